//! The video behind everything: what is between its texels, what is finer than pixels, and codes of 8 bits. They need a Vulkan adapter
//! and fail without one.

use std::collections::HashMap;
use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};
use half::f16;
use mr360_protocol::video::{StereoLayout, Transfer};
use mr360_shaders::colour::{decode_transfer, srgb_encode};
use mr360_shaders::equirect::{direction_from_uv, uv_from_direction};

use super::tests::{SIZE, floats, panorama, ray_of, scene};
use super::*;
use crate::picture::{Picture, Samples};
use crate::render::{How, Still, ambient_light};

/// A panorama of sRGB codes.
fn coded(width: u32, height: u32, code: impl Fn(Vec2) -> f32) -> Picture {
    let texel = |i: u32| {
        let uv = Vec2::new(((i % width) as f32 + 0.5) / width as f32, ((i / width) as f32 + 0.5) / height as f32);
        let code = f16::from_f32(code(uv));
        [code, code, code, f16::ONE]
    };
    let texels = (0..width * height).flat_map(texel).collect();
    let samples = Samples::Rgba16F { texels, transfer: Transfer::Srgb };
    Picture { pts_us: 0, width, height, stereo: StereoLayout::Mono, samples }
}

fn show(gpu: &Gpu, picture: &Picture, camera: &Camera) -> Vec<f32> {
    let (light, empty) = (ambient_light(picture), scene(vec![]));
    let still = Still { gpu, picture, light: &light, scene: &empty, assets: &HashMap::new() };
    let how = How { resampling: Resampling::Fine, ..How::default() };
    floats(&still.draw_by(how, camera, SIZE, wgpu::TextureFormat::Rgba32Float).unwrap()).into_iter().map(|c| c.x).collect()
}

/// What the picture shows, as an sRGB code.
fn codes(gpu: &Gpu, picture: &Picture, camera: &Camera) -> Vec<f32> {
    show(gpu, picture, camera).into_iter().map(srgb_encode).collect()
}

#[test]
fn the_seam_is_a_place_like_any_other_large_and_small() {
    let gpu = Gpu::headless().unwrap();
    // A fifth of a cycle a texel around, the same after each quarter turn.
    for (width, fov) in [(320, 0.5), (1280, 1.2)] {
        let cycles = (width / 20 * 4) as f32;
        let picture = coded(width, width / 2, |uv| 0.5 + 0.2 * (TAU * cycles * uv.x + 1.0).cos() + 0.1 * (TAU * uv.y * cycles * 0.5).sin());
        let quarters = [0.0f32, 1.0, 2.0, 3.0].map(|turn| show(&gpu, &picture, &Camera::looking(turn * PI / 2.0, 0.3, fov)));
        for other in &quarters[1..] {
            let off = quarters[0].iter().zip(other).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            // Directions of floats, on the steepest slope that there is: 0.2 · 2π · 64 a turn.
            assert!(off < 2e-3, "{width}: {off}");
        }
    }
}

#[test]
fn between_texels_there_is_more_than_a_line() {
    let gpu = Gpu::headless().unwrap();
    let (width, cycles) = (320, 64.0);
    let code = |uv: Vec2| 0.5 + 0.2 * (TAU * cycles * uv.x).cos();
    let picture = coded(width, width / 2, code);
    let camera = Camera::looking(0.4, 0.0, 0.15);
    let drawn = codes(&gpu, &picture, &camera);
    // What linear interpolation of the same texels makes.
    let linear = |uv: Vec2| {
        let place = uv.x * width as f32 - 0.5;
        let texel = |i: f32| code(Vec2::new((i + 0.5) / width as f32, 0.5));
        let t = place - place.floor();
        texel(place.floor()) * (1.0 - t) + texel(place.floor() + 1.0) * t
    };
    let (mut ours, mut theirs) = (0.0, 0.0);
    for (at, seen) in drawn.iter().enumerate() {
        let uv = uv_from_direction(ray_of(&camera, at));
        ours += (seen - code(uv)).powi(2);
        theirs += (linear(uv) - code(uv)).powi(2);
    }
    println!("rms {} against {}", (ours / drawn.len() as f32).sqrt(), (theirs / drawn.len() as f32).sqrt());
    // At a fifth of a cycle a texel, midway: cos 36° = 0.81 is left by a line, 0.95 by a cubic.
    assert!(ours.sqrt() < 0.4 * theirs.sqrt(), "{ours} {theirs}");
}

#[test]
fn poles_are_as_smooth_as_all_else() {
    let gpu = Gpu::headless().unwrap();
    // Slopes across the pole, of few texels: rows beyond it lie on its other side.
    let code = |d: Vec3| 0.5 + 0.3 * d.x + 0.15 * d.z;
    let picture = coded(64, 32, |uv| code(direction_from_uv(uv)));
    for pitch in [PI / 2.0, -PI / 2.0, 0.0] {
        let camera = Camera::looking(0.3, pitch, 0.5);
        let off = codes(&gpu, &picture, &camera)
            .iter()
            .enumerate()
            .map(|(at, seen)| (seen - code(ray_of(&camera, at))).abs())
            .fold(0.0, f32::max);
        println!("pitch {pitch}: {off}");
        // Codes are half floats: steps of 0.0005.
        assert!(off < 0.002, "pitch {pitch}: {off}");
    }
}

#[test]
fn what_is_finer_than_pixels_is_averaged_in_light() {
    let gpu = Gpu::headless().unwrap();
    // Black and white by turns, one texel each; a pixel spans 4.6 of them.
    let (width, fov) = (1024, 0.9);
    let white = |uv: Vec2| ((uv.x * width as f32) as u32 + (uv.y * width as f32 / 2.0) as u32).is_multiple_of(2);
    let picture = coded(width, width / 2, |uv| f32::from(u8::from(white(uv))));
    for yaw in [0.0, PI] {
        let drawn = show(&gpu, &picture, &Camera::looking(yaw, 0.0, fov * 2.0));
        let mean = drawn.iter().sum::<f32>() / drawn.len() as f32;
        let spread = (drawn.iter().map(|c| (c - mean).powi(2)).sum::<f32>() / drawn.len() as f32).sqrt();
        println!("mean {mean}, spread {spread}");
        // Rays see codes between those of the texels, half a code by the middle, which is 0.21 of the light; single rays would
        // see anything from 0 to 1.
        assert!((0.21..0.5).contains(&mean) && spread < 0.04, "{mean} {spread}");
    }
}

#[test]
fn a_slow_gradient_keeps_its_mean_in_eight_bits() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(256, 128, |d| Vec3::splat(0.2 + 0.02 * d.x + 0.01 * d.y));
    let light = ambient_light(&picture);
    let empty = scene(vec![]);
    let still = Still { gpu: &gpu, picture: &picture, light: &light, scene: &empty, assets: &HashMap::new() };
    let size = (160, 88);
    let camera = Camera::looking(0.0, 0.0, 0.9);
    let exact: Vec<f32> =
        floats(&still.draw(&camera, size, wgpu::TextureFormat::Rgba32Float).unwrap()).iter().map(|c| srgb_encode(c.x) * 255.0).collect();
    for format in [wgpu::TextureFormat::Rgba8Unorm, wgpu::TextureFormat::Rgba8UnormSrgb] {
        let drawn: Vec<f32> = still.draw(&camera, size, format).unwrap().chunks_exact(4).map(|texel| f32::from(texel[0])).collect();
        let mut rounded = 0.0f32;
        for block in 0..(size.0 / 8 * size.1 / 8) {
            let (left, top) = (block % (size.0 / 8) * 8, block / (size.0 / 8) * 8);
            let mean = |of: &[f32]| (0..64).map(|i| of[((top + i / 8) * size.0 + left + i % 8) as usize]).sum::<f32>() / 64.0;
            let (seen, truth) = (mean(&drawn), mean(&exact));
            assert!((seen - truth).abs() < 0.125, "{format:?} {block}: {seen} against {truth}");
            rounded = rounded.max((truth.round() - truth).abs());
        }
        assert!(rounded > 0.4 && drawn.iter().zip(&exact).all(|(a, b)| (a - b).abs() < 1.0), "{format:?}: {rounded}");
    }
}

#[test]
fn every_code_of_srgb_video_is_shown_as_itself() {
    let gpu = Gpu::headless().unwrap();
    for (transfer, shown) in [(Transfer::Srgb, None), (Transfer::Bt709, Some(Transfer::Bt709))] {
        for code in (0..=255u32).step_by(15) {
            let value = f16::from_f32(code as f32 / 255.0);
            let texels = [value, value, value, f16::ONE].repeat(32);
            let samples = Samples::Rgba16F { texels, transfer };
            let picture = Picture { pts_us: 0, width: 8, height: 4, stereo: StereoLayout::Mono, samples };
            let (light, empty) = (ambient_light(&picture), scene(vec![]));
            let still = Still { gpu: &gpu, picture: &picture, light: &light, scene: &empty, assets: &HashMap::new() };
            for format in [wgpu::TextureFormat::Rgba8Unorm, wgpu::TextureFormat::Rgba8UnormSrgb] {
                let drawn = still.draw(&Camera::looking(0.0, 0.0, 0.9), (16, 8), format).unwrap();
                let mean = drawn.chunks_exact(4).map(|texel| f32::from(texel[1])).sum::<f32>() / 128.0;
                let expected = match shown {
                    None => code as f32,
                    Some(transfer) => srgb_encode(decode_transfer(transfer, Vec3::splat(code as f32 / 255.0)).x) * 255.0,
                };
                // Codes as half floats are off by up to a sixteenth of a step. Targets that encode may do it by less than a step's half.
                let tolerance = if format == wgpu::TextureFormat::Rgba8Unorm { 0.13 } else { 0.3 };
                assert!((mean - expected).abs() < tolerance, "{transfer:?} {format:?} {code}: {mean} against {expected}");
            }
        }
    }
}
