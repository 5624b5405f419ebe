//! The race against Bevy: three balls on the ground of a panorama, at the same size, samples, light and shadow map, to a texture, every frame waited for.
//!
//! `tests/peers/bevy_scene` is Bevy's side, built by whoever wants the race. Both programs time their own frames, so that neither their start nor
//! their pipelines are charged to them; rounds alternate. A truth of the same scene (`tests/references/race`) tells who is nearer.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail, ensure};
use mr360_protocol::scene::{Geometry, Shape};
use mr360_protocol::scene_file::SceneFile;
use mr360_shaders::layout::SHADOW_MAP_SIZE;
use serde::{Deserialize, Serialize};

use super::Options;
use super::flip::{flip, mean};
use super::programs::{View, finish, light, load_json, load_picture, references, render};
use super::truth::{Kept, find, panoramas};
use crate::chart::number;
use crate::figures::save;
use crate::samples::percentile;
use crate::sandbox::Sandbox;
use crate::table::Table;

/// Pictures that are raced.
const SIZES: [(u32, u32); 2] = [(640, 360), (1280, 720)];
/// Of both programs in turn.
const ROUNDS: usize = 3;
/// Timed in each round, and drawn before them.
const FRAMES: u32 = 8;
const WARM: u32 = 6;
/// Samples a pixel, of tier 0.
const SAMPLES: u32 = 4;
/// What a frame of ours may take of Bevy's: of a still panorama, and of one that changes with every frame.
const BOUNDS: [f64; 2] = [0.5, 0.25];

/// What `bevy_scene` reads.
#[derive(Serialize)]
struct Job<'a> {
    panorama: &'a Path,
    columns: u32,
    rows: u32,
    lights: &'a [Lamp],
    objects: &'a [Ball],
    ground_y: f32,
    size: (u32, u32),
    fov_y_deg: f32,
    pitch_deg: f32,
    samples: u32,
    shadow_size: u32,
    changing: bool,
    warm: u32,
    frames: u32,
    picture: Option<&'a Path>,
}

#[derive(Debug, Serialize)]
struct Ball {
    position: [f32; 3],
    diameter: f32,
    base_color: [f32; 3],
    roughness: f32,
    metallic: f32,
}

#[derive(Serialize, Deserialize)]
struct Lamp {
    direction: [f32; 3],
    irradiance: [f32; 3],
    solid_angle_sr: f32,
}

/// Of `analyze --json`.
#[derive(Deserialize)]
struct Estimate {
    lights: Vec<Lamp>,
}

/// A scene in a panorama, as both programs take it.
struct Stage {
    panorama: PathBuf,
    estimate: PathBuf,
    /// The panorama's radiance as plain floats.
    plain: PathBuf,
    plain_size: (u32, u32),
    lights: Vec<Lamp>,
    objects: Vec<Ball>,
    ground_y: f32,
    view: View,
}

/// Times of one size, milliseconds a frame: still, and changing.
struct Raced {
    size: (u32, u32),
    ours: [Vec<f64>; 2],
    bevys: [Vec<f64>; 2],
}

impl Raced {
    /// Medians of ours and Bevy's, and their ratio.
    fn figures(&self, kind: usize) -> [f64; 3] {
        let [ours, bevys] = [&self.ours[kind], &self.bevys[kind]].map(|times| percentile(times, 0.5).unwrap_or(f64::NAN));
        [ours, bevys, ours / bevys]
    }
}

/// Races, writes `render-bevy.csv`, and returns the section of the summary.
///
/// # Errors
/// When `--bevy` was not given, panoramas or references are missing, a program fails, or the results cannot be written.
pub(super) fn run(options: &Options) -> Result<String> {
    let Some(bevy) = &options.bevy else {
        bail!("--part bevy wants --bevy PATH: the program that `cargo build` makes in tests/peers/bevy_scene");
    };
    let bevy = bevy.canonicalize().with_context(|| format!("--bevy {}", bevy.display()))?;
    let folder = references("race");
    let kept: Kept = load_json(&folder.join("truth.json"))?;
    let panoramas = panoramas(options)?;
    let sandbox = Sandbox::new()?;
    let (mut likeness, mut raced, mut version) = (Vec::new(), Vec::new(), String::new());
    for name in kept.panoramas.keys() {
        eprintln!("bevy: {name}");
        let stage = Stage::new(&sandbox, (&find(&panoramas, name)?, name), &folder.join("SCENE.toml"), kept.view)?;
        let truth = load_picture(&folder.join(format!("{name}-truth.png")), kept.view.size)?.into_rgb8();
        let (ours, bevys) = pictures(&sandbox, &bevy, &stage, &folder)?;
        bevys.save(options.out.join(format!("{name}-bevy.png"))).context("Bevy's picture cannot be written")?;
        ours.save(options.out.join(format!("{name}-ours.png"))).context("our picture cannot be written")?;
        likeness.push((name.clone(), [&ours, &bevys].map(|picture| mean(&flip(&truth, picture)))));
        // One shadow map each.
        if raced.is_empty() && stage.lights.len() == 1 {
            for size in SIZES {
                let (times, by) = race(&sandbox, &bevy, &stage, &folder, size)?;
                raced.push(times);
                version = by;
            }
        }
    }
    let mut csv = Table::new(&["columns", "rows", "panorama", "renderer", "ms"]);
    for of in &raced {
        for (kind, name) in ["still", "changing"].into_iter().enumerate() {
            for (renderer, times) in [("ours", &of.ours[kind]), ("Bevy", &of.bevys[kind])] {
                let head = [of.size.0.to_string(), of.size.1.to_string(), name.to_owned(), renderer.to_owned()];
                times.iter().for_each(|ms| csv.push(head.iter().cloned().chain([number(*ms)])));
            }
        }
    }
    save(&options.out, "render-bevy.csv", &csv.csv())?;
    Ok(section(&raced, &likeness, &version))
}

impl Stage {
    fn new(sandbox: &Sandbox, (panorama, name): (&Path, &str), scene: &Path, view: View) -> Result<Self> {
        let estimate = light(sandbox, panorama, name)?;
        let mut lights = load_json::<Estimate>(&estimate)?.lights;
        let strength = |lamp: &Lamp| lamp.irradiance.iter().sum::<f32>();
        lights.sort_by(|a, b| strength(b).total_cmp(&strength(a)));
        let pixels = image::open(panorama).with_context(|| panorama.display().to_string())?.into_rgb32f();
        let plain = sandbox.path(&format!("{name}.f32"));
        let held = |value: &f32| if value.is_finite() { value.clamp(0.0, 65_000.0) } else { 0.0 };
        let bytes: Vec<u8> = pixels.as_raw().iter().flat_map(|value| held(value).to_le_bytes()).collect();
        std::fs::write(&plain, bytes).with_context(|| plain.display().to_string())?;
        let (ground_y, objects) = balls(scene)?;
        Ok(Self { panorama: panorama.to_owned(), estimate, plain, plain_size: pixels.dimensions(), lights, objects, ground_y, view })
    }

    fn job(&self, size: (u32, u32), changing: bool) -> Job<'_> {
        Job {
            panorama: &self.plain,
            columns: self.plain_size.0,
            rows: self.plain_size.1,
            lights: &self.lights,
            objects: &self.objects,
            ground_y: self.ground_y,
            size,
            fov_y_deg: self.view.fov_y_deg,
            pitch_deg: self.view.pitch_deg,
            samples: SAMPLES,
            shadow_size: SHADOW_MAP_SIZE,
            changing,
            warm: WARM,
            frames: FRAMES,
            picture: None,
        }
    }
}

/// The ground's height and the balls of a scene.
fn balls(scene: &Path) -> Result<(f32, Vec<Ball>)> {
    let file =
        SceneFile::load(scene)?.resolve(|model| -> Result<_, String> { Err(format!("{}: only balls are raced", model.display())) })?;
    let ball = |object: &mr360_protocol::scene::Object| {
        let material = object
            .material
            .filter(|_| object.geometry == Geometry::Shape(Shape::Sphere))
            .context("only balls with a material are raced")?;
        Ok(Ball {
            position: object.transform.position.to_array(),
            diameter: object.transform.scale.x,
            base_color: material.base_color,
            roughness: material.roughness,
            metallic: material.metallic,
        })
    };
    Ok((file.ground_y, file.objects.iter().map(ball).collect::<Result<_>>()?))
}

/// Runs Bevy's side and returns its name and the milliseconds of its frames.
fn draw(bevy: &Path, job: &Job<'_>) -> Result<(String, Vec<f64>)> {
    let failed = || format!("--bevy {}: build it with `cargo build` in tests/peers/bevy_scene", bevy.display());
    let mut child = Command::new(bevy).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().with_context(failed)?;
    // A child that ends without reading breaks the pipe; its exit tells why.
    let sent = child.stdin.take().map_or(Ok(()), |mut stdin| stdin.write_all(&serde_json::to_vec(job)?));
    let output = child.wait_with_output()?;
    ensure!(output.status.success(), "--bevy {}: ended with {}", bevy.display(), output.status);
    sent?;
    said(&String::from_utf8_lossy(&output.stdout)).with_context(failed)
}

/// A name and the times, one line each.
fn said(text: &str) -> Result<(String, Vec<f64>)> {
    let mut lines = text.lines();
    let name = lines.next().context("it said nothing")?;
    let times: Vec<f64> = serde_json::from_str(lines.next().context("it told no times")?)?;
    ensure!(!times.is_empty(), "it timed no frames");
    Ok((name.to_owned(), times))
}

/// Our picture and Bevy's, at the truth's size.
fn pictures(sandbox: &Sandbox, bevy: &Path, stage: &Stage, folder: &Path) -> Result<(image::RgbImage, image::RgbImage)> {
    let size = stage.view.size;
    let (own, raw) = (sandbox.path("ours.png"), sandbox.path("bevy.rgba"));
    finish(render(sandbox, &stage.panorama, &folder.join("SCENE.toml"), &stage.estimate, stage.view)?.arg("--out").arg(&own))?;
    draw(bevy, &Job { frames: 1, picture: Some(&raw), ..stage.job(size, false) })?;
    let bytes = std::fs::read(&raw).with_context(|| raw.display().to_string())?;
    let rgba = image::RgbaImage::from_raw(size.0, size.1, bytes).context("Bevy's picture is of another size")?;
    Ok((load_picture(&own, size)?.into_rgb8(), image::DynamicImage::from(rgba).into_rgb8()))
}

/// Times of both, in alternating rounds.
fn race(sandbox: &Sandbox, bevy: &Path, stage: &Stage, folder: &Path, size: (u32, u32)) -> Result<(Raced, String)> {
    let mut raced = Raced { size, ours: Default::default(), bevys: Default::default() };
    let mut version = String::new();
    let (own, times) = (sandbox.path("raced.png"), sandbox.path("times.csv"));
    for round in 0..ROUNDS {
        eprintln!("bevy: {}×{}, round {}", size.0, size.1, round + 1);
        let view = View { size, ..stage.view };
        let mut command = render(sandbox, &stage.panorama, &folder.join("SCENE.toml"), &stage.estimate, view)?;
        finish(command.arg("--out").arg(&own).args(["--frames", &FRAMES.to_string(), "--frame-times"]).arg(&times))?;
        let text = std::fs::read_to_string(&times).with_context(|| times.display().to_string())?;
        for (kind, own) in frame_times(&text)?.into_iter().enumerate() {
            raced.ours[kind].extend(own);
            let (name, their) = draw(bevy, &stage.job(size, kind == 1))?;
            raced.bevys[kind].extend(their);
            version = name;
        }
    }
    Ok((raced, version))
}

/// What `--frame-times` wrote: still, and with new pictures.
fn frame_times(text: &str) -> Result<[Vec<f64>; 2]> {
    let mut lines = text.lines();
    ensure!(lines.next() == Some("still_ms,new_picture_ms"), "--frame-times wrote another head: {text}");
    let row = |line: &str| line.split_once(',').and_then(|(still, new)| Some((still.parse::<f64>().ok()?, new.parse::<f64>().ok()?)));
    let rows = lines.map(|line| row(line).with_context(|| line.to_owned())).collect::<Result<Vec<_>>>()?;
    let (still, new) = rows.into_iter().unzip();
    Ok([still, new])
}

fn section(raced: &[Raced], likeness: &[(String, [f64; 2])], version: &str) -> String {
    let mut times = Table::new(&["pixels", "panorama", "ours ms", "Bevy ms", "ratio", "wanted", ""]);
    for of in raced {
        for (kind, name) in ["still", "changes every frame"].into_iter().enumerate() {
            let figures = of.figures(kind);
            let verdict = if figures[2] <= BOUNDS[kind] { "met" } else { "missed" };
            let head = [format!("{}×{}", of.size.0, of.size.1), name.to_owned()];
            let tail = [format!("at most {}", number(BOUNDS[kind])), format!("**{verdict}**")];
            times.push(head.into_iter().chain(figures.map(number)).chain(tail));
        }
    }
    let mut errors = Table::new(&["panorama", "ours FLIP", "Bevy FLIP"]);
    for (name, flips) in likeness {
        errors.push(std::iter::once(name.clone()).chain(flips.map(number)));
    }
    let nearer = likeness.iter().filter(|(_, [ours, bevys])| ours < bevys).count();
    format!(
        "## Race against Bevy\n\nThree balls on the ground of a panorama, {SAMPLES} samples a pixel, one shadow map of {SHADOW_MAP_SIZE}², drawn to a texture and waited for; \
         medians of {ROUNDS} alternating rounds of {FRAMES} frames. {version}. Bevy filters its environment on a cube of 256² when the panorama \
         changes, and not at all when it is still; its ground has the albedo that makes it look as the panorama does.\n\n{}\n\
         Mean FLIP against the path-traced truth of the scene; ours is lower on **{nearer} of {}**:\n\n{}",
        times.markdown(),
        likeness.len(),
        errors.markdown(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scene_is_one_that_both_can_draw_and_others_are_refused() {
        let (ground_y, objects) = balls(&references("race").join("SCENE.toml")).unwrap();
        assert_eq!((ground_y, objects.len()), (-1.6, 3));
        assert!(objects.iter().all(|ball| ball.diameter > 0.5));
        let error = balls(&references("truth").join("SCENE.toml")).unwrap_err();
        assert!(format!("{error:#}").contains("only balls"), "{error:#}");
    }

    #[test]
    fn ratios_are_held_against_their_bounds() {
        let raced = Raced { size: (640, 360), ours: [vec![10.0, 40.0, 11.0], vec![30.0]], bevys: [vec![21.0, 30.0, 22.0], vec![100.0]] };
        assert_eq!(raced.figures(0), [11.0, 22.0, 0.5]);
        let text = section(&[raced], &[("sky".to_owned(), [0.05, 0.1]), ("hall".to_owned(), [0.1, 0.1])], "Bevy on a GPU");
        assert!(text.contains("| 640×360 | still | 11 | 22 | 0.5 | at most 0.5 | **met** |"), "{text}");
        assert!(text.contains("| 640×360 | changes every frame | 30 | 100 | 0.3 | at most 0.25 | **missed** |"), "{text}");
        assert!(text.contains("**1 of 2**") && text.contains("| sky | 0.05 | 0.1 |"), "{text}");
    }

    #[test]
    fn what_both_programs_say_is_read() {
        assert_eq!(frame_times("still_ms,new_picture_ms\n1.5,4\n2,5\n").unwrap(), [vec![1.5, 2.0], vec![4.0, 5.0]]);
        assert!(frame_times("still_ms\n1\n").is_err() && frame_times("still_ms,new_picture_ms\n1\n").is_err());
        assert_eq!(said("Bevy on llvmpipe\n[1.5,2]\n").unwrap(), ("Bevy on llvmpipe".to_owned(), vec![1.5, 2.0]));
        assert!(said("Bevy\n[]\n").is_err() && said("").is_err());
    }
}
