//! Every shadow ray traced: the answers are right, one by one.

use super::{Questions, Scratch, Stage, Visibility, sample_lights};
use crate::film::z_order;
use crate::light::AreaLight;
use occlude_kernel::lanes::{Task, dispatch};
use occlude_kernel::{Bvh, Counter, Counts, Occluders, Simd, Targets, TilePoint, TileScratch, Uncounted};

/// Traces every shadow ray through the scene's tree, a tile and a light at a time.
#[derive(Clone, Copy, Debug, Default)]
pub struct Exact;

impl Visibility for Exact {
    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        trace(stage, &[], questions, estimates, counts);
    }
}

/// As [`Exact`], at the same points, with other random numbers for the lights: of each key other ones.
#[derive(Clone, Copy, Debug, Default)]
pub struct Anew(pub u64);

impl Visibility for Anew {
    fn ask(&self, stage: &Stage<'_>, scratch: &mut Scratch) {
        scratch.draw_anew(self.0);
        sample_lights(stage, scratch);
    }

    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        Exact.estimate(stage, questions, estimates, counts);
    }
}

/// The same answers as of [`Exact`], but where a box inside a closed mesh stands between all of a tile and all of a
/// light, nothing is traced.
#[derive(Clone, Debug, Default)]
pub struct Walled<'a> {
    occluders: Vec<Occluders<'a>>,
}

impl<'a> Walled<'a> {
    /// With the boxes for each light, such as those of [`crate::volumetric::Volumes::occluders`].
    pub fn new(occluders: Vec<Occluders<'a>>) -> Self {
        Self { occluders }
    }
}

impl Visibility for Walled<'_> {
    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        trace(stage, &self.occluders, questions, estimates, counts);
    }
}

/// Asks everything.
pub(super) fn trace(
    stage: &Stage<'_>,
    occluders: &[Occluders<'_>],
    questions: &Questions,
    estimates: &mut Vec<f32>,
    counts: &mut Counts,
) {
    let blocked = blocked(stage, occluders, questions, counts);
    estimates.clear();
    estimates.resize(blocked.len() * 64, 1.0);
    // Half a word at a time, for the compiler's vectors; a branch a bit would be guessed wrong in every penumbra.
    for (halves, word) in estimates.chunks_exact_mut(64).zip(&blocked) {
        for (half, bits) in halves.chunks_exact_mut(32).zip([*word as u32, (*word >> 32) as u32]) {
            for (k, estimate) in half.iter_mut().enumerate() {
                *estimate = if bits & 1 << k == 0 { 1.0 } else { 0.0 };
            }
        }
    }
    estimates.truncate(questions.weights.len());
}

/// Which samples are blocked, a bit each.
pub(super) fn blocked(
    stage: &Stage<'_>,
    occluders: &[Occluders<'_>],
    questions: &Questions,
    counts: &mut Counts,
) -> Vec<u64> {
    let groups = groups(questions);
    let mut blocked = vec![0; questions.weights.len().div_ceil(64)];
    let (bvh, lights) = (stage.bvh, stage.lights);
    let (groups, words) = (groups.as_slice(), blocked.as_mut_slice());
    if stage.count {
        let counter = counts;
        let trace = Trace { bvh, lights, occluders, questions, groups, blocked: words, counter };
        dispatch(stage.level, trace);
    } else {
        let counter = &mut Uncounted;
        let trace = Trace { bvh, lights, occluders, questions, groups, blocked: words, counter };
        dispatch(stage.level, trace);
    }
    blocked
}

/// Points that share a shaft: one light, and places near each other.
struct Group {
    light: u32,
    points: Vec<TilePoint>,
}

/// With as many samples a point and light or more, a tile is cut into parts of [`PART`] pixels along its Z curve, 8 by 8:
/// narrow shafts then save more than they cost.
const FEW: usize = 4;
const PART: u64 = 64;

/// The batches of a tile by light and by part of the tile, those of neighbours one after the other.
fn groups(questions: &Questions) -> Vec<Group> {
    let Questions { points, batches, width, .. } = questions;
    let whole = questions.weights.len() < FEW * batches.len();
    let place = |batch: &super::Batch| {
        let pixel = points[batch.point as usize].pixel;
        (batch.light, z_order(pixel % width.max(&1), pixel / width.max(&1)))
    };
    let part = |(light, place): (u32, u64)| (light, if whole { 0 } else { place / PART });
    let mut order: Vec<_> = batches.iter().map(|batch| (place(batch), batch)).collect();
    order.sort_by_key(|&(place, _)| place);
    order
        .chunk_by(|a, b| part(a.0) == part(b.0))
        .map(|group| Group {
            light: group[0].0.0,
            points: group
                .iter()
                .map(|(_, batch)| TilePoint {
                    x: points[batch.point as usize].origin.to_array(),
                    first: batch.samples.start,
                    count: batch.samples.end - batch.samples.start,
                })
                .collect(),
        })
        .collect()
}

/// All batches of a tile.
struct Trace<'a, C> {
    bvh: Bvh<'a>,
    lights: &'a [AreaLight],
    /// For each light; or none at all.
    occluders: &'a [Occluders<'a>],
    questions: &'a Questions,
    groups: &'a [Group],
    blocked: &'a mut [u64],
    counter: &'a mut C,
}

impl<C: Counter> Task for Trace<'_, C> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let bvh = self.bvh.on(simd);
        let [x, y, z] = &self.questions.targets;
        let Some(targets) = Targets::new(x, y, z) else { return };
        let mut scratch = TileScratch::new();
        for group in self.groups {
            let light = &self.lights[group.light as usize];
            let targets = targets.on_parallelogram(light.corner, light.u, light.v);
            let occluders = match self.occluders.get(group.light as usize) {
                Some(occluders) => occluders,
                None => &Occluders::NONE,
            };
            let (points, counter) = (&group.points[..], &mut *self.counter);
            bvh.occluded_tile_with(occluders, points, &targets, None, counter, &mut scratch, self.blocked);
        }
    }
}
