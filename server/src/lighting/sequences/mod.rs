//! Synthetic panoramas over time whose light is known: what methods are held against, in tests and on charts.
//!
//! Discs of even radiance stand in a textured sky over a dark textured ground, unless a sequence says otherwise. Frames are 256×128, sRGB in 8 bits with seeded grain, or linear where a bound must
//! not depend on clipping. This module makes frames of scenes and says what is true of them; the sequences themselves are further down, by what
//! they vary.

use std::f32::consts::TAU;

use glam::{Quat, Vec2, Vec3};
use mr360_protocol::light::DirectionalLight;
use mr360_protocol::video::{StereoLayout, Transfer};
use mr360_shaders::colour::srgb_encode;
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};

use crate::frame::{Frame, Pixels};

mod camera;
mod lights;
mod scenery;

pub use camera::*;
pub use lights::*;
pub use scenery::*;

const WIDTH: u32 = 256;
const HEIGHT: u32 = 128;
/// Width of a texel at the horizon.
const TEXEL: f32 = TAU / WIDTH as f32;
/// Radiance of a sun: far above white, and the same in three channels up to a warm tint.
const SUN: Vec3 = Vec3::new(62.0, 60.0, 52.0);
/// Radiance of a lamp in linear sequences.
const LAMP: Vec3 = Vec3::new(8.0, 6.0, 4.0);
/// Mean radiance of the sky.
const SKY: Vec3 = Vec3::new(0.11, 0.12, 0.15);
/// Frames a second unless a sequence says otherwise.
const RATE: f64 = 30.0;

/// Surfaces whose irradiance is known: up, right, left, back, ahead, down.
pub const SURFACES: [Vec3; 6] = [Vec3::Y, Vec3::X, Vec3::NEG_X, Vec3::Z, Vec3::NEG_Z, Vec3::NEG_Y];

/// A disc of even radiance.
#[derive(Debug, Clone, Copy)]
struct Disc {
    centre: Vec3,
    radius: f32,
    radiance: Vec3,
}

impl Disc {
    fn at(longitude_deg: f32, latitude_deg: f32, radius_deg: f32, radiance: Vec3) -> Self {
        let centre = direction_from_uv(Vec2::new(longitude_deg / 360.0 + 0.5, 0.5 - latitude_deg / 180.0));
        Self { centre, radius: radius_deg.to_radians(), radiance }
    }

    fn solid_angle_sr(self) -> f32 {
        TAU * (1.0 - self.radius.cos())
    }
}

/// What there is to see at one time.
#[derive(Debug, Clone)]
struct Scene {
    /// Lights, the main one first.
    discs: Vec<Disc>,
    /// What stands before sky and ground and is no light.
    things: Vec<Disc>,
    sky: Vec3,
    ground: Vec3,
    /// Contrast of the texture of sky and ground.
    texture: f32,
    /// Which place: the texture of sky and ground.
    place: f32,
    /// Exposure of each channel.
    gain: Vec3,
    /// Turns the scene before the camera.
    turn: Quat,
}

impl Scene {
    fn new(discs: Vec<Disc>) -> Self {
        Self {
            discs,
            things: Vec::new(),
            sky: SKY,
            ground: Vec3::splat(0.02),
            texture: 0.25,
            place: 0.0,
            gain: Vec3::ONE,
            turn: Quat::IDENTITY,
        }
    }

    fn exposed(self, stops: Vec3) -> Self {
        Self { gain: stops.exp2(), ..self }
    }

    /// Radiance of sky or ground.
    fn background(&self, d: Vec3) -> Vec3 {
        let p = self.place;
        let waves = (5.0 * d.x + 2.0 * p).sin() * (7.0 * d.z - p).cos() + (9.0 * d.y + 3.0 * d.x + 5.0 * p).sin();
        let even = if d.y > 0.0 { self.sky } else { self.ground };
        even * (1.0 + self.texture * waves)
    }

    fn radiance(&self, d: Vec3) -> Vec3 {
        let d = self.turn.inverse() * d;
        let mut radiance = self.background(d);
        for disc in self.things.iter().chain(&self.discs) {
            let off = 2.0 * (0.5 * (d - disc.centre).length()).min(1.0).asin();
            let covered = ((disc.radius - off) / TEXEL + 0.5).clamp(0.0, 1.0);
            radiance = radiance.lerp(disc.radiance, covered);
        }
        radiance * self.gain
    }

    fn truth(&self, irradiance: [Vec3; 6]) -> Truth {
        let lights = self.discs.iter().zip(0..).map(|(disc, id)| DirectionalLight {
            id,
            direction: self.turn * disc.centre,
            irradiance: disc.radiance * disc.solid_angle_sr() * self.gain,
            solid_angle_sr: disc.solid_angle_sr(),
        });
        Truth { lights: lights.collect(), ambient: (self.sky + self.ground) * 0.5 * self.gain, gain: self.gain, irradiance }
    }
}

/// What is true of a frame, in its own exposure and before clipping.
#[derive(Debug, Clone)]
pub struct Truth {
    /// The discs, the main light first, which need not be the strongest; `id` says which disc of the sequence.
    pub lights: Vec<DirectionalLight>,
    /// Mean radiance of sky and ground, up to their texture.
    pub ambient: Vec3,
    /// Exposure of each channel, 1 at the beginning of most sequences.
    pub gain: Vec3,
    /// What [`SURFACES`] receive of everything, by the sum over the frame's texels.
    pub irradiance: [Vec3; 6],
}

/// A frame and the truth about it.
pub struct Shot {
    /// The frame, as a decoder would give it.
    pub frame: Frame,
    /// Its light.
    pub truth: Truth,
}

/// What a sequence varies, where that has a figure of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Varies {
    /// Light that beats with the mains: judged by the ripple that is left.
    Beat,
    /// Exposure alone: judged by the ratio of light to ambient, which stays.
    Exposure,
    /// Anything else.
    Else,
}

/// One sequence.
pub struct Sequence {
    /// Its name, for tests and charts.
    pub name: &'static str,
    /// What it varies.
    pub varies: Varies,
    /// When its light changes at once, seconds.
    pub steps_s: &'static [f32],
    transfer: Transfer,
    /// Presentation times of the frames.
    times_us: Vec<u64>,
    /// Standard deviation of the grain, in 8-bit steps.
    grain: f32,
    scene: Box<dyn Fn(f32) -> Scene + Send>,
    /// The frame that is full of numbers that no picture holds.
    faulty: Option<usize>,
}

impl Sequence {
    fn new(name: &'static str, seconds: f32, scene: impl Fn(f32) -> Scene + Send + 'static) -> Self {
        Self {
            name,
            varies: Varies::Else,
            steps_s: &[],
            transfer: Transfer::Srgb,
            times_us: times_us(seconds, RATE),
            grain: 1.0,
            scene: Box::new(scene),
            faulty: None,
        }
    }

    /// The same at another number of frames a second.
    fn paced(self, seconds: f32, rate: f64) -> Self {
        Self { times_us: times_us(seconds, rate), ..self }
    }

    fn varying(self, varies: Varies) -> Self {
        Self { varies, ..self }
    }

    /// The same, and its light changes at once at these times.
    fn stepping(self, steps_s: &'static [f32]) -> Self {
        Self { steps_s, ..self }
    }

    fn grained(self, grain: f32) -> Self {
        Self { grain, ..self }
    }

    /// The same in linear radiance, without clipping.
    fn linear(self) -> Self {
        Self { transfer: Transfer::Linear, ..self }
    }

    /// One frame in `step` of the same.
    #[cfg(test)]
    pub(super) fn thinned(self, step: usize) -> Self {
        let times_us = self.times_us.iter().copied().step_by(step).collect();
        Self { times_us, faulty: self.faulty.map(|index| index / step), ..self }
    }

    /// The frames, one after the other.
    pub fn shots(&self) -> impl Iterator<Item = Shot> + '_ {
        let mut noise = Noise(0x9E37_79B9_7F4A_7C15);
        self.times_us.iter().enumerate().map(move |(index, pts_us)| {
            let scene = (self.scene)(*pts_us as f32 * 1e-6);
            let mut irradiance = [Vec3::ZERO; 6];
            let mut texels: Vec<[f32; 3]> = (0..WIDTH * HEIGHT)
                .map(|texel| {
                    let (x, y) = ((texel % WIDTH) as f32 + 0.5, (texel / WIDTH) as f32 + 0.5);
                    let direction = direction_from_uv(Vec2::new(x / WIDTH as f32, y / HEIGHT as f32));
                    let radiance = scene.radiance(direction);
                    let energy = radiance * pixel_solid_angle_sr(texel / WIDTH, WIDTH, HEIGHT);
                    for (received, normal) in irradiance.iter_mut().zip(SURFACES) {
                        *received += energy * direction.dot(normal).max(0.0);
                    }
                    radiance.to_array().map(|value| self.code(value, &mut noise))
                })
                .collect();
            if self.faulty == Some(index) {
                let wrong = [f32::NAN, f32::NEG_INFINITY, f32::INFINITY, -0.5, 1e30];
                texels.iter_mut().step_by(97).zip(wrong.iter().cycle()).for_each(|(texel, wrong)| texel[index % 3] = *wrong);
            }
            let pixels = Pixels::Rgb { width: WIDTH, height: HEIGHT, texels, transfer: self.transfer };
            Shot { frame: Frame { pts_us: *pts_us, stereo: StereoLayout::Mono, pixels }, truth: scene.truth(irradiance) }
        })
    }

    /// What the camera makes of a radiance.
    fn code(&self, radiance: f32, noise: &mut Noise) -> f32 {
        // The sum of three even numbers has a standard deviation of one half.
        let grain = 2.0 * self.grain * (noise.next() + noise.next() + noise.next() - 1.5);
        if self.transfer == Transfer::Linear {
            return radiance * (1.0 + grain / 100.0);
        }
        (srgb_encode(radiance.min(1.0)) * 255.0 + grain).round().clamp(0.0, 255.0) / 255.0
    }
}

/// Presentation times.
fn times_us(seconds: f32, rate: f64) -> Vec<u64> {
    let frames = (f64::from(seconds) * rate).round() as u64;
    (0..frames).map(|frame| (frame as f64 * 1e6 / rate) as u64).collect()
}

/// A small deterministic generator (xorshift), so that every run sees the same grain. Values in [0, 1).
pub(super) struct Noise(pub(super) u64);

impl Noise {
    pub(super) fn next(&mut self) -> f32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
    }
}

fn sun(longitude_deg: f32, latitude_deg: f32) -> Disc {
    Disc::at(longitude_deg, latitude_deg, 4.0, SUN)
}

/// All sequences.
#[must_use]
pub fn all() -> Vec<Sequence> {
    vec![
        still(),
        exposure_ramp(false),
        exposure_ramp(true),
        exposure_seen(false),
        exposure_seen(true),
        white_balance_jump(),
        lamp_beat(),
        lamp_beat_60(),
        slow_beat(),
        one_lamp_beats(),
        scene_cut(),
        over_the_seam(),
        over_the_zenith(),
        behind_a_cloud(),
        lamp_switched(),
        merge_and_split(),
        crossing(),
        clipped_share(),
        clipped_clouds(),
        clipped_speck(),
        overcast(),
        even_overcast(),
        window_with_bounce(),
        wet_ground(),
        people(),
        shake(),
        faulty_frame(),
        uneven_pace(),
    ]
}
