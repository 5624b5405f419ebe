//! Scenes of one object each, one a material.

use std::collections::HashMap;
use std::sync::Arc;

use anyhow::{Context, Result};
use glam::Vec3;
use image::{Rgba, RgbaImage};
use mr360_client::render::Models;
use mr360_client::scene::model::Model;
use mr360_protocol::asset::AssetId;
use mr360_protocol::scene::{Geometry, Material, MaterialKind, Scene, Shape};
use mr360_tests::models::{Glb, ball, bending_post};
use serde_json::json;

use super::scene_of;

/// When the skinned model is shown: bent by 45°.
pub(crate) const TIME_US: u64 = 500_000;
/// Of a ball that stands on the ground.
const ON_GROUND: Vec3 = Vec3::new(0.0, -1.1, -3.0);
/// Texels of the textures' sides.
const SIDE: u32 = 64;

/// Name, scene and models of every material.
pub(crate) fn all() -> Result<Vec<(&'static str, Scene, Models)>> {
    let plain = |name, material| {
        let (scene, assets) = shape(material);
        (name, scene, assets)
    };
    let opaque = |base_color, roughness, metallic| Material { base_color, roughness, metallic, kind: MaterialKind::Opaque };
    let mut scenes = vec![
        plain("diffuse", opaque([0.6, 0.5, 0.4], 1.0, 0.0)),
        plain("glossy", GLOSSY),
        plain("rough-metal", opaque([0.9, 0.65, 0.3], 0.5, 1.0)),
        plain("mirror", opaque([0.95; 3], 0.0, 1.0)),
        plain("glass", Material { base_color: [0.85, 0.97, 0.95], roughness: 0.0, metallic: 0.0, kind: MaterialKind::Glass }),
    ];
    let models = [
        ("textured", textured()?, ON_GROUND),
        ("mask", holed("MASK")?, ON_GROUND),
        ("blend", holed("BLEND")?, ON_GROUND),
        ("emissive", ball(24).with_material(emissive()), ON_GROUND),
        ("skinned", bending_post().with_material(json!({ "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 0.6 } })), {
            Vec3::new(-0.1, -1.6, -3.0)
        }),
    ];
    for (name, file, position) in models {
        let bytes = file.finish()?;
        let id = AssetId::of(&bytes);
        let model = Model::parse(&bytes).with_context(|| name.to_owned())?;
        scenes.push((name, scene_of(Geometry::Model(id), None, position), HashMap::from([(id, Arc::new(model))])));
    }
    Ok(scenes)
}

const GLOSSY: Material = Material { base_color: [0.2, 0.35, 0.6], roughness: 0.25, metallic: 0.0, kind: MaterialKind::Opaque };

/// A glossy ball.
pub(crate) fn glossy() -> (Scene, Models) {
    shape(GLOSSY)
}

fn shape(material: Material) -> (Scene, Models) {
    (scene_of(Geometry::Shape(Shape::Sphere), Some(material), ON_GROUND), HashMap::new())
}

fn emissive() -> serde_json::Value {
    json!({ "emissiveFactor": [1.0, 0.5, 0.1], "pbrMetallicRoughness": { "baseColorFactor": [0.05, 0.05, 0.05, 1.0], "metallicFactor": 0.0 } })
}

/// True on every other of the fields of a chequer, eight around and four down.
fn chequer(x: u32, y: u32) -> bool {
    (x * 8 / SIDE + y * 4 / SIDE).is_multiple_of(2)
}

fn image(of: impl Fn(u32, u32) -> [u8; 4]) -> RgbaImage {
    RgbaImage::from_fn(SIDE, SIDE, |x, y| Rgba(of(x, y)))
}

/// Coloured fields, of which every other one is of polished metal, with waves all over.
fn textured() -> Result<Glb> {
    let mut file = ball(24);
    let base = file.texture(&image(|x, y| if chequer(x, y) { [230, 190, 120, 255] } else { [40, 70, 140, 255] }))?;
    // Green is roughness, blue metallic.
    let rough = file.texture(&image(|x, y| if chequer(x, y) { [0, 60, 255, 255] } else { [0, 200, 0, 255] }))?;
    let slope = |at: u32| (at as f32 / SIDE as f32 * 8.0 * std::f32::consts::TAU).sin() * 0.35;
    let normal = |x, y| {
        let normal = Vec3::new(slope(x), slope(y), 1.0).normalize();
        let [x, y, z] = (normal * 0.5 + 0.5).to_array().map(|part| (part * 255.0).round() as u8);
        [x, y, z, 255]
    };
    let normal = file.texture(&image(normal))?;
    Ok(file.with_material(json!({
        "pbrMetallicRoughness": { "baseColorTexture": { "index": base }, "metallicRoughnessTexture": { "index": rough } },
        "normalTexture": { "index": normal },
    })))
}

/// Every other field is away, or lets half of the light through.
fn holed(mode: &str) -> Result<Glb> {
    let mut file = ball(24);
    let clear = if mode == "MASK" { 0 } else { 128 };
    let base = file.texture(&image(|x, y| if chequer(x, y) { [200, 60, 40, 255] } else { [60, 180, 80, clear] }))?;
    Ok(file.with_material(json!({
        "alphaMode": mode, "doubleSided": true,
        "pbrMetallicRoughness": { "baseColorTexture": { "index": base }, "metallicFactor": 0.0, "roughnessFactor": 0.5 },
    })))
}
