//! obvhs' two trees over the same triangles, as its pages advise: medium build, triangles in the tree's order.

use crate::Work;
use glam::Vec3;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2_from_tris;
use obvhs::cwbvh::CwBvh;
use obvhs::cwbvh::builder::build_cwbvh_from_tris;
use obvhs::ray::{Ray, RayHit};
use obvhs::rt_triangle::RtTriangle;
use obvhs::{BvhBuildParams, triangle::Triangle};
use occlude_host::scene::Scene;
use std::time::Duration;

/// `Bvh2`, the binary one.
pub struct Binary {
    tree: Bvh2,
    triangles: Vec<RtTriangle>,
}

/// `CwBvh`, eight children a node, compressed.
pub struct Wide {
    tree: CwBvh,
    triangles: Vec<RtTriangle>,
}

/// Our ray as theirs, with the inverse of its direction.
#[inline(always)]
pub fn ray(origin: Vec3, direction: Vec3, t_max: f32) -> Ray {
    Ray::new(origin.into(), direction.into(), 0.0, t_max)
}

fn triangles(scene: &Scene) -> Vec<Triangle> {
    (0..scene.triangles.len() as u32)
        .map(|i| {
            let [v0, v1, v2] = scene.vertices(i).map(|v: Vec3| v.into());
            Triangle { v0, v1, v2 }
        })
        .collect()
}

fn in_order(triangles: &[Triangle], order: &[u32]) -> Vec<RtTriangle> {
    order.iter().map(|&i| RtTriangle::from(&triangles[i as usize])).collect()
}

impl Binary {
    /// Builds it.
    pub fn new(scene: &Scene) -> Self {
        let all = triangles(scene);
        let tree = build_bvh2_from_tris(&all, BvhBuildParams::medium_build(), &mut Duration::default());
        Self { triangles: in_order(&all, &tree.primitive_indices), tree }
    }

    /// Is anything in the way?
    #[inline(always)]
    pub fn occluded(&self, ray: Ray) -> bool {
        !self.tree.ray_traverse_miss(ray, |ray, i| self.triangles[i].intersect(ray))
    }

    /// Is there a nearest hit?
    #[inline(always)]
    pub fn closest(&self, ray: Ray) -> bool {
        self.tree.ray_traverse(ray, &mut RayHit::none(), |ray, i| self.triangles[i].intersect(ray))
    }

    /// Answers all of the work: a word a batch.
    pub fn answer(&self, work: &Work, blocked: &mut [u64]) {
        answer(work, blocked, |ray| self.occluded(ray));
    }
}

impl Wide {
    /// Builds it.
    pub fn new(scene: &Scene) -> Self {
        let all = triangles(scene);
        let tree = build_cwbvh_from_tris(&all, BvhBuildParams::medium_build(), &mut Duration::default());
        Self { triangles: in_order(&all, &tree.primitive_indices), tree }
    }

    /// Is anything in the way?
    #[inline(always)]
    pub fn occluded(&self, ray: Ray) -> bool {
        !self.tree.ray_traverse_miss(ray, |ray, i| self.triangles[i].intersect(ray))
    }

    /// Is there a nearest hit?
    #[inline(always)]
    pub fn closest(&self, ray: Ray) -> bool {
        self.tree.ray_traverse(ray, &mut RayHit::none(), |ray, i| self.triangles[i].intersect(ray))
    }

    /// Answers all of the work: a word a batch.
    pub fn answer(&self, work: &Work, blocked: &mut [u64]) {
        answer(work, blocked, |ray| self.occluded(ray));
    }
}

#[inline(always)]
fn answer(work: &Work, blocked: &mut [u64], occluded: impl Fn(Ray) -> bool) {
    let [x, y, z] = &work.targets;
    for (batch, word) in work.batches.iter().zip(blocked) {
        *word = 0;
        for i in batch.first as usize..batch.last as usize {
            let target = Vec3::new(x[i], y[i], z[i]);
            let hit = occluded(ray(batch.origin, target - batch.origin, 1.0));
            *word |= u64::from(hit) << (i - batch.first as usize);
        }
    }
}
