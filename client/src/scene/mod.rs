//! Objects of the shared scene as meshes: built-in shapes, models, what they occlude, and picking.

pub mod accessor;
pub mod material;
pub mod mesh;
pub mod model;
#[cfg(test)]
mod model_tests;
pub mod occluder;
pub mod pick;
pub mod shapes;
