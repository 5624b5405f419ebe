//! Accuracy against time, drawn, with the front of what nothing beats.

use anyhow::Result;

use super::exposure::Exposure;
use super::race::{Row, SWEPT};
use super::radiance_map::Half;
use super::report::Names;
use super::{opencv, three};
use crate::chart::{Axis, Chart, Mark, Scale, Series, pareto_front};
use crate::samples::percentile;

/// File of an exposure's chart.
pub(super) fn chart_name(exposure: Exposure) -> String {
    format!("lighting-accuracy-{}.svg", exposure.name())
}

/// Median time against median error of an exposure, both logarithmic, over the held-out half, or over everything where
/// nothing was held out. Sweeps are lines; the front is that of the server's own methods;
/// oracles, which take no time, are dashed lines at their error.
///
/// # Errors
/// When an error or a time is not positive.
pub(super) fn chart(rows: &[Row], exposure: Exposure) -> Result<String> {
    let held_out = rows.iter().any(|row| row.half == Half::HeldOut);
    let shown = |row: &&Row| row.exposure == exposure && (!held_out || row.half == Half::HeldOut);
    let names = Names::of(rows);
    let point = |name: &String| {
        let own: Vec<&Row> = rows.iter().filter(shown).filter(|row| row.method == *name).collect();
        let median = |f: fn(&Row) -> Option<f64>| percentile(&own.iter().filter_map(|row| f(row)).collect::<Vec<_>>(), 0.5);
        Some((median(|row| row.time_ms)?, median(|row| Some(row.score.absolute))? * 100.0))
    };
    let swept = |name: &String| SWEPT.iter().any(|swept| name.starts_with(swept));
    let mut series: Vec<Series> = Vec::new();
    for name in names.methods.iter().filter(|name| !swept(name)) {
        series.extend(point(name).map(|point| Series { name: name.clone(), points: vec![point], mark: Mark::Scatter }));
    }
    for name in SWEPT {
        let points: Vec<_> = names.sweeps.iter().filter(|sweep| sweep.starts_with(name)).filter_map(point).collect();
        if !points.is_empty() {
            series.push(Series { name: format!("{name}, 1 to 64"), points, mark: Mark::Line });
        }
    }
    let peers = [opencv::NAME, three::NAME];
    let points: Vec<_> =
        series.iter().filter(|series| !peers.contains(&series.name.as_str())).flat_map(|series| series.points.clone()).collect();
    let fastest = series.iter().flat_map(|series| &series.points).map(|point| point.0).fold(f64::INFINITY, f64::min);
    for name in &names.oracles {
        let errors: Vec<f64> = rows.iter().filter(shown).filter(|row| row.method == *name).map(|row| row.score.absolute * 100.0).collect();
        let points = percentile(&errors, 0.5).map(|error| (fastest, error));
        if let Some(point) = points.filter(|_| fastest.is_finite()) {
            series.push(Series { name: name.clone(), points: vec![point], mark: Mark::Bound });
        }
    }
    series.push(Series { name: "Pareto front".to_owned(), points: pareto_front(&points), mark: Mark::Front });
    let over = if held_out { "held-out panoramas" } else { "panoramas" };
    let chart = Chart {
        title: format!("{}: median over the {over}", exposure.title()),
        x: Axis { label: "time / ms".to_owned(), scale: Scale::Log },
        y: Axis { label: "irradiance error / %".to_owned(), scale: Scale::Log },
        series,
    };
    chart.svg()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::oracle::Oracle;
    use crate::lighting::report::overview;
    use crate::lighting::report::tests::{row, rows};

    #[test]
    fn the_chart_shows_the_held_out_half_and_the_front() {
        let svg = chart(&rows(), Exposure::Ldr(95)).unwrap();
        assert!(svg.contains("directional: 2, 12.5") && svg.contains("median-cut, 1 to 64: 1.5, 75") && svg.contains("Pareto front"));
        let tuned = chart(&rows()[..1], Exposure::Ldr(95)).unwrap();
        assert!(tuned.contains("directional: 2, 25"));
        assert!(chart(&rows(), Exposure::Hdr).unwrap_err().to_string().contains("no points"));
        assert!(overview(&rows()).contains("directional: median error - / - / 12.5 / - %"));
    }

    #[test]
    fn oracles_are_bounds_beside_the_front() {
        let mut rows = rows();
        let oracle = row(Oracle::Regions.name(), "b", Half::HeldOut, 0.01, 1.0);
        rows.push(Row { time_ms: None, ..oracle });
        let svg = chart(&rows, Exposure::Ldr(95)).unwrap();
        // Better than everything, and yet the front's first point is the fastest method.
        assert!(svg.contains("oracle:regions: 1") && svg.contains("Pareto front"));
        assert!(!svg.contains("oracle:total"));
    }
}
