//! A frame runs the passes that its scene needs under its light, and no others: seen from outside, by the passes that were timed.

use anyhow::{Context, Result, ensure};
use mr360_tests::sandbox::Sandbox;

const GROUND: &str = "ground_y = -1.6\n";
const DIFFUSE: &str = "[[object]]\nshape = \"sphere\"\nposition = [-0.7, -1.1, -3.0]\nmaterial = { base_color = [0.6, 0.5, 0.4], roughness = 1.0 }\n\
                       [[object]]\nshape = \"cube\"\nposition = [0.7, -1.1, -3.5]\nmaterial = { base_color = [0.3, 0.5, 0.7], roughness = 1.0 }\n";
const MIRROR: &str = "[[object]]\nshape = \"sphere\"\nposition = [0.0, -1.1, -4.5]\nmaterial = { roughness = 0.0, metallic = 1.0 }\n";
const GLASS: &str = "[[object]]\nshape = \"sphere\"\nposition = [0.0, -1.1, -4.5]\nmaterial = { roughness = 0.0, kind = \"glass\" }\n";

/// Standard overcast sky of the CIE over grey ground, with the noise of a camera; `sun`: with a disc of 2° half angle that shines through.
fn sky(sun: bool) -> image::Rgb32FImage {
    let towards_sun = glam::Vec3::new(0.5, 0.7, -0.5).normalize();
    image::Rgb32FImage::from_fn(256, 128, |x, y| {
        let longitude = ((x as f32 + 0.5) / 256.0 - 0.5) * std::f32::consts::TAU;
        let latitude = (0.5 - (y as f32 + 0.5) / 128.0) * std::f32::consts::PI;
        let towards = glam::Vec3::new(latitude.cos() * longitude.sin(), latitude.sin(), -latitude.cos() * longitude.cos());
        let radiance = if towards.y > 0.0 { 0.6 * (1.0 + 2.0 * towards.y) / 3.0 } else { 0.12 };
        let noise = (((x * 7919 + y * 104_729) % 5) as f32 - 2.0) / 255.0;
        let lit = sun && towards.dot(towards_sun) > 2.0_f32.to_radians().cos();
        image::Rgb([if lit { 300.0 } else { radiance + noise }; 3])
    })
}

/// Names of the passes of a frame with these objects, under the light that the server sees in this panorama.
fn passes(sandbox: &Sandbox, panorama: &str, objects: &str) -> Result<Vec<String>> {
    std::fs::write(sandbox.path("SCENE.toml"), GROUND.to_owned() + objects)?;
    let output = sandbox.server_command()?.args(["analyze", "--json", panorama]).output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    std::fs::write(sandbox.path("light.json"), &output.stdout)?;
    let mut command = sandbox.client_command()?;
    command.args(["render", "--panorama", panorama, "--scene", "SCENE.toml", "--light", "light.json", "--size", "160x90"]);
    let output = command.args(["--pitch-deg", "-15", "--out", "out.png", "--passes", "passes.csv"]).output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = std::fs::read_to_string(sandbox.path("passes.csv"))?;
    text.lines().skip(1).map(|line| Ok(line.rsplit_once(',').context("no time")?.0.to_owned())).collect()
}

#[test]
fn diffuse_objects_under_an_overcast_sky_run_nothing_extra_and_each_need_adds_its_own_pass() -> Result<()> {
    let sandbox = Sandbox::new()?;
    sky(false).save(sandbox.path("overcast.exr"))?;
    sky(true).save(sandbox.path("sunny.exr"))?;
    let wanted: [(&str, String, &[&str]); 6] = [
        ("overcast.exr", String::new(), &["composite"]),
        ("overcast.exr", DIFFUSE.to_owned(), &["objects", "composite"]),
        ("overcast.exr", [DIFFUSE, MIRROR].concat(), &["reflections", "objects", "composite"]),
        ("overcast.exr", [DIFFUSE, GLASS].concat(), &["reflections", "objects", "glass", "composite"]),
        ("sunny.exr", DIFFUSE.to_owned(), &["shadow 1", "objects", "composite"]),
        ("sunny.exr", [DIFFUSE, MIRROR].concat(), &["reflections", "shadow 1", "objects", "composite"]),
    ];
    for (panorama, objects, expected) in wanted {
        let ran = passes(&sandbox, panorama, &objects)?;
        ensure!(ran == expected, "{panorama}, {objects:?}: ran {ran:?}, not {expected:?}");
    }
    Ok(())
}
