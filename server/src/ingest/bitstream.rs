//! Access units as they are broadcast: Annex B with inline parameter sets at keyframes, or AV1 temporal units with
//! their sequence header.

use bytes::{Bytes, BytesMut};
use ffmpeg_next::codec::Parameters;
use ffmpeg_next::{Error, Packet};

use super::VideoCodec;
use super::raw::{BitstreamFilter, HeaderParser, extradata};

/// Turns a demuxer's packets into access units.
pub(super) struct AccessUnits {
    codec: VideoCodec,
    filter: Option<BitstreamFilter>,
    /// Parameter sets or sequence header, in the form of the access units.
    headers: Bytes,
    parser: Option<HeaderParser>,
}

/// An access unit, and its format where it is a keyframe and tells.
pub(super) struct Unit {
    pub(super) data: Bytes,
    pub(super) format: Option<(u32, u32, i32)>,
}

impl AccessUnits {
    pub(super) fn new(codec: VideoCodec, parameters: &Parameters) -> Result<Self, Error> {
        let filter = match codec {
            VideoCodec::H264 => Some(BitstreamFilter::new(c"h264_mp4toannexb", parameters)?),
            VideoCodec::Hevc => Some(BitstreamFilter::new(c"hevc_mp4toannexb", parameters)?),
            VideoCodec::Av1 => None,
        };
        let headers = match &filter {
            Some(filter) => Bytes::copy_from_slice(filter.headers()),
            None => Bytes::copy_from_slice(sequence_header(extradata(parameters))),
        };
        Ok(Self { codec, filter, headers, parser: HeaderParser::new(parameters.id()) })
    }

    /// One packet's access unit; the packet is used up.
    pub(super) fn convert(&mut self, packet: &mut Packet) -> Result<Option<Unit>, Error> {
        let keyframe = packet.is_key();
        let filtered = match &mut self.filter {
            Some(filter) => match filter.filter(packet)? {
                Some(filtered) => filtered,
                None => return Ok(None),
            },
            None => std::mem::replace(packet, Packet::empty()),
        };
        let Some(data) = filtered.data().filter(|data| !data.is_empty()) else { return Ok(None) };
        let missing = keyframe && !self.headers.is_empty() && !carries_headers(self.codec, data);
        let data = if missing {
            let mut joined = BytesMut::with_capacity(self.headers.len() + data.len());
            joined.extend_from_slice(&self.headers);
            joined.extend_from_slice(data);
            joined.freeze()
        } else {
            Bytes::copy_from_slice(data)
        };
        // Without inline headers the parser would read what it does not know the format of.
        let format = if keyframe && !missing { self.parser.as_mut().and_then(|parser| parser.format(&filtered)) } else { None };
        Ok(Some(Unit { data, format }))
    }
}

/// The OBUs behind the four bytes of an AV1CodecConfigurationRecord, or all of it where there is no record.
fn sequence_header(extradata: &[u8]) -> &[u8] {
    match extradata {
        [0x81, _, _, _, obus @ ..] => obus,
        other => other,
    }
}

fn carries_headers(codec: VideoCodec, data: &[u8]) -> bool {
    match codec {
        VideoCodec::H264 => nal_headers(data).any(|header| header & 0x1f == 7),
        VideoCodec::Hevc => nal_headers(data).any(|header| header >> 1 & 0x3f == 33),
        VideoCodec::Av1 => obu_types(data).any(|kind| kind == 1),
    }
}

/// First byte of every NAL unit of an Annex B access unit.
fn nal_headers(data: &[u8]) -> impl Iterator<Item = u8> {
    data.windows(4).filter(|window| window[..3] == [0, 0, 1]).map(|window| window[3])
}

/// Types of the OBUs of a temporal unit, up to the first that cannot be read (AV1 specification, 5.3).
fn obu_types(mut data: &[u8]) -> impl Iterator<Item = u8> {
    std::iter::from_fn(move || {
        let (&header, rest) = data.split_first()?;
        let rest = rest.get(usize::from(header >> 2 & 1)..)?;
        let (size, rest) = if header & 2 != 0 { leb128(rest)? } else { (rest.len(), rest) };
        data = rest.get(size..)?;
        Some(header >> 3 & 0xf)
    })
}

fn leb128(data: &[u8]) -> Option<(usize, &[u8])> {
    let mut value = 0u64;
    for (index, &byte) in data.iter().enumerate().take(8) {
        value |= u64::from(byte & 0x7f) << (7 * index);
        if byte & 0x80 == 0 {
            return Some((usize::try_from(value).ok()?, data.get(index + 1..)?));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameter_sets_are_found() {
        assert!(carries_headers(VideoCodec::H264, &[0, 0, 0, 1, 9, 16, 0, 0, 1, 0x67, 1, 2]));
        assert!(!carries_headers(VideoCodec::H264, &[0, 0, 0, 1, 0x65, 16, 0x67]));
        assert!(carries_headers(VideoCodec::Hevc, &[0, 0, 1, 0x40, 1, 0, 0, 1, 0x42, 1]));
        assert!(!carries_headers(VideoCodec::Hevc, &[]));
    }

    #[test]
    fn sequence_header_is_found_and_damage_is_survived() {
        let unit = [0x12, 0, 0x0a, 2, 9, 9, 0x32, 1, 7];
        assert_eq!(obu_types(&unit).collect::<Vec<_>>(), [2, 1, 6]);
        assert!(carries_headers(VideoCodec::Av1, &unit) && !carries_headers(VideoCodec::Av1, &unit[6..]));
        assert_eq!(obu_types(&[0x0a, 0xff, 0xff]).count(), 0);
        assert_eq!(sequence_header(&[0x81, 0, 0, 0, 0x0a, 1]), [0x0a, 1]);
    }
}
