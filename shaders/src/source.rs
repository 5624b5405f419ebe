//! WGSL modules as one text each: a prelude of shared constants, then the module with its imports, each once.
//!
//! A line `#import "name.wgsl"` stands for the text of that file, at its first mention. Constants that the CPU
//! twins use too are written from their Rust values, so the two cannot drift apart.

use std::f32::consts::PI;
use std::fmt::Write as _;

use mr360_protocol::light::{Lift, MAX_GAIN_LN, MAX_MAGNITUDE, Recovery};
use mr360_protocol::video::Transfer;

use crate::layout::{CELLS, MAX_OCCLUDERS, SHADOW_MAP_SIZE};
use crate::{colour, lobe, sh};

/// Radii from an occluder's centre beyond which it hides exactly nothing.
pub const OCCLUDER_REACH: f32 = 5.0;
/// Half the side of the plane that hides what lies beneath the ground, metres.
pub const GROUND_EXTENT_M: f32 = 10_000.0;
/// Perceptual roughness up to which reflections come from the maps alone.
pub const ROUGH_FROM: f32 = 0.7;
/// Perceptual roughness from which reflections come from spherical harmonics alone.
pub const ROUGH_TO: f32 = 0.9;
/// GGX alpha below which a lobe is as good as a cone.
pub const MIRROR_ALPHA: f32 = 0.02;
/// Refractive index of glass.
pub const GLASS_IOR: f32 = 1.5;
/// Way through glass that leaves the share of light that its base colour names, metres (Beer and Lambert).
pub const GLASS_DEPTH_M: f32 = 0.1;

/// What a surface is shaded with; each kind has a pipeline of its own, which does no more than it needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Surface {
    /// Spherical harmonics alone.
    Rough,
    /// One cone of the panorama.
    Mirror,
    /// A lobe over the reflection map, and spherical harmonics where it is wide.
    Glossy,
    /// All of these: a texture says which.
    Varying,
    /// Clear glass.
    Glass,
}

impl Surface {
    /// The kind of a surface with one roughness all over.
    #[must_use]
    pub fn of(roughness: f32, glass: bool) -> Self {
        let roughness = roughness.clamp(0.0, 1.0);
        match roughness {
            _ if glass => Self::Glass,
            r if r >= ROUGH_TO => Self::Rough,
            r if r * r < MIRROR_ALPHA => Self::Mirror,
            _ => Self::Glossy,
        }
    }

    /// Its number in the shaders.
    #[must_use]
    pub fn index(self) -> u32 {
        self as u32
    }
}

/// What a surface's alpha does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub enum Alpha {
    /// Nothing.
    #[default]
    Opaque,
    /// Cuts holes.
    Mask,
    /// Lets through what lies behind.
    Blend,
}

impl Alpha {
    /// Its number in the shaders.
    #[must_use]
    pub fn index(self) -> u32 {
        self as u32
    }
}

/// How glossy surfaces look their lobes up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Reflections {
    /// In maps that are filtered over roughness once a video frame: one or two samples a pixel.
    #[default]
    Prefiltered,
    /// By 36 samples a pixel of the mips (Iorns & Rhee 2015, Sec. 3.2).
    Iorns,
    /// By 16 samples a pixel of the mips that follow the GGX lobe.
    Taps,
}

impl Reflections {
    /// Every method with its name on the command line.
    pub const ALL: [(Self, &str); 3] = [(Self::Prefiltered, "prefiltered"), (Self::Iorns, "iorns"), (Self::Taps, "taps")];

    /// Its number in the shaders.
    #[must_use]
    pub fn index(self) -> u32 {
        self as u32
    }
}

/// A shader module: a file with entry points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Module {
    /// Video to reflection map.
    EnvironmentLift,
    /// Reflection map to its next level.
    EnvironmentMip,
    /// Reflection map under lobes of one width.
    EnvironmentPrefilter,
    /// Depth from a light.
    Caster,
    /// Depth from a light, of surfaces with holes.
    Cutout,
    /// Vertices put into a pose.
    Deform,
    /// Virtual objects.
    Object,
    /// Virtual objects of glass, after all others.
    Glass,
    /// Ground and place as catchers of shadows and reflections.
    Ground,
    /// What the ground mirrors to its next level.
    MirrorMip,
    /// Video and objects to the target.
    Composite,
    /// Depth of a whole view.
    Depth,
    /// What is told of a frame, over the view.
    Overlay,
    /// A headset's picture in a window.
    Spectator,
    /// Which view is drawn, to find out whether one pass draws two.
    EyeProbe,
    /// Light kernels at given directions, for tests against their CPU twins.
    Probe,
    /// Surfaces under ambient light and one light, for tests against numerical integrals.
    BrdfProbe,
}

impl Module {
    /// Every module.
    pub const ALL: [Self; 17] = [
        Self::EnvironmentLift,
        Self::EnvironmentMip,
        Self::EnvironmentPrefilter,
        Self::Caster,
        Self::Cutout,
        Self::Deform,
        Self::Object,
        Self::Glass,
        Self::Ground,
        Self::MirrorMip,
        Self::Composite,
        Self::Depth,
        Self::Overlay,
        Self::Spectator,
        Self::EyeProbe,
        Self::Probe,
        Self::BrdfProbe,
    ];

    /// Name of its file.
    #[must_use]
    pub fn file(self) -> &'static str {
        match self {
            Self::EnvironmentLift => "environment_lift.wgsl",
            Self::EnvironmentMip => "environment_mip.wgsl",
            Self::EnvironmentPrefilter => "environment_prefilter.wgsl",
            Self::Caster => "caster.wgsl",
            Self::Cutout => "cutout.wgsl",
            Self::Deform => "deform.wgsl",
            Self::Object => "object.wgsl",
            Self::Glass => "glass.wgsl",
            Self::Ground => "ground.wgsl",
            Self::MirrorMip => "mirror_mip.wgsl",
            Self::Composite => "composite.wgsl",
            Self::Depth => "depth.wgsl",
            Self::Overlay => "overlay.wgsl",
            Self::Spectator => "spectator.wgsl",
            Self::EyeProbe => "eye_probe.wgsl",
            Self::Probe => "probe.wgsl",
            Self::BrdfProbe => "brdf_probe.wgsl",
        }
    }

    /// The whole text, ready for the compiler.
    ///
    /// # Errors
    /// [`ImportError`] naming a file that is not there; the module tests keep that from happening in a build.
    pub fn source(self) -> Result<String, ImportError> {
        let mut text = prelude();
        let mut seen = Vec::new();
        append(self.file(), &mut seen, &mut text)?;
        Ok(text)
    }
}

/// An import that names no file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("shader import \"{0}\" names no file under shaders/wgsl")]
pub struct ImportError(pub String);

macro_rules! files {
    ($($name:literal),* $(,)?) => {
        /// Every WGSL file, by name.
        const FILES: &[(&str, &str)] = &[$(($name, include_str!(concat!("../wgsl/", $name)))),*];
    };
}

files![
    "background.wgsl",
    "brdf.wgsl",
    "brdf_probe.wgsl",
    "caster.wgsl",
    "colour.wgsl",
    "composite.wgsl",
    "cube.wgsl",
    "cutout.wgsl",
    "deform.wgsl",
    "depth.wgsl",
    "environment_lift.wgsl",
    "environment_mip.wgsl",
    "environment_prefilter.wgsl",
    "equirect.wgsl",
    "eye.wgsl",
    "eye_probe.wgsl",
    "frame.wgsl",
    "fullscreen.wgsl",
    "glass.wgsl",
    "gloss.wgsl",
    "ground.wgsl",
    "material.wgsl",
    "mirror_mip.wgsl",
    "object.wgsl",
    "occlusion.wgsl",
    "overlay.wgsl",
    "parallax.wgsl",
    "probe.wgsl",
    "reflection.wgsl",
    "sh.wgsl",
    "shadow.wgsl",
    "spectator.wgsl",
    "video.wgsl",
];

fn append(name: &str, seen: &mut Vec<String>, text: &mut String) -> Result<(), ImportError> {
    if seen.iter().any(|file| file == name) {
        return Ok(());
    }
    seen.push(name.to_owned());
    let (_, source) = FILES.iter().find(|(file, _)| *file == name).ok_or_else(|| ImportError(name.to_owned()))?;
    for line in source.lines() {
        match line.strip_prefix("#import \"").and_then(|rest| rest.strip_suffix('"')) {
            Some(import) => append(import, seen, text)?,
            None => {
                text.push_str(line);
                text.push('\n');
            }
        }
    }
    Ok(())
}

/// Number of a transfer function in the shaders.
#[must_use]
pub fn transfer_index(transfer: Transfer) -> u32 {
    match transfer {
        Transfer::Linear => 0,
        Transfer::Bt709 => 1,
        Transfer::Srgb => 2,
        Transfer::Pq => 3,
        Transfer::Hlg => 4,
    }
}

/// Number of a lift in the shaders.
#[must_use]
pub fn lift_index(lift: Lift) -> u32 {
    match lift {
        Lift::Linear => 0,
        Lift::InverseToneMap => 1,
        Lift::Recovered(_) => 2,
    }
}

fn prelude() -> String {
    let [hlg_a, hlg_b, hlg_c] = colour::HLG_ABC;
    let [m1, m2] = colour::PQ_M;
    let [c1, c2, c3] = colour::PQ_C;
    let golden_angle = PI * (3.0 - 5.0f32.sqrt());
    let mut text = String::new();
    for (name, value) in [
        ("PI", PI),
        ("HDR_REFERENCE_WHITE", colour::HDR_REFERENCE_WHITE),
        ("HLG_PEAK", colour::HLG_PEAK),
        ("HLG_GAMMA", colour::HLG_GAMMA),
        ("HLG_A", hlg_a),
        ("HLG_B", hlg_b),
        ("HLG_C", hlg_c),
        ("PQ_M1", m1),
        ("PQ_M2", m2),
        ("PQ_C1", c1),
        ("PQ_C2", c2),
        ("PQ_C3", c3),
        ("IORNS_GAIN", colour::IORNS_GAIN),
        ("IORNS_EXPONENT", colour::IORNS_EXPONENT as f32),
        ("IORNS_BASE", colour::IORNS_BASE),
        ("MAX_MAGNITUDE", MAX_MAGNITUDE),
        ("MAX_GAIN_LN", MAX_GAIN_LN),
        ("CLIPPED_FIRST", colour::CLIPPED.0),
        ("CLIPPED_LAST", colour::CLIPPED.1),
        ("OCCLUDER_REACH", OCCLUDER_REACH),
        ("GROUND_EXTENT_M", GROUND_EXTENT_M),
        ("ROUGH_FROM", ROUGH_FROM),
        ("ROUGH_TO", ROUGH_TO),
        ("GLASS_IOR", GLASS_IOR),
        ("GLASS_DEPTH_M", GLASS_DEPTH_M),
        ("MIRROR_ALPHA", MIRROR_ALPHA),
        ("PREFILTER_ALPHA", lobe::PREFILTER_ALPHA),
        ("PREFILTER_RATIO", lobe::PREFILTER_RATIO),
        ("GOLDEN_COSINE", golden_angle.cos()),
        ("GOLDEN_SINE", golden_angle.sin()),
        ("SHADOW_MAP_SIZE", SHADOW_MAP_SIZE as f32),
        ("CELLS", CELLS as f32),
    ] {
        // {:?} prints the shortest text that reads back as the same float. Writing to a String cannot fail.
        let _ = writeln!(text, "const {name}: f32 = {value:?};");
    }
    for (name, value) in [
        ("TRANSFER_LINEAR", transfer_index(Transfer::Linear)),
        ("TRANSFER_BT709", transfer_index(Transfer::Bt709)),
        ("TRANSFER_SRGB", transfer_index(Transfer::Srgb)),
        ("TRANSFER_PQ", transfer_index(Transfer::Pq)),
        ("TRANSFER_HLG", transfer_index(Transfer::Hlg)),
        ("MAX_OCCLUDERS", MAX_OCCLUDERS as u32),
        ("MAX_TAPS", lobe::MAX_TAPS as u32),
        ("REFLECTIONS_IORNS", Reflections::Iorns.index()),
        ("REFLECTIONS_TAPS", Reflections::Taps.index()),
        ("ALPHA_MASK", Alpha::Mask.index()),
        ("ALPHA_OPAQUE", Alpha::Opaque.index()),
        ("ALPHA_BLEND", Alpha::Blend.index()),
        ("SURFACE_ROUGH", Surface::Rough.index()),
        ("SURFACE_MIRROR", Surface::Mirror.index()),
        ("SURFACE_GLOSSY", Surface::Glossy.index()),
        ("SURFACE_GLASS", Surface::Glass.index()),
        ("LIFT_INVERSE_TONE_MAP", lift_index(Lift::InverseToneMap)),
        ("LIFT_RECOVERED", lift_index(Lift::Recovered(Recovery::default()))),
    ] {
        let _ = writeln!(text, "const {name}: u32 = {value}u;");
    }
    for (name, luma) in [("IORNS_LUMA", colour::IORNS_LUMA), ("LUMA", colour::LUMA)] {
        let _ = writeln!(text, "const {name}: vec3<f32> = vec3({:?}, {:?}, {:?});", luma.x, luma.y, luma.z);
    }
    for (name, band) in [("IRRADIANCE_BAND", sh::IRRADIANCE_BAND), ("RADIANCE_BAND", [1.0; 5])] {
        let values = band.map(|value| format!("{value:?}")).join(", ");
        let _ = writeln!(text, "const {name} = array<f32, 5>({values});");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_module_is_valid() {
        for module in Module::ALL {
            let source = module.source().unwrap();
            let parsed = naga::front::wgsl::parse_str(&source)
                .unwrap_or_else(|error| panic!("{}: {}", module.file(), error.emit_to_string_with_path(&source, module.file())));
            naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty())
                .validate(&parsed)
                .unwrap_or_else(|error| panic!("{}: {}", module.file(), error.emit_to_string(&source)));
        }
    }

    #[test]
    fn every_file_is_listed_and_imported_once() {
        let mut on_disk: Vec<_> = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/wgsl"))
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        on_disk.sort();
        assert_eq!(on_disk, FILES.iter().map(|(name, _)| (*name).to_owned()).collect::<Vec<_>>());
        let object = Module::Object.source().unwrap();
        assert_eq!(object.matches("fn uv_from_direction").count(), 1);
        assert_eq!(append("missing.wgsl", &mut Vec::new(), &mut String::new()), Err(ImportError("missing.wgsl".to_owned())));
    }
}
