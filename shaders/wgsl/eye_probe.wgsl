// The number of the view all over its layer, from 1: tells whether a pass of both eyes draws to both.

#import "fullscreen.wgsl"
#import "eye.wgsl"

@fragment
fn fs_eye_probe() -> @location(0) vec4<f32> {
    return vec4(f32(view_at + 1u));
}
