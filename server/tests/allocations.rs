//! Methods of light promise not to allocate once they have seen a frame of a size and colour. Counted by the allocator itself.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use ffmpeg_next::format::Pixel;
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
/// of half this size can tell apart, and a sky that is one region.
const PICTURES: [fn(u32, u32) -> f32; 5] = [
    |_, _| 0.0,
    |x, y| if x.abs_diff(300) < 9 && y.abs_diff(90) < 9 { 1.0 } else { 0.1 },
    |x, y| if x % 32 < 2 && y % 32 < 2 { 1.0 } else { 0.02 },
    |x, y| if x % 4 < 2 && y % 4 < 2 { 1.0 } else { 0.02 },
    |_, y| if y < 40 { 1.0 } else { 0.2 },
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
            let mut light = spec.make();
            let mut steps = StepTimes::default();
            let mut most_lights = 0;
            // Every picture thrice, so that lights are born, followed, lost and found again; time goes on, or each frame would begin a stream.
            for i in 0..3 * frames.len() {
                let frame = &mut frames[i / 3];
                frame.pts_us = i as u64 * 33_333;
                let (allocations, lights) = allocations_of(|| light.estimate(&*frame, &mut steps).map(|estimate| estimate.lights.len()));
                most_lights = lights.unwrap().max(most_lights);
                // The first frame is black: what the later ones hold may not cost an allocation either.
                assert!(i == 0 || allocations == 0, "{spec}, {source}, frame {i}: {allocations} allocations");
            }
            assert!(matches!(spec.name(), "iorns" | "sh") || most_lights > 0, "{spec}, {source}: frames without lights prove nothing");
        }
    }
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
