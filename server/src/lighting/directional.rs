//! The product's own method: what stands out of the upper hemisphere becomes at most [`MOST_LIGHTS`] lights, all
//! else SH.
//!
//! Differences from the paper's method: display-linear radiance instead of the inverse tone map's, clipped light recovered from what surrounds it
//! ([`super::recovery`]) and its regions told apart ([`super::clipped`]), statistics weighted by solid angle, a threshold that cannot pass the brightest texel,
//! regions that are whole across the seam and the zenith, directions averaged as vectors, lights only where they matter to
//! the frame, and lights that are followed over time ([`super::track`]): what a frame shows is an observation, what is sent
//! keeps its identity, moves and fades.

use glam::{DVec3, Vec3};
use mr360_protocol::light::{Lift, MAX_GAIN_LN, Recovery, SH25};
use mr360_shaders::colour::{LUMA, recovery_tint};
use mr360_shaders::sh::basis25;

use super::bright::{Bright, Scene};
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
/// A light is kept down to this part of that share: its shadow takes at most 4 % off, twice the least contrast that is seen
/// (Weber's 2 %), and fades there. Nothing short of a halving then makes a light come and go.
const KEPT: f64 = 0.5;

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
    bright: Bright,
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
        Self::new(size, LEAST_SHARE)
    }

    /// With lights from this share of the upper hemisphere's energy on; see [`super::MethodSpec::make_from`].
    pub(super) fn with_least_share(share: f64) -> Self {
        Self::new(SIZE, share)
    }

    fn new(size: Grid, least_share: f64) -> Self {
        let (width, upper_rows) = (size.width as usize, size.height as usize / 2);
        let (panorama, recoverer) = (Panorama::new(size, Lift::Linear).keep_upper_half(), Recoverer::new(size));
        Self {
            luminance: Luminance::new(&panorama.geometry, recoverer.rows_at_once()),
            bright: Bright::new(&panorama.geometry),
            panorama,
            recoverer,
            series: Series::new(size, SH25),
            sh: [Vec3::ZERO; SH25],
            regions: Regions::new(width, upper_rows),
            candidates: Candidates::new(most_regions(width, upper_rows)),
            clipped: Clipped::new(width, upper_rows),
            observations: Vec::with_capacity(2 * MOST_OBSERVATIONS),
            coarse: Coarse::default(),
            tracker: Tracker::new(Bounds { birth: least_share, death: KEPT * least_share, lights: MOST_LIGHTS }),
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

    /// Observations of what is clipped in the upper hemisphere and of what else stands out of it. What is moved between them is moved in the SH, too.
    fn observe(&mut self, statistics: &Statistics, recovered: Option<&Recovered>, steps: &mut StepTimes) {
        let width = self.panorama.size.width as usize;
        let degree = &self.recoverer.clipped()[..self.luminance.texels().len()];
        let curve = recovered.map(|recovered| recovered.curve);
        let sky = Sky {
            panorama: &self.panorama,
            clipped: degree,
            density: self.recoverer.density(),
            mean: statistics.mean,
            energy: statistics.energy,
            tint: curve.map_or(Vec3::ONE, |curve| recovery_tint(&curve)),
            sigma: recovered.map_or(0.0, |recovered| recovered.sigma),
        };
        self.clipped.clear();
        if recovered.is_some() {
            steps.time("clipped", || {
                self.regions.find(width, degree, Topology::Panorama, |degree| degree > clipped::INSIDE);
                self.clipped.measure(&sky, &self.regions);
            });
        }
        let threshold = statistics.threshold();
        steps.time("regions", || {
            self.regions.find(width, self.luminance.texels(), Topology::Panorama, |luminance| luminance > threshold);
        });
        steps.time("candidates", || {
            self.candidates.collect(&self.panorama, &self.regions, LUMA, threshold);
            let scene = Scene {
                panorama: &self.panorama,
                regions: &self.regions,
                luminance: self.luminance.texels(),
                hdr: self.panorama.is_hdr(),
                clipped: recovered.map(|_| degree),
                threshold,
                mean: statistics.mean,
                energy: statistics.energy,
                tint: sky.tint,
                sigma: f64::from(sky.sigma),
            };
            let sh = &mut self.sh;
            let mut moved = |direction: Vec3, irradiance: DVec3| {
                sh.iter_mut().zip(basis25(direction)).for_each(|(sum, basis)| *sum += irradiance.as_vec3() * basis);
            };
            let given = self.bright.measure(&scene, self.candidates.list(), self.clipped.pooled(), &mut moved);
            self.clipped.observe(&sky, given, &mut self.observations, &mut moved);
            self.bright.observe(&scene, &self.clipped, &mut self.observations);
        });
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
        self.observe(&statistics, recovered.as_ref(), steps);
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
