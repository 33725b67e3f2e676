//! Two builds of `peers` in turns: is a plain build as quick as one for this machine's CPU alone?
//!
//! ```text
//! cargo build --release -p occlude-benches --bin peers --bin builds
//! RUSTFLAGS="-C target-cpu=native" cargo build --release -p occlude-benches --bin peers --target-dir target/native
//! target/release/builds target/release/peers target/native/release/peers
//! ```
//!
//! Each answers the same questions by tiles and by single rays, one after the other, some times over. The table holds the
//! least time a ray of each, and what part of the second one's speed the first one reaches.

use clap::Parser;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio, exit};

/// Compares two builds of `peers`.
#[derive(Parser)]
struct Options {
    /// The build in question.
    first: PathBuf,
    /// What it is held against.
    second: PathBuf,
    /// Scenes, by name, separated by commas.
    #[arg(long, default_value = "columns,fence,spheres,city,hair,soup")]
    scenes: String,
    /// Shadow rays a point and light.
    #[arg(long, default_value = "1,16,64")]
    rays: String,
    /// About how many shaded points a scene.
    #[arg(long, default_value_t = 2048)]
    points: usize,
    /// How many times each build is asked.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
}

/// The least times seen, in ns a ray, of both builds.
type Times = BTreeMap<(String, usize, String), [f64; 2]>;

fn main() {
    let options = Options::parse();
    let mut times = Times::new();
    for round in 0..options.rounds.max(1) {
        for (which, program) in [&options.first, &options.second].into_iter().enumerate() {
            eprintln!("round {}: {}", round + 1, program.display());
            if let Err(why) = ask(program, which, &options, &mut times) {
                eprintln!("{}: {why}", program.display());
                exit(2);
            }
        }
    }
    println!("| scene | N | query | {} | {} | part |", options.first.display(), options.second.display());
    println!("| --- | ---: | --- | ---: | ---: | ---: |");
    let mut least = f64::INFINITY;
    for ((scene, rays, query), [first, second]) in &times {
        println!("| {scene} | {rays} | {query} | {first:.2} | {second:.2} | {:.2} |", second / first);
        least = least.min(second / first);
    }
    let logs: f64 = times.values().map(|[first, second]| (second / first).ln()).sum();
    println!("geometric mean {:.3}, least {least:.2}", (logs / times.len() as f64).exp());
}

/// Lets a build answer, and keeps what was quicker than before.
fn ask(program: &Path, which: usize, options: &Options, times: &mut Times) -> Result<(), String> {
    let name = std::env::temp_dir().join(format!("occlude-builds-{}", std::process::id()));
    let points = options.points.to_string();
    let done = Command::new(program)
        .args(["--overall", "--runs", "3", "--peers", "tile,single", "--points", &points])
        .args(["--scenes", &options.scenes, "--rays", &options.rays, "-o"])
        .arg(&name)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .map_err(|why| why.to_string())?;
    if !done.success() {
        return Err(format!("ended with {done}"));
    }
    let table = name.with_extension("csv");
    let text = std::fs::read_to_string(&table).map_err(|why| format!("{}: {why}", table.display()))?;
    for written in [table, name.with_extension("md")] {
        std::fs::remove_file(&written).map_err(|why| format!("{}: {why}", written.display()))?;
    }
    for line in text.lines().skip(1) {
        let mut fields = line.split(',');
        let mut next = || fields.next().ok_or_else(|| format!("a line of its table is short: {line}"));
        let (scene, rays, _class, query, ns) = (next()?, next()?, next()?, next()?, next()?);
        let rays = rays.parse().map_err(|_| format!("not a number of rays: {rays}"))?;
        let ns: f64 = ns.parse().map_err(|_| format!("not a time: {ns}"))?;
        let place = times.entry((scene.to_owned(), rays, query.to_owned())).or_insert([f64::INFINITY; 2]);
        place[which] = place[which].min(ns);
    }
    Ok(())
}
