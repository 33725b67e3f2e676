//! Shoots photons through a scene and sorts them for look-ups.
//!
//! Lines leave the lights in proportion to their power, cosine distributed, and cross everything. The first surface
//! on a line keeps a light photon, every later one an occlusion photon with the blockers crossed before it. Surfaces
//! nearer together than the clearance of the tree count as one, as they do for shadow rays.
//!
//! A line's numbers follow from the seed and its index, and results are joined in the order of the indices: any
//! number of threads gives the same photons. With several rounds ([`Shower::shoot_in_rounds`]) the first is even, and
//! later ones go where shadows seem to begin and end.

mod rounds;

pub(crate) use rounds::{normal, scene_area};

use crate::accel::{Accel, Quality};
use crate::light::AreaLight;
use crate::sampler::Sampler;
use crate::scene::Scene;
use glam::Vec3;
use occlude_kernel::lanes::{Level, Task, dispatch};
use occlude_kernel::photons::{Nearest, Neighbour, PhotonBlock, PhotonId, PhotonTree, Photons, Point, Split};
use occlude_kernel::{
    Bvh, Child, Hit, LightPhoton, Native, OcclusionPhoton, PhotonMap, Ray, Simd, Uncounted, offset,
};
use rayon::prelude::*;
use rounds::Cells;
use std::f32::consts::TAU;
use std::fmt;
use std::ops::{ControlFlow, Range};
use std::str::FromStr;
use std::time::{Duration, Instant};

/// What a photon names when something was in its way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BlockerKind {
    /// The triangle.
    Triangle,
    /// The object of the file that it belongs to.
    Object,
    /// The subtree of the scene's tree that it belongs to, of at most this many triangles.
    Treelet(u32),
}

impl Default for BlockerKind {
    fn default() -> Self {
        Self::Treelet(128)
    }
}

impl fmt::Display for BlockerKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Triangle => f.write_str("triangle"),
            Self::Object => f.write_str("object"),
            Self::Treelet(size) => write!(f, "treelet:{size}"),
        }
    }
}

impl FromStr for BlockerKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let size = |text: &str| text.parse().ok().filter(|&size| size >= 8);
        match text.split_once(':') {
            None if text == "triangle" => Ok(Self::Triangle),
            None if text == "object" => Ok(Self::Object),
            Some(("treelet", text)) => size(text)
                .map(Self::Treelet)
                .ok_or_else(|| "a treelet has at least 8 triangles, like treelet:128".into()),
            _ => Err("wants triangle, object or treelet:SIZE, like treelet:128".into()),
        }
    }
}

/// The blockers of a scene: which triangle belongs to which, and what they are.
#[derive(Clone, Debug)]
pub enum BlockerSet {
    /// Each triangle is one, of its own number.
    Triangles,
    /// Each object is one; its triangles, and a tree of them.
    Objects(Vec<Range<u32>>, Vec<Accel>),
    /// Subtrees of the scene's tree, and which of them each triangle is in.
    Treelets(Vec<Child>, Vec<u32>),
}

impl BlockerSet {
    /// The blockers of a kind.
    pub fn new(kind: BlockerKind, scene: &Scene, bvh: &Bvh<'_>, quality: Quality) -> Self {
        match kind {
            BlockerKind::Triangle => Self::Triangles,
            BlockerKind::Object => {
                let objects: Vec<Range<u32>> = scene
                    .objects
                    .iter()
                    .map(|object| object.triangles.clone())
                    .filter(|triangles| !triangles.is_empty())
                    .collect();
                let tree = |triangles: &Range<u32>| {
                    let corners: Vec<[Vec3; 3]> = triangles.clone().map(|i| scene.vertices(i)).collect();
                    Accel::from_triangles(&corners, quality)
                };
                let trees = objects.par_iter().map(tree).collect();
                Self::Objects(objects, trees)
            }
            BlockerKind::Treelet(size) => {
                let roots = treelets(bvh, size);
                let mut of = vec![0; scene.triangles.len()];
                for (number, &root) in roots.iter().enumerate() {
                    below(bvh, root, &mut |triangle| of[triangle as usize] = number as u32);
                }
                Self::Treelets(roots, of)
            }
        }
    }

    /// The blocker that a triangle belongs to.
    #[inline]
    pub fn of(&self, triangle: u32) -> u32 {
        match self {
            Self::Triangles => triangle,
            Self::Objects(objects, _) => objects.partition_point(|object| object.end <= triangle) as u32,
            Self::Treelets(_, of) => of[triangle as usize],
        }
    }

    /// How many there are, of a scene of this many triangles.
    pub fn count(&self, triangles: usize) -> usize {
        match self {
            Self::Triangles => triangles,
            Self::Objects(objects, _) => objects.len(),
            Self::Treelets(roots, _) => roots.len(),
        }
    }
}

/// The largest subtrees of at most `size` triangles; a block of a leaf may stand alone. They hold every triangle once.
fn treelets(bvh: &Bvh<'_>, size: u32) -> Vec<Child> {
    let (nodes, blocks) = (bvh.nodes(), bvh.blocks());
    if nodes.is_empty() {
        return Vec::new();
    }
    let mut counts = vec![0u32; nodes.len()];
    let count = |counts: &[u32], child: Child| {
        let node = child.as_node().map(|node| counts[node]);
        node.or_else(|| child.as_leaf().map(|leaf| leaf.ids(blocks).len() as u32)).unwrap_or(0)
    };
    // Children come after their parents.
    for index in (0..nodes.len()).rev() {
        counts[index] = nodes[index].children.iter().map(|&child| count(&counts, child)).sum();
    }
    let (mut roots, mut stack) = (Vec::new(), vec![Child::node(0)]);
    while let Some(child) = stack.pop() {
        match child.as_node() {
            Some(node) if count(&counts, child) > size => stack.extend(nodes[node].children.iter().rev()),
            _ if count(&counts, child) > 0 => roots.push(child),
            _ => {}
        }
    }
    roots
}

/// Calls `each` with the triangles of a subtree.
fn below(bvh: &Bvh<'_>, root: Child, each: &mut impl FnMut(u32)) {
    let mut stack = vec![root];
    while let Some(child) = stack.pop() {
        if let Some(node) = child.as_node() {
            stack.extend(bvh.nodes()[node].children.iter().rev());
        } else if let Some(leaf) = child.as_leaf() {
            leaf.ids(bvh.blocks()).iter().for_each(|&id| each(id));
        }
    }
}

/// Blockers a line can name; those crossed later are dropped, and counted.
pub const MOST_BLOCKERS: usize = 64;

/// Photons a line can leave; those behind are dropped, and counted.
pub const MOST_PHOTONS: usize = 256;

/// Lines a task shoots.
const CHUNK: u64 = 2048;

/// The part of the random numbers that photons use; pixels use those of passes.
const STREAM: u32 = 0x5048_4f54;

/// What to shoot.
#[derive(Clone, Copy, Debug)]
pub struct Shower<'a> {
    /// The tree.
    pub bvh: Bvh<'a>,
    /// The lights.
    pub lights: &'a [AreaLight],
    /// What blocks.
    pub blockers: &'a BlockerSet,
    /// Lines in all.
    pub lines: u64,
    /// The seed.
    pub seed: u64,
    /// The SIMD level.
    pub level: Level,
}

/// How many lines a scene gets if nobody says: four a triangle, between 250 000 and 4 000 000.
pub fn default_lines(triangles: usize) -> u64 {
    (4 * triangles as u64).clamp(250_000, 4_000_000)
}

impl Shower<'_> {
    /// The first line of each light, and at the end the number of lines: in proportion to power, systematically, so
    /// that each count is within one of its due. Lights without power get none.
    pub fn shares(&self) -> Vec<u64> {
        self.shares_of(self.lines)
    }

    fn shares_of(&self, lines: u64) -> Vec<u64> {
        let power: Vec<f64> =
            self.lights.iter().map(|light| f64::from(light.power().element_sum())).collect();
        let total: f64 = power.iter().sum();
        let mut sum = 0.0;
        let mut firsts = vec![0];
        for (i, power) in power.iter().enumerate() {
            sum += power;
            let share = if i + 1 == self.lights.len() || total <= 0.0 { 1.0 } else { sum / total };
            firsts.push((share * lines as f64).round() as u64);
        }
        firsts
    }

    /// The ray of a line from a light: from a uniform point of it, in a cosine distributed direction of unit length.
    #[inline]
    pub fn ray(&self, line: u64, light: u32) -> Ray {
        self.ray_and_place(line, light).0
    }

    /// The same, and where on the light's unit square it starts.
    #[inline]
    pub fn ray_and_place(&self, line: u64, light: u32) -> (Ray, [f32; 2]) {
        let (ray, place, _) = self.even(line, light);
        (ray, place)
    }

    /// The same, and the direction as the square of a radius and an angle.
    #[inline]
    fn even(&self, line: u64, light: u32) -> (Ray, [f32; 2], [f32; 2]) {
        let mut sampler = Sampler::new(self.seed, line, STREAM);
        let place = [sampler.uniform(), sampler.uniform()];
        let (across, angle) = (sampler.uniform(), TAU * sampler.uniform());
        let radius = across.sqrt();
        let disc = [radius * angle.cos(), radius * angle.sin()];
        (self.leave(light, place, disc, across), place, [across, angle])
    }

    /// The ray from a place, in the direction whose foot on the disc is this, at this squared distance.
    #[inline]
    fn leave(&self, light: u32, place: [f32; 2], disc: [f32; 2], across: f32) -> Ray {
        let light = &self.lights[light as usize];
        let y = light.point(place);
        let (u, v) = light.normal.any_orthonormal_pair();
        let direction = u * disc[0] + v * disc[1] + light.normal * (1.0 - across).max(0.0).sqrt();
        Ray::from(offset(y, light.normal, self.bvh.clearance()), direction)
    }

    /// The ray of a line, and the cell it leaves from if there are any.
    fn ray_and_cell(&self, line: u64, light: u32, from: Source<'_>) -> (Ray, u32) {
        match from {
            Source::Anywhere(cells) => {
                let (ray, place, [across, angle]) = self.even(line, light);
                let cell = cells.map_or(0, |cells| cells.at(place, rounds::square(across.sqrt(), angle)));
                (ray, cell)
            }
            Source::Cells { cells, first, count } => {
                let mut sampler = Sampler::new(self.seed, line, STREAM);
                let uniform = [0; 4].map(|_| sampler.uniform());
                let (cell, place, direction) = cells.draw(line - first, count, uniform);
                let disc = rounds::disc(direction);
                (self.leave(light, place, disc, disc[0] * disc[0] + disc[1] * disc[1]), cell)
            }
        }
    }

    /// Shoots all lines and sorts what they leave, on the threads of the current pool.
    pub fn shoot(&self) -> PhotonStore {
        self.shoot_all(1, None)
    }

    /// The same in rounds: half of the lines evenly, and the other half in equal rounds, each of them to where the photons
    /// so far see shadows begin and end, or name different blockers. 0 rounds count as one.
    ///
    /// Later photons stand apart (see [`Photons::with_later`]). Costs, beside the lines, a look-up of 24 neighbours for
    /// each photon and later round, and sorting as often.
    pub fn shoot_in_rounds(&self, rounds: u32, scene: &Scene) -> PhotonStore {
        self.shoot_all(rounds, Some(scene))
    }

    fn shoot_all(&self, rounds: u32, scene: Option<&Scene>) -> PhotonStore {
        let start = Instant::now();
        let many = self.lights.len();
        let later = u64::from(rounds.saturating_sub(1)).min(self.lines / 2);
        let scene = scene.filter(|_| later > 0);
        let even = if scene.is_some() { self.lines - self.lines / 2 } else { self.lines };
        let mut store = PhotonStore {
            stats: ShowerStats { lines: self.lines, rounds: 1, ..Default::default() },
            ..Default::default()
        };
        let firsts = self.shares_of(even);
        let mut cells: Vec<Option<Cells>> =
            firsts.windows(2).map(|part| scene.map(|_| Cells::new(part[1] - part[0]))).collect();
        let mut ranges = vec![[Vec::new(), Vec::new()]; many];
        let mut from = [Vec::new(), Vec::new()];
        let anywhere = |light: usize| Source::Anywhere(cells[light].as_ref());
        self.round(0, &firsts, anywhere, &mut store, &mut ranges, &mut from);
        let evenly = ranges.clone();
        let mut done = even;
        if let Some(scene) = scene {
            for round in 1..=later {
                let judging = Instant::now();
                let next = even + (self.lines - even) * round / later;
                let firsts = self.shares_of(next - done);
                for (light, cells) in cells.iter_mut().enumerate().filter_map(|(i, c)| Some((i, c.as_mut()?)))
                {
                    let photons = [&ranges[light][0][..], &ranges[light][1][..]];
                    let of = [&from[0][..], &from[1][..]];
                    let points = rounds::score(self, scene, &store, of, photons, cells.count());
                    cells.divide(&points, firsts[light + 1] - firsts[light]);
                }
                store.stats.judged += judging.elapsed();
                let in_cells = |light: usize| {
                    let (first, count) = (done + firsts[light], firsts[light + 1] - firsts[light]);
                    cells[light].as_ref().map_or(Source::Anywhere(None), |cells| Source::Cells {
                        cells,
                        first,
                        count,
                    })
                };
                self.round(done, &firsts, in_cells, &mut store, &mut ranges, &mut from);
                store.stats.rounds += 1;
                done = next;
            }
        }
        store.stats.later_lines = self.lines - even;
        store.stats.shot = start.elapsed() - store.stats.judged;

        let start = Instant::now();
        let (light, occlusion) = (&store.light, &store.occlusion);
        let sort = |(all, even): (&Ranges, &Ranges)| {
            let sorted = |skip: [usize; 2], take: [usize; 2]| {
                let of = |kind: usize| &all[kind][skip[kind]..skip[kind] + take[kind]];
                Sorted::new([of(0), of(1)], light, occlusion)
            };
            let evenly = [even[0].len(), even[1].len()];
            let rest = [all[0].len() - evenly[0], all[1].len() - evenly[1]];
            Tree { even: sorted([0; 2], evenly), later: sorted(evenly, rest) }
        };
        let trees = ranges.par_iter().zip(&evenly).map(sort).collect();
        store.trees = trees;
        store.stats.sorted = start.elapsed();
        store
    }

    /// Shoots the lines of a round, those of each light from `firsts` on, and appends what they leave.
    fn round<'c>(
        &self,
        base: u64,
        firsts: &[u64],
        from: impl Fn(usize) -> Source<'c> + Sync,
        store: &mut PhotonStore,
        ranges: &mut [Ranges],
        cells: &mut [Vec<u32>; 2],
    ) {
        let parts: Vec<(u32, Range<u64>)> = firsts
            .windows(2)
            .zip(0u32..)
            .flat_map(|(lines, light)| {
                let (first, end) = (base + lines[0], base + lines[1]);
                (first..end).step_by(CHUNK as usize).map(move |from| (light, from..end.min(from + CHUNK)))
            })
            .collect();
        let trails: Vec<Trails> = parts
            .par_iter()
            .map(|(light, lines)| {
                let from = from(*light as usize);
                dispatch(self.level, Cross { shower: self, light: *light, lines: lines.clone(), from })
            })
            .collect();
        let total = |size: fn(&Trails) -> usize| trails.iter().map(size).sum::<usize>();
        store.light.reserve(total(|t| t.light.len()));
        store.occlusion.reserve(total(|t| t.occlusion.len()));
        store.blockers.reserve(total(|t| t.blockers.len()));
        let mut trails = trails.iter().zip(&parts).peekable();
        for light in 0..firsts.len() as u32 - 1 {
            let before = (store.light.len(), store.occlusion.len());
            while let Some((trail, _)) = trails.next_if(|(_, (of, _))| *of == light) {
                let base = store.blockers.len() as u32;
                store.light.extend_from_slice(&trail.light);
                store
                    .occlusion
                    .extend(trail.occlusion.iter().map(|p| OcclusionPhoton { first: p.first + base, ..*p }));
                store.blockers.extend_from_slice(&trail.blockers);
                store
                    .surfaces
                    .iter_mut()
                    .zip(&trail.surfaces)
                    .for_each(|(to, from)| to.extend_from_slice(from));
                cells.iter_mut().zip(&trail.cells).for_each(|(to, from)| to.extend_from_slice(from));
                store.stats.dropped_blockers += trail.dropped_blockers;
                store.stats.dropped_photons += trail.dropped_photons;
                store.stats.lost += trail.lost;
            }
            ranges[light as usize][0].push(before.0..store.light.len());
            ranges[light as usize][1].push(before.1..store.occlusion.len());
        }
    }
}

/// Light and occlusion photons of one light, a range a round.
type Ranges = [Vec<Range<usize>>; 2];

/// Where lines leave from.
#[derive(Clone, Copy)]
enum Source<'a> {
    /// Evenly; into which cells that falls is told if there are any.
    Anywhere(Option<&'a Cells>),
    /// From the cells that are due most.
    Cells { cells: &'a Cells, first: u64, count: u64 },
}

/// Builds a tree, each half of a large part in a thread of its own.
pub fn build(blocks: &mut [PhotonBlock], splits: &mut [Split]) {
    fn part(tree: PhotonTree<'_>) {
        if tree.blocks() < 1024 {
            tree.build();
        } else if let Some((left, right)) = tree.halve() {
            rayon::join(|| part(left), || part(right));
        }
    }
    part(PhotonTree::new(blocks, splits).expect("a split for each block"));
}

/// What some lines left.
#[derive(Default)]
struct Trails {
    light: Vec<LightPhoton>,
    occlusion: Vec<OcclusionPhoton>,
    blockers: Vec<u32>,
    /// The triangle of each photon, by kind.
    surfaces: [Vec<u32>; 2],
    /// The cell that each photon's line left from, by kind, if there are cells.
    cells: [Vec<u32>; 2],
    dropped_blockers: u64,
    dropped_photons: u64,
    lost: u64,
}

/// Shoots some lines of a light.
struct Cross<'a> {
    shower: &'a Shower<'a>,
    light: u32,
    lines: Range<u64>,
    from: Source<'a>,
}

impl Task for Cross<'_> {
    type Output = Trails;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Trails {
        let bvh = self.shower.bvh.on(simd);
        let mut trails = Trails::default();
        let mut hits: Vec<Hit> = Vec::new();
        let mut line = self.lines.start;
        while line < self.lines.end {
            let (ray, cell) = self.shower.ray_and_cell(line, self.light, self.from);
            hits.clear();
            bvh.each_hit(&ray, None, &mut Uncounted, |hit| {
                hits.push(hit);
                ControlFlow::Continue(())
            });
            trails.leave(self.shower, self.light, &ray, &mut hits);
            if !matches!(self.from, Source::Anywhere(None)) {
                trails.came_from(cell);
            }
            line += 1;
        }
        trails
    }
}

impl Trails {
    /// Notes the cell of the photons that have none yet.
    fn came_from(&mut self, cell: u32) {
        self.cells[0].resize(self.light.len(), cell);
        self.cells[1].resize(self.occlusion.len(), cell);
    }

    /// Turns the hits of a line, in any order, into photons.
    fn leave(&mut self, shower: &Shower<'_>, light: u32, ray: &Ray, hits: &mut Vec<Hit>) {
        if hits.is_empty() {
            self.lost += 1;
            return;
        }
        hits.sort_unstable_by(|a, b| a.t.total_cmp(&b.t).then(a.triangle.cmp(&b.triangle)));
        hits.dedup_by_key(|hit| hit.triangle);
        let clearance = shower.bvh.clearance();
        let first = self.blockers.len();
        let (mut at, mut photons) = (0, 0);
        while at < hits.len() {
            // All of one surface: what is nearer together than shadow rays can tell.
            let surface = hits[at].t;
            let position = ray.at(surface).to_array();
            let known = self.blockers.len() - first;
            if photons == MOST_PHOTONS {
                self.dropped_photons += 1;
            } else if photons == 0 {
                self.light.push(LightPhoton { position, light });
                self.surfaces[0].push(hits[at].triangle);
                photons += 1;
            } else {
                self.occlusion.push(OcclusionPhoton {
                    position,
                    light,
                    first: first as u32,
                    len: known as u32,
                });
                self.surfaces[1].push(hits[at].triangle);
                photons += 1;
            }
            while at < hits.len() && hits[at].t <= surface + clearance {
                let blocker = shower.blockers.of(hits[at].triangle);
                at += 1;
                if self.blockers[first..].contains(&blocker) {
                    continue;
                }
                if self.blockers.len() - first == MOST_BLOCKERS {
                    self.dropped_blockers += 1;
                } else {
                    self.blockers.push(blocker);
                }
            }
        }
        // What only the last surface adds, nobody names.
        if let Some(last) = self.occlusion.last().filter(|last| photons > 1 && last.first == first as u32) {
            self.blockers.truncate(first + last.len as usize);
        } else if photons < 2 {
            self.blockers.truncate(first);
        }
    }
}

/// The photons of one light, sorted: those of the first round, and those of later ones.
#[derive(Clone, Debug, Default)]
struct Tree {
    even: Sorted,
    later: Sorted,
}

/// A map's memory.
#[derive(Clone, Debug, Default)]
struct Sorted {
    blocks: Vec<PhotonBlock>,
    splits: Vec<Split>,
}

impl Sorted {
    /// Of ranges of light photons and of occlusion photons.
    fn new(ranges: [&[Range<usize>]; 2], light: &[LightPhoton], occlusion: &[OcclusionPhoton]) -> Self {
        let count: usize = ranges.iter().flat_map(|ranges| ranges.iter()).map(Range::len).sum();
        let mut sorted = Self::default();
        sorted.blocks = vec![PhotonBlock::EMPTY; count.div_ceil(PhotonBlock::WIDTH)];
        sorted.splits = vec![Split::NONE; sorted.blocks.len()];
        let points = PhotonBlock::as_points(&mut sorted.blocks);
        points.fill(Point::NONE);
        let [first, rest] = ranges;
        let first = first.iter().cloned().flatten();
        let rest = rest.iter().cloned().flatten();
        let all = first.map(|i| Point { position: light[i].position, id: PhotonId::light(i as u32) }).chain(
            rest.map(|i| Point { position: occlusion[i].position, id: PhotonId::occlusion(i as u32) }),
        );
        points.iter_mut().zip(all).for_each(|(point, photon)| *point = photon);
        build(&mut sorted.blocks, &mut sorted.splits);
        sorted
    }

    fn bytes(&self) -> usize {
        size_of_val(&*self.blocks) + size_of_val(&*self.splits)
    }
}

/// How far to look for the `k` nearest of this many photons: three times as far as they are on average, if they
/// lay evenly on this area.
fn reach(k: usize, area: f64, photons: usize) -> f32 {
    (3.0 * (k as f64 * area / (std::f64::consts::PI * photons.max(1) as f64)).sqrt()) as f32
}

/// What a shower was like.
#[derive(Clone, Copy, Debug, Default)]
pub struct ShowerStats {
    /// Lines shot.
    pub lines: u64,
    /// Rounds they were shot in, the even one counted.
    pub rounds: u32,
    /// Lines of the rounds after the even one.
    pub later_lines: u64,
    /// Lines that met nothing.
    pub lost: u64,
    /// Names left out of lines that crossed more than [`MOST_BLOCKERS`].
    pub dropped_blockers: u64,
    /// Photons left out of lines that crossed more than [`MOST_PHOTONS`] surfaces.
    pub dropped_photons: u64,
    /// Time to shoot, on the clock.
    pub shot: Duration,
    /// Time to find where later rounds should go, on the clock.
    pub judged: Duration,
    /// Time to join and sort, on the clock.
    pub sorted: Duration,
}

/// All photons, sorted by light.
#[derive(Clone, Debug, Default)]
pub struct PhotonStore {
    light: Vec<LightPhoton>,
    occlusion: Vec<OcclusionPhoton>,
    blockers: Vec<u32>,
    surfaces: [Vec<u32>; 2],
    trees: Vec<Tree>,
    /// How it came about.
    pub stats: ShowerStats,
}

impl PhotonStore {
    /// Light photons, in the order of their lines.
    pub fn light(&self) -> &[LightPhoton] {
        &self.light
    }

    /// Occlusion photons, in the order of their lines and along each.
    pub fn occlusion(&self) -> &[OcclusionPhoton] {
        &self.occlusion
    }

    /// The blockers that an occlusion photon names, in the order of the line.
    pub fn named(&self, photon: &OcclusionPhoton) -> &[u32] {
        &self.blockers[photon.first as usize..(photon.first + photon.len) as usize]
    }

    /// Where a photon is.
    pub fn position(&self, id: PhotonId) -> [f32; 3] {
        if id.is_light() { self.light[id.index()].position } else { self.occlusion[id.index()].position }
    }

    /// The triangle it lies on.
    pub fn surface(&self, id: PhotonId) -> u32 {
        self.surfaces[usize::from(!id.is_light())][id.index()]
    }

    /// The photons of each light, to ask. Checks them, so ask for it once a render.
    pub fn by_light<'a>(&'a self) -> Vec<Photons<'a, Native>> {
        let map = |sorted: &'a Sorted| {
            PhotonMap::new(&sorted.blocks, &sorted.splits).expect("the builder keeps the kernel's rules")
        };
        let photons = |tree: &'a Tree| {
            let photons = Photons::new(map(&tree.even), &self.occlusion, &self.blockers);
            photons
                .and_then(|photons| photons.with_later(map(&tree.later)))
                .expect("photons name what was kept")
        };
        self.trees.iter().map(photons).collect()
    }

    /// How far to look for the `k` nearest photons of a light: three times as far as those of the first, even round are
    /// on average, if they lay evenly on this area.
    pub fn radius(&self, light: usize, k: usize, area: f64) -> f32 {
        let used = |block: &PhotonBlock| block.ids.iter().filter(|&&id| id != PhotonId::NONE).count();
        reach(k, area, self.trees[light].even.blocks.iter().map(used).sum())
    }

    /// Bytes of all of it.
    pub fn bytes(&self) -> usize {
        let trees = self.trees.iter().map(|tree| tree.even.bytes() + tree.later.bytes());
        size_of_val(&*self.light)
            + size_of_val(&*self.occlusion)
            + size_of_val(&*self.blockers)
            + self.surfaces.iter().map(|surfaces| size_of_val(&**surfaces)).sum::<usize>()
            + trees.sum::<usize>()
    }
}

/// Slots for a look-up: of the k nearest photons of the first round, and of up to four times as many of later ones.
pub fn slots(k: usize) -> Vec<Neighbour> {
    vec![Neighbour::NONE; Nearest::room(k) + Nearest::room(LATER * k)]
}

/// How many photons of later rounds count beside each of the first.
const LATER: usize = 4;
