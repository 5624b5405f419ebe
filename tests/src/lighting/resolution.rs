//! What the size of the working panorama costs and brings: methods made at 8×4 to 1024×512 texels, error against time.
//!
//! LDR frames are those of a live stream, 1280×640 in planar 4:2:0; HDR frames are the panoramas themselves.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use mr360_server::lighting::{LightMethod, MethodSpec, StepTimes};

use super::exposure::Exposure;
use super::irradiance::Normals;
use super::race::FRAME_US;
use super::radiance_map::{Half, RadianceMap};
use super::report::{directions, per_cent, spread};
use super::score::{Dominant, Light, Score};
use super::truth::Truth;
use super::video_frame::{SIZE, VideoFrame};
use super::{Options, name};
use crate::chart::{Axis, Chart, Mark, Scale, Series, number};
use crate::figures::save;
use crate::samples::percentile;
use crate::table::Table;

/// Columns of the working panorama.
const WIDTHS: [u32; 8] = [8, 16, 32, 64, 128, 256, 512, 1024];
/// Methods whose size can be set, the default one first.
const METHODS: [&str; 4] = ["directional", "mr360", "sh:9", "sh:25"];
/// How the panoramas are shown.
const EXPOSURES: [Exposure; 3] = [Exposure::Hdr, Exposure::Ldr(95), Exposure::Ldr(99)];

/// One method at one width on one panorama through one exposure.
#[derive(Debug, Clone, PartialEq)]
struct Row {
    method: &'static str,
    width: u32,
    panorama: String,
    half: Half,
    exposure: Exposure,
    absolute: f64,
    scale_invariant: f64,
    dominant: Dominant,
    time_ms: f64,
}

/// Measures, writes `lighting-resolution.csv` and a chart an exposure, and returns the section of the summary.
///
/// # Errors
/// When a panorama cannot be used, a method fails, or the results cannot be written.
pub(super) fn run(options: &Options, files: &[PathBuf]) -> Result<String> {
    let mut rows = Vec::new();
    for (place, path) in files.iter().enumerate() {
        eprintln!("lighting: resolution on {} ({} of {})", name(path), place + 1, files.len());
        rows.extend(measure(path, Half::of_place(place), options.rounds).with_context(|| path.display().to_string())?);
    }
    save(&options.out, "lighting-resolution.csv", &csv(&rows))?;
    for exposure in EXPOSURES {
        save(&options.out, &chart_name(exposure), &chart(&rows, exposure)?)?;
    }
    Ok(markdown(&rows, options.rounds))
}

fn measure(path: &Path, half: Half, rounds: u32) -> Result<Vec<Row>> {
    let (map, normals) = (RadianceMap::load(path)?, Normals::new());
    let truth = Truth::of(&map, &normals);
    let mut rows = Vec::new();
    for exposure in EXPOSURES {
        let scale = exposure.scale(&map)?;
        let mut frame = match exposure {
            Exposure::Hdr => exposure.take(&map)?.frame,
            Exposure::Ldr(_) => VideoFrame::of(&map, scale)?.frame,
        };
        let mut methods = made()?;
        let mut times = vec![Vec::new(); methods.len()];
        let mut lights = vec![Light::default(); methods.len()];
        for round in 0..=rounds {
            frame.pts_us = u64::from(round) * FRAME_US;
            for (((method, width, made), times), light) in methods.iter_mut().zip(&mut times).zip(&mut lights) {
                let started = Instant::now();
                let estimate = made.estimate(&frame, &mut StepTimes::default()).with_context(|| format!("{method} at {width}"))?;
                let elapsed_ms = started.elapsed().as_secs_f64() * 1e3;
                if round > 0 {
                    times.push(elapsed_ms);
                    *light = estimate.into();
                }
            }
        }
        rows.extend(methods.iter().zip(times).zip(lights).map(|(((method, width, _), times), light)| {
            let score = Score::of(&light, &truth, scale, &normals);
            Row {
                method,
                width: *width,
                panorama: name(path),
                half,
                exposure,
                absolute: score.absolute,
                scale_invariant: score.scale_invariant,
                dominant: score.dominant,
                time_ms: percentile(&times, 0.5).unwrap_or(f64::NAN),
            }
        }));
    }
    Ok(rows)
}

/// A method's name, its width and itself.
type Made = (&'static str, u32, Box<dyn LightMethod>);

/// Every method at every width.
fn made() -> Result<Vec<Made>> {
    let all = METHODS.iter().flat_map(|method| WIDTHS.iter().map(move |width| (*method, *width)));
    all.map(|(method, width)| {
        let made = method.parse::<MethodSpec>()?.make_at(width);
        Ok((method, width, made.with_context(|| format!("{method} is not made at {width} columns"))?))
    })
    .collect()
}

fn size(width: u32) -> String {
    format!("{width}×{}", width / 2)
}

fn csv(rows: &[Row]) -> String {
    let mut table =
        Table::new(&["method", "width", "panorama", "half", "exposure", "absolute", "scale_invariant", "dominant_off_deg", "time_ms"]);
    for row in rows {
        table.push([
            row.method.to_owned(),
            row.width.to_string(),
            row.panorama.clone(),
            row.half.name().to_owned(),
            row.exposure.name(),
            format!("{:.5}", row.absolute),
            format!("{:.5}", row.scale_invariant),
            if let Dominant::OffDeg(off) = row.dominant { format!("{off:.3}") } else { String::new() },
            format!("{:.4}", row.time_ms),
        ]);
    }
    table.csv()
}

fn chart_name(exposure: Exposure) -> String {
    format!("lighting-resolution-{}.svg", exposure.name())
}

/// Those that tables and charts are made of: the held-out half, or everything where nothing was held out.
fn judged(rows: &[Row]) -> impl Iterator<Item = &Row> {
    let held_out = rows.iter().any(|row| row.half == Half::HeldOut);
    rows.iter().filter(move |row| !held_out || row.half == Half::HeldOut)
}

fn chart(rows: &[Row], exposure: Exposure) -> Result<String> {
    let point = |method: &str, width: u32| {
        let own: Vec<&Row> = judged(rows).filter(|row| row.method == method && row.width == width && row.exposure == exposure).collect();
        let median = |f: fn(&Row) -> f64| percentile(&own.iter().map(|row| f(row)).collect::<Vec<_>>(), 0.5);
        Some((median(|row| row.time_ms)?, median(|row| row.absolute)? * 100.0))
    };
    let series: Vec<Series> = METHODS
        .iter()
        .map(|method| Series {
            name: (*method).to_owned(),
            points: WIDTHS.iter().filter_map(|width| point(method, *width)).collect(),
            mark: Mark::Line,
        })
        .collect();
    ensure!(series.iter().any(|series| !series.points.is_empty()), "nothing was measured at {}", exposure.title());
    let ends = (size(WIDTHS[0]), size(WIDTHS[WIDTHS.len() - 1]));
    Chart {
        title: format!("{}: working panorama of {} to {}, median", exposure.title(), ends.0, ends.1),
        x: Axis { label: "time / ms".to_owned(), scale: Scale::Log },
        y: Axis { label: "irradiance error / %".to_owned(), scale: Scale::Log },
        series,
    }
    .svg()
}

/// A row a width, a column a method.
fn by_width(cell: impl Fn(&str, u32) -> String) -> Table {
    let head: Vec<&str> = std::iter::once("working panorama").chain(METHODS).collect();
    let mut table = Table::new(&head);
    for width in WIDTHS {
        table.push(std::iter::once(size(width)).chain(METHODS.iter().map(|method| cell(method, width))));
    }
    table
}

fn markdown(rows: &[Row], rounds: u32) -> String {
    let usual = METHODS.iter().filter_map(|method| {
        let width = method.parse::<MethodSpec>().ok()?.usual_width()?;
        Some(format!("`{method}` {}", size(width)))
    });
    let mut text = format!(
        "## Working resolution\n\nMethods made with working panoramas of {} to {} texels; their own are {}. As many blocks of the source go into a texel as usual, or as few as keep the usual number along a row. \
         HDR frames are the panoramas, LDR frames {}×{} yuv420p. Errors are irradiance errors in %, absolute / after the best single scale, median (worst) over \
         the held-out half; times median (worst) over all panoramas, each the median of {rounds} rounds on one thread.\n",
        size(WIDTHS[0]),
        size(WIDTHS[WIDTHS.len() - 1]),
        usual.collect::<Vec<_>>().join(", "),
        SIZE.0,
        SIZE.1,
    );
    for exposure in EXPOSURES {
        let errors = by_width(|method, width| {
            let own = || judged(rows).filter(|row| row.method == method && row.width == width && row.exposure == exposure);
            let of = |f: fn(&Row) -> f64| spread(&own().map(f).collect::<Vec<_>>(), per_cent);
            format!("{} / {}", of(|row| row.absolute), of(|row| row.scale_invariant))
        });
        text += &format!("\nError, {}:\n\n{}", exposure.title(), errors.markdown());
        let off = by_width(|method, width| {
            let own = judged(rows).filter(|row| row.method == method && row.width == width && row.exposure == exposure);
            directions(&own.map(|row| row.dominant).collect::<Vec<_>>())
        });
        text += &format!("\nDirection of the dominant light, {}:\n\n{}", exposure.title(), off.markdown());
    }
    for (title, hdr) in [("HDR", true), ("LDR", false)] {
        let times = by_width(|method, width| {
            let own = rows.iter().filter(|row| row.method == method && row.width == width && (row.exposure == Exposure::Hdr) == hdr);
            spread(&own.map(|row| row.time_ms).collect::<Vec<_>>(), number)
        });
        text += &format!("\nTime in ms, {title}:\n\n{}", times.markdown());
    }
    text += "\n";
    for exposure in EXPOSURES {
        text += &format!("![{}]({})\n", exposure.title(), chart_name(exposure));
    }
    text
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    #[test]
    fn every_method_is_measured_at_every_width_through_every_exposure() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sky.exr");
        let map = RadianceMap::of(32, |d| Vec3::new(0.5, 0.6, 0.8) * (1.0 + 0.5 * d.y + 0.3 * d.x));
        let texels = map.texels().iter().flat_map(Vec3::to_array).collect();
        image::Rgb32FImage::from_raw(64, 32, texels).unwrap().save(&path).unwrap();
        let rows = measure(&path, Half::Tune, 1).unwrap();
        assert_eq!(rows.len(), METHODS.len() * WIDTHS.len() * EXPOSURES.len());
        for row in rows.iter().filter(|row| row.exposure == Exposure::Hdr && row.method.starts_with("sh")) {
            // Bands 0 and 1 alone; texels of 45° take a tenth of band 1, which is a twentieth of the light.
            assert!(row.absolute < if row.width < 64 { 0.05 } else { 2e-3 }, "{row:?}");
        }
        let text = markdown(&rows, 1);
        assert!(text.contains("| 8×4 |") && text.contains("| 1024×512 |") && text.contains("`directional` 512×256"));
        assert_eq!(csv(&rows).lines().count(), rows.len() + 1);
        let svg = chart(&rows, Exposure::Hdr).unwrap();
        assert!(svg.contains(">sh:25<") && svg.matches("<polyline").count() == METHODS.len());
        assert!(chart(&[], Exposure::Hdr).is_err());
    }
}
