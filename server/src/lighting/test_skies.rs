//! Panoramas whose light is known in closed form, and what an estimate makes of them.

use std::f32::consts::PI;

use glam::{DVec3, Vec2, Vec3};
use mr360_protocol::video::{StereoLayout, Transfer};
use mr360_shaders::equirect::direction_from_uv;
use mr360_shaders::sh;

use super::{Estimate, LightMethod, StepTimes};
use crate::frame::{Frame, Pixels};

pub(super) const WIDTH: u32 = 1024;
pub(super) const HEIGHT: u32 = 512;

/// A disc of even radiance.
#[derive(Debug, Clone, Copy)]
pub(super) struct Disc {
    pub(super) centre: Vec3,
    pub(super) radius: f32,
    pub(super) radiance: Vec3,
}

impl Disc {
    /// Angles in degrees.
    pub(super) fn at(longitude: f32, latitude: f32, radius: f32, radiance: Vec3) -> Self {
        let centre = direction_from_uv(Vec2::new(longitude / 360.0 + 0.5, 0.5 - latitude / 180.0));
        Self { centre, radius: radius.to_radians(), radiance }
    }

    /// Radiance times solid angle.
    pub(super) fn energy(self) -> Vec3 {
        self.radiance * self.solid_angle_sr()
    }

    pub(super) fn solid_angle_sr(self) -> f32 {
        2.0 * PI * (1.0 - self.radius.cos())
    }
}

/// Discs over an even background; a pixel near a disc is the average of 4×64 points, as a rim at the zenith runs along rows.
pub(super) fn sky(transfer: Transfer, background: Vec3, discs: &[Disc]) -> Frame {
    let direction = |x: f32, y: f32| direction_from_uv(Vec2::new(x / WIDTH as f32, y / HEIGHT as f32));
    let texels = (0..HEIGHT).flat_map(|j| (0..WIDTH).map(move |i| (i as f32, j as f32))).map(|(i, j)| {
        let centre = direction(i + 0.5, j + 0.5);
        let Some(disc) = discs.iter().find(|disc| (centre - disc.centre).length() < disc.radius + 0.01) else {
            return background.to_array();
        };
        let points = (0..256).map(|k| direction(i + ((k % 4) as f32 + 0.5) / 4.0, j + ((k / 4) as f32 + 0.5) / 64.0));
        let inside = points.filter(|d| (*d - disc.centre).length() < 2.0 * (disc.radius / 2.0).sin()).count();
        background.lerp(disc.radiance, inside as f32 / 256.0).to_array()
    });
    frame(WIDTH, HEIGHT, transfer, texels.collect())
}

pub(super) fn frame(width: u32, height: u32, transfer: Transfer, texels: Vec<[f32; 3]>) -> Frame {
    Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Rgb { width, height, texels, transfer } }
}

/// The estimate of a frame, checked for what holds of every estimate.
pub(super) fn estimate_with(method: &mut dyn LightMethod, frame: &Frame) -> Estimate {
    let estimate = method.estimate(frame, &mut StepTimes::default()).unwrap().clone();
    let name = method.name();
    assert!(matches!(estimate.sh.len(), 9 | 25) && estimate.sh.iter().all(|c| c.is_finite()), "{name}: {:?}", estimate.sh);
    assert!(estimate.lights.len() <= mr360_protocol::light::MAX_LIGHTS, "{name}");
    for light in &estimate.lights {
        assert!(light.irradiance.is_finite() && light.irradiance.min_element() >= 0.0, "{name}: {light:?}");
        assert!((light.direction.length() - 1.0).abs() < 1e-4, "{name}: {light:?}");
        assert!(light.solid_angle_sr > 0.0 && light.solid_angle_sr < 4.0 * PI + 0.01, "{name}: {light:?}");
    }
    estimate
}

/// Irradiance of lights and SH on a surface.
pub(super) fn irradiance(estimate: &Estimate, normal: Vec3) -> Vec3 {
    let direct: Vec3 = estimate.lights.iter().map(|light| light.irradiance * light.direction.dot(normal).max(0.0)).sum();
    direct + sh::irradiance(&estimate.sh, normal)
}

/// Energy over the whole sphere: the lights' irradiance and the SH's mean times 4π.
pub(super) fn energy(estimate: &Estimate) -> DVec3 {
    let lights: DVec3 = estimate.lights.iter().map(|light| light.irradiance.as_dvec3()).sum();
    lights + estimate.sh[0].as_dvec3() * (4.0 * std::f64::consts::PI).sqrt()
}

/// Directions spread evenly over the sphere: a Fibonacci lattice.
pub(super) fn normals(count: u32) -> impl Iterator<Item = Vec3> {
    let golden = PI * (3.0 - 5f32.sqrt());
    (0..count).map(move |i| {
        let y = 1.0 - (i as f32 + 0.5) * 2.0 / count as f32;
        let (sin, cos) = (i as f32 * golden).sin_cos();
        Vec3::new((1.0 - y * y).sqrt() * sin, y, (1.0 - y * y).sqrt() * cos)
    })
}
