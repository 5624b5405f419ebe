//! What is done at which rate: the light at display rate, reflections with the picture, shadow maps when something changes.

use std::sync::Arc;

use glam::Vec3;
use mr360_protocol::light::{Lift, LightFrame};
use mr360_protocol::scene::{Geometry, Gloss, Material, MaterialKind, Object, PlaceMesh, Scene, Shape, Transform};

use super::tests::{SIZE, ball, camera, diffuse, draw, gradient, mirror, object, panorama, pixel_of, scene, sun};
use super::*;
use crate::governor::Tier;
use crate::render::ambient_light;
use crate::scene::model::Model;

fn slider() -> (Arc<Model>, AssetId) {
    let bytes = crate::scene::test_models::slider().glb();
    (Arc::new(Model::parse(&bytes).unwrap()), AssetId::of(&bytes))
}

#[test]
fn light_between_two_pictures_is_between_theirs_and_reflections_stay_the_picture() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(128, 64, gradient);
    let own = LightFrame { lights: vec![sun(Vec3::new(0.5, 1.0, 0.6), 3.0)], ..ambient_light(&picture) };
    let mut next = LightFrame { lights: vec![sun(Vec3::new(0.3, 1.0, 0.7), 3.5)], ..own.clone() };
    next.sh.iter_mut().for_each(|c| *c *= 1.1);
    let (chalk, mirror_at) = (Vec3::new(-0.6, -1.0, -3.5), Vec3::new(0.6, -1.0, -3.5));
    let balls = scene(vec![object(1, Shape::Sphere, chalk, 1.0, diffuse(0.5)), object(2, Shape::Sphere, mirror_at, 1.0, mirror())]);
    let target = crate::render::target(&gpu, SIZE, wgpu::TextureFormat::Rgba32Float);
    let view = target.create_view(&wgpu::TextureViewDescriptor::default());
    let mut environment = Environment::new(&gpu).unwrap();
    environment.upload(&gpu, &picture).unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba32Float).unwrap();
    assert!(!renderer.has_objects() && renderer.set_scene(&gpu, &balls, &|_| None).is_empty() && renderer.has_objects());
    let mut frame = |change: &mut dyn FnMut(&mut Renderer)| {
        change(&mut renderer);
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let report = renderer.render(&gpu, &mut encoder, &mut environment, &[View { camera: camera(), target: &view, size: SIZE }]);
        gpu.queue.submit([encoder.finish()]);
        let floats = bytemuck::pod_collect_to_vec::<u8, f32>(&gpu.read_texture(&target).unwrap());
        (floats.chunks_exact(4).map(|t| Vec3::new(t[0], t[1], t[2])).collect::<Vec<_>>(), report)
    };
    let first = frame(&mut |renderer| renderer.set_light(&own)).0;
    assert_eq!(first, draw(&gpu, &picture, &own, &balls, &camera()), "its own light at its instant");
    // On the lit side of the chalk ball, above, towards the camera.
    let lit = [Vec3::new(0.2, 0.42, 0.18), Vec3::new(-0.1, 0.45, 0.2), Vec3::new(0.1, 0.1, 0.48)].map(|d| pixel_of(&camera(), chalk + d));
    // Mirrors the sky, and nothing of the chalk ball or the ground.
    let mirrored = pixel_of(&camera(), mirror_at + Vec3::new(0.28, 0.25, 0.33));
    let end = draw(&gpu, &picture, &next, &balls, &camera());
    let mut before = first.clone();
    for weight in [0.25, 0.5, 0.75, 1.0] {
        let between = frame(&mut |renderer| renderer.relight(&own.blend(&next, weight))).0;
        for at in lit {
            let share = (between[at].x - first[at].x) / (end[at].x - first[at].x);
            // Nearly linear: the light turns by 11°.
            assert!(between[at].x > before[at].x && (share - weight).abs() < 0.05, "{weight}: {share}");
        }
        // All that moves there is the skirt of the sun's highlight.
        assert!((between[mirrored] - first[mirrored]).abs().max_element() < 0.01, "the mirror shows the picture");
        before = between;
    }
    // Times come back one or two frames later: by now no frame of these has made reflections.
    let report = frame(&mut |_| ()).1;
    let names: Vec<_> = report.passes.iter().map(|pass| pass.name).collect();
    assert!(!names.is_empty() && !names.contains(&"reflections"), "{names:?}");
    assert_eq!(frame(&mut |renderer| renderer.set_light(&next)).0, end, "the next one's at its instant");
}

#[test]
fn shadow_maps_are_drawn_when_light_or_scene_change() {
    let gpu = Gpu::headless().unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
    let mut environment = Environment::new(&gpu).unwrap();
    let offscreen = crate::headless::Offscreen::new(&gpu.device, &gpu.queue, 32, 32);
    let target = offscreen.target();
    let light = |east: f32| {
        let lights = vec![sun(Vec3::Y, 2.0), sun(Vec3::new(east, 1.0, 0.0), 1.0)];
        LightFrame { pts_us: 0, published_us: 0, lift: Lift::Linear, sh: vec![Vec3::ONE; 9], lights }
    };
    let mut draws = |change: &mut dyn FnMut(&mut Renderer)| {
        change(&mut renderer);
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let view = View { camera: camera(), target: &target.view, size: (32, 32) };
        let report = renderer.render(&gpu, &mut encoder, &mut environment, &[view]);
        gpu.queue.submit([encoder.finish()]);
        report.draws
    };
    let set = |scene: Scene| {
        let gpu = &gpu;
        move |renderer: &mut Renderer| assert!(renderer.set_scene(gpu, &scene, &|_| None).is_empty())
    };
    draws(&mut |renderer| renderer.set_light(&light(1.0)));
    // The ball, the ground, the composite; and the ball in each map that is drawn.
    assert_eq!(draws(&mut set(ball(diffuse(0.8)))), 3 + 2);
    assert_eq!(draws(&mut |_| ()), 3);
    assert_eq!(draws(&mut |renderer| renderer.relight(&light(1.1))), 3 + 1);
    assert_eq!(draws(&mut |renderer| renderer.set_light(&light(1.1))), 3);
    // A light less and back again: its map still shows the scene.
    assert_eq!(draws(&mut |renderer| renderer.set_light(&LightFrame { lights: vec![sun(Vec3::Y, 2.0)], ..light(1.1) })), 3);
    assert_eq!(draws(&mut |renderer| renderer.set_light(&light(1.1))), 3);
    assert_eq!(draws(&mut set(ball(diffuse(0.7)))), 3 + 2);
    // What moves by itself takes its shadow along, and what stands still leaves it.
    let (model, id) = slider();
    let moving = Object { geometry: Geometry::Model(id), material: None, ..object(1, Shape::Cube, Vec3::NEG_Z * 3.5, 0.3, mirror()) };
    let moving = scene(vec![moving]);
    let set_moving = |renderer: &mut Renderer| assert!(renderer.set_scene(&gpu, &moving, &|_| Some(Ok(Arc::clone(&model)))).is_empty());
    assert_eq!(draws(&mut |renderer| set_moving(renderer)), 3 + 2);
    assert_eq!(draws(&mut |renderer| renderer.set_time(40_000)), 3 + 2);
    assert_eq!(draws(&mut |renderer| renderer.set_time(40_000)), 3);
}

#[test]
fn a_tier_changes_what_objects_cost_and_nothing_else() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(128, 64, gradient);
    let lights = vec![sun(Vec3::new(0.5, 1.0, 0.6), 3.0), sun(Vec3::new(-0.5, 1.0, 0.6), 2.0)];
    let light = LightFrame { lights, ..ambient_light(&picture) };
    let balls = scene(vec![
        object(1, Shape::Sphere, Vec3::new(-0.6, -1.0, -3.5), 1.0, diffuse(0.5)),
        object(2, Shape::Sphere, Vec3::new(0.6, -1.0, -3.5), 1.0, mirror()),
    ]);
    let mut environment = Environment::new(&gpu).unwrap();
    environment.upload(&gpu, &picture).unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8UnormSrgb).unwrap();
    assert!(renderer.set_scene(&gpu, &balls, &|_| None).is_empty());
    let mut offscreen = crate::headless::Offscreen::new(&gpu.device, &gpu.queue, SIZE.0, SIZE.1);
    let mut draw_with = |renderer: &mut Renderer| {
        renderer.set_light(&light);
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let target = offscreen.target();
        let report = renderer.render(&gpu, &mut encoder, &mut environment, &[View { camera: camera(), target: &target.view, size: SIZE }]);
        gpu.queue.submit([encoder.finish()]);
        (offscreen.read().unwrap().to_vec(), report.plan)
    };
    let mut frame = |number: u8| {
        renderer.set_tier(Tier::new(number).unwrap());
        draw_with(&mut renderer)
    };
    let (full, plan) = frame(0);
    assert_eq!((plan.shadows, plan.reflections_every, plan.occlusion, plan.samples), (2, 1, true, 4));
    let (lowest, plan) = frame(Tier::LOWEST.number());
    assert_eq!((plan.shadows, plan.reflections_every, plan.occlusion, plan.samples), (1, 4, false, 1));
    let changed: Vec<usize> =
        full.chunks_exact(4).zip(lowest.chunks_exact(4)).enumerate().filter(|(_, (a, b))| a != b).map(|p| p.0).collect();
    assert_eq!(full, frame(0).0, "and back");
    // What objects change without anything left out: a little over a third of the picture, of which a tenth stays as it is in all tiers. With all left out they change no more, but for
    // pixels at edges, whose middles may lie in what none of four samples meets.
    renderer.set_visible(false);
    let empty = draw_with(&mut renderer).0;
    let by_objects = |drawn: &[u8]| -> Vec<bool> { drawn.chunks_exact(4).zip(empty.chunks_exact(4)).map(|(a, b)| a != b).collect() };
    let (by_full, by_lowest) = (by_objects(&full), by_objects(&lowest));
    let count = |of: &[bool]| of.iter().filter(|changed| **changed).count();
    let beyond = by_lowest.iter().zip(&by_full).filter(|(lowest, full)| **lowest && !**full).count();
    println!("{} of {} pixels change with the tier, {} by objects", changed.len(), full.len() / 4, count(&by_full));
    assert!(
        !changed.is_empty() && count(&by_full) < full.len() / 10 && changed.len() < full.len() / 12 && beyond < 40,
        "{} {} {beyond}",
        count(&by_full),
        count(&by_lowest)
    );
}

#[test]
fn every_pass_of_every_view_has_a_column() {
    let gpu = Gpu::headless().unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8UnormSrgb).unwrap();
    let mut environment = Environment::new(&gpu).unwrap();
    let (moving, id) = slider();
    let glass = Material { kind: MaterialKind::Glass, ..mirror() };
    let objects = vec![
        object(1, Shape::Sphere, Vec3::new(0.0, -1.1, -3.5), 1.0, mirror()),
        object(2, Shape::Sphere, Vec3::new(1.0, -1.1, -3.5), 1.0, glass),
        Object { geometry: Geometry::Model(id), material: None, ..object(3, Shape::Cube, Vec3::new(0.0, 0.0, -6.0), 1.0, mirror()) },
    ];
    let place = vec![PlaceMesh { model: id, transform: Transform::default(), casts_shadows: true, gloss: Gloss::MATT }];
    assert!(
        renderer
            .set_scene(&gpu, &Scene { place, ground: Gloss { roughness: 0.2, reflectance: 0.04 }, ..scene(objects) }, &|_| Some(Ok(
                Arc::clone(&moving)
            )))
            .is_empty()
    );
    let offscreen = crate::headless::Offscreen::new(&gpu.device, &gpu.queue, 32, 32);
    let target = offscreen.target();
    let mut seen = Vec::new();
    for i in 0..4 {
        let light = LightFrame { pts_us: i, published_us: 0, lift: Lift::Linear, sh: vec![Vec3::ONE; 9], lights: vec![sun(Vec3::Y, 2.0)] };
        renderer.set_light(&light);
        renderer.set_time(i);
        let views = std::array::from_fn::<_, MAX_VIEWS, _>(|_| View { camera: camera(), target: &target.view, size: (32, 32) });
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        seen.extend(renderer.render(&gpu, &mut encoder, &mut environment, &views).passes.iter().map(|pass| pass.name));
        gpu.queue.submit([encoder.finish()]);
        gpu.wait().unwrap();
    }
    // All but those of the second light and further ones; names of columns are parted by commas.
    let further = [&SHADOWS[1..], &PLACE_SHADOWS[1..]].concat();
    for name in PASSES.into_iter().filter(|name| !further.contains(name)) {
        assert!(seen.contains(&name) && !name.contains(','), "{name}: {seen:?}");
    }
    assert!(seen.iter().all(|name| PASSES.contains(name)), "{seen:?}");
}
