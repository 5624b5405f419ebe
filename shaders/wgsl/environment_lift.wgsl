// Video rate: the left eye's panorama as lifted radiance on a cube, without the narrow lights.

#import "cube.wgsl"
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
    // Texels along one side of a face.
    size_px: u32,
    // Samples along one side of a texel.
    samples: u32,
    cut_count: u32,
    padding: u32,
}

@group(0) @binding(0) var<uniform> lift: Lift;
@group(0) @binding(1) var lifted: texture_storage_2d_array<rgba16float, write>;

fn sh_at(index: u32) -> vec3<f32> {
    return lift.sh[index].rgb;
}

@compute @workgroup_size(8, 8)
fn cs_lift(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id.xy >= vec2(lift.size_px)) {
        return;
    }
    let place = cube_place(id.xy, lift.size_px);
    let direction = normalize(cube_direction(id.z, place));
    let step = 2.0 / f32(lift.size_px * lift.samples);
    var sum = vec3(0.0);
    for (var y = 0u; y < lift.samples; y++) {
        for (var x = 0u; x < lift.samples; x++) {
            let offset = (vec2(f32(x), f32(y)) + 0.5 - 0.5 * f32(lift.samples)) * step;
            let seen = normalize(cube_direction(id.z, place + offset));
            sum += lifted_from_code(direction, video_code(uv_from_direction(seen), 0u));
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
    textureStore(lifted, id.xy, id.z, vec4(radiance, 1.0));
}
