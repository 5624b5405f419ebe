//! A session with a headset: its states, its frames, and what is drawn for it.

use std::time::Duration;

use mr360_protocol::clock::ClientTime;
use openxr as xr;

use super::Fault;
use super::controllers::Controllers;
use super::eyes::{EyeRecorder, Kept};
use super::graphics::{self, Handles};
use super::layers;
use super::pace::Pace;
use super::runtime::{Runtime, VIEWS};
use super::space::{self, Spaces};
use super::spectator::Watching;
use super::swapchain::{self, Content, Swapchain};
use crate::camera::Camera;
use crate::frame_loop::{FrameError, HeadsetTimes, PictureTime, Presented, Presenter, Shot, Target};
use crate::gpu::Gpu;
use crate::hands::{HandInput, HandsInput, Haptic, Placing, PlacingChange, Pose};
use crate::sync::ClientClock;
use crate::viewpoint::Viewpoint;

/// What the runtime said since it was asked last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Standing {
    /// Frames are wanted.
    Running,
    /// No frames are wanted now: the session has not begun, or was stopped.
    Stopped,
    /// The user has ended the program from within the headset.
    Ended,
}

/// What outlives a session.
#[derive(Debug, Default)]
pub(super) struct Viewer {
    pace: Pace,
    /// How the space above the floor lies in the world.
    placing: Placing,
}

/// A frame between its beginning and its end.
struct Begun {
    called_for: ClientTime,
    display: xr::Time,
    should_render: bool,
    /// What it is drawn from, once it is.
    views: Vec<xr::View>,
    cameras: Vec<Camera>,
    pose_read: Option<xr::Time>,
    waits: u64,
}

/// Who sees what the eyes see.
pub(super) struct Watchers<'a> {
    pub(super) spectator: Option<Watching<'a>>,
    pub(super) eyes: Option<&'a mut EyeRecorder>,
}

/// A session with a headset.
pub(super) struct Headset<'a> {
    // Dropped in this order: what is the session's, before it.
    watchers: Watchers<'a>,
    colour: Swapchain,
    depth: Option<Swapchain>,
    controllers: Controllers,
    spaces: Spaces,
    stream: xr::FrameStream<xr::Vulkan>,
    waiter: xr::FrameWaiter,
    session: xr::Session<xr::Vulkan>,
    runtime: Runtime,
    device: wgpu::Device,
    queue: wgpu::Queue,
    clock: ClientClock,
    running: bool,
    begun: Option<Begun>,
    viewer: &'a mut Viewer,
    ground_y: f32,
    hands: [HandInput; 2],
    /// Above the floor.
    head: Pose,
}

impl<'a> Headset<'a> {
    /// Begins a session on the GPU, which is not to be used by another thread.
    ///
    /// # Errors
    /// Those of [`Fault::of`].
    pub(super) fn new(
        runtime: Runtime,
        gpu: &Gpu,
        handles: &Handles,
        clock: ClientClock,
        viewer: &'a mut Viewer,
        watchers: Watchers<'a>,
    ) -> Result<Self, Fault> {
        let (session, waiter, stream) = graphics::begin_session(&runtime, gpu, handles)?;
        let no_format = || Fault::Absent("the headset takes none of sRGB in 8 bits and linear light in 16; update its software".to_owned());
        let colour = swapchain::format(&session, Content::Colour)?.ok_or_else(no_format)?;
        let depth = if runtime.extensions.khr_composition_layer_depth { swapchain::format(&session, Content::Depth)? } else { None };
        let depth = depth.map(|format| Swapchain::new(&session, gpu, Content::Depth, format, runtime.eye_size)).transpose()?;
        let colour = Swapchain::new(&session, gpu, Content::Colour, colour, runtime.eye_size)?;
        tracing::info!(format = ?colour.format, depth = depth.is_some(), "session with the headset");
        viewer.pace.rests();
        Ok(Self {
            colour,
            depth,
            controllers: Controllers::new(&runtime, &session)?,
            spaces: Spaces::new(&session, &runtime)?,
            stream,
            waiter,
            session,
            runtime,
            device: gpu.device.clone(),
            queue: gpu.queue.clone(),
            clock,
            watchers,
            running: false,
            begun: None,
            viewer,
            ground_y: 0.0,
            hands: [HandInput::default(); 2],
            head: Pose::IDENTITY,
        })
    }

    /// Takes in what the runtime has to say. `ground_y` is the height of the scene's ground, on which the viewer's floor lies.
    ///
    /// # Errors
    /// [`Fault::Lost`] when everything has to be made anew; those of [`Fault::of`].
    pub(super) fn listen(&mut self, ground_y: f32) -> Result<Standing, Fault> {
        self.ground_y = ground_y;
        if let Some(Watching(spectator)) = &mut self.watchers.spectator {
            spectator.listen();
        }
        let mut buffer = xr::EventDataBuffer::new();
        let instance = self.runtime.instance.clone();
        while let Some(event) = instance.poll_event(&mut buffer).map_err(|code| Fault::of("listening to the headset", code))? {
            match event {
                xr::Event::SessionStateChanged(event) if self.changes_to(event.state())? => return Ok(Standing::Ended),
                xr::Event::InstanceLossPending(_) => return Err(Fault::Lost("the OpenXR runtime is about to end".to_owned())),
                xr::Event::InteractionProfileChanged(_) => self.controllers.log_in_use(&self.runtime, &self.session),
                xr::Event::ReferenceSpaceChangePending(_) => tracing::info!("the headset was recentred"),
                _ => {}
            }
        }
        Ok(if self.running { Standing::Running } else { Standing::Stopped })
    }

    /// True when the user has ended the session.
    fn changes_to(&mut self, state: xr::SessionState) -> Result<bool, Fault> {
        let meaning = match state {
            xr::SessionState::READY => "ready",
            xr::SessionState::SYNCHRONIZED => "asleep or covered: nothing is drawn",
            xr::SessionState::VISIBLE => "visible",
            xr::SessionState::FOCUSED => "in use",
            xr::SessionState::STOPPING => "stopping",
            xr::SessionState::EXITING => "ended by its user",
            xr::SessionState::LOSS_PENDING => "about to be lost",
            _ => "idle",
        };
        tracing::info!(state = ?state, "headset {meaning}");
        match state {
            xr::SessionState::READY => {
                self.session.begin(VIEWS).map_err(|code| Fault::of("beginning to show", code))?;
                self.running = true;
            }
            xr::SessionState::STOPPING => {
                self.running = false;
                self.viewer.pace.rests();
                self.session.end().map_err(|code| Fault::of("ending to show", code))?;
            }
            xr::SessionState::LOSS_PENDING => return Err(Fault::Lost("the headset is about to be lost".to_owned())),
            _ => {}
        }
        Ok(state == xr::SessionState::EXITING)
    }

    /// Waits until the runtime wants the next frame, at the display's pace, and begins it. The display's interval when it is to be drawn.
    ///
    /// # Errors
    /// Those of [`Fault::of`].
    pub(super) fn begin(&mut self) -> Result<Option<Duration>, Fault> {
        let state = self.waiter.wait().map_err(|code| Fault::of("waiting for the display", code))?;
        let called_for = self.clock.now();
        self.stream.begin().map_err(|code| Fault::of("beginning a frame", code))?;
        let (display, should_render) = (state.predicted_display_time, state.should_render);
        let period_ns = state.predicted_display_period.as_nanos();
        if should_render {
            self.viewer.pace.displays_at(display.as_nanos(), period_ns);
        } else {
            self.viewer.pace.rests();
        }
        self.begun = Some(Begun { called_for, display, should_render, views: Vec::new(), cameras: Vec::new(), pose_read: None, waits: 0 });
        Ok(should_render.then(|| Duration::from_nanos(u64::try_from(period_ns).unwrap_or(0))))
    }

    /// Head and hands at the time that the begun frame is displayed.
    ///
    /// # Errors
    /// Those of [`Fault::of`].
    pub(super) fn read_hands(&mut self) -> Result<HandsInput, Fault> {
        let failed = |code| Fault::of("reading the controllers", code);
        let Some(display) = self.begun.as_ref().map(|begun| begun.display) else {
            let placing = &self.viewer.placing;
            return Ok(HandsInput { hands: self.hands, head: placing.in_world(&self.head), now: self.clock.now(), scale: placing.scale() });
        };
        self.hands = self.controllers.read(&self.session, &self.spaces, display, self.ground_y).map_err(failed)?;
        let placing = self.viewer.placing;
        for pose in self.hands.iter_mut().flat_map(|hand| [&mut hand.grip, &mut hand.aim]).flatten() {
            *pose = placing.in_world(pose);
        }
        self.head = self.spaces.head(display, self.ground_y).map_err(failed)?.unwrap_or(self.head);
        let ahead_us = self.runtime.now().map_or(0, |now| u64::try_from((display.as_nanos() - now.as_nanos()) / 1_000).unwrap_or(0));
        let now = ClientTime(self.clock.now().0.saturating_add(ahead_us));
        Ok(HandsInput { hands: self.hands, head: placing.in_world(&self.head), now, scale: placing.scale() })
    }

    /// Takes wishes of the viewer for where and how large they are.
    pub(super) fn place(&mut self, changes: &[PlacingChange]) {
        for change in changes {
            self.viewer.placing.change(*change, &self.head);
        }
    }

    /// Plays pulses, left and right.
    ///
    /// # Errors
    /// Those of [`Fault::of`].
    pub(super) fn pulse(&self, haptics: [Option<Haptic>; 2]) -> Result<(), Fault> {
        self.controllers.pulse(&self.session, haptics).map_err(|code| Fault::of("playing a pulse", code))
    }

    /// Ends the begun frame without a picture, unless it was presented.
    ///
    /// # Errors
    /// Those of [`Fault::of`].
    pub(super) fn end_unseen(&mut self) -> Result<(), Fault> {
        let Some(begun) = self.begun.take() else { return Ok(()) };
        self.stream.end(begun.display, self.runtime.blend, &[]).map_err(|code| Fault::of("ending a frame", code))
    }

    /// Borrows pictures, then reads where the eyes are: as late as can be.
    fn look(&mut self) -> Result<Option<Vec<Shot>>, Fault> {
        let Some(begun) = self.begun.as_mut().filter(|begun| begun.should_render) else { return Ok(None) };
        let lent = |code| Fault::of("borrowing the headset's pictures", code);
        for swapchain in [Some(&mut self.colour), self.depth.as_mut()].into_iter().flatten() {
            let Some(stood_still) = swapchain.acquire().map_err(lent)? else { return Ok(None) };
            begun.waits += u64::from(stood_still);
        }
        begun.pose_read = self.runtime.now();
        let located = self.session.locate_views(VIEWS, begun.display, &self.spaces.floor);
        let (flags, views) = located.map_err(|code| Fault::of("locating the eyes", code))?;
        let ground_y = self.ground_y;
        let placing = self.viewer.placing;
        let placed = |camera: Camera| {
            let pose = placing.in_world(&Pose { position: camera.position, orientation: camera.world_from_view });
            Camera { position: pose.position, world_from_view: pose.orientation, ..camera }
        };
        let cameras = views.iter().zip([false, true]).map(|(view, right_eye)| space::camera(view, flags, ground_y, right_eye).map(placed));
        let Some(cameras) = cameras.collect::<Option<Vec<_>>>().filter(|cameras| cameras.len() == 2) else { return Ok(None) };
        let Some((_, targets)) = self.colour.held() else { return Ok(None) };
        let depths = self.depth.as_ref().and_then(Swapchain::held).map(|(_, views)| views);
        let (width, height) = self.colour.size;
        let shot = |(at, camera): (usize, &Camera)| Shot {
            camera: *camera,
            target: Target {
                view: targets.each[at].clone(),
                both: Some(targets.both.clone()),
                format: self.colour.format,
                depth: depths.map(|depths| depths.each[at].clone()),
                width,
                height,
            },
        };
        let shots = cameras.iter().enumerate().map(shot).collect();
        (begun.views, begun.cameras) = (views, cameras);
        Ok(Some(shots))
    }

    fn show(&mut self, shown: PictureTime) -> Result<Presented, Fault> {
        let Some(begun) = self.begun.take() else { return Ok(Presented::default()) };
        self.keep(&begun, shown);
        let now = self.clock.now();
        let seen = self.colour.held().zip(self.watchers.spectator.as_mut());
        let mirrors = seen.is_some_and(|((texture, _), Watching(spectator))| spectator.copy(texture, now));
        let released = |code| Fault::of("giving the headset its pictures", code);
        self.colour.release().map_err(released)?;
        if let Some(depth) = &mut self.depth {
            depth.release().map_err(released)?;
        }
        let when = (begun.display, self.runtime.blend);
        let depth = self.depth.as_ref().map(|depth| (depth, self.viewer.placing.scale()));
        layers::end(&mut self.stream, when, (&self.spaces.floor, &begun.views), &self.colour, depth)
            .map_err(|code| Fault::of("ending a frame", code))?;
        let pose_to_photon_us =
            begun.pose_read.map(|read| u64::try_from(begun.display.as_nanos().saturating_sub(read.as_nanos()) / 1_000).unwrap_or(0));
        let frame_us = self.clock.now().0.saturating_sub(begun.called_for.0);
        if let Some(Watching(spectator)) = self.watchers.spectator.as_mut().filter(|_| mirrors) {
            spectator.show();
        }
        let headset = HeadsetTimes { pose_to_photon_us, frame_us, missed: self.viewer.pace.missed() };
        Ok(Presented { gpu_waits: begun.waits, headset: Some(headset) })
    }

    fn keep(&mut self, begun: &Begun, shown: PictureTime) {
        let now = self.clock.now();
        let Some((eyes, frame)) = self.watchers.eyes.as_mut().and_then(|eyes| eyes.count(now).map(|frame| (eyes, frame))) else { return };
        let Some((texture, _)) = self.colour.held() else { return };
        let aspect = self.colour.size.0 as f32 / self.colour.size.1 as f32;
        let views = begun.cameras.iter().map(|camera| Viewpoint::of(camera, aspect)).collect();
        let head = self.viewer.placing.in_world(&self.head);
        let kept = Kept { frame, pts_us: shown.pts_us, views, hands: self.hands, head };
        eyes.keep(&self.device, &self.queue, texture, kept, now);
    }
}

impl Presenter for Headset<'_> {
    fn acquire(&mut self, _camera: &Camera) -> Result<Option<Vec<Shot>>, FrameError> {
        self.look().map_err(|fault| fault.within_session().into_frame_error("looking from the headset"))
    }

    fn present(&mut self, shown: PictureTime, _now: ClientTime) -> Result<Presented, FrameError> {
        self.show(shown).map_err(|fault| fault.within_session().into_frame_error("presenting to the headset"))
    }
}
