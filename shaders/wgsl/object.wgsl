// Virtual objects: spherical harmonics, reflections, and the detected lights with their shadows.

#import "brdf.wgsl"
#import "occlusion.wgsl"
#import "reflection.wgsl"
#import "material.wgsl"

struct ObjectVertex {
    @builtin(position) clip: vec4<f32>,
    @location(0) world: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    // RGB, and roughness.
    @location(3) @interpolate(flat) base_color: vec4<f32>,
    @location(4) @interpolate(flat) metallic: f32,
    @location(5) @interpolate(flat) object: u32,
}

fn object_vertex(position: vec3<f32>, normal: vec3<f32>, uv: vec2<f32>, index: u32) -> ObjectVertex {
    let world = instances[index].world_from_object * vec4(position, 1.0);
    return ObjectVertex(
        view.clip_from_world * world,
        world.xyz,
        instances[index].normal_from_object * normal,
        uv,
        vec4(instances[index].base_color, instances[index].roughness),
        instances[index].metallic,
        instances[index].object,
    );
}

@vertex
fn vs_object(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @builtin(instance_index) index: u32,
) -> ObjectVertex {
    return object_vertex(position, normal, uv, index);
}

// The same for meshes that have more than position, normal and first texture coordinates.
struct DetailedVertex {
    @builtin(position) clip: vec4<f32>,
    @location(0) world: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @location(3) @interpolate(flat) base_color: vec4<f32>,
    @location(4) @interpolate(flat) metallic: f32,
    @location(5) @interpolate(flat) object: u32,
    @location(6) tangent: vec4<f32>,
    @location(7) uv1: vec2<f32>,
    @location(8) color: vec4<f32>,
}

@vertex
fn vs_object_detailed(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @location(3) tangent: vec4<f32>,
    @location(4) uv1: vec2<f32>,
    @location(5) color: vec4<f32>,
    @builtin(instance_index) index: u32,
) -> DetailedVertex {
    let plain = object_vertex(position, normal, uv, index);
    let along = instances[index].world_from_object * vec4(tangent.xyz, 0.0);
    // Made a unit before it is interpolated, as the normal is for the same frame.
    let unit = along.xyz * inverseSqrt(max(dot(along.xyz, along.xyz), 1e-20));
    let world_tangent = vec4(unit, tangent.w);
    return DetailedVertex(
        plain.clip, plain.world, plain.normal, plain.uv, plain.base_color, plain.metallic, plain.object, world_tangent, uv1, color,
    );
}

struct Kept {
    diffuse: vec3<f32>,
    specular: vec3<f32>,
}

// Ambient light kept by a surface beside other objects, over its hemisphere and in its lobe, and what they send back of their
// own colour. A mirror keeps all of its light: in it, the spheres would show as what they are.
fn neighbour_ratio(world: vec3<f32>, normal: vec3<f32>, mirror: vec3<f32>, roughness: f32, own: u32) -> Kept {
    var kept = Kept(vec3(1.0), vec3(1.0));
    let lobe_sr = lobe_solid_angle(roughness * roughness);
    var i = next_occluder(0u, world, true, own);
    while i < lighting.occluder_count {
        let occluder = occluders[i];
        let to_center = occluder.center - world;
        let lost = 1.0 - occluder.albedo - occluder.specular;
        kept.diffuse *= 1.0 - sphere_form_factor(to_center, occluder.radius, normal) * lost;
        if SURFACE != SURFACE_MIRROR {
            kept.specular *= 1.0 - sphere_in_lobe(to_center, occluder.radius, mirror, lobe_sr) * lost;
        }
        i = next_occluder(i + 1u, world, true, own);
    }
    return kept;
}

// What the mirror ray meets.
struct Met {
    // In which the panorama, taken at the world's origin, shows it.
    direction: vec3<f32>,
    // Share of its light that objects leave it.
    ratio: vec3<f32>,
}

// The ground where the ray falls on it, else what is far away. A lobe of GGX alpha a spans 2a/y² times the surface's height of
// the ground about a ray of slope y; the more that is, the less of it is shade.
fn met_by(world: vec3<f32>, mirror: vec3<f32>, roughness: f32) -> Met {
    let height_m = world.y - lighting.ground_y;
    if mirror.y > -1e-4 || height_m <= 0.0 || lighting.ground_y >= 0.0 {
        return Met(mirror, vec3(1.0));
    }
    let point = world - mirror * (height_m / mirror.y);
    var ratio = vec3(1.0);
    if all(point.xz > lighting.ground_min) && all(point.xz < lighting.ground_max) {
        let span = 2.0 * roughness * roughness / (mirror.y * mirror.y);
        let shaded = real_ratio(point, vec3(0.0, 1.0, 0.0), lighting.ground_ambient, lighting.ground_unshadowed);
        ratio = mix(vec3(1.0), shaded, 1.0 / (1.0 + span * span));
    }
    return Met(normalize(point), ratio);
}

struct Reflected {
    radiance: vec3<f32>,
    // Shares of it that come from the spherical harmonics, which lack every light, and from the map, which lacks
    // those that are cut out of it.
    sh_share: f32,
    map_share: f32,
}

// Reflected radiance: the maps where the surface is smooth, spherical harmonics where it is rough.
fn reflected(world: vec3<f32>, mirror: vec3<f32>, roughness: f32) -> Reflected {
    if SURFACE == SURFACE_ROUGH {
        return Reflected(sh_irradiance(mirror) / PI, 1.0, 0.0);
    }
    let met = met_by(world, mirror, roughness);
    let footprint_sr = spanned(met.direction);
    let share = lobe_map_share(met.direction, roughness, footprint_sr);
    if SURFACE == SURFACE_MIRROR {
        return Reflected(met.ratio * lobe_radiance(met.direction, roughness, footprint_sr), 0.0, share);
    }
    let rough = smoothstep(ROUGH_FROM, ROUGH_TO, roughness);
    var sum = Reflected(vec3(0.0), rough, (1.0 - rough) * share);
    if rough > 0.0 {
        sum.radiance += rough * sh_irradiance(mirror) / PI;
    }
    if rough < 1.0 {
        sum.radiance += (1.0 - rough) * met.ratio * lobe_radiance(met.direction, roughness, footprint_sr);
    }
    return sum;
}

fn visibility_of_light(index: u32, world: vec3<f32>, normal: vec3<f32>) -> f32 {
    if index < lighting.shadow_count {
        return light_visibility(index, world, normal);
    }
    return 1.0;
}

// Radiance of a surface, premultiplied by its alpha.
fn shaded(in: ObjectVertex, surface: SurfacePoint) -> vec4<f32> {
    let v = normalize(view.position - in.world);
    let n = surface.normal;
    let mirror = reflect(-v, n);
    let footprint_sr = spanned(mirror);
    let albedo = surface.albedo;
    let roughness = surface.roughness;
    let metallic = surface.metallic;
    if UNLIT {
        return vec4(min(albedo, vec3(MAX_MAGNITUDE)), 1.0) * surface.alpha;
    }

    let f0 = surface_f0(albedo, metallic);
    let weights = ambient_weights(f0, albedo, metallic, max(dot(n, v), 0.0), roughness);
    let around = reflected(in.world, mirror, roughness);
    let kept = neighbour_ratio(in.world, n, mirror, roughness, in.object);
    var specular_kept = kept.specular;
    if OCCLUSION_MAP {
        specular_kept *= specular_occlusion(surface.occlusion, max(dot(n, v), 0.0), roughness);
    }
    var radiance = specular_kept * weights.specular * around.radiance;
    radiance += surface.occlusion * weights.diffuse * kept.diffuse * sh_irradiance(n) / PI;

    for (var i = 0u; i < lighting.light_count; i++) {
        let light = lighting.lights[i];
        let cosine = dot(n, light.direction);
        if cosine > 0.0 {
            // A highlight for as much of the reflection as lacks the light: on top of the rest it would count twice.
            let lacking = around.sh_share + light.cut * around.map_share;
            let specular = lacking * highlight(weights, f0, n, v, light.direction, roughness, light.tan_radius, footprint_sr);
            radiance += light.irradiance * visibility_of_light(i, in.world, n) * (specular + weights.diffuse * cosine / PI);
        }
    }
    return vec4(min(radiance + surface.emission, vec3(MAX_MAGNITUDE)), 1.0) * surface.alpha;
}

fn plain_point(in: ObjectVertex, front: bool) -> SurfacePoint {
    return surface_point(in.base_color, in.metallic, in.world, in.normal, in.uv, NO_DETAIL, front);
}

fn detailed_point(in: DetailedVertex, front: bool) -> SurfacePoint {
    let detail = VertexDetail(in.tangent, in.uv1, in.color);
    return surface_point(in.base_color, in.metallic, in.world, in.normal, in.uv, detail, front);
}

fn without_detail(in: DetailedVertex) -> ObjectVertex {
    return ObjectVertex(in.clip, in.world, in.normal, in.uv, in.base_color, in.metallic, in.object);
}

@fragment
fn fs_object(in: ObjectVertex, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    return shaded(in, plain_point(in, front));
}

@fragment
fn fs_object_detailed(in: DetailedVertex, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    return shaded(without_detail(in), detailed_point(in, front));
}

// Alpha to coverage by the shader: the layer is premultiplied, so samples that are covered have to have an alpha of 1,
// which the fixed function would take from the same number as the coverage.
struct Masked {
    @location(0) radiance: vec4<f32>,
    @builtin(sample_mask) samples: u32,
}

fn masked(in: ObjectVertex, point: SurfacePoint) -> Masked {
    let samples = mask_samples(point.alpha);
    if samples == 0u {
        discard;
    }
    var whole = point;
    whole.alpha = 1.0;
    return Masked(shaded(in, whole), samples);
}

@fragment
fn fs_object_masked(in: ObjectVertex, @builtin(front_facing) front: bool) -> Masked {
    return masked(in, plain_point(in, front));
}

@fragment
fn fs_object_detailed_masked(in: DetailedVertex, @builtin(front_facing) front: bool) -> Masked {
    return masked(without_detail(in), detailed_point(in, front));
}

// What the ground mirrors of an object: the radiance that leaves it towards the eye's image, premultiplied by its alpha.
struct Mirrored {
    @location(0) radiance: vec4<f32>,
    // Alpha over the way from the ground to the surface, per metre: their mean is nearer to the nearest.
    @location(1) nearness: vec4<f32>,
}

// Drawn from the eye's image beneath the ground, `view.position`, whose rays pass the ground on their way up.
fn mirrored(in: ObjectVertex, point: SurfacePoint) -> Mirrored {
    let above_m = in.world.y - lighting.ground_y;
    let hidden = above_m < 0.0 || (ALPHA == ALPHA_MASK && point.alpha < material.alpha_cutoff);
    var whole = point;
    if ALPHA == ALPHA_MASK {
        whole.alpha = 1.0;
    }
    let radiance = shaded(in, whole);
    if hidden {
        discard;
    }
    let beneath_m = lighting.ground_y - view.position.y;
    let way_m = distance(in.world, view.position) * above_m / max(above_m + beneath_m, 1e-6);
    return Mirrored(radiance, vec4(radiance.a / max(way_m, NEAREST_MIRRORED_M), 0.0, 0.0, radiance.a));
}

// Nearer than this to the ground, what it mirrors is as sharp as here.
const NEAREST_MIRRORED_M: f32 = 0.005;

@fragment
fn fs_object_mirrored(in: ObjectVertex, @builtin(front_facing) front: bool) -> Mirrored {
    return mirrored(in, plain_point(in, front));
}

@fragment
fn fs_object_detailed_mirrored(in: DetailedVertex, @builtin(front_facing) front: bool) -> Mirrored {
    return mirrored(without_detail(in), detailed_point(in, front));
}
