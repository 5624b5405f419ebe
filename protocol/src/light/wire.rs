//! The light frame on the wire: quantised so that a frame of four lights and nine SH coefficients takes about a hundred bytes.
//!
//! Errors, all far below those of any estimate (see the tests): directions 0.005°; irradiance 0.05 % in luminance (down to 6e-5, where half floats
//! lose digits) and 0.25 % in colour; solid angles 3 %, which is 1.6 % of a penumbra; a recovery's gain 1 %; SH bands 0 and 1 are half floats, bands 2 to 4 bytes relative to the largest of their band. Band 2
//! reaches irradiance with a quarter of the mean's weight, band 3 not at all and band 4 with a twenty-fourth, so that bytes do for them.

use glam::Vec3;
use half::f16;
use serde::{Deserialize, Serialize};

use super::{
    DirectionalLight, LUMA, Lift, LightFrame, MAX_GAIN_LN, MAX_GAIN_SLOPE, MAX_LIGHTS, MAX_MAGNITUDE, MAX_TINT_LN, Recovery, SH9, SH25,
};
use crate::codec::{Message, WireError, ensure_in_range};

/// Coefficients of bands 0 and 1.
const FINE: usize = 4;
/// First coefficient of each coarse band, and the end of the last.
const COARSE: [usize; 4] = [FINE, SH9, 16, SH25];
/// Steps of a coarse coefficient on either side of zero.
const STEPS: f32 = 127.0;
/// Natural logarithms of the smallest and largest solid angle that bytes tell apart: a millionth of a steradian, and the sphere.
const SOLID_ANGLE_LN: (f32, f32) = (-13.815_511, 2.531_024_2);
/// Largest code of a chromaticity.
const CHROMA: f32 = 4095.0;

impl LightFrame {
    /// Encodes for the `light` track, quantised as the module says.
    ///
    /// # Errors
    /// When a value is out of its range or not finite.
    pub fn to_wire(&self) -> Result<bytes::Bytes, WireError> {
        let check = |ok, field, detail: String| ensure_in_range(ok, WireLightFrame::NAME, field, || detail);
        for (field, value) in self.sh.iter().map(|c| ("sh", *c)).chain(self.lights.iter().map(|l| ("lights.irradiance", l.irradiance))) {
            check(value.is_finite() && value.abs().max_element() <= MAX_MAGNITUDE, field, format!("{value}"))?;
        }
        for light in &self.lights {
            let length = light.direction.length();
            check((length - 1.0).abs() < 1e-3, "lights.direction", format!("{} is not a unit vector", light.direction))?;
            check(light.irradiance.min_element() >= 0.0, "lights.irradiance", format!("{}", light.irradiance))?;
            let solid_angle_sr = light.solid_angle_sr;
            let sphere = 4.0 * std::f32::consts::PI + 0.01;
            check(solid_angle_sr > 0.0 && solid_angle_sr <= sphere, "lights.solid_angle_sr", format!("{solid_angle_sr}"))?;
        }
        if let Lift::Recovered(recovery) = self.lift {
            // Rounding would make a sound colour of any.
            check(recovery.tint_ln.iter().all(|ln| ln.abs() <= MAX_TINT_LN), "lift.tint", format!("{:?}", recovery.tint_ln))?;
        }
        check(matches!(self.sh.len(), SH9 | SH25), "sh", format!("{} coefficients, {SH9} or {SH25} expected", self.sh.len()))?;
        WireLightFrame {
            pts_us: self.pts_us,
            published_after_us: self.published_us.wrapping_sub(self.pts_us) as i64,
            lift: WireLift::from(self.lift),
            sh_fine: std::array::from_fn(|i| half3(self.sh[i])),
            sh_coarse: COARSE.windows(2).filter_map(|band| self.sh.get(band[0]..band[1])).map(WireBand::new).collect(),
            lights: self.lights.iter().map(WireLight::new).collect(),
        }
        .to_wire()
    }

    /// Decodes what [`LightFrame::to_wire`] wrote.
    ///
    /// # Errors
    /// [`WireError`] for anything malformed, of another version, or out of range.
    pub fn from_wire(wire: &[u8]) -> Result<Self, WireError> {
        let wire = WireLightFrame::from_wire(wire)?;
        Ok(Self {
            pts_us: wire.pts_us,
            published_us: wire.pts_us.wrapping_add(wire.published_after_us as u64),
            lift: wire.lift.into(),
            sh: wire.sh_fine.iter().map(|c| vec3(*c)).chain(wire.sh_coarse.iter().flat_map(WireBand::coefficients)).collect(),
            lights: wire.lights.iter().map(WireLight::light).collect(),
        })
    }
}

/// Halves travel as two bytes: bincode's variable-length integers would take three for most of them.
type Half = [u8; 2];

#[derive(Serialize, Deserialize)]
enum WireLift {
    Linear,
    InverseToneMap,
    Recovered { gain_ln: Half, slope: [Half; 3], tint: [i8; 2] },
}

impl From<Lift> for WireLift {
    fn from(lift: Lift) -> Self {
        match lift {
            Lift::Linear => Self::Linear,
            Lift::InverseToneMap => Self::InverseToneMap,
            Lift::Recovered(Recovery { gain_ln, slope, tint_ln }) => {
                Self::Recovered { gain_ln: half(gain_ln), slope: half3(slope), tint: tint_ln.map(|ln| step(ln / MAX_TINT_LN)) }
            }
        }
    }
}

impl From<WireLift> for Lift {
    fn from(lift: WireLift) -> Self {
        match lift {
            WireLift::Linear => Self::Linear,
            WireLift::InverseToneMap => Self::InverseToneMap,
            WireLift::Recovered { gain_ln, slope, tint } => Self::Recovered(Recovery {
                gain_ln: unhalf(gain_ln),
                slope: vec3(slope),
                tint_ln: tint.map(|step| f32::from(step) / STEPS * MAX_TINT_LN),
            }),
        }
    }
}

/// One band of SH: steps of a scale, R, G and B of one coefficient after another.
#[derive(Serialize, Deserialize)]
struct WireBand {
    scale: Half,
    steps: Vec<i8>,
}

impl WireBand {
    fn new(coefficients: &[Vec3]) -> Self {
        let largest = coefficients.iter().map(|c| c.abs().max_element()).fold(0.0, f32::max);
        // As it will be read; rounded down it would leave the largest coefficient half a step short.
        let scale = f16::from_f32(largest);
        let inverse = if scale.to_f32() > 0.0 { 1.0 / scale.to_f32() } else { 0.0 };
        let steps = coefficients.iter().flat_map(|c| (*c * inverse).to_array()).map(step).collect();
        Self { scale: scale.to_le_bytes(), steps }
    }

    fn coefficients(&self) -> impl Iterator<Item = Vec3> + '_ {
        let step = unhalf(self.scale) / STEPS;
        self.steps.chunks_exact(3).map(move |rgb| Vec3::new(f32::from(rgb[0]), f32::from(rgb[1]), f32::from(rgb[2])) * step)
    }
}

/// Nearest step of a value in [−1, 1].
fn step(value: f32) -> i8 {
    (value.clamp(-1.0, 1.0) * STEPS).round() as i8
}

#[derive(Serialize, Deserialize)]
struct WireLight {
    id: u32,
    direction: [Half; 2],
    luminance: Half,
    /// Shares of red and blue in the sum of the channels, 12 bits each.
    chroma: [u8; 3],
    solid_angle: u8,
}

impl WireLight {
    fn new(light: &DirectionalLight) -> Self {
        let sum = light.irradiance.element_sum().max(f32::MIN_POSITIVE);
        let [red, blue] = [light.irradiance.x, light.irradiance.z].map(|channel| (channel / sum * CHROMA).round() as u16);
        let (least, most) = SOLID_ANGLE_LN;
        let solid_angle = (light.solid_angle_sr.ln() - least) / (most - least);
        Self {
            id: light.id,
            direction: octahedral_from_direction(light.direction),
            luminance: half(light.irradiance.dot(LUMA)),
            chroma: [red as u8, (red >> 8 | (blue & 15) << 4) as u8, (blue >> 4) as u8],
            solid_angle: (solid_angle.clamp(0.0, 1.0) * 255.0).round() as u8,
        }
    }

    fn shares(&self) -> Vec3 {
        let [low, middle, high] = self.chroma.map(u16::from);
        let [red, blue] = [low | (middle & 15) << 8, middle >> 4 | high << 4].map(|code| f32::from(code) / CHROMA);
        Vec3::new(red, (1.0 - red - blue).max(0.0), blue)
    }

    fn light(&self) -> DirectionalLight {
        let (least, most) = SOLID_ANGLE_LN;
        let shares = self.shares();
        DirectionalLight {
            id: self.id,
            direction: direction_from_octahedral(self.direction),
            irradiance: (shares * (unhalf(self.luminance) / shares.dot(LUMA))).min(Vec3::splat(MAX_MAGNITUDE)),
            solid_angle_sr: (least + f32::from(self.solid_angle) / 255.0 * (most - least)).exp(),
        }
    }
}

#[derive(Serialize, Deserialize)]
struct WireLightFrame {
    pts_us: u64,
    published_after_us: i64,
    lift: WireLift,
    sh_fine: [[Half; 3]; FINE],
    sh_coarse: Vec<WireBand>,
    lights: Vec<WireLight>,
}

impl Message for WireLightFrame {
    const NAME: &'static str = "light frame";
    const VERSION: u8 = 2;

    fn validate(&self) -> Result<(), WireError> {
        let check = |ok, field, detail: String| ensure_in_range(ok, Self::NAME, field, || detail);
        if let WireLift::Recovered { gain_ln, slope, tint } = self.lift {
            let (gain_ln, slope) = (unhalf(gain_ln), vec3(slope));
            check(gain_ln.abs() <= MAX_GAIN_LN, "lift.gain_ln", format!("{gain_ln}"))?;
            // No comparison holds for what is not a number.
            check(slope.abs().cmple(Vec3::splat(MAX_GAIN_SLOPE)).all(), "lift.slope", format!("{slope}"))?;
            check(tint.iter().all(|step| *step > i8::MIN), "lift.tint", format!("{tint:?}"))?;
        }
        check(self.sh_fine.iter().all(|c| vec3(*c).is_finite()), "sh", "not finite".to_owned())?;
        check(matches!(self.sh_coarse.len(), 1 | 3), "sh", format!("{} bands above the first, 1 or 3 expected", self.sh_coarse.len()))?;
        for (band, bounds) in self.sh_coarse.iter().zip(COARSE.windows(2)) {
            let expected = 3 * (bounds[1] - bounds[0]);
            check(band.steps.len() == expected, "sh", format!("{} values in a band of {expected}", band.steps.len()))?;
            let scale = unhalf(band.scale);
            check((0.0..=MAX_MAGNITUDE).contains(&scale), "sh", format!("scale {scale}"))?;
            check(band.steps.iter().all(|step| *step > i8::MIN), "sh", "a step below the lowest".to_owned())?;
        }
        check(self.lights.len() <= MAX_LIGHTS, "lights", format!("{} lights, at most {MAX_LIGHTS}", self.lights.len()))?;
        for light in &self.lights {
            let luminance = unhalf(light.luminance);
            check((0.0..=MAX_MAGNITUDE).contains(&luminance), "lights.irradiance", format!("luminance {luminance}"))?;
            let shares = light.shares();
            // Each is rounded by half a step.
            check(shares.x + shares.z <= 1.0 + 1.5 / CHROMA, "lights.irradiance", format!("shares {shares}"))?;
        }
        Ok(())
    }
}

fn half(value: f32) -> Half {
    f16::from_f32(value).to_le_bytes()
}

fn unhalf(value: Half) -> f32 {
    f16::from_le_bytes(value).to_f32()
}

fn half3(value: Vec3) -> [Half; 3] {
    value.to_array().map(half)
}

fn vec3(value: [Half; 3]) -> Vec3 {
    Vec3::from_array(value.map(unhalf))
}

/// Octahedral map (Meyer et al. 2010), 16 bits an axis: worst error below 0.005°.
fn octahedral_from_direction(direction: Vec3) -> [Half; 2] {
    let d = direction / (direction.x.abs() + direction.y.abs() + direction.z.abs());
    let folded = if d.y >= 0.0 { (d.x, d.z) } else { ((1.0 - d.z.abs()) * d.x.signum(), (1.0 - d.x.abs()) * d.z.signum()) };
    [folded.0, folded.1].map(|v| (((v.clamp(-1.0, 1.0) * 0.5 + 0.5) * 65_535.0).round() as u16).to_le_bytes())
}

fn direction_from_octahedral(wire: [Half; 2]) -> Vec3 {
    let [x, z] = wire.map(|v| f32::from(u16::from_le_bytes(v)) / 65_535.0 * 2.0 - 1.0);
    let y = 1.0 - x.abs() - z.abs();
    let under = (-y).max(0.0);
    Vec3::new(x - under * x.signum(), y, z - under * z.signum()).normalize()
}

#[cfg(test)]
mod tests;
