// Virtual objects: spherical harmonics, reflections, and the detected lights with their shadows.

#import "brdf.wgsl"
#import "shadow.wgsl"
#import "occlusion.wgsl"
#import "reflection.wgsl"
#import "material.wgsl"

// What kind of surface a draw has: one of the SURFACE constants.
override SURFACE: u32 = 3u;

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

// Ambient light kept by a surface beside other objects, and what they send back of their own colour.
fn neighbour_ratio(world: vec3<f32>, normal: vec3<f32>, own: u32) -> vec3<f32> {
    var kept = vec3(1.0);
    var i = next_occluder(0u, world, true, own);
    while i < lighting.occluder_count {
        let occluder = occluders[i];
        let factor = sphere_form_factor(occluder.center - world, occluder.radius, normal);
        kept *= 1.0 - factor * (1.0 - occluder.albedo);
        i = next_occluder(i + 1u, world, true, own);
    }
    return kept;
}

struct Reflected {
    radiance: vec3<f32>,
    // Shares of it that come from the spherical harmonics, which lack every light, and from the map, which lacks
    // those that are cut out of it.
    sh_share: f32,
    map_share: f32,
}

// Reflected radiance: the maps where the surface is smooth, spherical harmonics where it is rough.
fn reflected(mirror: vec3<f32>, roughness: f32, footprint_sr: f32) -> Reflected {
    if SURFACE == SURFACE_ROUGH {
        return Reflected(sh_irradiance(mirror) / PI, 1.0, 0.0);
    }
    if SURFACE == SURFACE_MIRROR {
        return Reflected(lobe_radiance(mirror, roughness, footprint_sr), 0.0, lobe_map_share(mirror, roughness, footprint_sr));
    }
    let rough = smoothstep(ROUGH_FROM, ROUGH_TO, roughness);
    var sum = Reflected(vec3(0.0), rough, 0.0);
    if rough > 0.0 {
        sum.radiance += rough * sh_irradiance(mirror) / PI;
    }
    if rough < 1.0 {
        sum.radiance += (1.0 - rough) * lobe_radiance(mirror, roughness, footprint_sr);
        sum.map_share = (1.0 - rough) * lobe_map_share(mirror, roughness, footprint_sr);
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
    let dx = dpdx(mirror);
    let dy = dpdy(mirror);
    let footprint_sr = min(length(cross(dx, dy)), 4.0 * PI) + 1e-9;
    let albedo = surface.albedo;
    let roughness = surface.roughness;
    let metallic = surface.metallic;
    if UNLIT {
        return vec4(min(albedo, vec3(MAX_MAGNITUDE)), 1.0) * surface.alpha;
    }

    let f0 = surface_f0(albedo, metallic);
    let weights = ambient_weights(f0, albedo, metallic, max(dot(n, v), 0.0), roughness);
    let kept = neighbour_ratio(in.world, n, in.object);
    let around = reflected(mirror, roughness, footprint_sr);
    var specular_kept = 1.0;
    if OCCLUSION_MAP {
        specular_kept = specular_occlusion(surface.occlusion, max(dot(n, v), 0.0), roughness);
    }
    var radiance = specular_kept * weights.specular * around.radiance + surface.occlusion * weights.diffuse * kept * sh_irradiance(n) / PI;

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
