// Video rate: the left eye's panorama as lifted radiance at the size of the reflection map, without the narrow lights.

#import "fullscreen.wgsl"
#import "sh.wgsl"
#import "video.wgsl"

// A light to be cut out.
struct Cut {
    direction: vec3<f32>,
    // Cosines of the half angles within which all of the share is taken, and from which nothing is.
    cos_inner: f32,
    cos_outer: f32,
    share: f32,
    padding: vec2<f32>,
}

struct Lift {
    sh: array<vec4<f32>, 25>,
    cuts: array<Cut, 8>,
    size_px: vec2<u32>,
    // Samples along one side of a texel.
    samples: u32,
    cut_count: u32,
}

@group(0) @binding(0) var<uniform> lift: Lift;

fn sh_at(index: u32) -> vec3<f32> {
    return lift.sh[index].rgb;
}

@fragment
fn fs_lift(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let size = vec2<f32>(lift.size_px);
    let direction = direction_from_uv(at.xy / size);
    var sum = vec3(0.0);
    for (var y = 0u; y < lift.samples; y++) {
        for (var x = 0u; x < lift.samples; x++) {
            let offset = (vec2(f32(x), f32(y)) + 0.5) / f32(lift.samples) - 0.5;
            sum += lifted_from_code(direction, video_code((at.xy + offset) / size, 0u));
        }
    }
    var radiance = min(sum / f32(lift.samples * lift.samples), vec3(MAX_MAGNITUDE));
    // A light comes back as its own highlight: what is left in its place is the residual, which the SH hold.
    var taken = 0.0;
    for (var i = 0u; i < lift.cut_count; i++) {
        let cut = lift.cuts[i];
        taken = max(taken, cut.share * smoothstep(cut.cos_outer, cut.cos_inner, dot(direction, cut.direction)));
    }
    if taken > 0.0 {
        let residual = max(sh_sum(SH_COUNT, direction, RADIANCE_BAND), vec3(0.0));
        radiance = mix(radiance, min(radiance, residual), taken);
    }
    return vec4(radiance, 1.0);
}
