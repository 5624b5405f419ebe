//! The window on a display of its own (Xvfb), as its user sees it: what a frame costs and does, and its lights, over the view.

use std::process::Command;
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use image::RgbImage;
use mr360_tests::probe::LONG;
use mr360_tests::process::Program;
use mr360_tests::sandbox::Sandbox;
use mr360_tests::xr::{XrRuntime, kept_frames};

const SIZE: (u32, u32) = (640, 400);
/// The plaza's sun.
const SUN_ELEVATION_DEG: f64 = 40.0;
const SUN_AZIMUTH_DEG: f64 = 30.0;
/// Pixels of the window to one of the overlay, along a side; the overlay's map of the panorama begins here and is so large.
const SCALE: u32 = 2;
const MAP: [f64; 4] = [4.0, 4.0, 168.0, 84.0];
/// The overlay's letters that are looked for: five rows of three pixels from the top, an octal digit each, 4 the left one.
const LETTERS: [(char, u16); 21] = [
    ('A', 0o25755),
    ('B', 0o65656),
    ('C', 0o34443),
    ('D', 0o65556),
    ('E', 0o74647),
    ('F', 0o74644),
    ('G', 0o34553),
    ('H', 0o55755),
    ('I', 0o72227),
    ('J', 0o11152),
    ('L', 0o44447),
    ('M', 0o57755),
    ('O', 0o25552),
    ('P', 0o65644),
    ('R', 0o65655),
    ('S', 0o34216),
    ('T', 0o72222),
    ('W', 0o55775),
    ('1', 0o26227),
    ('2', 0o71747),
    ('4', 0o55711),
];

/// Starts a display and returns its name.
fn display() -> Result<(Program, String)> {
    let mut command = Command::new("Xvfb");
    let screen = format!("{}x{}x24", SIZE.0, SIZE.1);
    command.args(["-displayfd", "1", "-screen", "0", &screen, "-nolisten", "tcp"]);
    let program = Program::spawn("Xvfb", &mut command).context("the window test needs Xvfb; run deploy/setup")?;
    let number = program.wait_for("the display's number", LONG, |line| line.trim().parse::<u32>().ok())?;
    Ok((program, format!(":{number}")))
}

/// What the display shows.
fn shot(sandbox: &Sandbox, display: &str) -> Result<RgbImage> {
    let path = sandbox.path("shot.png");
    let size = format!("{}x{}", SIZE.0, SIZE.1);
    let mut command = Command::new("ffmpeg");
    command.args(["-hide_banner", "-nostdin", "-loglevel", "error", "-y", "-f", "x11grab", "-draw_mouse", "0", "-video_size", &size]);
    let output = command.args(["-i", display, "-frames:v", "1"]).arg(&path).output().context("ffmpeg does not start; run deploy/setup")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Ok(image::open(&path)?.into_rgb8())
}

/// True where a line of the overlay holds this text, in capitals.
fn says(shown: &RgbImage, text: &str) -> Result<bool> {
    let glyphs = text.chars().map(|letter| match letter {
        ' ' => Ok(0),
        _ => LETTERS
            .iter()
            .find(|(known, _)| *known == letter)
            .map(|(_, rows)| *rows)
            .with_context(|| format!("{letter:?} has no rows here")),
    });
    let glyphs = glyphs.collect::<Result<Vec<u16>>>()?;
    let inked = |x: u32, y: u32| shown.get_pixel_checked(x * SCALE, y * SCALE).is_some_and(|pixel| pixel.0.iter().all(|code| *code > 150));
    let begins = |x: u32, y: u32| {
        glyphs.iter().zip(0..).all(|(rows, at)| {
            (0..5).all(|row| (0..3).all(|column| inked(x + 4 * at + column, y + row) == (rows >> (3 * (4 - row) + 2 - column) & 1 == 1)))
        })
    };
    Ok((0..SIZE.1 / SCALE).any(|y| (0..SIZE.0 / SCALE).any(|x| begins(x, y))))
}

/// Brightness of the overlay's map so many of its pixels below a direction.
fn on_map(shown: &RgbImage, (azimuth_deg, elevation_deg): (f64, f64), below: f64) -> u8 {
    let x = MAP[0] + MAP[2] * (0.5 + azimuth_deg / 360.0);
    let y = MAP[1] + MAP[3] * (0.5 - elevation_deg / 180.0) + below;
    shown.get_pixel((x * f64::from(SCALE)) as u32, (y * f64::from(SCALE)) as u32).0.into_iter().max().unwrap_or_default()
}

/// What the window shows where it covers it with a picture of this size, mean difference of its codes.
fn off(shown: &RgbImage, picture: &RgbImage) -> f64 {
    let scale = (f64::from(SIZE.0) / f64::from(picture.width())).max(f64::from(SIZE.1) / f64::from(picture.height()));
    let cut = |side: u32, of: u32| 0.5 * (f64::from(of) * scale - f64::from(side));
    let (left, top) = (cut(SIZE.0, picture.width()), cut(SIZE.1, picture.height()));
    let mut sum = 0.0;
    for (x, y, pixel) in shown.enumerate_pixels() {
        let at = |place: u32, cut: f64, of: u32| (((f64::from(place) + 0.5 + cut) / scale) as u32).min(of - 1);
        let seen = picture.get_pixel(at(x, left, picture.width()), at(y, top, picture.height()));
        sum += f64::from(pixel.0[1].abs_diff(seen.0[1]));
    }
    sum / f64::from(SIZE.0 * SIZE.1)
}

#[test]
fn a_window_mirrors_the_left_eye_of_a_headset() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let (_display, name) = display()?;
    // So near that the eyes see it at different places.
    std::fs::write(
        sandbox.path("SCENE.toml"),
        "ground_y = -1.6\n[[object]]\nshape = \"sphere\"\nposition = [0.0, 0.0, -0.7]\nscale = 0.3\n",
    )?;
    let server = sandbox.serve("synthetic:plaza?size=512x256&movers=0", &["--listen", "127.0.0.1:0", "--scene", "SCENE.toml"])?;
    let mut runtime = XrRuntime::new(&sandbox, "xr")?;
    runtime.start()?;
    let size = format!("{}x{}", SIZE.0, SIZE.1);
    let folder = sandbox.path("eyes");
    let arguments = ["--mode", "xr", "--mute", "--size", &size, "--record-eyes", folder.to_str().context("path")?];
    let mut viewer = runtime.join_on_display(&sandbox, &name, &server.join_url, &arguments)?;
    for _ in 0..3 {
        viewer.wait_for_text("eyes kept", LONG)?;
        viewer.mark();
    }
    let last = kept_frames(&folder)?.pop().and_then(|frame| frame["frame"].as_u64()).context("no kept frame")?;
    let eye = |name: &str| -> Result<RgbImage> { Ok(image::open(folder.join(format!("{last:06}-{name}.png")))?.into_rgb8()) };
    let (left, right) = (eye("left")?, eye("right")?);
    let begin = Instant::now();
    // The display shows a frame some time after it was presented.
    loop {
        let shown = shot(&sandbox, &name)?;
        let (near, far) = (off(&shown, &left), off(&shown, &right));
        if near < 4.0 && 2.0 * near < far {
            break;
        }
        if begin.elapsed() > LONG || !viewer.is_running() {
            let kept = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("mirror.png");
            shown.save(&kept)?;
            bail!("{near} codes off the left eye, {far} off the right, see {}:\n{}", kept.display(), viewer.output());
        }
    }
    viewer.finish(LONG)
}

#[test]
fn the_overlay_tells_tier_times_of_stages_and_lights() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let (_display, name) = display()?;
    std::fs::write(sandbox.path("SCENE.toml"), "ground_y = -1.6\n[[object]]\nshape = \"sphere\"\nposition = [0.0, -1.1, -3.0]\n")?;
    let source = format!("synthetic:plaza?size=512x256&sun={SUN_ELEVATION_DEG}&azimuth={SUN_AZIMUTH_DEG}&movers=0");
    let server = sandbox.serve(&source, &["--listen", "127.0.0.1:0", "--scene", "SCENE.toml"])?;
    let mut command = sandbox.client_command()?;
    command.args([
        "join",
        &server.join_url,
        "--mode",
        "window",
        "--size",
        &format!("{}x{}", SIZE.0, SIZE.1),
        "--tier",
        "2",
        "--overlay",
        "--mute",
    ]);
    let mut viewer = Program::spawn("viewer", command.env("DISPLAY", &name).env_remove("WAYLAND_DISPLAY"))?;
    viewer.wait_for_text("first picture after", LONG)?;
    // Times of passes come two frames late, and the display shows a frame some time after it was presented.
    let begin = Instant::now();
    // For whoever wants to look at it.
    let kept = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("window.png");
    // Shadow maps are kept while nothing moves: their pass is not in every frame.
    let texts = ["TIER 2 OF 4", "LIGHTS 1", "SHADOWS 1", "OBJECTS", "COMPOSITE", "MS"];
    let shown = loop {
        let shown = shot(&sandbox, &name)?;
        let missing = texts.iter().map(|text| Ok((text, says(&shown, text)?))).collect::<Result<Vec<_>>>()?;
        match missing.into_iter().find(|(_, said)| !said) {
            None => break shown,
            Some((text, _)) if begin.elapsed() > LONG || !viewer.is_running() => {
                shown.save(&kept)?;
                bail!("the overlay does not say {text:?}, see {}:\n{}", kept.display(), viewer.output());
            }
            Some(_) => {}
        }
    };
    shown.save(&kept)?;
    let (sun, mirrored) = ((SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG), (-SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG));
    // Its arrow reaches down by more than eight pixels; its disc is at most six in radius.
    let [place, arrow, above, beside] = [(sun, 0.0), (sun, 8.0), (sun, -8.0), (mirrored, 0.0)].map(|(at, below)| on_map(&shown, at, below));
    ensure!(
        place > 200 && arrow > 200 && above < 150 && beside < 150,
        "brightness at the sun's place on the map {place}, of its arrow {arrow}, above {above}, at its mirror image {beside}"
    );
    // Beyond the overlay the view is shown: neither black nor of one colour.
    let view: Vec<u8> = (380..SIZE.0).map(|x| shown.get_pixel(x, SIZE.1 / 2).0[1]).collect();
    ensure!(view.iter().max() > view.iter().min() && view.iter().any(|code| *code > 20), "no view beside the overlay: {view:?}");
    viewer.finish(LONG)
}
