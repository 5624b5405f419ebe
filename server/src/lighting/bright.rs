//! Lights of the bright regions that are not clipped, or only in part.
//!
//! What is clipped is a light by itself ([`super::clipped`]). What else stands out around it is its halo, where the two are one source, and a light
//! of its own, where they are not: a lamp in a bright ceiling, a window beside the sun.

use std::f64::consts::PI;

use glam::{DVec3, Vec3};
use mr360_shaders::colour::LUMA;
use pulp::Arch;

use super::brightest::{Brightest, CAP_RAD};
use super::candidates::{Candidate, Excess, half_angle};
use super::clipped::{Clipped, INSIDE, likely_share};
use super::panorama::{Geometry, Panorama};
use super::regions::{Regions, contain};
use super::track::{MOST_OBSERVATIONS, Observation};

/// A region is left to its clipped parts when they make up more than this share of it.
const MOSTLY: f64 = 0.5;
/// A source is where its clipped part is when that makes up at least this share of it.
const CORE: f64 = 0.1;

/// What the observations are taken out of.
pub(super) struct Scene<'a> {
    /// Recovered.
    pub(super) panorama: &'a Panorama,
    /// Above the threshold.
    pub(super) regions: &'a Regions,
    /// Luminance of the upper hemisphere.
    pub(super) luminance: &'a [f32],
    /// Whether it is true HDR.
    pub(super) hdr: bool,
    /// Degree to which each texel is clipped; `None` in a frame that does not clip.
    pub(super) clipped: Option<&'a [f32]>,
    /// What exceeds this luminance is light.
    pub(super) threshold: f32,
    /// Mean luminance of the upper hemisphere.
    pub(super) mean: f64,
    /// Luminance times solid angle of the upper hemisphere.
    pub(super) energy: f64,
    /// Colour of what recovery adds, of luminance 1.
    pub(super) tint: Vec3,
    /// Standard deviation of its logarithm.
    pub(super) sigma: f64,
}

/// Finds the lights that are not clipped; the buffer is reused.
pub(super) struct Bright {
    sources: Vec<Source>,
    brightest: Brightest,
}

/// What is bright and not clipped in a candidate.
struct Source {
    candidate: Candidate,
    /// Without what is clipped.
    rest: Candidate,
    direction: DVec3,
    irradiance: DVec3,
    /// What of its strength recovery added, to single channels or on the way to white.
    hidden: f64,
}

impl Bright {
    /// Room for the sources of a frame whose panorama has this geometry.
    pub(super) fn new(geometry: &Geometry) -> Self {
        Self { sources: Vec::with_capacity(MOST_OBSERVATIONS), brightest: Brightest::new(geometry) }
    }

    /// Measures the candidates, and takes the share `pooled` off what recovery gave their single channels; returns how much that is.
    /// `moved` is told its direction and irradiance.
    pub(super) fn measure(&mut self, scene: &Scene<'_>, candidates: &[Candidate], pooled: f64, mut moved: impl FnMut(Vec3, DVec3)) -> f64 {
        self.sources.clear();
        let mut given = 0.0;
        for candidate in candidates.iter().take(MOST_OBSERVATIONS) {
            let rest = scene.rest(candidate);
            if rest.strength <= 0.0 || rest.strength < (1.0 - MOSTLY) * candidate.strength {
                continue;
            }
            let direction = self.brightest.direction(scene, &rest);
            let (hidden, of_channels) = scene.hidden(&rest);
            let mut source = Source { candidate: *candidate, rest, direction, irradiance: rest.irradiance, hidden };
            let change = pooled * of_channels;
            if change > 0.0 {
                let irradiance = scene.tint.as_dvec3() * change;
                moved(direction.as_vec3(), -irradiance);
                source.irradiance = (source.irradiance - irradiance).max(DVec3::ZERO);
                source.hidden -= change;
                given += change;
            }
            self.sources.push(source);
        }
        given
    }

    /// Adds an observation for each source to those of the clipped regions, or makes one of two that are the same. Strongest first, at
    /// most [`MOST_OBSERVATIONS`].
    pub(super) fn observe(&self, scene: &Scene<'_>, clipped: &Clipped, observations: &mut Vec<Observation>) {
        let of_clipped = observations.len();
        for source in &self.sources {
            let reach = source.rest.radius();
            let (runs, width) = (scene.excess(None).runs(&source.rest), scene.panorama.size.width as usize);
            let mut whole = source.observation(scene);
            let mut middle = DVec3::ZERO;
            for (part, texel) in observations[..of_clipped].iter_mut().zip(clipped.texels()) {
                let near = (reach + half_angle(part.solid_angle_sr)).min(PI).cos();
                if part.share > 0.0 && part.direction.dot(source.direction) > near && contain(runs, width, texel as usize) {
                    whole = joined(&whole, part);
                    middle += part.direction * strength(part);
                    part.share = 0.0;
                }
            }
            if middle != DVec3::ZERO {
                let of_parts = source.candidate.strength - source.rest.strength;
                let is_core = of_parts >= CORE * source.candidate.strength;
                let core = middle.try_normalize().filter(|_| is_core);
                whole.direction = core.unwrap_or_else(|| scene.excess(None).core(&source.candidate));
            }
            whole.share = likely_share(strength(&whole), scene.energy, whole.sigma);
            observations.push(whole);
        }
        observations.retain(|observation| observation.share > 0.0);
        observations.sort_unstable_by(|a, b| strength(b).total_cmp(&strength(a)));
        observations.truncate(MOST_OBSERVATIONS);
    }
}

impl Brightest {
    /// Direction of what is not clipped in a candidate. Of a wide source in true HDR that is where it is brightest. In LDR, spots along a source differ by
    /// less than the steps and the grain of codes near white, and by nothing where they clip: there the core is what holds still.
    fn direction(&mut self, scene: &Scene<'_>, rest: &Candidate) -> DVec3 {
        let excess = scene.excess(scene.clipped);
        if !scene.hdr || rest.radius() <= CAP_RAD {
            return excess.core(rest);
        }
        let brightest = self.of(&scene.panorama.geometry, scene.luminance, excess.runs(rest));
        excess.near(rest, brightest, 2.0 * CAP_RAD).try_normalize().unwrap_or(brightest)
    }
}

impl<'a> Scene<'a> {
    /// What stands out, without what is clipped to a degree that is given.
    fn excess(&self, clipped: Option<&'a [f32]>) -> Excess<'a> {
        let left_out = clipped.map(|degree| (degree, INSIDE));
        Excess { panorama: self.panorama, regions: self.regions, luma: LUMA, threshold: self.threshold, left_out, arch: Arch::new() }
    }

    fn rest(&self, candidate: &Candidate) -> Candidate {
        if self.clipped.is_some() { self.excess(self.clipped).rest(candidate) } else { *candidate }
    }

    /// What recovery added to the rest of a candidate, which is what is above white; and what of that it added because single channels clip, which
    /// a coloured ceiling has and a sun has not.
    fn hidden(&self, rest: &Candidate) -> (f64, f64) {
        let Some(degree) = self.clipped else { return (0.0, 0.0) };
        let (width, least) = (self.panorama.size.width as usize, self.threshold.max(1.0));
        let (mut all, mut of_channels) = (0.0, 0.0);
        for run in self.excess(None).runs(rest) {
            let texels = run.texels(width);
            let (mut of_run, mut of_run_channels) = (0.0f32, 0.0f32);
            for (luminance, degree) in self.luminance[texels.clone()].iter().zip(&degree[texels]) {
                let above = if *degree <= INSIDE { (luminance - least).max(0.0) } else { 0.0 };
                let open = 1.0 - degree / INSIDE;
                of_run += above;
                of_run_channels += above * (open * open);
            }
            let texel_sr = f64::from(self.panorama.geometry.solid_angle_sr[run.row as usize]);
            all += f64::from(of_run) * texel_sr;
            of_channels += f64::from(of_run_channels) * texel_sr;
        }
        (all.min(rest.strength), of_channels.min(rest.strength))
    }
}

impl Source {
    /// Without its share.
    fn observation(&self, scene: &Scene<'_>) -> Observation {
        let strength = self.irradiance.dot(LUMA.as_dvec3()).max(f64::MIN_POSITIVE);
        let hidden_share = (self.hidden / strength).min(1.0);
        Observation {
            direction: self.direction,
            irradiance: self.irradiance,
            pedestal: self.rest.kept * (1.0 - scene.mean / f64::from(scene.threshold)).max(0.0),
            solid_angle_sr: self.rest.effective_solid_angle_sr(),
            share: 0.0,
            hidden_share,
            sigma: scene.sigma * hidden_share,
        }
    }
}

fn strength(observation: &Observation) -> f64 {
    observation.irradiance.dot(LUMA.as_dvec3())
}

/// One source that is seen as two, in the direction of the first.
fn joined(a: &Observation, b: &Observation) -> Observation {
    let [of_a, of_b] = [a, b].map(strength);
    let sum = (of_a + of_b).max(f64::MIN_POSITIVE);
    let mean = |x: f64, y: f64| (x * of_a + y * of_b) / sum;
    // (Σ E)² / Σ E²/Ω, as for texels.
    let concentration = of_a * of_a / a.solid_angle_sr + of_b * of_b / b.solid_angle_sr;
    Observation {
        irradiance: a.irradiance + b.irradiance,
        pedestal: a.pedestal + b.pedestal,
        solid_angle_sr: sum * sum / concentration,
        hidden_share: mean(a.hidden_share, b.hidden_share),
        sigma: mean(a.sigma, b.sigma),
        ..*a
    }
}
