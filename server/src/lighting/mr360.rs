//! The method of MR360 (Rhee et al. 2017, Sections 3.2, 4 and 6.3), for comparison: threshold at μ+2σ of the
//! inverse-tone-mapped upper half, breadth-first regions, lights from their excess over the threshold.
//!
//! Its known faults are the paper's and are kept: angles are averaged instead of directions (wrong around the
//! zenith), regions end at the ±180° seam (a sun there becomes two lights), and no light is found once a fifth of
//! the sky is clipped.

use glam::Vec3;
use mr360_protocol::light::{DirectionalLight, Lift, MAX_LIGHTS, SH9};
use mr360_shaders::colour::IORNS_LUMA;

use super::candidates::{Candidate, Candidates};
use super::panorama::Panorama;
use super::radiance::Planes;
use super::regions::{Regions, Topology, most_regions};
use super::sampling::Grid;
use super::series::Series;
use super::{Estimate, LightError, LightMethod, StepTimes};
use crate::frame::Frame;

/// Section 6.3: the upper half is 600×150. The lower half is needed for the residual only. The tone map is inverted
/// at twice that resolution, before the resampling.
pub(super) const SIZE: Grid = Grid { width: 600, height: 300, supersample: 2 };
/// Section 4.1: the smallest number of lights that hold this share of all detected irradiance is kept.
const KEPT_SHARE: f64 = 0.9;
/// Relative margin over the mean that a threshold needs, so that rounding in an even sky makes no light.
const ROUNDING_MARGIN: f64 = 1e-3;
/// Section 6.3: the range of solid angles that the paper maps linearly.
const SIZE_RANGE_SR: (f32, f32) = (0.1, 0.6);
/// Section 4.1 brightens small lights and dims large ones "with an experimentally determined ad-hoc mapping"
/// that is not given. This project's choice at the ends of [`SIZE_RANGE_SR`], linear between and even around 1.
const SIZE_FACTOR: (f32, f32) = (1.5, 0.5);

/// The paper's method; see the module.
pub struct Mr360 {
    panorama: Panorama,
    series: Series,
    luminance: Vec<f32>,
    blurred: Vec<f32>,
    across: Vec<f32>,
    regions: Regions,
    candidates: Candidates,
    estimate: Estimate,
    size_intensity: bool,
}

impl Default for Mr360 {
    fn default() -> Self {
        Self::new(true)
    }
}

impl Mr360 {
    /// The method with or without its size-dependent intensity, which alone makes lights and SH differ from the
    /// lifted panorama's energy. It stands in for light lost to clipping, so HDR frames are never given it.
    #[must_use]
    pub fn new(size_intensity: bool) -> Self {
        Self::with_size(SIZE, size_intensity)
    }

    /// On a working panorama of another size, twice as wide as high; see [`super::MethodSpec::make_at`].
    pub(super) fn with_size(size: Grid, size_intensity: bool) -> Self {
        let (width, upper_rows) = (size.width as usize, size.height as usize / 2);
        let texels = width * upper_rows;
        Self {
            panorama: Panorama::new(size, Lift::InverseToneMap),
            series: Series::new(size, SH9),
            luminance: vec![0.0; texels],
            blurred: vec![0.0; texels],
            across: vec![0.0; texels],
            regions: Regions::new(width, upper_rows),
            candidates: Candidates::new(most_regions(width, upper_rows)),
            estimate: Estimate { lights: Vec::with_capacity(MAX_LIGHTS), ..Estimate::default() },
            size_intensity,
        }
    }

    fn find_lights(&mut self, threshold: f32, steps: &mut StepTimes) {
        let width = self.panorama.size.width as usize;
        steps.time("regions", || {
            self.regions.find(width, &self.blurred, Topology::Flat, |luminance| luminance > threshold);
        });
        steps.time("lights", || {
            self.candidates.collect(&self.panorama, &self.regions, IORNS_LUMA, threshold);
            let chosen = strongest(self.candidates.list());
            let boost = self.size_intensity && self.panorama.lift() == Lift::InverseToneMap;
            self.estimate.lights.clear();
            let lights = self.candidates.list()[..chosen].iter().zip(0..).map(|(candidate, id)| light(candidate, id, boost));
            self.estimate.lights.extend(lights);
            self.candidates.take_out(chosen, &mut self.panorama, &self.regions, IORNS_LUMA, threshold);
        });
    }
}

impl LightMethod for Mr360 {
    fn name(&self) -> &'static str {
        "mr360"
    }

    fn estimate(&mut self, frame: &Frame, steps: &mut StepTimes) -> Result<&Estimate, LightError> {
        steps.time("sample", || self.panorama.take(frame))?;
        let threshold = steps.time("threshold", || {
            luminance(&self.panorama.channels, &mut self.luminance);
            box_blur(&self.luminance, self.panorama.size.width as usize, &mut self.across, &mut self.blurred);
            statistical_threshold(&self.blurred)
        });
        self.find_lights(threshold, steps);
        steps.time("sh", || self.estimate.project(&self.panorama, &self.series));
        Ok(&self.estimate)
    }
}

/// Eq. 3 for as many texels from the top as `out` holds.
fn luminance([red, green, blue]: &Planes, out: &mut [f32]) {
    for (((out, r), g), b) in out.iter_mut().zip(red).zip(green).zip(blue) {
        *out = IORNS_LUMA.x * r + IORNS_LUMA.y * g + IORNS_LUMA.z * b;
    }
}

/// Section 4.1 asks for "a small box blur": 3×3, the smallest, with edges repeated. It does not wrap.
fn box_blur(source: &[f32], width: usize, across: &mut [f32], out: &mut [f32]) {
    for (row, out) in source.chunks_exact(width).zip(across.chunks_exact_mut(width)) {
        for (out, window) in out[1..].iter_mut().zip(row.windows(3)) {
            *out = window[0] + window[1] + window[2];
        }
        out[0] = row[0] + row[0] + row[1];
        out[width - 1] = row[width - 2] + row[width - 1] + row[width - 1];
    }
    let rows = source.len() / width;
    for (row, out) in out.chunks_exact_mut(width).enumerate() {
        let line = |row: usize| &across[row * width..(row + 1) * width];
        let (above, here, below) = (line(row.saturating_sub(1)), line(row), line((row + 1).min(rows - 1)));
        for (((out, a), b), c) in out.iter_mut().zip(above).zip(here).zip(below) {
            *out = (a + b + c) * (1.0 / 9.0);
        }
    }
}

/// Eq. 6, μ + 2σ of the blurred luminance over the pixels of the upper half, each counted alike: the paper takes
/// "the distribution of luminance values" and weights by solid angle only where it says so.
fn statistical_threshold(luminance: &[f32]) -> f32 {
    let count = luminance.len() as f64;
    let mean = luminance.iter().map(|y| f64::from(*y)).sum::<f64>() / count;
    let variance = luminance.iter().map(|y| (f64::from(*y) - mean).powi(2)).sum::<f64>() / count;
    (mean + 2.0 * variance.sqrt()).max(mean * (1.0 + ROUNDING_MARGIN)) as f32
}

/// How many of the candidates, strongest first, hold [`KEPT_SHARE`] of the irradiance; no more than the wire takes.
fn strongest(candidates: &[Candidate]) -> usize {
    let goal = KEPT_SHARE * candidates.iter().map(|c| c.strength).sum::<f64>();
    let mut held = 0.0;
    let needed = candidates
        .iter()
        .take_while(|candidate| {
            let short = held < goal;
            held += candidate.strength;
            short
        })
        .count();
    needed.min(MAX_LIGHTS)
}

fn light(candidate: &Candidate, id: u32, boost: bool) -> DirectionalLight {
    // Eq. 5: the mean of angles, not of directions.
    let longitude = (candidate.angles.0 / candidate.strength) as f32;
    let latitude = (candidate.angles.1 / candidate.strength) as f32;
    let (sin_latitude, cos_latitude) = latitude.sin_cos();
    let solid_angle_sr = candidate.solid_angle_sr as f32;
    DirectionalLight {
        id,
        direction: Vec3::new(cos_latitude * longitude.sin(), sin_latitude, -cos_latitude * longitude.cos()),
        irradiance: candidate.irradiance.as_vec3() * if boost { size_factor(solid_angle_sr) } else { 1.0 },
        solid_angle_sr,
    }
}

fn size_factor(solid_angle_sr: f32) -> f32 {
    let position = (solid_angle_sr - SIZE_RANGE_SR.0) / (SIZE_RANGE_SR.1 - SIZE_RANGE_SR.0);
    SIZE_FACTOR.0 + (SIZE_FACTOR.1 - SIZE_FACTOR.0) * position.clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blur_keeps_the_sum_away_from_edges_and_even_pictures_as_they_are() {
        let mut source = vec![0.0; 7 * 5];
        source[2 * 7 + 3] = 9.0;
        let (mut across, mut out) = (vec![0.0; 35], vec![0.0; 35]);
        box_blur(&source, 7, &mut across, &mut out);
        assert!((out.iter().sum::<f32>() - 9.0).abs() < 1e-5);
        assert!((out[7 + 2] - 1.0).abs() < 1e-6 && out[0] == 0.0);
        // At the sides the edge is repeated and the other side of the picture is not seen.
        source.fill(0.0);
        source[2 * 7] = 9.0;
        box_blur(&source, 7, &mut across, &mut out);
        assert!((out[2 * 7] - 2.0).abs() < 1e-6 && out[2 * 7 + 6] == 0.0, "{out:?}");
        box_blur(&[0.5; 35], 7, &mut across, &mut out);
        assert!(out.iter().all(|v| (v - 0.5).abs() < 1e-6));
    }

    #[test]
    fn threshold_is_two_deviations_above_the_mean() {
        // μ = 1, σ = 1.
        assert!((statistical_threshold(&[0.0, 2.0, 0.0, 2.0]) - 3.0).abs() < 1e-6);
        // An even picture has no deviation, and nothing in it stands out.
        assert!(statistical_threshold(&[0.1; 9]) > 0.1 * 1.0005);
    }

    #[test]
    fn size_dependent_intensity_favours_small_lights() {
        assert_eq!([0.0, 0.1, 0.35, 0.6, 3.0].map(|sr| (size_factor(sr) * 100.0).round()), [150.0, 150.0, 100.0, 50.0, 50.0]);
    }
}
