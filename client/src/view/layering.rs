//! The layer of objects and changed ground, and the composite that puts it over the video.

use mr360_shaders::source::Alpha;

use super::background::{Background, pixel_rad, rays};
use super::extent::{Part, touched};
use super::glass::is_glass;
use super::pipelines::{Kind, Use};
use super::plan::Plan;
use super::recipe::multiview_mask;
use super::resources::{Layer, VIEW_STRIDE};
use super::room::Room;
use super::{COMPOSITE, FrameReport, OBJECTS, Renderer, View, depth_attachment, draw_part, look_into, object_use, stage};
use crate::environment::Environment;
use crate::gpu::Gpu;
use crate::scene::mesh::Bounds;

/// What all views of a frame show.
pub(super) struct Shown {
    /// Of the background's dome, where it has one.
    pub(super) dome_m: Option<f32>,
    /// What objects can change of ground and place.
    pub(super) ground: Option<Bounds>,
    pub(super) changed_place: Vec<Bounds>,
}

impl Renderer {
    /// Layers and composite of one view.
    pub(super) fn draw_view(
        &mut self,
        gpu: &Gpu,
        (encoder, environment): (&mut wgpu::CommandEncoder, &Environment),
        kind: Kind,
        (at, view): (usize, &View<'_>),
        shown: &Shown,
        report: &mut FrameReport,
    ) {
        let part = self.part(view, kind, report.plan, shown);
        self.write_view(gpu, environment, (at, view), part, shown);
        self.draw_recorded(gpu, (encoder, environment), kind, (at, view, part), shown, report);
    }

    /// What of a view is in its layer.
    pub(super) fn part(&self, view: &View<'_>, kind: Kind, plan: Plan, shown: &Shown) -> Option<Part> {
        match kind.place && kind.parallax {
            // All of it, so that pixels lie in it as they do without objects.
            true => Some(Part { origin: (0, 0), size: view.size }),
            false if plan.objects => touched(&view.camera, view.size, &self.stage, (self.ground_seen(view, shown), &shown.changed_place)),
            false => None,
        }
    }

    /// From beneath there is no ground to see.
    fn ground_seen(&self, view: &View<'_>, shown: &Shown) -> Option<Bounds> {
        shown.ground.filter(|_| view.camera.position.y > self.stage.ground_y)
    }

    pub(super) fn write_view(
        &self,
        gpu: &Gpu,
        environment: &Environment,
        (at, view): (usize, &View<'_>),
        part: Option<Part>,
        shown: &Shown,
    ) {
        let rays = if self.fine { rays(environment.texels(pixel_rad(view))) } else { 1 };
        let background = Background { dome_m: shown.dome_m.unwrap_or_default(), rays };
        self.resources.write_view(gpu, at, (view, background), part.unwrap_or_default());
    }

    /// Layers and composite of a view, or of two by one pass, whose uniforms have been written from `at` on.
    pub(super) fn draw_recorded(
        &mut self,
        gpu: &Gpu,
        (encoder, environment): (&mut wgpu::CommandEncoder, &Environment),
        kind: Kind,
        (at, view, part): (usize, &View<'_>, Option<Part>),
        shown: &Shown,
        report: &mut FrameReport,
    ) {
        let plan = report.plan;
        let ground = self.ground_seen(view, shown).is_some();
        self.drawn.push(part.is_some());
        if let Some(part) = part {
            self.make_layer(gpu, (at, kind.views), (part, view.size), plan);
            if plan.ground_mirrors && ground {
                if kind.views == 1 {
                    self.resources.write_mirrored_view(gpu, at, view, part, self.stage.ground_y);
                }
                self.draw_mirror(encoder, environment, kind, (at, view, part), report);
            }
            self.draw_layer(encoder, environment, kind, (at, view, part), ground, report);
            if plan.glass {
                self.draw_glass(gpu, encoder, environment, kind, (at, view, part), report);
            }
        }
        self.composite(encoder, environment, kind, (at, view), part.is_some(), report);
    }

    /// The layer's targets, kept while they hold the part and are not far too large for it.
    pub(super) fn make_layer(&mut self, gpu: &Gpu, (at, views): (usize, u32), (part, image): (Part, (u32, u32)), plan: Plan) {
        let (glass, mirror) = (plan.glass, plan.ground_mirrors);
        let make = |room: &Room| Layer::new(&gpu.device, &self.layouts, (room.size(), views), self.samples, (glass, mirror));
        // Views before this one may have had nothing to draw.
        while self.layers.len() <= at {
            let mut room = Room::default();
            room.make(part.size, image);
            self.layers.push((room, make(&room)));
        }
        if let Some((room, layer)) = self.layers.get_mut(at)
            && (room.make(part.size, image) || layer.views != views || layer.glass.is_some() != glass || layer.mirror.is_some() != mirror)
        {
            *layer = make(room);
        }
    }

    pub(super) fn draw_layer(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        environment: &Environment,
        kind: Kind,
        (at, view, part): (usize, &View<'_>, Part),
        ground: bool,
        report: &mut FrameReport,
    ) {
        let Some((_, layer)) = self.layers.get(at) else { return };
        // Glass goes over the samples of what was drawn, and sees them resolved.
        let (resolved, samples_store) = match &layer.glass {
            Some(glass) => (&glass.drawn, wgpu::StoreOp::Store),
            None => (&layer.resolved, wgpu::StoreOp::Discard),
        };
        let depth_store = if self.keeps_depth { wgpu::StoreOp::Store } else { samples_store };
        let (target, resolve_target, store) = match &layer.samples {
            Some(samples) => (samples, Some(resolved), samples_store),
            None => (resolved, None, wgpu::StoreOp::Store),
        };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some(OBJECTS[at]),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: target,
                depth_slice: None,
                resolve_target,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store },
            })],
            depth_stencil_attachment: Some(depth_attachment(&layer.depth, 0.0, depth_store)),
            timestamp_writes: self.timer.pass(OBJECTS[at]),
            multiview_mask: multiview_mask(kind.views),
            ..wgpu::RenderPassDescriptor::default()
        });
        look_into(&mut pass, view, part);
        pass.set_bind_group(0, &self.resources.frame, &[at as u32 * VIEW_STRIDE]);
        pass.set_bind_group(1, environment.bind_group(), &[]);
        pass.set_bind_group(2, environment.reflection_bind_group(), &[]);
        // The place may be drawn without any.
        let objects = report.plan.objects;
        if objects {
            for draw in self.stage.draws.iter().filter(|draw| draw.look.alpha != Alpha::Blend && !is_glass(draw)) {
                report.draws += self.draw_object(&mut pass, kind, draw);
            }
            report.triangles += self.stage.triangles;
        }
        self.draw_place(&mut pass, kind, report);
        // After the objects, so that ground they cover is not shaded. From beneath there is no ground to see.
        let changed = (ground && objects, Use::Ground { glossy: layer.mirror.is_some() });
        if let Some(mirror) = &layer.mirror {
            pass.set_bind_group(3, &mirror.group, &[]);
        }
        let hiding = (report.plan.ground_hides && view.camera.position.y > self.stage.ground_y, Use::Horizon);
        for (_, what) in [changed, hiding].into_iter().filter(|(drawn, _)| *drawn) {
            if let Some(pipeline) = self.pipelines.get(kind, what) {
                pass.set_pipeline(pipeline);
                pass.draw(0..4, 0..1);
                report.draws += 1;
            }
        }
        // Over all that covers, ground too, which writes what is changed and not what is added to it.
        for draw in self.stage.blended(self.between).0.into_iter().filter(|_| objects) {
            report.draws += self.draw_object(&mut pass, kind, draw);
        }
    }

    /// Draws one, if its pipeline and model are there; the groups of frame, environment and reflections are set. Returns the draw calls.
    pub(super) fn draw_object(&self, pass: &mut wgpu::RenderPass<'_>, kind: Kind, draw: &stage::Draw) -> u32 {
        let Some(Ok(model)) = self.models.get(&draw.geometry) else { return 0 };
        let Some(part) = model.parts.get(draw.part) else { return 0 };
        let Some(pipeline) = self.pipelines.get(kind, object_use(draw)) else { return 0 };
        pass.set_pipeline(pipeline);
        pass.set_bind_group(3, if draw.own_material { &part.material } else { self.models.plain() }, &[]);
        draw_part(pass, model, part, draw);
        1
    }

    pub(super) fn composite(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        environment: &Environment,
        kind: Kind,
        (at, view): (usize, &View<'_>),
        drawn: bool,
        report: &mut FrameReport,
    ) {
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some(COMPOSITE[at]),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: view.target,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            })],
            timestamp_writes: self.timer.pass(COMPOSITE[at]),
            multiview_mask: multiview_mask(kind.views),
            ..wgpu::RenderPassDescriptor::default()
        });
        let layer = self.layers.get(at).filter(|_| drawn).map_or(&self.resources.no_layer, |(_, layer)| &layer.group);
        let Some(pipeline) = self.pipelines.get(kind, Use::Composite) else { return };
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &self.resources.frame, &[at as u32 * VIEW_STRIDE]);
        pass.set_bind_group(1, environment.bind_group(), &[]);
        pass.set_bind_group(2, layer, &[]);
        pass.draw(0..3, 0..1);
        report.draws += 1;
    }
}
