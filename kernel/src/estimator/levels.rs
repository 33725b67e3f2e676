//! Many groups in an order: each is asked only if those before it let light through, and then not always.

use crate::decomposition::EstimatorError;

/// Estimates the product of any number of visibilities by asking them in turn, the later the rarer.
///
/// With `Q_i` the chance to get as far as level i,
///
/// ```text
///     V = 1 - sum_i (blocked first at i) / Q_i,
/// ```
///
/// right for any `1 >= Q_0 >= Q_1 >= ... > 0`. Where level i is the first to block, the variance is `1 / Q_i - 1`;
/// where nothing blocks the result is 1 without fail.
///
/// For two levels with `Q_0 = 1` it is [`Decomposition::Residual`](crate::Decomposition::Residual) with u = 1. Unlike
/// recursive [`Halving`](super::Halving), its variance does not grow with the number of levels.
#[derive(Clone, Copy, Debug)]
pub struct Levels<'a>(&'a [f32]);

impl<'a> Levels<'a> {
    /// With these chances to get to each level. Costs one look at them.
    pub fn new(reach: &'a [f32]) -> Result<Self, EstimatorError> {
        let mut last = 1.0;
        for (level, &chance) in reach.iter().enumerate() {
            if !(chance > 0.0 && chance <= last) {
                return Err(EstimatorError::Reach { level });
            }
            last = chance;
        }
        Ok(Self(reach))
    }

    /// How many there are.
    #[inline]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Are there none? Then everything is visible.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Levels to ask, from the first on, until one blocks: `u` is uniform in [0, 1).
    #[inline]
    pub fn depth(&self, u: f32) -> usize {
        self.0.iter().take_while(|&&chance| u < chance).count()
    }

    /// What to return if this level is the first that blocks, having been asked; 1 if none of those asked does.
    /// Panics if there is no such level.
    #[inline]
    pub fn value(&self, blocked: Option<usize>) -> f32 {
        match blocked {
            Some(level) => 1.0 - 1.0 / self.0[level],
            None => 1.0,
        }
    }

    /// The same with the levels asked by `visible`: does level i let light through?
    #[inline(always)]
    pub fn estimate(&self, u: f32, mut visible: impl FnMut(usize) -> bool) -> f32 {
        for (level, &chance) in self.0.iter().enumerate() {
            if u >= chance {
                return 1.0;
            }
            if !visible(level) {
                return 1.0 - 1.0 / chance;
            }
        }
        1.0
    }

    /// The variance where this level is the first to block, or none is. Panics if there is no such level.
    pub fn variance(&self, blocked: Option<usize>) -> f64 {
        blocked.map_or(0.0, |level| 1.0 / f64::from(self.0[level]) - 1.0)
    }

    /// The mean of [`Levels::variance`], where level i is the first to block with the chance `first[i]`.
    pub fn mean_variance(&self, first: &[f64]) -> f64 {
        self.0.iter().zip(first).map(|(&chance, first)| first * (1.0 / f64::from(chance) - 1.0)).sum()
    }

    /// The variance of one evaluation at random blockers: the mean variance plus that of V, `v (1 - v)`.
    pub fn total_variance(&self, first: &[f64]) -> f64 {
        let hidden: f64 = first.iter().sum();
        self.mean_variance(first) + hidden * (1.0 - hidden)
    }

    /// Writes chances that fall evenly, `Q_i = (K - i) / K`: any number of levels from 1 to K is as likely.
    pub fn even(reach: &mut [f32]) {
        let count = reach.len();
        for (level, chance) in reach.iter_mut().enumerate() {
            *chance = (count - level) as f32 / count as f32;
        }
    }

    /// Writes the chances of least variance times cost, where level i is the first to block with the chance
    /// `first[i]`, and asking it costs `costs[i]`:
    ///
    /// ```text
    ///     Q_i ∝ sqrt(h_i / c_i),    h_i = P(i blocks | free so far),
    /// ```
    ///
    /// cut off at 1 and pooled where they would grow, and at least `least`. The slices must be of one length, or the
    /// shortest counts. Panics if `least` is NaN. Costs the square of the number of levels.
    pub fn best(first: &[f64], costs: &[f64], least: f32, reach: &mut [f32]) {
        let count = reach.len().min(first.len()).min(costs.len());
        let reach = &mut reach[..count];
        // A level's cost counts only where light has come so far.
        let mass = |from: usize, to: usize| {
            let mut free = 1.0 - first[..from].iter().sum::<f64>();
            let (mut blocked, mut cost) = (0.0, 0.0);
            for level in from..to {
                blocked += first[level];
                cost += costs[level] * free.max(0.0);
                free -= first[level];
            }
            (blocked, cost)
        };
        // Blocks of levels that share a chance: those whose ratios would grow are pooled, from left to right.
        let ratio = |from, to| {
            let (blocked, cost) = mass(from, to);
            if blocked > 0.0 { blocked / cost.max(f64::MIN_POSITIVE) } else { 0.0 }
        };
        for level in 0..count {
            let (mut from, mut own) = (level, ratio(level, level + 1));
            while from > 0 && f64::from(reach[from - 1]) <= own {
                let shared = reach[from - 1];
                while from > 0 && reach[from - 1] == shared {
                    from -= 1;
                }
                own = ratio(from, level + 1);
            }
            reach[from..=level].fill(own as f32);
        }
        // With the first `whole` of them at 1 and the others at λ sqrt(ratio), variance times cost is
        // (W + F/λ) (C + λ F), least at λ² = C/W. The best of all cut-offs wins.
        let hidden: f64 = first[..count].iter().sum();
        let (mut best, mut best_scale) = (f64::INFINITY, f64::INFINITY);
        for whole in 1..=count {
            let (blocked, cost) = mass(0, whole);
            let spread = hidden * (1.0 - hidden) - hidden + blocked;
            let next = reach.get(whole).map_or(0.0, |&ratio| libm::sqrt(f64::from(ratio)));
            let mut scale = if spread > 0.0 { libm::sqrt(cost / spread) } else { f64::INFINITY };
            // Between where the next is cut off too, and where the last no longer is.
            scale = scale.min(1.0 / next).max(1.0 / libm::sqrt(f64::from(reach[whole - 1])));
            let (mut variance, mut work, mut free) = (hidden * (1.0 - hidden) - hidden, 0.0, 1.0f64);
            for ((&ratio, blocked), cost) in reach.iter().zip(first).zip(costs) {
                let chance = chance_of(ratio, scale, least);
                variance += blocked / chance;
                work += cost * free.max(0.0) * chance;
                free -= blocked;
            }
            if variance * work < best {
                (best, best_scale) = (variance * work, scale);
            }
        }
        for chance in reach.iter_mut() {
            *chance = chance_of(*chance, best_scale, least) as f32;
        }
    }
}

/// The chance of a level of this ratio.
fn chance_of(ratio: f32, scale: f64, least: f32) -> f64 {
    let chance = libm::sqrt(f64::from(ratio)) * scale;
    // 0 times infinity: no blocker, at no spread.
    let chance = if chance.is_nan() { 0.0 } else { chance };
    chance.clamp(f64::from(least.clamp(f32::EPSILON, 1.0)), 1.0)
}
