//! Values that more than one command takes.

use crate::governor::Tier;

/// Longest side of a picture, pixels: H.264's, too, and a readback of 8 bits fits the smallest buffers that GPUs promise.
pub(crate) const MAX_SIDE: u32 = 8192;

/// A size in pixels, as in `1280x720`.
pub(crate) fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let side = |text: &str| text.parse().ok().filter(|side| (1..=MAX_SIDE).contains(side));
    text.split_once(['x', '×'])
        .and_then(|(width, height)| Some((side(width)?, side(height)?)))
        .ok_or_else(|| format!("a size is WIDTHxHEIGHT, as in 1280x720, each from 1 to {MAX_SIDE}"))
}

/// A field of view in degrees.
pub(crate) fn parse_fov(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|fov| (1.0..=170.0).contains(fov)).ok_or_else(|| "a field of view is from 1 to 170 degrees".to_owned())
}

/// An angle in degrees.
pub(crate) fn parse_angle(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|angle: &f32| angle.is_finite()).ok_or_else(|| "an angle is a finite number of degrees".to_owned())
}

/// A tier by its number.
pub(crate) fn parse_tier(text: &str) -> Result<Tier, String> {
    let tier = text.parse().ok().and_then(Tier::new);
    tier.ok_or_else(|| format!("a tier is a number from 0 to {}", Tier::LOWEST.number()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_in_range_are_taken_and_others_named() {
        assert_eq!(parse_size("1280x720"), Ok((1280, 720)));
        assert_eq!(parse_size("8192×1"), Ok((8192, 1)));
        for wrong in ["", "1280", "0x720", "8193x1", "1x-1", "1280X720", "1x1x1"] {
            assert!(parse_size(wrong).unwrap_err().contains("8192"), "{wrong}");
        }
        assert_eq!((parse_fov("170"), parse_angle("-40.5")), (Ok(170.0), Ok(-40.5)));
        assert_eq!((parse_tier("0"), parse_tier("4")), (Ok(Tier::FULL), Ok(Tier::LOWEST)));
        for wrong in ["5", "-1", "auto", "0.5"] {
            assert!(parse_tier(wrong).unwrap_err().contains("0 to 4"), "{wrong}");
        }
        for wrong in ["0.9", "171", "NaN", "wide"] {
            assert!(parse_fov(wrong).is_err(), "{wrong}");
        }
        for wrong in ["inf", "NaN", "left"] {
            assert!(parse_angle(wrong).is_err(), "{wrong}");
        }
    }
}
