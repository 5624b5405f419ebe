//! Triangles and their bounds.

use glam::Vec3;
use mr360_shaders::layout::Vertex;

/// An axis-aligned box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Lowest corner.
    pub min: Vec3,
    /// Highest corner.
    pub max: Vec3,
}

impl Bounds {
    /// Holds nothing.
    pub const EMPTY: Self = Self { min: Vec3::INFINITY, max: Vec3::NEG_INFINITY };

    /// Grown to hold a point.
    #[must_use]
    pub fn including(self, point: Vec3) -> Self {
        Self { min: self.min.min(point), max: self.max.max(point) }
    }

    /// What both hold; `None` where they are apart.
    #[must_use]
    pub fn common(self, other: &Self) -> Option<Self> {
        let (min, max) = (self.min.max(other.min), self.max.min(other.max));
        min.cmple(max).all().then_some(Self { min, max })
    }

    /// Grown to hold another box.
    #[must_use]
    pub fn joined(self, other: &Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// Centre.
    #[must_use]
    pub fn center(&self) -> Vec3 {
        (self.min + self.max) * 0.5
    }

    /// Half the size.
    #[must_use]
    pub fn half(&self) -> Vec3 {
        ((self.max - self.min) * 0.5).max(Vec3::ZERO)
    }

    /// The eight corners.
    #[must_use]
    pub fn corners(&self) -> [Vec3; 8] {
        std::array::from_fn(|i| {
            let pick = |bit: usize, low: f32, high: f32| if i >> bit & 1 == 1 { high } else { low };
            Vec3::new(pick(0, self.min.x, self.max.x), pick(1, self.min.y, self.max.y), pick(2, self.min.z, self.max.z))
        })
    }
}

/// Triangles, counter-clockwise seen from outside.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Corners.
    pub vertices: Vec<Vertex>,
    /// Three a triangle, each below `vertices.len()`.
    pub indices: Vec<u32>,
}

impl Mesh {
    /// The box around every vertex.
    #[must_use]
    pub fn bounds(&self) -> Bounds {
        self.vertices.iter().fold(Bounds::EMPTY, |bounds, vertex| bounds.including(Vec3::from_array(vertex.position)))
    }
}
