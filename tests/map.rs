//! The occlusion map's rounds of photons, trees over blockers, and test rays by cells.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_host::film::{Image, Tile};
use occlude_host::generate::{Kind, generate};
use occlude_host::integrator::{
    Exact, Form, MapOptions, MapTerms, PreparedMap, Rule, Settings, Split, Stage, Visibility, questions,
};
use occlude_host::light::{AreaLight, lights};
use occlude_host::photons::{BlockerKind, slots};
use occlude_host::render::{Limits, render};
use occlude_host::sampler::Pattern;
use occlude_host::scene::{CameraRequest, Scene, load};
use occlude_kernel::bvh::{SmallTree, SmallTriangle};
use occlude_kernel::lanes::{Task, detect};
use occlude_kernel::photons::{Class, Nearest};
use occlude_kernel::{BatchScratch, Bvh, Child, Counts, Node, Simd, Targets, TriangleBlock, Uncounted};
use occlude_tests::{Family, Random};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

struct Setting {
    scene: Scene,
    accel: Accel,
    lights: Vec<AreaLight>,
}

/// What is wrong with a map, of all points and lights of a picture.
#[derive(Clone, Copy, Debug, Default)]
struct Wrong {
    /// Called lit or dark where one of 64 rays says otherwise, of all.
    calls: f64,
    /// What that costs: the mean error of visibility.
    error: f64,
    /// Of the rays of penumbrae that something blocks, those that nothing named blocks.
    missed: f64,
    /// Called penumbra, of all.
    penumbra: f64,
}

const SIZE: (u32, u32) = (80, 50);

impl Setting {
    fn of(mut scene: Scene) -> Self {
        let camera = scene.camera.as_mut().expect("a camera");
        (camera.width, camera.height) = SIZE;
        Self { accel: Accel::build(&scene, Quality::Medium), lights: lights(&scene), scene }
    }

    fn own(name: &str) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes").join(name);
        Self::of(load(&folder, &CameraRequest::default()).expect("the scene loads"))
    }

    fn on_stage<T>(&self, shadow_rays: u32, seed: u64, what: impl FnOnce(&Stage<'_>) -> T) -> T {
        let camera = self.scene.camera.expect("a camera");
        let frame = camera.frame();
        what(&Stage {
            scene: &self.scene,
            bvh: self.accel.bvh(),
            lights: &self.lights,
            eye: camera.eye,
            camera: &frame,
            shadow_rays,
            pattern: Pattern::default(),
            seed,
            level: detect(),
            count: true,
        })
    }

    fn prepare(&self, seed: u64, lines: u64, rounds: u32, blockers: BlockerKind) -> PreparedMap {
        let quality = Quality::Medium;
        let options = MapOptions { lines: Some(lines), rounds, k: 20, radius: None, blockers, quality };
        self.on_stage(1, seed, |stage| PreparedMap::new(stage, &options))
    }

    fn render(&self, method: &dyn Visibility, threads: usize) -> (Image, Counts) {
        self.on_stage(16, 1, |stage| {
            let limits = Limits { passes: 2, time: None };
            let rendered = render(stage, method, SIZE, limits, threads, &AtomicBool::new(false), |_| ());
            let rendered = rendered.expect("it renders");
            (rendered.film.develop(), rendered.shadow_counts)
        })
    }

    /// The same points and rays whatever the map.
    fn wrong(&self, seed: u64, lines: u64, rounds: u32, k: usize, blockers: BlockerKind) -> Wrong {
        let options =
            MapOptions { lines: Some(lines), rounds, k, radius: None, blockers, quality: Quality::Medium };
        let map = self.on_stage(1, seed, |stage| PreparedMap::new(stage, &options));
        let rays = 64 * self.lights.len().clamp(1, 16) as u32;
        self.on_stage(rays, 1, |stage| self.judge(stage, &map, k))
    }

    fn judge(&self, stage: &Stage<'_>, map: &PreparedMap, k: usize) -> Wrong {
        let visibility = map.visibility();
        let photons = map.store.by_light();
        let mut slots = slots(k);
        let mut nearest = Nearest::new(k, &mut slots).expect("room");
        let mut room = vec![0; 8192];
        let (mut all, mut calls, mut error, mut blocked, mut missed, mut penumbra) = (0, 0, 0.0, 0, 0, 0);
        for tile in Tile::cover(SIZE.0, SIZE.1, 32) {
            let asked = questions(stage, tile, SIZE.0, 0);
            let (mut truth, mut said) = (Vec::new(), Vec::new());
            Exact.estimate(stage, &asked, &mut truth, &mut Counts::default());
            visibility.estimate(stage, &asked, &mut said, &mut Counts::default());
            for batch in &asked.batches {
                let samples = batch.samples.start as usize..batch.samples.end as usize;
                let (truth, said) = (&truth[samples.clone()], &said[samples]);
                let point = &asked.points[batch.point as usize];
                let place = map.place(batch.light as usize, point.x, point.normal);
                let free = truth.iter().filter(|&&v| v > 0.5).count();
                let share = free as f64 / truth.len() as f64;
                all += 1;
                match photons[batch.light as usize].classify(&place, &mut nearest, &mut room) {
                    Class::Lit => {
                        calls += u32::from(free < truth.len());
                        error += 1.0 - share;
                    }
                    Class::Dark => {
                        calls += u32::from(free > 0);
                        error += share;
                    }
                    Class::Penumbra(_) => {
                        penumbra += 1;
                        blocked += truth.len() - free;
                        missed += truth.iter().zip(said).filter(|(t, s)| **t < 0.5 && **s > 0.5).count();
                    }
                    Class::Unknown => {}
                }
            }
        }
        Wrong {
            calls: f64::from(calls) / f64::from(all),
            error: error / f64::from(all),
            missed: missed as f64 / blocked.max(1) as f64,
            penumbra: f64::from(penumbra) / f64::from(all),
        }
    }
}

fn six() -> Vec<Setting> {
    let own = ["columns", "fence"].map(Setting::own);
    let generated = [Kind::Spheres, Kind::City, Kind::Forest, Kind::Sponge]
        .map(|kind| Setting::of(generate(kind, 1, 5000)));
    own.into_iter().chain(generated).collect()
}

/// The mean of these, and how many standard errors it is above 0.
fn above_zero(differences: &[f64]) -> (f64, f64) {
    let count = differences.len() as f64;
    let mean = differences.iter().sum::<f64>() / count;
    let variance = differences.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / (count - 1.0);
    (mean, mean / (variance / count).sqrt())
}

/// Six scenes, four showers each, even and in three rounds: the decrease relative to the mean of the scene is above 0 by
/// more than 5 standard errors, which of 24 pairs happens by chance once in 40 000 times; and it is a decrease in
/// each scene.
#[test]
fn rounds_make_fewer_wrong_calls_and_miss_fewer_blockers() {
    let mut gains = [Vec::new(), Vec::new()];
    for setting in six() {
        let shower = |rounds| -> Vec<Wrong> {
            (0..4).map(|seed| setting.wrong(seed, 40_000, rounds, 10, BlockerKind::Triangle)).collect()
        };
        let (even, adaptive) = (shower(1), shower(3));
        let of = |wrong: &Wrong| [wrong.calls, wrong.missed];
        for (which, gains) in gains.iter_mut().enumerate() {
            let mean = |all: &[Wrong]| all.iter().map(|wrong| of(wrong)[which]).sum::<f64>() / 4.0;
            let (before, after) = (mean(&even), mean(&adaptive));
            println!("{}, {}: {before:.5} -> {after:.5}", setting.scene.name, ["wrong", "missed"][which]);
            assert!(before > 0.0 && after < before, "{}: {before} -> {after}", setting.scene.name);
            let pairs = even.iter().zip(&adaptive);
            gains.extend(pairs.map(|(even, adaptive)| (of(even)[which] - of(adaptive)[which]) / before));
        }
    }
    for gains in gains {
        let (mean, errors) = above_zero(&gains);
        println!("less by {mean:.3}, {errors:.1} standard errors");
        assert!(errors > 5.0, "{errors}");
    }
}

/// Of the same test: what does not gain is found out.
#[test]
fn a_gain_that_is_none_is_no_gain() {
    assert!(above_zero(&[0.5, -0.4, 0.3, -0.5, 0.2, 0.1, -0.2, 0.1]).1 < 5.0);
    assert!(above_zero(&[-0.5, -0.4, -0.6, -0.5]).1 < -5.0);
}

/// For a record: as many photons, evenly, in rounds, and with twice as many looked up.
#[test]
#[ignore = "prints figures"]
fn figures() {
    println!(
        "| scene | photons name | k | rounds | wrong calls, % | visibility error, % | missed, % | penumbra, % |"
    );
    for setting in six() {
        let (triangle, treelet) = (BlockerKind::Triangle, BlockerKind::Treelet(128));
        for (kind, lines, k) in [(triangle, 64_000, 50), (triangle, 64_000, 10), (treelet, 64_000, 50)] {
            for (k, rounds) in [(k, 1), (2 * k, 1), (k, 2), (k, 3), (k, 5)] {
                let mut sum = Wrong::default();
                for seed in 0..2 {
                    let wrong = setting.wrong(seed, lines, rounds, k, kind);
                    sum.calls += wrong.calls / 2.0;
                    sum.error += wrong.error / 2.0;
                    sum.missed += wrong.missed / 2.0;
                    sum.penumbra += wrong.penumbra / 2.0;
                }
                println!(
                    "| {} | {kind} | {k} | {rounds} | {:.3} | {:.4} | {:.3} | {:.1} |",
                    setting.scene.name,
                    100.0 * sum.calls,
                    100.0 * sum.error,
                    100.0 * sum.missed,
                    100.0 * sum.penumbra
                );
            }
        }
    }
}

fn few(random: &mut Random, count: usize) -> Vec<SmallTriangle> {
    (0..count as u32)
        .map(|id| {
            let at = random.point();
            SmallTriangle { corners: [0; 3].map(|_| (at + 0.3 * random.point()).to_array()), id }
        })
        .collect()
}

struct Batches<'a> {
    scene: Bvh<'a>,
    small: (&'a [Node], &'a [TriangleBlock]),
    x: Vec3,
    targets: &'a Targets<'a>,
}

impl Task for Batches<'_> {
    type Output = [u64; 2];

    /// By the small tree, and by the scene's.
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [u64; 2] {
        let bvh = self.scene.on(simd);
        let small = bvh.with_small(self.small.0, self.small.1).expect("a tree");
        let mut scratch = BatchScratch::new();
        let mut blocked = [[0u64; 1]; 2];
        small.occluded_batch(self.x, self.targets, None, &mut Uncounted, &mut scratch, &mut blocked[0]);
        bvh.occluded_batch(self.x, self.targets, None, &mut Uncounted, &mut scratch, &mut blocked[1]);
        [blocked[0][0], blocked[1][0]]
    }
}

#[test]
fn small_trees_hold_every_triangle_once_and_answer_like_the_scene() {
    let mut random = Random::new(17);
    for count in [0, 1, 7, 8, 9, 16, 17, 63, 64, 65, 100, 513, 1000] {
        let mut triangles = few(&mut random, count);
        let corners: Vec<[Vec3; 3]> = triangles.iter().map(|t| t.corners.map(Vec3::from)).collect();
        let accel = Accel::from_triangles(&corners, Quality::Fast);
        // What was in the memory before does not matter.
        let mut nodes =
            vec![Node { children: [Child::node(7); 8], ..Node::EMPTY }; SmallTree::nodes(count) + 2];
        let mut blocks = vec![TriangleBlock::EMPTY; SmallTree::blocks(count) + 2];
        let tree = SmallTree::new(&mut triangles, &mut nodes, &mut blocks).expect("room");
        let (n, b) = tree.build();
        let small = (&nodes[..n], &blocks[..b]);
        assert_eq!((n > 0, b), (count > 0, count.div_ceil(8)));
        let mut ids: Vec<u32> = small.1.iter().flat_map(|block| block.ids[..block.len()].to_vec()).collect();
        ids.sort_unstable();
        assert!(ids.iter().copied().eq(0..count as u32));
        Bvh::new(small.0, small.1).expect("a tree by the kernel's rules");
        let mut hits = 0;
        for _ in 0..40 {
            let x = random.point() * 2.0;
            let corner = random.point() * 2.0;
            let [xs, ys, zs] = [0, 1, 2]
                .map(|axis| -> Vec<f32> { (0..37).map(|_| corner[axis] + 0.5 * random.unit()).collect() });
            let targets = Targets::new(&xs, &ys, &zs).expect("as many");
            for family in Family::all() {
                let [by_small, by_scene] =
                    family.run(Batches { scene: accel.bvh(), small, x, targets: &targets });
                assert_eq!(by_small, by_scene, "{count} triangles, {family}");
                hits += by_small.count_ones();
            }
        }
        assert_eq!(hits > 0, count > 0, "{count} triangles block something");
    }
}

#[test]
fn small_trees_want_room_and_sound_slices() {
    let mut random = Random::new(3);
    let mut triangles = few(&mut random, 20);
    let (mut nodes, mut blocks) = ([Node::EMPTY; 3], [TriangleBlock::EMPTY; 3]);
    assert!(SmallTree::new(&mut triangles, &mut nodes[..2], &mut blocks).is_none());
    assert!(SmallTree::new(&mut triangles, &mut nodes, &mut blocks[..2]).is_none());
    let scene = Bvh::new(&[], &[]).expect("empty");
    nodes[0].set(0, [0.0; 3], [1.0; 3], Child::leaf(9));
    assert!(scene.with_small(&nodes[..1], &blocks).is_err());
}

/// For a record: what it takes to build one, beside a tree that is built by cost.
#[test]
#[ignore = "prints times"]
fn times_of_small_trees() {
    let mut random = Random::new(1);
    for count in [16, 64, 256, 1024] {
        let triangles = few(&mut random, count);
        let corners: Vec<[Vec3; 3]> = triangles.iter().map(|t| t.corners.map(Vec3::from)).collect();
        let mut nodes = vec![Node::EMPTY; SmallTree::nodes(count)];
        let mut blocks = vec![TriangleBlock::EMPTY; SmallTree::blocks(count)];
        let mut least = [f64::INFINITY; 2];
        for _ in 0..200 {
            let mut copy = triangles.clone();
            let start = Instant::now();
            SmallTree::new(&mut copy, &mut nodes, &mut blocks).expect("room").build();
            least[0] = least[0].min(start.elapsed().as_secs_f64());
            let start = Instant::now();
            let accel = Accel::from_triangles(&corners, Quality::Fast);
            least[1] = least[1].min(start.elapsed().as_secs_f64());
            assert_eq!(accel.triangles(), count);
        }
        let each = least.map(|time| time * 1e9 / count as f64);
        println!("{count} triangles: {:.0} ns a triangle, by cost {:.0}", each[0], each[1]);
    }
}

/// Lists, trees over them and rays one by one give the same bits; subtrees of the scene's tree, which hold more, do not.
#[test]
fn trees_and_single_rays_change_no_bit() {
    let setting = Setting::of(generate(Kind::Spheres, 2, 3000));
    let map = setting.prepare(1, 20_000, 2, BlockerKind::Triangle);
    let list = setting.render(&map.visibility(), 2);
    let trees = setting.render(&map.visibility().with_trees().expect("of triangles"), 3);
    let alone = setting.render(&map.visibility().one_by_one(), 2);
    let both = setting.render(&map.visibility().with_trees().expect("of triangles").one_by_one(), 1);
    assert!(list.0.pixels.iter().any(|pixel| pixel[1] > 0.0));
    assert!(list.0 == trees.0 && list.0 == alone.0 && list.0 == both.0);
    assert!(trees.1.triangle_tests < list.1.triangle_tests, "{:?} {:?}", trees.1, list.1);
    assert_eq!((list.1.rays, list.1.rays), (trees.1.rays, alone.1.rays));
    let treelets = setting.prepare(1, 20_000, 2, BlockerKind::Treelet(32));
    assert!(setting.render(&treelets.visibility(), 2).0 != list.0);
    let said = treelets.visibility().with_trees().expect_err("refused").to_string();
    assert!(said.contains("--blocker-kind triangle"), "{said}");
}

/// Test rays for each cell: the same picture and the same counts for any number of threads, and fewer tests than for each
/// point.
#[test]
fn cells_learn_the_same_whoever_asks_first() {
    let setting = Setting::of(generate(Kind::Forest, 2, 3000));
    let map = setting.prepare(1, 40_000, 2, BlockerKind::Triangle);
    for (rule, form) in [(Rule::Importance, Form::Balanced), (Rule::Optimal, Form::Residual)] {
        let settings = Settings { form, rule, split: Split::Sorted, ..Settings::default() };
        let terms = |trees: bool| {
            let map = map.visibility();
            let map = if trees { map.with_trees().expect("of triangles") } else { map };
            MapTerms::new(map, settings, &setting.scene).expect("they go together")
        };
        let first = setting.render(&terms(true).by_cells(), 1);
        for threads in [2, 5] {
            let again = setting.render(&terms(true).by_cells(), threads);
            assert!(first.0 == again.0, "{threads} threads");
            assert_eq!(first.1, again.1, "{threads} threads");
        }
        let by_point = setting.render(&terms(true), 2);
        let uniform = Settings { rule: Rule::Uniform, ..settings };
        let uniform =
            MapTerms::new(map.visibility().with_trees().expect("of triangles"), uniform, &setting.scene);
        let none = setting.render(&uniform.expect("they go together"), 2);
        assert!(by_point.0 != first.0 && none.0 != first.0, "probabilities differ");
        assert!(first.1.triangle_tests < by_point.1.triangle_tests);
    }
}
