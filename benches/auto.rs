//! The map that learns (`--method auto`) against the exact method, and beside Embree: one thread, its CPU time.
//!
//! `cargo run --release -p occlude-benches --features embree --bin auto -- equal-error` compares visibility at equal error,
//! `whole` the time of whole renders until they are good, `scaling` both methods over numbers of triangles. Each prints
//! tables, and with `-o NAME` writes them as CSV and Markdown. Without the feature Embree is left out.

use clap::{Args, Parser, Subcommand};
use occlude_benches::learning::{Meeting, Place, Spent, Terms, meet, stay_alone};
use occlude_benches::scaling::{self, Sample};
use occlude_benches::whole::{Ladder, WAYS};
use occlude_benches::{OWN, Peer, SHARED, Work, ours, scene};
use occlude_host::generate::{Kind, generate};
use occlude_kernel::lanes::{Level, detect, level_name, level_named};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Measures the map that learns.
#[derive(Parser)]
struct Options {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// The same passes of both methods, and the exact method's rays by Embree.
    EqualError(EqualError),
    /// Whole renders, until the error of the picture is small.
    Whole(Whole),
    /// Visibility at equal error from 10^3 triangles on, and the map's memory against what it may have.
    Scaling(Scaling),
}

/// What all of them want to know.
#[derive(Args)]
struct Common {
    /// Scenes, by name, separated by commas; generated ones with or without a number of triangles (hair:1000000).
    /// All there are if not given.
    #[arg(long, value_delimiter = ',')]
    scenes: Vec<String>,
    /// The picture's size in pixels.
    #[arg(long, value_name = "WxH", value_parser = size, default_value = "128x72")]
    size: (u32, u32),
    /// The SIMD level.
    #[arg(long, value_parser = level)]
    simd: Option<Level>,
    /// Write NAME.csv and NAME.md; of scaling NAME.svg as well.
    #[arg(short, long, value_name = "NAME")]
    output: Option<PathBuf>,
}

#[derive(Args)]
struct EqualError {
    #[command(flatten)]
    common: Common,
    /// Shadow rays a camera sample, over all lights together.
    #[arg(long, value_delimiter = ',', default_values_t = [1, 16, 64])]
    rays: Vec<u32>,
    /// Passes, if not 128 over the root of the number of rays.
    #[arg(long)]
    passes: Option<u32>,
    /// Renders with other random numbers, which are added up.
    #[arg(long, default_value_t = 1)]
    seeds: u64,
}

#[derive(Args)]
struct Scaling {
    #[command(flatten)]
    common: Common,
    /// Shadow rays a camera sample, over all lights together.
    #[arg(long, default_value_t = 64)]
    rays: u32,
    /// Up to 10^MOST triangles.
    #[arg(long, default_value_t = 6, value_parser = clap::value_parser!(u32).range(3..=8))]
    most: u32,
    /// What the map may have, kB, of the scenes with 10^5 triangles.
    #[arg(long, value_delimiter = ',', default_values_t = [64, 256, 1024, 4096, 262_144])]
    memory: Vec<usize>,
}

#[derive(Args)]
struct Whole {
    #[command(flatten)]
    common: Common,
    /// Shadow rays a camera sample, over all lights together.
    #[arg(long, default_value_t = 16)]
    rays: u32,
    /// The RMSE over the picture's mean that is asked for.
    #[arg(long, default_value_t = 0.01)]
    goal: f64,
    /// Where exact would take longer than so many seconds, the error it comes to in the time is asked for instead.
    #[arg(long, default_value_t = 4.0)]
    most: f64,
}

fn size(text: &str) -> Result<(u32, u32), String> {
    text.split_once('x')
        .and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)))
        .filter(|&(width, height)| width > 0 && height > 0)
        .ok_or_else(|| "wants width x height in pixels, like 128x72".to_owned())
}

fn level(name: &str) -> Result<Level, String> {
    level_named(name).ok_or_else(|| format!("no SIMD level is called {name} on this CPU"))
}

impl Common {
    fn level(&self) -> Level {
        self.simd.unwrap_or_else(detect)
    }

    /// The scenes that there are.
    fn places(&self) -> impl Iterator<Item = Place> {
        let made = Kind::ALL.into_iter().map(Kind::name);
        let mut names = self.scenes.clone();
        if names.is_empty() {
            names = SHARED.into_iter().chain(OWN).chain(made).map(str::to_owned).collect();
        }
        names.into_iter().filter_map(|name| match scene(&name)? {
            Ok(scene) => Place::new(&name, scene, self.size),
            Err(error) => {
                eprintln!("skipped: {error}");
                None
            }
        })
    }

    fn write(&self, csv: &str, markdown: &str) {
        let Some(name) = &self.output else { return };
        write(&name.with_extension("csv"), csv);
        write(&name.with_extension("md"), markdown);
    }
}

fn write(path: &Path, text: &str) {
    std::fs::write(path, text).unwrap_or_else(|error| {
        eprintln!("{}: {error}", path.display());
        std::process::exit(2);
    });
}

fn main() {
    stay_alone();
    match Options::parse().what {
        What::EqualError(options) => equal_error(&options),
        What::Whole(options) => whole(&options),
        What::Scaling(options) => scale(&options),
    }
}

/// The geometric mean of what is finite, and the least with its name.
fn mean_and_least<'a>(values: impl Iterator<Item = (&'a str, f64)>) -> (f64, f64, &'a str) {
    let values: Vec<_> = values.filter(|(_, value)| value.is_finite()).collect();
    let mean = (values.iter().map(|(_, value)| value.ln()).sum::<f64>() / values.len() as f64).exp();
    let least = values.iter().min_by(|a, b| a.1.total_cmp(&b.1)).copied().unwrap_or(("", f64::NAN));
    (mean, least.1, least.0)
}

/// One way to answer: our tile query.
fn tile(place: &Place, level: Level) -> Peer<'_> {
    let bvh = place.bvh();
    let method = ours::METHODS.iter().find(|method| method.name == "tile").expect("one of ours");
    let answer = Box::new(move |work: &Work, blocked: &mut [u64]| (method.answer)(level, bvh, work, blocked));
    Peer { name: method.name.to_owned(), family: "ours", answer }
}

fn equal_error(options: &EqualError) {
    let level = options.common.level();
    let mut meetings = Vec::new();
    for place in options.common.places() {
        #[cfg(feature = "embree")]
        let trees = [false, true].map(|robust| occlude_benches::embree::Embree::new(&place.scene, robust));
        #[cfg_attr(not(feature = "embree"), expect(unused_mut, reason = "nobody to add"))]
        let mut peers = vec![tile(&place, level)];
        #[cfg(feature = "embree")]
        peers.extend(occlude_benches::embree::peers(&trees, level));
        for &rays in &options.rays {
            let mut terms = Terms { seeds: options.seeds, ..Terms::new(level, rays) };
            terms.passes = options.passes.unwrap_or(terms.passes);
            let meeting = meet(&place, &terms, &peers);
            eprintln!(
                "{:>16} N={rays:<3} squared error {:.3}, gain {:.3} (with samples {:.3}, whole {:.3}); ns a ray: exact {:.2}, \
                 tile {:.2}, auto {:.2}, {:.3} of the best of Embree",
                place.name,
                meeting.error_ratio(),
                meeting.gain(Spent::of_visibility),
                meeting.gain(Spent::of_light),
                meeting.gain(Spent::whole),
                meeting.exact_ns(),
                meeting.tile_ns,
                meeting.effective_ns(),
                meeting.lead(),
            );
            meetings.push(meeting);
        }
    }
    let markdown = equal_error_markdown(options, &meetings);
    print!("{markdown}");
    options.common.write(&equal_error_csv(&meetings), &markdown);
}

fn equal_error_csv(meetings: &[Meeting]) -> String {
    let mut text = String::from(
        "scene,triangles,shadow_rays,passes,rays,error_ratio,exact_visibility_s,exact_light_s,exact_rest_s,auto_learning_s,\
         auto_visibility_s,auto_light_s,auto_rest_s,gain_visibility,gain_with_samples,gain_whole,exact_ns,tile_ns,\
         auto_effective_ns,embree_ns,embree_mode,embree_differs,lead,lead_with_samples,map_bytes\n",
    );
    for meeting in meetings {
        let Meeting { exact, auto, .. } = meeting;
        let (mode, ns) = meeting.best.clone().unwrap_or((String::new(), f64::NAN));
        let _ = writeln!(
            text,
            "{},{},{},{},{},{:.4},{:.4},{:.4},{:.4},{:.4},{:.4},{:.4},{:.4},{:.3},{:.3},{:.3},{:.3},{:.3},{:.3},{ns:.3},{mode},{:.2e},\
             {:.3},{:.3},{}",
            meeting.scene,
            meeting.triangles,
            meeting.shadow_rays,
            meeting.passes,
            meeting.rays,
            meeting.error_ratio(),
            exact.visibility,
            exact.light,
            exact.rest,
            auto.learning,
            auto.visibility,
            auto.light,
            auto.rest,
            meeting.gain(Spent::of_visibility),
            meeting.gain(Spent::of_light),
            meeting.gain(Spent::whole),
            meeting.exact_ns(),
            meeting.tile_ns,
            meeting.effective_ns(),
            meeting.differ,
            meeting.lead(),
            meeting.lead_with_samples(),
            meeting.map_bytes,
        );
    }
    text
}

/// What a meeting is summed up by.
type Figure = fn(&Meeting) -> f64;

fn equal_error_markdown(options: &EqualError, meetings: &[Meeting]) -> String {
    let (width, height) = options.common.size;
    let mut text = format!(
        "{width}x{height} pixels, SIMD level `{}`, {}. Squared errors and times of auto over those of exact, times with what \
         is learned before and between passes; gains are of time x squared error. ns a ray: exact, our tile query by itself \
         and the best of Embree's modes with the same rays; auto's are its time x the ratio of squared errors, for each ray \
         of exact. The leads are the best of Embree over auto.\n",
        level_name(options.common.level()),
        if options.seeds == 1 {
            "one render of each".to_owned()
        } else {
            format!("{} renders of each", options.seeds)
        },
    );
    for &rays in &options.rays {
        let of_it = || meetings.iter().filter(|meeting| meeting.shadow_rays == rays);
        let Some(passes) = of_it().next().map(|meeting| meeting.passes) else { continue };
        let _ = write!(
            text,
            "\n## {rays} shadow rays, {passes} passes\n\n\
             | scene | squared error | time: visibility | with light samples | whole | gain: visibility | with light samples \
             | whole | exact, ns | tile, ns | auto, ns | Embree, ns | mode | lead | with light samples | map, kB |\n\
             | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | --- | ---: | ---: | ---: |\n",
        );
        for meeting in of_it() {
            let time = |which: fn(&Spent) -> f64| which(&meeting.auto) / which(&meeting.exact);
            let (mode, ns) = meeting.best.clone().unwrap_or((String::new(), f64::NAN));
            let _ = writeln!(
                text,
                "| {} | {:.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.2} | {:.1} | {:.1} | {:.1} | {ns:.1} | {} | {:.2} | {:.2} \
                 | {:.0} |",
                meeting.scene,
                meeting.error_ratio(),
                time(Spent::of_visibility),
                time(Spent::of_light),
                time(Spent::whole),
                meeting.gain(Spent::of_visibility),
                meeting.gain(Spent::of_light),
                meeting.gain(Spent::whole),
                meeting.exact_ns(),
                meeting.tile_ns,
                meeting.effective_ns(),
                mode.trim_start_matches("embree "),
                meeting.lead(),
                meeting.lead_with_samples(),
                meeting.map_bytes as f64 * 1e-3,
            );
        }
        let figures: [(&str, Figure); 5] = [
            ("gain of visibility", |meeting| meeting.gain(Spent::of_visibility)),
            ("with light samples", |meeting| meeting.gain(Spent::of_light)),
            ("of the whole", |meeting| meeting.gain(Spent::whole)),
            ("lead over Embree", Meeting::lead),
            ("with light samples", Meeting::lead_with_samples),
        ];
        text.push('\n');
        for (name, figure) in figures {
            let (mean, least, of) =
                mean_and_least(of_it().map(|meeting| (meeting.scene.as_str(), figure(meeting))));
            if mean.is_finite() {
                let _ = writeln!(text, "- {name}: geometric mean {mean:.2}, least {least:.2} ({of})");
            }
        }
    }
    text
}

/// A scene's renders by each of [`WAYS`], and the error at which they are compared.
struct Climbs {
    scene: String,
    ladders: Vec<Ladder>,
    goal: f64,
}

impl Climbs {
    fn until(&self, way: usize) -> f64 {
        self.ladders[way].until(self.goal)
    }

    /// Of the last way.
    fn gain(&self, over: usize) -> f64 {
        self.until(over) / self.until(WAYS.len() - 1)
    }
}

/// How much longer than the exact method the others may take.
const LONGER: f64 = 4.0;

fn whole(options: &Whole) {
    let Whole { common, rays, goal, most } = options;
    let mut all = Vec::new();
    for place in common.places() {
        let mut climbs = Climbs { scene: place.name.clone(), ladders: Vec::new(), goal: *goal };
        for way in WAYS {
            // What exact came to within its time the others may take longer for.
            let patience = if climbs.ladders.is_empty() { *most } else { LONGER * most };
            let ladder = Ladder::climb(&place, common.level(), *rays, way, climbs.goal, patience);
            if climbs.ladders.is_empty() {
                climbs.goal = goal.max(ladder.least());
            }
            climbs.ladders.push(ladder);
        }
        let each = (0..WAYS.len()).map(|way| format!("{} {:.3} s", WAYS[way].name, climbs.until(way)));
        eprintln!(
            "{:>16}, {:.2} %: {}",
            place.name,
            100.0 * climbs.goal,
            each.collect::<Vec<_>>().join(", ")
        );
        all.push(climbs);
    }
    let markdown = whole_markdown(options, &all);
    print!("{markdown}");
    common.write(&whole_csv(&all), &markdown);
}

fn whole_csv(all: &[Climbs]) -> String {
    let mut text = String::from("scene,goal,way,passes,relative_rmse,seconds\n");
    for Climbs { scene, ladders, goal } in all {
        for (way, ladder) in WAYS.iter().zip(ladders) {
            for step in &ladder.steps {
                let _ = writeln!(
                    text,
                    "{scene},{goal:.5},\"{}\",{},{:.5},{:.4}",
                    way.name, step.passes, step.error, step.seconds
                );
            }
        }
    }
    text
}

fn whole_markdown(options: &Whole, all: &[Climbs]) -> String {
    let (width, height) = options.common.size;
    let mut text = format!(
        "{width}x{height} pixels, {} shadow rays a camera sample, SIMD level `{}`. CPU time, s, from the start, the map included, \
         until the RMSE of the whole picture, edges included, is {} % of its mean; where exact needs more than {} s for that, \
         until it is what exact comes to in the time. Of two renders with other random numbers for each of 4, 8, 16 ... \
         passes, and along a power of the error between these. The gains are of auto, adaptive.\n\n| scene | error, % |",
        options.rays,
        level_name(options.common.level()),
        100.0 * options.goal,
        options.most,
    );
    text.extend(WAYS.iter().map(|way| format!(" {} |", way.name)));
    text.push_str(" gain over exact | over exact, adaptive |\n| --- |");
    text.push_str(&" ---: |".repeat(WAYS.len() + 3));
    text.push('\n');
    for climbs in all {
        let _ = write!(text, "| {} | {:.2} |", climbs.scene, 100.0 * climbs.goal);
        text.extend((0..WAYS.len()).map(|way| format!(" {:.3} |", climbs.until(way))));
        let _ = writeln!(text, " {:.2} | {:.2} |", climbs.gain(0), climbs.gain(1));
    }
    text.push('\n');
    for (over, name) in [(0, "exact"), (1, "exact, adaptive")] {
        let gains = all.iter().map(|climbs| (climbs.scene.as_str(), climbs.gain(over)));
        let (mean, least, of) = mean_and_least(gains);
        let _ = writeln!(text, "- over {name}: geometric mean {mean:.2}, least {least:.2} ({of})");
    }
    text
}

/// Triangles of the scenes in which the map's memory is bounded.
const BOUNDED: usize = 100_000;

fn scale(options: &Scaling) {
    let Scaling { common, rays, most, memory } = options;
    let level = common.level();
    let kinds = [Kind::Spheres, Kind::City]
        .into_iter()
        .filter(|kind| common.scenes.is_empty() || common.scenes.iter().any(|name| name == kind.name()));
    let (mut meetings, mut bounded) = (Vec::new(), Vec::new());
    for kind in kinds {
        for power in 3..=*most {
            let triangles = 10usize.pow(power);
            let Some(place) = Place::new(kind.name(), generate(kind, 1, triangles), common.size) else {
                continue;
            };
            let terms = Terms::new(level, *rays);
            let meeting = meet(&place, &terms, &[]);
            eprintln!(
                "{:>16}, {} triangles: gain {:.3}, ns a ray: exact {:.2}, auto {:.2}",
                place.name,
                meeting.triangles,
                meeting.gain(Spent::of_visibility),
                meeting.exact_ns(),
                meeting.effective_ns()
            );
            meetings.push(meeting);
            if triangles == BOUNDED {
                for &most in memory {
                    let terms = Terms { memory: Some(most << 10), ..terms };
                    bounded.push((most, meet(&place, &terms, &[])));
                }
            }
        }
    }
    let samples: Vec<_> = meetings
        .iter()
        .flat_map(|meeting| {
            let each = [("exact", meeting.exact_ns()), ("auto", meeting.effective_ns())];
            each.map(|(peer, ns)| Sample {
                kind: meeting.scene.clone(),
                peer,
                triangles: meeting.triangles,
                ns,
                build: f64::NAN,
                bytes: f64::NAN,
            })
        })
        .collect();
    let markdown = scaling_markdown(options, &meetings, &bounded);
    print!("{markdown}");
    common.write(&equal_error_csv(&meetings), &markdown);
    if let Some(name) = &common.output {
        let title =
            format!("Visibility, {rays} shadow rays, one thread: time for each ray of exact at equal error");
        write(&name.with_extension("svg"), &scaling::svg(&samples, &title));
    }
}

fn scaling_markdown(options: &Scaling, meetings: &[Meeting], bounded: &[(usize, Meeting)]) -> String {
    let (width, height) = options.common.size;
    let passes = meetings.first().map_or(0, |meeting| meeting.passes);
    let mut text = format!(
        "{width}x{height} pixels, {} shadow rays, {passes} passes, SIMD level `{}`. Seconds of visibility, for auto with \
         lessons and times the ratio of squared errors: what exact has in all passes, and what auto needs to come to the \
         same error.\n\n\
         | scene | triangles | exact, s | auto, s | squared error | gain: visibility | with light samples | whole | map, kB |\n\
         | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |\n",
        options.rays,
        level_name(options.common.level()),
    );
    for meeting in meetings {
        let _ = writeln!(
            text,
            "| {} | {} | {:.3} | {:.3} | {:.2} | {:.2} | {:.2} | {:.2} | {:.0} |",
            meeting.scene,
            meeting.triangles,
            meeting.exact.visibility,
            meeting.auto.of_visibility() * meeting.error_ratio(),
            meeting.error_ratio(),
            meeting.gain(Spent::of_visibility),
            meeting.gain(Spent::of_light),
            meeting.gain(Spent::whole),
            meeting.map_bytes as f64 * 1e-3,
        );
    }
    text.push_str(
        "\n| scene, 10^5 triangles | the map may have, KiB | and has, KiB | squared error | gain: visibility | whole |\n\
         | --- | ---: | ---: | ---: | ---: | ---: |\n",
    );
    for (most, meeting) in bounded {
        let _ = writeln!(
            text,
            "| {} | {most} | {:.0} | {:.2} | {:.2} | {:.2} |",
            meeting.scene,
            meeting.map_bytes as f64 / 1024.0,
            meeting.error_ratio(),
            meeting.gain(Spent::of_visibility),
            meeting.gain(Spent::whole),
        );
    }
    text
}
