//! Lights of a frame that clips: its clipped regions, and which of them holds the sun.
//!
//! Area wins over brightness once both are clipped: a window outranks the sun. What a frame still shows is where its regions stand and how
//! large they are, and that orders them better: suns and lamps are high, windows and horizons are not, and of two at the same height the one
//! that gives level ground more is the likelier source. Half of what recovery gave the regions is therefore pooled and handed to the likeliest
//! ([`Region::score`]). Over 24 panoramas this leaves the irradiance as near to the truth as before, within half a point, and brings the
//! direction of the strongest light from a median of 8° to 4°.

use glam::{DVec3, Vec3};
use pulp::{Arch, Simd, WithSimd};

use super::luminance;
use super::panorama::Panorama;
use super::recovery::Density;
use super::regions::{Regions, Run, most_regions};
use super::track::{MOST_OBSERVATIONS, Observation};
use super::vectors::{load, vectors};

/// Texels clipped by more than this belong to a region with all that they hold, and say where it is by how much more.
pub(super) const INSIDE: f32 = 0.8;
/// From this solid angle on a region is as likely as its place makes it: more than a texel of the default method's panorama, a disc of 0.5°
/// radius. Smaller ones are glints and sharpened edges.
const WHOLE_SR: f64 = 2e-4;
/// Share of what recovery added to the regions that goes to the likeliest.
const POOLED: f64 = 0.5;
/// What the score of a region gains with the logarithm of its solid angle, with the sine of its elevation, and with the level irradiance of
/// its solid angle. Found over 24 panoramas and five exposures each.
const SCORE: [f64; 3] = [0.1, 2.5, 14.0];
/// Differences of scores by which one region is likelier than another by e. So small that the best one wins, so large that two that are as
/// good share what there is and neither pops.
const TEMPERATURE: f64 = 0.05;

/// The fourth power of the density draws a texel's region's direction. Over 14 panoramas with a dominant light, four exposures each, that light
/// is 5.4° off the centroid of its clipped region in the mean with the power of 0, 4.8° with 4, 4.6° with 8; higher powers hang on single cells.
///
/// Regions larger than the first of these solid angles begin to be broad, and are from the second on: discs of 4.6° and 7.9°. The density is blurred
/// over ±2.8° twice; of smaller regions it knows no more than their outline, and that less well.
const BROAD_SR: [f64; 2] = [0.02, 0.06];

/// A clipped region of the upper hemisphere.
#[derive(Debug, Clone, Copy)]
struct Region {
    /// One of its texels.
    texel: u32,
    irradiance: DVec3,
    strength: f64,
    /// Sums of directions, by solid angle alone and by the density with which it is clipped; the second of regions that begin to be broad.
    moment: DVec3,
    dense: DVec3,
    concentration: f64,
    solid_angle_sr: f64,
    /// Luminance that recovery added, times solid angle.
    hidden: f64,
}

impl Region {
    fn direction(&self) -> DVec3 {
        let broad = ((self.solid_angle_sr - BROAD_SR[0]) / (BROAD_SR[1] - BROAD_SR[0])).clamp(0.0, 1.0);
        let middle = |moment: DVec3| moment.try_normalize().unwrap_or(DVec3::ZERO);
        // Texels of one hemisphere cannot cancel out, except on its rim; straight up is as good as any then.
        middle(self.moment).lerp(middle(self.dense), broad).try_normalize().unwrap_or(DVec3::Y)
    }

    fn score(&self) -> f64 {
        let height = self.direction().y;
        SCORE[0] * self.solid_angle_sr.ln() + SCORE[1] * height + SCORE[2] * self.solid_angle_sr * height
    }
}

/// What lights are taken out of.
pub(super) struct Sky<'a> {
    /// Recovered.
    pub(super) panorama: &'a Panorama,
    /// Degree to which each texel is clipped.
    pub(super) clipped: &'a [f32],
    /// How much of what lies around each texel is clipped.
    pub(super) density: Density<'a>,
    /// Mean luminance of the upper hemisphere: what stands out of it is light.
    pub(super) mean: f64,
    /// Luminance times solid angle of the upper hemisphere.
    pub(super) energy: f64,
    /// Colour of what recovery adds, of luminance 1.
    pub(super) tint: Vec3,
    /// Standard deviation of its logarithm.
    pub(super) sigma: f32,
}

/// Finds the lights of clipped frames; buffers are reused.
pub(super) struct Clipped {
    list: Vec<Region>,
    likelihood: Vec<f64>,
    /// Share of what recovery added that goes to the likeliest: [`POOLED`], and less where all regions are specks.
    pooled: f64,
    /// Along a run, which is one row of the sky at most.
    density: Vec<f32>,
}

impl Clipped {
    /// Room for whatever a sky of this size may hold, so that no frame allocates.
    pub(super) fn new(width: usize, rows: usize) -> Self {
        let regions = most_regions(width, rows);
        Self { list: Vec::with_capacity(regions), likelihood: Vec::with_capacity(regions), pooled: 0.0, density: vec![0.0; width] }
    }

    /// Forgets the last frame's regions.
    pub(super) fn clear(&mut self) {
        self.list.clear();
        self.likelihood.clear();
        self.pooled = 0.0;
    }

    /// Measures the regions and finds out which is likely to hold the sun.
    pub(super) fn measure(&mut self, sky: &Sky<'_>, regions: &Regions) {
        self.clear();
        let arch = Arch::new();
        self.list.extend(regions.iter().map(|runs| {
            let mut region = arch.dispatch(Measure { sky, runs });
            if region.solid_angle_sr > BROAD_SR[0] {
                arch.dispatch(Dense { sky, runs, region: &mut region, density: &mut self.density });
            }
            region
        }));
        self.list.retain(|region| region.strength > 0.0);
        self.weigh();
    }

    /// Share of what recovery added to anything that is given away to the likeliest regions.
    pub(super) fn pooled(&self) -> f64 {
        self.pooled
    }

    /// Hands out what is pooled, and what others give away, `given`, and writes the strongest, at most [`MOST_OBSERVATIONS`]. `moved` is told
    /// direction and irradiance of whatever was moved to or from one of them: the panorama does not know of it.
    pub(super) fn observe(&mut self, sky: &Sky<'_>, given: f64, observations: &mut Vec<Observation>, mut moved: impl FnMut(Vec3, DVec3)) {
        let pool = given + self.pooled * self.list.iter().map(|region| region.hidden).sum::<f64>();
        for (region, likelihood) in self.list.iter_mut().zip(&self.likelihood) {
            let change = pool * likelihood - self.pooled * region.hidden;
            let irradiance = sky.tint.as_dvec3() * change;
            moved(region.direction().as_vec3(), irradiance);
            region.irradiance = (region.irradiance + irradiance).max(DVec3::ZERO);
            region.concentration *= ((region.strength + change) / region.strength).powi(2);
            region.hidden += change;
            region.strength += change;
        }
        self.list.sort_unstable_by(|a, b| b.strength.total_cmp(&a.strength));
        observations.clear();
        observations.extend(self.list.iter().take(MOST_OBSERVATIONS).map(|region| {
            let hidden_share = (region.hidden / region.strength).clamp(0.0, 1.0);
            let sigma = f64::from(sky.sigma) * hidden_share;
            Observation {
                direction: region.direction(),
                irradiance: region.irradiance,
                // What stands out of the mean is all in the light.
                pedestal: DVec3::ZERO,
                solid_angle_sr: region.strength * region.strength / region.concentration,
                share: likely_share(region.strength, sky.energy, sigma),
                hidden_share,
                sigma,
            }
        }));
    }

    /// A texel of the region behind each observation, in the same order.
    pub(super) fn texels(&self) -> impl Iterator<Item = u32> + '_ {
        self.list.iter().take(MOST_OBSERVATIONS).map(|region| region.texel)
    }

    /// How likely each region is to hold the sun; the sum is 1, or there are none.
    fn weigh(&mut self) {
        let whole = |region: &Region| (region.solid_angle_sr / WHOLE_SR).min(1.0).powi(2);
        let best = self.list.iter().map(Region::score).fold(f64::NEG_INFINITY, f64::max);
        self.likelihood.clear();
        self.likelihood.extend(self.list.iter().map(|region| whole(region) * ((region.score() - best) / TEMPERATURE).exp()));
        let sum: f64 = self.likelihood.iter().sum();
        self.likelihood.iter_mut().for_each(|likelihood| *likelihood /= sum.max(f64::MIN_POSITIVE));
        // Specks get nothing that is not theirs.
        self.pooled = POOLED * self.list.iter().map(whole).fold(0.0, f64::max);
    }
}

/// Share of the energy that a light may well have: its strength is known up to a standard deviation. Missing the only lamp of a room is worse
/// than a faint shadow too many.
pub(super) fn likely_share(strength: f64, energy: f64, sigma: f64) -> f64 {
    let likely = strength * sigma.exp();
    likely / (energy + likely - strength)
}

/// What stands out of the mean in one region.
struct Measure<'a> {
    sky: &'a Sky<'a>,
    runs: &'a [Run],
}

impl WithSimd for Measure<'_> {
    type Output = Region;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Region {
        let Sky { panorama, clipped, mean, .. } = *self.sky;
        let (geometry, width) = (&panorama.geometry, panorama.size.width as usize);
        let mut sum = Region {
            texel: self.runs.first().map_or(0, |run| run.texels(width).start as u32),
            irradiance: DVec3::ZERO,
            strength: 0.0,
            moment: DVec3::ZERO,
            dense: DVec3::ZERO,
            concentration: 0.0,
            solid_angle_sr: 0.0,
            hidden: 0.0,
        };
        let (zero, one, mean) = (simd.splat_f32s(0.0), simd.splat_f32s(1.0), simd.splat_f32s(mean as f32));
        for run in self.runs {
            let (row, columns, texels) = (run.row as usize, run.columns(), run.texels(width));
            let channels = [0, 1, 2].map(|channel: usize| &panorama.channels[channel][texels.clone()]);
            let [sines, cosines] = geometry.sin_cos_longitude.each_ref().map(|table| &table[columns.clone()]);
            let degree = &clipped[texels];
            let (mut irradiance, mut of_inside, mut strength, mut squares, mut hidden) = ([zero; 3], [zero; 3], zero, zero, zero);
            for vector in 0..vectors::<S>(columns.len()) {
                let radiance = [load(simd, channels[0], vector), load(simd, channels[1], vector), load(simd, channels[2], vector)];
                let luminance = luminance::of(simd, radiance[0], radiance[1], radiance[2]);
                let share = simd.sub_f32s(one, simd.div_f32s(mean, simd.max_f32s(luminance, simd.splat_f32s(f32::MIN_POSITIVE))));
                let share = simd.max_f32s(share, zero);
                for channel in 0..3 {
                    irradiance[channel] = simd.add_f32s(irradiance[channel], simd.mul_f32s(radiance[channel], share));
                }
                let excess = simd.mul_f32s(luminance, share);
                strength = simd.add_f32s(strength, excess);
                squares = simd.add_f32s(squares, simd.mul_f32s(excess, excess));
                // What is shown is white at most.
                hidden = simd.add_f32s(hidden, simd.max_f32s(simd.sub_f32s(luminance, one), zero));
                // Where a region is brightest is a guess; where it is, is seen.
                let inside = inside(simd, load(simd, degree, vector));
                of_inside[0] = simd.add_f32s(of_inside[0], inside);
                of_inside[1] = simd.add_f32s(of_inside[1], simd.mul_f32s(inside, load(simd, sines, vector)));
                of_inside[2] = simd.add_f32s(of_inside[2], simd.mul_f32s(inside, load(simd, cosines, vector)));
            }
            let texel_sr = f64::from(geometry.solid_angle_sr[row]);
            let mut total = [0.0; 9];
            let all = [irradiance[0], irradiance[1], irradiance[2], strength, squares, hidden, of_inside[0], of_inside[1], of_inside[2]];
            for (total, sums) in total.iter_mut().zip(all) {
                *total = f64::from(simd.reduce_sum_f32s(sums)) * texel_sr;
            }
            let [red, green, blue, strength, squares, hidden, inside, of_sine, of_cosine] = total;
            sum.irradiance += DVec3::new(red, green, blue);
            sum.strength += strength;
            sum.concentration += squares;
            sum.hidden += hidden;
            sum.solid_angle_sr += inside;
            sum.moment += along_row(geometry.sin_cos_latitude[row], inside, of_sine, of_cosine);
        }
        sum.hidden = sum.hidden.min(sum.strength);
        sum
    }
}

/// Adds up directions by density: a sun has the broadest part of its glare around it.
struct Dense<'a> {
    sky: &'a Sky<'a>,
    runs: &'a [Run],
    region: &'a mut Region,
    density: &'a mut [f32],
}

impl WithSimd for Dense<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Sky { panorama, clipped, density, .. } = *self.sky;
        let (geometry, width) = (&panorama.geometry, panorama.size.width as usize);
        for run in self.runs {
            let (row, columns) = (run.row as usize, run.columns());
            let densities = &mut self.density[..columns.len()];
            density.along(row, columns.clone(), densities);
            let [sines, cosines] = geometry.sin_cos_longitude.each_ref().map(|table| &table[columns.clone()]);
            let degree = &clipped[run.texels(width)];
            let mut sums = [simd.splat_f32s(0.0); 3];
            for vector in 0..vectors::<S>(columns.len()) {
                let density = load(simd, densities, vector);
                let square = simd.mul_f32s(density, density);
                let weight = simd.mul_f32s(inside(simd, load(simd, degree, vector)), simd.mul_f32s(square, square));
                sums[0] = simd.add_f32s(sums[0], weight);
                sums[1] = simd.add_f32s(sums[1], simd.mul_f32s(weight, load(simd, sines, vector)));
                sums[2] = simd.add_f32s(sums[2], simd.mul_f32s(weight, load(simd, cosines, vector)));
            }
            let texel_sr = f64::from(geometry.solid_angle_sr[row]);
            let mut total = [0.0; 3];
            for (total, sums) in total.iter_mut().zip(sums) {
                *total = f64::from(simd.reduce_sum_f32s(sums)) * texel_sr;
            }
            self.region.dense += along_row(geometry.sin_cos_latitude[row], total[0], total[1], total[2]);
        }
    }
}

/// Sum of directions of a row, from its sine and cosine of latitude and the sums of weights and of weights times sines and cosines of longitude.
fn along_row((sine, cosine): (f32, f32), weight: f64, of_sine: f64, of_cosine: f64) -> DVec3 {
    DVec3::new(f64::from(cosine) * of_sine, f64::from(sine) * weight, -f64::from(cosine) * of_cosine)
}

/// How far inside the region texels of these degrees are: rises from 0 to 1 between [`INSIDE`] and 1, without a kink at either end. Never nothing, or a
/// region on the brink of clipping would be nowhere; and nothing of what is no part of it.
#[inline(always)]
fn inside<S: Simd>(simd: S, degree: S::f32s) -> S::f32s {
    let (zero, one) = (simd.splat_f32s(0.0), simd.splat_f32s(1.0));
    let t = simd.mul_f32s(simd.sub_f32s(degree, simd.splat_f32s(INSIDE)), simd.splat_f32s(1.0 / (1.0 - INSIDE)));
    let t = simd.min_f32s(simd.max_f32s(t, zero), one);
    let smooth = simd.mul_f32s(simd.mul_f32s(t, t), simd.sub_f32s(simd.splat_f32s(3.0), simd.add_f32s(t, t)));
    simd.select_f32s(simd.greater_than_f32s(degree, simd.splat_f32s(INSIDE)), simd.max_f32s(smooth, simd.splat_f32s(1e-3)), zero)
}
