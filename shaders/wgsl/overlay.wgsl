// A small picture over the upper left corner, its pixels enlarged.

#import "fullscreen.wgsl"

// Pixels of the target to one of the picture, along a side.
override SCALE: f32 = 2.0;

@group(0) @binding(0) var picture: texture_2d<f32>;

@fragment
fn fs_overlay(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let texel = textureLoad(picture, vec2<i32>(at.xy / SCALE), 0);
    return vec4(texel.rgb * texel.a, texel.a);
}
