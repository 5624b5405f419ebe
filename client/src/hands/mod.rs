//! Hands: point, grab, move, turn, scale, throw, release, place. No runtime, no GPU and no clock in here: time is an argument.

mod button;
pub mod ground;
mod hold;
pub mod input;
pub mod looks;
mod palette;
mod placing;
#[cfg(test)]
mod tests;
mod throw;

use glam::{Quat, Vec3};
use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::{Action, Motion};
use mr360_protocol::scene::{Geometry, LibraryItem, Material, ObjectId, Transform};

use crate::scene::mesh::Bounds;
use crate::scene::pick::Ray;
use button::{Edge, Menu, Press, Trigger};
pub use hold::scaled;
use hold::{Button, Held};
pub use input::{HandInput, HandsInput, Haptic, Pose};
pub use palette::{MAX_REACH_M, Palette};
pub use placing::{Placing, PlacingChange};
pub use throw::History;

/// A hand this near to an object's bounds holds it itself, metres of a viewer of usual size.
const NEAR_M: f32 = 0.08;
/// A stick counts from here on.
const DEAD_ZONE: f32 = 0.25;
/// A stick turns the viewer once when it goes beyond this.
const SNAP: f32 = 0.7;
/// How far it turns, radians.
const SNAP_RAD: f32 = std::f32::consts::FRAC_PI_6;
/// A full stick turns what is held so fast, radians a second.
const TURN_RAD_S: f32 = 2.0;
/// A full stick scales or reels what is held by e in this many seconds.
const STRETCH_S: f32 = 1.0;
/// A full stick raises the viewer so fast, metres a second.
const RAISE_M_S: f32 = 0.5;
/// Longest time between two frames that a stick counts for, seconds.
const MAX_FRAME_S: f32 = 0.05;

const TOUCHED: Haptic = Haptic { amplitude: 0.2, duration_us: 10_000 };
const GRABBED: Haptic = Haptic { amplitude: 0.7, duration_us: 25_000 };
const RELEASED: Haptic = Haptic { amplitude: 0.4, duration_us: 15_000 };

/// What hands and pointers ask of the scene that this viewer shows. By itself a world is empty.
pub trait World {
    /// The nearest object along a ray and where it is met.
    fn pick(&self, _ray: &Ray) -> Option<(ObjectId, Vec3)> {
        None
    }

    /// The object nearest to a point whose bounds are within `reach_m` of it.
    fn near(&self, _point: Vec3, _reach_m: f32) -> Option<ObjectId> {
        None
    }

    /// Where an object is, as this viewer shows it; none when it is gone.
    fn transform(&self, _object: ObjectId) -> Option<Transform> {
        None
    }

    /// Its bounds in its own frame, before its scale.
    fn object_bounds(&self, _object: ObjectId) -> Option<Bounds> {
        None
    }

    /// Bounds of a form of the library; none while its model has not come.
    fn bounds(&self, _geometry: &Geometry) -> Option<Bounds> {
        None
    }

    /// What can be put.
    fn library(&self) -> &[LibraryItem] {
        &[]
    }

    /// Height of the ground, metres.
    fn ground_y(&self) -> f32 {
        0.0
    }
}

/// Something that only this viewer sees: a controller, a ray, the ghost of what is about to be placed.
#[derive(Debug, Clone, PartialEq)]
pub struct LocalObject {
    /// A shape, a model that the scene's library names, or one of [`looks`].
    pub geometry: Geometry,
    /// Its place.
    pub transform: Transform,
    /// Its surface; a model without one keeps that of its file.
    pub material: Option<Material>,
    /// It throws a shadow.
    pub casts: bool,
}

/// What a frame's input came to.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct HandsOutput {
    /// Wishes for the server, in order. Hand each to `Stage::predict` too, so that this viewer sees it without the round trip.
    pub actions: Vec<Action>,
    /// Pulses to play now, left and right.
    pub haptics: [Option<Haptic>; 2],
    /// Hands, rays, palette and ghost, for `Stage::show_local`.
    pub drawn: Vec<LocalObject>,
    /// Wishes of the viewer for where and how large they are: for the [`Placing`] that made this input's poses.
    pub placing: Vec<PlacingChange>,
}

/// What a hand that holds nothing points with, or at.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Pointed {
    Nothing,
    Near(ObjectId),
    Far(ObjectId, Vec3),
}

#[derive(Debug, Default)]
struct Hand {
    select: Trigger,
    squeeze: Trigger,
    menu: Menu,
    /// What it pointed at in the frame before.
    pointed: Option<ObjectId>,
    palette: Palette,
    snapped: bool,
}

/// Both hands over time.
#[derive(Debug, Default)]
pub struct Hands {
    hands: [Hand; 2],
    held: Vec<Held>,
    last: Option<ClientTime>,
    /// Both hands hold the world itself: how far they were from each other when they took it.
    span: Option<f32>,
}

impl Hands {
    /// Takes in the hands of one frame.
    pub fn update(&mut self, input: &HandsInput, world: &impl World) -> HandsOutput {
        let input = input.checked();
        let elapsed = self.last.map_or(0.0, |last| input.now.0.saturating_sub(last.0) as f32 * 1e-6);
        self.last = Some(input.now);
        let mut out = HandsOutput::default();
        for hand in 0..2 {
            self.hands[hand].palette.keep_to(world.library());
            self.buttons(hand, &input, world, &mut out);
            self.stick(hand, &input, elapsed.min(MAX_FRAME_S), &mut out);
        }
        self.follow(&input, world, &mut out);
        self.stretch_world(&input, &mut out);
        for hand in 0..2 {
            self.point(hand, &input, world, &mut out);
        }
        out
    }

    /// Lets go of everything, without throwing it: nobody will say any more what these hands do. The wishes are as those of
    /// [`Hands::update`].
    pub fn let_go_of_all(&mut self) -> Vec<Action> {
        self.span = None;
        self.held.drain(..).map(|held| Action::Release(held.object, Motion::STILL)).collect()
    }

    /// The same where no hands were taken in for as long as a lost hand keeps what it holds, as while a headset is off.
    pub fn let_go_when_idle(&mut self, now: ClientTime) -> Vec<Action> {
        let idle = self.last.is_some_and(|last| now.0.saturating_sub(last.0) > hold::LOST_US);
        if idle { self.let_go_of_all() } else { Vec::new() }
    }

    /// What a hand holds.
    fn holding(&self, hand: usize) -> Option<usize> {
        self.held.iter().position(|held| held.grips[hand].is_some())
    }

    fn buttons(&mut self, hand: usize, input: &HandsInput, world: &impl World, out: &mut HandsOutput) {
        let own = &input.hands[hand];
        let edges =
            [(Button::Select, self.hands[hand].select.update(own.select)), (Button::Squeeze, self.hands[hand].squeeze.update(own.squeeze))];
        for (button, edge) in edges {
            match (edge, self.holding(hand)) {
                (Edge::Released, Some(at)) if self.held[at].grips[hand].is_some_and(|grip| grip.by == button) => {
                    out.haptics[hand] = Some(RELEASED);
                    if !self.held[at].let_go(hand) {
                        let held = self.held.remove(at);
                        out.actions.push(Action::Release(held.object, held.motion(input.now)));
                    }
                }
                (Edge::Pressed, None) => self.pressed(hand, button, input, world, out),
                _ => {}
            }
        }
        // Of a button that the runtime does not tell nobody can say how long it was down.
        if own.select.is_nan() {
            self.hands[hand].menu.unknown();
            return;
        }
        match (self.hands[hand].menu.update(own.menu, input.now), self.holding(hand)) {
            (Press::Short, None) => self.hands[hand].palette.cycle(world.library()),
            (Press::Short, Some(at)) => self.snap(at, world, out),
            (Press::Long, None) => out.placing.push(PlacingChange::Recentre),
            (Press::Long, Some(at)) => out.actions.push(Action::Remove(self.held.remove(at).object)),
            (Press::None, _) => {}
        }
    }

    fn pressed(&mut self, hand: usize, button: Button, input: &HandsInput, world: &impl World, out: &mut HandsOutput) {
        let own = &input.hands[hand];
        if self.hands[hand].palette.item().is_some() && button == Button::Select {
            let put = own.aim.and_then(|aim| self.hands[hand].palette.put(&ray(&aim), world));
            out.haptics[hand] = put.is_some().then_some(GRABBED);
            out.actions.extend(put);
            return;
        }
        let (object, far, point) = match target(own, input.scale, world) {
            Pointed::Near(object) => (object, false, own.grip.map(|grip| grip.position)),
            Pointed::Far(object, at) => (object, true, Some(at)),
            Pointed::Nothing => return,
        };
        let (Some(point), Some(transform)) = (point, world.transform(object)) else { return };
        let at = self.held.iter().position(|held| held.object == object).unwrap_or_else(|| {
            out.actions.push(Action::Grab(object));
            self.held.push(Held::new(object, transform));
            self.held.len() - 1
        });
        self.held[at].take(hand, own, button, far, point);
        out.haptics[hand] = Some(GRABBED);
    }

    /// Stands what is held on the ground and lets go of it.
    fn snap(&mut self, at: usize, world: &impl World, out: &mut HandsOutput) {
        let held = self.held.remove(at);
        if let Some(bounds) = world.object_bounds(held.object) {
            out.actions.push(Action::Move(held.object, ground::on_ground(&held.transform, &bounds, world.ground_y())));
        }
        out.actions.push(Action::Release(held.object, Motion::STILL));
    }

    fn stick(&mut self, hand: usize, input: &HandsInput, elapsed_s: f32, out: &mut HandsOutput) {
        let own = &input.hands[hand];
        let live = |axis: f32| if axis.abs() < DEAD_ZONE { 0.0 } else { axis };
        let (x, y) = (live(own.stick.x), live(own.stick.y));
        let stretch = (y * elapsed_s / STRETCH_S).exp();
        let turn = -x * TURN_RAD_S * elapsed_s;
        let snapped = std::mem::replace(&mut self.hands[hand].snapped, x.abs() >= SNAP);
        if let Some(at) = self.holding(hand) {
            let held = &mut self.held[at];
            let far = held.grips[hand].is_some_and(|grip| grip.far);
            if x != 0.0 {
                held.turn_by(turn);
            }
            match own.aim.filter(|_| far) {
                _ if y == 0.0 => {}
                Some(aim) => held.reel(&aim, stretch),
                None => held.scale_by(stretch),
            }
        } else if self.hands[hand].palette.item().is_some() {
            self.hands[hand].palette.turn_by(turn);
            self.hands[hand].palette.scale_by(stretch);
        } else {
            if y != 0.0 {
                out.placing.push(PlacingChange::Raise(y * RAISE_M_S * elapsed_s));
            }
            if x.abs() >= SNAP && !snapped {
                out.placing.push(PlacingChange::Turn(-SNAP_RAD.copysign(x)));
            }
        }
    }

    /// Has what is held follow its hands; what no tracked hand holds is let go of in the end.
    fn follow(&mut self, input: &HandsInput, world: &impl World, out: &mut HandsOutput) {
        self.held.retain_mut(|held| {
            if world.transform(held.object).is_none() {
                // Somebody has removed it.
                return false;
            }
            let before = held.transform;
            if !held.follow(&input.hands, input.now) {
                out.actions.push(Action::Release(held.object, Motion::STILL));
                return false;
            }
            if held.transform != before && held.transform.validate("move").is_ok() {
                out.actions.push(Action::Move(held.object, held.transform));
            }
            true
        });
    }

    /// Two squeezing hands that hold no object hold the world: it grows as they part, as if it were between them.
    fn stretch_world(&mut self, input: &HandsInput, out: &mut HandsOutput) {
        let squeezing = |hand: usize| self.hands[hand].squeeze.down && self.holding(hand).is_none();
        let apart = match [input.hands[0].grip, input.hands[1].grip] {
            [Some(left), Some(right)] if squeezing(0) && squeezing(1) => left.position.distance(right.position),
            _ => {
                self.span = None;
                return;
            }
        };
        // Poses come scaled already: the wish is for whatever is missing.
        let span = *self.span.get_or_insert(apart);
        if apart > 0.01 && span > 0.01 && (span / apart - 1.0).abs() > 1e-3 {
            out.placing.push(PlacingChange::Scale(span / apart));
        }
    }

    fn point(&mut self, hand: usize, input: &HandsInput, world: &impl World, out: &mut HandsOutput) {
        let own = &input.hands[hand];
        out.drawn.extend(own.grip.map(|grip| looks::controller(hand, &grip, input.scale)));
        if let Some(at) = self.holding(hand) {
            self.hands[hand].pointed = Some(self.held[at].object);
            let grip = self.held[at].grips[hand].filter(|grip| grip.far).zip(own.aim);
            if let Some((grip, aim)) = grip {
                out.drawn.push(looks::ray(&aim, aim.position.distance(grip.holds_at(&aim)), input.scale));
            }
            return;
        }
        if self.hands[hand].palette.item().is_some() {
            self.hands[hand].pointed = None;
            let Some(aim) = own.aim else { return };
            let ghost = self.hands[hand].palette.ghost(&ray(&aim), world);
            let length = ghost.as_ref().map_or(MAX_REACH_M * 0.1, |ghost| ghost.transform.position.distance(aim.position));
            out.drawn.push(looks::ray(&aim, length, input.scale));
            out.drawn.extend(ghost);
            return;
        }
        let pointed = match target(own, input.scale, world) {
            Pointed::Nothing => None,
            Pointed::Near(object) => Some(object),
            Pointed::Far(object, at) => {
                out.drawn.extend(own.aim.map(|aim| looks::ray(&aim, aim.position.distance(at), input.scale)));
                out.drawn.push(looks::mark(at, input.head.position, input.scale));
                Some(object)
            }
        };
        if pointed.is_some() && pointed != self.hands[hand].pointed && out.haptics[hand].is_none() {
            out.haptics[hand] = Some(TOUCHED);
        }
        self.hands[hand].pointed = pointed;
    }
}

/// What a hand of a viewer of this size that holds nothing would take: what it touches, else what its ray meets.
fn target(input: &HandInput, viewer: f32, world: &impl World) -> Pointed {
    if let Some(object) = input.grip.and_then(|grip| world.near(grip.position, NEAR_M * viewer)) {
        return Pointed::Near(object);
    }
    let hit = input.aim.and_then(|aim| Some((aim, world.pick(&ray(&aim))?)));
    match hit {
        Some((aim, (object, at))) if at.distance(aim.position) <= MAX_REACH_M => Pointed::Far(object, at),
        _ => Pointed::Nothing,
    }
}

fn ray(aim: &Pose) -> Ray {
    Ray { origin: aim.position, direction: aim.forward() }
}

/// The turn that takes +y to a direction.
fn along(direction: Vec3) -> Quat {
    Quat::from_rotation_arc(Vec3::Y, direction)
}
