//! What one eye sees, in a window for those beside the headset. The headset's frames do not wait for it: the eye's picture is copied on the GPU
//! and shown once the frame has been handed over, on displays that take a picture at any time; on others there is no such window.

mod screen;

use std::sync::Arc;
use std::time::Duration;

use mr360_protocol::clock::ClientTime;
use winit::application::ApplicationHandler;
use winit::dpi::LogicalSize;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, EventLoop};
use winit::platform::pump_events::EventLoopExtPumpEvents as _;
use winit::window::{Window, WindowId};

use self::screen::Screen;
use crate::gpu::Gpu;
use crate::window::{WindowError, WindowOptions, event_loop};

/// From one picture to the next, microseconds: what watches needs no headset's rate.
const INTERVAL_US: u64 = 33_333;

/// The window of those who watch, over all sessions.
pub struct Spectator {
    event_loop: EventLoop<()>,
    shown: Shown,
    /// Of the session's GPU.
    screen: Option<Screen>,
    last: Option<ClientTime>,
}

/// The window, as its events have it.
struct Shown {
    title: String,
    size: (u32, u32),
    window: Option<Arc<Window>>,
    fault: Option<String>,
    resized: bool,
    /// By its user: it does not come back.
    closed: bool,
}

impl Spectator {
    /// A window that opens with the first session. Call it on the main thread, and once in a program, as [`crate::window::run`].
    ///
    /// # Errors
    /// [`WindowError::NoDisplay`] where there is none.
    pub fn new(options: &WindowOptions) -> Result<Self, WindowError> {
        let shown = Shown { title: options.title.clone(), size: options.size, window: None, fault: None, resized: false, closed: false };
        Ok(Self { event_loop: event_loop()?, shown, screen: None, last: None })
    }

    /// For a window that takes the headset's place: a program has one event loop.
    #[must_use]
    pub fn into_event_loop(self) -> EventLoop<()> {
        self.event_loop
    }

    /// Shows what this GPU draws, until [`Spectator::close`].
    pub(super) fn open(&mut self, gpu: &Gpu) {
        self.listen();
        let Some(window) = self.shown.window.clone() else {
            if let Some(fault) = self.shown.fault.take() {
                tracing::warn!("no window mirrors the headset: {fault}");
            }
            return;
        };
        match Screen::new(gpu, window) {
            Ok(screen) => self.screen = Some(screen),
            Err(error) => tracing::warn!("no window mirrors the headset: {error}"),
        }
    }

    /// Lets go of the GPU; the window stays.
    pub(super) fn close(&mut self) {
        self.screen = None;
    }

    /// Takes in what the window's user did.
    pub(super) fn listen(&mut self) {
        self.event_loop.pump_app_events(Some(Duration::ZERO), &mut self.shown);
        if self.shown.window.is_none() {
            self.screen = None;
        }
        if std::mem::take(&mut self.shown.resized)
            && let (Some(screen), Some(window)) = (&mut self.screen, &self.shown.window)
        {
            let size = window.inner_size();
            screen.resize(size.width, size.height);
        }
    }

    /// The same where there is no session: a window that has not opened waits for one.
    pub(super) fn attend(&mut self) {
        if self.shown.window.is_some() {
            self.listen();
        }
    }

    /// Submits a copy of the first layer of what the runtime lent, which is left as it wants it back. True when it is to be shown.
    pub(super) fn copy(&mut self, texture: &wgpu::Texture, now: ClientTime) -> bool {
        let due = self.last.is_none_or(|last| now.0 >= last.0.saturating_add(INTERVAL_US));
        let Some(screen) = self.screen.as_mut().filter(|_| due) else { return false };
        self.last = Some(now);
        screen.copy(texture);
        true
    }

    /// Shows what was copied last.
    pub(super) fn show(&mut self) {
        if let Some(screen) = &mut self.screen
            && let Err(error) = screen.show()
        {
            tracing::warn!("the window no longer mirrors the headset: {error}");
            self.screen = None;
        }
    }
}

impl ApplicationHandler for Shown {
    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        if self.window.is_some() || self.closed {
            return;
        }
        let (width, height) = self.size;
        let attributes = Window::default_attributes()
            .with_title(self.title.clone())
            .with_inner_size(LogicalSize::new(f64::from(width.max(1)), f64::from(height.max(1))));
        match event_loop.create_window(attributes) {
            Ok(window) => self.window = Some(Arc::new(window)),
            Err(error) => self.fault = Some(error.to_string()),
        }
    }

    fn window_event(&mut self, _event_loop: &ActiveEventLoop, _window: WindowId, event: WindowEvent) {
        match event {
            WindowEvent::CloseRequested => {
                self.window = None;
                self.closed = true;
            }
            WindowEvent::Resized(_) => self.resized = true,
            _ => {}
        }
    }
}

/// A spectator that has let go of the GPU when this is dropped.
pub(super) struct Watching<'a>(pub(super) &'a mut Spectator);

impl<'a> Watching<'a> {
    pub(super) fn new(spectator: &'a mut Spectator, gpu: &Gpu) -> Self {
        spectator.open(gpu);
        Self(spectator)
    }
}

impl Drop for Watching<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}
