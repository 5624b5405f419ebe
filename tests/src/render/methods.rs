//! Time against error: every way to look up reflections in every tier, on the scenes of the path-traced references.
//!
//! Time is the GPU's over all passes of a frame that brings a new picture, as the viewer's `--passes` tells it; error is that of the picture. A still
//! picture does not show what a tier saves by reflections that follow every second or fourth picture: only the time does.

use std::path::Path;

use anyhow::Result;
use mr360_shaders::source::Reflections;

use super::Options;
use super::flip::{flip, mean};
use super::programs::{Passes, finish, light, load_json, load_passes, load_picture, references, render};
use super::truth::{Kept, find, panoramas, rmse};
use crate::chart::{Axis, Chart, Mark, Scale, Series, number, pareto_front, stack};
use crate::figures::save;
use crate::samples::percentile;
use crate::sandbox::Sandbox;
use crate::table::Table;

/// Tiers from the one that leaves out nothing.
const TIERS: [u8; 5] = [0, 1, 2, 3, 4];

/// One picture.
struct Drawn {
    panorama: String,
    flip: f64,
    rmse: f64,
    passes: Passes,
}

/// One method in one tier.
struct Point {
    method: &'static str,
    tier: u8,
    pictures: Vec<Drawn>,
}

impl Point {
    /// Median over the panoramas of the time of all passes, milliseconds.
    fn time_ms(&self) -> f64 {
        let times: Vec<f64> = self.pictures.iter().map(|drawn| drawn.passes.iter().map(|pass| pass.1).sum()).collect();
        percentile(&times, 0.5).unwrap_or_default()
    }

    /// Mean over the panoramas.
    fn error(&self, of: fn(&Drawn) -> f64) -> f64 {
        self.pictures.iter().map(of).sum::<f64>() / self.pictures.len().max(1) as f64
    }
}

/// What is drawn against time.
const ERRORS: [(&str, fn(&Drawn) -> f64); 2] = [("FLIP", |drawn| drawn.flip), ("RMSE", |drawn| drawn.rmse)];

/// Draws, times and compares everything, writes `render-methods.csv` and `render-methods.svg`, and returns the section of the summary.
///
/// # Errors
/// When panoramas or references are missing, the viewer fails, the GPU has no timestamps, or the results cannot be written.
pub(super) fn run(options: &Options) -> Result<String> {
    let folder = references("truth");
    let kept: Kept = load_json(&folder.join("truth.json"))?;
    let panoramas = panoramas(options)?;
    let sandbox = Sandbox::new()?;
    let methods = Reflections::ALL.iter().flat_map(|(_, method)| TIERS.map(|tier| (*method, tier)));
    let mut points: Vec<Point> = methods.map(|(method, tier)| Point { method, tier, pictures: Vec::new() }).collect();
    for name in kept.panoramas.keys() {
        let panorama = find(&panoramas, name)?;
        let estimate = light(&sandbox, &panorama, name)?;
        let truth = load_picture(&folder.join(format!("{name}-truth.png")), kept.view.size)?.into_rgb8();
        for point in &mut points {
            eprintln!("methods: {name}, {} in tier {}", point.method, point.tier);
            let (out, times) = (sandbox.path("picture.png"), sandbox.path("passes.csv"));
            let mut command = render(&sandbox, &panorama, &folder.join("SCENE.toml"), &estimate, kept.view)?;
            command.args(["--reflections", point.method, "--tier", &point.tier.to_string()]);
            finish(command.arg("--out").arg(&out).arg("--passes").arg(&times))?;
            let picture = load_picture(&out, kept.view.size)?.into_rgb8();
            point.pictures.push(Drawn {
                panorama: name.clone(),
                flip: mean(&flip(&truth, &picture)),
                rmse: rmse(&truth, &picture),
                passes: load_passes(&times)?,
            });
        }
    }
    write(&options.out, &points, kept.view.size)
}

fn write(out: &Path, points: &[Point], size: (u32, u32)) -> Result<String> {
    let fronts = ERRORS.map(|(_, of)| pareto_front(&points.iter().map(|point| (point.time_ms(), point.error(of))).collect::<Vec<_>>()));
    save(out, "render-methods.csv", &table(points).csv())?;
    let charts: Vec<Chart> = ERRORS.iter().zip(&fronts).map(|((name, of), front)| chart(points, name, *of, front)).collect();
    save(out, "render-methods.svg", &stack(&charts)?)?;
    let mut summary = Table::new(&["reflections", "tier", "ms", "FLIP", "RMSE", "on the front of"]);
    for point in points {
        let errors = ERRORS.map(|(_, of)| point.error(of));
        let on = |front: &[(f64, f64)], error: f64| front.contains(&(point.time_ms(), error));
        let fronts: Vec<_> = ERRORS.iter().zip(&fronts).zip(errors).filter(|((_, front), error)| on(front, *error)).collect();
        let fronts = fronts.iter().map(|(((name, _), _), _)| *name).collect::<Vec<_>>().join(", ");
        let figures = [point.time_ms(), errors[0], errors[1]].map(number);
        summary.push([point.method.to_owned(), point.tier.to_string()].into_iter().chain(figures).chain([fronts]));
    }
    let panoramas = points.first().map_or(0, |point| point.pictures.len());
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    Ok(format!(
        "## Time against error\n\nEvery way to look up reflections in every tier, on the scenes of the path-traced references: three balls, a fox and a rabbit, \
         {}×{} pixels, {panoramas} panoramas. Time: GPU time of all passes of a frame with a new picture and lights that moved, median over the \
         panoramas, on this machine with {cores} cores. Error: mean over the panoramas, of a still picture, which does not show that reflections come later in tiers 1 to 4.\n\n{}\n\
         Each line runs from tier 0 to tier 4:\n\n![Time against error](render-methods.svg)\n\n\
         Milliseconds by pass, median over the panoramas:\n\n{}",
        size.0,
        size.1,
        summary.markdown(),
        by_pass(points).markdown(),
    ))
}

fn chart(points: &[Point], name: &str, of: fn(&Drawn) -> f64, front: &[(f64, f64)]) -> Chart {
    let line = |(_, method): (Reflections, &'static str)| Series {
        name: method.to_owned(),
        points: points.iter().filter(|point| point.method == method).map(|point| (point.time_ms(), point.error(of))).collect(),
        mark: Mark::Line,
    };
    let mut series: Vec<Series> = Reflections::ALL.map(line).into_iter().filter(|series| !series.points.is_empty()).collect();
    series.push(Series { name: "Pareto front".to_owned(), points: front.to_vec(), mark: Mark::Front });
    Chart {
        title: format!("{name} against the truth over time, by method from tier 0 to 4"),
        x: Axis { label: "GPU time a frame / ms".to_owned(), scale: Scale::Log },
        y: Axis { label: format!("mean {name}"), scale: Scale::Log },
        series,
    }
}

/// Every figure of every picture.
fn table(points: &[Point]) -> Table {
    let mut table = Table::new(&["reflections", "tier", "panorama", "figure", "value"]);
    for point in points {
        for drawn in &point.pictures {
            let errors = ERRORS.map(|(name, of)| (name.to_owned(), of(drawn)));
            let times = drawn.passes.iter().map(|(name, ms)| (format!("{name} ms"), *ms));
            for (figure, value) in errors.into_iter().chain(times) {
                table.push([point.method.to_owned(), point.tier.to_string(), drawn.panorama.clone(), figure, number(value)]);
            }
        }
    }
    table
}

/// One column a pass, one row a point.
fn by_pass(points: &[Point]) -> Table {
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in points.iter().flat_map(|point| &point.pictures).flat_map(|drawn| &drawn.passes) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let mut table = Table::new(&[&["reflections", "tier"][..], &names].concat());
    for point in points {
        let median = |name: &&str| {
            // A pass that a picture does not need takes no time there.
            let of = |drawn: &Drawn| drawn.passes.iter().filter(|pass| pass.0 == *name).map(|pass| pass.1).sum();
            percentile(&point.pictures.iter().map(of).collect::<Vec<f64>>(), 0.5).map_or_else(String::new, number)
        };
        table.push([point.method.to_owned(), point.tier.to_string()].into_iter().chain(names.iter().map(median)));
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(method: &'static str, tier: u8, pictures: &[(f64, f64)]) -> Point {
        let drawn = |(at, (ms, flip)): (usize, &(f64, f64))| Drawn {
            panorama: format!("p{at}"),
            flip: *flip,
            rmse: 2.0 * flip,
            passes: vec![("objects".to_owned(), 0.75 * ms), ("composite".to_owned(), 0.25 * ms)],
        };
        Point { method, tier, pictures: pictures.iter().enumerate().map(drawn).collect() }
    }

    #[test]
    fn times_are_medians_errors_means_and_the_front_is_marked() {
        let folder = tempfile::tempdir().unwrap();
        let points = [
            point("prefiltered", 0, &[(8.0, 0.04), (4.0, 0.08), (100.0, 0.06)]),
            point("prefiltered", 4, &[(2.0, 0.1), (2.0, 0.1), (2.0, 0.1)]),
            point("taps", 0, &[(16.0, 0.07), (16.0, 0.07), (16.0, 0.07)]),
        ];
        let text = write(folder.path(), &points, (64, 36)).unwrap();
        assert!(text.contains("| prefiltered | 0 | 8 | 0.06 | 0.12 | FLIP, RMSE |"), "{text}");
        assert!(
            text.contains("| prefiltered | 4 | 2 | 0.1 | 0.2 | FLIP, RMSE |") && text.contains("| taps | 0 | 16 | 0.07 | 0.14 |  |"),
            "{text}"
        );
        assert!(text.contains("| reflections | tier | objects | composite |") && text.contains("| prefiltered | 0 | 6 | 2 |"), "{text}");
        let csv = std::fs::read_to_string(folder.path().join("render-methods.csv")).unwrap();
        assert!(csv.contains("prefiltered,0,p1,FLIP,0.08\n") && csv.contains("taps,0,p2,objects ms,12\n"), "{csv}");
        let svg = std::fs::read_to_string(folder.path().join("render-methods.svg")).unwrap();
        assert!(svg.contains("prefiltered: 8, 0.06") && svg.matches("Pareto front").count() == 2);
    }
}
