//! Bind group layouts and pipelines of the view passes.

use std::collections::HashMap;

use mr360_shaders::layout::Vertex;
use mr360_shaders::source::{Module, Reflections, Surface};

use crate::environment::reflection::reflection_layout;
use crate::environment::{VideoKind, sampler_entry, texture_entry, video_layout};
use crate::gpu::{Gpu, GpuError};

/// Linear radiance, premultiplied by coverage.
pub(super) const LAYER_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;
/// Reversed: 1 near, 0 at infinity.
pub(super) const DEPTH_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
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
    pub(super) caster: wgpu::RenderPipeline,
    /// Of casters that let a part of the light pass.
    pub(super) sheer_caster: wgpu::RenderPipeline,
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
        textured: bool,
        double_sided: bool,
    },
    /// Glass, over what was drawn before it.
    Glass {
        textured: bool,
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
            material: make("material", &[texture_entry(0), texture_entry(1), sampler_entry(2)]),
        }
    }
}

/// What differs between the pipelines.
#[derive(Clone)]
struct Recipe<'a> {
    label: &'a str,
    vertex: &'a str,
    fragment: Option<(&'a str, Option<wgpu::TextureFormat>)>,
    layouts: &'a [Option<&'a wgpu::BindGroupLayout>],
    mesh: bool,
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
    let mesh = [Some(wgpu::VertexBufferLayout {
        array_stride: size_of::<Vertex>() as u64,
        step_mode: wgpu::VertexStepMode::Vertex,
        attributes: &attributes,
    })];
    let targets: Vec<_> = recipe.fragment.iter().filter_map(|(_, format)| *format).map(|format| Some(format.into())).collect();
    let strip = !recipe.mesh && recipe.vertex != "vs_fullscreen";
    let topology = if strip { wgpu::PrimitiveTopology::TriangleStrip } else { wgpu::PrimitiveTopology::TriangleList };
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(recipe.label),
        layout: Some(&layout),
        vertex: wgpu::VertexState {
            module,
            entry_point: Some(recipe.vertex),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers: if recipe.mesh { &mesh } else { &[] },
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

impl Pipelines {
    pub(super) fn new(gpu: &Gpu, layouts: &Layouts, target: wgpu::TextureFormat) -> Result<Self, GpuError> {
        let casters = Recipe {
            label: "caster",
            vertex: "vs_caster",
            fragment: None,
            layouts: &[Some(&layouts.casters), Some(&layouts.caster)],
            mesh: true,
            cull: None,
            depth: Some(depth(wgpu::CompareFunction::Less, wgpu::DepthBiasState::default())),
            samples: 1,
            constants: &[],
        };
        let sheer = Recipe { label: "sheer caster", vertex: "vs_sheer", fragment: Some(("fs_sheer", None)), ..casters.clone() };
        let module = gpu.shader(Module::Caster)?;
        Ok(Self {
            caster: build(gpu, &module, &casters),
            sheer_caster: build(gpu, &module, &sheer),
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

    /// A pipeline that was prepared.
    pub(super) fn get(&self, kind: Kind, what: Use) -> Option<&wgpu::RenderPipeline> {
        self.made.get(&key(kind, what))
    }

    fn make(&self, gpu: &Gpu, layouts: &Layouts, kind: Kind, what: Use) -> wgpu::RenderPipeline {
        let video = video_layout(&gpu.device);
        let flag = |value: bool| f64::from(u8::from(value));
        let [a, b, c, d] = kind.video.constants();
        let mut constants = vec![a, b, c, d, ("SH_COUNT", kind.sh_count as f64)];
        // The ground gives way to what lies flat on it.
        let behind = wgpu::DepthBiasState { constant: -8, slope_scale: -2.0, clamp: 0.0 };
        let ground = Recipe {
            label: "ground",
            vertex: "vs_ground",
            fragment: Some(("fs_ground", Some(LAYER_FORMAT))),
            layouts: &[Some(&layouts.frame), Some(&video)],
            mesh: false,
            cull: Some(wgpu::Face::Back),
            depth: Some(depth(wgpu::CompareFunction::Greater, behind)),
            samples: kind.samples,
            constants: &[],
        };
        match what {
            Use::Object { surface, textured, double_sided } => {
                constants.extend([("SURFACE", f64::from(surface.index())), ("TEXTURED", flag(textured)), ("PLACE", flag(kind.place))]);
                constants.push(("REFLECTIONS", f64::from(kind.reflections.index())));
                let reflection = reflection_layout(&gpu.device);
                let recipe = Recipe {
                    label: "object",
                    vertex: "vs_object",
                    fragment: Some(("fs_object", Some(LAYER_FORMAT))),
                    layouts: &[Some(&layouts.frame), Some(&video), Some(&reflection), Some(&layouts.material)],
                    mesh: true,
                    cull: (!double_sided).then_some(wgpu::Face::Back),
                    depth: Some(depth(wgpu::CompareFunction::Greater, wgpu::DepthBiasState::default())),
                    constants: &constants,
                    ..ground
                };
                build(gpu, &self.object, &recipe)
            }
            Use::Glass { textured } => {
                constants.extend([
                    ("SURFACE", f64::from(Surface::Glass.index())),
                    ("TEXTURED", flag(textured)),
                    ("PLACE", flag(kind.place)),
                ]);
                constants.push(("REFLECTIONS", f64::from(kind.reflections.index())));
                let reflection = reflection_layout(&gpu.device);
                let recipe = Recipe {
                    label: "glass",
                    vertex: "vs_object",
                    fragment: Some(("fs_glass", Some(LAYER_FORMAT))),
                    layouts: &[Some(&layouts.glass), Some(&video), Some(&reflection), Some(&layouts.material)],
                    mesh: true,
                    depth: Some(depth(wgpu::CompareFunction::Greater, wgpu::DepthBiasState::default())),
                    constants: &constants,
                    ..ground
                };
                build(gpu, &self.glass, &recipe)
            }
            Use::GlassBack => {
                let recipe = Recipe {
                    label: "glass, far sides",
                    vertex: "vs_object",
                    fragment: Some(("fs_glass_back", Some(BACK_FORMAT))),
                    layouts: &[Some(&layouts.frame)],
                    mesh: true,
                    cull: Some(wgpu::Face::Front),
                    depth: Some(depth(wgpu::CompareFunction::Greater, wgpu::DepthBiasState::default())),
                    samples: 1,
                    ..ground
                };
                build(gpu, &self.glass, &recipe)
            }
            Use::Ground => {
                constants.push(("PLACE", flag(kind.place)));
                build(gpu, &self.ground, &Recipe { constants: &constants, ..ground })
            }
            Use::Place => {
                constants.push(("PLACE", 1.0));
                let fragment = Some(("fs_place", Some(LAYER_FORMAT)));
                let place = Recipe { label: "place", vertex: "vs_place", mesh: true, cull: None, ..ground };
                build(gpu, &self.ground, &Recipe { fragment, constants: &constants, ..place })
            }
            Use::Horizon => {
                let fragment = Some(("fs_horizon", Some(LAYER_FORMAT)));
                // It lies in the ground's own plane, and gives way to it too.
                let farther = wgpu::DepthBiasState { constant: -32, slope_scale: -4.0, clamp: 0.0 };
                let depth = Some(depth(wgpu::CompareFunction::Greater, farther));
                build(gpu, &self.ground, &Recipe { label: "horizon", vertex: "vs_horizon", fragment, depth, ..ground })
            }
            Use::Composite => {
                let eight_bits = matches!(self.target, wgpu::TextureFormat::Rgba8Unorm | wgpu::TextureFormat::Bgra8Unorm);
                constants.push(("ENCODE_SRGB", flag(eight_bits)));
                let recipe = Recipe {
                    label: "composite",
                    vertex: "vs_fullscreen",
                    fragment: Some(("fs_composite", Some(self.target))),
                    layouts: &[Some(&layouts.frame), Some(&video), Some(&layouts.layer)],
                    cull: None,
                    depth: None,
                    samples: 1,
                    constants: &constants,
                    ..ground
                };
                build(gpu, &self.composite, &recipe)
            }
        }
    }
}
