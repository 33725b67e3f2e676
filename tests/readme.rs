//! The Rust code of the first README is this, so it compiles.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_kernel::{BatchScratch, Bvh, Targets, TilePoint, TileScratch, Uncounted};

struct Light {
    corner: Vec3,
    u: Vec3,
    v: Vec3,
}

/// What is blocked of a light from one point, and from several with a target each.
fn embedding(bvh: &Bvh<'_>, light: &Light, points: Vec<TilePoint>, ends: &[Vec3]) -> Option<[u64; 2]> {
    let [xs, ys, zs] = [0, 1, 2].map(|axis| ends.iter().map(|end| end[axis]).collect::<Vec<f32>>());
    let (mut batch, mut tile) = (BatchScratch::new(), TileScratch::new());
    let (mut blocked, x) = ([0; 1], points[0].x);
    let targets = Targets::new(&xs, &ys, &zs)?.on_parallelogram(light.corner, light.u, light.v);
    bvh.occluded_batch(x, &targets, None, &mut Uncounted, &mut batch, &mut blocked); // a point, 64 shadow rays
    let of_point = blocked[0];
    bvh.occluded_tile(&points, &targets, None, &mut Uncounted, &mut tile, &mut blocked); // and its neighbours
    Some([of_point, blocked[0]])
}

#[test]
fn embedding_works_as_shown() {
    let half = [[Vec3::new(0.501, -9.0, 1.0), Vec3::new(9.0, -9.0, 1.0), Vec3::new(0.501, 9.0, 1.0)]];
    let accel = Accel::from_triangles(&half, Quality::Fast);
    let light = Light { corner: Vec3::Z * 2.0, u: Vec3::X * 2.0, v: Vec3::Y };
    let ends: Vec<Vec3> = (0..64).map(|i| light.corner + light.u * (i as f32 / 64.0)).collect();
    let points: Vec<TilePoint> = (0..64u8)
        .map(|i| TilePoint { x: [0.0, f32::from(i) * 1e-3, 0.0], first: i.into(), count: 1 })
        .collect();
    let dark = u64::MAX << 33;
    assert_eq!(embedding(&accel.bvh(), &light, points, &ends), Some([dark, dark]));
}

#[test]
fn the_readme_shows_what_is_compiled_here() {
    let readme = include_str!("../README.md");
    let code = readme.split("```rust\n").nth(1).and_then(|rest| rest.split("```").next()).expect("a block");
    let mut lines = include_str!("readme.rs").lines().map(str::trim);
    for line in code.lines() {
        assert!(lines.any(|ours| ours == line), "not compiled: {line}");
    }
    assert_eq!(readme.matches("```rust").count(), 1, "one block");
}
