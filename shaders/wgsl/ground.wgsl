// The real surfaces, ground and meshes of the place, as catchers of shadows:
// video × (irradiance with objects / irradiance without).

#import "shadow.wgsl"
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

// Irradiance on a real surface with the objects over irradiance without, per channel. Given are the irradiance from the
// spherical harmonics, and from the lights without shadow maps.
// What the place keeps from the surface is missing from both: where the video shows a shadow, there is no second one.
// Objects take ambient light by hiding what is behind them, and give a part of it back: what the ground sends up to
// them (reflectance g) and they send down again (albedo a), one bounce. Never more than they took: the ground
// beside a contact is itself in shade, and a full series of bounces would glow there.
fn real_ratio(world: vec3<f32>, normal: vec3<f32>, ambient: vec3<f32>, unshadowed: vec3<f32>) -> vec3<f32> {
    var direct = unshadowed;
    var before = ambient + unshadowed;
    var changed = false;
    for (var i = 0u; i < lighting.shadow_count; i++) {
        let light = lighting.lights[i];
        let falling = light.irradiance * (place_visibility(i, world, normal) * max(dot(light.direction, normal), 0.0));
        let visibility = objects_visibility(i, world, normal);
        changed = changed || (visibility < 1.0 && any(falling > vec3(0.0)));
        before += falling;
        direct += falling * visibility;
    }
    var kept = vec3(1.0);
    var i = next_occluder(0u, world, false, 0u);
    while i < lighting.occluder_count {
        let occluder = occluders[i];
        let to_center = occluder.center - world;
        let factor = sphere_form_factor(to_center, occluder.radius, normal);
        changed = changed || factor > 0.0;
        let hidden = sh_radiance(normalize(to_center)) * PI / max(ambient, vec3(1e-6));
        kept *= max(1.0 - factor * hidden * (1.0 - occluder.albedo * lighting.ground_reflectance), vec3(0.0));
        i = next_occluder(i + 1u, world, false, 0u);
    }
    if !changed {
        return vec3(1.0);
    }
    let ratio = (ambient * kept + direct) / max(before, vec3(1e-6));
    return select(ratio, vec3(1.0), before <= vec3(1e-6));
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
