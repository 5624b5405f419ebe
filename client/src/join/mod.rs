//! `mr360-client join`: receive ─► decode ─► sync ─► environment ─► view ─► present.

mod args;
mod arrivals;
mod inbox;
mod live_stage;
mod standing;
#[cfg(test)]
mod tests;

pub use args::{JoinArgs, Mode};
pub use live_stage::LiveStage;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use mr360_protocol::scene::Action;
use mr360_protocol::stop::asked_to_stop;

use crate::Failure;
use crate::camera::Camera;
use crate::decode::VideoDecoder;
use crate::frame_loop::{BoxError, FrameLoop, Inputs};
use crate::gpu::{self, Gpu};
use crate::headless::{self, Files, Graphics};
use crate::receive::{Receiver as Network, User};
use crate::stats::Stats;
use crate::sync::ClientClock;
use crate::view;
use crate::window::{self, UserAction, WindowError, WindowGraphics};
use crate::xr::{self, EyeRecorder, XrError};
use args::{DISPLAY_MHZ, HEADSET_MHZ, Settings};
use arrivals::Arrivals;
use inbox::Inbox;
use live_stage::SharedScene;
use standing::Standing;

/// Joins a broadcast and presents it until the user, a limit, or the broadcast's end.
///
/// # Errors
/// [`Failure::Input`] for a wrong URL or setting and a file that cannot be created, [`Failure::Running`] for everything that ends a run
/// later. A run that has shown nothing and was not ended by the user has failed, too.
pub fn run(args: JoinArgs) -> Result<(), Failure> {
    let settings = args.settle().map_err(Failure::Input)?;
    let stats = Stats::open(settings.stats.as_deref(), &view::PASSES).map_err(|error| Failure::Input(error.into()))?;
    let outputs = Outputs { files: settings.files()?, eyes: settings.eyes()? };
    present(&settings, stats, outputs).map_err(Failure::Running)
}

/// What a run writes.
struct Outputs {
    files: Files,
    eyes: Option<EyeRecorder>,
}

fn present(settings: &Settings, stats: Stats, outputs: Outputs) -> anyhow::Result<()> {
    let clock = ClientClock::start();
    stop_on_signal(Arc::clone(&settings.stop))?;
    let (network, events) = Network::start(settings.network.clone(), clock)?;
    let user = network.user();
    let (decoder, pictures) = VideoDecoder::start(clock, settings.hardware)?;
    let (sender, arrivals) = Arrivals::new();
    let (dropped, standing) = (sender.dropped(), Standing::new());
    let scene = SharedScene::default();
    let audio = crate::audio::AudioTimeline::default();
    let inputs = Inputs { pictures, arrivals, decoder: decoder.counters(), audio: Some(audio.clone()) };
    let inbox = Inbox::new(decoder, sender, scene.clone(), standing.clone(), settings.wants_sound().then_some(audio), clock);
    let end = Arc::new(Mutex::new(None));
    inbox.spawn(events, Arc::clone(&end), Arc::clone(&settings.stop))?;

    let mut frames = FrameLoop::new(inputs, clock, stats);
    let shown = match settings.mode {
        Mode::Xr => in_headset(&mut frames, settings, outputs.eyes, &scene, &user),
        Mode::Window => in_window(&mut frames, settings, &scene, &user),
        Mode::Headless => to_file(&mut frames, settings, outputs.files, &scene),
    };
    drop(network);
    let presented = frames.frames();
    let summary = frames.into_stats().finish()?;
    eprintln!("{summary}");
    if let Some(error) = end.lock().unwrap_or_else(PoisonError::into_inner).take() {
        return Err(error);
    }
    match dropped.load(Ordering::Relaxed) {
        0 => {}
        dropped => tracing::warn!(dropped, "lights and counts of bytes were dropped while the frame loop stood still"),
    }
    standing.judge(shown, presented, settings.stop.load(Ordering::Relaxed))
}

fn in_headset(
    frames: &mut FrameLoop,
    settings: &Settings,
    eyes: Option<EyeRecorder>,
    scene: &SharedScene,
    user: &User,
) -> anyhow::Result<()> {
    let mut open = |gpu: Gpu| -> Result<LiveStage, BoxError> {
        Ok(settings.stage(LiveStage::new(gpu, scene.clone(), settings.governor(Some(HEADSET_MHZ)))?))
    };
    let surroundings = xr::Surroundings { open: &mut open, ground_y: &|| scene.ground_y(), act: &mut |_hands, _stage| [None, None], eyes };
    match xr::run(frames, &settings.headset(), surroundings) {
        Err(error @ XrError::NoHeadset { .. }) => {
            tracing::warn!("{error}; going on in a window");
            in_window(frames, settings, scene, user)
        }
        result => result.map(drop).map_err(Into::into),
    }
}

fn in_window(frames: &mut FrameLoop, settings: &Settings, scene: &SharedScene, user: &User) -> anyhow::Result<()> {
    let mut open = |window: Arc<winit::window::Window>| -> Result<WindowGraphics<LiveStage>, BoxError> {
        let display_mhz = window.current_monitor().and_then(|monitor| monitor.refresh_rate_millihertz()).unwrap_or(DISPLAY_MHZ);
        let governor = settings.governor(Some(display_mhz));
        let instance = gpu::vulkan_instance();
        let surface = instance.create_surface(window)?;
        let gpu = Gpu::new(instance, Some(&surface))?;
        let (adapter, device, queue) = (gpu.adapter.clone(), gpu.device.clone(), gpu.queue.clone());
        let stage = settings.stage(LiveStage::new(gpu, scene.clone(), governor)?.with_parallax(settings.parallax));
        Ok(WindowGraphics { surface, adapter, device, queue, stage })
    };
    let mut act = |action| {
        let wish = match action {
            UserAction::Grab(id) => Action::Grab(id),
            UserAction::Release(id) => Action::Release(id),
            UserAction::Move(id, position) => match scene.moved_to(id, position) {
                Some(transform) => Action::Move(id, transform),
                None => return,
            },
        };
        user.wish(wish);
    };
    match window::run(frames, &settings.window(), &mut open, &mut act) {
        Err(error @ WindowError::NoDisplay { .. }) => {
            tracing::warn!("{error}; going on headless");
            // Nothing is written from a window, nor from what takes its place.
            to_file(frames, settings, Files::default(), scene)
        }
        result => result.map(drop).map_err(Into::into),
    }
}

fn to_file(frames: &mut FrameLoop, settings: &Settings, files: Files, scene: &SharedScene) -> anyhow::Result<()> {
    let mut open = || -> Result<Graphics<LiveStage>, BoxError> {
        let gpu = Gpu::headless()?;
        let (device, queue) = (gpu.device.clone(), gpu.queue.clone());
        let stage = settings.stage(LiveStage::new(gpu, scene.clone(), settings.governor(None))?.with_parallax(settings.parallax));
        Ok(Graphics { device, queue, stage })
    };
    let camera: Camera = settings.camera;
    let report = headless::run(frames, &settings.headless(), files, &mut open, &mut |_| camera)?;
    match report.recording {
        Some(Ok(recording)) => tracing::info!(frames = recording.frames, dropped = recording.dropped, "recording written"),
        Some(Err(error)) => return Err(error.into()),
        None => {}
    }
    if let Some(path) = &settings.snapshot {
        tracing::info!(path = %path.display(), "snapshot written");
    }
    Ok(())
}

/// Ctrl-C or a termination request ends the run in order: recordings are closed, the summary is printed.
fn stop_on_signal(stop: Arc<AtomicBool>) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build()?;
    std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
        runtime.block_on(asked_to_stop());
        stop.store(true, Ordering::Relaxed);
    })?;
    Ok(())
}
