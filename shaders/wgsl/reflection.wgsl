// What a lobe around a direction sees of the lifted panorama.

#import "frame.wgsl"
#import "video.wgsl"

@group(2) @binding(0) var environment: texture_2d<f32>;
@group(2) @binding(1) var environment_sampler: sampler;

// The mip level whose texels have this solid angle in this direction.
fn environment_level(direction: vec3<f32>, solid_angle_sr: f32) -> f32 {
    let size = vec2<f32>(textureDimensions(environment));
    let cosine = max(sqrt(max(1.0 - direction.y * direction.y, 0.0)), 1.0 / size.y);
    let texel_sr = 2.0 * PI * PI / (size.x * size.y) * cosine;
    return 0.5 * log2(solid_angle_sr / texel_sr);
}

fn environment_radiance(direction: vec3<f32>, level: f32) -> vec3<f32> {
    return textureSampleLevel(environment, environment_sampler, uv_from_direction(direction), max(level, 0.0)).rgb;
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

// Directions that stand for a lobe.
const LOBE_TAPS: u32 = 16u;

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
        return map_share(environment_level(mirror, lobe_solid_angle(alpha) + footprint_sr));
    }
    return 1.0;
}

// GGX lobe of this roughness around the mirror direction; `footprint_sr` is what one pixel spans.
fn lobe_radiance(mirror: vec3<f32>, roughness: f32, footprint_sr: f32) -> vec3<f32> {
    let alpha = roughness * roughness;
    let lobe_sr = lobe_solid_angle(alpha);
    if is_cone(alpha) {
        return cone_radiance(mirror, lobe_sr + footprint_sr);
    }
    // Rays through normals drawn from the GGX distribution, each standing for its share of the lobe.
    let side = normalize(select(vec3(0.0, 1.0, 0.0), vec3(1.0, 0.0, 0.0), abs(mirror.y) > 0.9));
    let tangent = normalize(cross(side, mirror));
    let bitangent = cross(mirror, tangent);
    let share_sr = max(lobe_sr * 4.0 / f32(LOBE_TAPS), footprint_sr);
    var sum = vec3(0.0);
    var turn = vec2(1.0, 0.0);
    var i = 0u;
    loop {
        let r2 = (f32(i) + 0.5) / f32(LOBE_TAPS);
        let spread = 2.0 * alpha * sqrt(r2 / (1.0 - min(r2, 0.9)));
        let direction = normalize(mirror + spread * (turn.x * tangent + turn.y * bitangent));
        sum += environment_radiance(direction, environment_level(direction, share_sr));
        continuing {
            turn = turned(turn);
            i++;
            break if i >= LOBE_TAPS;
        }
    }
    return sum / f32(LOBE_TAPS);
}
