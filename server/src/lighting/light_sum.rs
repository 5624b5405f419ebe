//! Texels of a panorama summed into one directional light.

use glam::{DVec3, Vec3};
use mr360_protocol::light::DirectionalLight;
use mr360_shaders::colour::LUMA;

/// Below this share of the strength, the mean of the directions is rounding: light from all around has none.
const LEAST_MEAN_DIRECTION: f64 = 1e-6;

/// The sum of some texels' light.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LightSum {
    /// Radiance times solid angle.
    pub(super) irradiance: DVec3,
    /// Directions weighted by luminance times solid angle.
    pub(super) moment: DVec3,
    /// Luminance squared times solid angle.
    pub(super) concentration: f64,
}

impl LightSum {
    /// Adds a texel.
    pub(super) fn add(&mut self, radiance: Vec3, solid_angle_sr: f64, direction: Vec3) {
        let luminance = f64::from(radiance.dot(LUMA));
        self.irradiance += radiance.as_dvec3() * solid_angle_sr;
        self.moment += direction.as_dvec3() * (luminance * solid_angle_sr);
        self.concentration += luminance * luminance * solid_angle_sr;
    }

    /// Luminance of the irradiance.
    fn strength(&self) -> f64 {
        self.irradiance.dot(LUMA.as_dvec3())
    }

    /// Mean direction of the light, or `otherwise` where it comes from all around alike.
    fn direction(&self, otherwise: Vec3) -> Vec3 {
        if self.moment.length() <= LEAST_MEAN_DIRECTION * self.strength() { otherwise } else { self.moment.normalize().as_vec3() }
    }

    /// The light of all texels, at their mean direction, or none where they are black. The solid angle is that of an
    /// even disc which spreads the light as widely: (Σ Y Ω)² / Σ Y² Ω, where squares of the dimmest light may vanish.
    pub(super) fn light(&self, id: u32, otherwise: Vec3) -> Option<DirectionalLight> {
        let strength = self.strength();
        (strength > 0.0).then(|| DirectionalLight {
            id,
            direction: self.direction(otherwise),
            irradiance: self.irradiance.as_vec3(),
            solid_angle_sr: (strength * strength / self.concentration).min(4.0 * std::f64::consts::PI) as f32,
        })
    }
}

/// Sorts lights, strongest first. The sort does not allocate; equals keep the order of their ids.
pub(super) fn rank(lights: &mut [DirectionalLight]) {
    let luminance = |light: &DirectionalLight| light.irradiance.dot(LUMA);
    lights.sort_unstable_by(|a, b| luminance(b).total_cmp(&luminance(a)).then(a.id.cmp(&b.id)));
}
