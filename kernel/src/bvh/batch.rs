//! One point and many points on a light: which of the segments are blocked?

use super::packet::{Any, Rays};
use super::pyramid::{MOST, NO_STACK, Pyramid, Stack};
use super::{Bvh, Child};
use crate::counter::Counter;
use crate::lanes::{Lanes, Simd};
use crate::ray::Ray;
use crate::vec3x;
use glam::Vec3;

/// The far ends of a batch: points on a light, one coordinate a slice, all of one length.
#[derive(Clone, Copy, Debug)]
pub struct Targets<'a> {
    x: &'a [f32],
    y: &'a [f32],
    z: &'a [f32],
    plane: Option<[Vec3; 3]>,
}

impl<'a> Targets<'a> {
    /// Points by their coordinates. `None` if the slices differ in length.
    #[inline(always)]
    pub fn new(x: &'a [f32], y: &'a [f32], z: &'a [f32]) -> Option<Self> {
        if x.len() == y.len() && y.len() == z.len() { Some(Self { x, y, z, plane: None }) } else { None }
    }

    /// Says that the points lie on, or very near, the parallelogram of a corner and the edges u and v at it.
    ///
    /// This only makes queries quicker, by a pyramid that fits the light; the answers are the same.
    #[inline(always)]
    pub fn on_parallelogram(
        self,
        corner: impl Into<[f32; 3]>,
        u: impl Into<[f32; 3]>,
        v: impl Into<[f32; 3]>,
    ) -> Self {
        let plane = [Vec3::from(corner.into()), Vec3::from(u.into()), Vec3::from(v.into())];
        Self { plane: Some(plane), ..self }
    }

    /// The coordinates along an axis.
    #[inline(always)]
    pub(super) fn axis(&self, axis: usize) -> &'a [f32] {
        match axis {
            0 => self.x,
            1 => self.y,
            _ => self.z,
        }
    }

    /// Three linear functions of positions from x, by rows, such that the targets lie at about one depth (the
    /// third), and near together once the first two are divided by it; and their inverse, by columns.
    #[inline(always)]
    pub(super) fn frame<const N: usize>(
        &self,
        x: Vec3,
        direction: &[[f32; N]; 3],
        count: usize,
    ) -> Option<([Vec3; 3], [Vec3; 3])> {
        if let Some([corner, u, v]) = self.plane {
            let c = corner - x;
            let n = u.cross(v);
            let height = n.dot(c);
            // So near the light's plane that its coordinates would say little, an axis serves better.
            if height.abs() > 1e-4 * (n.abs().max_element() * c.abs().max_element()) {
                let inverse = 1.0 / height;
                return Some(([v.cross(c) * inverse, c.cross(u) * inverse, n * inverse], [u, v, c]));
            }
        }
        let mut sum = Vec3::ZERO;
        let mut i = 0;
        while i < count {
            sum += Vec3::new(direction[0][i], direction[1][i], direction[2][i]);
            i += 1;
        }
        let (size, mut rows) = (sum.abs(), [Vec3::X, Vec3::Y, Vec3::Z]);
        if size.x >= size.y && size.x >= size.z {
            rows = [Vec3::Y, Vec3::Z, Vec3::X];
        } else if size.y >= size.z {
            rows = [Vec3::Z, Vec3::X, Vec3::Y];
        }
        if rows[2].dot(sum) < 0.0 {
            rows[2] = -rows[2];
        }
        if sum.is_finite() { Some((rows, rows)) } else { None }
    }

    /// How many.
    #[inline]
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Are there none?
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }

    /// Point `i`. Panics if there is no such point.
    #[inline]
    pub fn get(&self, i: usize) -> Vec3 {
        Vec3::new(self.x[i], self.y[i], self.z[i])
    }
}

/// What a batch works in: keep one a thread, so that nothing is cleared between queries. About six kilobytes.
pub struct BatchScratch {
    pyramid: Pyramid,
    stack: Stack,
}

impl BatchScratch {
    /// Ready for any query.
    pub const fn new() -> Self {
        Self { pyramid: Pyramid::EMPTY, stack: NO_STACK }
    }
}

impl Default for BatchScratch {
    fn default() -> Self {
        Self::new()
    }
}

impl core::fmt::Debug for BatchScratch {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("BatchScratch")
    }
}

impl<S: Simd> Bvh<'_, S> {
    /// Which of the segments from `x` to the targets does anything but `ignore` block?
    ///
    /// Bit `i % 64` of `blocked[i / 64]` answers for target `i`, as [`Bvh::occluded`] would for
    /// [`Ray::segment(x, target)`](crate::Ray::segment). Words are overwritten; bits beyond the targets are 0, and
    /// words beyond the last target are left alone. Panics if `blocked` is too short for the targets.
    ///
    /// One traversal for 64 targets. Say what light they lie on if it is flat ([`Targets::on_parallelogram`]).
    #[inline(always)]
    pub fn occluded_batch(
        &self,
        x: impl Into<[f32; 3]>,
        targets: &Targets<'_>,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        scratch: &mut BatchScratch,
        blocked: &mut [u64],
    ) {
        let x = x.into();
        let mut from = 0;
        while from < targets.len() {
            let count = (targets.len() - from).min(MOST);
            blocked[from / MOST] = if count < FEW || self.nodes.is_empty() {
                self.packets_blocked(x, targets, from, count, ignore, counter)
            } else if scratch.pyramid.aim(self.simd, x.into(), targets, from, count, self.magnitude) {
                counter.rays(count as u32);
                let BatchScratch { pyramid, stack } = scratch;
                self.pyramid_blocked(pyramid, stack, Child::node(0), u64::MAX, ignore, counter)
            } else {
                self.packets_blocked(x, targets, from, count, ignore, counter)
            };
            from += MOST;
        }
    }

    /// The same, but only the triangles below these subtrees count: blockers that may be in the way, named by
    /// whoever knows. Costs a traversal of each, until nothing is left to hide.
    ///
    /// Panics if one of them is beyond the tree's nodes or blocks.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub fn occluded_batch_by(
        &self,
        subtrees: &[Child],
        x: impl Into<[f32; 3]>,
        targets: &Targets<'_>,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        scratch: &mut BatchScratch,
        blocked: &mut [u64],
    ) {
        let x = x.into();
        let mut from = 0;
        while from < targets.len() {
            let count = (targets.len() - from).min(MOST);
            let every = u64::MAX >> (64 - count);
            let mut free = every;
            counter.rays(count as u32);
            let aimed = count >= FEW
                && scratch.pyramid.aim(self.simd, x.into(), targets, from, count, self.magnitude);
            let mut next = 0;
            while next < subtrees.len() && free != 0 {
                let subtree = subtrees[next];
                next += 1;
                if subtree == Child::NONE {
                    continue;
                }
                if aimed {
                    let BatchScratch { pyramid, stack } = &mut *scratch;
                    free &= !self.pyramid_blocked(pyramid, stack, subtree, free, ignore, counter);
                } else {
                    let mut ask = free;
                    while ask != 0 {
                        let i = ask.trailing_zeros() as usize;
                        ask &= ask - 1;
                        let ray = Ray::segment(x, targets.get(from + i));
                        if self.occluded_from(subtree, &ray, ignore, counter) {
                            free &= !(1 << i);
                        }
                    }
                }
            }
            blocked[from / MOST] = every & !free;
            from += MOST;
        }
    }

    /// The same for up to 64 targets, in packets.
    #[inline(always)]
    fn packets_blocked(
        &self,
        x: [f32; 3],
        targets: &Targets<'_>,
        first: usize,
        count: usize,
        ignore: Option<u32>,
        counter: &mut impl Counter,
    ) -> u64 {
        let token = self.simd.token();
        let width = S::Packet::WIDTH;
        let mut blocked = 0;
        let mut tail = [0.0; 16];
        let mut done = 0;
        while done < count {
            let (from, rest) = (first + done, (count - done).min(width));
            let origin = vec3x::splat(token, x);
            let ends = [
                ends_of::<S>(token, targets.x, from, rest, &mut tail),
                ends_of::<S>(token, targets.y, from, rest, &mut tail),
                ends_of::<S>(token, targets.z, from, rest, &mut tail),
            ];
            let rays = Rays {
                origin,
                direction: vec3x::sub(ends, origin),
                t_min: S::Packet::splat(token, 0.0),
                t_max: S::Packet::splat(token, 1.0),
            };
            let mut any = Any { blocked: 0, note: |_, _| () };
            self.traverse_rays(&rays, (1 << rest) - 1, ignore, counter, &mut any);
            blocked |= u64::from(any.blocked) << done;
            done += width;
        }
        blocked
    }
}

/// Below this many targets a pyramid costs more than it saves.
const FEW: usize = 4;

/// The coordinates of up to a vector's width of targets; lanes beyond the last hold anything.
#[inline(always)]
fn ends_of<S: Simd>(
    token: S::Token,
    all: &[f32],
    from: usize,
    count: usize,
    tail: &mut [f32; 16],
) -> S::Packet {
    if count == S::Packet::WIDTH {
        return S::Packet::load(token, &all[from..]);
    }
    tail[..count].copy_from_slice(&all[from..from + count]);
    S::Packet::load(token, tail)
}
