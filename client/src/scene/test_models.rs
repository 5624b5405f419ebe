//! Small glTF files for tests, put together from numbers.

use std::f32::consts::FRAC_1_SQRT_2;
use std::io::Cursor;

use serde_json::{Value, json};

/// A file in the making: its JSON, and the bytes of its one buffer.
#[derive(Clone)]
pub(crate) struct File {
    pub(crate) json: Value,
    pub(crate) bytes: Vec<u8>,
}

fn push(list: &mut Value, item: Value) -> usize {
    if list.is_null() {
        *list = json!([]);
    }
    let list = list.as_array_mut().unwrap();
    list.push(item);
    list.len() - 1
}

impl File {
    pub(crate) fn new() -> Self {
        let json = json!({ "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }] });
        Self { json, bytes: Vec::new() }
    }

    pub(crate) fn view(&mut self, bytes: &[u8]) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let view = json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() });
        self.bytes.extend(bytes);
        push(&mut self.json["bufferViews"], view)
    }

    fn accessor(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        let view = self.view(bytes);
        push(&mut self.json["accessors"], json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }))
    }

    /// Floats of `SCALAR`, `VEC2` … `MAT4`.
    pub(crate) fn floats(&mut self, kind: &str, values: &[f32]) -> usize {
        let width = match kind {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            _ => 16,
        };
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.accessor(&bytes, 5126, kind, values.len() / width)
    }

    /// Positions, with the bounds that the format asks for.
    pub(crate) fn positions(&mut self, values: &[[f32; 3]]) -> usize {
        let at = self.floats("VEC3", values.as_flattened());
        let pick = |least: fn(f32, f32) -> f32| [0, 1, 2].map(|axis| values.iter().map(|v| v[axis]).reduce(least).unwrap());
        self.json["accessors"][at]["min"] = json!(pick(f32::min));
        self.json["accessors"][at]["max"] = json!(pick(f32::max));
        at
    }

    pub(crate) fn joints(&mut self, values: &[[u8; 4]]) -> usize {
        self.accessor(values.as_flattened(), 5121, "VEC4", values.len())
    }

    pub(crate) fn indices(&mut self, values: &[u16]) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.accessor(&bytes, 5123, "SCALAR", values.len())
    }

    pub(crate) fn mesh(&mut self, primitive: &Value) -> usize {
        push(&mut self.json["meshes"], json!({ "primitives": [primitive] }))
    }

    pub(crate) fn animation(&mut self, name: &str, channels: &Value, samplers: &Value) {
        push(&mut self.json["animations"], json!({ "name": name, "channels": channels, "samplers": samplers }));
    }

    /// Index of a texture of RGBA texels.
    pub(crate) fn texture(&mut self, width: u32, texels: &[[u8; 4]], sampler: Value) -> usize {
        let height = texels.len() as u32 / width;
        let image = image::RgbaImage::from_raw(width, height, texels.concat()).unwrap();
        let mut png = Cursor::new(Vec::new());
        image.write_to(&mut png, image::ImageFormat::Png).unwrap();
        let view = self.view(png.get_ref());
        let source = push(&mut self.json["images"], json!({ "bufferView": view, "mimeType": "image/png" }));
        let sampler = push(&mut self.json["samplers"], sampler);
        push(&mut self.json["textures"], json!({ "source": source, "sampler": sampler }))
    }

    pub(crate) fn glb(&self) -> Vec<u8> {
        let mut json = self.json.clone();
        json["buffers"] = json!([{ "byteLength": self.bytes.len() }]);
        let mut text = serde_json::to_vec(&json).unwrap();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut binary = self.bytes.clone();
        binary.resize(binary.len().next_multiple_of(4), 0);
        let mut out = b"glTF".to_vec();
        for word in [2, (12 + 8 + text.len() + 8 + binary.len()) as u32, text.len() as u32] {
            out.extend(word.to_le_bytes());
        }
        out.extend(b"JSON");
        out.extend(text);
        out.extend((binary.len() as u32).to_le_bytes());
        out.extend(b"BIN\0");
        out.extend(binary);
        out
    }
}

/// A square of side 2 that faces +z, v growing downwards; `normal` at all its corners, if any.
pub(crate) fn square(normal: Option<[f32; 3]>) -> File {
    let mut file = File::new();
    let positions = file.positions(&[[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]]);
    let uv = file.floats("VEC2", &[0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0]);
    let indices = file.indices(&[0, 2, 1, 1, 2, 3]);
    let mut attributes = json!({ "POSITION": positions, "TEXCOORD_0": uv });
    if let Some(normal) = normal {
        attributes["NORMAL"] = json!(file.floats("VEC3", &[normal; 4].concat()));
    }
    file.mesh(&json!({ "attributes": attributes, "indices": indices, "material": 0 }));
    file.json["materials"] = json!([{ "pbrMetallicRoughness": { "metallicFactor": 0.0 } }]);
    file
}

/// A strip of two squares, from y = 0 to 2, with a joint at y = 0 and its child at y = 1; the upper corners can be moved by 1
/// along z. Its animations: "bend" turns the upper joint by 90° about z within a second, and moves the corners half way;
/// "shift" lifts the lower joint at once to y = 3, after a second to y = 5, and ends a second later.
pub(crate) fn arm(with_normals: bool) -> File {
    let mut file = File::new();
    let positions = file.positions(&[-0.5f32, 0.5].map(|x| [0.0f32, 1.0, 2.0].map(|y| [x, y, 0.0])).concat());
    let joints = file.joints(&[[0, 1, 0, 0]; 6]);
    let weights = file.floats("VEC4", &[[1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]].repeat(2).concat());
    let target = file.positions(&[[0.0; 3], [0.0; 3], [0.0, 0.0, 1.0]].repeat(2));
    let indices = file.indices(&[0, 3, 1, 3, 4, 1, 1, 4, 2, 4, 5, 2]);
    let mut attributes = json!({ "POSITION": positions, "JOINTS_0": joints, "WEIGHTS_0": weights });
    if with_normals {
        attributes["NORMAL"] = json!(file.floats("VEC3", &[[0.0, 0.0, 1.0]; 6].concat()));
    }
    file.mesh(&json!({ "attributes": attributes, "indices": indices, "targets": [{ "POSITION": target }] }));
    file.json["nodes"] = json!([{ "mesh": 0, "skin": 0 }, { "children": [2] }, { "translation": [0, 1, 0] }]);
    file.json["scenes"] = json!([{ "nodes": [0, 1] }]);
    let unit = [1.0f32, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let bind = file.floats("MAT4", &[&unit[..], &[0.0, 0.0, 0.0, 1.0], &unit, &[0.0, -1.0, 0.0, 1.0]].concat());
    file.json["skins"] = json!([{ "joints": [1, 2], "inverseBindMatrices": bind }]);
    let second = file.floats("SCALAR", &[0.0, 1.0]);
    let turns = file.floats("VEC4", &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, FRAC_1_SQRT_2, FRAC_1_SQRT_2]);
    let moves = file.floats("SCALAR", &[0.0, 0.5]);
    file.animation(
        "bend",
        &json!([
            { "sampler": 0, "target": { "node": 2, "path": "rotation" } },
            { "sampler": 1, "target": { "node": 0, "path": "weights" } }
        ]),
        &json!([{ "input": second, "output": turns }, { "input": second, "output": moves }]),
    );
    let times = file.floats("SCALAR", &[0.0, 1.0, 2.0]);
    let lifts = file.floats("VEC3", &[0.0, 3.0, 0.0, 0.0, 5.0, 0.0, 0.0, 5.0, 0.0]);
    file.animation(
        "shift",
        &json!([{ "sampler": 0, "target": { "node": 1, "path": "translation" } }]),
        &json!([{ "input": times, "output": lifts, "interpolation": "STEP" }]),
    );
    file
}

/// A square that its node takes from x = −2 to x = 2 within two seconds.
pub(crate) fn slider() -> File {
    let mut file = square(Some([0.0, 0.0, 1.0]));
    let times = file.floats("SCALAR", &[0.0, 2.0]);
    let places = file.floats("VEC3", &[-2.0, 0.0, 0.0, 2.0, 0.0, 0.0]);
    file.animation(
        "slide",
        &json!([{ "sampler": 0, "target": { "node": 0, "path": "translation" } }]),
        &json!([{ "input": times, "output": places }]),
    );
    file
}
