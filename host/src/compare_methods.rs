//! Methods beside each other: the same camera samples, their errors, and the time they take.

use crate::clock;
use crate::film::{Film, Image};
use crate::integrator::{
    Auto, AutoOptions, Exact, MapOptions, PreparedMap, Scratch, Settings, Stage, StageTimes, Stochastic,
    Visibility, render_tile,
};
use crate::metrics::flip;
use crate::page::{
    Axis, Crop, Data, Entry, Figure, Gallery, Page, Picture, Plot, Series, Strip, Table, Tone, heat, number,
};
use crate::reproduce::{Halted, Reproduced, Run};
use clap::ValueEnum;
use rayon::prelude::*;
use std::sync::Mutex;
use std::time::Instant;

/// The command that makes the page.
pub const MAKER: &str = "occlude compare-methods";

/// The files beside the page.
pub const FILES: [&str; 2] = ["methods.csv", "passes.csv"];

/// A way to find visibility.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// Every shadow ray is traced through the scene.
    Exact,
    /// A map that learns; right on average.
    Auto,
    /// The residual decomposition over two groups of all blockers.
    Stochastic,
    /// The occlusion map with its three cases; biased.
    Map,
}

impl Method {
    fn name(self) -> &'static str {
        match self {
            Self::Exact => "exact",
            Self::Auto => "auto",
            Self::Stochastic => "stochastic",
            Self::Map => "map",
        }
    }
}

/// How the methods are compared.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// Which, the first being what the others are held against.
    pub methods: Vec<Method>,
    /// Passes of each.
    pub passes: u32,
    /// Shadow rays of the reference for each camera sample.
    pub reference_rays: u32,
    /// The image's size.
    pub size: (u32, u32),
}

/// What a method has done so far.
struct Runner<'a> {
    method: Method,
    visibility: Box<dyn Visibility + 'a>,
    film: Film,
    scratches: Vec<Mutex<Scratch>>,
    /// Before the first pass and in passes, s.
    seconds: f64,
    prepared: f64,
    /// Passes, time and error, from time to time.
    history: Vec<(u32, f64, f64)>,
}

impl<'a> Runner<'a> {
    fn new(method: Method, visibility: Box<dyn Visibility + 'a>, size: (u32, u32), prepared: f64) -> Self {
        let scratches = (0..rayon::current_num_threads()).map(|_| Mutex::default()).collect();
        let film = Film::new(size.0, size.1);
        Self { method, visibility, film, scratches, seconds: prepared, prepared, history: Vec::new() }
    }

    fn begin(&mut self, stage: &Stage<'_>) {
        let start = clock::of_process();
        let tiles: Vec<_> = self.film.tiles().iter().map(|tile| tile.tile()).collect();
        self.visibility.begin(stage, &tiles, self.film.width());
        let spent = (clock::of_process() - start).as_secs_f64();
        self.seconds += spent;
        self.prepared += spent;
    }

    fn pass(&mut self, stage: &Stage<'_>, pass: u32) {
        let start = clock::of_process();
        let Self { visibility, film, scratches, .. } = self;
        let width = film.width();
        film.tiles_mut().par_iter_mut().for_each(|tile| {
            let own = &scratches[rayon::current_thread_index().unwrap_or(0)];
            let mut scratch = own.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
            render_tile(stage, &**visibility, width, pass, tile, &mut scratch);
        });
        visibility.passed(stage);
        self.seconds += (clock::of_process() - start).as_secs_f64();
    }

    fn times(&self) -> StageTimes {
        let mut times = StageTimes::default();
        for scratch in &self.scratches {
            times += scratch.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).times;
        }
        times
    }
}

/// What the exact method says of a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Class {
    Lit,
    Dark,
    Penumbra,
    Empty,
}

const CLASSES: [(Class, &str); 3] =
    [(Class::Lit, "lit"), (Class::Dark, "dark"), (Class::Penumbra, "penumbra")];

/// Runs the methods over a scene and writes a page. Errors are those of the shadow rays alone: the reference has the same
/// camera samples, and many rays for each.
pub fn compare_methods(
    stage: &Stage<'_>,
    options: &MapOptions,
    comparison: &Comparison,
    run: &Run<'_>,
) -> Result<Reproduced, Halted> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(run.threads)
        .build()
        .map_err(|error| crate::Error::Usage(format!("cannot start {} threads: {error}", run.threads)))?;
    pool.install(|| compare(stage, options, comparison, run))
}

fn compare(
    stage: &Stage<'_>,
    options: &MapOptions,
    comparison: &Comparison,
    run: &Run<'_>,
) -> Result<Reproduced, Halted> {
    let began = Instant::now();
    let size = comparison.size;
    let prepared = {
        let start = clock::of_process();
        let wanted = comparison.methods.contains(&Method::Map);
        wanted.then(|| (PreparedMap::new(stage, options), (clock::of_process() - start).as_secs_f64()))
    };
    let map = prepared.as_ref().map(|(prepared, seconds)| (prepared, *seconds));
    let mut runners = Vec::new();
    for &method in &comparison.methods {
        let start = clock::of_process();
        let (visibility, before): (Box<dyn Visibility + '_>, f64) = match method {
            Method::Exact => (Box::new(Exact), 0.0),
            Method::Auto => (Box::new(Auto::new(AutoOptions::default())), 0.0),
            Method::Stochastic => {
                (Box::new(Stochastic::new(Settings::default(), stage.scene, &stage.bvh)?), 0.0)
            }
            Method::Map => {
                let Some((map, seconds)) = map else { continue };
                (Box::new(map.visibility()), seconds)
            }
        };
        let spent = (clock::of_process() - start).as_secs_f64();
        runners.push(Runner::new(method, visibility, size, before + spent));
    }
    runners.iter_mut().for_each(|runner| runner.begin(stage));

    let many = Stage { shadow_rays: comparison.reference_rays, ..*stage };
    let mut reference = Runner::new(Method::Exact, Box::new(Exact), size, 0.0);
    for pass in 0..comparison.passes {
        run.watch.reached(
            f64::from(pass) / f64::from(comparison.passes),
            &format!("pass {} of {}", pass + 1, comparison.passes),
        );
        run.go_on()?;
        reference.pass(&many, pass);
        for runner in &mut runners {
            run.go_on()?;
            runner.pass(stage, pass);
        }
        if (pass + 1).is_power_of_two() || pass + 1 == comparison.passes {
            let truth = reference.film.develop();
            for runner in &mut runners {
                let error = rmse(&runner.film.develop(), &truth, |_| true);
                runner.history.push((pass + 1, runner.seconds, error));
            }
        }
    }
    let classes = classes(stage, size);
    let truth = reference.film.develop();
    let images: Vec<Image> = runners.iter().map(|runner| runner.film.develop()).collect();

    let mut page = Page::new(
        MAKER,
        format!("Methods on {}", stage.scene.name),
        format!(
            "{} × {} pixels, {} camera samples a pixel, {} shadow rays each. The error is that of the shadow rays: the \
             reference has the same camera samples and {} rays for each.",
            size.0, size.1, comparison.passes, stage.shadow_rays, comparison.reference_rays
        ),
    );
    let mut data = Data::new(&[
        "method",
        "prepare_s",
        "render_s",
        "visibility_s",
        "light_s",
        "rmse",
        "gain_visibility",
        "gain_visibility_and_samples",
        "gain_render",
    ]);
    let mut table =
        Table::new("Error, time and gain, (time × squared error) against that of the first method")
            .words("method")
            .numbers("before, s")
            .numbers("passes and before, s")
            .numbers("visibility, s")
            .numbers("light samples, s")
            .numbers("RMSE")
            .numbers("FLIP")
            .numbers("gain, visibility")
            .numbers("with light samples")
            .numbers("whole");
    let figures: Vec<_> = runners
        .iter()
        .zip(&images)
        .map(|(runner, image)| {
            let times = runner.times();
            let seconds = [
                times.visibility.as_secs_f64(),
                times.visibility.as_secs_f64() + times.light.as_secs_f64(),
                runner.seconds,
            ];
            (seconds, rmse(image, &truth, |_| true), times.light.as_secs_f64())
        })
        .collect();
    for (k, (runner, (seconds, error, light))) in runners.iter().zip(&figures).enumerate() {
        let gains: [f64; 3] = std::array::from_fn(|i| {
            let (first, first_error, ..) = figures[0];
            first[i] * first_error * first_error / (seconds[i] * error * error)
        });
        let seen = flip::flip(&images[k], &truth, 0.0, flip::PIXELS_PER_DEGREE)?;
        let mut row = vec![
            Entry::from(runner.method.name()),
            Entry::number(runner.prepared, 3),
            Entry::number(runner.seconds, 3),
            Entry::number(seconds[0], 3),
            Entry::number(*light, 3),
            Entry::number(*error, 3),
            Entry::number(seen.mean, 3),
        ];
        row.extend(gains.map(|gain| {
            let tone = if gain >= 1.0 { Tone::Good } else { Tone::Bad };
            Entry::number(gain, 3).tone(tone)
        }));
        table.row(row);
        let numbers = [runner.prepared, runner.seconds, seconds[0], *light, *error];
        let cells = std::iter::once(runner.method.name().to_owned());
        data.row(cells.chain(numbers.iter().chain(&gains).map(|value| format!("{value:.6e}"))));
    }
    page.section("Gain");
    page.add(&table);
    page.prose(
        "Times are those that threads worked, summed: whoever else uses the machine is not in them. The whole has all in it, \
         with what came before the first pass. The map is biased: more passes do not take its error away.",
    );
    page.data(FILES[0], "one line a method");

    page.section("Error against time");
    let mut passes = Data::new(&["method", "passes", "seconds", "rmse"]);
    let mut plot = Plot::new("", Axis::log("seconds"), Axis::log("RMSE"));
    for (k, runner) in runners.iter().enumerate() {
        let points = runner.history.iter().map(|&(_, seconds, error)| (seconds, error));
        plot = plot.series(Series::new(runner.method.name(), k, points));
        for &(pass, seconds, error) in &runner.history {
            let numbers = [f64::from(pass), seconds, error].map(|value| format!("{value:.6e}"));
            passes.row(std::iter::once(runner.method.name().to_owned()).chain(numbers));
        }
    }
    page.add(
        &Figure::new("After 1, 2, 4, 8 and so on passes", "Lower and to the left is better.").plot(plot),
    );
    page.data(FILES[1], "a line for each method after 1, 2, 4 and so on passes");

    page.section("Where");
    let mut by_class = Table::new("RMSE by what the exact method says of a pixel's first camera sample")
        .words("method")
        .numbers("lit")
        .numbers("dark")
        .numbers("penumbra");
    let count = |class: Class| classes.iter().filter(|&&other| other == class).count();
    let share = |class: Class| 100.0 * count(class) as f64 / classes.len().max(1) as f64;
    let mut row = vec![Entry::from("pixels, %").tone(Tone::Faint)];
    row.extend(CLASSES.map(|(class, _)| Entry::number(share(class), 3).tone(Tone::Faint)));
    by_class.row(row);
    for (runner, image) in runners.iter().zip(&images) {
        let mut row = vec![Entry::from(runner.method.name())];
        row.extend(
            CLASSES.map(|(class, _)| Entry::number(rmse(image, &truth, |pixel| classes[pixel] == class), 3)),
        );
        by_class.row(row);
    }
    page.add(&by_class);

    page.section("Pictures");
    let crop = busiest(&truth);
    let mut strip = Strip::new(
        "After the last pass",
        "The frame is enlarged below each picture.",
        ["reference".to_owned()].into_iter().chain(runners.iter().map(|r| r.method.name().to_owned())),
    )
    .crops([("where there is most going on".to_owned(), crop)]);
    let picture = |image: &Image, name: &str| Picture::new(image, 0.0, name).crops(image, 0.0, &[crop]);
    let all = std::iter::once((&truth, "the reference"))
        .chain(images.iter().zip(runners.iter().map(|runner| runner.method.name())));
    strip.row("picture", all.map(|(image, name)| picture(image, name)));
    page.add(&strip);
    let off: Vec<Vec<f64>> = images.iter().map(|image| differences(image, &truth)).collect();
    let most = off.iter().flatten().fold(0.0f64, |most, &value| most.max(value));
    // Most of what there is: a few pixels would make everything else black.
    let mut sorted: Vec<f64> = off.iter().flatten().copied().collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let high = sorted.get(sorted.len() * 199 / 200).copied().unwrap_or(most).max(1e-9);
    let mut gallery =
        Gallery::new("How far each is off", "The mean of the three channels, without its sign.")
            .ramp(0.0, high, "radiance");
    for (runner, off) in runners.iter().zip(&off) {
        let image = heat(off, size.0, size.1, 0.0, high);
        gallery.picture(runner.method.name(), Picture::new(&image, 0.0, runner.method.name()));
    }
    page.add(&gallery);

    if let Some(k) = comparison.methods.iter().position(|&method| method == Method::Auto).filter(|&k| k > 0) {
        let gain = figures[0].0[0] * figures[0].1.powi(2) / (figures[k].0[0] * figures[k].1.powi(2));
        page.in_short(format!(
            "Visibility at equal error: auto is {} times as efficient as {}.",
            number(gain, 3),
            comparison.methods[0].name(),
        ));
    }
    let foot = format!(
        "Made by `{MAKER}` of Occlude {} in {:.0} s: {} threads, {}, seed {}.",
        env!("CARGO_PKG_VERSION"),
        began.elapsed().as_secs_f64(),
        rayon::current_num_threads(),
        occlude_kernel::lanes::level_name(run.level),
        run.seed,
    );
    Ok(Reproduced { page, foot, data: vec![(FILES[0], data), (FILES[1], passes)] })
}

/// Over pixels and channels.
fn rmse(image: &Image, truth: &Image, counts: impl Fn(usize) -> bool) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0f64);
    for (pixel, (a, b)) in image.pixels.iter().zip(&truth.pixels).enumerate() {
        if counts(pixel) {
            sum += (0..3).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>();
            count += 3.0;
        }
    }
    (sum / count.max(1.0)).sqrt()
}

fn differences(image: &Image, truth: &Image) -> Vec<f64> {
    let mean = |pixel: &[f32; 3]| f64::from(pixel[0] + pixel[1] + pixel[2]) / 3.0;
    image.pixels.iter().zip(&truth.pixels).map(|(a, b)| (mean(a) - mean(b)).abs()).collect()
}

/// A square with as much going on as can be.
fn busiest(image: &Image) -> Crop {
    let edge = (image.width.min(image.height) / 5).max(1);
    let mut best = (f32::NEG_INFINITY, Crop { x: 0, y: 0, width: edge, height: edge });
    for y in (0..=image.height - edge).step_by(4) {
        for x in (0..=image.width - edge).step_by(4) {
            let mut change = 0.0;
            for row in y..y + edge - 1 {
                for column in x..x + edge - 1 {
                    let at = |x: u32, y: u32| image.pixels[(y * image.width + x) as usize][1].min(1.0);
                    change += (at(column, row) - at(column + 1, row)).abs().min(0.2);
                    change += (at(column, row) - at(column, row + 1)).abs().min(0.2);
                }
            }
            if change > best.0 {
                best = (change, Crop { x, y, width: edge, height: edge });
            }
        }
    }
    best.1
}

/// What 64 exact rays to the lights say of each pixel's first camera sample.
fn classes(stage: &Stage<'_>, size: (u32, u32)) -> Vec<Class> {
    let stage = Stage { shadow_rays: 64, count: false, ..*stage };
    let mut classes = vec![Class::Empty; size.0 as usize * size.1 as usize];
    for tile in Film::new(size.0, size.1).tiles() {
        let tile = tile.tile();
        let asked = crate::integrator::questions(&stage, tile, size.0, 0);
        let mut estimates = Vec::new();
        Exact.estimate(&stage, &asked, &mut estimates, &mut Default::default());
        for batch in &asked.batches {
            let (x, y) = tile.position(asked.points[batch.point as usize].pixel as usize);
            let answers = &estimates[batch.samples.start as usize..batch.samples.end as usize];
            let (free, blocked) = (answers.contains(&1.0), answers.contains(&0.0));
            let class = &mut classes[y as usize * size.0 as usize + x as usize];
            *class = match (*class, free, blocked) {
                (Class::Empty | Class::Lit, true, false) => Class::Lit,
                (Class::Empty | Class::Dark, false, true) => Class::Dark,
                _ => Class::Penumbra,
            };
        }
    }
    classes
}
