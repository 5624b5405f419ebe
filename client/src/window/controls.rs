//! What mouse and keys do. No window in here.

use std::f32::consts::{PI, TAU};

use glam::{Quat, Vec2, Vec3};
use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::{Action, Motion};
use mr360_protocol::scene::{MAX_POSITION_M, ObjectId, Transform};

use crate::camera::Camera;
use crate::hands::{History, LocalObject, Palette, World, ground, scaled};
use crate::scene::pick::Ray;

/// Field of view at the start, degrees.
const START_FOV_DEG: f32 = 75.0;
/// Narrowest and widest field of view, degrees.
const FOV_DEG: std::ops::RangeInclusive<f32> = 30.0..=110.0;
/// Field of view, or the size of what is held, changes by this factor for every notch of the wheel.
const ZOOM: f32 = 1.08;
/// Highest and lowest look: straight up and down would leave yaw without meaning.
const MAX_PITCH_RAD: f32 = 89.0 * PI / 180.0;
/// Farther away the ground runs so flat that a pixel is metres.
const MAX_REACH_M: f32 = 50.0;
/// A height of the window turns what is held so far, radians.
const TURN_RAD: f32 = PI;
/// A key turns what is held so far, radians.
const KEY_TURN_RAD: f32 = PI / 12.0;
/// A key raises the viewer so far, and so far at most from where the panorama was filmed, metres.
const RAISE_M: f32 = 0.1;
/// See [`RAISE_M`].
const MAX_HEIGHT_M: f32 = 10.0;

/// What the pointer does as it moves.
#[derive(Debug)]
enum Drag {
    Nothing,
    /// The panorama follows the pointer.
    Look,
    Object(Held),
}

/// An object at the pointer.
#[derive(Debug)]
struct Held {
    id: ObjectId,
    transform: Transform,
    way: Way,
    history: History,
    /// It has been moved since the last frame: at most one wish a frame, for the newest place is all that counts.
    moved: bool,
}

/// How an object follows the pointer.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Way {
    /// On the ground: its position less the point of the ground under the pointer. None above the horizon, until the ground is met.
    Ground(Option<Vec3>),
    /// Up and down: its height less that of the pointer above it.
    Lift(f32),
    /// It turns in place.
    Turn,
}

/// Where the user looks, and what the pointer holds.
#[derive(Debug)]
pub(super) struct Controls {
    yaw_rad: f32,
    pitch_rad: f32,
    fov_y_rad: f32,
    height_m: f32,
    /// Pixels from the top left.
    pointer: Vec2,
    size: Vec2,
    /// Shift is down: what is held is lifted.
    lifting: bool,
    drag: Drag,
    palette: Palette,
    actions: Vec<Action>,
}

impl Controls {
    pub(super) fn new() -> Self {
        Self {
            yaw_rad: 0.0,
            pitch_rad: 0.0,
            fov_y_rad: START_FOV_DEG.to_radians(),
            height_m: 0.0,
            pointer: Vec2::ZERO,
            size: Vec2::ONE,
            lifting: false,
            drag: Drag::Nothing,
            palette: Palette::default(),
            actions: Vec::new(),
        }
    }

    pub(super) fn camera(&self) -> Camera {
        Camera { position: Vec3::Y * self.height_m, ..Camera::looking(self.yaw_rad, self.pitch_rad, self.fov_y_rad) }
    }

    pub(super) fn resized(&mut self, width: u32, height: u32) {
        self.size = Vec2::new(width.max(1) as f32, height.max(1) as f32);
    }

    /// Looks straight ahead again, from where the panorama was filmed.
    pub(super) fn reset(&mut self) {
        (self.yaw_rad, self.pitch_rad, self.fov_y_rad, self.height_m) = (0.0, 0.0, START_FOV_DEG.to_radians(), 0.0);
    }

    /// Raises the eyes, or lowers them.
    pub(super) fn raise(&mut self, up: bool) {
        let by = if up { RAISE_M } else { -RAISE_M };
        self.height_m = (self.height_m + by).clamp(-MAX_HEIGHT_M, MAX_HEIGHT_M);
    }

    pub(super) fn set_lifting(&mut self, lifting: bool) {
        self.lifting = lifting;
    }

    /// Positive notches narrow the view, or make larger what is held or about to be put.
    pub(super) fn wheel(&mut self, notches: f32, now: ClientTime) {
        if !notches.is_finite() {
            return;
        }
        let factor = ZOOM.powf(notches.clamp(-20.0, 20.0));
        if let Drag::Object(held) = &mut self.drag {
            held.place(Transform { scale: scaled(held.transform.scale, factor), ..held.transform }, now);
        } else if self.palette.item().is_some() {
            self.palette.scale_by(factor);
        } else {
            let fov_deg = self.fov_y_rad.to_degrees() / factor;
            self.fov_y_rad = fov_deg.clamp(*FOV_DEG.start(), *FOV_DEG.end()).to_radians();
        }
    }

    /// The left button: puts an item, takes an object, or looks around.
    pub(super) fn pressed(&mut self, world: &impl World, now: ClientTime) {
        self.released(now);
        if self.palette.item().is_some() {
            self.actions.extend(self.palette.put(&self.ray(), world));
            return;
        }
        self.drag = match self.take(world, now) {
            Some(held) => Drag::Object(held),
            None => Drag::Look,
        };
    }

    /// The right button: turns an object, the held one or that under the pointer.
    pub(super) fn turn_pressed(&mut self, world: &impl World, now: ClientTime) {
        if !matches!(self.drag, Drag::Object(_))
            && let Some(held) = self.take(world, now)
        {
            self.drag = Drag::Object(held);
        }
        if let Drag::Object(held) = &mut self.drag {
            held.way = Way::Turn;
        }
    }

    /// The right button is up: the object is on the ground again, or let go of where the left button is up, too.
    pub(super) fn turn_released(&mut self, left_down: bool, now: ClientTime) {
        match &mut self.drag {
            Drag::Object(held) if left_down => held.way = Way::Ground(None),
            _ => self.released(now),
        }
    }

    /// Lets go of what is held: thrown, if it was moving.
    pub(super) fn released(&mut self, now: ClientTime) {
        self.flush_move();
        if let Drag::Object(held) = std::mem::replace(&mut self.drag, Drag::Nothing) {
            self.actions.push(Action::Release(held.id, held.history.motion(now)));
        }
    }

    /// The pointer is at `to`, pixels from the top left.
    pub(super) fn moved(&mut self, to: Vec2, world: Option<&impl World>, now: ClientTime) {
        let before = std::mem::replace(&mut self.pointer, to);
        let by = to - before;
        let (camera, ray) = (self.camera(), self.ray());
        let wanted = if self.lifting { Way::Lift(0.0) } else { Way::Ground(None) };
        match &mut self.drag {
            Drag::Nothing => {}
            Drag::Look => {
                let rad_per_pixel = self.fov_y_rad / self.size.y;
                self.yaw_rad = (self.yaw_rad + by.x * rad_per_pixel).rem_euclid(TAU);
                self.pitch_rad = (self.pitch_rad + by.y * rad_per_pixel).clamp(-MAX_PITCH_RAD, MAX_PITCH_RAD);
            }
            Drag::Object(held) if held.way == Way::Turn => {
                let turn = by / self.size.y * TURN_RAD;
                let sideways = camera.world_from_view * Vec3::X;
                let rotation = Quat::from_rotation_y(turn.x) * Quat::from_axis_angle(sideways, turn.y) * held.transform.rotation;
                held.place(Transform { rotation: rotation.normalize(), ..held.transform }, now);
            }
            Drag::Object(held) => {
                let Some(world) = world else { return };
                let old = Ray { direction: camera.ray(ndc(before, self.size), self.size.x / self.size.y), ..ray };
                if std::mem::discriminant(&held.way) != std::mem::discriminant(&wanted) {
                    held.way = match wanted {
                        Way::Lift(_) => Way::Lift(held.transform.position.y - height_at(&old, held.transform.position)),
                        other => other,
                    };
                }
                held.follow(&ray, &old, world, now);
            }
        }
    }

    /// Turns what is held, or what is under the pointer, by a notch.
    pub(super) fn turn(&mut self, left: bool, world: &impl World, now: ClientTime) {
        let angle = if left { KEY_TURN_RAD } else { -KEY_TURN_RAD };
        if self.palette.item().is_some() {
            self.palette.turn_by(angle);
            return;
        }
        self.change(world, now, |transform, _| Transform {
            rotation: (Quat::from_rotation_y(angle) * transform.rotation).normalize(),
            ..transform
        });
    }

    /// Stands what is held, or what is under the pointer, on the ground.
    pub(super) fn snap(&mut self, world: &impl World, now: ClientTime) {
        self.change(world, now, |transform, id| {
            world.object_bounds(id).map_or(transform, |bounds| ground::on_ground(&transform, &bounds, world.ground_y()))
        });
        if matches!(self.drag, Drag::Object(_)) {
            self.flush_move();
            if let Drag::Object(held) = std::mem::replace(&mut self.drag, Drag::Nothing) {
                self.actions.push(Action::Release(held.id, Motion::STILL));
            }
        }
    }

    /// Takes what is held, or what is under the pointer, out of the scene.
    pub(super) fn remove(&mut self, world: &impl World) {
        let held = match std::mem::replace(&mut self.drag, Drag::Nothing) {
            Drag::Object(held) => Some(held.id),
            other => {
                self.drag = other;
                world.pick(&self.ray()).map(|(id, _)| id)
            }
        };
        self.actions.extend(held.map(Action::Remove));
    }

    fn change(&mut self, world: &impl World, now: ClientTime, to: impl Fn(Transform, ObjectId) -> Transform) {
        if let Drag::Object(held) = &mut self.drag {
            held.place(to(held.transform, held.id), now);
        } else if let Some((id, _)) = world.pick(&self.ray())
            && let Some(transform) = world.transform(id)
        {
            self.actions.extend([Action::Grab(id), Action::Move(id, to(transform, id)), Action::Release(id, Motion::STILL)]);
        }
    }

    /// The next item of the library, or the so manieth.
    pub(super) fn choose(&mut self, item: Option<usize>, world: &impl World) {
        match item {
            None => self.palette.cycle(world.library()),
            item => self.palette.choose(item, world.library()),
        }
    }

    /// Puts the library away; false when it was not in hand.
    pub(super) fn close_palette(&mut self) -> bool {
        let open = self.palette.item().is_some();
        self.palette.choose(None, &[]);
        open
    }

    /// Name of the item about to be put.
    pub(super) fn in_hand<'a>(&self, world: &'a impl World) -> Option<&'a str> {
        Some(&world.library().get(self.palette.item()?)?.name)
    }

    /// What this viewer alone sees: the item about to be put.
    pub(super) fn drawn(&mut self, world: &impl World) -> Vec<LocalObject> {
        self.palette.keep_to(world.library());
        self.palette.ghost(&self.ray(), world).into_iter().collect()
    }

    /// What happened since the last call, in order.
    pub(super) fn take_actions(&mut self) -> Vec<Action> {
        self.flush_move();
        std::mem::take(&mut self.actions)
    }

    fn flush_move(&mut self) {
        if let Drag::Object(held) = &mut self.drag
            && std::mem::take(&mut held.moved)
        {
            self.actions.push(Action::Move(held.id, held.transform));
        }
    }

    fn take(&mut self, world: &impl World, now: ClientTime) -> Option<Held> {
        let ray = self.ray();
        let (id, _) = world.pick(&ray)?;
        let transform = world.transform(id)?;
        self.actions.push(Action::Grab(id));
        let way = Way::Ground(ground_point(&ray, world).map(|point| transform.position - point));
        let mut held = Held { id, transform, way, history: History::default(), moved: false };
        held.history.push(now, &transform);
        Some(held)
    }

    fn ray(&self) -> Ray {
        let camera = self.camera();
        Ray { origin: camera.position, direction: camera.ray(ndc(self.pointer, self.size), self.size.x / self.size.y) }
    }
}

impl Held {
    fn place(&mut self, transform: Transform, now: ClientTime) {
        let edge = Vec3::splat(MAX_POSITION_M);
        let transform = Transform { position: transform.position.clamp(-edge, edge), ..transform };
        if transform.validate("move").is_ok() {
            self.transform = transform;
            self.history.push(now, &transform);
            self.moved = true;
        }
    }

    /// Follows the pointer from one ray to the next.
    fn follow(&mut self, ray: &Ray, old: &Ray, world: &impl World, now: ClientTime) {
        let position = self.transform.position;
        let to = match self.way {
            Way::Ground(offset) => {
                let Some(point) = ground_point(ray, world) else { return };
                // Grabbed above the horizon or far out, it keeps to the first point that there is.
                let offset = offset.unwrap_or_else(|| position - ground_point(old, world).unwrap_or(point));
                self.way = Way::Ground(Some(offset));
                Vec3::new(point.x + offset.x, position.y, point.z + offset.z)
            }
            Way::Lift(offset) => Vec3::new(position.x, height_at(ray, position) + offset, position.z),
            Way::Turn => return,
        };
        self.place(Transform { position: to, ..self.transform }, now);
    }
}

/// The height at which a ray passes an upright axis: where it is as far away as the axis.
fn height_at(ray: &Ray, axis: Vec3) -> f32 {
    let level = |v: Vec3| Vec2::new(v.x, v.z);
    let along = level(ray.direction).length();
    let away = level(axis - ray.origin).length();
    ray.origin.y + if along > 1e-3 { ray.direction.y / along * away } else { 0.0 }
}

fn ground_point(ray: &Ray, world: &impl World) -> Option<Vec3> {
    ray.ground(world.ground_y(), MAX_REACH_M)
}

fn ndc(pointer: Vec2, size: Vec2) -> Vec2 {
    let unit = pointer / size;
    Vec2::new(unit.x * 2.0 - 1.0, 1.0 - unit.y * 2.0)
}

#[cfg(test)]
mod tests;
