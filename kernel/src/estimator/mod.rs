//! Visibility from the answers of groups of blockers: exactly, or a random part of it.
//!
//! | estimator | asks | right |
//! |---|---|---|
//! | [`Exact`] | A, and B if A lets light through | always |
//! | [`OneTerm`] | what one term of a [`Decomposition`] needs | on average |
//! | [`Levels`] | groups in their order, the later the rarer | on average |
//! | [`Halving`] | a random path through a tree of groups | on average |
//!
//! Random numbers are arguments, uniform in [0, 1); [`Quotas`] makes them such that exactly the right share of a
//! point's samples takes each term. Groups are asked lazily, so what is not needed costs nothing. **Nothing is
//! clamped**: estimates may be negative or above one, and only their average is right. Clamp pixels, not samples.

mod halving;
mod levels;
mod probabilities;
mod quotas;

pub use halving::Halving;
pub use levels::Levels;
pub use probabilities::Probabilities;
pub use quotas::Quotas;

use crate::decomposition::{CELLS, Costs, Decomposition, EstimatorError, Group, Joint, Needs, cell};

/// Visibility from the answers of two groups.
pub trait Estimator {
    /// V, or a number that is V on average over u, which is uniform in [0, 1).
    ///
    /// `visible` says whether a group lets light through. It is asked once a group at most, A first.
    fn estimate(&self, u: f32, visible: impl FnMut(Group) -> bool) -> f32;
}

/// `V_A V_B` itself; `u` is not looked at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Exact;

impl Estimator for Exact {
    #[inline(always)]
    fn estimate(&self, _: f32, mut visible: impl FnMut(Group) -> bool) -> f32 {
        if visible(Group::A) && visible(Group::B) { 1.0 } else { 0.0 }
    }
}

/// Estimates `V_A V_B` by one randomly chosen term of a sum.
///
/// Term `i` is taken with probability `p_i`, and `s_i / p_i` returned; see [`Decomposition`]. For
/// [`Decomposition::Residual`] it is the coin that is drawn: to stop at A, or to go on.
///
/// - The result is not confined to `[0, 1]`: with `InclusionExclusion` and equal probabilities it is -3, 0 or 3.
/// - Cost: a comparison or two, a load, and the groups asked.
///
/// Where a closure is unwelcome, as around SIMD code, ask the groups yourself:
///
/// ```
/// use occlude_kernel::{Decomposition, OneTerm, Probabilities};
/// # let (trace_a, trace_b, u) = (|| true, || false, 0.4);
/// let one = OneTerm::new(Decomposition::Balanced, &Probabilities::UNIFORM)?;
/// let choice = one.choose(u);
/// let needs = one.needs(choice);
/// let a = needs.a && trace_a();
/// let b = needs.b.given(a) && trace_b();
/// let estimate = one.value(choice, a, b);
/// # assert!((estimate + 1.0).abs() < 1e-6);
/// # Ok::<(), occlude_kernel::EstimatorError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OneTerm {
    decomposition: Decomposition,
    p: [f64; 3],
    below: [u32; 2], // choice 0 below the first, 1 below the second, in steps of 2⁻²⁴
    values: [[f32; 4]; 3],
}

impl OneTerm {
    /// With these probabilities, at which `Residual` does not look.
    pub fn new(decomposition: Decomposition, probabilities: &Probabilities) -> Result<Self, EstimatorError> {
        let mut decomposition = decomposition.checked()?;
        let mut below = probabilities.below();
        if let Decomposition::Residual { q, u } = &mut decomposition {
            // A chance that 24 random bits have exactly.
            let on = ((*q * STEPS + 0.5) as u32).max(1);
            (*q, below) = (on as f32 / STEPS, [STEPS as u32 - on, STEPS as u32]);
            debug_assert!(u.is_finite());
        }
        let p = probabilities.chances();
        let mut values = [[0.0; 4]; 3];
        for (choice, row) in values.iter_mut().enumerate() {
            for (value, (a, b)) in row.iter_mut().zip(CELLS) {
                *value = decomposition.value(p, choice, a, b) as f32;
            }
        }
        Ok(Self { decomposition, p, below, values })
    }

    /// What is decomposed; the q of `Residual` rounded to a multiple of 2⁻²⁴.
    pub fn decomposition(&self) -> Decomposition {
        self.decomposition
    }

    /// The chance of each choice.
    pub fn chances(&self) -> [f64; 3] {
        self.decomposition.chances(self.p)
    }

    /// The term to take, or for `Residual` whether to go on to B (1) or not (0).
    #[inline(always)]
    pub fn choose(&self, u: f32) -> usize {
        let u = (u * STEPS) as u32;
        usize::from(u >= self.below[0]) + usize::from(u >= self.below[1])
    }

    /// The groups that a choice must ask.
    #[inline(always)]
    pub fn needs(&self, choice: usize) -> Needs {
        self.decomposition.needs(choice)
    }

    /// What a choice returns for these answers; what it does not need may be anything. 0 if there is no such choice.
    #[inline(always)]
    pub fn value(&self, choice: usize, a: bool, b: bool) -> f32 {
        match self.values.get(choice) {
            Some(row) => row[cell(a, b)],
            None => 0.0,
        }
    }

    /// The variance where V_A and V_B are these.
    pub fn variance(&self, a: bool, b: bool) -> f64 {
        self.decomposition.variance(self.p, a, b)
    }

    /// The mean of [`OneTerm::variance`] over (V_A, V_B).
    pub fn mean_variance(&self, joint: &Joint) -> f64 {
        self.decomposition.mean_variance(self.p, joint)
    }

    /// The variance of one evaluation at a random (V_A, V_B).
    pub fn total_variance(&self, joint: &Joint) -> f64 {
        self.decomposition.total_variance(self.p, joint)
    }

    /// The same, a sample, with [`Quotas`].
    pub fn quota_variance(&self, joint: &Joint) -> f64 {
        self.decomposition.quota_variance(self.p, joint)
    }

    /// The mean cost of a sample.
    pub fn mean_cost(&self, costs: &Costs) -> f64 {
        self.decomposition.mean_cost(self.p, costs)
    }
}

impl Estimator for OneTerm {
    #[inline(always)]
    fn estimate(&self, u: f32, mut visible: impl FnMut(Group) -> bool) -> f32 {
        let choice = self.choose(u);
        let needs = self.needs(choice);
        let a = needs.a && visible(Group::A);
        let b = needs.b.given(a) && visible(Group::B);
        self.value(choice, a, b)
    }
}

/// Steps of a random number: a float in [0, 1) made of 24 bits has each with the same chance.
const STEPS: f32 = 16_777_216.0;
