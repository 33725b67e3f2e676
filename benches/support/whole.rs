//! Whole renders, map included, from the first pass until the picture is as good as asked.

use crate::learning::{Place, squared_difference};
use occlude_host::clock;
use occlude_host::film::Image;
use occlude_host::integrator::{Auto, AutoOptions, Exact, Visibility};
use occlude_host::render::{Limits, render, render_adaptively};
use occlude_kernel::lanes::Level;
use std::sync::atomic::AtomicBool;

/// How a picture is rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Way {
    /// What it is called.
    pub name: &'static str,
    /// By the map that learns, or else by the exact method.
    pub learns: bool,
    /// Whether camera samples go where the picture is not sure yet.
    pub adaptive: bool,
}

/// The first is what the others are held against.
pub const WAYS: [Way; 4] = [
    Way { name: "exact", learns: false, adaptive: false },
    Way { name: "exact, adaptive", learns: false, adaptive: true },
    Way { name: "auto", learns: true, adaptive: false },
    Way { name: "auto, adaptive", learns: true, adaptive: true },
];

/// Renders of one way, each with twice the passes of the one before.
#[derive(Clone, Debug, Default)]
pub struct Ladder {
    /// From few passes to many.
    pub steps: Vec<Step>,
}

/// Renders with so many passes.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// Passes: camera samples a pixel, on average.
    pub passes: u32,
    /// RMSE over the picture's mean.
    pub error: f64,
    /// CPU time from the start, the map included and the scene's tree not, s.
    pub seconds: f64,
}

/// The fewest passes: as many as go everywhere before samples are given where they are needed.
const FEWEST: u32 = 4;

impl Ladder {
    /// Renders until the error is no more than `goal`, or until a render with twice the passes would take more than `most`
    /// seconds.
    ///
    /// The error is that of the whole picture, edges included: two renders that share no random number differ by twice the
    /// mean square error of one, if it is right on average. So no reference is needed, which would have to be far better.
    pub fn climb(place: &Place, level: Level, shadow_rays: u32, way: Way, goal: f64, most: f64) -> Self {
        let mut ladder = Self::default();
        let mut passes = FEWEST;
        loop {
            let [(a, a_time), (b, b_time)] =
                [1, 2].map(|seed| picture(place, level, shadow_rays, way, passes, seed));
            let error = (squared_difference(&a, &b) / 2.0).sqrt() / (0.5 * (mean(&a) + mean(&b)));
            let seconds = 0.5 * (a_time + b_time);
            ladder.steps.push(Step { passes, error, seconds });
            // Not a number if the picture is black.
            if error <= goal || error.is_nan() || 2.0 * seconds > most {
                return ladder;
            }
            passes *= 2;
        }
    }

    /// The least error.
    pub fn least(&self) -> f64 {
        self.steps.iter().map(|step| step.error).fold(f64::INFINITY, f64::min)
    }

    /// Time until the error is `goal`: between steps along a power of the error; that of the first step if it is good
    /// enough. NaN if none is.
    pub fn until(&self, goal: f64) -> f64 {
        let Some(end) = self.steps.iter().position(|step| step.error <= goal) else { return f64::NAN };
        let (Some(before), after) = (end.checked_sub(1).map(|at| self.steps[at]), self.steps[end]) else {
            return self.steps[end].seconds;
        };
        let along = (before.error / goal).ln() / (before.error / after.error).ln();
        before.seconds * (after.seconds / before.seconds).powf(along)
    }
}

fn mean(image: &Image) -> f64 {
    let sum: f64 = image.pixels.iter().flatten().map(|&value| f64::from(value)).sum();
    sum / (3 * image.pixels.len().max(1)) as f64
}

/// The picture and the time it took.
fn picture(place: &Place, level: Level, shadow_rays: u32, way: Way, passes: u32, seed: u64) -> (Image, f64) {
    let stage = place.stage(level, shadow_rays, seed);
    let (limits, stop) = (Limits { passes, time: None }, AtomicBool::new(false));
    let start = clock::of_process();
    let auto = Auto::new(AutoOptions::default());
    let method: &dyn Visibility = if way.learns { &auto } else { &Exact };
    let render = if way.adaptive { render_adaptively } else { render };
    let rendered = render(&stage, method, place.size, limits, 1, &stop, |_| ()).expect("a thread");
    let image = rendered.film.develop();
    (image, (clock::of_process() - start).as_secs_f64())
}
