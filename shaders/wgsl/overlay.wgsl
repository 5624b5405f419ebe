// A small picture over a part of the target: the viewport's.

// Size of the picture, texels.
override WIDTH: f32 = 1.0;
override HEIGHT: f32 = 1.0;

@group(0) @binding(0) var picture: texture_2d<f32>;

struct OverlayVertex {
    @builtin(position) at: vec4<f32>,
    @location(0) texel: vec2<f32>,
}

@vertex
fn vs_overlay(@builtin(vertex_index) index: u32) -> OverlayVertex {
    let unit = vec2(f32(index & 1u), f32(index >> 1u));
    return OverlayVertex(vec4(unit * vec2(2.0, -2.0) + vec2(-1.0, 1.0), 0.0, 1.0), unit * vec2(WIDTH, HEIGHT));
}

@fragment
fn fs_overlay(in: OverlayVertex) -> @location(0) vec4<f32> {
    let texel = textureLoad(picture, vec2<i32>(in.texel), 0);
    return vec4(texel.rgb * texel.a, texel.a);
}
