//! The command `occlude`.

pub mod compare;
mod compare_methods;
pub mod generate;
pub mod info;
mod learn;
pub mod map;
pub mod photons;
pub mod render;
pub mod reproduce;

use crate::error::{Error, Result};
use crate::scene::Scene;
use clap::{Parser, Subcommand};
use occlude_kernel::lanes::{Level, detect, level_name, level_named, levels};
use std::io::Write;
use std::ops::RangeInclusive;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Soft shadows from area lights.
#[derive(Debug, Parser)]
#[command(name = "occlude", version, about, max_term_width = 100, propagate_version = true)]
pub struct Cli {
    /// Use this SIMD level and not the best one of the CPU (`occlude info` lists them).
    #[arg(long, global = true, value_name = "LEVEL", value_parser = simd_level)]
    simd: Option<SimdLevel>,

    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Render a scene's direct light.
    Render(render::RenderArgs),
    /// Say what a scene holds, and what this machine can do.
    Info(info::InfoArgs),
    /// Compare two images: error, bias, FLIP.
    Compare(compare::CompareArgs),
    /// Run methods side by side on a scene, and write a page of their errors and times.
    CompareMethods(compare_methods::CompareMethodsArgs),
    /// Learn where shadows begin and end, for later renders; or say what such a map holds.
    Map(learn::LearnArgs),
    /// Show the photons of the occlusion map, and what they say.
    Photons(photons::PhotonsArgs),
    /// Write a scene of any size.
    Generate(generate::GenerateArgs),
    /// Run the tables and figures of stochastic visibility again, and write a page of them.
    Reproduce(reproduce::ReproduceArgs),
}

/// A SIMD level of this CPU.
#[derive(Clone, Copy, Debug)]
pub struct SimdLevel(Level);

fn simd_level(name: &str) -> std::result::Result<SimdLevel, String> {
    level_named(name).map(SimdLevel).ok_or_else(|| {
        let known: Vec<&str> = levels().map(level_name).collect();
        format!("this CPU has {}", known.join(", "))
    })
}

/// How a command ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// As asked.
    Done,
    /// By Ctrl-C; of a picture, what there was, if a pass was done, has been written.
    Interrupted,
}

/// Runs the command line: 0 when done, 1 when interrupted, 2 when something was wrong.
pub fn run() -> ExitCode {
    let cli = Cli::parse();
    let level = cli.simd.map_or_else(detect, |level| level.0);
    let ended = match &cli.command {
        Command::Render(args) => render::run(args, level),
        Command::Info(args) => info::run(args, level).map(|()| Ended::Done),
        Command::Compare(args) => compare::run(args).map(|()| Ended::Done),
        Command::CompareMethods(args) => compare_methods::run(args, level),
        Command::Map(args) => learn::run(args, level),
        Command::Photons(args) => photons::run(args, level).map(|()| Ended::Done),
        Command::Generate(args) => generate::run(args),
        Command::Reproduce(args) => reproduce::run(args, level),
    };
    match ended {
        Ok(Ended::Done) => ExitCode::SUCCESS,
        Ok(Ended::Interrupted) => ExitCode::from(1),
        Err(error) => {
            // Standard error may be closed as well; there is nobody left to tell.
            let _ = writeln!(std::io::stderr(), "error: {error}");
            ExitCode::from(2)
        }
    }
}

/// What Ctrl-C sets. A second Ctrl-C does not wait. `what` would be lost if the system refused.
pub fn interruptible(what: &str) -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let asked = Arc::clone(&stop);
    let handled = ctrlc::set_handler(move || {
        if asked.swap(true, Ordering::Relaxed) {
            std::process::exit(1);
        }
    });
    if let Err(error) = handled {
        note(&format!("warning: Ctrl-C will lose {what}: {error}"));
    }
    stop
}

/// A number as people write it: `1000000`, `1_000_000`, `1e6`, `250k`, `1.5M`. Not below 0.
fn number(text: &str) -> Option<f64> {
    let digits = text.replace('_', "");
    let (digits, unit) = match digits.char_indices().next_back() {
        Some((end, 'k' | 'K')) => (&digits[..end], 1e3),
        Some((end, 'm' | 'M')) => (&digits[..end], 1e6),
        _ => (digits.as_str(), 1.0),
    };
    digits.starts_with(|c: char| c.is_ascii_digit()).then(|| Some(digits.parse::<f64>().ok()? * unit))?
}

/// A parser of whole numbers in a range, written like those of [`number`].
fn whole<T: TryFrom<u64>>(
    range: RangeInclusive<u64>,
) -> impl Fn(&str) -> std::result::Result<T, String> + Clone + Send + Sync + 'static {
    move |text| {
        // All digits of a seed count, and a float has not so many. 2.3M is off by rounding only.
        let whole = |n: &f64| (n - n.round()).abs() <= 4.0 * f64::EPSILON * n && *n < u64::MAX as f64;
        let rounded = || number(text).filter(whole);
        let value = text.replace('_', "").parse().ok().or_else(|| Some(rounded()?.round() as u64));
        let value = value.filter(|value| range.contains(value)).and_then(|value| T::try_from(value).ok());
        value.ok_or_else(|| {
            format!("wants a whole number from {} to {}, like 1000 or 2.5k", range.start(), range.end())
        })
    }
}

/// Ends a command that has nothing to write: what an earlier one wrote is better.
fn interrupted_before_the_first_pass(quiet: bool) -> Ended {
    if !quiet {
        note("interrupted before the first pass was done; nothing was written");
    }
    Ended::Interrupted
}

/// The files that a scene was read from, for `output::check_apart`.
fn files_of(scene: &Scene) -> Vec<(&'static str, &Path)> {
    scene.files.iter().map(|file| ("the scene's", &**file)).collect()
}

/// Prints to standard output. A reader that has gone away is no error: `occlude info | head`.
pub fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(Error::io("writing to", "standard output")(error))
        }
        _ => Ok(()),
    }
}

/// Prints a line to standard error, if anybody listens.
pub fn note(text: &str) {
    let _ = writeln!(std::io::stderr(), "{text}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_numbers_as_people_write_them() {
        let small = whole::<u32>(1..=2_300_000);
        for (text, value) in
            [("1", 1), ("1e5", 100_000), ("100k", 100_000), ("2.3M", 2_300_000), ("1_000", 1000)]
        {
            assert_eq!(small(text), Ok(value), "{text}");
        }
        for wrong in ["0", "2300001", "-1", "1.5", "", "k", "nan", "1e99", "many", "0x10"] {
            assert!(small(wrong).unwrap_err().contains("from 1 to 2300000"), "{wrong}");
        }
        let seed = whole::<u64>(0..=u64::MAX);
        assert_eq!(seed("18446744073709551615"), Ok(u64::MAX));
        assert_eq!(seed("9007199254740993"), Ok(9_007_199_254_740_993));
        assert_eq!(seed("18_446_744_073_709_551_615"), Ok(u64::MAX));
        assert_eq!(seed("9_007_199_254_740_993"), Ok(9_007_199_254_740_993));
        assert!(seed("18446744073709551616").is_err() && seed("1.0000005").is_err());
        assert!(whole::<u16>(0..=u64::MAX)("70000").is_err());
    }
}
