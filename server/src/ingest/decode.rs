//! Decoding video packets, whatever state they are in.

use ffmpeg_next::codec::{Context, Id, Parameters};
use ffmpeg_next::{Error, Packet, decoder, frame};

use super::error::IngestError;
use super::raw::{self, Threads};

/// Pictures above this size are decoded by several threads each on a frame of its own, which costs two frames of latency. Up to
/// it only slices are decoded side by side, which costs none: one core decodes 3840×2160 in real time.
const SLICES_UP_TO: u64 = 3840 * 2160;

/// A video decoder.
pub(super) struct VideoDecoder {
    decoder: decoder::Video,
}

impl VideoDecoder {
    /// Timestamps of packets and frames are in microseconds.
    pub(super) fn new(input: &str, parameters: &Parameters) -> Result<Self, IngestError> {
        let id: Id = parameters.id();
        let unsupported = |error: Error| IngestError::UnsupportedCodec { input: input.to_owned(), codec: format!("{id:?} ({error})") };
        let mut context = Context::from_parameters(parameters.clone()).map_err(unsupported)?;
        let shape = raw::video_parameters(parameters);
        let pixels = u64::from(shape.width) * u64::from(shape.height);
        raw::prepare_decoder(&mut context, id, if pixels <= SLICES_UP_TO { Threads::Slices } else { Threads::Frames(3) });
        let decoder = context.decoder().video().map_err(unsupported)?;
        Ok(Self { decoder })
    }

    /// Takes one packet; an error means that it was refused and the next may go well again.
    pub(super) fn send(&mut self, packet: &Packet) -> Result<(), Error> {
        // Without payload FFmpeg takes a packet for the end of the stream.
        if packet.size() == 0 { Ok(()) } else { self.decoder.send_packet(packet) }
    }

    /// The next picture in presentation order, `None` when more packets are needed. Frames that the decoder knows to be broken come with an error.
    pub(super) fn receive(&mut self) -> Result<Option<frame::Video>, Error> {
        let mut frame = frame::Video::empty();
        match self.decoder.receive_frame(&mut frame) {
            Ok(()) => Ok(Some(frame)),
            Err(Error::Eof) => Ok(None),
            Err(Error::Other { errno }) if errno == ffmpeg_next::error::EAGAIN => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// No more packets: what is held back comes out.
    pub(super) fn drain(&mut self) {
        // The only failure is having been told before.
        let _ = self.decoder.send_eof();
    }

    /// Ready for packets from elsewhere.
    pub(super) fn restart(&mut self) {
        self.decoder.flush();
    }
}
