//! The Vulkan device that everything is drawn with.

use std::future::Future;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, Waker};

/// Why there is no device.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// Nothing to draw with.
    #[error("no Vulkan adapter found ({0}); install a Vulkan driver: your GPU vendor's, or mesa-vulkan-drivers for drawing in software")]
    NoAdapter(String),
    /// The adapter gave no device.
    #[error("Vulkan adapter {adapter} gave no device: {fault}; update its driver, or install mesa-vulkan-drivers for drawing in software")]
    NoDevice {
        /// Name of the adapter.
        adapter: String,
        /// The driver's word.
        fault: String,
    },
    /// The device went away while waiting for it.
    #[error("the GPU did not finish: {0}; the device has to be made anew")]
    Lost(String),
    /// More than the device can do, or has memory for.
    #[error("this GPU cannot draw a picture of {width}×{height} pixels; choose a smaller --size ({fault})")]
    Refused {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// The driver's word.
        fault: String,
    },
    /// A shader module with an import that is missing from the build.
    #[error(transparent)]
    Shader(#[from] mr360_shaders::source::ImportError),
}

/// A device, its queue and where they came from.
pub struct Gpu {
    /// Makes surfaces.
    pub instance: wgpu::Instance,
    /// Knows formats and limits.
    pub adapter: wgpu::Adapter,
    /// Makes resources.
    pub device: wgpu::Device,
    /// Takes work.
    pub queue: wgpu::Queue,
    lost: Arc<AtomicBool>,
}

/// Most bytes of a texture that are on their way back at once: textures may be larger than any buffer.
const READ_BACK_BYTES: u64 = 64 * 1024 * 1024;

/// Features that are used where the device has them.
const WANTED: wgpu::Features = wgpu::Features::TIMESTAMP_QUERY.union(wgpu::Features::TEXTURE_FORMAT_16BIT_NORM).union(MULTIVIEW);

/// What a pass of both eyes needs.
pub(crate) const MULTIVIEW: wgpu::Features = wgpu::Features::MULTIVIEW.union(wgpu::Features::MULTISAMPLE_ARRAY);

/// A Vulkan instance, to make a window's surface from before the device is chosen.
#[must_use]
pub fn vulkan_instance() -> wgpu::Instance {
    wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: wgpu::Backends::VULKAN,
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    })
}

impl Gpu {
    /// Opens a Vulkan device without a window.
    ///
    /// # Errors
    /// [`GpuError`] naming the remedy.
    pub fn headless() -> Result<Self, GpuError> {
        Self::new(vulkan_instance(), None)
    }

    /// Opens a Vulkan device that can present to the surface, if one is given; the surface comes from `instance`.
    ///
    /// # Errors
    /// [`GpuError`] naming the remedy.
    pub fn new(instance: wgpu::Instance, compatible_surface: Option<&wgpu::Surface<'_>>) -> Result<Self, GpuError> {
        let options = wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            compatible_surface,
            ..wgpu::RequestAdapterOptions::default()
        };
        let adapter = block_on(instance.request_adapter(&options)).map_err(|error| GpuError::NoAdapter(error.to_string()))?;
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("mr360"),
            required_features: Self::features(&adapter),
            required_limits: Self::limits(&adapter),
            ..wgpu::DeviceDescriptor::default()
        };
        let (device, queue) = block_on(adapter.request_device(&descriptor))
            .map_err(|error| GpuError::NoDevice { adapter: adapter.get_info().name, fault: error.to_string() })?;
        Ok(Self::from_parts(instance, adapter, device, queue))
    }

    /// Features that a device made elsewhere should enable: those of [`Gpu::new`] that the adapter has.
    #[must_use]
    pub fn features(adapter: &wgpu::Adapter) -> wgpu::Features {
        adapter.features() & WANTED
    }

    /// Limits that a device made elsewhere should have: WebGPU's defaults, with textures as large and views as many as the adapter takes.
    #[must_use]
    pub fn limits(adapter: &wgpu::Adapter) -> wgpu::Limits {
        let wgpu::Limits { max_texture_dimension_2d, max_multiview_view_count, .. } = adapter.limits();
        wgpu::Limits { max_texture_dimension_2d, max_multiview_view_count, ..wgpu::Limits::default() }
    }

    /// Takes over a device that was made elsewhere, by an OpenXR runtime for instance.
    #[must_use]
    pub fn from_parts(instance: wgpu::Instance, adapter: wgpu::Adapter, device: wgpu::Device, queue: wgpu::Queue) -> Self {
        let lost = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&lost);
        device.set_device_lost_callback(move |reason, message| {
            if !matches!(reason, wgpu::DeviceLostReason::Destroyed) {
                tracing::error!(?reason, message, "GPU device lost");
            }
            flag.store(true, Ordering::Release);
        });
        device.on_uncaptured_error(Arc::new(|error| tracing::error!(%error, "GPU error")));
        let info = adapter.get_info();
        tracing::info!(adapter = info.name, driver = info.driver_info, kind = ?info.device_type, "GPU");
        Self { instance, adapter, device, queue, lost }
    }

    /// True once the device is gone; everything made from it has to be made anew.
    #[must_use]
    pub fn lost(&self) -> bool {
        self.lost.load(Ordering::Acquire)
    }

    /// Waits until everything submitted so far is done.
    ///
    /// # Errors
    /// [`GpuError::Lost`] when the device went away.
    pub fn wait(&self) -> Result<(), GpuError> {
        match self.device.poll(wgpu::PollType::wait_indefinitely()) {
            Ok(_) if !self.lost() => Ok(()),
            Ok(_) => Err(GpuError::Lost("device lost".to_owned())),
            Err(error) => Err(GpuError::Lost(error.to_string())),
        }
    }

    /// Compiles a shader module.
    ///
    /// # Errors
    /// [`GpuError::Shader`] when an import is missing from the build.
    pub fn shader(&self, module: mr360_shaders::source::Module) -> Result<wgpu::ShaderModule, GpuError> {
        let source = wgpu::ShaderSource::Wgsl(module.source()?.into());
        Ok(self.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(module.file()), source }))
    }

    /// Compiles a shader module for passes of both eyes, on a device with multiview.
    ///
    /// # Errors
    /// As [`Gpu::shader`].
    pub(crate) fn multiview_shader(&self, module: mr360_shaders::source::Module) -> Result<wgpu::ShaderModule, GpuError> {
        let source = wgpu::ShaderSource::Wgsl(module.multiview_source()?.into());
        Ok(self.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(module.file()), source }))
    }

    /// Copies a texture of 4, 8 or 16 bytes a texel back to memory, rows packed from the top. Waits for the GPU.
    ///
    /// # Errors
    /// [`GpuError::Lost`] when the device went away.
    pub fn read_texture(&self, texture: &wgpu::Texture) -> Result<Vec<u8>, GpuError> {
        self.read_layer(texture, 0)
    }

    /// As [`Gpu::read_texture`], of one of its layers.
    ///
    /// # Errors
    /// As [`Gpu::read_texture`].
    pub fn read_layer(&self, texture: &wgpu::Texture, layer: u32) -> Result<Vec<u8>, GpuError> {
        self.read_bands(texture, layer, READ_BACK_BYTES.min(self.device.limits().max_buffer_size))
    }

    /// As [`Gpu::read_layer`], as many rows at a time as fit `band_bytes`, one at least.
    fn read_bands(&self, texture: &wgpu::Texture, layer: u32, band_bytes: u64) -> Result<Vec<u8>, GpuError> {
        let (width, height) = (texture.width(), texture.height());
        let row = width * texture.format().block_copy_size(None).unwrap_or(4);
        let padded = row.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let rows = u32::try_from(band_bytes / u64::from(padded.max(1))).unwrap_or(u32::MAX).clamp(1, height);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("read back"),
            size: u64::from(padded) * u64::from(rows),
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        let mut out = Vec::with_capacity(row as usize * height as usize);
        for top in (0..height).step_by(rows as usize) {
            let band = rows.min(height - top);
            let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            encoder.copy_texture_to_buffer(
                wgpu::TexelCopyTextureInfo { origin: wgpu::Origin3d { x: 0, y: top, z: layer }, ..texture.as_image_copy() },
                wgpu::TexelCopyBufferInfo {
                    buffer: &buffer,
                    layout: wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(padded), rows_per_image: None },
                },
                wgpu::Extent3d { width, height: band, depth_or_array_layers: 1 },
            );
            self.queue.submit([encoder.finish()]);
            let bytes = self.read_buffer(&buffer)?;
            bytes.chunks_exact(padded as usize).take(band as usize).for_each(|padded| out.extend_from_slice(&padded[..row as usize]));
        }
        Ok(out)
    }

    /// Copies a mappable buffer back to memory. Waits for the GPU.
    ///
    /// # Errors
    /// [`GpuError::Lost`] when the device went away.
    pub fn read_buffer(&self, buffer: &wgpu::Buffer) -> Result<Vec<u8>, GpuError> {
        let lost = |fault: String| GpuError::Lost(fault);
        buffer.slice(..).map_async(wgpu::MapMode::Read, |_| {});
        self.wait()?;
        let bytes = buffer.slice(..).get_mapped_range().map_err(|error| lost(error.to_string()))?.to_vec();
        buffer.unmap();
        Ok(bytes)
    }
}

/// wgpu's native futures are ready when they are made; they wait for nothing that would have to wake this thread.
pub(crate) fn block_on<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    loop {
        if let Poll::Ready(value) = future.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            return value;
        }
        std::thread::yield_now();
    }
}

/// A texture that holds these texels of 4 bytes, layer after layer, to be read back.
#[cfg(test)]
pub(crate) fn texture_of(gpu: &Gpu, size: wgpu::Extent3d, format: wgpu::TextureFormat, texels: &[u8]) -> wgpu::Texture {
    let texture = gpu.device.create_texture(&wgpu::TextureDescriptor {
        label: None,
        size,
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::COPY_SRC | wgpu::TextureUsages::RENDER_ATTACHMENT,
        view_formats: &[],
    });
    let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * size.width), rows_per_image: Some(size.height) };
    gpu.queue.write_texture(texture.as_image_copy(), texels, layout, size);
    texture
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_of_any_height_give_the_whole_texture() {
        let gpu = Gpu::headless().unwrap();
        let size = wgpu::Extent3d { width: 5, height: 7, depth_or_array_layers: 2 };
        let texels: Vec<u8> = (0..2 * 5 * 7 * 4).map(|at| (at % 251) as u8).collect();
        let texture = texture_of(&gpu, size, wgpu::TextureFormat::Rgba8Unorm, &texels);
        // A row takes 256 bytes in a buffer: one row, two, all seven at a time.
        for band_bytes in [1, 600, 1 << 20] {
            for (layer, texels) in (0..).zip(texels.chunks(5 * 7 * 4)) {
                assert_eq!(gpu.read_bands(&texture, layer, band_bytes).unwrap(), texels, "{band_bytes}");
            }
        }
    }

    #[test]
    fn a_device_that_is_gone_is_known_to_be() {
        let gpu = Gpu::headless().unwrap();
        assert!(!gpu.lost() && gpu.wait().is_ok());
        gpu.device.destroy();
        // Told by the next look at the device.
        assert!(matches!(gpu.wait(), Err(GpuError::Lost(_))) && gpu.lost());
    }
}
