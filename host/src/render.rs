//! Every pixel, pass by pass.

use crate::film::{Film, TileFilm};
use crate::integrator::{Scratch, Stage, StageTimes, Visibility, render_tile};
use occlude_kernel::Counts;
use rayon::prelude::*;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// When a render ends.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Passes: camera samples a pixel.
    pub passes: u32,
    /// No pass begins after this long, if given; the first one always does.
    pub time: Option<Duration>,
}

/// What a render gives.
#[derive(Debug)]
pub struct Rendered {
    /// The image, with its variance.
    pub film: Film,
    /// Whole passes; a film may hold tiles of one more.
    pub passes: u32,
    /// Whether it was told to stop.
    pub interrupted: bool,
    /// Where the time went, summed over threads.
    pub times: StageTimes,
    /// Work done for camera rays.
    pub camera_counts: Counts,
    /// Work done for shadow rays.
    pub shadow_counts: Counts,
    /// From the first pass to the last, s on the clock.
    pub elapsed: Duration,
}

/// Renders passes until the limits are reached or `stop` is set, which ends after the tiles under way.
///
/// `threads` 0 means one for each core. The result does not depend on it: a pixel's numbers follow from the
/// seed, the pixel and the pass, and every pixel belongs to one tile. `passed` hears of each pass done.
pub fn render(
    stage: &Stage<'_>,
    method: &dyn Visibility,
    size: (u32, u32),
    limits: Limits,
    threads: usize,
    stop: &AtomicBool,
    mut passed: impl FnMut(u32) + Send,
) -> crate::Result<Rendered> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|error| crate::Error::Usage(format!("cannot start {threads} threads: {error}")))?;
    let mut film = Film::new(size.0, size.1);
    let scratches: Vec<Mutex<Scratch>> = (0..pool.current_num_threads()).map(|_| Mutex::default()).collect();
    let start = Instant::now();
    let mut passes = 0;
    let out_of_time = || limits.time.is_some_and(|most| start.elapsed() >= most);
    pool.install(|| {
        let tiles: Vec<_> = film.tiles().iter().map(TileFilm::tile).collect();
        method.begin(stage, &tiles, size.0);
        while passes < limits.passes && !stop.load(Ordering::Relaxed) && !(passes > 0 && out_of_time()) {
            film.tiles_mut().par_iter_mut().for_each(|tile| {
                if stop.load(Ordering::Relaxed) {
                    return;
                }
                // Each thread has its own, so nobody waits; a poisoned one holds no more than scratch.
                let own = &scratches[rayon::current_thread_index().unwrap_or(0)];
                let mut scratch = own.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
                render_tile(stage, method, size.0, passes, tile, &mut scratch);
            });
            if stop.load(Ordering::Relaxed) {
                break;
            }
            passes += 1;
            method.passed(stage);
            passed(passes);
        }
    });
    let elapsed = start.elapsed();
    let mut rendered = Rendered {
        film,
        passes,
        interrupted: stop.load(Ordering::Relaxed) && passes < limits.passes,
        times: StageTimes::default(),
        camera_counts: Counts::default(),
        shadow_counts: Counts::default(),
        elapsed,
    };
    for scratch in scratches {
        let scratch = scratch.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner());
        rendered.times += scratch.times;
        rendered.camera_counts += scratch.camera_counts;
        rendered.shadow_counts += scratch.shadow_counts;
    }
    Ok(rendered)
}
