//! Small glTF models made of numbers.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

/// A node with a mesh of these corners and triangles, as a .gltf with everything embedded: accessor 0 holds the corners, 1 the indices.
pub(super) fn gltf(corners: &[[f32; 3]], triangles: &[[u16; 3]]) -> Value {
    let mut bytes: Vec<u8> = corners.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    let indices_at = bytes.len();
    bytes.extend(triangles.iter().flatten().flat_map(|v| v.to_le_bytes()));
    let bound = |pick: fn(f32, f32) -> f32| [0, 1, 2].map(|axis| corners.iter().map(|corner| corner[axis]).reduce(pick));
    json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "accessors": [
            {
                "bufferView": 0, "componentType": 5126, "count": corners.len(), "type": "VEC3",
                "min": bound(f32::min), "max": bound(f32::max),
            },
            { "bufferView": 1, "componentType": 5123, "count": 3 * triangles.len(), "type": "SCALAR" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": indices_at },
            { "buffer": 0, "byteOffset": indices_at, "byteLength": bytes.len() - indices_at },
        ],
        "buffers": [buffer(&bytes)],
    })
}

/// A buffer that is embedded.
pub(super) fn buffer(bytes: &[u8]) -> Value {
    json!({ "byteLength": bytes.len(), "uri": format!("data:application/octet-stream;base64,{}", STANDARD.encode(bytes)) })
}

/// The file.
pub(super) fn bytes(gltf: &Value) -> bytes::Bytes {
    serde_json::to_vec(gltf).unwrap().into()
}

/// A level grid of so many quads a side, a metre each, around the origin.
pub(super) fn grid(side: u16) -> bytes::Bytes {
    let corner = |x: u16, z: u16| [f32::from(x) - f32::from(side) * 0.5, 0.0, f32::from(z) - f32::from(side) * 0.5];
    let corners: Vec<_> = (0..=side).flat_map(|z| (0..=side).map(move |x| corner(x, z))).collect();
    let at = |x: u16, z: u16| z * (side + 1) + x;
    let quad = |x, z| [[at(x, z), at(x, z + 1), at(x + 1, z)], [at(x + 1, z), at(x, z + 1), at(x + 1, z + 1)]];
    let triangles: Vec<_> = (0..side).flat_map(|z| (0..side).flat_map(move |x| quad(x, z))).collect();
    bytes(&gltf(&corners, &triangles))
}
