//! On whose behalf a use case runs.

use std::net::IpAddr;
use std::sync::{Arc, LazyLock};

use super::key_table::ActiveKey;
use super::permission::Permission;
use super::signed_in_user::SignedInUser;
use crate::domain::{Actor, CameraId, Error, ErrorKind, Result, Scope};

/// The holder of a client certificate that the server's client authority has signed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CertificateHolder {
    /// The first 16 hexadecimal digits of the certificate's SHA-256.
    pub fingerprint: Arc<str>,
    /// The scope of certificates of that authority.
    pub scope: Arc<Scope>,
}

/// Who makes a request.
#[derive(Clone)]
pub enum Principal {
    /// Somebody without a credential.
    Anonymous,
    /// Anybody, while no key exists.
    Everyone,
    /// The program itself: a background job, or a command on the data folder.
    Program,
    /// The holder of a key.
    Key(Arc<ActiveKey>),
    /// A person who has signed in by OpenID Connect.
    User(Arc<SignedInUser>),
    /// The holder of a client certificate.
    Certificate(CertificateHolder),
}

impl Principal {
    /// Returns the principal's scope; `None` for no restriction, and for the anonymous, who may do
    /// nothing.
    #[must_use]
    pub fn scope(&self) -> Option<&Scope> {
        match self {
            Self::Anonymous | Self::Everyone | Self::Program => None,
            Self::Key(key) => Some(&key.key().scope),
            Self::User(user) => Some(user.scope()),
            Self::Certificate(holder) => Some(&holder.scope),
        }
    }

    fn name(&self) -> Arc<str> {
        // Shared, because every request needs one.
        static ANONYMOUS: LazyLock<Arc<str>> = LazyLock::new(|| "anonymous".into());
        static EVERYONE: LazyLock<Arc<str>> = LazyLock::new(|| "open access".into());
        match self {
            Self::Anonymous => ANONYMOUS.clone(),
            Self::Everyone => EVERYONE.clone(),
            Self::Program => "program".into(),
            Self::Key(key) => key.name(),
            Self::User(user) => user.name(),
            Self::Certificate(holder) => format!("certificate {}", holder.fingerprint).into(),
        }
    }
}

/// A principal, and where its request comes from. Clones are cheap.
#[derive(Clone)]
pub struct Caller {
    principal: Principal,
    actor: Arc<Actor>,
}

impl Caller {
    /// The sender of a request.
    #[must_use]
    pub fn new(principal: Principal, address: Option<IpAddr>, request_id: Option<Arc<str>>) -> Self {
        let (key_id, identity) = match &principal {
            Principal::Key(key) => (Some(key.key().id), None),
            Principal::User(user) => (None, Some(user.subject())),
            Principal::Certificate(_) => (None, Some(principal.name())),
            Principal::Anonymous | Principal::Everyone | Principal::Program => (None, None),
        };
        let actor = Arc::new(Actor { name: principal.name(), key_id, identity, address, request_id });
        Self { principal, actor }
    }

    /// A part of the program that acts by itself.
    #[must_use]
    pub fn program(name: &str) -> Self {
        Self { principal: Principal::Program, actor: Arc::new(Actor::program(name)) }
    }

    /// Who it is.
    #[must_use]
    pub const fn principal(&self) -> &Principal {
        &self.principal
    }

    /// As the audit log and the log name it.
    #[must_use]
    pub const fn actor(&self) -> &Arc<Actor> {
        &self.actor
    }

    /// Checks that the caller may use operations that need a permission.
    ///
    /// # Errors
    /// `Unauthenticated` without a credential; `PermissionDenied` if the role does not have it.
    pub fn authorize(&self, permission: Permission) -> Result<()> {
        match self.principal() {
            Principal::Anonymous if permission != Permission::Public => Err(Error::refused(
                ErrorKind::Unauthenticated,
                "the request needs a key: send the header `authorization: Bearer sf_...`",
            )),
            principal => match principal.scope().map(Scope::role) {
                Some(role) if !permission.is_granted_to(role) => Err(Error::refused(
                    ErrorKind::PermissionDenied,
                    format!("the role {role} may not do this; use a key of another role"),
                )),
                _ => Ok(()),
            },
        }
    }

    /// Checks that the caller may reach a camera.
    ///
    /// # Errors
    /// `PermissionDenied` if its key is restricted to others.
    pub fn authorize_camera(&self, camera: &CameraId) -> Result<()> {
        match self.principal().scope() {
            Some(scope) if !scope.contains(camera) => Err(Error::refused(
                ErrorKind::PermissionDenied,
                format!("the key is not for camera {camera}"),
            )),
            _ => Ok(()),
        }
    }

    /// Checks that the caller's key has not been revoked, nor expired, since the request began, and their session
    /// has not ended.
    ///
    /// # Errors
    /// `Unauthenticated`.
    pub fn check_active(&self) -> Result<()> {
        match self.principal() {
            Principal::Key(key) => key.check_active(),
            Principal::User(user) => user.check_active(),
            _ => Ok(()),
        }
    }

    /// True if the caller may lose its access while a request is open.
    #[must_use]
    pub fn is_revocable(&self) -> bool {
        matches!(self.principal(), Principal::Key(_) | Principal::User(_))
    }

    /// Waits until the caller's key is revoked or expires, or their session ends; the error says so.
    pub async fn ended(&self) -> Error {
        match self.principal() {
            Principal::Key(key) => key.ended().await,
            Principal::User(user) => user.ended().await,
            _ => std::future::pending().await,
        }
    }
}
