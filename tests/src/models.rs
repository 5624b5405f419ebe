//! Small glTF models made from numbers, for tests and benches.

use std::f32::consts::{PI, TAU};
use std::io::Cursor;

use anyhow::{Context, Result};
use glam::{Vec2, Vec3};
use image::RgbaImage;
use serde_json::{Value, json};

/// A .glb in the making: one node with one mesh of one part, whose material is the file's first.
pub struct Glb {
    /// The file's JSON, without its buffer.
    pub json: Value,
    bytes: Vec<u8>,
}

/// Corners of a part, and its triangles.
struct Surface {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    coordinates: Vec<Vec2>,
    indices: Vec<u32>,
}

impl Glb {
    fn new(surface: &Surface) -> Self {
        let json = json!({
            "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
            "bufferViews": [], "accessors": [], "materials": [{}],
        });
        let mut file = Self { json, bytes: Vec::new() };
        let positions = file.floats("VEC3", &flat(&surface.positions));
        let bound = |pick: fn(Vec3, Vec3) -> Vec3| surface.positions.iter().copied().reduce(pick).unwrap_or_default().to_array();
        file.json["accessors"][positions]["min"] = json!(bound(Vec3::min));
        file.json["accessors"][positions]["max"] = json!(bound(Vec3::max));
        let normals = file.floats("VEC3", &flat(&surface.normals));
        let coordinates = file.floats("VEC2", &surface.coordinates.iter().flat_map(|uv| uv.to_array()).collect::<Vec<_>>());
        let bytes: Vec<u8> = surface.indices.iter().flat_map(|index| index.to_le_bytes()).collect();
        let indices = file.accessor(&bytes, 5125, "SCALAR", surface.indices.len());
        let attributes = json!({ "POSITION": positions, "NORMAL": normals, "TEXCOORD_0": coordinates });
        file.json["meshes"] = json!([{ "primitives": [{ "attributes": attributes, "indices": indices, "material": 0 }] }]);
        file
    }

    /// The same with this material.
    #[must_use]
    pub fn with_material(mut self, material: Value) -> Self {
        self.json["materials"] = json!([material]);
        self
    }

    /// Index of a texture for the material.
    ///
    /// # Errors
    /// When the image cannot be encoded.
    pub fn texture(&mut self, image: &RgbaImage) -> Result<usize> {
        let mut png = Cursor::new(Vec::new());
        image.write_to(&mut png, image::ImageFormat::Png).context("a texture cannot be encoded")?;
        let view = self.view(png.get_ref());
        let source = push(&mut self.json["images"], json!({ "bufferView": view, "mimeType": "image/png" }));
        Ok(push(&mut self.json["textures"], json!({ "source": source })))
    }

    /// The file.
    ///
    /// # Errors
    /// When it is longer than a .glb can be.
    pub fn finish(mut self) -> Result<Vec<u8>> {
        self.pad();
        self.json["buffers"] = json!([{ "byteLength": self.bytes.len() }]);
        let mut text = self.json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let length = |bytes: usize| u32::try_from(bytes).map(u32::to_le_bytes).context("the model is too large for a .glb");
        let head = [b"glTF".to_vec(), 2_u32.to_le_bytes().to_vec(), length(28 + text.len() + self.bytes.len())?.to_vec()].concat();
        let chunk = |kind: &[u8], data: &[u8]| -> Result<Vec<u8>> { Ok([&length(data.len())?[..], kind, data].concat()) };
        Ok([head, chunk(b"JSON", &text)?, chunk(b"BIN\0", &self.bytes)?].concat())
    }

    fn pad(&mut self) {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
    }

    fn view(&mut self, bytes: &[u8]) -> usize {
        self.pad();
        let view = json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() });
        self.bytes.extend(bytes);
        push(&mut self.json["bufferViews"], view)
    }

    fn accessor(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        let view = self.view(bytes);
        push(&mut self.json["accessors"], json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }))
    }

    /// `SCALAR`, `VEC2`, `VEC3`, `VEC4` or `MAT4`.
    fn floats(&mut self, kind: &str, values: &[f32]) -> usize {
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
}

fn flat(vectors: &[Vec3]) -> Vec<f32> {
    vectors.iter().flat_map(Vec3::to_array).collect()
}

/// Appends to a list, which is made where there is none, and returns the item's place in it.
fn push(list: &mut Value, item: Value) -> usize {
    match list {
        Value::Array(items) => {
            items.push(item);
            items.len() - 1
        }
        other => {
            *other = Value::Array(vec![item]);
            0
        }
    }
}

/// Two triangles for each cell of a grid of corners, `columns + 1` in a row, rows going down seen from outside.
fn grid(rows: u32, columns: u32) -> Vec<u32> {
    let cell = |row: u32, column: u32| {
        let at = row * (columns + 1) + column;
        let below = at + columns + 1;
        [at, below, at + 1, at + 1, below, below + 1]
    };
    (0..rows).flat_map(|row| (0..columns).flat_map(move |column| cell(row, column))).collect()
}

/// A ball one metre across of `rows` rings, twice as many cells around, with the texture of a globe.
#[must_use]
pub fn ball(rows: u32) -> Glb {
    let (rows, columns) = (rows.max(2), 2 * rows.max(2));
    let corners = (0..=rows).flat_map(|row| (0..=columns).map(move |column| (row, column)));
    let coordinates: Vec<Vec2> = corners.map(|(row, column)| Vec2::new(column as f32 / columns as f32, row as f32 / rows as f32)).collect();
    let normal = |uv: &Vec2| {
        let (polar, around) = (uv.y * PI, uv.x * TAU);
        Vec3::new(polar.sin() * around.sin(), polar.cos(), polar.sin() * around.cos())
    };
    let normals: Vec<Vec3> = coordinates.iter().map(normal).collect();
    let positions = normals.iter().map(|normal| *normal * 0.5).collect();
    Glb::new(&Surface { positions, normals, coordinates, indices: grid(rows, columns) })
}

/// A post one metre high on the ground, a quarter of a metre across, whose upper half bends by 90° to the right within a second: a skin of two joints.
#[must_use]
pub fn bending_post() -> Glb {
    const RADIUS: f32 = 0.125;
    let (rows, columns) = (16, 24);
    let corners = (0..=rows).flat_map(|row| (0..=columns).map(move |column| (row, column)));
    let coordinates: Vec<Vec2> = corners.map(|(row, column)| Vec2::new(column as f32 / columns as f32, row as f32 / rows as f32)).collect();
    let normals: Vec<Vec3> = coordinates.iter().map(|uv| Vec3::new((uv.x * TAU).sin(), 0.0, (uv.x * TAU).cos())).collect();
    let positions: Vec<Vec3> = coordinates.iter().zip(&normals).map(|(uv, normal)| *normal * RADIUS + Vec3::Y * (1.0 - uv.y)).collect();
    // The upper joint takes over between 0.4 and 0.6 m.
    let upper: Vec<f32> = positions.iter().map(|position| ((position.y - 0.4) / 0.2).clamp(0.0, 1.0)).collect();
    let mut file = Glb::new(&Surface { positions, normals, coordinates, indices: grid(rows, columns) });
    let weights = file.floats("VEC4", &upper.iter().flat_map(|upper| [1.0 - upper, *upper, 0.0, 0.0]).collect::<Vec<_>>());
    let joints: Vec<u8> = upper.iter().flat_map(|_| [0, 1, 0, 0]).collect();
    let joints = file.accessor(&joints, 5121, "VEC4", upper.len());
    let attributes = &mut file.json["meshes"][0]["primitives"][0]["attributes"];
    attributes["WEIGHTS_0"] = json!(weights);
    attributes["JOINTS_0"] = json!(joints);
    file.json["nodes"] = json!([{ "mesh": 0, "skin": 0 }, { "children": [2] }, { "translation": [0, 0.5, 0] }]);
    file.json["scenes"] = json!([{ "nodes": [0, 1] }]);
    let unmoved = |y: f32| [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, y, 0.0, 1.0];
    let bind = file.floats("MAT4", &[unmoved(0.0), unmoved(-0.5)].concat());
    file.json["skins"] = json!([{ "joints": [1, 2], "inverseBindMatrices": bind }]);
    let times = file.floats("SCALAR", &[0.0, 1.0]);
    let half = (PI / 4.0).sin();
    let turns = file.floats("VEC4", &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -half, half]);
    file.json["animations"] = json!([{
        "name": "bend",
        "channels": [{ "sampler": 0, "target": { "node": 2, "path": "rotation" } }],
        "samplers": [{ "input": times, "output": turns }],
    }]);
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ball_has_its_triangles_and_the_file_its_length() {
        let glb = ball(16).finish().unwrap();
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        let json: Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
        assert_eq!(json["accessors"][3]["count"].as_u64(), Some(16 * 32 * 6));
        assert_eq!(json["accessors"][0]["max"], json!([0.5, 0.5, 0.5]));
        assert_eq!(u32::from_le_bytes(glb[8..12].try_into().unwrap()) as usize, glb.len());
    }

    #[test]
    fn textures_are_numbered_in_their_order() {
        let mut file = bending_post();
        let image = RgbaImage::from_pixel(2, 2, image::Rgba([1, 2, 3, 4]));
        assert_eq!([file.texture(&image).unwrap(), file.texture(&image).unwrap()], [0, 1]);
        assert_eq!(file.json["images"].as_array().map(Vec::len), Some(2));
    }
}
