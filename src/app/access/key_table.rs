//! The keys that work, looked up without a lock and without the database.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use arc_swap::ArcSwap;
use jiff::Timestamp;
use tokio::sync::Mutex;
use tokio_util::sync::CancellationToken;

use crate::domain::{ApiKey, Error, ErrorKind, KeyId, Result, SecretDigest};
use crate::store::{KeysVersion, Store};

/// Shortest time between two looks for unknown keys, whoever presents them.
const LOOK_PAUSE: Duration = Duration::from_millis(100);

/// A key that works, until it is revoked or expires.
pub struct ActiveKey {
    key: ApiKey,
    name: Arc<str>,
    digest: SecretDigest,
    /// Microseconds since 1970; 0 if never.
    last_used_us: AtomicI64,
    stored_use_us: AtomicI64,
    has_ended: AtomicBool,
    ended: CancellationToken,
}

impl ActiveKey {
    fn new(key: ApiKey, digest: SecretDigest) -> Arc<Self> {
        let last_used_us = key.last_used_at.map_or(0, Timestamp::as_microsecond);
        Arc::new(Self {
            name: key.name.as_str().into(),
            key,
            digest,
            last_used_us: AtomicI64::new(last_used_us),
            stored_use_us: AtomicI64::new(last_used_us),
            has_ended: AtomicBool::new(false),
            ended: CancellationToken::new(),
        })
    }

    /// As it was stored when it was loaded; its last use may be later.
    #[must_use]
    pub const fn key(&self) -> &ApiKey {
        &self.key
    }

    #[must_use]
    pub fn name(&self) -> Arc<str> {
        self.name.clone()
    }

    /// Records a use; `false` if the key does not work any more.
    pub(super) fn use_at(&self, now: Timestamp) -> bool {
        let works = !self.has_ended() && self.key.is_valid_at(now);
        if works {
            self.last_used_us.fetch_max(now.as_microsecond(), Ordering::Relaxed);
        }
        works
    }

    pub(super) fn has_ended(&self) -> bool {
        self.has_ended.load(Ordering::Acquire)
    }

    pub(super) fn check_active(&self) -> Result<()> {
        if self.has_ended() { Err(does_not_work()) } else { Ok(()) }
    }

    /// Waits until the key is revoked or expires.
    pub(super) async fn ended(&self) -> Error {
        self.ended.cancelled().await;
        does_not_work()
    }

    fn end(&self) {
        self.has_ended.store(true, Ordering::Release);
        self.ended.cancel();
    }
}

fn does_not_work() -> Error {
    Error::refused(ErrorKind::Unauthenticated, "the key is unknown, was revoked or has expired")
}

/// The keys by the first 64 bits of their digests, which nobody can choose.
#[derive(Default)]
struct Keys {
    by_bucket: HashMap<u64, Vec<Arc<ActiveKey>>>,
    /// `None` before the store was read.
    version: Option<KeysVersion>,
}

impl Keys {
    fn iter(&self) -> impl Iterator<Item = &Arc<ActiveKey>> {
        self.by_bucket.values().flatten()
    }
}

/// The keys of the store, replaced as a whole when one changes. Instants are readings of the monotonic clock.
#[derive(Default)]
pub(super) struct KeyTable {
    keys: ArcSwap<Keys>,
    /// How long they count after they were last known to be those of the store; without end if it is not set.
    lease: OnceLock<Duration>,
    /// When that was.
    confirmed_at_ns: AtomicU64,
    /// When the store was last asked for a key that is not in the table.
    looked_at_ns: AtomicU64,
    /// How often what was read had to be forgotten.
    distrusted: AtomicU64,
    /// Held from reading the store to replacing the table.
    change: Mutex<()>,
}

impl KeyTable {
    /// True if no key was ever created; `false` before the store was read.
    pub(super) fn is_empty(&self) -> bool {
        self.keys.load().version.as_ref().is_some_and(KeysVersion::is_empty)
    }

    /// Lets the keys count for that time only after each time that they were known to be those of the store.
    pub(super) fn set_lease(&self, lease: Duration) {
        self.lease.get_or_init(|| lease);
    }

    /// Notes that a look at the store which began at that instant found this version; `false` if it is another one than
    /// that of these keys, and then nothing is noted.
    pub(super) fn confirm(&self, version: &KeysVersion, began_at: Duration) -> bool {
        let is_known = self.keys.load().version.as_ref() == Some(version);
        if is_known {
            self.confirmed_at_ns.fetch_max(as_ns(began_at), Ordering::AcqRel);
        }
        is_known
    }

    /// Checks that another process can have revoked no key, nor created the first, for longer than the lease.
    ///
    /// # Errors
    /// `Overloaded`.
    pub(super) fn check_confirmed(&self, at: Duration) -> Result<()> {
        let age = as_ns(at).saturating_sub(self.confirmed_at_ns.load(Ordering::Acquire));
        let is_recent = self.lease.get().is_none_or(|lease| age < as_ns(*lease));
        if is_recent && self.keys.load().version.is_some() {
            return Ok(());
        }
        let message =
            "the database cannot be reached, so it is not known which keys work; try again, or another node";
        Err(Error::refused(ErrorKind::Overloaded, message))
    }

    /// The key with a digest, which is used now.
    ///
    /// # Errors
    /// `Unauthenticated`.
    pub(super) fn use_key(&self, digest: &SecretDigest, now: Timestamp) -> Result<Arc<ActiveKey>> {
        let keys = self.keys.load();
        let bucket = keys.by_bucket.get(&digest.bucket()).map_or(&[][..], Vec::as_slice);
        let key = bucket.iter().find(|key| key.digest == *digest && key.use_at(now));
        key.cloned().ok_or_else(does_not_work)
    }

    /// True if a key of that digest is in the table.
    pub(super) fn has(&self, digest: &SecretDigest) -> bool {
        let keys = self.keys.load();
        keys.by_bucket.get(&digest.bucket()).is_some_and(|keys| keys.iter().any(|key| key.digest == *digest))
    }

    /// True if enough time has passed since the latest call to read the store again.
    pub(super) fn may_look(&self, at: Duration) -> bool {
        let (at_ns, pause_ns) = (as_ns(at), as_ns(LOOK_PAUSE));
        let looks =
            |latest_ns: u64| (at_ns >= latest_ns + pause_ns || latest_ns == 0).then_some(at_ns.max(1));
        self.looked_at_ns.fetch_update(Ordering::AcqRel, Ordering::Acquire, looks).is_ok()
    }

    /// Lets nobody in until the keys were read again, whatever version they have.
    pub(super) fn distrust(&self) {
        self.distrusted.fetch_add(1, Ordering::AcqRel);
        self.forget_version();
    }

    fn forget_version(&self) {
        self.keys.rcu(|keys| Keys { by_bucket: keys.by_bucket.clone(), version: None });
    }

    /// Reads the keys if they have changed; `began_at` is an instant before the call.
    pub(super) async fn refresh(&self, store: &Store, now: Timestamp, began_at: Duration) -> Result<()> {
        let _change = self.change.lock().await;
        let distrusted = self.distrusted.load(Ordering::Acquire);
        let known = self.keys.load_full();
        let version = store.keys_version().await?;
        // Requests and streams of an expired key have ended; if the clock was wrong, the key works again.
        let has_returned = known.iter().any(|key| key.has_ended() && key.key.is_valid_at(now));
        if has_returned || known.version.as_ref() != Some(&version) {
            let is_first = known.version.as_ref().is_some_and(KeysVersion::is_empty) && !version.is_empty();
            self.replace(&known, store.unrevoked_keys().await?, version.clone());
            if is_first {
                tracing::info!("a key was created: from now on every request needs one");
            }
        }
        if self.distrusted.load(Ordering::Acquire) != distrusted {
            // They were read before that, perhaps from another history.
            self.forget_version();
        }
        self.confirm(&version, began_at);
        // Open streams of a key that has expired end here; new requests look at the time themselves.
        self.keys.load().iter().filter(|key| !key.key.is_valid_at(now)).for_each(|key| key.end());
        Ok(())
    }

    fn replace(&self, known: &Keys, stored: Vec<(ApiKey, SecretDigest)>, version: KeysVersion) {
        let by_id: HashMap<KeyId, &Arc<ActiveKey>> = known.iter().map(|key| (key.key.id, key)).collect();
        let mut by_bucket: HashMap<u64, Vec<Arc<ActiveKey>>> = HashMap::new();
        let mut kept = HashSet::new();
        for (key, digest) in stored {
            kept.insert(key.id);
            // Requests and streams of a key hold the same value, and end with it.
            let known = by_id.get(&key.id).filter(|known| !known.has_ended());
            let active = known.map_or_else(|| ActiveKey::new(key, digest), |&it| it.clone());
            by_bucket.entry(digest.bucket()).or_default().push(active);
        }
        self.keys.store(Arc::new(Keys { by_bucket, version: Some(version) }));
        known.iter().filter(|key| !kept.contains(&key.key.id)).for_each(|key| key.end());
    }

    /// The keys that were used since the last call, with the time of their latest use.
    pub(super) fn take_unstored_uses(&self) -> Vec<(KeyId, Timestamp)> {
        let keys = self.keys.load();
        let unstored = |key: &&Arc<ActiveKey>| {
            let used_us = key.last_used_us.load(Ordering::Relaxed);
            key.stored_use_us.swap(used_us, Ordering::Relaxed) != used_us
        };
        keys.iter().filter(unstored).filter_map(|key| Some((key.key.id, last_use(key)?))).collect()
    }

    pub(super) fn last_use(&self, id: KeyId) -> Option<Timestamp> {
        last_use(self.keys.load().iter().find(|key| key.key.id == id)?)
    }
}

fn as_ns(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

fn last_use(key: &ActiveKey) -> Option<Timestamp> {
    let used_us = key.last_used_us.load(Ordering::Relaxed);
    Timestamp::from_microsecond(used_us).ok().filter(|_| used_us != 0)
}
