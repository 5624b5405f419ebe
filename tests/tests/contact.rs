//! The shade around the place where a ball stands on the ground, against what an integral over the hemisphere leaves of coloured light there.

use std::collections::HashMap;
use std::f32::consts::TAU;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use glam::{Quat, Vec2, Vec3};
use half::f16;
use mr360_client::camera::Camera;
use mr360_client::gpu::Gpu;
use mr360_client::picture::{Picture, Samples};
use mr360_client::render::{Still, load_light};
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{Geometry, Material, Object, ObjectId, Playback, Scene, Shape, Transform};
use mr360_protocol::video::{StereoLayout, Transfer};
use mr360_shaders::sh;

const SIZE: (u32, u32) = (320, 240);
const FOV_Y_RAD: f32 = 0.7;
const BALL: Vec3 = Vec3::new(0.0, -1.1, -3.0);
const RADIUS: f32 = 0.5;
const GROUND_Y: f32 = -1.6;
/// A half sphere's directions are so many rings and sectors.
const RINGS: u32 = 64;
/// Most that any channel may be off, of the light without the ball: one term stands for what lies behind the ball, and a black ball still mirrors 4 %.
const BOUND: f32 = 0.06;

/// What a ball leaves of the irradiance on level ground, by cosine-weighted directions.
fn left(light: &LightFrame, point: Vec3) -> Vec3 {
    let to_center = BALL - point;
    let (mut all, mut seen) = (Vec3::ZERO, Vec3::ZERO);
    for (ring, sector) in (0..RINGS).flat_map(|ring| (0..4 * RINGS).map(move |sector| (ring, sector))) {
        let sine = ((ring as f32 + 0.5) / RINGS as f32).sqrt();
        let (sin, cos) = ((sector as f32 + 0.5) / (4 * RINGS) as f32 * TAU).sin_cos();
        let direction = Vec3::new(sine * sin, (1.0 - sine * sine).sqrt(), sine * cos);
        let radiance = sh::radiance(&light.sh, direction);
        let nearest = to_center - direction * to_center.dot(direction);
        all += radiance;
        if to_center.dot(direction) < 0.0 || nearest.length() > RADIUS {
            seen += radiance;
        }
    }
    seen / all
}

#[test]
fn contact_shade_keeps_of_every_colour_what_the_ball_leaves() -> Result<()> {
    let gpu = Gpu::headless()?;
    // Harmonics of a hall whose lights are gone from them: in places bluer and in places redder than on the whole.
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("references/golden/warehouse.json");
    let mut light = load_light(&golden)?;
    light.lights.clear();
    light.sh.truncate(9);
    let grey = f16::from_f32(0.5);
    let samples = Samples::Rgba16F { texels: [grey, grey, grey, f16::ONE].repeat(64 * 32), transfer: Transfer::Linear };
    let picture = Picture { pts_us: 0, width: 64, height: 32, stereo: StereoLayout::Mono, samples };
    let transform = Transform { position: BALL, rotation: Quat::IDENTITY, scale: Vec3::splat(2.0 * RADIUS) };
    let material = Some(Material { base_color: [0.0; 3], roughness: 1.0, ..Material::default() });
    let ball = Object { id: ObjectId(1), geometry: Geometry::Shape(Shape::Sphere), transform, material, animation: Playback::First };
    let scene = Scene { ground_y: GROUND_Y, objects: vec![ball], ..Scene::default() };
    let camera = Camera::looking(0.0, -0.45, FOV_Y_RAD);
    let still = Still { gpu: &gpu, picture: &picture, light: &light, scene: &scene, assets: &HashMap::new() };
    let bytes = still.draw(&camera, SIZE, wgpu::TextureFormat::Rgba32Float).map_err(|error| anyhow::anyhow!("{error:?}"))?;
    let mut worst = 0.0_f32;
    for (x, z) in [(0.0, 0.18), (0.0, 0.25), (0.12, 0.25), (-0.3, 0.3), (0.0, 0.5), (0.5, 0.2), (-0.8, 0.2), (0.0, 0.9)] {
        let point = Vec3::new(BALL.x + x, GROUND_Y, BALL.z + z);
        let pixel = pixel_of(&camera, point).context("out of the picture")?;
        let texel = bytes.get(16 * pixel..16 * pixel + 12).context("fewer pixels than asked for")?;
        let value = |at: usize| f32::from_le_bytes([texel[at], texel[at + 1], texel[at + 2], texel[at + 3]]);
        let drawn = Vec3::new(value(0), value(4), value(8)) / 0.5;
        let expected = left(&light, point);
        eprintln!("{x}, {z}: {drawn}, not {expected}");
        worst = worst.max((drawn - expected).abs().max_element());
    }
    ensure!(worst < BOUND, "off by {worst} of the light without the ball");
    Ok(())
}

/// Index of the pixel that shows a point.
fn pixel_of(camera: &Camera, point: Vec3) -> Option<usize> {
    let view = camera.world_from_view.inverse() * (point - camera.position);
    let tan = (FOV_Y_RAD / 2.0).tan();
    let ndc = Vec2::new(view.x * SIZE.1 as f32 / SIZE.0 as f32, view.y) / (-view.z * tan);
    let at = (ndc * Vec2::new(0.5, -0.5) + 0.5) * Vec2::new(SIZE.0 as f32, SIZE.1 as f32);
    let inside = at.cmpge(Vec2::ZERO).all() && at.x < SIZE.0 as f32 && at.y < SIZE.1 as f32;
    inside.then(|| at.y as usize * SIZE.0 as usize + at.x as usize)
}
