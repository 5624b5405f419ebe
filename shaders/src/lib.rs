//! WGSL of MR360 live, the Rust mirrors of its layouts, and the CPU twins of its light kernels.
//!
//! [`equirect`], [`sh`] and [`colour`] hold the conventions of the whole project once, for the server's
//! analysis and for tests; the WGSL files of the same names are their GPU twins.

pub mod brdf;
pub mod colour;
pub mod equirect;
pub mod layout;
pub mod lobe;
pub mod multiview;
pub mod project;
pub mod sh;
pub mod source;
