//! How the GPU's time grows with lights, objects, triangles, roughness, pixels and views: one picture of a made scene at each step, timed pass by pass by
//! `mr360-client render --passes`, with fitted exponents.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use image::RgbImage;

use super::Options;
use super::programs::{Passes, View, finish, load_passes, render};
use crate::chart::{Axis, Chart, Mark, Scale, Series, number, stack};
use crate::figures::save;
use crate::models::ball;
use crate::sandbox::Sandbox;
use crate::table::Table;

/// What a picture shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Shown {
    lights: usize,
    objects: usize,
    /// Of one model, in place of the objects; 0 for none.
    triangles: usize,
    roughness: f64,
    size: (u32, u32),
    /// Drawn in one frame.
    views: usize,
}

/// What all sweeps start from.
const BASE: Shown = Shown { lights: 1, objects: 20, triangles: 0, roughness: 0.3, size: (640, 360), views: 1 };

/// One thing varied.
struct Sweep {
    name: &'static str,
    scale: Scale,
    steps: Vec<(f64, Shown)>,
}

/// The same with so many objects.
pub(super) fn with_objects(objects: usize) -> Shown {
    Shown { objects, ..BASE }
}

/// Times of a sweep.
struct Timed {
    sweep: Sweep,
    passes: Vec<Passes>,
}

/// Times every step, writes `render-growth.csv` and `render-growth.svg`, and returns the section of the summary.
///
/// # Errors
/// When the viewer fails, the GPU has no timestamps, or the results cannot be written.
pub(super) fn run(options: &Options) -> Result<String> {
    let sandbox = Sandbox::new()?;
    let panorama = gradient(&sandbox)?;
    let mut timed = Vec::new();
    for sweep in sweeps() {
        let mut passes = Vec::new();
        for (value, shown) in &sweep.steps {
            eprintln!("growth: {} {value}", sweep.name);
            passes.push(time(&sandbox, &panorama, *shown)?);
        }
        timed.push(Timed { sweep, passes });
    }
    write(options, &timed)
}

/// A panorama.
pub(super) fn gradient(sandbox: &Sandbox) -> Result<PathBuf> {
    let panorama = sandbox.path("panorama.png");
    let gradient = RgbImage::from_fn(1024, 512, |x, y| image::Rgb([(x / 4) as u8, (y / 2) as u8, 160]));
    gradient.save(&panorama).context("a panorama cannot be written")?;
    Ok(panorama)
}

fn sweeps() -> Vec<Sweep> {
    let with = |values: &[f64], change: &dyn Fn(&mut Shown, f64)| {
        let step = |value: &f64| {
            let mut shown = BASE;
            change(&mut shown, *value);
            (*value, shown)
        };
        values.iter().map(step).collect()
    };
    let lights = with(&[0.0, 1.0, 2.0, 4.0, 8.0, 16.0], &|shown, n| shown.lights = n as usize);
    let objects = with(&[1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0], &|shown, n| shown.objects = n as usize);
    let triangles = with(&[1e3, 1e4, 1e5, 3e5, 1e6], &|shown, n| shown.triangles = n as usize);
    let roughness = with(&[0.0, 0.1, 0.25, 0.5, 0.75, 1.0], &|shown, n| shown.roughness = n);
    let sizes = [(320, 180), (640, 360), (960, 540), (1280, 720), (1920, 1080)];
    let views = with(&[1.0, 2.0, 3.0, 4.0], &|shown, n| shown.views = n as usize);
    let pixels = sizes.map(|size: (u32, u32)| (f64::from(size.0 * size.1), Shown { size, ..BASE }));
    vec![
        Sweep { name: "lights", scale: Scale::Linear, steps: lights },
        Sweep { name: "objects", scale: Scale::Log, steps: objects },
        Sweep { name: "triangles", scale: Scale::Log, steps: triangles },
        Sweep { name: "roughness", scale: Scale::Linear, steps: roughness },
        Sweep { name: "pixels", scale: Scale::Log, steps: pixels.to_vec() },
        Sweep { name: "views", scale: Scale::Linear, steps: views },
    ]
}

fn time(sandbox: &Sandbox, panorama: &Path, shown: Shown) -> Result<Passes> {
    let (scene, light, times) = (sandbox.path("SCENE.toml"), sandbox.path("light.json"), sandbox.path("passes.csv"));
    if shown.triangles > 0 {
        std::fs::write(sandbox.path("ball.glb"), ball(rings(shown.triangles)).finish()?)?;
    }
    std::fs::write(&scene, scene_of(shown))?;
    std::fs::write(&light, light_of(shown.lights))?;
    let view = View { size: shown.size, fov_y_deg: 45.0, pitch_deg: -14.0 };
    let out: PathBuf = sandbox.path("picture.png");
    let mut command = render(sandbox, panorama, &scene, &light, view)?;
    finish(command.arg("--out").arg(out).args(["--views", &shown.views.to_string(), "--passes"]).arg(&times))?;
    load_passes(&times)
}

/// Of a ball of about so many triangles.
fn rings(triangles: usize) -> u32 {
    (triangles as f64 / 4.0).sqrt().round() as u32
}

/// Balls in rows on the ground before the camera, all in sight; or one model.
pub(super) fn scene_of(shown: Shown) -> String {
    let material = format!("material = {{ base_color = [0.7, 0.6, 0.5], roughness = {:.3}, metallic = 0.0 }}\n", shown.roughness);
    let mut text = "ground_y = -1.6\n".to_owned();
    if shown.triangles > 0 {
        return text + "[[object]]\nmodel = \"ball.glb\"\nposition = [0.0, -1.1, -3.5]\n" + &material;
    }
    let columns = (shown.objects as f64).sqrt().ceil().max(1.0) as usize;
    for at in 0..shown.objects {
        let share = |place: usize| (place as f64 + 0.5) / columns as f64 - 0.5;
        let (x, z) = (3.0 * share(at % columns), -4.5 - 3.0 * share(at / columns));
        // Writing to a String cannot fail.
        let _ = write!(text, "[[object]]\nshape = \"sphere\"\nscale = 0.2\nposition = [{x:.3}, -1.5, {z:.3}]\n{material}");
    }
    text
}

/// Even ambient light, and lamps around that give as much together.
pub(super) fn light_of(count: usize) -> String {
    let mut sh = [[0.0; 3]; 9];
    sh[0] = [1.0; 3];
    let lamp = |at: usize| {
        let around = at as f32 * 2.4;
        let direction = glam::Vec3::new(around.sin(), 1.0, around.cos()).normalize();
        let irradiance = [3.0 / count as f32; 3];
        serde_json::json!({ "id": at, "direction": direction.to_array(), "irradiance": irradiance, "solid_angle_sr": 1e-3 })
    };
    serde_json::json!({ "sh": sh, "lights": (0..count).map(lamp).collect::<Vec<_>>() }).to_string()
}

/// `t = base + factor · x^exponent` of least squares, no part negative; `None` for fewer than four points.
fn growth(points: &[(f64, f64)]) -> Option<(f64, f64, f64)> {
    let points: Vec<_> = points.iter().copied().filter(|(x, _)| *x > 0.0).collect();
    if points.len() < 4 {
        return None;
    }
    let count = points.len() as f64;
    let fit = |exponent: f64| {
        let powers: Vec<f64> = points.iter().map(|(x, _)| x.powf(exponent)).collect();
        let (mean_x, mean_t) = (powers.iter().sum::<f64>() / count, points.iter().map(|point| point.1).sum::<f64>() / count);
        let spread: f64 = powers.iter().map(|x| (x - mean_x).powi(2)).sum();
        let shared: f64 = powers.iter().zip(&points).map(|(x, (_, t))| (x - mean_x) * (t - mean_t)).sum();
        let mut factor = (shared / spread).max(0.0);
        let mut base = mean_t - factor * mean_x;
        if base < 0.0 {
            base = 0.0;
            factor = powers.iter().zip(&points).map(|(x, (_, t))| x * t).sum::<f64>() / powers.iter().map(|x| x * x).sum::<f64>();
        }
        let off: f64 = powers.iter().zip(&points).map(|(x, (_, t))| (base + factor * x - t).powi(2)).sum();
        (off, (base, factor, exponent))
    };
    (1..=60).map(|step| fit(f64::from(step) * 0.05)).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, fitted)| fitted)
}

fn write(options: &Options, timed: &[Timed]) -> Result<String> {
    let mut csv = Table::new(&["sweep", "value", "pass", "gpu_ms"]);
    let mut summary = Table::new(&["varied", "from", "to", "ms from", "ms to", "exponent", "fit"]);
    let mut charts = Vec::new();
    for Timed { sweep, passes } in timed {
        let totals: Vec<(f64, f64)> =
            sweep.steps.iter().zip(passes).map(|((value, _), passes)| (*value, passes.iter().map(|pass| pass.1).sum())).collect();
        let mut series: Vec<Series> = Vec::new();
        for ((value, _), passes) in sweep.steps.iter().zip(passes) {
            for (name, ms) in passes {
                csv.push([sweep.name.to_owned(), number(*value), name.clone(), number(*ms)]);
                if !series.iter().any(|known| known.name == *name) {
                    series.push(Series { name: name.clone(), points: Vec::new(), mark: Mark::Line });
                }
                // A logarithmic axis has no place for what took no time.
                let fits = sweep.scale == Scale::Linear || *ms > 0.0;
                series.iter_mut().filter(|known| known.name == *name && fits).for_each(|known| known.points.push((*value, *ms)));
            }
        }
        series.push(Series { name: "all".to_owned(), points: totals.clone(), mark: Mark::Line });
        let (x, y) =
            (Axis { label: sweep.name.to_owned(), scale: sweep.scale }, Axis { label: "GPU time / ms".to_owned(), scale: sweep.scale });
        charts.push(Chart { title: format!("Time over {}", sweep.name), x, y, series });
        if let (Some(first), Some(last)) = (totals.first(), totals.last()) {
            let fitted = growth(&totals).filter(|_| sweep.name != "roughness");
            let exponent = fitted.map_or_else(String::new, |(_, _, exponent)| number(exponent));
            let law = fitted.map_or_else(String::new, |(base, factor, exponent)| {
                format!("{} + {} x^{}", number(base), number(factor), number(exponent))
            });
            let figures = [first.0, last.0, first.1, last.1].map(number);
            summary.push(std::iter::once(sweep.name.to_owned()).chain(figures).chain([exponent, law]));
        }
    }
    save(&options.out, "render-growth.csv", &csv.csv())?;
    save(&options.out, "render-growth.svg", &stack(&charts)?)?;
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    Ok(format!(
        "## Growth\n\nGPU time of all passes of a frame with a new picture of 1024×512 and lights that moved, median of 8 frames, on this machine with {cores} cores. Unless varied: {} light, {} balls of \
         roughness {}, {}×{} pixels; triangles are those of one ball; views are drawn one after the other in one frame. Fits are t = a + b x^p of least squares, in milliseconds.\n\n{}\n![Growth](render-growth.svg)\n",
        BASE.lights,
        BASE.objects,
        BASE.roughness,
        BASE.size.0,
        BASE.size.1,
        summary.markdown(),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponents_of_known_growth_are_found() {
        let points = |law: fn(f64) -> f64| [1.0, 2.0, 4.0, 8.0, 16.0].map(|x| (x, law(x)));
        for (law, expected) in [
            ((|x| 3.0 + 0.5 * x) as fn(f64) -> f64, (3.0, 0.5, 1.0)),
            (|x| 0.1 * x * x, (0.0, 0.1, 2.0)),
            (|x| 2.0 + x.sqrt(), (2.0, 1.0, 0.5)),
        ] {
            let (base, factor, exponent) = growth(&points(law)).unwrap();
            let off = [base - expected.0, factor - expected.1, exponent - expected.2];
            assert!(off.iter().all(|off| off.abs() < 1e-6), "{base} {factor} {exponent}, not {expected:?}");
        }
        assert_eq!(growth(&points(|x| x)[..3]), None);
    }

    #[test]
    fn a_ball_has_its_triangles_and_scenes_are_scenes() {
        for triangles in [1_000, 100_000] {
            let made = f64::from(4 * rings(triangles).pow(2));
            assert!((made / triangles as f64 - 1.0).abs() < 0.05, "{made}");
        }
        for sweep in sweeps() {
            for (_, shown) in sweep.steps {
                let scene = mr360_protocol::scene_file::SceneFile::parse(&scene_of(shown), Path::new("SCENE.toml")).unwrap();
                let scene = scene.resolve(|_| Ok::<_, String>(mr360_protocol::asset::AssetId::of(b"ball"))).unwrap();
                assert_eq!(scene.objects.len(), if shown.triangles > 0 { 1 } else { shown.objects });
            }
        }
    }

    #[test]
    fn times_are_summed_and_fitted() {
        let folder = tempfile::tempdir().unwrap();
        let steps = [1.0, 2.0, 4.0, 8.0].map(|value| (value, BASE)).to_vec();
        let passes = steps.iter().map(|(value, _)| vec![("objects".to_owned(), *value), ("composite".to_owned(), 2.0)]).collect();
        let timed = [Timed { sweep: Sweep { name: "objects", scale: Scale::Log, steps }, passes }];
        let text = write(&super::super::tests::options(folder.path()), &timed).unwrap();
        assert!(text.contains("| objects | 1 | 8 | 3 | 10 | 1 | 2 + 1 x^1 |"), "{text}");
        assert!(std::fs::read_to_string(folder.path().join("render-growth.csv")).unwrap().contains("objects,4,composite,2"));
    }
}
