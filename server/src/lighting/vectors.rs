//! Rows of floats in whatever vectors there are. All of it is inlined into work that `pulp` dispatches: what is not, as closures often are
//! not, knows nothing of the vectors and calls a function for each operation.

use pulp::{Arch, Simd};

/// The widest vectors of this processor of which whole ones make a row, which is a power of two from 8 on.
pub(super) fn arch_for_rows(width: usize) -> Arch {
    match Arch::new() {
        #[cfg(target_arch = "x86_64")]
        Arch::V4(simd) if width < 16 => Arch::V3(*simd),
        arch => arch,
    }
}

/// How many vectors hold a row of this length.
#[inline(always)]
pub(super) fn vectors<S: Simd>(length: usize) -> usize {
    length.div_ceil(S::F32_LANES)
}

/// The vector with this index; beyond the row's end are zeros.
#[inline(always)]
pub(super) fn load<S: Simd>(simd: S, row: &[f32], vector: usize) -> S::f32s {
    let (whole, rest) = S::as_simd_f32s(row);
    match whole.get(vector) {
        Some(values) => *values,
        None if vector == whole.len() => simd.partial_load_f32s(rest),
        None => simd.splat_f32s(0.0),
    }
}

/// Writes the vector with this index, as much of it as lies in the row.
#[inline(always)]
pub(super) fn store<S: Simd>(simd: S, row: &mut [f32], vector: usize, values: S::f32s) {
    let (whole, rest) = S::as_mut_simd_f32s(row);
    let count = whole.len();
    match whole.get_mut(vector) {
        Some(place) => *place = values,
        None if vector == count => simd.partial_store_f32s(rest, values),
        None => {}
    }
}

/// Sums of `values` over every `side` of its elements.
#[inline(always)]
pub(super) fn add_sides(values: &[f32], side: usize, sums: &mut [f32]) {
    if side == 4 {
        for (sum, [a, b, c, d]) in sums.iter_mut().zip(values.as_chunks().0) {
            *sum = (a + b) + (c + d);
        }
        return;
    }
    for (sum, values) in sums.iter_mut().zip(values.chunks_exact(side)) {
        *sum = 0.0;
        for value in values {
            *sum += value;
        }
    }
}

/// Every element of `values`, `side` times.
#[inline(always)]
pub(super) fn repeat_sides(values: &[f32], side: usize, repeated: &mut [f32]) {
    if side == 4 {
        for (repeated, value) in repeated.as_chunks_mut().0.iter_mut().zip(values) {
            *repeated = [*value; 4];
        }
        return;
    }
    for (repeated, value) in repeated.chunks_exact_mut(side).zip(values) {
        repeated.fill(*value);
    }
}

/// Whether all values are zero.
#[inline(always)]
pub(super) fn all_zero(values: &[f32]) -> bool {
    // Without a way out half way, so that many are looked at together.
    let mut bits = 0;
    for value in values {
        bits |= value.to_bits();
    }
    bits == 0
}
