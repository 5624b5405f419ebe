//! A virtual grey card in the light of a real one: `tests/peers/mitsuba_grey_card.py` traced a place with three real cards and without them; the server
//! estimates the light of the place without, and the viewer draws the cards into it.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use glam::{Mat3, Vec2, Vec3};
use mr360_client::camera::Camera;
use mr360_tests::sandbox::Sandbox;
use serde::Deserialize;

/// Most that any channel may be off, of the real card's radiance.
const BOUND: f32 = 0.03;
const SIZE: (u32, u32) = (480, 270);
const FOV_Y_DEG: f32 = 60.0;

/// `cards.json`.
#[derive(Deserialize)]
struct Cards {
    cards: Vec<Card>,
}

/// The middle of a real card as the camera sees it.
#[derive(Deserialize)]
struct Card {
    /// Linear.
    radiance: [f32; 3],
    standard_error: [f32; 3],
    middle: [f32; 3],
    /// From the middle to the sides of what was measured.
    across: [f32; 3],
    up: [f32; 3],
}

impl Card {
    /// True for rays from the camera that meet what was measured.
    fn met_by(&self, ray: Vec3) -> bool {
        let frame = Mat3::from_cols(self.across.into(), self.up.into(), -ray);
        let at = frame.inverse() * -Vec3::from(self.middle);
        at.z > 0.0 && at.x.abs() < 1.0 && at.y.abs() < 1.0
    }
}

#[test]
fn a_virtual_grey_card_looks_as_a_real_one_does() -> Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("references/grey-card");
    let cards: Cards = serde_json::from_str(&std::fs::read_to_string(folder.join("cards.json"))?)?;
    let sandbox = Sandbox::new()?;
    let panorama = folder.join("without.exr");
    let output = sandbox.server_command()?.args(["analyze", "--json"]).arg(&panorama).output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    std::fs::write(sandbox.path("light.json"), &output.stdout)?;
    let mut command = sandbox.client_command()?;
    command.arg("render").arg("--panorama").arg(&panorama).arg("--scene").arg(folder.join("SCENE.toml"));
    command.args(["--light", "light.json", "--size", &format!("{}x{}", SIZE.0, SIZE.1), "--fov-y-deg", &FOV_Y_DEG.to_string()]);
    let output = command.args(["--out", "cards.png", "--out-linear", "cards.exr"]).output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let drawn = image::open(sandbox.path("cards.exr"))?.into_rgb32f();
    let camera = Camera::looking(0.0, 0.0, FOV_Y_DEG.to_radians());
    let mut worst = 0.0_f32;
    for (at, card) in cards.cards.iter().enumerate() {
        let seen = |x: u32, y: u32| {
            let ndc = Vec2::new((x as f32 + 0.5) / SIZE.0 as f32 * 2.0 - 1.0, 1.0 - (y as f32 + 0.5) / SIZE.1 as f32 * 2.0);
            card.met_by(camera.ray(ndc, SIZE.0 as f32 / SIZE.1 as f32))
        };
        let pixels: Vec<Vec3> =
            drawn.enumerate_pixels().filter(|(x, y, _)| seen(*x, *y)).map(|(_, _, pixel)| Vec3::from(pixel.0)).collect();
        ensure!(pixels.len() > 300, "card {at} is seen in {} pixels", pixels.len());
        let mean = pixels.iter().sum::<Vec3>() / pixels.len() as f32;
        let off = (mean / Vec3::from(card.radiance) - 1.0).to_array();
        eprintln!("card {at}: {mean} of {:?}, off by {off:?}", card.radiance);
        let noise = card.standard_error.iter().zip(card.radiance).map(|(error, radiance)| error / radiance).fold(0.0, f32::max);
        ensure!(noise < BOUND / 10.0, "the reference of card {at} is uncertain by {noise}");
        worst = off.into_iter().map(f32::abs).fold(worst, f32::max);
    }
    ensure!(worst <= BOUND, "off by {:.1} %", 100.0 * worst);
    cards.cards.first().map(|_| ()).context("cards.json holds no card")
}
