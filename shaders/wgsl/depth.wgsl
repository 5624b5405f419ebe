// Depth of a view for whoever shows it from a slightly other place: that of the nearest sample of what was drawn, and elsewhere that of the
// background: 0, infinitely far, unless it has a distance.

#import "fullscreen.wgsl"
#import "parallax.wgsl"

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

fn background_depth(at: vec2<f32>) -> f32 {
    if !PARALLAX {
        return 0.0;
    }
    let ray = ray_through(at);
    let clip = view.clip_from_world * vec4(view.position + ray * background_m(ray), 1.0);
    return clamp(clip.z / max(clip.w, 1e-6), 0.0, 1.0);
}

@fragment
fn fs_depth_samples(@builtin(position) at: vec4<f32>) -> @builtin(frag_depth) f32 {
    let texel = layer_texel(at.xy);
    var nearest = 0.0;
    for (var i = 0; i < SAMPLES && texel.x >= 0; i++) {
        nearest = max(nearest, textureLoad(depth_samples, texel, i));
    }
    if nearest > 0.0 {
        return nearest;
    }
    return background_depth(at.xy);
}

@fragment
fn fs_depth_single(@builtin(position) at: vec4<f32>) -> @builtin(frag_depth) f32 {
    let texel = layer_texel(at.xy);
    var drawn = 0.0;
    if texel.x >= 0 {
        drawn = textureLoad(depth_single, texel, 0);
    }
    if drawn > 0.0 {
        return drawn;
    }
    return background_depth(at.xy);
}
