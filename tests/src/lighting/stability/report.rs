//! What the sequences came to: tables and CSV.

use super::super::bounds::{Best, Bound, Limit};
use super::Watched;
use super::curves::chart_name;
use super::measures::Measures;
use crate::chart::number;
use crate::table::Table;

/// The still scene through the codec, among the sequences.
pub(super) const CODED: &str = "still, H.264 at 8 Mb/s";
/// The same under clouds near white.
pub(super) const BRIGHT: &str = "still under bright clouds, H.264 at 8 Mb/s";
/// The same over dark ground.
pub(super) const DARK: &str = "still over dark ground, H.264 at 8 Mb/s";
/// The real clip, among the sequences.
pub(super) const REAL: &str = "real clip";

/// A measure of a run; none where the sequence does not ask or nothing was shown.
type Figure = fn(&Measures) -> Option<f64>;

/// A column of the CSV, and its table's title where it has one.
struct Column {
    name: &'static str,
    of: Figure,
    table: Option<&'static str>,
    /// The same of the truth, beside it in the table.
    truth: Option<Figure>,
}

const fn column(name: &'static str, of: Figure, table: Option<&'static str>) -> Column {
    Column { name, of, table, truth: None }
}

impl Column {
    const fn beside(self, truth: Figure) -> Self {
        Self { truth: Some(truth), ..self }
    }
}

fn percent(share: Option<f64>) -> Option<f64> {
    share.map(|share| 100.0 * share)
}

fn ms(seconds: Option<f64>) -> Option<f64> {
    seconds.map(|seconds| 1e3 * seconds)
}

/// All measures.
static COLUMNS: [Column; 20] = [
    column("found_percent", |m| percent(m.found), Some("Frames in which a light is within 10° of the true main light, %:")),
    column(
        "invented_percent",
        |m| percent(m.invented),
        Some("Frames without a true main light for which lights are sent all the same, %:"),
    ),
    column("off_rms_deg", |m| m.off_rms_deg, Some("Main light off the true one, RMS in degrees:")),
    column("off_worst_deg", |m| m.off_worst_deg, Some("Main light off the true one, worst frame in degrees:")),
    column("wander_rms_deg", |m| m.wander_rms_deg, Some("Main light about its own mean error, RMS in degrees:")),
    column(
        "turn_worst_deg",
        |m| m.turn_worst_deg,
        Some("Largest move of the main light between two frames beyond the true one's, degrees:"),
    ),
    column(
        "strength_variation_percent",
        |m| percent(m.strength_variation),
        Some("Variation of the main light's strength, standard deviation over mean of estimate over truth in %:"),
    ),
    column("level_variation_percent", |m| percent(Some(m.level_variation)), Some("The same of all that level ground receives, %:")),
    column("events_per_s", |m| Some(m.events_per_s), Some("Births and deaths a second:")).beside(|m| m.true_events_per_s),
    column("true_events_per_s", |m| m.true_events_per_s, None),
    column(
        "lag_ms",
        |m| ms(m.lag_s),
        Some("Lag to a step, ms until all that surfaces receive is within 5 % of where it settles (longest of the sequence's steps):"),
    ),
    column(
        "jump_percent",
        |m| percent(Some(m.jump)),
        Some("Largest change between two frames of what a surface receives, % of the most that one receives:"),
    )
    .beside(|m| percent(m.true_jump)),
    column("true_jump_percent", |m| percent(m.true_jump), None),
    column("ripple", |m| m.ripple, Some("Ripple of level ground under beating lamps, over the truth's:")),
    column("light_ripple", |m| m.light_ripple, Some("Ripple of the main light under beating lamps, over the truth's:")),
    column(
        "ratio_drift_percent",
        |m| percent(m.ratio_drift),
        Some("Largest drift of the ratio of main light to ambient while the exposure moves, %:"),
    ),
    column("strength_first", |m| m.strength_first, Some("Main light's strength over the truth's, median of the first second:")),
    column("strength_last", |m| m.strength_last, Some("The same of the last second:")),
    column("strength_least", |m| m.strength_least, Some("The same of all frames in which the truth's is within 5 % of its least:")),
    column("known_ripple", |m| m.known_ripple, None),
];

/// What the best possible method with the same input reaches, where it is measured: figure, who that is, and what it reaches.
static BEST: [(&str, &str, Figure); 3] = [
    ("ripple", "a mean over the beat's period, known beforehand", |m| m.known_ripple),
    ("light_ripple", "a mean over the beat's period, known beforehand", |m| m.known_ripple),
    ("strength_last", "the same light while it is not clipped, of which μ + 2σ stays in the harmonics", |m| m.strength_least),
];

fn best(figure: &str, measures: &Measures) -> Vec<Best> {
    let of = BEST.iter().filter(|(name, ..)| *name == figure);
    of.filter_map(|(_, who, of)| Some(Best { name: (*who).to_owned(), figure: of(measures)? })).collect()
}

/// One row a sequence and method.
pub(super) fn csv(all: &[Watched]) -> String {
    let names: Vec<&str> = ["sequence", "method"].into_iter().chain(COLUMNS.iter().map(|column| column.name)).collect();
    let mut table = Table::new(&names);
    for watched in all {
        for run in &watched.runs {
            let cells = COLUMNS.iter().map(|column| (column.of)(&run.measures).map(|value| format!("{value:.4}")).unwrap_or_default());
            table.push([watched.sequence.clone(), run.method.clone()].into_iter().chain(cells));
        }
    }
    table.csv()
}

/// What is asked of the default method.
struct Asked {
    what: &'static str,
    sequences: &'static [&'static str],
    figure: &'static str,
    limit: Limit,
}

const fn bound(what: &'static str, sequences: &'static [&'static str], figure: &'static str, most: f64) -> Asked {
    Asked { what, sequences, figure, limit: Limit::AtMost(most) }
}

const fn at_least(what: &'static str, sequences: &'static [&'static str], figure: &'static str, least: f64) -> Asked {
    Asked { what, sequences, figure, limit: Limit::AtLeast(least) }
}

const STILL: &[&str] = &["still", CODED, BRIGHT, DARK];
const PATHS: &[&str] = &["over the seam", "over the zenith"];
const SHARES: &[&str] = &["clipped share", "clipped clouds"];
const OVERCAST: &[&str] = &["overcast", "even overcast"];
const SEEN: &[&str] = &["exposure seen", "exposure seen at once"];
const BEATS: &[&str] = &["lamp beat", "one lamp beats"];
/// Two frames at 30 a second.
const TWO_FRAMES_MS: f64 = 66.7;

/// What the default method is held to.
static BOUNDS: [Asked; 18] = [
    bound("still scene: direction about its mean, degrees RMS", STILL, "wander_rms_deg", 0.1),
    bound("still scene: variation of the light, %", STILL, "strength_variation_percent", 1.0),
    at_least("still scene: frames in which the light is found, %", STILL, "found_percent", 100.0),
    bound("still scene: births and deaths a second", STILL, "events_per_s", 0.0),
    bound("scene cut: light off in any frame, degrees", &["scene cut"], "off_worst_deg", 2.0),
    bound("scene cut: settled after, ms", &["scene cut"], "lag_ms", TWO_FRAMES_MS),
    bound("lamp beat 50 Hz at 30 frames/s: ripple of level ground", BEATS, "ripple", 0.1),
    bound("lamp beat 50 Hz at 30 frames/s: ripple of the light", BEATS, "light_ripple", 0.1),
    bound("lamp beat 60 Hz at 25 frames/s: ripple of level ground", &["lamp beat, 60 Hz"], "ripple", 0.1),
    bound("exposure ramp 1 EV/s: drift of light to ambient, %", &["exposure ramp, linear", "exposure ramp"], "ratio_drift_percent", 5.0),
    bound("sun over seam and zenith: off in any frame, degrees", PATHS, "off_worst_deg", 0.5),
    bound("sun over seam and zenith: births and deaths a second", PATHS, "events_per_s", 0.0),
    at_least("clipped share 0.05 to 0.6: frames in which the light is found, %", SHARES, "found_percent", 100.0),
    bound("overcast with noise: frames with a light, %", OVERCAST, "invented_percent", 0.0),
    bound("faulty frame: largest change between two frames, %", &["faulty frame"], "jump_percent", 2.0),
    bound("clipped lamp after it was seen unclipped: strength over the truth's", SEEN, "strength_last", 1.1),
    at_least("clipped lamp after it was seen unclipped: strength over the truth's", SEEN, "strength_last", 0.9),
    bound("camera shake: births and deaths a second", &["shake"], "events_per_s", 0.0),
];

/// The default method against its bounds, sequence by sequence.
pub(super) fn bounds(all: &[Watched]) -> Vec<Bound> {
    let mut bounds = Vec::new();
    for asked in &BOUNDS {
        for sequence in asked.sequences {
            let Some(run) = all.iter().find(|watched| watched.sequence == *sequence).and_then(|watched| watched.runs.first()) else {
                continue;
            };
            bounds.push(Bound {
                what: format!("{} ({sequence})", asked.what),
                limit: asked.limit,
                all: COLUMNS.iter().find(|column| column.name == asked.figure).and_then(|column| (column.of)(&run.measures)),
                halves: [None; 2],
                best: best(asked.figure, &run.measures),
            });
        }
    }
    bounds
}

/// A row a sequence, a column a method, and one for the truth where that has such a figure.
fn by_sequence(all: &[Watched], column: &Column) -> Table {
    let methods = all.first().into_iter().flat_map(|watched| watched.runs.iter().map(|run| run.method.as_str()));
    let mut table = Table::new(&["sequence"].into_iter().chain(methods).chain(column.truth.map(|_| "truth")).collect::<Vec<_>>());
    for watched in all {
        let mut figures: Vec<Option<f64>> = watched.runs.iter().map(|run| (column.of)(&run.measures)).collect();
        figures.extend(column.truth.map(|truth| watched.runs.first().and_then(|run| truth(&run.measures))));
        if figures.iter().any(Option::is_some) {
            let cells = figures.into_iter().map(|value| value.map_or_else(|| "–".to_owned(), short));
            table.push([watched.sequence.clone()].into_iter().chain(cells));
        }
    }
    table
}

/// Three digits are enough to compare by.
fn short(value: f64) -> String {
    if value.abs() >= 100.0 { format!("{value:.0}") } else { number((value * 1e3).round() / 1e3) }
}

/// All tables as Markdown.
pub(super) fn markdown(all: &[Watched]) -> String {
    let mut text =
        "## Stability\n\nSequences of 256×128 pixels with known light (`mr360_server::lighting::sequences`), still scenes of 1920×960 with sensor noise through H.264 at \
         8 Mbit/s and the server's decoder, and the real clip, of which no truth is known. The main light of an estimate is its strongest with all others within 10° \
         of it. A dash: the method sends no light, or the sequence does not ask.\n"
            .to_owned();
    for (column, title) in COLUMNS.iter().filter_map(|column| column.table.map(|title| (column, title))) {
        text += &format!("\n{title}\n\n{}", by_sequence(all, column).markdown());
    }
    text += "\nOver time:\n\n";
    for watched in all {
        text += &format!("![{}]({})\n", watched.sequence, chart_name(&watched.sequence));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::Run;
    use super::*;

    fn watched(sequence: &str, measures: Measures) -> Watched {
        let run = |method: &str, measures| Run { method: method.to_owned(), moments: Vec::new(), measures };
        Watched { sequence: sequence.to_owned(), runs: vec![run("directional", measures), run("sh:9", Measures::default())] }
    }

    #[test]
    fn bounds_name_what_is_missed() {
        let still = Measures { found: Some(1.0), wander_rms_deg: Some(0.05), strength_variation: Some(0.02), ..Measures::default() };
        let share = Measures { found: Some(0.99), ..Measures::default() };
        let all = [watched("still", still), watched("clipped share", share), watched("overcast", Measures::default())];
        let bounds = bounds(&all);
        let of = |what: &str| bounds.iter().find(|bound| bound.what.contains(what)).unwrap();
        assert!(of("degrees RMS (still)").is_met() && of("degrees RMS (still)").all == Some(0.05), "{bounds:?}");
        assert!(!of("variation of the light, % (still)").is_met() && of("variation of the light, % (still)").all == Some(2.0));
        assert!(!of("found, % (clipped share)").is_met() && !of("(overcast)").is_met() && of("(overcast)").all.is_none());
        assert_eq!(bounds.iter().filter(|bound| !bound.is_met()).count(), 3);
        assert!(BOUNDS.iter().all(|bound| COLUMNS.iter().any(|column| column.name == bound.figure)));
        let known: Vec<&str> =
            mr360_server::lighting::sequences::all().iter().map(|sequence| sequence.name).chain([CODED, BRIGHT, DARK, REAL]).collect();
        assert!(BOUNDS.iter().flat_map(|bound| bound.sequences).all(|sequence| known.contains(sequence)));
        // Every chart has a file of its own.
        let mut files: Vec<String> = known.iter().map(|name| chart_name(name)).collect();
        files.sort_unstable();
        files.dedup();
        assert_eq!((files.len(), chart_name(CODED).as_str()), (known.len(), "lighting-stability-still-h-264-at-8-mb-s.svg"));
    }

    #[test]
    fn tables_hold_sequences_that_ask() {
        let all = [watched("still", Measures { lag_s: Some(0.1), ..Measures::default() }), watched("shake", Measures::default())];
        let table = |name: &str| by_sequence(&all, COLUMNS.iter().find(|column| column.name == name).unwrap()).csv();
        assert_eq!(table("lag_ms"), "sequence,directional,sh:9\nstill,100,–\n");
        assert_eq!(table("events_per_s"), "sequence,directional,sh:9,truth\nstill,0,0,–\nshake,0,0,–\n");
        let csv = csv(&all);
        assert!(csv.starts_with("sequence,method,found_percent,") && csv.lines().count() == 5, "{csv}");
        assert!(markdown(&all).contains("| still | 100 | – |"));
    }
}
