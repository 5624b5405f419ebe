//! How something moved that a hand or a pointer led: the motion it is let go of with.

use std::collections::VecDeque;

use glam::{Quat, Vec3};
use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::Motion;
use mr360_protocol::scene::Transform;

/// Only this last stretch counts, microseconds: a hand's swing is longer, and fingers open within it.
const WINDOW_US: u64 = 80_000;
/// Most places kept: at 400 a second the window holds as many.
const MOST: usize = 32;

/// Where something was over the last moments.
#[derive(Debug, Clone, Default)]
pub struct History(VecDeque<(ClientTime, Vec3, Quat)>);

impl History {
    /// It is here now.
    pub fn push(&mut self, now: ClientTime, at: &Transform) {
        // What comes at the same time, or earlier, corrects the last.
        while self.0.back().is_some_and(|(last, ..)| *last >= now) {
            self.0.pop_back();
        }
        self.0.push_back((now, at.position, at.rotation));
        while self.0.len() > MOST || self.0.front().is_some_and(|(first, ..)| now.0 - first.0 > WINDOW_US) {
            self.0.pop_front();
        }
    }

    /// How it moves `now`, within the bounds of a wish. The median of the slopes between all pairs of places (Theil 1950, Sen 1968), so
    /// that up to a quarter of them may be tracked wrongly. At rest where it was not moved for the length of the window.
    #[must_use]
    pub fn motion(&self, now: ClientTime) -> Motion {
        let recent: Vec<_> = self.0.iter().filter(|(at, ..)| now.0.saturating_sub(at.0) <= WINDOW_US).collect();
        let Some((begin, _, mut before)) = recent.first().copied().copied() else { return Motion::STILL };
        let mut turned = Vec3::ZERO;
        let samples: Vec<(f32, Vec3, Vec3)> = recent
            .iter()
            .map(|(at, position, rotation)| {
                // Turns between neighbours are small: their sum is the whole turn, even beyond half a circle.
                turned += shortest(*rotation * before.inverse()).to_scaled_axis();
                before = *rotation;
                ((at.0 - begin.0) as f32 * 1e-6, *position, turned)
            })
            .collect();
        let pairs: Vec<_> = (1..samples.len())
            .flat_map(|later| (0..later).map(move |earlier| (earlier, later)))
            .map(|(a, b)| (&samples[a], &samples[b]))
            .collect();
        let slopes = |of: fn(&(f32, Vec3, Vec3)) -> Vec3| {
            let slope = pairs.iter().map(|(a, b)| (of(b) - of(a)) / (b.0 - a.0)).collect::<Vec<_>>();
            Vec3::new(median(slope.iter().map(|s| s.x)), median(slope.iter().map(|s| s.y)), median(slope.iter().map(|s| s.z)))
        };
        Motion { linear: slopes(|sample| sample.1), angular: slopes(|sample| sample.2) }.bounded()
    }
}

/// The turn of the same result that is at most half a circle.
fn shortest(turn: Quat) -> Quat {
    if turn.w < 0.0 { -turn } else { turn }
}

/// Zero of nothing.
fn median(values: impl Iterator<Item = f32>) -> f32 {
    let mut values: Vec<_> = values.collect();
    values.sort_unstable_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME_US: u64 = 11_111;

    fn led(frames: u64, place: impl Fn(f32) -> (Vec3, Quat)) -> (History, ClientTime) {
        let mut history = History::default();
        for frame in 0..frames {
            let (position, rotation) = place(frame as f32 * FRAME_US as f32 * 1e-6);
            history.push(ClientTime(frame * FRAME_US), &Transform { position, rotation, scale: Vec3::ONE });
        }
        (history, ClientTime((frames - 1) * FRAME_US))
    }

    #[test]
    fn a_steady_swing_has_its_velocity_and_spin() {
        let (linear, angular) = (Vec3::new(2.0, 3.0, -4.0), Vec3::new(0.0, -6.0, 3.0));
        let (history, now) = led(30, |t| (Vec3::ONE + linear * t, Quat::from_scaled_axis(angular * t)));
        let motion = history.motion(now);
        assert!((motion.linear - linear).length() < 1e-3 && (motion.angular - angular).length() < 1e-2, "{motion:?}");
        // Beyond half a circle within the window.
        let fast = Vec3::Y * 39.0;
        let (history, now) = led(30, |t| (Vec3::ZERO, Quat::from_scaled_axis(fast * t)));
        assert!((history.motion(now).angular - fast).length() < 0.1);
    }

    #[test]
    fn what_is_tracked_wrongly_for_a_frame_does_not_count() {
        let velocity = Vec3::new(1.0, 2.0, 0.0);
        let (mut history, now) = led(30, |t| (velocity * t, Quat::IDENTITY));
        history.0[5].1 += Vec3::splat(0.5);
        let motion = history.motion(now);
        assert!((motion.linear - velocity).length() < 0.2, "{motion:?}");
    }

    #[test]
    fn only_the_end_of_the_way_counts_and_rest_is_rest() {
        // Back, then forth.
        let (history, now) = led(40, |t| (Vec3::X * (t - 0.3).abs() * 3.0, Quat::IDENTITY));
        assert!((history.motion(now).linear - Vec3::X * 3.0).length() < 1e-3);
        assert_eq!(history.motion(ClientTime(now.0 + WINDOW_US + FRAME_US)), Motion::STILL);
        assert_eq!(History::default().motion(now), Motion::STILL);
        let (one, now) = led(1, |_| (Vec3::ONE, Quat::IDENTITY));
        assert_eq!(one.motion(now), Motion::STILL);
    }

    #[test]
    fn times_that_stand_still_or_go_back_and_numbers_that_are_none_stay_within_bounds() {
        let mut history = History::default();
        for (at, x) in [(5, 0.0), (5, 1e30), (3, 2.0), (9, f32::NAN), (9, f32::INFINITY)] {
            history.push(ClientTime(at), &Transform { position: Vec3::X * x, ..Transform::default() });
        }
        let motion = history.motion(ClientTime(9));
        assert_eq!(motion, motion.bounded());
        (0..1000).for_each(|i| history.push(ClientTime(10 + i), &Transform::default()));
        assert_eq!(history.0.len(), MOST);
    }
}
