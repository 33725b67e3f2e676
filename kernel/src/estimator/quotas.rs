//! Stratified choices: of M samples exactly the right share takes each term.

/// Random numbers for M samples that fall into every interval as often as they should.
///
/// ```text
///     u_k = (k' / M + u) mod 1,    k' = a permutation of k
/// ```
///
/// Each `u_k` alone is uniform in [0, 1), so every estimate that uses it keeps its mean, exactly; together they
/// are M points at equal distances, of which an interval of length p holds floor(p M) or ceil(p M), p M on average.
/// That is systematic sampling with a single random offset. The permutation keeps the choice from running along
/// with the order of the samples, which for points on a light is an order in space.
///
/// Variance a sample: `sum Var(s_i) / p_i`, see
/// [`Decomposition::quota_variance`](crate::Decomposition::quota_variance). It serves [`OneTerm`](super::OneTerm)
/// and the coin of its `Residual`, and [`Levels`](super::Levels).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quotas {
    samples: u32,
    offset: u32,
    mask: u32,
    seed: u32,
}

impl Quotas {
    /// For so many samples; `u` is uniform in [0, 1), and `seed` any number, that of the permutation.
    #[inline]
    pub fn new(samples: u32, u: f32, seed: u32) -> Self {
        let samples = samples.max(1);
        let mask = u32::MAX.checked_shr((samples - 1).leading_zeros()).unwrap_or(0);
        Self { samples, offset: (u * super::STEPS) as u32, mask, seed }
    }

    /// The random number of sample `k`, counted modulo M.
    #[inline]
    pub fn number(&self, k: u32) -> f32 {
        let samples = u64::from(self.samples);
        let turn = samples << 24;
        // In steps of 2⁻²⁴ / M; the offset takes 2²⁴ equally likely values that are M steps apart.
        let at = (u64::from(self.place(k % self.samples)) << 24) + u64::from(self.offset) * samples;
        let at = if at >= turn { at - turn } else { at };
        (at / samples) as f32 / super::STEPS
    }

    /// A permutation of the numbers below M: one of those below the next power of two, walked until it is back
    /// below M. Each step of it can be undone.
    ///
    /// Kensler, "Correlated Multi-Jittered Sampling", Pixar Technical Memo 13-01 (2013).
    #[inline]
    fn place(&self, k: u32) -> u32 {
        let (mask, seed) = (self.mask, self.seed);
        let mut at = k;
        loop {
            at ^= seed;
            at = at.wrapping_mul(0xe170_893d);
            at ^= seed >> 16;
            at ^= (at & mask) >> 4;
            at ^= seed >> 8;
            at = at.wrapping_mul(0x0929_eb3f);
            at ^= seed >> 23;
            at ^= (at & mask) >> 1;
            at = at.wrapping_mul(1 | seed >> 27);
            at = at.wrapping_mul(0x6935_fa69);
            at ^= (at & mask) >> 11;
            at = at.wrapping_mul(0x74dc_b303);
            at ^= (at & mask) >> 2;
            at = at.wrapping_mul(0x9e50_1cc3);
            at ^= (at & mask) >> 2;
            at = at.wrapping_mul(0xc860_a3df);
            at &= mask;
            at ^= at >> 5;
            if at < self.samples {
                return at;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_a_permutation() {
        let mut seen = [u32::MAX; 300];
        for samples in 1..=300u32 {
            let quotas = Quotas::new(samples, 0.0, samples.wrapping_mul(0x9e37_79b9));
            for k in 0..samples {
                let place = quotas.place(k) as usize;
                assert_ne!(seen[place], samples, "{samples}: {place} twice");
                seen[place] = samples;
            }
        }
    }
}
