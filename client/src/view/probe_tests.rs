//! The light kernels on the GPU against their CPU twins. Needs a Vulkan adapter and fails without one.

use glam::{Vec2, Vec3};
use mr360_protocol::video::Transfer;
use mr360_shaders::colour::decode_transfer;
use mr360_shaders::equirect::{direction_from_uv, uv_from_direction};
use mr360_shaders::layout::{Probe, ProbeResult};
use mr360_shaders::sh::irradiance;
use mr360_shaders::source::{Module, transfer_index};
use wgpu::util::DeviceExt as _;

use crate::gpu::Gpu;

const TRANSFERS: [Transfer; 5] = [Transfer::Bt709, Transfer::Srgb, Transfer::Linear, Transfer::Pq, Transfer::Hlg];

fn ask(gpu: &Gpu, probes: &[Probe], sh: &[[f32; 4]; 25]) -> Vec<ProbeResult> {
    let device = &gpu.device;
    let shader = gpu.shader(Module::Probe).unwrap();
    let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some("probe"),
        layout: None,
        module: &shader,
        entry_point: Some("cs_probe"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    });
    let init = |contents| {
        device.create_buffer_init(&wgpu::util::BufferInitDescriptor { label: None, contents, usage: wgpu::BufferUsages::STORAGE })
    };
    let size = (probes.len() * size_of::<ProbeResult>()) as u64;
    let buffer = |usage| device.create_buffer(&wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false });
    let (questions, coefficients) = (init(bytemuck::cast_slice(probes)), init(bytemuck::cast_slice(sh)));
    let results = buffer(wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC);
    let back = buffer(wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ);
    let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[
            wgpu::BindGroupEntry { binding: 0, resource: questions.as_entire_binding() },
            wgpu::BindGroupEntry { binding: 1, resource: coefficients.as_entire_binding() },
            wgpu::BindGroupEntry { binding: 2, resource: results.as_entire_binding() },
        ],
    });
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups((probes.len() as u32).div_ceil(64), 1, 1);
    }
    encoder.copy_buffer_to_buffer(&results, 0, &back, 0, size);
    gpu.queue.submit([encoder.finish()]);
    bytemuck::pod_collect_to_vec(&gpu.read_buffer(&back).unwrap())
}

#[test]
fn kernels_match_their_cpu_twins() {
    let gpu = Gpu::headless().unwrap();
    let sh: [Vec3; 25] = std::array::from_fn(|i| Vec3::new(1.0, 0.1 * i as f32, 0.5 - 0.03 * i as f32) / (1.0 + i as f32 * 0.3));
    let probes: Vec<Probe> = (0..512)
        .map(|i| {
            let uv = Vec2::new((i % 32) as f32 / 32.0 + 0.01, ((i / 32) as f32 + 0.5) / 16.0);
            let transfer = TRANSFERS[i % TRANSFERS.len()];
            let code = [i as f32 / 511.0, 0.5, 1.0 - i as f32 / 511.0];
            Probe { direction: direction_from_uv(uv).to_array(), transfer: transfer_index(transfer), code, padding: 0 }
        })
        .collect();
    for (i, (probe, result)) in probes.iter().zip(ask(&gpu, &probes, &sh.map(|c| c.extend(0.0).to_array()))).enumerate() {
        let direction = Vec3::from_array(probe.direction);
        let expected = irradiance(&sh, direction);
        assert!((Vec3::from_array(result.irradiance) - expected).abs().max_element() < 1e-4, "irradiance {direction}");
        // Vulkan allows atan2 an error of 4096 ulp, and asin inherits it.
        assert!((Vec2::new(result.u, result.v) - uv_from_direction(direction)).abs().max_element() < 5e-4, "uv of {direction}");
        assert!((Vec3::from_array(result.round_trip) - direction).length() < 4e-3, "round trip of {direction}");
        let linear = decode_transfer(TRANSFERS[i % TRANSFERS.len()], Vec3::from_array(probe.code));
        let error = (Vec3::from_array(result.linear) - linear).abs() / (linear.abs() + 1e-3);
        // PQ raises to a power of 78, which multiplies the error of a power function by as much.
        assert!(error.max_element() < 5e-3, "probe {i}: {:?} against {linear}", result.linear);
    }
}
