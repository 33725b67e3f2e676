//! The occlusion map: photons say what may be in the way, and shadow rays ask only that.
//!
//! Around a point the k nearest photons of a light tell three cases apart. Only light photons: lit, and the light is
//! known in closed form. Only occlusion photons: dark. Both: penumbra, and shadow rays are traced against the blockers
//! that the photons name, and nothing else. Where no photon is near, the scene is asked.
//!
//! Biased: what the photons miss casts no shadow, and thin shadows and slits of light can be lost. It is the thesis'
//! method; the exact one is [`Exact`](super::Exact).

mod cells;
mod terms;

pub use terms::MapTerms;

use super::{Questions, ShadingPoint, Stage, Visibility};
use crate::accel::Quality;
use crate::error::{Error, Result};
use crate::light::AreaLight;
use crate::photons::{self, BlockerKind, BlockerSet, PhotonStore, Shower, default_lines};
use crate::report::MapFigures;
use occlude_kernel::bvh::{SmallTree, SmallTriangle};
use occlude_kernel::lanes::{Task, dispatch};
use occlude_kernel::photons::{Class, Nearest, Photons, Place};
use occlude_kernel::{
    BatchScratch, Bvh, Child, Counter, Counts, Native, Node, Occluders, Simd, Targets, TriangleBlock,
};
use std::f32::consts::FRAC_1_PI;
use std::sync::atomic::{AtomicU64, Ordering};

/// How much more a step along the normal counts than one along the surface, when photons are looked up.
pub const FLATNESS: f32 = 4.0;

/// Room for the names of all photons of a look-up.
const ROOM: usize = 8192;

/// What to prepare.
#[derive(Clone, Copy, Debug)]
pub struct MapOptions {
    /// Lines to shoot; from the size of the scene if not given.
    pub lines: Option<u64>,
    /// Photons to look up.
    pub k: usize,
    /// Rounds to shoot them in; 1 shoots evenly, and of more the later ones go where shadows begin and end.
    pub rounds: u32,
    /// How far to look; from the density of the photons if not given.
    pub radius: Option<f32>,
    /// What photons name.
    pub blockers: BlockerKind,
    /// How long to look for good trees of objects.
    pub quality: Quality,
}

/// The photons of a scene and its blockers.
#[derive(Debug)]
pub struct PreparedMap {
    /// The photons.
    pub store: PhotonStore,
    /// What they name.
    pub blockers: BlockerSet,
    kind: BlockerKind,
    k: usize,
    radii: Vec<f32>,
}

impl PreparedMap {
    /// Shoots the photons, on the threads of the current pool.
    pub fn new(stage: &Stage<'_>, options: &MapOptions) -> Self {
        let scene = stage.scene;
        let blockers = BlockerSet::new(options.blockers, scene, &stage.bvh, options.quality);
        let lines = options.lines.unwrap_or_else(|| default_lines(scene.triangles.len()));
        let (bvh, lights, seed, level) = (stage.bvh, stage.lights, stage.seed, stage.level);
        let shower = Shower { bvh, lights, blockers: &blockers, lines, seed, level };
        let store = shower.shoot_in_rounds(options.rounds, scene);
        let area = photons::scene_area(scene);
        let radius = |light| options.radius.unwrap_or_else(|| store.radius(light, options.k, area));
        let radii = (0..lights.len()).map(radius).collect();
        Self { store, blockers, kind: options.blockers, k: options.k, radii }
    }

    /// The photons ready to be asked.
    pub fn visibility(&self) -> Map<'_> {
        let objects = match &self.blockers {
            BlockerSet::Objects(_, trees) => trees.iter().map(|tree| tree.bvh()).collect(),
            _ => Vec::new(),
        };
        let photons = self.store.by_light();
        let ways = Ways::default();
        Map { prepared: self, photons, objects, occluders: Vec::new(), ways, classes: Default::default() }
    }

    /// Where to look for the photons of a light around a point of a surface.
    #[inline]
    pub fn place(&self, light: usize, x: glam::Vec3, normal: glam::Vec3) -> Place {
        Place::disc(x, normal, self.radii[light], FLATNESS)
    }

    /// What it holds, and what it said so far.
    pub fn figures(&self, map: &Map<'_>) -> MapFigures {
        let (store, stats) = (&self.store, &self.store.stats);
        let [lit, dark, penumbra, unknown] = map.classes().get();
        MapFigures {
            lines: stats.lines,
            adaptive: stats.rounds > 1,
            rounds: stats.rounds,
            later_lines: stats.later_lines,
            lines_lost: stats.lost,
            light_photons: store.light().len(),
            occlusion_photons: store.occlusion().len(),
            dropped_photons: stats.dropped_photons,
            dropped_blockers: stats.dropped_blockers,
            blockers: self.kind.to_string(),
            k: self.k,
            shoot_s: stats.shot.as_secs_f64(),
            judge_s: stats.judged.as_secs_f64(),
            sort_s: stats.sorted.as_secs_f64(),
            bytes: store.bytes(),
            lit,
            dark,
            penumbra,
            unknown,
        }
    }

    /// How many photons a look-up wants.
    pub fn k(&self) -> usize {
        self.k
    }
}

/// Batches of each class so far.
#[derive(Debug, Default)]
pub struct Classes([AtomicU64; 4]);

impl Classes {
    /// Lit, dark, penumbra, and where no photon was near.
    pub fn get(&self) -> [u64; 4] {
        [0, 1, 2, 3].map(|class| self.0[class].load(Ordering::Relaxed))
    }
}

/// Traces shadow rays against what photons name.
#[derive(Debug)]
pub struct Map<'a> {
    prepared: &'a PreparedMap,
    photons: Vec<Photons<'a, Native>>,
    objects: Vec<Bvh<'a>>,
    occluders: Vec<Occluders<'a>>,
    ways: Ways,
    classes: Classes,
}

/// How what photons name is asked.
#[derive(Clone, Copy, Debug, Default)]
struct Ways {
    /// Whether a tree is built over the triangles.
    trees: bool,
    /// Whether every ray is traced by itself.
    alone: bool,
}

impl<'a> Map<'a> {
    /// With boxes that block the light of each light, whatever photons name (see [`crate::volumetric`]).
    pub fn with_occluders(self, occluders: Vec<Occluders<'a>>) -> Self {
        Self { occluders, ..self }
    }

    /// With a tree over the triangles that photons name, built for each point and light ([`SmallTree`]); an error if they
    /// name anything else.
    pub fn with_trees(mut self) -> Result<Self> {
        if !matches!(self.prepared.blockers, BlockerSet::Triangles) {
            return Err(Error::Usage(format!(
                "--blocker-trees builds trees over triangles, and photons name {}: give --blocker-kind triangle",
                self.prepared.kind
            )));
        }
        self.ways.trees = true;
        Ok(self)
    }

    /// With every shadow ray traced by itself, and not all of a point at once. The same answers, slower: as the thesis
    /// did it, for comparison.
    pub fn one_by_one(mut self) -> Self {
        self.ways.alone = true;
        self
    }

    /// What the batches asked so far were.
    pub fn classes(&self) -> &Classes {
        &self.classes
    }
}

impl Visibility for Map<'_> {
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
        let classes = dispatch(stage.level, Ask { map: self, stage, questions, estimates, counter: counts });
        for (total, of_tile) in self.classes.0.iter().zip(classes) {
            total.fetch_add(of_tile, Ordering::Relaxed);
        }
    }
}

/// All batches of a tile. Counts in any case: not to would be one more copy to compile.
struct Ask<'a> {
    map: &'a Map<'a>,
    stage: &'a Stage<'a>,
    questions: &'a Questions,
    estimates: &'a mut Vec<f32>,
    counter: &'a mut Counts,
}

impl Task for Ask<'_> {
    type Output = [u64; 4];

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [u64; 4] {
        let Self { map, stage, questions, estimates, counter } = self;
        let prepared = map.prepared;
        let bvh = stage.bvh.on(simd);
        let mut slots = photons::slots(prepared.k);
        let mut nearest = Nearest::new(prepared.k, &mut slots).expect("room for k");
        let mut room = vec![0; ROOM];
        let mut tracer = Tracer::new(map.ways);
        let mut blocked = [0u64; MOST / 64];
        let mut hidden = [0u64; MOST / 64];
        let mut classes = [0; 4];
        let [x, y, z] = &questions.targets;
        for batch in &questions.batches {
            let point = &questions.points[batch.point as usize];
            let light = &stage.lights[batch.light as usize];
            let samples = batch.samples.start as usize..batch.samples.end as usize;
            let place = prepared.place(batch.light as usize, point.x, point.normal);
            let near = map.photons[batch.light as usize].on(simd);
            let class = near.classify(&place, &mut nearest, &mut room);
            let list = match class {
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
                    tracer.aim_at(&prepared.blockers, stage, blockers.list);
                    classes[2] += 1;
                    Some(blockers.list)
                }
                Class::Unknown => {
                    classes[3] += 1;
                    None
                }
            };
            let mut from = samples.start;
            while from < samples.end {
                let part = from..samples.end.min(from + MOST);
                from = part.end;
                let count = part.len();
                let Some(targets) = Targets::new(&x[part.clone()], &y[part.clone()], &z[part]) else {
                    continue;
                };
                let targets = targets.on_parallelogram(light.corner, light.u, light.v);
                let words = &mut blocked[..count.div_ceil(64)];
                let behind = &mut hidden[..count.div_ceil(64)];
                behind.fill(0);
                if let (Some(boxes), Some(_)) = (map.occluders.get(batch.light as usize), list) {
                    bvh.hidden_batch(boxes, point.origin, &targets, counter, &mut tracer.scratch, behind);
                }
                let ones: u32 = behind.iter().map(|word| word.count_ones()).sum();
                if ones as usize == count {
                    counter.rays(ones);
                    estimates.resize(estimates.len() + count, 0.0);
                    continue;
                }
                match list {
                    None => {
                        let (x, scratch) = (point.origin.to_array(), &mut tracer.scratch);
                        trace_tree((simd, bvh), x, &targets, counter, scratch, words);
                    }
                    Some(list) => {
                        let blockers = (&prepared.blockers, &map.objects[..]);
                        let x = point.origin.to_array();
                        tracer.trace(blockers, (simd, bvh), list, x, &targets, counter, words);
                    }
                }
                for i in 0..count {
                    let word = blocked[i / 64] | hidden[i / 64];
                    estimates.push(if word >> (i % 64) & 1 == 0 { 1.0 } else { 0.0 });
                }
            }
        }
        classes
    }
}

/// What each sample of a lit point counts, such that they add up to what is known.
fn lit(light: &AreaLight, point: &ShadingPoint, weights: &[f32], share: f32) -> f32 {
    let sum: f32 = weights.iter().sum();
    let whole = light.unshadowed(point.x, point.normal).unwrap_or(0.0) * FRAC_1_PI * share;
    if sum > 0.0 { whole / sum } else { 0.0 }
}

/// Samples asked about at once.
const MOST: usize = 256;

/// Shadow rays against a list of blockers.
struct Tracer {
    ways: Ways,
    blocks: Vec<TriangleBlock>,
    roots: Vec<Child>,
    few: Vec<SmallTriangle>,
    nodes: Vec<Node>,
    /// Nodes and blocks of the tree over the list, if there is one.
    grown: Option<(usize, usize)>,
    scratch: BatchScratch,
}

impl Tracer {
    fn new(ways: Ways) -> Self {
        Self {
            ways,
            blocks: Vec::new(),
            roots: Vec::new(),
            few: Vec::new(),
            nodes: Vec::new(),
            grown: None,
            scratch: BatchScratch::new(),
        }
    }

    /// Gathers what a list names: triangles by eights or as a tree, or subtrees.
    fn aim_at(&mut self, blockers: &BlockerSet, stage: &Stage<'_>, list: &[u32]) {
        let corners = |triangle| stage.scene.vertices(triangle).map(|corner| corner.to_array());
        self.blocks.clear();
        self.roots.clear();
        self.grown = None;
        match blockers {
            BlockerSet::Triangles if self.ways.trees && !list.is_empty() => {
                self.few.clear();
                self.few.extend(list.iter().map(|&id| SmallTriangle { corners: corners(id), id }));
                self.nodes.resize(SmallTree::nodes(list.len()), Node::EMPTY);
                self.blocks.resize(SmallTree::blocks(list.len()), TriangleBlock::EMPTY);
                let tree = SmallTree::new(&mut self.few, &mut self.nodes, &mut self.blocks);
                self.grown = tree.map(SmallTree::build);
            }
            BlockerSet::Triangles => {
                for eight in list.chunks(TriangleBlock::WIDTH) {
                    let mut block = TriangleBlock::EMPTY;
                    for (lane, &triangle) in eight.iter().enumerate() {
                        block.set(lane, corners(triangle), triangle);
                    }
                    self.roots.push(Child::leaf(self.blocks.len() as u32));
                    self.blocks.push(block);
                }
            }
            BlockerSet::Objects(..) => {}
            BlockerSet::Treelets(roots, _) => {
                self.roots.extend(list.iter().map(|&treelet| roots[treelet as usize]));
            }
        }
    }

    /// Asks what a list names; `blocked` has a bit for each target.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn trace<S: Simd>(
        &mut self,
        blockers: (&BlockerSet, &[Bvh<'_>]),
        (simd, bvh): (S, Bvh<'_, S>),
        list: &[u32],
        x: [f32; 3],
        targets: &Targets<'_>,
        counter: &mut Counts,
        blocked: &mut [u64],
    ) {
        if !self.ways.alone {
            self.trace_all(blockers, (simd, bvh), list, x, targets, counter, blocked);
            return;
        }
        blocked.fill(0);
        let mut i = 0;
        while i < targets.len() {
            let [tx, ty, tz] = targets.get(i).to_array();
            if let Some(one) = Targets::new(&[tx], &[ty], &[tz]) {
                let mut word = [0u64];
                self.trace_all(blockers, (simd, bvh), list, x, &one, counter, &mut word);
                blocked[i / 64] |= word[0] << (i % 64);
            }
            i += 1;
        }
    }

    /// In a function of its own, so that it is compiled once.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn trace_all<S: Simd>(
        &mut self,
        (blockers, objects): (&BlockerSet, &[Bvh<'_>]),
        (simd, bvh): (S, Bvh<'_, S>),
        list: &[u32],
        x: [f32; 3],
        targets: &Targets<'_>,
        counter: &mut Counts,
        blocked: &mut [u64],
    ) {
        simd.apart(
            #[inline(always)]
            || {
                let (tree, roots) = match blockers {
                    BlockerSet::Triangles => {
                        if let Some((nodes, blocks)) = self.grown {
                            let tree = bvh.with_small(&self.nodes[..nodes], &self.blocks[..blocks]);
                            let tree = tree.expect("the builder keeps the kernel's rules");
                            return trace_tree((simd, tree), x, targets, counter, &mut self.scratch, blocked);
                        }
                        (bvh.with_blocks(&self.blocks), &self.roots[..])
                    }
                    BlockerSet::Treelets(..) => (bvh, &self.roots[..]),
                    BlockerSet::Objects(..) => {
                        // Trees of their own, each asked about what the others leave; rays count once.
                        blocked.fill(0);
                        let mut by_one = [0u64; MOST / 64];
                        let rays = counter.rays + targets.len() as u64;
                        for &object in list {
                            let tree = (simd, objects[object as usize].on(simd));
                            trace_tree(tree, x, targets, counter, &mut self.scratch, &mut by_one);
                            for (word, more) in blocked.iter_mut().zip(by_one) {
                                *word |= more;
                            }
                        }
                        counter.rays = rays;
                        return;
                    }
                };
                tree.occluded_batch_by(roots, x, targets, None, counter, &mut self.scratch, blocked);
            },
        );
    }
}

/// Asks a tree, in a function of its own as well.
#[inline(always)]
fn trace_tree<S: Simd>(
    (simd, tree): (S, Bvh<'_, S>),
    x: [f32; 3],
    targets: &Targets<'_>,
    counter: &mut Counts,
    scratch: &mut BatchScratch,
    blocked: &mut [u64],
) {
    simd.apart(
        #[inline(always)]
        || tree.occluded_batch(x, targets, None, counter, scratch, blocked),
    );
}
