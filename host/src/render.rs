//! Every pixel, pass by pass.

use crate::adaptive::{Due, FEWEST, FIRST, FIRST_WEIGHT, Needs, first_rays};
use crate::film::{Film, TileFilm};
use crate::integrator::{CameraSample, Scratch, Stage, StageTimes, Visibility, render_samples};
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

/// The same for about the same work, but with camera samples where the picture is not sure yet, and with no more shadow
/// rays for each than help there.
///
/// In rounds: after four passes over everything, with a quarter of the shadow rays or four, rounds end at a quarter of the
/// passes, at a quarter of these and so on, so that each costs about three times what all before it did, but the first one
/// to seven times. What a round gives a pixel follows from the variance that was seen in it and around it, and from what
/// part of that shadow rays made: at least one sample and at most 256 times its passes (16 384 over the usual rays, from 16
/// on, if that is less), of the usual number of shadow rays or of that halved some times. With fewer than eight passes it
/// is [`render`].
///
/// Right on average: what a pixel gets follows from earlier rounds only, with which a round shares no random number, and a
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

/// How many passes the round after so many has, of so many in all.
///
/// Samples of one round are spread over the pixel, those of two know nothing of each other: few rounds, the last of them
/// large, leave about 0.8 of the squared error of rounds that double (ten scenes, 16 to 64 passes).
fn round_after(passes: u32, all: u32) -> u32 {
    let mut end = all;
    while end / 4 >= (2 * FIRST).max(passes + 1) {
        end /= 4;
    }
    end - passes
}

/// What a round of so many passes counts: one over the variance that so many well spread samples have, about.
fn weight_of_round(passes: u32) -> f64 {
    f64::from(passes).powf(1.5)
}

/// A round under way.
struct Round {
    film: Film,
    /// What the pixels of each tile get.
    due: Vec<Vec<Due>>,
    /// Its first pass.
    first: u32,
    /// And how many it has.
    passes: u32,
}

/// Refuses an image that there is no memory for: film, what is known of its pixels, the image, its variance and both as they
/// are put into a file. To run out of it later would end the program.
fn check_memory((width, height): (u32, u32), adaptive: bool) -> crate::Result<()> {
    let [film, listening] = Film::BYTES_A_PIXEL;
    let image = size_of::<[f32; 3]>();
    let films = if adaptive { 2 * (film + listening) + Needs::BYTES_A_PIXEL } else { film };
    check_room((width, height), films + 6 * image)
}

/// What the system could still give, bytes, where it says so.
fn available_memory() -> Option<u64> {
    let said = std::fs::read_to_string("/proc/meminfo").ok()?;
    let kilobytes = |key: &str| {
        let line = said.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
        line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()
    };
    Some((kilobytes("MemAvailable")? + kilobytes("SwapFree").unwrap_or(0)).saturating_mul(1024))
}

/// Refuses an image of so many bytes a pixel that there is no memory for.
pub(crate) fn check_room((width, height): (u32, u32), bytes_a_pixel: usize) -> crate::Result<()> {
    let bytes = u64::from(width) * u64::from(height) * bytes_a_pixel as u64;
    let mut room = Vec::<u8>::new();
    let got = usize::try_from(bytes).is_ok_and(|bytes| room.try_reserve_exact(bytes).is_ok());
    // Or the compiler would take it for had.
    std::hint::black_box(&mut room);
    // Some systems promise more than they have.
    if got && available_memory().is_none_or(|available| bytes <= available) {
        return Ok(());
    }
    Err(crate::Error::Usage(format!(
        "an image of {width}x{height} pixels takes about {:.1} GB of memory, and there is not so much: make it smaller, with --size",
        bytes as f64 * 1e-9
    )))
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
    let adaptive = adaptive && limits.passes >= FEWEST;
    check_memory(size, adaptive)?;
    let new_film = || {
        let film = Film::new(size.0, size.1);
        if adaptive { film.listening() } else { film }
    };
    let mut film = new_film();
    let scratches: Vec<Mutex<Scratch>> = (0..pool.current_num_threads()).map(|_| Mutex::default()).collect();
    let start = Instant::now();
    let mut passes = 0;
    let out_of_time = || limits.time.is_some_and(|most| start.elapsed() >= most);
    let even_rays = adaptive.then(|| first_rays(stage.shadow_rays));
    pool.install(|| {
        let tiles: Vec<_> = film.tiles().iter().map(TileFilm::tile).collect();
        method.begin(stage, &tiles, size.0);
        let mut needs = if adaptive { Needs::new(size.0, size.1) } else { Needs::new(0, 0) };
        // What the film counts.
        let mut weight = 0.0;
        let mut round: Option<Round> = None;
        let mut rounds = 0;
        while passes < limits.passes && !stop.load(Ordering::Relaxed) && !(passes > 0 && out_of_time()) {
            if adaptive && passes >= FIRST && round.is_none() {
                if passes == FIRST {
                    needs.learn(&film, |_, _| first_rays(stage.shadow_rays));
                    weight = FIRST_WEIGHT * f64::from(FIRST);
                }
                let count = round_after(passes, limits.passes);
                let last = passes + count == limits.passes;
                let due = needs.share(&tiles, count, stage.shadow_rays, last);
                rounds += 1;
                round = Some(Round { film: new_film(), due, first: passes, passes: count });
            }
            let (target, plan) = match &mut round {
                Some(Round { film, due, first, passes: count }) => {
                    (film, Some((&*due, passes - *first, *count)))
                }
                None => (&mut film, None),
            };
            target.tiles_mut().par_iter_mut().enumerate().for_each(|(index, tile)| {
                if stop.load(Ordering::Relaxed) {
                    return;
                }
                // Each thread has its own, so nobody waits; a poisoned one holds no more than scratch.
                let own = &scratches[rayon::current_thread_index().unwrap_or(0)];
                let mut scratch = own.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
                let Some((due, pass, count)) = plan else {
                    let pixels = 0..tile.tile().len() as u32;
                    let samples = pixels
                        .map(|pixel| CameraSample { rays: even_rays, ..CameraSample::even(pixel, passes) });
                    render_samples(stage, method, size.0, samples, tile, &mut scratch);
                    return;
                };
                // Every pixel has its first sample in the first pass of the round.
                let until = |samples: u32, pass: u32| {
                    (u64::from(samples) * u64::from(pass)).div_ceil(u64::from(count)) as u32
                };
                let samples = (0u32..).zip(&due[index]).flat_map(|(pixel, &Due { samples, rays })| {
                    let range = until(samples, pass)..until(samples, pass + 1);
                    range.map(move |index| CameraSample { pixel, round: rounds, index, rays: Some(rays) })
                });
                render_samples(stage, method, size.0, samples, tile, &mut scratch);
            });
            if stop.load(Ordering::Relaxed) {
                break;
            }
            passes += 1;
            if let Some(done) = round.take_if(|round| passes == round.first + round.passes) {
                let its = weight_of_round(done.passes);
                film.merge(weight, &done.film, its);
                weight += its;
                needs.learn(&done.film, |tile, pixel| done.due[tile][pixel].rays);
            }
            method.passed(stage);
            passed(passes);
        }
        // Of a round that was broken off, whole passes count, and so do tiles of one more.
        if let Some(broken) = round {
            let done = (passes - broken.first).max(1);
            let its = weight_of_round(done);
            // One that has hardly begun is no better than the first passes.
            let weight = if broken.first == FIRST && done < FIRST { its } else { weight };
            film.merge(weight, &broken.film, its);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_beyond_all_memory_is_refused() {
        for adaptive in [false, true] {
            check_memory((640, 360), adaptive).unwrap();
            let said = check_memory((u32::MAX, u32::MAX), adaptive).unwrap_err().to_string();
            assert!(said.contains("4294967295x4294967295") && said.contains("--size"), "{said}");
        }
    }

    #[test]
    fn rounds_end_where_the_passes_do_and_the_last_is_the_largest() {
        for (all, ends) in [
            (8, &[8][..]),
            (16, &[16]),
            (31, &[31]),
            (32, &[8, 32]),
            (100, &[25, 100]),
            (256, &[16, 64, 256]),
            (u32::MAX, &[15, 63, 255, 1023]),
        ] {
            let mut passes = FIRST;
            for &end in ends {
                passes += round_after(passes, all);
                assert_eq!(passes, end, "of {all}");
            }
        }
    }
}
