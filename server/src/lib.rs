//! MR360 live, the server's half: ingest ─► light ─► broadcast, and the session that owns the scene.
//!
//! [`serve`] reads like the data path. Everything runs on the CPU.

pub mod analyze;
pub mod broadcast;
pub mod frame;
pub mod image_file;
pub mod ingest;
pub mod lighting;
pub mod physics;
pub mod plaza;
pub mod serve;
pub mod session;
pub mod stats;
pub mod truth;
