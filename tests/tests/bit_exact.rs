//! What no object touched is the panorama, bit for bit.

use anyhow::{Result, ensure};
use mr360_tests::sandbox::Sandbox;

const EMPTY: &str = "ground_y = -1.6\n";
const SCENE: &str = r#"
ground_y = -1.6
[[object]]
shape = "cube"
position = [0.0, -1.35, -4.0]
scale = 0.5
material = { base_color = [0.1, 0.6, 0.2] }
"#;
/// One light from above, as `analyze --json` writes it, so that the cube casts a shadow.
const LIGHT: &str = r#"{"sh":[[1,1,1],[0.2,0.2,0.2],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0],[0,0,0]],
"lights":[{"id":1,"direction":[0.48,0.8,0.36],"irradiance":[2.0,1.9,1.7],"solid_angle_sr":0.01}]}"#;

#[test]
fn pixels_that_no_object_touched_are_the_panorama() -> Result<()> {
    let sandbox = Sandbox::new()?;
    panorama().save(sandbox.path("panorama.exr"))?;
    for (name, text) in [("empty.toml", EMPTY), ("scene.toml", SCENE), ("light.json", LIGHT)] {
        std::fs::write(sandbox.path(name), text)?;
    }
    let [empty, scene] = [render(&sandbox, "empty")?, render(&sandbox, "scene")?];
    let (width, height) = (empty.width(), empty.height());
    let changed: Vec<(u32, u32)> =
        empty.enumerate_pixels().filter(|(x, y, before)| *before != scene.get_pixel(*x, *y)).map(|(x, y, _)| (x, y)).collect();
    ensure!(!changed.is_empty(), "the cube is not there");
    // The cube is 0.5 m wide at 4 m: its light and shadow change the ground around it, and never the sky or the picture's sides.
    let horizon = height / 2;
    let stray = changed.iter().find(|&&(x, y)| y + 2 < horizon || x < width / 8 || x >= width - width / 8);
    ensure!(stray.is_none(), "pixel {stray:?} of {width}×{height} changed, {} in all", changed.len());
    let total = (width * height) as usize;
    ensure!(changed.len() * 2 < total, "{} of {total} pixels changed", changed.len());
    Ok(())
}

/// Linear light that differs from pixel to pixel, brighter than white in places: rounding anywhere would show.
fn panorama() -> image::Rgb32FImage {
    image::Rgb32FImage::from_fn(128, 64, |x, y| {
        let (x, y) = (x as f32, y as f32);
        image::Rgb([0.3 + 0.2 * (x * 0.7).sin(), 0.4 + 0.3 * (y * 0.9).cos(), 0.2 + x / 100.0])
    })
}

fn render(sandbox: &Sandbox, name: &str) -> Result<image::Rgb32FImage> {
    let [scene, out, linear] = ["toml", "png", "exr"].map(|ending| format!("{name}.{ending}"));
    let mut command = sandbox.client_command()?;
    command.args(["render", "--panorama", "panorama.exr", "--light", "light.json", "--size", "160x90", "--scene", &scene]);
    let output = command.args(["--out", &out, "--out-linear", &linear]).output()?;
    ensure!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    ensure!(image::open(sandbox.path(&out))?.width() == 160);
    Ok(image::open(sandbox.path(&linear))?.into_rgb32f())
}
