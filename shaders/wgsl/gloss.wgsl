// Real surfaces as catchers of reflections: what a glossy one mirrors of the panorama is in the video already, and gives way to
// what it mirrors of the objects (differential rendering, Debevec 1998, Sec. 6; Rhee et al. 2017, Sec. 5 and 6.4).

#import "brdf.wgsl"
#import "occlusion.wgsl"
#import "reflection.wgsl"

// What the ground mirrors of the objects, with mips, premultiplied; and how near they are to it (see `mirrored`).
@group(3) @binding(0) var mirror_image: texture_2d_array<f32>;
@group(3) @binding(1) var mirror_nearness: texture_2d_array<f32>;
@group(3) @binding(2) var mirror_sampler: sampler;

// Rays of a lobe through the mirror image: to look for objects, and to show them.
const SEARCH_RAYS: u32 = 8u;
const MIRROR_RAYS: u32 = 20u;
// Of the normals' distribution, the part that the rays stand for: the rest is spread over the whole sky.
const KEPT_NORMALS: f32 = 0.9;

struct Gloss {
    // Share of the mirror lobe's light that comes back.
    weight: vec3<f32>,
    // Light of the lobe without objects.
    around: vec3<f32>,
}

// Of a surface that mirrors light from `mirror` to the eye. Rough lobes give way to none: beyond ROUGH_TO they are matt.
fn gloss(mirror: vec3<f32>, n_dot_v: f32, roughness: f32, f0: f32, footprint_sr: f32) -> Gloss {
    let ab = dfg(n_dot_v, roughness);
    let share = 1.0 - smoothstep(ROUGH_FROM, ROUGH_TO, roughness);
    return Gloss(vec3(share * (f0 * ab.x + ab.y)), lobe_radiance(mirror, roughness, footprint_sr));
}

// The video changed by what falls on the surface (`ratio`) and by what is mirrored in it: objects as premultiplied radiance, and
// the share of the lobe that they cover. What the video can have of the lobe's light is the lobe's; the rest is scattered light.
fn glossy_video(seen: vec3<f32>, ratio: vec3<f32>, own: Gloss, objects: vec3<f32>, covered: f32) -> vec3<f32> {
    let of_lobe = min(own.weight * own.around, seen);
    return (seen - of_lobe) * ratio + of_lobe * (1.0 - covered) + own.weight * objects;
}

// A ray of a lobe over level ground: from the surface, and the solid angle of the rays that it stands for.
struct LobeRay {
    direction: vec3<f32>,
    solid_angle_sr: f32,
    // Share of what the eye sees.
    weight: f32,
}

// Through normals of the GGX distribution at even quantiles, which the eye sees by their cosine (Walter et al. 2007, Eq. 35).
fn lobe_ray(index: u32, count: u32, turn: vec2<f32>, v: vec3<f32>, alpha: f32) -> LobeRay {
    let quantile = (f32(index) + 0.5) / f32(count) * KEPT_NORMALS;
    let slope = alpha * sqrt(quantile / (1.0 - quantile));
    let normal = normalize(vec3(turn.x * slope, 1.0, turn.y * slope));
    let cosine = dot(v, normal);
    let direction = 2.0 * cosine * normal - v;
    // Solid angle of normals over their quantile; four mirror directions to one, times the cosine.
    let density = PI * alpha * alpha * KEPT_NORMALS / ((1.0 - quantile) * (1.0 - quantile));
    let solid_angle_sr = 4.0 * max(cosine, 0.0) * density / f32(count);
    return LobeRay(direction, solid_angle_sr, select(0.0, cosine, cosine > 0.0 && direction.y > 0.02));
}

struct MirrorTap {
    // Premultiplied.
    image: vec4<f32>,
    nearness: f32,
}

// The mirror image around where a ray from the ground is at this distance.
fn mirror_tap(ground: vec3<f32>, ray: LobeRay, way_m: f32) -> MirrorTap {
    let up = ray.direction.y * way_m;
    let image = ground + vec3(ray.direction.x * way_m, -up, ray.direction.z * way_m);
    let clip = view.clip_from_world * vec4(image, 1.0);
    let size = vec2<f32>(textureDimensions(mirror_image));
    let pixel = (clip.xy / max(clip.w, 1e-3) * vec2(0.5, -0.5) + 0.5) * view.size_px - view.layer_origin;
    // Pixels across the disc that the ray stands for.
    let px_per_m = 0.5 * view.size_px.y / (length(view.world_from_ndc[1]) * max(clip.w, 1e-3));
    let across_px = 2.0 * sqrt(ray.solid_angle_sr / PI) * way_m * px_per_m;
    let level = log2(max(across_px, 1.0));
    let at = pixel / size;
    return MirrorTap(
        textureSampleLevel(mirror_image, mirror_sampler, at, view_at, level),
        textureSampleLevel(mirror_nearness, mirror_sampler, at, view_at, level).r,
    );
}

// Mean distance of the objects that a lobe meets when their image is looked at as if at this distance; negative for none.
fn search_mirrored(ground: vec3<f32>, v: vec3<f32>, alpha: f32, way_m: f32) -> f32 {
    var covered = 0.0;
    var nearness = 0.0;
    var turn = vec2(1.0, 0.0);
    for (var i = 0u; i < SEARCH_RAYS; i++) {
        let ray = lobe_ray(i, SEARCH_RAYS, turn, v, alpha);
        let tap = mirror_tap(ground, ray, way_m);
        covered += ray.weight * tap.image.a;
        nearness += ray.weight * tap.nearness;
        turn = turned(turn);
    }
    return select(-1.0, covered / max(nearness, 1e-9), covered > 0.0);
}

// What the ground's lobe sees of the objects: premultiplied radiance, and the share of the lobe that they cover. As far as they
// are away, so wide is the lobe there: sharp at a contact, blurred far above.
fn mirrored_objects(ground: vec3<f32>, v: vec3<f32>) -> vec4<f32> {
    let alpha = max(lighting.ground_roughness * lighting.ground_roughness, 1e-3);
    let farthest_m = lighting.highest_m / max(v.y, 0.05);
    var way_m = search_mirrored(ground, v, alpha, 0.5 * farthest_m);
    if way_m < 0.0 {
        return vec4(0.0);
    }
    let nearer_m = search_mirrored(ground, v, alpha, min(way_m, farthest_m));
    way_m = select(way_m, nearer_m, nearer_m > 0.0);
    var sum = vec4(0.0);
    var total = 0.0;
    var turn = vec2(1.0, 0.0);
    for (var i = 0u; i < MIRROR_RAYS; i++) {
        let ray = lobe_ray(i, MIRROR_RAYS, turn, v, alpha);
        sum += ray.weight * mirror_tap(ground, ray, min(way_m, farthest_m)).image;
        total += ray.weight;
        turn = turned(turn);
    }
    return sum / max(total, 1e-6);
}

// The same of a surface that no mirror image is drawn for: of the spheres that stand for the objects. Radiance, and what is left
// of the lobe.
fn mirrored_spheres(world: vec3<f32>, mirror: vec3<f32>, roughness: f32) -> vec4<f32> {
    let lobe_sr = lobe_solid_angle(roughness * roughness);
    var sum = vec3(0.0);
    var left = 1.0;
    for (var i = 0u; i < lighting.occluder_count; i++) {
        let occluder = occluders[i];
        let to_center = occluder.center - world;
        let share = sphere_in_cone(to_center, occluder.radius, mirror, lobe_sr);
        if share > 0.0 {
            sum = sum * (1.0 - share) + share * sphere_radiance(occluder, to_center, mirror);
            left *= 1.0 - share;
        }
    }
    return vec4(sum, left);
}

// Of a sphere where a ray meets it, or where it passes nearest: under all light, as the sphere casts no shadow on itself.
fn sphere_radiance(occluder: Occluder, to_center: vec3<f32>, ray: vec3<f32>) -> vec3<f32> {
    let along = dot(to_center, ray);
    let beside = dot(to_center, to_center) - along * along;
    let depth = sqrt(max(occluder.radius * occluder.radius - beside, 0.0));
    let normal = normalize(ray * (along - depth) - to_center);
    var falling = sh_irradiance(normal);
    for (var i = 0u; i < lighting.light_count; i++) {
        falling += lighting.lights[i].irradiance * max(dot(lighting.lights[i].direction, normal), 0.0);
    }
    return occluder.albedo * falling / PI + occluder.specular * sh_radiance(reflect(ray, normal));
}
