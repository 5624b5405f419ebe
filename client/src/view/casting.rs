//! What casts shadows: animated models in their pose, and the maps of what each light sees of the objects.

use mr360_protocol::scene::Geometry;

use super::extent::in_view;
use super::plan::{MAX_SHADOWS, Plan};
use super::resources::VIEW_STRIDE;
use super::shadows::Frustum;
use super::{FrameReport, Renderer, SHADOWS, View, depth_attachment, draw_part};
use crate::gpu::Gpu;
use crate::scene::mesh::Bounds;

impl Renderer {
    /// Brings animated models that this frame shows into their pose, and has the shadow maps drawn anew where one moved. A shadow
    /// may fall into a view that its object is outside of.
    pub(super) fn pose(&mut self, gpu: &Gpu, encoder: &mut wgpu::CommandEncoder, plan: Plan, views: &[View<'_>]) {
        let Self { stage, models, timer, time_us, shadows, .. } = self;
        if !plan.objects || stage.animated.is_empty() {
            return;
        }
        let seen = |bounds: &Bounds| plan.shadows > 0 || views.iter().any(|view| in_view(&view.camera, view.size, bounds));
        let shown = |geometry: &Geometry, animation: usize| {
            stage.animated.iter().any(|(of, which, bounds)| (of, *which) == (geometry, animation) && seen(bounds))
        };
        if models.deform(gpu, encoder, timer, *time_us, &shown) {
            *shadows = [None; MAX_SHADOWS];
        }
    }

    /// Draws the maps that do not show the scene as their light sees it now.
    pub(super) fn draw_shadows(&mut self, encoder: &mut wgpu::CommandEncoder, frusta: &[Frustum], report: &mut FrameReport) {
        let maps = self.resources.shadow_layers.iter().zip(&mut self.shadows).zip(SHADOWS);
        for (at, (((layer, held), name), frustum)) in maps.zip(frusta).enumerate() {
            if held.replace(*frustum) == Some(*frustum) {
                continue;
            }
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some(name),
                depth_stencil_attachment: Some(depth_attachment(layer, 1.0, wgpu::StoreOp::Store)),
                timestamp_writes: self.timer.pass(name),
                ..wgpu::RenderPassDescriptor::default()
            });
            pass.set_bind_group(0, &self.resources.caster_instances, &[]);
            pass.set_bind_group(1, &self.resources.caster_views, &[at as u32 * VIEW_STRIDE]);
            for draw in self.stage.draws.iter().filter(|draw| draw.casts) {
                if let Some(Ok(model)) = self.models.get(&draw.geometry)
                    && let Some(part) = model.parts.get(draw.part)
                {
                    let (pipeline, with_material) = self.pipelines.caster(draw.surface, draw.look);
                    pass.set_pipeline(pipeline);
                    if with_material {
                        pass.set_bind_group(3, &part.material, &[]);
                    }
                    draw_part(&mut pass, model, part, draw);
                    report.draws += 1;
                }
            }
            report.triangles += self.stage.triangles;
        }
    }
}
