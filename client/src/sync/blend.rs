//! The light between a picture and the next: what is shown at display rate moves at display rate.

use glam::Vec3;
use mr360_protocol::clock::ClientTime;
use mr360_protocol::light::LightFrame;
use mr360_shaders::sh::irradiance;

use super::ReceivedLight;

/// Frames farther apart than this say nothing of the time between them: as after lost frames, or a pause. Microseconds.
const LONGEST_GAP_US: u64 = 100_000;
/// A cut changes the irradiance of some surface by more than this share of the greatest: an exposure that rises at 10 EV/s changes by 0.21 in a
/// frame, a sun that alone lights a place by 0.21 when the camera turns at 360°/s. What stays below is no cut or does not look like one.
const CUT_SHARE: f32 = 0.3;
/// Changes below this share of the whole light are not shown: a quarter of the smallest step between 8-bit codes, which is 0.9 % at white.
const LEAST_SHARE: f32 = 1.0 / 512.0;
/// Turns of a light below this are not shown, radians: a third of a pixel at a shadow's edge, for 1280 pixels across 75°.
const LEAST_TURN: f32 = 3e-4;
/// Nor are changes of a solid angle below this share: the wire's own rounding.
const LEAST_SPREAD: f32 = 0.03;

/// Moves the light from a picture's own towards the next one's. At the moment a picture is switched to exactly its own is in force; it reaches
/// the next one's when that picture is to be presented. Time is an argument.
pub struct LightBlend {
    own: LightFrame,
    switched: ClientTime,
    next: Option<Next>,
    /// In force, when it is not `own`.
    moved: Option<LightFrame>,
    weight: f32,
}

/// Where the light is going, fixed until the next picture: what comes later would make it jump.
struct Next {
    light: LightFrame,
    /// When it had come; the light sets out then, or when the picture was switched to.
    from: ClientTime,
    until: ClientTime,
    /// False for cuts, which take place when they do.
    follows: bool,
}

impl LightBlend {
    /// Its picture was switched to at `now`.
    #[must_use]
    pub fn new(own: LightFrame, now: ClientTime) -> Self {
        Self { own, switched: now, next: None, moved: None, weight: 0.0 }
    }

    /// Moves on to `now`. `upcoming` is the next light that waits for its picture. Returns the light to be shown from now on, or `None` while
    /// it would look the same.
    pub fn advance(&mut self, now: ClientTime, upcoming: Option<&ReceivedLight>) -> Option<&LightFrame> {
        if self.next.is_none()
            && let Some(ReceivedLight { light, arrived }) = upcoming
        {
            let interval_us = light.pts_us.saturating_sub(self.own.pts_us);
            let until = ClientTime(self.switched.0.saturating_add(interval_us));
            self.next = Some(Next { light: light.clone(), from: self.switched.max(*arrived), until, follows: follows(&self.own, light) });
        }
        let next = self.next.as_ref().filter(|next| next.follows && next.from < next.until)?;
        let (gone, whole) = (now.0.saturating_sub(next.from.0), next.until.0 - next.from.0);
        // The next picture's light at its instant belongs to that picture.
        let weight = (gone as f32 / whole as f32).min(1.0 - f32::EPSILON);
        let blended = self.own.blend(&next.light, weight);
        if looks_like(self.moved.as_ref().unwrap_or(&self.own), &blended) {
            return None;
        }
        self.weight = weight;
        self.moved = Some(blended);
        self.moved.as_ref()
    }

    /// How far the light in force is on its way to the next picture's, in [0, 1).
    #[must_use]
    pub fn weight(&self) -> f32 {
        self.weight
    }

    /// From one picture to the next, microseconds; `None` while no next one is known or it is not blended to.
    #[must_use]
    pub fn interval_us(&self) -> Option<u64> {
        self.next.as_ref().filter(|next| next.follows).map(|next| next.until.0.saturating_sub(self.switched.0))
    }
}

/// True when `next` goes on from `own`: no cut and no gap lies between.
fn follows(own: &LightFrame, next: &LightFrame) -> bool {
    let gap_us = next.pts_us.saturating_sub(own.pts_us);
    let known = |light: &LightFrame, id| light.lights.iter().any(|light| light.id == id);
    let disjoint = !own.lights.is_empty() && !next.lights.is_empty() && !own.lights.iter().any(|light| known(next, light.id));
    (1..=LONGEST_GAP_US).contains(&gap_us) && !disjoint && change(own, next) <= CUT_SHARE
}

/// The greatest change of irradiance, over the six axes and RGB, as a share of the greatest irradiance.
fn change(a: &LightFrame, b: &LightFrame) -> f32 {
    let axes = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
    let (mut most, mut changed) = (0.0f32, 0.0f32);
    for normal in axes {
        let [a, b] = [a, b].map(|frame| {
            let direct = frame.lights.iter().map(|light| light.irradiance * light.direction.dot(normal).max(0.0));
            irradiance(&frame.sh, normal) + direct.sum::<Vec3>()
        });
        most = most.max(a.max_element()).max(b.max_element());
        changed = changed.max((a - b).abs().max_element());
    }
    if most > 0.0 { changed / most } else { 0.0 }
}

/// True when nobody could tell one from the other.
fn looks_like(a: &LightFrame, b: &LightFrame) -> bool {
    let ambient = |light: &LightFrame| light.sh.first().map_or(0.0, |c| c.abs().max_element());
    // The mean radiance is 0.282 of the first coefficient; the irradiance of a sphere of it π times that.
    let whole = 0.886 * ambient(b) + b.lights.iter().map(|light| light.irradiance.max_element()).sum::<f32>();
    let alike = |a: Vec3, b: Vec3| (a - b).abs().max_element() <= LEAST_SHARE * whole;
    a.sh.len() == b.sh.len()
        && a.lights.len() == b.lights.len()
        && a.sh.iter().zip(&b.sh).all(|(a, b)| alike(*a, *b))
        && a.lights.iter().zip(&b.lights).all(|(a, b)| {
            a.id == b.id
                && alike(a.irradiance, b.irradiance)
                && a.direction.distance(b.direction) <= LEAST_TURN
                && (a.solid_angle_sr - b.solid_angle_sr).abs() <= LEAST_SPREAD * b.solid_angle_sr
        })
}

#[cfg(test)]
mod tests {
    use mr360_protocol::light::{DirectionalLight, Lift, SH9};

    use super::*;

    const INTERVAL_US: u64 = 33_000;
    const BEGIN: u64 = 5_000_000;

    fn frame(number: u64, ambient: f32, lights: &[(u32, Vec3, f32)]) -> LightFrame {
        let mut sh = vec![Vec3::ZERO; SH9];
        sh[0] = Vec3::splat(ambient);
        let light = |(id, direction, irradiance): &(u32, Vec3, f32)| DirectionalLight {
            id: *id,
            direction: direction.normalize(),
            irradiance: Vec3::splat(*irradiance),
            solid_angle_sr: 0.001,
        };
        let pts_us = number * INTERVAL_US;
        LightFrame { pts_us, published_us: pts_us, lift: Lift::Linear, sh, lights: lights.iter().map(light).collect() }
    }

    /// Of a light that came `after_us` after its picture was switched to.
    fn received(light: &LightFrame, after_us: u64) -> ReceivedLight {
        ReceivedLight { light: light.clone(), arrived: ClientTime(BEGIN + after_us) }
    }

    fn ambient(blend: &mut LightBlend, after_us: u64, upcoming: Option<&ReceivedLight>) -> Option<f32> {
        blend.advance(ClientTime(BEGIN + after_us), upcoming).map(|light| light.sh[0].x)
    }

    #[test]
    fn a_picture_has_its_own_light_at_its_instant_and_approaches_the_next_ones() {
        // It came before the picture was due.
        let (own, next) = (frame(7, 1.0, &[]), ReceivedLight { arrived: ClientTime(BEGIN - 9_000), ..received(&frame(8, 1.2, &[]), 0) });
        let mut blend = LightBlend::new(own, ClientTime(BEGIN));
        assert_eq!((ambient(&mut blend, 0, Some(&next)), blend.weight()), (None, 0.0));
        let third = ambient(&mut blend, 11_000, Some(&next)).unwrap();
        assert!((third - (1.0 + 0.2 / 3.0)).abs() < 1e-6 && (blend.weight() - 1.0 / 3.0).abs() < 1e-6, "{third}");
        // The same instant again looks the same, and so does a change of less than a quarter of a code.
        assert_eq!((ambient(&mut blend, 11_000, Some(&next)), ambient(&mut blend, 11_100, Some(&next))), (None, None));
        let last = ambient(&mut blend, 33_000, Some(&next)).unwrap();
        assert!((last - 1.2).abs() < 1e-6 && blend.weight() < 1.0);
        // The next picture is late.
        assert_eq!(ambient(&mut blend, 80_000, Some(&next)), None);
    }

    #[test]
    fn light_that_comes_within_the_interval_is_approached_without_a_jump_and_late_light_is_not() {
        let next = received(&frame(1, 1.2, &[]), 13_000);
        let mut blend = LightBlend::new(frame(0, 1.0, &[]), ClientTime(BEGIN));
        assert_eq!((ambient(&mut blend, 0, None), ambient(&mut blend, 13_000, Some(&next))), (None, None));
        let half = ambient(&mut blend, 23_000, Some(&next)).unwrap();
        assert!((half - 1.1).abs() < 1e-6, "{half}");
        // However rarely frames are drawn.
        let mut rare = LightBlend::new(frame(0, 1.0, &[]), ClientTime(BEGIN));
        assert_eq!(ambient(&mut rare, 23_000, Some(&next)), Some(half));
        // Light of frame 1 that comes after that of frame 2 does not turn the light around.
        let mut gap = LightBlend::new(frame(0, 1.0, &[]), ClientTime(BEGIN));
        gap.advance(ClientTime(BEGIN), Some(&received(&frame(2, 1.2, &[]), 0)));
        let third = ambient(&mut gap, 22_000, Some(&received(&frame(1, 0.9, &[]), 20_000))).unwrap();
        assert!((third - (1.0 + 0.2 / 3.0)).abs() < 1e-6, "{third}");
        let mut late = LightBlend::new(frame(0, 1.0, &[]), ClientTime(BEGIN));
        let next = received(&frame(1, 1.2, &[]), 33_000);
        assert!((33_000..70_000).step_by(1_000).all(|at| ambient(&mut late, at, Some(&next)).is_none()));
    }

    #[test]
    fn cuts_are_not_smeared() {
        let sun = |id, direction| (id, direction, 2.0f32);
        let own = frame(3, 2.0, &[sun(1, Vec3::Y)]);
        let stays = |next: &LightFrame| {
            let mut blend = LightBlend::new(own.clone(), ClientTime(BEGIN));
            (0..200_000).step_by(1_000).all(|at| blend.advance(ClientTime(BEGIN + at), Some(&received(next, 0))).is_none())
                && blend.weight() == 0.0
        };
        // 132 ms between them; before; twice the same.
        assert!(stays(&frame(7, 2.1, &[sun(1, Vec3::Y)])) && stays(&frame(2, 2.1, &[sun(1, Vec3::Y)])) && stays(&own));
        // Other lights, though as bright and in the same place.
        assert!(stays(&frame(4, 2.0, &[sun(2, Vec3::Y)])));
        // E on the ground is 0.886·2 + 2 = 3.77; the sun goes to the side, and the ground loses 2 of it.
        assert!(stays(&frame(4, 2.0, &[sun(1, Vec3::X)])));
        // A lamp goes on: 0.886·4 + 2 = 5.54, by 0.32 of it.
        assert!(stays(&frame(4, 4.0, &[sun(1, Vec3::Y)])));
    }

    #[test]
    fn fast_ordinary_changes_are_followed() {
        let own = frame(3, 2.0, &[(1, Vec3::Y, 2.0)]);
        let turned = Vec3::new(12f32.to_radians().sin(), 12f32.to_radians().cos(), 0.0);
        let exposed = 10f32 / 30.0;
        let nexts = [
            // 10 EV/s; a turn at 360°/s; a third of the light moved into the SH.
            frame(4, 2.0 * exposed.exp2(), &[(1, Vec3::Y, 2.0 * exposed.exp2())]),
            frame(4, 2.0, &[(1, turned, 2.0)]),
            frame(4, 2.0 + 2.0 / 3.0 / 0.886, &[(1, Vec3::Y, 2.0 - 2.0 / 3.0)]),
        ];
        for next in &nexts {
            let mut blend = LightBlend::new(own.clone(), ClientTime(BEGIN));
            assert!(blend.advance(ClientTime(BEGIN + INTERVAL_US / 2), Some(&received(next, 0))).is_some(), "{next:?}");
        }
        let dark = frame(0, 0.0, &[]);
        assert!(follows(&dark, &frame(1, 0.0, &[])) && !follows(&dark, &frame(1, 0.1, &[])));
    }

    #[test]
    fn a_still_light_costs_nothing() {
        let (own, next) = (frame(0, 1.0, &[(1, Vec3::Y, 2.0)]), frame(1, 1.003, &[(1, Vec3::new(2e-4, 1.0, 0.0), 2.003)]));
        let next = received(&next, 0);
        let mut blend = LightBlend::new(own, ClientTime(BEGIN));
        assert!((0..33_000).step_by(1_000).all(|at| blend.advance(ClientTime(BEGIN + at), Some(&next)).is_none()));
        assert_eq!(blend.weight(), 0.0);
    }
}
