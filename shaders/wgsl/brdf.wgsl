// GGX metallic-roughness (Burley 2012, Karis 2013) and its integral over a uniform environment.

// Scale and bias of F0 for light from everywhere: the fit of Lazarov 2013 as given by Karis 2014.
fn dfg(n_dot_v: f32, roughness: f32) -> vec2<f32> {
    let r = roughness * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
    let a = min(r.x * r.x, exp2(-9.28 * n_dot_v)) * r.x + r.y;
    return vec2(-1.04, 1.04) * a + r.zw;
}

struct AmbientWeights {
    // Of the light in the mirror lobe.
    specular: vec3<f32>,
    // Of irradiance over π.
    diffuse: vec3<f32>,
}

// Weights that add up to 1 for a white surface, at every roughness, metal or dielectric
// (Fdez-Agüera 2019, Eq. 8–17).
fn ambient_weights(f0: vec3<f32>, albedo: vec3<f32>, metallic: f32, n_dot_v: f32, roughness: f32) -> AmbientWeights {
    let ab = dfg(n_dot_v, roughness);
    let single = f0 * ab.x + ab.y;
    let lost = 1.0 - (ab.x + ab.y);
    let average = f0 + (1.0 - f0) / 21.0;
    let multiple = single * average / (1.0 - lost * average) * lost;
    let diffuse = albedo * (1.0 - metallic) * (1.0 - single - multiple);
    return AmbientWeights(single, multiple + diffuse);
}

// GGX alpha of a highlight: the surface's own, widened by the light's cone and by the mirror directions that a pixel
// spans (Kaplanyan et al. 2016; four of them to a half vector). Alpha of one pixel's spacing: sampled once a pixel,
// the peak keeps its sum over the pixels within 3 %, wherever it falls between them.
fn highlight_alpha(roughness: f32, tan_radius: f32, footprint_sr: f32) -> f32 {
    let alpha = roughness * roughness + 0.5 * tan_radius;
    return clamp(sqrt(alpha * alpha + 0.25 * footprint_sr), 0.003, 1.0);
}

// Radiance of a light of unit irradiance in a cone around a direction at this cosine from it: the spherical Gaussian
// with the peak of a GGX highlight of this alpha, without its tails, which no cone of the map has. Its integral over
// directions is 1.
fn cone_of_light(cosine: f32, alpha: f32) -> f32 {
    let sharpness = 0.5 / (alpha * alpha);
    return sharpness / (2.0 * PI * (1.0 - exp(-2.0 * sharpness))) * exp(sharpness * (cosine - 1.0));
}

// Reflected radiance from a light of unit irradiance, cosine included.
fn ggx_direct(f0: vec3<f32>, n: vec3<f32>, v: vec3<f32>, l: vec3<f32>, alpha: f32) -> vec3<f32> {
    let h = normalize(v + l);
    let n_dot_l = max(dot(n, l), 0.0);
    let n_dot_v = max(dot(n, v), 1e-3);
    let n_dot_h = max(dot(n, h), 0.0);
    let a2 = alpha * alpha;
    let d = n_dot_h * n_dot_h * (a2 - 1.0) + 1.0;
    let distribution = a2 / (PI * d * d);
    let masking = 0.5 / (n_dot_l * sqrt(n_dot_v * n_dot_v * (1.0 - a2) + a2) + n_dot_v * sqrt(n_dot_l * n_dot_l * (1.0 - a2) + a2) + 1e-6);
    let fresnel = f0 + (1.0 - f0) * pow(1.0 - max(dot(v, h), 0.0), 5.0);
    return fresnel * (distribution * masking * n_dot_l);
}
