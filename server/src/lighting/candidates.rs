//! Regions brighter than a threshold as candidates for lights, and what is left once the chosen ones are out.

use glam::{DVec3, Vec3};

use super::panorama::Panorama;
use super::regions::Regions;

/// A region's light before it is decided whether it becomes one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    region: usize,
    /// Irradiance, the sum of Eq. 4 over the region.
    pub(super) irradiance: DVec3,
    /// Luminance of that irradiance.
    pub(super) strength: f64,
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
/// Steps of the mean shift; each leaves a part of the way, and none of what matters after these.
const SHIFTS: usize = 6;

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
        self.list.extend(regions.iter().enumerate().map(|(region, members)| measure(panorama, region, members.iter(), luma, threshold)));
        self.list.retain(|candidate| candidate.strength > 0.0);
        self.list.sort_unstable_by(|a, b| b.strength.total_cmp(&a.strength));
    }

    /// Candidates, strongest first.
    pub(super) fn list(&self) -> &[Candidate] {
        &self.list
    }

    /// A candidate without its texels of which `left_out` is true.
    pub(super) fn without(
        candidate: &Candidate,
        panorama: &Panorama,
        regions: &Regions,
        luma: Vec3,
        threshold: f32,
        left_out: impl Fn(usize) -> bool,
    ) -> Candidate {
        let members = regions.members(candidate.region).iter().filter(|texel| !left_out(**texel as usize));
        measure(panorama, candidate.region, members, luma, threshold)
    }

    /// The texels of a candidate's region.
    pub(super) fn members<'a>(candidate: &Candidate, regions: &'a Regions) -> &'a [u32] {
        regions.members(candidate.region)
    }

    /// Direction of a candidate's core, where shadows come from: the centroid of what lies within twice the radius of its effective solid angle,
    /// found by mean shift from the centroid of all (Comaniciu & Meer 2002). An even disc is its own core; of a sun that runs together with a
    /// bright cloud, or a lamp with a window, it is the sun or the lamp. The rest of the region's dipole stays in the SH. Texels of which
    /// `left_out` is true have no say.
    pub(super) fn core(
        candidate: &Candidate,
        panorama: &Panorama,
        regions: &Regions,
        luma: Vec3,
        threshold: f32,
        left_out: impl Fn(usize) -> bool,
    ) -> DVec3 {
        // Texels of one hemisphere cannot cancel out, except on its rim; straight up is as good as any then.
        let mut core = candidate.direction.try_normalize().unwrap_or(DVec3::Y);
        let radius = candidate.radius();
        let width = panorama.size.width as usize;
        let cosine = (CORE_RADII * radius).min(std::f64::consts::PI).cos() as f32;
        for _ in 0..SHIFTS {
            let (mut sum, towards) = (DVec3::ZERO, core.as_vec3());
            for texel in regions.members(candidate.region) {
                let texel = *texel as usize;
                let direction = panorama.geometry.direction(texel / width, texel % width);
                if direction.dot(towards) >= cosine && !left_out(texel) {
                    let excess = (panorama.radiance(texel).dot(luma) - threshold).max(0.0);
                    sum += direction.as_dvec3() * f64::from(excess * panorama.geometry.solid_angle_sr[texel / width]);
                }
            }
            core = sum.try_normalize().unwrap_or(core);
        }
        core
    }

    /// Takes the light of the first `chosen` candidates out of the panorama; all others stay in it.
    pub(super) fn take_out(&self, chosen: usize, panorama: &mut Panorama, regions: &Regions, luma: Vec3, threshold: f32) {
        for candidate in self.list.iter().take(chosen) {
            for texel in regions.members(candidate.region) {
                let texel = *texel as usize;
                let radiance = panorama.radiance(texel);
                panorama.set_radiance(texel, radiance * kept_share(radiance.dot(luma), threshold));
            }
        }
    }
}

fn measure<'a>(panorama: &Panorama, region: usize, members: impl Iterator<Item = &'a u32>, luma: Vec3, threshold: f32) -> Candidate {
    let mut sum = Candidate {
        region,
        irradiance: DVec3::ZERO,
        strength: 0.0,
        direction: DVec3::ZERO,
        angles: (0.0, 0.0),
        solid_angle_sr: 0.0,
        concentration: 0.0,
    };
    let width = panorama.size.width as usize;
    for texel in members {
        let texel = *texel as usize;
        let (row, column) = (texel / width, texel % width);
        let radiance = panorama.radiance(texel);
        let share = kept_share(radiance.dot(luma), threshold);
        if share >= 1.0 {
            continue;
        }
        let solid_angle_sr = f64::from(panorama.geometry.solid_angle_sr[row]);
        let irradiance = (radiance - radiance * share).as_dvec3() * solid_angle_sr;
        let strength = irradiance.dot(luma.as_dvec3());
        sum.irradiance += irradiance;
        sum.strength += strength;
        sum.direction += strength * panorama.geometry.direction(row, column).as_dvec3();
        sum.angles.0 += strength * f64::from(panorama.geometry.longitude[column]);
        sum.angles.1 += strength * f64::from(panorama.geometry.latitude[row]);
        sum.solid_angle_sr += solid_angle_sr;
        sum.concentration += strength * strength / solid_angle_sr;
    }
    sum
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
