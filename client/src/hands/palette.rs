//! The library in a user's hand: one item at a time, as a ghost where it would be put.

use glam::Vec3;
use mr360_protocol::intent::Action;
use mr360_protocol::scene::{LibraryItem, MAX_POSITION_M, Transform};

use super::ground::standing;
use super::hold::scaled;
use super::{LocalObject, World};
use crate::scene::pick::Ray;

/// Farthest point that something is put at, metres.
pub const MAX_REACH_M: f32 = 30.0;

/// What of the library is in hand.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Palette {
    item: Option<usize>,
    /// Of the item.
    name: Option<String>,
    /// Of the ghost, about the vertical, radians.
    yaw_rad: f32,
    /// Of the ghost, beside the item's own.
    scale: f32,
}

impl Palette {
    /// The item in hand.
    #[must_use]
    pub fn item(&self) -> Option<usize> {
        self.item
    }

    /// The next item; none after the last.
    pub fn cycle(&mut self, library: &[LibraryItem]) {
        self.choose(Some(self.item.map_or(0, |item| item + 1)), library);
    }

    /// This item; none where the library has no such.
    pub fn choose(&mut self, item: Option<usize>, library: &[LibraryItem]) {
        let chosen = item.and_then(|item| Some((item, library.get(item)?)));
        *self = Self { item: chosen.map(|(item, _)| item), name: chosen.map(|(_, item)| item.name.clone()), yaw_rad: 0.0, scale: 1.0 };
    }

    /// Puts the item away that the library does not hold any more where it was, as after a new broadcast.
    pub fn keep_to(&mut self, library: &[LibraryItem]) {
        let there = self.item.and_then(|item| library.get(item)).map(|item| &item.name);
        if there != self.name.as_ref() {
            self.choose(None, library);
        }
    }

    /// Turns the ghost left, radians.
    pub fn turn_by(&mut self, angle_rad: f32) {
        self.yaw_rad = (self.yaw_rad + angle_rad).rem_euclid(std::f32::consts::TAU);
    }

    /// Makes the ghost larger.
    pub fn scale_by(&mut self, factor: f32) {
        self.scale *= factor;
    }

    /// Where the item would stand that is pointed with: on the object there, or on the ground.
    #[must_use]
    pub fn place(&self, ray: &Ray, world: &impl World) -> Option<(u16, Transform)> {
        let index = self.item?;
        let item = world.library().get(index)?;
        let within = |at: &Vec3| at.is_finite() && at.abs().max_element() < MAX_POSITION_M && at.distance(ray.origin) <= MAX_REACH_M;
        let at = world.pick(ray).map(|(_, at)| at).or_else(|| ray.ground(world.ground_y(), MAX_REACH_M)).filter(within)?;
        let bounds = world.bounds(&item.geometry)?;
        // Its front to whoever points.
        let towards = ray.origin - at;
        let yaw = towards.x.atan2(towards.z) + self.yaw_rad;
        Some((u16::try_from(index).ok()?, standing(at, yaw, scaled(item.scale, self.scale), &bounds)))
    }

    /// The wish that puts it there.
    #[must_use]
    pub fn put(&self, ray: &Ray, world: &impl World) -> Option<Action> {
        let (item, transform) = self.place(ray, world)?;
        transform.validate("put").is_ok().then_some(Action::Put { item, transform })
    }

    /// The item as it would be there, lit and shaded as it would be.
    #[must_use]
    pub fn ghost(&self, ray: &Ray, world: &impl World) -> Option<LocalObject> {
        let (item, transform) = self.place(ray, world)?;
        let LibraryItem { geometry, material, .. } = world.library().get(usize::from(item))?;
        Some(LocalObject { geometry: *geometry, transform, material: *material, casts: true })
    }
}
