// What surfaces make of ambient light and of one light, to hold against numerical integrals.

#import "brdf.wgsl"

struct BrdfProbe {
    // In the surface's frame, normal along z.
    view: vec3<f32>,
    roughness: f32,
    light: vec3<f32>,
    tan_radius: f32,
    albedo: vec3<f32>,
    metallic: f32,
}

struct BrdfResult {
    // Radiance of a light of unit irradiance in the lobe.
    specular: vec3<f32>,
    padding: f32,
    // All radiance of a light of unit irradiance.
    direct: vec3<f32>,
    padding_2: f32,
    // Of radiance 1 from everywhere.
    ambient: vec3<f32>,
    padding_3: f32,
}

@group(0) @binding(0) var<storage, read> brdf_probes: array<BrdfProbe>;
@group(0) @binding(1) var<storage, read_write> brdf_results: array<BrdfResult>;

@compute @workgroup_size(64)
fn cs_brdf_probe(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= arrayLength(&brdf_probes) {
        return;
    }
    let probe = brdf_probes[id.x];
    let n = vec3(0.0, 0.0, 1.0);
    let f0 = surface_f0(probe.albedo, probe.metallic);
    let weights = ambient_weights(f0, probe.albedo, probe.metallic, probe.view.z, probe.roughness);
    let specular = highlight(weights, f0, n, probe.view, probe.light, probe.roughness, probe.tan_radius, 0.0);
    let direct = specular + weights.diffuse * max(probe.light.z, 0.0) / PI;
    brdf_results[id.x] = BrdfResult(specular, 0.0, direct, 0.0, weights.specular + weights.diffuse, 0.0);
}
