//! Which lights exist, and how much of each is sent.
//!
//! A light is born when its share of the energy has exceeded the upper bound for [`HOLD_S`], and dies when it has been
//! below the lower bound, or out of sight, for as long; in the first frame and after a cut births are immediate. What is
//! sent fades in and out over [`FADE_S`], the rest is in the SH. When two lights run together, the one that
//! is left holds the energy of both: it is sent without what the other, still fading out, holds. A split is
//! the same backwards. In either case the light that falls on any surface passes from one to two sources without a step.

use glam::DVec3;

use super::assign::MOST;
use super::evidence::Evidence;
use super::follow::{Follower, Manner};
use super::{Bounds, DIRECTION, Gains, LUMA, Observation};

/// Time for which a birth or death must be asked for: two frames at 30 a second, so that neither a flash nor a
/// single bad frame makes one.
const HOLD_S: f64 = 0.05;
/// Time in which a light fades.
const FADE_S: f64 = 0.2;
/// Time constant of the solid angle, which only softens shadows.
const WIDTH_S: f64 = 0.2;
/// Intensity: natural logarithm of each channel. Grain and compression move a small region's energy by about a hundredth.
const INTENSITY: Manner = Manner { gate: 0.05, leap: 0.05, fastest: 8.0, suppress_swings: true };
/// Darkest channel of a light against its brightest, so that a pure colour has a logarithm.
const LEAST_CHANNEL: f64 = 1e-4;
/// A newcomer takes the place of the weakest light, where all are taken, from this ratio of their strengths on.
const DISPLACE: f64 = 1.5;

/// A light over time.
#[derive(Debug, Clone, Copy)]
pub(super) struct Track {
    /// None until its birth.
    pub(super) id: Option<u32>,
    pub(super) direction: Follower,
    /// Logarithm of the irradiance in canonical exposure.
    pub(super) intensity: Follower,
    evidence: Evidence,
    solid_angle_ln: f64,
    /// Of the energy of the upper hemisphere; none while it is out of sight.
    share: f64,
    alive: bool,
    /// For how long the opposite of `alive` has been asked for.
    pending_s: f64,
    /// The share of it that is sent as a light.
    pub(super) weight: f64,
    /// What the current frame shows of it.
    pub(super) seen: Option<Observation>,
    /// The light that it ran into or came out of.
    pub(super) kin: Option<u32>,
}

/// Logarithm of an observed irradiance in canonical exposure.
pub(super) fn canonical(irradiance: DVec3, gains: Gains) -> DVec3 {
    let scene = irradiance / gains.measured;
    let least = (LEAST_CHANNEL * scene.max_element()).max(f64::MIN_POSITIVE);
    scene.max(DVec3::splat(least)).ln()
}

fn evidence(seen: &Observation, gains: Gains) -> Evidence {
    Evidence::new(canonical(seen.irradiance, gains), seen.sigma, gains.measured.dot(LUMA).ln())
}

/// Logarithm of the luminance of such an irradiance.
pub(super) fn strength_ln(intensity: DVec3) -> f64 {
    intensity.exp().dot(LUMA).ln()
}

impl Track {
    fn new(seen: Observation, gains: Gains) -> Self {
        Self {
            id: None,
            direction: Follower::new(seen.direction),
            intensity: Follower::new(canonical(seen.irradiance, gains)),
            evidence: evidence(&seen, gains),
            solid_angle_ln: seen.solid_angle_sr.ln(),
            share: seen.share,
            alive: false,
            pending_s: 0.0,
            weight: 0.0,
            seen: Some(seen),
            kin: None,
        }
    }

    /// Solid angle.
    pub(super) fn solid_angle_sr(&self) -> f64 {
        self.solid_angle_ln.exp()
    }

    /// Half angle of a disc of its solid angle.
    pub(super) fn radius(&self) -> f64 {
        (1.0 - self.solid_angle_sr() / std::f64::consts::TAU).clamp(-1.0, 1.0).acos()
    }

    /// Canonical strength along the direction.
    fn vector(&self, dt_s: f64) -> DVec3 {
        self.direction.predicted(dt_s) * strength_ln(self.intensity.predicted(dt_s)).exp()
    }

    fn observe(&mut self, seen: Observation, gains: Gains, dt_s: f64) {
        self.direction.observe(&DIRECTION, seen.direction, dt_s);
        self.direction.normalize();
        let known = self.evidence.take(&evidence(&seen, gains), seen.hidden_share, dt_s);
        self.intensity.observe(&INTENSITY, known, dt_s);
        // What is known to be stronger than it looks has a larger share.
        // The share of a guess reaches up a standard deviation already.
        let ratio = (strength_ln(known) - strength_ln(canonical(seen.irradiance, gains)) - seen.sigma).exp().max(1.0);
        let share = seen.share * ratio / (1.0 + seen.share * (ratio - 1.0));
        self.solid_angle_ln += (1.0 - (-dt_s / WIDTH_S).exp()) * (seen.solid_angle_sr.ln() - self.solid_angle_ln);
        (self.share, self.seen) = (share, Some(seen));
    }

    /// Takes over an observation at once: the light is not what it was, but a part of it or more than it.
    fn become_seen(&mut self, seen: Observation, gains: Gains) {
        self.direction.jump(seen.direction);
        self.intensity.jump(canonical(seen.irradiance, gains));
        self.evidence = evidence(&seen, gains);
        self.solid_angle_ln = seen.solid_angle_sr.ln();
        (self.share, self.seen) = (seen.share, Some(seen));
    }

    fn miss(&mut self, dt_s: f64) {
        self.direction.coast(dt_s);
        self.direction.normalize();
        // What is out of sight has no share, and stands back behind what is in sight.
        (self.share, self.seen) = (0.0, None);
    }

    /// Hysteresis; `dt_s` is none when nothing is known from before.
    fn decide(&mut self, bounds: Bounds, dt_s: Option<f64>) {
        let asked = if self.alive { self.share < bounds.death } else { self.share >= bounds.birth };
        self.pending_s = if asked { self.pending_s + dt_s.unwrap_or(HOLD_S) } else { 0.0 };
        // Half a microsecond for the sum of rounded frame times.
        if asked && self.pending_s + 5e-7 >= HOLD_S {
            (self.alive, self.pending_s) = (!self.alive, 0.0);
        }
        let fade = dt_s.map_or(1.0, |dt_s| dt_s / FADE_S);
        self.weight = (self.weight + if self.alive { fade } else { -fade }).clamp(0.0, 1.0);
    }

    /// Whether nothing is sent of it and nothing asks for it.
    fn is_over(&self) -> bool {
        !self.alive && self.weight <= 0.0 && self.pending_s <= 0.0
    }
}

/// What a frame shows, and of which track.
pub(super) struct Shown<'a> {
    pub(super) observations: &'a [Observation],
    /// The observation of each track.
    pub(super) matched: [Option<usize>; MOST],
    pub(super) gains: Gains,
    pub(super) dt_s: f64,
}

impl Shown<'_> {
    /// The track's observation.
    fn of(&self, track: usize) -> Option<Observation> {
        self.matched[track].map(|seen| self.observations[seen])
    }

    /// Canonical strength along the direction.
    fn vector(&self, seen: &Observation) -> DVec3 {
        seen.direction * (seen.irradiance / self.gains.measured).dot(LUMA)
    }
}

/// Whether two parts make up a whole: what is missing is less than half of the part, so that the part being there
/// explains more than its not being there.
fn adds_up(whole: DVec3, part: DVec3, rest: DVec3) -> bool {
    (whole - part - rest).length() < 0.5 * part.length()
}

/// Gives every track what the frame shows of it, and begins tracks for observations that have none.
pub(super) fn observe(tracks: &mut Vec<Track>, shown: &Shown<'_>, bounds: Bounds) {
    let known = tracks.len();
    let mut altered = [false; MOST];
    for track in 0..known {
        let (lost, back) = (shown.matched[track].is_none(), tracks[track].seen.is_none());
        let heir = Some(track).filter(|_| lost && tracks[track].weight > 0.0).and_then(|track| heir(tracks, track, shown));
        if let Some(heir) = heir {
            tracks[track].kin = tracks[heir].id;
        }
        // Two that ran together, and two that come apart again: the other one changes with it.
        let kin = tracks[track].kin.filter(|_| lost != back);
        if let Some(kin) = kin.and_then(|kin| tracks.iter().position(|other| other.id == Some(kin))) {
            altered[kin] = true;
        }
    }
    let mut parents = [None; MOST];
    for (new, parent) in parents.iter_mut().enumerate().take(shown.observations.len()) {
        if !shown.matched[..known].contains(&Some(new)) {
            *parent = self::parent(tracks, &shown.observations[new], shown);
        }
        parent.iter().for_each(|parent: &usize| altered[*parent] = true);
    }
    for (index, track) in tracks.iter_mut().enumerate() {
        match shown.of(index) {
            Some(seen) if altered[index] => track.become_seen(seen, shown.gains),
            Some(seen) => track.observe(seen, shown.gains, shown.dt_s),
            None => track.miss(shown.dt_s),
        }
    }
    for (new, seen) in shown.observations.iter().enumerate() {
        if !shown.matched[..known].contains(&Some(new)) {
            begin(tracks, seen, parents[new], shown.gains, bounds);
        }
    }
}

/// The track that now shows a lost one's light beside its own.
fn heir(tracks: &[Track], lost: usize, shown: &Shown<'_>) -> Option<usize> {
    let gone = tracks[lost].vector(shown.dt_s);
    (0..tracks.len()).find(|heir| {
        let both = shown.of(*heir).filter(|_| tracks[*heir].weight > 0.0);
        both.is_some_and(|both| adds_up(shown.vector(&both), gone, tracks[*heir].vector(shown.dt_s)))
    })
}

/// The track whose light is now shown by its own observation and a new one.
fn parent(tracks: &[Track], new: &Observation, shown: &Shown<'_>) -> Option<usize> {
    (0..tracks.len()).find(|parent| {
        let rest = shown.of(*parent).filter(|_| tracks[*parent].alive);
        rest.is_some_and(|rest| adds_up(tracks[*parent].vector(shown.dt_s), shown.vector(new), shown.vector(&rest)))
    })
}

/// A track for an observation that has none, if it may become a light. What split off a light is one at once, down to
/// the lower bound.
fn begin(tracks: &mut Vec<Track>, seen: &Observation, parent: Option<usize>, gains: Gains, bounds: Bounds) {
    let least = if parent.is_some() { bounds.death } else { bounds.birth };
    if tracks.len() < MOST && seen.share >= least {
        let mut track = Track::new(*seen, gains);
        (track.alive, track.kin) = (parent.is_some(), parent.and_then(|parent| tracks[parent].id));
        tracks.push(track);
    }
}

/// Births, deaths and fades. `dt_s` is none when nothing is known from before; `next_id` counts identities.
pub(super) fn decide(tracks: &mut Vec<Track>, bounds: Bounds, next_id: &mut u32, dt_s: Option<f64>) {
    tracks.sort_unstable_by(|a, b| b.share.total_cmp(&a.share));
    for index in 0..tracks.len() {
        tracks[index].decide(bounds, dt_s);
        if tracks[index].alive && tracks[index].id.is_none() && !make_room(tracks, index, bounds.lights) {
            (tracks[index].alive, tracks[index].weight) = (false, 0.0);
        }
        if tracks[index].alive && tracks[index].id.is_none() {
            tracks[index].id = Some(*next_id);
            *next_id = next_id.wrapping_add(1);
        }
        if tracks[index].weight >= 1.0 && tracks[index].seen.is_some() {
            tracks[index].kin = None;
        }
    }
    tracks.retain(|track| !track.is_over());
}

/// Whether there is room for a newborn light among `most`, if need be in place of one that is clearly weaker.
fn make_room(tracks: &mut [Track], newborn: usize, most: usize) -> bool {
    let alive = |track: &&mut Track| track.alive && track.id.is_some();
    if tracks.iter_mut().filter(alive).count() < most {
        return true;
    }
    let share = tracks[newborn].share;
    let weakest = tracks.iter_mut().filter(alive).min_by(|a, b| a.share.total_cmp(&b.share));
    match weakest {
        Some(weakest) if weakest.share * DISPLACE < share => {
            weakest.alive = false;
            true
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GAINS: Gains = Gains { measured: DVec3::ONE, sent: DVec3::ONE };
    const BOUNDS: Bounds = Bounds { birth: 0.04, death: 0.02, lights: 8 };
    const DT_S: f64 = 1.0 / 30.0;

    /// Ids alive and their weights, frame by frame, of one light with these shares of the energy.
    fn lives(shares: impl IntoIterator<Item = f64>) -> Vec<(Option<u32>, f64)> {
        let (mut tracks, mut next_id) = (Vec::new(), 0);
        let frame = |share: f64| {
            let seen = Observation {
                direction: DVec3::Y,
                irradiance: DVec3::splat(share),
                pedestal: DVec3::ZERO,
                solid_angle_sr: 0.01,
                share,
                hidden_share: 0.0,
                sigma: 0.0,
            };
            let mut matched = [None; MOST];
            matched[0] = Some(0).filter(|_| !tracks.is_empty());
            observe(&mut tracks, &Shown { observations: &[seen], matched, gains: GAINS, dt_s: DT_S }, BOUNDS);
            decide(&mut tracks, BOUNDS, &mut next_id, Some(DT_S));
            tracks.first().map_or((None, 0.0), |track| (track.id.filter(|_| track.alive), track.weight))
        };
        shares.into_iter().map(frame).collect()
    }

    #[test]
    fn a_share_that_wavers_about_the_upper_bound_makes_one_light() {
        let lives = lives((0..60).map(|frame| if frame % 4 < 2 { 0.05 } else { 0.03 }));
        assert!(lives[0].0.is_none() && lives[1].0 == Some(0), "{lives:?}");
        assert!(lives[1..].iter().all(|(id, _)| *id == Some(0)), "{lives:?}");
        // It fades in within 0.2 s: six frames from its second.
        assert!(lives[5].1 < 1.0 && lives[7].1 == 1.0, "{lives:?}");
    }

    #[test]
    fn a_light_out_of_sight_gives_way_to_one_in_sight() {
        let (mut tracks, mut next_id) = (Vec::new(), 0);
        let bounds = Bounds { lights: 1, ..BOUNDS };
        let light = |direction, share| Observation {
            direction,
            irradiance: DVec3::splat(share),
            pedestal: DVec3::ZERO,
            solid_angle_sr: 0.01,
            share,
            hidden_share: 0.0,
            sigma: 0.0,
        };
        let (strong, weak) = (light(DVec3::Y, 0.5), light(DVec3::X, 0.1));
        let mut frame = |observations: &[Observation]| {
            let mut matched = [None; MOST];
            for (track, matched) in tracks.iter().zip(&mut matched) {
                let track: &Track = track;
                *matched = observations.iter().position(|seen| seen.direction == track.direction.value());
            }
            observe(&mut tracks, &Shown { observations, matched, gains: GAINS, dt_s: DT_S }, bounds);
            decide(&mut tracks, bounds, &mut next_id, Some(DT_S));
            tracks.iter().filter(|track| track.alive).map(|track| track.id).collect::<Vec<_>>()
        };
        (0..8).for_each(|_| drop(frame(&[strong])));
        // The weak one asks for a place in every second frame, and is refused.
        assert!((0..3).all(|_| frame(&[strong, weak]) == [Some(0)]));
        assert_eq!(frame(&[weak]), [Some(1)]);
    }

    #[test]
    fn one_weak_frame_is_no_death_and_many_are() {
        let lives = lives((0..40).map(|frame| if frame == 20 || frame >= 30 { 0.01 } else { 0.05 }));
        assert!(lives[10..31].iter().all(|life| *life == (Some(0), 1.0)), "{lives:?}");
        assert!(lives[31].0.is_none() && lives[31].1 > 0.8 && lives[37].1 == 0.0, "{lives:?}");
    }
}
