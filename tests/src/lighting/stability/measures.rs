//! What a sequence of estimates is judged by.
//!
//! Truth and estimate are reduced to the same [`Shown`], so that each measure is one function of both. Luminance stands for light throughout,
//! but for the lag, which sees colours.

use std::f64::consts::PI;

use glam::{DVec3, Vec3};
use mr360_protocol::light::DirectionalLight;
use mr360_server::lighting::Estimate;
use mr360_server::lighting::sequences::{SURFACES, Truth, Varies};

use super::super::irradiance::lit_by;

/// BT.709 luminance.
pub(super) const LUMA: DVec3 = DVec3::new(0.2126, 0.7152, 0.0722);
/// Lights within this angle of the main one belong to it: methods that lay many lights over one lamp are judged by them all.
const TOGETHER_DEG: f64 = 10.0;
/// A true light is there to be found when it gives a surface that faces it at least this share of what that receives.
const LEAST_SHARE: f64 = 0.1;
/// A light that moves further than this from one frame to the next is another one, whatever its identifier says: the fastest of the sequences move by
/// less than 1°, and many methods number their lights anew in every frame.
const ANOTHER_DEG: f64 = 10.0;
/// What has come this near to where it will stay has arrived.
const ARRIVED: f64 = 0.05;
/// Beats are judged after this time: until a beat is known for one it may be followed.
const BEAT_KNOWN_S: f64 = 2.0;

/// The main light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Main {
    /// Unit vector towards it.
    pub(super) direction: DVec3,
    /// Luminous irradiance of a surface that faces it.
    pub(super) strength: f64,
}

/// The light of a frame, as the measures need it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Shown {
    /// The main light, if there is one: of a truth the first, of an estimate the strongest, with all others within 10° of it.
    pub(super) main: Option<Main>,
    /// Every light's identifier and direction.
    pub(super) lights: Vec<(u32, DVec3)>,
    /// Irradiance of [`SURFACES`] from all light.
    pub(super) surfaces: [DVec3; 6],
    /// Mean luminance outside the lights.
    pub(super) ambient: f64,
}

impl Shown {
    pub(super) fn of_estimate(estimate: &Estimate) -> Self {
        let strongest = estimate.lights.iter().max_by(|a, b| strength(a).total_cmp(&strength(b)));
        Self {
            main: strongest.and_then(|light| together(light, &estimate.lights)),
            lights: named(&estimate.lights),
            surfaces: SURFACES.map(|normal| lit_by(&estimate.sh, &estimate.lights, normal)),
            ambient: estimate.sh.first().map_or(0.0, |mean| mean.as_dvec3().dot(LUMA)) / (4.0 * PI).sqrt(),
        }
    }

    /// The main light is left out where it gives too little to be found.
    pub(super) fn of_truth(truth: &Truth) -> Self {
        let ambient = truth.ambient.as_dvec3().dot(LUMA);
        let main = truth.lights.first().and_then(|light| together(light, &truth.lights));
        Self {
            main: main.filter(|main| main.strength >= LEAST_SHARE * (main.strength + PI * ambient)),
            lights: named(&truth.lights),
            surfaces: truth.irradiance.map(Vec3::as_dvec3),
            ambient,
        }
    }

    /// Luminous irradiance of one of [`SURFACES`].
    fn received(&self, surface: usize) -> f64 {
        self.surfaces[surface].dot(LUMA)
    }

    /// Luminous irradiance of level ground.
    pub(super) fn level(&self) -> f64 {
        self.received(0)
    }
}

fn strength(light: &DirectionalLight) -> f64 {
    light.irradiance.as_dvec3().dot(LUMA)
}

fn named(lights: &[DirectionalLight]) -> Vec<(u32, DVec3)> {
    lights.iter().map(|light| (light.id, light.direction.as_dvec3())).collect()
}

/// A light and those around it as one.
fn together(first: &DirectionalLight, lights: &[DirectionalLight]) -> Option<Main> {
    let near = |light: &&DirectionalLight| degrees(light.direction.as_dvec3(), first.direction.as_dvec3()) <= TOGETHER_DEG;
    let sums = lights.iter().filter(near).map(|light| (light.direction.as_dvec3() * strength(light), strength(light)));
    let (direction, strength) = sums.fold((DVec3::ZERO, 0.0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
    direction.try_normalize().map(|direction| Main { direction, strength })
}

/// Angle between two unit vectors.
pub(super) fn degrees(a: DVec3, b: DVec3) -> f64 {
    a.cross(b).length().atan2(a.dot(b)).to_degrees()
}

/// One frame.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Moment {
    /// Presentation time.
    pub(super) time_s: f64,
    /// What the method says.
    pub(super) estimate: Shown,
    /// What is true, where that is known.
    pub(super) truth: Option<Shown>,
}

impl Moment {
    /// Estimated and true main light, where there are both.
    fn mains(&self) -> Option<(Main, Main)> {
        Some((self.estimate.main?, self.truth.as_ref()?.main?))
    }

    /// Degrees between estimated and true main light.
    pub(super) fn off_deg(&self) -> Option<f64> {
        self.mains().map(|(estimate, truth)| degrees(estimate.direction, truth.direction))
    }

    /// Estimated over true strength of the main light; the strength itself where no truth is known.
    fn strength(&self) -> Option<f64> {
        match &self.truth {
            Some(_) => self.mains().map(|(estimate, truth)| estimate.strength / truth.strength),
            None => self.estimate.main.map(|main| main.strength),
        }
    }

    /// The same of all that level ground receives.
    fn level(&self) -> f64 {
        self.estimate.level() / self.truth.as_ref().map_or(1.0, Shown::level)
    }
}

/// The measures of a method on a sequence. None where a sequence does not ask, or nothing was shown to be judged.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Measures {
    /// Share of the frames with a true main light in which one of the method's lights is within 10° of it.
    pub(super) found: Option<f64>,
    /// Share of the frames without a true main light in which the method sends lights all the same.
    pub(super) invented: Option<f64>,
    /// Root mean square of the angle between estimated and true main light, over the frames that have both.
    pub(super) off_rms_deg: Option<f64>,
    /// Largest such angle.
    pub(super) off_worst_deg: Option<f64>,
    /// The same root mean square once the mean of estimate less truth is taken away: what the light wanders. Without a truth, about the mean direction.
    pub(super) wander_rms_deg: Option<f64>,
    /// Largest move of the main light between two frames beyond the true one's.
    pub(super) turn_worst_deg: Option<f64>,
    /// Standard deviation over mean of estimated over true strength of the main light. Not asked of beats, which are to be told apart from the light.
    pub(super) strength_variation: Option<f64>,
    /// The same of all that level ground receives.
    pub(super) level_variation: f64,
    /// Births and deaths a second; a light that jumps by more than 10° counts as both.
    pub(super) events_per_s: f64,
    /// Those of the true lights.
    pub(super) true_events_per_s: Option<f64>,
    /// After a step of the truth, time until what the surfaces receive has come within 5 % of where it is before the next step, for good, relative to the most
    /// that any of them receives then. The longest of a sequence's steps; a step that never settles counts until the next.
    pub(super) lag_s: Option<f64>,
    /// Largest change between two frames of what a surface receives, over the most that any of them receives in the sequence.
    pub(super) jump: f64,
    /// That of the truth.
    pub(super) true_jump: Option<f64>,
    /// Swing of what level ground receives, over the truth's.
    pub(super) ripple: Option<f64>,
    /// Swing of the main light's strength, over the truth's of level ground or of the light, whichever is greater.
    pub(super) light_ripple: Option<f64>,
    /// Largest departure of the ratio of main light to ambient from what it was in the first frame.
    pub(super) ratio_drift: Option<f64>,
    /// Estimated over true strength of the main light, median of the first second.
    pub(super) strength_first: Option<f64>,
    /// And of the last second.
    pub(super) strength_last: Option<f64>,
    /// And of all frames in which the truth's is within 5 % of its least: where the exposure moves, those that show a lamp unclipped, if any do.
    pub(super) strength_least: Option<f64>,
    /// [`Measures::ripple`] of a mean of the truth over the number of frames, from the last to the twelfth last, that leaves least of it: of somebody who knows the beat
    /// beforehand.
    pub(super) known_ripple: Option<f64>,
}

impl Measures {
    /// Of the frames of a sequence whose light steps at `steps_s`.
    pub(super) fn of(moments: &[Moment], steps_s: &[f32], varies: Varies) -> Self {
        let off: Vec<f64> = moments.iter().filter_map(Moment::off_deg).collect();
        let strengths: Vec<f64> = moments.iter().filter_map(Moment::strength).collect();
        let truths: Option<Vec<&Shown>> = moments.iter().map(|moment| moment.truth.as_ref()).collect();
        let estimates: Vec<&Shown> = moments.iter().map(|moment| &moment.estimate).collect();
        let duration_s = moments.last().map_or(0.0, |last| last.time_s) - moments.first().map_or(0.0, |first| first.time_s);
        let (first_s, last_s) = (moments.first().map_or(0.0, |m| m.time_s), moments.last().map_or(0.0, |m| m.time_s));
        let true_strength = |within: &dyn Fn(f64) -> bool| {
            let known = moments.iter().filter(|moment| moment.truth.is_some() && within(moment.time_s));
            crate::samples::percentile(&known.filter_map(Moment::strength).collect::<Vec<_>>(), 0.5)
        };
        let beats = varies == Varies::Beat;
        Self {
            found: share(moments, true, |moment, main| {
                moment
                    .estimate
                    .lights
                    .iter()
                    .any(|(_, direction)| main.is_some_and(|main| degrees(*direction, main.direction) <= TOGETHER_DEG))
            }),
            invented: share(moments, false, |moment, _| !moment.estimate.lights.is_empty()),
            off_rms_deg: rms(&off),
            off_worst_deg: off.iter().copied().reduce(f64::max),
            wander_rms_deg: wander_rms_deg(moments),
            turn_worst_deg: turn_worst_deg(moments),
            strength_variation: if beats { None } else { variation(&strengths) },
            level_variation: variation(&moments.iter().map(Moment::level).collect::<Vec<_>>()).unwrap_or(0.0),
            events_per_s: events(&estimates) as f64 / duration_s.max(f64::EPSILON),
            true_events_per_s: truths.as_ref().map(|truths| events(truths) as f64 / duration_s.max(f64::EPSILON)),
            lag_s: lag_s(moments, steps_s),
            jump: jump(&estimates),
            true_jump: truths.as_ref().map(|truths| jump(truths)),
            ripple: if beats { ripple(moments, |shown| Some(shown.level())) } else { None },
            light_ripple: if beats { ripple(moments, |shown| shown.main.map(|main| main.strength)) } else { None },
            ratio_drift: if varies == Varies::Exposure { ratio_drift(moments) } else { None },
            strength_first: true_strength(&|time_s| time_s < first_s + 1.0),
            strength_last: true_strength(&|time_s| time_s > last_s - 1.0),
            strength_least: strength_least(moments),
            known_ripple: if beats { known_ripple(moments) } else { None },
        }
    }
}

/// Share of the frames with (or without) a true main light of which `holds`.
fn share(moments: &[Moment], with_light: bool, holds: impl Fn(&Moment, Option<Main>) -> bool) -> Option<f64> {
    let main = |moment: &&Moment| moment.truth.as_ref().is_some_and(|truth| truth.main.is_some() == with_light);
    let all: Vec<&Moment> = moments.iter().filter(main).collect();
    let held = all.iter().filter(|moment| holds(moment, moment.truth.as_ref().and_then(|truth| truth.main))).count();
    (!all.is_empty()).then(|| held as f64 / all.len() as f64)
}

/// Root mean square.
fn rms(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| (values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64).sqrt())
}

/// Standard deviation over mean.
fn variation(values: &[f64]) -> Option<f64> {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    rms(&values.iter().map(|value| value / mean - 1.0).collect::<Vec<_>>()).filter(|variation| variation.is_finite())
}

fn wander_rms_deg(moments: &[Moment]) -> Option<f64> {
    let difference = |moment: &Moment| match &moment.truth {
        Some(_) => moment.mains().map(|(estimate, truth)| estimate.direction - truth.direction),
        None => moment.estimate.main.map(|main| main.direction),
    };
    let differences: Vec<DVec3> = moments.iter().filter_map(difference).collect();
    let mean = differences.iter().sum::<DVec3>() / differences.len() as f64;
    // The chord of a small angle is the angle.
    rms(&differences.iter().map(|difference| (*difference - mean).length().to_degrees()).collect::<Vec<_>>())
}

fn turn_worst_deg(moments: &[Moment]) -> Option<f64> {
    let turn = |pair: &[Moment]| {
        let estimated = degrees(pair[0].estimate.main?.direction, pair[1].estimate.main?.direction);
        let main = |moment: &Moment| Some(moment.truth.as_ref()?.main?.direction);
        let truly = main(&pair[0]).zip(main(&pair[1])).map_or(0.0, |(a, b)| degrees(a, b));
        Some((estimated - truly).max(0.0))
    };
    moments.windows(2).filter_map(turn).reduce(f64::max)
}

/// Births and deaths after the first frame.
fn events(frames: &[&Shown]) -> usize {
    let lacks = |lights: &[(u32, DVec3)], (id, direction): &(u32, DVec3)| {
        !lights.iter().any(|(other, there)| other == id && degrees(*there, *direction) <= ANOTHER_DEG)
    };
    let pairs = frames.windows(2).map(|pair| (&pair[0].lights, &pair[1].lights));
    pairs.map(|(a, b)| a.iter().filter(|light| lacks(b, light)).count() + b.iter().filter(|light| lacks(a, light)).count()).sum()
}

fn jump(frames: &[&Shown]) -> f64 {
    let received = |shown: &Shown| [0, 1, 2, 3, 4, 5].map(|surface| shown.received(surface));
    let most = frames.iter().flat_map(|shown| received(shown)).fold(0.0, f64::max);
    let steps = frames.windows(2).flat_map(|pair| {
        let (before, after) = (received(pair[0]), received(pair[1]));
        [0, 1, 2, 3, 4, 5].map(|surface| (after[surface] - before[surface]).abs())
    });
    steps.fold(0.0, f64::max) / most.max(f64::MIN_POSITIVE)
}

fn lag_s(moments: &[Moment], steps_s: &[f32]) -> Option<f64> {
    // Times are whole microseconds.
    let begins = |step: &f32| moments.partition_point(|moment| moment.time_s < f64::from(*step) - 1e-5);
    let starts: Vec<usize> = steps_s.iter().map(begins).chain([moments.len()]).collect();
    let lag = |pair: &[usize]| {
        let after = moments.get(pair[0]..pair[1])?;
        let (first, settled) = (after.first()?, after.last()?);
        let most = settled.estimate.surfaces.iter().map(|received| received.max_element()).fold(0.0, f64::max);
        let off = |moment: &Moment| {
            let pairs = moment.estimate.surfaces.iter().zip(&settled.estimate.surfaces);
            pairs.map(|(now, then)| (*now - *then).abs().max_element()).fold(0.0, f64::max) / most.max(f64::MIN_POSITIVE)
        };
        let last_off = after.iter().rposition(|moment| off(moment) > ARRIVED);
        Some(last_off.and_then(|last| after.get(last + 1)).map_or(0.0, |arrived| arrived.time_s - first.time_s))
    };
    starts.windows(2).filter_map(lag).reduce(f64::max)
}

/// Peak to peak over the middle.
fn swing(values: &[f64]) -> Option<f64> {
    let (least, most) = (values.iter().copied().reduce(f64::min)?, values.iter().copied().reduce(f64::max)?);
    (most > 0.0).then(|| 2.0 * (most - least) / (most + least))
}

fn ripple(moments: &[Moment], of: impl Fn(&Shown) -> Option<f64>) -> Option<f64> {
    let begin_s = moments.first()?.time_s + BEAT_KNOWN_S;
    let known = || moments.iter().filter(|moment| moment.time_s >= begin_s);
    let own: Vec<f64> = known().filter_map(|moment| of(&moment.estimate)).collect();
    let truth = |of: &dyn Fn(&Shown) -> Option<f64>| swing(&known().filter_map(|moment| of(moment.truth.as_ref()?)).collect::<Vec<_>>());
    let level = truth(&|shown| Some(shown.level()))?;
    Some(swing(&own)? / truth(&of)?.max(level))
}

/// Most frames that a mean is taken over: the slowest beats that a second's frames show as such take twelve.
const MOST_MEANT: usize = 12;

fn known_ripple(moments: &[Moment]) -> Option<f64> {
    let begin_s = moments.first()?.time_s + BEAT_KNOWN_S;
    let begin = moments.partition_point(|moment| moment.time_s < begin_s).max(MOST_MEANT);
    let levels: Option<Vec<f64>> = moments.iter().map(|moment| moment.truth.as_ref().map(Shown::level)).collect();
    let levels = levels?;
    let mean = |frames: usize| -> Vec<f64> {
        (begin..levels.len()).map(|frame| levels[frame + 1 - frames..=frame].iter().sum::<f64>() / frames as f64).collect()
    };
    let least = (1..=MOST_MEANT).filter_map(|frames| swing(&mean(frames))).reduce(f64::min)?;
    Some(least / swing(&mean(1))?)
}

fn strength_least(moments: &[Moment]) -> Option<f64> {
    let truly = |moment: &Moment| Some(moment.truth.as_ref()?.main?.strength);
    let least = moments.iter().filter_map(truly).reduce(f64::min)?;
    let shown = moments.iter().filter(|moment| truly(moment).is_some_and(|strength| strength <= (1.0 + ARRIVED) * least));
    crate::samples::percentile(&shown.filter_map(Moment::strength).collect::<Vec<_>>(), 0.5)
}

fn ratio_drift(moments: &[Moment]) -> Option<f64> {
    let ratio = |shown: &Shown| shown.main.map(|main| main.strength / shown.ambient);
    let first = ratio(&moments.first()?.estimate)?;
    let ratios: Option<Vec<f64>> = moments.iter().map(|moment| ratio(&moment.estimate)).collect();
    // A frame that lacks its light has lost the ratio altogether.
    let drift = ratios.map_or(1.0, |ratios| ratios.iter().map(|ratio| (ratio / first - 1.0).abs()).fold(0.0, f64::max));
    Some(drift)
}
