//! Our shadows against path-traced visibility: wrong pixels over true shadow pixels, penumbrae compared at half intensity.
//!
//! `tests/peers/mitsuba_truth.py` made the references: of each pixel, the share of the lamps' light that reaches the ground, and whether nothing but
//! ground is seen. All lamps give level ground the same, so that N lamps make N + 1 levels, and a pixel whose nearest level is another one is wrong.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use image::{Rgb, RgbImage};
use serde::{Deserialize, Serialize};

use super::Options;
use super::programs::{View, finish, load_json, load_picture, references, render};
use super::sheet::{save as save_sheet, sheet};
use crate::chart::number;
use crate::figures::save;
use crate::sandbox::Sandbox;
use crate::table::Table;

/// What is shaded, in the order of the table; each has a scene and a picture a number of lamps.
const SCENES: [&str; 3] = ["cylinder", "bunny", "fox"];
/// Mean error that is bearable.
const BOUND: f64 = 0.04;

/// `shadows.json`.
#[derive(Deserialize)]
struct Kept {
    view: View,
    /// By number of lamps.
    lights: BTreeMap<usize, Vec<Lamp>>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Lamp {
    direction: [f32; 3],
    irradiance: [f32; 3],
    solid_angle_sr: f32,
}

/// What `mr360-client render --light` reads: lamps and nothing else.
#[derive(Serialize)]
struct Light<'a> {
    sh: [[f32; 3]; 9],
    lights: &'a [Lamp],
}

/// One comparison.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Counted {
    shadow: usize,
    wrong: usize,
}

impl Counted {
    fn error(self) -> f64 {
        self.wrong as f64 / self.shadow.max(1) as f64
    }
}

/// Draws and compares everything, writes `render-shadows.csv` and the sheet `render-shadows.png`, and returns the section of the summary.
///
/// # Errors
/// When references are missing, the viewer fails, or the results cannot be written.
pub(super) fn run(options: &Options) -> Result<String> {
    let folder = references("shadows");
    let kept: Kept = load_json(&folder.join("shadows.json"))?;
    let sandbox = Sandbox::new()?;
    let white = sandbox.path("white.png");
    RgbImage::from_pixel(64, 32, Rgb([255; 3])).save(&white).context("a white panorama cannot be written")?;
    let (mut rows, mut pictures) = (Vec::new(), Vec::new());
    for scene in SCENES {
        for (&count, lamps) in &kept.lights {
            eprintln!("shadows: {scene}, {count} lights");
            let truth = load_picture(&folder.join(format!("{scene}-{count}.png")), kept.view.size)?.into_luma_alpha8();
            let ours = visibility(&sandbox, &white, &folder.join(format!("{scene}.toml")), lamps, kept.view)?;
            let (counted, marked) = compare(&truth, &ours, count);
            ensure!(counted.shadow > 0, "{scene}-{count}.png: holds no shadow");
            pictures.push(vec![shown(&truth), grey(&ours, kept.view.size.0), marked]);
            rows.push((scene, count, counted));
        }
    }
    let mut table = Table::new(&["object", "lights", "true shadow pixels", "wrong pixels", "error"]);
    for (scene, count, counted) in &rows {
        let figures = [*count, counted.shadow, counted.wrong].map(|figure| figure.to_string());
        table.push(std::iter::once((*scene).to_owned()).chain(figures).chain([number(counted.error())]));
    }
    let mean = rows.iter().map(|(.., counted)| counted.error()).sum::<f64>() / rows.len().max(1) as f64;
    save(&options.out, "render-shadows.csv", &table.csv())?;
    let columns: Vec<_> = pictures.chunks(kept.lights.len().max(1)).map(<[_]>::concat).collect();
    save_sheet(&options.out, "render-shadows.png", &sheet(&columns, (kept.view.size.0 * 3 / 4, kept.view.size.1 * 3 / 4)))?;
    Ok(format!(
        "## Shadows\n\nWrong pixels over true shadow pixels, against path-traced visibility of discs; N lights that give level ground the same make N + 1 levels, \
         and a pixel is wrong where another level is nearest: penumbrae are compared at half intensity. Pixels through which an object is seen do not count.\n\n\
         Mean error **{} %** (wanted: at most {} %; **{}**).\n\n{}\n\
         Truth, ours and wrong pixels (red: shadow missing; blue: too much), by number of lights; one row an object:\n\n![Shadows](render-shadows.png)\n",
        number(mean * 100.0),
        number(BOUND * 100.0),
        if mean <= BOUND { "met" } else { "missed" },
        table.markdown(),
    ))
}

/// The share of the lamps' light that reaches each pixel's ground as the viewer draws it: its picture of a white panorama.
fn visibility(sandbox: &Sandbox, white: &Path, scene: &Path, lamps: &[Lamp], view: View) -> Result<Vec<f32>> {
    let (light, coded, linear) = (sandbox.path("lamps.json"), sandbox.path("picture.png"), sandbox.path("picture.exr"));
    std::fs::write(&light, serde_json::to_vec(&Light { sh: [[0.0; 3]; 9], lights: lamps })?)?;
    finish(render(sandbox, white, scene, &light, view)?.arg("--out").arg(&coded).arg("--out-linear").arg(&linear))?;
    let picture = load_picture(&linear, view.size)?.into_rgb32f();
    Ok(picture.pixels().map(|pixel| pixel.0[1]).collect())
}

fn compare(truth: &image::GrayAlphaImage, ours: &[f32], count: usize) -> (Counted, RgbImage) {
    let level = |visible: f64| (visible.clamp(0.0, 1.0) * count as f64).round() as usize;
    let mut counted = Counted { shadow: 0, wrong: 0 };
    let mut marked = shown(truth);
    for ((pixel, mark), ours) in truth.pixels().zip(marked.pixels_mut()).zip(ours) {
        let [visible, ground] = pixel.0;
        if ground == 0 {
            continue;
        }
        let (wanted, drawn) = (level(f64::from(visible) / 255.0), level(f64::from(*ours)));
        counted.shadow += usize::from(wanted < count);
        counted.wrong += usize::from(wanted != drawn);
        if drawn != wanted {
            *mark = if drawn > wanted { Rgb([230, 30, 30]) } else { Rgb([40, 80, 255]) };
        }
    }
    (counted, marked)
}

/// Visibility as grey; where an object is seen, a flat tone.
fn shown(truth: &image::GrayAlphaImage) -> RgbImage {
    RgbImage::from_fn(truth.width(), truth.height(), |x, y| {
        let [visible, ground] = truth.get_pixel(x, y).0;
        Rgb(if ground == 0 { [120, 110, 90] } else { [visible; 3] })
    })
}

fn grey(values: &[f32], width: u32) -> RgbImage {
    let code = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
    let height = values.len() as u32 / width.max(1);
    RgbImage::from_fn(width, height, |x, y| Rgb([code(values.get((y * width + x) as usize).copied().unwrap_or_default()); 3]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_told_apart_at_half_intensity() {
        // Two lamps: levels at 0, 127.5 and 255. The last pixel shows the object.
        let codes = [0, 255, 60, 255, 70, 255, 190, 255, 200, 255, 255, 255, 0, 0];
        let truth = image::GrayAlphaImage::from_raw(7, 1, codes.to_vec()).unwrap();
        let right = [0.1, 0.1, 0.3, 0.7, 0.8, 1.0, 1.0];
        let (counted, _) = compare(&truth, &right, 2);
        assert_eq!(counted, Counted { shadow: 4, wrong: 0 });
        // One level up, two levels down, and the pixel that does not count.
        let (counted, marked) = compare(&truth, &[0.3, 0.1, 0.3, 0.7, 0.8, 0.0, 0.5], 2);
        assert_eq!(counted, Counted { shadow: 4, wrong: 2 });
        assert!((counted.error() - 0.5).abs() < 1e-12);
        assert!(marked.get_pixel(0, 0).0[0] > 200 && marked.get_pixel(5, 0).0[2] > 200);
    }

    #[test]
    fn every_reference_is_there_and_fits() {
        let folder = references("shadows");
        let kept: Kept = load_json(&folder.join("shadows.json")).unwrap();
        assert_eq!(kept.lights.keys().copied().collect::<Vec<_>>(), [1, 2, 4]);
        for (count, lamps) in &kept.lights {
            assert_eq!(lamps.len(), *count);
            // Level ground receives the same of each, 1 in all.
            assert!(lamps.iter().all(|lamp| (lamp.irradiance[1] * lamp.direction[1] * *count as f32 - 1.0).abs() < 1e-4));
            for scene in SCENES {
                let path = folder.join(format!("{scene}-{count}.png"));
                let picture = load_picture(&path, kept.view.size).unwrap().into_luma_alpha8();
                assert!(compare(&picture, &vec![1.0; picture.pixels().len()], *count).0.error() == 1.0);
            }
        }
    }
}
