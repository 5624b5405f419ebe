//! Meshes of the built-in shapes, one metre across.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};
use mr360_protocol::scene::Shape;
use mr360_shaders::layout::Vertex;

use super::mesh::Mesh;

/// Steps around spheres and cylinders.
const AROUND: u32 = 48;

/// The mesh of a shape.
#[must_use]
pub fn mesh(shape: Shape) -> Mesh {
    match shape {
        Shape::Sphere => sphere(),
        Shape::Cube => cube(),
        Shape::Cylinder => cylinder(),
        Shape::Plane => plane(),
    }
}

fn vertex(position: Vec3, normal: Vec3, uv: Vec2) -> Vertex {
    Vertex { position: position.to_array(), normal: normal.to_array(), uv: uv.to_array() }
}

/// Two triangles for each cell of a grid of vertices, `columns + 1` in a row, rows going down seen from outside.
fn grid(columns: u32, rows: u32) -> Vec<u32> {
    let cell = |row: u32, column: u32| {
        let at = row * (columns + 1) + column;
        let below = at + columns + 1;
        [at, below, at + 1, at + 1, below, below + 1]
    };
    (0..rows).flat_map(|row| (0..columns).flat_map(move |column| cell(row, column))).collect()
}

fn sphere() -> Mesh {
    let rows = AROUND / 2;
    let at = |row: u32, column: u32| {
        let uv = Vec2::new(column as f32 / AROUND as f32, row as f32 / rows as f32);
        let (longitude, polar) = (uv.x * TAU, uv.y * PI);
        let normal = Vec3::new(polar.sin() * longitude.sin(), polar.cos(), polar.sin() * longitude.cos());
        vertex(normal * 0.5, normal, uv)
    };
    let vertices = (0..=rows).flat_map(|row| (0..=AROUND).map(move |column| at(row, column))).collect();
    Mesh { vertices, indices: grid(AROUND, rows) }
}

/// A square of side 1 at half a metre along its normal; `right` and `up` as seen from outside.
fn face(right: Vec3, up: Vec3, distance: f32) -> [Vertex; 4] {
    let normal = right.cross(up);
    [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)].map(|(u, v)| {
        let position = right * (u - 0.5) + up * (0.5 - v) + normal * distance;
        vertex(position, normal, Vec2::new(u, v))
    })
}

fn cube() -> Mesh {
    let faces = [
        (Vec3::X, Vec3::Y),
        (Vec3::NEG_X, Vec3::Y),
        (Vec3::Z, Vec3::Y),
        (Vec3::NEG_Z, Vec3::Y),
        (Vec3::X, Vec3::Z),
        (Vec3::X, Vec3::NEG_Z),
    ];
    let vertices = faces.into_iter().flat_map(|(right, up)| face(right, up, 0.5)).collect();
    let indices = (0..6).flat_map(|at| grid(1, 1).into_iter().map(move |i| at * 4 + i)).collect();
    Mesh { vertices, indices }
}

fn plane() -> Mesh {
    Mesh { vertices: face(Vec3::X, Vec3::NEG_Z, 0.0).to_vec(), indices: grid(1, 1) }
}

fn cylinder() -> Mesh {
    let ring = |column: u32| {
        let (sine, cosine) = (column as f32 / AROUND as f32 * TAU).sin_cos();
        Vec3::new(sine, 0.0, cosine)
    };
    let side = |row: u32, column: u32| {
        let (normal, y) = (ring(column), 0.5 - row as f32);
        vertex(normal * 0.5 + Vec3::Y * y, normal, Vec2::new(column as f32 / AROUND as f32, row as f32))
    };
    let mut mesh =
        Mesh { vertices: (0..=1).flat_map(|row| (0..=AROUND).map(move |column| side(row, column))).collect(), indices: grid(AROUND, 1) };
    for normal in [Vec3::Y, Vec3::NEG_Y] {
        let center = mesh.vertices.len() as u32;
        mesh.vertices.push(vertex(normal * 0.5, normal, Vec2::splat(0.5)));
        for column in 0..=AROUND {
            let rim = ring(column);
            mesh.vertices.push(vertex(rim * 0.5 + normal * 0.5, normal, Vec2::new(0.5 + 0.5 * rim.x, 0.5 + 0.5 * rim.z)));
        }
        let fan = |column: u32| {
            let (a, b) = (center + 1 + column, center + 2 + column);
            if normal.y > 0.0 { [center, a, b] } else { [center, b, a] }
        };
        mesh.indices.extend((0..AROUND).flat_map(fan));
    }
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_are_one_metre_across_closed_and_face_outwards() {
        for (shape, area, volume) in
            [(Shape::Sphere, PI, PI / 6.0), (Shape::Cube, 6.0, 1.0), (Shape::Cylinder, 1.5 * PI, PI / 4.0), (Shape::Plane, 1.0, 0.0)]
        {
            let mesh = mesh(shape);
            let bounds = mesh.bounds();
            let expected = if shape == Shape::Plane { Vec3::new(0.5, 0.0, 0.5) } else { Vec3::splat(0.5) };
            assert!((bounds.half() - expected).abs().max_element() < 1e-5, "{shape:?}: {bounds:?}");
            let (mut found_area, mut found_volume) = (0.0, 0.0);
            for corners in mesh.indices.chunks_exact(3) {
                let [a, b, c] = [0, 1, 2].map(|i| mesh.vertices[corners[i] as usize]);
                let [pa, pb, pc] = [a, b, c].map(|v| Vec3::from_array(v.position));
                let cross = (pb - pa).cross(pc - pa);
                let normal = Vec3::from_array(a.normal) + Vec3::from_array(b.normal) + Vec3::from_array(c.normal);
                // Triangles at the poles have no area but rounding.
                assert!(cross.dot(normal) >= -1e-6, "{shape:?} has a triangle that faces inwards");
                found_area += cross.length() * 0.5;
                found_volume += pa.dot(pb.cross(pc)) / 6.0;
            }
            // 48 steps around a circle miss 0.3 % of its area.
            assert!((found_area - area).abs() < 0.01 * area, "{shape:?}: {found_area}");
            assert!((found_volume - volume).abs() < 0.01, "{shape:?}: {found_volume}");
        }
    }
}
