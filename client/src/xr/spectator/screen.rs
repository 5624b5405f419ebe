//! The window's surface, and the picture that it shows.

use std::sync::Arc;

use mr360_shaders::source::Module;
use winit::window::Window;

use crate::frame_loop::BoxError;
use crate::gpu::Gpu;

/// Linear light is written, and encoded by the surface.
const FORMATS: [wgpu::TextureFormat; 2] = [wgpu::TextureFormat::Bgra8UnormSrgb, wgpu::TextureFormat::Rgba8UnormSrgb];
/// Ways to present that wait for no display.
const MODES: [wgpu::PresentMode; 2] = [wgpu::PresentMode::Mailbox, wgpu::PresentMode::Immediate];

/// A configured surface.
pub(super) struct Screen {
    surface: wgpu::Surface<'static>,
    device: wgpu::Device,
    queue: wgpu::Queue,
    configuration: wgpu::SurfaceConfiguration,
    pipeline: wgpu::RenderPipeline,
    sampler: wgpu::Sampler,
    /// A copy of an eye's picture.
    copy: Option<(wgpu::Texture, wgpu::BindGroup)>,
}

impl Screen {
    pub(super) fn new(gpu: &Gpu, window: Arc<Window>) -> Result<Self, BoxError> {
        let size = window.inner_size();
        let surface = gpu.instance.create_surface(window)?;
        let offered = surface.get_capabilities(&gpu.adapter);
        let mut configuration = surface
            .get_default_config(&gpu.adapter, size.width.max(1), size.height.max(1))
            .ok_or("the headset's GPU cannot present to this display")?;
        let format = FORMATS.into_iter().find(|format| offered.formats.contains(format)).ok_or("the display offers no sRGB format")?;
        let mode = MODES.into_iter().find(|mode| offered.present_modes.contains(mode));
        configuration.format = format;
        configuration.present_mode = mode.ok_or("the display would hold up the headset's frames")?;
        surface.configure(&gpu.device, &configuration);
        let shader = gpu.shader(Module::Spectator)?;
        let sampler = gpu.device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("spectator"),
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..wgpu::SamplerDescriptor::default()
        });
        let pipeline = pipeline(gpu, &shader, format);
        Ok(Self { surface, device: gpu.device.clone(), queue: gpu.queue.clone(), configuration, pipeline, sampler, copy: None })
    }

    /// Follows the window; a size of zero (minimised) keeps the old one.
    pub(super) fn resize(&mut self, width: u32, height: u32) {
        if width > 0 && height > 0 && (self.configuration.width, self.configuration.height) != (width, height) {
            (self.configuration.width, self.configuration.height) = (width, height);
            self.surface.configure(&self.device, &self.configuration);
        }
    }

    pub(super) fn copy(&mut self, texture: &wgpu::Texture) {
        let size = wgpu::Extent3d { depth_or_array_layers: 1, ..texture.size() };
        let (copy, _) = self.copy.get_or_insert_with(|| {
            let copy = self.device.create_texture(&wgpu::TextureDescriptor {
                label: Some("spectator"),
                size,
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format: texture.format(),
                usage: wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::TEXTURE_BINDING,
                view_formats: &[],
            });
            let view = copy.create_view(&wgpu::TextureViewDescriptor::default());
            let group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some("spectator"),
                layout: &self.pipeline.get_bind_group_layout(0),
                entries: &[
                    wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(&view) },
                    wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::Sampler(&self.sampler) },
                ],
            });
            (copy, group)
        });
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("spectator") });
        encoder.copy_texture_to_texture(texture.as_image_copy(), copy.as_image_copy(), size);
        let back = wgpu::TextureTransition { texture, selector: None, state: wgpu::TextureUses::COLOR_TARGET };
        encoder.transition_resources(std::iter::empty(), std::iter::once(back));
        self.queue.submit([encoder.finish()]);
    }

    /// Presents the copy, cut to the window's shape. A window that takes none just now shows the last one.
    pub(super) fn show(&mut self) -> Result<(), BoxError> {
        use wgpu::CurrentSurfaceTexture as Current;
        let Some((copy, group)) = &self.copy else { return Ok(()) };
        let target = match self.surface.get_current_texture() {
            Current::Success(texture) | Current::Suboptimal(texture) => texture,
            Current::Timeout | Current::Occluded => return Ok(()),
            Current::Outdated => {
                self.surface.configure(&self.device, &self.configuration);
                return Ok(());
            }
            Current::Lost => return Err("the window's surface is gone".into()),
            Current::Validation => return Err("the GPU's validation refused the window's next image".into()),
        };
        let view = target.texture.create_view(&wgpu::TextureViewDescriptor::default());
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("spectator") });
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("spectator"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            })],
            ..wgpu::RenderPassDescriptor::default()
        });
        let [x, y, width, height] = cover((copy.width(), copy.height()), (target.texture.width(), target.texture.height()));
        pass.set_viewport(x, y, width, height, 0.0, 1.0);
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, group, &[]);
        pass.draw(0..4, 0..1);
        drop(pass);
        self.queue.submit([encoder.finish()]);
        self.queue.present(target);
        Ok(())
    }
}

/// Where a picture lies that covers all of a window, its middle in the middle: left, top, width, height.
fn cover(picture: (u32, u32), window: (u32, u32)) -> [f32; 4] {
    let [columns, rows, width, height] = [picture.0, picture.1, window.0, window.1].map(|side| side.max(1) as f32);
    let scale = (width / columns).max(height / rows);
    let (wide, high) = (columns * scale, rows * scale);
    [0.5 * (width - wide), 0.5 * (height - high), wide, high]
}

fn pipeline(gpu: &Gpu, shader: &wgpu::ShaderModule, format: wgpu::TextureFormat) -> wgpu::RenderPipeline {
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("spectator"),
        layout: None,
        vertex: wgpu::VertexState {
            module: shader,
            entry_point: Some("vs_spectator"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers: &[],
        },
        primitive: wgpu::PrimitiveState { topology: wgpu::PrimitiveTopology::TriangleStrip, ..wgpu::PrimitiveState::default() },
        depth_stencil: None,
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: shader,
            entry_point: Some("fs_spectator"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            targets: &[Some(format.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_covers_the_window_and_keeps_its_shape() {
        assert_eq!(cover((320, 240), (640, 480)), [0.0, 0.0, 640.0, 480.0]);
        // Cut above and below, or at both sides.
        assert_eq!(cover((320, 240), (640, 400)), [0.0, -40.0, 640.0, 480.0]);
        assert_eq!(cover((320, 240), (300, 300)), [-50.0, 0.0, 400.0, 300.0]);
    }
}
