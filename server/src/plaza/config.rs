//! What the synthetic place can be asked for.

use thiserror::Error;

/// Why a plaza cannot be made.
#[derive(Debug, Error, Clone, PartialEq)]
pub enum PlazaError {
    /// The picture is not a 2:1 equirect of a supported size.
    #[error(
        "size {width}x{height} is not possible; give a width of 64 to 8192, even, and half of it, even, as height, such as size=1280x640"
    )]
    Size {
        /// Columns asked for.
        width: u32,
        /// Rows asked for.
        height: u32,
    },
    /// An option that does not exist.
    #[error("no option \"{key}\"; there are size, fps, sun, azimuth, clouds, seed and movers")]
    UnknownOption {
        /// The key as written.
        key: String,
    },
    /// An option whose value cannot be read or is out of range.
    #[error("{key}={value} is not possible; expected {expected}")]
    Value {
        /// The key.
        key: &'static str,
        /// The value as written.
        value: String,
        /// What is accepted, with an example.
        expected: &'static str,
    },
}

/// Clouds of the place.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Clouds {
    /// A clear sky.
    None,
    /// A few clouds that stand still and never cover the sun.
    Still,
    /// As `Still`, and a veil dims the sun to a quarter and lets it come back, once a minute.
    Passing,
}

/// A synthetic plaza.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlazaConfig {
    /// Columns, even, 64 to 8192.
    pub width: u32,
    /// Rows, half the columns, even.
    pub height: u32,
    /// Frames a second, 1 to 240.
    pub fps: f64,
    /// Varies pavement, foliage, clouds and interiors; the layout stays.
    pub seed: u32,
    /// Sun above the horizon, degrees, 5 to 85.
    pub sun_elevation_deg: f32,
    /// Sun's longitude, degrees, from −z towards +x, −180 to 180.
    pub sun_azimuth_deg: f32,
    /// Clouds.
    pub clouds: Clouds,
    /// People walking about, 0 to 5.
    pub movers: u32,
}

/// Most walkers that the place has paths for.
pub const MAX_MOVERS: u32 = 5;

impl Default for PlazaConfig {
    fn default() -> Self {
        Self {
            width: 1280,
            height: 640,
            fps: 30.0,
            seed: 1,
            sun_elevation_deg: 35.0,
            sun_azimuth_deg: -118.0,
            clouds: Clouds::Still,
            movers: MAX_MOVERS,
        }
    }
}

impl PlazaConfig {
    /// Reads `key=value` pairs joined by `&`, such as `size=1280x640&fps=30&sun=35&clouds=passing`. An empty
    /// query is the default.
    ///
    /// Keys: `size` (WxH), `fps`, `sun` (elevation, degrees), `azimuth` (degrees), `clouds` (`0`/`none`,
    /// `1`/`still`, `passing`), `seed`, `movers`.
    ///
    /// # Errors
    /// When a key is unknown, or a value cannot be read or is out of its range.
    pub fn from_query(query: &str) -> Result<Self, PlazaError> {
        let mut config = Self::default();
        for pair in query.trim_start_matches('?').split('&').filter(|pair| !pair.is_empty()) {
            let (key, value) = pair.split_once('=').unwrap_or((pair, ""));
            config.set(key, value)?;
        }
        config.checked()
    }

    fn set(&mut self, key: &str, value: &str) -> Result<(), PlazaError> {
        let refuse = |key, expected| PlazaError::Value { key, value: value.to_owned(), expected };
        match key {
            "size" => {
                let size = value.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
                (self.width, self.height) = size.ok_or_else(|| refuse("size", "WIDTHxHEIGHT, such as 1280x640"))?;
            }
            "fps" => self.fps = value.parse().map_err(|_| refuse("fps", FPS))?,
            "sun" => self.sun_elevation_deg = value.parse().map_err(|_| refuse("sun", SUN))?,
            "azimuth" => self.sun_azimuth_deg = value.parse().map_err(|_| refuse("azimuth", AZIMUTH))?,
            "seed" => self.seed = value.parse().map_err(|_| refuse("seed", "a whole number, such as 1"))?,
            "movers" => self.movers = value.parse().map_err(|_| refuse("movers", MOVERS))?,
            "clouds" => {
                self.clouds = match value {
                    "0" | "none" => Clouds::None,
                    "1" | "still" => Clouds::Still,
                    "passing" => Clouds::Passing,
                    _ => return Err(refuse("clouds", "none, still or passing")),
                }
            }
            _ => return Err(PlazaError::UnknownOption { key: key.to_owned() }),
        }
        Ok(())
    }

    /// The same configuration, if it can be rendered.
    ///
    /// # Errors
    /// When the size is not 2:1 and even within 64×32 to 8192×4096, or a number is out of its range.
    pub fn checked(self) -> Result<Self, PlazaError> {
        let (width, height) = (self.width, self.height);
        if !(64..=8192).contains(&width) || !width.is_multiple_of(4) || u64::from(height) * 2 != u64::from(width) {
            return Err(PlazaError::Size { width, height });
        }
        let ranges = [
            ("fps", self.fps, 1.0..=240.0, FPS),
            ("sun", f64::from(self.sun_elevation_deg), 5.0..=85.0, SUN),
            ("azimuth", f64::from(self.sun_azimuth_deg), -180.0..=180.0, AZIMUTH),
            ("movers", f64::from(self.movers), 0.0..=f64::from(MAX_MOVERS), MOVERS),
        ];
        for (key, value, range, expected) in ranges {
            if !range.contains(&value) {
                return Err(PlazaError::Value { key, value: value.to_string(), expected });
            }
        }
        Ok(self)
    }
}

const FPS: &str = "frames a second from 1 to 240, such as 30";
const SUN: &str = "degrees above the horizon from 5 to 85, such as 35";
const AZIMUTH: &str = "degrees from -z towards +x, -180 to 180, such as -118";
const MOVERS: &str = "a number of people from 0 to 5";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queries() {
        assert_eq!(PlazaConfig::from_query(""), Ok(PlazaConfig::default()));
        let config = PlazaConfig::from_query("size=640x320&fps=29.97&sun=20&azimuth=90&clouds=passing&seed=7&movers=2").expect("all valid");
        assert_eq!((config.width, config.height, config.fps, config.seed, config.movers), (640, 320, 29.97, 7, 2));
        assert_eq!((config.sun_elevation_deg, config.sun_azimuth_deg, config.clouds), (20.0, 90.0, Clouds::Passing));
    }

    #[test]
    fn bad_queries_name_the_fault() {
        for (query, part) in [
            ("size=1280", "1280x640"),
            ("size=1280x720", "1280x720"),
            ("size=62x31", "62x31"),
            ("size=66x33", "66x33"),
            ("size=16384x8192", "16384x8192"),
            ("size=0x0", "0x0"),
            ("fps=0", "fps=0"),
            ("fps=NaN", "fps=NaN"),
            ("fps=", "fps="),
            ("sun=95", "sun=95"),
            ("azimuth=inf", "azimuth=inf"),
            ("clouds=maybe", "clouds=maybe"),
            ("movers=6", "movers=6"),
            ("seed=-1", "seed=-1"),
            ("colour=red", "colour"),
            ("size", "size="),
        ] {
            let message = PlazaConfig::from_query(query).expect_err(query).to_string();
            assert!(message.contains(part), "{query}: {message}");
        }
    }
}
