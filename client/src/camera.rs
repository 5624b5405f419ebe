//! The viewer's camera.

use glam::{EulerRot, Mat4, Quat, Vec2, Vec3, Vec4};

/// A perspective camera; −z forward, y up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Metres; the camera that filmed the panorama stood at the origin.
    pub position: Vec3,
    /// Rotation of the view in the world.
    pub world_from_view: Quat,
    /// How much it sees.
    pub fov: FieldOfView,
    /// Shows the right eye's view of a stereo source.
    pub right_eye: bool,
}

/// How much a camera sees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FieldOfView {
    /// So many radians from the lowest to the highest row, as much to either side of the axis; the picture's shape gives the width.
    Vertical(f32),
    /// Up to these edges, whatever the picture's shape: a headset's optics are wider on one side than on the other.
    Edges(Edges),
}

/// Edges of a picture on the plane one metre ahead of the eye: tangents of the angles from the axis, to the right and up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edges {
    /// Of the leftmost ray, below 0 where the axis is in the picture.
    pub left: f32,
    /// Of the rightmost ray, above `left`.
    pub right: f32,
    /// Of the lowest ray, below 0 where the axis is in the picture.
    pub down: f32,
    /// Of the highest ray, above `down`.
    pub up: f32,
}

impl Edges {
    /// As much to every side, for pictures so many times as wide as high.
    #[must_use]
    pub fn symmetric(fov_y_rad: f32, aspect: f32) -> Self {
        let up = (fov_y_rad * 0.5).tan();
        let right = up * aspect;
        Self { left: -right, right, down: -up, up }
    }

    /// From the angles of the four edges, radians; those to the left and down are negative where the axis is in the picture. `None` where
    /// they leave no picture: not finite, crossed, or not ahead of the eye.
    #[must_use]
    pub fn from_angles(left: f32, right: f32, down: f32, up: f32) -> Option<Self> {
        let ahead = |angle: f32| angle.abs() < std::f32::consts::FRAC_PI_2;
        let edges = Self { left: left.tan(), right: right.tan(), down: down.tan(), up: up.tan() };
        ([left, right, down, up].into_iter().all(ahead) && edges.left < edges.right && edges.down < edges.up).then_some(edges)
    }

    /// The middle of the picture.
    #[must_use]
    pub fn center(&self) -> Vec2 {
        0.5 * Vec2::new(self.left + self.right, self.down + self.up)
    }

    /// From there to the right and to the upper edge.
    #[must_use]
    pub fn half(&self) -> Vec2 {
        0.5 * Vec2::new(self.right - self.left, self.up - self.down)
    }
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
            fov: FieldOfView::Vertical(fov_y_rad),
            right_eye: false,
        }
    }

    /// Edges of a picture so many times as wide as high.
    #[must_use]
    pub fn edges(&self, aspect: f32) -> Edges {
        match self.fov {
            FieldOfView::Vertical(fov_y_rad) => Edges::symmetric(fov_y_rad, aspect),
            FieldOfView::Edges(edges) => edges,
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
        let edges = self.edges(aspect);
        let (center, half) = (edges.center(), edges.half());
        let aside = center / half;
        Mat4::from_cols(Vec4::X / half.x, Vec4::Y / half.y, Vec4::new(aside.x, aside.y, 0.0, -1.0), Vec4::Z * Self::NEAR_M)
    }

    /// World vectors that (x, y, 1) in normalised device coordinates, y up, is applied to for the ray there, not of unit length.
    #[must_use]
    pub fn world_from_ndc(&self, aspect: f32) -> [Vec3; 3] {
        let edges = self.edges(aspect);
        let half = edges.half();
        [Vec3::X * half.x, Vec3::Y * half.y, edges.center().extend(-1.0)].map(|axis| self.world_from_view * axis)
    }

    /// World direction of the ray through a point of the image, x and y in [−1, 1], y up.
    #[must_use]
    pub fn ray(&self, ndc: Vec2, aspect: f32) -> Vec3 {
        let [x, y, middle] = self.world_from_ndc(aspect);
        (x * ndc.x + y * ndc.y + middle).normalize()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The left eye of a headset: wider to the left than to the nose, and downwards.
    fn lopsided() -> Edges {
        Edges::from_angles(-0.9, 0.6, -0.8, 0.7).unwrap()
    }

    fn camera(fov: FieldOfView) -> Camera {
        let world_from_view = Quat::from_euler(EulerRot::YXZ, 0.4, -0.3, 0.2);
        Camera { position: Vec3::new(0.3, 1.6, -2.0), world_from_view, fov, right_eye: false }
    }

    #[test]
    fn the_picture_ends_at_its_four_edges() {
        let camera = camera(FieldOfView::Edges(lopsided()));
        // A point on each edge ray, at any distance, lies on that edge of the clip volume, whatever the picture's shape.
        let edges = [
            ((-0.9_f32).tan(), 0.0, 0, -1.0),
            (0.6_f32.tan(), 0.0, 0, 1.0),
            (0.0, (-0.8_f32).tan(), 1, -1.0),
            (0.0, 0.7_f32.tan(), 1, 1.0),
        ];
        for (x, y, axis, expected) in edges {
            for (distance, aspect) in [(0.3, 1.0), (7.0, 2.0)] {
                let point = camera.position + camera.world_from_view * (Vec3::new(x, y, -1.0) * distance);
                let ndc = (camera.clip_from_view(aspect) * camera.view_from_world()).project_point3(point);
                assert!((ndc[axis] - expected).abs() < 1e-5, "{ndc} at {x}, {y}");
                assert!((ndc.z - Camera::NEAR_M / distance).abs() < 1e-6, "depth {}", ndc.z);
            }
        }
    }

    #[test]
    fn rays_and_projection_are_each_others_inverse() {
        for fov in [FieldOfView::Vertical(1.0), FieldOfView::Edges(lopsided())] {
            let camera = camera(fov);
            for ndc in [Vec2::new(-1.0, -1.0), Vec2::new(0.25, -0.75), Vec2::new(1.0, 1.0), Vec2::ZERO] {
                let point = camera.position + camera.ray(ndc, 1.7) * 3.0;
                let seen = (camera.clip_from_view(1.7) * camera.view_from_world()).project_point3(point);
                assert!((seen.truncate() - ndc).length() < 1e-5, "{fov:?}: {seen} for {ndc}");
            }
        }
    }

    #[test]
    fn equal_angles_are_the_symmetric_camera() {
        let (half_y, half_x) = (0.4_f32, 0.7_f32);
        let aspect = half_x.tan() / half_y.tan();
        let (fixed, shaped) = (Edges::from_angles(-half_x, half_x, -half_y, half_y).unwrap(), Edges::symmetric(2.0 * half_y, aspect));
        assert!((fixed.half() - shaped.half()).length() < 1e-6 && fixed.center() == Vec2::ZERO && shaped.center() == Vec2::ZERO);
    }

    #[test]
    fn angles_that_leave_no_picture_are_refused() {
        for [left, right, down, up] in [[0.5, -0.5, -0.5, 0.5], [-0.5, 0.5, 0.5, 0.5], [-1.6, 0.5, -0.5, 0.5], [-0.5, f32::NAN, -0.5, 0.5]]
        {
            assert_eq!(Edges::from_angles(left, right, down, up), None, "{left} {right} {down} {up}");
        }
        // An axis beside the picture is allowed.
        assert!(Edges::from_angles(0.1, 0.5, -0.5, 0.5).is_some());
    }
}
