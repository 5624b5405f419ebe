//! Our pictures against path-traced ones of the same scenes, beside three.js's.
//!
//! `tests/peers/mitsuba_truth.py` made the references and says how; `tests/references/truth/truth.json` holds their view and how good they are.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use image::RgbImage;
use serde::Deserialize;

use super::Options;
use super::flip::{flip, mean};
use super::programs::{View, finish, light, load_json, load_picture, references, render};
use super::sheet::{coloured, save as save_sheet, sheet};
use super::three::{Job, draw};
use crate::chart::number;
use crate::figures::save;
use crate::sandbox::{Sandbox, media_folder};
use crate::table::Table;

/// Ours has to look less wrong than three.js's on this many panoramas.
const WANTED: usize = 7;
/// Size of a picture on the sheet.
const TILE: (u32, u32) = (288, 162);

/// `truth.json`.
#[derive(Deserialize)]
pub(super) struct Kept {
    made_with: MadeWith,
    pub(super) view: View,
    /// What the values of `regions.png` stand for.
    regions: Vec<String>,
    pub(super) panoramas: BTreeMap<String, Quality>,
}

#[derive(Deserialize)]
struct MadeWith {
    mitsuba: String,
    runs: u32,
    samples: u32,
}

#[derive(Deserialize)]
pub(super) struct Quality {
    /// Share of the visible ground's radiance that no albedo could give and the ground emits.
    emitted_share_of_ground: f64,
    /// Mean over the pixels, linear.
    standard_error: f64,
}

/// One picture against the truth.
struct Compared {
    flip: f64,
    rmse: f64,
    /// What each region adds to `flip`.
    shares: Vec<f64>,
    difference: Vec<f64>,
}

/// Both pictures of one panorama.
struct Row {
    panorama: String,
    ours: Compared,
    three: Compared,
}

/// Draws and compares everything, writes `render-truth.csv` and the sheet `render-truth.jpg`, and returns the section of the summary.
///
/// # Errors
/// When panoramas or references are missing, a program fails, or the results cannot be written.
pub(super) fn run(options: &Options) -> Result<String> {
    let folder = references("truth");
    let kept: Kept = load_json(&folder.join("truth.json"))?;
    let size = kept.view.size;
    let regions = load_picture(&folder.join("regions.png"), size)?.into_luma8().into_raw();
    let panoramas = panoramas(options)?;
    let sandbox = Sandbox::new()?;
    let scene = folder.join("SCENE.toml");
    let (mut jobs, mut ours) = (Vec::new(), Vec::new());
    for name in kept.panoramas.keys() {
        eprintln!("truth: {name}");
        let panorama = find(&panoramas, name)?;
        let estimate = light(&sandbox, &panorama, name)?;
        let out = sandbox.path(&format!("{name}.png"));
        finish(render(&sandbox, &panorama, &scene, &estimate, kept.view)?.arg("--out").arg(&out))?;
        ours.push(load_picture(&out, size)?.into_rgb8());
        jobs.push(Job::new(&scene, (panorama, estimate, options.out.join(format!("{name}-three.png"))), kept.view)?);
    }
    let (three_from, version) = match &options.three {
        Some(three) => (options.out.clone(), draw(&options.node, three, &options.chromium, &jobs)?),
        None => (folder.clone(), "kept pictures of three.js, which `--three` draws anew".to_owned()),
    };
    let (mut rows, mut pictures) = (Vec::new(), Vec::new());
    for (name, ours) in kept.panoramas.keys().zip(ours) {
        let truth = load_picture(&folder.join(format!("{name}-truth.png")), size)?.into_rgb8();
        let three = load_picture(&three_from.join(format!("{name}-three.png")), size)?.into_rgb8();
        let row = Row {
            panorama: name.clone(),
            ours: compare(&truth, &ours, &regions, kept.regions.len()),
            three: compare(&truth, &three, &regions, kept.regions.len()),
        };
        let differences = [&row.ours, &row.three].map(|compared| coloured(&compared.difference, size.0));
        pictures.push([truth, ours, three].into_iter().chain(differences).collect());
        rows.push(row);
    }
    save_sheet(&options.out, "render-truth.jpg", &sheet(&pictures, TILE))?;
    save(&options.out, "render-truth.csv", &table(&rows, &kept.regions).csv())?;
    Ok(section(&rows, &kept, &version))
}

/// The folder of panoramas.
///
/// # Errors
/// When there is none.
pub(super) fn panoramas(options: &Options) -> Result<PathBuf> {
    let folder = options.panoramas.clone().map_or_else(|| media_folder("hdr"), Ok)?;
    folder.canonicalize().with_context(|| format!("--panoramas {}", folder.display()))
}

/// The panorama whose file name ends in `name`.
///
/// # Errors
/// When the folder holds none.
pub(super) fn find(folder: &Path, name: &str) -> Result<PathBuf> {
    let entries = std::fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    let fits = |path: &PathBuf| {
        path.extension().is_some_and(|kind| kind == "exr" || kind == "hdr")
            && path.file_stem().is_some_and(|stem| stem.to_string_lossy().ends_with(name))
    };
    let found = entries.filter_map(|entry| Some(entry.ok()?.path())).find(fits);
    found.with_context(|| format!("{}: holds no panorama {name}; run deploy/fetch-media", folder.display()))
}

fn compare(truth: &RgbImage, picture: &RgbImage, regions: &[u8], count: usize) -> Compared {
    let difference = flip(truth, picture);
    let rmse = rmse(truth, picture);
    let mut shares = vec![0.0; count];
    for (value, region) in difference.iter().zip(regions) {
        if let Some(share) = shares.get_mut(usize::from(*region)) {
            *share += value / difference.len() as f64;
        }
    }
    Compared { flip: mean(&difference), rmse, shares, difference }
}

/// Root of the mean square of the codes' differences, 1 between black and white; of pictures of one size.
pub(super) fn rmse(truth: &RgbImage, picture: &RgbImage) -> f64 {
    let squares = truth.as_raw().iter().zip(picture.as_raw()).map(|(a, b)| ((f64::from(*a) - f64::from(*b)) / 255.0).powi(2));
    (squares.sum::<f64>() / truth.as_raw().len() as f64).sqrt()
}

fn table(rows: &[Row], regions: &[String]) -> Table {
    let mut head = vec!["panorama".to_owned(), "renderer".to_owned(), "FLIP".to_owned(), "RMSE".to_owned()];
    head.extend(regions.iter().map(|region| format!("of it {region}")));
    let mut table = Table::new(&head.iter().map(String::as_str).collect::<Vec<_>>());
    for row in rows {
        for (renderer, compared) in [("ours", &row.ours), ("three.js", &row.three)] {
            let figures = [compared.flip, compared.rmse].into_iter().chain(compared.shares.iter().copied()).map(number);
            table.push([row.panorama.clone(), renderer.to_owned()].into_iter().chain(figures));
        }
    }
    table
}

fn section(rows: &[Row], kept: &Kept, three: &str) -> String {
    let lower = rows.iter().filter(|row| row.ours.flip < row.three.flip).count();
    let over = |of: fn(&Row) -> f64| rows.iter().map(of).sum::<f64>() / rows.len().max(1) as f64;
    let verdict = if lower >= WANTED.min(rows.len()) { "met" } else { "missed" };
    let mut main =
        Table::new(&["panorama", "ours FLIP", "three.js FLIP", "ours RMSE", "three.js RMSE", "ground emits", "noise of the truth"]);
    for row in rows {
        let quality = kept.panoramas.get(&row.panorama);
        let of = |figure: fn(&Quality) -> f64| quality.map(figure).map_or_else(String::new, number);
        let figures = [row.ours.flip, row.three.flip, row.ours.rmse, row.three.rmse].map(number);
        let known = [of(|quality| quality.emitted_share_of_ground), of(|quality| quality.standard_error)];
        main.push(std::iter::once(row.panorama.clone()).chain(figures).chain(known));
    }
    let mut where_from = Table::new(&["region", "ours", "three.js"]);
    let mut ranked: Vec<_> = kept
        .regions
        .iter()
        .enumerate()
        .map(|(at, name)| {
            let share =
                |of: fn(&Row) -> &Compared| rows.iter().filter_map(|row| of(row).shares.get(at)).sum::<f64>() / rows.len().max(1) as f64;
            (name, share(|row| &row.ours), share(|row| &row.three))
        })
        .collect();
    ranked.sort_by(|a, b| b.1.total_cmp(&a.1));
    for (name, ours, three) in ranked {
        where_from.push([name.clone(), number(ours), number(three)]);
    }
    format!(
        "## Against path-traced truth\n\nThree spheres, a fox and a bunny on a ground whose albedo makes it look, with nothing on it, as the panorama does; \
         Mitsuba {}, {} runs of {} samples a pixel. Beside ours: {three}. The light is the server's estimate for both.\n\n\
         FLIP of ours is lower on **{lower} of {}** panoramas (wanted: at least {WANTED}; **{verdict}**); mean {} against {} of three.js.\n\n{}\n\
         What each region adds to the mean FLIP:\n\n{}\n\
         Truth, ours, three.js, and FLIP of ours and of three.js, one row a panorama in the order of the table:\n\n![Pictures](render-truth.jpg)\n",
        kept.made_with.mitsuba,
        kept.made_with.runs,
        kept.made_with.samples,
        rows.len(),
        number(over(|row| row.ours.flip)),
        number(over(|row| row.three.flip)),
        main.markdown(),
        where_from.markdown(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_differs_counts_where_it_lies() {
        let grey = RgbImage::from_pixel(64, 32, image::Rgb([128; 3]));
        let mut marked = grey.clone();
        (0..32).flat_map(|y| (40..64).map(move |x| (x, y))).for_each(|(x, y)| marked.put_pixel(x, y, image::Rgb([200; 3])));
        let regions: Vec<u8> = (0..64 * 32).map(|at| u8::from(at % 64 >= 32)).collect();
        let compared = compare(&grey, &marked, &regions, 2);
        // 24 of 64 columns differ by 72 codes; all of it in the right half but for what the eye's filter spreads.
        assert!((compared.rmse - 72.0 / 255.0 * (24.0_f64 / 64.0).sqrt()).abs() < 1e-9);
        assert!((compared.shares.iter().sum::<f64>() - compared.flip).abs() < 1e-12);
        assert!(compared.shares[1] > 20.0 * compared.shares[0]);
    }

    #[test]
    fn the_verdict_counts_panoramas() {
        let compared = |flip| Compared { flip, rmse: flip, shares: vec![0.0, flip], difference: Vec::new() };
        let row = |name: &str, ours, three| Row { panorama: name.to_owned(), ours: compared(ours), three: compared(three) };
        let quality = || Quality { emitted_share_of_ground: 0.01, standard_error: 0.001 };
        let kept = Kept {
            made_with: MadeWith { mitsuba: "3.9.1".to_owned(), runs: 16, samples: 96 },
            view: View { size: (64, 36), fov_y_deg: 45.0, pitch_deg: -14.0 },
            regions: vec!["panorama".to_owned(), "ground".to_owned()],
            panoramas: [("a".to_owned(), quality())].into(),
        };
        let names = ["a", "b", "c", "d", "e", "f", "g", "h"];
        let rows: Vec<_> = names.iter().enumerate().map(|(at, name)| row(name, 0.05, if at == 0 { 0.05 } else { 0.06 })).collect();
        assert!(section(&rows, &kept, "r187").contains("**7 of 8** panoramas (wanted: at least 7; **met**)"));
        let rows: Vec<_> = names.iter().enumerate().map(|(at, name)| row(name, 0.05, if at < 2 { 0.04 } else { 0.06 })).collect();
        let text = section(&rows, &kept, "r187");
        assert!(text.contains("**6 of 8**") && text.contains("**missed**") && text.contains("| ground | 0.05 |"));
        assert_eq!(table(&rows, &kept.regions).csv().lines().nth(1), Some("a,ours,0.05,0.05,0,0.05"));
    }

    #[test]
    fn every_reference_is_there_and_fits() {
        let folder = references("truth");
        let kept: Kept = load_json(&folder.join("truth.json")).unwrap();
        assert_eq!(kept.panoramas.len(), 8);
        let regions = load_picture(&folder.join("regions.png"), kept.view.size).unwrap().into_luma8();
        assert!((0..kept.regions.len()).all(|region| regions.as_raw().contains(&(region as u8))));
        for name in kept.panoramas.keys() {
            for kind in ["truth", "three"] {
                load_picture(&folder.join(format!("{name}-{kind}.png")), kept.view.size).unwrap();
            }
        }
    }
}
