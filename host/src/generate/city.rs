//! A city: boxes of many heights, in blocks with streets between.

use super::dice::Dice;
use super::mesh::Mesh;
use crate::scene::Scene;
use glam::Vec3;

/// From so many boxes on, their faces are cut finer instead.
const MOST_BOXES: usize = 1 << 16;
/// From the middle of a lot to the middle of the next one in the block.
const LOT: f32 = 20.0;
/// A street runs after every fourth lot.
const BLOCK: usize = 4;
const STREET: f32 = 14.0;

/// Twelve triangles a box, and from 65 536 boxes on finer ones; to within 2 %.
///
/// Two buildings in three are one box, the others a box on another one, or on two.
pub(super) fn city(seed: u64, triangles: usize) -> Scene {
    let mut dice = Dice::new(seed);
    // Less ground and lights, which are six, and rounded, which is six more.
    let twelves = (triangles / 12).max(1);
    let boxes = twelves.min(MOST_BOXES);
    let cuts = (twelves / boxes).isqrt().max(1);
    let step = 2 * cuts + 1;
    let finer = (twelves.saturating_sub(boxes * cuts * cuts) + step / 2) / step;

    let lots = (boxes * 2).div_ceil(3);
    let mut tiers = vec![1_u32; lots];
    for _ in lots..boxes {
        tiers[dice.below(lots)] += 1;
    }

    let columns = lots.isqrt() + usize::from(lots.isqrt() * lots.isqrt() < lots);
    let place = |k: usize| k as f32 * LOT + (k / BLOCK) as f32 * STREET;
    let side = place(columns - 1) + LOT;
    let half = 0.5 * side;

    let room = boxes * 12 * (cuts + 1) * (cuts + 1);
    let room = room.min(triangles + triangles / 32) + 64;
    let mut mesh = Mesh::new("city", room, room / 2 + 2 * boxes + 64);
    mesh.ground(1.15 * half, [0.42, 0.42, 0.43]);
    let sky = Vec3::new(0.0, 90.0 + 0.7 * side, 0.0);
    mesh.light("sky", sky, [half, half], [2.2, 2.7, 3.7]);
    let lamp = Vec3::new(0.35 * side, 90.0 + 0.45 * side, 0.2 * side);
    mesh.light("lamp", lamp, [0.02 * side; 2], [2300.0, 1950.0, 1400.0]);
    let walls = [
        mesh.matte("concrete", [0.6, 0.59, 0.56]),
        mesh.matte("brick", [0.56, 0.3, 0.22]),
        mesh.matte("sandstone", [0.7, 0.58, 0.42]),
        mesh.matte("glass", [0.3, 0.4, 0.46]),
    ];

    mesh.object("buildings");
    let mut built = 0;
    for (lot, &tiers) in tiers.iter().enumerate() {
        let x = place(lot % columns) + 0.5 * LOT - half;
        let z = place(lot / columns) + 0.5 * LOT - half;
        // Higher towards the middle, and now and then a tower.
        let middle = 1.0 - (x * x + z * z) / (2.0 * half * half);
        let rare = dice.unit();
        let mut height = 8.0 + 14.0 * dice.unit() + 55.0 * middle.max(0.0) * rare * rare * rare;
        let (mut wide, mut deep) = (dice.between(0.32, 0.46) * LOT, dice.between(0.32, 0.46) * LOT);
        // The foot is below the ground: nothing is coplanar with anything.
        let mut floor = -0.5;
        mesh.paint(walls[dice.below(walls.len())]);
        for _ in 0..tiers {
            let low = Vec3::new(x - wide, floor, z - deep);
            let high = Vec3::new(x + wide, floor + height, z + deep);
            cuboid(&mut mesh, low, high, (cuts + usize::from(built < finer)) as u32);
            built += 1;
            // The next one stands in this one's roof, narrower.
            floor += height - 0.5;
            height *= dice.between(0.3, 0.7);
            wide *= dice.between(0.55, 0.8);
            deep *= dice.between(0.55, 0.8);
        }
    }
    mesh.finish([-0.36 * side, 40.0 + 0.2 * side, 0.6 * side], [-0.04 * side, 0.0, 0.12 * side], 36.0)
}

/// A closed box with each face cut into `n` by `n`; `12 n²` triangles, facing out.
fn cuboid(mesh: &mut Mesh, low: Vec3, high: Vec3, n: u32) {
    // Vertices layer by layer: whole layers at the ends, rims between.
    let first = mesh.next_vertex();
    let size = high - low;
    let at = |i: u32, j: u32, k: u32| low + size * Vec3::new(i as f32, j as f32, k as f32) / n as f32;
    let rim = 4 * n;
    let whole = (n + 1) * (n + 1);
    for k in 0..=n {
        for j in 0..=n {
            for i in 0..=n {
                if [i, j, k].iter().any(|&c| c == 0 || c == n) {
                    mesh.vertex(at(i, j, k));
                }
            }
        }
    }
    let index = |i: u32, j: u32, k: u32| {
        let layer = if k == 0 { 0 } else { whole + (k - 1) * rim };
        let within = if k == 0 || k == n || j == 0 {
            j * (n + 1) + i
        } else if j == n {
            (n + 1) + 2 * (n - 1) + i
        } else {
            (n + 1) + 2 * (j - 1) + u32::from(i == n)
        };
        first + layer + within
    };
    for b in 0..n {
        for a in 0..n {
            let (c, d) = (a + 1, b + 1);
            mesh.quad([index(a, b, n), index(c, b, n), index(c, d, n), index(a, d, n)]);
            mesh.quad([index(a, b, 0), index(a, d, 0), index(c, d, 0), index(c, b, 0)]);
            mesh.quad([index(n, a, b), index(n, c, b), index(n, c, d), index(n, a, d)]);
            mesh.quad([index(0, a, b), index(0, a, d), index(0, c, d), index(0, c, b)]);
            mesh.quad([index(b, n, a), index(b, n, c), index(d, n, c), index(d, n, a)]);
            mesh.quad([index(b, 0, a), index(d, 0, a), index(d, 0, c), index(b, 0, c)]);
        }
    }
}
