// Halves the reflection map. Rows count by their solid angle; sizes are powers of two, so no texel pair
// crosses the seam and the result wraps.

#import "fullscreen.wgsl"

@group(0) @binding(0) var finer: texture_2d<f32>;

@fragment
fn fs_mip(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let size = vec2<i32>(textureDimensions(finer));
    let corner = vec2<i32>(at.xy) * 2;
    var sum = vec3(0.0);
    var weight = 0.0;
    for (var j = 0; j < 2; j++) {
        let y = min(corner.y + j, size.y - 1);
        let w = sin(PI * (f32(y) + 0.5) / f32(size.y));
        let pair = textureLoad(finer, vec2(min(corner.x, size.x - 1), y), 0) + textureLoad(finer, vec2(min(corner.x + 1, size.x - 1), y), 0);
        sum += w * pair.rgb;
        weight += 2.0 * w;
    }
    return vec4(sum / weight, 1.0);
}
