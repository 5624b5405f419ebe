//! Things that stand.

use glam::{Quat, Vec3};
use mr360_protocol::scene::Transform;

use crate::scene::mesh::Bounds;

/// Room beneath what is stood somewhere, so that it settles and is not pushed out, metres.
const ROOM_M: f32 = 1e-3;

/// An object of these bounds, in its own frame, that stands upright at a point.
#[must_use]
pub fn standing(at: Vec3, yaw_rad: f32, scale: Vec3, bounds: &Bounds) -> Transform {
    let beneath = if bounds.min.y.is_finite() { bounds.min.y * scale.y } else { 0.0 };
    Transform { position: at - Vec3::Y * (beneath - ROOM_M), rotation: Quat::from_rotation_y(yaw_rad), scale }
}

/// The object upright on the ground beneath it, its heading as it was.
#[must_use]
pub fn on_ground(transform: &Transform, bounds: &Bounds, ground_y: f32) -> Transform {
    let at = Vec3::new(transform.position.x, ground_y, transform.position.z);
    standing(at, heading(transform.rotation), transform.scale, bounds)
}

/// Angle about +y of the upright turn that is nearest to a turn.
fn heading(rotation: Quat) -> f32 {
    // The twist about y (swing-twist decomposition); any where the object stands on its head.
    if rotation.y.abs() + rotation.w.abs() < 1e-6 { 0.0 } else { 2.0 * rotation.y.atan2(rotation.w) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS: Bounds = Bounds { min: Vec3::new(-0.5, -0.2, -0.5), max: Vec3::new(0.5, 0.8, 0.5) };

    #[test]
    fn what_is_snapped_stands_upright_on_the_ground_and_keeps_its_heading() {
        for tilt in [0.0, 0.4, -1.2] {
            let rotation = Quat::from_rotation_y(0.7) * Quat::from_rotation_x(tilt) * Quat::from_rotation_z(0.5 * tilt);
            let floating = Transform { position: Vec3::new(1.0, 2.0, 3.0), rotation, scale: Vec3::splat(2.0) };
            let stands = on_ground(&floating, &BOUNDS, -1.6);
            assert!((stands.position - Vec3::new(1.0, -1.6 + 0.4 + ROOM_M, 3.0)).length() < 1e-5, "{stands:?}");
            assert!((stands.rotation * Vec3::Y).distance(Vec3::Y) < 1e-5 && stands.scale == floating.scale);
            let off = (stands.rotation * Vec3::Z).angle_between(Quat::from_rotation_y(0.7) * Vec3::Z);
            assert!(off < tilt.abs() * 0.4 + 1e-3, "turned by {off}");
        }
        let head_down = Transform { rotation: Quat::from_rotation_x(std::f32::consts::PI), ..Transform::default() };
        assert!((on_ground(&head_down, &BOUNDS, 0.0).rotation * Vec3::Y).distance(Vec3::Y) < 1e-5);
    }

    #[test]
    fn a_thing_without_bounds_stands_at_its_origin() {
        assert_eq!(standing(Vec3::X, 0.0, Vec3::ONE, &Bounds::EMPTY).position, Vec3::new(1.0, ROOM_M, 0.0));
    }
}
