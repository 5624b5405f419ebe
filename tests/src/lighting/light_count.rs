//! What the number of lights costs and brings: the default method with lights from different shares of the light on, and the methods whose number
//! of lights can be set; error of irradiance and of a shadow against bytes and lights sent.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use mr360_server::lighting::{LightMethod, MethodSpec, StepTimes};

use super::Options;
use super::exposure::Exposure;
use super::irradiance::Normals;
use super::name;
use super::radiance_map::{Half, RadianceMap};
use super::rendered::{self, Stage};
use super::report::{per_cent, spread};
use super::score::{Light, Score};
use super::truth::Truth;
use crate::chart::{Axis, Chart, Mark, Scale, Series, number};
use crate::figures::save;
use crate::samples::percentile;
use crate::table::Table;

/// Shares of the upper hemisphere's energy from which on something is a light of the default method, per cent. The last leaves all to the SH.
const SHARES: [f64; 8] = [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 100.0];
/// Numbers of lights of the others.
const COUNTS: [usize; 6] = [1, 2, 4, 8, 16, 32];
/// Methods that take such a number.
const COUNTED: [&str; 3] = ["median-cut", "variance-cut", "k-means"];
/// How the panoramas are shown.
const EXPOSURES: [Exposure; 3] = [Exposure::Hdr, Exposure::Ldr(95), Exposure::Ldr(99)];

/// One method with one setting on one panorama through one exposure.
#[derive(Debug, Clone, PartialEq)]
struct Row {
    method: String,
    /// Least share in per cent, or number of lights.
    setting: f64,
    panorama: String,
    half: Half,
    exposure: Exposure,
    lights: usize,
    bytes: usize,
    absolute: f64,
    /// Root mean square error of the ground around a cylinder over its mean.
    shadow: f64,
}

/// Measures, writes `lighting-lights.csv` and a chart an exposure, and returns the section of the summary.
///
/// # Errors
/// When a panorama cannot be used, a method fails, or the results cannot be written.
pub(super) fn run(options: &Options, files: &[PathBuf]) -> Result<String> {
    let (normals, stage) = (Normals::new(), Stage::new());
    let mut rows = Vec::new();
    for (place, path) in files.iter().enumerate() {
        eprintln!("lighting: number of lights on {} ({} of {})", name(path), place + 1, files.len());
        rows.extend(measure(path, Half::of_place(place), &normals, &stage).with_context(|| path.display().to_string())?);
    }
    save(&options.out, "lighting-lights.csv", &csv(&rows))?;
    for exposure in EXPOSURES {
        save(&options.out, &chart_name(exposure), &chart(&rows, exposure)?)?;
    }
    Ok(markdown(&rows))
}

/// A method's name, its setting and itself.
type Made = (&'static str, f64, Box<dyn LightMethod>);

/// Every method with every setting.
fn made() -> Result<Vec<Made>> {
    let default = MethodSpec::default();
    let shares = SHARES.iter().map(|share| {
        let made = default.make_from(share / 100.0);
        Ok((default.name(), *share, made.context("the default method has no least share")?))
    });
    let counted = COUNTED.iter().flat_map(|method| COUNTS.iter().map(move |count| (*method, *count)));
    let counted = counted.map(|(method, count)| Ok((method, count as f64, format!("{method}:{count}").parse::<MethodSpec>()?.make())));
    shares.chain(counted).collect()
}

fn measure(path: &Path, half: Half, normals: &Normals, stage: &Stage) -> Result<Vec<Row>> {
    let map = RadianceMap::load(path)?;
    let truth = Truth::of(&map, normals);
    let pictures = stage.under_all(&[&map]).into_iter().next().unwrap_or_default();
    let mut rows = Vec::new();
    for exposure in EXPOSURES {
        let taken = exposure.take(&map)?;
        for (method, setting, mut made) in made()? {
            let estimate = made.estimate(&taken.frame, &mut StepTimes::default()).with_context(|| format!("{method} at {setting}"))?;
            let light = Light::from(estimate);
            let [_, _, (shadow, _), _] = rendered::errors(&stage.under(&light, &[]), &pictures, taken.scale);
            rows.push(Row {
                method: method.to_owned(),
                setting,
                panorama: name(path),
                half,
                exposure,
                lights: light.lights.len(),
                bytes: light.over_the_wire()?.0,
                absolute: Score::of(&light, &truth, taken.scale, normals).absolute,
                shadow,
            });
        }
    }
    Ok(rows)
}

fn csv(rows: &[Row]) -> String {
    let mut table = Table::new(&["method", "setting", "panorama", "half", "exposure", "lights", "bytes", "absolute", "shadow"]);
    for row in rows {
        table.push([
            row.method.clone(),
            row.setting.to_string(),
            row.panorama.clone(),
            row.half.name().to_owned(),
            row.exposure.name(),
            row.lights.to_string(),
            row.bytes.to_string(),
            format!("{:.5}", row.absolute),
            format!("{:.5}", row.shadow),
        ]);
    }
    table.csv()
}

fn chart_name(exposure: Exposure) -> String {
    format!("lighting-lights-{}.svg", exposure.name())
}

/// Methods with their settings.
fn settings() -> impl Iterator<Item = (&'static str, Vec<f64>)> {
    let counts = || COUNTS.iter().map(|count| *count as f64).collect();
    std::iter::once((MethodSpec::default().name(), SHARES.to_vec())).chain(COUNTED.iter().map(move |method| (*method, counts())))
}

fn chart(rows: &[Row], exposure: Exposure) -> Result<String> {
    let series: Vec<Series> = settings()
        .map(|(method, settings)| {
            let point = |setting: &f64| {
                let own: Vec<&Row> =
                    rows.iter().filter(|row| row.method == method && row.setting == *setting && row.exposure == exposure).collect();
                let mean = own.iter().map(|row| row.bytes as f64).sum::<f64>() / own.len() as f64;
                let errors: Vec<f64> = own.iter().map(|row| row.shadow * 100.0).collect();
                Some((mean, percentile(&errors, 0.5)?))
            };
            Series { name: method.to_owned(), points: settings.iter().filter_map(point).collect(), mark: Mark::Line }
        })
        .collect();
    ensure!(series.iter().any(|series| !series.points.is_empty()), "nothing was measured at {}", exposure.title());
    Chart {
        title: format!("{}: from no light to all that stand out", exposure.title()),
        x: Axis { label: "mean bytes a frame".to_owned(), scale: Scale::Log },
        y: Axis { label: "error of the ground around a cylinder / %, median".to_owned(), scale: Scale::Log },
        series,
    }
    .svg()
}

fn markdown(rows: &[Row]) -> String {
    let mut text = format!(
        "## Number of lights\n\n`{}` with lights from a share of the upper hemisphere's energy on (kept down to half of it), and methods with a set \
         number. Each cell: mean lights, mean bytes, error of irradiance, error of the ground around a cylinder; errors in %, median (worst) \
         over all panoramas.\n",
        MethodSpec::default().name()
    );
    for exposure in EXPOSURES {
        let mut table = Table::new(&["method", "setting", "lights", "bytes", "irradiance", "shadow"]);
        for (method, settings) in settings() {
            for setting in settings {
                let own = || rows.iter().filter(|row| row.method == method && row.setting == setting && row.exposure == exposure);
                let mean = |f: fn(&Row) -> usize| own().map(|row| f(row) as f64).sum::<f64>() / own().count().max(1) as f64;
                let of = |f: fn(&Row) -> f64| spread(&own().map(f).collect::<Vec<_>>(), per_cent);
                let unit = if method == MethodSpec::default().name() { " %" } else { "" };
                table.push([
                    method.to_owned(),
                    format!("{setting}{unit}"),
                    number(mean(|row| row.lights)),
                    number(mean(|row| row.bytes)),
                    of(|row| row.absolute),
                    of(|row| row.shadow),
                ]);
            }
        }
        text += &format!("\n{}:\n\n{}", exposure.title(), table.markdown());
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
    fn fewer_lights_are_sent_from_higher_shares_on_and_none_from_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lamps.exr");
        let lamps = [(Vec3::new(0.0, 0.8, -0.6), 400.0), (Vec3::new(0.6, 0.8, 0.0), 150.0)];
        let map = RadianceMap::of(128, |d| {
            let lamp = lamps.iter().find(|(to, _)| d.dot(*to) > 5f32.to_radians().cos());
            Vec3::splat(lamp.map_or(1.0, |(_, radiance)| *radiance))
        });
        let texels = map.texels().iter().flat_map(Vec3::to_array).collect();
        image::Rgb32FImage::from_raw(256, 128, texels).unwrap().save(&path).unwrap();
        let rows = measure(&path, Half::Tune, &Normals::new(), &Stage::new()).unwrap();
        assert_eq!(rows.len(), (SHARES.len() + COUNTED.len() * COUNTS.len()) * EXPOSURES.len());
        let sent = |method: &str| -> Vec<usize> {
            let own = rows.iter().filter(|row| row.method == method && row.exposure == Exposure::Hdr);
            own.map(|row| row.lights).collect()
        };
        // The lamps give 9.6 and 3.6 of 19.5 in all, 8.2 and 2.2 above μ + 2σ.
        assert_eq!(sent("directional"), [2, 2, 2, 2, 2, 1, 1, 0]);
        assert_eq!(sent("median-cut"), COUNTS);
        let shadow = |setting: f64| {
            let own = |row: &&Row| row.method == "directional" && row.exposure == Exposure::Hdr && row.setting == setting;
            rows.iter().find(own).unwrap().shadow
        };
        assert!(shadow(4.0) < shadow(16.0) && shadow(16.0) < 0.5 * shadow(100.0), "{} {} {}", shadow(4.0), shadow(16.0), shadow(100.0));
        let text = markdown(&rows);
        assert!(text.contains("| directional | 4 % |") && text.contains("| k-means | 32 |"), "{text}");
        assert_eq!(csv(&rows).lines().count(), rows.len() + 1);
        assert!(chart(&rows, Exposure::Hdr).unwrap().contains(">variance-cut<") && chart(&[], Exposure::Hdr).is_err());
    }
}
