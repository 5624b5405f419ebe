//! Harness of the end-to-end tests and the benches: real processes, measured from outside.
//!
//! [`sandbox`] finds the programs and keeps what they write apart from the user's own files, [`process`] starts
//! them and reads what they say, [`usage`] and [`ports`] ask the system about them. [`samples`] reads what
//! `--stats` wrote; [`chart`] and [`table`] write what came out; [`network`] is a bench made of these.

pub mod chart;
pub mod network;
pub mod ports;
pub mod process;
pub mod samples;
pub mod sandbox;
pub mod svg;
pub mod table;
pub mod usage;
