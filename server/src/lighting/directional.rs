//! The product's own method: what stands out of the upper hemisphere becomes at most [`MOST_LIGHTS`] lights, all
//! else SH.
//!
//! Differences from the paper's method: display-linear radiance instead of the inverse tone map's, clipped light recovered from what surrounds it
//! ([`super::recovery`]) and its regions told apart ([`super::clipped`]), statistics weighted by solid angle, a threshold that cannot pass the brightest texel,
//! regions that are whole across the seam and the zenith, directions averaged as vectors, lights only where they matter to
//! the frame, and lights that are followed over time ([`super::track`]): what a frame shows is an observation, what is sent
//! keeps its identity, moves and fades.

use glam::Vec3;
use mr360_protocol::light::{Lift, MAX_GAIN_LN, Recovery, SH25};
use mr360_shaders::colour::{LUMA, recovery_tint};
use mr360_shaders::sh::basis25;

use super::candidates::Candidates;
use super::clipped::{self, Clipped, Sky};
use super::luminance::{Luminance, Statistics};
use super::panorama::Panorama;
use super::recovery::{Recovered, Recoverer};
use super::regions::{Regions, Topology, most_regions};
use super::sampling::Grid;
use super::series::Series;
use super::track::{Bounds, Coarse, MOST_OBSERVATIONS, Observation, Tracker, View};
use super::{Estimate, Hidden, LightError, LightMethod, StepTimes};
use crate::frame::Frame;

/// Working panorama.
pub(super) const SIZE: Grid = Grid { width: 512, height: 256, supersample: 2 };
/// Most lights of a frame.
pub const MOST_LIGHTS: usize = 8;
/// A region is a light from this share of the upper hemisphere's energy on: its shadow takes at most twice that share
/// off an open ground. The brighter middle of a standard overcast sky stands at 0.031, the specks that any threshold
/// finds in an even noisy sky far below.
const LEAST_SHARE: f64 = 0.04;
/// A light is kept down to this share: its shadow takes at most 4 % off, twice the least contrast that is seen
/// (Weber's 2 %), and fades there. Half of [`LEAST_SHARE`], so that nothing short of a halving makes a light come and go.
const LAST_SHARE: f64 = 0.02;

/// A region that stands out is left to its clipped parts when they make up more than this share of it.
const MOSTLY: f64 = 0.5;
/// A region has its core where its strongest clipped part is when they make up at least this share of it.
const CORE: f64 = 0.1;
/// The curve of an LDR frame in which nothing is clipped: no gain to speak of. Viewers then have one kind of curve for the whole stream.
const UNCLIPPED: Recovery = Recovery { gain_ln: -MAX_GAIN_LN, slope: Vec3::ZERO, tint_ln: [0.0; 2] };

/// The default method; see the module.
pub struct Directional {
    panorama: Panorama,
    recoverer: Recoverer,
    series: Series,
    sh: [Vec3; SH25],
    luminance: Luminance,
    regions: Regions,
    candidates: Candidates,
    clipped: Clipped,
    observations: Vec<Observation>,
    coarse: Coarse,
    tracker: Tracker,
    estimate: Estimate,
}

impl Default for Directional {
    fn default() -> Self {
        Self::with_size(SIZE)
    }
}

impl Directional {
    /// On a working panorama of another size, twice as wide as high; see [`super::MethodSpec::make_at`].
    pub(super) fn with_size(size: Grid) -> Self {
        let (width, upper_rows) = (size.width as usize, size.height as usize / 2);
        let (panorama, recoverer) = (Panorama::new(size, Lift::Linear), Recoverer::new(size));
        Self {
            luminance: Luminance::new(&panorama.geometry, recoverer.rows_at_once()),
            panorama,
            recoverer,
            series: Series::new(size, SH25),
            sh: [Vec3::ZERO; SH25],
            regions: Regions::new(width, upper_rows),
            candidates: Candidates::new(most_regions(width, upper_rows)),
            clipped: Clipped::new(most_regions(width, upper_rows)),
            observations: Vec::with_capacity(2 * MOST_OBSERVATIONS),
            coarse: Coarse::default(),
            tracker: Tracker::new(Bounds { birth: LEAST_SHARE, death: LAST_SHARE, lights: MOST_LIGHTS }),
            estimate: Estimate { lights: Vec::with_capacity(MOST_LIGHTS), ..Estimate::default() },
        }
    }
}

impl Directional {
    /// One sweep over the panorama: rows are looked at while they are in the cache.
    fn sample(&mut self, frame: &Frame) -> Result<(), LightError> {
        let Self { panorama, recoverer, luminance, .. } = self;
        recoverer.begin();
        panorama.take_by_rows(frame, recoverer.rows_at_once(), |rows| {
            // True HDR is not recovered.
            if rows.hdr {
                luminance.see(rows);
            } else {
                recoverer.see(rows, luminance);
            }
        })
    }

    /// Recovers what is clipped, and projects all there is then. True HDR holds its highlights already, which may be so bright that it matters
    /// where in a cell they are.
    fn recover(&mut self, steps: &mut StepTimes) -> Option<Recovered> {
        let Self { panorama, recoverer, luminance, series, sh, .. } = self;
        if panorama.is_hdr() {
            steps.time("sh", || series.project(panorama, sh));
            return None;
        }
        steps.time("sh", || recoverer.project(sh));
        let recovered = steps.time("recover", || recoverer.recover(panorama, luminance))?;
        steps.time("sh", || recoverer.project_hidden(series, &recovered, sh));
        Some(recovered)
    }

    /// Observations of what is clipped in the sky; what is moved between them is moved in the SH, too.
    fn find_clipped(&mut self, statistics: &Statistics, recovered: &Recovered) {
        let clipped = &self.recoverer.clipped()[..self.luminance.texels().len()];
        self.regions.find(self.panorama.size.width as usize, clipped, Topology::Panorama, |degree| degree > clipped::INSIDE);
        let sky = Sky {
            panorama: &self.panorama,
            clipped,
            mean: statistics.mean,
            energy: statistics.energy,
            tint: recovery_tint(&recovered.curve),
            sigma: recovered.sigma,
        };
        let sh = &mut self.sh;
        self.clipped.observe(&sky, &self.regions, &mut self.observations, |direction, irradiance| {
            sh.iter_mut().zip(basis25(direction)).for_each(|(sum, basis)| *sum += irradiance.as_vec3() * basis);
        });
    }

    /// Observations of what else stands out. Where a region is clipped for the most part, its clipped parts stand for it; where it is not, it
    /// stands for them.
    fn find_candidates(&mut self, statistics: &Statistics, recovered: Option<&Recovered>, steps: &mut StepTimes) {
        let threshold = statistics.threshold();
        let width = self.panorama.size.width as usize;
        steps.time("regions", || {
            self.regions.find(width, self.luminance.texels(), Topology::Panorama, |luminance| luminance > threshold);
        });
        steps.time("candidates", || {
            self.candidates.collect(&self.panorama, &self.regions, LUMA, threshold);
            let of_clipped = self.observations.len();
            let mut replaced = [false; MOST_OBSERVATIONS];
            for candidate in self.candidates.list().iter().take(MOST_OBSERVATIONS) {
                let (mut clipped, mut hidden_share) = (0.0, 0.0);
                if recovered.is_some() {
                    let degree = self.recoverer.clipped();
                    (clipped, hidden_share) =
                        Candidates::clipped(candidate, &self.panorama, &self.regions, degree, clipped::INSIDE, threshold);
                }
                if clipped > MOSTLY {
                    continue;
                }
                let mut core = None;
                if clipped > 0.0 {
                    let parts = replaced.iter_mut().zip(self.clipped.texels()).zip(&self.observations);
                    for ((replaced, _), part) in parts.filter(|((_, texel), _)| Candidates::holds(candidate, &self.regions, *texel)) {
                        *replaced = true;
                        core = core.or((clipped >= CORE).then_some(part.direction));
                    }
                }
                let core = core.unwrap_or_else(|| Candidates::core(candidate, &self.panorama, &self.regions, LUMA, threshold));
                let sigma = recovered.map_or(0.0, |recovered| f64::from(recovered.sigma) * hidden_share);
                self.observations.push(Observation {
                    direction: core,
                    irradiance: candidate.irradiance,
                    solid_angle_sr: candidate.effective_solid_angle_sr(),
                    share: clipped::likely_share(candidate.strength, statistics.energy, sigma),
                    hidden_share,
                    sigma,
                });
            }
            let mut index = 0..;
            self.observations.retain(|_| index.next().is_some_and(|index| index >= of_clipped || !replaced[index]));
        });
        let luma = LUMA.as_dvec3();
        self.observations.sort_unstable_by(|a, b| b.irradiance.dot(luma).total_cmp(&a.irradiance.dot(luma)));
        self.observations.truncate(MOST_OBSERVATIONS);
    }
}

impl LightMethod for Directional {
    fn name(&self) -> &'static str {
        "directional"
    }

    fn estimate(&mut self, frame: &Frame, steps: &mut StepTimes) -> Result<&Estimate, LightError> {
        steps.time("sample", || self.sample(frame))?;
        let recovered = self.recover(steps);
        let statistics = steps.time("threshold", || self.luminance.statistics());
        self.observations.clear();
        if let Some(recovered) = &recovered {
            steps.time("clipped", || self.find_clipped(&statistics, recovered));
        }
        self.find_candidates(&statistics, recovered.as_ref(), steps);
        steps.time("track", || {
            if self.panorama.is_hdr() {
                self.coarse.take(&self.panorama);
            } else {
                let (cells, columns) = self.recoverer.cells();
                self.coarse.take_cells(cells, columns);
            }
            let view = View {
                pts_us: frame.pts_us,
                coarse: &self.coarse,
                hdr: self.panorama.is_hdr(),
                sh: &self.sh,
                observations: &self.observations,
            };
            self.tracker.track(&view, &mut self.estimate);
        });
        self.estimate.lift = match recovered {
            _ if self.panorama.is_hdr() => Lift::Linear,
            recovered => Lift::Recovered(recovered.map_or(UNCLIPPED, |recovered| recovered.curve)),
        };
        self.estimate.hidden = recovered.map(|recovered| Hidden { share: recovered.hidden_share, sigma: recovered.sigma });
        self.estimate.mended = self.panorama.mended;
        Ok(&self.estimate)
    }
}
