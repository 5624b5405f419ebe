//! What the camera does: exposure, white balance, cuts, shake, broken frames, pace.

use std::f32::consts::{PI, TAU};

use glam::{Quat, Vec3};

use super::{Disc, LAMP, SKY, Scene, Sequence, Varies, sun};

/// Nothing changes but the grain.
#[must_use]
pub fn still() -> Sequence {
    Sequence::new("still", 10.0, |_| Scene::new(vec![sun(40.0, 50.0)]))
}

/// Exposure rises by 1 EV a second for two seconds, rests, and falls back. The linear sequence clips nothing.
#[must_use]
pub fn exposure_ramp(linear: bool) -> Sequence {
    let scene = |time: f32| {
        let stops = (time - 1.0).clamp(0.0, 2.0) - (time - 4.0).clamp(0.0, 2.0) - 1.0;
        Scene::new(vec![Disc { radiance: LAMP, ..sun(40.0, 50.0) }]).exposed(Vec3::splat(stops))
    };
    let name = if linear { "exposure ramp, linear" } else { "exposure ramp" };
    let sequence = Sequence::new(name, 7.0, scene).varying(Varies::Exposure);
    if linear { sequence.linear() } else { sequence }
}

/// A clipped lamp, six times white, whose exposure falls by 3 EV: for two seconds it is seen as it is, and then clipped again. The exposure
/// moves at once, or by 1.5 EV a second.
#[must_use]
pub fn exposure_seen(at_once: bool) -> Sequence {
    let scene = move |time: f32| {
        let (fallen, risen) = if at_once {
            (if time < 2.0 { 0.0 } else { 1.0 }, if time < 4.0 { 0.0 } else { 1.0 })
        } else {
            ((0.5 * (time - 2.0)).clamp(0.0, 1.0), (0.5 * (time - 6.0)).clamp(0.0, 1.0))
        };
        let lamp = Disc { radiance: 0.75 * LAMP, radius: 1.5 * sun(40.0, 50.0).radius, ..sun(40.0, 50.0) };
        Scene { sky: 2.5 * SKY, ..Scene::new(vec![lamp]) }.exposed(Vec3::splat(3.0 * (risen - fallen)))
    };
    if at_once {
        Sequence::new("exposure seen at once", 7.0, scene).stepping(&[2.0, 4.0])
    } else {
        Sequence::new("exposure seen", 10.0, scene)
    }
}

/// After two seconds the white balance goes to a warmer light at once.
#[must_use]
pub fn white_balance_jump() -> Sequence {
    Sequence::new("white balance jump", 4.0, |time| {
        let stops = if time < 2.0 { Vec3::ZERO } else { Vec3::new(-0.3, 0.0, 0.5) };
        Scene::new(vec![sun(40.0, 50.0)]).exposed(stops)
    })
    .stepping(&[2.0])
}

/// Two seconds here, two there, and back.
#[must_use]
pub fn scene_cut() -> Sequence {
    Sequence::new("scene cut", 6.0, |time| {
        let there = (2.0..4.0).contains(&time);
        let scene = Scene::new(vec![if there { sun(-120.0, 25.0) } else { sun(40.0, 50.0) }]);
        Scene { place: if there { 1.7 } else { 0.0 }, ..scene }
    })
    .stepping(&[2.0, 4.0])
}

/// The camera shakes by 1° at 2 Hz, about two axes.
#[must_use]
pub fn shake() -> Sequence {
    Sequence::new("shake", 5.0, |time| {
        let degree = PI / 180.0;
        let turn = Quat::from_rotation_x(degree * (TAU * 2.0 * time).sin()) * Quat::from_rotation_z(degree * (TAU * 1.3 * time).sin());
        Scene { turn, ..Scene::new(vec![sun(40.0, 50.0)]) }
    })
}

/// One frame has pixels that are no numbers, infinite, negative and too large.
#[must_use]
pub fn faulty_frame() -> Sequence {
    let sequence = Sequence::new("faulty frame", 3.0, |_| Scene::new(vec![sun(40.0, 50.0)]));
    Sequence { faulty: Some(45), ..sequence }
}

/// 30 frames a second, then 12, then 60, with a gap of half a second in between, while the sun moves on.
#[must_use]
pub fn uneven_pace() -> Sequence {
    let steps = [(33_333, 45), (83_333, 18), (500_000, 1), (16_667, 90)];
    let steps = steps.iter().flat_map(|(step, count)| std::iter::repeat_n(*step, *count));
    let times_us = steps.scan(0, |time, step| Some(std::mem::replace(time, *time + step))).collect();
    Sequence { times_us, ..Sequence::new("uneven pace", 0.0, |time| Scene::new(vec![sun(5.0 * time, 40.0)])) }
}
