//! MR360 (Rhee et al. 2017, Sections 3.2 and 4) straight from its equations: what other implementations are compared with in speed.
//!
//! Written to be read beside the paper: double precision, one function a step, nothing kept from frame to frame, a power and an angle
//! wherever an equation has one. It wastes nothing on purpose either: every step passes over its pixels once.

use std::collections::VecDeque;
use std::f64::consts::{PI, TAU};

use glam::{DVec3, Vec3};
use mr360_protocol::light::{DirectionalLight, Lift, SH9};

use super::score::Light;

/// Name in tables.
pub(super) const NAME: &str = "plain mr360";
/// Section 4.1: the fewest lights that hold this share of all detected irradiance are kept.
const KEPT_SHARE: f64 = 0.9;
/// Section 6.3: solid angles between which the brightness of lights changes, and the factors there, which the paper does not give: those
/// of `mr360`.
const SIZE_RANGE_SR: (f64, f64) = (0.1, 0.6);
const SIZE_FACTOR: (f64, f64) = (1.5, 0.5);

/// A picture of linear or coded R, G and B, row by row.
struct Picture {
    width: usize,
    height: usize,
    pixels: Vec<DVec3>,
}

/// The light of a frame of 8-bit codes, `width` columns wide, on a working map of `working_width` columns and half as many rows.
pub(super) fn estimate(codes: &[[u8; 3]], width: usize, working_width: usize) -> Light {
    let small = resample(codes, width, working_width, working_width / 2);
    let mut radiance = inverse_tone_map(&small);
    let upper = radiance.height / 2;
    let luminances: Vec<f64> = radiance.pixels[..radiance.width * upper].iter().map(|pixel| luminance(*pixel)).collect();
    let blurred = box_blur(&luminances, radiance.width, upper);
    let threshold = statistical_threshold(&blurred);
    let mask: Vec<bool> = blurred.iter().map(|y| *y > threshold).collect();
    let patches = breadth_first_search(mask, radiance.width, upper);
    let mut lights: Vec<(Patch, Vec<usize>)> = patches
        .into_iter()
        .map(|pixels| (Patch::of(&radiance, &pixels, threshold), pixels))
        .filter(|(patch, _)| patch.strength > 0.0)
        .collect();
    keep_strongest(&mut lights);
    for (_, pixels) in &lights {
        clamp(&mut radiance, pixels, threshold);
    }
    let sh = spherical_harmonics(&radiance);
    let lights = lights.iter().zip(0..).map(|((patch, _), id)| patch.light(id)).collect();
    Light { lift: Lift::InverseToneMap, sh, lights }
}

/// Bilinear resampling of the codes, as values from 0 to 1.
fn resample(codes: &[[u8; 3]], width: usize, to_width: usize, to_height: usize) -> Picture {
    let height = codes.len() / width;
    let code = |column: usize, row: usize| DVec3::from_array(codes[row * width + column].map(f64::from)) / 255.0;
    let mut pixels = Vec::with_capacity(to_width * to_height);
    for row in 0..to_height {
        let y = ((row as f64 + 0.5) / to_height as f64 * height as f64 - 0.5).clamp(0.0, (height - 1) as f64);
        let (top, bottom) = (y as usize, (y as usize + 1).min(height - 1));
        for column in 0..to_width {
            let x = ((column as f64 + 0.5) / to_width as f64 * width as f64 - 0.5).clamp(0.0, (width - 1) as f64);
            let (left, right) = (x as usize, (x as usize + 1).min(width - 1));
            let above = code(left, top).lerp(code(right, top), x.fract());
            let below = code(left, bottom).lerp(code(right, bottom), x.fract());
            pixels.push(above.lerp(below, y.fract()));
        }
    }
    Picture { width: to_width, height: to_height, pixels }
}

/// Eq. 1 and 2: `k · RGB` with `k = 10 Y¹⁰ + 1.8`.
fn inverse_tone_map(picture: &Picture) -> Picture {
    let lifted = picture.pixels.iter().map(|pixel| *pixel * (10.0 * luminance(*pixel).powf(10.0) + 1.8)).collect();
    Picture { pixels: lifted, ..*picture }
}

/// Eq. 3.
fn luminance(rgb: DVec3) -> f64 {
    0.3 * rgb.x + 0.59 * rgb.y + 0.11 * rgb.z
}

/// Section 4.1: "a small box blur", 3×3, of those of the neighbours that there are.
fn box_blur(values: &[f64], width: usize, height: usize) -> Vec<f64> {
    let mut blurred = Vec::with_capacity(values.len());
    for row in 0..height {
        for column in 0..width {
            let (mut sum, mut count) = (0.0, 0.0);
            for y in row.saturating_sub(1)..(row + 2).min(height) {
                for x in column.saturating_sub(1)..(column + 2).min(width) {
                    sum += values[y * width + x];
                    count += 1.0;
                }
            }
            blurred.push(sum / count);
        }
    }
    blurred
}

/// Eq. 6: μ + 2σ; a little above the mean at least, so that rounding in an even picture makes no light.
fn statistical_threshold(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64;
    (mean + 2.0 * variance.sqrt()).max(1.001 * mean)
}

/// Section 4.1: the patches of the mask, neighbours at the corners included.
fn breadth_first_search(mut mask: Vec<bool>, width: usize, height: usize) -> Vec<Vec<usize>> {
    let mut patches = Vec::new();
    for seed in 0..mask.len() {
        if !mask[seed] {
            continue;
        }
        mask[seed] = false;
        let (mut patch, mut queue) = (Vec::new(), VecDeque::from([seed]));
        while let Some(pixel) = queue.pop_front() {
            patch.push(pixel);
            let (row, column) = (pixel / width, pixel % width);
            for y in row.saturating_sub(1)..(row + 2).min(height) {
                for x in column.saturating_sub(1)..(column + 2).min(width) {
                    if std::mem::take(&mut mask[y * width + x]) {
                        queue.push_back(y * width + x);
                    }
                }
            }
        }
        patches.push(patch);
    }
    patches
}

/// Longitude and latitude of a pixel's centre.
fn angles(picture: &Picture, pixel: usize) -> (f64, f64) {
    let (row, column) = (pixel / picture.width, pixel % picture.width);
    let longitude = ((column as f64 + 0.5) / picture.width as f64 - 0.5) * TAU;
    (longitude, (0.5 - (row as f64 + 0.5) / picture.height as f64) * PI)
}

fn direction((longitude, latitude): (f64, f64)) -> DVec3 {
    DVec3::new(latitude.cos() * longitude.sin(), latitude.sin(), -latitude.cos() * longitude.cos())
}

/// Ω of a pixel.
fn solid_angle(picture: &Picture, latitude: f64) -> f64 {
    TAU / picture.width as f64 * PI / picture.height as f64 * latitude.cos()
}

/// A patch's light.
struct Patch {
    irradiance: DVec3,
    strength: f64,
    angles: (f64, f64),
    solid_angle_sr: f64,
}

impl Patch {
    /// Eq. 4 and 5.
    fn of(radiance: &Picture, pixels: &[usize], threshold: f64) -> Self {
        let mut patch = Self { irradiance: DVec3::ZERO, strength: 0.0, angles: (0.0, 0.0), solid_angle_sr: 0.0 };
        for pixel in pixels {
            let (longitude, latitude) = angles(radiance, *pixel);
            let (colour, solid_angle_sr) = (radiance.pixels[*pixel], solid_angle(radiance, latitude));
            let excess = solid_angle_sr * (colour - colour * f64::min(1.0, threshold / luminance(colour)));
            let strength = luminance(excess);
            patch.irradiance += excess;
            patch.strength += strength;
            patch.angles.0 += strength * longitude;
            patch.angles.1 += strength * latitude;
            patch.solid_angle_sr += solid_angle_sr;
        }
        patch.angles = (patch.angles.0 / patch.strength, patch.angles.1 / patch.strength);
        patch
    }

    /// Brighter where it is small, Section 4.1.
    fn light(&self, id: u32) -> DirectionalLight {
        let position = ((self.solid_angle_sr - SIZE_RANGE_SR.0) / (SIZE_RANGE_SR.1 - SIZE_RANGE_SR.0)).clamp(0.0, 1.0);
        let factor = SIZE_FACTOR.0 + (SIZE_FACTOR.1 - SIZE_FACTOR.0) * position;
        DirectionalLight {
            id,
            direction: direction(self.angles).as_vec3(),
            irradiance: (self.irradiance * factor).as_vec3(),
            solid_angle_sr: self.solid_angle_sr as f32,
        }
    }
}

/// Section 4.1: strongest first, and no more than hold [`KEPT_SHARE`].
fn keep_strongest(lights: &mut Vec<(Patch, Vec<usize>)>) {
    lights.sort_by(|a, b| b.0.strength.total_cmp(&a.0.strength));
    let goal = KEPT_SHARE * lights.iter().map(|(patch, _)| patch.strength).sum::<f64>();
    let mut held = 0.0;
    lights.retain(|(patch, _)| {
        let short = held < goal;
        held += patch.strength;
        short
    });
}

/// Section 4.1: "clamp the radiance map to the threshold luminance in order to ensure energy conservation".
fn clamp(radiance: &mut Picture, pixels: &[usize], threshold: f64) {
    for pixel in pixels {
        let colour = radiance.pixels[*pixel];
        radiance.pixels[*pixel] = colour * f64::min(1.0, threshold / luminance(colour));
    }
}

/// The diffuse light of what is left: real SH of bands 0 to 2, the basis evaluated at every pixel.
fn spherical_harmonics(radiance: &Picture) -> Vec<Vec3> {
    let mut sums = [DVec3::ZERO; SH9];
    for (pixel, colour) in radiance.pixels.iter().enumerate() {
        let angles = angles(radiance, pixel);
        let DVec3 { x, y, z } = direction(angles);
        let basis = [
            0.282_095,
            0.488_603 * y,
            0.488_603 * z,
            0.488_603 * x,
            1.092_548 * x * y,
            1.092_548 * y * z,
            0.315_392 * (3.0 * z * z - 1.0),
            1.092_548 * x * z,
            0.546_274 * (x * x - y * y),
        ];
        let energy = *colour * solid_angle(radiance, angles.1);
        for (sum, value) in sums.iter_mut().zip(basis) {
            *sum += energy * value;
        }
    }
    sums.map(|sum| sum.as_vec3()).to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::exposure::{Exposure, code};
    use crate::lighting::irradiance::Normals;
    use crate::lighting::radiance_map::RadianceMap;
    use mr360_server::lighting::{LightMethod, Mr360, StepTimes};

    fn codes(map: &RadianceMap) -> Vec<[u8; 3]> {
        map.texels().iter().map(|texel| texel.to_array().map(code)).collect()
    }

    #[test]
    fn an_even_frame_is_lifted_by_the_equations_and_has_no_light() {
        let grey = RadianceMap::of(32, |_| Vec3::splat(mr360_shaders::colour::srgb_decode(0.8)));
        let light = estimate(&codes(&grey), grey.width, 64);
        // 0.8 (10 · 0.8¹⁰ + 1.8); midpoints of 32 rows are off by 0.05 %.
        let mean = light.sh[0] / (4.0 * std::f32::consts::PI).sqrt();
        assert!((mean / 2.299 - 1.0).abs().max_element() < 2e-3 && light.lights.is_empty(), "{mean} {:?}", light.lights);
    }

    #[test]
    fn a_bright_disc_is_one_light_in_its_place() {
        let to_light = Vec3::new(0.4, 0.5, -0.6).normalize();
        let map = RadianceMap::of(128, |direction| Vec3::splat(if direction.dot(to_light) > 0.98 { 1.0 } else { 0.1 }));
        let light = estimate(&codes(&map), map.width, 256);
        let [only] = light.lights.as_slice() else { panic!("{:?}", light.lights) };
        // The disc is 11.5° wide: the mean of angles is off by a few tenths.
        assert!(only.direction.angle_between(to_light).to_degrees() < 1.0, "{}", only.direction);
        // 2π (1 − 0.98), and a rim of one pixel, 1.4° wide, from the blur.
        assert!((only.solid_angle_sr / 0.1257 - 1.0).abs() < 0.2, "{}", only.solid_angle_sr);
    }

    #[test]
    fn it_agrees_with_the_servers_own_implementation_of_the_paper() {
        let to_light = Vec3::new(-0.4, 0.7, 0.5).normalize();
        let map = RadianceMap::of(150, |direction| match direction {
            d if d.dot(to_light) > 0.99 => Vec3::new(5.0, 4.0, 3.0),
            d if d.y > 0.0 => Vec3::new(0.2, 0.3, 0.5) * (1.0 + 0.3 * (7.0 * d.x).sin()),
            _ => Vec3::splat(0.15),
        });
        let scaled = Exposure::Ldr(99).take(&map).unwrap();
        let plain = estimate(scaled.codes.as_ref().unwrap(), map.width, 600);
        let mut method = Mr360::default();
        let own = method.estimate(&scaled.frame, &mut StepTimes::default()).unwrap();
        assert_eq!(plain.lights.len(), own.lights.len());
        assert!(plain.lights[0].direction.angle_between(own.lights[0].direction).to_degrees() < 0.3);
        let normals = Normals::new();
        let (a, b) = (normals.lit_by(&plain.sh, &plain.lights), normals.lit_by(&own.sh, &own.lights));
        // One interpolates codes where the other averages areas of lifted pixels.
        assert!(normals.absolute_error(&a, &b) < 0.02, "{}", normals.absolute_error(&a, &b));
    }
}
