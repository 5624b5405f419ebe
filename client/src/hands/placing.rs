//! How the viewer's room lies in the world: where, which way, and how large.

use glam::{Quat, Vec3};

use super::input::Pose;

/// Lowest and highest size of a viewer, as a factor.
const SCALE: std::ops::RangeInclusive<f32> = 0.1..=10.0;
/// Farthest that eyes are raised or lowered from where the panorama was filmed, metres.
const MAX_RAISE_M: f32 = 10.0;

/// What a viewer wishes of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PlacingChange {
    /// The head is where the panorama was filmed and looks into its centre; what it sees of the ground is right there alone.
    Recentre,
    /// Turns the viewer left about their head, radians.
    Turn(f32),
    /// Raises the eyes, metres.
    Raise(f32),
    /// Makes the viewer larger about their head by a factor: the world looks smaller.
    Scale(f32),
}

/// From the tracked space to the world: scale, then turn, then shift.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placing {
    position: Vec3,
    yaw_rad: f32,
    scale: f32,
}

impl Default for Placing {
    fn default() -> Self {
        Self { position: Vec3::ZERO, yaw_rad: 0.0, scale: 1.0 }
    }
}

impl Placing {
    /// A pose of the tracked space in the world.
    #[must_use]
    pub fn in_world(&self, pose: &Pose) -> Pose {
        let turn = Quat::from_rotation_y(self.yaw_rad);
        Pose { position: self.position + turn * (pose.position * self.scale), orientation: turn * pose.orientation }
    }

    /// Size of the viewer: the distance between their eyes grows with it.
    #[must_use]
    pub fn scale(&self) -> f32 {
        self.scale
    }

    /// Takes a wish of a viewer whose head is there in the tracked space.
    pub fn change(&mut self, change: PlacingChange, head: &Pose) {
        if !head.position.is_finite() || !head.orientation.is_finite() {
            return;
        }
        let before = self.in_world(head).position;
        let eyes = match change {
            PlacingChange::Recentre => {
                (self.yaw_rad, self.scale) = (-yaw(head), 1.0);
                Vec3::ZERO
            }
            PlacingChange::Turn(angle) if angle.is_finite() => {
                self.yaw_rad = (self.yaw_rad + angle).rem_euclid(std::f32::consts::TAU);
                before
            }
            PlacingChange::Raise(by) if by.is_finite() => Vec3::new(before.x, (before.y + by).clamp(-MAX_RAISE_M, MAX_RAISE_M), before.z),
            PlacingChange::Scale(by) if by.is_finite() => {
                self.scale = (self.scale * by).clamp(*SCALE.start(), *SCALE.end());
                before
            }
            _ => before,
        };
        self.position += eyes - self.in_world(head).position;
    }
}

/// Which way a head looks, about +y from −z; also where it looks straight up or down.
fn yaw(head: &Pose) -> f32 {
    let forward = head.forward();
    let level = if forward.y.abs() < 0.99 { forward } else { head.orientation * Vec3::NEG_Y * forward.y.signum() };
    (-level.x).atan2(-level.z)
}

#[cfg(test)]
mod tests {
    use std::f32::consts::{FRAC_PI_2, PI};

    use super::*;

    fn head() -> Pose {
        Pose { position: Vec3::new(1.0, 1.7, -2.0), orientation: Quat::from_rotation_y(0.8) * Quat::from_rotation_x(-0.3) }
    }

    #[test]
    fn recentred_the_head_is_where_the_camera_was_and_keeps_its_pitch() {
        let mut placing = Placing::default();
        placing.change(PlacingChange::Scale(2.0), &head());
        placing.change(PlacingChange::Recentre, &head());
        let seen = placing.in_world(&head());
        assert!(seen.position.length() < 1e-5, "{}", seen.position);
        let expected = Quat::from_rotation_x(-0.3) * Vec3::NEG_Z;
        assert!(seen.forward().distance(expected) < 1e-5, "{}", seen.forward());
        assert_eq!(placing.scale(), 1.0);
    }

    #[test]
    fn a_head_that_looks_straight_down_is_recentred_by_its_brow() {
        let mut placing = Placing::default();
        let down = Pose { position: Vec3::ZERO, orientation: Quat::from_rotation_y(1.0) * Quat::from_rotation_x(-FRAC_PI_2) };
        placing.change(PlacingChange::Recentre, &down);
        let brow = placing.in_world(&down).orientation * Vec3::Y;
        assert!(brow.distance(Vec3::NEG_Z) < 1e-5, "{brow}");
    }

    #[test]
    fn turns_and_sizes_leave_the_head_where_it_is() {
        let mut placing = Placing::default();
        placing.change(PlacingChange::Recentre, &head());
        let (before, hand) = (placing.in_world(&head()), Pose { position: head().position + Vec3::X * 0.5, ..head() });
        let apart = |placing: &Placing| placing.in_world(&hand).position.distance(placing.in_world(&head()).position);
        placing.change(PlacingChange::Turn(PI / 6.0), &head());
        placing.change(PlacingChange::Scale(3.0), &head());
        assert!(placing.in_world(&head()).position.distance(before.position) < 1e-5);
        assert!((apart(&placing) - 1.5).abs() < 1e-5);
        let turned = before.forward().dot(placing.in_world(&head()).forward());
        assert!(turned < 0.9);
        placing.change(PlacingChange::Raise(0.4), &head());
        assert!((placing.in_world(&head()).position.y - 0.4).abs() < 1e-5);
    }

    #[test]
    fn senseless_wishes_change_nothing_and_sizes_are_bounded() {
        let mut placing = Placing::default();
        for change in [PlacingChange::Turn(f32::NAN), PlacingChange::Raise(f32::INFINITY), PlacingChange::Scale(f32::NAN)] {
            placing.change(change, &head());
        }
        assert_eq!(placing, Placing::default());
        let lost = Pose { position: Vec3::splat(f32::NAN), ..head() };
        placing.change(PlacingChange::Recentre, &lost);
        assert_eq!(placing, Placing::default());
        (0..100).for_each(|_| placing.change(PlacingChange::Scale(1e9), &head()));
        assert_eq!(placing.scale(), *SCALE.end());
        (0..100).for_each(|_| placing.change(PlacingChange::Raise(1e3), &head()));
        assert!((placing.in_world(&head()).position.y - MAX_RAISE_M).abs() < 1e-3);
    }
}
