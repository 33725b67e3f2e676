//! Recursive halving: each group is estimated from two halves of its own, down to single blockers.

use super::{OneTerm, Probabilities};
use crate::decomposition::{Bilinear, Decomposition, EstimatorError, Need};

/// Estimates the product of any number of visibilities by halving them, and each half again.
///
/// `V_A` and `V_B` of a [`Decomposition`] are estimates of their own, independent of each other, which leaves the
/// mean as it is where terms are linear in each: `Power` is refused.
///
/// **The variance explodes.** With `Balanced`, equal probabilities and n blockers none of which is in the way it is
/// `3^(n - 1) - 1`: 2, 26, 2186 for n = 2, 4, 8. At each node the second moments multiply, `E[x²] = 3 E[a²] E[b²]`.
/// It is here to be seen; [`Levels`](super::Levels) takes any number of groups without that.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Halving {
    one: OneTerm,
    forms: [Bilinear; 3],
}

impl Halving {
    /// The same decomposition and probabilities at every node.
    pub fn new(decomposition: Decomposition, probabilities: &Probabilities) -> Result<Self, EstimatorError> {
        if !decomposition.nests() {
            return Err(EstimatorError::PowerNested);
        }
        let one = OneTerm::new(decomposition, probabilities)?;
        let returned = |choice| one.decomposition.returned(one.p, choice);
        Ok(Self { one, forms: [returned(0), returned(1), returned(2)] })
    }

    /// An estimate of whether all of `count` blockers let light through; 1 if there are none.
    ///
    /// `u` gives independent random numbers, uniform in [0, 1), at most `count - 1` of them; `visible` answers for
    /// a blocker below `count`. Blockers are halved in their order: hand them over shuffled to halve at random. The
    /// result grows like the root of the variance, so it is an `f64`.
    pub fn estimate(
        &self,
        count: usize,
        mut u: impl FnMut() -> f32,
        mut visible: impl FnMut(usize) -> bool,
    ) -> f64 {
        self.node(0, count, &mut u, &mut visible)
    }

    fn node(
        &self,
        first: usize,
        count: usize,
        u: &mut impl FnMut() -> f32,
        visible: &mut impl FnMut(usize) -> bool,
    ) -> f64 {
        if count <= 1 {
            return if count == 0 || visible(first) { 1.0 } else { 0.0 };
        }
        let half = count.div_ceil(2);
        let choice = self.one.choose(u());
        let needs = self.one.needs(choice);
        let a = if needs.a { self.node(first, half, u, visible) } else { 0.0 };
        // Lazy where the factor of B is exactly 0.
        let ask = match needs.b {
            Need::Never => false,
            Need::Always => true,
            Need::IfVisible => a != 0.0,
            Need::IfBlocked => a != 1.0,
        };
        let b = if ask { self.node(first + half, count - half, u, visible) } else { 0.0 };
        self.forms[choice].at(a, b)
    }

    /// The variance for blockers of which each is in the way (`false`) or not, in this order.
    pub fn variance(&self, visible: &[bool]) -> f64 {
        let (mean, square) = self.moments(visible);
        square - mean * mean
    }

    /// E\[x\] and E\[x²\] of a node.
    fn moments(&self, visible: &[bool]) -> (f64, f64) {
        match *visible {
            [] => return (1.0, 1.0),
            [one] => {
                let one = f64::from(u8::from(one));
                return (one, one);
            }
            _ => {}
        }
        let (a, b) = visible.split_at(visible.len().div_ceil(2));
        let ((a, aa), (b, bb)) = (self.moments(a), self.moments(b));
        let mut square = 0.0;
        for (chance, form) in self.one.chances().iter().zip(&self.forms) {
            let Bilinear { constant: k, a: ka, b: kb, ab: kab } = *form;
            // The square of k + ka A + kb B + kab A B, for independent A and B.
            let squares = k * k + ka * ka * aa + kb * kb * bb + kab * kab * aa * bb;
            let crossed =
                k * (ka * a + kb * b + kab * a * b) + (ka * kb * a * b) + kab * (ka * aa * b + kb * a * bb);
            square += chance * (squares + 2.0 * crossed);
        }
        (a * b, square)
    }
}
