// Halves the faces of the reflection map. Texels count by their solid angle, so that every level holds the energy of the first;
// no texel has a part in two faces.

#import "cube.wgsl"

@group(0) @binding(0) var finer: texture_2d_array<f32>;
@group(0) @binding(1) var coarser: texture_storage_2d_array<rgba16float, write>;

@compute @workgroup_size(8, 8)
fn cs_mip(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id.xy >= textureDimensions(coarser)) {
        return;
    }
    let size = textureDimensions(finer).x;
    var sum = vec3(0.0);
    var weight = 0.0;
    for (var i = 0u; i < 4u; i++) {
        let at = min(id.xy * 2u + vec2(i & 1u, i >> 1u), vec2(size - 1u));
        let density = cube_density(cube_place(at, size));
        sum += density * textureLoad(finer, at, id.z, 0).rgb;
        weight += density;
    }
    textureStore(coarser, id.xy, id.z, vec4(sum / weight, 1.0));
}
