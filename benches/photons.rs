//! Look-ups of the k nearest photons: the tree, the grid, and the crate `kiddo` beside them.
//!
//! Photons lie on surfaces: a floor, and spheres on it. Look-ups come from points on the same surfaces, in the order
//! of the picture's pixels as a renderer would ask them, or at random. 10^5 and 10^6 photons; 10^7 too if
//! `OCCLUDE_BENCH_LARGE` is set. Everything is built from the same points, and the distances found are compared.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use occlude_host::photons::build;
use occlude_host::sampler::Sampler;
use occlude_kernel::Simd;
use occlude_kernel::lanes::{Level, Task, detect, dispatch};
use occlude_kernel::photons::{
    GridCell, Nearest, Neighbour, PhotonBlock, PhotonGrid, PhotonId, PhotonMap, Place, Point, Split,
};
use std::num::NonZero;
use std::time::Instant;

/// A point on a floor of 10 by 10, or on one of 25 spheres on it.
fn on_surface(random: &mut Sampler) -> Vec3 {
    let (u, v) = (random.uniform(), random.uniform());
    if random.uniform() < 0.6 {
        return Vec3::new(u * 10.0, 0.0, v * 10.0);
    }
    let sphere = random.word() % 25;
    let centre = Vec3::new((sphere % 5) as f32 * 2.0 + 1.0, 0.8, (sphere / 5) as f32 * 2.0 + 1.0);
    let (z, angle) = (2.0 * u - 1.0, v * std::f32::consts::TAU);
    let r = (1.0 - z * z).sqrt();
    centre + 0.8 * Vec3::new(r * angle.cos(), z, r * angle.sin())
}

fn blocks_of(crowd: &[Vec3]) -> Vec<PhotonBlock> {
    let mut blocks = vec![PhotonBlock::EMPTY; crowd.len().div_ceil(PhotonBlock::WIDTH)];
    for ((point, at), i) in PhotonBlock::as_points(&mut blocks).iter_mut().zip(crowd).zip(0..) {
        *point = Point { position: at.to_array(), id: PhotonId::occlusion(i) };
    }
    blocks
}

struct Tree<'a, 'n>(PhotonMap<'a>, &'a [Place], &'a mut Nearest<'n>);

impl Task for Tree<'_, '_> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f64 {
        let map = self.0.on(simd);
        let mut sum = 0.0;
        for place in self.1 {
            map.nearest(place, self.2);
            sum += farthest(self.2);
        }
        sum
    }
}

struct Grid<'a, 'n>(PhotonGrid<'a>, &'a [Place], &'a mut Nearest<'n>);

impl Task for Grid<'_, '_> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f64 {
        let grid = self.0.on(simd);
        let mut sum = 0.0;
        for place in self.1 {
            grid.nearest(place, self.2);
            sum += farthest(self.2);
        }
        sum
    }
}

#[inline(always)]
fn farthest(nearest: &Nearest<'_>) -> f64 {
    let mut most = 0.0f32;
    for neighbour in nearest.found() {
        most = most.max(neighbour.distance_squared());
    }
    f64::from(most)
}

fn lookups(c: &mut Criterion, level: Level, count: usize) {
    let mut random = Sampler::new(1, 0, 0);
    let crowd: Vec<Vec3> = (0..count).map(|_| on_surface(&mut random)).collect();
    let start = Instant::now();
    let mut blocks = blocks_of(&crowd);
    let mut splits = vec![Split::NONE; blocks.len()];
    build(&mut blocks, &mut splits);
    let ours = start.elapsed();
    let map = PhotonMap::new(&blocks, &splits).expect("a map");
    let entries: Vec<[f32; 3]> = crowd.iter().map(|p| p.to_array()).collect();
    let start = Instant::now();
    let theirs: ImmutableKdTree<f32, 3> = ImmutableKdTree::new_from_slice(&entries).expect("a tree");
    println!("{count} photons: our tree built in {ours:.2?}, kiddo's in {:.2?}", start.elapsed());

    // 4096 look-ups: every place at random, or near the one before as pixels are.
    let scattered: Vec<Vec3> = (0..4096).map(|_| on_surface(&mut random)).collect();
    let coherent: Vec<Vec3> = (0..4096)
        .map(|i| Vec3::new(3.0 + (i % 64) as f32 * 0.01, 0.0, 3.0 + (i / 64) as f32 * 0.01))
        .collect();
    for k in [8usize, 50, 200] {
        // Cells about as wide as the k nearest reach, on a surface of about 200.
        let edge = (k as f32 / count as f32 * 200.0 / std::f32::consts::PI).sqrt();
        let mut in_cells = blocks_of(&crowd);
        let mut table = vec![GridCell::NONE; PhotonGrid::table(count)];
        let grid = PhotonGrid::build(&mut in_cells, &mut table, edge).expect("a grid");
        let mut slots = vec![Neighbour::NONE; Nearest::room(k)];
        let mut nearest = Nearest::new(k, &mut slots).expect("room");
        let most = NonZero::new(k).expect("not 0");
        for (order, at) in [("scattered", &scattered), ("coherent", &coherent)] {
            let balls: Vec<Place> = at.iter().map(|&x| Place::ball(x, f32::INFINITY)).collect();
            let discs: Vec<Place> = at.iter().map(|&x| Place::disc(x, Vec3::Y, f32::INFINITY, 4.0)).collect();
            let with_kiddo = || {
                let mut sum = 0.0;
                for x in at {
                    let found = theirs
                        .query(&x.to_array())
                        .nearest_n::<SquaredEuclidean<f32>>(most)
                        .unsorted()
                        .execute();
                    let mut farthest = 0.0f32;
                    for near in &found {
                        farthest = farthest.max(near.distance);
                    }
                    sum += f64::from(farthest);
                }
                sum
            };
            let sums = [
                dispatch(level, Tree(map, &balls, &mut nearest)),
                dispatch(level, Grid(grid, &balls, &mut nearest)),
                with_kiddo(),
            ];
            assert!((sums[0] - sums[2]).abs() < 1e-4 * sums[2] && sums[0] == sums[1], "{sums:?}");
            let mut group = c.benchmark_group(format!("photons/{count}/k{k}/{order}"));
            group.throughput(Throughput::Elements(at.len() as u64));
            group.bench_function("tree", |b| b.iter(|| dispatch(level, Tree(map, &balls, &mut nearest))));
            group
                .bench_function("tree_disc", |b| b.iter(|| dispatch(level, Tree(map, &discs, &mut nearest))));
            group.bench_function("grid", |b| b.iter(|| dispatch(level, Grid(grid, &balls, &mut nearest))));
            group.bench_function("kiddo", |b| b.iter(with_kiddo));
            group.finish();
        }
    }
}

fn all(c: &mut Criterion) {
    let level = detect();
    lookups(c, level, 100_000);
    lookups(c, level, 1_000_000);
    if std::env::var_os("OCCLUDE_BENCH_LARGE").is_some() {
        lookups(c, level, 10_000_000);
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10);
    targets = all
}
criterion_main!(benches);
