//! Who may use the server: roles, and keys that programs present.

use std::fmt;
use std::str::FromStr;

use jiff::Timestamp;
use sha2::{Digest, Sha256};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};
use subtle::ConstantTimeEq as _;
use uuid::Uuid;

use super::error::{Error, ErrorKind, Result};
use super::names::{CameraId, check_text};

/// The purpose of a key. `app::access` says which operations each role may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Display, EnumString, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_role)]
pub enum Role {
    /// Reads everything but keys and the audit log.
    Viewer,
    /// A device: fuses, streams and adds samples, for the cameras that its key names only.
    Edge,
    /// Everything but keys.
    Operator,
    /// Everything.
    Admin,
}

impl Role {
    /// All roles, the most restricted first.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// Name in the database and in wire formats.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

fn unknown_role(_: &str) -> Error {
    Error::invalid("role", "must be one of viewer, edge, operator, admin")
}

/// A role, with the cameras that it is restricted to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Scope {
    role: Role,
    cameras: Vec<CameraId>,
}

impl Scope {
    /// Most cameras that one key names.
    pub const MAX_CAMERAS: usize = 256;

    /// # Errors
    /// Names the field `camera_ids`: the role `edge` needs cameras, the others take none.
    pub fn new(role: Role, mut cameras: Vec<CameraId>) -> Result<Self> {
        cameras.sort();
        cameras.dedup();
        let message = match role {
            Role::Edge if cameras.is_empty() => "must name the cameras that the role edge is restricted to",
            Role::Edge if cameras.len() > Self::MAX_CAMERAS => "must be at most 256",
            Role::Edge => return Ok(Self { role, cameras }),
            _ if cameras.is_empty() => return Ok(Self { role, cameras }),
            _ => "must be empty: only the role edge is restricted to cameras",
        };
        Err(Error::invalid("camera_ids", message))
    }

    /// The role.
    #[must_use]
    pub const fn role(&self) -> Role {
        self.role
    }

    /// The cameras of the role `edge`, by id; empty for the others, which reach all.
    #[must_use]
    pub fn cameras(&self) -> &[CameraId] {
        &self.cameras
    }

    /// True if the scope contains a camera.
    #[must_use]
    pub fn contains(&self, camera: &CameraId) -> bool {
        self.role != Role::Edge || self.cameras.binary_search(camera).is_ok()
    }
}

/// Id of a key, which may be shown: a UUID of version 7, so that keys sort by their time of creation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct KeyId(pub Uuid);

impl fmt::Display for KeyId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(out)
    }
}

impl FromStr for KeyId {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let id = Uuid::parse_str(text);
        id.map(Self).map_err(|_| Error::refused(ErrorKind::KeyNotFound, "a key's id is a UUID"))
    }
}

const PREFIX: &str = "sf_";
const ALPHABET: &[u8; 62] = b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz";
/// 62^30 is about 2^178.
const RANDOM_CHARACTERS: usize = 30;
/// Enough for 32 bits: 62^6 > 2^32.
const CHECKSUM_CHARACTERS: usize = 6;

/// The secret that a client presents: `sf_`, 30 random characters of base 62, and 6 with the CRC-32 of all
/// before them, so that a mistyped key is recognised without a lookup, and leaked ones by scanners.
#[derive(Clone, PartialEq, Eq)]
pub struct KeySecret(String);

impl KeySecret {
    /// A new secret from a source of random bytes.
    pub fn generate(mut fill_random: impl FnMut(&mut [u8])) -> Self {
        let mut text = PREFIX.to_owned();
        while text.len() < PREFIX.len() + RANDOM_CHARACTERS {
            let mut byte = [0];
            fill_random(&mut byte);
            // The largest multiple of 62: every character is equally likely.
            if byte[0] < 248 {
                text.push(char::from(ALPHABET[usize::from(byte[0]) % ALPHABET.len()]));
            }
        }
        let checksum = checksum(&text);
        Self(text + &checksum)
    }

    /// # Errors
    /// `Unauthenticated` for text that is not such a secret. It is not repeated in the message.
    pub fn parse(text: &str) -> Result<Self> {
        let is_complete = text.len() == PREFIX.len() + RANDOM_CHARACTERS + CHECKSUM_CHARACTERS
            && text.starts_with(PREFIX)
            && text[PREFIX.len()..].bytes().all(|byte| byte.is_ascii_alphanumeric());
        let (random, found) = text.split_at_checked(PREFIX.len() + RANDOM_CHARACTERS).unwrap_or_default();
        if is_complete && checksum(random) == found {
            return Ok(Self(text.to_owned()));
        }
        let message = "the key is incomplete or mistyped: it begins with sf_ and has 39 characters";
        Err(Error::refused(ErrorKind::Unauthenticated, message))
    }

    /// The text, to be shown to its owner once.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }

    /// Returns the digest that is stored of the secret.
    #[must_use]
    pub fn digest(&self) -> SecretDigest {
        SecretDigest::of(self.0.as_bytes())
    }
}

/// Hides the secret.
impl fmt::Debug for KeySecret {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("KeySecret(hidden)")
    }
}

fn checksum(text: &str) -> String {
    let mut rest = crc32fast::hash(text.as_bytes());
    let mut characters = [b'0'; CHECKSUM_CHARACTERS];
    for character in characters.iter_mut().rev() {
        *character = ALPHABET[(rest % 62) as usize];
        rest /= 62;
    }
    characters.iter().map(|&byte| char::from(byte)).collect()
}

/// SHA-256 of a random secret. No salt or slow hash is needed: the secret cannot be guessed.
#[derive(Clone, Copy)]
pub struct SecretDigest([u8; 32]);

impl SecretDigest {
    /// The digest of a secret.
    #[must_use]
    pub fn of(secret: &[u8]) -> Self {
        Self(Sha256::digest(secret).into())
    }

    /// A stored digest.
    #[must_use]
    pub const fn from_bytes(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    /// As it is stored.
    #[must_use]
    pub const fn as_bytes(&self) -> &[u8; 32] {
        &self.0
    }

    /// Its first 64 bits, to look it up by; [`PartialEq`] decides.
    #[must_use]
    pub fn bucket(&self) -> u64 {
        self.0.first_chunk().map_or(0, |first| u64::from_le_bytes(*first))
    }
}

/// Takes the same time wherever the digests differ.
impl PartialEq for SecretDigest {
    fn eq(&self, other: &Self) -> bool {
        self.0.ct_eq(&other.0).into()
    }
}

/// A key to be created.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewKey {
    /// The key's purpose, for people.
    pub name: String,
    /// The cameras and sites that the key may use.
    pub scope: Scope,
    /// When it stops working, if it does.
    pub expires_at: Option<Timestamp>,
}

impl NewKey {
    /// # Errors
    /// Names the invalid field: a name that is not 1 to 128 bytes of text, an expiry that is over.
    pub fn new(name: &str, scope: Scope, expires_at: Option<Timestamp>, now: Timestamp) -> Result<Self> {
        check_text("name", name, 128)?;
        if expires_at.is_some_and(|expires_at| expires_at <= now) {
            return Err(Error::invalid("expires_at", "must be in the future"));
        }
        Ok(Self { name: name.to_owned(), scope, expires_at })
    }
}

/// A stored key, without its secret.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ApiKey {
    /// Its id.
    pub id: KeyId,
    /// The key's purpose, for people.
    pub name: String,
    /// The cameras and sites that the key may use.
    pub scope: Scope,
    /// Time of creation.
    pub created_at: Timestamp,
    /// When it stops working, if it does.
    pub expires_at: Option<Timestamp>,
    /// Time of its latest use, to about a minute.
    pub last_used_at: Option<Timestamp>,
    /// Time of its revocation; it does not work since then.
    pub revoked_at: Option<Timestamp>,
}

impl ApiKey {
    /// True if the key works at a time.
    #[must_use]
    pub fn is_valid_at(&self, now: Timestamp) -> bool {
        self.revoked_at.is_none() && self.expires_at.is_none_or(|expires_at| now < expires_at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn secret() -> KeySecret {
        let mut next = 0_u8;
        KeySecret::generate(|bytes| {
            for byte in bytes {
                next = next.wrapping_add(83);
                *byte = next;
            }
        })
    }

    #[test]
    fn a_secret_is_recognised_by_its_checksum() {
        let secret = secret();
        let text = secret.reveal().to_owned();
        assert_eq!((text.len(), &text[..3]), (39, "sf_"));
        assert_eq!(KeySecret::parse(&text).expect("its own"), secret);
        for at in 3..text.len() {
            let mut wrong = text.clone().into_bytes();
            wrong[at] = if wrong[at] == b'a' { b'b' } else { b'a' };
            let wrong = String::from_utf8(wrong).expect("ASCII");
            let refused = KeySecret::parse(&wrong).expect_err(&wrong);
            assert_eq!(refused.kind(), ErrorKind::Unauthenticated);
            assert!(!refused.to_string().contains(&wrong), "a secret must not enter a log: {refused}");
        }
        for wrong in ["", "sf_", &text[1..], "sf_é", &format!("{text}0")] {
            assert!(KeySecret::parse(wrong).is_err(), "{wrong}");
        }
        assert!(!format!("{secret:?}").contains(&text));
    }

    #[test]
    fn digests_are_compared_whole() {
        let digest = secret().digest();
        assert!(digest == SecretDigest::from_bytes(*digest.as_bytes()));
        for at in 0..32 {
            let mut other = *digest.as_bytes();
            other[at] ^= 1;
            assert!(digest != SecretDigest::from_bytes(other), "byte {at}");
        }
    }

    #[test]
    fn only_devices_are_restricted_to_cameras() {
        let camera = CameraId::new("gate").expect("a slug");
        let other = CameraId::new("yard").expect("a slug");
        let edge = Scope::new(Role::Edge, vec![camera.clone()]).expect("one camera");
        assert!(edge.contains(&camera) && !edge.contains(&other));
        assert!(Scope::new(Role::Edge, Vec::new()).is_err());
        assert!(Scope::new(Role::Admin, vec![camera.clone()]).is_err());
        assert!(Scope::new(Role::Viewer, Vec::new()).expect("all cameras").contains(&other));
    }

    #[test]
    fn a_key_works_until_it_expires_or_is_revoked() {
        let at = |second| Timestamp::from_second(second).expect("in range");
        let scope = Scope::new(Role::Viewer, Vec::new()).expect("all cameras");
        assert!(NewKey::new("late", scope.clone(), Some(at(5)), at(5)).is_err());
        let key = ApiKey {
            id: KeyId(Uuid::nil()),
            name: "n".to_owned(),
            scope,
            created_at: at(0),
            expires_at: Some(at(10)),
            last_used_at: None,
            revoked_at: None,
        };
        assert!(key.is_valid_at(at(9)) && !key.is_valid_at(at(10)));
        assert!(!ApiKey { revoked_at: Some(at(1)), ..key }.is_valid_at(at(2)));
    }
}
