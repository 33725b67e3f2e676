//! Renders the direct light of area lights with the `occlude` kernel.

pub mod cli;
pub mod error;
pub mod generate;
pub mod scene;

pub use error::{Error, Result};
