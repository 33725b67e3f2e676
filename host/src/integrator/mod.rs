//! Direct light, tile by tile, in stages over arrays: camera rays, light samples, visibility, shading.
//!
//! The stages stand apart so that each can be timed, and so that visibility, the only one in which methods
//! differ, gets all its questions at once: [`Visibility`] is what a method implements.

mod auto;
mod exact;
mod map;
mod stochastic;

use auto::Kind;
pub use auto::{Auto, AutoOptions, Learned, SavedMap, fingerprint};
pub use exact::{Anew, Exact, Walled};
pub use map::{Classes, FLATNESS, Map, MapOptions, MapTerms, PreparedMap};
pub use stochastic::{Form, Rule, Settings, Split, Stochastic};

use crate::clock;
use crate::film::{Heard, Tile, TileFilm};
use crate::light::AreaLight;
use crate::sampler::{Pattern, Sampler};
use crate::scene::{Frame, Scene};
use glam::Vec3;
use occlude_kernel::lanes::{Level, Task, dispatch};
use occlude_kernel::occlusion_map::bin;
use occlude_kernel::{Bvh, Counter, Counts, RayPacket, Simd, Uncounted, offset};
use std::f32::consts::FRAC_1_PI;
use std::ops::Range;
use std::time::Duration;

/// Everything a render reads and nothing writes.
#[derive(Clone, Copy)]
pub struct Stage<'a> {
    /// Triangles and materials.
    pub scene: &'a Scene,
    /// Their tree.
    pub bvh: Bvh<'a>,
    /// The lights.
    pub lights: &'a [AreaLight],
    /// Where camera rays start.
    pub eye: Vec3,
    /// Where they go.
    pub camera: &'a Frame,
    /// Shadow rays a camera sample, over all lights together.
    pub shadow_rays: u32,
    /// How they are spread over a light.
    pub pattern: Pattern,
    /// The seed of every random number.
    pub seed: u64,
    /// The SIMD level.
    pub level: Level,
    /// Whether to count the work done.
    pub count: bool,
}

/// Answers, for a tile, how much of each light sample arrives.
///
/// Of a pass, tiles are asked in any order and at the same time, and none of them learns from another: what a method
/// learns it may use from the next pass on, in [`Visibility::passed`].
pub trait Visibility: Sync {
    /// Gets ready, before the first pass, for an image in these tiles.
    fn begin(&self, _: &Stage<'_>, _: &[Tile], _width: u32) {}

    /// Says which samples of the lights the points of `scratch` ask about, and adds what needs no asking.
    fn ask(&self, stage: &Stage<'_>, scratch: &mut Scratch) {
        sample_lights(stage, scratch);
    }

    /// Hears that a pass has ended.
    fn passed(&self, _: &Stage<'_>) {}

    /// Writes an estimate for each sample of `questions`, in their order: right on average, and for an exact
    /// method 0 or 1.
    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    );
}

impl<V: Visibility + ?Sized> Visibility for &V {
    fn begin(&self, stage: &Stage<'_>, tiles: &[Tile], width: u32) {
        (**self).begin(stage, tiles, width);
    }

    fn ask(&self, stage: &Stage<'_>, scratch: &mut Scratch) {
        (**self).ask(stage, scratch);
    }

    fn passed(&self, stage: &Stage<'_>) {
        (**self).passed(stage);
    }

    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        (**self).estimate(stage, questions, estimates, counts);
    }
}

/// A point that light may reach.
#[derive(Clone, Copy, Debug)]
pub struct ShadingPoint {
    /// The pixel, counted row by row in its tile.
    pub pixel: u32,
    /// Which of the camera samples asked for.
    path: u32,
    /// The point on the surface.
    pub x: Vec3,
    /// The same moved off the surface, to the side it is seen from: where shadow rays begin.
    pub origin: Vec3,
    /// Unit geometric normal, to that side.
    pub normal: Vec3,
    /// The triangle it lies on.
    pub triangle: u32,
    /// Diffuse reflectance.
    pub diffuse: Vec3,
    /// The key of random numbers that are this point's own, for [`Sampler::from_key`].
    pub key: u64,
    /// Shadow rays it is due, over all lights together.
    pub rays: u32,
    /// Whether they are its own, so that no other point gets any of them.
    pub firm: bool,
}

/// The samples of one light as seen from one point.
#[derive(Clone, Debug)]
pub struct Batch {
    /// Which of the points.
    pub point: u32,
    /// Which of the lights.
    pub light: u32,
    /// Its samples.
    pub samples: Range<u32>,
    /// What part of the light the samples stand for: 1 on average, and 1 if it always gets samples.
    pub share: f32,
}

/// What a tile asks: points, batches, and the samples of all batches one after the other.
#[derive(Clone, Debug, Default)]
pub struct Questions {
    /// The points of the tile that are worth asking about.
    pub points: Vec<ShadingPoint>,
    /// The points' lights, in the order of the points.
    pub batches: Vec<Batch>,
    /// The far ends, moved off the light to the side it shines to: x, y and z.
    pub targets: [Vec<f32>; 3],
    /// What each sample adds if it arrives, per unit of reflectance times radiance.
    pub weights: Vec<f32>,
    /// Pixels across the tile.
    pub width: u32,
    /// Of methods that learn: for each batch the cell that wants to hear of it, or [`NOBODY`], and for each sample of
    /// those the bin of the light.
    cells: Vec<u32>,
    bins: Vec<u8>,
    /// And for each batch what would arrive with nothing in the way, of reflectance and radiance 1; infinite where
    /// that has been dealt with, and not a number where it is not known.
    wholes: Vec<f32>,
    /// And for each batch how many samples it would have had without what was learned.
    usual: Vec<f32>,
    /// And for each batch what kind of pixel asked.
    kinds: Vec<Kind>,
    /// And for each batch of a point with rays of its own what part of the light its pixel had seen on average before.
    before: Vec<Option<f32>>,
    /// The tile's first column and row.
    place: [u32; 2],
}

/// Who wants to hear of a batch if nobody does.
const NOBODY: u32 = u32::MAX;

impl Questions {
    fn clear(&mut self) {
        self.points.clear();
        self.batches.clear();
        self.targets.iter_mut().for_each(Vec::clear);
        self.weights.clear();
        self.cells.clear();
        self.bins.clear();
        self.wholes.clear();
        self.usual.clear();
        self.kinds.clear();
        self.before.clear();
    }
}

/// Where the time went, summed over threads: time they worked, where the system tells ([`crate::clock`]).
#[derive(Clone, Copy, Debug, Default)]
pub struct StageTimes {
    /// Camera rays and their nearest hits.
    pub camera: Duration,
    /// Choosing lights and points on them.
    pub light: Duration,
    /// Asking what arrives.
    pub visibility: Duration,
    /// Adding it up.
    pub shade: Duration,
}

impl std::ops::AddAssign for StageTimes {
    fn add_assign(&mut self, other: Self) {
        self.camera += other.camera;
        self.light += other.light;
        self.visibility += other.visibility;
        self.shade += other.shade;
    }
}

/// A camera sample: which pixel of a tile, counted row by row, and which of that pixel's samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CameraSample {
    /// The pixel.
    pub pixel: u32,
    /// The round. What a pixel gets in a round may follow from earlier ones, since rounds share no random number.
    pub round: u32,
    /// The sample in the round; those of a pixel are spread the better the fewer are left out.
    pub index: u32,
    /// Its shadow rays, over all lights together: a method may ask more for it, and fewer only of lights that it has proven
    /// lit. Of `None` the usual number, which a method may share with other samples.
    pub rays: Option<u32>,
}

impl CameraSample {
    /// One of a pixel that gets one in each pass, with the usual shadow rays.
    pub fn even(pixel: u32, pass: u32) -> Self {
        Self { pixel, round: 0, index: pass, rays: None }
    }
}

/// What a thread keeps from tile to tile, so that nothing is allocated in between.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    paths: Vec<CameraSample>,
    samplers: Vec<Sampler>,
    radiance: Vec<Vec3>,
    questions: Questions,
    estimates: Vec<f32>,
    shares: Vec<Share>,
    square: Vec<[f32; 2]>,
    fan: Fan,
    /// Time spent so far.
    pub times: StageTimes,
    /// Work done so far: camera rays apart, since they are no shadow rays.
    pub camera_counts: Counts,
    /// Work done for visibility.
    pub shadow_counts: Counts,
}

impl Scratch {
    /// From here on the points' random numbers are others than they would have been: of each key other ones.
    fn draw_anew(&mut self, key: u64) {
        for sampler in &mut self.samplers {
            *sampler = Sampler::from_key(sampler.key() ^ key);
        }
    }
}

/// Renders one camera sample of every pixel of a tile and adds it to the film.
pub fn render_tile(
    stage: &Stage<'_>,
    method: &dyn Visibility,
    width: u32,
    pass: u32,
    film: &mut TileFilm,
    scratch: &mut Scratch,
) {
    let pixels = 0..film.tile().len() as u32;
    let samples = pixels.map(|pixel| CameraSample::even(pixel, pass));
    render_samples(stage, method, width, samples, film, scratch);
}

/// The same of any camera samples of a tile.
pub fn render_samples(
    stage: &Stage<'_>,
    method: &dyn Visibility,
    width: u32,
    samples: impl IntoIterator<Item = CameraSample>,
    film: &mut TileFilm,
    scratch: &mut Scratch,
) {
    scratch.paths.clear();
    scratch.paths.extend(samples);
    let start = clock::of_thread();
    cast(stage, film.tile(), width, scratch);
    let cast_end = clock::of_thread();
    method.ask(stage, scratch);
    let light_end = clock::of_thread();
    method.estimate(stage, &scratch.questions, &mut scratch.estimates, &mut scratch.shadow_counts);
    let visibility_end = clock::of_thread();
    shade(stage, film, scratch);
    scratch.times += StageTimes {
        camera: cast_end - start,
        light: light_end - cast_end,
        visibility: visibility_end - light_end,
        shade: clock::of_thread() - visibility_end,
    };
}

/// What one pass over a tile asks: for benchmarks and tests of visibility alone.
pub fn questions(stage: &Stage<'_>, tile: Tile, width: u32, pass: u32) -> Questions {
    let mut scratch = Scratch::default();
    scratch.paths.extend((0..tile.len() as u32).map(|pixel| CameraSample::even(pixel, pass)));
    cast(stage, tile, width, &mut scratch);
    sample_lights(stage, &mut scratch);
    scratch.questions
}

/// The nearest hits of up to 16 camera rays.
struct Cast<'a, C> {
    bvh: Bvh<'a>,
    rays: &'a RayPacket,
    active: u32,
    counter: &'a mut C,
}

impl<C: Counter> Task for Cast<'_, C> {
    type Output = occlude_kernel::HitPacket;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Self::Output {
        self.bvh.on(simd).closest_packet(self.rays, self.active, None, self.counter)
    }
}

/// Casts the camera rays of all paths, and starts everything else anew.
fn cast(stage: &Stage<'_>, tile: Tile, width: u32, scratch: &mut Scratch) {
    scratch.questions.clear();
    scratch.questions.width = tile.width;
    scratch.questions.place = [tile.x, tile.y];
    scratch.samplers.clear();
    scratch.radiance.clear();
    scratch.radiance.resize(scratch.paths.len(), Vec3::ZERO);
    let mut rays = RayPacket::default();
    for first in (0..scratch.paths.len()).step_by(RayPacket::WIDTH) {
        let count = RayPacket::WIDTH.min(scratch.paths.len() - first);
        for lane in 0..count {
            let CameraSample { pixel, round, index, .. } = scratch.paths[first + lane];
            let seed = Sampler::seed_of_round(stage.seed, round);
            let (x, y) = tile.position(pixel as usize);
            let pixel = u64::from(y) * u64::from(width) + u64::from(x);
            let at = Sampler::in_pixel(seed, pixel, index);
            let (px, py) = (x as f32 + at[0], y as f32 + at[1]);
            rays.set(lane, &occlude_kernel::Ray::from(stage.eye, stage.camera.ray_direction(px, py)));
            scratch.samplers.push(Sampler::new(seed, pixel, index));
        }
        let (bvh, rays, active) = (stage.bvh, &rays, (1u32 << count) - 1);
        let hits = if stage.count {
            dispatch(stage.level, Cast { bvh, rays, active, counter: &mut scratch.camera_counts })
        } else {
            dispatch(stage.level, Cast { bvh, rays, active, counter: &mut Uncounted })
        };
        for lane in (0..count).filter(|lane| hits.hit >> lane & 1 != 0) {
            let hit = hits.hits[lane];
            let toward = -rays.get(lane).direction;
            let [a, b, c] = stage.scene.vertices(hit.triangle);
            let across = (b - a).as_dvec3().cross((c - a).as_dvec3());
            let Some(geometric) = across.try_normalize() else { continue };
            let geometric = geometric.as_vec3();
            let material = stage.scene.material(hit.triangle);
            let front = geometric.dot(toward) > 0.0;
            if front {
                scratch.radiance[first + lane] += material.emission;
            }
            if material.diffuse.max_element() <= 0.0 {
                continue;
            }
            let normal = if front { geometric } else { -geometric };
            let x = a * (1.0 - hit.u - hit.v) + b * hit.u + c * hit.v;
            scratch.questions.points.push(ShadingPoint {
                pixel: scratch.paths[first + lane].pixel,
                path: (first + lane) as u32,
                x,
                origin: offset(x, normal, stage.bvh.clearance()),
                normal,
                triangle: hit.triangle,
                diffuse: material.diffuse,
                key: scratch.samplers[first + lane].key(),
                rays: scratch.paths[first + lane].rays.unwrap_or(stage.shadow_rays),
                firm: scratch.paths[first + lane].rays.is_some(),
            });
        }
    }
}

/// The part of the shadow rays that every light in sight shares evenly, whatever its estimate says.
const FAIR_SHARE: f32 = 0.1;

/// The lights that a point may see, and how many samples each gets: the number, what each counts, and what part of
/// the light they stand for together.
///
/// A light gets rays in proportion to the irradiance it would give with nothing in the way, in closed form, and
/// a tenth of them is shared evenly. Rounding to whole rays is systematic sampling with one random number: a
/// light due `e` rays gets `floor(e)` or `ceil(e)`, and `e` on average. Where that is never 0 its samples are
/// averaged (weight 1/n), which is right for either number; else they are weighed by 1/e.
fn divide(stage: &Stage<'_>, point: &ShadingPoint, sampler: &mut Sampler, shares: &mut Vec<Share>) {
    expect(stage, point, shares);
    round(sampler, shares, Some(point.rays));
}

/// How many samples each light that a point may see is due.
fn expect(stage: &Stage<'_>, point: &ShadingPoint, shares: &mut Vec<Share>) {
    shares.clear();
    shares.extend(stage.lights.iter().enumerate().filter_map(|(light, area)| {
        let unshadowed = area.unshadowed(point.x, point.normal)?;
        Some(Share { light: light as u32, unshadowed, expected: 0.0, count: 0, each: 0.0 })
    }));
    let value = |share: &Share| share.unshadowed * stage.lights[share.light as usize].radiance.element_sum();
    let total: f32 = shares.iter().map(value).sum();
    let fair = FAIR_SHARE / shares.len() as f32;
    for share in shares.iter_mut() {
        share.expected = point.rays as f32 * ((1.0 - FAIR_SHARE) * value(share) / total + fair);
    }
}

/// How many each gets; `all` rays are given in the end, whatever rounding does, if it says how many that is.
fn round(sampler: &mut Sampler, shares: &mut [Share], all: Option<u32>) {
    let mut due = f64::from(sampler.uniform());
    let mut given = 0u32;
    let last = shares.len().saturating_sub(1);
    for (place, share) in shares.iter_mut().enumerate() {
        due += f64::from(share.expected);
        let until = match all {
            Some(all) if place == last => all,
            Some(all) => (due as u32).clamp(given, all),
            None => (due as u32).max(given),
        };
        share.count = until - given;
        given = until;
        share.each = if share.expected > 1.001 { 1.0 / share.count as f32 } else { 1.0 / share.expected };
    }
}

/// The samples of a light that a point gets.
#[derive(Clone, Copy, Debug)]
struct Share {
    light: u32,
    /// Irradiance with nothing in the way, of radiance 1.
    unshadowed: f32,
    /// Samples it is due, and those it gets.
    expected: f32,
    count: u32,
    each: f32,
}

/// Points of one light as seen from one point: places, and what each adds.
#[derive(Clone, Debug, Default)]
struct Fan {
    /// Moved off the light: x, y and z.
    targets: [Vec<f32>; 3],
    /// 0 for one that sends nothing there.
    weights: Vec<f32>,
    /// Whether all of them send something.
    every: bool,
    /// Which part of the light they lie in.
    bins: Vec<u8>,
    /// How many times as likely as with an even density, if they follow another.
    densities: Vec<f32>,
}

impl Fan {
    fn resize(&mut self, count: usize) {
        self.targets.iter_mut().for_each(|axis| axis.resize(count, 0.0));
        self.weights.resize(count, 0.0);
        self.bins.resize(count, 0);
        self.densities.resize(count, 1.0);
    }

    /// Opens it to points of the light's unit square.
    fn open(
        &mut self,
        stage: &Stage<'_>,
        area: &AreaLight,
        point: &ShadingPoint,
        square: &[[f32; 2]],
        each: f32,
    ) {
        self.resize(square.len());
        let clearance = stage.bvh.clearance();
        dispatch(stage.level, Open { fan: self, area, point, square, each, clearance });
    }

    /// The bins of the samples that send something.
    fn append_bins_to(&self, bins: &mut Vec<u8>) {
        if self.every {
            return bins.extend_from_slice(&self.bins);
        }
        bins.extend(self.bins.iter().zip(&self.weights).filter(|(_, w)| **w > 0.0).map(|(bin, _)| bin));
    }

    /// The samples that send something.
    fn append_to(&self, questions: &mut Questions) {
        let to = questions.targets.iter_mut().chain([&mut questions.weights]);
        for (to, from) in to.zip(self.targets.iter().chain([&self.weights])) {
            if self.every {
                to.extend_from_slice(from);
            } else {
                to.extend(from.iter().zip(&self.weights).filter(|(_, w)| **w > 0.0).map(|(at, _)| at));
            }
        }
    }
}

/// How a light and a surface face each other: what a place on the light sends.
#[derive(Clone, Copy)]
struct Facing {
    light: Vec3,
    surface: Vec3,
    /// The density of a place, the reflection of a diffuse surface, and what a sample counts.
    scale: f32,
}

impl Facing {
    #[inline(always)]
    fn new(area: &AreaLight, point: &ShadingPoint, each: f32) -> Self {
        Self { light: area.normal, surface: point.normal, scale: area.area * FRAC_1_PI * each }
    }

    /// Cosines and inverse square along the way to a place of the light; 0 if it sends nothing there. Without a branch.
    #[inline(always)]
    fn weight(&self, path: Vec3) -> f32 {
        let one = 1.0 / path.length_squared();
        let (leaving, arriving) = (-self.light.dot(path), self.surface.dot(path));
        let arrives = (leaving > 0.0) & (arriving > 0.0);
        let weight = (leaving * one) * (arriving * one) * self.scale;
        if arrives { weight } else { 0.0 }
    }
}

/// Loops over plain slices, for the compiler to turn into vectors of the level.
struct Open<'a> {
    fan: &'a mut Fan,
    area: &'a AreaLight,
    point: &'a ShadingPoint,
    square: &'a [[f32; 2]],
    each: f32,
    clearance: f32,
}

impl Task for Open<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { fan, area, point, square, each, clearance } = self;
        let count = square.len();
        let [x, y, z] = &mut fan.targets;
        let (x, y, z) = (&mut x[..count], &mut y[..count], &mut z[..count]);
        let weights = &mut fan.weights[..count];
        let bins = &mut fan.bins[..count];
        let facing = Facing::new(area, point, each);
        // What stays the same is copied: a vector would gather what only some of its lanes need.
        let &AreaLight { corner, u, v, normal, shape, .. } = area;
        let from = point.x;
        let whole = shape == crate::light::Shape::Parallelogram;
        let mut every = true;
        let mut i = 0;
        while i < count {
            let [mut s, mut t] = square[i];
            bins[i] = bin(square[i]) as u8;
            if !whole {
                let root = s.sqrt();
                (s, t) = (1.0 - root, t * root);
            }
            let at = corner + u * s + v * t;
            let weight = facing.weight(at - from);
            every &= weight > 0.0;
            weights[i] = weight;
            let target = at + normal * clearance;
            x[i] = target.x;
            y[i] = target.y;
            z[i] = target.z;
            i += 1;
        }
        fan.every = every;
    }
}

/// Spreads the shadow rays of each point over the lights and over their areas.
fn sample_lights(stage: &Stage<'_>, scratch: &mut Scratch) {
    let Scratch { samplers, questions, shares, square, fan, .. } = scratch;
    for index in 0..questions.points.len() {
        let point = questions.points[index];
        let sampler = &mut samplers[point.path as usize];
        divide(stage, &point, sampler, shares);
        for &Share { light, count, each, .. } in shares.iter().filter(|share| share.count > 0) {
            let first = questions.weights.len() as u32;
            square.clear();
            sampler.points(stage.pattern, count as usize, square);
            fan.open(stage, &stage.lights[light as usize], &point, square, each);
            fan.append_to(questions);
            let last = questions.weights.len() as u32;
            if last > first {
                let share = count as f32 * each;
                questions.batches.push(Batch { point: index as u32, light, samples: first..last, share });
            }
        }
    }
}

/// Sums over pairs of numbers; in eight parts, so that vectors can take them and the order does not depend on the machine.
#[inline(always)]
fn sums<const N: usize>(
    weights: &[f32],
    estimates: &[f32],
    terms: impl Fn(f32, f32) -> [f32; N],
) -> [f32; N] {
    let mut parts = [[0.0f32; 8]; N];
    let (mut w, mut v) = (weights.chunks_exact(8), estimates.chunks_exact(8));
    for (w, v) in w.by_ref().zip(v.by_ref()) {
        for lane in 0..8 {
            let terms = terms(w[lane], v[lane]);
            for k in 0..N {
                parts[k][lane] += terms[k];
            }
        }
    }
    for (lane, (w, v)) in w.remainder().iter().zip(v.remainder()).enumerate() {
        let terms = terms(*w, *v);
        for k in 0..N {
            parts[k][lane] += terms[k];
        }
    }
    parts.map(|x| ((x[0] + x[4]) + (x[1] + x[5])) + ((x[2] + x[6]) + (x[3] + x[7])))
}

fn shade(stage: &Stage<'_>, film: &mut TileFilm, scratch: &mut Scratch) {
    let Scratch { questions, estimates, radiance, paths, .. } = scratch;
    let listens = film.listens();
    for (index, batch) in questions.batches.iter().enumerate() {
        let samples = batch.samples.start as usize..batch.samples.end as usize;
        let point = &questions.points[batch.point as usize];
        let full = point.diffuse * stage.lights[batch.light as usize].radiance;
        let (weights, estimates) = (&questions.weights[samples.clone()], &estimates[samples]);
        if !listens {
            let [arrives] = sums(weights, estimates, |w, v| [w * v]);
            radiance[point.path as usize] += full * arrives;
            continue;
        }
        let moments = |w: f32, v: f32| [w, w * v, w * v * v, (w * v) * (w * v)];
        let [all, arrives, visible, squares] = sums(weights, estimates, moments);
        radiance[point.path as usize] += full * arrives;
        // Where the form of the light has been taken out, only what is in the way differs from sample to sample.
        let n = weights.len() as f32;
        let formless = questions.wholes.get(index).is_some_and(|whole| !whole.is_nan());
        let second = if formless { visible * all } else { squares * n };
        let variance = (second - arrives * arrives) / (n - 1.0).max(1.0);
        let heard =
            Heard::batch(weights.len(), point.rays, batch.share, full.length_squared(), arrives, variance);
        film.hear(point.pixel as usize, heard);
    }
    for (path, &radiance) in paths.iter().zip(radiance.iter()) {
        film.add(path.pixel as usize, radiance);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_are_over_all_samples() {
        for count in 0..40 {
            let weights: Vec<f32> = (0..count).map(|k| k as f32).collect();
            let estimates: Vec<f32> = (0..count).map(|k| (k % 2) as f32).collect();
            let all = weights.iter().sum::<f32>();
            let free = weights.iter().zip(&estimates).map(|(w, v)| w * v).sum::<f32>();
            assert_eq!(sums(&weights, &estimates, |w, v| [w, w * v]), [all, free], "{count}");
        }
    }
}
