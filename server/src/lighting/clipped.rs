//! Lights of a frame that clips: its clipped regions, and which of them holds the sun.
//!
//! Area wins over brightness once both are clipped: a window outranks the sun. What a frame still shows is where its regions stand and how
//! large they are, and that orders them better: suns and lamps are high, windows and horizons are not, and of two at the same height the one
//! that gives level ground more is the likelier source. Half of what recovery gave the regions is therefore pooled and handed to the likeliest
//! ([`Region::score`]). Over 24 panoramas this leaves the irradiance as near to the truth as before, within half a point, and brings the
//! direction of the strongest light from a median of 8° to 4°.

use glam::{DVec3, Vec3};
use mr360_shaders::colour::LUMA;

use super::panorama::Panorama;
use super::recovery::Density;
use super::regions::Regions;
use super::track::{MOST_OBSERVATIONS, Observation};

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

/// Power of the density with which a texel draws its region's direction. Over 14 panoramas with a dominant light, four exposures each, that light
/// is 5.4° off the centroid of its clipped region in the mean with 0, 4.8° with 4, 4.6° with 8; higher powers hang on single cells.
const BROADEST: i32 = 4;
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
    /// Sums of directions, by solid angle alone and by the density with which it is clipped.
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
}

impl Clipped {
    /// Room for this many regions.
    pub(super) fn new(regions: usize) -> Self {
        Self { list: Vec::with_capacity(regions), likelihood: Vec::with_capacity(regions), pooled: 0.0 }
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
        self.list.extend(regions.iter().map(|members| measure(sky, members)));
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
fn measure(sky: &Sky<'_>, members: &[u32]) -> Region {
    let mut sum = Region {
        texel: members.first().copied().unwrap_or_default(),
        irradiance: DVec3::ZERO,
        strength: 0.0,
        moment: DVec3::ZERO,
        dense: DVec3::ZERO,
        concentration: 0.0,
        solid_angle_sr: 0.0,
        hidden: 0.0,
    };
    let width = sky.panorama.size.width as usize;
    for texel in members {
        let texel = *texel as usize;
        let radiance = sky.panorama.radiance(texel);
        let luminance = radiance.dot(LUMA);
        // Never nothing, or a region on the brink of clipping would be nowhere.
        let inside = smooth(((sky.clipped[texel] - INSIDE) / (1.0 - INSIDE)).clamp(0.0, 1.0)).max(1e-3);
        let excess = (1.0 - sky.mean / f64::from(luminance).max(f64::MIN_POSITIVE)).max(0.0);
        let (row, column) = (texel / width, texel % width);
        let solid_angle_sr = f64::from(sky.panorama.geometry.solid_angle_sr[row]);
        let strength = f64::from(luminance) * excess * solid_angle_sr;
        sum.irradiance += radiance.as_dvec3() * (excess * solid_angle_sr);
        sum.strength += strength;
        // Where a region is brightest is a guess; where it is, is seen, and that a sun has the broadest part of its glare around it.
        let inside_sr = solid_angle_sr * f64::from(inside);
        let direction = sky.panorama.geometry.direction(row, column).as_dvec3() * inside_sr;
        sum.moment += direction;
        sum.dense += direction * f64::from(sky.density.at(row, column)).powi(BROADEST);
        sum.concentration += strength * f64::from(luminance) * excess;
        sum.solid_angle_sr += inside_sr;
        // What is shown is white at most.
        sum.hidden += f64::from((luminance - 1.0).max(0.0)) * solid_angle_sr;
    }
    sum.hidden = sum.hidden.min(sum.strength);
    sum
}

/// Rises from 0 to 1 with `t`, without a kink at either end.
fn smooth(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}
