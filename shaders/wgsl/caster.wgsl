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
