//! What lights do: beat, move, fade, merge.

use std::f32::consts::TAU;

use glam::{Quat, Vec3};

use super::{Disc, LAMP, SKY, SUN, Scene, Sequence, Varies, sun};

/// Half the swing of lamps on mains.
const BEAT: f32 = 0.2;

/// Level of a lamp on mains of this frequency, which is bright twice a period.
fn beat(mains_hz: f32, time: f32) -> f32 {
    1.0 + BEAT * (TAU * 2.0 * mains_hz * time + 0.4).sin()
}

/// All light is from lamps on mains of this frequency.
fn under_lamps(mains_hz: f32) -> impl Fn(f32) -> Scene + Send + 'static {
    let lamp = Disc { radiance: LAMP, ..sun(40.0, 50.0) };
    move |time| Scene::new(vec![lamp]).exposed(Vec3::splat(beat(mains_hz, time).log2()))
}

/// All light is from lamps on 50 Hz mains, bright a hundred times a second: 10 Hz at 30 frames a second.
#[must_use]
pub fn lamp_beat() -> Sequence {
    Sequence::new("lamp beat", 5.0, under_lamps(50.0)).varying(Varies::Beat)
}

/// All light is from lamps on 60 Hz mains, at 25 frames a second: 5 Hz.
#[must_use]
pub fn lamp_beat_60() -> Sequence {
    Sequence::new("lamp beat, 60 Hz", 6.0, under_lamps(60.0)).paced(6.0, 25.0).varying(Varies::Beat)
}

/// All light is from lamps on 60 Hz mains, at 29.97 frames a second: once in 8.3 s, which no method can tell from a change of exposure.
#[must_use]
pub fn slow_beat() -> Sequence {
    Sequence::new("slow beat", 13.0, under_lamps(60.0)).paced(13.0, 30_000.0 / 1001.0).varying(Varies::Beat)
}

/// A lamp on 50 Hz mains under a sky that does not beat.
#[must_use]
pub fn one_lamp_beats() -> Sequence {
    Sequence::new("one lamp beats", 5.0, |time| Scene::new(vec![Disc { radiance: LAMP * beat(50.0, time), ..sun(40.0, 50.0) }]))
        .linear()
        .varying(Varies::Beat)
}

/// A sun that crosses the panorama's left and right edge at 10° a second.
#[must_use]
pub fn over_the_seam() -> Sequence {
    Sequence::new("over the seam", 4.0, |time| Scene::new(vec![sun(160.0 + 10.0 * time, 35.0)]))
}

/// A sun that crosses the zenith at 10° a second, slightly beside it.
#[must_use]
pub fn over_the_zenith() -> Sequence {
    Sequence::new("over the zenith", 6.0, |time| {
        let disc = sun(30.0, 60.0);
        let axis = disc.centre.cross(Vec3::Y).normalize();
        let centre = Quat::from_axis_angle(axis, 10f32.to_radians() * time) * disc.centre;
        Scene::new(vec![Disc { centre: Quat::from_rotation_z(0.01) * centre, ..disc }])
    })
}

/// A cloud draws over the sun within a second, and away again.
#[must_use]
pub fn behind_a_cloud() -> Sequence {
    Sequence::new("behind a cloud", 7.0, |time| {
        let covered = (time - 1.5).clamp(0.0, 1.0) - (time - 4.0).clamp(0.0, 1.0);
        Scene::new(vec![Disc { radiance: SUN * (SKY / SUN).powf(covered), ..sun(40.0, 50.0) }])
    })
}

/// A lamp doubles after a second, goes out after two and comes back after three.
#[must_use]
pub fn lamp_switched() -> Sequence {
    Sequence::new("lamp switched", 4.0, |time| {
        let level = [1.0, 2.0, 0.02, 1.0][(time as usize).min(3)];
        Scene::new(vec![Disc { radiance: LAMP * level, ..sun(40.0, 50.0) }])
    })
    .linear()
    .stepping(&[1.0, 2.0, 3.0])
}

/// Two lamps run into one and come apart again.
#[must_use]
pub fn merge_and_split() -> Sequence {
    Sequence::new("merge and split", 6.0, |time| {
        let half = 4.0 * (time - 3.0).abs();
        Scene::new(vec![Disc::at(-half - 2.0, 30.0, 4.0, LAMP), Disc::at(half + 2.0, 30.0, 3.5, LAMP)])
    })
    .linear()
}

/// Two lamps pass each other at 20° a second.
#[must_use]
pub fn crossing() -> Sequence {
    Sequence::new("crossing", 4.0, |time| {
        let along = 10.0 * (time - 2.0);
        Scene::new(vec![Disc::at(along, 33.0, 5.0, LAMP), Disc::at(-along, 28.0, 3.5, LAMP)])
    })
    .linear()
}
