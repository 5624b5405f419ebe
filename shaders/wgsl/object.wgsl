// Virtual objects: spherical harmonics, reflections, and the detected lights with their shadows.

#import "brdf.wgsl"
#import "occlusion.wgsl"
#import "reflection.wgsl"

@group(3) @binding(0) var base_color_map: texture_2d<f32>;
@group(3) @binding(1) var metallic_roughness_map: texture_2d<f32>;
@group(3) @binding(2) var material_sampler: sampler;

// What kind of surface a draw has: one of the SURFACE constants.
override SURFACE: u32 = 3u;
// The model's textures count.
override TEXTURED: bool = true;

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

@vertex
fn vs_object(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @builtin(instance_index) index: u32,
) -> ObjectVertex {
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

// Solid angle between the directions of neighbouring pixels.
fn spanned(direction: vec3<f32>) -> f32 {
    return min(length(cross(dpdx(direction), dpdy(direction))), 4.0 * PI) + 1e-9;
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

@fragment
fn fs_object(in: ObjectVertex, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    let v = normalize(view.position - in.world);
    let n = normalize(select(-in.normal, in.normal, front));
    let mirror = reflect(-v, n);
    let footprint_sr = spanned(mirror);
    var albedo = in.base_color.rgb;
    var roughness = in.base_color.a;
    var metallic = in.metallic;
    if TEXTURED {
        albedo *= textureSample(base_color_map, material_sampler, in.uv).rgb;
        let metallic_roughness = textureSample(metallic_roughness_map, material_sampler, in.uv);
        roughness *= metallic_roughness.g;
        metallic *= metallic_roughness.b;
    }
    roughness = clamp(roughness, 0.0, 1.0);
    metallic = clamp(metallic, 0.0, 1.0);

    let f0 = surface_f0(albedo, metallic);
    let weights = ambient_weights(f0, albedo, metallic, max(dot(n, v), 0.0), roughness);
    let around = reflected(in.world, mirror, roughness);
    let kept = neighbour_ratio(in.world, n, mirror, roughness, in.object);
    var radiance = weights.specular * kept.specular * around.radiance + weights.diffuse * kept.diffuse * sh_irradiance(n) / PI;

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
    return vec4(min(radiance, vec3(MAX_MAGNITUDE)), 1.0);
}
