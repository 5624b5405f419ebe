//! Both eyes by one pass, where the GPU draws two layers at once (Vulkan's multiview): half the draw calls and passes of the way view by
//! view, with the same picture.

use super::layering::Shown;
use super::pipelines::{DEPTH_FORMAT, Kind, LAYER_FORMAT};
use super::recipe::{Recipe, build, multiview_mask, nearer};
use super::resources::{texture, texture_view};
use super::{FrameReport, Renderer, View, depth_attachment};
use crate::camera::Camera;
use crate::environment::Environment;
use crate::gpu::{self, Gpu, GpuError};
use mr360_shaders::multiview::VIEWS;
use mr360_shaders::source::Module;

/// Side of the probe's picture, pixels: as software GPUs draw whole tiles otherwise than their parts, it is larger than a tile.
const PROBE_PX: u32 = 128;
/// Of the probe, as layers have.
const PROBE_SAMPLES: u32 = 4;

impl Renderer {
    /// Draws both eyes by one pass from the next frame on where this GPU can. It is tried out first, which waits for the GPU: there are
    /// drivers that offer what they get wrong (Mesa 22 draws covered tiles of the second layer to the first). True when it can.
    ///
    /// # Errors
    /// [`GpuError::Lost`] when the device went away, [`GpuError::Shader`] when the build lacks a shader file.
    pub fn use_multiview(&mut self, gpu: &Gpu) -> Result<bool, GpuError> {
        let works = works(gpu)?;
        if works {
            self.pipelines.draw_both(gpu)?;
        }
        Ok(works)
    }

    /// As [`Renderer::render`], of two views into the layers of one texture, which `both` shows together: by one pass if
    /// [`Renderer::use_multiview`] found that this works.
    pub fn render_eyes(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        environment: &mut Environment,
        (views, both): (&[View<'_>; VIEWS as usize], &wgpu::TextureView),
    ) -> FrameReport {
        let [left, right] = views;
        // What a pass draws of the ground it draws for both.
        let beneath = |view: &View<'_>| view.camera.position.y <= self.stage.ground_y;
        let alike = left.size == right.size && beneath(left) == beneath(right);
        self.record(gpu, encoder, environment, views, Some(both).filter(|_| alike && self.pipelines.draws_both()))
    }

    /// Layers and composite of both eyes.
    pub(super) fn draw_both(
        &mut self,
        gpu: &Gpu,
        (encoder, environment): (&mut wgpu::CommandEncoder, &Environment),
        kind: Kind,
        (views, target): (&[View<'_>], &wgpu::TextureView),
        shown: &Shown,
        report: &mut FrameReport,
    ) {
        let Some(first) = views.first() else { return };
        let parts = views.iter().filter_map(|view| self.part(view, kind, report.plan, shown));
        let part = parts.reduce(|all, one| all.joined(one));
        for (at, view) in views.iter().enumerate() {
            self.write_view(gpu, environment, (at, view), part, shown);
            if let Some(part) = part.filter(|_| report.plan.ground_mirrors) {
                self.resources.write_mirrored_view(gpu, at, view, part, self.stage.ground_y);
            }
        }
        // Between the eyes: which side of the ground it is on, and in which order things are blended, holds for both.
        let middle = View { camera: Camera { position: self.between, ..first.camera }, target, size: first.size };
        self.draw_recorded(gpu, (encoder, environment), kind, (0, &middle, part), shown, report);
        self.layers.truncate(1);
        self.drawn = vec![part.is_some(); views.len()];
    }
}

/// True when one pass draws each view to its own layer: with samples, resolved, and with depth.
fn works(gpu: &Gpu) -> Result<bool, GpuError> {
    if !gpu.device.features().contains(gpu::MULTIVIEW) || gpu.device.limits().max_multiview_view_count < VIEWS {
        return Ok(false);
    }
    let attachment = wgpu::TextureUsages::RENDER_ATTACHMENT;
    let make = |label, samples, format, usage| texture(&gpu.device, (label, 1), (PROBE_PX, PROBE_PX), VIEWS, samples, format, usage);
    let samples = texture_view(&make("eye probe samples", PROBE_SAMPLES, LAYER_FORMAT, attachment));
    let depth = texture_view(&make("eye probe depth", PROBE_SAMPLES, DEPTH_FORMAT, attachment));
    let resolved = make("eye probe", 1, LAYER_FORMAT, attachment | wgpu::TextureUsages::COPY_SRC);
    let recipe = Recipe {
        label: "eye probe",
        vertex: "vs_fullscreen",
        fragment: Some(("fs_eye_probe", Some(LAYER_FORMAT))),
        layouts: &[],
        mesh: false,
        detailed: false,
        blend: false,
        beside: None,
        mirrored: false,
        cull: None,
        depth: Some(wgpu::DepthStencilState { depth_compare: Some(wgpu::CompareFunction::Always), ..nearer() }),
        samples: PROBE_SAMPLES,
        views: VIEWS,
        constants: &[],
    };
    let pipeline = build(gpu, &gpu.multiview_shader(Module::EyeProbe)?, &recipe);
    let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("eye probe") });
    let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some("eye probe"),
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view: &samples,
            depth_slice: None,
            resolve_target: Some(&texture_view(&resolved)),
            ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Discard },
        })],
        depth_stencil_attachment: Some(depth_attachment(&depth, 0.0, wgpu::StoreOp::Discard)),
        multiview_mask: multiview_mask(VIEWS),
        ..wgpu::RenderPassDescriptor::default()
    });
    pass.set_pipeline(&pipeline);
    pass.draw(0..3, 0..1);
    drop(pass);
    gpu.queue.submit([encoder.finish()]);
    let mut right = true;
    for layer in 0..VIEWS {
        let texels: Vec<half::f16> = bytemuck::pod_collect_to_vec(&gpu.read_layer(&resolved, layer)?);
        right &= texels.iter().all(|value| value.to_f32() == (layer + 1) as f32);
    }
    if !right {
        tracing::info!("this GPU's driver offers multiview and gets it wrong: each eye has passes of its own");
    }
    Ok(right)
}
