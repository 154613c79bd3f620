//! Settings of a history, as cameras and sites store them.

use serde::{Deserialize, Serialize};

use crate::domain::{HistorySettings, Result};

/// The settings as JSON.
#[derive(Serialize, Deserialize)]
pub(crate) struct StoredHistory {
    keep_days: u32,
    max_bytes: u64,
    coarsen_m: f64,
}

impl StoredHistory {
    pub(crate) fn to_domain(&self) -> Result<HistorySettings> {
        HistorySettings::new(self.keep_days, self.max_bytes, self.coarsen_m)
    }
}

impl From<HistorySettings> for StoredHistory {
    fn from(settings: HistorySettings) -> Self {
        Self {
            keep_days: settings.keep_days(),
            max_bytes: settings.max_bytes(),
            coarsen_m: settings.coarsen_m(),
        }
    }
}
