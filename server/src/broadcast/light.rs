//! The light track: one group for every video frame.

use mr360_protocol::codec::WireError;
use mr360_protocol::light::LightFrame;

/// Publishes light.
pub struct LightTrack {
    track: moq_net::track::Producer,
}

/// Why a frame's light was not published.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PublishError {
    /// The estimate holds what no viewer would accept.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// The track is closed.
    #[error("light track")]
    Track(#[from] moq_net::Error),
    /// The time does not fit the wire.
    #[error("light track: pts {0} µs is past the wire's range")]
    Time(u64),
}

impl LightTrack {
    pub(super) fn new(track: moq_net::track::Producer) -> Self {
        Self { track }
    }

    /// Publishes one frame and returns its size in bytes.
    ///
    /// # Errors
    /// [`PublishError`]; the next frame may succeed.
    pub fn publish(&mut self, frame: &LightFrame) -> Result<usize, PublishError> {
        let wire = frame.to_wire()?;
        let size = wire.len();
        let timestamp = moq_net::Timestamp::from_micros(frame.pts_us).map_err(|_| PublishError::Time(frame.pts_us))?;
        self.track.write_frame(timestamp, wire)?;
        Ok(size)
    }
}
