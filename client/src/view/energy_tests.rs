//! One consistent energy: what a white surface sends back of light from everywhere is 1, however that light is divided
//! between spherical harmonics, reflection map and lights. They need a Vulkan adapter and fail without one.

use std::f32::consts::PI;

use glam::Vec3;
use mr360_protocol::light::{DirectionalLight, LightFrame};
use mr360_protocol::scene::Material;
use mr360_shaders::brdf::albedo;
use mr360_shaders::layout::{BrdfProbe, BrdfResult};
use mr360_shaders::source::Module;
use wgpu::util::DeviceExt as _;

use super::reflection_tests::{SIDE, draw};
use super::tests::panorama;
use crate::environment::albedo::AlbedoTable;
use crate::gpu::Gpu;
use crate::render::ambient_light;

fn ask(gpu: &Gpu, probes: &[BrdfProbe]) -> Vec<BrdfResult> {
    let device = &gpu.device;
    let shader = gpu.shader(Module::BrdfProbe).unwrap();
    let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some("brdf probe"),
        layout: None,
        module: &shader,
        entry_point: Some("cs_brdf_probe"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    });
    let contents = bytemuck::cast_slice(probes);
    let questions =
        device.create_buffer_init(&wgpu::util::BufferInitDescriptor { label: None, contents, usage: wgpu::BufferUsages::STORAGE });
    let size = (probes.len() * size_of::<BrdfResult>()) as u64;
    let buffer = |usage| device.create_buffer(&wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false });
    let results = buffer(wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC);
    let back = buffer(wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ);
    let table = AlbedoTable::new(gpu);
    let group = |at, entries: &[_]| {
        device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout: &pipeline.get_bind_group_layout(at), entries })
    };
    let asked = group(
        0,
        &[
            wgpu::BindGroupEntry { binding: 0, resource: questions.as_entire_binding() },
            wgpu::BindGroupEntry { binding: 1, resource: results.as_entire_binding() },
        ],
    );
    let looked_up = group(
        2,
        &[
            wgpu::BindGroupEntry { binding: 2, resource: wgpu::BindingResource::TextureView(&table.view) },
            wgpu::BindGroupEntry { binding: 3, resource: wgpu::BindingResource::Sampler(&table.sampler) },
        ],
    );
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &asked, &[]);
        pass.set_bind_group(2, &looked_up, &[]);
        pass.dispatch_workgroups((probes.len() as u32).div_ceil(64), 1, 1);
    }
    encoder.copy_buffer_to_buffer(&results, 0, &back, 0, size);
    gpu.queue.submit([encoder.finish()]);
    bytemuck::pod_collect_to_vec(&gpu.read_buffer(&back).unwrap())
}

/// One case: a surface, a view at this cosine from its normal, and lights of this size.
#[derive(Debug, Clone, Copy)]
struct Case {
    n_dot_v: f32,
    roughness: f32,
    tan_radius: f32,
    albedo: f32,
    metallic: f32,
}

/// Steps over the half vector's polar angle and over half of its azimuth.
const STEPS: (usize, usize) = (128, 24);

impl Case {
    fn view(self) -> Vec3 {
        Vec3::new((1.0 - self.n_dot_v * self.n_dot_v).sqrt(), 0.0, self.n_dot_v)
    }

    /// Light directions with the solid angle that each stands for: reflections about half vectors that a GGX lobe of this
    /// alpha spreads evenly, their tail drawn out.
    fn lobe(self, alpha: f32) -> impl Iterator<Item = (Vec3, f32)> {
        let (v, a2) = (self.view(), alpha * alpha);
        (0..STEPS.0 * STEPS.1).filter_map(move |at| {
            let t = ((at / STEPS.1) as f32 + 0.5) / STEPS.0 as f32;
            let turn = PI * ((at % STEPS.1) as f32 + 0.5) / STEPS.1 as f32;
            // The share t² of the lobe lies farther out.
            let cos2 = t * t / (t * t + (1.0 - t * t) * a2);
            let (cosine, sine) = (cos2.sqrt(), (1.0 - cos2).max(0.0).sqrt());
            let h = Vec3::new(sine * turn.cos(), sine * turn.sin(), cosine);
            let v_dot_h = v.dot(h);
            let light = 2.0 * v_dot_h * h - v;
            let d = cos2 * (a2 - 1.0) + 1.0;
            let density = a2 / (PI * d * d) * cosine / (4.0 * v_dot_h);
            (v_dot_h > 0.0 && light.z > 0.0).then(|| (light, 2.0 * t / density / (STEPS.0 * STEPS.1) as f32))
        })
    }

    /// Light directions spread evenly over the hemisphere by their cosine.
    fn hemisphere() -> impl Iterator<Item = (Vec3, f32)> {
        (0..STEPS.0 * STEPS.1).map(|at| {
            let cosine = ((at / STEPS.1) as f32 + 0.5) / STEPS.0 as f32;
            let turn = PI * ((at % STEPS.1) as f32 + 0.5) / STEPS.1 as f32;
            let sine = (1.0 - cosine * cosine).sqrt();
            (Vec3::new(sine * turn.cos(), sine * turn.sin(), cosine), 2.0 * PI / (STEPS.0 * STEPS.1) as f32)
        })
    }

    fn probe(self, light: Vec3) -> BrdfProbe {
        BrdfProbe {
            view: self.view().to_array(),
            roughness: self.roughness,
            light: light.to_array(),
            tan_radius: self.tan_radius,
            albedo: [self.albedo; 3],
            metallic: self.metallic,
        }
    }

    /// What light from every direction, each sent as a light of its own, makes together in the lobe and in the rest; and what
    /// the shaders make of the same as ambient light.
    fn reflected(self, gpu: &Gpu) -> (f32, f32, f32) {
        // As the shaders widen it.
        let alpha = (self.roughness * self.roughness + 0.5 * self.tan_radius).clamp(0.003, 1.0);
        let (lobe, rest): (Vec<_>, Vec<_>) = (self.lobe(alpha).collect(), Self::hemisphere().collect());
        let probes: Vec<_> = lobe.iter().chain(&rest).map(|(light, _)| self.probe(*light)).collect();
        let results = ask(gpu, &probes);
        let (in_lobe, in_rest) = results.split_at(lobe.len());
        let specular = in_lobe.iter().zip(&lobe).map(|(result, (_, weight))| result.specular[1] * weight).sum();
        let diffuse = in_rest.iter().zip(&rest).map(|(result, (_, weight))| (result.direct[1] - result.specular[1]) * weight).sum();
        (specular, diffuse, results[0].ambient[1])
    }
}

#[test]
fn lights_from_everywhere_are_the_same_as_ambient_light() {
    let gpu = Gpu::headless().unwrap();
    for (metallic, albedo) in [(0.0, 1.0), (0.0, 0.3), (1.0, 1.0), (1.0, 0.5)] {
        for step in 0..=10 {
            for n_dot_v in [0.05, 0.1, 0.3, 0.7, 1.0] {
                // Of no size; the sun; a lamp just narrow enough to have a highlight.
                for tan_radius in [0.0, 0.0047, 0.14] {
                    let case = Case { n_dot_v, roughness: 0.1 * step as f32, tan_radius, albedo, metallic };
                    let (specular, diffuse, ambient) = case.reflected(&gpu);
                    let together = specular + diffuse;
                    // The table's half a per cent, once for the own lobe and once for the widened.
                    assert!((together / ambient - 1.0).abs() < 0.01, "{case:?}: {specular} + {diffuse} against {ambient}");
                    if albedo == 1.0 {
                        assert!((together - 1.0).abs() < 0.01 && (ambient - 1.0).abs() < 1e-3, "{case:?}: {together}, {ambient}");
                    }
                }
            }
        }
    }
}

#[test]
fn a_single_light_reflects_what_the_lobe_integrates_to() {
    let gpu = Gpu::headless().unwrap();
    for step in 1..=10 {
        for n_dot_v in [0.05f32, 0.1, 0.3, 0.7, 1.0] {
            let case = Case { n_dot_v, roughness: 0.1 * step as f32, tan_radius: 0.0, albedo: 0.5, metallic: 1.0 };
            let (specular, _, _) = case.reflected(&gpu);
            let ab = albedo(case.n_dot_v, case.roughness);
            let expected = 0.5 * ab.x + ab.y;
            assert!((specular / expected - 1.0).abs() < 0.01, "{case:?}: {specular} against {expected}");
        }
    }
}

/// Directions spread evenly over the sphere (Fibonacci), each as good as any other.
fn spread(count: usize) -> impl Iterator<Item = Vec3> {
    (0..count).map(move |i| {
        let y = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
        let (sine, cosine) = (i as f32 * PI * (3.0 - 5.0f32.sqrt())).sin_cos();
        let ring = (1.0 - y * y).sqrt();
        Vec3::new(ring * cosine, y, ring * sine)
    })
}

#[test]
fn a_furnace_of_lights_stays_white_in_the_picture() {
    const FRAMES: usize = 16;
    const LIGHTS: usize = 8;
    let gpu = Gpu::headless().unwrap();
    let picture = panorama(256, 128, |_| Vec3::ONE);
    let sky = ambient_light(&picture);
    // Each light is below the share from which it would cast a shadow, which ends at a ball's rim in steps.
    let irradiance = 0.06f32;
    let radiance = LIGHTS as f32 * irradiance / (4.0 * PI);
    let radius_px = 60.0;
    let inside = |at: usize| {
        let (x, y) = ((at % SIDE as usize) as f32 + 0.5, (at / SIDE as usize) as f32 + 0.5);
        (x - SIDE as f32 / 2.0).hypot(y - SIDE as f32 / 2.0) < radius_px - 2.0
    };
    for metallic in [0.0, 1.0] {
        for roughness in [0.3, 0.5, 0.8, 1.0] {
            let material = Material { base_color: [1.0; 3], roughness, metallic, ..Material::default() };
            let mean = |light: &LightFrame| {
                let drawn = draw(&gpu, &picture, light, material, radius_px);
                let ball: Vec<f32> = drawn.into_iter().enumerate().filter(|(at, _)| inside(*at)).map(|(_, value)| value).collect();
                ball.iter().sum::<f32>() / ball.len() as f32
            };
            let without = mean(&sky);
            let directions: Vec<Vec3> = spread(FRAMES * LIGHTS).collect();
            let mut added = 0.0;
            for frame in 0..FRAMES {
                let light = |i| DirectionalLight {
                    id: i as u32,
                    direction: directions[i * FRAMES + frame],
                    irradiance: Vec3::splat(irradiance),
                    solid_angle_sr: 6.8e-5,
                };
                added += mean(&LightFrame { lights: (0..LIGHTS).map(light).collect(), ..sky.clone() }) - without;
            }
            let share = added / FRAMES as f32 / radiance;
            assert!((without - 1.0).abs() < 2e-3, "metallic {metallic}, roughness {roughness}: {without} without lights");
            // 128 highlights, some of them cut by the rim that is left out. Half floats of the layer hold the lights' 4 % to
            // 1 % a pixel, which averages out.
            assert!((share - 1.0).abs() < 0.02, "metallic {metallic}, roughness {roughness}: {share} of the lights' energy");
        }
    }
}
