// One level of the prefiltered maps: the reflection map under a GGX lobe around each direction (Karis 2013), by taps that
// follow the lobe, each from the mip whose texels are as large as its share (Colbert and Křivánek 2007).

#import "cube.wgsl"

struct Prefilter {
    // xyz: direction around a lobe along z, w: mip level. Each counts by its cosine, z.
    taps: array<vec4<f32>, MAX_TAPS>,
    count: u32,
    // Texels along one side of a face.
    size_px: u32,
    padding: vec2<u32>,
}

@group(0) @binding(0) var<uniform> prefilter: Prefilter;
@group(0) @binding(1) var sharp: texture_cube<f32>;
@group(0) @binding(2) var sharp_sampler: sampler;
@group(0) @binding(3) var prefiltered_level: texture_storage_2d_array<rgba16float, write>;

@compute @workgroup_size(8, 8)
fn cs_prefilter(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id.xy >= vec2(prefilter.size_px)) {
        return;
    }
    let axis = normalize(cube_direction(id.z, cube_place(id.xy, prefilter.size_px)));
    let side = select(vec3(0.0, 1.0, 0.0), vec3(1.0, 0.0, 0.0), abs(axis.y) > 0.9);
    let tangent = normalize(cross(side, axis));
    let frame = mat3x3(tangent, cross(axis, tangent), axis);
    var sum = vec3(0.0);
    var weight = 0.0;
    for (var i = 0u; i < prefilter.count; i++) {
        let tap = prefilter.taps[i];
        sum += tap.z * textureSampleLevel(sharp, sharp_sampler, frame * tap.xyz, tap.w).rgb;
        weight += tap.z;
    }
    textureStore(prefiltered_level, id.xy, id.z, vec4(sum / weight, 1.0));
}
