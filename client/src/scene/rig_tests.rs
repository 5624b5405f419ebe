//! Poses against closed forms, and what may be wrong with what makes them.

use glam::{Mat4, Vec3};
use mr360_shaders::layout::Vertex;
use proptest::prelude::*;
use serde_json::json;

use super::material::{AlphaMode, PLAIN_UV};
use super::model::Model;
use super::rig::deform;
use super::test_models::{File, arm, slider, square};

fn posed(model: &Model, animation: usize, time_s: f64) -> Vec<Vertex> {
    let rig = model.rig.as_ref().unwrap();
    let pose = rig.pose(animation, time_s);
    let vertices = |moving: &super::rig::Moving| {
        let binding = &rig.bindings[moving.binding];
        deform(&moving.primitive, &pose.matrices[binding.first_matrix..], &pose.weights[binding.first_weight..])
    };
    rig.moving.iter().flat_map(vertices).collect()
}

fn close(vertex: &Vertex, expected: Vec3) -> bool {
    (Vec3::from_array(vertex.position) - expected).length() < 1e-5
}

#[test]
fn joints_and_morph_targets_move_vertices_by_their_formula() {
    let model = Model::parse(&arm(true).glb()).unwrap();
    for time in [0.0, 0.25, 0.5, 0.9] {
        let (angle, weight) = (std::f32::consts::FRAC_PI_2 * time as f32, 0.5 * time as f32);
        let vertices = posed(&model, 0, time);
        // About z through (0, 1): the lower end stays, the upper turns and moves along z, the middle is held by both.
        let turned = |x: f32, y: f32, z: f32| {
            let (sine, cosine) = angle.sin_cos();
            Vec3::new(x * cosine - (y - 1.0) * sine, 1.0 + x * sine + (y - 1.0) * cosine, z)
        };
        for (column, x) in [-0.5, 0.5].into_iter().enumerate() {
            assert!(close(&vertices[column * 3], Vec3::new(x, 0.0, 0.0)), "{time}");
            assert!(close(&vertices[column * 3 + 1], (Vec3::new(x, 1.0, 0.0) + turned(x, 1.0, 0.0)) * 0.5), "{time}");
            assert!(close(&vertices[column * 3 + 2], turned(x, 2.0, weight)), "{time}: {:?}", vertices[column * 3 + 2]);
        }
        assert_eq!(posed(&model, 0, time), posed(&model, 0, time + 7.0), "an animation of a second begins anew each second");
    }
    // Steps jump, and the animation ends with its last key.
    for (time, lift) in [(0.0, 3.0), (0.99, 3.0), (1.0, 5.0), (1.9, 5.0), (2.0, 3.0)] {
        assert!(close(&posed(&model, 1, time)[0], Vec3::new(-0.5, lift, 0.0)), "{time}");
    }
}

#[test]
fn without_an_animation_a_model_rests_and_its_parts_are_at_rest() {
    let mut file = arm(true);
    file.json["meshes"][0]["weights"] = json!([0.25]);
    let model = Model::parse(&file.glb()).unwrap();
    let rig = model.rig.as_ref().unwrap();
    assert_eq!(rig.pose(9, 0.7), rig.rest());
    assert_eq!(model.parts[0].mesh.vertices, posed(&model, 9, 0.0));
    // The mesh's own weights hold where nothing animates them, as in "shift".
    assert!(close(&model.parts[0].mesh.vertices[2], Vec3::new(-0.5, 2.0, 0.25)));
    assert!(close(&posed(&model, 1, 0.5)[2], Vec3::new(-0.5, 5.0, 0.25)));
    // A node's weights stand before its mesh's.
    file.json["nodes"][0]["weights"] = json!([1.0]);
    file.json.as_object_mut().unwrap().remove("animations");
    let still = Model::parse(&file.glb()).unwrap();
    assert!(still.rig.is_none() && close(&still.parts[0].mesh.vertices[2], Vec3::new(-0.5, 2.0, 1.0)));
}

#[test]
fn a_rigid_part_follows_its_node_and_others_stay() {
    let mut file = slider();
    let nodes = file.json["nodes"].as_array_mut().unwrap();
    nodes.push(json!({ "mesh": 0, "translation": [0, 9, 0] }));
    file.json["scenes"][0]["nodes"] = json!([0, 1]);
    let model = Model::parse(&file.glb()).unwrap();
    let rig = model.rig.as_ref().unwrap();
    assert_eq!((model.parts.len(), rig.moving.len(), rig.moving[0].part), (2, 1, 0));
    assert!(close(&posed(&model, 0, 0.5)[0], Vec3::new(-2.0, 1.0, 0.0)));
    // From x = −3 to 3, and the other square at y = 10.
    let bounds = rig.bounds[0];
    assert!(bounds.min.x <= -3.0 && bounds.max.x >= 3.0 && bounds.max.y >= 10.0, "{bounds:?}");
    assert!(bounds.max.x < 3.0 + 1.0 && bounds.min.y > -1.0 - 1.0, "no more than half a step beyond: {bounds:?}");
}

#[test]
fn normals_of_flat_triangles_are_those_of_the_pose() {
    let model = Model::parse(&arm(false).glb()).unwrap();
    for time in [0.0, 0.3, 0.8] {
        let vertices = posed(&model, 0, time);
        assert_eq!(vertices.len(), 12);
        for corners in vertices.chunks_exact(3) {
            let [a, b, c] = [0, 1, 2].map(|i| Vec3::from_array(corners[i].position));
            let normal = (b - a).cross(c - a).normalize();
            assert!(corners.iter().all(|corner| (Vec3::from_array(corner.normal) - normal).length() < 1e-5), "{time}");
        }
    }
}

#[test]
fn bounds_hold_every_pose() {
    for file in [arm(true), arm(false), slider()] {
        let model = Model::parse(&file.glb()).unwrap();
        let rig = model.rig.as_ref().unwrap();
        for (animation, bounds) in rig.bounds.iter().enumerate() {
            for i in 0..500 {
                let time = f64::from(rig.animations[animation].duration_s) * f64::from(i) / 499.0;
                for vertex in posed(&model, animation, time) {
                    let at = Vec3::from_array(vertex.position);
                    assert!(at.cmpge(bounds.min - 1e-5).all() && at.cmple(bounds.max + 1e-5).all(), "{animation} {time}: {at} {bounds:?}");
                }
            }
        }
    }
}

#[test]
fn singular_and_mirroring_matrices_keep_normals() {
    let mut file = square(Some([0.0, 0.6, 0.8]));
    file.json["nodes"][0]["scale"] = json!([0.0, 2.0, 1.0]);
    let flattened = Model::parse(&file.glb()).unwrap();
    assert!(flattened.parts[0].mesh.vertices.iter().all(|vertex| Vec3::from_array(vertex.normal).is_normalized()));
    file.json["nodes"][0]["scale"] = json!([-1.0, 2.0, 1.0]);
    let mirrored = Model::parse(&file.glb()).unwrap();
    // The inverse transpose of diag(−1, 2, 1), of (0, 0.6, 0.8).
    let expected = Vec3::new(0.0, 0.3, 0.8).normalize();
    assert!((Vec3::from_array(mirrored.parts[0].mesh.vertices[0].normal) - expected).length() < 1e-6);
}

#[test]
fn a_material_reads_as_written() {
    let mut file = square(Some([0.0, 0.0, 1.0]));
    let texture = file.texture(1, &[[9, 9, 9, 9]], json!({ "wrapS": 33071, "magFilter": 9728, "minFilter": 9729 }));
    let transform = json!({ "offset": [0.5, 0.25], "rotation": std::f32::consts::FRAC_PI_2, "scale": [2.0, 3.0], "texCoord": 1 });
    file.json["materials"] = json!([{
        "alphaMode": "MASK", "alphaCutoff": 0.3, "doubleSided": true,
        "emissiveFactor": [0.5, 0.25, 1.0], "emissiveTexture": { "index": texture },
        "normalTexture": { "index": texture, "scale": 0.5, "extensions": { "KHR_texture_transform": transform } },
        "occlusionTexture": { "index": texture, "strength": 0.75, "texCoord": 1 },
        "pbrMetallicRoughness": { "baseColorFactor": [0.1, 0.2, 0.3, 0.4], "baseColorTexture": { "index": texture } },
        "extensions": { "KHR_materials_emissive_strength": { "emissiveStrength": 8.0 }, "KHR_materials_unlit": {} }
    }]);
    file.json["extensionsRequired"] = json!(["KHR_materials_emissive_strength", "KHR_materials_unlit", "KHR_texture_transform"]);
    let model = Model::parse(&file.glb()).unwrap();
    let surface = &model.parts[0].surface;
    assert_eq!((surface.alpha, surface.alpha_mode, surface.unlit), (0.4, AlphaMode::Mask(0.3), true));
    assert_eq!(surface.emission, Vec3::new(4.0, 2.0, 8.0));
    assert_eq!((surface.normal_scale, surface.occlusion_strength), (0.5, 0.75));
    let normal = surface.normal_texture.unwrap();
    // Counter-clockwise with v downwards: a quarter turn takes +u to −v. Scaled before, moved after.
    let at = |u: f32, v: f32| normal.transform.map(|row| row.dot(Vec3::new(u, v, 1.0)));
    let near = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).abs() + (a[1] - b[1]).abs() < 1e-6;
    assert!(near(at(0.0, 0.0), [0.5, 0.25]) && near(at(1.0, 0.0), [0.5, 0.25 - 2.0]) && near(at(0.0, 1.0), [0.5 + 3.0, 0.25]));
    assert!(normal.second_uv && surface.occlusion_texture.unwrap().second_uv);
    let color = surface.base_color_texture.unwrap();
    assert!(!color.second_uv && color.transform == PLAIN_UV);
    assert_eq!((color.sampling.magnify_linear, color.sampling.minify_linear, color.sampling.mips_linear), (false, true, None));
    // One image, three ways of averaging it.
    assert_eq!(model.textures.len(), 3);
    // TEXCOORD_1 is asked for and is not there: zeros, and no fault.
    assert!(model.parts[0].details.is_empty());
}

#[test]
fn what_a_vertex_has_beyond_the_usual_is_kept() {
    let mut file = square(Some([0.0, 0.0, 1.0]));
    let colors = file.floats("VEC3", &[[0.0, 0.5, 1.0]; 4].concat());
    let tangents = file.floats("VEC4", &[[1.0, 0.0, 0.0, 1.0]; 4].concat());
    let texture = file.texture(1, &[[128, 128, 255, 255]], json!({}));
    let attributes = &mut file.json["meshes"][0]["primitives"][0]["attributes"];
    (attributes["COLOR_0"], attributes["TANGENT"]) = (json!(colors), json!(tangents));
    let details = |file: &File| Model::parse(&file.glb()).unwrap().parts[0].details.clone();
    let plain = details(&file);
    // Without a normal map nobody asks for tangents.
    assert_eq!((plain[0].color, plain[0].tangent), ([0, 32_768, 65_535, 65_535], [0.0; 4]));
    file.json["materials"][0]["normalTexture"] = json!({ "index": texture });
    assert_eq!(details(&file)[3].tangent, [1.0, 0.0, 0.0, 1.0]);
    file.json["nodes"][0]["scale"] = json!([-2.0, 1.0, 1.0]);
    assert_eq!(details(&file)[3].tangent, [-1.0, 0.0, 0.0, -1.0], "a mirror turns the tangent, and the side of the bitangent");
}

#[test]
fn each_fault_of_animations_and_attributes_names_its_element() {
    type Break = fn(&mut File);
    let cases: [(&str, Break); 19] = [
        ("animation 0: channel 0 has times that do not rise: key 0", |file| {
            let times = file.floats("SCALAR", &[1.0, 1.0]);
            file.json["animations"][0]["samplers"][0]["input"] = json!(times);
        }),
        ("accessor", |file| {
            let times = file.floats("SCALAR", &[0.0, f32::NAN]);
            file.json["animations"][0]["samplers"][0]["input"] = json!(times);
        }),
        ("animation 1: channel 0 has 9 numbers where 2 keys", |file| {
            let times = file.floats("SCALAR", &[0.0, 1.0]);
            file.json["animations"][1]["samplers"][0]["input"] = json!(times);
        }),
        ("animation 0: channel 0 has no keys", |file| {
            let times = file.floats("SCALAR", &[-1.0, 1.0]);
            file.json["animations"][0]["samplers"][0]["input"] = json!(times);
        }),
        ("animation 0: channel 1 moves node 77", |file| file.json["animations"][0]["channels"][1]["target"]["node"] = json!(77)),
        ("animation 0: channel 0 moves neither", |file| file.json["animations"][0]["channels"][0]["target"]["path"] = json!("pointer")),
        ("animation 0: channel 2 moves the Rotation", |file| {
            let first = file.json["animations"][0]["channels"][0].clone();
            file.json["animations"][0]["channels"].as_array_mut().unwrap().push(first);
        }),
        ("not a valid glTF", |file| file.json["animations"][0]["channels"][0]["sampler"] = json!(5)),
        ("animation 1: moves vertices to where no number reaches", |file| {
            let far = file.floats("VEC3", &[3e38; 9]);
            file.json["animations"][1]["samplers"][0]["output"] = json!(far);
            file.json["nodes"][2]["translation"] = json!([3e38, 3e38, 3e38]);
            file.json["skins"][0].as_object_mut().unwrap().remove("inverseBindMatrices");
        }),
        ("mesh 0, primitive 0: joint 9 is not in its skin of 2", |file| {
            let joints = file.joints(&[[9, 1, 0, 0]; 6]);
            file.json["meshes"][0]["primitives"][0]["attributes"]["JOINTS_0"] = json!(joints);
        }),
        ("node 2: is a joint without inverse bind matrix", |file| {
            let bind = file.json["skins"][0]["inverseBindMatrices"].as_u64().unwrap() as usize;
            file.json["accessors"][bind]["count"] = json!(1);
        }),
        ("node 1: is a joint but not part of the scene", |file| file.json["scenes"][0]["nodes"] = json!([0])),
        ("belongs to a skin that has no joints", |file| file.json["skins"][0]["joints"] = json!([])),
        ("mesh 0, primitive 0: accessor 99", |file| file.json["meshes"][0]["primitives"][0]["targets"][0]["POSITION"] = json!(99)),
        ("its attributes differ in count", |file| {
            let target = file.positions(&[[0.0; 3]; 5]);
            file.json["meshes"][0]["primitives"][0]["targets"][0]["POSITION"] = json!(target);
        }),
        ("node 2: its transform", |file| file.json["nodes"][2]["translation"] = json!([1e39, 0.0, 0.0])),
        ("node 1: ", |file| file.json["nodes"][2]["children"] = json!([1])),
        ("sparse values or indices", |file| {
            let indices = file.view(&[250]);
            let values = file.view(&[0; 12]);
            let sparse =
                json!({ "count": 1, "indices": { "bufferView": indices, "componentType": 5121 }, "values": { "bufferView": values } });
            let positions = file.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"].as_u64().unwrap() as usize;
            file.json["accessors"][positions]["sparse"] = sparse;
        }),
        ("elements, at most", |file| {
            let target = file.json["meshes"][0]["primitives"][0]["targets"][0]["POSITION"].as_u64().unwrap() as usize;
            file.json["accessors"][target]["count"] = json!(1u64 << 32);
        }),
    ];
    for (names, break_it) in cases {
        let mut file = arm(true);
        break_it(&mut file);
        let error = Model::parse(&file.glb()).expect_err(names).to_string();
        assert!(error.contains(names), "expected {names:?}, got {error}");
    }
    let mut file = square(None);
    let texture = file.texture(1, &[[0; 4]], json!({}));
    for (names, material) in [
        ("material 0: uses texture coordinates 2", json!({ "normalTexture": { "index": texture, "texCoord": 2 } })),
        ("material 0: factors", json!({ "emissiveFactor": [2.0, 0.0, 0.0] })),
        ("material 0: normal scale", json!({ "normalTexture": { "index": texture, "scale": 1e39 } })),
        (
            "material 0: its texture transform",
            json!({
                "occlusionTexture": { "index": texture, "extensions": { "KHR_texture_transform": { "scale": [1e39, 1.0] } } }
            }),
        ),
    ] {
        file.json["materials"] = json!([material]);
        let error = Model::parse(&file.glb()).expect_err(names).to_string();
        assert!(error.contains(names), "expected {names:?}, got {error}");
    }
}

#[test]
fn a_pose_of_no_use_is_no_panic() {
    let model = Model::parse(&arm(true).glb()).unwrap();
    let rig = model.rig.as_ref().unwrap();
    for time in [f64::NAN, f64::INFINITY, -5.0, 1e300] {
        assert!(rig.pose(0, time).matrices.iter().all(|matrix: &Mat4| matrix.is_finite()), "{time}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

    /// Whatever becomes of a file's bytes, reading it ends, in a model of its size or in an error.
    #[test]
    fn flipped_bytes_neither_panic_nor_grow(flips in proptest::collection::vec((any::<proptest::sample::Index>(), any::<u8>()), 1..6), normals in any::<bool>()) {
        let mut bytes = arm(normals).glb();
        for (at, value) in flips {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        match Model::parse(&bytes) {
            Ok(model) => {
                prop_assert!(model.bytes() < 1 << 20);
                if let Some(rig) = &model.rig {
                    (0..rig.animations.len()).for_each(|animation| drop(rig.pose(animation, 0.4)));
                }
            }
            Err(error) => prop_assert!(!error.to_string().is_empty()),
        }
    }
}
