//! Real spherical harmonics of radiance, bands 0–4, on world components; index l(l+1)+m.
//!
//! Irradiance follows Ramamoorthi & Hanrahan 2001: convolving with the clamped cosine scales band l by
//! (π, 2π/3, π/4, 0, −π/24).

use std::f32::consts::PI;

use glam::Vec3;

/// Factors that turn a radiance coefficient of band l into one of irradiance.
pub const IRRADIANCE_BAND: [f32; 5] = [PI, 2.0 * PI / 3.0, PI / 4.0, 0.0, -PI / 24.0];

/// Band of coefficient `index`.
#[must_use]
pub fn band(index: usize) -> usize {
    index.isqrt()
}

/// Bands 0–2 in a direction.
#[must_use]
pub fn basis9(d: Vec3) -> [f32; 9] {
    let Vec3 { x, y, z } = d;
    [
        0.282_094_8,
        0.488_602_5 * y,
        0.488_602_5 * z,
        0.488_602_5 * x,
        1.092_548_4 * x * y,
        1.092_548_4 * y * z,
        0.315_391_57 * (3.0 * z * z - 1.0),
        1.092_548_4 * x * z,
        0.546_274_2 * (x * x - y * y),
    ]
}

/// Bands 0–4 in a direction.
#[must_use]
pub fn basis25(d: Vec3) -> [f32; 25] {
    let Vec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let mut out = [0.0; 25];
    out[..9].copy_from_slice(&basis9(d));
    out[9..].copy_from_slice(&[
        0.590_043_6 * y * (3.0 * xx - yy),
        2.890_611_4 * x * y * z,
        0.457_045_8 * y * (5.0 * zz - 1.0),
        0.373_176_33 * z * (5.0 * zz - 3.0),
        0.457_045_8 * x * (5.0 * zz - 1.0),
        1.445_305_7 * z * (xx - yy),
        0.590_043_6 * x * (xx - 3.0 * yy),
        2.503_342_9 * x * y * (xx - yy),
        1.770_130_8 * y * z * (3.0 * xx - yy),
        0.946_174_7 * x * y * (7.0 * zz - 1.0),
        0.669_046_5 * y * z * (7.0 * zz - 3.0),
        0.105_785_55 * (35.0 * zz * zz - 30.0 * zz + 3.0),
        0.669_046_5 * x * z * (7.0 * zz - 3.0),
        0.473_087_34 * (xx - yy) * (7.0 * zz - 1.0),
        1.770_130_8 * x * z * (xx - 3.0 * yy),
        0.625_835_7 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
    ]);
    out
}

/// Radiance in a direction; may be negative where the series rings.
#[must_use]
pub fn radiance(coefficients: &[Vec3], direction: Vec3) -> Vec3 {
    coefficients.iter().zip(basis25(direction)).map(|(c, y)| *c * y).sum()
}

/// Irradiance on a surface of this normal, clamped at 0.
#[must_use]
pub fn irradiance(coefficients: &[Vec3], normal: Vec3) -> Vec3 {
    let sum: Vec3 = coefficients.iter().zip(basis25(normal)).enumerate().map(|(i, (c, y))| *c * (y * IRRADIANCE_BAND[band(i)])).sum();
    sum.max(Vec3::ZERO)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::equirect::{direction_from_uv, pixel_solid_angle_sr};
    use glam::Vec2;

    fn integrate(f: impl Fn(Vec3) -> f64) -> f64 {
        let (width, height) = (256, 128);
        let mut sum = 0.0;
        for row in 0..height {
            let solid_angle = f64::from(pixel_solid_angle_sr(row, width, height));
            for column in 0..width {
                let uv = Vec2::new((column as f32 + 0.5) / width as f32, (row as f32 + 0.5) / height as f32);
                sum += f(direction_from_uv(uv)) * solid_angle;
            }
        }
        sum
    }

    #[test]
    fn basis_is_orthonormal() {
        for i in 0..25 {
            for j in 0..=i {
                let product = integrate(|d| f64::from(basis25(d)[i]) * f64::from(basis25(d)[j]));
                let expected = if i == j { 1.0 } else { 0.0 };
                // Midpoint quadrature on 256×128 pixels is good to 1e-3 for degree 8.
                assert!((product - expected).abs() < 1e-3, "⟨{i},{j}⟩ = {product}");
            }
        }
    }

    #[test]
    fn white_furnace() {
        let mut coefficients = [Vec3::ZERO; 9];
        coefficients[0] = Vec3::splat((4.0 * PI).sqrt());
        assert!((radiance(&coefficients, Vec3::X) - 1.0).abs().max_element() < 1e-5);
        assert!((irradiance(&coefficients, Vec3::Y) - PI).abs().max_element() < 1e-4);
    }

    #[test]
    fn irradiance_bands_are_the_clamped_cosine() {
        for (i, l) in [(0, 0), (2, 1), (6, 2), (12, 3), (20, 4)] {
            let projected = integrate(|d| f64::from(d.z.max(0.0)) * f64::from(basis25(d)[i]));
            let scaled = f64::from(IRRADIANCE_BAND[l]) * f64::from(basis25(Vec3::Z)[i]);
            assert!((projected - scaled).abs() < 1e-3, "band {l}: {projected} against {scaled}");
        }
    }
}
