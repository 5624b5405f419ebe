//! A clip pushed by `ffmpeg` over RTMP into the real server, watched by real viewers: what the project is for.

use anyhow::{Context, Result, ensure};
use mr360_tests::probe::{LONG, Probe};
use mr360_tests::samples::Samples;
use mr360_tests::sandbox::Sandbox;
use mr360_tests::{clips, ports};

const SCENE: &str = r#"
ground_y = -1.6
[[object]]
shape = "sphere"
position = [0.0, 0.0, -3.0]
scale = 1.5
material = { base_color = [0.9, 0.05, 0.05] }
[[object]]
shape = "sphere"
position = [-2.0, -1.1, -4.0]
material = { base_color = [0.9, 0.9, 0.9], roughness = 0.0, metallic = 1.0 }
[[object]]
model = "model.glb"
position = [1.5, -1.1, -4.0]
scale = 0.5
"#;
const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/demo-scene/suzanne.glb");

/// Bits of the pushed video: at 15 frames/s as many a frame as 5 Mbit/s at 30, and real 360° streams have more.
const VIDEO_KBITS: u32 = 2_500;

#[test]
fn a_pushed_clip_is_lit_and_shown_to_two_viewers() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let clip = clips::stereo(&sandbox, "clip.flv", VIDEO_KBITS)?;
    std::fs::write(sandbox.path("scene.toml"), SCENE)?;
    std::fs::copy(MODEL, sandbox.path("model.glb"))?;
    let push_url = format!("rtmp://127.0.0.1:{}/live/KEY", ports::free_tcp_port()?);
    let arguments =
        ["--listen", "127.0.0.1:0", "--stereo", "top-bottom", "--scene", "scene.toml", "--stats", "server.csv", "--state", "server"];
    let mut server = sandbox.serve(&format!("{push_url}?listen=1"), &arguments)?;

    let viewer = |name: &str| {
        let [stats, snapshot] = [format!("{name}.csv"), format!("{name}.png")];
        let arguments = ["--mode", "headless", "--size", "160x90", "--stats", &stats, "--snapshot", &snapshot, "--frames", "3"];
        sandbox.join(name, &server.join_url, &arguments)
    };
    let mut early = viewer("early")?;
    early.wait_for_text("its source has not come yet", LONG)?;
    let _source = sandbox.push(&clip, &push_url)?;
    let probe = Probe::join(&server.join_url)?;
    let before_joining = probe.pts_after(3 * clips::GOP)?;
    let mut late = viewer("late")?;
    for viewer in [&mut early, &mut late] {
        let status = viewer.wait_for_exit(LONG)?;
        ensure!(status.success(), "viewer ended with {status}:\n{}", viewer.output());
        ensure!(viewer.output().contains("track asset: 1 frames"), "the model did not come:\n{}", viewer.output());
    }
    server.program.finish(LONG)?;

    let sent = Samples::load(&sandbox.path("server.csv"))?;
    let first_sent = sent.column("pts_us")?.into_iter().flatten().next().context("nothing was sent")?;
    // The newest keyframe is at most one GOP old.
    for (name, joined_at) in [("early", first_sent), ("late", before_joining as f64)] {
        let stats = Samples::load(&sandbox.path(&format!("{name}.csv")))?;
        let first_shown = stats.column("pts_us")?.into_iter().flatten().next().context("nothing was shown")?;
        ensure!(first_shown >= joined_at - clips::GOP_US as f64, "{name} joined at {joined_at} and was shown {first_shown} first");
        every_picture_has_its_own_light(&stats)?;
        the_red_ball_stands_in_the_grey_place(&sandbox, name)?;
    }
    light_keeps_to_its_budget(&sent)
}

/// What is shown is one frame's picture under the same frame's light.
fn every_picture_has_its_own_light(stats: &Samples) -> Result<()> {
    let (pictures, lights) = (stats.column("pts_us")?, stats.column("light_pts_us")?);
    ensure!(!pictures.is_empty() && pictures.iter().all(Option::is_some), "a row without a picture");
    ensure!(pictures == lights, "pictures {pictures:?} were shown under the light of {lights:?}");
    Ok(())
}

/// At most 200 bytes a frame with up to 4 lights, and under 1 % of the video's bits.
fn light_keeps_to_its_budget(sent: &Samples) -> Result<()> {
    let (mut light_bytes, mut video_bytes) = (0.0, 0.0);
    let rows = sent.column("lights")?.into_iter().zip(sent.column("light_bytes")?).zip(sent.column("video_bytes")?);
    for ((lights, light), video) in rows {
        // Only frames with light count: when the server ends, the newest may still be without.
        let (Some(lights), Some(light), Some(video)) = (lights, light, video) else { continue };
        ensure!(lights > 4.0 || light <= 200.0, "{lights} lights took {light} bytes");
        light_bytes += light;
        video_bytes += video;
    }
    ensure!(light_bytes > 0.0 && light_bytes < 0.01 * video_bytes, "{light_bytes} bytes of light beside {video_bytes} of video");
    Ok(())
}

/// The clip has no colour at all, so red in the middle of the picture is the ball; at the upper edge there is nothing but the place.
fn the_red_ball_stands_in_the_grey_place(sandbox: &Sandbox, name: &str) -> Result<()> {
    let picture = image::open(sandbox.path(&format!("{name}.png")))?.into_rgb8();
    let (width, height) = picture.dimensions();
    let ball = picture.get_pixel(width / 2, height / 2).0.map(i32::from);
    ensure!(ball[0] > ball[1] + 20 && ball[0] > ball[2] + 20, "{name}: no red ball but {ball:?}");
    for x in [2, width / 4, width - 3] {
        let place = picture.get_pixel(x, 2).0.map(i32::from);
        ensure!(place.iter().all(|&channel| channel > 20), "{name}: black at {x}, 2: {place:?}");
        // Chroma of 128 comes back as grey to within a code or two of each conversion.
        ensure!(place.iter().max().zip(place.iter().min()).is_some_and(|(max, min)| max - min <= 8), "{name}: colour at {x}, 2: {place:?}");
    }
    Ok(())
}
