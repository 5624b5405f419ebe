//! What objects and the place are to the solver.

use std::collections::HashMap;

use glam::{DMat4, Vec3};
use mr360_protocol::asset::AssetId;
use mr360_protocol::scene::{Geometry, MAX_POSITION_M, PlaceMesh, Scene, Shape};
use rapier3d::prelude::{ColliderBuilder, Vector};

use super::gltf::{FormError, Triangles};
use super::hull::{Hull, boxed};

/// A plane has to have a body: this thick, its upper side where it is seen, metres.
const PLANE_THICKNESS_M: f32 = 0.02;
/// Largest body, metres: as wide as the world. What is larger nothing touches.
const MAX_BODY_M: f32 = 2.0 * MAX_POSITION_M;
/// No corner of the place lies farther out on any axis, metres: beyond it single precision has steps of half a centimetre.
const MAX_PLACE_M: f32 = 50.0 * MAX_POSITION_M;
/// Scales that differ by less are one: a sphere stays round.
const ROUND: f32 = 1e-3;

/// The forms of all that a scene names.
#[derive(Debug)]
pub struct Forms {
    hulls: HashMap<AssetId, Hull>,
    meshes: HashMap<AssetId, Triangles>,
    ball: Option<Hull>,
    drum: Option<Hull>,
}

impl Default for Forms {
    /// Of shapes alone.
    fn default() -> Self {
        Self { hulls: HashMap::new(), meshes: HashMap::new(), ball: Hull::ball(), drum: Hull::drum() }
    }
}

impl Forms {
    /// Reads the models of objects, library and place. One that tells no form is named in the log and takes no part: viewers may
    /// still draw it.
    #[must_use]
    pub fn read(scene: &Scene, bytes_of: impl Fn(AssetId) -> Option<bytes::Bytes>) -> Self {
        let mut forms = Self::default();
        let triangles = |id: AssetId| -> Result<Triangles, FormError> { Triangles::read(&bytes_of(id).ok_or(FormError::Missing)?) };
        let models = scene.objects.iter().map(|object| object.geometry).chain(scene.library.iter().map(|item| item.geometry));
        for geometry in models {
            let Geometry::Model(id) = geometry else { continue };
            if forms.hulls.contains_key(&id) {
                continue;
            }
            match triangles(id).and_then(|triangles| Hull::around(&triangles.corners).ok_or(FormError::Empty)) {
                Ok(hull) => drop(forms.hulls.insert(id, hull)),
                Err(fault) => tracing::warn!("model {id}: {fault}; its objects neither fall nor collide"),
            }
        }
        for mesh in &scene.place {
            if forms.meshes.contains_key(&mesh.model) {
                continue;
            }
            match triangles(mesh.model).and_then(Triangles::bounded) {
                Ok(triangles) => drop(forms.meshes.insert(mesh.model, triangles)),
                Err(fault) => tracing::warn!("place model {}: {fault}; objects fall through it", mesh.model),
            }
        }
        forms
    }

    /// An object's body in its own frame, scaled.
    pub(super) fn collider(&self, geometry: &Geometry, scale: Vec3) -> Option<ColliderBuilder> {
        let half = scale * 0.5;
        let equal = |a: f32, b: f32| (a - b).abs() <= ROUND * a.max(b);
        match geometry {
            Geometry::Shape(Shape::Sphere) if equal(scale.x, scale.y) && equal(scale.y, scale.z) => Some(ColliderBuilder::ball(half.x)),
            Geometry::Shape(Shape::Cylinder) if equal(scale.x, scale.z) => Some(ColliderBuilder::cylinder(half.y, half.x)),
            Geometry::Shape(Shape::Sphere) => self.ball.as_ref().map(|hull| hull.collider(scale)),
            Geometry::Shape(Shape::Cylinder) => self.drum.as_ref().map(|hull| hull.collider(scale)),
            Geometry::Shape(Shape::Cube) => Some(boxed(-half, half)),
            Geometry::Shape(Shape::Plane) => Some(boxed(Vec3::new(-half.x, -PLANE_THICKNESS_M, -half.z), Vec3::new(half.x, 0.0, half.z))),
            Geometry::Model(id) => self.hulls.get(id).filter(|hull| hull.extent(scale) <= MAX_BODY_M).map(|hull| hull.collider(scale)),
        }
    }

    /// A mesh of the place in the world.
    pub(super) fn place(&self, mesh: &PlaceMesh) -> Option<ColliderBuilder> {
        let triangles = self.meshes.get(&mesh.model)?;
        let PlaceMesh { transform, .. } = mesh;
        let world = DMat4::from_scale_rotation_translation(
            transform.scale.as_dvec3(),
            transform.rotation.as_dquat(),
            transform.position.as_dvec3(),
        );
        let corners: Vec<_> = triangles.corners.iter().map(|p| world.transform_point3(p.as_dvec3()).as_vec3()).collect();
        let sound = corners.iter().all(|corner| corner.abs().max_element() <= MAX_PLACE_M);
        if !sound {
            tracing::warn!("place model {}: reaches farther than {MAX_PLACE_M} m; objects fall through it", mesh.model);
            return None;
        }
        let corners = corners.into_iter().map(|corner| Vector::from_array(corner.to_array())).collect();
        let built = ColliderBuilder::trimesh(corners, triangles.indices.clone());
        if let Err(fault) = &built {
            tracing::warn!("place model {}: {fault}; objects fall through it", mesh.model);
        }
        built.ok()
    }
}
