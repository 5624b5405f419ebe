//! The default method on sequences whose light is known, held to bounds on stillness, lag and steps.

use glam::Vec3;
use mr360_protocol::light::DirectionalLight;
use mr360_shaders::sh;

use super::sequences::{self, Sequence, Truth};
use super::{Directional, Estimate, LightMethod, StepTimes};

/// What the method said of one frame, and what is true.
struct Row {
    time_s: f64,
    truth: Truth,
    estimate: Estimate,
}

fn run(sequence: &Sequence) -> Vec<Row> {
    let mut method = Directional::default();
    let mut steps = StepTimes::default();
    let rows = sequence.shots().map(|shot| {
        let estimate = method.estimate(&shot.frame, &mut steps).unwrap().clone();
        Row { time_s: shot.frame.pts_us as f64 * 1e-6, truth: shot.truth, estimate }
    });
    rows.collect()
}

/// Births and deaths after the first frame.
fn comings_and_goings(rows: &[Row]) -> usize {
    let lacks = |lights: &[DirectionalLight], id| !lights.iter().any(|light| light.id == id);
    let pairs = rows.windows(2).map(|pair| (&pair[0].estimate.lights, &pair[1].estimate.lights));
    pairs.map(|(a, b)| a.iter().filter(|l| lacks(b, l.id)).count() + b.iter().filter(|l| lacks(a, l.id)).count()).sum()
}

fn degrees(a: Vec3, b: Vec3) -> f32 {
    2.0 * ((a - b).length() / 2.0).asin().to_degrees()
}

fn rms(values: impl IntoIterator<Item = f32>) -> f32 {
    let (sum, count) = values.into_iter().fold((0.0, 0), |(sum, count), v| (sum + v * v, count + 1));
    (sum / count.max(1) as f32).sqrt()
}

fn largest(values: impl IntoIterator<Item = f32>) -> f32 {
    values.into_iter().fold(0.0, f32::max)
}

/// Standard deviation over mean.
fn variation(values: &[f32]) -> f32 {
    let mean = values.iter().sum::<f32>() / values.len() as f32;
    rms(values.iter().map(|v| v / mean - 1.0))
}

/// The brightest light.
fn main_light(row: &Row) -> &DirectionalLight {
    row.estimate.lights.first().unwrap_or_else(|| panic!("no light at {} s", row.time_s))
}

/// Angle between the brightest light and the only true one.
fn error_deg(row: &Row) -> f32 {
    degrees(main_light(row).direction, row.truth.lights[0].direction)
}

fn normals() -> [Vec3; 6] {
    [Vec3::Y, Vec3::X, Vec3::NEG_X, Vec3::Z, Vec3::NEG_Z, Vec3::NEG_Y]
}

/// Luminous irradiance of the lights, and of lights and SH together.
fn irradiance(row: &Row, normal: Vec3) -> (f32, f32) {
    let direct: f32 = row.estimate.lights.iter().map(|light| light.irradiance.y * light.direction.dot(normal).max(0.0)).sum();
    (direct, direct + sh::irradiance(&row.estimate.sh, normal).y)
}

/// Largest step from frame to frame of the direct light, and of all light, on six surfaces, relative to the most
/// that one of them receives.
fn largest_steps(rows: &[Row]) -> (f32, f32) {
    let most = largest(rows.iter().flat_map(|row| normals().map(|normal| irradiance(row, normal).1)));
    let step = |pair: &[Row], normal| {
        let (before, after) = (irradiance(&pair[0], normal), irradiance(&pair[1], normal));
        ((after.0 - before.0).abs() / most, (after.1 - before.1).abs() / most)
    };
    let steps: Vec<_> = rows.windows(2).flat_map(|pair| normals().map(|normal| step(pair, normal))).collect();
    (largest(steps.iter().map(|s| s.0)), largest(steps.iter().map(|s| s.1)))
}

/// Least irradiance of the SH before the clamp, over their mean.
fn least_residual(rows: &[Row]) -> f32 {
    let normals = (0..16 * 8).map(|i| {
        let uv = glam::Vec2::new((i % 16) as f32 / 16.0, ((i / 16) as f32 + 0.5) / 8.0);
        mr360_shaders::equirect::direction_from_uv(uv)
    });
    let normals: Vec<Vec3> = normals.collect();
    let unclamped = |row: &Row, normal: Vec3| {
        let terms = row.estimate.sh.iter().zip(sh::basis9(normal)).enumerate();
        terms.map(|(i, (c, y))| c.y * y * sh::IRRADIANCE_BAND[sh::band(i)]).sum::<f32>()
    };
    let least = |row: &Row| {
        let values: Vec<f32> = normals.iter().map(|normal| unclamped(row, *normal)).collect();
        values.iter().copied().fold(f32::INFINITY, f32::min) / (values.iter().sum::<f32>() / values.len() as f32)
    };
    rows.iter().map(least).fold(f32::INFINITY, f32::min)
}

#[test]
fn survey() {
    for sequence in sequences::all() {
        let rows = run(&sequence);
        let with_light = rows.iter().filter(|row| !row.estimate.lights.is_empty());
        let errors: Vec<f32> = with_light.clone().filter(|row| row.truth.lights.len() == 1).map(error_deg).collect();
        let strengths: Vec<f32> = with_light.map(|row| row.estimate.lights.iter().map(|l| l.irradiance.y).sum()).collect();
        let (direct, all) = largest_steps(&rows);
        println!(
            "{:24} lit {:3}/{:3} events {} error rms {:.3} worst {:.3} strength {:.4} var {:.4} steps {:.3} {:.3} residual {:.3}",
            sequence.name,
            strengths.len(),
            rows.len(),
            comings_and_goings(&rows),
            rms(errors.iter().copied()),
            largest(errors.iter().copied()),
            strengths.first().unwrap_or(&0.0),
            variation(&strengths),
            direct,
            all,
            least_residual(&rows)
        );
    }
}
