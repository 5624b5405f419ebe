// GGX metallic-roughness (Burley 2012, Karis 2013) and its integral over a uniform environment.

// Scale and bias of F0 for light from everywhere, as shaders/src/brdf.rs integrates them.
@group(2) @binding(2) var albedo_table: texture_2d<f32>;
@group(2) @binding(3) var albedo_sampler: sampler;

fn dfg(n_dot_v: f32, roughness: f32) -> vec2<f32> {
    let size = vec2<f32>(textureDimensions(albedo_table));
    let at = (clamp(vec2(sqrt(n_dot_v), roughness), vec2(0.0), vec2(1.0)) * (size - 1.0) + 0.5) / size;
    return textureSampleLevel(albedo_table, albedo_sampler, at, 0.0).rg;
}

// Reflectance at normal incidence: of glass for what is no metal.
fn surface_f0(albedo: vec3<f32>, metallic: f32) -> vec3<f32> {
    return mix(vec3(0.04), albedo, metallic);
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

// The lobe alone: reflected radiance from a light of unit irradiance, cosine included.
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

// Highlight of a light of unit irradiance. A wider lobe loses more between the facets and sees other angles of Fresnel's
// term, but neither the light's width nor the pixel's adds or takes energy: the highlight keeps what the surface's own lobe
// reflects.
fn highlight(
    weights: AmbientWeights,
    f0: vec3<f32>,
    n: vec3<f32>,
    v: vec3<f32>,
    l: vec3<f32>,
    roughness: f32,
    tan_radius: f32,
    footprint_sr: f32,
) -> vec3<f32> {
    let alpha = highlight_alpha(roughness, tan_radius, footprint_sr);
    let wide = dfg(max(dot(n, v), 0.0), sqrt(alpha));
    // A channel that metal does not reflect has neither: 0 of 0.
    return ggx_direct(f0, n, v, l, alpha) * weights.specular / max(f0 * wide.x + wide.y, vec3(1e-6));
}
