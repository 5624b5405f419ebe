//! Glass against closed forms of a ball and of a pane. They need a Vulkan adapter and fail without one.

use glam::{Quat, Vec3};
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::{Material, MaterialKind, Object, Shape, Transform};
use mr360_shaders::source::{GLASS_DEPTH_M, GLASS_IOR};

use super::reflection_tests::{DISTANCE_M, FOV, SIDE, draw as draw_ball, mirrored};
use super::tests::{SIZE, camera, draw, object, panorama, pixel_of, scene, sun};
use crate::camera::Camera;
use crate::gpu::Gpu;
use crate::render::ambient_light;

fn glass(tint: f32) -> Material {
    Material { base_color: [tint; 3], roughness: 0.0, kind: MaterialKind::Glass, ..Material::default() }
}

/// Unpolarised reflectance by Fresnel's equations in angles (Hecht, Eq. 4.42 and 4.43).
fn fresnel(cosine: f32) -> f32 {
    let (incident, refracted) = (cosine.acos(), (cosine.acos().sin() / GLASS_IOR).asin());
    if incident < 1e-3 {
        return ((GLASS_IOR - 1.0) / (GLASS_IOR + 1.0)).powi(2);
    }
    let across = ((incident - refracted).sin() / (incident + refracted).sin()).powi(2);
    let along = ((incident - refracted).tan() / (incident + refracted).tan()).powi(2);
    0.5 * (across + along)
}

const RADIUS_PX: f32 = 150.0;

/// A glass ball's pixels away from its rim, with what they should show.
fn compare(tint: f32, sky: &dyn Fn(Vec3) -> f32, tolerance: f32) {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(512, 256, |d| Vec3::splat(sky(d)));
    // No light but the picture's own; nothing of the ball is lit by it but through the glass.
    let light = LightFrame { sh: vec![Vec3::ZERO; 9], ..ambient_light(&picture) };
    let drawn = draw_ball(&gpu, &picture, &light, glass(tint), RADIUS_PX);
    let radius_m = RADIUS_PX * 2.0 * DISTANCE_M * (FOV / 2.0).tan() / SIDE as f32;
    let mut compared = 0;
    for (at, (value, seen)) in drawn.iter().zip(mirrored(RADIUS_PX)).enumerate() {
        let Some((n, mirror, n_dot_v)) = seen.filter(|(_, _, n_dot_v)| *n_dot_v > 0.5) else { continue };
        let ray = mirror + 2.0 * n_dot_v * -n;
        // Snell twice: the chord makes the same angle with both ends' normals, so that both turn the ray by as much.
        let refracted = ((1.0 - n_dot_v * n_dot_v).sqrt() / GLASS_IOR).asin();
        let turned = 2.0 * (n_dot_v.acos() - refracted);
        let axis = ray.cross(-n).normalize_or_zero();
        let out = if axis == Vec3::ZERO { ray } else { Quat::from_axis_angle(axis, turned) * ray };
        let passed = tint.powf(2.0 * radius_m * refracted.cos() / GLASS_DEPTH_M);
        let reflected = fresnel(n_dot_v);
        let expected = reflected * sky(mirror) + (1.0 - reflected) * passed * sky(out);
        assert!((value - expected).abs() < tolerance, "pixel {at}, n·v {n_dot_v}: {value} against {expected}");
        compared += 1;
    }
    assert!(compared > 10_000);
}

#[test]
fn black_glass_reflects_by_fresnel() {
    // A mesh of 48 steps around a circle lies up to 0.2 % of its radius within the ball, which tilts the normal that a pixel
    // sees by a third of a degree.
    compare(0.0, &|_| 1.0, 0.003);
}

#[test]
fn clear_glass_is_a_white_furnace() {
    compare(1.0, &|_| 1.0, 1e-3);
}

#[test]
fn tinted_glass_absorbs_along_the_way() {
    // 3.4 m at its thickest: half of the light is left there.
    compare(0.98, &|_| 1.0, 0.01);
}

#[test]
fn a_ball_turns_the_world_upside_down() {
    compare(1.0, &|d| 0.5 + 0.3 * d.x + 0.15 * d.y, 0.03);
}

#[test]
fn light_that_is_reflected_within_is_not_lost() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(128, 64, |_| Vec3::ONE);
    // Rays through one face of a cube meet another beyond the critical angle.
    let turned = Transform {
        position: Vec3::new(0.0, -0.6, -2.0),
        rotation: Quat::from_rotation_y(0.6) * Quat::from_rotation_x(0.3),
        scale: Vec3::ONE,
    };
    let cube = Object { transform: turned, ..object(1, Shape::Cube, Vec3::ZERO, 1.0, glass(1.0)) };
    let drawn = draw(&gpu, &picture, &ambient_light(&picture), &scene(vec![cube]), &camera());
    // The ground below is a little darker, where the cube stands in its light.
    assert!(drawn.iter().all(|c| c.min_element() > 0.5 && c.max_element() < 1.0 + 1e-2), "NaN or lost light");
    let top: Vec<_> = drawn.iter().take(SIZE.0 as usize * SIZE.1 as usize / 3).collect();
    assert!(top.iter().all(|c| (**c - 1.0).abs().max_element() < 1e-2));
}

#[test]
fn glass_shows_what_stands_behind_it() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(128, 64, |_| Vec3::splat(0.2));
    let light = ambient_light(&picture);
    let camera = Camera::looking(0.0, 0.0, 0.9);
    let red = Material { base_color: [0.9, 0.05, 0.05], ..Material::default() };
    let ball = object(1, Shape::Sphere, Vec3::new(0.0, 0.0, -4.0), 1.0, red);
    let transform = Transform { position: Vec3::new(0.0, 0.0, -2.0), rotation: Quat::IDENTITY, scale: Vec3::new(3.0, 3.0, 0.02) };
    let pane = Object { transform, ..object(2, Shape::Cube, Vec3::ZERO, 1.0, glass(1.0)) };
    let without = draw(&gpu, &picture, &light, &scene(vec![ball.clone()]), &camera);
    let with = draw(&gpu, &picture, &light, &scene(vec![ball, pane]), &camera);
    let mut seen = 0;
    for (x, y) in (0..SIZE.0).flat_map(|x| (0..SIZE.1).map(move |y| (x, y))) {
        let from_middle = (x as f32 + 0.5 - SIZE.0 as f32 / 2.0).hypot(y as f32 + 0.5 - SIZE.1 as f32 / 2.0);
        let at = (y * SIZE.0 + x) as usize;
        // The ball is 23 pixels across, the pane 139. It shifts what is behind by less than a pixel.
        if from_middle < 9.0 || (15.0..40.0).contains(&from_middle) {
            let reflected = fresnel(super::tests::ray_of(&camera, at).dot(Vec3::NEG_Z));
            let expected = without[at] * (1.0 - reflected) + 0.2 * reflected;
            // The pane keeps a little of the ambient light from the ball.
            assert!((with[at] - expected).abs().max_element() < 0.02, "({x}, {y}): {} against {expected}", with[at]);
            seen += 1;
        }
    }
    assert!(seen > 1000 && without[(SIZE.1 / 2 * SIZE.0 + SIZE.0 / 2) as usize].y < 0.03);
}

#[test]
fn glass_changes_no_pixel_beside_it_and_casts_no_opaque_shadow() {
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(256, 128, |d| Vec3::splat(0.5 + 0.1 * (20.0 * d.x).sin()));
    let ambient = ambient_light(&picture);
    let light = LightFrame { lights: vec![sun(Vec3::new(1.0, 1.0, 0.0), 4.0)], ..ambient };
    let floating = |material| scene(vec![object(1, Shape::Sphere, Vec3::new(0.0, -0.9, -4.0), 0.6, material)]);
    let empty = draw(&gpu, &picture, &light, &scene(vec![]), &camera());
    let clear = draw(&gpu, &picture, &light, &floating(glass(1.0)), &camera());
    let opaque = draw(&gpu, &picture, &light, &floating(Material::default()), &camera());
    let above = SIZE.0 as usize * 10;
    assert_eq!(empty[..above], clear[..above]);
    let at = pixel_of(&camera(), Vec3::new(-0.7, -1.6, -4.0));
    assert!(opaque[at].x < 0.6 * empty[at].x && clear[at].x > 0.85 * empty[at].x, "{} {} {}", opaque[at], clear[at], empty[at]);
    assert!((empty.len() / 3..empty.len()).contains(&empty.iter().zip(&clear).filter(|(a, b)| a == b).count()));
}
