//! What the picture must show, on small images. They need a Vulkan adapter and fail without one.

use std::collections::HashMap;
use std::f32::consts::PI;

use glam::{Quat, Vec2, Vec3};
use half::f16;
use mr360_protocol::light::{DirectionalLight, Lift, LightFrame};
use mr360_protocol::scene::{Geometry, Gloss, Material, MaterialKind, Object, Scene, Shape, Transform};
use mr360_protocol::video::{Colour, StereoLayout, Transfer};
use mr360_shaders::colour::{rgb_from_yuv, srgb_encode};
use mr360_shaders::equirect::{direction_from_uv, uv_from_direction};

use super::*;
use crate::picture::{Picture, Plane, Samples};
use crate::render::{Still, ambient_light};

pub(super) const SIZE: (u32, u32) = (160, 90);

pub(super) fn panorama(width: u32, height: u32, radiance: impl Fn(Vec3) -> Vec3) -> Picture {
    let texel = |i: u32| {
        let uv = Vec2::new(((i % width) as f32 + 0.5) / width as f32, ((i / width) as f32 + 0.5) / height as f32);
        let [r, g, b] = radiance(direction_from_uv(uv)).to_array().map(f16::from_f32);
        [r, g, b, f16::ONE]
    };
    let texels = (0..width * height).flat_map(texel).collect();
    let samples = Samples::Rgba16F { texels, transfer: Transfer::Linear };
    Picture { pts_us: 0, width, height, stereo: StereoLayout::Mono, samples }
}

pub(super) fn object(id: u32, shape: Shape, position: Vec3, scale: f32, material: Material) -> Object {
    let transform = Transform { position, rotation: Quat::IDENTITY, scale: Vec3::splat(scale) };
    Object { id: ObjectId(id), geometry: Geometry::Shape(shape), transform, material: Some(material), animation: Default::default() }
}

pub(super) fn scene(objects: Vec<Object>) -> Scene {
    Scene { ground_y: -1.6, objects, ..Scene::default() }
}

pub(super) fn ball(material: Material) -> Scene {
    scene(vec![object(1, Shape::Sphere, Vec3::new(0.0, -1.1, -3.5), 1.0, material)])
}

pub(super) fn diffuse(albedo: f32) -> Material {
    Material { base_color: [albedo; 3], ..Material::default() }
}

pub(super) fn mirror() -> Material {
    Material { base_color: [1.0; 3], roughness: 0.0, metallic: 1.0, ..Material::default() }
}

/// Looks down a little, so that ball and ground are both in view.
pub(super) fn camera() -> Camera {
    Camera::looking(0.0, -0.25, 0.9)
}

pub(super) fn draw(gpu: &Gpu, picture: &Picture, light: &LightFrame, scene: &Scene, camera: &Camera) -> Vec<Vec3> {
    let still = Still { gpu, picture, light, scene, assets: &HashMap::new() };
    floats(&still.draw(camera, SIZE, wgpu::TextureFormat::Rgba32Float).unwrap())
}

/// Radiance by pixel, of a target of 32-bit floats.
pub(super) fn floats(bytes: &[u8]) -> Vec<Vec3> {
    bytemuck::pod_collect_to_vec::<u8, f32>(bytes).chunks_exact(4).map(|t| Vec3::new(t[0], t[1], t[2])).collect()
}

pub(super) fn ray_of(camera: &Camera, index: usize) -> Vec3 {
    let (x, y) = (index as u32 % SIZE.0, index as u32 / SIZE.0);
    let ndc = Vec2::new((x as f32 + 0.5) / SIZE.0 as f32 * 2.0 - 1.0, 1.0 - (y as f32 + 0.5) / SIZE.1 as f32 * 2.0);
    camera.ray(ndc, SIZE.0 as f32 / SIZE.1 as f32)
}

/// Index of the pixel that shows a point.
pub(super) fn pixel_of(camera: &Camera, point: Vec3) -> usize {
    let aspect = SIZE.0 as f32 / SIZE.1 as f32;
    let at = (camera.clip_from_view(aspect) * camera.view_from_world()).project_point3(point);
    let (x, y) = ((at.x * 0.5 + 0.5) * SIZE.0 as f32, (0.5 - at.y * 0.5) * SIZE.1 as f32);
    y as usize * SIZE.0 as usize + x as usize
}

fn worst(a: &[Vec3], b: &[Vec3]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (*a - *b).abs().max_element()).fold(0.0, f32::max)
}

pub(super) fn sun(direction: Vec3, irradiance: f32) -> DirectionalLight {
    DirectionalLight { id: 1, direction: direction.normalize(), irradiance: Vec3::splat(irradiance), solid_angle_sr: 6.8e-5 }
}

/// Smooth, with no seam: a direction's own components.
pub(super) fn gradient(d: Vec3) -> Vec3 {
    d * 0.4 + 0.5
}

#[test]
fn background_is_the_panorama() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(512, 256, gradient);
    for yaw_deg in [0.0f32, 90.0, 180.0, 217.0] {
        for pitch_deg in [-90.0f32, 0.0, 40.0] {
            let camera = Camera::looking(yaw_deg.to_radians(), pitch_deg.to_radians(), 1.2);
            let drawn = draw(&gpu, &picture, &ambient_light(&picture), &scene(vec![]), &camera);
            for (i, colour) in drawn.iter().enumerate() {
                // Bilinear filtering of 0.7° texels, in half floats: within 1/255, at the pole too.
                let expected = gradient(ray_of(&camera, i));
                assert!(
                    (*colour - expected).abs().max_element() < 1.0 / 255.0,
                    "yaw {yaw_deg} pitch {pitch_deg} pixel {i}: {colour} {expected}"
                );
            }
        }
    }
}

#[test]
fn the_seam_does_not_show_in_any_layout() {
    let gpu = Gpu::headless().unwrap();
    // 64 texels around: one texel of the seam is many pixels wide.
    let mono = panorama(64, 32, |d| Vec3::splat(0.5 + 0.4 * d.z));
    let Samples::Rgba16F { texels, .. } = &mono.samples else { panic!("made above") };
    let dark: Vec<f16> = texels.chunks_exact(4).flat_map(|_| [f16::ZERO, f16::ZERO, f16::ZERO, f16::ONE]).collect();
    let join = |stereo, right_eye: bool| {
        let (own, other) = (texels, &dark);
        let (first, second) = if right_eye { (other, own) } else { (own, other) };
        let (width, height, texels) = match stereo {
            StereoLayout::TopBottom => (64, 64, [first.as_slice(), second].concat()),
            _ => (128, 32, first.chunks(256).zip(second.chunks(256)).flat_map(|(a, b)| [a, b].concat()).collect()),
        };
        Picture { width, height, stereo, samples: Samples::Rgba16F { texels, transfer: Transfer::Linear }, pts_us: 0 }
    };
    let mut camera = Camera::looking(PI, 0.3, 1.2);
    let expected = draw(&gpu, &mono, &ambient_light(&mono), &scene(vec![]), &camera);
    let jump = expected
        .chunks_exact(SIZE.0 as usize)
        .flat_map(|row| row.windows(2))
        .map(|p| (p[0] - p[1]).abs().max_element())
        .fold(0.0, f32::max);
    // The steepest slope of the cosine is 0.4 a radian; a pixel spans 0.0152 rad.
    assert!(jump < 0.4 * 0.0152 * 2.0, "{jump}");
    for stereo in [StereoLayout::TopBottom, StereoLayout::SideBySide] {
        for right_eye in [false, true] {
            camera.right_eye = right_eye;
            let picture = join(stereo, right_eye);
            let drawn = draw(&gpu, &picture, &ambient_light(&picture), &scene(vec![]), &camera);
            // The sampler's fixed-point weights differ with the texture's size: 1/256 of a texel's step.
            assert!(worst(&drawn, &expected) < 1e-3, "{stereo:?} right {right_eye}: {}", worst(&drawn, &expected));
        }
    }
    // Poles of one eye must not take from the other.
    camera = Camera::looking(0.0, -PI / 2.0, 1.0);
    let picture = join(StereoLayout::TopBottom, false);
    let bottom = draw(&gpu, &picture, &ambient_light(&picture), &scene(vec![]), &camera);
    assert!(bottom.iter().all(|c| c.min_element() > 0.2), "the other eye's black bleeds in");
}

#[test]
fn video_codes_decode_as_on_the_cpu() {
    let gpu = Gpu::headless().unwrap();
    for (bit_depth, transfer) in [(8, Transfer::Bt709), (10, Transfer::Pq), (10, Transfer::Hlg), (8, Transfer::Srgb)] {
        let colour = Colour { bit_depth, transfer, ..Colour::default() };
        let scale = 1u16 << (bit_depth - 8);
        let codes = [150 * scale, 110 * scale, 140 * scale];
        let plane = |code: u16, width: u32, height: u32| {
            let wide = bit_depth > 8;
            let data: Vec<u8> =
                (0..width * height).flat_map(|_| if wide { code.to_le_bytes().to_vec() } else { vec![code as u8] }).collect();
            Plane { width, height, stride: width as usize * if wide { 2 } else { 1 }, data: data.into() }
        };
        let planes = [plane(codes[0], 64, 32), plane(codes[1], 32, 16), plane(codes[2], 32, 16)];
        let picture = Picture { pts_us: 0, width: 64, height: 32, stereo: StereoLayout::Mono, samples: Samples::Yuv { planes, colour } };
        let (matrix, offset) = rgb_from_yuv(colour);
        let yuv = Vec3::from_array(codes.map(f32::from)) / ((1u32 << bit_depth) - 1) as f32;
        let expected = mr360_shaders::colour::decode_transfer(transfer, matrix * (yuv - offset));
        let drawn = draw(&gpu, &picture, &LightFrame { sh: vec![Vec3::ZERO; 9], ..ambient_light(&picture) }, &scene(vec![]), &camera());
        // The GPU's pow is good to about 1e-5 relative; PQ raises to a power of 78.
        assert!((drawn[0] / expected - 1.0).abs().max_element() < 5e-3, "{colour:?}: {} against {expected}", drawn[0]);
    }
}

#[test]
fn a_white_furnace_hides_every_white_surface() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(256, 128, |_| Vec3::ONE);
    let light = ambient_light(&picture);
    for metallic in [0.0, 1.0] {
        for roughness in [0.0, 0.1, 0.3, 0.5, 0.8, 1.0] {
            let material = Material { base_color: [1.0; 3], roughness, metallic, ..Material::default() };
            let drawn = draw(&gpu, &picture, &light, &ball(material), &camera());
            let off = drawn.iter().map(|c| (*c - 1.0).abs().max_element()).fold(0.0, f32::max);
            // Shows no step in an 8-bit picture.
            assert!(off < 1.0 / 255.0, "metallic {metallic} roughness {roughness}: off by {off}");
        }
    }
}

#[test]
fn untouched_pixels_have_the_same_bits_and_removal_restores_all() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(512, 256, |d| gradient(d) + Vec3::splat(0.05 * (40.0 * d.x).sin()));
    let light = LightFrame { lights: vec![sun(Vec3::new(0.5, 1.0, 0.2), 3.0)], ..ambient_light(&picture) };
    let material = Material { roughness: 0.3, ..Material::default() };
    let objects = vec![
        object(1, Shape::Sphere, Vec3::new(0.0, -1.1, -3.5), 1.0, material),
        object(2, Shape::Cube, Vec3::new(-0.9, -1.5, -3.0), 0.5, diffuse(0.5)),
    ];
    for format in [wgpu::TextureFormat::Rgba32Float, wgpu::TextureFormat::Rgba8UnormSrgb, wgpu::TextureFormat::Rgba8Unorm] {
        let empty_scene = scene(vec![]);
        let full_scene = scene(objects.clone());
        let still = |scene| {
            Still { gpu: &gpu, picture: &picture, light: &light, scene, assets: &HashMap::new() }.draw(&camera(), SIZE, format).unwrap()
        };
        let (empty, full) = (still(&empty_scene), still(&full_scene));
        let texel = empty.len() / (SIZE.0 * SIZE.1) as usize;
        let same = empty.chunks_exact(texel).zip(full.chunks_exact(texel)).filter(|(a, b)| a == b).count();
        let share = same as f32 / (SIZE.0 * SIZE.1) as f32;
        assert!((0.3..0.97).contains(&share), "{format:?}: {share} of the pixels have the same bits");
        // Above the horizon and clear of the objects nothing at all may change.
        let top = texel * SIZE.0 as usize * 8;
        assert_eq!(empty[..top], full[..top], "{format:?}");
    }
    // One renderer, objects set and removed again.
    let target = crate::render::target(&gpu, SIZE, wgpu::TextureFormat::Rgba8Unorm);
    let view = target.create_view(&wgpu::TextureViewDescriptor::default());
    let mut environment = Environment::new(&gpu).unwrap();
    environment.upload(&gpu, &picture).unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
    renderer.set_light(&light);
    let mut frame = |change: &mut dyn FnMut(&mut Renderer)| {
        change(&mut renderer);
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        renderer.render(&gpu, &mut encoder, &mut environment, &[View { camera: camera(), target: &view, size: SIZE }]);
        gpu.queue.submit([encoder.finish()]);
        gpu.read_texture(&target).unwrap()
    };
    let set = |objects: &[Object]| {
        let scene = scene(objects.to_vec());
        let gpu = &gpu;
        move |renderer: &mut Renderer| assert!(renderer.set_scene(gpu, &scene, &|_| None).is_empty())
    };
    let (before, with) = (frame(&mut set(&[])), frame(&mut set(&objects)));
    assert_ne!(before, with);
    // Hidden and shown again, without the scene being set again.
    assert_eq!(before, frame(&mut |renderer| renderer.set_visible(false)));
    assert_eq!(with, frame(&mut |renderer| renderer.set_visible(true)));
    assert_eq!(before, frame(&mut set(&[])));
}

#[test]
fn shadow_falls_away_from_the_light_and_light_on_its_side() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(256, 128, |_| Vec3::splat(0.5));
    let ambient = ambient_light(&picture);
    // A ball clear of the ground, so that its shadow lies apart from its contact shade.
    let floating = scene(vec![object(1, Shape::Sphere, Vec3::new(0.0, -0.9, -4.0), 0.6, diffuse(0.8))]);
    for side in [-1.0f32, 1.0] {
        let light = LightFrame { lights: vec![sun(Vec3::new(side, 1.0, 0.0), 4.0)], ..ambient.clone() };
        let drawn = draw(&gpu, &picture, &light, &floating, &camera());
        let at = |point: Vec3| drawn[pixel_of(&camera(), point)].x;
        // The ray through the centre meets the ground 0.7 m to the side. E = π·0.5 + 4·cos 45°.
        let (sky, direct) = (PI * 0.5, 4.0 * std::f32::consts::FRAC_1_SQRT_2);
        let umbra = at(Vec3::new(-side * 0.7, -1.6, -4.0));
        let lit = at(Vec3::new(side * 1.2, -1.6, -4.0));
        // The ball hides at most a tenth of the sky from there, and gives some of it back.
        let expected = 0.5 * sky / (sky + direct);
        assert!(umbra < expected * 1.05 && umbra > expected * 0.85, "{umbra} against {expected}");
        assert!((lit - 0.5).abs() < 0.01, "{lit}");
        // The ball itself: bright towards the light, only the sky on the other side.
        let bright = at(Vec3::new(side * 0.2, -0.7, -3.85));
        let dark = at(Vec3::new(-side * 0.2, -1.05, -3.85));
        assert!(bright > 1.5 * dark, "{bright} against {dark}");
    }
}

#[test]
fn a_mirror_shows_the_panorama_sharply() {
    let gpu = Gpu::headless().unwrap();
    let checks = |d: Vec3| {
        let uv = uv_from_direction(d);
        Vec3::splat(if ((uv.x * 16.0) as i32 + (uv.y * 8.0) as i32) % 2 == 0 { 0.9 } else { 0.1 })
    };
    let picture = panorama(1024, 512, checks);
    let plate = Object {
        transform: Transform { position: Vec3::new(0.0, 0.0, -2.0), rotation: Quat::from_rotation_x(PI / 2.0), scale: Vec3::splat(6.0) },
        ..object(1, Shape::Plane, Vec3::ZERO, 1.0, mirror())
    };
    // All of the panorama is far away.
    let plate = Scene { ground_y: -1e5, ..scene(vec![plate]) };
    let camera = Camera::looking(0.0, 0.0, 0.8);
    let drawn = draw(&gpu, &picture, &ambient_light(&picture), &plate, &camera);
    let wrong = drawn
        .iter()
        .enumerate()
        .filter(|(i, colour)| {
            let ray = ray_of(&camera, *i);
            let expected = checks(Vec3::new(ray.x, ray.y, -ray.z));
            (**colour - expected).abs().max_element() > 0.2
        })
        .count();
    // Only pixels on the edges of the checks, at most two a line and edge, may differ.
    assert!(wrong < drawn.len() / 12, "{wrong} of {} pixels", drawn.len());
}

#[test]
fn diffuse_objects_without_lights_run_two_passes() {
    let gpu = Gpu::headless().unwrap();
    let mut renderer = Renderer::new(&gpu, wgpu::TextureFormat::Rgba8Unorm).unwrap();
    let mut environment = Environment::new(&gpu).unwrap();
    let target = gpu.device.create_texture(&wgpu::TextureDescriptor {
        label: None,
        size: wgpu::Extent3d { width: 32, height: 32, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba8Unorm,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
        view_formats: &[],
    });
    let view = target.create_view(&wgpu::TextureViewDescriptor::default());
    let mut names = |material, ground, lights: Vec<DirectionalLight>| {
        let light = LightFrame { pts_us: 0, published_us: 0, lift: Lift::Linear, sh: vec![Vec3::ONE; 9], lights };
        renderer.set_light(&light);
        renderer.set_scene(&gpu, &Scene { ground, ..ball(material) }, &|_| None);
        let mut seen = std::collections::BTreeSet::new();
        // Times come back one or two frames later, and those of the scene before with them.
        for frame in 0..6 {
            let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            renderer.set_light(&light);
            let report = renderer.render(&gpu, &mut encoder, &mut environment, &[View { camera: camera(), target: &view, size: (32, 32) }]);
            gpu.queue.submit([encoder.finish()]);
            gpu.wait().unwrap();
            if frame >= 2 {
                seen.extend(report.passes.iter().map(|pass| pass.name));
            }
        }
        PASSES.into_iter().filter(|name| seen.contains(name)).collect::<Vec<_>>()
    };
    let matt = Gloss::MATT;
    assert_eq!(names(diffuse(0.8), matt, vec![]), ["objects", "composite"]);
    assert_eq!(names(mirror(), matt, vec![]), ["reflections", "objects", "composite"]);
    let glass = Material { kind: MaterialKind::Glass, ..mirror() };
    assert_eq!(names(glass, matt, vec![]), ["reflections", "objects", "glass", "composite"]);
    assert_eq!(names(diffuse(0.8), matt, vec![sun(Vec3::Y, 2.0)]), ["shadow 1", "objects", "composite"]);
    let wet = Gloss { roughness: 0.2, reflectance: 0.04 };
    assert_eq!(names(diffuse(0.8), wet, vec![]), ["reflections", "mirror", "objects", "composite"]);
    let rough = Gloss { roughness: 1.0, reflectance: 0.04 };
    assert_eq!(names(diffuse(0.8), rough, vec![]), ["objects", "composite"]);
}

#[test]
fn srgb_is_made_by_the_shader_where_the_format_does_not() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(64, 32, |_| Vec3::new(0.2, 0.02, 0.7));
    let light = ambient_light(&picture);
    for format in [wgpu::TextureFormat::Rgba8Unorm, wgpu::TextureFormat::Rgba8UnormSrgb] {
        let still = Still { gpu: &gpu, picture: &picture, light: &light, scene: &scene(vec![]), assets: &HashMap::new() };
        let drawn = still.draw(&camera(), SIZE, format).unwrap();
        for (code, linear) in drawn.iter().zip([0.2f32, 0.02, 0.7]) {
            assert!((f32::from(*code) - srgb_encode(linear) * 255.0).abs() <= 1.0, "{format:?}");
        }
    }
}
