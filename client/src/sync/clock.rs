//! The client's clock.

use std::time::{Duration, Instant};

use mr360_protocol::clock::ClientTime;

/// Reads [`ClientTime`]; copies of it agree.
#[derive(Debug, Clone, Copy)]
pub struct ClientClock(Instant);

impl ClientClock {
    /// Starts at zero.
    #[must_use]
    pub fn start() -> Self {
        Self(Instant::now())
    }

    /// Microseconds since the start.
    #[must_use]
    pub fn now(&self) -> ClientTime {
        ClientTime(u64::try_from(self.0.elapsed().as_micros()).unwrap_or(u64::MAX))
    }

    /// The instant at which this clock reads `time`.
    #[must_use]
    pub fn instant(&self, time: ClientTime) -> Instant {
        self.0.checked_add(Duration::from_micros(time.0)).unwrap_or(self.0)
    }
}
