//! What `render` is given: panorama, scene and light from files.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context as _, bail};
use glam::Vec3;
use half::f16;
use image::ImageFormat;
use mr360_protocol::asset::{AssetId, MAX_ASSET_BYTES};
use mr360_protocol::light::{DirectionalLight, Lift, LightFrame, MAX_MAGNITUDE, SH9};
use mr360_protocol::scene::Scene;
use mr360_protocol::scene_file::SceneFile;
use mr360_protocol::video::{StereoLayout, Transfer};
use mr360_shaders::colour::decode_transfer;
use mr360_shaders::project::project;
use serde::Deserialize;

use crate::picture::{Picture, Samples};
use crate::scene::model::Model;

/// Longest side of a panorama, pixels.
const MAX_SIDE: u32 = 16_384;
/// Most bytes that decoding a panorama may take.
const MAX_PANORAMA_BYTES: u64 = 2 * 1024 * 1024 * 1024;
/// Largest light file that is read.
const MAX_LIGHT_BYTES: u64 = 1024 * 1024;

/// Reads a panorama: linear from .exr and .hdr, sRGB from everything else. Negative and non-finite values, as
/// compression leaves them, become 0; others are held below the largest half float.
///
/// # Errors
/// Naming the file.
pub fn load_panorama(path: &Path, stereo: StereoLayout) -> anyhow::Result<Picture> {
    let named = || format!("panorama {}", path.display());
    let mut reader = image::ImageReader::open(path).with_context(named)?.with_guessed_format().with_context(named)?;
    let linear = matches!(reader.format(), Some(ImageFormat::OpenExr | ImageFormat::Hdr));
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_PANORAMA_BYTES);
    reader.limits(limits);
    let decoded = reader
        .decode()
        .with_context(|| format!("{}: not a readable .exr, .hdr, .png or .jpg of at most {MAX_SIDE} pixels a side", named()))?;
    let pixels = decoded.into_rgb32f();
    let held = |value: f32| f16::from_f32(if value.is_nan() { 0.0 } else { value.clamp(0.0, MAX_MAGNITUDE) });
    let texels = pixels.pixels().flat_map(|p| [held(p.0[0]), held(p.0[1]), held(p.0[2]), f16::ONE]).collect();
    let transfer = if linear { Transfer::Linear } else { Transfer::Srgb };
    Ok(Picture { pts_us: 0, width: pixels.width(), height: pixels.height(), stereo, samples: Samples::Rgba16F { texels, transfer } })
}

/// Models by name.
pub type Models = HashMap<AssetId, Arc<Model>>;

/// Reads a scene and the models it names.
///
/// # Errors
/// Naming the file, the object and what is wrong with it.
pub fn load_scene(path: &Path) -> anyhow::Result<(Scene, Models)> {
    let mut assets = HashMap::new();
    let scene = SceneFile::load(path)?.resolve(|model| {
        let size = std::fs::metadata(model).map_err(|error| error.to_string())?.len();
        if size > MAX_ASSET_BYTES as u64 {
            return Err(format!("{size} bytes, at most {MAX_ASSET_BYTES}"));
        }
        let bytes = std::fs::read(model).map_err(|error| error.to_string())?;
        let id = AssetId::of(&bytes);
        if let Entry::Vacant(slot) = assets.entry(id) {
            slot.insert(Arc::new(Model::parse(&bytes).map_err(|error| error.to_string())?));
        }
        Ok(id)
    })?;
    Ok((scene, assets))
}

#[derive(Deserialize)]
struct FileLight {
    sh: Vec<[f32; 3]>,
    lights: Vec<FileDirectional>,
    #[serde(default)]
    lift: Lift,
}

#[derive(Deserialize)]
struct FileDirectional {
    #[serde(default)]
    id: u32,
    direction: [f32; 3],
    irradiance: [f32; 3],
    solid_angle_sr: f32,
}

/// Reads the first JSON object of a file as `mr360-server analyze --json` prints them.
///
/// # Errors
/// Naming the file and the field.
pub fn load_light(path: &Path) -> anyhow::Result<LightFrame> {
    let named = || format!("light {}", path.display());
    if std::fs::metadata(path).with_context(named)?.len() > MAX_LIGHT_BYTES {
        bail!("{}: more than {MAX_LIGHT_BYTES} bytes; give one frame of analyze --json", named());
    }
    let text = std::fs::read_to_string(path).with_context(named)?;
    let first = serde_json::Deserializer::from_str(&text).into_iter::<FileLight>().next();
    let file = first.with_context(|| format!("{}: holds no JSON object", named()))?.with_context(named)?;
    let light = |light: FileDirectional| DirectionalLight {
        id: light.id,
        direction: Vec3::from_array(light.direction).normalize_or_zero(),
        irradiance: Vec3::from_array(light.irradiance),
        solid_angle_sr: light.solid_angle_sr,
    };
    let frame = LightFrame {
        pts_us: 0,
        published_us: 0,
        lift: file.lift,
        sh: file.sh.into_iter().map(Vec3::from_array).collect(),
        lights: file.lights.into_iter().map(light).collect(),
    };
    // What could not be broadcast is no light: the wire's bounds on counts and ranges hold here too.
    frame.to_wire().with_context(named)?;
    Ok(frame)
}

/// Spherical harmonics of the left eye's panorama, and no lights.
#[must_use]
pub fn ambient_light(picture: &Picture) -> LightFrame {
    let (width, height) = picture.stereo.eye_size(picture.width, picture.height);
    let radiance: Vec<Vec3> = match &picture.samples {
        Samples::Rgba16F { texels, transfer } => texels
            .chunks_exact(picture.width as usize * 4)
            .take(height as usize)
            .flat_map(|row| row.chunks_exact(4).take(width as usize))
            .map(|texel| decode_transfer(*transfer, Vec3::new(texel[0].to_f32(), texel[1].to_f32(), texel[2].to_f32())))
            .collect(),
        Samples::Yuv { .. } => Vec::new(),
    };
    LightFrame { pts_us: 0, published_us: 0, lift: Lift::Linear, sh: project::<SH9>(&radiance, width, height).to_vec(), lights: Vec::new() }
}
