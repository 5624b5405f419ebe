//! What a frame needs: which passes run at all. Decided from the scene and the light, in one place.

use mr360_protocol::light::DirectionalLight;
use mr360_shaders::colour::luminance;
use mr360_shaders::source::ROUGH_TO;

use crate::environment::FrameLight;
use crate::governor::Tier;

/// Most lights that cast shadows.
pub const MAX_SHADOWS: usize = 4;
/// A light casts shadows from this share of the frame's whole irradiance on.
const SHADOW_SHARE: f32 = 0.02;

/// Lights that cast shadows count for so much more, so that of two nearly alike one goes on casting.
const KEPT: f32 = 1.25;

/// Which lights cast shadows, by id.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Casting(Vec<u32>);

impl Casting {
    fn strength(&self, light: &DirectionalLight) -> f32 {
        luminance(light.irradiance).max(0.0) * if self.0.contains(&light.id) { KEPT } else { 1.0 }
    }

    /// Strongest first, where those that cast shadows keep their places against others that are not clearly stronger.
    pub fn order(&self, lights: &mut [DirectionalLight]) {
        lights.sort_by(|a, b| self.strength(b).total_cmp(&self.strength(a)));
    }

    /// From now on these do.
    pub fn keep(&mut self, lights: &[DirectionalLight]) {
        self.0.clear();
        self.0.extend(lights.iter().map(|light| light.id));
    }
}

/// The passes of one frame, and how well they do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Plan {
    /// Anything is drawn over the video.
    pub objects: bool,
    /// The reflection map is kept up to date.
    pub reflections: bool,
    /// The strongest this many lights cast shadows.
    pub shadows: usize,
    /// Something reaches beneath the ground and has to be hidden there.
    pub ground_hides: bool,
    /// Reflections follow every so manieth picture.
    pub reflections_every: u32,
    /// Objects shade each other and the ground from the sky.
    pub occlusion: bool,
    /// Samples a pixel of what is drawn over the video.
    pub samples: u32,
    /// Something is of glass and is drawn after all else, which it shows.
    pub glass: bool,
    /// Glossy ground mirrors the objects: they are drawn once more, as it shows them.
    pub ground_mirrors: bool,
    /// Some glossy mesh of the place mirrors the objects.
    pub place_mirrors: bool,
}

/// What the plan asks of the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SceneNeeds {
    /// Objects drawn.
    pub objects: usize,
    /// Some surface is smooth enough to reflect, or is glass.
    pub reflective: bool,
    /// Finest of the prefiltered levels that its lobes look into; none where all are cones.
    pub lobes_from: Option<u32>,
    /// Some object reaches beneath the ground.
    pub beneath_ground: bool,
    /// Some surface is glass.
    pub glass: bool,
    /// The ground mirrors objects.
    pub glossy_ground: bool,
    /// Some mesh of the place mirrors objects.
    pub glossy_place: bool,
}

impl SceneNeeds {
    /// A surface has lobes of this level and wider ones, if any.
    pub fn add_lobes(&mut self, finest: Option<u32>) {
        self.lobes_from = self.lobes_from.into_iter().chain(finest).min();
    }
}

impl Plan {
    /// Decides. `casting` are those lights that cast shadows so far, of which `light` is in order.
    #[must_use]
    pub fn new(scene: SceneNeeds, light: &FrameLight, casting: &Casting) -> Self {
        if scene.objects == 0 {
            return Self { place_mirrors: scene.glossy_place, ..Self::default() }.within(Tier::FULL);
        }
        let ambient = luminance(light.sh[0]).max(0.0) * 0.282_094_8 * std::f32::consts::PI;
        let total = ambient + light.lights.iter().map(|light| luminance(light.irradiance).max(0.0)).sum::<f32>();
        let casts = |light: &&DirectionalLight| luminance(light.irradiance) > 0.0 && casting.strength(light) >= SHADOW_SHARE * total;
        let shadows = light.lights.iter().take(MAX_SHADOWS).take_while(casts).count();
        let all = Self {
            objects: true,
            // What a glossy real surface shows of the panorama gives way to what it shows of an object.
            reflections: scene.reflective || scene.glossy_ground || scene.glossy_place,
            shadows,
            ground_hides: scene.beneath_ground,
            glass: scene.glass,
            ground_mirrors: scene.glossy_ground,
            place_mirrors: scene.glossy_place,
            ..Self::default()
        };
        all.within(Tier::FULL)
    }

    /// Leaves out what a tier leaves out. Glass sees what was drawn before it in all samples, and keeps them.
    #[must_use]
    pub fn within(self, tier: Tier) -> Self {
        let limits = tier.limits();
        let samples = if self.glass { Tier::FULL.limits().samples } else { limits.samples };
        Self {
            shadows: self.shadows.min(limits.shadows),
            reflections_every: if self.reflections { limits.reflections_every } else { 0 },
            occlusion: self.objects && limits.occlusion,
            samples: if self.objects { samples } else { 0 },
            ground_mirrors: self.ground_mirrors && limits.mirrors,
            place_mirrors: self.place_mirrors && limits.mirrors,
            ..self
        }
    }
}

/// True where the shaders look into the reflection map.
#[must_use]
pub fn reflects(roughness: f32, glass: bool) -> bool {
    glass || roughness < ROUGH_TO
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn planned(scene: SceneNeeds, light: &FrameLight) -> Plan {
        Plan::new(scene, light, &Casting::default())
    }

    fn light(irradiances: &[f32]) -> FrameLight {
        let mut light = FrameLight::default();
        light.sh[0] = Vec3::splat(1.0);
        let one = |(id, irradiance): (usize, &f32)| DirectionalLight {
            id: id as u32,
            direction: Vec3::Y,
            irradiance: Vec3::splat(*irradiance),
            solid_angle_sr: 0.01,
        };
        light.lights = irradiances.iter().enumerate().map(one).collect();
        light
    }

    #[test]
    fn an_overcast_sky_on_diffuse_objects_runs_nothing_extra() {
        let needs = SceneNeeds { objects: 3, ..SceneNeeds::default() };
        let plain = Plan { objects: true, occlusion: true, samples: 4, ..Plan::default() };
        assert_eq!(planned(needs, &light(&[])), plain);
        let mirror = SceneNeeds { reflective: true, ..needs };
        let mirrored = Plan { reflections: true, reflections_every: 1, ..plain };
        assert_eq!(planned(mirror, &light(&[])), mirrored);
        let glass = SceneNeeds { glass: true, ..mirror };
        assert_eq!(planned(glass, &light(&[])), Plan { glass: true, ..mirrored });
        let wet = SceneNeeds { glossy_ground: true, ..needs };
        assert_eq!(planned(wet, &light(&[])), Plan { ground_mirrors: true, ..mirrored });
        let table = SceneNeeds { glossy_place: true, ..needs };
        assert_eq!(planned(table, &light(&[])), Plan { place_mirrors: true, ..mirrored });
        assert_eq!(planned(SceneNeeds { glossy_ground: true, ..SceneNeeds::default() }, &light(&[])), Plan::default());
        assert_eq!(planned(SceneNeeds::default(), &light(&[5.0])), Plan::default());
    }

    #[test]
    fn a_tier_bounds_and_never_adds() {
        let needs = SceneNeeds { objects: 1, reflective: true, ..SceneNeeds::default() };
        let all = planned(needs, &light(&[1.0; 6]));
        let lowest = all.within(Tier::LOWEST);
        assert_eq!(
            (lowest.shadows, lowest.reflections, lowest.reflections_every, lowest.occlusion, lowest.samples),
            (1, true, 4, false, 1)
        );
        assert_eq!(planned(SceneNeeds::default(), &light(&[5.0])).within(Tier::LOWEST), Plan::default());
        let wet = planned(SceneNeeds { glossy_ground: true, glossy_place: true, ..needs }, &light(&[]));
        let lowest = wet.within(Tier::LOWEST);
        assert!(wet.ground_mirrors && wet.place_mirrors && !lowest.ground_mirrors && !lowest.place_mirrors);
        assert_eq!(planned(SceneNeeds { reflective: false, ..needs }, &light(&[])).within(Tier::LOWEST).shadows, 0);
    }

    #[test]
    fn strong_lights_cast_shadows_and_weak_ones_do_not() {
        let needs = SceneNeeds { objects: 1, ..SceneNeeds::default() };
        assert_eq!(planned(needs, &light(&[3.0, 0.5, 0.001])).shadows, 2);
        assert_eq!(planned(needs, &light(&[1.0; 6])).shadows, MAX_SHADOWS);
        assert!(reflects(0.0, false) && reflects(1.0, true) && !reflects(1.0, false));
    }

    /// Sets of lights that cast shadows, frame by frame, of which only `count` may.
    fn casting_over(frames: &[Vec<f32>], count: usize) -> Vec<Vec<u32>> {
        let needs = SceneNeeds { objects: 1, ..SceneNeeds::default() };
        let mut casting = Casting::default();
        let one = |irradiances: &Vec<f32>| {
            let mut frame = light(irradiances);
            casting.order(&mut frame.lights);
            let shadows = Plan::new(needs, &frame, &casting).shadows.min(count);
            casting.keep(&frame.lights[..shadows]);
            let mut ids = casting.0.clone();
            ids.sort_unstable();
            ids
        };
        frames.iter().map(one).collect()
    }

    #[test]
    fn lights_that_are_nearly_alike_do_not_take_turns_at_casting() {
        // By turns one is 10 % stronger than the other, of two where one may cast, and of five where four may.
        let waver = |count: usize| {
            let frame = |i: usize| (0..count).map(|at| if (at + i).is_multiple_of(2) { 1.0 } else { 1.1 }).collect();
            (0..20).map(frame).collect::<Vec<Vec<f32>>>()
        };
        for (lights, most) in [(2, 1), (5, MAX_SHADOWS)] {
            let sets = casting_over(&waver(lights), most);
            assert!(sets[0].len() == most && sets.windows(2).all(|pair| pair[0] == pair[1]), "{sets:?}");
        }
        // One about the share that casts at all.
        let about = SHADOW_SHARE / (1.0 - SHADOW_SHARE) * (1.0 + 0.282_094_8 * std::f32::consts::PI);
        let frames: Vec<Vec<f32>> = (0..20u32).map(|i| vec![1.0, about * if i.is_multiple_of(2) { 1.05 } else { 0.95 }]).collect();
        let sets = casting_over(&frames, MAX_SHADOWS);
        assert!(sets.iter().all(|ids| *ids == [0, 1]), "{sets:?}");
    }

    #[test]
    fn one_that_is_clearly_stronger_takes_over() {
        let sets = casting_over(&[vec![1.0, 0.9], vec![1.0, 1.2], vec![1.0, 1.3], vec![1.0, 1.1]], 1);
        assert_eq!(sets, [[0], [0], [1], [1]]);
        assert_eq!(casting_over(&[vec![1.0, 0.5], vec![1.0, 0.01]], 2), [vec![0, 1], vec![0]]);
    }
}
