//! A texture to draw to, and its way back into memory.

use std::sync::mpsc::channel;
use std::time::Duration;

use crate::frame_loop::{FrameError, Target};

/// A frame that takes longer than this is taken for a hung GPU; software Vulkan needs up to a second for a large one.
const PATIENCE: Duration = Duration::from_secs(30);

/// A render target of RGBA8, sRGB-encoded, that can be read back.
pub struct Offscreen {
    device: wgpu::Device,
    queue: wgpu::Queue,
    texture: wgpu::Texture,
    staging: wgpu::Buffer,
    padded_row: u32,
    texels: Vec<u8>,
}

impl Offscreen {
    /// Format of the texture.
    pub const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8UnormSrgb;

    /// A target of this size, each side at least 1.
    #[must_use]
    pub fn new(device: &wgpu::Device, queue: &wgpu::Queue, width: u32, height: u32) -> Self {
        let size = wgpu::Extent3d { width: width.max(1), height: height.max(1), depth_or_array_layers: 1 };
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("headless target"),
            size,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: Self::FORMAT,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        let padded_row = (size.width * 4).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let staging = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("headless readback"),
            size: u64::from(padded_row) * u64::from(size.height),
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        Self { device: device.clone(), queue: queue.clone(), texture, staging, padded_row, texels: Vec::new() }
    }

    /// The texture as a target.
    #[must_use]
    pub fn target(&self) -> Target {
        let view = self.texture.create_view(&wgpu::TextureViewDescriptor::default());
        Target { view, both: None, format: Self::FORMAT, depth: None, width: self.texture.width(), height: self.texture.height() }
    }

    /// Waits until everything submitted is done.
    ///
    /// # Errors
    /// [`FrameError::DeviceLost`] when the GPU does not answer.
    pub fn wait(&self) -> Result<(), FrameError> {
        let wait = wgpu::PollType::Wait { submission_index: None, timeout: Some(PATIENCE) };
        self.device.poll(wait).map(|_| ()).map_err(|error| FrameError::DeviceLost { detail: error.to_string() })
    }

    /// What the texture holds, tightly packed, row by row from the top; valid until the next call.
    ///
    /// # Errors
    /// [`FrameError::DeviceLost`] when the GPU does not answer or the memory cannot be mapped.
    pub fn read(&mut self) -> Result<&[u8], FrameError> {
        let lost = |detail: String| FrameError::DeviceLost { detail };
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("headless readback") });
        encoder.copy_texture_to_buffer(
            self.texture.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &self.staging,
                layout: wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(self.padded_row), rows_per_image: None },
            },
            self.texture.size(),
        );
        self.queue.submit([encoder.finish()]);
        let (tell, told) = channel();
        self.staging.map_async(wgpu::MapMode::Read, .., move |result| {
            // The receiver lives until the end of this function; after it nobody needs to know.
            let _ = tell.send(result);
        });
        self.wait()?;
        told.try_recv().map_err(|error| lost(error.to_string()))?.map_err(|error| lost(error.to_string()))?;
        let row = self.texture.width() as usize * 4;
        self.texels.clear();
        {
            let mapped = self.staging.get_mapped_range(..).map_err(|error| lost(error.to_string()))?;
            for padded in mapped.chunks_exact(self.padded_row as usize) {
                self.texels.extend_from_slice(&padded[..row]);
            }
        }
        self.staging.unmap();
        Ok(&self.texels)
    }
}
