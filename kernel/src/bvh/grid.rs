//! The parts of a light: eight by eight cells of the box around a tile's targets, along its two longest sides.

use super::Targets;
use super::batch::targets_from;
use super::pyramid::MOST;
use super::shaft::Shaft;
use crate::lanes::{Lanes, Simd, UNIT};
use crate::vec3x;
use glam::Vec3;

/// Parts of the light along either side.
pub(super) const SIDE: usize = 8;
pub(super) const CELLS: usize = SIDE * SIDE;

/// Where the middles of the cells are, in halves of the sides from the middle of all.
pub(super) const MIDDLES: [[f32; CELLS]; 2] = middles();

const fn middles() -> [[f32; CELLS]; 2] {
    let mut middles = [[0.0; CELLS]; 2];
    let mut k = 0;
    while k < CELLS {
        middles[0][k] = (2 * (k % SIDE) + 1) as f32 / SIDE as f32 - 1.0;
        middles[1][k] = (2 * (k / SIDE) + 1) as f32 / SIDE as f32 - 1.0;
        k += 1;
    }
    middles
}

/// Cells, numbered row by row.
pub(super) struct Grid {
    pub(super) middle: Vec3,
    /// Half the box's sides, the longest two first.
    pub(super) halves: [Vec3; 3],
    /// Cells for a step from the middle.
    pub(super) axes: [Vec3; 2],
}

impl Grid {
    pub(super) const NOTHING: Self =
        Self { middle: Vec3::ZERO, halves: [Vec3::ZERO; 3], axes: [Vec3::ZERO; 2] };

    /// Over the targets of a shaft.
    #[inline(always)]
    pub(super) fn new(shaft: &Shaft) -> Self {
        let targets = &shaft.targets;
        let [a, b, c] = targets.axes;
        let [x, y, z] = [a.length_squared(), b.length_squared(), c.length_squared()];
        let halves = if z <= x && z <= y {
            [a, b, c]
        } else if y <= x {
            [a, c, b]
        } else {
            [b, c, a]
        };
        let mut axes = [Vec3::ZERO; 2];
        let mut k = 0;
        while k < 2 {
            let size = halves[k].length_squared();
            axes[k] = if size > 1e-30 { halves[k] * (0.5 * SIDE as f32 / size) } else { Vec3::ZERO };
            k += 1;
        }
        Self { middle: shaft.reference + targets.middle, halves, axes }
    }

    /// Finds the cells of targets, as the last bits of numbers.
    #[inline(always)]
    pub(super) fn find<S: Simd>(
        &self,
        simd: S,
        targets: &Targets<'_>,
        first: usize,
        count: usize,
        cells: &mut [f32; MOST],
    ) {
        type P<S> = <S as Simd>::Packet;
        let token = simd.token();
        let one = |value: f32| P::<S>::splat(token, value);
        let middle = vec3x::splat::<P<S>>(token, self.middle.to_array());
        let s = vec3x::splat::<P<S>>(token, self.axes[0].to_array());
        let t = vec3x::splat::<P<S>>(token, self.axes[1].to_array());
        let (zero, most) = (one(0.0), one(SIDE as f32 - 1.0));
        let (half, unit, side) = (one(0.5 * SIDE as f32 - 0.5), one(UNIT), one(SIDE as f32));
        let mut i = 0;
        while i < count {
            let at = vec3x::sub(targets_from::<S>(token, targets, first + i, first + count), middle);
            // Rounded to whole numbers by what they are added to.
            let s = (vec3x::dot(at, s) + half).max(zero).min(most) + unit;
            let t = (vec3x::dot(at, t) + half).max(zero).min(most) + unit;
            ((t - unit) * side + s).store(&mut cells[i..]);
            i += P::<S>::WIDTH;
        }
    }
}

/// The cell that a number stands for; any, where it is not finite.
#[inline(always)]
pub(super) fn cell(number: f32) -> usize {
    number.to_bits() as usize & (CELLS - 1)
}
