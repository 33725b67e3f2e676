//! Spheres resting over a floor: large closed meshes with much room inside.

use super::dice::Dice;
use super::icosphere::icosphere;
use super::mesh::Mesh;
use crate::scene::Scene;
use glam::{Vec2, Vec3};

/// 24 to 120 spheres that carry the count by their tessellation, to within 4 %.
pub(super) fn spheres(seed: u64, triangles: usize) -> Scene {
    let mut dice = Dice::new(seed);
    let wanted = (triangles / 250).clamp(24, 120);
    let side = 1.1 * (wanted as f32).sqrt();
    let spheres = place(&mut dice, wanted, 0.5 * side);

    // Twenty triangles times the square of a frequency: f for the small ones, f + 1 for the first few.
    let twenties = (triangles + 6) / 20; // less ground and light, rounded
    let f = (twenties / spheres.len().max(1)).isqrt().max(1);
    let step = 2 * f + 1;
    let finer = (twenties.saturating_sub(spheres.len() * f * f) + step / 2) / step;

    let mut mesh =
        Mesh::new("spheres", triangles + triangles / 16 + 1024, triangles / 2 + triangles / 16 + 1024);
    mesh.ground(1.2 * side, [0.62, 0.6, 0.56]);
    mesh.light(
        "light",
        Vec3::new(0.15 * side, 0.6 * side, 0.1 * side),
        [0.05 * side; 2],
        [290.0, 270.0, 238.0],
    );
    let paints = [
        ("clay", [0.72, 0.36, 0.24]),
        ("bone", [0.78, 0.74, 0.66]),
        ("moss", [0.36, 0.52, 0.26]),
        ("slate", [0.3, 0.38, 0.5]),
        ("straw", [0.8, 0.64, 0.28]),
    ]
    .map(|(name, diffuse)| mesh.matte(name, diffuse));
    for (k, &(at, radius)) in spheres.iter().enumerate() {
        mesh.object(format!("sphere_{k}"));
        mesh.paint(paints[dice.below(paints.len())]);
        // A hundredth off the floor, so that nothing touches.
        icosphere(
            &mut mesh,
            Vec3::new(at.x, 1.01 * radius, at.y),
            radius,
            (f + usize::from(k < finer)) as u32,
        );
    }
    mesh.finish([-0.32 * side, 0.5 * side, 0.95 * side], [0.0, 0.0, 0.05 * side], 40.0)
}

/// Disjoint discs in a square, the widest first; each shrinks until it finds room.
fn place(dice: &mut Dice, count: usize, half: f32) -> Vec<(Vec2, f32)> {
    let mut placed: Vec<(Vec2, f32)> = Vec::with_capacity(count);
    for k in 0..count {
        let mut radius = 0.75 - 0.5 * k as f32 / count as f32;
        loop {
            let room = half - radius;
            let at = Vec2::new(dice.between(-room, room), dice.between(-room, room));
            if placed
                .iter()
                .all(|&(other, r)| at.distance_squared(other) > (r + radius) * (r + radius) * 1.02)
            {
                placed.push((at, radius));
                break;
            }
            radius *= 0.995;
        }
    }
    placed
}
