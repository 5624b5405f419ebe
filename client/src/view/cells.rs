//! Where in a shadow map something can hide the light: cells about the casters, which spare all other points the search for one.

use bytemuck::Zeroable as _;
use glam::{Vec2, Vec3};
use mr360_shaders::layout::{CELLS, CasterCells};

use super::shadows::Frustum;
use crate::scene::mesh::Bounds;

/// Least radius of the shader's search, its bilinear taps, and rounding; texels.
const MARGIN_TEXELS: f32 = 4.0;

/// Marks every cell from which the shader's search may find one of these casters. Each is a box, or where it is said to be round the
/// ball within a cube. The search widens with depth: below the casters as far as the map is wide, the cells hold.
pub(super) fn cells(frustum: &Frustum, tan_radius: f32, casters: impl Iterator<Item = (Bounds, bool)>) -> CasterCells {
    let mut cells = CasterCells { clear_to_m: frustum.range_m + 2.0 * frustum.half_width_m, ..CasterCells::zeroed() };
    let margin_m = (tan_radius * cells.clear_to_m).max(0.0) + MARGIN_TEXELS * frustum.texel_m();
    // Cells from the upper left corner, as the shader counts them.
    let cells_per_m = 0.5 * CELLS as f32 / frustum.half_width_m;
    let axes = [frustum.shadow_from_world.row(0), frustum.shadow_from_world.row(1)].map(|row| row.truncate() * frustum.half_width_m);
    for (caster, round) in casters {
        let at = frustum.shadow_from_world.transform_point3(caster.center());
        let center = Vec2::new(0.5 + 0.5 * at.x, 0.5 - 0.5 * at.y) * CELLS as f32;
        let half = caster.half();
        if round {
            mark(&mut cells, center, Vec2::splat((half.max_element() + margin_m) * cells_per_m), true);
        } else {
            let across = |axis: Vec3| (axis.abs().dot(half) + margin_m) * cells_per_m;
            mark(&mut cells, center, Vec2::new(across(axes[0]), across(axes[1])), false);
        }
    }
    cells
}

/// Marks what a rectangle touches, or the disc within a square.
fn mark(cells: &mut CasterCells, center: Vec2, half: Vec2, disc: bool) {
    let last = CELLS as f32 - 1.0;
    let span = |middle: f32, half: f32| {
        let (first, end) = ((middle - half).floor(), (middle + half).floor());
        (end >= 0.0 && first <= last).then(|| first.clamp(0.0, last) as usize..=end.clamp(0.0, last) as usize)
    };
    for row in span(center.y, half.y).into_iter().flatten() {
        // Of the row's points the nearest to the middle.
        let down = center.y.clamp(row as f32, row as f32 + 1.0) - center.y;
        let across = if disc { (half.x * half.x - down * down).max(0.0).sqrt() } else { half.x };
        span(center.x, across).into_iter().flatten().for_each(|column| cells.mark(row, column));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::shadows::fit;

    /// Points of a map in steps of a quarter of a cell, each with its cell.
    fn points() -> impl Iterator<Item = (Vec2, (usize, usize))> {
        let side = 4 * CELLS;
        (0..side * side).map(move |i| {
            let (row, column) = (i / side, i % side);
            let at = Vec2::new(column as f32 + 0.5, row as f32 + 0.5) / 4.0;
            (at / CELLS as f32, (row / 4, column / 4))
        })
    }

    #[test]
    fn every_point_that_may_find_a_caster_lies_in_a_marked_cell_and_few_others_do() {
        let ball = Bounds { min: Vec3::new(-2.0, -1.6, -4.5), max: Vec3::new(-1.0, -0.6, -3.5) };
        let block = Bounds { min: Vec3::new(0.5, -1.6, -5.0), max: Vec3::new(0.8, -0.2, -3.0) };
        let casters = [(ball, true), (block, false)];
        for direction in [Vec3::Y, Vec3::new(0.6, 0.48, -0.64), Vec3::new(0.99, 0.1, 0.05).normalize()] {
            for tan_radius in [0.0, 0.01, 0.1] {
                let frustum = fit(direction, &[ball, block], 0.1);
                let cells = cells(&frustum, tan_radius, casters.into_iter());
                let search_m = (tan_radius * cells.clear_to_m).max(2.0 * frustum.texel_m()) + frustum.texel_m();
                let world_from_map = frustum.shadow_from_world.inverse();
                let (mut found, mut marked) = (0, 0);
                for (at, (row, column)) in points() {
                    let map = Vec3::new(2.0 * at.x - 1.0, 1.0 - 2.0 * at.y, 0.0);
                    let point = world_from_map.transform_point3(map);
                    // How far the ray along the light passes the ball, and a disc within the block.
                    let beside = |to: Vec3| (to - point).reject_from(direction).length();
                    let near = beside(ball.center()) < 0.5 + search_m || beside(block.center()) < 0.15 + search_m;
                    assert!(!near || cells.is_marked(row, column), "{direction} {tan_radius}: {row}, {column}");
                    found += usize::from(near);
                    marked += usize::from(cells.is_marked(row, column));
                }
                let all = points().count();
                // Boxes seen along the ground are wide.
                let few = marked < all * 3 / 5 || tan_radius > 0.05 || direction.y < 0.4;
                assert!(found > 0 && few, "{direction} {tan_radius}: {found} {marked} of {all}");
            }
        }
    }

    #[test]
    fn beside_the_map_nothing_is_marked_and_a_large_caster_marks_it_all() {
        let one = |center: Vec2, half: f32, disc: bool| {
            let mut cells = CasterCells::zeroed();
            mark(&mut cells, center, Vec2::splat(half), disc);
            cells.rows.as_flattened().iter().map(|row| row.count_ones()).sum::<u32>()
        };
        assert_eq!(one(Vec2::splat(-3.0), 2.5, false), 0);
        assert_eq!(one(Vec2::splat(16.0), 100.0, true), 1024);
        assert_eq!((one(Vec2::splat(4.5), 0.2, false), one(Vec2::splat(4.5), 0.2, true)), (1, 1));
        assert_eq!(one(Vec2::new(0.2, 31.9), 0.5, false), 1);
        // A disc leaves out a square's corners.
        assert!(one(Vec2::splat(16.0), 10.0, true) < one(Vec2::splat(16.0), 10.0, false) * 9 / 10);
    }
}
