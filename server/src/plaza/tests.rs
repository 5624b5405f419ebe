use glam::{DVec3, Vec2, Vec3};
use mr360_shaders::equirect;

use super::*;

fn small(query: &str) -> Plaza {
    Plaza::new(PlazaConfig::from_query(query).expect("valid query"), |_| {}).expect("valid configuration")
}

fn yuv(plaza: &mut Plaza, index: u64) -> Vec<u8> {
    let pixels = plaza.config().width as usize * plaza.config().height as usize;
    let (mut y, mut u, mut v) = (vec![0; pixels], vec![0; pixels / 4], vec![0; pixels / 4]);
    let stride = plaza.config().width as usize;
    plaza.yuv420(index, &mut y, stride, &mut u, stride / 2, &mut v, stride / 2);
    [y, u, v].concat()
}

fn direction(pixel: usize, width: u32, height: u32) -> Vec3 {
    let (column, row) = (pixel as u32 % width, pixel as u32 / width);
    equirect::direction_from_uv(Vec2::new((column as f32 + 0.5) / width as f32, (row as f32 + 0.5) / height as f32))
}

#[test]
fn a_frame_depends_on_nothing_but_configuration_and_index() {
    let query = "size=256x128&clouds=passing";
    let (mut a, mut b) = (small(query), small(query));
    // 660 is in the middle of the veil's coming.
    let forward: Vec<_> = [0, 7, 660, 661].map(|i| yuv(&mut a, i)).into();
    let mut backward: Vec<_> = [661, 660, 7, 0].map(|i| yuv(&mut b, i)).into();
    backward.reverse();
    assert!(forward == backward);
    assert!(forward[0] != forward[1] && forward[2] != forward[1], "people and light change");
    assert!(yuv(&mut small("size=256x128&clouds=passing&seed=2"), 0) != forward[0]);
}

#[test]
fn progress_rises_to_one() {
    let mut seen = vec![0.0];
    Plaza::new(PlazaConfig { width: 64, height: 32, ..PlazaConfig::default() }, |p| seen.push(p)).expect("valid configuration");
    assert!(seen.windows(2).all(|pair| pair[0] <= pair[1]), "{seen:?}");
    assert!((seen[seen.len() - 1] - 1.0).abs() < 1e-6);
}

#[test]
fn planes_may_be_padded_and_short_slices_are_left_alone() {
    let mut plaza = small("size=64x32");
    let tight = yuv(&mut plaza, 3);
    let (mut y, mut u, mut v) = (vec![9; 80 * 32], vec![9; 48 * 16], vec![9; 40 * 16]);
    plaza.yuv420(3, &mut y, 80, &mut u, 48, &mut v, 40);
    for row in 0..32 {
        assert_eq!(y[row * 80..row * 80 + 64], tight[row * 64..(row + 1) * 64]);
        assert!(y[row * 80 + 64..(row + 1) * 80].iter().all(|b| *b == 9));
    }
    assert_eq!(u[48..80], tight[64 * 32 + 32..64 * 32 + 64]);
    plaza.yuv420(3, &mut y[..10], 80, &mut [], 0, &mut v, 40);
}

/// Irradiance by summing pixel centres: an independent way to the truth's closed forms.
#[test]
fn truth_is_the_integral_of_the_radiance() {
    for query in ["size=1024x512", "size=512x256&sun=50&azimuth=40&clouds=none"] {
        let mut plaza = small(query);
        let (width, height) = (plaza.config().width, plaza.config().height);
        let (radiance, truth) = (plaza.radiance(11), plaza.truth(11));
        for irradiance in &truth.irradiances {
            let normal = Vec3::from(irradiance.normal);
            let mut sum = DVec3::ZERO;
            for (pixel, value) in radiance.iter().enumerate() {
                let facing = normal.dot(direction(pixel, width, height)).max(0.0);
                let solid_angle = equirect::pixel_solid_angle_sr(pixel as u32 / width, width, height);
                sum += Vec3::from(*value).as_dvec3() * f64::from(facing * solid_angle);
            }
            let off = ((sum.as_vec3() - Vec3::from(irradiance.total)) / Vec3::from(irradiance.total)).abs().max_element();
            assert!(off < 0.01, "{query} {normal}: {sum} {:?}", irradiance.total);
        }
    }
}

#[test]
fn the_suns_energy_is_the_same_at_every_size() {
    for query in ["size=64x32", "size=128x64", "size=1024x512", "size=128x64&sun=85"] {
        let mut plaza = small(query);
        let (width, height) = (plaza.config().width, plaza.config().height);
        let sun = plaza.truth(0).sun;
        let energy: Vec3 =
            plaza.still.disc.iter().map(|(pixel, value)| *value * equirect::pixel_solid_angle_sr(pixel / width, width, height)).sum();
        let expected = Vec3::from(sun.irradiance);
        assert!(((energy - expected) / expected).abs().max_element() < 1e-3, "{query}: {energy} {expected}");
        assert_eq!(sun.visible_fraction, 1.0);
        // The brightest pixel is where the sun is, within one pixel.
        let radiance = plaza.radiance(0);
        let brightest = (0..radiance.len()).max_by(|a, b| radiance[*a][1].total_cmp(&radiance[*b][1])).expect("there are pixels");
        let off = direction(brightest, width, height).angle_between(Vec3::from(sun.direction));
        assert!(off < std::f32::consts::PI / height as f32, "{query}: {off}");
    }
}

#[test]
fn a_house_before_the_sun_hides_it() {
    let mut plaza = small("size=128x64&sun=10&azimuth=-8");
    let truth = plaza.truth(0);
    assert_eq!(truth.sun.visible_fraction, 0.0);
    assert_eq!(truth.sun.irradiance, [0.0; 3]);
}

#[test]
fn the_camera_clips_the_sun_and_exposes_the_ground() {
    let mut plaza = small("size=512x256&movers=0");
    let luma = yuv(&mut plaza, 0);
    let at = |d: Vec3| {
        let uv = equirect::uv_from_direction(d.normalize());
        (f32::from(luma[(uv.y * 256.0) as usize * 512 + (uv.x * 512.0) as usize]) - 16.0) / 219.0
    };
    assert_eq!(at(plaza.world.sky.sun), 1.0);
    let ground: Vec<f32> = (-8..8).map(|i| at(Vec3::new(i as f32 * 0.25, -1.6, -3.0))).collect();
    let mean = ground.iter().sum::<f32>() / ground.len() as f32;
    assert!((0.58..0.72).contains(&mean), "{mean}");
    // The centre of the picture, −z, is the town hall's front; the zenith is sky.
    assert!(at(Vec3::Y) > 0.25 && at(Vec3::Y) < 0.7, "{}", at(Vec3::Y));
}

/// Pixels of runs.
fn pixels(runs: &[Run], width: u32) -> impl Iterator<Item = usize> {
    runs.iter().flat_map(move |[row, first, count]| (0..*count).map(move |i| (row * width + first + i) as usize))
}

#[test]
fn masks_are_the_pixels_that_differ_from_the_empty_place() {
    let (mut peopled, mut empty) = (small("size=512x256"), small("size=512x256&movers=0"));
    for index in [0, 45, 400] {
        let (with, without, truth) = (peopled.radiance(index), empty.radiance(index), peopled.truth(index));
        assert_eq!(truth.movers.len(), 5);
        let mut allowed = vec![false; with.len()];
        let (mut body, mut same) = (0, 0);
        for mover in &truth.movers {
            assert!(!mover.shadow_mask.is_empty());
            for pixel in pixels(&mover.shadow_mask, 512) {
                allowed[pixel] = true;
                assert!(with[pixel] != without[pixel], "a shadow pixel that is not darkened");
            }
            for pixel in pixels(&mover.body_mask, 512) {
                allowed[pixel] = true;
                body += 1;
                same += usize::from(with[pixel] == without[pixel]);
            }
        }
        assert!(body > 150 && same == 0, "{same} of {body}");
        assert!((0..with.len()).all(|pixel| allowed[pixel] || with[pixel] == without[pixel]), "a change outside the masks");
    }
}

#[test]
fn shadows_fall_away_from_the_sun() {
    let mut plaza = small("size=1024x512");
    let truth = plaza.truth(20);
    let with = plaza.radiance(20);
    let without = small("size=1024x512&movers=0").radiance(20);
    let sun = Vec3::from(truth.sun.direction);
    let away = -Vec3::new(sun.x, 0.0, sun.z).normalize();
    let length = 1.7 * (1.0 - sun.y * sun.y).sqrt() / sun.y;
    for mover in &truth.movers {
        let (mut sum, mut area) = (0.0, 0.0);
        for pixel in pixels(&mover.shadow_mask, 1024) {
            let d = direction(pixel, 1024, 512);
            if d.y > -0.05 {
                continue;
            }
            let on_ground = d * (truth.ground.y / d.y);
            // Area of the pixel on the ground.
            let weight = equirect::pixel_solid_angle_sr(pixel as u32 / 1024, 1024, 512) * on_ground.length_squared() / -d.y;
            let along = (on_ground - Vec3::from(mover.position)).dot(away);
            assert!(along < length + 1.0 && along > -1.7, "{} reaches {along}", mover.id);
            // By how much the light falls: the mask's rim counts little.
            let weight = weight * (1.0 - with[pixel][1] / without[pixel][1]);
            sum += along * weight;
            area += weight;
        }
        assert!(sum / area > 0.25 * length, "mover {}: {}", mover.id, sum / area);
    }
}

#[test]
fn a_passing_veil_dims_the_sun_and_leaves_the_sky() {
    let mut plaza = small("size=128x64&clouds=passing&fps=10&movers=0");
    let (clear, veiled) = (plaza.truth(0), plaza.truth(300));
    assert_eq!((clear.sun.transmission, veiled.sun.transmission), (1.0, 0.25));
    let up = |t: &PlazaTruth| (Vec3::from(t.irradiances[2].sun).y, Vec3::from(t.irradiances[2].ambient).y);
    assert!((up(&veiled).0 / up(&clear).0 - 0.25).abs() < 1e-4);
    assert!(up(&veiled).1 > 0.7 * up(&clear).1);
}

#[test]
fn truth_is_json_with_the_place_in_it() {
    let mut plaza = small("size=64x32");
    let mut line = Vec::new();
    plaza.write_truth_json(5, &mut line).expect("a vector takes it");
    let json: serde_json::Value = serde_json::from_slice(&line).expect("valid JSON");
    assert_eq!(json["ground"]["y"].as_f64().map(|y| y as f32), Some(-1.6));
    assert!((json["time_secs"].as_f64().expect("a number") - 5.0 / 30.0).abs() < 1e-9);
    let geometry = json["geometry"].as_array().expect("a list");
    assert!(geometry.iter().filter(|g| g["name"] == "building").count() >= 5);
    // The ground in front is free for virtual objects.
    for part in geometry {
        let number = |key: &str, i: usize| part[key][i].as_f64().expect("a number");
        let gap = |i| (number("position", i).abs() - number("size", i) * 0.5).max(0.0);
        let gap = match part["kind"].as_str() {
            Some("sphere") => number("position", 0).hypot(number("position", 2)) - number("size", 0) * 0.5,
            _ => gap(0).hypot(gap(2)),
        };
        assert!(gap > 6.0, "{part}");
    }
}
