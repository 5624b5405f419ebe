//! Projection of an equirect panorama on spherical harmonics (Ramamoorthi & Hanrahan 2001, Eq. 10).

use glam::{Vec2, Vec3};

use crate::equirect::{direction_from_uv, pixel_solid_angle_sr};
use crate::sh::basis25;

/// First `N` (at most 25) coefficients of the radiance of a `width` × `height` panorama, row by row from the
/// top: the sum of radiance · basis · solid angle over its pixels. Rows or pixels that are missing count as black.
#[must_use]
pub fn project<const N: usize>(radiance: &[Vec3], width: u32, height: u32) -> [Vec3; N] {
    let mut sums = [[0.0f64; 3]; N];
    for (row, pixels) in (0..height).zip(radiance.chunks(width.max(1) as usize)) {
        let solid_angle = pixel_solid_angle_sr(row, width, height);
        for (column, pixel) in pixels.iter().enumerate() {
            let uv = Vec2::new((column as f32 + 0.5) / width as f32, (row as f32 + 0.5) / height as f32);
            for (sum, basis) in sums.iter_mut().zip(basis25(direction_from_uv(uv))) {
                let weight = f64::from(basis * solid_angle);
                for (sum, value) in sum.iter_mut().zip(pixel.to_array()) {
                    *sum += weight * f64::from(value);
                }
            }
        }
    }
    sums.map(|[r, g, b]| Vec3::new(r as f32, g as f32, b as f32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sh::{irradiance, radiance};

    #[test]
    fn a_band_limited_panorama_comes_back() {
        let mut coefficients = [Vec3::ZERO; 9];
        for (i, c) in coefficients.iter_mut().enumerate() {
            *c = Vec3::new(1.0, 0.1 * i as f32, -0.05 * i as f32);
        }
        let (width, height) = (128, 64);
        let pixel = |i: u32| {
            let uv = Vec2::new(((i % width) as f32 + 0.5) / width as f32, ((i / width) as f32 + 0.5) / height as f32);
            radiance(&coefficients, direction_from_uv(uv))
        };
        let panorama: Vec<Vec3> = (0..width * height).map(pixel).collect();
        for (found, expected) in project::<9>(&panorama, width, height).iter().zip(coefficients) {
            // Midpoint quadrature on 128×64 pixels is good to 1e-3 for products of degree 4.
            assert!((*found - expected).abs().max_element() < 2e-3, "{found} against {expected}");
        }
    }

    #[test]
    fn uniform_radiance_gives_pi_of_irradiance() {
        let sh = project::<9>(&vec![Vec3::ONE; 64 * 32], 64, 32);
        assert!((irradiance(&sh, Vec3::new(0.6, 0.0, 0.8)) - std::f32::consts::PI).abs().max_element() < 1e-3);
    }
}
