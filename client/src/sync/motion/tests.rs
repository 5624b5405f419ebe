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
