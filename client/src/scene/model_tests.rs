//! Models that hold, and every way in which one may be broken.

use base64::Engine as _;
use glam::Vec3;
use serde_json::{Value, json};

use super::hierarchy::MAX_NODE_DEPTH;
use super::model::{Model, ModelError};

/// One triangle with indices; positions at byte 0, indices (u16) at 36.
fn triangle() -> (Value, Vec<u8>) {
    let positions: [f32; 9] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let mut bytes: Vec<u8> = positions.iter().flat_map(|v| v.to_le_bytes()).collect();
    bytes.extend([0u16, 1, 2, 0].iter().flat_map(|v| v.to_le_bytes()));
    let json = json!({
        "asset": { "version": "2.0" },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "buffers": [{ "byteLength": bytes.len() }],
        "bufferViews": [{ "buffer": 0, "byteLength": 36 }, { "buffer": 0, "byteOffset": 36, "byteLength": 6 }],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0] },
            { "bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR" }
        ]
    });
    (json, bytes)
}

fn embedded(mut json: Value, bytes: &[u8]) -> Vec<u8> {
    let uri = format!("data:application/octet-stream;base64,{}", base64::engine::general_purpose::STANDARD.encode(bytes));
    json["buffers"][0]["uri"] = Value::String(uri);
    serde_json::to_vec(&json).unwrap()
}

fn glb(json: &Value, bytes: &[u8]) -> Vec<u8> {
    let mut text = serde_json::to_vec(json).unwrap();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut out = b"glTF".to_vec();
    let length = 12 + 8 + text.len() + 8 + bytes.len();
    for word in [2, length as u32, text.len() as u32] {
        out.extend(word.to_le_bytes());
    }
    out.extend(b"JSON");
    out.extend(text);
    out.extend((bytes.len() as u32).to_le_bytes());
    out.extend(b"BIN\0");
    out.extend(bytes);
    out
}

#[test]
fn both_containers_give_the_same_triangle() {
    let (json, bytes) = triangle();
    let model = Model::parse(&embedded(json.clone(), &bytes)).unwrap();
    assert_eq!(model, Model::parse(&glb(&json, &bytes)).unwrap());
    // Without normals the triangle gets its own: +z.
    assert_eq!(model.parts[0].mesh.vertices[1].normal, [0.0, 0.0, 1.0]);
    assert_eq!((model.bounds.min, model.bounds.max), (Vec3::ZERO, Vec3::new(1.0, 1.0, 0.0)));
}

#[test]
fn the_binary_chunk_belongs_to_the_first_buffer_alone() {
    let (mut json, bytes) = triangle();
    // The chunk may be longer than what is declared, by its padding for instance.
    json["buffers"][0]["byteLength"] = json!(42);
    assert!(Model::parse(&glb(&json, &bytes)).is_ok());
    // Each of these would otherwise be a copy of the whole chunk.
    json["buffers"].as_array_mut().unwrap().extend((0..60).map(|_| json!({ "byteLength": 36 })));
    let error = Model::parse(&glb(&json, &bytes)).unwrap_err().to_string();
    assert!(error.contains("buffer 1") && error.contains("only the first buffer"), "{error}");
}

#[test]
fn a_model_knows_what_it_takes() {
    let (json, bytes) = triangle();
    // Three vertices of position, normal and texture coordinates, three indices.
    assert_eq!(Model::parse(&glb(&json, &bytes)).unwrap().bytes(), 3 * 32 + 3 * 4);
}

#[test]
fn nodes_place_and_mirrored_nodes_keep_their_outside() {
    let (mut json, bytes) = triangle();
    json["nodes"] = json!([{ "children": [1], "translation": [0, 0, 5] }, { "mesh": 0, "scale": [-2, 1, 1] }]);
    let model = Model::parse(&embedded(json, &bytes)).unwrap();
    let mesh = &model.parts[0].mesh;
    let [a, b, c] = [0, 1, 2].map(|i| Vec3::from_array(mesh.vertices[mesh.indices[i] as usize].position));
    assert_eq!((b - a).cross(c - a), Vec3::Z * 2.0);
    assert_eq!(model.bounds.min, Vec3::new(-2.0, 0.0, 5.0));
}

#[test]
fn a_skin_moves_vertices_by_its_joints_alone() {
    let (mut json, mut bytes) = triangle();
    bytes.extend([[0u8, 0, 0, 0]; 3].concat());
    bytes.extend([[1.0f32, 0.0, 0.0, 0.0]; 3].concat().iter().flat_map(|v| v.to_le_bytes()));
    json["buffers"][0]["byteLength"] = json!(bytes.len());
    json["bufferViews"] = json!([
        { "buffer": 0, "byteLength": 36 }, { "buffer": 0, "byteOffset": 36, "byteLength": 6 },
        { "buffer": 0, "byteOffset": 44, "byteLength": 12 }, { "buffer": 0, "byteOffset": 56, "byteLength": 48 }
    ]);
    json["accessors"].as_array_mut().unwrap().extend([
        json!({ "bufferView": 2, "componentType": 5121, "count": 3, "type": "VEC4" }),
        json!({ "bufferView": 3, "componentType": 5126, "count": 3, "type": "VEC4" }),
    ]);
    json["meshes"][0]["primitives"][0]["attributes"] = json!({ "POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3 });
    // The mesh node's own translation is ignored, as glTF says.
    json["nodes"] = json!([{ "mesh": 0, "skin": 0, "translation": [9, 9, 9] }, { "translation": [0, 2, 0] }]);
    json["scenes"][0]["nodes"] = json!([0, 1]);
    json["skins"] = json!([{ "joints": [1] }]);
    let model = Model::parse(&embedded(json.clone(), &bytes)).unwrap();
    assert_eq!(model.bounds.min, Vec3::new(0.0, 2.0, 0.0));
    bytes[44] = 7;
    let error = Model::parse(&embedded(json, &bytes)).unwrap_err().to_string();
    assert!(error.contains("joint 7") && error.contains("mesh 0, primitive 0"), "{error}");
}

#[test]
fn each_fault_names_its_element() {
    let chain = |length: usize| {
        let mut nodes: Vec<Value> = (1..length).map(|child| json!({ "children": [child] })).collect();
        nodes.push(json!({ "mesh": 0 }));
        Value::Array(nodes)
    };
    type Break = Box<dyn Fn(&mut Value, &mut Vec<u8>)>;
    let cases: Vec<(&str, Break)> = vec![
        (
            "buffer 0 holds 44 bytes where 64",
            Box::new(|json, bytes| {
                json["buffers"][0]["uri"] = json!(format!("data:a;base64,{}", base64::engine::general_purpose::STANDARD.encode(bytes)));
                json["buffers"][0]["byteLength"] = json!(64);
            }),
        ),
        (
            "mesh 0, primitive 0: accessor 5 does not exist",
            Box::new(|json, _| json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = json!(5)),
        ),
        ("image 0: has neither", Box::new(|json, _| json["images"] = json!([{ "bufferView": 0 }]))),
        ("buffer 0 has broken base64", Box::new(|json, _| json["buffers"][0]["uri"] = json!("data:a;base64,*"))),
        ("buffer 0 lies in another file, \"secret.bin\"", Box::new(|json, _| json["buffers"][0]["uri"] = json!("secret.bin"))),
        ("buffer 0 brings the buffers to more than", Box::new(|json, _| json["buffers"][0]["byteLength"] = json!(4_294_967_296u64))),
        ("accessor 0 (positions): element 0 is not finite", Box::new(|_, bytes| bytes[..4].copy_from_slice(&f32::NAN.to_le_bytes()))),
        ("accessor 0 (positions)", Box::new(|json, _| json["accessors"][0]["count"] = json!(1_000_000_000))),
        ("accessor 0 (positions)", Box::new(|json, _| json["accessors"][0]["count"] = json!(4))),
        ("accessor 0 (positions)", Box::new(|json, _| json["accessors"][0]["byteOffset"] = json!(u64::MAX / 2))),
        ("accessor 0 (positions): buffer view 0", Box::new(|json, _| json["bufferViews"][0]["byteOffset"] = json!(20))),
        ("accessor 0 (positions): Vec2", Box::new(|json, _| json["accessors"][0]["type"] = json!("VEC2"))),
        ("accessor 1 (indices)", Box::new(|json, _| json["accessors"][1]["componentType"] = json!(5126))),
        ("mesh 0, primitive 0: index 9", Box::new(|_, bytes| bytes[36] = 9)),
        ("mesh 0, primitive 0: 2 indices", Box::new(|json, _| json["accessors"][1]["count"] = json!(2))),
        ("mesh 0, primitive 0: Lines", Box::new(|json, _| json["meshes"][0]["primitives"][0]["mode"] = json!(1))),
        ("node 0", Box::new(|json, _| json["nodes"] = json!([{ "mesh": 0, "children": [0] }]))),
        ("two parents", Box::new(|json, _| json["nodes"] = json!([{ "children": [1, 1] }, { "mesh": 0 }]))),
        ("node 64", Box::new(move |json, _| json["nodes"] = chain(MAX_NODE_DEPTH + 2))),
        (
            "extension KHR_draco_mesh_compression",
            Box::new(|json, _| {
                json["extensionsRequired"] = json!(["KHR_draco_mesh_compression"]);
                json["extensionsUsed"] = json!(["KHR_draco_mesh_compression"]);
            }),
        ),
        (
            "image 0: neither PNG nor JPEG",
            Box::new(|json, _| {
                json["images"] = json!([{ "uri": "data:image/png;base64,AAAA" }]);
                json["textures"] = json!([{ "source": 0 }]);
                json["materials"] = json!([{ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }]);
                json["meshes"][0]["primitives"][0]["material"] = json!(0);
            }),
        ),
        ("not a valid glTF", Box::new(|json, _| json["nodes"][0]["mesh"] = json!(3))),
        ("no triangles", Box::new(|json, _| json["nodes"] = json!([{}]))),
    ];
    for (names, break_it) in cases {
        let (mut json, mut bytes) = triangle();
        break_it(&mut json, &mut bytes);
        let keeps_uri = json["buffers"][0].get("uri").is_some();
        let file = if keeps_uri { serde_json::to_vec(&json).unwrap() } else { embedded(json, &bytes) };
        let error = Model::parse(&file).expect_err(names).to_string();
        assert!(error.contains(names), "expected {names:?}, got {error}");
    }
}

#[test]
fn truncated_and_flipped_containers_never_panic() {
    let (json, bytes) = triangle();
    let whole = glb(&json, &bytes);
    for length in 0..whole.len() {
        assert!(Model::parse(&whole[..length]).is_err(), "{length}");
    }
    for at in 0..whole.len() {
        let mut flipped = whole.clone();
        flipped[at] ^= 0x55;
        let _ = Model::parse(&flipped);
    }
    assert!(matches!(Model::parse(b""), Err(ModelError::Format(_))));
}
