//! Presents in a window, where mouse and keys do what hands do in a headset; [`crate::overlay::CONTROLS`] lists it.

mod controls;
mod surface;

use std::ffi::OsString;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use glam::Vec2;
use mr360_protocol::intent::Action;
use winit::application::ApplicationHandler;
use winit::dpi::LogicalSize;
use winit::event::{ElementState, KeyEvent, MouseButton, MouseScrollDelta, StartCause, WindowEvent};
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop};
use winit::keyboard::{KeyCode, PhysicalKey};
use winit::window::{Fullscreen, Window, WindowId};

use self::controls::Controls;
use self::surface::SurfacePresenter;
use crate::frame_loop::{BoxError, FrameError, FrameLoop, Redraw, Stage};

/// Lost devices within [`REOPEN_SPAN`] after which the window is given up.
const MAX_REOPENS: u32 = 3;
/// See [`MAX_REOPENS`].
const REOPEN_SPAN: Duration = Duration::from_secs(10);
/// A touchpad's pixels that make a notch of a wheel.
const PIXELS_PER_NOTCH: f64 = 40.0;

/// How the window begins and when it ends.
#[derive(Debug, Clone)]
pub struct WindowOptions {
    /// Title.
    pub title: String,
    /// Size at the start, in points.
    pub size: (u32, u32),
    /// Closes after so many frames.
    pub frames: Option<u64>,
    /// Closes after so long.
    pub duration: Option<Duration>,
    /// Closes when set, as by Ctrl-C; set when the user closes the window.
    pub stop: Arc<AtomicBool>,
}

/// An open GPU that can present to the window, with its renderer.
pub struct WindowGraphics<S> {
    /// Made from the window.
    pub surface: wgpu::Surface<'static>,
    /// One that can present to it.
    pub adapter: wgpu::Adapter,
    /// The device.
    pub device: wgpu::Device,
    /// Its queue.
    pub queue: wgpu::Queue,
    /// The renderer.
    pub stage: S,
}

/// Why there is no window, or no longer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WindowError {
    /// There is nowhere to open one: fall back to the headless mode.
    #[error("no window can be opened: {detail}; set DISPLAY or WAYLAND_DISPLAY, or use --mode headless")]
    NoDisplay {
        /// What was missing.
        detail: String,
    },
    /// The GPU could not be opened for the window.
    #[error("the GPU cannot be opened for the window: {0}")]
    Open(BoxError),
    /// A frame could not be drawn.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The window system failed while the window was open.
    #[error("the window system failed ({detail}); the broadcast is not affected, join again")]
    System {
        /// What it said.
        detail: String,
    },
}

/// Opens the GPU for a window, and again when it was lost.
pub type Open<'a, S> = dyn FnMut(Arc<Window>) -> Result<WindowGraphics<S>, BoxError> + 'a;

/// Shows a window until the user closes it, an end of `options` is reached, or the stream ends; then returns the frames presented.
/// Call it on the main thread, and once in a program: the window systems ask for both. `act` must not block; `events` is the program's event loop,
/// if it has one already.
///
/// # Errors
/// [`WindowError::NoDisplay`] before anything was shown; everything else ends a window that was open.
pub fn run<S: Stage>(
    frames: &mut FrameLoop,
    options: &WindowOptions,
    open: &mut Open<'_, S>,
    act: &mut dyn FnMut(Action),
    events: Option<EventLoop<()>>,
) -> Result<u64, WindowError> {
    let event_loop = events.map_or_else(event_loop, Ok)?;
    let first_frame = frames.frames();
    let mut app = App {
        frames,
        options,
        open,
        act,
        controls: Controls::new(),
        left_down: false,
        shown: None,
        tried: false,
        first_frame,
        begin: Instant::now(),
        reopened: Vec::new(),
        outcome: Ok(()),
    };
    // One that has run before may be set to wait for events of windows, of which there is none yet.
    event_loop.set_control_flow(ControlFlow::Poll);
    let ran = event_loop.run_app(&mut app);
    let App { frames, outcome, .. } = app;
    outcome?;
    ran.map_err(|error| WindowError::System { detail: error.to_string() })?;
    Ok(frames.frames() - first_frame)
}

/// What windows live in. A program makes one.
pub(crate) fn event_loop() -> Result<EventLoop<()>, WindowError> {
    require_display(|name| std::env::var_os(name))?;
    EventLoop::new().map_err(|error| WindowError::NoDisplay { detail: error.to_string() })
}

/// Says what is missing more clearly than the window system does. `variable` reads the environment.
fn require_display(variable: impl Fn(&str) -> Option<OsString>) -> Result<(), WindowError> {
    let set = |name| variable(name).is_some_and(|value| !value.is_empty());
    if cfg!(all(unix, not(target_vendor = "apple"))) && !["DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"].into_iter().any(set) {
        return Err(WindowError::NoDisplay { detail: "there is no display".to_owned() });
    }
    Ok(())
}

/// An open window.
struct Shown<S> {
    window: Arc<Window>,
    /// The window's.
    title: String,
    presenter: SurfacePresenter,
    stage: S,
}

struct App<'a, S> {
    frames: &'a mut FrameLoop,
    options: &'a WindowOptions,
    open: &'a mut Open<'a, S>,
    act: &'a mut dyn FnMut(Action),
    controls: Controls,
    /// The left button.
    left_down: bool,
    shown: Option<Shown<S>>,
    /// A window was asked for, whatever came of it.
    tried: bool,
    first_frame: u64,
    begin: Instant,
    reopened: Vec<Instant>,
    outcome: Result<(), WindowError>,
}

impl<S: Stage> App<'_, S> {
    fn show(&mut self, window: Arc<Window>) -> Result<(), WindowError> {
        let graphics = (self.open)(Arc::clone(&window)).map_err(WindowError::Open)?;
        let size = window.inner_size();
        let (presenter, stage) = SurfacePresenter::new(graphics, size.width, size.height)?;
        self.controls.resized(size.width, size.height);
        let title = String::new();
        self.shown = Some(Shown { window, title, presenter, stage });
        Ok(())
    }

    fn create(&mut self, event_loop: &ActiveEventLoop) -> Result<(), WindowError> {
        self.tried = true;
        let (width, height) = self.options.size;
        let attributes = Window::default_attributes()
            .with_title(self.options.title.clone())
            .with_inner_size(LogicalSize::new(f64::from(width.max(1)), f64::from(height.max(1))));
        let window = event_loop.create_window(attributes).map_err(|error| WindowError::NoDisplay { detail: error.to_string() })?;
        self.show(Arc::new(window))
    }

    /// Opens the GPU anew for the same window, a few times.
    fn reopen(&mut self, detail: &str) -> Result<(), WindowError> {
        let now = Instant::now();
        self.reopened.retain(|at| now.duration_since(*at) < REOPEN_SPAN);
        self.reopened.push(now);
        let attempt = self.reopened.len();
        self.frames.device_lost();
        // Everything of the old device goes before the new one comes: a window has one surface at a time.
        let window = self.shown.take().map(|shown| shown.window);
        match window {
            Some(window) if attempt <= MAX_REOPENS as usize => {
                tracing::warn!(attempt, "the GPU device was lost ({detail}); opening it anew");
                self.show(window)
            }
            _ => Err(FrameError::DeviceLost { detail: detail.to_owned() }.into()),
        }
    }

    /// Does what the user did since the last time: shown at once, decided by the server.
    fn act(&mut self) {
        let now = self.frames.clock().now();
        let actions = self.controls.take_actions();
        if let Some(shown) = &mut self.shown {
            actions.iter().for_each(|action| shown.stage.predict(action, now));
            shown.stage.show_local(&self.controls.drawn(&shown.stage));
            let title = self
                .controls
                .in_hand(&shown.stage)
                .map_or_else(|| self.options.title.clone(), |item| format!("{item} in hand: click puts it, Esc puts it away"));
            if shown.title != title {
                shown.window.set_title(&title);
                shown.title = title;
            }
        }
        actions.into_iter().for_each(|action| (self.act)(action));
    }

    fn turn(&mut self) -> Result<bool, WindowError> {
        self.act();
        let done = self.frames.frames() - self.first_frame;
        let over =
            self.options.frames.is_some_and(|most| done >= most) || self.options.duration.is_some_and(|most| self.begin.elapsed() >= most);
        if over || self.options.stop.load(Ordering::Relaxed) {
            return Ok(true);
        }
        let Some(shown) = self.shown.as_mut() else { return Ok(false) };
        match self.frames.turn(&mut shown.stage, &mut shown.presenter, &self.controls.camera(), Redraw::OnChange) {
            Ok(turn) => Ok(turn.ended),
            Err(FrameError::DeviceLost { detail }) => self.reopen(&detail).map(|()| false),
            Err(error) => Err(error.into()),
        }
    }

    fn end(&mut self, event_loop: &ActiveEventLoop, outcome: Result<(), WindowError>) {
        self.controls.released(self.frames.clock().now());
        self.act();
        if self.outcome.is_ok() {
            self.outcome = outcome;
        }
        event_loop.exit();
    }

    fn closed_by_user(&mut self, event_loop: &ActiveEventLoop) {
        self.options.stop.store(true, Ordering::Relaxed);
        self.end(event_loop, Ok(()));
    }

    fn key(&mut self, event_loop: &ActiveEventLoop, event: &KeyEvent) {
        let PhysicalKey::Code(code) = event.physical_key else { return };
        // Held down, these go on.
        let repeats = matches!(code, KeyCode::KeyQ | KeyCode::KeyE | KeyCode::PageUp | KeyCode::PageDown);
        if event.state != ElementState::Pressed || (event.repeat && !repeats) {
            return;
        }
        match code {
            KeyCode::Escape if !self.controls.close_palette() => self.closed_by_user(event_loop),
            KeyCode::KeyR => self.controls.reset(),
            KeyCode::PageUp => self.controls.raise(true),
            KeyCode::PageDown => self.controls.raise(false),
            _ => self.key_in_scene(code),
        }
    }

    /// Keys that are about what is shown.
    fn key_in_scene(&mut self, code: KeyCode) {
        let now = self.frames.clock().now();
        let Some(Shown { window, stage, .. }) = &mut self.shown else { return };
        let digit = [KeyCode::Digit1, KeyCode::Digit2, KeyCode::Digit3, KeyCode::Digit4, KeyCode::Digit5]
            .into_iter()
            .chain([KeyCode::Digit6, KeyCode::Digit7, KeyCode::Digit8, KeyCode::Digit9])
            .position(|digit| digit == code);
        match code {
            KeyCode::F1 => {
                stage.toggle_overlay();
                self.frames.redraw();
            }
            KeyCode::F2 => {
                stage.toggle_controls();
                self.frames.redraw();
            }
            KeyCode::F11 => {
                let full = window.fullscreen().is_none().then_some(Fullscreen::Borderless(None));
                window.set_fullscreen(full);
            }
            KeyCode::Tab => self.controls.choose(None, stage),
            KeyCode::KeyQ => self.controls.turn(true, stage, now),
            KeyCode::KeyE => self.controls.turn(false, stage, now),
            KeyCode::KeyG => self.controls.snap(stage, now),
            KeyCode::Delete | KeyCode::Backspace => self.controls.remove(stage),
            _ if digit.is_some() => self.controls.choose(digit, stage),
            _ => {}
        }
    }

    fn button(&mut self, state: ElementState, button: MouseButton) {
        let now = self.frames.clock().now();
        let Some(Shown { stage, .. }) = &self.shown else { return };
        match (button, state) {
            (MouseButton::Left, ElementState::Pressed) => {
                self.left_down = true;
                self.controls.pressed(stage, now);
            }
            (MouseButton::Left, ElementState::Released) => {
                self.left_down = false;
                self.controls.released(now);
            }
            (MouseButton::Right, ElementState::Pressed) => self.controls.turn_pressed(stage, now),
            (MouseButton::Right, ElementState::Released) => self.controls.turn_released(self.left_down, now),
            _ => {}
        }
    }
}

impl<S: Stage> ApplicationHandler for App<'_, S> {
    fn new_events(&mut self, _event_loop: &ActiveEventLoop, _cause: StartCause) {}

    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        if self.shown.is_none()
            && let Err(error) = self.create(event_loop)
        {
            self.end(event_loop, Err(error));
        }
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, _window: WindowId, event: WindowEvent) {
        match event {
            WindowEvent::CloseRequested => self.closed_by_user(event_loop),
            WindowEvent::Resized(size) => {
                self.controls.resized(size.width, size.height);
                if let Some(shown) = self.shown.as_mut() {
                    shown.presenter.resize(size.width, size.height);
                    // What was drawn for the other size is of no use.
                    self.frames.redraw();
                }
            }
            WindowEvent::RedrawRequested => self.frames.redraw(),
            WindowEvent::KeyboardInput { event, .. } => self.key(event_loop, &event),
            WindowEvent::ModifiersChanged(modifiers) => self.controls.set_lifting(modifiers.state().shift_key()),
            WindowEvent::CursorMoved { position, .. } => {
                let (to, now) = (Vec2::new(position.x as f32, position.y as f32), self.frames.clock().now());
                self.controls.moved(to, self.shown.as_ref().map(|shown| &shown.stage), now);
            }
            WindowEvent::MouseInput { state, button, .. } => self.button(state, button),
            WindowEvent::Focused(false) => {
                self.left_down = false;
                self.controls.released(self.frames.clock().now());
            }
            WindowEvent::MouseWheel { delta, .. } => {
                let notches = match delta {
                    MouseScrollDelta::LineDelta(_, lines) => lines,
                    MouseScrollDelta::PixelDelta(pixels) => (pixels.y / PIXELS_PER_NOTCH) as f32,
                };
                self.controls.wheel(notches, self.frames.clock().now());
            }
            _ => {}
        }
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        // An event loop that has run before, as a spectator's, is not resumed again.
        if !self.tried {
            self.resumed(event_loop);
            if self.outcome.is_err() {
                return;
            }
        }
        match self.turn() {
            Ok(true) => self.end(event_loop, Ok(())),
            Ok(false) => {
                let next = self.frames.clock().instant(self.frames.next_turn());
                event_loop.set_control_flow(ControlFlow::WaitUntil(next));
            }
            Err(error) => self.end(event_loop, Err(error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(all(unix, not(target_vendor = "apple")))]
    #[test]
    fn a_missing_display_is_named_with_its_remedy() {
        let environment = |set: &'static [(&str, &str)]| {
            require_display(move |name| set.iter().find(|(variable, _)| *variable == name).map(|(_, value)| OsString::from(value)))
        };
        for missing in [&[][..], &[("DISPLAY", ""), ("WAYLAND_DISPLAY", "")], &[("HOME", "/root")]] {
            let error = environment(missing).unwrap_err();
            assert!(matches!(error, WindowError::NoDisplay { .. }), "{missing:?}: {error}");
            assert!(error.to_string().contains("DISPLAY") && error.to_string().contains("headless"), "{error}");
        }
        for there in [&[("DISPLAY", ":0")][..], &[("DISPLAY", ""), ("WAYLAND_DISPLAY", "wayland-0")], &[("WAYLAND_SOCKET", "7")]] {
            assert!(environment(there).is_ok(), "{there:?}");
        }
    }
}
