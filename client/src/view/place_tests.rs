//! The real place beside the ground: what it catches, what it hides, and that nothing is darkened twice.

use std::collections::HashMap;
use std::sync::Arc;

use base64::Engine as _;
use glam::{Quat, Vec3};
use mr360_protocol::asset::AssetId;
use mr360_protocol::scene::{Gloss, PlaceMesh, Scene, Shape, Transform};

use super::extent::touched;
use super::shadow_tests::{Eye, GROUND_Y, RAYS, Solid, light, seen_of_light, towards};
use super::*;
use crate::scene::mesh::Bounds;
use crate::scene::model::Model;
use crate::scene::shapes;

/// A cube of edge 1 as a model.
fn cube() -> Arc<Model> {
    let mesh = shapes::mesh(Shape::Cube);
    let positions: Vec<u8> = mesh.vertices.iter().flat_map(|v| v.position).flat_map(f32::to_le_bytes).collect();
    let indices: Vec<u8> = mesh.indices.iter().flat_map(|i| i.to_le_bytes()).collect();
    let (at, bytes) = (positions.len(), [positions, indices].concat());
    let text = base64::engine::general_purpose::STANDARD.encode(&bytes);
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":{},"type":"VEC3","min":[-0.5,-0.5,-0.5],"max":[0.5,0.5,0.5]}},
        {{"bufferView":1,"componentType":5125,"count":{},"type":"SCALAR"}}],
        "bufferViews":[{{"buffer":0,"byteOffset":0,"byteLength":{at}}},{{"buffer":0,"byteOffset":{at},"byteLength":{}}}],
        "buffers":[{{"byteLength":{},"uri":"data:application/octet-stream;base64,{text}"}}]}}"#,
        mesh.vertices.len(),
        mesh.indices.len(),
        bytes.len() - at,
        bytes.len(),
    );
    Arc::new(Model::parse(json.as_bytes()).unwrap())
}

pub(super) fn block(center: Vec3, half: Vec3) -> Solid {
    Solid::Block { center, half }
}

/// A scene with real blocks, and the model that they are made of.
pub(super) fn scene(objects: &[Solid], real: &[(Solid, bool)]) -> (Scene, crate::render::Models) {
    let id = AssetId::of(b"cube");
    let mesh = |(solid, casts_shadows): &(Solid, bool)| {
        let Solid::Block { center, half } = *solid else { panic!("the place is of blocks here") };
        let transform = Transform { position: center, rotation: Quat::IDENTITY, scale: half * 2.0 };
        PlaceMesh { model: id, transform, casts_shadows: *casts_shadows, gloss: Gloss::MATT }
    };
    let objects = (1..).zip(objects).map(|(id, solid)| solid.object(id)).collect();
    let scene = Scene { ground_y: GROUND_Y, objects, place: real.iter().map(mesh).collect(), ..Scene::default() };
    (scene, HashMap::from([(id, cube())]))
}

#[test]
fn the_place_hides_what_is_behind_it_and_is_itself_not_seen() {
    let gpu = Gpu::headless().unwrap();
    let eye = Eye::at(Vec3::new(0.0, 0.5, 0.0), Vec3::new(0.0, -1.0, -6.0), 0.7, (160, 120));
    let ball = Solid::Ball { center: Vec3::new(0.0, -1.0, -6.0), radius: 0.3 };
    let (wall, inner) =
        (block(Vec3::new(0.3, -1.0, -2.5), Vec3::new(0.3, 0.8, 0.05)), block(Vec3::new(0.3, -1.0, -2.5), Vec3::new(0.28, 0.78, 0.05)));
    let sun = light(towards(180.0, 60.0), 6.8e-5, Vec3::ONE, 1);
    let draw = |objects: &[Solid], real: &[(Solid, bool)]| {
        let (scene, assets) = scene(objects, real);
        eye.draw_scene(&gpu, &scene, &assets, vec![sun])
    };
    let (empty, free, behind) = (draw(&[], &[]), draw(&[ball], &[]), draw(&[ball], &[(wall, true)]));
    assert_eq!(empty, draw(&[], &[(wall, true)]));
    let (mut hidden, mut shown) = (0, 0);
    for pixel in 0..empty.len() {
        let ray = eye.ray(pixel);
        if inner.meets(eye.camera.position, ray) {
            assert_eq!(behind[pixel], empty[pixel], "the wall shows at {pixel}");
            hidden += usize::from(free[pixel] != empty[pixel]);
        } else if !wall.meets(eye.camera.position, ray) && ball.meets(eye.camera.position, ray) {
            shown += usize::from((behind[pixel] - free[pixel]).abs().max_element() < 1e-3);
        }
    }
    assert!(hidden > 50 && shown > 50, "{hidden} pixels of the ball hidden, {shown} shown");
}

#[test]
fn no_light_is_taken_twice() {
    let gpu = Gpu::headless().unwrap();
    let eye = Eye::at(Vec3::new(1.2, 1.5, -1.5), Vec3::new(0.6, GROUND_Y, -4.0), 0.8, (200, 150));
    let sun = light(towards(-90.0, 40.0), 0.002, Vec3::ONE * 4.0, 1);
    // The wall's shadow falls over the half beyond z = −4, the ball's over both halves.
    let wall = block(Vec3::new(-1.0, GROUND_Y + 1.0, -5.5), Vec3::new(0.05, 1.0, 1.5));
    let ball = Solid::Ball { center: Vec3::new(0.0, GROUND_Y + 0.7, -4.0), radius: 0.35 };
    let sunk = Solid::Ball { center: Vec3::new(-0.4, GROUND_Y + 0.2, -5.2), radius: 0.15 };
    let (with, assets) = scene(&[ball, sunk], &[(wall, true)]);
    let drawn = eye.draw_scene(&gpu, &with, &assets, vec![sun]);
    let (mut kept, mut dark, mut lit) = (0, 0, 0);
    for (pixel, point) in eye.ground(&[ball, sunk, wall]).iter().enumerate() {
        let Some(point) = point else { continue };
        let (real, both) = (seen_of_light(*point, &sun, &[wall], RAYS / 8), seen_of_light(*point, &sun, &[ball], RAYS / 8));
        let share = drawn[pixel].x / 0.5;
        if real == 0.0 && both == 0.0 {
            // Dark already: there was no light to take.
            kept += usize::from(share == 1.0);
            dark += usize::from(share != 1.0);
        } else if real == 1.0 && both == 0.0 {
            lit += usize::from(share < 0.02);
        }
    }
    println!("{kept} pixels dark already and kept, {dark} darkened twice, {lit} darkened once");
    // Their rims differ by a texel of either map.
    assert!(kept > 100 && lit > 100 && dark * 20 < kept, "{kept} kept, {dark} darkened twice, {lit} darkened once");
    // A virtual object in the real shadow gets none of the light.
    let inner = Solid::Ball { center: Vec3::new(-0.4, GROUND_Y + 0.2, -5.2), radius: 0.12 };
    let meets = |solid: Solid, pixel: usize| solid.meets(eye.camera.position, eye.ray(pixel));
    let seen: Vec<_> = (0..drawn.len()).filter(|pixel| meets(inner, *pixel) && !meets(ball, *pixel)).collect();
    let most = |picture: &[Vec3]| seen.iter().map(|pixel| picture[*pixel].x).fold(0.0, f32::max);
    let (alone, _) = scene(&[ball, sunk], &[]);
    let (brightest, in_the_open) = (most(&drawn), most(&eye.draw_scene(&gpu, &alone, &assets, vec![sun])));
    println!("the ball in the wall's shadow: {brightest}, in the open {in_the_open}");
    assert!(seen.len() > 20 && brightest < 0.02 * in_the_open, "{brightest} of {in_the_open}");
}

#[test]
fn what_is_far_above_leaves_its_penumbra() {
    let gpu = Gpu::headless().unwrap();
    let center = Vec3::new(0.0, GROUND_Y + 0.5, -4.0);
    let (ball, inner) = (Solid::Ball { center, radius: 0.1 }, Solid::Ball { center, radius: 0.08 });
    let eye = Eye::at(Vec3::new(0.0, 1.0, -3.0), center, 0.3, (64, 48));
    let sun = light(Vec3::Y, 0.05, Vec3::ONE * 4.0, 1);
    // A roof over all that lies to the left of an edge, which is farther away than what a ball as small as this changes.
    for (height, edge) in [(12.0, -1.0), (30.0, -1.0), (30.0, 1.0), (30.0, -2.0)] {
        let roof = block(Vec3::new(edge - 20.0, GROUND_Y + height, -4.0), Vec3::new(20.0, 0.05, 20.0));
        let brightness = |casts| {
            let (scene, assets) = scene(&[ball], &[(roof, casts)]);
            let drawn = eye.draw_scene(&gpu, &scene, &assets, vec![sun]);
            let on_ball = (0..drawn.len()).filter(|pixel| inner.meets(eye.camera.position, eye.ray(*pixel)));
            on_ball.map(|pixel| drawn[pixel].x).sum::<f32>()
        };
        let share = brightness(true) / brightness(false);
        let truth = seen_of_light(center + Vec3::Y * 0.1, &sun, &[roof], RAYS);
        println!("roof {height} m above, edge at {edge} m: {share} of the light, truth {truth}");
        // Taps of the filter are of a 48th each, and the ball is as wide as a twentieth of the penumbra.
        assert!((share - truth).abs() < 0.06 && truth > 0.05 && truth < 0.95, "{height} m, {edge} m: {share}, truth {truth}");
    }
}

#[test]
fn what_is_far_above_leaves_low_shadows_fine() {
    let gpu = Gpu::headless().unwrap();
    let eye = Eye::at(Vec3::new(0.3, 0.2, -2.2), Vec3::new(0.3, GROUND_Y + 0.2, -4.0), 0.6, (120, 90));
    let sun = light(Vec3::Y, 0.7, Vec3::ONE * 4.0, 1);
    let table = block(Vec3::new(0.3, GROUND_Y + 0.2, -4.0), Vec3::new(0.5, 0.02, 0.4));
    // Half beneath the table.
    let ball = Solid::Ball { center: Vec3::new(0.3, GROUND_Y + 0.08, -3.6), radius: 0.08 };
    let small = |x: f32| block(Vec3::new(x, GROUND_Y + 30.0, -4.0), Vec3::splat(0.1));
    let roof = block(Vec3::new(-19.0, GROUND_Y + 59.0, -4.0), Vec3::new(20.0, 0.05, 20.0));
    let frustum = |real: &[(Solid, bool)]| {
        let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
        let (scene, assets) = scene(&[ball], real);
        assert!(renderer.set_scene(&gpu, &scene, &|id| assets.get(&id).cloned().map(Ok)).is_empty());
        renderer.stage.place_frustum(&sun)
    };
    let alone = frustum(&[(table, true)]);
    for x in [40.0, 0.3] {
        let with = frustum(&[(table, true), (small(x), true)]);
        assert_eq!(with.texel_m(), alone.texel_m(), "a small thing at {x} m");
    }
    let under_roof = frustum(&[(table, true), (roof, true)]);
    assert!(under_roof.texel_m() > alone.texel_m() && under_roof.texel_m() <= 0.015, "{} m", under_roof.texel_m());
    // The picture: what is aside hides nothing of the light.
    assert_eq!(frustum(&[(table, true), (small(40.0), true)]), alone);
    let draw = |real: &[(Solid, bool)]| {
        let (scene, assets) = scene(&[ball], real);
        eye.draw_scene(&gpu, &scene, &assets, vec![sun])
    };
    let (bare, low, both) = (draw(&[]), draw(&[(table, true)]), draw(&[(table, true), (small(40.0), true)]));
    let worst = |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).map(|(a, b)| (*a - *b).abs().max_element()).fold(0.0, f32::max);
    println!("the table changes up to {}, what is far aside up to {}", worst(&bare, &low), worst(&low, &both));
    // The same maps, to the layer's rounding.
    assert!(worst(&bare, &low) > 0.1 && worst(&low, &both) < 1e-3, "{} against {}", worst(&low, &both), worst(&bare, &low));
}

#[test]
fn a_table_of_the_place_catches_the_shadow() {
    let gpu = Gpu::headless().unwrap();
    let eye = Eye::at(Vec3::new(0.3, 1.2, -2.0), Vec3::new(0.3, -1.0, -4.0), 0.7, (160, 120));
    let sun = light(towards(-90.0, 50.0), 0.002, Vec3::ONE * 4.0, 1);
    let top_y = GROUND_Y + 0.8;
    let table = block(Vec3::new(0.3, top_y - 0.05, -4.0), Vec3::new(0.8, 0.05, 0.6));
    let ball = Solid::Ball { center: Vec3::new(0.0, top_y + 0.4, -4.0), radius: 0.2 };
    for casts in [true, false] {
        let (scene, assets) = scene(&[ball], &[(table, casts)]);
        let drawn = eye.draw_scene(&gpu, &scene, &assets, vec![sun]);
        let (mut wrong, mut shadow) = (0, 0);
        for (pixel, colour) in drawn.iter().enumerate() {
            let ray = eye.ray(pixel);
            let point = eye.camera.position + ray * ((top_y - eye.camera.position.y) / ray.y);
            let on_top = (point.x - 0.3).abs() < 0.78 && (point.z + 4.0).abs() < 0.58;
            if !on_top || ball.meets(eye.camera.position, ray) {
                continue;
            }
            let dark = seen_of_light(point, &sun, &[ball], RAYS / 8) < 0.5;
            shadow += usize::from(dark);
            wrong += usize::from(dark != (colour.x < 0.25));
        }
        println!("table, casting {casts}: {wrong} of {shadow} wrong");
        assert!(shadow > 200 && wrong * 25 < shadow, "casting {casts}: {wrong} of {shadow} wrong");
    }
}

#[test]
fn a_room_all_around_is_drawn_where_objects_change_it() {
    let gpu = Gpu::headless().unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
    let room = block(Vec3::new(0.0, 0.0, 0.0), Vec3::new(4.0, 1.6, 4.0));
    let ball = Solid::Ball { center: Vec3::new(0.5, GROUND_Y + 0.15, -3.0), radius: 0.15 };
    let (scene, assets) = scene(&[ball], &[(room, false)]);
    assert!(renderer.set_scene(&gpu, &scene, &|id| assets.get(&id).cloned().map(Ok)).is_empty());
    let light = FrameLight { lights: vec![light(towards(0.0, 60.0), 0.01, Vec3::ONE, 1)], ..FrameLight::default() };
    let (camera, size) = (Camera::looking(0.0, -0.2, 0.9), (640, 360));
    let part = |mirrors| {
        let place = renderer.stage.changed_place(&light, 1, mirrors);
        touched(&camera, size, &renderer.stage, (None, &place)).unwrap()
    };
    let (width, height) = part(false).size;
    assert!(width < 320 && height < 240, "{width}×{height}");
    assert_eq!(part(true).size, size);
    // The shadow lies within, from the caster to where it falls.
    let changed = renderer.stage.changed_place(&light, 1, false);
    for share in [0.0, 0.3, 0.7, 1.0] {
        let point =
            Vec3::new(0.5, GROUND_Y + 0.15, -3.0).lerp(Vec3::new(0.5, GROUND_Y, -3.0) - Vec3::Z * 0.15 / 60f32.to_radians().tan(), share);
        assert!(changed.iter().any(|part| part.common(&Bounds { min: point, max: point }).is_some()), "{point}: {changed:?}");
    }
}

#[test]
fn a_scene_without_a_place_has_no_maps_of_one() {
    let gpu = Gpu::headless().unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
    let ball = Solid::Ball { center: Vec3::new(0.0, -1.0, -4.0), radius: 0.3 };
    let wall = block(Vec3::new(0.0, -1.0, -5.0), Vec3::splat(0.5));
    for (real, maps) in [(vec![], 4), (vec![(wall, true)], 8), (vec![(wall, false)], 4), (vec![], 4)] {
        let (scene, assets) = scene(&[ball], &real);
        let warnings = renderer.set_scene(&gpu, &scene, &|id| assets.get(&id).cloned().map(Ok));
        assert_eq!((warnings.len(), renderer.resources.shadow_layers.len()), (0, maps));
        assert_eq!(renderer.place_frusta(0).len(), 0);
    }
    let (scene, _) = scene(&[ball], &[(wall, true)]);
    let warnings = renderer.set_scene(&gpu, &scene, &|_| None);
    assert_eq!(warnings.iter().map(|w| w.element).collect::<Vec<_>>(), [Element::Place(1)]);
    assert!(warnings[0].to_string().starts_with("place 1 is not drawn"), "{}", warnings[0]);
}
