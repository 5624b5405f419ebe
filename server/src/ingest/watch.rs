//! Stopping, and noticing that nothing happens any more.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Shared by all of ingest's threads and by FFmpeg's interrupt callback.
#[derive(Clone)]
pub(super) struct Watch(Arc<Inner>);

struct Inner {
    stopped: AtomicBool,
    guard: Mutex<()>,
    wake: Condvar,
    epoch: Instant,
    /// Microseconds after `epoch`; zero for none.
    deadline_us: AtomicU64,
    /// A call was given up since the source was opened.
    timed_out: AtomicBool,
}

impl Watch {
    pub(super) fn new() -> Self {
        Self(Arc::new(Inner {
            stopped: AtomicBool::new(false),
            guard: Mutex::new(()),
            wake: Condvar::new(),
            epoch: Instant::now(),
            deadline_us: AtomicU64::new(0),
            timed_out: AtomicBool::new(false),
        }))
    }

    pub(super) fn stop(&self) {
        let _guard = self.0.guard.lock().unwrap_or_else(PoisonError::into_inner);
        self.0.stopped.store(true, Ordering::Release);
        self.0.wake.notify_all();
    }

    pub(super) fn stopped(&self) -> bool {
        self.0.stopped.load(Ordering::Acquire)
    }

    /// From now on a blocking call into FFmpeg is given up after `patience`.
    pub(super) fn allow(&self, patience: Duration) {
        let deadline = self.0.epoch.elapsed().saturating_add(patience).as_micros();
        self.0.deadline_us.store(u64::try_from(deadline).unwrap_or(u64::MAX), Ordering::Release);
    }

    /// As [`Watch::allow`], for a source that is opened now: what was given up before is forgotten.
    pub(super) fn begin(&self, patience: Duration) {
        self.0.timed_out.store(false, Ordering::Release);
        self.allow(patience);
    }

    /// Whether a call was given up since the source was opened. It tells why a source ended better than FFmpeg's error does, which differs
    /// between protocols and may come calls later: what demuxers hold back, they hand on first.
    pub(super) fn timed_out(&self) -> bool {
        self.0.timed_out.load(Ordering::Acquire)
    }

    /// What FFmpeg's interrupt callback answers.
    pub(super) fn interrupts(&self) -> bool {
        let deadline = self.0.deadline_us.load(Ordering::Acquire);
        if deadline != 0 && self.0.epoch.elapsed().as_micros() > u128::from(deadline) {
            self.0.timed_out.store(true, Ordering::Release);
            return true;
        }
        self.stopped()
    }

    /// Sleeps until `until` or until stopped; true if stopped.
    pub(super) fn sleep_until(&self, until: Instant) -> bool {
        let mut guard = self.0.guard.lock().unwrap_or_else(PoisonError::into_inner);
        while !self.stopped() {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            guard = self.0.wake.wait_timeout(guard, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        true
    }
}
