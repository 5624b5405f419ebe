//! Exponential, logarithm and hyperbolic tangent that a loop makes several of at once.
//!
//! Those of the system's library are good to the last bit and are called one by one, which costs more than all else that is done with
//! them. These are good to less than a millionth and nothing but sums, products and shifts, so that a plain loop over them is compiled for
//! vectors; they are the same on every processor.

use std::f32::consts::{LN_2, LOG2_E};

/// Adding it rounds a float between −2²² and 2²² to an integer, which is left in the low bits.
const ROUNDER: f32 = 12_582_912.0;
/// 1 is this exponent in a float's bits.
const BIAS: u32 = 127;
/// Bits of a float below its exponent.
const MANTISSA: u32 = 23;
/// √½ as bits: mantissas are taken from here to √2, about 1.
const ROOT_HALF: u32 = 0x3f35_04f3;

/// e^x, good to 3e-7 of it; beyond ±87, where floats end, it is that of ±87.
#[inline(always)]
pub(super) fn exp(x: f32) -> f32 {
    let x = if x > -87.0 { x } else { -87.0 };
    let x = if x < 87.0 { x } else { 87.0 };
    let rounded = x * LOG2_E + ROUNDER;
    let whole = rounded - ROUNDER;
    // ln 2 in two parts, of which the first times any whole number is exact.
    let rest = (x - whole * 0.693_359_4) + whole * 2.121_944_4e-4;
    let fourth = 0.041_665_796 + rest * (0.008_333_452 + rest * (0.001_398_2 + rest * 1.987_569_2e-4));
    let series = 1.0 + rest + rest * rest * (0.5 + rest * (0.166_666_65 + rest * fourth));
    let power = f32::from_bits((rounded.to_bits() << MANTISSA).wrapping_add(BIAS << MANTISSA));
    series * power
}

/// Natural logarithm of a positive number that is not denormal, good to 3e-7 or as much of it.
#[inline(always)]
pub(super) fn ln(x: f32) -> f32 {
    let bits = x.to_bits();
    let exponent = (bits.wrapping_sub(ROOT_HALF) as i32) >> MANTISSA;
    let mantissa = f32::from_bits(bits.wrapping_sub((exponent as u32) << MANTISSA));
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let square = s * s;
    let series = 2.0 * s * (1.0 + square * (1.0 / 3.0 + square * (0.2 + square * (1.0 / 7.0 + square * (1.0 / 9.0)))));
    exponent as f32 * LN_2 + series
}

/// Hyperbolic tangent, good to 3e-7.
#[inline(always)]
pub(super) fn tanh(x: f32) -> f32 {
    1.0 - 2.0 / (exp(2.0 * x) + 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Evenly from the first to the second.
    fn between(first: f32, last: f32) -> impl Iterator<Item = f32> {
        (0..=20_000).map(move |i| first + (last - first) * i as f32 / 20_000.0)
    }

    #[test]
    fn they_agree_with_the_library() {
        for x in between(-86.0, 86.0).chain(between(-1.0, 1.0)) {
            let (got, expected) = (f64::from(exp(x)), f64::from(x).exp());
            assert!((got / expected - 1.0).abs() < 5e-7, "exp {x}: {got} against {expected}");
            let (got, expected) = (f64::from(tanh(x)), f64::from(x).tanh());
            assert!((got - expected).abs() < 3e-7, "tanh {x}: {got} against {expected}");
        }
        for x in between(-86.0, 86.0).map(f32::exp).chain(between(0.5, 2.0)) {
            let (got, expected) = (f64::from(ln(x)), f64::from(x).ln());
            assert!((got - expected).abs() < 3e-7 * expected.abs().max(1.0), "ln {x}: {got} against {expected}");
        }
        assert_eq!((exp(0.0), ln(1.0), tanh(0.0)), (1.0, 0.0, 0.0));
    }

    #[test]
    fn nothing_overflows() {
        for x in [100.0, 1e30, f32::INFINITY] {
            assert!(exp(x).is_finite() && exp(-x) > 0.0 && tanh(x) == 1.0 && tanh(-x) == -1.0, "{x}");
        }
    }
}
