//! Where moving objects are shown: what this user holds at once, what others or physics move a little later and evenly.
//!
//! Changes come in steps of the server's clock and with the network's jitter. What was so at one time of the server is shown a fixed
//! while later, in between two places (the entity interpolation of Bernier, "Latency Compensating Methods in Client/Server In-game
//! Protocol Design and Optimization", 2001). What this user leads is shown where they lead it; once let go, it goes on until the
//! server's word on it has come, and what the two differ by fades.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};

use glam::{Quat, Vec3};
use mr360_protocol::clock::{ClientTime, ClockOffset, ServerTime};
use mr360_protocol::intent::{Action, Motion};
use mr360_protocol::scene::{Change, Object, ObjectId, Scene, Transform};

/// What was so on the server is shown so much later than it can be here at the earliest, microseconds: three of its steps, which a usual
/// network's jitter stays below.
const DELAY_US: u64 = 50_000;
/// After so long without a change an object rested in between, microseconds; it did not creep from one place to the next.
const REST_US: u64 = 60_000;
/// The server's step, microseconds.
const STEP_US: u64 = 16_667;
/// Most places kept of one object: those of the delay, and room for changes that come in a heap.
const MOST_PLACES: usize = 64;
/// Time constant by which a difference between what was shown and what is so fades, critically damped: neither place nor speed jump.
/// Microseconds.
const FADE_US: f32 = 100_000.0;
/// Fades last this long, then nothing is left of them, microseconds.
const FADED_US: u64 = 800_000;
/// For so long a thing that was let go of goes on by itself, microseconds; the server's word is due by then.
const COAST_US: u64 = 300_000;
/// For so long after taking hold, places from before then may still come, microseconds.
const GRACE_US: u64 = 500_000;
/// Last places that this user wished for, by which the server's echo is told from others' doing.
const MOST_WISHES: usize = 64;

/// All objects that do not simply stand where the scene says.
#[derive(Debug, Default)]
pub struct Motions {
    clock: ClockOffset,
    tracks: BTreeMap<ObjectId, Track>,
    led: HashMap<ObjectId, Led>,
    /// What this user would lead, but others do, until they let go.
    refused: HashSet<ObjectId>,
}

/// Places of an object as the server told them, and what is left of what was shown instead.
#[derive(Debug, Default)]
struct Track {
    places: VecDeque<(ServerTime, Transform)>,
    fade: Option<Fade>,
}

/// What was shown, less what was so.
#[derive(Debug, Clone, Copy)]
struct Fade {
    since: ClientTime,
    position: Vec3,
    /// Speed shown less speed so, metres a second.
    speed: Vec3,
    rotation: Quat,
    /// By which it was larger, on each axis.
    scale: Vec3,
}

/// An object that this user leads, or has just let go of.
#[derive(Debug)]
struct Led {
    since: ClientTime,
    transform: Transform,
    /// Newest last.
    wishes: VecDeque<Transform>,
    /// The server has shown one of the wishes to be done.
    echoed: bool,
    released: Option<(ClientTime, Motion)>,
}

impl Motions {
    /// Takes in a delta that was so at `at` and came at `arrived`. `before` is the scene without it.
    pub fn delta(&mut self, at: ServerTime, arrived: ClientTime, changes: &[Change], before: &Scene) {
        self.clock.observe(at, arrived);
        for change in changes {
            match change {
                Change::Move(id, transform) => {
                    let track = self.tracks.entry(*id).or_default();
                    let last = track.places.back().map(|(last, _)| *last);
                    if last.is_none_or(|last| at.0.saturating_sub(last.0) > REST_US)
                        && let Some(object) = before.object(*id)
                    {
                        track.places.push_back((ServerTime(at.0.saturating_sub(STEP_US)), object.transform));
                    }
                    if last.is_none_or(|last| last < at) {
                        track.places.push_back((at, *transform));
                    }
                    while track.places.len() > MOST_PLACES {
                        track.places.pop_front();
                    }
                    self.hear(*id, transform, arrived);
                }
                Change::Put(object) => self.forget(object.id),
                Change::Remove(id) => self.forget(*id),
            }
        }
    }

    /// Takes in a snapshot that was so at `at` and came at `arrived`: what it differs by from the scene `before` it, as a delta. Groups
    /// begin with one while everything goes on.
    pub fn snapshot(&mut self, at: ServerTime, arrived: ClientTime, scene: &Scene, before: &Scene) {
        let known = |scene: &Scene, id| scene.objects.binary_search_by_key(&id, |object| object.id).ok();
        let change = |object: &Object| match known(before, object.id).and_then(|index| before.objects.get(index)) {
            Some(old) if old.transform == object.transform => None,
            Some(_) => Some(Change::Move(object.id, object.transform)),
            None => Some(Change::Put(object.clone())),
        };
        let gone = before.objects.iter().filter(|object| known(scene, object.id).is_none()).map(|object| Change::Remove(object.id));
        let changes: Vec<_> = scene.objects.iter().filter_map(change).chain(gone).collect();
        self.delta(at, arrived, &changes, before);
    }

    fn forget(&mut self, id: ObjectId) {
        self.refused.remove(&id);
        self.tracks.remove(&id);
        self.led.remove(&id);
    }

    /// Tells the echo of this user's wishes from others' doing.
    fn hear(&mut self, id: ObjectId, transform: &Transform, now: ClientTime) {
        let Some(led) = self.led.get_mut(&id) else { return };
        if led.wishes.contains(transform) {
            led.echoed = true;
            return;
        }
        // From before the server heard of the grab; or the thing is another user's.
        let own = led.released.is_none() && !led.echoed && now.0.saturating_sub(led.since.0) < GRACE_US;
        if !own && (led.released.is_some() || !led.echoed) {
            if led.released.is_none() {
                self.refused.insert(id);
            }
            self.hand_over(id, now);
        }
    }

    /// From now on the server's word is shown; what it differs by from what was, fades.
    fn hand_over(&mut self, id: ObjectId, now: ClientTime) {
        let Some(led) = self.led.remove(&id) else { return };
        let shown = led.at(now);
        let Some(server_now) = self.server_now(now) else { return };
        let track = self.tracks.entry(id).or_default();
        let mut speed = Vec3::ZERO;
        if let Some((_, motion)) = led.released {
            speed = motion.linear;
            // What was told is not due yet. Until then it is on its way there as it was let go of, not still in hand.
            if let Some((at, first)) = track.places.back().copied().filter(|(at, _)| *at > server_now) {
                let seconds = (at.0 - server_now.0 + STEP_US) as f32 * 1e-6;
                let back = Transform {
                    position: first.position - motion.linear * seconds,
                    rotation: (Quat::from_scaled_axis(-motion.angular * seconds) * first.rotation).normalize(),
                    ..first
                };
                track.places.clear();
                track.places.extend([(ServerTime(server_now.0.saturating_sub(STEP_US)), back), (at, first)]);
                speed = Vec3::ZERO;
            }
        }
        if let Some(so) = track.place(server_now) {
            track.fade = Some(Fade {
                since: now,
                position: shown.position - so.position,
                speed,
                rotation: shown.rotation * so.rotation.inverse(),
                scale: shown.scale / so.scale,
            });
        }
    }

    /// What this user does is shown at once. `shown` is where the object is shown now.
    pub fn lead(&mut self, action: &Action, shown: Option<Transform>, now: ClientTime) {
        match action {
            Action::Move(id, _) if self.refused.contains(id) => {}
            Action::Grab(id) | Action::Move(id, _) => {
                self.refused.remove(id);
                let Some(shown) = shown else { return };
                let led = self.led.entry(*id).or_insert_with(|| Led::new(shown, now));
                if led.released.is_some() {
                    *led = Led::new(shown, now);
                }
                if let Action::Move(_, transform) = action {
                    led.transform = *transform;
                    led.wishes.push_back(*transform);
                    if led.wishes.len() > MOST_WISHES {
                        led.wishes.pop_front();
                    }
                }
            }
            Action::Release(id, motion) => {
                self.refused.remove(id);
                if let Some(led) = self.led.get_mut(id) {
                    led.released = Some((now, *motion));
                }
            }
            // It is gone, or comes, when the server says so.
            Action::Remove(_) | Action::Put { .. } => {}
        }
    }

    /// Where every object is shown now that does not stand where the scene says, or has just come to do so. Call once a frame.
    pub fn advance(&mut self, now: ClientTime, scene: &Scene) -> Vec<(ObjectId, Transform)> {
        let over = |led: &Led| led.released.is_some_and(|(at, _)| now.0.saturating_sub(at.0) > COAST_US);
        let mut ended: Vec<_> = self.led.iter().filter(|(_, led)| over(led)).map(|(id, _)| *id).collect();
        ended.sort_unstable();
        for id in ended {
            // Nothing more was heard: it lies where the scene has it.
            if let Some(object) = scene.object(id) {
                let track = self.tracks.entry(id).or_default();
                if track.places.is_empty() {
                    track.places.push_back((ServerTime(0), object.transform));
                }
            }
            self.hand_over(id, now);
        }
        let server_now = self.server_now(now);
        let mut out: Vec<_> = self.led.iter().map(|(id, led)| (*id, led.at(now))).collect();
        let led = &self.led;
        self.tracks.retain(|id, track| {
            let Some(place) = server_now.and_then(|server| track.place(server)) else { return false };
            if !led.contains_key(id) {
                out.push((*id, track.fade.map_or(place, |fade| fade.over(&place, now))));
            }
            let fading = track.fade.is_some_and(|fade| now.0.saturating_sub(fade.since.0) < FADED_US);
            if !fading {
                track.fade = None;
            }
            let last = track.places.back().map_or(0, |(last, _)| last.0);
            fading || server_now.is_some_and(|server| server.0 < last)
        });
        out.sort_unstable_by_key(|(id, _)| *id);
        out
    }

    /// True while something is shown elsewhere than the scene says: the next frame looks different.
    #[must_use]
    pub fn moving(&self) -> bool {
        !self.tracks.is_empty() || self.led.values().any(|led| led.released.is_some())
    }

    /// The time of the server that is shown now.
    fn server_now(&self, now: ClientTime) -> Option<ServerTime> {
        let server = self.clock.server_from_client(now)?;
        Some(ServerTime(server.0.saturating_sub(DELAY_US)))
    }
}

impl Track {
    /// Between the two places around this time; the first or the last beyond them. Places that are over are dropped.
    fn place(&mut self, at: ServerTime) -> Option<Transform> {
        while self.places.get(1).is_some_and(|(next, _)| *next <= at) {
            self.places.pop_front();
        }
        let (begin, from) = *self.places.front()?;
        let Some((end, to)) = self.places.get(1).copied().filter(|_| begin <= at) else { return Some(from) };
        let t = (at.0 - begin.0) as f32 / (end.0 - begin.0).max(1) as f32;
        Some(Transform {
            position: from.position.lerp(to.position, t),
            rotation: from.rotation.slerp(to.rotation, t).normalize(),
            scale: from.scale.lerp(to.scale, t),
        })
    }
}

impl Fade {
    fn over(&self, so: &Transform, now: ClientTime) -> Transform {
        let elapsed_us = now.0.saturating_sub(self.since.0) as f32;
        let t = elapsed_us / FADE_US;
        let left = (1.0 + t) * (-t).exp();
        Transform {
            position: so.position + self.position * left + self.speed * (elapsed_us * 1e-6 * (-t).exp()),
            rotation: (Quat::IDENTITY.slerp(self.rotation, left) * so.rotation).normalize(),
            scale: so.scale * self.scale.powf(left),
        }
    }
}

impl Led {
    fn new(transform: Transform, now: ClientTime) -> Self {
        Self { since: now, transform, wishes: VecDeque::new(), echoed: false, released: None }
    }

    /// Let go of it goes straight on for a while: whether it falls, or what it hits, the server says.
    fn at(&self, now: ClientTime) -> Transform {
        let Some((at, motion)) = self.released else { return self.transform };
        let seconds = now.0.saturating_sub(at.0).min(COAST_US) as f32 * 1e-6;
        Transform {
            position: self.transform.position + motion.linear * seconds,
            rotation: (Quat::from_scaled_axis(motion.angular * seconds) * self.transform.rotation).normalize(),
            ..self.transform
        }
    }
}

#[cfg(test)]
mod tests;
