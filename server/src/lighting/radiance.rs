//! From code values to radiance by table: the same curves as `shaders::colour`, at a price per texel that
//! allows video rate.

use glam::{Mat3, Vec3};
use mr360_protocol::light::Lift;
use mr360_protocol::video::{Colour, Primaries, Transfer};
use mr360_shaders::colour::{IORNS_LUMA, bt709_from_primaries, decode_transfer, hlg_display_factor, hlg_scene_light, iorns_factor};

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

/// Tables for one lift of one colour.
pub(super) struct RadianceTable {
    key: (Lift, Colour),
    /// Linear light of a code, one channel.
    transfer: Box<[f32; ENTRIES]>,
    /// Factor of a code's luma (Iorns & Rhee 2015, Eq. 2, or its scaled form).
    factor: Box<[f32; ENTRIES]>,
    primaries: Mat3,
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

/// Clamps to [0, 1]; written as comparisons because these are single instructions.
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
