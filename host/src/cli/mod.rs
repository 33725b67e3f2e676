//! The commands of the `occlude` program.

pub mod generate;
