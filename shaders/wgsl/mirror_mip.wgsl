// Halves the mirror image and its nearness: the mean of four texels, which bilinear sampling between them gives.

#import "eye.wgsl"
#import "fullscreen.wgsl"

@group(0) @binding(0) var finer_image: texture_2d_array<f32>;
@group(0) @binding(1) var finer_nearness: texture_2d_array<f32>;
@group(0) @binding(2) var finer_sampler: sampler;

struct Halved {
    @location(0) image: vec4<f32>,
    @location(1) nearness: vec4<f32>,
}

@fragment
fn fs_mirror_mip(@builtin(position) at: vec4<f32>) -> Halved {
    let uv = 2.0 * at.xy / vec2<f32>(textureDimensions(finer_image));
    return Halved(
        textureSampleLevel(finer_image, finer_sampler, uv, view_at, 0.0),
        textureSampleLevel(finer_nearness, finer_sampler, uv, view_at, 0.0),
    );
}
