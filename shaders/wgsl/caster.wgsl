// Depth of the objects as one light sees them.

#import "frame.wgsl"

struct Caster {
    clip_from_world: mat4x4<f32>,
}

@group(1) @binding(0) var<uniform> caster: Caster;

@vertex
fn vs_caster(@location(0) position: vec3<f32>, @builtin(instance_index) index: u32) -> @builtin(position) vec4<f32> {
    return caster.clip_from_world * (instances[index].world_from_object * vec4(position, 1.0));
}

struct SheerVertex {
    @builtin(position) clip: vec4<f32>,
    @location(0) @interpolate(flat) opacity: f32,
}

// Share of light that clear glass lets pass at its two surfaces, looked at straight.
const GLASS_PASSES: f32 = 0.92;

@vertex
fn vs_sheer(@location(0) position: vec3<f32>, @builtin(instance_index) index: u32) -> SheerVertex {
    let instance = instances[index];
    let passes = GLASS_PASSES * dot(instance.base_color, vec3(0.2126, 0.7152, 0.0722)) * f32(instance.glass);
    return SheerVertex(caster.clip_from_world * (instance.world_from_object * vec4(position, 1.0)), 1.0 - passes);
}

// A screen of as many texels as the surface keeps light: the filter of the shadow, some texels wide, takes their mean.
// Ordered dither (Bayer 1973), 4 x 4.
@fragment
fn fs_sheer(in: SheerVertex) {
    let at = vec2<u32>(in.clip.xy);
    let x = at.x ^ at.y;
    let rank = ((x & 1u) << 3u) | ((at.y & 1u) << 2u) | (x & 2u) | ((at.y & 2u) >> 1u);
    if in.opacity * 16.0 < f32(rank) + 0.5 {
        discard;
    }
}
