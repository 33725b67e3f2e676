//! The tree's queries, on the shadow and camera rays of real pictures, with obvhs' traversal of the same rays beside
//! them.
//!
//! `cargo bench -p occlude-benches --bench bvh -- any_hit` runs one group. Throughput is rays a second, one
//! thread. All variants of a group answer the same rays; that ours agree is checked first, and how often obvhs'
//! differ is printed.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use occlude_benches::obvhs::{Binary, Wide, ray as theirs};
use occlude_benches::ours::METHODS;
use occlude_benches::{Setting, settings};
use occlude_kernel::lanes::{Level, Task, detect, dispatch};
use occlude_kernel::{Bvh, Counts, Ray, RayPacket, Simd, Uncounted};

struct Closest<'a>(Bvh<'a>, &'a [Ray]);

impl Task for Closest<'_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> usize {
        let bvh = self.0.on(simd);
        let mut found = 0;
        for ray in self.1 {
            found += usize::from(bvh.closest(ray, None, &mut Uncounted).is_some());
        }
        found
    }
}

struct ClosestPackets<'a>(Bvh<'a>, &'a [Ray]);

impl Task for ClosestPackets<'_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> usize {
        let bvh = self.0.on(simd);
        let mut packet = RayPacket::default();
        let mut found = 0;
        for rays in self.1.chunks(RayPacket::WIDTH) {
            for (i, ray) in rays.iter().enumerate() {
                packet.set(i, ray);
            }
            let active = ((1u64 << rays.len()) - 1) as u32;
            let hits = bvh.closest_packet(&packet, active, None, &mut Uncounted);
            found += hits.hit.count_ones() as usize;
        }
        found
    }
}

fn any_hit(c: &mut Criterion, level: Level, setting: &Setting, binary: &Binary, wide: &Wide) {
    let work = setting.work(64, None);
    let bvh = setting.bvh();
    let rays = work.rays() as f64;
    let mut answers = work.answers();
    let mut first: Option<Vec<u64>> = None;
    for method in METHODS {
        let mut counts = Counts::default();
        (method.count)(level, bvh, &work, &mut answers, &mut counts);
        let first = first.get_or_insert_with(|| answers.clone());
        assert_eq!(*first, answers, "{} differs from {}", method.name, METHODS[0].name);
        let (triangles, nodes) = (counts.triangle_tests as f64 / rays, counts.node_tests as f64 / rays);
        println!(
            "{}, {}: {triangles:.2} triangle and {nodes:.2} node tests a ray",
            setting.name, method.name
        );
    }
    let first = first.unwrap_or_default();
    let differ = |other: &[u64]| first.iter().zip(other).map(|(a, b)| (a ^ b).count_ones()).sum::<u32>();
    let blocked: u32 = first.iter().map(|word| word.count_ones()).sum();
    binary.answer(&work, &mut answers);
    let by_binary = differ(&answers);
    wide.answer(&work, &mut answers);
    let by_wide = differ(&answers);
    println!(
        "{}: {rays} rays, {blocked} blocked; obvhs' binary tree differs on {by_binary}, the wide one on {by_wide}",
        setting.name
    );
    let mut group = c.benchmark_group(format!("any_hit/{}", setting.name));
    group.throughput(Throughput::Elements(work.rays() as u64));
    for method in METHODS {
        group.bench_function(method.name, |b| b.iter(|| (method.answer)(level, bvh, &work, &mut answers)));
    }
    group.bench_function("obvhs_binary", |b| b.iter(|| binary.answer(&work, &mut answers)));
    group.bench_function("obvhs_wide", |b| b.iter(|| wide.answer(&work, &mut answers)));
    group.finish();
}

fn closest(c: &mut Criterion, level: Level, setting: &Setting, binary: &Binary, wide: &Wide) {
    let rays = setting.work(4, None).segments();
    let bvh = setting.bvh();
    let mut group = c.benchmark_group(format!("closest/{}", setting.name));
    group.throughput(Throughput::Elements(rays.len() as u64));
    group.bench_function("single", |b| b.iter(|| dispatch(level, Closest(bvh, &rays))));
    group.bench_function("packet", |b| b.iter(|| dispatch(level, ClosestPackets(bvh, &rays))));
    let count = |found: &dyn Fn(&Ray) -> bool| rays.iter().filter(|ray| found(ray)).count();
    group.bench_function("obvhs_binary", |b| {
        b.iter(|| count(&|ray| binary.closest(theirs(ray.origin, ray.direction, ray.t_max))));
    });
    group.bench_function("obvhs_wide", |b| {
        b.iter(|| count(&|ray| wide.closest(theirs(ray.origin, ray.direction, ray.t_max))));
    });
    group.finish();
}

fn all(c: &mut Criterion) {
    let level = detect();
    for setting in settings(POINTS) {
        let (binary, wide) = (Binary::new(&setting.scene), Wide::new(&setting.scene));
        any_hit(c, level, &setting, &binary, &wide);
        closest(c, level, &setting, &binary, &wide);
    }
}

/// Shading points of a scene.
const POINTS: usize = 8000;

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10);
    targets = all
}
criterion_main!(benches);
