//! The occlusion map: finding a cell, drawing samples from it, and making odds of what rays saw.
//!
//! A third of the cells are free of shadows, a third dark, and a border crosses the others.

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use occlude_kernel::occlusion_map::{
    BIN_EDGE, BINS, CellKey, Demand, Doubts, MapCell, OcclusionMap, Rates, Tally, bin,
};
use std::hint::black_box;

/// Spreads numbers evenly over [0, 1).
fn even(i: usize, by: f32) -> f32 {
    (i as f32 * by).fract()
}

/// Cells on a plane, so many along each edge of it, that face up.
fn cells(edge: usize) -> Vec<MapCell> {
    let key = |i: usize| {
        let x = [(i % edge) as f32 + 0.5, 0.5, (i / edge) as f32 + 0.5];
        CellKey::new(x, [0.0, 1.0, 0.0], 0, 0).expect("near the origin")
    };
    (0..edge * edge).map(|i| MapCell::new(key(i), [0.0, 1.0, 0.0])).collect()
}

/// What 16 rays to each bin of a cell saw.
fn tallies(cell: usize) -> [Tally; BINS] {
    let (slope, at) = (even(cell, 0.618) - 0.5, even(cell, 0.755) * BIN_EDGE as f32);
    std::array::from_fn(|bin| {
        let (column, row) = ((bin % BIN_EDGE) as f32, (bin / BIN_EDGE) as f32);
        let free = match cell % 3 {
            0 => 1.0,
            1 => 0.0,
            _ => (column - at + slope * row).clamp(0.0, 1.0),
        };
        Tally { asked: 16, free: (free * 16.0) as u32 }
    })
}

fn rates() -> Rates {
    let mut doubts = Doubts::default();
    for (class, (asked, squared)) in doubts.asked.iter_mut().zip(&mut doubts.squared).enumerate() {
        (*asked, *squared) = (10_000, (10_000 * 255 * 255 / 5) >> class);
    }
    doubts.rates(0.06)
}

fn find(c: &mut Criterion) {
    for (name, edge) in [("in the cache", 16), ("beyond the cache", 512)] {
        let cells = cells(edge);
        let mut table = vec![OcclusionMap::FREE; OcclusionMap::table(cells.len())];
        OcclusionMap::index(&cells, &mut table);
        let map = OcclusionMap::new(&cells, &table).expect("a power of two");
        let mut next = 0;
        c.bench_function(&format!("find/{name}"), |b| {
            b.iter(|| {
                next = (next + 7919) % cells.len();
                let at = [(next % edge) as f32 + 0.5, 0.5, (next / edge) as f32 + 0.5];
                let key = CellKey::new(black_box(at), [0.0, 1.0, 0.0], 0, 0)?;
                map.find(key).map(|found| map.cells()[found].known(at))
            });
        });
    }
}

fn draw(c: &mut Criterion) {
    let mut cell = cells(1)[0];
    cell.learn(MapCell::expect(&tallies(2)).as_ref(), &rates());
    assert!(!cell.is_flat(), "a border");
    let square: Vec<[f32; 2]> = (0..64).map(|i| [i as f32 / 64.0, even(i, 0.618)]).collect();
    c.bench_function("draw/64", |b| {
        b.iter(|| {
            let (mut guesses, mut weights) = (0.0, 0.0);
            for &at in black_box(&square) {
                let drawn = cell.draw(at);
                guesses += cell.odds(usize::from(drawn.bin)).guess();
                weights += 1.0 / drawn.density;
            }
            [guesses, weights]
        });
    });
    c.bench_function("bin/64", |b| {
        b.iter(|| black_box(&square).iter().map(|&at| bin(at)).sum::<usize>());
    });
}

fn learn(c: &mut Criterion) {
    let before = cells(32);
    let seen: Vec<_> = (0..before.len()).map(tallies).collect();
    let rates = rates();
    let mut group = c.benchmark_group("learn");
    group.throughput(criterion::Throughput::Elements(before.len() as u64));
    group.bench_function("expect", |b| {
        b.iter(|| black_box(&seen).iter().filter_map(MapCell::expect).map(|p| p[0]).sum::<f32>());
    });
    let expected: Vec<_> = seen.iter().map(MapCell::expect).collect();
    group.bench_function("demand", |b| {
        b.iter(|| {
            let mut demand = Demand::default();
            black_box(&expected).iter().flatten().for_each(|expected| demand.add(expected, 1.0, &rates));
            demand
        });
    });
    group.bench_function("odds", |b| {
        let learn = |mut cells: Vec<MapCell>| {
            for (cell, expected) in cells.iter_mut().zip(&expected) {
                cell.learn(expected.as_ref(), &rates);
            }
            cells
        };
        b.iter_batched(|| before.clone(), learn, BatchSize::LargeInput);
    });
    group.finish();
}

criterion_group!(benches, find, draw, learn);
criterion_main!(benches);
