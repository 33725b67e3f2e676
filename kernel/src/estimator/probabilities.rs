//! How likely each term is taken.

use super::STEPS;
use crate::decomposition::{Costs, Decomposition, EstimatorError, Joint};

/// Three probabilities above 0, multiples of 2⁻²⁴ that sum to 1: those that a float in [0, 1) of 24 random bits
/// has exactly.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Probabilities([u32; 2]);

impl Probabilities {
    /// A third each, to 2⁻²⁴.
    pub const UNIFORM: Self = Self([5_592_405, 11_184_811]);

    /// In proportion to weights, which must be finite and above 0; none comes out below 2⁻²⁴.
    pub fn new(weights: [f64; 3]) -> Result<Self, EstimatorError> {
        let sum: f64 = weights.iter().sum();
        if let Some(term) = weights.iter().position(|weight| !(*weight > 0.0 && *weight / sum > 0.0)) {
            return Err(EstimatorError::Probability { term });
        }
        let steps = f64::from(STEPS);
        let step = |share: f64| (share / sum * steps + 0.5) as u32;
        let first = step(weights[0]).clamp(1, STEPS as u32 - 2);
        Ok(Self([first, step(weights[0] + weights[1]).clamp(first + 1, STEPS as u32 - 1)]))
    }

    /// The thesis' importance sampling: each term in proportion to its mean contribution `E|s_i|`, which test rays
    /// tell (64 a point: see [`Tally`](crate::decomposition::Tally)).
    ///
    /// The terms of `InclusionExclusion` are 0 or ±1, so `E|s_i| = E[s_i²]`, and as long as each term contributes
    /// the variance `sum E[s_i²] / p_i - V²` is **exactly that of equal probabilities**: this gains nothing. It is
    /// here because it is part of the method; [`Probabilities::optimal`] does what it was meant to do.
    ///
    /// No term gets less than `least`, from 0 to 1/3; what test rays did not see may still be there. With
    /// `least` 0, a term that never contributes is an error.
    pub fn importance(
        decomposition: &Decomposition,
        joint: &Joint,
        least: f64,
    ) -> Result<Self, EstimatorError> {
        at_least(decomposition.contributions(joint), least)
    }

    /// Those of least variance times cost where (V_A, V_B) is so distributed: with costs c_i of the terms and c_0
    /// of a sample, `m_i = E[s_i²]`, μ = E\[V\], and C and Var the mean cost and the variance that result,
    ///
    /// ```text
    ///     p_i ∝ sqrt(m_i / (c_i + c_0 + μ² C / Var)),
    /// ```
    ///
    /// a fixed point found in some rounds. Where all costs are the same this is `sqrt(m_i)`.
    ///
    /// No term gets less than `least`, from 0 to 1/3, as in [`Probabilities::importance`]. For `Residual` see
    /// [`Decomposition::best_residual`].
    pub fn optimal(
        decomposition: &Decomposition,
        joint: &Joint,
        costs: &Costs,
        least: f64,
    ) -> Result<Self, EstimatorError> {
        let moments = decomposition.second_moments(joint);
        let mean = joint.visibility();
        let mut p = scaled(moments.map(libm::sqrt));
        for _ in 0..ROUNDS {
            let cost = costs.fixed + (0..3).map(|i| p[i] * costs.terms[i]).sum::<f64>();
            let square: f64 = (0..3).filter(|&i| p[i] > 0.0).map(|i| moments[i] / p[i]).sum();
            let spread = square - mean * mean;
            if spread <= 0.0 || spread.is_nan() {
                break;
            }
            let common = costs.fixed + mean * mean * cost / spread;
            let mut next = [0.0; 3];
            for i in 0..3 {
                next[i] = libm::sqrt(moments[i] / (costs.terms[i] + common));
            }
            let next = scaled(next);
            // Free terms that never contribute are 0/0.
            if next.iter().any(|p| !p.is_finite()) {
                break;
            }
            let moved = (0..3).fold(0.0f64, |most, i| most.max((next[i] - p[i]).abs()));
            p = next;
            if moved < SETTLED {
                break;
            }
        }
        at_least(p, least)
    }

    /// The chance of each term.
    pub fn chances(&self) -> [f64; 3] {
        let [first, second] = self.0.map(|below| f64::from(below) / f64::from(STEPS));
        [first, second - first, 1.0 - second]
    }

    /// The first term is taken below the first, the second below the second, in steps of 2⁻²⁴.
    pub(super) fn below(&self) -> [u32; 2] {
        self.0
    }
}

impl Default for Probabilities {
    fn default() -> Self {
        Self::UNIFORM
    }
}

/// The most rounds, and the movement after which another would not be seen in 24 bits.
const ROUNDS: usize = 32;
const SETTLED: f64 = 1e-8;

fn scaled(weights: [f64; 3]) -> [f64; 3] {
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

/// The same shares of what is left when each has `least`.
fn at_least(weights: [f64; 3], least: f64) -> Result<Probabilities, EstimatorError> {
    let least = least.clamp(0.0, 1.0 / 3.0);
    let shares = scaled(weights);
    // Nothing contributes anywhere: any will do.
    let shares = if shares.iter().all(|share| share.is_finite()) { shares } else { [1.0 / 3.0; 3] };
    Probabilities::new(shares.map(|share| least + (1.0 - 3.0 * least) * share))
}
