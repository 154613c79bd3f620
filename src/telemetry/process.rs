//! Figures of this process and of its machine, from the operating system.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use rustix::process::{Resource, getrlimit};

use crate::clock::process_cpu_s;

/// Ticks per second in `/proc`: fixed in the interface of the kernel on all architectures that matter.
const TICKS_PER_S: f64 = 100.0;
/// Bytes in a unit of `/proc/meminfo` and `/proc/self/status`.
const KIB: u64 = 1_024;

/// Files that this process may have open; `None` without a limit.
#[must_use]
pub fn open_files_limit() -> Option<u64> {
    getrlimit(Resource::Nofile).current
}

/// Memory that new work can have: that of the machine or of the control group, whichever is less.
#[must_use]
pub fn available_memory_bytes() -> Option<u64> {
    let machine = field_kib("/proc/meminfo", "MemAvailable:");
    let group = control_group_bytes("memory.max")
        .map(|most| most.saturating_sub(control_group_bytes("memory.current").unwrap_or_default()));
    machine.into_iter().chain(group).min()
}

fn control_group_bytes(name: &str) -> Option<u64> {
    fs::read_to_string(Path::new("/sys/fs/cgroup").join(name)).ok()?.trim().parse().ok()
}

fn field_kib(path: &str, name: &str) -> Option<u64> {
    let text = fs::read_to_string(path).ok()?;
    let line = text.lines().find(|line| line.starts_with(name))?;
    let number: u64 = line[name.len()..].split_whitespace().next()?.parse().ok()?;
    Some(number * KIB)
}

/// The conventional `process_*` metrics in Prometheus' text format. What the system does not tell is left out.
pub(super) fn render() -> String {
    let mut text = String::new();
    let mut metric = |name: &str, kind: &str, help: &str, value: Option<f64>| {
        if let Some(value) = value {
            let _ = write!(text, "# HELP {name} {help}\n# TYPE {name} {kind}\n{name} {value}\n\n");
        }
    };
    let memory_bytes = |name| field_kib("/proc/self/status", name).map(|bytes| bytes as f64);
    metric("process_cpu_seconds_total", "counter", "CPU time, user and system", Some(process_cpu_s()));
    metric("process_resident_memory_bytes", "gauge", "Resident memory", memory_bytes("VmRSS:"));
    metric("process_virtual_memory_bytes", "gauge", "Virtual memory", memory_bytes("VmSize:"));
    metric("process_open_fds", "gauge", "Open file descriptors", open_files().map(|files| files as f64));
    let limit = open_files_limit().map_or(f64::INFINITY, |limit| limit as f64);
    metric("process_max_fds", "gauge", "Limit of open file descriptors", limit.is_finite().then_some(limit));
    metric("process_start_time_seconds", "gauge", "Start of the process, seconds since 1970", start_s());
    text
}

fn open_files() -> Option<u64> {
    // Linux tells their number as the size of the folder since 6.2; older kernels tell 0.
    let folder = Path::new("/proc/self/fd");
    match fs::metadata(folder).ok()?.len() {
        0 => Some(fs::read_dir(folder).ok()?.count() as u64),
        files => Some(files),
    }
}

fn start_s() -> Option<f64> {
    let stat = fs::read_to_string("/proc/self/stat").ok()?;
    // The name of the process may contain anything, so fields are counted from its end.
    let (_, fields) = stat.rsplit_once(')')?;
    // proc(5): starttime is field 22; the first after the name is field 3.
    let ticks: f64 = fields.split_whitespace().nth(22 - 3)?.parse().ok()?;
    let stat = fs::read_to_string("/proc/stat").ok()?;
    let boot_s: f64 = stat.lines().find_map(|line| line.strip_prefix("btime "))?.trim().parse().ok()?;
    Some(boot_s + ticks / TICKS_PER_S)
}
