// Vertices put into a pose: morph targets, then joints (glTF 2.0, Sec. 3.7). Twin of `scene::rig::deform`.

struct Vertex {
    position: array<f32, 3>,
    normal: array<f32, 3>,
    uv: array<f32, 2>,
}

struct Influence {
    weights: vec4<f32>,
    // Two in each number, the first in its lower half.
    joints: vec2<u32>,
    padding: vec2<u32>,
}

struct Delta {
    position: array<f32, 3>,
    normal: array<f32, 3>,
}

struct Deformation {
    vertex_count: u32,
    target_count: u32,
    first_matrix: u32,
    first_weight: u32,
    skinned: u32,
    flat_shaded: u32,
    padding: vec2<u32>,
}

@group(0) @binding(0) var<uniform> deformation: Deformation;
@group(0) @binding(1) var<storage, read> source: array<Vertex>;
@group(0) @binding(2) var<storage, read> influences: array<Influence>;
@group(0) @binding(3) var<storage, read> deltas: array<Delta>;
@group(0) @binding(4) var<storage, read_write> deformed: array<Vertex>;
@group(1) @binding(0) var<storage, read> matrices: array<mat4x4<f32>>;
@group(1) @binding(1) var<storage, read> weights: array<f32>;

struct Placed {
    position: vec3<f32>,
    normal: vec3<f32>,
}

fn three(values: array<f32, 3>) -> vec3<f32> {
    return vec3(values[0], values[1], values[2]);
}

fn matrix_of(at: u32) -> mat4x4<f32> {
    if deformation.skinned == 0u {
        return matrices[deformation.first_matrix];
    }
    let influence = influences[at];
    var sum = mat4x4<f32>();
    for (var slot = 0u; slot < 4u; slot++) {
        if influence.weights[slot] != 0.0 {
            let joint = (influence.joints[slot / 2u] >> (16u * (slot % 2u))) & 0xffffu;
            sum += matrices[deformation.first_matrix + joint] * influence.weights[slot];
        }
    }
    return sum;
}

fn placed(at: u32) -> Placed {
    let vertex = source[at];
    var position = three(vertex.position);
    var normal = three(vertex.normal);
    for (var i = 0u; i < deformation.target_count; i++) {
        let weight = weights[deformation.first_weight + i];
        if weight != 0.0 {
            let delta = deltas[i * deformation.vertex_count + at];
            position += three(delta.position) * weight;
            normal += three(delta.normal) * weight;
        }
    }
    let matrix = matrix_of(at);
    // The inverse transpose up to a factor, which also works for singular matrices.
    let x = matrix[0].xyz;
    let y = matrix[1].xyz;
    let z = matrix[2].xyz;
    let side = select(1.0, -1.0, dot(x, cross(y, z)) < 0.0);
    let turned = (cross(y, z) * normal.x + cross(z, x) * normal.y + cross(x, y) * normal.z) * side;
    return Placed((matrix * vec4(position, 1.0)).xyz, unit(turned));
}

fn unit(v: vec3<f32>) -> vec3<f32> {
    let square = dot(v, v);
    return select(vec3(0.0, 1.0, 0.0), v * inverseSqrt(max(square, 1e-37)), square > 1e-37);
}

@compute @workgroup_size(64)
fn deform(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = id.x;
    if at >= deformation.vertex_count {
        return;
    }
    var own = placed(at);
    if deformation.flat_shaded != 0u {
        // Each three vertices are a triangle of their own.
        let first = at / 3u * 3u;
        let a = placed(first).position;
        own.normal = unit(cross(placed(first + 1u).position - a, placed(first + 2u).position - a));
    }
    deformed[at].position = array(own.position.x, own.position.y, own.position.z);
    deformed[at].normal = array(own.normal.x, own.normal.y, own.normal.z);
    deformed[at].uv = source[at].uv;
}
