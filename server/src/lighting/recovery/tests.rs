use std::f32::consts::PI;

use glam::Vec3;
use mr360_protocol::light::Lift;
use mr360_shaders::colour::{luminance, recovered};

use super::*;
use crate::lighting::panorama::Geometry;

const SIZE: Grid = Grid { width: 512, height: 256, supersample: 1 };

/// A panorama of this radiance in each direction.
fn panorama(of: impl Fn(Vec3) -> Vec3) -> Panorama {
    let mut panorama = Panorama::new(SIZE, Lift::Linear);
    for texel in 0..512 * 256 {
        let direction = panorama.geometry.direction(texel / 512, texel % 512);
        panorama.set_radiance(texel, of(direction));
    }
    panorama
}

/// Sky, ground, and a clipped disc of this half angle.
fn scene(to_light: Vec3, half_angle_deg: f32, ground: f32) -> impl Fn(Vec3) -> Vec3 {
    let cosine = half_angle_deg.to_radians().cos();
    move |d: Vec3| {
        if d.dot(to_light) > cosine {
            Vec3::ONE
        } else if d.y > 0.0 {
            Vec3::new(0.2, 0.3, 0.5)
        } else {
            Vec3::splat(ground)
        }
    }
}

/// Shows the panorama to the recoverer, and has it brightened.
fn recover(recoverer: &mut Recoverer, panorama: &mut Panorama) -> Option<Recovered> {
    recover_with(recoverer, panorama, &mut Luminance::new(&Geometry::new(SIZE), recoverer.rows_at_once()))
}

fn recover_with(recoverer: &mut Recoverer, panorama: &mut Panorama, luminance: &mut Luminance) -> Option<Recovered> {
    recoverer.begin();
    let count = recoverer.rows_at_once();
    (0..panorama.size.height as usize / count).for_each(|row| recoverer.see(&panorama.rows(row * count, count), luminance));
    recoverer.recover(panorama, luminance)
}

fn flux(panorama: &Panorama) -> f64 {
    let row = |row: usize| {
        let sum: f64 = (0..512).map(|column| f64::from(luminance(panorama.radiance(row * 512 + column)))).sum();
        sum * f64::from(panorama.geometry.solid_angle_sr[row])
    };
    (0..256).map(row).sum()
}

#[test]
fn the_regression_agrees_with_its_reference() {
    // Worked out by NumPy in double precision from the weights as they were fitted.
    for (given, expected) in REFERENCE {
        let [size, height, ground_ln, brightness_ln] = given;
        let got = excess::excess_ln(&excess::Surroundings { size, height, ground_ln, brightness_ln });
        assert!((got - expected).abs() < 1e-4, "{given:?}: {got} against {expected}");
    }
}

#[test]
fn a_frame_without_clipped_texels_is_left_as_it_is() {
    let even = |d: Vec3| Vec3::splat(0.5 + 0.41 * d.y);
    let mut panorama = panorama(even);
    assert_eq!(recover(&mut Recoverer::new(SIZE), &mut panorama), None);
    assert!((0..512 * 256).all(|texel| panorama.radiance(texel) == even(panorama.geometry.direction(texel / 512, texel % 512))));
}

#[test]
fn what_is_added_is_what_the_curve_says_and_what_is_reported() {
    let to_light = Vec3::new(0.3, 0.8, -0.5).normalize();
    let mut panorama = panorama(scene(to_light, 5.0, 0.25));
    let before = flux(&panorama);
    let shown: Vec<Vec3> = (0..512 * 256).map(|texel| panorama.radiance(texel)).collect();
    let found = recover(&mut Recoverer::new(SIZE), &mut panorama).unwrap();
    let after = flux(&panorama);
    assert!(after > 1.05 * before && (1.0 - before / after - f64::from(found.hidden_share)).abs() < 1e-5, "{before} {after} {found:?}");
    for (texel, shown) in shown.iter().enumerate() {
        let direction = panorama.geometry.direction(texel / 512, texel % 512);
        let (got, expected) = (panorama.radiance(texel), recovered(&found.curve, direction, *shown));
        // The curve is read once a cell, at most 2° from the texel.
        let steepest = found.curve.slope.length() * 2f32.to_radians();
        assert!((got - expected).abs().max_element() <= (steepest.exp() - 1.0) * expected.max_element() + 1e-5, "{got} {expected}");
    }
    // The light's colour is its rim's: the blue of the sky, as far as red and blue are believed.
    let rim = [(0.2f32 / 0.3).ln(), (0.5f32 / 0.3).ln()];
    assert!((found.curve.tint_ln[0] - rim[0]).abs() < 0.02 && (found.curve.tint_ln[1] - BLUE_SHARE * rim[1]).abs() < 0.02, "{found:?}");
    assert!(found.sigma > 0.3 && found.sigma < 3.0, "{found:?}");
}

#[test]
fn luminance_and_harmonics_know_of_what_was_added() {
    let mut panorama = panorama(scene(Vec3::new(0.3, 0.8, -0.5).normalize(), 5.0, 0.25));
    let mut recoverer = Recoverer::new(SIZE);
    let [mut got, mut expected] = [0; 2].map(|_| Luminance::new(&panorama.geometry, recoverer.rows_at_once()));
    let count = recoverer.rows_at_once();
    (0..256 / count).for_each(|row| recoverer.see(&panorama.rows(row * count, count), &mut got));
    // What is recovered is left in the cells.
    let shown = recoverer.cells.radiance.clone();
    let found = recover_with(&mut recoverer, &mut panorama, &mut got).unwrap();
    (0..256 / count).for_each(|row| expected.see(&panorama.rows(row * count, count)));
    assert!(got.texels().iter().zip(expected.texels()).all(|(got, expected)| (got - expected).abs() <= 1e-5 * expected));
    let (statistics, expected) = (got.statistics(), expected.statistics());
    for (got, expected) in [(statistics.energy, expected.energy), (f64::from(statistics.threshold()), f64::from(expected.threshold()))] {
        assert!((got / expected - 1.0).abs() < 1e-5, "{got} against {expected}");
    }
    let texels = Series::new(SIZE, SH25);
    let [mut got, mut expected] = [[Vec3::ZERO; SH25]; 2];
    recoverer.cells.radiance.clone_from(&shown);
    recoverer.project(&mut got);
    recoverer.project_hidden(&texels, &found, &mut got);
    texels.project(&panorama, &mut expected);
    for (got, expected_one) in got.iter().zip(expected) {
        // Of what is shown a cell is even; what is hidden is exact.
        assert!((*got - expected_one).abs().max_element() < 1e-3 * expected[0].max_element(), "{got} against {expected_one}");
    }
}

#[test]
fn a_single_light_gets_what_its_surroundings_ask_for() {
    // One disc in the middle of cells that are all alike: the curve passes through their mean.
    let to_light = Vec3::new(0.0, 0.6, -0.8);
    let mut panorama = panorama(scene(to_light, 6.0, 0.25));
    let mut recoverer = Recoverer::new(SIZE);
    let found = recover(&mut recoverer, &mut panorama).unwrap();
    let clipped = recoverer.places.clipped_flux.iter().zip(&recoverer.places.excess_ln);
    let asked: f64 = clipped.map(|(flux, ln)| f64::from(flux * ln.exp())).sum();
    let given = f64::from(found.hidden_share) * flux(&panorama);
    assert!((given / asked - 1.0).abs() < 5e-3, "{given} {asked}");
}

#[test]
fn a_brighter_ground_asks_for_more_light() {
    let hidden = |ground: f32| {
        let mut panorama = panorama(scene(Vec3::new(0.0, 0.6, -0.8), 4.0, ground));
        let before = flux(&panorama);
        recover(&mut Recoverer::new(SIZE), &mut panorama).unwrap();
        flux(&panorama) - before
    };
    let hidden = [0.02, 0.08, 0.2, 0.4].map(hidden);
    assert!(hidden.windows(2).all(|pair| pair[1] > 1.1 * pair[0]), "{hidden:?}");
}

#[test]
fn neither_seam_nor_heading_matters() {
    let at = |longitude: f32| {
        let light = Vec3::new(0.8 * longitude.sin(), 0.6, -0.8 * longitude.cos());
        let mut panorama = panorama(scene(light, 5.0, 0.3));
        recover(&mut Recoverer::new(SIZE), &mut panorama).unwrap()
    };
    // 90° are 32 cells exactly; the light stands across the seam at 180°.
    let all = [0.0, 0.5 * PI, PI, 1.5 * PI].map(at);
    for found in &all {
        assert!(
            (found.hidden_share / all[0].hidden_share - 1.0).abs() < 2e-3 && (found.curve.slope.y - all[0].curve.slope.y).abs() < 5e-3,
            "{all:?}"
        );
    }
}

#[test]
fn nothing_moves_by_a_jump_when_a_region_comes_to_be_clipped() {
    let hidden = |level: f32| {
        let disc = scene(Vec3::new(0.0, 0.6, -0.8), 4.0, 0.3);
        let mut panorama = panorama(|d| if disc(d) == Vec3::ONE { Vec3::splat(level) } else { disc(d) });
        recover(&mut Recoverer::new(SIZE), &mut panorama).map_or(0.0, |found| found.hidden_share)
    };
    let levels: Vec<f32> = (0..=40).map(|i| hidden(0.915 + 0.002 * i as f32)).collect();
    let most = levels[40];
    assert!(levels[0] == 0.0 && most > 0.02, "{levels:?}");
    // The ramp's steepest is 1.5 over 35 of these steps.
    assert!(levels.windows(2).all(|pair| pair[1] >= pair[0] - 1e-4 && pair[1] - pair[0] < 0.08 * most), "{levels:?}");
}

#[test]
fn the_blur_is_a_mean_over_a_box_on_the_sphere() {
    let cells = Cells::new(Grid { width: 64, height: 32, supersample: 1 });
    let mut blur = Blur::new(cells.columns, &cells.solid_angle_sr, &cells.latitude);
    let field: Vec<f32> = (0..64 * 32).map(|i| ((i * 7919) % 101) as f32 / 101.0).collect();
    let mut got = vec![0.0; field.len()];
    blur.run(&field, 360.0 / 64.0 * 3.0, &mut got);
    let pass = |field: &[f32]| -> Vec<f32> {
        let across = |row: usize, column: usize| {
            let reach = (3.0 / cells.latitude[row].cos()).round() as i64;
            let reach = if 2 * reach + 1 >= 64 { 32 } else { reach };
            let columns = if reach == 32 { -32..=31 } else { -reach..=reach };
            let count = columns.clone().count() as f32;
            columns.map(|k| field[row * 64 + (column as i64 + k).rem_euclid(64) as usize]).sum::<f32>() / count
        };
        let mean = |i: usize| {
            let rows = (i / 64).saturating_sub(3)..=(i / 64 + 3).min(31);
            let weight: f32 = rows.clone().map(|row| cells.solid_angle_sr[row]).sum();
            rows.map(|row| cells.solid_angle_sr[row] * across(row, i % 64)).sum::<f32>() / weight
        };
        (0..64 * 32).map(mean).collect()
    };
    let expected = pass(&pass(&field));
    assert!(got.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-5));
}

/// Size, height, ground and brightness, and the logarithm of the excess.
const REFERENCE: [([f32; 4], f32); 6] = [
    ([0.1, 0.5, -0.8, -1.4], 0.819_326),
    ([0.9, -0.3, 0.7, -3.0], 0.137_963),
    ([0.002, 0.99, -2.5, 0.0], 0.305_26),
    ([0.3, 0.2, 1.2, -0.5], 2.544_614),
    ([0.0, 0.05, -3.4, -3.9], -1.889_146),
    ([1.0, 1.0, 3.0, 1.0], 5.950_335),
];

#[test]
fn the_density_is_even_between_the_middles_of_cells() {
    for side in [1usize, 2, 4, 8] {
        let (columns, rows) = (32, 16);
        let share: Vec<f32> = (0..columns * rows).map(|cell| ((cell * 7919) % 101) as f32).collect();
        let density = Density { share: &share, columns, side };
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        for row in [0, side, 7 * side + side / 2, 16 * side - 1] {
            let mut along = vec![0.0; 20 * side + 1];
            for start in [0, 3, 32 * side - along.len()] {
                density.along(row, start..start + along.len(), &mut along);
                for (column, got) in (start..).zip(&along) {
                    let (x, y) = ((column as f32 + 0.5) / side as f32 - 0.5, ((row as f32 + 0.5) / side as f32 - 0.5).clamp(0.0, 15.0));
                    let cell = |row: f32, column: f32| share[row as usize * 32 + column.rem_euclid(32.0) as usize];
                    let [upper, lower] = [y.floor(), (y.floor() + 1.0).min(15.0)]
                        .map(|row| mix(cell(row, x.floor()), cell(row, x.floor() + 1.0), x - x.floor()));
                    let expected = mix(upper, lower, y - y.floor());
                    assert!((got - expected).abs() < 1e-3, "side {side}, {row} {column}: {got} {expected}");
                }
            }
        }
    }
}
