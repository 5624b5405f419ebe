// Contact-hardening shadows: blocker search, then percentage-closer filtering over the penumbra
// (Fernando 2005), with the receiver's plane as depth bias.

#import "frame.wgsl"

// Share of a light that reaches a point, exactly 1 where nothing lies in between.
fn light_visibility(index: u32, world: vec3<f32>, normal: vec3<f32>) -> f32 {
    let light = lighting.lights[index];
    if light.shadow_layer < 0 {
        return 1.0;
    }
    let size = f32(textureDimensions(shadow_maps).x);
    let texel_m = 2.0 * light.shadow_half_width_m / size;
    let at = light.shadow_from_world * vec4(world + normal * (1.5 * texel_m), 1.0);
    if max(abs(at.x), abs(at.y)) >= 1.0 {
        return 1.0;
    }
    // Depth over the map's plane, metres a metre, from the receiver's own plane.
    let axis_x = vec3(light.shadow_from_world[0].x, light.shadow_from_world[1].x, light.shadow_from_world[2].x) * light.shadow_half_width_m;
    let axis_y = vec3(light.shadow_from_world[0].y, light.shadow_from_world[1].y, light.shadow_from_world[2].y) * light.shadow_half_width_m;
    let facing = max(dot(normal, light.direction), 0.1);
    let slope = clamp(vec2(dot(normal, axis_x), dot(normal, axis_y)) / facing, vec2(-8.0), vec2(8.0));

    let uv = at.xy * vec2(0.5, -0.5) + 0.5;
    let uv_per_m = vec2(0.5, -0.5) / light.shadow_half_width_m;
    let search_m = max(light.tan_radius * max(at.z, 0.0), 2.0 * texel_m);
    var blockers = 0.0;
    var depth_sum = 0.0;
    for (var i = 0u; i < 16u; i++) {
        let offset = lighting.disc[i].xy * search_m;
        let tap = clamp(uv + offset * uv_per_m, vec2(0.0), vec2(0.99999));
        let depth = textureLoad(shadow_maps, vec2<i32>(tap * size), light.shadow_layer, 0) * light.shadow_range_m;
        if depth < light.shadow_range_m && depth < at.z + dot(slope, offset) - texel_m {
            blockers += 1.0;
            depth_sum += depth;
        }
    }
    if blockers == 0.0 {
        return 1.0;
    }
    let penumbra_m = max(light.tan_radius * (at.z - depth_sum / blockers), 1.5 * texel_m);
    var lit = 0.0;
    for (var i = 0u; i < 16u; i++) {
        let offset = lighting.disc[i].xy * penumbra_m;
        let depth = (at.z + dot(slope, offset) - 0.5 * texel_m) / light.shadow_range_m;
        lit += textureSampleCompareLevel(shadow_maps, shadow_sampler, uv + offset * uv_per_m, light.shadow_layer, min(depth, 0.99999));
    }
    return lit / 16.0;
}
