//! How large a view's layer is made, so that what moves in it does not have it made anew.

/// Sides are multiples of this, pixels.
const STEP_PX: u32 = 64;
/// A side is made longer than needed by one part in this many.
const SPARE: u32 = 8;
/// A layer is made smaller once it has been twice as large as needed for so many frames: what leaves the view may come back.
const PATIENCE: u32 = 120;

/// The size of a layer over time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Room {
    size: (u32, u32),
    /// Frames in a row for which it was too large, and what the largest of them needed.
    too_large: u32,
    needed: (u32, u32),
}

impl Room {
    /// Makes room for `part` pixels of an image. True when the layer has to be made anew, of [`Room::size`].
    pub(super) fn make(&mut self, part: (u32, u32), image: (u32, u32)) -> bool {
        let side = |part: u32, image: u32| part.saturating_add(part / SPARE).next_multiple_of(STEP_PX).min(image.max(part)).max(1);
        let wanted = (side(part.0, image.0), side(part.1, image.1));
        if part.0 > self.size.0 || part.1 > self.size.1 {
            *self = Self { size: larger(self.size, wanted), ..Self::default() };
            return true;
        }
        let area = |(width, height): (u32, u32)| u64::from(width) * u64::from(height);
        if area(self.size) <= 2 * area(wanted) {
            (self.too_large, self.needed) = (0, (0, 0));
            return false;
        }
        (self.too_large, self.needed) = (self.too_large + 1, larger(self.needed, wanted));
        let smaller = self.too_large >= PATIENCE;
        if smaller {
            *self = Self { size: self.needed, ..Self::default() };
        }
        smaller
    }

    /// Columns and rows.
    pub(super) fn size(&self) -> (u32, u32) {
        self.size
    }
}

fn larger(a: (u32, u32), b: (u32, u32)) -> (u32, u32) {
    (a.0.max(b.0), a.1.max(b.1))
}

#[cfg(test)]
mod tests {
    use super::*;

    const IMAGE: (u32, u32) = (1280, 720);

    #[test]
    fn what_moves_and_turns_has_its_layer_made_once() {
        let mut room = Room::default();
        // A box of 300 pixels that turns and moves by fractions of the extent's steps of 16.
        let made = (0..1_000u32).filter(|i| room.make((304 + 16 * (i % 3), 288 + 16 * (i / 7 % 3)), IMAGE)).count();
        assert_eq!((made, room.size()), (1, (384, 384)));
    }

    #[test]
    fn what_leaves_the_view_and_comes_back_finds_its_layer() {
        let mut room = Room::default();
        let side = |i: u32| 16 + (i % 100).abs_diff(50) * 8;
        let made = (0..1_000).filter(|i| room.make((side(*i), 416), IMAGE)).count();
        assert_eq!((made, room.size()), (1, (512, 512)));
    }

    #[test]
    fn one_that_stays_too_large_is_made_smaller_once() {
        let mut room = Room::default();
        assert!(room.make((1000, 700), IMAGE) && room.size() == (1152, 720));
        let made: Vec<u32> = (1..1_000).filter(|i| room.make((200, if i % 2 == 0 { 100 } else { 300 }), IMAGE)).collect();
        assert_eq!((made, room.size()), (vec![PATIENCE], (256, 384)));
        // Never larger than an image needs.
        assert!(room.make(IMAGE, IMAGE) && room.size() == IMAGE);
        let mut tiny = Room::default();
        assert!(tiny.make((1, 1), (1, 1)) && tiny.size() == (1, 1) && !tiny.make((0, 0), (0, 0)));
    }
}
