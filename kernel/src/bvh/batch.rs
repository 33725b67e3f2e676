//! One point and many points on a light: which of the segments are blocked?

use super::Bvh;
use super::packet::{Any, Rays};
use crate::counter::Counter;
use crate::lanes::{Lanes, Simd};
use crate::vec3x;
use glam::Vec3;

/// The far ends of a batch: points on a light, one coordinate a slice, all of one length.
#[derive(Clone, Copy, Debug)]
pub struct Targets<'a> {
    x: &'a [f32],
    y: &'a [f32],
    z: &'a [f32],
}

impl<'a> Targets<'a> {
    /// Points by their coordinates. `None` if the slices differ in length.
    #[inline]
    pub fn new(x: &'a [f32], y: &'a [f32], z: &'a [f32]) -> Option<Self> {
        (x.len() == y.len() && y.len() == z.len()).then_some(Self { x, y, z })
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

impl<S: Simd> Bvh<'_, S> {
    /// Which of the segments from `x` to the targets does anything but `ignore` block?
    ///
    /// Bit `i % 64` of `blocked[i / 64]` answers for target `i`, as [`Bvh::occluded`] would for
    /// [`Ray::segment(x, target)`](crate::Ray::segment). Words are overwritten; bits beyond the targets are 0, and
    /// words beyond the last target are left alone. Panics if `blocked` is too short for the targets.
    #[inline(always)]
    pub fn occluded_batch(
        &self,
        x: impl Into<[f32; 3]>,
        targets: &Targets<'_>,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        blocked: &mut [u64],
    ) {
        let x = x.into();
        let token = self.simd.token();
        let width = S::Packet::WIDTH;
        let words = targets.len().div_ceil(64);
        blocked[..words].fill(0);
        let mut tail = [0.0; 16];
        for from in (0..targets.len()).step_by(width) {
            let rest = (targets.len() - from).min(width);
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
            blocked[from / 64] |= u64::from(any.blocked) << (from % 64);
        }
    }
}

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
