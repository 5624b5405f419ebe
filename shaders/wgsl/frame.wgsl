// What one frame knows: its view, its light, its objects.

#import "eye.wgsl"
#import "sh.wgsl"

struct View {
    clip_from_world: mat4x4<f32>,
    // Applied to (x, y, 1) in normalised device coordinates, y up: a ray, not of unit length.
    world_from_ndc: mat3x3<f32>,
    position: vec3<f32>,
    // 0 left, 1 right.
    eye: u32,
    size_px: vec2<f32>,
    // Corner of the image's part that the layer of objects and ground holds, and that part's size.
    layer_origin: vec2<f32>,
    layer_size: vec2<f32>,
    // Of the dome that the background lies on, metres.
    dome_m: f32,
    // Rays along each side of a pixel that show the background.
    rays: u32,
}

// What casts shadows, as one light sees it.
struct ShadowMap {
    // x, y in [-1, 1] and z in metres from the nearest caster, along the light.
    from_world: mat4x4<f32>,
    // Half the width of the frustum, metres.
    half_width_m: f32,
    // Metres from depth 0 to depth 1.
    range_m: f32,
    // Side of a texel, metres.
    texel_m: f32,
    // Layer of the maps' texture; negative for none.
    layer: i32,
}

// Where in a shadow map a caster can hide the light, a bit for each cell, up to a depth along the light, metres.
struct CasterCells {
    rows: array<vec4<u32>, 8>,
    clear_to_m: f32,
}

struct Light {
    direction: vec3<f32>,
    // Tangent of half the cone that the light fills.
    tan_radius: f32,
    irradiance: vec3<f32>,
    // Share of the light that the reflection map is without.
    cut: f32,
    // Of the virtual objects.
    objects: ShadowMap,
    // Of the real place.
    place: ShadowMap,
}

struct Lighting {
    sh: array<vec4<f32>, 25>,
    // Of the ground without objects: irradiance from the spherical harmonics, and from all there is.
    ground_ambient: vec3<f32>,
    light_count: u32,
    ground_before: vec3<f32>,
    // The first so many lights have shadow maps.
    shadow_count: u32,
    // Irradiance on the ground from the lights without shadow maps.
    ground_unshadowed: vec3<f32>,
    occluder_count: u32,
    // Reflectance of the ground as the video shows it.
    ground_reflectance: vec3<f32>,
    ground_y: f32,
    lights: array<Light, 8>,
    // By layer of the shadow maps.
    casters: array<CasterCells, 8>,
    // Corners of the ground that objects can change, x and z.
    ground_min: vec2<f32>,
    ground_max: vec2<f32>,
    // How the ground mirrors objects: perceptual roughness, and reflectance straight on.
    ground_roughness: f32,
    ground_f0: f32,
    // How high over the ground objects reach, metres.
    highest_m: f32,
    padding: f32,
}

struct Occluder {
    center: vec3<f32>,
    radius: f32,
    // Share of light sent back in all directions, and in mirror directions.
    albedo: vec3<f32>,
    object: u32,
    specular: vec3<f32>,
    padding: f32,
}

struct Instance {
    world_from_object: mat4x4<f32>,
    // Inverse transpose of the linear part.
    normal_from_object: mat3x3<f32>,
    base_color: vec3<f32>,
    roughness: f32,
    metallic: f32,
    // 1 for glass.
    glass: u32,
    object: u32,
    padding: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> lighting: Lighting;
@group(0) @binding(2) var<storage, read> instances: array<Instance>;
@group(0) @binding(3) var<uniform> occluders: array<Occluder, MAX_OCCLUDERS>;
@group(0) @binding(4) var shadow_maps: texture_depth_2d_array;
@group(0) @binding(5) var shadow_sampler: sampler_comparison;

fn sh_at(index: u32) -> vec3<f32> {
    return lighting.sh[index].rgb;
}

fn sh_irradiance(normal: vec3<f32>) -> vec3<f32> {
    return max(sh_sum(SH_COUNT, normal, IRRADIANCE_BAND), vec3(0.0));
}

fn sh_radiance(direction: vec3<f32>) -> vec3<f32> {
    return max(sh_sum(SH_COUNT, direction, RADIANCE_BAND), vec3(0.0));
}

// World direction through a point of the image given in pixels.
fn ray_through(pixel: vec2<f32>) -> vec3<f32> {
    let ndc = vec2(2.0, -2.0) * pixel / view.size_px + vec2(-1.0, 1.0);
    return normalize(view.world_from_ndc * vec3(ndc, 1.0));
}

// Points spread evenly over the unit disc (Vogel 1979): each turned by the golden angle from the one before.
fn turned(point: vec2<f32>) -> vec2<f32> {
    return vec2(dot(point, vec2(GOLDEN_COSINE, -GOLDEN_SINE)), dot(point, vec2(GOLDEN_SINE, GOLDEN_COSINE)));
}
