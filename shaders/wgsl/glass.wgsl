// Glass: a solid that refracts at both of its sides, takes away light along the way between them, and shows what was drawn
// before it or the panorama (Rohmer et al. 2015, Sec. 6.6, with the exit found on the solid's back faces and the ray beyond it
// followed through the depth of what was drawn).

#import "object.wgsl"
#import "parallax.wgsl"

// What was drawn before, premultiplied, and its depth.
@group(0) @binding(6) var drawn: texture_2d_array<f32>;
@group(0) @binding(7) var drawn_depth: texture_depth_multisampled_2d;
// The glass's back faces: outward normal, and metres from the eye; 0 where there are none.
@group(0) @binding(8) var back_faces: texture_2d_array<f32>;
// The depth of the second view, as there are no arrays of such textures.
@group(0) @binding(9) var drawn_depth_beside: texture_depth_multisampled_2d;

// Facets turn a refracted ray by half as much as they are tilted, at both sides, and a reflected one by twice: the solid angle of the
// one as a share of the other's, and the roughness whose lobe is as wide, its fourth root.
const REFRACTED_SHARE: f32 = 0.125;
const REFRACTED_ROUGHNESS: f32 = 0.5946;

@fragment
fn fs_glass_back(in: ObjectVertex) -> @location(0) vec4<f32> {
    return vec4(normalize(in.normal), distance(in.world, view.position));
}

// Unpolarised light at a boundary to a medium of this index, from outside (Fresnel).
fn fresnel_dielectric(cosine: f32, index: f32) -> f32 {
    let within = sqrt(max(1.0 - (1.0 - cosine * cosine) / (index * index), 0.0));
    let across = (cosine - index * within) / (cosine + index * within);
    let along = (index * cosine - within) / (index * cosine + within);
    return 0.5 * (across * across + along * along);
}

struct LayerPlace {
    // In the layer; the texel lies in it if `inside`.
    texel: vec2<i32>,
    inside: bool,
    // Metres before the eye, along its axis.
    ahead_m: f32,
}

fn layer_place(world: vec3<f32>) -> LayerPlace {
    let clip = view.clip_from_world * vec4(world, 1.0);
    let pixel = (clip.xy / max(clip.w, 1e-6) * vec2(0.5, -0.5) + 0.5) * view.size_px - view.layer_origin;
    let inside = clip.w > 1e-3 && all(pixel >= vec2(0.0)) && all(pixel < view.layer_size);
    let texel = vec2<i32>(clamp(pixel, vec2(0.0), view.layer_size - 1.0));
    return LayerPlace(texel, inside, clip.w);
}

struct Passage {
    exit: vec3<f32>,
    direction: vec3<f32>,
    // Within the glass, metres.
    length_m: f32,
}

// The way of a ray through the solid. The far side is where the inner ray meets the back faces as the eye sees them, found
// by a few steps from the place straight behind. What is reflected there leaves unrefracted; a pane without a far side lets
// light through as it came.
fn passage(world: vec3<f32>, n: vec3<f32>, v: vec3<f32>) -> Passage {
    let inside = refract(-v, n, 1.0 / GLASS_IOR);
    var length_m = 0.0;
    var far_normal = vec3(0.0);
    for (var i = 0; i < 4; i++) {
        let at = world + inside * length_m;
        let place = layer_place(at);
        let back = textureLoad(back_faces, place.texel, view_at, 0);
        if !place.inside || back.w <= 0.0 {
            break;
        }
        let met = view.position + normalize(at - view.position) * back.w;
        length_m = max(dot(met - world, inside), 0.0);
        far_normal = back.xyz;
    }
    if all(far_normal == vec3(0.0)) || length_m <= 0.0 {
        return Passage(world, -v, 0.0);
    }
    let normal = normalize(far_normal);
    let out = refract(inside, -normal, GLASS_IOR);
    let left = select(reflect(inside, normal), out, dot(out, out) > 0.0);
    return Passage(world + inside * length_m, normalize(left), length_m);
}

fn drawn_depth_at(texel: vec2<i32>) -> f32 {
    if view_at > 0u {
        return textureLoad(drawn_depth_beside, texel, 0);
    }
    return textureLoad(drawn_depth, texel, 0);
}

// Metres before the eye of what was drawn there; far away where nothing was.
fn drawn_ahead(texel: vec2<i32>) -> f32 {
    // The projection's near plane over depth: depth is reversed and has no far plane.
    return view.clip_from_world[3].z / max(drawn_depth_at(texel), 1e-9);
}

// Steps of the ray beyond the glass, and how far it goes in them, metres.
const BEYOND_STEPS: u32 = 14u;
const BEYOND_FIRST_M: f32 = 0.03;
const BEYOND_LAST_M: f32 = 30.0;

// Where a ray meets what was drawn, as a distance along it; negative where it meets nothing, or leaves the picture first.
fn meets_drawn(origin: vec3<f32>, direction: vec3<f32>, farthest_m: f32) -> f32 {
    let last = min(BEYOND_LAST_M, farthest_m);
    let ratio = pow(max(last / BEYOND_FIRST_M, 1.0), 1.0 / f32(BEYOND_STEPS - 1u));
    var before_m = 0.0;
    var at_m = min(BEYOND_FIRST_M, last);
    var in_front = false;
    for (var i = 0u; i < BEYOND_STEPS; i++) {
        let place = layer_place(origin + direction * at_m);
        if !place.inside {
            return -1.0;
        }
        let behind = place.ahead_m - drawn_ahead(place.texel);
        // As thick as the step is long: what lies farther in front is passed behind.
        if in_front && behind > 0.0 && behind < 1.5 * (at_m - before_m) + 0.01 {
            var near = before_m;
            var far = at_m;
            for (var j = 0; j < 5; j++) {
                let middle = 0.5 * (near + far);
                let between = layer_place(origin + direction * middle);
                if between.ahead_m > drawn_ahead(between.texel) {
                    far = middle;
                } else {
                    near = middle;
                }
            }
            return far;
        }
        in_front = behind <= 0.0;
        before_m = at_m;
        at_m *= ratio;
    }
    return -1.0;
}

struct Beyond {
    // Drawn surfaces, premultiplied by how much of the view they take.
    drawn: vec4<f32>,
    // In which direction the panorama shows what they leave.
    direction: vec3<f32>,
}

// Taps of what was drawn, behind rough glass.
const ROUGH_TAPS: u32 = 8u;

// What a ray that left the glass meets. The ground shows what the video has there as the eye sees it, as it does beside the
// glass; the rest of the panorama is far away.
fn beyond(way: Passage, spread: f32) -> Beyond {
    let fall = lighting.ground_y - way.exit.y;
    let lands = way.direction.y < -1e-4 && fall < 0.0;
    let ground_m = select(1e9, min(fall / way.direction.y, 1e6), lands);
    var met_m = meets_drawn(way.exit, way.direction, ground_m * 1.01);
    if met_m < 0.0 {
        let towards = filmed_at(way.exit + way.direction * ground_m);
        // What is blended has no depth: it is seen as far away as the panorama is.
        let place = layer_place(way.exit + way.direction * min(ground_m, BEYOND_LAST_M));
        var blended = vec4(0.0);
        if place.inside && drawn_depth_at(place.texel) == 0.0 {
            blended = textureLoad(drawn, place.texel, view_at, 0);
        }
        return Beyond(blended, select(way.direction, towards, lands));
    }
    let sides = lobe_sides(way.direction);
    let taps = select(ROUGH_TAPS, 1u, spread == 0.0);
    var sum = vec4(0.0);
    var turn = vec2(1.0, 0.0);
    for (var i = 0u; i < taps; i++) {
        let aside = sides * (turn * sqrt((f32(i) + 0.5) / f32(taps)) * spread);
        sum += textureLoad(drawn, layer_place(way.exit + (way.direction + aside) * met_m).texel, view_at, 0);
        turn = turned(turn);
    }
    return Beyond(sum / f32(taps), filmed_at(way.exit + way.direction * met_m));
}

// Radiance of glass. A mask cuts holes into it, and it may glow; occlusion counts for nothing in what is seen through.
fn glass_radiance(in: ObjectVertex, surface: SurfacePoint) -> vec4<f32> {
    let v = normalize(view.position - in.world);
    let n = surface.normal;
    let mirror = reflect(-v, n);
    let footprint_sr = spanned(mirror);
    if ALPHA == ALPHA_MASK && surface.alpha < material.alpha_cutoff {
        discard;
    }
    let tint = surface.albedo;
    let roughness = surface.roughness;
    let fresnel = fresnel_dielectric(max(dot(n, v), 0.0), GLASS_IOR);
    let way = passage(in.world, n, v);
    let passed = (1.0 - fresnel) * pow(clamp(tint, vec3(1e-4), vec3(1.0)), vec3(way.length_m / GLASS_DEPTH_M));
    let refracted_sr = REFRACTED_SHARE * lobe_solid_angle(roughness * roughness);
    let seen = beyond(way, sqrt(refracted_sr / PI));
    let through_sr = averaged(footprint_sr) + refracted_sr;
    let open = passed * (1.0 - seen.drawn.a);
    var radiance = fresnel * lobe_radiance(mirror, roughness, footprint_sr);
    radiance += passed * seen.drawn.rgb + open * cone_radiance(seen.direction, through_sr);
    // Lights that are cut out of the map.
    let mirror_share = fresnel * lobe_map_share(mirror, roughness, footprint_sr);
    let through_share = open * map_share(environment_level(seen.direction, through_sr));
    for (var i = 0u; i < lighting.light_count; i++) {
        let light = lighting.lights[i];
        let through_alpha = highlight_alpha(REFRACTED_ROUGHNESS * roughness, light.tan_radius, footprint_sr);
        var highlight = through_share * cone_of_light(dot(seen.direction, light.direction), through_alpha);
        if dot(n, light.direction) > 0.0 {
            let alpha = highlight_alpha(roughness, light.tan_radius, footprint_sr);
            highlight += mirror_share * cone_of_light(dot(mirror, light.direction), alpha) * visibility_of_light(i, in.world, n);
        }
        radiance += light.irradiance * light.cut * highlight;
    }
    return vec4(min(radiance + surface.emission, vec3(MAX_MAGNITUDE)), 1.0);
}

@fragment
fn fs_glass(in: ObjectVertex, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    return glass_radiance(in, plain_point(in, front));
}

@fragment
fn fs_glass_detailed(in: DetailedVertex, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    return glass_radiance(without_detail(in), detailed_point(in, front));
}
