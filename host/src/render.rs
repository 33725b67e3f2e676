//! Every pixel, pass by pass.

use crate::film::{Film, Tile, TileFilm};
use crate::integrator::{CameraSample, Scratch, Stage, StageTimes, Visibility, render_samples, render_tile};
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
    passed: impl FnMut(u32) + Send,
) -> crate::Result<Rendered> {
    run(stage, method, size, limits, threads, stop, false, passed)
}

/// The same with as many camera samples in all, but more of them where the picture is not sure yet.
///
/// In rounds: after a few passes over everything, each round has as many samples a pixel, on average, as all before it,
/// and a pixel gets them in proportion to the standard deviation that was seen in it and around it; at least one, and at
/// most 16 times the average. Right on average: how many samples a pixel gets follows from earlier rounds only, and a
/// round counts by its number of passes, whatever was seen in it.
pub fn render_adaptively(
    stage: &Stage<'_>,
    method: &dyn Visibility,
    size: (u32, u32),
    limits: Limits,
    threads: usize,
    stop: &AtomicBool,
    passed: impl FnMut(u32) + Send,
) -> crate::Result<Rendered> {
    run(stage, method, size, limits, threads, stop, true, passed)
}

/// Passes over everything before samples are given where they are needed.
const FIRST: u32 = 4;

/// Times the average that a pixel can get at most.
const MOST: f32 = 16.0;

/// How many samples the pixels of each tile get in a round of so many passes.
fn shares(film: &Film, passes: u32) -> Vec<Vec<u32>> {
    let variance = film.variance_of_sample();
    let (width, height) = (film.width() as usize, film.height() as usize);
    let at = |x: usize, y: usize| variance.pixels[y * width + x].iter().sum::<f32>();
    let deviation: Vec<f32> = (0..height)
        .into_par_iter()
        .flat_map_iter(|y| {
            (0..width).map(move |x| {
                let rows = y.saturating_sub(1)..(y + 2).min(height);
                let columns = x.saturating_sub(1)..(x + 2).min(width);
                let around: f32 = rows
                    .clone()
                    .flat_map(|y| columns.clone().map(move |x| (x, y)))
                    .map(|(x, y)| at(x, y))
                    .sum();
                (around / (rows.len() * columns.len()) as f32).sqrt()
            })
        })
        .collect();
    let mean = deviation.iter().map(|&d| f64::from(d)).sum::<f64>() / deviation.len().max(1) as f64;
    let scale = if mean > 0.0 { f64::from(passes) / mean } else { 0.0 };
    let share = |x: u32, y: u32| {
        let due = f64::from(deviation[y as usize * width + x as usize]) * scale;
        // A tenth is for all alike, so that nothing is forgotten.
        let due = 0.9 * due as f32 + 0.1 * passes as f32;
        (due.round() as u32).clamp(1, (MOST * passes as f32) as u32)
    };
    let of_tile =
        |tile: Tile| (0..tile.len()).map(|pixel| tile.position(pixel)).map(|(x, y)| share(x, y)).collect();
    film.tiles().iter().map(|tile| of_tile(tile.tile())).collect()
}

#[allow(clippy::too_many_arguments)]
fn run(
    stage: &Stage<'_>,
    method: &dyn Visibility,
    size: (u32, u32),
    limits: Limits,
    threads: usize,
    stop: &AtomicBool,
    adaptive: bool,
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
        // Of the round at hand: its film, the samples of its pixels, its first pass and how many it has.
        let mut round: Option<(Film, Vec<Vec<u32>>, u32, u32)> = None;
        let mut had: Vec<Vec<u32>> = tiles.iter().map(|tile| vec![0; tile.len()]).collect();
        while passes < limits.passes && !stop.load(Ordering::Relaxed) && !(passes > 0 && out_of_time()) {
            if adaptive && passes >= FIRST && round.is_none() {
                let count = passes.min(limits.passes - passes);
                if passes == FIRST {
                    had.iter_mut().flatten().for_each(|had| *had = FIRST);
                }
                round = Some((Film::new(size.0, size.1), shares(&film, count), passes, count));
            }
            let (target, plan) = match &mut round {
                Some((film, shares, first, count)) => (film, Some((&*shares, passes - *first, *count))),
                None => (&mut film, None),
            };
            let had_before = &had;
            target.tiles_mut().par_iter_mut().enumerate().for_each(|(index, tile)| {
                if stop.load(Ordering::Relaxed) {
                    return;
                }
                // Each thread has its own, so nobody waits; a poisoned one holds no more than scratch.
                let own = &scratches[rayon::current_thread_index().unwrap_or(0)];
                let mut scratch = own.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
                let Some((shares, pass, count)) = plan else {
                    render_tile(stage, method, size.0, passes, tile, &mut scratch);
                    return;
                };
                // Every pixel has its first sample in the first pass of the round.
                let until = |share: u32, pass: u32| {
                    (u64::from(share) * u64::from(pass)).div_ceil(u64::from(count)) as u32
                };
                let samples = (0u32..).zip(&shares[index]).flat_map(|(pixel, &share)| {
                    let before = had_before[index][pixel as usize];
                    let range = before + until(share, pass)..before + until(share, pass + 1);
                    range.map(move |index| CameraSample { pixel, index })
                });
                render_samples(stage, method, size.0, samples, tile, &mut scratch);
            });
            if stop.load(Ordering::Relaxed) {
                break;
            }
            passes += 1;
            if let Some((of_round, shares, first, count)) = round.take_if(|round| passes == round.2 + round.3)
            {
                film.merge(f64::from(first), &of_round, f64::from(count));
                for (had, share) in had.iter_mut().flatten().zip(shares.iter().flatten()) {
                    *had += share;
                }
            }
            method.passed(stage);
            passed(passes);
        }
        // Of a round that was broken off, whole passes count, and so do tiles of one more.
        if let Some((of_round, _, first, _)) = round {
            film.merge(f64::from(first), &of_round, f64::from((passes - first).max(1)));
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
