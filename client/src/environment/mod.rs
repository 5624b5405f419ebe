//! Video rate: the decoded picture on the GPU, and the reflection map made of it when something reflects.

pub(crate) mod albedo;
pub(crate) mod light;
pub(crate) mod reflection;
mod upload;

use bytemuck::Zeroable;
use glam::Mat3;
use mr360_protocol::light::Lift;
use mr360_protocol::video::{StereoLayout, Transfer};
use mr360_shaders::colour::{bt709_from_primaries, rgb_from_yuv};
use mr360_shaders::layout;
use mr360_shaders::source::{lift_index, transfer_index};

use crate::gpu::{Gpu, GpuError};
use crate::picture::{Picture, Samples};
use crate::view::timing::PassTimer;

pub use light::FrameLight;
pub use upload::UploadError;

use reflection::{How, ReflectionMap};
use upload::Planes;

/// What stays for a whole stream, and is fixed in pipelines when they are made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct VideoKind {
    transfer: u32,
    planar: bool,
    whole_width: bool,
    lift: u32,
}

impl VideoKind {
    fn new(picture: &Picture, lift: u32) -> Self {
        let (transfer, planar) = match &picture.samples {
            Samples::Yuv { colour, .. } => (colour.transfer, true),
            Samples::Rgba16F { transfer, .. } => (*transfer, false),
        };
        let whole_width = [false, true].iter().all(|right| picture.stereo.eye_rect(*right)[2] == 1.0);
        Self { transfer: transfer_index(transfer), planar, whole_width, lift }
    }

    /// Constants of the shaders that see the video.
    pub(crate) fn constants(self) -> [(&'static str, f64); 4] {
        [
            ("TRANSFER", f64::from(self.transfer)),
            ("PLANAR", f64::from(u8::from(self.planar))),
            ("WHOLE_WIDTH", f64::from(u8::from(self.whole_width))),
            ("LIFT", f64::from(self.lift)),
        ]
    }
}

/// The panorama as the shaders see it.
pub struct Environment {
    layout: wgpu::BindGroupLayout,
    sampler: wgpu::Sampler,
    uniform: wgpu::Buffer,
    /// What `uniform` holds.
    video: layout::Video,
    kind: VideoKind,
    planes: Planes,
    bind_group: wgpu::BindGroup,
    /// Of one eye's panorama.
    eye_size: (u32, u32),
    stereo: bool,
    reflections: ReflectionMap,
    /// The method that the reflection maps are up to date for.
    reflected: Option<How>,
}

impl Environment {
    /// A black panorama.
    ///
    /// # Errors
    /// [`GpuError::Shader`] when the build lacks a shader file.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let layout = video_layout(&gpu.device);
        let sampler = gpu.device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("video"),
            address_mode_u: wgpu::AddressMode::Repeat,
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..wgpu::SamplerDescriptor::default()
        });
        let uniform = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("video"),
            size: size_of::<layout::Video>() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let planes = Planes::black(&gpu.device);
        let bind_group = video_bind_group(&gpu.device, &layout, &uniform, &planes, &sampler);
        let reflections = ReflectionMap::new(gpu, &layout)?;
        let eye_rect = [StereoLayout::Mono.eye_rect(false); 2];
        let video = layout::Video { eye_rect, bt709_from_primaries: columns(Mat3::IDENTITY), ..layout::Video::zeroed() };
        gpu.queue.write_buffer(&uniform, 0, bytemuck::bytes_of(&video));
        let kind =
            VideoKind { transfer: transfer_index(Transfer::Linear), planar: false, whole_width: true, lift: lift_index(Lift::Linear) };
        Ok(Self {
            layout,
            sampler,
            uniform,
            video,
            kind,
            planes,
            bind_group,
            eye_size: (1, 1),
            stereo: false,
            reflections,
            reflected: None,
        })
    }

    /// Puts the next picture on the GPU. Textures are kept while size and format stay.
    ///
    /// # Errors
    /// [`UploadError`] when the picture's planes do not hold what they say, or are larger than the GPU takes;
    /// the picture before it stays.
    pub fn upload(&mut self, gpu: &Gpu, picture: &Picture) -> Result<(), UploadError> {
        if self.planes.write(gpu, picture)? {
            self.bind_group = video_bind_group(&gpu.device, &self.layout, &self.uniform, &self.planes, &self.sampler);
        }
        self.eye_size = picture.stereo.eye_size(picture.width, picture.height);
        self.stereo = picture.stereo != StereoLayout::Mono;
        self.kind = VideoKind::new(picture, self.kind.lift);
        self.video = layout::Video { recovery: self.video.recovery, ..video_uniform(picture, self.planes.code_scale()) };
        gpu.queue.write_buffer(&self.uniform, 0, bytemuck::bytes_of(&self.video));
        self.reflected = None;
        Ok(())
    }

    /// Takes the light that belongs to the picture: its lift, and the lights to leave out of reflections.
    pub(crate) fn set_light(&mut self, gpu: &Gpu, light: &FrameLight) {
        self.kind.lift = lift_index(light.lift);
        let recovery = light.lift.into();
        if self.video.recovery != recovery {
            self.video.recovery = recovery;
            gpu.queue.write_buffer(&self.uniform, 0, bytemuck::bytes_of(&self.video));
        }
        self.reflected = None;
    }

    /// Records the rebuilding of what reflections are looked up in, if picture, light or `how` changed since the last time.
    pub(crate) fn refresh_reflections(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        light: &FrameLight,
        how: How,
        timer: &mut PassTimer,
    ) {
        if self.reflected != Some(how) {
            self.reflections.record(gpu, encoder, (self.kind, &self.bind_group), self.eye_size.0, (light, how), timer);
            self.reflected = Some(how);
        }
    }

    /// The picture shows each eye its own view.
    pub(crate) fn is_stereo(&self) -> bool {
        self.stereo
    }

    /// Texels of the panorama across an angle, along its finer side; fewer at its poles, where columns are but nearer.
    pub(crate) fn texels(&self, angle_rad: f32) -> f32 {
        let (width, height) = (self.eye_size.0 as f32, self.eye_size.1 as f32);
        angle_rad * (width / std::f32::consts::TAU).max(height / std::f32::consts::PI)
    }

    /// The picture is of codes: what lies between them is smooth, as it is not in light without bounds.
    pub(crate) fn is_coded(&self) -> bool {
        self.kind.transfer != transfer_index(Transfer::Linear)
    }

    /// What pipelines that see the video are made for.
    pub(crate) fn kind(&self) -> VideoKind {
        self.kind
    }

    /// Group 1 of the shaders that see the video.
    pub(crate) fn bind_group(&self) -> &wgpu::BindGroup {
        &self.bind_group
    }

    /// Group 2 of the shaders that see reflections.
    pub(crate) fn reflection_bind_group(&self) -> &wgpu::BindGroup {
        self.reflections.bind_group()
    }
}

fn columns(m: Mat3) -> [[f32; 4]; 3] {
    m.to_cols_array_2d().map(|[x, y, z]| [x, y, z, 0.0])
}

/// `code_scale` is the largest sampled value over the largest code: sampled · scale is what `rgb_from_yuv` expects.
fn video_uniform(picture: &Picture, code_scale: f32) -> layout::Video {
    let eye_rect = [picture.stereo.eye_rect(false), picture.stereo.eye_rect(true)];
    match &picture.samples {
        Samples::Yuv { planes, colour } => {
            let (matrix, offset) = rgb_from_yuv(*colour);
            let [luma, chroma, _] = planes;
            let subsampled = chroma.width < luma.width;
            layout::Video {
                rgb_from_yuv: columns(matrix * code_scale),
                bt709_from_primaries: columns(bt709_from_primaries(colour.primaries)),
                eye_rect,
                yuv_offset: (offset / code_scale).to_array(),
                chroma_shift_u: if subsampled { 0.5 / picture.width as f32 } else { 0.0 },
                recovery: layout::Recovery::zeroed(),
            }
        }
        Samples::Rgba16F { .. } => layout::Video { bt709_from_primaries: columns(Mat3::IDENTITY), eye_rect, ..layout::Video::zeroed() },
    }
}

/// Stages that see the video and what is made of it.
const LOOKED_AT_BY: wgpu::ShaderStages = wgpu::ShaderStages::FRAGMENT.union(wgpu::ShaderStages::COMPUTE);

/// Layout of group 1: how to decode, three planes, their sampler.
pub(crate) fn video_layout(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    let uniform = wgpu::BindGroupLayoutEntry {
        binding: 0,
        visibility: LOOKED_AT_BY,
        ty: wgpu::BindingType::Buffer { ty: wgpu::BufferBindingType::Uniform, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    };
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some("video"),
        entries: &[uniform, texture_entry(1), texture_entry(2), texture_entry(3), sampler_entry(4)],
    })
}

pub(crate) fn texture_entry(binding: u32) -> wgpu::BindGroupLayoutEntry {
    let ty = wgpu::BindingType::Texture {
        sample_type: wgpu::TextureSampleType::Float { filterable: true },
        view_dimension: wgpu::TextureViewDimension::D2,
        multisampled: false,
    };
    wgpu::BindGroupLayoutEntry { binding, visibility: LOOKED_AT_BY, ty, count: None }
}

pub(crate) fn sampler_entry(binding: u32) -> wgpu::BindGroupLayoutEntry {
    let ty = wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering);
    wgpu::BindGroupLayoutEntry { binding, visibility: LOOKED_AT_BY, ty, count: None }
}

fn video_bind_group(
    device: &wgpu::Device,
    layout: &wgpu::BindGroupLayout,
    uniform: &wgpu::Buffer,
    planes: &Planes,
    sampler: &wgpu::Sampler,
) -> wgpu::BindGroup {
    let [y, cb, cr] = planes.views();
    device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some("video"),
        layout,
        entries: &[
            wgpu::BindGroupEntry { binding: 0, resource: uniform.as_entire_binding() },
            wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::TextureView(y) },
            wgpu::BindGroupEntry { binding: 2, resource: wgpu::BindingResource::TextureView(cb) },
            wgpu::BindGroupEntry { binding: 3, resource: wgpu::BindingResource::TextureView(cr) },
            wgpu::BindGroupEntry { binding: 4, resource: wgpu::BindingResource::Sampler(sampler) },
        ],
    })
}
