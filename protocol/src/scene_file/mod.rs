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
//! physics = "dynamic"             # falls once somebody or something has touched it; or "fixed": stays where it is put
//! [[place]]
//! model = "room.glb"              # of the real place: catches shadows and hides what is behind it
//! casts_shadows = true            # false for what holds the lights, or lies beyond them
//! gloss = { roughness = 0.2 }     # as the ground's
//! [[library]]                     # what users may add; without any, one of each shape
//! name = "chair"                  # shape or model, scale, material and physics as for objects
//! model = "chair.glb"
//! ```

mod file;
#[cfg(test)]
mod tests;

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};

use glam::{EulerRot, Quat, Vec3};

use crate::asset::{AssetId, MAX_ASSETS};
use crate::codec::{WireError, ensure_in_range};
use crate::scene::{
    Geometry, Gloss, LibraryItem, MAX_LIBRARY, MAX_OBJECTS, MAX_PLACE_MESHES, Material, Object, ObjectId, PlaceMesh, Playback, Scene,
    Shape, Transform,
};
use file::{FileItem, FileMaterial, FileObject, FilePhysics, FilePlaceMesh, FileScale, FileScene};

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
    /// An item of the library that cannot be.
    #[error("scene {path}: library {index}: {fault}")]
    Library {
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

/// A scene whose models are still files.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneFile {
    path: PathBuf,
    ground_y: f32,
    ground: Gloss,
    objects: Vec<Checked>,
    place: Vec<CheckedPlace>,
    library: Option<Vec<CheckedItem>>,
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
    fixed: bool,
}

/// An item of the library that is within bounds.
#[derive(Debug, Clone, PartialEq)]
struct CheckedItem {
    name: String,
    geometry: FileGeometry,
    scale: Vec3,
    material: Option<Material>,
    fixed: bool,
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
        let at_most = |count: usize, limit: usize, what: &str, remedy: &str| match count > limit {
            true => Err(SceneFileError::Scene { path: path.to_owned(), fault: format!("{count} {what}, at most {limit}; {remedy}") }),
            false => Ok(()),
        };
        at_most(file.objects.len(), MAX_OBJECTS, "objects", "join some in one model")?;
        at_most(file.place.len(), MAX_PLACE_MESHES, "place meshes", "join some in one model")?;
        at_most(file.library.as_ref().map_or(0, Vec::len), MAX_LIBRARY, "items of the library", "leave some out")?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let objects = (1..)
            .zip(file.objects)
            .map(|(index, object)| check(object, folder).map_err(|fault| SceneFileError::Object { path: path.to_owned(), index, fault }))
            .collect::<Result<Vec<_>, _>>()?;
        let check_items = |items| {
            (1..).zip(items).map(|(index, item)| {
                check_item(item, folder).map_err(|fault| SceneFileError::Library { path: path.to_owned(), index, fault })
            })
        };
        let library = file.library.map(|items| check_items(items).collect::<Result<Vec<_>, _>>()).transpose()?;
        let place = (1..).zip(file.place).map(|(index, mesh)| -> Result<_, SceneFileError> {
            check_place(mesh, folder).map_err(|fault| SceneFileError::Place { path: path.to_owned(), index, fault })
        });
        let place = place.collect::<Result<Vec<_>, _>>()?;
        let ground = file.ground.map(Gloss::from).unwrap_or_default();
        let scene = Self { path: path.to_owned(), ground_y: file.ground_y, ground, objects, place, library };
        let bounds = Scene { ground_y: scene.ground_y, ground, ..Scene::default() }.validate("scene file");
        bounds.map_err(|error| SceneFileError::Scene { path: path.to_owned(), fault: fault(&error) })?;
        at_most(scene.models().len(), MAX_ASSETS, "models", "join some in one file")?;
        Ok(scene)
    }

    /// The model files it names, each once.
    #[must_use]
    pub fn models(&self) -> Vec<&Path> {
        let items = self.library.iter().flatten();
        let mut models: Vec<&Path> = (self.objects.iter().map(|object| &object.geometry))
            .chain(items.map(|item| &item.geometry))
            .filter_map(|geometry| match geometry {
                FileGeometry::Model(path) => Some(path.as_path()),
                FileGeometry::Shape(_) => None,
            })
            .chain(self.place.iter().map(|mesh| mesh.model.as_path()))
            .collect();
        models.sort_unstable();
        models.dedup();
        models
    }

    /// The objects that stay where they are put, as [`SceneFile::resolve`] names them.
    #[must_use]
    pub fn fixed_objects(&self) -> BTreeSet<ObjectId> {
        (1..).zip(&self.objects).filter(|(_, object)| object.fixed).map(|(id, _)| ObjectId(id)).collect()
    }

    /// The items of the library that stay where they are put, by index.
    #[must_use]
    pub fn fixed_items(&self) -> BTreeSet<u16> {
        (0..).zip(self.library.iter().flatten()).filter(|(_, item)| item.fixed).map(|(index, _)| index).collect()
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
            let geometry = object.geometry.resolve(&mut asset_once).map_err(|fault| SceneFileError::Object {
                path: self.path.clone(),
                index: id as usize,
                fault,
            })?;
            let Checked { transform, material, animation, .. } = object.clone();
            scene.objects.push(Object { id: ObjectId(id), geometry, transform, material, animation });
        }
        for (index, mesh) in (1..).zip(&self.place) {
            let CheckedPlace { transform, casts_shadows, gloss, .. } = *mesh;
            let model = asset_once(&mesh.model).map_err(|fault| SceneFileError::Place { path: self.path.clone(), index, fault })?;
            scene.place.push(PlaceMesh { model, transform, casts_shadows, gloss });
        }
        if let Some(items) = &self.library {
            let resolved = (1..).zip(items).map(|(index, item)| -> Result<_, SceneFileError> {
                let fault = |fault| SceneFileError::Library { path: self.path.clone(), index, fault };
                let geometry = item.geometry.resolve(&mut asset_once).map_err(fault)?;
                Ok(LibraryItem { name: item.name.clone(), geometry, scale: item.scale, material: item.material })
            });
            scene.library = resolved.collect::<Result<_, _>>()?;
        }
        Ok(scene)
    }
}

impl FileGeometry {
    fn new(shape: Option<Shape>, model: Option<PathBuf>, folder: &Path) -> Result<Self, String> {
        match (shape, model) {
            (Some(shape), None) => Ok(Self::Shape(shape)),
            (None, Some(model)) => Ok(Self::Model(folder.join(model))),
            (None, None) => Err("neither shape nor model; give one".to_owned()),
            (Some(_), Some(_)) => Err("both shape and model; give one".to_owned()),
        }
    }

    /// Shapes without a material are matt, models keep that of their file.
    fn material(&self, material: Option<FileMaterial>) -> Option<Material> {
        material.map(Material::from).or(match self {
            Self::Shape(_) => Some(Material::default()),
            Self::Model(_) => None,
        })
    }

    fn resolve<'a>(&'a self, mut asset: impl FnMut(&'a Path) -> Result<AssetId, String>) -> Result<Geometry, String> {
        match self {
            Self::Shape(shape) => Ok(Geometry::Shape(*shape)),
            Self::Model(model) => asset(model).map(Geometry::Model),
        }
    }
}

fn check_place(mesh: FilePlaceMesh, folder: &Path) -> Result<CheckedPlace, String> {
    let transform = transform(mesh.position, mesh.rotation_deg, mesh.scale)?;
    let gloss = mesh.gloss.map(Gloss::from).unwrap_or_default();
    gloss.validate("scene file").map_err(|error| fault(&error))?;
    Ok(CheckedPlace { model: folder.join(mesh.model), transform, casts_shadows: mesh.casts_shadows, gloss })
}

fn check(object: FileObject, folder: &Path) -> Result<Checked, String> {
    let geometry = FileGeometry::new(object.shape, object.model, folder)?;
    let transform = transform(object.position, object.rotation_deg, object.scale)?;
    let material = geometry.material(object.material);
    let animation = match object.animation {
        Some(_) if matches!(geometry, FileGeometry::Shape(_)) => return Err("animation: shapes have none; leave it out".to_owned()),
        Some(name) if name == NO_ANIMATION => Playback::Still,
        Some(name) => Playback::Named(name),
        None => Playback::First,
    };
    let shape = Geometry::Shape(Shape::Cube);
    let probe = Object { id: ObjectId(0), geometry: shape, transform, material, animation: animation.clone() };
    probe.validate("scene file").map_err(|error| fault(&error))?;
    Ok(Checked { geometry, transform, material, animation, fixed: object.physics == FilePhysics::Fixed })
}

fn check_item(item: FileItem, folder: &Path) -> Result<CheckedItem, String> {
    let geometry = FileGeometry::new(item.shape, item.model, folder)?;
    let (scale, material) = (item.scale.into(), geometry.material(item.material));
    let probe = LibraryItem { name: item.name.clone(), geometry: Geometry::Shape(Shape::Cube), scale, material };
    probe.validate("scene file").map_err(|error| fault(&error))?;
    Ok(CheckedItem { name: item.name, geometry, scale, material, fixed: item.physics == FilePhysics::Fixed })
}

fn transform(position: [f32; 3], rotation_deg: [f32; 3], scale: FileScale) -> Result<Transform, String> {
    let [x, y, z] = rotation_deg.map(f32::to_radians);
    ensure_in_range([x, y, z].iter().all(|angle| angle.is_finite()), "scene file", "rotation_deg", || {
        format!("{rotation_deg:?} is not finite")
    })
    .map_err(|e| fault(&e))?;
    let rotation = Quat::from_euler(EulerRot::YXZ, y, x, z);
    let transform = Transform { position: Vec3::from_array(position), rotation, scale: scale.into() };
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
