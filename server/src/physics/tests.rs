//! Falling and flying in closed form, rest, stacks, and the same bits every time.

use glam::{Quat, Vec3};
use mr360_protocol::asset::AssetId;
use mr360_protocol::intent::{MAX_SPEED_M_S, Motion};
use mr360_protocol::scene::{Geometry, MAX_POSITION_M, Object, ObjectId, PlaceMesh, Scene, Shape, Transform};

use super::crowd::{MAX_PAIRS, MAX_TRIANGLES};
use super::{Forms, LINEAR_DAMPING, Physics, STEP_S, test_models};

const GROUND_Y: f32 = -1.6;
const G: f32 = 9.81;
/// Of the solver, by its own default.
const SUBSTEPS: usize = 4;
/// Solvers let bodies sink in by about their slop.
const SLOP_M: f32 = 0.01;

fn at(position: Vec3) -> Transform {
    Transform { position, ..Transform::default() }
}

fn object(id: u32, shape: Shape, transform: Transform) -> Object {
    Object { id: ObjectId(id), geometry: Geometry::Shape(shape), transform, material: None, animation: Default::default() }
}

fn physics(objects: Vec<Object>) -> Physics {
    Physics::new(&Scene { ground_y: GROUND_Y, objects, ..Scene::default() }, |_| false, Forms::default())
}

fn place(physics: &Physics, id: u32) -> Transform {
    physics.bodies[&ObjectId(id)].transform
}

/// Takes hold of an object, brings it somewhere and lets go.
fn let_go(physics: &mut Physics, id: u32, from: Transform, motion: Motion) {
    physics.hold(ObjectId(id));
    physics.move_to(ObjectId(id), from);
    physics.step();
    physics.release(ObjectId(id), motion);
}

fn settle(physics: &mut Physics) -> usize {
    let steps = (0..3_000)
        .take_while(|_| {
            !physics.at_rest() && {
                physics.step();
                true
            }
        })
        .count();
    assert!(physics.at_rest(), "still moving after {steps} steps: {:?}", physics.step());
    steps
}

#[test]
fn what_hangs_in_the_air_stays_there_until_it_was_touched_and_then_rests_on_the_ground() {
    for (shape, rest) in [(Shape::Sphere, 0.5), (Shape::Cube, 0.5), (Shape::Cylinder, 0.5), (Shape::Plane, 0.02)] {
        let hanging = at(Vec3::new(0.0, 1.0, -3.0));
        let mut physics = physics(vec![object(1, shape, hanging), object(2, shape, at(Vec3::new(5.0, 1.0, -3.0)))]);
        assert!(physics.at_rest() && physics.step().is_empty(), "{shape:?}");
        physics.hold(ObjectId(1));
        physics.step();
        physics.release(ObjectId(1), Motion::STILL);
        settle(&mut physics);
        let low = place(&physics, 1).position;
        assert!((low.y - (GROUND_Y + rest)).abs() < SLOP_M, "{shape:?} rests at {}", low.y);
        assert_eq!(place(&physics, 2).position, Vec3::new(5.0, 1.0, -3.0), "{shape:?}: its neighbour fell, too");
        assert!(physics.step().is_empty());
    }
}

#[test]
fn what_is_thrown_flies_a_parabola() {
    let mut physics = physics(vec![object(1, Shape::Sphere, at(Vec3::ZERO))]);
    let velocity = Vec3::new(3.0, 4.0, -2.0);
    let start = Vec3::new(1.0, 2.0, 3.0);
    let_go(&mut physics, 1, at(start), Motion { linear: velocity, angular: Vec3::ZERO });
    let steps = 36;
    (0..steps).for_each(|_| drop(physics.step()));
    // As the solver sums up: speed first, in substeps; air takes its share at the end of each step.
    let substep = STEP_S / SUBSTEPS as f32;
    let (mut expected, mut speed) = (start, velocity);
    for _ in 0..steps {
        for _ in 0..SUBSTEPS {
            speed -= Vec3::Y * (G * substep);
            expected += speed * substep;
        }
        speed /= 1.0 + STEP_S * LINEAR_DAMPING;
    }
    let there = place(&physics, 1).position;
    assert!(there.distance(expected) < 1e-3, "{there} for {expected}");
    // The closed form without air.
    let t = steps as f32 * STEP_S;
    let parabola = start + velocity * t - Vec3::Y * (0.5 * G * t * t);
    assert!(there.distance(parabola) < 0.025 * t * velocity.length() + 0.05, "{there} for {parabola}");
}

#[test]
fn a_spin_keeps_its_axis_and_its_sense() {
    let mut physics = physics(vec![object(1, Shape::Cube, at(Vec3::ZERO))]);
    let_go(&mut physics, 1, at(Vec3::Y * 3.0), Motion { linear: Vec3::Y * 3.0, angular: Vec3::Y * 2.0 });
    (0..15).for_each(|_| drop(physics.step()));
    let (axis, angle) = place(&physics, 1).rotation.to_axis_angle();
    assert!(axis.distance(Vec3::Y) < 1e-3 && (0.35..=0.5).contains(&angle), "{axis} {angle}");
}

#[test]
fn cubes_stay_stacked_and_fall_when_their_foot_is_taken_away() {
    let cube = |id, level: f32| object(id, Shape::Cube, Transform { scale: Vec3::splat(0.3), ..at(Vec3::new(0.0, level, -2.0)) });
    let mut physics = physics((1..=4).map(|id| cube(id, id as f32)).collect());
    for id in 1..=4u16 {
        let height = GROUND_Y + 0.15 + 0.3 * f32::from(id - 1) + 0.005;
        let on_top = Transform { scale: Vec3::splat(0.3), ..at(Vec3::new(0.01 * f32::from(id), height, -2.0)) };
        let_go(&mut physics, id.into(), on_top, Motion::STILL);
        settle(&mut physics);
    }
    for id in 1..=4u16 {
        let height = GROUND_Y + 0.15 + 0.3 * f32::from(id - 1);
        let there = place(&physics, id.into()).position;
        assert!((there.y - height).abs() < 2.0 * SLOP_M && (there.x - 0.01 * f32::from(id)).abs() < 0.01, "cube {id} is at {there}");
    }
    physics.remove(ObjectId(1));
    settle(&mut physics);
    let lowest = place(&physics, 2).position.y;
    assert!((lowest - (GROUND_Y + 0.15)).abs() < 0.01, "{lowest}");

    // Held and drawn away, too.
    physics.hold(ObjectId(2));
    physics.move_to(ObjectId(2), at(Vec3::new(9.0, 0.0, 9.0)));
    settle(&mut physics);
    assert!((place(&physics, 3).position.y - (GROUND_Y + 0.15)).abs() < 0.01, "{}", place(&physics, 3).position);
    assert_eq!(place(&physics, 2).position, Vec3::new(9.0, 0.0, 9.0));
}

#[test]
fn what_is_hit_falls_and_what_is_fixed_does_not() {
    for fixed in [false, true] {
        let objects = vec![object(1, Shape::Sphere, at(Vec3::ZERO)), object(2, Shape::Cube, at(Vec3::new(3.0, 2.0, 0.0)))];
        let scene = Scene { ground_y: GROUND_Y, objects, ..Scene::default() };
        let mut physics = Physics::new(&scene, |id| fixed && id == ObjectId(2), Forms::default());
        let_go(&mut physics, 1, at(Vec3::Y * 2.0), Motion { linear: Vec3::new(10.0, 1.0, 0.0), angular: Vec3::ZERO });
        settle(&mut physics);
        let hit = place(&physics, 2).position;
        let ball = place(&physics, 1).position;
        if fixed {
            assert_eq!(hit, Vec3::new(3.0, 2.0, 0.0));
            assert!(ball.x < 3.0, "the ball went through to {ball}");
            // A fixed thing can be moved by hand and stays where it is left.
            let_go(&mut physics, 2, at(Vec3::Y * 5.0), Motion { linear: Vec3::X * 9.0, angular: Vec3::X });
            settle(&mut physics);
            assert_eq!(place(&physics, 2), at(Vec3::Y * 5.0));
        } else {
            assert!(hit.x > 3.1 && (hit.y - (GROUND_Y + 0.5)).abs() < 0.3, "{hit}");
        }
    }
}

#[test]
fn a_held_thing_pushes_and_one_that_jumps_does_not() {
    let cubes = || {
        let at_foot = |x: f32| at(Vec3::new(x, GROUND_Y + 0.5, 0.0));
        let mut physics = physics(vec![object(1, Shape::Cube, at_foot(-2.0)), object(2, Shape::Cube, at_foot(0.0))]);
        physics.hold(ObjectId(1));
        (physics, at_foot)
    };
    let (mut physics, at_foot) = cubes();
    for step in 0..=50u8 {
        physics.move_to(ObjectId(1), at_foot(-2.0 + 0.1 * f32::from(step)));
        physics.step();
    }
    settle(&mut physics);
    let other = place(&physics, 2).position;
    assert!(other.x > 3.9, "it was pushed to {other} only");
    // In touch, then as after a gap of the network: 30 m/s, if it were a push.
    let (mut physics, at_foot) = cubes();
    for x in [-1.01, -1.0, -0.5] {
        physics.move_to(ObjectId(1), at_foot(x));
        (0..if x < -0.9 { 20 } else { 1 }).for_each(|_| drop(physics.step()));
    }
    settle(&mut physics);
    let other = place(&physics, 2).position;
    assert!((0.2..1.0).contains(&other.x), "it was flung to {other}");
}

#[test]
fn a_held_thing_grows() {
    let mut physics = physics(vec![object(1, Shape::Cube, at(Vec3::ZERO))]);
    let large = Transform { scale: Vec3::new(1.0, 3.0, 1.0), ..at(Vec3::Y * 2.0) };
    let_go(&mut physics, 1, large, Motion::STILL);
    settle(&mut physics);
    let rest = place(&physics, 1);
    assert!((rest.position.y - (GROUND_Y + 1.5)).abs() < SLOP_M && rest.scale == large.scale, "{rest:?}");
    // Not round any more.
    for shape in [Shape::Sphere, Shape::Cylinder] {
        let mut physics = self::physics(vec![object(1, shape, at(Vec3::ZERO))]);
        let flat = Transform { scale: Vec3::new(2.0, 0.4, 1.0), ..at(Vec3::ZERO) };
        let_go(&mut physics, 1, flat, Motion::STILL);
        settle(&mut physics);
        let rest = place(&physics, 1).position.y;
        assert!((rest - (GROUND_Y + 0.2)).abs() < 0.02, "{shape:?} rests at {rest}");
    }
}

#[test]
fn nothing_leaves_the_world_or_passes_its_speed() {
    let edge = MAX_POSITION_M - 1.0;
    let mut physics = physics(vec![object(1, Shape::Sphere, at(Vec3::ZERO))]);
    let wild = Motion { linear: Vec3::new(1e9, 5.0, 0.0), angular: Vec3::splat(1e9) };
    let_go(&mut physics, 1, at(Vec3::new(edge, 5.0, 0.0)), wild.bounded());
    let moved = physics.step();
    assert!(moved.iter().all(|(_, to)| (to.position.x - edge).abs() <= MAX_SPEED_M_S * STEP_S * 1.01), "{moved:?}");
    let mut farthest = edge;
    while !physics.at_rest() {
        physics.step();
        place(&physics, 1).validate("object").unwrap();
        farthest = farthest.max(place(&physics, 1).position.x);
    }
    assert_eq!(farthest, MAX_POSITION_M);
    // Begun under the ground it comes up.
    let_go(&mut physics, 1, at(Vec3::new(0.0, GROUND_Y - 0.3, 0.0)), Motion::STILL);
    settle(&mut physics);
    assert!((place(&physics, 1).position.y - (GROUND_Y + 0.5)).abs() < SLOP_M);
}

#[test]
fn what_is_scaled_often_between_two_steps_is_formed_once() {
    let mut physics = physics(vec![object(1, Shape::Cube, at(Vec3::ZERO))]);
    let id = ObjectId(1);
    physics.hold(id);
    let before = physics.bodies[&id].collider;
    for i in 1..100u8 {
        physics.move_to(id, Transform { scale: Vec3::splat(1.0 + f32::from(i) * 0.01), ..at(Vec3::ZERO) });
    }
    assert_eq!(physics.bodies[&id].collider, before);
    physics.step();
    let collider = physics.bodies[&id].collider.unwrap();
    assert_ne!(Some(collider), before);
    let half = physics.world.colliders[collider].shape().as_cuboid().unwrap().half_extents.x;
    assert!((half - 0.995).abs() < 1e-5, "{half}");
    physics.step();
    assert_eq!(physics.bodies[&id].collider, Some(collider));
}

#[test]
fn a_crowd_in_one_place_costs_no_more_than_its_bound_and_can_be_taken_apart() {
    let mut physics = physics(Vec::new());
    let here = at(Vec3::new(0.0, 1.0, -3.0));
    for id in 1..=1024 {
        physics.add(&object(id, Shape::Cube, here), false);
    }
    for _ in 0..10 {
        for (_, moved) in physics.step() {
            moved.validate("object").unwrap();
        }
        let pairs = physics.world.contact_pairs().count();
        // Those that were let in grow apart, the ground beside.
        assert!(pairs <= MAX_PAIRS + 1024, "{pairs} pairs");
    }
    assert!(place(&physics, 1) != here, "those that are let in move");
    assert_eq!(place(&physics, 1024), here, "it hangs");
    // Taken out of the crowd it is a thing like any other.
    let_go(&mut physics, 1024, at(Vec3::new(500.0, 0.0, 0.0)), Motion::STILL);
    (0..200).for_each(|_| drop(physics.step()));
    assert!((place(&physics, 1024).position.y - (GROUND_Y + 0.5)).abs() < SLOP_M, "{:?}", place(&physics, 1024));
}

#[test]
fn what_hung_for_a_crowd_comes_back_when_there_is_room() {
    let here = at(Vec3::new(0.0, 1.0, -3.0));
    // Of 128 in one place each meets each other: 8128 pairs, and the next one would be too many.
    let count = 140;
    let crowd = || {
        let mut physics = physics(Vec::new());
        (1..=count).for_each(|id| physics.add(&object(id, Shape::Cube, here), false));
        physics.step();
        physics
    };
    let hanging =
        |physics: &Physics| physics.bodies.iter().filter(|(_, body)| body.hangs.is_some()).map(|(id, _)| id.0).collect::<Vec<_>>();
    let mut physics = crowd();
    assert_eq!(hanging(&physics), (129..=count).collect::<Vec<_>>());
    // The crowd is taken away.
    (1..=128).for_each(|id| physics.remove(ObjectId(id)));
    physics.step();
    assert!(hanging(&physics).is_empty(), "{:?}", hanging(&physics));
    settle(&mut physics);
    assert!((129..=count).all(|id| place(&physics, id) != here), "some are still where they hung");
    // It falls apart by itself, the same way each time, and the world does not go to rest before.
    let fall_apart = || {
        let mut physics = crowd();
        let mut steps = 0;
        while !hanging(&physics).is_empty() && !physics.at_rest() && steps < 3_000 {
            physics.step();
            steps += 1;
        }
        assert!(hanging(&physics).is_empty(), "{:?} hang after {steps} steps", hanging(&physics));
        (1..=count).map(|id| place(&physics, id)).collect::<Vec<_>>()
    };
    assert_eq!(fall_apart(), fall_apart());
}

#[test]
fn what_lies_in_too_much_of_the_place_hangs_and_a_small_thing_rests_on_it() {
    let floor = AssetId::of(b"floor");
    let mesh = PlaceMesh { model: floor, transform: at(Vec3::ZERO), casts_shadows: true, gloss: Default::default() };
    let scene = Scene {
        ground_y: GROUND_Y,
        objects: vec![object(1, Shape::Cube, at(Vec3::Y * 2.0)), object(2, Shape::Cube, at(Vec3::new(30.0, 2.0, 0.0)))],
        place: vec![mesh],
        ..Scene::default()
    };
    let side = 120;
    assert!(2 * usize::from(side) * usize::from(side) > MAX_TRIANGLES);
    let forms = Forms::read(&scene, |_| Some(test_models::grid(side)));
    let mut physics = Physics::new(&scene, |_| false, forms);
    let huge = Transform { scale: Vec3::new(500.0, 1.0, 500.0), ..at(Vec3::Y * 0.4) };
    let_go(&mut physics, 1, huge, Motion::STILL);
    settle(&mut physics);
    assert_eq!(place(&physics, 1), huge);
    physics.remove(ObjectId(1));
    let_go(&mut physics, 2, at(Vec3::new(30.0, 2.0, 0.0)), Motion::STILL);
    settle(&mut physics);
    assert!((place(&physics, 2).position.y - 0.5).abs() < SLOP_M, "{:?}", place(&physics, 2));
}

#[test]
fn models_and_places_without_bounds_take_no_part() {
    let (far, vast) = (AssetId::of(b"far"), AssetId::of(b"vast"));
    let transform = Transform { scale: Vec3::splat(1000.0), ..at(Vec3::ZERO) };
    let scene = Scene {
        ground_y: GROUND_Y,
        objects: vec![Object { geometry: Geometry::Model(vast), ..object(1, Shape::Cube, transform) }],
        place: vec![PlaceMesh { model: far, transform, casts_shadows: true, gloss: Default::default() }],
        ..Scene::default()
    };
    let forms = Forms::read(&scene, |id| Some(if id == vast { pyramid(2.0, 2.0) } else { pyramid(100.0, 1.0) }));
    let mut physics = Physics::new(&scene, |_| false, forms);
    assert!(physics.place.is_empty() && physics.bodies[&ObjectId(1)].collider.is_none());
    // Made small, it is a body.
    let_go(&mut physics, 1, at(Vec3::Y), Motion::STILL);
    settle(&mut physics);
    assert!((place(&physics, 1).position.y - GROUND_Y).abs() < SLOP_M, "{:?}", place(&physics, 1));
}

/// A pyramid of the given foot, as a .gltf.
fn pyramid(foot: f32, height: f32) -> bytes::Bytes {
    let corners = [[-foot, 0.0, -foot], [foot, 0.0, -foot], [foot, 0.0, foot], [-foot, 0.0, foot], [0.0, height, 0.0]];
    let faces = [[0, 4, 1], [1, 4, 2], [2, 4, 3], [3, 4, 0], [0, 1, 2], [0, 2, 3]];
    test_models::bytes(&test_models::gltf(&corners, &faces))
}

#[test]
fn models_have_their_hull_the_place_its_triangles_and_broken_ones_take_no_part() {
    let [tent, table, broken] = [b"tent", b"desk", b"oops"].map(|name| AssetId::of(name));
    let model = |id, asset, transform| Object { geometry: Geometry::Model(asset), ..object(id, Shape::Cube, transform) };
    let on_table = Transform { position: Vec3::new(0.0, 0.4, 0.0), rotation: Quat::from_rotation_y(0.3), scale: Vec3::ONE };
    let hidden = Transform { position: Vec3::new(0.0, GROUND_Y, 0.0), ..Transform::default() };
    let scene = Scene {
        ground_y: GROUND_Y,
        objects: vec![model(1, tent, on_table), model(2, broken, at(Vec3::new(0.0, 0.2, 0.0)))],
        // Its upper side 0.6 m above the ground, upside down.
        place: vec![PlaceMesh {
            model: table,
            transform: Transform {
                position: hidden.position + Vec3::Y * 0.6,
                rotation: Quat::from_rotation_x(std::f32::consts::PI),
                ..hidden
            },
            casts_shadows: true,
            gloss: Default::default(),
        }],
        ..Scene::default()
    };
    let forms = Forms::read(&scene, |id| match id {
        id if id == tent => Some(pyramid(0.2, 0.3)),
        id if id == table => Some(pyramid(1.0, 0.6)),
        _ => Some(bytes::Bytes::from_static(b"{}")),
    });
    let mut physics = Physics::new(&scene, |_| false, forms);
    let_go(&mut physics, 1, on_table, Motion::STILL);
    settle(&mut physics);
    let rest = place(&physics, 1).position;
    assert!((rest.y - (GROUND_Y + 0.6)).abs() < SLOP_M, "{rest}");
    let_go(&mut physics, 2, at(Vec3::Y), Motion { linear: Vec3::X, angular: Vec3::ZERO });
    settle(&mut physics);
    assert_eq!(place(&physics, 2), at(Vec3::Y));
}

/// Ten seconds of throws, pushes and growth of twelve things, and where all ends; `idle` steps come before.
fn tumult(seed: u64, idle: usize) -> Vec<(ObjectId, [u32; 10])> {
    let shapes = [Shape::Sphere, Shape::Cube, Shape::Cylinder, Shape::Plane];
    let scattered = |id: u32| at(Vec3::new(id as f32 % 4.0 - 2.0, 0.7 * (id / 4) as f32, -3.0));
    let mut physics = physics((0..12).map(|id| object(id, shapes[id as usize % 4], scattered(id))).collect());
    (0..idle).for_each(|_| drop(physics.step()));
    let mut state = seed;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 24) as f32 * 2.0 - 1.0
    };
    for step in 0..600u32 {
        let id = ObjectId(step / 20 % 12);
        match step % 20 {
            0 => physics.hold(id),
            19 => {
                let linear = Vec3::new(random(), random(), random()) * 6.0;
                physics.release(id, Motion { linear, angular: Vec3::new(random(), random(), random()) * 5.0 });
            }
            _ => {
                let position = Vec3::new(random(), random(), random() - 3.0);
                physics.move_to(id, Transform { scale: Vec3::splat(0.5 + 0.4 * random()), ..at(position) });
            }
        }
        for (_, transform) in physics.step() {
            transform.validate("object").unwrap();
        }
    }
    settle(&mut physics);
    let bits = |t: Transform| {
        let mut all = [0; 10];
        let numbers = t.position.to_array().into_iter().chain(t.rotation.to_array()).chain(t.scale.to_array());
        all.iter_mut().zip(numbers).for_each(|(to, from)| *to = from.to_bits());
        all
    };
    physics.bodies.iter().map(|(id, body)| (*id, bits(body.transform))).collect()
}

/// Of the end of `tumult(1, 0)`, as x86-64 has it; every machine and profile has to have the same. It changes with the solver's version and
/// with the constants of [`super`] alone.
const TUMULT_ENDS: u64 = 453_723_803_171_685_323;

#[test]
fn the_same_wishes_end_in_the_same_bits() {
    let first = tumult(1, 0);
    // FNV-1a.
    let numbers = first.iter().flat_map(|(id, bits)| std::iter::once(id.0).chain(*bits));
    let hash = numbers.fold(0xcbf2_9ce4_8422_2325_u64, |hash, number| (hash ^ u64::from(number)).wrapping_mul(0x0100_0000_01b3));
    assert_eq!(hash, TUMULT_ENDS, "{first:?}");
    assert_eq!(first, tumult(1, 0));
    assert_eq!(first, tumult(1, 77), "steps in which nothing was to be done changed the end");
    assert_ne!(first, tumult(2, 0));
}
