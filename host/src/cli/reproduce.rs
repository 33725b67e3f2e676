//! `occlude reproduce`: tables and figures, run again.

use super::{Ended, note, whole};
use crate::error::Result;
use crate::page::{Folder, INDEX};
use crate::reproduce::map::{self, map};
use crate::reproduce::theory::{self, theory};
use crate::reproduce::{Halted, Reproduced, Run, Watch};
use clap::{Args, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use occlude_kernel::lanes::Level;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Arguments of `occlude reproduce`.
#[derive(Debug, Args)]
pub struct ReproduceArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Stochastic visibility: variances, pictures and efficiency of every decomposition, as a page.
    ///
    /// Everything on it is run anew. Takes some minutes; nothing but this program is needed.
    Theory(TheoryArgs),
    /// The occlusion map: time, tests, error and bias, each remedy alone and all together, and the thesis' table beside
    /// ours, as a page.
    ///
    /// Everything on it is run anew. Takes ten minutes and more; --quick: one.
    Map(MapPageArgs),
}

#[derive(Debug, Args)]
#[command(allow_negative_numbers = true)]
struct MapPageArgs {
    /// The folder to write index.html and the .csv files to.
    #[arg(short, long, value_name = "FOLDER", default_value = "map")]
    output: PathBuf,

    /// A folder of scenes, of which columns and fence are added to the generated ones.
    #[arg(long, value_name = "FOLDER")]
    scenes: Option<PathBuf>,

    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, Args)]
#[command(allow_negative_numbers = true)]
struct TheoryArgs {
    /// The folder to write index.html and the .csv files to.
    #[arg(short, long, value_name = "FOLDER", default_value = "theory")]
    output: PathBuf,

    #[command(flatten)]
    common: CommonArgs,
}

/// What all of them take.
#[derive(Debug, Args)]
struct CommonArgs {
    /// Smaller pictures and fewer samples: seconds, not minutes.
    #[arg(long)]
    quick: bool,

    /// Threads; 0 for one a core. All but the times is the same for any number.
    #[arg(long, default_value_t = 0, value_name = "T", value_parser = whole::<u16>(0..=1024))]
    threads: u16,

    /// Seed of the random numbers.
    #[arg(long, default_value_t = 0, value_name = "S", value_parser = whole::<u64>(0..=u64::MAX))]
    seed: u64,

    /// Write to the folder whatever is in it.
    #[arg(long)]
    force: bool,

    /// Print nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

/// Runs the command.
pub fn run(args: &ReproduceArgs, level: Level) -> Result<Ended> {
    let what = &args.what;
    let (args, output, maker, files) = match what {
        What::Theory(of) => (&of.common, &of.output, theory::MAKER, &theory::FILES[..]),
        What::Map(of) => (&of.common, &of.output, map::MAKER, &map::FILES[..]),
    };
    if let What::Map(MapPageArgs { scenes: Some(scenes), .. }) = what {
        map::check_scenes(scenes)?;
    }
    let folder = Folder::claim(output, maker, files, args.force)?;
    let stop = super::interruptible("the page");
    let progress = Progress::new(args.quiet);
    let run = Run {
        quick: args.quick,
        seed: args.seed,
        threads: usize::from(args.threads),
        level,
        stop: &stop,
        watch: &progress,
    };
    let made = match what {
        What::Theory(_) => theory(&run),
        What::Map(of) => map(&run, of.scenes.as_deref()),
    };
    write(&folder, made, &progress, args.quiet)
}

/// Writes a page and what goes beside it.
pub(super) fn write(
    folder: &Folder,
    reproduced: std::result::Result<Reproduced, Halted>,
    progress: &Progress,
    quiet: bool,
) -> Result<Ended> {
    let reproduced = match reproduced {
        Ok(reproduced) => reproduced,
        Err(Halted::Failed(error)) => return Err(error),
        Err(Halted::Interrupted) => {
            progress.finish();
            if !quiet {
                note("interrupted; nothing was written");
            }
            return Ok(Ended::Interrupted);
        }
    };
    progress.finish();
    for (name, data) in &reproduced.data {
        folder.write(name, &data.csv())?;
    }
    folder.write(INDEX, reproduced.page.html(&reproduced.foot).as_bytes())?;
    if !quiet {
        note(&format!("wrote {} and {} files of data", folder.file(INDEX).display(), reproduced.data.len()));
    }
    Ok(Ended::Done)
}

/// A bar on a terminal, a line a step in a pipe.
pub(super) enum Progress {
    Quiet,
    Bar(ProgressBar),
    Lines { start: Instant, last: Mutex<String> },
}

/// Steps of the bar.
const STEPS: f64 = 1000.0;

impl Progress {
    pub(super) fn new(quiet: bool) -> Self {
        if quiet {
            return Self::Quiet;
        }
        if !std::io::stderr().is_terminal() {
            return Self::Lines { start: Instant::now(), last: Mutex::default() };
        }
        let bar = ProgressBar::new(STEPS as u64);
        if let Ok(style) = ProgressStyle::with_template("{bar:30} {percent:>3}%  {elapsed}, {wide_msg}") {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Self::Bar(bar)
    }

    fn finish(&self) {
        if let Self::Bar(bar) = self {
            bar.finish_and_clear();
        }
    }
}

impl Watch for Progress {
    fn reached(&self, done: f64, next: &str) {
        match self {
            Self::Quiet => {}
            Self::Bar(bar) => {
                bar.set_position((done * STEPS) as u64);
                bar.set_message(next.to_owned());
            }
            Self::Lines { start, last } => {
                let mut last = last.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
                if *last != next {
                    *last = next.to_owned();
                    note(&format!("{:3.0} %, {:.1} s: {next}", 100.0 * done, start.elapsed().as_secs_f64()));
                }
            }
        }
    }
}
