//! Spheres that stand for an object where it hides the sky from others.

use glam::Vec3;

use super::mesh::Bounds;

/// Most spheres along one axis of an object.
const MOST_ALONG_AXIS: f32 = 3.0;

/// A sphere in the frame of an object's scaled bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// Metres.
    pub center: Vec3,
    /// Metres.
    pub radius: f32,
}

/// One sphere for a round object, else at most 27 that fill a box without reaching out of its thinnest side
/// by more than a tenth. `bounds` are in the object's frame, before its scale.
#[must_use]
pub fn cover(bounds: &Bounds, scale: Vec3, round: bool) -> Vec<Sphere> {
    let (center, half) = (bounds.center() * scale, bounds.half() * scale);
    let (thin, wide) = (half.min_element(), half.max_element());
    if round && wide <= thin * 1.01 {
        return vec![Sphere { center, radius: wide }];
    }
    // A sheet or a rod is stood for by spheres a third of its width, which hide about as much sky from afar.
    let radius = (thin * 1.1).max(wide / MOST_ALONG_AXIS);
    let counts = (half / radius - 0.2).ceil().clamp(Vec3::ONE, Vec3::splat(MOST_ALONG_AXIS));
    let reach = (half - radius).max(Vec3::ZERO);
    let along = |count: f32, reach: f32| {
        (0..count as u32).map(move |i| if count > 1.0 { reach * (2.0 * i as f32 / (count - 1.0) - 1.0) } else { 0.0 })
    };
    let mut spheres = Vec::new();
    for x in along(counts.x, reach.x) {
        for y in along(counts.y, reach.y) {
            spheres.extend(along(counts.z, reach.z).map(|z| Sphere { center: center + Vec3::new(x, y, z), radius }));
        }
    }
    spheres
}

/// One sphere with the volume of the ellipsoid in the bounds, for crowded scenes.
#[must_use]
pub fn single(bounds: &Bounds, scale: Vec3) -> Sphere {
    let half = (bounds.half() * scale).max(Vec3::splat(1e-4));
    Sphere { center: bounds.center() * scale, radius: (half.x * half.y * half.z).cbrt() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ball_is_itself_and_a_box_is_filled() {
        let unit = Bounds { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) };
        assert_eq!(cover(&unit, Vec3::splat(2.0), true), [Sphere { center: Vec3::ZERO, radius: 1.0 }]);
        let pole = cover(&unit, Vec3::new(0.2, 1.0, 0.2), false);
        assert_eq!(pole.len(), 3);
        assert!(pole.iter().all(|s| s.center.x == 0.0 && s.center.y.abs() + s.radius < 0.51));
        assert!(cover(&unit, Vec3::new(1.0, 0.001, 1.0), false).len() <= 27);
    }
}
