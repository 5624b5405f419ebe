//! Where the viewer is: poses of the runtime in our world. Its axes are OpenXR's; the floor beneath the viewer lies on the scene's ground.

use glam::{Quat, Vec3};
use openxr as xr;

use super::Fault;
use super::runtime::Runtime;
use crate::camera::{Camera, Edges, FieldOfView};
use crate::hands::Pose;

/// How high the eyes are above the floor where the runtime does not know, metres.
const EYE_HEIGHT_M: f32 = 1.6;

/// Spaces of a session.
pub(super) struct Spaces {
    /// Its origin lies on the floor, and ahead is where the user looked last when recentring, or the room's own front.
    pub(super) floor: xr::Space,
    head: xr::Space,
}

impl Spaces {
    /// The best that the runtime has: the floor beneath the user, that of the room, or where the head was at first with a floor below it.
    ///
    /// # Errors
    /// Those of [`Fault::of`].
    pub(super) fn new(session: &xr::Session<xr::Vulkan>, runtime: &Runtime) -> Result<Self, Fault> {
        let failed = |code| Fault::of("making a space for the viewer", code);
        let offered = session.enumerate_reference_spaces().map_err(failed)?;
        let (kind, below_m) = choose(&offered, runtime.extensions.ext_local_floor);
        let mut pose = xr::Posef::IDENTITY;
        pose.position.y = -below_m;
        tracing::info!(space = ?kind, "the viewer's floor is the scene's ground");
        Ok(Self {
            floor: session.create_reference_space(kind, pose).map_err(failed)?,
            head: session.create_reference_space(xr::ReferenceSpaceType::VIEW, xr::Posef::IDENTITY).map_err(failed)?,
        })
    }

    /// Where a space is in the world, if both its place and its turn are known.
    ///
    /// # Errors
    /// The runtime's.
    pub(super) fn locate(&self, space: &xr::Space, at: xr::Time, ground_y: f32) -> Result<Option<Pose>, xr::sys::Result> {
        let location = space.locate(&self.floor, at)?;
        let known = xr::SpaceLocationFlags::POSITION_VALID | xr::SpaceLocationFlags::ORIENTATION_VALID;
        Ok(location.location_flags.contains(known).then(|| pose(location.pose, ground_y)).flatten())
    }

    /// Where the head is in the world.
    ///
    /// # Errors
    /// The runtime's.
    pub(super) fn head(&self, at: xr::Time, ground_y: f32) -> Result<Option<Pose>, xr::sys::Result> {
        self.locate(&self.head, at, ground_y)
    }
}

/// A kind of space, and how far below its origin the floor lies.
fn choose(offered: &[xr::ReferenceSpaceType], knows_local_floor: bool) -> (xr::ReferenceSpaceType, f32) {
    if knows_local_floor && offered.contains(&xr::ReferenceSpaceType::LOCAL_FLOOR_EXT) {
        (xr::ReferenceSpaceType::LOCAL_FLOOR_EXT, 0.0)
    } else if offered.contains(&xr::ReferenceSpaceType::STAGE) {
        (xr::ReferenceSpaceType::STAGE, 0.0)
    } else {
        (xr::ReferenceSpaceType::LOCAL, EYE_HEIGHT_M)
    }
}

/// A pose above the floor as one of the world, whose ground is at this height; `None` for one that is no pose.
pub(super) fn pose(of: xr::Posef, ground_y: f32) -> Option<Pose> {
    let position = Vec3::new(of.position.x, of.position.y + ground_y, of.position.z);
    let turn = Quat::from_xyzw(of.orientation.x, of.orientation.y, of.orientation.z, of.orientation.w);
    let orientation = (turn.length_squared() > 0.25).then(|| turn.normalize())?;
    (position.is_finite() && orientation.is_finite()).then_some(Pose { position, orientation })
}

/// The camera of an eye; `None` when the runtime tells no picture. Where it does not know the eye's place, that is above the middle of the floor.
pub(super) fn camera(view: &xr::View, flags: xr::ViewStateFlags, ground_y: f32, right_eye: bool) -> Option<Camera> {
    if !flags.contains(xr::ViewStateFlags::ORIENTATION_VALID) {
        return None;
    }
    let mut of = view.pose;
    if !flags.contains(xr::ViewStateFlags::POSITION_VALID) {
        of.position = xr::Vector3f { x: 0.0, y: EYE_HEIGHT_M, z: 0.0 };
    }
    let Pose { position, orientation } = pose(of, ground_y)?;
    let edges = Edges::from_angles(view.fov.angle_left, view.fov.angle_right, view.fov.angle_down, view.fov.angle_up)?;
    Some(Camera { position, world_from_view: orientation, fov: FieldOfView::Edges(edges), right_eye })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view() -> xr::View {
        let orientation = xr::Quaternionf { x: 0.0, y: 0.6, z: 0.0, w: 0.8 };
        let pose = xr::Posef { orientation, position: xr::Vector3f { x: 0.5, y: 1.7, z: -0.2 } };
        xr::View { pose, fov: xr::Fovf { angle_left: -0.9, angle_right: 0.6, angle_up: 0.7, angle_down: -0.8 } }
    }

    #[test]
    fn the_floor_is_the_scenes_ground() {
        let camera = camera(&view(), xr::ViewStateFlags::ORIENTATION_VALID | xr::ViewStateFlags::POSITION_VALID, -1.5, true).unwrap();
        assert!((camera.position - Vec3::new(0.5, 0.2, -0.2)).length() < 1e-6 && camera.right_eye);
        // Turned to the left about +y by 2 · asin 0.6: its axis points there.
        let ahead = camera.world_from_view * Vec3::NEG_Z;
        assert!((ahead - Vec3::new(-0.96, 0.0, -0.28)).length() < 1e-6, "{ahead}");
        let expected = Edges { left: (-0.9_f32).tan(), right: 0.6_f32.tan(), down: (-0.8_f32).tan(), up: 0.7_f32.tan() };
        assert_eq!(camera.fov, FieldOfView::Edges(expected));
    }

    #[test]
    fn what_is_not_known_is_not_made_up() {
        let placed = camera(&view(), xr::ViewStateFlags::ORIENTATION_VALID, -1.5, false).unwrap();
        assert!((placed.position - Vec3::new(0.0, EYE_HEIGHT_M - 1.5, 0.0)).length() < 1e-6);
        assert_eq!(camera(&view(), xr::ViewStateFlags::POSITION_VALID, -1.5, false), None);
        let both = xr::ViewStateFlags::ORIENTATION_VALID | xr::ViewStateFlags::POSITION_VALID;
        let mut crossed = view();
        crossed.fov.angle_left = 0.7;
        assert_eq!(camera(&crossed, both, 0.0, false), None);
        let mut still = view();
        still.pose.orientation = xr::Quaternionf { x: 0.0, y: 0.0, z: 0.0, w: 0.0 };
        assert_eq!(camera(&still, both, 0.0, false), None);
    }

    #[test]
    fn a_floor_is_found_where_there_is_one() {
        use xr::ReferenceSpaceType as Kind;
        let all = [Kind::VIEW, Kind::LOCAL, Kind::STAGE, Kind::LOCAL_FLOOR_EXT];
        assert_eq!(choose(&all, true), (Kind::LOCAL_FLOOR_EXT, 0.0));
        assert_eq!(choose(&all, false), (Kind::STAGE, 0.0));
        assert_eq!(choose(&all[..2], true), (Kind::LOCAL, EYE_HEIGHT_M));
    }
}
