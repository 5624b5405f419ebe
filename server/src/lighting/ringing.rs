//! Why SH that ring are not windowed.
//!
//! SH that end after a few bands dip below zero on the far side of something bright. Irradiance can then come out negative, and viewers clamp it at
//! 0. The usual remedy divides band l by 1 + λ·l²(l+1)² (Sloan 2008, "Stupid Spherical Harmonics Tricks") with the least λ at which nothing is
//! negative. It takes accuracy from everywhere else, more than the clamp costs where it acts; two more bands cost none, and the frames that would ring
//! have them (`track::energy`). This holds all of it against closed forms; no frame of 16 panoramas rings at all, HDR or clipped.

use glam::Vec3;
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};
use mr360_shaders::sh::{IRRADIANCE_BAND, band, basis25};

const GRID: (u32, u32) = (128, 64);

/// Directions evenly over longitude and latitude, with their solid angles.
fn sphere((width, height): (u32, u32)) -> impl Iterator<Item = (Vec3, f32)> {
    (0..height).flat_map(move |row| (0..width).map(move |column| (row, column))).map(move |(row, column)| {
        let uv = glam::Vec2::new((column as f32 + 0.5) / width as f32, (row as f32 + 0.5) / height as f32);
        (direction_from_uv(uv), pixel_solid_angle_sr(row, width, height))
    })
}

fn irradiance(sh: &[f32], normal: Vec3, lambda: f32) -> f32 {
    let term = |(i, (c, y)): (usize, (&f32, f32))| {
        let l = band(i) as f32;
        c * y * IRRADIANCE_BAND[band(i)] / (1.0 + lambda * (l * (l + 1.0)).powi(2))
    };
    sh.iter().zip(basis25(normal)).enumerate().map(term).sum()
}

/// Least of the irradiance, and its mean error over that of the truth when it is clamped.
fn least_and_error(sh: &[f32], lambda: f32, light: f32, truth: &[(Vec3, f32, f32)]) -> (f32, f32) {
    let (mut least, mut wrong, mut all) = (f32::INFINITY, 0.0, 0.0);
    for (normal, solid_angle_sr, expected) in truth {
        let rest = irradiance(sh, *normal, lambda);
        least = least.min(rest);
        wrong += solid_angle_sr * (rest.max(0.0) + light * normal.y.max(0.0) - expected).abs();
        all += solid_angle_sr * expected;
    }
    (least, wrong / all)
}

/// Errors of a disc of radiance 1 about the zenith in a sky of this radiance, sent as a light as strong as `track::energy` sends it and SH of the
/// rest: clamped, and windowed until it is not negative.
fn errors(radius: f32, sky: f32, coefficients: usize) -> (f32, f32, f32) {
    let radiance = |d: Vec3| if d.y > radius.cos() { 1.0 } else { sky };
    let mut sh = vec![0.0; coefficients];
    for (d, solid_angle_sr) in sphere(GRID) {
        sh.iter_mut().zip(basis25(d)).for_each(|(sum, y)| *sum += radiance(d) * y * solid_angle_sr);
    }
    let (c, half) = (radius.cos(), 0.5 * (1.0 + radius.cos()));
    let light = std::f32::consts::TAU * (1.0 - c) * (1.0 - sky) * (0.25 + 0.5 * half + 0.3125 * c * half) / 1.0625;
    sh.iter_mut().zip(basis25(Vec3::Y)).for_each(|(sum, y)| *sum -= light * y);
    let gather = |normal: Vec3| sphere(GRID).map(|(d, solid_angle_sr)| radiance(d) * d.dot(normal).max(0.0) * solid_angle_sr).sum::<f32>();
    let truth: Vec<_> = sphere((16, 16)).map(|(normal, solid_angle_sr)| (normal, solid_angle_sr, gather(normal))).collect();
    let (least, clamped) = least_and_error(&sh, 0.0, light, &truth);
    let (mut rings, mut still) = (0.0, 1.0);
    for _ in 0..16 {
        let middle = 0.5 * (rings + still);
        if least_and_error(&sh, middle, light, &truth).0 >= 0.0 { still = middle } else { rings = middle }
    }
    (least, clamped, least_and_error(&sh, still, light, &truth).1)
}

#[test]
fn clamping_costs_less_than_a_window() {
    for radius in [0.5, 0.9, 1.2] {
        for coefficients in [9, 25] {
            let (least, clamped, windowed) = errors(radius, 0.0, coefficients);
            // 6.3 against 7.2, 8.9 against 10.6, 8.0 against 11.2 % with 9; 4.5 against 7.1, 4.2 against 9.3, 3.4 against 9.2 % with 25.
            assert!(least < 0.0 && clamped < 0.9 * windowed, "{radius} {coefficients}: {least} {clamped} {windowed}");
        }
    }
}

#[test]
fn two_more_bands_take_the_ringing_away() {
    for radius in [0.9, 1.2] {
        let ((few, by_few, _), (more, by_more, _)) = (errors(radius, 0.02, 9), errors(radius, 0.02, 25));
        assert!(few < 0.0 && more > 0.0 && by_more < 0.55 * by_few, "{radius}: {few} {more} {by_few} {by_more}");
    }
}
