//! `mr360-client join`: receive ─► decode ─► sync ─► environment ─► view ─► present.

mod args;
mod arrivals;
mod inbox;
mod live_stage;
mod shared_scene;
mod standing;
#[cfg(test)]
mod tests;
mod wishes;

pub use args::{JoinArgs, Mode};
pub use live_stage::LiveStage;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use mr360_protocol::failure::say;
use mr360_protocol::intent::Action;
use mr360_protocol::stop::asked_to_stop;
use winit::event_loop::EventLoop;

use crate::Failure;
use crate::camera::Camera;
use crate::decode::VideoDecoder;
use crate::frame_loop::{BoxError, FrameLoop, Inputs};
use crate::gpu::{self, Gpu};
use crate::headless::{self, Files, Graphics};
use crate::receive::Receiver as Network;
use crate::script::{self, Deed, Player};
use crate::stats::Stats;
use crate::sync::ClientClock;
use crate::view;
use crate::window::{self, WindowError, WindowGraphics};
use crate::xr::{self, EyeRecorder, Spectator, XrError};
use args::{DISPLAY_MHZ, HEADSET_MHZ, Settings};
use arrivals::Arrivals;
use inbox::Inbox;
use shared_scene::SharedScene;
use standing::Standing;
use wishes::wishes;

/// Joins a broadcast and presents it until the user, a limit, or the broadcast's end.
///
/// # Errors
/// [`Failure::Input`] for a wrong URL or setting and a file that cannot be created, [`Failure::Running`] for everything that ends a run
/// later. A run that has shown nothing and was not ended by the user has failed, too.
pub fn run(args: JoinArgs) -> Result<(), Failure> {
    let settings = args.settle().map_err(Failure::Input)?;
    let stats = Stats::open(settings.stats.as_deref(), &view::PASSES).map_err(|error| Failure::Input(error.into()))?;
    let scripts = settings.scripts()?;
    let outputs = Outputs { files: settings.files()?, eyes: settings.eyes()? };
    present(&settings, stats, outputs, scripts).map_err(Failure::Running)
}

/// What a run writes.
struct Outputs {
    files: Files,
    eyes: Option<EyeRecorder>,
}

/// What is to be done, and where to write what the user does.
type Scripts = (Option<Vec<Deed>>, Option<script::Recorder>);

fn present(settings: &Settings, stats: Stats, outputs: Outputs, (deeds, recorder): Scripts) -> anyhow::Result<()> {
    let clock = ClientClock::start();
    stop_on_signal(Arc::clone(&settings.stop))?;
    let (network, events) = Network::start(settings.network.clone(), clock)?;
    let user = network.user();
    let (decoder, pictures) = VideoDecoder::start(clock, settings.hardware)?;
    let (sender, arrivals) = Arrivals::new();
    let (dropped, standing) = (sender.dropped(), Standing::new());
    let scene = SharedScene::new(clock);
    let audio = crate::audio::AudioTimeline::default();
    let inputs = Inputs { pictures, arrivals, decoder: decoder.counters(), audio: Some(audio.clone()) };
    let inbox = Inbox::new(decoder, sender, scene.clone(), standing.clone(), settings.wants_sound().then_some(audio), clock);
    let end = Arc::new(Mutex::new(None));
    inbox.spawn(events, Arc::clone(&end), Arc::clone(&settings.stop))?;

    let mut frames = FrameLoop::new(inputs, clock, stats);
    let mut act = wishes(move |action| user.wish(action), recorder, scene.clone(), move || clock.now());
    if let Some(deeds) = deeds {
        frames.play(Player::new(deeds, Box::new(act.clone())));
    }
    // Limits count from here on, through whatever has to be presented in.
    let mut settings = settings.clone();
    settings.begin(Instant::now());
    let settings = &settings;
    let shown = match settings.mode {
        Mode::Xr => in_headset(&mut frames, settings, outputs.eyes, &scene, &mut act),
        Mode::Window => in_window(&mut frames, settings, &scene, &mut act, None),
        Mode::Headless => to_file(&mut frames, settings, outputs.files, &scene),
    };
    drop(network);
    let presented = frames.frames();
    let summary = frames.into_stats().finish()?;
    say(summary);
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
    act: &mut dyn FnMut(Action),
) -> anyhow::Result<()> {
    let mut open = |gpu: Gpu| -> Result<LiveStage, BoxError> {
        let stage = LiveStage::new(gpu, scene.clone(), settings.governor(Some(HEADSET_MHZ)))?;
        Ok(settings.stage(stage.with_background(settings.parallax, settings.resampling)))
    };
    let mut spectator = Spectator::new(&settings.window(frames.frames()))
        .inspect_err(|error| tracing::debug!("no window mirrors the headset: {error}"))
        .ok();
    let surroundings = xr::Surroundings { open: &mut open, act: &mut *act, eyes, spectator: spectator.as_mut() };
    match xr::run(frames, &settings.headset(frames.frames()), surroundings) {
        Err(error @ XrError::NoHeadset { .. }) => {
            tracing::warn!("{error}; going on in a window");
            in_window(frames, settings, scene, act, spectator.map(Spectator::into_event_loop))
        }
        result => result.map(drop).map_err(Into::into),
    }
}

fn in_window(
    frames: &mut FrameLoop,
    settings: &Settings,
    scene: &SharedScene,
    act: &mut dyn FnMut(Action),
    events: Option<EventLoop<()>>,
) -> anyhow::Result<()> {
    let mut open = |window: Arc<winit::window::Window>| -> Result<WindowGraphics<LiveStage>, BoxError> {
        let display_mhz = window.current_monitor().and_then(|monitor| monitor.refresh_rate_millihertz()).unwrap_or(DISPLAY_MHZ);
        let governor = settings.governor(Some(display_mhz));
        let instance = gpu::vulkan_instance();
        let surface = instance.create_surface(window)?;
        let gpu = Gpu::new(instance, Some(&surface))?;
        let (adapter, device, queue) = (gpu.adapter.clone(), gpu.device.clone(), gpu.queue.clone());
        let stage = settings.stage(LiveStage::new(gpu, scene.clone(), governor)?.with_background(settings.parallax, settings.resampling));
        Ok(WindowGraphics { surface, adapter, device, queue, stage })
    };
    match window::run(frames, &settings.window(frames.frames()), &mut open, act, events) {
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
        let stage = settings
            .stage(LiveStage::new(gpu, scene.clone(), settings.governor(None))?.with_background(settings.parallax, settings.resampling));
        Ok(Graphics { device, queue, stage })
    };
    let camera: Camera = settings.camera;
    let report = headless::run(frames, &settings.headless(frames.frames()), files, &mut open, &mut |_| camera)?;
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
