//! Projection of a working panorama onto the spherical harmonics, exact for texels of even radiance.
//!
//! Along a row the latitude is constant, so each basis function of band l is a trigonometric polynomial of the longitude
//! of degree l. A row is reduced to its moments against 1, sin mλ and cos mλ; what each moment gives to each
//! coefficient is integrated once, over the rows' height and the texels' width. No error of quadrature is left: an even
//! sky has no other coefficient than the first.

use std::f64::consts::{PI, TAU};

use glam::{DVec3, Vec3};
use mr360_protocol::light::{SH9, SH25};
use mr360_shaders::sh::basis25;
use pulp::{Arch, Simd, WithSimd};

use super::panorama::Panorama;
use super::radiance::Planes;
use super::sampling::Grid;

/// 1, and sin mλ and cos mλ for every m up to 4.
const MOST_MOMENTS: usize = 9;
/// Moments that a basis function may have.
const MOMENTS_OF_EACH: usize = 3;
/// Longitudes at which a basis function is read to find its polynomial: twice the highest degree and one more would do.
const READINGS: usize = 16;
/// Nodes and weights of Gauss and Legendre's rule over [−1, 1].
const GAUSS: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
];

/// Tables for one size of panorama.
pub(super) struct Series {
    arch: Arch,
    /// sin λ, cos λ, sin 2λ, cos 2λ and so on, each at the centres of the first quarter of the columns.
    harmonics: Vec<Vec<f32>>,
    /// For each row, what every coefficient gets of its first moment, then of its second and its third.
    weights: Vec<f64>,
    /// Moments of each coefficient. A basis function is even or odd in x and even or odd in z, and so are the harmonics: sin λ and sin 3λ,
    /// cos λ and cos 3λ, sin 2λ and sin 4λ, and 1, cos 2λ and cos 4λ.
    moments: [[usize; SH25]; MOMENTS_OF_EACH],
    coefficients: usize,
}

impl Series {
    /// Tables for the first `coefficients`, at most 25, of a panorama of this size, whose width is a multiple of four.
    pub(super) fn new(size: Grid, coefficients: usize) -> Self {
        let (degree, depth) = if coefficients <= SH9 { (2, SH9) } else { (4, SH25) };
        let longitude = |column: u32| ((f64::from(column) + 0.5) / f64::from(size.width) - 0.5) * TAU;
        let harmonic = |k: usize| (0..size.width / 4).map(|column| moment_basis(k, longitude(column)) as f32).collect();
        let harmonics = (1..=2 * degree).map(harmonic).collect();
        let of_rows: Vec<_> = (0..size.height).map(|row| row_weights(size, row)).collect();
        let mut moments = [[0; SH25]; MOMENTS_OF_EACH];
        for i in 0..depth {
            // All others are zero but for rounding.
            let mut by_weight: [usize; MOST_MOMENTS] = std::array::from_fn(|k| k);
            let whole = |k: usize| of_rows.iter().map(|weights| weights[k][i].abs()).sum::<f64>();
            by_weight.sort_by(|a, b| whole(*b).total_cmp(&whole(*a)));
            moments.iter_mut().zip(by_weight).for_each(|(moments, k)| moments[i] = k);
        }
        let of_row = |row: &[[f64; SH25]; MOST_MOMENTS]| moments.map(|moments| std::array::from_fn::<_, SH25, _>(|i| row[moments[i]][i]));
        let weights = of_rows.iter().flat_map(|row| of_row(row).into_iter().flat_map(|weights| weights.into_iter().take(depth))).collect();
        Self { arch: Arch::new(), harmonics, weights, moments, coefficients: coefficients.min(SH25) }
    }

    /// How many coefficients the tables are for.
    pub(super) fn coefficients(&self) -> usize {
        self.coefficients
    }

    /// Writes the coefficients of the panorama's radiance into `sh`, which is as long as the tables are deep.
    pub(super) fn project(&self, panorama: &Panorama, sh: &mut [Vec3]) {
        self.project_planes(&panorama.channels, sh);
    }

    /// The same for any three planes of the size that the tables are for.
    pub(super) fn project_planes(&self, planes: &Planes, sh: &mut [Vec3]) {
        self.arch.dispatch(Project { series: self, planes, sh });
    }

    /// Coefficients of a plane of which only these rows are not zero; as many as the tables are deep.
    pub(super) fn project_rows<'a>(&self, rows: impl Iterator<Item = (usize, &'a [f32])>) -> [f64; SH25] {
        let mut sums = [0.0; SH25];
        for (row, values) in rows {
            self.arch.dispatch(AddRow { series: self, row, values, sums: &mut sums });
        }
        sums
    }

    /// Columns of a row.
    fn width(&self) -> usize {
        4 * self.harmonics.first().map_or(0, Vec::len)
    }
}

/// [`Series::project_planes`] for whatever vectors there are.
struct Project<'a> {
    series: &'a Series,
    planes: &'a Planes,
    sh: &'a mut [Vec3],
}

impl WithSimd for Project<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if self.series.coefficients <= SH9 { self.run::<S, 5, SH9>(simd) } else { self.run::<S, 9, SH25>(simd) }
    }
}

impl Project<'_> {
    #[inline(always)]
    fn run<S: Simd, const MOMENTS: usize, const DEPTH: usize>(self, simd: S) {
        let mut sums = [[0.0f64; DEPTH]; 3];
        let width = self.series.width();
        for (channel, sums) in self.planes.iter().zip(&mut sums) {
            for (row, values) in channel.chunks_exact(width).enumerate() {
                self.series.add_row::<S, MOMENTS, DEPTH>(simd, row, values, sums);
            }
        }
        for (i, out) in self.sh.iter_mut().take(DEPTH.min(self.series.coefficients)).enumerate() {
            *out = DVec3::from_array(sums.map(|sums| sums[i])).as_vec3();
        }
    }
}

/// Adds one row to the coefficients of one channel.
struct AddRow<'a> {
    series: &'a Series,
    row: usize,
    values: &'a [f32],
    sums: &'a mut [f64; SH25],
}

impl WithSimd for AddRow<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { series, row, values, sums } = self;
        if series.coefficients <= SH9 {
            if let Some(sums) = sums.first_chunk_mut() {
                series.add_row::<S, 5, SH9>(simd, row, values, sums);
            }
        } else {
            series.add_row::<S, 9, SH25>(simd, row, values, sums);
        }
    }
}

impl Series {
    #[inline(always)]
    fn add_row<S: Simd, const MOMENTS: usize, const DEPTH: usize>(&self, simd: S, row: usize, values: &[f32], sums: &mut [f64; DEPTH]) {
        let Some(weights) = self.weights.as_chunks::<DEPTH>().0.as_chunks::<MOMENTS_OF_EACH>().0.get(row) else { return };
        let of_row = moments::<S, MOMENTS>(simd, values, &self.harmonics);
        for (moments, weights) in self.moments.iter().zip(weights) {
            let mut of_coefficients = [0.0; DEPTH];
            for (moment, k) in of_coefficients.iter_mut().zip(moments) {
                *moment = of_row[*k % MOMENTS];
            }
            for i in 0..DEPTH {
                sums[i] += f64::from(of_coefficients[i]) * weights[i];
            }
        }
    }
}

/// Sums of a row times 1 and times each of the harmonics.
///
/// Columns a quarter of the row apart have the same harmonics but for sign and order: a turn by 90° leaves those of 4λ as they are, reverses
/// those of 2λ and exchanges the sines and cosines of λ and 3λ. So the four are added and subtracted first, and multiplied once.
/// No sum is fused with its product, so that every processor finds the same light.
#[inline(always)]
fn moments<S: Simd, const MOMENTS: usize>(simd: S, row: &[f32], harmonics: &[Vec<f32>]) -> [f32; MOMENTS] {
    let quarter = row.len() / 4;
    let zero = simd.splat_f32s(0.0);
    let (mut whole, mut rest): ([&[S::f32s]; 4], _) = ([&[]; 4], [zero; 4]);
    for i in 0..4 {
        let (vectors, remainder) = S::as_simd_f32s(&row[i * quarter..(i + 1) * quarter]);
        (whole[i], rest[i]) = (vectors, simd.partial_load_f32s(remainder));
    }
    let (mut tables, mut rest_of_tables): ([&[S::f32s]; MOST_MOMENTS], _) = ([&[]; MOST_MOMENTS], [zero; MOST_MOMENTS]);
    for k in 1..MOMENTS {
        let (vectors, remainder) = S::as_simd_f32s(&harmonics[k - 1]);
        (tables[k], rest_of_tables[k]) = (&vectors[..whole[0].len()], simd.partial_load_f32s(remainder));
    }
    let mut sums = [zero; MOST_MOMENTS];
    for vector in 0..whole[0].len() {
        let values = [whole[0][vector], whole[1][vector], whole[2][vector], whole[3][vector]];
        let mut harmonics = [zero; MOST_MOMENTS];
        for k in 1..MOMENTS {
            harmonics[k] = tables[k][vector];
        }
        add_products::<S, MOMENTS>(simd, values, harmonics, &mut sums);
    }
    // Beyond the end are zeros, which add nothing.
    add_products::<S, MOMENTS>(simd, rest, rest_of_tables, &mut sums);
    let mut moments = [0.0; MOMENTS];
    for k in 0..MOMENTS {
        moments[k] = simd.reduce_sum_f32s(sums[k]);
    }
    moments
}

/// Adds the products of four values, each a quarter of the way further on, with the harmonics of the first; that of index 0 is 1.
#[inline(always)]
fn add_products<S: Simd, const MOMENTS: usize>(
    simd: S,
    [a, b, c, d]: [S::f32s; 4],
    harmonics: [S::f32s; MOST_MOMENTS],
    sums: &mut [S::f32s; MOST_MOMENTS],
) {
    let [_, sin, cos, sin_2, cos_2, sin_3, cos_3, sin_4, cos_4] = harmonics;
    let (even, odd) = ((simd.add_f32s(a, c), simd.add_f32s(b, d)), (simd.sub_f32s(a, c), simd.sub_f32s(b, d)));
    let (all, alternating) = (simd.add_f32s(even.0, even.1), simd.sub_f32s(even.0, even.1));
    sums[0] = simd.add_f32s(sums[0], all);
    let (of_sin, of_cos) = turned(simd, odd.0, odd.1, sin, cos);
    sums[1] = simd.add_f32s(sums[1], of_sin);
    sums[2] = simd.add_f32s(sums[2], of_cos);
    sums[3] = simd.add_f32s(sums[3], simd.mul_f32s(alternating, sin_2));
    sums[4] = simd.add_f32s(sums[4], simd.mul_f32s(alternating, cos_2));
    if MOMENTS == MOST_MOMENTS {
        let (of_cos, of_sin) = turned(simd, odd.0, odd.1, cos_3, sin_3);
        sums[5] = simd.add_f32s(sums[5], of_sin);
        sums[6] = simd.add_f32s(sums[6], of_cos);
        sums[7] = simd.add_f32s(sums[7], simd.mul_f32s(all, sin_4));
        sums[8] = simd.add_f32s(sums[8], simd.mul_f32s(all, cos_4));
    }
}

/// Products with one harmonic and with the next, for values of which the second belong a quarter of the way further on:
/// there the first harmonic is what the second is here, and the second is what the first is here, reversed.
#[inline(always)]
fn turned<S: Simd>(simd: S, here: S::f32s, further: S::f32s, first: S::f32s, second: S::f32s) -> (S::f32s, S::f32s) {
    let of_first = simd.add_f32s(simd.mul_f32s(here, first), simd.mul_f32s(further, second));
    let of_second = simd.sub_f32s(simd.mul_f32s(here, second), simd.mul_f32s(further, first));
    (of_first, of_second)
}

/// 1, sin λ, cos λ, sin 2λ, cos 2λ, …
fn moment_basis(k: usize, longitude: f64) -> f64 {
    let angle = k.div_ceil(2) as f64 * longitude;
    if k % 2 == 1 { angle.sin() } else { angle.cos() }
}

/// What each moment of row `row` gives to every coefficient.
fn row_weights(size: Grid, row: u32) -> [[f64; SH25]; MOST_MOMENTS] {
    let half_height = PI / f64::from(size.height) / 2.0;
    let centre = PI / 2.0 - (f64::from(row) + 0.5) * 2.0 * half_height;
    let width = TAU / f64::from(size.width);
    let mut weights = [[0.0; SH25]; MOST_MOMENTS];
    for (node, share) in GAUSS {
        let (y, c) = (centre + node * half_height).sin_cos();
        for reading in 0..READINGS {
            let longitude = reading as f64 / READINGS as f64 * TAU;
            let (sin, cos) = longitude.sin_cos();
            let values = basis25(DVec3::new(c * sin, y, -c * cos).as_vec3());
            for (k, weights) in weights.iter_mut().enumerate() {
                // The mean of sin² or cos² is a half; a texel's integral of either is its value at the centre times this.
                let m = k.div_ceil(2) as f64;
                let across = if k == 0 { width } else { 2.0 * 2.0 * (m * width / 2.0).sin() / m };
                let factor = across * share * half_height * c * moment_basis(k, longitude) / READINGS as f64;
                weights.iter_mut().zip(values).for_each(|(weight, value)| *weight += factor * f64::from(value));
            }
        }
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;
    use mr360_protocol::light::Lift;
    use mr360_shaders::sh::basis9;

    /// 28 columns make quarters of seven, which are no whole number of vectors.
    fn filled(size: Grid) -> Panorama {
        let mut panorama = Panorama::new(size, Lift::Linear);
        for texel in 0..(size.width * size.height) as usize {
            let (row, column) = (texel / size.width as usize, texel % size.width as usize);
            panorama.set_radiance(texel, Vec3::new((row * 7 + column * 3) as f32 % 5.0, column as f32 * 0.1, row as f32 * 0.3));
        }
        panorama
    }

    #[test]
    fn coefficients_are_the_integral_over_every_texel() {
        let size = Grid { width: 28, height: 14, supersample: 1 };
        let panorama = filled(size);
        let mut got = [Vec3::ZERO; SH25];
        Series::new(size, SH25).project(&panorama, &mut got);
        // Each texel by 12×12 parts, whose own error is 1/144 of a texel's.
        let fine = Grid { width: 336, height: 168, supersample: 1 };
        let geometry = &Panorama::new(fine, Lift::Linear).geometry;
        let mut expected = [DVec3::ZERO; SH25];
        for (row, column) in (0..168).flat_map(|row| (0..336).map(move |column| (row, column))) {
            let energy = panorama.radiance(row / 12 * 28 + column / 12).as_dvec3() * f64::from(geometry.solid_angle_sr[row]);
            for (sum, basis) in expected.iter_mut().zip(basis25(geometry.direction(row, column))) {
                *sum += energy * f64::from(basis);
            }
        }
        for (got, expected) in got.iter().zip(expected) {
            // Coefficients reach 10; the parts' midpoints are off by (15°/12)²/24·l² or 1e-4 of them.
            assert!((got.as_dvec3() - expected).abs().max_element() < 2e-3, "{got} against {expected}");
        }
    }

    #[test]
    fn rows_add_up_to_the_whole() {
        let size = Grid { width: 28, height: 14, supersample: 1 };
        let panorama = filled(size);
        for coefficients in [SH9, SH25] {
            let series = Series::new(size, coefficients);
            let mut whole = [Vec3::ZERO; SH25];
            series.project(&panorama, &mut whole[..coefficients]);
            // From the bottom up: any order will do.
            let got = series.project_rows((0..14).rev().map(|row| (row, panorama.row(1, row))));
            assert!(got.iter().zip(whole).all(|(got, whole)| (got - f64::from(whole.y)).abs() < 1e-5), "{got:?} against {whole:?}");
            assert_eq!(series.project_rows([(14, panorama.row(1, 0))].into_iter()), [0.0; SH25]);
        }
    }

    #[test]
    fn nine_coefficients_are_the_first_of_25_and_agree_with_the_sum_over_centres() {
        let size = Grid { width: 64, height: 32, supersample: 1 };
        let panorama = filled(size);
        let (mut nine, mut all, mut centres) = ([Vec3::ZERO; SH9], [Vec3::ZERO; SH25], [Vec3::ZERO; SH9]);
        Series::new(size, SH9).project(&panorama, &mut nine);
        Series::new(size, SH25).project(&panorama, &mut all);
        for texel in 0..64 * 32 {
            let (row, column) = (texel / 64, texel % 64);
            let energy = panorama.radiance(texel) * panorama.geometry.solid_angle_sr[row];
            centres.iter_mut().zip(basis9(panorama.geometry.direction(row, column))).for_each(|(sum, basis)| *sum += energy * basis);
        }
        assert!(nine.iter().zip(all).all(|(a, b)| (*a - b).abs().max_element() < 1e-4));
        // Centres are good to 0.3 % of the mean.
        assert!(nine.iter().zip(centres).all(|(a, b)| (*a - b).abs().max_element() < 3e-3 * nine[0].max_element()), "{nine:?} {centres:?}");
    }
}
