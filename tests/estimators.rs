//! Estimators by sampling: means that are V and variances that are the closed forms.
//!
//! A million samples for each estimator, each rule of probabilities and each (V_A, V_B). Every figure is compared
//! with its closed form in units of its own standard error, which follows from the estimator's outcomes and not from
//! the samples. A file of `N` comparisons fails by chance once in a million runs: two-sided, at `1e-6 / N` each.

use occlude_kernel::{
    Decomposition, Estimator, Exact, Group, Halving, Joint, Levels, OneTerm, Probabilities, Quotas, Tally,
};
use occlude_tests::Random;
use std::collections::BTreeMap;

const CELLS: [(bool, bool); 4] = [(false, false), (false, true), (true, false), (true, true)];
const SAMPLES: u32 = 1_000_000;

/// Two-sided at 1e-6 over some 500 comparisons: 2e-9, which is six standard errors.
const LIMIT: f64 = 6.0;

/// Values with their chances.
type Outcomes = Vec<(f64, f64)>;

fn moment(outcomes: &Outcomes, power: i32, about: f64) -> f64 {
    outcomes.iter().map(|(chance, value)| chance * (value - about).powi(power)).sum()
}

/// Compares mean and variance of samples with those of the outcomes they are drawn from.
fn check(what: &str, samples: impl Iterator<Item = f64>, outcomes: &Outcomes, v: f64) {
    let (mut count, mut sum, mut square) = (0.0, 0.0, 0.0);
    for sample in samples {
        count += 1.0;
        sum += sample - v;
        square += (sample - v) * (sample - v);
    }
    let (variance, fourth) = (moment(outcomes, 2, v), moment(outcomes, 4, v));
    let off = sum / count;
    // A rounding of a single-precision estimate is no bias worth speaking of.
    let error = (variance / count).sqrt() + 1e-7 * (1.0 + variance).sqrt();
    assert!(off.abs() < LIMIT * error, "{what}: the mean is off by {off}, {} standard errors", off / error);
    let error = ((fourth - variance * variance).max(0.0) / count).sqrt() + 1e-6 * variance;
    let off = square / count - variance;
    assert!(off.abs() <= LIMIT * error, "{what}: variance off by {off} of {variance}, error {error}");
}

fn outcomes(one: &OneTerm, a: bool, b: bool) -> Outcomes {
    let chances = one.chances();
    (0..3).map(|i| (chances[i], one.decomposition().value(chances, i, a, b))).filter(|o| o.0 > 0.0).collect()
}

/// Every rule, for this distribution of (V_A, V_B) and groups of unlike costs.
fn rules(form: &Decomposition, joint: &Joint) -> [(&'static str, Probabilities); 4] {
    let costs = form.costs(joint, 0.3, 1.0, 2.5);
    let sound = "every term gets something";
    [
        ("uniform", Probabilities::UNIFORM),
        ("given", Probabilities::new([0.25, 0.15, 0.6]).expect(sound)),
        ("importance", Probabilities::importance(form, joint, 0.05).expect(sound)),
        ("optimal", Probabilities::optimal(form, joint, &costs, 0.05).expect(sound)),
    ]
}

fn forms() -> Vec<Decomposition> {
    vec![
        Decomposition::InclusionExclusion,
        Decomposition::Balanced,
        Decomposition::Power(3),
        Decomposition::Power(8),
        Decomposition::Residual { q: 0.2, u: 1.0 },
        Decomposition::Residual { q: 0.45, u: 0.7 },
        Decomposition::Residual { q: 1.0, u: -2.0 },
    ]
}

fn ask(a: bool, b: bool) -> impl FnMut(Group) -> bool {
    move |group| if group == Group::A { a } else { b }
}

/// (V_A, V_B) of that distribution.
fn draw(joint: &Joint, random: &mut Random) -> (bool, bool) {
    let mut at = f64::from(random.unit());
    for (cell, chance) in CELLS.into_iter().zip(joint.chances()) {
        if at < chance {
            return cell;
        }
        at -= chance;
    }
    CELLS[3]
}

#[test]
fn one_term_is_right_on_average() {
    let mut random = Random::new(11);
    let joint = Joint::new([0.2, 0.1, 0.3, 0.4]).expect("sound");
    for form in forms() {
        for (rule, probabilities) in rules(&form, &joint) {
            let one = OneTerm::new(form, &probabilities).expect("sound");
            for (a, b) in CELLS {
                let v = f64::from(Exact.estimate(0.0, ask(a, b)));
                assert_eq!(v == 1.0, a && b);
                let what = format!("{form:?}, {rule}, {a} {b}");
                let outcomes = outcomes(&one, a, b);
                assert!((moment(&outcomes, 2, v) - one.variance(a, b)).abs() < 1e-9, "{what}");
                let samples = (0..SAMPLES).map(|_| f64::from(one.estimate(random.unit(), ask(a, b))));
                check(&what, samples, &outcomes, v);
                // With quotas, too; the samples of a point are not independent, so points are the samples.
                let points = SAMPLES / 50;
                let means = (0..points).map(|_| {
                    let quotas = Quotas::new(50, random.unit(), random.bits() as u32);
                    (0..50).map(|k| f64::from(one.estimate(quotas.number(k), ask(a, b)))).sum::<f64>() / 50.0
                });
                let means: Vec<f64> = means.collect();
                let mean = means.iter().sum::<f64>() / f64::from(points);
                let spread = means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / f64::from(points - 1);
                let error = (spread / f64::from(points)).sqrt() + 1e-6 * (1.0 + one.variance(a, b)).sqrt();
                assert!((mean - v).abs() < LIMIT * error, "{what}: quotas, mean {mean} +- {error}");
            }
        }
    }
}

/// At random (V_A, V_B): the total variance, and with quotas that of `sum Var(s_i) / p_i`.
#[test]
fn variances_at_random_visibilities() {
    let mut random = Random::new(12);
    let weights = [0.2, 0.1, 0.3, 0.4];
    let joint = Joint::new(weights).expect("sound");
    let v = joint.visibility();
    for form in forms() {
        for (rule, probabilities) in rules(&form, &joint) {
            // Quotas of whole samples, so that the closed form is that of these numbers.
            let probabilities = if rule == "given" {
                Probabilities::new([0.25, 0.25, 0.5]).expect("positive")
            } else {
                probabilities
            };
            let one = OneTerm::new(form, &probabilities).expect("sound");
            let all: Outcomes = CELLS
                .iter()
                .zip(joint.chances())
                .flat_map(|(&(a, b), cell)| {
                    outcomes(&one, a, b).into_iter().map(move |(chance, x)| (cell * chance, x))
                })
                .collect();
            let what = format!("{form:?}, {rule}, random");
            assert!((moment(&all, 2, v) - one.total_variance(&joint)).abs() < 1e-9, "{what}");
            let samples = (0..SAMPLES).map(|_| {
                let (a, b) = draw(&joint, &mut random);
                f64::from(one.estimate(random.unit(), ask(a, b)))
            });
            check(&what, samples, &all, v);

            if rule == "given" && !matches!(form, Decomposition::Residual { .. }) {
                const EACH: u32 = 64;
                let points = SAMPLES / EACH;
                let squares: Vec<f64> = (0..points)
                    .map(|_| {
                        let quotas = Quotas::new(EACH, random.unit(), random.bits() as u32);
                        let sum: f64 = (0..EACH)
                            .map(|k| {
                                let (a, b) = draw(&joint, &mut random);
                                f64::from(one.estimate(quotas.number(k), ask(a, b)))
                            })
                            .sum();
                        (sum / f64::from(EACH) - v).powi(2) * f64::from(EACH)
                    })
                    .collect();
                let mean = squares.iter().sum::<f64>() / f64::from(points);
                // Sums of 64 are all but normal: the square's deviation is the root of two times its mean.
                let expected = one.quota_variance(&joint);
                let error = expected * (2.2 / f64::from(points)).sqrt();
                assert!((mean - expected).abs() < LIMIT * error, "{what}: quotas {mean}, not {expected}");
                assert!(expected < one.total_variance(&joint) - LIMIT * error, "{what}: quotas gain nothing");
            }
        }
    }
}

/// The probability that a sample takes a term is p to the last bit, whatever its place among the samples: all 2²⁴
/// offsets.
#[test]
fn quotas_take_every_term_with_its_very_probability() {
    let probabilities = Probabilities::new([0.123, 0.456, 0.421]).expect("positive");
    let one = OneTerm::new(Decomposition::Balanced, &probabilities).expect("sound");
    let expected = one.chances().map(|chance| (chance * 16_777_216.0) as u32);
    for (samples, sample) in [(1, 0), (5, 3), (6, 0), (64, 17)] {
        let mut counts = [0u32; 3];
        for offset in 0..1u32 << 24 {
            let quotas = Quotas::new(samples, offset as f32 / 16_777_216.0, 99);
            counts[one.choose(quotas.number(sample))] += 1;
        }
        assert_eq!(counts, expected, "sample {sample} of {samples}");
    }
}

#[test]
fn quotas_are_met() {
    let mut random = Random::new(13);
    for samples in (1..100).chain([1000, 65_536]) {
        for _ in 0..20 {
            let weights = [0; 3].map(|_| f64::from(random.unit()) + 0.001);
            let probabilities = Probabilities::new(weights).expect("positive");
            let one = OneTerm::new(Decomposition::Balanced, &probabilities).expect("sound");
            let quotas = Quotas::new(samples, random.unit(), random.bits() as u32);
            let mut counts = [0u32; 3];
            (0..samples).for_each(|k| counts[one.choose(quotas.number(k))] += 1);
            for (count, chance) in counts.into_iter().zip(one.chances()) {
                let due = chance * f64::from(samples);
                let off = f64::from(count) - due;
                assert!(off.abs() < 1.0, "{samples} samples: {count} took what {due} should");
            }
        }
    }
}

/// The choice must not run along with the samples' order: neighbours take the same of two terms half of the time.
#[test]
fn quotas_are_shuffled() {
    let mut random = Random::new(14);
    let (points, samples) = (20_000u32, 64u32);
    for lag in [1u32, 2, 8, 32] {
        let mut same = 0u32;
        for _ in 0..points {
            let quotas = Quotas::new(samples, random.unit(), random.bits() as u32);
            let first = |k: u32| quotas.number(k) < 0.5;
            same += u32::from(first(7) == first(7 + lag));
        }
        // Of the other 63, 31 are in the same half.
        let (share, expected) = (f64::from(same) / f64::from(points), 31.0 / 63.0);
        let error = (0.25 / f64::from(points)).sqrt();
        assert!((share - expected).abs() < LIMIT * error, "lag {lag}: {share}");
    }
}

/// The thesis: 64 test rays a point say what each term contributes. Unbiased, since other rays are then used.
#[test]
fn learned_probabilities_stay_right() {
    let mut random = Random::new(15);
    let joint = Joint::new([0.02, 0.18, 0.3, 0.5]).expect("sound");
    let v = joint.visibility();
    type Learn = fn(&Decomposition, &Joint) -> OneTerm;
    let importance: Learn = |form, joint| {
        let p = Probabilities::importance(form, joint, 1.0 / 128.0).expect("a least share");
        OneTerm::new(*form, &p).expect("sound")
    };
    let optimal: Learn = |form, joint| {
        let p = Probabilities::optimal(form, joint, &form.costs(joint, 0.5, 1.0, 1.0), 1.0 / 128.0);
        OneTerm::new(*form, &p.expect("a least share")).expect("sound")
    };
    let residual: Learn = |_, joint| {
        let form = Decomposition::best_residual(joint, 1.0, 1.0, 1.0 / 16.0);
        OneTerm::new(form, &Probabilities::UNIFORM).expect("sound")
    };
    for (form, learn) in [
        (Decomposition::InclusionExclusion, importance),
        (Decomposition::Balanced, optimal),
        (Decomposition::Power(8), optimal),
        (Decomposition::Balanced, residual),
    ] {
        let points = 20_000;
        let means: Vec<f64> = (0..points)
            .map(|_| {
                let mut tally = Tally::default();
                for _ in 0..64 {
                    let (a, b) = draw(&joint, &mut random);
                    tally.add(a, b);
                }
                let one = learn(&form, &tally.joint().expect("64 rays"));
                let sum: f64 = (0..50)
                    .map(|_| {
                        let (a, b) = draw(&joint, &mut random);
                        f64::from(one.estimate(random.unit(), ask(a, b)))
                    })
                    .sum();
                sum / 50.0
            })
            .collect();
        let mean = means.iter().sum::<f64>() / f64::from(points);
        let spread = means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / f64::from(points - 1);
        let error = (spread / f64::from(points)).sqrt();
        assert!((mean - v).abs() < LIMIT * error, "{form:?}: {mean} +- {error}, not {v}");
    }
}

/// The distribution of recursive halving with nothing in the way. Estimates are whole numbers, so equal ones merge.
fn halving_outcomes(n: usize) -> Outcomes {
    if n == 1 {
        return vec![(1.0, 1.0)];
    }
    let (a, b) = (halving_outcomes(n.div_ceil(2)), halving_outcomes(n / 2));
    let mut all = BTreeMap::new();
    for &(chance_a, a) in &a {
        for &(chance_b, b) in &b {
            for value in [3.0 * a - 1.0, 3.0 * b - 1.0, 3.0 * (1.0 - a) * (1.0 - b) - 1.0] {
                *all.entry(value as i64).or_insert(0.0) += chance_a * chance_b / 3.0;
            }
        }
    }
    all.into_iter().map(|(value, chance)| (chance, value as f64)).collect()
}

/// 3^(n - 1) - 1, measured.
#[test]
fn the_variance_of_halving_explodes() {
    let mut random = Random::new(16);
    let halving = Halving::new(Decomposition::Balanced, &Probabilities::UNIFORM).expect("linear");
    for n in [2usize, 4, 8] {
        let outcomes = halving_outcomes(n);
        let variance = 3.0f64.powi(n as i32 - 1) - 1.0;
        assert!((moment(&outcomes, 2, 1.0) - variance).abs() < 1e-9 * variance);
        let mut square = 0.0;
        let samples: Vec<f64> =
            (0..SAMPLES).map(|_| halving.estimate(n, || random.unit(), |_| true)).collect();
        samples.iter().for_each(|x| square += (x - 1.0) * (x - 1.0) / f64::from(SAMPLES));
        println!("n = {n}: variance {square:.3} measured, {variance} by the formula");
        check(&format!("{n} halved"), samples.into_iter(), &outcomes, 1.0);
    }
}

#[test]
fn halving_is_right_whoever_blocks() {
    let mut random = Random::new(17);
    for form in [
        Decomposition::InclusionExclusion,
        Decomposition::Balanced,
        Decomposition::Residual { q: 0.5, u: 0.8 },
    ] {
        let halving = Halving::new(form, &Probabilities::UNIFORM).expect("linear");
        for visible in [[true; 3], [true, false, true], [false, true, true], [false; 3], [true, true, false]]
        {
            let v = if visible.iter().all(|&v| v) { 1.0 } else { 0.0 };
            let (mut sum, mut square) = (0.0, 0.0);
            for _ in 0..SAMPLES {
                let x = halving.estimate(3, || random.unit(), |i| visible[i]) - v;
                (sum, square) = (sum + x, square + x * x);
            }
            let n = f64::from(SAMPLES);
            let variance = halving.variance(&visible);
            let error = (variance / n).sqrt() + 1e-6;
            assert!((sum / n).abs() < LIMIT * error, "{form:?} {visible:?}: {}", sum / n);
            // Outcomes of three reach 11 in size; their squares' deviation is at most that times their root.
            let error = 12.0 * (variance / n).sqrt() + 1e-5 * variance;
            assert!((square / n - variance).abs() <= LIMIT * error, "{form:?} {visible:?}: {}", square / n);
        }
    }
}

#[test]
fn levels_are_right_on_average() {
    let mut random = Random::new(18);
    let mut even = [0.0f32; 5];
    Levels::even(&mut even);
    assert_eq!(even, [1.0, 0.8, 0.6, 0.4, 0.2]);
    let mut best = [0.0f32; 5];
    Levels::best(&[0.3, 0.1, 0.15, 0.05, 0.02], &[1.0, 1.0, 1.0, 2.0, 4.0], 0.05, &mut best);
    for reach in [even, best, [0.9, 0.9, 0.3, 0.05, 0.05]] {
        let levels = Levels::new(&reach).expect("they fall");
        for blocked in [None, Some(0), Some(1), Some(2), Some(3), Some(4)] {
            let v = if blocked.is_none() { 1.0 } else { 0.0 };
            let outcomes = match blocked {
                None => vec![(1.0, 1.0)],
                Some(level) => {
                    let q = f64::from(reach[level]);
                    vec![(q, 1.0 - 1.0 / q), (1.0 - q, 1.0)]
                }
            };
            assert!((moment(&outcomes, 2, v) - levels.variance(blocked)).abs() < 1e-9);
            // Levels behind the first that blocks may say anything.
            let visible =
                |level| blocked.is_none_or(|first| level < first || (level > first && level % 2 == 0));
            let samples = (0..SAMPLES).map(|_| f64::from(levels.estimate(random.unit(), visible)));
            check(&format!("{reach:?}, blocked at {blocked:?}"), samples, &outcomes, v);
        }
    }
}
