// What a lobe around a direction sees of the lifted panorama.

#import "frame.wgsl"
#import "video.wgsl"

@group(2) @binding(0) var environment: texture_cube<f32>;
@group(2) @binding(1) var environment_sampler: sampler;
@group(2) @binding(4) var prefiltered: texture_cube<f32>;

// What kind of surface a draw has: one of the SURFACE constants.
override SURFACE: u32 = 3u;
// How lobes are looked up: one of the REFLECTIONS constants.
override REFLECTIONS: u32 = 0u;

// The mip level whose texels have this solid angle in this direction.
fn environment_level(direction: vec3<f32>, solid_angle_sr: f32) -> f32 {
    let size = f32(textureDimensions(environment).x);
    let axis = max(max(abs(direction.x), abs(direction.y)), abs(direction.z));
    let texel_sr = 4.0 / (size * size) * axis * axis * axis;
    return 0.5 * log2(solid_angle_sr / texel_sr);
}

fn environment_radiance(direction: vec3<f32>, level: f32) -> vec3<f32> {
    return textureSampleLevel(environment, environment_sampler, direction, max(level, 0.0)).rgb;
}

// Share of a cone of this level that the map serves, which lacks the narrow lights. The rest is the video itself,
// which shows them.
fn map_share(level: f32) -> f32 {
    return clamp(level + 1.0, 0.0, 1.0);
}

// A cone of this solid angle: the video itself where the cone is finer than the map.
fn cone_radiance(direction: vec3<f32>, solid_angle_sr: f32) -> vec3<f32> {
    let level = environment_level(direction, solid_angle_sr);
    let share = map_share(level);
    if share == 1.0 {
        return environment_radiance(direction, level);
    }
    let sharp = lifted_from_code(direction, video_code(uv_from_direction(direction), view.eye));
    if share == 0.0 {
        return sharp;
    }
    return mix(sharp, environment_radiance(direction, 0.0), share);
}

// Solid angle of the directions that a GGX lobe of this alpha reflects.
fn lobe_solid_angle(alpha: f32) -> f32 {
    return 4.0 * PI * alpha * alpha;
}

fn is_cone(alpha: f32) -> bool {
    return SURFACE == SURFACE_MIRROR || (SURFACE != SURFACE_GLOSSY && alpha < MIRROR_ALPHA);
}

// Share of `lobe_radiance` that the map serves.
fn lobe_map_share(mirror: vec3<f32>, roughness: f32, footprint_sr: f32) -> f32 {
    let alpha = roughness * roughness;
    if is_cone(alpha) {
        return map_share(environment_level(mirror, lobe_solid_angle(alpha) + averaged(footprint_sr)));
    }
    return 1.0;
}

// Right and up of a lobe along an axis.
fn lobe_sides(axis: vec3<f32>) -> mat2x3<f32> {
    let side = select(vec3(0.0, 1.0, 0.0), vec3(1.0, 0.0, 0.0), abs(axis.y) > 0.9);
    let tangent = normalize(cross(side, axis));
    return mat2x3(tangent, cross(axis, tangent));
}

// Maps that were filtered once a video frame, between lobes of the two nearest widths. Lobes finer than the first are on
// their way to a cone.
fn lobe_prefiltered(mirror: vec3<f32>, lobe_sr: f32) -> vec3<f32> {
    let alpha = sqrt(lobe_sr / (4.0 * PI));
    let level = log2(alpha / PREFILTER_ALPHA) / log2(PREFILTER_RATIO);
    let filtered = textureSampleLevel(prefiltered, environment_sampler, mirror, max(level, 0.0)).rgb;
    if level >= 0.0 {
        return filtered;
    }
    let cone = environment_radiance(mirror, environment_level(mirror, lobe_sr));
    return mix(cone, filtered, clamp((alpha - MIRROR_ALPHA) / (PREFILTER_ALPHA - MIRROR_ALPHA), 0.0, 1.0));
}

// Iorns & Rhee 2015, Sec. 3.2 and 5: six rings of six samples, three within the radius at which a Phong lobe has fallen to
// a half and three beyond, each from the mip whose texels are as far apart as the samples of its ring.
fn lobe_iorns(mirror: vec3<f32>, lobe_sr: f32) -> vec3<f32> {
    let alpha2 = min(lobe_sr / (4.0 * PI), 0.95);
    // The Phong lobe that is as wide (Walter et al. 2007; four mirror directions to a half vector).
    let exponent = 0.5 / alpha2 - 0.5;
    let half_radius = acos(exp2(-1.0 / exponent));
    let sides = lobe_sides(mirror);
    var sum = vec3(0.0);
    var total = 0.0;
    for (var ring = 1u; ring <= 6u; ring++) {
        let angle = min(f32(ring) / 3.0 * half_radius, 0.5 * PI);
        // Neighbours on a ring of six are as far apart as the ring is wide.
        let level = environment_level(mirror, angle * angle);
        let weight = pow(max(cos(angle), 0.0), exponent);
        for (var i = 0u; i < 6u; i++) {
            let turn = f32(i) * PI / 3.0;
            let direction = cos(angle) * mirror + sin(angle) * (sides * vec2(cos(turn), sin(turn)));
            sum += weight * environment_radiance(direction, level);
            total += weight;
        }
    }
    return sum / total;
}

// Directions that stand for a lobe.
const LOBE_TAPS: u32 = 16u;

// Rays through normals drawn from the GGX distribution, each standing for its share of the lobe.
fn lobe_taps(mirror: vec3<f32>, lobe_sr: f32) -> vec3<f32> {
    let alpha = sqrt(lobe_sr / (4.0 * PI));
    let sides = lobe_sides(mirror);
    let share_sr = lobe_sr * 4.0 / f32(LOBE_TAPS);
    var sum = vec3(0.0);
    var turn = vec2(1.0, 0.0);
    var i = 0u;
    loop {
        let r2 = (f32(i) + 0.5) / f32(LOBE_TAPS);
        let spread = 2.0 * alpha * sqrt(r2 / (1.0 - min(r2, 0.9)));
        let direction = normalize(mirror + spread * (sides * turn));
        sum += environment_radiance(direction, environment_level(direction, share_sr));
        continuing {
            turn = turned(turn);
            i++;
            break if i >= LOBE_TAPS;
        }
    }
    return sum / f32(LOBE_TAPS);
}

// Solid angle between the directions of neighbouring pixels.
fn spanned(direction: vec3<f32>) -> f32 {
    return min(length(cross(dpdx(direction), dpdy(direction))), 4.0 * PI) + 1e-9;
}

// What a pixel that spans this much averages over: twice as much, since trilinear texels of its own size would show as they
// pass between pixels.
fn averaged(footprint_sr: f32) -> f32 {
    return 2.0 * footprint_sr;
}

// GGX lobe of this roughness around the mirror direction; `footprint_sr` is what one pixel spans.
fn lobe_radiance(mirror: vec3<f32>, roughness: f32, footprint_sr: f32) -> vec3<f32> {
    let alpha = roughness * roughness;
    let lobe_sr = lobe_solid_angle(alpha) + averaged(footprint_sr);
    if is_cone(alpha) {
        return cone_radiance(mirror, lobe_sr);
    }
    switch REFLECTIONS {
        case REFLECTIONS_IORNS: { return lobe_iorns(mirror, lobe_sr); }
        case REFLECTIONS_TAPS: { return lobe_taps(mirror, lobe_sr); }
        default: { return lobe_prefiltered(mirror, lobe_sr); }
    }
}
