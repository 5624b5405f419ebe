//! Presents to nobody: into a texture that is read back for recordings and snapshots.

mod offscreen;
mod recording_time;
#[cfg(test)]
pub(crate) mod tests;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use mr360_protocol::clock::ClientTime;

pub use self::offscreen::Offscreen;

use self::recording_time::RecordingTime;
use crate::camera::Camera;
use crate::frame_loop::{BoxError, FrameError, FrameLoop, PictureTime, Presented, Presenter, Redraw, Shot, Stage};
use crate::record::{PictureFile, RecordError, RecordReport, Recorder};

/// Lost devices in a row after which the run ends.
const MAX_REOPENS: u32 = 3;

/// How often to draw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// Every picture once.
    Video,
    /// So many frames a second, whatever the video does; above 0.
    Fixed(f64),
}

/// What to present, and when to stop.
#[derive(Debug, Clone)]
pub struct HeadlessOptions {
    /// Columns, at least 1.
    pub width: u32,
    /// Rows, at least 1.
    pub height: u32,
    /// How often to draw.
    pub pace: Pace,
    /// Stops after so many frames.
    pub frames: Option<u64>,
    /// Stops after so long.
    pub duration: Option<Duration>,
    /// Stops when set, as by Ctrl-C.
    pub stop: Arc<AtomicBool>,
}

/// Files that a run fills, of the frames' size.
#[derive(Default)]
pub struct Files {
    /// Takes every frame.
    pub recorder: Option<Recorder>,
    /// Takes the last frame.
    pub snapshot: Option<PictureFile>,
}

/// An open GPU with its renderer.
pub struct Graphics<S> {
    /// The device.
    pub device: wgpu::Device,
    /// Its queue.
    pub queue: wgpu::Queue,
    /// The renderer.
    pub stage: S,
}

/// What a run came to.
#[derive(Debug)]
pub struct HeadlessReport {
    /// Frames presented.
    pub frames: u64,
    /// The recording, or why it ended early; `None` when none was asked for.
    pub recording: Option<Result<RecordReport, RecordError>>,
}

/// Why a run failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HeadlessError {
    /// The GPU could not be opened.
    #[error("the GPU cannot be opened: {0}")]
    Open(BoxError),
    /// A frame could not be drawn.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The snapshot could not be written.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A pace of no frames.
    #[error("a pace of {0} frames/s is not possible; give a number above 0")]
    Pace(f64),
    /// There is nothing to take a snapshot of.
    #[error("no picture came while the program ran, so there is no snapshot; check that the source sends, or run longer")]
    NoPicture,
}

/// Opens the GPU, and again when it was lost.
pub type Open<'a, S> = dyn FnMut() -> Result<Graphics<S>, BoxError> + 'a;

/// Presents frames until an end of `options` is reached or the stream ends. `camera` is asked before every frame, with the time since
/// the run began.
///
/// # Errors
/// [`HeadlessError`]. A recording that ends early, or at once, as by a full disk, is no error: it is logged and reported.
pub fn run<S: Stage>(
    frames: &mut FrameLoop,
    options: &HeadlessOptions,
    files: Files,
    open: &mut Open<'_, S>,
    camera: &mut dyn FnMut(Duration) -> Camera,
) -> Result<HeadlessReport, HeadlessError> {
    let period_us = match options.pace {
        Pace::Video => None,
        Pace::Fixed(fps) if fps.is_finite() && fps > 0.0 => Some((1e6 / fps).max(1.0)),
        Pace::Fixed(fps) => return Err(HeadlessError::Pace(fps)),
    };
    let mut graphics = open().map_err(HeadlessError::Open)?;
    let mut presenter = ToFile::new(&graphics, options, files);
    let mut reopened = 0;
    let begin = frames.clock().now();
    let first_frame = frames.frames();
    let mut ticks = 0_u64;
    loop {
        let elapsed = Duration::from_micros(frames.clock().now().0.saturating_sub(begin.0));
        let done = frames.frames() - first_frame;
        let over = options.frames.is_some_and(|most| done >= most) || options.duration.is_some_and(|most| elapsed >= most);
        if over || options.stop.load(Ordering::Relaxed) {
            break;
        }
        let tick = period_us.map(|period| ClientTime(begin.0 + (ticks as f64 * period) as u64));
        let drawing = tick.is_none_or(|tick| frames.clock().now() >= tick);
        if !drawing {
            frames.rest(tick);
            continue;
        }
        let redraw = if tick.is_some() { Redraw::Always } else { Redraw::OnPicture };
        presenter.tick_us = tick.map(|tick| tick.0);
        match frames.turn(&mut graphics.stage, &mut presenter, &camera(elapsed), redraw) {
            Ok(turn) if turn.ended => break,
            Ok(turn) => {
                if turn.presented {
                    reopened = 0;
                }
                ticks = next_tick(ticks, elapsed, period_us);
            }
            Err(FrameError::DeviceLost { detail }) if reopened < MAX_REOPENS => {
                reopened += 1;
                tracing::warn!(attempt = reopened, "the GPU device was lost ({detail}); opening it anew");
                frames.device_lost();
                graphics = open().map_err(HeadlessError::Open)?;
                presenter.offscreen = Offscreen::new(&graphics.device, &graphics.queue, options.width, options.height);
            }
            Err(error) => return Err(error.into()),
        }
        if tick.is_none() {
            frames.rest(None);
        }
    }
    finish(presenter, options, frames.frames() - first_frame)
}

/// The tick after this one that is not over yet: a slow renderer leaves ticks out instead of falling behind.
fn next_tick(tick: u64, elapsed: Duration, period_us: Option<f64>) -> u64 {
    let Some(period) = period_us else { return 0 };
    (tick + 1).max((elapsed.as_micros() as f64 / period) as u64)
}

fn finish(mut presenter: ToFile, options: &HeadlessOptions, frames: u64) -> Result<HeadlessReport, HeadlessError> {
    // Closed first: a snapshot that fails must not cost the recording its end.
    let recording = presenter.recorder.take().map(Recorder::finish);
    if let Some(snapshot) = presenter.snapshot.take() {
        if !presenter.drawn {
            return Err(HeadlessError::NoPicture);
        }
        let (width, height) = (options.width, options.height);
        let texels = presenter.offscreen.read()?.to_vec();
        let got = texels.len();
        let picture = image::RgbaImage::from_raw(width, height, texels).ok_or(RecordError::FrameSize { got, width, height })?;
        snapshot.write(&picture.into())?;
    }
    Ok(HeadlessReport { frames, recording })
}

/// The presenter: waits for the GPU, and reads back for the recording.
struct ToFile {
    offscreen: Offscreen,
    recorder: Option<Recorder>,
    snapshot: Option<PictureFile>,
    time: RecordingTime,
    tick_us: Option<u64>,
    drawn: bool,
}

impl ToFile {
    fn new<S>(graphics: &Graphics<S>, options: &HeadlessOptions, files: Files) -> Self {
        let offscreen = Offscreen::new(&graphics.device, &graphics.queue, options.width, options.height);
        let Files { recorder, snapshot } = files;
        Self { offscreen, recorder, snapshot, time: RecordingTime::default(), tick_us: None, drawn: false }
    }
}

impl Presenter for ToFile {
    fn acquire(&mut self, camera: &Camera) -> Result<Option<Vec<Shot>>, FrameError> {
        Ok(Some(vec![Shot { camera: *camera, target: self.offscreen.target() }]))
    }

    fn present(&mut self, shown: PictureTime, now: ClientTime) -> Result<Presented, FrameError> {
        self.drawn = true;
        let waited = Presented { gpu_waits: 1, headset: None };
        let Some(recorder) = self.recorder.as_mut().filter(|recorder| !recorder.has_failed()) else {
            return self.offscreen.wait().map(|()| waited);
        };
        let time_us = self.tick_us.unwrap_or_else(|| self.time.of(shown, now));
        let texels = self.offscreen.read()?;
        recorder.push(time_us, texels).map_err(|error| FrameError::Failed { action: "recording", source: error.into() })?;
        Ok(waited)
    }
}
