//! What is asked of the default method, what it does, and, where it falls short, what the best possible method with the same input would do.

use std::fmt;

use mr360_server::lighting::MethodSpec;

use super::exposure::Exposure;
use super::oracle::Oracle;
use super::race::Row;
use super::radiance_map::Half;
use super::score::Dominant;
use crate::chart::number;
use crate::samples::{median, percentile};
use crate::table::Table;

/// What meets a bound.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Limit {
    AtMost(f64),
    AtLeast(f64),
}

impl Limit {
    /// Whether a figure does.
    pub(super) fn is_met_by(self, figure: f64) -> bool {
        match self {
            Self::AtMost(most) => figure <= most,
            Self::AtLeast(least) => figure >= least,
        }
    }
}

impl fmt::Display for Limit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::AtMost(most) => write!(f, "≤ {}", number(*most)),
            Self::AtLeast(least) => write!(f, "≥ {}", number(*least)),
        }
    }
}

/// What the best possible method with the same input reaches.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Best {
    /// Who it is: what it knows that a method does not.
    pub(super) name: String,
    /// What it reaches.
    pub(super) figure: f64,
}

/// A bound, and what was measured against it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Bound {
    /// What is bounded, with its unit.
    pub(super) what: String,
    /// By what.
    pub(super) limit: Limit,
    /// Over everything; none where there is nothing to measure.
    pub(super) all: Option<f64>,
    /// Over the half to tune on, and the half held out, of panoramas.
    pub(super) halves: [Option<f64>; 2],
    /// The least is what this is compared with.
    pub(super) best: Vec<Best>,
}

impl Bound {
    /// Whether it is met.
    pub(super) fn is_met(&self) -> bool {
        self.all.is_some_and(|figure| self.limit.is_met_by(figure))
    }

    /// The oracle that is nearest to what was measured, and the ratio of the worse to the better of the two.
    fn reached(&self) -> Option<(&Best, f64)> {
        let all = self.all?;
        let worse_by = |best: &Best| match self.limit {
            Limit::AtMost(_) => all / best.figure,
            Limit::AtLeast(_) => best.figure / all,
        };
        self.best.iter().map(|best| (best, worse_by(best))).min_by(|(_, a), (_, b)| a.total_cmp(b))
    }
}

/// A multiple from which on it is of nothing.
const MOST_TIMES: f64 = 1000.0;

/// All bounds, a row each.
pub(super) fn table(bounds: &[Bound]) -> Table {
    let head = [
        "what",
        "bound",
        "measured",
        "tuning half",
        "held-out half",
        "",
        "best possible with the same input",
        "this against the nearest of these",
    ];
    let mut table = Table::new(&head);
    let figure = |figure: Option<f64>| figure.map_or_else(|| "–".to_owned(), short);
    for bound in bounds {
        let best: Vec<String> = bound.best.iter().map(|best| format!("{}: {}", best.name, short(best.figure))).collect();
        // Of what is next to nothing, there is no multiple.
        let reached = bound.reached().filter(|(_, ratio)| *ratio < MOST_TIMES);
        table.push([
            bound.what.clone(),
            bound.limit.to_string(),
            bound.all.map_or_else(|| "nothing to measure".to_owned(), short),
            figure(bound.halves[0]),
            figure(bound.halves[1]),
            if bound.is_met() { "met".to_owned() } else { "**missed**".to_owned() },
            best.join("; "),
            reached.map_or_else(String::new, |(best, ratio)| format!("{} × {}", short(ratio), best.name)),
        ]);
    }
    table
}

/// Three digits are enough to compare by.
fn short(value: f64) -> String {
    if value.abs() >= 100.0 { format!("{value:.0}") } else { number((value * 1e3).round() / 1e3) }
}

/// The section at the head of the summary.
pub(super) fn markdown(bounds: &[Bound]) -> String {
    let missed = bounds.iter().filter(|bound| !bound.is_met()).count();
    format!(
        "## Bounds\n\nThe default method, `{}`, against what is asked of it, from what this run measured: {} of {} met. Oracles see the same frames and \
         are told what no frame holds; `{FEATURES}` is told nothing, but fitted to the very panoramas that it is judged by, which no method may be.\n\n{}",
        MethodSpec::default(),
        bounds.len() - missed,
        bounds.len(),
        table(bounds).markdown()
    )
}

/// For the terminal: what is missed.
pub(super) fn overview(bounds: &[Bound]) -> String {
    let line = |bound: &Bound| {
        let measured = bound.all.map_or_else(|| "nothing to measure".to_owned(), short);
        format!("lighting: missed: {}: {measured}, bound {}\n", bound.what, bound.limit)
    };
    bounds.iter().filter(|bound| !bound.is_met()).map(line).collect()
}

/// A regression on the default's own features, fitted to the panoramas that it is judged by.
pub(super) const FEATURES: &str = "oracle:features";

/// Errors of [`FEATURES`] on one panorama through one exposure.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fitted {
    /// File name without its ending.
    pub(super) panorama: String,
    /// How it was shown.
    pub(super) exposure: Exposure,
    /// As [`super::score::Score::absolute`].
    pub(super) absolute: f64,
    /// As [`super::score::Score::scale_invariant`].
    pub(super) scale_invariant: f64,
}

/// Which figure of a panorama is bounded.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Figure {
    Absolute,
    ScaleInvariant,
    Direction,
    DirectShare,
    Bytes,
}

impl Figure {
    fn title(self) -> &'static str {
        match self {
            Self::Absolute => "irradiance error, %",
            Self::ScaleInvariant => "irradiance error after the best single scale, %",
            Self::Direction => "direction of the dominant light, degrees",
            Self::DirectShare => "share of lights on level ground, error",
            Self::Bytes => "bytes of a frame's light",
        }
    }

    /// None where a panorama does not ask.
    fn of(self, row: &Row) -> Option<f64> {
        match self {
            Self::Absolute => Some(100.0 * row.score.absolute),
            Self::ScaleInvariant => Some(100.0 * row.score.scale_invariant),
            Self::Direction => match row.score.dominant {
                Dominant::Absent => None,
                // As wrong as can be.
                Dominant::NoLight => Some(180.0),
                Dominant::OffDeg(off) => Some(off),
            },
            Self::DirectShare => Some(row.score.direct.abs()),
            Self::Bytes => row.wire_bytes.map(|bytes| bytes as f64),
        }
    }

    fn of_fitted(self, fitted: &Fitted) -> Option<f64> {
        match self {
            Self::Absolute => Some(100.0 * fitted.absolute),
            Self::ScaleInvariant => Some(100.0 * fitted.scale_invariant),
            _ => None,
        }
    }
}

/// Which of the panoramas counts: the middle one, or the worst.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Over {
    Median,
    Worst,
}

const HDR: Exposure = Exposure::Hdr;
const AT_95: Exposure = Exposure::Ldr(95);
const AT_99: Exposure = Exposure::Ldr(99);

/// What is asked over panoramas.
const ASKED: [(Exposure, Figure, Over, f64); 16] = [
    (HDR, Figure::Absolute, Over::Median, 0.7),
    (HDR, Figure::Absolute, Over::Worst, 3.0),
    (AT_95, Figure::Absolute, Over::Median, 25.0),
    (AT_95, Figure::ScaleInvariant, Over::Median, 20.0),
    (AT_99, Figure::Absolute, Over::Median, 12.0),
    (AT_99, Figure::ScaleInvariant, Over::Median, 10.0),
    (HDR, Figure::Direction, Over::Median, 0.3),
    (HDR, Figure::Direction, Over::Worst, 2.0),
    (AT_99, Figure::Direction, Over::Median, 2.0),
    (AT_99, Figure::Direction, Over::Worst, 10.0),
    (AT_95, Figure::Direction, Over::Median, 4.0),
    (AT_95, Figure::Direction, Over::Worst, 15.0),
    (AT_95, Figure::DirectShare, Over::Median, 0.15),
    (HDR, Figure::Bytes, Over::Median, 150.0),
    (AT_99, Figure::Bytes, Over::Median, 150.0),
    (AT_95, Figure::Bytes, Over::Median, 150.0),
];

/// Who finds the dominant light of HDR by its definition.
const DEFINITION: &str = "the definition itself, of pixels 3 % off at random";

/// The bounds over panoramas, from the rows of the race, what was fitted to the same panoramas, and [`super::truth::Truth::restlessness_deg`] of those that have a
/// dominant light.
pub(super) fn of_accuracy(rows: &[Row], fitted: &[Fitted], restless_deg: &[f64]) -> Vec<Bound> {
    let default = MethodSpec::default().to_string();
    let bound = |(exposure, figure, over, most): &(Exposure, Figure, Over, f64)| {
        let middle = |values: Vec<f64>| if *over == Over::Median { median(&values) } else { percentile(&values, 1.0) };
        let of = |method: &str, half: Option<Half>| {
            let own =
                rows.iter().filter(|row| row.method == method && row.exposure == *exposure && half.is_none_or(|half| row.half == half));
            middle(own.filter_map(|row| figure.of(row)).collect())
        };
        let fitted = fitted.iter().filter(|fitted| fitted.exposure == *exposure).filter_map(|fitted| figure.of_fitted(fitted)).collect();
        let oracles = Oracle::ALL.iter().map(|oracle| (oracle.name(), of(oracle.name(), None)));
        let restless = Some(restless_deg.to_vec()).filter(|_| (*exposure, *figure) == (HDR, Figure::Direction)).and_then(middle);
        let named = oracles.chain([(FEATURES, middle(fitted))]).map(|(name, figure)| (format!("`{name}`"), figure));
        let best = std::iter::once((DEFINITION.to_owned(), restless)).chain(named);
        let over = if *over == Over::Median { "median" } else { "worst" };
        Bound {
            what: format!("{}: {}, {over}", exposure.title(), figure.title()),
            limit: Limit::AtMost(*most),
            all: of(&default, None),
            halves: Half::ALL.map(|half| of(&default, Some(half))),
            best: best.filter_map(|(name, figure)| Some(Best { name, figure: figure? })).collect(),
        }
    };
    ASKED.iter().map(bound).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::report::tests::{row, rows};

    #[test]
    fn halves_stand_apart_and_a_miss_is_held_against_the_nearest_oracle() {
        let mut rows = rows();
        rows.push(row("oracle:total", "b", Half::HeldOut, 0.05, 1.0));
        let fitted =
            |panorama: &str, absolute| Fitted { panorama: panorama.to_owned(), exposure: AT_95, absolute, scale_invariant: absolute / 4.0 };
        let bounds = of_accuracy(&rows, &[fitted("a", 0.1), fitted("b", 0.1)], &[0.5, 1.5]);
        assert_eq!(
            bounds.iter().find(|bound| bound.what == "HDR: direction of the dominant light, degrees, worst").unwrap().best[0].figure,
            1.5
        );
        assert_eq!(bounds.len(), ASKED.len());
        let of = |what: &str| bounds.iter().find(|bound| bound.what.contains(what)).unwrap();
        // 25 % of the tuning half, 50, 12.5 and 6.25 % of the other.
        let absolute = of("white at 95 %: irradiance error, %");
        assert_eq!((absolute.all, absolute.halves), (Some(18.75), [Some(25.0), Some(12.5)]));
        assert!(absolute.is_met() && absolute.reached().unwrap().0.name == "`oracle:features`", "{absolute:?}");
        assert!((absolute.reached().unwrap().1 - 1.875).abs() < 1e-9);
        // 25, 50, 12.5 and 6.25 degrees.
        let worst = of("white at 95 %: direction of the dominant light, degrees, worst");
        assert!(!worst.is_met() && worst.all == Some(50.0));
        assert_eq!(of("HDR: irradiance error, %, median").all, None);
        let text = markdown(&bounds);
        assert!(text.contains("| white at 95 %: irradiance error, %, median | ≤ 25 | 18.75 | 25 | 12.5 | met | `oracle:total`: 5; `oracle:features`: 10 | 1.875 × `oracle:features` |"), "{text}");
        assert!(text.contains("degrees, worst | ≤ 15 | 50 | 25 | 50 | **missed** |"), "{text}");
        assert!(
            overview(&bounds).contains("lighting: missed: white at 95 %: direction of the dominant light, degrees, worst: 50, bound ≤ 15")
        );
    }

    #[test]
    fn more_is_better_where_at_least_is_asked() {
        let best = vec![Best { name: "floor".to_owned(), figure: 24.0 }];
        let bound = Bound { what: "times as fast".to_owned(), limit: Limit::AtLeast(10.0), all: Some(8.0), halves: [None; 2], best };
        assert!(!bound.is_met() && bound.reached().unwrap().1 == 3.0);
        assert!(table(&[bound]).markdown().contains("| times as fast | ≥ 10 | 8 | – | – | **missed** | floor: 24 | 3 × floor |"));
    }
}
