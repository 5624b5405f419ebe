// Real spherical harmonics of radiance; twin of shaders/src/sh.rs.

// 9 or 25: how many coefficients the frame's light has.
override SH_COUNT: u32 = 25u;

// Weighted sum of the basis in a direction; `band` weights bands 0 to 4. The importing module says where the
// coefficients lie: fn sh_at(index: u32) -> vec3<f32>.
fn sh_sum(count: u32, d: vec3<f32>, band: array<f32, 5>) -> vec3<f32> {
    var sum = sh_at(0u) * (0.2820948 * band[0]);
    sum += (sh_at(1u) * d.y + sh_at(2u) * d.z + sh_at(3u) * d.x) * (0.4886025 * band[1]);
    sum += (sh_at(4u) * (1.0925484 * d.x * d.y)
        + sh_at(5u) * (1.0925484 * d.y * d.z)
        + sh_at(6u) * (0.31539157 * (3.0 * d.z * d.z - 1.0))
        + sh_at(7u) * (1.0925484 * d.x * d.z)
        + sh_at(8u) * (0.5462742 * (d.x * d.x - d.y * d.y))) * band[2];
    if count <= 9u {
        return sum;
    }
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    // Irradiance has none of it: where that is known, it is left out.
    if band[3] != 0.0 {
        sum += (sh_at(9u) * (0.5900436 * d.y * (3.0 * xx - yy))
            + sh_at(10u) * (2.8906114 * d.x * d.y * d.z)
            + sh_at(11u) * (0.4570458 * d.y * (5.0 * zz - 1.0))
            + sh_at(12u) * (0.37317633 * d.z * (5.0 * zz - 3.0))
            + sh_at(13u) * (0.4570458 * d.x * (5.0 * zz - 1.0))
            + sh_at(14u) * (1.4453057 * d.z * (xx - yy))
            + sh_at(15u) * (0.5900436 * d.x * (xx - 3.0 * yy))) * band[3];
    }
    sum += (sh_at(16u) * (2.5033429 * d.x * d.y * (xx - yy))
        + sh_at(17u) * (1.7701308 * d.y * d.z * (3.0 * xx - yy))
        + sh_at(18u) * (0.9461747 * d.x * d.y * (7.0 * zz - 1.0))
        + sh_at(19u) * (0.6690465 * d.y * d.z * (7.0 * zz - 3.0))
        + sh_at(20u) * (0.10578555 * (35.0 * zz * zz - 30.0 * zz + 3.0))
        + sh_at(21u) * (0.6690465 * d.x * d.z * (7.0 * zz - 3.0))
        + sh_at(22u) * (0.47308734 * (xx - yy) * (7.0 * zz - 1.0))
        + sh_at(23u) * (1.7701308 * d.x * d.z * (xx - 3.0 * yy))
        + sh_at(24u) * (0.6258357 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)))) * band[4];
    return sum;
}
