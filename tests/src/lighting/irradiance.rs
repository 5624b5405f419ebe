//! Irradiance on a grid of normals, and how far an estimate of it is off.

use glam::{DVec3, Vec2, Vec3};
use mr360_protocol::light::DirectionalLight;
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};
use mr360_shaders::sh;

/// Columns and rows of the grid.
const GRID: (u32, u32) = (32, 16);

/// 32×16 normals over the whole sphere, each with the solid angle of its cell.
pub(super) struct Normals {
    directions: Vec<Vec3>,
    weights: Vec<f64>,
}

impl Normals {
    pub(super) fn new() -> Self {
        let (width, height) = GRID;
        let cells = || (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
        let uv = |(column, row): (u32, u32)| Vec2::new((column as f32 + 0.5) / width as f32, (row as f32 + 0.5) / height as f32);
        Self {
            directions: cells().map(|cell| direction_from_uv(uv(cell))).collect(),
            weights: cells().map(|(_, row)| f64::from(pixel_solid_angle_sr(row, width, height))).collect(),
        }
    }

    /// Unit vectors.
    pub(super) fn directions(&self) -> &[Vec3] {
        &self.directions
    }

    /// Irradiance on every normal under spherical harmonics and lights.
    pub(super) fn lit_by(&self, coefficients: &[Vec3], lights: &[DirectionalLight]) -> Vec<DVec3> {
        self.directions.iter().map(|normal| lit_by(coefficients, lights, *normal)).collect()
    }

    /// Σ w |E − T| / Σ w T over RGB.
    pub(super) fn absolute_error(&self, estimate: &[DVec3], truth: &[DVec3]) -> f64 {
        self.sum(estimate, truth, |e, t| (e - t).abs().element_sum()) / self.sum(estimate, truth, |_, t| t.element_sum())
    }

    /// Root of the mean square error after the best single scale, over the mean of the truth.
    pub(super) fn scale_invariant_error(&self, estimate: &[DVec3], truth: &[DVec3]) -> f64 {
        let own = self.sum(estimate, truth, |e, _| e.length_squared());
        let scale = if own > 0.0 { self.sum(estimate, truth, DVec3::dot) / own } else { 0.0 };
        let values = 3.0 * self.weights.iter().sum::<f64>();
        let square = self.sum(estimate, truth, |e, t| (e * scale - t).length_squared()) / values;
        square.sqrt() / (self.sum(estimate, truth, |_, t| t.element_sum()) / values)
    }

    /// Mean angle between the colours, degrees, over the normals that receive light. An estimate that leaves one of
    /// these dark shares nothing with the truth and counts as 90°.
    pub(super) fn colour_error_deg(&self, estimate: &[DVec3], truth: &[DVec3]) -> f64 {
        let angle = |e: DVec3, t: DVec3| match (e == DVec3::ZERO, t == DVec3::ZERO) {
            (_, true) => 0.0,
            (true, false) => 90.0,
            (false, false) => e.cross(t).length().atan2(e.dot(t)).to_degrees(),
        };
        let lit = self.sum(estimate, truth, |_, t| if t == DVec3::ZERO { 0.0 } else { 1.0 });
        if lit > 0.0 { self.sum(estimate, truth, angle) / lit } else { 0.0 }
    }

    /// Σ w f(E, T).
    fn sum(&self, estimate: &[DVec3], truth: &[DVec3], f: impl Fn(DVec3, DVec3) -> f64) -> f64 {
        self.weights.iter().zip(estimate).zip(truth).map(|((w, e), t)| w * f(*e, *t)).sum()
    }
}

/// What a viewer lights a surface of this normal with: the harmonics, clamped at 0, and every light's cosine.
pub(super) fn lit_by(coefficients: &[Vec3], lights: &[DirectionalLight], normal: Vec3) -> DVec3 {
    let direct: DVec3 = lights.iter().map(|light| light.irradiance.as_dvec3() * f64::from(normal.dot(light.direction).max(0.0))).sum();
    sh::irradiance(coefficients, normal).as_dvec3() + direct
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    /// Upper and lower hemisphere of even irradiance; the grid has as much of one as of the other.
    fn halves(normals: &Normals, up: DVec3, down: DVec3) -> Vec<DVec3> {
        normals.directions().iter().map(|normal| if normal.y > 0.0 { up } else { down }).collect()
    }

    fn close(a: f64, b: f64) -> bool {
        // Weights and directions are single precision.
        (a - b).abs() < 1e-5
    }

    #[test]
    fn normals_cover_the_sphere_evenly() {
        let normals = Normals::new();
        assert_eq!(normals.directions().len(), 512);
        assert!(close(normals.weights.iter().sum::<f64>() / (4.0 * PI), 1.0));
        let sum: DVec3 = normals.directions().iter().zip(&normals.weights).map(|(n, w)| n.as_dvec3() * *w).sum();
        assert!(sum.length() < 1e-4, "{sum}");
    }

    #[test]
    fn uniform_light_and_one_light() {
        let mut coefficients = [Vec3::ZERO; 9];
        coefficients[0] = Vec3::new(1.0, 2.0, 3.0) * (4.0 * std::f32::consts::PI).sqrt();
        let direction = Vec3::new(0.0, 0.6, 0.8);
        let light = DirectionalLight { id: 0, direction, irradiance: Vec3::new(5.0, 4.0, 3.0), solid_angle_sr: 0.01 };
        let even = DVec3::new(1.0, 2.0, 3.0) * PI;
        for (normal, cosine) in [(direction, 1.0), (Vec3::Y, 0.6), (Vec3::X, 0.0), (-direction, 0.0)] {
            let expected = even + light.irradiance.as_dvec3() * cosine;
            assert!((lit_by(&coefficients, &[light], normal) - expected).abs().max_element() < 1e-4, "{normal}");
        }
        // Ringing harmonics give no negative light, and take none of a light's.
        coefficients[0] = -coefficients[0];
        assert!((lit_by(&coefficients, &[light], direction) - light.irradiance.as_dvec3()).abs().max_element() < 1e-6);
    }

    #[test]
    fn a_known_scale_is_the_absolute_error_and_none_of_the_others() {
        let normals = Normals::new();
        let truth = halves(&normals, DVec3::new(3.0, 2.0, 1.0), DVec3::new(0.5, 0.4, 0.3));
        for scale in [0.25, 1.0, 3.0f64] {
            let estimate: Vec<_> = truth.iter().map(|t| *t * scale).collect();
            assert!(close(normals.absolute_error(&estimate, &truth), (scale - 1.0).abs()));
            assert!(close(normals.scale_invariant_error(&estimate, &truth), 0.0));
            assert!(close(normals.colour_error_deg(&estimate, &truth), 0.0));
        }
        let dark = vec![DVec3::ZERO; 512];
        assert!(close(normals.absolute_error(&dark, &truth), 1.0) && close(normals.colour_error_deg(&dark, &truth), 90.0));
        // Darkness is off by the root mean square over the mean.
        let (mean, square) = (7.2 / 6.0, (14.0 + 0.5) / 6.0);
        assert!(close(normals.scale_invariant_error(&dark, &truth), f64::sqrt(square) / mean));
    }

    #[test]
    fn an_even_estimate_of_two_halves() {
        let normals = Normals::new();
        let truth = halves(&normals, DVec3::ONE, DVec3::splat(3.0));
        let estimate = vec![DVec3::ONE; 512];
        // (0 + 2) / (1 + 3).
        assert!(close(normals.absolute_error(&estimate, &truth), 0.5));
        // The best scale is 2, both halves are then off by 1, and the mean is 2.
        assert!(close(normals.scale_invariant_error(&estimate, &truth), 0.5));
    }

    #[test]
    fn colours_are_compared_by_their_angle() {
        let normals = Normals::new();
        let truth = halves(&normals, DVec3::ONE, DVec3::ZERO);
        let estimate = halves(&normals, DVec3::new(7.0, 7.0, 0.0), DVec3::X);
        // Between (1, 1, 1) and (1, 1, 0); where there is no light there is no colour to miss.
        let expected = (2.0 / 6f64.sqrt()).acos().to_degrees();
        assert!(close(normals.colour_error_deg(&estimate, &truth), expected));
        let half_dark = halves(&normals, DVec3::ZERO, DVec3::ONE);
        assert!(close(normals.colour_error_deg(&half_dark, &halves(&normals, DVec3::ONE, DVec3::ONE)), 45.0));
    }
}
