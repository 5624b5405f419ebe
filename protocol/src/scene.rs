//! The shared scene: objects on a ground plane, changed by users' intents ([`crate::intent`]) through the server alone.

#[cfg(test)]
mod tests;

use glam::{Quat, Vec3};
use serde::{Deserialize, Serialize};

use crate::asset::AssetId;
use crate::codec::{Message, WireError, ensure_in_range};

/// Most objects in a scene.
pub const MAX_OBJECTS: usize = 1024;
/// Most meshes of the place.
pub const MAX_PLACE_MESHES: usize = 16;
/// Most users in a session.
pub const MAX_USERS: usize = 256;
/// Most changes in one delta.
pub const MAX_CHANGES: usize = 256;
/// Most bytes in an animation's name.
pub const MAX_ANIMATION_BYTES: usize = 64;
/// Most items of the library.
pub const MAX_LIBRARY: usize = 64;
/// Most characters in a user's name.
pub const MAX_NAME_CHARS: usize = 64;
/// Objects stay within this distance of the origin on every axis, metres.
pub const MAX_POSITION_M: f32 = 1_000.0;
/// Scales lie in [1/this, this].
pub const MAX_SCALE: f32 = 1_000.0;

/// From here on ids are of each viewer's own objects, as hands and rays, which nobody else has: no scene holds one.
pub const FIRST_LOCAL_ID: u32 = u32::MAX - 128;

/// Names an object for as long as it exists.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ObjectId(pub u32);

/// Built-in shapes, centred at their origin and one metre across: the sphere's and cylinder's diameter,
/// the cylinder's height (along y), the cube's edge, the plane's sides (in x and z, facing +y).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// Diameter 1.
    Sphere,
    /// Edge 1.
    Cube,
    /// Diameter 1, height 1.
    Cylinder,
    /// 1 × 1.
    Plane,
}

/// What an object looks like before its material.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Geometry {
    /// A built-in shape.
    Shape(Shape),
    /// A glTF 2.0 model (.glb, or .gltf with everything embedded).
    Model(AssetId),
}

/// Surface class.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaterialKind {
    /// Metallic-roughness.
    #[default]
    Opaque,
    /// Clear, refracting.
    Glass,
}

/// glTF's metallic-roughness in short. Perceptual roughness 0 with metallic 1 is a mirror.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Material {
    /// Linear BT.709, each in [0, 1].
    pub base_color: [f32; 3],
    /// Perceptual roughness in [0, 1]; alpha is its square.
    pub roughness: f32,
    /// In [0, 1].
    pub metallic: f32,
    /// Surface class.
    pub kind: MaterialKind,
}

impl Default for Material {
    fn default() -> Self {
        Self { base_color: [0.8; 3], roughness: 1.0, metallic: 0.0, kind: MaterialKind::Opaque }
    }
}

/// Position, rotation and scale: `world_from_object` = T · R · S.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Transform {
    /// Metres.
    pub position: Vec3,
    /// Unit quaternion.
    pub rotation: Quat,
    /// Factor on each axis.
    pub scale: Vec3,
}

impl Default for Transform {
    fn default() -> Self {
        Self { position: Vec3::ZERO, rotation: Quat::IDENTITY, scale: Vec3::ONE }
    }
}

/// Which of its model's animations an object plays. It begins with the broadcast and is repeated for ever, so that every
/// viewer shows the same pose with the same picture.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum Playback {
    /// The model's first, if it has any.
    #[default]
    First,
    /// None: the model at rest.
    Still,
    /// The one of this name, not empty and of at most [`MAX_ANIMATION_BYTES`].
    Named(String),
}

/// One virtual object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// Its name.
    pub id: ObjectId,
    /// Its form.
    pub geometry: Geometry,
    /// Its place.
    pub transform: Transform,
    /// Its surface; a model without one keeps the materials of its file.
    pub material: Option<Material>,
    /// How its model moves; of no effect on shapes.
    pub animation: Playback,
}

/// How a real surface mirrors virtual objects. The light in it needs none of this: the video shows that already.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Gloss {
    /// Perceptual roughness in [0, 1]; alpha is its square.
    pub roughness: f32,
    /// Share of light that is mirrored straight back, in [0, 1]; nothing is mirrored at 0.
    pub reflectance: f32,
}

impl Gloss {
    /// A surface that mirrors nothing.
    pub const MATT: Self = Self { roughness: 1.0, reflectance: 0.0 };
    /// Reflectance of what is neither metal nor gem: stone, wood, water, varnish.
    pub const DIELECTRIC: f32 = 0.04;

    pub(crate) fn validate(self, message: &'static str) -> Result<(), WireError> {
        let unit = |v: f32| (0.0..=1.0).contains(&v);
        ensure_in_range(unit(self.roughness), message, "roughness", || self.roughness.to_string())?;
        ensure_in_range(unit(self.reflectance), message, "reflectance", || self.reflectance.to_string())
    }
}

impl Default for Gloss {
    fn default() -> Self {
        Self::MATT
    }
}

/// A mesh of the real place, as the video shows it: it catches shadows and reflections, hides what is behind it, and is itself never
/// seen.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PlaceMesh {
    /// A glTF 2.0 model; its materials do not count.
    pub model: AssetId,
    /// Its place.
    pub transform: Transform,
    /// It stands between the lights and what lies behind it. Not so for walls that hold the lights themselves, or lie beyond them.
    pub casts_shadows: bool,
    /// How it mirrors objects.
    pub gloss: Gloss,
}

/// What users may put into the scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LibraryItem {
    /// Shown to users; 1 to [`MAX_NAME_CHARS`] characters.
    pub name: String,
    /// Its form.
    pub geometry: Geometry,
    /// Factor on each axis when it is put down.
    pub scale: Vec3,
    /// Its surface; a model without one keeps the materials of its file.
    pub material: Option<Material>,
}

/// The whole shared state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// Counts every change the server made; a delta applies to the revision before its own.
    pub revision: u64,
    /// Height of the ground plane, metres, relative to the camera that filmed the panorama at y = 0.
    pub ground_y: f32,
    /// How the ground mirrors objects.
    pub ground: Gloss,
    /// In order of id.
    pub objects: Vec<Object>,
    /// Beside the ground, what of the real place catches shadows.
    pub place: Vec<PlaceMesh>,
    /// What users may add.
    pub library: Vec<LibraryItem>,
}

impl Default for Scene {
    fn default() -> Self {
        Self { revision: 0, ground_y: -1.6, ground: Gloss::MATT, objects: Vec::new(), place: Vec::new(), library: LibraryItem::shapes() }
    }
}

impl LibraryItem {
    /// The library of a scene whose author gives none: each shape, of a size to be handled.
    #[must_use]
    pub fn shapes() -> Vec<Self> {
        let item = |name: &str, shape, scale, base_color, roughness| Self {
            name: name.to_owned(),
            geometry: Geometry::Shape(shape),
            scale,
            material: Some(Material { base_color, roughness, ..Material::default() }),
        };
        vec![
            item("ball", Shape::Sphere, Vec3::splat(0.3), [0.75, 0.12, 0.05], 0.2),
            item("cube", Shape::Cube, Vec3::splat(0.3), [0.8; 3], 0.6),
            item("cylinder", Shape::Cylinder, Vec3::new(0.3, 0.5, 0.3), [0.1, 0.3, 0.7], 0.4),
            item("board", Shape::Plane, Vec3::new(0.8, 1.0, 0.5), [0.55, 0.35, 0.15], 0.8),
        ]
    }

    /// Bounds the name, the scale and the material; `message` names what carries it.
    ///
    /// # Errors
    /// [`WireError::OutOfRange`] naming the field.
    pub fn validate(&self, message: &'static str) -> Result<(), WireError> {
        ensure_in_range((1..=MAX_NAME_CHARS).contains(&self.name.chars().count()), message, "name", || {
            format!("a name of {} characters, 1 to {MAX_NAME_CHARS}", self.name.chars().count())
        })?;
        Transform { scale: self.scale, ..Transform::default() }.validate(message)?;
        self.material.map_or(Ok(()), |material| material.validate(message))
    }
}

/// One change to a scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Change {
    /// Adds the object, or replaces the one of the same id.
    Put(Object),
    /// Moves an object.
    Move(ObjectId, Transform),
    /// Takes an object away.
    Remove(ObjectId),
}

/// What the `scene` track carries: each group is one snapshot, then deltas in order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum SceneMessage {
    /// The whole scene.
    Snapshot {
        /// When all this was so, as of a delta.
        at_us: u64,
        /// As it was.
        scene: Scene,
    },
    /// Turns revision `revision − 1` into `revision`.
    Delta {
        /// Revision after the changes.
        revision: u64,
        /// When all this was so on the server's clock, microseconds: what moves is shown at its pace, not at the network's.
        at_us: u64,
        /// In order.
        changes: Vec<Change>,
    },
}

/// Why a delta does not fit a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ApplyError {
    /// A delta was lost; wait for the next snapshot.
    #[error("scene delta {got} does not follow revision {have}; waiting for the next snapshot")]
    Gap {
        /// Revision held.
        have: u64,
        /// Revision offered.
        got: u64,
    },
    /// A change names an object that is not there.
    #[error("scene change names object {} that does not exist", .0.0)]
    NoSuchObject(ObjectId),
    /// The scene is full.
    #[error("a scene holds at most {MAX_OBJECTS} objects")]
    Full,
}

impl Scene {
    /// The object of this id.
    #[must_use]
    pub fn object(&self, id: ObjectId) -> Option<&Object> {
        self.objects.iter().find(|object| object.id == id)
    }

    /// Takes in a message of the `scene` track. On error the scene is as it was.
    ///
    /// # Errors
    /// [`ApplyError`] when a delta does not fit.
    pub fn apply(&mut self, message: &SceneMessage) -> Result<(), ApplyError> {
        match message {
            SceneMessage::Snapshot { scene, .. } => self.clone_from(scene),
            SceneMessage::Delta { revision, changes, .. } => {
                // A snapshot may carry any revision, the last one included: then nothing can follow it.
                if self.revision.checked_add(1) != Some(*revision) {
                    return Err(ApplyError::Gap { have: self.revision, got: *revision });
                }
                let mut next = self.clone();
                changes.iter().try_for_each(|change| next.change(change))?;
                next.revision = *revision;
                *self = next;
            }
        }
        Ok(())
    }

    fn change(&mut self, change: &Change) -> Result<(), ApplyError> {
        let position = |scene: &Self, id| scene.objects.iter().position(|o| o.id == id).ok_or(ApplyError::NoSuchObject(id));
        match change {
            Change::Put(object) => match position(self, object.id) {
                Ok(at) => self.objects[at].clone_from(object),
                Err(_) if self.objects.len() >= MAX_OBJECTS => return Err(ApplyError::Full),
                Err(_) => {
                    let at = self.objects.partition_point(|o| o.id < object.id);
                    self.objects.insert(at, object.clone());
                }
            },
            Change::Move(id, transform) => {
                let at = position(self, *id)?;
                self.objects[at].transform = *transform;
            }
            Change::Remove(id) => {
                let at = position(self, *id)?;
                self.objects.remove(at);
            }
        }
        Ok(())
    }

    /// The assets that the objects, the place and the library name, each once, in order.
    #[must_use]
    pub fn assets(&self) -> Vec<AssetId> {
        let geometries = self.objects.iter().map(|object| object.geometry).chain(self.library.iter().map(|item| item.geometry));
        let mut ids: Vec<_> = geometries
            .filter_map(|geometry| match geometry {
                Geometry::Model(id) => Some(id),
                Geometry::Shape(_) => None,
            })
            .chain(self.place.iter().map(|mesh| mesh.model))
            .collect();
        ids.sort_unstable();
        ids.dedup();
        ids
    }
}

impl Transform {
    /// Bounds every part; `message` names the message that carries it.
    ///
    /// # Errors
    /// [`WireError::OutOfRange`] naming the field.
    pub fn validate(&self, message: &'static str) -> Result<(), WireError> {
        ensure_in_range(self.position.is_finite() && self.position.abs().max_element() <= MAX_POSITION_M, message, "position", || {
            format!("{}, within ±{MAX_POSITION_M} m", self.position)
        })?;
        ensure_in_range(self.rotation.is_finite() && (self.rotation.length() - 1.0).abs() < 1e-3, message, "rotation", || {
            format!("{} is not a unit quaternion", self.rotation)
        })?;
        let range = 1.0 / MAX_SCALE..=MAX_SCALE;
        ensure_in_range(self.scale.to_array().iter().all(|s| range.contains(s)), message, "scale", || {
            format!("{}, each within {}..{MAX_SCALE}", self.scale, 1.0 / MAX_SCALE)
        })
    }
}

impl Material {
    /// Bounds every part; `message` names what carries it.
    ///
    /// # Errors
    /// [`WireError::OutOfRange`] naming the field.
    pub fn validate(&self, message: &'static str) -> Result<(), WireError> {
        let unit = |v: f32| (0.0..=1.0).contains(&v);
        ensure_in_range(self.base_color.into_iter().all(unit), message, "base_color", || format!("{:?}", self.base_color))?;
        ensure_in_range(unit(self.roughness), message, "roughness", || self.roughness.to_string())?;
        ensure_in_range(unit(self.metallic), message, "metallic", || self.metallic.to_string())
    }
}

impl Object {
    /// Bounds the id, the transform, the material and the animation's name; `message` names what carries it.
    ///
    /// # Errors
    /// [`WireError::OutOfRange`] naming the field.
    pub fn validate(&self, message: &'static str) -> Result<(), WireError> {
        ensure_in_range(self.id.0 < FIRST_LOCAL_ID, message, "id", || format!("{}, below {FIRST_LOCAL_ID}", self.id.0))?;
        self.transform.validate(message)?;
        self.material.map_or(Ok(()), |material| material.validate(message))?;
        match &self.animation {
            Playback::Named(name) => ensure_in_range((1..=MAX_ANIMATION_BYTES).contains(&name.len()), message, "animation", || {
                format!("a name of {} bytes, 1 to {MAX_ANIMATION_BYTES}", name.len())
            }),
            Playback::First | Playback::Still => Ok(()),
        }
    }
}

impl Scene {
    /// Bounds counts and ranges, and asks for ids in order.
    ///
    /// # Errors
    /// [`WireError::OutOfRange`] naming the field.
    pub fn validate(&self, message: &'static str) -> Result<(), WireError> {
        ensure_in_range(self.objects.len() <= MAX_OBJECTS, message, "objects", || {
            format!("{}, at most {MAX_OBJECTS}", self.objects.len())
        })?;
        ensure_in_range(self.objects.is_sorted_by(|a, b| a.id < b.id), message, "objects", || "ids not in order".to_owned())?;
        ensure_in_range(self.ground_y.is_finite() && self.ground_y.abs() <= MAX_POSITION_M, message, "ground_y", || {
            self.ground_y.to_string()
        })?;
        ensure_in_range(self.place.len() <= MAX_PLACE_MESHES, message, "place", || {
            format!("{} meshes, at most {MAX_PLACE_MESHES}", self.place.len())
        })?;
        self.ground.validate(message)?;
        self.place.iter().try_for_each(|mesh| mesh.transform.validate(message).and_then(|()| mesh.gloss.validate(message)))?;
        ensure_in_range(self.library.len() <= MAX_LIBRARY, message, "library", || {
            format!("{} items, at most {MAX_LIBRARY}", self.library.len())
        })?;
        self.library.iter().try_for_each(|item| item.validate(message))?;
        self.objects.iter().try_for_each(|object| object.validate(message))
    }
}

impl Message for SceneMessage {
    const NAME: &'static str = "scene message";
    /// 2: objects have a [`Playback`], scenes have meshes of the place. 3: scenes have a library, deltas say when they were, ground and
    /// place have a [`Gloss`]. 4: snapshots say when they were.
    const VERSION: u8 = 4;

    fn validate(&self) -> Result<(), WireError> {
        match self {
            Self::Snapshot { scene, .. } => scene.validate(Self::NAME),
            Self::Delta { changes, .. } => {
                ensure_in_range(changes.len() <= MAX_CHANGES, Self::NAME, "changes", || {
                    format!("{}, at most {MAX_CHANGES}", changes.len())
                })?;
                changes.iter().try_for_each(|change| match change {
                    Change::Put(object) => object.validate(Self::NAME),
                    Change::Move(_, transform) => transform.validate(Self::NAME),
                    Change::Remove(_) => Ok(()),
                })
            }
        }
    }
}
