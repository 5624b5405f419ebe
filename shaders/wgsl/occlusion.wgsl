// Spheres that stand for objects where they hide the sky from a surface.

#import "frame.wgsl"

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
    return clamp(factor * (1.0 - smoothstep(0.6 * OCCLUDER_REACH, OCCLUDER_REACH, h)), 0.0, 0.999);
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
