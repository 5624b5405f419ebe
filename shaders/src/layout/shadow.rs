//! Mirrors of what shadows need.

use bytemuck::{Pod, Zeroable};

/// Texels on a side of a shadow map.
pub const SHADOW_MAP_SIZE: u32 = 1024;
/// Most shadow maps, of objects and place together.
pub const MOST_SHADOW_MAPS: usize = 8;
/// Cells on a side of a shadow map: as many as a word has bits.
pub const CELLS: usize = 32;

/// `ShadowMap`: what casts shadows, as one light sees it.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct ShadowMap {
    /// Columns.
    pub from_world: [[f32; 4]; 4],
    /// Metres.
    pub half_width_m: f32,
    /// Metres.
    pub range_m: f32,
    /// Metres.
    pub texel_m: f32,
    /// Layer of the maps' texture; negative for none.
    pub layer: i32,
}

impl ShadowMap {
    /// No shadows.
    pub const NONE: Self = Self { from_world: [[0.0; 4]; 4], half_width_m: 1.0, range_m: 1.0, texel_m: 1.0, layer: -1 };
}

/// `CasterCells`: where in a shadow map a caster can hide the light. From elsewhere nothing has to be looked for.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct CasterCells {
    /// A word for every row of cells, from the top of the map; a bit for every column, the lowest on the left.
    pub rows: [[u32; 4]; CELLS / 4],
    /// Along the light: up to this depth, metres as those of the map, the cells hold.
    pub clear_to_m: f32,
    /// Unused.
    pub padding: [f32; 3],
}

impl CasterCells {
    /// Marks a cell.
    pub fn mark(&mut self, row: usize, column: usize) {
        if let Some(word) = self.rows.as_flattened_mut().get_mut(row) {
            *word |= 1 << (column % CELLS);
        }
    }

    /// True where a cell is marked.
    #[must_use]
    pub fn is_marked(&self, row: usize, column: usize) -> bool {
        self.rows.as_flattened().get(row).is_some_and(|word| word >> (column % CELLS) & 1 == 1)
    }
}

/// `Caster`: one light's view of the objects.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub struct Caster {
    /// Columns.
    pub clip_from_world: [[f32; 4]; 4],
}
