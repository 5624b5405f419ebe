//! What the race came to: tables and CSV.

use super::exposure::Exposure;
use super::fronts::chart_name;
use super::oracle::Oracle;
use super::race::{Row, SWEPT, SWEPT_LIGHTS};
use super::radiance_map::Half;
use super::rendered::Object;
use super::score::Dominant;
use super::speed::cores;
use crate::chart::number;
use crate::samples::percentile;
use crate::table::Table;

/// Columns of the CSV before those of the rendered pictures.
const HEAD: [&str; 15] = [
    "method",
    "panorama",
    "half",
    "exposure",
    "absolute",
    "scale_invariant",
    "colour_deg",
    "dominant",
    "dominant_off_deg",
    "direct_error",
    "lights",
    "wire_bytes",
    "wire_error",
    "time_ms",
    "time_over_mr360",
];

/// One row a method, panorama and exposure. `dominant_off_deg` is empty where there is no dominant light or the method says
/// of no light; `dominant` tells which.
pub(super) fn csv(rows: &[Row]) -> String {
    let mut head: Vec<String> = HEAD.map(str::to_owned).to_vec();
    for object in Object::ALL {
        head.extend(["rmse", "scale_invariant_rmse"].map(|error| format!("{}_{error}", object.name())));
    }
    let mut table = Table::new(&head.iter().map(String::as_str).collect::<Vec<_>>());
    for row in rows {
        let score = &row.score;
        let (dominant, off) = match score.dominant {
            Dominant::Absent => ("absent", String::new()),
            Dominant::NoLight => ("no light", String::new()),
            Dominant::OffDeg(off) => ("found", format!("{off:.3}")),
        };
        let cells = [
            row.method.clone(),
            row.panorama.clone(),
            row.half.name().to_owned(),
            row.exposure.name(),
            format!("{:.5}", score.absolute),
            format!("{:.5}", score.scale_invariant),
            format!("{:.3}", score.colour_deg),
            dominant.to_owned(),
            off,
            format!("{:.4}", score.direct),
            row.lights.map(|lights| lights.to_string()).unwrap_or_default(),
            row.wire_bytes.map(|bytes| bytes.to_string()).unwrap_or_default(),
            row.quantisation.map(|error| format!("{error:.6}")).unwrap_or_default(),
            row.time_ms.map(|time| format!("{time:.4}")).unwrap_or_default(),
            row.time_ratio.map(|ratio| format!("{ratio:.3}")).unwrap_or_default(),
        ];
        let rendered = row.rendered.iter().flat_map(|error| [error.0, error.1]).map(|error| format!("{error:.5}"));
        table.push(cells.into_iter().chain(rendered));
    }
    table.csv()
}

/// Names of the methods in the order in which they were raced, sweeps and oracles apart.
pub(super) struct Names {
    /// Methods and peers.
    pub(super) methods: Vec<String>,
    /// Methods by their number of lights.
    pub(super) sweeps: Vec<String>,
    /// An oracle, in its place among those that the rows hold.
    pub(super) oracles: Vec<String>,
}

impl Names {
    /// Of these rows.
    pub(super) fn of(rows: &[Row]) -> Self {
        let swept = || SWEPT.iter().flat_map(|name| SWEPT_LIGHTS.iter().map(move |lights| format!("{name}:{lights}")));
        let mut names: Vec<String> = Vec::new();
        for row in rows {
            if !names.contains(&row.method) {
                names.push(row.method.clone());
            }
        }
        let default = |name: &String| mr360_server::lighting::MethodSpec::all().any(|spec| spec.to_string() == *name);
        let sweeps = swept().filter(|name| names.contains(name)).collect();
        let (oracles, names): (Vec<_>, Vec<_>) = names.into_iter().partition(|name| Oracle::ALL.iter().any(|oracle| oracle.name() == name));
        let methods = names.into_iter().filter(|name| default(name) || !swept().any(|swept| swept == *name)).collect();
        Self { methods, sweeps, oracles }
    }
}

/// Median and largest of some values, written by `format`; empty without values.
pub(super) fn spread(values: &[f64], format: impl Fn(f64) -> String) -> String {
    match (percentile(values, 0.5), percentile(values, 1.0)) {
        (Some(median), Some(worst)) => format!("{} ({})", format(median), format(worst)),
        _ => String::new(),
    }
}

/// A share in per cent, with a digit after the point below 10 %.
pub(super) fn per_cent(value: f64) -> String {
    let value = value * 100.0;
    if value < 10.0 { format!("{value:.1}") } else { format!("{value:.0}") }
}

/// A row for each name, a column for each exposure, each cell what `cell` makes of the rows that meet there.
fn by_exposure(rows: &[Row], names: &[String], cell: impl Fn(&[&Row]) -> String) -> Table {
    let head: Vec<String> = std::iter::once("method".to_owned()).chain(Exposure::ALL.iter().map(|exposure| exposure.title())).collect();
    let mut table = Table::new(&head.iter().map(String::as_str).collect::<Vec<_>>());
    for name in names {
        let cells = Exposure::ALL.iter().map(|exposure| {
            let met: Vec<&Row> = rows.iter().filter(|row| row.method == *name && row.exposure == *exposure).collect();
            if met.is_empty() { "–".to_owned() } else { cell(&met) }
        });
        table.push(std::iter::once(name.clone()).chain(cells));
    }
    table
}

fn errors(rows: &[&Row]) -> String {
    let of = |f: fn(&Row) -> f64| spread(&rows.iter().map(|row| f(row)).collect::<Vec<_>>(), per_cent);
    format!("{} / {}", of(|row| row.score.absolute), of(|row| row.score.scale_invariant))
}

/// Errors of one of the pictures, by its place in [`Object::ALL`].
fn rendered(picture: usize) -> impl Fn(&[&Row]) -> String {
    move |rows| {
        let of = |f: fn((f64, f64)) -> f64| spread(&rows.iter().map(|row| f(row.rendered[picture])).collect::<Vec<_>>(), per_cent);
        format!("{} / {}", of(|error| error.0), of(|error| error.1))
    }
}

fn dominant(rows: &[&Row]) -> String {
    directions(&rows.iter().map(|row| row.score.dominant).collect::<Vec<_>>())
}

/// Median and largest angle to the dominant light, and how often it was missed.
pub(super) fn directions(met: &[Dominant]) -> String {
    let off: Vec<f64> = met.iter().filter_map(|met| if let Dominant::OffDeg(off) = met { Some(*off) } else { None }).collect();
    let missed = met.iter().filter(|met| **met == Dominant::NoLight).count();
    match (off.len() + missed, off.is_empty()) {
        (0, _) => "–".to_owned(),
        (_, true) => "no light".to_owned(),
        (all, false) => {
            let spread = spread(&off, |off| format!("{off:.1}°"));
            if missed == 0 { spread } else { format!("{spread}, none on {missed} of {all}") }
        }
    }
}

fn median_and_worst(f: fn(&Row) -> Option<f64>, digits: usize) -> impl Fn(&[&Row]) -> String {
    move |rows| spread(&rows.iter().filter_map(|row| f(row)).collect::<Vec<_>>(), |value| format!("{value:.digits$}"))
}

fn bytes(rows: &[&Row]) -> String {
    let sent: Vec<f64> = rows.iter().filter_map(|row| row.wire_bytes.map(|bytes| bytes as f64)).collect();
    let unsent = rows.len() - sent.len();
    let spread = spread(&sent, |bytes| format!("{bytes:.0}"));
    if unsent == 0 { spread } else { format!("{spread}, {unsent} beyond the wire's range") }
}

/// All tables as Markdown. `peers` says what became of the peers, `rounds` how often every frame was timed.
pub(super) fn markdown(rows: &[Row], peers: &str, rounds: u32) -> String {
    let names = Names::of(rows);
    let mut text = format!(
        "## Accuracy\n\nEvery cell is median (worst) over the panoramas of its half: even places of the alphabetical order to tune on, odd places \
         held out. Each panorama is given as it is (HDR), and as 8-bit sRGB whose white is a percentile of its luminance; what is true is the HDR \
         panorama at the same scale. {peers}\n\nOracles are no methods: they are told the true energy of what is clipped, channel by \
         channel, and spread it evenly over all clipped pixels (`{}`) or over those of each connected region (`{}`); their irradiance is summed over \
         every pixel.\n",
        Oracle::Total.name(),
        Oracle::Regions.name(),
    );
    for half in Half::ALL {
        let own: Vec<Row> = rows.iter().filter(|row| row.half == half).cloned().collect();
        if !own.is_empty() {
            text += &accuracy(&own, &names, half);
        }
    }
    text += &cost(rows, &names, rounds);
    text += "\n";
    for exposure in Exposure::ALL {
        text += &format!("![{}]({})\n", exposure.title(), chart_name(exposure));
    }
    text
}

fn section(title: &str, table: &Table) -> String {
    format!("\n{title}\n\n{}", table.markdown())
}

/// Errors over one half.
fn accuracy(rows: &[Row], names: &Names, half: Half) -> String {
    let mut panoramas: Vec<&str> = rows.iter().map(|row| row.panorama.as_str()).collect();
    panoramas.dedup();
    let shown: Vec<String> = names.methods.iter().chain(&names.oracles).cloned().collect();
    let methods = |title: &str, cell: &dyn Fn(&[&Row]) -> String| section(title, &by_exposure(rows, &shown, cell));
    let mut text = format!("\n### {}: {}\n", if half == Half::Tune { "Tune" } else { "Held out" }, panoramas.join(", "));
    text += &methods("Irradiance error in %, absolute / after the best single scale:", &errors);
    text += &methods("Direction of the dominant light:", &dominant);
    let direct = median_and_worst(|row| Some(row.score.direct.abs()), 2);
    text += &methods("Error of the lights' share of the irradiance on level ground:", &direct);
    let colour = median_and_worst(|row| Some(row.score.colour_deg), 1);
    text += &methods("Angle between the colours of the irradiance, degrees:", &colour);
    for (picture, object) in Object::ALL.iter().enumerate() {
        let title = format!("Rendered, {}: RMSE over the mean in %, as it is / after the best single scale:", object.title());
        text += &methods(&title, &rendered(picture));
    }
    let swept = "Number of lights swept, irradiance error in %, absolute / after the best single scale:";
    text + &section(swept, &by_exposure(rows, &names.sweeps, errors))
}

/// Time and size over both halves.
fn cost(rows: &[Row], names: &Names, rounds: u32) -> String {
    let further = names.sweeps.iter().filter(|name| !names.methods.contains(name));
    let all: Vec<String> = names.methods.iter().chain(further).cloned().collect();
    let clock = format!(
        "Time in ms: one thread, median of {rounds} rounds after a warm-up, all methods in turn, {}. OpenCV reads 8-bit \
         codes, the methods the same codes as floats:",
        cores()
    );
    let mut text = "\n### Cost, over both halves\n".to_owned();
    text += &section(&clock, &by_exposure(rows, &all, median_and_worst(|row| row.time_ms, 2)));
    text += &section("Time over that of `mr360` on the same frame:", &by_exposure(rows, &all, median_and_worst(|row| row.time_ratio, 2)));
    text += &section(
        "Number of lights:",
        &by_exposure(rows, &names.methods, median_and_worst(|row| row.lights.map(|lights| lights as f64), 0)),
    );
    text += &section("Bytes of a frame's light on the wire:", &by_exposure(rows, &all, bytes));
    let wire = "Error of the wire's quantisation: irradiance of the light received against that of the light sent, absolute, in %:";
    text + &section(wire, &by_exposure(rows, &all, median_and_worst(|row| row.quantisation.map(|error| error * 100.0), 3)))
}

/// One line a method for the terminal: median errors over everything that was measured, exposure by exposure.
pub(super) fn overview(rows: &[Row]) -> String {
    let names = Names::of(rows).methods;
    let line = |name: &String| {
        let cells = Exposure::ALL.iter().map(|exposure| {
            let own: Vec<f64> =
                rows.iter().filter(|row| row.method == *name && row.exposure == *exposure).map(|row| row.score.absolute * 100.0).collect();
            percentile(&own, 0.5).map_or_else(|| "-".to_owned(), number)
        });
        format!("lighting: {name}: median error {} %\n", cells.collect::<Vec<_>>().join(" / "))
    };
    names.iter().map(line).collect()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::lighting::score::Score;

    pub(in super::super) fn row(method: &str, panorama: &str, half: Half, error: f64, time_ms: f64) -> Row {
        let score = Score {
            absolute: error,
            scale_invariant: error / 2.0,
            colour_deg: 3.0,
            dominant: Dominant::OffDeg(error * 100.0),
            direct: -0.25,
        };
        Row {
            method: method.to_owned(),
            panorama: panorama.to_owned(),
            half,
            exposure: Exposure::Ldr(95),
            score,
            rendered: [(error, error / 2.0); 4],
            lights: Some(2),
            wire_bytes: Some(100),
            quantisation: Some(0.00025),
            time_ms: Some(time_ms),
            time_ratio: Some(time_ms / 4.0),
        }
    }

    pub(in super::super) fn rows() -> Vec<Row> {
        vec![
            row("directional", "a", Half::Tune, 0.25, 2.0),
            row("directional", "b", Half::HeldOut, 0.5, 2.0),
            row("directional", "c", Half::HeldOut, 0.125, 2.0),
            row("directional", "d", Half::HeldOut, 0.0625, 2.0),
            row("median-cut:16", "b", Half::HeldOut, 0.03125, 1.0),
            row("median-cut:4", "b", Half::HeldOut, 0.75, 1.5),
        ]
    }

    #[test]
    fn halves_are_told_apart_and_sweeps_from_methods() {
        let text = markdown(&rows(), "No peer.", 3);
        let (tune, held_out) = text.split_once("### Held out: b, c, d").unwrap();
        assert!(tune.contains("### Tune: a") && tune.contains("| directional | – | – | 25 (25) / 12 (12) | – |"), "{tune}");
        assert!(held_out.contains("| directional | – | – | 12 (50) / 6.2 (25) | – |"), "{held_out}");
        assert!(held_out.contains("| directional | – | – | 12.5° (50.0°) | – |") && held_out.contains("0.25 (0.25)"));
        // 16 is the default and among the methods too, 4 only in the sweep: of the half's nine tables, one.
        let count = |name: &str| held_out.split("### Cost").next().unwrap().matches(name).count();
        assert_eq!((count("| median-cut:16 "), count("| median-cut:4 ")), (9, 1));
        assert!(text.contains("No peer.") && text.contains("lighting-accuracy-ldr95.svg") && text.contains("| 0.025 (0.025) |"));
    }

    #[test]
    fn oracles_have_errors_and_no_cost() {
        let mut rows = rows();
        let oracle = row(Oracle::Total.name(), "b", Half::HeldOut, 0.0625, 1.0);
        rows.push(Row { lights: None, wire_bytes: None, quantisation: None, time_ms: None, time_ratio: None, ..oracle });
        let (errors, cost) = markdown(&rows, "", 3).split_once("### Cost").map(|(a, b)| (a.to_owned(), b.to_owned())).unwrap();
        assert!(errors.contains("| oracle:total | – | – | 6.2 (6.2) / 3.1 (3.1) | – |") && !cost.contains("oracle:"));
        assert!(csv(&rows).contains("oracle:total,b,held out,ldr95,0.06250,0.03125,3.000,found,6.250,-0.2500,,,,,,0.06250"));
    }

    #[test]
    fn lights_that_were_missed_and_messages_that_cannot_be_sent_are_counted() {
        let mut rows = rows();
        rows[2].score.dominant = Dominant::NoLight;
        rows[3].score.dominant = Dominant::Absent;
        rows[3].wire_bytes = None;
        let own: Vec<&Row> = rows[1..4].iter().collect();
        assert_eq!(dominant(&own), "50.0° (50.0°), none on 1 of 2");
        assert_eq!((dominant(&own[1..2]), dominant(&own[2..])), ("no light".to_owned(), "–".to_owned()));
        assert_eq!(bytes(&own), "100 (100), 1 beyond the wire's range");
        let csv = csv(&rows);
        assert_eq!(
            csv.lines().nth(1),
            Some(
                "directional,a,tune,ldr95,0.25000,0.12500,3.000,found,25.000,-0.2500,2,100,0.000250,2.0000,0.500,0.25000,0.12500,0.25000,0.12500,0.25000,0.12500,0.25000,0.12500"
            )
        );
        assert!(csv.lines().nth(3).unwrap().contains(",no light,,") && csv.lines().nth(4).unwrap().contains(",absent,,"));
    }
}
