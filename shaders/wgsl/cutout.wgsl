// Depth of surfaces with holes as one light sees them.

#import "caster.wgsl"
#import "material.wgsl"

struct CutoutVertex {
    @builtin(position) clip: vec4<f32>,
    @location(0) uv: vec2<f32>,
    @location(1) uv1: vec2<f32>,
    @location(2) alpha: f32,
}

fn cutout_vertex(position: vec3<f32>, uv: vec2<f32>, uv1: vec2<f32>, alpha: f32, index: u32) -> CutoutVertex {
    return CutoutVertex(caster.clip_from_world * (instances[index].world_from_object * vec4(position, 1.0)), uv, uv1, alpha);
}

@vertex
fn vs_cutout(@location(0) position: vec3<f32>, @location(2) uv: vec2<f32>, @builtin(instance_index) index: u32) -> CutoutVertex {
    return cutout_vertex(position, uv, vec2(0.0), 1.0, index);
}

@vertex
fn vs_cutout_detailed(
    @location(0) position: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @location(4) uv1: vec2<f32>,
    @location(5) color: vec4<f32>,
    @builtin(instance_index) index: u32,
) -> CutoutVertex {
    return cutout_vertex(position, uv, uv1, color.a, index);
}

// A mask lets light through its holes. What is blended lets through its share of each 4 × 4 texels: ordered dither
// (Bayer 1973), which the penumbra's filter averages.
@fragment
fn fs_cutout(in: CutoutVertex) {
    let alpha = base_color(vec3(1.0), in.uv, VertexDetail(vec4(0.0), in.uv1, vec4(vec3(1.0), in.alpha))).a;
    if ALPHA == ALPHA_MASK {
        if alpha < material.alpha_cutoff {
            discard;
        }
    } else {
        let at = vec2<u32>(in.clip.xy);
        let x = at.x ^ at.y;
        let order = ((x & 1u) << 3u) | ((at.y & 1u) << 2u) | (x & 2u) | ((at.y & 2u) >> 1u);
        if alpha <= (f32(order) + 0.5) / 16.0 {
            discard;
        }
    }
}
