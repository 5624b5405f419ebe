//! Flags of `join`.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use mr360_protocol::join::JoinUrl;

use crate::Failure;
use crate::arguments::{parse_angle, parse_fov, parse_size, parse_tier};
use crate::camera::Camera;
use crate::decode::Hardware;
use crate::frame_loop::Stage;
use crate::governor::{Governor, Tier};
use crate::headless::{Files, HeadlessOptions, Pace};
use crate::receive;
use crate::record::{PictureFile, RecordError, Recorder};
use crate::script::{self, Deed, ScriptError};
use crate::view::{Parallax, Resampling};
use crate::viewpoint::Viewpoint;
use crate::window::WindowOptions;
use crate::xr::{EyeRecorder, XrOptions};

/// A display whose rate is not known, in thousandths of a frame a second.
pub(super) const DISPLAY_MHZ: u32 = 60_000;

/// A headset's display, in thousandths of a frame a second.
pub(super) const HEADSET_MHZ: u32 = 90_000;

/// Where to present.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Mode {
    /// In a headset, through the system's OpenXR runtime; in a window where there is none.
    Xr,
    /// In a window; headless where there is no display.
    Window,
    /// Nowhere, or into files.
    Headless,
}

/// Join a live broadcast.
#[derive(Debug, Clone, Args)]
pub struct JoinArgs {
    /// Join URL, as mr360-server prints it.
    pub url: String,
    /// Where to present [default: window, or headless with --record, --snapshot or --frames].
    #[arg(long, value_enum)]
    pub mode: Option<Mode>,
    /// Record to an MP4 file, headless.
    #[arg(long, value_name = "OUT.mp4")]
    pub record: Option<PathBuf>,
    /// Save the last picture, headless.
    #[arg(long, value_name = "OUT.png")]
    pub snapshot: Option<PathBuf>,
    /// Write one CSV row a frame.
    #[arg(long, value_name = "OUT.csv")]
    pub stats: Option<PathBuf>,
    /// Size of the picture or of the window.
    #[arg(long, value_name = "WxH", default_value = "1280x720", value_parser = parse_size)]
    pub size: (u32, u32),
    /// End after so many frames.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: Option<u64>,
    /// End after so many seconds.
    #[arg(long, value_name = "SECONDS", value_parser = parse_seconds, allow_negative_numbers = true)]
    pub duration: Option<Duration>,
    /// Frames a second, headless [default: every picture of the video].
    #[arg(long, value_name = "N", value_parser = parse_fps, allow_negative_numbers = true)]
    pub fps: Option<f64>,
    /// Vertical field of view, headless.
    #[arg(long, value_name = "DEGREES", default_value_t = 75.0, value_parser = parse_fov, allow_negative_numbers = true)]
    pub fov_y_deg: f32,
    /// Look left of the panorama's centre, headless.
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0, value_parser = parse_angle, allow_negative_numbers = true)]
    pub yaw_deg: f32,
    /// Look up, headless.
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0, value_parser = parse_angle, allow_negative_numbers = true)]
    pub pitch_deg: f32,
    /// Look as a view did that --record-eyes wrote, headless: from its place, and up to its edges.
    #[arg(long, value_name = "VIEW.json", conflicts_with_all = ["fov_y_deg", "yaw_deg", "pitch_deg"])]
    pub view: Option<PathBuf>,
    /// Keep what the eyes saw, in a headset: once a second both pictures and, in frames.jsonl, from where.
    #[arg(long, value_name = "FOLDER")]
    pub record_eyes: Option<PathBuf>,
    /// What to leave out of frames: 0 nothing, 4 all that can be, or auto, as much as keeps up with the display [default: 0 headless, else
    /// auto].
    #[arg(long, value_name = "N", value_parser = parse_tier_choice)]
    pub tier: Option<TierChoice>,
    /// Distance of the background of mono video, for eyes beside the camera that filmed: infinity, ground (ground and place where they are,
    /// all else on a dome of 50 m), or ground:RADIUS.
    #[arg(long, default_value = "ground", value_name = "SETTING")]
    pub parallax: Parallax,
    /// How the video is resampled: plainly, finely, or finely where the GPU is one (auto).
    #[arg(long, value_enum, default_value_t = Resampling::Auto)]
    pub resampling: Resampling,
    /// Show what a frame costs over the view, as F1 does in a window.
    #[arg(long)]
    pub overlay: bool,
    /// Decode in software, even where the GPU could.
    #[arg(long)]
    pub software_decoding: bool,
    /// No sound.
    #[arg(long)]
    pub mute: bool,
    /// Record what the user does to the scene, one JSON object a line.
    #[arg(long, value_name = "OUT.jsonl")]
    pub record_input: Option<PathBuf>,
    /// Do what was recorded, from the first picture on.
    #[arg(long, value_name = "FILE.jsonl")]
    pub replay_input: Option<PathBuf>,
    /// Name in the session, 1 to 64 of a-z A-Z 0-9 - _ [default: a random one].
    #[arg(long, value_name = "NAME")]
    pub user: Option<String>,
}

/// Who chooses the tier.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TierChoice {
    /// The governor.
    Auto,
    /// The user.
    Fixed(Tier),
}

/// What holds, checked.
#[derive(Clone)]
pub(super) struct Settings {
    pub(super) network: receive::Config,
    pub(super) mode: Mode,
    record: Option<PathBuf>,
    pub(super) snapshot: Option<PathBuf>,
    pub(super) stats: Option<PathBuf>,
    record_eyes: Option<PathBuf>,
    pub(super) camera: Camera,
    pub(super) hardware: Hardware,
    pub(super) stop: Arc<AtomicBool>,
    size: (u32, u32),
    frames: Option<u64>,
    duration: Option<Duration>,
    /// When presenting began.
    begin: Option<Instant>,
    pace: Pace,
    overlay: bool,
    pub(super) parallax: Parallax,
    pub(super) resampling: Resampling,
    tier: Option<TierChoice>,
    mute: bool,
    record_input: Option<PathBuf>,
    replay_input: Option<PathBuf>,
}

impl JoinArgs {
    pub(super) fn settle(self) -> anyhow::Result<Settings> {
        let join: JoinUrl = self.url.parse()?;
        let to_file = self.record.is_some() || self.snapshot.is_some();
        let mode = self.mode.unwrap_or(if to_file || self.frames.is_some() { Mode::Headless } else { Mode::Window });
        if mode != Mode::Headless && to_file {
            bail!("--record and --snapshot go with --mode headless");
        }
        if mode != Mode::Headless && self.view.is_some() {
            bail!("--view goes with --mode headless: elsewhere the user looks around");
        }
        if mode != Mode::Xr && self.record_eyes.is_some() {
            bail!("--record-eyes goes with --mode xr");
        }
        let camera = match &self.view {
            Some(path) => Viewpoint::load(path)?,
            None => Camera::looking(self.yaw_deg.to_radians(), self.pitch_deg.to_radians(), self.fov_y_deg.to_radians()),
        };
        let user = self.user.unwrap_or_else(|| format!("viewer-{:08x}", std::process::id() ^ random()));
        if !mr360_protocol::track::is_valid_room(&user) {
            bail!("--user {user:?}: not 1 to 64 of a-z A-Z 0-9 - _");
        }
        let folders = directories::ProjectDirs::from("", "", "mr360").context("no home folder for the cache; set HOME")?;
        Ok(Settings {
            network: receive::Config { join, cache: folders.cache_dir().join("assets"), user },
            mode,
            record: self.record,
            snapshot: self.snapshot,
            stats: self.stats,
            record_eyes: self.record_eyes,
            camera,
            hardware: if self.software_decoding { Hardware::Never } else { Hardware::Prefer },
            stop: Arc::default(),
            size: self.size,
            frames: self.frames,
            duration: self.duration,
            begin: None,
            pace: self.fps.map_or(Pace::Video, Pace::Fixed),
            overlay: self.overlay,
            parallax: self.parallax,
            resampling: self.resampling,
            tier: self.tier,
            mute: self.mute,
            record_input: self.record_input,
            replay_input: self.replay_input,
        })
    }
}

impl Settings {
    pub(super) fn wants_sound(&self) -> bool {
        self.mode != Mode::Headless && !self.mute
    }

    /// For a display that shows so many frames in 1,000 seconds, or for a file.
    pub(super) fn governor(&self, display_mhz: Option<u32>) -> Governor {
        let file_mhz = match self.pace {
            Pace::Fixed(fps) => (fps * 1e3) as u32,
            Pace::Video => DISPLAY_MHZ,
        };
        let automatic = |mhz: u32| Governor::automatic(u32::try_from(1_000_000_000 / u64::from(mhz.max(1))).unwrap_or(u32::MAX));
        match (self.tier, display_mhz) {
            (Some(TierChoice::Fixed(tier)), _) => Governor::fixed(tier),
            (None, None) => Governor::fixed(Tier::FULL),
            (_, Some(display)) => automatic(display),
            (Some(TierChoice::Auto), None) => automatic(file_mhz),
        }
    }

    /// As the user wants it to begin.
    pub(super) fn stage<S: Stage>(&self, mut stage: S) -> S {
        if self.overlay {
            stage.toggle_overlay();
        }
        stage
    }

    /// Presenting begins.
    pub(super) fn begin(&mut self, now: Instant) {
        self.begin = Some(now);
    }

    /// How many frames are left of the limit, and how long, when so many have been presented: where one presenter takes another one's place
    /// the limits go on.
    fn left(&self, presented: u64) -> (Option<u64>, Option<Duration>) {
        let elapsed = self.begin.map_or(Duration::ZERO, |begin| begin.elapsed());
        (self.frames.map(|frames| frames.saturating_sub(presented)), self.duration.map(|duration| duration.saturating_sub(elapsed)))
    }

    pub(super) fn headless(&self, presented: u64) -> HeadlessOptions {
        let (frames, duration) = self.left(presented);
        HeadlessOptions { width: self.size.0, height: self.size.1, pace: self.pace, frames, duration, stop: Arc::clone(&self.stop) }
    }

    /// Creates what is to be written, so that a wrong path is known before anything is joined.
    pub(super) fn files(&self) -> Result<Files, Failure> {
        let named = |error| match error {
            RecordError::NoEncoder | RecordError::Thread { .. } => Failure::Running(anyhow::Error::from(error)),
            error => Failure::Input(error.into()),
        };
        let snapshot = self.snapshot.as_deref().map(|path| PictureFile::create(path, image::ImageFormat::Png));
        let snapshot = snapshot.transpose().map_err(named)?;
        let recorder = self.record.as_deref().map(|path| Recorder::start(path, self.size.0, self.size.1));
        Ok(Files { recorder: recorder.transpose().map_err(named)?, snapshot })
    }

    /// Creates what keeps the eyes' pictures, as [`Settings::files`] does.
    pub(super) fn eyes(&self) -> Result<Option<EyeRecorder>, Failure> {
        self.record_eyes.as_deref().map(EyeRecorder::start).transpose().map_err(Failure::Input)
    }

    pub(super) fn headset(&self, presented: u64) -> XrOptions {
        let (frames, duration) = self.left(presented);
        XrOptions { frames, duration, stop: Arc::clone(&self.stop) }
    }

    /// What is to be done, and where to write what the user does, checked before anything is joined.
    pub(super) fn scripts(&self) -> Result<(Option<Vec<Deed>>, Option<script::Recorder>), Failure> {
        let input = |error: ScriptError| Failure::Input(error.into());
        let deeds = self.replay_input.as_deref().map(script::load).transpose().map_err(input)?;
        let recorder = self.record_input.as_deref().map(script::Recorder::create).transpose().map_err(input)?;
        Ok((deeds, recorder))
    }

    pub(super) fn window(&self, presented: u64) -> WindowOptions {
        let (frames, duration) = self.left(presented);
        WindowOptions {
            title: format!("MR360 live: {}", self.network.join.room),
            size: self.size,
            frames,
            duration,
            stop: Arc::clone(&self.stop),
        }
    }
}

/// Unpredictable enough to tell viewers apart, without a random number generator of our own.
fn random() -> u32 {
    use std::hash::{BuildHasher, Hasher};
    std::collections::hash_map::RandomState::new().build_hasher().finish() as u32
}

fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok().and_then(|seconds: f64| Duration::try_from_secs_f64(seconds).ok());
    seconds.filter(|seconds| !seconds.is_zero()).ok_or_else(|| "a duration is a number of seconds above 0".to_owned())
}

fn parse_tier_choice(text: &str) -> Result<TierChoice, String> {
    if text == "auto" { Ok(TierChoice::Auto) } else { parse_tier(text).map(TierChoice::Fixed).map_err(|fault| format!("{fault}, or auto")) }
}

fn parse_fps(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|fps: &f64| fps.is_finite() && *fps > 0.0).ok_or_else(|| "a rate is a number of frames above 0".to_owned())
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[test]
    fn a_tier_is_auto_or_a_number_and_nothing_else() {
        assert_eq!(parse_tier_choice("auto"), Ok(TierChoice::Auto));
        assert_eq!(parse_tier_choice("0"), Ok(TierChoice::Fixed(Tier::FULL)));
        assert_eq!(parse_tier_choice("4"), Ok(TierChoice::Fixed(Tier::LOWEST)));
        for wrong in ["5", "-1", "", "Auto"] {
            assert!(parse_tier_choice(wrong).unwrap_err().contains("0 to 4"), "{wrong}");
        }
    }

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        join: JoinArgs,
    }

    #[test]
    fn limits_go_on_where_one_presenter_takes_the_place_of_another() {
        let url = format!("https://127.0.0.1:1/#room=live,sha256={}", "ab".repeat(32));
        let line = ["join", &url, "--mode", "window", "--frames", "100", "--duration", "60"];
        let mut settings = Line::try_parse_from(line).unwrap().join.settle().unwrap();
        assert_eq!((settings.window(0).frames, settings.window(0).duration), (Some(100), Some(Duration::from_secs(60))));
        settings.begin(Instant::now().checked_sub(Duration::from_secs(25)).unwrap());
        let (frames, duration) = (settings.headless(30).frames, settings.headless(30).duration.unwrap());
        assert_eq!(frames, Some(70));
        assert!(duration <= Duration::from_secs(35), "{duration:?}");
        assert_eq!(settings.window(101).frames, Some(0));
    }
}
