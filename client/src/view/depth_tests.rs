//! A headset's views: edges that lie where they like, two eyes, and their depth.

use glam::{Vec2, Vec3};
use mr360_protocol::scene::{Material, MaterialKind, Shape};

use super::tests::{SIZE, diffuse, draw, gradient, mirror, object, panorama, scene, sun};
use super::{DEPTH_FORMAT, Parallax, Renderer, View};
use crate::camera::{Camera, Edges, FieldOfView};
use crate::environment::Environment;
use crate::governor::Tier;
use crate::gpu::Gpu;
use crate::render::ambient_light;

/// The part of a picture of this size from one pixel to another, as edges of its own.
fn part(whole: Edges, size: (u32, u32), from: (u32, u32), to: (u32, u32)) -> Edges {
    let across = |x: u32| whole.left + (whole.right - whole.left) * x as f32 / size.0 as f32;
    let down = |y: u32| whole.up - (whole.up - whole.down) * y as f32 / size.1 as f32;
    Edges { left: across(from.0), right: across(to.0), down: down(to.1), up: down(from.1) }
}

#[test]
fn a_lopsided_view_is_a_part_of_a_wider_one() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(256, 128, gradient);
    let mut light = ambient_light(&picture);
    light.lights.push(sun(Vec3::new(0.5, 1.0, 0.3), 1.5));
    let glass = Material { kind: MaterialKind::Glass, ..mirror() };
    let objects = [(-0.9, diffuse(0.7)), (0.0, mirror()), (0.9, glass)];
    let objects =
        objects.into_iter().zip(1..).map(|((x, material), id)| object(id, Shape::Sphere, Vec3::new(x, -1.1, -3.0), 0.8, material));
    let scene = scene(objects.collect());
    // A part of as many pixels, so that the wider picture has four for each of its: their mean is what it should show.
    let narrow =
        Camera { fov: FieldOfView::Edges(Edges { left: -0.9, right: 0.5, down: -0.8, up: 0.2 }), ..Camera::looking(0.0, -0.1, 1.0) };
    let drawn = draw(&gpu, &picture, &light, &scene, &narrow);
    let (half_width, half_height) = (SIZE.0 / 2, SIZE.1 / 2);
    let mut off = Vec::new();
    for (column, row) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let from = (column * half_width, row * half_height);
        let edges = part(narrow.edges(1.0), SIZE, from, (from.0 + half_width, from.1 + half_height));
        let quarter = draw(&gpu, &picture, &light, &scene, &Camera { fov: FieldOfView::Edges(edges), ..narrow });
        for y in 0..half_height {
            for x in 0..half_width {
                let finer = |dx, dy| quarter[((2 * y + dy) * SIZE.0 + 2 * x + dx) as usize];
                let mean = (finer(0, 0) + finer(1, 0) + finer(0, 1) + finer(1, 1)) / 4.0;
                off.push((mean - drawn[((from.1 + y) * SIZE.0 + from.0 + x) as usize]).abs().max_element());
            }
        }
    }
    off.sort_by(f32::total_cmp);
    let (median, most) = (off[off.len() / 2], off[off.len() * 97 / 100]);
    // Outlines are averaged over other samples, and footprints are half as wide: the glass ball's above all.
    assert!(median < 1e-3 && most < 0.06, "median {median}, 97 % {most}");
}

#[test]
fn depth_is_that_of_the_nearest_surface_and_the_panorama_is_infinitely_far() {
    let gpu = Gpu::headless().unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8UnormSrgb).unwrap();
    let mut environment = Environment::new(&gpu).unwrap();
    let make = |format, usage| {
        gpu.device.create_texture(&wgpu::TextureDescriptor {
            label: None,
            size: wgpu::Extent3d { width: 64, height: 64, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage: usage | wgpu::TextureUsages::RENDER_ATTACHMENT,
            view_formats: &[],
        })
    };
    let colour = make(wgpu::TextureFormat::Rgba8UnormSrgb, wgpu::TextureUsages::empty());
    let depths = [0, 1].map(|_| make(DEPTH_FORMAT, wgpu::TextureUsages::COPY_SRC));
    let view_of = |texture: &wgpu::Texture| texture.create_view(&wgpu::TextureViewDescriptor::default());
    let (colour, targets) = (view_of(&colour), depths.each_ref().map(view_of));
    // The left eye sees a cube whose front is 2 m ahead; the right one looks away.
    let eye = Edges { left: -0.9, right: 0.4, down: -0.5, up: 0.8 };
    let cameras = [0.0, 3.0].map(|yaw| Camera { fov: FieldOfView::Edges(eye), ..Camera::looking(yaw, 0.0, 1.0) });
    let glass = Material { kind: MaterialKind::Glass, ..mirror() };
    for (material, tier) in [(diffuse(0.5), Tier::FULL), (diffuse(0.5), Tier::LOWEST), (glass, Tier::FULL)] {
        let cube = object(1, Shape::Cube, Vec3::new(0.0, 0.0, -2.5), 1.0, material);
        renderer.set_scene(&gpu, &scene(vec![cube]), &|_| None);
        renderer.set_tier(tier);
        renderer.set_keeps_depth(true);
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let views = cameras.map(|camera| View { camera, target: &colour, size: (64, 64) });
        renderer.render(&gpu, &mut encoder, &mut environment, &views);
        renderer.write_depth(&gpu, &mut encoder, &targets.each_ref()).unwrap();
        gpu.queue.submit([encoder.finish()]);
        let [seen, away] = depths.each_ref().map(|depth| bytemuck::pod_collect_to_vec::<u8, f32>(&gpu.read_texture(depth).unwrap()));
        // On the axis, and where the panorama is seen beside the cube.
        let at = |x: f32, y: f32| {
            let unit = (Vec2::new(x, y) - Vec2::new(eye.left, eye.down)) / (2.0 * eye.half());
            seen[((1.0 - unit.y) * 64.0) as usize * 64 + (unit.x * 64.0) as usize]
        };
        assert!((at(0.0, 0.0) - Camera::NEAR_M / 2.0).abs() < 1e-5, "{material:?} {tier}: {}", at(0.0, 0.0));
        assert!((at(0.2, -0.2) - Camera::NEAR_M / 2.0).abs() < 1e-5);
        assert_eq!((at(-0.6, 0.0), at(0.0, 0.6)), (0.0, 0.0));
        assert!(away.iter().all(|depth| *depth == 0.0));
    }
}

#[test]
fn a_background_with_a_distance_has_that_depth() {
    let gpu = Gpu::headless().unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
    let mut environment = Environment::new(&gpu).unwrap();
    let ground_y = -1.6;
    renderer.set_scene(&gpu, &mr360_protocol::scene::Scene { ground_y, ..scene(vec![]) }, &|_| None);
    renderer.set_keeps_depth(true);
    let size = (16, 16);
    let colour = crate::render::target(&gpu, size, wgpu::TextureFormat::Rgba8Unorm).create_view(&Default::default());
    let depth = crate::render::target(&gpu, size, DEPTH_FORMAT);
    let camera = Camera { position: Vec3::new(0.1, 0.2, 0.0), ..Camera::looking(0.3, -0.2, 1.2) };
    let dome_m = 20.0;
    for parallax in [Parallax::Ground { dome_m }, Parallax::Infinity] {
        renderer.set_parallax(parallax);
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        renderer.render(&gpu, &mut encoder, &mut environment, &[View { camera, target: &colour, size }]);
        renderer.write_depth(&gpu, &mut encoder, &[&depth.create_view(&Default::default())]).unwrap();
        gpu.queue.submit([encoder.finish()]);
        let depths: Vec<f32> = bytemuck::pod_collect_to_vec(&gpu.read_texture(&depth).unwrap());
        for (at, depth) in (0..).zip(depths) {
            let ray = camera.ray(Vec2::new((at % 16) as f32 / 8.0 - 0.9375, 0.9375 - (at / 16) as f32 / 8.0), 1.0);
            let fall = (camera.position.y - ground_y) / -ray.y;
            // To the dome about the origin: |position + ray · t| is its radius.
            let along = camera.position.dot(ray);
            let dome = (along * along + dome_m * dome_m - camera.position.length_squared()).sqrt() - along;
            let way = if ray.y < 0.0 { fall.min(dome) } else { dome };
            let ahead = way * ray.dot(camera.world_from_view * Vec3::NEG_Z);
            let expected = if parallax == Parallax::Infinity { 0.0 } else { Camera::NEAR_M / ahead };
            assert!((depth - expected).abs() <= 1e-4 * expected, "{parallax:?} {at}: {depth} instead of {expected}");
        }
    }
}

#[test]
fn the_eyes_differ_by_the_parallax_of_their_distance() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(64, 32, |_| Vec3::splat(0.1));
    let light = ambient_light(&picture);
    // Dark, and high above the ground that it shades.
    let scene = scene(vec![object(1, Shape::Sphere, Vec3::new(0.0, -0.2, -3.5), 1.0, diffuse(0.1))]);
    let edges = Edges { left: -0.5, right: 0.5, down: -0.4, up: 0.3 };
    let centre = |x: f32| {
        let camera = Camera { position: Vec3::X * x, fov: FieldOfView::Edges(edges), ..Camera::looking(0.0, 0.0, 1.0) };
        let drawn = draw(&gpu, &picture, &light, &scene, &camera);
        let columns: Vec<f32> = (0..).zip(&drawn).filter(|(_, colour)| colour.x < 0.05).map(|(at, _)| (at % SIZE.0) as f32 + 0.5).collect();
        columns.iter().sum::<f32>() / columns.len() as f32
    };
    // Pixels so many to a unit of tangent: each eye sees it shifted by half the distance of the eyes. The outline of a ball of radius r whose
    // middle lies at (x, z) is an ellipse about x·z / (z² − r²).
    let shift = centre(-0.1) - centre(0.1);
    let (away, radius) = (3.5, 0.5);
    let expected = 0.2 * away / (away * away - radius * radius) * SIZE.0 as f32 / (edges.right - edges.left);
    assert!((shift - expected).abs() < 0.1, "{shift} pixels instead of {expected}");
}
