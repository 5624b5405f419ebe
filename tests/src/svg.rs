//! The few SVG elements that charts are made of.

use std::fmt::Write as _;

/// How a text lies about its point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Anchor {
    /// Begins at it.
    Start,
    /// Is centred on it.
    Middle,
    /// Ends at it.
    End,
}

/// An SVG document. Coordinates are pixels from the top left.
#[derive(Debug, Clone)]
pub struct Svg {
    body: String,
    width: f64,
    height: f64,
}

impl Svg {
    /// A white sheet.
    #[must_use]
    pub fn new(width: f64, height: f64) -> Self {
        let body = "<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n".to_owned();
        Self { body, width, height }
    }

    /// Appends one element; writing to a `String` cannot fail.
    fn element(&mut self, element: std::fmt::Arguments<'_>) {
        let _ = writeln!(self.body, "{element}");
    }

    /// A straight line.
    pub fn line(&mut self, from: (f64, f64), to: (f64, f64), colour: &str, width: f64) {
        let ((x1, y1), (x2, y2)) = (from, to);
        let colour = escaped(colour);
        self.element(format_args!(
            "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{colour}\" stroke-width=\"{width}\"/>"
        ));
    }

    /// Straight lines from point to point.
    pub fn polyline(&mut self, points: &[(f64, f64)], colour: &str, width: f64) {
        let points: Vec<_> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        let (points, colour) = (points.join(" "), escaped(colour));
        self.element(format_args!("<polyline points=\"{points}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\"/>"));
    }

    /// Dashes from point to point, behind which other marks stay visible.
    pub fn dashes(&mut self, points: &[(f64, f64)], colour: &str, width: f64) {
        let points: Vec<_> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        let (points, colour) = (points.join(" "), escaped(colour));
        self.element(format_args!(
            "<polyline points=\"{points}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\" stroke-dasharray=\"6 4\"/>"
        ));
    }

    /// A filled disc; `title` appears under the pointer.
    pub fn dot(&mut self, (x, y): (f64, f64), radius: f64, colour: &str, title: &str) {
        let (colour, title) = (escaped(colour), escaped(title));
        self.element(format_args!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{colour}\"><title>{title}</title></circle>"));
    }

    /// An empty disc's rim; `title` appears under the pointer.
    pub fn ring(&mut self, (x, y): (f64, f64), radius: f64, colour: &str, title: &str) {
        let (colour, title) = (escaped(colour), escaped(title));
        self.element(format_args!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"#fff\" stroke=\"{colour}\" stroke-width=\"2\"><title>{title}</title></circle>"
        ));
    }

    /// A filled rectangle between two corners; `title` appears under the pointer.
    pub fn bar(&mut self, (left, top): (f64, f64), (right, bottom): (f64, f64), colour: &str, title: &str) {
        let (width, height) = ((right - left).max(0.0), (bottom - top).max(0.0));
        let (colour, title) = (escaped(colour), escaped(title));
        self.element(format_args!(
            "<rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" fill=\"{colour}\"><title>{title}</title></rect>"
        ));
    }

    /// One line of text, its baseline through the point, turned clockwise by `turn_deg` about it.
    pub fn text(&mut self, (x, y): (f64, f64), anchor: Anchor, size: f64, turn_deg: f64, text: &str) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let turn = if turn_deg == 0.0 { String::new() } else { format!(" transform=\"rotate({turn_deg} {x:.1} {y:.1})\"") };
        let text = escaped(text);
        self.element(format_args!("<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" font-size=\"{size}\"{turn}>{text}</text>"));
    }

    /// The whole document.
    #[must_use]
    pub fn finish(&self) -> String {
        let Self { body, width, height } = self;
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" \
             font-family=\"sans-serif\" fill=\"#222\">\n{body}</svg>\n"
        )
    }
}

/// Documents of one size one below the other.
#[must_use]
pub fn stack(documents: &[String], (width, height): (f64, f64)) -> String {
    let mut body = String::new();
    for (at, document) in documents.iter().enumerate() {
        let _ = writeln!(body, "<g transform=\"translate(0 {})\">\n{document}</g>", at as f64 * height);
    }
    let height = documents.len() as f64 * height;
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\">\n{body}</svg>\n"
    )
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_escaped() {
        let mut svg = Svg::new(10.0, 10.0);
        svg.text((1.0, 2.0), Anchor::End, 12.0, -90.0, "a < b & \"c\"");
        let document = svg.finish();
        assert!(document.contains(
            "<text x=\"1.0\" y=\"2.0\" text-anchor=\"end\" font-size=\"12\" transform=\"rotate(-90 1.0 2.0)\">a &lt; b &amp; &quot;c&quot;</text>"
        ));
        assert!(document.starts_with("<svg ") && document.ends_with("</svg>\n"));
    }
}
