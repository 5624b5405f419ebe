// In which direction the video shows what an eye sees that is not where the camera was that filmed.

#import "frame.wgsl"

// The background has a distance: that of ground and place, and of a dome about the camera that filmed elsewhere.
override PARALLAX: bool = false;

// Of a point that the eye sees.
fn filmed_at(point: vec3<f32>) -> vec3<f32> {
    if PARALLAX {
        return normalize(point);
    }
    return normalize(point - view.position);
}

// Metres along a ray from the eye to what the background shows there, where no mesh of the place is: the ground within the dome, or the dome.
fn background_m(ray: vec3<f32>) -> f32 {
    let b = dot(view.position, ray);
    let c = dot(view.position, view.position) - view.dome_m * view.dome_m;
    var way_m = sqrt(max(b * b - c, 0.0)) - b;
    let fall_m = view.position.y - lighting.ground_y;
    // From beneath there is no ground to see, nor did a camera beneath it film any.
    if ray.y < 0.0 && fall_m > 0.0 && lighting.ground_y < 0.0 {
        way_m = min(way_m, fall_m / -ray.y);
    }
    return way_m;
}

// Of what lies there.
fn filmed_along(ray: vec3<f32>) -> vec3<f32> {
    if !PARALLAX {
        return ray;
    }
    return normalize(view.position + ray * background_m(ray));
}
