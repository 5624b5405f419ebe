//! Meshes of the real place: they catch what objects change, cast the shadows that the video already shows, and hide
//! what is behind them. Wang et al. call the two sides bidirectional shadows; here the real side keeps a virtual shadow
//! from darkening what a real one has darkened.

use bytemuck::Zeroable as _;
use glam::{Mat3, Mat4, Vec3};
use mr360_protocol::light::DirectionalLight;
use mr360_protocol::scene::{Geometry, Gloss, PlaceMesh};
use mr360_shaders::layout::{self, SHADOW_MAP_SIZE};
use mr360_shaders::lobe::finest_level;
use mr360_shaders::source::{OCCLUDER_REACH, ROUGH_TO, Surface};

use super::material::Look;
use super::models::Models;
use super::pipelines::{Kind, Use};
use super::plan::MAX_SHADOWS;
use super::resources::VIEW_STRIDE;
use super::shadows::{Frustum, LONGEST_SHADOW_M, STEPS_AN_OCTAVE, fit_over};
use super::stage::{Draw, MAX_INSTANCES, ModelFault, Stage};
use super::{FrameReport, PLACE_SHADOWS, Renderer, depth_attachment, draw_part};
use crate::environment::FrameLight;
use crate::environment::light::tan_radius;
use crate::scene::mesh::Bounds;

/// Most objects whose shadows on the place are looked at one by one.
const MOST_CASTERS: usize = 64;
/// Most boxes that a shadow is taken apart into.
const MOST_SHADOW_PIECES: usize = 16;
/// Tangent of the widest light whose penumbrae are followed beside what objects can change.
const WIDEST_TAN: f32 = 0.5;
/// Fall of the shadows that there is room for in any case, metres: about that of what stands in a room.
const USUAL_FALL_M: f32 = 2.0;
/// Side of a texel up to which a map grows for penumbrae from farther above, metres. Shadows part from their casters by about a texel, which
/// shows from a few centimetres on; penumbrae that are wider than this leaves room for lose the outermost of what hides their light.
const COARSEST_TEXEL_M: f32 = 0.015;

/// What of the place is drawn until the scene changes.
#[derive(Debug, Default)]
pub(super) struct Place {
    /// Each with whether it casts shadows.
    pub(super) draws: Vec<(Draw, bool)>,
    /// Of all of them.
    pub(super) bounds: Vec<Bounds>,
    /// Of those that cast shadows.
    pub(super) casters: Vec<Bounds>,
    triangles: u64,
}

/// True for a surface that mirrors objects. What is too rough for a mirror image is matt.
pub(super) fn is_glossy(gloss: Gloss) -> bool {
    gloss.reflectance > 0.0 && gloss.roughness < ROUGH_TO
}

impl Stage {
    /// Adds a mesh of the place, of which `parts` of the scene's are drawn so far.
    pub(super) fn add_place(&mut self, mesh: &PlaceMesh, models: &Models, parts: &mut usize) -> Result<(), ModelFault> {
        let geometry = Geometry::Model(mesh.model);
        let model = models.get(&geometry).ok_or(ModelFault::Missing)?.map_err(|error| ModelFault::Broken(error.clone()))?;
        if *parts + model.parts.len() > MAX_INSTANCES {
            return Err(ModelFault::TooManyParts);
        }
        *parts += model.parts.len();
        self.needs.glossy_place |= is_glossy(mesh.gloss);
        self.needs.add_lobes(finest_level(mesh.gloss.roughness).filter(|_| is_glossy(mesh.gloss)));
        let transform = mesh.transform;
        let world_from_object = Mat4::from_scale_rotation_translation(transform.scale, transform.rotation, transform.position);
        let normals = Mat3::from_mat4(world_from_object).inverse().transpose();
        for (part, one) in model.parts.iter().enumerate() {
            let at = self.instances.len() as u32;
            self.instances.push(layout::Instance {
                world_from_object: world_from_object.to_cols_array_2d(),
                normal_from_object: normals.to_cols_array_2d().map(|[x, y, z]| [x, y, z, 0.0]),
                roughness: mesh.gloss.roughness,
                // Of a real surface the colour is the video's, and this its reflectance straight on.
                base_color: [mesh.gloss.reflectance; 3],
                ..layout::Instance::zeroed()
            });
            let draw = Draw {
                geometry,
                part,
                instances: at..at + 1,
                animation: None,
                own_material: false,
                look: Look::default(),
                double_sided: true,
                center: Vec3::ZERO,
                surface: Surface::Rough,
                casts: mesh.casts_shadows,
            };
            self.place.draws.push((draw, mesh.casts_shadows));
            self.place.triangles += u64::from(one.index_count / 3);
        }
        let corners = model.bounds(None).corners().map(|corner| world_from_object.transform_point3(corner));
        let bounds = corners.into_iter().fold(Bounds::EMPTY, Bounds::including);
        self.place.bounds.push(bounds);
        if mesh.casts_shadows {
            self.place.casters.push(bounds);
        }
        Ok(())
    }

    /// The parts of the place that objects can change under this light: within their occluders' reach, and in the shadows of the
    /// first `shadows` lights; all of it where it `mirrors` them, or where they are many.
    pub(super) fn changed_place(&self, light: &FrameLight, shadows: usize, mirrors: bool) -> Vec<Bounds> {
        let place = &self.place.bounds;
        if mirrors || place.is_empty() || self.casters.len() > MOST_CASTERS {
            return place.clone();
        }
        let reached = self.occluders.iter().map(reach);
        let shaded = light.lights.iter().take(shadows).flat_map(|light| {
            self.casters.iter().flat_map(|caster| shadow_pieces(light.direction, tan_radius(light.solid_angle_sr), caster, place))
        });
        reached.chain(shaded).flat_map(|space| place.iter().filter_map(move |mesh| space.common(mesh))).collect()
    }

    /// One light's view of the place, over all that objects can change: there alone its shadows are asked for.
    pub(super) fn place_frustum(&self, light: &DirectionalLight) -> Frustum {
        let changed: Vec<_> = self.occluders.iter().map(reach).chain(self.casters.iter().copied()).collect();
        let (right, up) = light.direction.any_orthonormal_pair();
        let light_from_world = Mat3::from_cols(right, up, light.direction).transpose();
        let seen = |bounds: &Bounds| bounds.corners().iter().fold(Bounds::EMPTY, |b, at| b.including(light_from_world * *at));
        let square = changed.iter().map(seen).fold(Bounds::EMPTY, |all, one| all.joined(&one));
        let tan = tan_radius(light.solid_angle_sr).clamp(0.0, WIDEST_TAN);
        let least_m = tan * USUAL_FALL_M;
        let counts = |caster: &Bounds| margin_for(&square, &seen(caster), tan).map(|margin_m| (*caster, margin_m));
        let (mut casters, margins): (Vec<_>, Vec<_>) = self.place.casters.iter().filter_map(counts).unzip();
        if casters.is_empty() {
            casters.clone_from(&self.place.casters);
        }
        let half = square.half().truncate().max_element();
        let room_m = 0.5 * SHADOW_MAP_SIZE as f32 * COARSEST_TEXEL_M / (1.0 / STEPS_AN_OCTAVE).exp2() - half;
        let margin_m = margins.into_iter().fold(least_m, f32::max).min(room_m.max(least_m));
        // What counts for nothing gives no depth either: the shaders search the wider the farther they are from the nearest plane.
        fit_over(light.direction, &changed, &casters, margin_m)
    }
}

/// How far beside the square of what objects can change a caster counts, metres; none where its penumbra ends before. Both boxes are in the
/// light's frame, z towards it. A penumbra is as wide as the tangent times the way to the farthest of what it may lie on;
/// objects' own shadows fall farther than the square reaches, and spread as much.
fn margin_for(square: &Bounds, caster: &Bounds, tan: f32) -> Option<f32> {
    let wide_m = tan * (caster.max.z - square.min.z).clamp(0.0, LONGEST_SHADOW_M);
    let gap = (square.min - caster.max).max(caster.min - square.max).truncate();
    let beyond = (square.min - caster.min).max(caster.max - square.max).truncate();
    (gap.max_element() < wide_m + 2.0 * tan * USUAL_FALL_M).then(|| beyond.max_element().clamp(0.0, wide_m))
}

/// What an occluder hides the sky from.
fn reach(occluder: &layout::Occluder) -> Bounds {
    let (center, reach) = (Vec3::from_array(occluder.center), Vec3::splat(occluder.radius * OCCLUDER_REACH));
    Bounds { min: center - reach, max: center + reach }
}

/// Boxes around a caster's shadow with its penumbra, piece by piece, up to where it leaves these boxes.
fn shadow_pieces(to_light: Vec3, tan_radius: f32, caster: &Bounds, place: &[Bounds]) -> Vec<Bounds> {
    let (center, radius) = (caster.center(), caster.half().length());
    let ends = place.iter().flat_map(Bounds::corners).map(|corner| (center - corner).dot(to_light));
    let end = (ends.fold(0.0, f32::max) + radius).min(LONGEST_SHADOW_M);
    let pieces = ((end / (2.0 * radius).max(1e-3)).ceil() as usize).clamp(1, MOST_SHADOW_PIECES);
    let step = end / pieces as f32;
    let piece = |at: usize| {
        let (near, far) = (at as f32 * step, (at + 1) as f32 * step);
        let side = Vec3::splat(radius + tan_radius * far);
        Bounds::EMPTY
            .joined(&Bounds { min: center - to_light * near - side, max: center - to_light * near + side })
            .joined(&Bounds { min: center - to_light * far - side, max: center - to_light * far + side })
    };
    (0..pieces).map(piece).collect()
}

impl Renderer {
    /// Frusta of the place's shadow maps, for the lights that have maps of the objects; none where no mesh casts.
    pub(super) fn place_frusta(&self, shadows: usize) -> Vec<Frustum> {
        let count = if self.stage.place.casters.is_empty() { 0 } else { shadows };
        self.current.lights.iter().take(count).map(|light| self.stage.place_frustum(light)).collect()
    }

    /// Draws the place as the first lights see it, unless its maps show just that.
    pub(super) fn draw_place_shadows(&mut self, encoder: &mut wgpu::CommandEncoder, frusta: Vec<Frustum>, report: &mut FrameReport) {
        if self.place_shown == frusta {
            return;
        }
        for (at, (layer, name)) in self.resources.shadow_layers.iter().skip(MAX_SHADOWS).zip(PLACE_SHADOWS).take(frusta.len()).enumerate() {
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some(name),
                depth_stencil_attachment: Some(depth_attachment(layer, 1.0, wgpu::StoreOp::Store)),
                timestamp_writes: self.timer.pass(name),
                ..wgpu::RenderPassDescriptor::default()
            });
            pass.set_pipeline(self.pipelines.caster(Surface::Rough, Look::default()).0);
            pass.set_bind_group(0, &self.resources.caster_instances, &[]);
            pass.set_bind_group(1, &self.resources.caster_views, &[(MAX_SHADOWS + at) as u32 * VIEW_STRIDE]);
            for (draw, _) in self.stage.place.draws.iter().filter(|(_, casts)| *casts) {
                if let Some(Ok(model)) = self.models.get(&draw.geometry)
                    && let Some(part) = model.parts.get(draw.part)
                {
                    draw_part(&mut pass, model, part, draw);
                    report.draws += 1;
                }
            }
        }
        self.place_shown = frusta;
    }

    /// Draws the place into the layer: what objects change of it, and nothing where they do not.
    pub(super) fn draw_place(&self, pass: &mut wgpu::RenderPass<'_>, kind: Kind, report: &mut FrameReport) {
        let glossy = report.plan.place_mirrors;
        let Some(pipeline) = self.pipelines.get(kind, Use::Place { glossy }).filter(|_| kind.place) else { return };
        pass.set_pipeline(pipeline);
        self.draw_place_parts(pass, report);
    }

    pub(super) fn draw_place_parts(&self, pass: &mut wgpu::RenderPass<'_>, report: &mut FrameReport) {
        for (draw, _) in &self.stage.place.draws {
            if let Some(Ok(model)) = self.models.get(&draw.geometry)
                && let Some(part) = model.parts.get(draw.part)
            {
                draw_part(pass, model, part, draw);
                report.draws += 1;
            }
        }
        report.triangles += self.stage.place.triangles;
    }
}
