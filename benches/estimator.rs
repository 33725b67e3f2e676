//! What an estimate costs beyond the visibility tests it asks for: groups answer from a table.
//!
//! `estimate` times 65,536 estimates at once, too many for their branches to be remembered; the throughput is what to
//! read. `learn` times what is done once for a point.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use occlude_kernel::{
    Decomposition, Estimator, Exact, Group, Halving, Joint, Levels, OneTerm, Probabilities, Quotas, Tally,
};
use std::hint::black_box;

const ESTIMATES: usize = 1 << 16;

/// Random numbers and answers.
struct Given {
    u: Vec<f32>,
    answers: Vec<[bool; 64]>,
}

impl Given {
    fn new() -> Self {
        let mut state = 0x9e37_79b9_7f4a_7c15u64;
        let mut word = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            state
        };
        let u = (0..ESTIMATES).map(|_| (word() >> 40) as f32 / 16_777_216.0).collect();
        let answers = (0..ESTIMATES)
            .map(|_| {
                let bits = word() | word() & word();
                std::array::from_fn(|i| bits >> i & 1 == 1)
            })
            .collect();
        Self { u, answers }
    }

    /// The sum over all of them.
    fn sum(&self, estimator: &impl Estimator) -> f32 {
        let mut sum = 0.0;
        for (&u, answers) in self.u.iter().zip(&self.answers) {
            sum += estimator.estimate(u, |group| answers[usize::from(group == Group::B)]);
        }
        sum
    }
}

fn estimates(c: &mut Criterion) {
    let given = Given::new();
    let mut group = c.benchmark_group("estimate");
    group.throughput(Throughput::Elements(ESTIMATES as u64));
    group.bench_function("exact", |b| b.iter(|| given.sum(&black_box(Exact))));
    let p = Probabilities::new([0.3, 0.3, 0.4]).expect("positive");
    for (name, form) in [
        ("inclusion", Decomposition::InclusionExclusion),
        ("balanced", Decomposition::Balanced),
        ("power:8", Decomposition::Power(8)),
        ("residual", Decomposition::Residual { q: 0.3, u: 0.8 }),
    ] {
        let one = OneTerm::new(form, &p).expect("sound");
        group.bench_function(name, |b| b.iter(|| given.sum(black_box(&one))));
    }
    let one = OneTerm::new(Decomposition::Balanced, &p).expect("sound");
    group.bench_function("balanced, quotas", |b| {
        b.iter(|| {
            let quotas = Quotas::new(black_box(ESTIMATES as u32), 0.3, 99);
            let mut sum = 0.0;
            for (k, answers) in (0u32..).zip(&given.answers) {
                sum += one.estimate(quotas.number(k), |group| answers[usize::from(group == Group::B)]);
            }
            sum
        });
    });
    for count in [2usize, 8, 64] {
        let mut reach = vec![0.0; count];
        Levels::even(&mut reach);
        group.bench_function(BenchmarkId::new("levels", count), |b| {
            b.iter(|| {
                let levels = Levels::new(black_box(&reach)).expect("they fall");
                let mut sum = 0.0;
                for (&u, answers) in given.u.iter().zip(&given.answers) {
                    sum += levels.estimate(u, |level| answers[level]);
                }
                sum
            });
        });
    }
    for count in [2usize, 8, 64] {
        let halving = Halving::new(Decomposition::Balanced, &p).expect("linear");
        group.bench_function(BenchmarkId::new("halving", count), |b| {
            b.iter(|| {
                let (mut sum, mut at) = (0.0, 0);
                for answers in &given.answers {
                    let u = || {
                        at = (at + 1) % ESTIMATES;
                        given.u[at]
                    };
                    sum += black_box(&halving).estimate(count, u, |i| answers[i]);
                }
                sum
            });
        });
    }
    group.finish();
}

/// What is done once for a point: probabilities from test rays, and the estimator that uses them.
fn learning(c: &mut Criterion) {
    let mut group = c.benchmark_group("learn");
    let mut tally = Tally::default();
    for i in 0..64 {
        tally.add(i % 3 != 0, i % 5 != 0);
    }
    let form = Decomposition::Balanced;
    let joint = || -> Joint { black_box(&tally).joint().expect("64 rays") };
    group.bench_function("uniform", |b| {
        b.iter(|| OneTerm::new(black_box(form), &Probabilities::UNIFORM));
    });
    group.bench_function("importance", |b| {
        b.iter(|| {
            let p = Probabilities::importance(&form, &joint(), 0.01).expect("a least share");
            OneTerm::new(form, &p)
        });
    });
    group.bench_function("optimal", |b| {
        b.iter(|| {
            let joint = joint();
            let p = Probabilities::optimal(&form, &joint, &form.costs(&joint, 0.1, 1.0, 1.0), 0.01);
            OneTerm::new(form, &p.expect("a least share"))
        });
    });
    group.bench_function("residual", |b| {
        b.iter(|| {
            OneTerm::new(Decomposition::best_residual(&joint(), 1.0, 1.0, 0.05), &Probabilities::UNIFORM)
        });
    });
    for count in [2usize, 8, 64] {
        let first: Vec<f64> = (0..count).map(|i| 0.5 / (count * (1 + i)) as f64).collect();
        let (costs, mut reach) = (vec![1.0; count], vec![0.0; count]);
        group.bench_function(BenchmarkId::new("levels", count), |b| {
            b.iter(|| Levels::best(black_box(&first), &costs, 0.05, &mut reach));
        });
    }
    group.finish();
}

criterion_group!(benches, estimates, learning);
criterion_main!(benches);
