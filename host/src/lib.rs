//! Renders the direct light of area lights with the `occlude` kernel.

pub mod accel;
mod adaptive;
pub mod cli;
pub mod clock;
pub mod compare_methods;
pub mod error;
pub mod film;
pub mod generate;
pub mod integrator;
pub mod light;
pub mod mesh;
pub mod metrics;
pub mod output;
pub mod page;
pub mod photons;
pub mod render;
pub mod report;
pub mod reproduce;
pub mod sampler;
pub mod scene;
pub mod volumetric;

pub use error::{Error, Result};
