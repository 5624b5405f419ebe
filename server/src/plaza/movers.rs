//! People who walk closed paths: where they are at a time, and their bodies as capsules.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use super::geometry::{Ray, capsule_distance, capsule_normal};
use super::place::GROUND_Y;

/// A limb.
#[derive(Debug, Clone, Copy)]
pub(super) struct Part {
    a: Vec3,
    b: Vec3,
    radius: f32,
    albedo: Vec3,
}

/// A racetrack: two straights and two half circles, so that the distance walked has a closed form.
#[derive(Debug, Clone, Copy)]
struct Track {
    centre: [f32; 2],
    /// Half the length of the straights, and the radius of the turns.
    half_straight: f32,
    radius: f32,
    /// Turn of the straights from +x, radians.
    angle: f32,
}

impl Track {
    fn length(&self) -> f64 {
        4.0 * f64::from(self.half_straight) + f64::from(TAU) * f64::from(self.radius)
    }

    /// Place and heading after walking `distance` in [0, length).
    fn at(&self, distance: f32) -> (Vec2, Vec2) {
        let (straight, turn) = (2.0 * self.half_straight, PI * self.radius);
        let lap = straight + turn;
        let (side, along) = if distance < lap { (1.0, distance) } else { (-1.0, distance - lap) };
        let (p, heading) = if along < straight {
            (Vec2::new(along - self.half_straight, -self.radius), Vec2::X)
        } else {
            let (sin, cos) = ((along - straight) / self.radius).sin_cos();
            (Vec2::new(self.half_straight + self.radius * sin, -self.radius * cos), Vec2::new(cos, sin))
        };
        let turned = Vec2::from_angle(self.angle);
        (Vec2::from(self.centre) + turned.rotate(p * side), turned.rotate(heading * side))
    }
}

/// Someone's path, pace and clothes.
struct Walker {
    track: Track,
    /// Metres a second; negative walks the other way round.
    speed: f32,
    /// Share of the lap walked at time zero.
    start: f64,
    height: f32,
    skin: [f32; 3],
    hair: [f32; 3],
    coat: [f32; 3],
    trousers: [f32; 3],
}

const WALKERS: [Walker; 5] = [
    Walker {
        track: Track { centre: [-2.2, -9.4], half_straight: 3.4, radius: 1.1, angle: 0.12 },
        speed: 1.25,
        start: 0.10,
        height: 1.76,
        skin: [0.50, 0.31, 0.22],
        hair: [0.05, 0.03, 0.02],
        coat: [0.50, 0.05, 0.04],
        trousers: [0.05, 0.06, 0.10],
    },
    Walker {
        track: Track { centre: [5.9, -9.6], half_straight: 2.2, radius: 1.2, angle: 1.2 },
        speed: -1.1,
        start: 0.55,
        height: 1.68,
        skin: [0.36, 0.21, 0.14],
        hair: [0.02, 0.015, 0.01],
        coat: [0.62, 0.50, 0.22],
        trousers: [0.11, 0.10, 0.09],
    },
    Walker {
        track: Track { centre: [-8.6, 0.5], half_straight: 4.0, radius: 0.9, angle: 1.45 },
        speed: 1.4,
        start: 0.3,
        height: 1.82,
        skin: [0.55, 0.36, 0.27],
        hair: [0.22, 0.12, 0.05],
        coat: [0.06, 0.13, 0.27],
        trousers: [0.16, 0.13, 0.10],
    },
    Walker {
        track: Track { centre: [9.6, 0.0], half_straight: 3.2, radius: 1.0, angle: 1.62 },
        speed: 1.15,
        start: 0.7,
        height: 1.64,
        skin: [0.52, 0.33, 0.25],
        hair: [0.30, 0.19, 0.07],
        coat: [0.06, 0.27, 0.20],
        trousers: [0.30, 0.27, 0.22],
    },
    Walker {
        track: Track { centre: [-0.5, 10.2], half_straight: 4.5, radius: 1.3, angle: 0.0 },
        speed: 1.3,
        start: 0.0,
        height: 1.74,
        skin: [0.30, 0.17, 0.11],
        hair: [0.02, 0.015, 0.01],
        coat: [0.55, 0.53, 0.50],
        trousers: [0.05, 0.06, 0.07],
    },
];

/// Step length over height.
const STRIDE: f32 = 0.43;

/// A body at one time.
pub(super) struct Figure {
    pub(super) id: u32,
    /// On the ground below the hip.
    pub(super) position: Vec3,
    pub(super) heading: Vec3,
    pub(super) height: f32,
    pub(super) parts: Vec<Part>,
    /// Least and greatest corner.
    pub(super) bounds: (Vec3, Vec3),
}

/// Everyone at a time.
pub(super) fn figures(count: u32, time_secs: f64) -> Vec<Figure> {
    WALKERS.iter().take(count as usize).enumerate().map(|(id, walker)| walker.figure(id as u32, time_secs)).collect()
}

impl Walker {
    fn figure(&self, id: u32, time_secs: f64) -> Figure {
        let length = self.track.length();
        let walked = f64::from(self.speed) * time_secs;
        let (at, heading) = self.track.at((self.start * length + walked).rem_euclid(length) as f32);
        let heading = heading * self.speed.signum();
        let position = Vec3::new(at.x, GROUND_Y, at.y);
        let stride = f64::from(2.0 * STRIDE * self.height);
        let phase = ((walked.abs() / stride).fract() as f32) * TAU;
        let heading = Vec3::new(heading.x, 0.0, heading.y);
        let parts = self.body(position, heading, phase);
        let (mut min, mut max) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for part in &parts {
            min = min.min(part.a.min(part.b) - part.radius);
            max = max.max(part.a.max(part.b) + part.radius);
        }
        Figure { id, position, heading, height: self.height, parts, bounds: (min, max) }
    }

    fn body(&self, position: Vec3, heading: Vec3, phase: f32) -> Vec<Part> {
        let h = self.height;
        let side = heading.cross(Vec3::Y);
        // The hip sinks when the legs are apart.
        let sink = 0.016 * h * (1.0 - (2.0 * phase).cos());
        let at = |forward: f32, up: f32, right: f32| position + heading * forward * h + Vec3::Y * (up * h - sink) + side * right * h;
        let (skin, hair, coat, trousers) = (Vec3::from(self.skin), Vec3::from(self.hair), Vec3::from(self.coat), Vec3::from(self.trousers));
        let mut parts = Vec::with_capacity(20);
        let mut add = |a: Vec3, b: Vec3, radius: f32, albedo: Vec3| parts.push(Part { a, b, radius: radius * h, albedo });
        let lean = 0.012;
        add(at(lean, 0.60, 0.0), at(lean * 1.5, 0.735, 0.0), 0.082, coat);
        add(at(lean * 1.6, 0.775, -0.062), at(lean * 1.6, 0.775, 0.062), 0.055, coat);
        add(at(0.0, 0.52, -0.032), at(0.0, 0.52, 0.032), 0.078, coat * 0.94);
        add(at(lean * 1.6, 0.80, 0.0), at(lean * 2.0, 0.86, 0.0), 0.033, skin * 0.9);
        add(at(lean * 2.2, 0.905, 0.0), at(lean * 2.4, 0.935, 0.0), 0.054, skin);
        add(at(lean * 1.2, 0.925, 0.0), at(lean * 1.6, 0.948, 0.0), 0.057, hair);
        for (sign, swing) in [(1.0f32, phase), (-1.0, phase + PI)] {
            let leg = swing.sin() * 0.46;
            // The knee bends while the leg swings forward.
            let bend = 0.12 + 0.75 * swing.cos().max(0.0).powi(2);
            let hip = at(0.0, 0.50, sign * 0.048);
            let reach = |from: Vec3, angle: f32, length: f32| from + (heading * angle.sin() - Vec3::Y * angle.cos()) * length * h;
            let knee = reach(hip, leg + 0.06, 0.235);
            let ankle = reach(knee, leg + 0.06 - bend, 0.225);
            let ankle = ankle.max(Vec3::new(f32::NEG_INFINITY, GROUND_Y + 0.04 * h, f32::NEG_INFINITY));
            add(hip, knee, 0.050, trousers);
            add(knee, ankle, 0.036, trousers);
            let toe = (ankle + heading * 0.085 * h - Vec3::Y * 0.012 * h).max(Vec3::new(
                f32::NEG_INFINITY,
                GROUND_Y + 0.024 * h,
                f32::NEG_INFINITY,
            ));
            add(ankle - Vec3::Y * 0.012 * h, toe, 0.024, Vec3::new(0.05, 0.03, 0.02));
            let arm = -swing.sin() * 0.40;
            let shoulder = at(lean * 1.6, 0.775, sign * 0.112);
            let elbow = reach(shoulder, arm, 0.165);
            let wrist = reach(elbow, arm + 0.38, 0.135);
            add(shoulder, elbow, 0.031, coat * 0.97);
            add(elbow, wrist, 0.026, coat * 0.97);
            add(wrist, reach(wrist, arm + 0.4, 0.03), 0.024, skin);
        }
        parts
    }
}

/// Where a ray met a body.
pub(super) struct BodyHit {
    pub(super) t: f32,
    pub(super) normal: Vec3,
    pub(super) albedo: Vec3,
}

impl Figure {
    /// Height of the body's axis above the ground at its middle, and a radius that holds every limb around the axis.
    fn girth(&self) -> f32 {
        let reach = |v: Vec3| (v.x - self.position.x).hypot(v.z - self.position.z);
        reach(self.bounds.0).max(reach(self.bounds.1))
    }

    /// Whether a ray meets the body's bounds grown by `margin`.
    pub(super) fn near(&self, ray: &Ray, margin: f32) -> bool {
        let inverse = ray.direction.recip();
        let (t0, t1) = ((self.bounds.0 - margin - ray.origin) * inverse, (self.bounds.1 + margin - ray.origin) * inverse);
        let far = t0.max(t1).min_element();
        far >= 0.0 && t0.min(t1).max_element() <= far
    }

    /// Whether a point is near enough to lose ambient light to the body.
    pub(super) fn darkens(&self, p: Vec3, margin: f32) -> bool {
        (p - self.position).length() < CONTACT_REACH + margin
    }

    /// Nearest point of the body along a ray, closer than `limit`.
    pub(super) fn hit(&self, ray: &Ray, limit: f32) -> Option<BodyHit> {
        if !self.near(ray, 0.0) {
            return None;
        }
        let mut best: Option<(f32, &Part)> = None;
        for part in &self.parts {
            if let Some(t) = capsule_distance(ray, part.a, part.b, part.radius)
                && t < best.map_or(limit, |(t, _)| t)
            {
                best = Some((t, part));
            }
        }
        best.map(|(t, part)| BodyHit { t, normal: capsule_normal(ray.at(t), part.a, part.b, part.radius), albedo: part.albedo })
    }

    /// Whether the body stands in a ray's way.
    pub(super) fn blocks(&self, ray: &Ray) -> bool {
        self.near(ray, 0.0) && self.parts.iter().any(|part| capsule_distance(ray, part.a, part.b, part.radius).is_some())
    }

    /// Spheres that hold the body.
    pub(super) fn body_spheres(&self) -> Vec<(Vec3, f32)> {
        let girth = self.girth();
        let count = 4;
        let top = self.bounds.1.y - GROUND_Y;
        let radius = girth.hypot(top / count as f32 * 0.5);
        (0..count).map(|i| (self.position + Vec3::Y * top * (i as f32 + 0.5) / count as f32, radius)).collect()
    }

    /// Spheres that hold the body's shadow down to the ground, and the ground that it darkens by standing there.
    pub(super) fn shadow_spheres(&self, sun: Vec3) -> Vec<(Vec3, f32)> {
        let mut spheres = vec![(self.position, CONTACT_REACH)];
        for (centre, radius) in self.body_spheres() {
            let length = (centre.y + radius - GROUND_Y) / sun.y;
            let steps = (length / (radius * 0.8)).ceil().max(1.0) as u32;
            spheres.extend((0..=steps).map(|i| (centre - sun * (length * i as f32 / steps as f32), radius * 1.1)));
        }
        spheres
    }

    /// Share of the ambient light that the body leaves a surface: a sphere at the feet and one at the trunk.
    pub(super) fn openness(&self, p: Vec3, normal: Vec3) -> f32 {
        if !self.darkens(p, 0.0) {
            return 1.0;
        }
        let mut open = 1.0;
        let fade = 1.0 - ((p - self.position).length() / CONTACT_REACH).min(1.0);
        for (up, radius, weight) in [(0.14, 0.24, 0.9), (0.85, 0.32, 0.9)] {
            let to = self.position + Vec3::Y * up - p;
            let distance = to.length().max(1e-3);
            let covered = normal.dot(to / distance).max(0.0) * (radius / distance.max(radius)).powi(2);
            open *= 1.0 - weight * covered * (fade * 1.6).min(1.0);
        }
        open
    }
}

/// How far a body's presence darkens the ambient light, metres.
const CONTACT_REACH: f32 = 1.3;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn walkers_come_round_again_and_keep_the_middle_free() {
        for walker in &WALKERS {
            let lap = walker.track.length() / f64::from(walker.speed.abs());
            for i in 0..200 {
                let time = lap * f64::from(i) / 200.0;
                let (here, later) = (walker.figure(0, time), walker.figure(0, time + lap));
                assert!((here.position - later.position).length() < 1e-3);
                assert!(Vec2::new(here.position.x, here.position.z).length() > 6.0, "{} comes too close", here.position);
                assert!(here.bounds.0.y >= GROUND_Y - 0.01 && here.bounds.0.y < GROUND_Y + 0.08, "feet at {}", here.bounds.0.y - GROUND_Y);
                let next = walker.figure(0, time + 0.01);
                let speed = (next.position - here.position).length() / 0.01;
                assert!((speed - walker.speed.abs()).abs() < 0.02, "{speed}");
                assert!((next.position - here.position).dot(here.heading) > 0.0, "walks forwards");
            }
        }
    }

    #[test]
    fn spheres_hold_the_body() {
        for figure in figures(5, 3.7) {
            for part in &figure.parts {
                for end in [part.a, part.b] {
                    let held = figure.body_spheres().iter().any(|(c, r)| (end - *c).length() <= *r + 1e-3);
                    assert!(held, "{end} of {}", figure.position);
                }
            }
        }
    }
}
