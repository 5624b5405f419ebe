//! k-means of directions on the sphere, by distance along the chord.

use glam::{DVec3, Vec3};

use super::direct::Directions;

/// Rounds of assigning and averaging, at most; from the last frame's centres two or three are enough.
const MOST_ROUNDS: usize = 16;
/// Squared chord up to which directions count as one: a thousandth of a radian, well below a texel.
const SAME: f32 = 1e-6;
/// Largest squared chord.
const LARGEST: f32 = 4.0;
/// Directions that are compared side by side.
const RUN: usize = 64;

/// A cluster's centre. `id` stays with it from frame to frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Centre {
    pub(super) id: u32,
    pub(super) direction: Vec3,
}

/// Clusters; buffers are reused.
#[derive(Default)]
pub(super) struct Clusters {
    pub(super) centres: Vec<Centre>,
    next_id: u32,
    labels: Vec<u8>,
    distances: Vec<f32>,
    sums: Vec<(DVec3, u32)>,
}

impl Clusters {
    /// Buffers for `samples` samples in `count` clusters.
    pub(super) fn new(samples: usize, count: usize) -> Self {
        Self {
            centres: Vec::with_capacity(count),
            next_id: 0,
            labels: Vec::with_capacity(samples),
            distances: Vec::with_capacity(samples),
            sums: Vec::with_capacity(count),
        }
    }

    /// Clusters the samples into at most `count` clusters, and fewer only where there are fewer directions. The centres of the
    /// last call are the seeds (Rohmer et al. 2015, Section 4.3, after Dong et al. 2009); those that no sample is near to any
    /// more make room for new ones.
    pub(super) fn find(&mut self, samples: &Directions, count: usize) {
        self.assign(samples);
        self.drop_empty();
        self.seed(samples, count);
        for _ in 0..MOST_ROUNDS {
            let moved = self.average(samples);
            if !moved {
                break;
            }
            self.assign(samples);
        }
    }

    /// Adds centres until there are `count`: each at the sample where the squared distances to the nearest centre, summed
    /// over the samples, pass a fraction of their total. That is the rule of k-means++ (Arthur & Vassilvitskii 2007) with the
    /// van der Corput sequence in the place of chance.
    fn seed(&mut self, samples: &Directions, count: usize) {
        let Self { centres, distances, .. } = self;
        distances.clear();
        distances.extend((0..samples.len()).map(|i| {
            let to_all = centres.iter().map(|centre| centre.direction.distance_squared(samples.get(i)));
            apart(to_all.fold(LARGEST, f32::min))
        }));
        for n in 1.. {
            let total: f64 = self.distances.iter().map(|d| f64::from(*d)).sum();
            if self.centres.len() >= count || total <= 0.0 {
                break;
            }
            let mut remaining = radical_inverse(n, 2) * total;
            let passed = |distance: &f32| {
                remaining -= f64::from(*distance);
                remaining <= 0.0 && *distance > 0.0
            };
            let Some(chosen) = self.distances.iter().position(passed) else { break };
            let direction = samples.get(chosen);
            self.centres.push(Centre { id: self.next_id, direction });
            self.next_id = self.next_id.wrapping_add(1);
            for (i, distance) in self.distances.iter_mut().enumerate() {
                *distance = apart(distance.min(direction.distance_squared(samples.get(i))));
            }
        }
        self.assign(samples);
    }

    fn assign(&mut self, samples: &Directions) {
        assign(samples, &self.centres, &mut self.labels);
    }

    fn drop_empty(&mut self) {
        let mut used = [false; 256];
        self.labels.iter().for_each(|label| used[usize::from(*label)] = true);
        let mut index = 0..;
        self.centres.retain(|_| index.next().is_some_and(|i: usize| used[i & 255]));
    }

    /// Moves every centre to the mean of its samples; says whether one moved.
    fn average(&mut self, samples: &Directions) -> bool {
        self.sums.clear();
        self.sums.resize(self.centres.len(), (DVec3::ZERO, 0));
        for (i, label) in self.labels.iter().enumerate() {
            if let Some((sum, count)) = self.sums.get_mut(usize::from(*label)) {
                *sum += samples.get(i).as_dvec3();
                *count += 1;
            }
        }
        let mut moved = false;
        for (centre, (sum, _)) in self.centres.iter_mut().zip(&self.sums) {
            let mean = sum.as_vec3().try_normalize().unwrap_or(centre.direction);
            moved |= mean.distance_squared(centre.direction) > SAME * SAME;
            centre.direction = mean;
        }
        moved
    }
}

/// A squared distance, 0 for directions that are the same.
fn apart(squared: f32) -> f32 {
    if squared <= SAME { 0.0 } else { squared }
}

/// Writes the index of the nearest centre of every direction; there are at most 256 centres. With none, all are 0.
pub(super) fn assign(directions: &Directions, centres: &[Centre], labels: &mut Vec<u8>) {
    labels.clear();
    labels.resize(directions.len(), 0);
    let Directions { x, y, z } = directions;
    for (((labels, x), y), z) in labels.chunks_mut(RUN).zip(x.chunks(RUN)).zip(y.chunks(RUN)).zip(z.chunks(RUN)) {
        let (mut best, mut index) = ([f32::NEG_INFINITY; RUN], [0u32; RUN]);
        for (centre, i) in centres.iter().zip(0u32..) {
            let c = centre.direction;
            for ((((best, index), x), y), z) in best.iter_mut().zip(&mut index).zip(x).zip(y).zip(z) {
                let cosine = c.x * x + c.y * y + c.z * z;
                *index = if cosine > *best { i } else { *index };
                *best = if cosine > *best { cosine } else { *best };
            }
        }
        labels.iter_mut().zip(index).for_each(|(label, index)| *label = index as u8);
    }
}

/// The van der Corput sequence: the digits of `n` mirrored at the point, in [0, 1).
pub(super) fn radical_inverse(mut n: u32, base: u32) -> f64 {
    let (mut value, mut place) = (0.0, 1.0);
    while n > 0 {
        place /= f64::from(base);
        value += f64::from(n % base) * place;
        n /= base;
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    fn directions(list: &[Vec3]) -> Directions {
        let mut directions = Directions::default();
        list.iter().for_each(|d| directions.push(d.normalize()));
        directions
    }

    /// `count` directions around each of these.
    fn around(centres: &[Vec3], count: usize) -> Directions {
        let ring = |k: usize| Vec3::new((k as f32).sin(), (k as f32 * 0.7).cos(), (k as f32 * 1.3).sin()) * 0.05;
        directions(&centres.iter().flat_map(|c| (0..count).map(|k| *c + ring(k))).collect::<Vec<_>>())
    }

    #[test]
    fn groups_are_found_wherever_they_lie() {
        // One of them at the seam, where longitudes jump, and one at the zenith.
        let groups = [Vec3::Z, Vec3::Y, Vec3::X, Vec3::new(-1.0, -1.0, 0.3).normalize()];
        let mut clusters = Clusters::new(400, 4);
        clusters.find(&around(&groups, 100), 4);
        assert_eq!(clusters.centres.len(), 4);
        for group in groups {
            assert!(clusters.centres.iter().any(|centre| centre.direction.distance(group) < 0.02), "{group}: {:?}", clusters.centres);
        }
    }

    #[test]
    fn there_are_never_more_clusters_than_directions() {
        let mut clusters = Clusters::new(8, 5);
        clusters.find(&directions(&[Vec3::X, Vec3::X, Vec3::X, Vec3::Y]), 5);
        assert_eq!(clusters.centres.len(), 2);
        // Less than a texel away is the same direction.
        clusters.find(&directions(&[Vec3::new(1.0, 0.0, 1e-4), Vec3::Y]), 5);
        assert_eq!(clusters.centres.len(), 2);
        clusters.find(&Directions::default(), 5);
        assert_eq!(clusters.centres.len(), 0);
        clusters.find(&directions(&[Vec3::Z]), 5);
        assert_eq!(clusters.centres.len(), 1);
    }

    #[test]
    fn poor_seeds_do_not_last() {
        let at = |angle: f32| Vec3::new(angle.sin(), 0.0, -angle.cos());
        let mut clusters = Clusters::new(101, 2);
        clusters.find(&directions(&[at(0.0), at(0.1)]), 2);
        // Along an arc of 1, the border between two clusters goes half of the way to the middle in every round.
        clusters.find(&directions(&(0..=100).map(|i| at(i as f32 / 100.0)).collect::<Vec<_>>()), 2);
        for middle in [0.25, 0.75] {
            assert!(clusters.centres.iter().any(|centre| centre.direction.distance(at(middle)) < 0.02), "{:?}", clusters.centres);
        }
    }

    #[test]
    fn identities_follow_the_groups() {
        let mut clusters = Clusters::new(300, 3);
        let at = |angle: f32| Vec3::new(angle.sin(), 0.4, -angle.cos()).normalize();
        clusters.find(&around(&[at(0.0), at(1.5), Vec3::NEG_Y], 100), 3);
        let first = clusters.centres.clone();
        for step in 1..20 {
            let angle = step as f32 * 0.05;
            clusters.find(&around(&[at(angle), at(1.5 + angle), Vec3::NEG_Y], 100), 3);
            let ids = |centres: &[Centre]| centres.iter().map(|centre| centre.id).collect::<Vec<_>>();
            assert_eq!(ids(&clusters.centres), ids(&first));
            for centre in &clusters.centres {
                assert!([at(angle), at(1.5 + angle), Vec3::NEG_Y].iter().any(|group| group.distance(centre.direction) < 0.03));
            }
        }
        // A group that goes loses its identity, one that comes beside another gets a new one.
        clusters.find(&around(&[at(0.95), Vec3::NEG_Y, Vec3::new(0.5, -1.0, 0.0).normalize()], 100), 3);
        let kept = clusters.centres.iter().filter(|centre| first.iter().any(|old| old.id == centre.id)).count();
        assert_eq!((clusters.centres.len(), kept), (3, 2), "{:?} {first:?}", clusters.centres);
    }

    #[test]
    fn radical_inverses_are_mirrored_digits() {
        assert_eq!([0, 1, 2, 3, 4, 6].map(|n| radical_inverse(n, 2)), [0.0, 0.5, 0.25, 0.75, 0.125, 0.375]);
        assert!((radical_inverse(5, 3) - (2.0 / 3.0 + 1.0 / 9.0)).abs() < 1e-15);
    }
}
