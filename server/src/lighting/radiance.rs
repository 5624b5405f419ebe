//! From code values to radiance by table: the same curves as `shaders::colour`, at a price per texel that
//! allows video rate.

use glam::{Mat3, Vec3};
use mr360_protocol::light::Lift;
use mr360_protocol::video::{Colour, Primaries, Transfer};
use mr360_shaders::colour::{IORNS_LUMA, bt709_from_primaries, decode_transfer, hlg_display_factor, hlg_scene_light, iorns_factor};
use pulp::{Arch, Simd, WithSimd};

use super::sampling::CodeRow;

/// Entries of a table over code values in [0, 1]. Rounding to the nearest entry moves a code by at most
/// 1/8190, an eighth of an 8-bit step, and averages out over the texels.
const ENTRIES: usize = 4096;
/// Texels whose table entries are worked out before any is looked up.
const RUN: usize = 64;

/// Planar R, G and B, one value a texel.
pub(super) type Planes = [Vec<f32>; 3];

/// Whether the transfer carries true HDR, so that nothing needs to be recovered.
#[must_use]
pub(super) fn is_hdr(transfer: Transfer) -> bool {
    matches!(transfer, Transfer::Linear | Transfer::Pq | Transfer::Hlg)
}

/// The lift that applies to video of this transfer: the papers' operator undoes the clipping of LDR video, so
/// HDR input is used as it is.
#[must_use]
pub(super) fn effective_lift(lift: Lift, transfer: Transfer) -> Lift {
    if is_hdr(transfer) { Lift::Linear } else { lift }
}

/// A transfer that is a power of 2.4 above its toe, as display-referred video has: BT.1886 and sRGB.
#[derive(Debug, Clone, Copy, PartialEq)]
struct PowerCurve {
    /// What is raised is `code * scale + shift`.
    scale: f32,
    shift: f32,
    /// Codes from here down are proportional to light, by `slope`.
    knee: f32,
    slope: f32,
}

/// Half of 2.4·1.4: see [`PowerCurve::mean`].
const SPREAD: f32 = 1.68;

impl PowerCurve {
    fn of(transfer: Transfer) -> Option<Self> {
        match transfer {
            Transfer::Bt709 => Some(Self { scale: 1.0, shift: 0.0, knee: 0.0, slope: 0.0 }),
            Transfer::Srgb => Some(Self { scale: 1.0 / 1.055, shift: 0.055 / 1.055, knee: 0.040_45, slope: 1.0 / 12.92 }),
            Transfer::Linear | Transfer::Pq | Transfer::Hlg => None,
        }
    }

    /// Mean radiance of codes of this mean and variance.
    ///
    /// By Taylor, the mean of ℓ(v) over an area is ℓ(m) + ½ℓ″(m)·σ² + …, with m and σ² the mean and the variance of the codes. For
    /// ℓ = v^2.4 that is m^0.4·(m² + 1.68σ²). A square law would have no further terms, and the power of 2.4 has small ones.
    /// The curve is convex between (0, 0) and (1, 1), hence the mean is never above m: evenly black and white, where Taylor
    /// alone has 0.508, become 0.5.
    #[inline(always)]
    fn mean<const TOE: bool>(self, code: f32, variance: f32) -> f32 {
        let code = unit(code);
        let mean = if TOE {
            let base = code * self.scale + self.shift;
            let root = power_of_two_fifths(base);
            let even = if code > self.knee { root * (base * base) } else { code * self.slope };
            even + root * (variance * (SPREAD * self.scale * self.scale))
        } else {
            power_of_two_fifths(code) * (code * code + variance * SPREAD)
        };
        if mean < code { mean } else { code }
    }
}

/// v^0.4 for v in [0, 1], good to 2.7e-4 of it from 1e-4 on: v·z with z = v^-0.6.
///
/// A float's bits, read as an integer, are nearly its logarithm, which gives a first z that is good to 5 %. With e = 1 − v³z⁵, what it
/// lacks is the factor (1 − e)^(−1/5), here a parabola. Nothing but products and sums, so that many are made at once.
#[inline(always)]
fn power_of_two_fifths(v: f32) -> f32 {
    // 154/256 is 0.6; the difference of integers is a float between 1 and 1e20 for whatever v.
    let z = f32::from_bits(FIRST_GUESS.wrapping_sub((v.to_bits() >> 8).wrapping_mul(154)));
    let product = v * z;
    let twice = product * z;
    let e = 1.0 - product * (twice * twice);
    product * (0.999_8 + e * (0.201_35 + e * 0.145_25))
}

/// With the parabola's coefficients, chosen for the least error from 1e-4 to 1.
const FIRST_GUESS: u32 = 1_705_200_000;

/// Tables for one lift of one colour.
pub(super) struct RadianceTable {
    key: (Lift, Colour),
    /// Linear light of a code, one channel.
    transfer: Box<[f32; ENTRIES]>,
    /// Factor of a code's luma (Iorns & Rhee 2015, Eq. 2, or its scaled form).
    factor: Box<[f32; ENTRIES]>,
    primaries: Mat3,
    /// The transfer as a power, where it is one and nothing is lifted.
    power: Option<PowerCurve>,
    arch: Arch,
}

impl RadianceTable {
    pub(super) fn new(lift: Lift, colour: Colour) -> Self {
        let lift = effective_lift(lift, colour.transfer);
        let table = |f: &dyn Fn(f32) -> f32| {
            let mut entries = Box::new([0.0; ENTRIES]);
            for (i, entry) in entries.iter_mut().enumerate() {
                *entry = f(i as f32 / (ENTRIES - 1) as f32);
            }
            entries
        };
        Self {
            key: (lift, colour),
            transfer: table(&|v| match (lift, colour.transfer) {
                (Lift::InverseToneMap, _) => v,
                (_, Transfer::Hlg) => hlg_scene_light(v),
                _ => decode_transfer(colour.transfer, Vec3::splat(v)).x,
            }),
            factor: table(&|luma| match lift {
                Lift::Linear | Lift::Recovered(_) => 1.0,
                Lift::InverseToneMap => iorns_factor(Vec3::splat(luma)),
            }),
            primaries: bt709_from_primaries(colour.primaries),
            power: PowerCurve::of(colour.transfer).filter(|_| lift == Lift::Linear),
            arch: Arch::new(),
        }
    }

    /// Whether this is the table that `new` would make.
    pub(super) fn is_for(&self, lift: Lift, colour: Colour) -> bool {
        self.key == (effective_lift(lift, colour.transfer), colour)
    }

    /// Whether codes are radiance already.
    pub(super) fn is_linear(&self) -> bool {
        self.key.1.transfer == Transfer::Linear
    }

    /// Whether codes are true HDR.
    pub(super) fn is_hdr(&self) -> bool {
        is_hdr(self.key.1.transfer)
    }

    /// The lift that is applied.
    pub(super) fn lift(&self) -> Lift {
        self.key.0
    }

    /// Whether [`RadianceTable::decode_means`] is there for this curve; otherwise codes must be decoded before they are averaged.
    pub(super) fn knows_means(&self) -> bool {
        self.power.is_some()
    }

    /// Turns means of codes and of the luma's squares into linear BT.709 radiance; see [`PowerCurve::mean`]. The chroma's own
    /// variance is left out: it is coded at half the resolution, and contrast is in the luma.
    pub(super) fn decode_means(&self, codes: &CodeRow<'_>, radiance: [&mut [f32]; 3]) {
        let Some(power) = self.power else { return };
        let primaries = (self.key.1.primaries != Primaries::Bt709).then_some(self.primaries);
        self.arch.dispatch(DecodeMeans { power, primaries, codes, radiance });
    }

    /// Turns codes into linear BT.709 radiance in place. Codes of a transfer other than linear are clamped to
    /// [0, 1], linear ones to 0 and above.
    pub(super) fn decode(&self, planes: &mut Planes) {
        let (lift, colour) = self.key;
        if colour.transfer != Transfer::Linear {
            if lift == Lift::Linear { self.decode_plain(planes) } else { self.decode_lifted(planes) }
        }
        if colour.transfer == Transfer::Hlg {
            for_each_texel(planes, |scene| if scene == Vec3::ZERO { scene } else { scene * hlg_display_factor(scene) });
        }
        // The papers' operator works on the codes, whatever their primaries.
        if colour.primaries != Primaries::Bt709 && lift != Lift::InverseToneMap {
            for_each_texel(planes, |radiance| self.primaries * radiance);
        }
        for plane in planes {
            plane.iter_mut().for_each(|v| *v = if *v > 0.0 { *v } else { 0.0 });
        }
    }

    fn decode_plain(&self, planes: &mut Planes) {
        for plane in planes {
            plane.iter_mut().for_each(|v| *v = self.transfer[entry(unit(*v)) as usize & (ENTRIES - 1)]);
        }
    }

    fn decode_lifted(&self, [red, green, blue]: &mut Planes) {
        for ((red, green), blue) in red.chunks_mut(RUN).zip(green.chunks_mut(RUN)).zip(blue.chunks_mut(RUN)) {
            // All arithmetic first, on runs that the compiler can do several texels at a time, then the look-ups.
            let mut entries = [[0u32; RUN]; 4];
            let [to_r, to_g, to_b, to_factor] = &mut entries;
            let run = red.iter().zip(green.iter()).zip(blue.iter());
            for ((((((r, g), b), to_r), to_g), to_b), to_factor) in run.zip(to_r).zip(to_g).zip(to_b).zip(to_factor) {
                let (r, g, b) = (unit(*r), unit(*g), unit(*b));
                let luma = r * IORNS_LUMA.x + g * IORNS_LUMA.y + b * IORNS_LUMA.z;
                [*to_r, *to_g, *to_b, *to_factor] = [r, g, b, luma].map(entry);
            }
            let texels = red.len().min(green.len()).min(blue.len()).min(RUN);
            let (red, green, blue) = (&mut red[..texels], &mut green[..texels], &mut blue[..texels]);
            for i in 0..texels {
                let [to_r, to_g, to_b, to_factor] = entries.each_ref().map(|run| run[i] as usize & (ENTRIES - 1));
                let factor = self.factor[to_factor];
                red[i] = self.transfer[to_r] * factor;
                green[i] = self.transfer[to_g] * factor;
                blue[i] = self.transfer[to_b] * factor;
            }
        }
    }
}

/// [`RadianceTable::decode_means`] for whatever vectors there are.
struct DecodeMeans<'a> {
    power: PowerCurve,
    /// To BT.709, where they are others.
    primaries: Option<Mat3>,
    codes: &'a CodeRow<'a>,
    radiance: [&'a mut [f32]; 3],
}

impl WithSimd for DecodeMeans<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        if self.power.knee > 0.0 { self.run::<true>() } else { self.run::<false>() }
    }
}

impl DecodeMeans<'_> {
    #[inline(always)]
    fn run<const TOE: bool>(mut self) {
        self.decode::<TOE>();
        if let Some(primaries) = self.primaries {
            self.convert(primaries);
        }
    }

    #[inline(always)]
    fn convert(&mut self, primaries: Mat3) {
        let [red, green, blue] = &mut self.radiance;
        let [x, y, z] = [primaries.x_axis, primaries.y_axis, primaries.z_axis];
        for ((r, g), b) in red.iter_mut().zip(green.iter_mut()).zip(blue.iter_mut()) {
            let sums = [x.x * *r + y.x * *g + z.x * *b, x.y * *r + y.y * *g + z.y * *b, x.z * *r + y.z * *g + z.z * *b];
            (*r, *g, *b) = (positive(sums[0]), positive(sums[1]), positive(sums[2]));
        }
    }

    #[inline(always)]
    fn decode<const TOE: bool>(&mut self) {
        let CodeRow { luma, luma_squares, luma_scale, tint } = self.codes;
        let [red, green, blue] = &mut self.radiance;
        let texels = [luma.len(), luma_squares.len(), tint[0].len(), tint[1].len(), tint[2].len(), red.len(), green.len(), blue.len()];
        let texels = texels.into_iter().fold(usize::MAX, usize::min);
        let (luma, luma_squares) = (&luma[..texels], &luma_squares[..texels]);
        let tint = tint.each_ref().map(|tint| &tint[..texels]);
        let (red, green, blue) = (&mut red[..texels], &mut green[..texels], &mut blue[..texels]);
        for i in 0..texels {
            let spread = luma_squares[i] - luma[i] * luma[i];
            let variance = if spread > 0.0 { spread * (luma_scale * luma_scale) } else { 0.0 };
            let luma = luma[i] * luma_scale;
            red[i] = self.power.mean::<TOE>(luma + tint[0][i], variance);
            green[i] = self.power.mean::<TOE>(luma + tint[1][i], variance);
            blue[i] = self.power.mean::<TOE>(luma + tint[2][i], variance);
        }
    }
}

#[inline(always)]
fn positive(v: f32) -> f32 {
    if v > 0.0 { v } else { 0.0 }
}

/// Clamps to [0, 1]; written as comparisons because these are single instructions.
#[inline(always)]
fn unit(v: f32) -> f32 {
    let v = if v > 0.0 { v } else { 0.0 };
    if v < 1.0 { v } else { 1.0 }
}

/// Nearest entry for a code in [0, 1]. Adding 2²³ leaves the rounded integer in the low bits of the float, which
/// costs less than a checked conversion and cannot leave the table.
fn entry(code: f32) -> u32 {
    (code * (ENTRIES - 1) as f32 + 8_388_608.0).to_bits() & (ENTRIES as u32 - 1)
}

fn for_each_texel([red, green, blue]: &mut Planes, f: impl Fn(Vec3) -> Vec3) {
    for ((r, g), b) in red.iter_mut().zip(green.iter_mut()).zip(blue.iter_mut()) {
        [*r, *g, *b] = f(Vec3::new(*r, *g, *b)).to_array();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use mr360_shaders::colour::radiance_from_code;

    #[test]
    fn tables_agree_with_the_curves() {
        for transfer in [Transfer::Bt709, Transfer::Srgb, Transfer::Linear, Transfer::Pq, Transfer::Hlg] {
            for primaries in [Primaries::Bt709, Primaries::Bt2020, Primaries::Bt601Ntsc] {
                for lift in [Lift::Linear, Lift::InverseToneMap] {
                    let colour = Colour { transfer, primaries, ..Colour::default() };
                    let table = RadianceTable::new(lift, colour);
                    // Limited-range video holds codes below black and above white; 255 of 8 bits is 1.09.
                    for code in [
                        Vec3::ZERO,
                        Vec3::new(0.9, 0.5, 0.2),
                        Vec3::splat(0.73),
                        Vec3::new(0.3, 0.8, 0.31),
                        Vec3::ONE,
                        Vec3::splat(239.0 / 219.0),
                        Vec3::new(1.09, 0.4, -0.07),
                        Vec3::splat(-0.07),
                    ] {
                        let mut planes = code.to_array().map(|v| vec![v]);
                        table.decode(&mut planes);
                        let got = Vec3::new(planes[0][0], planes[1][0], planes[2][0]);
                        let expected = radiance_from_code(table.lift(), colour, Vec3::Y, code);
                        // Half a table step of the steepest curve, PQ or the tenth power near white, is 0.25 %.
                        assert!(
                            (got - expected).abs().max_element() <= 3e-3 * expected.max_element() + 1e-5,
                            "{colour:?} {lift:?} {code}: {got} against {expected}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn hdr_is_never_lifted() {
        for transfer in [Transfer::Linear, Transfer::Pq, Transfer::Hlg] {
            assert_eq!(effective_lift(Lift::InverseToneMap, transfer), Lift::Linear);
        }
        assert_eq!(effective_lift(Lift::InverseToneMap, Transfer::Srgb), Lift::InverseToneMap);
    }
}
