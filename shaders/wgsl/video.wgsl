// The decoded video frame, sampled and decoded where it is needed. Filtering is bilinear on the code values.
//
// What stays for a whole stream is fixed when the pipeline is made: where pixels run in step, as on a processor
// without a GPU, a branch not taken costs as much as the one taken.

#import "equirect.wgsl"
#import "colour.wgsl"

struct Video {
    rgb_from_yuv: mat3x3<f32>,
    bt709_from_primaries: mat3x3<f32>,
    // Offset and scale in frame coordinates, left eye and right eye.
    eye_rect: array<vec4<f32>, 2>,
    yuv_offset: vec3<f32>,
    // Added to u before chroma is sampled: chroma sited on the left luma column (ITU-T H.273 type 0).
    chroma_shift_u: f32,
    recovery: Recovery,
}

// Transfer function of the code values.
override TRANSFER: u32 = 0u;
// Y, Cb, Cr planes instead of one RGBA texture.
override PLANAR: bool = false;
// An eye's panorama spans the frame from left to right.
override WHOLE_WIDTH: bool = false;
// How the lights' radiance is made from code values.
override LIFT: u32 = 0u;

@group(1) @binding(0) var<uniform> video: Video;
@group(1) @binding(1) var plane_0: texture_2d<f32>;
@group(1) @binding(2) var plane_1: texture_2d<f32>;
@group(1) @binding(3) var plane_2: texture_2d<f32>;
@group(1) @binding(4) var video_sampler: sampler;

// The sampler wraps in u where an eye spans the frame. Where it does not, the texel columns at the two
// ends of the eye's rectangle are blended by hand, so neither the seam nor the other eye shows.
fn plane_sample(plane: texture_2d<f32>, u: f32, v: f32, rect: vec4<f32>) -> vec4<f32> {
    let half_texel = 0.5 / vec2<f32>(textureDimensions(plane));
    let y = clamp(rect.y + v * rect.w, rect.y + half_texel.y, rect.y + rect.w - half_texel.y);
    if WHOLE_WIDTH {
        return textureSampleLevel(plane, video_sampler, vec2(u, y), 0.0);
    }
    let x = rect.x + fract(u) * rect.z;
    let left = rect.x + half_texel.x;
    let right = rect.x + rect.z - half_texel.x;
    let inside = textureSampleLevel(plane, video_sampler, vec2(clamp(x, left, right), y), 0.0);
    if x >= left && x <= right {
        return inside;
    }
    let across = textureSampleLevel(plane, video_sampler, vec2(select(left, right, x < left), y), 0.0);
    let beyond = max(left - x, x - right) / (2.0 * half_texel.x);
    return mix(inside, across, beyond);
}

// R'G'B' code values at a point of one eye's panorama.
fn video_code(uv: vec2<f32>, eye: u32) -> vec3<f32> {
    let rect = video.eye_rect[eye];
    if !PLANAR {
        return plane_sample(plane_0, uv.x, uv.y, rect).rgb;
    }
    return planar_code(plane_sample(plane_0, uv.x, uv.y, rect).r, uv, rect);
}

// Of this luma, with the chroma of a point.
fn planar_code(luma: f32, uv: vec2<f32>, rect: vec4<f32>) -> vec3<f32> {
    let chroma_u = uv.x + video.chroma_shift_u / rect.z;
    let yuv = vec3(
        luma,
        plane_sample(plane_1, chroma_u, uv.y, rect).r,
        plane_sample(plane_2, chroma_u, uv.y, rect).r,
    );
    return video.rgb_from_yuv * (yuv - video.yuv_offset);
}

// What the eye sees of the video in a direction: codes beyond the range included, as the stream has them.
fn video_radiance(direction: vec3<f32>, eye: u32) -> vec3<f32> {
    return linear_from_code(TRANSFER, video.bt709_from_primaries, video_code(uv_from_direction(direction), eye));
}

// The radiance that lights are taken from, of a pixel that looks in this direction.
fn lifted_from_code(direction: vec3<f32>, code: vec3<f32>) -> vec3<f32> {
    return radiance_from_code(LIFT, video.recovery, TRANSFER, video.bt709_from_primaries, direction, code);
}
