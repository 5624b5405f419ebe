//! Connected regions of a mask by breadth-first search.

/// What lies beyond the edges of the mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Topology {
    /// Nothing: the mask is a plain picture.
    Flat,
    /// The mask is the top of an equirect panorama: the left and right edges meet, and a texel of the first row
    /// touches the one on the other side of the zenith.
    Panorama,
}

/// Texels that are searched for a first one of a region together.
const RUN: usize = 64;

/// Most eight-connected regions of a mask: any 2×2 texels touch each other, so they hold parts of at most one.
pub(super) fn most_regions(width: usize, rows: usize) -> usize {
    width.div_ceil(2) * rows.div_ceil(2)
}

/// Eight-connected regions of a mask; buffers are reused.
pub(super) struct Regions {
    mask: Vec<bool>,
    members: Vec<u32>,
    ends: Vec<usize>,
}

impl Regions {
    /// Room for whatever a mask of this size may hold, so that no frame allocates.
    pub(super) fn new(width: usize, rows: usize) -> Self {
        let texels = width * rows;
        Self { mask: Vec::with_capacity(texels), members: Vec::with_capacity(texels), ends: Vec::with_capacity(most_regions(width, rows)) }
    }

    /// Finds the regions of the texels of a `width`-wide map for which `inside` holds.
    pub(super) fn find(&mut self, width: usize, values: &[f32], topology: Topology, inside: impl Fn(f32) -> bool) {
        self.mask.resize(values.len(), false);
        for (mask, value) in self.mask.iter_mut().zip(values) {
            *mask = inside(*value);
        }
        self.members.clear();
        self.ends.clear();
        for start in (0..self.mask.len()).step_by(RUN) {
            let run = start..(start + RUN).min(self.mask.len());
            // Without a way out half way, so that many texels are looked at together: nearly all runs are empty.
            if !self.mask[run.clone()].iter().fold(false, |any, inside| any | inside) {
                continue;
            }
            for seed in run {
                if self.mask[seed] {
                    self.grow(seed, width, topology);
                    self.ends.push(self.members.len());
                }
            }
        }
    }

    fn grow(&mut self, seed: usize, width: usize, topology: Topology) {
        let rows = self.mask.len() / width;
        let mut next = self.members.len();
        self.visit(seed);
        while next < self.members.len() {
            let texel = self.members[next] as usize;
            next += 1;
            let (row, column) = (texel as u32 / width as u32, texel as u32 % width as u32);
            let (row, column) = (row as usize, column as usize);
            if row > 0 && row + 1 < rows && column > 0 && column + 1 < width {
                for first in [texel - width - 1, texel - 1, texel + width - 1] {
                    self.visit_three(first);
                }
                continue;
            }
            let wraps = topology == Topology::Panorama;
            let left = if column > 0 { Some(column - 1) } else { wraps.then_some(width - 1) };
            let right = if column + 1 < width { Some(column + 1) } else { wraps.then_some(0) };
            for row in row.saturating_sub(1)..(row + 2).min(rows) {
                for column in [left, Some(column), right].into_iter().flatten() {
                    self.visit(row * width + column);
                }
            }
            if wraps && row == 0 {
                self.visit((column + width / 2) % width);
            }
        }
    }

    /// Visits a texel and the two beside it; the middle of a region has been visited from all sides.
    #[inline]
    fn visit_three(&mut self, first: usize) {
        let [a, b, c] = [self.mask[first], self.mask[first + 1], self.mask[first + 2]];
        if a | b | c {
            (first..first + 3).for_each(|texel| self.visit(texel));
        }
    }

    #[inline]
    fn visit(&mut self, texel: usize) {
        if std::mem::take(&mut self.mask[texel]) {
            self.members.push(texel as u32);
        }
    }

    /// How many regions there are.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.ends.len()
    }

    /// Texels of each region, in the order in which the search met them.
    pub(super) fn iter(&self) -> impl Iterator<Item = &[u32]> {
        (0..self.ends.len()).map(|region| self.members(region))
    }

    /// Texels of one region.
    pub(super) fn members(&self, region: usize) -> &[u32] {
        let start = if region == 0 { 0 } else { self.ends[region - 1] };
        &self.members[start..self.ends[region]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn count(picture: &[&str], topology: Topology) -> usize {
        let values: Vec<f32> = picture.iter().flat_map(|row| row.bytes().map(|b| f32::from(b == b'#'))).collect();
        let mut regions = Regions::new(picture[0].len(), picture.len());
        regions.find(picture[0].len(), &values, topology, |v| v > 0.5);
        let texels: usize = regions.iter().map(<[u32]>::len).sum();
        assert_eq!(texels, values.iter().filter(|v| **v > 0.5).count());
        regions.len()
    }

    #[test]
    fn corners_connect_and_gaps_do_not() {
        assert_eq!(count(&["#...", ".#..", "...#"], Topology::Flat), 2);
        assert_eq!(count(&["....", "...."], Topology::Flat), 0);
        // Down one side and up the other.
        assert_eq!(count(&["#..#", "#..#", "####"], Topology::Flat), 1);
        assert_eq!(most_regions(5, 3), count(&["#.#.#", ".....", "#.#.#"], Topology::Flat));
    }

    #[test]
    fn panoramas_wrap_and_pictures_do_not() {
        for (picture, flat, panorama) in [
            (["........", "#......#", "........"], 2, 1),
            // The row above touches across the seam, too.
            (["........", ".......#", "#......."], 2, 1),
            // Opposite sides of the zenith.
            ([".#...#..", "........", "........"], 2, 1),
            // The bottom row of the upper half does not wrap over any pole.
            (["........", "........", ".#...#.."], 2, 2),
        ] {
            assert_eq!((count(&picture, Topology::Flat), count(&picture, Topology::Panorama)), (flat, panorama), "{picture:?}");
        }
    }
}
