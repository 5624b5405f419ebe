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

    /// A point of its frame in the world.
    #[must_use]
    pub fn point(&self, point: Vec3) -> Vec3 {
        self.position + self.orientation * point
    }

    /// A point of the world in its frame.
    #[must_use]
    pub fn inverse_point(&self, point: Vec3) -> Vec3 {
        self.orientation.inverse() * (point - self.position)
    }

    /// A pose of its frame in the world.
    #[must_use]
    pub fn child(&self, pose: &Self) -> Self {
        Self { position: self.point(pose.position), orientation: self.orientation * pose.orientation }
    }

    /// A pose of the world in its frame.
    #[must_use]
    pub fn inverse_child(&self, pose: &Self) -> Self {
        Self { position: self.inverse_point(pose.position), orientation: self.orientation.inverse() * pose.orientation }
    }

    /// Itself with a unit quaternion, where it is one at all.
    #[must_use]
    pub fn checked(&self) -> Option<Self> {
        let length = self.orientation.length();
        let sound = self.position.is_finite() && length.is_finite() && length > 0.1;
        sound.then(|| Self { position: self.position, orientation: self.orientation / length })
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
    /// Trigger, 0 to 1; not a number while it is not known, as without focus: then it is as it was, and a press of
    /// the menu button comes to nothing.
    pub select: f32,
    /// Grip, 0 to 1; not a number while it is not known.
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
    /// Size of the viewer, as a factor: their hands and reach are so much larger.
    pub scale: f32,
}

impl HandsInput {
    /// With poses that are ones; what is not is not tracked.
    #[must_use]
    pub(super) fn checked(&self) -> Self {
        let hands = self.hands.map(|hand| HandInput {
            grip: hand.grip.and_then(|pose| pose.checked()),
            aim: hand.aim.and_then(|pose| pose.checked()),
            stick: if hand.stick.is_finite() { hand.stick.clamp(Vec2::NEG_ONE, Vec2::ONE) } else { Vec2::ZERO },
            ..hand
        });
        let scale = if self.scale.is_finite() && self.scale > 0.0 { self.scale } else { 1.0 };
        Self { hands, head: self.head.checked().unwrap_or(Pose::IDENTITY), now: self.now, scale }
    }
}

/// A pulse for one hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Haptic {
    /// 0 to 1.
    pub amplitude: f32,
    /// Microseconds.
    pub duration_us: u64,
}
