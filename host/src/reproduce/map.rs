//! `reproduce map`: the thesis' occlusion map, its result table, and what it gets wrong.

mod ways;

use super::{Halted, Leg, Reproduced, Run};
use crate::accel::{Accel, Quality};
use crate::clock;
use crate::error::Error;
use crate::film::{Image, Tile};
use crate::generate::{Kind, generate};
use crate::integrator::{Exact, MapOptions, PreparedMap, Questions, Stage, Visibility, questions};
use crate::light::{AreaLight, lights};
use crate::page::{
    Axis, Cell, Data, Entry, Figure, Line, Page, Picture, Plot, Series, Strip, Table, Tone, number,
};
use crate::photons::BlockerKind;
use crate::render::{Limits, Rendered, render};
use crate::sampler::Pattern;
use crate::scene::{CameraRequest, Frame, Scene, load};
use occlude_kernel::lanes::{Task, dispatch, level_name};
use occlude_kernel::photons::{Class, Nearest, Photons};
use occlude_kernel::{Counts, Native};
use rayon::prelude::*;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
pub use ways::check_scenes;
use ways::{Maps, OPTIMISED, PLAIN, ROUNDS, Recipe, TREELETS, Way, ways};

/// The command, by which its pages know each other.
pub const MAKER: &str = "occlude reproduce map";

/// The files of data beside the page.
pub const FILES: [&str; 5] = ["map.csv", "photons.csv", "calls.csv", "rounds.csv", "why.csv"];

const KINDS: [Kind; 4] = [Kind::Spheres, Kind::City, Kind::Forest, Kind::Sponge];

/// Photons looked up, of the wrong calls.
const KS: [usize; 4] = [10, 20, 50, 100];

/// Shadow rays that say what a call should have been.
const TRUTH: u32 = 64;

struct Size {
    pixels: (u32, u32),
    triangles: usize,
    rays: u32,
    reference_rays: u32,
    lines: u64,
    counts: &'static [u64],
    runs: u32,
}

const WHOLE: Size = Size {
    pixels: (240, 150),
    triangles: 50_000,
    rays: 64,
    reference_rays: 4096,
    lines: 250_000,
    counts: &[1_000, 4_000, 16_000, 64_000, 250_000, 1_000_000],
    runs: 2,
};
const QUICK: Size = Size {
    pixels: (96, 60),
    triangles: 5_000,
    rays: 32,
    reference_rays: 1024,
    lines: 50_000,
    counts: &[1_000, 8_000, 64_000],
    runs: 2,
};

/// The thesis' table: variant, scene, seconds and millions of tests of the map, and of the map with stochastic
/// visibility.
const THESIS: [(&str, u32, [f64; 4]); 7] = [
    ("plain", 1, [68.0, 1957.0, 63.0, 1610.0]),
    ("plain", 2, [62.0, 1194.0, 58.0, 885.0]),
    ("plain", 3, [133.0, 4028.0, 126.0, 3074.0]),
    ("optimised", 1, [85.0, 2007.0, 98.0, 2336.0]),
    ("optimised", 2, [260.0, 264.0, 299.0, 299.0]),
    ("optimised", 3, [224.0, 4131.0, 314.0, 4198.0]),
    ("optimised", 4, [90.0, 1762.0, 107.0, 1945.0]),
];

/// What a way did.
struct Measured {
    image: Image,
    rmse: f64,
    seconds: f64,
    counts: Counts,
}

/// A scene and what its picture should be.
struct Setting {
    scene: Scene,
    accel: Accel,
    lights: Vec<AreaLight>,
    frame: Frame,
    size: (u32, u32),
    reference: Image,
    exposure: f32,
}

impl Setting {
    fn new(run: &Run<'_>, mut scene: Scene, size: &Size) -> Result<Self, Halted> {
        let camera = scene
            .camera
            .as_mut()
            .ok_or_else(|| Error::Usage(format!("the scene {} has no camera", scene.name)))?;
        (camera.width, camera.height) = size.pixels;
        let frame = camera.frame();
        let (accel, lights) = (Accel::build(&scene, Quality::Medium), lights(&scene));
        let reference = Image::default();
        let mut setting = Self { scene, accel, lights, frame, size: size.pixels, reference, exposure: 0.0 };
        setting.reference = setting.render(run, &Exact, size.reference_rays)?.film.develop();
        let mut bright: Vec<f32> = setting.reference.pixels.iter().map(|p| p[1]).collect();
        bright.sort_unstable_by(f32::total_cmp);
        let high = bright.get(bright.len() * 9 / 10).copied().unwrap_or(1.0);
        setting.exposure = if high > 0.0 { -(high / 0.8).log2() } else { 0.0 };
        Ok(setting)
    }

    fn stage(&self, run: &Run<'_>, shadow_rays: u32, count: bool) -> Stage<'_> {
        Stage {
            scene: &self.scene,
            bvh: self.accel.bvh(),
            lights: &self.lights,
            eye: self.scene.camera.map(|camera| camera.eye).unwrap_or_default(),
            camera: &self.frame,
            shadow_rays,
            pattern: Pattern::Lattice,
            seed: run.seed,
            level: run.level,
            count,
        }
    }

    fn render(&self, run: &Run<'_>, method: &dyn Visibility, rays: u32) -> Result<Rendered, Halted> {
        self.pass(run, method, rays, false)
    }

    fn pass(
        &self,
        run: &Run<'_>,
        method: &dyn Visibility,
        rays: u32,
        count: bool,
    ) -> Result<Rendered, Halted> {
        let stage = self.stage(run, rays, count);
        let limits = Limits { passes: 1, time: None };
        let rendered = render(&stage, method, self.size, limits, run.threads, run.stop, |_| ())?;
        run.go_on()?;
        Ok(rendered)
    }

    fn prepare(&self, run: &Run<'_>, kind: BlockerKind, lines: u64, rounds: u32, k: usize) -> PreparedMap {
        let options = MapOptions {
            lines: Some(lines),
            rounds,
            k,
            radius: None,
            blockers: kind,
            quality: Quality::Medium,
        };
        PreparedMap::new(&self.stage(run, 1, false), &options)
    }

    fn measure(&self, run: &Run<'_>, way: &Way, maps: &Maps, size: &Size) -> Result<Measured, Halted> {
        self.ask(run, way.recipe.as_ref(), maps, (size.rays, size.runs))
    }

    /// Asks this many rays a pixel as a recipe says, so many times.
    fn ask(
        &self,
        run: &Run<'_>,
        recipe: Option<&Recipe>,
        maps: &Maps,
        (rays, runs): (u32, u32),
    ) -> Result<Measured, Halted> {
        maps.with(self, recipe, |method| {
            let counts = self.pass(run, method, rays, true)?.shadow_counts;
            let mut best: Option<(f64, Image)> = None;
            for _ in 0..runs {
                let timed = Timed { method, spent: AtomicU64::new(0) };
                let rendered = self.render(run, &timed, rays)?;
                let seconds = timed.spent.into_inner() as f64 * 1e-9;
                if best.as_ref().is_none_or(|(least, _)| seconds < *least) {
                    best = Some((seconds, rendered.film.develop()));
                }
            }
            let (seconds, image) = best.unwrap_or_default();
            Ok(Measured { rmse: rmse(&image, &self.reference), image, seconds, counts })
        })
    }

    /// The time that the look-ups of a pass take, summed over threads.
    fn look_ups(&self, run: &Run<'_>, prepared: &PreparedMap) -> f64 {
        let stage = self.stage(run, 64, false);
        let tiles: Vec<Tile> = Tile::cover(self.size.0, self.size.1, 32).collect();
        let photons = prepared.store.by_light();
        let look = |&tile: &Tile| {
            let asked = questions(&stage, tile, self.size.0, 0);
            let start = clock::of_thread();
            let called = dispatch(stage.level, Judge { prepared, photons: &photons, questions: &asked });
            (clock::of_thread() - start, called.len())
        };
        let times: Vec<(Duration, usize)> = tiles.par_iter().map(look).collect();
        times.iter().map(|(time, _)| time.as_secs_f64()).sum()
    }

    /// The difference of a picture: orange is too bright, blue is too dark.
    fn difference(&self, image: &Image, gain: f32) -> Image {
        let scale = gain * self.exposure.exp2();
        Image::from_fn(image.width, image.height, |x, y| {
            let at = (y * image.width + x) as usize;
            let off = scale * (image.pixels[at][1] - self.reference.pixels[at][1]);
            if off >= 0.0 { [off, 0.4 * off, 0.0] } else { [0.0, -0.4 * off, -off] }
        })
    }

    /// What the map calls each point and light, against the rays of a first pass.
    fn calls(&self, run: &Run<'_>, prepared: &PreparedMap) -> Calls {
        let rays = TRUTH * self.lights.len().clamp(1, 16) as u32;
        let stage = self.stage(run, rays, false);
        let (map, photons) = (prepared.visibility(), prepared.store.by_light());
        let tiles: Vec<Tile> = Tile::cover(self.size.0, self.size.1, 32).collect();
        let parts: Vec<Calls> = tiles
            .par_iter()
            .map(|&tile| {
                let asked = questions(&stage, tile, self.size.0, 0);
                let (mut truth, mut said) = (Vec::new(), Vec::new());
                Exact.estimate(&stage, &asked, &mut truth, &mut Counts::default());
                map.estimate(&stage, &asked, &mut said, &mut Counts::default());
                let judged = dispatch(stage.level, Judge { prepared, photons: &photons, questions: &asked });
                let mut calls = Calls::default();
                for (batch, called) in asked.batches.iter().zip(judged) {
                    let samples = batch.samples.start as usize..batch.samples.end as usize;
                    calls.add(called, &truth[samples.clone()], &said[samples]);
                }
                calls
            })
            .collect();
        parts.iter().fold(Calls::default(), Calls::and)
    }
}

/// A method, and the CPU time of its answers in ns, over all threads.
struct Timed<'a> {
    method: &'a dyn Visibility,
    spent: AtomicU64,
}

impl Visibility for Timed<'_> {
    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        let start = clock::of_thread();
        self.method.estimate(stage, questions, estimates, counts);
        self.spent.fetch_add((clock::of_thread() - start).as_nanos() as u64, Ordering::Relaxed);
    }
}

/// A call of the rule of three cases.
#[derive(Clone, Copy)]
enum Called {
    Lit,
    Dark,
    Penumbra,
    Unknown,
}

/// Calls all batches of a tile.
struct Judge<'a> {
    prepared: &'a PreparedMap,
    photons: &'a [Photons<'a, Native>],
    questions: &'a Questions,
}

impl Task for Judge<'_> {
    type Output = Vec<Called>;

    #[inline(always)]
    fn run<S: occlude_kernel::Simd>(self, simd: S) -> Vec<Called> {
        let mut slots = crate::photons::slots(self.prepared.k());
        let mut nearest = Nearest::new(self.prepared.k(), &mut slots).expect("room for k");
        let mut room = vec![0; 8192];
        let mut called = Vec::new();
        for batch in &self.questions.batches {
            let point = &self.questions.points[batch.point as usize];
            let place = self.prepared.place(batch.light as usize, point.x, point.normal);
            let photons = self.photons[batch.light as usize].on(simd);
            called.push(match photons.classify(&place, &mut nearest, &mut room) {
                Class::Lit => Called::Lit,
                Class::Dark => Called::Dark,
                Class::Penumbra(_) => Called::Penumbra,
                Class::Unknown => Called::Unknown,
            });
        }
        called
    }
}

/// How right the calls were.
#[derive(Clone, Copy, Debug, Default)]
struct Calls {
    all: u64,
    lit: u64,
    dark: u64,
    penumbra: u64,
    unknown: u64,
    wrongly_lit: u64,
    wrongly_dark: u64,
    /// Sums over lit and dark calls of the visibility that is missed or added.
    off: f64,
    /// Of rays of penumbrae: blocked, and of these let through.
    blocked: u64,
    missed: u64,
}

impl Calls {
    fn add(&mut self, called: Called, truth: &[f32], said: &[f32]) {
        let visible = truth.iter().filter(|&&v| v > 0.5).count();
        let share = visible as f64 / truth.len().max(1) as f64;
        self.all += 1;
        match called {
            Called::Lit => {
                self.lit += 1;
                self.wrongly_lit += u64::from(visible < truth.len());
                self.off += 1.0 - share;
            }
            Called::Dark => {
                self.dark += 1;
                self.wrongly_dark += u64::from(visible > 0);
                self.off += share;
            }
            Called::Penumbra => {
                self.penumbra += 1;
                self.blocked += (truth.len() - visible) as u64;
                self.missed += truth.iter().zip(said).filter(|(t, s)| **t < 0.5 && **s > 0.5).count() as u64;
            }
            Called::Unknown => self.unknown += 1,
        }
    }

    fn and(self, other: &Self) -> Self {
        Self {
            all: self.all + other.all,
            lit: self.lit + other.lit,
            dark: self.dark + other.dark,
            penumbra: self.penumbra + other.penumbra,
            unknown: self.unknown + other.unknown,
            wrongly_lit: self.wrongly_lit + other.wrongly_lit,
            wrongly_dark: self.wrongly_dark + other.wrongly_dark,
            off: self.off + other.off,
            blocked: self.blocked + other.blocked,
            missed: self.missed + other.missed,
        }
    }

    /// Of the points and lights called lit or dark, the share where a ray says otherwise.
    fn wrong(&self) -> f64 {
        (self.wrongly_lit + self.wrongly_dark) as f64 / (self.lit + self.dark).max(1) as f64
    }

    /// The same of all points and lights.
    fn wrong_of_all(&self) -> f64 {
        (self.wrongly_lit + self.wrongly_dark) as f64 / self.all.max(1) as f64
    }

    /// The mean error of visibility over all points and lights, by calls of lit and dark.
    fn error(&self) -> f64 {
        self.off / self.all.max(1) as f64
    }

    /// Of the rays of penumbrae that something blocks, those that nothing named blocks.
    fn missed(&self) -> f64 {
        self.missed as f64 / self.blocked.max(1) as f64
    }
}

fn rmse(image: &Image, reference: &Image) -> f64 {
    let square = |(a, b): (&[f32; 3], &[f32; 3])| -> f64 {
        (0..3).map(|c| (f64::from(a[c]) - f64::from(b[c])).powi(2)).sum()
    };
    let sum: f64 = image.pixels.iter().zip(&reference.pixels).map(square).sum();
    (sum / (3 * image.pixels.len()).max(1) as f64).sqrt()
}

/// Time, tests and error of two ways, from and to.
fn ratios(from: &Measured, to: &Measured) -> [(f64, f64); 3] {
    let tests = |m: &Measured| m.counts.triangle_tests.max(1) as f64;
    [(from.seconds, to.seconds), (tests(from), tests(to)), (from.rmse, to.rmse)]
}

fn percent(share: f64) -> String {
    format!("{} %", number(100.0 * share, 3))
}

/// A change in per cent, with its sign.
fn change(from: f64, to: f64) -> Entry {
    if to == from {
        return "0 %".into();
    }
    let change = 100.0 * (to / from - 1.0);
    let text = format!("{}{} %", if change < 0.0 { "−" } else { "+" }, number(change.abs(), 2));
    Entry::from(text).tone(if change < 0.0 { Tone::Good } else { Tone::Bad })
}

/// Runs everything and makes the page. `folder` holds scenes of files; those not there are left out, and named.
pub fn map(run: &Run<'_>, folder: Option<&Path>) -> Result<Reproduced, Halted> {
    let start = Instant::now();
    let size = if run.quick { QUICK } else { WHOLE };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(run.threads)
        .build()
        .map_err(|error| Error::Usage(format!("cannot start {} threads: {error}", run.threads)))?;
    let mut scenes: Vec<Scene> = KINDS.iter().map(|&kind| generate(kind, run.seed, size.triangles)).collect();
    let (own, skipped) = ways::own(folder);
    for path in &own {
        scenes.push(load(path, &CameraRequest::default())?);
    }
    let mut page = Page::new(
        MAKER,
        "The occlusion map",
        "Photons shot through everything say where it is lit, where it is dark, and what may be in the way \
         in between; shadow rays ask only that. The second half of Niels Billen’s thesis, run again: its \
         table beside ours, and what the map gets wrong.",
    );
    let (ways, remedies) = ways();
    let place = |name: &str| remedies.iter().position(|remedy| remedy.name == name).expect("one of them");
    let pairs = [("plain", 0), ("optimised", place(OPTIMISED)), ("with treelets", place(TREELETS))]
        .map(|(name, row)| (name, remedies[row].map.unwrap_or(0), remedies[row].terms));
    let mut data =
        Data::new(&["scene", "triangles", "method", "visibility_s", "triangle_tests", "node_tests", "rmse"]);
    let mut photon_data = Data::new(&[
        "scene",
        "lines",
        "rounds",
        "rmse",
        "wrong_calls",
        "visibility_error",
        "missed_blockers",
    ]);
    let mut round_data = Data::new(&[
        "scene",
        "lines",
        "k",
        "rounds",
        "lit",
        "dark",
        "penumbra",
        "unknown",
        "wrong_of_all",
        "visibility_error",
        "missed_blockers",
        "preparing_s",
    ]);
    let mut why_data =
        Data::new(&["scene", "rays", "one_by_one", "method", "visibility_s", "look_ups_s", "triangle_tests"]);
    let mut call_data = Data::new(&[
        "scene",
        "k",
        "points_and_lights",
        "lit",
        "dark",
        "penumbra",
        "unknown",
        "wrongly_lit",
        "wrongly_dark",
        "wrong_calls",
        "visibility_error",
        "bound",
    ]);
    let shown = || ways.iter().filter(|way| way.shown).map(|way| way.name.clone());
    let mut strip = Strip::new(
        format!("The pictures, at {} shadow rays a pixel", size.rays),
        "Below each: the difference to the reference, four times as bright; orange is too bright, blue too dark.",
        std::iter::once("Reference".to_owned()).chain(shown()),
    );
    let mut bias = Strip::new(
        "What is lost: bias of the map",
        "With as many shadow rays as the reference, and the same, so that there is no noise: what is left is \
         bias. Orange: light where a blocker was missed or a point was called lit. Blue: a point called dark \
         that is not, or one whose photons lie on another surface. Sixteen times as bright.",
        ["Reference", "Map of triangles", "Map of treelets", "Triangles, adaptive photons and boxes"]
            .map(str::to_owned),
    );
    let mut results = Table::new(format!(
        "Time of visibility, tests of rays against triangles, and error, at {} shadow rays a pixel",
        size.rays
    ))
    .words("method")
    .numbers("visibility, ms")
    .numbers("triangle tests, millions")
    .numbers("node tests, millions")
    .numbers("RMSE");
    let mut signs =
        Table::new("Change of time and of tests by stochastic visibility: the thesis’ table, and ours")
            .words("variant")
            .words("scene")
            .numbers("time")
            .numbers("triangle tests")
            .numbers("RMSE");
    signs.group("Thesis (its scenes, its machine)");
    for (variant, scene, [t, i, ts, is]) in THESIS {
        signs.row([Entry::from(variant), scene.to_string().into(), change(t, ts), change(i, is), "".into()]);
    }
    signs.group("Here");
    let mut wrong =
        Table::new("Calls of lit or dark, where one of 64 shadow rays to the light says otherwise")
            .words("scene")
            .numbers("k")
            .numbers("lit")
            .numbers("dark")
            .numbers("penumbra")
            .numbers("wrong of lit and dark")
            .numbers("mean error of visibility")
            .numbers("1/(e(k + 1))");
    let mut errors =
        Plot::new("Error of the picture", Axis::log("lines shot"), Axis::log("RMSE / RMSE at fewest"));
    let mut misses =
        Plot::new("Missed blockers", Axis::log("lines shot"), Axis::log("share of blocked rays, %"));
    let mut apart = Table::new("Even photons, and as many in rounds: what is wrong")
        .words("scene")
        .numbers("lines")
        .numbers("k")
        .numbers("wrong calls, of all: even")
        .numbers("in rounds")
        .numbers("missed blockers: even")
        .numbers("in rounds")
        .numbers("called penumbra: even")
        .numbers("in rounds");
    let mut why =
        Table::new("The plain variant: what stochastic visibility changes, and what that can be worth")
            .words("rays")
            .numbers("look-ups, of the map’s time")
            .numbers("tests")
            .numbers("worth at most, of the time")
            .numbers("time")
            .numbers("time but look-ups");
    let headed = |title: String| {
        Table::new(title)
            .words("remedy")
            .numbers("map: time")
            .numbers("tests")
            .numbers("RMSE")
            .numbers("map + stochastic: time")
            .numbers("tests")
            .numbers("RMSE")
    };
    let mut by_scene = headed("Changes by each remedy, against plain, in each scene".into());
    // Logarithms of the changes, summed over scenes.
    let mut changes = vec![[0.0f64; 6]; remedies.len()];
    // Of our pairs: fewer tests, less time and more error.
    let mut tally = [[0u32; 3]; 3];
    // Of the plain one, with rays together, more of them, and one by one: less time, and less but for look-ups.
    let mut parts = [[0u32; 3]; 2];
    // The greatest share of the time that is no look-up.
    let mut shares = [0.0f64; 3];
    // Of even photons and of those in rounds: cases, fewer wrong calls, fewer missed.
    let mut better = [0u32; 3];
    let mut worst_call = (0.0f64, String::new());
    let mut above = 0;
    let many = scenes.len();
    for (s, scene) in scenes.into_iter().enumerate() {
        let name = scene.name.clone();
        let leg = Leg::new(run, s as f64 / many as f64, (s + 1) as f64 / many as f64);
        leg.at(0.0, &format!("{name}: reference"))?;
        let setting = Setting::new(run, scene, &size)?;
        let triangles = setting.scene.triangles.len() as u64;
        leg.at(0.2, &format!("{name}: the methods"))?;
        let shoot = |kind, lines, rounds, k| pool.install(|| setting.prepare(run, kind, lines, rounds, k));
        let treelets = BlockerKind::Treelet(128);
        let maps = pool.install(|| Maps::new(&setting, run, &size));
        let mut measured = Vec::new();
        for way in &ways {
            measured.push(setting.measure(run, way, &maps, &size)?);
        }
        results.group(format!("{name}, {triangles} triangles"));
        for (way, m) in ways.iter().zip(&measured) {
            results.row([
                Entry::from(way.name.as_str()),
                Entry::number(m.seconds * 1e3, 3),
                Entry::number(m.counts.triangle_tests as f64 * 1e-6, 3),
                Entry::number(m.counts.node_tests as f64 * 1e-6, 3),
                Entry::number(m.rmse, 3),
            ]);
            data.row([
                Cell::from(name.as_str()),
                triangles.into(),
                way.name.as_str().into(),
                m.seconds.into(),
                (m.counts.triangle_tests).into(),
                (m.counts.node_tests).into(),
                m.rmse.into(),
            ]);
        }
        for (p, &(variant, map, terms)) in pairs.iter().enumerate() {
            let (map, terms) = (&measured[map], &measured[terms]);
            let (tests, with) = (map.counts.triangle_tests as f64, terms.counts.triangle_tests as f64);
            tally[p][0] += u32::from(with < tests);
            tally[p][1] += u32::from(terms.seconds < map.seconds);
            tally[p][2] += u32::from(terms.rmse > map.rmse);
            signs.row([
                Entry::from(variant),
                name.as_str().into(),
                change(map.seconds, terms.seconds),
                change(tests, with),
                change(map.rmse, terms.rmse),
            ]);
        }
        by_scene.group(name.as_str());
        let (plain_map, plain_terms) = (&measured[pairs[0].1], &measured[pairs[0].2]);
        for (remedy, sums) in remedies.iter().zip(&mut changes) {
            let mut row = vec![Entry::from(remedy.name)];
            let with = [remedy.map.map(|map| (plain_map, map)), Some((plain_terms, remedy.terms))];
            for (column, with) in with.into_iter().enumerate() {
                let Some((plain, with)) = with else {
                    row.extend([Entry::from(""), "".into(), "".into()]);
                    continue;
                };
                for (i, (from, to)) in ratios(plain, &measured[with]).into_iter().enumerate() {
                    sums[3 * column + i] += (to / from).ln();
                    row.push(change(from, to));
                }
            }
            if remedy.name != "plain" {
                by_scene.row(row);
            }
        }

        leg.at(0.4, &format!("{name}: why"))?;
        let asked =
            |recipe: Recipe, rays: u32, runs: u32| setting.ask(run, Some(&recipe), &maps, (rays, runs));
        let alone = Recipe { alone: true, ..Recipe::default() };
        let terms = |recipe: Recipe| Recipe { terms: Some(PLAIN), ..recipe };
        let looks = (0..size.runs).map(|_| pool.install(|| setting.look_ups(run, maps.of(&alone))));
        let looked = looks.fold(f64::INFINITY, f64::min);
        let many = 4 * size.rays;
        let plain = Recipe::default();
        let (map_many, terms_many) = (asked(plain, many, size.runs)?, asked(terms(plain), many, size.runs)?);
        let (map_alone, terms_alone) =
            (asked(alone, size.rays, size.runs)?, asked(terms(alone), size.rays, size.runs)?);
        let cases = [
            (size.rays, false, plain_map, plain_terms),
            (many, false, &map_many, &terms_many),
            (size.rays, true, &map_alone, &terms_alone),
        ];
        for (rays, one_by_one, map, terms) in cases {
            for (method, m) in [("map", map), ("map + stochastic", terms)] {
                why_data.row([
                    Cell::from(name.as_str()),
                    u64::from(rays).into(),
                    u64::from(one_by_one).into(),
                    method.into(),
                    m.seconds.into(),
                    looked.into(),
                    m.counts.triangle_tests.into(),
                ]);
            }
        }
        why.group(name.as_str());
        for (i, (rays, one_by_one, map, terms)) in cases.into_iter().enumerate() {
            let (tests, with) = (map.counts.triangle_tests as f64, terms.counts.triangle_tests as f64);
            let looks = looked.min(map.seconds).min(terms.seconds);
            let rest = (map.seconds - looks, terms.seconds - looks);
            parts[0][i] += u32::from(terms.seconds < map.seconds);
            parts[1][i] += u32::from(rest.1 < rest.0);
            shares[i] = shares[i].max(rest.0 / map.seconds);
            let worth = (with / tests - 1.0) * rest.0 / map.seconds;
            why.row([
                Entry::from(format!("{rays}{}", if one_by_one { ", one by one" } else { "" })),
                percent(looks / map.seconds).into(),
                change(tests, with),
                change(1.0, 1.0 + worth),
                change(map.seconds, terms.seconds),
                change(rest.0, rest.1),
            ]);
        }

        let exposure = setting.exposure;
        let picture = |image: &Image, words: String| Picture::new(image, exposure, words);
        let reference = || picture(&setting.reference, format!("{name}, exact and converged"));
        let visible = || ways.iter().zip(&measured).filter(|(way, _)| way.shown);
        let pictures = visible().map(|(way, m)| {
            picture(&m.image, format!("{name}, {}", way.name)).under(format!("RMSE {}", number(m.rmse, 3)))
        });
        strip.row(name.as_str(), std::iter::once(reference()).chain(pictures));
        let differences = visible().map(|(way, m)| {
            let words = format!("{name}, {}: difference to the reference", way.name);
            Picture::new(&setting.difference(&m.image, 4.0), 0.0, words)
        });
        strip.row("difference", std::iter::once(reference()).chain(differences));

        leg.at(0.5, &format!("{name}: bias"))?;
        let mut biased = vec![reference()];
        let remedied = Recipe { rounds: true, boxes: true, ..plain };
        for recipe in [plain, Recipe { treelets: true, ..plain }, remedied] {
            let image = maps.with(&setting, Some(&recipe), |map| {
                Ok(setting.render(run, map, size.reference_rays)?.film.develop())
            })?;
            let words = format!("{name}: bias of the map");
            let off = rmse(&image, &setting.reference);
            let shown = Picture::new(&setting.difference(&image, 16.0), 0.0, words);
            biased.push(shown.under(format!("RMSE by bias alone {}", number(off, 3))));
        }
        bias.row(name.as_str(), biased);

        leg.at(0.65, &format!("{name}: calls"))?;
        for k in KS {
            let prepared = shoot(treelets, size.lines, 1, k);
            let calls = pool.install(|| setting.calls(run, &prepared));
            run.go_on()?;
            let bound = 1.0 / (std::f64::consts::E * (k as f64 + 1.0));
            above += u32::from(calls.error() > bound);
            if calls.error() / bound > worst_call.0 {
                worst_call = (calls.error() / bound, format!("{name}, k = {k}"));
            }
            let share = |part: u64| percent(part as f64 / calls.all.max(1) as f64);
            wrong.row([
                Entry::from(name.as_str()),
                k.to_string().into(),
                share(calls.lit).into(),
                share(calls.dark).into(),
                share(calls.penumbra).into(),
                percent(calls.wrong()).into(),
                Entry::from(percent(calls.error())).tone(if calls.error() > bound {
                    Tone::Bad
                } else {
                    Tone::Good
                }),
                percent(bound).into(),
            ]);
            call_data.row([
                Cell::from(name.as_str()),
                (k as u64).into(),
                calls.all.into(),
                calls.lit.into(),
                calls.dark.into(),
                calls.penumbra.into(),
                calls.unknown.into(),
                calls.wrongly_lit.into(),
                calls.wrongly_dark.into(),
                calls.wrong().into(),
                calls.error().into(),
                bound.into(),
            ]);
        }
        leg.at(0.75, &format!("{name}: rounds"))?;
        for lines in [size.lines / 8, size.lines] {
            for k in [50, 10] {
                let called = [1, ROUNDS].map(|rounds| {
                    let start = Instant::now();
                    let prepared = shoot(BlockerKind::Triangle, lines, rounds, k);
                    let seconds = start.elapsed().as_secs_f64();
                    let calls = pool.install(|| setting.calls(run, &prepared));
                    let of_all = calls.wrong_of_all();
                    round_data.row([
                        Cell::from(name.as_str()),
                        lines.into(),
                        (k as u64).into(),
                        u64::from(rounds).into(),
                        calls.lit.into(),
                        calls.dark.into(),
                        calls.penumbra.into(),
                        calls.unknown.into(),
                        of_all.into(),
                        calls.error().into(),
                        calls.missed().into(),
                        seconds.into(),
                    ]);
                    calls
                });
                run.go_on()?;
                let [even, later] = &called;
                better[0] += 1;
                better[1] += u32::from(later.wrong_of_all() <= even.wrong_of_all());
                better[2] += u32::from(later.missed() <= even.missed());
                let of = |calls: &Calls| calls.penumbra as f64 / calls.all.max(1) as f64;
                let toned = |even: f64, later: f64| {
                    let entry = Entry::from(percent(later));
                    if later > even { entry.tone(Tone::Bad) } else { entry.tone(Tone::Good) }
                };
                apart.row([
                    Entry::from(name.as_str()),
                    lines.to_string().into(),
                    k.to_string().into(),
                    percent(even.wrong_of_all()).into(),
                    toned(even.wrong_of_all(), later.wrong_of_all()),
                    percent(even.missed()).into(),
                    toned(even.missed(), later.missed()),
                    percent(of(even)).into(),
                    percent(of(later)).into(),
                ]);
            }
        }

        leg.at(0.85, &format!("{name}: photons"))?;
        let mut first = f64::NAN;
        for rounds in [1, ROUNDS] {
            let (mut line, mut missed) = (Vec::new(), Vec::new());
            for &lines in size.counts {
                let prepared = shoot(treelets, lines, rounds, 50);
                let image = setting.render(run, &prepared.visibility(), size.rays)?.film.develop();
                let off = rmse(&image, &setting.reference);
                let calls = pool.install(|| setting.calls(run, &prepared));
                run.go_on()?;
                if first.is_nan() {
                    first = off;
                }
                line.push((lines as f64, off / first));
                if calls.missed > 0 {
                    missed.push((lines as f64, 100.0 * calls.missed()));
                }
                photon_data.row([
                    Cell::from(name.as_str()),
                    lines.into(),
                    u64::from(rounds).into(),
                    off.into(),
                    calls.wrong().into(),
                    calls.error().into(),
                    calls.missed().into(),
                ]);
            }
            let (label, kind) = match rounds {
                1 => (name.clone(), Line::Solid),
                _ => (format!("{name}, in rounds"), Line::Dashed),
            };
            errors = errors.series(Series::new(label.as_str(), s, line).line(kind));
            misses = misses.series(Series::new(label.as_str(), s, missed).line(kind));
        }
    }
    let mut ablation =
        headed(format!("Changes by each remedy, against plain: geometric means of {many} scenes"));
    for (remedy, sums) in remedies.iter().zip(&changes).skip(1) {
        let mut row = vec![Entry::from(remedy.name)];
        for (i, sum) in sums.iter().enumerate() {
            let there = i >= 3 || remedy.map.is_some();
            row.push(if there { change(1.0, (sum / many as f64).exp()) } else { "".into() });
        }
        ablation.row(row);
    }
    let [plain, optimised, with_treelets] = tally;
    page.in_short(format!(
        "Stochastic visibility over what photons name needs fewer triangle tests in {} of {many} scenes in \
         the plain variant (thesis: 3 of 3) and in {} of {many} in the optimised one (thesis: 0 of 4); it \
         takes less time in {} (thesis: 3 of 3) and {} (0 of 4), and its error is larger in {} and {}.",
        plain[0], optimised[0], plain[1], optimised[1], plain[2], optimised[2],
    ));
    page.in_short(format!(
        "With subtrees of the scene’s tree in place of trees for each point, and test rays for each cell, it needs \
         fewer tests in {} of {many} and takes less time in {}.",
        with_treelets[0], with_treelets[1]
    ));
    page.in_short(format!(
        "As many photons, shot in {ROUNDS} rounds, make no more wrong calls in {} of {} cases, and miss no more \
         blockers in {}.",
        better[1], better[0], better[2]
    ));
    page.in_short(format!(
        "The mean error of visibility by wrong calls of lit and dark is above 1/(e(k + 1)) in {above} of {} \
         cases; the most, {} times it, at {}.",
        many * KS.len(),
        number(worst_call.0, 2),
        worst_call.1
    ));
    page.section("The table");
    page.prose(&format!(
        "Scenes: four that this program generates{}. {} lines from the lights, 50 photons looked up, the sum \
         *Balanced*. *Plain*: photons name triangles, and all that are named are tested, without a tree; \
         two random halves, each term as likely. *Optimised*, the thesis’ last variant: adaptive photons in {ROUNDS} \
         rounds, volumetric occluders, blockers sorted by distance and cut in two, a tree built over each half for each \
         point and light (over all of them where rays ask both), and importance from 64 test rays for each point and \
         light, whose tests count. *With treelets*: photons name subtrees of at most 128 triangles of the scene’s own \
         tree, so that no tree is built, and test rays are asked once for each cell of a grid over the map. Time is CPU time \
         of visibility, trees included, summed over threads, the least of {} runs; photons are shot before.",
        match skipped.len() {
            0 => format!(", and {} of the repository", ways::own_names()),
            _ => format!(
                "; {} of the repository left out, since they were not found: --scenes FOLDER says where",
                skipped.join(" and ")
            ),
        },
        size.lines,
        size.runs,
    ));
    page.add(&signs);
    page.prose(
        "Where the optimised variant needs more tests than in the thesis’ column, it is the test rays: 64 of them ask both \
         halves for every point and light of a penumbra, and beside as few samples as here they outweigh the samples \
         themselves. Where it needs fewer, the trees have done it: a tree over a half passes over most of it whatever \
         the term. And the column that the thesis’ table does not have: one random term of a sum has a variance that \
         exact rays do not have, so at an equal number of rays the error grows.",
    );
    page.heading("Why plain time has another sign");
    page.prose(&format!(
        "In the thesis’ plain variant time fell by 0.22 to 0.41 of the share by which tests fell: a test was worth that \
         much of its time. Here most of the time is that of looking up photons, whatever is asked afterwards, and all that is \
         not, put down to tests, is at most {} of it with {} rays, {} with {} and {} with {} traced one by one, as the \
         thesis traced them. So fewer tests can save no more than the column *worth at most*. Against it stand \
         drawing halves, a random number and a term for each ray, and gathering the rays that ask each half. \
         Time falls in {} and {} of {many} scenes with rays that are asked of eight triangles at once, and in {} with \
         rays one by one; look-ups left out, in {} and {}, and in {}.",
        percent(shares[0]),
        size.rays,
        percent(shares[1]),
        4 * size.rays,
        percent(shares[2]),
        size.rays,
        parts[0][0],
        parts[0][1],
        parts[0][2],
        parts[1][0],
        parts[1][1],
        parts[1][2],
    ));
    page.add(&why);
    page.data("why.csv", "times and tests of this table");
    page.section("Each remedy alone, and all together");
    page.prose(
        "Against plain, without and with stochastic visibility. Boxes inside closed meshes block what no photon named. \
         Adaptive photons name more, so lists are longer, and fewer points count as lit or dark. Trees and treelets leave \
         out most of a list; treelets hold triangles that no photon named, too. Importance as the thesis has it gives \
         each term the probability of its contribution: its terms are 0 or ±1, and for *Inclusion–exclusion* that has \
         exactly the variance of equal probabilities, so it cannot gain; for *Balanced*, whose terms are −1/3 and 2/3, it is not the best either. What it \
         costs is the test rays, and for each cell they are few. An RMSE here is noise of the rays and bias together; \
         with stochastic visibility it is mostly noise.",
    );
    page.add(&ablation);
    page.folded("In each scene", &by_scene);
    page.add(&strip);
    page.add(&results);
    page.data("map.csv", "the numbers of this table");
    page.section("How often the three cases are wrong");
    page.prose(
        "If each of k photons is a light photon with the probability V that the point sees a point of the \
         light, all of them are with V^{k}, and calling it lit errs by 1 − V: on average by V^{k}(1 − V) at \
         most, which is about 1/(e(k + 1)), for the worst V. The mean over a picture should be well below \
         it, since few points have the worst V. Where it is above, the photons are not those of the point: \
         they were found on a disc around it, and thin shadows are narrower than the disc. A wrong call is \
         one where at least one of the rays says otherwise, whatever it is worth. Rays are 64 a light on average; \
         points and lights are those of one pass over the picture. Few photons make few wrong calls, since \
         k of them then lie far apart, and almost every point counts as penumbra: it is missed blockers that \
         they cost, see below.",
    );
    page.add(&wrong);
    page.data("calls.csv", "the numbers of this table");
    page.section("Photons against error");
    page.add(
        &Figure::new(
            "More photons",
            "Map of treelets, 50 photons looked up; dashed: in rounds. Left: the error of the picture, noise of the shadow rays \
             included, relative to that with the fewest photons. Right: of the rays in penumbrae that \
             something blocks, those that no named blocker blocks.",
        )
        .plot(errors)
        .plot(misses),
    );
    page.data(
        "photons.csv",
        "error, wrong calls and missed blockers of each number of lines, evenly and in rounds",
    );
    page.heading("Photons in rounds");
    page.prose(&format!(
        "Half of the lines leave evenly; the others in {} rounds from those cells of emission, place on the light times \
         direction, whose photons so far see lit and dark neighbours, or name blockers that few of their neighbours name. \
         Photons that are denser here than there say nothing by their number, so the rule counts even ones only: later \
         ones join those that are as near as the k-th, turn lit or dark into penumbra, and add names. So k even photons \
         must be found among half as many lines, on a disc of twice the area, and more points count as penumbra: that is \
         the price. Photons name triangles here.",
        ROUNDS - 1
    ));
    page.add(&apart);
    page.data("rounds.csv", "the numbers of this table");
    page.section("What is lost, and why");
    page.prose(
        "Two things are lost, and more light samples repair neither. A point whose photons are all of one kind is \
         called lit or dark, and the thin shadow or slit of light between the photons is gone. And in a penumbra \
         what no photon crossed is not asked, so its shadow is missing: triangles, being small, are missed \
         more often than treelets, which hold their neighbours too. The last column has the thesis’ remedies: volumetric \
         occluders block what a list lacks where the blocker is closed, and adaptive photons find more of the list where \
         it is asked.",
    );
    page.add(&bias);
    let foot = format!(
        "Made by `{MAKER}{}` of Occlude {} in {:.0} s: {} threads, {}, seed {}. All but the times comes out \
         the same whatever the number of threads.",
        if run.quick { " --quick" } else { "" },
        env!("CARGO_PKG_VERSION"),
        start.elapsed().as_secs_f64(),
        pool.current_num_threads(),
        level_name(run.level),
        run.seed,
    );
    let data = vec![
        ("map.csv", data),
        ("photons.csv", photon_data),
        ("calls.csv", call_data),
        ("rounds.csv", round_data),
        ("why.csv", why_data),
    ];
    Ok(Reproduced { page, foot, data })
}
