//! Queries about a part of the scene: as if there were no other triangles.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_host::generate::{Kind, generate};
use occlude_kernel::lanes::{Task, detect, dispatch, levels};
use occlude_kernel::{
    BatchScratch, Bvh, Child, Counts, Leaf, Part, Ray, Scalar, Simd, Targets, TriangleBlock, Uncounted,
};
use occlude_tests::Random;

/// Triangles by their numbers, or whole leaves of them.
#[derive(Clone, Copy)]
struct Some<'a> {
    triangles: &'a [bool],
    leaves: &'a [bool],
}

/// Where the choice of a leaf stands.
fn place_of(leaf: Leaf) -> usize {
    leaf.block * TriangleBlock::WIDTH + leaf.first
}

impl Part for Some<'_> {
    #[inline(always)]
    fn below(self, child: Child) -> bool {
        child.as_leaf().is_none_or(|leaf| self.leaves[place_of(leaf)])
    }

    #[inline(always)]
    fn holds(self, id: u32) -> bool {
        self.triangles[id as usize]
    }
}

struct Ask<'a, P> {
    bvh: Bvh<'a>,
    part: P,
    x: [f32; 3],
    targets: Targets<'a>,
    scratch: &'a mut BatchScratch,
    counts: &'a mut Counts,
}

impl<P: Part> Task for Ask<'_, P> {
    /// By the batch, by single rays.
    type Output = (Vec<u64>, Vec<u64>);

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Self::Output {
        let (bvh, count) = (self.bvh.on(simd), self.targets.len());
        let (mut batch, mut single) = (vec![0; count.div_ceil(64)], vec![0; count.div_ceil(64)]);
        bvh.occluded_batch_among(self.x, &self.targets, self.part, self.counts, self.scratch, &mut batch);
        for i in 0..count {
            let ray = Ray::segment(self.x, self.targets.get(i));
            let blocked = bvh.occluded_among(&ray, self.part, &mut Uncounted);
            single[i / 64] |= u64::from(blocked) << (i % 64);
        }
        (batch, single)
    }
}

/// The part of a tree against a tree of the part.
#[test]
fn a_part_is_a_scene_of_its_own() {
    let mut random = Random::new(21);
    for kind in Kind::ALL {
        let scene = generate(kind, 2, 3000);
        let all: Vec<[Vec3; 3]> = (0..scene.triangles.len() as u32).map(|i| scene.vertices(i)).collect();
        let accel = Accel::from_triangles(&all, Quality::Medium);
        let bvh = accel.bvh();
        let (lower, upper) = scene.bounds().expect("triangles");
        let mut point = || lower + (random.point() * 0.5 + 0.5) * (upper - lower);
        let questions: Vec<([f32; 3], Vec<Vec3>)> = (0..30)
            .map(|round| {
                let (x, centre, count) = (point(), point(), [1, 3, 20, 64, 100][round % 5]);
                (x.to_array(), (0..count).map(|_| centre + 0.1 * (point() - centre)).collect())
            })
            .collect();
        let mut blocked = [0; 2];
        for (by_leaf, share) in [(false, 2), (true, 2), (false, 50), (true, 50), (true, 1)] {
            let chosen = |index: usize| ((index as u64 * 0x9e37_79b9) >> 7).is_multiple_of(share);
            let mut triangles = vec![false; all.len()];
            let mut leaves = vec![true; bvh.blocks().len() * TriangleBlock::WIDTH];
            for leaf in bvh.nodes().iter().flat_map(|node| node.children).filter_map(Child::as_leaf) {
                let place = place_of(leaf);
                leaves[place] = !by_leaf || chosen(place);
                for &id in leaf.ids(bvh.blocks()) {
                    triangles[id as usize] = if by_leaf { leaves[place] } else { chosen(id as usize) };
                }
            }
            let part = Some { triangles: &triangles, leaves: &leaves };
            let own: Vec<[Vec3; 3]> = (0..all.len()).filter(|&i| triangles[i]).map(|i| all[i]).collect();
            let own = Accel::from_triangles(&own, Quality::Fast);
            let mut scratch = BatchScratch::new();
            for (x, targets) in &questions {
                let [xs, ys, zs] = [0, 1, 2].map(|axis| targets.iter().map(|y| y[axis]).collect::<Vec<_>>());
                let targets = Targets::new(&xs, &ys, &zs).expect("one length");
                let expected: Vec<u64> = (0..targets.len().div_ceil(64))
                    .map(|word| {
                        (0..targets.len().min(64 * word + 64) - 64 * word).fold(0, |bits, i| {
                            let ray = Ray::segment(*x, targets.get(64 * word + i));
                            bits | u64::from(own.bvh().on(Scalar).occluded(&ray, None, &mut Uncounted)) << i
                        })
                    })
                    .collect();
                for level in levels() {
                    let mut counts = Counts::default();
                    let (x, scratch, counts) = (*x, &mut scratch, &mut counts);
                    let (batch, single) = dispatch(level, Ask { bvh, part, x, targets, scratch, counts });
                    assert_eq!(batch, expected, "{}: batch from {x:?}", kind.name());
                    assert_eq!(single, expected, "{}: single from {x:?}", kind.name());
                }
                let bits: u32 = expected.iter().map(|word| word.count_ones()).sum();
                blocked[0] += bits;
                blocked[1] += targets.len() as u32 - bits;
            }
        }
        assert!(blocked.iter().all(|&count| count > 50), "{}: {blocked:?} blocked and free", kind.name());
    }
}

/// Triangles that are not of the part are not counted as tested, and nothing is tested for an empty one.
#[test]
fn only_the_part_is_counted() {
    let scene = generate(Kind::Soup, 1, 2000);
    let accel = Accel::build(&scene, Quality::Medium);
    let bvh = accel.bvh();
    let all = vec![true; scene.triangles.len()];
    let half: Vec<bool> = (0..all.len()).map(|i| i % 2 == 0).collect();
    let lanes = bvh.blocks().len() * TriangleBlock::WIDTH;
    let (leaves, nothing) = (vec![true; lanes], vec![false; lanes]);
    let mut random = Random::new(22);
    let mut tests = [0u64; 4];
    for _ in 0..200 {
        let (x, y) = (random.point() * 3.0, random.point() * 3.0);
        let (xs, ys, zs): (Vec<f32>, Vec<f32>, Vec<f32>) =
            ((0..16).map(|i| y.x + i as f32 * 0.01).collect(), vec![y.y; 16], vec![y.z; 16]);
        let targets = Targets::new(&xs, &ys, &zs).expect("one length");
        let parts = [(&all, &leaves), (&half, &leaves), (&all, &nothing)];
        for (total, (triangles, leaves)) in tests.iter_mut().zip(parts) {
            let mut counts = Counts::default();
            let part = Some { triangles, leaves };
            let (scratch, counted) = (&mut BatchScratch::new(), &mut counts);
            dispatch(detect(), Ask { bvh, part, x: x.into(), targets, scratch, counts: counted });
            *total += counts.triangle_tests;
        }
        let mut counts = Counts::default();
        bvh.occluded_batch(x, &targets, None, &mut counts, &mut BatchScratch::new(), &mut [0]);
        tests[3] += counts.triangle_tests;
    }
    println!("tests of all, half, nothing, and without a part: {tests:?}");
    assert_eq!(tests[2], 0);
    assert!(tests[1] > 0 && tests[1] < tests[0]);
    assert!(tests[3] > 0);
}
