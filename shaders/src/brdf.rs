//! The directional albedo of the GGX lobe, tabulated for the shaders; twin of what `brdf.wgsl` integrates to.
//!
//! The lobe is D·V·F with D of Walter et al. 2007, the height-correlated V of Heitz 2014 (Eq. 99) and Schlick's F. Of a
//! uniform environment of radiance 1 it reflects F0·A + B (Karis 2013): A + B is what a white lobe sends back after
//! one bounce, and what it lacks to 1 takes more than one.

use std::f64::consts::PI;
use std::sync::OnceLock;

use glam::Vec2;

/// Columns of the table: √(n·v) from 0 to 1. The albedo of a smooth lobe falls and rises again between 0° and 3° of
/// elevation, where the root spends a fifth of the columns.
pub const ALBEDO_COLUMNS: usize = 32;
/// Rows of the table: perceptual roughness from 0 to 1.
pub const ALBEDO_ROWS: usize = 64;

/// Steps over the polar angle of the visible normals and over half of their azimuth: within 0.001 of the limit where n·v
/// is above 0.03.
const STEPS: (usize, usize) = (32, 16);
/// Below this a lobe is a mirror in double precision too.
const LEAST_ALPHA: f64 = 1e-4;

/// A and B for a view at this cosine from the normal, both in [0, 1].
///
/// Visible normals are drawn evenly (Dupuy and Benyoub 2023): what is left of the integrand is the share of their
/// reflections that is not masked, times Fresnel's two terms. The steps crowd towards grazing normals, whose
/// reflections end below the horizon.
#[must_use]
pub fn albedo(n_dot_v: f32, roughness: f32) -> Vec2 {
    let mu = f64::from(n_dot_v).clamp(1e-4, 1.0);
    let alpha = f64::from(roughness).powi(2).clamp(LEAST_ALPHA, 1.0);
    let a2 = alpha * alpha;
    let sine = (1.0 - mu * mu).sqrt();
    let root = |cosine: f64| (cosine * cosine * (1.0 - a2) + a2).sqrt();
    // The view where the lobe's ellipsoid is a sphere.
    let length = (alpha * sine).hypot(mu);
    let (across, along) = (alpha * sine / length, mu / length);
    let (mut scale, mut bias) = (0.0, 0.0);
    for i in 0..STEPS.0 {
        let t = (i as f64 + 0.5) / STEPS.0 as f64;
        let z = t * t * (1.0 + along) - along;
        let ring = (1.0 - z * z).max(0.0).sqrt();
        for j in 0..STEPS.1 {
            let turn = PI * (j as f64 + 0.5) / STEPS.1 as f64;
            let [x, y, up] = [alpha * (ring * turn.cos() + across), alpha * ring * turn.sin(), z + along];
            let norm = (x * x + y * y + up * up).sqrt().max(f64::MIN_POSITIVE);
            let v_dot_h = ((sine * x + mu * up) / norm).clamp(0.0, 1.0);
            let n_dot_l = 2.0 * v_dot_h * up / norm - mu;
            if n_dot_l > 0.0 {
                let unmasked = n_dot_l * (mu + root(mu)) / (n_dot_l * root(mu) + mu * root(n_dot_l));
                let fresnel = (1.0 - v_dot_h).powi(5);
                scale += 2.0 * t * unmasked * (1.0 - fresnel);
                bias += 2.0 * t * unmasked * fresnel;
            }
        }
    }
    Vec2::new(scale as f32, bias as f32) / (STEPS.0 * STEPS.1) as f32
}

/// Rows of [`ALBEDO_COLUMNS`] texels, roughness 0 first.
#[must_use]
pub fn albedo_table() -> &'static [Vec2] {
    static TABLE: OnceLock<Vec<Vec2>> = OnceLock::new();
    TABLE.get_or_init(|| {
        let step = |at: usize, count: usize| at as f32 / (count - 1) as f32;
        let texel = |at: usize| {
            let root = step(at % ALBEDO_COLUMNS, ALBEDO_COLUMNS);
            albedo(root * root, step(at / ALBEDO_COLUMNS, ALBEDO_ROWS))
        };
        (0..ALBEDO_COLUMNS * ALBEDO_ROWS).map(texel).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A + B at α = 1, where the integral closes: D is 1/π and E = ∫ cos θ / (cos θ + μ) d cos θ.
    fn roughest(mu: f64) -> f64 {
        1.0 - mu * (1.0 / mu).ln_1p()
    }

    /// The shaders' bilinear lookup.
    fn looked_up(n_dot_v: f32, roughness: f32) -> Vec2 {
        let (x, y) = (n_dot_v.sqrt() * (ALBEDO_COLUMNS - 1) as f32, roughness * (ALBEDO_ROWS - 1) as f32);
        let (i, j) = ((x as usize).min(ALBEDO_COLUMNS - 2), (y as usize).min(ALBEDO_ROWS - 2));
        let texel = |i: usize, j: usize| albedo_table()[j * ALBEDO_COLUMNS + i];
        let row = |j: usize| texel(i, j).lerp(texel(i + 1, j), x - i as f32);
        row(j).lerp(row(j + 1), y - j as f32)
    }

    #[test]
    fn the_roughest_lobe_has_a_closed_form() {
        for mu in [0.03, 0.1, 0.3, 0.7, 1.0] {
            let (found, closed) = (albedo(mu as f32, 1.0).element_sum(), roughest(mu) as f32);
            assert!((found - closed).abs() < 1e-3, "{mu}: {found} against {closed}");
        }
    }

    #[test]
    fn a_mirror_reflects_schlick() {
        for mu in [0.03f32, 0.1, 0.3, 0.7, 1.0] {
            let fresnel = (1.0 - mu).powi(5);
            assert!((albedo(mu, 0.0) - Vec2::new(1.0 - fresnel, fresnel)).abs().max_element() < 1e-4, "{mu}: {}", albedo(mu, 0.0));
        }
    }

    #[test]
    fn the_table_is_good_to_half_a_per_cent() {
        let mut worst = (0.0f32, 0.0, 0.0);
        for (i, j) in (0..61).flat_map(|i| (0..61).map(move |j| (i, j))) {
            let (mu, roughness) = (0.03 + 0.97 * i as f32 / 60.0, j as f32 / 60.0);
            let off = looked_up(mu, roughness) - albedo(mu, roughness);
            let off = off.y.abs().max(off.element_sum().abs());
            if off > worst.0 {
                worst = (off, mu, roughness);
            }
        }
        assert!(worst.0 < 0.005, "off by {} at n·v {}, roughness {}", worst.0, worst.1, worst.2);
    }
}
