//! Mouse and keys against a ground with one cube.

use mr360_protocol::scene::{Geometry, LibraryItem, Shape};

use super::*;
use crate::scene::mesh::Bounds;
use crate::scene::pick::{Target, nearest};

const CUBE: ObjectId = ObjectId(7);
const FRAME_US: u64 = 16_667;
const BOX: Bounds = Bounds { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) };

/// A ground at y = −1.6 and one cube in the middle of the lower half of the image.
struct Ground {
    library: Vec<LibraryItem>,
}

fn cube() -> Transform {
    Transform { position: Vec3::new(0.0, -1.1, -4.5), ..Transform::default() }
}

impl World for Ground {
    fn pick(&self, ray: &Ray) -> Option<(ObjectId, Vec3)> {
        nearest(ray, [Target { id: CUBE, transform: cube(), bounds: BOX, shape: Some(Shape::Cube) }])
    }
    fn transform(&self, _object: ObjectId) -> Option<Transform> {
        Some(cube())
    }
    fn object_bounds(&self, _object: ObjectId) -> Option<Bounds> {
        Some(BOX)
    }
    fn bounds(&self, _geometry: &Geometry) -> Option<Bounds> {
        Some(BOX)
    }
    fn library(&self) -> &[LibraryItem] {
        &self.library
    }
    fn ground_y(&self) -> f32 {
        -1.6
    }
}

/// Controls with the pointer on the cube.
struct Stand {
    controls: Controls,
    world: Ground,
    now: ClientTime,
}

const ON_CUBE: Vec2 = Vec2::new(400.0, 265.0);

impl Stand {
    fn new() -> Self {
        let mut controls = Controls::new();
        controls.resized(800, 400);
        let mut stand = Self { controls, world: Ground { library: LibraryItem::shapes() }, now: ClientTime(1_000_000) };
        stand.to(ON_CUBE);
        stand
    }

    fn to(&mut self, pointer: Vec2) {
        self.now.0 += FRAME_US;
        self.controls.moved(pointer, Some(&self.world), self.now);
    }

    fn press(&mut self) {
        self.controls.pressed(&self.world, self.now);
    }

    fn release(&mut self) {
        self.controls.released(self.now);
    }

    fn ground(&self) -> Vec3 {
        ground_point(&self.controls.ray(), &self.world).unwrap()
    }
}

#[test]
fn the_panorama_follows_the_pointer() {
    let mut stand = Stand::new();
    stand.to(Vec2::new(400.0, 20.0));
    let point = stand.controls.camera().ray(Vec2::ZERO, 2.0);
    stand.press();
    stand.to(Vec2::new(410.0, 24.0));
    // What was in the middle is now to the right and below it.
    let seen = stand.controls.camera().view_from_world().transform_vector3(point);
    assert!(seen.x > 0.0 && seen.y < 0.0, "{seen}");
    stand.release();
    let camera = stand.controls.camera();
    stand.to(Vec2::ZERO);
    assert_eq!(stand.controls.camera(), camera);
    assert_eq!(stand.controls.take_actions(), []);
}

#[test]
fn pitch_height_and_field_of_view_stay_in_range() {
    let mut stand = Stand::new();
    stand.to(Vec2::new(400.0, 20.0));
    stand.press();
    stand.to(Vec2::new(0.0, 1e6));
    let up = stand.controls.camera().ray(Vec2::ZERO, 1.0);
    assert!((up.y - MAX_PITCH_RAD.sin()).abs() < 1e-5);
    stand.release();
    for (notches, deg) in [(1e9, 30.0), (-1e9, 110.0), (f32::NAN, 110.0)] {
        (0..4).for_each(|_| stand.controls.wheel(notches, stand.now));
        let fov = crate::camera::FieldOfView::Vertical(stand.controls.fov_y_rad);
        assert_eq!(stand.controls.camera().fov, fov);
        assert!((stand.controls.fov_y_rad.to_degrees() - deg).abs() < 1e-3);
    }
    (0..3).for_each(|_| stand.controls.raise(true));
    assert!((stand.controls.camera().position.y - 0.3).abs() < 1e-6);
    (0..300).for_each(|_| stand.controls.raise(false));
    assert_eq!(stand.controls.camera().position.y, -MAX_HEIGHT_M);
    stand.controls.reset();
    assert_eq!(stand.controls.camera(), Camera::looking(0.0, 0.0, START_FOV_DEG.to_radians()));
}

#[test]
fn an_object_keeps_its_height_and_its_distance_to_the_pointer() {
    let mut stand = Stand::new();
    let grabbed = stand.ground();
    stand.press();
    stand.to(ON_CUBE + Vec2::new(20.0, 10.0));
    stand.to(ON_CUBE + Vec2::new(40.0, 20.0));
    let expected = cube().position + (stand.ground() - grabbed) * Vec3::new(1.0, 0.0, 1.0);
    let actions = stand.controls.take_actions();
    let [Action::Grab(CUBE), Action::Move(CUBE, to)] = actions[..] else { panic!("{actions:?}") };
    assert!((to.position - expected).length() < 1e-5);
    // Above the horizon there is no ground: it stays. Let go of after a rest it is not thrown.
    stand.to(Vec2::new(440.0, 20.0));
    stand.now.0 += 500_000;
    stand.release();
    assert_eq!(stand.controls.take_actions(), [Action::Release(CUBE, Motion::STILL)]);
}

#[test]
fn let_go_of_in_motion_it_is_thrown_the_way_it_went() {
    let mut stand = Stand::new();
    stand.press();
    (1..=10u8).for_each(|step| stand.to(ON_CUBE + Vec2::X * 8.0 * f32::from(step)));
    stand.release();
    let actions = stand.controls.take_actions();
    let Some(Action::Release(CUBE, motion)) = actions.last() else { panic!("{actions:?}") };
    // Eight pixels a frame at the distance of the ground under the pointer.
    let metres = (2.0 * (START_FOV_DEG.to_radians() * 0.5).tan()) / 400.0 * 8.0 * -stand.ground().z;
    let expected = metres / (FRAME_US as f32 * 1e-6);
    assert!((motion.linear.x / expected - 1.0).abs() < 0.02 && motion.linear.y == 0.0, "{motion:?}, not {expected}");
}

#[test]
fn shift_lifts_the_wheel_scales_and_the_right_button_turns() {
    let mut stand = Stand::new();
    stand.press();
    stand.controls.set_lifting(true);
    stand.to(ON_CUBE - Vec2::Y * 50.0);
    let [Action::Grab(CUBE), Action::Move(CUBE, lifted)] = stand.controls.take_actions()[..] else { panic!() };
    let metres = (2.0 * (START_FOV_DEG.to_radians() * 0.5).tan()) / 400.0 * 50.0 * 4.5;
    assert!((lifted.position - cube().position - Vec3::Y * metres).length() < 1e-3, "{lifted:?}");
    // Shift up again: from there over the ground, without a jump.
    stand.controls.set_lifting(false);
    stand.to(ON_CUBE - Vec2::Y * 50.0 + Vec2::X * 0.01);
    let [Action::Move(CUBE, after)] = stand.controls.take_actions()[..] else { panic!() };
    assert!((after.position - lifted.position).length() < 0.01, "{after:?}");
    stand.controls.wheel(2.0, stand.now);
    let [Action::Move(CUBE, larger)] = stand.controls.take_actions()[..] else { panic!() };
    assert!((larger.scale - Vec3::splat(ZOOM * ZOOM)).length() < 1e-5);
    stand.controls.turn_pressed(&stand.world, stand.now);
    let pointer = stand.controls.pointer;
    stand.to(pointer + Vec2::X * 100.0);
    let [Action::Move(CUBE, turned)] = stand.controls.take_actions()[..] else { panic!() };
    assert!((turned.rotation * Vec3::Z).distance(Quat::from_rotation_y(TURN_RAD / 4.0) * Vec3::Z) < 1e-5);
    assert_eq!(turned.position, larger.position);
    stand.controls.turn_released(true, stand.now);
    assert_eq!(stand.controls.take_actions(), [], "the left button still holds it");
    stand.release();
    // The right button alone takes and lets go, too.
    stand.controls.take_actions();
    stand.to(ON_CUBE);
    stand.controls.turn_pressed(&stand.world, stand.now);
    stand.to(ON_CUBE + Vec2::Y * 40.0);
    stand.now.0 += 500_000;
    stand.controls.turn_released(false, stand.now);
    let actions = stand.controls.take_actions();
    assert!(matches!(actions[..], [Action::Grab(CUBE), Action::Move(..), Action::Release(CUBE, Motion::STILL)]), "{actions:?}");
}

#[test]
fn keys_turn_snap_and_remove_what_is_under_the_pointer() {
    let mut stand = Stand::new();
    stand.controls.turn(true, &stand.world, stand.now);
    let actions = stand.controls.take_actions();
    let [Action::Grab(CUBE), Action::Move(CUBE, turned), Action::Release(CUBE, Motion::STILL)] = actions[..] else { panic!("{actions:?}") };
    assert!((turned.rotation.to_axis_angle().1 - KEY_TURN_RAD).abs() < 1e-4);
    stand.controls.snap(&stand.world, stand.now);
    let actions = stand.controls.take_actions();
    let [Action::Grab(CUBE), Action::Move(CUBE, stands), Action::Release(CUBE, Motion::STILL)] = actions[..] else { panic!("{actions:?}") };
    assert!((stands.position.y - (-1.1)).abs() < 2e-3);
    // Held, it is stood and let go of.
    stand.press();
    stand.controls.snap(&stand.world, stand.now);
    stand.release();
    assert!(matches!(stand.controls.take_actions()[..], [Action::Grab(CUBE), Action::Move(..), Action::Release(CUBE, Motion::STILL)]));
    stand.press();
    stand.controls.remove(&stand.world);
    stand.release();
    assert_eq!(stand.controls.take_actions(), [Action::Grab(CUBE), Action::Remove(CUBE)]);
    stand.controls.remove(&stand.world);
    assert_eq!(stand.controls.take_actions(), [Action::Remove(CUBE)]);
    stand.to(Vec2::new(400.0, 20.0));
    stand.controls.remove(&stand.world);
    stand.controls.snap(&stand.world, stand.now);
    assert_eq!(stand.controls.take_actions(), []);
}

#[test]
fn an_item_is_chosen_shown_and_put_where_the_pointer_is() {
    let mut stand = Stand::new();
    stand.to(Vec2::new(100.0, 320.0));
    assert_eq!(stand.controls.drawn(&stand.world), []);
    stand.controls.choose(None, &stand.world);
    assert_eq!(stand.controls.in_hand(&stand.world), Some("ball"));
    stand.controls.choose(Some(1), &stand.world);
    assert_eq!(stand.controls.in_hand(&stand.world), Some("cube"));
    let ghost = stand.controls.drawn(&stand.world).remove(0);
    assert_eq!(ghost.geometry, stand.world.library[1].geometry);
    let foot = ghost.transform.position - Vec3::Y * 0.15;
    assert!(foot.distance(stand.ground()) < 2e-3, "{foot}");
    stand.controls.wheel(1.0, stand.now);
    stand.press();
    stand.release();
    let actions = stand.controls.take_actions();
    let [Action::Put { item: 1, transform }] = actions[..] else { panic!("{actions:?}") };
    assert!((transform.scale.x - 0.3 * ZOOM).abs() < 1e-5);
    // On the cube's upper side.
    stand.to(Vec2::new(400.0, 235.0));
    let on_cube = stand.controls.drawn(&stand.world).remove(0).transform.position;
    assert!((on_cube.y - (-0.6 + 0.15 * ZOOM)).abs() < 3e-3, "{on_cube}");
    assert!(stand.controls.close_palette() && !stand.controls.close_palette());
    assert_eq!(stand.controls.in_hand(&stand.world), None);
    stand.controls.choose(Some(9), &stand.world);
    assert_eq!(stand.controls.drawn(&stand.world), []);
}
