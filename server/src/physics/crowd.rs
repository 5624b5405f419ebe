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

/// What an object does in the step that is about to be made.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Part {
    /// Nothing, unless something hits it.
    Rests,
    Held,
    Free,
    /// Nothing, unless there is room for it again; so many triangles of the place lie in its box.
    Hangs(usize),
}

/// An object as it is about to be stepped.
struct Boxed {
    id: ObjectId,
    part: Part,
    bounds: Aabb,
}

impl Physics {
    /// Takes out of the next step what would make it too long: a held object then passes through everything, another one hangs where it is
    /// until there is room for it. Those of the lowest ids stay in, and come back first, so that the same wishes have the same end.
    ///
    /// True while something hangs for which there may be room after this step without anybody's wish, as others move.
    pub(super) fn keep_affordable(&mut self) -> bool {
        let boxes = self.boxes();
        let in_step = self.affordable(&boxes);
        let (mut changing, mut waiting) = (false, false);
        for (own, in_step) in boxes.iter().zip(in_step) {
            match own.part {
                Part::Rests => continue,
                Part::Held => {
                    let collider = self.bodies.get(&own.id).and_then(|body| body.collider);
                    set_enabled(&mut self.world.colliders, collider, in_step);
                    continue;
                }
                Part::Free if !in_step => self.hang(own),
                Part::Hangs(_) if in_step => self.bring_back(own.id),
                Part::Free | Part::Hangs(_) => {}
            }
            changing |= in_step || own.part == Part::Free;
            waiting |= !in_step;
        }
        changing && waiting
    }

    /// Of each object whether it is in the step: all that rests, what moves as far as there is room, and last what hangs. That may use half
    /// of the room alone, so that it is not taken out again as soon as a heap stirs; all of it where nothing else uses any.
    fn affordable(&self, boxes: &[Boxed]) -> Vec<bool> {
        let mut in_step: Vec<bool> = boxes.iter().map(|own| own.part == Part::Rests).collect();
        let (mut pairs, mut triangles) = (0, 0);
        let moving = boxes.iter().enumerate().filter(|(_, own)| matches!(own.part, Part::Held | Part::Free));
        let hanging = boxes.iter().enumerate().filter(|(_, own)| matches!(own.part, Part::Hangs(_)));
        for (i, own) in moving.chain(hanging) {
            // Each pair counts once: with the one of the two that comes later.
            let meets = |(other, in_step): &(&Boxed, &bool)| **in_step && other.bounds.intersects(&own.bounds);
            let met = boxes.iter().zip(&in_step).filter(meets).take(MAX_PAIRS + 1 - pairs).count();
            let (touched, share) = match own.part {
                // Neither it nor the place has moved since they were counted.
                Part::Hangs(touched) => (touched, if (pairs, triangles) == (0, 0) { 1 } else { 2 }),
                _ => (self.triangles_in(&own.bounds, MAX_TRIANGLES + 1 - triangles), 1),
            };
            if pairs + met <= MAX_PAIRS / share && triangles + touched <= MAX_TRIANGLES / share {
                in_step[i] = true;
                (pairs, triangles) = (pairs + met, triangles + touched);
            }
        }
        in_step
    }

    fn hang(&mut self, own: &Boxed) {
        let touched = self.triangles_in(&own.bounds, MAX_TRIANGLES + 1);
        let Some(body) = self.bodies.get_mut(&own.id) else { return };
        if let Some(rigid) = self.world.bodies.get_mut(body.handle) {
            tracing::debug!(object = own.id.0, "too much is in one place; it hangs where it is until there is room for it");
            rigid.set_enabled(false);
            body.hangs = Some(touched);
        }
    }

    /// It goes on as it moved when it was taken out.
    fn bring_back(&mut self, id: ObjectId) {
        let Some(body) = self.bodies.get_mut(&id) else { return };
        body.hangs = None;
        if let Some(rigid) = self.world.bodies.get_mut(body.handle) {
            rigid.set_enabled(true);
            rigid.wake_up(true);
        }
    }

    /// Of all objects that something can touch or could if they did not hang, in order.
    fn boxes(&self) -> Vec<Boxed> {
        let boxed = |(id, body): (&ObjectId, &super::Body)| {
            let rigid = self.world.bodies.get(body.handle).filter(|rigid| rigid.is_enabled() || body.hangs.is_some())?;
            let collider = self.world.colliders.get(body.collider?)?;
            let part = match body.hangs {
                _ if body.held => Part::Held,
                Some(touched) => Part::Hangs(touched),
                None if body.fixed || rigid.is_sleeping() => Part::Rests,
                None => Part::Free,
            };
            let at = if body.held { pose(&body.transform) } else { *rigid.position() };
            Some(Boxed { id: *id, part, bounds: collider.shape().compute_aabb(&at).loosened(LOOSE_M) })
        };
        self.bodies.iter().filter_map(boxed).collect()
    }

    /// So many triangles of the place lie in a box; they are counted no farther than to `most`.
    fn triangles_in(&self, bounds: &Aabb, most: usize) -> usize {
        let of_mesh = |collider: &ColliderHandle| self.world.colliders.get(*collider)?.shape().as_trimesh();
        self.place.iter().filter_map(of_mesh).flat_map(|mesh| mesh.bvh().intersect_aabb(bounds)).take(most).count()
    }
}
