//! Samples of a random number: mean and variance, and how sure they are.

use crate::reproduce::{Halted, Run};
use crate::sampler::Sampler;
use rayon::prelude::*;

/// Mean and variance of samples.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Sampled {
    pub(super) count: u64,
    pub(super) mean: f64,
    pub(super) variance: f64,
    /// Standard error of the variance, `sqrt((m4 - m2²) / n)`, from the fourth moment of the samples themselves.
    pub(super) variance_error: f64,
    /// Mean of what was counted beside each sample.
    pub(super) asked: f64,
}

/// Half-width of a 95 % interval, in standard errors.
pub(super) const Z95: f64 = 1.959_964;

impl Sampled {
    /// Standard error of the mean.
    pub(super) fn mean_error(&self) -> f64 {
        (self.variance / self.count as f64).sqrt()
    }

    /// How many of its standard errors the variance is off a closed form; 0 where there is no spread on either side.
    pub(super) fn off(&self, closed: f64) -> f64 {
        let off = (self.variance - closed).abs();
        // Single precision rounds estimates by 6e-8 of their size.
        let error = self.variance_error + 1e-6 * closed;
        if off == 0.0 { 0.0 } else { off / error }
    }
}

/// Samples drawn one after the other by one generator.
const CHUNK: u64 = 1 << 14;

/// Draws samples. `about` is a number near their mean; `draw` returns a sample and what it counted.
///
/// The same bits for any number of threads: each chunk has its own generator, and sums are merged in order.
pub(super) fn sample(
    run: &Run<'_>,
    stream: u64,
    count: u64,
    about: f64,
    draw: impl Fn(&mut Sampler) -> (f64, u32) + Sync,
) -> Result<Sampled, Halted> {
    let chunks = count.div_ceil(CHUNK);
    let sums: Vec<Option<[f64; 5]>> = (0..chunks)
        .into_par_iter()
        .map(|chunk| {
            run.go_on().ok()?;
            let mut random = Sampler::new(run.seed ^ stream.wrapping_mul(0x9e37_79b9_7f4a_7c15), chunk, 0);
            let mut sums = [0.0; 5];
            for _ in 0..CHUNK.min(count - chunk * CHUNK) {
                let (value, asked) = draw(&mut random);
                let off = value - about;
                let square = off * off;
                for (sum, term) in
                    sums.iter_mut().zip([off, square, square * off, square * square, f64::from(asked)])
                {
                    *sum += term;
                }
            }
            Some(sums)
        })
        .collect();
    let mut total = [0.0; 5];
    for sums in sums {
        let sums = sums.ok_or(Halted::Interrupted)?;
        total.iter_mut().zip(sums).for_each(|(total, sum)| *total += sum);
    }
    let [m1, m2, m3, m4, asked] = total.map(|sum| sum / count.max(1) as f64);
    let variance = (m2 - m1 * m1).max(0.0);
    let fourth = m4 - 4.0 * m1 * m3 + 6.0 * m1 * m1 * m2 - 3.0 * m1.powi(4);
    Ok(Sampled {
        count,
        mean: about + m1,
        variance: variance * count as f64 / (count.max(2) - 1) as f64,
        variance_error: ((fourth - variance * variance).max(0.0) / count.max(1) as f64).sqrt(),
        asked,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reproduce::theory::tests::run;
    use std::sync::atomic::AtomicBool;

    #[test]
    fn moments_of_uniform_numbers() {
        let stop = AtomicBool::new(false);
        let draw = |random: &mut Sampler| (f64::from(random.uniform()), 3);
        let seen = sample(&run(&stop), 7, 1_000_000, 0.4, draw).expect("nobody stops it");
        // Fourth moment 1/80, variance 1/12.
        let error = ((1.0 / 80.0 - 1.0 / 144.0) / 1e6f64).sqrt();
        assert!((seen.variance_error / error - 1.0).abs() < 0.01, "{seen:?}");
        assert!(seen.off(1.0 / 12.0) < 5.0 && (seen.mean - 0.5).abs() < 5.0 * seen.mean_error(), "{seen:?}");
        assert_eq!((seen.asked, seen.count), (3.0, 1_000_000));
        assert!(seen.off(0.09) > 50.0);
    }

    #[test]
    fn a_constant_has_no_spread() {
        let stop = AtomicBool::new(false);
        let seen = sample(&run(&stop), 7, 20_000, 2.0, |_| (2.0, 0)).expect("nobody stops it");
        assert_eq!((seen.mean, seen.variance, seen.variance_error, seen.off(0.0)), (2.0, 0.0, 0.0, 0.0));
    }
}
