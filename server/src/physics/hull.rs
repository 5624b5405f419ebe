//! Convex hulls of few corners.

use glam::Vec3;
use rapier3d::parry::transformation::try_convex_hull;
use rapier3d::prelude::{ColliderBuilder, Vector};

/// A closed convex mesh in its object's own frame.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Hull {
    corners: Vec<Vec3>,
    /// Three corners each; none where the corners lie in a plane or the hull could not be made: then the box around them counts.
    faces: Vec<[u32; 3]>,
    min: Vec3,
    max: Vec3,
}

/// Thinnest body, metres, in any direction: the solver cannot hold what is thinner.
const MIN_THICKNESS_M: f32 = 2e-3;
/// A hull that is thinner than this share of its length is a box to the solver.
const MIN_FLATNESS: f32 = 0.1;

/// How far the corners of a flat side move inwards that it does not stand on, as a share of its body's size.
const FEET: f32 = 0.08;
/// And at most by this share of the body's thickness there.
const FEET_OF_THICKNESS: f32 = 0.25;

impl Hull {
    /// Around the points that lie farthest along each of [`directions`]; `None` of no points.
    pub(super) fn around(points: &[Vec3]) -> Option<Self> {
        let first = *points.first()?;
        let (min, max) = points.iter().fold((first, first), |(min, max), p| (min.min(*p), max.max(*p)));
        let mut picked: Vec<usize> = directions()
            .map(|direction| {
                let farthest = |best: (usize, f32), (i, p): (usize, &Vec3)| {
                    let along = p.dot(direction);
                    if along > best.1 { (i, along) } else { best }
                };
                points.iter().enumerate().fold((0, f32::NEG_INFINITY), farthest).0
            })
            .collect();
        picked.sort_unstable();
        picked.dedup();
        let corners: Vec<_> = picked.into_iter().map(|i| points[i]).collect();
        let size = max - min;
        let flat = size.min_element() < size.max_element() * MIN_FLATNESS;
        let hull = (!flat).then(|| hull(&corners)).flatten().and_then(|(corners, faces)| hull(&with_feet(corners, &faces)));
        let (corners, faces) = hull.unwrap_or((corners, Vec::new()));
        Some(Self { corners, faces, min, max })
    }

    /// Diameter 1 around the origin, for spheres that are scaled to an ellipsoid.
    pub(super) fn ball() -> Option<Self> {
        Self::around(&directions().map(|direction| direction * 0.5).collect::<Vec<_>>())
    }

    /// Diameter and height 1, along y, for cylinders that are not round.
    pub(super) fn drum() -> Option<Self> {
        let rim = directions().filter(|direction| direction.y == 0.0).map(|direction| direction * 0.5);
        Self::around(&rim.flat_map(|point| [point + Vec3::Y * 0.5, point - Vec3::Y * 0.5]).collect::<Vec<_>>())
    }

    /// Its longest side, scaled.
    pub(super) fn extent(&self, scale: Vec3) -> f32 {
        ((self.max - self.min) * scale).max_element()
    }

    /// Scaled by a factor on each axis: it stays convex, so its faces stay what they are.
    pub(super) fn collider(&self, scale: Vec3) -> ColliderBuilder {
        let corners: Vec<_> = self.corners.iter().map(|p| Vector::from_array((*p * scale).to_array())).collect();
        let size = (self.max - self.min) * scale;
        let thick = size.min_element() > MIN_THICKNESS_M && size.min_element() >= size.max_element() * MIN_FLATNESS;
        let solid = (thick && !self.faces.is_empty()).then(|| ColliderBuilder::convex_mesh(corners, &self.faces)).flatten();
        solid.unwrap_or_else(|| boxed(self.min * scale, self.max * scale))
    }
}

fn hull(points: &[Vec3]) -> Option<(Vec<Vec3>, Vec<[u32; 3]>)> {
    let vectors: Vec<_> = points.iter().map(|p| Vector::from_array(p.to_array())).collect();
    // It refuses most degenerate points and asserts over some: then the box around them is as good.
    let (corners, faces) = std::panic::catch_unwind(|| try_convex_hull(&vectors)).ok()?.ok()?;
    Some((corners.iter().map(|p| Vec3::from_array(p.to_array())).collect(), faces))
}

/// The solver takes the first four corners of a flat side for the whole of it, and what stands on more of them tips over. So of each such
/// side the four that span most of it stay, and the others move inwards a little.
fn with_feet(mut corners: Vec<Vec3>, faces: &[[u32; 3]]) -> Vec<Vec3> {
    let at = |corners: &[Vec3], i: u32| corners[i as usize];
    let Some(first) = corners.first().copied() else { return corners };
    let (min, max) = corners.iter().fold((first, first), |(min, max), p| (min.min(*p), max.max(*p)));
    let size = (max - min).max_element();
    let plane = |face: &[u32; 3]| {
        let [a, b, c] = face.map(|i| at(&corners, i));
        let normal = (b - a).cross(c - a).normalize_or_zero();
        (normal, normal.dot(a))
    };
    let mut moved = Vec::new();
    let mut seen: Vec<(Vec3, f32)> = Vec::new();
    for face in faces {
        let (normal, offset) = plane(face);
        let same = |(other, distance): &(Vec3, f32)| other.dot(normal) > 1.0 - 1e-4 && (distance - offset).abs() < size * 1e-3;
        if normal == Vec3::ZERO || seen.iter().any(same) {
            continue;
        }
        seen.push((normal, offset));
        let side: Vec<u32> = (0..corners.len() as u32).filter(|i| (normal.dot(at(&corners, *i)) - offset).abs() < size * 1e-3).collect();
        if side.len() > 4 {
            let feet = four_of(&side, normal, |i| at(&corners, i));
            let thickness = corners.iter().map(|p| offset - normal.dot(*p)).fold(0.0, f32::max);
            let inwards = normal * (size * FEET).min(thickness * FEET_OF_THICKNESS);
            moved.extend(side.into_iter().filter(|i| !feet.contains(i)).map(|i| (i, inwards)));
        }
    }
    for (i, inwards) in moved {
        corners[i as usize] -= inwards;
    }
    corners
}

/// The two corners that are farthest from each other, and the farthest from their line on both sides of it.
fn four_of(side: &[u32], normal: Vec3, at: impl Fn(u32) -> Vec3) -> [u32; 4] {
    let farthest = |of: &dyn Fn(u32) -> f32| side.iter().copied().max_by(|a, b| of(*a).total_cmp(&of(*b))).unwrap_or_default();
    let first = farthest(&|i| at(i).distance(at(side[0])));
    let second = farthest(&|i| at(i).distance(at(first)));
    let across = normal.cross(at(second) - at(first));
    let beside = |i: u32| across.dot(at(i) - at(first));
    [first, second, farthest(&beside), farthest(&|i| -beside(i))]
}

/// A box, thick enough to be held.
pub(super) fn boxed(min: Vec3, max: Vec3) -> ColliderBuilder {
    let half = ((max - min) * 0.5).max(Vec3::splat(MIN_THICKNESS_M * 0.5));
    ColliderBuilder::cuboid(half.x, half.y, half.z).translation(Vector::from_array(((min + max) * 0.5).to_array()))
}

/// The 98 directions of whole numbers up to 2: spread evenly enough, and made without a function that differs between machines.
fn directions() -> impl Iterator<Item = Vec3> {
    let whole = || -2i8..=2;
    let all = whole().flat_map(move |x| whole().flat_map(move |y| whole().map(move |z| [x, y, z])));
    let shortest = |[x, y, z]: &[i8; 3]| [x, y, z].into_iter().any(|c| c % 2 != 0);
    all.filter(shortest).map(|[x, y, z]| Vec3::new(x.into(), y.into(), z.into()).normalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_are_98_and_different() {
        let all: Vec<_> = directions().collect();
        assert_eq!(all.len(), 98);
        for (i, a) in all.iter().enumerate() {
            assert!((a.length() - 1.0).abs() < 1e-6);
            assert!(all.iter().skip(i + 1).all(|b| a.dot(*b) < 0.99), "{a} twice");
        }
    }

    #[test]
    fn a_hull_of_many_points_holds_nearly_all_of_their_volume() {
        let grid = |i: i16| f32::from(i) / 8.0;
        let points: Vec<_> = (-8..=8)
            .flat_map(|x| (-8..=8).flat_map(move |y| (-8..=8).map(move |z| Vec3::new(grid(x), grid(y), grid(z)))))
            .filter(|p| p.length() <= 1.0)
            .collect();
        let volume = |hull: &Hull, scale| rapier3d::prelude::Collider::from(hull.collider(scale)).volume();
        let ball = std::f32::consts::PI * 4.0 / 3.0;
        let share = volume(&Hull::around(&points).unwrap(), Vec3::ONE) / ball;
        assert!((0.85..1.0).contains(&share), "{share}");
        // A scale on each axis multiplies the volume.
        let drum = Hull::drum().unwrap();
        let ratio = volume(&drum, Vec3::new(1.0, 2.0, 3.0)) / volume(&drum, Vec3::ONE);
        assert!((ratio - 6.0).abs() < 0.01, "{ratio}");
        assert!(volume(&Hull::ball().unwrap(), Vec3::ONE) / (ball / 8.0) > 0.9);
    }

    #[test]
    fn a_body_has_the_same_form_wherever_its_model_has_its_origin() {
        let points: Vec<_> = Hull::drum().unwrap().corners.iter().map(|p| *p * 0.25).collect();
        // An eighth, so that the sums are exact.
        let off = Vec3::new(2.0, 1.0, -4.0);
        let shifted: Vec<_> = points.iter().map(|p| *p + off).collect();
        let (own, shifted) = (Hull::around(&points).unwrap(), Hull::around(&shifted).unwrap());
        assert_eq!(own.corners.len(), shifted.corners.len());
        for corner in &own.corners {
            let apart = shifted.corners.iter().map(|other| other.distance(*corner + off)).fold(f32::INFINITY, f32::min);
            assert!(apart < 1e-5, "{corner} is {apart} m off");
        }
    }

    #[test]
    fn feet_of_a_thin_body_are_no_deeper_than_a_share_of_it() {
        let height = 0.15;
        let drum = Hull::drum().unwrap();
        let points: Vec<_> = drum.corners.iter().map(|p| Vec3::new(p.x, p.y.signum() * 0.5 * height, p.z)).collect();
        let hull = Hull::around(&points).unwrap();
        assert!(!hull.faces.is_empty());
        let least = hull.corners.iter().map(|p| p.y.abs()).fold(f32::INFINITY, f32::min);
        assert!(least >= height * (0.5 - FEET_OF_THICKNESS) - 1e-5, "a corner at {least} m of {height}");
    }

    #[test]
    fn degenerate_points_are_no_panic() {
        for scale in [1e-30, 1e-12, 1.0, 1e6] {
            for spread in [0.0, 1e-7, 1e-4, 1.0] {
                let point = |i: u8| Vec3::new(f32::from(i % 7), f32::from(i % 5) * spread, f32::from(i % 3)) * scale;
                let hull = Hull::around(&(0..=255).map(point).collect::<Vec<_>>()).unwrap();
                let _ = rapier3d::prelude::Collider::from(hull.collider(Vec3::ONE));
            }
        }
    }

    #[test]
    fn flat_and_tiny_things_are_boxes_that_can_be_held() {
        let sheet: Vec<_> = (0..16u8).map(|i| Vec3::new(f32::from(i % 4), 0.0, f32::from(i / 4))).collect();
        let hull = Hull::around(&sheet).unwrap();
        assert!(hull.faces.is_empty());
        let collider = rapier3d::prelude::Collider::from(hull.collider(Vec3::ONE));
        let cuboid = collider.shape().as_cuboid().unwrap();
        assert_eq!(cuboid.half_extents.to_array(), [1.5, MIN_THICKNESS_M * 0.5, 1.5]);
        assert!(Hull::around(&[Vec3::ONE]).unwrap().faces.is_empty());
        assert_eq!(Hull::around(&[]), None);
    }
}
