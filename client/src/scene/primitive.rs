//! One primitive of a mesh as its file gives it, before any node or joint moves it.

use std::borrow::Cow;

use glam::{Vec3, Vec4};
use gltf::Semantic;
use mr360_shaders::layout::{Delta, Detail, Influence, Vertex};

use super::accessor::{floats, integers};
use super::mesh::Mesh;
use super::model::{MAX_VERTICES, ModelError};

/// Most morph targets of a primitive.
pub const MAX_TARGETS: usize = 256;
/// Most vertices times morph targets of a model.
pub const MAX_DELTAS: usize = 4_000_000;

/// Triangles with everything that can move or colour them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Primitive {
    /// Positions, normals and first texture coordinates.
    pub mesh: Mesh,
    /// One a vertex, or none.
    pub details: Vec<Detail>,
    /// One a vertex where joints move it, else none.
    pub influences: Vec<Influence>,
    /// All vertices for the first target, then for the second.
    pub deltas: Vec<Delta>,
    /// Each three vertices are a triangle of their own, with the normal of its plane (glTF 2.0, Sec. 3.7.2.1).
    pub flat: bool,
}

/// Which parts of a primitive are wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Wanted {
    /// Joints in the skin.
    pub(super) joints: Option<usize>,
    pub(super) second_uv: bool,
    pub(super) tangents: bool,
    /// Room that is left of [`MAX_DELTAS`].
    pub(super) deltas: usize,
}

pub(super) struct Reader<'a> {
    primitive: &'a gltf::Primitive<'a>,
    buffers: &'a [Cow<'a, [u8]>],
    mesh: usize,
    count: usize,
}

impl<'a> Reader<'a> {
    pub(super) fn new(mesh: usize, primitive: &'a gltf::Primitive<'a>, buffers: &'a [Cow<'a, [u8]>]) -> Self {
        Self { primitive, buffers, mesh, count: 0 }
    }

    fn fault(&self, fault: String) -> ModelError {
        ModelError::Primitive { mesh: self.mesh, primitive: self.primitive.index(), fault }
    }

    /// Reads all that is wanted; `mirrored` turns the triangles over, for a node that mirrors them.
    pub(super) fn read(mut self, wanted: Wanted, mirrored: bool) -> Result<Primitive, ModelError> {
        if self.primitive.mode() != gltf::mesh::Mode::Triangles {
            return Err(self.fault(format!("{:?} are not drawn; export triangles", self.primitive.mode())));
        }
        let positions = self.primitive.get(&Semantic::Positions).ok_or_else(|| self.fault("has no positions".to_owned()))?;
        let positions = floats::<3>(&positions, self.buffers, "positions")?;
        self.count = positions.len();
        if self.count > MAX_VERTICES {
            return Err(ModelError::TooLarge { what: "vertices", limit: MAX_VERTICES });
        }
        let normals = self.attribute::<3>(&Semantic::Normals, "normals")?;
        let uvs = self.attribute::<2>(&Semantic::TexCoords(0), "texture coordinates")?;
        let vertex = |i: usize| Vertex {
            position: positions[i],
            normal: normals.as_ref().map_or([0.0, 1.0, 0.0], |n| Vec3::from_array(n[i]).normalize_or(Vec3::Y).to_array()),
            uv: uvs.as_ref().map_or([0.0; 2], |uv| uv[i]),
        };
        let mut indices = self.indices()?;
        if mirrored {
            // A mirrored mesh shows its back; glTF asks for the winding to be turned.
            indices.chunks_exact_mut(3).for_each(|corners| corners.swap(1, 2));
        }
        let out = Primitive {
            mesh: Mesh { vertices: (0..self.count).map(vertex).collect(), indices },
            // Without normals the file's tangents do not count (glTF 2.0, Sec. 3.7.2.1).
            details: self.details(Wanted { tangents: wanted.tangents && normals.is_some(), ..wanted })?,
            influences: wanted.joints.map_or(Ok(Vec::new()), |joints| self.influences(joints))?,
            deltas: self.deltas(normals.is_some(), wanted.deltas)?,
            flat: false,
        };
        if normals.is_some() { Ok(out) } else { self.flattened(&out, wanted.deltas) }
    }

    fn attribute<const N: usize>(&self, semantic: &Semantic, used_as: &'static str) -> Result<Option<Vec<[f32; N]>>, ModelError> {
        let Some(accessor) = self.primitive.get(semantic) else { return Ok(None) };
        let values = floats::<N>(&accessor, self.buffers, used_as)?;
        self.same_count(values.len())?;
        Ok(Some(values))
    }

    fn same_count(&self, count: usize) -> Result<(), ModelError> {
        if count == self.count { Ok(()) } else { Err(self.fault("its attributes differ in count".to_owned())) }
    }

    fn indices(&self) -> Result<Vec<u32>, ModelError> {
        let indices = match self.primitive.indices() {
            Some(accessor) => integers::<1>(&accessor, self.buffers, "indices")?.into_iter().map(|[i]| i).collect(),
            None => (0..self.count as u32).collect::<Vec<_>>(),
        };
        if let Some(outside) = indices.iter().find(|i| **i as usize >= self.count) {
            return Err(self.fault(format!("index {outside} names no vertex; there are {}", self.count)));
        }
        if !indices.len().is_multiple_of(3) {
            return Err(self.fault(format!("{} indices are no whole number of triangles", indices.len())));
        }
        if indices.len() > 3 * MAX_VERTICES {
            return Err(ModelError::TooLarge { what: "indices", limit: 3 * MAX_VERTICES });
        }
        Ok(indices)
    }

    fn details(&self, wanted: Wanted) -> Result<Vec<Detail>, ModelError> {
        let colors = match self.primitive.get(&Semantic::Colors(0)).map(|accessor| accessor.dimensions()) {
            Some(gltf::accessor::Dimensions::Vec3) => self
                .attribute::<3>(&Semantic::Colors(0), "colours")?
                .map(|colors| colors.into_iter().map(|rgb| Vec3::from_array(rgb).extend(1.0)).collect::<Vec<_>>()),
            _ => self
                .attribute::<4>(&Semantic::Colors(0), "colours")?
                .map(|colors| colors.into_iter().map(Vec4::from_array).collect::<Vec<_>>()),
        };
        let second = if wanted.second_uv { self.attribute::<2>(&Semantic::TexCoords(1), "texture coordinates")? } else { None };
        let tangents = if wanted.tangents { self.attribute::<4>(&Semantic::Tangents, "tangents")? } else { None };
        if colors.is_none() && second.is_none() && tangents.is_none() {
            return Ok(Vec::new());
        }
        let code = |value: f32| (value.clamp(0.0, 1.0) * 65_535.0 + 0.5) as u16;
        let detail = |i: usize| Detail {
            tangent: tangents.as_ref().map_or([0.0; 4], |t| t[i]),
            uv1: second.as_ref().map_or([0.0; 2], |uv| uv[i]),
            color: colors.as_ref().map_or([u16::MAX; 4], |c| c[i].to_array().map(code)),
        };
        Ok((0..self.count).map(detail).collect())
    }

    /// The first four joints of each vertex, as every glTF viewer has to read; weights made to add up to 1.
    fn influences(&self, joints: usize) -> Result<Vec<Influence>, ModelError> {
        let (Some(names), Some(weights)) = (self.primitive.get(&Semantic::Joints(0)), self.primitive.get(&Semantic::Weights(0))) else {
            return Err(self.fault("belongs to a skin but has no joints or weights".to_owned()));
        };
        if joints == 0 {
            return Err(self.fault("belongs to a skin that has no joints".to_owned()));
        }
        let names = integers::<4>(&names, self.buffers, "joints")?;
        let weights = floats::<4>(&weights, self.buffers, "weights")?;
        self.same_count(names.len()).and(self.same_count(weights.len()))?;
        names
            .into_iter()
            .zip(weights)
            .map(|(names, weights)| {
                let weights = weights.map(|weight| weight.max(0.0));
                let total: f32 = weights.iter().sum();
                // What no joint holds is held by the first, rather than drawn to the origin.
                let weights = if total > 0.0 { weights.map(|weight| weight / total) } else { [1.0, 0.0, 0.0, 0.0] };
                let mut used = [0; 4];
                for ((slot, name), weight) in used.iter_mut().zip(names).zip(weights) {
                    if weight > 0.0 {
                        if name as usize >= joints {
                            return Err(self.fault(format!("joint {name} is not in its skin of {joints}")));
                        }
                        *slot = name;
                    }
                }
                Ok(Influence { weights, joints: [used[0] | used[1] << 16, used[2] | used[3] << 16], padding: [0; 2] })
            })
            .collect()
    }

    fn deltas(&self, with_normals: bool, room: usize) -> Result<Vec<Delta>, ModelError> {
        let targets = self.primitive.morph_targets().len();
        if targets > MAX_TARGETS || targets.saturating_mul(self.count) > room {
            return Err(self.fault(format!(
                "{targets} morph targets of {} vertices; at most {MAX_TARGETS}, and {MAX_DELTAS} moved vertices in the model",
                self.count
            )));
        }
        let mut deltas = Vec::with_capacity(targets * self.count);
        let read = |accessor: Option<gltf::Accessor<'_>>, used_as| -> Result<_, ModelError> {
            let Some(accessor) = accessor else { return Ok(None) };
            let values = floats::<3>(&accessor, self.buffers, used_as)?;
            self.same_count(values.len())?;
            Ok(Some(values))
        };
        for target in self.primitive.morph_targets() {
            let positions = read(target.positions(), "morphed positions")?;
            let normals = read(target.normals().filter(|_| with_normals), "morphed normals")?;
            let of = |values: &Option<Vec<[f32; 3]>>, i: usize| values.as_ref().map_or([0.0; 3], |values| values[i]);
            deltas.extend((0..self.count).map(|i| Delta { position: of(&positions, i), normal: of(&normals, i) }));
        }
        Ok(deltas)
    }

    /// The same triangles with corners of their own, as glTF asks for where a primitive has no normals. The normals
    /// are those of the planes and follow from the pose.
    fn flattened(&self, shared: &Primitive, room: usize) -> Result<Primitive, ModelError> {
        let corners = &shared.mesh.indices;
        let targets = shared.deltas.len().checked_div(self.count).unwrap_or(0);
        if targets.saturating_mul(corners.len()) > room {
            return Err(self.fault(format!("its flat triangles have more than {MAX_DELTAS} moved vertices; export normals")));
        }
        let target = |target: usize| corners.iter().map(move |i| shared.deltas[target * self.count + *i as usize]);
        let gather = |i: &u32| shared.mesh.vertices[*i as usize];
        Ok(Primitive {
            mesh: Mesh { vertices: corners.iter().map(gather).collect(), indices: (0..corners.len() as u32).collect() },
            details: if shared.details.is_empty() { Vec::new() } else { corners.iter().map(|i| shared.details[*i as usize]).collect() },
            influences: if shared.influences.is_empty() {
                Vec::new()
            } else {
                corners.iter().map(|i| shared.influences[*i as usize]).collect()
            },
            deltas: (0..targets).flat_map(target).collect(),
            flat: true,
        })
    }
}
