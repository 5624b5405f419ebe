//! How much one step may cost, whatever users bring together.

use mr360_protocol::scene::{MAX_OBJECTS, ObjectId};
use rapier3d::parry::bounding_volume::{Aabb, BoundingVolume};
use rapier3d::prelude::{ColliderHandle, ColliderSet};

use super::{Physics, pose};

/// Most pairs of objects with overlapping boxes in one step, of which one moves at least: eight for each of a full scene, more than a heap of
/// all of them has.
pub(super) const MAX_PAIRS: usize = 8 * MAX_OBJECTS;
/// Most triangles of the place that lie in the boxes of what moves, in one step.
pub(super) const MAX_TRIANGLES: usize = 16_384;
/// Boxes are looser by this than what they hold, metres: the solver's look ahead, and a step's way at a usual speed.
const LOOSE_M: f32 = 0.02;

/// Looks before it writes: what is written to counts as changed to the solver.
pub(super) fn set_enabled(colliders: &mut ColliderSet, collider: Option<ColliderHandle>, enabled: bool) {
    let differs = |collider: &ColliderHandle| colliders.get(*collider).is_some_and(|collider| collider.is_enabled() != enabled);
    if let Some(collider) = collider.filter(differs).and_then(|collider| colliders.get_mut(collider)) {
        collider.set_enabled(enabled);
    }
}

/// An object as it is about to be stepped.
struct Boxed {
    id: ObjectId,
    moves: bool,
    bounds: Aabb,
}

impl Physics {
    /// Takes out of the next step what would make it too long: a held object then passes through everything, another one hangs where it is
    /// until somebody takes hold of it. Those of the lowest ids stay in, so that the same wishes have the same end.
    pub(super) fn keep_affordable(&mut self) {
        let boxes = self.boxes();
        let mut in_step = vec![true; boxes.len()];
        let (mut pairs, mut triangles) = (0, 0);
        for (i, own) in boxes.iter().enumerate().filter(|(_, own)| own.moves) {
            let meets = |(j, other): &(usize, &Boxed)| (!other.moves || *j < i) && in_step[*j] && other.bounds.intersects(&own.bounds);
            let met = boxes.iter().enumerate().filter(meets).take(MAX_PAIRS + 1 - pairs).count();
            let touched = self.triangles_in(&own.bounds, MAX_TRIANGLES + 1 - triangles);
            if pairs + met > MAX_PAIRS || triangles + touched > MAX_TRIANGLES {
                in_step[i] = false;
            } else {
                (pairs, triangles) = (pairs + met, triangles + touched);
            }
        }
        for (own, in_step) in boxes.iter().zip(in_step).filter(|(own, _)| own.moves) {
            let Some(body) = self.bodies.get(&own.id) else { continue };
            if body.held {
                set_enabled(&mut self.world.colliders, body.collider, in_step);
            } else if !in_step && let Some(rigid) = self.world.bodies.get_mut(body.handle) {
                tracing::debug!(object = own.id.0, "too much is in one place; it hangs where it is until somebody takes hold of it");
                rigid.set_enabled(false);
            }
        }
    }

    /// Of all objects that something can touch, in order.
    fn boxes(&self) -> Vec<Boxed> {
        let boxed = |(id, body): (&ObjectId, &super::Body)| {
            let rigid = self.world.bodies.get(body.handle).filter(|rigid| rigid.is_enabled())?;
            let collider = self.world.colliders.get(body.collider?)?;
            let moves = body.held || (!body.fixed && !rigid.is_sleeping());
            let at = if body.held { pose(&body.transform) } else { *rigid.position() };
            Some(Boxed { id: *id, moves, bounds: collider.shape().compute_aabb(&at).loosened(LOOSE_M) })
        };
        self.bodies.iter().filter_map(boxed).collect()
    }

    /// So many triangles of the place lie in a box; they are counted no farther than to `most`.
    fn triangles_in(&self, bounds: &Aabb, most: usize) -> usize {
        let of_mesh = |collider: &ColliderHandle| self.world.colliders.get(*collider)?.shape().as_trimesh();
        self.place.iter().filter_map(of_mesh).flat_map(|mesh| mesh.bvh().intersect_aabb(bounds)).take(most).count()
    }
}
