//! The occlusion map that learns: rays go where shadows begin and end, and the picture is right on average.
//!
//! Before the first pass, camera rays say which cells the picture needs ([`occlude_kernel::occlusion_map`]); a shaft
//! proves some of them lit; photons shot from the lights through everything give the others their first odds. Each pass
//! is rendered against the map as it is. What its rays saw is counted, in whole numbers, so that no order of threads
//! matters, and between passes the counts become new odds.

use super::{CameraSample, Fan, Questions, Scratch, Share, Stage, Visibility, cast, divide, exact};
use crate::film::Tile;
use crate::light::AreaLight;
use crate::photons::{BlockerSet, Shower};
use crate::sampler::Sampler;
use glam::Vec3;
use occlude_kernel::lanes::{Task, dispatch};
use occlude_kernel::occlusion_map::{
    BINS, CLASSES, CellKey, Chances, Coin, Doubts, Known, MapCell, OcclusionMap, Tally, bin, class,
};
use occlude_kernel::{Bvh, Counts, Hit, Ray, Simd, Targets, TileScratch, Uncounted, offset};
use rayon::prelude::*;
use std::f32::consts::FRAC_1_PI;
use std::ops::{ControlFlow, Range};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, RwLock};

/// How the map is made.
#[derive(Clone, Copy, Debug)]
pub struct AutoOptions {
    /// Pixels across a cell, at least: cells have edges of one to two times that many.
    pub cell: f32,
    /// Photons to shoot before the first pass; from the number of cells if not given.
    pub photons: Option<u64>,
    /// Bytes that cells may take.
    pub memory: usize,
}

impl Default for AutoOptions {
    fn default() -> Self {
        Self { cell: 4.0, photons: None, memory: 256 << 20 }
    }
}

/// Bytes of a cell, with what is counted for it.
const CELL_BYTES: usize = size_of::<MapCell>() + BINS * size_of::<AtomicU64>() + 24;

/// Rays at random where the map is not sure, and none where it is.
#[derive(Debug, Default)]
pub struct Auto {
    options: AutoOptions,
    map: RwLock<Map>,
    /// Points of cells that there are not, or beyond the bounds of a cell that is lit.
    strays: Mutex<Vec<Stray>>,
    /// How far this pass' guesses are off.
    doubts: Mutex<Doubts>,
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
    /// The angle of a pixel.
    angle: f32,
    /// How far guesses were off.
    doubts: Doubts,
    /// And what follows from that.
    chances: Chances,
    passes: u32,
    /// Strays that a tile may report, so that they take no more memory than the cells may.
    most_strays: usize,
    /// About what a shadow ray costs, ns.
    ray: f64,
    /// Is there room for no more cells?
    full: bool,
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
            doubts: Doubts::default(),
            chances: Chances::ALL,
            passes: 0,
            most_strays: 0,
            ray: 4.0,
            full: false,
        }
    }
}

/// How often a cell is tried to be proven lit, at most.
const TRIES: u8 = 4;

/// What it costs to think of a sample, and of one that then gets a ray; ns.
const SKIPPED: f64 = 3.0;
const CHOSEN: f64 = 5.0;

/// How much more a ray costs whose neighbours were not chosen.
const SCATTERED: f64 = 1.3;

/// What well spread samples leave of the variance that bins have by themselves: a border crosses few of a point's bins,
/// but many of a cell's. Measured: at 0.06 the error of pictures is that of asking every ray, or a little less.
const SPREAD: f64 = 0.06;

/// Photons for each cell.
const PHOTONS: u64 = 4;

impl Map {
    fn view(&self) -> OcclusionMap<'_> {
        if self.table.is_empty() {
            return OcclusionMap::EMPTY;
        }
        OcclusionMap::new(&self.cells, &self.table).expect("a table of these cells")
    }

    fn key(&self, options: &AutoOptions, eye: Vec3, x: Vec3, normal: Vec3, light: u32) -> Option<CellKey> {
        let size = x.distance(eye) * self.angle * options.cell;
        CellKey::new(x, normal, CellKey::level(size), light)
    }

    fn tally(&self, cell: usize) -> [Tally; BINS] {
        std::array::from_fn(|bin| {
            let word = self.tallies[cell * BINS + bin].load(Ordering::Relaxed);
            Tally { asked: (word >> 32) as u32, free: word as u32 }
        })
    }

    fn count(&self, place: usize, free: bool) {
        self.tallies[place].fetch_add(1 << 32 | u64::from(free), Ordering::Relaxed);
    }

    /// Makes room for points that have none.
    fn take_in(&mut self, mut strays: Vec<Stray>, stage: &Stage<'_>, options: &AutoOptions) {
        strays.par_sort_unstable_by_key(Stray::order);
        let clearance = stage.bvh.clearance();
        let known = self.cells.len();
        self.before.clear();
        for group in strays.chunk_by(|a, b| a.key == b.key) {
            let key = group[0].key;
            let found = if self.table.is_empty() { None } else { self.view().find(key) };
            let index = match found {
                Some(index) => index,
                None if (self.cells.len() + 1) * CELL_BYTES > options.memory => {
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
            cell.widen(if index < known { 0.5 * size } else { size }, 0.25 * clearance);
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
                let light = &stage.lights[cell.key().light() as usize];
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
        // How many bins of which class, weighed by how often they are asked.
        let mut segments = [0u64; CLASSES];
        let mut unknown = 0;
        for ((cell, expected), &points) in self.cells.iter().zip(&expected).zip(&self.points) {
            match expected {
                None if cell.is_lit() => {}
                None => unknown += BINS as u64 * u64::from(points),
                Some(expected) => expected.iter().for_each(|&p| segments[class(p)] += u64::from(points)),
            }
        }
        // What a ray costs when all are asked, and what one costs that was chosen; ns.
        let ray = self.ray;
        let chosen = SCATTERED * ray + CHOSEN;
        self.chances = self.doubts.chances(&segments, unknown, SKIPPED / chosen, SPREAD);
        self.doubts.fade();
        let most =
            if self.passes >= FOR_GOOD { ((ray - SKIPPED) / chosen).clamp(0.0, 1.0) as f32 } else { 1.0 };
        let chances = self.chances;
        let cells = self.cells.par_iter_mut().zip(&expected).with_min_len(256);
        cells.for_each(|(cell, expected)| cell.learn(expected.as_ref(), &chances, most));
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

/// Passes before cells that are all doubt are left alone.
const FOR_GOOD: u32 = 3;

/// Writes which samples are asked, and gives what is known of all of them together.
fn choose(cell: &MapCell, chances: &Chances, fan: &Fan, coin: &mut Coin, some: &mut Vec<u32>) -> f32 {
    let count = fan.weights.len();
    some.resize(count, 0);
    let (weights, bins, some_of) = (&fan.weights[..count], &fan.bins[..count], &mut some[..count]);
    let (mut kept, mut sum) = (0, 0.0);
    for i in 0..count {
        let odds = cell.odds(usize::from(bins[i]) % BINS);
        sum += odds.guess(chances) * weights[i];
        some_of[kept] = i as u32;
        kept += usize::from(coin.toss(chances.of(odds.class)) & (weights[i] > 0.0));
    }
    some.truncate(kept);
    sum
}

/// Is there nothing between a cell and its light?
struct Prove<'a> {
    bvh: Bvh<'a>,
    light: &'a AreaLight,
    corners: &'a [[f32; 3]; 8],
    scratch: &'a mut TileScratch,
}

impl Task for Prove<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> bool {
        let clearance = self.bvh.clearance();
        let (corners, count) = self.light.corners();
        // Samples lie a clearance before the light, give or take some rounding.
        let mut at = [[0.0; 8]; 3];
        for (k, &corner) in corners[..count].iter().enumerate() {
            for (half, by) in [0.75, 1.25].into_iter().enumerate() {
                let target = offset(corner, self.light.normal, by * clearance);
                for axis in 0..3 {
                    at[axis][k + half * count] = target[axis];
                }
            }
        }
        let [x, y, z] = &at;
        let Some(targets) = Targets::new(&x[..2 * count], &y[..2 * count], &z[..2 * count]) else {
            return false;
        };
        let targets = targets.on_parallelogram(self.light.corner, self.light.u, self.light.v);
        self.bvh.on(simd).nothing_between(self.corners, &targets, &mut Uncounted, self.scratch)
    }
}

impl Auto {
    /// With nothing known yet.
    pub fn new(options: AutoOptions) -> Self {
        Self { options, ..Self::default() }
    }

    /// Lets somebody change what the map thinks, between passes. Whatever it thinks, pictures stay right on average, as
    /// long as no cell is called lit that is not.
    pub fn alter(&self, change: impl FnOnce(&mut [MapCell], &mut Chances)) {
        let mut map = self.map.write().unwrap_or_else(|poisoned| poisoned.into_inner());
        let Map { cells, chances, .. } = &mut *map;
        change(cells, chances);
    }

    /// Shoots photons at the cells, and counts which of them light reaches.
    fn seed(&self, map: &Map, stage: &Stage<'_>) {
        let lines = self.options.photons.unwrap_or((PHOTONS * map.cells.len() as u64).min(4_000_000));
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
            dispatch(stage.level, Photons { auto: self, map, stage, shower: &shower, light, lines });
        });
    }
}

/// Photons that a task shoots.
const CHUNK: u64 = 1024;

/// Photons of a light.
struct Photons<'a> {
    auto: &'a Auto,
    map: &'a Map,
    stage: &'a Stage<'a>,
    shower: &'a Shower<'a>,
    light: u32,
    lines: Range<u64>,
}

impl Task for Photons<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { auto, map, stage, shower, light, lines } = self;
        let (bvh, view, clearance) = (stage.bvh.on(simd), map.view(), stage.bvh.clearance());
        let mut hits: Vec<Hit> = Vec::new();
        for line in lines {
            let (ray, at) = shower.ray_and_place(line, light);
            hits.clear();
            bvh.each_hit(&ray, None, &mut Uncounted, |hit| {
                hits.push(hit);
                ControlFlow::Continue(())
            });
            hits.sort_unstable_by(|a, b| a.t.total_cmp(&b.t).then(a.triangle.cmp(&b.triangle)));
            let Some(first) = hits.first().map(|hit| hit.t + clearance) else { continue };
            for hit in &hits {
                let [a, b, c] = stage.scene.vertices(hit.triangle);
                let Some(normal) = (b - a).cross(c - a).try_normalize() else { continue };
                let normal = if normal.dot(ray.direction) < 0.0 { normal } else { -normal };
                let key = map.key(&auto.options, stage.eye, ray.at(hit.t), normal, light);
                if let Some(cell) = key.and_then(|key| view.find(key)) {
                    map.count(cell * BINS + bin(at), hit.t <= first);
                }
            }
        }
    }
}

impl Visibility for Auto {
    fn begin(&self, stage: &Stage<'_>, tiles: &[Tile], width: u32) {
        let mut map = self.map.write().unwrap_or_else(|poisoned| poisoned.into_inner());
        let ahead = stage.camera.ray_direction(0.5 * width as f32, 0.5 * width as f32);
        let beside = stage.camera.ray_direction(0.5 * width as f32 + 1.0, 0.5 * width as f32);
        let most_strays = self.options.memory / size_of::<Stray>() / tiles.len().max(1);
        *map = Map { angle: (beside - ahead).length() / ahead.length(), most_strays, ..Map::default() };
        let found = &*map;
        let strays: Vec<Vec<Stray>> = tiles
            .par_iter()
            .map_init(Scratch::default, |scratch, &tile| {
                scratch.paths.clear();
                let all = 0..tile.len() as u32;
                scratch.paths.extend(all.map(|pixel| CameraSample { pixel, index: 0 }));
                cast(&Stage { count: false, ..*stage }, tile, width, scratch);
                let mut strays = Vec::new();
                for point in &scratch.questions.points {
                    for (light, area) in (0..).zip(stage.lights) {
                        if area.unshadowed(point.x, point.normal).is_some() {
                            let key = found.key(&self.options, stage.eye, point.x, point.normal, light);
                            strays.extend(key.map(|key| Stray {
                                key,
                                origin: point.origin,
                                normal: point.normal,
                            }));
                        }
                    }
                }
                strays.truncate(most_strays);
                strays
            })
            .collect();
        let strays = strays.concat();
        map.take_in(strays.clone(), stage, &self.options);
        self.seed(&map, stage);
        map.prove(stage);
        map.probe(&strays, stage);
        map.learn();
    }

    fn ask(&self, stage: &Stage<'_>, scratch: &mut Scratch) {
        let map = self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner());
        let view = map.view();
        let Scratch { samplers, questions, shares, square, fan, radiance, .. } = scratch;
        let mut strays = Vec::new();
        let some = &mut Vec::new();
        for index in 0..questions.points.len() {
            let point = questions.points[index];
            let sampler = &mut samplers[point.path as usize];
            divide(stage, &point, sampler, shares);
            for &Share { light, unshadowed, count, each } in shares.iter() {
                let area = &stage.lights[light as usize];
                let key = map.key(&self.options, stage.eye, point.x, point.normal, light);
                let cell = key.and_then(|key| view.find(key));
                let known = match cell {
                    Some(cell) => view.cells()[cell].known(point.origin),
                    None => Known::Nothing,
                };
                let full = point.diffuse * area.radiance;
                if known == Known::Lit {
                    radiance[point.path as usize] += full * (unshadowed * FRAC_1_PI);
                    continue;
                }
                let outside = cell.is_none_or(|cell| view.cells()[cell].is_lit() && map.tries[cell] > 0);
                let wanted = outside && !(map.full && cell.is_none()) && strays.len() < map.most_strays;
                if let (Some(key), true) = (key, wanted) {
                    strays.push(Stray { key, origin: point.origin, normal: point.normal });
                }
                if count == 0 {
                    continue;
                }
                let share = count as f32 * each;
                let first = questions.weights.len() as u32;
                square.clear();
                sampler.points(stage.pattern, count as usize, square);
                let mut coin = Coin::new(sampler.uniform());
                some.clear();
                let sum = match (known, cell) {
                    (Known::Flat(odds), Some(_)) => {
                        // Only those that are asked need be there; the others add up to what is known.
                        let chance = map.chances.of(odds.class);
                        square.retain(|_| coin.toss(chance));
                        fan.open(stage, area, &point, square, each);
                        some.extend((0..).zip(&fan.weights).filter(|(_, w)| **w > 0.0).map(|(i, _)| i));
                        odds.guess(&map.chances) * unshadowed * FRAC_1_PI * share
                    }
                    (Known::Bins, Some(index)) => {
                        fan.open(stage, area, &point, square, each);
                        choose(&view.cells()[index], &map.chances, fan, &mut coin, some)
                    }
                    _ => {
                        fan.open(stage, area, &point, square, each);
                        0.0
                    }
                };
                let known_bins = matches!(known, Known::Flat(_) | Known::Bins);
                match cell {
                    Some(index) if known != Known::All => {
                        if !known_bins {
                            some.extend((0..).zip(&fan.weights).filter(|(_, w)| **w > 0.0).map(|(i, _)| i));
                        }
                        fan.append_some_to(some, questions);
                        let cell = &view.cells()[index];
                        let odds = |bin: u8| match known {
                            Known::Flat(odds) => Some(odds),
                            Known::Bins => Some(cell.odds(usize::from(bin))),
                            _ => None,
                        };
                        let bins = || some.iter().map(|&i| fan.bins[i as usize]);
                        questions.odds.extend(bins().map(odds));
                        questions.places.extend(bins().map(|bin| (index * BINS) as u32 + u32::from(bin)));
                    }
                    _ => fan.append_to(questions),
                }
                questions.odds.resize(questions.weights.len(), None);
                questions.places.resize(questions.weights.len(), u32::MAX);
                radiance[point.path as usize] += full * sum;
                let last = questions.weights.len() as u32;
                if last > first {
                    questions.batches.push(super::Batch {
                        point: index as u32,
                        light,
                        samples: first..last,
                        share,
                    });
                }
            }
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
        let map = self.map.read().unwrap_or_else(|poisoned| poisoned.into_inner());
        let blocked = exact::blocked(stage, &[], questions, counts);
        estimates.clear();
        let mut doubts = Doubts::default();
        for (i, (odds, &place)) in questions.odds.iter().zip(&questions.places).enumerate() {
            let free = blocked[i / 64] >> (i % 64) & 1 == 0;
            estimates.push(match odds {
                Some(odds) => {
                    doubts.count(*odds, free);
                    odds.correction(&map.chances, free)
                }
                None if free => 1.0,
                None => 0.0,
            });
            if place != u32::MAX {
                map.count(place as usize, free);
            }
        }
        self.doubts.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).merge(&doubts);
    }

    fn passed(&self, stage: &Stage<'_>) {
        let mut map = self.map.write().unwrap_or_else(|poisoned| poisoned.into_inner());
        let strays =
            std::mem::take(&mut *self.strays.lock().unwrap_or_else(|poisoned| poisoned.into_inner()));
        if !strays.is_empty() {
            map.take_in(strays, stage, &self.options);
        }
        map.passes += 1;
        let doubts =
            std::mem::take(&mut *self.doubts.lock().unwrap_or_else(|poisoned| poisoned.into_inner()));
        map.doubts.merge(&doubts);
        map.prove(stage);
        if worth_learning(map.passes) {
            map.learn();
        }
    }
}

/// Odds change the less the more is known: they are made anew after 1, 2, 3, 4, 6, 8, 12, 16, 24, ... passes.
fn worth_learning(passes: u32) -> bool {
    let odd = passes >> passes.trailing_zeros();
    odd == 1 || odd == 3
}
