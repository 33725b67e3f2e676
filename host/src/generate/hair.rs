//! Hair: thin curved strands on a ball.

use super::dice::{Dice, circle};
use super::icosphere::icosphere;
use super::mesh::Mesh;
use crate::scene::Scene;
use glam::Vec3;

/// The segments of a strand, the last of which is its point. A few strands have one more.
const SEGMENTS: usize = 8;

/// A ball and three-sided strands of 45 triangles; the count is met to within 6.
pub(super) fn hair(seed: u64, triangles: usize) -> Scene {
    let mut dice = Dice::new(seed);
    let frequency = (triangles / 80).isqrt().clamp(1, 16);
    let rest = triangles.saturating_sub(4 + 20 * frequency * frequency);
    let strands = (rest / (6 * SEGMENTS - 3)).max(1);
    let spare = rest.saturating_sub(strands * (6 * SEGMENTS - 3)) / 6;

    let mut mesh = Mesh::new("hair", triangles + 64, rest * 5 / 9 + 8000);
    mesh.ground(5.0, [0.6, 0.58, 0.55]);
    mesh.light("light", Vec3::new(1.6, 6.0, 1.0), [0.5, 0.5], [190.0, 176.0, 154.0]);
    let skin = mesh.matte("skin", [0.66, 0.48, 0.38]);
    let fair = mesh.matte("hair", [0.56, 0.38, 0.2]);
    let centre = Vec3::new(0.0, 2.1, 0.0);
    mesh.object("ball");
    mesh.paint(skin);
    icosphere(&mut mesh, centre, 1.0, frequency as u32);

    mesh.object("hair");
    mesh.paint(fair);
    // Together they cover about as much of the ball, whatever their number.
    let radius = (0.35 / (strands as f32).sqrt()).clamp(0.0004, 0.02);
    let mut points = Vec::with_capacity(SEGMENTS + 2);
    for k in 0..strands {
        let segments = SEGMENTS + spare / strands + usize::from(k < spare % strands);
        let out = dice.direction();
        let side = out.any_orthonormal_vector();
        let other = out.cross(side);
        let length = dice.between(0.55, 0.85);
        let comb = 0.35 * Vec3::new(-out.z, 0.0, out.x) + 0.12 * dice.ball();
        let (phase, curls) = (dice.unit(), dice.between(0.4, 1.1));
        points.clear();
        for s in 0..=segments {
            let t = s as f32 / segments as f32;
            let (cos, sin) = circle(phase + curls * t);
            let curl = 0.06 * t * (cos * side + sin * other);
            let along = out * t + (comb - 0.55 * Vec3::Y) * t * t;
            // The foot is inside the ball, so that no strand hovers over a facet.
            points.push((centre + 0.97 * out + length * along + curl, radius * (1.0 - 0.5 * t)));
        }
        if let Some((tip, _)) = points.pop() {
            mesh.spike(&points, tip, 3);
        }
    }
    mesh.finish([-1.2, 3.6, 7.6], [0.0, 1.25, 0.0], 32.0)
}
