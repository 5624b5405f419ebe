// Contact-hardening shadows: blocker search, then percentage-closer filtering over the penumbra
// (Fernando 2005), with the receiver's plane as depth bias.

#import "frame.wgsl"

// The scene has meshes of the place, which cast shadows of their own.
override PLACE: bool = false;

// Pairs of taps, each with its mirror image at the centre: what half of a disc sees is exactly a half.
// Of the search, and of the filter over a narrow penumbra, where texels overlap, and over a wide one.
const SEARCH_PAIRS: u32 = 8u;
const NARROW_PAIRS: u32 = 8u;
const WIDE_PAIRS: u32 = 24u;
// Texels of radius from which a penumbra is wide.
const WIDE_TEXELS: f32 = 4.0;
// Least radius of the search and of the filter, texels: what an edge needs to be smooth.
const LEAST_SEARCH: f32 = 2.0;
const LEAST_PENUMBRA: f32 = 1.5;

// Turned by half the golden angle: with their mirror images, points spread evenly over the disc (Vogel 1979).
fn half_turned(point: vec2<f32>) -> vec2<f32> {
    return vec2(dot(point, vec2(0.36237, -0.93204)), dot(point, vec2(0.93204, 0.36237)));
}

// Share of a light that one map lets through to a point, exactly 1 where nothing lies in between.
//
// What lies beneath the receiver's tangent plane cannot hide the light from it, so that convex surfaces never shadow
// themselves. A texel hides a part of the light only if it lies within the cone from the point to the light's disc: as
// far aside as the tangent of its radius times the gap.
//
// The loops end where their taps are not needed, which spares them on every kind of processor; a branch around
// them would not where pixels run in step. Such a loop runs at least once and must do no harm then.
fn visibility_in(map: ShadowMap, light_direction: vec3<f32>, tan_radius: f32, world: vec3<f32>, normal: vec3<f32>) -> f32 {
    let texel_m = map.texel_m;
    let at = map.from_world * vec4(world, 1.0);
    let seen = map.layer >= 0 && max(abs(at.x), abs(at.y)) < 1.0;
    // Depth over the map's plane, metres a metre, on the receiver's own plane.
    let axis_x = vec3(map.from_world[0].x, map.from_world[1].x, map.from_world[2].x) * map.half_width_m;
    let axis_y = vec3(map.from_world[0].y, map.from_world[1].y, map.from_world[2].y) * map.half_width_m;
    let slope = vec2(dot(normal, axis_x), dot(normal, axis_y)) / max(dot(normal, light_direction), 0.02);
    // A bilinear tap reaches a texel's side along both axes. No shift aside, which would part a shadow from its caster.
    let bias_m = texel_m * (0.5 + abs(slope.x) + abs(slope.y));
    let gap_per_m = 1.0 / max(tan_radius, 1e-3);

    let layer = max(map.layer, 0);
    let uv = at.xy * vec2(0.5, -0.5) + 0.5;
    let uv_per_m = vec2(0.5, -0.5) / map.half_width_m;
    let search_m = max(tan_radius * max(at.z, 0.0), LEAST_SEARCH * texel_m);
    let search_pairs = select(0u, SEARCH_PAIRS, seen);
    var blockers = 0.0;
    var covered = 0.0;
    var nearness = 0.0;
    var turn = vec2(1.0, 0.0);
    var i = 0u;
    loop {
        // Most lie near the rim, where a caster first reaches into the light.
        let aside_m = pow((f32(i) + 0.1) / f32(SEARCH_PAIRS), 0.33) * search_m;
        for (var side = -1.0; side < 2.0; side += 2.0) {
            let offset = turn * (aside_m * side);
            let tap = clamp(uv + offset * uv_per_m, vec2(0.0), vec2(0.99999));
            let depth = textureLoad(shadow_maps, vec2<i32>(tap * SHADOW_MAP_SIZE), layer, 0) * map.range_m;
            let gap_m = at.z - depth;
            if depth < map.range_m && gap_m + dot(slope, offset) > bias_m {
                // Those outside of the cone count where none of the taps lies within.
                let weight = select(0.01, 1.0, gap_m > gap_per_m * (aside_m - LEAST_SEARCH * texel_m));
                covered += 1.0;
                blockers += weight;
                nearness += weight / max(gap_m, texel_m);
            }
        }
        continuing {
            turn = half_turned(turn);
            i++;
            break if i >= search_pairs;
        }
    }
    blockers = select(0.0, blockers, seen);
    // All taps of the search covered: the filter's lie closer, within the umbra.
    let fringe = blockers > 0.0 && covered < 2.0 * f32(SEARCH_PAIRS);
    let penumbra_m = max(tan_radius * blockers / max(nearness, 1e-6), LEAST_PENUMBRA * texel_m);
    let pairs = select(NARROW_PAIRS, WIDE_PAIRS, penumbra_m > WIDE_TEXELS * texel_m);
    let filter_pairs = select(0u, pairs, fringe);
    var lit = 0.0;
    turn = vec2(1.0, 0.0);
    i = 0u;
    loop {
        let aside_m = sqrt((f32(i) + 0.5) / f32(pairs)) * penumbra_m;
        // Half the gap that the cone asks for: blockers of one penumbra differ in depth.
        let cone_m = 0.5 * gap_per_m * (aside_m - LEAST_SEARCH * texel_m);
        for (var side = -1.0; side < 2.0; side += 2.0) {
            let offset = turn * (aside_m * side);
            let depth = min((at.z - max(bias_m - dot(slope, offset), cone_m)) / map.range_m, 0.99999);
            lit += textureSampleCompareLevel(shadow_maps, shadow_sampler, uv + offset * uv_per_m, layer, depth);
        }
        continuing {
            turn = half_turned(turn);
            i++;
            break if i >= filter_pairs;
        }
    }
    return select(select(0.0, 1.0, blockers == 0.0), 0.5 * lit / f32(pairs), fringe);
}

// Share of a light that the objects let through to a point.
fn objects_visibility(index: u32, world: vec3<f32>, normal: vec3<f32>) -> f32 {
    let light = lighting.lights[index];
    return visibility_in(light.objects, light.direction, light.tan_radius, world, normal);
}

// Share of a light that the real place lets through to a point.
fn place_visibility(index: u32, world: vec3<f32>, normal: vec3<f32>) -> f32 {
    if !PLACE {
        return 1.0;
    }
    let light = lighting.lights[index];
    return visibility_in(light.place, light.direction, light.tan_radius, world, normal);
}

// Share of a light that reaches a virtual surface, past objects and place.
fn light_visibility(index: u32, world: vec3<f32>, normal: vec3<f32>) -> f32 {
    return objects_visibility(index, world, normal) * place_visibility(index, world, normal);
}
