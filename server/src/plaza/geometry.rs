//! Analytic primitives and rays against them.

use glam::Vec3;

/// Nearer hits than this are the surface that the ray starts on, metres.
pub(super) const EPSILON: f32 = 1e-3;

/// A ray with a unit direction.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub(super) origin: Vec3,
    pub(super) direction: Vec3,
}

impl Ray {
    pub(super) fn at(&self, t: f32) -> Vec3 {
        self.origin + self.direction * t
    }
}

/// A half-space: points with `normal · p <= offset` are inside.
#[derive(Debug, Clone, Copy)]
pub(super) struct HalfSpace {
    pub(super) normal: Vec3,
    pub(super) offset: f32,
}

/// A solid.
#[derive(Debug, Clone)]
pub(super) enum Shape {
    /// Axis-aligned box.
    Box { min: Vec3, max: Vec3 },
    /// Sphere.
    Sphere { centre: Vec3, radius: f32 },
    /// Segment with a radius.
    Capsule { a: Vec3, b: Vec3, radius: f32 },
    /// Upright cylinder on its base.
    Cylinder { base: Vec3, radius: f32, height: f32 },
    /// Intersection of half-spaces, with its bounds.
    Convex { faces: Vec<HalfSpace>, min: Vec3, max: Vec3 },
}

/// Distance and outward normal.
pub(super) type Hit = (f32, Vec3);

impl Shape {
    /// Least and greatest corner of the axis-aligned bounds.
    pub(super) fn bounds(&self) -> (Vec3, Vec3) {
        match self {
            Self::Box { min, max } | Self::Convex { min, max, .. } => (*min, *max),
            Self::Sphere { centre, radius } => (*centre - *radius, *centre + *radius),
            Self::Capsule { a, b, radius } => (a.min(*b) - *radius, a.max(*b) + *radius),
            Self::Cylinder { base, radius, height } => {
                (*base - Vec3::new(*radius, 0.0, *radius), *base + Vec3::new(*radius, *height, *radius))
            }
        }
    }

    /// Nearest entry from outside, beyond [`EPSILON`].
    pub(super) fn hit(&self, ray: &Ray) -> Option<Hit> {
        match self {
            Self::Box { min, max } => hit_box(ray, *min, *max),
            Self::Sphere { centre, radius } => hit_sphere(ray, *centre, *radius),
            Self::Capsule { a, b, radius } => hit_capsule(ray, *a, *b, *radius),
            Self::Cylinder { base, radius, height } => hit_cylinder(ray, *base, *radius, *height),
            Self::Convex { faces, .. } => hit_convex(ray, faces),
        }
    }
}

fn hit_box(ray: &Ray, min: Vec3, max: Vec3) -> Option<Hit> {
    let inverse = ray.direction.recip();
    let (t0, t1) = ((min - ray.origin) * inverse, (max - ray.origin) * inverse);
    let near = t0.min(t1);
    let (t_near, t_far) = (near.max_element(), t0.max(t1).min_element());
    if t_near > t_far || t_near < EPSILON {
        return None;
    }
    let axis = if near.x == t_near {
        Vec3::X
    } else if near.y == t_near {
        Vec3::Y
    } else {
        Vec3::Z
    };
    Some((t_near, -axis * ray.direction.dot(axis).signum()))
}

fn hit_sphere(ray: &Ray, centre: Vec3, radius: f32) -> Option<Hit> {
    let to = ray.origin - centre;
    let b = to.dot(ray.direction);
    let closest = to - ray.direction * b;
    let h = radius * radius - closest.length_squared();
    if h < 0.0 {
        return None;
    }
    let t = -b - h.sqrt();
    (t > EPSILON).then(|| (t, (ray.at(t) - centre) / radius))
}

/// Distance to a capsule, without the normal.
pub(super) fn capsule_distance(ray: &Ray, a: Vec3, b: Vec3, radius: f32) -> Option<f32> {
    let (axis, to) = (b - a, ray.origin - a);
    let axis2 = axis.length_squared();
    let (along_ray, along_to) = (axis.dot(ray.direction), axis.dot(to));
    let qa = axis2 - along_ray * along_ray;
    let qb = axis2 * ray.direction.dot(to) - along_to * along_ray;
    let qc = axis2 * to.length_squared() - along_to * along_to - radius * radius * axis2;
    let h = qb * qb - qa * qc;
    if h < 0.0 {
        return None;
    }
    let t = if qa > 1e-6 * axis2 { (-qb - h.sqrt()) / qa } else { 0.0 };
    let along = along_to + t * along_ray;
    if qa > 1e-6 * axis2 && along > 0.0 && along < axis2 {
        return (t > EPSILON).then_some(t);
    }
    let towards_b = if qa > 1e-6 * axis2 { along >= axis2 } else { along_ray < 0.0 };
    hit_sphere(ray, if towards_b { b } else { a }, radius).map(|(t, _)| t)
}

/// Normal of a capsule at a point of its surface.
pub(super) fn capsule_normal(p: Vec3, a: Vec3, b: Vec3, radius: f32) -> Vec3 {
    let axis = b - a;
    let along = ((p - a).dot(axis) / axis.length_squared().max(1e-12)).clamp(0.0, 1.0);
    (p - a - axis * along) / radius
}

fn hit_capsule(ray: &Ray, a: Vec3, b: Vec3, radius: f32) -> Option<Hit> {
    capsule_distance(ray, a, b, radius).map(|t| (t, capsule_normal(ray.at(t), a, b, radius)))
}

fn hit_cylinder(ray: &Ray, base: Vec3, radius: f32, height: f32) -> Option<Hit> {
    let to = ray.origin - base;
    let d = ray.direction;
    // Slab of the caps.
    let (y0, y1) = (-to.y / d.y, (height - to.y) / d.y);
    let (cap_near, cap_far) = (y0.min(y1), y0.max(y1));
    // The endless tube.
    let a = d.x * d.x + d.z * d.z;
    let b = to.x * d.x + to.z * d.z;
    let c = to.x * to.x + to.z * to.z - radius * radius;
    let h = b * b - a * c;
    if h < 0.0 || a < 1e-12 {
        return (a < 1e-12 && c <= 0.0 && cap_near > EPSILON).then(|| (cap_near, Vec3::Y * -d.y.signum()));
    }
    let (tube_near, tube_far) = ((-b - h.sqrt()) / a, (-b + h.sqrt()) / a);
    let t = tube_near.max(cap_near);
    if t > tube_far.min(cap_far) || t < EPSILON {
        return None;
    }
    if cap_near > tube_near {
        return Some((t, Vec3::Y * -d.y.signum()));
    }
    let p = to + d * t;
    Some((t, Vec3::new(p.x, 0.0, p.z) / radius))
}

fn hit_convex(ray: &Ray, faces: &[HalfSpace]) -> Option<Hit> {
    let (mut near, mut far, mut normal) = (f32::NEG_INFINITY, f32::INFINITY, Vec3::Y);
    for face in faces {
        let speed = face.normal.dot(ray.direction);
        let gap = face.offset - face.normal.dot(ray.origin);
        if speed.abs() < 1e-9 {
            if gap < 0.0 {
                return None;
            }
        } else if speed < 0.0 {
            if gap / speed > near {
                (near, normal) = (gap / speed, face.normal);
            }
        } else {
            far = far.min(gap / speed);
        }
    }
    (near <= far && near > EPSILON).then_some((near, normal))
}

/// A roof over the rectangle `min`–`max` (their y is the eaves): four slopes that meet in a ridge along the
/// longer side, or in a point over a square. `hip` in [0, 1] is how far the ends slope: 0 is a gable.
pub(super) fn roof(min: Vec3, max: Vec3, rise: f32, hip: f32) -> Shape {
    let half = (max - min) * 0.5;
    let centre = (max + min) * 0.5;
    let run = half.x.min(half.z);
    let slope = |outward: Vec3, run: f32, reach: f32| {
        let normal = (outward * rise + Vec3::Y * run).normalize();
        HalfSpace { normal, offset: normal.dot(Vec3::new(centre.x, min.y, centre.z) + outward * reach) }
    };
    let end_run = (run * hip).max(0.01);
    let (run_x, run_z) = if half.x <= half.z { (run, end_run) } else { (end_run, run) };
    let faces = vec![
        slope(Vec3::X, run_x, half.x),
        slope(-Vec3::X, run_x, half.x),
        slope(Vec3::Z, run_z, half.z),
        slope(-Vec3::Z, run_z, half.z),
        HalfSpace { normal: -Vec3::Y, offset: -min.y },
    ];
    Shape::Convex { faces, min: Vec3::new(min.x, min.y, min.z), max: Vec3::new(max.x, min.y + rise, max.z) }
}

/// An upright pyramid with `sides` faces on a circle of `radius`: a parasol, a small spire.
pub(super) fn pyramid(base: Vec3, radius: f32, rise: f32, sides: u32) -> Shape {
    let mut faces = vec![HalfSpace { normal: -Vec3::Y, offset: -base.y }];
    for side in 0..sides {
        let angle = std::f32::consts::TAU * (side as f32 + 0.5) / sides as f32;
        let outward = Vec3::new(angle.cos(), 0.0, angle.sin());
        let normal = (outward * rise + Vec3::Y * radius).normalize();
        faces.push(HalfSpace { normal, offset: normal.dot(base + outward * radius) });
    }
    let reach = radius / (std::f32::consts::PI / sides as f32).cos();
    Shape::Convex { faces, min: base - Vec3::new(reach, 0.0, reach), max: base + Vec3::new(reach, rise, reach) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along_minus_z(y: f32) -> Ray {
        Ray { origin: Vec3::new(0.0, y, 10.0), direction: -Vec3::Z }
    }

    #[test]
    fn every_shape_is_hit_where_geometry_says() {
        let shapes = [
            Shape::Box { min: Vec3::NEG_ONE, max: Vec3::ONE },
            Shape::Sphere { centre: Vec3::ZERO, radius: 1.0 },
            Shape::Capsule { a: -Vec3::Y, b: Vec3::Y, radius: 1.0 },
            Shape::Cylinder { base: -Vec3::Y, radius: 1.0, height: 2.0 },
        ];
        for shape in &shapes {
            let (t, normal) = shape.hit(&along_minus_z(0.0)).expect("aimed at the centre");
            assert!((t - 9.0).abs() < 1e-4 && (normal - Vec3::Z).length() < 1e-4, "{shape:?} {t} {normal}");
            assert!(shape.hit(&along_minus_z(2.1)).is_none(), "{shape:?} has no such height");
        }
        let down = Ray { origin: Vec3::Y * 5.0, direction: -Vec3::Y };
        for (shape, top) in shapes.iter().zip([1.0, 1.0, 2.0, 1.0]) {
            let (t, normal) = shape.hit(&down).expect("straight down");
            assert!((5.0 - t - top).abs() < 1e-4 && (normal - Vec3::Y).length() < 1e-4, "{shape:?} {t} {normal}");
        }
    }

    #[test]
    fn roofs_rise_to_their_ridge() {
        let shape = roof(Vec3::new(-4.0, 0.0, -2.0), Vec3::new(4.0, 0.0, 2.0), 1.5, 1.0);
        let (t, _) = shape.hit(&Ray { origin: Vec3::Y * 10.0, direction: -Vec3::Y }).expect("over the ridge");
        assert!((10.0 - t - 1.5).abs() < 1e-4, "{t}");
        let (t, normal) = shape.hit(&Ray { origin: Vec3::new(0.0, 10.0, 1.0), direction: -Vec3::Y }).expect("over a slope");
        assert!((10.0 - t - 0.75).abs() < 1e-4 && normal.z > 0.0, "{t} {normal}");
    }
}
