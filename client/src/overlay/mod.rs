//! What a frame costs and does, and where its lights are, over the view.

mod canvas;

use glam::{IVec2, Vec2, Vec3};
use mr360_shaders::colour::{luminance, srgb_encode};
use mr360_shaders::equirect::uv_from_direction;
use mr360_shaders::source::Module;

use crate::camera::{Camera, FieldOfView};
use crate::environment::FrameLight;
use crate::frame_loop::{Drawn, HeadsetTimes, Shot};
use crate::gpu::{Gpu, GpuError};
use crate::stats::FrameTimes;
use canvas::{CELL, Canvas, Colour};

/// Pixels of the overlay's picture.
const SIZE: IVec2 = IVec2::new(176, 176);
/// Each is shown as so many pixels of the view, squared, and as far from its corner.
const SCALE: u32 = 2;
/// Where a headset shows the upper left corner: tangents of the angles from the first view's axis, to the right and up.
const CORNER: Vec2 = Vec2::new(-0.4, 0.35);
/// Room around what is drawn.
const MARGIN: i32 = 4;
/// The panorama with its lights.
const MAP: IVec2 = IVec2::new(168, 84);

/// Lengths of lights' arrows, pixels: of one that gives nothing, and of one that gives all light.
const SHORTEST_ARROW: i32 = 8;
const LONGEST_ARROW: i32 = 30;
/// Pixels of each stroke of an arrow's head.
const ARROW_HEAD: i32 = 3;
/// Column in which [`CONTROLS`] say what something does.
const DOES_AT: i32 = 16;

const PAPER: Colour = [0, 0, 0, 170];
const INK: Colour = [235, 235, 235, 255];
const FAINT: Colour = [170, 170, 170, 255];
const WARNING: Colour = [255, 120, 90, 255];

/// What mouse and keys do in a window.
pub const CONTROLS: [(&str, &str); 16] = [
    ("drag", "look, move an object"),
    ("let go moving", "throw it"),
    ("shift drag", "lift it"),
    ("right drag, Q E", "turn it"),
    ("wheel", "scale it, or zoom"),
    ("G", "stand it on ground"),
    ("Del", "remove it"),
    ("Tab, 1-9", "take from library"),
    ("click", "put it there"),
    ("Q E, wheel", "turn, scale it first"),
    ("Esc", "put it away, or leave"),
    ("PgUp PgDn", "raise, lower eyes"),
    ("R", "recentre"),
    ("F1", "what a frame costs"),
    ("F2", "this"),
    ("F11", "full screen"),
];

/// What is told of a frame.
pub struct Told<'a> {
    /// What it did, and what the passes of an earlier one took.
    pub drawn: &'a Drawn,
    /// The frame before it, presented; `None` at first.
    pub before: Option<&'a FrameTimes>,
    /// What it cost, milliseconds.
    pub cost_ms: f32,
    /// What it may cost, milliseconds, where that matters.
    pub budget_ms: Option<f32>,
    /// The light in force.
    pub light: &'a FrameLight,
    /// Unit vector to the middle of the view.
    pub looking: Vec3,
    /// What mouse and keys do is told instead.
    pub controls: bool,
}

/// The overlay on the GPU.
pub struct Overlay {
    canvas: Canvas,
    texture: wgpu::Texture,
    group: wgpu::BindGroup,
    pipeline: wgpu::RenderPipeline,
}

impl Overlay {
    /// For targets of one format, which encodes sRGB itself.
    ///
    /// # Errors
    /// [`GpuError::Shader`] when the build lacks a shader file.
    pub fn new(gpu: &Gpu, format: wgpu::TextureFormat) -> Result<Self, GpuError> {
        let device = &gpu.device;
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("overlay"),
            size: extent(),
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: wgpu::TextureFormat::Rgba8UnormSrgb,
            usage: wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        });
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let pipeline = pipeline(gpu, &gpu.shader(Module::Overlay)?, format);
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("overlay"),
            layout: &pipeline.get_bind_group_layout(0),
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(&view) }],
        });
        Ok(Self { canvas: Canvas::new(SIZE), texture, group, pipeline })
    }

    /// Records the overlay over what the shots' targets already show: in the upper left corner of a picture, and in a headset, whose corners
    /// nobody sees, in the same direction for both eyes.
    pub fn draw(&mut self, gpu: &Gpu, encoder: &mut wgpu::CommandEncoder, shots: &[Shot], told: &Told<'_>) {
        paint(&mut self.canvas, told);
        let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * SIZE.x as u32), rows_per_image: None };
        gpu.queue.write_texture(self.texture.as_image_copy(), self.canvas.texels(), layout, extent());
        for shot in shots {
            let origin = origin(&shots[0].camera, shot);
            let size = IVec2::new(shot.target.width as i32, shot.target.height as i32);
            let (low, high) = (origin.clamp(IVec2::ZERO, size), (origin + SCALE as i32 * SIZE).clamp(IVec2::ZERO, size));
            if (high - low).min_element() <= 0 {
                continue;
            }
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some("overlay"),
                color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                    view: &shot.target.view,
                    depth_slice: None,
                    resolve_target: None,
                    ops: wgpu::Operations { load: wgpu::LoadOp::Load, store: wgpu::StoreOp::Store },
                })],
                ..wgpu::RenderPassDescriptor::default()
            });
            let shown = (SCALE as i32 * SIZE).as_vec2();
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, &self.group, &[]);
            pass.set_viewport(origin.x as f32, origin.y as f32, shown.x, shown.y, 0.0, 1.0);
            pass.set_scissor_rect(low.x as u32, low.y as u32, (high.x - low.x) as u32, (high.y - low.y) as u32);
            pass.draw(0..4, 0..1);
        }
    }
}

/// The overlay's upper left pixel.
fn origin(first: &Camera, shot: &Shot) -> IVec2 {
    let FieldOfView::Edges(_) = first.fov else { return IVec2::ZERO };
    let towards = first.world_from_view * Vec3::new(CORNER.x, CORNER.y, -1.0);
    let size = Vec2::new(shot.target.width as f32, shot.target.height as f32);
    // As far away as the panorama.
    let seen = shot.camera.clip_from_view(size.x / size.y.max(1.0)) * (shot.camera.world_from_view.inverse() * towards).extend(1.0);
    if seen.w <= 1e-3 {
        return size.as_ivec2();
    }
    let ndc = (seen.truncate().truncate() / seen.w).clamp(Vec2::splat(-2.0), Vec2::splat(2.0));
    ((ndc * Vec2::new(0.5, -0.5) + 0.5) * size).as_ivec2()
}

fn extent() -> wgpu::Extent3d {
    wgpu::Extent3d { width: SIZE.x as u32, height: SIZE.y as u32, depth_or_array_layers: 1 }
}

fn pipeline(gpu: &Gpu, shader: &wgpu::ShaderModule, format: wgpu::TextureFormat) -> wgpu::RenderPipeline {
    let target =
        wgpu::ColorTargetState { format, blend: Some(wgpu::BlendState::PREMULTIPLIED_ALPHA_BLENDING), write_mask: wgpu::ColorWrites::ALL };
    let constants = [("WIDTH", f64::from(SIZE.x)), ("HEIGHT", f64::from(SIZE.y))];
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("overlay"),
        layout: None,
        vertex: wgpu::VertexState {
            module: shader,
            entry_point: Some("vs_overlay"),
            compilation_options: wgpu::PipelineCompilationOptions { constants: &constants, ..Default::default() },
            buffers: &[],
        },
        primitive: wgpu::PrimitiveState { topology: wgpu::PrimitiveTopology::TriangleStrip, ..Default::default() },
        depth_stencil: None,
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: shader,
            entry_point: Some("fs_overlay"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            targets: &[Some(target)],
        }),
        multiview_mask: None,
        cache: None,
    })
}

fn paint(canvas: &mut Canvas, told: &Told<'_>) {
    canvas.fill(PAPER);
    if told.controls {
        for (row, (what, does)) in (0..).zip(CONTROLS) {
            let at = IVec2::new(MARGIN, MARGIN + row * CELL.y);
            canvas.text(at, what, INK);
            canvas.text(at + IVec2::X * DOES_AT * CELL.x, does, FAINT);
        }
        return;
    }
    let map = IVec2::splat(MARGIN);
    paint_map(canvas, map, told);
    let mut at = map + IVec2::new(0, MAP.y + MARGIN);
    for (line, colour) in lines(told) {
        canvas.text(at, &line, colour);
        at.y += CELL.y;
    }
}

/// The whole panorama, the view's middle as a cross, and each light as a disc in its colour with an arrow the way it shines, towards level ground from
/// above or from beneath; both larger the more of all light it is.
fn paint_map(canvas: &mut Canvas, at: IVec2, told: &Told<'_>) {
    canvas.frame(at, MAP, FAINT);
    let place = |direction: Vec3| at + (uv_from_direction(direction) * MAP.as_vec2()).as_ivec2();
    let middle = place(told.looking);
    for step in -2..=2 {
        canvas.dot(middle + IVec2::new(step, 0), FAINT);
        canvas.dot(middle + IVec2::new(0, step), FAINT);
    }
    let whole =
        luminance(told.light.sh[0]).max(0.0) * 0.886 + told.light.lights.iter().map(|light| luminance(light.irradiance)).sum::<f32>();
    for light in &told.light.lights {
        let share = luminance(light.irradiance) / whole.max(f32::MIN_POSITIVE);
        let colour = light.irradiance / light.irradiance.max_element().max(f32::MIN_POSITIVE);
        let [r, g, b] = colour.to_array().map(|channel| (srgb_encode(channel) * 255.0).round() as u8);
        let (from, share) = (place(light.direction), share.clamp(0.0, 1.0));
        canvas.disc(from, 1 + (5.0 * share.sqrt()) as i32, [r, g, b, 255]);
        let reach = SHORTEST_ARROW + ((LONGEST_ARROW - SHORTEST_ARROW) as f32 * share) as i32;
        paint_arrow(canvas, from, if light.direction.y < 0.0 { -reach } else { reach }, [r, g, b, 255]);
    }
}

/// Down from a place by so many pixels, or up.
fn paint_arrow(canvas: &mut Canvas, from: IVec2, reach: i32, colour: Colour) {
    let step = reach.signum();
    (0..=reach.abs()).for_each(|at| canvas.dot(from + IVec2::new(0, step * at), colour));
    for aside in 1..=ARROW_HEAD {
        [-aside, aside].into_iter().for_each(|across| canvas.dot(from + IVec2::new(across, reach - step * aside), colour));
    }
}

fn lines(told: &Told<'_>) -> Vec<(String, Colour)> {
    let Drawn { passes, tier, plan } = told.drawn;
    let over = told.budget_ms.is_some_and(|budget| told.cost_ms > budget);
    let budget = told.budget_ms.map_or_else(String::new, |budget| format!(" of {budget:.1}"));
    let reflections = if plan.reflections { format!("1/{}", plan.reflections_every) } else { "-".to_owned() };
    let occlusion = if plan.occlusion { "on" } else { "-" };
    let mut lines = vec![
        (format!("frame {:.1}{budget} ms  tier {tier}", told.cost_ms), if over { WARNING } else { INK }),
        (format!("lights {}  shadows {}  samples {}", told.light.lights.len(), plan.shadows, plan.samples), INK),
        (format!("reflections {reflections}  occlusion {occlusion}"), INK),
    ];
    if let Some(before) = told.before {
        let ms = |us: u64| format!("{:.0}", us as f64 * 1e-3);
        let light = before.light_age_us().map_or_else(|| "-".to_owned(), ms);
        lines.push((format!("age ms: light {light}  video {}", ms(before.video_age_us())), INK));
        if let Some(HeadsetTimes { pose_to_photon_us, missed, .. }) = before.shown.headset {
            let pose = pose_to_photon_us.map_or_else(|| "-".to_owned(), ms);
            lines.push((format!("pose to photon {pose} ms  missed {missed}"), INK));
        }
    }
    lines.extend(passes.iter().map(|pass| (format!("{:>7.2} ms  {}", pass.gpu_ms, pass.name), FAINT)));
    lines
}

#[cfg(test)]
mod tests {
    use mr360_protocol::clock::ClientTime;
    use mr360_protocol::light::DirectionalLight;

    use super::*;
    use crate::camera::Edges;
    use crate::frame_loop::Presented;
    use crate::governor::Tier;
    use crate::headless::Offscreen;
    use crate::stats::{LightTimes, PassTime};
    use crate::view::Plan;

    fn light(direction: Vec3, irradiance: Vec3) -> FrameLight {
        FrameLight { lights: vec![DirectionalLight { id: 1, direction, irradiance, solid_angle_sr: 0.01 }], ..FrameLight::default() }
    }

    fn told<'a>(drawn: &'a Drawn, light: &'a FrameLight) -> Told<'a> {
        Told { drawn, before: None, cost_ms: 12.34, budget_ms: Some(11.1), light, looking: Vec3::NEG_Z, controls: false }
    }

    #[test]
    fn the_lines_say_what_was_decided_and_what_it_costs() {
        let plan = Plan { objects: true, reflections: true, reflections_every: 4, shadows: 1, samples: 1, ..Plan::default() };
        let drawn = Drawn { passes: vec![PassTime { name: "composite", gpu_ms: 3.456 }], tier: Tier::LOWEST, plan };
        let light = light(Vec3::Y, Vec3::ONE);
        let lines = lines(&told(&drawn, &light));
        let texts: Vec<&str> = lines.iter().map(|(line, _)| line.as_str()).collect();
        let expected = [
            "frame 12.3 of 11.1 ms  tier 4 of 4",
            "lights 1  shadows 1  samples 1",
            "reflections 1/4  occlusion -",
            "   3.46 ms  composite",
        ];
        assert_eq!(texts, expected);
        assert_eq!(lines[0].1, WARNING, "over the budget");
        let at = |us: u64| ClientTime(1_000_000 + us);
        let before = FrameTimes {
            frame: 7,
            pts_us: 0,
            new_picture: true,
            arrived: at(0),
            decoded: at(5_000),
            light: Some(LightTimes { pts_us: 0, published: at(3_000), arrived: at(4_000) }),
            light_weight: 0.0,
            paired: at(80_000),
            uploaded: at(81_000),
            begun: at(90_000),
            rendered: at(95_000),
            presented: at(96_400),
            playout_delay_us: 20_000,
            shown: Presented { gpu_waits: 0, headset: Some(HeadsetTimes { pose_to_photon_us: Some(21_600), frame_us: 6_400, missed: 3 }) },
        };
        let with_ages = super::lines(&Told { before: Some(&before), ..told(&drawn, &light) });
        assert_eq!((with_ages[3].0.as_str(), with_ages[4].0.as_str()), ("age ms: light 93  video 96", "pose to photon 22 ms  missed 3"));
        let longest = texts.iter().map(|line| line.len()).max().unwrap() as i32;
        assert!(longest * CELL.x <= SIZE.x - 2 * MARGIN);
    }

    #[test]
    fn what_mouse_and_keys_do_fits_the_picture() {
        for (what, does) in CONTROLS {
            assert!((what.len() as i32) < DOES_AT, "{what}");
            assert!((DOES_AT + does.len() as i32) * CELL.x <= SIZE.x - 2 * MARGIN, "{does}");
        }
        assert!(CONTROLS.len() as i32 * CELL.y <= SIZE.y - 2 * MARGIN);
    }

    #[test]
    fn a_light_is_where_it_is_in_the_panorama_and_nothing_else_is_touched() {
        let gpu = Gpu::headless().unwrap();
        let mut offscreen = Offscreen::new(&gpu.device, &gpu.queue, 400, 400);
        let mut overlay = Overlay::new(&gpu, Offscreen::FORMAT).unwrap();
        let (drawn, light) = (Drawn::default(), light(Vec3::X, Vec3::new(1.0, 0.0, 0.0)));
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let shot = Shot { camera: Camera::looking(0.0, 0.0, 1.0), target: offscreen.target() };
        overlay.draw(&gpu, &mut encoder, &[shot], &told(&drawn, &light));
        gpu.queue.submit([encoder.finish()]);
        let texels = offscreen.read().unwrap();
        let at = |x: usize, y: usize| <[u8; 4]>::try_from(&texels[4 * (400 * y + x)..][..4]).unwrap();
        // +x is three quarters along the panorama, at half its height: 4 + 126 and 4 + 42, twice as large.
        assert_eq!(at(260, 92), [255, 0, 0, 255]);
        assert_eq!((at(260, 60)[0], at(0, 0)[3]), (0, PAPER[3]));
        // All light comes from it: the arrow is 30 long, and its head's strokes end three above its tip.
        assert_eq!([at(260, 152), at(254, 146), at(266, 146)], [[255, 0, 0, 255]; 3]);
        assert_eq!([at(260, 156)[0], at(252, 152)[0]], [0, 0]);
        // Beyond its edge the target is as it was.
        assert_eq!((at(352, 10), at(10, 352)), ([0; 4], [0; 4]));
    }

    #[test]
    fn both_eyes_of_a_headset_see_it_in_one_direction() {
        let gpu = Gpu::headless().unwrap();
        let offscreen = Offscreen::new(&gpu.device, &gpu.queue, 1000, 1000);
        // Mirrored fields of view, the right eye canted outwards.
        let left = Edges::from_angles(-0.9, 0.6, -0.8, 0.7).unwrap();
        let right = Edges { left: -left.right, right: -left.left, ..left };
        let eye = |edges, yaw: f32| Camera { fov: FieldOfView::Edges(edges), ..Camera::looking(yaw, 0.0, 1.0) };
        let cameras = [eye(left, 0.0), eye(right, -0.1)];
        let shown = cameras.map(|camera| {
            let at = origin(&cameras[0], &Shot { camera, target: offscreen.target() });
            let ndc = at.as_vec2() / 1000.0 * Vec2::new(2.0, -2.0) + Vec2::new(-1.0, 1.0);
            camera.ray(ndc, 1.0)
        });
        let expected = Vec3::new(CORNER.x, CORNER.y, -1.0).normalize();
        assert!(shown.iter().all(|ray| ray.dot(expected) > 0.999_99), "{shown:?}");
        // Behind an eye it is not drawn at all.
        let behind = Shot { camera: eye(right, 3.0), target: offscreen.target() };
        assert_eq!(origin(&cameras[0], &behind), IVec2::splat(1000));
    }
}
