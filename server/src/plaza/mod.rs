//! `synthetic:plaza`, a small outdoor place rendered by the project itself, with its truth.
//!
//! The place and its light never change but for a veil that may pass before the sun, so it is rendered once; a frame
//! draws only the people and their shadows. The same configuration and frame index give the same bytes, in any order
//! of asking and on any number of threads.
//!
//! ```no_run
//! use mr360_server::plaza::{Plaza, PlazaConfig};
//!
//! let mut plaza = Plaza::new(PlazaConfig::from_query("size=1280x640&fps=30&sun=35")?, |_| {})?;
//! let truth = plaza.truth(0);
//! # Ok::<(), mr360_server::plaza::PlazaError>(())
//! ```

mod ambient;
mod bvh;
mod config;
mod encode;
mod facade;
mod frame;
mod geometry;
mod movers;
mod noise;
mod place;
mod sky;
mod still;
mod surface;
#[cfg(test)]
mod tests;
mod truth;

use glam::Vec3;

use ambient::World;
pub use config::{Clouds, MAX_MOVERS, PlazaConfig, PlazaError};
use encode::{Encoder, Planes, copy_rows};
use frame::{Composer, Touched};
use movers::{Figure, figures};
use place::Place;
use sky::{Sky, sun_solid_angle_sr};
use still::{Still, render};
pub use truth::{GeometryTruth, GroundTruth, IrradianceTruth, MoverTruth, PlazaTruth, Run, SunTruth};

/// A rendered place, ready to give frames.
///
/// Holds about 40 bytes a pixel.
pub struct Plaza {
    config: PlazaConfig,
    world: World,
    still: Still,
    composer: Composer,
    encoder: Encoder,
    /// The encoded still place, and the sun's strength in it.
    base: Option<(f32, Planes)>,
    frame: Planes,
    irradiance: Option<truth::StillIrradiance>,
}

/// What moves in a frame.
struct Moment {
    time_secs: f64,
    transmission: f32,
    figures: Vec<Figure>,
    touched: Vec<Touched>,
}

impl Plaza {
    /// Renders the place on all cores; two to four seconds on two cores at 1280×640. `progress` is called on this
    /// thread with values that rise from 0 to 1.
    ///
    /// # Errors
    /// When the configuration is out of range, see [`PlazaConfig::checked`].
    pub fn new(config: PlazaConfig, progress: impl FnMut(f32)) -> Result<Self, PlazaError> {
        let config = config.checked()?;
        let world = World::new(Place::new(config.seed), Sky::new(&config));
        let still = render(&config, &world, progress);
        let composer = Composer::new(&still, &world);
        let frame = Planes::new(config.width, config.height);
        Ok(Self { config, world, still, composer, encoder: Encoder::new(), base: None, frame, irradiance: None })
    }

    /// What it was made from.
    #[must_use]
    pub fn config(&self) -> &PlazaConfig {
        &self.config
    }

    /// Writes a frame as 8-bit limited-range BT.709 YUV 4:2:0. Codes are linear^(1/2.4) of the radiance, clipped at
    /// display white. Strides in bytes, at least the width (luma) and half of it (chroma); rows that a slice is too
    /// short for are not written.
    #[expect(clippy::too_many_arguments, reason = "three planes and their strides")]
    pub fn yuv420(
        &mut self,
        frame_index: u64,
        y: &mut [u8],
        y_stride: usize,
        u: &mut [u8],
        u_stride: usize,
        v: &mut [u8],
        v_stride: usize,
    ) {
        let moment = self.moment(frame_index);
        self.encode(&moment);
        let width = self.frame.width;
        copy_rows(&self.frame.y, width, y, y_stride);
        copy_rows(&self.frame.u, width / 2, u, u_stride);
        copy_rows(&self.frame.v, width / 2, v, v_stride);
    }

    /// Linear radiance of a frame, row by row from the top; display white is 1, the sun is tens of thousands.
    pub fn radiance(&mut self, frame_index: u64) -> Vec<[f32; 3]> {
        let moment = self.moment(frame_index);
        let mut pixels: Vec<[f32; 3]> = self.still.texels.iter().map(|t| t.radiance(moment.transmission).to_array()).collect();
        for touched in &moment.touched {
            pixels[touched.pixel as usize] = touched.radiance.to_array();
        }
        pixels
    }

    /// The truth about a frame.
    pub fn truth(&mut self, frame_index: u64) -> PlazaTruth {
        let moment = self.moment(frame_index);
        let sky = &self.world.sky;
        let sun = SunTruth {
            direction: sky.sun.to_array(),
            irradiance: (sky.sun_irradiance * (moment.transmission * self.still.disc_visible)).to_array(),
            solid_angle_sr: sun_solid_angle_sr(),
            visible_fraction: self.still.disc_visible,
            transmission: moment.transmission,
        };
        let irradiance = self.irradiance.get_or_insert_with(|| truth::StillIrradiance::new(&self.still));
        PlazaTruth {
            frame_index,
            time_secs: moment.time_secs,
            size: [self.config.width, self.config.height],
            irradiances: irradiance.of_frame(&self.still, &moment.touched, &sun),
            sun,
            sky_irradiance_up: sky.up_irradiance.to_array(),
            ground: truth::ground(),
            movers: moment.figures.iter().map(|figure| truth::mover(figure, &moment.touched, self.config.width)).collect(),
            geometry: truth::geometry(&self.world.place),
        }
    }

    /// [`Plaza::truth`] as one line of JSON.
    ///
    /// # Errors
    /// When `out` cannot be written to.
    pub fn write_truth_json(&mut self, frame_index: u64, mut out: impl std::io::Write) -> std::io::Result<()> {
        serde_json::to_writer(&mut out, &self.truth(frame_index))?;
        out.write_all(b"\n")
    }

    fn moment(&mut self, frame_index: u64) -> Moment {
        let time_secs = frame_index as f64 / self.config.fps;
        let transmission = Sky::transmission(self.config.clouds, time_secs);
        let figures = figures(self.config.movers, time_secs);
        let touched = self.composer.compose(&self.still, &self.world, &figures, transmission);
        Moment { time_secs, transmission, figures, touched }
    }

    /// Encodes a frame into `self.frame`: the still place under that sun, then every block that movers touch.
    fn encode(&mut self, moment: &Moment) {
        let (width, still, encoder) = (self.still.width as usize, &self.still, &self.encoder);
        let blank = || (f32::NAN, Planes::new(still.width, still.height));
        let (transmission, base) = self.base.get_or_insert_with(blank);
        if *transmission != moment.transmission {
            *transmission = moment.transmission;
            for (x, y) in (0..still.height as usize / 2).flat_map(|y| (0..width / 2).map(move |x| (x * 2, y * 2))) {
                let light = BLOCK.map(|[dx, dy]| still.texels[(y + dy) * width + x + dx].radiance(moment.transmission));
                encoder.block(base, x, y, light);
            }
        }
        self.frame.y.copy_from_slice(&base.y);
        self.frame.u.copy_from_slice(&base.u);
        self.frame.v.copy_from_slice(&base.v);
        let changed = |pixel: usize| -> Option<Vec3> {
            let found = moment.touched.binary_search_by_key(&(pixel as u32), |t| t.pixel).ok()?;
            moment.touched.get(found).map(|t| t.radiance)
        };
        for touched in &moment.touched {
            let (x, y) = (touched.pixel as usize % width, touched.pixel as usize / width);
            let corner = (y & !1) * width + (x & !1);
            let pixels = BLOCK.map(|[dx, dy]| corner + dy * width + dx);
            let radiances = pixels.map(changed);
            // The first touched pixel of a block encodes it.
            let first = pixels.iter().zip(&radiances).find(|(_, r)| r.is_some()).map(|(p, _)| *p);
            if first != Some(touched.pixel as usize) {
                continue;
            }
            let light = std::array::from_fn(|i| radiances[i].unwrap_or_else(|| still.texels[pixels[i]].radiance(moment.transmission)));
            encoder.block(&mut self.frame, x & !1, y & !1, light);
        }
    }
}

/// Pixels of a 2×2 block from its corner.
const BLOCK: [[usize; 2]; 4] = [[0, 0], [1, 0], [0, 1], [1, 1]];
