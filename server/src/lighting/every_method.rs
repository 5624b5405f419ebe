//! Every method of the registry against panoramas whose light is known in closed form.

use std::f32::consts::PI;

use glam::{DVec3, Vec3};
use mr360_protocol::light::{Lift, LightFrame, MAX_MAGNITUDE};
use mr360_protocol::video::Transfer;
use mr360_shaders::colour::luminance;
use mr360_shaders::equirect::pixel_solid_angle_sr;
use mr360_shaders::sh;

use super::closed_forms::degrees;
use super::sequences::Noise;
use super::test_skies::{Disc, energy, estimate_with, frame, irradiance, normals, sky};
use super::{Estimate, LightMethod, MethodSpec};
use crate::frame::{Frame, Pixels};

fn make(text: &str) -> Box<dyn LightMethod> {
    text.parse::<MethodSpec>().unwrap().make()
}

/// Every method with its default parameter, and some with the ends of its range.
fn all() -> impl Iterator<Item = Box<dyn LightMethod>> {
    let ends = ["sh:25", "median-cut:1", "median-cut:64", "variance-cut:1", "variance-cut:64", "k-means:1", "k-means:64"];
    MethodSpec::all().map(MethodSpec::make).chain(ends.into_iter().map(make))
}

/// The methods that place a number of lights over the whole sphere.
fn placing(count: usize) -> [Box<dyn LightMethod>; 3] {
    ["median-cut", "variance-cut", "k-means"].map(|name| make(&format!("{name}:{count}")))
}

fn relative(got: Vec3, expected: Vec3) -> f32 {
    ((got - expected) / expected).abs().max_element()
}

/// Mostly dim, now and then up to thousands; and its energy.
fn noise(seed: u64, width: u32, height: u32) -> (Frame, DVec3) {
    let mut noise = Noise(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15));
    let texels: Vec<[f32; 3]> = (0..width * height)
        .map(|_| {
            let peak = if noise.next() > 0.995 { 10f32.powf(noise.next() * 4.0) } else { 1.0 };
            std::array::from_fn(|_| noise.next() * peak)
        })
        .collect();
    let solid_angle = |i: usize| f64::from(pixel_solid_angle_sr(i as u32 / width, width, height));
    let energy = texels.iter().enumerate().map(|(i, texel)| Vec3::from_array(*texel).as_dvec3() * solid_angle(i)).sum();
    (frame(width, height, Transfer::Linear, texels), energy)
}

const SUN: Vec3 = Vec3::new(4000.0, 3500.0, 2500.0);

#[test]
fn one_disc_is_one_light_at_its_place_wherever_it_stands() {
    for (longitude, latitude, radius) in [
        (40.0, 50.0, 1.0),
        (-120.3, -20.7, 2.5),
        (180.0, 35.0, 2.0),
        (-179.6, 5.0, 2.0),
        (0.0, 90.0, 2.5),
        (60.0, 89.0, 2.5),
        (0.0, -90.0, 3.0),
    ] {
        let disc = Disc::at(longitude, latitude, radius, SUN);
        let frame = sky(Transfer::Linear, Vec3::ZERO, &[disc]);
        for mut method in placing(1) {
            let estimate = estimate_with(method.as_mut(), &frame);
            let context = format!("{} {longitude} {latitude} {radius}: {estimate:?}", method.name());
            assert_eq!(estimate.lights.len(), 1, "{context}");
            assert!(degrees(estimate.lights[0].direction, disc.centre) < 0.3, "{context}");
            // Points on the rim are good to 1 % of the smallest disc. k-means leaves up to a quarter, the rim, to the SH.
            let held = estimate.lights[0].irradiance / disc.energy();
            let least = if method.name().starts_with("k-means") { 0.74 } else { 0.98 };
            assert!(held.min_element() > least && held.max_element() < 1.02, "{context}");
            assert!(relative(energy(&estimate).as_vec3(), disc.energy()) < 0.02, "{context}");
            // The rim is blurred by a texel of 0.7° on each side.
            let widened = Disc { radius: disc.radius + 0.012, ..disc }.solid_angle_sr();
            assert!((0.5 * disc.solid_angle_sr()..1.2 * widened).contains(&estimate.lights[0].solid_angle_sr), "{context}");
        }
    }
}

#[test]
fn all_lights_of_one_disc_lie_in_it() {
    let disc = Disc::at(-100.0, 40.0, 4.0, SUN);
    let frame = sky(Transfer::Linear, Vec3::ZERO, &[disc]);
    for mut method in placing(16) {
        let estimate = estimate_with(method.as_mut(), &frame);
        assert_eq!(estimate.lights.len(), 16, "{}", method.name());
        assert!(estimate.lights.iter().all(|light| degrees(light.direction, disc.centre) < 4.7), "{}: {estimate:?}", method.name());
    }
}

#[test]
fn two_equal_discs_are_two_equal_lights() {
    for (first, second) in [((-60.0, 30.0), (70.0, 30.0)), ((-60.0, 75.0), (120.0, -40.0)), ((10.0, 60.0), (170.0, 60.0))] {
        let discs = [first, second].map(|(longitude, latitude)| Disc::at(longitude, latitude, 3.0, SUN));
        let frame = sky(Transfer::Linear, Vec3::ZERO, &discs);
        for mut method in placing(2) {
            let estimate = estimate_with(method.as_mut(), &frame);
            let context = format!("{} {first:?} {second:?}: {estimate:?}", method.name());
            assert_eq!(estimate.lights.len(), 2, "{context}");
            for disc in discs {
                let light =
                    estimate.lights.iter().min_by(|a, b| degrees(a.direction, disc.centre).total_cmp(&degrees(b.direction, disc.centre)));
                let light = light.unwrap();
                assert!(degrees(light.direction, disc.centre) < 0.3, "{context}");
                // k-means leaves up to a quarter of both, and of either a little more, to the SH.
                let lost = if method.name().starts_with("k-means") { 0.35 } else { 0.02 };
                assert!(relative(light.irradiance, disc.energy()) < lost, "{context}");
            }
        }
    }
}

#[test]
fn even_sky_is_ambient_alone_but_for_the_cuts() {
    let radiance = Vec3::new(0.7, 0.6, 0.5);
    let sky = sky(Transfer::Linear, radiance, &[]);
    for mut method in all() {
        let estimate = estimate_with(method.as_mut(), &sky);
        let name = method.name();
        if name.contains("-cut") {
            // See the cuts' own test for what this does to the irradiance.
            assert!(estimate.sh.iter().all(|c| *c == Vec3::ZERO), "{name}: {estimate:?}");
            continue;
        }
        assert!(estimate.lights.is_empty(), "{name}: {:?}", estimate.lights);
        // SH alone are integrated exactly, up to single precision; the others sum at the centres of 32 rows and more, good to 1e-3.
        let tolerance = if name.starts_with("sh") { 1e-5 } else { 1e-3 };
        for normal in normals(40) {
            assert!(relative(irradiance(&estimate, normal), radiance * PI) < tolerance, "{name}: {estimate:?}");
            assert!(relative(sh::radiance(&estimate.sh, normal), radiance) < 4.0 * tolerance, "{name}: {estimate:?}");
        }
    }
}

#[test]
fn energy_is_conserved_on_random_panoramas() {
    for (seed, (width, height)) in [(1, (256, 128)), (2, (333, 167)), (3, (64, 32)), (4, (1024, 512)), (5, (3, 1))] {
        let (frame, truth) = noise(seed, width, height);
        for mut method in all() {
            // A second look must not add to the first.
            estimate_with(method.as_mut(), &frame);
            let estimate = estimate_with(method.as_mut(), &frame);
            let error = ((energy(&estimate) - truth) / truth).abs().max_element();
            assert!(error < 1e-4, "{} {width}×{height}: {error}", method.name());
        }
    }
}

#[test]
fn as_many_lights_as_asked_for_and_the_strongest_first() {
    let (frame, _) = noise(9, 512, 256);
    for count in [1, 2, 3, 7, 16, 33, 64] {
        for mut method in placing(count) {
            let estimate = estimate_with(method.as_mut(), &frame);
            assert_eq!(estimate.lights.len(), count, "{}", method.name());
            let strength = |light: &super::DirectionalLight| luminance(light.irradiance);
            assert!(estimate.lights.windows(2).all(|pair| strength(&pair[0]) >= strength(&pair[1])), "{}", method.name());
            let mut ids: Vec<u32> = estimate.lights.iter().map(|light| light.id).collect();
            ids.sort_unstable();
            ids.dedup();
            assert_eq!(ids.len(), count, "{}", method.name());
        }
    }
}

#[test]
fn a_light_in_one_texel_is_not_cut() {
    // Three texels of 512×256 hold all the light there is.
    let mut texels = vec![[0.0; 3]; 512 * 256];
    [70 * 512 + 100, 70 * 512 + 101, 180 * 512 + 400].into_iter().for_each(|texel: usize| texels[texel] = [5.0, 4.0, 3.0]);
    let frame = frame(512, 256, Transfer::Linear, texels);
    for mut method in placing(16) {
        assert_eq!(estimate_with(method.as_mut(), &frame).lights.len(), 3, "{}", method.name());
    }
}

#[test]
fn black_frame_is_dark_and_forgotten() {
    let (bright, truth) = noise(3, 256, 128);
    for transfer in [Transfer::Linear, Transfer::Srgb, Transfer::Pq, Transfer::Hlg] {
        for (width, height) in [(64, 32), (1, 1)] {
            let black = frame(width, height, transfer, vec![[0.0; 3]; (width * height) as usize]);
            for mut method in all() {
                estimate_with(method.as_mut(), &bright);
                let estimate = estimate_with(method.as_mut(), &black);
                assert!(estimate.lights.is_empty() && estimate.sh.iter().all(|c| c.abs().max_element() < 1e-6), "{estimate:?}");
                let again = energy(&estimate_with(method.as_mut(), &bright));
                assert!(((again - truth) / truth).abs().max_element() < 1e-4, "{}", method.name());
            }
        }
    }
}

#[test]
fn impossible_pixels_leave_the_light_finite() {
    let mut frame = sky(Transfer::Linear, Vec3::splat(0.2), &[Disc::at(10.0, 45.0, 3.0, SUN)]);
    let Pixels::Rgb { texels, .. } = &mut frame.pixels else { unreachable!() };
    for (i, bad) in [f32::NAN, f32::NEG_INFINITY, -3.0, f32::INFINITY, 1e38].into_iter().enumerate() {
        texels[90_000 + 777 * i] = [bad, 0.2, bad];
    }
    for mut method in all() {
        assert_eq!(estimate_with(method.as_mut(), &frame).mended, 10, "{}", method.name());
    }
}

#[test]
fn the_strongest_light_there_is_crosses_the_wire() {
    // HDR in absolute units: a whole sphere as bright as can be said, and a dim one with a sun of cd/m².
    let (width, height) = (256, 128);
    let whole = frame(width, height, Transfer::Linear, vec![[f32::MAX; 3]; (width * height) as usize]);
    let sun = sky(Transfer::Linear, Vec3::splat(3e3), &[Disc::at(10.0, 45.0, 9.0, Vec3::new(1.6e9, 1.4e9, 1.0e9))]);
    for (i, frame) in [whole, sun].iter().enumerate() {
        for mut method in all() {
            let Estimate { lift, sh, lights, .. } = estimate_with(method.as_mut(), frame);
            let mut light = LightFrame { pts_us: 0, published_us: 0, lift, sh, lights };
            let strongest = |light: &LightFrame| light.lights.iter().map(|l| l.irradiance.max_element()).fold(0.0, f32::max);
            let before = strongest(&light);
            light.hold_to_range();
            let wire = light.to_wire().unwrap_or_else(|error| panic!("{i}, {}: {error}", method.name()));
            let back = LightFrame::from_wire(&wire).unwrap();
            assert_eq!(back.lights.len(), light.lights.len());
            assert!((strongest(&back) / before.min(MAX_MAGNITUDE) - 1.0).abs() < 1e-3 || before == 0.0, "{i}, {}", method.name());
        }
    }
}

#[test]
fn the_same_frames_give_the_same_light() {
    let frames =
        [noise(21, 256, 128).0, sky(Transfer::Srgb, Vec3::splat(0.3), &[Disc::at(-90.0, 20.0, 5.0, Vec3::ONE)]), noise(22, 256, 128).0];
    let run =
        |mut method: Box<dyn LightMethod>| -> Vec<Estimate> { frames.iter().map(|frame| estimate_with(method.as_mut(), frame)).collect() };
    for (a, b) in all().zip(all()) {
        let name = a.name().to_owned();
        assert_eq!(run(a), run(b), "{name}");
    }
}

#[test]
fn new_methods_see_what_the_display_shows() {
    // sRGB code 0.5 is radiance 0.2140; nothing is lifted.
    let grey = frame(64, 32, Transfer::Srgb, vec![[0.5; 3]; 64 * 32]);
    for mut method in placing(8).into_iter().chain([make("sh"), make("sh:25")]) {
        let estimate = estimate_with(method.as_mut(), &grey);
        assert_eq!(estimate.lift, Lift::Linear);
        // Half an entry of the code table is 0.1 % here.
        assert!((energy(&estimate) / (4.0 * std::f64::consts::PI * 0.214_04) - 1.0).abs().max_element() < 2e-3, "{}", method.name());
    }
}

#[test]
fn coefficients_are_as_many_as_asked_for_and_the_deeper_bands_are_right() {
    // A disc's coefficients are those of a point at its centre times ∫ P_l: (1−c) 2π for l = 0, and in general
    // 2π (P_{l−1}(c) − P_{l+1}(c))/(2l + 1), c the cosine of its radius.
    let disc = Disc::at(130.0, 25.0, 12.0, Vec3::new(2.0, 1.0, 0.5));
    let frame = sky(Transfer::Linear, Vec3::ZERO, &[disc]);
    let estimate = estimate_with(make("sh:25").as_mut(), &frame);
    assert_eq!(estimate.sh.len(), 25);
    assert_eq!(estimate_with(make("sh").as_mut(), &frame).sh.len(), 9);
    let c = disc.radius.cos();
    let legendre = [1.0, c, (3.0 * c * c - 1.0) / 2.0, (5.0 * c.powi(3) - 3.0 * c) / 2.0, (35.0 * c.powi(4) - 30.0 * c * c + 3.0) / 8.0];
    let fifth = (63.0 * c.powi(5) - 70.0 * c.powi(3) + 15.0 * c) / 8.0;
    let p = |l: usize| if l == 5 { fifth } else { legendre[l] };
    for (i, (got, basis)) in estimate.sh.iter().zip(sh::basis25(disc.centre)).enumerate() {
        let l = sh::band(i);
        let zonal = if l == 0 { 2.0 * PI * (1.0 - c) } else { 2.0 * PI * (p(l - 1) - p(l + 1)) / (2 * l + 1) as f32 };
        // Texels of 2.8° take 0.2 % off band 4; the rim's points are good to 0.1 %.
        assert!((*got - disc.radiance * basis * zonal).abs().max_element() < 1e-3, "{i}: {got} {}", disc.radiance * basis * zonal);
    }
}
