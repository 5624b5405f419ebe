//! Keyframes of a model (glTF 2.0, Sec. 3.11 and Appendix C), sampled at a time.

use std::borrow::Cow;
use std::collections::HashSet;

use glam::{Quat, Vec3};
use gltf::animation::Property;

use super::accessor::floats;
use super::hierarchy::Hierarchy;
use super::model::ModelError;

/// Most animations of a model.
pub const MAX_ANIMATIONS: usize = 128;
/// Most numbers in all keyframes together; channels may share what the file holds once.
const MAX_KEY_NUMBERS: usize = 8_000_000;

/// How values between two keys follow from them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interpolation {
    /// The earlier key's.
    Step,
    /// On the straight line, or the shortest arc.
    Linear,
    /// Hermite splines with the keys' own tangents.
    Cubic,
}

/// What a track moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Path {
    /// Metres.
    Translation,
    /// A unit quaternion.
    Rotation,
    /// Factors.
    Scale,
    /// Of morph targets.
    Weights,
}

/// Keys of one property of one node.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    /// Place of the node in the hierarchy.
    pub node: usize,
    /// Which property.
    pub path: Path,
    /// Seconds, rising.
    pub times: Vec<f32>,
    /// `width` numbers a key, or three times as many, in-tangent, value, out-tangent, for [`Interpolation::Cubic`].
    pub values: Vec<f32>,
    /// Numbers in a value.
    pub width: usize,
    /// Between the keys.
    pub interpolation: Interpolation,
}

/// One animation.
#[derive(Debug, Clone, PartialEq)]
pub struct Animation {
    /// As the file names it; empty where it does not.
    pub name: String,
    /// Seconds until it begins anew: its last key.
    pub duration_s: f32,
    /// One a property.
    pub tracks: Vec<Track>,
}

impl Animation {
    /// Time within the animation when it is repeated for ever.
    #[must_use]
    pub fn looped(&self, time_s: f64) -> f32 {
        let duration = f64::from(self.duration_s);
        if duration > 0.0 && time_s.is_finite() { time_s.rem_euclid(duration) as f32 } else { 0.0 }
    }
}

impl Track {
    /// The value at a time, in `width` numbers; before the first key and after the last theirs.
    pub fn sample(&self, time_s: f32, out: &mut [f32]) {
        let next = self.times.partition_point(|key| *key <= time_s);
        let last = self.times.len().saturating_sub(1);
        let (from, to) = (next.saturating_sub(1), next.min(last));
        let span = self.times[to] - self.times[from];
        let t = if span > 0.0 { ((time_s - self.times[from]) / span).clamp(0.0, 1.0) } else { 0.0 };
        match self.interpolation {
            Interpolation::Step => out.copy_from_slice(self.key(from, 0)),
            Interpolation::Linear => {
                let (a, b) = (self.key(from, 0), self.key(to, 0));
                if self.path == Path::Rotation {
                    out.copy_from_slice(&quaternion(a).slerp(quaternion(b), t).to_array());
                } else {
                    out.iter_mut().zip(a.iter().zip(b)).for_each(|(out, (a, b))| *out = a + (b - a) * t);
                }
            }
            Interpolation::Cubic => {
                let (t2, t3) = (t * t, t * t * t);
                let (a, leaving) = (self.key(from, 1), self.key(from, 2));
                let (b, arriving) = (self.key(to, 1), self.key(to, 0));
                for (i, out) in out.iter_mut().enumerate() {
                    *out = (2.0 * t3 - 3.0 * t2 + 1.0) * a[i]
                        + span * (t3 - 2.0 * t2 + t) * leaving[i]
                        + (3.0 * t2 - 2.0 * t3) * b[i]
                        + span * (t3 - t2) * arriving[i];
                }
                if self.path == Path::Rotation {
                    out.copy_from_slice(&quaternion(out).to_array());
                }
            }
        }
    }

    /// The numbers of a key: part 0 its value, or for cubic splines 0 its in-tangent, 1 its value, 2 its out-tangent.
    fn key(&self, key: usize, part: usize) -> &[f32] {
        let parts = if self.interpolation == Interpolation::Cubic { 3 } else { 1 };
        let at = (key * parts + part) * self.width;
        &self.values[at..at + self.width]
    }
}

/// Made a unit; the identity where there is no direction.
pub(super) fn quaternion(values: &[f32]) -> Quat {
    let at = |i: usize| values.get(i).copied().unwrap_or(0.0);
    let length = (0..4).map(|i| at(i) * at(i)).sum::<f32>().sqrt();
    if length > 1e-6 { Quat::from_xyzw(at(0), at(1), at(2), at(3)) / length } else { Quat::IDENTITY }
}

/// Reads every animation; channels of nodes outside of the scene are left out.
pub(super) fn read(document: &gltf::Document, buffers: &[Cow<'_, [u8]>], hierarchy: &Hierarchy) -> Result<Vec<Animation>, ModelError> {
    if document.animations().len() > MAX_ANIMATIONS {
        return Err(ModelError::TooLarge { what: "animations", limit: MAX_ANIMATIONS });
    }
    let mut numbers = 0;
    document
        .animations()
        .map(|animation| {
            let (mut tracks, mut moved): (Vec<Track>, HashSet<(usize, Path)>) = (Vec::new(), HashSet::new());
            for channel in animation.channels() {
                let fault = |fault: String| ModelError::Animation {
                    index: animation.index(),
                    fault: format!("channel {} {fault}", channel.index()),
                };
                let Some(node) = hierarchy.place.get(channel.target().node().index()).copied().flatten() else { continue };
                let track = track(&channel, node, buffers, hierarchy, &fault)?;
                if !moved.insert((track.node, track.path)) {
                    return Err(fault(format!("moves the {:?} of a node that another channel moves", track.path)));
                }
                numbers += track.times.len() + track.values.len();
                if numbers > MAX_KEY_NUMBERS {
                    return Err(ModelError::TooLarge { what: "numbers in its keyframes", limit: MAX_KEY_NUMBERS });
                }
                tracks.push(track);
            }
            let duration_s = tracks.iter().filter_map(|track| track.times.last()).copied().fold(0.0, f32::max);
            Ok(Animation { name: animation.name().unwrap_or_default().to_owned(), duration_s, tracks })
        })
        .collect()
}

fn track(
    channel: &gltf::animation::Channel<'_>,
    node: usize,
    buffers: &[Cow<'_, [u8]>],
    hierarchy: &Hierarchy,
    fault: &dyn Fn(String) -> ModelError,
) -> Result<Track, ModelError> {
    let sampler = channel.sampler();
    let times: Vec<f32> = floats::<1>(&sampler.input(), buffers, "animation times")?.into_iter().flatten().collect();
    if times.is_empty() || times[0] < 0.0 {
        return Err(fault("has no keys, or one before time 0".to_owned()));
    }
    if let Some(at) = times.windows(2).position(|pair| pair[0] >= pair[1]) {
        return Err(fault(format!("has times that do not rise: key {} at {} s, the next at {} s", at, times[at], times[at + 1])));
    }
    let (path, values): (Path, Vec<f32>) = match channel.target().property() {
        Property::Translation => (Path::Translation, floats::<3>(&sampler.output(), buffers, "translations")?.into_flattened()),
        Property::Rotation => (Path::Rotation, floats::<4>(&sampler.output(), buffers, "rotations")?.into_flattened()),
        Property::Scale => (Path::Scale, floats::<3>(&sampler.output(), buffers, "scales")?.into_flattened()),
        Property::MorphTargetWeights => (Path::Weights, floats::<1>(&sampler.output(), buffers, "morph weights")?.into_flattened()),
    };
    let width = match path {
        Path::Translation | Path::Scale => 3,
        Path::Rotation => 4,
        Path::Weights => hierarchy.nodes[node].weights.len(),
    };
    let (interpolation, parts) = match sampler.interpolation() {
        gltf::animation::Interpolation::Step => (Interpolation::Step, 1),
        gltf::animation::Interpolation::Linear => (Interpolation::Linear, 1),
        gltf::animation::Interpolation::CubicSpline => (Interpolation::Cubic, 3),
    };
    let expected = times.len().saturating_mul(parts * width);
    if values.len() != expected {
        return Err(fault(format!("has {} numbers where {} keys of {width} need {expected}", values.len(), times.len())));
    }
    Ok(Track { node, path, times, values, width, interpolation })
}

/// Where a node's translation, rotation and scale go, and its weights.
pub(super) enum Moved {
    Translation(Vec3),
    Rotation(Quat),
    Scale(Vec3),
    Weights(Vec<f32>),
}

impl Track {
    /// The value at a time, as what it moves.
    pub(super) fn moved(&self, time_s: f32) -> Moved {
        let mut four = [0.0; 4];
        match self.path {
            Path::Weights => {
                let mut weights = vec![0.0; self.width];
                self.sample(time_s, &mut weights);
                Moved::Weights(weights)
            }
            Path::Rotation => {
                self.sample(time_s, &mut four);
                Moved::Rotation(Quat::from_array(four))
            }
            Path::Translation | Path::Scale => {
                let mut three = [0.0; 3];
                self.sample(time_s, &mut three);
                let value = Vec3::from_array(three);
                if self.path == Path::Scale { Moved::Scale(value) } else { Moved::Translation(value) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::{FRAC_PI_2, FRAC_PI_4};

    use super::*;

    fn track(path: Path, interpolation: Interpolation, width: usize, times: &[f32], values: &[f32]) -> Track {
        Track { node: 0, path, times: times.to_vec(), values: values.to_vec(), width, interpolation }
    }

    fn at<const N: usize>(track: &Track, time: f32) -> [f32; N] {
        let mut out = [0.0; N];
        track.sample(time, &mut out);
        out
    }

    #[test]
    fn keys_are_met_and_ends_are_held() {
        for interpolation in [Interpolation::Step, Interpolation::Linear] {
            let track = track(Path::Weights, interpolation, 1, &[1.0, 2.0, 4.0], &[10.0, 20.0, -4.0]);
            for (time, value) in [(0.0, 10.0), (1.0, 10.0), (2.0, 20.0), (4.0, -4.0), (9.0, -4.0)] {
                assert_eq!(at(&track, time), [value], "{interpolation:?} at {time}");
            }
        }
        let held = track(Path::Weights, Interpolation::Step, 1, &[0.0, 1.0], &[3.0, 5.0]);
        assert_eq!([at::<1>(&held, 0.999)[0], at::<1>(&held, 1.0)[0]], [3.0, 5.0]);
        let line = track(Path::Translation, Interpolation::Linear, 3, &[0.0, 2.0], &[0.0, 0.0, 0.0, 2.0, -4.0, 8.0]);
        assert_eq!(at(&line, 0.5), [0.5, -1.0, 2.0]);
    }

    #[test]
    fn rotations_keep_to_the_shortest_arc() {
        let quarter = Quat::from_rotation_y(FRAC_PI_2);
        for sign in [1.0, -1.0] {
            // The same rotation with the other sign is the same place.
            let values = [Quat::IDENTITY.to_array(), (quarter * sign).to_array()].concat();
            let track = track(Path::Rotation, Interpolation::Linear, 4, &[0.0, 1.0], &values);
            for t in [0.0, 0.25, 0.5, 0.9, 1.0] {
                let expected = Quat::from_rotation_y(FRAC_PI_2 * t);
                assert!(Quat::from_array(at(&track, t)).angle_between(expected) < 1e-3, "{sign} {t}");
            }
        }
    }

    #[test]
    fn cubic_splines_follow_their_polynomial() {
        // p(s) = s³ − s from s = 1 to s = 3 has slopes 2 and 26 there: the spline of its ends is the cubic itself.
        let values = [0.0, 0.0, 2.0, 26.0, 24.0, 0.0];
        let spline = track(Path::Weights, Interpolation::Cubic, 1, &[1.0, 3.0], &values);
        for s in [1.0f32, 1.3, 2.0, 2.7, 3.0] {
            assert!((at::<1>(&spline, s)[0] - (s * s * s - s)).abs() < 1e-4, "{s}");
        }
        // Flat tangents between a quaternion and its quarter turn pass the middle of the arc, a unit again.
        let (a, b, flat) = (Quat::IDENTITY.to_array(), Quat::from_rotation_z(FRAC_PI_2).to_array(), [0.0; 4]);
        let turn = track(Path::Rotation, Interpolation::Cubic, 4, &[0.0, 1.0], &[flat, a, flat, flat, b, flat].concat());
        assert!(Quat::from_array(at(&turn, 0.5)).angle_between(Quat::from_rotation_z(FRAC_PI_4)) < 1e-3);
        assert!((Quat::from_array(at(&turn, 0.2)).length() - 1.0).abs() < 1e-5);
    }

    #[test]
    fn an_animation_begins_anew_at_its_end() {
        let animation = Animation { name: String::new(), duration_s: 2.5, tracks: Vec::new() };
        assert_eq!([0.0, 1.0, 2.5, 6.0].map(|time| animation.looped(time)), [0.0, 1.0, 0.0, 1.0]);
        // A broadcast of eleven days: f32 seconds would jump by 60 ms.
        assert!((animation.looped(1_000_000.0 + 0.01) - 0.01).abs() < 1e-6);
        assert_eq!(Animation { duration_s: 0.0, ..animation }.looped(3.0), 0.0);
    }
}
