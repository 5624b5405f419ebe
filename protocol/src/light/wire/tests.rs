use proptest::prelude::*;

use super::*;

fn frame(lights: usize) -> LightFrame {
    let lights = (0..lights as u32).map(|id| DirectionalLight {
        id,
        direction: Vec3::new(id as f32 - 1.5, 1.0, -0.3).normalize(),
        irradiance: Vec3::new(3.0, 2.5, 2.0),
        solid_angle_sr: 6.8e-5,
    });
    LightFrame {
        pts_us: 3_600_000_000 * 24,
        published_us: 3_600_000_000 * 24 + 70_000,
        lift: Lift::Linear,
        sh: vec![Vec3::splat(0.7); SH9],
        lights: lights.collect(),
    }
}

#[test]
fn four_lights_fit_in_110_bytes_and_with_25_coefficients_in_170() {
    let mut four = frame(4);
    assert!(four.to_wire().unwrap().len() <= 110, "{} bytes", four.to_wire().unwrap().len());
    four.sh = vec![Vec3::splat(0.7); SH25];
    four.lift = Lift::Recovered(Recovery { gain_ln: 1.5, slope: Vec3::Y, tint_ln: [0.1, -0.2] });
    assert!(four.to_wire().unwrap().len() <= 170, "{} bytes", four.to_wire().unwrap().len());
}

#[test]
fn rounding_is_as_small_as_the_module_says() {
    let noise = |i: usize, k: usize| ((i * 37 + k * 101 + 11) as f32 * 12.9898).sin();
    let mut sent = frame(0);
    sent.lift = Lift::Recovered(Recovery { gain_ln: 1.234, slope: Vec3::new(0.1, 2.3, -0.7), tint_ln: [0.31, -0.7] });
    sent.sh = (0..SH25).map(|i| Vec3::new(noise(i, 0), noise(i, 1), noise(i, 2)) * if i == 0 { 3.0 } else { 1.0 }).collect();
    sent.lights = (0..20)
        .map(|i| DirectionalLight {
            id: i as u32,
            direction: Vec3::new(noise(i, 3), noise(i, 4), noise(i, 5)).normalize(),
            irradiance: Vec3::new(noise(i, 6), noise(i, 7), noise(i, 8)).abs() * 10f32.powi(i as i32 % 6 - 2),
            solid_angle_sr: 10f32.powf(-5.0 * noise(i, 9).abs()),
        })
        .collect();
    let back = LightFrame::from_wire(&sent.to_wire().unwrap()).unwrap();
    for (i, (got, expected)) in back.sh.iter().zip(&sent.sh).enumerate() {
        // Half floats have 11 bits; the others half a step of a 127th.
        let tolerance = if i < FINE { 2f32.powi(-11) * 3.0 } else { 1.01 / 254.0 };
        assert!((*got - *expected).abs().max_element() <= tolerance, "{i}: {got} {expected}");
    }
    for (got, expected) in back.lights.iter().zip(&sent.lights) {
        let error = (got.irradiance - expected.irradiance).abs().max_element() / expected.irradiance.max_element();
        assert!(error < 2.5e-3 && (got.irradiance.dot(LUMA) / expected.irradiance.dot(LUMA) - 1.0).abs() < 6e-4, "{got:?} {expected:?}");
        assert!((got.solid_angle_sr / expected.solid_angle_sr).ln().abs() < 0.033, "{got:?} {expected:?}");
    }
    let (Lift::Recovered(got), Lift::Recovered(expected)) = (back.lift, sent.lift) else { panic!("{:?}", back.lift) };
    // A gain is off by no more than half a per cent.
    for direction in [Vec3::X, Vec3::Y, Vec3::NEG_Z] {
        assert!((got.gain(direction) / expected.gain(direction) - 1.0).abs() < 5e-3, "{got:?}");
    }
    assert!(got.tint_ln.iter().zip(expected.tint_ln).all(|(a, b)| (a - b).abs() < 3e-3), "{got:?}");
}

#[test]
fn curves_that_no_camera_asks_for_are_refused() {
    let sound = Recovery { gain_ln: 1.0, slope: Vec3::Y, tint_ln: [0.0; 2] };
    for recovery in [
        Recovery { gain_ln: f32::NAN, ..sound },
        Recovery { gain_ln: 7.0, ..sound },
        Recovery { slope: Vec3::splat(f32::INFINITY), ..sound },
        Recovery { slope: Vec3::new(0.0, f32::NAN, 0.0), ..sound },
        Recovery { slope: Vec3::new(0.0, -17.0, 0.0), ..sound },
        Recovery { tint_ln: [100.0, 0.0], ..sound },
        Recovery { tint_ln: [0.0, f32::NAN], ..sound },
    ] {
        let frame = LightFrame { lift: Lift::Recovered(recovery), ..frame(1) };
        assert!(
            matches!(frame.to_wire(), Err(WireError::OutOfRange { field: "lift.gain_ln" | "lift.slope" | "lift.tint", .. })),
            "{recovery:?}"
        );
    }
    assert_eq!(Recovery { gain_ln: 6.0, slope: Vec3::Y * 9.0, ..sound }.gain(Vec3::Y), MAX_GAIN_LN.exp());
}

#[test]
fn black_lights_and_even_skies_come_back() {
    let mut dark = frame(1);
    dark.lights[0].irradiance = Vec3::ZERO;
    dark.sh = vec![Vec3::ZERO; SH25];
    dark.sh[0] = Vec3::ONE;
    let back = LightFrame::from_wire(&dark.to_wire().unwrap()).unwrap();
    assert_eq!((back.lights[0].irradiance, &back.sh), (Vec3::ZERO, &dark.sh));
}

#[test]
fn another_version_is_refused_by_name() {
    let mut wire = frame(1).to_wire().unwrap().to_vec();
    wire[0] = 9;
    assert!(matches!(LightFrame::from_wire(&wire), Err(WireError::UnknownVersion { got: 9, expected: 2, .. })));
}

#[test]
fn trailing_bytes_are_refused() {
    let mut wire = frame(1).to_wire().unwrap().to_vec();
    wire.push(0);
    assert!(matches!(LightFrame::from_wire(&wire), Err(WireError::Malformed { .. })));
}

#[test]
fn strong_light_is_held_to_the_range_and_keeps_its_colour() {
    let mut strong = frame(2);
    strong.lights[1].irradiance = Vec3::new(4e9, 2e9, 1e9);
    strong.sh[0] = Vec3::new(1e5, 5e4, 0.0);
    strong.sh[3] = Vec3::splat(-2e5);
    assert!(strong.to_wire().is_err());
    assert_eq!(strong.hold_to_range(), 2);
    let back = LightFrame::from_wire(&strong.to_wire().unwrap()).unwrap();
    // Half floats have 11 bits.
    let close = |got: Vec3, expected: Vec3| assert!((got - expected).abs().max_element() < 5e-4 * MAX_MAGNITUDE, "{got} {expected}");
    close(back.lights[0].irradiance, Vec3::new(3.0, 2.5, 2.0));
    close(back.lights[1].irradiance, Vec3::new(1.0, 0.5, 0.25) * MAX_MAGNITUDE);
    close(back.sh[0], Vec3::new(0.5, 0.25, 0.0) * MAX_MAGNITUDE);
    close(back.sh[3], Vec3::splat(-MAX_MAGNITUDE));
    assert_eq!(strong.hold_to_range(), 0);
    // What is not finite is a fault, and no strong light.
    strong.lights[0].irradiance.x = f32::INFINITY;
    assert_eq!(strong.hold_to_range(), 0);
    assert!(strong.to_wire().is_err());
}

#[test]
fn non_finite_values_are_never_sent() {
    let mut bad = frame(1);
    bad.sh[3].y = f32::NAN;
    assert!(matches!(bad.to_wire(), Err(WireError::OutOfRange { field: "sh", .. })));
    let mut bad = frame(1);
    bad.lights[0].irradiance.x = f32::INFINITY;
    assert!(matches!(bad.to_wire(), Err(WireError::OutOfRange { field: "lights.irradiance", .. })));
}

proptest! {
    #[test]
    fn directions_survive_within_5_millidegrees(x in -1.0f32..1.0, y in -1.0f32..1.0, z in -1.0f32..1.0) {
        let direction = Vec3::new(x, y, z);
        prop_assume!(direction.length() > 0.01);
        let direction = direction.normalize();
        let back = direction_from_octahedral(octahedral_from_direction(direction));
        // The chord is used because the arc cosine of a number near 1 loses the small angle.
        prop_assert!((back - direction).length().to_degrees() < 0.005);
    }

    #[test]
    fn random_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        let mut versioned = bytes.clone();
        if let Some(first) = versioned.first_mut() { *first = WireLightFrame::VERSION; }
        let _ = LightFrame::from_wire(&bytes);
        let _ = LightFrame::from_wire(&versioned);
    }
}
