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
    return vec2(dot(point, vec2(0.36237489, -0.93203242)), dot(point, vec2(0.93203242, 0.36237489)));
}

// A point that asks what hides a light from it.
struct Receiver {
    uv: vec2<f32>,
    uv_per_m: vec2<f32>,
    // Metres along the light, as those of the map.
    depth_m: f32,
    // Depth over the map's plane, metres a metre, on the receiver's own plane.
    slope: vec2<f32>,
    bias_m: f32,
    // Gap from which a texel beside the point lies within the cone to the light's disc, metres a metre.
    gap_per_m: f32,
    texel_m: f32,
    range_m: f32,
    layer: i32,
}

fn receiver_in(map: ShadowMap, light_direction: vec3<f32>, tan_radius: f32, at: vec3<f32>, normal: vec3<f32>) -> Receiver {
    let axis_x = vec3(map.from_world[0].x, map.from_world[1].x, map.from_world[2].x) * map.half_width_m;
    let axis_y = vec3(map.from_world[0].y, map.from_world[1].y, map.from_world[2].y) * map.half_width_m;
    let slope = vec2(dot(normal, axis_x), dot(normal, axis_y)) / max(dot(normal, light_direction), 0.02);
    // A bilinear tap reaches a texel's side along both axes. No shift aside, which would part a shadow from its caster.
    let bias_m = map.texel_m * (0.5 + abs(slope.x) + abs(slope.y));
    return Receiver(
        at.xy * vec2(0.5, -0.5) + 0.5,
        vec2(0.5, -0.5) / map.half_width_m,
        at.z,
        slope,
        bias_m,
        1.0 / max(tan_radius, 1e-3),
        map.texel_m,
        map.range_m,
        max(map.layer, 0),
    );
}

// How much of a blocker lies at an offset in metres: its weight, that over its gap, and 1 where anything lies there.
// Those outside of the cone count where none of the taps lies within.
fn blocker_at(r: Receiver, offset: vec2<f32>, aside_m: f32) -> vec3<f32> {
    let tap = clamp(r.uv + offset * r.uv_per_m, vec2(0.0), vec2(0.99999));
    let depth_m = textureLoad(shadow_maps, vec2<i32>(tap * SHADOW_MAP_SIZE), r.layer, 0) * r.range_m;
    let gap_m = r.depth_m - depth_m;
    let weight = select(0.01, 1.0, gap_m > r.gap_per_m * (aside_m - LEAST_SEARCH * r.texel_m));
    let blocks = depth_m < r.range_m && gap_m + dot(r.slope, offset) > r.bias_m;
    return select(vec3(0.0), vec3(weight, weight / max(gap_m, r.texel_m), 1.0), blocks);
}

// Share of light past what lies at an offset in metres, from four texels. Of the gap that the cone asks for a half is
// enough: blockers of one penumbra differ in depth.
fn lit_at(r: Receiver, offset: vec2<f32>, aside_m: f32) -> f32 {
    let cone_m = 0.5 * r.gap_per_m * (aside_m - LEAST_SEARCH * r.texel_m);
    let depth = min((r.depth_m - max(r.bias_m - dot(r.slope, offset), cone_m)) / r.range_m, 0.99999);
    return textureSampleCompareLevel(shadow_maps, shadow_sampler, r.uv + offset * r.uv_per_m, r.layer, depth);
}

// True where some caster may hide the light from a point within the map's square.
fn near_caster(layer: i32, at: vec3<f32>) -> bool {
    let cell = vec2<u32>(clamp((at.xy * vec2(0.5, -0.5) + 0.5) * CELLS, vec2(0.0), vec2(CELLS - 1.0)));
    let row = lighting.casters[layer].rows[cell.y >> 2u][cell.y & 3u];
    return ((row >> cell.x) & 1u) == 1u || at.z > lighting.casters[layer].clear_to_m;
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
    let at = (map.from_world * vec4(world, 1.0)).xyz;
    let seen = map.layer >= 0 && max(abs(at.x), abs(at.y)) < 1.0 && near_caster(max(map.layer, 0), at);
    let r = receiver_in(map, light_direction, tan_radius, at, normal);
    let search_m = max(tan_radius * max(at.z, 0.0), LEAST_SEARCH * r.texel_m);
    let search_pairs = select(0u, SEARCH_PAIRS, seen);
    var found = vec3(0.0);
    var turn = vec2(1.0, 0.0);
    var i = 0u;
    loop {
        // Most lie near the rim, where a caster first reaches into the light.
        let aside_m = pow((f32(i) + 0.1) / f32(SEARCH_PAIRS), 0.33) * search_m;
        let offset = turn * aside_m;
        found += blocker_at(r, offset, aside_m) + blocker_at(r, -offset, aside_m);
        continuing {
            turn = half_turned(turn);
            i++;
            break if i >= search_pairs;
        }
    }
    found = select(vec3(0.0), found, seen);
    // All taps of the search covered: the filter's lie closer, within the umbra.
    let fringe = found.x > 0.0 && found.z < 2.0 * f32(SEARCH_PAIRS);
    let penumbra_m = max(tan_radius * found.x / max(found.y, 1e-6), LEAST_PENUMBRA * r.texel_m);
    let pairs = select(NARROW_PAIRS, WIDE_PAIRS, penumbra_m > WIDE_TEXELS * r.texel_m);
    let filter_pairs = select(0u, pairs, fringe);
    var lit = 0.0;
    turn = vec2(1.0, 0.0);
    i = 0u;
    loop {
        let aside_m = sqrt((f32(i) + 0.5) / f32(pairs)) * penumbra_m;
        let offset = turn * aside_m;
        lit += lit_at(r, offset, aside_m) + lit_at(r, -offset, aside_m);
        continuing {
            turn = half_turned(turn);
            i++;
            break if i >= filter_pairs;
        }
    }
    return select(select(0.0, 1.0, found.x == 0.0), 0.5 * lit / f32(pairs), fringe);
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
