//! Rays against objects and the ground, for dragging.

use glam::Vec3;
use mr360_protocol::scene::{ObjectId, Shape, Transform};

use super::mesh::Bounds;

/// A half line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Metres.
    pub origin: Vec3,
    /// Unit.
    pub direction: Vec3,
}

impl Ray {
    /// The point at a distance, metres.
    #[must_use]
    pub fn at(&self, distance: f32) -> Vec3 {
        self.origin + self.direction * distance
    }

    /// Where the ray meets the ground plane, if it does within `farthest_m`.
    #[must_use]
    pub fn ground(&self, ground_y: f32, farthest_m: f32) -> Option<Vec3> {
        let distance = (ground_y - self.origin.y) / self.direction.y;
        (distance.is_finite() && distance >= 0.0 && distance <= farthest_m).then(|| self.at(distance))
    }

    /// The ray in the frame of an object, not of unit length there: distances along it stay the world's.
    fn in_object(&self, transform: &Transform) -> Self {
        let inverse = transform.rotation.inverse();
        Self {
            origin: inverse * (self.origin - transform.position) / transform.scale,
            direction: inverse * self.direction / transform.scale,
        }
    }
}

/// What a ray is tested against.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    /// Whose.
    pub id: ObjectId,
    /// Its place.
    pub transform: Transform,
    /// In its own frame.
    pub bounds: Bounds,
    /// Its exact form, where it has one.
    pub shape: Option<Shape>,
}

/// The nearest object along the ray and the point where it is met: the ball itself for spheres, the oriented
/// bounding box for everything else.
#[must_use]
pub fn nearest(ray: &Ray, targets: impl IntoIterator<Item = Target>) -> Option<(ObjectId, Vec3)> {
    targets
        .into_iter()
        .filter_map(|target| {
            let local = ray.in_object(&target.transform);
            let distance = match target.shape {
                Some(Shape::Sphere) => hit_unit_ball(&local)?,
                _ => hit_box(&local, &target.bounds)?,
            };
            Some((distance, target.id))
        })
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(distance, id)| (id, ray.at(distance)))
}

/// The object nearest to a point, and how far away it is, metres, if that is at most `reach_m`; 0 within its oriented bounding box or
/// the ball itself.
#[must_use]
pub fn nearest_to(point: Vec3, reach_m: f32, targets: impl IntoIterator<Item = Target>) -> Option<(ObjectId, f32)> {
    let distance = |target: &Target| {
        let Transform { position, rotation, scale } = target.transform;
        let local = rotation.inverse() * (point - position);
        let (min, max) = (target.bounds.min * scale, target.bounds.max * scale);
        let round = target.shape == Some(Shape::Sphere) && scale.max_element() - scale.min_element() <= 1e-3 * scale.max_element();
        if round { (local.length() - scale.x * 0.5).max(0.0) } else { local.distance(local.max(min).min(max)) }
    };
    let within = targets.into_iter().map(|target| (target.id, distance(&target))).filter(|(_, distance)| *distance <= reach_m);
    within.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// The ball of diameter 1 around the origin.
fn hit_unit_ball(ray: &Ray) -> Option<f32> {
    let (a, b) = (ray.direction.length_squared(), ray.origin.dot(ray.direction));
    let root = b * b - a * (ray.origin.length_squared() - 0.25);
    let root = (root >= 0.0).then(|| root.sqrt())?;
    [(-b - root) / a, (-b + root) / a].into_iter().find(|distance| *distance >= 0.0)
}

fn hit_box(ray: &Ray, bounds: &Bounds) -> Option<f32> {
    let (to_min, to_max) = ((bounds.min - ray.origin) / ray.direction, (bounds.max - ray.origin) / ray.direction);
    // A ray within a face's plane gives 0/0; min and max of floats leave a NaN out.
    let enter = to_min.to_array().into_iter().zip(to_max.to_array()).map(|(a, b)| a.min(b)).fold(0.0, f32::max);
    let leave = to_min.to_array().into_iter().zip(to_max.to_array()).map(|(a, b)| a.max(b)).fold(f32::INFINITY, f32::min);
    (enter <= leave).then_some(enter)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    fn target(id: u32, shape: Shape, position: Vec3, scale: Vec3) -> Target {
        let transform = Transform { position, rotation: Quat::from_rotation_y(0.5), scale };
        Target { id: ObjectId(id), transform, bounds: Bounds { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) }, shape: Some(shape) }
    }

    #[test]
    fn the_nearest_object_is_hit_where_it_is() {
        let ray = Ray { origin: Vec3::ZERO, direction: Vec3::NEG_Z };
        let near = target(1, Shape::Sphere, Vec3::new(0.0, 0.0, -3.0), Vec3::splat(2.0));
        let far = target(2, Shape::Cube, Vec3::new(0.0, 0.0, -9.0), Vec3::ONE);
        let (id, point) = nearest(&ray, [far, near]).unwrap();
        assert_eq!(id, ObjectId(1));
        assert!((point - Vec3::new(0.0, 0.0, -2.0)).length() < 1e-5, "{point}");
        let past = Ray { origin: Vec3::new(1.01, 0.0, 0.0), direction: Vec3::NEG_Z };
        assert_eq!(nearest(&past, [near, far]), None);
        let away = Ray { origin: Vec3::ZERO, direction: Vec3::Z };
        assert_eq!(nearest(&away, [near, far]), None);
    }

    #[test]
    fn the_nearest_object_within_reach_is_touched() {
        let ball = target(1, Shape::Sphere, Vec3::ZERO, Vec3::splat(2.0));
        let cube = target(2, Shape::Cube, Vec3::new(3.0, 0.0, 0.0), Vec3::new(1.0, 4.0, 1.0));
        let at = |point| nearest_to(point, 0.5, [ball, cube]);
        assert_eq!(at(Vec3::X * 0.5), Some((ObjectId(1), 0.0)));
        let (id, distance) = at(Vec3::new(0.8, 0.8, 0.0)).unwrap();
        // Beyond the ball, though within its box.
        assert!(id == ObjectId(1) && (distance - (0.8 * std::f32::consts::SQRT_2 - 1.0)).abs() < 1e-5);
        let (id, distance) = at(Vec3::new(3.0, 2.3, 0.0)).unwrap();
        assert!(id == ObjectId(2) && (distance - 0.3).abs() < 1e-5);
        assert_eq!(at(Vec3::Y * 1.6), None);
        // A box around nothing is nowhere.
        let empty = Target { bounds: Bounds::EMPTY, shape: None, ..cube };
        assert_eq!(nearest_to(Vec3::ZERO, 1.0, [empty]), None);
    }

    #[test]
    fn rays_meet_the_ground_ahead_only() {
        let down = Ray { origin: Vec3::ZERO, direction: Vec3::new(0.0, -0.6, -0.8) };
        assert!((down.ground(-1.5, 100.0).unwrap() - Vec3::new(0.0, -1.5, -2.0)).length() < 1e-5);
        assert_eq!(down.ground(-1.5, 1.0), None);
        assert_eq!(Ray { origin: Vec3::ZERO, direction: Vec3::Y }.ground(-1.5, 100.0), None);
        assert_eq!(Ray { origin: Vec3::ZERO, direction: Vec3::X }.ground(-1.5, 100.0), None);
    }
}
