//! Virtual area lights by k-means (Rohmer et al. 2015, Sections 4.2 to 4.4), on the panorama instead of a radiance atlas.
//!
//! What stands out is direct light ([`direct`]). Samples of it, drawn in proportion to its luminance, are grouped by their
//! directions ([`clusters`]); every direct texel is then added to the light of its nearest cluster (Eq. 6), and the rest
//! becomes SH (Eq. 9). Clusters begin where those of the last frame ended, so lights move with what they stand for and keep
//! their identity. The samples are those of a fixed sequence: the same frames give the same light. Radiance is display-linear.

mod clusters;
mod direct;

use mr360_protocol::light::{Lift, MAX_LIGHTS, SH9};

use self::clusters::{Clusters, assign, radical_inverse};
use self::direct::{DirectTexels, Directions};
use super::light_sum::{LightSum, rank};
use super::panorama::Panorama;
use super::sampling::Grid;
use super::series::Series;
use super::{Estimate, LightError, LightMethod, StepTimes};
use crate::frame::Frame;

/// Working panorama.
const SIZE: Grid = Grid { width: 512, height: 256, supersample: 2 };
/// Samples of a frame: 16 a light where there are as many lights as the wire takes.
const SAMPLES: u32 = 1024;

/// The method; see the module.
pub(super) struct KMeans {
    name: String,
    count: usize,
    panorama: Panorama,
    series: Series,
    direct: DirectTexels,
    samples: Directions,
    clusters: Clusters,
    labels: Vec<u8>,
    sums: Vec<LightSum>,
    estimate: Estimate,
}

impl KMeans {
    /// The method with `count` lights, at most [`MAX_LIGHTS`].
    pub(super) fn new(count: usize) -> Self {
        let texels = (SIZE.width * SIZE.height) as usize;
        Self {
            name: format!("k-means:{count}"),
            count: count.clamp(1, MAX_LIGHTS),
            panorama: Panorama::new(SIZE, Lift::Linear),
            series: Series::new(SIZE, SH9),
            direct: DirectTexels::new(texels, SIZE.height as usize),
            samples: Directions::with_capacity(SAMPLES as usize),
            clusters: Clusters::new(SAMPLES as usize, MAX_LIGHTS),
            labels: Vec::with_capacity(texels),
            sums: Vec::with_capacity(MAX_LIGHTS),
            estimate: Estimate { lights: Vec::with_capacity(MAX_LIGHTS), ..Estimate::default() },
        }
    }

    /// Adds up the direct texels of every cluster.
    fn find_lights(&mut self) {
        let Self { direct, clusters, labels, sums, estimate, .. } = self;
        assign(&direct.directions, &clusters.centres, labels);
        sums.clear();
        sums.resize(clusters.centres.len(), LightSum::default());
        for (i, label) in labels.iter().enumerate() {
            if let Some(sum) = sums.get_mut(usize::from(*label)) {
                sum.add(direct.radiance[i], f64::from(direct.solid_angle_sr[i]), direct.directions.get(i));
            }
        }
        estimate.lights.clear();
        let lights = sums.iter().zip(&clusters.centres).filter_map(|(sum, centre)| sum.light(centre.id, centre.direction));
        estimate.lights.extend(lights);
        rank(&mut estimate.lights);
    }
}

impl LightMethod for KMeans {
    fn name(&self) -> &str {
        &self.name
    }

    fn estimate(&mut self, frame: &Frame, steps: &mut StepTimes) -> Result<&Estimate, LightError> {
        steps.time("sample", || self.panorama.take(frame))?;
        steps.time("threshold", || self.direct.take_out_of(&mut self.panorama));
        steps.time("clusters", || {
            draw(&self.direct, &mut self.samples);
            self.clusters.find(&self.samples, self.count);
        });
        steps.time("lights", || self.find_lights());
        steps.time("sh", || self.estimate.project(&self.panorama, &self.series));
        Ok(&self.estimate)
    }
}

/// Draws [`SAMPLES`] directions of direct light by the inverse of its distribution (Section 4.3): a row by the light of the
/// rows, then a texel by the light within the row. The points are Hammersley's.
fn draw(direct: &DirectTexels, samples: &mut Directions) {
    samples.clear();
    let up_to = |texels: usize| if texels == 0 { 0.0 } else { direct.cumulative[texels - 1] };
    let total = up_to(direct.cumulative.len());
    if total <= 0.0 {
        return;
    }
    let mut row = 0;
    for i in 0..SAMPLES {
        // The first coordinate only grows, so the row is found by going on from the last one.
        let at = (f64::from(i) + 0.5) / f64::from(SAMPLES) * total;
        while row + 1 < direct.row_ends.len() && up_to(direct.row_ends[row]) <= at {
            row += 1;
        }
        let (first, end) = (if row == 0 { 0 } else { direct.row_ends[row - 1] }, direct.row_ends[row]);
        let (before, after) = (up_to(first), up_to(end));
        let target = before + radical_inverse(i, 2) * (after - before);
        let within = direct.cumulative[first..end].partition_point(|light| *light <= target);
        samples.push(direct.directions.get((first + within).min(end - 1)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lighting::test_skies::{Disc, estimate_with, sky};
    use glam::Vec3;
    use mr360_protocol::video::Transfer;

    #[test]
    fn samples_are_as_many_as_the_light_is_strong() {
        let mut panorama = Panorama::new(SIZE, Lift::Linear);
        let mut direct = DirectTexels::new(512 * 256, 256);
        // Two in one row, one in another; no two of them hold the share of direct light.
        for (row, column, share) in [(60, 40, 0.28), (60, 300, 0.32), (150, 7, 0.4)] {
            panorama.set_radiance(row * 512 + column, Vec3::splat(share / panorama.geometry.solid_angle_sr[row]));
        }
        let places = [(60, 40), (60, 300), (150, 7)].map(|(row, column)| panorama.geometry.direction(row, column));
        direct.take_out_of(&mut panorama);
        let mut samples = Directions::default();
        draw(&direct, &mut samples);
        let counts = places.map(|place| (0..samples.len()).filter(|i| samples.get(*i) == place).count());
        // 1024 points of the sequence fill any rectangle to within a few.
        assert!(counts.iter().zip([287usize, 328, 410]).all(|(got, expected)| got.abs_diff(expected) <= 6), "{counts:?}");
    }

    #[test]
    fn lights_keep_their_ids_while_they_move() {
        let discs = |step: u16| {
            let shift = f32::from(step) * 3.0;
            [
                Disc::at(170.0 + shift, 30.0, 3.0, Vec3::splat(60.0)),
                Disc::at(-40.0, 80.0, 3.0, Vec3::splat(58.0)),
                Disc::at(60.0, -20.0, 3.0, Vec3::splat(56.0)),
            ]
        };
        let mut method = KMeans::new(3);
        let mut ids = None;
        // The first passes the seam at 180°.
        for step in 0..8 {
            let estimate = estimate_with(&mut method, &sky(Transfer::Linear, Vec3::splat(0.01), &discs(step)));
            let now = discs(step).map(|disc| {
                let mut near = estimate.lights.iter().filter(|light| (light.direction - disc.centre).length().to_degrees() < 0.3);
                near.next().map(|light| light.id)
            });
            assert!(now.iter().all(Option::is_some) && estimate.lights.len() == 3, "{step}: {estimate:?}");
            assert_eq!(*ids.get_or_insert(now), now, "{step}");
        }
    }

    #[test]
    fn a_light_that_goes_out_gives_its_place_away() {
        let (a, b) = (Disc::at(-60.0, 40.0, 3.0, Vec3::splat(50.0)), Disc::at(80.0, 10.0, 3.0, Vec3::splat(30.0)));
        let mut method = KMeans::new(2);
        let both = estimate_with(&mut method, &sky(Transfer::Linear, Vec3::splat(0.01), &[a, b]));
        let moved = Disc::at(-170.0, -40.0, 3.0, Vec3::splat(30.0));
        let after = estimate_with(&mut method, &sky(Transfer::Linear, Vec3::splat(0.01), &[a, moved]));
        assert_eq!(after.lights[0].id, both.lights[0].id);
        assert!((after.lights[1].direction - moved.centre).length().to_degrees() < 0.3, "{after:?}");
    }
}
