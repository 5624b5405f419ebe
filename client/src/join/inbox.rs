//! Takes what the network brings to where it belongs: decoder, playout, sound, scene.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use mr360_protocol::transport::{DialError, LinkEvent};
use tokio::sync::mpsc;

use super::live_stage::SharedScene;
use crate::audio::{AudioFormat, AudioPlayer, AudioTimeline};
use crate::decode::VideoDecoder;
use crate::frame_loop::Arrival;
use crate::receive::{Event, ReceiveError};
use crate::sync::{ClientClock, ReceivedLight};

/// The far ends of the data path's first half.
pub(super) struct Inbox {
    decoder: VideoDecoder,
    arrivals: Sender<Arrival>,
    scene: SharedScene,
    /// Where sound is played by; `None` for silence.
    timeline: Option<AudioTimeline>,
    player: Option<AudioPlayer>,
    clock: ClientClock,
    started: Instant,
    first_unit: bool,
    names: Names,
}

/// Track names, shared with every row of the statistics.
struct Names {
    video: Arc<str>,
    light: Arc<str>,
    audio: Arc<str>,
    asset: Arc<str>,
}

impl Inbox {
    pub(super) fn new(
        decoder: VideoDecoder,
        arrivals: Sender<Arrival>,
        scene: SharedScene,
        timeline: Option<AudioTimeline>,
        clock: ClientClock,
    ) -> Self {
        let names = Names { video: "video".into(), light: "light".into(), audio: "audio".into(), asset: "asset".into() };
        Self { decoder, arrivals, scene, timeline, player: None, clock, started: Instant::now(), first_unit: true, names }
    }

    /// Runs on a thread of its own until the network ends. Then the decoder is let go, and the frame loop ends
    /// once it has shown what it has; `end` says why.
    pub(super) fn spawn(
        mut self,
        mut events: mpsc::Receiver<Event>,
        end: Arc<Mutex<Option<anyhow::Error>>>,
        stop: Arc<AtomicBool>,
    ) -> std::io::Result<()> {
        std::thread::Builder::new().name("inbox".to_owned()).spawn(move || {
            while let Some(event) = events.blocking_recv() {
                if let Err(error) = self.take(event) {
                    *end.lock().unwrap_or_else(PoisonError::into_inner) = Some(error.into());
                    stop.store(true, Ordering::Relaxed);
                    break;
                }
            }
        })?;
        Ok(())
    }

    fn take(&mut self, event: Event) -> Result<(), ReceiveError> {
        match event {
            Event::Link(LinkEvent::Up(version)) => tracing::info!(version, "connected"),
            Event::Link(LinkEvent::Down { fault: fault @ DialError::HostEnded { .. }, .. }) => {
                tracing::warn!("{fault}; waiting for it to come back");
            }
            Event::Link(LinkEvent::Down { fault, retry_in }) => tracing::warn!(%fault, ?retry_in, "connection lost; trying again"),
            Event::Link(LinkEvent::Failed { fault, retry_in }) => tracing::warn!(%fault, ?retry_in, "not connected; trying again"),
            Event::Joined => {
                tracing::info!("joined the room");
                self.arrive(Arrival::NewBroadcast);
            }
            Event::AwaitingSource => tracing::info!("the room is open; its source has not come yet"),
            Event::Video(format) => {
                tracing::info!(?format, "video");
                if let Err(error) = self.decoder.set_format(format) {
                    tracing::error!("{error}");
                }
            }
            Event::Unit(unit) => {
                if std::mem::take(&mut self.first_unit) {
                    tracing::info!("first frame received after {} ms", self.started.elapsed().as_millis());
                }
                self.count(&self.names.video, unit.data.len());
                if let Err(error) = self.decoder.push(unit) {
                    tracing::debug!(%error, "access unit refused");
                }
            }
            Event::Audio(format) => self.open_sound(format.as_ref()),
            Event::AudioPacket { pts_us, data } => {
                self.count(&self.names.audio, data.len());
                if let Some(player) = &mut self.player {
                    player.push(pts_us, &data);
                }
            }
            Event::Light { frame, bytes, arrived } => {
                self.count(&self.names.light, bytes);
                self.arrive(Arrival::Light(ReceivedLight { light: frame, arrived }));
            }
            Event::Scene(message) => {
                if let Err(error) = self.scene.apply(&message) {
                    tracing::warn!("{error}");
                }
            }
            Event::Asset(id, bytes) => {
                self.count(&self.names.asset, bytes.len());
                self.scene.add_asset(id, &bytes);
            }
            Event::AssetFailed(id, error) => tracing::warn!(%id, "{error}; objects of this model are left out"),
            Event::Refused(fault) => tracing::warn!("{fault}"),
            Event::Ended(error) => return Err(error),
        }
        Ok(())
    }

    fn open_sound(&mut self, format: Option<&AudioFormat>) {
        self.player = None;
        let (Some(format), Some(timeline)) = (format, &self.timeline) else { return };
        match AudioPlayer::start(format, self.clock, timeline) {
            Ok(player) => self.player = Some(player),
            Err(error) => tracing::warn!("{error}; the session goes on silently"),
        }
    }

    fn count(&self, track: &Arc<str>, bytes: usize) {
        self.arrive(Arrival::Bytes(Arc::clone(track), bytes));
    }

    fn arrive(&self, arrival: Arrival) {
        // A frame loop that has ended takes nothing more; the whole client is about to.
        let _ = self.arrivals.send(arrival);
    }
}
