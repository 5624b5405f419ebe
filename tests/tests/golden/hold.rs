//! Pictures against their goldens, within the tolerances of `tolerances.toml`; or the goldens made anew.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use image::RgbImage;
use mr360_tests::render::flip::{flip, mean};
use serde::Deserialize;

/// Of all goldens together, bytes.
const LARGEST: u64 = 2_000_000;

/// What the pictures whose names begin alike may be off.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Tolerance {
    /// Largest mean FLIP.
    flip: f64,
    /// Largest difference of a code of any channel…
    codes: u8,
    /// …in all but this share of the pixels.
    spare: f64,
    /// Why so much.
    reason: String,
}

/// Folder of the goldens.
pub(crate) fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("references/golden")
}

fn tolerances() -> Result<BTreeMap<String, Tolerance>> {
    let path = folder().join("tolerances.toml");
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    toml::from_str(&text).with_context(|| path.display().to_string())
}

/// The tolerance whose name is the longest that `name` begins with or ends in.
fn tolerance<'a>(all: &'a BTreeMap<String, Tolerance>, name: &str) -> Result<&'a Tolerance> {
    let fits = all.iter().filter(|(known, _)| name.starts_with(known.as_str()) || name.ends_with(known.as_str()));
    let longest = fits.max_by_key(|(known, _)| known.len()).map(|(_, tolerance)| tolerance);
    longest.with_context(|| format!("tolerances.toml holds none for {name}"))
}

/// Compares every picture with its golden; with `MR360_GOLDEN=write` in the environment keeps the pictures as goldens instead.
pub(crate) fn hold(pictures: Vec<(String, RgbImage)>) -> Result<()> {
    let tolerances = tolerances()?;
    let write = std::env::var_os("MR360_GOLDEN").is_some_and(|value| value == "write");
    let mut faults = Vec::new();
    for (name, picture) in pictures {
        let tolerance = tolerance(&tolerances, &name)?;
        let path = folder().join(format!("{name}.png"));
        if write {
            picture.save(&path).with_context(|| path.display().to_string())?;
        } else if let Some(fault) = compare(&picture, &path, tolerance)? {
            let kept = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}.png"));
            picture.save(&kept).with_context(|| kept.display().to_string())?;
            faults.push(format!("{name}: {fault}; drawn: {}, golden: {}", kept.display(), path.display()));
        }
    }
    ensure!(
        faults.is_empty(),
        "{}\nif this is meant: MR360_GOLDEN=write cargo test -p mr360-tests --test golden, and look at the pictures",
        faults.join("\n")
    );
    Ok(())
}

fn compare(picture: &RgbImage, path: &Path, tolerance: &Tolerance) -> Result<Option<String>> {
    let golden = image::open(path).with_context(|| path.display().to_string())?.into_rgb8();
    ensure!(golden.dimensions() == picture.dimensions(), "{}: of another size", path.display());
    let flip = mean(&flip(&golden, picture));
    let differs = |(a, b): (&image::Rgb<u8>, &image::Rgb<u8>)| (0..3).map(|c| a.0[c].abs_diff(b.0[c])).max().unwrap_or_default();
    let mut codes: Vec<u8> = golden.pixels().zip(picture.pixels()).map(differs).collect();
    codes.sort_unstable();
    let held = codes.len() - 1 - (codes.len() as f64 * tolerance.spare) as usize;
    let Tolerance { flip: most, codes: most_codes, spare, reason } = tolerance;
    let over = flip > *most || codes[held] > *most_codes;
    Ok(over.then(|| {
        format!(
            "mean FLIP {flip:.5} (at most {most}), {} codes but for {spare} of the pixels (at most {most_codes}), {} at worst; tolerated: {reason}",
            codes[held],
            codes[codes.len() - 1]
        )
    }))
}

#[test]
fn every_tolerance_has_its_reason_and_its_pictures_which_are_small() -> Result<()> {
    let all = tolerances()?;
    let (mut names, mut bytes) = (Vec::new(), 0);
    for entry in std::fs::read_dir(folder())? {
        let entry = entry?;
        bytes += entry.metadata()?.len();
        let path = entry.path();
        if path.extension().is_some_and(|kind| kind == "png") {
            names.push(path.file_stem().unwrap_or_default().to_string_lossy().into_owned());
        }
    }
    ensure!(bytes < LARGEST, "the goldens take {bytes} bytes");
    for (known, of) in &all {
        ensure!(of.reason.len() > 10 && (0.0..0.1).contains(&of.spare) && of.flip < 0.05, "{known}: no reason, or too much is tolerated");
        let used = names.iter().any(|name| tolerance(&all, name).is_ok_and(|used| std::ptr::eq(used, of)));
        ensure!(used, "{known}: no picture needs this tolerance");
    }
    Ok(())
}

#[test]
fn differences_beyond_the_tolerance_are_faults_and_others_are_not() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("grey.png");
    let grey = RgbImage::from_pixel(40, 30, image::Rgb([128; 3]));
    grey.save(&path)?;
    let tolerance = Tolerance { flip: 0.1, codes: 2, spare: 0.005, reason: "rounding".to_owned() };
    let changed = |pixels: u32, by: u8| {
        let mut picture = grey.clone();
        (0..pixels).for_each(|at| picture.put_pixel(at % 40, at / 40, image::Rgb([128 + by; 3])));
        compare(&picture, &path, &tolerance)
    };
    // Six of 1200 pixels are spared, all may be off by two codes.
    ensure!(changed(6, 60)?.is_none() && changed(1200, 2)?.is_none());
    ensure!(changed(7, 60)?.is_some() && changed(1200, 3)?.is_some());
    Ok(())
}
