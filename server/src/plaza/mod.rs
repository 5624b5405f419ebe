//! plaza
