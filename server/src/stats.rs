//! One timestamp a stage for every frame: CSV rows while it runs, a summary at the end.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use mr360_protocol::clock::ServerTime;
use mr360_protocol::stages::StageTimes;

use crate::ingest::IngestCounters;
use crate::lighting::StepTimes;

/// Coded frames that may wait for their light before they are written without it.
const MAX_WAITING: usize = 256;

/// Shared between the threads of the data path; each call is short.
#[derive(Clone)]
pub struct Stats(Arc<Mutex<Inner>>);

struct Inner {
    csv: Option<Csv>,
    waiting: BTreeMap<u64, Coded>,
    frames: u64,
    stages: StageTimes,
    bytes: [(&'static str, u64); 3],
    without_light: u64,
    light_errors: u64,
    media_errors: u64,
    first_pts_us: Option<u64>,
    last_pts_us: u64,
}

struct Csv {
    path: PathBuf,
    out: BufWriter<File>,
    /// Cells of a row that belong to its light; known once the header is written.
    light_cells: Option<usize>,
}

struct Coded {
    ingested: ServerTime,
    published: ServerTime,
    bytes: usize,
}

/// Light of one frame, as published.
pub struct LightRow<'a> {
    /// The frame.
    pub pts_us: u64,
    /// When its picture was decoded.
    pub decoded: ServerTime,
    /// When its estimate began.
    pub begun: ServerTime,
    /// When its light went to the transport.
    pub published: ServerTime,
    /// Steps of the estimate.
    pub steps: &'a StepTimes,
    /// Number of lights.
    pub lights: usize,
    /// Size on the wire.
    pub bytes: usize,
}

/// Cells of a row that belong to its light, before the steps of the method.
const LIGHT_CELLS: usize = 5;
const VIDEO: usize = 0;
const LIGHT: usize = 1;
const AUDIO: usize = 2;

impl Stats {
    /// Statistics that are also written to `csv`, if given.
    ///
    /// # Errors
    /// When the file cannot be created.
    pub fn new(csv: Option<&Path>) -> std::io::Result<Self> {
        let csv = csv
            .map(|path| File::create(path).map(|file| Csv { path: path.to_owned(), out: BufWriter::new(file), light_cells: None }))
            .transpose()?;
        Ok(Self(Arc::new(Mutex::new(Inner {
            csv,
            waiting: BTreeMap::new(),
            frames: 0,
            stages: StageTimes::default(),
            bytes: [("video", 0), ("light", 0), ("audio", 0)],
            without_light: 0,
            light_errors: 0,
            media_errors: 0,
            first_pts_us: None,
            last_pts_us: 0,
        }))))
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A coded frame went to the transport.
    pub fn video(&self, pts_us: u64, ingested: ServerTime, published: ServerTime, bytes: usize) {
        let mut inner = self.lock();
        inner.frames += 1;
        inner.first_pts_us.get_or_insert(pts_us);
        inner.last_pts_us = pts_us;
        inner.bytes[VIDEO].1 += bytes as u64;
        inner.stages.record("publish video", published.0.saturating_sub(ingested.0));
        inner.waiting.insert(pts_us, Coded { ingested, published, bytes });
        if inner.waiting.len() > MAX_WAITING
            && let Some((pts_us, coded)) = inner.waiting.pop_first()
        {
            inner.without_light += 1;
            inner.write_row(pts_us, &coded, None);
        }
    }

    /// The light of a frame went to the transport.
    pub fn light(&self, row: &LightRow<'_>) {
        let mut inner = self.lock();
        inner.bytes[LIGHT].1 += row.bytes as u64;
        let Some(coded) = inner.waiting.remove(&row.pts_us) else { return };
        inner.stages.record("decode", row.decoded.0.saturating_sub(coded.ingested.0));
        for (name, duration) in row.steps.iter() {
            inner.stages.record_step("light", name, micros(duration));
        }
        inner.stages.record("light", row.published.0.saturating_sub(row.begun.0));
        inner.stages.record("ingest to light published", row.published.0.saturating_sub(coded.ingested.0));
        inner.write_row(row.pts_us, &coded, Some(row));
    }

    /// An audio packet went to the transport.
    pub fn audio(&self, bytes: usize) {
        self.lock().bytes[AUDIO].1 += bytes as u64;
    }

    /// The light of a frame could not be found or published.
    pub fn light_error(&self) {
        self.lock().light_errors += 1;
    }

    /// A packet could not be published.
    pub fn media_error(&self) {
        self.lock().media_errors += 1;
    }

    /// The summary, many lines.
    #[must_use]
    pub fn summary(&self, survived: IngestCounters) -> String {
        let mut inner = self.lock();
        inner.flush();
        let seconds = inner.last_pts_us.saturating_sub(inner.first_pts_us.unwrap_or(0)) as f64 / 1e6;
        let mut text = format!("{} frames in {seconds:.1} s\n", inner.frames);
        text += &inner.stages.to_string();
        for (name, bytes) in inner.bytes {
            let rate = if seconds > 0.0 { bytes as f64 * 8e-3 / seconds } else { 0.0 };
            text += &format!("track {name}: {bytes} bytes  {rate:.1} kbit/s\n");
        }
        let IngestCounters { reconnects, timestamp_jumps, format_changes, corrupt_packets, frames_without_light } = survived;
        text += &format!(
            "survived: {reconnects} reconnects, {timestamp_jumps} timestamp jumps, {format_changes} format changes, \
             {corrupt_packets} corrupt packets\nwithout light: {frames_without_light} too late, {} with errors, {} never decoded; \
             {} packets not published",
            inner.light_errors, inner.without_light, inner.media_errors
        );
        text
    }
}

impl Inner {
    fn write_row(&mut self, pts_us: u64, coded: &Coded, light: Option<&LightRow<'_>>) {
        let Some(csv) = &mut self.csv else { return };
        if let Err(error) = csv.row(pts_us, coded, light) {
            tracing::error!(path = %csv.path.display(), %error, "statistics end here; the broadcast goes on");
            self.csv = None;
        }
    }

    fn flush(&mut self) {
        while let Some((pts_us, coded)) = self.waiting.pop_first() {
            self.without_light += 1;
            self.write_row(pts_us, &coded, None);
        }
        if let Some(csv) = &mut self.csv
            && let Err(error) = csv.out.flush()
        {
            tracing::error!(path = %csv.path.display(), %error, "statistics are incomplete");
        }
    }
}

impl Csv {
    /// The steps of the method that runs name their columns, so the header waits for the first light.
    fn row(&mut self, pts_us: u64, coded: &Coded, light: Option<&LightRow<'_>>) -> std::io::Result<()> {
        if self.light_cells.is_none() {
            let Some(light) = light else { return Ok(()) };
            write!(
                self.out,
                "pts_us,ingested_us,video_published_us,video_bytes,decoded_us,light_begun_us,light_published_us,lights,light_bytes"
            )?;
            for (name, _) in light.steps.iter() {
                write!(self.out, ",light_{}_us", name.replace([' ', ','], "_"))?;
            }
            writeln!(self.out)?;
            self.light_cells = Some(LIGHT_CELLS + light.steps.iter().count());
        }
        write!(self.out, "{pts_us},{},{},{}", coded.ingested.0, coded.published.0, coded.bytes)?;
        if let Some(light) = light {
            write!(self.out, ",{},{},{},{},{}", light.decoded.0, light.begun.0, light.published.0, light.lights, light.bytes)?;
            for (_, duration) in light.steps.iter() {
                write!(self.out, ",{}", micros(duration))?;
            }
        } else {
            write!(self.out, "{}", ",".repeat(self.light_cells.unwrap_or(0)))?;
        }
        writeln!(self.out)
    }
}

fn micros(duration: Duration) -> u64 {
    u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)
}
