//! Proofs that no segment from a cell to its light is blocked.

use crate::light::AreaLight;
use occlude_kernel::lanes::Task;
use occlude_kernel::{Bvh, Simd, Targets, TileScratch, Uncounted, offset};

/// Is there nothing between a cell and its light?
pub(super) struct Prove<'a> {
    pub(super) bvh: Bvh<'a>,
    pub(super) light: &'a AreaLight,
    pub(super) corners: &'a [[f32; 3]; 8],
    pub(super) scratch: &'a mut TileScratch,
}

impl Task for Prove<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> bool {
        let clearance = self.bvh.clearance();
        let (corners, count) = self.light.corners();
        // Samples lie a clearance before the light, give or take some rounding.
        let mut at = [[0.0; 8]; 3];
        for (k, &corner) in corners[..count].iter().enumerate() {
            for (half, by) in [0.75, 1.25].into_iter().enumerate() {
                let target = offset(corner, self.light.normal, by * clearance);
                for axis in 0..3 {
                    at[axis][k + half * count] = target[axis];
                }
            }
        }
        let [x, y, z] = &at;
        let Some(targets) = Targets::new(&x[..2 * count], &y[..2 * count], &z[..2 * count]) else {
            return false;
        };
        let targets = targets.on_parallelogram(self.light.corner, self.light.u, self.light.v);
        self.bvh.on(simd).nothing_between(self.corners, &targets, &mut Uncounted, self.scratch)
    }
}
