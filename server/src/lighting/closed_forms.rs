//! Every method against panoramas whose light is known in closed form.

use std::f32::consts::PI;

use glam::{DVec3, Vec2, Vec3};
use mr360_protocol::light::{DirectionalLight, Lift};
use mr360_protocol::video::{StereoLayout, Transfer};
use mr360_shaders::colour::radiance_from_code;
use mr360_shaders::equirect::{direction_from_uv, pixel_solid_angle_sr};
use mr360_shaders::sh;

use super::{Directional, Estimate, Iorns, LightMethod, MOST_LIGHTS, Mr360, StepTimes};
use crate::frame::{Frame, Pixels};

const WIDTH: u32 = 1200;
const HEIGHT: u32 = 600;

/// A disc of even radiance.
#[derive(Clone, Copy)]
struct Disc {
    centre: Vec3,
    radius: f32,
    radiance: Vec3,
}

impl Disc {
    fn at(longitude_deg: f32, latitude_deg: f32, radius_deg: f32, radiance: Vec3) -> Self {
        let centre = direction_from_uv(Vec2::new(longitude_deg / 360.0 + 0.5, 0.5 - latitude_deg / 180.0));
        Self { centre, radius: radius_deg.to_radians(), radiance }
    }

    /// Irradiance on a surface facing the disc: π L sin² r.
    fn irradiance(self) -> Vec3 {
        self.radiance * PI * self.radius.sin().powi(2)
    }

    fn solid_angle_sr(self) -> f32 {
        2.0 * PI * (1.0 - self.radius.cos())
    }
}

/// Discs over an even background, each pixel near a disc the average of 4×64 points: at the zenith a rim runs along
/// the rows.
fn sky(transfer: Transfer, background: Vec3, discs: &[Disc]) -> Frame {
    let direction = |x: f32, y: f32| direction_from_uv(Vec2::new(x / WIDTH as f32, y / HEIGHT as f32));
    let texels = (0..HEIGHT)
        .flat_map(|j| (0..WIDTH).map(move |i| (i as f32, j as f32)))
        .map(|(i, j)| {
            let centre = direction(i + 0.5, j + 0.5);
            // A pixel is at most 0.3° wide: only those near a rim need more than their centre.
            let near = |disc: &&Disc| (centre - disc.centre).length() < disc.radius + 0.01;
            let Some(disc) = discs.iter().find(near) else { return background.to_array() };
            let points = (0..256).map(|k| direction(i + ((k % 4) as f32 + 0.5) / 4.0, j + ((k / 4) as f32 + 0.5) / 64.0));
            let inside = points.filter(|d| (*d - disc.centre).length() < 2.0 * (disc.radius / 2.0).sin()).count();
            let covered = inside as f32 / 256.0;
            // Codes on the rim that are averages would be lifted as such: the truth is known for hard rims only.
            let covered = if transfer == Transfer::Linear { covered } else { covered.round() };
            background.lerp(disc.radiance, covered).to_array()
        })
        .collect();
    frame(WIDTH, HEIGHT, transfer, texels)
}

fn frame(width: u32, height: u32, transfer: Transfer, texels: Vec<[f32; 3]>) -> Frame {
    Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Rgb { width, height, texels, transfer } }
}

fn conserving() -> [Box<dyn LightMethod>; 3] {
    [Box::new(Directional::default()), Box::new(Mr360::new(false)), Box::new(Iorns::default())]
}

fn with_lights() -> [Box<dyn LightMethod>; 2] {
    [Box::new(Directional::default()), Box::new(Mr360::new(false))]
}

fn estimate(method: &mut dyn LightMethod, frame: &Frame) -> Estimate {
    let estimate = method.estimate(frame, &mut StepTimes::default()).unwrap().clone();
    assert!(estimate.sh.len() == 9 && estimate.sh.iter().all(|c| c.is_finite()), "{}: {:?}", method.name(), estimate.sh);
    for light in &estimate.lights {
        assert!(light.irradiance.is_finite() && light.irradiance.min_element() >= 0.0, "{light:?}");
        assert!((light.direction.length() - 1.0).abs() < 1e-4 && light.solid_angle_sr > 0.0, "{light:?}");
    }
    estimate
}

/// Irradiance of lights and SH on a surface.
fn irradiance(estimate: &Estimate, normal: Vec3) -> Vec3 {
    let direct: Vec3 = estimate.lights.iter().map(|light| light.irradiance * light.direction.dot(normal).max(0.0)).sum();
    direct + sh::irradiance(&estimate.sh, normal)
}

/// Energy over the whole sphere: the lights' irradiance and the SH's mean times 4π.
fn energy(estimate: &Estimate) -> DVec3 {
    let lights: DVec3 = estimate.lights.iter().map(|light| light.irradiance.as_dvec3()).sum();
    lights + estimate.sh[0].as_dvec3() * (4.0 * std::f64::consts::PI).sqrt()
}

/// Irradiance-weighted mean direction of some lights.
fn mean_direction<'a>(lights: impl IntoIterator<Item = &'a DirectionalLight>) -> Vec3 {
    lights.into_iter().map(|light| light.direction * light.irradiance.y).sum::<Vec3>().normalize()
}

fn degrees(a: Vec3, b: Vec3) -> f32 {
    2.0 * ((a - b).length() / 2.0).asin().to_degrees()
}

fn relative(got: Vec3, expected: Vec3) -> f32 {
    ((got - expected) / expected).abs().max_element()
}

const SUN: Vec3 = Vec3::new(4000.0, 3500.0, 2500.0);

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
            // Nine SH give what the threshold leaves of a disc 6 % too much irradiance: 0.6 % of the whole.
            assert!(relative(irradiance(&estimate, disc.centre), disc.irradiance()) < 0.01, "{context}");
            // The light's rim is blurred by a texel of 0.6° to 0.7° on each side.
            let widened = Disc { radius: disc.radius + 0.012, ..disc }.solid_angle_sr();
            assert!((0.5 * disc.solid_angle_sr()..2.0 * widened).contains(&estimate.lights[0].solid_angle_sr), "{context}");
        }
    }
}

#[test]
fn one_clipped_disc_on_black_has_the_lifted_irradiance() {
    let white = radiance_from_code(Lift::InverseToneMap, mr360_protocol::video::Colour::default(), Vec3::ONE);
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
        // On the ground both add up.
        let ground: Vec3 = discs.iter().map(|disc| disc.irradiance() * disc.centre.y).sum();
        assert!(relative(irradiance(&estimate, Vec3::Y), ground) < 0.015, "{}: {estimate:?}", method.name());
    }
}

#[test]
fn sun_on_the_seam() {
    for longitude in [180.0, 179.6, -178.9] {
        let disc = Disc::at(longitude, 35.0, 2.0, SUN);
        let frame = sky(Transfer::Linear, Vec3::splat(0.05), &[disc]);
        for (mut method, lights) in with_lights().into_iter().zip([1, 2]) {
            // The paper's search does not wrap: it sees one sun on either side.
            let estimate = estimate(method.as_mut(), &frame);
            assert_eq!(estimate.lights.len(), if lights == 2 && longitude == -178.9 { estimate.lights.len() } else { lights });
            assert!(degrees(mean_direction(&estimate.lights), disc.centre) < 0.5, "{} {longitude}: {estimate:?}", method.name());
            let expected = disc.irradiance() + 0.05 * PI;
            assert!(relative(irradiance(&estimate, disc.centre), expected) < 0.01, "{} {longitude}: {estimate:?}", method.name());
        }
    }
}

#[test]
fn sun_at_the_zenith() {
    for (latitude, longitude) in [(90.0, 0.0), (89.0, 60.0), (88.0, -150.0)] {
        let disc = Disc::at(longitude, latitude, 2.5, SUN);
        let frame = sky(Transfer::Linear, Vec3::ZERO, &[disc]);
        let ours = estimate(&mut Directional::default(), &frame);
        assert_eq!(ours.lights.len(), 1, "{ours:?}");
        assert!(degrees(ours.lights[0].direction, disc.centre) < 0.5, "{ours:?}");
        assert!(relative(irradiance(&ours, disc.centre), disc.irradiance()) < 0.01, "{ours:?}");
    }
    // Eq. 5 averages angles: longitudes all around cancel to the panorama's centre, and the mean polar angle of a
    // disc of radius r is 2r/3. The energy is right, the direction is not.
    let disc = Disc::at(0.0, 90.0, 2.5, SUN);
    let paper = estimate(&mut Mr360::new(false), &sky(Transfer::Linear, Vec3::ZERO, &[disc]));
    assert_eq!(paper.lights.len(), 1, "{paper:?}");
    let (sin, cos) = (disc.radius * 2.0 / 3.0).sin_cos();
    assert!(degrees(paper.lights[0].direction, Vec3::new(0.0, cos, -sin)) < 0.1, "{paper:?}");
    assert!(relative(energy(&paper).as_vec3(), disc.radiance * disc.solid_angle_sr()) < 0.01, "{paper:?}");
    // Pixels crowd at the pole, so μ + 2σ over pixels leaves two fifths of the disc in the SH, which add 6 % to it.
    assert!(relative(irradiance(&paper, disc.centre), disc.irradiance()) < 0.03, "{paper:?}");
}

#[test]
fn uniform_sky_is_ambient_alone() {
    for transfer in [Transfer::Linear, Transfer::Srgb] {
        let code = Vec3::new(0.7, 0.6, 0.5);
        let frame = sky(transfer, code, &[]);
        for mut method in conserving() {
            let estimate = estimate(method.as_mut(), &frame);
            let colour = mr360_protocol::video::Colour { transfer, ..Default::default() };
            let radiance = radiance_from_code(estimate.lift, colour, code);
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

/// A small deterministic generator (xorshift), so that a failure can be repeated.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
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
        let row = |i: usize| i as u32 / width;
        let truth: DVec3 = texels
            .iter()
            .enumerate()
            .map(|(i, texel)| Vec3::from_array(*texel).as_dvec3() * f64::from(pixel_solid_angle_sr(row(i), width, height)))
            .sum();
        let frame = frame(width, height, Transfer::Linear, texels);
        for mut method in conserving() {
            let estimate = estimate(method.as_mut(), &frame);
            let error = ((energy(&estimate) - truth) / truth).abs().max_element();
            assert!(error < 1e-4, "{} seed {seed}: {error}", method.name());
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
        assert_eq!(estimate(method.as_mut(), &frame).mended, 8, "{}", method.name());
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
    let frame =
        Frame { pts_us: 0, stereo: StereoLayout::Mono, pixels: Pixels::Rgb { width: 512, height: 256, texels, transfer: Transfer::Bt709 } };
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
    // The SH of a map with a ground and a horizon are good to a few percent.
    assert!((total / (sky + sun_on_ground) - 1.0).abs() < 0.05, "{total}");
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
