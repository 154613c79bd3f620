//! Drift detection of one camera: what its model states against what receivers state.

use std::sync::Mutex;

use super::sync::lock;
use crate::domain::CameraMoved;
use crate::fusion::drift_detector::{DriftAlarm, DriftDetector, DriftDetectorSettings, ResidualSample};
use crate::fusion::track::TrackSettings;
use crate::model::Regressor;

/// One camera's drift detector; a new one with every model version.
#[derive(Default)]
pub(super) struct DriftMonitor(Mutex<Option<Monitored>>);

struct Monitored {
    model_version: u32,
    detector: DriftDetector,
    /// Raised, but not yet stored, because storing it has failed.
    unsaved: Option<DriftAlarm>,
}

impl DriftMonitor {
    /// Takes a residual of a model version; `Some` while there is an alarm to be stored.
    pub(super) fn observe(
        &self,
        (regressor, model_version): (&Regressor, u32),
        residual: &ResidualSample,
    ) -> Option<CameraMoved> {
        let mut monitored = lock(&self.0);
        if monitored.as_ref().is_none_or(|it| it.model_version != model_version) {
            let gnss = TrackSettings::from_model(regressor).gnss;
            let detector =
                DriftDetector::new(DriftDetectorSettings { gnss, ..DriftDetectorSettings::default() });
            *monitored = Some(Monitored { model_version, detector, unsaved: None });
        }
        let monitored = monitored.as_mut()?;
        if let Some(alarm) = monitored.detector.observe(residual) {
            monitored.unsaved = Some(alarm);
        }
        monitored.unsaved.map(|alarm| camera_moved(model_version, &alarm))
    }

    /// The alarm is stored.
    pub(super) fn saved(&self) {
        if let Some(monitored) = lock(&self.0).as_mut() {
            monitored.unsaved = None;
        }
    }
}

fn camera_moved(model_version: u32, alarm: &DriftAlarm) -> CameraMoved {
    CameraMoved {
        model_version,
        onset_at: alarm.onset_at,
        raised_at: alarm.detected_at,
        shift_east_m: alarm.shift.east_m,
        shift_north_m: alarm.shift.north_m,
        statistic: alarm.glr_statistic,
        targets: u32::try_from(alarm.supporting_targets).unwrap_or(u32::MAX),
    }
}
