//! Harness of the end-to-end tests and the benches: real processes, measured from outside.
//!
//! [`sandbox`] finds the programs and keeps what they write apart from the user's own files, [`process`] starts
//! them and reads what they say, [`usage`] and [`ports`] ask the system about them. [`clips`] and [`models`] make what they are fed,
//! [`probe`] is a peer without a picture, [`xr`] a headset without hardware, [`impair`] a bad network. [`samples`] reads what
//! `--stats` wrote; [`figures`], [`chart`], [`boxes`] and [`table`] make and write what came out; [`lighting`], [`render`], [`network`] and [`headset`]
//! are benches made of these.

pub mod boxes;
pub mod chart;
pub mod clips;
pub mod figures;
pub mod headset;
pub mod impair;
pub mod lighting;
pub mod models;
pub mod network;
pub mod ports;
pub mod probe;
pub mod process;
pub mod render;
pub mod samples;
pub mod sandbox;
pub mod svg;
pub mod table;
pub mod usage;
pub mod xr;
