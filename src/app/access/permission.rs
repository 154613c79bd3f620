//! The permissions of operations, and the roles that have them.

use crate::domain::Role;

/// The permission that an operation needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Permission {
    /// Nothing: health and the description of the interface.
    Public,
    /// Any key that works.
    Authenticated,
    /// To read cameras, samples, runs, models, tracks, evaluations and metrics.
    Read,
    /// To fuse, stream and add samples, for the cameras of the key.
    Ingest,
    /// To change everything but keys, and to read the audit log.
    Operate,
    /// To create, list and revoke keys.
    Administer,
}

impl Permission {
    /// True if a role has the permission.
    #[must_use]
    pub const fn is_granted_to(self, role: Role) -> bool {
        match self {
            Self::Public | Self::Authenticated => true,
            Self::Read => matches!(role, Role::Viewer | Role::Operator | Role::Admin),
            Self::Ingest => matches!(role, Role::Edge | Role::Operator | Role::Admin),
            Self::Operate => matches!(role, Role::Operator | Role::Admin),
            Self::Administer => matches!(role, Role::Admin),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Permission::{Administer, Authenticated, Ingest, Operate, Public, Read};
    use super::*;

    #[test]
    fn roles_have_the_permissions_that_the_documentation_states() {
        let granted = |role: Role| {
            [Public, Authenticated, Read, Ingest, Operate, Administer].map(|it| it.is_granted_to(role))
        };
        assert_eq!(granted(Role::Viewer), [true, true, true, false, false, false]);
        assert_eq!(granted(Role::Edge), [true, true, false, true, false, false]);
        assert_eq!(granted(Role::Operator), [true, true, true, true, true, false]);
        assert_eq!(granted(Role::Admin), [true; 6]);
        assert_eq!(Role::ALL.len(), 4);
    }
}
