//! What mouse and keys do. No window in here.

use glam::{Vec2, Vec3};
use mr360_protocol::scene::ObjectId;

use crate::camera::Camera;
use crate::frame_loop::Stage;

/// Field of view at the start, degrees.
const START_FOV_DEG: f32 = 75.0;
/// Narrowest and widest field of view, degrees.
const FOV_DEG: std::ops::RangeInclusive<f32> = 30.0..=110.0;
/// Field of view changes by this factor for every notch of the wheel.
const ZOOM: f32 = 1.08;
/// Highest and lowest look: straight up and down would leave yaw without meaning.
const MAX_PITCH_RAD: f32 = 89.0 * std::f32::consts::PI / 180.0;
/// Farther away the ground runs so flat that a pixel is metres.
const MAX_REACH_M: f32 = 50.0;

/// What the user does to the shared scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum UserAction {
    /// Holds an object: others cannot take it meanwhile.
    Grab(ObjectId),
    /// Wants it at this position, metres.
    Move(ObjectId, Vec3),
    /// Lets go of it.
    Release(ObjectId),
}

/// What the pressed button does.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Drag {
    Nothing,
    /// The panorama follows the pointer.
    Look,
    /// An object follows the pointer on the ground; `offset` is its position less the ground point it was grabbed at.
    Object {
        id: ObjectId,
        offset: Vec3,
        height: f32,
    },
}

/// Where the user looks, and what the pointer holds.
#[derive(Debug)]
pub(super) struct Controls {
    yaw_rad: f32,
    pitch_rad: f32,
    fov_y_rad: f32,
    /// Pixels from the top left.
    pointer: Vec2,
    size: Vec2,
    drag: Drag,
    /// At most one a frame: the newest position is all that counts.
    moved: Option<(ObjectId, Vec3)>,
    actions: Vec<UserAction>,
}

impl Controls {
    pub(super) fn new() -> Self {
        Self {
            yaw_rad: 0.0,
            pitch_rad: 0.0,
            fov_y_rad: START_FOV_DEG.to_radians(),
            pointer: Vec2::ZERO,
            size: Vec2::ONE,
            drag: Drag::Nothing,
            moved: None,
            actions: Vec::new(),
        }
    }

    pub(super) fn camera(&self) -> Camera {
        Camera::looking(self.yaw_rad, self.pitch_rad, self.fov_y_rad)
    }

    pub(super) fn resized(&mut self, width: u32, height: u32) {
        self.size = Vec2::new(width.max(1) as f32, height.max(1) as f32);
    }

    /// Looks straight ahead again.
    pub(super) fn reset(&mut self) {
        (self.yaw_rad, self.pitch_rad, self.fov_y_rad) = (0.0, 0.0, START_FOV_DEG.to_radians());
    }

    /// Positive notches narrow the view.
    pub(super) fn zoomed(&mut self, notches: f32) {
        if notches.is_finite() {
            let fov_deg = self.fov_y_rad.to_degrees() / ZOOM.powf(notches.clamp(-20.0, 20.0));
            self.fov_y_rad = fov_deg.clamp(*FOV_DEG.start(), *FOV_DEG.end()).to_radians();
        }
    }

    pub(super) fn pressed(&mut self, stage: &impl Stage) {
        self.released();
        let camera = self.camera();
        let Some(id) = stage.pick(&camera, self.ndc(), self.aspect()) else {
            self.drag = Drag::Look;
            return;
        };
        let ground = self.ground(stage);
        let position = stage.position(id).or(ground).unwrap_or(Vec3::ZERO);
        // Grabbed above the horizon or far out, it comes to the pointer at its first move.
        let offset = ground.map_or(Vec3::ZERO, |ground| position - ground);
        self.drag = Drag::Object { id, offset, height: position.y };
        self.actions.push(UserAction::Grab(id));
    }

    pub(super) fn released(&mut self) {
        if let Drag::Object { id, .. } = std::mem::replace(&mut self.drag, Drag::Nothing) {
            self.flush_move();
            self.actions.push(UserAction::Release(id));
        }
    }

    /// The pointer is at `to`, pixels from the top left.
    pub(super) fn moved(&mut self, to: Vec2, stage: Option<&impl Stage>) {
        let by = to - self.pointer;
        self.pointer = to;
        match self.drag {
            Drag::Nothing => {}
            Drag::Look => {
                let rad_per_pixel = self.fov_y_rad / self.size.y;
                self.yaw_rad = (self.yaw_rad + by.x * rad_per_pixel).rem_euclid(std::f32::consts::TAU);
                self.pitch_rad = (self.pitch_rad + by.y * rad_per_pixel).clamp(-MAX_PITCH_RAD, MAX_PITCH_RAD);
            }
            Drag::Object { id, offset, height } => {
                if let Some(ground) = stage.and_then(|stage| self.ground(stage)) {
                    let position = ground + offset;
                    self.moved = Some((id, Vec3::new(position.x, height, position.z)));
                }
            }
        }
    }

    /// What happened since the last call, in order.
    pub(super) fn take_actions(&mut self) -> Vec<UserAction> {
        self.flush_move();
        std::mem::take(&mut self.actions)
    }

    fn flush_move(&mut self) {
        if let Some((id, position)) = self.moved.take() {
            self.actions.push(UserAction::Move(id, position));
        }
    }

    fn ground(&self, stage: &impl Stage) -> Option<Vec3> {
        let point = stage.ground_point(&self.camera(), self.ndc(), self.aspect())?;
        (point.is_finite() && point.length() <= MAX_REACH_M).then_some(point)
    }

    fn ndc(&self) -> Vec2 {
        let unit = self.pointer / self.size;
        Vec2::new(unit.x * 2.0 - 1.0, 1.0 - unit.y * 2.0)
    }

    fn aspect(&self) -> f32 {
        self.size.x / self.size.y
    }
}

#[cfg(test)]
mod tests {
    use mr360_protocol::light::LightFrame;

    use super::*;
    use crate::frame_loop::{Drawn, FrameError, Shot};
    use crate::sync::Paired;

    /// A ground at y = −1.6 and one object in the middle of the lower half of the image.
    struct Ground;

    const CUBE: ObjectId = ObjectId(7);

    impl Stage for Ground {
        fn prepare(&mut self) -> Result<bool, FrameError> {
            Ok(false)
        }
        fn update(&mut self, _paired: Paired) -> Result<(), FrameError> {
            Ok(())
        }
        fn relight(&mut self, _light: &LightFrame) -> bool {
            false
        }
        fn draw(&mut self, _shots: &[Shot]) -> Result<Drawn, FrameError> {
            Ok(Drawn::default())
        }
        fn device_lost(&self) -> Option<String> {
            None
        }
        fn pick(&self, _camera: &Camera, ndc: Vec2, _aspect: f32) -> Option<ObjectId> {
            (ndc.distance(Vec2::new(0.0, -0.5)) < 0.1).then_some(CUBE)
        }
        fn ground_point(&self, camera: &Camera, ndc: Vec2, aspect: f32) -> Option<Vec3> {
            let ray = camera.ray(ndc, aspect);
            (ray.y < 0.0).then(|| ray * (-1.6 / ray.y))
        }
        fn position(&self, _object: ObjectId) -> Option<Vec3> {
            Some(Vec3::new(0.0, -1.1, -4.5))
        }
    }

    fn controls() -> Controls {
        let mut controls = Controls::new();
        controls.resized(800, 400);
        controls
    }

    #[test]
    fn the_panorama_follows_the_pointer() {
        let mut controls = controls();
        let point = controls.camera().ray(Vec2::ZERO, 2.0);
        controls.moved(Vec2::new(400.0, 200.0), None::<&Ground>);
        controls.pressed(&Ground);
        controls.moved(Vec2::new(410.0, 204.0), Some(&Ground));
        // What was in the middle is now to the right and below it.
        let seen = controls.camera().view_from_world().transform_vector3(point);
        assert!(seen.x > 0.0 && seen.y < 0.0, "{seen}");
        controls.released();
        let camera = controls.camera();
        controls.moved(Vec2::new(0.0, 0.0), Some(&Ground));
        assert_eq!(controls.camera(), camera);
        assert_eq!(controls.take_actions(), []);
    }

    #[test]
    fn pitch_and_field_of_view_stay_in_range() {
        let mut controls = controls();
        controls.pressed(&Ground);
        controls.moved(Vec2::new(0.0, 1e6), Some(&Ground));
        let up = controls.camera().ray(Vec2::ZERO, 1.0);
        assert!((up.y - MAX_PITCH_RAD.sin()).abs() < 1e-5);
        for (notches, deg) in [(1e9, 30.0), (-1e9, 110.0), (f32::NAN, 110.0)] {
            (0..4).for_each(|_| controls.zoomed(notches));
            assert!((controls.fov_y_rad.to_degrees() - deg).abs() < 1e-3);
        }
        controls.reset();
        assert_eq!(controls.camera(), Camera::looking(0.0, 0.0, START_FOV_DEG.to_radians()));
    }

    #[test]
    fn an_object_keeps_its_height_and_its_distance_to_the_pointer() {
        let mut controls = controls();
        controls.moved(Vec2::new(400.0, 300.0), None::<&Ground>);
        let grabbed = controls.ground(&Ground).unwrap();
        controls.pressed(&Ground);
        controls.moved(Vec2::new(420.0, 310.0), Some(&Ground));
        controls.moved(Vec2::new(440.0, 320.0), Some(&Ground));
        let target = controls.ground(&Ground).unwrap();
        let expected = Vec3::new(0.0, -1.1, -4.5) + (target - grabbed) * Vec3::new(1.0, 0.0, 1.0);
        let actions = controls.take_actions();
        let [UserAction::Grab(CUBE), UserAction::Move(CUBE, position)] = actions[..] else { panic!("{actions:?}") };
        assert!((position - expected).length() < 1e-5);
        // Above the horizon there is no ground: it stays.
        controls.moved(Vec2::new(440.0, 20.0), Some(&Ground));
        controls.released();
        assert_eq!(controls.take_actions(), [UserAction::Release(CUBE)]);
    }
}
