// The real surfaces, ground and meshes of the place, as catchers of shadows:
// video × (irradiance with objects / irradiance without).

#import "occlusion.wgsl"
#import "video.wgsl"

struct GroundVertex {
    @builtin(position) clip: vec4<f32>,
    @location(0) world: vec3<f32>,
}

@vertex
fn vs_ground(@builtin(vertex_index) index: u32) -> GroundVertex {
    // Counter-clockwise seen from above.
    let corner = vec2(f32(index & 1u), f32(index >> 1u));
    let at = mix(lighting.ground_min, lighting.ground_max, vec2(corner.x, 1.0 - corner.y));
    let world = vec3(at.x, lighting.ground_y, at.y);
    return GroundVertex(view.clip_from_world * vec4(world, 1.0), world);
}

// The video by this factor; nothing drawn where it is 1.
fn changed_video(ratio: vec3<f32>, pixel: vec2<f32>) -> vec4<f32> {
    if all(ratio == vec3(1.0)) {
        return vec4(0.0);
    }
    let seen = video_radiance(ray_through(pixel + view.layer_origin), view.eye);
    return vec4(min(seen * ratio, vec3(MAX_MAGNITUDE)), 1.0);
}

@fragment
fn fs_ground(in: GroundVertex) -> @location(0) vec4<f32> {
    let ratio = real_ratio(in.world, vec3(0.0, 1.0, 0.0), lighting.ground_ambient, lighting.ground_unshadowed);
    return changed_video(ratio, in.clip.xy);
}

struct PlaceVertex {
    @builtin(position) clip: vec4<f32>,
    @location(0) world: vec3<f32>,
    @location(1) normal: vec3<f32>,
}

@vertex
fn vs_place(@location(0) position: vec3<f32>, @location(1) normal: vec3<f32>, @builtin(instance_index) index: u32) -> PlaceVertex {
    let world = instances[index].world_from_object * vec4(position, 1.0);
    return PlaceVertex(view.clip_from_world * world, world.xyz, instances[index].normal_from_object * normal);
}

@fragment
fn fs_place(in: PlaceVertex, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    let normal = normalize(select(-in.normal, in.normal, front));
    var unshadowed = vec3(0.0);
    for (var i = lighting.shadow_count; i < lighting.light_count; i++) {
        unshadowed += lighting.lights[i].irradiance * max(dot(lighting.lights[i].direction, normal), 0.0);
    }
    return changed_video(real_ratio(in.world, normal, sh_irradiance(normal), unshadowed), in.clip.xy);
}

// Hides what lies beneath the ground: writes depth, and nothing over the video.
@vertex
fn vs_horizon(@builtin(vertex_index) index: u32) -> @builtin(position) vec4<f32> {
    let corner = vec2(f32(index & 1u), f32(index >> 1u)) * 2.0 - 1.0;
    let world = vec3(view.position.x + corner.x * GROUND_EXTENT_M, lighting.ground_y, view.position.z - corner.y * GROUND_EXTENT_M);
    return view.clip_from_world * vec4(world, 1.0);
}

@fragment
fn fs_horizon() -> @location(0) vec4<f32> {
    return vec4(0.0);
}
