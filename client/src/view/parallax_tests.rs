//! The background's distance against projections of known points. They need a Vulkan adapter and fail without one.

use std::collections::HashMap;

use glam::{Vec2, Vec3};
use mr360_protocol::scene::{Gloss, Object, Scene, Shape};
use mr360_protocol::video::StereoLayout;

use super::place_tests::{block, scene as place_scene};
use super::shadow_tests::{GROUND_Y, Solid};
use super::tests::{diffuse, floats, gradient, object, panorama, sun};
use super::*;
use crate::picture::{Picture, Samples};
use crate::render::{How, Models, Still, ambient_light};

const SIZE: (u32, u32) = (640, 360);

const GROUND: Parallax = Parallax::Ground { dome_m: 5.0 };

fn draw(gpu: &Gpu, picture: &Picture, scene: &Scene, assets: &Models, camera: &Camera, parallax: Parallax) -> Vec<Vec3> {
    let light = ambient_light(picture);
    let still = Still { gpu, picture, light: &light, scene, assets };
    let how = How { parallax, ..How::default() };
    floats(&still.draw_by(how, camera, SIZE, wgpu::TextureFormat::Rgba32Float).unwrap())
}

/// Where a point is in the picture, pixels.
fn projected(camera: &Camera, point: Vec3) -> Vec2 {
    let aspect = SIZE.0 as f32 / SIZE.1 as f32;
    let at = (camera.clip_from_view(aspect) * camera.view_from_world()).project_point3(point);
    Vec2::new((at.x * 0.5 + 0.5) * SIZE.0 as f32, (0.5 - at.y * 0.5) * SIZE.1 as f32)
}

/// Middle of what differs from a background of 0.5, pixels.
fn centroid(drawn: &[Vec3]) -> Vec2 {
    let (mut sum, mut total) = (Vec2::ZERO, 0.0);
    for (at, colour) in drawn.iter().enumerate() {
        let weight = (0.5 - colour.x).abs();
        sum += weight * Vec2::new((at as u32 % SIZE.0) as f32 + 0.5, (at as u32 / SIZE.0) as f32 + 0.5);
        total += weight;
    }
    sum / total
}

/// Half grey, with a black mark where `marked` says so.
fn marked(mark: impl Fn(Vec3) -> bool) -> Picture {
    panorama(2048, 1024, |d| Vec3::splat(if mark(d) { 0.0 } else { 0.5 }))
}

/// Two eyes 64 mm apart, the left first.
fn eyes(yaw: f32, pitch: f32) -> [Camera; 2] {
    [-0.032, 0.032].map(|aside| {
        let camera = Camera::looking(yaw, pitch, 0.6);
        Camera { position: camera.world_from_view * Vec3::X * aside, ..camera }
    })
}

#[test]
fn an_object_s_foot_and_the_ground_beneath_it_keep_together() {
    let gpu = Gpu::headless().unwrap();
    let foot = Vec3::new(0.2, GROUND_Y, -2.0);
    let on_ground = |d: Vec3| d.y < -0.1 && (d * (GROUND_Y / d.y)).distance(foot) < 0.06;
    let picture = marked(on_ground);
    let even = marked(|_| false);
    let empty = Scene { ground_y: GROUND_Y, ..Scene::default() };
    // A thin black plate in the place of the mark.
    let plate = Solid::Cylinder { center: foot + Vec3::Y * 0.001, radius: 0.06, half_height: 0.001 };
    let mut plate = plate.object(1);
    plate.material = Some(diffuse(0.0));
    let plate = Scene { objects: vec![plate], ..empty.clone() };
    let assets = HashMap::new();
    for camera in eyes(-0.1, -0.65) {
        let mark = centroid(&draw(&gpu, &picture, &empty, &assets, &camera, GROUND));
        let object = centroid(&draw(&gpu, &even, &plate, &assets, &camera, GROUND));
        let expected = projected(&camera, foot);
        println!("eye at {}: ground {mark}, object {object}, projected {expected}", camera.position);
        assert!(mark.distance(expected) < 0.5 && mark.distance(object) < 1.0, "{mark} {object} {expected}");
        // At infinity they part by 32 mm over the distance.
        let far = centroid(&draw(&gpu, &picture, &empty, &assets, &camera, Parallax::Infinity));
        assert!(far.distance(expected) > 5.0, "{far} {expected}");
    }
}

#[test]
fn what_is_no_ground_lies_on_the_dome() {
    let gpu = Gpu::headless().unwrap();
    let towards = Vec3::new(0.3, 0.2, -1.0).normalize();
    let picture = marked(|d| d.dot(towards) > 0.03f32.cos());
    let empty = Scene { ground_y: GROUND_Y, ..Scene::default() };
    for position in [Vec3::new(0.3, 0.0, 0.0), Vec3::new(-0.2, 0.1, 0.3)] {
        let camera = Camera { position, ..Camera::looking(-0.29, 0.19, 0.6) };
        let seen = centroid(&draw(&gpu, &picture, &empty, &HashMap::new(), &camera, GROUND));
        let expected = projected(&camera, towards * 5.0);
        assert!(seen.distance(expected) < 0.5, "{position}: {seen} {expected}");
    }
}

#[test]
fn meshes_of_the_place_are_where_they_are() {
    let gpu = Gpu::headless().unwrap();
    let wall = block(Vec3::new(0.0, -0.4, -2.1), Vec3::new(0.8, 0.6, 0.1));
    let mark = Vec3::new(0.2, -0.3, -2.0);
    let picture = marked(|d| d.z < -0.1 && (d * (-2.0 / d.z)).distance(mark) < 0.06);
    let (scene, assets) = place_scene(&[], &[(wall, true)]);
    for camera in eyes(-0.1, -0.15) {
        let seen = centroid(&draw(&gpu, &picture, &scene, &assets, &camera, GROUND));
        let expected = projected(&camera, mark);
        assert!(seen.distance(expected) < 0.5, "{seen} {expected}");
        let without = Scene { place: vec![], ..scene.clone() };
        let seen = centroid(&draw(&gpu, &picture, &without, &assets, &camera, GROUND));
        assert!(seen.distance(expected) > 3.0, "{seen} {expected}");
    }
}

#[test]
fn at_the_camera_that_filmed_no_setting_changes_a_bit() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(256, 128, gradient);
    let wall = block(Vec3::new(0.5, -0.4, -2.1), Vec3::new(0.3, 0.3, 0.1));
    let ball = Solid::Ball { center: Vec3::new(0.0, -1.0, -3.0), radius: 0.4 };
    let (scene, assets) = place_scene(&[ball], &[(wall, true)]);
    let camera = Camera::looking(0.0, -0.2, 0.9);
    let [a, b] = [GROUND, Parallax::Infinity].map(|parallax| draw(&gpu, &picture, &scene, &assets, &camera, parallax));
    assert_eq!(a, b);
}

#[test]
fn a_stereo_source_keeps_its_own_parallax() {
    let gpu = Gpu::headless().unwrap();
    let Samples::Rgba16F { texels, transfer } = panorama(256, 128, gradient).samples else { panic!("made above") };
    let both = Samples::Rgba16F { texels: [texels.as_slice(), &texels].concat(), transfer };
    let picture = Picture { pts_us: 0, width: 256, height: 256, stereo: StereoLayout::TopBottom, samples: both };
    let empty = Scene { ground_y: GROUND_Y, ..Scene::default() };
    let camera = Camera { position: Vec3::X * 0.3, ..Camera::looking(0.0, -0.4, 0.9) };
    let draw = |parallax| draw(&gpu, &picture, &empty, &HashMap::new(), &camera, parallax);
    assert_eq!(draw(GROUND), draw(Parallax::Infinity));
}

#[test]
fn what_no_object_touched_is_unchanged_at_every_distance() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(512, 256, |d| gradient(d) + Vec3::splat(0.05 * (40.0 * d.x).sin()));
    let wall = block(Vec3::new(0.9, -1.0, -3.0), Vec3::new(0.3, 0.6, 0.3));
    let light = LightFrame { lights: vec![sun(Vec3::new(0.5, 1.0, 0.2), 3.0)], ..ambient_light(&picture) };
    let gloss = Gloss { roughness: 0.3, reflectance: 0.04 };
    let camera = Camera { position: Vec3::new(0.07, 0.05, -0.1), ..Camera::looking(0.0, -0.25, 0.9) };
    for parallax in [Parallax::Infinity, GROUND, Parallax::default()] {
        for real in [&[][..], &[(wall, true)]] {
            let with = |objects: Vec<Object>| {
                let (mut scene, assets) = place_scene(&[], real);
                scene.objects = objects;
                scene.place.iter_mut().for_each(|mesh| mesh.gloss = gloss);
                scene.ground = gloss;
                let still = Still { gpu: &gpu, picture: &picture, light: &light, scene: &scene, assets: &assets };
                let how = How { parallax, ..How::default() };
                floats(&still.draw_by(how, &camera, (160, 90), wgpu::TextureFormat::Rgba32Float).unwrap())
            };
            let ball = |position: Vec3| object(1, Shape::Sphere, position, 0.6, diffuse(0.5));
            let empty = with(vec![]);
            // Behind the eye, its shadow too.
            assert_eq!(with(vec![ball(Vec3::new(0.0, -1.3, 6.0))]), empty, "{parallax:?}");
            let drawn = with(vec![ball(Vec3::new(-0.3, -1.3, -3.5))]);
            let same = empty.iter().zip(&drawn).filter(|(a, b)| a == b).count();
            assert!((4_000..14_200).contains(&same), "{parallax:?}: {same}");
            assert_eq!(empty[..160 * 20], drawn[..160 * 20], "{parallax:?}");
        }
    }
}
