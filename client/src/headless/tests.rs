use std::sync::atomic::AtomicU64;
use std::sync::mpsc::channel;

use bytes::Bytes;
use glam::Vec3;
use mr360_protocol::intent::Action;
use mr360_protocol::light::{LightFrame, SH9};
use mr360_protocol::video::{Colour, StereoLayout};

use super::*;
use crate::decode::{DecodeCounters, Decoded, PictureReceiver, PictureSender, outbox};
use crate::frame_loop::{Arrival, Drawn, Inputs};
use crate::hands::{LocalObject, World};
use crate::picture::{Picture, Plane, Samples};
use crate::stats::{PassTime, Stats};
use crate::sync::{ClientClock, Paired, ReceivedLight};

/// Clears the target to the luma of the picture's first sample.
struct Clear {
    device: wgpu::Device,
    queue: wgpu::Queue,
    luma: u8,
    /// How often the light was moved on.
    relit: Arc<AtomicU64>,
    /// Pretends that the device is lost.
    lost: bool,
}

impl Stage for Clear {
    fn prepare(&mut self) -> Result<bool, FrameError> {
        Ok(false)
    }

    fn update(&mut self, paired: Paired) -> Result<(), FrameError> {
        assert_eq!(paired.light.as_ref().map(|light| light.light.pts_us), Some(paired.picture.pts_us));
        let Samples::Yuv { planes, .. } = &paired.picture.samples else { panic!("not YUV") };
        self.luma = planes[0].data[0];
        Ok(())
    }

    fn relight(&mut self, _light: &LightFrame) -> bool {
        self.relit.fetch_add(1, Ordering::Relaxed);
        true
    }

    fn draw(&mut self, shots: &[Shot]) -> Result<Drawn, FrameError> {
        let value = f64::from(self.luma) / 255.0;
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        drop(encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &shots[0].target.view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color { r: value, g: 0.0, b: 1.0, a: 1.0 }),
                    store: wgpu::StoreOp::Store,
                },
            })],
            ..Default::default()
        }));
        self.queue.submit([encoder.finish()]);
        Ok(Drawn { passes: vec![PassTime { name: "clear", gpu_ms: 0.5 }], ..Drawn::default() })
    }

    fn device_lost(&self) -> Option<String> {
        self.lost.then(|| "pretended".to_owned())
    }

    fn has_scene(&self) -> bool {
        true
    }

    fn predict(&mut self, _action: &Action, _now: ClientTime) {}

    fn show_local(&mut self, _objects: &[LocalObject]) {}
}

impl World for Clear {}

fn graphics(lost: bool) -> Graphics<Clear> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let adapter = runtime.block_on(instance.request_adapter(&wgpu::RequestAdapterOptions::default())).unwrap();
    let (device, queue) = runtime.block_on(adapter.request_device(&wgpu::DeviceDescriptor::default())).unwrap();
    Graphics { stage: Clear { device: device.clone(), queue: queue.clone(), luma: 0, relit: Arc::default(), lost }, device, queue }
}

fn picture(index: u64, clock: ClientClock) -> Decoded {
    let plane = |value: u8| Plane { width: 1, height: 1, stride: 1, data: Bytes::from(vec![value]) };
    let planes = [plane(index as u8), plane(128), plane(128)];
    Decoded {
        picture: Picture {
            pts_us: index * 10_000,
            width: 1,
            height: 1,
            stereo: StereoLayout::Mono,
            samples: Samples::Yuv { planes, colour: Colour::default() },
        },
        arrived: clock.now(),
        decoded: clock.now(),
        held_us: 0,
    }
}

/// Feeds `count` pictures, 10 ms apart in pts, with their lights, as fast as they are taken; then the stream ends.
fn frame_loop(count: u64, csv: Option<&std::path::Path>) -> (FrameLoop, std::thread::JoinHandle<()>) {
    fed(count, csv)
}

/// As [`frame_loop`], but pictures come until nobody listens: the stream never ends by itself.
pub(crate) fn endless_frame_loop() -> (FrameLoop, std::thread::JoinHandle<()>) {
    fed(u64::MAX, None)
}

fn fed(count: u64, csv: Option<&std::path::Path>) -> (FrameLoop, std::thread::JoinHandle<()>) {
    let clock = ClientClock::start();
    let (pictures, taken): (PictureSender, PictureReceiver) = outbox(1);
    let (lights, arrivals) = channel();
    let feeder = std::thread::spawn(move || {
        for index in 0..count {
            let light =
                LightFrame { pts_us: index * 10_000, published_us: 0, lift: Default::default(), sh: vec![Vec3::ONE; SH9], lights: vec![] };
            let light = Arrival::Light(ReceivedLight { light, arrived: clock.now() });
            if lights.send(light).is_err() || pictures.send(picture(index, clock)).is_err() {
                return;
            }
        }
    });
    let inputs = Inputs { pictures: taken, arrivals, decoder: Arc::new(DecodeCounters::default()), audio: None };
    (FrameLoop::new(inputs, clock, Stats::open(csv, &["clear"]).unwrap()), feeder)
}

fn options() -> HeadlessOptions {
    HeadlessOptions { width: 33, height: 7, pace: Pace::Video, frames: None, duration: None, stop: Arc::new(AtomicBool::new(false)) }
}

fn recorder(path: &std::path::Path) -> Recorder {
    Recorder::start(path, 33, 7).unwrap()
}

pub(crate) fn png(path: &std::path::Path) -> PictureFile {
    PictureFile::create(path, image::ImageFormat::Png).unwrap()
}

fn still(_since: Duration) -> Camera {
    Camera::looking(0.0, 0.0, 1.0)
}

#[test]
fn the_last_picture_is_in_the_snapshot_and_every_frame_in_the_csv() {
    let folder = tempfile::tempdir().unwrap();
    let (snapshot, csv) = (folder.path().join("out.png"), folder.path().join("stats.csv"));
    let (mut frames, feeder) = frame_loop(20, Some(&csv));
    let files = Files { recorder: Some(recorder(&folder.path().join("out.mp4"))), snapshot: Some(png(&snapshot)) };
    let report = run(&mut frames, &options(), files, &mut || Ok(graphics(false)), &mut still).unwrap();
    feeder.join().unwrap();
    assert!(report.frames >= 1);
    let recorded = report.recording.unwrap().unwrap();
    assert_eq!(recorded.frames + recorded.dropped, report.frames);
    let image = image::open(&snapshot).unwrap().to_rgba8();
    assert_eq!(image.dimensions(), (33, 7));
    // Linear 19/255 as sRGB: 255 · (1.055 · (19/255)^(1/2.4) − 0.055) = 77.2. One code for the driver's rounding.
    assert!(image.pixels().all(|texel| texel.0[0].abs_diff(77) <= 1 && texel.0[1..] == [0, 255, 255]), "{:?}", image.get_pixel(0, 0));
    let summary = frames.into_stats().finish().unwrap();
    assert_eq!(summary.frames(), report.frames);
    assert_eq!(std::fs::read_to_string(&csv).unwrap().lines().count() as u64, report.frames + 1);
    assert!(summary.to_string().contains("gpu clear"));
}

#[test]
fn a_fixed_pace_repeats_the_picture_and_stops_at_the_count() {
    let clock = ClientClock::start();
    // Both stay open: the stream does not end, but nothing comes after its only picture.
    let (pictures, taken) = outbox(1);
    let (lights, arrivals) = channel();
    let light = LightFrame { pts_us: 0, published_us: 0, lift: Default::default(), sh: vec![Vec3::ONE; SH9], lights: vec![] };
    lights.send(Arrival::Light(ReceivedLight { light, arrived: clock.now() })).unwrap();
    pictures.send(picture(0, clock)).ok().unwrap();
    let inputs = Inputs { pictures: taken, arrivals, decoder: Arc::new(DecodeCounters::default()), audio: None };
    let mut frames = FrameLoop::new(inputs, clock, Stats::open(None, &["clear"]).unwrap());
    let options = HeadlessOptions { frames: Some(5), pace: Pace::Fixed(200.0), ..options() };
    assert_eq!(run(&mut frames, &options, Files::default(), &mut || Ok(graphics(false)), &mut still).unwrap().frames, 5);
    let wrong = HeadlessOptions { pace: Pace::Fixed(0.0), ..options };
    assert!(matches!(run(&mut frames, &wrong, Files::default(), &mut || Ok(graphics(false)), &mut still), Err(HeadlessError::Pace(_))));
    let summary = frames.into_stats().finish().unwrap();
    assert_eq!((summary.frames(), summary.pictures()), (5, 1));
}

#[test]
fn light_moves_between_pictures_where_frames_are_drawn_between_them() {
    for (pace, frames, moves) in [(Pace::Fixed(20.0), Some(5), true), (Pace::Video, None, false)] {
        let clock = ClientClock::start();
        let (pictures, taken) = outbox(1);
        let (lights, arrivals) = channel();
        // The light of the picture, and of one 90 ms later that is not here: it is approached, and kept where it ends.
        for (pts_us, sh) in [(0, 1.0), (90_000, 1.2)] {
            let light = LightFrame { pts_us, published_us: 0, lift: Default::default(), sh: vec![Vec3::splat(sh); SH9], lights: vec![] };
            lights.send(Arrival::Light(ReceivedLight { light, arrived: clock.now() })).unwrap();
        }
        pictures.send(picture(0, clock)).ok().unwrap();
        let inputs = Inputs { pictures: taken, arrivals, decoder: Arc::new(DecodeCounters::default()), audio: None };
        let mut shown = FrameLoop::new(inputs, clock, Stats::open(None, &["clear"]).unwrap());
        let options = HeadlessOptions { frames, pace, duration: Some(Duration::from_millis(500)), ..options() };
        let graphics = graphics(false);
        let relit = Arc::clone(&graphics.stage.relit);
        let mut graphics = Some(graphics);
        let mut open = || graphics.take().ok_or_else(|| "opened twice".into());
        run(&mut shown, &options, Files::default(), &mut open, &mut still).unwrap();
        assert_eq!(relit.load(Ordering::Relaxed) > 0, moves, "{pace:?}");
        let summary = shown.into_stats().finish().unwrap().to_string();
        assert_eq!(!summary.contains(" 0 frames under light between"), moves, "{summary}");
    }
}

#[test]
fn a_device_that_is_lost_again_and_again_ends_the_run() {
    let (mut frames, feeder) = endless_frame_loop();
    let options = options();
    let mut opened = 0;
    let failed = run(
        &mut frames,
        &options,
        Files::default(),
        &mut || {
            opened += 1;
            Ok(graphics(true))
        },
        &mut still,
    );
    drop(frames);
    feeder.join().unwrap();
    assert!(matches!(failed, Err(HeadlessError::Frame(FrameError::DeviceLost { .. }))));
    assert_eq!(opened, 1 + MAX_REOPENS);
}

#[test]
fn stopping_and_finding_nothing_are_told_apart() {
    let stopped = options();
    stopped.stop.store(true, Ordering::Relaxed);
    let (mut frames, feeder) = frame_loop(1, None);
    assert_eq!(run(&mut frames, &stopped, Files::default(), &mut || Ok(graphics(false)), &mut still).unwrap().frames, 0);
    let folder = tempfile::tempdir().unwrap();
    let files = Files { snapshot: Some(png(&folder.path().join("out.png"))), ..Files::default() };
    assert!(matches!(run(&mut frames, &stopped, files, &mut || Ok(graphics(false)), &mut still), Err(HeadlessError::NoPicture)));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    let refused = run::<Clear>(&mut frames, &options(), Files::default(), &mut || Err("no adapter".into()), &mut still);
    assert!(refused.unwrap_err().to_string().contains("no adapter"));
    drop(frames);
    feeder.join().unwrap();
}

#[test]
fn a_recording_goes_on_with_the_broadcast_of_a_server_that_came_back() {
    let folder = tempfile::tempdir().unwrap();
    let graphics = graphics(false);
    let files = Files { recorder: Some(recorder(&folder.path().join("out.mp4"))), snapshot: None };
    let mut presenter = ToFile::new(&graphics, &options(), files);
    // The second server's time is far behind the first one's when it is lost.
    for (epoch, pts_us, now) in [(0, 60_000_000, 0), (0, 60_040_000, 40_000), (1, 0, 3_000_000), (1, 40_000, 3_040_000)] {
        presenter.acquire(&still(Duration::ZERO)).unwrap();
        presenter.present(PictureTime { epoch, pts_us }, ClientTime(now)).unwrap();
    }
    // Four frames fit the queue: none is dropped for want of time.
    assert_eq!(presenter.recorder.take().unwrap().finish().unwrap(), RecordReport { frames: 4, dropped: 0 });
}

#[test]
fn pictures_pass_unseen_while_nothing_can_be_shown() {
    let (mut frames, feeder) = frame_loop(30, None);
    while !frames.pass().ended {
        frames.rest(None);
    }
    feeder.join().unwrap();
    let summary = frames.into_stats().finish().unwrap().to_string();
    assert!(summary.starts_with("0 frames presented") && summary.contains("display skipped 0, "), "{summary}");
    assert!(!summary.contains("display skipped 0, 0 passed"), "{summary}");
}
