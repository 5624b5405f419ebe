//! What hands and rays look like: models made here, drawn for this viewer alone.

use std::sync::{Arc, LazyLock};

use glam::{Mat3, Quat, Vec3};
use mr360_protocol::asset::AssetId;
use mr360_protocol::scene::{Geometry, Material, Shape, Transform};

use super::input::Pose;
use super::{LocalObject, along};
use crate::scene::material::Surface;
use crate::scene::mesh::{Bounds, Mesh};
use crate::scene::model::{Model, Part};
use crate::scene::shapes;

/// A ray's diameter, metres.
const RAY_M: f32 = 0.004;
/// A mark's diameter as a share of its distance: so it is seen from afar.
const MARK: f32 = 0.012;
/// Linear; the same in every light, since it is light.
const RAY_COLOUR: Vec3 = Vec3::new(0.35, 0.75, 1.0);
/// Matt plastic, left and right a little different.
const PLASTIC: [Vec3; 2] = [Vec3::new(0.16, 0.17, 0.2), Vec3::new(0.2, 0.17, 0.15)];

static RAY: LazyLock<(AssetId, Arc<Model>)> = LazyLock::new(|| (AssetId::of(b"mr360 ray"), Arc::new(glow(Shape::Cylinder))));
static MARK_MODEL: LazyLock<(AssetId, Arc<Model>)> = LazyLock::new(|| (AssetId::of(b"mr360 mark"), Arc::new(glow(Shape::Sphere))));
static CONTROLLERS: LazyLock<[(AssetId, Arc<Model>); 2]> =
    LazyLock::new(|| [0, 1].map(|hand| (AssetId::of(&[b"mr360 hand"[..].to_vec(), vec![hand as u8]].concat()), Arc::new(handle(hand)))));

/// The model of this name, if it is made here.
#[must_use]
pub fn model(id: AssetId) -> Option<Arc<Model>> {
    [&*RAY, &*MARK_MODEL].into_iter().chain(&*CONTROLLERS).find(|(own, _)| *own == id).map(|(_, model)| Arc::clone(model))
}

/// A ray from a hand of a viewer of this size, so many metres long.
pub(crate) fn ray(aim: &Pose, length_m: f32, viewer: f32) -> LocalObject {
    let thick = RAY_M * viewer;
    let (direction, length) = (aim.forward(), length_m.max(thick));
    let transform = Transform {
        position: aim.position + direction * (length * 0.5),
        rotation: along(direction).normalize(),
        scale: Vec3::new(thick, length, thick),
    };
    local(RAY.0, transform, false)
}

/// Where a ray meets something, seen from `eyes` of a viewer of this size.
pub(super) fn mark(at: Vec3, eyes: Vec3, viewer: f32) -> LocalObject {
    let size = (at.distance(eyes) * MARK).max(RAY_M * viewer);
    local(MARK_MODEL.0, Transform { position: at, rotation: Quat::IDENTITY, scale: Vec3::splat(size) }, false)
}

/// A controller in the left hand, 0, or the right one, 1, of a viewer of this size.
pub(crate) fn controller(hand: usize, grip: &Pose, viewer: f32) -> LocalObject {
    let [left, right] = &*CONTROLLERS;
    let (id, _) = if hand == 0 { left } else { right };
    local(*id, Transform { position: grip.position, rotation: grip.orientation, scale: Vec3::splat(viewer) }, true)
}

fn local(id: AssetId, transform: Transform, casts: bool) -> LocalObject {
    LocalObject { geometry: Geometry::Model(id), transform, material: None::<Material>, casts }
}

fn glow(shape: Shape) -> Model {
    let surface = Surface { base_color: RAY_COLOUR, unlit: true, ..Surface::default() };
    model_of(vec![(shapes::mesh(shape), surface)])
}

/// In the frame of OpenXR's grip: +y along the handle to the thumb, −z to where the hand points.
fn handle(hand: usize) -> Model {
    let plastic = Surface { base_color: PLASTIC[hand.min(1)], roughness: 0.6, ..Surface::default() };
    let metal = Surface { base_color: Vec3::splat(0.6), roughness: 0.35, metallic: 1.0, ..Surface::default() };
    let tilt = Quat::from_rotation_x(-0.6);
    let side = if hand == 0 { -1.0 } else { 1.0 };
    model_of(vec![
        (placed(Shape::Cylinder, Vec3::new(0.0, -0.02, 0.01), Quat::IDENTITY, Vec3::new(0.034, 0.11, 0.034)), plastic.clone()),
        (placed(Shape::Sphere, Vec3::new(0.0, -0.075, 0.01), Quat::IDENTITY, Vec3::splat(0.034)), plastic.clone()),
        (placed(Shape::Cylinder, Vec3::new(0.0, 0.04, -0.015), tilt, Vec3::new(0.052, 0.028, 0.052)), plastic),
        // Stick and trigger tell which way it is held.
        (placed(Shape::Cylinder, Vec3::new(0.006 * side, 0.06, -0.02), tilt, Vec3::new(0.014, 0.018, 0.014)), metal.clone()),
        (placed(Shape::Sphere, Vec3::new(0.0, 0.02, -0.038), tilt, Vec3::new(0.016, 0.03, 0.02)), metal),
    ])
}

fn placed(shape: Shape, at: Vec3, rotation: Quat, size: Vec3) -> Mesh {
    let mut mesh = shapes::mesh(shape);
    let normals = Mat3::from_quat(rotation) * Mat3::from_diagonal(size.recip());
    for vertex in &mut mesh.vertices {
        vertex.position = (at + rotation * (Vec3::from_array(vertex.position) * size)).to_array();
        vertex.normal = (normals * Vec3::from_array(vertex.normal)).normalize().to_array();
    }
    mesh
}

fn model_of(parts: Vec<(Mesh, Surface)>) -> Model {
    let bounds = parts.iter().map(|(mesh, _)| mesh.bounds()).fold(Bounds::EMPTY, |all, one| all.joined(&one));
    let parts = parts.into_iter().map(|(mesh, surface)| Part { mesh, details: Vec::new(), surface }).collect();
    Model { parts, textures: Vec::new(), bounds, rig: None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ray_reaches_from_the_hand_to_where_it_ends() {
        let aim = Pose { position: Vec3::new(0.2, 1.0, 0.3), orientation: Quat::from_rotation_y(0.7) * Quat::from_rotation_x(-0.4) };
        let drawn = ray(&aim, 2.5, 1.0);
        let end = |y: f32| drawn.transform.position + drawn.transform.rotation * (Vec3::Y * y * drawn.transform.scale);
        assert!(end(-0.5).distance(aim.position) < 1e-5);
        assert!(end(0.5).distance(aim.position + aim.forward() * 2.5) < 1e-5);
        assert!(!drawn.casts);
        for direction in [Vec3::Y, Vec3::NEG_Y] {
            assert!((along(direction) * Vec3::Y).distance(direction) < 1e-5);
        }
    }

    #[test]
    fn what_is_drawn_is_made_here_and_within_a_hand() {
        for hand in 0..2 {
            let drawn = controller(hand, &Pose::IDENTITY, 1.0);
            let Geometry::Model(id) = drawn.geometry else { panic!("{drawn:?}") };
            let model = model(id).unwrap();
            assert!(model.bounds.half().max_element() < 0.15 && model.parts.len() == 5);
            for vertex in model.parts.iter().flat_map(|part| &part.mesh.vertices) {
                assert!((Vec3::from_array(vertex.normal).length() - 1.0).abs() < 1e-4);
            }
        }
        assert_ne!(controller(0, &Pose::IDENTITY, 1.0).geometry, controller(1, &Pose::IDENTITY, 1.0).geometry);
        assert!(model(AssetId::of(b"another")).is_none());
    }
}
