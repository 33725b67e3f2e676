//! Triangle soup: slivers that fill a cube, in no order at all.

use super::dice::Dice;
use super::mesh::Mesh;
use crate::scene::Scene;
use glam::Vec3;

/// Slivers between a light and a floor; the count is exact.
///
/// They grow smaller with their number: about one lies in the way of any ray through the cube.
pub(super) fn soup(seed: u64, triangles: usize) -> Scene {
    let mut dice = Dice::new(seed);
    let slivers = triangles.saturating_sub(4);
    let mut mesh = Mesh::new("soup", slivers + 4, 3 * slivers + 8);
    mesh.ground(2.0, [0.64, 0.62, 0.6]);
    mesh.light("light", Vec3::new(0.1, 2.3, 0.2), [0.15, 0.15], [270.0, 252.0, 225.0]);
    let paints = [
        mesh.matte("red", [0.66, 0.24, 0.2]),
        mesh.matte("blue", [0.24, 0.36, 0.62]),
        mesh.matte("white", [0.74, 0.73, 0.7]),
    ];
    // The mean area of a sliver is length² / 40; together, twice a face of the cube.
    let length = (40.0 * 2.0 / slivers.max(1) as f32).sqrt().min(0.5);
    for (k, &paint) in paints.iter().enumerate() {
        mesh.object(format!("slivers_{k}"));
        mesh.paint(paint);
        for _ in 0..slivers / 3 + usize::from(k < slivers % 3) {
            let middle =
                Vec3::new(dice.between(-0.5, 0.5), dice.between(0.35, 1.35), dice.between(-0.5, 0.5));
            let along = dice.direction();
            let across = along.cross(dice.direction()).normalize_or(along.any_orthonormal_vector());
            let half = 0.5 * length * dice.between(0.7, 1.25);
            let wide = half * dice.between(0.01, 0.09) * 2.0;
            let slide = dice.between(-1.0, 1.0) * half;
            let corners =
                [middle - half * along, middle + half * along, middle + slide * along + wide * across];
            let corners = corners.map(|p| mesh.vertex(p));
            mesh.triangle(corners);
        }
    }
    mesh.finish([-1.2, 1.75, 2.9], [0.0, 0.6, 0.0], 34.0)
}
