//! Light probe sampling by cuts: the panorama is divided into regions, and each becomes a light at the centroid of its
//! energy.
//!
//! Median cut (Debevec 2005, "A Median Cut Algorithm for Light Probe Sampling") halves the energy along a region's
//! longest dimension. Variance cut (Viriyothai & Debevec 2009, "Variance Minimization Light Probe Sampling") cuts where
//! the larger variance of the two parts is least, so that a source is not cut in two. Differences from both: centroids
//! and distances are those of directions instead of pixels, so that they hold at the seam and at the poles, and
//! any number of lights is possible, see [`partition`].
//!
//! All energy goes to the lights and the SH are zero: an even sky is as many lights as were asked for. Radiance is
//! display-linear.

mod partition;
mod table;

use glam::Vec3;
use mr360_protocol::light::{Lift, MAX_LIGHTS, SH9};
use mr360_shaders::colour::LUMA;

use self::partition::Divider;
use self::table::{Rectangle, SummedArea};
use super::light_sum::{LightSum, rank};
use super::panorama::Panorama;
use super::sampling::Grid;
use super::{Estimate, LightError, LightMethod, StepTimes};
use crate::frame::Frame;

/// Working panorama.
const SIZE: Grid = Grid { width: 512, height: 256, supersample: 2 };
/// Values that are summed side by side.
const LANES: usize = 8;

/// Where a region is cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Rule {
    /// Into halves of equal energy.
    Median,
    /// Where the larger variance of the parts is least.
    Variance,
}

/// The methods; see the module.
pub(super) struct LightCuts {
    name: String,
    rule: Rule,
    count: usize,
    panorama: Panorama,
    table: SummedArea,
    regions: Vec<Rectangle>,
    estimate: Estimate,
}

impl LightCuts {
    /// The method with `count` lights, at most [`MAX_LIGHTS`].
    pub(super) fn new(rule: Rule, count: usize) -> Self {
        let name = match rule {
            Rule::Median => "median-cut",
            Rule::Variance => "variance-cut",
        };
        Self {
            name: format!("{name}:{count}"),
            rule,
            count: count.clamp(1, MAX_LIGHTS),
            panorama: Panorama::new(SIZE, Lift::Linear),
            table: SummedArea::default(),
            regions: Vec::with_capacity(MAX_LIGHTS),
            estimate: Estimate { lights: Vec::with_capacity(MAX_LIGHTS), ..Estimate::default() },
        }
    }

    fn find_lights(&mut self) {
        let Self { panorama, table, regions, estimate, .. } = self;
        let measured =
            regions.iter().zip(0..).filter_map(|(region, id)| measure(panorama, table, *region).light(id, centre(panorama, *region)));
        estimate.lights.clear();
        estimate.lights.extend(measured);
        rank(&mut estimate.lights);
        estimate.lights.iter_mut().zip(0..).for_each(|(light, id)| light.id = id);
    }
}

impl LightMethod for LightCuts {
    fn name(&self) -> &str {
        &self.name
    }

    fn estimate(&mut self, frame: &Frame, steps: &mut StepTimes) -> Result<&Estimate, LightError> {
        steps.time("sample", || self.panorama.take(frame))?;
        steps.time("table", || self.table.fill(&self.panorama));
        steps.time("regions", || {
            let divider = Divider::new(&self.table, SIZE.width as usize, SIZE.height as usize);
            divider.divide(self.rule, self.count, &mut self.regions);
        });
        steps.time("lights", || self.find_lights());
        self.estimate.take_over(&self.panorama, &[Vec3::ZERO; SH9]);
        Ok(&self.estimate)
    }
}

/// Light of a region: its energy is summed from the texels, so that no rounding of the table enters it.
fn measure(panorama: &Panorama, table: &SummedArea, region: Rectangle) -> LightSum {
    let mut sum = LightSum { moment: table.sum(region).moment, ..LightSum::default() };
    for row in region.top..region.bottom {
        let [red, green, blue] = [0, 1, 2].map(|channel| &panorama.row(channel, row)[region.left..region.right]);
        let [r, g, b, squares] = row_sums(red, green, blue);
        let solid_angle_sr = f64::from(panorama.geometry.solid_angle_sr[row]);
        sum.irradiance += glam::DVec3::new(r, g, b) * solid_angle_sr;
        sum.concentration += squares * solid_angle_sr;
    }
    sum
}

/// Sums of red, green, blue and squared luminance. Side-by-side sums let the compiler add several at a time.
fn row_sums(red: &[f32], green: &[f32], blue: &[f32]) -> [f64; 4] {
    let mut lanes = [[0.0f32; LANES]; 4];
    let (reds, greens, blues) = (red.chunks_exact(LANES), green.chunks_exact(LANES), blue.chunks_exact(LANES));
    let rest = reds.remainder().iter().zip(greens.remainder()).zip(blues.remainder());
    let luminance = |r: f32, g: f32, b: f32| LUMA.x * r + LUMA.y * g + LUMA.z * b;
    let mut sums = rest.fold([0.0; 4], |[sr, sg, sb, sq], ((r, g), b)| {
        let y = f64::from(luminance(*r, *g, *b));
        [sr + f64::from(*r), sg + f64::from(*g), sb + f64::from(*b), sq + y * y]
    });
    for ((r, g), b) in reds.zip(greens).zip(blues) {
        for i in 0..LANES {
            let y = luminance(r[i], g[i], b[i]);
            lanes[0][i] += r[i];
            lanes[1][i] += g[i];
            lanes[2][i] += b[i];
            lanes[3][i] += y * y;
        }
    }
    for (sum, lanes) in sums.iter_mut().zip(lanes) {
        *sum += lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>();
    }
    sums
}

/// Direction of a region's middle.
fn centre(panorama: &Panorama, region: Rectangle) -> Vec3 {
    panorama.geometry.direction((region.top + region.bottom) / 2, (region.left + region.right) / 2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::test_skies::{Disc, estimate_with, irradiance, normals, sky};
    use glam::DVec3;
    use mr360_protocol::video::Transfer;

    const RULES: [Rule; 2] = [Rule::Median, Rule::Variance];

    /// The method after it has seen a linear sky.
    fn seen(rule: Rule, count: usize, background: Vec3, discs: &[Disc]) -> LightCuts {
        let mut cuts = LightCuts::new(rule, count);
        estimate_with(&mut cuts, &sky(Transfer::Linear, background, discs));
        cuts
    }

    #[test]
    fn regions_cover_every_texel_once() {
        for (rule, count) in RULES.into_iter().flat_map(|rule| [1, 2, 5, 16, 37, 64].map(|count| (rule, count))) {
            let cuts = seen(rule, count, Vec3::splat(0.2), &[Disc::at(170.0, 60.0, 8.0, Vec3::splat(9.0))]);
            assert_eq!(cuts.regions.len(), count, "{rule:?}");
            let mut covered = vec![0; 512 * 256];
            for region in &cuts.regions {
                for row in region.top..region.bottom {
                    covered[row * 512 + region.left..row * 512 + region.right].iter_mut().for_each(|n| *n += 1);
                }
            }
            assert!(covered.iter().all(|n| *n == 1), "{rule:?}:{count}");
        }
    }

    #[test]
    fn the_median_halves_the_energy() {
        let cuts = seen(Rule::Median, 16, Vec3::splat(0.5), &[Disc::at(20.0, 40.0, 30.0, Vec3::splat(3.0))]);
        let energies: Vec<f64> = cuts.regions.iter().map(|region| cuts.table.sum(*region).energy).collect();
        let mean = energies.iter().sum::<f64>() / 16.0;
        // Every cut may be half a row or column of texels off: 1/60 of a region that is no narrower than 30 texels, four times.
        assert!(energies.iter().all(|energy| (energy / mean - 1.0).abs() < 4.0 / 60.0), "{energies:?}");
    }

    #[test]
    fn the_most_energetic_regions_are_cut_again_where_the_number_is_no_power_of_two() {
        let discs = [Disc::at(90.0, 30.0, 10.0, Vec3::splat(30.0))];
        let (four, five) = (seen(Rule::Median, 4, Vec3::ONE, &discs), seen(Rule::Median, 5, Vec3::ONE, &discs));
        let energy = |cuts: &LightCuts, region: &Rectangle| cuts.table.sum(*region).energy;
        let gone: Vec<_> = four.regions.iter().filter(|region| !five.regions.contains(region)).collect();
        let most = four.regions.iter().map(|region| energy(&four, region)).fold(0.0, f64::max);
        assert!(gone.len() == 1 && energy(&four, gone[0]) >= most, "{gone:?}");
    }

    #[test]
    fn a_regions_width_is_that_on_the_sphere() {
        // Light around the zenith: a quarter of the turn is 1.6 wide in the picture but 0.1 on the sphere, so rows are cut.
        let cuts = seen(Rule::Median, 16, Vec3::ZERO, &[Disc::at(0.0, 90.0, 10.0, Vec3::ONE)]);
        assert!(cuts.regions.iter().all(|region| region.right - region.left == 128), "{:?}", cuts.regions);
    }

    #[test]
    fn variance_keeps_two_unequal_sources_whole_where_the_median_cuts_the_stronger() {
        // Viriyothai & Debevec 2009, Figure 2.
        let discs = [Disc::at(-60.0, 30.0, 6.0, Vec3::splat(30.0)), Disc::at(50.0, 35.0, 6.0, Vec3::splat(10.0))];
        let median = seen(Rule::Median, 2, Vec3::ZERO, &discs);
        let variance = seen(Rule::Variance, 2, Vec3::ZERO, &discs);
        for (light, disc) in variance.estimate.lights.iter().zip(discs) {
            assert!((light.direction - disc.centre).length().to_degrees() < 0.2, "{light:?}");
            assert!(((light.irradiance - disc.energy()) / disc.energy()).abs().max_element() < 0.01, "{light:?}");
        }
        assert!(median.estimate.lights.iter().all(|light| (light.direction - discs[1].centre).length().to_degrees() > 2.0));
    }

    #[test]
    fn variance_is_the_least_that_any_place_gives() {
        // The search by halves against the search of every place.
        let discs = [Disc::at(-100.0, 10.0, 20.0, Vec3::splat(4.0)), Disc::at(50.0, -35.0, 9.0, Vec3::splat(10.0))];
        let cuts = seen(Rule::Variance, 2, Vec3::splat(0.3), &discs);
        let larger = |a: Rectangle, b: Rectangle| cuts.table.sum(a).variance().max(cuts.table.sum(b).variance());
        let whole = Rectangle { top: 0, bottom: 256, left: 0, right: 512 };
        let columns = (1..512).map(|at| larger(Rectangle { right: at, ..whole }, Rectangle { left: at, ..whole }));
        let rows = (1..256).map(|at| larger(Rectangle { bottom: at, ..whole }, Rectangle { top: at, ..whole }));
        let least = columns.chain(rows).fold(f64::MAX, f64::min);
        assert!(larger(cuts.regions[0], cuts.regions[1]) <= least * (1.0 + 1e-9));
    }

    #[test]
    fn irradiance_is_within_the_bound_of_the_regions() {
        // A region gives Σ w max(0, d·n), its light W max(0, c·n), c = M/|M|, with W = Σ w and M = Σ w d. As max(0, x) is
        // convex, Σ w max(0, d·n) ≥ max(0, M·n); as it is (x + |x|)/2 and Σ w |x| ≤ √(W Σ w x²), it is at most
        // (M·n + √(W Σ w (d·n)²))/2. The light exceeds max(0, M·n) by (W − |M|) max(0, c·n).
        for (rule, count, worst) in RULES.into_iter().flat_map(|rule| [(rule, 4, 0.9), (rule, 16, 0.2), (rule, 64, 0.03)]) {
            let cuts = seen(rule, count, Vec3::ONE, &[]);
            let truth = f64::from(std::f32::consts::PI);
            for normal in normals(100) {
                let n = normal.as_dvec3();
                let (mut above, mut below) = (0.0, 0.0);
                for region in &cuts.regions {
                    let sum = cuts.table.sum(*region);
                    let squares: f64 = directions(&cuts.panorama, *region).map(|(d, w)| w * d.dot(n).powi(2)).sum();
                    let (facing, length) = (sum.moment.dot(n), sum.moment.length());
                    above += (sum.energy - length) * (facing / length).max(0.0);
                    below += 0.5 * (facing + (sum.energy * squares).sqrt()) - facing.max(0.0);
                }
                let error = f64::from(irradiance(&cuts.estimate, normal).y) - truth;
                assert!(error <= above + 1e-3 && -error <= below + 1e-3, "{rule:?}:{count} {normal}: {error}, {above}, {below}");
                assert!(error.abs() < worst * truth, "{rule:?}:{count} {normal}: {error}");
            }
        }
    }

    fn directions(panorama: &Panorama, region: Rectangle) -> impl Iterator<Item = (DVec3, f64)> + '_ {
        let rows = region.top..region.bottom;
        rows.flat_map(move |row| (region.left..region.right).map(move |column| (row, column)))
            .map(|(row, column)| (panorama.geometry.direction(row, column).as_dvec3(), f64::from(panorama.geometry.solid_angle_sr[row])))
    }
}
