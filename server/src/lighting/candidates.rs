//! Regions brighter than a threshold as candidates for lights, and what is left once the chosen ones are out.

use glam::{DVec3, Vec3};
use pulp::{Arch, Simd, WithSimd};

use super::panorama::Panorama;
use super::regions::{Regions, Run};
use super::vectors::{load, vectors};

/// A region's light before it is decided whether it becomes one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    region: usize,
    /// Irradiance, the sum of Eq. 4 over the region.
    pub(super) irradiance: DVec3,
    /// Luminance of that irradiance.
    pub(super) strength: f64,
    /// What the same texels leave in the panorama.
    pub(super) kept: DVec3,
    /// Strength-weighted sum of the texels' directions.
    pub(super) direction: DVec3,
    /// Strength-weighted sums of the texels' longitudes and latitudes.
    pub(super) angles: (f64, f64),
    /// Solid angle of the texels that are above the threshold themselves.
    pub(super) solid_angle_sr: f64,
    /// Sum of strength² over solid angle.
    concentration: f64,
}

impl Candidate {
    /// Solid angle of an even disc that spreads the light as widely: (Σ E)² / Σ E²/Ω.
    pub(super) fn effective_solid_angle_sr(&self) -> f64 {
        self.strength * self.strength / self.concentration
    }

    /// Half angle of that disc, radians.
    pub(super) fn radius(&self) -> f64 {
        half_angle(self.effective_solid_angle_sr())
    }
}

/// Half angle of a disc of this solid angle, radians.
pub(super) fn half_angle(solid_angle_sr: f64) -> f64 {
    (1.0 - solid_angle_sr / std::f64::consts::TAU).clamp(-1.0, 1.0).acos()
}

/// Reach of a candidate's core in radii of its effective solid angle.
const CORE_RADII: f64 = 2.0;
/// Most steps of the mean shift; each leaves a part of the way, and none of what matters after these.
const SHIFTS: usize = 6;
/// A step shorter than this, radians, is the last: a hundredth of what a light is held still to.
const ARRIVED: f64 = 2e-5;

/// The share of a pixel's radiance that stays in the panorama when its light is taken out: the minimum in
/// Rhee et al. 2017, Eq. 4.
fn kept_share(luminance: f32, threshold: f32) -> f32 {
    if luminance > threshold { threshold / luminance } else { 1.0 }
}

/// Candidates of one frame, strongest first after [`Candidates::collect`]; the buffer is reused.
pub(super) struct Candidates {
    list: Vec<Candidate>,
}

impl Candidates {
    /// Room for the candidates of `regions` regions, so that no frame allocates.
    pub(super) fn new(regions: usize) -> Self {
        Self { list: Vec::with_capacity(regions) }
    }

    /// Measures every region: Eq. 4 of Rhee et al. 2017 for each of its texels, with `luma` as luminance.
    /// Regions without any excess over the threshold are left out.
    pub(super) fn collect(&mut self, panorama: &Panorama, regions: &Regions, luma: Vec3, threshold: f32) {
        self.list.clear();
        let excess = Excess { panorama, regions, luma, threshold, left_out: None, arch: Arch::new() };
        self.list.extend((0..regions.len()).map(|region| excess.measure(region)));
        self.list.retain(|candidate| candidate.strength > 0.0);
        self.list.sort_unstable_by(|a, b| b.strength.total_cmp(&a.strength));
    }

    /// Candidates, strongest first.
    pub(super) fn list(&self) -> &[Candidate] {
        &self.list
    }

    /// Takes the light of the first `chosen` candidates out of the panorama; all others stay in it.
    pub(super) fn take_out(&self, chosen: usize, panorama: &mut Panorama, regions: &Regions, luma: Vec3, threshold: f32) {
        for candidate in self.list.iter().take(chosen) {
            let width = panorama.size.width as usize;
            for texel in regions.runs(candidate.region).iter().flat_map(|run| run.texels(width)) {
                let radiance = panorama.radiance(texel);
                panorama.set_radiance(texel, radiance * kept_share(radiance.dot(luma), threshold));
            }
        }
    }
}

/// What candidates are parts of: the light above a threshold.
#[derive(Clone, Copy)]
pub(super) struct Excess<'a> {
    pub(super) panorama: &'a Panorama,
    /// Above the threshold.
    pub(super) regions: &'a Regions,
    pub(super) luma: Vec3,
    pub(super) threshold: f32,
    /// Texels whose value exceeds the number have no say.
    pub(super) left_out: Option<(&'a [f32], f32)>,
    pub(super) arch: Arch,
}

impl<'a> Excess<'a> {
    /// A region of it, without what is left out: Eq. 4 of Rhee et al. 2017.
    fn measure(&self, region: usize) -> Candidate {
        self.arch.dispatch(Measure { excess: self, region })
    }

    /// A candidate without what is left out.
    pub(super) fn rest(&self, candidate: &Candidate) -> Candidate {
        self.measure(candidate.region)
    }

    /// The runs of a candidate's region.
    pub(super) fn runs(&self, candidate: &Candidate) -> &'a [Run] {
        self.regions.runs(candidate.region)
    }

    /// Direction of a candidate's core, where shadows come from: the centroid of what lies within twice the radius of its effective solid angle,
    /// found by mean shift from the centroid of all (Comaniciu & Meer 2002). An even disc is its own core; of a sun that runs together with a
    /// bright cloud, or a lamp with a window, it is the sun or the lamp. The rest of the region's dipole stays in the SH.
    pub(super) fn core(&self, candidate: &Candidate) -> DVec3 {
        // Texels of one hemisphere cannot cancel out, except on its rim; straight up is as good as any then.
        let mut core = candidate.direction.try_normalize().unwrap_or(DVec3::Y);
        for _ in 0..SHIFTS {
            let shifted = self.near(candidate, core, CORE_RADII * candidate.radius());
            let before = core;
            core = shifted.try_normalize().unwrap_or(core);
            if before.distance_squared(core) < ARRIVED * ARRIVED {
                break;
            }
        }
        core
    }

    /// Sum of the directions of what lies within `radius` of `towards`, by strength.
    pub(super) fn near(&self, candidate: &Candidate, towards: DVec3, radius: f64) -> DVec3 {
        let cosine = radius.min(std::f64::consts::PI).cos() as f32;
        self.arch.dispatch(Centroid { excess: self, region: candidate.region, towards: towards.as_vec3(), cosine })
    }
}

/// What `left_out` says of a run's texels.
#[inline(always)]
fn of_run<'a>(left_out: Option<(&'a [f32], f32)>, texels: &std::ops::Range<usize>) -> Option<(&'a [f32], f32)> {
    left_out.map(|(values, most)| (&values[texels.clone()], most))
}

/// [`Excess::measure`] for whatever vectors there are.
struct Measure<'a> {
    excess: &'a Excess<'a>,
    region: usize,
}

impl WithSimd for Measure<'_> {
    type Output = Candidate;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Candidate {
        let Excess { panorama, regions, luma, threshold, left_out, .. } = *self.excess;
        let geometry = &panorama.geometry;
        let mut sum = Candidate {
            region: self.region,
            irradiance: DVec3::ZERO,
            strength: 0.0,
            kept: DVec3::ZERO,
            direction: DVec3::ZERO,
            angles: (0.0, 0.0),
            solid_angle_sr: 0.0,
            concentration: 0.0,
        };
        let (zero, one, least) = (simd.splat_f32s(0.0), simd.splat_f32s(1.0), simd.splat_f32s(threshold));
        let luma = [simd.splat_f32s(luma.x), simd.splat_f32s(luma.y), simd.splat_f32s(luma.z)];
        for run in regions.runs(self.region) {
            let (row, columns, texels) = (run.row as usize, run.columns(), run.texels(panorama.size.width as usize));
            let channels = [0, 1, 2].map(|channel: usize| &panorama.channels[channel][texels.clone()]);
            let [sines, cosines] = geometry.sin_cos_longitude.each_ref().map(|table| &table[columns.clone()]);
            let longitudes = &geometry.longitude[columns.clone()];
            let left_out = of_run(left_out, &texels);
            let (mut irradiance, mut kept, mut moments, mut count, mut squares) = ([zero; 3], [zero; 3], [zero; 4], zero, zero);
            for vector in 0..vectors::<S>(columns.len()) {
                let radiance = [load(simd, channels[0], vector), load(simd, channels[1], vector), load(simd, channels[2], vector)];
                let luminance = simd.add_f32s(
                    simd.add_f32s(simd.mul_f32s(luma[0], radiance[0]), simd.mul_f32s(luma[1], radiance[1])),
                    simd.mul_f32s(luma[2], radiance[2]),
                );
                // The share that stays in the panorama: the minimum in Eq. 4.
                let mut stands_out = simd.greater_than_f32s(luminance, least);
                if let Some((values, most)) = left_out {
                    let counts = simd.less_than_or_equal_f32s(load(simd, values, vector), simd.splat_f32s(most));
                    stands_out = simd.and_m32s(stands_out, counts);
                }
                let share = simd.select_f32s(stands_out, simd.div_f32s(least, luminance), zero);
                let over = simd.select_f32s(stands_out, simd.sub_f32s(one, share), zero);
                for channel in 0..3 {
                    irradiance[channel] = simd.add_f32s(irradiance[channel], simd.mul_f32s(radiance[channel], over));
                    kept[channel] = simd.add_f32s(kept[channel], simd.mul_f32s(radiance[channel], share));
                }
                let strength = simd.mul_f32s(luminance, over);
                let tables = [one, load(simd, sines, vector), load(simd, cosines, vector), load(simd, longitudes, vector)];
                for (moment, table) in moments.iter_mut().zip(tables) {
                    *moment = simd.add_f32s(*moment, simd.mul_f32s(strength, table));
                }
                count = simd.add_f32s(count, simd.select_f32s(stands_out, one, zero));
                squares = simd.add_f32s(squares, simd.mul_f32s(strength, strength));
            }
            let texel_sr = f64::from(geometry.solid_angle_sr[row]);
            let mut total = [0.0; 12];
            let all = [
                irradiance[0],
                irradiance[1],
                irradiance[2],
                kept[0],
                kept[1],
                kept[2],
                moments[0],
                moments[1],
                moments[2],
                moments[3],
                count,
                squares,
            ];
            for (total, sums) in total.iter_mut().zip(all) {
                *total = f64::from(simd.reduce_sum_f32s(sums)) * texel_sr;
            }
            let [red, green, blue, kept_red, kept_green, kept_blue, strength, of_sine, of_cosine, of_longitude, solid_angle_sr, squares] =
                total;
            let (sine, cosine) = geometry.sin_cos_latitude[row];
            sum.irradiance += DVec3::new(red, green, blue);
            sum.kept += DVec3::new(kept_red, kept_green, kept_blue);
            sum.strength += strength;
            sum.direction += DVec3::new(f64::from(cosine) * of_sine, f64::from(sine) * strength, -f64::from(cosine) * of_cosine);
            sum.angles.0 += of_longitude;
            sum.angles.1 += strength * f64::from(geometry.latitude[row]);
            sum.solid_angle_sr += solid_angle_sr;
            // Strength² over solid angle.
            sum.concentration += squares;
        }
        sum
    }
}

/// The excess of a region within an angle of a direction, times its directions.
struct Centroid<'a> {
    excess: &'a Excess<'a>,
    region: usize,
    towards: Vec3,
    /// Of the angle.
    cosine: f32,
}

impl WithSimd for Centroid<'_> {
    type Output = DVec3;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> DVec3 {
        let Excess { panorama, regions, luma, threshold, left_out, .. } = *self.excess;
        let geometry = &panorama.geometry;
        let (zero, least, bound) = (simd.splat_f32s(0.0), simd.splat_f32s(threshold), simd.splat_f32s(self.cosine));
        let luma = [simd.splat_f32s(luma.x), simd.splat_f32s(luma.y), simd.splat_f32s(luma.z)];
        let mut sum = DVec3::ZERO;
        for run in regions.runs(self.region) {
            let (row, columns, texels) = (run.row as usize, run.columns(), run.texels(panorama.size.width as usize));
            let channels = [0, 1, 2].map(|channel: usize| &panorama.channels[channel][texels.clone()]);
            let [sines, cosines] = geometry.sin_cos_longitude.each_ref().map(|table| &table[columns.clone()]);
            let left_out = of_run(left_out, &texels);
            let (sine, cosine) = geometry.sin_cos_latitude[row];
            // The cosine of the angle to a texel is that of its row, and what its column adds.
            let across = [simd.splat_f32s(cosine * self.towards.x), simd.splat_f32s(-cosine * self.towards.z)];
            let of_row = simd.splat_f32s(sine * self.towards.y);
            let mut moments = [zero; 3];
            for vector in 0..vectors::<S>(columns.len()) {
                let luminance = simd.add_f32s(
                    simd.add_f32s(
                        simd.mul_f32s(luma[0], load(simd, channels[0], vector)),
                        simd.mul_f32s(luma[1], load(simd, channels[1], vector)),
                    ),
                    simd.mul_f32s(luma[2], load(simd, channels[2], vector)),
                );
                let (of_sine, of_cosine) = (load(simd, sines, vector), load(simd, cosines, vector));
                let near = simd.add_f32s(of_row, simd.add_f32s(simd.mul_f32s(across[0], of_sine), simd.mul_f32s(across[1], of_cosine)));
                let mut counts = simd.and_m32s(simd.greater_than_or_equal_f32s(near, bound), simd.greater_than_f32s(luminance, least));
                if let Some((values, most)) = left_out {
                    let within = simd.less_than_or_equal_f32s(load(simd, values, vector), simd.splat_f32s(most));
                    counts = simd.and_m32s(counts, within);
                }
                let excess = simd.select_f32s(counts, simd.sub_f32s(luminance, least), zero);
                moments[0] = simd.add_f32s(moments[0], excess);
                moments[1] = simd.add_f32s(moments[1], simd.mul_f32s(excess, of_sine));
                moments[2] = simd.add_f32s(moments[2], simd.mul_f32s(excess, of_cosine));
            }
            let texel_sr = f64::from(geometry.solid_angle_sr[row]);
            let all = f64::from(simd.reduce_sum_f32s(moments[0])) * texel_sr;
            let of_sine = f64::from(simd.reduce_sum_f32s(moments[1])) * texel_sr;
            let of_cosine = f64::from(simd.reduce_sum_f32s(moments[2])) * texel_sr;
            sum += DVec3::new(f64::from(cosine) * of_sine, f64::from(sine) * all, -f64::from(cosine) * of_cosine);
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use mr360_protocol::light::Lift;

    use super::*;
    use crate::lighting::regions::Topology;
    use crate::lighting::sampling::Grid;

    #[test]
    fn regions_without_excess_are_no_candidates() {
        let mut panorama = Panorama::new(Grid { width: 8, height: 4, supersample: 1 }, Lift::Linear);
        panorama.set_radiance(9, Vec3::splat(3.0));
        panorama.set_radiance(13, Vec3::splat(1.0));
        // As after a blur, the mask has texels that are not above the threshold themselves.
        let mut mask = [0.0; 32];
        for texel in [8, 9, 13] {
            mask[texel] = 1.0;
        }
        let mut regions = Regions::new(8, 4);
        regions.find(8, &mask, Topology::Flat, |v| v > 0.5);
        let mut candidates = Candidates::new(regions.len());
        candidates.collect(&panorama, &regions, Vec3::splat(1.0 / 3.0), 2.0);
        let [only] = candidates.list() else { panic!("{:?}", candidates.list()) };
        let texel_sr = f64::from(panorama.geometry.solid_angle_sr[1]);
        assert!((only.kept / texel_sr - 2.0).abs().max_element() < 1e-6, "{only:?}");
        // Eq. 4: 3 − 3·min(1, 2/3), and the texel beside it adds neither light nor size.
        assert!((only.irradiance / texel_sr - 1.0).abs().max_element() < 1e-6, "{only:?}");
        assert!(
            (only.solid_angle_sr - texel_sr).abs() < 1e-9 && (only.effective_solid_angle_sr() / texel_sr - 1.0).abs() < 1e-6,
            "{only:?}"
        );
        candidates.take_out(1, &mut panorama, &regions, Vec3::splat(1.0 / 3.0), 2.0);
        assert_eq!([8, 9, 13].map(|texel| panorama.radiance(texel).y), [0.0, 2.0, 1.0]);
    }
}
