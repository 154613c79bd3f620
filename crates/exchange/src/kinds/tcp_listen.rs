//! Ports of this machine that take lines.

use crate::address::Scheme;

pub(super) const SCHEMES: &[Scheme] = &[Scheme::host("tcp-listen", None)];
