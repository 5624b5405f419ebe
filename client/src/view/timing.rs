//! GPU time of each pass by timestamp queries, read back a frame or two later without waiting.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

use crate::gpu::Gpu;
use crate::stats::PassTime;

/// Most passes that are timed in one frame.
const MAX_PASSES: usize = 32;
/// Frames whose times are on their way.
const IN_FLIGHT: usize = 3;

const FREE: u8 = 0;
const RECORDED: u8 = 1;
const MAPPING: u8 = 2;
const MAPPED: u8 = 3;
const FAILED: u8 = 4;

struct Slot {
    buffer: wgpu::Buffer,
    names: Vec<&'static str>,
    state: Arc<AtomicU8>,
}

/// Times passes where the device has timestamp queries; does nothing elsewhere.
pub struct PassTimer {
    queries: Option<(wgpu::QuerySet, wgpu::Buffer)>,
    slots: Vec<Slot>,
    names: Vec<&'static str>,
    period_ns: f32,
    latest: Vec<PassTime>,
}

impl PassTimer {
    /// A timer for this device.
    #[must_use]
    pub fn new(gpu: &Gpu) -> Self {
        let bytes = (MAX_PASSES * 2 * size_of::<u64>()) as u64;
        let buffer = |usage| {
            gpu.device.create_buffer(&wgpu::BufferDescriptor { label: Some("pass times"), size: bytes, usage, mapped_at_creation: false })
        };
        let available = gpu.device.features().contains(wgpu::Features::TIMESTAMP_QUERY);
        let queries = available.then(|| {
            let set = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("pass times"),
                ty: wgpu::QueryType::Timestamp,
                count: MAX_PASSES as u32 * 2,
            });
            (set, buffer(wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC))
        });
        let slot = || Slot {
            buffer: buffer(wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ),
            names: Vec::new(),
            state: Arc::new(AtomicU8::new(FREE)),
        };
        Self {
            queries,
            slots: (0..IN_FLIGHT).map(|_| slot()).collect(),
            names: Vec::new(),
            period_ns: gpu.queue.get_timestamp_period(),
            latest: Vec::new(),
        }
    }

    /// Takes what has come back, without waiting; call once a frame before recording.
    pub fn collect(&mut self, gpu: &Gpu) {
        // A lost device is seen by `Gpu::lost`; here it only means that no times come back.
        let _ = gpu.device.poll(wgpu::PollType::Poll);
        for slot in &mut self.slots {
            match slot.state.load(Ordering::Acquire) {
                RECORDED => {
                    slot.state.store(MAPPING, Ordering::Release);
                    let state = Arc::clone(&slot.state);
                    slot.buffer.slice(..).map_async(wgpu::MapMode::Read, move |result| {
                        state.store(if result.is_ok() { MAPPED } else { FAILED }, Ordering::Release);
                    });
                }
                MAPPED => {
                    if let Ok(bytes) = slot.buffer.slice(..).get_mapped_range() {
                        self.latest = times(&bytes, &slot.names, self.period_ns);
                    }
                    slot.buffer.unmap();
                    slot.state.store(FREE, Ordering::Release);
                }
                FAILED => slot.state.store(FREE, Ordering::Release),
                _ => {}
            }
        }
    }

    /// Both timestamps of a pass.
    pub fn pass(&mut self, name: &'static str) -> Option<wgpu::RenderPassTimestampWrites<'_>> {
        let at = self.start(name)?;
        self.writes(Some(at), Some(at + 1))
    }

    /// Both timestamps of a compute pass.
    pub fn compute(&mut self, name: &'static str) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let at = self.start(name)?;
        let (query_set, _) = self.queries.as_ref()?;
        let (beginning_of_pass_write_index, end_of_pass_write_index) = (Some(at), Some(at + 1));
        Some(wgpu::ComputePassTimestampWrites { query_set, beginning_of_pass_write_index, end_of_pass_write_index })
    }

    /// First timestamp of a run of passes that are timed as one.
    pub fn begin(&mut self, name: &'static str) -> Option<wgpu::RenderPassTimestampWrites<'_>> {
        let at = self.start(name)?;
        self.writes(Some(at), None)
    }

    /// Last timestamp of the run that [`PassTimer::begin`] started.
    pub fn end(&mut self) -> Option<wgpu::RenderPassTimestampWrites<'_>> {
        let at = (self.names.len() as u32).checked_sub(1)? * 2;
        self.writes(None, Some(at + 1))
    }

    fn start(&mut self, name: &'static str) -> Option<u32> {
        if self.queries.is_none() || self.names.len() >= MAX_PASSES {
            return None;
        }
        self.names.push(name);
        Some((self.names.len() as u32 - 1) * 2)
    }

    fn writes(&self, beginning: Option<u32>, end: Option<u32>) -> Option<wgpu::RenderPassTimestampWrites<'_>> {
        let (query_set, _) = self.queries.as_ref()?;
        Some(wgpu::RenderPassTimestampWrites { query_set, beginning_of_pass_write_index: beginning, end_of_pass_write_index: end })
    }

    /// Records the read-back of this frame's times; skipped when earlier frames' are all still on their way.
    pub fn finish(&mut self, encoder: &mut wgpu::CommandEncoder) {
        let names = std::mem::take(&mut self.names);
        let Some((set, resolved)) = &self.queries else { return };
        let free = self.slots.iter_mut().find(|slot| slot.state.load(Ordering::Acquire) == FREE);
        let (Some(slot), false) = (free, names.is_empty()) else { return };
        let count = names.len() as u32 * 2;
        encoder.resolve_query_set(set, 0..count, resolved, 0);
        encoder.copy_buffer_to_buffer(resolved, 0, &slot.buffer, 0, u64::from(count) * 8);
        slot.names = names;
        slot.state.store(RECORDED, Ordering::Release);
    }

    /// The newest times that came back, one or two frames old.
    #[must_use]
    pub fn latest(&self) -> &[PassTime] {
        &self.latest
    }
}

fn times(bytes: &[u8], names: &[&'static str], period_ns: f32) -> Vec<PassTime> {
    let stamp = |at: usize| bytes.get(at * 8..at * 8 + 8).and_then(|b| b.try_into().ok()).map_or(0, u64::from_le_bytes);
    let one = |(i, name): (usize, &&'static str)| PassTime {
        name,
        gpu_ms: stamp(2 * i + 1).saturating_sub(stamp(2 * i)) as f32 * period_ns * 1e-6,
    };
    names.iter().enumerate().map(one).collect()
}
