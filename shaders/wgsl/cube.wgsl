// Faces of a cube map, in the order and with the axes that every graphics API gives them.

// A direction, not of unit length: 1 along the face's axis. `at` in [-1, 1], right and down on the face.
fn cube_direction(face: u32, at: vec2<f32>) -> vec3<f32> {
    switch face {
        case 0u: { return vec3(1.0, -at.y, -at.x); }
        case 1u: { return vec3(-1.0, -at.y, at.x); }
        case 2u: { return vec3(at.x, 1.0, at.y); }
        case 3u: { return vec3(at.x, -1.0, -at.y); }
        case 4u: { return vec3(at.x, -at.y, 1.0); }
        default: { return vec3(-at.x, -at.y, -1.0); }
    }
}

// Place of a texel's centre on its face.
fn cube_place(texel: vec2<u32>, size: u32) -> vec2<f32> {
    return (vec2<f32>(texel) + 0.5) * (2.0 / f32(size)) - 1.0;
}

// Solid angle per area of the face at a place on it.
fn cube_density(at: vec2<f32>) -> f32 {
    let squared = 1.0 + dot(at, at);
    return 1.0 / (squared * sqrt(squared));
}
