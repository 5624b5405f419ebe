//! A view as `--record-eyes` writes it and `--view` reads it: so that a picture that a headset showed can be drawn again.

use std::path::Path;

use anyhow::{Context, ensure};
use glam::{Quat, Vec3};
use serde::{Deserialize, Serialize};

use crate::camera::{Camera, Edges, FieldOfView};

/// Largest file that is read.
const MAX_BYTES: u64 = 64 * 1024;
/// Farthest from the camera that filmed, metres.
const MAX_DISTANCE_M: f32 = 1_000.0;

/// A camera whose picture ends at given edges, in the world.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Viewpoint {
    /// Metres; x right, y up, −z into the centre of the panorama.
    pub position: [f32; 3],
    /// Unit quaternion x, y, z, w: from the view's axes to the world's.
    pub orientation: [f32; 4],
    /// Tangents of the angles from the axis to the picture's edges, to the right and up.
    pub edges: EdgeTangents,
    /// Shows the right eye's view of a stereo source.
    #[serde(default)]
    pub right_eye: bool,
}

/// As [`Edges`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EdgeTangents {
    /// Of the leftmost ray.
    pub left: f32,
    /// Of the rightmost ray.
    pub right: f32,
    /// Of the lowest ray.
    pub down: f32,
    /// Of the highest ray.
    pub up: f32,
}

impl Viewpoint {
    /// That of a camera, for pictures so many times as wide as high.
    #[must_use]
    pub fn of(camera: &Camera, aspect: f32) -> Self {
        let Edges { left, right, down, up } = camera.edges(aspect);
        Self {
            position: camera.position.to_array(),
            orientation: camera.world_from_view.to_array(),
            edges: EdgeTangents { left, right, down, up },
            right_eye: camera.right_eye,
        }
    }

    /// Reads one from a JSON file.
    ///
    /// # Errors
    /// Naming the file and what is wrong with it.
    pub fn load(path: &Path) -> anyhow::Result<Camera> {
        let named = || format!("view {}", path.display());
        let length = std::fs::metadata(path).with_context(named)?.len();
        ensure!(length <= MAX_BYTES, "{}: {length} bytes; a view is at most {MAX_BYTES}", named());
        let text = std::fs::read_to_string(path).with_context(named)?;
        let read: Self = serde_json::from_str(&text).with_context(|| format!("{}: not a view as --record-eyes writes it", named()))?;
        read.camera().with_context(named)
    }

    /// The camera.
    ///
    /// # Errors
    /// What keeps it from being one.
    pub fn camera(&self) -> anyhow::Result<Camera> {
        let position = Vec3::from_array(self.position);
        ensure!(
            position.length() <= MAX_DISTANCE_M,
            "position: farther than {MAX_DISTANCE_M} m from the camera that filmed, or not finite"
        );
        let turn = Quat::from_array(self.orientation);
        ensure!((turn.length() - 1.0).abs() < 1e-3, "orientation: not a unit quaternion");
        let EdgeTangents { left, right, down, up } = self.edges;
        let open = |low: f32, high: f32| low.is_finite() && high.is_finite() && high - low > 1e-6;
        ensure!(open(left, right) && open(down, up), "edges: left has to be less than right and down less than up, all finite");
        let fov = FieldOfView::Edges(Edges { left, right, down, up });
        Ok(Camera { position, world_from_view: turn.normalize(), fov, right_eye: self.right_eye })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written() -> Viewpoint {
        let camera = Camera { position: Vec3::new(0.1, 0.2, -0.3), right_eye: true, ..Camera::looking(0.3, 0.1, 1.0) };
        Viewpoint::of(&camera, 1.5)
    }

    #[test]
    fn what_was_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("view.json");
        std::fs::write(&path, serde_json::to_string(&written()).unwrap()).unwrap();
        let read = Viewpoint::load(&path).unwrap();
        assert_eq!((read.position, read.right_eye), (Vec3::new(0.1, 0.2, -0.3), true));
        // The same picture, whatever its shape.
        let before = Camera::looking(0.3, 0.1, 1.0);
        for ndc in [glam::Vec2::ONE, glam::Vec2::new(-1.0, 0.5)] {
            assert!((read.ray(ndc, 9.0) - before.ray(ndc, 1.5)).length() < 1e-6);
        }
    }

    #[test]
    fn what_is_no_view_is_refused_by_name() {
        let refused = |view: Viewpoint, word: &str| {
            let error = view.camera().unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        };
        refused(Viewpoint { position: [f32::NAN, 0.0, 0.0], ..written() }, "position");
        refused(Viewpoint { orientation: [0.0; 4], ..written() }, "orientation");
        let edges = EdgeTangents { left: 1.0, ..written().edges };
        refused(Viewpoint { edges, ..written() }, "edges");
        let error = format!("{:#}", Viewpoint::load(Path::new("/nowhere/view.json")).unwrap_err());
        assert!(error.contains("/nowhere/view.json"), "{error}");
    }
}
