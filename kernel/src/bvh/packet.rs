//! Several rays at a time, one a lane: one box or one triangle a step, or, for the few rays that come to a place, each
//! with all boxes or triangles there.

use super::slabs::{PacketSlabs, SHORTEST, Slabs};
use super::{Bvh, Child, Node, Part, STACK};
use crate::counter::Counter;
use crate::lanes::{Lanes, Mask, Simd};
use crate::ray::{Hit, RayPacket};
use crate::triangle::{Axes, Found, Sheared, Single, TriangleBlock, Turn};
use crate::vec3x::{self, Vec3x};
use arrayvec::ArrayVec;
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

    /// Whether a ray needs no more than one hit, and of that no more than the triangle.
    const ANY: bool = false;

    /// Takes hits on the triangle in a lane of a block: rays of `bits`. Gives the rays that need no more.
    fn hits(
        &mut self,
        bits: u32,
        block: &TriangleBlock,
        lane: usize,
        found: &Found,
        t_max: &mut [f32; 16],
    ) -> u32;
}

/// Hears of the rays, by bits, that the triangle in a lane of a block blocks.
pub(super) trait Note {
    fn note(&mut self, bits: u32, block: &TriangleBlock, lane: usize);
}

/// Does not care.
pub(super) struct Nobody;

impl Note for Nobody {
    #[inline(always)]
    fn note(&mut self, _: u32, _: &TriangleBlock, _: usize) {}
}

/// Keeps the triangle of each ray, counted from the `from`th.
struct Occluders<'o> {
    from: usize,
    occluders: &'o mut [Option<u32>; RayPacket::WIDTH],
}

impl Note for Occluders<'_> {
    #[inline(always)]
    fn note(&mut self, mut bits: u32, block: &TriangleBlock, lane: usize) {
        while bits != 0 {
            self.occluders[(self.from + bits.trailing_zeros() as usize) & 15] = Some(block.ids[lane]);
            bits &= bits - 1;
        }
    }
}

/// Ends each ray at its first hit.
pub(super) struct Any<N> {
    pub(super) blocked: u32,
    pub(super) note: N,
}

impl<L: Lanes, N: Note> PacketVisitor<L> for Any<N> {
    const ORDERED: bool = false;
    const ANY: bool = true;

    #[inline(always)]
    fn hits(&mut self, bits: u32, block: &TriangleBlock, lane: usize, _: &Found, _: &mut [f32; 16]) -> u32 {
        self.blocked |= bits;
        self.note.note(bits, block, lane);
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
    fn hits(
        &mut self,
        mut bits: u32,
        block: &TriangleBlock,
        place: usize,
        found: &Found,
        t_max: &mut [f32; 16],
    ) -> u32 {
        let triangle = block.ids[place];
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
    fn hits(
        &mut self,
        mut bits: u32,
        block: &TriangleBlock,
        place: usize,
        found: &Found,
        _: &mut [f32; 16],
    ) -> u32 {
        let triangle = block.ids[place];
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

/// The rays of a packet, one by one, as the tests of one ray want them.
struct Ends {
    slabs: [[[f32; 16]; 3]; 3],
    origin: [[f32; 16]; 3],
    direction: [[f32; 16]; 3],
    shear: [[f32; 16]; 3],
    t_min: [f32; 16],
}

impl Ends {
    #[inline(always)]
    fn of<L: Lanes>(slabs: &PacketSlabs<L>, sheared: &Sheared<L>) -> Self {
        let mut ends = Self {
            slabs: [[[0.0; 16]; 3]; 3],
            origin: [[0.0; 16]; 3],
            direction: [[0.0; 16]; 3],
            shear: [[0.0; 16]; 3],
            t_min: [0.0; 16],
        };
        slabs.store(&mut ends.slabs);
        let mut axis = 0;
        while axis < 3 {
            sheared.origin[axis].store(&mut ends.origin[axis]);
            sheared.direction[axis].store(&mut ends.direction[axis]);
            sheared.shear[axis].store(&mut ends.shear[axis]);
            axis += 1;
        }
        sheared.t_min.store(&mut ends.t_min);
        ends
    }

    /// The same numbers as in the packet's lane: shear and origin decide answers.
    #[inline(always)]
    fn sheared<L: Lanes>(&self, token: L::Token, axes: Axes, lane: usize, t_max: f32) -> Sheared<L> {
        Sheared {
            turn: Turn::Same(axes),
            turned: [
                L::splat(token, self.origin[axes.x][lane]),
                L::splat(token, self.origin[axes.y][lane]),
                L::splat(token, self.origin[axes.z][lane]),
            ],
            origin: vec3x::broadcast(token, &self.origin, lane),
            direction: vec3x::broadcast(token, &self.direction, lane),
            shear: vec3x::broadcast(token, &self.shear, lane),
            t_min: L::splat(token, self.t_min[lane]),
            t_max: L::splat(token, t_max),
        }
    }
}

/// Of as many rays of a vector or fewer, each is tested against all boxes of a node; more are tested side by side against
/// one box after the other.
pub(super) const FEW_AT_NODE: u32 = 4;

/// The same with the triangles of a block.
pub(super) const FEW_AT_BLOCK: u32 = 5;

/// The 8 by 8 bits of a word, rows as columns.
#[inline(always)]
pub(super) fn transposed(x: u64) -> u64 {
    let t = (x ^ (x >> 7)) & 0x00aa_00aa_00aa_00aa;
    let x = x ^ t ^ (t << 7);
    let t = (x ^ (x >> 14)) & 0x0000_cccc_0000_cccc;
    let x = x ^ t ^ (t << 14);
    let t = (x ^ (x >> 28)) & 0x0000_0000_f0f0_f0f0;
    x ^ t ^ (t << 28)
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
        let mut from = 0;
        while from < RayPacket::WIDTH {
            let mut any = Any { blocked: 0, note: Nobody };
            self.traverse_chunk(rays, active, from, ignore, counter, &mut any);
            blocked |= any.blocked << from;
            from += S::Packet::WIDTH;
        }
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
        let mut from = 0;
        while from < RayPacket::WIDTH {
            let note = Occluders { from, occluders: &mut occluders };
            self.traverse_chunk(rays, active, from, ignore, counter, &mut Any { blocked: 0, note });
            from += S::Packet::WIDTH;
        }
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
        let mut from = 0;
        while from < RayPacket::WIDTH {
            let mut closest = Closest { from, best: &mut best };
            self.traverse_chunk(rays, active, from, ignore, counter, &mut closest);
            from += S::Packet::WIDTH;
        }
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
        let mut from = 0;
        while from < RayPacket::WIDTH {
            let mut each = Each { from, visit: &mut visit };
            self.traverse_chunk(rays, active, from, ignore, counter, &mut each);
            from += S::Packet::WIDTH;
        }
    }

    /// Asks about as many rays from the `from`th on as a vector holds.
    ///
    /// The callers' loops are spelt out: a closure would not be compiled for the instructions of a task.
    #[inline(always)]
    fn traverse_chunk<V: PacketVisitor<S::Packet>>(
        &self,
        rays: &RayPacket,
        active: u32,
        from: usize,
        ignore: Option<u32>,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        let token = self.simd.token();
        let active = active >> from & ((1 << S::Packet::WIDTH) - 1);
        if active == 0 {
            return;
        }
        counter.rays(active.count_ones());
        let chunk = Rays {
            origin: vec3x::load(token, &rays.origin, from),
            direction: vec3x::load(token, &rays.direction, from),
            t_min: S::Packet::load(token, &rays.t_min[from..]),
            t_max: S::Packet::load(token, &rays.t_max[from..]),
        };
        self.traverse_rays(&chunk, active, ignore, counter, visitor);
    }

    /// Asks about the rays of `active`.
    #[inline(always)]
    pub(super) fn traverse_rays<V: PacketVisitor<S::Packet>>(
        &self,
        rays: &Rays<S::Packet>,
        active: u32,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        if !self.nodes.is_empty() {
            self.simd.apart(
                #[inline(always)]
                || self.traverse_axes(rays, active, part, counter, visitor),
            );
        }
    }

    #[inline(always)]
    fn traverse_axes<V: PacketVisitor<S::Packet>>(
        &self,
        rays: &Rays<S::Packet>,
        active: u32,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        if let Some(ready) = self.make_ready(rays, active) {
            self.traverse_packet(rays, &ready, part, counter, visitor);
        }
    }

    /// Those of the rays of `active` that may hit something; `None` if none can.
    #[inline(always)]
    pub(super) fn make_ready(&self, rays: &Rays<S::Packet>, active: u32) -> Option<Ready<S::Packet>> {
        let token = self.simd.token();
        let infinity = S::Packet::splat(token, f32::INFINITY);
        let length = vec3x::abs(rays.direction);
        let place = vec3x::abs(rays.origin);
        let [x, y, z] = length;
        let finite = x.lt(infinity) & y.lt(infinity) & z.lt(infinity);
        let finite = finite & place[0].lt(infinity) & place[1].lt(infinity) & place[2].lt(infinity);
        let shortest = S::Packet::splat(token, SHORTEST);
        let active = active & (finite & shortest.le(vec3x::most(length))).bits();
        if active == 0 {
            return None;
        }
        // The rule of `Axes::dominant`.
        let (first, second) = (y.le(x) & z.le(x), z.le(y));
        let along_x = active & first.bits();
        let along_y = active & !along_x & second.bits();
        let along = [along_x, along_y, active & !along_x & !along_y];
        let turn = Turn::same(along, active).unwrap_or(Turn::Each([first, second]));
        let reach = S::Packet::splat(token, self.magnitude) + vec3x::most(place);
        Some(Ready { along, turn, slack: reach * S::Packet::splat(token, 16.0 * super::ROUNDING) })
    }

    #[inline(always)]
    fn traverse_packet<V: PacketVisitor<S::Packet>>(
        &self,
        rays: &Rays<S::Packet>,
        ready: &Ready<S::Packet>,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        let token = self.simd.token();
        let &Ready { along, turn, slack } = ready;
        let active = along[0] | along[1] | along[2];
        let slabs = &PacketSlabs::new(token, active, rays.origin, rays.direction, rays.t_min, slack);
        let sheared = Sheared::new(token, turn, rays.origin, rays.direction, rays.t_min, rays.t_max);
        let mut this = Going { sheared, t_max: [0.0; 16], active };
        this.sheared.t_max.store(&mut this.t_max);
        // The child, the rays that meet its box, and where the first of them enters it.
        let mut stack = ArrayVec::<(Child, u32, f32), STACK>::new();
        // Rays one by one, once they are wanted.
        let mut ends = None;
        stack.push((Child::node(0), active, 0.0));
        while let Some((next, meet, _)) = stack.pop() {
            let meet = meet & this.active;
            if meet == 0 {
                continue;
            }
            let few = V::ANY && meet.count_ones() <= if next.is_leaf() { FEW_AT_BLOCK } else { FEW_AT_NODE };
            if few && ends.is_none() {
                ends = Some(Ends::of(slabs, &this.sheared));
            }
            match &ends {
                Some(ends) if few && next.is_leaf() => {
                    let block = (&self.blocks[next.block()], next.bits());
                    self.meet_block_each(block, meet, along, ends, &mut this, part, counter, visitor);
                }
                Some(ends) if few => {
                    let node = &self.nodes[next.index()];
                    self.meet_node_each(node, meet, ends, &this, &mut stack, part, counter);
                }
                _ if next.is_leaf() => {
                    let block = (&self.blocks[next.block()], next.bits());
                    self.meet_block(block, meet, &mut this, part, counter, visitor);
                }
                _ => {
                    let node = &self.nodes[next.index()];
                    self.meet_node::<V>(node, meet, slabs, &mut this, &mut stack, part, counter);
                }
            }
            if this.active == 0 {
                return;
            }
        }
    }

    #[inline(always)]
    fn meet_block<V: PacketVisitor<S::Packet>>(
        &self,
        (block, mut lanes): (&TriangleBlock, u32),
        meet: u32,
        this: &mut Going<S::Packet>,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        let token = self.simd.token();
        while lanes != 0 {
            let at = lanes.trailing_zeros() as usize & 7;
            lanes &= lanes - 1;
            let id = block.ids[at];
            if id == crate::triangle::NO_TRIANGLE {
                break;
            }
            if !part.holds(id) {
                continue;
            }
            counter.triangle_tests((meet & this.active).count_ones());
            let crossing = this.sheared.cross(token, Single { block, lane: at });
            let bits = crossing.hit.bits() & meet & this.active;
            if bits == 0 {
                continue;
            }
            this.active &= !if V::ANY {
                visitor.hits(bits, block, at, &Found::NOTHING, &mut this.t_max)
            } else {
                let mut found = Found::NOTHING;
                crossing.det.store(&mut found.det);
                crossing.t.store(&mut found.t);
                crossing.u.store(&mut found.u);
                crossing.v.store(&mut found.v);
                visitor.hits(bits, block, at, &found, &mut this.t_max)
            };
            if this.active == 0 {
                return;
            }
            if V::ORDERED {
                this.sheared.t_max = S::Packet::load(token, &this.t_max);
            }
        }
    }

    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn meet_node<V: PacketVisitor<S::Packet>>(
        &self,
        node: &Node,
        meet: u32,
        slabs: &PacketSlabs<S::Packet>,
        this: &mut Going<S::Packet>,
        stack: &mut ArrayVec<(Child, u32, f32), STACK>,
        part: impl Part,
        counter: &mut impl Counter,
    ) {
        let token = self.simd.token();
        counter.node_tests(node.len() * meet.count_ones());
        let first = stack.len();
        // The first child comes on top.
        let mut place = Node::WIDTH;
        while place > 0 {
            place -= 1;
            let child = node.children[place];
            if child != Child::NONE && part.below(child) {
                let (hit, enter) = slabs.meet(token, node, place, this.sheared.t_max);
                let meet = hit.bits() & meet;
                if meet != 0 {
                    // Depth is checked at construction, so there is always room.
                    stack.push((child, meet, 0.0));
                    if V::ORDERED {
                        let mut entry = [0.0; 16];
                        enter.store(&mut entry);
                        let at = entry[meet.trailing_zeros() as usize & 15];
                        let mut slot = stack.len() - 1;
                        while slot > first && stack[slot - 1].2 < at {
                            stack[slot] = stack[slot - 1];
                            slot -= 1;
                        }
                        stack[slot] = (child, meet, at);
                    }
                }
            }
        }
    }

    /// A block that few rays meet: each of them with all of its triangles.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn meet_block_each<V: PacketVisitor<S::Packet>>(
        &self,
        (block, lanes): (&TriangleBlock, u32),
        meet: u32,
        along: [u32; 3],
        ends: &Ends,
        this: &mut Going<S::Packet>,
        part: impl Part,
        counter: &mut impl Counter,
        visitor: &mut V,
    ) {
        let token = self.simd.token();
        let mut left = meet;
        while left != 0 {
            let ray = left.trailing_zeros() as usize & 15;
            left &= left - 1;
            let axis = usize::from(along[1] >> ray & 1 != 0) + 2 * usize::from(along[2] >> ray & 1 != 0);
            let sheared = ends.sheared::<S::Node>(token, Axes::of(axis), ray, this.t_max[ray]);
            counter.triangle_tests(part.count(block, lanes));
            let mut hits = sheared.block_hits(token, block) & lanes;
            while hits != 0 {
                let lane = hits.trailing_zeros() as usize & 7;
                hits &= hits - 1;
                if part.holds(block.ids[lane]) {
                    this.active &= !visitor.hits(1 << ray, block, lane, &Found::NOTHING, &mut this.t_max);
                    break;
                }
            }
        }
    }

    /// A node that few rays meet: each of them with all of its boxes.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn meet_node_each(
        &self,
        node: &Node,
        meet: u32,
        ends: &Ends,
        this: &Going<S::Packet>,
        stack: &mut ArrayVec<(Child, u32, f32), STACK>,
        part: impl Part,
        counter: &mut impl Counter,
    ) {
        let token = self.simd.token();
        counter.node_tests(node.len() * meet.count_ones());
        // The children that each ray meets, a byte a ray, and those that any of them meets.
        let (mut rows, mut any) = ([0u64; 2], 0);
        let mut entry = [0.0; 8];
        let mut left = meet;
        while left != 0 {
            let ray = left.trailing_zeros() as usize & 15;
            left &= left - 1;
            let slabs = Slabs::<S::Node>::of_lane(token, ends.slabs.each_ref(), ray, ends.t_min[ray]);
            let met = slabs.children(token, node, this.t_max[ray], &mut entry);
            any |= met;
            rows[ray / 8] |= u64::from(met) << (8 * (ray % 8));
        }
        let columns = [transposed(rows[0]), if S::Packet::WIDTH > 8 { transposed(rows[1]) } else { 0 }];
        while any != 0 {
            // The first child comes on top.
            let place = (31 - any.leading_zeros()) as usize & 7;
            any &= !(1 << place);
            let child = node.children[place];
            if child != Child::NONE && part.below(child) {
                let meet = (columns[0] >> (8 * place) & 0xff) | ((columns[1] >> (8 * place) & 0xff) << 8);
                // Depth is checked at construction, so there is always room.
                stack.push((child, meet as u32, 0.0));
            }
        }
    }
}

/// What boxes and triangles are held against rays with.
pub(super) struct Ready<L: Lanes> {
    /// The rays by dominant axis.
    pub(super) along: [u32; 3],
    pub(super) turn: Turn<L>,
    /// What boxes are widened by.
    pub(super) slack: L,
}

/// A packet on its way through the tree.
struct Going<L: Lanes> {
    sheared: Sheared<L>,
    t_max: [f32; 16],
    /// Rays that want more.
    active: u32,
}
