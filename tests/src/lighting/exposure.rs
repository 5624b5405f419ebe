//! A panorama as a camera would hand it over: true HDR, or 8 bits with its highlights clipped.

use anyhow::{Context, Result, ensure};
use glam::Vec3;
use mr360_protocol::light::Lift;
use mr360_protocol::video::{Colour, StereoLayout, Transfer};
use mr360_server::frame::{Frame, Pixels};
use mr360_shaders::colour::{radiance_from_code, srgb_encode};

use super::radiance_map::{LUMA, RadianceMap};

/// How a panorama becomes a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Exposure {
    /// Its radiance as it is.
    Hdr,
    /// 8-bit sRGB. Display white is the luminance that this percentage of the pixels does not exceed; what is above clips, channel by channel.
    Ldr(u8),
}

impl Exposure {
    /// Those that are measured.
    pub(super) const ALL: [Self; 4] = [Self::Hdr, Self::Ldr(90), Self::Ldr(95), Self::Ldr(99)];

    /// As CSV and file names call it.
    pub(super) fn name(self) -> String {
        match self {
            Self::Hdr => "hdr".to_owned(),
            Self::Ldr(percent) => format!("ldr{percent}"),
        }
    }

    /// As tables and charts call it.
    pub(super) fn title(self) -> String {
        match self {
            Self::Hdr => "HDR".to_owned(),
            Self::Ldr(percent) => format!("white at {percent} %"),
        }
    }

    /// Factor from the panorama's radiance to the frame's, in which display white is 1.
    ///
    /// # Errors
    /// When so much of the panorama is black that its white would be.
    pub(super) fn scale(self, map: &RadianceMap) -> Result<f32> {
        let Self::Ldr(percent) = self else { return Ok(1.0) };
        let mut luminance: Vec<f32> = map.texels().iter().map(|texel| texel.dot(LUMA)).collect();
        let rank = (luminance.len() * usize::from(percent)).div_ceil(100).saturating_sub(1);
        ensure!(rank < luminance.len(), "white at {percent} %: at most 100 %");
        let (_, white, _) = luminance.select_nth_unstable_by(rank, f32::total_cmp);
        let scale = white.recip();
        ensure!(scale.is_finite(), "{percent} % of its pixels are black; white there cannot be told from black");
        Ok(scale)
    }

    /// The frame that methods are given, and its codes where it has 8 bits.
    ///
    /// # Errors
    /// As [`Exposure::scale`].
    pub(super) fn take(self, map: &RadianceMap) -> Result<Taken> {
        let scale = self.scale(map).with_context(|| self.title())?;
        let codes = match self {
            Self::Hdr => None,
            Self::Ldr(_) => Some(map.texels().iter().map(|texel| (*texel * scale).to_array().map(code)).collect::<Vec<[u8; 3]>>()),
        };
        let (texels, transfer) = match &codes {
            None => (map.texels().iter().map(Vec3::to_array).collect(), Transfer::Linear),
            Some(codes) => (codes.iter().map(|code| code.map(|v| f32::from(v) / 255.0)).collect(), Transfer::Srgb),
        };
        let pixels = Pixels::Rgb { width: map.width as u32, height: map.height as u32, texels, transfer };
        Ok(Taken { scale, frame: Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels }, codes })
    }
}

/// A panorama through an exposure.
pub(super) struct Taken {
    /// Factor from the panorama's radiance to the frame's.
    pub(super) scale: f32,
    /// What methods are given.
    pub(super) frame: Frame,
    /// 8-bit sRGB, row by row; none of a true HDR frame.
    pub(super) codes: Option<Vec<[u8; 3]>>,
}

impl Taken {
    /// What a mirror shows of it in a viewer that lifts it so; `map` is the panorama that was taken.
    pub(super) fn lifted(&self, lift: Lift, map: &RadianceMap) -> RadianceMap {
        let Some(codes) = &self.codes else { return map.clone() };
        let colour = Colour { transfer: Transfer::Srgb, ..Colour::default() };
        let radiance = |(at, code): (usize, &[u8; 3])| {
            let code = Vec3::from_array(code.map(|v| f32::from(v) / 255.0));
            radiance_from_code(lift, colour, map.direction(at % map.width, at / map.width), code)
        };
        map.with_texels(codes.iter().enumerate().map(radiance).collect())
    }
}

/// 8-bit sRGB of linear light, rounded.
pub(super) fn code(linear: f32) -> u8 {
    (srgb_encode(linear.clamp(0.0, 1.0)) * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn white_is_the_luminance_that_the_percentage_does_not_exceed() {
        // 800 pixels, luminance 1 to 800 in some order.
        let count = std::cell::Cell::new(0u32);
        let map = RadianceMap::of(20, |_| {
            count.set(count.get() + 1);
            Vec3::splat((count.get() * 7 % 800 + 1) as f32)
        });
        for (percent, white) in [(90, 720.0), (95, 760.0), (99, 792.0)] {
            let scale = Exposure::Ldr(percent).scale(&map).unwrap();
            assert!((scale * white - 1.0).abs() < 1e-5, "{percent}: {scale}");
        }
        assert_eq!(Exposure::Hdr.scale(&map).unwrap(), 1.0);
        let night = RadianceMap::of(20, |direction| if direction.y > 0.99 { Vec3::ONE } else { Vec3::ZERO });
        assert!(Exposure::Ldr(90).scale(&night).unwrap_err().to_string().contains("black"));
    }

    #[test]
    fn ldr_frames_hold_rounded_srgb_codes_clipped_channel_by_channel() {
        // Three quarters grey of luminance 2, the rest a light that is red alone.
        let map = RadianceMap::of(
            16,
            |direction| if direction.x > 0.71 && direction.z > 0.0 { Vec3::new(100.0, 0.43, 0.0) } else { Vec3::splat(2.0) },
        );
        let taken = Exposure::Ldr(90).take(&map).unwrap();
        assert_eq!(taken.scale, 0.5);
        let Pixels::Rgb { texels, transfer, .. } = &taken.frame.pixels else { panic!("RGB was made") };
        assert_eq!(*transfer, Transfer::Srgb);
        for ((texel, code), radiance) in texels.iter().zip(taken.codes.clone().unwrap()).zip(map.texels()) {
            // sRGB of 0.215 is code 127.76.
            assert_eq!(code, if radiance.x > 2.0 { [255, 128, 0] } else { [255; 3] });
            assert_eq!(*texel, code.map(|v| f32::from(v) / 255.0));
        }
        // Lifted by nothing, it is what its codes show; by the papers' operator, white is 11.8.
        let (linear, lifted) = (taken.lifted(Lift::Linear, &map), taken.lifted(Lift::InverseToneMap, &map));
        for ((linear, lifted), radiance) in linear.texels().iter().zip(lifted.texels()).zip(map.texels()) {
            assert!((linear.y - (radiance.y * 0.5).min(1.0)).abs() < 2e-3 && (radiance.x > 2.0 || (lifted.x - 11.8).abs() < 1e-3));
        }
        let hdr = Exposure::Hdr.take(&map).unwrap();
        assert!(hdr.codes.is_none() && hdr.lifted(Lift::InverseToneMap, &map).texels() == map.texels());
        let Pixels::Rgb { texels, transfer, .. } = &hdr.frame.pixels else { panic!("RGB was made") };
        assert!(*transfer == Transfer::Linear && texels[0] == map.texels()[0].to_array());
    }
}
