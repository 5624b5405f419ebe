//! What moves a model: its nodes, skins and morph targets, put into the pose of a time.

use glam::{Mat3, Mat4, Vec3};
use mr360_shaders::layout::{Deformation, Vertex};

use super::animation::{Animation, Interpolation, Moved, Path, Track};
use super::hierarchy::Hierarchy;
use super::mesh::Bounds;
use super::primitive::Primitive;

/// Matrices of all bindings together.
pub const MAX_MATRICES: usize = 4096;
/// Times at which the bounds of an animation are taken: in a model with many joints at most the first, in others the second.
const SAMPLES: (usize, usize) = (16, 2048);
/// Nodes and boxes of joints that are moved for all bounds of a model together.
const MAX_MOVES: usize = 1 << 22;

/// Who moves a primitive: one node, or the joints of a skin.
#[derive(Debug, Clone, PartialEq)]
pub struct Binding {
    /// Places of nodes, each with what takes its vertices to it. A rigid mesh has one, its own node.
    pub joints: Vec<(usize, Mat4)>,
    /// The node of the mesh, whose weights its morph targets have.
    pub node: usize,
    /// The first of its matrices in a pose.
    pub first_matrix: usize,
    /// The first of its weights in a pose.
    pub first_weight: usize,
}

/// A part that some animation moves.
#[derive(Debug, Clone, PartialEq)]
pub struct Moving {
    /// Which of the model's parts.
    pub part: usize,
    /// As the file has it.
    pub primitive: Primitive,
    /// Which of the rig's bindings.
    pub binding: usize,
}

/// Matrices and weights for every binding, in order: what [`Moving`] parts are deformed with.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Pose {
    /// From the vertices of the file to the model's frame.
    pub matrices: Vec<Mat4>,
    /// Of morph targets.
    pub weights: Vec<f32>,
}

/// Everything that is needed to play a model's animations.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Rig {
    /// Nodes.
    pub hierarchy: Hierarchy,
    /// Who moves what.
    pub bindings: Vec<Binding>,
    /// What is moved by any animation.
    pub moving: Vec<Moving>,
    /// In the order of the file.
    pub animations: Vec<Animation>,
    /// Around the whole model in all poses of each animation.
    pub bounds: Vec<Bounds>,
}

impl Rig {
    /// The pose of an animation at a time, seconds from its beginning, repeated for ever; the rest pose where there is no such
    /// animation. It depends on nothing else, so that all viewers of a broadcast see the same.
    #[must_use]
    pub fn pose(&self, animation: usize, time_s: f64) -> Pose {
        self.animations.get(animation).map_or_else(|| self.pose_of(&[], 0.0), |a| self.pose_of(&a.tracks, a.looped(time_s)))
    }

    /// The pose of the file's own transforms.
    #[must_use]
    pub fn rest(&self) -> Pose {
        self.pose_of(&[], 0.0)
    }

    fn pose_of(&self, tracks: &[Track], time_s: f32) -> Pose {
        let nodes = &self.hierarchy.nodes;
        let mut moved = vec![None; nodes.len()];
        let mut weights: Vec<Option<Vec<f32>>> = vec![None; nodes.len()];
        for track in tracks {
            let rest = nodes[track.node].rest;
            match track.moved(time_s) {
                Moved::Translation(to) => moved[track.node].get_or_insert(rest).0 = to,
                Moved::Rotation(to) => moved[track.node].get_or_insert(rest).1 = to,
                Moved::Scale(to) => moved[track.node].get_or_insert(rest).2 = to,
                Moved::Weights(to) => weights[track.node] = Some(to),
            }
        }
        let world = self.hierarchy.world(|at, node| {
            moved[at]
                .map_or(node.matrix, |(translation, rotation, scale)| Mat4::from_scale_rotation_translation(scale, rotation, translation))
        });
        let mut pose = Pose::default();
        for binding in &self.bindings {
            pose.matrices.extend(binding.joints.iter().map(|(node, bind)| world[*node] * *bind));
            pose.weights.extend(weights[binding.node].as_ref().unwrap_or(&nodes[binding.node].weights));
        }
        pose
    }

    /// True for nodes that an animation moves, with all that hangs on them; and for those whose weights it changes.
    pub(super) fn moved_nodes(&self) -> Vec<bool> {
        let mut moved = vec![false; self.hierarchy.nodes.len()];
        self.animations.iter().flat_map(|animation| &animation.tracks).for_each(|track| moved[track.node] = true);
        for at in 0..moved.len() {
            if let Some(parent) = self.hierarchy.nodes[at].parent {
                moved[at] |= moved[parent];
            }
        }
        moved
    }

    /// Fills in the bounds of each animation, around what stands still and what moves. False where a pose reaches beyond all numbers.
    ///
    /// A deformed vertex lies between the places that its joints alone would take it to, so the boxes of each joint's vertices,
    /// moved by the joint, hold it. They are followed from key to key; in between, a corner keeps within half its way of one
    /// of the two, and as much is added.
    pub(super) fn measure(&mut self, still: Bounds) -> bool {
        let boxes = self.joint_boxes();
        let moves = (boxes.iter().map(Vec::len).sum::<usize>() + self.hierarchy.nodes.len()) * self.animations.len();
        let most = (MAX_MOVES / moves.max(1)).clamp(SAMPLES.0, SAMPLES.1);
        let bounds_of = |animation: &Animation| {
            let poses = sample_times(animation, most).into_iter().map(|time| self.pose_of(&animation.tracks, time));
            poses_bounds(&boxes, poses, still)
        };
        let bounds: Vec<Bounds> = self.animations.iter().map(bounds_of).collect();
        self.bounds = bounds;
        self.bounds.iter().all(|bounds| bounds.min.is_finite() && bounds.max.is_finite())
    }

    /// For each binding and each of its joints, the box of the vertices it has a hold on, wherever morph targets take them.
    fn joint_boxes(&self) -> Vec<Vec<Bounds>> {
        let mut boxes: Vec<Vec<Bounds>> = self.bindings.iter().map(|binding| vec![Bounds::EMPTY; binding.joints.len()]).collect();
        let ranges = self.weight_ranges();
        for moving in &self.moving {
            let (binding, primitive) = (&self.bindings[moving.binding], &moving.primitive);
            let vertices = &primitive.mesh.vertices;
            for (at, vertex) in vertices.iter().enumerate() {
                let position = Vec3::from_array(vertex.position);
                let mut around = Bounds::EMPTY.including(position);
                for (target, delta) in primitive.deltas.iter().skip(at).step_by(vertices.len()).enumerate() {
                    let (low, high) = ranges[binding.first_weight + target];
                    let delta = Vec3::from_array(delta.position);
                    let (a, b) = (delta * low, delta * high);
                    around = Bounds { min: around.min + a.min(b), max: around.max + a.max(b) };
                }
                let boxes = &mut boxes[moving.binding];
                match primitive.influences.get(at) {
                    Some(influence) => {
                        for slot in (0..4).filter(|slot| influence.weights[*slot] > 0.0) {
                            let joint = joint_of(influence.joints, slot);
                            boxes[joint] = boxes[joint].joined(&around);
                        }
                    }
                    None => boxes[0] = boxes[0].joined(&around),
                }
            }
        }
        boxes
    }

    /// Least and largest value of each weight of a pose, over all animations and at rest. A spline may swing out beyond its keys,
    /// by 4/27 of each of the two tangents times the time between the keys.
    fn weight_ranges(&self) -> Vec<(f32, f32)> {
        let mut ranges: Vec<(f32, f32)> = self.rest().weights.into_iter().map(|weight| (weight, weight)).collect();
        for binding in &self.bindings {
            let tracks = self.animations.iter().flat_map(|a| &a.tracks);
            for track in tracks.filter(|track| track.node == binding.node && track.path == Path::Weights && track.width > 0) {
                let longest = track.times.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f32::max);
                let ranges = &mut ranges[binding.first_weight..binding.first_weight + track.width];
                for (at, range) in ranges.iter_mut().enumerate() {
                    let numbers = track.values.iter().skip(at).step_by(track.width).enumerate();
                    let (mut low, mut high, mut steepest) = (range.0, range.1, 0.0f32);
                    for (i, number) in numbers {
                        if track.interpolation == Interpolation::Cubic && i % 3 != 1 {
                            steepest = steepest.max(number.abs());
                        } else {
                            (low, high) = (low.min(*number), high.max(*number));
                        }
                    }
                    let swing = 8.0 / 27.0 * longest * steepest;
                    *range = (low - swing, high + swing);
                }
            }
        }
        ranges
    }
}

/// Every key of an animation and two times between each and the next; fewer, spread evenly, where that is more than `most`.
fn sample_times(animation: &Animation, most: usize) -> Vec<f32> {
    let mut keys: Vec<f32> = animation.tracks.iter().flat_map(|track| track.times.iter().copied()).collect();
    keys.sort_unstable_by(f32::total_cmp);
    keys.dedup();
    let between = |pair: &[f32]| [pair[0], pair[0] + (pair[1] - pair[0]) / 3.0, pair[0] + (pair[1] - pair[0]) / 1.5];
    let mut times: Vec<f32> = keys.windows(2).flat_map(between).chain(keys.last().copied()).collect();
    let skip = times.len().div_ceil(most.max(1)).max(1);
    let last = times.last().copied();
    times = times.into_iter().step_by(skip).collect();
    times.extend(last);
    times
}

fn poses_bounds(boxes: &[Vec<Bounds>], poses: impl Iterator<Item = Pose>, still: Bounds) -> Bounds {
    let boxes: Vec<&Bounds> = boxes.iter().flatten().collect();
    let mut around = vec![Bounds::EMPTY; boxes.len()];
    let mut before: Vec<Option<[Vec3; 8]>> = vec![None; boxes.len()];
    let mut farthest = vec![0.0f32; boxes.len()];
    for pose in poses {
        for (at, (own, matrix)) in boxes.iter().zip(&pose.matrices).enumerate().filter(|(_, (own, _))| own.min.x <= own.max.x) {
            let corners = own.corners().map(|corner| matrix.transform_point3(corner));
            around[at] = corners.iter().fold(around[at], |bounds, corner| bounds.including(*corner));
            if let Some(before) = &before[at] {
                farthest[at] = before.iter().zip(&corners).map(|(a, b)| a.distance(*b)).fold(farthest[at], f32::max);
            }
            // A corner that is no number has no place among minima and maxima; the box has to tell of it.
            if !corners.iter().all(|corner| corner.is_finite()) {
                around[at] = Bounds { min: Vec3::NEG_INFINITY, max: Vec3::INFINITY };
            }
            before[at] = Some(corners);
        }
    }
    around.iter().zip(farthest).filter(|(bounds, _)| bounds.min.x <= bounds.max.x).fold(still, |all, (bounds, farthest)| {
        // The way between two times is an arc, a tenth longer than its chord where it turns by 90°.
        let room = Vec3::splat(0.55 * farthest);
        all.joined(&Bounds { min: bounds.min - room, max: bounds.max + room })
    })
}

fn joint_of(joints: [u32; 2], slot: usize) -> usize {
    (joints[slot / 2] >> (16 * (slot % 2)) & 0xffff) as usize
}

/// What the shader that deforms a primitive is told.
#[must_use]
pub fn deformation(primitive: &Primitive, binding: &Binding) -> Deformation {
    let vertices = primitive.mesh.vertices.len();
    Deformation {
        vertex_count: vertices as u32,
        target_count: primitive.deltas.len().checked_div(vertices).unwrap_or(0) as u32,
        first_matrix: binding.first_matrix as u32,
        first_weight: binding.first_weight as u32,
        skinned: u32::from(!primitive.influences.is_empty()),
        flat_shaded: u32::from(primitive.flat),
        padding: [0; 2],
    }
}

/// The vertices of a primitive, given the matrices and weights of its own binding: morph targets first, then joints (glTF 2.0, Sec. 3.7). Twin of `deform.wgsl`.
#[must_use]
pub fn deform(primitive: &Primitive, matrices: &[Mat4], weights: &[f32]) -> Vec<Vertex> {
    let vertices = &primitive.mesh.vertices;
    let place = |at: usize, vertex: &Vertex| {
        let (mut position, mut normal) = (Vec3::from_array(vertex.position), Vec3::from_array(vertex.normal));
        for (delta, weight) in primitive.deltas.iter().skip(at).step_by(vertices.len()).zip(weights).filter(|(_, weight)| **weight != 0.0) {
            position += Vec3::from_array(delta.position) * *weight;
            normal += Vec3::from_array(delta.normal) * *weight;
        }
        let matrix = match primitive.influences.get(at) {
            Some(influence) => (0..4)
                .filter(|slot| influence.weights[*slot] != 0.0)
                .fold(Mat4::ZERO, |sum, slot| sum + matrices[joint_of(influence.joints, slot)] * influence.weights[slot]),
            None => matrices[0],
        };
        (matrix.transform_point3(position), (normal_matrix(matrix) * normal).normalize_or(Vec3::Y))
    };
    let mut out: Vec<Vertex> = vertices
        .iter()
        .enumerate()
        .map(|(at, vertex)| {
            let (position, normal) = place(at, vertex);
            Vertex { position: position.to_array(), normal: normal.to_array(), uv: vertex.uv }
        })
        .collect();
    if primitive.flat {
        for corners in out.chunks_exact_mut(3) {
            let [a, b, c] = [0, 1, 2].map(|i| Vec3::from_array(corners[i].position));
            let normal = (b - a).cross(c - a).normalize_or(Vec3::Y).to_array();
            corners.iter_mut().for_each(|corner| corner.normal = normal);
        }
    }
    out
}

/// Inverse transpose, up to a factor, that also works for singular matrices.
fn normal_matrix(matrix: Mat4) -> Mat3 {
    let m = Mat3::from_mat4(matrix);
    let cofactors = Mat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis));
    if m.determinant() < 0.0 { -cofactors } else { cofactors }
}
