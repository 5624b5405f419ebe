//! How far away a background is that one camera filmed. Two eyes, or a head that moves, see objects from elsewhere; against a
//! panorama at infinity their feet slide over the ground (Rhee et al. 2017, Sec. 8).

use std::str::FromStr;

use glam::Vec3;

/// Distance of the background of a source with one view. What a stereo source shows each eye has its own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Parallax {
    /// All of it is infinitely far away.
    Infinity,
    /// Ground and meshes of the place are where they are; all else lies on a dome of this radius around the camera that filmed.
    Ground {
        /// Metres.
        dome_m: f32,
    },
}

impl Parallax {
    /// Radii that a dome may have, metres.
    pub const DOME_M: [f32; 2] = [1.0, 10_000.0];
    /// An eye's 32 mm to the side are 0.04° at this distance: half a pixel of the finest headsets.
    const FAR_M: f32 = 50.0;

    /// The dome's radius as seen by eyes at these places; `None` where the background is drawn as if infinitely far away, as it is
    /// too where all of them are where the camera was.
    pub(super) fn dome_m(self, stereo: bool, mut eyes: impl Iterator<Item = Vec3>) -> Option<f32> {
        match self {
            Self::Ground { dome_m } if !stereo && eyes.any(|eye| eye != Vec3::ZERO) => Some(dome_m),
            _ => None,
        }
    }
}

impl Default for Parallax {
    fn default() -> Self {
        Self::Ground { dome_m: Self::FAR_M }
    }
}

impl FromStr for Parallax {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let [least, most] = Self::DOME_M;
        let radius = |text: &str| text.parse().ok().filter(|dome_m| (least..=most).contains(dome_m));
        let parallax = match text.split_once(':') {
            None if text == "infinity" => Some(Self::Infinity),
            None if text == "ground" => Some(Self::default()),
            Some(("ground", dome)) => radius(dome).map(|dome_m| Self::Ground { dome_m }),
            _ => None,
        };
        parallax.ok_or_else(|| format!("infinity, ground, or ground:RADIUS with a dome of {least} to {most} metres"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parallax_is_named_with_or_without_its_dome() {
        assert_eq!("infinity".parse(), Ok(Parallax::Infinity));
        assert_eq!("ground".parse(), Ok(Parallax::default()));
        assert_eq!("ground:4.5".parse(), Ok(Parallax::Ground { dome_m: 4.5 }));
        for wrong in ["", "Ground", "ground:", "ground:0.5", "ground:nan", "ground:inf", "infinity:3", "ground:-4"] {
            assert!(wrong.parse::<Parallax>().unwrap_err().contains("ground:RADIUS"), "{wrong}");
        }
    }

    #[test]
    fn the_background_has_a_distance_where_that_can_be_seen() {
        let ground = Parallax::Ground { dome_m: 5.0 };
        let aside = || [Vec3::ZERO, Vec3::X * 0.03].into_iter();
        assert_eq!(ground.dome_m(false, aside()), Some(5.0));
        assert_eq!(ground.dome_m(false, std::iter::once(Vec3::ZERO)), None);
        assert_eq!(ground.dome_m(true, aside()), None);
        assert_eq!(Parallax::Infinity.dome_m(false, aside()), None);
    }
}
