//! The best that a method could do with a clipped frame: what is not clipped as the frame has it, and of what is clipped the true energy,
//! which no frame holds, but not its place.
//!
//! A channel is clipped where its code is the largest. Each channel's energy is spread evenly over its clipped pixels; light of the
//! panorama that results is summed over every pixel, without harmonics and lights.

use glam::Vec3;
use mr360_shaders::colour::srgb_decode;

use super::radiance_map::{LUMA, RadianceMap};

/// How much an oracle knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Oracle {
    /// The energy of everything that is clipped, together.
    Total,
    /// The energy of each connected region of clipped pixels.
    Regions,
}

/// What an oracle says of a frame.
pub(super) struct Answer {
    /// Its panorama, in the frame's unit of radiance.
    pub(super) map: RadianceMap,
    /// Unit vector to the middle of the region with the most energy; none of a frame without clipped pixels.
    pub(super) strongest: Option<Vec3>,
}

impl Oracle {
    /// Both.
    pub(super) const ALL: [Self; 2] = [Self::Total, Self::Regions];

    /// In tables.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Total => "oracle:total",
            Self::Regions => "oracle:regions",
        }
    }

    /// What it makes of the codes of `truth` times `scale`.
    pub(super) fn answer(self, truth: &RadianceMap, scale: f32, codes: &[[u8; 3]]) -> Answer {
        let regions = regions(truth, codes);
        let linear = |code: u8| srgb_decode(f32::from(code) / 255.0);
        let mut texels: Vec<Vec3> = codes.iter().map(|code| Vec3::from_array(code.map(linear))).collect();
        let mut spread = |pixels: &mut dyn Iterator<Item = usize>| {
            let pixels: Vec<usize> = pixels.collect();
            for channel in 0..3 {
                let clipped = || pixels.iter().copied().filter(|pixel| codes[*pixel][channel] == u8::MAX);
                let solid_angle = |pixel: usize| truth.solid_angle_sr(pixel / truth.width);
                let (mut energy, mut extent) = (0.0, 0.0);
                for pixel in clipped() {
                    energy += f64::from(truth.texels()[pixel][channel] * scale) * solid_angle(pixel);
                    extent += solid_angle(pixel);
                }
                clipped().for_each(|pixel| texels[pixel][channel] = (energy / extent) as f32);
            }
        };
        match self {
            Self::Total => spread(&mut regions.iter().flatten().copied()),
            Self::Regions => regions.iter().for_each(|region| spread(&mut region.iter().copied())),
        }
        let map = truth.with_texels(texels);
        let centroids = regions.iter().map(|region| centroid(&map, region));
        let strongest = centroids.max_by(|(a, _), (b, _)| a.total_cmp(b)).map(|(_, middle)| middle);
        Answer { map, strongest }
    }
}

/// Luminous energy of a region, and where its middle is.
fn centroid(map: &RadianceMap, region: &[usize]) -> (f64, Vec3) {
    let (mut energy, mut sum) = (0.0, glam::DVec3::ZERO);
    for pixel in region {
        let (row, column) = (pixel / map.width, pixel % map.width);
        let own = f64::from(map.texels()[*pixel].dot(LUMA)) * map.solid_angle_sr(row);
        energy += own;
        sum += map.direction(column, row).as_dvec3() * own;
    }
    (energy, sum.as_vec3().normalize_or(Vec3::Y))
}

/// Pixels with a clipped channel, by the regions that they form: corners touch, across the seam and over the poles too.
fn regions(map: &RadianceMap, codes: &[[u8; 3]]) -> Vec<Vec<usize>> {
    let (width, height) = (map.width, map.height);
    let mut left: Vec<bool> = codes.iter().map(|code| code.contains(&u8::MAX)).collect();
    let mut regions = Vec::new();
    for seed in 0..left.len() {
        if !std::mem::take(&mut left[seed]) {
            continue;
        }
        let (mut region, mut next) = (vec![seed], 0);
        while let Some(pixel) = region.get(next).copied() {
            next += 1;
            let (row, column) = (pixel / width, pixel % width);
            for near_row in row.saturating_sub(1)..(row + 2).min(height) {
                for near_column in [column + width - 1, column, column + 1] {
                    let near = near_row * width + near_column % width;
                    if std::mem::take(&mut left[near]) {
                        region.push(near);
                    }
                }
            }
            let across = row * width + (column + width / 2) % width;
            if (row == 0 || row + 1 == height) && std::mem::take(&mut left[across]) {
                region.push(across);
            }
        }
        regions.push(region);
    }
    regions
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::exposure::code;

    const SUN: Vec3 = Vec3::new(90.0, 80.0, 60.0);
    const WINDOW: Vec3 = Vec3::new(2.0, 2.0, 0.5);

    /// A sun across the seam and a wider window that is less than white in blue.
    fn room() -> (RadianceMap, Vec<[u8; 3]>, Vec3, Vec3) {
        let (to_sun, to_window) = (Vec3::new(0.01, 0.5, 0.8).normalize(), Vec3::new(0.3, 0.2, -0.9).normalize());
        let map = RadianceMap::of(64, |direction| match direction {
            d if d.dot(to_sun) > 0.99 => SUN,
            d if d.dot(to_window) > 0.95 => WINDOW,
            _ => Vec3::splat(0.2),
        });
        let codes = map.texels().iter().map(|texel| texel.to_array().map(code)).collect();
        (map, codes, to_sun, to_window)
    }

    fn energy(map: &RadianceMap) -> glam::DVec3 {
        map.texels().iter().enumerate().map(|(at, texel)| texel.as_dvec3() * map.solid_angle_sr(at / map.width)).sum()
    }

    #[test]
    fn no_oracle_loses_energy_and_even_regions_are_met_exactly() {
        let (map, codes, to_sun, _) = room();
        let regions = Oracle::Regions.answer(&map, 1.0, &codes);
        for (got, expected) in regions.map.texels().iter().zip(map.texels()) {
            // What is not clipped has been rounded to 8 bits, a step of which is 1.6 % here.
            assert!((*got - *expected).abs().max_element() < 8e-3 * expected.max_element(), "{got} {expected}");
        }
        // Pixels of 2.8° draw the disc.
        assert!(regions.strongest.unwrap().angle_between(to_sun).to_degrees() < 1.0);
        let total = Oracle::Total.answer(&map, 1.0, &codes);
        assert!((energy(&total.map) / energy(&map) - 1.0).abs().max_element() < 8e-3);
    }

    #[test]
    fn together_the_wide_region_outweighs_the_strong_one() {
        let (map, codes, _, to_window) = room();
        let total = Oracle::Total.answer(&map, 1.0, &codes);
        assert!(total.strongest.unwrap().angle_between(to_window).to_degrees() < 1.0);
        // Red is clipped in both and even over both; blue is clipped in the sun alone, and the window keeps its own.
        let at = |radiance: Vec3| map.texels().iter().position(|texel| *texel == radiance).unwrap();
        let (sun, window) = (total.map.texels()[at(SUN)], total.map.texels()[at(WINDOW)]);
        assert!(sun.x == window.x && sun.x > WINDOW.x && sun.x < SUN.x);
        assert!((sun.z - SUN.z).abs() < 1e-3 && (window.z - WINDOW.z).abs() < 4e-3);
    }

    #[test]
    fn a_frame_is_answered_in_its_own_exposure() {
        let (map, ..) = room();
        let codes: Vec<[u8; 3]> = map.texels().iter().map(|texel| (*texel * 0.25).to_array().map(code)).collect();
        let answer = Oracle::Regions.answer(&map, 0.25, &codes);
        assert!((energy(&answer.map) / energy(&map) - 0.25).abs().max_element() < 4e-3);
        let dark = vec![[9; 3]; codes.len()];
        assert!(Oracle::Total.answer(&map, 1.0, &dark).strongest.is_none());
    }

    #[test]
    fn regions_hold_together_over_seam_and_pole() {
        let map = RadianceMap::of(4, |_| Vec3::ONE);
        let clipped = |pixels: &[usize]| {
            let mut codes = vec![[0u8; 3]; 32];
            pixels.iter().for_each(|pixel| codes[*pixel][1] = 255);
            regions(&map, &codes).len()
        };
        // Eight columns: the ends of a row; corners; opposite each other over the zenith; two rows apart.
        assert_eq!([clipped(&[8, 15]), clipped(&[8, 17]), clipped(&[1, 5]), clipped(&[9, 25]), clipped(&[])], [1, 1, 1, 2, 0]);
    }
}
