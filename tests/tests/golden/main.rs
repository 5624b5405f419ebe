//! Golden pictures: what the viewer draws today, held against what was looked at and kept in `tests/references/golden`.
//!
//! After a change that is meant to be seen: `MR360_GOLDEN=write cargo test -p mr360-tests --test golden`, then look at what git says has changed.
//! `tolerances.toml` beside the pictures holds every tolerance with its reason.

mod hold;
mod materials;
mod multiview;
mod video;

use std::collections::HashMap;

use anyhow::{Context, Result};
use glam::Vec3;
use image::RgbImage;
use mr360_client::camera::Camera;
use mr360_client::gpu::Gpu;
use mr360_client::picture::Picture;
use mr360_client::render::{Models, Still, load_light, load_panorama};
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{Geometry, Object, ObjectId, Playback, Scene, Transform};
use mr360_protocol::video::StereoLayout;
use mr360_tests::sandbox::media;

use hold::{folder, hold};

/// Under a low sun, in a hall without a light that stands out, and among many windows.
const PANORAMAS: [&str; 3] = ["esplanade", "hall", "warehouse"];
/// Of the pictures.
const SIZE: (u32, u32) = (96, 72);

/// A panorama with the light that was estimated when the pictures were made: another estimate must not change them.
fn panorama(name: &str) -> Result<(Picture, LightFrame)> {
    let picture = load_panorama(&media(&format!("hdr/{name}.exr"))?, StereoLayout::Mono)?;
    Ok((picture, load_light(&folder().join(format!("{name}.json")))?))
}

fn draw(gpu: &Gpu, (picture, light): (&Picture, &LightFrame), (scene, assets): (&Scene, &Models), camera: &Camera) -> Result<RgbImage> {
    let still = Still { gpu, picture, light, scene, assets };
    let bytes = still.draw(camera, SIZE, wgpu::TextureFormat::Rgba8UnormSrgb).map_err(|error| anyhow::anyhow!("{error:?}"))?;
    let rgba = image::RgbaImage::from_raw(SIZE.0, SIZE.1, bytes).context("a picture of another size came back")?;
    Ok(image::DynamicImage::from(rgba).into_rgb8())
}

/// What stands where the camera of [`ahead`] looks: balls of one metre, or what is as large.
fn scene_of(geometry: Geometry, material: Option<mr360_protocol::scene::Material>, position: Vec3) -> Scene {
    let transform = Transform { position, rotation: glam::Quat::IDENTITY, scale: Vec3::ONE };
    let object = Object { id: ObjectId(1), geometry, transform, material, animation: Playback::First };
    Scene { ground_y: -1.6, objects: vec![object], ..Scene::default() }
}

/// Sees a ball on the ground, three metres away, and its shadow.
fn ahead() -> Camera {
    Camera::looking(0.0, -0.34, 0.62)
}

#[test]
fn every_material_in_every_panorama() -> Result<()> {
    let gpu = Gpu::headless()?;
    let mut drawn = Vec::new();
    for name in PANORAMAS {
        let (mut picture, light) = panorama(name)?;
        picture.pts_us = materials::TIME_US;
        for (material, scene, assets) in materials::all()? {
            drawn.push((format!("{name}-{material}"), draw(&gpu, (&picture, &light), (&scene, &assets), &ahead())?));
        }
    }
    hold(drawn)
}

#[test]
fn the_seam_and_both_poles() -> Result<()> {
    let gpu = Gpu::headless()?;
    let (picture, light) = panorama("esplanade")?;
    let (scene, assets) = (Scene { ground_y: -1.6, ..Scene::default() }, HashMap::new());
    let views = [("seam", 180.0_f32, 0.0_f32), ("zenith", 30.0, 90.0), ("nadir", 30.0, -90.0)];
    let view = |(name, yaw, pitch): (&str, f32, f32)| {
        let camera = Camera::looking(yaw.to_radians(), pitch.to_radians(), 1.0);
        Ok((name.to_owned(), draw(&gpu, (&picture, &light), (&scene, &assets), &camera)?))
    };
    hold(views.into_iter().map(view).collect::<Result<_>>()?)
}

#[test]
fn video_of_8_bits_and_hdr_video() -> Result<()> {
    let gpu = Gpu::headless()?;
    let (linear, light) = panorama("esplanade")?;
    let (scene, assets) = materials::glossy();
    let mut drawn = Vec::new();
    for (name, colour) in video::COLOURS {
        let picture = video::coded(&linear, colour)?;
        drawn.push((format!("video-{name}"), draw(&gpu, (&picture, &light), (&scene, &assets), &ahead())?));
    }
    hold(drawn)
}

#[test]
fn both_eyes_of_a_stereo_picture() -> Result<()> {
    let gpu = Gpu::headless()?;
    let (mono, light) = panorama("esplanade")?;
    let picture = video::top_bottom(&mono)?;
    let (scene, assets) = materials::glossy();
    let eye = |(name, right_eye): (&str, bool)| {
        let camera = Camera { right_eye, ..ahead() };
        Ok((format!("stereo-{name}"), draw(&gpu, (&picture, &light), (&scene, &assets), &camera)?))
    };
    hold([("left", false), ("right", true)].into_iter().map(eye).collect::<Result<_>>()?)
}
