//! `mr360-client render`: one picture of a scene in a still panorama, for looking at and for tests from outside.

use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow};
use image::ImageFormat;
use mr360_protocol::light::LightFrame;
use mr360_protocol::scene::Scene;
use mr360_protocol::video::StereoLayout;
use mr360_shaders::source::Reflections;

use crate::Failure;
use crate::arguments::{parse_angle, parse_fov, parse_size, parse_tier};
use crate::camera::Camera;
use crate::environment::Environment;
use crate::governor::Tier;
use crate::gpu::{Gpu, GpuError, block_on};
use crate::picture::Picture;
use crate::record::PictureFile;
use crate::view::{MAX_VIEWS, Parallax, Renderer, Resampling};

mod eyes;
mod layers;
mod load;
mod timing;

pub use timing::{FrameTimes, Timed};

pub use eyes::Eyes;
pub use layers::Multiview;
#[cfg(test)]
pub(crate) use layers::target;
pub use load::{Models, ambient_light, load_light, load_panorama, load_scene};

use layers::Layers;

/// Draw a scene into a still panorama.
#[derive(Debug, Clone, clap::Args)]
pub struct RenderArgs {
    /// Equirect panorama: .exr and .hdr are linear, .png and .jpg sRGB.
    #[arg(long)]
    pub panorama: PathBuf,
    /// Scene to draw into it.
    #[arg(long)]
    pub scene: PathBuf,
    /// Size of the picture in pixels, as in 1280x720.
    #[arg(long, value_parser = parse_size, default_value = "1280x720")]
    pub size: (u32, u32),
    /// Vertical field of view, degrees.
    #[arg(long, default_value_t = 60.0, value_parser = parse_fov, allow_negative_numbers = true)]
    pub fov_y_deg: f32,
    /// Turn to the left, degrees.
    #[arg(long, default_value_t = 0.0, value_parser = parse_angle, allow_negative_numbers = true)]
    pub yaw_deg: f32,
    /// Look upwards, degrees.
    #[arg(long, default_value_t = 0.0, value_parser = parse_angle, allow_negative_numbers = true)]
    pub pitch_deg: f32,
    /// Picture to write, sRGB.
    #[arg(long)]
    pub out: PathBuf,
    /// The same in linear light, as OpenEXR.
    #[arg(long)]
    pub out_linear: Option<PathBuf>,
    /// GPU time of every pass, as CSV: a frame's share of it, over frames that each bring a new picture and lights that moved, as video does.
    #[arg(long)]
    pub passes: Option<PathBuf>,
    /// Time of whole frames, as CSV: of a still picture, and with a new picture each. The GPU is waited for after every frame.
    #[arg(long)]
    pub frame_times: Option<PathBuf>,
    /// Frames of each kind for --frame-times.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub frames: u32,
    /// Views drawn in every frame of --passes and --frame-times, side by side as eyes are.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=MAX_VIEWS as i64))]
    pub views: u32,
    /// What to leave out: 0 nothing, 4 all that can be.
    #[arg(long, value_name = "N", default_value = "0", value_parser = parse_tier)]
    pub tier: Tier,
    /// Light of the panorama: the JSON that `mr360-server analyze --json` prints. Without it, spherical
    /// harmonics of the panorama alone, and no light casts a shadow.
    #[arg(long)]
    pub light: Option<PathBuf>,
    /// Time at which animated models are shown, seconds after their animations began.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, value_parser = parse_time, allow_negative_numbers = true)]
    pub time: f64,
    /// Layout of the panorama's views.
    #[arg(long, value_parser = parse_stereo, default_value = "mono")]
    pub stereo: StereoLayout,
    /// Show the right eye's view of a stereo panorama.
    #[arg(long)]
    pub right_eye: bool,
    /// How glossy surfaces look into the panorama: prefiltered maps, 36 samples a pixel (iorns) or 16 (taps).
    #[arg(long, value_parser = parse_reflections, default_value = "prefiltered")]
    pub reflections: Reflections,
    /// Distance of the background of a mono panorama, for eyes beside the camera that filmed: infinity, ground (ground and place where they
    /// are, all else on a dome of 50 m), or ground:RADIUS.
    #[arg(long, default_value = "ground", value_name = "SETTING")]
    pub parallax: Parallax,
    /// How the panorama is resampled: fine, plain, or auto, which is fine on all but software GPUs.
    #[arg(long, value_enum, default_value_t = Resampling::Auto)]
    pub resampling: Resampling,
    /// One picture, or both eyes' side by side, each of --size.
    #[arg(long, value_enum, default_value_t = Eyes::One, conflicts_with = "right_eye")]
    pub eyes: Eyes,
    /// Two views by one pass: auto, where the GPU draws two layers at once; on, or an error; off.
    #[arg(long, value_enum, default_value_t = Multiview::Auto)]
    pub multiview: Multiview,
    /// Distance between the eyes, millimetres.
    #[arg(long, default_value_t = 64.0, value_parser = eyes::parse_ipd, allow_negative_numbers = true)]
    pub ipd_mm: f32,
}

fn parse_reflections(text: &str) -> Result<Reflections, String> {
    let named = Reflections::ALL.into_iter().find(|(_, name)| *name == text);
    named.map(|(method, _)| method).ok_or_else(|| Reflections::ALL.map(|(_, name)| name).join(" or "))
}

/// A day is enough for every animation, and microseconds count it exactly.
fn parse_time(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if (0.0..=86_400.0).contains(&seconds) { Ok(seconds) } else { Err("from 0 to 86400 seconds".to_owned()) }
}

fn parse_stereo(text: &str) -> Result<StereoLayout, String> {
    match text {
        "mono" => Ok(StereoLayout::Mono),
        "top-bottom" => Ok(StereoLayout::TopBottom),
        "side-by-side" => Ok(StereoLayout::SideBySide),
        _ => Err("mono, top-bottom or side-by-side".to_owned()),
    }
}

/// Renders one picture.
///
/// # Errors
/// [`Failure::Input`] for what is wrong with a file or an argument, and for pictures that cannot be created; [`Failure::Running`] when there
/// is no GPU to draw with, or it fails, or the disk is full.
pub fn run(args: &RenderArgs) -> Result<(), Failure> {
    let inputs = Inputs::load(args).map_err(Failure::Input)?;
    let coded = create(&args.out, &[ImageFormat::Png, ImageFormat::Jpeg]).map_err(Failure::Input)?;
    let linear = args.out_linear.as_deref().map(|path| create(path, &[ImageFormat::OpenExr, ImageFormat::Hdr]));
    let linear = linear.transpose().map_err(Failure::Input)?;
    let table = |path: &PathBuf| File::create(path).with_context(|| format!("{}: cannot be created", path.display()));
    let passes = args.passes.as_ref().map(table).transpose().map_err(Failure::Input)?;
    let frame_times = args.frame_times.as_ref().map(table).transpose().map_err(Failure::Input)?;
    let mut camera = Camera::looking(args.yaw_deg.to_radians(), args.pitch_deg.to_radians(), args.fov_y_deg.to_radians());
    camera.right_eye = args.right_eye;
    let gpu = Gpu::headless().map_err(running)?;
    let Inputs { picture, light, scene, assets } = &inputs;
    let still = Still { gpu: &gpu, picture, light, scene, assets };
    let RenderArgs { reflections, tier, parallax, resampling, multiview, .. } = *args;
    let how = How { reflections, tier, parallax, resampling, multiview };
    // All is drawn before anything is written: a GPU that fails leaves no half of what was asked for.
    let draw = |format| args.eyes.draw(&still, how, (&camera, args.ipd_mm * 1e-3), args.size, format);
    let coded = (coded, draw(wgpu::TextureFormat::Rgba8UnormSrgb)?);
    let linear = match linear {
        Some(file) => Some((file, draw(wgpu::TextureFormat::Rgba32Float)?)),
        None => None,
    };
    let timed = Timed { camera, size: args.size, views: args.views as usize };
    if let Some(file) = passes {
        let times = still.time_passes(how, timed)?;
        write_rows(file, "pass,gpu_ms", times.iter().map(|pass| format!("{},{}", pass.name, pass.gpu_ms))).map_err(Failure::Running)?;
    }
    if let Some(file) = frame_times {
        let FrameTimes { still_ms, new_picture_ms } = still.time_frames(how, timed, args.frames as usize)?;
        let rows = still_ms.iter().zip(&new_picture_ms).map(|(still, new)| format!("{still:.3},{new:.3}"));
        write_rows(file, "still_ms,new_picture_ms", rows).map_err(Failure::Running)?;
    }
    save(args.eyes.picture_size(args.size), coded, linear).map_err(Failure::Running)
}

fn write_rows(mut file: File, head: &str, rows: impl Iterator<Item = String>) -> anyhow::Result<()> {
    let text: String = std::iter::once(head.to_owned()).chain(rows).map(|row| row + "\n").collect();
    file.write_all(text.as_bytes()).with_context(|| format!("the table of {head} cannot be written"))
}

/// How a picture is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct How {
    /// How glossy surfaces look into the panorama.
    pub reflections: Reflections,
    /// What is left out.
    pub tier: Tier,
    /// How far away the background is.
    pub parallax: Parallax,
    /// How it is resampled.
    pub resampling: Resampling,
    /// Whether two views are drawn by one pass.
    pub multiview: Multiview,
}

impl From<Reflections> for How {
    fn from(reflections: Reflections) -> Self {
        Self { reflections, ..Self::default() }
    }
}

/// What is drawn.
struct Inputs {
    picture: Picture,
    light: LightFrame,
    scene: Scene,
    assets: Models,
}

impl Inputs {
    fn load(args: &RenderArgs) -> anyhow::Result<Self> {
        let mut picture = load_panorama(&args.panorama, args.stereo)?;
        picture.pts_us = (args.time * 1e6).round() as u64;
        let (scene, assets) = load_scene(&args.scene)?;
        let light = match &args.light {
            Some(path) => load_light(path)?,
            None => {
                tracing::info!("no --light: lit by spherical harmonics of the panorama alone, without shadow-casting lights");
                ambient_light(&picture)
            }
        };
        Ok(Self { picture, light, scene, assets })
    }
}

fn running(error: impl Into<anyhow::Error>) -> Failure {
    Failure::Running(error.into())
}

/// A picture file in the format that its ending names, one of `formats`.
fn create(path: &Path, formats: &[ImageFormat]) -> anyhow::Result<PictureFile> {
    let format = ImageFormat::from_path(path).ok().filter(|format| formats.contains(format)).with_context(|| {
        let endings: Vec<_> = formats.iter().flat_map(|format| format.extensions_str()).map(|ending| format!(".{ending}")).collect();
        format!("{}: its name has to end in {}", path.display(), endings.join(" or "))
    })?;
    Ok(PictureFile::create(path, format)?)
}

/// Writes RGBA8, and RGBA of 32-bit floats where that was asked for.
fn save((width, height): (u32, u32), coded: (PictureFile, Vec<u8>), linear: Option<(PictureFile, Vec<u8>)>) -> anyhow::Result<()> {
    let (file, bytes) = coded;
    let rgb = bytes.chunks_exact(4).flat_map(|texel| [texel[0], texel[1], texel[2]]).collect();
    file.write(&image::RgbImage::from_raw(width, height, rgb).context(TOO_FEW)?.into())?;
    if let Some((file, bytes)) = linear {
        let value = |at: usize| bytes.get(at..at + 4).and_then(|b| b.try_into().ok()).map_or(0.0, f32::from_le_bytes);
        let rgb = (0..bytes.len() / 16).flat_map(|texel| [0, 4, 8].map(|channel| value(texel * 16 + channel))).collect();
        file.write(&image::Rgb32FImage::from_raw(width, height, rgb).context(TOO_FEW)?.into())?;
    }
    Ok(())
}

const TOO_FEW: &str = "the GPU gave back fewer pixels than were asked for";

/// A still panorama with its light, and a scene to draw into it: in the pose of the picture's time.
pub struct Still<'a> {
    /// Draws.
    pub gpu: &'a Gpu,
    /// The panorama.
    pub picture: &'a Picture,
    /// Its light.
    pub light: &'a LightFrame,
    /// What stands in it.
    pub scene: &'a Scene,
    /// Models by name.
    pub assets: &'a Models,
}

impl Still<'_> {
    /// Draws one picture and brings it back, rows packed from the top, as the format says.
    ///
    /// # Errors
    /// [`Failure::Input`] for a model that cannot be drawn, and for a panorama or a picture too large for the GPU; [`Failure::Running`] for a
    /// GPU that refuses or is lost.
    pub fn draw(&self, camera: &Camera, size: (u32, u32), format: wgpu::TextureFormat) -> Result<Vec<u8>, Failure> {
        self.draw_by(How::default(), camera, size, format)
    }

    /// As [`Still::draw`], in this way.
    ///
    /// # Errors
    /// As [`Still::draw`].
    pub fn draw_by(&self, how: impl Into<How>, camera: &Camera, size: (u32, u32), format: wgpu::TextureFormat) -> Result<Vec<u8>, Failure> {
        let views = self.draw_views(how.into(), std::slice::from_ref(camera), size, format)?;
        views.into_iter().next().ok_or_else(|| Failure::Running(anyhow!(TOO_FEW)))
    }

    /// Draws a frame of some views, each of this size.
    fn draw_views(&self, how: How, cameras: &[Camera], size: (u32, u32), format: wgpu::TextureFormat) -> Result<Vec<Vec<u8>>, Failure> {
        let gpu = self.gpu;
        let largest = gpu.device.limits().max_texture_dimension_2d;
        if size.0.max(size.1) > largest {
            let (width, height) = size;
            return Err(Failure::Input(anyhow!("a picture of {width}×{height} pixels is larger than this GPU draws, {largest} on a side")));
        }
        let memory = gpu.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let validation = gpu.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let drawn = self.draw_checked(how, cameras, size, format);
        let fault = [block_on(validation.pop()), block_on(memory.pop())].into_iter().flatten().next();
        match fault {
            // The fault came first: what it left undone may have failed in turn.
            Some(fault) => Err(running(GpuError::Refused { width: size.0, height: size.1, fault: fault.to_string() })),
            None => drawn,
        }
    }

    /// The panorama on the GPU, and a renderer that has light and scene.
    fn set_up(&self, how: How, views: usize, format: wgpu::TextureFormat) -> Result<(Environment, Renderer), Failure> {
        let gpu = self.gpu;
        let mut environment = Environment::new(gpu).map_err(running)?;
        environment.upload(gpu, self.picture).map_err(|error| Failure::Input(error.into()))?;
        let mut renderer = Renderer::new(gpu, format).map_err(running)?;
        renderer.set_light(self.light);
        renderer.set_reflections(how.reflections);
        renderer.set_tier(how.tier);
        renderer.set_parallax(how.parallax);
        renderer.set_resampling(gpu, how.resampling);
        renderer.set_time(self.picture.pts_us);
        how.multiview.set_up(gpu, &mut renderer, views)?;
        if let Some(warning) = renderer.set_scene(gpu, self.scene, &|id| self.assets.get(&id).cloned().map(Ok)).into_iter().next() {
            return Err(Failure::Input(warning.into()));
        }
        Ok((environment, renderer))
    }

    fn draw_checked(&self, how: How, cameras: &[Camera], size: (u32, u32), format: wgpu::TextureFormat) -> Result<Vec<Vec<u8>>, Failure> {
        let gpu = self.gpu;
        let (mut environment, mut renderer) = self.set_up(how, cameras.len(), format)?;
        let layers = Layers::new(gpu, size, cameras.len(), format);
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let report = layers.render(gpu, &mut encoder, &mut environment, &mut renderer, cameras);
        gpu.queue.submit([encoder.finish()]);
        let views =
            (0..cameras.len() as u32).map(|layer| gpu.read_layer(&layers.texture, layer).map_err(running)).collect::<Result<_, _>>()?;
        tracing::debug!(plan = ?report.plan, draws = report.draws, triangles = report.triangles, "drawn");
        Ok(views)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use half::f16;
    use mr360_protocol::video::Transfer;

    use super::*;
    use crate::picture::Samples;

    #[test]
    fn a_time_is_seconds_of_a_day() {
        assert_eq!(parse_time("1.5"), Ok(1.5));
        for refused in ["-1", "86401", "nan", "inf", "1s"] {
            assert!(parse_time(refused).is_err(), "{refused}");
        }
    }

    #[test]
    fn a_picture_beyond_one_buffer_is_drawn_whole() {
        let gpu = Gpu::headless().unwrap();
        let half = [0.25, 0.5, 0.75, 1.0].map(f16::from_f32);
        let samples = Samples::Rgba16F { texels: [half, half].concat(), transfer: Transfer::Linear };
        let picture = Picture { pts_us: 0, width: 2, height: 1, stereo: StereoLayout::Mono, samples };
        let (scene, light) = (Scene::default(), ambient_light(&picture));
        let still = Still { gpu: &gpu, picture: &picture, light: &light, scene: &scene, assets: &HashMap::new() };
        let (width, height) = (8192, 2050);
        assert!(u64::from(width) * u64::from(height) * 16 > gpu.device.limits().max_buffer_size);
        let bytes = still.draw(&Camera::looking(0.0, 0.0, 1.0), (width, height), wgpu::TextureFormat::Rgba32Float).unwrap();
        assert_eq!(bytes.len(), width as usize * height as usize * 16);
        let texel: Vec<u8> = [0.25_f32, 0.5, 0.75, 1.0].iter().flat_map(|value| value.to_le_bytes()).collect();
        assert!(bytes.chunks_exact(16).all(|drawn| drawn == texel));
    }

    #[test]
    fn what_the_gpu_refuses_is_an_error_and_not_a_dump() {
        let gpu = Gpu::headless().unwrap();
        let samples = Samples::Rgba16F { texels: vec![f16::ONE; 8], transfer: Transfer::Linear };
        let picture = Picture { pts_us: 0, width: 2, height: 1, stereo: StereoLayout::Mono, samples };
        let (scene, light) = (Scene::default(), ambient_light(&picture));
        let still = Still { gpu: &gpu, picture: &picture, light: &light, scene: &scene, assets: &HashMap::new() };
        let camera = Camera::looking(0.0, 0.0, 1.0);
        // A format that nothing can be drawn to.
        let refused = still.draw(&camera, (64, 32), wgpu::TextureFormat::Rgb9e5Ufloat);
        assert!(matches!(&refused, Err(Failure::Running(error)) if error.to_string().contains("64×32")), "{refused:?}");
        let largest = gpu.device.limits().max_texture_dimension_2d;
        let refused = still.draw(&camera, (largest + 1, 1), wgpu::TextureFormat::Rgba8UnormSrgb);
        assert!(matches!(&refused, Err(Failure::Input(error)) if error.to_string().contains("larger")), "{refused:?}");
    }
}
