//! Keeps what the eyes saw: once a second both pictures, as PNG, and a line of JSON with everything needed to draw them again. Neither the
//! frame loop nor the GPU waits for it: a picture that finds the last ones still under way is not kept.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context;
use half::f16;
use mr360_protocol::clock::ClientTime;
use mr360_shaders::colour::srgb_encode;
use serde::Serialize;

use crate::hands::{HandInput, Pose};
use crate::viewpoint::Viewpoint;

/// From one frame that is kept to the next, microseconds.
const INTERVAL_US: u64 = 1_000_000;
/// Most frames under way to the disk.
const UNDER_WAY: usize = 3;
/// Longest wait for the last copies when all is over.
const PATIENCE: Duration = Duration::from_secs(5);
/// Names of the two layers.
const EYES: [&str; 2] = ["left", "right"];

/// What a kept frame was.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Kept {
    /// The headset's frames before it.
    pub(super) frame: u64,
    /// Of the video's picture.
    pub(super) pts_us: u64,
    /// From where each eye saw it.
    pub(super) views: Vec<Viewpoint>,
    /// As the action layer saw them in this frame.
    pub(super) hands: [HandInput; 2],
    /// Between the eyes.
    pub(super) head: Pose,
}

struct Job {
    kept: Kept,
    pixels: wgpu::Buffer,
    layout: Layout,
}

#[derive(Clone, Copy)]
struct Layout {
    width: u32,
    height: u32,
    padded_row: u32,
    format: wgpu::TextureFormat,
}

/// Writes into a folder on a thread of its own, until dropped.
pub struct EyeRecorder {
    /// `None` ends the writer.
    jobs: SyncSender<Option<Job>>,
    /// Of the last copy.
    device: Option<wgpu::Device>,
    frames: u64,
    under_way: Arc<AtomicUsize>,
    last: Option<ClientTime>,
    writer: Option<JoinHandle<()>>,
}

impl EyeRecorder {
    /// Makes the folder, and begins `frames.jsonl` in it anew.
    ///
    /// # Errors
    /// Naming what cannot be created.
    pub fn start(folder: &Path) -> anyhow::Result<Self> {
        std::fs::create_dir_all(folder).with_context(|| format!("--record-eyes {}: the folder cannot be made", folder.display()))?;
        let list = folder.join("frames.jsonl");
        let file = File::create(&list).with_context(|| format!("--record-eyes: {} cannot be created", list.display()))?;
        let (jobs, receiver) = sync_channel(UNDER_WAY + 1);
        let under_way = Arc::new(AtomicUsize::new(0));
        let (folder, counter) = (folder.to_owned(), Arc::clone(&under_way));
        let writer = std::thread::Builder::new().name("eyes".to_owned()).spawn(move || write(&receiver, &folder, file, &counter))?;
        Ok(Self { jobs, device: None, frames: 0, under_way, last: None, writer: Some(writer) })
    }

    /// Counts a frame. Its number when it is to be kept, and there is room for it.
    pub(super) fn count(&mut self, now: ClientTime) -> Option<u64> {
        let number = self.frames;
        self.frames += 1;
        let due = self.last.is_none_or(|last| now.0 >= last.0.saturating_add(INTERVAL_US));
        (due && self.under_way.load(Ordering::Acquire) < UNDER_WAY).then_some(number)
    }

    /// Submits a copy of a texture of two layers, which is left as the runtime wants it back. Nothing waits for the copy.
    pub(super) fn keep(&mut self, device: &wgpu::Device, queue: &wgpu::Queue, texture: &wgpu::Texture, kept: Kept, now: ClientTime) {
        self.last = Some(now);
        self.device = Some(device.clone());
        let row = texture.width() * texture.format().block_copy_size(None).unwrap_or(4);
        let padded_row = row.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let layout = Layout { width: texture.width(), height: texture.height(), padded_row, format: texture.format() };
        let pixels = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("eyes"),
            size: EYES.len() as u64 * u64::from(padded_row) * u64::from(layout.height),
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("eyes") });
        encoder.copy_texture_to_buffer(
            texture.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &pixels,
                layout: wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(padded_row), rows_per_image: Some(layout.height) },
            },
            texture.size(),
        );
        let back = wgpu::TextureTransition { texture, selector: None, state: wgpu::TextureUses::COLOR_TARGET };
        encoder.transition_resources(std::iter::empty(), std::iter::once(back));
        queue.submit([encoder.finish()]);
        self.under_way.fetch_add(1, Ordering::AcqRel);
        let (jobs, counter, mapped) = (self.jobs.clone(), Arc::clone(&self.under_way), pixels.clone());
        // Called by a later submission, when the copy is done.
        mapped.map_async(wgpu::MapMode::Read, .., move |result| {
            if result.is_err() || jobs.try_send(Some(Job { kept, pixels, layout })).is_err() {
                counter.fetch_sub(1, Ordering::AcqRel);
            }
        });
    }
}

impl Drop for EyeRecorder {
    fn drop(&mut self) {
        // The last copies; those of a lost device are not coming.
        if let Some(device) = &self.device {
            let _ = device.poll(wgpu::PollType::Wait { submission_index: None, timeout: Some(PATIENCE) });
        }
        if let Some(writer) = self.writer.take().filter(|_| self.jobs.send(None).is_ok()) {
            // It has said what went wrong.
            let _ = writer.join();
        }
    }
}

fn write(jobs: &Receiver<Option<Job>>, folder: &Path, list: File, under_way: &AtomicUsize) {
    let mut list = BufWriter::new(list);
    let mut failed = false;
    while let Ok(Some(job)) = jobs.recv() {
        if !failed && let Err(error) = write_one(&job, folder, &mut list) {
            tracing::error!("--record-eyes: {error:#}; going on without");
            failed = true;
        }
        job.pixels.unmap();
        under_way.fetch_sub(1, Ordering::AcqRel);
    }
}

fn write_one(job: &Job, folder: &Path, list: &mut impl Write) -> anyhow::Result<()> {
    let Layout { width, height, padded_row, format } = job.layout;
    let mapped = job.pixels.get_mapped_range(..).map_err(|error| anyhow::anyhow!("the copy cannot be read: {error}"))?;
    for (eye, layer) in EYES.into_iter().zip(mapped.chunks_exact(padded_row as usize * height as usize)) {
        let path = picture_path(folder, job.kept.frame, eye);
        let texels: Vec<u8> = layer.chunks_exact(padded_row as usize).flat_map(|row| codes(row, width as usize, format)).collect();
        let picture = image::RgbImage::from_raw(width, height, texels).context("fewer pixels than the picture has")?;
        picture.save_with_format(&path, image::ImageFormat::Png).with_context(|| format!("{} cannot be written", path.display()))?;
    }
    let line = serde_json::to_string(&job.kept).context("frames.jsonl")?;
    writeln!(list, "{line}").and_then(|()| list.flush()).context("frames.jsonl cannot be written")?;
    tracing::info!(frame = job.kept.frame, "eyes kept");
    Ok(())
}

fn picture_path(folder: &Path, frame: u64, eye: &str) -> PathBuf {
    folder.join(format!("{frame:06}-{eye}.png"))
}

/// sRGB codes of a row in any of the formats that a headset's pictures have.
fn codes(row: &[u8], width: usize, format: wgpu::TextureFormat) -> Vec<u8> {
    let bytes = format.block_copy_size(None).unwrap_or(4) as usize;
    let texels = row.chunks_exact(bytes).take(width);
    let float = |texel: &[u8], at: usize| {
        let linear = f16::from_le_bytes([texel[at], texel[at + 1]]).to_f32();
        (srgb_encode(linear.clamp(0.0, 1.0)) * 255.0).round() as u8
    };
    match format {
        wgpu::TextureFormat::Rgba16Float => texels.flat_map(|texel| [0, 2, 4].map(|at| float(texel, at))).collect(),
        wgpu::TextureFormat::Bgra8UnormSrgb => texels.flat_map(|texel| [texel[2], texel[1], texel[0]]).collect(),
        _ => texels.flat_map(|texel| [texel[0], texel[1], texel[2]]).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::gpu::{Gpu, texture_of};

    fn kept(frame: u64) -> Kept {
        let views = vec![Viewpoint::of(&Camera::looking(0.0, 0.0, 1.0), 1.0); 2];
        Kept { frame, pts_us: 7, views, hands: Default::default(), head: Pose::IDENTITY }
    }

    #[test]
    fn both_layers_reach_the_disk_as_they_were() {
        let gpu = Gpu::headless().unwrap();
        let size = wgpu::Extent3d { width: 5, height: 3, depth_or_array_layers: 2 };
        let texels: Vec<u8> = (0..5 * 3 * 2 * 4).map(|at| at as u8).collect();
        let texture = texture_of(&gpu, size, wgpu::TextureFormat::Bgra8UnormSrgb, &texels);
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = EyeRecorder::start(folder.path()).unwrap();
        assert_eq!(recorder.count(ClientTime(5)), Some(0));
        recorder.keep(&gpu.device, &gpu.queue, &texture, kept(4), ClientTime(5));
        assert_eq!((recorder.count(ClientTime(5 + INTERVAL_US - 1)), recorder.count(ClientTime(5 + INTERVAL_US))), (None, Some(2)));
        drop(recorder);
        for (eye, first) in EYES.into_iter().zip([0_u8, 60]) {
            let picture = image::open(picture_path(folder.path(), 4, eye)).unwrap().into_rgb8();
            assert_eq!(picture.dimensions(), (5, 3));
            let texel = |x, y| picture.get_pixel(x, y).0;
            let expected = |at: u8| [at + 2, at + 1, at];
            assert_eq!((texel(0, 0), texel(4, 2)), (expected(first), expected(first + 56)), "{eye}");
        }
        let line = std::fs::read_to_string(folder.path().join("frames.jsonl")).unwrap();
        assert!(line.starts_with("{\"frame\":4,\"pts_us\":7,\"views\":[{\"position\":"), "{line}");
    }

    #[test]
    fn a_slow_disk_keeps_fewer_frames_and_holds_up_nobody() {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = EyeRecorder::start(folder.path()).unwrap();
        recorder.under_way.store(UNDER_WAY, Ordering::Release);
        assert_eq!(recorder.count(ClientTime(0)), None);
        let error = EyeRecorder::start(Path::new("/proc/no-such-folder")).err().unwrap();
        assert!(format!("{error:#}").contains("/proc/no-such-folder"));
    }
}
