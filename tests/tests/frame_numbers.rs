//! The picture that is shown is the frame whose light is used: both are read from the viewer's own pixels.
//!
//! The test card spells its number in blocks around the nadir, and its colour bars turn, so the light of every frame is
//! another one. Four white balls show it.

use anyhow::{Context, Result, ensure};
use glam::{Vec2, Vec3};
use image::RgbImage;
use mr360_client::camera::Camera;
use mr360_server::ingest::testcard::read_number;
use mr360_shaders::colour::decode_transfer;
use mr360_shaders::equirect::direction_from_uv;
use mr360_shaders::sh::irradiance;
use mr360_tests::clips;
use mr360_tests::probe::LONG;
use mr360_tests::samples::Samples;
use mr360_tests::sandbox::Sandbox;
use serde::Deserialize;

/// The bars turn once in eight seconds: at three frames a second by 15° from frame to frame.
const CARD: &str = "synthetic:testcard?size=512x256&fps=3";
const FRAME_RATE: f64 = 3.0;
/// Frames of one turn, after which the light comes again.
const TURN: usize = 24;
/// Frames watched: half a turn.
const WATCHED: usize = 12;
/// Blocks of the number, and where their middle row lies in the panorama: they take its lowest eighth.
const BLOCKS: usize = 32;
const BLOCKS_V: f32 = 15.0 / 16.0;
/// Straight down, so that the ring of blocks lies in the middle and the balls around it.
const PITCH_DEG: f32 = -90.0;
const FOV_Y_DEG: f32 = 120.0;
const SIZE: (u32, u32) = (320, 180);
/// Out of the way of each other's shade, and high above the ground.
const BALLS: [Vec3; 4] = [Vec3::new(2.2, -1.3, 0.0), Vec3::new(-2.2, -1.3, 0.0), Vec3::new(0.0, -1.3, 1.6), Vec3::new(0.0, -1.3, -1.6)];
const GROUND_Y: f32 = -50.0;

/// A line of `analyze --json`.
#[derive(Deserialize)]
struct Light {
    sh: Vec<Vec3>,
    lights: Vec<Directional>,
}

#[derive(Deserialize)]
struct Directional {
    direction: Vec3,
    irradiance: Vec3,
}

impl Light {
    /// What the middles of the balls send to the camera, up to one factor: Lambert's law.
    fn on_balls(&self) -> Vec<Vec3> {
        let ball = |at: &Vec3| {
            let normal = -at.normalize();
            let direct = self.lights.iter().map(|light| light.irradiance * normal.dot(light.direction).max(0.0));
            irradiance(&self.sh, normal) + direct.sum::<Vec3>()
        };
        BALLS.iter().map(ball).collect()
    }
}

#[test]
fn the_number_in_the_picture_is_that_of_its_light() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let expected: Vec<Vec<Vec3>> = lights(&sandbox)?.iter().map(Light::on_balls).collect();
    let balls: String = BALLS
        .iter()
        .map(|at| {
            let material = "{ base_color = [0.8, 0.8, 0.8], roughness = 1.0 }";
            format!("[[object]]\nshape = \"sphere\"\nposition = [{:?}, {:?}, {:?}]\nscale = 0.8\nmaterial = {material}\n", at.x, at.y, at.z)
        })
        .collect();
    std::fs::write(sandbox.path("scene.toml"), format!("ground_y = {GROUND_Y:?}\n{balls}"))?;
    let server = sandbox.serve(CARD, &["--listen", "127.0.0.1:0", "--scene", "scene.toml"])?;
    let (size, frames) = (format!("{}x{}", SIZE.0, SIZE.1), WATCHED.to_string());
    let (pitch, fov) = (PITCH_DEG.to_string(), FOV_Y_DEG.to_string());
    let mut arguments = vec!["--mode", "headless", "--size", &size, "--frames", &frames, "--pitch-deg", &pitch, "--fov-y-deg", &fov];
    arguments.extend(["--record", "view.mp4", "--stats", "view.csv"]);
    let mut viewer = sandbox.join("viewer", &server.join_url, &arguments)?;
    let status = viewer.wait_for_exit(LONG)?;
    ensure!(status.success(), "viewer ended with {status}:\n{}", viewer.output());

    let pictures = clips::pictures(&sandbox.path("view.mp4"), SIZE)?;
    let pts = Samples::load(&sandbox.path("view.csv"))?.column("pts_us")?.into_iter().collect::<Option<Vec<f64>>>();
    let pts = pts.context("a row without a picture")?;
    ensure!(pictures.len() == pts.len() && pts.len() == WATCHED, "{} pictures and {} rows", pictures.len(), pts.len());
    let first = number(&pictures[0])?;
    for (picture, at) in pictures.iter().zip(&pts) {
        let number = number(picture)?;
        let by_time = first + ((at - pts[0]) * FRAME_RATE / 1e6).round() as u64;
        ensure!(number == by_time, "the picture of {at} µs spells {number} and not {by_time}");
        let own = number as usize % TURN;
        let distances: Vec<f32> = expected.iter().map(|light| distance(&seen(picture), light)).collect();
        let nearest_other =
            distances.iter().enumerate().filter(|(at, _)| *at != own).map(|(_, distance)| *distance).fold(f32::MAX, f32::min);
        // The nearest others are those before and after.
        ensure!(2.0 * distances[own] < nearest_other, "picture {number} is not under the light of {own}: {distances:?}");
    }
    Ok(())
}

/// The light of every frame of a turn.
fn lights(sandbox: &Sandbox) -> Result<Vec<Light>> {
    let output = sandbox.server_command()?.args(["analyze", CARD, "--json", "--frames", &TURN.to_string()]).output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let lights: Vec<Light> = String::from_utf8(output.stdout)?.lines().map(serde_json::from_str).collect::<Result<_, _>>()?;
    ensure!(lights.len() == TURN, "{} lines", lights.len());
    Ok(lights)
}

fn camera() -> Camera {
    Camera::looking(0.0, PITCH_DEG.to_radians(), FOV_Y_DEG.to_radians())
}

/// The pixel that shows what lies in a direction.
fn pixel(direction: Vec3) -> (u32, u32) {
    let (width, height) = (SIZE.0 as f32, SIZE.1 as f32);
    let at = (camera().clip_from_view(width / height) * camera().view_from_world()).project_point3(direction);
    (((at.x * 0.5 + 0.5) * width) as u32, ((0.5 - at.y * 0.5) * height) as u32)
}

/// What the blocks spell.
fn number(picture: &RgbImage) -> Result<u64> {
    let row: Vec<u8> = (0..BLOCKS)
        .map(|block| {
            let (x, y) = pixel(direction_from_uv(Vec2::new((block as f32 + 0.5) / BLOCKS as f32, BLOCKS_V)));
            picture.get_pixel(x, y).0[1]
        })
        .collect();
    read_number(&row, BLOCKS, BLOCKS, 1).context("a row of one sample a block can be read")
}

/// Linear colours of the middles of the balls, each the mean of 5×5 pixels.
fn seen(picture: &RgbImage) -> Vec<Vec3> {
    let linear = |x, y| {
        let codes = Vec3::from_array(picture.get_pixel(x, y).0.map(f32::from)) / 255.0;
        decode_transfer(mr360_protocol::video::Transfer::Srgb, codes)
    };
    let ball = |at: &Vec3| {
        let (x, y) = pixel(*at);
        let patch = (0..25).map(|i| linear(x + i % 5 - 2, y + i / 5 - 2));
        patch.sum::<Vec3>() / 25.0
    };
    BALLS.iter().map(ball).collect()
}

/// How far colours are from `expected` times the factor that fits best, relative to their own size.
fn distance(colours: &[Vec3], expected: &[Vec3]) -> f32 {
    let sum = |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f32>();
    let factor = sum(colours, expected) / sum(expected, expected);
    let rest: Vec<Vec3> = colours.iter().zip(expected).map(|(a, b)| *a - *b * factor).collect();
    (sum(&rest, &rest) / sum(colours, colours)).sqrt()
}
