//! What a frame needs: which passes run at all. Decided from the scene and the light, in one place.

use mr360_shaders::colour::luminance;
use mr360_shaders::source::ROUGH_TO;

use crate::environment::FrameLight;
use crate::governor::Tier;

/// Most lights that cast shadows.
pub const MAX_SHADOWS: usize = 4;
/// A light casts shadows from this share of the frame's whole irradiance on.
const SHADOW_SHARE: f32 = 0.02;

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
    /// Some object reaches beneath the ground.
    pub beneath_ground: bool,
    /// Some surface is glass.
    pub glass: bool,
    /// The ground mirrors objects.
    pub glossy_ground: bool,
    /// Some mesh of the place mirrors objects.
    pub glossy_place: bool,
}

impl Plan {
    /// Decides.
    #[must_use]
    pub fn new(scene: SceneNeeds, light: &FrameLight) -> Self {
        if scene.objects == 0 {
            return Self { place_mirrors: scene.glossy_place, ..Self::default() }.within(Tier::FULL);
        }
        let ambient = luminance(light.sh[0]).max(0.0) * 0.282_094_8 * std::f32::consts::PI;
        let shares: Vec<f32> = light.lights.iter().map(|light| luminance(light.irradiance).max(0.0)).collect();
        let total = ambient + shares.iter().sum::<f32>();
        let shadows = shares.iter().take(MAX_SHADOWS).take_while(|share| **share > 0.0 && **share >= SHADOW_SHARE * total).count();
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
    use mr360_protocol::light::DirectionalLight;

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
        assert_eq!(Plan::new(needs, &light(&[])), plain);
        let mirror = SceneNeeds { reflective: true, ..needs };
        let mirrored = Plan { reflections: true, reflections_every: 1, ..plain };
        assert_eq!(Plan::new(mirror, &light(&[])), mirrored);
        let glass = SceneNeeds { glass: true, ..mirror };
        assert_eq!(Plan::new(glass, &light(&[])), Plan { glass: true, ..mirrored });
        let wet = SceneNeeds { glossy_ground: true, ..needs };
        assert_eq!(Plan::new(wet, &light(&[])), Plan { ground_mirrors: true, ..mirrored });
        let table = SceneNeeds { glossy_place: true, ..needs };
        assert_eq!(Plan::new(table, &light(&[])), Plan { place_mirrors: true, ..mirrored });
        assert_eq!(Plan::new(SceneNeeds { glossy_ground: true, ..SceneNeeds::default() }, &light(&[])), Plan::default());
        assert_eq!(Plan::new(SceneNeeds::default(), &light(&[5.0])), Plan::default());
    }

    #[test]
    fn a_tier_bounds_and_never_adds() {
        let needs = SceneNeeds { objects: 1, reflective: true, ..SceneNeeds::default() };
        let all = Plan::new(needs, &light(&[1.0; 6]));
        let lowest = all.within(Tier::LOWEST);
        assert_eq!(
            (lowest.shadows, lowest.reflections, lowest.reflections_every, lowest.occlusion, lowest.samples),
            (1, true, 4, false, 1)
        );
        assert_eq!(Plan::new(SceneNeeds::default(), &light(&[5.0])).within(Tier::LOWEST), Plan::default());
        let wet = Plan::new(SceneNeeds { glossy_ground: true, glossy_place: true, ..needs }, &light(&[]));
        let lowest = wet.within(Tier::LOWEST);
        assert!(wet.ground_mirrors && wet.place_mirrors && !lowest.ground_mirrors && !lowest.place_mirrors);
        assert_eq!(Plan::new(SceneNeeds { reflective: false, ..needs }, &light(&[])).within(Tier::LOWEST).shadows, 0);
    }

    #[test]
    fn strong_lights_cast_shadows_and_weak_ones_do_not() {
        let needs = SceneNeeds { objects: 1, ..SceneNeeds::default() };
        assert_eq!(Plan::new(needs, &light(&[3.0, 0.5, 0.001])).shadows, 2);
        assert_eq!(Plan::new(needs, &light(&[1.0; 6])).shadows, MAX_SHADOWS);
        assert!(reflects(0.0, false) && reflects(1.0, true) && !reflects(1.0, false));
    }
}
