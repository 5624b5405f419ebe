// What a surface is at a point: the instance's values, the model's textures, and the vertex's own.
//
// Each texture and each kind of alpha is an override, so that a draw does no more than its material asks for.

struct TextureMap {
    // Rows of the transform of (u, v, 1); u.w is 1 for the second set of coordinates.
    u: vec4<f32>,
    v: vec4<f32>,
}

struct Material {
    // Base colour, metallic-roughness, normal, occlusion, emission.
    maps: array<TextureMap, 5>,
    emission: vec3<f32>,
    normal_scale: f32,
    occlusion_strength: f32,
    alpha: f32,
    alpha_cutoff: f32,
    padding: f32,
}

@group(3) @binding(0) var<uniform> material: Material;
@group(3) @binding(1) var base_color_map: texture_2d<f32>;
@group(3) @binding(2) var metallic_roughness_map: texture_2d<f32>;
@group(3) @binding(3) var normal_map: texture_2d<f32>;
@group(3) @binding(4) var occlusion_map: texture_2d<f32>;
@group(3) @binding(5) var emission_map: texture_2d<f32>;
@group(3) @binding(6) var base_color_sampler: sampler;
@group(3) @binding(7) var metallic_roughness_sampler: sampler;
@group(3) @binding(8) var normal_sampler: sampler;
@group(3) @binding(9) var occlusion_sampler: sampler;
@group(3) @binding(10) var emission_sampler: sampler;

override BASE_COLOR_MAP: bool = true;
override METALLIC_ROUGHNESS_MAP: bool = true;
override NORMAL_MAP: bool = true;
override OCCLUSION_MAP: bool = true;
override EMISSION_MAP: bool = true;
// Some texture's coordinates are transformed, or are of the second set.
override UV_TRANSFORMS: bool = true;
override EMISSIVE: bool = true;
override UNLIT: bool = false;
// One of the ALPHA constants.
override ALPHA: u32 = 2u;
// The mesh has tangents of its own.
override TANGENTS: bool = true;
// A pixel of objects and ground.
override SAMPLES: u32 = 4u;

// What a vertex may have beyond position, normal and first texture coordinates.
struct VertexDetail {
    tangent: vec4<f32>,
    uv1: vec2<f32>,
    color: vec4<f32>,
}

const NO_DETAIL = VertexDetail(vec4<f32>(0.0), vec2<f32>(0.0), vec4<f32>(1.0));

struct SurfacePoint {
    albedo: vec3<f32>,
    roughness: f32,
    metallic: f32,
    // Unit, on the side that is seen.
    normal: vec3<f32>,
    // Share of ambient light that comes through.
    occlusion: f32,
    // Radiance of its own.
    emission: vec3<f32>,
    alpha: f32,
}

fn map_uv(index: u32, uv: vec2<f32>, uv1: vec2<f32>) -> vec2<f32> {
    if !UV_TRANSFORMS {
        return uv;
    }
    let map = material.maps[index];
    let at = vec3(select(uv, uv1, map.u.w > 0.5), 1.0);
    return vec2(dot(map.u.xyz, at), dot(map.v.xyz, at));
}

// Directions on the surface in which u and v grow, the larger a unit vector: the frame of a mesh without tangents
// (Schüler 2013, "Normal mapping without precomputed tangents"). It needs no data, follows every pose, and mirrored
// coordinates come out right; in return it is constant over a triangle.
fn cotangents(n: vec3<f32>, world: vec3<f32>, uv: vec2<f32>) -> mat2x3<f32> {
    let across = dpdx(world);
    let down = dpdy(world);
    let u = vec2(dpdx(uv.x), dpdy(uv.x));
    let v = vec2(dpdx(uv.y), dpdy(uv.y));
    let from_across = cross(down, n);
    let from_down = cross(n, across);
    // Rows count downwards: the pair is turned over with the triangle.
    let side = sign(dot(across, from_across));
    let t = (from_across * u.x + from_down * u.y) * side;
    let b = (from_across * v.x + from_down * v.y) * side;
    let longest = max(dot(t, t), dot(b, b));
    // No frame without coordinates: only the length along the normal counts.
    let scale = select(0.0, inverseSqrt(longest), longest > 0.0);
    return mat2x3(t * scale, b * scale);
}

// The normal of the map in the world, before it is turned to the side that is seen; green points up the image, against v.
fn mapped_normal(code: vec3<f32>, n: vec3<f32>, tangent: vec4<f32>, world: vec3<f32>, uv: vec2<f32>) -> vec3<f32> {
    let mapped = (code * 2.0 - 1.0) * vec3(material.normal_scale, material.normal_scale, 1.0);
    if TANGENTS {
        // The frame is interpolated as it is, without being made orthogonal: as the maps are baked (Mikkelsen 2008).
        let t = tangent.xyz;
        return normalize(t * mapped.x + cross(n, t) * (tangent.w * mapped.y) + n * mapped.z);
    }
    let frame = cotangents(n, world, uv);
    return normalize(frame[0] * mapped.x - frame[1] * mapped.y + n * mapped.z);
}

fn base_color(factor: vec3<f32>, uv: vec2<f32>, detail: VertexDetail) -> vec4<f32> {
    var color = vec4(factor, 1.0) * detail.color;
    if BASE_COLOR_MAP {
        color *= textureSample(base_color_map, base_color_sampler, map_uv(0u, uv, detail.uv1));
    }
    if ALPHA == ALPHA_OPAQUE {
        color.a = 1.0;
    } else {
        color.a *= material.alpha;
    }
    return color;
}

// All of a surface at one point. In uniform control flow: it takes derivatives.
fn surface_point(
    base: vec4<f32>,
    metallic: f32,
    world: vec3<f32>,
    vertex_normal: vec3<f32>,
    uv: vec2<f32>,
    detail: VertexDetail,
    front: bool,
) -> SurfacePoint {
    let color = base_color(base.rgb, uv, detail);
    var point = SurfacePoint(color.rgb, base.a, metallic, normalize(vertex_normal), 1.0, vec3(0.0), color.a);
    if METALLIC_ROUGHNESS_MAP {
        let map = textureSample(metallic_roughness_map, metallic_roughness_sampler, map_uv(1u, uv, detail.uv1));
        point.roughness *= map.g;
        point.metallic *= map.b;
    }
    if NORMAL_MAP {
        let at = map_uv(2u, uv, detail.uv1);
        let map = textureSample(normal_map, normal_sampler, at);
        point.normal = mapped_normal(map.rgb, point.normal, detail.tangent, world, at);
        // Alpha is the GGX alpha of the normals that a texel stands for, see `scene::texture`.
        let alpha = point.roughness * point.roughness;
        let spread = map.a * material.normal_scale;
        point.roughness = sqrt(sqrt(alpha * alpha + spread * spread));
    }
    if OCCLUSION_MAP {
        let map = textureSample(occlusion_map, occlusion_sampler, map_uv(3u, uv, detail.uv1));
        point.occlusion = 1.0 + material.occlusion_strength * (map.r - 1.0);
    }
    if EMISSIVE {
        point.emission = material.emission;
        if EMISSION_MAP {
            point.emission *= textureSample(emission_map, emission_sampler, map_uv(4u, uv, detail.uv1)).rgb;
        }
    }
    point.normal = select(-point.normal, point.normal, front);
    point.roughness = clamp(point.roughness, 0.0, 1.0);
    point.metallic = clamp(point.metallic, 0.0, 1.0);
    return point;
}

// Share of reflected ambient light that occlusion leaves (Lagarde & de Rousiers 2014, Sec. 4.10.2).
fn specular_occlusion(occlusion: f32, n_dot_v: f32, roughness: f32) -> f32 {
    return clamp(pow(n_dot_v + occlusion, exp2(-16.0 * roughness - 1.0)) - 1.0 + occlusion, 0.0, 1.0);
}

// Samples that a mask's edge covers: alpha made as steep as one pixel, about the cutoff. In uniform control flow.
fn mask_samples(alpha: f32) -> u32 {
    let covered = clamp((alpha - material.alpha_cutoff) / max(fwidth(alpha), 1e-4) + 0.5, 0.0, 1.0);
    return (1u << u32(covered * f32(SAMPLES) + 0.5)) - 1u;
}
