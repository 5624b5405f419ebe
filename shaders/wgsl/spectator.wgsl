// A picture all over the viewport.

struct Corner {
    @builtin(position) clip: vec4<f32>,
    @location(0) uv: vec2<f32>,
}

@vertex
fn vs_spectator(@builtin(vertex_index) index: u32) -> Corner {
    let uv = vec2(f32(index & 1u), f32(index >> 1u));
    return Corner(vec4(2.0 * uv.x - 1.0, 1.0 - 2.0 * uv.y, 0.0, 1.0), uv);
}

@group(0) @binding(0) var picture: texture_2d<f32>;
@group(0) @binding(1) var smooth_sampler: sampler;

@fragment
fn fs_spectator(in: Corner) -> @location(0) vec4<f32> {
    return vec4(textureSample(picture, smooth_sampler, in.uv).rgb, 1.0);
}
