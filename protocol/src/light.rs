//! The light of one video frame: a few directional lights and the spherical harmonics of the rest.

use glam::Vec3;
use half::f16;
use serde::{Deserialize, Serialize};

use crate::codec::{Message, WireError, ensure_in_range};

/// Number of SH coefficients for bands 0–2.
pub const SH9: usize = 9;
/// Number of SH coefficients for bands 0–4.
pub const SH25: usize = 25;
/// Most lights a frame may carry.
pub const MAX_LIGHTS: usize = 64;
/// Largest radiance, coefficient or irradiance that crosses the wire: the largest finite half float.
pub const MAX_MAGNITUDE: f32 = 65_504.0;

/// A light at infinity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DirectionalLight {
    /// Stays with the light from frame to frame where the method follows lights (`directional`, `k-means`); elsewhere it is the rank in this
    /// frame and says nothing of other frames.
    pub id: u32,
    /// Unit vector towards the light.
    pub direction: Vec3,
    /// Irradiance on a surface that faces the light, RGB, radiance·sr.
    pub irradiance: Vec3,
    /// Solid angle, in (0, 4π].
    pub solid_angle_sr: f32,
}

/// How the video's code values become the radiance that the lights and the SH were taken from; a client
/// applies the same curve to its own decoded video for reflections.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
pub enum Lift {
    /// The video's own transfer function inverted; nothing above display white is made up.
    #[default]
    Linear,
    /// Inverse tone map of Iorns & Rhee 2015, Eq. 1–3, on the code values.
    InverseToneMap,
    /// Linear, with the highlight boost of the inverse tone map scaled so that mid-tones keep their value.
    Highlights,
}

/// All light of one video frame. No part of it is in both: what becomes a light is taken out of what the SH are made of.
///
/// Together they hold the energy that the method takes the frame to have. That is the energy of the video under [`lift`](Self::lift), up to the
/// rounding of the wire, except where a method says otherwise:
///
/// - `directional` adds to clipped LDR video what the ground shows to be missing, which a client cannot find in its own copy of the
///   video, and smooths exposure and lights over time: a frame's energy is then that of the smoothed exposure, 2 % off within its noise and
///   more for a frame or two after a jump.
/// - `mr360` multiplies each light of LDR video by 0.5 to 1.5 according to its size, as its paper asks for, and leaves the SH as they are.
/// - `iorns` and `sh` have no lights, and low-order SH hold the mean exactly but not the detail.
#[derive(Debug, Clone, PartialEq)]
pub struct LightFrame {
    /// Presentation time of the video frame this belongs to, and of no other.
    pub pts_us: u64,
    /// Server clock when the frame was handed to the transport, in microseconds since the broadcast began.
    pub published_us: u64,
    /// How radiance was made from code values.
    pub lift: Lift,
    /// Radiance, real SH, [`SH9`] or [`SH25`] coefficients, not convolved.
    pub sh: Vec<Vec3>,
    /// Strongest first.
    pub lights: Vec<DirectionalLight>,
}

impl LightFrame {
    /// Brings what is finite but above [`MAX_MAGNITUDE`] down to it: each light by itself, the SH together, so that
    /// colours and the shape of the SH stay. Returns how many were held back, the SH counted as one. A frame that is
    /// somewhat too dim lights a scene better than the last one that did fit.
    pub fn hold_to_range(&mut self) -> usize {
        let hold = |values: &mut [&mut Vec3]| {
            let largest = values.iter().map(|value| value.abs().max_element()).fold(0.0, f32::max);
            let over = largest.is_finite() && largest > MAX_MAGNITUDE;
            if over {
                let range = Vec3::splat(MAX_MAGNITUDE);
                // The product may be an ulp above the bound.
                values.iter_mut().for_each(|value| **value = (**value * (MAX_MAGNITUDE / largest)).clamp(-range, range));
            }
            usize::from(over)
        };
        let lights: usize = self.lights.iter_mut().map(|light| hold(&mut [&mut light.irradiance])).sum();
        let mut sh: Vec<&mut Vec3> = self.sh.iter_mut().collect();
        lights + hold(&mut sh)
    }

    /// Encodes for the `light` track. Values are quantised: half floats, octahedral directions of 16 bits.
    ///
    /// # Errors
    /// When a value is out of its range or not finite.
    pub fn to_wire(&self) -> Result<bytes::Bytes, WireError> {
        for (field, value) in self.sh.iter().map(|c| ("sh", *c)).chain(self.lights.iter().map(|l| ("lights.irradiance", l.irradiance))) {
            ensure_in_range(value.is_finite() && value.abs().max_element() <= MAX_MAGNITUDE, WireLightFrame::NAME, field, || {
                format!("{value}")
            })?;
        }
        for light in &self.lights {
            ensure_in_range((light.direction.length() - 1.0).abs() < 1e-3, WireLightFrame::NAME, "lights.direction", || {
                format!("{} is not a unit vector", light.direction)
            })?;
        }
        WireLightFrame {
            pts_us: self.pts_us,
            published_us: self.published_us,
            lift: self.lift,
            sh: self.sh.iter().map(|c| half3(*c)).collect(),
            lights: self
                .lights
                .iter()
                .map(|light| WireLight {
                    id: light.id,
                    direction: octahedral_from_direction(light.direction),
                    irradiance: half3(light.irradiance),
                    solid_angle_sr: half(light.solid_angle_sr),
                })
                .collect(),
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
            published_us: wire.published_us,
            lift: wire.lift,
            sh: wire.sh.iter().map(|c| vec3(*c)).collect(),
            lights: wire
                .lights
                .iter()
                .map(|light| DirectionalLight {
                    id: light.id,
                    direction: direction_from_octahedral(light.direction),
                    irradiance: vec3(light.irradiance),
                    solid_angle_sr: unhalf(light.solid_angle_sr),
                })
                .collect(),
        })
    }
}

/// Halves travel as two bytes: bincode's variable-length integers would take three for most of them.
type Half = [u8; 2];

#[derive(Serialize, Deserialize)]
struct WireLight {
    id: u32,
    direction: [Half; 2],
    irradiance: [Half; 3],
    solid_angle_sr: Half,
}

#[derive(Serialize, Deserialize)]
struct WireLightFrame {
    pts_us: u64,
    published_us: u64,
    lift: Lift,
    sh: Vec<[Half; 3]>,
    lights: Vec<WireLight>,
}

impl Message for WireLightFrame {
    const NAME: &'static str = "light frame";
    const VERSION: u8 = 1;

    fn validate(&self) -> Result<(), WireError> {
        let check = |ok, field, detail: String| ensure_in_range(ok, Self::NAME, field, || detail);
        check(matches!(self.sh.len(), SH9 | SH25), "sh", format!("{} coefficients, {SH9} or {SH25} expected", self.sh.len()))?;
        check(self.lights.len() <= MAX_LIGHTS, "lights", format!("{} lights, at most {MAX_LIGHTS}", self.lights.len()))?;
        check(self.sh.iter().all(|c| vec3(*c).is_finite()), "sh", "not finite".to_owned())?;
        for light in &self.lights {
            let irradiance = vec3(light.irradiance);
            check(irradiance.is_finite() && irradiance.min_element() >= 0.0, "lights.irradiance", format!("{irradiance}"))?;
            let solid_angle_sr = unhalf(light.solid_angle_sr);
            check(
                solid_angle_sr > 0.0 && solid_angle_sr <= 4.0 * std::f32::consts::PI + 0.01,
                "lights.solid_angle_sr",
                format!("{solid_angle_sr}"),
            )?;
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
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frame(lights: usize) -> LightFrame {
        let lights = (0..lights as u32).map(|id| DirectionalLight {
            id,
            direction: Vec3::new(id as f32 - 1.5, 1.0, -0.3).normalize(),
            irradiance: Vec3::new(3.0, 2.5, 2.0),
            solid_angle_sr: 6.8e-5,
        });
        LightFrame {
            pts_us: 3_600_000_000 * 24,
            published_us: 3_600_000_000 * 24 + 70_000,
            lift: Lift::Linear,
            sh: vec![Vec3::splat(0.7); SH9],
            lights: lights.collect(),
        }
    }

    #[test]
    fn four_lights_fit_in_200_bytes() {
        let wire = frame(4).to_wire().unwrap();
        assert!(wire.len() <= 200, "{} bytes", wire.len());
    }

    #[test]
    fn another_version_is_refused_by_name() {
        let mut wire = frame(1).to_wire().unwrap().to_vec();
        wire[0] = 9;
        assert!(matches!(LightFrame::from_wire(&wire), Err(WireError::UnknownVersion { got: 9, expected: 1, .. })));
    }

    #[test]
    fn trailing_bytes_are_refused() {
        let mut wire = frame(1).to_wire().unwrap().to_vec();
        wire.push(0);
        assert!(matches!(LightFrame::from_wire(&wire), Err(WireError::Malformed { .. })));
    }

    #[test]
    fn strong_light_is_held_to_the_range_and_keeps_its_colour() {
        let mut strong = frame(2);
        strong.lights[1].irradiance = Vec3::new(4e9, 2e9, 1e9);
        strong.sh[0] = Vec3::new(1e5, 5e4, 0.0);
        strong.sh[3] = Vec3::splat(-2e5);
        assert!(strong.to_wire().is_err());
        assert_eq!(strong.hold_to_range(), 2);
        let back = LightFrame::from_wire(&strong.to_wire().unwrap()).unwrap();
        // Half floats have 11 bits.
        let close = |got: Vec3, expected: Vec3| assert!((got - expected).abs().max_element() < 5e-4 * MAX_MAGNITUDE, "{got} {expected}");
        close(back.lights[0].irradiance, Vec3::new(3.0, 2.5, 2.0));
        close(back.lights[1].irradiance, Vec3::new(1.0, 0.5, 0.25) * MAX_MAGNITUDE);
        close(back.sh[0], Vec3::new(0.5, 0.25, 0.0) * MAX_MAGNITUDE);
        close(back.sh[3], Vec3::splat(-MAX_MAGNITUDE));
        assert_eq!(strong.hold_to_range(), 0);
        // What is not finite is a fault, and no strong light.
        strong.lights[0].irradiance.x = f32::INFINITY;
        assert_eq!(strong.hold_to_range(), 0);
        assert!(strong.to_wire().is_err());
    }

    #[test]
    fn non_finite_values_are_never_sent() {
        let mut bad = frame(1);
        bad.sh[3].y = f32::NAN;
        assert!(matches!(bad.to_wire(), Err(WireError::OutOfRange { field: "sh", .. })));
        let mut bad = frame(1);
        bad.lights[0].irradiance.x = f32::INFINITY;
        assert!(matches!(bad.to_wire(), Err(WireError::OutOfRange { field: "lights.irradiance", .. })));
    }

    proptest! {
        #[test]
        fn directions_survive_within_5_millidegrees(x in -1.0f32..1.0, y in -1.0f32..1.0, z in -1.0f32..1.0) {
            let direction = Vec3::new(x, y, z);
            prop_assume!(direction.length() > 0.01);
            let direction = direction.normalize();
            let back = direction_from_octahedral(octahedral_from_direction(direction));
            // The chord is used because the arc cosine of a number near 1 loses the small angle.
            prop_assert!((back - direction).length().to_degrees() < 0.005);
        }

        #[test]
        fn random_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
            let mut versioned = bytes.clone();
            if let Some(first) = versioned.first_mut() { *first = WireLightFrame::VERSION; }
            let _ = LightFrame::from_wire(&bytes);
            let _ = LightFrame::from_wire(&versioned);
        }
    }
}
