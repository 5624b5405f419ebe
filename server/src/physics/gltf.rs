//! Corners and triangles of a glTF 2.0 model at rest. Nothing else of it matters to the solver.

use std::borrow::Cow;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::{DMat4, Vec3};
use gltf::accessor::{DataType, Dimensions};
use gltf::mesh::Mode;
use mr360_protocol::scene::{MAX_POSITION_M, MAX_SCALE};

/// Most corners of a model, as viewers bound them.
const MAX_CORNERS: usize = 2_000_000;
/// Most indices of a model.
const MAX_INDICES: usize = 3 * MAX_CORNERS;
/// No corner lies farther from the model's origin on any axis: a kilometre in millimetres, as scales allow it.
const MAX_CORNER: f32 = MAX_POSITION_M * MAX_SCALE;
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
        let mut budget = MAX_INDICES;
        for node in document.nodes() {
            let Some(Some(own)) = nodes.get(node.index()) else { continue };
            let Some(mesh) = node.mesh() else { continue };
            let placed = match node.skin() {
                Some(skin) => bound(&skin, &nodes, &buffers)?,
                None => *own,
            };
            for primitive in mesh.primitives() {
                out.add(&primitive, &placed, &buffers, &mut budget)?;
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

    /// `budget` is how many more indices the model may have: primitives may name the same ones again and again.
    fn add(
        &mut self,
        primitive: &gltf::Primitive<'_>,
        placed: &DMat4,
        buffers: &[Cow<'_, [u8]>],
        budget: &mut usize,
    ) -> Result<(), FormError> {
        if !matches!(primitive.mode(), Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            return Ok(());
        }
        let Some(accessor) = primitive.get(&gltf::Semantic::Positions) else { return Ok(()) };
        let start = self.corners.len();
        if start.saturating_add(accessor.count()) > MAX_CORNERS {
            return Err(FormError::TooLarge { what: "corners", limit: MAX_CORNERS });
        }
        for corner in floats::<3>(&accessor, buffers, Dimensions::Vec3)? {
            let corner = placed.transform_point3(Vec3::from(corner).as_dvec3()).as_vec3();
            let sound = corner.is_finite() && corner.abs().max_element() <= MAX_CORNER;
            if !sound {
                return Err(broken(format!("accessor {}: a corner is not a number, or farther out than {MAX_CORNER}", accessor.index())));
            }
            self.corners.push(corner);
        }
        let count = self.corners.len() - start;
        let named = primitive.indices().map_or(count, |accessor| accessor.count());
        *budget = budget.checked_sub(named).ok_or(FormError::TooLarge { what: "indices", limit: MAX_INDICES })?;
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
fn world(document: &gltf::Document) -> Result<Vec<Option<DMat4>>, FormError> {
    let mut out = vec![None; document.nodes().len()];
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else { return Ok(out) };
    let mut open: Vec<_> = scene.nodes().map(|node| (node, DMat4::IDENTITY, 1)).collect();
    while let Some((node, parent, depth)) = open.pop() {
        let slot = out.get_mut(node.index()).ok_or_else(|| broken(format!("node {} does not exist", node.index())))?;
        if depth > MAX_DEPTH || slot.is_some() {
            return Err(broken(format!("node {} has two parents, is its own ancestor, or lies too deep", node.index())));
        }
        let own = parent * DMat4::from_cols_array_2d(&node.transform().matrix().map(|column| column.map(f64::from)));
        *slot = Some(own);
        open.extend(node.children().map(|child| (child, own, depth + 1)));
    }
    Ok(out)
}

/// From the frame of a skinned mesh to the model's, by the skin's first joint.
fn bound(skin: &gltf::Skin<'_>, nodes: &[Option<DMat4>], buffers: &[Cow<'_, [u8]>]) -> Result<DMat4, FormError> {
    let joint = skin.joints().next().and_then(|joint| nodes.get(joint.index()).copied().flatten());
    let joint = joint.ok_or_else(|| broken(format!("skin {} has no joint in the scene", skin.index())))?;
    let Some(accessor) = skin.inverse_bind_matrices() else { return Ok(joint) };
    let inverse = floats::<16>(&accessor, buffers, Dimensions::Mat4)?;
    Ok(joint * inverse.first().map_or(DMat4::IDENTITY, |inverse| DMat4::from_cols_array(&inverse.map(f64::from))))
}

/// The bytes of an accessor's elements, each `size` long; every bound is checked before anything is allocated for them.
fn elements<'a>(
    accessor: &gltf::Accessor<'_>,
    buffers: &'a [Cow<'_, [u8]>],
    size: usize,
) -> Result<impl Iterator<Item = &'a [u8]> + use<'a>, FormError> {
    let fault = || broken(format!("accessor {} lies outside of its buffer, or is sparse", accessor.index()));
    if accessor.sparse().is_some() || accessor.count() > MAX_INDICES {
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
    use crate::physics::test_models;

    /// Two triangles, one scaled to double size by its node.
    fn file(change: impl Fn(&mut serde_json::Value)) -> Vec<u8> {
        let mut json = test_models::gltf(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], &[[0, 1, 2]]);
        json["scenes"][0]["nodes"] = serde_json::json!([0, 1]);
        json["nodes"] = serde_json::json!([{ "mesh": 0, "scale": [2.0, 2.0, 2.0] }, { "mesh": 1, "translation": [0.0, 5.0, 0.0] }]);
        let strip = serde_json::json!({ "primitives": [{ "attributes": { "POSITION": 0 }, "mode": 5 }] });
        json["meshes"].as_array_mut().unwrap().push(strip);
        change(&mut json);
        test_models::bytes(&json).to_vec()
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
    fn without_indices_the_corners_are_taken_in_order() {
        let read = Triangles::read(&file(|json| json["meshes"][0]["primitives"][0]["indices"] = serde_json::Value::Null)).unwrap();
        assert_eq!(read.indices, [[0, 1, 2], [3, 4, 5]]);
    }

    #[test]
    fn indices_are_counted_over_all_that_name_them() {
        let many = |primitives: usize| {
            file(|json| {
                json["buffers"].as_array_mut().unwrap().push(test_models::buffer(&vec![0; MAX_INDICES / 2]));
                let view = serde_json::json!({ "buffer": 1, "byteOffset": 0, "byteLength": MAX_INDICES / 2 });
                json["bufferViews"].as_array_mut().unwrap().push(view);
                json["accessors"][1] =
                    serde_json::json!({ "bufferView": 2, "componentType": 5121, "count": MAX_INDICES / 2, "type": "SCALAR" });
                let primitive = json["meshes"][0]["primitives"][0].clone();
                json["meshes"][0]["primitives"] = vec![primitive; primitives].into();
                json["scenes"][0]["nodes"] = serde_json::json!([0]);
            })
        };
        assert_eq!(Triangles::read(&many(2)).unwrap().indices.len(), MAX_INDICES / 3);
        assert_eq!(Triangles::read(&many(3)), Err(FormError::TooLarge { what: "indices", limit: MAX_INDICES }));
    }

    #[test]
    fn broken_files_are_refused() {
        type Change = fn(&mut serde_json::Value);
        let changes: [(&str, Change); 11] = [
            ("does not exist", |json| json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 7.into()),
            ("outside", |json| json["accessors"][0]["count"] = 4.into()),
            ("outside", |json| json["accessors"][0]["byteOffset"] = u32::MAX.into()),
            ("outside", |json| json["bufferViews"][0]["byteOffset"] = 4_000_000_000u32.into()),
            ("cut short", |json| json["buffers"][0]["byteLength"] = 43.into()),
            ("another file", |json| json["buffers"][0]["uri"] = "a.bin".into()),
            ("ancestor", |json| json["nodes"][1]["children"] = serde_json::json!([1])),
            ("farther out", |json| json["nodes"][0]["scale"] = serde_json::json!([1e38, 1.0, 1.0])),
            ("not a number", |json| json["nodes"][0]["translation"] = serde_json::json!([0.0, 1e7, 0.0])),
            ("more than", |json| json["accessors"][0]["count"] = 3_000_000.into()),
            ("no triangles", |json| json["scenes"][0]["nodes"] = serde_json::json!([])),
        ];
        for (says, change) in changes {
            let fault = Triangles::read(&file(change)).unwrap_err().to_string();
            assert!(fault.contains(says), "{says}: {fault}");
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
