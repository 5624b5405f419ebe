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
mod tests {
    use mr360_protocol::scene::{Geometry, Shape};

    use super::*;

    const BALL: ObjectId = ObjectId(1);
    const G: f32 = 9.81;

    fn at(position: Vec3) -> Transform {
        Transform { position, ..Transform::default() }
    }

    fn scene(position: Vec3) -> Scene {
        let geometry = Geometry::Shape(Shape::Sphere);
        let ball = Object { id: BALL, geometry, transform: at(position), material: None, animation: Default::default() };
        Scene { objects: vec![ball], ..Scene::default() }
    }

    /// A server and a viewer with a network between them.
    struct Link {
        motions: Motions,
        scene: Scene,
        /// Client clock minus server clock.
        offset: i64,
        waiting: Vec<(ClientTime, ServerTime, Transform)>,
        shown: Transform,
    }

    impl Link {
        fn new(offset: i64) -> Self {
            Self { motions: Motions::default(), scene: scene(Vec3::ZERO), offset, waiting: Vec::new(), shown: at(Vec3::ZERO) }
        }

        fn client(&self, server_us: u64) -> ClientTime {
            ClientTime(server_us.checked_add_signed(self.offset).unwrap())
        }

        fn send(&mut self, server_us: u64, delay_us: u64, transform: Transform) {
            self.waiting.push((self.client(server_us + delay_us), ServerTime(server_us), transform));
        }

        /// Takes in what has come by now, and shows a frame.
        fn frame(&mut self, now: ClientTime) -> Transform {
            let (come, wait): (Vec<_>, Vec<_>) = self.waiting.drain(..).partition(|(arrived, ..)| *arrived <= now);
            self.waiting = wait;
            for (arrived, server, transform) in come {
                let change = Change::Move(BALL, transform);
                self.motions.delta(server, arrived, std::slice::from_ref(&change), &self.scene);
                self.scene.objects[0].transform = transform;
            }
            let moved = self.motions.advance(now, &self.scene);
            self.shown = moved.first().map_or(self.shown, |(_, transform)| *transform);
            self.shown
        }
    }

    #[test]
    fn what_others_move_is_shown_evenly_whatever_the_network_does() {
        for offset in [-40_000_000i64, 0, 5_000_000] {
            let mut link = Link::new(offset);
            let begin = 50_000_000;
            for step in 0..60u64 {
                let jitter = [0, 21_000, 3_000, 30_000, 9_000][step as usize % 5];
                link.send(begin + step * STEP_US, 20_000 + jitter, at(Vec3::X * (step as f32 * STEP_US as f32 * 1e-6)));
            }
            let mut places = Vec::new();
            for frame in 0..100u64 {
                let now = link.client(begin + frame * 11_111);
                places.push((frame * 11_111, link.frame(now).position.x));
            }
            // Shown is what was so 70 ms before: the least delay of the network and the viewer's own.
            for (t, x) in &places[12..] {
                let so = (t - 70_000).min(59 * STEP_US) as f32 * 1e-6;
                assert!((x - so).abs() < 1e-3, "offset {offset}: at {t} it is shown at {x}, not {so}");
            }
            assert!(!link.motions.moving(), "it rests, and is moved no more");
            assert!((link.shown.position.x - 59.0 * STEP_US as f32 * 1e-6).abs() < 1e-6);
        }
    }

    #[test]
    fn what_has_rested_does_not_creep() {
        let mut link = Link::new(0);
        link.send(10_000_000, 1_000, at(Vec3::X));
        for ms in 0..200 {
            link.frame(ClientTime(10_000_000 + ms * 1_000));
        }
        link.send(14_000_000, 1_000, at(Vec3::X * 2.0));
        let mut shown = Vec::new();
        for ms in 0..100u64 {
            shown.push(link.frame(ClientTime(14_000_000 + ms * 1_000)).position.x);
        }
        let moving = shown.iter().filter(|x| **x > 1.0 && **x < 2.0).count();
        assert!((14..=18).contains(&moving), "on its way for {moving} ms");
    }

    #[test]
    fn what_this_user_leads_is_where_they_lead_it_and_echoes_change_nothing() {
        let mut link = Link::new(0);
        link.send(1_000_000, 40_000, at(Vec3::ZERO));
        link.frame(ClientTime(1_100_000));
        link.motions.lead(&Action::Grab(BALL), Some(link.shown), ClientTime(1_100_000));
        for frame in 0..50u64 {
            let now = ClientTime(1_100_000 + frame * 11_111);
            let wish = at(Vec3::X * frame as f32 * 0.01);
            link.motions.lead(&Action::Move(BALL, wish), Some(link.shown), now);
            link.send(now.0, 40_000, wish);
            assert_eq!(link.frame(now), wish);
        }
    }

    #[test]
    fn a_thing_that_is_let_go_of_never_jumps_and_ends_where_the_server_has_it() {
        let frame_us = 11_111;
        for (linear, falls) in [(Vec3::new(2.0, 1.0, 0.0), true), (Vec3::ZERO, true), (Vec3::ZERO, false)] {
            let mut link = Link::new(0);
            link.send(900_000, 40_000, at(Vec3::ZERO));
            link.frame(ClientTime(1_000_000));
            link.motions.lead(&Action::Grab(BALL), Some(link.shown), ClientTime(1_000_000));
            let hold = at(Vec3::Y);
            link.motions.lead(&Action::Move(BALL, hold), Some(link.shown), ClientTime(1_000_000));
            link.send(1_040_000, 40_000, hold);
            link.frame(ClientTime(1_300_000));
            let released = 1_300_000;
            link.motions.lead(&Action::Release(BALL, Motion { linear, angular: Vec3::ZERO }), Some(hold), ClientTime(released));
            // The server hears of it 40 ms later, and tells of it 40 ms after each step.
            let end = |t: f32| if falls { Vec3::Y + linear * t - Vec3::Y * (0.5 * G * t * t) } else { Vec3::Y };
            if falls {
                for step in 1..40u64 {
                    link.send(released + 40_000 + step * STEP_US, 40_000, at(end(step as f32 * STEP_US as f32 * 1e-6)));
                }
            }
            let (mut last, mut speed) = (hold.position, linear);
            for frame in 1..200u64 {
                let now = ClientTime(released + frame * frame_us);
                let shown = link.frame(now).position;
                let next = (shown - last) / (frame_us as f32 * 1e-6);
                // What fell 130 ms fades within some of these frames; a jump of a centimetre would be 0.9 m/s.
                // In the end the server's ball stops dead, as if on a ledge.
                assert!((next - speed).length() < 0.6 || frame >= 70, "speed jumps from {speed} to {next} in frame {frame}");
                (last, speed) = (shown, next);
            }
            let rest = if falls { end(39.0 * STEP_US as f32 * 1e-6) } else { Vec3::Y };
            assert!(last.distance(rest) < 1e-3, "{last} for {rest}");
            assert!(!link.motions.moving());
        }
    }

    #[test]
    fn what_another_user_holds_slips_away() {
        let mut link = Link::new(0);
        link.send(900_000, 40_000, at(Vec3::ZERO));
        link.frame(ClientTime(1_000_000));
        link.motions.lead(&Action::Grab(BALL), Some(link.shown), ClientTime(1_000_000));
        for frame in 0..120u64 {
            let now = 1_000_000 + frame * 11_111;
            link.motions.lead(&Action::Move(BALL, at(Vec3::X)), Some(link.shown), ClientTime(now));
            link.send(now, 40_000, at(Vec3::Z * frame as f32 * 0.01));
            link.frame(ClientTime(now));
            if frame == 40 {
                assert_eq!(link.shown, at(Vec3::X), "within the grace it is this user's");
            }
        }
        // Shown is the other's doing of 90 ms before, and the fade of what was shown instead.
        assert!((link.shown.position - Vec3::Z * 1.19).length() < 0.12, "{}", link.shown.position);
        // A new grab is a new try.
        link.motions.lead(&Action::Grab(BALL), Some(link.shown), ClientTime(3_000_000));
        assert!(link.motions.led.contains_key(&BALL));
    }

    #[test]
    fn a_group_that_begins_amid_a_flight_does_not_show() {
        let position = |server_us: u64| Vec3::X * (server_us as f32 * 1e-6 * 2.0);
        let shown = |snapshots: bool| {
            let mut link = Link::new(0);
            let mut shown = Vec::new();
            for step in 60..180u64 {
                let now = step * STEP_US;
                if snapshots && step % 10 == 0 {
                    let next = scene(position(now));
                    link.motions.snapshot(ServerTime(now), ClientTime(now), &next, &link.scene);
                    link.scene = next;
                } else {
                    link.send(now, 0, at(position(now)));
                }
                shown.push(link.frame(ClientTime(now)).position.x);
            }
            shown
        };
        assert_eq!(shown(true), shown(false));
    }

    #[test]
    fn what_a_snapshot_lacks_is_forgotten_and_removals_end_motions() {
        let mut link = Link::new(0);
        link.send(1_000_000, 0, at(Vec3::X));
        link.frame(ClientTime(1_000_000));
        assert!(link.motions.moving());
        link.motions.snapshot(ServerTime(1_016_667), ClientTime(1_016_667), &Scene::default(), &link.scene);
        assert!(!link.motions.moving() && link.motions.advance(ClientTime(1_016_668), &link.scene).is_empty());
        link.motions.lead(&Action::Grab(BALL), Some(at(Vec3::X)), ClientTime(1_000_000));
        link.motions.delta(ServerTime(2_000_000), ClientTime(2_000_000), &[Change::Remove(BALL)], &link.scene);
        assert!(link.motions.led.is_empty());
    }
}
