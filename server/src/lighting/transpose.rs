//! Rows of eight as columns of eight.
//!
//! Compilers make many times more instructions of a plain transpose than the 24 exchanges that it takes; where the processor has
//! them, they are named one by one.

use pulp::{Arch, Simd, WithSimd};

/// Values in a row and in a column.
pub(super) const SIDE: usize = 8;
/// Eight rows of eight values.
pub(super) type Square = [[f32; SIDE]; SIDE];

/// A processor's way to transpose.
pub(super) trait Transpose: Copy {
    /// Columns of `rows` as rows.
    fn transposed(self, rows: Square) -> Square;
}

/// Work that transposes, done in the widest vectors there are.
pub(super) trait WithTranspose {
    /// Does it; to be inlined, as in [`WithSimd`].
    fn with<T: Transpose>(self, transpose: T);
}

/// Does `work` with what this processor has.
pub(super) fn dispatch(arch: Arch, work: impl WithTranspose) {
    match arch {
        #[cfg(target_arch = "x86_64")]
        Arch::V4(simd) => Simd::vectorize(simd, With(work, *simd)),
        #[cfg(target_arch = "x86_64")]
        Arch::V3(simd) => Simd::vectorize(simd, With(work, simd)),
        arch => arch.dispatch(With(work, Plain)),
    }
}

struct With<W, T>(W, T);

impl<W: WithTranspose, T: Transpose> WithSimd for With<W, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        self.0.with(self.1);
    }
}

/// For processors without a way of their own.
#[derive(Clone, Copy)]
struct Plain;

impl Transpose for Plain {
    #[inline(always)]
    fn transposed(self, rows: Square) -> Square {
        std::array::from_fn(|row| std::array::from_fn(|column| rows[column][row]))
    }
}

#[cfg(target_arch = "x86_64")]
impl Transpose for pulp::x86::V3 {
    #[inline(always)]
    fn transposed(self, rows: Square) -> Square {
        let [a, b, c, d, e, f, g, h] = rows.map(pulp::cast::<_, std::arch::x86_64::__m256>);
        let avx = self.avx;
        let singles = |a, b| (avx._mm256_unpacklo_ps(a, b), avx._mm256_unpackhi_ps(a, b));
        let pairs = |a, b| (avx._mm256_shuffle_ps::<0b01_00_01_00>(a, b), avx._mm256_shuffle_ps::<0b11_10_11_10>(a, b));
        let halves = |a, b| (avx._mm256_permute2f128_ps::<0x20>(a, b), avx._mm256_permute2f128_ps::<0x31>(a, b));
        let ((a, b), (c, d), (e, f), (g, h)) = (singles(a, b), singles(c, d), singles(e, f), singles(g, h));
        let ((a, c), (b, d), (e, g), (f, h)) = (pairs(a, c), pairs(b, d), pairs(e, g), pairs(f, h));
        let ((a, e), (c, g), (b, f), (d, h)) = (halves(a, e), halves(c, g), halves(b, f), halves(d, h));
        [a, c, b, d, e, g, f, h].map(pulp::cast)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Check;

    impl WithTranspose for Check {
        fn with<T: Transpose>(self, transpose: T) {
            let rows: Square = std::array::from_fn(|i| std::array::from_fn(|j| (8 * i + j) as f32));
            let columns = transpose.transposed(rows);
            assert!((0..8).all(|i| (0..8).all(|j| columns[i][j] == rows[j][i])), "{columns:?}");
        }
    }

    #[test]
    fn every_way_turns_rows_into_columns() {
        dispatch(Arch::new(), Check);
        Check.with(Plain);
    }
}
