//! Bringing decoded pictures to the projection, size and pixel format that are needed, with libavfilter.

use ffmpeg_next::filter::{self, Graph};
use ffmpeg_next::format::Pixel;
use ffmpeg_next::{Error, frame};
use mr360_protocol::video::StereoLayout;

use super::colour::is_rgb;
use super::layout::{Layout, Projection};

/// What pictures are brought to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Target {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) pixel: Pixel,
    pub(super) layout: Layout,
}

/// Reforms pictures; the filters are built anew when the pictures change.
#[derive(Default)]
pub(super) struct Reform {
    built: Option<(Shape, Target, Graph)>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Shape {
    width: u32,
    height: u32,
    pixel: Pixel,
}

impl Reform {
    /// The picture as `target` says, with its timestamp and tags; itself where it is so already.
    pub(super) fn run(&mut self, picture: frame::Video, target: Target) -> Result<frame::Video, Error> {
        let shape = Shape { width: picture.width(), height: picture.height(), pixel: picture.format() };
        let same = target.layout.projection == Projection::Equirect;
        if same && shape == (Shape { width: target.width, height: target.height, pixel: target.pixel }) {
            return Ok(picture);
        }
        if !self.built.as_ref().is_some_and(|(from, to, _)| *from == shape && *to == target) {
            self.built = Some((shape, target, build(shape, target)?));
        }
        let (_, _, graph) = self.built.as_mut().ok_or(Error::Bug)?;
        let mut out = frame::Video::empty();
        graph.get("in").ok_or(Error::FilterNotFound)?.source().add(&picture)?;
        graph.get("out").ok_or(Error::FilterNotFound)?.sink().frame(&mut out)?;
        Ok(out)
    }
}

fn build(shape: Shape, target: Target) -> Result<Graph, Error> {
    let name = |pixel: Pixel| pixel.descriptor().map(|descriptor| descriptor.name()).ok_or(Error::InvalidData);
    let mut graph = Graph::new();
    let source = filter::find("buffer").ok_or(Error::FilterNotFound)?;
    let sink = filter::find("buffersink").ok_or(Error::FilterNotFound)?;
    let arguments =
        format!("video_size={}x{}:pix_fmt={}:time_base=1/1000000:pixel_aspect=1/1", shape.width, shape.height, name(shape.pixel)?);
    graph.add(&source, "in", &arguments)?;
    graph.add(&sink, "out", "")?;
    let target_name = name(target.pixel)?;
    let Target { width, height, .. } = target;
    let matrix = if is_rgb(shape.pixel) { ":out_color_matrix=bt709:out_range=tv" } else { "" };
    let convert = format!("scale=w={width}:h={height}:flags=area{matrix},format=pix_fmts={target_name}");
    let chain = match v360(target.layout) {
        // Faces are resampled in the target's pixel format, at the target's size.
        Some(input) => {
            let stereo = stereo(target.layout.stereo);
            let to_yuv = format!("scale=flags=area{matrix},format=pix_fmts={target_name}");
            format!("{to_yuv},v360={input}:output=e:w={width}:h={height}:in_stereo={stereo}:out_stereo={stereo},{convert}")
        }
        None => convert,
    };
    graph.output("in", 0)?.input("out", 0)?.parse(&chain)?;
    graph.validate()?;
    Ok(graph)
}

fn v360(layout: Layout) -> Option<String> {
    match layout.projection {
        Projection::Equirect => None,
        Projection::Cubemap => Some("input=c3x2".to_owned()),
        Projection::Eac => Some("input=eac".to_owned()),
        // The filter takes the left circle for the one at the back.
        Projection::DualFisheye { fov_deg } => Some(format!("input=dfisheye:ih_fov={fov_deg}:iv_fov={fov_deg}:yaw=180")),
    }
}

fn stereo(stereo: StereoLayout) -> &'static str {
    match stereo {
        StereoLayout::Mono => "2d",
        StereoLayout::TopBottom => "tb",
        StereoLayout::SideBySide => "sbs",
    }
}

/// Size of the broadcast picture: equirect at the resolution of the source's faces, no wider than `max_width`, and even.
pub(super) fn broadcast_size(layout: Layout, width: u32, height: u32, max_width: Option<u32>) -> (u32, u32) {
    let (eye_width, eye_height) = layout.stereo.eye_size(width, height);
    let (eye_width, eye_height) = match layout.projection {
        Projection::Equirect => (eye_width, eye_height),
        // Three faces across, of 90° each.
        Projection::Cubemap | Projection::Eac => (eye_width / 3 * 4, eye_width / 3 * 2),
        // Each circle spans 180° or more across half the width.
        Projection::DualFisheye { .. } => (eye_width, eye_width / 2),
    };
    let (mut wide, mut high) = match layout.stereo {
        StereoLayout::Mono => (eye_width, eye_height),
        StereoLayout::TopBottom => (eye_width, eye_height * 2),
        StereoLayout::SideBySide => (eye_width * 2, eye_height),
    };
    let limit = max_width.unwrap_or(super::layout::MAX_SIDE).clamp(super::layout::MIN_WIDTH, super::layout::MAX_SIDE);
    if wide > limit {
        high = u32::try_from(u64::from(high) * u64::from(limit) / u64::from(wide)).unwrap_or(high);
        wide = limit;
    }
    // Chroma and both eyes fall on whole samples.
    let (across, down) = match layout.stereo {
        StereoLayout::Mono => (2, 2),
        StereoLayout::TopBottom => (2, 4),
        StereoLayout::SideBySide => (4, 2),
    };
    ((wide / across * across).max(super::layout::MIN_WIDTH), (high / down * down).max(super::layout::MIN_HEIGHT))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(projection: Projection, stereo: StereoLayout) -> Layout {
        Layout { stereo, projection }
    }

    #[test]
    fn broadcast_sizes() {
        let mono = |projection| layout(projection, StereoLayout::Mono);
        assert_eq!(broadcast_size(mono(Projection::Equirect), 1920, 1080, None), (1920, 1080));
        assert_eq!(broadcast_size(mono(Projection::Equirect), 1921, 961, None), (1920, 960));
        assert_eq!(broadcast_size(mono(Projection::Equirect), 3840, 1920, Some(1280)), (1280, 640));
        assert_eq!(broadcast_size(mono(Projection::Eac), 3840, 2560, None), (5120, 2560));
        assert_eq!(broadcast_size(mono(Projection::DualFisheye { fov_deg: 190.0 }), 3840, 1920, None), (3840, 1920));
        assert_eq!(broadcast_size(layout(Projection::Cubemap, StereoLayout::TopBottom), 960, 1280, None), (1280, 1280));
        assert_eq!(broadcast_size(layout(Projection::Equirect, StereoLayout::TopBottom), 1920, 1082, None), (1920, 1080));
    }

    /// A cubemap with one grey per face: right, left, up above down, front, back.
    #[test]
    fn cube_faces_land_in_their_directions() {
        const FACE: u32 = 64;
        let mut cube = frame::Video::new(Pixel::YUV420P, 3 * FACE, 2 * FACE);
        for plane in 1..3 {
            cube.data_mut(plane).fill(128);
        }
        let stride = cube.stride(0);
        for y in 0..2 * FACE {
            for x in 0..3 * FACE {
                let face = y / FACE * 3 + x / FACE;
                cube.data_mut(0)[y as usize * stride + x as usize] = 40 + 30 * u8::try_from(face).unwrap();
            }
        }
        cube.set_pts(Some(77));
        for projection in [Projection::Cubemap, Projection::Eac] {
            let copy = cube.clone();
            let target = Target { width: 256, height: 128, pixel: Pixel::YUV420P, layout: layout(projection, StereoLayout::Mono) };
            let out = Reform::default().run(copy, target).unwrap();
            assert_eq!((out.width(), out.height(), out.pts()), (256, 128, Some(77)));
            let at = |x: usize, y: usize| out.data(0)[y * out.stride(0) + x];
            // Front in the middle, right a quarter turn on, back at the seam.
            if projection == Projection::Cubemap {
                assert_eq!([at(128, 64), at(192, 64), at(64, 64), at(0, 64)], [160, 40, 70, 190]);
                assert_eq!([at(128, 1), at(128, 126)], [100, 130]);
            } else {
                // EAC has left, front, right above down, back, up.
                assert_eq!([at(128, 64), at(192, 64), at(64, 64), at(0, 64)], [70, 100, 40, 160]);
                assert_eq!([at(128, 1), at(128, 126)], [190, 130]);
            }
        }
    }
}
