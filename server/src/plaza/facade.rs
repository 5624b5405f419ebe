//! House fronts: bays of windows with recess, frame, sill and shutters.

use glam::{Vec2, Vec3};

use super::noise::{fbm2, unit3};
use super::surface::Surface;

/// Depth of the glass behind the wall, metres.
const RECESS: f32 = 0.20;

/// A wall's pattern. Lengths in metres, colours linear albedo.
#[derive(Debug, Clone, Copy)]
pub(super) struct Facade {
    pub(super) wall: Vec3,
    pub(super) trim: Vec3,
    pub(super) shutters: Option<Vec3>,
    /// Height of the ground floor and of each floor above it.
    pub(super) ground_floor: f32,
    pub(super) floor: f32,
    /// Width of a bay; stretched so that a whole number fits.
    pub(super) bay: f32,
    /// Width and height of a window.
    pub(super) window: [f32; 2],
    /// Round tops.
    pub(super) arched: bool,
    /// Shop fronts on the ground floor.
    pub(super) shop: bool,
    /// Courses of brick instead of plaster.
    pub(super) brick: bool,
}

impl Default for Facade {
    fn default() -> Self {
        Self {
            wall: Vec3::splat(0.5),
            trim: Vec3::new(0.66, 0.62, 0.54),
            shutters: None,
            ground_floor: 3.9,
            floor: 3.2,
            bay: 2.9,
            window: [1.05, 1.75],
            arched: false,
            shop: false,
            brick: false,
        }
    }
}

/// A point of a wall and how it is looked at, in the wall's frame: along, up, out.
pub(super) struct WallPoint {
    /// From the wall's lower left corner.
    pub(super) at: Vec2,
    /// Length and height of the wall.
    pub(super) size: Vec2,
    /// The ray's direction.
    pub(super) view: Vec3,
    /// The direction to the sun.
    pub(super) sun: Vec3,
    /// Tells walls apart.
    pub(super) wall_id: i32,
    /// Width of a pixel on the wall.
    pub(super) footprint: f32,
}

/// An opening's half width, sill and head within its floor, and the point relative to its foot.
struct Opening {
    half: f32,
    height: f32,
    arched: bool,
    /// The point from the middle of the sill.
    at: Vec2,
    /// Column and row, for variation.
    cell: [i32; 2],
    door: bool,
}

impl Opening {
    /// Signed distance-like measure: negative inside.
    fn outside(&self, p: Vec2) -> f32 {
        let straight = (p.x.abs() - self.half).max(-p.y);
        let spring = self.height - self.half;
        if self.arched && p.y > spring {
            return Vec2::new(p.x, p.y - spring).length() - self.half;
        }
        straight.max(p.y - self.height)
    }
}

impl Facade {
    /// The window or door nearest to a point, if the wall has one on that floor and bay.
    fn opening(&self, wall: &WallPoint) -> Option<Opening> {
        let bays = (wall.size.x / self.bay).floor().max(1.0);
        let bay = wall.size.x / bays;
        let column = (wall.at.x / bay).floor().clamp(0.0, bays - 1.0);
        let x = wall.at.x - (column + 0.5) * bay;
        let y = wall.at.y;
        let cell = |row: i32| [column as i32, row];
        if y < self.ground_floor {
            let door = column as i32 == (bays * 0.5) as i32 || (self.shop && unit3(column as i32, 5, wall.wall_id) < 0.3);
            let (half, sill, head) = match (door, self.shop) {
                (true, _) => (0.62f32.min(bay * 0.4), 0.05, 2.5),
                (false, true) => (bay * 0.40, 0.62, 2.9),
                (false, false) => (self.window[0] * 0.5, 1.0, 1.0 + self.window[1].min(self.ground_floor - 1.7)),
            };
            let arched = self.arched && !door;
            return Some(Opening { half, height: head - sill, arched, at: Vec2::new(x, y - sill), cell: cell(0), door });
        }
        let row = ((y - self.ground_floor) / self.floor).floor();
        let foot = self.ground_floor + row * self.floor;
        let sill = 0.85f32.min(self.floor - self.window[1] - 0.4);
        let fits = foot + sill + self.window[1] + 0.55 < wall.size.y;
        let at = Vec2::new(x, y - foot - sill);
        let (half, height) = (self.window[0] * 0.5, self.window[1]);
        fits.then_some(Opening { half, height, arched: self.arched, at, cell: cell(row as i32 + 1), door: false })
    }

    /// What the wall shows at a point. `normal` comes back in the wall's frame.
    pub(super) fn surface(&self, wall: &WallPoint) -> Surface {
        let Some(opening) = self.opening(wall) else { return self.plaster(wall) };
        let outside = opening.outside(opening.at);
        if outside < 0.0 {
            return self.recess(wall, &opening);
        }
        if let Some(colour) = self.shutters
            && opening.cell[1] > 0
            && (0.0..opening.height).contains(&opening.at.y)
            && (opening.half + 0.03..opening.half * 2.0 + 0.03).contains(&opening.at.x.abs())
        {
            // Slats every 7 cm, faded where they are finer than a pixel.
            let fade = (1.0 - wall.footprint / 0.07).clamp(0.0, 1.0);
            let slat = (opening.at.y / 0.07).fract();
            return Surface::matt(colour * (1.0 - 0.35 * fade * slat));
        }
        if outside < 0.16 && !(opening.door && opening.at.y < 0.0) {
            return Surface::matt(self.trim * if opening.at.y < 0.0 { 1.08 } else { 1.0 });
        }
        self.plaster(wall)
    }

    fn plaster(&self, wall: &WallPoint) -> Surface {
        let p = wall.at;
        let id = wall.wall_id;
        let patches = fbm2(p * 0.35, 4, 900 + id) - 0.47;
        let fine = (fbm2(p * 3.0, 3, 930 + id) - 0.44) * (1.0 - wall.footprint / 0.3).clamp(0.0, 1.0);
        // Rain marks run down, dirt splashes up from the street.
        let streaks = fbm2(Vec2::new(p.x * 2.5, p.y * 0.18), 3, 960 + id) - 0.44;
        let dirt = 0.16 * (-p.y / 0.9).exp() + 0.05 * (-(wall.size.y - p.y) / 1.5).exp();
        let mut albedo = self.wall * (1.0 + 0.28 * patches + 0.12 * fine + 0.14 * streaks - dirt);
        if self.brick {
            albedo *= brick(p, wall.footprint);
        } else if p.y < self.ground_floor - 0.2 && !self.shop {
            // Ashlar joints on the ground floor.
            let course = (p.y / 0.48).floor();
            let joint = groove(p.y / 0.48, 0.03 / 0.48, wall.footprint / 0.48).max(groove(
                p.x / 1.1 + 0.5 * course.rem_euclid(2.0),
                0.03 / 1.1,
                wall.footprint / 1.1,
            ));
            albedo *= 0.94 * (1.0 - 0.35 * joint);
        }
        Surface::matt(albedo.max(Vec3::splat(0.02)))
    }

    /// Follows the ray into an opening: it ends on the reveal, on a frame or on glass.
    fn recess(&self, wall: &WallPoint, opening: &Opening) -> Surface {
        let inward = (-wall.view.z).max(1e-3);
        let step = Vec2::new(wall.view.x, wall.view.y) / inward;
        let deep = opening.at + step * RECESS;
        let outside = opening.outside(deep);
        if outside > 0.0 {
            // Where the ray leaves the opening, by regula falsi.
            let entry = opening.outside(opening.at);
            let depth = RECESS * entry / (entry - outside);
            let at = opening.at + step * depth;
            let normal = if at.y <= 0.02 {
                Vec3::Y
            } else if at.y > opening.height - 0.02 {
                -Vec3::Y
            } else {
                Vec3::X * -at.x.signum()
            };
            let direct = sun_through(opening, wall.sun, at, depth);
            return Surface { albedo: self.wall * 0.95, normal, direct, ambient: 1.0 - 2.2 * depth, mirror: 0.0 };
        }
        let direct = sun_through(opening, wall.sun, deep, RECESS);
        let bar = 0.055f32;
        let transom = (opening.height * 0.68 - deep.y).abs() < bar * 0.7;
        let framed = outside > -0.075 || (deep.x.abs() < bar * 0.7 && opening.half < 0.9) || transom;
        let ambient = 0.62 + 0.2 * (-outside / opening.half).min(1.0);
        if framed || (opening.door && deep.y < 1.9) {
            let wood = Vec3::new(0.16, 0.09, 0.05);
            let colour = if opening.door && outside <= -0.075 { wood } else { self.trim * if opening.door { 0.5 } else { 1.1 } };
            return Surface { albedo: colour, normal: Vec3::Z, direct, ambient, mirror: 0.0 };
        }
        let [column, row] = opening.cell;
        let curtain = unit3(column, row, wall.wall_id + 77);
        let drawn = curtain > 0.55 && deep.x.abs() > opening.half * (1.3 - curtain);
        let goods = 0.06 + 0.10 * unit3((deep.x * 2.5).floor() as i32, (deep.y * 2.0).floor() as i32, column + wall.wall_id);
        let albedo = match (drawn, self.shop && row == 0) {
            (_, true) => Vec3::new(1.0, 0.75, 0.5) * goods,
            (true, false) => Vec3::new(0.30, 0.28, 0.24),
            (false, false) => Vec3::new(0.020, 0.024, 0.028),
        };
        let tilt = |k| (unit3(column * 2 + i32::from(deep.x > 0.0), row, wall.wall_id + k) - 0.5) * 0.035;
        let normal = Vec3::new(tilt(1), tilt(2), 1.0).normalize();
        Surface { albedo, normal, direct: direct * 0.8, ambient: ambient * 0.7, mirror: 1.0 }
    }
}

/// 1 where the sun reaches a point `depth` inside an opening past the reveal, else 0.
fn sun_through(opening: &Opening, sun: Vec3, at: Vec2, depth: f32) -> f32 {
    if sun.z <= 1e-3 {
        return 0.0;
    }
    f32::from(u8::from(opening.outside(at + Vec2::new(sun.x, sun.y) * (depth / sun.z)) < 0.0))
}

/// Coverage of lines at whole numbers, `width` wide, seen with a pixel `footprint` wide.
pub(super) fn groove(x: f32, width: f32, footprint: f32) -> f32 {
    let filter = footprint.max(1e-4);
    let distance = (x - x.round()).abs();
    let covered = ((width * 0.5 - distance) / filter + 0.5).clamp(0.0, 1.0);
    // Once the lines are finer than the filter, their mean remains.
    let blend = ((filter - 0.35) / 0.5).clamp(0.0, 1.0);
    covered.min(width / filter) * (1.0 - blend) + width * blend
}

fn brick(p: Vec2, footprint: f32) -> Vec3 {
    let (width, height) = (0.26, 0.08);
    let course = (p.y / height).floor();
    let along = p.x / width + 0.5 * course.rem_euclid(2.0);
    let mortar = groove(p.y / height, 0.14, footprint / height).max(groove(along, 0.05, footprint / width));
    let fade = (1.0 - footprint / width).clamp(0.0, 1.0);
    let tone = 1.0 + 0.5 * fade * (unit3(along.floor() as i32, course as i32, 5) - 0.5);
    Vec3::splat(tone).lerp(Vec3::new(1.15, 1.9, 2.3), mortar * 0.8)
}
