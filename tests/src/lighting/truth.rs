//! What is true of a panorama's light, from all its pixels.

use glam::{DVec3, Vec3};

use super::irradiance::Normals;
use super::radiance_map::{LUMA, RadianceMap};

/// The dominant light is what lies this near to the middle of the brightest cap.
const CENTROID_RADIUS_DEG: f64 = 5.0;
/// Radius of the caps among which the brightest is sought.
const CAP_RADIUS_DEG: f64 = 2.5;
/// Standard deviation of the grain under which the dominant light is looked for again, as a share of each pixel's radiance, and how often.
const GRAIN: f32 = 0.03;
const GRAINS: u64 = 4;
/// A dominant light gives more than this share of the irradiance on level ground.
const DOMINANT_SHARE: f64 = 0.1;

/// The light of a panorama, in its own unit of radiance.
#[derive(Debug, Clone)]
pub(super) struct Truth {
    /// On a surface of each of the [`Normals`], radiance·sr.
    pub(super) irradiance: Vec<DVec3>,
    /// Unit vector to the dominant light, where there is one.
    pub(super) dominant: Option<Vec3>,
    /// Share of the luminous irradiance on level ground that comes from what exceeds μ + 2σ of the upper hemisphere.
    pub(super) direct_share: f64,
}

impl Truth {
    /// Of a panorama.
    pub(super) fn of(map: &RadianceMap, normals: &Normals) -> Self {
        let energy = Energy::of(map);
        Self { irradiance: irradiances(map, normals), dominant: energy.dominant(map), direct_share: direct_share(map) }
    }

    /// How far the dominant light of the same panorama moves, degrees, when each of its pixels is off by a grain of 3 %: the largest of four moves. Where the brightest
    /// cap is hardly brighter than others, as on a long lamp, its place is decided by less than that.
    pub(super) fn restlessness_deg(&self, map: &RadianceMap) -> Option<f64> {
        let dominant = self.dominant?;
        let moved = (1..=GRAINS).filter_map(|seed| {
            let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15);
            // xorshift; the sum of three even numbers has a standard deviation of one half.
            let mut even = || {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                (state >> 40) as f32 / (1u64 << 24) as f32
            };
            let texels = map.texels().iter().map(|texel| *texel * (1.0 + 2.0 * GRAIN * (even() + even() + even() - 1.5)).max(0.0));
            let grained = map.with_texels(texels.collect());
            let found = Energy::of(&grained).dominant(&grained)?;
            Some(f64::from(found.cross(dominant).length().atan2(found.dot(dominant)).to_degrees()))
        });
        moved.reduce(f64::max)
    }

    /// Irradiance in units in which the panorama's radiance is `scale` times as large.
    pub(super) fn scaled_irradiance(&self, scale: f32) -> Vec<DVec3> {
        self.irradiance.iter().map(|irradiance| *irradiance * f64::from(scale)).collect()
    }
}

/// Irradiance on a surface of each of the normals.
pub(super) fn irradiances(map: &RadianceMap, normals: &Normals) -> Vec<DVec3> {
    normals.directions().iter().map(|normal| irradiance(map, *normal)).collect()
}

/// Irradiance on a surface of this normal: radiance · cosine · solid angle, summed over every pixel.
fn irradiance(map: &RadianceMap, normal: Vec3) -> DVec3 {
    let normal = normal.as_dvec3();
    let (longitudes, latitudes) = (axis(map.width, std::f64::consts::TAU), axis(map.height, -std::f64::consts::PI));
    // With d = (cos φ · sin λ, sin φ, −cos φ · cos λ): the part of the cosine that depends on the column.
    let across: Vec<f64> = longitudes.iter().map(|longitude| normal.x * longitude.sin() - normal.z * longitude.cos()).collect();
    let rows = map.rows().zip(&latitudes).enumerate().map(|(row, (texels, latitude))| {
        let (sin, cos) = latitude.sin_cos();
        let mut sum = DVec3::ZERO;
        for (texel, across) in texels.iter().zip(&across) {
            sum += texel.as_dvec3() * (cos * across + sin * normal.y).max(0.0);
        }
        sum * map.solid_angle_sr(row)
    });
    rows.sum()
}

/// Angles of the pixel centres of an axis that spans `range` around 0.
fn axis(count: usize, range: f64) -> Vec<f64> {
    (0..count).map(|at| ((at as f64 + 0.5) / count as f64 - 0.5) * range).collect()
}

/// Share of the irradiance on level ground that the light above μ + 2σ gives, in luminance. Mean and deviation are those
/// of the upper hemisphere, weighted by solid angle.
pub(super) fn direct_share(map: &RadianceMap) -> f64 {
    let upper = || {
        let rows = map.rows().enumerate().take(map.height / 2);
        rows.flat_map(|(row, texels)| {
            let (solid_angle, cosine) = (map.solid_angle_sr(row), f64::from(map.direction(0, row).y));
            texels.iter().map(move |texel| (f64::from(texel.dot(LUMA)), solid_angle, solid_angle * cosine))
        })
    };
    let weight: f64 = upper().map(|(_, solid_angle, _)| solid_angle).sum();
    let mean = upper().map(|(y, solid_angle, _)| y * solid_angle).sum::<f64>() / weight;
    let variance = upper().map(|(y, solid_angle, _)| (y - mean).powi(2) * solid_angle).sum::<f64>() / weight;
    let threshold = mean + 2.0 * variance.sqrt();
    let (mut direct, mut total) = (0.0, 0.0);
    for (y, _, received) in upper() {
        direct += (y - threshold).max(0.0) * received;
        total += y * received;
    }
    if total > 0.0 { direct / total } else { 0.0 }
}

/// Luminous energy, radiance · solid angle, with running sums along every row.
struct Energy {
    width: usize,
    /// `width + 1` for every row: energy of all pixels before this one.
    before: Vec<f64>,
    /// Sine and cosine of each row's latitude.
    latitudes: Vec<(f64, f64)>,
}

impl Energy {
    fn of(map: &RadianceMap) -> Self {
        let mut before = Vec::with_capacity((map.width + 1) * map.height);
        for (row, texels) in map.rows().enumerate() {
            let mut sum = 0.0;
            before.push(sum);
            for texel in texels {
                sum += f64::from(texel.dot(LUMA)) * map.solid_angle_sr(row);
                before.push(sum);
            }
        }
        let latitudes = axis(map.height, -std::f64::consts::PI).into_iter().map(f64::sin_cos).collect();
        Self { width: map.width, before, latitudes }
    }

    /// Columns to either side of its middle that a cap around a pixel of row `centre` covers in row `row`: `None` where it
    /// does not reach, half the width or more where it covers all of it.
    fn reach(&self, centre: usize, row: usize, cos_radius: f64) -> Option<usize> {
        let ((sin_a, cos_a), (sin_b, cos_b)) = (self.latitudes[centre], self.latitudes[row]);
        let cosine = (cos_radius - sin_a * sin_b) / (cos_a * cos_b);
        (cosine <= 1.0).then(|| (cosine.max(-1.0).acos() / std::f64::consts::TAU * self.width as f64) as usize)
    }

    /// Energy of the pixels of a row within `reach` of `column`, around the seam too.
    fn around(&self, row: usize, column: usize, reach: usize) -> f64 {
        let line = &self.before[row * (self.width + 1)..(row + 1) * (self.width + 1)];
        let all = line[self.width];
        if 2 * reach + 1 >= self.width {
            return all;
        }
        let (first, last) = (column + self.width - reach, column + self.width + reach + 1);
        let until = |at: usize| all * (at / self.width) as f64 + line[at % self.width];
        until(last) - until(first)
    }

    /// Middle of the brightest cap as column and row.
    fn brightest_cap(&self) -> (usize, usize) {
        let cos_radius = CAP_RADIUS_DEG.to_radians().cos();
        let mut best = (f64::NEG_INFINITY, (0, 0));
        for centre in 0..self.latitudes.len() {
            let reaches: Vec<(usize, usize)> =
                (0..self.latitudes.len()).filter_map(|row| Some((row, self.reach(centre, row, cos_radius)?))).collect();
            for column in 0..self.width {
                let energy: f64 = reaches.iter().map(|(row, reach)| self.around(*row, column, *reach)).sum();
                if energy > best.0 {
                    best = (energy, (column, centre));
                }
            }
        }
        best.1
    }

    /// Direction of the dominant light: the energy's centroid around the brightest cap, where that gives level ground enough.
    fn dominant(&self, map: &RadianceMap) -> Option<Vec3> {
        let (column, row) = self.brightest_cap();
        let middle = map.direction(column, row);
        let cos_radius = CENTROID_RADIUS_DEG.to_radians().cos() as f32;
        let (mut centroid, mut given, mut total) = (DVec3::ZERO, 0.0, 0.0);
        for (row, texels) in map.rows().enumerate() {
            for (column, texel) in texels.iter().enumerate() {
                let direction = map.direction(column, row);
                let energy = f64::from(texel.dot(LUMA)) * map.solid_angle_sr(row);
                let received = energy * f64::from(direction.y.max(0.0));
                total += received;
                if direction.dot(middle) >= cos_radius {
                    centroid += direction.as_dvec3() * energy;
                    given += received;
                }
            }
        }
        (given > DOMINANT_SHARE * total).then(|| centroid.normalize().as_vec3())
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{PI, TAU};

    use super::*;

    /// An even sky of radiance 1 with a disc of radiance `peak` and `radius_deg` around `middle`.
    fn sky(middle: Vec3, radius_deg: f32, peak: f32) -> RadianceMap {
        let cosine = radius_deg.to_radians().cos();
        RadianceMap::of(256, |direction| Vec3::splat(if direction.dot(middle) >= cosine { peak } else { 1.0 }))
    }

    #[test]
    fn an_even_sky_gives_pi_on_every_normal_and_has_no_dominant_light() {
        let map = RadianceMap::of(64, |_| Vec3::new(1.0, 2.0, 0.5));
        let truth = Truth::of(&map, &Normals::new());
        for irradiance in &truth.irradiance {
            // Midpoint quadrature on 128×64 pixels.
            assert!((*irradiance / PI - DVec3::new(1.0, 2.0, 0.5)).abs().max_element() < 1e-3, "{irradiance}");
        }
        assert_eq!((truth.dominant, truth.direct_share), (None, 0.0));
        assert_eq!(truth.scaled_irradiance(2.0)[7], truth.irradiance[7] * 2.0);
    }

    #[test]
    fn one_light_gives_its_irradiance_times_the_cosine() {
        let to_light = Vec3::new(0.5, 0.6, -0.4).normalize();
        let cosine = 4.0f32.to_radians().cos();
        let map = RadianceMap::of(256, |direction| if direction.dot(to_light) >= cosine { Vec3::splat(100.0) } else { Vec3::ZERO });
        let facing = irradiance(&map, to_light);
        // π sin² of the disc's radius; pixels of 0.7° draw its edge to 1 %.
        assert!((facing.x / (100.0 * PI * 4f64.to_radians().sin().powi(2)) - 1.0).abs() < 0.01, "{facing}");
        for normal in [Vec3::Y, Vec3::X, Vec3::new(0.0, 0.6, 0.8)] {
            let expected = facing.x * f64::from(normal.dot(to_light).max(0.0));
            assert!((irradiance(&map, normal).x - expected).abs() < 0.005 * facing.x, "{normal}");
        }
        assert_eq!(irradiance(&map, -to_light), DVec3::ZERO);
    }

    #[test]
    fn the_dominant_light_is_found_at_the_seam_at_the_zenith_and_between() {
        for middle in [Vec3::Z, Vec3::new(0.01, 0.4, 0.9), Vec3::Y, Vec3::new(0.02, 1.0, 0.03), Vec3::new(0.3, 0.5, -0.6)] {
            let middle = (middle + Vec3::Y * 0.2).normalize();
            let found = Truth::of(&sky(middle, 1.5, 3e4), &Normals::new()).dominant.unwrap();
            // Pixels of 0.7° draw the disc's edge unevenly: half of one.
            assert!(found.angle_between(middle).to_degrees() < 0.35, "{middle}: {found}");
        }
    }

    #[test]
    fn the_brightest_part_of_an_even_strip_is_anywhere_along_it() {
        let disc = sky(Vec3::new(0.3, 0.8, -0.5).normalize(), 1.5, 3e4);
        let strip = RadianceMap::of(256, |d| Vec3::splat(if d.z.abs() < 0.02 && d.x.abs() < 0.3 && d.y > 0.0 { 3e3 } else { 1.0 }));
        let [still, restless] = [&disc, &strip].map(|map| Truth::of(map, &Normals::new()).restlessness_deg(map).unwrap());
        assert!(still < 0.05 && restless > 1.0, "{still} {restless}");
    }

    #[test]
    fn a_light_that_gives_level_ground_little_is_not_dominant() {
        let high = Vec3::new(0.0, 0.8, -0.6);
        // A disc of radius 1.5° has 2.15e-3 sr: of π it gives a tenth at a radiance of 203 on a cosine of 0.8.
        assert!(Truth::of(&sky(high, 1.5, 150.0), &Normals::new()).dominant.is_none());
        assert!(Truth::of(&sky(high, 1.5, 260.0), &Normals::new()).dominant.is_some());
        assert!(Truth::of(&sky(-high, 1.5, 1e5), &Normals::new()).dominant.is_none());
    }

    #[test]
    fn the_direct_share_is_what_exceeds_two_deviations() {
        let (cosine, peak) = (0.8, 1000.0);
        let map = sky(Vec3::new(0.0, cosine as f32, -0.6), 3.0, peak as f32);
        let solid_angle = TAU * (1.0 - 3f64.to_radians().cos());
        let covered = solid_angle / TAU;
        let threshold = 1.0 + (peak - 1.0) * (covered + 2.0 * (covered * (1.0 - covered)).sqrt());
        let expected = (peak - threshold) * solid_angle * cosine / (PI + (peak - 1.0) * solid_angle * cosine);
        // The disc's edge is drawn to 1 %.
        assert!((direct_share(&map) - expected).abs() < 0.01, "{} against {expected}", direct_share(&map));
    }
}
