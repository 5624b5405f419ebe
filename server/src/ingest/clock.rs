//! The server's clock.

use std::time::Instant;

use mr360_protocol::clock::ServerTime;

/// Monotonic clock that starts with the broadcast; copies agree with each other.
#[derive(Debug, Clone, Copy)]
pub struct ServerClock {
    start: Instant,
}

impl ServerClock {
    /// A clock that reads zero now.
    #[must_use]
    pub fn start() -> Self {
        Self { start: Instant::now() }
    }

    /// Microseconds since the start.
    #[must_use]
    pub fn now(&self) -> ServerTime {
        ServerTime(u64::try_from(self.start.elapsed().as_micros()).unwrap_or(u64::MAX))
    }
}
