//! Line and scatter charts with linear or logarithmic axes, as SVG.

use anyhow::{Result, ensure};

use crate::svg::{self, Anchor, Svg};

/// Colours that stay apart for colour-blind readers too (Okabe & Ito 2008; the last ones Tol 2021).
const COLOURS: [&str; 12] =
    ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#f0e442", "#999933", "#882255", "#44aa99", "#aa4499"];
/// Of [`Mark::Front`].
const FRONT: &str = "#888";
const SIZE: (f64, f64) = (760.0, 420.0);
/// Left, top, right, bottom; the right one holds the legend.
const MARGIN: (f64, f64, f64, f64) = (76.0, 44.0, 190.0, 56.0);
const FONT: f64 = 12.0;

/// How values become lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// Even steps; the axis includes zero.
    Linear,
    /// Even factors; values must be positive.
    Log,
}

/// An axis.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Axis {
    /// What is measured, with its unit.
    pub label: String,
    /// How values become lengths.
    pub scale: Scale,
}

/// How points are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    /// Dots joined in the order given.
    Line,
    /// Dots alone.
    Scatter,
    /// Grey dashes in the order given, in steps: right, then up or down. For the front of points that other series draw.
    Front,
    /// Joined in the order given, without dots; a point whose y is no number lifts the pen. For many points.
    Curve,
    /// The same in grey dashes: what curves are to be held against.
    Reference,
    /// A dashed line across the whole chart at the height of each point, with an empty dot at its left end. For bounds, which have no x of their
    /// own: that of the points is not drawn, but has to lie within the chart.
    Bound,
}

/// Points that belong together.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// x and y.
    pub points: Vec<(f64, f64)>,
    /// How they are drawn.
    pub mark: Mark,
}

/// A chart.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    /// Above it.
    pub title: String,
    /// To the right.
    pub x: Axis,
    /// Upwards.
    pub y: Axis,
    /// In the order of the legend.
    pub series: Vec<Series>,
}

impl Series {
    /// The points that are drawn.
    fn drawn(&self) -> impl Iterator<Item = &(f64, f64)> {
        let lifts = matches!(self.mark, Mark::Curve | Mark::Reference);
        self.points.iter().filter(move |(_, y)| !(lifts && y.is_nan()))
    }

    /// What is drawn without lifting the pen.
    fn strokes(&self) -> impl Iterator<Item = &[(f64, f64)]> {
        self.points.split(|(_, y)| y.is_nan()).filter(|stroke| !stroke.is_empty())
    }
}

/// Draws charts one below the other into one document.
///
/// # Errors
/// As [`Chart::svg`].
pub fn stack(charts: &[Chart]) -> Result<String> {
    let charts = charts.iter().map(Chart::svg).collect::<Result<Vec<_>>>()?;
    Ok(svg::stack(&charts, SIZE))
}

impl Chart {
    /// Draws it.
    ///
    /// # Errors
    /// When there is no point, a value is not finite, or one on a logarithmic axis is not positive.
    pub fn svg(&self) -> Result<String> {
        let all = || self.series.iter().flat_map(Series::drawn);
        let (left, top, right, bottom) = MARGIN;
        let x = Ruler::new(&self.x, all().map(|p| p.0), (left, SIZE.0 - right), &self.title)?;
        let y = Ruler::new(&self.y, all().map(|p| p.1), (SIZE.1 - bottom, top), &self.title)?;
        let mut svg = Svg::new(SIZE.0, SIZE.1);
        svg.text((left, top - 18.0), Anchor::Start, FONT + 3.0, 0.0, &self.title);
        x.draw_across(&mut svg, &self.x.label, y.pixels);
        y.draw_up(&mut svg, &self.y.label, &x);
        for (at, (series, colour)) in self.series.iter().zip(COLOURS.iter().cycle()).enumerate() {
            let place = |points: &[(f64, f64)]| points.iter().map(|(vx, vy)| (x.place(*vx), y.place(*vy))).collect::<Vec<_>>();
            let points = place(&series.points);
            let row = top + 10.0 + at as f64 * (FONT + 8.0);
            svg.text((SIZE.0 - right + 32.0, row), Anchor::Start, FONT, 0.0, &series.name);
            let sample = [(SIZE.0 - right + 12.0, row - 4.0), (SIZE.0 - right + 28.0, row - 4.0)];
            match series.mark {
                Mark::Line => svg.polyline(&points, colour, 2.0),
                Mark::Scatter => {}
                Mark::Front => {
                    svg.dashes(&steps(&points), FRONT, 1.5);
                    svg.dashes(&sample, FRONT, 1.5);
                    continue;
                }
                Mark::Curve => {
                    series.strokes().for_each(|stroke| svg.polyline(&place(stroke), colour, 1.2));
                    svg.polyline(&sample, colour, 3.0);
                    continue;
                }
                Mark::Reference => {
                    series.strokes().for_each(|stroke| svg.dashes(&place(stroke), FRONT, 1.5));
                    svg.dashes(&sample, FRONT, 1.5);
                    continue;
                }
                Mark::Bound => {
                    for ((_, height), (_, value)) in points.iter().zip(&series.points) {
                        svg.dashes(&[(left, *height), (SIZE.0 - right, *height)], colour, 1.5);
                        svg.ring((left, *height), 3.5, colour, &format!("{}: {}", series.name, number(*value)));
                    }
                    svg.dashes(&sample, colour, 1.5);
                    svg.ring((SIZE.0 - right + 20.0, row - 4.0), 5.0, colour, &series.name);
                    continue;
                }
            }
            for (place, (vx, vy)) in points.iter().zip(&series.points) {
                svg.dot(*place, 3.5, colour, &format!("{}: {}, {}", series.name, number(*vx), number(*vy)));
            }
            svg.dot((SIZE.0 - right + 20.0, row - 4.0), 5.0, colour, &series.name);
        }
        Ok(svg.finish())
    }
}

/// The points with a corner between every two: as far right as the later one, as high as the earlier one.
fn steps(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let corners = points.windows(2).flat_map(|pair| [(pair[1].0, pair[0].1), pair[1]]);
    points.first().copied().into_iter().chain(corners).collect()
}

/// The points that no other one beats in one of time and error without losing in the other, fastest first.
#[must_use]
pub fn pareto_front(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut sorted = points.to_vec();
    sorted.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut best = f64::INFINITY;
    sorted.retain(|(_, error)| {
        let better = *error < best;
        best = best.min(*error);
        better
    });
    sorted
}

/// An axis with its range, laid between two pixels.
pub(crate) struct Ruler {
    scale: Scale,
    range: (f64, f64),
    pixels: (f64, f64),
    ticks: Vec<f64>,
}

impl Ruler {
    /// A range around `values`, from the first of `pixels` to the second; errors name the chart by its title.
    pub(crate) fn new(axis: &Axis, values: impl Iterator<Item = f64>, pixels: (f64, f64), title: &str) -> Result<Self> {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for value in values {
            let fits = value.is_finite() && (axis.scale == Scale::Linear || value > 0.0);
            ensure!(fits, "chart {title:?}: {value} does not fit the {:?} axis {:?}", axis.scale, axis.label);
            (low, high) = (low.min(value), high.max(value));
        }
        ensure!(low <= high, "chart {title:?}: no points");
        let ticks = match axis.scale {
            Scale::Linear => linear_ticks(low.min(0.0), high.max(0.0)),
            Scale::Log => log_ticks(low, high),
        };
        let range = (ticks.first().copied().unwrap_or(low), ticks.last().copied().unwrap_or(high));
        Ok(Self { scale: axis.scale, range, pixels, ticks })
    }

    /// The pixel of a value.
    pub(crate) fn place(&self, value: f64) -> f64 {
        let along = match self.scale {
            Scale::Linear => (value - self.range.0) / (self.range.1 - self.range.0),
            Scale::Log => (value / self.range.0).ln() / (self.range.1 / self.range.0).ln(),
        };
        self.pixels.0 + along * (self.pixels.1 - self.pixels.0)
    }

    /// Draws it from left to right, its lines from the first to the second of these heights.
    pub(crate) fn draw_across(&self, svg: &mut Svg, label: &str, (bottom, top): (f64, f64)) {
        for &tick in &self.ticks {
            let x = self.place(tick);
            svg.line((x, bottom), (x, top), "#ddd", 1.0);
            svg.text((x, bottom + FONT + 6.0), Anchor::Middle, FONT, 0.0, &number(tick));
        }
        svg.line((self.pixels.0, bottom), (self.pixels.1, bottom), "#222", 1.0);
        svg.text((f64::midpoint(self.pixels.0, self.pixels.1), bottom + 42.0), Anchor::Middle, FONT, 0.0, label);
    }

    fn draw_up(&self, svg: &mut Svg, label: &str, across: &Self) {
        let (left, right) = across.pixels;
        for &tick in &self.ticks {
            let y = self.place(tick);
            svg.line((left, y), (right, y), "#ddd", 1.0);
            svg.text((left - 6.0, y + 4.0), Anchor::End, FONT, 0.0, &number(tick));
        }
        svg.line((left, self.pixels.0), (left, self.pixels.1), "#222", 1.0);
        svg.text((20.0, f64::midpoint(self.pixels.0, self.pixels.1)), Anchor::Middle, FONT, -90.0, label);
    }
}

/// Four to ten multiples of 1, 2 or 5 times a power of ten, the outer ones around `low` and `high`.
fn linear_ticks(low: f64, high: f64) -> Vec<f64> {
    let span = if high > low { high - low } else { 1.0 };
    let power = 10_f64.powf((span / 4.0).log10().floor());
    let step = [5.0, 2.0].into_iter().map(|factor| factor * power).find(|step| span / step >= 4.0).unwrap_or(power);
    let (first, last) = ((low / step).floor(), ((low + span) / step).ceil());
    (0..=(last - first) as u32).map(|at| (first + f64::from(at)) * step).collect()
}

/// 1, 2 and 5 times powers of ten, or powers of ten alone over more than three, the outer ones around `low` and `high`.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    let (first, last) = (low.log10().floor() as i32, high.log10().floor() as i32 + 1);
    let factors: &[f64] = if last - first > 3 { &[1.0] } else { &[1.0, 2.0, 5.0] };
    let all: Vec<f64> = (first..=last).flat_map(|power| factors.iter().map(move |factor| factor * 10_f64.powi(power))).collect();
    // One on or below the lowest value and one above the highest are enough.
    let from = all.iter().rposition(|&tick| tick <= low).unwrap_or(0);
    let to = all.iter().position(|&tick| tick > high).unwrap_or(all.len() - 1);
    all.get(from..=to).unwrap_or(&all).to_vec()
}

/// Short form of a number: at most four significant digits, no trailing zeros.
#[must_use]
pub fn number(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let power = value.abs().log10().floor() as i32;
    if !(-4..=6).contains(&power) {
        return format!("{value:.2e}");
    }
    let text = format!("{value:.*}", usize::try_from(3 - power).unwrap_or(0));
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(scale: Scale) -> Axis {
        Axis { label: "time / ms".to_owned(), scale }
    }

    fn chart(scale: Scale, points: &[(f64, f64)]) -> Chart {
        let series = Series { name: "a & b".to_owned(), points: points.to_vec(), mark: Mark::Line };
        Chart { title: "t".to_owned(), x: axis(scale), y: axis(Scale::Linear), series: vec![series] }
    }

    #[test]
    fn ticks_enclose_the_values() {
        assert_eq!(linear_ticks(0.0, 10.0), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        assert_eq!(linear_ticks(0.0, 3.2), [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5]);
        assert_eq!(linear_ticks(0.0, 0.0).first(), Some(&0.0));
        assert_eq!(log_ticks(1.5, 30.0), [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]);
        assert_eq!(log_ticks(1.0, 1.0), [1.0, 2.0]);
        assert_eq!(log_ticks(3.0, 40_000.0), [1.0, 10.0, 100.0, 1000.0, 10_000.0, 100_000.0]);
    }

    #[test]
    fn places_follow_the_scale() {
        let linear = Ruler::new(&axis(Scale::Linear), [0.0, 10.0].into_iter(), (0.0, 100.0), "t").unwrap();
        assert!((linear.place(5.0) - 50.0).abs() < 1e-9);
        let log = Ruler::new(&axis(Scale::Log), [1.0, 99.0].into_iter(), (100.0, 0.0), "t").unwrap();
        assert!((log.place(10.0) - 50.0).abs() < 1e-9);
    }

    #[test]
    fn a_chart_holds_every_point_and_its_names() {
        let svg = chart(Scale::Log, &[(1.0, 2.0), (10.0, 3.0)]).svg().unwrap();
        assert!(svg.contains("a &amp; b: 1, 2") && svg.contains("a &amp; b: 10, 3") && svg.contains("time / ms"));
        assert_eq!(svg.matches("<polyline").count(), 1);
    }

    #[test]
    fn a_front_is_dashed_in_steps_and_has_no_dots() {
        assert_eq!(steps(&[(0.0, 9.0), (2.0, 5.0), (3.0, 1.0)]), [(0.0, 9.0), (2.0, 9.0), (2.0, 5.0), (3.0, 5.0), (3.0, 1.0)]);
        let mut chart = chart(Scale::Log, &[(1.0, 2.0), (10.0, 3.0)]);
        let dots = chart.svg().unwrap().matches("<circle").count();
        chart.series.push(Series { name: "front".to_owned(), points: vec![(1.0, 2.0)], mark: Mark::Front });
        let svg = chart.svg().unwrap();
        assert_eq!((svg.matches("<circle").count(), svg.matches("stroke-dasharray").count()), (dots, 2));
        assert!(svg.contains(">front<"));
    }

    #[test]
    fn a_curve_lifts_its_pen() {
        let mut chart = chart(Scale::Log, &[(1.0, 2.0), (10.0, 3.0)]);
        let dots = chart.svg().unwrap().matches("<circle").count();
        let points = vec![(1.0, 2.0), (2.0, 2.0), (3.0, f64::NAN), (4.0, f64::NAN), (5.0, 2.0), (6.0, 2.0)];
        for (mark, polylines, dashed) in [(Mark::Curve, 1 + 2 + 1, 0), (Mark::Reference, 1 + 2 + 1, 2 + 1)] {
            chart.series.truncate(1);
            chart.series.push(Series { name: "curve".to_owned(), points: points.clone(), mark });
            let svg = chart.svg().unwrap();
            assert_eq!((svg.matches("<polyline").count(), svg.matches("stroke-dasharray").count()), (polylines, dashed));
            assert_eq!(svg.matches("<circle").count(), dots);
        }
        // Elsewhere a value that is no number is a fault.
        chart.series[1].mark = Mark::Line;
        assert!(chart.svg().unwrap_err().to_string().contains("does not fit"));
    }

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let points = [(3.0, 1.0), (1.0, 5.0), (2.0, 5.0), (2.0, 4.0), (4.0, 1.0), (1.0, 6.0)];
        assert_eq!(pareto_front(&points), [(1.0, 5.0), (2.0, 4.0), (3.0, 1.0)]);
        assert_eq!(pareto_front(&[]), []);
    }

    #[test]
    fn charts_are_stacked() {
        let one = chart(Scale::Linear, &[(1.0, 2.0)]);
        let both = stack(&[one.clone(), one]).unwrap();
        assert_eq!((both.matches("<svg ").count(), both.matches("</svg>").count()), (3, 3));
        assert!(both.contains("height=\"840\"") && both.contains("translate(0 420)"));
    }

    #[test]
    fn a_bound_is_dashed_across_the_chart_and_hollow() {
        let mut chart = chart(Scale::Log, &[(1.0, 2.0), (10.0, 3.0)]);
        chart.series.push(Series { name: "best".to_owned(), points: vec![(1.0, 1.5)], mark: Mark::Bound });
        let svg = chart.svg().unwrap();
        assert!(svg.contains("best: 1.5") && svg.contains(">best<"));
        // On the chart and in the legend.
        assert_eq!((svg.matches("stroke-dasharray").count(), svg.matches("fill=\"#fff\" stroke").count()), (2, 2));
        assert!(svg.contains("points=\"76.0,") && svg.contains("570.0,"));
    }

    #[test]
    fn what_cannot_be_drawn_is_refused() {
        assert!(chart(Scale::Linear, &[]).svg().unwrap_err().to_string().contains("no points"));
        assert!(chart(Scale::Log, &[(0.0, 1.0)]).svg().unwrap_err().to_string().contains("does not fit"));
        assert!(chart(Scale::Linear, &[(f64::NAN, 1.0)]).svg().is_err());
    }

    #[test]
    fn numbers_are_short() {
        for (value, text) in
            [(0.0, "0"), (1.0, "1"), (0.125, "0.125"), (1234.56, "1235"), (-20.0, "-20"), (1e9, "1.00e9"), (100_000.0, "100000")]
        {
            assert_eq!(number(value), text);
        }
    }
}
