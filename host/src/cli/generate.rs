//! `occlude generate`: a scene of any size, for measuring.

use super::{Ended, interruptible, note, number, whole};
use crate::error::Result;
use crate::generate::{self, Kind, MOST_TRIANGLES};
use std::io::{self, Write};
use std::path::PathBuf;

/// Generate a scene of a given number of triangles
#[derive(Clone, Debug, clap::Args)]
#[command(allow_negative_numbers = true)]
pub struct GenerateArgs {
    /// What to generate
    #[arg(value_name = "KIND")]
    pub name: Kind,
    /// The folder to write scene.obj, scene.mtl and camera.json to [default: the kind's name]
    #[arg(short, long, value_name = "FOLDER")]
    pub output: Option<PathBuf>,
    /// About how many triangles: 1e6, 1_000_000, 250k and 2M are understood
    #[arg(short, long, value_name = "N", default_value = "100k", value_parser = count)]
    pub triangles: usize,
    /// The same seed gives the same scene, on any machine
    #[arg(long, value_name = "S", default_value_t = 0, value_parser = whole::<u64>(0..=u64::MAX))]
    pub seed: u64,
    /// Replace a scene that is already in the folder
    #[arg(long)]
    pub force: bool,
}

/// Generates, writes, and says in one line what was written.
pub fn run(args: &GenerateArgs) -> Result<Ended> {
    let folder = args.output.clone().unwrap_or_else(|| PathBuf::from(args.name.name()));
    let check = || if args.force { Ok(()) } else { generate::check_empty(&folder) };
    check()?;
    let scene = generate::generate(args.name, args.seed, args.triangles);
    check()?;
    // Before that there is nothing to clean up.
    if !generate::overwrite_unless(&scene, &folder, &interruptible("room on the disk"))? {
        note("interrupted; nothing was written");
        return Ok(Ended::Interrupted);
    }
    // Whoever closed the pipe does not want to read this.
    let _ = writeln!(
        io::stdout(),
        "{}: {} triangles, {} vertices, {} materials",
        folder.display(),
        scene.triangles.len(),
        scene.positions.len(),
        scene.materials.len()
    );
    Ok(Ended::Done)
}

/// A count of triangles, as people write it: `1000000`, `1_000_000`, `1e6`, `250k`, `1.5M`.
fn count(text: &str) -> std::result::Result<usize, String> {
    match number(text).map(f64::round) {
        Some(n) if n >= 1.0 && n <= MOST_TRIANGLES as f64 => Ok(n as usize),
        Some(_) => Err(format!("between 1 and {MOST_TRIANGLES} triangles are possible")),
        None => Err("a number such as 1000000, 1_000_000, 1e6, 250k or 2M is needed".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        args: GenerateArgs,
    }

    #[test]
    fn counts_as_people_write_them() {
        let good = ["1", "1e6", "1_000_000", "250k", "2M", "1.5M", "12K", "1e3k"];
        assert_eq!(
            good.map(|t| count(t).unwrap()),
            [1, 1_000_000, 1_000_000, 250_000, 2_000_000, 1_500_000, 12_000, 1_000_000]
        );
        for bad in ["", "k", "0", "-5", "1e99", "nan", "inf", "many", "1e", "0.2", "+3", "5 k", "é"] {
            assert!(count(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_command_line_becomes_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("wood");
        let line = ["occlude", "forest", "-o", output.to_str().unwrap(), "--triangles", "2k", "--seed", "9"];
        let args = Program::try_parse_from(line).unwrap().args;
        assert_eq!((args.name, args.triangles, args.seed, args.force), (Kind::Forest, 2000, 9, false));
        run(&args).unwrap();
        assert!(run(&args).is_err());
        run(&GenerateArgs { force: true, ..args }).unwrap();
        assert!(output.join("scene.obj").exists());
    }

    #[test]
    fn names_agree_with_the_command_line() {
        use clap::ValueEnum;
        assert_eq!(Kind::value_variants(), Kind::ALL);
        assert!(Kind::ALL.iter().all(|k| k.to_possible_value().is_some_and(|v| v.get_name() == k.name())));
    }
}
