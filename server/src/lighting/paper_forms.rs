//! What the formulas of Rhee et al. 2017 give where they part from the truth, in closed form.

use std::f32::consts::PI;

use glam::{Vec2, Vec3};
use mr360_protocol::video::Transfer;
use mr360_shaders::equirect::{direction_from_uv, uv_from_direction};

use super::closed_forms::{Disc, SUN, assert_conserved, degrees, estimate, frame, irradiance, nine_sh, normals, relative, sky};
use super::{Directional, Mr360};

/// Rows of the method's upper half.
const ROWS: f32 = 150.0;
/// Height of one in degrees.
const ROW_DEG: f32 = 0.6;

/// Share of a disc of `k` rows over the pole that μ + 2σ leaves to the SH. The rim lies on a row's edge, so that μ is k/150 of
/// the radiance and the 3×3 blur makes 1, 1 of the last row inside and the first outside 2/3 and 1/3: the mean square is (k − 4/9)/150.
fn left_of_rows(k: f32) -> f32 {
    let mean = k / ROWS;
    mean + 2.0 * ((k - 4.0 / 9.0) / ROWS - mean * mean).sqrt()
}

/// Eq. 5 over an even disc, by points of equal area: the means of longitude and latitude.
fn mean_of_angles(disc: Disc) -> Vec3 {
    let (right, up) = disc.centre.any_orthonormal_pair();
    let (rings, spokes) = (100, 720);
    let mut sum = Vec2::ZERO;
    for (ring, spoke) in (0..rings).flat_map(|ring| (0..spokes).map(move |spoke| (ring, spoke))) {
        let share = (ring as f32 + 0.5) / rings as f32;
        let (sin, cos) = (2.0 * ((disc.radius / 2.0).sin() * share.sqrt()).asin()).sin_cos();
        let turn = Vec2::from_angle((spoke as f32 + 0.5) / spokes as f32 * 2.0 * PI);
        sum += uv_from_direction(disc.centre * cos + (right * turn.x + up * turn.y) * sin);
    }
    direction_from_uv(sum / (rings * spokes) as f32)
}

#[test]
fn a_disc_over_the_pole_leans_to_the_picture_centre() {
    // Longitudes all around cancel to that of the picture's centre. Polar angles are averaged at the rows' centres, of which
    // row j has 2j + 1 parts of the area: Σ (2j + 1)(j + ½) / k² rows, or (4k² − 1) / 6k. For many rows that is two
    // thirds of the radius.
    for k in [1.0f32, 4.0, 8.0] {
        let disc = Disc::at(0.0, 90.0, k * ROW_DEG, SUN);
        let frame = sky(Transfer::Linear, Vec3::ZERO, &[disc]);
        let estimate = estimate(&mut Mr360::new(false), &frame);
        assert_eq!(estimate.lights.len(), 1, "{estimate:?}");
        let light = &estimate.lights[0];
        let (sin, cos) = ((4.0 * k * k - 1.0) / (6.0 * k) * ROW_DEG).to_radians().sin_cos();
        let leaning = Vec3::new(0.0, cos, -sin);
        assert!(degrees(light.direction, leaning) < 0.01, "{k}: {light:?}");
        assert!((light.solid_angle_sr / disc.solid_angle_sr() - 1.0).abs() < 1e-3, "{k}: {light:?}");
        let left = left_of_rows(k);
        assert!(relative(light.irradiance, disc.irradiance() * (1.0 - left)) < 2e-3, "{k}: {light:?}");
        for normal in normals().chain([Vec3::Y]).filter(|normal| normal.y.abs() > disc.radius.sin()) {
            let expected = (1.0 - left) * leaning.dot(normal).max(0.0) + left * nine_sh(normal.y);
            let got = irradiance(&estimate, normal) / disc.irradiance();
            // A disc's cosines to the pole average to 1 − r²/4, which the SH see and a light does not.
            assert!((got - expected.max(0.0)).abs().max_element() < 2e-3, "{k} {normal}: {got} against {expected}");
        }
        assert_conserved(&estimate, &frame);
    }
}

#[test]
fn the_real_sun_at_the_zenith_is_within_half_a_degree_and_a_percent() {
    // A disc within the first row is one row of even texels, whatever its size: its light leans by half a row. The frame's points
    // make rings of 0.3° / 64, of which the sun's 0.267° is the 57th.
    for radius in [57.0 / 64.0 * 0.3, ROW_DEG] {
        let disc = Disc::at(0.0, 90.0, radius, SUN);
        let estimate = estimate(&mut Mr360::new(false), &sky(Transfer::Linear, Vec3::ZERO, &[disc]));
        assert_eq!(estimate.lights.len(), 1, "{estimate:?}");
        assert!(degrees(estimate.lights[0].direction, Vec3::Y) < 0.31, "{estimate:?}");
        assert!(relative(irradiance(&estimate, Vec3::Y), disc.irradiance()) < 0.01, "{estimate:?}");
    }
}

#[test]
fn discs_near_the_pole_have_the_mean_of_their_angles() {
    for (longitude, latitude, off) in [(60.0, 89.0, 0.9), (-150.0, 88.0, 3.0), (40.0, 80.0, 0.0)] {
        let disc = Disc::at(longitude, latitude, 2.4, SUN);
        let estimate = estimate(&mut Mr360::new(false), &sky(Transfer::Linear, Vec3::ZERO, &[disc]));
        assert_eq!(estimate.lights.len(), 1, "{estimate:?}");
        let expected = mean_of_angles(disc);
        // A quarter of a row for texels on the rim, whose part above the threshold is smaller than what they cover.
        assert!(degrees(estimate.lights[0].direction, expected) < 0.15, "{longitude} {latitude}: {expected} {estimate:?}");
        assert!(degrees(expected, disc.centre) >= off, "{longitude} {latitude}: {expected}");
    }
}

#[test]
fn the_blur_bridges_gaps_of_a_texel() {
    for (gap, lights) in [(1, 1), (3, 2)] {
        // Two squares of four texels, as large as the method's own.
        let bright = |i: u32, j: u32| (60..64).contains(&j) && ((400..404).contains(&i) || (404 + gap..408 + gap).contains(&i));
        let texels = (0..300).flat_map(|j| (0..600).map(move |i| [if bright(i, j) { 1000.0 } else { 0.0 }; 3])).collect();
        let frame = frame(600, 300, Transfer::Linear, texels);
        let estimate = estimate(&mut Mr360::new(false), &frame);
        assert_eq!(estimate.lights.len(), lights, "{estimate:?}");
        assert_conserved(&estimate, &frame);
    }
}

#[test]
fn a_sun_on_the_seam_is_two_halves() {
    let disc = Disc::at(180.0, 35.0, 2.0, SUN);
    let estimate = estimate(&mut Mr360::new(false), &sky(Transfer::Linear, Vec3::ZERO, &[disc]));
    assert_eq!(estimate.lights.len(), 2, "{estimate:?}");
    // A half disc's centroid lies 4r/3π from its edge.
    let aside = (4.0 * 2.0 / (3.0 * PI)) / 35f32.to_radians().cos();
    let mut halves = [180.0 - aside, -180.0 + aside].map(|longitude| Disc::at(longitude, 35.0, 2.0, SUN).centre);
    if estimate.lights[0].direction.x < 0.0 {
        halves.reverse();
    }
    for (light, half) in estimate.lights.iter().zip(halves) {
        assert!(degrees(light.direction, half) < 0.05, "{half} {light:?}");
    }
    assert!(relative(estimate.lights[0].irradiance, estimate.lights[1].irradiance) < 0.01, "{estimate:?}");
}

#[test]
fn the_fewest_lights_with_nine_tenths_of_the_irradiance_are_kept() {
    // μ + 2σ is 0.04 of the first: their excess is 0.96, 0.56, 0.26 and 0.06 of 1.84, and 90 % is reached by the third.
    let suns = [(-120.0, 1.0), (-40.0, 0.6), (40.0, 0.3), (120.0, 0.1)];
    let discs = suns.map(|(longitude, strength)| Disc::at(longitude, 40.0, 1.5, strength * SUN));
    let frame = sky(Transfer::Linear, Vec3::ZERO, &discs);
    let paper = estimate(&mut Mr360::new(false), &frame);
    assert_eq!(paper.lights.len(), 3, "{paper:?}");
    assert!(paper.lights.iter().zip(&discs).all(|(light, disc)| degrees(light.direction, disc.centre) < 0.5), "{paper:?}");
    assert_conserved(&paper, &frame);
    // The default keeps what has 4 % of the sky's energy above the threshold: the fourth has 0.06 of 2.0.
    let ours = estimate(&mut Directional::default(), &frame);
    assert_eq!(ours.lights.len(), 3, "{ours:?}");
    assert_conserved(&ours, &frame);
}
