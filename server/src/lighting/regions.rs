//! Connected regions of a mask, as runs of texels: rows are cut into runs, and runs that touch are joined by union-find (Rosenfeld & Pfaltz
//! 1966). What a region holds is then summed run by run, a row's latitude once a run.

use std::ops::Range;

/// What lies beyond the edges of the mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Topology {
    /// Nothing: the mask is a plain picture.
    Flat,
    /// The mask is the top of an equirect panorama: the left and right edges meet, and a texel of the first row
    /// touches the one on the other side of the zenith.
    Panorama,
}

/// Texels that are looked at together.
const AT_ONCE: usize = 64;

/// Most eight-connected regions of a mask: any 2×2 texels touch each other, so they hold parts of at most one.
pub(super) fn most_regions(width: usize, rows: usize) -> usize {
    width.div_ceil(2) * rows.div_ceil(2)
}

/// Texels side by side in one row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Run {
    pub(super) row: u32,
    /// First column, and the one after the last.
    start: u32,
    end: u32,
}

impl Run {
    /// Its columns.
    #[inline(always)]
    pub(super) fn columns(self) -> Range<usize> {
        self.start as usize..self.end as usize
    }

    /// Its texels in a map of this width.
    #[inline(always)]
    pub(super) fn texels(self, width: usize) -> Range<usize> {
        let first = self.row as usize * width;
        first + self.start as usize..first + self.end as usize
    }
}

/// Whether a texel of a map of this width is in one of the runs.
pub(super) fn contain(runs: &[Run], width: usize, texel: usize) -> bool {
    runs.iter().any(|run| run.texels(width).contains(&texel))
}

/// Eight-connected regions of a mask; buffers are reused.
pub(super) struct Regions {
    /// From the top, left to right.
    found: Vec<Run>,
    /// Of each, one that it is joined to, or itself: the first of its region in the end.
    joined: Vec<u32>,
    region: Vec<u32>,
    /// Region by region.
    runs: Vec<Run>,
    ends: Vec<usize>,
}

impl Regions {
    /// Room for whatever a mask of this size may hold, so that no frame allocates.
    pub(super) fn new(width: usize, rows: usize) -> Self {
        let runs = width.div_ceil(2) * rows;
        Self {
            found: Vec::with_capacity(runs),
            joined: Vec::with_capacity(runs),
            region: Vec::with_capacity(runs),
            runs: Vec::with_capacity(runs),
            ends: Vec::with_capacity(most_regions(width, rows)),
        }
    }

    /// Finds the regions of the texels of a `width`-wide map for which `inside` holds, in the order of their first texels.
    pub(super) fn find(&mut self, width: usize, values: &[f32], topology: Topology, inside: impl Fn(f32) -> bool) {
        self.found.clear();
        self.joined.clear();
        let mut above = 0..0;
        for (row, values) in (0..).zip(values.chunks_exact(width)) {
            let first = self.found.len();
            self.cut(row, values, &inside);
            let here = first..self.found.len();
            self.join_rows(above, here.clone());
            if topology == Topology::Panorama {
                self.join_around(first.saturating_sub(1), here.clone(), width as u32);
            }
            above = here;
        }
        self.collect();
    }

    /// Runs of one row.
    #[inline(always)]
    fn cut(&mut self, row: u32, values: &[f32], inside: &impl Fn(f32) -> bool) {
        let mut open = None;
        for (chunk, first) in values.chunks(AT_ONCE).zip((0..).step_by(AT_ONCE)) {
            // Without a way out half way, so that many texels are looked at together: nearly all are like their neighbours.
            let count: u32 = chunk.iter().map(|value| u32::from(inside(*value))).fold(0, u32::wrapping_add);
            if count as usize == chunk.len() {
                open = open.or(Some(first));
                continue;
            }
            if count == 0 {
                self.close(row, &mut open, first);
                continue;
            }
            for (value, column) in chunk.iter().zip(first..) {
                if inside(*value) {
                    open = open.or(Some(column));
                } else {
                    self.close(row, &mut open, column);
                }
            }
        }
        self.close(row, &mut open, values.len() as u32);
    }

    #[inline(always)]
    fn close(&mut self, row: u32, open: &mut Option<u32>, end: u32) {
        if let Some(start) = open.take() {
            self.joined.push(self.found.len() as u32);
            self.found.push(Run { row, start, end });
        }
    }

    /// Joins the runs of a row with those of the row above.
    fn join_rows(&mut self, above: Range<usize>, here: Range<usize>) {
        let (mut upper, mut lower) = (above.start, here.start);
        while upper < above.end && lower < here.end {
            let (a, b) = (self.found[upper], self.found[lower]);
            if a.start <= b.end && b.start <= a.end {
                self.join(upper, lower);
            }
            // What ends first touches nothing further on.
            if a.end < b.end { upper += 1 } else { lower += 1 }
        }
    }

    /// Joins what touches across the seam, `last_above` being the last run of the row above if it has any, and over the zenith.
    fn join_around(&mut self, last_above: usize, here: Range<usize>, width: u32) {
        let Some(last) = here.clone().last() else { return };
        let row = self.found[last].row;
        let first_above = (0..=last_above).rev().take_while(|run| self.found[*run].row + 1 == row).last();
        let (begins, ends) = (|run: Run| run.start == 0, |run: Run| run.end == width);
        for (a, b) in [Some((here.start, last)), first_above.map(|above| (above, last)), first_above.map(|_| (here.start, last_above))]
            .into_iter()
            .flatten()
        {
            if begins(self.found[a]) && ends(self.found[b]) {
                self.join(a, b);
            }
        }
        if row > 0 {
            return;
        }
        for (a, b) in here.clone().flat_map(|a| (a..last + 1).map(move |b| (a, b))) {
            let (run, other) = (self.found[a], self.found[b]);
            let opposite = |turn: u32| run.start + turn < other.end + width && other.start + width < run.end + turn;
            if opposite(width / 2) || opposite(width + width / 2) {
                self.join(a, b);
            }
        }
    }

    /// The earlier of two regions takes the other in.
    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.first(a as u32), self.first(b as u32));
        self.joined[a.max(b) as usize] = a.min(b);
    }

    /// The first run of the region that a run is in.
    fn first(&mut self, mut run: u32) -> u32 {
        while self.joined[run as usize] != run {
            let next = self.joined[run as usize];
            self.joined[run as usize] = self.joined[next as usize];
            run = next;
        }
        run
    }

    /// Puts the runs of each region side by side.
    fn collect(&mut self) {
        self.region.clear();
        self.ends.clear();
        for run in 0..self.found.len() {
            let first = self.first(run as u32) as usize;
            let region = if first == run {
                self.ends.push(0);
                self.ends.len() as u32 - 1
            } else {
                self.region[first]
            };
            self.region.push(region);
            self.ends[region as usize] += 1;
        }
        let mut sum = 0;
        for end in &mut self.ends {
            sum += std::mem::replace(end, sum);
        }
        self.runs.clear();
        self.runs.resize(self.found.len(), Run { row: 0, start: 0, end: 0 });
        for (run, region) in self.found.iter().zip(&self.region) {
            let place = &mut self.ends[*region as usize];
            self.runs[*place] = *run;
            *place += 1;
        }
    }

    /// How many regions there are.
    pub(super) fn len(&self) -> usize {
        self.ends.len()
    }

    /// Runs of each region, from the top, left to right.
    pub(super) fn iter(&self) -> impl Iterator<Item = &[Run]> {
        (0..self.ends.len()).map(|region| self.runs(region))
    }

    /// Runs of one region.
    pub(super) fn runs(&self, region: usize) -> &[Run] {
        let start = if region == 0 { 0 } else { self.ends[region - 1] };
        &self.runs[start..self.ends[region]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn count(picture: &[&str], topology: Topology) -> usize {
        let values: Vec<f32> = picture.iter().flat_map(|row| row.bytes().map(|b| f32::from(b == b'#'))).collect();
        let mut regions = Regions::new(picture[0].len(), picture.len());
        regions.find(picture[0].len(), &values, topology, |v| v > 0.5);
        let (width, mut inside) = (picture[0].len(), vec![false; values.len()]);
        for run in regions.iter().flatten() {
            run.texels(width).for_each(|texel| assert!(!std::mem::replace(&mut inside[texel], true), "{texel} is in two"));
        }
        assert!(inside.iter().zip(&values).all(|(inside, value)| *inside == (*value > 0.5)), "{picture:?}");
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

    /// Regions by flooding from every texel: slower, and nothing that could go wrong.
    fn flooded(mask: &[bool], width: usize) -> Vec<usize> {
        let rows = mask.len() / width;
        let mut labels = vec![usize::MAX; mask.len()];
        for seed in 0..mask.len() {
            if !mask[seed] || labels[seed] != usize::MAX {
                continue;
            }
            let mut next = vec![seed];
            while let Some(texel) = next.pop() {
                if std::mem::replace(&mut labels[texel], seed) == seed {
                    continue;
                }
                let (row, column) = (texel / width, texel % width);
                let beside = |column: usize| [column + width - 1, column, column + 1].map(|column| column % width);
                let near = (row.saturating_sub(1)..(row + 2).min(rows)).flat_map(|row| beside(column).map(|column| row * width + column));
                let over = (row == 0).then_some((column + width / 2) % width);
                next.extend(near.chain(over).filter(|texel| mask[*texel] && labels[*texel] != seed));
            }
        }
        labels
    }

    #[test]
    fn regions_are_those_of_a_flood() {
        let width = 130;
        for density in [3, 10, 30, 50, 70, 97] {
            for seed in 0..20usize {
                let mask: Vec<bool> =
                    (0..width * 9).map(|texel| (texel * 7919 + seed * 104_729) * 31 % 10_007 * 101 % 100 < density).collect();
                let values: Vec<f32> = mask.iter().map(|inside| f32::from(u8::from(*inside))).collect();
                let mut regions = Regions::new(width, 9);
                regions.find(width, &values, Topology::Panorama, |value| value > 0.5);
                let mut labels = vec![usize::MAX; mask.len()];
                for runs in regions.iter() {
                    let first = runs[0].texels(width).start;
                    runs.iter().flat_map(|run| run.texels(width)).for_each(|texel| labels[texel] = first);
                    assert!(contain(runs, width, first) && runs.is_sorted_by_key(|run| run.texels(width).start));
                }
                assert!(labels == flooded(&mask, width), "{density} {seed}");
            }
        }
    }
}
