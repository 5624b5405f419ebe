//! Spheres that stand for an object where it hides the sky from others.

use std::f32::consts::PI;

use glam::Vec3;

use super::mesh::{Bounds, Mesh};

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

impl Sphere {
    /// Of an object of this scale, where the sphere is of the unscaled one.
    #[must_use]
    pub fn scaled(self, scale: Vec3) -> Self {
        Self { center: self.center * scale, radius: self.radius * scale.abs().element_product().cbrt() }
    }
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

/// Spheres that hide as much as a mesh does, at most 27: one in each part of its box, in the middle of the surface there and
/// with as much surface. A closed convex body hides a quarter of its surface, averaged over directions (Cauchy). In the mesh's
/// own frame.
#[must_use]
pub fn of_surface<'a>(meshes: impl Iterator<Item = &'a Mesh>, bounds: &Bounds) -> Vec<Sphere> {
    let half = bounds.half();
    let side = (half.min_element() * 1.1).max(half.max_element() / MOST_ALONG_AXIS).max(f32::MIN_POSITIVE);
    let counts = (half / side - 0.2).ceil().clamp(Vec3::ONE, Vec3::splat(MOST_ALONG_AXIS));
    // Surface, and that times its middle.
    let mut cells = [(0.0f32, Vec3::ZERO); 27];
    let mut add = |middle: Vec3, area: f32| {
        let at =
            ((middle - bounds.min) / (2.0 * half).max(Vec3::splat(f32::MIN_POSITIVE)) * counts).floor().clamp(Vec3::ZERO, counts - 1.0);
        if let Some(cell) = cells.get_mut((at.x + MOST_ALONG_AXIS * (at.y + MOST_ALONG_AXIS * at.z)) as usize) {
            *cell = (cell.0 + area, cell.1 + middle * area);
        }
    };
    for mesh in meshes {
        for corners in mesh.indices.chunks_exact(3) {
            let corner = |at: usize| corners.get(at).and_then(|at| mesh.vertices.get(*at as usize)).map(|v| Vec3::from_array(v.position));
            if let [Some(a), Some(b), Some(c)] = [corner(0), corner(1), corner(2)] {
                for_each_piece([a, b, c], side, &mut add);
            }
        }
    }
    let sphere = |(area, sum): &(f32, Vec3)| Sphere { center: *sum / *area, radius: (area / (4.0 * PI)).sqrt() };
    cells.iter().filter(|(area, _)| *area > 0.0).map(sphere).filter(|s| s.center.is_finite() && s.radius.is_finite()).collect()
}

/// Middles and areas of a triangle's pieces, of which each lies about within one part of the box.
fn for_each_piece([a, b, c]: [Vec3; 3], side: f32, add: &mut impl FnMut(Vec3, f32)) {
    let longest = (b - a).length().max((c - a).length()).max((c - b).length());
    let pieces = (longest / side).ceil().clamp(1.0, 4.0 * MOST_ALONG_AXIS) as u32;
    let area = 0.5 * (b - a).cross(c - a).length() / (pieces * pieces) as f32;
    let (right, up) = ((b - a) / pieces as f32, (c - a) / pieces as f32);
    for i in 0..pieces {
        for j in 0..pieces - i {
            let corner = a + right * i as f32 + up * j as f32;
            add(corner + (right + up) / 3.0, area);
            if i + j + 1 < pieces {
                add(corner + (right + up) * (2.0 / 3.0), area);
            }
        }
    }
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
    use crate::scene::shapes;
    use mr360_protocol::scene::Shape;

    #[test]
    fn a_ball_is_itself_and_a_box_is_filled() {
        let unit = Bounds { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) };
        assert_eq!(cover(&unit, Vec3::splat(2.0), true), [Sphere { center: Vec3::ZERO, radius: 1.0 }]);
        let pole = cover(&unit, Vec3::new(0.2, 1.0, 0.2), false);
        assert_eq!(pole.len(), 3);
        assert!(pole.iter().all(|s| s.center.x == 0.0 && s.center.y.abs() + s.radius < 0.51));
        assert!(cover(&unit, Vec3::new(1.0, 0.001, 1.0), false).len() <= 27);
    }

    fn surface(spheres: &[Sphere]) -> f32 {
        spheres.iter().map(|s| 4.0 * PI * s.radius * s.radius).sum()
    }

    #[test]
    fn spheres_have_the_surface_of_the_mesh_and_lie_where_it_does() {
        for (shape, area) in [(Shape::Cube, 6.0), (Shape::Sphere, PI), (Shape::Cylinder, 1.5 * PI)] {
            let mesh = shapes::mesh(shape);
            let found = surface(&of_surface([&mesh].into_iter(), &mesh.bounds()));
            // A mesh of flat faces has a little less than the round body.
            assert!((found / area - 1.0).abs() < 0.02, "{shape:?}: {found} against {area}");
        }
        // A table: a wide top and a thin leg at one end, which its box does not tell from a solid block.
        let block = |low: Vec3, high: Vec3| {
            let mut mesh = shapes::mesh(Shape::Cube);
            for vertex in &mut mesh.vertices {
                vertex.position = (low + (Vec3::from_array(vertex.position) + 0.5) * (high - low)).to_array();
            }
            mesh
        };
        let (top, leg) = (block(Vec3::new(0.0, 0.9, 0.0), Vec3::new(3.0, 1.0, 1.0)), block(Vec3::ZERO, Vec3::new(0.1, 0.9, 0.1)));
        let bounds = Bounds { min: Vec3::ZERO, max: Vec3::new(3.0, 1.0, 1.0) };
        let spheres = of_surface([&top, &leg].into_iter(), &bounds);
        assert!((surface(&spheres) / (6.0 + 0.8 + 0.02 + 0.36) - 1.0).abs() < 0.02, "{spheres:?}");
        assert!(spheres.len() <= 27 && spheres.iter().all(|s| s.center.cmpge(Vec3::ZERO).all() && s.center.cmple(bounds.max).all()));
        assert!(spheres.iter().filter(|s| s.center.x > 1.0).all(|s| s.center.y > 0.9), "{spheres:?}");
        assert!(of_surface(std::iter::empty(), &Bounds::EMPTY).is_empty());
    }
}
