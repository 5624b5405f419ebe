//! Bind group layouts and pipelines of the view passes.

use std::collections::HashMap;

use mr360_shaders::source::{Alpha, Module, Reflections, Surface};

use super::material::{Look, layout_entries};
use super::recipe::{Recipe, build, caster_depth, nearer};
use crate::environment::reflection::reflection_layout;
use crate::environment::{VideoKind, sampler_entry, texture_entry, video_layout};
use crate::gpu::{Gpu, GpuError};

/// Linear radiance, premultiplied by coverage.
pub(super) const LAYER_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;
/// Reversed: 1 near, 0 at infinity.
pub const DEPTH_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
/// What the ground mirrors: radiance, premultiplied by coverage; and coverage over the way to it, per metre.
pub(super) const MIRROR_FORMATS: [wgpu::TextureFormat; 2] = [wgpu::TextureFormat::Rgba16Float, wgpu::TextureFormat::R16Float];
/// Back faces of glass: outward normal, and metres from the eye.
pub(super) const BACK_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba32Float;

pub(super) struct Layouts {
    /// Group 0 of what is drawn in the layer.
    pub(super) frame: wgpu::BindGroupLayout,
    /// Group 0 of glass: the same and what was drawn before.
    pub(super) glass: wgpu::BindGroupLayout,
    /// Group 0 of the casters' pass: the same without the shadow maps it draws.
    pub(super) casters: wgpu::BindGroupLayout,
    /// Group 1 of the casters' pass.
    pub(super) caster: wgpu::BindGroupLayout,
    /// Group 2 of the composite.
    pub(super) layer: wgpu::BindGroupLayout,
    /// Group 3 of glossy ground: what it mirrors.
    pub(super) mirror: wgpu::BindGroupLayout,
    /// Group 3 of objects.
    pub(super) material: wgpu::BindGroupLayout,
}

/// The pipelines in use. Those that see the video are made for its kind and for the kind of surface, when first needed.
pub(super) struct Pipelines {
    /// Of opaque casters.
    caster: wgpu::RenderPipeline,
    /// Of glass, which lets a part of the light pass.
    sheer_caster: wgpu::RenderPipeline,
    cutout: wgpu::ShaderModule,
    /// Casters with holes, by what of their looks counts.
    cutouts: HashMap<Look, wgpu::RenderPipeline>,
    /// For passes of one view.
    one: Drawn,
    /// For passes of both eyes' views, once they are wanted.
    both: Option<Drawn>,
    target: wgpu::TextureFormat,
    made: HashMap<(Kind, Use), wgpu::RenderPipeline>,
}

/// Shaders of what views show.
pub(super) struct Drawn {
    object: wgpu::ShaderModule,
    glass: wgpu::ShaderModule,
    pub(super) ground: wgpu::ShaderModule,
    pub(super) mirror_mip: wgpu::ShaderModule,
    composite: wgpu::ShaderModule,
}

impl Drawn {
    fn new(make: impl Fn(Module) -> Result<wgpu::ShaderModule, GpuError>) -> Result<Self, GpuError> {
        Ok(Self {
            object: make(Module::Object)?,
            glass: make(Module::Glass)?,
            ground: make(Module::Ground)?,
            mirror_mip: make(Module::MirrorMip)?,
            composite: make(Module::Composite)?,
        })
    }
}

/// What stays for a whole stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Kind {
    pub(super) video: VideoKind,
    /// 9 or 25.
    pub(super) sh_count: usize,
    /// A pixel of objects and ground.
    pub(super) samples: u32,
    /// That a pass draws, 1 or 2.
    pub(super) views: u32,
    pub(super) reflections: Reflections,
    /// The scene has meshes of the place.
    pub(super) place: bool,
    /// The background has a distance.
    pub(super) parallax: bool,
    /// Pixels are finer than the texels of a coded picture.
    pub(super) magnified: bool,
}

/// What a pipeline draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Use {
    Object {
        surface: Surface,
        look: Look,
        double_sided: bool,
    },
    /// Glass, over what was drawn before it.
    Glass {
        look: Look,
    },
    /// The far sides of glass.
    GlassBack,
    /// An object as the ground mirrors it.
    Mirrored {
        surface: Surface,
        look: Look,
        double_sided: bool,
    },
    /// A level of what the ground mirrors to the next.
    MirrorMip,
    Ground {
        glossy: bool,
    },
    Place {
        glossy: bool,
    },
    /// The place as the ground mirrors it: hides what is behind it.
    PlaceMirrored,
    Horizon,
    Composite,
}

fn buffer_entry(binding: u32, ty: wgpu::BufferBindingType, has_dynamic_offset: bool) -> wgpu::BindGroupLayoutEntry {
    let ty = wgpu::BindingType::Buffer { ty, has_dynamic_offset, min_binding_size: None };
    wgpu::BindGroupLayoutEntry { binding, visibility: wgpu::ShaderStages::VERTEX_FRAGMENT, ty, count: None }
}

impl Layouts {
    pub(super) fn new(device: &wgpu::Device) -> Self {
        let storage = wgpu::BufferBindingType::Storage { read_only: true };
        let uniform = wgpu::BufferBindingType::Uniform;
        let shadow_maps = wgpu::BindGroupLayoutEntry {
            ty: wgpu::BindingType::Texture {
                sample_type: wgpu::TextureSampleType::Depth,
                view_dimension: wgpu::TextureViewDimension::D2Array,
                multisampled: false,
            },
            ..texture_entry(4)
        };
        let shadow_sampler =
            wgpu::BindGroupLayoutEntry { ty: wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Comparison), ..sampler_entry(5) };
        let make = |label, entries: &[_]| device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries });
        let shared = [
            buffer_entry(0, uniform, true),
            buffer_entry(1, uniform, false),
            buffer_entry(2, storage, false),
            buffer_entry(3, uniform, false),
        ];
        let [view, lighting, instances, occluders] = shared;
        // Of layers by view.
        let by_view = |binding, filterable| wgpu::BindGroupLayoutEntry {
            ty: wgpu::BindingType::Texture {
                sample_type: wgpu::TextureSampleType::Float { filterable },
                view_dimension: wgpu::TextureViewDimension::D2Array,
                multisampled: false,
            },
            ..texture_entry(binding)
        };
        let depth_samples = wgpu::BindingType::Texture {
            sample_type: wgpu::TextureSampleType::Depth,
            view_dimension: wgpu::TextureViewDimension::D2,
            multisampled: true,
        };
        Self {
            frame: make("frame", &[view, lighting, instances, occluders, shadow_maps, shadow_sampler]),
            glass: make(
                "glass",
                &[
                    view,
                    lighting,
                    instances,
                    occluders,
                    shadow_maps,
                    shadow_sampler,
                    by_view(6, false),
                    wgpu::BindGroupLayoutEntry { ty: depth_samples, ..texture_entry(7) },
                    by_view(8, false),
                    wgpu::BindGroupLayoutEntry { ty: depth_samples, ..texture_entry(9) },
                ],
            ),
            casters: make("casters", &[instances]),
            caster: make("caster", &[buffer_entry(0, uniform, true)]),
            layer: make("layer", &[by_view(0, false)]),
            mirror: make("mirror", &[by_view(0, true), by_view(1, true), sampler_entry(2)]),
            material: make("material", &layout_entries()),
        }
    }
}

/// The composite does not draw to what has samples.
fn key(kind: Kind, what: Use) -> (Kind, Use) {
    (if matches!(what, Use::Composite | Use::MirrorMip) { Kind { samples: 1, ..kind } } else { kind }, what)
}

fn object_vertex(look: Look) -> &'static str {
    if look.detailed { "vs_object_detailed" } else { "vs_object" }
}

fn object_entry(look: Look) -> &'static str {
    match (look.alpha, look.detailed) {
        (Alpha::Mask, false) => "fs_object_masked",
        (Alpha::Mask, true) => "fs_object_detailed_masked",
        (_, false) => "fs_object",
        (_, true) => "fs_object_detailed",
    }
}

fn mirrored_entry(look: Look) -> &'static str {
    if look.detailed { "fs_object_detailed_mirrored" } else { "fs_object_mirrored" }
}

impl Pipelines {
    pub(super) fn new(gpu: &Gpu, layouts: &Layouts, target: wgpu::TextureFormat) -> Result<Self, GpuError> {
        let casters = Recipe {
            label: "caster",
            vertex: "vs_caster",
            fragment: None,
            layouts: &[Some(&layouts.casters), Some(&layouts.caster)],
            mesh: true,
            detailed: false,
            blend: false,
            beside: None,
            mirrored: false,
            cull: None,
            depth: Some(caster_depth()),
            samples: 1,
            views: 1,
            constants: &[],
        };
        let sheer = Recipe { label: "sheer caster", vertex: "vs_sheer", fragment: Some(("fs_sheer", None)), ..casters.clone() };
        let module = gpu.shader(Module::Caster)?;
        Ok(Self {
            caster: build(gpu, &module, &casters),
            sheer_caster: build(gpu, &module, &sheer),
            cutout: gpu.shader(Module::Cutout)?,
            cutouts: HashMap::new(),
            one: Drawn::new(|module| gpu.shader(module))?,
            both: None,
            target,
            made: HashMap::new(),
        })
    }

    /// Has passes of both eyes' views, which the device can draw.
    ///
    /// # Errors
    /// [`GpuError::Shader`] when the build lacks a shader file.
    pub(super) fn draw_both(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        self.both = Some(Drawn::new(|module| gpu.multiview_shader(module))?);
        Ok(())
    }

    /// True when there are passes of both eyes' views.
    pub(super) fn draws_both(&self) -> bool {
        self.both.is_some()
    }

    /// Shaders for passes of this kind.
    pub(super) fn drawn(&self, kind: Kind) -> &Drawn {
        self.both.as_ref().filter(|_| kind.views > 1).unwrap_or(&self.one)
    }

    /// Makes a pipeline unless it is there.
    pub(super) fn prepare(&mut self, gpu: &Gpu, layouts: &Layouts, kind: Kind, what: Use) {
        if !self.made.contains_key(&key(kind, what)) {
            self.made.insert(key(kind, what), self.make(gpu, layouts, kind, what));
        }
    }

    /// Makes the pipeline of a caster unless it is there.
    pub(super) fn prepare_caster(&mut self, gpu: &Gpu, layouts: &Layouts, surface: Surface, look: Look) {
        let look = look.cutout();
        if surface == Surface::Glass || look.alpha == Alpha::Opaque || self.cutouts.contains_key(&look) {
            return;
        }
        let recipe = Recipe {
            label: "caster with holes",
            vertex: if look.detailed { "vs_cutout_detailed" } else { "vs_cutout" },
            fragment: Some(("fs_cutout", None)),
            layouts: &[Some(&layouts.casters), Some(&layouts.caster), None, Some(&layouts.material)],
            mesh: true,
            detailed: look.detailed,
            blend: false,
            beside: None,
            mirrored: false,
            cull: None,
            depth: Some(caster_depth()),
            samples: 1,
            views: 1,
            constants: &look.cutout_constants(),
        };
        self.cutouts.insert(look, build(gpu, &self.cutout, &recipe));
    }

    /// The pipeline of a caster that was prepared, and whether it looks at the material.
    pub(super) fn caster(&self, surface: Surface, look: Look) -> (&wgpu::RenderPipeline, bool) {
        if surface == Surface::Glass {
            return (&self.sheer_caster, false);
        }
        match self.cutouts.get(&look.cutout()) {
            Some(cutout) if look.alpha != Alpha::Opaque => (cutout, true),
            _ => (&self.caster, false),
        }
    }

    /// A pipeline that was prepared.
    pub(super) fn get(&self, kind: Kind, what: Use) -> Option<&wgpu::RenderPipeline> {
        self.made.get(&key(kind, what))
    }

    fn make(&self, gpu: &Gpu, layouts: &Layouts, kind: Kind, what: Use) -> wgpu::RenderPipeline {
        let video = video_layout(&gpu.device);
        let reflection = reflection_layout(&gpu.device);
        let groups = Groups { layouts, video: &video, reflection: &reflection };
        match what {
            Use::Object { surface, look, double_sided } => self.object(gpu, &groups, kind, (surface, look, double_sided), false),
            Use::Mirrored { surface, look, double_sided } => self.object(gpu, &groups, kind, (surface, look, double_sided), true),
            Use::MirrorMip => self.mirror_mip(gpu, layouts, kind),
            Use::Glass { look } => self.glass(gpu, &groups, kind, look),
            Use::GlassBack => self.glass_back(gpu, &groups, kind),
            Use::Ground { .. } | Use::Place { .. } | Use::PlaceMirrored | Use::Horizon => self.ground(gpu, &groups, kind, what),
            Use::Composite => self.composite(gpu, &groups, kind),
        }
    }

    fn object(
        &self,
        gpu: &Gpu,
        groups: &Groups<'_>,
        kind: Kind,
        (surface, look, double_sided): (Surface, Look, bool),
        mirrored: bool,
    ) -> wgpu::RenderPipeline {
        let mut constants = surface_constants(kind, surface, look);
        constants.push(("SAMPLES", f64::from(kind.samples)));
        let Groups { layouts, video, reflection } = groups;
        let recipe = Recipe {
            label: "object",
            vertex: object_vertex(look),
            fragment: Some((if mirrored { mirrored_entry(look) } else { object_entry(look) }, Some(LAYER_FORMAT))),
            layouts: &[Some(&layouts.frame), Some(video), Some(reflection), Some(&layouts.material)],
            mesh: true,
            detailed: look.detailed,
            blend: look.alpha == Alpha::Blend,
            beside: mirrored.then_some(MIRROR_FORMATS[1]),
            mirrored,
            cull: (!double_sided).then_some(wgpu::Face::Back),
            depth: Some(wgpu::DepthStencilState { depth_write_enabled: Some(look.alpha != Alpha::Blend), ..nearer() }),
            samples: kind.samples,
            views: kind.views,
            constants: &constants,
        };
        build(gpu, &self.drawn(kind).object, &recipe)
    }

    fn glass(&self, gpu: &Gpu, groups: &Groups<'_>, kind: Kind, look: Look) -> wgpu::RenderPipeline {
        let Groups { layouts, video, reflection } = groups;
        let entry = if look.detailed { "fs_glass_detailed" } else { "fs_glass" };
        let mut constants = surface_constants(kind, Surface::Glass, look);
        constants.push(("PARALLAX", flag(kind.parallax)));
        let recipe = Recipe {
            label: "glass",
            vertex: object_vertex(look),
            fragment: Some((entry, Some(LAYER_FORMAT))),
            layouts: &[Some(&layouts.glass), Some(video), Some(reflection), Some(&layouts.material)],
            mesh: true,
            detailed: look.detailed,
            blend: false,
            beside: None,
            mirrored: false,
            cull: Some(wgpu::Face::Back),
            depth: Some(nearer()),
            samples: kind.samples,
            views: kind.views,
            constants: &constants,
        };
        build(gpu, &self.drawn(kind).glass, &recipe)
    }

    fn glass_back(&self, gpu: &Gpu, groups: &Groups<'_>, kind: Kind) -> wgpu::RenderPipeline {
        let recipe = Recipe {
            label: "glass, far sides",
            vertex: "vs_object",
            fragment: Some(("fs_glass_back", Some(BACK_FORMAT))),
            layouts: &[Some(&groups.layouts.frame)],
            mesh: true,
            detailed: false,
            blend: false,
            beside: None,
            mirrored: false,
            cull: Some(wgpu::Face::Front),
            depth: Some(nearer()),
            samples: 1,
            views: kind.views,
            constants: &[],
        };
        build(gpu, &self.drawn(kind).glass, &recipe)
    }

    fn composite(&self, gpu: &Gpu, groups: &Groups<'_>, kind: Kind) -> wgpu::RenderPipeline {
        let codes = matches!(self.target, wgpu::TextureFormat::Rgba8Unorm | wgpu::TextureFormat::Bgra8Unorm);
        let encoded = matches!(self.target, wgpu::TextureFormat::Rgba8UnormSrgb | wgpu::TextureFormat::Bgra8UnormSrgb);
        let mut constants = video_constants(kind);
        constants.extend(background_constants(kind));
        constants.extend([("ENCODE_SRGB", flag(codes)), ("EIGHT_BITS", flag(codes || encoded))]);
        let recipe = Recipe {
            label: "composite",
            vertex: "vs_fullscreen",
            fragment: Some(("fs_composite", Some(self.target))),
            layouts: &[Some(&groups.layouts.frame), Some(groups.video), Some(&groups.layouts.layer)],
            mesh: false,
            detailed: false,
            blend: false,
            beside: None,
            mirrored: false,
            cull: None,
            depth: None,
            samples: 1,
            views: kind.views,
            constants: &constants,
        };
        build(gpu, &self.drawn(kind).composite, &recipe)
    }
}

/// Layouts of the bind groups.
pub(super) struct Groups<'a> {
    pub(super) layouts: &'a Layouts,
    pub(super) video: &'a wgpu::BindGroupLayout,
    pub(super) reflection: &'a wgpu::BindGroupLayout,
}

pub(super) fn flag(value: bool) -> f64 {
    f64::from(u8::from(value))
}

/// What shaders that see the video ask for.
pub(super) fn video_constants(kind: Kind) -> Vec<(&'static str, f64)> {
    let [a, b, c, d] = kind.video.constants();
    vec![a, b, c, d, ("SH_COUNT", kind.sh_count as f64)]
}

/// What shaders that show the video ask for besides.
pub(super) fn background_constants(kind: Kind) -> [(&'static str, f64); 2] {
    [("PARALLAX", flag(kind.parallax)), ("MAGNIFIED", flag(kind.magnified))]
}

/// What shaders of objects ask for besides.
fn surface_constants(kind: Kind, surface: Surface, look: Look) -> Vec<(&'static str, f64)> {
    let mut constants = video_constants(kind);
    constants.extend([("SURFACE", f64::from(surface.index())), ("PLACE", flag(kind.place))]);
    constants.push(("REFLECTIONS", f64::from(kind.reflections.index())));
    constants.extend(look.constants());
    constants
}
