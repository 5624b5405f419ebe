//! One time per stage of every frame: as CSV while running, as a summary at the end. Memory is bounded however long it runs.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use mr360_protocol::clock::ClientTime;
use mr360_protocol::stages::StageTimes;

use crate::decode::DecodeCounters;
use crate::frame_loop::{Drawn, HeadsetTimes, Presented};
use crate::governor::Tier;
use crate::sync::Drops;

/// Most tracks told apart; their names come from the catalog.
const MAX_NAMES: usize = 64;
/// Columns before those of the passes.
const COLUMNS: &str = "frame,pts_us,arrived_us,decoded_us,light_pts_us,light_arrived_us,paired_us,uploaded_us,rendered_us,presented_us,network_us,light_age_us,video_age_us,\
playout_delay_us,dropped_superseded,dropped_no_light,dropped_late,dropped_overflow,light_late,decode_errors,decode_backlog,decode_superseded,light_weight,\
tier,shadow_lights,reflections_every,occlusion,samples,gpu_waits,pose_to_photon_us,frame_us,missed_frames";

/// GPU time of one pass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PassTime {
    /// Its name: `shadow`, `view`, …
    pub name: &'static str,
    /// Milliseconds.
    pub gpu_ms: f32,
}

/// One presented frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameTimes {
    /// Presented frames before this one.
    pub frame: u64,
    /// Of the picture shown.
    pub pts_us: u64,
    /// True the first time that this picture is shown: only then are the stages up to the upload counted.
    pub new_picture: bool,
    /// When the picture's access unit had arrived.
    pub arrived: ClientTime,
    /// When the picture left the decoder.
    pub decoded: ClientTime,
    /// Its light, if it has one.
    pub light: Option<LightTimes>,
    /// How far the light in force is on its way to the next picture's, in [0, 1); 0 under the picture's own.
    pub light_weight: f32,
    /// When both were handed to the renderer.
    pub paired: ClientTime,
    /// When the upload was submitted.
    pub uploaded: ClientTime,
    /// When drawing the view began.
    pub begun: ClientTime,
    /// When the view's passes were submitted.
    pub rendered: ClientTime,
    /// When the frame was handed to the display, or read back.
    pub presented: ClientTime,
    /// How late pictures are played out on purpose, microseconds.
    pub playout_delay_us: u64,
    /// What presenting it came to.
    pub shown: Presented,
}

impl FrameTimes {
    /// From the server's publishing the picture's light to the frame's presenting, microseconds; `None` without a light.
    #[must_use]
    pub fn light_age_us(&self) -> Option<u64> {
        self.light.map(|light| self.presented.0.saturating_sub(light.published.0))
    }

    /// From the arrival of the picture's access unit to the frame's presenting, microseconds.
    #[must_use]
    pub fn video_age_us(&self) -> u64 {
        self.presented.0.saturating_sub(self.arrived.0)
    }
}

/// Times of a LightFrame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LightTimes {
    /// Its pts: the picture's own, unless pairing has failed.
    pub pts_us: u64,
    /// When the server published it, on this client's clock (see [`mr360_protocol::clock::ClockOffset`]): the least network
    /// delay counts as none.
    pub published: ClientTime,
    /// When it had arrived.
    pub arrived: ClientTime,
}

/// Why statistics cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: statistics cannot be written ({fault}); check that the folder exists, can be written to, and has space")]
pub struct StatsError {
    path: String,
    fault: std::io::Error,
}

struct Csv {
    path: String,
    file: BufWriter<File>,
    /// Passes that have a column.
    passes: &'static [&'static str],
    header_written: bool,
}

/// Collects.
#[derive(Default)]
pub struct Stats {
    csv: Option<Csv>,
    stages: StageTimes,
    /// Names of the GPU's passes as stages, made once: frames make no texts.
    gpu_stages: Vec<(&'static str, String)>,
    tracks: BTreeMap<String, (u64, u64)>,
    frames: u64,
    pictures: u64,
    blended: u64,
    /// Frames by tier.
    tiers: [u64; Tier::COUNT],
    skipped: u64,
    unseen: u64,
    gpu_waits: u64,
    /// Of a headset, as last told.
    missed: Option<u64>,
    drops: Drops,
    decode: [u64; 6],
}

impl Stats {
    /// Without a path only the summary is made; `passes` are those with a column in the file.
    ///
    /// # Errors
    /// [`StatsError`] when the file cannot be created.
    pub fn open(path: Option<&Path>, passes: &'static [&'static str]) -> Result<Self, StatsError> {
        let csv = path
            .map(|path| {
                let file = File::create(path).map_err(|fault| StatsError { path: path.display().to_string(), fault })?;
                Ok(Csv { path: path.display().to_string(), file: BufWriter::new(file), passes, header_written: false })
            })
            .transpose()?;
        Ok(Self { csv, ..Self::default() })
    }

    /// Counts received bytes of a track.
    pub fn received(&mut self, track: &str, bytes: usize) {
        if !self.tracks.contains_key(track) {
            if self.tracks.len() >= MAX_NAMES {
                return;
            }
            self.tracks.insert(track.to_owned(), (0, 0));
        }
        if let Some((frames, total)) = self.tracks.get_mut(track) {
            *frames += 1;
            *total += bytes as u64;
        }
    }

    /// Counts a picture that had no target to be drawn to when it was due.
    pub fn skipped(&mut self) {
        self.skipped += 1;
    }

    /// Counts a picture that was due while nothing could be shown.
    pub fn unseen(&mut self) {
        self.unseen += 1;
    }

    /// Takes in what was dropped so far.
    pub fn counted(&mut self, drops: Drops, decode: Option<&DecodeCounters>) {
        self.drops = drops;
        if let Some(decode) = decode {
            self.decode = [
                decode.units.get(),
                decode.pictures.get(),
                decode.errors.get(),
                decode.unanchored.get(),
                decode.backlog.get(),
                decode.superseded.get(),
            ];
        }
    }

    /// Takes in a presented frame. A file that cannot be written to is given up with one line in the log.
    pub fn presented(&mut self, times: &FrameTimes, drawn: &Drawn) {
        self.frames += 1;
        self.tiers[usize::from(drawn.tier.number())] += 1;
        self.blended += u64::from(times.light_weight > 0.0);
        self.gpu_waits += times.shown.gpu_waits;
        self.missed = times.shown.headset.map(|headset| headset.missed).or(self.missed);
        let mut stage = |name, from: ClientTime, to: ClientTime| {
            self.stages.record(name, to.0.saturating_sub(from.0));
        };
        if times.new_picture {
            self.pictures += 1;
            stage("decode (arrived → decoded)", times.arrived, times.decoded);
            stage("playout (decoded → paired)", times.decoded, times.paired);
            stage("upload (paired → submitted)", times.paired, times.uploaded);
            stage("video age (arrived → presented)", times.arrived, times.presented);
            if let Some(light) = times.light {
                stage("network (light published → arrived)", light.published, light.arrived);
                stage("light age (published → presented)", light.published, times.presented);
            }
        }
        stage("view (begun → submitted)", times.begun, times.rendered);
        stage("present (submitted → presented)", times.rendered, times.presented);
        if let Some(HeadsetTimes { pose_to_photon_us, frame_us, .. }) = times.shown.headset {
            self.stages.record("headset frame (called for → handed over)", frame_us);
            if let Some(pose_to_photon_us) = pose_to_photon_us {
                self.stages.record("pose to photon", pose_to_photon_us);
            }
        }
        for pass in drawn.passes.iter().filter(|pass| pass.gpu_ms.is_finite() && pass.gpu_ms >= 0.0) {
            let at = self.gpu_stages.iter().position(|(name, _)| *name == pass.name).unwrap_or_else(|| {
                self.gpu_stages.push((pass.name, format!("gpu {}", pass.name)));
                self.gpu_stages.len() - 1
            });
            self.stages.record(&self.gpu_stages[at].1, (f64::from(pass.gpu_ms) * 1_000.0) as u64);
        }
        self.write_row(times, drawn);
    }

    fn write_row(&mut self, times: &FrameTimes, drawn: &Drawn) {
        let (drops, decode) = (self.drops, self.decode);
        let Some(csv) = self.csv.as_mut() else { return };
        if let Err(fault) = csv.write(times, drawn, drops, decode) {
            tracing::error!("{}; going on without", StatsError { path: csv.path.clone(), fault });
            self.csv = None;
        }
    }

    /// Writes the rest of the file and makes the summary.
    ///
    /// # Errors
    /// [`StatsError`] when the rest cannot be written.
    pub fn finish(mut self) -> Result<Summary, StatsError> {
        if let Some(csv) = self.csv.as_mut() {
            csv.file.flush().map_err(|fault| StatsError { path: csv.path.clone(), fault })?;
        }
        Ok(Summary(self))
    }
}

impl Csv {
    fn write(&mut self, times: &FrameTimes, drawn: &Drawn, drops: Drops, decode: [u64; 6]) -> std::io::Result<()> {
        if !self.header_written {
            write!(self.file, "{COLUMNS}")?;
            for pass in self.passes {
                write!(self.file, ",gpu_{}_ms", pass.replace(' ', "_"))?;
            }
            writeln!(self.file)?;
            self.header_written = true;
        }
        let network = times.light.map(|light| light.arrived.0.saturating_sub(light.published.0));
        let [_, _, errors, _, backlog, superseded] = decode;
        write!(
            self.file,
            "{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{errors},{backlog},{superseded},{},{},{},{},{},{},{},{},{},{}",
            times.frame,
            times.pts_us,
            times.arrived.0,
            times.decoded.0,
            Cell(times.light.map(|light| light.pts_us)),
            Cell(times.light.map(|light| light.arrived.0)),
            times.paired.0,
            times.uploaded.0,
            times.rendered.0,
            times.presented.0,
            Cell(network),
            Cell(times.light_age_us()),
            times.video_age_us(),
            times.playout_delay_us,
            drops.superseded,
            drops.no_light,
            drops.late,
            drops.overflow,
            drops.light_late,
            times.light_weight,
            drawn.tier.number(),
            drawn.plan.shadows,
            drawn.plan.reflections_every,
            u8::from(drawn.plan.occlusion),
            drawn.plan.samples,
            times.shown.gpu_waits,
            Cell(times.shown.headset.and_then(|headset| headset.pose_to_photon_us)),
            Cell(times.shown.headset.map(|headset| headset.frame_us)),
            Cell(times.shown.headset.map(|headset| headset.missed)),
        )?;
        for column in self.passes {
            match drawn.passes.iter().find(|pass| pass.name == *column) {
                Some(pass) => write!(self.file, ",{:.3}", pass.gpu_ms)?,
                None => write!(self.file, ",")?,
            }
        }
        writeln!(self.file)
    }
}

/// A value of the file, or nothing.
struct Cell(Option<u64>);

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.map_or(Ok(()), |value| write!(f, "{value}"))
    }
}

/// What a run came to; prints as a table.
pub struct Summary(Stats);

impl Summary {
    /// Frames presented.
    #[must_use]
    pub fn frames(&self) -> u64 {
        self.0.frames
    }

    /// Different pictures presented.
    #[must_use]
    pub fn pictures(&self) -> u64 {
        self.0.pictures
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let stats = &self.0;
        writeln!(
            f,
            "{} frames presented, {} pictures, {} frames under light between two pictures'",
            stats.frames, stats.pictures, stats.blended
        )?;
        if stats.frames > stats.tiers[0] {
            let tiers = stats.tiers.iter().enumerate().filter(|(_, frames)| **frames > 0);
            let tiers: Vec<_> = tiers.map(|(tier, frames)| format!("{tier}: {frames}")).collect();
            writeln!(f, "frames by tier: {}", tiers.join(", "))?;
        }
        write!(f, "{}", stats.stages)?;
        let Drops { superseded, no_light, late, duplicate, overflow, light_late, light_unused } = stats.drops;
        writeln!(
            f,
            "pictures not shown: {superseded} superseded, {no_light} without light, {late} late, {duplicate} duplicate, {overflow} overflow; \
             display skipped {}, {} passed while nothing could be shown; lights: {light_late} late, {light_unused} unused",
            stats.skipped, stats.unseen
        )?;
        if let Some(missed) = stats.missed {
            writeln!(f, "headset: {missed} display frames missed; {} waits for the GPU within frames", stats.gpu_waits)?;
        }
        let [units, pictures, errors, unanchored, backlog, superseded] = stats.decode;
        writeln!(
            f,
            "decoder: {units} units, {pictures} pictures, {errors} errors, {unanchored} before a keyframe, {backlog} dropped by backlog; {superseded} pictures superseded before the playout"
        )?;
        for (track, (frames, bytes)) in &stats.tracks {
            writeln!(f, "track {track}: {frames} frames, {bytes} bytes")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::Plan;

    fn times(frame: u64) -> FrameTimes {
        let at = |us| ClientTime(frame * 33_000 + us);
        // The first is not a headset's; of the second the runtime's clock cannot be read.
        let headset = [None, Some(None), Some(Some(21_000))][frame.min(2) as usize];
        FrameTimes {
            frame,
            pts_us: frame * 33_000,
            new_picture: true,
            arrived: at(0),
            decoded: at(4_000),
            light_weight: if frame == 2 { 0.25 } else { 0.0 },
            light: (frame != 1).then_some(LightTimes { pts_us: frame * 33_000, published: at(5_000), arrived: at(6_000) }),
            paired: at(24_000),
            uploaded: at(25_000),
            begun: at(25_500),
            rendered: at(27_000),
            presented: at(30_000),
            playout_delay_us: 20_000,
            shown: Presented {
                gpu_waits: frame,
                headset: headset.map(|pose_to_photon_us| HeadsetTimes { pose_to_photon_us, frame_us: 9_000, missed: 3 }),
            },
        }
    }

    #[test]
    fn csv_has_one_column_for_every_value() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("stats.csv");
        let mut stats = Stats::open(Some(&path), &["shadow", "view"]).unwrap();
        for frame in 0..3 {
            let passes = [PassTime { name: "shadow", gpu_ms: 1.5 }, PassTime { name: "view", gpu_ms: 2.25 }];
            let plan = Plan { shadows: 2, reflections_every: 4, samples: 1, ..Plan::default() };
            let passes = if frame == 2 { &passes[1..] } else { &passes[..] };
            stats.presented(&times(frame), &Drawn { passes: passes.to_vec(), tier: Tier::new(frame as u8).unwrap(), plan });
        }
        stats.received("video", 1_000);
        stats.received("video", 500);
        stats.counted(Drops { no_light: 7, ..Drops::default() }, None);
        let summary = stats.finish().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), 4);
        assert!(lines[0].ends_with(
            "decode_backlog,decode_superseded,light_weight,tier,shadow_lights,reflections_every,occlusion,samples,gpu_waits,pose_to_photon_us,frame_us,missed_frames,gpu_shadow_ms,gpu_view_ms"
        ));
        assert!(lines.iter().all(|line| line.split(',').count() == lines[0].split(',').count()));
        assert_eq!(
            lines[1],
            "0,0,0,4000,0,6000,24000,25000,27000,30000,1000,25000,30000,20000,0,0,0,0,0,0,0,0,0,0,2,4,0,1,0,,,,1.500,2.250"
        );
        assert!(lines[2].starts_with("1,33000,33000,37000,,,57000,") && lines[2].ends_with(",1,,9000,3,1.500,2.250"));
        assert!(lines[3].ends_with(",0.25,2,2,4,0,1,2,21000,9000,3,,2.250"));
        let printed = summary.to_string();
        assert!(
            printed.contains("frames by tier: 0: 1, 1: 1, 2: 1")
                && printed.contains("1 frames under light between")
                && printed.contains("7 without light")
                && printed.contains("pose to photon")
                && printed.contains("3 display frames missed; 3 waits for the GPU")
                && printed.contains("track video: 2 frames, 1500 bytes"),
            "{printed}"
        );
        assert_eq!((summary.frames(), summary.pictures()), (3, 3));
    }

    #[test]
    fn a_full_disk_ends_the_file_and_nothing_else() {
        let mut stats = Stats::open(Some(Path::new("/dev/full")), &[]).unwrap();
        for frame in 0..1_000 {
            stats.presented(&times(frame), &Drawn::default());
        }
        assert_eq!(stats.finish().unwrap().frames(), 1_000);
        let error = Stats::open(Some(Path::new("/nowhere/stats.csv")), &[]).err().unwrap();
        // As the program prints it, with all causes.
        let error = format!("{:#}", anyhow::Error::from(error));
        assert!(error.contains("/nowhere/stats.csv") && error.contains("folder"), "{error}");
        assert_eq!(error.matches("No such file").count(), 1, "{error}");
    }
}
