//! Bind group layouts and pipelines of the view passes.

use std::collections::HashMap;

use mr360_shaders::layout::{Detail, Vertex};
use mr360_shaders::source::{Alpha, Module, Reflections, Surface};

use super::material::{Look, layout_entries};

use crate::environment::reflection::reflection_layout;
use crate::environment::{VideoKind, sampler_entry, texture_entry, video_layout};
use crate::gpu::{Gpu, GpuError};

/// Linear radiance, premultiplied by coverage.
pub(super) const LAYER_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;
/// Reversed: 1 near, 0 at infinity.
pub const DEPTH_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
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
    object: wgpu::ShaderModule,
    glass: wgpu::ShaderModule,
    ground: wgpu::ShaderModule,
    composite: wgpu::ShaderModule,
    target: wgpu::TextureFormat,
    made: HashMap<(Kind, Use), wgpu::RenderPipeline>,
}

/// What stays for a whole stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Kind {
    pub(super) video: VideoKind,
    /// 9 or 25.
    pub(super) sh_count: usize,
    /// A pixel of objects and ground.
    pub(super) samples: u32,
    pub(super) reflections: Reflections,
    /// The scene has meshes of the place.
    pub(super) place: bool,
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
    Ground,
    Place,
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
        let unfiltered = wgpu::BindGroupLayoutEntry {
            ty: wgpu::BindingType::Texture {
                sample_type: wgpu::TextureSampleType::Float { filterable: false },
                view_dimension: wgpu::TextureViewDimension::D2,
                multisampled: false,
            },
            ..texture_entry(0)
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
                    wgpu::BindGroupLayoutEntry { binding: 6, ..unfiltered },
                    wgpu::BindGroupLayoutEntry { binding: 7, ty: depth_samples, ..unfiltered },
                    wgpu::BindGroupLayoutEntry { binding: 8, ..unfiltered },
                ],
            ),
            casters: make("casters", &[instances]),
            caster: make("caster", &[buffer_entry(0, uniform, true)]),
            layer: make("layer", &[unfiltered]),
            material: make("material", &layout_entries()),
        }
    }
}

/// What differs between the pipelines.
#[derive(Clone)]
struct Recipe<'a> {
    label: &'a str,
    vertex: &'a str,
    /// Entry point, and what it colours, if anything.
    fragment: Option<(&'a str, Option<wgpu::TextureFormat>)>,
    layouts: &'a [Option<&'a wgpu::BindGroupLayout>],
    mesh: bool,
    /// The mesh has a second vertex buffer.
    detailed: bool,
    blend: bool,
    cull: Option<wgpu::Face>,
    depth: Option<wgpu::DepthStencilState>,
    samples: u32,
    /// Of the fragment shader.
    constants: &'a [(&'a str, f64)],
}

fn build(gpu: &Gpu, module: &wgpu::ShaderModule, recipe: &Recipe<'_>) -> wgpu::RenderPipeline {
    let layout = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(recipe.label),
        bind_group_layouts: recipe.layouts,
        immediate_size: 0,
    });
    let attributes = wgpu::vertex_attr_array![0 => Float32x3, 1 => Float32x3, 2 => Float32x2];
    let details = wgpu::vertex_attr_array![3 => Float32x4, 4 => Float32x2, 5 => Unorm16x4];
    let buffer = |size: usize, attributes| {
        Some(wgpu::VertexBufferLayout { array_stride: size as u64, step_mode: wgpu::VertexStepMode::Vertex, attributes })
    };
    let mesh = [buffer(size_of::<Vertex>(), &attributes), buffer(size_of::<Detail>(), &details)];
    let buffers = match (recipe.mesh, recipe.detailed) {
        (false, _) => &mesh[..0],
        (true, false) => &mesh[..1],
        (true, true) => &mesh[..],
    };
    let blend = recipe.blend.then_some(wgpu::BlendState::PREMULTIPLIED_ALPHA_BLENDING);
    let target = |format: Option<wgpu::TextureFormat>| Some(wgpu::ColorTargetState { blend, ..format?.into() });
    let targets: Vec<_> = recipe.fragment.iter().filter(|(_, format)| format.is_some()).map(|(_, format)| target(*format)).collect();
    let strip = !recipe.mesh && recipe.vertex != "vs_fullscreen";
    let topology = if strip { wgpu::PrimitiveTopology::TriangleStrip } else { wgpu::PrimitiveTopology::TriangleList };
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(recipe.label),
        layout: Some(&layout),
        vertex: wgpu::VertexState {
            module,
            entry_point: Some(recipe.vertex),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers,
        },
        primitive: wgpu::PrimitiveState { topology, cull_mode: recipe.cull, ..wgpu::PrimitiveState::default() },
        depth_stencil: recipe.depth.clone(),
        multisample: wgpu::MultisampleState { count: recipe.samples, ..wgpu::MultisampleState::default() },
        fragment: recipe.fragment.map(|(entry, _)| wgpu::FragmentState {
            module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions { constants: recipe.constants, ..Default::default() },
            targets: &targets,
        }),
        multiview_mask: None,
        cache: None,
    })
}

fn depth(compare: wgpu::CompareFunction, bias: wgpu::DepthBiasState) -> wgpu::DepthStencilState {
    wgpu::DepthStencilState {
        format: DEPTH_FORMAT,
        depth_write_enabled: Some(true),
        depth_compare: Some(compare),
        stencil: wgpu::StencilState::default(),
        bias,
    }
}

/// The composite does not draw to what has samples.
fn key(kind: Kind, what: Use) -> (Kind, Use) {
    (if what == Use::Composite { Kind { samples: 1, ..kind } } else { kind }, what)
}

fn caster_depth() -> wgpu::DepthStencilState {
    depth(wgpu::CompareFunction::Less, wgpu::DepthBiasState::default())
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
            cull: None,
            depth: Some(caster_depth()),
            samples: 1,
            constants: &[],
        };
        let sheer = Recipe { label: "sheer caster", vertex: "vs_sheer", fragment: Some(("fs_sheer", None)), ..casters.clone() };
        let module = gpu.shader(Module::Caster)?;
        Ok(Self {
            caster: build(gpu, &module, &casters),
            sheer_caster: build(gpu, &module, &sheer),
            cutout: gpu.shader(Module::Cutout)?,
            cutouts: HashMap::new(),
            object: gpu.shader(Module::Object)?,
            glass: gpu.shader(Module::Glass)?,
            ground: gpu.shader(Module::Ground)?,
            composite: gpu.shader(Module::Composite)?,
            target,
            made: HashMap::new(),
        })
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
            cull: None,
            depth: Some(caster_depth()),
            samples: 1,
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
            Use::Object { surface, look, double_sided } => self.object(gpu, &groups, kind, (surface, look, double_sided)),
            Use::Glass { look } => self.glass(gpu, &groups, kind, look),
            Use::GlassBack => self.glass_back(gpu, &groups),
            Use::Ground | Use::Place | Use::Horizon => self.ground(gpu, &groups, kind, what),
            Use::Composite => self.composite(gpu, &groups, kind),
        }
    }

    fn object(
        &self,
        gpu: &Gpu,
        groups: &Groups<'_>,
        kind: Kind,
        (surface, look, double_sided): (Surface, Look, bool),
    ) -> wgpu::RenderPipeline {
        let mut constants = surface_constants(kind, surface, look);
        constants.push(("SAMPLES", f64::from(kind.samples)));
        let Groups { layouts, video, reflection } = groups;
        let recipe = Recipe {
            label: "object",
            vertex: object_vertex(look),
            fragment: Some((object_entry(look), Some(LAYER_FORMAT))),
            layouts: &[Some(&layouts.frame), Some(video), Some(reflection), Some(&layouts.material)],
            mesh: true,
            detailed: look.detailed,
            blend: look.alpha == Alpha::Blend,
            cull: (!double_sided).then_some(wgpu::Face::Back),
            depth: Some(wgpu::DepthStencilState { depth_write_enabled: Some(look.alpha != Alpha::Blend), ..nearer() }),
            samples: kind.samples,
            constants: &constants,
        };
        build(gpu, &self.object, &recipe)
    }

    fn glass(&self, gpu: &Gpu, groups: &Groups<'_>, kind: Kind, look: Look) -> wgpu::RenderPipeline {
        let Groups { layouts, video, reflection } = groups;
        let entry = if look.detailed { "fs_glass_detailed" } else { "fs_glass" };
        let recipe = Recipe {
            label: "glass",
            vertex: object_vertex(look),
            fragment: Some((entry, Some(LAYER_FORMAT))),
            layouts: &[Some(&layouts.glass), Some(video), Some(reflection), Some(&layouts.material)],
            mesh: true,
            detailed: look.detailed,
            blend: false,
            cull: Some(wgpu::Face::Back),
            depth: Some(nearer()),
            samples: kind.samples,
            constants: &surface_constants(kind, Surface::Glass, look),
        };
        build(gpu, &self.glass, &recipe)
    }

    fn glass_back(&self, gpu: &Gpu, groups: &Groups<'_>) -> wgpu::RenderPipeline {
        let recipe = Recipe {
            label: "glass, far sides",
            vertex: "vs_object",
            fragment: Some(("fs_glass_back", Some(BACK_FORMAT))),
            layouts: &[Some(&groups.layouts.frame)],
            mesh: true,
            detailed: false,
            blend: false,
            cull: Some(wgpu::Face::Front),
            depth: Some(nearer()),
            samples: 1,
            constants: &[],
        };
        build(gpu, &self.glass, &recipe)
    }

    /// Ground, the place's meshes, or the ground's horizon.
    fn ground(&self, gpu: &Gpu, groups: &Groups<'_>, kind: Kind, what: Use) -> wgpu::RenderPipeline {
        let mut constants = video_constants(kind);
        constants.push(("PLACE", flag(kind.place)));
        // The ground gives way to what lies flat on it.
        let behind = wgpu::DepthBiasState { constant: -8, slope_scale: -2.0, clamp: 0.0 };
        let ground = Recipe {
            label: "ground",
            vertex: "vs_ground",
            fragment: Some(("fs_ground", Some(LAYER_FORMAT))),
            layouts: &[Some(&groups.layouts.frame), Some(groups.video)],
            mesh: false,
            detailed: false,
            blend: false,
            cull: Some(wgpu::Face::Back),
            depth: Some(depth(wgpu::CompareFunction::Greater, behind)),
            samples: kind.samples,
            constants: &constants,
        };
        match what {
            Use::Place => {
                let fragment = Some(("fs_place", Some(LAYER_FORMAT)));
                build(gpu, &self.ground, &Recipe { label: "place", vertex: "vs_place", fragment, mesh: true, cull: None, ..ground })
            }
            Use::Horizon => {
                let fragment = Some(("fs_horizon", Some(LAYER_FORMAT)));
                // It lies in the ground's own plane, and gives way to it too.
                let farther = wgpu::DepthBiasState { constant: -32, slope_scale: -4.0, clamp: 0.0 };
                let depth = Some(depth(wgpu::CompareFunction::Greater, farther));
                build(gpu, &self.ground, &Recipe { label: "horizon", vertex: "vs_horizon", fragment, depth, constants: &[], ..ground })
            }
            _ => build(gpu, &self.ground, &ground),
        }
    }

    fn composite(&self, gpu: &Gpu, groups: &Groups<'_>, kind: Kind) -> wgpu::RenderPipeline {
        let eight_bits = matches!(self.target, wgpu::TextureFormat::Rgba8Unorm | wgpu::TextureFormat::Bgra8Unorm);
        let mut constants = video_constants(kind);
        constants.push(("ENCODE_SRGB", flag(eight_bits)));
        let recipe = Recipe {
            label: "composite",
            vertex: "vs_fullscreen",
            fragment: Some(("fs_composite", Some(self.target))),
            layouts: &[Some(&groups.layouts.frame), Some(groups.video), Some(&groups.layouts.layer)],
            mesh: false,
            detailed: false,
            blend: false,
            cull: None,
            depth: None,
            samples: 1,
            constants: &constants,
        };
        build(gpu, &self.composite, &recipe)
    }
}

/// Layouts of the bind groups.
struct Groups<'a> {
    layouts: &'a Layouts,
    video: &'a wgpu::BindGroupLayout,
    reflection: &'a wgpu::BindGroupLayout,
}

fn flag(value: bool) -> f64 {
    f64::from(u8::from(value))
}

/// Nothing lies before it, which depth is reversed for.
fn nearer() -> wgpu::DepthStencilState {
    depth(wgpu::CompareFunction::Greater, wgpu::DepthBiasState::default())
}

/// What shaders that see the video ask for.
fn video_constants(kind: Kind) -> Vec<(&'static str, f64)> {
    let [a, b, c, d] = kind.video.constants();
    vec![a, b, c, d, ("SH_COUNT", kind.sh_count as f64)]
}

/// What shaders of objects ask for besides.
fn surface_constants(kind: Kind, surface: Surface, look: Look) -> Vec<(&'static str, f64)> {
    let mut constants = video_constants(kind);
    constants.extend([("SURFACE", f64::from(surface.index())), ("PLACE", flag(kind.place))]);
    constants.push(("REFLECTIONS", f64::from(kind.reflections.index())));
    constants.extend(look.constants());
    constants
}
