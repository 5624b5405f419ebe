//! A small picture drawn by the CPU: text of 3×5 pixels, lines and dots.

use glam::IVec2;

/// From one character to the next, and from one line to the next, pixels.
pub(super) const CELL: IVec2 = IVec2::new(4, 7);

/// Glyphs as five rows of an octal digit each, from the top; 4 is the left pixel.
const GLYPHS: [(char, u16); 47] = [
    ('0', 0o75557),
    ('1', 0o26227),
    ('2', 0o71747),
    ('3', 0o71717),
    ('4', 0o55711),
    ('5', 0o74717),
    ('6', 0o74757),
    ('7', 0o71122),
    ('8', 0o75757),
    ('9', 0o75717),
    ('A', 0o25755),
    ('B', 0o65656),
    ('C', 0o34443),
    ('D', 0o65556),
    ('E', 0o74647),
    ('F', 0o74644),
    ('G', 0o34553),
    ('H', 0o55755),
    ('I', 0o72227),
    ('J', 0o11152),
    ('K', 0o55655),
    ('L', 0o44447),
    ('M', 0o57755),
    ('N', 0o65555),
    ('O', 0o25552),
    ('P', 0o65644),
    ('Q', 0o25573),
    ('R', 0o65655),
    ('S', 0o34216),
    ('T', 0o72222),
    ('U', 0o55557),
    ('V', 0o55552),
    ('W', 0o55775),
    ('X', 0o55255),
    ('Y', 0o55222),
    ('Z', 0o71247),
    (' ', 0),
    ('.', 0o00002),
    (',', 0o00024),
    (':', 0o02020),
    ('/', 0o11244),
    ('-', 0o00700),
    ('+', 0o02720),
    ('%', 0o51245),
    ('(', 0o12221),
    (')', 0o42224),
    ('=', 0o07070),
];

/// Straight RGBA, sRGB codes.
pub(super) type Colour = [u8; 4];

/// The picture, rows from the top.
pub(super) struct Canvas {
    size: IVec2,
    texels: Vec<u8>,
}

impl Canvas {
    pub(super) fn new(size: IVec2) -> Self {
        let size = size.max(IVec2::ONE);
        Self { size, texels: vec![0; (4 * size.x * size.y) as usize] }
    }

    pub(super) fn texels(&self) -> &[u8] {
        &self.texels
    }

    pub(super) fn fill(&mut self, colour: Colour) {
        self.texels.chunks_exact_mut(4).for_each(|texel| texel.copy_from_slice(&colour));
    }

    /// What lies outside is left out.
    pub(super) fn dot(&mut self, at: IVec2, colour: Colour) {
        if at.cmpge(IVec2::ZERO).all() && at.cmplt(self.size).all() {
            let start = 4 * (at.y * self.size.x + at.x) as usize;
            self.texels[start..start + 4].copy_from_slice(&colour);
        }
    }

    /// A line of text from its upper left corner; small letters are drawn as capitals, what has no glyph as a box.
    pub(super) fn text(&mut self, at: IVec2, text: &str, colour: Colour) {
        for (i, character) in text.chars().map(|c| c.to_ascii_uppercase()).enumerate() {
            let rows = GLYPHS.iter().find(|(glyph, _)| *glyph == character).map_or(0o77777, |(_, rows)| *rows);
            for pixel in (0..15).filter(|pixel| rows >> (14 - pixel) & 1 == 1) {
                self.dot(at + IVec2::new(CELL.x * i as i32 + pixel % 3, pixel / 3), colour);
            }
        }
    }

    /// The outline of a rectangle.
    pub(super) fn frame(&mut self, at: IVec2, size: IVec2, colour: Colour) {
        let last = size - IVec2::ONE;
        (0..size.x).for_each(|x| [0, last.y].into_iter().for_each(|y| self.dot(at + IVec2::new(x, y), colour)));
        (0..size.y).for_each(|y| [0, last.x].into_iter().for_each(|x| self.dot(at + IVec2::new(x, y), colour)));
    }

    /// A filled disc.
    pub(super) fn disc(&mut self, at: IVec2, radius: i32, colour: Colour) {
        for y in -radius..=radius {
            for x in -radius..=radius {
                if x * x + y * y <= radius * radius {
                    self.dot(at + IVec2::new(x, y), colour);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHITE: Colour = [255; 4];

    fn rows(canvas: &Canvas) -> Vec<String> {
        let row = |row: &[u8]| row.chunks_exact(4).map(|texel| if texel[3] > 0 { '#' } else { '.' }).collect();
        canvas.texels.chunks_exact(4 * canvas.size.x as usize).map(row).collect()
    }

    #[test]
    fn text_is_legible() {
        let mut canvas = Canvas::new(IVec2::new(12, 5));
        canvas.text(IVec2::ZERO, "h7é", WHITE);
        assert_eq!(rows(&canvas), ["#.#.###.###.", "#.#...#.###.", "###...#.###.", "#.#..#..###.", "#.#..#..###."]);
    }

    #[test]
    fn every_glyph_is_there_once_and_no_two_look_alike() {
        for (i, (character, rows)) in GLYPHS.iter().enumerate() {
            assert!(GLYPHS[..i].iter().all(|(other, drawn)| other != character && drawn != rows), "{character}");
            assert_eq!(character.to_ascii_uppercase(), *character);
        }
    }

    #[test]
    fn what_reaches_outside_is_cut_off() {
        let mut canvas = Canvas::new(IVec2::new(4, 3));
        canvas.frame(IVec2::ZERO, IVec2::new(4, 3), WHITE);
        assert_eq!(rows(&canvas), ["####", "#..#", "####"]);
        canvas.fill([0; 4]);
        canvas.disc(IVec2::ZERO, 1, WHITE);
        canvas.disc(IVec2::new(i32::MAX / 2, -9), 2, WHITE);
        canvas.text(IVec2::new(3, 2), "E", WHITE);
        assert_eq!(rows(&canvas), ["##..", "#...", "...#"]);
    }
}
