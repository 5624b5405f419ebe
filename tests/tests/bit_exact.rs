//! What no object touched is the panorama, bit for bit, and everything that one touched is not.
//!
//! What is touched is known from geometry alone: what a cube covers, the ground within reach of the sphere that stands for it before
//! the sky, and the ground in its shadow.

use anyhow::{Result, ensure};
use glam::{Quat, Vec2, Vec3};
use mr360_client::camera::Camera;
use mr360_shaders::source::OCCLUDER_REACH;
use mr360_tests::sandbox::Sandbox;

const SIZE: (u32, u32) = (320, 180);
const PITCH_DEG: f32 = -10.0;
const FOV_Y_DEG: f32 = 60.0;
const GROUND_Y: f32 = -1.6;
/// Side of both cubes, metres.
const SIDE: f32 = 0.5;
/// A cube of side s is stood for by one sphere of radius 1.1 · s / 2.
const OCCLUDER_RADIUS: f32 = 1.1 * SIDE / 2.0;
/// One stands on the ground, its shadow within its reach; one floats too high to reach the ground, its shadow by itself.
const CUBES: [(Vec3, f32); 2] = [(Vec3::new(0.6, GROUND_Y + SIDE / 2.0, -4.0), 0.0), (Vec3::new(-0.8, -0.1, -4.0), 30.0)];
const TO_LIGHT: Vec3 = Vec3::new(0.48, 0.8, 0.36);
const SOLID_ANGLE_SR: f32 = 0.001;

/// What geometry says of a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Touch {
    Touched,
    Untouched,
    /// So close to an edge that rounding, or the shadow map's texels, decide.
    Edge,
}

#[test]
fn pixels_that_no_object_touched_are_the_panorama_and_no_others() -> Result<()> {
    let sandbox = Sandbox::new()?;
    panorama().save(sandbox.path("panorama.exr"))?;
    let empty = format!("ground_y = {GROUND_Y:?}\n");
    let cube = |(position, turn): &(Vec3, f32)| {
        let place = format!("position = {:?}\nrotation_deg = [0.0, {turn:?}, 0.0]\nscale = {SIDE:?}", position.to_array());
        format!("[[object]]\nshape = \"cube\"\n{place}\nmaterial = {{ base_color = [0.1, 0.6, 0.2] }}\n")
    };
    let scene = empty.clone() + &CUBES.iter().map(cube).collect::<String>();
    let sh = "[[1,1,1],[0.2,0.2,0.2],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0]]";
    let light =
        format!("\"id\":1,\"direction\":{:?},\"irradiance\":[2.0,1.9,1.7],\"solid_angle_sr\":{SOLID_ANGLE_SR}", TO_LIGHT.to_array());
    let light = format!("{{\"sh\":{sh},\"lights\":[{{{light}}}]}}");
    for (name, text) in [("empty.toml", &empty), ("scene.toml", &scene), ("light.json", &light)] {
        std::fs::write(sandbox.path(name), text)?;
    }
    let [(empty, empty_codes), (scene, scene_codes)] = [render(&sandbox, "empty")?, render(&sandbox, "scene")?];
    let mut counts = [0, 0, 0];
    for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))) {
        let bits = |picture: &image::Rgb32FImage| picture.get_pixel(x, y).0.map(f32::to_bits);
        let same = bits(&empty) == bits(&scene);
        let touch = touch(x, y);
        counts[touch as usize] += 1;
        match touch {
            Touch::Untouched => {
                ensure!(same, "{x}, {y}: {:?} became {:?}", empty.get_pixel(x, y), scene.get_pixel(x, y));
                ensure!(empty_codes.get_pixel(x, y) == scene_codes.get_pixel(x, y), "{x}, {y}: other codes");
            }
            Touch::Touched => ensure!(!same, "{x}, {y}: touched, and still {:?}", empty.get_pixel(x, y)),
            Touch::Edge => {}
        }
    }
    let [touched, untouched, edge] = counts;
    ensure!(touched > 3_000 && untouched > 40_000 && edge < 1_000, "{touched} touched, {untouched} untouched, {edge} on edges");
    Ok(())
}

fn touch(x: u32, y: u32) -> Touch {
    // Anywhere in the pixel, whose samples lie off its middle; a centimetre is a third of a pixel at the cubes.
    let offsets = [-0.5, 0.0, 0.5].map(|dx| [-0.5, 0.0, 0.5].map(|dy| (dx, dy)));
    let meets = |side: f32| {
        move |(dx, dy): &(f32, f32)| CUBES.iter().any(|cube| ray_meets(cube, Vec3::ZERO, ray(x as f32 + dx, y as f32 + dy), side))
    };
    let offsets = offsets.as_flattened();
    if offsets.iter().all(meets(SIDE - 0.01)) {
        Touch::Touched
    } else if offsets.iter().any(meets(SIDE + 0.01)) {
        Touch::Edge
    } else {
        ground_touch(ray(x as f32, y as f32))
    }
}

fn ground_touch(ray: Vec3) -> Touch {
    if ray.y >= 0.0 {
        return Touch::Untouched;
    }
    let point = ray * (GROUND_Y / ray.y);
    let mut touch = Touch::Untouched;
    for cube in &CUBES {
        // The last fiftieth of the reach changes less than a float's last digit.
        let reach = (cube.0 - point).length() / OCCLUDER_RADIUS;
        let (within, near) = (reach < OCCLUDER_REACH - 0.1, reach < OCCLUDER_REACH);
        // Blockers are looked for in a cone up to where the shadow map begins, within two metres of the cube; texels are millimetres.
        let tan_radius = (SOLID_ANGLE_SR / std::f32::consts::PI).sqrt();
        let fringe = tan_radius * ((cube.0 - point).length() + 2.0) + 0.03;
        let shadowed = ray_meets(cube, point, TO_LIGHT, 0.8 * SIDE);
        let fringed = ray_meets(cube, point, TO_LIGHT, SIDE + 2.0 * fringe);
        if within || shadowed {
            return Touch::Touched;
        }
        if near || fringed {
            touch = Touch::Edge;
        }
    }
    touch
}

/// The ray through a place in the picture, `x` and `y` counted in pixels from the middle of the first.
fn ray(x: f32, y: f32) -> Vec3 {
    let (width, height) = (SIZE.0 as f32, SIZE.1 as f32);
    let ndc = Vec2::new((x + 0.5) / width * 2.0 - 1.0, 1.0 - (y + 0.5) / height * 2.0);
    Camera::looking(0.0, PITCH_DEG.to_radians(), FOV_Y_DEG.to_radians()).ray(ndc, width / height)
}

/// Whether a ray meets a cube of this side in the place of `cube`: Kay and Kajiya's slabs.
fn ray_meets((position, turn_deg): &(Vec3, f32), from: Vec3, direction: Vec3, side: f32) -> bool {
    let turn = Quat::from_rotation_y(-turn_deg.to_radians());
    let (from, direction) = (turn * (from - *position), turn * direction);
    let (a, b) = ((-side / 2.0 - from) / direction, (side / 2.0 - from) / direction);
    let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
    enter <= leave && leave > 0.0
}

/// Linear light that differs from pixel to pixel, brighter than white in places: rounding anywhere would show.
fn panorama() -> image::Rgb32FImage {
    image::Rgb32FImage::from_fn(128, 64, |x, y| {
        let (x, y) = (x as f32, y as f32);
        image::Rgb([0.3 + 0.2 * (x * 0.7).sin(), 0.4 + 0.3 * (y * 0.9).cos(), 0.2 + x / 100.0])
    })
}

/// Linear light, and the codes of the PNG.
fn render(sandbox: &Sandbox, name: &str) -> Result<(image::Rgb32FImage, image::RgbImage)> {
    let [scene, out, linear] = ["toml", "png", "exr"].map(|ending| format!("{name}.{ending}"));
    let [size, pitch, fov] = [format!("{}x{}", SIZE.0, SIZE.1), PITCH_DEG.to_string(), FOV_Y_DEG.to_string()];
    let mut command = sandbox.client_command()?;
    command.args(["render", "--panorama", "panorama.exr", "--light", "light.json", "--size", &size, "--pitch-deg", &pitch]);
    let output = command.args(["--fov-y-deg", &fov, "--scene", &scene, "--out", &out, "--out-linear", &linear]).output()?;
    ensure!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    Ok((image::open(sandbox.path(&linear))?.into_rgb32f(), image::open(sandbox.path(&out))?.into_rgb8()))
}
