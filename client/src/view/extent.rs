//! The part of the image that objects and the ground they change can touch.

use glam::{Mat4, Vec3};

use super::stage::Stage;
use crate::camera::Camera;
use crate::scene::mesh::Bounds;

/// Corners lie on multiples of this, so that pixels share their quads (and so derivatives) with the whole image.
const STEP_PX: u32 = 16;

/// A rectangle of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Part {
    pub(super) origin: (u32, u32),
    pub(super) size: (u32, u32),
}

impl Part {
    /// The smallest that holds both.
    pub(super) fn joined(self, other: Self) -> Self {
        let ends = |part: Self| (part.origin.0 + part.size.0, part.origin.1 + part.size.1);
        let (first, second) = (ends(self), ends(other));
        let origin = (self.origin.0.min(other.origin.0), self.origin.1.min(other.origin.1));
        Self { origin, size: (first.0.max(second.0) - origin.0, first.1.max(second.1) - origin.1) }
    }
}

/// Where casters and changed ground and place appear in an image of this size; `None` where nothing of them is in view.
pub(super) fn touched(camera: &Camera, size: (u32, u32), stage: &Stage, (ground, place): (Option<Bounds>, &[Bounds])) -> Option<Part> {
    let (width, height) = (size.0.max(1) as f32, size.1.max(1) as f32);
    let clip_from_world = camera.clip_from_view(width / height) * camera.view_from_world();
    let ground = ground.map(|bounds| Bounds {
        min: Vec3::new(bounds.min.x, stage.ground_y, bounds.min.z),
        max: Vec3::new(bounds.max.x, stage.ground_y, bounds.max.z),
    });
    let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
    for bounds in stage.casters.iter().chain(&stage.apart).chain(place).copied().chain(ground) {
        let Some(seen) = box_in_ndc(&clip_from_world, &bounds) else { continue };
        for axis in 0..2 {
            low[axis] = low[axis].min(seen.min[axis]);
            high[axis] = high[axis].max(seen.max[axis]);
        }
    }
    // A pixel of room for rounding in the projection.
    let columns = span((low[0] * 0.5 + 0.5) * width - 1.0, (high[0] * 0.5 + 0.5) * width + 1.0, size.0)?;
    let rows = span((0.5 - high[1] * 0.5) * height - 1.0, (0.5 - low[1] * 0.5) * height + 1.0, size.1)?;
    Some(Part { origin: (columns.0, rows.0), size: (columns.1, rows.1) })
}

/// True unless a box lies wholly outside of an image of this size.
pub(super) fn in_view(camera: &Camera, size: (u32, u32), bounds: &Bounds) -> bool {
    let clip_from_world = camera.clip_from_view(size.0.max(1) as f32 / size.1.max(1) as f32) * camera.view_from_world();
    box_in_ndc(&clip_from_world, bounds)
        .is_some_and(|seen| seen.min.truncate().max_element() < 1.0 && seen.max.truncate().min_element() > -1.0)
}

/// Normalised device coordinates of a box: the whole plane where it reaches behind the camera, nothing where it
/// lies wholly behind.
fn box_in_ndc(clip_from_world: &Mat4, bounds: &Bounds) -> Option<Bounds> {
    let corners = bounds.corners().map(|corner| *clip_from_world * corner.extend(1.0));
    let behind = corners.iter().filter(|corner| corner.w <= 1e-4).count();
    match behind {
        0 => Some(corners.iter().fold(Bounds::EMPTY, |seen, corner| seen.including(corner.truncate() / corner.w))),
        8 => None,
        _ => Some(Bounds { min: Vec3::splat(-1e6), max: Vec3::splat(1e6) }),
    }
}

/// First pixel and count of those between two places, rounded outwards to steps within the image.
fn span(low: f32, high: f32, pixels: u32) -> Option<(u32, u32)> {
    // Casting a float saturates.
    let first = low.max(0.0) as u32 / STEP_PX * STEP_PX;
    let end = (high.max(0.0).ceil() as u32).min(pixels).next_multiple_of(STEP_PX).min(pixels);
    (low < high && first < end).then(|| (first, end - first))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stage(min: Vec3, max: Vec3) -> Stage {
        Stage { casters: vec![Bounds { min, max }], ground_y: -1.6, ..Stage::default() }
    }

    #[test]
    fn a_box_ahead_takes_its_part_and_one_behind_none() {
        let camera = Camera::looking(0.0, 0.0, 1.0);
        // A metre across, 10.5 m away at the near side: 360 / (2 · tan 0.5 · 9.5) = 34.7 pixels across.
        let ahead = stage(Vec3::new(-0.5, -0.5, -10.5), Vec3::new(0.5, 0.5, -9.5));
        let part = touched(&camera, (640, 360), &ahead, (None, &[])).unwrap();
        assert_eq!(part, Part { origin: (288, 160), size: (64, 48) });
        let behind = stage(Vec3::new(-0.5, -0.5, 9.5), Vec3::new(0.5, 0.5, 10.5));
        assert_eq!(touched(&camera, (640, 360), &behind, (None, &[])), None);
        let around = stage(Vec3::splat(-1.0), Vec3::splat(1.0));
        assert_eq!(touched(&camera, (640, 360), &around, (None, &[])), Some(Part { origin: (0, 0), size: (640, 360) }));
        assert_eq!(touched(&camera, (640, 360), &Stage::default(), (None, &[])), None);
    }

    #[test]
    fn a_joined_part_holds_both() {
        let (a, b) = (Part { origin: (16, 32), size: (64, 16) }, Part { origin: (48, 0), size: (16, 96) });
        let joined = Part { origin: (16, 0), size: (64, 96) };
        assert_eq!((a.joined(b), b.joined(a), a.joined(a)), (joined, joined, a));
    }

    #[test]
    fn ground_counts_at_its_own_height() {
        let camera = Camera::looking(0.0, 0.0, 1.0);
        let ground = Bounds { min: Vec3::new(-1.0, -99.0, -4.0), max: Vec3::new(1.0, 99.0, -3.0) };
        let part = touched(&camera, (640, 360), &Stage { ground_y: -1.0, ..Stage::default() }, (Some(ground), &[])).unwrap();
        // Beneath the middle row, down to 180 + 180 / (3 · tan 0.5) = 290.
        assert!(part.origin.1 > 180 && part.origin.1 + part.size.1 <= 304, "{part:?}");
    }
}
