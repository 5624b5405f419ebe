//! glTF 2.0 models, self-contained: a .glb with its binary chunk, or a .gltf with data URIs.
//!
//! Nodes' transforms and skins in their rest pose are worked into the vertices. Everything is bounded and
//! checked; an error names the element.

use std::borrow::Cow;
use std::sync::Arc;

use glam::{Mat3, Mat4, Vec3};
use mr360_shaders::layout::Vertex;

use super::accessor::{floats, integers};
use super::material::{Materials, Surface, Texture, data_uri};
use super::mesh::{Bounds, Mesh};

/// Most vertices, and most indices, of a model.
pub const MAX_VERTICES: usize = 2_000_000;
/// Most parts (primitives drawn) of a model.
pub const MAX_PARTS: usize = 1024;
/// Deepest chain of nodes.
pub const MAX_NODE_DEPTH: usize = 64;
/// Most nodes visited.
const MAX_NODES: usize = 65_536;
/// Most bytes in all buffers together.
const MAX_BUFFER_BYTES: usize = 256 * 1024 * 1024;
/// Extensions that a file may require.
const SUPPORTED_EXTENSIONS: [&str; 1] = ["KHR_materials_transmission"];

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
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// In the model's frame.
    pub mesh: Mesh,
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
    /// Around all parts.
    pub bounds: Bounds,
}

impl Model {
    /// Bytes of memory that vertices, indices and textures take.
    #[must_use]
    pub fn bytes(&self) -> usize {
        let meshes = self.parts.iter().map(|part| size_of_val(&part.mesh.vertices[..]) + size_of_val(&part.mesh.indices[..]));
        let levels = self.textures.iter().flat_map(|texture| &texture.levels);
        meshes.chain(levels.map(Vec::len)).sum()
    }

    /// Reads a model.
    ///
    /// # Errors
    /// [`ModelError`] naming the element.
    pub fn parse(bytes: &[u8]) -> Result<Self, ModelError> {
        let (json, binary) = split(bytes)?;
        let gltf = gltf::Gltf::from_slice_without_validation(json).map_err(|error| ModelError::Format(error.to_string()))?;
        if let Some(unknown) = gltf.extensions_required().find(|name| !SUPPORTED_EXTENSIONS.contains(name)) {
            return Err(ModelError::Extension(unknown.to_owned()));
        }
        let json = gltf.document.into_json();
        guard(&json)?;
        let document = gltf::Document::from_json(json).map_err(|error| ModelError::Format(error.to_string()))?;
        let buffers = buffers(&document, binary)?;
        let mut importer = Importer { materials: Materials::new(&document, &buffers), buffers: &buffers, parts: Vec::new(), vertices: 0 };
        let world = world_transforms(&document)?;
        for (node, transform) in document.nodes().zip(&world) {
            if let Some(transform) = transform {
                importer.node(&node, *transform, &world)?;
            }
        }
        let Importer { parts, materials, .. } = importer;
        let bounds =
            parts.iter().flat_map(|part| part.mesh.vertices.iter()).fold(Bounds::EMPTY, |b, v| b.including(Vec3::from_array(v.position)));
        if parts.is_empty() { Err(ModelError::Empty) } else { Ok(Self { parts, textures: materials.textures, bounds }) }
    }
}

/// JSON and binary chunk of a .glb (glTF 2.0, Sec. 4.4), or the whole of a .gltf.
fn split(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), ModelError> {
    let word = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?));
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    let fault = |fault: &str| ModelError::Format(fault.to_owned());
    if word(4) != Some(2) {
        return Err(fault("its binary container is not version 2"));
    }
    let chunk = |at: usize, kind: &[u8; 4]| {
        let length = word(at)? as usize;
        let body = bytes.get(at + 8..(at + 8).checked_add(length)?)?;
        (bytes.get(at + 4..at + 8)? == kind).then_some(body)
    };
    let json = chunk(12, b"JSON").ok_or_else(|| fault("its JSON chunk is missing or cut short"))?;
    let after = 20 + json.len();
    if bytes.len() < after + 8 {
        return Ok((json, None));
    }
    let binary = chunk(after, b"BIN\0").ok_or_else(|| fault("its binary chunk is cut short or of another kind"))?;
    Ok((json, Some(binary)))
}

/// What the gltf crate itself would panic over: it looks these up before, or without, checking them.
fn guard(root: &gltf::json::Root) -> Result<(), ModelError> {
    for (mesh, primitive, one) in
        root.meshes.iter().enumerate().flat_map(|(m, mesh)| mesh.primitives.iter().enumerate().map(move |(p, one)| (m, p, one)))
    {
        if let Some(missing) = one.attributes.values().find(|accessor| accessor.value() >= root.accessors.len()) {
            return Err(ModelError::Primitive { mesh, primitive, fault: format!("accessor {} does not exist", missing.value()) });
        }
    }
    let unnamed = |image: &gltf::json::Image| image.uri.is_none() && (image.buffer_view.is_none() || image.mime_type.is_none());
    match root.images.iter().position(unnamed) {
        Some(index) => Err(ModelError::Image { index, fault: "has neither a URI nor a buffer view with its MIME type".to_owned() }),
        None => Ok(()),
    }
}

/// The declared bytes of every buffer. The binary chunk is lent out, not copied: many buffers may claim it.
fn buffers<'a>(document: &gltf::Document, binary: Option<&'a [u8]>) -> Result<Vec<Cow<'a, [u8]>>, ModelError> {
    let mut total = 0;
    let mut out = Vec::new();
    for buffer in document.buffers() {
        let fault = |fault: String| ModelError::Buffer { index: buffer.index(), fault };
        total = buffer.length().saturating_add(total);
        if total > MAX_BUFFER_BYTES {
            return Err(fault(format!("brings the buffers to more than {MAX_BUFFER_BYTES} bytes; simplify the model")));
        }
        let bytes = match buffer.source() {
            // glTF 2.0, Sec. 4.4.3.2: the first buffer alone may be the binary chunk.
            gltf::buffer::Source::Bin if buffer.index() > 0 => {
                return Err(fault("has no URI; only the first buffer may be the file's binary chunk".to_owned()));
            }
            gltf::buffer::Source::Bin => Cow::Borrowed(binary.ok_or_else(|| fault("is missing: the file has no binary chunk".to_owned()))?),
            gltf::buffer::Source::Uri(uri) => Cow::Owned(data_uri(uri).map_err(fault)?),
        };
        if bytes.len() < buffer.length() {
            return Err(fault(format!("holds {} bytes where {} are declared; the file is cut short", bytes.len(), buffer.length())));
        }
        out.push(bytes);
    }
    Ok(out)
}

/// Transform of every node of the scene in the model's frame, by node index; `None` for nodes outside of it.
fn world_transforms(document: &gltf::Document) -> Result<Vec<Option<Mat4>>, ModelError> {
    let mut world = vec![None; document.nodes().len()];
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else { return Ok(world) };
    let mut open: Vec<_> = scene.nodes().map(|node| (node, Mat4::IDENTITY, 1)).collect();
    let mut visited = 0;
    while let Some((node, parent, depth)) = open.pop() {
        let fault = |fault: String| ModelError::Node { index: node.index(), fault };
        visited += 1;
        if visited > MAX_NODES {
            return Err(ModelError::TooLarge { what: "nodes", limit: MAX_NODES });
        }
        if depth > MAX_NODE_DEPTH {
            return Err(fault(format!("lies in a cycle, or deeper than {MAX_NODE_DEPTH} nodes")));
        }
        let transform = parent * Mat4::from_cols_array_2d(&node.transform().matrix());
        if !transform.is_finite() {
            return Err(fault("its transform is not finite".to_owned()));
        }
        let slot = world.get_mut(node.index()).ok_or_else(|| fault("does not exist".to_owned()))?;
        if slot.is_some() {
            return Err(fault("is reached twice: it has two parents or lies in a cycle".to_owned()));
        }
        *slot = Some(transform);
        open.extend(node.children().map(|child| (child, transform, depth + 1)));
    }
    Ok(world)
}

struct Importer<'a> {
    materials: Materials<'a>,
    buffers: &'a [Cow<'a, [u8]>],
    parts: Vec<Part>,
    vertices: usize,
}

impl Importer<'_> {
    fn node(&mut self, node: &gltf::Node<'_>, transform: Mat4, world: &[Option<Mat4>]) -> Result<(), ModelError> {
        let Some(mesh) = node.mesh() else { return Ok(()) };
        let joints = node.skin().map(|skin| self.joint_matrices(&skin, world)).transpose()?;
        for primitive in mesh.primitives() {
            if self.parts.len() >= MAX_PARTS {
                return Err(ModelError::TooLarge { what: "primitives", limit: MAX_PARTS });
            }
            let fault = |fault: String| ModelError::Primitive { mesh: mesh.index(), primitive: primitive.index(), fault };
            let read = self.primitive(&primitive, fault)?;
            let posed = match &joints {
                Some(joints) => self.skinned(&primitive, read, joints, fault)?,
                None => with_normals(placed(read, transform), &primitive),
            };
            self.vertices += posed.vertices.len().max(posed.indices.len() / 3);
            if self.vertices > MAX_VERTICES {
                return Err(ModelError::TooLarge { what: "vertices", limit: MAX_VERTICES });
            }
            if posed.indices.is_empty() {
                continue;
            }
            let surface = self.materials.surface(&primitive.material())?;
            self.parts.push(Part { mesh: posed, surface });
        }
        Ok(())
    }

    fn primitive(&self, primitive: &gltf::Primitive<'_>, fault: impl Fn(String) -> ModelError) -> Result<Mesh, ModelError> {
        use gltf::Semantic;
        if primitive.mode() != gltf::mesh::Mode::Triangles {
            return Err(fault(format!("{:?} are not drawn; export triangles", primitive.mode())));
        }
        let positions = primitive.get(&Semantic::Positions).ok_or_else(|| fault("has no positions".to_owned()))?;
        let positions = floats::<3>(&positions, self.buffers, "positions")?;
        let optional = |semantic| primitive.get(&semantic);
        let normals = optional(Semantic::Normals).map(|a| floats::<3>(&a, self.buffers, "normals")).transpose()?;
        let uvs = optional(Semantic::TexCoords(0)).map(|a| floats::<2>(&a, self.buffers, "texture coordinates")).transpose()?;
        let same_count = |count: Option<usize>| count.is_none_or(|count| count == positions.len());
        if !same_count(normals.as_ref().map(Vec::len)) || !same_count(uvs.as_ref().map(Vec::len)) {
            return Err(fault("its attributes differ in count".to_owned()));
        }
        if positions.len() > MAX_VERTICES {
            return Err(ModelError::TooLarge { what: "vertices", limit: MAX_VERTICES });
        }
        let indices = match primitive.indices() {
            Some(accessor) => integers::<1>(&accessor, self.buffers, "indices")?.into_iter().map(|[i]| i).collect(),
            None => (0..positions.len() as u32).collect::<Vec<_>>(),
        };
        if let Some(outside) = indices.iter().find(|i| **i as usize >= positions.len()) {
            return Err(fault(format!("index {outside} names no vertex; there are {}", positions.len())));
        }
        if !indices.len().is_multiple_of(3) {
            return Err(fault(format!("{} indices are no whole number of triangles", indices.len())));
        }
        if indices.len() > 3 * MAX_VERTICES {
            return Err(ModelError::TooLarge { what: "indices", limit: 3 * MAX_VERTICES });
        }
        let vertex = |i: usize| Vertex {
            position: positions[i],
            normal: normals.as_ref().map_or([0.0, 1.0, 0.0], |n| Vec3::from_array(n[i]).normalize_or(Vec3::Y).to_array()),
            uv: uvs.as_ref().map_or([0.0; 2], |uv| uv[i]),
        };
        Ok(Mesh { vertices: (0..positions.len()).map(vertex).collect(), indices })
    }

    /// World transform of each joint times its inverse bind matrix (glTF 2.0, Sec. 3.7.3).
    fn joint_matrices(&self, skin: &gltf::Skin<'_>, world: &[Option<Mat4>]) -> Result<Vec<Mat4>, ModelError> {
        let inverse_bind = skin.inverse_bind_matrices().map(|a| floats::<16>(&a, self.buffers, "inverse bind matrices")).transpose()?;
        skin.joints()
            .enumerate()
            .map(|(at, joint)| {
                let fault = |fault: &str| ModelError::Node { index: joint.index(), fault: fault.to_owned() };
                let world = world.get(joint.index()).copied().flatten().ok_or_else(|| fault("is a joint but not part of the scene"))?;
                let bind = match &inverse_bind {
                    Some(matrices) => {
                        matrices.get(at).map(Mat4::from_cols_array).ok_or_else(|| fault("is a joint without inverse bind matrix"))?
                    }
                    None => Mat4::IDENTITY,
                };
                Ok(world * bind)
            })
            .collect()
    }

    fn skinned(
        &self,
        primitive: &gltf::Primitive<'_>,
        mesh: Mesh,
        joints: &[Mat4],
        fault: impl Fn(String) -> ModelError,
    ) -> Result<Mesh, ModelError> {
        use gltf::Semantic;
        let (Some(names), Some(weights)) = (primitive.get(&Semantic::Joints(0)), primitive.get(&Semantic::Weights(0))) else {
            return Err(fault("belongs to a skin but has no joints or weights".to_owned()));
        };
        let names = integers::<4>(&names, self.buffers, "joints")?;
        let weights = floats::<4>(&weights, self.buffers, "weights")?;
        if names.len() != mesh.vertices.len() || weights.len() != mesh.vertices.len() {
            return Err(fault("its joints or weights differ in count from its positions".to_owned()));
        }
        let mut posed = mesh;
        for ((vertex, names), weights) in posed.vertices.iter_mut().zip(names).zip(weights) {
            let total: f32 = weights.iter().sum();
            let mut matrix = Mat4::ZERO;
            for (name, weight) in names.into_iter().zip(weights).filter(|(_, weight)| *weight != 0.0) {
                let joint =
                    joints.get(name as usize).ok_or_else(|| fault(format!("joint {name} is not in its skin of {}", joints.len())))?;
                matrix += *joint * (weight / total);
            }
            *vertex = moved(*vertex, matrix, normal_matrix(matrix));
        }
        let bad = posed.vertices.iter().any(|vertex| !vertex.position.iter().all(|v| v.is_finite()));
        if bad { Err(fault("its skin moves vertices to where no number reaches".to_owned())) } else { Ok(with_normals(posed, primitive)) }
    }
}

/// Inverse transpose, up to a factor, that also works for singular matrices.
fn normal_matrix(matrix: Mat4) -> Mat3 {
    let m = Mat3::from_mat4(matrix);
    let sign = m.determinant().signum();
    Mat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis)) * sign
}

fn moved(vertex: Vertex, matrix: Mat4, normals: Mat3) -> Vertex {
    let normal = (normals * Vec3::from_array(vertex.normal)).normalize_or(Vec3::Y);
    Vertex { position: matrix.transform_point3(Vec3::from_array(vertex.position)).to_array(), normal: normal.to_array(), ..vertex }
}

fn placed(mesh: Mesh, transform: Mat4) -> Mesh {
    let normals = normal_matrix(transform);
    let mut out =
        Mesh { vertices: mesh.vertices.into_iter().map(|vertex| moved(vertex, transform, normals)).collect(), indices: mesh.indices };
    if transform.determinant() < 0.0 {
        // A mirrored mesh shows its back; glTF asks for the winding to be turned.
        out.indices.chunks_exact_mut(3).for_each(|corners| corners.swap(1, 2));
    }
    out
}

fn with_normals(mesh: Mesh, primitive: &gltf::Primitive<'_>) -> Mesh {
    if primitive.get(&gltf::Semantic::Normals).is_some() { mesh } else { mesh.flat_shaded() }
}
