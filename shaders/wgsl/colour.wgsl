// Transfer functions; twin of shaders/src/colour.rs, whose constants stand in the generated prelude.

fn srgb_decode(v: f32) -> f32 {
    return select(pow((max(v, 0.0) + 0.055) / 1.055, 2.4), v / 12.92, v <= 0.04045);
}

fn srgb_encode(v: f32) -> f32 {
    return select(1.055 * pow(max(v, 0.0), 1.0 / 2.4) - 0.055, v * 12.92, v <= 0.0031308);
}

fn pq_decode(v: f32) -> f32 {
    let p = pow(clamp(v, 0.0, 1.0), 1.0 / PQ_M2);
    return pow(max(p - PQ_C1, 0.0) / (PQ_C2 - PQ_C3 * p), 1.0 / PQ_M1) * 10000.0 / HDR_REFERENCE_WHITE;
}

fn hlg_scene(code: f32) -> f32 {
    let v = clamp(code, 0.0, 1.0);
    return select((exp((v - HLG_C) / HLG_A) + HLG_B) / 12.0, v * v / 3.0, v <= 0.5);
}

fn hlg_decode(code: vec3<f32>) -> vec3<f32> {
    let scene = vec3(hlg_scene(code.r), hlg_scene(code.g), hlg_scene(code.b));
    let luminance = dot(scene, vec3(0.2627, 0.6780, 0.0593));
    return scene * pow(luminance, HLG_GAMMA - 1.0) * (HLG_PEAK / HDR_REFERENCE_WHITE);
}

fn decode_transfer(transfer: u32, code: vec3<f32>) -> vec3<f32> {
    switch transfer {
        case TRANSFER_BT709: { return pow(max(code, vec3(0.0)), vec3(2.4)); }
        case TRANSFER_SRGB: { return vec3(srgb_decode(code.r), srgb_decode(code.g), srgb_decode(code.b)); }
        case TRANSFER_PQ: { return vec3(pq_decode(code.r), pq_decode(code.g), pq_decode(code.b)); }
        case TRANSFER_HLG: { return hlg_decode(code); }
        default: { return code; }
    }
}

// Decoded light as linear BT.709, as much of it as a half float holds.
fn linear_from_code(transfer: u32, bt709_from_primaries: mat3x3<f32>, code: vec3<f32>) -> vec3<f32> {
    return clamp(bt709_from_primaries * decode_transfer(transfer, code), vec3(0.0), vec3(MAX_MAGNITUDE));
}

fn iorns_factor(code: vec3<f32>) -> f32 {
    return IORNS_GAIN * pow(max(dot(code, IORNS_LUMA), 0.0), IORNS_EXPONENT) + IORNS_BASE;
}

// What clipping took from a frame; twin of colour::recovered.
struct Recovery {
    // What the logarithm of the gain gains along a direction.
    slope: vec3<f32>,
    // Its mean over the sphere.
    gain_ln: f32,
    // Of luminance 1.
    tint: vec3<f32>,
    padding: f32,
}

fn recovered(recovery: Recovery, direction: vec3<f32>, linear: vec3<f32>) -> vec3<f32> {
    let degree = smoothstep(vec3(CLIPPED_FIRST), vec3(CLIPPED_LAST), linear);
    let gain = exp(min(recovery.gain_ln + dot(recovery.slope, direction), MAX_GAIN_LN));
    return min(linear + dot(linear * degree, LUMA) * gain * recovery.tint, vec3(MAX_MAGNITUDE));
}

// Radiance that lights are taken from; twin of colour::radiance_from_code, which says why codes are clamped.
fn radiance_from_code(
    lift: u32,
    recovery: Recovery,
    transfer: u32,
    bt709_from_primaries: mat3x3<f32>,
    direction: vec3<f32>,
    code: vec3<f32>,
) -> vec3<f32> {
    let bounded = select(clamp(code, vec3(0.0), vec3(1.0)), code, transfer == TRANSFER_LINEAR);
    if lift == LIFT_INVERSE_TONE_MAP {
        return max(bounded, vec3(0.0)) * iorns_factor(bounded);
    }
    let linear = linear_from_code(transfer, bt709_from_primaries, bounded);
    let standard = transfer == TRANSFER_BT709 || transfer == TRANSFER_SRGB;
    if lift == LIFT_RECOVERED && standard {
        return recovered(recovery, direction, linear);
    }
    return linear;
}
