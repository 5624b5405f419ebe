//! Light between two video frames.

use glam::Vec3;

use super::{DirectionalLight, LUMA, LightFrame, MAX_LIGHTS};

/// Lights of one id that lie farther apart than this, as a cosine (30°), are two: no light turns at 900°/s, and ids that are ranks say nothing.
pub const SAME_LIGHT_COS: f32 = 0.866_025_4;

impl LightFrame {
    /// The light at `weight` in [0, 1] of the way from this frame to `next`; it still has this frame's times and lift, which belong to the
    /// picture. At weight 0 it is this frame, bit for bit.
    ///
    /// SH, irradiances and solid angles are blended linearly, so that no energy is made or lost; directions of lights with the same id by
    /// slerp, at constant angular speed. On a surface the irradiance then is that between the two frames' up to
    /// `(E + E′)·θ²/16 + |E′ − E|·θ/4` for each light that turns by θ. A light that only one of the frames has fades from or to 0 where it is;
    /// what the server moved between it and the SH moves with them. Frames of more than [`MAX_LIGHTS`] different lights are not blended.
    #[must_use]
    pub fn blend(&self, next: &Self, weight: f32) -> Self {
        // Not a number is no weight either.
        let weight = if weight > 0.0 { weight.min(1.0) } else { return self.clone() };
        let Some(lights) = blend_lights(&self.lights, &next.lights, weight) else { return self.clone() };
        let sh = (0..self.sh.len().max(next.sh.len())).map(|i| {
            let [from, to] = [&self.sh, &next.sh].map(|sh| sh.get(i).copied().unwrap_or(Vec3::ZERO));
            from.lerp(to, weight)
        });
        Self { pts_us: self.pts_us, published_us: self.published_us, lift: self.lift, sh: sh.collect(), lights }
    }
}

/// Strongest first; `None` when there would be too many.
fn blend_lights(from: &[DirectionalLight], to: &[DirectionalLight], weight: f32) -> Option<Vec<DirectionalLight>> {
    let mut coming: Vec<Option<&DirectionalLight>> = to.iter().map(Some).collect();
    let mut lights = Vec::with_capacity(from.len().max(to.len()));
    for light in from {
        let same = |other: &&mut Option<&DirectionalLight>| {
            other.is_some_and(|o| o.id == light.id && o.direction.dot(light.direction) >= SAME_LIGHT_COS)
        };
        lights.push(match coming.iter_mut().find(same).and_then(Option::take) {
            Some(next) => between(light, next, weight),
            None => DirectionalLight { irradiance: light.irradiance * (1.0 - weight), ..*light },
        });
    }
    lights.extend(coming.into_iter().flatten().map(|light| DirectionalLight { irradiance: light.irradiance * weight, ..*light }));
    lights.retain(|light| light.irradiance != Vec3::ZERO);
    lights.sort_by(|a, b| b.irradiance.dot(LUMA).total_cmp(&a.irradiance.dot(LUMA)));
    (lights.len() <= MAX_LIGHTS).then_some(lights)
}

fn between(from: &DirectionalLight, to: &DirectionalLight, weight: f32) -> DirectionalLight {
    let solid_angle_sr = from.solid_angle_sr + (to.solid_angle_sr - from.solid_angle_sr) * weight;
    DirectionalLight {
        id: from.id,
        direction: from.direction.slerp(to.direction, weight).normalize(),
        irradiance: from.irradiance.lerp(to.irradiance, weight),
        solid_angle_sr,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::light::{Lift, SH9, SH25};

    fn light(id: u32, direction: Vec3, irradiance: f32) -> DirectionalLight {
        DirectionalLight { id, direction: direction.normalize(), irradiance: Vec3::splat(irradiance), solid_angle_sr: 0.01 }
    }

    fn frame(pts_us: u64, ambient: f32, lights: Vec<DirectionalLight>) -> LightFrame {
        LightFrame { pts_us, published_us: pts_us + 7, lift: Lift::Linear, sh: vec![Vec3::splat(ambient); SH9], lights }
    }

    /// Irradiance of the lights alone: Lambert's law.
    fn direct(frame: &LightFrame, normal: Vec3) -> Vec3 {
        frame.lights.iter().map(|light| light.irradiance * light.direction.dot(normal).max(0.0)).sum()
    }

    #[test]
    fn half_way_a_light_stands_in_the_middle() {
        let (a, b) = (frame(10, 1.0, vec![light(3, Vec3::X, 2.0)]), frame(20, 3.0, vec![light(3, Vec3::new(3f32.sqrt(), 1.0, 0.0), 4.0)]));
        let half = a.blend(&b, 0.5);
        assert_eq!((half.pts_us, half.published_us, half.sh[4]), (10, 17, Vec3::splat(2.0)));
        let [light] = half.lights[..] else { panic!("{half:?}") };
        assert_eq!((light.id, light.irradiance), (3, Vec3::splat(3.0)));
        // 15° of 30°. glam's arc cosine is good to 7e-5.
        assert!(light.direction.abs_diff_eq(Vec3::new(15f32.to_radians().cos(), 15f32.to_radians().sin(), 0.0), 1e-4), "{light:?}");
        // A third of the way is 10°, where a chord would stand at 9.7°.
        let third = a.blend(&b, 1.0 / 3.0).lights[0].direction;
        assert!((third.angle_between(Vec3::X).to_degrees() - 10.0).abs() < 0.02, "{third}");
    }

    #[test]
    fn what_only_one_frame_has_fades_where_it_is_and_ids_that_are_elsewhere_are_others() {
        let a = frame(0, 1.0, vec![light(1, Vec3::Y, 4.0), light(2, Vec3::X, 1.0)]);
        let b = frame(1, 1.0, vec![light(2, Vec3::NEG_X, 1.0), light(5, Vec3::Z, 8.0)]);
        let seen: Vec<_> = a.blend(&b, 0.25).lights.iter().map(|l| (l.id, l.direction, l.irradiance.x)).collect();
        assert_eq!(seen, [(1, Vec3::Y, 3.0), (5, Vec3::Z, 2.0), (2, Vec3::X, 0.75), (2, Vec3::NEG_X, 0.25)]);
        // The end holds nothing of the first.
        let end: Vec<_> = a.blend(&b, 1.0).lights.iter().map(|l| (l.id, l.irradiance.x)).collect();
        assert_eq!(end, [(5, 8.0), (2, 1.0)]);
    }

    #[test]
    fn frames_of_too_many_lights_are_not_blended_and_missing_coefficients_are_0() {
        let many = |first: u32| frame(0, 1.0, (first..first + 33).map(|id| light(id, Vec3::Y, 1.0)).collect());
        assert_eq!(many(0).blend(&many(33), 0.5), many(0));
        let (nine, mut all) = (frame(0, 1.0, vec![]), frame(1, 1.0, vec![]));
        all.sh = vec![Vec3::ONE; SH25];
        for (weight, expected) in [(0.0, SH9), (0.5, SH25)] {
            assert_eq!(nine.blend(&all, weight).sh.len(), expected);
        }
        assert_eq!(nine.blend(&all, 0.5).sh[20], Vec3::splat(0.5));
        assert_eq!(all.blend(&nine, 0.5).sh[20], Vec3::splat(0.5));
        assert_eq!(nine.blend(&all, f32::NAN), nine);
    }

    fn vector() -> impl Strategy<Value = Vec3> {
        (-1.0..1.0f32, -1.0..1.0f32, -1.0..1.0f32).prop_map(|(x, y, z)| Vec3::new(x, y, z))
    }

    fn direction() -> impl Strategy<Value = Vec3> {
        vector().prop_filter("has a direction", |v| v.length() > 0.1).prop_map(Vec3::normalize)
    }

    fn frames() -> impl Strategy<Value = LightFrame> {
        let light = (0..6u32, direction(), vector(), 1e-5..12.0f32).prop_map(|(id, direction, colour, solid_angle_sr)| DirectionalLight {
            id,
            direction,
            irradiance: colour.abs() * 9.0,
            solid_angle_sr,
        });
        let sh = prop_oneof![Just(SH9), Just(SH25)].prop_flat_map(|count| proptest::collection::vec(vector(), count));
        (proptest::collection::vec(light, 0..8), sh).prop_map(|(mut lights, sh)| {
            // As they travel: an id stands for one light.
            lights.sort_by_key(|light| light.id);
            lights.dedup_by_key(|light| light.id);
            LightFrame { pts_us: 5, published_us: 9, lift: Lift::Linear, sh, lights }
        })
    }

    proptest! {
        #[test]
        fn nothing_is_made_or_lost(a in frames(), b in frames(), weight in 0.0..=1.0f32, normal in direction()) {
            prop_assert_eq!(&a.blend(&b, 0.0), &a);
            let blended = a.blend(&b, weight);
            prop_assert!(blended.to_wire().is_ok(), "{:?}", blended.to_wire());
            for (i, c) in blended.sh.iter().enumerate() {
                let [from, to] = [&a, &b].map(|frame| frame.sh.get(i).copied().unwrap_or(Vec3::ZERO));
                prop_assert!((*c - (from * (1.0 - weight) + to * weight)).abs().max_element() < 1e-6);
            }
            // Those that are one light: irradiances, and the angle between.
            let turning: Vec<_> = a.lights.iter().filter_map(|from| {
                let to = b.lights.iter().find(|to| to.id == from.id && from.direction.dot(to.direction) >= SAME_LIGHT_COS)?;
                Some((from, to, from.direction.angle_between(to.direction)))
            }).collect();
            let bound: f32 = turning.iter().map(|(from, to, angle)| {
                let change = (to.irradiance - from.irradiance).abs().max_element() * angle / 4.0;
                let turn = (from.irradiance + to.irradiance).max_element() * angle * angle / 16.0;
                // At the terminator the law has a kink, where the first order counts.
                let kinked = from.direction.dot(normal) * to.direction.dot(normal) < 0.0;
                let kink = from.irradiance.max(to.irradiance).max_element() * angle / 2.0;
                change + turn + if kinked { kink } else { 0.0 }
            }).sum();
            let expected = direct(&a, normal) * (1.0 - weight) + direct(&b, normal) * weight;
            let off = (direct(&blended, normal) - expected).abs().max_element();
            // Third order, 3 % of the second at 30°; glam's arc cosine is good to 7e-5, of at most six lights of 9.
            prop_assert!(off <= bound * 1.05 + 5e-3, "{} over {}", off, bound);
        }

        #[test]
        fn every_light_of_either_frame_is_there_once(a in frames(), b in frames(), weight in 0.01..0.99f32) {
            let blended = a.blend(&b, weight);
            let sum = |frame: &LightFrame| frame.lights.iter().map(|light| light.irradiance).sum::<Vec3>();
            let expected = sum(&a) * (1.0 - weight) + sum(&b) * weight;
            prop_assert!((sum(&blended) - expected).abs().max_element() < 1e-4);
            prop_assert!(blended.lights.windows(2).all(|pair| pair[0].irradiance.dot(LUMA) >= pair[1].irradiance.dot(LUMA)));
            prop_assert!(blended.lights.iter().all(|light| a.lights.iter().chain(&b.lights).any(|other| other.id == light.id)));
        }
    }
}
