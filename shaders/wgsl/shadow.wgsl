// Contact-hardening shadows: blocker search, then percentage-closer filtering over the penumbra
// (Fernando 2005), with the receiver's plane as depth bias.

#import "frame.wgsl"

// Taps of the search and of the filter.
const SHADOW_TAPS: u32 = 16u;

fn disc_radius(index: u32) -> f32 {
    return sqrt((f32(index) + 0.5) / f32(SHADOW_TAPS));
}

// Share of a light that reaches a point, exactly 1 where nothing lies in between.
//
// The loops end where their taps are not needed, which spares them on every kind of processor; a branch around
// them would not where pixels run in step. Such a loop runs at least once and must do no harm then.
fn light_visibility(index: u32, world: vec3<f32>, normal: vec3<f32>) -> f32 {
    let light = lighting.lights[index];
    let texel_m = light.shadow_texel_m;
    let at = light.shadow_from_world * vec4(world + normal * (1.5 * texel_m), 1.0);
    let seen = light.shadow_layer >= 0 && max(abs(at.x), abs(at.y)) < 1.0;
    // Depth over the map's plane, metres a metre, from the receiver's own plane.
    let axis_x = vec3(light.shadow_from_world[0].x, light.shadow_from_world[1].x, light.shadow_from_world[2].x) * light.shadow_half_width_m;
    let axis_y = vec3(light.shadow_from_world[0].y, light.shadow_from_world[1].y, light.shadow_from_world[2].y) * light.shadow_half_width_m;
    let facing = max(dot(normal, light.direction), 0.1);
    let slope = clamp(vec2(dot(normal, axis_x), dot(normal, axis_y)) / facing, vec2(-8.0), vec2(8.0));

    let layer = max(light.shadow_layer, 0);
    let uv = at.xy * vec2(0.5, -0.5) + 0.5;
    let uv_per_m = vec2(0.5, -0.5) / light.shadow_half_width_m;
    let search_m = max(light.tan_radius * max(at.z, 0.0), 2.0 * texel_m);
    let search_taps = select(0u, SHADOW_TAPS, seen);
    var blockers = 0.0;
    var depth_sum = 0.0;
    var turn = vec2(1.0, 0.0);
    var i = 0u;
    loop {
        let offset = turn * (disc_radius(i) * search_m);
        let tap = clamp(uv + offset * uv_per_m, vec2(0.0), vec2(0.99999));
        let depth = textureLoad(shadow_maps, vec2<i32>(tap * SHADOW_MAP_SIZE), layer, 0) * light.shadow_range_m;
        if depth < light.shadow_range_m && depth < at.z + dot(slope, offset) - texel_m {
            blockers += 1.0;
            depth_sum += depth;
        }
        continuing {
            turn = turned(turn);
            i++;
            break if i >= search_taps;
        }
    }
    blockers = select(0.0, blockers, seen);
    // All taps of the search blocked: the filter's lie closer, within the umbra.
    let fringe = blockers > 0.0 && blockers < f32(SHADOW_TAPS);
    let filter_taps = select(0u, SHADOW_TAPS, fringe);
    let penumbra_m = max(light.tan_radius * (at.z - depth_sum / max(blockers, 1.0)), 1.5 * texel_m);
    var lit = 0.0;
    turn = vec2(1.0, 0.0);
    i = 0u;
    loop {
        let offset = turn * (disc_radius(i) * penumbra_m);
        let depth = (at.z + dot(slope, offset) - 0.5 * texel_m) / light.shadow_range_m;
        lit += textureSampleCompareLevel(shadow_maps, shadow_sampler, uv + offset * uv_per_m, layer, min(depth, 0.99999));
        continuing {
            turn = turned(turn);
            i++;
            break if i >= filter_taps;
        }
    }
    return select(select(0.0, 1.0, blockers == 0.0), lit / f32(SHADOW_TAPS), fringe);
}
