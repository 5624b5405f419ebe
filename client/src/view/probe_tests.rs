//! The light kernels on the GPU against their CPU twins. Needs a Vulkan adapter and fails without one.

use glam::{Mat3, Vec2, Vec3};
use mr360_protocol::light::{Lift, Recovery};
use mr360_protocol::video::{Colour, Primaries, Transfer};
use mr360_shaders::colour::{bt709_from_primaries, decode_transfer, radiance_from_code};
use mr360_shaders::equirect::{direction_from_uv, uv_from_direction};
use mr360_shaders::layout::{Probe, ProbeResult};
use mr360_shaders::sh::irradiance;
use mr360_shaders::source::{Module, lift_index, transfer_index};
use wgpu::util::DeviceExt as _;

use crate::gpu::Gpu;

const TRANSFERS: [Transfer; 5] = [Transfer::Bt709, Transfer::Srgb, Transfer::Linear, Transfer::Pq, Transfer::Hlg];
const PRIMARIES: [Primaries; 4] = [Primaries::Bt709, Primaries::Bt2020, Primaries::Bt601Pal, Primaries::Bt601Ntsc];
const LIFTS: [Lift; 3] = [
    Lift::Linear,
    Lift::InverseToneMap,
    Lift::Recovered(Recovery { gain_ln: 0.7, slope: Vec3::new(0.3, 1.9, -0.4), tint_ln: [0.3, -0.5] }),
];
/// Codes asked of each kind.
const CODES: usize = 64;

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

/// Columns as the shaders have them.
fn columns(matrix: Mat3) -> [[f32; 4]; 3] {
    [matrix.x_axis, matrix.y_axis, matrix.z_axis].map(|column| column.extend(0.0).to_array())
}

#[test]
fn kernels_match_their_cpu_twins() {
    let gpu = Gpu::headless().unwrap();
    let sh: [Vec3; 25] = std::array::from_fn(|i| Vec3::new(1.0, 0.1 * i as f32, 0.5 - 0.03 * i as f32) / (1.0 + i as f32 * 0.3));
    let kinds: Vec<_> = TRANSFERS
        .into_iter()
        .flat_map(|transfer| PRIMARIES.map(|primaries| (transfer, primaries)))
        .flat_map(|(transfer, primaries)| LIFTS.map(|lift| (lift, Colour { transfer, primaries, ..Colour::default() })))
        .collect();
    // As far below black and above white as the codes of limited-range video go.
    let step = |i: usize| -0.1 + 1.2 * i as f32 / (CODES - 1) as f32;
    let questions: Vec<_> = kinds.iter().flat_map(|kind| (0..CODES).map(move |i| (*kind, i))).collect();
    let probe = |(n, ((lift, colour), i)): (usize, &((Lift, Colour), usize))| {
        let uv = Vec2::new((n % 64) as f32 / 64.0 + 0.01, ((n / 64) as f32 + 0.5) / (questions.len() as f32 / 64.0));
        Probe {
            direction: direction_from_uv(uv).to_array(),
            transfer: transfer_index(colour.transfer),
            code: [step(*i), 0.5, step(CODES - 1 - i)],
            lift: lift_index(*lift),
            recovery: (*lift).into(),
            bt709_from_primaries: columns(bt709_from_primaries(colour.primaries)),
        }
    };
    let probes: Vec<Probe> = questions.iter().enumerate().map(probe).collect();
    let results = ask(&gpu, &probes, &sh.map(|c| c.extend(0.0).to_array()));
    assert_eq!(results.len(), probes.len());
    for (((lift, colour), probe), result) in questions.iter().map(|(kind, _)| kind).zip(&probes).zip(&results) {
        let direction = Vec3::from_array(probe.direction);
        let expected = irradiance(&sh, direction);
        assert!((Vec3::from_array(result.irradiance) - expected).abs().max_element() < 1e-4, "irradiance {direction}");
        // Vulkan allows atan2 an error of 4096 ulp, and asin inherits it.
        assert!((Vec2::new(result.u, result.v) - uv_from_direction(direction)).abs().max_element() < 5e-4, "uv of {direction}");
        assert!((Vec3::from_array(result.round_trip) - direction).length() < 4e-3, "round trip of {direction}");
        let code = Vec3::from_array(probe.code);
        let linear = decode_transfer(colour.transfer, code);
        // PQ raises to a power of 78, which multiplies the error of a power function by as much.
        let error = (Vec3::from_array(result.linear) - linear).abs() / (linear.abs() + 1e-3);
        assert!(error.max_element() < 5e-3, "{colour:?} {code}: {:?} against {linear}", result.linear);
        // The primaries take channels from each other: what is left has the error of the largest.
        let radiance = radiance_from_code(*lift, *colour, direction, code);
        let error = (Vec3::from_array(result.lifted) - radiance).abs().max_element() / (linear.abs().max(radiance).max_element() + 1e-3);
        assert!(error < 1e-2, "{lift:?} {colour:?} {code}: {:?} against {radiance}", result.lifted);
    }
}
