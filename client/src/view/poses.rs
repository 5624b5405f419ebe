//! Animated models on the GPU: their vertices are put into the pose of the picture's time by a compute pass, once for
//! all objects that play the same animation of the same model.

use std::sync::Arc;

use mr360_shaders::layout::{Delta, Influence, Vertex};
use mr360_shaders::source::Module;

use super::models::filled;
use super::timing::PassTimer;
use crate::gpu::{Gpu, GpuError};
use crate::scene::model::Model;
use crate::scene::rig::{Moving, Rig, deformation};

/// Most vertices of all animations that are played at once: a model's may be played side by side.
pub(super) const MAX_POSED_VERTICES: usize = 8_000_000;
/// Threads of a workgroup of `deform.wgsl`.
const WORKGROUP: u32 = 64;

/// The pipeline that deforms.
pub(super) struct Deformer {
    pipeline: wgpu::ComputePipeline,
    part: wgpu::BindGroupLayout,
    pose: wgpu::BindGroupLayout,
}

fn entry(binding: u32, ty: wgpu::BufferBindingType) -> wgpu::BindGroupLayoutEntry {
    let ty = wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None };
    wgpu::BindGroupLayoutEntry { binding, visibility: wgpu::ShaderStages::COMPUTE, ty, count: None }
}

impl Deformer {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let device = &gpu.device;
        let (read, write) = (wgpu::BufferBindingType::Storage { read_only: true }, wgpu::BufferBindingType::Storage { read_only: false });
        let layout =
            |label, entries: &[_]| device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries });
        let uniform = entry(0, wgpu::BufferBindingType::Uniform);
        let part = layout("deformed part", &[uniform, entry(1, read), entry(2, read), entry(3, read), entry(4, write)]);
        let pose = layout("pose", &[entry(0, read), entry(1, read)]);
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("deform"),
            bind_group_layouts: &[Some(&part), Some(&pose)],
            immediate_size: 0,
        });
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some("deform"),
            layout: Some(&pipeline_layout),
            module: &gpu.shader(Module::Deform)?,
            entry_point: Some("deform"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        Ok(Self { pipeline, part, pose })
    }

    /// Records the poses of these for a time, those that have it already left out. Without any, nothing is recorded;
    /// returns whether some were.
    pub(super) fn record<'a>(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        timer: &mut PassTimer,
        time_us: u64,
        playing: impl Iterator<Item = &'a mut Playing>,
    ) -> bool {
        let due: Vec<_> = playing.filter(|playing| playing.posed_at_us != Some(time_us)).collect();
        if due.is_empty() {
            return false;
        }
        let descriptor = wgpu::ComputePassDescriptor { label: Some("deform"), timestamp_writes: timer.compute_pass("deform") };
        let mut pass = encoder.begin_compute_pass(&descriptor);
        pass.set_pipeline(&self.pipeline);
        for playing in due {
            playing.write(gpu, time_us);
            pass.set_bind_group(1, &playing.pose, &[]);
            for part in &playing.parts {
                pass.set_bind_group(0, &part.group, &[]);
                pass.dispatch_workgroups(part.vertex_count.div_ceil(WORKGROUP), 1, 1);
            }
        }
        true
    }
}

/// What a model's animations deform, as the file has it; all of them read the same.
pub(super) struct Sources(Vec<Source>);

struct Source {
    part: usize,
    vertex_count: u32,
    /// Uniform, vertices, influences, morph targets.
    buffers: [wgpu::Buffer; 4],
}

/// One animation of one model.
pub(super) struct Playing {
    model: Arc<Model>,
    animation: usize,
    matrices: wgpu::Buffer,
    weights: wgpu::Buffer,
    pose: wgpu::BindGroup,
    parts: Vec<DeformedPart>,
    posed_at_us: Option<u64>,
}

struct DeformedPart {
    part: usize,
    vertex_count: u32,
    vertices: wgpu::Buffer,
    group: wgpu::BindGroup,
}

impl Playing {
    pub(super) fn new(gpu: &Gpu, deformer: &Deformer, sources: &Sources, model: &Arc<Model>, rig: &Rig, animation: usize) -> Self {
        let pose = rig.pose(animation, 0.0);
        // A binding may not be empty.
        let buffer = |label, size: usize| {
            let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
            gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: size.max(64) as u64,
                usage,
                mapped_at_creation: false,
            })
        };
        let matrices = buffer("pose", size_of_val(&pose.matrices[..]));
        let weights = buffer("morph weights", size_of_val(&pose.weights[..]));
        let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("pose"),
            layout: &deformer.pose,
            entries: &[
                wgpu::BindGroupEntry { binding: 0, resource: matrices.as_entire_binding() },
                wgpu::BindGroupEntry { binding: 1, resource: weights.as_entire_binding() },
            ],
        });
        let parts = sources.0.iter().map(|source| DeformedPart::new(gpu, deformer, source)).collect();
        Self { model: Arc::clone(model), animation, matrices, weights, pose: group, parts, posed_at_us: None }
    }

    /// Deformed vertices of a part of the model; `None` where nothing moves it.
    pub(super) fn vertices(&self, part: usize) -> Option<&wgpu::Buffer> {
        self.parts.iter().find(|deformed| deformed.part == part).map(|deformed| &deformed.vertices)
    }

    fn write(&mut self, gpu: &Gpu, time_us: u64) {
        let Some(rig) = &self.model.rig else { return };
        let pose = rig.pose(self.animation, time_us as f64 * 1e-6);
        gpu.queue.write_buffer(&self.matrices, 0, bytemuck::cast_slice(&pose.matrices));
        gpu.queue.write_buffer(&self.weights, 0, bytemuck::cast_slice(&pose.weights));
        self.posed_at_us = Some(time_us);
    }
}

impl Sources {
    pub(super) fn new(gpu: &Gpu, rig: &Rig) -> Self {
        Self(rig.moving.iter().map(|moving| Source::new(gpu, rig, moving)).collect())
    }

    /// Vertices that each animation deforms.
    pub(super) fn vertices(&self) -> usize {
        self.0.iter().map(|source| source.vertex_count as usize).sum()
    }
}

impl Source {
    fn new(gpu: &Gpu, rig: &Rig, moving: &Moving) -> Self {
        let primitive = &moving.primitive;
        let mesh = &primitive.mesh.vertices;
        let storage = wgpu::BufferUsages::STORAGE;
        // Bindings may not be empty: what a primitive lacks is one that nobody reads.
        let influences: &[u8] = bytemuck::cast_slice(&primitive.influences);
        let deltas: &[u8] = bytemuck::cast_slice(&primitive.deltas);
        let or_one = |bytes: &[u8], size: usize| if bytes.is_empty() { vec![0; size] } else { bytes.to_vec() };
        let binding = rig.bindings.get(moving.binding);
        let deformation = binding.map(|binding| deformation(primitive, binding));
        let buffers = [
            filled(gpu, "deformation", bytemuck::cast_slice(deformation.as_slice()), wgpu::BufferUsages::UNIFORM),
            filled(gpu, "source vertices", bytemuck::cast_slice(mesh), storage),
            filled(gpu, "influences", &or_one(influences, size_of::<Influence>()), storage),
            filled(gpu, "morph targets", &or_one(deltas, size_of::<Delta>()), storage),
        ];
        Self { part: moving.part, vertex_count: mesh.len() as u32, buffers }
    }
}

impl DeformedPart {
    fn new(gpu: &Gpu, deformer: &Deformer, source: &Source) -> Self {
        let vertices = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("deformed vertices"),
            size: u64::from(source.vertex_count) * size_of::<Vertex>() as u64,
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::VERTEX | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        let entries: Vec<_> = (0..)
            .zip(source.buffers.iter().chain([&vertices]))
            .map(|(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("deformed part"),
            layout: &deformer.part,
            entries: &entries,
        });
        Self { part: source.part, vertex_count: source.vertex_count, vertices, group }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::scene::rig::deform;
    use crate::scene::test_models::{File, arm, slider};

    fn read(gpu: &Gpu, buffer: &wgpu::Buffer) -> Vec<Vertex> {
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let copy = gpu.device.create_buffer(&wgpu::BufferDescriptor { label: None, size: buffer.size(), usage, mapped_at_creation: false });
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(buffer, 0, &copy, 0, buffer.size());
        gpu.queue.submit([encoder.finish()]);
        bytemuck::pod_collect_to_vec(&gpu.read_buffer(&copy).unwrap())
    }

    #[test]
    fn the_gpu_deforms_as_the_cpu_does() {
        let gpu = Gpu::headless().unwrap();
        let deformer = Deformer::new(&gpu).unwrap();
        let mut timer = PassTimer::new(&gpu);
        // Skinned and morphed, with normals and with flat triangles; rigid. The second part of a model has matrices further on.
        let twice = |mut file: File| {
            let mesh = file.json["meshes"][0]["primitives"][0].clone();
            file.json["meshes"][0]["primitives"].as_array_mut().unwrap().push(mesh);
            file.json["nodes"][0]["weights"] = serde_json::json!([0.5]);
            file
        };
        for (file, animation) in [(arm(true), 0), (arm(true), 1), (twice(arm(false)), 0), (slider(), 0)] {
            let model = Arc::new(Model::parse(&file.glb()).unwrap());
            let rig = model.rig.as_ref().unwrap();
            let sources = Sources::new(&gpu, rig);
            let mut playing = Playing::new(&gpu, &deformer, &sources, &model, rig, animation);
            for time_us in [0, 333_000, 910_000, 12_250_000] {
                let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
                deformer.record(&gpu, &mut encoder, &mut timer, time_us, std::iter::once(&mut playing));
                gpu.queue.submit([encoder.finish()]);
                let pose = rig.pose(animation, time_us as f64 * 1e-6);
                for moving in &rig.moving {
                    let binding = &rig.bindings[moving.binding];
                    let (matrices, weights) = (&pose.matrices[binding.first_matrix..], &pose.weights[binding.first_weight..]);
                    let expected = deform(&moving.primitive, matrices, weights);
                    let deformed = read(&gpu, playing.vertices(moving.part).unwrap());
                    assert_eq!(deformed.len(), expected.len());
                    for (gpu, cpu) in deformed.iter().zip(&expected) {
                        let off = |a: [f32; 3], b: [f32; 3]| (Vec3::from_array(a) - Vec3::from_array(b)).length();
                        // The same sums, in an order of the driver's own.
                        assert!(off(gpu.position, cpu.position) < 1e-5 && off(gpu.normal, cpu.normal) < 1e-5, "{gpu:?} {cpu:?}");
                        assert_eq!(gpu.uv, cpu.uv);
                    }
                }
            }
        }
    }
}
