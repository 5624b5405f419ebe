//! Where each layout's pixels look: a picture coloured by direction comes out as an equirect picture coloured by direction.

use ffmpeg_next::format::Pixel;
use ffmpeg_next::frame;
use glam::Vec3;

use super::*;
use crate::ingest::layout::Layout;
use crate::ingest::reform::{Reform, Target};

/// A code for each of x, y and z, in Y, U and V.
const CODES: f32 = 100.0;
/// libavfilter's v360 places samples up to half a pixel off, in the source and in the result: together at most 1.4° here, of 1.75 codes a degree;
/// one code is for rounding.
const TOLERANCE: f32 = 3.5;
const WIDTH: u32 = 512;

/// A face of a cube, seen from inside: where its middle lies, where its columns run to, and where its rows run to.
type Face = [Vec3; 3];
const X: Vec3 = Vec3::X;
const Y: Vec3 = Vec3::Y;
const Z: Vec3 = Vec3::Z;
const FRONT: Face = [Vec3::NEG_Z, X, Vec3::NEG_Y];
const BACK: Face = [Z, Vec3::NEG_X, Vec3::NEG_Y];
const RIGHT: Face = [X, Z, Vec3::NEG_Y];
const LEFT: Face = [Vec3::NEG_X, Vec3::NEG_Z, Vec3::NEG_Y];
/// Up and down of a cubemap adjoin the front face by its upper and lower edge.
const UP: Face = [Y, X, Vec3::NEG_Z];
const DOWN: Face = [Vec3::NEG_Y, X, Z];
/// The lower row of YouTube's EAC is one strip from down over back to up, lying on its side.
const EAC_LOWER: [Face; 3] = [[Vec3::NEG_Y, Z, Vec3::NEG_X], [Z, Y, Vec3::NEG_X], [Y, Vec3::NEG_Z, Vec3::NEG_X]];

fn on_face([middle, across, down]: Face, a: f32, b: f32) -> Vec3 {
    (middle + across * a + down * b).normalize()
}

/// Face and position in it, each in [-1, 1), from a position in [0, 1) of a picture of three by two faces.
fn face(faces: [[Face; 3]; 2], u: f32, v: f32) -> (Face, f32, f32) {
    let (column, row) = ((u * 3.0).clamp(0.0, 2.0).floor(), (v * 2.0).clamp(0.0, 1.0).floor());
    let column = if u * 3.0 >= 2.0 { 2.0 } else { column };
    (faces[row as usize][column as usize], (u * 3.0 - column) * 2.0 - 1.0, (v * 2.0 - row) * 2.0 - 1.0)
}

fn cubemap(u: f32, v: f32, _: [f32; 2]) -> Vec3 {
    let (face, a, b) = face([[RIGHT, LEFT, UP], [DOWN, FRONT, BACK]], u, v);
    on_face(face, a, b)
}

/// The angle grows evenly over a face. YouTube's files have two pixels of padding at the sides and above and below each row.
fn eac(u: f32, v: f32, [width, height]: [f32; 2]) -> Vec3 {
    let (pad_x, pad_y) = (2.0 / width, 2.0 / height);
    let u = (u - pad_x) / (1.0 - 2.0 * pad_x);
    let row = (v * 2.0).floor();
    let v = ((v - row * 0.5 - pad_y) / (1.0 - 4.0 * pad_y) + row * 0.5).clamp(row * 0.5, row * 0.5 + 0.499_99);
    let (face, a, b) = face([[LEFT, FRONT, RIGHT], EAC_LOWER], u, v);
    let even = |t: f32| (t * std::f32::consts::FRAC_PI_4).tan();
    on_face(face, even(a), even(b))
}

/// Equidistant lenses, the front one at the left.
fn dual_fisheye(fov_deg: f32) -> impl Fn(f32, f32, [f32; 2]) -> Vec3 {
    move |u, v, _| {
        let lens = if u < 0.5 { FRONT } else { BACK };
        let (a, b) = ((u * 4.0) % 2.0 - 1.0, v * 2.0 - 1.0);
        let radius = a.hypot(b).max(1e-6);
        let (sin, cos) = (radius * fov_deg.to_radians() / 2.0).sin_cos();
        lens[0] * cos + (lens[1] * a + lens[2] * b) * (sin / radius)
    }
}

fn equirect(u: f32, v: f32, _: [f32; 2]) -> Vec3 {
    mr360_shaders::equirect::direction_from_uv(glam::Vec2::new(u, v))
}

/// Walks over the pixels of every plane: plane, column, row, and the direction that `look` finds at the pixel's centre.
/// The lower eye's codes are mirrored, to tell it from the upper one.
fn pixels(
    picture: &frame::Video,
    stereo: StereoLayout,
    look: &dyn Fn(f32, f32, [f32; 2]) -> Vec3,
    mut visit: impl FnMut(usize, usize, usize, f32),
) {
    for plane in 0..3 {
        let (width, height) = (picture.plane_width(plane) as usize, picture.plane_height(plane) as usize);
        let eye = if stereo == StereoLayout::TopBottom { height / 2 } else { height };
        for y in 0..height {
            for x in 0..width {
                let (u, v) = ((x as f32 + 0.5) / width as f32, ((y % eye) as f32 + 0.5) / eye as f32);
                let direction = look(u, v, [width as f32, eye as f32]);
                let sign = if y < eye { 1.0 } else { -1.0 };
                visit(plane, x, y, 128.0 + sign * CODES * direction[plane]);
            }
        }
    }
}

fn check(projection: Projection, stereo: StereoLayout, (width, height): (u32, u32), look: &dyn Fn(f32, f32, [f32; 2]) -> Vec3) {
    let mut source = frame::Video::new(Pixel::YUV420P, width, height);
    let like = source.clone();
    pixels(&like, stereo, look, |plane, x, y, code| {
        let stride = source.stride(plane);
        source.data_mut(plane)[y * stride + x] = code.round().clamp(0.0, 255.0) as u8;
    });
    let eyes = if stereo == StereoLayout::TopBottom { 2 } else { 1 };
    let target = Target { width: WIDTH, height: WIDTH / 2 * eyes, pixel: Pixel::YUV420P, layout: Layout { projection, stereo } };
    let out = Reform::default().run(source, target).unwrap();
    let (mut worst, mut place) = (0.0, String::new());
    pixels(&out, stereo, &equirect, |plane, x, y, code| {
        let got = f32::from(out.data(plane)[y * out.stride(plane) + x]);
        if (got - code).abs() > worst {
            (worst, place) = ((got - code).abs(), format!("plane {plane} at {x}, {y}: {got} instead of {code}"));
        }
    });
    assert!(worst <= TOLERANCE, "{projection:?} {stereo:?}: {place}");
}

#[test]
fn cubemap_pixels_look_where_they_should() {
    check(Projection::Cubemap, StereoLayout::Mono, (768, 512), &cubemap);
    check(Projection::Cubemap, StereoLayout::TopBottom, (768, 1024), &cubemap);
}

#[test]
fn eac_pixels_look_where_they_should() {
    check(Projection::Eac, StereoLayout::Mono, (768, 512), &eac);
}

#[test]
fn dual_fisheye_pixels_look_where_they_should() {
    for fov_deg in [190.0, 200.0] {
        check(Projection::DualFisheye { fov_deg }, StereoLayout::Mono, (1024, 512), &dual_fisheye(fov_deg));
    }
}
