//! The kernel's ways to answer, each a task that is entered once for all of the work.

use crate::pack::{Tracer, pack};
use crate::{Batch, Work};
use glam::Vec3;
use occlude_kernel::lanes::{Level, Task, dispatch};
use occlude_kernel::{
    BatchScratch, Bvh, Counter, Counts, Ray, RayPacket, Simd, Targets, TilePoint, TileScratch, Uncounted,
};

/// One way to answer.
#[derive(Clone, Copy)]
pub struct Method {
    /// What it is called.
    pub name: &'static str,
    /// Answers all of the work: a word a batch, bit `i` for its ray `i`.
    pub answer: fn(Level, Bvh<'_>, &Work, &mut [u64]),
    /// The same, and counts tests.
    pub count: fn(Level, Bvh<'_>, &Work, &mut [u64], &mut Counts),
}

/// A table of tasks with the fields of [`Single`].
macro_rules! methods {
    ($($name:literal => $task:ident),* $(,)?) => {
        &[$(Method {
            name: $name,
            answer: |level, bvh, work, blocked| {
                dispatch(level, $task { bvh, work, blocked, counter: &mut Uncounted });
            },
            count: |level, bvh, work, blocked, counter| {
                dispatch(level, $task { bvh, work, blocked, counter });
            },
        }),*]
    };
}

/// All of them. A new one is a task below and a line here.
pub const METHODS: &[Method] = methods! {
    "single" => Single,
    "packet" => Packets,
    "batch" => Batches,
    "tile" => Tiles,
};

/// [`Bvh::occluded`], ray by ray.
pub struct Single<'a, C> {
    /// The tree.
    pub bvh: Bvh<'a>,
    /// What is asked.
    pub work: &'a Work,
    /// A word a batch.
    pub blocked: &'a mut [u64],
    /// Takes note of tests.
    pub counter: &'a mut C,
}

impl<C: Counter> Task for Single<'_, C> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let bvh = self.bvh.on(simd);
        let [x, y, z] = &self.work.targets;
        let mut index = 0;
        while index < self.work.batches.len() {
            let batch = &self.work.batches[index];
            let (first, last) = (batch.first as usize, batch.last as usize);
            let mut word = 0;
            let mut i = first;
            while i < last {
                let ray = Ray::segment(batch.origin, [x[i], y[i], z[i]]);
                word |= u64::from(bvh.occluded(&ray, None, self.counter)) << (i - first);
                i += 1;
            }
            self.blocked[index] = word;
            index += 1;
        }
    }
}

/// [`Bvh::occluded_packet`], by 16 rays.
pub struct Packets<'a, C> {
    bvh: Bvh<'a>,
    work: &'a Work,
    blocked: &'a mut [u64],
    counter: &'a mut C,
}

impl<C: Counter> Task for Packets<'_, C> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let tracer = PacketTracer { bvh: self.bvh.on(simd), counter: self.counter };
        pack(tracer, self.work, self.blocked);
    }
}

struct PacketTracer<'a, S, C> {
    bvh: Bvh<'a, S>,
    counter: &'a mut C,
}

impl<S: Simd, C: Counter> Tracer<{ RayPacket::WIDTH }> for PacketTracer<'_, S, C> {
    type Packet = RayPacket;

    #[inline(always)]
    fn packet(&self) -> RayPacket {
        RayPacket { t_max: [1.0; RayPacket::WIDTH], ..RayPacket::default() }
    }

    #[allow(clippy::needless_range_loop, reason = "several arrays side by side")]
    #[inline(always)]
    fn fill(packet: &mut RayPacket, origin: Vec3, targets: [&[f32; RayPacket::WIDTH]; 3]) {
        let origin = origin.to_array();
        for axis in 0..3 {
            for lane in 0..RayPacket::WIDTH {
                packet.origin[axis][lane] = origin[axis];
                packet.direction[axis][lane] = targets[axis][lane] - origin[axis];
            }
        }
    }

    #[inline(always)]
    fn put(packet: &mut RayPacket, lane: usize, origin: Vec3, target: [f32; 3]) {
        let origin = origin.to_array();
        for axis in 0..3 {
            packet.origin[axis][lane] = origin[axis];
            packet.direction[axis][lane] = target[axis] - origin[axis];
        }
    }

    #[inline(always)]
    fn trace(&mut self, packet: &mut RayPacket, active: u32) -> u32 {
        self.bvh.occluded_packet(packet, active, None, self.counter)
    }
}

/// [`Bvh::occluded_batch`], by the rays of a point and a light.
pub struct Batches<'a, C> {
    bvh: Bvh<'a>,
    work: &'a Work,
    blocked: &'a mut [u64],
    counter: &'a mut C,
}

impl<C: Counter> Task for Batches<'_, C> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let bvh = self.bvh.on(simd);
        let [x, y, z] = &self.work.targets;
        let mut scratch = BatchScratch::new();
        let mut index = 0;
        while index < self.work.batches.len() {
            let batch = &self.work.batches[index];
            let (first, last) = (batch.first as usize, batch.last as usize);
            if let Some(targets) = Targets::new(&x[first..last], &y[first..last], &z[first..last]) {
                let [corner, u, v] = self.work.planes[batch.light as usize];
                let targets = targets.on_parallelogram(corner, u, v);
                let word = &mut self.blocked[index..=index];
                bvh.occluded_batch(batch.origin, &targets, None, self.counter, &mut scratch, word);
            }
            index += 1;
        }
    }
}

/// [`Bvh::occluded_tile`], by the rays of neighbouring points to a light.
pub struct Tiles<'a, C> {
    bvh: Bvh<'a>,
    work: &'a Work,
    blocked: &'a mut [u64],
    counter: &'a mut C,
}

impl<C: Counter> Task for Tiles<'_, C> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let bvh = self.bvh.on(simd);
        let [x, y, z] = &self.work.targets;
        let mut scratch = TileScratch::new();
        let mut points = [TilePoint::default(); 256];
        let mut answers = [0; 64];
        let mut index = 0;
        while index < self.work.tiles.len() {
            let range = &self.work.tiles[index];
            let (begin, end) = (range.start as usize, range.end as usize);
            let batches = &self.work.batches[begin..end];
            let first = batches[0].first;
            let points = &mut points[..batches.len()];
            let mut k = 0;
            while k < batches.len() && k < points.len() {
                let Batch { origin, first: from, last, .. } = batches[k];
                points[k] = TilePoint { x: origin.to_array(), first: from - first, count: last - from };
                k += 1;
            }
            let (from, to) = (first as usize, self.work.batches[end - 1].last as usize);
            if let Some(targets) = Targets::new(&x[from..to], &y[from..to], &z[from..to]) {
                let [corner, u, v] = self.work.planes[batches[0].light as usize];
                let targets = targets.on_parallelogram(corner, u, v);
                bvh.occluded_tile(points, &targets, None, self.counter, &mut scratch, &mut answers);
            }
            let blocked = &mut self.blocked[begin..end];
            let mut k = 0;
            while k < blocked.len() && k < points.len() {
                let TilePoint { first, count, .. } = points[k];
                let (word, bit) = (first as usize / 64 % answers.len(), first % 64);
                let mut bits = answers[word] >> bit;
                if bit + count > 64 {
                    bits |= answers[(word + 1) % answers.len()] << (64 - bit);
                }
                blocked[k] = bits & u64::MAX.checked_shr(64 - count).unwrap_or(0);
                k += 1;
            }
            index += 1;
        }
    }
}
