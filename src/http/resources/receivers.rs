//! Receivers in a camera's profile.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::domain::{self, ClockOffset, ReceiverId, Receivers, Result, SigmaM, TargetId};

/// A GNSS receiver: whose it is, how far its clock is off, and its error.
#[derive(Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct Receiver {
    /// Its id, as fixes name it.
    #[schema(min_length = 1, max_length = 128, example = "phone-7")]
    receiver_id: String,
    /// The target that carries it; the receiver's own id if left out.
    #[serde(default)]
    #[schema(min_length = 1, max_length = 128, example = "person-1")]
    target_id: Option<String>,
    /// Seconds to be added to the receiver's time to get the camera's.
    #[serde(default)]
    #[schema(minimum = -86_400.0, maximum = 86_400.0, example = -0.35)]
    clock_offset_s: f64,
    /// Standard deviation per horizontal axis, m, of its fixes that state none; that of the camera's `gnss_error` if left
    /// out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.001, maximum = 10_000.0, example = 0.02)]
    sigma_m: Option<f64>,
}

impl Receiver {
    fn to_domain(&self) -> Result<domain::Receiver> {
        let named = domain::Receiver::named(ReceiverId::new(&self.receiver_id)?);
        Ok(domain::Receiver {
            target_id: self.target_id.as_deref().map_or(Ok(named.target_id), TargetId::new)?,
            clock_offset: ClockOffset::from_seconds(self.clock_offset_s)?,
            sigma: self.sigma_m.map(SigmaM::new).transpose()?,
            receiver_id: named.receiver_id,
        })
    }
}

/// The list as a value; the path of a field at fault begins at `receivers`.
pub(super) fn receivers(given: &[Receiver]) -> Result<Receivers> {
    let receiver = |(index, given): (usize, &Receiver)| {
        given.to_domain().map_err(|error| error.under(&format!("receivers[{index}]")))
    };
    Receivers::new(given.iter().enumerate().map(receiver).collect::<Result<Vec<_>>>()?)
}

/// The list as it is shown, all fields filled, by receiver id.
pub(super) fn shown(receivers: &Receivers) -> Vec<Receiver> {
    receivers.iter().map(Receiver::from).collect()
}

impl From<&domain::Receiver> for Receiver {
    fn from(receiver: &domain::Receiver) -> Self {
        Self {
            receiver_id: receiver.receiver_id.as_str().to_owned(),
            target_id: Some(receiver.target_id.as_str().to_owned()),
            clock_offset_s: receiver.clock_offset.seconds(),
            sigma_m: receiver.sigma.map(SigmaM::metres),
        }
    }
}
