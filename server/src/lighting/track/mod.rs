//! Lights over time: what frames show one by one becomes lights that last.
//!
//! The tracker knows neither where observations come from nor what time it is: it is given what a frame shows and the
//! frame's presentation time, and says what to send. Intensities are tracked in canonical exposure, with the camera's
//! gain divided out ([`exposure`]); gain, intensity and direction are each followed by a [`follow::Follower`]; of a light that is clipped now
//! and was not before, what was seen is believed ([`evidence`]);
//! observations find their lights by optimal assignment ([`assign`]); which lights exist, and how much of each is
//! sent, is decided by hysteresis and fades ([`life`]); [`energy`] leaves in the SH exactly what the lights do not hold.

use glam::{DVec3, Vec3};
use mr360_protocol::light::SH25;
use mr360_shaders::colour;

use self::assign::{Costs, MOST};
pub(super) use self::exposure::Coarse;
use self::exposure::Exposure;
use self::follow::{Follower, Manner};
use self::life::Track;
use super::Estimate;

mod assign;
mod energy;
mod evidence;
mod exposure;
mod follow;
mod life;

/// Most observations that a frame may bring.
pub(super) const MOST_OBSERVATIONS: usize = MOST;
/// BT.709 luminance in double precision.
const LUMA: DVec3 = DVec3::new(colour::LUMA.x as f64, colour::LUMA.y as f64, colour::LUMA.z as f64);
/// Exposure: natural logarithm. The median over hundreds of texels is good to a thousandth; automatic exposure and
/// white balance move by less than 3 EV a second unless they jump.
const GAIN: Manner = Manner { gate: 0.015, leap: 0.015, fastest: 3.0, suppress_swings: true };
/// Direction: chord on the unit sphere. A centroid is good to a small part of a 0.7° texel, so 0.2° off is
/// motion; 2° in one frame may be a neighbour that ran into the region and is believed when it stays.
const DIRECTION: Manner = Manner { gate: 0.0035, leap: 0.035, fastest: 4.0, suppress_swings: false };
/// Angle and logarithmic strength that cost an assignment as much as each other.
const ANGLE_UNIT: f64 = 0.0873;
const STRENGTH_UNIT: f64 = 1.0;
/// Standard deviations of a clipped light's strength that count as one unit of it.
const GUESS_UNITS: f64 = 2.0;
/// Cost from which on two are not the same light: 10° off, or seven times as strong.
const GATE_COST: f64 = 4.0;
/// Gaps longer than this say nothing about where lights have gone: as after a cut.
const LONGEST_GAP_S: f64 = 2.0;

/// A light as one frame shows it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Observation {
    /// Unit vector towards it.
    pub(super) direction: DVec3,
    /// Irradiance on a surface facing it.
    pub(super) irradiance: DVec3,
    /// What it holds beyond that, between the mean of the upper hemisphere and the threshold from which on a light is taken out.
    pub(super) pedestal: DVec3,
    /// Solid angle.
    pub(super) solid_angle_sr: f64,
    /// Its share of the energy of the upper hemisphere; of a clipped one, what it may be within a standard deviation.
    pub(super) share: f64,
    /// Part of its strength that was clipped and is estimated.
    pub(super) hidden_share: f64,
    /// Standard deviation of the logarithm of its strength for that.
    pub(super) sigma: f64,
}

/// What a frame shows.
pub(super) struct View<'a> {
    /// Presentation time of the frame.
    pub(super) pts_us: u64,
    /// The frame at 64×32, lights included.
    pub(super) coarse: &'a Coarse,
    /// Whether its radiance is the scene's, without lift and clipping.
    pub(super) hdr: bool,
    /// SH of the whole frame, lights included.
    pub(super) sh: &'a [Vec3; SH25],
    /// Candidates, strongest first, at most [`MOST_OBSERVATIONS`].
    pub(super) observations: &'a [Observation],
}

/// When an observation is a light.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    /// A light is born from this share of the energy on.
    pub(super) birth: f64,
    /// It dies below this share.
    pub(super) death: f64,
    /// Most lights sent.
    pub(super) lights: usize,
}

/// Lights over time; see the module. Allocates in the first frame only.
pub(super) struct Tracker {
    bounds: Bounds,
    exposure: Exposure,
    gain: Option<Follower>,
    tracks: Vec<Track>,
    last_pts_us: Option<u64>,
    next_id: u32,
    lights: energy::Lights,
}

/// Exposure of a frame and the one that is sent, as factors on canonical radiance.
#[derive(Debug, Clone, Copy)]
struct Gains {
    measured: DVec3,
    sent: DVec3,
}

impl Tracker {
    /// A tracker that has seen nothing.
    pub(super) fn new(bounds: Bounds) -> Self {
        Self {
            bounds,
            exposure: Exposure::default(),
            gain: None,
            tracks: Vec::with_capacity(MOST),
            last_pts_us: None,
            next_id: 0,
            lights: energy::Lights::default(),
        }
    }

    /// Takes a frame and writes the lights and SH to send. A frame that is not later than the last one begins a new
    /// stream, with identities counted from 0.
    pub(super) fn track(&mut self, view: &View<'_>, estimate: &mut Estimate) {
        let dt_s = self.last_pts_us.and_then(|last| view.pts_us.checked_sub(last)).map_or(0.0, |us| us as f64 * 1e-6);
        self.last_pts_us = Some(view.pts_us);
        if dt_s <= 0.0 {
            self.next_id = 0;
        }
        if dt_s <= 0.0 || dt_s > LONGEST_GAP_S {
            self.forget();
        }
        let (gains, fresh) = self.expose(view, dt_s);
        let matched = self.assign(view, gains, dt_s);
        let shown = life::Shown { observations: view.observations, matched, gains, dt_s };
        life::observe(&mut self.tracks, &shown, self.bounds);
        life::decide(&mut self.tracks, self.bounds, &mut self.next_id, if fresh { None } else { Some(dt_s) });
        self.lights.send(&self.tracks, view, gains, self.bounds.lights, estimate);
    }

    fn forget(&mut self) {
        self.exposure.reset();
        self.gain = None;
        self.tracks.clear();
        self.lights.reset();
    }

    /// Follows the exposure. The second value is whether nothing is known from before: the first frame, or a cut.
    fn expose(&mut self, view: &View<'_>, dt_s: f64) -> (Gains, bool) {
        let mut change = self.exposure.measure(view.coarse, view.hdr, dt_s);
        if change.cut {
            self.forget();
            change = self.exposure.measure(view.coarse, view.hdr, dt_s);
        }
        let fresh = self.gain.is_none();
        let gain = self.gain.get_or_insert_with(|| Follower::new(change.gain));
        if !fresh {
            gain.observe(&GAIN, change.gain, dt_s);
        }
        (Gains { measured: change.gain.exp(), sent: gain.value().exp() }, fresh)
    }

    /// The observation of each track.
    fn assign(&self, view: &View<'_>, gains: Gains, dt_s: f64) -> [Option<usize>; MOST] {
        let mut costs: Costs = [[GATE_COST; MOST]; MOST];
        for (row, track) in costs.iter_mut().zip(&self.tracks) {
            let direction = track.direction.predicted(dt_s).try_normalize().unwrap_or(DVec3::Y);
            let strength = life::strength_ln(track.intensity.predicted(dt_s));
            // The centroid of a wide light moves with its edges.
            let unit = ANGLE_UNIT + 0.5 * track.radius();
            for (cost, seen) in row.iter_mut().zip(view.observations) {
                let angle = 2.0 * (0.5 * (seen.direction - direction).length()).min(1.0).asin() / unit;
                // A guess may be several of its deviations off and still be of the same light.
                let unit_ln = STRENGTH_UNIT.hypot(GUESS_UNITS * seen.sigma);
                let ratio = (life::strength_ln(life::canonical(seen.irradiance, gains)) - strength) / unit_ln;
                *cost = (angle * angle + ratio * ratio).min(GATE_COST);
            }
        }
        let columns = assign::assign(&costs);
        std::array::from_fn(|row| Some(columns[row]).filter(|column| costs[row][*column] < GATE_COST))
    }
}
