//! The map that learns beside the exact method: the same camera samples, as many shadow rays, one thread, its CPU time.

use crate::{Batch, PARTED, Peer, Work};
use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_host::clock;
use occlude_host::film::{Film, Image, Tile, z_order};
use occlude_host::integrator::{
    Anew, Auto, AutoOptions, Exact, Learned, Questions, Scratch, Stage, Visibility, questions, render_tile,
};
use occlude_host::light::{AreaLight, lights};
use occlude_host::sampler::Pattern;
use occlude_host::scene::{Frame, Scene};
use occlude_kernel::Bvh;
use occlude_kernel::lanes::Level;
use std::ops::AddAssign;

/// Makes this thread the only one that rayon knows, so that its CPU time is that of all the work.
///
/// # Panics
/// If rayon has been used before.
pub fn stay_alone() {
    rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .use_current_thread()
        .build_global()
        .expect("nobody used rayon before");
}

/// A scene, its tree and its camera.
pub struct Place {
    /// What it is called.
    pub name: String,
    /// Its triangles.
    pub scene: Scene,
    /// The picture's size.
    pub size: (u32, u32),
    lights: Vec<AreaLight>,
    accel: Accel,
    eye: Vec3,
    frame: Frame,
}

impl Place {
    /// `None` without a camera.
    pub fn new(name: &str, scene: Scene, size: (u32, u32)) -> Option<Self> {
        let mut camera = scene.camera?;
        (camera.width, camera.height) = size;
        let (lights, accel) = (lights(&scene), Accel::build(&scene, Quality::default()));
        Some(Self {
            name: name.to_owned(),
            scene,
            size,
            lights,
            accel,
            eye: camera.eye,
            frame: camera.frame(),
        })
    }

    /// The tree. It is checked, so ask once for many rays.
    pub fn bvh(&self) -> Bvh<'_> {
        self.accel.bvh()
    }

    /// What a render of it reads.
    pub fn stage(&self, level: Level, shadow_rays: u32, seed: u64) -> Stage<'_> {
        Stage {
            scene: &self.scene,
            bvh: self.accel.bvh(),
            lights: &self.lights,
            eye: self.eye,
            camera: &self.frame,
            shadow_rays,
            pattern: Pattern::default(),
            seed,
            level,
            count: false,
        }
    }

    /// The shadow rays of a pass of the exact method, in the order in which it asks: tile by tile, light by light, and
    /// neighbours after each other.
    pub fn work(&self, stage: &Stage<'_>, pass: u32) -> Work {
        let planes = self.lights.iter().map(|light| [light.corner, light.u, light.v]).collect();
        let mut work = Work { planes, ..Work::default() };
        for tile in Tile::cover(self.size.0, self.size.1, Film::TILE) {
            work.append(&questions(stage, tile, self.size.0, pass));
        }
        work
    }
}

/// Pixels of a part of a tile, along its Z curve, that is asked about together unless rays are few.
const PART: u64 = 64;

impl Work {
    /// Adds what a tile of a render asks.
    fn append(&mut self, asked: &Questions) {
        let place = |batch: &occlude_host::integrator::Batch| {
            let pixel = asked.points[batch.point as usize].pixel;
            (batch.light, z_order(pixel % asked.width.max(1), pixel / asked.width.max(1)))
        };
        let mut order: Vec<_> = asked.batches.iter().map(|batch| (place(batch), batch)).collect();
        order.sort_by_key(|&(place, _)| place);
        let few = asked.weights.len() < PARTED * asked.batches.len();
        let part = |(light, place): (u32, u64)| (light, if few { 0 } else { place / PART });
        for part in order.chunk_by(|a, b| part(a.0) == part(b.0)) {
            let begin = self.batches.len() as u32;
            for ((light, _), batch) in part {
                let samples = batch.samples.start as usize..batch.samples.end as usize;
                let first = self.rays() as u32;
                for (to, from) in self.targets.iter_mut().zip(&asked.targets) {
                    to.extend_from_slice(&from[samples.clone()]);
                }
                let origin = asked.points[batch.point as usize].origin;
                self.batches.push(Batch { origin, light: *light, first, last: self.rays() as u32 });
            }
            self.tiles.push(begin..self.batches.len() as u32);
        }
    }
}

/// What a method has spent, s of CPU time, and how far off its picture is.
#[derive(Clone, Copy, Debug, Default)]
pub struct Spent {
    /// Before the first pass and between passes: a first look at the picture, proofs, lessons.
    pub learning: f64,
    /// Choosing lights and points on them, and what the map says of them.
    pub light: f64,
    /// Asking what arrives, and counting it.
    pub visibility: f64,
    /// Camera rays and shading.
    pub rest: f64,
    /// The mean square over pixels and channels of what shadow rays made wrong, radiance squared.
    pub squared_error: f64,
}

impl Spent {
    /// With all that was learned for it.
    pub fn of_visibility(&self) -> f64 {
        self.learning + self.visibility
    }

    /// And with light samples.
    pub fn of_light(&self) -> f64 {
        self.of_visibility() + self.light
    }

    /// From the start to the last pass.
    pub fn whole(&self) -> f64 {
        self.of_light() + self.rest
    }
}

impl AddAssign for Spent {
    fn add_assign(&mut self, other: Self) {
        self.learning += other.learning;
        self.light += other.light;
        self.visibility += other.visibility;
        self.rest += other.rest;
        self.squared_error += other.squared_error;
    }
}

/// A picture in the making.
struct Runner<'a> {
    method: &'a dyn Visibility,
    film: Film,
    scratch: Scratch,
    learning: f64,
}

impl<'a> Runner<'a> {
    fn new(method: &'a dyn Visibility, stage: &Stage<'_>, size: (u32, u32)) -> Self {
        let film = Film::new(size.0, size.1);
        let tiles: Vec<_> = film.tiles().iter().map(|tile| tile.tile()).collect();
        let mut runner = Self { method, film, scratch: Scratch::default(), learning: 0.0 };
        runner.learn(|| method.begin(stage, &tiles, size.0));
        runner
    }

    fn learn(&mut self, what: impl FnOnce()) {
        let start = clock::of_thread();
        what();
        self.learning += (clock::of_thread() - start).as_secs_f64();
    }

    fn pass(&mut self, stage: &Stage<'_>, pass: u32) {
        let width = self.film.width();
        for tile in self.film.tiles_mut() {
            render_tile(stage, self.method, width, pass, tile, &mut self.scratch);
        }
        let method = self.method;
        self.learn(|| method.passed(stage));
    }

    fn spent(&self, truths: &[Image; 2]) -> Spent {
        let times = self.scratch.times;
        Spent {
            learning: self.learning,
            light: times.light.as_secs_f64(),
            visibility: times.visibility.as_secs_f64(),
            rest: (times.camera + times.shade).as_secs_f64(),
            squared_error: squared_error(&self.film.develop(), truths),
        }
    }
}

/// The mean square of what an image is off, without what the references are off, which are right on average and have random
/// numbers of their own: the mean product of the differences from one and from the other.
fn squared_error(image: &Image, truths: &[Image; 2]) -> f64 {
    let channels = |image: &Image| image.pixels.iter().flatten().copied().map(f64::from).collect::<Vec<_>>();
    let [image, a, b] = [image, &truths[0], &truths[1]].map(channels);
    let sum: f64 = image.iter().zip(a.iter().zip(&b)).map(|(x, (a, b))| (x - a) * (x - b)).sum();
    sum / image.len().max(1) as f64
}

/// The mean over pixels and channels.
pub fn squared_difference(a: &Image, b: &Image) -> f64 {
    let pairs = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
    let sum: f64 = pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum();
    sum / (3 * a.pixels.len().max(1)) as f64
}

/// How the methods meet.
#[derive(Clone, Copy, Debug)]
pub struct Terms {
    /// The SIMD level.
    pub level: Level,
    /// N, the shadow rays a camera sample, over all lights together.
    pub shadow_rays: u32,
    /// Passes: camera samples a pixel.
    pub passes: u32,
    /// Pictures of other random numbers, whose times and squared errors are added up.
    pub seeds: u64,
    /// Bytes that the map may take, if not as many as usual.
    pub memory: Option<usize>,
}

impl Terms {
    /// With as many passes as make fewer rays need more of them: 128 of one ray, 32 of 16, 16 of 64.
    pub fn new(level: Level, shadow_rays: u32) -> Self {
        let passes = (128.0 / f64::from(shadow_rays).sqrt()).ceil().max(2.0) as u32;
        Self { level, shadow_rays, passes, seeds: 1, memory: None }
    }

    /// Rays of each of two references for each camera sample.
    fn reference_rays(&self) -> u32 {
        (2 * self.shadow_rays).max(8)
    }
}

/// What came of it.
#[derive(Clone, Debug, Default)]
pub struct Meeting {
    /// The scene.
    pub scene: String,
    /// How many triangles.
    pub triangles: usize,
    /// N.
    pub shadow_rays: u32,
    /// Camera samples a pixel.
    pub passes: u32,
    /// Shadow rays of the exact method, in all passes.
    pub rays: f64,
    /// What it spent.
    pub exact: Spent,
    /// And the map that learns.
    pub auto: Spent,
    /// Bytes of the map.
    pub map_bytes: usize,
    /// What it knew in the end.
    pub learned: Option<Learned>,
    /// Our tile query by itself, with the exact method's rays: ns a ray.
    pub tile_ns: f64,
    /// The quickest of Embree's ways with the same rays, and its ns a ray.
    pub best: Option<(String, f64)>,
    /// The part of the rays that it answers otherwise than the tile query.
    pub differ: f64,
}

impl Meeting {
    /// Squared errors, of auto over exact.
    pub fn error_ratio(&self) -> f64 {
        self.auto.squared_error / self.exact.squared_error
    }

    /// How many times better auto is at equal error, of what takes the time that `which` gives.
    pub fn gain(&self, which: impl Fn(&Spent) -> f64) -> f64 {
        which(&self.exact) / (which(&self.auto) * self.error_ratio())
    }

    /// ns for a ray of the exact method.
    pub fn exact_ns(&self) -> f64 {
        self.exact.visibility / self.rays * 1e9
    }

    /// ns that auto spends, lessons included, for each ray that the exact method would trace to come to the same error.
    pub fn effective_ns(&self) -> f64 {
        self.auto.of_visibility() * self.error_ratio() / self.rays * 1e9
    }

    /// ns a ray of the best of Embree over [`Meeting::effective_ns`]; NaN without Embree.
    pub fn lead(&self) -> f64 {
        self.best.as_ref().map_or(f64::NAN, |(_, ns)| ns / self.effective_ns())
    }

    /// The same with light samples on both sides: Embree's rays are those of the exact method, and so are their costs.
    pub fn lead_with_samples(&self) -> f64 {
        let samples = self.exact.light / self.rays * 1e9;
        let auto = self.auto.of_light() * self.error_ratio() / self.rays * 1e9;
        self.best.as_ref().map_or(f64::NAN, |(_, ns)| (ns + samples) / auto)
    }
}

/// Peers are asked in so many of the passes.
const ASKED: u32 = 4;

/// Those slower than this many times the best of Embree at first are not asked again.
const HOPELESS: f64 = 1.4;

/// Renders a place by the exact method and by the map that learns, pass by pass in turns; and in some of the passes
/// `peers`, the first of them our tile query, answer the very rays of the exact method.
pub fn meet(place: &Place, terms: &Terms, peers: &[Peer<'_>]) -> Meeting {
    let mut options = AutoOptions::default();
    options.memory = terms.memory.unwrap_or(options.memory);
    let mut meeting = Meeting {
        scene: place.name.clone(),
        triangles: place.scene.triangles.len(),
        shadow_rays: terms.shadow_rays,
        passes: terms.passes,
        ..Meeting::default()
    };
    let mut contest = Contest::new(peers);
    for seed in 0..terms.seeds {
        let stage = place.stage(terms.level, terms.shadow_rays, seed);
        let many = Stage { shadow_rays: terms.reference_rays(), ..stage };
        let auto = Auto::new(options);
        let anew = [Anew(1), Anew(2)];
        let mut references = anew.each_ref().map(|anew| Runner::new(anew, &many, place.size));
        let mut runners = [Runner::new(&Exact, &stage, place.size), Runner::new(&auto, &stage, place.size)];
        for pass in 0..terms.passes {
            references.iter_mut().for_each(|reference| reference.pass(&many, pass));
            // Whoever comes first may find caches in another state.
            let first = usize::from(pass % 2 == 1);
            runners[first].pass(&stage, pass);
            runners[1 - first].pass(&stage, pass);
            let work = place.work(&stage, pass);
            meeting.rays += work.rays() as f64;
            if pass.is_multiple_of(terms.passes.div_ceil(ASKED)) {
                contest.ask(&work);
            }
        }
        let truths = references.map(|reference| reference.film.develop());
        meeting.exact += runners[0].spent(&truths);
        meeting.auto += runners[1].spent(&truths);
        meeting.map_bytes = auto.bytes();
        meeting.learned = auto.history().last().copied();
    }
    contest.report(&mut meeting);
    meeting
}

/// Several who answer the same questions.
struct Contest<'a> {
    peers: &'a [Peer<'a>],
    /// Of each; none once it has no chance.
    tallies: Vec<Option<Tally>>,
    warm: bool,
}

#[derive(Clone, Copy, Default)]
struct Tally {
    seconds: f64,
    rays: f64,
    /// Rays answered otherwise than by the first peer.
    differ: f64,
}

impl<'a> Contest<'a> {
    fn new(peers: &'a [Peer<'a>]) -> Self {
        Self { peers, tallies: vec![Some(Tally::default()); peers.len()], warm: false }
    }

    /// Asks all that have a chance. Before the first work everybody does it once, which warms the caches and shows who
    /// has one.
    fn ask(&mut self, work: &Work) {
        if work.rays() == 0 {
            return;
        }
        if !std::mem::replace(&mut self.warm, true) {
            self.answer(work);
            let theirs = self.peers.iter().zip(&self.tallies).filter(|(peer, _)| peer.family != "ours");
            let best =
                theirs.filter_map(|(_, tally)| Some(tally.as_ref()?.seconds)).fold(f64::INFINITY, f64::min);
            for (peer, tally) in self.peers.iter().zip(&mut self.tallies) {
                let chance = |tally: &Tally| peer.family == "ours" || tally.seconds <= HOPELESS * best;
                *tally = tally.filter(chance).map(|_| Tally::default());
            }
        }
        self.answer(work);
    }

    fn answer(&mut self, work: &Work) {
        let mut first: Option<Vec<u64>> = None;
        let mut blocked = work.answers();
        for (peer, tally) in self.peers.iter().zip(&mut self.tallies) {
            let Some(tally) = tally else { continue };
            let start = clock::of_thread();
            (peer.answer)(work, &mut blocked);
            tally.seconds += (clock::of_thread() - start).as_secs_f64();
            tally.rays += work.rays() as f64;
            let first = first.get_or_insert_with(|| blocked.clone());
            let differ: u32 = first.iter().zip(&blocked).map(|(a, b)| (a ^ b).count_ones()).sum();
            tally.differ += f64::from(differ);
        }
    }

    fn report(&self, meeting: &mut Meeting) {
        let each = |tally: &Tally| tally.seconds / tally.rays * 1e9;
        for (peer, tally) in self.peers.iter().zip(&self.tallies) {
            let Some(tally) = tally.as_ref().filter(|tally| tally.rays > 0.0) else { continue };
            if peer.family == "ours" {
                meeting.tile_ns = each(tally);
            } else if meeting.best.as_ref().is_none_or(|(_, best)| each(tally) < *best) {
                meeting.best = Some((peer.name.clone(), each(tally)));
                meeting.differ = tally.differ / tally.rays;
            }
        }
    }
}
