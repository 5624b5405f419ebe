// Depth of a view for whoever shows it from a slightly other place: that of the nearest sample of what was drawn, and 0, infinitely far,
// where the panorama is seen.

#import "fullscreen.wgsl"
#import "frame.wgsl"

// Of the layer.
override SAMPLES: i32 = 4;

@group(1) @binding(0) var depth_samples: texture_depth_multisampled_2d;
@group(1) @binding(1) var depth_single: texture_depth_2d;

// In the layer; negative beside it.
fn layer_texel(at: vec2<f32>) -> vec2<i32> {
    let inside = at - view.layer_origin;
    let drawn = all(inside >= vec2(0.0)) && all(inside < view.layer_size);
    return select(vec2(-1), vec2<i32>(inside), drawn);
}

@fragment
fn fs_depth_samples(@builtin(position) at: vec4<f32>) -> @builtin(frag_depth) f32 {
    let texel = layer_texel(at.xy);
    var nearest = 0.0;
    for (var i = 0; i < SAMPLES && texel.x >= 0; i++) {
        nearest = max(nearest, textureLoad(depth_samples, texel, i));
    }
    return nearest;
}

@fragment
fn fs_depth_single(@builtin(position) at: vec4<f32>) -> @builtin(frag_depth) f32 {
    let texel = layer_texel(at.xy);
    if texel.x < 0 {
        return 0.0;
    }
    return textureLoad(depth_single, texel, 0);
}
