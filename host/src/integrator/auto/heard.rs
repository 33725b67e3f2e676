//! What the rays of a tile saw: counted for their cells, remembered for their pixels, and what that says of the gain.

use super::kinds;
use super::{Map, NOBODY, TilePast, past_of};
use crate::integrator::{Batch, Questions, Stage, sums};
use occlude_kernel::Simd;
use occlude_kernel::lanes::Task;
use occlude_kernel::occlusion_map::{BINS, Doubts, Tally};
use std::sync::MutexGuard;
use std::sync::atomic::Ordering;

/// Variances of visibility as samples left them, and as the usual ones would have, weighed by squared light.
///
/// Well spread samples leave `v (1 - v) n^-1.5` where borders are long against their distance, and `n^-1` where fine things
/// are in the way; which of both, a quarter of a light tells: it has half of the variance of the whole, or all of it.
///
/// A tile sums numbers, and tiles are summed in whole parts of [`FINE`], so that their order does not matter.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Gain<T = u64> {
    /// With the powers -1 and -1.5.
    before: [T; 2],
    left: [T; 2],
    /// Variances of a sample within quarters of a light, and in all of it.
    quarters: T,
    whole: T,
}

/// Variances are counted in these parts.
const FINE: f64 = 4_294_967_296.0;

/// Samples of a light before its quarters tell anything.
const QUARTERED: f32 = 8.0;

impl Gain<f64> {
    /// Adds a batch of n samples, and `usual` otherwise, that saw `v` of squared light `light`; `forms` are what the form of
    /// the light adds to the variance, and what is left of that.
    #[inline(always)]
    fn add(&mut self, light: f32, v: f32, [n, usual]: [f32; 2], forms: [f32; 2]) -> f32 {
        let one = v * (1.0 - v) * (n / (n - 1.0));
        for (k, [n, usual]) in [[n, usual], [n * n.sqrt(), usual * usual.sqrt()]].into_iter().enumerate() {
            self.before[k] += f64::from(light * (one / usual + forms[0]));
            self.left[k] += f64::from(light * (one / n + forms[1]));
        }
        light * one
    }

    /// Adds what its quarters saw, where all of it has the variance `whole`.
    #[inline(always)]
    fn add_quarters(&mut self, light: f32, whole: f32, bins: &[u8], estimates: &[f32]) {
        let (mut asked, mut free) = ([0.0f32; 4], [0.0f32; 4]);
        // Eight bits for each quarter, so that vectors hold as many samples as of numbers.
        const MOST: usize = u8::MAX as usize;
        for (bins, estimates) in bins.chunks(MOST).zip(estimates.chunks(MOST)) {
            let mut words = [0u32; 2];
            for (&bin, &estimate) in bins.iter().zip(estimates) {
                let bin = u32::from(bin);
                let quarter = 1u32 << (bin >> 1 & 16 | bin << 1 & 8);
                words[0] += quarter;
                words[1] += if estimate > 0.0 { quarter } else { 0 };
            }
            for (sums, word) in [&mut asked, &mut free].into_iter().zip(words) {
                for (k, sum) in sums.iter_mut().enumerate() {
                    *sum += (word >> (8 * k) & 0xff) as f32;
                }
            }
        }
        let (mut sum, mut samples) = (0.0, 0.0);
        for (n, free) in asked.into_iter().zip(free).filter(|(n, _)| *n > 1.0) {
            sum += n * (free / n) * (1.0 - free / n) * (n / (n - 1.0));
            samples += n;
        }
        if samples > 0.0 {
            self.quarters += f64::from(light * (sum / samples));
            self.whole += f64::from(whole);
        }
    }

    pub(super) fn counted(&self) -> Gain {
        let count = |sum: f64| (sum * FINE) as u64;
        Gain {
            before: self.before.map(count),
            left: self.left.map(count),
            quarters: count(self.quarters),
            whole: count(self.whole),
        }
    }
}

impl Gain {
    pub(super) fn merge(&mut self, other: &Self) {
        let add = |sum: &mut u64, more: u64| *sum = sum.saturating_add(more);
        for k in 0..2 {
            add(&mut self.before[k], other.before[k]);
            add(&mut self.left[k], other.left[k]);
        }
        add(&mut self.quarters, other.quarters);
        add(&mut self.whole, other.whole);
    }

    /// How many times less variance there is than the usual samples would leave; none if that cannot be told.
    pub(super) fn value(&self) -> Option<f64> {
        if self.left.contains(&0) {
            return None;
        }
        let each = |k: usize| (self.before[k] as f64 / self.left[k] as f64).ln();
        let spread = if self.quarters > 0 {
            (self.whole as f64 / self.quarters as f64).log2().clamp(0.0, 1.0)
        } else {
            0.0
        };
        Some((each(0) + spread * (each(1) - each(0))).exp())
    }
}

/// A ray as a word of a bin: asked in the upper half, free in the lower.
#[inline(always)]
pub(super) fn tallied(free: bool) -> u64 {
    1 << 32 | u64::from(free)
}

/// What such words add up to.
#[inline(always)]
pub(super) fn tally(word: u64) -> Tally {
    Tally { asked: (word >> 32) as u32, free: word as u32 }
}

/// What points next to each other saw of a cell: to be noted once for all, since others may be noting too.
struct Run {
    cell: u32,
    /// A bit for each bin in which there is something.
    seen: u64,
    words: [u64; BINS],
}

/// Runs at a time: a tile sees some cells of some lights.
const RUNS: usize = 16;

impl Run {
    const NONE: Self = Self { cell: NOBODY, seen: 0, words: [0; BINS] };

    #[inline(always)]
    fn count(&mut self, bins: &[u8], estimates: &[f32]) {
        for (&bin, &estimate) in bins.iter().zip(estimates) {
            let bin = usize::from(bin) % BINS;
            self.seen |= 1 << bin;
            self.words[bin] += tallied(estimate > 0.0);
        }
    }
}

impl Map {
    /// Tells cells what batches saw, each of the cell beside it, and says how far their odds were off.
    #[inline(always)]
    fn tell(&self, batches: &[Batch], cells: &[u32], bins: &[u8], estimates: &[f32]) -> Doubts {
        let mut doubts = Doubts::default();
        let mut runs = [const { Run::NONE }; RUNS];
        for (batch, &index) in batches.iter().zip(cells) {
            if index as usize >= self.cells.len() {
                continue;
            }
            let run = &mut runs[index as usize % RUNS];
            if run.cell != index {
                self.note(run, &mut doubts);
                run.cell = index;
            }
            let samples = batch.samples.start as usize..batch.samples.end as usize;
            run.count(&bins[samples.clone()], &estimates[samples]);
        }
        runs.iter_mut().for_each(|run| self.note(run, &mut doubts));
        doubts
    }

    /// Notes what a run saw, and how far the odds of its cell were off; and ends it.
    fn note(&self, run: &mut Run, doubts: &mut Doubts) {
        let Some(cell) = self.cells.get(run.cell as usize) else { return };
        let tallies = &self.tallies[run.cell as usize * BINS..][..BINS];
        while run.seen != 0 {
            let bin = run.seen.trailing_zeros() as usize;
            run.seen &= run.seen - 1;
            let word = std::mem::take(&mut run.words[bin]);
            tallies[bin].fetch_add(word, Ordering::Relaxed);
            if cell.is_known() {
                doubts.add(cell.odds(bin), tally(word));
            }
        }
        run.cell = NOBODY;
    }
}

/// What a tile has heard, to be merged with others: whole numbers.
#[derive(Default)]
pub(super) struct Heard {
    pub(super) doubts: Doubts,
    pub(super) kinds: kinds::Seen,
    pub(super) gain: Gain,
}

/// Tells cells and pixels what rays saw. Of what pixels know better than their samples, these get some more or less.
pub(super) struct Hear<'a, 'b> {
    pub(super) map: &'a Map,
    pub(super) stage: &'a Stage<'a>,
    pub(super) questions: &'a Questions,
    pub(super) estimates: &'a mut [f32],
    pub(super) pasts: &'a mut Option<MutexGuard<'b, TilePast>>,
}

impl Task for Hear<'_, '_> {
    type Output = Heard;

    #[inline(always)]
    fn run<S: Simd>(self, _simd: S) -> Heard {
        let Self { map, stage, questions, estimates, pasts } = self;
        let doubts = map.tell(&questions.batches, &questions.cells, &questions.bins, estimates);
        let mut gain = Gain::<f64>::default();
        let mut seen = kinds::Seen::default();
        let told = questions.wholes.iter().zip(&questions.usual).zip(&questions.before).zip(&questions.kinds);
        for (batch, (((&whole, &usual), &before), &kind)) in questions.batches.iter().zip(told) {
            let point = &questions.points[batch.point as usize];
            if whole.is_nan() {
                continue;
            }
            let Some(past) = past_of(pasts, point.pixel, batch.light, map.remembered) else { continue };
            let samples = batch.samples.start as usize..batch.samples.end as usize;
            let count = samples.len() as f32;
            let estimates = &mut estimates[samples.clone()];
            let [all, free] = sums(&questions.weights[samples], estimates, |w, v| [w, w * v]);
            let off = if whole.is_finite() { whole - all } else { 0.0 };
            let v = (free / all).min(1.0);
            let bins = &questions.bins[batch.samples.start as usize..batch.samples.end as usize];
            past.mark(v, bins, estimates);
            past.vary(v, count);
            seen.add(kind, v, count);
            // Where rays are the points' own, the map does not give up in any case.
            if count > 1.0 && !point.firm {
                let radiance = stage.lights[batch.light as usize].radiance * (all / map.brightest);
                let light = (point.diffuse * radiance).length_squared();
                let form = |v: f32| (v * off / all).powi(2);
                let whole = gain.add(light, v, [count, usual], [form(v), form(v - past.mean())]);
                if whole > 0.0 && count >= QUARTERED && (batch.point + map.passes).is_multiple_of(4) {
                    gain.add_quarters(light, whole, bins, estimates);
                }
            }
            let more = past.asked(v, off, before) / all;
            if more != 0.0 {
                estimates.iter_mut().for_each(|estimate| *estimate += more);
            }
        }
        Heard { doubts, kinds: seen, gain: gain.counted() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampler::Sampler;
    use occlude_kernel::occlusion_map::{CellKey, MapCell, Rates};
    use std::sync::atomic::AtomicU64;

    #[test]
    fn cells_are_told_of_every_ray_once() {
        let mut random = Sampler::from_key(7);
        let mut below = |n: usize| (random.uniform() * n as f32) as usize;
        let cell = |k: usize| {
            let key = CellKey::new([k as f32, 0.0, 0.0], [0.0, 1.0, 0.0], 0, 0).expect("near");
            let mut cell = MapCell::new(key, [0.0, 1.0, 0.0]);
            // One in three knows nothing yet.
            let odds = std::array::from_fn(|bin| bin as f32 / BINS as f32);
            cell.learn((!k.is_multiple_of(3)).then_some(&odds), &Rates::each(1.0));
            cell
        };
        // Some share a place among the runs, and the last ones of what is named are not there.
        let map = Map {
            cells: (0..3 * RUNS + 5).map(cell).collect(),
            tallies: (0..(3 * RUNS + 5) * BINS).map(|_| AtomicU64::new(tallied(true))).collect(),
            ..Map::default()
        };
        let (mut batches, mut cells, mut bins, mut estimates) = (vec![], vec![], vec![], vec![]);
        for point in 0..500 {
            let first = bins.len() as u32;
            bins.extend((0..below(80)).map(|_| below(BINS) as u8));
            estimates.extend((first..bins.len() as u32).map(|_| below(2) as f32));
            let samples = first..bins.len() as u32;
            batches.push(Batch { point, light: point % 3, samples, share: 1.0 });
            let last = cells.last().copied().unwrap_or(NOBODY);
            cells.push([last, NOBODY, below(3 * RUNS + 8) as u32][below(3)]);
        }
        let doubts = map.tell(&batches, &cells, &bins, &estimates);
        let mut expected: Vec<u64> = vec![tallied(true); map.tallies.len()];
        let mut off = Doubts::default();
        for (batch, &cell) in
            batches.iter().zip(&cells).filter(|(_, cell)| (**cell as usize) < map.cells.len())
        {
            for k in batch.samples.start as usize..batch.samples.end as usize {
                let (bin, free) = (usize::from(bins[k]), estimates[k] > 0.0);
                expected[cell as usize * BINS + bin] += tallied(free);
                let cell = &map.cells[cell as usize];
                if cell.is_known() {
                    off.add(cell.odds(bin), tally(tallied(free)));
                }
            }
        }
        let told: Vec<u64> = map.tallies.iter().map(|word| word.load(Ordering::Relaxed)).collect();
        assert_eq!(told, expected);
        assert_eq!(doubts, off);
        assert!(doubts.asked.iter().sum::<u64>() > 1000);
    }

    #[test]
    fn quarters_tell_fine_things_from_long_borders() {
        let bins: Vec<u8> = (0..64).collect();
        let gain = |free: fn(u8) -> bool| {
            let estimates: Vec<f32> = bins.iter().map(|&bin| f32::from(u8::from(free(bin)))).collect();
            let v = estimates.iter().sum::<f32>() / 64.0;
            let mut sums = Gain::<f64>::default();
            let whole = sums.add(1.0, v, [64.0, 16.0], [0.0; 2]);
            sums.add_quarters(1.0, whole, &bins, &estimates);
            (sums.counted().value().expect("both"), sums.quarters / sums.whole)
        };
        // A border down the middle of the left half, and a chessboard.
        let (border, half) = gain(|bin| bin % 8 < 2);
        assert!((half - 0.7).abs() < 0.01 && border > 5.0 && border < 8.0, "{border} {half}");
        let (fine, all) = gain(|bin| (bin ^ bin >> 3) & 1 == 0);
        assert!((all - 1.05).abs() < 0.03 && (fine - 4.0).abs() < 1e-3, "{fine} {all}");
        // More samples than are counted at a time: the same border, but for n / (n - 1).
        let (bins, estimates) = (bins.repeat(20), bins.repeat(20));
        let estimates: Vec<f32> = estimates.iter().map(|bin| f32::from(u8::from(bin % 8 < 2))).collect();
        let mut sums = Gain::<f64>::default();
        let whole = sums.add(1.0, 0.25, [1280.0, 320.0], [0.0; 2]);
        sums.add_quarters(1.0, whole, &bins, &estimates);
        let half = sums.quarters / sums.whole;
        assert!((half - 2.0 / 3.0 * (320.0 / 319.0) / (1280.0 / 1279.0)).abs() < 1e-5, "{half}");
        // What the light's form adds counts with either power, and nothing seen is nothing told.
        let mut sums = Gain::<f64>::default();
        sums.add(2.0, 0.0, [8.0, 8.0], [0.5, 0.25]);
        assert_eq!(sums.counted().value(), Some(2.0));
        assert_eq!(Gain::<u64>::default().value(), None);
    }
}
