//! Both eyes by one pass against a pass an eye, over the number of objects: the same frames by the same driver, in alternating rounds. The driver is
//! that of the OpenXR runtime for tests, because the system's may not draw two layers at once.

use std::path::Path;

use anyhow::{Context, Result, ensure};

use super::Options;
use super::growth::{gradient, light_of, scene_of, with_objects};
use super::programs::{View, finish, load_passes, render_by};
use crate::chart::{Axis, Chart, Mark, Scale, Series, number};
use crate::figures::save;
use crate::samples::{Samples, percentile};
use crate::sandbox::Sandbox;
use crate::table::Table;
use crate::xr::XrRuntime;

const OBJECTS: [usize; 5] = [1, 10, 30, 100, 300];
const ROUNDS: usize = 3;
/// Pixels of an eye: few, so that drivers, vertices and commands count beside them.
const SIZE: (u32, u32) = (320, 240);
/// Values of `--multiview`, and what they are called.
const WAYS: [(&str, &str); 2] = [("off", "a pass an eye"), ("on", "one pass")];

/// Times of one way with so many objects, milliseconds: one value a round.
#[derive(Debug, Clone, PartialEq, Default)]
struct Times {
    /// Of the GPU, all passes of a frame with a new picture.
    gpu: Vec<f64>,
    /// From the first command of a frame of a still picture to its end on the GPU, median of a round.
    frame: Vec<f64>,
}

/// By number of objects, both ways.
type Race = Vec<(usize, [Times; 2])>;

/// Races, writes `render-eyes.csv` and `render-eyes.svg`, and returns the section of the summary.
///
/// # Errors
/// When no runtime is installed, the viewer fails, the GPU has no timestamps, or the results cannot be written.
pub(super) fn run(options: &Options) -> Result<String> {
    let sandbox = Sandbox::new()?;
    let runtime = XrRuntime::new(&sandbox, "xr")?;
    let panorama = gradient(&sandbox)?;
    let mut race: Race = OBJECTS.map(|objects| (objects, Default::default())).to_vec();
    for round in 1..=ROUNDS {
        for (objects, times) in &mut race {
            eprintln!("eyes: round {round} of {ROUNDS}, {objects} objects");
            for ((way, _), times) in WAYS.iter().zip(times) {
                let (gpu, frame) = time(&sandbox, &runtime, &panorama, *objects, way)?;
                times.gpu.push(gpu);
                times.frame.push(frame);
            }
        }
    }
    write(options, &race)
}

fn time(sandbox: &Sandbox, runtime: &XrRuntime, panorama: &Path, objects: usize, way: &str) -> Result<(f64, f64)> {
    let (scene, light) = (sandbox.path("SCENE.toml"), sandbox.path("light.json"));
    std::fs::write(&scene, scene_of(with_objects(objects)))?;
    std::fs::write(&light, light_of(1))?;
    let view = View { size: SIZE, fov_y_deg: 45.0, pitch_deg: -14.0 };
    let (out, passes, frames) = (sandbox.path("picture.png"), sandbox.path("passes.csv"), sandbox.path("frames.csv"));
    let mut command = render_by(sandbox.client_command_by(runtime.starter()?)?, panorama, &scene, &light, view);
    command.args(["--views", "2", "--multiview", way]).arg("--out").arg(out);
    finish(command.arg("--passes").arg(&passes).arg("--frame-times").arg(&frames))?;
    let still: Vec<f64> = Samples::load(&frames)?.column("still_ms")?.into_iter().flatten().collect();
    Ok((load_passes(&passes)?.iter().map(|pass| pass.1).sum(), percentile(&still, 0.5).context("no frame was timed")?))
}

fn median(values: &[f64]) -> f64 {
    percentile(values, 0.5).unwrap_or_default()
}

fn write(options: &Options, race: &Race) -> Result<String> {
    ensure!(!race.is_empty(), "nothing was raced");
    let mut table = Table::new(&[
        "objects",
        "GPU ms, a pass an eye",
        "GPU ms, one pass",
        "ratio",
        "frame ms, a pass an eye",
        "frame ms, one pass",
        "ratio",
    ]);
    let mut csv = Table::new(&["objects", "way", "round", "gpu_ms", "frame_ms"]);
    let mut series: Vec<Series> = ["GPU", "frame"]
        .iter()
        .flat_map(|what| WAYS.map(|(_, way)| Series { name: format!("{what}, {way}"), points: Vec::new(), mark: Mark::Line }))
        .collect();
    for (objects, ways) in race {
        // Of each round: what both ways met with alike falls out.
        let ratio = |of: fn(&Times) -> &Vec<f64>| {
            median(&of(&ways[1]).iter().zip(of(&ways[0])).map(|(one, two)| one / two.max(1e-6)).collect::<Vec<_>>())
        };
        let (gpu, frame) = (ways.each_ref().map(|times| median(&times.gpu)), ways.each_ref().map(|times| median(&times.frame)));
        let figures = [gpu[0], gpu[1], ratio(|times| &times.gpu), frame[0], frame[1], ratio(|times| &times.frame)];
        table.push(std::iter::once(objects.to_string()).chain(figures.map(number)));
        for (series, ms) in series.iter_mut().zip(gpu.into_iter().chain(frame)) {
            series.points.push((*objects as f64, ms));
        }
        for ((_, way), times) in WAYS.iter().zip(ways) {
            for (round, (gpu, frame)) in times.gpu.iter().zip(&times.frame).enumerate() {
                csv.push([objects.to_string(), (*way).to_owned(), (round + 1).to_string(), number(*gpu), number(*frame)]);
            }
        }
    }
    let axis = |label: &str| Axis { label: label.to_owned(), scale: Scale::Log };
    let chart = Chart { title: "Both eyes, over objects".to_owned(), x: axis("objects"), y: axis("ms"), series };
    save(&options.out, "render-eyes.csv", &csv.csv())?;
    save(&options.out, "render-eyes.svg", &chart.svg()?)?;
    Ok(format!(
        "## Both eyes\n\nTwo views of {}×{} pixels, 64 mm apart, in one frame: by passes of each eye's own, and by passes of both (multiview), in {ROUNDS} alternating rounds on the driver of the OpenXR \
         runtime for tests. GPU is all passes of a frame with a new picture; frame is a still picture's from the first command to the end on the GPU, with what the processor takes to record it. Medians; ratios are medians of each \
         round's. A GPU in software shades every pixel of either way alike, and runs vertices for each view: what is left to save are commands and passes.\n\n{}\n![Both eyes](render-eyes.svg)\n",
        SIZE.0,
        SIZE.1,
        table.markdown(),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_ways_are_set_against_each_other() {
        let folder = tempfile::tempdir().unwrap();
        let times = |scale: f64| Times { gpu: [1.0, 3.0, 2.0].map(|ms| ms * scale).to_vec(), frame: vec![10.0 * scale; 3] };
        let race = vec![(1, [times(2.0), times(1.0)]), (10, [times(4.0), times(3.0)])];
        let text = write(&super::super::tests::options(folder.path()), &race).unwrap();
        assert!(text.contains("| 1 | 4 | 2 | 0.5 | 20 | 10 | 0.5 |") && text.contains("| 10 | 8 | 6 | 0.75 | 40 | 30 | 0.75 |"), "{text}");
        assert_eq!(std::fs::read_to_string(folder.path().join("render-eyes.csv")).unwrap().lines().count(), 13);
        assert!(folder.path().join("render-eyes.svg").is_file());
    }
}
