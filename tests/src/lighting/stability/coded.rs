//! Still scenes as a live stream brings them: sensor noise, 8-bit 4:2:0, H.264 at 8 Mbit/s, and the server's own decoder.

use std::f32::consts::{PI, TAU};
use std::path::{Path, PathBuf};

use anyhow::Result;
use glam::{DVec3, Vec2, Vec3};
use mr360_server::frame::Frame;
use mr360_server::ingest::{DecodeOptions, Source, decode_frames};
use mr360_server::lighting::sequences::SURFACES;
use mr360_shaders::colour::srgb_encode;
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};

use super::measures::{LUMA, Main, Shown};
use crate::clips;
use crate::sandbox::Sandbox;

/// Columns and rows.
const SIZE: (u32, u32) = (1920, 960);
/// Frames a second.
const RATE: u32 = 30;
/// Longitude to the right, latitude and radius of the sun, degrees.
const SUN: (f32, f32, f32) = (40.0, 50.0, 0.27);
/// Radiance of the sun's disc: with white on a bright cloud, a clear sky's sun gives level ground three times what the sky gives.
const SUN_RADIANCE: Vec3 = Vec3::new(5.2e4, 5.0e4, 4.5e4);
/// Radius within which its glare reaches white, degrees.
const GLARE_DEG: f32 = 2.5;
/// Sensor noise: variance of linear radiance, at black and for each unit of radiance. Two codes at mid grey, as of a small sensor in daylight.
const NOISE: (f32, f32) = (4e-6, 2e-4);

fn sun() -> Vec3 {
    direction_from_uv(Vec2::new(SUN.0 / 360.0 + 0.5, 0.5 - SUN.1 / 180.0))
}

/// What there is besides the sun: mean radiance. The ground's albedo is a quarter unless told otherwise.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weather {
    zenith: Vec3,
    horizon: f32,
    clouds: f32,
    ground: Vec3,
}

/// A blue sky with clouds well below white.
pub(super) const CLEAR: Weather =
    Weather { zenith: Vec3::new(0.14, 0.2, 0.32), horizon: 0.3, clouds: 0.6, ground: Vec3::new(0.28, 0.29, 0.2) };
/// Clouds that are near white without being the sun's.
pub(super) const BRIGHT: Weather =
    Weather { zenith: Vec3::new(0.22, 0.33, 0.52), horizon: 0.4, clouds: 0.85, ground: Vec3::new(0.32, 0.33, 0.24) };

/// The same over dark ground, of an albedo of a tenth: fresh asphalt, water, needle trees.
pub(super) const DARK: Weather = Weather { ground: Vec3::new(0.12, 0.13, 0.08), ..BRIGHT };

/// Radiance of the scene: a sky with clouds and a sun, and ground of fields.
fn radiance(weather: &Weather, d: Vec3) -> Vec3 {
    let waves = (5.0 * d.x + 2.0 * d.y).sin() * (7.0 * d.z - d.x).cos() + 0.5 * (23.0 * d.x + 3.0).sin() * (19.0 * d.z + 11.0 * d.y).cos();
    if d.y <= 0.0 {
        return weather.ground * (1.0 + 0.5 * waves);
    }
    let cloud = (1.6 * waves - 0.5).clamp(0.0, 1.0);
    let sky = weather.zenith.lerp(Vec3::splat(weather.horizon), 1.0 - d.y).lerp(Vec3::splat(weather.clouds), cloud);
    let off_deg = (2.0 * (0.5 * (d - sun()).length()).min(1.0).asin()).to_degrees();
    let glare = (GLARE_DEG / off_deg.max(SUN.2)).powi(2).min(20.0);
    sky + Vec3::new(1.0, 0.97, 0.9) * (glare - (GLARE_DEG / 25.0).powi(2)).max(0.0)
}

/// Every pixel's noiseless code, beyond 255 where it is brighter than white, and the noise's standard deviation in codes.
fn picture(weather: &Weather) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    let (width, height) = SIZE;
    let pixel = |i: u32| {
        let (x, y) = ((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
        let radiance = radiance(weather, direction_from_uv(Vec2::new(x / width as f32, y / height as f32))).to_array();
        let code = |value: f32| 255.0 * srgb_encode(value);
        let deviation = |value: f32| (NOISE.0 + NOISE.1 * value).sqrt() * (code(value + 5e-4) - code((value - 5e-4).max(0.0))) / 1e-3;
        (radiance.map(code), radiance.map(deviation))
    };
    (0..width * height).map(pixel).unzip()
}

/// Normal deviates, drawn from a table by a small generator (xorshift), so that every run sees the same noise.
struct Grain {
    table: Vec<f32>,
    state: u64,
}

impl Grain {
    fn new() -> Self {
        let mut grain = Self { table: Vec::new(), state: 0x9E37_79B9_7F4A_7C15 };
        // The sum of twelve even numbers in [0, 1) has a standard deviation of 1.
        let even = |state: u64| (state >> 40) as f32 / (1u64 << 24) as f32;
        grain.table = (0..1 << 16).map(|_| (0..12).map(|_| even(grain.next())).sum::<f32>() - 6.0).collect();
        grain
    }

    fn next(&mut self) -> u64 {
        self.state ^= self.state << 13;
        self.state ^= self.state >> 7;
        self.state ^= self.state << 17;
        self.state
    }

    fn three(&mut self) -> [f32; 3] {
        let bits = self.next();
        [16, 32, 48].map(|shift| self.table[(bits >> shift) as usize & 0xFFFF])
    }
}

/// Encodes `seconds` of the scene into the file `name` of the sandbox.
///
/// # Errors
/// When ffmpeg is missing or fails.
pub(super) fn encode(sandbox: &Sandbox, name: &str, weather: &Weather, seconds: u32) -> Result<PathBuf> {
    let (codes, deviations) = picture(weather);
    let mut grain = Grain::new();
    let frame = |_| {
        let pixels = codes.iter().zip(&deviations).flat_map(|(code, deviation)| {
            let noise = grain.three();
            [0, 1, 2].map(|channel| (code[channel] + deviation[channel] * noise[channel]).round().clamp(0.0, 255.0) as u8)
        });
        pixels.collect()
    };
    let h264 = "-vf scale=out_color_matrix=bt709:out_range=tv -pix_fmt yuv420p -colorspace bt709 -color_primaries bt709 -color_trc iec61966-2-1 \
                -c:v libx264 -preset veryfast -tune zerolatency -b:v 8M -maxrate 8M -bufsize 4M -bf 0 -g 30";
    clips::make_from(sandbox, name, SIZE, RATE, (0..seconds * RATE).map(frame), h264)
}

/// The frames of a file as the server decodes it, all eyes' views as its metadata say.
///
/// # Errors
/// When the file cannot be opened; while iterating, when it cannot be decoded.
pub(super) fn frames(path: &Path) -> Result<impl Iterator<Item = Result<Frame>>> {
    let decoded = decode_frames(&Source::File(path.to_owned()), DecodeOptions::default())?;
    Ok(decoded.map(|frame| Ok(frame?)))
}

/// What is true of the scene: the sun's disc is its main light.
pub(super) fn truth(weather: &Weather) -> Shown {
    // Sums over a quarter of the columns and rows; the disc, which is smaller than a pixel of those, in closed form.
    let (width, height) = (SIZE.0 / 4, SIZE.1 / 4);
    let strength = SUN_RADIANCE.as_dvec3() * f64::from(TAU * (1.0 - SUN.2.to_radians().cos()));
    let mut surfaces = SURFACES.map(|normal| strength * f64::from(sun().dot(normal).max(0.0)));
    let mut mean = DVec3::ZERO;
    for i in 0..width * height {
        let (x, y) = ((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
        let d = direction_from_uv(Vec2::new(x / width as f32, y / height as f32));
        let energy = (radiance(weather, d) * pixel_solid_angle_sr(i / width, width, height)).as_dvec3();
        mean += energy / f64::from(4.0 * PI);
        for (received, normal) in surfaces.iter_mut().zip(SURFACES) {
            *received += energy * f64::from(d.dot(normal).max(0.0));
        }
    }
    let direction = sun().as_dvec3();
    Shown { main: Some(Main { direction, strength: strength.dot(LUMA) }), lights: vec![(0, direction)], surfaces, ambient: mean.dot(LUMA) }
}
