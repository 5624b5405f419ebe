//! An object in one hand or two, near or at the end of a ray.

use glam::{Quat, Vec3};
use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::Motion;
use mr360_protocol::scene::{MAX_POSITION_M, ObjectId, Transform};

use super::input::{HandInput, Pose};
use super::throw::History;

/// A hand that is not tracked keeps what it holds for so long, microseconds.
pub(super) const LOST_US: u64 = 1_000_000;
/// Hands that are nearer to each other do not scale what they hold, metres: the ratio would be noise.
const MIN_SPAN_M: f32 = 0.03;
/// Smallest and largest side of a thing that hands scale, as its factor.
const SCALE: std::ops::RangeInclusive<f32> = 0.02..=50.0;

/// Which button took hold; the same lets go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Button {
    Select,
    Squeeze,
}

/// How one hand holds.
#[derive(Debug, Clone, Copy)]
pub(super) struct Grip {
    pub(super) by: Button,
    /// By the ray: the object follows the aim, else the grip.
    pub(super) far: bool,
    /// Where it was taken, in the hand's frame.
    point: Vec3,
    /// The object in the hand's frame.
    object: Pose,
}

impl Grip {
    /// The point that it holds by, in the world.
    pub(super) fn holds_at(&self, frame: &Pose) -> Vec3 {
        frame.point(self.point)
    }
}

/// What two hands had when they began to hold together.
#[derive(Debug, Clone, Copy)]
struct Pair {
    begin: Transform,
    middle: Vec3,
    span: Vec3,
    /// From one hand to the other, as last seen, and all its turns since.
    direction: Vec3,
    turn: Quat,
}

/// An object in hand.
#[derive(Debug)]
pub(super) struct Held {
    pub(super) object: ObjectId,
    pub(super) transform: Transform,
    pub(super) grips: [Option<Grip>; 2],
    /// The hands that led it in the last frame.
    led: [bool; 2],
    pair: Option<Pair>,
    history: History,
    lost: Option<ClientTime>,
}

/// The frame by which a hand holds.
fn frame(input: &HandInput, far: bool) -> Option<Pose> {
    if far { input.aim } else { input.grip }
}

impl Held {
    pub(super) fn new(object: ObjectId, transform: Transform) -> Self {
        Self { object, transform, grips: [None; 2], led: [false; 2], pair: None, history: History::default(), lost: None }
    }

    /// A hand takes hold at a point of the world.
    pub(super) fn take(&mut self, hand: usize, input: &HandInput, by: Button, far: bool, point: Vec3) {
        let Some(frame) = frame(input, far) else { return };
        self.grips[hand] = Some(Grip { by, far, point: frame.inverse_point(point), object: Pose::IDENTITY });
        self.led = [false; 2];
    }

    /// A hand lets go; true when the other one still holds.
    pub(super) fn let_go(&mut self, hand: usize) -> bool {
        self.grips[hand] = None;
        self.led = [false; 2];
        self.grips.iter().any(Option::is_some)
    }

    /// How it moves now.
    pub(super) fn motion(&self, now: ClientTime) -> Motion {
        self.history.motion(now)
    }

    /// Follows the hands. False when none of them has been tracked for too long.
    pub(super) fn follow(&mut self, inputs: &[HandInput; 2], now: ClientTime) -> bool {
        let frames = [0, 1].map(|hand| self.grips[hand].and_then(|grip| frame(&inputs[hand], grip.far)));
        let led = frames.map(|frame| frame.is_some());
        if led != self.led {
            self.anchor(&frames);
            self.led = led;
        }
        match (frames, self.grips) {
            ([Some(left), Some(right)], [Some(a), Some(b)]) => self.follow_two(left.point(a.point), right.point(b.point)),
            ([Some(frame), None], [Some(grip), _]) | ([None, Some(frame)], [_, Some(grip)]) => {
                let at = frame.child(&grip.object);
                (self.transform.position, self.transform.rotation) = (at.position, at.orientation);
            }
            _ => return now.0.saturating_sub(self.lost.get_or_insert(now).0) <= LOST_US,
        }
        self.lost = None;
        let edge = Vec3::splat(MAX_POSITION_M);
        self.transform.position = self.transform.position.clamp(-edge, edge);
        self.transform.rotation = self.transform.rotation.normalize();
        self.history.push(now, &self.transform);
        true
    }

    /// From here on the object keeps its place in the hands that lead it, so that it never jumps when a hand comes or goes.
    fn anchor(&mut self, frames: &[Option<Pose>; 2]) {
        let own = Pose { position: self.transform.position, orientation: self.transform.rotation };
        for (grip, frame) in self.grips.iter_mut().zip(frames) {
            if let (Some(grip), Some(frame)) = (grip, frame) {
                grip.object = frame.inverse_child(&own);
            }
        }
        self.pair = match (frames, self.grips) {
            ([Some(left), Some(right)], [Some(a), Some(b)]) => {
                let (a, b) = (left.point(a.point), right.point(b.point));
                let span = b - a;
                let direction = span.normalize_or(Vec3::X);
                Some(Pair { begin: self.transform, middle: (a + b) * 0.5, span, direction, turn: Quat::IDENTITY })
            }
            _ => None,
        };
    }

    fn follow_two(&mut self, left: Vec3, right: Vec3) {
        let Some(pair) = &mut self.pair else { return };
        let span = right - left;
        let direction = span.normalize_or(pair.direction);
        pair.turn = (Quat::from_rotation_arc(pair.direction, direction) * pair.turn).normalize();
        pair.direction = direction;
        let wanted = if pair.span.length() < MIN_SPAN_M { 1.0 } else { span.length() / pair.span.length() };
        let scale = scaled(pair.begin.scale, wanted);
        let ratio = scale.x / pair.begin.scale.x;
        self.transform = Transform {
            position: (left + right) * 0.5 + pair.turn * (pair.begin.position - pair.middle) * ratio,
            rotation: pair.turn * pair.begin.rotation,
            scale,
        };
    }

    /// Scales it in place.
    pub(super) fn scale_by(&mut self, factor: f32) {
        self.transform.scale = scaled(self.transform.scale, factor);
        self.led = [false; 2];
    }

    /// Turns it about the vertical through its origin.
    pub(super) fn turn_by(&mut self, angle_rad: f32) {
        self.transform.rotation = (Quat::from_rotation_y(angle_rad) * self.transform.rotation).normalize();
        self.led = [false; 2];
    }

    /// Brings it nearer along the ray, or farther away.
    pub(super) fn reel(&mut self, aim: &Pose, factor: f32) {
        let away = self.transform.position - aim.position;
        if (0.2..=50.0).contains(&(away.length() * factor)) {
            self.transform.position = aim.position + away * factor;
            self.led = [false; 2];
        }
    }
}

/// A scale times a factor, as a whole within what hands can make of a thing.
#[must_use]
pub fn scaled(scale: Vec3, factor: f32) -> Vec3 {
    let (least, most) = (SCALE.start() / scale.min_element(), SCALE.end() / scale.max_element());
    // What is beyond already may come back, and goes no farther.
    let factor = if factor.is_finite() { factor.clamp(least.min(1.0), most.max(1.0)) } else { 1.0 };
    scale * factor
}
