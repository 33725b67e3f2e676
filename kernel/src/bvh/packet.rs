//! Several rays at a time, one a lane: one box or one triangle a step.

use super::slabs::{PacketSlabs, SHORTEST};
use super::{Bvh, Child, Node, Part, STACK};
use crate::counter::Counter;
use crate::lanes::{Lanes, Mask, Simd};
use crate::ray::{Hit, RayPacket};
use crate::triangle::{Axes, Found, Sheared, TriangleBlock};
use crate::vec3x::{self, Vec3x};
use core::ops::ControlFlow;

/// The nearest hits of a packet.
#[derive(Clone, Copy, Debug)]
pub struct HitPacket {
    /// Bit `i` is set where ray `i` hit something.
    pub hit: u32,
    /// The hit of each ray; only those of the mask mean anything.
    pub hits: [Hit; RayPacket::WIDTH],
}

/// Rays side by side, as vectors.
pub(super) struct Rays<L> {
    pub(super) origin: Vec3x<L>,
    pub(super) direction: Vec3x<L>,
    pub(super) t_min: L,
    pub(super) t_max: L,
}

/// What becomes of the hits of a packet.
pub(super) trait PacketVisitor<L: Lanes> {
    /// Whether `t_max` shrinks, so that near boxes come first.
    const ORDERED: bool;

    /// Takes hits on one triangle: rays of `bits`. Gives the rays that need no more.
    fn hits(&mut self, bits: u32, triangle: u32, found: &Found, t_max: &mut [f32; 16]) -> u32;
}

/// Ends each ray at its first hit.
pub(super) struct Any<F> {
    pub(super) blocked: u32,
    pub(super) note: F,
}

impl<L: Lanes, F: FnMut(u32, u32)> PacketVisitor<L> for Any<F> {
    const ORDERED: bool = false;

    #[inline(always)]
    fn hits(&mut self, bits: u32, triangle: u32, _: &Found, _: &mut [f32; 16]) -> u32 {
        self.blocked |= bits;
        (self.note)(bits, triangle);
        bits
    }
}

struct Closest<'h> {
    from: usize,
    best: &'h mut HitPacket,
}

impl<L: Lanes> PacketVisitor<L> for Closest<'_> {
    const ORDERED: bool = true;

    #[inline(always)]
    fn hits(&mut self, mut bits: u32, triangle: u32, found: &Found, t_max: &mut [f32; 16]) -> u32 {
        while bits != 0 {
            let lane = bits.trailing_zeros() as usize & 15;
            bits &= bits - 1;
            let ray = self.from + lane;
            let hit = found.hit(lane, triangle);
            if self.best.hit >> ray & 1 == 0 || hit.nearer_than(&self.best.hits[ray]) {
                self.best.hit |= 1 << ray;
                self.best.hits[ray] = hit;
                // The test compares products, whose rounding must not hide a hit at the same quotient.
                t_max[lane] = t_max[lane].min(hit.t + hit.t.abs() * (2.0 * f32::EPSILON));
            }
        }
        0
    }
}

struct Each<F> {
    from: usize,
    visit: F,
}

impl<L: Lanes, F: FnMut(usize, Hit) -> ControlFlow<()>> PacketVisitor<L> for Each<F> {
    const ORDERED: bool = false;

    #[inline(always)]
    fn hits(&mut self, mut bits: u32, triangle: u32, found: &Found, _: &mut [f32; 16]) -> u32 {
        let mut done = 0;
        while bits != 0 {
            let lane = bits.trailing_zeros() as usize & 15;
            bits &= bits - 1;
            if (self.visit)(self.from + lane, found.hit(lane, triangle)).is_break() {
                done |= 1 << lane;
            }
        }
        done
    }
}

impl<S: Simd> Bvh<'_, S> {
    /// Which of the rays of `active` does anything but `ignore` block? A bit for each.
    #[inline(always)]
    pub fn occluded_packet(
        &self,
        rays: &RayPacket,
        active: u32,
        ignore: Option<u32>,
        counter: &mut impl Counter,
    ) -> u32 {
        let mut blocked = 0;
        self.chunks(rays, active, counter, |chunk, active, from, counter| {
            let mut any = Any { blocked: 0, note: |_, _| () };
            self.traverse_rays(chunk, active, ignore, counter, &mut any);
            blocked |= any.blocked << from;
        });
        blocked
    }

    /// Which triangle blocks each of the rays of `active`: some one of them, not the nearest.
    #[inline(always)]
    pub fn occluder_packet(
        &self,
        rays: &RayPacket,
        active: u32,
        ignore: Option<u32>,
        counter: &mut impl Counter,
    ) -> [Option<u32>; RayPacket::WIDTH] {
        let mut occluders = [None; RayPacket::WIDTH];
        self.chunks(rays, active, counter, |chunk, active, from, counter| {
            let note = |mut bits: u32, triangle: u32| {
                while bits != 0 {
                    occluders[(from + bits.trailing_zeros() as usize) & 15] = Some(triangle);
                    bits &= bits - 1;
                }
            };
            self.traverse_rays(chunk, active, ignore, counter, &mut Any { blocked: 0, note });
        });
        occluders
    }

    /// The nearest hit of each of the rays of `active`. Of several at the same `t`, that of the lowest number.
    #[inline(always)]
    pub fn closest_packet(
        &self,
        rays: &RayPacket,
        active: u32,
        ignore: Option<u32>,
        counter: &mut impl Counter,
    ) -> HitPacket {
        let nothing = Hit { t: 0.0, u: 0.0, v: 0.0, triangle: 0 };
        let mut best = HitPacket { hit: 0, hits: [nothing; RayPacket::WIDTH] };
        self.chunks(rays, active, counter, |chunk, active, from, counter| {
            self.traverse_rays(chunk, active, ignore, counter, &mut Closest { from, best: &mut best });
        });
        best
    }

    /// Every hit of the rays of `active`, in no order, as the ray's place and the hit. A ray for which `visit`
    /// breaks is asked no further.
    #[inline(always)]
    pub fn each_hit_packet(
        &self,
        rays: &RayPacket,
        active: u32,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        mut visit: impl FnMut(usize, Hit) -> ControlFlow<()>,
    ) {
        self.chunks(rays, active, counter, |chunk, active, from, counter| {
            self.traverse_rays(chunk, active, ignore, counter, &mut Each { from, visit: &mut visit });
        });
    }

    /// Hands out a packet as many rays at a time as a vector holds.
    #[inline(always)]
    fn chunks<C: Counter>(
        &self,
        rays: &RayPacket,
        active: u32,
        counter: &mut C,
        mut ask: impl FnMut(&Rays<S::Packet>, u32, usize, &mut C),
    ) {
        let token = self.simd.token();
        let width = S::Packet::WIDTH;
        for from in (0..RayPacket::WIDTH).step_by(width) {
            let active = active >> from & ((1 << width) - 1);
            if active == 0 {
                continue;
            }
            let chunk = Rays {
                origin: vec3x::load(token, &rays.origin, from),
                direction: vec3x::load(token, &rays.direction, from),
                t_min: S::Packet::load(token, &rays.t_min[from..]),
                t_max: S::Packet::load(token, &rays.t_max[from..]),
            };
            ask(&chunk, active, from, counter);
        }
    }

    /// Asks about the rays of `active`, those of one dominant axis at a time.
    #[inline(always)]
    pub(super) fn traverse_rays<V: PacketVisitor<S::Packet>>(
        &self,
        rays: &Rays<S::Packet>,
        active: u32,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        counter.rays(active.count_ones());
        if self.nodes.is_empty() {
            return;
        }
        let token = self.simd.token();
        let infinity = S::Packet::splat(token, f32::INFINITY);
        let length = vec3x::abs(rays.direction);
        let place = vec3x::abs(rays.origin);
        let [x, y, z] = length;
        let finite = x.lt(infinity) & y.lt(infinity) & z.lt(infinity);
        let finite = finite & place[0].lt(infinity) & place[1].lt(infinity) & place[2].lt(infinity);
        let shortest = S::Packet::splat(token, SHORTEST);
        let active = active & (finite & shortest.le(vec3x::most(length))).bits();
        // The rule of `Axes::dominant`.
        let along_x = active & (y.le(x) & z.le(x)).bits();
        let along_y = active & !along_x & z.le(y).bits();
        let along_z = active & !along_x & !along_y;

        let reach = S::Packet::splat(token, self.magnitude) + vec3x::most(place);
        let slack = reach * S::Packet::splat(token, 16.0 * super::ROUNDING);
        let slabs = PacketSlabs::new(token, rays.origin, rays.direction, rays.t_min, slack);
        let mut axis = 0;
        while axis < 3 {
            let active = [along_x, along_y, along_z][axis];
            if active != 0 {
                self.traverse_packet(rays, &slabs, Axes::of(axis), active, part, counter, visitor);
            }
            axis += 1;
        }
    }

    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn traverse_packet<V: PacketVisitor<S::Packet>>(
        &self,
        rays: &Rays<S::Packet>,
        slabs: &PacketSlabs<S::Packet>,
        axes: Axes,
        mut active: u32,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        let token = self.simd.token();
        let mut sheared = Sheared::new(token, axes, rays.origin, rays.direction, rays.t_min, rays.t_max);
        let mut t_max = [0.0f32; 16];
        sheared.t_max.store(&mut t_max);
        let mut found = Found::NOTHING;
        // The child, the rays that meet its box, and where the first of them enters it.
        let mut stack = [(Child::NONE, 0u32, 0.0f32); STACK];
        let mut len = 1;
        stack[0] = (Child::node(0), active, 0.0);
        while len > 0 {
            len -= 1;
            let (next, meet, _) = stack[len];
            let meet = meet & active;
            if meet == 0 {
                continue;
            }
            if next.is_leaf() {
                let block = &self.blocks[next.index()];
                for lane in 0..TriangleBlock::WIDTH {
                    let id = block.ids[lane];
                    if id == crate::triangle::NO_TRIANGLE {
                        break;
                    }
                    if !part.holds(id) {
                        continue;
                    }
                    counter.triangle_tests((meet & active).count_ones());
                    let [a, b, c] = &block.vertices;
                    let triangle = [
                        vec3x::broadcast(token, a, lane),
                        vec3x::broadcast(token, b, lane),
                        vec3x::broadcast(token, c, lane),
                    ];
                    let crossing = sheared.cross(token, triangle);
                    let bits = crossing.hit.bits() & meet & active;
                    if bits == 0 {
                        continue;
                    }
                    crossing.det.store(&mut found.det);
                    crossing.t.store(&mut found.t);
                    crossing.u.store(&mut found.u);
                    crossing.v.store(&mut found.v);
                    active &= !visitor.hits(bits, id, &found, &mut t_max);
                    if active == 0 {
                        return;
                    }
                    if V::ORDERED {
                        sheared.t_max = S::Packet::load(token, &t_max);
                    }
                }
            } else {
                let node = &self.nodes[next.index()];
                counter.node_tests(node.len() * meet.count_ones());
                let first = len;
                let mut entry = [0.0; 16];
                for place in 0..Node::WIDTH {
                    let child = node.children[place];
                    if child == Child::NONE || !part.below(child) {
                        continue;
                    }
                    let (hit, enter) = slabs.meet(token, node, place, sheared.t_max);
                    let meet = hit.bits() & meet;
                    if meet == 0 {
                        continue;
                    }
                    let mut slot = len;
                    let mut at = 0.0;
                    if V::ORDERED {
                        enter.store(&mut entry);
                        at = entry[meet.trailing_zeros() as usize & 15];
                        while slot > first && stack[slot - 1].2 < at {
                            stack[slot] = stack[slot - 1];
                            slot -= 1;
                        }
                    }
                    stack[slot] = (child, meet, at);
                    len += 1;
                }
            }
        }
    }
}
