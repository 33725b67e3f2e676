//! The product of two visibilities as a sum, of which a random part is evaluated.
//!
//! With the blockers in two groups, `V = V_A V_B`. An identity `V_A V_B = s_0 + s_1 + s_2` lets one term stand for
//! all: take term `i` with probability `p_i`, return `s_i / p_i`, and the mean is V, for
//!
//! ```text
//!     sum_i p_i (s_i / p_i) = V_A V_B,    with the variance    sum_i s_i² / p_i - (V_A V_B)².
//! ```
//!
//! What is returned is no visibility: it may be negative or above one. Here are the identities, their variances in
//! closed form and the work they take; [`estimator`](crate::estimator) draws the terms.
//!
//! Billen, Engelen, Lagae and Dutré, "Probabilistic Visibility Evaluation for Direct Illumination", Computer
//! Graphics Forum 32(4), 2013. `Residual` is Russian roulette on the second group.

use core::fmt;

/// One of the two halves of the blockers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// The first, whose visibility is V_A.
    A,
    /// The second, whose visibility is V_B.
    B,
}

/// When group B must be asked, as A's answer has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// Not at all.
    Never,
    /// Whatever A says.
    Always,
    /// Only if A lets light through.
    IfVisible,
    /// Only if A blocks.
    IfBlocked,
}

impl Need {
    /// Must it be asked, given V_A?
    #[inline(always)]
    pub const fn given(self, a: bool) -> bool {
        match self {
            Self::Never => false,
            Self::Always => true,
            Self::IfVisible => a,
            Self::IfBlocked => !a,
        }
    }
}

/// The groups that must be asked. A comes first; its answer may spare B.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Needs {
    /// Whether group A must be asked.
    pub a: bool,
    /// When group B must be. If A is not asked, this is `Never` or `Always`.
    pub b: Need,
}

/// A way to write V_A V_B as a sum, and what is evaluated of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Decomposition {
    /// `V_A ; V_B ; (1 - V_A)(1 - V_B) - 1`. With equal probabilities the variances of (V_A, V_B) = 00, 01, 10, 11
    /// are 0, 6, 6, 8.
    InclusionExclusion,
    /// `V_A - 1/3 ; V_B - 1/3 ; (1 - V_A)(1 - V_B) - 1/3`: variance 2 everywhere.
    Balanced,
    /// `-V_A/d ; -V_B/d ; (V_A + V_B)ⁿ/d` with `d = 2ⁿ - 2`, n from 2 to [`Decomposition::MOST_POWER`]. The third term
    /// is nearly all of the sum and asks both groups. For n = 8 the variances are 0, 6/254², 6/254², 2.0475; 6/254² is
    /// 9.30e-5, of which the thesis' slides print one half. Rests on V² = V, so it cannot be nested.
    Power(u32),
    /// `u V_A ; V_A (V_B - u)`: the first always, the second with chance q in (0, 1]. No group B without a look at A:
    ///
    /// ```text
    ///     A blocks: 0,    else with chance q: (V_B - (1 - q) u) / q,    else: u.
    /// ```
    ///
    /// Right for any u. It brings its own chances, so the p of others mean nothing to it.
    Residual {
        /// The chance to ask group B where A lets light through.
        q: f32,
        /// The guess of V_B, of any value. Best is the chance that B lets light through where A does.
        u: f32,
    },
}

/// Why numbers make no decomposition, no probabilities and no estimator.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum EstimatorError {
    /// The n of `Power(n)` is outside 2 to [`Decomposition::MOST_POWER`].
    Power(u32),
    /// The q of `Residual` is outside (0, 1].
    Chance(f32),
    /// The u of `Residual` is not finite.
    Guess(f32),
    /// `Power` cannot be nested: it needs V² = V, which estimates do not obey.
    PowerNested,
    /// The probability of a term would not be above 0, or not finite.
    Probability {
        /// The term.
        term: usize,
    },
    /// The chance to get to a level is outside (0, 1], or above that of the level before.
    Reach {
        /// The level.
        level: usize,
    },
}

impl fmt::Display for EstimatorError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Power(n) => {
                write!(f, "power {n}: must be from 2 to {}", Decomposition::MOST_POWER)
            }
            Self::Chance(q) => write!(f, "q = {q}: must be above 0 and at most 1"),
            Self::Guess(u) => write!(f, "u = {u}: must be finite"),
            Self::PowerNested => {
                write!(f, "the power form cannot be nested: it needs V² = V, which estimates do not obey")
            }
            Self::Probability { term } => {
                write!(f, "term {term}: a probability must be finite and above 0")
            }
            Self::Reach { level } => {
                write!(
                    f,
                    "level {level}: a chance must be above 0 and at most that of the level before, or 1"
                )
            }
        }
    }
}

impl core::error::Error for EstimatorError {}

/// How likely each (V_A, V_B) is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Joint([f64; 4]);

impl Joint {
    /// From weights of (V_A, V_B) = 00, 01, 10, 11: not negative, finite, not all 0. They need not sum to 1.
    pub fn new(weights: [f64; 4]) -> Option<Self> {
        let sum: f64 = weights.iter().sum();
        let sound = weights.iter().all(|&weight| weight >= 0.0) && sum > 0.0 && sum.is_finite();
        if sound { Some(Self(weights.map(|weight| weight / sum))) } else { None }
    }

    /// Always these two.
    pub fn certain(a: bool, b: bool) -> Self {
        let mut p = [0.0; 4];
        p[cell(a, b)] = 1.0;
        Self(p)
    }

    /// V_A with this chance of being 1 and V_B with that one, independent. `None` outside [0, 1].
    pub fn independent(a: f64, b: f64) -> Option<Self> {
        Self::new([(1.0 - a) * (1.0 - b), (1.0 - a) * b, a * (1.0 - b), a * b])
    }

    /// The chances of 00, 01, 10, 11.
    #[inline]
    pub fn chances(&self) -> [f64; 4] {
        self.0
    }

    /// E\[V\], the chance that both let light through.
    #[inline]
    pub fn visibility(&self) -> f64 {
        self.0[3]
    }

    /// The chance that A lets light through.
    #[inline]
    pub fn a_visible(&self) -> f64 {
        self.0[2] + self.0[3]
    }

    /// The mean of a function of (V_A, V_B).
    fn mean(&self, of: impl Fn(bool, bool) -> f64) -> f64 {
        let mut sum = 0.0;
        for (chance, (a, b)) in self.0.iter().zip(CELLS) {
            // What never happens may be infinite.
            if *chance > 0.0 {
                sum += chance * of(a, b);
            }
        }
        sum
    }
}

/// Answers of test rays, counted: what [`Joint`] is learned from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally([u32; 4]);

impl Tally {
    /// Takes note of one ray.
    #[inline(always)]
    pub fn add(&mut self, a: bool, b: bool) {
        self.0[cell(a, b)] += 1;
    }

    /// How often 00, 01, 10 and 11 came.
    pub fn counts(&self) -> [u32; 4] {
        self.0
    }

    /// As often as seen. `None` before the first ray.
    pub fn joint(&self) -> Option<Joint> {
        Joint::new(self.0.map(f64::from))
    }
}

/// What it costs to evaluate terms, in any unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Costs {
    /// Of a sample, whatever the term.
    pub fixed: f64,
    /// Of each term beyond that.
    pub terms: [f64; 3],
}

/// (V_A, V_B) in the order of all tables: 00, 01, 10, 11.
pub(crate) const CELLS: [(bool, bool); 4] = [(false, false), (false, true), (true, false), (true, true)];

/// The place of (V_A, V_B) in that order.
#[inline(always)]
pub(crate) const fn cell(a: bool, b: bool) -> usize {
    (a as usize) << 1 | b as usize
}

/// A function `constant + a V_A + b V_B + ab V_A V_B`, which every function of two bits is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bilinear {
    pub(crate) constant: f64,
    pub(crate) a: f64,
    pub(crate) b: f64,
    pub(crate) ab: f64,
}

impl Bilinear {
    const ZERO: Self = Self { constant: 0.0, a: 0.0, b: 0.0, ab: 0.0 };

    #[inline]
    pub(crate) fn at(&self, a: f64, b: f64) -> f64 {
        self.constant + self.a * a + b * (self.b + self.ab * a)
    }

    fn scaled(&self, by: f64) -> Self {
        Self { constant: self.constant * by, a: self.a * by, b: self.b * by, ab: self.ab * by }
    }
}

impl Decomposition {
    /// The greatest n of `Power(n)`: beyond it nothing changes.
    pub const MOST_POWER: u32 = 64;

    /// The same, if its numbers are sound.
    pub fn checked(self) -> Result<Self, EstimatorError> {
        match self {
            Self::Power(n) if !(2..=Self::MOST_POWER).contains(&n) => Err(EstimatorError::Power(n)),
            Self::Residual { q, .. } if !(q > 0.0 && q <= 1.0) => Err(EstimatorError::Chance(q)),
            Self::Residual { u, .. } if !u.is_finite() => Err(EstimatorError::Guess(u)),
            sound => Ok(sound),
        }
    }

    /// Whether V_A and V_B may themselves be estimates, if independent: all but `Power`.
    pub const fn nests(&self) -> bool {
        !matches!(self, Self::Power(_))
    }

    /// Terms in the sum, and choices to draw from: 3, and 2 for `Residual`.
    pub const fn terms(&self) -> usize {
        match self {
            Self::Residual { .. } => 2,
            _ => 3,
        }
    }

    /// Term `i` of the sum; 0 where there is none.
    pub fn term(&self, i: usize, a: bool, b: bool) -> f64 {
        self.form(i).at(f64::from(u8::from(a)), f64::from(u8::from(b)))
    }

    /// Term `i` as a function of two bits.
    fn form(&self, i: usize) -> Bilinear {
        const THIRD: f64 = 1.0 / 3.0;
        match (*self, i) {
            (Self::InclusionExclusion, 0) => Bilinear { a: 1.0, ..Bilinear::ZERO },
            (Self::InclusionExclusion, 1) => Bilinear { b: 1.0, ..Bilinear::ZERO },
            (Self::InclusionExclusion, 2) => Bilinear { constant: 0.0, a: -1.0, b: -1.0, ab: 1.0 },
            (Self::Balanced, 0) => Bilinear { constant: -THIRD, a: 1.0, ..Bilinear::ZERO },
            (Self::Balanced, 1) => Bilinear { constant: -THIRD, b: 1.0, ..Bilinear::ZERO },
            (Self::Balanced, 2) => Bilinear { constant: 1.0 - THIRD, a: -1.0, b: -1.0, ab: 1.0 },
            (Self::Power(n), 0..=2) => {
                let share = 1.0 / (libm::ldexp(1.0, n as i32) - 2.0);
                match i {
                    0 => Bilinear { a: -share, ..Bilinear::ZERO },
                    1 => Bilinear { b: -share, ..Bilinear::ZERO },
                    // (V_A + V_B)ⁿ is 0, 1 and 2ⁿ, and 2ⁿ = 1 + 1 + d.
                    _ => Bilinear { constant: 0.0, a: share, b: share, ab: 1.0 },
                }
            }
            (Self::Residual { u, .. }, 0) => Bilinear { a: f64::from(u), ..Bilinear::ZERO },
            (Self::Residual { u, .. }, 1) => Bilinear { a: -f64::from(u), ab: 1.0, ..Bilinear::ZERO },
            _ => Bilinear::ZERO,
        }
    }

    /// The chance of each choice: p, but for `Residual` `[1 - q, q, 0]`, to stop at A and to go on to B.
    pub fn chances(&self, p: [f64; 3]) -> [f64; 3] {
        match *self {
            Self::Residual { q, .. } => [1.0 - f64::from(q), f64::from(q), 0.0],
            _ => p,
        }
    }

    /// What a choice returns, as a function of two bits.
    pub(crate) fn returned(&self, p: [f64; 3], choice: usize) -> Bilinear {
        match (*self, choice) {
            (Self::Residual { .. }, 0) => self.form(0),
            (Self::Residual { q, .. }, 1) => {
                let (first, second) = (self.form(0), self.form(1).scaled(1.0 / f64::from(q)));
                Bilinear { a: first.a + second.a, ab: second.ab, ..Bilinear::ZERO }
            }
            _ => p.get(choice).map_or(Bilinear::ZERO, |p| self.form(choice).scaled(1.0 / p)),
        }
    }

    /// What a choice returns: `s_i / p_i`, and for `Residual` u V_A or that plus V_A (V_B - u) / q.
    pub fn value(&self, p: [f64; 3], choice: usize, a: bool, b: bool) -> f64 {
        self.returned(p, choice).at(f64::from(u8::from(a)), f64::from(u8::from(b)))
    }

    /// The groups that a choice must ask.
    #[inline(always)]
    pub const fn needs(&self, choice: usize) -> Needs {
        match (self, choice) {
            (Self::Residual { .. }, 1) => Needs { a: true, b: Need::IfVisible },
            (_, 0) => Needs { a: true, b: Need::Never },
            (_, 1) => Needs { a: false, b: Need::Always },
            (Self::Power(_), _) => Needs { a: true, b: Need::Always },
            (_, _) => Needs { a: true, b: Need::IfBlocked },
        }
    }

    /// The variance of one evaluation where V_A and V_B are these: `sum_i s_i² / p_i - V²`.
    pub fn variance(&self, p: [f64; 3], a: bool, b: bool) -> f64 {
        self.total_variance(p, &Joint::certain(a, b))
    }

    /// The mean of [`Decomposition::variance`] over (V_A, V_B): what the choice of terms adds to the noise.
    pub fn mean_variance(&self, p: [f64; 3], joint: &Joint) -> f64 {
        joint.mean(|a, b| self.variance(p, a, b))
    }

    /// The variance of one evaluation at a random (V_A, V_B): the mean variance plus that of V, `v (1 - v)`.
    pub fn total_variance(&self, p: [f64; 3], joint: &Joint) -> f64 {
        let (chances, mut sum) = (self.chances(p), 0.0);
        for (choice, chance) in chances.iter().enumerate() {
            if *chance > 0.0 {
                let value = self.returned(p, choice);
                sum += chance
                    * joint.mean(|a, b| {
                        let value = value.at(f64::from(u8::from(a)), f64::from(u8::from(b)));
                        value * value
                    });
            }
        }
        let mean = joint.visibility();
        sum - mean * mean
    }

    /// The same, a sample, where of many samples exactly the share p_i takes term i: `sum_i Var(s_i) / p_i`.
    ///
    /// Never above [`Decomposition::total_variance`], and constants in the terms drop out. The samples' (V_A, V_B)
    /// are independent of each other here; stratified ones do better.
    pub fn quota_variance(&self, p: [f64; 3], joint: &Joint) -> f64 {
        let (chances, mut sum) = (self.chances(p), 0.0);
        for (choice, chance) in chances.iter().enumerate() {
            if *chance > 0.0 {
                let value = self.returned(p, choice);
                let at = |a, b| value.at(f64::from(u8::from(a)), f64::from(u8::from(b)));
                let mean = joint.mean(at);
                sum += chance * joint.mean(|a, b| (at(a, b) - mean) * (at(a, b) - mean));
            }
        }
        sum
    }

    /// `E[s_i²]`.
    pub fn second_moments(&self, joint: &Joint) -> [f64; 3] {
        let mut moments = [0.0; 3];
        for (i, moment) in moments.iter_mut().enumerate() {
            *moment = joint.mean(|a, b| self.term(i, a, b) * self.term(i, a, b));
        }
        moments
    }

    /// `E|s_i|`: what the thesis' importance sampling goes by.
    pub fn contributions(&self, joint: &Joint) -> [f64; 3] {
        let mut contributions = [0.0; 3];
        for (i, contribution) in contributions.iter_mut().enumerate() {
            *contribution = joint.mean(|a, b| self.term(i, a, b).abs());
        }
        contributions
    }

    /// The mean cost of each choice, if asking group A costs `a` and group B costs `b`: groups are asked lazily.
    pub fn costs(&self, joint: &Joint, fixed: f64, a: f64, b: f64) -> Costs {
        let mut terms = [0.0; 3];
        for (choice, cost) in terms.iter_mut().enumerate().take(self.terms()) {
            let needs = self.needs(choice);
            let asks_b = joint.mean(|visible, _| f64::from(u8::from(needs.b.given(visible))));
            *cost = if needs.a { a } else { 0.0 } + asks_b * b;
        }
        Costs { fixed, terms }
    }

    /// The mean cost of a sample.
    pub fn mean_cost(&self, p: [f64; 3], costs: &Costs) -> f64 {
        let chances = self.chances(p);
        costs.fixed + (0..3).map(|i| chances[i] * costs.terms[i]).sum::<f64>()
    }

    /// The `Residual` of least variance times cost where (V_A, V_B) is so distributed and asking the groups costs
    /// `a` and `b`: with α = P(A visible), v = E\[V\] and m = α - v,
    ///
    /// ```text
    ///     u = v / α,    q = min(1, sqrt(m a / (v α (1 - α) b))),    q at least `least`.
    /// ```
    ///
    /// A distribution learned from few rays needs a `least` well above 0: a blocker of B that none of them met
    /// costs 1 / q.
    pub fn best_residual(joint: &Joint, a: f64, b: f64, least: f32) -> Self {
        let (alpha, v) = (joint.a_visible(), joint.visibility());
        let missed = alpha - v;
        let least = least.clamp(f32::EPSILON, 1.0);
        let q = libm::sqrt(missed * a / (v * alpha * (1.0 - alpha) * b));
        // 0/0 where A never misses a blocker; infinity where it blocks nothing or B everything.
        let q = if q.is_nan() { 0.0 } else { q.min(1.0) };
        let u = if alpha > 0.0 { (v / alpha) as f32 } else { 0.0 };
        Self::Residual { q: (q as f32).max(least), u }
    }
}
