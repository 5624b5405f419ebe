//! LDR-FLIP: how different two pictures look when one is flipped for the other in place, 0 to 1 a pixel
//! (Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images").
//!
//! As in the authors' own program, version 1.7, with its standard screen: 0.7 m wide, 3840 pixels across, seen from 0.7 m.

use glam::DVec3;

/// Pixels a degree of the standard screen.
const PIXELS_PER_DEGREE: f64 = 3840.0 * std::f64::consts::PI / 180.0;
/// Weights and widths of the two Gaussians of each channel's contrast sensitivity: luminance, red-green, blue-yellow (Table 1).
const SENSITIVITY: [[(f64, f64); 2]; 3] = [[(1.0, 0.0047), (0.0, 1e-5)], [(1.0, 0.0053), (0.0, 1e-5)], [(34.1, 0.04), (13.5, 0.025)]];
/// Widest of [`SENSITIVITY`]: all filters share its radius.
const WIDEST: f64 = 0.04;
/// Exponent of the colour difference; where its response bends, and to what (Sec. 4.1.3).
const QC: f64 = 0.7;
const PC: f64 = 0.4;
const PT: f64 = 0.95;
/// Exponent of the feature difference, and width of the features in degrees (Sec. 4.2).
const QF: f64 = 0.5;
const FEATURE_WIDTH: f64 = 0.082;

/// One value a pixel, in rows from the top.
type Plane = Vec<f64>;

/// An 8-bit sRGB picture's size and what FLIP compares of it.
struct Prepared {
    /// CIELAB after the eye's filter, adjusted for Hunt's effect.
    lab: Vec<DVec3>,
    edges: Plane,
    points: Plane,
}

/// The difference of two pictures of the same size, row by row.
///
/// # Panics
/// When the sizes differ.
#[must_use]
pub fn flip(reference: &image::RgbImage, test: &image::RgbImage) -> Vec<f64> {
    assert_eq!(reference.dimensions(), test.dimensions(), "FLIP compares pictures of one size");
    let (reference, test) = (prepare(reference), prepare(test));
    let extreme = |rgb| hunt(lab_of(xyz_of(rgb)));
    let largest = hyab(extreme(DVec3::Y), extreme(DVec3::Z)).powf(QC);
    let bend = PC * largest;
    let colour = |a, b| {
        let difference = hyab(a, b).powf(QC);
        if difference < bend { PT / bend * difference } else { PT + (difference - bend) / (largest - bend) * (1.0 - PT) }
    };
    (0..reference.lab.len())
        .map(|at| {
            let edges = (reference.edges[at] - test.edges[at]).abs();
            let points = (reference.points[at] - test.points[at]).abs();
            let feature = (edges.max(points) / std::f64::consts::SQRT_2).powf(QF);
            colour(reference.lab[at], test.lab[at]).powf(1.0 - feature)
        })
        .collect()
}

/// The mean of a difference.
#[must_use]
pub fn mean(difference: &[f64]) -> f64 {
    difference.iter().sum::<f64>() / difference.len().max(1) as f64
}

fn prepare(picture: &image::RgbImage) -> Prepared {
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let opponent: Vec<DVec3> = picture.pixels().map(|pixel| opponent_of(xyz_of(DVec3::from(pixel.0.map(linear))))).collect();
    let plane = |channel: usize| opponent.iter().map(|value| value[channel]).collect::<Plane>();
    let filtered = [0, 1, 2].map(|channel| sensed(&plane(channel), width, height, SENSITIVITY[channel]));
    let lab = (0..width * height).map(|at| {
        let rgb = rgb_of(xyz_of_opponent(DVec3::new(filtered[0][at], filtered[1][at], filtered[2][at])));
        hunt(lab_of(xyz_of(rgb.clamp(DVec3::ZERO, DVec3::ONE))))
    });
    let lightness: Plane = opponent.iter().map(|value| (value.x + 16.0) / 116.0).collect();
    let [edges, points] = features(&lightness, width, height);
    Prepared { lab: lab.collect(), edges, points }
}

fn linear(code: u8) -> f64 {
    let value = f64::from(code) / 255.0;
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// Rows of the matrix from linear sRGB to CIE XYZ.
const XYZ: [DVec3; 3] = [
    DVec3::new(10_135_552.0 / 24_577_794.0, 8_788_810.0 / 24_577_794.0, 4_435_075.0 / 24_577_794.0),
    DVec3::new(2_613_072.0 / 12_288_897.0, 8_788_810.0 / 12_288_897.0, 887_015.0 / 12_288_897.0),
    DVec3::new(1_425_312.0 / 73_733_382.0, 8_788_810.0 / 73_733_382.0, 70_074_185.0 / 73_733_382.0),
];

fn xyz_of(rgb: DVec3) -> DVec3 {
    DVec3::new(XYZ[0].dot(rgb), XYZ[1].dot(rgb), XYZ[2].dot(rgb))
}

fn rgb_of(xyz: DVec3) -> DVec3 {
    glam::DMat3::from_cols(XYZ[0], XYZ[1], XYZ[2]).transpose().inverse() * xyz
}

fn white() -> DVec3 {
    xyz_of(DVec3::ONE)
}

/// YCxCz, a linear CIELAB (Eq. 4).
fn opponent_of(xyz: DVec3) -> DVec3 {
    let share = xyz / white();
    DVec3::new(116.0 * share.y - 16.0, 500.0 * (share.x - share.y), 200.0 * (share.y - share.z))
}

fn xyz_of_opponent(value: DVec3) -> DVec3 {
    let y = (value.x + 16.0) / 116.0;
    DVec3::new(y + value.y / 500.0, y, y - value.z / 200.0) * white()
}

fn lab_of(xyz: DVec3) -> DVec3 {
    const DELTA: f64 = 6.0 / 29.0;
    let bent = |t: f64| if t > DELTA.powi(3) { t.cbrt() } else { t / (3.0 * DELTA * DELTA) + 4.0 / 29.0 };
    let share = xyz / white();
    let [x, y, z] = [share.x, share.y, share.z].map(bent);
    DVec3::new(116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z))
}

/// Colours look weaker in the dark (Eq. 6).
fn hunt(lab: DVec3) -> DVec3 {
    DVec3::new(lab.x, 0.01 * lab.x * lab.y, 0.01 * lab.x * lab.z)
}

fn hyab(a: DVec3, b: DVec3) -> f64 {
    let d = a - b;
    d.x.abs() + d.y.hypot(d.z)
}

/// A channel as the eye resolves it (Eq. 3).
fn sensed(plane: &[f64], width: usize, height: usize, gaussians: [(f64, f64); 2]) -> Plane {
    use std::f64::consts::PI;
    let radius = (3.0 * (WIDEST / (2.0 * PI * PI)).sqrt() * PIXELS_PER_DEGREE).ceil() as i32;
    let mut sum = vec![0.0; plane.len()];
    let mut total = 0.0;
    for (weight, b) in gaussians.into_iter().filter(|(weight, _)| *weight > 0.0) {
        let kernel: Plane = (-radius..=radius).map(|at| (-PI * PI / b * (f64::from(at) / PIXELS_PER_DEGREE).powi(2)).exp()).collect();
        let weight = weight * (PI / b).sqrt();
        total += weight * kernel.iter().sum::<f64>().powi(2);
        let filtered = convolved(plane, width, height, &kernel, &kernel);
        sum.iter_mut().zip(filtered).for_each(|(sum, value)| *sum += weight * value);
    }
    sum.iter().map(|value| value / total).collect()
}

/// Strength of edges and of points (Eq. 13 and 14).
fn features(plane: &[f64], width: usize, height: usize) -> [Plane; 2] {
    let deviation = 0.5 * FEATURE_WIDTH * PIXELS_PER_DEGREE;
    let radius = (3.0 * deviation).ceil() as i32;
    let gaussian = |at: i32| (-f64::from(at * at) / (2.0 * deviation * deviation)).exp();
    let across: Plane = (-radius..=radius).map(gaussian).collect();
    let beside: f64 = across.iter().sum();
    let edge = |at: i32| -f64::from(at) * gaussian(at);
    let point = |at: i32| (f64::from(at * at) / (deviation * deviation) - 1.0) * gaussian(at);
    let strength = |along: &dyn Fn(i32) -> f64| {
        let raw: Plane = (-radius..=radius).map(along).collect();
        let positive: f64 = raw.iter().filter(|value| **value > 0.0).sum();
        let negative: f64 = -raw.iter().filter(|value| **value < 0.0).sum::<f64>();
        let kernel: Plane = raw.iter().map(|value| value / (beside * if *value > 0.0 { positive } else { negative })).collect();
        let horizontal = convolved(plane, width, height, &kernel, &across);
        let vertical = convolved(plane, width, height, &across, &kernel);
        horizontal.iter().zip(vertical).map(|(x, y)| x.hypot(y)).collect()
    };
    [strength(&edge), strength(&point)]
}

/// A plane filtered along rows and then along columns; what lies outside is like the nearest pixel inside.
fn convolved(plane: &[f64], width: usize, height: usize, along_rows: &[f64], along_columns: &[f64]) -> Plane {
    let inside = |at: usize, offset: usize, radius: usize, count: usize| (at + offset).saturating_sub(radius).min(count - 1);
    let filter = |from: &dyn Fn(usize, usize) -> f64, kernel: &[f64], horizontal: bool| -> Plane {
        let radius = kernel.len() / 2;
        let one = |at: usize| {
            let (row, column) = (at / width, at % width);
            let tap = |(offset, weight): (usize, &f64)| {
                let (row, column) =
                    if horizontal { (row, inside(column, offset, radius, width)) } else { (inside(row, offset, radius, height), column) };
                weight * from(row, column)
            };
            kernel.iter().enumerate().map(tap).sum()
        };
        (0..width * height).map(one).collect()
    };
    let rows = filter(&|row, column| plane[row * width + column], along_rows, true);
    filter(&|row, column| rows[row * width + column], along_columns, false)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(width: u32, height: u32, of: impl Fn(u32, u32) -> [u32; 3]) -> image::RgbImage {
        image::RgbImage::from_fn(width, height, |x, y| image::Rgb(of(x, y).map(|value| (value % 256) as u8)))
    }

    #[test]
    fn a_picture_does_not_differ_from_itself_and_black_differs_from_white_in_full() {
        let picture = pattern(24, 16, |x, y| [x * 10, y * 15, x * y]);
        assert!(flip(&picture, &picture).iter().all(|value| *value == 0.0));
        let [black, white] = [0, 255].map(|level| pattern(16, 16, |_, _| [level; 3]));
        // Lightness 100 apart, which the largest difference, green to blue, exceeds.
        let value = mean(&flip(&black, &white));
        assert!((value - 0.967_39).abs() < 2e-4, "{value}");
    }

    #[test]
    fn values_are_those_of_the_authors_program() {
        // flip-evaluator 1.7: evaluate(reference, test, "LDR", applyMagma=False) of these patterns.
        let reference = pattern(48, 32, |x, y| [x * 5 + y, 90 + y * 4, 200 - x * 3]);
        let test = pattern(48, 32, |x, y| {
            [x * 5 + y + 20 * u32::from(x > 20), 90 + y * 4 + 30 * u32::from((x / 6 + y / 6) % 2 == 0), 190 - x * 3]
        });
        let difference = flip(&reference, &test);
        assert!((mean(&difference) - MEAN).abs() < 2e-4, "{}", mean(&difference));
        for (x, y, value) in POINTS {
            let own = difference[y * 48 + x];
            assert!((own - value).abs() < 1e-3, "{x}, {y}: {own}, not {value}");
        }
    }

    const MEAN: f64 = 0.47974;
    /// Column, row and value.
    const POINTS: [(usize, usize, f64); 7] =
        [(0, 0, 0.4595), (10, 5, 0.3462), (21, 16, 0.3728), (30, 20, 0.5058), (47, 31, 0.5823), (20, 3, 0.2504), (36, 11, 0.4570)];
}
