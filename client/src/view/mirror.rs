//! What glossy ground mirrors of the objects: a picture of them from the eye's image beneath the ground, with mips, in which the
//! ground's lobes look them up. Differential rendering (Debevec 1998; Rhee et al. 2017, Sec. 5 and 6.4) in one pass: the panorama's
//! own reflection is in the video already.
//!
//! Glass is left out: clear as it is, it hides about as much of the sky from the ground as it shows.

use glam::{Mat4, Vec3};
use mr360_shaders::source::Alpha;

use super::extent::Part;
use super::glass::is_glass;
use super::pipelines::{DEPTH_FORMAT, Kind, Layouts, MIRROR_FORMATS, Use};
use super::recipe::multiview_mask;
use super::resources::{VIEW_STRIDE, by_view, texture, texture_view};
use super::stage::{Draw, Stage};
use super::{FrameReport, MAX_VIEWS, MIRROR, Renderer, View, depth_attachment, draw_part, look_into};
use crate::environment::Environment;
use crate::scene::mesh::Bounds;

/// The coarsest level has texels of 32 pixels: wider lobes average over many of them.
const LEVELS: u32 = 6;
/// Normals of a lobe lean this many times its GGX alpha to the side at most, see `lobe_ray`.
const WIDEST_SLOPE: f32 = 3.0;
/// Widest angle at which a lobe is followed beside its axis, radians.
const WIDEST_RAD: f32 = 1.0;
/// A lobe that is wider than an object at this many of its radii mirrors it no more.
const FARTHEST_RADII: f32 = 5.0;

/// Reflection in the ground.
pub(super) fn reflection(ground_y: f32) -> Mat4 {
    Mat4::from_translation(Vec3::Y * (2.0 * ground_y)) * Mat4::from_scale(Vec3::new(1.0, -1.0, 1.0))
}

impl Stage {
    /// The part of the ground, in x and z, on which an eye may see objects mirrored; `None` from beneath it.
    pub(super) fn mirrored_ground(&self, eye: Vec3) -> Option<Bounds> {
        let height = eye.y - self.ground_y;
        if height <= 0.0 {
            return None;
        }
        let alpha = self.ground_gloss.roughness * self.ground_gloss.roughness;
        let aside = (2.0 * (WIDEST_SLOPE * alpha).atan()).min(WIDEST_RAD).tan();
        let one = |caster: &Bounds| {
            let top = caster.max.y - self.ground_y;
            if top <= 0.0 {
                return None;
            }
            let mut seen = Bounds::EMPTY;
            let mut blur = 0.0f32;
            for corner in caster.corners() {
                let above = (corner.y - self.ground_y).max(0.0);
                let foot = corner.lerp(eye, above / (above + height));
                seen = seen.including(foot);
                let way = (corner - foot.with_y(self.ground_y)).length();
                // Aslant over the ground, a lobe reaches farther along it than across.
                blur = blur.max(way * aside / (above / way.max(1e-6)).max(0.1));
            }
            let margin = Vec3::splat(blur.min(FARTHEST_RADII * caster.half().length()));
            Some(Bounds { min: seen.min - margin, max: seen.max + margin })
        };
        self.casters.iter().filter_map(one).reduce(|all, one| all.including(one.min).including(one.max))
    }
}

/// Targets of what the ground mirrors.
pub(super) struct MirrorLayer {
    /// Where there are more than one a pixel.
    samples: Option<[wgpu::TextureView; 2]>,
    depth: wgpu::TextureView,
    /// Image and nearness, by level.
    levels: Vec<[wgpu::TextureView; 2]>,
    /// Each level, to be halved.
    halving: Vec<wgpu::BindGroup>,
    /// All levels, to be looked up.
    pub(super) group: wgpu::BindGroup,
}

impl MirrorLayer {
    /// For a layer of this size and so many views; `samples` to a pixel.
    pub(super) fn new(device: &wgpu::Device, layouts: &Layouts, (size, views): ((u32, u32), u32), samples: u32) -> Self {
        // Levels halve without a rest.
        let whole = |side: u32| side.next_multiple_of(1 << (LEVELS - 1));
        let size = (whole(size.0), whole(size.1));
        let attachment = wgpu::TextureUsages::RENDER_ATTACHMENT;
        let make = |label, levels, samples, format, usage| texture(device, (label, levels), size, views, samples, format, usage);
        let bound = attachment | wgpu::TextureUsages::TEXTURE_BINDING;
        let textures = MIRROR_FORMATS.map(|format| make("mirror", LEVELS, 1, format, bound));
        let level = |base_mip_level: u32| {
            let dimension = Some(wgpu::TextureViewDimension::D2Array);
            let one = wgpu::TextureViewDescriptor { dimension, base_mip_level, mip_level_count: Some(1), ..Default::default() };
            textures.each_ref().map(|texture| texture.create_view(&one))
        };
        let levels: Vec<_> = (0..LEVELS).map(level).collect();
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("mirror"),
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            mipmap_filter: wgpu::MipmapFilterMode::Linear,
            ..wgpu::SamplerDescriptor::default()
        });
        let group = |[image, nearness]: &[wgpu::TextureView; 2]| {
            let entries = [
                wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(image) },
                wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::TextureView(nearness) },
                wgpu::BindGroupEntry { binding: 2, resource: wgpu::BindingResource::Sampler(&sampler) },
            ];
            device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("mirror"), layout: &layouts.mirror, entries: &entries })
        };
        Self {
            samples: (samples > 1)
                .then(|| MIRROR_FORMATS.map(|format| texture_view(&make("mirror samples", 1, samples, format, attachment)))),
            depth: texture_view(&make("mirror depth", 1, samples, DEPTH_FORMAT, attachment)),
            halving: levels.iter().take(levels.len() - 1).map(group).collect(),
            group: group(&textures.each_ref().map(by_view)),
            levels,
        }
    }
}

impl Renderer {
    /// Draws what the ground mirrors in the part of a view that its layer holds.
    pub(super) fn draw_mirror(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        environment: &Environment,
        kind: Kind,
        (at, view, part): (usize, &View<'_>, Part),
        report: &mut FrameReport,
    ) {
        let Some(mirror) = self.layers.get(at).and_then(|(_, layer)| layer.mirror.as_ref()) else { return };
        let Some(finest) = mirror.levels.first() else { return };
        let target = |which: usize| {
            let (view, resolve_target, store) = match &mirror.samples {
                Some(samples) => (&samples[which], Some(&finest[which]), wgpu::StoreOp::Discard),
                None => (&finest[which], None, wgpu::StoreOp::Store),
            };
            let ops = wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store };
            Some(wgpu::RenderPassColorAttachment { view, depth_slice: None, resolve_target, ops })
        };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some(MIRROR[at]),
            color_attachments: &[target(0), target(1)],
            depth_stencil_attachment: Some(depth_attachment(&mirror.depth, 0.0, wgpu::StoreOp::Discard)),
            timestamp_writes: self.timer.begin(MIRROR[at]),
            multiview_mask: multiview_mask(kind.views),
            ..wgpu::RenderPassDescriptor::default()
        });
        look_into(&mut pass, view, part);
        pass.set_bind_group(0, &self.resources.frame, &[(MAX_VIEWS + at) as u32 * VIEW_STRIDE]);
        pass.set_bind_group(1, environment.bind_group(), &[]);
        pass.set_bind_group(2, environment.reflection_bind_group(), &[]);
        let image = reflection(self.stage.ground_y).transform_point3(self.between);
        let solid = self.stage.draws.iter().filter(|draw| draw.look.alpha != Alpha::Blend && !is_glass(draw));
        let (far, near) = self.stage.blended(image);
        for draw in solid {
            report.draws += self.draw_mirrored(&mut pass, kind, draw);
        }
        report.triangles += self.stage.triangles;
        if let Some(pipeline) = self.pipelines.get(kind, Use::PlaceMirrored).filter(|_| kind.place) {
            pass.set_pipeline(pipeline);
            self.draw_place_parts(&mut pass, report);
        }
        for draw in far.into_iter().chain(near) {
            report.draws += self.draw_mirrored(&mut pass, kind, draw);
        }
        drop(pass);
        self.halve_mirror(encoder, kind, at, report);
    }

    fn draw_mirrored(&self, pass: &mut wgpu::RenderPass<'_>, kind: Kind, draw: &Draw) -> u32 {
        let Some(Ok(model)) = self.models.get(&draw.geometry) else { return 0 };
        let Some(part) = model.parts.get(draw.part) else { return 0 };
        let Some(pipeline) = self.pipelines.get(kind, mirrored_use(draw)) else { return 0 };
        pass.set_pipeline(pipeline);
        pass.set_bind_group(3, if draw.own_material { &part.material } else { self.models.plain() }, &[]);
        draw_part(pass, model, part, draw);
        1
    }

    fn halve_mirror(&mut self, encoder: &mut wgpu::CommandEncoder, kind: Kind, at: usize, report: &mut FrameReport) {
        let Some(mirror) = self.layers.get(at).and_then(|(_, layer)| layer.mirror.as_ref()) else { return };
        let Some(pipeline) = self.pipelines.get(kind, Use::MirrorMip) else { return };
        let coarser = mirror.levels.iter().skip(1);
        for (level, (group, target)) in mirror.halving.iter().zip(coarser).enumerate() {
            let attach = |view| {
                let ops = wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store };
                Some(wgpu::RenderPassColorAttachment { view, depth_slice: None, resolve_target: None, ops })
            };
            let last = level + 1 == mirror.halving.len();
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some(MIRROR[at]),
                color_attachments: &[attach(&target[0]), attach(&target[1])],
                timestamp_writes: if last { self.timer.end() } else { None },
                multiview_mask: multiview_mask(kind.views),
                ..wgpu::RenderPassDescriptor::default()
            });
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, group, &[]);
            pass.draw(0..3, 0..1);
            report.draws += 1;
        }
    }
}

pub(super) fn mirrored_use(draw: &Draw) -> Use {
    Use::Mirrored { surface: draw.surface, look: draw.look, double_sided: draw.double_sided }
}
