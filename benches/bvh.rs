//! The tree's queries, on the shadow rays of real pictures, with obvhs' traversal of the same rays beside them.
//!
//! `cargo bench -p occlude-benches --bench bvh -- any_hit` runs one group. Throughput is rays a second, one
//! thread. All variants of a group answer the same rays; that they agree is checked first.

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use obvhs::rt_triangle::RtTriangle;
use occlude_benches::{Setting, settings};
use occlude_kernel::lanes::{Level, Task, detect, dispatch};
use occlude_kernel::{BatchScratch, Bvh, Counts, Ray, RayPacket, Simd, Targets, Uncounted};

struct Single<'a>(Bvh<'a>, &'a [Ray]);

impl Task for Single<'_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> usize {
        let bvh = self.0.on(simd);
        let mut blocked = 0;
        for ray in self.1 {
            blocked += usize::from(bvh.occluded(ray, None, &mut Uncounted));
        }
        blocked
    }
}

struct Packets<'a>(Bvh<'a>, &'a [Ray]);

impl Task for Packets<'_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> usize {
        let bvh = self.0.on(simd);
        let mut packet = RayPacket::default();
        let mut blocked = 0;
        for rays in self.1.chunks(RayPacket::WIDTH) {
            for (i, ray) in rays.iter().enumerate() {
                packet.set(i, ray);
            }
            let active = ((1u64 << rays.len()) - 1) as u32;
            blocked += bvh.occluded_packet(&packet, active, None, &mut Uncounted).count_ones() as usize;
        }
        blocked
    }
}

struct Batches<'a>(Bvh<'a>, &'a Setting);

impl Task for Batches<'_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> usize {
        let bvh = self.0.on(simd);
        let mut scratch = BatchScratch::new();
        let mut words = [0u64; 4];
        let mut blocked = 0;
        for questions in &self.1.questions {
            let [x, y, z] = &questions.targets;
            for batch in &questions.batches {
                let point = &questions.points[batch.point as usize];
                let light = &self.1.lights[batch.light as usize];
                let samples = batch.samples.start as usize..batch.samples.end as usize;
                if let Some(targets) = Targets::new(&x[samples.clone()], &y[samples.clone()], &z[samples]) {
                    let targets = targets.on_parallelogram(light.corner, light.u, light.v);
                    words = [0; 4];
                    bvh.occluded_batch(
                        point.origin,
                        &targets,
                        None,
                        &mut Uncounted,
                        &mut scratch,
                        &mut words,
                    );
                }
                blocked += words.iter().map(|word| word.count_ones() as usize).sum::<usize>();
            }
        }
        blocked
    }
}

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

fn theirs(ray: &Ray) -> obvhs::ray::Ray {
    obvhs::ray::Ray::new(ray.origin.into(), ray.direction.into(), 0.0, 1.0)
}

fn any_hit(c: &mut Criterion, level: Level) {
    for setting in settings(64) {
        let rays = setting.rays();
        let triangles: Vec<RtTriangle> = setting.triangles().iter().map(RtTriangle::from).collect();
        let (binary, wide) = (setting.obvhs_binary(), setting.obvhs_wide());
        let with_binary = || {
            rays.iter()
                .filter(|ray| {
                    !binary.ray_traverse_miss(theirs(ray), |ray, i| {
                        triangles[binary.primitive_indices[i] as usize].intersect(ray)
                    })
                })
                .count()
        };
        let with_wide = || {
            rays.iter()
                .filter(|ray| {
                    !wide.ray_traverse_miss(theirs(ray), |ray, i| {
                        triangles[wide.primitive_indices[i] as usize].intersect(ray)
                    })
                })
                .count()
        };
        let bvh = setting.bvh();
        let ours = dispatch(level, Single(bvh, &rays));
        assert_eq!(ours, dispatch(level, Packets(bvh, &rays)));
        assert_eq!(ours, dispatch(level, Batches(bvh, &setting)));
        let mut counts = Counts::default();
        for ray in &rays {
            bvh.occluded(ray, None, &mut counts);
        }
        println!(
            "{}: {} rays, {ours} blocked; obvhs' binary tree {}, wide tree {}; {:.2} triangle and {:.2} node tests a ray",
            setting.name,
            rays.len(),
            with_binary(),
            with_wide(),
            counts.triangle_tests as f64 / rays.len() as f64,
            counts.node_tests as f64 / rays.len() as f64,
        );
        let mut group = c.benchmark_group(format!("any_hit/{}", setting.name));
        group.throughput(Throughput::Elements(rays.len() as u64));
        group.bench_function("single", |b| b.iter(|| dispatch(level, Single(bvh, &rays))));
        group.bench_function("packet", |b| b.iter(|| dispatch(level, Packets(bvh, &rays))));
        group.bench_function("batch", |b| b.iter(|| dispatch(level, Batches(bvh, &setting))));
        group.bench_function("obvhs_binary", |b| b.iter(with_binary));
        group.bench_function("obvhs_wide", |b| b.iter(with_wide));
        group.finish();
    }
}

fn closest(c: &mut Criterion, level: Level) {
    for setting in settings(4) {
        let rays = setting.rays();
        let bvh = setting.bvh();
        let mut group = c.benchmark_group(format!("closest/{}", setting.name));
        group.throughput(Throughput::Elements(rays.len() as u64));
        group.bench_function("single", |b| {
            b.iter_batched(|| (), |()| dispatch(level, Closest(bvh, &rays)), BatchSize::SmallInput);
        });
        group.finish();
    }
}

fn all(c: &mut Criterion) {
    let level = detect();
    any_hit(c, level);
    closest(c, level);
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10);
    targets = all
}
criterion_main!(benches);
