//! Orthographic frusta of the shadow maps, fitted to the objects that cast.

use glam::{Mat3, Mat4, Vec3, Vec4};

use mr360_shaders::layout::{self, SHADOW_MAP_SIZE};

use crate::scene::mesh::Bounds;

/// Sides that a frustum may have between one and its double.
pub(super) const STEPS_AN_OCTAVE: f32 = 4.0;
/// Texels beside the casters that stay empty, one of them for the snap: what lies at the edge is taken for all beyond.
const EMPTY_TEXELS: f32 = 3.0;
/// Shadows on the ground end at this distance from their caster, metres.
pub const LONGEST_SHADOW_M: f32 = 60.0;

/// One light's view of the casters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frustum {
    /// x, y in [−1, 1], z in metres from the plane nearest to the light.
    pub shadow_from_world: Mat4,
    /// The same with z in [0, 1].
    pub clip_from_world: Mat4,
    /// Half the side of the square it covers, metres.
    pub half_width_m: f32,
    /// Metres from depth 0 to depth 1.
    pub range_m: f32,
}

impl Frustum {
    /// Side of a texel, metres.
    #[must_use]
    pub fn texel_m(&self) -> f32 {
        2.0 * self.half_width_m / SHADOW_MAP_SIZE as f32
    }

    /// As the shaders look into it, from this layer.
    #[must_use]
    pub fn map(&self, layer: i32) -> layout::ShadowMap {
        let from_world = self.shadow_from_world.to_cols_array_2d();
        layout::ShadowMap { from_world, half_width_m: self.half_width_m, range_m: self.range_m, texel_m: self.texel_m(), layer }
    }
}

/// Fits a frustum around the casters' boxes as seen from the light. Receivers need not lie within: outside of the
/// square nothing can hide the light, and depth beyond the range counts as its end. `margin_m` is room for penumbrae.
///
/// The basis hangs on the light alone, so that turning the camera moves no texel. The side goes in steps and the corner
/// lies on a texel of the whole plane, so that objects that move leave the texels of all others where they are.
#[must_use]
pub fn fit(direction: Vec3, casters: &[Bounds], margin_m: f32) -> Frustum {
    fit_over(direction, casters, casters, margin_m)
}

/// The same, with a square around the first boxes and the depth of the others: of casters that reach far beyond what
/// their shadows are asked for.
#[must_use]
pub fn fit_over(direction: Vec3, across: &[Bounds], along: &[Bounds], margin_m: f32) -> Frustum {
    let (right, up) = direction.any_orthonormal_pair();
    let light_from_world = Mat3::from_cols(right, up, direction).transpose();
    let seen = |boxes: &[Bounds]| boxes.iter().flat_map(Bounds::corners).fold(Bounds::EMPTY, |b, at| b.including(light_from_world * at));
    let (square, depth) = (seen(across), seen(along));
    let center = square.center().truncate().extend(depth.center().z);
    let half = square.half().truncate().extend(depth.half().z);
    let needed_m = (half.x.max(half.y).max(1e-3) + margin_m) * (1.0 + EMPTY_TEXELS / (0.5 * SHADOW_MAP_SIZE as f32));
    let half_width_m = ((needed_m.log2() * STEPS_AN_OCTAVE).ceil() / STEPS_AN_OCTAVE).exp2();
    let texel_m = 2.0 * half_width_m / SHADOW_MAP_SIZE as f32;
    let corner = (center / texel_m).round() * texel_m;
    // Room at both ends, for rounding: a flat caster that faces the light has no depth of its own.
    let room_m = (0.02 * half.z).max(1e-3);
    let range_m = 2.0 * (half.z + room_m);
    // Rows: x and y of the light's plane over the half width; z counts away from the light.
    let rows = [
        (right / half_width_m).extend(-corner.x / half_width_m),
        (up / half_width_m).extend(-corner.y / half_width_m),
        (-direction).extend(center.z + half.z + room_m),
        Vec4::W,
    ];
    let shadow_from_world = Mat4::from_cols(rows[0], rows[1], rows[2], rows[3]).transpose();
    let clip_from_world = Mat4::from_scale(Vec3::new(1.0, 1.0, 1.0 / range_m)) * shadow_from_world;
    Frustum { shadow_from_world, clip_from_world, half_width_m, range_m }
}

/// The part of the ground, as corners (x, z), that a ball's shadow can fall on; `None` for a light at or below
/// the horizon, or a ball beneath the ground.
#[must_use]
pub fn ground_shadow(direction: Vec3, tan_radius: f32, center: Vec3, radius: f32, ground_y: f32) -> Option<Bounds> {
    let height = center.y + radius - ground_y;
    if direction.y <= 1e-3 || height <= 0.0 {
        return None;
    }
    let farthest = (height / direction.y).min(LONGEST_SHADOW_M);
    let spread = radius / direction.y.max(0.1) + tan_radius * farthest;
    let bottom = ((center.y - radius - ground_y).max(0.0) / direction.y).min(LONGEST_SHADOW_M);
    let ends = [center - direction * bottom, center - direction * farthest];
    Some(ends.iter().fold(Bounds::EMPTY, |bounds, end| bounds.including(*end - Vec3::splat(spread)).including(*end + Vec3::splat(spread))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn casters_lie_within_and_depth_grows_away_from_the_light() {
        let casters = [
            Bounds { min: Vec3::new(1.0, -1.6, -4.0), max: Vec3::new(2.0, 0.4, -3.0) },
            Bounds { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) },
        ];
        for direction in [Vec3::Y, Vec3::new(0.6, 0.48, -0.64), Vec3::NEG_Z, Vec3::new(0.01, -0.99, 0.0).normalize()] {
            let frustum = fit(direction, &casters, 0.1);
            for corner in casters.iter().flat_map(Bounds::corners) {
                let at = frustum.clip_from_world.transform_point3(corner);
                assert!(at.x.abs() < 1.0 && at.y.abs() < 1.0 && (0.0..=1.0).contains(&at.z), "{direction}: {at}");
                let beyond = frustum.shadow_from_world.transform_point3(corner - direction);
                let here = frustum.shadow_from_world.transform_point3(corner);
                assert!((beyond.z - here.z - 1.0).abs() < 1e-4 && (beyond - here).truncate().length() < 1e-4);
            }
        }
    }

    #[test]
    fn a_flat_caster_that_faces_the_light_keeps_its_depth() {
        // A metre up and a kilometre away: floats there are 61 µm apart.
        for center in [Vec3::Y, Vec3::new(1000.0, 1.0, -1000.0)] {
            let flat = [Bounds { min: center - Vec3::new(0.5, 0.0, 0.5), max: center + Vec3::new(0.5, 0.0, 0.5) }];
            for direction in [Vec3::Y, Vec3::NEG_Y, Vec3::new(0.6, 0.48, -0.64)] {
                let frustum = fit(direction, &flat, 0.0);
                for corner in flat[0].corners() {
                    let at = frustum.clip_from_world.transform_point3(corner);
                    assert!(at.z > 5e-3 && at.z < 1.0 - 5e-3, "{direction} {center}: {at}");
                }
            }
        }
    }

    #[test]
    fn objects_that_move_leave_the_texels_where_they_are() {
        let still = Bounds { min: Vec3::new(-0.5, -1.6, -4.5), max: Vec3::new(0.5, -0.6, -3.5) };
        let direction = Vec3::new(0.5, 0.8, 0.3).normalize();
        let texel_of = |frustum: &Frustum, point: Vec3| {
            let at = frustum.shadow_from_world.transform_point3(point).truncate();
            at * (0.5 * SHADOW_MAP_SIZE as f32)
        };
        let point = Vec3::new(0.2, -1.0, -3.7);
        let mut sides = Vec::new();
        let mut first: Option<(Frustum, glam::Vec2)> = None;
        for step in 0..200 {
            let offset = Vec3::new(0.007, 0.0, 0.0031) * step as f32;
            let moving = Bounds { min: Vec3::new(0.8, -1.6, -3.3) + offset, max: Vec3::new(1.4, -1.0, -2.7) + offset };
            let frustum = fit(direction, &[still, moving], 0.02);
            let here = texel_of(&frustum, point);
            if sides.last() != Some(&frustum.half_width_m) {
                sides.push(frustum.half_width_m);
                first = None;
            }
            let (_, there) = *first.get_or_insert((frustum, here));
            let moved = here - there;
            // Rounding of coordinates of a few metres over texels of a few millimetres.
            assert!((moved - moved.round()).abs().max_element() < 0.01, "step {step}: {moved}");
        }
        // 1.4 m of way widen the square by a half at most: two steps or three.
        assert!(sides.len() <= 4, "{sides:?}");
    }

    #[test]
    fn a_shadow_falls_away_from_the_light() {
        let bounds = ground_shadow(Vec3::new(0.8, 0.6, 0.0), 0.0, Vec3::new(0.0, 1.0, 0.0), 0.5, 0.0).unwrap();
        assert!(bounds.min.x < -1.3 && bounds.max.x < 0.5, "{bounds:?}");
        assert_eq!(ground_shadow(Vec3::new(1.0, 0.0, 0.0), 0.0, Vec3::Y, 0.5, 0.0), None);
        assert_eq!(ground_shadow(Vec3::Y, 0.0, Vec3::NEG_Y, 0.5, 0.0), None);
    }
}
