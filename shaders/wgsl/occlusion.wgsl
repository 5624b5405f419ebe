// Spheres that stand for objects where they hide the sky from a surface, and what real surfaces keep of their light.

#import "frame.wgsl"
#import "shadow.wgsl"

// Form factor from a surface element to a sphere, in [0, 1]: the share of the cosine-weighted hemisphere
// behind it, cut by the horizon. Snyder 1996, "Area light sources for real-time graphics", sphere case.
// Faded so that it is exactly 0 from OCCLUDER_REACH radii on.
fn sphere_form_factor(to_center: vec3<f32>, radius: f32, normal: vec3<f32>) -> f32 {
    let distance = length(to_center);
    let h = distance / radius;
    if h >= OCCLUDER_REACH {
        return 0.0;
    }
    let cosine = dot(normal, to_center) / max(distance, 1e-6);
    let h2 = max(h * h, 1.0001);
    let k2 = 1.0 - h2 * cosine * cosine;
    var factor = max(cosine, 0.0) / h2;
    if k2 > 0.0 {
        let sine2 = max(1.0 - cosine * cosine, 1e-6);
        let clipped = cosine * acos(clamp(-cosine * sqrt((h2 - 1.0) / sine2), -1.0, 1.0)) - sqrt(k2 * (h2 - 1.0));
        factor = max((clipped / h2 + atan(sqrt(k2 / (h2 - 1.0)))) / PI, 0.0);
    }
    return clamp(factor * within_reach(h), 0.0, 0.999);
}

// 1 near an occluder and 0 from OCCLUDER_REACH radii on.
fn within_reach(radii: f32) -> f32 {
    return 1.0 - smoothstep(0.6 * OCCLUDER_REACH, OCCLUDER_REACH, radii);
}

// Share of a lobe around a direction that a sphere fills: two cones that overlap, the lobe's of this solid angle.
// Oat & Sander 2007, "Ambient aperture lighting", Sec. 4: all of the narrower one where they lie within each other, and
// a smooth step from there to where they part.
fn sphere_in_cone(to_center: vec3<f32>, radius: f32, axis: vec3<f32>, lobe_sr: f32) -> f32 {
    let distance = max(length(to_center), 1e-6);
    let sphere_cos = sqrt(max(1.0 - radius * radius / (distance * distance), 0.0));
    let lobe_cos = 1.0 - min(lobe_sr / (2.0 * PI), 1.0);
    let sphere = acos(sphere_cos);
    let lobe = acos(lobe_cos);
    let apart = acos(clamp(dot(axis, to_center) / distance, -1.0, 1.0));
    let most = min((1.0 - sphere_cos) / max(1.0 - lobe_cos, 1e-6), 1.0);
    return most * (1.0 - smoothstep(abs(sphere - lobe), sphere + lobe, apart));
}

// Share of a lobe that an occluder within reach hides.
fn sphere_in_lobe(to_center: vec3<f32>, radius: f32, axis: vec3<f32>, lobe_sr: f32) -> f32 {
    return sphere_in_cone(to_center, radius, axis, lobe_sr) * within_reach(length(to_center) / radius);
}

// The next occluder from `start` on that reaches a point; occluder_count if none does. Those of object `own` do
// not count for itself.
// Searched for ahead of the form factor, whose cost is then paid only by those within reach.
fn next_occluder(start: u32, world: vec3<f32>, not_own: bool, own: u32) -> u32 {
    var i = start;
    for (; i < lighting.occluder_count; i++) {
        let occluder = occluders[i];
        let to_center = occluder.center - world;
        let reach = occluder.radius * OCCLUDER_REACH;
        if !(not_own && occluder.object == own) && dot(to_center, to_center) < reach * reach {
            break;
        }
    }
    return i;
}

// Irradiance on a real surface with the objects over irradiance without, per channel. Given are the irradiance from the
// spherical harmonics, and from the lights without shadow maps.
// What the place keeps from the surface is missing from both: where the video shows a shadow, there is no second one.
// Objects take ambient light by hiding what is behind them, and give a part of it back. Matt ones: what the ground sends up
// to them (reflectance g) and they send down again (albedo a), one bounce, and never more than they took: the ground beside
// a contact is itself in shade, and a full series of bounces would glow there. Mirroring ones: a ball spreads what it
// mirrors evenly over all directions, half of it sky, and half ground that is as shaded as this point is.
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
    // Means over the two halves of the sphere, of the mean radiance from above here.
    let ground = 0.5 * lighting.ground_reflectance;
    let sky = max(sh_at(0u) * (0.5 / sqrt(PI)) * PI / max(ambient, vec3(1e-6)) - ground, vec3(0.0));
    var kept = vec3(1.0);
    var i = next_occluder(0u, world, false, 0u);
    while i < lighting.occluder_count {
        let occluder = occluders[i];
        let to_center = occluder.center - world;
        let factor = sphere_form_factor(to_center, occluder.radius, normal);
        changed = changed || factor > 0.0;
        // Mean radiance behind the sphere over that from above: of a small one what lies behind its middle, and all there is behind one that fills the view.
        let hidden = mix(sh_radiance(normalize(to_center)) * PI / max(ambient, vec3(1e-6)), vec3(1.0), factor);
        // Of the colour of what is hidden: what the underside shows lies about the point, not overhead.
        let share = min(dot(sky, LUMA) / max(dot(hidden, LUMA), 1e-6), 0.5);
        let taken = factor * hidden * (1.0 - occluder.albedo * lighting.ground_reflectance - occluder.specular * share);
        kept *= max(1.0 - taken, vec3(0.0)) / (1.0 - factor * occluder.specular * ground);
        i = next_occluder(i + 1u, world, false, 0u);
    }
    if !changed {
        return vec3(1.0);
    }
    let ratio = (ambient * kept + direct) / max(before, vec3(1e-6));
    return select(ratio, vec3(1.0), before <= vec3(1e-6));
}
