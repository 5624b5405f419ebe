//! The window's surface as a [`Presenter`].

use mr360_protocol::clock::ClientTime;

use super::WindowGraphics;
use crate::camera::Camera;
use crate::frame_loop::{FrameError, PictureTime, Presented, Presenter, Shot, Target};

/// Formats by preference: the renderer writes linear light, the attachment encodes it.
const FORMATS: [wgpu::TextureFormat; 2] = [wgpu::TextureFormat::Bgra8UnormSrgb, wgpu::TextureFormat::Rgba8UnormSrgb];

/// A configured surface.
pub(super) struct SurfacePresenter {
    surface: wgpu::Surface<'static>,
    device: wgpu::Device,
    queue: wgpu::Queue,
    configuration: wgpu::SurfaceConfiguration,
    acquired: Option<wgpu::SurfaceTexture>,
}

impl SurfacePresenter {
    /// Splits the stage off and configures the surface.
    pub(super) fn new<S>(graphics: WindowGraphics<S>, width: u32, height: u32) -> Result<(Self, S), FrameError> {
        let WindowGraphics { surface, adapter, device, queue, stage } = graphics;
        let failed = |why: &str| FrameError::Failed { action: "setting up the window's surface", source: why.into() };
        let offered = surface.get_capabilities(&adapter).formats;
        let format = FORMATS.into_iter().find(|format| offered.contains(format));
        let mut configuration = surface
            .get_default_config(&adapter, width.max(1), height.max(1))
            .ok_or_else(|| failed("this GPU cannot present to this display; use --mode headless"))?;
        configuration.format = format.ok_or_else(|| failed("the display offers no sRGB format; use --mode headless"))?;
        // Waits for the display: no tearing, and no more frames than it can show.
        configuration.present_mode = wgpu::PresentMode::AutoVsync;
        configuration.desired_maximum_frame_latency = 1;
        surface.configure(&device, &configuration);
        let mut presenter = Self { surface, device, queue, configuration, acquired: None };
        presenter.clear()?;
        Ok((presenter, stage))
    }

    /// Black until the first picture: some window systems show what was there before, some show no window at all.
    fn clear(&mut self) -> Result<(), FrameError> {
        let Some(target) = self.next()? else { return Ok(()) };
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("black window") });
        drop(encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("black window"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &target.view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            })],
            ..wgpu::RenderPassDescriptor::default()
        }));
        self.queue.submit([encoder.finish()]);
        self.present_acquired();
        Ok(())
    }

    fn present_acquired(&mut self) {
        if let Some(texture) = self.acquired.take() {
            self.queue.present(texture);
        }
    }

    /// Follows the window; a size of zero (minimised) keeps the old one.
    pub(super) fn resize(&mut self, width: u32, height: u32) {
        if width > 0 && height > 0 && (self.configuration.width, self.configuration.height) != (width, height) {
            (self.configuration.width, self.configuration.height) = (width, height);
            self.acquired = None;
            self.surface.configure(&self.device, &self.configuration);
        }
    }

    /// The window's next image, or `None` when it has none just now.
    fn next(&mut self) -> Result<Option<Target>, FrameError> {
        use wgpu::CurrentSurfaceTexture as Current;
        let texture = match self.surface.get_current_texture() {
            Current::Success(texture) | Current::Suboptimal(texture) => texture,
            Current::Timeout | Current::Occluded => return Ok(None),
            Current::Outdated => {
                self.surface.configure(&self.device, &self.configuration);
                return Ok(None);
            }
            Current::Lost => return Err(FrameError::DeviceLost { detail: "the window's surface is gone".to_owned() }),
            Current::Validation => {
                return Err(FrameError::Failed {
                    action: "acquiring the window's next image",
                    source: "the GPU's validation refused it".into(),
                });
            }
        };
        let view = texture.texture.create_view(&wgpu::TextureViewDescriptor::default());
        let (width, height) = (texture.texture.width(), texture.texture.height());
        self.acquired = Some(texture);
        Ok(Some(Target { view, both: None, format: self.configuration.format, depth: None, width, height }))
    }
}

impl Presenter for SurfacePresenter {
    fn acquire(&mut self, camera: &Camera) -> Result<Option<Vec<Shot>>, FrameError> {
        Ok(self.next()?.map(|target| vec![Shot { camera: *camera, target }]))
    }

    fn present(&mut self, _shown: PictureTime, _now: ClientTime) -> Result<Presented, FrameError> {
        self.present_acquired();
        Ok(Presented::default())
    }
}
