//! Shoots photons through a scene and sorts them for look-ups.
//!
//! Lines leave the lights in proportion to their power, cosine distributed, and cross everything. The first surface
//! on a line keeps a light photon, every later one an occlusion photon with the blockers crossed before it. Surfaces
//! nearer together than the clearance of the tree count as one, as they do for shadow rays.
//!
//! A line's numbers follow from the seed and its index, and results are joined in the order of the indices: any
//! number of threads gives the same photons.

use crate::accel::{Accel, Quality};
use crate::light::AreaLight;
use crate::sampler::Sampler;
use crate::scene::Scene;
use glam::Vec3;
use occlude_kernel::lanes::{Level, Task, dispatch};
use occlude_kernel::photons::{PhotonBlock, PhotonId, PhotonTree, Photons, Point, Split};
use occlude_kernel::{
    Bvh, Child, Hit, LightPhoton, NO_TRIANGLE, Native, OcclusionPhoton, PhotonMap, Ray, Simd, Uncounted,
    offset,
};
use rayon::prelude::*;
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
        node.or_else(|| child.as_leaf().map(|leaf| blocks[leaf].len() as u32)).unwrap_or(0)
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
            bvh.blocks()[leaf].ids.iter().filter(|&&id| id != NO_TRIANGLE).for_each(|&id| each(id));
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
        let power: Vec<f64> =
            self.lights.iter().map(|light| f64::from(light.power().element_sum())).collect();
        let total: f64 = power.iter().sum();
        let mut sum = 0.0;
        let mut firsts = vec![0];
        for (i, power) in power.iter().enumerate() {
            sum += power;
            let share = if i + 1 == self.lights.len() || total <= 0.0 { 1.0 } else { sum / total };
            firsts.push((share * self.lines as f64).round() as u64);
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
        let light = &self.lights[light as usize];
        let mut sampler = Sampler::new(self.seed, line, STREAM);
        let place = [sampler.uniform(), sampler.uniform()];
        let y = light.point(place);
        let (across, angle) = (sampler.uniform(), TAU * sampler.uniform());
        let radius = across.sqrt();
        let (u, v) = light.normal.any_orthonormal_pair();
        let direction =
            u * (radius * angle.cos()) + v * (radius * angle.sin()) + light.normal * (1.0 - across).sqrt();
        (Ray::from(offset(y, light.normal, self.bvh.clearance()), direction), place)
    }

    /// Shoots all lines and sorts what they leave, on the threads of the current pool.
    pub fn shoot(&self) -> PhotonStore {
        let start = Instant::now();
        let firsts = self.shares();
        let parts: Vec<(u32, Range<u64>)> = firsts
            .windows(2)
            .zip(0u32..)
            .flat_map(|(lines, light)| {
                let (first, end) = (lines[0], lines[1]);
                (first..end).step_by(CHUNK as usize).map(move |from| (light, from..end.min(from + CHUNK)))
            })
            .collect();
        let trails: Vec<Trails> = parts
            .par_iter()
            .map(|(light, lines)| {
                dispatch(self.level, Cross { shower: self, light: *light, lines: lines.clone() })
            })
            .collect();
        let shot = start.elapsed();

        let start = Instant::now();
        let total = |size: fn(&Trails) -> usize| trails.iter().map(size).sum::<usize>();
        let mut store = PhotonStore {
            light: Vec::with_capacity(total(|t| t.light.len())),
            occlusion: Vec::with_capacity(total(|t| t.occlusion.len())),
            blockers: Vec::with_capacity(total(|t| t.blockers.len())),
            trees: Vec::with_capacity(self.lights.len()),
            stats: ShowerStats { lines: self.lines, shot, ..Default::default() },
        };
        let mut trails = trails.iter().zip(&parts).peekable();
        for light in 0..self.lights.len() as u32 {
            let before = (store.light.len(), store.occlusion.len());
            while let Some((trail, _)) = trails.next_if(|(_, (of, _))| *of == light) {
                let base = store.blockers.len() as u32;
                store.light.extend_from_slice(&trail.light);
                store
                    .occlusion
                    .extend(trail.occlusion.iter().map(|p| OcclusionPhoton { first: p.first + base, ..*p }));
                store.blockers.extend_from_slice(&trail.blockers);
                store.stats.dropped_blockers += trail.dropped_blockers;
                store.stats.dropped_photons += trail.dropped_photons;
                store.stats.lost += trail.lost;
            }
            let ranges = (before.0..store.light.len(), before.1..store.occlusion.len());
            store.trees.push(Tree { light: ranges.0, occlusion: ranges.1, ..Default::default() });
        }
        let (light, occlusion) = (&store.light, &store.occlusion);
        store.trees.par_iter_mut().for_each(|tree| tree.sort(light, occlusion));
        store.stats.sorted = start.elapsed();
        store
    }
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
    dropped_blockers: u64,
    dropped_photons: u64,
    lost: u64,
}

/// Shoots some lines of a light.
struct Cross<'a> {
    shower: &'a Shower<'a>,
    light: u32,
    lines: Range<u64>,
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
            let ray = self.shower.ray(line, self.light);
            hits.clear();
            bvh.each_hit(&ray, None, &mut Uncounted, |hit| {
                hits.push(hit);
                ControlFlow::Continue(())
            });
            trails.leave(self.shower, self.light, &ray, &mut hits);
            line += 1;
        }
        trails
    }
}

impl Trails {
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
                photons += 1;
            } else {
                self.occlusion.push(OcclusionPhoton {
                    position,
                    light,
                    first: first as u32,
                    len: known as u32,
                });
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

/// The photons of one light, sorted.
#[derive(Clone, Debug, Default)]
struct Tree {
    light: Range<usize>,
    occlusion: Range<usize>,
    blocks: Vec<PhotonBlock>,
    splits: Vec<Split>,
}

impl Tree {
    fn sort(&mut self, light: &[LightPhoton], occlusion: &[OcclusionPhoton]) {
        let count = self.light.len() + self.occlusion.len();
        self.blocks = vec![PhotonBlock::EMPTY; count.div_ceil(PhotonBlock::WIDTH)];
        self.splits = vec![Split::NONE; self.blocks.len()];
        let points = PhotonBlock::as_points(&mut self.blocks);
        points.fill(Point::NONE);
        let (first, rest) = points.split_at_mut(self.light.len());
        for (point, i) in first.iter_mut().zip(self.light.clone()) {
            *point = Point { position: light[i].position, id: PhotonId::light(i as u32) };
        }
        for (point, i) in rest.iter_mut().zip(self.occlusion.clone()) {
            *point = Point { position: occlusion[i].position, id: PhotonId::occlusion(i as u32) };
        }
        build(&mut self.blocks, &mut self.splits);
    }
}

/// What a shower was like.
#[derive(Clone, Copy, Debug, Default)]
pub struct ShowerStats {
    /// Lines shot.
    pub lines: u64,
    /// Lines that met nothing.
    pub lost: u64,
    /// Names left out of lines that crossed more than [`MOST_BLOCKERS`].
    pub dropped_blockers: u64,
    /// Photons left out of lines that crossed more than [`MOST_PHOTONS`] surfaces.
    pub dropped_photons: u64,
    /// Time to shoot, on the clock.
    pub shot: Duration,
    /// Time to join and sort, on the clock.
    pub sorted: Duration,
}

/// All photons, sorted by light.
#[derive(Clone, Debug)]
pub struct PhotonStore {
    light: Vec<LightPhoton>,
    occlusion: Vec<OcclusionPhoton>,
    blockers: Vec<u32>,
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

    /// The photons of each light, to ask. Checks them, so ask for it once a render.
    pub fn by_light<'a>(&'a self) -> Vec<Photons<'a, Native>> {
        let photons = |tree: &'a Tree| {
            let Tree { blocks, splits, .. } = tree;
            let map = PhotonMap::new(blocks, splits).expect("the builder keeps the kernel's rules");
            Photons::new(map, &self.occlusion, &self.blockers).expect("photons name what was kept")
        };
        self.trees.iter().map(photons).collect()
    }

    /// How far to look for the `k` nearest photons of a light: three times as far as they are on average, if photons
    /// lay evenly on this area.
    pub fn radius(&self, light: usize, k: usize, area: f64) -> f32 {
        let tree = &self.trees[light];
        let photons = (tree.light.len() + tree.occlusion.len()).max(1);
        (3.0 * (k as f64 * area / (std::f64::consts::PI * photons as f64)).sqrt()) as f32
    }

    /// Bytes of all of it.
    pub fn bytes(&self) -> usize {
        let trees = self.trees.iter().map(|tree| size_of_val(&*tree.blocks) + size_of_val(&*tree.splits));
        size_of_val(&*self.light)
            + size_of_val(&*self.occlusion)
            + size_of_val(&*self.blockers)
            + trees.sum::<usize>()
    }
}
