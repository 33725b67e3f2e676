//! One ray against the eight triangles of a block, at every SIMD level: a tree of one leaf.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use occlude_kernel::lanes::{Task, dispatch, level_name, levels};
use occlude_kernel::{Bvh, Child, Node, Ray, Simd, TriangleBlock, Uncounted};

struct Rays<'a>(Bvh<'a>, &'a [Ray]);

impl Task for Rays<'_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> usize {
        let bvh = self.0.on(simd);
        let mut hits = 0;
        for ray in self.1 {
            hits += usize::from(bvh.occluded(ray, None, &mut Uncounted));
        }
        hits
    }
}

fn block(c: &mut Criterion) {
    let mut block = TriangleBlock::EMPTY;
    for lane in 0..TriangleBlock::WIDTH {
        let x = lane as f32 - 4.0;
        block.set(lane, [[x, -1.0, 1.0], [x + 0.5, -1.0, 1.0], [x, 1.0, 1.2]], lane as u32);
    }
    let mut root = Node::EMPTY;
    root.set(0, [-4.0, -1.0, 1.0], [4.0, 1.0, 1.2], Child::leaf(0));
    let (nodes, blocks) = ([root], [block]);
    let Ok(bvh) = Bvh::new(&nodes, &blocks) else { return };
    let rays: Vec<Ray> = (0..1024)
        .map(|i: u32| {
            let at = |salt: u32| {
                ((i.wrapping_mul(2_654_435_761) ^ salt).wrapping_mul(0x9e37_79b9) >> 8) as f32 / 16_777_216.0
            };
            Ray::segment([0.0; 3], [at(1) * 8.0 - 4.0, at(2) * 2.0 - 1.0, 2.0])
        })
        .collect();
    let mut group = c.benchmark_group("block");
    group.throughput(Throughput::Elements(rays.len() as u64));
    for level in levels() {
        group.bench_function(level_name(level), |b| b.iter(|| dispatch(level, Rays(bvh, &rays))));
    }
    group.finish();
}

criterion_group!(benches, block);
criterion_main!(benches);
