//! Shared set-up for the benchmarks: scenes, the shadow rays they ask about, who answers them, and a clock.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_host::error::Result;
use occlude_host::film::{Tile, z_order};
use occlude_host::generate::{Kind, generate};
use occlude_host::light::{AreaLight, lights};
use occlude_host::sampler::{Pattern, Sampler};
use occlude_host::scene::{CameraRequest, Scene, load};
use occlude_kernel::lanes::{Task, detect, dispatch};
use occlude_kernel::{Bvh, Ray, Simd, Uncounted, offset};
use rustix::time::{ClockId, clock_gettime};
use std::ops::Range;
use std::path::{Path, PathBuf};

#[cfg(feature = "embree")]
#[path = "support/embree.rs"]
pub mod embree;
#[path = "support/learning.rs"]
pub mod learning;
#[path = "support/obvhs.rs"]
pub mod obvhs;
#[path = "support/ours.rs"]
pub mod ours;
#[path = "support/pack.rs"]
pub mod pack;
#[path = "support/record.rs"]
pub mod record;
#[path = "support/scaling.rs"]
pub mod scaling;
#[path = "support/whole.rs"]
pub mod whole;

/// What is asked: batches of shadow rays, each from a point to samples of a light.
#[derive(Clone, Debug, Default)]
pub struct Work {
    /// The batches, in the order of the picture.
    pub batches: Vec<Batch>,
    /// The far ends of all batches, one after the other: x, y and z.
    pub targets: [Vec<f32>; 3],
    /// The lights: a corner and two edges.
    pub planes: Vec<[Vec3; 3]>,
    /// Batches that belong together: one light, and points in one tile of the picture.
    pub tiles: Vec<Range<u32>>,
    /// Tile and light of the last batch.
    place: Option<(u32, u32)>,
}

/// One point and one light: up to 64 shadow rays.
#[derive(Clone, Copy, Debug)]
pub struct Batch {
    /// Where the rays begin.
    pub origin: Vec3,
    /// Which light.
    pub light: u32,
    /// The first of its targets.
    pub first: u32,
    /// The one after the last.
    pub last: u32,
}

impl Work {
    /// Rays in all batches.
    pub fn rays(&self) -> usize {
        self.targets[0].len()
    }

    /// Every ray, in the order of the batches.
    pub fn segments(&self) -> Vec<Ray> {
        let [x, y, z] = &self.targets;
        let of = |batch: &Batch| {
            let origin = batch.origin;
            (batch.first as usize..batch.last as usize).map(move |i| Ray::segment(origin, [x[i], y[i], z[i]]))
        };
        self.batches.iter().flat_map(of).collect()
    }

    /// A word for the answers of each batch.
    pub fn answers(&self) -> Vec<u64> {
        vec![0; self.batches.len()]
    }
}

/// Answers all of some work: a word a batch, a bit a ray, 1 for blocked.
pub type Answer<'a> = Box<dyn Fn(&Work, &mut [u64]) + 'a>;

/// Somebody who answers.
pub struct Peer<'a> {
    /// What it is called.
    pub name: String,
    /// `ours`, `embree` or `obvhs`.
    pub family: &'static str,
    /// How it answers.
    pub answer: Answer<'a>,
}

/// How much of a light a point sees, by 64 exact rays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// All of it.
    Lit,
    /// Nothing.
    Dark,
    /// Some of it.
    Penumbra,
}

impl Class {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Lit, Self::Dark, Self::Penumbra];

    /// In lower case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Lit => "lit",
            Self::Dark => "dark",
            Self::Penumbra => "penumbra",
        }
    }
}

/// A point and a light that faces it.
#[derive(Clone, Copy, Debug)]
pub struct Pair {
    x: Vec3,
    normal: Vec3,
    origin: Vec3,
    pixel: u64,
    tile: u32,
    light: u32,
    /// How much it sees.
    pub class: Class,
}

/// A scene, its tree, and points its camera sees.
#[derive(Debug)]
pub struct Setting {
    /// What it is called.
    pub name: String,
    /// Its triangles.
    pub scene: Scene,
    /// Its lights.
    pub lights: Vec<AreaLight>,
    /// Shaded points.
    pub points: usize,
    /// Each of them with each of its lights, in the order of the picture.
    pub pairs: Vec<Pair>,
    clearance: f32,
    accel: Accel,
}

/// The picture that points are taken from, and the tiles that are taken whole.
const SIZE: (u32, u32) = (1280, 720);
const TILE: u32 = 16;

/// With as many samples a point or more, a tile is asked about in four parts, as the host does.
const PARTED: usize = 4;

/// The seeds of the rays measured, and of those that tell the classes.
const SEEDS: [u64; 2] = [1, 2];

impl Setting {
    /// Finds the first hits of the scene's camera in as many tiles of 16 by 16 pixels, evenly spread over the
    /// picture, as give about so many points.
    pub fn new(name: &str, scene: Scene, points: usize) -> Self {
        let accel = Accel::build(&scene, Quality::default());
        let lights = lights(&scene);
        let all = dispatch(detect(), FirstHits { bvh: accel.bvh(), scene: &scene });
        let tiles: Vec<_> = all.chunk_by(|a, b| a.tile / 4 == b.tile / 4).collect();
        let each = (TILE * TILE) as usize;
        let kept = (points / each).clamp(1, tiles.len().max(1)).min(tiles.len());
        let clearance = accel.bvh().clearance();
        let (mut pairs, mut points) = (Vec::new(), 0);
        for i in 0..kept {
            let tile = tiles[(2 * i + 1) * tiles.len() / (2 * kept)];
            points += tile.len();
            for (light, area) in (0..).zip(&lights) {
                for &FirstHit { pixel, tile, x, normal } in tile {
                    if area.unshadowed(x, normal).is_some() {
                        let origin = offset(x, normal, clearance);
                        pairs.push(Pair { x, normal, origin, pixel, tile, light, class: Class::Lit });
                    }
                }
            }
        }
        let mut setting = Self { name: name.to_owned(), scene, lights, points, pairs, clearance, accel };
        setting.classify();
        setting
    }

    /// Tells the classes, and drops pairs with no sample above both horizons.
    fn classify(&mut self) {
        let mut work = self.no_work();
        let mut pairs = self.pairs.clone();
        pairs.retain(|pair| self.ask(pair, 64, SEEDS[1], &mut work));
        let mut blocked = work.answers();
        let counter = &mut Uncounted;
        dispatch(detect(), ours::Single { bvh: self.bvh(), work: &work, blocked: &mut blocked, counter });
        for (pair, (batch, blocked)) in pairs.iter_mut().zip(work.batches.iter().zip(blocked)) {
            pair.class = match blocked.count_ones() {
                0 => Class::Lit,
                all if all == batch.last - batch.first => Class::Dark,
                _ => Class::Penumbra,
            };
        }
        self.pairs = pairs;
    }

    fn no_work(&self) -> Work {
        let planes = self.lights.iter().map(|light| [light.corner, light.u, light.v]).collect();
        Work { planes, ..Work::default() }
    }

    /// The tree. It is checked, so ask once for many rays.
    pub fn bvh(&self) -> Bvh<'_> {
        self.accel.bvh()
    }

    /// Bytes of the tree.
    pub fn bytes(&self) -> usize {
        self.accel.bytes()
    }

    /// The shadow rays of all pairs, or of one class: `n` stratified samples of the light each, less those below
    /// either horizon, which a renderer would not ask about. The same rays for a pair either way.
    pub fn work(&self, n: usize, class: Option<Class>) -> Work {
        let mut work = self.no_work();
        for pair in self.pairs.iter().filter(|pair| class.is_none_or(|class| class == pair.class)) {
            self.ask(pair, n, SEEDS[0], &mut work);
        }
        work
    }

    /// Adds the batch of a pair, unless it has no rays.
    fn ask(&self, pair: &Pair, n: usize, seed: u64, work: &mut Work) -> bool {
        let light = &self.lights[pair.light as usize];
        let first = work.rays() as u32;
        let mut square = Vec::with_capacity(n);
        Sampler::new(seed, pair.pixel, pair.light).points(Pattern::Jittered, n, &mut square);
        for at in square {
            let y = light.point(at);
            let path = y - pair.x;
            if light.normal.dot(path) < 0.0 && pair.normal.dot(path) > 0.0 {
                let target = offset(y, light.normal, self.clearance);
                for axis in 0..3 {
                    work.targets[axis].push(target[axis]);
                }
            }
        }
        let last = work.rays() as u32;
        if last > first {
            let index = work.batches.len() as u32;
            let part = if n < PARTED { 4 } else { 1 };
            let place = (pair.tile / part, pair.light);
            match work.tiles.last_mut() {
                Some(tile) if work.place == Some(place) => tile.end = index + 1,
                _ => work.tiles.push(index..index + 1),
            }
            work.place = Some(place);
            work.batches.push(Batch { origin: pair.origin, light: pair.light, first, last });
        }
        last > first
    }
}

/// A point that the camera sees.
#[derive(Clone, Copy)]
struct FirstHit {
    pixel: u64,
    tile: u32,
    x: Vec3,
    normal: Vec3,
}

/// All of them that reflect, in tiles.
struct FirstHits<'a> {
    bvh: Bvh<'a>,
    scene: &'a Scene,
}

impl Task for FirstHits<'_> {
    type Output = Vec<FirstHit>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Vec<FirstHit> {
        let bvh = self.bvh.on(simd);
        let (width, height) = SIZE;
        let mut found = Vec::new();
        let Some(mut camera) = self.scene.camera else { return found };
        (camera.width, camera.height) = SIZE;
        let frame = camera.frame();
        for (index, tile) in (0..).zip(Tile::cover(width, height, TILE)) {
            let quarter = |pixel: &usize| {
                let (x, y) = tile.position(*pixel);
                2 * ((y - tile.y) / (TILE / 2)) + (x - tile.x) / (TILE / 2)
            };
            // Along a Z curve, so that neighbours in the list are neighbours in the picture.
            let mut pixels: Vec<usize> = (0..tile.len()).collect();
            pixels.sort_by_key(|&pixel| {
                let (x, y) = tile.position(pixel);
                z_order(x - tile.x, y - tile.y)
            });
            for pixel in pixels {
                let (px, py) = tile.position(pixel);
                let toward = frame.ray_direction(px as f32 + 0.5, py as f32 + 0.5);
                let ray = Ray::from(camera.eye, toward);
                let Some(hit) = bvh.closest(&ray, None, &mut Uncounted) else { continue };
                let [a, b, c] = self.scene.vertices(hit.triangle);
                let across = (b - a).as_dvec3().cross((c - a).as_dvec3());
                let Some(normal) = across.try_normalize() else { continue };
                if self.scene.material(hit.triangle).diffuse.max_element() <= 0.0 {
                    continue;
                }
                let normal = normal.as_vec3();
                found.push(FirstHit {
                    pixel: u64::from(py) * u64::from(width) + u64::from(px),
                    tile: 4 * index + quarter(&pixel),
                    x: a * (1.0 - hit.u - hit.v) + b * hit.u + c * hit.v,
                    normal: if normal.dot(toward) < 0.0 { normal } else { -normal },
                });
            }
        }
        found
    }
}

/// Scenes of `../shared/scenes`.
pub const SHARED: [&str; 6] =
    ["cornell_original", "bunny_penumbra", "sponza_part", "teapot_toys", "apple_tree", "vented_case"];

/// Scenes of the repository.
pub const OWN: [&str; 5] = ["cornell", "columns", "fence", "half_plane", "plates"];

/// Triangles of a generated scene unless its name says otherwise.
const GENERATED: usize = 100_000;

/// Where a scene comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// A folder, which may be absent.
    Folder(PathBuf),
    /// Made of about so many triangles.
    Made(Kind, usize),
}

/// The scene of a name: one of [`SHARED`], one of [`OWN`], or a kind of generated scene with or without a number
/// of triangles, `hair` or `hair:1000000`.
pub fn source(name: &str) -> Option<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    if SHARED.contains(&name) {
        return Some(Source::Folder(shared_folder().join(name)));
    }
    if OWN.contains(&name) {
        return Some(Source::Folder(root.join("scenes").join(name)));
    }
    let (kind, triangles) = name.split_once(':').unwrap_or((name, ""));
    let kind = Kind::ALL.into_iter().find(|known| known.name() == kind)?;
    let triangles = if name.contains(':') { triangles.parse().ok()? } else { GENERATED };
    Some(Source::Made(kind, triangles))
}

/// Where the shared scenes are: beside the repository, or where `OCCLUDE_SCENES` says.
pub fn shared_folder() -> PathBuf {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/scenes");
    std::env::var_os("OCCLUDE_SCENES").map_or_else(beside, PathBuf::from)
}

/// The scene of a name. `None`, with a message, if its folder is absent or there is no such name.
pub fn scene(name: &str) -> Option<Result<Scene>> {
    match source(name) {
        Some(Source::Made(kind, triangles)) => Some(Ok(generate(kind, 1, triangles))),
        Some(Source::Folder(folder)) if folder.exists() => Some(load(&folder, &CameraRequest::default())),
        Some(Source::Folder(folder)) => {
            eprintln!("skipped: {name} is not at {}", folder.display());
            None
        }
        None => {
            eprintln!("skipped: no scene is called {name}");
            None
        }
    }
}

/// Scenes of the repository, generated ones, and the shared ones where there are any.
pub fn settings(points: usize) -> Vec<Setting> {
    let names = ["cornell", "columns", "spheres", "hair"].into_iter().chain(SHARED);
    names
        .filter_map(|name| match scene(name)? {
            Ok(scene) => Some(Setting::new(name, scene, points)),
            Err(error) => {
                eprintln!("skipped: {error}");
                None
            }
        })
        .collect()
}

/// CPU time of this thread, in seconds: other processes hardly show in it.
pub fn thread_time() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// How often a tree is built to say how long that takes: small ones take so little that other work often comes between.
pub fn builds(scene: &Scene) -> usize {
    match scene.triangles.len() {
        n if n > 2_000_000 => 1,
        n => (1_000_000 / n.max(1)).clamp(3, 25),
    }
}

/// The middle one; of two middle ones their mean. NaN of nothing.
pub fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let half = values.len() / 2;
    match values.len() {
        0 => f64::NAN,
        odd if odd % 2 == 1 => values[half],
        _ => (values[half - 1] + values[half]) / 2.0,
    }
}
