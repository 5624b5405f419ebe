//! The frame loop that every mode runs: take in what arrived, hand the newest due pair to the stage, draw, present.
//!
//! Nothing in here waits for network, decoder or GPU; a [`Presenter`] decides what presenting means.

mod presenter;
mod stage;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError};
use std::time::Duration;

use mr360_protocol::clock::{ClientTime, ClockOffset, ServerTime};

use crate::audio::AudioTimeline;
use crate::camera::Camera;
use crate::decode::{DecodeCounters, PictureReceiver};
use crate::script::Player;
use crate::stats::{FrameTimes, LightTimes, Stats};
use crate::sync::{ClientClock, LightBlend, Playout, ReceivedLight};

pub use presenter::{HeadsetTimes, PictureTime, Presented, Presenter, Shot, Target};
pub use stage::{Drawn, Stage};

/// Longest rest between two looks at what arrived: well within the least playout delay of 20 ms.
const IDLE: Duration = Duration::from_millis(4);
/// Messages of the network taken in one turn, so that a flood cannot hold up the display.
const MESSAGES_A_TURN: usize = 512;

/// An error of a stage or a presenter, whatever its type.
pub type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// Why a frame could not be drawn or presented.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FrameError {
    /// Everything on the GPU is gone; it has to be opened anew.
    #[error("the GPU device was lost ({detail})")]
    DeviceLost {
        /// What the driver said.
        detail: String,
    },
    /// Anything else.
    #[error("{action} failed")]
    Failed {
        /// What was tried.
        action: &'static str,
        /// The reason.
        source: BoxError,
    },
}

/// From the network, apart from pictures.
#[derive(Debug)]
pub enum Arrival {
    /// Light of a frame.
    Light(ReceivedLight),
    /// Bytes of a frame of a track, for the statistics.
    Bytes(Arc<str>, usize),
    /// A new broadcast begins: what waits belongs to the old one.
    NewBroadcast,
}

/// Where pictures and lights come from.
pub struct Inputs {
    /// From the decoder.
    pub pictures: PictureReceiver,
    /// From the network.
    pub arrivals: Receiver<Arrival>,
    /// The decoder's counts.
    pub decoder: Arc<DecodeCounters>,
    /// The sound that follows the pictures.
    pub audio: Option<AudioTimeline>,
}

/// When to draw.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Redraw {
    /// For every new picture.
    OnPicture,
    /// When the picture, the scene or the camera changed: a frame that would look the same is not drawn again.
    OnChange,
    /// Every time.
    Always,
}

/// What a turn did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Turn {
    /// A frame was presented.
    pub presented: bool,
    /// Nothing more will come: the decoder is gone and the playout is empty.
    pub ended: bool,
}

/// Times of the picture on the GPU.
struct OnStage {
    time: PictureTime,
    arrived: ClientTime,
    decoded: ClientTime,
    light: Option<LightTimes>,
    blend: Option<LightBlend>,
    paired: ClientTime,
    uploaded: ClientTime,
    presented_once: bool,
}

/// The loop's state between turns; outlives a lost GPU device.
pub struct FrameLoop {
    inputs: Inputs,
    clock: ClientClock,
    playout: Playout,
    server_clock: ClockOffset,
    stats: Stats,
    on_stage: Option<OnStage>,
    /// What is on stage has changed since it was drawn.
    stale: bool,
    last_camera: Option<Camera>,
    /// How long the last frame took to draw and present, microseconds.
    drawing_us: u64,
    frames: u64,
    ended: bool,
    /// Does what a user did once.
    player: Option<Player>,
}

impl FrameLoop {
    /// A loop that has shown nothing.
    #[must_use]
    pub fn new(inputs: Inputs, clock: ClientClock, stats: Stats) -> Self {
        let playout = Playout::new();
        Self {
            inputs,
            clock,
            playout,
            server_clock: ClockOffset::default(),
            stats,
            on_stage: None,
            stale: false,
            last_camera: None,
            drawing_us: 0,
            frames: 0,
            ended: false,
            player: None,
        }
    }

    /// Plays a script from when there are a picture and a scene.
    pub fn play(&mut self, player: Player) {
        self.player = Some(player);
    }

    /// One turn of the loop.
    ///
    /// # Errors
    /// Those of the stage and of the presenter. After [`FrameError::DeviceLost`] call [`FrameLoop::device_lost`], open both anew and
    /// go on.
    pub fn turn<S: Stage>(
        &mut self,
        stage: &mut S,
        presenter: &mut impl Presenter,
        camera: &Camera,
        redraw: Redraw,
    ) -> Result<Turn, FrameError> {
        if let Some(detail) = stage.device_lost() {
            return Err(FrameError::DeviceLost { detail });
        }
        self.take_in();
        if let Some(player) = self.player.as_mut().filter(|_| self.on_stage.is_some() && stage.has_scene()) {
            player.play(stage, self.clock.now());
        }
        self.stale |= stage.prepare()?;
        let new_picture = self.update(stage)?;
        // A new picture comes on under its own light, whatever its upload took.
        if !new_picture {
            self.relight(stage, redraw);
        }
        let wanted = match redraw {
            Redraw::OnPicture => new_picture || self.on_stage.as_ref().is_some_and(|on_stage| !on_stage.presented_once),
            Redraw::OnChange => self.stale || self.last_camera != Some(*camera),
            Redraw::Always => true,
        };
        let presented = wanted && self.on_stage.is_some() && self.show(stage, presenter, camera)?;
        if new_picture && wanted && !presented {
            self.stats.skipped();
        }
        Ok(Turn { presented, ended: self.has_ended() })
    }

    /// A turn in which nothing can be shown: takes in what arrived and lets due pictures pass unseen, so that what comes after it is shown in
    /// time.
    pub fn pass(&mut self) -> Turn {
        self.take_in();
        if self.playout.poll(self.clock.now()).is_some() {
            self.stats.unseen();
        }
        self.follow_with_sound();
        Turn { presented: false, ended: self.has_ended() }
    }

    /// Forgets what was on the GPU; the playout goes on.
    pub fn device_lost(&mut self) {
        self.on_stage = None;
        self.last_camera = None;
    }

    /// Asks for a frame even when nothing has changed, as after a resize.
    pub fn redraw(&mut self) {
        self.stale = true;
    }

    /// When the next turn has something to do, at the latest.
    #[must_use]
    pub fn next_turn(&self) -> ClientTime {
        let now = self.clock.now();
        let idle = ClientTime(now.0 + IDLE.as_micros() as u64);
        self.playout.next_deadline(now).map_or(idle, |deadline| deadline.clamp(now, idle))
    }

    /// Rests until the next turn has something to do, at most until `until`.
    pub fn rest(&mut self, until: Option<ClientTime>) {
        let next = self.next_turn();
        let next = until.map_or(next, |until| next.min(until));
        let rest = Duration::from_micros(next.0.saturating_sub(self.clock.now().0));
        if rest.is_zero() {
            return;
        }
        if !self.playout.has_room() || self.ended {
            std::thread::sleep(rest);
            return;
        }
        match self.inputs.pictures.recv_timeout(rest) {
            Ok(decoded) => self.playout.push_picture(decoded, self.clock.now()),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => self.ended = true,
        }
    }

    /// The clock of all times in here.
    #[must_use]
    pub fn clock(&self) -> ClientClock {
        self.clock
    }

    /// Presented frames so far.
    #[must_use]
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// The statistics, for the summary at the end.
    #[must_use]
    pub fn into_stats(mut self) -> Stats {
        self.stats.counted(self.playout.drops(), Some(&self.inputs.decoder));
        self.stats
    }

    fn take_in(&mut self) {
        for _ in 0..MESSAGES_A_TURN {
            match self.inputs.arrivals.try_recv() {
                Ok(Arrival::Light(light)) => {
                    self.server_clock.observe(ServerTime(light.light.published_us), light.arrived);
                    self.playout.push_light(light);
                }
                Ok(Arrival::Bytes(track, bytes)) => self.stats.received(&track, bytes),
                Ok(Arrival::NewBroadcast) => {
                    self.server_clock = ClockOffset::default();
                    self.playout.reset();
                }
                Err(_) => break,
            }
        }
        while self.playout.has_room() {
            match self.inputs.pictures.try_recv() {
                Ok(decoded) => self.playout.push_picture(decoded, self.clock.now()),
                Err(TryRecvError::Empty) => return,
                Err(TryRecvError::Disconnected) => {
                    self.ended = true;
                    return;
                }
            }
        }
    }

    fn has_ended(&self) -> bool {
        self.ended && self.playout.next_deadline(self.clock.now()).is_none()
    }

    fn follow_with_sound(&self) {
        if let Some(audio) = &self.inputs.audio {
            audio.set(self.playout.presentation_offset_us());
        }
    }

    fn light_times(&self, light: &ReceivedLight) -> Option<LightTimes> {
        let published = self.server_clock.client_from_server(ServerTime(light.light.published_us), light.arrived)?;
        Some(LightTimes { pts_us: light.light.pts_us, published, arrived: light.arrived })
    }

    fn update(&mut self, stage: &mut impl Stage) -> Result<bool, FrameError> {
        let now = self.clock.now();
        let paired = self.playout.poll(now);
        self.follow_with_sound();
        let Some(paired) = paired else { return Ok(false) };
        let mut on_stage = OnStage {
            time: PictureTime { epoch: self.playout.epoch(), pts_us: paired.picture.pts_us },
            arrived: paired.arrived,
            decoded: paired.decoded,
            light: paired.light.as_ref().and_then(|light| self.light_times(light)),
            blend: paired.light.as_ref().map(|light| LightBlend::new(light.light.clone(), now)),
            paired: paired.paired,
            uploaded: paired.paired,
            presented_once: false,
        };
        stage.update(paired)?;
        on_stage.uploaded = self.clock.now();
        self.on_stage = Some(on_stage);
        self.stale = true;
        Ok(true)
    }

    /// Moves the light on between two pictures.
    fn relight(&mut self, stage: &mut impl Stage, redraw: Redraw) {
        // A picture that is drawn once is drawn under its own light.
        if redraw == Redraw::OnPicture {
            return;
        }
        let now = self.clock.now();
        let Some(blend) = self.on_stage.as_mut().and_then(|on_stage| on_stage.blend.as_mut()) else { return };
        let Some(light) = blend.advance(now, self.playout.upcoming_light()) else { return };
        let differs = stage.relight(light);
        // Where drawing is slow, a frame for the light alone would hold up the next picture.
        let fast = blend.interval_us().is_some_and(|interval| 2 * self.drawing_us <= interval);
        self.stale |= differs && fast;
    }

    fn show(&mut self, stage: &mut impl Stage, presenter: &mut impl Presenter, camera: &Camera) -> Result<bool, FrameError> {
        let Some(on_stage) = self.on_stage.as_mut() else { return Ok(false) };
        let Some(shots) = presenter.acquire(camera)? else { return Ok(false) };
        let begun = self.clock.now();
        let drawn = stage.draw(&shots)?;
        let rendered = self.clock.now();
        let shown = presenter.present(on_stage.time, rendered)?;
        // What a lost device drew is nothing to count.
        if let Some(detail) = stage.device_lost() {
            return Err(FrameError::DeviceLost { detail });
        }
        let presented = self.clock.now();
        self.drawing_us = presented.0.saturating_sub(begun.0);
        let times = FrameTimes {
            frame: self.frames,
            pts_us: on_stage.time.pts_us,
            new_picture: !on_stage.presented_once,
            arrived: on_stage.arrived,
            decoded: on_stage.decoded,
            light: on_stage.light,
            light_weight: on_stage.blend.as_ref().map_or(0.0, LightBlend::weight),
            paired: on_stage.paired,
            uploaded: on_stage.uploaded,
            begun,
            rendered,
            presented,
            playout_delay_us: self.playout.delay_us(),
            shown,
        };
        on_stage.presented_once = true;
        self.stale = false;
        self.last_camera = Some(*camera);
        if self.frames == 0 {
            tracing::info!("first picture after {} ms", times.presented.0 / 1_000);
        }
        self.frames += 1;
        self.stats.counted(self.playout.drops(), Some(&self.inputs.decoder));
        self.stats.presented(&times, &drawn);
        stage.presented(&times);
        Ok(true)
    }
}
