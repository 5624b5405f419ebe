//! The equirectangular mapping.
//!
//! u in [0, 1) runs left to right, v in [0, 1] top to bottom, pixel centres at (i + 0.5) / N.
//! Longitude λ = (u − 0.5)·2π, latitude φ = (0.5 − v)·π; the panorama's centre is −z, its right half +x.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

/// Unit direction of the point (u, v).
#[must_use]
pub fn direction_from_uv(uv: Vec2) -> Vec3 {
    let (sin_longitude, cos_longitude) = ((uv.x - 0.5) * TAU).sin_cos();
    let (sin_latitude, cos_latitude) = ((0.5 - uv.y) * PI).sin_cos();
    Vec3::new(cos_latitude * sin_longitude, sin_latitude, -cos_latitude * cos_longitude)
}

/// The point (u, v) of a unit direction, u in [0, 1).
#[must_use]
pub fn uv_from_direction(direction: Vec3) -> Vec2 {
    let longitude = direction.x.atan2(-direction.z);
    let u = longitude / TAU + 0.5;
    Vec2::new(if u >= 1.0 { u - 1.0 } else { u }, 0.5 - direction.y.clamp(-1.0, 1.0).asin() / PI)
}

/// Solid angle of one pixel of row `row` in a `width` × `height` panorama, exactly: the area of a
/// latitude band on the unit sphere over the pixels in it.
#[must_use]
pub fn pixel_solid_angle_sr(row: u32, width: u32, height: u32) -> f32 {
    let sin_latitude = |v: f64| ((0.5 - v) * std::f64::consts::PI).sin();
    let (top, bottom) = (f64::from(row) / f64::from(height), f64::from(row + 1) / f64::from(height));
    ((sin_latitude(top) - sin_latitude(bottom)) * std::f64::consts::TAU / f64::from(width)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn named_directions() {
        for (uv, direction) in
            [((0.5, 0.5), -Vec3::Z), ((0.75, 0.5), Vec3::X), ((0.25, 0.5), -Vec3::X), ((0.0, 0.5), Vec3::Z), ((0.5, 0.0), Vec3::Y)]
        {
            assert!((direction_from_uv(Vec2::from(uv)) - direction).length() < 1e-6, "{uv:?}");
        }
    }

    #[test]
    fn directions_round_trip() {
        for (i, j) in (0..64).flat_map(|i| (0..32).map(move |j| (i, j))) {
            let uv = Vec2::new((i as f32 + 0.5) / 64.0, (j as f32 + 0.5) / 32.0);
            assert!((uv_from_direction(direction_from_uv(uv)) - uv).length() < 1e-4, "{uv}");
        }
    }

    #[test]
    fn pixels_cover_the_sphere() {
        let total: f64 = (0..50).map(|row| f64::from(pixel_solid_angle_sr(row, 100, 50)) * 100.0).sum();
        assert!((total / (4.0 * std::f64::consts::PI) - 1.0).abs() < 1e-6, "{total}");
    }
}
