mod ambient;
mod bvh;
mod config;
mod facade;
mod geometry;
mod noise;
mod place;
mod sky;
mod still;
mod surface;
pub use config::{Clouds, MAX_MOVERS, PlazaConfig, PlazaError};
#[cfg(test)]
mod look;
