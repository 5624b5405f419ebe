//! `SCENE.toml`, the scene as its author writes it.
//!
//! ```toml
//! ground_y = -1.6                 # height of the ground plane; the camera is at 0
//! [[object]]
//! shape = "sphere"                # or "cube", "cylinder", "plane"; or model = "file.glb"
//! position = [0.0, -1.1, -3.0]    # metres
//! rotation_deg = [0.0, 30.0, 0.0] # about x, y, z, applied in the order y, x, z
//! scale = 1.0                     # or [x, y, z]
//! material = { base_color = [0.8, 0.8, 0.8], roughness = 0.3, metallic = 0.0, kind = "opaque" }
//! animation = "Walk"              # of models alone: one of the file's, or "none"; without it the file's first
//! ```

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::{EulerRot, Quat, Vec3};
use serde::Deserialize;

use crate::asset::{AssetId, MAX_ASSETS};
use crate::codec::{WireError, ensure_in_range};
use crate::scene::{Geometry, MAX_OBJECTS, Material, MaterialKind, Object, ObjectId, Playback, Scene, Shape, Transform};

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
    #[serde(default, rename = "object")]
    objects: Vec<FileObject>,
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

#[derive(Deserialize)]
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
    roughness: f32,
    metallic: f32,
    kind: MaterialKind,
}

impl Default for FileMaterial {
    fn default() -> Self {
        let Material { base_color, roughness, metallic, kind } = Material::default();
        Self { base_color, roughness, metallic, kind }
    }
}

/// A scene whose models are still files.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneFile {
    path: PathBuf,
    ground_y: f32,
    objects: Vec<Checked>,
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
        let folder = path.parent().unwrap_or(Path::new(""));
        let objects = file
            .objects
            .into_iter()
            .enumerate()
            .map(|(at, object)| {
                check(object, folder).map_err(|fault| SceneFileError::Object { path: path.to_owned(), index: at + 1, fault })
            })
            .collect::<Result<Vec<_>, _>>()?;
        let scene = Self { path: path.to_owned(), ground_y: file.ground_y, objects };
        let bounds = Scene { ground_y: scene.ground_y, ..Scene::default() }.validate("scene file");
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
            .collect();
        models.sort_unstable();
        models.dedup();
        models
    }

    /// The scene, with each model file replaced by the asset that `asset_of` makes of it; asked once for each file.
    ///
    /// # Errors
    /// What `asset_of` fails with, with the object that names the model.
    pub fn resolve<E: std::fmt::Display>(&self, mut asset_of: impl FnMut(&Path) -> Result<AssetId, E>) -> Result<Scene, SceneFileError> {
        let mut known: HashMap<&Path, AssetId> = HashMap::new();
        let mut scene = Scene { revision: 0, ground_y: self.ground_y, objects: Vec::with_capacity(self.objects.len()) };
        for (id, object) in (1..).zip(&self.objects) {
            let geometry = match &object.geometry {
                FileGeometry::Shape(shape) => Geometry::Shape(*shape),
                FileGeometry::Model(model) => Geometry::Model(match known.get(model.as_path()) {
                    Some(asset) => *asset,
                    None => {
                        let asset = asset_of(model).map_err(|error| SceneFileError::Object {
                            path: self.path.clone(),
                            index: id as usize,
                            fault: format!("model {}: {error}", model.display()),
                        })?;
                        known.insert(model, asset);
                        asset
                    }
                }),
            };
            let Checked { transform, material, animation, .. } = object.clone();
            scene.objects.push(Object { id: ObjectId(id), geometry, transform, material, animation });
        }
        Ok(scene)
    }
}

fn check(object: FileObject, folder: &Path) -> Result<Checked, String> {
    let geometry = match (object.shape, object.model) {
        (Some(shape), None) => FileGeometry::Shape(shape),
        (None, Some(model)) => FileGeometry::Model(folder.join(model)),
        (None, None) => return Err("neither shape nor model; give one".to_owned()),
        (Some(_), Some(_)) => return Err("both shape and model; give one".to_owned()),
    };
    let [x, y, z] = object.rotation_deg.map(f32::to_radians);
    ensure_in_range([x, y, z].iter().all(|angle| angle.is_finite()), "scene file", "rotation_deg", || {
        format!("{:?} is not finite", object.rotation_deg)
    })
    .map_err(|e| fault(&e))?;
    let transform = Transform {
        position: Vec3::from_array(object.position),
        rotation: Quat::from_euler(EulerRot::YXZ, y, x, z),
        scale: match object.scale {
            FileScale::Uniform(scale) => Vec3::splat(scale),
            FileScale::Axes(scale) => Vec3::from_array(scale),
        },
    };
    let material =
        object.material.map(|m| Material { base_color: m.base_color, roughness: m.roughness, metallic: m.metallic, kind: m.kind });
    let material = material.or(match geometry {
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

/// Field and detail without the message's name: the file is named already.
fn fault(error: &WireError) -> String {
    match error {
        WireError::OutOfRange { field, detail, .. } => format!("{field} is out of range: {detail}"),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<SceneFile, SceneFileError> {
        SceneFile::parse(text, Path::new("stage/SCENE.toml"))
    }

    #[test]
    fn a_scene_reads_as_written() {
        let file = parse(
            r#"
            ground_y = -1.5
            [[object]]
            shape = "sphere"
            position = [1.0, 2.0, 3.0]
            scale = [1.0, 2.0, 1.0]
            material = { base_color = [1.0, 0.5, 0.0], roughness = 0.1, metallic = 1.0 }
            [[object]]
            model = "fox.glb"
            rotation_deg = [0.0, 90.0, 0.0]
            [[object]]
            model = "fox.glb"
            animation = "Walk"
            [[object]]
            model = "fox.glb"
            animation = "none"
            "#,
        )
        .unwrap();
        assert_eq!(file.models(), [Path::new("stage/fox.glb")]);
        let fox = AssetId::of(b"fox");
        let scene = file.resolve(|_| Ok::<_, String>(fox)).unwrap();
        assert_eq!(scene.ground_y, -1.5);
        assert_eq!(scene.objects[0].transform.scale, Vec3::new(1.0, 2.0, 1.0));
        assert_eq!(scene.objects[0].material.unwrap().metallic, 1.0);
        assert_eq!(scene.objects[1].geometry, Geometry::Model(fox));
        assert_eq!(scene.objects[1].material, None);
        let animations: Vec<_> = scene.objects.iter().map(|object| object.animation.clone()).collect();
        assert_eq!(animations, [Playback::First, Playback::First, Playback::Named("Walk".to_owned()), Playback::Still]);
        // A quarter turn about +y takes −z to −x.
        assert!((scene.objects[1].transform.rotation * -Vec3::Z - -Vec3::X).length() < 1e-6);
    }

    #[test]
    fn each_wrong_field_is_named() {
        let sphere = "ground_y = 0.0\n[[object]]\nshape = \"sphere\"\n";
        for (text, names) in [
            (String::new(), "ground_y"),
            ("ground_y = \"low\"".to_owned(), "ground_y"),
            ("ground_y = nan".to_owned(), "ground_y"),
            ("ground_y = 0.0\nsky = 1".to_owned(), "sky"),
            ("ground_y = 0.0\n[[object]]".to_owned(), "neither shape nor model"),
            (format!("{sphere}model = \"a.glb\""), "both shape and model"),
            ("ground_y = 0.0\n[[object]]\nshape = \"torus\"".to_owned(), "torus"),
            (format!("{sphere}position = [1.0]"), "position"),
            (format!("{sphere}position = [inf, 0.0, 0.0]"), "position"),
            (format!("{sphere}rotation_deg = [nan, 0.0, 0.0]"), "rotation_deg"),
            (format!("{sphere}scale = 0.0"), "scale"),
            (format!("{sphere}scale = \"big\""), "scale"),
            (format!("{sphere}material = {{ roughness = 2.0 }}"), "roughness"),
            (format!("{sphere}material = {{ metallic = -1.0 }}"), "metallic"),
            (format!("{sphere}material = {{ base_color = [2.0, 0.0, 0.0] }}"), "base_color"),
            (format!("{sphere}material = {{ kind = \"wood\" }}"), "wood"),
            (format!("{sphere}material = {{ shiny = true }}"), "shiny"),
            (format!("{sphere}colour = 1"), "colour"),
            (format!("{sphere}animation = \"Walk\""), "shapes have none"),
            ("ground_y = 0.0\n[[object]]\nmodel = \"a.glb\"\nanimation = \"\"".to_owned(), "animation"),
        ] {
            let error = parse(&text).unwrap_err().to_string();
            assert!(error.contains(names) && error.contains("stage/SCENE.toml"), "{text:?} gave {error}");
        }
    }

    #[test]
    fn a_model_of_many_objects_is_read_once() {
        let file = parse(&format!("ground_y = 0.0\n{}", "[[object]]\nmodel = \"fox.glb\"\n".repeat(3))).unwrap();
        let mut reads = 0;
        let scene = file.resolve(|_| {
            reads += 1;
            Ok::<_, String>(AssetId::of(b"fox"))
        });
        assert_eq!((scene.unwrap().objects.len(), reads), (3, 1));
    }

    #[test]
    fn a_missing_model_names_file_and_object() {
        let file = parse("ground_y = 0.0\n[[object]]\nmodel = \"no.glb\"").unwrap();
        let error = file.resolve(|_| Err::<AssetId, _>("no such file")).unwrap_err().to_string();
        assert!(error.contains("object 1") && error.contains("stage/no.glb") && error.contains("no such file"), "{error}");
        assert!(matches!(SceneFile::load(Path::new("/nowhere/SCENE.toml")), Err(SceneFileError::Read { .. })));
    }
}
