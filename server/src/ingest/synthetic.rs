//! Pictures that the program renders itself, paced, encoded and handed on like a stream's.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ffmpeg_next::format::Pixel;
use ffmpeg_next::frame;
use mr360_protocol::video::{Colour, StereoLayout};

use super::encode::{Encoding, VideoEncoder};
use super::error::IngestError;
use super::layout::{Layout, Projection, check_size};
use super::pictures::video_info;
use super::queue::Queue;
use super::raw;
use super::shared::{Shared, count};
use super::testcard::TestCard;
use super::{IngestEvent, VideoCodec};
use crate::frame::{Frame, Pixels};
use crate::plaza::{Plaza, PlazaConfig};

/// Names that [`open`] knows.
const KNOWN: &str = "plaza, testcard";
/// Rendered pictures that may wait for light.
const FRAMES_WAITING: usize = 8;

/// A source of equirect mono pictures, the same for the same index.
pub trait FrameSource: Send {
    /// Columns, rows, and frames a second.
    fn info(&self) -> (u32, u32, f64);
    /// Renders picture `index` into `out`, which is YUV420P of the size that [`FrameSource::info`] tells; BT.709, limited range.
    fn frame(&mut self, index: u64, out: &mut frame::Video);
}

/// Parameters of a synthetic source, as in `NAME?size=1280x640&fps=30`.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// Name before the question mark.
    pub name: String,
    /// Columns; even.
    pub width: u32,
    /// Rows; even.
    pub height: u32,
    /// Frames a second, in [1, 120].
    pub frame_rate: f64,
}

impl Parameters {
    fn parse(text: &str) -> Result<Self, IngestError> {
        let (name, query) = text.split_once('?').unwrap_or((text, ""));
        let bad = |detail: String| IngestError::BadSynthetic { name: name.to_owned(), detail };
        let mut parameters = Self { name: name.to_owned(), width: 1280, height: 640, frame_rate: 30.0 };
        for pair in query.split('&').filter(|pair| !pair.is_empty()) {
            match pair.split_once('=') {
                Some(("size", size)) => {
                    let numbers = size.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
                    (parameters.width, parameters.height) = numbers.ok_or_else(|| bad(format!("size {size} is not WIDTHxHEIGHT")))?;
                }
                Some(("fps", rate)) => {
                    let number = rate.parse().ok().filter(|rate| (1.0..=120.0).contains(rate));
                    parameters.frame_rate = number.ok_or_else(|| bad(format!("fps {rate} is not 1 to 120")))?;
                }
                _ => return Err(bad(format!("parameter {pair} is not known"))),
            }
        }
        check_size(&format!("synthetic:{name}"), parameters.width, parameters.height)?;
        if !parameters.width.is_multiple_of(2) || !parameters.height.is_multiple_of(2) {
            return Err(bad(format!("size {}x{} is odd", parameters.width, parameters.height)));
        }
        Ok(parameters)
    }
}

/// The source of that name.
///
/// # Errors
/// [`IngestError::UnknownSynthetic`] for any other name.
pub fn open(parameters: &Parameters) -> Result<Box<dyn FrameSource>, IngestError> {
    match parameters.name.as_str() {
        "testcard" => Ok(Box::new(TestCard::new(parameters))),
        other => Err(IngestError::UnknownSynthetic { name: other.to_owned(), known: KNOWN.to_owned() }),
    }
}

/// The source that the user names after `synthetic:`.
pub(super) fn parse(text: &str) -> Result<Box<dyn FrameSource>, IngestError> {
    let (name, query) = text.split_once('?').unwrap_or((text, ""));
    if name == "plaza" {
        return plaza(query);
    }
    open(&Parameters::parse(text)?)
}

/// Rendering the place takes seconds at large sizes, so each tenth of it is logged.
fn plaza(query: &str) -> Result<Box<dyn FrameSource>, IngestError> {
    let bad = |error: crate::plaza::PlazaError| IngestError::BadSynthetic { name: "plaza".to_owned(), detail: error.to_string() };
    let config = PlazaConfig::from_query(query).map_err(bad)?;
    let mut tenths = 0;
    let progress = |done: f32| {
        let now = (done * 10.0) as u32;
        if now > tenths {
            tenths = now;
            tracing::info!("rendering the plaza: {} %", now * 10);
        }
    };
    Ok(Box::new(Plaza::new(config, progress).map_err(bad)?))
}

impl FrameSource for Plaza {
    fn info(&self) -> (u32, u32, f64) {
        let config = self.config();
        (config.width, config.height, config.fps)
    }

    fn frame(&mut self, index: u64, out: &mut frame::Video) {
        let [y_stride, u_stride, v_stride] = [0, 1, 2].map(|plane| out.stride(plane));
        let [y, u, v] = raw::planes_mut(out);
        self.yuv420(index, y, y_stride, u, u_stride, v, v_stride);
    }
}

/// Renders one picture.
pub(super) fn render(source: &mut dyn FrameSource, index: u64) -> frame::Video {
    let (width, height, _) = source.info();
    let mut picture = frame::Video::new(Pixel::YUV420P, width, height);
    source.frame(index, &mut picture);
    picture
}

/// Runs the source until stopped: one picture every 1/rate, none for moments that were missed.
pub(super) fn run(shared: &Arc<Shared>, mut source: Box<dyn FrameSource>) -> Result<(), IngestError> {
    let (width, height, frame_rate) = source.info();
    let encoding = Encoding { width, height, pixel: Pixel::YUV420P, colour: Colour::default(), frame_rate };
    debug_assert_eq!(encoding.codec(), VideoCodec::H264);
    let mut encoder = VideoEncoder::new(&encoding).map_err(|error| encoding.error(&shared.name, error))?;
    let layout = Layout { stereo: StereoLayout::Mono, projection: Projection::Equirect };
    shared.announce(video_info(&encoding, layout, None), None);
    let frames = Arc::new(Queue::<(Frame, mr360_protocol::clock::ServerTime)>::new(FRAMES_WAITING));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while let Some((frame, rendered)) = frames.pop() {
                shared.sink.event(IngestEvent::Frame(frame, rendered));
            }
        });
        let result = render_loop(shared, source.as_mut(), &mut encoder, &frames).map_err(|error| encoding.error(&shared.name, error));
        frames.abandon();
        result
    })
}

fn render_loop(
    shared: &Shared,
    source: &mut dyn FrameSource,
    encoder: &mut VideoEncoder,
    frames: &Queue<(Frame, mr360_protocol::clock::ServerTime)>,
) -> Result<(), ffmpeg_next::Error> {
    let rate = source.info().2;
    let start = Instant::now();
    let start_us = i64::try_from(shared.clock.now().0).unwrap_or(0);
    let mut index = 0u64;
    while !shared.watch.sleep_until(start + Duration::from_secs_f64(index as f64 / rate)) {
        let ingested = shared.clock.now();
        let mut picture = render(source, index);
        let pts_us = start_us + (index as f64 * 1_000_000.0 / rate) as i64;
        picture.set_pts(Some(pts_us));
        for coded in encoder.encode(&mut picture)? {
            shared.send_coded(coded, ingested);
        }
        let frame = Frame {
            pts_us: u64::try_from(pts_us).unwrap_or(0),
            stereo: StereoLayout::Mono,
            pixels: Pixels::Video(picture, Colour::default()),
        };
        if !frames.try_push((frame, shared.clock.now())) {
            count(&shared.counters.frames_without_light);
        }
        // The picture that is due now, if rendering took longer than there was time.
        index = (index + 1).max((start.elapsed().as_secs_f64() * rate) as u64);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_plaza_is_drawn_into_the_picture_itself() {
        let mut plaza = Plaza::new(PlazaConfig::from_query("size=72x36&fps=30").unwrap(), |_| {}).unwrap();
        let picture = render(&mut plaza, 3);
        let [mut y, mut u, mut v] = [vec![0; 72 * 36], vec![0; 36 * 18], vec![0; 36 * 18]];
        plaza.yuv420(3, &mut y, 72, &mut u, 36, &mut v, 36);
        for (plane, (samples, width)) in [(y, 72), (u, 36), (v, 36)].into_iter().enumerate() {
            // Rows of a picture are padded.
            let rows = picture.data(plane).chunks(picture.stride(plane));
            assert!(rows.map(|row| &row[..width]).eq(samples.chunks(width)), "plane {plane}");
        }
    }

    #[test]
    fn parameters_and_their_errors() {
        let parameters = Parameters::parse("testcard?size=256x128&fps=25").unwrap();
        assert_eq!((parameters.width, parameters.height, parameters.frame_rate), (256, 128, 25.0));
        assert_eq!(Parameters::parse("x").unwrap().width, 1280);
        for text in ["t?size=2", "t?size=1x1", "t?size=33x16", "t?size=99999x4", "t?fps=0", "t?fps=nan", "t?colour=red"] {
            assert!(Parameters::parse(text).is_err(), "{text}");
        }
        assert!(matches!(parse("nowhere"), Err(IngestError::UnknownSynthetic { .. })));
    }
}
