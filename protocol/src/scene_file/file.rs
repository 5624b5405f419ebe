//! The tables of a scene file, as they are written.

use std::path::PathBuf;

use glam::Vec3;
use serde::Deserialize;

use crate::scene::{Gloss, Material, MaterialKind, Shape};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FileScene {
    pub(super) ground_y: f32,
    pub(super) ground: Option<FileGloss>,
    #[serde(default, rename = "object")]
    pub(super) objects: Vec<FileObject>,
    #[serde(default)]
    pub(super) place: Vec<FilePlaceMesh>,
    /// Without one the library of shapes is there.
    pub(super) library: Option<Vec<FileItem>>,
}

/// How an object takes part in physics.
#[derive(Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum FilePhysics {
    /// Falls, collides, is thrown; where the author put it, it stays until somebody or something touches it.
    #[default]
    Dynamic,
    /// Stays where it is put.
    Fixed,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FileItem {
    pub(super) name: String,
    pub(super) shape: Option<Shape>,
    pub(super) model: Option<PathBuf>,
    #[serde(default)]
    pub(super) scale: FileScale,
    pub(super) material: Option<FileMaterial>,
    #[serde(default)]
    pub(super) physics: FilePhysics,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FilePlaceMesh {
    pub(super) model: PathBuf,
    #[serde(default)]
    pub(super) position: [f32; 3],
    #[serde(default)]
    pub(super) rotation_deg: [f32; 3],
    #[serde(default)]
    pub(super) scale: FileScale,
    #[serde(default = "yes")]
    pub(super) casts_shadows: bool,
    pub(super) gloss: Option<FileGloss>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FileGloss {
    roughness: f32,
    #[serde(default = "dielectric")]
    reflectance: f32,
}

fn dielectric() -> f32 {
    Gloss::DIELECTRIC
}

impl From<FileGloss> for Gloss {
    fn from(file: FileGloss) -> Self {
        Self { roughness: file.roughness, reflectance: file.reflectance }
    }
}

fn yes() -> bool {
    true
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FileObject {
    pub(super) shape: Option<Shape>,
    pub(super) model: Option<PathBuf>,
    #[serde(default)]
    pub(super) position: [f32; 3],
    #[serde(default)]
    pub(super) rotation_deg: [f32; 3],
    #[serde(default)]
    pub(super) scale: FileScale,
    pub(super) material: Option<FileMaterial>,
    pub(super) animation: Option<String>,
    #[serde(default)]
    pub(super) physics: FilePhysics,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(untagged, expecting = "scale is a number or three numbers")]
pub(super) enum FileScale {
    Uniform(f32),
    Axes([f32; 3]),
}

impl From<FileScale> for Vec3 {
    fn from(scale: FileScale) -> Self {
        match scale {
            FileScale::Uniform(scale) => Self::splat(scale),
            FileScale::Axes(scale) => Self::from_array(scale),
        }
    }
}

impl Default for FileScale {
    fn default() -> Self {
        Self::Uniform(1.0)
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct FileMaterial {
    pub(super) base_color: [f32; 3],
    pub(super) roughness: Option<f32>,
    pub(super) metallic: f32,
    pub(super) kind: MaterialKind,
}

impl Default for FileMaterial {
    fn default() -> Self {
        let Material { base_color, metallic, kind, .. } = Material::default();
        Self { base_color, roughness: None, metallic, kind }
    }
}

impl From<FileMaterial> for Material {
    /// Glass is clear unless the file says otherwise; all else is matt.
    fn from(file: FileMaterial) -> Self {
        let FileMaterial { base_color, roughness, metallic, kind } = file;
        let unsaid = if kind == MaterialKind::Glass { 0.0 } else { Self::default().roughness };
        Self { base_color, roughness: roughness.unwrap_or(unsaid), metallic, kind }
    }
}
