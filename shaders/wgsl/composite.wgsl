// The picture: video where nothing was drawn, the layer of objects and changed ground elsewhere.
//
// The layer holds premultiplied radiance. Where nothing was drawn it is exactly 0 in all four channels, so
// the pixel is video × 1 + 0: the same bits as with no object in the scene.

#import "fullscreen.wgsl"
#import "frame.wgsl"
#import "parallax.wgsl"
#import "video.wgsl"

// The target stores sRGB codes that the shader must make.
override ENCODE_SRGB: bool = false;

@group(2) @binding(0) var layer: texture_2d<f32>;

@fragment
fn fs_composite(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let inside = at.xy - view.layer_origin;
    var drawn = vec4(0.0);
    if all(inside >= vec2(0.0)) && all(inside < view.layer_size) {
        drawn = textureLoad(layer, vec2<i32>(inside), 0);
    }
    var colour = drawn.rgb;
    if drawn.a < 1.0 {
        colour += video_radiance(filmed_along(ray_through(at.xy)), view.eye) * (1.0 - drawn.a);
    }
    if ENCODE_SRGB {
        let shown = clamp(colour, vec3(0.0), vec3(1.0));
        colour = vec3(srgb_encode(shown.r), srgb_encode(shown.g), srgb_encode(shown.b));
    }
    return vec4(colour, 1.0);
}
