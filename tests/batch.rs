//! The batch and tile queries against single rays, on real scenes: the same answer for every sample.

use occlude_host::accel::{Accel, Quality};
use occlude_host::film::Tile;
use occlude_host::generate::{Kind, generate};
use occlude_host::integrator::{Stage, questions};
use occlude_host::light::lights;
use occlude_host::sampler::Pattern;
use occlude_host::scene::{CameraRequest, Scene, load};
use occlude_kernel::lanes::{Task, detect, dispatch};
use occlude_kernel::{BatchScratch, Bvh, Counts, Ray, Simd, Targets, TilePoint, TileScratch, Uncounted};
use occlude_tests::shared_scene;
use std::path::Path;

/// What the batch says of all targets and what single rays say, in words of 64.
struct Ask<'a> {
    bvh: Bvh<'a>,
    x: [f32; 3],
    targets: Targets<'a>,
    scratch: &'a mut BatchScratch,
}

impl Task for Ask<'_> {
    type Output = (Vec<u64>, Vec<u64>);

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Self::Output {
        let (bvh, words) = (self.bvh.on(simd), self.targets.len().div_ceil(64));
        let (mut batch, mut single) = (vec![0; words], vec![0; words]);
        bvh.occluded_batch(self.x, &self.targets, None, &mut Counts::default(), self.scratch, &mut batch);
        for i in 0..self.targets.len() {
            let ray = Ray::segment(self.x, self.targets.get(i));
            single[i / 64] |= u64::from(bvh.occluded(&ray, None, &mut Uncounted)) << (i % 64);
        }
        (batch, single)
    }
}

/// Answers a tile.
struct AskTile<'a> {
    bvh: Bvh<'a>,
    points: &'a [TilePoint],
    targets: Targets<'a>,
    scratch: &'a mut TileScratch,
    blocked: &'a mut [u64],
}

impl Task for AskTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let bvh = self.bvh.on(simd);
        bvh.occluded_tile(self.points, &self.targets, None, &mut Uncounted, self.scratch, self.blocked);
    }
}

/// Asks about every light from the points of some tiles, with and without the light's plane.
fn agree(name: &str, scene: &Scene, shadow_rays: u32) {
    let accel = Accel::build(scene, Quality::Medium);
    let lights = lights(scene);
    let camera = scene.camera.expect("a camera");
    let frame = camera.frame();
    let stage = Stage {
        scene,
        bvh: accel.bvh(),
        lights: &lights,
        eye: camera.eye,
        camera: &frame,
        shadow_rays,
        pattern: Pattern::Jittered,
        seed: u64::from(shadow_rays),
        level: detect(),
        count: false,
    };
    let mut scratch = BatchScratch::new();
    let mut tile_scratch = TileScratch::new();
    let (mut asked, mut blocked) = (0, 0);
    for (index, tile) in Tile::cover(camera.width, camera.height, 16).enumerate() {
        if index % 37 != shadow_rays as usize % 37 {
            continue;
        }
        let questions = questions(&stage, tile, camera.width, 0);
        let [x, y, z] = &questions.targets;
        let mut want = vec![0u64; x.len().div_ceil(64)];
        for batch in &questions.batches {
            let light = &lights[batch.light as usize];
            let point = &questions.points[batch.point as usize];
            let batch_of = batch.samples.clone();
            let samples = batch_of.start as usize..batch_of.end as usize;
            let any =
                Targets::new(&x[samples.clone()], &y[samples.clone()], &z[samples]).expect("one length");
            for targets in [any, any.on_parallelogram(light.corner, light.u, light.v)] {
                let (bvh, x, scratch) = (stage.bvh, point.origin.into(), &mut scratch);
                let (batch, single) = dispatch(detect(), Ask { bvh, x, targets, scratch });
                assert_eq!(batch, single, "{name}: from {:?}, {} targets", point.origin, targets.len());
                asked += targets.len();
                blocked += single.iter().map(|word| word.count_ones()).sum::<u32>();
                for (i, sample) in (batch_of.start as usize..).take(targets.len()).enumerate() {
                    want[sample / 64] |= (single[i / 64] >> (i % 64) & 1) << (sample % 64);
                }
            }
        }
        // As tiles: all points of a light, and neighbouring ones.
        for part in [usize::MAX, 64, 7] {
            let mut found = vec![u64::MAX; want.len()];
            if let (Some(last), true) = (found.last_mut(), x.len() % 64 != 0) {
                *last >>= 64 - x.len() % 64;
            }
            for (light, area) in (0..).zip(&lights) {
                let points: Vec<TilePoint> = questions
                    .batches
                    .iter()
                    .filter(|batch| batch.light == light)
                    .map(|batch| TilePoint {
                        x: questions.points[batch.point as usize].origin.to_array(),
                        first: batch.samples.start,
                        count: batch.samples.end - batch.samples.start,
                    })
                    .collect();
                let any = Targets::new(x, y, z).expect("one length");
                let targets = if part == 7 { any } else { any.on_parallelogram(area.corner, area.u, area.v) };
                for points in points.chunks(part.min(points.len().max(1))) {
                    let (bvh, scratch, blocked) = (stage.bvh, &mut tile_scratch, found.as_mut_slice());
                    dispatch(detect(), AskTile { bvh, points, targets, scratch, blocked });
                }
            }
            assert!(found == want, "{name}: a tile of {shadow_rays} rays a point, in parts of {part}");
        }
    }
    assert!(asked > 1000, "{name}: only {asked} rays");
    println!("{name}: {asked} rays, {blocked} blocked, all agree");
}

const COUNTS: [u32; 5] = [1, 3, 16, 64, 256];

#[test]
fn on_our_scenes() {
    for name in ["cornell", "plates", "fence", "half_plane", "columns"] {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes").join(name);
        let scene = load(&folder, &CameraRequest::default()).expect("it loads");
        for count in COUNTS {
            agree(name, &scene, count);
        }
    }
}

#[test]
fn on_generated_scenes() {
    for kind in Kind::ALL {
        let scene = generate(kind, 1, 30_000);
        for count in COUNTS {
            agree(kind.name(), &scene, count);
        }
    }
}

#[test]
fn on_shared_scenes() {
    for name in
        ["cornell_original", "bunny_penumbra", "sponza_part", "teapot_toys", "apple_tree", "vented_case"]
    {
        let Some(folder) = shared_scene(name) else { continue };
        let scene = load(&folder, &CameraRequest::default()).expect("it loads");
        for count in COUNTS {
            agree(name, &scene, count);
        }
    }
}
