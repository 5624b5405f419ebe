//! Pipelines of the real surfaces, ground and place, and of what the ground mirrors.

use mr360_shaders::source::Surface;

use super::pipelines::{Groups, Kind, LAYER_FORMAT, Layouts, MIRROR_FORMATS, Pipelines, Use, background_constants, flag, video_constants};
use super::recipe::{Recipe, build, depth, nearer};
use crate::gpu::Gpu;

impl Pipelines {
    /// Ground, the place's meshes, or the ground's horizon.
    pub(super) fn ground(&self, gpu: &Gpu, groups: &Groups<'_>, kind: Kind, what: Use) -> wgpu::RenderPipeline {
        let mut constants = video_constants(kind);
        constants.extend(background_constants(kind));
        constants.push(("PLACE", flag(kind.place)));
        // What is rough and what is smooth has one pipeline.
        let lobes = [("SURFACE", f64::from(Surface::Varying.index())), ("REFLECTIONS", f64::from(kind.reflections.index()))];
        let glossy_constants = [constants.as_slice(), &lobes].concat();
        let layouts = groups.layouts;
        // The ground gives way to what lies flat on it.
        let behind = wgpu::DepthBiasState { constant: -8, slope_scale: -2.0, clamp: 0.0 };
        let ground = Recipe {
            label: "ground",
            vertex: "vs_ground",
            fragment: Some(("fs_ground", Some(LAYER_FORMAT))),
            layouts: &[Some(&layouts.frame), Some(groups.video)],
            mesh: false,
            detailed: false,
            blend: false,
            beside: None,
            mirrored: false,
            cull: Some(wgpu::Face::Back),
            depth: Some(depth(wgpu::CompareFunction::Greater, behind)),
            samples: kind.samples,
            views: kind.views,
            constants: &constants,
        };
        match what {
            Use::Place { glossy: false } => {
                let fragment = Some(("fs_place", Some(LAYER_FORMAT)));
                build(
                    gpu,
                    &self.drawn(kind).ground,
                    &Recipe { label: "place", vertex: "vs_place", fragment, mesh: true, cull: None, ..ground },
                )
            }
            Use::Place { glossy: true } => {
                let recipe = Recipe {
                    label: "glossy place",
                    vertex: "vs_place",
                    fragment: Some(("fs_place_glossy", Some(LAYER_FORMAT))),
                    layouts: &[Some(&layouts.frame), Some(groups.video), Some(groups.reflection)],
                    mesh: true,
                    cull: None,
                    constants: &glossy_constants,
                    ..ground
                };
                build(gpu, &self.drawn(kind).ground, &recipe)
            }
            Use::PlaceMirrored => {
                let recipe = Recipe {
                    label: "mirrored place",
                    vertex: "vs_place",
                    fragment: Some(("fs_place_mirrored", Some(MIRROR_FORMATS[0]))),
                    beside: Some(MIRROR_FORMATS[1]),
                    mesh: true,
                    cull: None,
                    depth: Some(nearer()),
                    constants: &[],
                    ..ground
                };
                build(gpu, &self.drawn(kind).ground, &recipe)
            }
            Use::Ground { glossy: true } => {
                let recipe = Recipe {
                    label: "glossy ground",
                    fragment: Some(("fs_ground_glossy", Some(LAYER_FORMAT))),
                    layouts: &[Some(&layouts.frame), Some(groups.video), Some(groups.reflection), Some(&layouts.mirror)],
                    constants: &glossy_constants,
                    ..ground
                };
                build(gpu, &self.drawn(kind).ground, &recipe)
            }
            Use::Horizon => {
                let fragment = Some(("fs_horizon", Some(LAYER_FORMAT)));
                // It lies in the ground's own plane, and gives way to it too.
                let farther = wgpu::DepthBiasState { constant: -32, slope_scale: -4.0, clamp: 0.0 };
                let depth = Some(depth(wgpu::CompareFunction::Greater, farther));
                build(
                    gpu,
                    &self.drawn(kind).ground,
                    &Recipe { label: "horizon", vertex: "vs_horizon", fragment, depth, constants: &[], ..ground },
                )
            }
            _ => build(gpu, &self.drawn(kind).ground, &ground),
        }
    }

    pub(super) fn mirror_mip(&self, gpu: &Gpu, layouts: &Layouts, kind: Kind) -> wgpu::RenderPipeline {
        let recipe = Recipe {
            label: "mirror mip",
            vertex: "vs_fullscreen",
            fragment: Some(("fs_mirror_mip", Some(MIRROR_FORMATS[0]))),
            layouts: &[Some(&layouts.mirror)],
            mesh: false,
            detailed: false,
            blend: false,
            beside: Some(MIRROR_FORMATS[1]),
            mirrored: false,
            cull: None,
            depth: None,
            samples: 1,
            views: kind.views,
            constants: &[],
        };
        build(gpu, &self.drawn(kind).mirror_mip, &recipe)
    }
}
