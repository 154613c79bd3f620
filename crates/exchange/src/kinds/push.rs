//! Messages by HTTP to this server.

use crate::address::Scheme;

pub(super) const SCHEMES: &[Scheme] = &[Scheme::bare("push")];
