//! Corners and triangles of a glTF 2.0 model at rest. Nothing else of it matters to the solver.

use std::borrow::Cow;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::{Mat4, Vec3};
use gltf::accessor::{DataType, Dimensions};
use gltf::mesh::Mode;

/// Most corners of a model, as viewers bound them.
const MAX_CORNERS: usize = 2_000_000;
/// Most triangles of a mesh of the place that objects collide with.
const MAX_PLACE_TRIANGLES: usize = 200_000;
/// Most bytes of a model's buffers together.
const MAX_BUFFER_BYTES: usize = 256 * 1024 * 1024;
/// Deepest chain of nodes.
const MAX_DEPTH: usize = 64;

/// Why a model tells no form.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(super) enum FormError {
    /// Not among the scene's assets.
    #[error("is not there")]
    Missing,
    /// Not glTF 2.0, or cut short.
    #[error("cannot be read ({0}); check it with the Khronos glTF validator")]
    Broken(String),
    /// Too much of something.
    #[error("holds more than {limit} {what}; simplify it")]
    TooLarge {
        /// Of what.
        what: &'static str,
        /// The bound.
        limit: usize,
    },
    /// No triangles.
    #[error("holds no triangles")]
    Empty,
}

/// A triangle mesh in the model's frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Triangles {
    pub(super) corners: Vec<Vec3>,
    /// Each below `corners.len()`.
    pub(super) indices: Vec<[u32; 3]>,
}

fn broken(fault: impl Into<String>) -> FormError {
    FormError::Broken(fault.into())
}

impl Triangles {
    /// All triangles of the model's scene, its nodes at rest. What a skin moves is taken to follow the skin's first joint, as it does
    /// where the model rests in the pose that it was bound in.
    pub(super) fn read(bytes: &[u8]) -> Result<Self, FormError> {
        let gltf::Gltf { document, blob } = gltf::Gltf::from_slice_without_validation(bytes).map_err(|error| broken(error.to_string()))?;
        let document = bare(document)?;
        let buffers = buffers(&document, blob.as_deref())?;
        let nodes = world(&document)?;
        let mut out = Self::default();
        for node in document.nodes() {
            let Some(Some(own)) = nodes.get(node.index()) else { continue };
            let Some(mesh) = node.mesh() else { continue };
            let placed = match node.skin() {
                Some(skin) => bound(&skin, &nodes, &buffers)?,
                None => *own,
            };
            for primitive in mesh.primitives() {
                out.add(&primitive, &placed, &buffers)?;
            }
        }
        if out.indices.is_empty() { Err(FormError::Empty) } else { Ok(out) }
    }

    /// Few enough to collide with.
    pub(super) fn bounded(self) -> Result<Self, FormError> {
        if self.indices.len() > MAX_PLACE_TRIANGLES {
            return Err(FormError::TooLarge { what: "triangles to collide with", limit: MAX_PLACE_TRIANGLES });
        }
        Ok(self)
    }

    fn add(&mut self, primitive: &gltf::Primitive<'_>, placed: &Mat4, buffers: &[Cow<'_, [u8]>]) -> Result<(), FormError> {
        if !matches!(primitive.mode(), Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            return Ok(());
        }
        let Some(accessor) = primitive.get(&gltf::Semantic::Positions) else { return Ok(()) };
        let start = self.corners.len();
        if start.saturating_add(accessor.count()) > MAX_CORNERS {
            return Err(FormError::TooLarge { what: "corners", limit: MAX_CORNERS });
        }
        for corner in floats::<3>(&accessor, buffers, Dimensions::Vec3)? {
            let corner = placed.transform_point3(corner.into());
            if !corner.is_finite() {
                return Err(broken(format!("accessor {}: a corner is not finite", accessor.index())));
            }
            self.corners.push(corner);
        }
        let count = self.corners.len() - start;
        let order = match primitive.indices() {
            Some(accessor) => indices(&accessor, buffers)?,
            None => (0..count as u32).collect(),
        };
        if order.iter().any(|index| *index as usize >= count) {
            return Err(broken("an index names a corner that is not there"));
        }
        let triangle = |corners: [u32; 3]| corners.map(|corner| start as u32 + corner);
        match primitive.mode() {
            Mode::TriangleStrip => self.indices.extend(order.windows(3).map(|w| triangle([w[0], w[1], w[2]]))),
            Mode::TriangleFan => {
                let hub = order.first().copied().unwrap_or_default();
                self.indices.extend(order.windows(2).skip(1).map(|w| triangle([hub, w[0], w[1]])));
            }
            _ => self.indices.extend(order.chunks_exact(3).map(|c| triangle([c[0], c[1], c[2]]))),
        }
        Ok(())
    }
}

/// The document without looks and motion: extensions of those may be required that matter to viewers alone, and the crate would panic
/// over some of their faults. What is left it checks.
fn bare(document: gltf::Document) -> Result<gltf::Document, FormError> {
    let mut json = document.into_json();
    json.extensions_required.clear();
    json.animations.clear();
    json.images.clear();
    json.textures.clear();
    json.materials.clear();
    let accessors = json.accessors.len();
    for primitive in json.meshes.iter_mut().flat_map(|mesh| &mut mesh.primitives) {
        (primitive.material, primitive.targets) = (None, None);
        // It looks these up before it checks them.
        if primitive.attributes.values().any(|accessor| accessor.value() >= accessors) {
            return Err(broken("a primitive names an accessor that does not exist"));
        }
    }
    gltf::Document::from_json(json).map_err(|error| broken(error.to_string()))
}

fn buffers<'a>(document: &gltf::Document, blob: Option<&'a [u8]>) -> Result<Vec<Cow<'a, [u8]>>, FormError> {
    let mut total: usize = 0;
    document
        .buffers()
        .map(|buffer| {
            total = total.saturating_add(buffer.length());
            if total > MAX_BUFFER_BYTES {
                return Err(FormError::TooLarge { what: "bytes of buffers", limit: MAX_BUFFER_BYTES });
            }
            let bytes = match buffer.source() {
                gltf::buffer::Source::Bin => blob.map(Cow::Borrowed).ok_or_else(|| broken("no binary chunk"))?,
                gltf::buffer::Source::Uri(uri) => {
                    let data = uri.strip_prefix("data:").and_then(|data| data.split_once(";base64,"));
                    let (_, text) = data.ok_or_else(|| broken("a buffer is in another file"))?;
                    Cow::Owned(STANDARD.decode(text).map_err(|error| broken(format!("buffer {}: {error}", buffer.index())))?)
                }
            };
            if bytes.len() < buffer.length() {
                return Err(broken(format!("buffer {} is cut short", buffer.index())));
            }
            Ok(bytes)
        })
        .collect()
}

/// Where each node of the scene rests in the model's frame.
fn world(document: &gltf::Document) -> Result<Vec<Option<Mat4>>, FormError> {
    let mut out = vec![None; document.nodes().len()];
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else { return Ok(out) };
    let mut open: Vec<_> = scene.nodes().map(|node| (node, Mat4::IDENTITY, 1)).collect();
    while let Some((node, parent, depth)) = open.pop() {
        let slot = out.get_mut(node.index()).ok_or_else(|| broken(format!("node {} does not exist", node.index())))?;
        if depth > MAX_DEPTH || slot.is_some() {
            return Err(broken(format!("node {} has two parents, is its own ancestor, or lies too deep", node.index())));
        }
        let own = parent * Mat4::from_cols_array_2d(&node.transform().matrix());
        *slot = Some(own);
        open.extend(node.children().map(|child| (child, own, depth + 1)));
    }
    Ok(out)
}

/// From the frame of a skinned mesh to the model's, by the skin's first joint.
fn bound(skin: &gltf::Skin<'_>, nodes: &[Option<Mat4>], buffers: &[Cow<'_, [u8]>]) -> Result<Mat4, FormError> {
    let joint = skin.joints().next().and_then(|joint| nodes.get(joint.index()).copied().flatten());
    let joint = joint.ok_or_else(|| broken(format!("skin {} has no joint in the scene", skin.index())))?;
    let Some(accessor) = skin.inverse_bind_matrices() else { return Ok(joint) };
    let inverse = floats::<16>(&accessor, buffers, Dimensions::Mat4)?;
    Ok(joint * inverse.first().map_or(Mat4::IDENTITY, Mat4::from_cols_array))
}

/// The bytes of an accessor's elements, each `size` long; every bound is checked before anything is allocated for them.
fn elements<'a>(
    accessor: &gltf::Accessor<'_>,
    buffers: &'a [Cow<'_, [u8]>],
    size: usize,
) -> Result<impl Iterator<Item = &'a [u8]> + use<'a>, FormError> {
    let fault = || broken(format!("accessor {} lies outside of its buffer, or is sparse", accessor.index()));
    if accessor.sparse().is_some() || accessor.count() > 3 * MAX_CORNERS {
        return Err(fault());
    }
    let view = accessor.view().ok_or_else(fault)?;
    let buffer = buffers.get(view.buffer().index()).ok_or_else(fault)?;
    let end = view.offset().checked_add(view.length()).ok_or_else(fault)?;
    let bytes = buffer.get(view.offset()..end).ok_or_else(fault)?;
    let (offset, stride, count) = (accessor.offset(), view.stride().unwrap_or(size), accessor.count());
    let last = count.saturating_sub(1).checked_mul(stride).and_then(|at| at.checked_add(offset)?.checked_add(size));
    if count > 0 && last.is_none_or(|last| last > bytes.len()) {
        return Err(fault());
    }
    Ok((0..count).filter_map(move |i| bytes.get(offset + i * stride..offset + i * stride + size)))
}

fn floats<const N: usize>(
    accessor: &gltf::Accessor<'_>,
    buffers: &[Cow<'_, [u8]>],
    dimensions: Dimensions,
) -> Result<Vec<[f32; N]>, FormError> {
    if accessor.data_type() != DataType::F32 || accessor.dimensions() != dimensions {
        return Err(broken(format!("accessor {} holds no {dimensions:?} of floats", accessor.index())));
    }
    let element = |bytes: &[u8]| {
        let mut out = [0.0; N];
        for (to, from) in out.iter_mut().zip(bytes.chunks_exact(4)) {
            *to = f32::from_le_bytes([from[0], from[1], from[2], from[3]]);
        }
        out
    };
    Ok(elements(accessor, buffers, 4 * N)?.map(element).collect())
}

fn indices(accessor: &gltf::Accessor<'_>, buffers: &[Cow<'_, [u8]>]) -> Result<Vec<u32>, FormError> {
    if accessor.dimensions() != Dimensions::Scalar || !matches!(accessor.data_type(), DataType::U8 | DataType::U16 | DataType::U32) {
        return Err(broken(format!("accessor {} holds no indices", accessor.index())));
    }
    let element = |bytes: &[u8]| bytes.iter().rev().fold(0, |value, byte| value << 8 | u32::from(*byte));
    Ok(elements(accessor, buffers, accessor.data_type().size())?.map(element).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two triangles, one scaled to double size by its node, as a .gltf with everything embedded.
    fn file(change: impl Fn(&mut serde_json::Value)) -> Vec<u8> {
        let corners: Vec<u8> = [0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let bytes: Vec<u8> = corners.into_iter().chain([0, 0, 1, 0, 2, 0]).collect();
        let mut json = serde_json::json!({
            "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0, 1] }],
            "nodes": [{ "mesh": 0, "scale": [2.0, 2.0, 2.0] }, { "mesh": 1, "translation": [0.0, 5.0, 0.0] }],
            "meshes": [
                { "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] },
                { "primitives": [{ "attributes": { "POSITION": 0 }, "mode": 5 }] },
            ],
            "accessors": [
                { "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0.0, 0.0, 0.0], "max": [1.0, 1.0, 0.0] },
                { "bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR" },
            ],
            "bufferViews": [
                { "buffer": 0, "byteOffset": 0, "byteLength": 36 }, { "buffer": 0, "byteOffset": 36, "byteLength": 6 },
            ],
            "buffers": [{ "byteLength": 42, "uri": format!("data:application/octet-stream;base64,{}", STANDARD.encode(bytes)) }],
        });
        change(&mut json);
        serde_json::to_vec(&json).unwrap()
    }

    #[test]
    fn triangles_lie_where_their_nodes_put_them() {
        let read = Triangles::read(&file(|_| {})).unwrap();
        assert_eq!(read.indices, [[0, 1, 2], [3, 4, 5]]);
        assert_eq!((read.corners[1], read.corners[5]), (Vec3::X * 2.0, Vec3::new(0.0, 6.0, 0.0)));
    }

    #[test]
    fn what_a_skin_moves_follows_its_first_joint() {
        let read = Triangles::read(&file(|json| {
            json["nodes"][0]["skin"] = 0.into();
            json["skins"] = serde_json::json!([{ "joints": [1] }]);
        }));
        // Not the mesh's own node, which glTF 2.0, Sec. 3.7.3.2 says is ignored.
        assert_eq!(read.unwrap().corners[1], Vec3::new(1.0, 5.0, 0.0));
    }

    #[test]
    fn broken_files_are_refused() {
        type Change = fn(&mut serde_json::Value);
        let changes: [(&str, Change); 10] = [
            ("does not exist", |json| json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 7.into()),
            ("outside", |json| json["accessors"][0]["count"] = 4.into()),
            ("outside", |json| json["accessors"][0]["byteOffset"] = u32::MAX.into()),
            ("outside", |json| json["bufferViews"][0]["byteOffset"] = 4_000_000_000u32.into()),
            ("cut short", |json| json["buffers"][0]["byteLength"] = 43.into()),
            ("another file", |json| json["buffers"][0]["uri"] = "a.bin".into()),
            ("ancestor", |json| json["nodes"][1]["children"] = serde_json::json!([1])),
            ("not there", |json| json["meshes"][0]["primitives"][0]["indices"] = serde_json::Value::Null),
            ("more than", |json| json["accessors"][0]["count"] = 3_000_000.into()),
            ("no triangles", |json| json["scenes"][0]["nodes"] = serde_json::json!([])),
        ];
        for (says, change) in changes {
            let bytes = file(change);
            match Triangles::read(&bytes) {
                // Without indices the corners are taken in order.
                Ok(read) => assert!(says == "not there" && read.indices.len() == 2, "{says}"),
                Err(fault) => assert!(fault.to_string().contains(says), "{says}: {fault}"),
            }
        }
        let far = file(|json| json["buffers"][0]["uri"] = format!("data:;base64,{}", STANDARD.encode([9; 42])).into());
        assert!(matches!(Triangles::read(&far), Err(FormError::Broken(fault)) if fault.contains("corner that is not there")));
        for bytes in [&b""[..], b"glTF", b"{}", b"glTF\x02\0\0\0\xff\xff\xff\xff"] {
            assert!(matches!(Triangles::read(bytes), Err(FormError::Broken(_) | FormError::Empty)));
        }
        for cut in 0..200 {
            let whole = file(|_| {});
            let _ = Triangles::read(&whole[..whole.len() * cut / 200]);
        }
    }

    #[test]
    fn a_place_of_too_many_triangles_is_refused() {
        let many = Triangles { corners: vec![Vec3::ZERO], indices: vec![[0; 3]; MAX_PLACE_TRIANGLES + 1] };
        assert!(matches!(many.bounded(), Err(FormError::TooLarge { .. })));
    }
}
