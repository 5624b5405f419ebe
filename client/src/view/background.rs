//! How a view shows the video behind everything, and the view's uniform.

use mr360_shaders::layout;

use super::View;
use super::extent::Part;
use crate::gpu::Gpu;

/// How the video is resampled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum Resampling {
    /// Fine, but plain where the GPU is a program on the processor: there it takes five times as long and more.
    #[default]
    Auto,
    /// One bilinear look-up a pixel.
    Plain,
    /// By a cubic where texels are larger than pixels, and by several rays a pixel where they are smaller.
    Fine,
}

impl Resampling {
    pub(super) fn is_fine(self, gpu: &Gpu) -> bool {
        match self {
            Self::Auto => gpu.adapter.get_info().device_type != wgpu::DeviceType::Cpu,
            Self::Plain => false,
            Self::Fine => true,
        }
    }
}

/// How a view shows the video.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Background {
    /// Radius of its dome, metres.
    pub(super) dome_m: f32,
    /// Along each side of a pixel.
    pub(super) rays: u32,
}

/// Angle between pixels in the middle of a view, where they are widest.
pub(super) fn pixel_rad(view: &View<'_>) -> f32 {
    let (width, height) = (view.size.0.max(1) as f32, view.size.1.max(1) as f32);
    2.0 * view.camera.edges(width / height).half().y / height
}

/// Most rays along a side of a pixel.
const MOST_RAYS: f32 = 4.0;

/// Rays along a side of a pixel that spans so many texels. Each ray sees a triangle of two texels.
pub(super) fn rays(texels: f32) -> u32 {
    (0.75 * texels).ceil().clamp(1.0, MOST_RAYS) as u32
}

/// The view's uniform.
pub(super) fn view_uniform((view, background): (&View<'_>, Background), layer: Part) -> layout::View {
    let (width, height) = (view.size.0.max(1) as f32, view.size.1.max(1) as f32);
    let aspect = width / height;
    let camera = &view.camera;
    let axes = camera.world_from_ndc(aspect).map(|axis| axis.extend(0.0).to_array());
    layout::View {
        clip_from_world: (camera.clip_from_view(aspect) * camera.view_from_world()).to_cols_array_2d(),
        world_from_ndc: axes,
        position: camera.position.to_array(),
        eye: u32::from(camera.right_eye),
        size_px: [width, height],
        layer_origin: [layer.origin.0 as f32, layer.origin.1 as f32],
        layer_size: [layer.size.0 as f32, layer.size.1 as f32],
        // An eye stays well within the dome.
        dome_m: background.dome_m.max(2.0 * camera.position.length()),
        rays: background.rays,
    }
}
