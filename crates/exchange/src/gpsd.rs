//! Fixes of a gpsd log: one JSON report per line, as written by `gpspipe -w`.
//!
//! Reports of class TPV contain the fixes, and those of class GST the standard deviations that receivers of NMEA state;
//! others are skipped. gpsd has called its estimates `epx` and `epy` 95 % errors until release 3.19, computes them so (15 m
//! times the dilution of precision) and has left their level open since then; `eph` is a radius of the same kind, or
//! what the receiver states, which for RTK is about one standard deviation of both axes.

use std::io::Read;

use jiff::Timestamp;
use serde::Deserialize;

use super::file_row::RowError;
use super::fix_quality::{
    Solution, StatedDeviations, sigma_of_deviations, sigma_of_intervals_95, sigma_of_radius_68,
    sigma_of_radius_95,
};
use super::fix_row::FixRow;
use super::lines::Lines;
use super::wire::{self, Text};
use crate::domain::{Error, ReceiverId, Result, SigmaM, TimeBounds, parse_time};

/// Reads a gpsd log's fixes.
pub(super) struct GpsdFixes<R> {
    lines: Lines<R>,
    reports: Reports,
    time_bounds: TimeBounds,
}

/// The fields of a report that are used.
#[derive(Deserialize)]
struct GpsdReport<'a> {
    #[serde(borrow)]
    class: Text<'a>,
    #[serde(borrow)]
    device: Option<Text<'a>>,
    mode: Option<u8>,
    status: Option<u8>,
    #[serde(borrow)]
    time: Option<Text<'a>>,
    /// Longitude, degrees; of GST its standard deviation, m.
    lon: Option<f64>,
    /// Latitude, degrees; of GST its standard deviation, m.
    lat: Option<f64>,
    epx: Option<f64>,
    epy: Option<f64>,
    eph: Option<f64>,
}

impl GpsdReport<'_> {
    fn solution(&self) -> Option<Solution> {
        Some(match self.status? {
            1 => Solution::Autonomous,
            2 => Solution::Differential,
            3 => Solution::RtkFixed,
            4 => Solution::RtkFloat,
            9 => Solution::Precise,
            _ => return None,
        })
    }

    /// By the errors that gpsd estimates, the larger where both are given; else by the kind of solution.
    fn sigma(&self) -> Option<SigmaM> {
        let is_rtk = matches!(self.solution(), Some(Solution::RtkFixed | Solution::RtkFloat));
        if let Some(eph_m) = self.eph.filter(|_| is_rtk) {
            return sigma_of_radius_68(eph_m);
        }
        let by_axes = self.epx.zip(self.epy).and_then(|(epx_m, epy_m)| sigma_of_intervals_95(epx_m, epy_m));
        let by_radius = self.eph.and_then(sigma_of_radius_95);
        let estimated = match (by_axes, by_radius) {
            (Some(one), Some(other)) => Some(if one > other { one } else { other }),
            (one, other) => one.or(other),
        };
        estimated.or_else(|| self.solution()?.sigma(None))
    }
}

/// The reports of one gpsd, in the order in which it sends them.
#[derive(Default)]
pub(super) struct Reports {
    /// The device that `deviations` are of.
    device: Option<String>,
    deviations: StatedDeviations<Option<u8>>,
}

impl<R: Read> GpsdFixes<R> {
    pub(super) fn new(reader: R, time_bounds: TimeBounds) -> Self {
        Self { lines: Lines::new(reader), reports: Reports::default(), time_bounds }
    }

    pub(super) fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        let Self { lines, reports, time_bounds } = self;
        lines.find_row(
            |line, text| {
                if text.is_empty() { Ok(None) } else { reports.fix(line, text, time_bounds) }
            },
        )
    }
}

impl Reports {
    /// The fix of a report; `None` for a report of another class.
    pub(super) fn fix(
        &mut self,
        line: u64,
        text: &str,
        time_bounds: &TimeBounds,
    ) -> Result<Option<Result<FixRow, RowError>>> {
        let report: GpsdReport<'_> = wire::parse_json(text.as_bytes())?;
        match report.class.as_str() {
            "TPV" => self.fix_of(line, report, time_bounds).map(Some),
            "GST" => {
                self.take_deviations(&report);
                Ok(None)
            }
            _ => Ok(None),
        }
    }

    fn take_deviations(&mut self, report: &GpsdReport<'_>) {
        let time = report.time.as_ref().and_then(|text| parse_time(text.as_str()).ok());
        let Some(time) = time else { return };
        let sigma =
            report.lon.zip(report.lat).and_then(|(east_m, north_m)| sigma_of_deviations(east_m, north_m));
        self.of_device(report).state(second_of_day(time), sigma);
    }

    /// The stated deviations of the report's device. Of several devices, only that of the latest report is remembered.
    fn of_device(&mut self, report: &GpsdReport<'_>) -> &mut StatedDeviations<Option<u8>> {
        let device = report.device.as_ref().map(Text::as_str);
        if self.device.as_deref() != device {
            *self = Self { device: device.map(str::to_owned), deviations: StatedDeviations::default() };
        }
        &mut self.deviations
    }

    fn fix_of(
        &mut self,
        line: u64,
        report: GpsdReport<'_>,
        time_bounds: &TimeBounds,
    ) -> Result<Result<FixRow, RowError>> {
        if matches!(report.mode, None | Some(0 | 1)) {
            return Err(Error::invalid("mode", "the receiver had no fix"));
        }
        if matches!(report.status, Some(5 | 7 | 8)) {
            let reason =
                "the position is dead reckoning, surveyed or simulated (status 5, 7, 8), not received";
            return Err(Error::invalid("status", reason));
        }
        let required =
            |number: Option<f64>, field| number.ok_or_else(|| Error::invalid(field, "is required"));
        let time: Option<Timestamp> =
            report.time.as_ref().map(|text| parse_time(text.as_str())).transpose()?;
        let stated = time.and_then(|time| self.of_device(&report).of_fix(second_of_day(time), report.status));
        let fix = wire::Fix {
            longitude_deg: required(report.lon, "lon")?,
            latitude_deg: required(report.lat, "lat")?,
            sigma_m: stated.or_else(|| report.sigma()).map(SigmaM::metres),
        };
        let receiver_id = report.device.map(|device| ReceiverId::new(device.as_str())).transpose();
        let receiver_id =
            receiver_id.map_err(|_| Error::invalid("device", "is too long or not printable"))?;
        Ok(FixRow::checked(line, time, receiver_id, fix.to_domain()?, time_bounds))
    }
}

fn second_of_day(time: Timestamp) -> f64 {
    time.duration_since(Timestamp::UNIX_EPOCH).as_secs_f64().rem_euclid(86_400.0)
}
