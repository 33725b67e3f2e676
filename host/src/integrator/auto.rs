//! The occlusion map that learns: rays go where shadows begin and end, and the picture is right on average.
//!
//! Before the first pass, some camera rays say which cells the picture needs ([`occlude_kernel::occlusion_map`]), and a
//! shaft proves some of them lit. Each pass is rendered against the map as it is. What its rays saw is counted, in
//! whole numbers, so that no order of threads matters, and between passes the counts become new odds.
//!
//! With odds, shadow rays go to the lights, and to the parts of a light, where there is doubt; no point gets more of them
//! than it would without a map, on average. Cells in which that does not help are left alone, and when all are such,
//! the map sleeps, and costs nothing any more.
//!
//! Beside the map, each pixel remembers what it saw of each light ([`past`]). That takes the noise out of light that
//! nothing blocks, and shares a point's rays among the bins of a light where a border crosses few of them. And it says how
//! far each light of each pixel is in doubt: the rays of a pass go to lights and pixels by that, from those that are lit
//! or dark all around to penumbrae, and by the root of what arrives there at most. Rays in penumbrae take longer, so a
//! pass has somewhat fewer than it would have without a map.
//!
//! Where neither promises anything, in pictures that are penumbra all over and alike, all is left to the exact method, but
//! for points whose rays are their own.
//!
//! Cells are of one size, some pixels across, and keep no lists of what may block there. Both were measured (AVX-512, Zen 5).
//! With the best of four sizes for each of ten scenes, 64 rays would gain 4.2 in the mean instead of 4.0; the sizes by themselves,
//! 2, 4, 8 and 16 pixels, gain 3.7, 4.0, 3.8 and 3.6. Tiles that were handed what their shafts had found the time before, complete
//! lists and subtrees, took 0.98 of the time with 16 rays a point and 1.01 with 64 (six scenes), and those that were handed
//! the triangles learned the time before 1.00: finding them anew costs no more than keeping them.

mod draws;
mod heard;
mod kinds;
mod past;
mod prove;
mod saved;
mod seed;

pub use saved::{SavedMap, fingerprint};

use self::draws::{Bins, Draws};
use self::heard::{Gain, Hear, tallied, tally};
pub(super) use self::kinds::Kind;
use self::kinds::Variances;
use self::past::{Nearby, Past};
use self::prove::Prove;
use self::saved::SavedCell;
use self::seed::Photons;
use super::{
    Batch, CameraSample, NOBODY, Questions, Scratch, Share, Stage, Visibility, cast, exact, expect, round,
    sample_lights, sums,
};
use crate::film::Tile;
use crate::photons::{BlockerSet, Shower};
use crate::sampler::Sampler;
use glam::Vec3;
use occlude_kernel::lanes::dispatch;
use occlude_kernel::occlusion_map::{
    BINS, CellKey, Demand, Doubts, Known, LEAST_CHANCE, MapCell, OcclusionMap, Rates, Tally,
};
use occlude_kernel::{Counts, Ray, TileScratch, offset};
use rayon::prelude::*;
use std::collections::HashMap;
use std::f32::consts::FRAC_1_PI;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, RwLock};

/// How the map is made.
#[derive(Clone, Copy, Debug)]
pub struct AutoOptions {
    /// Pixels across a cell, at least: cells have edges of one to two times that many. If not given, 4 for 64 shadow rays
    /// of a camera sample or more, and up to 8 for fewer, so that cells hear of as many.
    pub cell: Option<f32>,
    /// Photons to shoot before the first pass; if not given, some where a point has few shadow rays, and else none.
    pub photons: Option<u64>,
    /// Bytes that cells, and what pixels remember, may take.
    pub memory: usize,
}

impl Default for AutoOptions {
    fn default() -> Self {
        Self { cell: None, photons: None, memory: 256 << 20 }
    }
}

/// Pixels across a cell that hears of so many shadow rays of each camera sample.
fn pixels_across(shadow_rays: u32) -> f32 {
    (32.0 / (shadow_rays.max(1) as f32).sqrt()).clamp(4.0, 8.0)
}

/// Bytes of a cell, with what is counted for it.
const CELL_BYTES: usize = size_of::<MapCell>() + BINS * size_of::<AtomicU64>() + 24;

/// Bytes of so many cells, with the table that finds them.
fn bytes_of(cells: usize) -> usize {
    let table = if cells > 0 { OcclusionMap::table(cells) } else { 0 };
    cells * CELL_BYTES + table * size_of::<u32>()
}

/// Rays at random where the map is not sure, and none where it is.
#[derive(Debug, Default)]
pub struct Auto {
    options: AutoOptions,
    map: RwLock<Map>,
    /// Points of cells that there are not, or beyond the bounds of a cell that is lit.
    strays: Mutex<Vec<Stray>>,
    /// How far this pass' guesses are off.
    doubts: Mutex<Doubts>,
    /// What pixels of each kind saw in it.
    kinds: Mutex<kinds::Seen>,
    /// What was learned before.
    before: Option<SavedMap>,
    /// Whether it goes on learning where it is no help.
    restless: bool,
}

/// What the map knew after a pass, by the points that ask it.
#[derive(Clone, Copy, Debug)]
pub struct Learned {
    /// Passes so far.
    pub passes: u32,
    /// Cells.
    pub cells: usize,
    /// The part of all points of a light that is proven lit.
    pub lit: f64,
    /// That has odds.
    pub odds: f64,
    /// That is left to the exact method for good.
    pub left_alone: f64,
    /// Where there are odds, the part of the usual samples that is asked for,
    pub part: f64,
    /// and the mean variance of V - u, by bins.
    pub doubt: f64,
    /// How many times better than the exact method visibility is thought to be, at equal error.
    pub promise: f64,
    /// Whether the map helps so little that it is not asked any more.
    pub asleep: bool,
}

fn points_of(map: &Map, which: impl Fn(&MapCell) -> bool) -> f64 {
    let counts = |(cell, &points): (&MapCell, &u32)| if which(cell) { f64::from(points) } else { 0.0 };
    map.cells.iter().zip(&map.points).map(counts).sum()
}

#[derive(Clone, Copy, Debug)]
struct Stray {
    key: CellKey,
    origin: Vec3,
    normal: Vec3,
}

impl Stray {
    /// For an order that does not depend on who came first.
    fn order(&self) -> (CellKey, [u32; 3]) {
        (self.key, self.origin.to_array().map(f32::to_bits))
    }
}

#[derive(Debug)]
struct Map {
    cells: Vec<MapCell>,
    table: Vec<u32>,
    /// Asked and free, a word for each bin of each cell.
    tallies: Vec<AtomicU64>,
    /// Points of the first look, which stand for how often a cell is asked.
    points: Vec<u32>,
    /// How often a cell may still be tried to be proven lit.
    tries: Vec<u8>,
    /// Cells that were lit before they grew.
    before: Vec<(usize, MapCell)>,
    /// The angle of a pixel, and pixels across a cell.
    angle: f32,
    cell: f32,
    /// How far guesses were off.
    doubts: Doubts,
    /// And what follows from that.
    rates: Rates,
    /// How much better than the exact method it is thought to be.
    promise: f64,
    /// Is it no help at all?
    asleep: bool,
    /// Samples of a light that a point sees, on average.
    samples: f64,
    passes: u32,
    /// Strays that a tile may report, so that they take no more memory than the cells may.
    most_strays: usize,
    /// About what a shadow ray costs, ns.
    ray: f64,
    /// Is there room for no more cells?
    full: bool,
    /// What was known after each lesson.
    history: Vec<Learned>,
    /// By the first column and row of a tile: what its pixels have seen of each light.
    pasts: HashMap<[u32; 2], Mutex<TilePast>>,
    /// What pixels of each kind saw, and what follows from that.
    kinds: kinds::Seen,
    variances: Variances,
    /// What weights are multiplied with, so that a pass takes about as long as usual; none before the first.
    scale: Option<f32>,
    /// The most that a light sends, for weights near 1.
    brightest: f32,
    /// Is everything left to the exact method?
    plain: bool,
    /// Shadow rays of a pixel so far.
    seen: u64,
    /// Of how many lights there is room for that.
    remembered: usize,
    /// Bytes that are left for cells.
    room: usize,
}

impl Default for Map {
    fn default() -> Self {
        Self {
            cells: Vec::new(),
            table: Vec::new(),
            tallies: Vec::new(),
            points: Vec::new(),
            tries: Vec::new(),
            before: Vec::new(),
            angle: 0.0,
            cell: 0.0,
            doubts: Doubts::default(),
            rates: Rates::each(1.0),
            promise: 1.0,
            asleep: false,
            samples: 0.0,
            passes: 0,
            most_strays: 0,
            ray: 4.0,
            full: false,
            history: Vec::new(),
            pasts: HashMap::new(),
            kinds: kinds::Seen::default(),
            variances: Variances::default(),
            scale: None,
            brightest: 1.0,
            plain: false,
            seen: 0,
            remembered: 0,
            room: 0,
        }
    }
}

/// How often a cell is tried to be proven lit, at most.
const TRIES: u8 = 4;

/// What it costs to look a point up, and to think of a light there, ns; and of each sample.
const CONSIDERED: f64 = 250.0;
const SAMPLED: f64 = 5.0;

/// What it costs more to draw a sample from a cell's density, and to take what is known from it.
const DRAWN: f64 = 3.0;

/// What well spread samples leave of the variance that bins have by themselves, times the root of their number: a border
/// crosses few of a point's bins, but many of a cell's.
const SPREAD: f64 = 0.5;

/// With fewer samples of a light than this, what each point of a light sends is not worth a closer look.
const FEW: u32 = 8;

/// Photons for each cell.
const PHOTONS: u64 = 4;

/// What is known of all lights of a point.
#[derive(Default)]
struct Told {
    /// Whether that is anything.
    changed: bool,
    /// Samples that lights are due by their doubt.
    sum: f32,
    /// What the usual samples cost, and those that are due.
    costs: [f32; 2],
}

/// What a sample costs where nothing is in doubt, in units of one in a penumbra. Measured: rays there take a tenth to a half
/// of the time, light samples as long.
const LEAST_COST: f32 = 0.25;

impl Told {
    /// Adds a light that would get so many samples, and that is so much in doubt.
    fn add(&mut self, usual: f32, doubt: f32) {
        self.changed |= doubt < 1.0;
        self.sum += usual * doubt;
        let cost = doubt.max(LEAST_COST);
        self.costs[0] += usual * cost;
        self.costs[1] += usual * doubt * cost;
    }
}

/// At a first look a point asks one in so many of its usual rays, of a generator of its own.
const PILOT: u32 = 2;
const PILOT_KEY: u64 = 0x510e_527f_ade6_82d1;

/// A light gets no more than so many times the usual number of samples, and by doubt no less than one in so many. Together
/// with the odds of a cell no part of it gets less than one in [`LEAST_CHANCE`], so no weight is more than that many times
/// what it would be.
const MOST_MORE: f32 = 8.0;

/// Nor more than this, unless that is usual: what a tile asks is in memory at once.
const MOST_RAYS: f32 = 2048.0;

/// How much brighter or darker than others a point may count as.
const BRIGHTNESS: [f32; 2] = [1.0 / 64.0, 8.0];

/// The weight of a point by what arrives there at most: the root, between what is best for the squared error of light,
/// about the power 0.8, and what is best for that of its logarithm, 0.
fn brightness(stage: &Stage<'_>, diffuse: Vec3, shares: &[Share], brightest: f32) -> f32 {
    let sent = |share: &Share| stage.lights[share.light as usize].radiance * share.unshadowed;
    let arrives = (shares.iter().map(sent).sum::<Vec3>() * diffuse).element_sum() / brightest;
    // Not a number counts as dark.
    if arrives.sqrt() > BRIGHTNESS[0] { arrives.sqrt().min(BRIGHTNESS[1]) } else { BRIGHTNESS[0] }
}

/// What a tile remembers.
#[derive(Debug, Default)]
struct TilePast {
    /// Of each pixel and light, pixel by pixel.
    pasts: Vec<Past>,
    /// Of the pass at hand.
    needs: Needs,
}

/// What the points of a pass need, in whole numbers, so that sums do not depend on their order.
#[derive(Clone, Copy, Debug, Default)]
struct Needs {
    /// What the usual samples cost, and those that are due to doubt and brightness.
    costs: [u64; 2],
    /// What was seen of the error.
    gain: Gain,
    /// Whether rays were the points' own. Who shares them out counts on what is known of lights, and goes on having it.
    firm: bool,
}

/// Rays of a pixel before it is known what it needs.
const TELLING: u64 = 64;

/// Needs are counted in these parts.
const NEED: f32 = 4096.0;

/// The variance has to fall by this where cells promise less than that: rays in doubt are dearer, and what was seen says a bit
/// too much. (Soup sees 1.3, of which its passes need 1.2; forest and hair see 1.6.)
const MUCH: f64 = 1.4;
const SOME: f64 = 1.2;

/// Passes before promises of cells are held against that.
const PATIENCE_WITH_ODDS: u32 = 3;

impl Needs {
    /// Adds a point.
    fn add(&mut self, told: &Told, bright: f32) {
        self.costs[0] += (told.costs[0] * NEED) as u64;
        self.costs[1] += (told.costs[1] * bright * NEED) as u64;
    }

    fn merge(&mut self, other: &Self) {
        self.costs[0] += other.costs[0];
        self.costs[1] += other.costs[1];
        self.gain.merge(&other.gain);
        self.firm |= other.firm;
    }

    /// What to multiply weights with, so that samples cost about as much as usual.
    fn scale(&self) -> f32 {
        let [usual, due] = self.costs;
        if due > 0 { usual as f32 / due as f32 } else { 1.0 }
    }
}

fn lock(pasts: &Mutex<TilePast>) -> MutexGuard<'_, TilePast> {
    pasts.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

/// What a pixel of a tile has seen of a light; of so many lights there is something to remember.
#[inline(always)]
fn past_of<'a>(
    pasts: &'a mut Option<MutexGuard<'_, TilePast>>,
    pixel: u32,
    light: u32,
    lights: usize,
) -> Option<&'a mut Past> {
    let light = Some(light as usize).filter(|&light| light < lights)?;
    pasts.as_mut()?.pasts.get_mut(pixel as usize * lights + light)
}

impl Map {
    /// What the pixels of a tile have seen.
    fn pasts_of(&self, place: [u32; 2]) -> Option<MutexGuard<'_, TilePast>> {
        self.pasts.get(&place).map(lock)
    }

    /// Asks some rays at the points of a first look, so that pixels know about what they will see: those in between what
    /// these saw that are next to them. Says what the points need.
    ///
    /// What these rays saw is no part of the picture, and their random numbers are their own.
    fn pilot(&self, stage: &Stage<'_>, scratch: &mut Scratch) -> Needs {
        let mut needs = Needs::default();
        let rays = stage.shadow_rays / PILOT;
        let Some(mut pasts) = self.pasts_of(scratch.questions.place).filter(|_| rays >= FEW / 2) else {
            return needs;
        };
        scratch.draw_anew(PILOT_KEY);
        scratch.questions.points.iter_mut().for_each(|point| point.rays = rays);
        sample_lights(stage, scratch);
        scratch.questions.points.iter_mut().for_each(|point| point.rays = stage.shadow_rays);
        let Scratch { questions, estimates, shares, .. } = scratch;
        exact::trace(&Stage { count: false, ..*stage }, &[], questions, estimates, &mut Counts::default());
        let lights = self.remembered;
        let pasts = &mut pasts.pasts;
        for batch in questions.batches.iter().filter(|batch| (batch.light as usize) < lights) {
            let samples = batch.samples.start as usize..batch.samples.end as usize;
            let estimates = &estimates[samples.clone()];
            let [all, free] = sums(&questions.weights[samples], estimates, |w, v| [w, w * v]);
            let pixel = questions.points[batch.point as usize].pixel as usize;
            if let Some(past) = pasts.get_mut(pixel * lights + batch.light as usize) {
                let v = (free / all).min(1.0);
                past.foresee(v, 1.0 / PILOT as f32);
                past.vary(v, estimates.len() as f32);
            }
        }
        past::spread(pasts, questions.width as usize, lights);
        for point in &questions.points {
            expect(stage, point, shares);
            let mut told = Told::default();
            for share in shares.iter() {
                let light = share.light as usize;
                let near = Nearby::new(pasts, questions.width, point.pixel, light, lights);
                told.add(share.expected, near.map_or(1.0, |near| near.doubt(&self.variances)));
            }
            let bright = brightness(stage, point.diffuse, shares, self.brightest);
            needs.add(&told, bright);
        }
        needs
    }

    fn view(&self) -> OcclusionMap<'_> {
        if self.table.is_empty() {
            return OcclusionMap::EMPTY;
        }
        OcclusionMap::new(&self.cells, &self.table).expect("a table of these cells")
    }

    fn key(&self, eye: Vec3, x: Vec3, normal: Vec3, light: u32) -> Option<CellKey> {
        let size = x.distance(eye) * self.angle * self.cell;
        CellKey::new(x, normal, CellKey::level(size), light)
    }

    fn tally(&self, cell: usize) -> [Tally; BINS] {
        std::array::from_fn(|bin| tally(self.tallies[cell * BINS + bin].load(Ordering::Relaxed)))
    }

    fn count(&self, place: usize, free: bool) {
        self.tallies[place].fetch_add(tallied(free), Ordering::Relaxed);
    }

    /// Takes in what was learned before, as far as there is room.
    fn remember(&mut self, saved: &SavedMap) {
        let room = (0..saved.cells.len()).take_while(|&before| bytes_of(before + 1) <= self.room).count();
        self.full = saved.cells.len() > room;
        for SavedCell { cell, points, tallies } in saved.cells.iter().take(room) {
            self.cells.push(*cell);
            self.points.push(*points);
            self.tries.push(TRIES);
            let words = tallies.iter().map(|tally| u64::from(tally.asked) << 32 | u64::from(tally.free));
            self.tallies.extend(words.map(AtomicU64::new));
        }
        for cell in &mut self.cells {
            cell.forget();
        }
        self.passes = saved.passes;
        self.doubts = saved.doubts;
        self.kinds = saved.kinds;
        self.variances = saved.kinds.variances();
        self.table.resize(OcclusionMap::table(self.cells.len()), OcclusionMap::FREE);
        OcclusionMap::index(&self.cells, &mut self.table);
    }

    /// Makes room for points that have none.
    fn take_in(&mut self, mut strays: Vec<Stray>, stage: &Stage<'_>) {
        strays.par_sort_unstable_by_key(Stray::order);
        let clearance = stage.bvh.clearance();
        let known = self.cells.len();
        self.before.clear();
        for group in strays.chunk_by(|a, b| a.key == b.key) {
            let key = group[0].key;
            let found = if self.table.is_empty() { None } else { self.view().find(key) };
            let index = match found {
                Some(index) => index,
                None if bytes_of(self.cells.len() + 1) > self.room => {
                    self.full = true;
                    continue;
                }
                None => {
                    let normal: Vec3 = group.iter().map(|stray| stray.normal).sum();
                    self.cells.push(MapCell::new(key, normal));
                    self.points.push(0);
                    self.tries.push(TRIES);
                    self.cells.len() - 1
                }
            };
            let cell = &mut self.cells[index];
            if cell.is_lit() {
                self.before.push((index, *cell));
            }
            group.iter().for_each(|stray| cell.add(stray.origin));
            let size = group[0].origin.distance(stage.eye) * self.angle;
            cell.widen(if index < known { 0.5 * size } else { 2.0 * size }, 0.25 * clearance);
            self.points[index] += group.len() as u32;
        }
        self.tallies.resize_with(self.cells.len() * BINS, AtomicU64::default);
        self.table.resize(OcclusionMap::table(self.cells.len()), OcclusionMap::FREE);
        OcclusionMap::index(&self.cells, &mut self.table);
    }

    /// Tries to prove cells lit that may be.
    fn prove(&mut self, stage: &Stage<'_>) {
        let tallies = &self.tallies;
        let dark = |index: usize| {
            tallies[index * BINS..][..BINS].iter().any(|word| {
                let word = word.load(Ordering::Relaxed);
                word >> 32 != word & 0xffff_ffff
            })
        };
        self.cells.par_iter_mut().zip(&mut self.tries).enumerate().with_min_len(64).for_each_init(
            || Box::new(TileScratch::new()),
            |scratch, (index, (cell, tries))| {
                if *tries == 0 || cell.is_lit() || dark(index) {
                    return;
                }
                *tries -= 1;
                let Some(light) = stage.lights.get(cell.key().light() as usize) else { return };
                let corners = cell.corners();
                let lit = dispatch(stage.level, Prove { bvh: stage.bvh, light, corners: &corners, scratch });
                if lit {
                    cell.set_lit();
                } else {
                    *tries = 0;
                }
            },
        );
        // Those that were lit in narrower bounds stay so.
        for (index, before) in self.before.drain(..) {
            if !self.cells[index].is_lit() {
                self.cells[index] = before;
                self.tries[index] = 0;
            }
        }
    }

    /// Turns what was counted into odds.
    fn learn(&mut self) {
        let this = &*self;
        let expected: Vec<_> = (0..this.cells.len())
            .into_par_iter()
            .with_min_len(256)
            .map(|index| if this.cells[index].is_lit() { None } else { MapCell::expect(&this.tally(index)) })
            .collect();
        let spread = (SPREAD / self.samples.max(1.0).sqrt()).min(1.0);
        self.rates = self.doubts.rates(spread as f32);
        // What is asked for, weighed by how often cells are asked.
        let mut demand = Demand::default();
        let mut unknown = 0.0;
        for ((cell, expected), &points) in self.cells.iter().zip(&expected).zip(&self.points) {
            match expected {
                None if cell.is_lit() => {}
                None => unknown += f64::from(points),
                Some(expected) => demand.add(expected, f64::from(points), &self.rates),
            }
        }
        let overhead = CONSIDERED / (self.samples * (self.ray + SAMPLED));
        self.rates.choose(&demand, unknown, overhead);
        self.doubts.fade();
        let rates = self.rates;
        let cells = self.cells.par_iter_mut().zip(&expected).with_min_len(256);
        cells.for_each(|(cell, expected)| cell.learn(expected.as_ref(), &rates));
        self.weigh();
    }

    /// Leaves alone what the exact method does better.
    fn weigh(&mut self) {
        let (samples, ray) = (self.samples, self.ray);
        let exact_time = samples * (ray + SAMPLED);
        let (mut time, mut error) = (0.0, 0.0);
        let (mut odds, mut part, mut doubt) = (0.0, 0.0, 0.0);
        let (mut all, mut exact_error, mut decided) = (0.0, 0.0, 0.0);
        for (cell, &points) in self.cells.iter_mut().zip(&self.points) {
            let points = f64::from(points);
            all += points;
            if cell.is_lit() {
                decided += points;
                continue;
            }
            let [left, usual] = cell.errors().map(f64::from);
            exact_error += points * usual;
            if cell.is_known() {
                decided += points;
                let known_time = CONSIDERED + (exact_time + samples * DRAWN) * f64::from(cell.part());
                let hopeless = known_time * left > HOPELESS * exact_time * usual;
                if !(self.passes >= FOR_GOOD && hopeless && cell.part() > 0.8) {
                    time += points * known_time;
                    error += points * left;
                    odds += points;
                    part += points * f64::from(cell.part());
                    doubt += points * usual / f64::from(self.rates.spread());
                    continue;
                }
                cell.set_all();
            }
            time += points * exact_time;
            error += points * usual;
        }
        self.promise = all * exact_time * exact_error / (time * error).max(f64::MIN_POSITIVE);
        if self.passes >= FOR_GOOD && self.promise < AWAKE && (decided > 0.5 * all || self.passes >= PATIENCE)
        {
            self.asleep = true;
        }
        self.history.push(Learned {
            passes: self.passes,
            cells: self.cells.len(),
            lit: points_of(self, |cell| cell.is_lit()) / all.max(1.0),
            left_alone: points_of(self, |cell| cell.known([f32::NAN; 3]) == Known::All) / all.max(1.0),
            odds: odds / all.max(1.0),
            part: part / odds.max(1.0),
            doubt: doubt / odds.max(1.0),
            promise: self.promise,
            asleep: self.asleep,
        });
    }

    /// About what a shadow ray costs where not all is lit, ns: from the tests of some rays and not from a clock, so that
    /// pictures do not depend on who else uses the machine, and rounded to a quarter of an octave, so that a bit more
    /// or less of rounding in a box test does not matter. Fitted to the times of ten scenes of 8 to 10^5 triangles.
    fn probe(&mut self, strays: &[Stray], stage: &Stage<'_>) {
        let view = self.view();
        let unproven = |stray: &&Stray| view.find(stray.key).is_none_or(|cell| !view.cells()[cell].is_lit());
        let mut counts = Counts::default();
        for (k, stray) in (0..).zip(strays.iter().step_by(strays.len() / PROBES + 1).filter(unproven)) {
            let light = &stage.lights[stray.key.light() as usize];
            let mut sampler = Sampler::from_key(stage.seed ^ k);
            let y = light.point([sampler.uniform(), sampler.uniform()]);
            let y = offset(y, light.normal, stage.bvh.clearance());
            stage.bvh.occluded(&Ray::segment(stray.origin, y), None, &mut counts);
        }
        let each = |count: u64| count as f64 / counts.rays.max(1) as f64;
        let tests = each(counts.node_tests) + each(counts.triangle_tests);
        let cost = (0.2 * tests.powf(1.4)).max(3.0);
        self.ray = 2f64.powf((4.0 * cost.log2()).round() / 4.0);
    }
}

/// Rays to see what rays cost.
const PROBES: usize = 4096;

/// Is it counted what a point's rays see? Always at first, and later of every second and of every fourth one: where rays
/// are cheap, counting costs as much as they do.
fn heard(point: u32, passes: u32) -> bool {
    let every = [1, 1, 1, 2, 2, 2, 2, 2].get(passes as usize).copied().unwrap_or(4);
    point.wrapping_add(passes).is_multiple_of(every)
}

/// Passes before guesses are put to use: in the first there are none, and the second shows how far they are off.
const TRIAL: u32 = 2;

/// Passes before cells that are all doubt are left alone.
const FOR_GOOD: u32 = 2;

/// Passes before the map sleeps though it has seen too little to tell.
const PATIENCE: u32 = 8;

/// A cell is left alone if its product of work and squared error is thought to be more than this part of the exact
/// method's.
const HOPELESS: f64 = 0.75;

/// And the whole picture if the map is thought to be no more than this many times better.
const AWAKE: f64 = 1.05;

impl Auto {
    /// With nothing known yet.
    pub fn new(options: AutoOptions) -> Self {
        Self { options, ..Self::default() }
    }

    /// With what was learned before. Whatever that is, even of another scene, pictures stay right on average; but it only
    /// helps with the same triangles and lights, and a camera near the same place: [`SavedMap::check`].
    pub fn with_saved(options: AutoOptions, saved: SavedMap) -> Self {
        Self { options, before: Some(saved), ..Self::default() }
    }

    /// One that never falls asleep, to learn for others.
    pub fn restless(self) -> Self {
        Self { restless: true, ..self }
    }

    /// What has been learned so far.
    pub fn save(&self, stage: &Stage<'_>) -> SavedMap {
        let map = self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner());
        let cells = map.cells.iter().zip(&map.points).enumerate();
        SavedMap {
            belongs_to: fingerprint(stage),
            passes: map.passes,
            // Of those that the size of its cells goes by.
            shadow_rays: self.before.as_ref().map_or(stage.shadow_rays, |before| before.shadow_rays),
            doubts: map.doubts,
            kinds: map.kinds,
            cells: cells
                .map(|(index, (&cell, &points))| SavedCell { cell, points, tallies: map.tally(index) })
                .collect(),
        }
    }

    /// What the map knew after each lesson.
    pub fn history(&self) -> Vec<Learned> {
        self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner()).history.clone()
    }

    /// Shows every cell, with the points of the first look that are in it.
    pub fn each_cell(&self, mut see: impl FnMut(&MapCell, u32)) {
        let map = self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner());
        map.cells.iter().zip(&map.points).for_each(|(cell, &points)| see(cell, points));
    }

    /// How far guesses were off of late, by how sure they were.
    pub fn doubts(&self) -> Doubts {
        self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner()).doubts
    }

    /// Bytes that the map takes.
    pub fn bytes(&self) -> usize {
        let map = self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner());
        let pixels: usize = map.pasts.values().map(|pasts| lock(pasts).pasts.len()).sum();
        bytes_of(map.cells.len()) + pixels * size_of::<Past>()
    }

    /// What is known of the light that the first camera sample of each pixel of a tile might get: the part that is
    /// proven lit, the part of the usual samples that is asked for, and how much of it the exact method is left with.
    pub fn survey(&self, stage: &Stage<'_>, tile: Tile, width: u32, scratch: &mut Scratch) -> Vec<[f32; 3]> {
        let map = self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner());
        let view = map.view();
        scratch.paths.clear();
        scratch.paths.extend((0..tile.len() as u32).map(|pixel| CameraSample::even(pixel, 0)));
        cast(&Stage { count: false, ..*stage }, tile, width, scratch);
        let mut seen = vec![[f32::NAN; 3]; tile.len()];
        for point in &scratch.questions.points {
            let (mut sums, mut total) = ([0.0; 3], 0.0f32);
            for (light, area) in (0..).zip(stage.lights) {
                let Some(unshadowed) = area.unshadowed(point.x, point.normal) else { continue };
                let key = map.key(stage.eye, point.x, point.normal, light);
                let cell = key.and_then(|key| view.find(key)).map(|cell| &view.cells()[cell]);
                let value = unshadowed * area.radiance.element_sum();
                total += value;
                let [lit, part, left] = match cell.map(|cell| (cell, cell.known(point.origin))) {
                    Some((_, Known::Lit)) => [1.0, 0.0, 0.0],
                    Some((cell, Known::Odds)) if !map.asleep => [0.0, cell.part(), 0.0],
                    _ => [0.0, 1.0, 1.0],
                };
                for (sum, add) in sums.iter_mut().zip([lit, part, left]) {
                    *sum += value * add;
                }
            }
            if total > 0.0 {
                seen[point.pixel as usize] = sums.map(|sum| sum / total);
            }
        }
        seen
    }

    /// Lets somebody change what the map thinks, between passes. Whatever it thinks, pictures stay right on average, as
    /// long as no cell is called lit that is not.
    pub fn alter(&self, change: impl FnOnce(&mut [MapCell])) {
        let mut map = self.map.write().unwrap_or_else(|poisoned| poisoned.into_inner());
        change(&mut map.cells);
    }

    /// Shoots photons at the cells, and counts which of them light reaches.
    fn seed(&self, map: &Map, stage: &Stage<'_>) {
        let few = f64::from(stage.shadow_rays) < PHOTONS_BELOW;
        let some = if few { (PHOTONS * map.cells.len() as u64).min(4_000_000) } else { 0 };
        let lines = self.options.photons.unwrap_or(some);
        if lines == 0 {
            return;
        }
        let blockers = BlockerSet::Triangles;
        let shower = Shower {
            bvh: stage.bvh,
            lights: stage.lights,
            blockers: &blockers,
            lines,
            seed: stage.seed,
            level: stage.level,
        };
        let firsts = shower.shares();
        let parts: Vec<(u32, Range<u64>)> = (0u32..)
            .zip(firsts.windows(2))
            .flat_map(|(light, lines)| {
                let (first, end) = (lines[0], lines[1]);
                (first..end).step_by(CHUNK as usize).map(move |from| (light, from..end.min(from + CHUNK)))
            })
            .collect();
        parts.into_par_iter().for_each(|(light, lines)| {
            dispatch(stage.level, Photons { map, stage, shower: &shower, light, lines });
        });
    }
}

/// With so many shadow rays, a pass tells more than photons would.
const PHOTONS_BELOW: f64 = 8.0;

/// Photons that a task shoots.
const CHUNK: u64 = 1024;

impl Visibility for Auto {
    fn begin(&self, stage: &Stage<'_>, tiles: &[Tile], width: u32) {
        let mut map = self.map.write().unwrap_or_else(|poisoned| poisoned.into_inner());
        let ahead = stage.camera.ray_direction(0.5 * width as f32, 0.5 * width as f32);
        let beside = stage.camera.ray_direction(0.5 * width as f32 + 1.0, 0.5 * width as f32);
        let most_strays = self.options.memory / size_of::<Stray>() / tiles.len().max(1);
        *map = Map { angle: (beside - ahead).length() / ahead.length(), most_strays, ..Map::default() };
        let sent = stage.lights.iter().map(|light| light.radiance.element_sum()).fold(0.0, f32::max);
        map.brightest = if sent > 0.0 && sent.is_finite() { sent } else { 1.0 };
        // Half of the memory is for the cells at least.
        let each = tiles.iter().map(|tile| tile.len()).sum::<usize>().max(1) * size_of::<Past>();
        map.remembered = (self.options.memory / 2 / each).min(stage.lights.len());
        map.room = self.options.memory - map.remembered * each;
        if map.remembered > 0 {
            let each = |tile: &Tile| vec![Past::default(); tile.len() * map.remembered];
            let pasts = |tile: &Tile| TilePast { pasts: each(tile), needs: Needs::default() };
            map.pasts = tiles.iter().map(|tile| ([tile.x, tile.y], Mutex::new(pasts(tile)))).collect();
        }
        // Those of a map that was made before are as large as they were.
        let rays = self.before.as_ref().map_or(stage.shadow_rays, |before| before.shadow_rays);
        map.cell = self.options.cell.unwrap_or_else(|| pixels_across(rays));
        if let Some(before) = &self.before {
            map.remember(before);
        }
        let found = &*map;
        // A look at every other pixel of every other row finds nearly all cells there are.
        let looks: Vec<(Vec<Stray>, usize, Needs)> = tiles
            .par_iter()
            .map_init(Scratch::default, |scratch, &tile| {
                scratch.paths.clear();
                let some = (0..tile.len() as u32).filter(|&pixel| {
                    let (x, y) = tile.position(pixel as usize);
                    x % 2 == 0 && y % 2 == 0
                });
                scratch.paths.extend(some.map(|pixel| CameraSample::even(pixel, 0)));
                cast(&Stage { count: false, ..*stage }, tile, width, scratch);
                let mut strays = Vec::new();
                for point in &scratch.questions.points {
                    let key = found.key(stage.eye, point.x, point.normal, 0);
                    for (light, area) in (0..).zip(stage.lights) {
                        if area.unshadowed(point.x, point.normal).is_some() {
                            let key = key.and_then(|key| key.with_light(light));
                            strays.extend(key.map(|key| Stray {
                                key,
                                origin: point.origin,
                                normal: point.normal,
                            }));
                        }
                    }
                }
                strays.truncate(most_strays);
                let points = scratch.questions.points.len();
                (strays, points, found.pilot(stage, scratch))
            })
            .collect();
        let mut needs = Needs::default();
        looks.iter().for_each(|look| needs.merge(&look.2));
        map.scale = (needs.costs[0] > 0).then(|| needs.scale());
        let points: usize = looks.iter().map(|look| look.1).sum();
        let strays: Vec<Stray> = looks.into_iter().flat_map(|look| look.0).collect();
        map.samples = f64::from(stage.shadow_rays) * points as f64 / strays.len().max(1) as f64;
        map.take_in(strays.clone(), stage);
        self.seed(&map, stage);
        map.prove(stage);
        map.probe(&strays, stage);
        map.learn();
        map.asleep &= !self.restless;
    }

    fn ask(&self, stage: &Stage<'_>, scratch: &mut Scratch) {
        let map = self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner());
        if map.plain {
            drop(map);
            return sample_lights(stage, scratch);
        }
        let view = map.view();
        let Scratch { samplers, questions, shares, square, fan, radiance, .. } = scratch;
        let mut pasts = map.pasts_of(questions.place);
        let mut strays = Vec::new();
        // Neighbours are in the same cells.
        let mut last = None;
        let mut found: Vec<Option<Option<usize>>> = vec![None; stage.lights.len()];
        let mut known: Vec<(Known, Option<usize>)> = Vec::new();
        let mut nearby: Vec<Option<Nearby>> = Vec::new();
        // Cells that are found late are of little use.
        let noting = (map.passes + 1).is_power_of_two();
        let mut needs = Needs::default();
        let mut usual: Vec<f32> = Vec::new();
        for index in 0..questions.points.len() {
            let point = questions.points[index];
            let sampler = &mut samplers[point.path as usize];
            expect(stage, &point, shares);
            known.clear();
            nearby.clear();
            let mut told = Told::default();
            usual.clear();
            usual.extend(shares.iter().map(|share| share.expected));
            if map.asleep {
                known.resize(shares.len(), (Known::All, None));
            } else {
                let place = map.key(stage.eye, point.x, point.normal, 0);
                if place != last {
                    last = place;
                    found.fill(None);
                }
                for share in shares.iter() {
                    let light = share.light;
                    let key = || place.and_then(|key| key.with_light(light));
                    let cell =
                        *found[light as usize].get_or_insert_with(|| key().and_then(|key| view.find(key)));
                    let thought = match cell.map(|cell| view.cells()[cell].known(point.origin)) {
                        Some(Known::Odds) if map.passes < TRIAL => Known::Nothing,
                        Some(thought) => thought,
                        None => Known::Nothing,
                    };
                    known.push((thought, cell));
                    if thought == Known::Lit {
                        continue;
                    }
                    let outside =
                        noting && cell.is_none_or(|cell| view.cells()[cell].is_lit() && map.tries[cell] > 0);
                    if outside && !(map.full && cell.is_none()) && strays.len() < map.most_strays {
                        let stray = |key| Stray { key, origin: point.origin, normal: point.normal };
                        strays.extend(key().map(stray));
                    }
                }
            }
            for (share, &mut (ref mut thought, cell)) in shares.iter_mut().zip(&mut known) {
                if !stage.lights[share.light as usize].is_apart(point.x) {
                    *thought = Known::All;
                }
                if *thought == Known::Lit {
                    nearby.push(None);
                    told.changed = true;
                    told.costs[0] += share.expected * LEAST_COST;
                    share.expected = 0.0;
                    continue;
                }
                let near = pasts.as_ref().and_then(|pasts| {
                    Nearby::new(
                        &pasts.pasts,
                        questions.width,
                        point.pixel,
                        share.light as usize,
                        map.remembered,
                    )
                });
                nearby.push(near);
                let doubt = near.map_or(1.0, |near| near.doubt(&map.variances));
                told.add(share.expected, doubt);
                share.expected *= doubt;
                // What a cell thinks of a border only adds noise to a pixel that has none; and of one that has not been
                // asked, its first samples tell more.
                let bordered = cell.is_some_and(|cell| !view.cells()[cell].is_flat());
                let many = share.expected >= FEW as f32;
                let no_border = |near: Nearby| near.own_is_sure() || (many && near.is_new());
                if *thought == Known::Odds && bordered && near.is_some_and(no_border) {
                    *thought = Known::Nothing;
                }
            }
            let bright = brightness(stage, point.diffuse, shares, map.brightest);
            needs.add(&told, bright);
            needs.firm |= point.firm;
            let mut scale = map.scale.map(|scale| scale * bright);
            if point.firm && told.sum > 0.0 {
                let unproven = known.iter().zip(&usual).filter(|((thought, _), _)| *thought != Known::Lit);
                // All of them, however little its lights are in doubt: where they are few, what is left of them would count
                // too much. And bright ones the more: without that the squared error is 1.17 times what it is, at 0.93 of the
                // time.
                let own = unproven.map(|(_, usual)| usual).sum::<f32>() / told.sum;
                scale = Some(scale.unwrap_or(own).max(own));
            }
            if let Some(scale) = scale {
                told.changed = true;
                for (share, usual) in shares.iter_mut().zip(&*usual) {
                    let due = share.expected * scale;
                    share.expected = if share.expected > 0.0 {
                        due.clamp(usual * (1.0 / MOST_MORE), (usual * MOST_MORE).min(usual.max(MOST_RAYS)))
                    } else {
                        0.0
                    };
                }
            }
            for ((share, (thought, cell)), usual) in shares.iter_mut().zip(&known).zip(&*usual) {
                if let (Known::Odds, Some(cell)) = (thought, cell) {
                    let cell = &view.cells()[*cell];
                    // With odds that differ a bin may have the least chance already.
                    let least = if cell.is_flat() { 1.0 / LEAST_CHANCE as f32 } else { cell.part() };
                    share.expected = (share.expected * cell.part()).max(usual * least);
                    told.changed = true;
                }
            }
            round(sampler, shares, (!told.changed).then_some(point.rays));
            for (((share, &(thought, cell)), near), &usual) in
                shares.iter().zip(&known).zip(&nearby).zip(&usual)
            {
                let area = &stage.lights[share.light as usize];
                let full = point.diffuse * area.radiance;
                let whole = if area.is_apart(point.x) { share.unshadowed * FRAC_1_PI } else { f32::NAN };
                if thought == Known::Lit {
                    radiance[point.path as usize] += full * whole;
                    continue;
                }
                let odds = cell.filter(|_| thought == Known::Odds).map(|cell| &view.cells()[cell]);
                let cell = cell.filter(|_| thought != Known::All && heard(index as u32, map.passes));
                if share.count == 0 {
                    if let Some(cell) = odds.filter(|cell| !cell.is_flat()) {
                        radiance[point.path as usize] += full * (cell.mean() * whole);
                    } else if !whole.is_nan()
                        && let Some(past) = past_of(&mut pasts, point.pixel, share.light, map.remembered)
                    {
                        radiance[point.path as usize] += full * past.unasked(whole, point.firm);
                    }
                    continue;
                }
                let mut open = whole;
                let kind = near.map_or(Kind::NEW, |near| near.kind());
                let near = near.filter(|_| thought != Known::Odds && whole.is_finite() && share.count >= FEW);
                let doubt = near.and_then(|near| near.bins(share.expected).map(|bins| (bins, near)));
                let first = questions.weights.len() as u32;
                square.clear();
                sampler.points(stage.pattern, share.count as usize, square);
                let closely = share.expected >= FEW as f32;
                let (each, clearance) = (share.each, stage.bvh.clearance());
                let point = &point;
                let drawn = if let Some((bins, near)) = doubt {
                    fan.resize(square.len());
                    let cell = &Bins::new(bins, near.mean());
                    let draws = Draws { cell, fan, closely, whole, area, point, square, each, clearance };
                    Some(dispatch(stage.level, draws))
                } else if let Some(cell) = odds.filter(|cell| !cell.is_flat()) {
                    fan.resize(square.len());
                    let draws = Draws { cell, fan, closely, whole, area, point, square, each, clearance };
                    Some(dispatch(stage.level, draws))
                } else {
                    fan.open(stage, area, point, square, each);
                    None
                };
                if let Some([known, had]) = drawn {
                    open = f32::INFINITY;
                    radiance[point.path as usize] += full * (known - had);
                }
                fan.append_to(questions);
                let last = questions.weights.len() as u32;
                if last > first {
                    fan.append_bins_to(&mut questions.bins);
                    questions.cells.push(cell.map_or(NOBODY, |cell| cell as u32));
                    questions.batches.push(Batch {
                        point: index as u32,
                        light: share.light,
                        samples: first..last,
                        share: share.count as f32 * share.each,
                    });
                    questions.wholes.push(open);
                    questions.usual.push(usual);
                    questions.kinds.push(kind);
                    // For all samples of the pass, before any of them adds to it.
                    questions.before.push(point.firm.then(|| {
                        let past = past_of(&mut pasts, point.pixel, share.light, map.remembered);
                        past.map_or(0.0, |past| past.mean())
                    }));
                } else if open.is_finite()
                    && let Some(past) = past_of(&mut pasts, point.pixel, share.light, map.remembered)
                {
                    radiance[point.path as usize] += full * past.unasked(whole, point.firm);
                }
            }
        }
        if let Some(pasts) = &mut pasts {
            pasts.needs.merge(&needs);
        }
        if !strays.is_empty() {
            self.strays.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).append(&mut strays);
        }
    }

    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        exact::trace(stage, &[], questions, estimates, counts);
        let map = self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner());
        if map.plain {
            return;
        }
        let mut pasts = map.pasts_of(questions.place);
        let pixels = &mut pasts;
        let heard = dispatch(stage.level, Hear { map: &map, stage, questions, estimates, pasts: pixels });
        if let Some(pasts) = &mut pasts {
            pasts.needs.gain.merge(&heard.gain);
        }
        if heard.kinds != kinds::Seen::default() {
            self.kinds.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).merge(&heard.kinds);
        }
        if heard.doubts != Doubts::default() {
            self.doubts.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).merge(&heard.doubts);
        }
    }

    fn passed(&self, stage: &Stage<'_>) {
        let mut map = self.map.write().unwrap_or_else(|poisoned| poisoned.into_inner());
        if map.plain {
            return;
        }
        let map = &mut *map;
        let mut needs = Needs::default();
        for tile in map.pasts.values_mut() {
            let tile = tile.get_mut().unwrap_or_else(|poisoned| poisoned.into_inner());
            needs.merge(&std::mem::take(&mut tile.needs));
        }
        let seen = std::mem::take(&mut *self.kinds.lock().unwrap_or_else(|poisoned| poisoned.into_inner()));
        map.kinds.merge(&seen);
        map.variances = map.kinds.variances();
        map.scale = (map.remembered > 0).then(|| needs.scale());
        map.seen += u64::from(stage.shadow_rays);
        let helps = needs.gain.value().is_none_or(|gain| gain > MUCH);
        let all_doubt = map.passes >= PATIENCE_WITH_ODDS && map.promise < SOME;
        if !needs.firm && (map.asleep || all_doubt) {
            map.plain = !self.restless && (map.remembered == 0 || map.seen >= TELLING && !helps);
        }
        if map.plain || map.asleep {
            return;
        }
        let strays =
            std::mem::take(&mut *self.strays.lock().unwrap_or_else(|poisoned| poisoned.into_inner()));
        if !strays.is_empty() {
            map.take_in(strays, stage);
        }
        map.passes += 1;
        let doubts =
            std::mem::take(&mut *self.doubts.lock().unwrap_or_else(|poisoned| poisoned.into_inner()));
        map.doubts.merge(&doubts);
        if map.passes.is_power_of_two() {
            map.prove(stage);
        }
        if worth_learning(map.passes) {
            map.learn();
            map.asleep &= !self.restless;
        }
    }
}

/// Odds change the less the more is known: they are made anew after 1, 2, 3, 4, 6, 8, 12, 16, 24, ... passes.
fn worth_learning(passes: u32) -> bool {
    let odd = passes >> passes.trailing_zeros();
    odd == 1 || odd == 3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_hear_of_as_many_rays() {
        assert_eq!([64, 256, 16, 1, 0].map(pixels_across), [4.0, 4.0, 8.0, 8.0, 8.0]);
        assert!((pixels_across(32).powi(2) * 32.0 - 1024.0).abs() < 0.01);
    }

    #[test]
    fn needs_scale_to_the_usual_cost() {
        let needs = |weights: [f32; 2]| {
            let mut needs = Needs::default();
            for &doubt in &weights {
                let mut told = Told::default();
                told.add(16.0, doubt);
                needs.add(&told, 1.0);
            }
            needs
        };
        let unlike = needs([1.0, 0.25]);
        // The usual samples cost 16 + 16 / 4, those that are due 16 + (16 / 4) / 4.
        assert_eq!(unlike.scale(), 20.0 / 17.0);
        assert_eq!(needs([0.5, 0.5]).scale(), 2.0);
        assert_eq!(Needs::default().scale(), 1.0);
        let mut both = needs([1.0, 1.0]);
        both.merge(&needs([0.25, 0.25]));
        assert_eq!(both.scale(), unlike.scale());
    }
}
