//! Synthetic panoramas over time whose light is known: what methods are held against, in tests and on charts.
//!
//! Discs of even radiance stand in a textured sky over a dark textured ground, which gives a method that recovers clipped light from the
//! ground nothing to recover; one sequence has bright ground. Frames are 256×128, sRGB in 8 bits with seeded grain, or linear where a bound must
//! not depend on clipping.

use std::f32::consts::{PI, TAU};

use glam::{Quat, Vec2, Vec3};
use mr360_protocol::light::DirectionalLight;
use mr360_protocol::video::{StereoLayout, Transfer};
use mr360_shaders::colour::srgb_encode;
use mr360_shaders::equirect::direction_from_uv;

use crate::frame::{Frame, Pixels};

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
    discs: Vec<Disc>,
    sky: Vec3,
    ground: Vec3,
    /// Which place: the texture of sky and ground.
    place: f32,
    /// Exposure of each channel.
    gain: Vec3,
    /// Turns the scene before the camera.
    turn: Quat,
}

impl Scene {
    fn new(discs: Vec<Disc>) -> Self {
        Self { discs, sky: SKY, ground: Vec3::splat(0.02), place: 0.0, gain: Vec3::ONE, turn: Quat::IDENTITY }
    }

    fn exposed(self, stops: Vec3) -> Self {
        Self { gain: stops.exp2(), ..self }
    }

    /// Radiance of sky or ground.
    fn background(&self, d: Vec3) -> Vec3 {
        let p = self.place;
        let waves = (5.0 * d.x + 2.0 * p).sin() * (7.0 * d.z - p).cos() + (9.0 * d.y + 3.0 * d.x + 5.0 * p).sin();
        let even = if d.y > 0.0 { self.sky } else { self.ground };
        even * (1.0 + 0.25 * waves)
    }

    fn radiance(&self, d: Vec3) -> Vec3 {
        let d = self.turn.inverse() * d;
        let mut radiance = self.background(d);
        for disc in &self.discs {
            let off = 2.0 * (0.5 * (d - disc.centre).length()).min(1.0).asin();
            let covered = ((disc.radius - off) / TEXEL + 0.5).clamp(0.0, 1.0);
            radiance = radiance.lerp(disc.radiance, covered);
        }
        radiance * self.gain
    }

    fn truth(&self) -> Truth {
        let lights = self.discs.iter().zip(0..).map(|(disc, id)| DirectionalLight {
            id,
            direction: self.turn * disc.centre,
            irradiance: disc.radiance * disc.solid_angle_sr() * self.gain,
            solid_angle_sr: disc.solid_angle_sr(),
        });
        Truth { lights: lights.collect(), ambient: (self.sky + self.ground) * 0.5 * self.gain, gain: self.gain }
    }
}

/// What is true of a frame, in its own exposure and before clipping.
#[derive(Debug, Clone)]
pub struct Truth {
    /// The discs; `id` says which disc of the sequence.
    pub lights: Vec<DirectionalLight>,
    /// Mean radiance of sky and ground, up to their texture.
    pub ambient: Vec3,
    /// Exposure of each channel, 1 at the beginning of most sequences.
    pub gain: Vec3,
}

/// A frame and the truth about it.
pub struct Shot {
    /// The frame, as a decoder would give it.
    pub frame: Frame,
    /// Its light.
    pub truth: Truth,
}

/// One sequence.
pub struct Sequence {
    /// Its name, for tests and charts.
    pub name: &'static str,
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
        let frames = (seconds * 30.0).round() as u64;
        let times_us = (0..frames).map(|frame| frame * 1_000_000 / 30).collect();
        Self { name, transfer: Transfer::Srgb, times_us, grain: 1.0, scene: Box::new(scene), faulty: None }
    }

    /// The same in linear radiance, without clipping.
    fn linear(self) -> Self {
        Self { transfer: Transfer::Linear, ..self }
    }

    /// The frames, one after the other.
    pub fn shots(&self) -> impl Iterator<Item = Shot> + '_ {
        let mut noise = Noise(0x9E37_79B9_7F4A_7C15);
        self.times_us.iter().enumerate().map(move |(index, pts_us)| {
            let scene = (self.scene)(*pts_us as f32 * 1e-6);
            let mut texels: Vec<[f32; 3]> = (0..WIDTH * HEIGHT)
                .map(|texel| {
                    let (x, y) = ((texel % WIDTH) as f32 + 0.5, (texel / WIDTH) as f32 + 0.5);
                    let radiance = scene.radiance(direction_from_uv(Vec2::new(x / WIDTH as f32, y / HEIGHT as f32)));
                    radiance.to_array().map(|value| self.code(value, &mut noise))
                })
                .collect();
            if self.faulty == Some(index) {
                let wrong = [f32::NAN, f32::NEG_INFINITY, f32::INFINITY, -0.5, 1e30];
                texels.iter_mut().step_by(97).zip(wrong.iter().cycle()).for_each(|(texel, wrong)| texel[index % 3] = *wrong);
            }
            let pixels = Pixels::Rgb { width: WIDTH, height: HEIGHT, texels, transfer: self.transfer };
            Shot { frame: Frame { pts_us: *pts_us, stereo: StereoLayout::Mono, pixels }, truth: scene.truth() }
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
    if linear { Sequence::new("exposure ramp, linear", 7.0, scene).linear() } else { Sequence::new("exposure ramp", 7.0, scene) }
}

/// After two seconds the white balance goes to a warmer light at once.
#[must_use]
pub fn white_balance_jump() -> Sequence {
    Sequence::new("white balance jump", 4.0, |time| {
        let stops = if time < 2.0 { Vec3::ZERO } else { Vec3::new(-0.3, 0.0, 0.5) };
        Scene::new(vec![sun(40.0, 50.0)]).exposed(stops)
    })
}

/// All light is from lamps on 50 Hz mains, bright a hundred times a second: 10 Hz at 30 frames a second.
#[must_use]
pub fn lamp_beat() -> Sequence {
    Sequence::new("lamp beat", 5.0, |time| {
        let beat = 0.2 * (TAU * 100.0 * time + 0.4).sin();
        Scene::new(vec![Disc { radiance: LAMP, ..sun(40.0, 50.0) }]).exposed(Vec3::splat((1.0 + beat).log2()))
    })
}

/// Two seconds here, two there, and back.
#[must_use]
pub fn scene_cut() -> Sequence {
    Sequence::new("scene cut", 6.0, |time| {
        let there = (2.0..4.0).contains(&time);
        let scene = Scene::new(vec![if there { sun(-120.0, 25.0) } else { sun(40.0, 50.0) }]);
        Scene { place: if there { 1.7 } else { 0.0 }, ..scene }
    })
}

/// A sun that crosses the panorama's left and right edge at 10° a second.
#[must_use]
pub fn over_the_seam() -> Sequence {
    Sequence::new("over the seam", 4.0, |time| Scene::new(vec![sun(160.0 + 10.0 * time, 35.0)]))
}

/// A sun that crosses the zenith at 10° a second, slightly beside it.
#[must_use]
pub fn over_the_zenith() -> Sequence {
    Sequence::new("over the zenith", 6.0, |time| {
        let disc = sun(30.0, 60.0);
        let axis = disc.centre.cross(Vec3::Y).normalize();
        let centre = Quat::from_axis_angle(axis, 10f32.to_radians() * time) * disc.centre;
        Scene::new(vec![Disc { centre: Quat::from_rotation_z(0.01) * centre, ..disc }])
    })
}

/// A cloud draws over the sun within a second, and away again.
#[must_use]
pub fn behind_a_cloud() -> Sequence {
    Sequence::new("behind a cloud", 7.0, |time| {
        let covered = (time - 1.5).clamp(0.0, 1.0) - (time - 4.0).clamp(0.0, 1.0);
        Scene::new(vec![Disc { radiance: SUN * (SKY / SUN).powf(covered), ..sun(40.0, 50.0) }])
    })
}

/// A lamp doubles after a second, goes out after two and comes back after three.
#[must_use]
pub fn lamp_switched() -> Sequence {
    Sequence::new("lamp switched", 4.0, |time| {
        let level = [1.0, 2.0, 0.02, 1.0][(time as usize).min(3)];
        Scene::new(vec![Disc { radiance: LAMP * level, ..sun(40.0, 50.0) }])
    })
    .linear()
}

/// Two lamps run into one and come apart again.
#[must_use]
pub fn merge_and_split() -> Sequence {
    Sequence::new("merge and split", 6.0, |time| {
        let half = 4.0 * (time - 3.0).abs();
        Scene::new(vec![Disc::at(-half - 2.0, 30.0, 4.0, LAMP), Disc::at(half + 2.0, 30.0, 3.5, LAMP)])
    })
    .linear()
}

/// Two lamps pass each other at 20° a second.
#[must_use]
pub fn crossing() -> Sequence {
    Sequence::new("crossing", 4.0, |time| {
        let along = 10.0 * (time - 2.0);
        Scene::new(vec![Disc::at(along, 33.0, 5.0, LAMP), Disc::at(-along, 28.0, 3.5, LAMP)])
    })
    .linear()
}

/// A clipped sky grows from 0.05 to 0.6 of the upper hemisphere.
#[must_use]
pub fn clipped_share() -> Sequence {
    Sequence::new("clipped share", 4.0, |time| {
        let share = 0.05 + 0.55 * time / 4.0;
        let radius = (1.0 - share).acos();
        let disc = Disc { centre: Vec3::Y, radius, radiance: Vec3::splat(3.0) };
        Scene { sky: Vec3::splat(0.08), ..Scene::new(vec![disc]) }
    })
}

/// A lamp whose middle wavers about white over bright ground: now and then a pixel or two of it are clipped.
#[must_use]
pub fn clipped_speck() -> Sequence {
    let sequence = Sequence::new("clipped speck", 4.0, |time| {
        let radiance = Vec3::splat(0.92 + 0.07 * (TAU * 1.1 * time).sin());
        Scene { ground: Vec3::splat(0.3), ..Scene::new(vec![Disc::at(40.0, 50.0, 1.0, radiance)]) }
    });
    Sequence { grain: 2.0, ..sequence }
}

/// A sky without a sun, coarse grain.
#[must_use]
pub fn overcast() -> Sequence {
    let sequence = Sequence::new("overcast", 4.0, |_| Scene { sky: Vec3::splat(0.35), ..Scene::new(Vec::new()) });
    Sequence { grain: 4.0, ..sequence }
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

/// All sequences.
#[must_use]
pub fn all() -> Vec<Sequence> {
    vec![
        still(),
        exposure_ramp(false),
        exposure_ramp(true),
        white_balance_jump(),
        lamp_beat(),
        scene_cut(),
        over_the_seam(),
        over_the_zenith(),
        behind_a_cloud(),
        lamp_switched(),
        merge_and_split(),
        crossing(),
        clipped_share(),
        clipped_speck(),
        overcast(),
        shake(),
        faulty_frame(),
        uneven_pace(),
    ]
}
