//! Boxes inside closed meshes: what they block, the mesh blocks.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_host::film::Tile;
use occlude_host::generate::{Kind, generate};
use occlude_host::integrator::{Exact, Stage, Visibility, Walled, questions};
use occlude_host::light::{AreaLight, Shape, lights};
use occlude_host::mesh;
use occlude_host::sampler::Pattern;
use occlude_host::scene::{CameraRequest, Material, Scene, load};
use occlude_host::volumetric::Volumes;
use occlude_kernel::lanes::{Task, detect, dispatch, levels};
use occlude_kernel::{
    BatchScratch, Bvh, Counts, Occluders, Ray, Simd, Targets, TilePoint, TileScratch, Uncounted,
};
use occlude_tests::meshes::{globe, icosphere, rotation, sponge, torus};
use occlude_tests::{Random, Triangle, bounds, shared_scene};
use std::ops::ControlFlow;
use std::path::Path;

/// A scene of triangles that share nothing but places.
fn soup(triangles: &[Triangle]) -> Scene {
    let count = triangles.len() as u32;
    Scene {
        positions: triangles.iter().flatten().copied().collect(),
        triangles: (0..count).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
        triangle_materials: vec![0; triangles.len()],
        materials: vec![Material { name: "grey".into(), diffuse: Vec3::splat(0.5), emission: Vec3::ZERO }],
        ..Scene::default()
    }
}

/// A box of twelve triangles that face out.
fn cuboid(lower: Vec3, upper: Vec3) -> Vec<Triangle> {
    let corner = |i: usize| {
        let side = |axis: usize| if i >> axis & 1 == 0 { lower[axis] } else { upper[axis] };
        Vec3::new(side(0), side(1), side(2))
    };
    let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).map(|t| t.map(corner)).collect()
}

fn turned(triangles: &[Triangle]) -> Vec<Triangle> {
    triangles.iter().map(|&[a, b, c]| [a, c, b]).collect()
}

/// A light of this size around a point.
fn light(at: Vec3, u: Vec3, v: Vec3) -> AreaLight {
    AreaLight {
        shape: Shape::Parallelogram,
        corner: at - (u + v) * 0.5,
        u,
        v,
        normal: u.cross(v).normalize(),
        area: u.cross(v).length(),
        radiance: Vec3::ONE,
        triangles: [0; 2],
    }
}

/// What is closed.
#[test]
fn closed_means_that_edges_balance() {
    let sizes = |triangles: &[Triangle]| -> Vec<usize> {
        mesh::closed(&soup(triangles)).iter().map(Vec::len).collect()
    };
    let cube = cuboid(Vec3::ZERO, Vec3::ONE);
    assert_eq!(sizes(&cube), [12]);
    assert_eq!(sizes(&turned(&cube)), [12], "inside out is closed as well");
    assert!(sizes(&cube[1..]).is_empty(), "a hole");
    let mut flipped = cube.clone();
    flipped[3].swap(0, 1);
    assert!(sizes(&flipped).is_empty(), "a face the wrong way round");
    // Another one at an edge, at a face, at a corner, inside, and a sheet at an edge.
    let moved = |x, y, z| cuboid(Vec3::new(x, y, z), Vec3::new(x, y, z) + 1.0);
    assert_eq!(sizes(&[cube.clone(), moved(1.0, 1.0, 0.0)].concat()), [12, 12]);
    assert_eq!(sizes(&[cube.clone(), moved(1.0, 1.0, 1.0)].concat()), [12, 12]);
    assert_eq!(sizes(&[cube.clone(), moved(1.0, 0.0, 0.0)].concat()).iter().sum::<usize>(), 24);
    assert_eq!(sizes(&[cube.clone(), cuboid(Vec3::splat(0.25), Vec3::splat(0.75))].concat()), [12, 12]);
    let sheet = [Vec3::ZERO, Vec3::X, Vec3::new(0.0, -1.0, -1.0)];
    assert_eq!(sizes(&[cube.clone(), vec![sheet]].concat()), [12], "what hangs at an edge does not matter");
    assert_eq!(sizes(&[cube.clone(), vec![[Vec3::splat(9.0); 3]]].concat()), [12], "a point is nothing");
    let line = [Vec3::ZERO, Vec3::ZERO, Vec3::X];
    assert_eq!(sizes(&[cube.clone(), vec![line]].concat()), [12], "nor is a line");
    assert_eq!(sizes(&sponge(2).triangles(|v| v.as_vec3())).len(), 1);
    assert!(sizes(&[]).is_empty());
}

/// Closed meshes of many kinds in the box from -1 to 1.
fn bodies(random: &mut Random) -> Vec<(&'static str, Vec<Triangle>)> {
    let mut turn = || {
        let m = rotation(random);
        move |v: glam::DVec3| m * v.as_vec3() * 0.9
    };
    let (first, second, third, fourth) = (turn(), turn(), turn(), turn());
    let cube = cuboid(Vec3::splat(-0.7), Vec3::splat(0.7));
    let tilted: Vec<Triangle> = cube.iter().map(|t| t.map(|v| first(v.as_dvec3()))).collect();
    let ball = icosphere(3).triangles(second);
    let near =
        |t: &[Triangle], by: Vec3| -> Vec<Triangle> { t.iter().map(|t| t.map(|v| v * 0.6 + by)).collect() };
    vec![
        ("cube", cube.clone()),
        ("tilted cube", tilted),
        ("inside out", turned(&cube)),
        ("plate", cuboid(Vec3::new(-0.9, -0.01, -0.9), Vec3::new(0.9, 0.01, 0.9))),
        ("rod", cuboid(Vec3::new(-0.01, -0.9, 0.1), Vec3::new(0.01, 0.9, 0.12))),
        ("ball", ball.clone()),
        ("globe", globe(17, 30).triangles(third)),
        ("torus", torus(0.3, 40, 20).triangles(|v| fourth(v * 0.7))),
        ("sponge", sponge(1).triangles(|v| v.as_vec3() * 0.5)),
        ("overlapping", [near(&ball, Vec3::splat(0.1)), near(&ball, Vec3::splat(-0.2))].concat()),
        // A shell: the hollow in it is inside the outer surface all the same.
        ("nested", [cube.clone(), turned(&near(&cube, Vec3::ZERO))].concat()),
        ("at an edge", [near(&cube, Vec3::splat(0.42)), near(&cube, Vec3::new(-0.42, -0.42, 0.42))].concat()),
    ]
}

/// Scenes from -1 to 1, and lights around them and among them.
fn lit(random: &mut Random) -> Vec<(String, Scene, Vec<AreaLight>)> {
    let mut scenes: Vec<(String, Scene)> =
        bodies(random).into_iter().map(|(name, triangles)| (name.to_owned(), soup(&triangles))).collect();
    for (kind, count) in [(Kind::Spheres, 20_000), (Kind::City, 3000), (Kind::Sponge, 2112)] {
        scenes.push((kind.name().to_owned(), generate(kind, 4, count)));
    }
    for name in ["teapot_toys", "vented_case"] {
        if let Some(folder) = shared_scene(name) {
            scenes.push((name.to_owned(), load(&folder, &CameraRequest::default()).expect("it loads")));
        }
    }
    scenes
        .into_iter()
        .map(|(name, scene)| {
            let (lower, upper) = scene.bounds().expect("triangles");
            let (middle, size) = ((lower + upper) * 0.5, (upper - lower) * 0.5);
            let mut all = lights(&scene);
            for i in 0..12 {
                let at = middle + size * random.point() * if i < 6 { 1.0 } else { 3.0 };
                let [u, v] = [0; 2].map(|_| random.direction() * size.max_element() * [0.02, 0.4][i % 2]);
                all.push(light(at, u, v));
            }
            (name, scene, all)
        })
        .collect()
}

/// Bits of targets that boxes hide, by levels.
struct Hide<'a> {
    bvh: Bvh<'a>,
    occluders: &'a Occluders<'a>,
    x: Vec3,
    targets: &'a Targets<'a>,
    scratch: &'a mut BatchScratch,
}

impl Task for Hide<'_> {
    type Output = u64;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> u64 {
        let mut hidden = [0];
        let bvh = self.bvh.on(simd);
        bvh.hidden_batch(self.occluders, self.x, self.targets, &mut Uncounted, self.scratch, &mut hidden);
        hidden[0]
    }
}

/// Segments from anywhere to lights: none that a box blocks is free.
fn no_box_blocks_what_is_free(segments: usize) {
    let mut random = Random::new(51);
    let scenes = lit(&mut random);
    let batches = segments.div_ceil(64 * scenes.len());
    let (mut total, mut all_hidden) = (0, 0);
    for (name, scene, lights) in &scenes {
        let accel = Accel::build(scene, Quality::Medium);
        let bvh = accel.bvh();
        let volumes = Volumes::build(scene, lights);
        let occluders = volumes.occluders();
        let (lower, upper) = scene.bounds().expect("triangles");
        let (middle, size) = ((lower + upper) * 0.5, (upper - lower) * 0.5);
        let mut scratch = BatchScratch::new();
        let (mut asked, mut blocked, mut hidden) = (0, 0, 0);
        for round in 0..batches {
            let light = random.below(lights.len());
            // Anywhere, in a box, or on a surface.
            let x = match round % 4 {
                0 if !volumes.boxes().is_empty() => {
                    let b = volumes.boxes()[random.below(volumes.boxes().len())];
                    b.lower + (b.upper - b.lower) * (random.point() * 0.5 + 0.5)
                }
                1 => {
                    let at = random.below(scene.triangles.len()) as u32;
                    random.on_triangle(&scene.vertices(at))
                }
                _ => middle + size * random.point() * 1.5,
            };
            let targets: Vec<Vec3> =
                (0..64).map(|_| lights[light].point([random.unit(), random.unit()])).collect();
            let [xs, ys, zs] = [0, 1, 2].map(|axis| targets.iter().map(|y| y[axis]).collect::<Vec<_>>());
            let ends = Targets::new(&xs, &ys, &zs).expect("one length");
            let area = &lights[light];
            let flat = ends.on_parallelogram(area.corner, area.u, area.v);
            let ends = if round % 3 == 0 { ends } else { flat };
            let mut by_level = Vec::new();
            for level in levels() {
                let occluders = &occluders[light];
                let ask = Hide { bvh, occluders, x, targets: &ends, scratch: &mut scratch };
                by_level.push(dispatch(level, ask));
            }
            for (i, &y) in targets.iter().enumerate() {
                let free = !bvh.occluded(&Ray::segment(x, y), None, &mut Uncounted);
                for bits in &by_level {
                    let behind = bits >> i & 1 == 1;
                    assert!(!(behind && free), "{name}: a box blocks {x:?} to {y:?}, light {light}");
                }
                asked += 1;
                blocked += usize::from(!free);
                hidden += usize::from(by_level[0] >> i & 1 == 1);
            }
        }
        println!(
            "{name}: {} boxes, {:.1} % filled, {:.0} ms; of {asked} segments {blocked} blocked, {hidden} by boxes",
            volumes.boxes().len(),
            100.0 * volumes.stats.fraction(),
            volumes.stats.time.as_secs_f64() * 1e3
        );
        assert!(!volumes.boxes().is_empty(), "{name}");
        assert!(hidden > 0, "{name}");
        total += asked;
        all_hidden += hidden;
    }
    println!("{total} segments, {all_hidden} blocked by boxes");
    assert!(total >= segments && all_hidden > total / 50);
}

#[test]
fn no_box_blocks_what_is_free_in_short() {
    no_box_blocks_what_is_free(100_000);
}

#[test]
#[ignore = "a million segments; seconds in a release build, minutes without"]
fn no_box_blocks_what_is_free_at_length() {
    no_box_blocks_what_is_free(1_000_000);
}

/// Boxes hold no part of a triangle of their mesh, and a line out of them crosses it oddly often.
#[test]
fn boxes_are_inside() {
    let mut random = Random::new(52);
    for (name, triangles) in bodies(&mut random) {
        if name == "overlapping" || name == "nested" || name == "at an edge" {
            continue;
        }
        let scene = soup(&triangles);
        let volumes = Volumes::build(&scene, &[light(Vec3::splat(9.0), Vec3::X, Vec3::Y)]);
        let accel = Accel::from_triangles(&triangles, Quality::Medium);
        for solid in volumes.boxes() {
            let inside = |p: Vec3| p.cmpgt(solid.lower).all() && p.cmplt(solid.upper).all();
            for triangle in &triangles {
                assert!((0..20).all(|_| !inside(random.on_triangle(triangle))), "{name}");
            }
            let x = solid.lower + (solid.upper - solid.lower) * (random.point() * 0.5 + 0.5);
            let mut hits = 0;
            let ray = Ray::from(x, random.direction());
            accel.bvh().each_hit(&ray, None, &mut Uncounted, |_| {
                hits += 1;
                ControlFlow::Continue(())
            });
            assert_eq!(hits % 2, 1, "{name}: {x} in {solid:?}");
        }
        let fraction = volumes.stats.fraction();
        println!("{name}: {} boxes, {:.1} % filled", volumes.boxes().len(), 100.0 * fraction);
        let least = match name {
            "cube" | "inside out" | "plate" | "rod" => 0.99,
            "torus" | "tilted cube" => 0.3,
            _ => 0.6,
        };
        assert!(fraction >= least, "{name}");
    }
}

/// A mesh that encloses or touches a light does not block its light; others do.
#[test]
fn rooms_block_nothing_of_their_lamps() {
    let room = turned(&cuboid(Vec3::splat(-2.0), Vec3::splat(2.0)));
    let chest = cuboid(Vec3::new(-1.0, -1.9, -0.5), Vec3::new(0.0, -0.9, 0.5));
    let scene = soup(&[room, chest].concat());
    let up = Vec3::Y * 1.5;
    let lamps = [
        light(up, Vec3::X * 0.3, Vec3::Z * 0.3),
        light(up * 3.0, Vec3::X * 0.3, Vec3::Z * 0.3),
        // Through the ceiling, in it, and in the chest.
        light(Vec3::Y * 2.0, Vec3::X * 0.3, Vec3::Y * 0.3),
        light(Vec3::Y * 2.0, Vec3::X * 0.3, Vec3::Z * 0.3),
        light(Vec3::new(-0.5, -1.4, 0.0), Vec3::X * 0.1, Vec3::Z * 0.1),
    ];
    let volumes = Volumes::build(&scene, &lamps);
    let occluders = volumes.occluders();
    let accel = Accel::build(&scene, Quality::Medium);
    let hides = |lamp: usize, x: Vec3| {
        let y = lamps[lamp].point([0.5; 2]).to_array();
        let targets = Targets::new(&y[0..1], &y[1..2], &y[2..3]).expect("one length");
        let (bvh, occluders, scratch) = (accel.bvh(), &occluders[lamp], &mut BatchScratch::new());
        dispatch(detect(), Hide { bvh, occluders, x, targets: &targets, scratch }) == 1
    };
    let (floor, below, outside) =
        (Vec3::new(1.5, -1.99, 0.0), Vec3::new(-0.5, -1.95, 0.1), Vec3::new(0.1, -3.0, 0.2));
    // By lamp: a point of the floor in sight, one under the chest, one under the room.
    let said: Vec<[bool; 3]> = (0..5).map(|lamp| [floor, below, outside].map(|x| hides(lamp, x))).collect();
    assert_eq!(said[0], [false, true, false]);
    assert_eq!(said[1], [true; 3]);
    assert_eq!(said[2], [false, true, false]);
    assert_eq!(said[3], [false, true, false]);
    assert_eq!(said[4], [false; 3]);
    let only_inside = Volumes::build(&scene, &lamps[4..]);
    assert!(only_inside.boxes().is_empty());
}

/// Whole tiles: the same bits with boxes and without.
struct Tiles<'a> {
    bvh: Bvh<'a>,
    occluders: &'a Occluders<'a>,
    points: &'a [TilePoint],
    targets: &'a Targets<'a>,
    scratch: &'a mut TileScratch,
}

impl Task for Tiles<'_> {
    /// The bits with boxes and without, and whether the boxes answered.
    type Output = ([Vec<u64>; 2], bool);

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Self::Output {
        let Self { occluders, points, targets, scratch, .. } = self;
        let bvh = self.bvh.on(simd);
        let mut bits = [0; 2].map(|_| vec![0; targets.len().div_ceil(64)]);
        let mut counts = Counts::default();
        bvh.occluded_tile_with(occluders, points, targets, None, &mut counts, scratch, &mut bits[0]);
        bvh.occluded_tile(points, targets, None, &mut Uncounted, scratch, &mut bits[1]);
        let by_box = counts.triangle_tests == 0 && bits[0].iter().any(|&word| word != 0);
        (bits, by_box)
    }
}

#[test]
fn a_tile_behind_a_box_is_dark() {
    let mut random = Random::new(53);
    let mut proven = 0;
    for (name, scene, lights) in lit(&mut random) {
        let accel = Accel::build(&scene, Quality::Medium);
        let volumes = Volumes::build(&scene, &lights);
        let occluders = volumes.occluders();
        let (lower, upper) = scene.bounds().expect("triangles");
        let (middle, size) = ((lower + upper) * 0.5, (upper - lower) * 0.5);
        let mut scratch = TileScratch::new();
        let (mut of_scene, mut dark) = (0, 0);
        for round in 0..400 {
            let light = random.below(lights.len());
            let area = &lights[light];
            let at = match round % 2 {
                0 if !volumes.boxes().is_empty() => {
                    // Beyond a box, or in it.
                    let b = volumes.boxes()[random.below(volumes.boxes().len())];
                    let through = b.lower + (b.upper - b.lower) * (random.point() * 0.5 + 0.5);
                    through + (through - area.point([0.5; 2])) * random.unit() * 0.3
                }
                _ => middle + size * random.point() * 1.2,
            };
            // A flat patch, or a cloud.
            let scale = size.max_element() * random.any_scale(-4.0, -0.7).abs();
            let (u, v) = (random.direction() * scale, random.direction() * scale);
            let each = [1, 4, 16][round % 3];
            let points: Vec<TilePoint> = (0..64u32)
                .map(|i| {
                    let (s, t) = (i as f32 % 8.0 / 8.0, (i / 8) as f32 / 8.0);
                    let x = at + if round % 5 == 0 { random.point() * scale } else { u * s + v * t };
                    TilePoint { x: x.to_array(), first: i * each, count: each }
                })
                .collect();
            let ends: Vec<Vec3> =
                (0..64 * each).map(|_| area.point([random.unit(), random.unit()])).collect();
            let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|y| y[axis]).collect::<Vec<_>>());
            let targets = Targets::new(&xs, &ys, &zs).expect("one length");
            let flat = targets.on_parallelogram(area.corner, area.u, area.v);
            let targets = if round % 7 == 0 { targets } else { flat };
            for level in levels() {
                let (bvh, occluders, points) = (accel.bvh(), &occluders[light], &points[..]);
                let ask = Tiles { bvh, occluders, points, targets: &targets, scratch: &mut scratch };
                let ([with, without], by_box) = dispatch(level, ask);
                assert_eq!(with, without, "{name}: round {round}");
                of_scene += usize::from(by_box);
                dark += without.iter().map(|word| word.count_ones()).sum::<u32>() / (64 * each);
            }
        }
        println!("{name}: {of_scene} of {dark} dark tiles behind a box");
        proven += of_scene;
    }
    assert!(proven > 500, "{proven} tiles");
}

/// The exact method, with boxes and without, in the same bits.
#[test]
fn images_are_the_same_bits() {
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a workspace").join("scenes");
    let mut scenes: Vec<Scene> = ["columns", "cornell", "fence", "half_plane", "plates"]
        .iter()
        .map(|name| load(&own.join(name), &CameraRequest::default()).expect("it loads"))
        .collect();
    let kinds = [(Kind::Spheres, 20_000), (Kind::City, 3000), (Kind::Sponge, 2112)];
    scenes.extend(kinds.map(|(kind, count)| generate(kind, 4, count)));
    let shared = ["teapot_toys", "vented_case", "bunny_penumbra", "cornell_original"];
    let shared = shared.iter().filter_map(|name| shared_scene(name));
    scenes.extend(shared.map(|folder| load(&folder, &CameraRequest::default()).expect("it loads")));
    let mut total = [0; 2];
    for scene in &scenes {
        let accel = Accel::build(scene, Quality::Medium);
        let lights = lights(scene);
        let volumes = Volumes::build(scene, &lights);
        let walled = Walled::new(volumes.occluders());
        let mut camera = scene.camera.expect("a camera");
        (camera.width, camera.height) = (96, 64);
        let frame = camera.frame();
        let (mut tests, mut dark) = ([0; 2], 0);
        for shadow_rays in [1, 16] {
            let stage = Stage {
                scene,
                bvh: accel.bvh(),
                lights: &lights,
                eye: camera.eye,
                camera: &frame,
                shadow_rays,
                pattern: Pattern::default(),
                seed: 6,
                level: detect(),
                count: true,
            };
            for tile in Tile::cover(camera.width, camera.height, 16) {
                let questions = questions(&stage, tile, camera.width, 0);
                let mut counts = [Counts::default(), Counts::default()];
                let (mut with, mut without) = (Vec::new(), Vec::new());
                walled.estimate(&stage, &questions, &mut with, &mut counts[0]);
                Exact.estimate(&stage, &questions, &mut without, &mut counts[1]);
                assert_eq!(with, without, "{}: {tile:?}", scene.name);
                assert_eq!(counts[0].rays, counts[1].rays);
                (tests[0], tests[1]) =
                    (tests[0] + counts[0].triangle_tests, tests[1] + counts[1].triangle_tests);
                dark += without.iter().filter(|&&estimate| estimate == 0.0).count();
            }
        }
        println!(
            "{}: {} boxes, {dark} dark; triangle tests {} with, {} without",
            scene.name,
            volumes.boxes().len(),
            tests[0],
            tests[1]
        );
        // What is learned from point to point differs a little.
        assert!(tests[0] <= tests[1] + tests[1] / 10, "{}: {tests:?}", scene.name);
        total = [total[0] + tests[0], total[1] + tests[1]];
    }
    assert!(total[0] < total[1], "{total:?}");
}

/// No triangles, no lights, flat meshes, and numbers that are no size.
#[test]
fn odd_scenes_have_no_boxes() {
    let lamp = [light(Vec3::splat(5.0), Vec3::X, Vec3::Y)];
    assert!(Volumes::build(&Scene::default(), &lamp).boxes().is_empty());
    let cube = cuboid(Vec3::ZERO, Vec3::ONE);
    assert!(Volumes::build(&soup(&cube), &[]).boxes().is_empty());
    assert!(Volumes::build(&soup(&cube[2..]), &lamp).boxes().is_empty(), "open");
    let flat: Vec<Triangle> = cube.iter().map(|t| t.map(|v| v * Vec3::new(1.0, 0.0, 1.0))).collect();
    assert!(Volumes::build(&soup(&flat), &lamp).boxes().is_empty(), "flat");
    // Far from the origin a box would be smaller than the rounding.
    let far: Vec<Triangle> = cube.iter().map(|t| t.map(|v| v + 1e6)).collect();
    let (lower, upper) = bounds(far.iter().flatten().copied());
    assert!(lower.x < upper.x);
    assert!(Volumes::build(&soup(&far), &lamp).boxes().is_empty(), "far");
    let huge: Vec<Triangle> = cube.iter().map(|t| t.map(|v| v * 1e17)).collect();
    let tiny: Vec<Triangle> = cube.iter().map(|t| t.map(|v| v * 1e-17)).collect();
    assert_eq!(Volumes::build(&soup(&huge), &lamp).boxes().len(), 0, "the light is in it");
    assert_eq!(Volumes::build(&soup(&tiny), &lamp).boxes().len(), 1);
}
