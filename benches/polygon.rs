//! The light of a rectangle in closed form, above the horizon and across it.

use criterion::{Criterion, criterion_group, criterion_main};
use occlude_kernel::polygon::irradiance;
use std::hint::black_box;

fn rectangle(c: &mut Criterion) {
    let above = [[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [1.0, 1.0, 2.0], [-1.0, 1.0, 2.0]];
    let across = [[2.0, -1.0, -1.0], [2.0, 1.0, -1.0], [2.0, 1.0, 1.0], [2.0, -1.0, 1.0]];
    for (name, vertices) in [("above", above), ("across", across)] {
        c.bench_function(&format!("irradiance/{name}"), |b| {
            b.iter(|| irradiance(black_box([0.1, 0.2, 0.0]), [0.0, 0.0, 1.0], black_box(&vertices)));
        });
    }
}

criterion_group!(benches, rectangle);
criterion_main!(benches);
