//! What methods do over time, frame by frame: a chart a sequence, and one table.

use anyhow::Result;

use super::measures::{Moment, Shown};
use super::{Run, Watched};
use crate::chart::{self, Axis, Chart, Mark, Scale, Series};
use crate::table::Table;

/// Where logarithmic axes end: what is less is drawn here.
const LEAST_DEG: f64 = 0.01;
const LEAST_STRENGTH: f64 = 1e-3;

/// One row a sequence, method and frame. Cells are empty where there is no main light, or no truth.
pub(super) fn csv(all: &[Watched]) -> String {
    let mut table = Table::new(&[
        "sequence",
        "method",
        "time_s",
        "lights",
        "off_deg",
        "strength",
        "true_strength",
        "level_irradiance",
        "true_level_irradiance",
    ]);
    for watched in all {
        for (run, moment) in watched.runs.iter().flat_map(|run| run.moments.iter().map(move |moment| (run, moment))) {
            let cell = |value: Option<f64>| value.map(|value| format!("{value:.4}")).unwrap_or_default();
            table.push([
                watched.sequence.clone(),
                run.method.clone(),
                format!("{:.3}", moment.time_s),
                moment.estimate.lights.len().to_string(),
                cell(moment.off_deg()),
                cell(strength(&moment.estimate)),
                cell(moment.truth.as_ref().and_then(strength)),
                cell(Some(moment.estimate.level())),
                cell(moment.truth.as_ref().map(Shown::level)),
            ]);
        }
    }
    table.csv()
}

fn strength(shown: &Shown) -> Option<f64> {
    shown.main.map(|main| main.strength)
}

/// File of a sequence's chart.
pub(super) fn chart_name(sequence: &str) -> String {
    let word: String = sequence.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' }).collect();
    let words: Vec<&str> = word.split('-').filter(|part| !part.is_empty()).collect();
    format!("lighting-stability-{}.svg", words.join("-"))
}

/// Three panels over time: error of the main light's direction where a truth is known, its strength, and the irradiance of level ground.
///
/// # Errors
/// When a method gave a number that is none.
pub(super) fn chart(watched: &Watched) -> Result<String> {
    let Watched { sequence, runs } = watched;
    let panel = |what: &str, scale: Scale, of: &dyn Fn(&Moment) -> Option<f64>, truth: &dyn Fn(&Shown) -> Option<f64>| {
        // A method that has nothing to show keeps its colour.
        let mut series: Vec<Series> = runs.iter().map(|run| curve(run.method.clone(), Mark::Curve, run, of)).collect();
        let truth = |moment: &Moment| moment.truth.as_ref().and_then(truth);
        series.extend(runs.first().map(|run| curve("truth".to_owned(), Mark::Reference, run, &truth)).filter(is_drawn));
        Chart {
            title: format!("{sequence}: {what}"),
            x: Axis { label: "time / s".to_owned(), scale: Scale::Linear },
            y: Axis { label: what.to_owned(), scale },
            series,
        }
    };
    let off = |moment: &Moment| moment.off_deg().map(|off| off.max(LEAST_DEG));
    let lit = |shown: &Shown| strength(shown).map(|strength| strength.max(LEAST_STRENGTH));
    let level = |shown: &Shown| Some(shown.level().max(LEAST_STRENGTH));
    let panels = [
        panel("error of direction / °", Scale::Log, &off, &|_| None),
        panel("strength of the main light", Scale::Log, &|moment| lit(&moment.estimate), &lit),
        panel("irradiance of level ground", Scale::Log, &|moment| level(&moment.estimate), &level),
    ];
    let drawn: Vec<Chart> = panels.into_iter().filter(|panel| panel.series.iter().any(is_drawn)).collect();
    chart::stack(&drawn)
}

/// The pen is lifted where there is no value.
fn curve(name: String, mark: Mark, run: &Run, of: &dyn Fn(&Moment) -> Option<f64>) -> Series {
    let points = run.moments.iter().map(|moment| (moment.time_s, of(moment).unwrap_or(f64::NAN))).collect();
    Series { name, points, mark }
}

fn is_drawn(series: &Series) -> bool {
    series.points.iter().any(|(_, y)| !y.is_nan())
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use mr360_server::lighting::sequences::Varies;

    use super::super::measures::{Main, Measures};
    use super::*;

    fn shown(main: Option<Main>) -> Shown {
        let lights = main.iter().map(|main| (0, main.direction)).collect();
        Shown { main, lights, surfaces: [DVec3::splat(2.0); 6], ambient: 1.0 }
    }

    /// A method that finds half of the light until it loses it, and one that knows no lights.
    fn watched(known: bool) -> Watched {
        let main = |strength| Some(Main { direction: DVec3::Y, strength });
        let run = |method: &str, finds: bool| {
            let moment = |frame: usize| Moment {
                time_s: frame as f64,
                estimate: shown(if finds && frame < 2 { main(0.5) } else { None }),
                truth: known.then(|| shown(main(1.0))),
            };
            let moments: Vec<Moment> = (0..4).map(moment).collect();
            Run { method: method.to_owned(), measures: Measures::of(&moments, &[], Varies::Else), moments }
        };
        Watched { sequence: "a lamp, lost".to_owned(), runs: vec![run("finds", true), run("knows", false)] }
    }

    #[test]
    fn every_frame_has_its_row() {
        let csv = csv(&[watched(true)]);
        assert_eq!(csv.lines().count(), 1 + 8);
        assert_eq!(csv.lines().nth(2), Some("\"a lamp, lost\",finds,1.000,1,0.0000,0.5000,1.0000,2.0000,2.0000"));
        assert_eq!(csv.lines().nth(8), Some("\"a lamp, lost\",knows,3.000,0,,,1.0000,2.0000,2.0000"));
    }

    #[test]
    fn what_is_not_known_is_not_drawn() {
        let panels = |known| chart(&watched(known)).unwrap().matches("<svg ").count() - 1;
        assert_eq!((panels(true), panels(false)), (3, 2));
        let svg = chart(&watched(true)).unwrap();
        // Both are in the legend of each panel, and the truth where there is one.
        assert_eq!([">finds<", ">knows<", ">truth<"].map(|name| svg.matches(name).count()), [3, 3, 2]);
        assert_eq!(chart_name("a lamp, lost"), "lighting-stability-a-lamp-lost.svg");
    }
}
