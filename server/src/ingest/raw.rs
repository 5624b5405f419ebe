//! Everything of FFmpeg's C interface that ffmpeg-next has no safe call for.
#![expect(unsafe_code, reason = "fields of AVCodecParameters, bitstream filters and parsers have no safe wrapper in ffmpeg-next")]

use std::ffi::CStr;
use std::ptr::{self, NonNull};

use ffmpeg_next::codec::packet::Mut;
use ffmpeg_next::codec::{Context, Id, Parameters};
use ffmpeg_next::ffi;
use ffmpeg_next::format::Pixel;
use ffmpeg_next::{Error, Packet, Rational, color, frame};

use super::colour::Tags;

/// What the demuxer knows of a video stream.
#[derive(Debug, Clone)]
pub(super) struct VideoParameters {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) sample_aspect: Rational,
    /// Frames that the decoder holds back to put pictures in order.
    pub(super) reorder: i32,
    pub(super) pixel: Pixel,
    pub(super) primaries: color::Primaries,
    pub(super) transfer: color::TransferCharacteristic,
    pub(super) matrix: color::Space,
    pub(super) range: color::Range,
}

/// What the demuxer knows of an audio stream.
#[derive(Debug, Clone)]
pub(super) struct AudioParameters {
    pub(super) sample_rate: u32,
    pub(super) channels: u32,
    pub(super) profile: i32,
}

pub(super) fn video_parameters(parameters: &Parameters) -> VideoParameters {
    // SAFETY: `parameters` owns a valid AVCodecParameters for as long as the reference lives; the colour fields of a
    // demuxed stream are values of their enumerations. `format` is -1 or a pixel format for video.
    let raw = unsafe { &*parameters.as_ptr() };
    let pixel = if raw.format < 0 {
        Pixel::None
    } else {
        // SAFETY: as above; this is the conversion that FFmpeg's own C code makes.
        Pixel::from(unsafe { std::mem::transmute::<i32, ffi::AVPixelFormat>(raw.format) })
    };
    VideoParameters {
        width: u32::try_from(raw.width).unwrap_or(0),
        height: u32::try_from(raw.height).unwrap_or(0),
        sample_aspect: raw.sample_aspect_ratio.into(),
        reorder: raw.video_delay,
        pixel,
        primaries: raw.color_primaries.into(),
        transfer: raw.color_trc.into(),
        matrix: raw.color_space.into(),
        range: raw.color_range.into(),
    }
}

pub(super) fn audio_parameters(parameters: &Parameters) -> AudioParameters {
    // SAFETY: as in `video_parameters`.
    let raw = unsafe { &*parameters.as_ptr() };
    AudioParameters {
        sample_rate: u32::try_from(raw.sample_rate).unwrap_or(0),
        channels: u32::try_from(raw.channels).unwrap_or(0),
        profile: raw.profile,
    }
}

/// The codec's out-of-band headers, empty if there are none.
pub(super) fn extradata(parameters: &Parameters) -> &[u8] {
    // SAFETY: extradata is null or points to extradata_size bytes that live as long as the parameters.
    unsafe {
        let raw = &*parameters.as_ptr();
        slice(raw.extradata, raw.extradata_size)
    }
}

/// The headers that an encoder made, empty if there are none.
pub(super) fn encoder_extradata(context: &Context) -> &[u8] {
    // SAFETY: extradata is null or points to extradata_size bytes that live as long as the context.
    unsafe {
        let raw = &*context.as_ptr();
        slice(raw.extradata, raw.extradata_size)
    }
}

/// # Safety
/// `data` is null or points to `size` bytes that live for `'a`.
unsafe fn slice<'a>(data: *const u8, size: i32) -> &'a [u8] {
    match usize::try_from(size) {
        // SAFETY: by this function's own contract.
        Ok(size) if size > 0 && !data.is_null() => unsafe { std::slice::from_raw_parts(data, size) },
        _ => &[],
    }
}

/// Writes colour tags into an encoder that is not open yet.
pub(super) fn tag_encoder(context: &mut Context, tags: &Tags) {
    // SAFETY: the context is valid and not open, so plain fields may be set.
    unsafe {
        let raw = &mut *context.as_mut_ptr();
        raw.color_primaries = tags.primaries.into();
        raw.color_trc = tags.transfer.into();
        raw.colorspace = tags.matrix.into();
        raw.color_range = tags.range.into();
    }
}

/// Whether every access unit may lean on threads inside the picture only.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Threads {
    /// No added latency.
    Slices,
    /// Adds one frame of latency for each thread after the first.
    Frames(i32),
}

/// Sets up threads and delay of a decoder that is not open yet.
pub(super) fn prepare_decoder(context: &mut Context, id: Id, threads: Threads) {
    // SAFETY: the context is valid and not open, so plain fields may be set.
    unsafe {
        let raw = &mut *context.as_mut_ptr();
        match threads {
            Threads::Slices => {
                raw.thread_type = ffi::FF_THREAD_SLICE;
                raw.thread_count = 0;
            }
            Threads::Frames(count) => {
                raw.thread_type = ffi::FF_THREAD_FRAME;
                raw.thread_count = count;
            }
        }
        // dav1d holds frames back for its threads unless told otherwise. FFmpeg's own decoders would stop reordering.
        if id == Id::AV1 && threads == Threads::Slices {
            raw.flags |= ffi::AV_CODEC_FLAG_LOW_DELAY as i32;
        }
        raw.pkt_timebase = ffi::AVRational { num: 1, den: 1_000_000 };
    }
}

/// The three planes of a planar picture at once, rows at the picture's strides; empty where the picture has no such plane.
pub(super) fn planes_mut(picture: &mut frame::Video) -> [&mut [u8]; 3] {
    let count = picture.planes();
    let places = [0, 1, 2].map(|plane| {
        let data = if plane < count { picture.data_mut(plane) } else { &mut [] };
        (data.as_mut_ptr(), data.len())
    });
    // SAFETY: each place is a valid slice that the picture lends for the lifetime of the result, or empty; planes of one picture do not overlap.
    places.map(|(start, length)| unsafe { std::slice::from_raw_parts_mut(start, length) })
}

/// A bitstream filter such as `h264_mp4toannexb`.
pub(super) struct BitstreamFilter(NonNull<ffi::AVBSFContext>);

// SAFETY: the context is owned by this value alone and holds no thread-local state.
unsafe impl Send for BitstreamFilter {}

impl BitstreamFilter {
    pub(super) fn new(name: &CStr, parameters: &Parameters) -> Result<Self, Error> {
        let mut context = ptr::null_mut();
        // SAFETY: `name` is NUL-terminated; the context is checked before use and freed by Drop on every later failure.
        unsafe {
            let filter = ffi::av_bsf_get_by_name(name.as_ptr());
            if filter.is_null() {
                return Err(Error::BsfNotFound);
            }
            check(ffi::av_bsf_alloc(filter, &raw mut context))?;
            let this = Self(NonNull::new(context).ok_or(Error::Unknown)?);
            check(ffi::avcodec_parameters_copy((*context).par_in, parameters.as_ptr()))?;
            check(ffi::av_bsf_init(context))?;
            Ok(this)
        }
    }

    /// Filters one packet; these filters give one packet for each.
    pub(super) fn filter(&mut self, packet: &mut Packet) -> Result<Option<Packet>, Error> {
        let mut out = Packet::empty();
        // SAFETY: both packets are valid; on success the filter takes over the input's buffer and leaves it blank.
        unsafe {
            let sent = ffi::av_bsf_send_packet(self.0.as_ptr(), packet.as_mut_ptr());
            if sent < 0 {
                ffi::av_bsf_flush(self.0.as_ptr());
                return Err(Error::from(sent));
            }
            match Error::from(ffi::av_bsf_receive_packet(self.0.as_ptr(), out.as_mut_ptr())) {
                Error::Other { errno: 0 } => Ok(Some(out)),
                Error::Other { errno } if errno == ffmpeg_next::error::EAGAIN => Ok(None),
                error => Err(error),
            }
        }
    }

    /// Out-of-band headers in the filter's output form.
    pub(super) fn headers(&self) -> &[u8] {
        // SAFETY: par_out is set by av_bsf_init and lives as long as the context.
        unsafe {
            let out = &*(*self.0.as_ptr()).par_out;
            slice(out.extradata, out.extradata_size)
        }
    }
}

impl Drop for BitstreamFilter {
    fn drop(&mut self) {
        let mut context = self.0.as_ptr();
        // SAFETY: the context is owned and not used after.
        unsafe { ffi::av_bsf_free(&raw mut context) };
    }
}

/// Reads the picture's format out of an access unit that carries its headers.
pub(super) struct HeaderParser {
    parser: NonNull<ffi::AVCodecParserContext>,
    context: Context,
}

// SAFETY: the parser is owned by this value alone and holds no thread-local state.
unsafe impl Send for HeaderParser {}

impl HeaderParser {
    pub(super) fn new(id: Id) -> Option<Self> {
        // SAFETY: a null return is checked; the fields set are plain flags.
        unsafe {
            let mut parser = NonNull::new(ffi::av_parser_init(ffi::AVCodecID::from(id) as i32))?;
            parser.as_mut().flags |= ffi::PARSER_FLAG_COMPLETE_FRAMES;
            let mut context = Context::new();
            (*context.as_mut_ptr()).codec_id = id.into();
            (*context.as_mut_ptr()).codec_type = ffi::AVMediaType::AVMEDIA_TYPE_VIDEO;
            Some(Self { parser, context })
        }
    }

    /// Width, height and pixel format code, if the access unit tells.
    pub(super) fn format(&mut self, packet: &Packet) -> Option<(u32, u32, i32)> {
        let data = packet.data()?;
        let size = i32::try_from(data.len()).ok()?;
        let (mut out, mut out_size) = (ptr::null_mut(), 0);
        // SAFETY: a packet's buffer is padded as the parser asks; `out` points into it or the parser and is not used.
        unsafe {
            ffi::av_parser_parse2(
                self.parser.as_ptr(),
                self.context.as_mut_ptr(),
                &raw mut out,
                &raw mut out_size,
                data.as_ptr(),
                size,
                ffi::AV_NOPTS_VALUE,
                ffi::AV_NOPTS_VALUE,
                0,
            );
            let parser = self.parser.as_ref();
            let (width, height) = (u32::try_from(parser.width).ok()?, u32::try_from(parser.height).ok()?);
            (width > 0 && height > 0).then_some((width, height, parser.format))
        }
    }
}

impl Drop for HeaderParser {
    fn drop(&mut self) {
        // SAFETY: the parser is owned and not used after.
        unsafe { ffi::av_parser_close(self.parser.as_ptr()) };
    }
}

fn check(code: i32) -> Result<(), Error> {
    if code < 0 { Err(Error::from(code)) } else { Ok(()) }
}
