//! A forest: trunks, branches, and leaves by the million.

use super::dice::{Dice, circle};
use super::mesh::Mesh;
use crate::scene::Scene;
use glam::Vec3;

/// The distance from tree to tree.
const SPACING: f32 = 3.5;
const TRUNK_SIDES: u32 = 6;
const TRUNK: usize = 6 * 7;
const BRANCH: usize = 3 * 3;

/// One tree for each `sqrt(40 triangles)`; the leaves make up the count, exactly from 1000 on.
pub(super) fn forest(seed: u64, triangles: usize) -> Scene {
    let mut dice = Dice::new(seed);
    let trees = (triangles / 40).isqrt().max(1);
    let branches = (triangles / trees / 60).clamp(3, 48);
    let columns = trees.isqrt() + usize::from(trees.isqrt() * trees.isqrt() < trees);
    let half = 0.5 * SPACING * columns as f32;
    let leaves = triangles.saturating_sub(4 + trees * (TRUNK + branches * BRANCH));

    let mut mesh = Mesh::new("forest", triangles + 256, leaves * 5 / 2 + trees * (32 + 7 * branches) + 64);
    mesh.ground(1.4 * half, [0.46, 0.4, 0.3]);
    let above = Vec3::new(0.5 * half, 8.0 + 1.2 * half, 0.3 * half);
    let emission = [680.0, 630.0, 530.0];
    mesh.light("sun", above, [0.1 * half; 2], emission);
    let barks = [mesh.matte("bark", [0.3, 0.22, 0.15]), mesh.matte("birch", [0.62, 0.58, 0.5])];
    let greens = [
        mesh.matte("beech", [0.28, 0.5, 0.12]),
        mesh.matte("fir", [0.1, 0.3, 0.14]),
        mesh.matte("maple", [0.62, 0.34, 0.1]),
    ];

    for k in 0..trees {
        // Each tree takes its even share, the first ones the remainder.
        let share = leaves / trees + usize::from(k < leaves % trees);
        let x = (k % columns) as f32 * SPACING - half + dice.between(0.25, 0.75) * SPACING;
        let z = (k / columns) as f32 * SPACING - half + dice.between(0.25, 0.75) * SPACING;
        let kind = dice.below(greens.len());
        mesh.object(format!("tree_{k}"));
        mesh.paint(barks[usize::from(kind == 2)]);
        let crown = wood(&mut mesh, &mut dice, Vec3::new(x, 0.0, z), branches);
        mesh.paint(greens[kind]);
        if kind == 1 {
            needles(&mut mesh, &mut dice, &crown, share)
        } else {
            blades(&mut mesh, &mut dice, &crown, share)
        }
    }
    mesh.finish([-0.8 * half, 5.0 + 0.5 * half, 1.55 * half + 4.0], [-0.05 * half, 1.5, 0.1 * half], 38.0)
}

/// Trunk and branches; the branches come back as root, bend and tip.
fn wood(mesh: &mut Mesh, dice: &mut Dice, foot: Vec3, branches: usize) -> Vec<[Vec3; 3]> {
    let height = dice.between(4.0, 7.0);
    let lean = Vec3::new(dice.between(-0.5, 0.5), 0.0, dice.between(-0.5, 0.5));
    let trunk = |t: f32| foot + t * height * Vec3::Y + t * t * lean;
    // The open foot stands a little below the ground.
    let rings = [-0.02, 0.06, 0.4, 0.75].map(|t| (trunk(t), (0.024 - 0.018 * t) * height));
    mesh.spike(&rings, trunk(1.0), TRUNK_SIDES);

    let turn = dice.unit();
    let mut crown = Vec::with_capacity(branches);
    for k in 0..branches {
        let t = 0.3 + 0.65 * (k as f32 + 0.5) / branches as f32;
        // The golden angle, as a plant would have it.
        let (cos, sin) = circle(turn + 0.381_966 * k as f32 + dice.between(-0.04, 0.04));
        let out = Vec3::new(cos, 0.0, sin);
        let length = height * 0.42 * (1.12 - t) * dice.between(0.75, 1.1);
        let root = trunk(t);
        let bend = root + length * (0.55 * out + 0.3 * Vec3::Y);
        let tip = root + length * (out + 0.35 * Vec3::Y);
        let thick = 0.006 * height * (1.2 - t);
        mesh.spike(&[(root, thick), (bend, 0.6 * thick)], tip, 3);
        crown.push([root, bend, tip]);
    }
    crown
}

/// A place for a leaf: on the outer part of a branch, or near it.
fn perch(dice: &mut Dice, crown: &[[Vec3; 3]]) -> Vec3 {
    let [root, bend, tip] = crown[dice.below(crown.len())];
    let t = dice.between(0.3, 2.0);
    let on = if t < 1.0 { root.lerp(bend, t) } else { bend.lerp(tip, t - 1.0) };
    on + 0.32 * dice.ball()
}

/// Rhombic leaves of two triangles, 24 square metres a tree in all, whatever their number.
fn blades(mesh: &mut Mesh, dice: &mut Dice, crown: &[[Vec3; 3]], triangles: usize) {
    let length = (4.0 * 24.0 / (triangles / 2).max(1) as f32).sqrt().min(0.5);
    for k in 0..triangles.div_ceil(2) {
        let stalk = perch(dice, crown);
        let along = (dice.direction() - 0.4 * Vec3::Y).normalize_or(Vec3::X) * length;
        let across = along.cross(dice.direction() + 0.3 * Vec3::X).normalize_or(Vec3::Z) * (0.25 * length);
        let [a, b, c] = [stalk, stalk + 0.45 * along + across, stalk + along].map(|p| mesh.vertex(p));
        mesh.triangle([a, b, c]);
        if 2 * k + 1 < triangles {
            let d = mesh.vertex(stalk + 0.45 * along - across);
            mesh.triangle([a, c, d]);
        }
    }
}

/// Needles of one triangle, 16 square metres a tree in all.
fn needles(mesh: &mut Mesh, dice: &mut Dice, crown: &[[Vec3; 3]], triangles: usize) {
    let length = (12.0 * 16.0 / triangles.max(1) as f32).sqrt().min(0.6);
    for _ in 0..triangles {
        let stalk = perch(dice, crown);
        let along = (dice.direction() + 0.3 * Vec3::Y).normalize_or(Vec3::Y) * length;
        let across = along.cross(dice.direction()).normalize_or(Vec3::X) * (length / 12.0);
        let corners = [stalk - across, stalk + across, stalk + along].map(|p| mesh.vertex(p));
        mesh.triangle(corners);
    }
}
