//! The occlusion map with stochastic visibility: of the blockers that photons name, a random part is asked.
//!
//! Lit and dark are as in [`Map`](super::Map). In a penumbra the names stand in two halves, drawn or sorted by distance
//! for each point and light, and a shadow ray asks the halves that its random term wants. The estimates have the
//! expectation of [`Map`](super::Map), which is biased, and may be negative or above one.
//!
//! The terms' probabilities may come from test rays, for each point and light or for each cell of a grid over the map; any
//! probabilities are right on average that do not depend on the samples they choose for, and these do not.

use super::super::stochastic::{TEST_RAYS, learned};
use super::super::{Batch, Questions, ShadingPoint, Split, Stage, Visibility};
use super::cells::Cells;
use super::{MOST, Map, PreparedMap, ROOM, Tracer, lit, trace_tree};
use crate::error::{Error, Result};
use crate::integrator::{Rule, Settings};
use crate::light::AreaLight;
use crate::photons::{self, BlockerSet};
use crate::sampler::Sampler;
use glam::Vec3;
use occlude_kernel::lanes::{Task, dispatch};
use occlude_kernel::photons::{Class, Nearest, PhotonId};
use occlude_kernel::{Bvh, Counter, Counts, OneTerm, Probabilities, Quotas, Simd, Tally, Targets, offset};
use std::sync::atomic::Ordering;

/// Asks random terms of what photons name.
#[derive(Debug)]
pub struct MapTerms<'a> {
    map: Map<'a>,
    settings: Settings,
    fixed: OneTerm,
    /// The middle of each blocker, if they are sorted.
    middles: Vec<Vec3>,
    /// Of each light, if probabilities are learned by cells.
    cells: Option<Vec<Cells>>,
}

impl<'a> MapTerms<'a> {
    /// Over the blockers of a map; an error if the settings do not go together.
    ///
    /// Two groups only, and random or sorted.
    pub fn new(map: Map<'a>, settings: Settings, scene: &crate::scene::Scene) -> Result<Self> {
        let settings = Self::checked(settings)?;
        let fixed = OneTerm::new(settings.form.decomposition(), &Probabilities::UNIFORM)
            .map_err(|error| Error::Usage(error.to_string()))?;
        let blockers = &map.prepared.blockers;
        let triangles = scene.triangles.len();
        let mut middles = Vec::new();
        if settings.split != Split::Random {
            let mut sums = vec![(Vec3::ZERO, 0.0f32); blockers.count(triangles)];
            for triangle in 0..triangles as u32 {
                let (sum, count) = &mut sums[blockers.of(triangle) as usize];
                *sum += scene.vertices(triangle).iter().sum::<Vec3>() / 3.0;
                *count += 1.0;
            }
            middles = sums.iter().map(|(sum, count)| *sum / count.max(1.0)).collect();
        }
        if settings.split == Split::Treelet && !matches!(blockers, BlockerSet::Treelets(..)) {
            return Err(Error::Usage(format!(
                "--split treelet halves subtrees of the scene's tree, and photons name {}: give --blocker-kind \
                 treelet:128, or --split sorted",
                map.prepared.kind
            )));
        }
        Ok(Self { map, settings, fixed, middles, cells: None })
    }

    /// With the probabilities that are learned, if any, learned once for each cell of a grid over the map and light, from
    /// 64 test rays that start at its photons, and not for each point.
    pub fn by_cells(mut self) -> Self {
        self.cells = (self.settings.rule != Rule::Uniform).then(|| Cells::of(&self.map));
        self
    }

    /// The same settings, if they go with the blockers of a map.
    pub fn checked(settings: Settings) -> Result<Settings> {
        let settings = settings.checked()?;
        if settings.groups > 2 {
            return Err(Error::Usage(
                "--levels above 2 wants --blockers all: what photons name stands in two groups".into(),
            ));
        }
        if settings.split == Split::Object {
            return Err(Error::Usage(
                "--split object wants --blockers all; with --blockers map it is random or sorted or treelet, and \
                 --blocker-kind object names objects"
                    .into(),
            ));
        }
        Ok(settings)
    }

    /// The map asked.
    pub fn map(&self) -> &Map<'a> {
        &self.map
    }
}

impl Visibility for MapTerms<'_> {
    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        estimates.clear();
        let mut unwanted = Counts::default();
        let counts = if stage.count { counts } else { &mut unwanted };
        let classes =
            dispatch(stage.level, Ask { method: self, stage, questions, estimates, counter: counts });
        for (total, of_tile) in self.map.classes.0.iter().zip(classes) {
            total.fetch_add(of_tile, Ordering::Relaxed);
        }
    }
}

/// All batches of a tile. Counts in any case, as [`Map`] does.
struct Ask<'a> {
    method: &'a MapTerms<'a>,
    stage: &'a Stage<'a>,
    questions: &'a Questions,
    estimates: &'a mut Vec<f32>,
    counter: &'a mut Counts,
}

impl Task for Ask<'_> {
    type Output = [u64; 4];

    /// Everything but the queries is bookkeeping, and stands in [`Work`].
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [u64; 4] {
        let Self { method, stage, questions, estimates, counter } = self;
        let map = &method.map;
        let prepared = map.prepared;
        let bvh = stage.bvh.on(simd);
        let mut slots = photons::slots(prepared.k);
        let mut nearest = Nearest::new(prepared.k, &mut slots).expect("room for k");
        let mut room = vec![0; ROOM];
        let mut tracers = [Tracer::new(map.ways), Tracer::new(map.ways)];
        let mut blocked = [0u64; MOST / 64];
        let mut classes = [0; 4];
        let mut work = Work::new(method);
        let mut learner = Work::new(method);
        for batch in &questions.batches {
            let point = &questions.points[batch.point as usize];
            let light = &stage.lights[batch.light as usize];
            let samples = batch.samples.start as usize..batch.samples.end as usize;
            let place = prepared.place(batch.light as usize, point.x, point.normal);
            let near = map.photons[batch.light as usize].on(simd);
            let class = near.classify(&place, &mut nearest, &mut room);
            let known = match class {
                Class::Lit => {
                    let each = lit(light, point, &questions.weights[samples.clone()], batch.share);
                    estimates.resize(estimates.len() + samples.len(), each);
                    classes[0] += 1;
                    continue;
                }
                Class::Dark => {
                    estimates.resize(estimates.len() + samples.len(), 0.0);
                    classes[1] += 1;
                    continue;
                }
                Class::Penumbra(blockers) => {
                    classes[2] += 1;
                    work.turn_to(point, batch.point);
                    work.divide(point.x, blockers.list);
                    true
                }
                Class::Unknown => {
                    classes[3] += 1;
                    false
                }
            };
            let cell = match &method.cells {
                Some(cells) if known => cells[batch.light as usize].find(point.x).map(|cell| (cells, cell)),
                _ => None,
            };
            let mut of_cell = None;
            if let Some((cells, cell)) = cell {
                let cells = &cells[batch.light as usize];
                of_cell = match cells.known(cell) {
                    Some(known) => known,
                    None => {
                        let mut tally = Tally::default();
                        let mut work_done = Counts::default();
                        learner.random =
                            Sampler::from_key(stage.seed ^ u64::from(cell) << 20 ^ u64::from(batch.light));
                        learner.square.clear();
                        learner.random.points(stage.pattern, TEST_RAYS, &mut learner.square);
                        let starts = cells.starts(cell);
                        for (i, &id) in starts.iter().enumerate() {
                            let start = start_at(stage, prepared, light, id);
                            let place = prepared.place(batch.light as usize, start.x, start.normal);
                            let class = near.classify(&place, &mut nearest, &mut room);
                            let Class::Penumbra(blockers) = class else { continue };
                            learner.divide(start.x, blockers.list);
                            learner.test_from(stage, &start, light, (i, starts.len()));
                            let mut group = 0;
                            while group < 2 {
                                let part = learner.part(group);
                                tracers[group].aim_at(&prepared.blockers, stage, &learner.names[part]);
                                learner.gather(questions, batch, group);
                                ask(
                                    (simd, bvh),
                                    (method, &mut learner, light),
                                    (&start, group),
                                    &mut tracers[group],
                                    &mut blocked,
                                    &mut work_done,
                                );
                                group += 1;
                            }
                            for visible in &learner.visible {
                                tally.add(visible[0], visible[1]);
                            }
                        }
                        let joint = tally.joint();
                        let one = joint.and_then(|joint| learned(method.settings, &joint));
                        // Counted once, whoever was quicker.
                        if cells.learn(cell, one) {
                            counter.rays(work_done.rays as u32);
                            counter.triangle_tests(work_done.triangle_tests as u32);
                            counter.node_tests(work_done.node_tests as u32);
                        }
                        one
                    }
                };
            }
            if known {
                let (first, second) = (work.part(0), work.part(1));
                tracers[0].aim_at(&prepared.blockers, stage, &work.names[first]);
                tracers[1].aim_at(&prepared.blockers, stage, &work.names[second]);
                work.begin(stage, point, batch, of_cell);
                work.hidden.clear();
                work.hidden.resize(samples.len().div_ceil(64), 0);
                if let Some(boxes) = map.occluders.get(batch.light as usize) {
                    let [x, y, z] = &questions.targets;
                    let mut from = samples.start;
                    while from < samples.end {
                        let part = from..samples.end.min(from + MOST);
                        if let Some(targets) =
                            Targets::new(&x[part.clone()], &y[part.clone()], &z[part.clone()])
                        {
                            let targets = targets.on_parallelogram(light.corner, light.u, light.v);
                            let first = (from - samples.start) / 64;
                            let words = &mut work.hidden[first..first + part.len().div_ceil(64)];
                            bvh.hidden_batch(
                                boxes,
                                point.origin,
                                &targets,
                                counter,
                                &mut tracers[0].scratch,
                                words,
                            );
                        }
                        from = part.end;
                    }
                }
            }
            if !known {
                // The scene is asked, for every sample.
                work.all(questions, batch);
                let mut from = 0;
                while from < samples.len() {
                    let part = from..samples.len().min(from + MOST);
                    from = part.end;
                    let [tx, ty, tz] = &work.asked;
                    let Some(targets) = Targets::new(&tx[part.clone()], &ty[part.clone()], &tz[part.clone()])
                    else {
                        continue;
                    };
                    let targets = targets.on_parallelogram(light.corner, light.u, light.v);
                    let words = &mut blocked[..part.len().div_ceil(64)];
                    let (x, scratch) = (point.origin.to_array(), &mut tracers[0].scratch);
                    trace_tree((simd, bvh), x, &targets, counter, scratch, words);
                    for i in 0..part.len() {
                        estimates.push(if blocked[i / 64] >> (i % 64) & 1 == 0 { 1.0 } else { 0.0 });
                    }
                }
                continue;
            }
            counter.rays(samples.len() as u32);
            loop {
                let mut group = 0;
                while group < 2 {
                    work.gather(questions, batch, group);
                    ask(
                        (simd, bvh),
                        (method, &mut work, light),
                        (point, group),
                        &mut tracers[group],
                        &mut blocked,
                        counter,
                    );
                    group += 1;
                }
                if work.finish(batch, estimates) {
                    break;
                }
            }
        }
        classes
    }
}

/// Asks a half of the names about the samples gathered.
#[inline(always)]
fn ask<S: Simd>(
    (simd, bvh): (S, Bvh<'_, S>),
    (method, work, light): (&MapTerms<'_>, &mut Work<'_>, &AreaLight),
    (point, group): (&ShadingPoint, usize),
    tracer: &mut Tracer,
    blocked: &mut [u64; MOST / 64],
    counter: &mut Counts,
) {
    let part = work.part(group);
    if part.is_empty() {
        work.free(group);
        return;
    }
    let x = point.origin.to_array();
    let mut from = 0;
    while from < work.places.len() {
        let some = from..work.places.len().min(from + MOST);
        from = some.end;
        let [tx, ty, tz] = &work.asked;
        let Some(targets) = Targets::new(&tx[some.clone()], &ty[some.clone()], &tz[some.clone()]) else {
            continue;
        };
        let targets = targets.on_parallelogram(light.corner, light.u, light.v);
        let words = &mut blocked[..some.len().div_ceil(64)];
        let blockers = (&method.map.prepared.blockers, &method.map.objects[..]);
        let names = &work.names[part.clone()];
        // Both halves are asked about the same rays, which the caller counts.
        let rays = counter.rays;
        tracer.trace(blockers, (simd, bvh), names, x, &targets, counter, words);
        counter.rays = rays;
        for (i, &place) in work.places[some].iter().enumerate() {
            work.visible[place as usize][group] = blocked[i / 64] >> (i % 64) & 1 == 0;
        }
    }
}

/// A photon as a point to trace test rays from, on the side that the middle of the light sees.
fn start_at(stage: &Stage<'_>, prepared: &PreparedMap, light: &AreaLight, id: PhotonId) -> ShadingPoint {
    let x = Vec3::from(prepared.store.position(id));
    let path = light.point([0.5; 2]) - x;
    let triangle = prepared.store.surface(id);
    let normal = photons::normal(stage.scene, triangle).unwrap_or(Vec3::ZERO);
    let normal = if normal.dot(path) < 0.0 { -normal } else { normal };
    let origin = offset(x, normal, stage.bvh.clearance());
    ShadingPoint {
        pixel: 0,
        path: 0,
        x,
        origin,
        normal,
        triangle,
        diffuse: Vec3::ZERO,
        key: 0,
        rays: 0,
        firm: false,
    }
}

/// The batch at hand: first its test rays, if probabilities are learned, and then its samples.
struct Work<'a> {
    method: &'a MapTerms<'a>,
    random: Sampler,
    point: Option<u32>,
    /// What photons name, one group after the other, and where the second begins.
    names: Vec<u32>,
    half: usize,
    order: Vec<(f32, u32)>,
    one: OneTerm,
    testing: bool,
    tests: [Vec<f32>; 3],
    square: Vec<[f32; 2]>,
    choices: Vec<u32>,
    visible: Vec<[bool; 2]>,
    /// Samples that boxes block, a bit each.
    hidden: Vec<u64>,
    places: Vec<u32>,
    asked: [Vec<f32>; 3],
}

impl<'a> Work<'a> {
    fn new(method: &'a MapTerms<'a>) -> Self {
        Self {
            method,
            random: Sampler::from_key(0),
            point: None,
            names: Vec::new(),
            half: 0,
            order: Vec::new(),
            one: method.fixed,
            testing: false,
            tests: Default::default(),
            square: Vec::new(),
            choices: Vec::new(),
            visible: Vec::new(),
            hidden: Vec::new(),
            places: Vec::new(),
            asked: Default::default(),
        }
    }

    /// Takes the numbers of a point, if it is a new one.
    fn turn_to(&mut self, point: &ShadingPoint, index: u32) {
        if self.point != Some(index) {
            self.point = Some(index);
            self.random = Sampler::from_key(point.key);
        }
    }

    /// Puts the names in two halves.
    fn divide(&mut self, x: Vec3, list: &[u32]) {
        self.names.clear();
        self.names.extend_from_slice(list);
        self.half = list.len().div_ceil(2);
        if self.method.settings.split != Split::Random {
            let far = |name: u32| self.method.middles[name as usize].distance_squared(x);
            self.order.clear();
            self.order.extend(list.iter().map(|&name| (far(name), name)));
            self.order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            self.names.iter_mut().zip(&self.order).for_each(|(name, (_, sorted))| *name = *sorted);
        } else {
            for i in (1..self.names.len()).rev() {
                let j = (u64::from(self.random.word()) * (i as u64 + 1)) >> 32;
                self.names.swap(i, j as usize);
            }
        }
    }

    /// Where the names of a half are.
    fn part(&self, group: usize) -> std::ops::Range<usize> {
        if group == 0 { 0..self.half } else { self.half..self.names.len() }
    }

    /// Turns to a batch: draws its terms, or first its test rays. With cells, `of_cell` is what that of the point knows.
    fn begin(&mut self, stage: &Stage<'_>, point: &ShadingPoint, batch: &Batch, of_cell: Option<OneTerm>) {
        self.one = of_cell.unwrap_or(self.method.fixed);
        self.testing = self.method.settings.rule != Rule::Uniform && self.method.cells.is_none();
        if !self.testing {
            self.choose(batch);
            return;
        }
        let light = &stage.lights[batch.light as usize];
        self.square.clear();
        self.random.points(stage.pattern, TEST_RAYS, &mut self.square);
        self.test_from(stage, point, light, (0, 1));
    }

    /// Prepares the test rays of a point: of all that are drawn every `n`-th, from the `i`-th on.
    fn test_from(
        &mut self,
        stage: &Stage<'_>,
        point: &ShadingPoint,
        light: &AreaLight,
        (i, n): (usize, usize),
    ) {
        self.testing = true;
        self.tests.iter_mut().for_each(Vec::clear);
        for &at in self.square.iter().skip(i).step_by(n) {
            let y = light.point(at);
            let path = y - point.x;
            if light.normal.dot(path) < 0.0 && point.normal.dot(path) > 0.0 {
                let target = offset(y, light.normal, stage.bvh.clearance());
                (0..3).for_each(|axis| self.tests[axis].push(target[axis]));
            }
        }
        self.visible.clear();
        self.visible.resize(self.tests[0].len(), [true; 2]);
    }

    /// Draws the terms of all samples.
    fn choose(&mut self, batch: &Batch) {
        let count = batch.samples.len();
        let (offset, seed) = (self.random.uniform(), self.random.word());
        let quotas = self.method.settings.quotas.then(|| Quotas::new(count as u32, offset, seed));
        self.choices.clear();
        for k in 0..count as u32 {
            let u = match &quotas {
                Some(quotas) => quotas.number(k),
                None => self.random.uniform(),
            };
            self.choices.push(self.one.choose(u) as u32);
        }
        self.visible.clear();
        self.visible.resize(count, [true; 2]);
    }

    /// Collects the samples that want to know of a group.
    fn gather(&mut self, questions: &Questions, batch: &Batch, group: usize) {
        self.places.clear();
        if self.testing {
            self.places.extend(0..self.visible.len() as u32);
        } else {
            for (place, (&choice, visible)) in (0u32..).zip(self.choices.iter().zip(&self.visible)) {
                let needs = self.one.needs(choice as usize);
                if self.hidden(place as usize) {
                    continue;
                }
                if if group == 0 { needs.a } else { needs.b.given(visible[0]) } {
                    self.places.push(place);
                }
            }
        }
        let samples = batch.samples.start as usize..batch.samples.end as usize;
        for (axis, asked) in self.asked.iter_mut().enumerate() {
            let from =
                if self.testing { &self.tests[axis][..] } else { &questions.targets[axis][samples.clone()] };
            asked.clear();
            asked.extend(self.places.iter().map(|&place| from[place as usize]));
        }
    }

    /// Do boxes block a sample?
    fn hidden(&self, place: usize) -> bool {
        self.hidden.get(place / 64).is_some_and(|word| word >> (place % 64) & 1 != 0)
    }

    /// All samples, for the scene to be asked.
    fn all(&mut self, questions: &Questions, batch: &Batch) {
        let samples = batch.samples.start as usize..batch.samples.end as usize;
        for (asked, from) in self.asked.iter_mut().zip(&questions.targets) {
            asked.clear();
            asked.extend_from_slice(&from[samples.clone()]);
        }
    }

    /// A group without blockers lets everything through.
    fn free(&mut self, group: usize) {
        for &place in &self.places {
            self.visible[place as usize][group] = true;
        }
    }

    /// After test rays, turns to the samples; after samples, writes their estimates and is done.
    fn finish(&mut self, batch: &Batch, estimates: &mut Vec<f32>) -> bool {
        if self.testing {
            self.testing = false;
            let mut tally = Tally::default();
            self.visible.iter().for_each(|[a, b]| tally.add(*a, *b));
            let joint = tally.joint();
            if let Some(one) = joint.and_then(|joint| learned(self.method.settings, &joint)) {
                self.one = one;
            }
            self.choose(batch);
            return false;
        }
        let value = |(place, (&choice, &[a, b])): (usize, (&u32, &[bool; 2]))| {
            if self.hidden(place) { 0.0 } else { self.one.value(choice as usize, a, b) }
        };
        estimates.extend(self.choices.iter().zip(&self.visible).enumerate().map(value));
        true
    }
}
