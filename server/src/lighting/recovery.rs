//! Energy that clipping took from an LDR frame, as far as the ground gives it away.
//!
//! A camera that shows the ground well clips the sun to display white and loses most of its light. The ground has
//! seen it: lit by irradiance E, ground of albedo ρ sends up radiance ρE/π. Whatever E exceeds what the frame's upper
//! hemisphere explains is put onto its clipped texels, in proportion to what they hold: as far as there are enough of them, and no more
//! than the sun could give. The albedo is assumed, so the
//! result is an estimate; true HDR frames and frames without clipped texels are left as they are.

use glam::Vec3;

use super::panorama::Panorama;

/// Albedo of the ground: soil, grass, paving and floors lie between 0.1 and 0.5, most of them about here.
const GROUND_ALBEDO: f64 = 0.3;
/// A texel is clipped by a degree that rises from the first to the second of these shares of display white's lifted luminance. Under
/// the highlights' lift these are the codes 0.95 and 0.98: the blocks that a texel averages need not all be clipped. Seven 8-bit steps lie
/// between them, so that grain moves the degree of a texel by a fraction.
const CLIPPED_SHARE: (f32, f32) = (0.6, 0.8);
/// From this clipped solid angle on, all that is missing is given to it: sixteen texels of the default method's panorama, a disc of 1.6°
/// radius. A sun that a camera clips takes its glare with it and covers several degrees; a texel or two are as likely glints and
/// sharpened edges that are gone in the next frame.
const TRUSTED_SR: f64 = 2.4e-3;
/// The sun gives a surface that faces it at most this many times what level ground gets from sun and sky together. Under clear skies the
/// ratio is 1 with the sun overhead and 4 with the sun at 5°, where it is greatest; below, the beam is lost in the air.
const MOST_BEAM: f64 = 4.0;
/// The sky is never made more than this many times as bright as it was: a bright floor in a dim room is a bright floor.
const MOST_GAIN: f64 = 5.0;
/// The ground is what lies at least this far below the horizon, as the sine of the angle: nearer to it stand houses and trees.
const GROUND_SINE: f32 = 0.25;

/// What the upper hemisphere and the ground hold.
#[derive(Default)]
struct Balance {
    /// Luminous irradiance on level ground.
    irradiance: f64,
    /// Part of it that clipped texels give, each by its degree.
    clipped: f64,
    /// The same on surfaces that face them.
    facing: f64,
    /// Solid angle of the clipped texels.
    clipped_sr: f64,
    /// Luminance of the ground, and the weight of its mean.
    ground: f64,
    ground_weight: f64,
}

/// Brightens the clipped texels of the upper hemisphere so that its irradiance explains the ground: wholly once there are enough of them,
/// and never beyond what the sun could give, spread over all of them. Continuous in every texel: none makes a step by being clipped or not.
/// `white` is the lifted luminance of display white, `luma` the luminance weights.
pub(super) fn recover(panorama: &mut Panorama, white: f32, luma: Vec3) {
    let ramp = Ramp::new(white);
    let balance = weigh(panorama, ramp, luma);
    if balance.clipped <= 0.0 || balance.ground_weight <= 0.0 {
        return;
    }
    let explained = (std::f64::consts::PI * (balance.ground / balance.ground_weight) / GROUND_ALBEDO).min(MOST_GAIN * balance.irradiance);
    let missing = (explained - balance.irradiance) * smooth((balance.clipped_sr / TRUSTED_SR).min(1.0));
    let gain = (1.0 + missing / balance.clipped).min(MOST_BEAM * explained / balance.facing);
    if gain > 1.0 {
        brighten(panorama, ramp, luma, gain as f32);
    }
}

/// Rises from 0 to 1 with `t`, without a kink at either end.
fn smooth(t: f64) -> f64 {
    t * t * (3.0 - 2.0 * t)
}

/// By how much a texel is clipped.
#[derive(Debug, Clone, Copy)]
struct Ramp {
    /// Luminance from which on it is.
    first: f32,
    /// One over the luminance from there to where it is wholly.
    inverse_width: f32,
}

impl Ramp {
    fn new(white: f32) -> Self {
        let (first, last) = CLIPPED_SHARE;
        Self { first: first * white, inverse_width: 1.0 / ((last - first) * white) }
    }

    /// In [0, 1].
    fn degree(self, luminance: f32) -> f32 {
        let t = ((luminance - self.first) * self.inverse_width).clamp(0.0, 1.0);
        t * t * (3.0 - 2.0 * t)
    }
}

fn luminance(panorama: &Panorama, row: usize, luma: Vec3) -> impl Iterator<Item = f32> + '_ {
    let [red, green, blue] = [0, 1, 2].map(|channel| panorama.row(channel, row));
    red.iter().zip(green).zip(blue).map(move |((r, g), b)| luma.x * r + luma.y * g + luma.z * b)
}

fn weigh(panorama: &Panorama, ramp: Ramp, luma: Vec3) -> Balance {
    let mut balance = Balance::default();
    for row in 0..panorama.size.height as usize {
        let sine = panorama.geometry.sin_cos_latitude[row].0;
        let texel_sr = f64::from(panorama.geometry.solid_angle_sr[row]);
        let weight = texel_sr * f64::from(sine.abs());
        if sine > 0.0 {
            let (mut all, mut clipped, mut count) = (0.0f32, 0.0f32, 0.0f32);
            for y in luminance(panorama, row, luma) {
                let degree = ramp.degree(y);
                all += y;
                clipped += degree * y;
                count += degree;
            }
            balance.irradiance += f64::from(all) * weight;
            balance.clipped += f64::from(clipped) * weight;
            balance.facing += f64::from(clipped) * texel_sr;
            balance.clipped_sr += f64::from(count) * texel_sr;
        } else if sine <= -GROUND_SINE {
            balance.ground += luminance(panorama, row, luma).map(f64::from).sum::<f64>() * weight;
            balance.ground_weight += weight * f64::from(panorama.size.width);
        }
    }
    balance
}

fn brighten(panorama: &mut Panorama, ramp: Ramp, luma: Vec3, gain: f32) {
    let width = panorama.size.width as usize;
    let upper = panorama.geometry.sin_cos_latitude.iter().take_while(|(sine, _)| *sine > 0.0).count() * width;
    for texel in 0..upper {
        let radiance = panorama.radiance(texel);
        let degree = ramp.degree(radiance.dot(luma));
        if degree > 0.0 {
            panorama.set_radiance(texel, radiance * (1.0 + (gain - 1.0) * degree));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::PI;

    use glam::Vec2;
    use mr360_protocol::light::Lift;
    use mr360_protocol::video::{StereoLayout, Transfer};
    use mr360_shaders::colour::radiance_from_code;
    use mr360_shaders::equirect::direction_from_uv;
    use mr360_shaders::sh;

    use super::*;
    use crate::frame::{Frame, Pixels};
    use crate::lighting::sampling::Grid;
    use crate::lighting::{Directional, LightMethod, StepTimes};

    #[test]
    fn what_the_ground_shows_goes_to_the_clipped_texels_of_the_sky_alone() {
        let (width, luma, white) = (32, Vec3::splat(1.0 / 3.0), 10.0);
        let mut panorama = Panorama::new(Grid { width, height: 16, supersample: 1 }, Lift::Linear);
        let sines: Vec<f32> = panorama.geometry.sin_cos_latitude.iter().map(|(sine, _)| *sine).collect();
        for texel in 0..32 * 16 {
            // Sky, what stands on the horizon, ground.
            let sine = sines[texel / 32];
            panorama.set_radiance(
                texel,
                Vec3::splat(if sine > 0.0 {
                    1.0
                } else if sine > -GROUND_SINE {
                    50.0
                } else {
                    0.5
                }),
            );
        }
        let (clipped, nearly, bright, puddle) = (70, 75, 80, 400);
        for (texel, radiance) in [(clipped, white), (nearly, 0.8 * white), (bright, 0.6 * white), (puddle, white)] {
            panorama.set_radiance(texel, Vec3::splat(radiance));
        }
        let sum = |panorama: &Panorama, rows: &dyn Fn(f32) -> bool, of: &dyn Fn(f32) -> f32| -> f64 {
            let weigh = |row: usize| f64::from(panorama.geometry.solid_angle_sr[row] * sines[row].abs());
            (0..16)
                .filter(|row| rows(sines[*row]))
                .map(|row| panorama.row(0, row).iter().map(|y| f64::from(of(*y))).sum::<f64>() * weigh(row))
                .sum()
        };
        let ground = |sine: f32| sine < -0.25;
        let explained = std::f64::consts::PI * sum(&panorama, &ground, &|y| y) / sum(&panorama, &ground, &|_| 1.0) / 0.3;
        let before = sum(&panorama, &|sine| sine > 0.0, &|y| y);
        assert!(explained > 1.2 * before && explained < 4.0 * before, "{explained} {before}");
        recover(&mut panorama, white, luma);
        let after = sum(&panorama, &|sine| sine > 0.0, &|y| y);
        assert!((after / explained - 1.0).abs() < 1e-4, "{after} against {explained}");
        let at = |texel: usize| panorama.radiance(texel).x;
        assert!(at(clipped) > white && (at(nearly) / at(clipped) - 0.8).abs() < 1e-5);
        assert_eq!([at(bright), at(puddle), at(0)], [0.6 * white, white, 1.0]);
    }

    const SKY: f32 = 0.12;
    const GROUND: f32 = 0.3;
    const WHITE: f32 = 6.5;
    /// Irradiance of the sky, by the texels' centres good to 1e-4, and what the ground explains, but for the limit.
    const FROM_SKY: f64 = std::f64::consts::PI * SKY as f64;
    const EXPLAINED: f64 = MOST_GAIN * FROM_SKY;

    /// Irradiance of the upper hemisphere on level ground, and on surfaces that face each texel of `patch`, once this many texels of a row
    /// are made that bright and the panorama recovered.
    fn recovered(row: usize, texels: usize, luminance: f32) -> (f64, f64) {
        let mut panorama = Panorama::new(Grid { width: 512, height: 256, supersample: 1 }, Lift::Linear);
        for texel in 0..512 * 256 {
            panorama.set_radiance(texel, Vec3::splat(if texel < 512 * 128 { SKY } else { GROUND }));
        }
        (0..texels).for_each(|column| panorama.set_radiance(row * 512 + column, Vec3::splat(luminance)));
        recover(&mut panorama, WHITE, Vec3::splat(1.0 / 3.0));
        let of_row = |row: usize| -> f64 {
            let sum: f64 = panorama.row(0, row).iter().map(|y| f64::from(*y)).sum();
            sum * f64::from(panorama.geometry.solid_angle_sr[row])
        };
        let up = (0..128).map(|row| of_row(row) * f64::from(panorama.geometry.sin_cos_latitude[row].0)).sum();
        let patch: f64 = panorama.row(0, row)[..texels].iter().map(|y| f64::from(*y)).sum();
        (up, patch * f64::from(panorama.geometry.solid_angle_sr[row]))
    }

    #[test]
    fn a_texel_or_two_gain_little_and_a_sun_all_that_is_missing() {
        // 40° up, where a texel is three quarters as wide as on the horizon.
        let up: Vec<f64> = (0..64).map(|texels| recovered(70, texels, WHITE).0).collect();
        assert!((up[0] / FROM_SKY - 1.0).abs() < 1e-3, "{}", up[0]);
        assert!(up[1] / up[0] < 1.05 && up[2] / up[0] < 1.15, "{:?}", &up[..4]);
        // The limit is five times what the frame shows, and clipped texels are part of that.
        assert!(up[63] >= EXPLAINED && up[63] < 1.2 * EXPLAINED, "{}", up[63]);
        // The ramp's steepest is 1.5, over 21 texels of this row.
        assert!(up.windows(2).all(|pair| pair[1] >= pair[0] && pair[1] - pair[0] < 0.08 * EXPLAINED), "{up:?}");
    }

    #[test]
    fn no_texel_makes_a_step_when_it_comes_to_be_clipped() {
        let up: Vec<f64> = (0..=120).map(|i| recovered(70, 64, WHITE * (0.55 + 0.0025 * i as f32)).0).collect();
        let steps = up.windows(2).map(|pair| pair[1] - pair[0]);
        // A third of the degree's rise is enough of 64 texels: 27 steps, none more than three times as high as all alike.
        assert!(steps.clone().all(|step| (0.0..3.0 / 27.0 * EXPLAINED).contains(&step)), "{:?}", steps.collect::<Vec<_>>());
        assert!(up[120] > 4.0 * up[0], "{} {}", up[0], up[120]);
    }

    #[test]
    fn a_low_light_is_given_no_more_than_the_sun_could_give() {
        // 1.8° up, what reaches level ground is a thirtieth of what the light would have to have.
        let (up, facing) = recovered(125, 64, WHITE);
        assert!(facing < MOST_BEAM * 1.2 * EXPLAINED && up < 0.5 * EXPLAINED, "{up} {facing}");
        // 40° up nothing is in the way.
        let (up, facing) = recovered(70, 64, WHITE);
        assert!(facing > 0.7 * EXPLAINED && up >= EXPLAINED, "{up} {facing}");
    }

    /// A clipped sun in an even sky over ground that shows what it really gave.
    fn clipped_sun(ground: f32) -> (Frame, f32) {
        let (sky_code, elevation) = (0.4f32, 40.0f32.to_radians());
        let sun = direction_from_uv(Vec2::new(0.6, 0.5 - elevation / PI));
        let texels = (0..256)
            .flat_map(|j| (0..512).map(move |i| direction_from_uv(Vec2::new((i as f32 + 0.5) / 512.0, (j as f32 + 0.5) / 256.0))))
            .map(|d| {
                let code = if d.y <= 0.0 {
                    ground.powf(1.0 / 2.4)
                } else if d.dot(sun) > 4.0f32.to_radians().cos() {
                    1.0
                } else {
                    sky_code
                };
                [code; 3]
            })
            .collect();
        let frame = Frame {
            pts_us: 0,
            stereo: StereoLayout::Mono,
            pixels: Pixels::Rgb { width: 512, height: 256, texels, transfer: Transfer::Bt709 },
        };
        (frame, elevation.sin())
    }

    #[test]
    fn a_clipped_sun_is_recovered_from_the_ground() {
        let sky = PI * radiance_from_code(Lift::Highlights, Default::default(), Vec3::splat(0.4)).x;
        let sun_on_ground = 1.5;
        // Ground of the albedo that the method assumes.
        let (frame, sine) = clipped_sun(0.3 / PI * (sky + sun_on_ground));
        let mut method = Directional::default();
        let estimate = method.estimate(&frame, &mut StepTimes::default()).unwrap();
        assert_eq!(estimate.lights.len(), 1);
        let found = estimate.lights[0].irradiance.y * sine;
        // Less what of the disc lies below the threshold of μ + 2σ and stays in the SH, a tenth here.
        assert!((found / sun_on_ground - 0.9).abs() < 0.03, "{found}");
        let total = sh::irradiance(&estimate.sh, Vec3::Y).y + found;
        // Nine SH hold the level irradiance of a half space exactly; the tenth of the sun that is theirs comes 5 % low.
        assert!((total / (sky + sun_on_ground) - 1.0).abs() < 0.01, "{total}");
    }

    #[test]
    fn a_dark_ground_recovers_nothing_and_a_bright_one_has_a_limit() {
        let up = |ground: f32| {
            let (frame, sine) = clipped_sun(ground);
            let mut method = Directional::default();
            let estimate = method.estimate(&frame, &mut StepTimes::default()).unwrap();
            estimate.lights.iter().map(|light| light.irradiance.y * sine).sum::<f32>()
        };
        let (dark, dim, bright, white) = (up(0.0), up(0.01), up(0.5), up(0.95));
        assert_eq!(dark, dim);
        assert!(bright > 4.0 * dark && white <= bright * 2.0, "{dark} {bright} {white}");
    }
}
