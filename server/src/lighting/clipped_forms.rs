//! Closed forms of frames that clip.

use glam::{DVec3, Vec3};
use mr360_protocol::light::Lift;
use mr360_protocol::video::Transfer;
use mr360_shaders::colour::{luminance, recovered, srgb_decode, srgb_encode};
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};

use super::closed_forms::{Disc, degrees, energy, sky};
use super::{Directional, Estimate, LightMethod, StepTimes};
use crate::frame::{Frame, Pixels};

fn estimate(frame: &Frame) -> Estimate {
    Directional::default().estimate(frame, &mut StepTimes::default()).unwrap().clone()
}

/// A disc of this linear radiance in a dim sky.
fn lamp(level: f32) -> Frame {
    sky(Transfer::Srgb, Vec3::splat(0.2), &[Disc::at(40.0, 40.0, 5.0, Vec3::splat(srgb_encode(level)))])
}

/// Energy of a frame under a curve, each pixel by itself.
fn energy_under(lift: Lift, frame: &Frame) -> DVec3 {
    let (Pixels::Rgb { width, height, texels, .. }, Lift::Recovered(curve)) = (&frame.pixels, lift) else { panic!("{lift:?}") };
    let energy = |(i, texel): (usize, &[f32; 3])| {
        let (x, y) = (i as u32 % width, i as u32 / width);
        let direction = direction_from_uv(glam::Vec2::new((x as f32 + 0.5) / *width as f32, (y as f32 + 0.5) / *height as f32));
        let linear = Vec3::from_array(texel.map(srgb_decode));
        recovered(&curve, direction, linear).as_dvec3() * f64::from(pixel_solid_angle_sr(y, *width, *height))
    };
    texels.iter().enumerate().map(energy).sum()
}

#[test]
fn lights_and_sh_hold_what_a_viewer_sees_under_the_same_curve() {
    let two = |level: f32| {
        let code = Vec3::splat(srgb_encode(level));
        sky(Transfer::Srgb, Vec3::splat(0.2), &[Disc::at(40.0, 30.0, 4.0, code), Disc::at(-100.0, 60.0, 7.0, code)])
    };
    for frame in [0.8, 0.93, 0.96, 0.98, 1.0].into_iter().flat_map(|level| [lamp(level), two(level)]) {
        let estimate = estimate(&frame);
        let ratio = energy(&estimate) / energy_under(estimate.lift, &frame);
        // Texels on a rim are averages of shown and clipped and count as shown: a twentieth of a disc of 5° and texels of 0.7°.
        assert!((ratio - 1.0).abs().max_element() < 0.05, "{ratio}");
    }
}

#[test]
fn a_lamp_comes_to_be_clipped_without_a_step() {
    let strength = |level: f32| estimate(&lamp(level)).lights.first().map_or(0.0, |light| luminance(light.irradiance));
    let strengths: Vec<f32> = (0..=50).map(|i| strength(0.90 + 0.002 * i as f32)).collect();
    assert!(strengths[50] > 1.5 * strengths[0] && strengths[0] > 0.0, "{strengths:?}");
    // The steepest part of the ramp makes a fifteenth of what is hidden; where the clipped part takes over from the whole region, what lay
    // below its threshold is added.
    assert!(strengths.windows(2).all(|pair| pair[1] > 0.98 * pair[0] && pair[1] < 1.25 * pair[0]), "{strengths:?}");
}

#[test]
fn a_glint_does_not_put_out_a_lamp_that_is_not_clipped() {
    let code = Vec3::splat(srgb_encode(0.9));
    let (lamp, glint) = (Disc::at(40.0, 40.0, 5.0, code), Disc::at(-60.0, 20.0, 0.6, Vec3::ONE));
    let estimate = estimate(&sky(Transfer::Srgb, Vec3::splat(0.2), &[lamp, glint]));
    let near = estimate.lights.iter().filter(|light| degrees(light.direction, lamp.centre) < 1.0).count();
    assert_eq!(near, 1, "{:?}", estimate.lights);
}

#[test]
fn a_speck_takes_nothing_from_a_lamp_that_is_on_the_way_to_white() {
    for linear in [0.93, 0.95, 0.96] {
        let lamp = Disc::at(40.0, 40.0, 5.0, Vec3::splat(srgb_encode(linear)));
        let near = |discs: &[Disc]| -> f32 {
            let lights = estimate(&sky(Transfer::Srgb, Vec3::splat(0.2), discs)).lights;
            lights.iter().filter(|light| degrees(light.direction, lamp.centre) < 1.0).map(|light| luminance(light.irradiance)).sum()
        };
        // One texel, a third of what counts as whole.
        let (alone, beside) = (near(&[lamp]), near(&[lamp, Disc::at(-60.117, 60.117, 0.5, Vec3::ONE)]));
        assert!(alone > 0.0 && (beside / alone - 1.0).abs() < 0.05, "{linear}: {alone} {beside}");
    }
}

#[test]
fn a_light_that_was_seen_stays_the_same_however_much_it_is_clipped() {
    // Eleven times white, and seen as 0.9 of it 3.6 stops darker.
    let scene = |gain: f32| {
        let code = |radiance: f32| Vec3::splat(srgb_encode((radiance * gain).min(1.0)));
        sky(Transfer::Srgb, code(0.3), &[Disc::at(40.0, 40.0, 6.0, code(11.0)), Disc::at(-90.0, -50.0, 40.0, code(0.2))])
    };
    let (dark, bright) = (scene(0.9 / 11.0), scene(1.0));
    let mut method = Directional::default();
    let lights: Vec<_> = (0..60u64)
        .map(|n| {
            let frame = if n < 20 { &dark } else { &bright };
            let Pixels::Rgb { width, height, texels, transfer } = &frame.pixels else { unreachable!() };
            let pixels = Pixels::Rgb { width: *width, height: *height, texels: texels.clone(), transfer: *transfer };
            let frame = Frame { pts_us: n * 33_333, stereo: frame.stereo, pixels };
            method.estimate(&frame, &mut StepTimes::default()).unwrap().lights.clone()
        })
        .collect();
    let (seen, clipped) = (&lights[19][0], &lights[59][0]);
    assert_eq!(seen.id, clipped.id);
    let ratio = luminance(clipped.irradiance) / luminance(seen.irradiance) / (11.0 / 0.9);
    // The exposure is measured on codes of 8 bits near black.
    assert!((ratio - 1.0).abs() < 0.15, "{ratio}");
}
