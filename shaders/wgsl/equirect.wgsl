// The equirectangular mapping; twin of shaders/src/equirect.rs.

fn direction_from_uv(uv: vec2<f32>) -> vec3<f32> {
    let longitude = (uv.x - 0.5) * 2.0 * PI;
    let latitude = (0.5 - uv.y) * PI;
    return vec3(cos(latitude) * sin(longitude), sin(latitude), -cos(latitude) * cos(longitude));
}

fn uv_from_direction(direction: vec3<f32>) -> vec2<f32> {
    let u = fract(atan2(direction.x, -direction.z) / (2.0 * PI) + 0.5);
    return vec2(u, 0.5 - asin(clamp(direction.y, -1.0, 1.0)) / PI);
}
