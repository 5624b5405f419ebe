//! Takes what the network brings to where it belongs: decoder, playout, sound, scene.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use mr360_protocol::transport::{DialError, LinkEvent};
use tokio::sync::mpsc;

use super::arrivals::Arrivals;
use super::shared_scene::SharedScene;
use super::standing::Standing;
use crate::audio::{AudioFormat, AudioPlayer, AudioTimeline};
use crate::decode::VideoDecoder;
use crate::frame_loop::Arrival;
use crate::receive::{Event, ReceiveError};
use crate::sync::{ClientClock, ReceivedLight};

/// The far ends of the data path's first half.
pub(super) struct Inbox {
    decoder: VideoDecoder,
    arrivals: Arrivals,
    scene: SharedScene,
    standing: Standing,
    /// Where sound is played by; `None` for silence.
    timeline: Option<AudioTimeline>,
    player: Option<AudioPlayer>,
    clock: ClientClock,
    names: Names,
}

/// Kinds of tracks that bytes are counted of.
#[derive(Clone, Copy)]
enum Track {
    Video,
    Light,
    Audio,
    Asset,
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
        arrivals: Arrivals,
        scene: SharedScene,
        standing: Standing,
        timeline: Option<AudioTimeline>,
        clock: ClientClock,
    ) -> Self {
        let names = Names { video: "video".into(), light: "light".into(), audio: "audio".into(), asset: "asset".into() };
        Self { decoder, arrivals, scene, standing, timeline, player: None, clock, names }
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
        self.standing.hear(&event);
        match event {
            Event::Link(LinkEvent::Up(version)) => tracing::info!(version, "connected"),
            Event::Link(LinkEvent::Down { fault: fault @ DialError::HostEnded { .. }, .. }) => {
                tracing::warn!("{fault}; waiting for it to come back");
            }
            Event::Link(LinkEvent::Down { fault, retry_in }) => tracing::warn!(%fault, ?retry_in, "connection lost; trying again"),
            Event::Link(LinkEvent::Failed { fault, retry_in }) => tracing::warn!(%fault, ?retry_in, "not connected; trying again"),
            Event::Joined => {
                tracing::info!("joined the room");
                self.scene.new_broadcast();
                self.arrivals.send(Arrival::NewBroadcast);
            }
            Event::AwaitingSource => tracing::info!("the room is open; its source has not come yet"),
            Event::Video(format) => {
                tracing::info!(?format, "video");
                if let Err(error) = self.decoder.set_format(format) {
                    tracing::error!("{error}");
                    self.standing.cannot_decode(&error);
                }
            }
            Event::Unit(unit) => {
                self.count(Track::Video, unit.data.len());
                match self.decoder.push(unit) {
                    Ok(()) => self.standing.video_came(),
                    Err(error) => tracing::debug!(%error, "access unit refused"),
                }
            }
            Event::Audio(format) => self.open_sound(format.as_ref()),
            Event::AudioPacket { pts_us, data } => {
                self.count(Track::Audio, data.len());
                if let Some(player) = &mut self.player {
                    player.push(pts_us, &data);
                }
            }
            Event::Light { frame, bytes, arrived } => {
                self.count(Track::Light, bytes);
                self.arrivals.send(Arrival::Light(ReceivedLight { light: frame, arrived }));
            }
            Event::Scene(message) => {
                if let Err(error) = self.scene.apply(&message) {
                    tracing::warn!("{error}");
                }
            }
            Event::Asset { id, bytes, model } => {
                self.count(Track::Asset, bytes);
                self.scene.add_model(id, model);
            }
            Event::AssetFailed(_, error) => tracing::warn!("{error}; trying again, objects of this model are left out until it comes"),
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

    fn count(&mut self, track: Track, bytes: usize) {
        let name = match track {
            Track::Video => &self.names.video,
            Track::Light => &self.names.light,
            Track::Audio => &self.names.audio,
            Track::Asset => &self.names.asset,
        };
        self.arrivals.send(Arrival::Bytes(Arc::clone(name), bytes));
    }
}
