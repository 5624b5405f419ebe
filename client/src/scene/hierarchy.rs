//! The nodes of a model's scene: who hangs on whom, and where each rests.

use glam::{Mat4, Quat, Vec3};

use super::animation::quaternion;
use super::model::{MAX_PARTS, ModelError};
use super::primitive::MAX_TARGETS;

/// Deepest chain of nodes.
pub const MAX_NODE_DEPTH: usize = 64;
/// Most nodes visited.
const MAX_NODES: usize = 65_536;

/// One node of the scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Node {
    /// Place of its parent in [`Hierarchy::nodes`], before its own.
    pub parent: Option<usize>,
    /// Transform to its parent while nothing moves it.
    pub matrix: Mat4,
    /// The same taken apart, for what animations leave alone: translation, rotation, scale.
    pub rest: (Vec3, Quat, Vec3),
    /// Weights of its mesh's morph targets while nothing moves them.
    pub weights: Vec<f32>,
}

/// All nodes of the scene, parents first.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Hierarchy {
    /// Parents first.
    pub nodes: Vec<Node>,
    /// Place of each of the file's nodes; `None` outside of the scene.
    pub(super) place: Vec<Option<usize>>,
}

impl Hierarchy {
    pub(super) fn read(document: &gltf::Document) -> Result<Self, ModelError> {
        let mut out = Self { nodes: Vec::new(), place: vec![None; document.nodes().len()] };
        let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else { return Ok(out) };
        let mut open: Vec<_> = scene.nodes().map(|node| (node, None, 1)).collect();
        while let Some((node, parent, depth)) = open.pop() {
            let fault = |fault: String| ModelError::Node { index: node.index(), fault };
            if out.nodes.len() >= MAX_NODES {
                return Err(ModelError::TooLarge { what: "nodes", limit: MAX_NODES });
            }
            if depth > MAX_NODE_DEPTH {
                return Err(fault(format!("lies in a cycle, or deeper than {MAX_NODE_DEPTH} nodes")));
            }
            let slot = out.place.get_mut(node.index()).ok_or_else(|| fault("does not exist".to_owned()))?;
            if slot.is_some() {
                return Err(fault("has two parents, or is its own ancestor".to_owned()));
            }
            *slot = Some(out.nodes.len());
            let own = read(&node).map_err(fault)?;
            open.extend(node.children().map(|child| (child, Some(out.nodes.len()), depth + 1)));
            out.nodes.push(Node { parent, ..own });
        }
        match out.world(|_, node| node.matrix).iter().position(|matrix| !matrix.is_finite()) {
            Some(at) => {
                let index = out.place.iter().position(|place| *place == Some(at)).unwrap_or(at);
                Err(ModelError::Node { index, fault: "its transform is not finite".to_owned() })
            }
            None => Ok(out),
        }
    }

    /// Transforms to the model's frame, given those to the parents.
    pub(super) fn world(&self, local: impl Fn(usize, &Node) -> Mat4) -> Vec<Mat4> {
        let mut world: Vec<Mat4> = Vec::with_capacity(self.nodes.len());
        for (at, node) in self.nodes.iter().enumerate() {
            let parent = node.parent.and_then(|parent| world.get(parent)).copied().unwrap_or(Mat4::IDENTITY);
            world.push(parent * local(at, node));
        }
        world
    }
}

fn read(node: &gltf::Node<'_>) -> Result<Node, String> {
    let transform = node.transform();
    let matrix = Mat4::from_cols_array_2d(&transform.clone().matrix());
    let rest = match transform {
        gltf::scene::Transform::Decomposed { translation, rotation, scale } => {
            (Vec3::from_array(translation), quaternion(&rotation), Vec3::from_array(scale))
        }
        gltf::scene::Transform::Matrix { .. } => {
            let (scale, rotation, translation) = matrix.to_scale_rotation_translation();
            (translation, rotation, scale)
        }
    };
    let primitives = node.mesh().into_iter().flat_map(|mesh| mesh.primitives()).take(MAX_PARTS);
    let targets = primitives.map(|primitive| primitive.morph_targets().len()).max().unwrap_or(0).min(MAX_TARGETS);
    let weights = node.weights().or_else(|| node.mesh().and_then(|mesh| mesh.weights())).unwrap_or_default();
    let mut weights: Vec<f32> = weights.iter().copied().take(targets).collect();
    weights.resize(targets, 0.0);
    if !matrix.is_finite() || !weights.iter().all(|weight| weight.is_finite()) {
        return Err("its transform or its weights are not finite".to_owned());
    }
    Ok(Node { parent: None, matrix, rest, weights })
}
