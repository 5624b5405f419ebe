// The picture: video where nothing was drawn, the layer of objects and changed ground elsewhere.
//
// The layer holds premultiplied radiance. Where nothing was drawn it is exactly 0 in all four channels, so
// the pixel is video × 1 + 0: the same bits as with no object in the scene.

#import "fullscreen.wgsl"
#import "background.wgsl"

// The target stores sRGB codes of 8 bits.
override EIGHT_BITS: bool = false;
// Which the shader must make.
override ENCODE_SRGB: bool = false;

@group(2) @binding(0) var layer: texture_2d_array<f32>;

// In (-0.5, 0.5), all of 64 values once in each 8 × 8 pixels (Bayer 1973): a slow gradient keeps its mean, and a code that is one
// already stays.
fn ordered_dither(at: vec2<u32>) -> f32 {
    let x = at.x ^ at.y;
    let low = ((x & 1u) << 5u) | ((at.y & 1u) << 4u) | ((x & 2u) << 2u) | ((at.y & 2u) << 1u);
    let rank = low | ((x & 4u) >> 1u) | ((at.y & 4u) >> 2u);
    return (f32(rank) + 0.5) / 64.0 - 0.5;
}

@fragment
fn fs_composite(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let inside = at.xy - view.layer_origin;
    var drawn = vec4(0.0);
    if all(inside >= vec2(0.0)) && all(inside < view.layer_size) {
        drawn = textureLoad(layer, vec2<i32>(inside), view_at, 0);
    }
    var colour = drawn.rgb;
    if drawn.a < 1.0 {
        colour += background(at.xy) * (1.0 - drawn.a);
    }
    if EIGHT_BITS {
        let shown = clamp(colour, vec3(0.0), vec3(1.0));
        let dither = ordered_dither(vec2<u32>(at.xy)) / 255.0;
        if ENCODE_SRGB {
            colour = vec3(srgb_encode(shown.r), srgb_encode(shown.g), srgb_encode(shown.b)) + dither;
        } else {
            // The target encodes: the same step of a code, in light.
            colour = shown + dither * max(2.4 / 1.055 * pow(shown, vec3(1.4 / 2.4)), vec3(1.0 / 12.92));
        }
    }
    return vec4(colour, 1.0);
}
