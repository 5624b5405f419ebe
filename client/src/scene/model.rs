//! glTF 2.0 models, self-contained: a .glb with its binary chunk, or a .gltf with data URIs.
//!
//! Nodes' transforms, skins and morph targets in their rest pose are worked into the vertices; what animations move is
//! kept beside them as a rig. Everything is bounded and checked; an error names the element.

use std::borrow::Cow;
use std::sync::Arc;

use glam::{Mat3, Mat4, Vec3};
use mr360_shaders::layout::{Delta, Detail, Influence};

use super::accessor::floats;
use super::animation;
use super::container::Container;
use super::hierarchy::Hierarchy;
use super::material::{Materials, Surface};
use super::mesh::{Bounds, Mesh};
use super::primitive::{MAX_DELTAS, Primitive, Reader, Wanted};
use super::rig::{Binding, MAX_MATRICES, Moving, Rig, deform};
use super::texture::Texture;

/// Most vertices, and most indices, of a model.
pub const MAX_VERTICES: usize = 2_000_000;
/// Most parts (primitives drawn) of a model.
pub const MAX_PARTS: usize = 1024;

/// Why a model was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// Not glTF 2.0, or its JSON breaks the format.
    #[error("not a valid glTF 2.0 file: {0}; check it with the Khronos glTF validator")]
    Format(String),
    /// Requires something unknown.
    #[error("requires extension {0}, which is not supported; export the model without it")]
    Extension(String),
    /// A buffer that is missing, too short or in another file.
    #[error("buffer {index} {fault}")]
    Buffer {
        /// In the file.
        index: usize,
        /// What is wrong and what to do.
        fault: String,
    },
    /// Numbers that are not there or make no sense.
    #[error("accessor {index} ({used_as}): {fault}")]
    Accessor {
        /// In the file.
        index: usize,
        /// What for.
        used_as: &'static str,
        /// What is wrong.
        fault: String,
    },
    /// A primitive that cannot be drawn.
    #[error("mesh {mesh}, primitive {primitive}: {fault}")]
    Primitive {
        /// In the file.
        mesh: usize,
        /// In the mesh.
        primitive: usize,
        /// What is wrong and what to do.
        fault: String,
    },
    /// A node that is its own ancestor, too deep, or placed nowhere.
    #[error("node {index}: {fault}")]
    Node {
        /// In the file.
        index: usize,
        /// What is wrong.
        fault: String,
    },
    /// An animation that cannot be played.
    #[error("animation {index}: {fault}")]
    Animation {
        /// In the file.
        index: usize,
        /// Channel and what is wrong.
        fault: String,
    },
    /// A material out of range.
    #[error("material {}: {fault}", .index.map_or_else(|| "(default)".to_owned(), |i| i.to_string()))]
    Material {
        /// In the file.
        index: Option<usize>,
        /// What is wrong.
        fault: String,
    },
    /// An image that does not decode.
    #[error("image {index}: {fault}")]
    Image {
        /// In the file.
        index: usize,
        /// What is wrong and what to do.
        fault: String,
    },
    /// Too much of something.
    #[error("holds more than {limit} {what}; simplify the model")]
    TooLarge {
        /// Of what.
        what: &'static str,
        /// The bound.
        limit: usize,
    },
    /// Nothing to draw.
    #[error("its scene holds no triangles")]
    Empty,
}

/// A model that was read, or why it cannot be drawn.
pub type LoadedModel = Result<Arc<Model>, ModelError>;

/// A part of a model with one surface.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Part {
    /// At rest, in the model's frame.
    pub mesh: Mesh,
    /// One a vertex, or none.
    pub details: Vec<Detail>,
    /// Its look.
    pub surface: Surface,
}

/// A model, ready to be put on the GPU.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// What is drawn.
    pub parts: Vec<Part>,
    /// What the surfaces name.
    pub textures: Vec<Texture>,
    /// Around all parts, at rest.
    pub bounds: Bounds,
    /// What plays its animations, if it has any that move what is drawn.
    pub rig: Option<Rig>,
}

impl Model {
    /// Bytes of memory that vertices, indices, textures and the rig take.
    #[must_use]
    pub fn bytes(&self) -> usize {
        let mesh = |mesh: &Mesh| size_of_val(&mesh.vertices[..]) + size_of_val(&mesh.indices[..]);
        let parts = self.parts.iter().map(|part| mesh(&part.mesh) + size_of_val(&part.details[..]));
        let levels = self.textures.iter().flat_map(|texture| &texture.levels).map(Vec::len);
        let moving = self.rig.iter().flat_map(|rig| &rig.moving).map(|moving| {
            // On the GPU the deformed vertices lie beside the file's.
            let (influences, deltas) = (moving.primitive.influences.len(), moving.primitive.deltas.len());
            mesh(&moving.primitive.mesh) * 2 + influences * size_of::<Influence>() + deltas * size_of::<Delta>()
        });
        let tracks = self.rig.iter().flat_map(|rig| &rig.animations).flat_map(|animation| &animation.tracks);
        let keys = tracks.map(|track| size_of_val(&track.times[..]) + size_of_val(&track.values[..]));
        parts.chain(levels).chain(moving).chain(keys).sum()
    }

    /// Reads a model.
    ///
    /// # Errors
    /// [`ModelError`] naming the element.
    pub fn parse(bytes: &[u8]) -> Result<Self, ModelError> {
        let container = Container::open(bytes)?;
        let buffers = container.buffers()?;
        let document = &container.document;
        let hierarchy = Hierarchy::read(document)?;
        let animations = animation::read(document, &buffers, &hierarchy)?;
        let rig = Rig { hierarchy, animations, ..Rig::default() };
        let world = rig.hierarchy.world(|_, node| node.matrix);
        let moved = rig.moved_nodes();
        let materials = Materials::new(document, &buffers, &container.extras);
        let mut importer =
            Importer { materials, buffers: &buffers, rig, world, moved, parts: Vec::new(), vertices: 0, weights: 0, deltas: 0 };
        for node in document.nodes() {
            if let Some(place) = importer.rig.hierarchy.place.get(node.index()).copied().flatten() {
                importer.node(&node, place)?;
            }
        }
        importer.finish()
    }
}

struct Importer<'a> {
    materials: Materials<'a>,
    buffers: &'a [Cow<'a, [u8]>],
    rig: Rig,
    /// Of every node, at rest.
    world: Vec<Mat4>,
    /// Nodes that some animation moves.
    moved: Vec<bool>,
    parts: Vec<Part>,
    vertices: usize,
    weights: usize,
    /// Kept for the rig.
    deltas: usize,
}

impl Importer<'_> {
    fn node(&mut self, node: &gltf::Node<'_>, place: usize) -> Result<(), ModelError> {
        let Some(mesh) = node.mesh() else { return Ok(()) };
        let binding = self.binding(node, place)?;
        let skinned = node.skin().is_some();
        let mirrored = !skinned && self.world[place].determinant() < 0.0;
        let moves = binding.joints.iter().any(|(joint, _)| self.moved[*joint]) || self.moved[place];
        let at = self.rig.bindings.len();
        let joints = skinned.then_some(binding.joints.len());
        let matrices: Vec<Mat4> = binding.joints.iter().map(|(joint, bind)| self.world[*joint] * *bind).collect();
        let weights = self.rig.hierarchy.nodes[place].weights.clone();
        self.weights += weights.len();
        self.rig.bindings.push(binding);
        for primitive in mesh.primitives() {
            if self.parts.len() >= MAX_PARTS {
                return Err(ModelError::TooLarge { what: "primitives", limit: MAX_PARTS });
            }
            let fault = |fault: String| ModelError::Primitive { mesh: mesh.index(), primitive: primitive.index(), fault };
            let surface = self.materials.surface(&primitive.material())?;
            let second_uv = surface.textures().iter().flatten().any(|map| map.second_uv);
            // Frames of moving meshes follow from their pose, see material.wgsl.
            let tangents = surface.normal_texture.is_some() && !moves && !skinned;
            let wanted = Wanted { joints, second_uv, tangents, deltas: MAX_DELTAS.saturating_sub(self.deltas) };
            let read = Reader::new(mesh.index(), &primitive, self.buffers).read(wanted, mirrored)?;
            let vertices = deform(&read, &matrices, &weights);
            if vertices.iter().any(|vertex| !vertex.position.iter().all(|v| v.is_finite())) {
                return Err(fault("its node, its skin or its morph targets move vertices to where no number reaches".to_owned()));
            }
            self.vertices += vertices.len().max(read.mesh.indices.len() / 3);
            if self.vertices > MAX_VERTICES {
                return Err(ModelError::TooLarge { what: "vertices", limit: MAX_VERTICES });
            }
            if read.mesh.indices.is_empty() {
                continue;
            }
            let details = placed(&read, self.world[place]);
            self.parts.push(Part { mesh: Mesh { vertices, indices: read.mesh.indices.clone() }, details, surface });
            if moves {
                self.deltas += read.deltas.len();
                self.rig.moving.push(Moving { part: self.parts.len() - 1, primitive: read, binding: at });
            }
        }
        Ok(())
    }

    /// World transforms of a skin's joints times their inverse bind matrices (glTF 2.0, Sec. 3.7.3), or the node itself.
    fn binding(&self, node: &gltf::Node<'_>, place: usize) -> Result<Binding, ModelError> {
        let joints = match node.skin() {
            Some(skin) => self.joints(&skin)?,
            None => vec![(place, Mat4::IDENTITY)],
        };
        let first_matrix = self.rig.bindings.last().map_or(0, |last| last.first_matrix + last.joints.len());
        if first_matrix + joints.len() > MAX_MATRICES {
            return Err(ModelError::TooLarge { what: "joints and mesh nodes", limit: MAX_MATRICES });
        }
        Ok(Binding { joints, node: place, first_matrix, first_weight: self.weights })
    }

    fn joints(&self, skin: &gltf::Skin<'_>) -> Result<Vec<(usize, Mat4)>, ModelError> {
        let inverse_bind = skin.inverse_bind_matrices();
        if inverse_bind.as_ref().is_some_and(|matrices| matrices.count() > MAX_MATRICES) {
            return Err(ModelError::TooLarge { what: "inverse bind matrices", limit: MAX_MATRICES });
        }
        let inverse_bind = inverse_bind.map(|a| floats::<16>(&a, self.buffers, "inverse bind matrices")).transpose()?;
        skin.joints()
            .enumerate()
            .map(|(at, joint)| {
                let fault = |fault: &str| ModelError::Node { index: joint.index(), fault: fault.to_owned() };
                let place = self.rig.hierarchy.place.get(joint.index()).copied().flatten();
                let place = place.ok_or_else(|| fault("is a joint but not part of the scene"))?;
                let bind = match &inverse_bind {
                    Some(matrices) => {
                        matrices.get(at).map(Mat4::from_cols_array).ok_or_else(|| fault("is a joint without inverse bind matrix"))?
                    }
                    None => Mat4::IDENTITY,
                };
                Ok((place, bind))
            })
            .collect()
    }

    fn finish(self) -> Result<Model, ModelError> {
        let Self { parts, materials, mut rig, .. } = self;
        let around = |part: &Part| part.mesh.bounds();
        let bounds = parts.iter().map(around).fold(Bounds::EMPTY, |all, part| all.joined(&part));
        if parts.is_empty() {
            return Err(ModelError::Empty);
        }
        let still = |(at, part): (usize, &Part)| (!rig.moving.iter().any(|moving| moving.part == at)).then(|| around(part));
        let still = parts.iter().enumerate().filter_map(still).fold(Bounds::EMPTY, |all, part| all.joined(&part));
        if !rig.moving.is_empty() && !rig.measure(still) {
            let index = rig.bounds.iter().position(|bounds| !(bounds.min.is_finite() && bounds.max.is_finite())).unwrap_or(0);
            return Err(ModelError::Animation { index, fault: "moves vertices to where no number reaches".to_owned() });
        }
        let rig = (!rig.moving.is_empty()).then_some(rig);
        Ok(Model { parts, textures: materials.textures, bounds, rig })
    }
}

/// The details of a primitive in the model's frame.
fn placed(primitive: &Primitive, transform: Mat4) -> Vec<Detail> {
    let linear = Mat3::from_mat4(transform);
    let side = if linear.determinant() < 0.0 { -1.0 } else { 1.0 };
    let place = |detail: &Detail| {
        let [x, y, z, w] = detail.tangent;
        let tangent = (linear * Vec3::new(x, y, z)).normalize_or_zero();
        Detail { tangent: tangent.extend(if w == 0.0 { 0.0 } else { w.signum() * side }).to_array(), ..*detail }
    };
    primitive.details.iter().map(place).collect()
}
