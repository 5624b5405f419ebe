//! The sky: Preetham, Shirley & Smits 1999, "A Practical Analytic Model for Daylight", with an aureole and a few clouds.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use glam::{Mat3, Vec2, Vec3};
use mr360_shaders::colour::luminance;

use super::config::{Clouds, PlazaConfig};
use super::noise::{fbm2, smoothstep};
use super::surface::PAVING_MEAN;

/// The sun's angular radius: half of 0.533°.
pub(super) const SUN_RADIUS_RAD: f32 = 0.266_5 * PI / 180.0;
/// Linear value that the pavement shall have in the sun.
const EXPOSURE_TARGET: f32 = 0.36;
/// Haziness in Preetham's scale: 2 is a very clear day, 6 hazy.
const TURBIDITY: f32 = 2.6;
/// Illuminance of the sun above the atmosphere, klx.
const EXTRATERRESTRIAL_KLX: f32 = 128.0;
/// The zenith formula makes skies too bright beside this sun; scaled so that sky and sun light level ground about 1 : 4.
const SKY_SHARE: f32 = 0.7;
/// Takes out the violet that the chromaticity fit has at low turbidity.
const SKY_TINT: Vec3 = Vec3::new(0.80, 1.0, 1.02);
/// Share of the sun's light that is scattered into the aureole, and the angle over which that falls by e.
const AUREOLE_SHARE: f32 = 0.03;
const AUREOLE_RAD: f32 = 0.032;

/// Radiance of a lit cloud over the irradiance of the sun's disc and over that of the whole sky.
const CLOUD_FROM_SUN: f32 = 0.20;
const CLOUD_FROM_SKY: f32 = 0.10;
/// Grey that haze has at every exposure, and its share.
const HAZE: Vec3 = Vec3::splat(0.42);
const HAZE_SHARE: f32 = 0.25;

/// A sky, exposed: display white is 1.
pub(super) struct Sky {
    /// Unit vector to the sun's centre.
    pub(super) sun: Vec3,
    /// Irradiance of the disc on a surface that faces it.
    pub(super) sun_irradiance: Vec3,
    /// Irradiance of the aureole on the same surface; shading takes it from the sun's direction.
    pub(super) aureole_irradiance: Vec3,
    /// Irradiance of the unobstructed sky, without sun and aureole, on level ground.
    pub(super) up_irradiance: Vec3,
    /// Radiance at the horizon away from the sun: the colour of distance.
    pub(super) haze: Vec3,
    exposure: f32,
    perez: [Perez; 3],
    clouds: bool,
    seed: i32,
}

/// What a direction shows, or an integral of it: clear sky as a weight or as light, and weights of lit cloud and of
/// haze before cloud.
#[derive(Clone, Copy)]
struct Mix<Clear> {
    clear: Clear,
    lit: f32,
    haze: f32,
}

/// One channel of Eq. 3, with its zenith value and its denominator.
#[derive(Clone, Copy)]
struct Perez {
    terms: [f32; 5],
    scale: f32,
}

impl Perez {
    fn new(slope: [f32; 5], at_zero: [f32; 5], zenith: f32, sun_from_zenith: f32) -> Self {
        let terms = std::array::from_fn(|i| slope[i] * TURBIDITY + at_zero[i]);
        let unscaled = Self { terms, scale: 1.0 };
        Self { terms, scale: zenith / unscaled.at(1.0, sun_from_zenith) }
    }

    /// Eq. 3 at a direction `cos_zenith` from the zenith and `gamma` from the sun.
    fn at(&self, cos_zenith: f32, gamma: f32) -> f32 {
        let [a, b, c, d, e] = self.terms;
        let cos_gamma = gamma.cos();
        self.scale * (1.0 + a * (b / cos_zenith).exp()) * (1.0 + c * (d * gamma).exp() + e * cos_gamma * cos_gamma)
    }
}

impl Sky {
    pub(super) fn new(config: &PlazaConfig) -> Self {
        let (elevation, azimuth) = (config.sun_elevation_deg.to_radians(), config.sun_azimuth_deg.to_radians());
        let sun = Vec3::new(elevation.cos() * azimuth.sin(), elevation.sin(), -elevation.cos() * azimuth.cos());
        let seed = (config.seed & 0x00FF_FFFF) as i32;
        let sun_klx = sun_colour(elevation) * EXTRATERRESTRIAL_KLX;
        let mut sky = Self {
            sun,
            sun_irradiance: sun_klx * (1.0 - AUREOLE_SHARE),
            aureole_irradiance: sun_klx * AUREOLE_SHARE,
            up_irradiance: Vec3::ZERO,
            haze: Vec3::ZERO,
            exposure: 1.0,
            perez: perez_of(FRAC_PI_2 - elevation),
            clouds: config.clouds != Clouds::None,
            seed,
        };
        sky.expose(sun_klx * sun.y);
        sky
    }

    /// Sets the exposure, and with it all that is measured in display white. `sun_up` is the irradiance of sun and
    /// aureole on level ground before that.
    ///
    /// Clouds are lit by the sky that they are part of, and haze is in part of a fixed colour: irradiance U and
    /// exposure e depend on each other, both linearly. With A, l and h the integrals over clear sky, lit cloud and
    /// haze in cloud, s·e the sun on the clouds and g·e + f the haze, U = A·e + l·(s·e + r·U) + h·(g·e + f).
    fn expose(&mut self, sun_up: Vec3) {
        let up = self.integrate_up();
        let horizon = self.clear(Vec3::new(self.sun.z, 0.06, -self.sun.x).normalize()) * (1.0 - HAZE_SHARE);
        let fixed_haze = HAZE * HAZE_SHARE;
        let own = 1.0 / (1.0 - up.lit * CLOUD_FROM_SKY);
        let per_exposure = (up.clear + self.sun_irradiance * (CLOUD_FROM_SUN * up.lit) + horizon * up.haze) * own;
        let fixed = fixed_haze * (up.haze * own);
        self.exposure = (EXPOSURE_TARGET * PI / luminance(PAVING_MEAN) - luminance(fixed)) / luminance(sun_up + per_exposure);
        self.sun_irradiance *= self.exposure;
        self.aureole_irradiance *= self.exposure;
        self.haze = horizon * self.exposure + fixed_haze;
        self.up_irradiance = per_exposure * self.exposure + fixed;
    }

    /// Radiance of sky and clouds, without the sun and its aureole.
    pub(super) fn radiance(&self, direction: Vec3) -> Vec3 {
        let clear = self.clear(direction);
        let Some(cloud) = self.cloud(direction) else { return clear };
        let lit = self.sun_irradiance * CLOUD_FROM_SUN + self.up_irradiance * CLOUD_FROM_SKY;
        clear * cloud.clear + lit * cloud.lit + self.haze * cloud.haze
    }

    /// Radiance of the aureole.
    pub(super) fn aureole(&self, direction: Vec3) -> Vec3 {
        let gamma = direction.dot(self.sun).clamp(-1.0, 1.0).acos();
        self.aureole_irradiance * ((-gamma / AUREOLE_RAD).exp() / (TAU * AUREOLE_RAD * AUREOLE_RAD))
    }

    /// Share of the sun's light that gets through at a time, in (0, 1], in steps of 1/256.
    pub(super) fn transmission(clouds: Clouds, time_secs: f64) -> f32 {
        if clouds != Clouds::Passing {
            return 1.0;
        }
        let phase = (time_secs / 60.0).fract() as f32;
        let veil = smoothstep(0.30, 0.42, phase) * (1.0 - smoothstep(0.62, 0.75, phase));
        ((1.0 - 0.75 * veil) * 256.0).round() / 256.0
    }

    fn clear(&self, direction: Vec3) -> Vec3 {
        let cos_zenith = direction.y.max(0.015);
        let gamma = direction.dot(self.sun).clamp(-1.0, 1.0).acos();
        let [luminance, x, y] = self.perez.map(|channel| channel.at(cos_zenith, gamma));
        let xyz = Vec3::new(x / y, 1.0, (1.0 - x - y) / y) * luminance;
        (BT709_FROM_XYZ * xyz).max(Vec3::ZERO) * SKY_TINT * self.exposure
    }

    /// The clouds in a direction; none below the horizon's haze.
    fn cloud(&self, direction: Vec3) -> Option<Mix<f32>> {
        if !self.clouds || direction.y <= 0.02 {
            return None;
        }
        let plane = Vec2::new(direction.x, direction.z) / (direction.y + 0.12) * 1.15;
        let towards_sun = Vec2::new(self.sun.x, self.sun.z).normalize_or_zero() * 0.22;
        let density = |p: Vec2| {
            let puffs = fbm2(p * 1.7 + Vec2::new(3.1, 8.4), 6, self.seed + 40);
            let fields = fbm2(p * 0.45 + Vec2::new(7.7, 1.3), 2, self.seed + 60);
            puffs + 0.55 * (fields - 0.40)
        };
        let here = density(plane);
        let gamma = direction.dot(self.sun).clamp(-1.0, 1.0).acos();
        let open = smoothstep(0.22, 0.60, gamma) * smoothstep(0.03, 0.16, direction.y);
        let cover = smoothstep(0.53, 0.78, here) * open;
        let shade = smoothstep(0.45, 0.95, density(plane + towards_sun));
        let (opacity, tone) = (cover * 0.92, 1.0 - 0.38 * shade * cover);
        let far = 0.35 * (1.0 - direction.y);
        Some(Mix { clear: 1.0 - opacity, lit: opacity * (1.0 - far) * tone, haze: opacity * far })
    }

    /// Cosine-weighted integrals of the three parts over the sky, by the midpoint rule in elevation and azimuth.
    fn integrate_up(&self) -> Mix<Vec3> {
        const ROWS: u32 = 64;
        const COLUMNS: u32 = 256;
        let mut sum = Mix { clear: Vec3::ZERO, lit: 0.0, haze: 0.0 };
        for row in 0..ROWS {
            // Equal steps of sin² φ carry equal cosine-weighted solid angles.
            let sin2 = (row as f32 + 0.5) / ROWS as f32;
            let (up, level) = (sin2.sqrt(), (1.0 - sin2).sqrt());
            for column in 0..COLUMNS {
                let (sin, cos) = ((column as f32 + 0.5) / COLUMNS as f32 * TAU).sin_cos();
                let direction = Vec3::new(level * sin, up, -level * cos);
                let cloud = self.cloud(direction).unwrap_or(Mix { clear: 1.0, lit: 0.0, haze: 0.0 });
                sum.clear += self.clear(direction) * cloud.clear;
                sum.lit += cloud.lit;
                sum.haze += cloud.haze;
            }
        }
        let weight = PI / (ROWS * COLUMNS) as f32;
        Mix { clear: sum.clear * weight, lit: sum.lit * weight, haze: sum.haze * weight }
    }
}

/// Solid angle of the sun's disc.
pub(super) fn sun_solid_angle_sr() -> f32 {
    // 2π(1 − cos r) without the cancellation.
    4.0 * PI * (SUN_RADIUS_RAD * 0.5).sin().powi(2)
}

/// BT.709 primaries with D65 (ITU-R BT.709), from CIE XYZ; columns.
const BT709_FROM_XYZ: Mat3 = Mat3::from_cols(
    Vec3::new(3.240_454_2, -0.969_266, 0.055_643_4),
    Vec3::new(-1.537_138_5, 1.876_010_8, -0.204_025_9),
    Vec3::new(-0.498_531_4, 0.041_556, 1.057_225_2),
);

/// Sunlight after Rayleigh and aerosol extinction at three wavelengths (Preetham et al. 1999, appendix A.1).
fn sun_colour(elevation: f32) -> Vec3 {
    let air_mass = 1.0 / (elevation.sin() + 0.15 * (elevation.to_degrees() + 3.885).powf(-1.253));
    let beta = 0.046_08 * TURBIDITY - 0.045_86;
    let transmitted = [0.61f32, 0.55, 0.465].map(|micrometres| {
        let depth = 0.008_735 * micrometres.powf(-4.08) + beta * micrometres.powf(-1.3);
        (-depth * air_mass).exp()
    });
    Vec3::from_array(transmitted)
}

/// Distributions of luminance (kcd/m²) and chromaticity (Preetham et al. 1999, appendix A.2).
fn perez_of(sun_from_zenith: f32) -> [Perez; 3] {
    let t = TURBIDITY;
    let s = sun_from_zenith;
    let powers = [s * s * s, s * s, s, 1.0];
    let zenith_of = |rows: [[f32; 4]; 3]| {
        let dot = |row: [f32; 4]| row.iter().zip(powers).map(|(a, b)| a * b).sum::<f32>();
        t * t * dot(rows[0]) + t * dot(rows[1]) + dot(rows[2])
    };
    let chi = (4.0 / 9.0 - t / 120.0) * (PI - 2.0 * s);
    let zenith_luminance = SKY_SHARE * ((4.0453 * t - 4.9710) * chi.tan() - 0.2155 * t + 2.4192);
    let zenith_x = zenith_of([
        [0.001_66, -0.003_75, 0.002_09, 0.0],
        [-0.029_03, 0.063_77, -0.032_02, 0.003_94],
        [0.116_93, -0.211_96, 0.060_52, 0.258_86],
    ]);
    let zenith_y = zenith_of([
        [0.002_75, -0.006_10, 0.003_17, 0.0],
        [-0.042_14, 0.089_70, -0.041_53, 0.005_16],
        [0.153_46, -0.267_56, 0.066_70, 0.266_88],
    ]);
    [
        Perez::new([0.1787, -0.3554, -0.0227, 0.1206, -0.0670], [-1.4630, 0.4275, 5.3251, -2.5771, 0.3703], zenith_luminance, s),
        Perez::new([-0.0193, -0.0665, -0.0004, -0.0641, -0.0033], [-0.2592, 0.0008, 0.2125, -0.8989, 0.0452], zenith_x, s),
        Perez::new([-0.0167, -0.0950, -0.0079, -0.0441, -0.0109], [-0.2608, 0.0092, 0.2102, -1.6537, 0.0529], zenith_y, s),
    ]
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// Irradiance of [`Sky::radiance`] on level ground in double precision, in equal steps of both angles: another rule
    /// than the one under test, and over the finished sky.
    fn irradiance_up(sky: &Sky) -> DVec3 {
        const ROWS: u32 = 180;
        const COLUMNS: u32 = 720;
        let mut sum = DVec3::ZERO;
        for row in 0..ROWS {
            let (up, level) = ((f64::from(row) + 0.5) / f64::from(ROWS) * std::f64::consts::FRAC_PI_2).sin_cos();
            for column in 0..COLUMNS {
                let (sin, cos) = (f64::from(column) / f64::from(COLUMNS) * std::f64::consts::TAU).sin_cos();
                let direction = DVec3::new(level * sin, up, -level * cos).as_vec3();
                sum += sky.radiance(direction).as_dvec3() * (level * up);
            }
        }
        sum * (std::f64::consts::FRAC_PI_2 / f64::from(ROWS) * std::f64::consts::TAU / f64::from(COLUMNS))
    }

    fn skies() -> impl Iterator<Item = (String, Sky)> {
        [Clouds::None, Clouds::Still, Clouds::Passing].into_iter().flat_map(|clouds| {
            [10.0, 35.0, 70.0].map(|sun_elevation_deg| {
                let sky = Sky::new(&PlazaConfig { sun_elevation_deg, clouds, ..PlazaConfig::default() });
                (format!("{clouds:?} {sun_elevation_deg}"), sky)
            })
        })
    }

    #[test]
    fn the_published_irradiance_is_the_integral_of_the_finished_sky() {
        for (name, sky) in skies() {
            let expected = irradiance_up(&sky);
            let off = (sky.up_irradiance.as_dvec3() / expected - 1.0).abs().max_element();
            // Two quadratures of the clouds' edges differ by less than a thousandth; clouds left unlit take 2 % off.
            assert!(off < 2e-3, "{name}: {} against {expected}", sky.up_irradiance);
        }
    }

    #[test]
    fn sunlit_pavement_lands_on_its_value_at_every_elevation() {
        for (name, sky) in skies() {
            let sun = (sky.sun_irradiance + sky.aureole_irradiance) * sky.sun.y;
            let level = luminance(sun + irradiance_up(&sky).as_vec3()) * luminance(PAVING_MEAN) / PI;
            assert!((level / EXPOSURE_TARGET - 1.0).abs() < 1e-3, "{name}: {level}");
        }
    }

    #[test]
    fn disc_times_its_solid_angle_is_the_suns_irradiance() {
        let sky = Sky::new(&PlazaConfig::default());
        // 0.533° across is 6.8e-5 sr.
        assert!((sun_solid_angle_sr() - 6.796e-5).abs() < 1e-8, "{}", sun_solid_angle_sr());
        assert!(
            (sky.sun_irradiance / sun_solid_angle_sr()).min_element() > 10_000.0,
            "a clear day's sun is tens of thousands of times display white"
        );
    }

    #[test]
    fn the_sky_is_blue_and_the_sun_warm() {
        let sky = Sky::new(&PlazaConfig { clouds: Clouds::None, ..PlazaConfig::default() });
        let zenith = sky.radiance(Vec3::Y);
        assert!(zenith.z > 1.5 * zenith.x && zenith.min_element() > 0.0, "{zenith}");
        assert!(sky.sun_irradiance.x > 1.2 * sky.sun_irradiance.z);
    }
}
