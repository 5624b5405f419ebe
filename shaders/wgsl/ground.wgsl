// The real surfaces, ground and meshes of the place, as catchers of shadows:
// video × (irradiance with objects / irradiance without); and of reflections.

#import "background.wgsl"
#import "gloss.wgsl"
#import "occlusion.wgsl"

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

// The video by a factor, as a pixel of the layer.
fn changed(seen: vec3<f32>, ratio: vec3<f32>) -> vec4<f32> {
    return vec4(min(seen * ratio, vec3(MAX_MAGNITUDE)), 1.0);
}

fn ground_ratio(world: vec3<f32>) -> vec3<f32> {
    return real_ratio(world, vec3(0.0, 1.0, 0.0), lighting.ground_ambient, lighting.ground_unshadowed);
}

@fragment
fn fs_ground(in: GroundVertex) -> @location(0) vec4<f32> {
    let ratio = ground_ratio(in.world);
    if all(ratio == vec3(1.0)) {
        return vec4(0.0);
    }
    return changed(background(in.clip.xy + view.layer_origin), ratio);
}

@fragment
fn fs_ground_glossy(in: GroundVertex) -> @location(0) vec4<f32> {
    let v = normalize(view.position - in.world);
    let mirror = vec3(-v.x, v.y, -v.z);
    let footprint_sr = spanned(mirror);
    let ratio = ground_ratio(in.world);
    let objects = mirrored_objects(in.world, v);
    if objects.a == 0.0 && all(ratio == vec3(1.0)) {
        return vec4(0.0);
    }
    let seen = background(in.clip.xy + view.layer_origin);
    let own = gloss(mirror, v.y, lighting.ground_roughness, lighting.ground_f0, footprint_sr);
    return vec4(min(glossy_video(seen, ratio, own, objects.rgb, objects.a), vec3(MAX_MAGNITUDE)), 1.0);
}

struct PlaceVertex {
    @builtin(position) clip: vec4<f32>,
    @location(0) world: vec3<f32>,
    @location(1) normal: vec3<f32>,
    // Roughness, and reflectance straight on.
    @location(2) @interpolate(flat) gloss: vec2<f32>,
}

@vertex
fn vs_place(@location(0) position: vec3<f32>, @location(1) normal: vec3<f32>, @builtin(instance_index) index: u32) -> PlaceVertex {
    let world = instances[index].world_from_object * vec4(position, 1.0);
    let gloss = vec2(instances[index].roughness, instances[index].base_color.x);
    return PlaceVertex(view.clip_from_world * world, world.xyz, instances[index].normal_from_object * normal, gloss);
}

// The video on a mesh of the place: as far away as that, or along the pixel's ray.
fn video_on_place(in: PlaceVertex) -> vec3<f32> {
    if PARALLAX {
        return background_radiance(filmed_at(in.world));
    }
    return background(in.clip.xy + view.layer_origin);
}

// By a factor. Nothing is drawn where it is 1, unless the mesh is nearer than what is behind it.
fn place_video(in: PlaceVertex, ratio: vec3<f32>) -> vec4<f32> {
    if !PARALLAX && all(ratio == vec3(1.0)) {
        return vec4(0.0);
    }
    return changed(video_on_place(in), ratio);
}

fn place_ratio(world: vec3<f32>, normal: vec3<f32>) -> vec3<f32> {
    var unshadowed = vec3(0.0);
    for (var i = lighting.shadow_count; i < lighting.light_count; i++) {
        unshadowed += lighting.lights[i].irradiance * max(dot(lighting.lights[i].direction, normal), 0.0);
    }
    return real_ratio(world, normal, sh_irradiance(normal), unshadowed);
}

@fragment
fn fs_place(in: PlaceVertex, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    let normal = normalize(select(-in.normal, in.normal, front));
    return place_video(in, place_ratio(in.world, normal));
}

@fragment
fn fs_place_glossy(in: PlaceVertex, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    let normal = normalize(select(-in.normal, in.normal, front));
    let v = normalize(view.position - in.world);
    let mirror = reflect(-v, normal);
    let footprint_sr = spanned(mirror);
    let ratio = place_ratio(in.world, normal);
    var objects = vec4(vec3(0.0), 1.0);
    // A matt mesh beside a glossy one.
    if in.gloss.y > 0.0 {
        objects = mirrored_spheres(in.world, mirror, in.gloss.x);
    }
    if in.gloss.y == 0.0 || (objects.a == 1.0 && all(ratio == vec3(1.0))) {
        return place_video(in, ratio);
    }
    let seen = video_on_place(in);
    let own = gloss(mirror, max(dot(normal, v), 0.0), in.gloss.x, in.gloss.y, footprint_sr);
    return vec4(min(glossy_video(seen, ratio, own, objects.rgb, 1.0 - objects.a), vec3(MAX_MAGNITUDE)), 1.0);
}

struct Nothing {
    @location(0) image: vec4<f32>,
    @location(1) nearness: vec4<f32>,
}

// Before objects that the ground mirrors: the place's own reflection is in the video.
@fragment
fn fs_place_mirrored() -> Nothing {
    return Nothing(vec4(0.0), vec4(0.0));
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
