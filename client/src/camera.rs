//! The viewer's camera.

use glam::{EulerRot, Mat4, Quat, Vec3, Vec4};

/// A perspective camera; −z forward, y up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Metres; the camera that filmed the panorama stood at the origin.
    pub position: Vec3,
    /// Rotation of the view in the world.
    pub world_from_view: Quat,
    /// Vertical field of view, radians.
    pub fov_y_rad: f32,
    /// Shows the right eye's view of a stereo source.
    pub right_eye: bool,
}

impl Camera {
    /// Nearest distance drawn, metres.
    pub const NEAR_M: f32 = 0.05;

    /// A camera at the origin. Yaw turns left (about +y), pitch looks up.
    #[must_use]
    pub fn looking(yaw_rad: f32, pitch_rad: f32, fov_y_rad: f32) -> Self {
        Self {
            position: Vec3::ZERO,
            world_from_view: Quat::from_euler(EulerRot::YXZ, yaw_rad, pitch_rad, 0.0),
            fov_y_rad,
            right_eye: false,
        }
    }

    /// View matrix.
    #[must_use]
    pub fn view_from_world(&self) -> Mat4 {
        Mat4::from_rotation_translation(self.world_from_view, self.position).inverse()
    }

    /// Projection with reversed, infinite depth: 1 at [`Camera::NEAR_M`], 0 at infinity.
    #[must_use]
    pub fn clip_from_view(&self, aspect: f32) -> Mat4 {
        let y = 1.0 / (self.fov_y_rad * 0.5).tan();
        Mat4::from_cols(Vec4::X * (y / aspect), Vec4::Y * y, Vec4::NEG_W, Vec4::Z * Self::NEAR_M)
    }

    /// World direction of the ray through a point of the image, x and y in [−1, 1], y up.
    #[must_use]
    pub fn ray(&self, ndc: glam::Vec2, aspect: f32) -> Vec3 {
        let tan = (self.fov_y_rad * 0.5).tan();
        (self.world_from_view * Vec3::new(ndc.x * tan * aspect, ndc.y * tan, -1.0)).normalize()
    }
}
