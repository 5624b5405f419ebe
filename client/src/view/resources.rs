//! Buffers, shadow maps and render targets of the view passes.

use bytemuck::Zeroable;
use glam::{Mat4, Vec3};
use mr360_protocol::light::{DirectionalLight, SAME_LIGHT_COS};
use mr360_shaders::layout::{self, MAX_OCCLUDERS, SHADOW_MAP_SIZE};
use mr360_shaders::{multiview, sh};

use super::background::{Background, view_uniform};
use super::cells::cells;
use super::extent::Part;
use super::mirror::MirrorLayer;
use super::pipelines::{BACK_FORMAT, DEPTH_FORMAT, LAYER_FORMAT, Layouts};
use super::plan::MAX_SHADOWS;
use super::shadows::{Frustum, LONGEST_SHADOW_M, fit};
use super::stage::Stage;
use super::{MAX_VIEWS, View, mirror};
use crate::environment::FrameLight;
use crate::environment::light::{map_cut, tan_radius};
use crate::gpu::Gpu;
use crate::scene::mesh::Bounds;

pub(super) use mr360_shaders::multiview::VIEW_STRIDE;

const _: () = assert!(2 * MAX_SHADOWS == layout::MOST_SHADOW_MAPS);

/// Everything that lives as long as the renderer, whatever is drawn.
pub(super) struct Resources {
    /// Those of the eyes, then those of their images in the ground.
    views: wgpu::Buffer,
    lighting: wgpu::Buffer,
    /// What `lighting` holds, and with it `casters`: a light's frustum is in it.
    written: layout::Lighting,
    instances: wgpu::Buffer,
    occluders: wgpu::Buffer,
    casters: wgpu::Buffer,
    shadow_maps: wgpu::TextureView,
    shadow_sampler: wgpu::Sampler,
    pub(super) shadow_layers: Vec<wgpu::TextureView>,
    pub(super) frame: wgpu::BindGroup,
    pub(super) caster_instances: wgpu::BindGroup,
    pub(super) caster_views: wgpu::BindGroup,
    pub(super) no_layer: wgpu::BindGroup,
    /// Counts the frame groups made.
    made: u64,
}

fn buffer(device: &wgpu::Device, label: &str, size: usize, usage: wgpu::BufferUsages) -> wgpu::Buffer {
    let usage = usage | wgpu::BufferUsages::COPY_DST;
    device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size: size as u64, usage, mapped_at_creation: false })
}

/// Of this name and so many levels.
pub(super) fn texture(
    device: &wgpu::Device,
    (label, mip_level_count): (&str, u32),
    (width, height): (u32, u32),
    layers: u32,
    samples: u32,
    format: wgpu::TextureFormat,
    usage: wgpu::TextureUsages,
) -> wgpu::Texture {
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some(label),
        size: wgpu::Extent3d { width: width.max(1), height: height.max(1), depth_or_array_layers: layers },
        mip_level_count,
        sample_count: samples,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage,
        view_formats: &[],
    })
}

/// Of all of a texture.
pub(super) fn texture_view(texture: &wgpu::Texture) -> wgpu::TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor::default())
}

/// Of all layers of a texture, to be looked up by view.
pub(super) fn by_view(texture: &wgpu::Texture) -> wgpu::TextureView {
    let dimension = Some(wgpu::TextureViewDimension::D2Array);
    texture.create_view(&wgpu::TextureViewDescriptor { dimension, ..Default::default() })
}

/// Of one layer of a texture.
pub(super) fn one_layer(texture: &wgpu::Texture, base_array_layer: u32) -> wgpu::TextureView {
    let (dimension, array_layer_count) = (Some(wgpu::TextureViewDimension::D2), Some(1));
    texture.create_view(&wgpu::TextureViewDescriptor { dimension, base_array_layer, array_layer_count, ..Default::default() })
}

impl Resources {
    pub(super) fn new(device: &wgpu::Device, layouts: &Layouts) -> Self {
        // A pass of both eyes sees the view after its own, too.
        let views = buffer(device, "views", (2 * MAX_VIEWS + 1) * VIEW_STRIDE as usize, wgpu::BufferUsages::UNIFORM);
        let lighting = buffer(device, "lighting", size_of::<layout::Lighting>(), wgpu::BufferUsages::UNIFORM);
        let instances = buffer(device, "instances", size_of::<layout::Instance>() * 16, wgpu::BufferUsages::STORAGE);
        let occluders = buffer(device, "occluders", size_of::<layout::Occluder>() * MAX_OCCLUDERS, wgpu::BufferUsages::UNIFORM);
        let casters = buffer(device, "casters", 2 * MAX_SHADOWS * VIEW_STRIDE as usize, wgpu::BufferUsages::UNIFORM);
        let (shadow_maps, shadow_layers) = shadow_targets(device, MAX_SHADOWS);
        let shadow_sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("shadow"),
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            compare: Some(wgpu::CompareFunction::LessEqual),
            ..Default::default()
        });
        let caster_views = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("casters"),
            layout: &layouts.caster,
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: slot(&casters, size_of::<layout::Caster>()) }],
        });
        // A fresh texture is zero: nothing drawn.
        let empty = texture(device, ("no layer", 1), (1, 1), 1, 1, LAYER_FORMAT, wgpu::TextureUsages::TEXTURE_BINDING);
        let no_layer = layer_group(device, &layouts.layer, &by_view(&empty));
        let shared = (&views, &lighting, &instances, &occluders);
        let frame = frame_group(device, &layouts.frame, shared, &shadow_maps, &shadow_sampler);
        let caster_instances = instances_group(device, &layouts.casters, &instances);
        Self {
            views,
            lighting,
            written: layout::Lighting::zeroed(),
            instances,
            occluders,
            casters,
            shadow_maps,
            shadow_sampler,
            shadow_layers,
            frame,
            caster_instances,
            caster_views,
            no_layer,
            made: 0,
        }
    }

    /// Writes what stays until the scene changes.
    pub(super) fn write_scene(&mut self, gpu: &Gpu, layouts: &Layouts, stage: &Stage) {
        let bytes: &[u8] = bytemuck::cast_slice(&stage.instances);
        let outgrown = bytes.len() as u64 > self.instances.size();
        // After the objects' maps those of the place, in scenes that have one.
        let maps = if stage.place.casters.is_empty() { MAX_SHADOWS } else { 2 * MAX_SHADOWS };
        if outgrown {
            self.instances = buffer(&gpu.device, "instances", bytes.len().next_power_of_two(), wgpu::BufferUsages::STORAGE);
        }
        if outgrown || maps != self.shadow_layers.len() {
            if maps != self.shadow_layers.len() {
                (self.shadow_maps, self.shadow_layers) = shadow_targets(&gpu.device, maps);
            }
            let shared = (&self.views, &self.lighting, &self.instances, &self.occluders);
            self.frame = frame_group(&gpu.device, &layouts.frame, shared, &self.shadow_maps, &self.shadow_sampler);
            self.made += 1;
            self.caster_instances = instances_group(&gpu.device, &layouts.casters, &self.instances);
        }
        gpu.queue.write_buffer(&self.instances, 0, bytes);
        gpu.queue.write_buffer(&self.occluders, 0, bytemuck::cast_slice(&stage.occluders));
    }

    /// The frustum of one light over the casters, with room for the widest penumbra on the ground.
    pub(super) fn frustum(&self, light: &DirectionalLight, stage: &Stage) -> Frustum {
        let fall = (stage.highest() / light.direction.y.max(0.05)).min(LONGEST_SHADOW_M);
        fit(light.direction, &stage.casters, tan_radius(light.solid_angle_sr) * fall)
    }

    /// Writes what changes with the light, if it has: lighting, and the casters' views. The second light is that of the picture, from which
    /// reflections are made. Frusta are those of the objects and those of the place; `ground` is what of it objects can change.
    pub(super) fn write_frame(
        &mut self,
        gpu: &Gpu,
        stage: &Stage,
        lights: (&FrameLight, &FrameLight),
        (objects, place): (&[Frustum], &[Frustum]),
        (occlusion, ground): (bool, Option<Bounds>),
    ) {
        let mut lighting = lighting(stage, lights, objects, place);
        if let Some(ground) = ground {
            (lighting.ground_min, lighting.ground_max) = ([ground.min.x, ground.min.z], [ground.max.x, ground.max.z]);
        }
        if !occlusion {
            lighting.occluder_count = 0;
        }
        if bytemuck::bytes_of(&lighting) == bytemuck::bytes_of(&self.written) {
            return;
        }
        for (at, frustum) in (0..).zip(objects).chain((MAX_SHADOWS..).zip(place)) {
            let caster = layout::Caster { clip_from_world: frustum.clip_from_world.to_cols_array_2d() };
            gpu.queue.write_buffer(&self.casters, at as u64 * u64::from(VIEW_STRIDE), bytemuck::bytes_of(&caster));
        }
        gpu.queue.write_buffer(&self.lighting, 0, bytemuck::bytes_of(&lighting));
        self.written = lighting;
    }

    /// Makes group 0 of the glass that stands before what a layer holds, unless it has it.
    pub(super) fn keep_glass_group(&self, gpu: &Gpu, layouts: &Layouts, glass: &mut GlassLayer) {
        if glass.group.as_ref().is_some_and(|(made, _)| *made == self.made) {
            return;
        }
        let shared = (&self.views, &self.lighting, &self.instances, &self.occluders);
        let entries = glass_entries(frame_entries(shared, &self.shadow_maps, &self.shadow_sampler), glass);
        let group =
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("glass"), layout: &layouts.glass, entries: &entries });
        glass.group = Some((self.made, group));
    }

    /// Writes a view, and how it shows the video.
    pub(super) fn write_view(&self, gpu: &Gpu, at: usize, view: (&View<'_>, Background), layer: Part) {
        self.write_view_uniform(gpu, at, &view_uniform(view, layer));
    }

    /// Writes the image of a view in the ground.
    pub(super) fn write_mirrored_view(&self, gpu: &Gpu, at: usize, view: &View<'_>, layer: Part, ground_y: f32) {
        let (own, reflection) = (view_uniform((view, Background::default()), layer), mirror::reflection(ground_y));
        let image = layout::View {
            clip_from_world: (Mat4::from_cols_array_2d(&own.clip_from_world) * reflection).to_cols_array_2d(),
            world_from_ndc: own.world_from_ndc.map(|[x, y, z, padding]| [x, -y, z, padding]),
            position: reflection.transform_point3(view.camera.position).to_array(),
            ..own
        };
        self.write_view_uniform(gpu, MAX_VIEWS + at, &image);
    }

    fn write_view_uniform(&self, gpu: &Gpu, slot: usize, uniform: &layout::View) {
        gpu.queue.write_buffer(&self.views, slot as u64 * u64::from(VIEW_STRIDE), bytemuck::bytes_of(uniform));
    }
}

/// Lights that are not in the picture's light are not cut out of its reflections, and must not come back as highlights.
fn lighting(stage: &Stage, (light, picture): (&FrameLight, &FrameLight), frusta: &[Frustum], place: &[Frustum]) -> layout::Lighting {
    let cut = |light: &DirectionalLight| {
        let same = |own: &&DirectionalLight| own.id == light.id && own.direction.dot(light.direction) > SAME_LIGHT_COS;
        picture.lights.iter().find(same).map_or(0.0, |own| map_cut(own.solid_angle_sr).share)
    };
    let ambient = sh::irradiance(&light.sh, Vec3::Y);
    let falling: Vec<Vec3> = light.lights.iter().map(|l| l.irradiance.max(Vec3::ZERO) * l.direction.y.max(0.0)).collect();
    let before = ambient + falling.iter().sum::<Vec3>();
    let sent_up = sh::radiance(&light.sh, Vec3::NEG_Y).max(Vec3::ZERO) * std::f32::consts::PI;
    let reflectance = (sent_up / before.max(Vec3::splat(1e-6))).clamp(Vec3::ZERO, Vec3::ONE);
    let mut out = layout::Lighting {
        sh: light.sh.map(|c| c.extend(0.0).to_array()),
        ground_ambient: ambient.to_array(),
        ground_before: before.to_array(),
        ground_unshadowed: falling.iter().skip(frusta.len()).sum::<Vec3>().to_array(),
        ground_reflectance: reflectance.to_array(),
        ground_y: stage.ground_y,
        shadow_count: frusta.len() as u32,
        light_count: light.lights.len() as u32,
        occluder_count: stage.occluders.len() as u32,
        ground_roughness: stage.ground_gloss.roughness,
        ground_f0: stage.ground_gloss.reflectance,
        highest_m: stage.highest(),
        ..layout::Lighting::zeroed()
    };
    let whose = [(&stage.casters[..], &stage.round[..], frusta), (&stage.place.casters[..], &[], place)];
    for (maps, (casters, round, frusta)) in out.casters.chunks_mut(MAX_SHADOWS).zip(whose) {
        for ((to, frustum), light) in maps.iter_mut().zip(frusta).zip(&light.lights) {
            let round = round.iter().copied().chain(std::iter::repeat(false));
            *to = cells(frustum, tan_radius(light.solid_angle_sr), casters.iter().copied().zip(round));
        }
    }
    for (at, (to, light)) in out.lights.iter_mut().zip(&light.lights).enumerate() {
        *to = layout::Light {
            direction: light.direction.to_array(),
            tan_radius: tan_radius(light.solid_angle_sr),
            irradiance: light.irradiance.max(Vec3::ZERO).to_array(),
            cut: cut(light),
            objects: frusta.get(at).map_or(layout::ShadowMap::NONE, |frustum| frustum.map(at as i32)),
            place: place.get(at).map_or(layout::ShadowMap::NONE, |frustum| frustum.map((MAX_SHADOWS + at) as i32)),
        };
    }
    out
}

/// This many shadow maps, and each of them.
fn shadow_targets(device: &wgpu::Device, count: usize) -> (wgpu::TextureView, Vec<wgpu::TextureView>) {
    let attachment = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING;
    let maps = texture(device, ("shadow maps", 1), (SHADOW_MAP_SIZE, SHADOW_MAP_SIZE), count as u32, 1, DEPTH_FORMAT, attachment);
    let all = by_view(&maps);
    (all, (0..count as u32).map(|layer| one_layer(&maps, layer)).collect())
}

fn slot(buffer: &wgpu::Buffer, size: usize) -> wgpu::BindingResource<'_> {
    wgpu::BindingResource::Buffer(wgpu::BufferBinding { buffer, offset: 0, size: wgpu::BufferSize::new(size as u64) })
}

fn frame_group(
    device: &wgpu::Device,
    layout: &wgpu::BindGroupLayout,
    shared: (&wgpu::Buffer, &wgpu::Buffer, &wgpu::Buffer, &wgpu::Buffer),
    shadow_maps: &wgpu::TextureView,
    shadow_sampler: &wgpu::Sampler,
) -> wgpu::BindGroup {
    let entries = frame_entries(shared, shadow_maps, shadow_sampler);
    device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("frame"), layout, entries: &entries })
}

fn frame_entries<'a>(
    (views, lighting, instances, occluders): (&'a wgpu::Buffer, &'a wgpu::Buffer, &'a wgpu::Buffer, &'a wgpu::Buffer),
    shadow_maps: &'a wgpu::TextureView,
    shadow_sampler: &'a wgpu::Sampler,
) -> [wgpu::BindGroupEntry<'a>; 6] {
    [
        wgpu::BindGroupEntry { binding: 0, resource: slot(views, (multiview::VIEWS * VIEW_STRIDE) as usize) },
        wgpu::BindGroupEntry { binding: 1, resource: lighting.as_entire_binding() },
        wgpu::BindGroupEntry { binding: 2, resource: instances.as_entire_binding() },
        wgpu::BindGroupEntry { binding: 3, resource: occluders.as_entire_binding() },
        wgpu::BindGroupEntry { binding: 4, resource: wgpu::BindingResource::TextureView(shadow_maps) },
        wgpu::BindGroupEntry { binding: 5, resource: wgpu::BindingResource::Sampler(shadow_sampler) },
    ]
}

/// Group 0 of glass: the frame's, and what was drawn before.
fn glass_entries<'a>(frame: [wgpu::BindGroupEntry<'a>; 6], glass: &'a GlassLayer) -> [wgpu::BindGroupEntry<'a>; 10] {
    let view = |binding, view| wgpu::BindGroupEntry { binding, resource: wgpu::BindingResource::TextureView(view) };
    let [a, b, c, d, e, f] = frame;
    let [depth, beside] = &glass.drawn_depths;
    [a, b, c, d, e, f, view(6, &glass.drawn), view(7, depth), view(8, &glass.back), view(9, beside)]
}

fn instances_group(device: &wgpu::Device, layout: &wgpu::BindGroupLayout, instances: &wgpu::Buffer) -> wgpu::BindGroup {
    let entries = &[wgpu::BindGroupEntry { binding: 2, resource: instances.as_entire_binding() }];
    device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("instances"), layout, entries })
}

fn layer_group(device: &wgpu::Device, layout: &wgpu::BindGroupLayout, layer: &wgpu::TextureView) -> wgpu::BindGroup {
    let entries = &[wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(layer) }];
    device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some("layer"), layout, entries })
}

/// Targets of objects and ground, of one view or of two in layers.
pub(super) struct Layer {
    pub(super) views: u32,
    /// Where there are more than one a pixel.
    pub(super) samples: Option<wgpu::TextureView>,
    pub(super) resolved: wgpu::TextureView,
    pub(super) depth: wgpu::TextureView,
    depth_texture: wgpu::Texture,
    pub(super) group: wgpu::BindGroup,
    /// Where the scene holds glass.
    pub(super) glass: Option<GlassLayer>,
    /// Where the ground mirrors objects.
    pub(super) mirror: Option<MirrorLayer>,
}

/// What glass looks at.
pub(super) struct GlassLayer {
    /// All that was drawn before, resolved.
    pub(super) drawn: wgpu::TextureView,
    drawn_depth: wgpu::Texture,
    /// Of either view.
    drawn_depths: [wgpu::TextureView; 2],
    /// The glass's own far sides.
    pub(super) back: wgpu::TextureView,
    pub(super) back_depth: wgpu::TextureView,
    /// With the number of the frame's group that it goes with.
    pub(super) group: Option<(u64, wgpu::BindGroup)>,
}

impl Layer {
    pub(super) fn new(
        device: &wgpu::Device,
        layouts: &Layouts,
        (size, views): ((u32, u32), u32),
        count: u32,
        (glass, mirror): (bool, bool),
    ) -> Self {
        let attachment = wgpu::TextureUsages::RENDER_ATTACHMENT;
        let bound = wgpu::TextureUsages::TEXTURE_BINDING;
        let make = |label, samples, format, usage| texture(device, (label, 1), size, views, samples, format, usage);
        let view = texture_view;
        let resolved = by_view(&make("layer", 1, LAYER_FORMAT, attachment | bound));
        let depth_texture = make("layer depth", count, DEPTH_FORMAT, attachment | bound | wgpu::TextureUsages::COPY_SRC);
        let glass = glass.then(|| {
            let drawn_depth = make("drawn depth", count, DEPTH_FORMAT, wgpu::TextureUsages::COPY_DST | attachment | bound);
            GlassLayer {
                drawn: by_view(&make("drawn", 1, LAYER_FORMAT, attachment | bound)),
                drawn_depths: [0, views - 1].map(|layer| one_layer(&drawn_depth, layer)),
                drawn_depth,
                back: by_view(&make("glass, far sides", 1, BACK_FORMAT, attachment | bound)),
                back_depth: view(&make("glass, far depth", 1, DEPTH_FORMAT, attachment)),
                group: None,
            }
        });
        Self {
            views,
            samples: (count > 1).then(|| view(&make("layer samples", count, LAYER_FORMAT, attachment))),
            depth: view(&depth_texture),
            depth_texture,
            group: layer_group(device, &layouts.layer, &resolved),
            resolved,
            glass,
            mirror: mirror.then(|| MirrorLayer::new(device, layouts, (size, views), count)),
        }
    }

    /// Depth of one of its views.
    pub(super) fn depth_of(&self, view: u32) -> wgpu::TextureView {
        one_layer(&self.depth_texture, view.min(self.views - 1))
    }

    /// Records that glass sees the depth of all that was drawn so far.
    pub(super) fn keep_depth(&self, encoder: &mut wgpu::CommandEncoder, glass: &GlassLayer) {
        encoder.copy_texture_to_texture(self.depth_texture.as_image_copy(), glass.drawn_depth.as_image_copy(), self.depth_texture.size());
    }
}
