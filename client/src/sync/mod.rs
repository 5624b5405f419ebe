//! Pairs every picture with the light of exactly its pts and plays them out a little late, so that jitter does not show.
//!
//! A protocol without I/O: time is an argument. Pictures and lights are pushed as they arrive, [`Playout::poll`]
//! hands out the newest pair that is due, and [`Playout::next_deadline`] says when to ask again.

mod baseline;
mod blend;
mod clock;
mod delay;
mod lights;
mod motion;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use mr360_protocol::clock::ClientTime;
use mr360_protocol::light::LightFrame;

pub use self::blend::LightBlend;
pub use self::clock::ClientClock;
pub use self::delay::{MAX_DELAY_US, MIN_DELAY_US};
pub use self::lights::MAX_LIGHTS;
pub use self::motion::Motions;

use self::baseline::Baseline;
use self::delay::PlayoutDelay;
use self::lights::Lights;
use crate::decode::Decoded;
use crate::picture::Picture;

/// Most pictures held; decoded pictures are large (50 MB at 8192×4096). What does not fit waits compressed, before the decoder.
pub const MAX_PICTURES: usize = 12;
/// A picture that is due waits this much longer for its light, microseconds.
const LIGHT_GRACE_US: u64 = 20_000;
/// After this long without any light, pictures are shown without it, microseconds.
const LIGHT_SILENCE_US: u64 = 1_000_000;
/// A pts this far behind the newest one starts a new broadcast; reordering never reaches so far, microseconds.
const JUMP_BACK_US: u64 = 2_000_000;
/// When every picture has come later than the longest delay for this long, the source has paused and the baseline moves, microseconds.
const REANCHOR_AFTER_US: u64 = 1_000_000;

/// A LightFrame and when it arrived.
#[derive(Debug, Clone, PartialEq)]
pub struct ReceivedLight {
    /// The light.
    pub light: LightFrame,
    /// When its last byte was here.
    pub arrived: ClientTime,
}

/// A picture and the light of the same pts.
pub struct Paired {
    /// The picture.
    pub picture: Picture,
    /// Its light; `None` only while the light track is silent: objects are then to be hidden.
    pub light: Option<ReceivedLight>,
    /// When the picture's access unit arrived.
    pub arrived: ClientTime,
    /// When the picture left the decoder.
    pub decoded: ClientTime,
    /// When the pair was handed out.
    pub paired: ClientTime,
}

/// What was not shown, by reason, since the start.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub struct Drops {
    /// A newer pair was due as well: the display is slower than the video.
    pub superseded: u64,
    /// Its light did not come in time.
    pub no_light: u64,
    /// It came after a newer one had been shown.
    pub late: u64,
    /// Its pts was here already.
    pub duplicate: u64,
    /// More than [`MAX_PICTURES`] waited.
    pub overflow: u64,
    /// Lights whose picture had been shown or dropped before they came.
    pub light_late: u64,
    /// Lights that no picture came for.
    pub light_unused: u64,
}

struct Waiting {
    decoded: Decoded,
    pushed: ClientTime,
}

impl Waiting {
    fn pts_us(&self) -> u64 {
        self.decoded.picture.pts_us
    }
}

/// Pictures that keep coming later than any delay allows: when that began, and the least of their (arrival − pts).
struct LateRun {
    since: ClientTime,
    best: (u64, ClientTime),
}

/// The playout buffer.
#[derive(Default)]
pub struct Playout {
    baseline: Baseline,
    delay: PlayoutDelay,
    /// In order of pts.
    pictures: VecDeque<Waiting>,
    lights: Lights,
    newest_pts_us: Option<u64>,
    last_shown_us: Option<u64>,
    late_run: Option<LateRun>,
    /// The first picture since the last light came.
    lightless_since: Option<ClientTime>,
    silent: bool,
    epoch: u64,
    drops: Drops,
}

impl Playout {
    /// An empty buffer.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// False when the next picture would push another out: leave it with the decoder, which then holds back compressed units.
    #[must_use]
    pub fn has_room(&self) -> bool {
        self.pictures.len() < MAX_PICTURES
    }

    /// Takes in a decoded picture at `now`.
    pub fn push_picture(&mut self, decoded: Decoded, now: ClientTime) {
        let pts_us = decoded.picture.pts_us;
        if self.newest_pts_us.is_some_and(|newest| pts_us.saturating_add(JUMP_BACK_US) < newest) {
            tracing::info!(pts_us, "the broadcast's time went back; starting over with it");
            self.restart_at(pts_us);
        }
        self.observe_picture(&decoded);
        self.newest_pts_us = self.newest_pts_us.max(Some(pts_us));
        // While no pictures come, missing lights mean nothing.
        self.lightless_since.get_or_insert(now);
        if self.last_shown_us.is_some_and(|shown| pts_us <= shown) {
            if self.last_shown_us == Some(pts_us) {
                self.drops.duplicate += 1;
            } else {
                self.drops.late += 1;
            }
            return;
        }
        match self.pictures.binary_search_by_key(&pts_us, Waiting::pts_us) {
            Ok(_) => self.drops.duplicate += 1,
            Err(at) => self.pictures.insert(at, Waiting { decoded, pushed: now }),
        }
        if self.pictures.len() > MAX_PICTURES {
            self.pictures.pop_front();
            self.drops.overflow += 1;
        }
    }

    /// Takes in a light.
    pub fn push_light(&mut self, received: ReceivedLight) {
        let pts_us = received.light.pts_us;
        self.lightless_since = None;
        if self.silent {
            self.silent = false;
            tracing::info!("the light track is back");
        }
        // While everything is late the baseline is in doubt, not the light.
        if let Some(expected) = self.baseline.expected(pts_us).filter(|_| self.late_run.is_none()) {
            self.delay.observe_light(received.arrived.0.saturating_sub(expected.0), received.arrived);
        }
        if self.last_shown_us.is_some_and(|shown| pts_us <= shown) {
            self.drops.light_late += 1;
            return;
        }
        let about = self.newest_pts_us.unwrap_or(pts_us);
        self.drops.light_unused += self.lights.insert(received, about);
    }

    /// The newest pair that is due, at most once each, never older than the one before. What it overtakes is dropped and counted.
    pub fn poll(&mut self, now: ClientTime) -> Option<Paired> {
        self.watch_light(now);
        let silent = self.silent;
        let ready = |waiting: &Waiting| self.due(waiting) <= now && (silent || self.lights.contains(waiting.pts_us()));
        let Some(at) = self.pictures.iter().rposition(ready) else {
            self.drop_expired(now);
            return None;
        };
        for overtaken in self.pictures.drain(..at) {
            if self.lights.contains(overtaken.pts_us()) || silent {
                self.drops.superseded += 1;
            } else {
                self.drops.no_light += 1;
            }
        }
        let Decoded { picture, arrived, decoded, .. } = self.pictures.pop_front()?.decoded;
        let light = self.lights.take(picture.pts_us);
        self.drops.light_unused += self.lights.forget_up_to(picture.pts_us);
        self.last_shown_us = Some(picture.pts_us);
        self.drop_expired(now);
        Some(Paired { picture, light, arrived, decoded, paired: now })
    }

    /// The light of the next picture after the one handed out last, if it is here; the picture may yet come, or not.
    #[must_use]
    pub fn upcoming_light(&self) -> Option<&ReceivedLight> {
        self.lights.next_after(self.last_shown_us?)
    }

    /// When [`Playout::poll`] next has something to do, or `None` while nothing waits. A new arrival may bring it forward.
    #[must_use]
    pub fn next_deadline(&self, now: ClientTime) -> Option<ClientTime> {
        self.pictures
            .iter()
            .map(|waiting| {
                let due = self.due(waiting);
                let known = self.silent || self.lights.contains(waiting.pts_us());
                if known || due > now { due } else { self.light_deadline(waiting) }
            })
            .min()
    }

    /// Client time minus pts at which pictures are presented, microseconds; `None` before the first picture. For the audio.
    #[must_use]
    pub fn presentation_offset_us(&self) -> Option<i64> {
        self.baseline.offset_us().map(|offset| offset.saturating_add_unsigned(self.delay.current_us()))
    }

    /// How late pictures are played out on purpose, microseconds.
    #[must_use]
    pub fn delay_us(&self) -> u64 {
        self.delay.current_us()
    }

    /// What was not shown, by reason.
    #[must_use]
    pub fn drops(&self) -> Drops {
        self.drops
    }

    /// How often the broadcast started over; within one epoch time only goes forward.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Forgets the broadcast's time, all pictures and all lights: a new broadcast begins. The counts stay.
    pub fn reset(&mut self) {
        *self = Self { drops: self.drops, epoch: self.epoch + 1, ..Self::default() };
    }

    /// Resets, but keeps the lights of the new epoch that came before its first picture.
    fn restart_at(&mut self, pts_us: u64) {
        let mut lights = std::mem::take(&mut self.lights);
        self.reset();
        lights.keep_near(pts_us, JUMP_BACK_US);
        self.lights = lights;
    }

    fn observe_picture(&mut self, decoded: &Decoded) {
        let pts_us = decoded.picture.pts_us;
        let arrived = decoded.arrived;
        let expected = self.baseline.expected(pts_us);
        let excess_us = expected.map_or(0, |expected| arrived.0.saturating_sub(expected.0));
        if excess_us > MAX_DELAY_US {
            self.follow_late_run(pts_us, arrived);
            return;
        }
        self.late_run = None;
        self.baseline.observe(pts_us, arrived);
        // Earlier than any before it: a late joiner is catching up with the live edge, which says nothing of jitter.
        if let Some(expected) = expected.filter(|expected| *expected < arrived) {
            let ready = decoded.decoded.0.saturating_sub(decoded.held_us).max(arrived.0);
            self.delay.observe_picture(ready - expected.0, arrived);
        }
    }

    /// A source that paused and went on where it was stays late for good: after a while the baseline is set anew.
    fn follow_late_run(&mut self, pts_us: u64, arrived: ClientTime) {
        let run = self.late_run.get_or_insert(LateRun { since: arrived, best: (pts_us, arrived) });
        let (best_pts, best_arrival) = run.best;
        if arrived.0.saturating_add(best_pts) < best_arrival.0.saturating_add(pts_us) {
            run.best = (pts_us, arrived);
        }
        if arrived.0.saturating_sub(run.since.0) >= REANCHOR_AFTER_US {
            let (pts, at) = run.best;
            self.baseline = Baseline::default();
            self.baseline.observe(pts, at);
            self.late_run = None;
            tracing::info!("the source paused; playing on from where it resumed");
        }
    }

    fn due(&self, waiting: &Waiting) -> ClientTime {
        let expected = self.baseline.expected(waiting.pts_us()).unwrap_or(waiting.decoded.arrived);
        ClientTime(expected.0.saturating_add(self.delay.current_us()))
    }

    fn light_deadline(&self, waiting: &Waiting) -> ClientTime {
        ClientTime(self.due(waiting).max(waiting.pushed).0.saturating_add(LIGHT_GRACE_US))
    }

    fn drop_expired(&mut self, now: ClientTime) {
        while let Some(oldest) = self.pictures.front() {
            let waits = self.silent || self.lights.contains(oldest.pts_us()) || now < self.light_deadline(oldest);
            if waits {
                return;
            }
            self.pictures.pop_front();
            self.drops.no_light += 1;
        }
    }

    fn watch_light(&mut self, now: ClientTime) {
        let since = self.lightless_since.unwrap_or(now);
        if !self.silent && !self.pictures.is_empty() && now.0.saturating_sub(since.0) > LIGHT_SILENCE_US {
            self.silent = true;
            tracing::warn!("no light for a second while pictures come: showing them without objects until it is back");
        }
    }
}
