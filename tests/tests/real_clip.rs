//! A real live-action clip, pushed from another program, lit and shown: top-bottom stereo, H.264 with rare keyframes, its sun out of sight.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use glam::{Quat, Vec3};
use image::RgbImage;
use mr360_client::camera::Camera;
use mr360_tests::probe::{LONG, Probe};
use mr360_tests::process::Program;
use mr360_tests::samples::Samples;
use mr360_tests::sandbox::{Sandbox, media};
use mr360_tests::{clips, ports};
use serde::Deserialize;

const CLIP: &str = "congo_2048.mp4";
const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/demo-scene/suzanne.glb");
/// Frames a second of the clip, and how many there are.
const FRAME_RATE: f64 = 917_425.0 / 30_618.0;
const CLIP_FRAMES: u64 = 300;
/// The server transcodes what has rarer keyframes than every two seconds, and makes one every second.
const GOP_US: f64 = 1e6;
const SIZE: (u32, u32) = (320, 180);
const FOV_Y_DEG: f32 = 50.0;
/// Pictures that each viewer records.
const WATCHED: &str = "12";
/// Most codes by which the mean of a patch or a disc may be off the prediction: the clip is coded twice more on its way, its transfer
/// is not quite sRGB's, and the picture may be a frame earlier or later.
const CODES: f32 = 16.0;

/// What stands in the place.
struct Thing {
    name: &'static str,
    /// Metres to the right of the middle of the view, at the height of the eyes less 0.9, four metres ahead.
    right_m: f32,
    radius_m: f32,
    toml: &'static str,
}

const MIRROR: Thing = Thing {
    name: "mirror ball",
    right_m: -1.4,
    radius_m: 0.6,
    toml: "shape = \"sphere\"\nscale = 1.2\nmaterial = { base_color = [0.95, 0.95, 0.95], roughness = 0.0, metallic = 1.0 }",
};
const DIFFUSE: Thing = Thing {
    name: "diffuse ball",
    right_m: 1.4,
    radius_m: 0.6,
    toml: "shape = \"sphere\"\nscale = 1.2\nmaterial = { base_color = [0.8, 0.8, 0.8], roughness = 1.0, metallic = 0.0 }",
};
/// Its middle is filled, its corners are not.
const SUZANNE: Thing = Thing { name: "model", right_m: 0.0, radius_m: 0.3, toml: "model = \"model.glb\"\nscale = 0.5" };

/// A line of `analyze --json`, as far as it is needed.
#[derive(Deserialize)]
struct Light {
    lights: Vec<Directional>,
}

#[derive(Deserialize)]
struct Directional {
    direction: Vec3,
}

/// Looks so that the main light comes from the left.
struct View {
    yaw_rad: f32,
    camera: Camera,
    to_light: Vec3,
}

impl View {
    fn beside(to_light: Vec3) -> Self {
        // Yaw turns left; straight at the light it would be atan2(−x, −z).
        let yaw_rad = (-to_light.x).atan2(-to_light.z) - std::f32::consts::FRAC_PI_2;
        Self { yaw_rad, camera: Camera::looking(yaw_rad, 0.0, FOV_Y_DEG.to_radians()), to_light }
    }

    fn place(&self, thing: &Thing) -> Vec3 {
        Quat::from_rotation_y(self.yaw_rad) * Vec3::new(thing.right_m, -0.9, -4.0)
    }

    fn scene(&self) -> String {
        let object = |thing: &Thing| format!("[[object]]\nposition = {:?}\n{}\n", self.place(thing).to_array(), thing.toml);
        format!("ground_y = -1.5\n{}", [MIRROR, DIFFUSE, SUZANNE].iter().map(object).collect::<String>())
    }

    fn pixel(&self, point: Vec3) -> (f32, f32) {
        let (width, height) = (SIZE.0 as f32, SIZE.1 as f32);
        let at = (self.camera.clip_from_view(width / height) * self.camera.view_from_world()).project_point3(point);
        ((at.x * 0.5 + 0.5) * width, (0.5 - at.y * 0.5) * height)
    }

    /// Pixels within four fifths of a thing's radius around its middle.
    fn disc(&self, thing: &Thing) -> Vec<(u32, u32)> {
        let (x, y) = self.pixel(self.place(thing));
        let metre_px = SIZE.1 as f32 / (2.0 * (0.5 * FOV_Y_DEG.to_radians()).tan()) / 4.0;
        let radius = 0.8 * thing.radius_m * metre_px;
        let inside = |&(px, py): &(u32, u32)| (px as f32 + 0.5 - x).hypot(py as f32 + 0.5 - y) < radius;
        (0..SIZE.0).flat_map(|px| (0..SIZE.1).map(move |py| (px, py))).filter(inside).collect()
    }

    /// Points of the diffuse ball in view, the first turned to the light, the second away from it.
    fn sides(&self) -> [(f32, f32); 2] {
        let middle = self.place(&DIFFUSE);
        let to_eye = -middle.normalize();
        let across = self.to_light.reject_from_normalized(to_eye).normalize();
        [across, -across].map(|side| self.pixel(middle + DIFFUSE.radius_m * (0.8 * side + 0.6 * to_eye)))
    }
}

#[test]
fn the_real_clip_lights_what_stands_in_it() -> Result<()> {
    let clip = media(CLIP)?;
    let sandbox = Sandbox::new()?;
    let view = View::beside(main_light(&sandbox, &clip)?);
    std::fs::write(sandbox.path("scene.toml"), view.scene())?;
    std::fs::copy(MODEL, sandbox.path("model.glb"))?;
    let push_url = format!("rtmp://127.0.0.1:{}/live/KEY", ports::free_tcp_port()?);
    let arguments = ["--listen", "127.0.0.1:0", "--stereo", "top-bottom", "--scene", "scene.toml", "--stats", "server.csv"];
    let mut server = sandbox.serve(&format!("{push_url}?listen=1"), &arguments)?;
    let join = |name: &str| -> Result<Program> {
        let [size, yaw, fov] = [format!("{}x{}", SIZE.0, SIZE.1), view.yaw_rad.to_degrees().to_string(), FOV_Y_DEG.to_string()];
        let [stats, record] = [format!("{name}.csv"), format!("{name}.mp4")];
        let look = ["--mode", "headless", "--size", &size, "--yaw-deg", &yaw, "--fov-y-deg", &fov];
        let write = ["--frames", WATCHED, "--stats", &stats, "--record", &record];
        sandbox.join(name, &server.join_url, &[&look[..], &write].concat())
    };
    let mut early = join("early")?;
    early.wait_for_text("its source has not come yet", LONG)?;
    let source = sandbox.push(&clip, &push_url)?;
    let probe = Probe::join(&server.join_url)?;
    // Well behind the change from the clip's own packets to transcoded ones.
    probe.pts_after(4 * FRAME_RATE as usize)?;
    let mut late = join("late")?;
    late.wait_for_text("joined the room", LONG)?;
    let late_joined_at = probe.pts_after(1)? as f64;
    for viewer in [&mut early, &mut late] {
        let status = viewer.wait_for_exit(LONG)?;
        ensure!(status.success(), "viewer ended with {status}:\n{}", viewer.output());
    }
    server.program.finish(LONG)?;
    drop(source);

    let sent = Samples::load(&sandbox.path("server.csv"))?;
    light_keeps_to_its_budget(&sent)?;
    let first_sent = sent.column("pts_us")?.into_iter().flatten().next().context("nothing was sent")?;
    for (name, joined_at) in [("early", first_sent), ("late", late_joined_at)] {
        let stats = Samples::load(&sandbox.path(&format!("{name}.csv")))?;
        let (pictures, lights) = (stats.column("pts_us")?, stats.column("light_pts_us")?);
        ensure!(pictures == lights, "{name}: pictures {pictures:?} were shown under the light of {lights:?}");
        let [first, .., last] = pictures.into_iter().collect::<Option<Vec<_>>>().context("a row without a picture")?[..] else {
            anyhow::bail!("{name}: nothing was shown");
        };
        // In the video's time, which does not run slower where programs do: the newest keyframe is at most a GOP old.
        ensure!((first - joined_at).abs() <= GOP_US, "{name}: joined at {joined_at} and was shown {first} first");
        let number = ((last - first_sent) * FRAME_RATE / 1e6).round() as u64 % CLIP_FRAMES;
        let shown = clips::pictures(&sandbox.path(&format!("{name}.mp4")), SIZE)?.pop().context("nothing was recorded")?;
        objects_are_there_and_lit(&sandbox, &view, &clip, number, &shown).with_context(|| format!("{name}, frame {number}"))?;
    }
    Ok(())
}

/// Direction to the strongest light of the clip's first frame.
fn main_light(sandbox: &Sandbox, clip: &Path) -> Result<Vec3> {
    let lines = output(sandbox.server_command()?.args(["analyze", "--stereo", "top-bottom", "--frames", "1", "--json"]).arg(clip))?;
    let light: Light = serde_json::from_str(lines.lines().next().context("analyze printed nothing")?)?;
    Ok(light.lights.first().context("no light was found in the clip")?.direction)
}

/// At most 200 bytes a frame, and under 1 % of the video's bits.
fn light_keeps_to_its_budget(sent: &Samples) -> Result<()> {
    let light: Vec<f64> = sent.column("light_bytes")?.into_iter().flatten().collect();
    let most = light.iter().copied().fold(0.0, f64::max);
    ensure!(!light.is_empty() && most <= 200.0, "up to {most} bytes of light a frame");
    let (light, video): (f64, f64) = (light.iter().sum(), sent.column("video_bytes")?.into_iter().flatten().sum());
    ensure!(light < 0.01 * video, "{light} bytes of light beside {video} of video");
    Ok(())
}

/// Compares with what `render` draws into the same frame of the file under the light that `analyze` finds in it, and with the place alone.
fn objects_are_there_and_lit(sandbox: &Sandbox, view: &View, clip: &Path, number: u64, shown: &RgbImage) -> Result<()> {
    let frame = sandbox.path("frame.png");
    let filter = format!("select=eq(n\\,{number}),scale=in_color_matrix=bt709");
    let mut ffmpeg = Command::new("ffmpeg");
    ffmpeg.args(["-hide_banner", "-nostdin", "-loglevel", "error", "-y", "-i"]).arg(clip);
    output(ffmpeg.args(["-vf", &filter, "-frames:v", "1"]).arg(&frame))?;
    let light = output(sandbox.server_command()?.args(["analyze", "--stereo", "top-bottom", "--json"]).arg(&frame))?;
    std::fs::write(sandbox.path("light.json"), light)?;
    std::fs::write(sandbox.path("empty.toml"), "ground_y = -1.5\n")?;
    let render = |scene: &str| -> Result<RgbImage> {
        let [size, yaw, fov] = [format!("{}x{}", SIZE.0, SIZE.1), view.yaw_rad.to_degrees().to_string(), FOV_Y_DEG.to_string()];
        let mut command = sandbox.client_command()?;
        command.args(["render", "--panorama", "frame.png", "--stereo", "top-bottom", "--light", "light.json", "--out", "out.png"]);
        output(command.args(["--scene", scene, "--size", &size, "--yaw-deg", &yaw, "--fov-y-deg", &fov]))?;
        Ok(image::open(sandbox.path("out.png"))?.into_rgb8())
    };
    let (predicted, place) = (render("scene.toml")?, render("empty.toml")?);
    for thing in [MIRROR, DIFFUSE, SUZANNE] {
        let disc = view.disc(&thing);
        let [off, changed] = [&predicted, &place].map(|other| difference(shown, other, &disc));
        ensure!(off < CODES && changed > 2.0 * off, "{}: {off} codes off the prediction, {changed} off the place alone", thing.name);
    }
    let sky: Vec<(u32, u32)> = (0..SIZE.0).flat_map(|x| (0..SIZE.1 / 4).map(move |y| (x, y))).collect();
    let off = difference(shown, &place, &sky);
    ensure!(off < CODES, "the place is {off} codes off above the objects");
    let [lit, dark] = view.sides().map(|at| brightness(shown, at));
    ensure!(lit > 1.15 * dark, "the diffuse ball's side to the light shows {lit} and the other {dark}");
    Ok(())
}

/// Mean absolute difference of codes.
fn difference(a: &RgbImage, b: &RgbImage, pixels: &[(u32, u32)]) -> f32 {
    let of = |&(x, y): &(u32, u32)| {
        let pairs = a.get_pixel(x, y).0.into_iter().zip(b.get_pixel(x, y).0);
        pairs.map(|(a, b)| f32::from(a.abs_diff(b))).sum::<f32>() / 3.0
    };
    pixels.iter().map(of).sum::<f32>() / pixels.len() as f32
}

/// Mean green code of 3×3 pixels.
fn brightness(picture: &RgbImage, (x, y): (f32, f32)) -> f32 {
    (0..9).map(|i| f32::from(picture.get_pixel(x as u32 + i % 3 - 1, y as u32 + i / 3 - 1).0[1])).sum::<f32>() / 9.0
}

fn output(command: &mut Command) -> Result<String> {
    let output = command.output().with_context(|| format!("{} does not start; run deploy/setup", command.get_program().display()))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?)
}
