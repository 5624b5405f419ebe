//! Objects mirrored in the ground and in meshes of the place, against rays. They need a Vulkan adapter and fail without one.

use std::collections::HashMap;
use std::f32::consts::PI;

use glam::Vec3;
use mr360_protocol::scene::{Geometry, Gloss, Material, Scene};

use super::place_tests::{block, scene as place_scene};
use super::shadow_tests::{Eye, GROUND_Y, Solid, light, towards};
use super::tests::{diffuse, floats, panorama};
use super::*;
use crate::render::{Still, ambient_light};

/// All light comes back.
fn mirror(roughness: f32) -> Gloss {
    Gloss { roughness, reflectance: 1.0 }
}

/// Black things over glossy ground, without ambient light: what is mirrored of them is missing from a panorama of 0.5, and nothing else
/// changes.
fn black(solids: &[Solid], ground: Gloss) -> Scene {
    let mut objects: Vec<_> = (1..).zip(solids).map(|(id, solid)| solid.object(id)).collect();
    objects.iter_mut().for_each(|object| object.material = Some(diffuse(0.0)));
    Scene { ground_y: GROUND_Y, ground, objects, ..Scene::default() }
}

/// Share of a GGX lobe over level ground that meets a solid, by rays through visible normals.
fn covered(point: Vec3, eye: Vec3, roughness: f32, solid: Solid) -> f32 {
    const RAYS: u32 = 4096;
    let (alpha, v) = (roughness * roughness, (eye - point).normalize());
    let (mut met, mut total) = (0.0, 0.0);
    for i in 0..RAYS {
        let quantile = (i as f32 + 0.5) / RAYS as f32;
        let (slope, angle) = (alpha * (quantile / (1.0 - quantile)).sqrt(), i as f32 * PI * (3.0 - 5.0f32.sqrt()));
        let normal = Vec3::new(slope * angle.cos(), 1.0, slope * angle.sin()).normalize();
        let (cosine, ray) = (v.dot(normal), 2.0 * v.dot(normal) * normal - v);
        if cosine > 0.0 && ray.y > 0.0 {
            total += cosine;
            met += if solid.meets(point, ray) { cosine } else { 0.0 };
        }
    }
    met / total
}

#[test]
fn a_polished_floor_shows_objects_upside_down_and_changes_nothing_else() {
    let gpu = Gpu::headless().unwrap();
    let eye = Eye::at(Vec3::new(0.3, 0.4, 0.0), Vec3::new(0.0, -1.2, -4.0), 0.9, (240, 180));
    let solid = Solid::Block { center: Vec3::new(0.1, GROUND_Y + 0.8, -4.0), half: Vec3::new(0.4, 0.3, 0.25) };
    // A lobe is never finer than a milliradian, of which some are kept.
    let (smaller, larger) = (0.92, 1.1);
    let scaled = |factor: f32| match solid {
        Solid::Block { center, half } => Solid::Block { center, half: half * factor },
        other => other,
    };
    let draw = |scene: &Scene| eye.draw_scene(&gpu, scene, &HashMap::new(), vec![]);
    let (empty, drawn) = (draw(&black(&[], mirror(0.0))), draw(&black(&[solid], mirror(0.0))));
    let matt = draw(&black(&[solid], Gloss::MATT));
    let (mut shown, mut same) = (0, 0);
    for (pixel, point) in eye.ground(&[scaled(larger)]).into_iter().enumerate() {
        let Some(point) = point else { continue };
        let ray = eye.ray(pixel);
        let up = Vec3::new(ray.x, -ray.y, ray.z);
        if scaled(smaller).meets(point, up) {
            assert!(drawn[pixel].max_element() < 0.02, "{point}: {}", drawn[pixel]);
            shown += 1;
        } else if !scaled(larger).meets(point, up) {
            assert_eq!(drawn[pixel], empty[pixel], "{point}");
            same += 1;
        }
        assert_eq!(matt[pixel], empty[pixel]);
    }
    assert!(shown > 500 && same > 5_000, "{shown} shown, {same} as they were");
}

#[test]
fn a_rough_floor_blurs_by_distance_as_its_lobe_does() {
    let gpu = Gpu::headless().unwrap();
    // Standing on the floor, and above it.
    for (roughness, height) in [(0.15, 0.0), (0.15, 0.8), (0.3, 0.0), (0.3, 0.8), (0.5, 0.3)] {
        let eye = Eye::at(Vec3::new(0.0, 0.2, 0.0), Vec3::new(0.0, GROUND_Y, -3.2), 0.8, (160, 120));
        let solid = Solid::Block { center: Vec3::new(0.0, GROUND_Y + height + 0.25, -4.0), half: Vec3::new(0.35, 0.25, 0.25) };
        let drawn = eye.draw_scene(&gpu, &black(&[solid], mirror(roughness)), &HashMap::new(), vec![]);
        let full = drawn.iter().map(|c| c.x).fold(0.0, f32::max);
        let (mut sum, mut worst, mut count, mut most) = (0.0, 0.0f32, 0, 0.0f32);
        // Clear of pixels that the block itself covers in part.
        let Solid::Block { center, half } = solid else { panic!("made above") };
        let clear = Solid::Block { center, half: half + 0.02 };
        for (pixel, point) in eye.ground(&[clear]).into_iter().enumerate().step_by(7) {
            let Some(point) = point else { continue };
            let truth = covered(point, eye.camera.position, roughness, solid);
            let share = 1.0 - drawn[pixel].x / full;
            sum += (share - truth).abs();
            worst = worst.max((share - truth).abs());
            most = most.max(truth);
            count += 1;
        }
        let mean = sum / count as f32;
        println!("roughness {roughness}, {height} m above: mean {mean:.4}, worst {worst:.3}, most covered {most:.2}, {count} pixels");
        // The image knows the near sides alone, and one distance stands for all of a lobe.
        assert!(full > 0.49 && most > 0.5 && mean < 0.02 && worst < 0.25, "roughness {roughness}, {height} m: {mean} {worst}");
    }
}

#[test]
fn a_glossy_table_mirrors_the_balls_on_it() {
    let gpu = Gpu::headless().unwrap();
    let eye = Eye::at(Vec3::new(0.0, 0.6, -1.0), Vec3::new(0.0, -0.7, -3.0), 0.8, (200, 150));
    let top_y = GROUND_Y + 0.8;
    let table = block(Vec3::new(0.0, top_y - 0.05, -3.0), Vec3::new(1.2, 0.05, 1.2));
    let ball = Solid::Ball { center: Vec3::new(0.0, top_y + 0.35, -3.2), radius: 0.2 };
    let draw = |gloss: Gloss, objects: &[Solid]| {
        let (mut scene, assets) = place_scene(objects, &[(table, true)]);
        scene.place[0].gloss = gloss;
        scene.objects.iter_mut().for_each(|object| object.material = Some(diffuse(0.0)));
        eye.draw_scene(&gpu, &scene, &assets, vec![])
    };
    let (empty, matt) = (draw(mirror(0.05), &[]), draw(Gloss::MATT, &[ball]));
    let drawn = draw(mirror(0.05), &[ball]);
    let (mut shown, mut same) = (0, 0);
    for pixel in 0..drawn.len() {
        let ray = eye.ray(pixel);
        let distance = (top_y - eye.camera.position.y) / ray.y;
        let point = eye.camera.position + ray * distance;
        let on_top = distance > 0.0 && point.x.abs() < 1.15 && (point.z + 3.0).abs() < 1.15;
        let scaled = |factor: f32| Solid::Ball { center: Vec3::new(0.0, top_y + 0.35, -3.2), radius: 0.2 * factor };
        if !on_top || scaled(1.1).meets(eye.camera.position, ray) {
            continue;
        }
        let up = Vec3::new(ray.x, -ray.y, ray.z);
        if scaled(0.9).meets(point, up) {
            // A black ball sends back a twelfth of the sky, which is black here too.
            assert!(drawn[pixel].x < 0.05, "{point}: {}", drawn[pixel]);
            shown += 1;
        } else if !scaled(1.2).meets(point, up) {
            assert_eq!(drawn[pixel], empty[pixel], "{point}");
            same += 1;
        }
        assert_eq!(matt[pixel], empty[pixel]);
    }
    assert!(shown > 300 && same > 3_000, "{shown} shown, {same} as they were");
}

#[test]
fn a_table_mirrors_a_lit_ball_in_its_colour() {
    let gpu = Gpu::headless().unwrap();
    let eye = Eye::at(Vec3::new(0.0, 0.6, -1.0), Vec3::new(0.0, -0.7, -3.0), 0.8, (200, 150));
    let top_y = GROUND_Y + 0.8;
    let table = block(Vec3::new(0.0, top_y - 0.05, -3.0), Vec3::new(1.2, 0.05, 1.2));
    let ball = Solid::Ball { center: Vec3::new(0.0, top_y + 0.35, -3.2), radius: 0.2 };
    let (mut scene, assets) = place_scene(&[ball], &[(table, true)]);
    scene.place[0].gloss = mirror(0.05);
    let red = Material { base_color: [0.8, 0.1, 0.1], ..Material::default() };
    scene.objects.iter_mut().for_each(|object| object.material = Some(red));
    // Light from the table's side falls on the side that the table sees.
    let drawn = eye.draw_scene(&gpu, &scene, &assets, vec![light(towards(0.0, -60.0), 0.01, Vec3::ONE * 2.0, 1)]);
    let up = |pixel: usize| eye.ray(pixel) * Vec3::new(1.0, -1.0, 1.0);
    let point = |pixel: usize| eye.camera.position + eye.ray(pixel) * ((top_y - eye.camera.position.y) / eye.ray(pixel).y);
    let inner = Solid::Ball { center: Vec3::new(0.0, top_y + 0.35, -3.2), radius: 0.1 };
    let seen: Vec<Vec3> = (0..drawn.len())
        .filter(|pixel| {
            eye.ray(*pixel).y < -0.1 && inner.meets(point(*pixel), up(*pixel)) && !ball.meets(eye.camera.position, eye.ray(*pixel))
        })
        .map(|pixel| drawn[pixel])
        .collect();
    assert!(seen.len() > 50 && seen.iter().all(|c| c.x > 3.0 * c.y && c.x > 0.1), "{seen:?}");
}

#[test]
fn objects_hide_the_sky_from_a_table_as_their_form_factor_says() {
    let gpu = Gpu::headless().unwrap();
    let top_y = GROUND_Y + 0.8;
    let table = block(Vec3::new(0.0, top_y - 0.05, -3.0), Vec3::new(1.5, 0.05, 1.5));
    // From the side, beneath what floats there.
    let eye = Eye::at(Vec3::new(0.0, top_y + 0.25, -1.0), Vec3::new(0.0, top_y, -3.0), 0.5, (160, 120));
    let picture = panorama(16, 8, |_| Vec3::splat(0.5));
    let ambient = ambient_light(&picture);
    for (solid, tolerance) in [
        (Solid::Ball { center: Vec3::new(0.0, top_y + 0.7, -3.0), radius: 0.3 }, 0.03),
        // A mesh, stood for by spheres.
        (Solid::Block { center: Vec3::new(0.0, top_y + 0.7, -3.0), half: Vec3::splat(0.25) }, 0.06),
    ] {
        let (mut scene, assets) = place_scene(&[solid], &[(table, true)]);
        let model = scene.place[0].model;
        for object in &mut scene.objects {
            object.material = Some(diffuse(0.0));
            if matches!(solid, Solid::Block { .. }) {
                object.geometry = Geometry::Model(model);
            }
        }
        let still = Still { gpu: &gpu, picture: &picture, light: &ambient, scene: &scene, assets: &assets };
        let drawn = floats(&still.draw(&eye.camera, (160, 120), wgpu::TextureFormat::Rgba32Float).unwrap());
        for x in [0.0, 0.3, 0.6] {
            let point = Vec3::new(x, top_y, -3.0);
            let share = drawn[eye.pixel(point)].x / 0.5;
            // It mirrors a twelfth of the light that it hides, half of which comes from above.
            let expected = 1.0 - form_factor(point, solid) * (1.0 - 0.086 * 0.5);
            println!("{x}: {share} against {expected}");
            assert!((share - expected).abs() < tolerance, "{solid:?} {x}: {share} against {expected}");
        }
    }
}

/// Share of the cosine-weighted hemisphere over a level point that a solid hides, by rays.
fn form_factor(point: Vec3, solid: Solid) -> f32 {
    const RAYS: u32 = 4096;
    let met = (0..RAYS).filter(|i| {
        let (r2, angle) = ((*i as f32 + 0.5) / RAYS as f32, *i as f32 * PI * (3.0 - 5.0f32.sqrt()));
        solid.meets(point, Vec3::new(r2.sqrt() * angle.cos(), (1.0 - r2).sqrt(), r2.sqrt() * angle.sin()))
    });
    met.count() as f32 / RAYS as f32
}
