//! Division of a panorama into regions by cuts along rows and columns.

use super::Rule;
use super::table::{Moments, Rectangle, SummedArea};

/// What rounding can leave of a black rectangle in the table, as a share of the panorama's light.
const ROUNDING: f64 = 1e-12;

/// The direction of a cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cut {
    /// Between two columns.
    Across,
    /// Between two rows.
    Down,
}

impl Rectangle {
    fn length(self, cut: Cut) -> usize {
        match cut {
            Cut::Across => self.right - self.left,
            Cut::Down => self.bottom - self.top,
        }
    }

    fn divided(self, cut: Cut, at: usize) -> (Self, Self) {
        match cut {
            Cut::Across => (Self { right: self.left + at, ..self }, Self { left: self.left + at, ..self }),
            Cut::Down => (Self { bottom: self.top + at, ..self }, Self { top: self.top + at, ..self }),
        }
    }
}

/// A panorama's table with what the rules need to know of it.
pub(super) struct Divider<'a> {
    table: &'a SummedArea,
    whole: Rectangle,
    least_energy: f64,
}

impl<'a> Divider<'a> {
    /// For a panorama of `width` × `height` texels.
    pub(super) fn new(table: &'a SummedArea, width: usize, height: usize) -> Self {
        let whole = Rectangle { top: 0, bottom: height, left: 0, right: width };
        Self { table, whole, least_energy: ROUNDING * table.sum(whole).energy }
    }

    /// Divides the panorama into at most `count` regions that hold light, and into fewer only where the texels allow no
    /// more. In every round each region is cut once, the one of most energy or variance first: where `count` is a power of
    /// two and every region can be cut, these are the papers' iterations; otherwise the last round stops at `count`.
    pub(super) fn divide(&self, rule: Rule, count: usize, regions: &mut Vec<Rectangle>) {
        regions.clear();
        regions.push(self.whole);
        while regions.len() < count {
            let round = regions.len();
            regions
                .sort_unstable_by(|a, b| self.need(rule, *b).total_cmp(&self.need(rule, *a)).then((a.top, a.left).cmp(&(b.top, b.left))));
            for i in 0..round {
                if regions.len() == count {
                    break;
                }
                if let Some((a, b)) = self.cut(rule, regions[i]) {
                    regions[i] = a;
                    regions.push(b);
                }
            }
            if regions.len() == round {
                break;
            }
        }
    }

    fn need(&self, rule: Rule, region: Rectangle) -> f64 {
        let sum = self.table.sum(region);
        match rule {
            Rule::Median => sum.energy,
            Rule::Variance => sum.variance(),
        }
    }

    /// The region's two parts, both with light, or none if a cut cannot part its light.
    fn cut(&self, rule: Rule, region: Rectangle) -> Option<(Rectangle, Rectangle)> {
        match rule {
            Rule::Median => {
                let (first, second) = if self.is_wide(region) { (Cut::Across, Cut::Down) } else { (Cut::Down, Cut::Across) };
                self.median(region, first).or_else(|| self.median(region, second))
            }
            Rule::Variance => {
                let cuts = [Cut::Across, Cut::Down].map(|cut| self.least_variance(region, cut));
                let [across, down] = cuts;
                match (across, down) {
                    (Some(a), Some(b)) => Some(if a.1 <= b.1 { a.0 } else { b.0 }),
                    (one, other) => one.or(other).map(|(parts, _)| parts),
                }
            }
        }
    }

    /// Debevec 2005: the longest dimension, a region's width counted as that of its middle row on the sphere.
    fn is_wide(&self, region: Rectangle) -> bool {
        let texel = std::f64::consts::PI / self.whole.bottom as f64;
        let latitude = std::f64::consts::FRAC_PI_2 - 0.5 * (region.top + region.bottom) as f64 * texel;
        let turn = 2.0 * std::f64::consts::PI / self.whole.right as f64;
        region.length(Cut::Across) as f64 * turn * latitude.cos() >= region.length(Cut::Down) as f64 * texel
    }

    /// The cut that comes closest to halving the energy.
    fn median(&self, region: Rectangle, cut: Cut) -> Option<(Rectangle, Rectangle)> {
        let half = 0.5 * self.table.sum(region).energy;
        let before = |at: usize| self.table.sum(region.divided(cut, at).0).energy;
        self.best(region, cut, |at| before(at) < half, |at| (before(at) - half).abs()).map(|(parts, _)| parts)
    }

    /// The cut with the least of the larger of the two variances (Viriyothai & Debevec 2009, step 2), and that variance.
    fn least_variance(&self, region: Rectangle, cut: Cut) -> Option<((Rectangle, Rectangle), f64)> {
        let variances = |at: usize| {
            let (a, b) = region.divided(cut, at);
            (self.table.sum(a).variance(), self.table.sum(b).variance())
        };
        self.best(region, cut, |at| variances(at).0 < variances(at).1, |at| variances(at).0.max(variances(at).1))
    }

    /// The place with the least `cost`. Light on one side grows with the place and shrinks on the other, and so do energy and
    /// variance: `is_before` holds up to a place and no further, and the least cost lies on either side of it.
    fn best(
        &self,
        region: Rectangle,
        cut: Cut,
        is_before: impl Fn(usize) -> bool,
        cost: impl Fn(usize) -> f64,
    ) -> Option<((Rectangle, Rectangle), f64)> {
        let length = region.length(cut);
        let (mut low, mut high) = (1, length);
        while low < high {
            let middle = usize::midpoint(low, high);
            if is_before(middle) { low = middle + 1 } else { high = middle }
        }
        let holds_light = |part: Rectangle| {
            let Moments { energy, .. } = self.table.sum(part);
            energy > self.least_energy
        };
        [low.saturating_sub(1), low]
            .into_iter()
            .filter(|at| (1..length).contains(at))
            .map(|at| (region.divided(cut, at), cost(at)))
            .filter(|((a, b), _)| holds_light(*a) && holds_light(*b))
            .min_by(|(_, a), (_, b)| a.total_cmp(b))
    }
}
