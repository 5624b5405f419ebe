//! Objects of the shared scene as meshes: built-in shapes, models and their animations, what they occlude, and picking.

pub mod accessor;
pub mod animation;
mod container;
pub mod hierarchy;
pub mod material;
pub mod mesh;
pub mod model;
#[cfg(test)]
mod model_tests;
pub mod occluder;
pub mod pick;
pub mod primitive;
pub mod rig;
#[cfg(test)]
mod rig_tests;
pub mod shapes;
#[cfg(test)]
pub(crate) mod test_models;
pub mod texture;
