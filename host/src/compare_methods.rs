//! Methods beside each other: the same camera samples, their errors, and the time they take.

use crate::clock;
use crate::film::{Film, Image, Tile};
use crate::integrator::{
    Auto, AutoOptions, CameraSample, Exact, Learned, MapOptions, PreparedMap, Questions, Scratch, Settings,
    Stage, StageTimes, Stochastic, Visibility, render_samples, render_tile,
};
use crate::metrics::flip;
use crate::page::{
    Axis, Crop, Data, Entry, Figure, Gallery, Page, Picture, Plot, Series, Strip, Table, Tone, heat, number,
};
use crate::render::check_room;
use crate::reproduce::{Halted, Reproduced, Run};
use clap::ValueEnum;
use occlude_kernel::Counts;
use occlude_kernel::occlusion_map::{BINS, CLASSES, class};
use rayon::prelude::*;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// The command that makes the page.
pub const MAKER: &str = "occlude compare-methods";

/// The files beside the page.
pub const FILES: [&str; 5] = ["methods.csv", "passes.csv", "classes.csv", "learned.csv", "guard.csv"];

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

/// A method, and how many shadow rays it has asked about.
struct Watched<'a> {
    visibility: Box<dyn Visibility + 'a>,
    rays: AtomicU64,
}

impl Visibility for Watched<'_> {
    fn begin(&self, stage: &Stage<'_>, tiles: &[Tile], width: u32) {
        self.visibility.begin(stage, tiles, width);
    }

    fn ask(&self, stage: &Stage<'_>, scratch: &mut Scratch) {
        self.visibility.ask(stage, scratch);
    }

    fn passed(&self, stage: &Stage<'_>) {
        self.visibility.passed(stage);
    }

    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        self.rays.fetch_add(questions.weights.len() as u64, Ordering::Relaxed);
        self.visibility.estimate(stage, questions, estimates, counts);
    }
}

/// What a method has done so far.
struct Runner<'a> {
    method: Method,
    visibility: Watched<'a>,
    film: Film,
    scratches: Vec<Mutex<Scratch>>,
    /// Before the first pass and in passes, s.
    seconds: f64,
    prepared: f64,
    /// Between passes, s.
    lessons: f64,
    /// Light samples and visibility of each tile, s.
    tiles: Vec<f64>,
    /// From time to time.
    history: Vec<Moment>,
}

/// What there was after some passes.
struct Moment {
    passes: u32,
    seconds: f64,
    error: f64,
    image: Image,
    times: StageTimes,
    /// Before the first pass and between passes, s.
    learning: f64,
    rays: u64,
}

impl<'a> Runner<'a> {
    fn new(method: Method, visibility: Box<dyn Visibility + 'a>, size: (u32, u32), prepared: f64) -> Self {
        let scratches = (0..rayon::current_num_threads()).map(|_| Mutex::default()).collect();
        let film = Film::new(size.0, size.1);
        let tiles = vec![0.0; film.tiles().len()];
        let visibility = Watched { visibility, rays: AtomicU64::new(0) };
        let (seconds, lessons, history) = (prepared, 0.0, Vec::new());
        Self { method, visibility, film, scratches, seconds, prepared, lessons, tiles, history }
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
        let Self { visibility, film, scratches, tiles, .. } = self;
        let width = film.width();
        film.tiles_mut().par_iter_mut().zip(tiles).for_each(|(tile, seconds)| {
            let own = &scratches[rayon::current_thread_index().unwrap_or(0)];
            let mut scratch = own.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
            let before = asking(&scratch.times);
            render_tile(stage, &*visibility, width, pass, tile, &mut scratch);
            *seconds += asking(&scratch.times) - before;
        });
        let passed = clock::of_process();
        visibility.passed(stage);
        self.lessons += (clock::of_process() - passed).as_secs_f64();
        self.seconds += (clock::of_process() - start).as_secs_f64();
    }

    /// Light samples and visibility of one more pass over the pixels of a class, s: what it learns is not counted.
    fn time_of(&self, stage: &Stage<'_>, pass: u32, which: impl Fn(usize) -> bool) -> f64 {
        let (mut film, mut scratch) = (Film::new(self.film.width(), self.film.height()), Scratch::default());
        let width = film.width();
        for tile in film.tiles_mut() {
            let pixels = tile.tile();
            let counts = |&pixel: &u32| {
                let (x, y) = pixels.position(pixel as usize);
                which((y * width + x) as usize)
            };
            let samples = (0..pixels.len() as u32).filter(counts);
            let samples = samples.map(|pixel| CameraSample::even(pixel, pass));
            render_samples(stage, &self.visibility, width, samples, tile, &mut scratch);
        }
        asking(&scratch.times)
    }

    fn remember(&mut self, passes: u32, error: f64, image: Image) {
        self.history.push(Moment {
            passes,
            seconds: self.seconds,
            error,
            image,
            times: self.times(),
            learning: self.prepared + self.lessons,
            rays: self.visibility.rays.load(Ordering::Relaxed),
        });
    }

    fn times(&self) -> StageTimes {
        let mut times = StageTimes::default();
        for scratch in &self.scratches {
            times += scratch.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).times;
        }
        times
    }
}

/// Light samples and visibility, s.
fn asking(times: &StageTimes) -> f64 {
    (times.light + times.visibility).as_secs_f64()
}

/// What the exact method says of a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Class {
    Lit,
    Dark,
    Penumbra,
    Empty,
}

const CLASSES_OF_PIXELS: [(Class, &str); 3] =
    [(Class::Lit, "lit"), (Class::Dark, "dark"), (Class::Penumbra, "penumbra")];

/// Pictures are kept of so many passes, and of the last.
const ALL_UNTIL: u32 = 32;

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
    // The reference and every method have a film and pictures, most of them of the first passes; and some are shown.
    let image = size_of::<[f32; 3]>();
    let pictures = comparison.passes.min(ALL_UNTIL) as usize + 1;
    let films = (comparison.methods.len() + 1) * (Film::BYTES_A_PIXEL[0] + image)
        + comparison.methods.len() * pictures * image;
    check_room(size, films + 6 * image)?;
    let prepared = {
        let start = clock::of_process();
        let wanted = comparison.methods.contains(&Method::Map);
        wanted.then(|| (PreparedMap::new(stage, options), (clock::of_process() - start).as_secs_f64()))
    };
    let map = prepared.as_ref().map(|(prepared, seconds)| (prepared, *seconds));
    let learner = Auto::new(AutoOptions::default());
    let mut runners = Vec::new();
    for &method in &comparison.methods {
        let start = clock::of_process();
        let (visibility, before): (Box<dyn Visibility + '_>, f64) = match method {
            Method::Exact => (Box::new(Exact), 0.0),
            Method::Auto => (Box::new(&learner), 0.0),
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
    let mut insights = Vec::new();
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
        let passes = pass + 1;
        if passes <= ALL_UNTIL || passes.is_power_of_two() || passes == comparison.passes {
            let truth = reference.film.develop();
            if comparison.methods.contains(&Method::Auto) {
                insights.push(Insight::of(&learner));
            }
            for runner in &mut runners {
                let image = runner.film.develop();
                let error = rmse(&image, &truth, |_| true);
                // Pictures of other passes are not shown.
                let image =
                    if passes <= ALL_UNTIL || passes == comparison.passes { image } else { Image::default() };
                runner.remember(passes, error, image);
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
        let points = runner.history.iter().map(|moment| (moment.seconds, moment.error));
        plot = plot.series(Series::new(runner.method.name(), k, points));
        for moment in &runner.history {
            let numbers =
                [f64::from(moment.passes), moment.seconds, moment.error].map(|value| format!("{value:.6e}"));
            passes.row(std::iter::once(runner.method.name().to_owned()).chain(numbers));
        }
    }
    page.add(
        &Figure::new(
            "After each pass up to the 32nd, and after 64, 128 and so on",
            "Lower and to the left is better.",
        )
        .plot(plot),
    );
    page.data(FILES[1], "a line for each method and point");
    let mut each = Plot::new("", Axis::linear("pass"), Axis::linear("seconds"));
    for (k, runner) in runners.iter().enumerate() {
        let pairs = runner.history.windows(2).filter(|pair| pair[1].passes == pair[0].passes + 1);
        let points = pairs.map(|pair| (f64::from(pair[1].passes), pair[1].seconds - pair[0].seconds));
        each = each.series(Series::new(runner.method.name(), k, points));
    }
    if comparison.passes > 2 {
        page.add(&Figure::new("Time of each pass", "From the second on.").plot(each));
    }
    equals(&mut page, &runners, &truth)?;

    page.section("Where");
    let mut by_class = Table::new("RMSE by what the exact method says of a pixel's first camera sample")
        .words("method")
        .numbers("lit")
        .numbers("dark")
        .numbers("penumbra");
    let count = |class: Class| classes.iter().filter(|&&other| other == class).count();
    let share = |class: Class| 100.0 * count(class) as f64 / classes.len().max(1) as f64;
    let mut row = vec![Entry::from("pixels, %").tone(Tone::Faint)];
    row.extend(CLASSES_OF_PIXELS.map(|(class, _)| Entry::number(share(class), 3).tone(Tone::Faint)));
    by_class.row(row);
    for (runner, image) in runners.iter().zip(&images) {
        let mut row = vec![Entry::from(runner.method.name())];
        row.extend(
            CLASSES_OF_PIXELS
                .map(|(class, _)| Entry::number(rmse(image, &truth, |pixel| classes[pixel] == class), 3)),
        );
        by_class.row(row);
    }
    page.add(&by_class);

    let mut beside = Table::new("Squared error against that of the first method")
        .words("method")
        .numbers("lit")
        .numbers("dark")
        .numbers("penumbra");
    for (runner, image) in runners.iter().zip(&images).skip(1) {
        let mut row = vec![Entry::from(runner.method.name())];
        row.extend(CLASSES_OF_PIXELS.map(|(class, _)| {
            let of = |image: &Image| rmse(image, &truth, |pixel| classes[pixel] == class).powi(2);
            Entry::number(of(image) / of(&images[0]), 3)
        }));
        beside.row(row);
    }
    if runners.len() > 1 {
        page.add(&beside);
    }

    let by_class = class_gains(&mut page, stage, comparison, &runners, &classes, &images, &truth);
    costs(&mut page, comparison, &runners, &classes);

    let auto = comparison.methods.iter().position(|&method| method == Method::Auto);
    let (learned, guard) = match auto {
        Some(k) => {
            let gain = figures[0].0[0] * figures[0].1.powi(2) / (figures[k].0[0] * figures[k].1.powi(2));
            let learned = learning(&mut page, stage, &learner, size, gain, runners[k].prepared);
            (learned, guarded(&mut page, &runners[0], &runners[k], &insights, &learner.history()))
        }
        None => (Data::new(&LEARNED), Data::new(&GUARD)),
    };

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
    Ok(Reproduced {
        page,
        foot,
        data: FILES.into_iter().zip([data, passes, by_class, learned, guard]).collect(),
    })
}

/// Pictures after the same time, and with the same error.
fn equals(page: &mut Page, runners: &[Runner<'_>], truth: &Image) -> Result<(), Halted> {
    page.section("The same time, the same error");
    let crop = busiest(truth);
    let time = runners.iter().map(|runner| runner.seconds).fold(f64::INFINITY, f64::min);
    let nearest = |runner: &Runner<'_>| {
        let off = |moment: &Moment| (moment.seconds / time).ln().abs();
        (0..runner.history.len())
            .filter(|&k| !runner.history[k].image.pixels.is_empty())
            .min_by(|&a, &b| off(&runner.history[a]).total_cmp(&off(&runner.history[b])))
    };
    // The least error that all have got to; of a biased method not more than it ever gets to.
    let last = |runner: &Runner<'_>| runner.history.last().map_or(f64::INFINITY, |moment| moment.error);
    let error = runners.iter().filter(|runner| runner.method != Method::Map).map(last).fold(0.0, f64::max);
    let first = |runner: &Runner<'_>| {
        (0..runner.history.len())
            .find(|&k| runner.history[k].error <= error && !runner.history[k].image.pixels.is_empty())
    };
    let mut table =
        Table::new("The first pass with no more error than the worst has in the end, and its time")
            .words("method")
            .numbers("passes")
            .numbers("RMSE")
            .numbers("seconds");
    let names = runners.iter().map(|runner| runner.method.name().to_owned());
    let mut strip = Strip::new(
        format!("After {time:.3} s each, and with an RMSE of {} each", number(error, 3)),
        "As near as whole passes come.",
        names,
    )
    .crops([("where there is most going on".to_owned(), crop)]);
    for (name, which) in
        [("equal time", &nearest as &dyn Fn(&Runner<'_>) -> Option<usize>), ("equal error", &first)]
    {
        let mut pictures = Vec::new();
        for runner in runners {
            let Some(moment) = which(runner).map(|k| &runner.history[k]) else {
                let nothing = Image::from_fn(truth.width, truth.height, |_, _| [0.2; 3]);
                pictures
                    .push(Picture::new(&nothing, 0.0, "never").crops(&nothing, 0.0, &[crop]).under("never"));
                continue;
            };
            let seen = flip::flip(&moment.image, truth, 0.0, flip::PIXELS_PER_DEGREE)?;
            let under = format!(
                "{} passes, {} s, RMSE {}, FLIP {}",
                moment.passes,
                number(moment.seconds, 3),
                number(moment.error, 3),
                number(seen.mean, 3)
            );
            let words = format!("{}, {name}", runner.method.name());
            pictures.push(
                Picture::new(&moment.image, 0.0, words).crops(&moment.image, 0.0, &[crop]).under(under),
            );
        }
        strip.row(name, pictures);
    }
    for runner in runners {
        let mut row = vec![Entry::from(runner.method.name())];
        row.extend(match first(runner).map(|k| &runner.history[k]) {
            Some(moment) => [
                Entry::from(moment.passes.to_string()),
                Entry::number(moment.error, 3),
                Entry::number(moment.seconds, 3),
            ],
            None => [Entry::from("never"), Entry::from(""), Entry::from("")],
        });
        table.row(row);
    }
    page.add(&table);
    page.add(&strip);
    Ok(())
}

const LEARNED: [&str; 9] =
    ["passes", "cells", "lit", "odds", "left_alone", "part", "doubt", "promise", "asleep"];

/// What the map that learns knew, and when.
fn learning(
    page: &mut Page,
    stage: &Stage<'_>,
    auto: &Auto,
    size: (u32, u32),
    gain: f64,
    prepared: f64,
) -> Data {
    page.section("What the map knows");
    let history = auto.history();
    let mut data = Data::new(&LEARNED);
    let mut table = Table::new("After some passes, by the points that ask")
        .numbers("passes")
        .numbers("cells")
        .numbers("proven lit, %")
        .numbers("odds, %")
        .numbers("left to exact, %")
        .numbers("samples where odds, %")
        .numbers("variance of V - u")
        .numbers("promised gain");
    for lesson in &history {
        let shares = [lesson.lit, lesson.odds, lesson.left_alone, lesson.part];
        let mut row = vec![Entry::from(lesson.passes.to_string()), Entry::from(lesson.cells.to_string())];
        row.extend(shares.map(|share| Entry::number(100.0 * share, 3)));
        row.extend([Entry::number(lesson.doubt, 3), Entry::number(lesson.promise, 3)]);
        table.row(row);
        let numbers = [shares[0], shares[1], shares[2], shares[3], lesson.doubt, lesson.promise];
        data.row(
            [lesson.passes.to_string(), lesson.cells.to_string()]
                .into_iter()
                .chain(numbers.iter().map(|value| format!("{value:.6e}")))
                .chain([u8::from(lesson.asleep).to_string()]),
        );
    }
    page.add(&table);
    page.data(FILES[3], "one line a lesson");
    let promise = history.last().map_or(1.0, |lesson| lesson.promise);
    let slept = history.iter().find(|lesson| lesson.asleep);
    page.facts([
        ("memory of the map", format!("{:.1} MB", auto.bytes() as f64 / 1e6)),
        ("building it, before the first pass", format!("{} s", number(prepared, 3))),
        ("gain of visibility, promised after the last lesson", number(promise, 3)),
        ("and measured, over all passes", number(gain, 3)),
        ("asleep", slept.map_or_else(|| "no".to_owned(), |lesson| format!("after pass {}", lesson.passes))),
    ]);
    let share = |which: &dyn Fn(&Learned) -> f64| -> Vec<(f64, f64)> {
        history.iter().map(|lesson| (f64::from(lesson.passes), 100.0 * which(lesson))).collect()
    };
    let plot = Plot::new("", Axis::linear("passes"), Axis::linear("% of the points"))
        .series(Series::new("proven lit", 0, share(&|lesson| lesson.lit)))
        .series(Series::new("odds", 1, share(&|lesson| lesson.odds)))
        .series(Series::new("left to the exact method", 2, share(&|lesson| lesson.left_alone)));
    page.add(&Figure::new("Who answers", "The rest is not known yet.").plot(plot));

    let mut seen = vec![[f64::NAN; 3]; size.0 as usize * size.1 as usize];
    let mut scratch = Scratch::default();
    for tile in Film::new(size.0, size.1).tiles() {
        let tile = tile.tile();
        for (pixel, values) in auto.survey(stage, tile, size.0, &mut scratch).iter().enumerate() {
            let (x, y) = tile.position(pixel);
            seen[y as usize * size.0 as usize + x as usize] = values.map(f64::from);
        }
    }
    let mut gallery = Gallery::new(
        "Where",
        "Of the light that a pixel's first camera sample would get with nothing in the way.",
    )
    .ramp(0.0, 1.0, "part");
    for (k, name) in ["proven lit", "samples asked for, of the usual ones", "left to the exact method"]
        .into_iter()
        .enumerate()
    {
        let values: Vec<f64> = seen.iter().map(|values| values[k]).collect();
        gallery.picture(name, Picture::new(&heat(&values, size.0, size.1, 0.0, 1.0), 0.0, name));
    }
    page.add(&gallery);
    data
}

/// What the map knew after a pass, of its cells with odds, by the points in them.
struct Insight {
    /// The part of the variance of V that guesses explain, if they are right on average.
    explained: f64,
    /// Bins of a light that are in doubt, of [`BINS`].
    doubtful: f64,
    /// Samples asked for, of the usual ones.
    part: f64,
    /// How often a guess is wrong that looks certain.
    missed: f64,
}

/// Bins of this class of doubt or a surer one are as good as certain: 4 p (1 - p) is below 2^-6.
const CERTAIN: usize = 6;

impl Insight {
    fn of(auto: &Auto) -> Self {
        let (mut all, mut explained, mut doubtful, mut part) = (0.0, 0.0, 0.0, 0.0);
        let mut variance = 0.0;
        auto.each_cell(|cell, points| {
            if cell.is_lit() || !cell.is_known() {
                return;
            }
            let points = f64::from(points);
            let guesses = (0..BINS).map(|bin| f64::from(cell.odds(bin).guess()));
            let mean = guesses.clone().sum::<f64>() / BINS as f64;
            let spread = guesses.clone().map(|guess| (guess - mean).powi(2)).sum::<f64>() / BINS as f64;
            let in_doubt = guesses.filter(|&guess| class(guess as f32) < CERTAIN).count();
            all += points;
            variance += points * mean * (1.0 - mean);
            explained += points * spread;
            doubtful += points * in_doubt as f64;
            part += points * f64::from(cell.part());
        });
        let doubts = auto.doubts();
        let (asked, squared) = (CERTAIN..CLASSES).fold((0.0, 0.0), |(asked, squared), class| {
            let of_it = doubts.asked[class] as f64;
            (asked + of_it, squared + of_it * doubts.variance(class))
        });
        Self {
            explained: explained / variance,
            doubtful: doubtful / all,
            part: part / all,
            missed: squared / asked,
        }
    }
}

const GUARD: [&str; 9] =
    ["passes", "q", "bins_in_doubt", "m", "r2", "gamma", "r2_wanted", "gain_promised", "gain_measured"];

/// What decides whether the map pays, and whether it did, over passes.
fn guarded(
    page: &mut Page,
    first: &Runner<'_>,
    auto: &Runner<'_>,
    insights: &[Insight],
    lessons: &[Learned],
) -> Data {
    let mut data = Data::new(&GUARD);
    let mut rows = Vec::new();
    let mut before = [0.0; 3];
    for ((theirs, ours), insight) in first.history.iter().zip(&auto.history).zip(insights) {
        let light = |moment: &Moment| moment.times.light.as_secs_f64();
        let visibility = |moment: &Moment| moment.times.visibility.as_secs_f64();
        // What the map itself costs: light samples beyond those that as many rays cost without it, and lessons.
        let usual = light(theirs) * ours.rays as f64 / theirs.rays.max(1) as f64;
        let now = [light(ours) - usual, ours.learning, visibility(theirs)];
        let own = (now[0] - before[0]).max(0.0) + now[1] - before[1];
        let gamma = own / (now[2] - before[2]);
        before = now;
        let promised = lessons.iter().rev().find(|lesson| lesson.passes <= ours.passes);
        let promised = promised.map_or(f64::NAN, |lesson| lesson.promise);
        let measured = visibility(theirs) * theirs.error.powi(2) / (visibility(ours) * ours.error.powi(2));
        rows.push([
            f64::from(ours.passes),
            insight.part,
            insight.doubtful,
            insight.missed,
            insight.explained,
            gamma,
            4.0 * gamma / (1.0 + gamma).powi(2),
            promised,
            measured,
        ]);
    }
    for row in &rows {
        let numbers = row[1..].iter().map(|value| format!("{value:.6e}"));
        data.row(std::iter::once(row[0].to_string()).chain(numbers));
    }
    let curve = |column: usize| -> Vec<(f64, f64)> {
        rows.iter().map(|row| (row[0], row[column])).filter(|(_, value)| value.is_finite()).collect()
    };
    page.add(
        &Figure::new(
            "Does the map pay?",
            "R² is the part of the variance of visibility that guesses explain in cells with odds, γ what the map costs (lessons, \
             and light samples beyond the usual ones) against exact visibility, pass by pass. It pays where R² is above \
             4γ/(1 + γ)².",
        )
        .plot(
            Plot::new("", Axis::linear("passes"), Axis::linear("part"))
                .series(Series::new("R²", 0, curve(4)))
                .series(Series::new("γ", 1, curve(5)))
                .series(Series::new("4γ/(1 + γ)²", 2, curve(6)))
                .series(Series::new("q, samples asked for", 3, curve(1))),
        ),
    );
    page.add(
        &Figure::new(
            "Gain of visibility, promised and measured",
            "Promised by the last lesson, for passes to come; measured over all passes so far.",
        )
        .plot(
            Plot::new("", Axis::linear("passes"), Axis::linear("gain"))
                .series(Series::new("promised", 0, curve(7)))
                .series(Series::new("measured", 1, curve(8))),
        ),
    );
    page.add(
        &Figure::new(
            "What is left in doubt",
            format!("Bins of a light in doubt, of {BINS}, in cells with odds."),
        )
        .plot(Plot::new("", Axis::linear("passes"), Axis::linear("bins")).series(Series::new(
            "in doubt",
            0,
            curve(2),
        ))),
    );
    page.add(&Figure::new("Missed blockers", "m: how often a guess is wrong that looks certain.").plot(
        Plot::new("", Axis::linear("passes"), Axis::log("m")).series(Series::new(
            "m",
            0,
            curve(3).into_iter().filter(|point| point.1 > 0.0),
        )),
    ));
    page.data(FILES[4], "one line a pass");
    if let (Some(theirs), Some(ours)) = (first.history.last(), auto.history.last()) {
        let traced = 100.0 * ours.rays as f64 / theirs.rays.max(1) as f64;
        page.facts([
            (
                "shadow rays traced through the scene, of the first method's",
                format!("{} %", number(traced, 3)),
            ),
            ("before the first pass and between passes", format!("{} s", number(ours.learning, 3))),
        ]);
    }
    data
}

/// The gain of each class of pixels, by the time of one more pass over these alone.
fn class_gains(
    page: &mut Page,
    stage: &Stage<'_>,
    comparison: &Comparison,
    runners: &[Runner<'_>],
    classes: &[Class],
    images: &[Image],
    truth: &Image,
) -> Data {
    let mut data = Data::new(&["method", "class", "pixels", "seconds_a_pass", "rmse", "gain"]);
    let mut table = Table::new("Gain by class, visibility and light samples")
        .words("method")
        .numbers("lit")
        .numbers("dark")
        .numbers("penumbra");
    let product = |k: usize, class: Class| {
        // In turns, so that whoever else uses the machine disturbs all alike; the least time is the least disturbed.
        let time = (0..3)
            .map(|pass| runners[k].time_of(stage, comparison.passes + pass, |pixel| classes[pixel] == class))
            .fold(f64::INFINITY, f64::min);
        (time, rmse(&images[k], truth, |pixel| classes[pixel] == class))
    };
    let first: Vec<_> = CLASSES_OF_PIXELS.map(|(class, _)| product(0, class)).into();
    for (k, runner) in runners.iter().enumerate() {
        let mut row = vec![Entry::from(runner.method.name())];
        for (&(class, name), &(time, error)) in CLASSES_OF_PIXELS.iter().zip(&first) {
            let (its_time, its_error) = if k == 0 { (time, error) } else { product(k, class) };
            let gain = time * error * error / (its_time * its_error * its_error);
            let tone = if gain >= 1.0 { Tone::Good } else { Tone::Bad };
            row.push(if gain.is_finite() { Entry::number(gain, 3).tone(tone) } else { Entry::from("") });
            let pixels = classes.iter().filter(|&&other| other == class).count();
            data.row(
                [runner.method.name().to_owned(), name.to_owned(), pixels.to_string()]
                    .into_iter()
                    .chain([its_time, its_error, gain].map(|value| format!("{value:.6e}"))),
            );
        }
        table.row(row);
    }
    page.add(&table);
    page.prose(
        "Squared errors are of all passes; times of one more pass over the pixels of the class alone, after the last lesson. \
         Where neither is ever wrong there is no gain to tell.",
    );
    page.data(FILES[2], "a line for each method and class");
    data
}

/// Where the time goes, and what the classes are.
fn costs(page: &mut Page, comparison: &Comparison, runners: &[Runner<'_>], classes: &[Class]) {
    let (width, height) = comparison.size;
    let passes = f64::from(comparison.passes);
    let values: Vec<Vec<f64>> = runners
        .iter()
        .map(|runner| {
            let mut values = vec![f64::NAN; width as usize * height as usize];
            for (tile, seconds) in runner.film.tiles().iter().zip(&runner.tiles) {
                let tile = tile.tile();
                let each = seconds / (tile.len() as f64 * passes) * 1e6;
                for (x, y) in (0..tile.len()).map(|pixel| tile.position(pixel)) {
                    values[(y * width + x) as usize] = each;
                }
            }
            values
        })
        .collect();
    let most = values.iter().flatten().fold(1e-9f64, |most, &value| most.max(value));
    let mut gallery = Gallery::new(
        "Cost",
        "Time of visibility and light samples, for a pixel and pass; by tiles, since questions are asked by tiles.",
    )
    .ramp(0.0, most, "µs");
    for (runner, values) in runners.iter().zip(&values) {
        let name = runner.method.name();
        gallery.picture(name, Picture::new(&heat(values, width, height, 0.0, most), 0.0, name));
    }
    page.add(&gallery);
    let shades = |class: Class| match class {
        Class::Lit => [0.9, 0.8, 0.3],
        Class::Dark => [0.02, 0.02, 0.1],
        Class::Penumbra => [0.7, 0.1, 0.1],
        Class::Empty => [0.2; 3],
    };
    let image = Image::from_fn(width, height, |x, y| shades(classes[(y * width + x) as usize]));
    let mut gallery =
        Gallery::new("Classes", "Yellow is lit, black is dark, red is penumbra, grey has no light to get.");
    gallery.picture("by 64 exact rays to the lights", Picture::new(&image, 0.0, "classes of pixels"));
    page.add(&gallery);
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
