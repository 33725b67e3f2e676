//! Direct light, tile by tile, in stages over arrays: camera rays, light samples, visibility, shading.
//!
//! The stages stand apart so that each can be timed, and so that visibility, the only one in which methods
//! differ, gets all its questions at once: [`Visibility`] is what a method implements.

mod exact;
mod map;
mod stochastic;

pub use exact::{Exact, Walled};
pub use map::{Classes, FLATNESS, Map, MapOptions, PreparedMap};
pub use stochastic::{Form, Rule, Settings, Split, Stochastic};

use crate::film::{Tile, TileFilm};
use crate::light::AreaLight;
use crate::sampler::{Pattern, Sampler};
use crate::scene::{Frame, Scene};
use glam::Vec3;
use occlude_kernel::lanes::{Level, Task, dispatch};
use occlude_kernel::{Bvh, Counter, Counts, RayPacket, Simd, Uncounted, offset};
use std::f32::consts::FRAC_1_PI;
use std::ops::Range;
use std::time::{Duration, Instant};

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
pub trait Visibility: Sync {
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

/// A point that light may reach.
#[derive(Clone, Copy, Debug)]
pub struct ShadingPoint {
    /// The pixel, counted row by row in its tile.
    pub pixel: u32,
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
}

impl Questions {
    fn clear(&mut self) {
        self.points.clear();
        self.batches.clear();
        self.targets.iter_mut().for_each(Vec::clear);
        self.weights.clear();
    }
}

/// Where the time went, summed over threads.
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

/// What a thread keeps from tile to tile, so that nothing is allocated in between.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    samplers: Vec<Sampler>,
    radiance: Vec<Vec3>,
    questions: Questions,
    estimates: Vec<f32>,
    shares: Vec<(u32, f32)>,
    square: Vec<[f32; 2]>,
    /// Time spent so far.
    pub times: StageTimes,
    /// Work done so far: camera rays apart, since they are no shadow rays.
    pub camera_counts: Counts,
    /// Work done for visibility.
    pub shadow_counts: Counts,
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
    let start = Instant::now();
    let tile = film.tile();
    scratch.questions.clear();
    scratch.questions.width = tile.width;
    scratch.samplers.clear();
    scratch.radiance.clear();
    scratch.radiance.resize(tile.len(), Vec3::ZERO);
    cast(stage, tile, width, pass, scratch);
    let cast_end = Instant::now();
    sample_lights(stage, scratch);
    let light_end = Instant::now();
    method.estimate(stage, &scratch.questions, &mut scratch.estimates, &mut scratch.shadow_counts);
    let visibility_end = Instant::now();
    shade(stage, film, scratch);
    scratch.times += StageTimes {
        camera: cast_end - start,
        light: light_end - cast_end,
        visibility: visibility_end - light_end,
        shade: visibility_end.elapsed(),
    };
}

/// What one pass over a tile asks: for benchmarks and tests of visibility alone.
pub fn questions(stage: &Stage<'_>, tile: Tile, width: u32, pass: u32) -> Questions {
    let mut scratch = Scratch { radiance: vec![Vec3::ZERO; tile.len()], ..Scratch::default() };
    scratch.questions.width = tile.width;
    cast(stage, tile, width, pass, &mut scratch);
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

fn cast(stage: &Stage<'_>, tile: Tile, width: u32, pass: u32, scratch: &mut Scratch) {
    let mut rays = RayPacket::default();
    for first in (0..tile.len()).step_by(RayPacket::WIDTH) {
        let count = RayPacket::WIDTH.min(tile.len() - first);
        for lane in 0..count {
            let (x, y) = tile.position(first + lane);
            let pixel = u64::from(y) * u64::from(width) + u64::from(x);
            let at = Sampler::in_pixel(stage.seed, pixel, pass);
            let (px, py) = (x as f32 + at[0], y as f32 + at[1]);
            rays.set(lane, &occlude_kernel::Ray::from(stage.eye, stage.camera.ray_direction(px, py)));
            scratch.samplers.push(Sampler::new(stage.seed, pixel, pass));
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
                pixel: (first + lane) as u32,
                x,
                origin: offset(x, normal, stage.bvh.clearance()),
                normal,
                triangle: hit.triangle,
                diffuse: material.diffuse,
                key: scratch.samplers[first + lane].key(),
            });
        }
    }
}

/// The part of the shadow rays that every light in sight shares evenly, whatever its estimate says.
const FAIR_SHARE: f32 = 0.1;

/// Spreads the shadow rays of each point over the lights and over their areas.
///
/// A light gets rays in proportion to the irradiance it would give with nothing in the way, in closed form, and
/// a tenth of them is shared evenly. Rounding to whole rays is systematic sampling with one random number: a
/// light due `e` rays gets `floor(e)` or `ceil(e)`, and `e` on average. Where that is never 0 its samples are
/// averaged (weight 1/n), which is right for either number; else they are weighed by 1/e.
fn sample_lights(stage: &Stage<'_>, scratch: &mut Scratch) {
    let Scratch { samplers, questions, shares, square, .. } = scratch;
    let clearance = stage.bvh.clearance();
    let Questions { points, batches, targets, weights, .. } = questions;
    for (index, point) in points.iter().enumerate() {
        let sampler = &mut samplers[point.pixel as usize];
        shares.clear();
        shares.extend(stage.lights.iter().enumerate().filter_map(|(light, area)| {
            Some((light as u32, area.unshadowed(point.x, point.normal)? * area.radiance.element_sum()))
        }));
        let total: f32 = shares.iter().map(|share| share.1).sum();
        let fair = FAIR_SHARE / shares.len() as f32;
        let mut due = f64::from(sampler.uniform());
        let mut given = 0u32;
        for (place, &(light, share)) in shares.iter().enumerate() {
            let expected = stage.shadow_rays as f32 * ((1.0 - FAIR_SHARE) * share / total + fair);
            due += f64::from(expected);
            // All of the rays are given in the end, whatever rounding does.
            let until = if place + 1 == shares.len() { stage.shadow_rays } else { due as u32 };
            let until = until.clamp(given, stage.shadow_rays);
            let count = until - given;
            given = until;
            if count == 0 {
                continue;
            }
            let area = &stage.lights[light as usize];
            let each = if expected > 1.001 { 1.0 / count as f32 } else { 1.0 / expected };
            let first = weights.len() as u32;
            square.clear();
            sampler.points(stage.pattern, count as usize, square);
            for &at in square.iter() {
                let y = area.point(at);
                let path = y - point.x;
                let squared = path.length_squared();
                let (leaving, arriving) = (-area.normal.dot(path), point.normal.dot(path));
                if leaving <= 0.0 || arriving <= 0.0 {
                    continue;
                }
                let target = offset(y, area.normal, clearance);
                for axis in 0..3 {
                    targets[axis].push(target[axis]);
                }
                // Cosines, inverse square, the density of a point, and the reflection of a diffuse surface.
                let geometry = leaving / squared * (arriving / squared);
                weights.push(geometry * area.area * FRAC_1_PI * each);
            }
            let last = weights.len() as u32;
            if last > first {
                let share = count as f32 * each;
                batches.push(Batch { point: index as u32, light, samples: first..last, share });
            }
        }
    }
}

fn shade(stage: &Stage<'_>, film: &mut TileFilm, scratch: &mut Scratch) {
    let Scratch { questions, estimates, radiance, .. } = scratch;
    for batch in &questions.batches {
        let samples = batch.samples.start as usize..batch.samples.end as usize;
        let arrives: f32 =
            questions.weights[samples.clone()].iter().zip(&estimates[samples]).map(|(w, v)| w * v).sum();
        let point = &questions.points[batch.point as usize];
        radiance[point.pixel as usize] +=
            point.diffuse * stage.lights[batch.light as usize].radiance * arrives;
    }
    for (pixel, &radiance) in radiance.iter().enumerate() {
        film.add(pixel, radiance);
    }
}
