//! What hands do and what they are answered with, whatever runtime they come from. All poses are in the world, whose axes are OpenXR's.

use glam::{Quat, Vec2, Vec3};
use mr360_protocol::clock::ClientTime;
use serde::{Deserialize, Serialize};

/// Where something is, and how it is turned.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Metres.
    pub position: Vec3,
    /// Unit quaternion.
    pub orientation: Quat,
}

impl Pose {
    /// At the origin, looking along −z.
    pub const IDENTITY: Self = Self { position: Vec3::ZERO, orientation: Quat::IDENTITY };

    /// Where its −z axis points: the direction of an aim or of a look.
    #[must_use]
    pub fn forward(&self) -> Vec3 {
        self.orientation * Vec3::NEG_Z
    }
}

/// One hand or its controller, as of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct HandInput {
    /// Where it holds things, as OpenXR's `grip/pose`; `None` while it is not tracked.
    pub grip: Option<Pose>,
    /// Where it points, as OpenXR's `aim/pose`.
    pub aim: Option<Pose>,
    /// Trigger, 0 to 1.
    pub select: f32,
    /// Grip, 0 to 1.
    pub squeeze: f32,
    /// Thumbstick or trackpad, each axis −1 to 1, right and up positive.
    pub stick: Vec2,
    /// The menu button is down.
    pub menu: bool,
}

/// Both hands and the head at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandsInput {
    /// Left, right.
    pub hands: [HandInput; 2],
    /// Between the eyes.
    pub head: Pose,
    /// When all this is so: the predicted display time where there is one.
    pub now: ClientTime,
}

/// A pulse for one hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Haptic {
    /// 0 to 1.
    pub amplitude: f32,
    /// Microseconds.
    pub duration_us: u64,
}
