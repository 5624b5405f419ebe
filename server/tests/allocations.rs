//! Methods of light promise not to allocate once they have seen a frame of a size and colour. Counted by the allocator itself.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use ffmpeg_next::format::Pixel;
use mr360_protocol::light::MAX_LIGHTS;
use mr360_protocol::video::{Colour, StereoLayout, Transfer};
use mr360_server::frame::{Frame, Pixels};
use mr360_server::lighting::{MethodSpec, StepTimes};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator, counting what this thread asks it for.
struct Counting;

fn count() {
    // A thread that is being torn down has no counter any more, and no test to count for.
    let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
}

#[expect(unsafe_code, reason = "GlobalAlloc is an unsafe trait; there is no other way to see allocations")]
// SAFETY: every call is handed to `System` unchanged, which keeps the contract. Counting allocates nothing: the
// counter is a constant-initialised thread-local without a destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract of `alloc_zeroed`.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract of `realloc`; `pointer` came from `System`.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`; `pointer` came from `System`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn allocations_of<T>(work: impl FnOnce() -> T) -> (u64, T) {
    let before = ALLOCATIONS.get();
    let result = work();
    (ALLOCATIONS.get() - before, result)
}

const WIDTH: u32 = 1024;
const HEIGHT: u32 = 512;

/// Brightness in [0, 1] of a pixel in each of the pictures: black, then one sun, hundreds of specks, as many specks as a working panorama
/// of half this size can tell apart, a sky that is one region over a striped ground,
/// and the sun with two lamps beside it.
const PICTURES: [fn(u32, u32) -> f32; 6] = [
    |_, _| 0.0,
    |x, y| if x.abs_diff(300) < 9 && y.abs_diff(90) < 9 { 1.0 } else { 0.01 },
    |x, y| if x % 32 < 2 && y % 32 < 2 { 1.0 } else { 0.02 },
    |x, y| if x % 4 < 2 && y % 4 < 2 { 1.0 } else { 0.02 },
    |x, y| match (y < 40, x % 64 < 32) {
        (true, _) => 1.0,
        (false, true) => 0.3,
        (false, false) => 0.1,
    },
    |x, y| if [300, 600, 900].iter().any(|lamp| x.abs_diff(*lamp) < 9) && y.abs_diff(90) < 9 { 1.0 } else { 0.01 },
];

fn rgb(transfer: Transfer, picture: fn(u32, u32) -> f32) -> Pixels {
    let texels = (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| [picture(x, y); 3])).collect();
    Pixels::Rgb { width: WIDTH, height: HEIGHT, texels, transfer }
}

fn video(format: Pixel, picture: fn(u32, u32) -> f32) -> Pixels {
    let mut video = ffmpeg_next::frame::Video::new(format, WIDTH, HEIGHT);
    let bytes = if format == Pixel::YUV420P10LE { 2 } else { 1 };
    let scale = if bytes == 2 { 4.0 } else { 1.0 };
    for plane in 0..3 {
        let (stride, columns, rows) = (video.stride(plane), video.plane_width(plane), video.plane_height(plane));
        for (x, y) in (0..rows).flat_map(|y| (0..columns).map(move |x| (x, y))) {
            let code = if plane == 0 { 16.0 + 219.0 * picture(x, y) } else { 128.0 };
            let at = y as usize * stride + x as usize * bytes;
            video.data_mut(plane)[at..at + bytes].copy_from_slice(&((code * scale) as u16).to_le_bytes()[..bytes]);
        }
    }
    Pixels::Video(video, Colour { bit_depth: if bytes == 2 { 10 } else { 8 }, ..Colour::default() })
}

/// Which picture is shown, and in how many frames: a sun, lamps that are born beside it and die, another place at once, and specks; each
/// long enough for births, deaths and their fades.
const SHOWN: [(usize, usize); 8] = [(0, 1), (1, 8), (5, 8), (1, 10), (4, 10), (2, 8), (3, 4), (1, 8)];

#[test]
fn frames_after_the_first_are_estimated_without_allocating() {
    type Source = (&'static str, fn(fn(u32, u32) -> f32) -> Pixels);
    let sources: [Source; 4] = [
        ("linear", |picture| rgb(Transfer::Linear, picture)),
        ("sRGB", |picture| rgb(Transfer::Srgb, picture)),
        ("8-bit video", |picture| video(Pixel::YUV420P, picture)),
        ("10-bit video", |picture| video(Pixel::YUV420P10LE, picture)),
    ];
    for spec in MethodSpec::all() {
        for (source, pixels) in sources {
            let mut frames = PICTURES.map(|picture| Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: pixels(picture) });
            let following = SHOWN.iter().flat_map(|(picture, frames)| std::iter::repeat_n(*picture, *frames)).zip(1u64..);
            let following: Vec<_> = following.map(|(picture, frame)| (picture, frame * 33_333)).collect();
            // In time, and as stills that know nothing of each other.
            for shown in [following, (0..PICTURES.len()).map(|picture| (picture, 0)).collect()] {
                let lives = estimate_all(spec, source, &mut frames, &shown);
                assert!(matches!(spec.name(), "iorns" | "sh") || lives.most > 0, "{spec}, {source}: frames without lights prove nothing");
                // The default method follows lights: frames in which none comes or goes, and none at once, prove nothing of it.
                let changes = lives.births >= 4 && lives.deaths >= 3 && lives.replaced > 0;
                assert!(spec != MethodSpec::default() || shown[1].1 == 0 || changes, "{source}: {lives:?}");
            }
        }
    }
}

/// What became of the lights.
#[derive(Debug, Default)]
struct Lives {
    /// Most lights of a frame.
    most: usize,
    births: usize,
    deaths: usize,
    /// Frames in which all lights there were gave way to others, as in a cut.
    replaced: usize,
}

/// Estimates the frames in this order and at these times, and checks that all but the first do without allocating.
fn estimate_all(spec: MethodSpec, source: &str, frames: &mut [Frame], shown: &[(usize, u64)]) -> Lives {
    let (mut light, mut steps, mut lives) = (spec.make(), StepTimes::default(), Lives::default());
    let mut before: Vec<u32> = Vec::new();
    for (i, (picture, pts_us)) in shown.iter().enumerate() {
        let frame = &mut frames[*picture];
        frame.pts_us = *pts_us;
        let mut ids = [0; MAX_LIGHTS];
        let (allocations, lights) = allocations_of(|| {
            light.estimate(frame, &mut steps).map(|estimate| {
                ids.iter_mut().zip(&estimate.lights).for_each(|(id, light)| *id = light.id);
                estimate.lights.len()
            })
        });
        assert!(lights.is_ok(), "{spec}, {source}, frame {i}: {lights:?}");
        let lights = lights.unwrap_or_default();
        // The first frame is black: what the later ones hold may not cost an allocation either.
        assert!(i == 0 || allocations == 0, "{spec}, {source}, frame {i} at {pts_us} µs: {allocations} allocations");
        let now = ids[..lights].to_vec();
        let births = now.iter().filter(|id| !before.contains(id)).count();
        lives.most = lives.most.max(lights);
        lives.births += births;
        lives.deaths += before.iter().filter(|id| !now.contains(id)).count();
        lives.replaced += usize::from(!before.is_empty() && births > 0 && births == now.len());
        before = now;
    }
    lives
}

#[test]
fn the_counter_counts() {
    let (allocations, mut values) = allocations_of(|| Vec::<u64>::with_capacity(4));
    assert_eq!(allocations, 1);
    let (allocations, ()) = allocations_of(|| values.extend(0..100));
    assert!(allocations >= 1);
    let (allocations, _zeroed) = allocations_of(|| vec![0u8; 1000]);
    assert_eq!(allocations, 1);
}
