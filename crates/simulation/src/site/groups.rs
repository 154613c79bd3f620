//! Walkers who walk together.

use std::f64::consts::TAU;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::options::SiteOptions;
use crate::geo::EastNorth;

/// Smallest and largest group.
const SIZES: [usize; 2] = [2, 4];
/// Distance of a companion from whom it walks with, m.
const APART_M: [f64; 2] = [0.4, 1.3];

/// Whom a walker walks with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Company {
    /// Index of a walker before it.
    pub(super) leader: usize,
    /// From the leader to the companion, m.
    pub(super) offset_m: EastNorth,
}

/// The company of each walker; `None` for leaders and for those who walk alone.
pub(super) fn drawn(options: &SiteOptions, random: &mut ChaCha8Rng) -> Vec<Option<Company>> {
    let grouped = (options.group_share * options.walkers as f64).round() as usize;
    let mut company = Vec::with_capacity(options.walkers);
    while company.len() + SIZES[0] <= grouped {
        let leader = company.len();
        let size = random.random_range(SIZES[0]..=SIZES[1]).min(grouped - leader);
        company.push(None);
        company.extend((1..size).map(|_| Some(Company { leader, offset_m: drawn_offset_m(random) })));
    }
    company.resize(options.walkers, None);
    company
}

fn drawn_offset_m(random: &mut ChaCha8Rng) -> EastNorth {
    let (distance_m, angle) = (random.random_range(APART_M[0]..APART_M[1]), TAU * random.random::<f64>());
    EastNorth { east_m: distance_m * angle.cos(), north_m: distance_m * angle.sin() }
}
