//! The real viewer in a headset without hardware, on a real OpenXR runtime: what the eyes see, and what becomes of a session when runtime and
//! headset come, go and come back.

use std::collections::BTreeSet;
use std::f32::consts::PI;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use glam::{EulerRot, Quat, Vec2, Vec3};
use image::RgbImage;
use mr360_client::camera::{Camera, Edges};
use mr360_client::viewpoint::Viewpoint;
use mr360_protocol::scene::{Change, SceneMessage};
use mr360_shaders::equirect::direction_from_uv;
use mr360_tests::clips;
use mr360_tests::probe::{LONG, Probe};
use mr360_tests::process::Program;
use mr360_tests::samples::Samples;
use mr360_tests::sandbox::Sandbox;
use mr360_tests::xr::{Angles, Script, Scripted, ScriptedHand, XrRuntime, kept_frames};
use serde_json::Value;

/// Columns and rows of the panorama.
const PANORAMA: (u32, u32) = (1024, 512);
/// What Monado's null compositor recommends for an eye.
const EYE: (u32, u32) = (320, 240);
/// Frames that the headset shows.
const FRAMES: u64 = 600;
/// Pictures of them, of both eyes, that are compared with the headless viewer's at least. One frame a second is kept, and some of the kept show
/// hands, or a head that had just moved.
const LEAST_COMPARED: usize = 20;
/// Longest that these take, at 20 frames a second and on a busy machine.
const SHOWN_WITHIN: Duration = Duration::from_secs(600);
const GROUND_Y: f32 = -1.6;
/// A white disc of the panorama.
const SUN: Vec3 = Vec3::new(0.4, 0.8, -0.45);
/// The red ball.
const CENTER: Vec3 = Vec3::new(0.1, -0.5, -1.8);
const RADIUS: f32 = 0.3;
/// Fields of view as wide outwards and downwards as optics are, mirrored.
const LEFT: Angles = [-0.9, 0.6, 0.7, -0.8];
const RIGHT: Angles = [-0.6, 0.9, 0.7, -0.8];
/// Of an eye from the middle of the head, metres.
const HALF_DISTANCE_M: f32 = 0.032;
const CARD: &str = "synthetic:testcard?size=256x128&fps=10";

/// Grey waves in longitude and latitude, which show a shift of a pixel, and a small sun.
fn pattern(direction: Vec3) -> u8 {
    if direction.dot(SUN.normalize()) > 0.997 {
        return 255;
    }
    let (longitude, latitude) = (direction.x.atan2(-direction.z), direction.y.clamp(-1.0, 1.0).asin());
    (125.0 + 40.0 * (20.0 * longitude).sin() + 40.0 * (20.0 * latitude).sin()).round() as u8
}

fn panorama() -> Vec<u8> {
    let (width, height) = PANORAMA;
    let texel = |i: u32| {
        let uv = Vec2::new(((i % width) as f32 + 0.5) / width as f32, ((i / width) as f32 + 0.5) / height as f32);
        [pattern(direction_from_uv(uv)); 3]
    };
    (0..width * height).flat_map(texel).collect()
}

/// Ten seconds in which nothing moves.
fn still_clip(sandbox: &Sandbox) -> Result<PathBuf> {
    let still = panorama();
    let arguments = "-c:v libx264 -preset veryfast -tune zerolatency -bf 0 -g 15 -sc_threshold 0 -pix_fmt yuv420p -crf 4";
    clips::make_from(sandbox, "still.mp4", PANORAMA, 15, (0..150).map(|_| still.clone()), arguments)
}

fn scene(sandbox: &Sandbox) -> Result<PathBuf> {
    let Vec3 { x, y, z } = CENTER;
    let ball = format!("shape = \"sphere\"\nposition = [{x}, {y}, {z}]\nscale = {}", 2.0 * RADIUS);
    let red = "material = { base_color = [0.8, 0.02, 0.02], roughness = 1.0, metallic = 0.0, kind = \"opaque\" }";
    let path = sandbox.path("scene.toml");
    fs::write(&path, format!("ground_y = {GROUND_Y}\n[[object]]\n{ball}\n{red}\n"))?;
    Ok(path)
}

fn turned(yaw: f32, pitch: f32, roll: f32) -> Quat {
    Quat::from_euler(EulerRot::YXZ, yaw, pitch, roll)
}

/// Whether the headless viewer is asked for the views of a head, too.
fn headless_sees(head: usize) -> bool {
    head != 0 && head != 2
}

/// Heads that all see the ball, each with hands of its own.
fn scripts() -> Vec<Script> {
    let heads = [
        (Vec3::new(0.0, 1.6, 0.0), turned(0.0, 0.0, 0.0)),
        (Vec3::new(0.2, 1.5, -0.3), turned(0.2, -0.3, 0.0)),
        (Vec3::new(-0.3, 1.7, 0.4), turned(-0.3, -0.1, 0.25)),
        (Vec3::new(0.0, 1.1, -0.2), turned(0.1, 0.2, -0.4)),
        (Vec3::new(0.1, 1.6, 0.1), turned(-0.1, -0.2, 0.1)),
    ];
    // Behind the head and pointing up, where there is nothing to take; sticks and grips too weak to move or scale the viewer.
    // Off where the headless viewer, which has no hands to be lit and to throw shadows, is to see the same.
    let hand = |aside: f32, at: usize| ScriptedHand {
        pose: Some(Scripted {
            position: Vec3::new(aside, 1.2 + 0.05 * at as f32, 0.9),
            orientation: turned(PI + 0.1 * at as f32, 0.8, 0.0),
        })
        .filter(|_| !headless_sees(at)),
        trigger: if at == 2 { 1.0 } else { 0.0 },
        squeeze: 0.1 * at as f32,
        stick: Vec2::new(0.5, -0.05 * at as f32),
        // Held, it recentres.
        b: false,
    };
    let script = |(at, (position, orientation)): (usize, (Vec3, Quat))| Script {
        head: Scripted { position, orientation },
        eyes: [(LEFT, -HALF_DISTANCE_M), (RIGHT, HALF_DISTANCE_M)],
        // The right one is off at first.
        hands: [hand(-0.2, at), if at == 0 { ScriptedHand { pose: None, ..hand(0.2, at) } } else { hand(0.2, at) }],
    };
    heads.into_iter().enumerate().map(script).collect()
}

/// A frame that was kept.
struct Kept {
    frame: u64,
    eyes: [(Camera, RgbImage); 2],
    value: Value,
}

impl Kept {
    fn load(folder: &Path, value: Value) -> Result<Self> {
        let frame = value["frame"].as_u64().context("no frame")?;
        let eye = |at: usize, name: &str| -> Result<(Camera, RgbImage)> {
            let view: Viewpoint = serde_json::from_value(value["views"][at].clone()).context("no view")?;
            Ok((view.camera()?, image::open(folder.join(format!("{frame:06}-{name}.png")))?.into_rgb8()))
        };
        Ok(Self { frame, eyes: [eye(0, "left")?, eye(1, "right")?], value })
    }

    fn vector(&self, of: &str, part: &str) -> Option<Vec<f32>> {
        let list = self.value.pointer(of)?.get(part)?.as_array()?;
        list.iter().map(|value| value.as_f64().map(|value| value as f32)).collect()
    }

    /// The headless viewer has none, which would be lit and throw shadows.
    fn shows_no_hands(&self) -> bool {
        self.value["hands"].as_array().is_some_and(|hands| hands.iter().all(|hand| hand["grip"].is_null() && hand["aim"].is_null()))
    }

    /// True when its head is the script's.
    fn is_of(&self, script: &Script) -> bool {
        let (Some(position), Some(orientation)) = (self.vector("/head", "position"), self.vector("/head", "orientation")) else {
            return false;
        };
        let expected = script.head.position + Vec3::Y * GROUND_Y;
        near(&position, &expected.to_array(), 1e-4) && same_turn(&orientation, script.head.orientation)
    }
}

fn near(a: &[f32], b: &[f32], tolerance: f32) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= tolerance)
}

fn same_turn(a: &[f32], b: Quat) -> bool {
    <[f32; 4]>::try_from(a).is_ok_and(|a| Quat::from_array(a).dot(b).abs() > 1.0 - 1e-5)
}

#[test]
fn both_eyes_see_what_geometry_and_the_headless_viewer_say() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let clip = still_clip(&sandbox)?;
    let scene = scene(&sandbox)?;
    let scene = scene.to_str().context("path")?;
    let server = sandbox.serve(clip.to_str().context("path")?, &["--loop", "--scene", scene, "--listen", "127.0.0.1:0"])?;
    let mut runtime = XrRuntime::new(&sandbox, "xr")?;
    runtime.start()?;
    let mut remote = runtime.remote()?;
    let scripts = scripts();
    remote.set(&scripts[0])?;
    let (folder, csv) = (sandbox.path("eyes"), sandbox.path("xr.csv"));
    let frames = FRAMES.to_string();
    // The pattern is that of a panorama at infinity.
    let arguments =
        ["--mode", "xr", "--mute", "--parallax", "infinity", "--frames", &frames, "--record-eyes", folder.to_str().context("path")?];
    let mut viewer =
        runtime.join(&sandbox, "viewer", &server.join_url, &[&arguments[..], &["--stats", csv.to_str().context("path")?]].concat())?;
    viewer.wait_for_text("eyes kept", LONG)?;
    for script in &scripts {
        viewer.mark();
        remote.set(script)?;
        // The first may have been read before; so may the hands of the second.
        for _ in 0..3 {
            viewer.wait_for_text("eyes kept", LONG)?;
            viewer.mark();
        }
    }
    let status = viewer.wait_for_exit(SHOWN_WITHIN)?;
    ensure!(status.success(), "the viewer ended with {status}:\n{}", viewer.output());
    for said in ["multiview=true", "5 of 5 kinds of controllers bound", "space=LOCAL_FLOOR"] {
        ensure!(viewer.output().contains(said), "the viewer does not say {said:?}:\n{}", viewer.output());
    }

    let mut seen = BTreeSet::new();
    let kept = kept_frames(&folder)?.into_iter().map(|value| Kept::load(&folder, value)).collect::<Result<Vec<_>>>()?;
    for (at, script) in scripts.iter().enumerate() {
        let kept = kept.iter().rfind(|kept| kept.is_of(script)).with_context(|| format!("no kept frame is of head {at}"))?;
        eyes_are_scripted(kept, script)?;
        hands_are_scripted(kept, script)?;
        for (eye, (camera, picture)) in kept.eyes.iter().enumerate() {
            let edges = panorama_reaches_all_edges(camera, picture).with_context(|| format!("head {at}, frame {}", kept.frame))?;
            seen.extend(edges.into_iter().map(|edge| (eye, edge)));
        }
        parallax_is_geometrys(kept).with_context(|| format!("head {at}, frame {}", kept.frame))?;
    }
    let mut compared = 0;
    for (_, script) in scripts.iter().enumerate().filter(|(at, _)| headless_sees(*at)) {
        let alike: Vec<&Kept> = kept.iter().filter(|kept| kept.is_of(script) && kept.shows_no_hands()).collect();
        compared += headless_draws_the_same(&sandbox, &runtime, &server.join_url, &alike)?;
    }
    println!("{compared} pictures of {FRAMES} frames compared with the headless viewer's, {} kept", 2 * kept.len());
    ensure!(compared >= LEAST_COMPARED, "only {compared} pictures were compared with the headless viewer's");
    ensure!(seen.len() == 8, "not every edge of both eyes was seen beside ball and shade: {seen:?}");
    stats_add_up(&Samples::load(&csv)?)
}

/// Every frame is there, shows a pose's age, and waited for nobody.
fn stats_add_up(samples: &Samples) -> Result<()> {
    ensure!(samples.len() as u64 == FRAMES, "{} rows for {FRAMES} frames", samples.len());
    let waits: f64 = samples.column("gpu_waits")?.iter().flatten().sum();
    ensure!(waits == 0.0, "{waits} waits within frames");
    let ages = samples.column("pose_to_photon_us")?;
    ensure!(ages.iter().all(Option::is_some), "a frame without the age of its pose");
    let missed = samples.column("missed_frames")?;
    ensure!(missed.windows(2).all(|pair| pair[0] <= pair[1]), "missed frames are not counted up");
    Ok(())
}

/// Each eye is where the script put it, turned as the head, and sees as far as its optics.
fn eyes_are_scripted(kept: &Kept, script: &Script) -> Result<()> {
    for ((camera, _), (angles, aside)) in kept.eyes.iter().zip(&script.eyes) {
        let position = script.head.position + script.head.orientation * (Vec3::X * *aside) + Vec3::Y * GROUND_Y;
        ensure!(camera.position.distance(position) < 1e-4, "an eye is at {} instead of {position}", camera.position);
        ensure!(camera.world_from_view.dot(script.head.orientation).abs() > 1.0 - 1e-5, "an eye is turned otherwise");
        let Edges { left, right, down, up } = camera.edges(1.0);
        ensure!(near(&[left, right, up, down], &angles.map(f32::tan), 1e-5), "edges {left} {right} {up} {down}");
    }
    Ok(())
}

fn hands_are_scripted(kept: &Kept, script: &Script) -> Result<()> {
    for (at, hand) in script.hands.iter().enumerate() {
        let told = &kept.value["hands"][at];
        let Some(pose) = hand.pose else {
            ensure!(told["grip"].is_null() && told["aim"].is_null(), "hand {at} is off, but told as {told}");
            continue;
        };
        let of = format!("/hands/{at}/grip");
        let position = pose.position + Vec3::Y * GROUND_Y;
        let told_position = kept.vector(&of, "position").with_context(|| format!("hand {at} is not told: {told}"))?;
        // The driver says where the controller's origin is; grip and aim lie a little off it.
        ensure!(near(&told_position, &position.to_array(), 0.15), "hand {at} is at {told_position:?} instead of {position}");
        let number = |name: &str| told[name].as_f64().unwrap_or(f64::NAN) as f32;
        ensure!(number("select") == hand.trigger, "hand {at}: {told}");
        ensure!((number("squeeze") - hand.squeeze).abs() < 1e-3, "hand {at}: {told}");
        let stick = kept.vector(&format!("/hands/{at}"), "stick").unwrap_or_default();
        ensure!(near(&stick, &hand.stick.to_array(), 1e-3), "hand {at}: {told}");
        ensure!(told["menu"].as_bool() == Some(hand.b), "hand {at}: {told}");
    }
    Ok(())
}

fn ray(camera: &Camera, x: f32, y: f32) -> Vec3 {
    let ndc = Vec2::new(2.0 * x / EYE.0 as f32 - 1.0, 1.0 - 2.0 * y / EYE.1 as f32);
    camera.ray(ndc, EYE.0 as f32 / EYE.1 as f32)
}

fn meets_ball(camera: &Camera, direction: Vec3, radius: f32) -> bool {
    let to = CENTER - camera.position;
    let along = to.dot(direction);
    along > 0.0 && to.length_squared() - along * along < radius * radius
}

/// True where the ball changes the ground: around its foot, and where its shadow falls.
fn meets_shade(camera: &Camera, direction: Vec3) -> bool {
    let along = (GROUND_Y - camera.position.y) / direction.y;
    let met = camera.position + direction * along;
    let height = CENTER.y - GROUND_Y;
    let shadow = CENTER - SUN.normalize() * (height / SUN.normalize().y);
    let beside = |place: Vec3| (met - place).with_y(0.0).length();
    direction.y < 0.0 && (beside(CENTER) < 4.0 * RADIUS || beside(shadow) < 2.0 * RADIUS)
}

/// What each of the four edges shows is what the panorama has there: of the errors that a shift of a pixel makes, a parabola, the least is
/// within a quarter of a pixel of none. Returns the edges that show enough of the panorama to tell.
fn panorama_reaches_all_edges(camera: &Camera, picture: &RgbImage) -> Result<Vec<&'static str>> {
    ensure!(picture.dimensions() == EYE, "a picture of {:?}", picture.dimensions());
    let (width, height) = EYE;
    let edges = [
        ("left", (0..3).flat_map(|x| (0..height).map(move |y| (x, y))).collect::<Vec<(u32, u32)>>(), Vec2::X),
        ("right", (width - 3..width).flat_map(|x| (0..height).map(move |y| (x, y))).collect(), Vec2::X),
        ("upper", (0..3).flat_map(|y| (0..width).map(move |x| (x, y))).collect(), Vec2::Y),
        ("lower", (height - 3..height).flat_map(|y| (0..width).map(move |x| (x, y))).collect(), Vec2::Y),
    ];
    let mut told = Vec::new();
    for (name, pixels, outwards) in edges {
        let error = |shift: f32| {
            let mut pairs = Vec::new();
            for (x, y) in &pixels {
                let at = Vec2::new(*x as f32 + 0.5, *y as f32 + 0.5) + outwards * shift;
                let direction = ray(camera, at.x, at.y);
                // Ball and sun are no waves, and beneath the ball lie shade and bounce.
                if !meets_ball(camera, direction, 1.1 * RADIUS) && !meets_shade(camera, direction) && direction.y < 0.6 {
                    pairs.push((f32::from(pattern(direction)), f32::from(picture.get_pixel(*x, *y).0[1])));
                }
            }
            (pairs.len() >= 200).then(|| mean_square_residual(&pairs))
        };
        let (Some(before), Some(here), Some(after)) = (error(-1.0), error(0.0), error(1.0)) else { continue };
        let bend = before + after - 2.0 * here;
        // Along crests and troughs of the waves a pixel aside is as good.
        if bend < 0.5 {
            continue;
        }
        told.push(name);
        let least = 0.5 * (before - after) / bend;
        ensure!(least.abs() < 0.25, "{name} edge: off by {least} pixels ({before}, {here}, {after})");
    }
    Ok(told)
}

/// What a straight line through pairs leaves, squared: codes of video and of pictures differ by their curves.
fn mean_square_residual(pairs: &[(f32, f32)]) -> f32 {
    let count = pairs.len() as f32;
    let mean = |of: &dyn Fn(&(f32, f32)) -> f32| pairs.iter().map(of).sum::<f32>() / count;
    let (mx, my) = (mean(&|p| p.0), mean(&|p| p.1));
    let slope = mean(&|p| (p.0 - mx) * (p.1 - my)) / mean(&|p| (p.0 - mx) * (p.0 - mx)).max(1e-6);
    mean(&|p| (p.1 - my - slope * (p.0 - mx)).powi(2))
}

/// The ball's middle in both pictures is where rays meet it, and so is the difference.
fn parallax_is_geometrys(kept: &Kept) -> Result<()> {
    let mut seen = [Vec2::ZERO; 2];
    let mut expected = [Vec2::ZERO; 2];
    for (at, (camera, picture)) in kept.eyes.iter().enumerate() {
        let is_red = |x: u32, y: u32| {
            let [r, g, b] = picture.get_pixel(x, y).0;
            i32::from(r) > 2 * i32::from(g.max(b))
        };
        seen[at] = middle(is_red).context("the ball is not seen")?;
        let met = |x: u32, y: u32| meets_ball(camera, ray(camera, x as f32 + 0.5, y as f32 + 0.5), RADIUS);
        expected[at] = middle(met).context("the ball is not in view")?;
    }
    for (eye, (seen, expected)) in seen.iter().zip(&expected).enumerate() {
        ensure!(seen.distance(*expected) < 1.0, "eye {eye}: the ball is at {seen} instead of {expected}");
    }
    let (shift, geometry) = (seen[0] - seen[1], expected[0] - expected[1]);
    ensure!(shift.distance(geometry) < 0.5, "the eyes differ by {shift} instead of {geometry} pixels");
    ensure!(geometry.length() > 3.0, "a parallax of {geometry} shows nothing");
    Ok(())
}

/// Mean of the pixels that are in, from the upper left corner.
fn middle(is_in: impl Fn(u32, u32) -> bool) -> Option<Vec2> {
    let all: Vec<Vec2> = (0..EYE.1)
        .flat_map(|y| (0..EYE.0).map(move |x| (x, y)))
        .filter(|(x, y)| is_in(*x, *y))
        .map(|(x, y)| Vec2::new(x as f32 + 0.5, y as f32 + 0.5))
        .collect();
    (all.len() > 100).then(|| all.iter().sum::<Vec2>() / all.len() as f32)
}

/// The headless viewer, asked for the same views of the same still broadcast, draws the same pictures up to what compression leaves. Returns
/// how many of these frames of one head were compared, both eyes'.
fn headless_draws_the_same(sandbox: &Sandbox, runtime: &XrRuntime, url: &str, alike: &[&Kept]) -> Result<usize> {
    let kept = alike.first().context("no kept frame is of this head")?;
    for at in 0..kept.eyes.len() {
        let (view, png) = (sandbox.path("view.json"), sandbox.path("headless.png"));
        fs::write(&view, kept.value["views"][at].to_string())?;
        let size = format!("{}x{}", EYE.0, EYE.1);
        let view = view.to_str().context("path")?;
        let arguments = ["--mode", "headless", "--parallax", "infinity", "--frames", "5", "--size", &size, "--view", view];
        // Through the same dynamic loader, and so with the same driver.
        let mut viewer =
            runtime.join(sandbox, "headless", url, &[&arguments[..], &["--snapshot", png.to_str().context("path")?]].concat())?;
        let status = viewer.wait_for_exit(LONG)?;
        ensure!(status.success(), "the headless viewer ended with {status}:\n{}", viewer.output());
        let headless = image::open(&png)?.into_rgb8();
        for kept in alike {
            let picture = &kept.eyes[at].1;
            let mut off: Vec<u8> = picture.as_raw().iter().zip(headless.as_raw()).map(|(a, b)| a.abs_diff(*b)).collect();
            off.sort_unstable();
            let (mean, most) = (off.iter().map(|off| f64::from(*off)).sum::<f64>() / off.len() as f64, off[off.len() * 999 / 1000]);
            ensure!(mean < 0.5 && most <= 6, "frame {}, eye {at}: {mean:.2} levels off on average, {most} at 99.9 %", kept.frame);
        }
    }
    Ok(alike.len() * kept.eyes.len())
}

#[test]
fn runtime_and_headset_come_and_go_and_the_broadcast_goes_on() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let server = sandbox.serve(CARD, &["--listen", "127.0.0.1:0"])?;
    let probe = Probe::join(&server.join_url)?;
    let mut runtime = XrRuntime::new(&sandbox, "xr")?;
    let csv = sandbox.path("xr.csv");
    let arguments = ["--mode", "xr", "--mute", "--stats", csv.to_str().context("path")?];
    // No service yet.
    let mut viewer = runtime.join(&sandbox, "viewer", &server.join_url, &arguments)?;
    viewer.wait_for_text("start the headset's software", LONG)?;
    let before = probe.pts_after(5)?;

    runtime.start()?;
    viewer.wait_for_text("headset in use", LONG)?;
    viewer.wait_for_text("first picture after", LONG)?;

    // Another program takes the headset and gives it back.
    viewer.mark();
    let mut other = runtime.join(&sandbox, "other", &server.join_url, &["--mode", "xr", "--mute", "--frames", "20"])?;
    let aside = |line: &str| ["headset asleep or covered", "headset visible"].iter().any(|text| line.contains(text)).then_some(());
    viewer.wait_for("losing the focus", LONG, aside)?;
    ensure!(other.wait_for_exit(LONG)?.success(), "the other viewer failed:\n{}", other.output());
    viewer.wait_for_text("headset in use", LONG)?;

    // Twice the runtime is gone from one moment to the next.
    for _ in 0..2 {
        viewer.mark();
        runtime.kill()?;
        viewer.wait_for_text("opening it anew; the broadcast goes on", LONG)?;
        runtime.start()?;
        viewer.wait_for_text("headset in use", LONG)?;
    }
    ensure!(probe.pts_after(5)? > before, "the broadcast has stood still");
    viewer.finish(LONG)?;
    let pictures = Samples::load(&csv)?.column("pts_us")?;
    ensure!(pictures.windows(2).all(|pair| pair[0] <= pair[1]), "the broadcast's time went back");
    Ok(())
}

#[test]
fn without_a_runtime_the_viewer_says_so_and_goes_on() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let server = sandbox.serve(CARD, &["--listen", "127.0.0.1:0"])?;
    let mut command: Command = sandbox.client_command()?;
    command.args(["join", &server.join_url, "--mode", "xr", "--mute", "--size", "64x36", "--frames", "3"]);
    command.env("XR_RUNTIME_JSON", "/nowhere/runtime.json").env_remove("DISPLAY").env_remove("WAYLAND_DISPLAY");
    let mut viewer = Program::spawn("viewer", &mut command)?;
    viewer.wait_for_text("no headset can be used", LONG)?;
    viewer.wait_for_text("going on in a window", LONG)?;
    viewer.wait_for_text("going on headless", LONG)?;
    let status = viewer.wait_for_exit(Duration::from_secs(120))?;
    ensure!(status.success(), "the viewer ended with {status}:\n{}", viewer.output());
    Ok(())
}

fn position(change: &Change) -> Option<Vec3> {
    match change {
        Change::Put(object) => Some(object.transform.position),
        Change::Move(_, transform) => Some(transform.position),
        Change::Remove(_) => None,
    }
}

/// One hand points at the ball, takes it and moves aside: the ball goes along for everyone.
#[test]
fn a_hand_in_the_headset_moves_what_it_holds() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let scene = scene(&sandbox)?;
    let server = sandbox.serve(CARD, &["--scene", scene.to_str().context("path")?, "--listen", "127.0.0.1:0"])?;
    let probe = Probe::join(&server.join_url)?;
    let mut runtime = XrRuntime::new(&sandbox, "xr")?;
    runtime.start()?;
    let mut remote = runtime.remote()?;
    let head = Scripted { position: Vec3::new(0.0, 1.6, 0.0), orientation: Quat::IDENTITY };
    let idle = ScriptedHand { pose: None, trigger: 0.0, squeeze: 0.0, stick: Vec2::ZERO, b: false };
    // Straight ahead, at the height of the ball's middle.
    let right = |aside: f32, trigger: f32| {
        let position = Vec3::new(CENTER.x + aside, CENTER.y - GROUND_Y, -0.4);
        ScriptedHand { pose: Some(Scripted { position, orientation: Quat::IDENTITY }), trigger, ..idle }
    };
    let script = |hand| Script { head, eyes: [(LEFT, -HALF_DISTANCE_M), (RIGHT, HALF_DISTANCE_M)], hands: [idle, hand] };
    remote.set(&script(right(0.0, 0.0)))?;
    let folder = sandbox.path("eyes");
    let arguments = ["--mode", "xr", "--mute", "--record-eyes", folder.to_str().context("path")?];
    let mut viewer = runtime.join(&sandbox, "viewer", &server.join_url, &arguments)?;
    let shown = |viewer: &mut Program| -> Result<()> {
        for _ in 0..2 {
            viewer.wait_for_text("eyes kept", LONG)?;
            viewer.mark();
        }
        Ok(())
    };
    shown(&mut viewer)?;
    remote.set(&script(right(0.0, 1.0)))?;
    shown(&mut viewer)?;
    remote.set(&script(right(0.4, 1.0)))?;
    let moved = probe.scene("the ball has moved", |message| {
        let objects: Vec<Vec3> = match message {
            SceneMessage::Snapshot { scene, .. } => scene.objects.iter().map(|object| object.transform.position).collect(),
            SceneMessage::Delta { changes, .. } => changes.iter().filter_map(position).collect(),
        };
        objects.into_iter().find(|position| position.x > CENTER.x + 0.3)
    })?;
    ensure!(moved.distance(CENTER + 0.4 * Vec3::X) < 0.15, "the ball was moved to {moved}");
    viewer.finish(LONG)
}
