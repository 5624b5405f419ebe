//! Bounding volume hierarchy over the place's primitives.

use glam::Vec3;

use super::geometry::{EPSILON, Hit, Ray, Shape};

const LEAF: usize = 3;

struct Node {
    min: Vec3,
    max: Vec3,
    /// First primitive of a leaf in `order`; the second child of an inner node (the first one follows it).
    first: u32,
    /// Primitives of a leaf; 0 for an inner node.
    count: u32,
}

/// Median-split hierarchy. Holds indices into the slice that it was built from.
pub(super) struct Bvh {
    nodes: Vec<Node>,
    order: Vec<u32>,
}

impl Bvh {
    pub(super) fn new(shapes: &[Shape]) -> Self {
        let mut order: Vec<u32> = (0..shapes.len() as u32).collect();
        let bounds: Vec<(Vec3, Vec3)> = shapes.iter().map(Shape::bounds).collect();
        let mut nodes = Vec::new();
        if !order.is_empty() {
            let all = order.len();
            split(&mut nodes, &mut order, &bounds, 0, all);
        }
        Self { nodes, order }
    }

    /// Nearest hit closer than `limit`, with the primitive's index.
    pub(super) fn nearest(&self, shapes: &[Shape], ray: &Ray, limit: f32) -> Option<(Hit, u32)> {
        let mut best: Option<(Hit, u32)> = None;
        let mut reach = limit;
        self.visit(ray, |index, _| {
            if let Some(hit) = shapes[index as usize].hit(ray)
                && hit.0 < reach
            {
                reach = hit.0;
                best = Some((hit, index));
            }
            Some(reach)
        });
        best
    }

    /// Whether anything lies within `limit` along the ray.
    pub(super) fn occluded(&self, shapes: &[Shape], ray: &Ray, limit: f32) -> bool {
        let mut found = false;
        self.visit(ray, |index, _| {
            found = shapes[index as usize].hit(ray).is_some_and(|(t, _)| t < limit);
            (!found).then_some(limit)
        });
        found
    }

    /// Calls `test` for every primitive whose node the ray meets within the reach that `test` last returned.
    fn visit(&self, ray: &Ray, mut test: impl FnMut(u32, &Ray) -> Option<f32>) {
        let inverse = ray.direction.recip();
        let mut reach = f32::INFINITY;
        let mut stack = [0u32; 48];
        let mut depth = usize::from(!self.nodes.is_empty());
        while depth > 0 {
            depth -= 1;
            let at = stack[depth];
            let node = &self.nodes[at as usize];
            let (t0, t1) = ((node.min - ray.origin) * inverse, (node.max - ray.origin) * inverse);
            let (near, far) = (t0.min(t1).max_element(), t0.max(t1).min_element());
            if near > far || far < EPSILON || near > reach {
                continue;
            }
            if node.count == 0 {
                stack[depth] = node.first;
                stack[depth + 1] = at + 1;
                depth += 2;
                continue;
            }
            for index in &self.order[node.first as usize..(node.first + node.count) as usize] {
                match test(*index, ray) {
                    Some(limit) => reach = limit,
                    None => return,
                }
            }
        }
    }
}

fn split(nodes: &mut Vec<Node>, order: &mut [u32], bounds: &[(Vec3, Vec3)], from: usize, to: usize) {
    let (mut min, mut max) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for index in &order[from..to] {
        min = min.min(bounds[*index as usize].0);
        max = max.max(bounds[*index as usize].1);
    }
    let at = nodes.len();
    nodes.push(Node { min, max, first: from as u32, count: (to - from) as u32 });
    if to - from <= LEAF {
        return;
    }
    let size = max - min;
    let axis = if size.x >= size.y.max(size.z) {
        Vec3::X
    } else if size.z >= size.y {
        Vec3::Z
    } else {
        Vec3::Y
    };
    let key = |index: &u32| (bounds[*index as usize].0 + bounds[*index as usize].1).dot(axis);
    order[from..to].sort_by(|a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
    let middle = (from + to) / 2;
    split(nodes, order, bounds, from, middle);
    let second = nodes.len() as u32;
    split(nodes, order, bounds, middle, to);
    nodes[at].first = second;
    nodes[at].count = 0;
}

#[cfg(test)]
mod tests {
    use super::super::noise::unit3;
    use super::*;

    #[test]
    fn finds_what_a_search_through_everything_finds() {
        let shapes: Vec<Shape> = (0..200)
            .map(|i| Shape::Sphere {
                centre: Vec3::new(unit3(i, 0, 1), unit3(i, 1, 1), unit3(i, 2, 1)) * 20.0 - 10.0,
                radius: 0.2 + unit3(i, 3, 1),
            })
            .collect();
        let bvh = Bvh::new(&shapes);
        for i in 0..500 {
            let direction = (Vec3::new(unit3(i, 0, 2), unit3(i, 1, 2), unit3(i, 2, 2)) - 0.5).normalize_or(Vec3::X);
            let ray = Ray { origin: Vec3::ZERO, direction };
            let slow = shapes.iter().filter_map(|s| s.hit(&ray)).map(|(t, _)| t).fold(f32::INFINITY, f32::min);
            let fast = bvh.nearest(&shapes, &ray, f32::INFINITY).map_or(f32::INFINITY, |((t, _), _)| t);
            assert_eq!(slow, fast);
            assert_eq!(bvh.occluded(&shapes, &ray, 5.0), slow < 5.0);
        }
    }
}
