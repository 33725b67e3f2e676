//! Decompositions by arithmetic: every outcome enumerated, in exact fractions where numbers are compared with print.

use occlude_kernel::{
    Decomposition, Estimator, EstimatorError, Exact, Group, Halving, Joint, Levels, Need, OneTerm,
    Probabilities, Tally,
};
use occlude_tests::Random;
use std::cell::Cell;
use std::ops::{Add, Mul, Sub};

/// A fraction in lowest terms. Overflow panics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Fraction(i128, i128);

const ZERO: Fraction = Fraction(0, 1);

fn fraction(a: i128, b: i128) -> Fraction {
    let gcd = |mut a: i128, mut b: i128| {
        while b != 0 {
            (a, b) = (b, a % b);
        }
        a.abs().max(1)
    };
    let (common, sign) = (gcd(a, b), if b < 0 { -1 } else { 1 });
    Fraction(sign * a / common, sign * b / common)
}

impl Add for Fraction {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        fraction(self.0 * other.1 + other.0 * self.1, self.1 * other.1)
    }
}

impl Sub for Fraction {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self + Fraction(-other.0, other.1)
    }
}

impl Mul for Fraction {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        fraction(self.0 * other.0, self.1 * other.1)
    }
}

impl Fraction {
    fn over(self, other: Self) -> Self {
        fraction(self.0 * other.1, self.1 * other.0)
    }

    fn float(self) -> f64 {
        self.0 as f64 / self.1 as f64
    }
}

const CELLS: [(bool, bool); 4] = [(false, false), (false, true), (true, false), (true, true)];

/// The terms as the formulas say, not as the kernel computes them.
fn terms(decomposition: Decomposition, a: bool, b: bool) -> [Fraction; 3] {
    let [va, vb] = [a, b].map(|v| fraction(i128::from(v), 1));
    let one = fraction(1, 1);
    let both_blocked = (one - va) * (one - vb);
    match decomposition {
        Decomposition::InclusionExclusion => [va, vb, both_blocked - one],
        Decomposition::Balanced => [va, vb, both_blocked].map(|s| s - fraction(1, 3)),
        Decomposition::Power(n) => {
            let d = fraction((1 << n) - 2, 1);
            let sum = (0..n).fold(one, |product, _| product * (va + vb));
            [(ZERO - va).over(d), (ZERO - vb).over(d), sum.over(d)]
        }
        _ => panic!("not a sum of three"),
    }
}

/// Mean and variance over the three choices.
fn moments(terms: [Fraction; 3], p: [Fraction; 3]) -> (Fraction, Fraction) {
    let mean = terms[0] + terms[1] + terms[2];
    let square = (0..3).fold(ZERO, |sum, i| sum + (terms[i] * terms[i]).over(p[i]));
    (mean, square - mean * mean)
}

const SUMS: [Decomposition; 5] = [
    Decomposition::InclusionExclusion,
    Decomposition::Balanced,
    Decomposition::Power(2),
    Decomposition::Power(8),
    Decomposition::Power(20),
];

#[test]
fn terms_sum_to_the_product_and_variances_are_those_of_all_outcomes() {
    let thirds = [fraction(1, 3); 3];
    let skewed = [fraction(1, 2), fraction(3, 10), fraction(1, 5)];
    let steep = [fraction(1, 100), fraction(1, 3), fraction(197, 300)];
    for decomposition in SUMS {
        for (a, b) in CELLS {
            let exact = terms(decomposition, a, b);
            for (i, term) in exact.iter().enumerate() {
                assert!((decomposition.term(i, a, b) - term.float()).abs() < 1e-15, "{decomposition:?} {i}");
            }
            for p in [thirds, skewed, steep] {
                let (mean, variance) = moments(exact, p);
                assert_eq!(mean, fraction(i128::from(a && b), 1), "{decomposition:?} {a} {b}");
                let p = p.map(Fraction::float);
                let found = decomposition.variance(p, a, b);
                assert!((found - variance.float()).abs() < 1e-12, "{decomposition:?} {a} {b}: {found}");
            }
        }
    }
}

/// The tables of the thesis' slides, derived. For the middle rows of n = 8 the slides print 4.65e-5, which is half
/// of what their own estimates give.
#[test]
fn the_tables_of_the_thesis() {
    let thirds = [fraction(1, 3); 3];
    let variances = |decomposition| CELLS.map(|(a, b)| moments(terms(decomposition, a, b), thirds).1);
    let whole = |n| fraction(n, 1);
    assert_eq!(variances(Decomposition::InclusionExclusion), [0, 6, 6, 8].map(whole));
    assert_eq!(variances(Decomposition::Balanced), [2; 4].map(whole));
    let [none, middle, other, all] = variances(Decomposition::Power(8));
    assert_eq!((none, middle, other), (ZERO, fraction(6, 254 * 254), fraction(6, 254 * 254)));
    // 3 (1 + 1 + 256²) / 254² - 1.
    assert_eq!(all, fraction(3 * (2 + 65536), 254 * 254) - whole(1));
    assert_eq!(format!("{:.2e} {:.4}", middle.float(), all.float()), "9.30e-5 2.0475");

    // The kernel's, at the thirds that 24 bits have.
    for (decomposition, row) in [
        (Decomposition::InclusionExclusion, [0.0, 6.0, 6.0, 8.0]),
        (Decomposition::Balanced, [2.0; 4]),
        (Decomposition::Power(8), [0.0, middle.float(), middle.float(), all.float()]),
    ] {
        let one = OneTerm::new(decomposition, &Probabilities::UNIFORM).expect("sound");
        for ((a, b), expected) in CELLS.into_iter().zip(row) {
            let found = one.variance(a, b);
            assert!((found - expected).abs() <= 1e-6 * expected, "{decomposition:?} {a} {b}: {found}");
        }
    }
    let estimates = |decomposition: Decomposition, a, b| {
        [0, 1, 2].map(|choice| decomposition.value([1.0 / 3.0; 3], choice, a, b))
    };
    let close = |found: [f64; 3], expected: [f64; 3]| {
        assert!((0..3).all(|i| (found[i] - expected[i]).abs() < 1e-12), "{found:?} {expected:?}");
    };
    close(estimates(Decomposition::InclusionExclusion, true, false), [3.0, 0.0, -3.0]);
    close(estimates(Decomposition::Balanced, false, false), [-1.0, -1.0, 2.0]);
    close(estimates(Decomposition::Power(8), true, true), [-3.0 / 254.0, -3.0 / 254.0, 768.0 / 254.0]);
}

/// Every outcome of the estimator itself, by its own chances: mean V and the variance it says.
#[test]
fn estimators_have_the_mean_and_variance_they_say() {
    let mut random = Random::new(1);
    let mut decompositions = SUMS.to_vec();
    for q in [1e-3, 0.25, 1.0] {
        decompositions.extend([-0.5, 0.0, 0.3, 1.0].map(|u| Decomposition::Residual { q, u }));
    }
    for decomposition in decompositions {
        for _ in 0..50 {
            let weights = [0; 3].map(|_| f64::from(random.unit()) + 1e-3);
            let one =
                OneTerm::new(decomposition, &Probabilities::new(weights).expect("positive")).expect("sound");
            let chances = one.chances();
            assert!((chances.iter().sum::<f64>() - 1.0).abs() < 1e-15);
            for (a, b) in CELLS {
                let (mut mean, mut square, mut start) = (0.0, 0.0, 0.0);
                for (choice, chance) in chances.into_iter().enumerate() {
                    if chance == 0.0 {
                        continue;
                    }
                    // The first and the last number of 24 bits that take this choice.
                    assert_eq!(one.choose(start as f32), choice);
                    start += chance;
                    assert_eq!(one.choose((start - 1.0 / 16_777_216.0) as f32), choice);
                    let value = f64::from(one.value(choice, a, b));
                    assert!(
                        (value - one.decomposition().value(chances, choice, a, b)).abs()
                            <= 1e-6 * value.abs()
                    );
                    (mean, square) = (mean + chance * value, square + chance * value * value);
                }
                let v = f64::from(u8::from(a && b));
                // The estimates are single precision; their sizes go up to 1/p.
                assert!((mean - v).abs() < 1e-6 * square.sqrt().max(1.0), "{one:?}: {mean}");
                let variance = one.variance(a, b);
                assert!(
                    (square - mean * mean - variance).abs() < 1e-5 * square.max(1e-9),
                    "{one:?}: {variance}"
                );
            }
        }
    }
}

/// `Residual` in double precision against its two outcomes, and its expectation against the closed forms.
#[test]
fn residual_has_its_closed_forms() {
    let joint = Joint::new([0.1, 0.15, 0.2, 0.55]).expect("sound");
    let (alpha, v) = (joint.a_visible(), joint.visibility());
    let m = alpha - v;
    assert!((alpha - 0.75).abs() < 1e-15 && (v - 0.55).abs() < 1e-15);
    for q in [0.125f32, 0.5, 1.0] {
        for u in [-1.0f32, 0.0, 0.5, 1.0] {
            let form = Decomposition::Residual { q, u };
            let (q, u) = (f64::from(q), f64::from(u));
            for (a, b) in CELLS {
                let [va, vb] = [a, b].map(|v| f64::from(u8::from(v)));
                assert_eq!(form.term(0, a, b) + form.term(1, a, b), va * vb);
                let (stop, go) = (va * u, va * (vb - (1.0 - q) * u) / q);
                let mean = (1.0 - q) * stop + q * go;
                assert!((mean - va * vb).abs() < 1e-12);
                let variance = (1.0 - q) * stop * stop + q * go * go - mean * mean;
                assert!((form.variance([0.0; 3], a, b) - variance).abs() < 1e-12);
            }
            let total = form.total_variance([0.0; 3], &joint);
            if u == 1.0 {
                assert!((total - (v * (1.0 - v) + m * (1.0 / q - 1.0))).abs() < 1e-12);
            }
            let best = Decomposition::Residual { q: q as f32, u: (v / alpha) as f32 };
            let least = best.total_variance([0.0; 3], &joint);
            assert!((least - (v * v * (1.0 - alpha) / alpha + v * m / alpha / q)).abs() < 1e-6);
            assert!(total >= least - 1e-6, "{u} does better than the best guess");
        }
    }
}

#[test]
fn expectations_are_means_over_the_cells() {
    let mut random = Random::new(2);
    for _ in 0..200 {
        let weights = [0; 4].map(|_| f64::from(random.unit()));
        let joint = Joint::new(weights).expect("sound");
        let p =
            Probabilities::new([0; 3].map(|_| f64::from(random.unit()) + 0.01)).expect("positive").chances();
        let v = joint.visibility();
        for decomposition in SUMS.into_iter().chain([Decomposition::Residual { q: 0.3, u: 0.6 }]) {
            let mean: f64 = CELLS
                .iter()
                .zip(joint.chances())
                .map(|(&(a, b), chance)| chance * decomposition.variance(p, a, b))
                .sum();
            assert!((decomposition.mean_variance(p, &joint) - mean).abs() < 1e-12);
            let total = decomposition.total_variance(p, &joint);
            assert!((total - mean - v * (1.0 - v)).abs() < 1e-12 * total.max(1.0));
            // Each choice's own variance, weighed by its chance.
            let chances = decomposition.chances(p);
            let quota: f64 = (0..decomposition.terms())
                .map(|i| {
                    let mean_of = |f: &dyn Fn(f64) -> f64| -> f64 {
                        let cells = CELLS.iter().zip(joint.chances());
                        cells.map(|(&(a, b), c)| c * f(decomposition.value(p, i, a, b))).sum()
                    };
                    chances[i] * (mean_of(&|x| x * x) - mean_of(&|x| x).powi(2))
                })
                .sum();
            let found = decomposition.quota_variance(p, &joint);
            assert!((found - quota).abs() < 1e-11 * total.max(1.0));
            assert!(found <= total + 1e-12, "quotas never do worse");
        }
    }
    // Constants drop out: with quotas, the two forms that differ by constants are one.
    let joint = Joint::independent(0.4, 0.7).expect("sound");
    let p = [0.2, 0.3, 0.5];
    let [first, second] = [Decomposition::InclusionExclusion, Decomposition::Balanced]
        .map(|decomposition| decomposition.quota_variance(p, &joint));
    assert!((first - second).abs() < 1e-12);
}

/// What is asked is what the value needs: an answer that was not asked for changes nothing.
#[test]
fn what_is_not_asked_does_not_matter() {
    let all = SUMS.into_iter().chain([Decomposition::Residual { q: 0.3, u: 0.6 }]);
    for decomposition in all {
        let p = [0.2, 0.3, 0.5];
        for choice in 0..decomposition.terms() {
            let needs = decomposition.needs(choice);
            assert!(needs.a || matches!(needs.b, Need::Never | Need::Always));
            for (a, b) in CELLS {
                let value = decomposition.value(p, choice, a, b);
                if !needs.a {
                    assert_eq!(value, decomposition.value(p, choice, !a, b), "{decomposition:?} {choice}");
                }
                if !needs.b.given(a) {
                    assert_eq!(value, decomposition.value(p, choice, a, !b), "{decomposition:?} {choice}");
                }
            }
            // Nor is anything asked in vain.
            let matters = |f: &dyn Fn(bool) -> bool| [false, true].into_iter().any(f);
            assert!(
                !needs.a
                    || matters(&|b| {
                        decomposition.value(p, choice, false, b) != decomposition.value(p, choice, true, b)
                    })
            );
            for a in [false, true] {
                assert!(
                    !needs.b.given(a) || {
                        decomposition.value(p, choice, a, false) != decomposition.value(p, choice, a, true)
                    }
                );
            }
        }
    }
}

/// The groups an estimator asks, in turn.
fn asked(estimator: &impl Estimator, u: f32, a: bool, b: bool) -> Vec<Group> {
    let mut asked = Vec::new();
    estimator.estimate(u, |group| {
        asked.push(group);
        if group == Group::A { a } else { b }
    });
    asked
}

#[test]
fn groups_are_asked_lazily_and_once() {
    use Group::{A, B};
    for (a, b) in CELLS {
        let lazy = if a { vec![A, B] } else { vec![A] };
        assert_eq!(asked(&Exact, 0.5, a, b), lazy);
        for form in [Decomposition::InclusionExclusion, Decomposition::Balanced, Decomposition::Power(8)] {
            let one = OneTerm::new(form, &Probabilities::UNIFORM).expect("sound");
            let power = matches!(form, Decomposition::Power(_));
            let third = if power || !a { vec![A, B] } else { vec![A] };
            for (u, expected) in [(0.1, vec![A]), (0.5, vec![B]), (0.9, third)] {
                assert_eq!(asked(&one, u, a, b), expected, "{form:?} {u}");
            }
        }
        let residual = Decomposition::Residual { q: 0.25, u: 0.5 };
        let one = OneTerm::new(residual, &Probabilities::UNIFORM).expect("sound");
        assert_eq!(asked(&one, 0.1, a, b), vec![A]);
        assert_eq!(asked(&one, 0.9, a, b), lazy);
    }
}

#[test]
fn importance_sampling_has_exactly_the_variance_of_equal_probabilities() {
    // In fractions: weights of a grid of joint distributions with every term present.
    let form = Decomposition::InclusionExclusion;
    for weights in [[1, 2, 3, 4], [7, 1, 1, 1], [0, 5, 1, 9], [1, 0, 8, 2], [3, 3, 3, 3], [0, 0, 0, 1]] {
        let sum: i128 = weights.iter().sum();
        let mean = |i: usize, absolute: bool| {
            CELLS.iter().zip(weights).fold(ZERO, |total, (&(a, b), weight)| {
                let s = terms(form, a, b)[i];
                let s = if absolute { fraction(s.0.abs(), s.1) } else { s * s };
                total + s * fraction(weight, sum)
            })
        };
        let importance = [0, 1, 2].map(|i| mean(i, true));
        let whole = importance[0] + importance[1] + importance[2];
        let square =
            |p: &dyn Fn(usize) -> Fraction| (0..3).fold(ZERO, |total, i| total + mean(i, false).over(p(i)));
        assert_eq!(square(&|i| importance[i].over(whole)), square(&|_| fraction(1, 3)), "{weights:?}");

        // And as the kernel finds them.
        let joint = Joint::new(weights.map(|w| w as f64)).expect("sound");
        let p = Probabilities::importance(&form, &joint, 0.0).expect("every term contributes");
        let [important, uniform] =
            [p, Probabilities::UNIFORM].map(|p| form.total_variance(p.chances(), &joint));
        assert!((important - uniform).abs() < 1e-6 * uniform, "{weights:?}: {important} {uniform}");
    }
    // A term that never contributes is the one thing it finds.
    let never = Joint::new([0.5, 0.0, 0.5, 0.0]).expect("sound");
    assert!(Probabilities::importance(&form, &never, 0.0).is_err());
    let p = Probabilities::importance(&form, &never, 1e-3).expect("none below the least");
    assert!(form.total_variance(p.chances(), &never) < form.total_variance([1.0 / 3.0; 3], &never));
}

/// Variance times cost at the optimum against equal and importance probabilities, and against a search around it.
#[test]
fn optimal_probabilities_are_optimal() {
    let mut random = Random::new(3);
    let mut gained = 0.0f64;
    for _ in 0..300 {
        let joint = Joint::new([0; 4].map(|_| f64::from(random.unit()) + 0.01)).expect("sound");
        let [a, b, fixed] = [0; 3].map(|_| f64::from(random.unit()) * 4.0 + 0.05);
        for form in [Decomposition::InclusionExclusion, Decomposition::Balanced, Decomposition::Power(8)] {
            let costs = form.costs(&joint, fixed, a, b);
            let work = |p: [f64; 3]| form.total_variance(p, &joint) * form.mean_cost(p, &costs);
            let best =
                Probabilities::optimal(&form, &joint, &costs, 0.0).expect("every term contributes").chances();
            let least = work(best);
            let uniform = work(Probabilities::UNIFORM.chances());
            let importance =
                Probabilities::importance(&form, &joint, 0.0).expect("every term contributes").chances();
            assert!(least <= uniform * (1.0 + 1e-6), "{form:?} {joint:?}: {least} {uniform}");
            assert!(least <= work(importance) * (1.0 + 1e-6), "{form:?} {joint:?}");
            gained = gained.max(uniform / least);
            for step in [1e-1, 1e-2, 1e-3] {
                for (i, j) in [(0, 1), (0, 2), (1, 2), (1, 0), (2, 0), (2, 1)] {
                    let mut p = best;
                    let moved = step * p[i].min(p[j]);
                    (p[i], p[j]) = (p[i] + moved, p[j] - moved);
                    assert!(least <= work(p) * (1.0 + 1e-6), "{form:?} {joint:?} {costs:?}: {best:?} {p:?}");
                }
            }
        }
    }
    assert!(gained > 2.0, "the choice never mattered: {gained}");
}

#[test]
fn the_best_residual_is_the_best_residual() {
    let mut random = Random::new(4);
    for _ in 0..300 {
        let joint = Joint::new([0; 4].map(|_| f64::from(random.unit()).powi(3) + 1e-4)).expect("sound");
        let [a, b] = [0; 2].map(|_| f64::from(random.unit()) * 4.0 + 0.05);
        let work = |form: Decomposition| {
            form.total_variance([0.0; 3], &joint) * form.mean_cost([0.0; 3], &form.costs(&joint, 0.0, a, b))
        };
        let form = Decomposition::best_residual(&joint, a, b, 1e-6);
        let Decomposition::Residual { q, u } = form.checked().expect("sound") else { panic!("{form:?}") };
        let least = work(form);
        for factor in [0.5, 0.9, 0.99, 1.01, 1.1, 2.0] {
            let other_q = Decomposition::Residual { q: (q * factor).min(1.0), u };
            let other_u = Decomposition::Residual { q, u: u * factor };
            assert!(least <= work(other_q) * (1.0 + 1e-5), "{joint:?}: {q} {factor}");
            assert!(least <= work(other_u) * (1.0 + 1e-5), "{joint:?}: {u} {factor}");
        }
    }
    let certain = Decomposition::best_residual(&Joint::certain(true, true), 1.0, 1.0, 0.25);
    assert_eq!(certain, Decomposition::Residual { q: 0.25, u: 1.0 });
}

/// All results of recursive halving with their chances: each node's choice and each blocker enumerated.
fn outcomes(decomposition: Decomposition, p: [f64; 3], visible: &[bool]) -> Vec<(f64, f64)> {
    if let [one] = visible {
        return vec![(1.0, f64::from(u8::from(*one)))];
    }
    let (a, b) = visible.split_at(visible.len().div_ceil(2));
    let (a, b) = (outcomes(decomposition, p, a), outcomes(decomposition, p, b));
    let mut all = Vec::new();
    for &(chance_a, a) in &a {
        for &(chance_b, b) in &b {
            let values = match decomposition {
                Decomposition::InclusionExclusion => [a, b, (1.0 - a) * (1.0 - b) - 1.0],
                _ => [a - 1.0 / 3.0, b - 1.0 / 3.0, (1.0 - a) * (1.0 - b) - 1.0 / 3.0],
            };
            all.extend((0..3).map(|i| (chance_a * chance_b * p[i], values[i] / p[i])));
        }
    }
    all
}

#[test]
fn halving_by_every_outcome() {
    let p = Probabilities::new([0.5, 0.3, 0.2]).expect("positive");
    for decomposition in [Decomposition::InclusionExclusion, Decomposition::Balanced] {
        for probabilities in [Probabilities::UNIFORM, p] {
            let halving = Halving::new(decomposition, &probabilities).expect("linear");
            for count in 1..=5usize {
                for pattern in 0..1u32 << count {
                    let visible: Vec<bool> = (0..count).map(|i| pattern >> i & 1 == 1).collect();
                    let all = outcomes(decomposition, probabilities.chances(), &visible);
                    let mean: f64 = all.iter().map(|(chance, x)| chance * x).sum();
                    let square: f64 = all.iter().map(|(chance, x)| chance * x * x).sum();
                    let v = if visible.iter().all(|&v| v) { 1.0 } else { 0.0 };
                    assert!((mean - v).abs() < 1e-12 * square.max(1.0), "{visible:?}: {mean}");
                    let variance = halving.variance(&visible);
                    assert!(
                        (square - v - variance).abs() < 1e-11 * square.max(1.0),
                        "{visible:?}: {variance}"
                    );
                }
            }
        }
    }
}

#[test]
fn the_variance_of_halving_is_a_power_of_three() {
    let halving = Halving::new(Decomposition::Balanced, &Probabilities::UNIFORM).expect("linear");
    for (n, expected) in [(1, 0.0), (2, 2.0), (3, 8.0), (4, 26.0), (8, 2186.0), (16, 14_348_906.0)] {
        let found = halving.variance(&vec![true; n]);
        assert!((found - expected).abs() <= 1e-6 * expected, "{n}: {found}");
    }
}

#[test]
fn levels_by_every_outcome() {
    let reach = [1.0f32, 0.75, 0.75, 0.1];
    let levels = Levels::new(&reach).expect("they fall");
    for blocked in [None, Some(0), Some(1), Some(2), Some(3)] {
        let visible = |level| blocked != Some(level);
        // As many levels are asked with the chance that the last is reached and the next is not.
        let (mut mean, mut square) = (0.0, 0.0);
        for depth in 0..=4usize {
            let chance = |level: usize| match level {
                0 => 1.0,
                level => reach.get(level - 1).map_or(0.0, |&q| f64::from(q)),
            };
            let share = chance(depth) - chance(depth + 1);
            if share == 0.0 {
                continue;
            }
            let u = (chance(depth) - share / 2.0) as f32;
            assert_eq!(levels.depth(u), depth);
            let asked = Cell::new(0);
            let value = levels.estimate(u, |level| {
                asked.set(asked.get() + 1);
                visible(level)
            });
            assert_eq!(asked.get(), depth.min(blocked.map_or(4, |level| level + 1)));
            let met = blocked.filter(|&level| level < depth);
            assert_eq!(value, levels.value(met));
            mean += share * f64::from(value);
            square += share * f64::from(value).powi(2);
        }
        let v = if blocked.is_none() { 1.0 } else { 0.0 };
        assert!((mean - v).abs() < 1e-6, "{blocked:?}: {mean}");
        assert!((square - v - levels.variance(blocked)).abs() < 1e-5, "{blocked:?}");
    }
    let first = [0.1, 0.2, 0.0, 0.3];
    let mean: f64 = first.iter().enumerate().map(|(i, f)| f * levels.variance(Some(i))).sum();
    assert!((levels.mean_variance(&first) - mean).abs() < 1e-12);
    assert!((levels.total_variance(&first) - mean - 0.6 * 0.4).abs() < 1e-12);
}

/// Two levels with a first that is always asked are the plain residual.
#[test]
fn two_levels_are_the_plain_residual() {
    let (levels, residual) = ([1.0f32, 0.25], Decomposition::Residual { q: 0.25, u: 1.0 });
    let levels = Levels::new(&levels).expect("they fall");
    let joint = Joint::new([0.1, 0.2, 0.3, 0.4]).expect("sound");
    let first = [1.0 - joint.a_visible(), joint.a_visible() - joint.visibility()];
    let total = residual.total_variance([0.0; 3], &joint);
    assert!((levels.total_variance(&first) - total).abs() < 1e-7, "{total}");
}

#[test]
fn the_best_levels_are_the_best_levels() {
    let mut random = Random::new(5);
    let work = |reach: &[f32], first: &[f64], costs: &[f64]| {
        let mut free = 1.0;
        let mut cost = 0.0;
        for i in 0..reach.len() {
            cost += costs[i] * free * f64::from(reach[i]);
            free -= first[i];
        }
        cost * Levels::new(reach).expect("they fall").total_variance(first)
    };
    let mut whole = 0;
    for _ in 0..500 {
        let count = 1 + random.below(6);
        let mut free = 1.0;
        let first: Vec<f64> = (0..count)
            .map(|_| {
                let blocked = free * f64::from(random.unit()).powi(3);
                free -= blocked;
                blocked
            })
            .collect();
        let costs: Vec<f64> = (0..count).map(|_| f64::from(random.unit()) + 0.05).collect();
        let mut best = vec![0.0; count];
        Levels::best(&first, &costs, 1e-6, &mut best);
        let least = work(&best, &first, &costs);
        whole += usize::from(best.iter().all(|&q| q == 1.0));
        assert_eq!(best[0], 1.0);
        for _ in 0..200 {
            // Neighbours that fall too, near and far.
            let far = 10.0f32.powf(random.between(-4.0, 0.0));
            let mut last = 1.0f32;
            let other: Vec<f32> = best
                .iter()
                .map(|&q| {
                    last = (q * (far * random.between(-1.0, 1.0)).exp()).min(last).max(1e-6);
                    last
                })
                .collect();
            let found = work(&other, &first, &costs);
            assert!(least <= found * (1.0 + 1e-5) + 1e-12, "{first:?} {costs:?}: {best:?} {other:?}");
        }
    }
    assert!((1..400).contains(&whole), "{whole} of 500 ask all");
}

#[test]
fn unsound_numbers_are_refused() {
    let uniform = Probabilities::UNIFORM;
    let refused = |decomposition| OneTerm::new(decomposition, &uniform).unwrap_err();
    assert_eq!(refused(Decomposition::Power(1)), EstimatorError::Power(1));
    assert_eq!(refused(Decomposition::Power(65)), EstimatorError::Power(65));
    for q in [0.0, -0.1, 1.5, f32::NAN] {
        assert!(matches!(refused(Decomposition::Residual { q, u: 1.0 }), EstimatorError::Chance(_)));
    }
    assert!(matches!(refused(Decomposition::Residual { q: 0.5, u: f32::NAN }), EstimatorError::Guess(_)));
    let nested = Halving::new(Decomposition::Power(8), &uniform).unwrap_err();
    assert_eq!(nested, EstimatorError::PowerNested);
    assert!(nested.to_string().contains("cannot be nested"));
    for weights in [[0.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, f64::NAN], [1.0, f64::INFINITY, 1.0]] {
        assert!(Probabilities::new(weights).is_err(), "{weights:?}");
    }
    for reach in [&[1.0f32, 0.0][..], &[0.5, 0.6], &[1.5], &[f32::NAN]] {
        assert!(Levels::new(reach).is_err(), "{reach:?}");
    }
    assert_eq!(Joint::new([0.0; 4]), None);
    assert_eq!(Joint::new([1.0, -1.0, 1.0, 1.0]), None);
    assert_eq!(Tally::default().joint(), None);
    let mut tally = Tally::default();
    CELLS.into_iter().chain([(true, false); 4]).for_each(|(a, b)| tally.add(a, b));
    assert_eq!(tally.joint(), Joint::new([1.0, 1.0, 5.0, 1.0]));
}
