//! `sightfix simulate site`

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use jiff::Timestamp;

use crate::domain::TargetId;
use crate::simulation::{LabelledDetection, SimulatedCamera, SimulatedSite, SiteOptions, simulate_site};

/// Write a simulated site of several cameras: a file of boxes per camera, the fixes, who is who, and the truth
///
/// The cameras stand along a street, in pairs whose views overlap with gaps between the pairs. `evaluate --site`
/// reads the folder; detections_<CAMERA>.csv and fixes.csv are also what `pair` and the imports read.
#[derive(Args)]
pub(super) struct SimulateSite {
    /// Output folder
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Number of cameras
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u16).range(1..=100))]
    cameras: u16,
    /// Number of walkers
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u16).range(0..=1_000))]
    walkers: u16,
    /// Share of the walkers who walk in groups of two to four
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    groups: f64,
    /// Number of vehicles
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u16).range(0..=1_000))]
    vehicles: u16,
    /// Share of the targets that carry a receiver
    #[arg(long, value_name = "SHARE", default_value_t = 0.5)]
    receivers: f64,
    /// Length, s
    #[arg(long, value_name = "S", default_value_t = 300.0)]
    duration_s: f64,
    /// Time between two frames, s
    #[arg(long, value_name = "S", default_value_t = 0.5)]
    frame_interval_s: f64,
    /// Standard deviation per axis of the receivers, m
    #[arg(long, value_name = "S", default_value_t = 2.6)]
    gnss_sigma_m: f64,
    /// Standard deviation of each edge of a box, px
    #[arg(long, value_name = "N", default_value_t = 2.0)]
    box_noise_px: f64,
    /// Share of the targets in view that a frame misses
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    missed: f64,
    /// Mean number of false detections per frame
    #[arg(long, value_name = "N", default_value_t = 0.0)]
    false_detections: f64,
    /// Mean time after which a tracker gives a target a new id, s [default: only after a gap]
    #[arg(long, value_name = "S")]
    tracker_id_lifetime_s: Option<f64>,
    /// Mean time after which a tracker swaps the ids of two neighbours, s [default: never]
    #[arg(long, value_name = "S")]
    tracker_id_swap_s: Option<f64>,
    /// Seed of everything but the cameras and the receivers' errors
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Seed of the cameras
    #[arg(long, value_name = "N", default_value_t = 1)]
    camera_seed: u64,
    /// Seed of the receivers' errors
    #[arg(long, value_name = "N", default_value_t = 1)]
    receiver_seed: u64,
}

impl SimulateSite {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let options = SiteOptions {
            seed: self.seed,
            camera_seed: self.camera_seed,
            receiver_seed: self.receiver_seed,
            cameras: self.cameras.into(),
            walkers: self.walkers.into(),
            group_share: self.groups,
            vehicles: self.vehicles.into(),
            receiver_share: self.receivers,
            duration_s: self.duration_s,
            frame_interval_s: self.frame_interval_s,
            gnss_sigma_m: self.gnss_sigma_m,
            box_noise_px: self.box_noise_px,
            missed_share: self.missed,
            false_per_frame: self.false_detections,
            tracker_id_lifetime_s: self.tracker_id_lifetime_s,
            tracker_id_swap_s: self.tracker_id_swap_s,
            ..SiteOptions::default()
        };
        check(&options)?;
        let site = simulate_site(&options);
        std::fs::create_dir_all(&self.out)
            .with_context(|| format!("cannot create the folder {}", self.out.display()))?;
        for camera in &site.cameras {
            let name = format!("detections_{}.csv", camera.id);
            write(&self.out.join(name), |out| write_detections(out, camera))?;
        }
        write(&self.out.join("fixes.csv"), |out| write_fixes(out, &site))?;
        write(&self.out.join("identity.csv"), |out| write_identities(out, &site))?;
        write(&self.out.join("truth.csv"), |out| write_truth(out, &site))
    }
}

fn check(options: &SiteOptions) -> anyhow::Result<()> {
    anyhow::ensure!(options.walkers + options.vehicles > 0, "give at least one walker or vehicle");
    anyhow::ensure!(
        (1.0..=86_400.0).contains(&options.duration_s),
        "--duration-s must be from 1 to 86,400 s"
    );
    anyhow::ensure!(
        (0.02..=10.0).contains(&options.frame_interval_s),
        "--frame-interval-s must be from 0.02 to 10 s"
    );
    anyhow::ensure!(
        (0.001..=1e4).contains(&options.gnss_sigma_m),
        "--gnss-sigma-m must be from 0.001 to 10,000 m"
    );
    anyhow::ensure!((0.0..=100.0).contains(&options.box_noise_px), "--box-noise-px must be from 0 to 100");
    anyhow::ensure!((0.0..=1.0).contains(&options.receiver_share), "--receivers must be a share from 0 to 1");
    anyhow::ensure!((0.0..=1.0).contains(&options.group_share), "--groups must be a share from 0 to 1");
    anyhow::ensure!((0.0..=0.95).contains(&options.missed_share), "--missed must be a share from 0 to 0.95");
    anyhow::ensure!(
        (0.0..=100.0).contains(&options.false_per_frame),
        "--false-detections must be from 0 to 100"
    );
    for (name, mean_s) in [
        ("tracker-id-lifetime-s", options.tracker_id_lifetime_s),
        ("tracker-id-swap-s", options.tracker_id_swap_s),
    ] {
        let is_valid = mean_s.is_none_or(|mean_s| (1.0..=1e6).contains(&mean_s));
        anyhow::ensure!(is_valid, "--{name} must be from 1 to 1,000,000 s");
    }
    Ok(())
}

fn write(path: &Path, rows: impl FnOnce(&mut dyn Write) -> std::io::Result<()>) -> anyhow::Result<()> {
    let cannot = || format!("cannot write {}", path.display());
    let mut out = BufWriter::new(File::create(path).with_context(cannot)?);
    rows(&mut out).and_then(|()| out.flush()).with_context(cannot)
}

fn write_detections(out: &mut dyn Write, camera: &SimulatedCamera) -> std::io::Result<()> {
    writeln!(out, "time,target_id,left,top,width,height,class")?;
    for LabelledDetection { detection, .. } in &camera.detections {
        let [left_px, top_px, width_px, height_px] = detection.bounding_box.sides_px();
        let class = detection.class.as_ref().map_or("", |class| class.as_str());
        writeln!(
            out,
            "{},{},{left_px:.2},{top_px:.2},{width_px:.2},{height_px:.2},{class}",
            detection.time, detection.target_id,
        )?;
    }
    Ok(())
}

fn write_fixes(out: &mut dyn Write, site: &SimulatedSite) -> std::io::Result<()> {
    writeln!(out, "time,receiver_id,longitude,latitude")?;
    for fix in &site.fixes {
        let receiver = fix.receiver_id.as_ref().map_or("", |receiver| receiver.as_str());
        let position = fix.fix.position;
        let (longitude_deg, latitude_deg) = (position.longitude_deg(), position.latitude_deg());
        writeln!(out, "{},{receiver},{longitude_deg:.8},{latitude_deg:.8}", fix.time)?;
    }
    Ok(())
}

/// Who had which id when: an id changes hands where the tracker swaps it.
fn write_identities(out: &mut dyn Write, site: &SimulatedSite) -> std::io::Result<()> {
    writeln!(out, "camera,target_id,person,from,until")?;
    for camera in &site.cameras {
        let mut latest: BTreeMap<&TargetId, (&TargetId, Timestamp, Timestamp)> = BTreeMap::new();
        let mut segments = Vec::new();
        for LabelledDetection { detection, target } in &camera.detections {
            let Some(target) = target else { continue };
            let time = detection.time;
            match latest.get_mut(&detection.target_id) {
                Some((person, _, until)) if *person == target => *until = time,
                _ => {
                    let ended = latest.insert(&detection.target_id, (target, time, time));
                    segments.extend(ended.map(|segment| (&detection.target_id, segment)));
                }
            }
        }
        segments.extend(latest);
        segments.sort();
        for (id, (person, from, until)) in segments {
            writeln!(out, "{},{id},{person},{from},{until}", camera.id)?;
        }
    }
    Ok(())
}

fn write_truth(out: &mut dyn Write, site: &SimulatedSite) -> std::io::Result<()> {
    writeln!(out, "time,person,longitude,latitude")?;
    for (time, target, position) in &site.truth {
        writeln!(out, "{time},{target},{:.8},{:.8}", position.longitude_deg(), position.latitude_deg())?;
    }
    Ok(())
}
