//! Time and randomness as values that are passed as parameters, so that tests and training runs can be
//! repeated exactly. Ages and time-outs are differences of [`Clock::monotonic`], which no correction of the
//! wall clock changes.
//!
//! This is the only module that reads the wall clock, CPU time or the operating system's randomness.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::time::{ClockId, clock_gettime};
use uuid::Uuid;

/// A source of the current time.
#[derive(Clone)]
pub struct Clock {
    wall: Arc<dyn Fn() -> Timestamp + Send + Sync>,
    monotonic: Arc<dyn Fn() -> Duration + Send + Sync>,
}

impl Clock {
    /// The operating system's clocks.
    #[must_use]
    pub fn system() -> Self {
        #[expect(clippy::disallowed_methods, reason = "the one place that reads the wall clock")]
        Self::from_fn(Timestamp::now)
    }

    /// A wall clock that the caller drives, beside the system's monotonic clock.
    pub fn from_fn(wall: impl Fn() -> Timestamp + Send + Sync + 'static) -> Self {
        let started = Instant::now();
        Self { wall: Arc::new(wall), monotonic: Arc::new(move || started.elapsed()) }
    }

    /// The same wall clock beside a monotonic clock that the caller drives.
    #[must_use]
    pub fn with_monotonic(self, monotonic: impl Fn() -> Duration + Send + Sync + 'static) -> Self {
        Self { monotonic: Arc::new(monotonic), ..self }
    }

    /// The wall clock's time now. It may jump.
    #[must_use]
    pub fn now(&self) -> Timestamp {
        (self.wall)()
    }

    /// Time since the clock was made. It never jumps and never goes back.
    #[must_use]
    pub fn monotonic(&self) -> Duration {
        (self.monotonic)()
    }
}

/// CPU time of this process, user and system, s.
#[must_use]
pub fn process_cpu_s() -> f64 {
    cpu_s(ClockId::ProcessCPUTime)
}

/// CPU time of the calling thread, user and system, s.
#[must_use]
pub fn thread_cpu_s() -> f64 {
    cpu_s(ClockId::ThreadCPUTime)
}

fn cpu_s(clock: ClockId) -> f64 {
    let time = clock_gettime(clock);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// A generator of ids and seeds.
#[derive(Clone)]
pub struct Randomness(Arc<Mutex<ChaCha8Rng>>);

impl Randomness {
    /// A cryptographic generator (ChaCha) seeded by the operating system.
    ///
    /// # Panics
    /// If the operating system has no randomness.
    #[must_use]
    pub fn system() -> Self {
        let mut seed = [0; 32];
        // Without it nothing is safe: keys must not be guessable.
        getrandom::fill(&mut seed).expect("the operating system has randomness");
        Self(Arc::new(Mutex::new(ChaCha8Rng::from_seed(seed))))
    }

    /// The same sequence for the same seed.
    #[must_use]
    pub fn seeded(seed: u64) -> Self {
        Self(Arc::new(Mutex::new(ChaCha8Rng::seed_from_u64(seed))))
    }

    /// A UUID of version 7: ordered by time, the remaining bits random.
    #[must_use]
    pub fn uuid_v7(&self, now: Timestamp) -> Uuid {
        let mut random = [0; 10];
        self.fill(&mut random);
        let millis = u64::try_from(now.as_millisecond()).unwrap_or(0);
        uuid::Builder::from_unix_timestamp_millis(millis, &random).into_uuid()
    }

    /// Fills a buffer with random bytes, good for secrets where the generator is the operating system's.
    pub fn fill(&self, bytes: &mut [u8]) {
        self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner).fill_bytes(bytes);
    }
}
