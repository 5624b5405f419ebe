//! The data path behind ingest: coded frames to the broadcast, decoded frames to the light.

use std::sync::{Mutex, PoisonError};

use mr360_protocol::clock::ServerTime;
use mr360_protocol::light::{Lift, LightFrame};

use crate::broadcast::{LightTrack, MediaError, MediaTracks};
use crate::frame::Frame;
use crate::ingest::{IngestEvent, ServerClock, Sink};
use crate::lighting::{LightMethod, StepTimes};
use crate::stats::{LightRow, Stats};

/// Takes ingest's events. Media and light are locked apart: light is computed on ingest's own decoding thread
/// and holds up no packet.
pub(super) struct DataPath {
    media: Mutex<MediaTracks>,
    light: Mutex<Light>,
    stats: Stats,
    clock: ServerClock,
}

struct Light {
    track: LightTrack,
    method: Box<dyn LightMethod>,
    steps: StepTimes,
    /// The frame on its way to the wire; its vectors are used again.
    frame: LightFrame,
    /// The last frame's light was above the wire's range.
    held: bool,
}

impl DataPath {
    pub(super) fn new(media: MediaTracks, track: LightTrack, method: Box<dyn LightMethod>, stats: Stats, clock: ServerClock) -> Self {
        let frame = LightFrame { pts_us: 0, published_us: 0, lift: Lift::default(), sh: Vec::new(), lights: Vec::new() };
        let light = Light { track, method, steps: StepTimes::default(), frame, held: false };
        Self { media: Mutex::new(media), light: Mutex::new(light), stats, clock }
    }

    fn media(&self, name: &str, publish: impl FnOnce(&mut MediaTracks) -> Result<(), MediaError>) -> bool {
        let result = publish(&mut self.media.lock().unwrap_or_else(PoisonError::into_inner));
        if let Err(error) = &result {
            tracing::warn!(%error, "{name} not published");
            self.stats.media_error();
        }
        result.is_ok()
    }

    fn light(&self, frame: &Frame, decoded: ServerTime) -> anyhow::Result<()> {
        let Light { track, method, steps, frame: light, held } = &mut *self.light.lock().unwrap_or_else(PoisonError::into_inner);
        let begun = self.clock.now();
        steps.clear();
        let estimate = method.estimate(frame, steps)?;
        let published = self.clock.now();
        (light.pts_us, light.published_us, light.lift) = (frame.pts_us, published.0, estimate.lift);
        light.sh.clone_from(&estimate.sh);
        light.lights.clone_from(&estimate.lights);
        let over = light.hold_to_range();
        // Once for as long as it lasts: a source of this kind is so on every frame.
        if over > 0 && !*held {
            tracing::warn!(pts_us = frame.pts_us, over, "light above the wire's range is held to it; give radiance over display white");
        }
        *held = over > 0;
        let bytes = track.publish(light)?;
        self.stats.light(&LightRow { pts_us: frame.pts_us, decoded, begun, published, steps, lights: light.lights.len(), bytes });
        Ok(())
    }
}

impl Sink for DataPath {
    fn event(&self, event: IngestEvent) {
        match event {
            IngestEvent::Started(video, audio) => {
                tracing::info!(?video, ?audio, "on air");
                self.media("format", |media| media.start(&video, audio.as_ref()));
            }
            IngestEvent::Video(unit) => {
                if self.media("video", |media| media.video(&unit)) {
                    self.stats.video(unit.pts_us, unit.ingested, self.clock.now(), unit.data.len());
                }
            }
            IngestEvent::Audio(packet) => {
                if self.media("audio", |media| media.audio(&packet)) {
                    self.stats.audio(packet.data.len());
                }
            }
            IngestEvent::Frame(frame, decoded) => {
                if let Err(error) = self.light(&frame, decoded) {
                    tracing::warn!(pts_us = frame.pts_us, %error, "frame without light");
                    self.stats.light_error();
                }
            }
            IngestEvent::Interrupted { reason, retry_in } => {
                tracing::warn!(reason, ?retry_in, "source lost; trying again");
            }
        }
    }
}
