//! Planes of a picture as textures.

use half::f16;

use crate::gpu::Gpu;
use crate::picture::{Picture, Plane, Samples};

/// Why a picture was not taken.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum UploadError {
    /// A side of 0, or larger than the GPU takes.
    #[error("a plane of {width}×{height} pixels does not fit this GPU, which takes 1 to {largest} on a side; send a smaller video")]
    Size {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Longest side.
        largest: u32,
    },
    /// Fewer bytes than rows and stride say, or a stride shorter than a row.
    #[error("a plane of {width}×{height} pixels with stride {stride} holds {bytes} bytes, fewer than it needs; drop the frame")]
    Short {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Bytes from row to row.
        stride: usize,
        /// Bytes held.
        bytes: usize,
    },
    /// Neither 8 nor 9 to 16 bits.
    #[error("samples of {0} bits are not supported; 8 to 16 are")]
    BitDepth(u8),
}

/// Textures of the picture's planes.
pub(super) struct Planes {
    textures: [wgpu::Texture; 3],
    views: [wgpu::TextureView; 3],
    code_scale: f32,
}

impl Planes {
    pub(super) fn black(device: &wgpu::Device) -> Self {
        Self::from_textures([(); 3].map(|()| plane_texture(device, wgpu::TextureFormat::R8Unorm, 1, 1)))
    }

    fn from_textures(textures: [wgpu::Texture; 3]) -> Self {
        let views = textures.each_ref().map(|texture| texture.create_view(&wgpu::TextureViewDescriptor::default()));
        Self { textures, views, code_scale: 1.0 }
    }

    pub(super) fn views(&self) -> [&wgpu::TextureView; 3] {
        self.views.each_ref()
    }

    /// Sampled value · this = code over largest code.
    pub(super) fn code_scale(&self) -> f32 {
        self.code_scale
    }

    /// Writes the picture; true when textures were made anew.
    pub(super) fn write(&mut self, gpu: &Gpu, picture: &Picture) -> Result<bool, UploadError> {
        let largest = gpu.device.limits().max_texture_dimension_2d;
        match &picture.samples {
            Samples::Yuv { planes, colour } => {
                let depth = Depth::new(colour.bit_depth, gpu.device.features())?;
                for plane in planes {
                    check(plane, depth.bytes(), largest)?;
                }
                let mut changed = false;
                for (at, plane) in planes.iter().enumerate() {
                    changed |= self.ensure(gpu, at, depth.format(), plane.width, plane.height);
                    depth.write(gpu, &self.textures[at], plane);
                }
                self.code_scale = depth.code_scale();
                Ok(changed)
            }
            Samples::Rgba16F { texels, .. } => {
                let (width, height) = (picture.width, picture.height);
                let bytes: &[u8] = bytemuck::cast_slice(texels);
                check_size(width, height, largest)?;
                let stride = width as usize * 8;
                if bytes.len() < stride * height as usize {
                    return Err(UploadError::Short { width, height, stride, bytes: bytes.len() });
                }
                let changed = self.ensure(gpu, 0, wgpu::TextureFormat::Rgba16Float, width, height);
                write(gpu, &self.textures[0], bytes, stride);
                self.code_scale = 1.0;
                Ok(changed)
            }
        }
    }

    fn ensure(&mut self, gpu: &Gpu, at: usize, format: wgpu::TextureFormat, width: u32, height: u32) -> bool {
        let texture = &self.textures[at];
        if texture.format() == format && texture.width() == width && texture.height() == height {
            return false;
        }
        self.textures[at] = plane_texture(&gpu.device, format, width, height);
        self.views[at] = self.textures[at].create_view(&wgpu::TextureViewDescriptor::default());
        true
    }
}

/// How samples of a depth lie in a texture.
enum Depth {
    Eight,
    /// Two bytes, sampled as code / 65535.
    Sixteen {
        bits: u8,
    },
    /// Two bytes on a GPU without 16-bit normalised textures: half floats of code over largest code, which
    /// tell all codes of up to 10 bits apart.
    Half {
        bits: u8,
    },
}

impl Depth {
    fn new(bits: u8, features: wgpu::Features) -> Result<Self, UploadError> {
        match bits {
            8 => Ok(Self::Eight),
            9..=16 if features.contains(wgpu::Features::TEXTURE_FORMAT_16BIT_NORM) => Ok(Self::Sixteen { bits }),
            9..=16 => Ok(Self::Half { bits }),
            _ => Err(UploadError::BitDepth(bits)),
        }
    }

    fn bytes(&self) -> usize {
        if matches!(self, Self::Eight) { 1 } else { 2 }
    }

    fn format(&self) -> wgpu::TextureFormat {
        match self {
            Self::Eight => wgpu::TextureFormat::R8Unorm,
            Self::Sixteen { .. } => wgpu::TextureFormat::R16Unorm,
            Self::Half { .. } => wgpu::TextureFormat::R16Float,
        }
    }

    fn code_scale(&self) -> f32 {
        match self {
            Self::Sixteen { bits } => 65_535.0 / largest_code(*bits),
            Self::Eight | Self::Half { .. } => 1.0,
        }
    }

    fn write(&self, gpu: &Gpu, texture: &wgpu::Texture, plane: &Plane) {
        let Self::Half { bits } = self else {
            return write(gpu, texture, &plane.data, plane.stride);
        };
        let row_bytes = plane.width as usize * 2;
        let rows = plane.data.chunks(plane.stride).take(plane.height as usize);
        let texels: Vec<f16> = rows
            .flat_map(|row| row.get(..row_bytes).unwrap_or(row).chunks_exact(2))
            .map(|code| f16::from_f32(f32::from(u16::from_le_bytes([code[0], code[1]])) / largest_code(*bits)))
            .collect();
        write(gpu, texture, bytemuck::cast_slice(&texels), row_bytes);
    }
}

fn largest_code(bits: u8) -> f32 {
    ((1u32 << bits) - 1) as f32
}

fn check_size(width: u32, height: u32, largest: u32) -> Result<(), UploadError> {
    let fits = |side| (1..=largest).contains(&side);
    if fits(width) && fits(height) { Ok(()) } else { Err(UploadError::Size { width, height, largest }) }
}

fn check(plane: &Plane, bytes_per_sample: usize, largest: u32) -> Result<(), UploadError> {
    let Plane { width, height, stride, data } = plane;
    check_size(*width, *height, largest)?;
    let row = *width as usize * bytes_per_sample;
    let needed = stride.checked_mul(*height as usize - 1).and_then(|bytes| bytes.checked_add(row));
    if *stride < row || !stride.is_multiple_of(bytes_per_sample) || needed.is_none_or(|needed| data.len() < needed) {
        return Err(UploadError::Short { width: *width, height: *height, stride: *stride, bytes: data.len() });
    }
    Ok(())
}

fn plane_texture(device: &wgpu::Device, format: wgpu::TextureFormat, width: u32, height: u32) -> wgpu::Texture {
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some("plane"),
        size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    })
}

fn write(gpu: &Gpu, texture: &wgpu::Texture, bytes: &[u8], stride: usize) {
    let bytes_per_row = u32::try_from(stride).ok();
    gpu.queue.write_texture(
        texture.as_image_copy(),
        bytes,
        wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row, rows_per_image: None },
        texture.size(),
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plane(width: u32, height: u32, stride: usize, bytes: usize) -> Plane {
        Plane { width, height, stride, data: vec![0; bytes].into() }
    }

    #[test]
    fn planes_must_hold_what_they_say() {
        assert_eq!(check(&plane(4, 2, 8, 12), 1, 64), Ok(()));
        for (bad, bytes_per_sample) in
            [(plane(4, 2, 8, 11), 1), (plane(4, 2, 3, 64), 1), (plane(4, 2, 9, 64), 2), (plane(4, 2, usize::MAX, 64), 1)]
        {
            assert!(matches!(check(&bad, bytes_per_sample, 64), Err(UploadError::Short { .. })));
        }
        assert!(matches!(check(&plane(0, 2, 8, 64), 1, 64), Err(UploadError::Size { .. })));
        assert!(matches!(check(&plane(65, 2, 80, 160), 1, 64), Err(UploadError::Size { .. })));
        assert!(matches!(Depth::new(7, wgpu::Features::empty()), Err(UploadError::BitDepth(7))));
    }
}
