// The video behind a pixel.

#import "parallax.wgsl"
#import "video.wgsl"

// Pixels are finer than the video's texels, and its codes are a picture's.
override MAGNIFIED: bool = false;

// A texel of one eye's panorama, which goes on beyond its ends: around the seam, and over the poles down the other side.
fn panorama_texel(plane: texture_2d<f32>, at: vec2<i32>, origin: vec2<i32>, size: vec2<i32>) -> vec4<f32> {
    let beyond = at.y < 0 || at.y >= size.y;
    let y = select(at.y, select(2 * size.y - 1 - at.y, -1 - at.y, at.y < 0), beyond);
    let x = at.x + select(0, size.x / 2, beyond);
    // The remainder of a negative number is negative.
    let around = ((x % size.x) + size.x) % size.x;
    return textureLoad(plane, origin + vec2(around, clamp(y, 0, size.y - 1)), 0);
}

// Weights of four texels around a place between the middle two: Catmull & Rom 1974, which keeps detail that linear weights lose.
fn cubic_weights(t: f32) -> vec4<f32> {
    let t2 = t * t;
    let t3 = t2 * t;
    return 0.5 * vec4(2.0 * t2 - t3 - t, 3.0 * t3 - 5.0 * t2 + 2.0, 4.0 * t2 - 3.0 * t3 + t, t3 - t2);
}

fn cubic_sample(plane: texture_2d<f32>, uv: vec2<f32>, rect: vec4<f32>) -> vec4<f32> {
    let whole = vec2<f32>(textureDimensions(plane));
    let size = round(rect.zw * whole);
    let place = uv * size - 0.5;
    let first = floor(place);
    let across = cubic_weights(place.x - first.x);
    let down = cubic_weights(place.y - first.y);
    let origin = vec2<i32>(round(rect.xy * whole));
    let corner = vec2<i32>(first) - 1;
    var sum = vec4(0.0);
    for (var row = 0; row < 4; row++) {
        var line = vec4(0.0);
        for (var column = 0; column < 4; column++) {
            line += across[column] * panorama_texel(plane, corner + vec2(column, row), origin, vec2<i32>(size));
        }
        sum += down[row] * line;
    }
    return sum;
}

// As `video_code`. Of planes, luma alone: the eye sees no detail in chroma, which has half of it anyway.
fn magnified_code(uv: vec2<f32>, eye: u32) -> vec3<f32> {
    let rect = video.eye_rect[eye];
    if !PLANAR {
        return cubic_sample(plane_0, uv, rect).rgb;
    }
    return planar_code(cubic_sample(plane_0, uv, rect).r, uv, rect);
}

fn background_radiance(direction: vec3<f32>) -> vec3<f32> {
    if MAGNIFIED {
        return linear_from_code(TRANSFER, video.bt709_from_primaries, magnified_code(uv_from_direction(direction), view.eye));
    }
    return video_radiance(direction, view.eye);
}

// Mean radiance over a pixel of the image, by as many rays as its texels ask for. Rays through parts of a pixel know neither seam
// nor poles, as derivatives of u would.
fn background(pixel: vec2<f32>) -> vec3<f32> {
    let step = 1.0 / f32(view.rays);
    var sum = vec3(0.0);
    for (var y = 0u; y < view.rays; y++) {
        for (var x = 0u; x < view.rays; x++) {
            let part = (vec2(f32(x), f32(y)) + 0.5) * step - 0.5;
            sum += background_radiance(filmed_along(ray_through(pixel + part)));
        }
    }
    return sum * (step * step);
}
