//! What crosses the wire in MR360 live, and how.
//!
//! [`light`], [`video`], [`scene`], [`intent`], [`clock`], [`asset`] and [`codec`] define the messages, their bounds and their encoding, without
//! I/O. [`transport`] carries them over QUIC and MoQ, and keeps the server's certificate; [`join`] is the URL that a viewer is handed;
//! [`scene_file`] reads the scene as its author writes it. [`failure`], [`stages`] and [`stop`] are what the programs share beside the wire.
//!
//! Conventions of the whole project: right-handed, y up, −z forward, metres, radians; linear BT.709 radiance
//! with the video's display white at 1.0.

pub mod asset;
pub mod clock;
pub mod codec;
pub mod failure;
pub mod intent;
pub mod join;
pub mod light;
pub mod scene;
pub mod scene_file;
pub mod stages;
pub mod stop;
pub mod track;
pub mod transport;
pub mod video;
