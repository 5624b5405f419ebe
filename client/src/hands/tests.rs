//! Scripted hands in a world of a few things.

use std::collections::BTreeMap;

use glam::{Quat, Vec2, Vec3};
use mr360_protocol::clock::ClientTime;
use mr360_protocol::codec::Message;
use mr360_protocol::intent::{Action, Intent, Motion};
use mr360_protocol::scene::{Geometry, LibraryItem, ObjectId, Shape, Transform};

use super::*;
use crate::scene::pick::{Target, nearest, nearest_to};

const FRAME_US: u64 = 11_111;
const CUBE: ObjectId = ObjectId(1);
const BALL: ObjectId = ObjectId(2);
const GROUND_Y: f32 = -1.6;

struct Things {
    things: BTreeMap<ObjectId, (Shape, Transform)>,
    library: Vec<LibraryItem>,
}

impl Things {
    fn targets(&self) -> impl Iterator<Item = Target> + '_ {
        self.things.iter().map(|(id, (shape, transform))| Target { id: *id, transform: *transform, bounds: BOX, shape: Some(*shape) })
    }
}

const BOX: Bounds = Bounds { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) };

impl World for Things {
    fn pick(&self, ray: &Ray) -> Option<(ObjectId, Vec3)> {
        nearest(ray, self.targets())
    }
    fn near(&self, point: Vec3, reach_m: f32) -> Option<ObjectId> {
        Some(nearest_to(point, reach_m, self.targets())?.0)
    }
    fn transform(&self, object: ObjectId) -> Option<Transform> {
        Some(self.things.get(&object)?.1)
    }
    fn object_bounds(&self, object: ObjectId) -> Option<Bounds> {
        self.things.get(&object).map(|_| BOX)
    }
    fn bounds(&self, _geometry: &Geometry) -> Option<Bounds> {
        Some(BOX)
    }
    fn library(&self) -> &[LibraryItem] {
        &self.library
    }
    fn ground_y(&self) -> f32 {
        GROUND_Y
    }
}

/// Hands, the world, and all that was wished.
struct Stand {
    hands: Hands,
    world: Things,
    input: HandsInput,
    wished: Vec<Action>,
}

fn at(position: Vec3) -> Pose {
    Pose { position, orientation: Quat::IDENTITY }
}

impl Stand {
    /// A small cube within reach of the right hand, a ball far ahead.
    fn new() -> Self {
        let small = |position| Transform { position, scale: Vec3::splat(0.2), ..Transform::default() };
        let things = BTreeMap::from([
            (CUBE, (Shape::Cube, small(Vec3::new(0.3, -0.3, -0.5)))),
            (BALL, (Shape::Sphere, Transform { scale: Vec3::ONE, ..small(Vec3::new(-2.0, -0.3, -5.0)) })),
        ]);
        let hand = |x: f32| {
            let pose = at(Vec3::new(x, -0.3, -0.3));
            HandInput { grip: Some(pose), aim: Some(pose), ..HandInput::default() }
        };
        let input = HandsInput { hands: [hand(-1.0), hand(1.0)], head: Pose::IDENTITY, now: ClientTime(1_000_000), scale: 1.0 };
        Self { hands: Hands::default(), world: Things { things, library: LibraryItem::shapes() }, input, wished: Vec::new() }
    }

    fn frame(&mut self) -> HandsOutput {
        let out = self.hands.update(&self.input, &self.world);
        self.input.now.0 += FRAME_US;
        for action in &out.actions {
            Intent { sequence: 1, action: action.clone() }.to_wire().unwrap();
            match action {
                Action::Move(object, transform) => {
                    // The other hand may have removed it in this frame.
                    self.world.things.entry(*object).and_modify(|thing| thing.1 = *transform);
                }
                Action::Remove(object) => drop(self.world.things.remove(object)),
                _ => {}
            }
        }
        self.wished.extend(out.actions.iter().cloned());
        out
    }

    fn both(&mut self, hand: usize, pose: Pose) {
        (self.input.hands[hand].grip, self.input.hands[hand].aim) = (Some(pose), Some(pose));
    }

    /// Moves a hand there at an even speed.
    fn lead(&mut self, hand: usize, to: Vec3, frames: u16) {
        let from = self.input.hands[hand].grip.unwrap();
        for frame in 1..=frames {
            let position = from.position.lerp(to, f32::from(frame) / f32::from(frames));
            self.both(hand, Pose { position, ..from });
            self.frame();
        }
    }

    fn squeeze(&mut self, hand: usize, value: f32) -> HandsOutput {
        self.input.hands[hand].squeeze = value;
        self.frame()
    }

    fn transform(&self, object: ObjectId) -> Transform {
        self.world.things[&object].1
    }
}

#[test]
fn a_near_thing_is_touched_taken_turned_and_thrown() {
    let mut stand = Stand::new();
    stand.frame();
    stand.both(1, at(Vec3::new(0.3, -0.3, -0.35)));
    assert_eq!(stand.frame().haptics, [None, Some(TOUCHED)]);
    assert_eq!(stand.frame().haptics, [None, None], "it is touched once");
    let out = stand.squeeze(1, 1.0);
    assert_eq!((out.haptics[1], &out.actions[..]), (Some(GRABBED), &[Action::Grab(CUBE)][..]));

    // Turned in place about the hand: what was 15 cm before it is 15 cm beside it.
    let turned = Pose { orientation: Quat::from_rotation_y(std::f32::consts::FRAC_PI_2), ..at(Vec3::new(0.3, -0.3, -0.35)) };
    stand.both(1, turned);
    stand.frame();
    assert!(stand.transform(CUBE).position.distance(Vec3::new(0.15, -0.3, -0.35)) < 1e-5);
    stand.both(1, at(Vec3::new(0.3, -0.3, -0.35)));
    (0..20).for_each(|_| drop(stand.frame()));

    let velocity = Vec3::new(1.0, 2.0, -3.0);
    let seconds = 18.0 * FRAME_US as f32 * 1e-6;
    stand.lead(1, Vec3::new(0.3, -0.3, -0.35) + velocity * seconds, 18);
    let out = stand.squeeze(1, 0.0);
    let [Action::Release(CUBE, motion)] = out.actions[..] else { panic!("{:?}", out.actions) };
    assert!(motion.linear.distance(velocity) < 0.02 && motion.angular.length() < 0.01, "{motion:?}");
    assert_eq!(out.haptics[1], Some(RELEASED));
    assert!(stand.hands.held.is_empty());
}

#[test]
fn hands_and_their_reach_grow_with_the_viewer() {
    let mut stand = Stand::new();
    stand.frame();
    // 20 cm from the cube's side: too far for a hand, near for one that is three times as large.
    stand.both(1, at(Vec3::new(0.6, -0.3, -0.5)));
    assert_eq!(stand.frame().haptics, [None, None]);
    stand.input.scale = 3.0;
    let out = stand.frame();
    assert_eq!(out.haptics, [None, Some(TOUCHED)]);
    assert!(out.drawn.iter().all(|drawn| drawn.transform.scale.x >= 0.999 * 3.0 * 0.004), "{:?}", out.drawn);
    assert_eq!(out.drawn.iter().filter(|drawn| drawn.casts && drawn.transform.scale == Vec3::splat(3.0)).count(), 2);
}

#[test]
fn a_far_thing_hangs_on_the_ray_is_reeled_in_and_turned() {
    let mut stand = Stand::new();
    let aim = at(Vec3::new(-2.0, -0.3, 0.0));
    stand.both(0, aim);
    let out = stand.frame();
    assert_eq!(out.drawn.len(), 2 + 2, "two controllers, the left one's ray and its mark: {:?}", out.drawn);
    stand.input.hands[0].select = 1.0;
    stand.frame();
    // A tenth of a turn at the hand: the thing five metres away swings around it.
    let angle = 0.3;
    stand.both(0, Pose { orientation: Quat::from_rotation_y(angle), ..aim });
    stand.frame();
    let expected = aim.position + Quat::from_rotation_y(angle) * Vec3::NEG_Z * 5.0;
    assert!(stand.transform(BALL).position.distance(expected) < 1e-4);
    stand.input.hands[0].stick = Vec2::NEG_Y;
    (0..90).for_each(|_| drop(stand.frame()));
    let distance = stand.transform(BALL).position.distance(aim.position);
    assert!((distance - 5.0 / std::f32::consts::E).abs() < 0.05, "reeled in to {distance} m");
    let before = stand.transform(BALL);
    stand.input.hands[0].stick = Vec2::X;
    (0..45).for_each(|_| drop(stand.frame()));
    let after = stand.transform(BALL);
    assert!(after.position.distance(before.position) < 1e-3);
    assert!((before.rotation.angle_between(after.rotation) - TURN_RAD_S * 45.0 * FRAME_US as f32 * 1e-6).abs() < 1e-3);
    // It was turned by the stick, and is let go of so.
    stand.input.hands[0].stick = Vec2::ZERO;
    (0..20).for_each(|_| drop(stand.frame()));
    stand.input.hands[0].select = 0.0;
    stand.frame();
    assert_eq!(stand.wished.last(), Some(&Action::Release(BALL, Motion::STILL)));
}

#[test]
fn two_hands_scale_and_turn_a_thing_and_pass_it_on_without_a_jump() {
    let mut stand = Stand::new();
    stand.both(1, at(Vec3::new(0.4, -0.3, -0.5)));
    stand.squeeze(1, 1.0);
    stand.both(0, at(Vec3::new(0.2, -0.3, -0.5)));
    stand.squeeze(0, 1.0);
    assert_eq!(stand.wished, [Action::Grab(CUBE)], "one user takes it once");
    let before = stand.transform(CUBE);
    // Twice as far from each other, about the same middle, and a quarter of a turn.
    let [left, right] = [Vec3::new(0.3, -0.3, -0.3), Vec3::new(0.3, -0.3, -0.7)];
    for step in 1..=30u8 {
        let (angle, apart) = (std::f32::consts::FRAC_PI_2 * f32::from(step) / 30.0, 0.1 + 0.1 * f32::from(step) / 30.0);
        let span = Quat::from_rotation_y(angle) * Vec3::X * apart;
        stand.both(0, at(Vec3::new(0.3, -0.3, -0.5) - span));
        stand.both(1, at(Vec3::new(0.3, -0.3, -0.5) + span));
        stand.frame();
    }
    let after = stand.transform(CUBE);
    assert!((after.scale - before.scale * 2.0).length() < 1e-4, "{after:?}");
    assert!(after.position.distance(before.position) < 1e-5);
    assert!((after.rotation * Vec3::X).distance(Vec3::NEG_Z) < 1e-4);
    assert_eq!(
        stand.input.hands.map(|hand| hand.grip.unwrap().position.distance(left).min(hand.grip.unwrap().position.distance(right)) < 1e-5),
        [true; 2]
    );

    // The first hand lets go: the other has it, where it was.
    let out = stand.squeeze(1, 0.0);
    assert!(out.actions.is_empty(), "{:?}", out.actions);
    assert_eq!(stand.transform(CUBE), after);
    stand.lead(0, left + Vec3::Y, 5);
    assert!(stand.transform(CUBE).position.distance(after.position + Vec3::Y) < 1e-4);
    stand.squeeze(0, 0.0);
    assert!(matches!(stand.wished.last(), Some(Action::Release(CUBE, _))));
}

#[test]
fn a_hand_that_is_lost_keeps_its_thing_for_a_while_and_never_throws_it() {
    let mut stand = Stand::new();
    stand.both(1, at(Vec3::new(0.3, -0.3, -0.5)));
    stand.squeeze(1, 1.0);
    stand.lead(1, Vec3::new(0.3, 0.7, -0.5), 10);
    let there = stand.transform(CUBE);
    (stand.input.hands[1].grip, stand.input.hands[1].aim) = (None, None);
    (0..45).for_each(|_| drop(stand.frame()));
    assert_eq!(stand.transform(CUBE), there);
    // Back elsewhere after half a second: the thing waits where it was and follows from there.
    stand.both(1, at(Vec3::new(0.8, 0.2, -0.5)));
    stand.frame();
    assert_eq!(stand.transform(CUBE), there);
    stand.lead(1, Vec3::new(0.9, 0.2, -0.5), 3);
    assert!(stand.transform(CUBE).position.distance(there.position + Vec3::X * 0.1) < 1e-5);
    // Gone for good, in a swing.
    (stand.input.hands[1].grip, stand.input.hands[1].aim) = (None, Some(Pose { position: Vec3::NAN, orientation: Quat::IDENTITY }));
    let frames = (0..200).take_while(|_| !stand.frame().actions.contains(&Action::Release(CUBE, Motion::STILL))).count();
    assert!((89..=92).contains(&frames), "let go of after {frames} frames");
}

#[test]
fn the_library_is_cycled_pointed_with_and_put() {
    let mut stand = Stand::new();
    // Down, to the ground two metres ahead.
    let origin = Vec3::new(0.0, 0.0, 0.0);
    let target = Vec3::new(0.0, GROUND_Y, -2.0);
    let aim = Pose { position: origin, orientation: Quat::from_rotation_arc(Vec3::NEG_Z, (target - origin).normalize()) };
    stand.both(1, aim);
    let press = |stand: &mut Stand| {
        stand.input.hands[1].menu = true;
        stand.frame();
        stand.input.hands[1].menu = false;
        stand.frame()
    };
    let is_ghost = |drawn: &LocalObject| matches!(drawn.geometry, Geometry::Shape(_));
    for item in 0..4 {
        let out = press(&mut stand);
        let ghost = out.drawn.iter().find(|drawn| is_ghost(drawn)).unwrap();
        let LibraryItem { geometry, scale, .. } = &stand.world.library[item];
        assert_eq!((&ghost.geometry, ghost.transform.scale), (geometry, *scale));
        let foot = ghost.transform.position - Vec3::Y * 0.5 * scale.y;
        assert!(foot.distance(target) < 2e-3, "the ghost stands at {foot}");
    }
    stand.input.hands[1].select = 1.0;
    let out = stand.frame();
    let [Action::Put { item: 3, transform }] = out.actions[..] else { panic!("{:?}", out.actions) };
    stand.input.hands[1].select = 0.0;
    stand.frame();
    // Larger, by the stick.
    stand.input.hands[1].stick = Vec2::Y;
    (0..90).for_each(|_| drop(stand.frame()));
    stand.input.hands[1].select = 1.0;
    let out = stand.frame();
    let [Action::Put { transform: larger, .. }] = out.actions[..] else { panic!("{:?}", out.actions) };
    assert!((larger.scale.x / transform.scale.x - std::f32::consts::E).abs() < 0.05);
    assert!(stand.wished.iter().all(|action| matches!(action, Action::Put { .. })), "nothing else was taken");
    // Beyond the last item the hand is free again.
    (stand.input.hands[1].stick, stand.input.hands[1].select) = (Vec2::ZERO, 0.0);
    let out = press(&mut stand);
    assert!(!out.drawn.iter().any(is_ghost));
    // To the sky nothing is put.
    press(&mut stand);
    stand.both(1, Pose { orientation: Quat::from_rotation_x(1.0), ..aim });
    stand.input.hands[1].select = 1.0;
    assert!(stand.frame().actions.is_empty());
}

#[test]
fn the_menu_snaps_and_removes_what_is_held_and_recentres_without() {
    let mut stand = Stand::new();
    stand.input.hands[1].menu = true;
    let told: Vec<_> = (0..100).flat_map(|_| stand.frame().placing).collect();
    assert_eq!(told, [PlacingChange::Recentre]);
    stand.input.hands[1].menu = false;
    stand.frame();

    stand.both(1, Pose { orientation: Quat::from_rotation_z(0.4), ..at(Vec3::new(0.3, -0.3, -0.5)) });
    stand.squeeze(1, 1.0);
    stand.lead(1, Vec3::new(0.5, 0.0, -1.0), 4);
    stand.input.hands[1].menu = true;
    stand.frame();
    stand.input.hands[1].menu = false;
    let out = stand.frame();
    let [Action::Move(CUBE, stands), Action::Release(CUBE, Motion::STILL)] = out.actions[..] else { panic!("{:?}", out.actions) };
    assert!((stands.position.y - (GROUND_Y + 0.1)).abs() < 2e-3 && (stands.rotation * Vec3::Y).distance(Vec3::Y) < 1e-5);
    // The button that held it is still down: it takes hold of nothing before it is pressed again.
    assert!(stand.frame().actions.is_empty());

    stand.squeeze(1, 0.0);
    stand.both(1, at(stands.position));
    stand.squeeze(1, 1.0);
    stand.input.hands[1].menu = true;
    (0..100).for_each(|_| drop(stand.frame()));
    assert_eq!(stand.wished.last(), Some(&Action::Remove(CUBE)));
    assert!(!stand.world.things.contains_key(&CUBE) && stand.hands.held.is_empty());
}

#[test]
fn sticks_of_free_hands_and_both_squeezes_place_the_viewer() {
    let mut stand = Stand::new();
    stand.frame();
    stand.input.hands[1].stick = Vec2::X;
    let told: Vec<_> = (0..30).flat_map(|_| stand.frame().placing).collect();
    assert_eq!(told, [PlacingChange::Turn(-SNAP_RAD)], "a turn each time the stick goes there");
    stand.input.hands[1].stick = Vec2::Y;
    let raised: f32 =
        (0..90).flat_map(|_| stand.frame().placing).map(|change| if let PlacingChange::Raise(by) = change { by } else { 9.0 }).sum();
    assert!((raised - 0.5).abs() < 0.01, "{raised}");
    stand.input.hands[1].stick = Vec2::ZERO;

    (stand.input.hands[0].squeeze, stand.input.hands[1].squeeze) = (1.0, 1.0);
    assert!(stand.frame().placing.is_empty());
    let mut placing = Placing::default();
    // The hands go to twice their distance in the room; poses come as the placing makes them.
    for step in 0..=20u8 {
        for (hand, x) in [(0, -1.0), (1, 1.0)] {
            let in_room = at(Vec3::new(x * (1.0 + f32::from(step) / 20.0), -0.3, -0.3));
            stand.both(hand, placing.in_world(&in_room));
        }
        stand.frame().placing.into_iter().for_each(|change| placing.change(change, &Pose::IDENTITY));
    }
    assert!((placing.scale() - 0.5).abs() < 0.01, "the viewer is {} times as large", placing.scale());
}

#[test]
fn what_another_user_removes_slips_out_of_the_hand() {
    let mut stand = Stand::new();
    stand.both(1, at(Vec3::new(0.3, -0.3, -0.5)));
    stand.squeeze(1, 1.0);
    stand.world.things.clear();
    let wished = stand.wished.len();
    stand.lead(1, Vec3::ZERO, 3);
    stand.squeeze(1, 0.0);
    assert_eq!(stand.wished.len(), wished);
}

/// Any numbers at all: what is wished for is within the bounds of the wire (`Stand::frame` encodes it).
#[test]
fn senseless_input_makes_no_senseless_wish() {
    let mut stand = Stand::new();
    let mut state = 7u64;
    let mut random = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        state >> 33
    };
    for frame in 0..5_000u32 {
        for hand in 0..2 {
            let mut number = || match random() % 12 {
                0 => f32::NAN,
                1 => f32::INFINITY,
                2 => -1e30,
                3 => 1e-30,
                _ => random() as f32 / (1u64 << 30) as f32 - 1.0,
            };
            let mut pose = || Pose {
                position: Vec3::new(number(), number(), number()),
                orientation: Quat::from_xyzw(number(), number(), number(), number()),
            };
            let (grip, aim) = (Some(pose()), Some(pose()));
            let near = at(Vec3::new(0.3, -0.3, -0.5));
            stand.input.hands[hand] = HandInput {
                grip: if random() % 3 > 0 { Some(near) } else { grip },
                aim,
                select: (random() % 2) as f32,
                squeeze: (random() % 2) as f32,
                stick: Vec2::new(if random() % 9 == 0 { f32::NAN } else { 1.0 }, 1.0),
                menu: random() % 2 == 0,
            };
        }
        if random() % 50 == 0 {
            stand.input.now.0 += 1_000_000;
        }
        if frame % 16 == 0 {
            stand.world = Stand::new().world;
        }
        stand.frame();
    }
    let thrown = stand.wished.iter().filter(|action| matches!(action, Action::Release(..))).count();
    assert!(thrown > 50 && stand.wished.len() > 500, "{thrown} of {}", stand.wished.len());
}

#[test]
fn a_controller_that_is_gone_with_its_buttons_throws_nothing_and_presses_nothing() {
    let mut stand = Stand::new();
    stand.both(1, at(Vec3::new(0.3, -0.3, -0.5)));
    stand.squeeze(1, 1.0);
    stand.input.hands[1].menu = true;
    stand.lead(1, Vec3::new(0.3, 0.7, -0.5), 10);
    let lost = HandInput { select: f32::NAN, squeeze: f32::NAN, ..HandInput::default() };
    let held = std::mem::replace(&mut stand.input.hands[1], lost);
    // Longer than a long press of the menu takes.
    assert!((0..80).all(|_| stand.frame().actions.is_empty()), "{:?}", stand.wished);
    // Back within the second it goes on, and the menu's press is forgotten.
    stand.input.hands[1] = HandInput { menu: false, ..held };
    stand.frame();
    assert_eq!(stand.hands.held.len(), 1);
    // Gone for good with the menu down it is let go of, not removed, and nobody is recentred.
    stand.input.hands[1].menu = true;
    stand.frame();
    stand.input.hands[1] = lost;
    let wished = stand.wished.len();
    assert!((0..200).all(|_| stand.frame().placing.is_empty()));
    assert_eq!(stand.wished[wished..], [Action::Release(CUBE, Motion::STILL)]);
    assert!(stand.world.things.contains_key(&CUBE));
    let mut stand = Stand::new();
    stand.both(1, at(Vec3::new(0.3, -0.3, -0.5)));
    stand.squeeze(1, 1.0);
    stand.lead(1, Vec3::new(0.3, 0.7, -0.5), 10);
    stand.input.hands[1] = lost;
    let frames = (0..200).take_while(|_| !stand.frame().actions.contains(&Action::Release(CUBE, Motion::STILL))).count();
    assert!((89..=92).contains(&frames), "let go of after {frames} frames");
}

#[test]
fn hands_that_nobody_leads_any_more_let_go() {
    let mut stand = Stand::new();
    stand.both(1, at(Vec3::new(0.3, -0.3, -0.5)));
    stand.squeeze(1, 1.0);
    stand.lead(1, Vec3::new(0.3, 0.7, -0.5), 10);
    let last = stand.hands.last.unwrap();
    assert!(stand.hands.let_go_when_idle(ClientTime(last.0 + 900_000)).is_empty());
    assert_eq!(stand.hands.let_go_when_idle(ClientTime(last.0 + 1_100_000)), [Action::Release(CUBE, Motion::STILL)]);
    assert!(stand.hands.let_go_of_all().is_empty() && stand.hands.held.is_empty());
    // The button is still down: nothing is taken anew before it is pressed again.
    assert!(stand.frame().actions.is_empty());
}

#[test]
fn an_item_in_hand_is_put_away_with_its_library() {
    let mut stand = Stand::new();
    for menu in [true, false] {
        stand.input.hands[1].menu = menu;
        stand.frame();
    }
    assert_eq!(stand.hands.hands[1].palette.item(), Some(0));
    stand.world.library.truncate(1);
    stand.frame();
    assert_eq!(stand.hands.hands[1].palette.item(), Some(0), "the same item is the same");
    stand.world.library[0].name = "another".to_owned();
    stand.frame();
    assert_eq!(stand.hands.hands[1].palette.item(), None);
    // The hand is free.
    stand.both(1, at(Vec3::new(0.3, -0.3, -0.5)));
    stand.input.hands[1].select = 1.0;
    assert_eq!(stand.frame().actions, [Action::Grab(CUBE)]);
}
