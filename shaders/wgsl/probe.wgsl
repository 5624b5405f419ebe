// Values of the light kernels at given directions, to compare with their CPU twins.

#import "equirect.wgsl"
#import "sh.wgsl"
#import "colour.wgsl"

struct Probe {
    direction: vec3<f32>,
    transfer: u32,
    code: vec3<f32>,
    lift: u32,
    bt709_from_primaries: mat3x3<f32>,
    recovery: Recovery,
}

struct ProbeResult {
    irradiance: vec3<f32>,
    u: f32,
    linear: vec3<f32>,
    v: f32,
    round_trip: vec3<f32>,
    padding: f32,
    lifted: vec3<f32>,
    padding_2: f32,
}

@group(0) @binding(0) var<storage, read> probes: array<Probe>;
@group(0) @binding(1) var<storage, read> probe_sh: array<vec4<f32>, 25>;
@group(0) @binding(2) var<storage, read_write> results: array<ProbeResult>;

fn sh_at(index: u32) -> vec3<f32> {
    return probe_sh[index].rgb;
}

@compute @workgroup_size(64)
fn cs_probe(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= arrayLength(&probes) {
        return;
    }
    let probe = probes[id.x];
    let uv = uv_from_direction(probe.direction);
    let irradiance = max(sh_sum(25u, probe.direction, IRRADIANCE_BAND), vec3(0.0));
    let linear = decode_transfer(probe.transfer, probe.code);
    let lifted = radiance_from_code(
        probe.lift,
        probe.recovery,
        probe.transfer,
        probe.bt709_from_primaries,
        probe.direction,
        probe.code,
    );
    results[id.x] = ProbeResult(irradiance, uv.x, linear, uv.y, direction_from_uv(uv), 0.0, lifted, 0.0);
}
