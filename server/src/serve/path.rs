//! The data path behind ingest: coded frames to the broadcast, decoded frames to the light.

use std::sync::{Mutex, PoisonError};

use anyhow::anyhow;
use mr360_protocol::clock::ServerTime;
use mr360_protocol::light::{Lift, LightFrame};

use tokio::sync::oneshot;

use crate::broadcast::{LightTrack, MediaError, MediaTracks};
use crate::frame::Frame;
use crate::ingest::{AudioInfo, IngestEvent, ServerClock, Sink, VideoInfo};
use crate::lighting::{LightMethod, StepTimes};
use crate::stats::{LightRow, Stats};

/// Takes ingest's events. Media and light are locked apart: light is computed on ingest's own decoding thread
/// and holds up no packet.
pub(super) struct DataPath {
    media: Mutex<MediaTracks>,
    light: Mutex<Light>,
    stats: Stats,
    clock: ServerClock,
    /// Takes why the first format could not be put on air; none once that has been tried.
    first_start: Mutex<Option<oneshot::Sender<anyhow::Error>>>,
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
    /// The second value hears why the first format could not be put on air: nobody can watch then, so the run is to end. A format that fails
    /// later is logged and counted, as the next may be fine again.
    pub(super) fn new(
        media: MediaTracks,
        track: LightTrack,
        method: Box<dyn LightMethod>,
        stats: Stats,
        clock: ServerClock,
    ) -> (Self, oneshot::Receiver<anyhow::Error>) {
        let frame = LightFrame { pts_us: 0, published_us: 0, lift: Lift::default(), sh: Vec::new(), lights: Vec::new() };
        let light = Light { track, method, steps: StepTimes::default(), frame, held: false };
        let (fault, failed) = oneshot::channel();
        let path = Self { media: Mutex::new(media), light: Mutex::new(light), stats, clock, first_start: Mutex::new(Some(fault)) };
        (path, failed)
    }

    fn start(&self, video: &VideoInfo, audio: Option<&AudioInfo>) {
        let first = self.first_start.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Err(error) = self.media.lock().unwrap_or_else(PoisonError::into_inner).start(video, audio) else {
            tracing::info!(?video, ?audio, "on air");
            return;
        };
        self.stats.media_error();
        match first {
            Some(first) => {
                let sound = audio.map_or("no".to_owned(), |audio| format!("{:?}", audio.codec));
                let fault = anyhow!(
                    "{:?} of {}×{} with {sound} sound cannot be broadcast ({error}); send H.264 with AAC or Opus",
                    video.codec,
                    video.width,
                    video.height
                );
                // Nobody listens where the run is over already.
                let _ = first.send(fault);
            }
            None => tracing::warn!(%error, ?video, ?audio, "format not published; nothing is on air until the next"),
        }
    }

    fn media(&self, name: &str, publish: impl FnOnce(&mut MediaTracks) -> Result<(), MediaError>) -> bool {
        let result = publish(&mut self.media.lock().unwrap_or_else(PoisonError::into_inner));
        match &result {
            // Told when the format failed.
            Err(MediaError::NoTrack(_)) => self.stats.media_error(),
            Err(error) => {
                tracing::warn!(%error, "{name} not published");
                self.stats.media_error();
            }
            Ok(()) => {}
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
            IngestEvent::Started(video, audio) => self.start(&video, audio.as_ref()),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::broadcast::Broadcast;
    use crate::ingest::AudioCodec;
    use crate::lighting::MethodSpec;
    use bytes::Bytes;
    use mr360_protocol::transport;

    /// Formats on air; an AudioSpecificConfig of one byte is too short to be understood.
    fn started(understood: bool) -> IngestEvent {
        let video = VideoInfo::small();
        let description = Bytes::from_static(if understood { &[0x11, 0x90] } else { &[0] });
        IngestEvent::Started(video, Some(AudioInfo { codec: AudioCodec::Aac, sample_rate: 48_000, channels: 2, description }))
    }

    fn path(broadcast: &Broadcast) -> (DataPath, oneshot::Receiver<anyhow::Error>) {
        let method = MethodSpec::default().make();
        DataPath::new(broadcast.media(), broadcast.light().unwrap(), method, Stats::new(None).unwrap(), ServerClock::start())
    }

    #[tokio::test]
    async fn a_first_format_that_fails_ends_the_run_and_a_later_one_does_not() {
        let origin = transport::origin();
        let broadcast = Broadcast::create(&origin, "first", "none").unwrap();
        let (path, failed) = path(&broadcast);
        path.event(started(false));
        let error = failed.await.unwrap().to_string();
        assert!(error.contains("H264 of 256×128 with Aac sound") && error.contains("send H.264"), "{error}");

        let broadcast = Broadcast::create(&origin, "later", "none").unwrap();
        let (path, failed) = self::path(&broadcast);
        path.event(started(true));
        path.event(started(false));
        assert!(failed.await.is_err(), "nothing more will come");
    }
}
