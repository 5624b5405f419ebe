//! Every transfer function, YUV matrix and primary conversion of the project.
//!
//! Code values are in [0, 1]. Decoded light is linear BT.709 with the video's display white at 1.0: for HLG
//! and PQ that is the reference white of BT.2408, 203 cd/m².

use glam::{Mat3, Vec3};
pub use mr360_protocol::light::LUMA;
use mr360_protocol::light::{Lift, MAX_MAGNITUDE, Recovery};
use mr360_protocol::video::{Colour, Matrix, Primaries, Transfer};

/// Reference white of HDR video, cd/m² (ITU-R BT.2408).
pub const HDR_REFERENCE_WHITE: f32 = 203.0;
/// Nominal peak of the HLG reference display, cd/m² (ITU-R BT.2100).
pub(crate) const HLG_PEAK: f32 = 1000.0;
/// System gamma of HLG at 1000 cd/m² (ITU-R BT.2100).
pub(crate) const HLG_GAMMA: f32 = 1.2;
/// a, b and c of the HLG inverse OETF (ITU-R BT.2100).
pub(crate) const HLG_ABC: [f32; 3] = [0.178_832_77, 1.0 - 4.0 * 0.178_832_77, 0.559_910_7];
/// m1 and m2 of PQ (SMPTE ST 2084).
pub(crate) const PQ_M: [f32; 2] = [2610.0 / 16384.0, 2523.0 / 4096.0 * 128.0];
/// c1, c2 and c3 of PQ (SMPTE ST 2084).
pub(crate) const PQ_C: [f32; 3] = [3424.0 / 4096.0, 2413.0 / 4096.0 * 32.0, 2392.0 / 4096.0 * 32.0];

/// Relative luminance of linear BT.709.
#[must_use]
pub fn luminance(rgb: Vec3) -> f32 {
    rgb.dot(LUMA)
}

/// Luma weights (Kr, Kb) of a YUV matrix (ITU-T H.273).
fn luma_weights(matrix: Matrix) -> (f32, f32) {
    match matrix {
        Matrix::Bt601 => (0.299, 0.114),
        Matrix::Bt709 => (LUMA.x, LUMA.z),
        Matrix::Bt2020 => (0.2627, 0.0593),
    }
}

/// Matrix and offset that turn sampled (Y, Cb, Cr), each the code over the largest code of its bit depth,
/// into R'G'B': `rgb = m * (yuv − offset)`.
#[must_use]
pub fn rgb_from_yuv(colour: Colour) -> (Mat3, Vec3) {
    let (kr, kb) = luma_weights(colour.matrix);
    let kg = 1.0 - kr - kb;
    let largest = ((1u32 << colour.bit_depth) - 1) as f32;
    let step = (1u32 << (colour.bit_depth - 8)) as f32;
    let (luma_scale, chroma_scale, luma_offset) =
        if colour.full_range { (1.0, 1.0, 0.0) } else { (largest / (219.0 * step), largest / (224.0 * step), 16.0 * step / largest) };
    let offset = Vec3::new(luma_offset, 128.0 * step / largest, 128.0 * step / largest);
    let from_y = Vec3::splat(luma_scale);
    let from_cb = Vec3::new(0.0, -2.0 * (1.0 - kb) * kb / kg, 2.0 * (1.0 - kb)) * chroma_scale;
    let from_cr = Vec3::new(2.0 * (1.0 - kr), -2.0 * (1.0 - kr) * kr / kg, 0.0) * chroma_scale;
    (Mat3::from_cols(from_y, from_cb, from_cr), offset)
}

/// Linear BT.709 from linear light of other primaries. BT.601's differ from BT.709's by less than its
/// own tolerance for PAL and by up to a few percent of saturation for NTSC.
#[must_use]
pub fn bt709_from_primaries(primaries: Primaries) -> Mat3 {
    match primaries {
        Primaries::Bt709 => Mat3::IDENTITY,
        // Columns: where the source's red, green and blue land in BT.709 (ITU-R BT.2087, inverse).
        Primaries::Bt2020 => Mat3::from_cols(
            Vec3::new(1.660_491, -0.124_550_5, -0.018_150_76),
            Vec3::new(-0.587_641_1, 1.132_899_9, -0.100_578_9),
            Vec3::new(-0.072_849_86, -0.008_349_422, 1.118_729_7),
        ),
        Primaries::Bt601Pal => {
            Mat3::from_cols(Vec3::new(1.044_043_2, 0.0, 0.0), Vec3::new(-0.044_043_2, 1.0, 0.011_793_378), Vec3::new(0.0, 0.0, 0.988_206_6))
        }
        Primaries::Bt601Ntsc => Mat3::from_cols(
            Vec3::new(0.939_542, 0.017_772_22, -0.001_621_599_8),
            Vec3::new(0.050_181_36, 0.965_792_85, -0.004_369_749_7),
            Vec3::new(0.010_276_644, 0.016_434_92, 1.005_991_3),
        ),
    }
}

/// Linear light of one code value, before any conversion of primaries.
#[must_use]
pub fn decode_transfer(transfer: Transfer, code: Vec3) -> Vec3 {
    let each = |f: fn(f32) -> f32| Vec3::from_array(code.to_array().map(f));
    match transfer {
        Transfer::Bt709 => each(|v| v.max(0.0).powf(2.4)),
        Transfer::Srgb => each(srgb_decode),
        Transfer::Linear => code,
        Transfer::Pq => each(pq_decode),
        Transfer::Hlg => hlg_decode(code),
    }
}

/// sRGB to linear (IEC 61966-2-1).
#[must_use]
pub fn srgb_decode(v: f32) -> f32 {
    if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// Linear to sRGB (IEC 61966-2-1).
#[must_use]
pub fn srgb_encode(v: f32) -> f32 {
    if v <= 0.003_130_8 { v * 12.92 } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}

/// SMPTE ST 2084, Eq. 4.1, over the reference white.
fn pq_decode(v: f32) -> f32 {
    let ([m1, m2], [c1, c2, c3]) = (PQ_M, PQ_C);
    let p = v.clamp(0.0, 1.0).powf(1.0 / m2);
    ((p - c1).max(0.0) / (c2 - c3 * p)).powf(1.0 / m1) * 10_000.0 / HDR_REFERENCE_WHITE
}

/// ITU-R BT.2100 HLG: inverse OETF, then the OOTF of a 1000 cd/m² display, over the reference white.
fn hlg_decode(code: Vec3) -> Vec3 {
    let scene = Vec3::from_array(code.to_array().map(hlg_scene_light));
    scene * hlg_display_factor(scene)
}

/// Scene light in [0, 1] of an HLG code value (ITU-R BT.2100, inverse OETF).
#[must_use]
pub fn hlg_scene_light(code: f32) -> f32 {
    let [a, b, c] = HLG_ABC;
    let v = code.clamp(0.0, 1.0);
    if v <= 0.5 { v * v / 3.0 } else { (((v - c) / a).exp() + b) / 12.0 }
}

/// Factor from HLG scene light to light over the reference white (ITU-R BT.2100, OOTF at 1000 cd/m²).
#[must_use]
pub fn hlg_display_factor(scene: Vec3) -> f32 {
    let luminance = scene.dot(Vec3::new(0.2627, 0.6780, 0.0593));
    luminance.powf(HLG_GAMMA - 1.0) * (HLG_PEAK / HDR_REFERENCE_WHITE)
}

/// Luma weights of Iorns & Rhee 2015, Eq. 1.
pub const IORNS_LUMA: Vec3 = Vec3::new(0.3, 0.59, 0.11);
/// Peak gain of Iorns & Rhee 2015, Eq. 2.
pub const IORNS_GAIN: f32 = 10.0;
/// Exponent of Iorns & Rhee 2015, Eq. 2.
pub const IORNS_EXPONENT: i32 = 10;
/// Base gain of Iorns & Rhee 2015, Eq. 2.
pub const IORNS_BASE: f32 = 1.8;

/// Inverse tone map's factor for a code value (Iorns & Rhee 2015, Eq. 2).
#[must_use]
pub fn iorns_factor(code: Vec3) -> f32 {
    IORNS_GAIN * code.dot(IORNS_LUMA).max(0.0).powi(IORNS_EXPONENT) + IORNS_BASE
}

/// A channel is clipped by a degree that rises smoothly from the first to the second of these shares of display white. They are the codes
/// 0.966 and 0.996 of BT.1886: 8-bit grain and the rounding of a codec about white move the degree by a fraction.
pub const CLIPPED: (f32, f32) = (0.92, 0.99);

/// By how much each channel of linear radiance is clipped, in [0, 1].
#[must_use]
pub fn clipped_degree(linear: Vec3) -> Vec3 {
    let (first, last) = CLIPPED;
    let t = ((linear - first) / (last - first)).clamp(Vec3::ZERO, Vec3::ONE);
    t * t * (3.0 - 2.0 * t)
}

/// Colour of what a recovery adds, of luminance 1.
#[must_use]
pub fn recovery_tint(recovery: &Recovery) -> Vec3 {
    let [red, blue] = recovery.tint_ln;
    let tint = Vec3::new(red.exp(), 1.0, blue.exp());
    tint / luminance(tint)
}

/// Linear radiance with what clipping took from it, as the recovery says.
#[must_use]
pub fn recovered(recovery: &Recovery, direction: Vec3, linear: Vec3) -> Vec3 {
    let added = luminance(linear * clipped_degree(linear)) * recovery.gain(direction);
    linear + added * recovery_tint(recovery)
}

/// Radiance of a code value under a lift, linear BT.709, in [0, [`MAX_MAGNITUDE`]]; `direction` is where its pixel looks.
///
/// HDR transfers carry their own highlights, so [`Lift::Recovered`] leaves them as they are. The papers'
/// operator works on the code values themselves, whatever their transfer.
///
/// Codes of a transfer other than linear are clamped to [0, 1] first. Limited-range video can hold more (255 of 8 bits
/// is 1.09), but there it is the ringing of filters and codecs, not measured light, and no transfer says what it means;
/// the operators' tenth power would make it 2.65 times as bright as white.
#[must_use]
pub fn radiance_from_code(lift: Lift, colour: Colour, direction: Vec3, code: Vec3) -> Vec3 {
    let code = if colour.transfer == Transfer::Linear { code } else { code.clamp(Vec3::ZERO, Vec3::ONE) };
    let linear = || {
        let linear = bt709_from_primaries(colour.primaries) * decode_transfer(colour.transfer, code);
        linear.clamp(Vec3::ZERO, Vec3::splat(MAX_MAGNITUDE))
    };
    match lift {
        Lift::Linear => linear(),
        Lift::InverseToneMap => code.max(Vec3::ZERO) * iorns_factor(code),
        Lift::Recovered(recovery) if matches!(colour.transfer, Transfer::Bt709 | Transfer::Srgb) => {
            recovered(&recovery, direction, linear()).min(Vec3::splat(MAX_MAGNITUDE))
        }
        Lift::Recovered(_) => linear(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: Vec3, b: Vec3, tolerance: f32) -> bool {
        (a - b).abs().max_element() < tolerance
    }

    #[test]
    fn grey_axis_and_primaries_of_every_matrix() {
        for matrix in [Matrix::Bt601, Matrix::Bt709, Matrix::Bt2020] {
            for (full_range, bit_depth) in [(false, 8), (true, 8), (false, 10), (true, 10)] {
                let (m, offset) = rgb_from_yuv(Colour { matrix, full_range, bit_depth, ..Colour::default() });
                let step = f32::from(1u16 << (bit_depth - 8));
                let largest = f32::from((1u16 << bit_depth) - 1);
                let (black, white) = if full_range { (0.0, largest) } else { (16.0 * step, 235.0 * step) };
                let grey = |y: f32| m * (Vec3::new(y, 128.0 * step, 128.0 * step) / largest - offset);
                assert!(close(grey(black), Vec3::ZERO, 1e-5), "{matrix:?} {full_range} {bit_depth}");
                assert!(close(grey(white), Vec3::ONE, 1e-5), "{matrix:?} {full_range} {bit_depth}");
                // R' = 1 has Y = Kr and Cr at its largest.
                let (kr, kb) = luma_weights(matrix);
                let (scale_y, scale_c) = if full_range { (largest, largest) } else { (219.0 * step, 224.0 * step) };
                let cb = -0.5 * kr / (1.0 - kb);
                let red = Vec3::new(black + kr * scale_y, 128.0 * step + cb * scale_c, 128.0 * step + 0.5 * scale_c) / largest;
                assert!(close(m * (red - offset), Vec3::X, 1e-5), "{matrix:?}");
            }
        }
    }

    #[test]
    fn white_stays_white_in_every_gamut() {
        for primaries in [Primaries::Bt709, Primaries::Bt2020, Primaries::Bt601Pal, Primaries::Bt601Ntsc] {
            assert!(close(bt709_from_primaries(primaries) * Vec3::ONE, Vec3::ONE, 1e-4), "{primaries:?}");
        }
    }

    #[test]
    fn transfers_at_known_points() {
        let at = |transfer, v| decode_transfer(transfer, Vec3::splat(v)).x;
        assert!((at(Transfer::Srgb, 0.5) - 0.214_041).abs() < 1e-5);
        assert!((at(Transfer::Bt709, 1.0) - 1.0).abs() < 1e-6);
        // BT.2408: 203 cd/m² is 58 % PQ and 75 % HLG.
        assert!((at(Transfer::Pq, 0.580_6) - 1.0).abs() < 5e-3, "{}", at(Transfer::Pq, 0.580_6));
        assert!((at(Transfer::Hlg, 0.75) - 1.0).abs() < 5e-3, "{}", at(Transfer::Hlg, 0.75));
        assert!((at(Transfer::Pq, 1.0) - 10_000.0 / 203.0).abs() < 1e-2);
        assert!((at(Transfer::Hlg, 1.0) - 1_000.0 / 203.0).abs() < 1e-2);
        assert!((srgb_encode(srgb_decode(0.37)) - 0.37).abs() < 1e-6);
    }

    #[test]
    fn luminance_of_white_is_one() {
        assert!((luminance(Vec3::ONE) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn codes_outside_the_range_are_as_bright_as_its_ends() {
        for transfer in [Transfer::Bt709, Transfer::Srgb, Transfer::Pq, Transfer::Hlg] {
            for lift in [Lift::Linear, Lift::InverseToneMap, Lift::Recovered(Recovery { gain_ln: 1.0, ..Recovery::default() })] {
                let radiance = |code| radiance_from_code(lift, Colour { transfer, ..Colour::default() }, Vec3::Y, code);
                assert_eq!(radiance(Vec3::splat(239.0 / 219.0)), radiance(Vec3::ONE), "{transfer:?} {lift:?}");
                assert_eq!(radiance(Vec3::new(1.09, 0.4, -0.07)), radiance(Vec3::new(1.0, 0.4, 0.0)), "{transfer:?} {lift:?}");
            }
        }
        // Linear codes are light: all that is above white is meant.
        let radiance =
            |code| radiance_from_code(Lift::Linear, Colour { transfer: Transfer::Linear, ..Colour::default() }, Vec3::Y, Vec3::splat(code));
        assert_eq!([-1.0, 7.0, 1e9].map(|code| radiance(code).x), [0.0, 7.0, MAX_MAGNITUDE]);
    }

    #[test]
    fn inverse_tone_map_at_the_papers_points() {
        let colour = Colour::default();
        assert!(close(radiance_from_code(Lift::InverseToneMap, colour, Vec3::Y, Vec3::ONE), Vec3::splat(11.8), 1e-5));
        let grey = radiance_from_code(Lift::InverseToneMap, colour, Vec3::Y, Vec3::splat(0.5));
        assert!(close(grey, Vec3::splat(0.5 * (10.0 * 0.5f32.powi(10) + 1.8)), 1e-5));
    }

    #[test]
    fn a_recovery_adds_its_gain_where_channels_are_clipped_and_nothing_else() {
        let recovery = Recovery { gain_ln: 1.0, slope: Vec3::new(0.0, 0.5, 0.0), tint_ln: [0.2, -0.3] };
        let at = |direction, linear: [f32; 3]| recovered(&recovery, direction, Vec3::from_array(linear));
        assert_eq!(at(Vec3::Y, [0.92, 0.5, 0.0]), Vec3::new(0.92, 0.5, 0.0));
        // All of white: its luminance times the gain of its direction.
        for (direction, gain) in [(Vec3::Y, 1.5f32.exp()), (Vec3::NEG_Y, 0.5f32.exp()), (Vec3::X, 1f32.exp())] {
            let white = at(direction, [1.0; 3]);
            assert!((luminance(white) / (1.0 + gain) - 1.0).abs() < 1e-5, "{white}");
            let added = white - 1.0;
            assert!(((added.x / added.y).ln() - 0.2).abs() < 1e-4 && ((added.z / added.y).ln() + 0.3).abs() < 1e-4, "{added}");
        }
        // Of a pixel whose red alone is clipped, red's luminance.
        let red = at(Vec3::X, [1.0, 0.5, 0.5]) - Vec3::new(1.0, 0.5, 0.5);
        assert!((luminance(red) / (0.2126 * 1f32.exp()) - 1.0).abs() < 1e-4, "{red}");
        // Half way up the ramp, by half.
        let half = at(Vec3::X, [0.955, 0.0, 0.0]);
        assert!((luminance(half - Vec3::new(0.955, 0.0, 0.0)) / (0.5 * 0.955 * 0.2126 * 1f32.exp()) - 1.0).abs() < 1e-3, "{half}");
    }
}
