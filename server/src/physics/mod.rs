//! Physics of the scene: what is let go of falls, flies, collides and comes to rest, the same for every viewer.
//!
//! Steps are of fixed length and nothing in here asks for the time, so that the same wishes between the same steps end in the same
//! place, bit for bit, on every machine: the solver computes in its deterministic mode, and what is computed here in single precision alone
//! or by f64 types, which have no vector instructions. While everything rests, nothing is computed.

mod crowd;
mod form;
mod gltf;
mod hull;
#[cfg(test)]
mod test_models;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use glam::{DQuat, Quat, Vec3};
use mr360_protocol::intent::{MAX_SPEED_M_S, MAX_SPIN_RAD_S, Motion};
use mr360_protocol::scene::{Geometry, MAX_POSITION_M, Object, ObjectId, Scene, Transform};
use rapier3d::prelude::{
    ColliderBuilder, ColliderHandle, PhysicsWorld, Pose, RigidBodyBuilder, RigidBodyHandle, RigidBodyType, Rotation, Vector,
};

pub use form::Forms;

/// Length of a step, seconds: one for each delta that viewers get.
pub const STEP_S: f32 = 1.0 / 60.0;

/// Water-soaked wood to light plastic; only ratios of masses matter, and these are of volumes.
const DENSITY_KG_M3: f32 = 500.0;
/// Dry wood on wood.
const FRICTION: f32 = 0.6;
/// Wood on stone; a stack comes to rest.
const RESTITUTION: f32 = 0.25;
/// Air, a second.
const LINEAR_DAMPING: f32 = 0.05;
/// Stands for rolling friction, which the solver does not have: without it a ball never stops.
const ANGULAR_DAMPING: f32 = 0.8;
/// Smaller moves are not told to viewers: a tenth of a millimetre.
const TOLD_M: f32 = 1e-4;
/// Smaller turns are not told to viewers, half the angle in radians.
const TOLD_RAD: f32 = 1e-4;
/// A held object that is asked to go farther in one step is there at once, and pushes nothing on its way.
const MAX_PUSH_M: f32 = MAX_SPEED_M_S * STEP_S;

/// Bodies of the scene's objects on its ground, among the meshes of its place.
pub struct Physics {
    world: PhysicsWorld,
    bodies: BTreeMap<ObjectId, Body>,
    /// The meshes of the place.
    place: Vec<ColliderHandle>,
    forms: Forms,
    /// Something moves, or may.
    awake: bool,
}

struct Body {
    handle: RigidBodyHandle,
    /// None where its model tells no form: it is where it was put, and nothing touches it.
    collider: Option<ColliderHandle>,
    geometry: Geometry,
    /// The scale that the collider was made for; none where it has to be made anew.
    formed: Option<Vec3>,
    /// Stays where it is put.
    fixed: bool,
    held: bool,
    /// It is out of the steps, which it would make too long; so many triangles of the place lie in its box.
    hangs: Option<usize>,
    /// It was let go of since the last step.
    let_go: Option<Motion>,
    /// As viewers know it; of a held one, where it is to go.
    transform: Transform,
}

impl Physics {
    /// Every object of the scene at rest where its author put it, even in the air: it falls once it was touched.
    #[must_use]
    pub fn new(scene: &Scene, fixed: impl Fn(ObjectId) -> bool, forms: Forms) -> Self {
        let mut world = PhysicsWorld::new();
        world.integration_parameters.dt = STEP_S;
        world.integration_parameters.normalized_max_linear_velocity = MAX_SPEED_M_S * 3.0;
        let ground =
            ColliderBuilder::halfspace(rapier3d::na::Unit::new_unchecked(Vector::Y)).translation(Vector::new(0.0, scene.ground_y, 0.0));
        world.insert_collider(surface(ground), None);
        let place = scene.place.iter().filter_map(|mesh| forms.place(mesh));
        let place = place.map(|collider| world.insert_collider(surface(collider), None)).collect();
        let mut physics = Self { world, bodies: BTreeMap::new(), place, forms, awake: false };
        for object in &scene.objects {
            physics.insert(object, fixed(object.id), true);
        }
        physics
    }

    /// Adds an object, which falls at once unless it is fixed.
    pub fn add(&mut self, object: &Object, fixed: bool) {
        self.insert(object, fixed, false);
        self.awake |= !fixed;
    }

    fn insert(&mut self, object: &Object, fixed: bool, asleep: bool) {
        let transform = object.transform;
        let collider = self.forms.collider(&object.geometry, transform.scale);
        let stays = fixed || collider.is_none();
        let kind = if stays { RigidBodyType::KinematicPositionBased } else { RigidBodyType::Dynamic };
        let body = RigidBodyBuilder::new(kind)
            .pose(pose(&transform))
            .linear_damping(LINEAR_DAMPING)
            .angular_damping(ANGULAR_DAMPING)
            .ccd_enabled(true)
            .sleeping(asleep || stays);
        let handle = self.world.insert_body(body);
        let collider = collider.map(|collider| self.world.insert_collider(surface(collider), Some(handle)));
        let (geometry, formed) = (object.geometry, Some(transform.scale));
        let body = Body { handle, collider, geometry, formed, fixed, held: false, hangs: None, let_go: None, transform };
        self.bodies.insert(object.id, body);
    }

    /// Takes an object away. What leant on it falls.
    pub fn remove(&mut self, object: ObjectId) {
        if let Some(body) = self.bodies.remove(&object) {
            self.world.remove_body(body.handle);
            self.awake = true;
        }
    }

    /// Somebody takes hold of an object: it goes where [`Physics::move_to`] says, and pushes what is in its way.
    pub fn hold(&mut self, object: ObjectId) {
        let Some(body) = self.bodies.get_mut(&object).filter(|body| !body.held) else { return };
        (body.held, body.hangs, body.let_go) = (true, None, None);
        if let Some(rigid) = self.world.bodies.get_mut(body.handle) {
            rigid.set_enabled(true);
            rigid.set_body_type(RigidBodyType::KinematicPositionBased, true);
        }
        if body.collider.and_then(|collider| self.world.colliders.get(collider)).is_some_and(|collider| !collider.is_enabled()) {
            // Its motion or its form was not finite.
            body.formed = None;
        }
        self.awake = true;
    }

    /// Where a held object is to be after the next step.
    pub fn move_to(&mut self, object: ObjectId, transform: Transform) {
        let Some(body) = self.bodies.get_mut(&object).filter(|body| body.held) else { return };
        body.transform = transform;
        self.awake = true;
    }

    /// Lets go of a held object, which the next step has flying.
    pub fn release(&mut self, object: ObjectId, motion: Motion) {
        let Some(body) = self.bodies.get_mut(&object).filter(|body| body.held) else { return };
        (body.held, body.let_go) = (false, Some(motion.bounded()));
        self.awake = true;
    }

    /// One step. The objects that moved by themselves, as viewers are to see them, in order.
    pub fn step(&mut self) -> Vec<(ObjectId, Transform)> {
        if !self.awake {
            return Vec::new();
        }
        self.reform();
        self.lead_held();
        self.throw();
        let may_come_back = self.keep_affordable();
        self.world.step();
        if !self.world.quarantine().is_empty() {
            tracing::error!("an object's motion was not finite; it stays where it was until somebody takes hold of it");
        }
        let mut moved = Vec::new();
        for (id, body) in self.bodies.iter_mut().filter(|(_, body)| !body.held && !body.fixed) {
            let Some(rigid) = self.world.bodies.get_mut(body.handle) else { continue };
            if !rigid.is_sleeping() {
                keep_in_bounds(rigid);
            }
            let (at, rotation) = (position(rigid.position()), quaternion(rigid.rotation()));
            let told = body.transform;
            let differs = if rigid.is_sleeping() || !rigid.is_enabled() {
                (at, rotation) != (told.position, told.rotation)
            } else {
                at.distance_squared(told.position) > TOLD_M * TOLD_M || half_turn(rotation, told.rotation) > TOLD_RAD
            };
            if differs {
                body.transform = Transform { position: at, rotation, ..told };
                moved.push((*id, body.transform));
            }
        }
        self.awake = may_come_back || self.world.islands.num_active_bodies() > 0;
        moved
    }

    /// Nothing moves, and nothing will before somebody wishes for something.
    #[must_use]
    pub fn at_rest(&self) -> bool {
        !self.awake
    }

    /// Makes the colliders of what was scaled anew, each once, however often it was.
    fn reform(&mut self) {
        for body in self.bodies.values_mut().filter(|body| body.formed != Some(body.transform.scale)) {
            if let Some(old) = body.collider.take() {
                self.world.remove_collider(old);
            }
            let form = self.forms.collider(&body.geometry, body.transform.scale);
            body.collider = form.map(|form| self.world.insert_collider(surface(form), Some(body.handle)));
            body.formed = Some(body.transform.scale);
        }
    }

    /// Has what was let go of fly.
    fn throw(&mut self) {
        for body in self.bodies.values_mut() {
            let Some(motion) = body.let_go.take() else { continue };
            let (pose, free) = (pose(&body.transform), !body.fixed && body.collider.is_some());
            crowd::set_enabled(&mut self.world.colliders, body.collider, true);
            let Some(rigid) = self.world.bodies.get_mut(body.handle) else { continue };
            rigid.set_position(pose, true);
            if free {
                rigid.set_body_type(RigidBodyType::Dynamic, true);
                rigid.recompute_mass_properties_from_colliders(&self.world.colliders);
                let (linear, angular) = (vector(motion.linear), vector(motion.angular));
                // The motion is that of the origin, the solver wants that of the middle of mass.
                let arm = rigid.center_of_mass() - pose.translation;
                rigid.set_linvel(linear + angular.cross(arm), true);
                rigid.set_angvel(angular, true);
            }
        }
    }

    fn lead_held(&mut self) {
        for body in self.bodies.values().filter(|body| body.held) {
            let Some(rigid) = self.world.bodies.get_mut(body.handle) else { continue };
            let to = pose(&body.transform);
            if *rigid.position() == to {
                continue;
            }
            if (to.translation - rigid.translation()).length() > MAX_PUSH_M {
                rigid.set_position(to, true);
            } else {
                rigid.set_next_kinematic_position(to);
            }
        }
    }
}

/// What flies off the edge of the world goes no farther; nothing spins faster than wishes may.
fn keep_in_bounds(rigid: &mut rapier3d::prelude::RigidBody) {
    let at = *rigid.position();
    let edge = Vector::splat(MAX_POSITION_M);
    let inside = at.translation.clamp(-edge, edge);
    if inside != at.translation {
        rigid.set_position(Pose::from_parts(inside, at.rotation), false);
        rigid.set_linvel(Vector::ZERO, false);
    }
    let most = Vector::splat(MAX_SPIN_RAD_S);
    if rigid.angvel().abs().max_element() > MAX_SPIN_RAD_S {
        let slower = rigid.angvel().clamp(-most, most);
        rigid.set_angvel(slower, false);
    }
}

fn surface(collider: ColliderBuilder) -> ColliderBuilder {
    collider.density(DENSITY_KG_M3).friction(FRICTION).restitution(RESTITUTION)
}

fn vector(v: Vec3) -> Vector {
    Vector::from_array(v.to_array())
}

fn pose(transform: &Transform) -> Pose {
    Pose::from_parts(vector(transform.position), Rotation::from_array(transform.rotation.to_array()))
}

fn position(pose: &Pose) -> Vec3 {
    Vec3::from_array(pose.translation.to_array())
}

fn quaternion(rotation: &Rotation) -> Quat {
    let [x, y, z, w] = rotation.to_array();
    DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into()).normalize().as_quat()
}

/// Half the angle between two turns, for small ones.
fn half_turn(a: Quat, b: Quat) -> f32 {
    (a.as_dquat() * b.as_dquat().inverse()).xyz().length() as f32
}
