//! The static place: a square with its buildings, fountain, trees, lamps and benches.

use glam::Vec3;

use super::bvh::Bvh;
use super::facade::Facade;
use super::geometry::{Ray, Shape, pyramid, roof};
use super::noise::unit3;

/// Height of the ground under the camera at the origin, metres.
pub(super) const GROUND_Y: f32 = -1.6;

/// What a primitive is made of.
#[derive(Debug, Clone, Copy)]
pub(super) enum Material {
    /// The ground.
    Paving,
    /// One colour with a little weathering.
    Plain(Vec3),
    /// A wall with windows; other faces of the same box are plain.
    Facade(Facade),
    /// Roof tiles.
    Tiles(Vec3),
    /// A clump of leaves in a crown.
    Foliage { colour: Vec3, crown: Vec3, radius: f32 },
    /// Still water with ripples.
    Water,
    /// A clock on the faces of a tower: its wall and the height of the dial's centre.
    Clock { wall: Vec3, dial_y: f32 },
}

/// Everything that stands still.
pub(super) struct Place {
    pub(super) shapes: Vec<Shape>,
    pub(super) materials: Vec<Material>,
    pub(super) names: Vec<&'static str>,
    bvh: Bvh,
}

/// What a ray met.
#[derive(Clone, Copy)]
pub(super) struct Contact {
    pub(super) t: f32,
    pub(super) normal: Vec3,
    /// Index of the primitive; [`Place::GROUND`] for the ground.
    pub(super) primitive: u32,
}

impl Place {
    pub(super) const GROUND: u32 = u32::MAX;

    pub(super) fn new(seed: u32) -> Self {
        let mut build = Builder { shapes: Vec::new(), materials: Vec::new(), names: Vec::new() };
        town(&mut build);
        skyline(&mut build, seed);
        hills(&mut build, seed);
        furniture(&mut build);
        for (at, size) in
            [(Vec3::new(10.2, GROUND_Y, -12.0), 1.0), (Vec3::new(-11.5, GROUND_Y, -7.5), 0.9), (Vec3::new(9.0, GROUND_Y, 11.5), 1.1)]
        {
            tree(&mut build, at, size, seed);
        }
        let bvh = Bvh::new(&build.shapes);
        Self { shapes: build.shapes, materials: build.materials, names: build.names, bvh }
    }

    /// Nearest surface along a ray.
    pub(super) fn trace(&self, ray: &Ray) -> Option<Contact> {
        let ground = if ray.direction.y < -1e-5 { (GROUND_Y - ray.origin.y) / ray.direction.y } else { f32::INFINITY };
        let ground = if ground > 1e-3 { ground } else { f32::INFINITY };
        match self.bvh.nearest(&self.shapes, ray, ground) {
            Some(((t, normal), primitive)) => Some(Contact { t, normal, primitive }),
            None if ground.is_finite() => Some(Contact { t: ground, normal: Vec3::Y, primitive: Self::GROUND }),
            None => None,
        }
    }

    /// Whether something solid stands between a surface point and a light at infinity.
    pub(super) fn shadowed(&self, p: Vec3, normal: Vec3, towards: Vec3) -> bool {
        let ray = Ray { origin: p + normal * 2e-3, direction: towards };
        self.bvh.occluded(&self.shapes, &ray, f32::INFINITY)
    }

    pub(super) fn material(&self, primitive: u32) -> Material {
        self.materials.get(primitive as usize).copied().unwrap_or(Material::Paving)
    }
}

/// A house's roof; flat where it does not rise.
#[derive(Clone, Copy)]
struct Roof {
    rise: f32,
    hip: f32,
    tiles: Vec3,
}

struct Builder {
    shapes: Vec<Shape>,
    materials: Vec<Material>,
    names: Vec<&'static str>,
}

impl Builder {
    fn add(&mut self, name: &'static str, material: Material, shape: Shape) {
        self.shapes.push(shape);
        self.materials.push(material);
        self.names.push(name);
    }

    /// A box from heights above the ground.
    fn block(&mut self, name: &'static str, material: Material, x: [f32; 2], y: [f32; 2], z: [f32; 2]) {
        let (min, max) = (Vec3::new(x[0], GROUND_Y + y[0], z[0]), Vec3::new(x[1], GROUND_Y + y[1], z[1]));
        self.add(name, material, Shape::Box { min, max });
    }

    /// A house with plinth, string course, cornice and roof.
    fn house(&mut self, facade: Facade, x: [f32; 2], z: [f32; 2], height: f32, top: Roof) {
        let grown = |r: [f32; 2], by: f32| [r[0] - by, r[1] + by];
        let trim = Material::Plain(facade.trim);
        self.block("building", Material::Facade(facade), x, [0.0, height], z);
        self.block("plinth", Material::Plain(facade.trim * 0.72), grown(x, 0.09), [0.0, 0.55], grown(z, 0.09));
        let course = facade.ground_floor;
        self.block("string course", trim, grown(x, 0.12), [course - 0.18, course + 0.06], grown(z, 0.12));
        self.block("cornice", trim, grown(x, 0.22), [height - 0.40, height - 0.18], grown(z, 0.22));
        self.block("cornice", trim, grown(x, 0.45), [height - 0.18, height + 0.08], grown(z, 0.45));
        if top.rise > 0.0 {
            let (x, z) = (grown(x, 0.5), grown(z, 0.5));
            let eaves = GROUND_Y + height + 0.08;
            self.add(
                "roof",
                Material::Tiles(top.tiles),
                roof(Vec3::new(x[0], eaves, z[0]), Vec3::new(x[1], eaves, z[1]), top.rise, top.hip),
            );
        } else {
            let edge = Material::Plain(facade.wall * 0.9);
            self.block("parapet", edge, [x[0], x[1]], [height + 0.08, height + 0.85], [z[0], z[0] + 0.3]);
            self.block("parapet", edge, [x[0], x[1]], [height + 0.08, height + 0.85], [z[1] - 0.3, z[1]]);
            self.block("parapet", edge, [x[0], x[0] + 0.3], [height + 0.08, height + 0.85], z);
            self.block("parapet", edge, [x[1] - 0.3, x[1]], [height + 0.08, height + 0.85], z);
        }
    }
}

const STONE: Vec3 = Vec3::new(0.62, 0.57, 0.49);
const TERRACOTTA: Vec3 = Vec3::new(0.46, 0.17, 0.09);
const SLATE: Vec3 = Vec3::new(0.15, 0.16, 0.18);

fn town(b: &mut Builder) {
    let base = Facade::default();
    let hall =
        Facade { wall: Vec3::new(0.66, 0.55, 0.38), ground_floor: 4.6, floor: 4.0, bay: 2.5, window: [1.15, 2.3], arched: true, ..base };
    let salmon = Facade { wall: Vec3::new(0.60, 0.30, 0.20), shutters: Some(Vec3::new(0.10, 0.21, 0.17)), shop: true, ..base };
    let yellow = Facade { wall: Vec3::new(0.60, 0.42, 0.16), shutters: Some(Vec3::new(0.14, 0.22, 0.30)), shop: true, bay: 2.7, ..base };
    let grey = Facade { wall: Vec3::new(0.42, 0.44, 0.46), bay: 2.4, window: [1.3, 2.0], floor: 3.3, ..base };
    let brick = Facade { wall: Vec3::new(0.36, 0.15, 0.10), brick: true, window: [1.2, 1.8], ..base };
    let rose = Facade { wall: Vec3::new(0.63, 0.40, 0.33), shutters: Some(Vec3::new(0.24, 0.16, 0.10)), ..base };
    let white = Facade { wall: Vec3::new(0.64, 0.61, 0.54), shutters: Some(Vec3::new(0.12, 0.20, 0.33)), shop: true, ..base };

    b.house(hall, [-13.0, 5.0], [-37.0, -27.0], 12.8, Roof { rise: 3.2, hip: 1.0, tiles: SLATE });
    arcade(b, -13.0, 5.0, -27.0);
    clock_tower(b);
    b.house(salmon, [13.5, 25.0], [-35.0, -20.0], 12.0, Roof { rise: 3.4, hip: 1.0, tiles: TERRACOTTA });
    b.house(yellow, [17.5, 28.0], [-15.5, 1.0], 10.2, Roof { rise: 0.0, hip: 0.0, tiles: TERRACOTTA });
    b.house(white, [18.5, 30.0], [1.0, 14.0], 12.6, Roof { rise: 3.0, hip: 0.0, tiles: TERRACOTTA * 0.9 });
    b.house(grey, [6.0, 20.0], [21.0, 33.0], 13.4, Roof { rise: 0.0, hip: 0.0, tiles: SLATE });
    b.house(brick, [-13.0, 1.0], [22.5, 33.0], 9.6, Roof { rise: 4.2, hip: 0.0, tiles: SLATE });
    b.house(rose, [-31.0, -19.5], [-27.0, -11.0], 9.0, Roof { rise: 3.0, hip: 1.0, tiles: TERRACOTTA });
    b.house(white, [-33.0, -22.0], [11.0, 27.0], 8.8, Roof { rise: 2.8, hip: 1.0, tiles: TERRACOTTA });
    awnings(b);
}

/// Columns, beam and terrace before the town hall, and the steps up to it.
fn arcade(b: &mut Builder, left: f32, right: f32, wall_z: f32) {
    let front = wall_z + 3.0;
    for step in 0..3u32 {
        let (top, out) = (0.45 - 0.15 * step as f32, 0.4 * (step + 1) as f32);
        b.block("step", Material::Plain(STONE * 0.85), [left, right], [0.0, top], [wall_z, front + out]);
    }
    b.block("terrace", Material::Plain(STONE), [left, right], [4.2, 4.75], [wall_z, front + 0.1]);
    b.block("terrace edge", Material::Plain(STONE * 1.08), [left - 0.12, right + 0.12], [4.75, 4.9], [wall_z, front + 0.25]);
    let columns = 9;
    for i in 0..columns {
        let x = left + 0.5 + (right - left - 1.0) * i as f32 / (columns - 1) as f32;
        let at = |y: f32| Vec3::new(x, GROUND_Y + y, front - 0.35);
        b.add("column", Material::Plain(STONE * 1.05), Shape::Cylinder { base: at(0.7), radius: 0.25, height: 3.2 });
        let foot = [x - 0.36, x + 0.36];
        let depth = [front - 0.71, front + 0.01];
        b.block("column base", Material::Plain(STONE), foot, [0.45, 0.7], depth);
        b.block("capital", Material::Plain(STONE * 1.08), foot, [3.9, 4.2], depth);
    }
    // Balustrade of the terrace.
    b.block("handrail", Material::Plain(STONE * 1.08), [left, right], [5.65, 5.8], [front - 0.15, front + 0.1]);
    for i in 0..48u32 {
        let x = left + 0.2 + (right - left - 0.4) * i as f32 / 47.0;
        b.add(
            "baluster",
            Material::Plain(STONE),
            Shape::Cylinder { base: Vec3::new(x, GROUND_Y + 4.9, front - 0.03), radius: 0.07, height: 0.75 },
        );
    }
}

fn clock_tower(b: &mut Builder) {
    let wall = Vec3::new(0.62, 0.53, 0.39);
    let trim = Material::Plain(STONE * 1.05);
    b.block("tower", Material::Clock { wall, dial_y: GROUND_Y + 18.2 }, [5.0, 9.4], [0.0, 20.5], [-32.4, -28.0]);
    for y in [5.0, 15.6] {
        b.block("string course", trim, [4.85, 9.55], [y, y + 0.3], [-32.55, -27.85]);
    }
    b.block("cornice", trim, [4.7, 9.7], [20.5, 21.0], [-32.7, -27.7]);
    b.block("belfry", Material::Plain(Vec3::splat(0.05)), [5.9, 8.5], [21.0, 23.4], [-31.5, -28.9]);
    for (x, z) in [(5.5, -31.9), (8.9, -31.9), (5.5, -28.5), (8.9, -28.5)] {
        b.block("pier", trim, [x - 0.4, x + 0.4], [21.0, 23.4], [z - 0.4, z + 0.4]);
    }
    b.block("cornice", trim, [4.9, 9.5], [23.4, 23.8], [-32.5, -27.9]);
    let eaves = GROUND_Y + 23.8;
    b.add(
        "spire",
        Material::Tiles(Vec3::new(0.16, 0.27, 0.24)),
        roof(Vec3::new(4.9, eaves, -32.5), Vec3::new(9.5, eaves, -27.9), 6.5, 1.0),
    );
}

/// Cloth over the shops on the right, and parasols before them.
fn awnings(b: &mut Builder) {
    let (red, cream) = (Vec3::new(0.55, 0.08, 0.06), Vec3::new(0.74, 0.68, 0.55));
    for (i, z) in [-13.2f32, -9.2, -5.2, -1.2].into_iter().enumerate() {
        let cloth = Material::Plain(if i % 2 == 0 { red } else { cream });
        b.block("awning", cloth, [15.9, 17.5], [2.75, 2.83], [z - 1.5, z + 1.5]);
        b.block("awning", cloth, [15.86, 15.92], [2.45, 2.83], [z - 1.5, z + 1.5]);
    }
    for (i, (x, z)) in [(13.2f32, -6.4f32), (13.6, -2.2), (13.0, 2.2)].into_iter().enumerate() {
        let at = Vec3::new(x, GROUND_Y, z);
        let cloth = Material::Plain(if i == 1 { red } else { cream });
        b.add("parasol", cloth, pyramid(at + Vec3::Y * 2.2, 1.5, 0.65, 8));
        b.add("pole", Material::Plain(Vec3::splat(0.35)), Shape::Cylinder { base: at, radius: 0.03, height: 2.3 });
        let wood = Material::Plain(Vec3::new(0.30, 0.17, 0.08));
        b.add("table", wood, Shape::Cylinder { base: at + Vec3::Y * 0.70, radius: 0.5, height: 0.05 });
        for (dx, dz) in [(0.85f32, 0.2f32), (-0.8, 0.35), (0.05, -0.85)] {
            let seat = at + Vec3::new(dx, 0.0, dz);
            b.add("stool", wood, Shape::Cylinder { base: seat, radius: 0.2, height: 0.45 });
        }
    }
}

/// Roofs in the distance.
fn skyline(b: &mut Builder, seed: u32) {
    for i in 0..34i32 {
        let random = |k| unit3(i, k, seed as i32);
        let angle = (i as f32 + 0.6 * random(0)) / 34.0 * std::f32::consts::TAU;
        let distance = 62.0 + 40.0 * random(1);
        let centre = Vec3::new(angle.sin() * distance, 0.0, -angle.cos() * distance);
        let (half_x, half_z, height) = (5.0 + 4.5 * random(2), 5.0 + 4.5 * random(3), 6.5 + 7.5 * random(4));
        let wall = Vec3::new(0.62, 0.52, 0.40).lerp(Vec3::new(0.60, 0.42, 0.33), random(5));
        let facade = Facade { wall, ..Facade::default() };
        let (x, z) = ([centre.x - half_x, centre.x + half_x], [centre.z - half_z, centre.z + half_z]);
        b.block("distant building", Material::Facade(facade), x, [0.0, height], z);
        let eaves = GROUND_Y + height;
        let shape = roof(Vec3::new(x[0] - 0.4, eaves, z[0] - 0.4), Vec3::new(x[1] + 0.4, eaves, z[1] + 0.4), 2.6, random(6).round());
        b.add("distant roof", Material::Tiles(TERRACOTTA.lerp(SLATE, 0.6 * random(7))), shape);
    }
}

/// Round wooded hills beyond the town.
fn hills(b: &mut Builder, seed: u32) {
    for i in 0..14i32 {
        let random = |k| unit3(i, k + 20, seed as i32);
        let (sin, cos) = ((i as f32 + 0.7 * random(0)) / 14.0 * std::f32::consts::TAU).sin_cos();
        let (distance, radius, rise) = (420.0 + 160.0 * random(1), 260.0 + 120.0 * random(2), 16.0 + 26.0 * random(3));
        let centre = Vec3::new(sin * distance, GROUND_Y + rise - radius, -cos * distance);
        let wood = Vec3::new(0.10, 0.13, 0.05).lerp(Vec3::new(0.17, 0.16, 0.08), random(4));
        b.add("hill", Material::Plain(wood), Shape::Sphere { centre, radius });
    }
}

fn furniture(b: &mut Builder) {
    fountain(b, Vec3::new(-3.6, GROUND_Y, -14.2));
    for (x, z) in [(5.6, -17.0), (-8.6, -18.5), (-13.0, 4.5), (11.5, 6.8), (-4.5, 15.0)] {
        lamp(b, Vec3::new(x, GROUND_Y, z));
    }
    for (x, z) in [(4.4f32, -13.2f32), (-8.4, -11.2)] {
        bench(b, x, z);
    }
    for x in [-10.8f32, -8.6, 0.8, 2.9] {
        planter(b, Vec3::new(x, GROUND_Y, -21.6));
    }
    for (x, z) in [(7.4f32, -16.6f32), (14.9, -9.6), (14.9, 0.2), (-16.0, -6.0)] {
        planter(b, Vec3::new(x, GROUND_Y, z));
    }
    for i in 0..8u32 {
        let at = Vec3::new(11.4, GROUND_Y, -24.0 + 2.0 * i as f32);
        if i != 6 {
            b.add("bollard", Material::Plain(Vec3::splat(0.10)), Shape::Cylinder { base: at, radius: 0.09, height: 0.8 });
            b.add("bollard", Material::Plain(Vec3::splat(0.13)), Shape::Sphere { centre: at + Vec3::Y * 0.85, radius: 0.12 });
        }
    }
}

/// A stone trough with flowers.
fn planter(b: &mut Builder, at: Vec3) {
    let around = |half: f32, c: f32| [c - half, c + half];
    b.block("planter", Material::Plain(STONE * 0.92), around(0.62, at.x), [0.0, 0.52], around(0.38, at.z));
    b.block("planter", Material::Plain(STONE * 1.05), around(0.67, at.x), [0.46, 0.56], around(0.43, at.z));
    let crown = at + Vec3::Y * 0.45;
    let key = (at.x * 8.0 + at.z * 64.0) as i32;
    for i in 0..46i32 {
        let random = |k| unit3(i, k, key);
        let centre = at + Vec3::new(1.1 * random(0) - 0.55, 0.55 + 0.22 * random(1), 0.62 * random(2) - 0.31);
        let leaf = Vec3::new(0.09, 0.16, 0.04);
        let bloom = [Vec3::new(0.55, 0.05, 0.08), Vec3::new(0.62, 0.30, 0.05), Vec3::new(0.60, 0.52, 0.55)][(key & 0xFF) as usize % 3];
        let colour = if random(3) < 0.42 { bloom } else { leaf };
        b.add("flowers", Material::Foliage { colour, crown, radius: 0.4 }, Shape::Sphere { centre, radius: 0.06 + 0.05 * random(4) });
    }
}

fn fountain(b: &mut Builder, at: Vec3) {
    let stone = Material::Plain(STONE * 1.02);
    let up = |y: f32| at + Vec3::Y * y;
    let tube = |y: f32, radius, height| Shape::Cylinder { base: up(y), radius, height };
    b.add("fountain step", Material::Plain(STONE * 0.9), tube(0.0, 3.1, 0.16));
    b.add("fountain basin", stone, tube(0.16, 2.5, 0.46));
    // The rim is a ring of short pieces, so that the water lies inside it.
    for i in 0..40u32 {
        let corner = |i: u32| {
            let (sin, cos) = (std::f32::consts::TAU * i as f32 / 40.0).sin_cos();
            up(0.68) + Vec3::new(2.42 * cos, 0.0, 2.42 * sin)
        };
        b.add("fountain rim", Material::Plain(STONE * 1.1), Shape::Capsule { a: corner(i), b: corner(i + 1), radius: 0.13 });
    }
    b.add("water", Material::Water, tube(0.62, 2.36, 0.02));
    b.add("fountain shaft", stone, tube(0.62, 0.36, 0.18));
    b.add("fountain shaft", stone, tube(0.8, 0.22, 1.1));
    b.add("fountain bowl", stone, tube(1.72, 0.55, 0.10));
    b.add("fountain bowl", stone, tube(1.82, 1.05, 0.16));
    b.add("water", Material::Water, tube(1.98, 0.95, 0.01));
    b.add("fountain shaft", stone, tube(1.98, 0.13, 0.62));
    b.add("fountain ball", Material::Plain(Vec3::new(0.50, 0.34, 0.12)), Shape::Sphere { centre: up(2.88), radius: 0.32 });
}

fn lamp(b: &mut Builder, at: Vec3) {
    let iron = Material::Plain(Vec3::new(0.035, 0.045, 0.045));
    let tube = |y: f32, radius, height| Shape::Cylinder { base: at + Vec3::Y * y, radius, height };
    b.add("lamp foot", iron, tube(0.0, 0.17, 0.5));
    b.add("lamp post", iron, tube(0.5, 0.06, 3.2));
    b.add("lamp collar", iron, tube(3.7, 0.13, 0.1));
    b.add("lamp globe", Material::Plain(Vec3::splat(0.78)), Shape::Sphere { centre: at + Vec3::Y * 4.02, radius: 0.25 });
    b.add("lamp cap", iron, tube(4.25, 0.1, 0.08));
}

fn bench(b: &mut Builder, x: f32, z: f32) {
    let wood = Material::Plain(Vec3::new(0.33, 0.17, 0.07));
    let iron = Material::Plain(Vec3::splat(0.05));
    for i in 0..3u32 {
        let z = z + 0.17 * i as f32;
        b.block("bench slat", wood, [x - 0.9, x + 0.9], [0.43, 0.47], [z, z + 0.13]);
    }
    for i in 0..2u32 {
        let y = 0.60 + 0.17 * i as f32;
        b.block("bench slat", wood, [x - 0.9, x + 0.9], [y, y + 0.13], [z - 0.06, z - 0.02]);
    }
    for side in [-0.75, 0.75] {
        b.block("bench leg", iron, [x + side - 0.03, x + side + 0.03], [0.0, 0.43], [z, z + 0.5]);
        b.block("bench leg", iron, [x + side - 0.03, x + side + 0.03], [0.0, 0.9], [z - 0.1, z - 0.06]);
    }
}

/// Leaf clumps of a crown.
const CLUMPS: i32 = 300;

/// A trunk, a kerb and a crown of leaf clumps.
fn tree(b: &mut Builder, at: Vec3, size: f32, seed: u32) {
    let bark = Material::Plain(Vec3::new(0.16, 0.11, 0.07));
    b.block("tree kerb", Material::Plain(STONE * 0.8), [at.x - 0.95, at.x + 0.95], [0.0, 0.16], [at.z - 0.95, at.z + 0.95]);
    b.block("tree soil", Material::Plain(Vec3::new(0.09, 0.065, 0.045)), [at.x - 0.8, at.x + 0.8], [0.0, 0.18], [at.z - 0.8, at.z + 0.8]);
    let crown = at + Vec3::Y * 4.5 * size;
    b.add("trunk", bark, Shape::Capsule { a: at, b: at + Vec3::Y * 3.2 * size, radius: 0.16 * size });
    let key = (at.x * 8.0) as i32;
    for i in 0..3 {
        let (sin, cos) = (std::f32::consts::TAU * (i as f32 + unit3(key, i, 3)) / 3.0).sin_cos();
        let tip = crown + Vec3::new(0.9 * cos, 0.2, 0.9 * sin) * size;
        b.add("branch", bark, Shape::Capsule { a: at + Vec3::Y * 2.5 * size, b: tip, radius: 0.07 * size });
    }
    let radius = 1.75 * size;
    for i in 0..CLUMPS {
        let random = |k| unit3(i, k + key, seed as i32);
        // Evenly spread over the sphere (golden angle), at random depths near the surface.
        let y = 1.0 - 2.0 * (i as f32 + 0.5) / CLUMPS as f32;
        let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
        let level = (1.0 - y * y).sqrt();
        let depth = radius * (0.58 + 0.50 * random(0));
        let centre = crown + Vec3::new(level * cos * 1.08, y * 0.86, level * sin * 1.08) * depth;
        let colour = Vec3::new(0.10, 0.17, 0.035).lerp(Vec3::new(0.19, 0.24, 0.05), random(1));
        let clump = Shape::Sphere { centre, radius: size * (0.13 + 0.17 * random(2)) };
        b.add("leaves", Material::Foliage { colour, crown, radius }, clump);
    }
}
