//! What a headset of today would ask of a GPU: the work of a frame, counted, times its pixels and its rate. Bytes are those that leave the
//! chip; caches are taken to hold what neighbours share, and nothing else.

use mr360_shaders::layout::SHADOW_MAP_SIZE;

use crate::chart::number;
use crate::table::Table;

/// Pixels of both eyes of a headset of today, and frames a second.
const EYE: (f64, f64) = (2064.0, 2208.0);
const EYES: f64 = 2.0;
const RATE_HZ: f64 = 90.0;
/// The broadcast: columns and rows of 4:2:0 in 8 bits, and pictures a second.
const VIDEO: (f64, f64) = (4096.0, 2048.0);
const VIDEO_HZ: f64 = 30.0;
const VIDEO_BYTES: f64 = 1.5;
/// Bytes a pixel: RGBA16F of the layer, its depth, samples of both, a picture's codes, a picture's depth.
const LAYER: f64 = 8.0;
const DEPTH: f64 = 4.0;
const SAMPLES: f64 = 4.0;
const CODES: f64 = 4.0;
/// Most lights that cast shadows.
const SHADOWS: f64 = 4.0;
/// Two cubes of 64² with their mips, RGBA16F: written once, the first read about as often for the second.
const REFLECTIONS: f64 = 2.0 * 2.0 * 6.0 * 64.0 * 64.0 * 4.0 / 3.0 * LAYER;
/// Pictures of each kind that a runtime lends by turns.
const LENT: f64 = 3.0;

/// One kind of work.
struct Work {
    what: &'static str,
    why: &'static str,
    rate_hz: f64,
    /// Bytes each time, for a share of the pixels that objects and changed ground take.
    bytes: fn(f64) -> f64,
}

fn pixels() -> f64 {
    EYES * EYE.0 * EYE.1
}

fn works() -> [Work; 6] {
    [
        Work {
            what: "objects and ground, one pass of both eyes",
            why: "4 samples of colour and depth written, colours read again and resolved, on the touched share",
            rate_hz: RATE_HZ,
            bytes: |share| share * pixels() * (SAMPLES * (2.0 * LAYER + DEPTH) + LAYER),
        },
        Work {
            what: "composite, one pass of both eyes",
            why: "layer read on the touched share, video at most a texel a pixel, codes written",
            rate_hz: RATE_HZ,
            bytes: |share| pixels() * (share * LAYER + VIDEO_BYTES + CODES),
        },
        Work {
            what: "depth for the runtime, a pass an eye",
            why: "4 samples read on the touched share, one written",
            rate_hz: RATE_HZ,
            bytes: |share| pixels() * (share * SAMPLES * DEPTH + DEPTH),
        },
        Work {
            what: "shadow maps, once for both eyes",
            why: "4 maps of 1024², redrawn when lights or objects move",
            rate_hz: VIDEO_HZ,
            bytes: |_| SHADOWS * f64::from(SHADOW_MAP_SIZE) * f64::from(SHADOW_MAP_SIZE) * DEPTH,
        },
        Work {
            what: "reflections, once for both eyes",
            why: "lift, mips, five levels over roughness",
            rate_hz: VIDEO_HZ,
            bytes: |_| REFLECTIONS,
        },
        Work {
            what: "video",
            why: "written for the GPU, read and written by its copy",
            rate_hz: VIDEO_HZ,
            bytes: |_| 3.0 * VIDEO.0 * VIDEO.1 * VIDEO_BYTES,
        },
    ]
}

/// Bytes that stay on the GPU.
fn memory(share: f64) -> f64 {
    let lent = LENT * pixels() * (CODES + DEPTH);
    let layers = share * pixels() * (LAYER + SAMPLES * (LAYER + DEPTH));
    let maps = SHADOWS * f64::from(SHADOW_MAP_SIZE) * f64::from(SHADOW_MAP_SIZE) * DEPTH;
    lent + layers + maps + VIDEO.0 * VIDEO.1 * VIDEO_BYTES + REFLECTIONS / 2.0
}

/// Gigabytes a second of all work together.
fn bandwidth(share: f64) -> f64 {
    works().iter().map(|work| (work.bytes)(share) * work.rate_hz).sum::<f64>() / 1e9
}

/// The table and its reasoning. `passes` are those that a frame was seen to have here, with their median times.
pub(super) fn markdown(passes: &[(String, f64)]) -> String {
    let (some, all) = (0.25, 1.0);
    let mut table = Table::new(&["work", "times/s", "MB each, a quarter touched", "all touched", "because"]);
    for Work { what, why, rate_hz, bytes } in works() {
        let megabytes = |share| number(bytes(share) / 1e6);
        table.push([what.to_owned(), number(rate_hz), megabytes(some), megabytes(all), why.to_owned()]);
    }
    let seen: Vec<_> = passes.iter().map(|(pass, ms)| format!("{pass} {}", number(*ms))).collect();
    format!(
        "## What a headset of today would need\n\n\
         2×2064×2208 pixels at 90 Hz: {} million pixels a second, in {} ms a frame; video of 4096×2048 at 30 Hz. Touched is what objects and changed ground take of the picture.\n\n{}\n\
         Together {} GB/s with a quarter touched, {} GB/s with all of it; memory {} and {} MB. Tiled GPUs keep the samples of the first row on the chip. Governor's tier 4 draws one sample a pixel, \
         which takes three quarters off the first row. Head motion costs nothing at the video's rate: light, reflections and shadow maps do not depend on it.\n\n\
         Passes of a frame, seen here in the calm run at 2×320×240 (ms, in software): {}.\n",
        number((pixels() * RATE_HZ / 1e6).round()),
        number(1e3 / RATE_HZ),
        table.markdown(),
        number(bandwidth(some)),
        number(bandwidth(all)),
        number((memory(some) / 1e6).round()),
        number((memory(all) / 1e6).round()),
        seen.join(", "),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_demand_follows_from_its_pixels() {
        // 9.11 million pixels: composite alone writes 4 of their bytes and reads 1.5, 90 times a second.
        let untouched = works()[1].bytes;
        assert!((untouched(0.0) - 9_114_624.0 * 5.5).abs() < 1.0);
        // All that is touched costs 88 + 8 + 16 bytes a pixel more.
        let more = (bandwidth(1.0) - bandwidth(0.0)) * 1e9 / RATE_HZ / pixels();
        assert!((more - 112.0).abs() < 1e-6, "{more}");
        assert!(memory(0.0) > LENT * pixels() * 8.0 && memory(1.0) - memory(0.0) == pixels() * 56.0);
        let text = markdown(&[("composite".to_owned(), 2.5)]);
        assert!(
            text.contains("2×2064×2208") && text.contains("composite 2.5") && text.contains("| composite, one pass of both eyes | 90 |"),
            "{text}"
        );
    }
}
