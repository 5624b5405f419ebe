//! Rust mirrors of the structs in `shaders/wgsl`, field by field in the same order.
//!
//! The tests compare every offset and size with what the shader compiler makes of the WGSL.

use bytemuck::{Pod, Zeroable};
use mr360_protocol::light;

use crate::colour::recovery_tint;
use crate::lobe::MAX_TAPS;

mod shadow;

pub use shadow::{CELLS, Caster, CasterCells, MOST_SHADOW_MAPS, SHADOW_MAP_SIZE, ShadowMap};

/// Most lights that shade a surface one by one.
pub const SHADED_LIGHTS: usize = 8;
/// Most spheres that stand for objects where they hide the sky.
pub const MAX_OCCLUDERS: usize = 64;

/// `View`: one eye's camera.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct View {
    /// Columns.
    pub clip_from_world: [[f32; 4]; 4],
    /// Columns; the fourth float pads.
    pub world_from_ndc: [[f32; 4]; 3],
    /// Metres.
    pub position: [f32; 3],
    /// 0 left, 1 right.
    pub eye: u32,
    /// Pixels.
    pub size_px: [f32; 2],
    /// Corner of the part of the image that the layer holds, pixels.
    pub layer_origin: [f32; 2],
    /// Size of that part, pixels.
    pub layer_size: [f32; 2],
    /// Radius of the dome that the background lies on, metres.
    pub dome_m: f32,
    /// Rays along each side of a pixel that show the background.
    pub rays: u32,
}

/// `Light`: one directional light.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct Light {
    /// Unit vector towards the light.
    pub direction: [f32; 3],
    /// Tangent of half the cone.
    pub tan_radius: f32,
    /// Irradiance on a facing surface.
    pub irradiance: [f32; 3],
    /// Share of the light that the reflection map is without.
    pub cut: f32,
    /// Of the virtual objects.
    pub objects: ShadowMap,
    /// Of the real place.
    pub place: ShadowMap,
}

/// `Lighting`: the light of the frame and what it needs to know of the scene.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct Lighting {
    /// RGB and a pad.
    pub sh: [[f32; 4]; 25],
    /// Irradiance on the ground from the SH.
    pub ground_ambient: [f32; 3],
    /// Lights in use.
    pub light_count: u32,
    /// Irradiance on the ground without objects.
    pub ground_before: [f32; 3],
    /// Lights with shadow maps, the first ones.
    pub shadow_count: u32,
    /// Irradiance on the ground from lights without shadow maps.
    pub ground_unshadowed: [f32; 3],
    /// Occluders in use.
    pub occluder_count: u32,
    /// Of the ground as the video shows it.
    pub ground_reflectance: [f32; 3],
    /// Metres.
    pub ground_y: f32,
    /// Strongest first.
    pub lights: [Light; SHADED_LIGHTS],
    /// By layer of the shadow maps.
    pub casters: [CasterCells; MOST_SHADOW_MAPS],
    /// x and z, metres.
    pub ground_min: [f32; 2],
    /// x and z, metres.
    pub ground_max: [f32; 2],
    /// Perceptual.
    pub ground_roughness: f32,
    /// Reflectance straight on.
    pub ground_f0: f32,
    /// Of objects over the ground, metres.
    pub highest_m: f32,
    /// Unused.
    pub padding: f32,
}

/// `Occluder`: a sphere that stands for an object or a part of it.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct Occluder {
    /// Metres.
    pub center: [f32; 3],
    /// Metres.
    pub radius: f32,
    /// Mean reflectance in all directions.
    pub albedo: [f32; 3],
    /// Number of its object in the frame.
    pub object: u32,
    /// Mean reflectance in mirror directions.
    pub specular: [f32; 3],
    /// Unused.
    pub padding: f32,
}

/// `Instance`: one drawn part of an object.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct Instance {
    /// Columns.
    pub world_from_object: [[f32; 4]; 4],
    /// Columns and pads.
    pub normal_from_object: [[f32; 4]; 3],
    /// Linear.
    pub base_color: [f32; 3],
    /// Perceptual.
    pub roughness: f32,
    /// In [0, 1].
    pub metallic: f32,
    /// 1 for glass.
    pub glass: u32,
    /// Number of its object in the frame.
    pub object: u32,
    /// Unused.
    pub padding: u32,
}

/// `Video`: how to sample and decode the frame.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct Video {
    /// Columns and pads.
    pub rgb_from_yuv: [[f32; 4]; 3],
    /// Columns and pads.
    pub bt709_from_primaries: [[f32; 4]; 3],
    /// Left and right.
    pub eye_rect: [[f32; 4]; 2],
    /// As sampled.
    pub yuv_offset: [f32; 3],
    /// In frame widths.
    pub chroma_shift_u: f32,
    /// In use with its lift.
    pub recovery: Recovery,
}

/// `Recovery`: what clipping took from the frame, as a curve.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Recovery {
    /// Of the gain's natural logarithm along a direction.
    pub slope: [f32; 3],
    /// The logarithm's mean over the sphere.
    pub gain_ln: f32,
    /// Of luminance 1.
    pub tint: [f32; 3],
    /// Unused.
    pub padding: f32,
}

/// The curve that a lift asks for; all zero for one that recovers nothing.
impl From<light::Lift> for Recovery {
    fn from(lift: light::Lift) -> Self {
        match lift {
            light::Lift::Recovered(recovery) => Self {
                slope: recovery.slope.to_array(),
                gain_ln: recovery.gain_ln,
                tint: recovery_tint(&recovery).to_array(),
                padding: 0.0,
            },
            light::Lift::Linear | light::Lift::InverseToneMap => Self::zeroed(),
        }
    }
}

/// `Lift`: what the reflection map is made with.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct Lift {
    /// RGB and a pad.
    pub sh: [[f32; 4]; 25],
    /// Those to be cut out.
    pub cuts: [Cut; SHADED_LIGHTS],
    /// Texels along one side of a face.
    pub size_px: u32,
    /// Along one side of a texel.
    pub samples: u32,
    /// Lights to be cut out.
    pub cut_count: u32,
    /// Unused.
    pub padding: u32,
}

/// `Prefilter`: how one level of the prefiltered maps is made.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct Prefilter {
    /// Direction around a lobe along z, and mip level.
    pub taps: [[f32; 4]; MAX_TAPS],
    /// Taps in use.
    pub count: u32,
    /// Texels along one side of a face.
    pub size_px: u32,
    /// Unused.
    pub padding: [u32; 2],
}

/// `Cut`: where a light is taken out of the reflection map, and how much of it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Cut {
    /// Unit vector towards the light.
    pub direction: [f32; 3],
    /// Cosine of the half angle within which all of the share is taken.
    pub cos_inner: f32,
    /// Cosine of the half angle from which nothing is taken.
    pub cos_outer: f32,
    /// In [0, 1].
    pub share: f32,
    /// Unused.
    pub padding: [f32; 2],
}

/// One vertex of a mesh.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Vertex {
    /// Metres, in the object.
    pub position: [f32; 3],
    /// Unit.
    pub normal: [f32; 3],
    /// First texture coordinates.
    pub uv: [f32; 2],
}

/// What a vertex has beyond [`Vertex`], in a buffer of its own for meshes that need any of it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Detail {
    /// Unit, in the object; the fourth is the sign of the bitangent, 0 where there is none.
    pub tangent: [f32; 4],
    /// Second texture coordinates.
    pub uv1: [f32; 2],
    /// Linear RGBA, in 65535ths.
    pub color: [u16; 4],
}

/// `Influence`: what moves a vertex.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Influence {
    /// Add up to 1.
    pub weights: [f32; 4],
    /// Of the matrices, two in each number, the first in its lower half.
    pub joints: [u32; 2],
    /// Unused.
    pub padding: [u32; 2],
}

/// `Delta`: how far a morph target of weight 1 moves a vertex.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Delta {
    /// Metres.
    pub position: [f32; 3],
    /// Added before the normal is made a unit vector again.
    pub normal: [f32; 3],
}

/// `Deformation`: one mesh to be put into a pose.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Deformation {
    /// Vertices of the mesh.
    pub vertex_count: u32,
    /// Morph targets.
    pub target_count: u32,
    /// Of the pose's matrices, the first that is its own.
    pub first_matrix: u32,
    /// Of the pose's weights, the first that is its own.
    pub first_weight: u32,
    /// 1 where vertices have influences; else the first matrix moves them all.
    pub skinned: u32,
    /// 1 where each three vertices are a triangle with the normal of its plane.
    pub flat_shaded: u32,
    /// Unused.
    pub padding: [u32; 2],
}

/// `TextureMap`: how a texture's coordinates follow from a vertex's.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct TextureMap {
    /// First row of the transform of (u, v, 1); the fourth is 1 for the second set of coordinates.
    pub u: [f32; 4],
    /// Second row.
    pub v: [f32; 4],
}

/// `Material`: what a model's file says of a surface beyond the instance's.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Material {
    /// Base colour, metallic-roughness, normal, occlusion, emission.
    pub maps: [TextureMap; 5],
    /// Linear radiance.
    pub emission: [f32; 3],
    /// Of mapped normals' first two components.
    pub normal_scale: f32,
    /// In [0, 1].
    pub occlusion_strength: f32,
    /// In [0, 1].
    pub alpha: f32,
    /// Least alpha that covers.
    pub alpha_cutoff: f32,
    /// Unused.
    pub padding: f32,
}

/// `Probe`: one question to the kernels under test.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct Probe {
    /// Unit.
    pub direction: [f32; 3],
    /// By [`crate::source::transfer_index`].
    pub transfer: u32,
    /// In [0, 1] or somewhat beyond.
    pub code: [f32; 3],
    /// By [`crate::source::lift_index`].
    pub lift: u32,
    /// Columns.
    pub bt709_from_primaries: [[f32; 4]; 3],
    /// In use with its lift.
    pub recovery: Recovery,
}

/// `ProbeResult`: the kernels' answer.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct ProbeResult {
    /// Of the SH on a surface of this normal.
    pub irradiance: [f32; 3],
    /// Of the direction.
    pub u: f32,
    /// Light of the code.
    pub linear: [f32; 3],
    /// Of the direction.
    pub v: f32,
    /// Direction of (u, v).
    pub round_trip: [f32; 3],
    /// Unused.
    pub padding: f32,
    /// Radiance of the code under the lift.
    pub lifted: [f32; 3],
    /// Unused.
    pub padding_2: f32,
}

/// `BrdfProbe`: a surface, a view and a light, in the surface's frame with the normal along z.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct BrdfProbe {
    /// Unit.
    pub view: [f32; 3],
    /// Perceptual.
    pub roughness: f32,
    /// Unit.
    pub light: [f32; 3],
    /// Tangent of half the light's cone.
    pub tan_radius: f32,
    /// Linear.
    pub albedo: [f32; 3],
    /// In [0, 1].
    pub metallic: f32,
}

/// `BrdfResult`: what the surface reflects.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct BrdfResult {
    /// Radiance in the lobe, of a light of unit irradiance.
    pub specular: [f32; 3],
    /// Unused.
    pub padding: f32,
    /// All radiance, of a light of unit irradiance.
    pub direct: [f32; 3],
    /// Unused.
    pub padding_2: f32,
    /// Radiance, of radiance 1 from everywhere.
    pub ambient: [f32; 3],
    /// Unused.
    pub padding_3: f32,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::Module;
    use std::mem::{offset_of, size_of};

    /// Offsets of a WGSL struct's members and its size.
    fn wgsl(module: Module, name: &str) -> (Vec<(String, usize)>, usize) {
        let parsed = naga::front::wgsl::parse_str(&module.source().unwrap()).unwrap();
        let found = parsed.types.iter().find(|(_, ty)| ty.name.as_deref() == Some(name));
        let Some((_, naga::Type { inner: naga::TypeInner::Struct { members, span }, .. })) = found else { panic!("no struct {name}") };
        (members.iter().map(|m| (m.name.clone().unwrap(), m.offset as usize)).collect(), *span as usize)
    }

    macro_rules! mirrors {
        ($module:ident, $name:ident { $($field:ident),* }) => {
            let (members, span) = wgsl(Module::$module, stringify!($name));
            let rust = vec![$((stringify!($field).to_owned(), offset_of!($name, $field))),*];
            let padding = |fields: &[(String, usize)]| fields.iter().filter(|(n, _)| !n.starts_with("padding")).cloned().collect::<Vec<_>>();
            assert_eq!(padding(&members), padding(&rust), stringify!($name));
            assert_eq!(span, size_of::<$name>(), stringify!($name));
        };
    }

    #[test]
    fn mirrors_match_the_shaders() {
        mirrors!(Object, View { clip_from_world, world_from_ndc, position, eye, size_px, layer_origin, layer_size, dome_m, rays });
        mirrors!(Object, ShadowMap { from_world, half_width_m, range_m, texel_m, layer });
        mirrors!(Object, CasterCells { rows, clear_to_m });
        mirrors!(Object, Light { direction, tan_radius, irradiance, cut, objects, place });
        mirrors!(
            Object,
            Lighting {
                sh,
                ground_ambient,
                light_count,
                ground_before,
                shadow_count,
                ground_unshadowed,
                occluder_count,
                ground_reflectance,
                ground_y,
                lights,
                casters,
                ground_min,
                ground_max,
                ground_roughness,
                ground_f0,
                highest_m,
                padding
            }
        );
        mirrors!(Object, Occluder { center, radius, albedo, object, specular, padding });
        mirrors!(Object, Instance { world_from_object, normal_from_object, base_color, roughness, metallic, glass, object, padding });
        mirrors!(Object, Video { rgb_from_yuv, bt709_from_primaries, eye_rect, yuv_offset, chroma_shift_u, recovery });
        mirrors!(Object, Recovery { slope, gain_ln, tint, padding });
        mirrors!(EnvironmentLift, Lift { sh, cuts, size_px, samples, cut_count, padding });
        mirrors!(EnvironmentPrefilter, Prefilter { taps, count, size_px, padding });
        mirrors!(EnvironmentLift, Cut { direction, cos_inner, cos_outer, share, padding });
        mirrors!(Caster, Caster { clip_from_world });
        mirrors!(Deform, Vertex { position, normal, uv });
        mirrors!(Deform, Influence { weights, joints, padding });
        mirrors!(Deform, Delta { position, normal });
        mirrors!(Deform, Deformation { vertex_count, target_count, first_matrix, first_weight, skinned, flat_shaded, padding });
        mirrors!(Object, TextureMap { u, v });
        mirrors!(Object, Material { maps, emission, normal_scale, occlusion_strength, alpha, alpha_cutoff, padding });
        mirrors!(Probe, Probe { direction, transfer, code, lift, bt709_from_primaries, recovery });
        mirrors!(BrdfProbe, BrdfProbe { view, roughness, light, tan_radius, albedo, metallic });
        mirrors!(BrdfProbe, BrdfResult { specular, padding, direct, padding_2, ambient, padding_3 });
        mirrors!(Probe, ProbeResult { irradiance, u, linear, v, round_trip, padding, lifted, padding_2 });
    }
}
