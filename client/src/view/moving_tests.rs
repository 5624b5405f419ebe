//! What is moved looks as if it had been laid out there, and what is only this viewer's touches nobody's light.

use std::collections::HashMap;
use std::f32::consts::FRAC_PI_4;

use glam::{Quat, Vec3};
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{Material, MaterialKind, Object, Scene, Shape, Transform};

use super::tests::{SIZE, camera, diffuse, gradient, mirror, object, panorama, pixel_of, scene, sun};
use super::*;
use crate::hands::looks;
use crate::render::ambient_light;

/// Draws frames of one renderer.
struct Frames {
    gpu: Gpu,
    environment: Environment,
    renderer: Renderer,
    texture: wgpu::Texture,
}

impl Frames {
    fn new() -> Self {
        let gpu = Gpu::headless().unwrap();
        let picture = panorama(128, 64, gradient);
        let mut environment = Environment::new(&gpu).unwrap();
        environment.upload(&gpu, &picture).unwrap();
        let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba32Float).unwrap();
        renderer.set_light(&LightFrame { lights: vec![sun(Vec3::new(0.5, 1.0, 0.6), 3.0)], ..ambient_light(&picture) });
        let texture = crate::render::target(&gpu, SIZE, wgpu::TextureFormat::Rgba32Float);
        Self { gpu, environment, renderer, texture }
    }

    fn set(&mut self, scene: &Scene) {
        let warnings = self.renderer.set_scene(&self.gpu, scene, &|id| looks::model(id).map(Ok));
        assert!(warnings.is_empty(), "{warnings:?}");
    }

    fn draw(&mut self) -> Vec<Vec3> {
        let view = self.texture.create_view(&wgpu::TextureViewDescriptor::default());
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let views = [View { camera: camera(), target: &view, size: SIZE }];
        self.renderer.render(&self.gpu, &mut encoder, &mut self.environment, &views);
        self.gpu.queue.submit([encoder.finish()]);
        let floats = bytemuck::pod_collect_to_vec::<u8, f32>(&self.gpu.read_texture(&self.texture).unwrap());
        floats.chunks_exact(4).map(|t| Vec3::new(t[0], t[1], t[2])).collect()
    }
}

/// A chalk ball, a mirror ball, two cubes of one kind, and a model of several parts.
fn things() -> Scene {
    let drawn = looks::controller(1, &crate::hands::Pose { position: Vec3::ZERO, orientation: Quat::IDENTITY }, 1.0);
    let at = |x: f32, z: f32| Vec3::new(x, -1.1, z);
    let large = Transform { position: at(0.0, -2.5), rotation: Quat::IDENTITY, scale: Vec3::splat(5.0) };
    let model =
        Object { geometry: drawn.geometry, material: None, transform: large, ..object(5, Shape::Cube, Vec3::ZERO, 1.0, diffuse(0.5)) };
    scene(vec![
        object(1, Shape::Sphere, at(-0.8, -3.5), 0.8, diffuse(0.5)),
        object(2, Shape::Sphere, at(0.9, -3.5), 0.8, mirror()),
        object(3, Shape::Cube, at(-1.6, -4.5), 0.7, diffuse(0.7)),
        object(4, Shape::Cube, at(1.6, -4.5), 0.7, diffuse(0.7)),
        model,
    ])
}

#[test]
fn a_thing_that_is_moved_looks_as_if_it_had_been_laid_out_there() {
    let mut frames = Frames::new();
    let before = things();
    let mut after = before.clone();
    let moves: HashMap<u32, Transform> = HashMap::from([1, 4, 5].map(|id| {
        let own = before.object(ObjectId(id)).unwrap().transform;
        let to = own.position + Vec3::new(0.4, 0.5, 0.6 * id as f32 * 0.2);
        (id, Transform { position: to, rotation: Quat::from_rotation_y(FRAC_PI_4) * Quat::from_rotation_x(0.4), ..own })
    }));
    for object in &mut after.objects {
        object.transform = moves.get(&object.id.0).copied().unwrap_or(object.transform);
    }
    frames.set(&after);
    let expected = frames.draw();
    frames.set(&before);
    let still = frames.draw();
    let moved: Vec<_> = moves.iter().map(|(id, transform)| (ObjectId(*id), *transform)).collect();
    assert!(frames.renderer.move_objects(&frames.gpu, &moved));
    let drawn = frames.draw();
    let differs = |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).filter(|(a, b)| (**a - **b).abs().max_element() > 1e-4).count();
    assert!(differs(&drawn, &still) > 500, "nothing moved");
    // Spheres that stand for a thing are turned with it, by a rounding more.
    assert_eq!(differs(&drawn, &expected), 0);
    let (id, _) = frames.renderer.pick(&Ray { origin: Vec3::ZERO, direction: moves[&1].position.normalize() }).unwrap();
    assert_eq!(id, ObjectId(1));
    assert_eq!(frames.renderer.target(ObjectId(4)).unwrap().transform, moves[&4]);
}

#[test]
fn what_depends_on_its_place_is_laid_out_anew() {
    let mut frames = Frames::new();
    let glass = Material { kind: MaterialKind::Glass, roughness: 0.0, ..Material::default() };
    let mut all = things();
    all.objects.push(object(6, Shape::Sphere, Vec3::new(0.0, 0.0, -3.0), 0.5, glass));
    frames.set(&all);
    let own = |id| all.object(ObjectId(id)).unwrap().transform;
    let move_one = |frames: &mut Frames, id, transform| frames.renderer.move_objects(&frames.gpu, &[(ObjectId(id), transform)]);
    assert!(!move_one(&mut frames, 6, own(6)), "glass is sorted");
    assert!(!move_one(&mut frames, 1, Transform { scale: Vec3::splat(2.0), ..own(1) }), "its spheres are others");
    assert!(move_one(&mut frames, 9, own(1)), "what is not drawn has nothing to move");
    assert!(move_one(&mut frames, 1, own(1)));
}

#[test]
fn rays_throw_no_shadow_hide_no_light_and_cannot_be_picked() {
    let mut frames = Frames::new();
    let bare = things();
    frames.set(&bare);
    let without = frames.draw();
    // Among the things, so that the same part of the image is drawn.
    let (begin, length) = (Vec3::new(-0.7, -0.8, -3.0), 1.4);
    let pose = crate::hands::Pose { position: begin, orientation: Quat::from_rotation_y(-std::f32::consts::FRAC_PI_2) };
    let ray = |casts: bool| {
        let mut drawn = looks::ray(&pose, length, 1.0);
        // As thick as two pixels, so that every sample meets it.
        drawn.transform.scale *= Vec3::new(15.0, 1.0, 15.0);
        let local = Object {
            id: local_id(0, casts),
            geometry: drawn.geometry,
            transform: drawn.transform,
            material: None,
            animation: Default::default(),
        };
        Scene { objects: bare.objects.iter().cloned().chain([local]).collect(), ..bare.clone() }
    };
    frames.set(&ray(false));
    let with = frames.draw();
    let line: Vec<usize> = (0..=140).map(|i| pixel_of(&camera(), pose.position + Vec3::X * (i as f32 * 0.01))).collect();
    let near = |i: usize| {
        line.iter()
            .any(|l| (i % SIZE.0 as usize).abs_diff(l % SIZE.0 as usize) <= 2 && (i / SIZE.0 as usize).abs_diff(l / SIZE.0 as usize) <= 2)
    };
    let changed: Vec<usize> = (0..with.len()).filter(|i| with[*i] != without[*i]).collect();
    assert!(changed.len() > 50, "the ray is not seen: {}", changed.len());
    let elsewhere: Vec<_> = changed.iter().filter(|i| !near(**i)).map(|i| (i % SIZE.0 as usize, i / SIZE.0 as usize)).collect();
    // Not even a mirror shows it, nor the ground its shade.
    assert!(elsewhere.is_empty(), "{elsewhere:?} changed, beside the ray");
    let along = Ray { origin: pose.position + Vec3::Z, direction: Vec3::NEG_Z };
    assert_eq!(frames.renderer.pick(&along).map(|(id, _)| id).filter(|id| *id == local_id(0, false)), None);
    // It moves and grows in the layout as it is.
    let longer = Transform { scale: Vec3::new(0.004, 5.0, 0.004), ..Transform::default() };
    assert!(frames.renderer.move_objects(&frames.gpu, &[(local_id(0, false), longer)]));
    frames.set(&ray(true));
    let shadowed = frames.draw();
    assert!(shadowed.iter().zip(&with).filter(|(a, b)| a != b).count() > 20, "a casting one is told from one that does not");
}
