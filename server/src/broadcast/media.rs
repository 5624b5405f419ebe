//! Video and audio tracks in hang's container, described in the catalog.

use std::time::Duration;

use moq_mux::import::{AudioFormat, AudioInit, Track, VideoFormat, VideoInit};
use moq_net::Timestamp;
use mr360_protocol::track;

use super::Catalog;
use crate::ingest::{AccessUnit, AudioCodec, AudioInfo, AudioPacket, VideoCodec, VideoInfo};

/// An audio group runs this long: short enough to join, long enough not to open a stream for every packet.
const AUDIO_GROUP: Duration = Duration::from_millis(500);

/// Why media were not published.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MediaError {
    /// Its format was not understood when it started, or never started.
    #[error("there is no {0} track: its format could not be started")]
    NoTrack(&'static str),
    /// What the codec or the transport says.
    #[error(transparent)]
    Refused(#[from] moq_mux::Error),
    /// What the transport says.
    #[error(transparent)]
    Transport(#[from] moq_net::Error),
}

/// The media of the source that is on air; none until [`MediaTracks::start`].
pub struct MediaTracks {
    broadcast: moq_net::broadcast::Producer,
    catalog: Catalog,
    /// Counts starts: a track's name is used once, so that viewers never read two formats from one track.
    started: u64,
    video: Option<Track>,
    audio: Option<Audio>,
}

struct Audio {
    track: Track,
    group_start_us: Option<u64>,
}

impl MediaTracks {
    pub(super) fn new(broadcast: moq_net::broadcast::Producer, catalog: Catalog) -> Self {
        Self { broadcast, catalog, started: 0, video: None, audio: None }
    }

    /// Ends the tracks on air, if any, and opens tracks for these formats.
    ///
    /// # Errors
    /// When a codec's description is not understood or a track cannot be created. Nothing is on air then.
    pub fn start(&mut self, video: &VideoInfo, audio: Option<&AudioInfo>) -> Result<(), MediaError> {
        let started = self.open(video, audio);
        if started.is_err() {
            self.finish();
        }
        started
    }

    fn open(&mut self, video: &VideoInfo, audio: Option<&AudioInfo>) -> Result<(), MediaError> {
        self.finish();
        let name = |base: &str| if self.started == 0 { base.to_owned() } else { format!("{base}-{}", self.started + 1) };
        let (video_name, audio_name) = (name(track::VIDEO), name(track::AUDIO));
        self.started += 1;
        self.catalog.mutate(|catalog| {
            if let Some(section) = &mut catalog.ext.mr360 {
                section.video = Some(video_name.clone());
                section.stereo = video.stereo;
                section.colour = video.colour;
            }
        })?;
        let mut init = VideoInit::new(video_format(video.codec), bytes::Bytes::new());
        init.hint.coded_width = Some(video.width);
        init.hint.coded_height = Some(video.height);
        init.hint.framerate = Some(video.frame_rate);
        init.hint.optimize_for_latency = Some(true);
        self.video = Some(Track::video(self.broadcast.reserve_track(video_name)?, self.catalog.reserve(), init)?);
        if let Some(audio) = audio {
            let init = AudioInit::new(audio_format(audio.codec), audio.description.clone());
            let opened = Track::audio(self.broadcast.reserve_track(audio_name)?, self.catalog.reserve(), init)?;
            self.audio = Some(Audio { track: opened, group_start_us: None });
        }
        Ok(())
    }

    /// Publishes one access unit; a keyframe starts a group.
    ///
    /// # Errors
    /// When the unit is not what the codec asks for; the next may succeed. [`MediaError::NoTrack`] until a start succeeds.
    pub fn video(&mut self, unit: &AccessUnit) -> Result<(), MediaError> {
        let video = self.video.as_mut().ok_or(MediaError::NoTrack(track::VIDEO))?;
        Ok(video.decode(unit.data.clone(), Some(timestamp(unit.pts_us)?))?)
    }

    /// Publishes one audio packet.
    ///
    /// # Errors
    /// When the packet is not what the codec asks for; the next may succeed. [`MediaError::NoTrack`] until a start succeeds.
    pub fn audio(&mut self, packet: &AudioPacket) -> Result<(), MediaError> {
        let audio = self.audio.as_mut().ok_or(MediaError::NoTrack(track::AUDIO))?;
        let pts = timestamp(packet.pts_us)?;
        let start_us = *audio.group_start_us.get_or_insert(packet.pts_us);
        if packet.pts_us.saturating_sub(start_us) >= AUDIO_GROUP.as_micros() as u64 {
            audio.track.cut(Some(pts))?;
            audio.group_start_us = Some(packet.pts_us);
        }
        Ok(audio.track.decode(packet.data.clone(), Some(pts))?)
    }

    /// Ends the tracks on air. Their renditions leave the catalog.
    pub fn finish(&mut self) {
        for mut track in self.video.take().into_iter().chain(self.audio.take().map(|audio| audio.track)) {
            if let Err(error) = track.finish() {
                tracing::debug!(%error, "a media track did not end cleanly");
            }
        }
    }
}

fn timestamp(pts_us: u64) -> Result<Timestamp, moq_mux::Error> {
    Timestamp::from_micros(pts_us).map_err(|_| moq_net::Error::from(moq_net::BoundsExceeded).into())
}

fn video_format(codec: VideoCodec) -> VideoFormat {
    match codec {
        VideoCodec::H264 => VideoFormat::Avc3,
        VideoCodec::Hevc => VideoFormat::Hev1,
        VideoCodec::Av1 => VideoFormat::Av01,
    }
}

fn audio_format(codec: AudioCodec) -> AudioFormat {
    match codec {
        AudioCodec::Aac => AudioFormat::Aac,
        AudioCodec::Opus => AudioFormat::Opus,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::broadcast::Broadcast;
    use bytes::Bytes;
    use mr360_protocol::clock::ServerTime;
    use mr360_protocol::transport;

    #[tokio::test]
    async fn media_without_a_track_are_errors_and_a_failed_start_leaves_none() {
        let origin = transport::origin();
        let broadcast = Broadcast::create(&origin, "live", "none").unwrap();
        let mut media = broadcast.media();
        let unit = AccessUnit { pts_us: 0, keyframe: true, data: Bytes::from_static(&[0, 0, 0, 1, 0x65]), ingested: ServerTime(0) };
        let packet = AudioPacket { pts_us: 0, data: Bytes::from_static(&[1, 2, 3]) };
        assert!(matches!(media.video(&unit), Err(MediaError::NoTrack("video"))));
        assert!(matches!(media.audio(&packet), Err(MediaError::NoTrack("audio"))));
        let video = VideoInfo::small();
        // An AudioSpecificConfig has two bytes at least.
        let audio = AudioInfo { codec: AudioCodec::Aac, sample_rate: 44_100, channels: 2, description: Bytes::from_static(&[0]) };
        media.start(&video, Some(&audio)).unwrap_err();
        assert!(matches!(media.video(&unit), Err(MediaError::NoTrack("video"))));
    }
}
