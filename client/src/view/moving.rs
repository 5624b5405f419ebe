//! Objects that move in the layout as it is: what a hand leads is moved with every display frame, and only it.

use std::ops::Range;

use glam::{Mat3, Mat4, Vec3};
use mr360_protocol::scene::{ObjectId, Transform};
use mr360_shaders::source::Alpha;

use super::Renderer;
use super::plan::MAX_SHADOWS;
use super::stage::{Placed, Stage, is_even, world_bounds};
use crate::gpu::Gpu;
use crate::scene::mesh::Bounds;

/// Where in the layout an object is.
#[derive(Debug)]
pub(super) struct Slot {
    /// Of its first part.
    instance: u32,
    parts: u32,
    /// From a part's instance to the next part's: all objects of a run lie in between.
    stride: u32,
    /// In [`Stage::casters`], or in [`Stage::apart`].
    bounds_at: (bool, usize),
    /// In its own frame.
    bounds: Bounds,
    /// A ball, unless its scale makes it another shape.
    round: bool,
    /// The spheres that stand for it, and their middles in the object's frame, scaled.
    occluders: Range<usize>,
    middles: Vec<Vec3>,
    transform: Transform,
}

impl Slot {
    /// None for an object whose draws depend on where it is, or that moves by itself: its scene is laid out anew.
    pub(super) fn new(placed: &Placed<'_>, instance: u32, stride: u32, bounds_at: (bool, usize)) -> Option<Self> {
        let own = placed.object.material.is_none();
        let glass = placed.object.material.is_some_and(|material| material.kind == mr360_protocol::scene::MaterialKind::Glass);
        let sorted = |part: &super::models::GpuPart| part.surface.glass || part.look.alpha == Alpha::Blend;
        if glass || placed.animation.is_some() || (own && placed.model.parts.iter().any(sorted)) {
            return None;
        }
        Some(Self {
            instance,
            parts: placed.model.parts.len() as u32,
            stride,
            bounds_at,
            bounds: placed.bounds,
            round: placed.model.round,
            occluders: 0..0,
            middles: Vec::new(),
            transform: placed.object.transform,
        })
    }
}

/// Of an instance: to the world, and its normals.
pub(super) fn matrices(world_from_object: &Mat4) -> ([[f32; 4]; 4], [[f32; 4]; 3]) {
    let normals = Mat3::from_mat4(*world_from_object).inverse().transpose();
    (world_from_object.to_cols_array_2d(), normals.to_cols_array_2d().map(|[x, y, z]| [x, y, z, 0.0]))
}

impl Stage {
    /// Where the bounds of the next object will be.
    pub(super) fn place_of_next(&self, casting: bool) -> (bool, usize) {
        (casting, if casting { self.casters.len() } else { self.apart.len() })
    }

    /// Keeps whose spheres are where. Objects of scenes with more of them than there is room for cannot be moved.
    pub(super) fn hold_occluders(&mut self, ranges: &[(ObjectId, Range<usize>)]) {
        if ranges.is_empty() {
            self.slots.retain(|_, slot| !slot.bounds_at.0);
        }
        for (id, range) in ranges {
            let (Some(slot), Some(spheres)) = (self.slots.get_mut(id), self.occluders.get(range.clone())) else { continue };
            let Transform { position, rotation, .. } = slot.transform;
            slot.middles = spheres.iter().map(|sphere| rotation.inverse() * (Vec3::from_array(sphere.center) - position)).collect();
            slot.occluders = range.clone();
        }
    }

    /// Moves an object; whether it throws a shadow. None where the scene has to be laid out anew for it.
    pub(super) fn move_object(&mut self, id: ObjectId, transform: &Transform) -> Option<bool> {
        // Left out, as without its model: there is nothing to move.
        if !self.slots.contains_key(&id) && !self.targets.iter().any(|target| target.id == id) {
            return Some(false);
        }
        let slot = self.slots.get_mut(&id)?;
        // Spheres of another size are of another number, too.
        if !slot.middles.is_empty() && slot.transform.scale != transform.scale {
            return None;
        }
        slot.transform = *transform;
        let world_from_object = Mat4::from_scale_rotation_translation(transform.scale, transform.rotation, transform.position);
        let (world, normals) = matrices(&world_from_object);
        for part in 0..slot.parts {
            let instance = self.instances.get_mut((slot.instance + part * slot.stride) as usize)?;
            (instance.world_from_object, instance.normal_from_object) = (world, normals);
        }
        for (sphere, middle) in self.occluders.get_mut(slot.occluders.clone())?.iter_mut().zip(&slot.middles) {
            sphere.center = (transform.position + transform.rotation * *middle).to_array();
        }
        let (casts, at) = slot.bounds_at;
        let bounds = world_bounds(&slot.bounds, &world_from_object);
        let all = if casts { &mut self.casters } else { &mut self.apart };
        *all.get_mut(at)? = bounds;
        if casts {
            *self.round.get_mut(at)? = slot.round && is_even(transform.scale);
        }
        self.needs.beneath_ground |= self.is_beneath(&bounds);
        if let Some(target) = self.targets.iter_mut().find(|target| target.id == id) {
            target.transform = *transform;
        }
        Some(casts)
    }
}

impl Renderer {
    /// Shows objects elsewhere from the next frame on. False where one of them cannot be moved in the scene as it is laid out: set the scene
    /// anew then.
    pub fn move_objects(&mut self, gpu: &Gpu, moved: &[(ObjectId, Transform)]) -> bool {
        let mut shadows = false;
        for (id, transform) in moved {
            match self.stage.move_object(*id, transform) {
                Some(casts) => shadows |= casts,
                None => return false,
            }
        }
        if shadows {
            self.shadows = [None; MAX_SHADOWS];
        }
        self.resources.write_scene(gpu, &self.layouts, &self.stage);
        true
    }
}
