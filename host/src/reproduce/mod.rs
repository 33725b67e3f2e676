//! Reproduces tables and figures: runs what they are made of, and writes a page of it.

pub mod map;
pub mod theory;

use crate::error::Error;
use crate::page::{Data, Page};
use occlude_kernel::lanes::Level;
use std::sync::atomic::{AtomicBool, Ordering};

/// What a reproduction is asked to do.
#[derive(Clone, Copy)]
pub struct Run<'a> {
    /// Smaller pictures, fewer samples.
    pub quick: bool,
    /// The seed of every random number.
    pub seed: u64,
    /// Threads; 0 for one a core.
    pub threads: usize,
    /// The SIMD level.
    pub level: Level,
    /// Set to end early.
    pub stop: &'a AtomicBool,
    /// Who wants to know how far it is.
    pub watch: &'a dyn Watch,
}

/// Hears how far a run is.
pub trait Watch: Sync {
    /// `done` of the whole, from 0 to 1, and what comes next.
    fn reached(&self, done: f64, next: &str);
}

/// Why there is no page.
#[derive(Debug)]
pub enum Halted {
    /// It was told to stop.
    Interrupted,
    /// Something was wrong.
    Failed(Error),
}

impl From<Error> for Halted {
    fn from(error: Error) -> Self {
        Self::Failed(error)
    }
}

/// A page, and the files of data beside it.
#[derive(Debug)]
pub struct Reproduced {
    /// The page.
    pub page: Page,
    /// What to write at its foot.
    pub foot: String,
    /// Names and contents.
    pub data: Vec<(&'static str, Data)>,
}

/// A part of a run, from one share of the whole to another.
#[derive(Clone, Copy)]
pub(crate) struct Leg<'a> {
    pub(crate) run: &'a Run<'a>,
    from: f64,
    to: f64,
}

impl<'a> Leg<'a> {
    pub(crate) fn new(run: &'a Run<'a>, from: f64, to: f64) -> Self {
        Self { run, from, to }
    }

    /// Says how far this part is, and ends it if that is wanted.
    pub(crate) fn at(&self, share: f64, next: &str) -> Result<(), Halted> {
        self.run.watch.reached(self.from + share * (self.to - self.from), next);
        self.run.go_on()
    }
}

impl Run<'_> {
    /// An error if the run was told to stop.
    pub fn go_on(&self) -> Result<(), Halted> {
        if self.stop.load(Ordering::Relaxed) { Err(Halted::Interrupted) } else { Ok(()) }
    }
}
