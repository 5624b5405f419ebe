//! The measures against sequences whose figures are known in closed form.

use std::f64::consts::TAU;

use glam::{DVec3, Vec3};
use mr360_protocol::light::DirectionalLight;
use mr360_server::lighting::Estimate;
use mr360_server::lighting::sequences::{Truth, Varies};

use super::measures::{Main, Measures, Moment, Shown, degrees};

/// A light this far from the zenith towards +x.
fn tilted(degrees: f64) -> DVec3 {
    DVec3::new(degrees.to_radians().sin(), degrees.to_radians().cos(), 0.0)
}

/// One light and an even surrounding: every surface receives `surfaces`.
fn shown(direction: DVec3, strength: f64, surfaces: f64) -> Shown {
    let main = Main { direction, strength };
    Shown { main: Some(main), lights: vec![(0, direction)], surfaces: [DVec3::splat(surfaces); 6], ambient: surfaces }
}

fn dark() -> Shown {
    Shown { main: None, lights: Vec::new(), surfaces: [DVec3::ONE; 6], ambient: 1.0 }
}

/// Thirty frames a second.
fn moments(count: usize, of: impl Fn(usize) -> (Shown, Option<Shown>)) -> Vec<Moment> {
    let moment = |frame: usize| {
        let (estimate, truth) = of(frame);
        Moment { time_s: frame as f64 / 30.0, estimate, truth }
    };
    (0..count).map(moment).collect()
}

fn plain(moments: &[Moment]) -> Measures {
    Measures::of(moments, &[], Varies::Else)
}

fn close(a: Option<f64>, b: f64) -> bool {
    a.is_some_and(|a| (a - b).abs() < 1e-3)
}

#[test]
fn an_offset_is_an_error_and_no_wander() {
    let still = plain(&moments(31, |_| (shown(tilted(12.0), 2.0, 3.0), Some(shown(tilted(10.0), 1.0, 1.5)))));
    assert!(close(still.off_rms_deg, 2.0) && close(still.off_worst_deg, 2.0) && close(still.wander_rms_deg, 0.0), "{still:?}");
    assert!(close(still.strength_variation, 0.0) && still.level_variation < 1e-9 && still.jump < 1e-9, "{still:?}");
    assert!(close(still.strength_first, 2.0) && close(still.strength_last, 2.0) && close(still.turn_worst_deg, 0.0), "{still:?}");
    assert_eq!((still.events_per_s, still.true_events_per_s, still.found, still.invented), (0.0, Some(0.0), Some(1.0), None));
    assert_eq!((still.lag_s, still.ripple, still.ratio_drift), (None, None, None));
}

#[test]
fn a_light_that_alternates_wanders_by_half_of_it() {
    let alternate = |frame: usize| if frame.is_multiple_of(2) { 1.0 } else { -1.0 };
    let of =
        |frame: usize| (shown(tilted(10.0 + 0.5 * alternate(frame)), 1.0 + 0.1 * alternate(frame), 1.0 + 0.1 * alternate(frame)), None);
    let measures = plain(&moments(30, of));
    assert!(close(measures.wander_rms_deg, 0.5) && close(measures.turn_worst_deg, 1.0) && close(measures.strength_variation, 0.1));
    // From 1.1 to 0.9, and 1.1 is the most.
    assert!((measures.level_variation - 0.1).abs() < 1e-9 && (measures.jump - 0.2 / 1.1).abs() < 1e-9, "{measures:?}");
    assert_eq!((measures.off_rms_deg, measures.found, measures.true_jump), (None, None, None));
}

#[test]
fn motion_of_the_truth_is_no_error() {
    let of = |frame: usize| {
        let truth = shown(tilted(frame as f64), 1.0 + frame as f64, 1.0 + frame as f64);
        (truth.clone(), Some(truth))
    };
    let measures = plain(&moments(9, of));
    assert!(close(measures.off_worst_deg, 0.0) && close(measures.wander_rms_deg, 0.0) && close(measures.turn_worst_deg, 0.0));
    assert!(close(measures.strength_variation, 0.0) && measures.level_variation < 1e-9);
    assert!((measures.jump - 1.0 / 9.0).abs() < 1e-9 && measures.true_jump == Some(measures.jump));
}

#[test]
fn births_deaths_and_exchanges_are_counted() {
    // There, gone, there at 20° under its old name: a death, a birth, and no more. Then it jumps by 20°: both. A move of 5° is none.
    let at = [Some(0.0), None, Some(20.0), Some(40.0), Some(45.0)];
    let of = |frame: usize| (at[frame].map_or_else(dark, |degrees| shown(tilted(degrees), 1.0, 1.0)), Some(dark()));
    let measures = plain(&moments(5, of));
    // Four events within four thirtieths of a second.
    assert!((measures.events_per_s - 30.0).abs() < 1e-9, "{measures:?}");
    assert_eq!((measures.true_events_per_s, measures.invented, measures.found), (Some(0.0), Some(0.8), None));
}

#[test]
fn a_light_that_is_elsewhere_or_absent_is_not_found() {
    let of = |frame: usize| {
        let estimate = [shown(tilted(9.0), 1.0, 1.0), shown(tilted(11.0), 1.0, 1.0), dark(), dark()][frame].clone();
        (estimate, Some(shown(tilted(0.0), 1.0, 1.0)))
    };
    let measures = plain(&moments(4, of));
    assert!(close(measures.found, 0.25) && close(measures.off_worst_deg, 11.0) && close(measures.off_rms_deg, (101f64).sqrt()));
}

#[test]
fn an_exponential_lags_until_a_twentieth_is_left() {
    // From 1 to 2 with a time constant of 0.1 s from the thirtieth frame on; what is left is under a twentieth of 2 after 0.1 ln 10 s.
    let of = |frame: usize| {
        let since = (frame as f64 - 30.0) / 30.0;
        let level = if since < 0.0 { 1.0 } else { 2.0 - (-since / 0.1).exp() };
        (shown(tilted(0.0), 1.0, level), Some(shown(tilted(0.0), 1.0, if since < 0.0 { 1.0 } else { 2.0 })))
    };
    let all = moments(120, of);
    let expected = ((0.1 * 10f64.ln()) * 30.0).ceil() / 30.0;
    assert!(close(Measures::of(&all, &[1.0], Varies::Else).lag_s, expected));
    // At once is no lag, and what never settles lags to the end of its time.
    let stepped = moments(90, |frame| (shown(tilted(0.0), 1.0, if frame < 30 { 1.0 } else { 2.0 }), None));
    assert_eq!(Measures::of(&stepped, &[1.0], Varies::Else).lag_s, Some(0.0));
    let rising = moments(90, |frame| (shown(tilted(0.0), 1.0, 2f64.powi(frame as i32)), None));
    assert!(close(Measures::of(&rising, &[1.0, 2.0], Varies::Else).lag_s, 29.0 / 30.0));
}

#[test]
fn a_beat_that_is_halved_has_half_the_ripple() {
    let of = |frame: usize| {
        let beat = (TAU * frame as f64 / 3.0).sin();
        (shown(tilted(0.0), 1.0 + 0.05 * beat, 1.0 + 0.1 * beat), Some(shown(tilted(0.0), 1.0 + 0.2 * beat, 1.0 + 0.2 * beat)))
    };
    let measures = Measures::of(&moments(150, of), &[], Varies::Beat);
    assert!(close(measures.ripple, 0.5) && close(measures.light_ripple, 0.25), "{measures:?}");
    // Three frames hold a whole beat.
    assert!(close(measures.known_ripple, 0.0), "{measures:?}");
    // A step of the truth is left of any mean, and somebody who averages twelve frames waits for it.
    let of = |frame: usize| (shown(tilted(0.0), 1.0, 1.0), Some(shown(tilted(0.0), 1.0, if frame < 100 { 1.0 } else { 2.0 })));
    assert!(close(Measures::of(&moments(150, of), &[], Varies::Beat).known_ripple, 1.0));
}

#[test]
fn the_strength_at_the_least_exposure_stands_by_itself() {
    let of = |frame: usize| {
        let truth = if (30..60).contains(&frame) { 1.0 } else { 4.0 };
        (shown(tilted(0.0), if truth < 2.0 { 0.8 } else { 2.0 }, 1.0), Some(shown(tilted(0.0), truth, 1.0)))
    };
    let measures = plain(&moments(90, of));
    assert!(close(measures.strength_first, 0.5) && close(measures.strength_least, 0.8), "{measures:?}");
}

#[test]
fn the_ratio_of_light_to_ambient_drifts_from_its_first() {
    let of = |frame: usize| (shown(tilted(0.0), 1.0 + 0.01 * frame as f64, 2.0), None);
    let drift = |moments: &[Moment]| Measures::of(moments, &[], Varies::Exposure).ratio_drift;
    assert!(close(drift(&moments(11, of)), 0.1));
    assert_eq!(drift(&moments(3, |frame| if frame == 2 { (dark(), None) } else { of(0) })), Some(1.0));
}

#[test]
fn lights_side_by_side_are_one_main_light() {
    let light = |id, degrees: f64, irradiance| DirectionalLight {
        id,
        direction: tilted(degrees).as_vec3(),
        irradiance: Vec3::splat(irradiance),
        solid_angle_sr: 0.01,
    };
    let lights = vec![light(0, -3.0, 1.0), light(1, 3.0, 2.0), light(2, 40.0, 1.9)];
    let mut sh = vec![Vec3::ZERO; 9];
    sh[0] = Vec3::splat((4.0 * std::f32::consts::PI).sqrt());
    let estimate = Shown::of_estimate(&Estimate { lights: lights.clone(), sh, ..Estimate::default() });
    let main = estimate.main.unwrap();
    // A third of the way from the stronger to the weaker one.
    assert!((main.strength - 3.0).abs() < 1e-5 && degrees(main.direction, tilted(1.0)) < 0.01, "{main:?}");
    assert!((estimate.ambient - 1.0).abs() < 1e-5 && estimate.lights.len() == 3);
    let level = std::f64::consts::PI + 3.0 * tilted(3.0).y + 1.9 * tilted(40.0).y;
    assert!((estimate.level() - level).abs() < 1e-5, "{}", estimate.level());
    // Of a truth the first light is the main one, unless it gives next to nothing.
    let truth = |lights: Vec<DirectionalLight>| Truth { lights, ambient: Vec3::ONE, gain: Vec3::ONE, irradiance: [Vec3::ONE; 6] };
    let first = Shown::of_truth(&truth(vec![light(0, 40.0, 1.9), light(1, 3.0, 2.0)])).main.unwrap();
    assert!((first.strength - 1.9).abs() < 1e-5);
    assert_eq!(Shown::of_truth(&truth(vec![light(0, 40.0, 0.3)])).main, None);
    assert_eq!(Shown::of_truth(&truth(Vec::new())).main, None);
}
