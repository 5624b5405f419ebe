//! Materials and poses as the picture shows them. They need a Vulkan adapter and fail without one.

use std::collections::HashMap;
use std::f32::consts::PI;
use std::sync::Arc;

use glam::{Quat, Vec3};
use mr360_protocol::light::{DirectionalLight, Lift, LightFrame};
use mr360_protocol::scene::{Geometry, Object, Playback, Transform};
use serde_json::{Value, json};

use super::tests::panorama;
use super::*;
use crate::picture::Picture;
use crate::render::{Still, ambient_light};
use crate::scene::model::Model;
use crate::scene::test_models::{File, slider, square};

const SIDE: u32 = 32;

/// Models that stand in a scene.
struct Stand {
    scene: Scene,
    models: HashMap<AssetId, Arc<Model>>,
}

impl Stand {
    fn new() -> Self {
        Self { scene: Scene { ground_y: -50.0, ..Scene::default() }, models: HashMap::new() }
    }

    fn with(mut self, file: &File, position: Vec3, rotation: Quat) -> Self {
        let bytes = file.glb();
        let id = AssetId::of(&bytes);
        self.models.insert(id, Arc::new(Model::parse(&bytes).unwrap()));
        let transform = Transform { position, rotation, scale: Vec3::ONE };
        let name = ObjectId(self.scene.objects.len() as u32 + 1);
        self.scene.objects.push(Object { id: name, geometry: Geometry::Model(id), transform, material: None, animation: Playback::First });
        self
    }

    fn draw_from(&self, gpu: &Gpu, picture: &Picture, light: &LightFrame, camera: &Camera) -> Vec<Vec3> {
        let still = Still { gpu, picture, light, scene: &self.scene, assets: &self.models };
        let bytes = still.draw(camera, (SIDE, SIDE), wgpu::TextureFormat::Rgba32Float).unwrap();
        bytemuck::pod_collect_to_vec::<u8, f32>(&bytes).chunks_exact(4).map(|t| Vec3::new(t[0], t[1], t[2])).collect()
    }

    fn draw(&self, gpu: &Gpu, picture: &Picture, light: &LightFrame) -> Vec<Vec3> {
        self.draw_from(gpu, picture, light, &Camera::looking(0.0, 0.0, 0.8))
    }
}

/// Fills the picture: at 2 m half of 0.8 rad reach 0.85 m.
const AHEAD: Vec3 = Vec3::new(0.0, 0.0, -2.0);

fn ahead(file: &File) -> Stand {
    Stand::new().with(file, AHEAD, Quat::IDENTITY)
}

fn even(radiance: f32) -> Picture {
    panorama(8, 4, |_| Vec3::splat(radiance))
}

fn dark() -> LightFrame {
    LightFrame { pts_us: 0, published_us: 0, lift: Lift::Linear, sh: vec![Vec3::ZERO; 9], lights: Vec::new() }
}

fn sun(direction: Vec3) -> LightFrame {
    let (direction, irradiance) = (direction.normalize(), Vec3::splat(3.0));
    LightFrame { lights: vec![DirectionalLight { id: 1, direction, irradiance, solid_angle_sr: 1e-3 }], ..dark() }
}

fn at(drawn: &[Vec3], x: f32, y: f32) -> Vec3 {
    drawn[(y * SIDE as f32) as usize * SIDE as usize + (x * SIDE as f32) as usize]
}

fn white(normal: [f32; 3], change: &Value) -> File {
    let mut file = square(Some(normal));
    let mut material = json!({ "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 0.6 } });
    change.as_object().unwrap().iter().for_each(|(key, value)| material[key] = value.clone());
    file.json["materials"] = json!([material]);
    file
}

fn worst(a: &[Vec3], b: &[Vec3]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (*a - *b).abs().max_element()).fold(0.0, f32::max)
}

#[test]
fn textures_lie_where_their_coordinates_say() {
    let gpu = Gpu::headless().unwrap();
    let [red, green, blue, yellow] = [[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [255, 255, 0, 255]];
    let seen = |transform: Value, second: bool, colors: bool| {
        let mut file = square(Some([0.0, 0.0, 1.0]));
        let texture = file.texture(2, &[red, green, blue, yellow], json!({ "magFilter": 9728, "minFilter": 9728 }));
        let mut info = json!({ "index": texture, "extensions": { "KHR_texture_transform": transform } });
        if second {
            // The other way round in u.
            let uv = file.floats("VEC2", &[1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0]);
            file.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_1"] = json!(uv);
            info["texCoord"] = json!(1);
        }
        if colors {
            let colors = file.floats("VEC4", &[[0.5, 0.25, 1.0, 1.0]; 4].concat());
            file.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = json!(colors);
        }
        file.json["materials"][0] =
            json!({ "pbrMetallicRoughness": { "baseColorTexture": info }, "extensions": { "KHR_materials_unlit": {} } });
        let drawn = ahead(&file).draw(&gpu, &even(0.3), &sun(Vec3::Z));
        [at(&drawn, 0.3, 0.3), at(&drawn, 0.7, 0.3), at(&drawn, 0.3, 0.7), at(&drawn, 0.7, 0.7)]
    };
    let [red, green, blue, yellow] = [red, green, blue, yellow].map(|[r, g, b, _]| Vec3::from_array([r, g, b].map(f32::from)) / 255.0);
    assert_eq!(seen(json!({}), false, false), [red, green, blue, yellow], "unlit: the colours themselves, in any light");
    assert_eq!(seen(json!({ "offset": [0.5, 0.0] }), false, false), [green, red, yellow, blue]);
    // A quarter turn: (u, v) looks at (v, −u).
    assert_eq!(seen(json!({ "rotation": PI / 2.0 }), false, false), [blue, red, yellow, green]);
    assert_eq!(seen(json!({ "scale": [0.5, 1.0] }), false, false), [red, red, blue, blue]);
    assert_eq!(seen(json!({}), true, false), [green, red, yellow, blue]);
    let tint = Vec3::new(0.5, 0.25, 1.0);
    for (seen, plain) in seen(json!({}), false, true).into_iter().zip([red, green, blue, yellow]) {
        // 16 bits of colour, then 11 of the layer.
        assert!((seen - plain * tint).abs().max_element() < 1e-3, "{seen} {plain}");
    }
}

#[test]
fn a_normal_map_tilts_as_the_geometry_would() {
    let gpu = Gpu::headless().unwrap();
    // Codes that are met exactly: −1 + code / 127.5.
    let code = [168u8, 90, 236, 255];
    let mapped = Vec3::from_array([code[0], code[1], code[2]].map(f32::from)) / 127.5 - 1.0;
    let light = sun(Vec3::new(0.7, 0.5, 0.6));
    let back = sun(Vec3::new(0.7, 0.5, -0.6));
    let picture = even(0.0);
    for mirrored in [false, true] {
        for turned in [false, true] {
            // Mapped u runs to the left in a mirrored square; seen from behind, all is the other way round by itself.
            let tilted = if mirrored { Vec3::new(-mapped.x, mapped.y, mapped.z) } else { mapped };
            let rotation = if turned { Quat::from_rotation_y(PI) } else { Quat::IDENTITY };
            let draw = |file: &File| {
                let camera_side = Stand::new().with(file, AHEAD, rotation);
                [&light, &back].map(|light| camera_side.draw(&gpu, &picture, light))
            };
            let truth = draw(&white(tilted.normalize().to_array(), &json!({ "doubleSided": true })));
            for tangents in [false, true] {
                let mut file = white([0.0, 0.0, 1.0], &json!({ "doubleSided": true }));
                let texture = file.texture(1, &[code], json!({}));
                file.json["materials"][0]["normalTexture"] = json!({ "index": texture });
                let attributes = ["meshes", "primitives", "attributes"];
                let side = if mirrored { -1.0 } else { 1.0 };
                if mirrored {
                    let uv = file.floats("VEC2", &[1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0]);
                    file.json[attributes[0]][0][attributes[1]][0][attributes[2]]["TEXCOORD_0"] = json!(uv);
                }
                if tangents {
                    let tangent = file.floats("VEC4", &[[side, 0.0, 0.0, side]; 4].concat());
                    file.json[attributes[0]][0][attributes[1]][0][attributes[2]]["TANGENT"] = json!(tangent);
                }
                for (drawn, truth) in draw(&file).iter().zip(&truth) {
                    // Half floats of values up to 1.
                    let off = worst(drawn, truth);
                    assert!(off < 2e-3, "mirrored {mirrored}, turned {turned}, tangents {tangents}: off by {off}");
                }
            }
        }
    }
}

#[test]
fn far_away_normals_become_roughness() {
    let gpu = Gpu::headless().unwrap();
    // Tilts of ±0.4 rad along both axes in turns, far smaller than pixels.
    let tilt = 0.4f32;
    let code = |v: f32| (v * 127.5 + 128.0) as u8;
    let texel = |i: u32| {
        let sign = if (i % 64).is_multiple_of(2) { 1.0 } else { -1.0 };
        let (x, y) = if (i / 64).is_multiple_of(2) { (sign * tilt.sin(), 0.0) } else { (0.0, sign * tilt.sin()) };
        [code(x), code(y), code(tilt.cos()), 255]
    };
    let texels: Vec<_> = (0..64 * 64).map(texel).collect();
    let mut bumpy = white([0.0, 0.0, 1.0], &json!({}));
    let texture = bumpy.texture(64, &texels, json!({}));
    let metal = |roughness: f32| json!({ "metallicFactor": 1.0, "roughnessFactor": roughness });
    bumpy.json["materials"][0]["pbrMetallicRoughness"] = metal(0.3);
    bumpy.json["materials"][0]["normalTexture"] =
        json!({ "index": texture, "extensions": { "KHR_texture_transform": { "scale": [8.0, 8.0] } } });
    // Slopes vary by (1 − cos) / cos along each axis; GGX alpha² grows by twice as much.
    let alpha2 = 0.3f32.powi(4) + 2.0 * (1.0 - tilt.cos()) / tilt.cos();
    let smooth = |roughness: f32| {
        let mut file = white([0.0, 0.0, 1.0], &json!({}));
        file.json["materials"][0]["pbrMetallicRoughness"] = metal(roughness);
        file
    };
    let light = sun(Vec3::new(0.2, 0.1, 1.0));
    let middle = |file: &File| at(&ahead(file).draw(&gpu, &even(0.0), &light), 0.5, 0.5).x;
    let (bumpy, rough, mirror) = (middle(&bumpy), middle(&smooth(alpha2.powf(0.25))), middle(&smooth(0.3)));
    // 8 bits of spread and of direction.
    assert!((bumpy / rough - 1.0).abs() < 0.05, "{bumpy} against {rough}");
    assert!(mirror / rough > 1.5, "the test would not see a map that widens nothing: {mirror} {rough}");
}

#[test]
fn occlusion_takes_ambient_light_alone() {
    let gpu = Gpu::headless().unwrap();
    let occluded = |strength: f32| {
        let mut file = white([0.0, 0.0, 1.0], &json!({}));
        let texture = file.texture(1, &[[51, 0, 0, 255]], json!({}));
        file.json["materials"][0]["occlusionTexture"] = json!({ "index": texture, "strength": strength });
        file
    };
    let open = white([0.0, 0.0, 1.0], &json!({}));
    let picture = even(1.0);
    let ambient = |file: &File| at(&ahead(file).draw(&gpu, &picture, &ambient_light(&picture)), 0.5, 0.5).x;
    assert!((ambient(&occluded(0.0)) / ambient(&open) - 1.0).abs() < 1e-3);
    // A white dielectric: 0.2 of its diffuse light is left, and less than 1 of the few per cent that are specular.
    let left = ambient(&occluded(1.0));
    assert!((0.19..0.24).contains(&left), "{left}");
    let direct = |file: &File| ahead(file).draw(&gpu, &even(0.0), &sun(Vec3::Z));
    assert_eq!(worst(&direct(&occluded(1.0)), &direct(&open)), 0.0);
}

#[test]
fn emission_shines_by_itself() {
    let gpu = Gpu::headless().unwrap();
    let mut file = white(
        [0.0, 0.0, 1.0],
        &json!({
            "emissiveFactor": [1.0, 0.5, 0.25],
            "extensions": { "KHR_materials_emissive_strength": { "emissiveStrength": 4.0 } }
        }),
    );
    let black = even(0.0);
    let lone = at(&ahead(&file).draw(&gpu, &black, &dark()), 0.5, 0.5);
    assert_eq!(lone, Vec3::new(4.0, 2.0, 1.0));
    let texture = file.texture(1, &[[255, 0, 255, 255]], json!({}));
    file.json["materials"][0]["emissiveTexture"] = json!({ "index": texture });
    assert_eq!(at(&ahead(&file).draw(&gpu, &black, &dark()), 0.5, 0.5), Vec3::new(4.0, 0.0, 1.0));
    // On top of what it reflects.
    let plain = white([0.0, 0.0, 1.0], &json!({}));
    let lit = |file: &File| at(&ahead(file).draw(&gpu, &black, &sun(Vec3::Z)), 0.5, 0.5);
    assert!((lit(&file) - lit(&plain) - Vec3::new(4.0, 0.0, 1.0)).abs().max_element() < 5e-3);
}

/// Alpha grows from left to right.
fn graded(mode: &str) -> File {
    let mut file = square(Some([0.0, 0.0, 1.0]));
    let texture = file.texture(2, &[[255, 255, 255, 0], [255; 4]], json!({ "wrapS": 33071, "wrapT": 33071 }));
    file.json["materials"][0] = json!({
        "alphaMode": mode,
        "pbrMetallicRoughness": { "baseColorTexture": { "index": texture } },
        "extensions": { "KHR_materials_unlit": {} }
    });
    file
}

#[test]
fn a_mask_cuts_along_its_cutoff_with_a_soft_edge() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(64, 32, |d| Vec3::splat(0.3 + 0.1 * d.x));
    let empty = Stand::new().draw(&gpu, &picture, &dark());
    // The edge passes the middles of pixels at a fifteenth of one: alpha = 2u − 0.5 between the texels' centres.
    let mut file = graded("MASK");
    file.json["materials"][0]["alphaCutoff"] = json!(0.53);
    let drawn = ahead(&file).draw(&gpu, &picture, &dark());
    let (edge, mut soft) = (0.53f32 + 0.5 - 1.0, 0);
    let half_width = 2.0 * 0.4f32.tan();
    for (i, (seen, before)) in drawn.iter().zip(&empty).enumerate() {
        let x = ((i as u32 % SIDE) as f32 + 0.5) / SIDE as f32 * 2.0 - 1.0;
        let pixels_right = (x - edge / half_width) * SIDE as f32 / 2.0;
        match pixels_right {
            right if right > 1.0 => assert_eq!(*seen, Vec3::ONE, "covered at {i}"),
            right if right < -1.0 => assert_eq!(seen, before, "untouched at {i}"),
            _ => soft += u32::from(*seen != Vec3::ONE && seen != before),
        }
    }
    assert!(soft >= SIDE / 2, "an edge of whole pixels only: {soft} of {SIDE} rows are soft");
    // With one sample a pixel it cuts where the middle of the pixel is: 15 of them lie right of the edge.
    let mut environment = Environment::new(&gpu).unwrap();
    environment.upload(&gpu, &picture).unwrap();
    let mut offscreen = crate::headless::Offscreen::new(&gpu.device, &gpu.queue, SIDE, SIDE);
    let target = offscreen.target();
    let mut renderer = Renderer::new(&gpu, target.format).unwrap();
    renderer.set_light(&dark());
    renderer.set_tier(Tier::LOWEST);
    let stand = ahead(&file);
    assert!(renderer.set_scene(&gpu, &stand.scene, &|id| stand.models.get(&id).cloned().map(Ok)).is_empty());
    let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    let view = View { camera: Camera::looking(0.0, 0.0, 0.8), target: &target.view, size: (SIDE, SIDE) };
    let report = renderer.render(&gpu, &mut encoder, &mut environment, &[view]);
    gpu.queue.submit([encoder.finish()]);
    let white = offscreen.read().unwrap().chunks_exact(4).filter(|texel| *texel == [255; 4]).count();
    assert_eq!((report.plan.samples, white), (1, 15 * SIDE as usize));
}

#[test]
fn blended_surfaces_mix_from_back_to_front() {
    let gpu = Gpu::headless().unwrap();
    let picture = even(0.5);
    let pane = |color: [f32; 4]| {
        let mut file = square(Some([0.0, 0.0, 1.0]));
        file.json["materials"][0] = json!({
            "alphaMode": "BLEND", "pbrMetallicRoughness": { "baseColorFactor": color }, "extensions": { "KHR_materials_unlit": {} }
        });
        file
    };
    let (near, far) = (pane([1.0, 0.0, 0.0, 0.5]), pane([0.0, 1.0, 0.0, 0.25]));
    let [front, behind] = [AHEAD, AHEAD - Vec3::Z].map(|at| move |stand: Stand, file: &File| stand.with(file, at, Quat::IDENTITY));
    let behind_it = Vec3::new(0.0, 1.0, 0.0) * 0.25 + Vec3::splat(0.5) * 0.75;
    let expected = Vec3::new(1.0, 0.0, 0.0) * 0.5 + behind_it * 0.5;
    for stand in [behind(front(Stand::new(), &near), &far), front(behind(Stand::new(), &far), &near)] {
        let seen = at(&stand.draw(&gpu, &picture, &dark()), 0.5, 0.5);
        assert!((seen - expected).abs().max_element() < 2e-3, "{seen} against {expected}");
    }
    // What covers hides what is blended behind it.
    let wall = white([0.0, 0.0, 1.0], &json!({ "extensions": { "KHR_materials_unlit": {} } }));
    let hidden = behind(front(Stand::new(), &wall), &far).draw(&gpu, &picture, &dark());
    assert_eq!(at(&hidden, 0.5, 0.5), Vec3::ONE);
}

/// A pane that faces the camera, and the far side of the glass a decimetre behind it.
fn slab(pane: &File) -> Stand {
    let far = white([0.0, 0.0, 1.0], &glass());
    ahead(pane).with(&far, AHEAD - Vec3::Z * 0.1, Quat::from_rotation_y(PI))
}

fn glass() -> Value {
    json!({
        "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 0.0 },
        "extensions": { "KHR_materials_transmission": { "transmissionFactor": 1.0 } }
    })
}

#[test]
fn glass_has_textures_vertex_colours_and_holes() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(64, 32, |d| Vec3::splat(0.5 + 0.1 * d.z.signum()));
    let empty = Stand::new().draw(&gpu, &picture, &dark());
    // Fresnel's 0.04 of what is behind the camera, and the rest passes once through the colour: a decimetre of glass.
    let seen = |tint: Vec3| Vec3::splat(0.04 * 0.6) + 0.96 * 0.4 * tint;
    let middle = |file: &File| at(&slab(file).draw(&gpu, &picture, &dark()), 0.5, 0.5);
    let tint = Vec3::new(1.0, 0.0, 1.0);
    let clear = white([0.0, 0.0, 1.0], &glass());
    let mut factor = clear.clone();
    factor.json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = json!([1.0, 0.0, 1.0, 1.0]);
    let mut textured = clear.clone();
    let texture = textured.texture(1, &[[255, 0, 255, 0]], json!({}));
    textured.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = json!({ "index": texture });
    let mut coloured = clear.clone();
    let colors = coloured.floats("VEC4", &[[1.0, 0.0, 1.0, 1.0]; 4].concat());
    coloured.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = json!(colors);
    for (name, file, tint) in
        [("clear", &clear, Vec3::ONE), ("factor", &factor, tint), ("texture", &textured, tint), ("vertices", &coloured, tint)]
    {
        let (drawn, expected) = (middle(file), seen(tint));
        // Light that is next to none is kept for infinite ways through it: a ten thousandth. The map has mips of half floats.
        assert!((drawn - expected).abs().max_element() < 4e-3, "{name}: {drawn} against {expected}");
    }
    // Glass blends by itself, whatever its alpha; a mask cuts it.
    textured.json["materials"][0]["alphaMode"] = json!("BLEND");
    assert!((middle(&textured) - seen(tint)).abs().max_element() < 4e-3);
    textured.json["materials"][0]["alphaMode"] = json!("MASK");
    assert_eq!(slab(&textured).draw(&gpu, &picture, &dark()), empty);
}

#[test]
fn glass_with_a_roughness_texture_has_all_its_levels_filled() {
    let gpu = Gpu::headless().unwrap();
    let finest = |textured: bool| {
        let mut file = white([0.0, 0.0, 1.0], &glass());
        file.json["materials"][0]["pbrMetallicRoughness"]["roughnessFactor"] = json!(0.6);
        if textured {
            let texture = file.texture(1, &[[255, 77, 255, 255]], json!({}));
            file.json["materials"][0]["pbrMetallicRoughness"]["metallicRoughnessTexture"] = json!({ "index": texture });
        }
        let stand = ahead(&file);
        let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
        assert!(renderer.set_scene(&gpu, &stand.scene, &|id| stand.models.get(&id).cloned().map(Ok)).is_empty());
        renderer.stage.needs.lobes_from
    };
    // Roughness 0.6 alone, and 0.6 · 0.3.
    assert_eq!((finest(false), finest(true)), (mr360_shaders::lobe::finest_level(0.6), Some(0)));
    assert!(finest(false) > Some(0));
}

#[test]
fn blended_surfaces_are_seen_through_glass_and_before_it() {
    let gpu = Gpu::headless().unwrap();
    let picture = even(0.5);
    let mut pane = square(Some([0.0, 0.0, 1.0]));
    pane.json["materials"][0] = json!({
        "alphaMode": "BLEND",
        "pbrMetallicRoughness": { "baseColorFactor": [1.0, 0.0, 0.0, 0.5] },
        "extensions": { "KHR_materials_unlit": {} }
    });
    let glass = white([0.0, 0.0, 1.0], &glass());
    // Half of it red, half of it what is behind.
    let over = Vec3::new(0.75, 0.25, 0.25);
    for (z, expected) in [(-1.0, 0.96 * over + 0.04 * 0.5), (0.5, over)] {
        let stand = ahead(&glass).with(&pane, AHEAD + Vec3::Z * z, Quat::IDENTITY);
        let seen = at(&stand.draw(&gpu, &picture, &dark()), 0.5, 0.5);
        assert!((seen - expected).abs().max_element() < 4e-3, "{z}: {seen} against {expected}");
    }
}

#[test]
fn shadows_have_the_holes_and_the_density_of_their_casters() {
    let gpu = Gpu::headless().unwrap();
    let picture = even(0.5);
    let camera = Camera::looking(0.0, -0.7, 0.9);
    let over_ground = |mode: &str, alpha: f32| {
        let mut file = square(Some([0.0, 0.0, 1.0]));
        file.json["materials"][0] = json!({
            "alphaMode": mode, "doubleSided": true, "pbrMetallicRoughness": { "baseColorFactor": [1.0, 1.0, 1.0, alpha] }
        });
        // Level, beside the view's centre, so that its shadow is seen past it.
        let mut stand = Stand::new().with(&file, Vec3::new(1.2, -0.8, -2.4), Quat::from_rotation_x(-PI / 2.0));
        stand.scene.ground_y = -1.6;
        let light = sun(Vec3::new(1.0, 1.0, 0.0));
        stand.draw_from(&gpu, &picture, &light, &camera)
    };
    let empty = Stand::new().draw_from(&gpu, &picture, &dark(), &camera);
    // The square's middle throws its shadow 0.8 m to the left.
    let at = |drawn: &[Vec3]| {
        let clip = camera.clip_from_view(1.0) * camera.view_from_world();
        let seen = clip.project_point3(Vec3::new(0.4, -1.6, -2.4));
        at(drawn, seen.x * 0.5 + 0.5, 0.5 - seen.y * 0.5).x
    };
    let solid = at(&over_ground("OPAQUE", 0.0));
    assert!(solid < 0.05, "{solid}");
    let half = at(&over_ground("BLEND", 0.5));
    // The penumbra's 16 taps over the dither: as many open as closed, within two.
    assert!((half - 0.25).abs() < 0.07, "{half}");
    assert_eq!(over_ground("MASK", 0.4), empty, "a mask that is all hole changes nothing");
    assert!((at(&over_ground("MASK", 0.6)) - solid).abs() < 1e-3);
}

#[test]
fn an_animated_model_is_where_its_picture_time_says_and_costs_nothing_unseen() {
    let gpu = Gpu::headless().unwrap();
    let mut file = slider();
    file.json["materials"][0] = json!({ "extensions": { "KHR_materials_unlit": {} } });
    let stand = Stand::new().with(&file, Vec3::new(0.0, 0.0, -8.0), Quat::IDENTITY);
    let middle_of = |time_s: f32| {
        let picture = Picture { pts_us: (time_s * 1e6) as u64, ..even(0.0) };
        let drawn = stand.draw(&gpu, &picture, &dark());
        let lit: Vec<f32> = drawn.iter().enumerate().filter(|(_, c)| c.x > 0.5).map(|(i, _)| (i as u32 % SIDE) as f32 + 0.5).collect();
        (lit.iter().sum::<f32>() / lit.len() as f32 / SIDE as f32 * 2.0 - 1.0) * 8.0 * 0.4f32.tan()
    };
    for (time, x) in [(0.0, -2.0), (0.5, -1.0), (1.0, 0.0), (3.5, 1.0)] {
        // A pixel is 0.21 m there.
        assert!((middle_of(time) - x).abs() < 0.15, "{time}: {} against {x}", middle_of(time));
    }
    let mut environment = Environment::new(&gpu).unwrap();
    let offscreen = crate::headless::Offscreen::new(&gpu.device, &gpu.queue, 32, 32);
    let target = offscreen.target();
    let mut renderer = Renderer::new(&gpu, target.format).unwrap();
    renderer.set_light(&dark());
    assert!(renderer.set_scene(&gpu, &stand.scene, &|id| stand.models.get(&id).cloned().map(Ok)).is_empty());
    let mut passes = |yaw: f32, step_us: u64| {
        let camera = Camera::looking(yaw, 0.0, 0.8);
        let mut report = FrameReport::default();
        for frame in 0..4 {
            renderer.set_time(frame * step_us);
            let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            report = renderer.render(&gpu, &mut encoder, &mut environment, &[View { camera, target: &target.view, size: (32, 32) }]);
            gpu.queue.submit([encoder.finish()]);
            gpu.wait().unwrap();
        }
        report.passes.iter().map(|pass| pass.name).collect::<Vec<_>>()
    };
    assert_eq!(passes(0.0, 1000), ["deform", "objects", "composite"]);
    assert_eq!(passes(0.0, 0), ["objects", "composite"], "the same picture has the same pose");
    assert_eq!(passes(PI, 1000), ["composite"]);
}

#[test]
fn an_animation_that_is_not_there_names_those_that_are() {
    let gpu = Gpu::headless().unwrap();
    let mut stand = Stand::new().with(&slider(), AHEAD, Quat::IDENTITY);
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
    let mut set = |animation: Playback| {
        stand.scene.objects[0].animation = animation;
        let warnings = renderer.set_scene(&gpu, &stand.scene, &|id| stand.models.get(&id).cloned().map(Ok));
        (warnings, renderer.stage.draws.first().map(|draw| draw.animation))
    };
    let (warnings, drawn) = set(Playback::Named("jump".to_owned()));
    let text = warnings[0].to_string();
    assert!(text.contains("object 1") && text.contains("no animation \"jump\"; it has \"slide\""), "{text}");
    assert_eq!(drawn, None);
    for (known, at) in [(Playback::Named("slide".to_owned()), Some(0)), (Playback::First, Some(0)), (Playback::Still, None)] {
        let (warnings, drawn) = set(known);
        assert!(warnings.is_empty() && drawn == Some(at), "{warnings:?} {drawn:?}");
    }
}
