//! Renders the direct light of area lights with the `occlude` kernel.

pub mod accel;
pub mod error;
pub mod light;
pub mod sampler;
pub mod scene;

pub use error::{Error, Result};
