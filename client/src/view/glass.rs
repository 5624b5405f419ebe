//! Glass, drawn after everything else but what is blended before it: its far sides first, then its near ones, which see them and
//! all that was drawn before.

use mr360_shaders::source::Surface;

use super::extent::Part;
use super::pipelines::{Kind, Use};
use super::recipe::multiview_mask;
use super::resources::VIEW_STRIDE;
use super::{FrameReport, GLASS, Renderer, View, depth_attachment, draw_part, look_into, stage};
use crate::environment::Environment;
use crate::gpu::Gpu;

impl Renderer {
    /// Draws the glass of a view over its layer, which [`Renderer::draw_layer`] left with its samples and depth.
    pub(super) fn draw_glass(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        environment: &Environment,
        kind: Kind,
        (at, view, part): (usize, &View<'_>, Part),
        report: &mut FrameReport,
    ) {
        self.draw_far_sides(encoder, kind, (at, view, part), report);
        let Self { layers, resources, layouts, .. } = self;
        if let Some(glass) = layers.get_mut(at).and_then(|(_, layer)| layer.glass.as_mut()) {
            resources.keep_glass_group(gpu, layouts, glass);
        }
        self.draw_near_sides(encoder, environment, kind, (at, view, part), report);
    }

    fn draw_far_sides(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        kind: Kind,
        (at, view, part): (usize, &View<'_>, Part),
        report: &mut FrameReport,
    ) {
        let Some((_, layer)) = self.layers.get(at) else { return };
        let (Some(glass), Some(pipeline)) = (&layer.glass, self.pipelines.get(kind, Use::GlassBack)) else { return };
        layer.keep_depth(encoder, glass);
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some(GLASS[at]),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &glass.back,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store },
            })],
            depth_stencil_attachment: Some(depth_attachment(&glass.back_depth, 0.0, wgpu::StoreOp::Discard)),
            timestamp_writes: self.timer.begin(GLASS[at]),
            multiview_mask: multiview_mask(kind.views),
            ..wgpu::RenderPassDescriptor::default()
        });
        look_into(&mut pass, view, part);
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &self.resources.frame, &[at as u32 * VIEW_STRIDE]);
        for draw in self.stage.draws.iter().filter(|draw| is_glass(draw)) {
            if let Some(Ok(model)) = self.models.get(&draw.geometry)
                && let Some(part) = model.parts.get(draw.part)
            {
                draw_part(&mut pass, model, part, draw);
                report.draws += 1;
            }
        }
    }

    fn draw_near_sides(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        environment: &Environment,
        kind: Kind,
        (at, view, part): (usize, &View<'_>, Part),
        report: &mut FrameReport,
    ) {
        let Some((_, layer)) = self.layers.get(at) else { return };
        let (Some((_, group)), Some(samples)) = (layer.glass.as_ref().and_then(|glass| glass.group.as_ref()), &layer.samples) else {
            return;
        };
        let store = if self.keeps_depth { wgpu::StoreOp::Store } else { wgpu::StoreOp::Discard };
        let kept = wgpu::Operations { load: wgpu::LoadOp::Load, store };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some(GLASS[at]),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: samples,
                depth_slice: None,
                resolve_target: Some(&layer.resolved),
                ops: wgpu::Operations { load: wgpu::LoadOp::Load, store: wgpu::StoreOp::Discard },
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &layer.depth,
                depth_ops: Some(kept),
                stencil_ops: None,
            }),
            timestamp_writes: self.timer.end(),
            multiview_mask: multiview_mask(kind.views),
            ..wgpu::RenderPassDescriptor::default()
        });
        look_into(&mut pass, view, part);
        pass.set_bind_group(0, group, &[at as u32 * VIEW_STRIDE]);
        pass.set_bind_group(1, environment.bind_group(), &[]);
        pass.set_bind_group(2, environment.reflection_bind_group(), &[]);
        for draw in self.stage.draws.iter().filter(|draw| is_glass(draw)) {
            report.draws += self.draw_object(&mut pass, kind, draw);
        }
        let (_, nearer) = self.stage.blended(self.between);
        if !nearer.is_empty() {
            pass.set_bind_group(0, &self.resources.frame, &[at as u32 * VIEW_STRIDE]);
        }
        for draw in nearer {
            report.draws += self.draw_object(&mut pass, kind, draw);
        }
    }
}

pub(super) fn is_glass(draw: &stage::Draw) -> bool {
    draw.surface == Surface::Glass
}
