//! `SCENE.toml`, the scene as its author writes it.
//!
//! ```toml
//! ground_y = -1.6                 # height of the ground plane; the camera is at 0
//! ground = { roughness = 0.2 }    # how it mirrors objects; reflectance = 0.04 unless given; without it not at all
//! [[object]]
//! shape = "sphere"                # or "cube", "cylinder", "plane"; or model = "file.glb"
//! position = [0.0, -1.1, -3.0]    # metres
//! rotation_deg = [0.0, 30.0, 0.0] # about x, y, z, applied in the order y, x, z
//! scale = 1.0                     # or [x, y, z]
//! material = { base_color = [0.8, 0.8, 0.8], roughness = 0.3, metallic = 0.0, kind = "opaque" }
//! animation = "Walk"              # of models alone: one of the file's, or "none"; without it the file's first
//! [[place]]
//! model = "room.glb"              # of the real place: catches shadows and hides what is behind it
//! casts_shadows = true            # false for what holds the lights, or lies beyond them
//! gloss = { roughness = 0.2 }     # as the ground's
//! ```

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::{EulerRot, Quat, Vec3};
use serde::Deserialize;

use crate::asset::{AssetId, MAX_ASSETS};
use crate::codec::{WireError, ensure_in_range};
use crate::scene::{
    Geometry, Gloss, MAX_OBJECTS, MAX_PLACE_MESHES, Material, MaterialKind, Object, ObjectId, PlaceMesh, Playback, Scene, Shape, Transform,
};

/// What a scene file calls a model that stays at rest.
pub const NO_ANIMATION: &str = "none";
/// Largest scene file that is read.
pub const MAX_SCENE_FILE_BYTES: u64 = 1024 * 1024;

/// Why a scene file was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneFileError {
    /// Not readable.
    #[error("scene {path}: {fault}; check the path and its permissions")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's word.
        fault: String,
    },
    /// Not TOML, an unknown field, or a field of the wrong type.
    #[error("scene {path}: {fault}")]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, column and fault.
        fault: String,
    },
    /// An object that cannot be.
    #[error("scene {path}: object {index}: {fault}")]
    Object {
        /// The file.
        path: PathBuf,
        /// Counted from 1 in the order of the file.
        index: usize,
        /// Field, fault and remedy.
        fault: String,
    },
    /// A mesh of the place that cannot be.
    #[error("scene {path}: place {index}: {fault}")]
    Place {
        /// The file.
        path: PathBuf,
        /// Counted from 1 in the order of the file.
        index: usize,
        /// Field, fault and remedy.
        fault: String,
    },
    /// The whole is out of bounds.
    #[error("scene {path}: {fault}")]
    Scene {
        /// The file.
        path: PathBuf,
        /// Field, fault and remedy.
        fault: String,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FileScene {
    ground_y: f32,
    ground: Option<FileGloss>,
    #[serde(default, rename = "object")]
    objects: Vec<FileObject>,
    #[serde(default)]
    place: Vec<FilePlaceMesh>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FilePlaceMesh {
    model: PathBuf,
    #[serde(default)]
    position: [f32; 3],
    #[serde(default)]
    rotation_deg: [f32; 3],
    #[serde(default)]
    scale: FileScale,
    #[serde(default = "yes")]
    casts_shadows: bool,
    gloss: Option<FileGloss>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileGloss {
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
struct FileObject {
    shape: Option<Shape>,
    model: Option<PathBuf>,
    #[serde(default)]
    position: [f32; 3],
    #[serde(default)]
    rotation_deg: [f32; 3],
    #[serde(default)]
    scale: FileScale,
    material: Option<FileMaterial>,
    animation: Option<String>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(untagged, expecting = "scale is a number or three numbers")]
enum FileScale {
    Uniform(f32),
    Axes([f32; 3]),
}

impl Default for FileScale {
    fn default() -> Self {
        Self::Uniform(1.0)
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct FileMaterial {
    base_color: [f32; 3],
    roughness: Option<f32>,
    metallic: f32,
    kind: MaterialKind,
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

/// A scene whose models are still files.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneFile {
    path: PathBuf,
    ground_y: f32,
    ground: Gloss,
    objects: Vec<Checked>,
    place: Vec<CheckedPlace>,
}

/// A mesh of the place that is within bounds.
#[derive(Debug, Clone, PartialEq)]
struct CheckedPlace {
    model: PathBuf,
    transform: Transform,
    casts_shadows: bool,
    gloss: Gloss,
}

/// An object that is within bounds.
#[derive(Debug, Clone, PartialEq)]
struct Checked {
    geometry: FileGeometry,
    transform: Transform,
    material: Option<Material>,
    animation: Playback,
}

#[derive(Debug, Clone, PartialEq)]
enum FileGeometry {
    Shape(Shape),
    Model(PathBuf),
}

impl SceneFile {
    /// Reads and checks a scene file. Model paths are relative to the file's folder.
    ///
    /// # Errors
    /// [`SceneFileError`] naming the file, the object and the field.
    pub fn load(path: &Path) -> Result<Self, SceneFileError> {
        let read = |fault: String| SceneFileError::Read { path: path.to_owned(), fault };
        let metadata = std::fs::metadata(path).map_err(|error| read(error.to_string()))?;
        if metadata.len() > MAX_SCENE_FILE_BYTES {
            return Err(read(format!("{} bytes, at most {MAX_SCENE_FILE_BYTES}", metadata.len())));
        }
        let text = std::fs::read_to_string(path).map_err(|error| read(error.to_string()))?;
        Self::parse(&text, path)
    }

    /// Checks the text of a scene file that lies, or would lie, at `path`.
    ///
    /// # Errors
    /// As [`SceneFile::load`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, SceneFileError> {
        let file: FileScene =
            toml::from_str(text).map_err(|error| SceneFileError::Syntax { path: path.to_owned(), fault: error.to_string() })?;
        if file.objects.len() > MAX_OBJECTS {
            return Err(SceneFileError::Scene {
                path: path.to_owned(),
                fault: format!("{} objects, at most {MAX_OBJECTS}", file.objects.len()),
            });
        }
        if file.place.len() > MAX_PLACE_MESHES {
            return Err(SceneFileError::Scene {
                path: path.to_owned(),
                fault: format!("{} place meshes, at most {MAX_PLACE_MESHES}; join some in one model", file.place.len()),
            });
        }
        let folder = path.parent().unwrap_or(Path::new(""));
        let objects = file
            .objects
            .into_iter()
            .enumerate()
            .map(|(at, object)| {
                check(object, folder).map_err(|fault| SceneFileError::Object { path: path.to_owned(), index: at + 1, fault })
            })
            .collect::<Result<Vec<_>, _>>()?;
        let place = (1..).zip(file.place).map(|(index, mesh)| -> Result<_, SceneFileError> {
            check_place(mesh, folder).map_err(|fault| SceneFileError::Place { path: path.to_owned(), index, fault })
        });
        let place = place.collect::<Result<Vec<_>, _>>()?;
        let ground = file.ground.map(Gloss::from).unwrap_or_default();
        let scene = Self { path: path.to_owned(), ground_y: file.ground_y, ground, objects, place };
        let bounds = Scene { ground_y: scene.ground_y, ground, ..Scene::default() }.validate("scene file");
        bounds.map_err(|error| SceneFileError::Scene { path: path.to_owned(), fault: fault(&error) })?;
        if scene.models().len() > MAX_ASSETS {
            return Err(SceneFileError::Scene {
                path: path.to_owned(),
                fault: format!("{} models, at most {MAX_ASSETS}", scene.models().len()),
            });
        }
        Ok(scene)
    }

    /// The model files it names, each once.
    #[must_use]
    pub fn models(&self) -> Vec<&Path> {
        let mut models: Vec<&Path> = self
            .objects
            .iter()
            .filter_map(|object| match &object.geometry {
                FileGeometry::Model(path) => Some(path.as_path()),
                FileGeometry::Shape(_) => None,
            })
            .chain(self.place.iter().map(|mesh| mesh.model.as_path()))
            .collect();
        models.sort_unstable();
        models.dedup();
        models
    }

    /// The scene, with each model file replaced by the asset that `asset_of` makes of it; asked once for each file.
    ///
    /// # Errors
    /// What `asset_of` fails with, with the object or place mesh that names the model.
    pub fn resolve<'a, E: std::fmt::Display>(
        &'a self,
        mut asset_of: impl FnMut(&Path) -> Result<AssetId, E>,
    ) -> Result<Scene, SceneFileError> {
        let mut known: HashMap<&Path, AssetId> = HashMap::new();
        // The fault names no element: that is for whoever asks.
        let mut asset_once = |model: &'a Path| -> Result<AssetId, String> {
            if let Some(asset) = known.get(model) {
                return Ok(*asset);
            }
            let asset = asset_of(model).map_err(|error| format!("model {}: {error}", model.display()))?;
            known.insert(model, asset);
            Ok(asset)
        };
        let mut scene = Scene { ground_y: self.ground_y, ground: self.ground, ..Scene::default() };
        for (id, object) in (1..).zip(&self.objects) {
            let geometry = match &object.geometry {
                FileGeometry::Shape(shape) => Geometry::Shape(*shape),
                FileGeometry::Model(model) => Geometry::Model(asset_once(model).map_err(|fault| SceneFileError::Object {
                    path: self.path.clone(),
                    index: id as usize,
                    fault,
                })?),
            };
            let Checked { transform, material, animation, .. } = object.clone();
            scene.objects.push(Object { id: ObjectId(id), geometry, transform, material, animation });
        }
        for (index, mesh) in (1..).zip(&self.place) {
            let CheckedPlace { transform, casts_shadows, gloss, .. } = *mesh;
            let model = asset_once(&mesh.model).map_err(|fault| SceneFileError::Place { path: self.path.clone(), index, fault })?;
            scene.place.push(PlaceMesh { model, transform, casts_shadows, gloss });
        }
        Ok(scene)
    }
}

fn check_place(mesh: FilePlaceMesh, folder: &Path) -> Result<CheckedPlace, String> {
    let transform = transform(mesh.position, mesh.rotation_deg, mesh.scale)?;
    let gloss = mesh.gloss.map(Gloss::from).unwrap_or_default();
    gloss.validate("scene file").map_err(|error| fault(&error))?;
    Ok(CheckedPlace { model: folder.join(mesh.model), transform, casts_shadows: mesh.casts_shadows, gloss })
}

fn check(object: FileObject, folder: &Path) -> Result<Checked, String> {
    let geometry = match (object.shape, object.model) {
        (Some(shape), None) => FileGeometry::Shape(shape),
        (None, Some(model)) => FileGeometry::Model(folder.join(model)),
        (None, None) => return Err("neither shape nor model; give one".to_owned()),
        (Some(_), Some(_)) => return Err("both shape and model; give one".to_owned()),
    };
    let transform = transform(object.position, object.rotation_deg, object.scale)?;
    let material = object.material.map(Material::from).or(match geometry {
        FileGeometry::Shape(_) => Some(Material::default()),
        FileGeometry::Model(_) => None,
    });
    let animation = match object.animation {
        Some(_) if matches!(geometry, FileGeometry::Shape(_)) => return Err("animation: shapes have none; leave it out".to_owned()),
        Some(name) if name == NO_ANIMATION => Playback::Still,
        Some(name) => Playback::Named(name),
        None => Playback::First,
    };
    let shape = Geometry::Shape(Shape::Cube);
    let probe = Object { id: ObjectId(0), geometry: shape, transform, material, animation: animation.clone() };
    probe.validate("scene file").map_err(|error| fault(&error))?;
    Ok(Checked { geometry, transform, material, animation })
}

fn transform(position: [f32; 3], rotation_deg: [f32; 3], scale: FileScale) -> Result<Transform, String> {
    let [x, y, z] = rotation_deg.map(f32::to_radians);
    ensure_in_range([x, y, z].iter().all(|angle| angle.is_finite()), "scene file", "rotation_deg", || {
        format!("{rotation_deg:?} is not finite")
    })
    .map_err(|e| fault(&e))?;
    let transform = Transform {
        position: Vec3::from_array(position),
        rotation: Quat::from_euler(EulerRot::YXZ, y, x, z),
        scale: match scale {
            FileScale::Uniform(scale) => Vec3::splat(scale),
            FileScale::Axes(scale) => Vec3::from_array(scale),
        },
    };
    transform.validate("scene file").map_err(|error| fault(&error))?;
    Ok(transform)
}

/// Field and detail without the message's name: the file is named already.
fn fault(error: &WireError) -> String {
    match error {
        WireError::OutOfRange { field, detail, .. } => format!("{field} is out of range: {detail}"),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests;
