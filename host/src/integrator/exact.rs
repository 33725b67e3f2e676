//! Every shadow ray traced: the answers are right, one by one.

use super::{Questions, Stage, Visibility};
use crate::light::AreaLight;
use occlude_kernel::lanes::{Task, dispatch};
use occlude_kernel::{BatchScratch, Bvh, Counter, Counts, Simd, Targets, Uncounted};

/// Traces every shadow ray through the scene's tree, a batch at a time.
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
        estimates.clear();
        let bvh = stage.bvh;
        if stage.count {
            dispatch(stage.level, Trace { bvh, lights: stage.lights, questions, estimates, counter: counts });
        } else {
            dispatch(
                stage.level,
                Trace { bvh, lights: stage.lights, questions, estimates, counter: &mut Uncounted },
            );
        }
    }
}

/// All batches of a tile.
struct Trace<'a, C> {
    bvh: Bvh<'a>,
    lights: &'a [AreaLight],
    questions: &'a Questions,
    estimates: &'a mut Vec<f32>,
    counter: &'a mut C,
}

impl<C: Counter> Task for Trace<'_, C> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let bvh = self.bvh.on(simd);
        let [x, y, z] = &self.questions.targets;
        let mut blocked = [0u64; MOST / 64];
        let mut scratch = BatchScratch::new();
        for batch in &self.questions.batches {
            let point = &self.questions.points[batch.point as usize];
            let samples = batch.samples.start as usize..batch.samples.end as usize;
            for from in samples.clone().step_by(MOST) {
                let part = from..samples.end.min(from + MOST);
                let count = part.len();
                if let Some(targets) = Targets::new(&x[part.clone()], &y[part.clone()], &z[part]) {
                    let light = &self.lights[batch.light as usize];
                    let targets = targets.on_parallelogram(light.corner, light.u, light.v);
                    let scratch = &mut scratch;
                    bvh.occluded_batch(point.origin, &targets, None, self.counter, scratch, &mut blocked);
                    let free = |i: usize| blocked[i / 64] >> (i % 64) & 1 == 0;
                    self.estimates.extend((0..count).map(|i| if free(i) { 1.0 } else { 0.0 }));
                }
            }
        }
    }
}

/// Samples asked about at once.
const MOST: usize = 256;
