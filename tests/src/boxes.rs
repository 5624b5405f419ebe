//! Box charts, as SVG: a row a name, its values from the least to the most.

use anyhow::Result;

use crate::chart::{Axis, Ruler, number};
use crate::samples::percentile;
use crate::svg::{Anchor, Svg};

const WIDTH: f64 = 760.0;
/// Left, top, right, bottom; the left one holds the names.
const MARGIN: (f64, f64, f64, f64) = (200.0, 44.0, 70.0, 56.0);
const ROW: f64 = 24.0;
const FONT: f64 = 12.0;
/// Of rows that are marked, and of all others.
const COLOURS: (&str, &str) = ("#d55e00", "#0072b2");

/// Values of one name.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// To the left.
    pub name: String,
    /// In any order; a row without values is left empty.
    pub values: Vec<f64>,
    /// Whether it stands apart: what others are compared with.
    pub marked: bool,
}

/// A box chart.
#[derive(Debug, Clone, PartialEq)]
pub struct Boxes {
    /// Above it.
    pub title: String,
    /// Below it.
    pub axis: Axis,
    /// From the top.
    pub rows: Vec<Row>,
}

impl Boxes {
    /// Draws a box from the first to the third quartile of each row, a line from its least to its most value, and its median as a number.
    ///
    /// # Errors
    /// When there is no value, one is not finite, or one on a logarithmic axis is not positive.
    pub fn svg(&self) -> Result<String> {
        let (left, top, right, bottom) = MARGIN;
        let height = top + ROW * self.rows.len() as f64;
        let across =
            Ruler::new(&self.axis, self.rows.iter().flat_map(|row| row.values.iter().copied()), (left, WIDTH - right), &self.title)?;
        let mut svg = Svg::new(WIDTH, height + bottom);
        svg.text((16.0, top - 18.0), Anchor::Start, FONT + 3.0, 0.0, &self.title);
        across.draw_across(&mut svg, &self.axis.label, (height, top));
        for (at, row) in self.rows.iter().enumerate() {
            let middle = top + ROW * (at as f64 + 0.5);
            svg.text((left - 8.0, middle + 4.0), Anchor::End, FONT, 0.0, &row.name);
            let quantiles = [0.0, 0.25, 0.5, 0.75, 1.0].map(|q| percentile(&row.values, q));
            let [Some(least), Some(first), Some(median), Some(third), Some(most)] = quantiles else { continue };
            let colour = if row.marked { COLOURS.0 } else { COLOURS.1 };
            let title = format!("{}: {}, {}, {}", row.name, number(least), number(median), number(most));
            svg.line((across.place(least), middle), (across.place(most), middle), colour, 1.5);
            // A box of one value is still to be seen.
            let (from, to) = (across.place(first), across.place(third).max(across.place(first) + 2.0));
            svg.bar((from, middle - 7.0), (to, middle + 7.0), colour, &title);
            svg.line((across.place(median), middle - 9.0), (across.place(median), middle + 9.0), "#222", 2.0);
            svg.text((across.place(most) + 6.0, middle + 4.0), Anchor::Start, FONT, 0.0, &number(median));
        }
        Ok(svg.finish())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::Scale;

    #[test]
    fn every_row_is_drawn_with_its_median() {
        let row = |name: &str, values: &[f64]| Row { name: name.to_owned(), values: values.to_vec(), marked: false };
        let mut boxes = Boxes {
            title: "t".to_owned(),
            axis: Axis { label: "time / ms".to_owned(), scale: Scale::Log },
            rows: vec![row("a", &[1.0, 4.0, 2.0]), row("b", &[8.0]), row("none", &[])],
        };
        let svg = boxes.svg().unwrap();
        assert!(svg.contains("a: 1, 2, 4") && svg.contains("b: 8, 8, 8") && svg.contains(">none<") && svg.contains("time / ms"));
        // The sheet and two boxes.
        assert_eq!(svg.matches("<rect").count(), 3);
        boxes.rows[1].values[0] = 0.0;
        assert!(boxes.svg().unwrap_err().to_string().contains("does not fit"));
        boxes.rows.clear();
        assert!(boxes.svg().is_err());
    }
}
