//! Mutations of valid input, from a seed.

use std::panic::catch_unwind;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::targets::{TARGETS, run};

/// Inputs that break careless parsers.
const TOKENS: [&[u8]; 34] = [
    b"NaN",
    b"inf",
    b"-1",
    b"-0",
    b"1e308",
    b"1e-320",
    b"1e400",
    b"1e39",
    b"18446744073709551616",
    b"180",
    b"-180",
    b"90",
    b"-90.0000001",
    b"null",
    b"true",
    b"\"",
    b"'",
    b"\n",
    b"\r\n",
    b",",
    b":",
    b"{",
    b"}",
    b"[",
    b"]",
    b"<",
    b">",
    b"&#0;",
    b"\0",
    b"\xef\xbb\xbf",
    b"\xff\xfe",
    "\u{1F600}".as_bytes(),
    b"9999-12-31T23:59:60Z",
    b"-9999-01-01T00:00:00+25:00",
];

/// A few random changes of an input.
pub(super) fn mutated(seeds: &[Vec<u8>], random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = seeds[random.random_range(0..seeds.len())].clone();
    for _ in 0..random.random_range(1..6) {
        let at = random.random_range(0..=bytes.len());
        let end = (at + random.random_range(0..20)).min(bytes.len());
        match random.random_range(0..7) {
            0 => bytes.truncate(at),
            1 => drop(bytes.drain(at..end)),
            2 => drop(bytes.splice(at..end, TOKENS[random.random_range(0..TOKENS.len())].iter().copied())),
            3 => drop(bytes.splice(at..at, TOKENS[random.random_range(0..TOKENS.len())].iter().copied())),
            4 => {
                let part = bytes[at..end].to_vec();
                let copies = random.random_range(1..200);
                drop(bytes.splice(at..at, part.repeat(copies)));
            }
            5 if at < bytes.len() => bytes[at] ^= 1 << random.random_range(0..8),
            _ => bytes.insert(at, random.random_range(0..=255)),
        }
    }
    bytes
}

/// So many mutations of each kind of input by default.
pub(super) fn iterations() -> u64 {
    crate::crash::setting("FUZZ_ITERATIONS", 1_500)
}

#[test]
fn mutated_input_is_read_or_refused() {
    for target in &TARGETS {
        let seeds = (target.seeds)();
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for input in &seeds {
            run(target.name, input);
        }
        // Each model is verified and probed, which takes longer.
        let iterations = if target.name == "model" { iterations() / 10 } else { iterations() };
        for iteration in 0..iterations {
            let input = mutated(&seeds, &mut random);
            let outcome = catch_unwind(|| run(target.name, &input));
            let shown = String::from_utf8_lossy(&input);
            assert!(outcome.is_ok(), "{} {iteration}: {shown:.2000}", target.name);
        }
    }
}
