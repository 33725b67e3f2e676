//! Ray and box, widened so that no triangle the ray meets is culled.
//!
//! A ray enters a slab at `b_near * inv - o * inv`, one multiply-add a plane. The origin is moved back for near
//! planes and on for far ones by the tree's slack, folded into the constants, so the bound on all rounding costs
//! nothing in the loop.

use super::Node;
use crate::lanes::{Lanes, Mask};
use crate::vec3x::{self, Vec3x};
use glam::Vec3;

/// Below this length a direction counts as zero.
pub(super) const SHORTEST: f32 = 1e-27;

/// Components smaller than this part of the longest are taken as that: over the length of a scene the ray moves
/// by less than the slack.
const FLATTEST: f32 = 1e-9;

/// Where slack, inverse and their product must lie. Beyond, a plane's product could overflow (planes and origin
/// are within `2^20` slacks of 0) or lose digits to underflow, and the axis culls nothing.
const SOUND: [f32; 2] = [f32::MIN_POSITIVE, 1e31];

/// One ray in every lane, for the boxes of a node's children.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slabs<L> {
    inverse: Vec3x<L>,
    near: Vec3x<L>,
    far: Vec3x<L>,
    /// Which side is near: 0 where the ray grows, 1 where it falls.
    near_side: [usize; 3],
    t_min: L,
}

/// The inverse of a direction's component, finite.
#[inline(always)]
fn inverse(component: f32, longest: f32) -> f32 {
    let least = longest * FLATTEST;
    if component.abs() < least { 1.0 / least.copysign(component) } else { 1.0 / component }
}

impl<L: Lanes> Slabs<L> {
    #[inline(always)]
    pub(super) fn new(token: L::Token, ray: &crate::Ray, slack: f32) -> Self {
        let longest = ray.direction.abs().max_element();
        let mut inverse = Vec3::new(
            inverse(ray.direction.x, longest),
            inverse(ray.direction.y, longest),
            inverse(ray.direction.z, longest),
        );
        let size = inverse.abs();
        let (mut back, mut wide) = (-ray.origin * inverse, slack * size);
        // As good as always all three are sound, so that is asked first, at once.
        let [least, most] = SOUND;
        if !(slack > least
            && size.min_element() > least
            && wide.min_element() > least
            && wide.max_element() < most)
        {
            for axis in 0..3 {
                if !(slack > least && size[axis] > least && wide[axis] > least && wide[axis] < most) {
                    (inverse[axis], back[axis], wide[axis]) = (0.0, 0.0, f32::INFINITY);
                }
            }
        }
        Self {
            inverse: vec3x::splat(token, inverse.to_array()),
            near: vec3x::splat(token, (back - wide).to_array()),
            far: vec3x::splat(token, (back + wide).to_array()),
            near_side: [
                usize::from(inverse.x < 0.0),
                usize::from(inverse.y < 0.0),
                usize::from(inverse.z < 0.0),
            ],
            t_min: L::splat(token, ray.t_min),
        }
    }

    /// One ray of a packet, from what [`PacketSlabs::store`] wrote.
    #[inline(always)]
    pub(super) fn of_lane<const N: usize>(
        token: L::Token,
        [inverse, near, far]: [&[[f32; N]; 3]; 3],
        lane: usize,
        t_min: f32,
    ) -> Self {
        Self {
            inverse: vec3x::broadcast(token, inverse, lane),
            near: vec3x::broadcast(token, near, lane),
            far: vec3x::broadcast(token, far, lane),
            near_side: [
                usize::from(inverse[0][lane] < 0.0),
                usize::from(inverse[1][lane] < 0.0),
                usize::from(inverse[2][lane] < 0.0),
            ],
            t_min: L::splat(token, t_min),
        }
    }

    /// Where the ray crosses the near or the far planes of an axis.
    #[inline(always)]
    fn planes(&self, token: L::Token, node: &Node, from: usize, axis: usize, far: usize) -> L {
        let side = (self.near_side[axis] & 1) ^ far;
        let plane = L::load(token, &node.bounds[side][axis][from..]);
        plane.mul_add(self.inverse[axis], if far == 0 { self.near[axis] } else { self.far[axis] })
    }

    /// Which children the ray may meet up to `t_max`, as bits, and from which `t` on.
    #[inline(always)]
    pub(super) fn children(&self, token: L::Token, node: &Node, t_max: f32, entry: &mut [f32; 8]) -> u32 {
        let t_max = L::splat(token, t_max);
        let mut met = 0;
        let mut from = 0;
        while from < Node::WIDTH {
            let near = [
                self.planes(token, node, from, 0, 0),
                self.planes(token, node, from, 1, 0),
                self.planes(token, node, from, 2, 0),
            ];
            let far = [
                self.planes(token, node, from, 0, 1),
                self.planes(token, node, from, 1, 1),
                self.planes(token, node, from, 2, 1),
            ];
            let enter = near[0].max(near[1]).max(near[2].max(self.t_min));
            let leave = far[0].min(far[1]).min(far[2].min(t_max));
            enter.store(&mut entry[from..]);
            met |= enter.le(leave).bits() << from;
            from += L::WIDTH;
        }
        met
    }
}

/// One ray a lane, for one box at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct PacketSlabs<L> {
    inverse: Vec3x<L>,
    near: Vec3x<L>,
    far: Vec3x<L>,
    t_min: L,
    /// Which side is near, by axis, if that is the same for all rays: a multiply-add a plane then does.
    near_side: Option<[usize; 3]>,
}

impl<L: Lanes> PacketSlabs<L> {
    #[inline(always)]
    pub(super) fn new(
        token: L::Token,
        active: u32,
        origin: Vec3x<L>,
        direction: Vec3x<L>,
        t_min: L,
        slack: L,
    ) -> Self {
        let length = vec3x::abs(direction);
        let least = vec3x::most(length) * L::splat(token, FLATTEST);
        let x = Self::axis(token, origin[0], direction[0], length[0], least, slack);
        let y = Self::axis(token, origin[1], direction[1], length[1], least, slack);
        let z = Self::axis(token, origin[2], direction[2], length[2], least, slack);
        let inverse = [x.0, y.0, z.0];
        let zero = L::splat(token, 0.0);
        let [falls_x, falls_y, falls_z] = [
            inverse[0].lt(zero).bits() & active,
            inverse[1].lt(zero).bits() & active,
            inverse[2].lt(zero).bits() & active,
        ];
        let alike = (falls_x == 0 || falls_x == active)
            && (falls_y == 0 || falls_y == active)
            && (falls_z == 0 || falls_z == active);
        let sides = [usize::from(falls_x != 0), usize::from(falls_y != 0), usize::from(falls_z != 0)];
        let near_side = if alike { Some(sides) } else { None };
        Self { inverse, near: [x.1, y.1, z.1], far: [x.2, y.2, z.2], t_min, near_side }
    }

    /// The inverse, and the constants of near and far planes, of one axis.
    #[inline(always)]
    fn axis(token: L::Token, origin: L, direction: L, length: L, least: L, slack: L) -> (L, L, L) {
        let flat = L::select(direction.lt(L::splat(token, 0.0)), -least, least);
        let inverse = L::splat(token, 1.0) / L::select(length.lt(least), flat, direction);
        let (back, wide) = (-origin * inverse, slack * inverse.abs());
        let (least, most) = (L::splat(token, SOUND[0]), L::splat(token, SOUND[1]));
        let sound = least.lt(slack) & least.lt(inverse.abs()) & least.lt(wide) & wide.lt(most);
        let infinity = L::splat(token, f32::INFINITY);
        (
            L::select(sound, inverse, L::splat(token, 0.0)),
            L::select(sound, back - wide, -infinity),
            L::select(sound, back + wide, infinity),
        )
    }

    /// From what [`PacketSlabs::constants`] gave.
    #[inline(always)]
    pub(super) fn from_constants(
        [inverse, near, far]: [Vec3x<L>; 3],
        t_min: L,
        near_side: Option<[usize; 3]>,
    ) -> Self {
        Self { inverse, near, far, t_min, near_side }
    }

    /// The constants of each ray: inverse, near and far by axis.
    #[inline(always)]
    pub(super) fn constants(&self) -> [Vec3x<L>; 3] {
        [self.inverse, self.near, self.far]
    }

    /// Which sides are near, by axis, if that is the same for all rays.
    #[inline(always)]
    pub(super) fn near_side(&self) -> Option<[usize; 3]> {
        self.near_side
    }

    /// Writes the constants of each ray: inverse, near and far by axis.
    #[inline(always)]
    pub(super) fn store(&self, to: &mut [[[f32; 16]; 3]; 3]) {
        let mut axis = 0;
        while axis < 3 {
            self.inverse[axis].store(&mut to[0][axis]);
            self.near[axis].store(&mut to[1][axis]);
            self.far[axis].store(&mut to[2][axis]);
            axis += 1;
        }
    }

    /// Which rays may meet a box up to `t_max`, and from which `t` on.
    #[inline(always)]
    pub(super) fn meet(&self, token: L::Token, node: &Node, place: usize, t_max: L) -> (L::Mask, L) {
        let (x, y, z);
        if let Some(near_side) = self.near_side {
            x = self.planes(token, node, place, 0, near_side[0]);
            y = self.planes(token, node, place, 1, near_side[1]);
            z = self.planes(token, node, place, 2, near_side[2]);
        } else {
            x = self.slab(token, node, place, 0);
            y = self.slab(token, node, place, 1);
            z = self.slab(token, node, place, 2);
        }
        let enter = x.0.max(y.0).max(z.0.max(self.t_min));
        let leave = x.1.min(y.1).min(z.1.min(t_max));
        (enter.le(leave), enter)
    }

    #[inline(always)]
    fn planes(&self, token: L::Token, node: &Node, place: usize, axis: usize, near_side: usize) -> (L, L) {
        let near = L::splat(token, node.bounds[near_side & 1][axis][place]);
        let far = L::splat(token, node.bounds[near_side & 1 ^ 1][axis][place]);
        (near.mul_add(self.inverse[axis], self.near[axis]), far.mul_add(self.inverse[axis], self.far[axis]))
    }

    #[inline(always)]
    fn slab(&self, token: L::Token, node: &Node, place: usize, axis: usize) -> (L, L) {
        let lower = L::splat(token, node.bounds[0][axis][place]) * self.inverse[axis];
        let upper = L::splat(token, node.bounds[1][axis][place]) * self.inverse[axis];
        (lower.min(upper) + self.near[axis], lower.max(upper) + self.far[axis])
    }
}
