//! Every method against panoramas whose light is known in closed form.
//!
//! What a light leaves behind, below the threshold, is given by nine SH, and those give light from one direction not the clamped
//! cosine but [`nine_sh`]. That is all that parts the estimates here from the truth, so both are asserted: the truth to
//! a percent, and the truth with that difference put in to a fraction of it.

use std::f32::consts::PI;

use glam::{DVec3, Vec2, Vec3};
use mr360_protocol::light::{DirectionalLight, Lift, MAX_LIGHTS};
use mr360_protocol::video::{StereoLayout, Transfer};
use mr360_shaders::colour::radiance_from_code;
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};
use mr360_shaders::sh;

use super::sequences::Noise;
use super::{Directional, Estimate, Iorns, LightMethod, MOST_LIGHTS, Mr360, StepTimes};
use crate::frame::{Frame, Pixels};

const WIDTH: u32 = 1200;
const HEIGHT: u32 = 600;

/// A disc of even radiance.
#[derive(Clone, Copy)]
pub(super) struct Disc {
    pub(super) centre: Vec3,
    pub(super) radius: f32,
    pub(super) radiance: Vec3,
}

impl Disc {
    pub(super) fn at(longitude_deg: f32, latitude_deg: f32, radius_deg: f32, radiance: Vec3) -> Self {
        let centre = direction_from_uv(Vec2::new(longitude_deg / 360.0 + 0.5, 0.5 - latitude_deg / 180.0));
        Self { centre, radius: radius_deg.to_radians(), radiance }
    }

    /// Irradiance on a surface facing the disc: π L sin² r.
    pub(super) fn irradiance(self) -> Vec3 {
        self.radiance * PI * self.radius.sin().powi(2)
    }

    /// Share of the upper half's pixels: an equirect picture stretches a row by 1 / cos φ.
    fn share_of_pixels(self) -> f32 {
        self.solid_angle_sr() / (self.centre.y.asin().cos() * PI * PI)
    }

    /// Share of the upper hemisphere's solid angle.
    fn share_of_sky(self) -> f32 {
        self.solid_angle_sr() / (2.0 * PI)
    }

    pub(super) fn solid_angle_sr(self) -> f32 {
        2.0 * PI * (1.0 - self.radius.cos())
    }
}

/// Discs over an even background, later ones over earlier, each pixel near a disc the average of 4×64 points: at the zenith a rim runs along
/// the rows.
pub(super) fn sky(transfer: Transfer, background: Vec3, discs: &[Disc]) -> Frame {
    let direction = |x: f32, y: f32| direction_from_uv(Vec2::new(x / WIDTH as f32, y / HEIGHT as f32));
    let texels = (0..HEIGHT)
        .flat_map(|j| (0..WIDTH).map(move |i| (i as f32, j as f32)))
        .map(|(i, j)| {
            let centre = direction(i + 0.5, j + 0.5);
            // A pixel is at most 0.3° wide: only those near a rim need more than their centre.
            let near = |disc: &&Disc| (centre - disc.centre).length() < disc.radius + 0.01;
            // A point stands for an area that shrinks towards the pole.
            let points = (0..256).map(|k| direction(i + ((k % 4) as f32 + 0.5) / 4.0, j + ((k / 4) as f32 + 0.5) / 64.0));
            let over = |below: Vec3, disc: &Disc| {
                let (mut inside, mut all) = (0.0, 0.0);
                for point in points.clone() {
                    let area = point.x.hypot(point.z);
                    all += area;
                    inside += if (point - disc.centre).length() < 2.0 * (disc.radius / 2.0).sin() { area } else { 0.0 };
                }
                // Codes on the rim that are averages would be lifted as such: the truth is known for hard rims only.
                let covered = inside / all;
                below.lerp(disc.radiance, if transfer == Transfer::Linear { covered } else { covered.round() })
            };
            discs.iter().filter(near).fold(background, over).to_array()
        })
        .collect();
    frame(WIDTH, HEIGHT, transfer, texels)
}

pub(super) fn frame(width: u32, height: u32, transfer: Transfer, texels: Vec<[f32; 3]>) -> Frame {
    Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Rgb { width, height, texels, transfer } }
}

fn conserving() -> [Box<dyn LightMethod>; 3] {
    [Box::new(Directional::default()), Box::new(Mr360::new(false)), Box::new(Iorns::default())]
}

fn with_lights() -> [Box<dyn LightMethod>; 2] {
    [Box::new(Directional::default()), Box::new(Mr360::new(false))]
}

pub(super) fn estimate(method: &mut dyn LightMethod, frame: &Frame) -> Estimate {
    let estimate = method.estimate(frame, &mut StepTimes::default()).unwrap().clone();
    assert!([9, 25].contains(&estimate.sh.len()) && estimate.sh.iter().all(|c| c.is_finite()), "{}: {:?}", method.name(), estimate.sh);
    for light in &estimate.lights {
        assert!(light.irradiance.is_finite() && light.irradiance.min_element() >= 0.0, "{light:?}");
        assert!((light.direction.length() - 1.0).abs() < 1e-4 && light.solid_angle_sr > 0.0, "{light:?}");
    }
    assert!(estimate.lights.len() <= MAX_LIGHTS && estimate.lights.iter().zip(0..).all(|(light, rank)| light.id == rank), "{estimate:?}");
    estimate
}

/// Irradiance of lights and SH on a surface.
pub(super) fn irradiance(estimate: &Estimate, normal: Vec3) -> Vec3 {
    let direct: Vec3 = estimate.lights.iter().map(|light| light.irradiance * light.direction.dot(normal).max(0.0)).sum();
    direct + sh::irradiance(&estimate.sh, normal)
}

/// Energy over the whole sphere: the lights' irradiance and the SH's mean times 4π.
pub(super) fn energy(estimate: &Estimate) -> DVec3 {
    let lights: DVec3 = estimate.lights.iter().map(|light| light.irradiance.as_dvec3()).sum();
    lights + estimate.sh[0].as_dvec3() * (4.0 * std::f64::consts::PI).sqrt()
}

/// Energy over the whole sphere of a frame of linear radiance.
fn energy_of(frame: &Frame) -> DVec3 {
    let Pixels::Rgb { width, height, texels, .. } = &frame.pixels else { unreachable!() };
    let solid_angle_sr: Vec<f64> = (0..*height).map(|row| pixel_solid_angle_sr(row, *width, *height).into()).collect();
    texels.iter().enumerate().map(|(i, texel)| Vec3::from_array(*texel).as_dvec3() * solid_angle_sr[i / *width as usize]).sum()
}

/// Lights and SH together hold the energy of the frame, whatever was clipped, blurred or cut off on the way.
pub(super) fn assert_conserved(estimate: &Estimate, frame: &Frame) {
    let truth = energy_of(frame);
    // Rows are summed in single precision.
    let error = ((energy(estimate) - truth) / truth.max(DVec3::splat(1e-9))).abs().max_element();
    assert!(error < 1e-5, "{error}: {} against {truth}", energy(estimate));
}

/// Irradiance of bands 0–2 of unit light from one direction, at the cosine `c` to the normal: Σ A_l (2l+1)/4π P_l(c). On a
/// surface that faces the light it is 1/16 too much, at most 3/32 too much on any other and 0.04 too little.
pub(super) fn nine_sh(c: f32) -> f32 {
    0.25 + 0.5 * c + 5.0 / 32.0 * (3.0 * c * c - 1.0)
}

/// What band 4 adds to that: A_4 9/4π P_4(c). Band 3 gives none.
fn fourth_band(c: f32) -> f32 {
    let c2 = c * c;
    -3.0 / 256.0 * (35.0 * c2 * c2 - 30.0 * c2 + 3.0)
}

/// μ + 2σ of the luminance of a black sky of which the discs fill these shares.
fn two_deviations(discs: &[(f32, f32)]) -> f32 {
    let mean: f32 = discs.iter().map(|(share, luminance)| share * luminance).sum();
    let square: f32 = discs.iter().map(|(share, luminance)| share * luminance * luminance).sum();
    mean + 2.0 * (square - mean * mean).sqrt()
}

/// Normals all over the sphere: a golden spiral.
pub(super) fn normals() -> impl Iterator<Item = Vec3> {
    (0..300).map(|i| {
        let y = 1.0 - (i as f32 + 0.5) / 150.0;
        let (sin, cos) = (i as f32 * 2.399_963_2).sin_cos();
        Vec3::new(sin * (1.0 - y * y).sqrt(), y, cos * (1.0 - y * y).sqrt())
    })
}

/// Asserts the irradiance of discs on black, in parts of the strongest disc's: within 1 % of the truth on every surface, and
/// within 0.3 % of the truth whose part below the threshold went through the SH. The 0.3 % are for what blur and
/// rims take off the threshold's σ, a fifth of it for discs of five texels across, and for the frame's own rims.
fn assert_irradiance(method: &dyn LightMethod, estimate: &Estimate, discs: &[Disc]) {
    let weigh = |disc: &Disc| (if method.name() == "mr360" { disc.share_of_pixels() } else { disc.share_of_sky() }, disc.radiance.y);
    // Discs of one frame have one hue, so their green stands for their luminance.
    let threshold = two_deviations(&discs.iter().map(weigh).collect::<Vec<_>>());
    let scale = discs.iter().map(|disc| disc.irradiance()).fold(Vec3::ZERO, Vec3::max);
    for normal in normals().chain([Vec3::Y]).chain(discs.iter().map(|disc| disc.centre)) {
        // A surface whose horizon cuts a disc sees a part of it: no closed form as short as the others.
        if discs.iter().any(|disc| disc.centre.dot(normal).abs() <= disc.radius.sin()) {
            continue;
        }
        let (mut truth, mut direct, mut through_sh) = (Vec3::ZERO, Vec3::ZERO, Vec3::ZERO);
        for disc in discs {
            let (c, below) = (disc.centre.dot(normal), threshold / disc.radiance.y);
            truth += disc.irradiance() * c.max(0.0);
            direct += disc.irradiance() * (1.0 - below) * c.max(0.0);
            let fourth = if estimate.sh.len() > 9 { fourth_band(c) } else { 0.0 };
            through_sh += disc.irradiance() * below * (nine_sh(c) + fourth);
        }
        let got = irradiance(estimate, normal);
        let expected = direct + through_sh.max(Vec3::ZERO);
        let context = || format!("{} {normal}: {got}, expected {expected}, truth {truth}, scale {scale}, {estimate:?}", method.name());
        assert!(((got - truth) / scale).abs().max_element() < 0.01, "{}", context());
        assert!(((got - expected) / scale).abs().max_element() < 0.003, "{}", context());
    }
}

/// Irradiance-weighted mean direction of some lights.
fn mean_direction<'a>(lights: impl IntoIterator<Item = &'a DirectionalLight>) -> Vec3 {
    lights.into_iter().map(|light| light.direction * light.irradiance.y).sum::<Vec3>().normalize()
}

pub(super) fn degrees(a: Vec3, b: Vec3) -> f32 {
    2.0 * ((a - b).length() / 2.0).asin().to_degrees()
}

pub(super) fn relative(got: Vec3, expected: Vec3) -> f32 {
    ((got - expected) / expected).abs().max_element()
}

pub(super) const SUN: Vec3 = Vec3::new(4000.0, 3500.0, 2500.0);

#[test]
fn one_disc_on_black() {
    for (longitude, latitude, radius) in [(40.0, 50.0, 1.0), (-120.3, 20.7, 2.5), (0.0, 35.0, 0.5)] {
        let disc = Disc::at(longitude, latitude, radius, SUN);
        let frame = sky(Transfer::Linear, Vec3::ZERO, &[disc]);
        for mut method in with_lights() {
            let estimate = estimate(method.as_mut(), &frame);
            let context = format!("{} {longitude} {latitude} {radius}: {estimate:?}", method.name());
            assert_eq!(estimate.lights.len(), 1, "{context}");
            assert!(degrees(estimate.lights[0].direction, disc.centre) < 0.5, "{context}");
            assert_irradiance(method.as_ref(), &estimate, &[disc]);
            assert_conserved(&estimate, &frame);
            // Rims spread by a texel of 0.6° to 0.7° on each side; one that is hardly covered counts whole for the paper.
            let widened = Disc { radius: disc.radius + 0.012, ..disc }.solid_angle_sr();
            assert!((disc.solid_angle_sr()..widened).contains(&estimate.lights[0].solid_angle_sr), "{context}");
        }
    }
}

#[test]
fn one_clipped_disc_on_black_has_the_lifted_irradiance() {
    let white = radiance_from_code(Lift::InverseToneMap, mr360_protocol::video::Colour::default(), Vec3::Y, Vec3::ONE);
    assert!((white - 11.8).abs().max_element() < 1e-4);
    for (mut method, boost) in [(Mr360::new(false), 1.0), (Mr360::new(true), 1.5)] {
        let disc = Disc::at(70.0, 40.0, 2.0, Vec3::ONE);
        let estimate = estimate(&mut method, &sky(Transfer::Srgb, Vec3::ZERO, &[disc]));
        assert_eq!((estimate.lights.len(), estimate.lift), (1, Lift::InverseToneMap));
        assert!(degrees(estimate.lights[0].direction, disc.centre) < 0.5);
        let lifted = Disc { radiance: white, ..disc };
        if boost == 1.0 {
            assert!(relative(irradiance(&estimate, disc.centre), lifted.irradiance()) < 0.01, "{estimate:?}");
        }
        let plain = self::estimate(&mut Mr360::new(false), &sky(Transfer::Srgb, Vec3::ZERO, &[disc]));
        assert!(relative(estimate.lights[0].irradiance, plain.lights[0].irradiance * boost) < 1e-5);
    }
}

#[test]
fn two_suns() {
    let discs = [Disc::at(-60.0, 30.0, 1.5, SUN), Disc::at(100.0, 55.0, 1.5, 0.6 * SUN)];
    let frame = sky(Transfer::Linear, Vec3::ZERO, &discs);
    for mut method in with_lights() {
        let estimate = estimate(method.as_mut(), &frame);
        assert_eq!(estimate.lights.iter().map(|light| light.id).collect::<Vec<_>>(), [0, 1], "{}: {estimate:?}", method.name());
        for (light, disc) in estimate.lights.iter().zip(discs) {
            assert!(degrees(light.direction, disc.centre) < 0.5, "{}: {light:?}", method.name());
        }
        assert_irradiance(method.as_ref(), &estimate, &discs);
        assert_conserved(&estimate, &frame);
    }
}

#[test]
fn sun_on_the_seam() {
    // The paper's search does not wrap: it sees one sun on either side. The last one's sliver beyond the seam, 3 % of it, is
    // cut off as a weak light and goes to the SH.
    for (longitude, papers_lights) in [(180.0, 2), (179.6, 2), (-178.9, 2), (-177.9, 1)] {
        let disc = Disc::at(longitude, 35.0, 2.0, SUN);
        let frame = sky(Transfer::Linear, Vec3::ZERO, &[disc]);
        for (mut method, lights) in with_lights().into_iter().zip([1, papers_lights]) {
            let estimate = estimate(method.as_mut(), &frame);
            assert_eq!(estimate.lights.len(), lights, "{} {longitude}: {estimate:?}", method.name());
            assert!(degrees(mean_direction(&estimate.lights), disc.centre) < 0.5, "{} {longitude}: {estimate:?}", method.name());
            assert_irradiance(method.as_ref(), &estimate, &[disc]);
            assert_conserved(&estimate, &frame);
        }
    }
}

#[test]
fn sun_at_the_zenith() {
    // The paper's method has its own closed forms there: `paper_forms`.
    for (latitude, longitude) in [(90.0, 0.0), (89.0, 60.0), (88.0, -150.0)] {
        let disc = Disc::at(longitude, latitude, 2.5, SUN);
        let frame = sky(Transfer::Linear, Vec3::ZERO, &[disc]);
        let mut method = Directional::default();
        let estimate = estimate(&mut method, &frame);
        assert_eq!(estimate.lights.len(), 1, "{estimate:?}");
        assert!(degrees(estimate.lights[0].direction, disc.centre) < 0.5, "{estimate:?}");
        assert_irradiance(&method, &estimate, &[disc]);
        assert_conserved(&estimate, &frame);
    }
}

#[test]
fn luminance_ranks_lights_and_not_radiance() {
    // Luminance falls from disc to disc with either weights; the sum of the channels rises.
    let colours = [Vec3::new(0.0, 1000.0, 0.0), Vec3::new(1500.0, 0.0, 0.0), Vec3::new(0.0, 0.0, 2500.0)];
    let discs = [-100.0, 20.0, 110.0].into_iter().zip(colours).map(|(longitude, colour)| Disc::at(longitude, 40.0, 1.5, colour));
    let discs: Vec<Disc> = discs.collect();
    let frame = sky(Transfer::Linear, Vec3::ZERO, &discs);
    for mut method in with_lights() {
        let estimate = estimate(method.as_mut(), &frame);
        assert_eq!(estimate.lights.len(), 3, "{}: {estimate:?}", method.name());
        for (light, disc) in estimate.lights.iter().zip(&discs) {
            assert!(degrees(light.direction, disc.centre) < 0.5, "{}: {estimate:?}", method.name());
            let hue = light.irradiance / disc.irradiance().max_element();
            // Each keeps its hue. μ + 2σ is a sixth of the darkest, and its rim's texels keep as much, too.
            assert!((hue - disc.radiance / disc.radiance.max_element()).abs().max_element() < 0.3, "{}: {light:?}", method.name());
        }
        assert_conserved(&estimate, &frame);
    }
}

#[test]
fn a_halo_counts_by_its_light_or_by_its_size() {
    let (halo, sun) = (Disc::at(30.0, 40.0, 6.0, 0.3 * SUN), Disc::at(30.0, 40.0, 2.0, SUN));
    let frame = sky(Transfer::Linear, Vec3::ZERO, &[halo, sun]);
    let ring_sr = halo.solid_angle_sr() - sun.solid_angle_sr();
    let threshold = two_deviations(&[(sun.share_of_sky(), 1.0), (ring_sr / (2.0 * PI), 0.3)]);
    let (inner, outer) = ((1.0 - threshold) * sun.solid_angle_sr(), (0.3 - threshold) * ring_sr);
    // The default's is that of an even disc which spreads the light as widely, (Σ E)² / Σ E²/Ω; the paper's is the region's own.
    let even = (inner + outer).powi(2) / (inner * (1.0 - threshold) + outer * (0.3 - threshold));
    for (mut method, expected) in with_lights().into_iter().zip([even, halo.solid_angle_sr()]) {
        let estimate = estimate(method.as_mut(), &frame);
        assert_eq!(estimate.lights.len(), 1, "{}: {estimate:?}", method.name());
        // A rim of half a texel is 0.35° of 6° of radius.
        assert!((estimate.lights[0].solid_angle_sr / expected - 1.0).abs() < 0.12, "{} {expected}: {estimate:?}", method.name());
        assert_conserved(&estimate, &frame);
    }
}

#[test]
fn light_from_below_is_ambient() {
    let discs = [Disc::at(20.0, 40.0, 1.5, SUN), Disc::at(-70.0, -30.0, 4.0, 2.0 * SUN)];
    let frame = sky(Transfer::Linear, Vec3::ZERO, &discs);
    for mut method in with_lights() {
        let estimate = estimate(method.as_mut(), &frame);
        assert_eq!(estimate.lights.len(), 1, "{}: {estimate:?}", method.name());
        assert!(degrees(estimate.lights[0].direction, discs[0].centre) < 0.5, "{}: {estimate:?}", method.name());
        // The threshold is the upper sky's alone: μ + 2σ of one sun is 4 % of it, which texels on the rim keep, too.
        assert!(relative(estimate.lights[0].irradiance, discs[0].irradiance()) < 0.07, "{}: {estimate:?}", method.name());
        assert_conserved(&estimate, &frame);
    }
}

#[test]
fn uniform_sky_is_ambient_alone() {
    for transfer in [Transfer::Linear, Transfer::Srgb] {
        let code = Vec3::new(0.7, 0.6, 0.5);
        let frame = sky(transfer, code, &[]);
        for mut method in conserving() {
            let estimate = estimate(method.as_mut(), &frame);
            let colour = mr360_protocol::video::Colour { transfer, ..Default::default() };
            let radiance = radiance_from_code(estimate.lift, colour, Vec3::Y, code);
            match (transfer, method.name()) {
                (Transfer::Linear, _) => assert_eq!(estimate.lift, Lift::Linear),
                (_, "directional") => assert!(matches!(estimate.lift, Lift::Recovered(_)), "{:?}", estimate.lift),
                (_, name) => assert_eq!(estimate.lift, Lift::InverseToneMap, "{name}"),
            }
            assert!(estimate.lights.is_empty(), "{} {transfer:?}: {:?}", method.name(), estimate.lights);
            for normal in [Vec3::X, Vec3::Y, Vec3::NEG_Z, Vec3::ONE.normalize()] {
                // Half a table step of the lift is 0.25 %; 32 rows at their centres leave 0.3 % of radiance in band 2.
                let tolerance = if transfer == Transfer::Linear { 1e-3 } else { 4e-3 };
                assert!(relative(irradiance(&estimate, normal), radiance * PI) < tolerance, "{} {transfer:?}: {estimate:?}", method.name());
                assert!(relative(sh::radiance(&estimate.sh, normal), radiance) < tolerance + 3e-3, "{} {transfer:?}", method.name());
            }
        }
    }
}

#[test]
fn black_frame_is_dark() {
    for (width, height) in [(WIDTH, HEIGHT), (1, 1)] {
        for transfer in [Transfer::Linear, Transfer::Srgb, Transfer::Pq, Transfer::Hlg, Transfer::Bt709] {
            let frame = frame(width, height, transfer, vec![[0.0; 3]; (width * height) as usize]);
            for mut method in conserving() {
                let estimate = estimate(method.as_mut(), &frame);
                assert!(estimate.lights.is_empty() && estimate.sh.iter().all(|c| c.abs().max_element() < 1e-6), "{estimate:?}");
            }
        }
    }
}

#[test]
fn energy_is_conserved_on_random_panoramas() {
    for seed in 1..12u64 {
        let mut noise = Noise(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let (width, height) = [(256, 128), (333, 167), (64, 32), (1024, 512)][seed as usize % 4];
        // Mostly dim, now and then up to thousands: hundreds of lights for the paper, cut at 90 %.
        let texels: Vec<[f32; 3]> = (0..width * height)
            .map(|_| {
                let peak = if noise.next() > 0.995 { 10f32.powf(noise.next() * 4.0) } else { 1.0 };
                std::array::from_fn(|_| noise.next() * peak)
            })
            .collect();
        let frame = frame(width, height, Transfer::Linear, texels);
        for mut method in conserving() {
            let estimate = estimate(method.as_mut(), &frame);
            assert_conserved(&estimate, &frame);
        }
    }
}

#[test]
fn size_dependent_intensity_leaves_hdr_alone() {
    let frame = sky(Transfer::Linear, Vec3::splat(0.1), &[Disc::at(10.0, 45.0, 3.0, SUN)]);
    assert_eq!(estimate(&mut Mr360::new(true), &frame), estimate(&mut Mr360::new(false), &frame));
}

#[test]
fn flat_noisy_sky_has_no_light() {
    for (deviation, transfer) in [(0.01, Transfer::Srgb), (0.05, Transfer::Srgb), (0.3, Transfer::Linear)] {
        let mut noise = Noise(77);
        let texels =
            (0..WIDTH * HEIGHT).map(|_| [0.6 + deviation * ((0..4).map(|_| noise.next()).sum::<f32>() - 2.0) * 3f32.sqrt(); 3]).collect();
        let estimate = estimate(&mut Directional::default(), &frame(WIDTH, HEIGHT, transfer, texels));
        assert!(estimate.lights.is_empty(), "{deviation}: {:?}", estimate.lights);
    }
}

#[test]
fn overcast_gradient_has_no_light() {
    // CIE standard overcast sky: three times as bright at the zenith as at the horizon.
    let texels = (0..HEIGHT)
        .flat_map(|j| (0..WIDTH).map(move |_| j))
        .map(|j| [if j < HEIGHT / 2 { (1.0 + 2.0 * ((0.5 - (j as f32 + 0.5) / HEIGHT as f32) * PI).sin()) / 3.0 } else { 0.1 }; 3])
        .collect();
    let estimate = estimate(&mut Directional::default(), &frame(WIDTH, HEIGHT, Transfer::Linear, texels));
    assert!(estimate.lights.is_empty(), "{:?}", estimate.lights);
}

#[test]
fn clipped_sky_keeps_its_light_where_the_papers_threshold_loses_it() {
    // Discs of 37°, 53° and 66° radius fill 0.2, 0.4 and 0.6 of the hemisphere.
    for radius in [37.0, 53.2, 66.5] {
        let disc = Disc::at(30.0, 90.0, radius, Vec3::ONE);
        let estimate = estimate(&mut Directional::default(), &sky(Transfer::Srgb, Vec3::splat(0.3), &[disc]));
        assert_eq!(estimate.lights.len(), 1, "{radius}");
        assert!(degrees(estimate.lights[0].direction, Vec3::Y) < 0.5, "{radius}");
    }
}

#[test]
fn impossible_pixels_leave_the_light_finite() {
    let mut frame = sky(Transfer::Linear, Vec3::splat(0.2), &[Disc::at(10.0, 45.0, 3.0, SUN)]);
    let Pixels::Rgb { texels, .. } = &mut frame.pixels else { unreachable!() };
    for (i, bad) in [f32::NAN, f32::NEG_INFINITY, -3.0, f32::INFINITY].into_iter().enumerate() {
        texels[90_000 + 777 * i] = [bad, 0.2, bad];
    }
    for mut method in conserving() {
        // The second time, too: faults are a frame's own.
        assert_eq!([(); 2].map(|()| estimate(method.as_mut(), &frame).mended), [8; 2], "{}", method.name());
    }
}

#[test]
fn lights_are_few_ranked_and_from_above() {
    let mut discs: Vec<Disc> = (0..12).map(|i| Disc::at(i as f32 * 30.0 - 165.0, 40.0, 2.0, SUN * (1.0 + i as f32 * 0.05))).collect();
    discs.push(Disc::at(0.0, -30.0, 6.0, SUN));
    let estimate = estimate(&mut Directional::default(), &sky(Transfer::Linear, Vec3::ZERO, &discs));
    assert_eq!(estimate.lights.len(), MOST_LIGHTS);
    assert!(estimate.lights.windows(2).all(|pair| pair[0].irradiance.y >= pair[1].irradiance.y && pair[0].id < pair[1].id));
    assert!(estimate.lights.iter().all(|light| light.direction.y > 0.0));
    assert!(degrees(estimate.lights[0].direction, discs[11].centre) < 0.5);
}

#[test]
fn frames_do_not_remember_each_other() {
    let sun = sky(Transfer::Linear, Vec3::splat(0.1), &[Disc::at(10.0, 45.0, 3.0, SUN)]);
    let code = sky(Transfer::Srgb, Vec3::splat(0.4), &[Disc::at(-90.0, 20.0, 5.0, Vec3::ONE)]);
    for mut method in conserving() {
        let first = estimate(method.as_mut(), &sun);
        let other = estimate(method.as_mut(), &code);
        assert!(first != other && first == estimate(method.as_mut(), &sun), "{}", method.name());
    }
}
