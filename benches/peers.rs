//! Any-hit visibility against other libraries: the same points, the same light samples, interleaved runs, one
//! thread, its CPU time, medians.
//!
//! `cargo run --release -p occlude-benches --features embree --bin peers` asks about whole tiles of each scene's picture,
//! N shadow rays a point and light, all points together and by class. It prints tables, and with `-o` writes them
//! as CSV and Markdown. Without the feature Embree is left out.

use clap::Parser;
use occlude_benches::ours::{METHODS, Method};
use occlude_benches::record::{Cell, Record, SceneRow};
use occlude_benches::scaling::{self, Sample};
use occlude_benches::{Class, OWN, Peer, SHARED, Setting, Work, builds, median, obvhs, scene, thread_time};
use occlude_host::accel::{Accel, Quality};
use occlude_host::generate::{Kind, generate};
use occlude_kernel::lanes::{Level, detect, level_name, level_named};
use occlude_kernel::{Bvh, Counts};
use std::path::PathBuf;
use std::time::Instant;

/// As the command `occlude` has it. Embree has one of its own.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Compares this library with its peers.
#[derive(Parser)]
struct Options {
    /// Scenes, by name, separated by commas; generated ones with or without a number of triangles (hair:1000000).
    /// All there are if not given.
    #[arg(long, value_delimiter = ',')]
    scenes: Vec<String>,
    /// Shadow rays a point and light.
    #[arg(long, value_delimiter = ',', default_values_t = [1, 16, 64])]
    rays: Vec<usize>,
    /// About how many shaded points a scene.
    #[arg(long, default_value_t = 32768)]
    points: usize,
    /// Interleaved runs.
    #[arg(long, default_value_t = 7)]
    runs: usize,
    /// The SIMD level of our queries.
    #[arg(long)]
    simd: Option<String>,
    /// Only all points together, not the classes apart.
    #[arg(long)]
    overall: bool,
    /// Instead of scenes one by one, time a ray against the number of triangles, 10^3 to 10^MOST, in generated
    /// spheres and cities at 16 rays a point and light; with -o writes NAME.csv and NAME.svg.
    #[arg(long, value_name = "MOST", value_parser = clap::value_parser!(u32).range(3..=8))]
    scaling: Option<u32>,
    /// Only these peers, by the beginnings of their names (tile, embree 16, obvhs); for profiles.
    #[arg(long, value_delimiter = ',')]
    peers: Vec<String>,
    /// Also print how many tests our queries make.
    #[arg(long)]
    counts: bool,
    /// Write NAME.csv and NAME.md.
    #[arg(short, long, value_name = "NAME")]
    output: Option<PathBuf>,
}

fn main() {
    let options = Options::parse();
    let level = match &options.simd {
        None => detect(),
        Some(name) => level_named(name).unwrap_or_else(|| {
            eprintln!("no SIMD level called {name} on this CPU");
            std::process::exit(2);
        }),
    };
    if let Some(most) = options.scaling {
        scale(&options, level, most);
        return;
    }
    let mut names = options.scenes.clone();
    if names.is_empty() {
        let made = Kind::ALL.into_iter().map(Kind::name);
        names = SHARED.into_iter().chain(OWN).chain(made).map(str::to_owned).collect();
    }
    let mut record = Record::new(level_name(level));
    for name in &names {
        match scene(name) {
            Some(Ok(scene)) => {
                let setting = Setting::new(name, scene, options.points);
                measure(&options, level, &setting, &mut record);
            }
            Some(Err(error)) => eprintln!("skipped: {error}"),
            None => {}
        }
    }
    print!("{}", record.summary());
    if let Some(path) = &options.output {
        record.write(path).unwrap_or_else(|error| {
            eprintln!("{}: {error}", path.display());
            std::process::exit(2);
        });
    }
}

/// Time a ray from 10^3 to 10^most triangles.
fn scale(options: &Options, level: Level, most: u32) {
    let mut samples = Vec::new();
    for kind in [Kind::Spheres, Kind::City] {
        for power in 3..=most {
            let start = Instant::now();
            let setting = Setting::new(kind.name(), generate(kind, 1, 10usize.pow(power)), options.points);
            let triangles = setting.scene.triangles.len();
            eprintln!(
                "{}, {triangles} triangles: ready after {:.1} s",
                setting.name,
                start.elapsed().as_secs_f64()
            );
            let build = build_time(&setting);
            let bvh = setting.bvh();
            #[cfg(feature = "embree")]
            let tree = occlude_benches::embree::Embree::quickest(&setting.scene, false);
            #[cfg_attr(not(feature = "embree"), expect(unused_mut, reason = "nobody to add"))]
            let mut peers = ours(level, bvh);
            #[cfg(feature = "embree")]
            if let Some(tree) = &tree {
                for mode in occlude_benches::embree::MODES.into_iter().filter(|mode| !mode.robust) {
                    let answer = Box::new(move |work: &Work, blocked: &mut [u64]| {
                        tree.answer(mode, level, work, blocked)
                    });
                    peers.push(Peer { name: mode.name.to_owned(), family: "embree", answer });
                }
            }
            let cells = contest(&peers, &setting.work(16, None), options.runs);
            let each = triangles as f64;
            let (kind, bytes) = (setting.name.clone(), setting.bytes() as f64 / each);
            if let Some(cell) = cells.iter().find(|cell| cell.peer == "tile") {
                samples.push(Sample { kind, peer: "ours", triangles, ns: cell.ns_per_ray(), build, bytes });
            }
            #[cfg(feature = "embree")]
            if let Some(tree) = &tree {
                let best = cells.iter().filter(|cell| cell.family == "embree").map(|cell| cell.ns_per_ray());
                let (ns, build) = (best.fold(f64::INFINITY, f64::min), tree.built.as_secs_f64());
                let (kind, bytes) = (setting.name.clone(), tree.tree_bytes() as f64 / each);
                samples.push(Sample { kind, peer: "embree", triangles, ns, build, bytes });
            }
        }
    }
    print!("{}", scaling::csv(&samples));
    if let Some(path) = &options.output {
        let title = "16 shadow rays a point and light, one thread; Embree: the best of its modes";
        let written = std::fs::write(path.with_extension("csv"), scaling::csv(&samples))
            .and_then(|()| std::fs::write(path.with_extension("svg"), scaling::svg(&samples, title)));
        written.unwrap_or_else(|error| {
            eprintln!("{}: {error}", path.display());
            std::process::exit(2);
        });
    }
}

/// The least time of a few in which our tree is built, on all threads.
fn build_time(setting: &Setting) -> f64 {
    let once = || {
        let start = Instant::now();
        drop(Accel::build(&setting.scene, Quality::default()));
        start.elapsed().as_secs_f64()
    };
    (0..builds(&setting.scene)).map(|_| once()).fold(f64::INFINITY, f64::min)
}

/// Our queries.
fn ours(level: Level, bvh: Bvh<'_>) -> Vec<Peer<'_>> {
    METHODS
        .iter()
        .map(|&Method { name, answer, .. }| Peer {
            name: name.to_owned(),
            family: "ours",
            answer: Box::new(move |work, blocked| answer(level, bvh, work, blocked)),
        })
        .collect()
}

fn measure(options: &Options, level: Level, setting: &Setting, record: &mut Record) {
    let bvh = setting.bvh();
    let mut row = SceneRow {
        scene: setting.name.clone(),
        triangles: setting.scene.triangles.len(),
        points: setting.points,
        our_bytes: setting.bytes(),
        ..SceneRow::default()
    };
    for (class, share) in Class::ALL.into_iter().zip(&mut row.shares) {
        let of_it = setting.pairs.iter().filter(|pair| pair.class == class).count();
        *share = of_it as f64 / setting.pairs.len().max(1) as f64;
    }
    row.our_build = build_time(setting);
    let (binary, wide) = (obvhs::Binary::new(&setting.scene), obvhs::Wide::new(&setting.scene));
    #[cfg(feature = "embree")]
    let trees = [false, true].map(|robust| occlude_benches::embree::Embree::quickest(&setting.scene, robust));
    let mut peers = ours(level, bvh);
    let answer = Box::new(|work: &Work, blocked: &mut [u64]| binary.answer(work, blocked));
    peers.push(Peer { name: "obvhs binary".to_owned(), family: "obvhs", answer });
    let answer = Box::new(|work: &Work, blocked: &mut [u64]| wide.answer(work, blocked));
    peers.push(Peer { name: "obvhs wide".to_owned(), family: "obvhs", answer });
    #[cfg(feature = "embree")]
    {
        peers.extend(occlude_benches::embree::peers(&trees, level));
        if let [Some(fast), Some(robust)] = &trees {
            row.embree_build = [fast, robust].map(|tree| tree.built.as_secs_f64());
            row.embree_bytes = [fast, robust].map(|tree| tree.tree_bytes());
            record.embree = Some(fast.version());
        }
    }
    let named = |peer: &Peer<'_>| options.peers.iter().any(|name| peer.name.starts_with(name.as_str()));
    peers.retain(|peer| options.peers.is_empty() || named(peer));
    eprintln!("{}", row.describe());

    for &rays in &options.rays {
        let classes = Class::ALL.into_iter().map(Some).take(if options.overall { 0 } else { 3 });
        for class in std::iter::once(None).chain(classes) {
            let work = setting.work(rays, class);
            if work.rays() == 0 {
                continue;
            }
            let class = class.map_or("all", Class::name);
            if options.counts {
                count(level, setting, &work, class);
            }
            let cells = contest(&peers, &work, options.runs);
            for mut cell in cells {
                cell.scene.clone_from(&setting.name);
                (cell.rays_per_point, cell.class) = (rays, class);
                record.cells.push(cell);
            }
            eprintln!("{}", record.line(&setting.name, rays, class));
        }
    }
    record.scenes.push(row);
}

/// Tests a pair of point and light, query by query.
fn count(level: Level, setting: &Setting, work: &Work, class: &str) {
    let pairs = work.batches.len() as f64;
    for method in METHODS {
        let mut counts = Counts::default();
        (method.count)(level, setting.bvh(), work, &mut work.answers(), &mut counts);
        eprintln!(
            "{} {class}, {}: {:.1} nodes visited by a ray or a bundle, {:.1} triangle tests a point and light",
            setting.name,
            method.name,
            counts.node_tests as f64 / 8.0 / pairs,
            counts.triangle_tests as f64 / pairs,
        );
    }
}

/// Times shorter than this say little, so short work is done several times over.
const LEAST: f64 = 2e-3;

/// Peers slower than this many times the best of their family in the first run are not asked again.
const HOPELESS: f64 = 1.4;

/// Everybody answers once, which warms the caches and tells how often they differ; then those with a chance run in
/// turns.
fn contest(peers: &[Peer<'_>], work: &Work, runs: usize) -> Vec<Cell> {
    let mut first: Option<Vec<u64>> = None;
    let mut blocked = work.answers();
    let mut cells: Vec<Cell> = Vec::new();
    for peer in peers {
        let begin = thread_time();
        (peer.answer)(work, &mut blocked);
        let once = thread_time() - begin;
        let first = first.get_or_insert_with(|| blocked.clone());
        let differ: u32 = first.iter().zip(&blocked).map(|(a, b)| (a ^ b).count_ones()).sum();
        assert!(peer.family != "ours" || differ == 0, "{} differs from single rays", peer.name);
        cells.push(Cell {
            peer: peer.name.clone(),
            family: peer.family,
            seconds: once,
            rays: work.rays(),
            batches: work.batches.len(),
            differ: f64::from(differ) / work.rays() as f64,
            ..Cell::default()
        });
    }
    let best = |cells: &[Cell], family: &str| {
        cells
            .iter()
            .filter(|cell| cell.family == family)
            .map(|cell| cell.seconds)
            .fold(f64::INFINITY, f64::min)
    };
    let limits = ["ours", "obvhs", "embree"].map(|family| (family, best(&cells, family) * HOPELESS));
    let chance = |cell: &Cell| {
        cell.family == "ours"
            || limits.iter().any(|&(family, most)| family == cell.family && cell.seconds <= most)
    };
    let contenders: Vec<_> = (0..peers.len()).filter(|&i| chance(&cells[i])).collect();
    let mut times = vec![Vec::new(); peers.len()];
    for _ in 0..runs {
        for &i in &contenders {
            let repeat = (LEAST / cells[i].seconds).ceil().clamp(1.0, 1000.0);
            let begin = thread_time();
            for _ in 0..repeat as usize {
                (peers[i].answer)(work, &mut blocked);
            }
            times[i].push((thread_time() - begin) / repeat);
        }
    }
    for &i in &contenders {
        cells[i].runs = runs;
        cells[i].seconds = median(&mut times[i]);
    }
    cells
}
