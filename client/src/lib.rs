//! MR360 live, the client's half: receive ─► decode ─► sync ─► environment ─► view ─► present.
//!
//! [`join`] reads like the data path. Head motion never leaves the client.

mod arguments;
pub mod audio;
pub mod camera;
pub mod decode;
pub mod environment;
pub mod frame_loop;
pub mod governor;
pub mod gpu;
pub mod hands;
pub mod headless;
pub mod join;
pub mod overlay;
pub mod picture;
pub mod receive;
pub mod record;
pub mod render;
pub mod scene;
pub mod script;
pub mod stats;
pub mod sync;
pub mod view;
pub mod viewpoint;
pub mod window;
pub mod xr;

/// Why a command of the client ended before it was done.
pub type Failure = mr360_protocol::failure::Failure<anyhow::Error>;
