//! Oracles and shared set-up for the tests.

pub mod meshes;

use glam::{DVec3, Vec3};
use occlude_kernel::lanes::{self, Level, Task};
use occlude_kernel::{
    BatchScratch, Bvh, Child, Counts, Hit, HitPacket, Native, Node, Ray, RayPacket, Scalar, Simd, Targets,
    TilePoint, TileScratch, TriangleBlock, Uncounted,
};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use std::fmt;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Three corners.
pub type Triangle = [Vec3; 3];

/// Random numbers that are the same in every run.
#[derive(Clone, Debug)]
pub struct Random(Xoshiro256PlusPlus);

impl Random {
    /// A stream of its own for each seed.
    pub fn new(seed: u64) -> Self {
        Self(Xoshiro256PlusPlus::seed_from_u64(seed))
    }

    /// Any 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0.next_u64()
    }

    /// From 0 up to but without 1.
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 * (1.0 / 16_777_216.0)
    }

    /// Between two numbers.
    pub fn between(&mut self, least: f32, most: f32) -> f32 {
        least + (most - least) * self.unit()
    }

    /// An index below `count`.
    pub fn below(&mut self, count: usize) -> usize {
        (self.bits() % count as u64) as usize
    }

    /// A point of the box from -1 to 1.
    pub fn point(&mut self) -> Vec3 {
        Vec3::new(self.between(-1.0, 1.0), self.between(-1.0, 1.0), self.between(-1.0, 1.0))
    }

    /// A unit vector, every direction equally likely.
    pub fn direction(&mut self) -> Vec3 {
        loop {
            let point = self.point();
            let length = point.length();
            if length > 0.01 && length <= 1.0 {
                return point / length;
            }
        }
    }

    /// A number of any sign and magnitude between two powers of ten.
    pub fn any_scale(&mut self, least: f32, most: f32) -> f32 {
        let sign = if self.bits() & 1 == 0 { 1.0 } else { -1.0 };
        sign * 10.0f32.powf(self.between(least, most))
    }

    /// A point of a triangle.
    pub fn on_triangle(&mut self, triangle: &Triangle) -> Vec3 {
        let (mut u, mut v) = (self.unit(), self.unit());
        if u + v > 1.0 {
            (u, v) = (1.0 - u, 1.0 - v);
        }
        let [a, b, c] = *triangle;
        a * (1.0 - u - v) + b * u + c * v
    }
}

/// A family of vectors that this machine can run.
#[derive(Clone, Copy, Debug)]
pub enum Family {
    /// One lane.
    Scalar,
    /// What the tests are compiled for.
    Native,
    /// Sixteen lanes a packet, whatever the CPU's registers hold.
    Sixteen,
    /// Chosen at run time.
    Level(Level),
}

impl Family {
    /// All of them.
    pub fn all() -> Vec<Self> {
        [Self::Scalar, Self::Native, Self::Sixteen]
            .into_iter()
            .chain(lanes::levels().map(Self::Level))
            .collect()
    }

    /// The fastest.
    pub fn best() -> Self {
        Self::Level(lanes::detect())
    }

    /// Runs a task with its vectors.
    pub fn run<T: Task>(self, task: T) -> T::Output {
        match self {
            Self::Scalar => task.run(Scalar),
            Self::Native => task.run(Native),
            Self::Sixteen => task.run(Sixteen),
            Self::Level(level) => lanes::dispatch(level, task),
        }
    }
}

impl fmt::Display for Family {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Scalar => f.write_str("scalar"),
            Self::Native => f.write_str("native"),
            Self::Sixteen => f.write_str("sixteen"),
            Self::Level(level) => f.write_str(lanes::level_name(*level)),
        }
    }
}

/// The vectors of [`Family::Sixteen`].
#[derive(Clone, Copy, Debug)]
pub struct Sixteen;

impl Simd for Sixteen {
    type Token = ();
    type Node = wide::f32x8;
    type Packet = wide::f32x16;

    fn token(self) {}

    fn apart<R>(self, work: impl FnOnce() -> R) -> R {
        work()
    }
}

/// A tree asked with the vectors of a family. One copy of every query is compiled here, for all tests.
#[derive(Clone, Copy, Debug)]
pub struct On<'a> {
    /// The tree.
    pub bvh: Bvh<'a>,
    /// The vectors.
    pub family: Family,
}

/// A query of [`Bvh`] as a method of [`On`].
macro_rules! query {
    ($q:lifetime, $name:ident($($arg:ident: $type:ty),*) -> $output:ty) => {
        #[doc = concat!("[`Bvh::", stringify!($name), "`].")]
        #[allow(clippy::too_many_arguments)]
        pub fn $name<$q>(&$q self, $($arg: $type),*) -> $output {
            struct Ask<$q> {
                bvh: Bvh<$q>,
                $($arg: $type),*
            }
            impl Task for Ask<'_> {
                type Output = $output;
                #[inline(always)]
                fn run<S: Simd>(self, simd: S) -> $output {
                    self.bvh.on(simd).$name($(self.$arg),*)
                }
            }
            self.family.run(Ask { bvh: self.bvh, $($arg),* })
        }
    };
}

impl On<'_> {
    query!('q, occluded(ray: &'q Ray, ignore: Option<u32>, counts: &'q mut Counts) -> bool);
    query!('q, occluder(ray: &'q Ray, ignore: Option<u32>, counts: &'q mut Counts) -> Option<u32>);
    query!('q, closest(ray: &'q Ray, ignore: Option<u32>, counts: &'q mut Counts) -> Option<Hit>);
    query!('q, each_hit(ray: &'q Ray, ignore: Option<u32>, counts: &'q mut Counts,
        visit: &'q mut dyn FnMut(Hit) -> ControlFlow<()>) -> ());
    query!('q, each_hit_in_order(ray: &'q Ray, ignore: Option<u32>, counts: &'q mut Counts,
        visit: &'q mut dyn FnMut(Hit) -> ControlFlow<()>) -> ());
    query!('q, occluded_packet(rays: &'q RayPacket, active: u32, ignore: Option<u32>,
        counts: &'q mut Counts) -> u32);
    query!('q, occluder_packet(rays: &'q RayPacket, active: u32, ignore: Option<u32>,
        counts: &'q mut Counts) -> [Option<u32>; 16]);
    query!('q, closest_packet(rays: &'q RayPacket, active: u32, ignore: Option<u32>,
        counts: &'q mut Counts) -> HitPacket);
    query!('q, each_hit_packet(rays: &'q RayPacket, active: u32, ignore: Option<u32>,
        counts: &'q mut Counts, visit: &'q mut dyn FnMut(usize, Hit) -> ControlFlow<()>) -> ());
    query!('q, occluded_batch(x: [f32; 3], targets: &'q Targets<'q>, ignore: Option<u32>,
        counts: &'q mut Counts, scratch: &'q mut BatchScratch, blocked: &'q mut [u64]) -> ());
    query!('q, occluded_tile(points: &'q [TilePoint], targets: &'q Targets<'q>, ignore: Option<u32>,
        counts: &'q mut Counts, scratch: &'q mut TileScratch, blocked: &'q mut [u64]) -> ());

    /// Every hit of a ray, nearest first.
    pub fn hits(&self, ray: &Ray, ignore: Option<u32>) -> Vec<Hit> {
        let mut hits = Vec::new();
        self.each_hit(ray, ignore, &mut Counts::default(), &mut |hit| {
            hits.push(hit);
            ControlFlow::Continue(())
        });
        sort(&mut hits);
        hits
    }

    /// Every hit of a ray, as [`Bvh::each_hit_in_order`] tells them.
    pub fn hits_in_order(&self, ray: &Ray, ignore: Option<u32>) -> Vec<Hit> {
        let mut hits = Vec::new();
        self.each_hit_in_order(ray, ignore, &mut Counts::default(), &mut |hit| {
            hits.push(hit);
            ControlFlow::Continue(())
        });
        hits
    }

    /// Every hit of each ray of a packet, nearest first.
    pub fn hits_packet(&self, rays: &RayPacket, active: u32, ignore: Option<u32>) -> [Vec<Hit>; 16] {
        let mut hits = [const { Vec::new() }; 16];
        self.each_hit_packet(rays, active, ignore, &mut Counts::default(), &mut |ray, hit| {
            hits[ray].push(hit);
            ControlFlow::Continue(())
        });
        hits.iter_mut().for_each(|hits| sort(hits));
        hits
    }
}

/// A tree with the vectors of every family.
pub fn families(bvh: Bvh<'_>) -> Vec<On<'_>> {
    Family::all().into_iter().map(|family| On { bvh, family }).collect()
}

/// From near to far; of hits at the same `t`, and zero is the same with either sign, the lower number first.
fn sort(hits: &mut [Hit]) {
    hits.sort_by(|a, b| a.t.partial_cmp(&b.t).expect("numbers").then(a.triangle.cmp(&b.triangle)));
}

/// A hit as bits, to compare.
pub fn bits(hit: &Hit) -> [u32; 4] {
    [hit.t.to_bits(), hit.u.to_bits(), hit.v.to_bits(), hit.triangle]
}

/// Hits as bits, to compare.
pub fn all_bits(hits: &[Hit]) -> Vec<[u32; 4]> {
    hits.iter().map(bits).collect()
}

/// A loop over all triangles, one lane and one block at a time: each block under a box that nothing misses.
#[derive(Clone, Debug)]
pub struct Oracle {
    root: [Node; 1],
    blocks: Vec<TriangleBlock>,
}

impl Oracle {
    /// Of these triangles, by their indices.
    pub fn new(triangles: &[Triangle]) -> Self {
        let mut root = Node::EMPTY;
        root.set(0, [-1e30; 3], [1e30; 3], Child::leaf(0));
        let blocks = triangles
            .chunks(TriangleBlock::WIDTH)
            .zip((0u32..).step_by(TriangleBlock::WIDTH))
            .map(|(triangles, first)| block(triangles, first))
            .collect();
        Self { root: [root], blocks }
    }

    /// Every hit of the ray, nearest first.
    pub fn hits(&self, ray: &Ray, ignore: Option<u32>) -> Vec<Hit> {
        let mut hits = Vec::new();
        for block in self.blocks.chunks(1) {
            let bvh = Bvh::new(&self.root, block).expect("a block is a tree").on(Scalar);
            bvh.each_hit(ray, ignore, &mut Uncounted, |hit| {
                hits.push(hit);
                ControlFlow::Continue(())
            });
        }
        sort(&mut hits);
        hits
    }
}

/// Up to eight triangles, numbered from `first`.
pub fn block(triangles: &[Triangle], first: u32) -> TriangleBlock {
    let mut block = TriangleBlock::EMPTY;
    for (lane, triangle) in triangles.iter().enumerate() {
        block.set(lane, triangle.map(|vertex| vertex.to_array()), first + lane as u32);
    }
    block
}

/// The box of points.
pub fn bounds(points: impl IntoIterator<Item = Vec3>) -> (Vec3, Vec3) {
    points.into_iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lower, upper), point| {
        (lower.min(point), upper.max(point))
    })
}

/// A tree of one node over up to 64 triangles, with tight boxes.
pub fn single_node(triangles: &[Triangle]) -> ([Node; 1], Vec<TriangleBlock>) {
    let mut root = Node::EMPTY;
    let mut blocks = Vec::new();
    for (place, chunk) in triangles.chunks(TriangleBlock::WIDTH).enumerate() {
        let (lower, upper) = bounds(chunk.iter().flatten().copied());
        root.set(place, lower.to_array(), upper.to_array(), Child::leaf(place as u32));
        blocks.push(block(chunk, (place * TriangleBlock::WIDTH) as u32));
    }
    ([root], blocks)
}

/// What mathematics says, where it is clear.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Clear {
    /// A hit at this `t`, by a good margin.
    Hit(f64),
    /// No hit, by a good margin.
    Miss,
    /// Too close for single precision to tell.
    Unclear,
}

/// Ray and triangle in double precision, by the signed volumes of the ray and the edges.
///
/// The margin is `1e-5`: of the triangle for the weights, of `t` for the ends of the ray.
pub fn in_double(ray: &Ray, triangle: &Triangle) -> Clear {
    const MARGIN: f64 = 1e-5;
    let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
    let [a, b, c] = triangle.map(|vertex| vertex.as_dvec3() - origin);
    let weights = [c.cross(b), a.cross(c), b.cross(a)].map(|normal: DVec3| normal.dot(direction));
    let det: f64 = weights.iter().sum();
    let normal = (b - a).cross(c - a);
    let reach = [a, b, c].iter().map(|vertex| vertex.length()).fold(0.0, f64::max);
    let longest = [b - a, c - b, a - c].iter().map(|edge| edge.length()).fold(0.0, f64::max);
    // Edge-on, a sliver, or small for its distance.
    if det.abs() < 1e-2 * longest * longest * direction.length() || longest < 1e-2 * reach {
        return Clear::Unclear;
    }
    let least = weights.iter().map(|weight| weight / det).fold(f64::INFINITY, f64::min);
    let t = normal.dot(a) / normal.dot(direction);
    let slack = MARGIN * t.abs().max(reach / direction.length());
    let (first, last) = (f64::from(ray.t_min), f64::from(ray.t_max));
    if least < -MARGIN || t < first - slack || t > last + slack {
        Clear::Miss
    } else if least > MARGIN && t > first + slack && t < last - slack {
        Clear::Hit(t)
    } else {
        Clear::Unclear
    }
}

/// A scene that lies beside the workspace, in `../shared/scenes`. Without it says so and gives nothing.
pub fn shared_scene(name: &str) -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests are in the workspace");
    let scene = root.join("../shared/scenes").join(name);
    if scene.is_dir() {
        return Some(scene);
    }
    println!("skipped: no scene {}", scene.display());
    None
}
