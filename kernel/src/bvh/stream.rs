//! Up to 64 segments on their way through the tree together: a bit each.
//!
//! They are kept number by number, so that at a node or a block either each of a few rays can be tested against all boxes
//! or triangles at once, or each box or triangle against a vector of rays: whichever is less work there. What takes time
//! besides the tests, above all guessing wrongly what comes next, is shared by all rays that come to a place. Of rays
//! that go together, what they have in common ([`super::hull`]) tells first which boxes and triangles need a test.

use super::hull::Hull;
use super::packet::{FEW_AT_BLOCK, FEW_AT_NODE, Rays, Ready, transposed};
use super::pyramid::{Learner, MOST, greatest_of, least_of};
use super::slabs::{PacketSlabs, Slabs};
use super::{ALL_LANES, Bvh, Child, Node, Part, STACK};
use crate::counter::Counter;
use crate::lanes::{Lanes, Mask, Simd};
use crate::triangle::{Axes, NO_TRIANGLE, Sheared, Single, TriangleBlock, Turn};
use crate::vec3x::{self, Vec3x};
use arrayvec::ArrayVec;
use glam::Vec3;

/// Segments, of which `t` runs from 0 to 1.
pub(super) struct Stream {
    inverse: [[f32; MOST]; 3],
    near: [[f32; MOST]; 3],
    far: [[f32; MOST]; 3],
    /// Which sides are near, for each eight rays, if that is the same for all of them.
    near_side: [Option<[usize; 3]>; MOST / 8],
    /// Along x, y and z of the triangle test.
    turned: [[f32; MOST]; 3],
    origin: [[f32; MOST]; 3],
    direction: [[f32; MOST]; 3],
    shear: [[f32; MOST]; 3],
    /// Rays by dominant axis.
    along: [u64; 3],
    /// Around all rays, where that was asked for.
    hull: Option<Hull>,
    /// Nodes and blocks that the last rays came to, and how many of the rays came to each.
    pub(super) visits: u64,
    pub(super) comers: u64,
}

impl Stream {
    pub(super) const EMPTY: Self = Self {
        inverse: [[0.0; MOST]; 3],
        near: [[0.0; MOST]; 3],
        far: [[0.0; MOST]; 3],
        near_side: [None; MOST / 8],
        turned: [[0.0; MOST]; 3],
        origin: [[0.0; MOST]; 3],
        direction: [[0.0; MOST]; 3],
        shear: [[0.0; MOST]; 3],
        along: [0; 3],
        hull: None,
        visits: 0,
        comers: 0,
    };

    /// For other rays.
    #[inline(always)]
    pub(super) fn clear(&mut self) {
        self.along = [0; 3];
        self.hull = None;
    }

    /// All rays that may hit something.
    #[inline(always)]
    fn every(&self) -> u64 {
        self.along[0] | self.along[1] | self.along[2]
    }

    /// Finds what all rays have in common. Takes as long as testing all of them once; pays where they go together.
    #[inline(always)]
    pub(super) fn surround<S: Simd>(&mut self, simd: S, magnitude: f32) {
        type P<S> = <S as Simd>::Packet;
        let token = simd.token();
        let every = self.every();
        if every == 0 {
            return;
        }
        let one = every.trailing_zeros() as usize;
        let full = u64::MAX >> (64 - P::<S>::WIDTH);
        let (mut begin, mut end) = ([Vec3::ZERO; 2], [Vec3::ZERO; 2]);
        let mut axis = 0;
        while axis < 3 {
            let (origin, direction) = (&self.origin[axis], &self.direction[axis]);
            let some = [origin[one], origin[one] + direction[one]];
            let (mut low, mut high) = (some, some);
            let some = [P::<S>::splat(token, some[0]), P::<S>::splat(token, some[1])];
            let (mut least, mut most) = (some, some);
            let mut from = 0;
            while from < MOST {
                let mut rays = every >> from & full;
                if rays == full {
                    let origin = P::<S>::load(token, &origin[from..]);
                    let end = origin + P::<S>::load(token, &direction[from..]);
                    (least, most) =
                        ([least[0].min(origin), least[1].min(end)], [most[0].max(origin), most[1].max(end)]);
                    rays = 0;
                }
                while rays != 0 {
                    let ray = (from + rays.trailing_zeros() as usize) & (MOST - 1);
                    rays &= rays - 1;
                    let (origin, end) = (origin[ray], origin[ray] + direction[ray]);
                    (low, high) =
                        ([low[0].min(origin), low[1].min(end)], [high[0].max(origin), high[1].max(end)]);
                }
                from += P::<S>::WIDTH;
            }
            begin[0][axis] = least_of(least[0]).min(low[0]);
            begin[1][axis] = greatest_of(most[0]).max(high[0]);
            end[0][axis] = least_of(least[1]).min(low[1]);
            end[1][axis] = greatest_of(most[1]).max(high[1]);
            axis += 1;
        }
        self.hull = Hull::new(begin, end, magnitude);
    }

    #[inline(always)]
    fn axes(&self, ray: usize) -> Axes {
        Axes::of(usize::from(self.along[1] >> ray & 1 != 0) + 2 * usize::from(self.along[2] >> ray & 1 != 0))
    }

    /// A ray for the boxes of a node.
    #[inline(always)]
    fn slabs<L: Lanes>(&self, token: L::Token, ray: usize) -> Slabs<L> {
        Slabs::of_lane(token, [&self.inverse, &self.near, &self.far], ray, 0.0)
    }

    /// Rays from `from` on for a box.
    #[inline(always)]
    fn packet_slabs<L: Lanes>(&self, token: L::Token, from: usize) -> PacketSlabs<L> {
        let constants = [
            vec3x::load(token, &self.inverse, from),
            vec3x::load(token, &self.near, from),
            vec3x::load(token, &self.far, from),
        ];
        let near_side = if L::WIDTH > 8 && self.near_side[from / 8] != self.near_side[(from / 8 + 1) & 7] {
            None
        } else {
            self.near_side[from / 8]
        };
        PacketSlabs::from_constants(constants, L::splat(token, 0.0), near_side)
    }

    /// A ray for the triangles of a block.
    #[inline(always)]
    fn sheared<L: Lanes>(&self, token: L::Token, ray: usize) -> Sheared<L> {
        Sheared {
            turn: Turn::Same(self.axes(ray)),
            turned: vec3x::broadcast(token, &self.turned, ray),
            origin: vec3x::broadcast(token, &self.origin, ray),
            direction: vec3x::broadcast(token, &self.direction, ray),
            shear: vec3x::broadcast(token, &self.shear, ray),
            t_min: L::splat(token, 0.0),
            t_max: L::splat(token, 1.0),
        }
    }

    /// Those of `rays` from `from` on for a triangle.
    #[inline(always)]
    fn packet_sheared<L: Lanes>(&self, token: L::Token, from: usize, rays: u32) -> Sheared<L> {
        let direction = vec3x::load(token, &self.direction, from);
        let [x, y, z] = self.along;
        let along = [(x >> from) as u32 & rays, (y >> from) as u32 & rays, (z >> from) as u32 & rays];
        let turn = match Turn::same(along, rays) {
            Some(turn) => turn,
            None => Turn::each(direction),
        };
        Sheared {
            turn,
            turned: vec3x::load(token, &self.turned, from),
            origin: vec3x::load(token, &self.origin, from),
            direction,
            shear: vec3x::load(token, &self.shear, from),
            t_min: L::splat(token, 0.0),
            t_max: L::splat(token, 1.0),
        }
    }
}

/// Where rays begin: at the root, or with some triangles and subtrees, as children of nodes made for it.
pub(super) struct Start<'c> {
    pub(super) root: bool,
    pub(super) blocks: &'c [TriangleBlock],
    pub(super) nodes: &'c [Node],
    /// Subtrees, and which of the rays may meet them.
    pub(super) entries: &'c [(Child, f32, u64)],
}

impl Start<'_> {
    /// At the root.
    pub(super) const ROOT: Start<'static> = Start { root: true, blocks: &[], nodes: &[], entries: &[] };
}

#[inline(always)]
fn store<L: Lanes>(v: Vec3x<L>, to: &mut [[f32; MOST]; 3], from: usize) {
    v[0].store(&mut to[0][from..]);
    v[1].store(&mut to[1][from..]);
    v[2].store(&mut to[2][from..]);
}

impl<S: Simd> Bvh<'_, S> {
    /// Takes in the rays of `active` as those from `from` on, a multiple of the vectors' width.
    #[inline(always)]
    pub(super) fn join(&self, stream: &mut Stream, from: usize, rays: &Rays<S::Packet>, active: u32) {
        let token = self.simd.token();
        let Some(Ready { along, turn, slack }) = self.make_ready(rays, active) else { return };
        stream.along[0] |= u64::from(along[0]) << from;
        stream.along[1] |= u64::from(along[1]) << from;
        stream.along[2] |= u64::from(along[2]) << from;
        let sheared = Sheared::new(token, turn, rays.origin, rays.direction, rays.t_min, rays.t_max);
        store(sheared.turned, &mut stream.turned, from);
        store(sheared.origin, &mut stream.origin, from);
        store(sheared.direction, &mut stream.direction, from);
        store(sheared.shear, &mut stream.shear, from);
        let active = along[0] | along[1] | along[2];
        let slabs = PacketSlabs::new(token, active, rays.origin, rays.direction, rays.t_min, slack);
        let [inverse, near, far] = slabs.constants();
        store(inverse, &mut stream.inverse, from);
        store(near, &mut stream.near, from);
        store(far, &mut stream.far, from);
        let mut eight = from / 8;
        while eight * 8 < from + S::Packet::WIDTH {
            // Of eight rays that come in several vectors nothing is known of all.
            stream.near_side[eight & 7] = if S::Packet::WIDTH < 8 { None } else { slabs.near_side() };
            eight += 1;
        }
    }

    /// Which rays of `ask` does anything block?
    #[inline(always)]
    pub(super) fn stream_blocked(
        &self,
        stream: &mut Stream,
        start: &Start<'_>,
        ask: u64,
        part: impl Part,
        counter: &mut impl Counter,
        learner: &mut dyn Learner,
    ) -> u64 {
        if self.nodes.is_empty() {
            return 0;
        }
        self.simd.apart(
            #[inline(always)]
            || self.stream_goes(stream, start, ask, part, counter, learner),
        )
    }

    #[inline(always)]
    fn stream_goes(
        &self,
        stream: &mut Stream,
        start: &Start<'_>,
        ask: u64,
        part: impl Part,
        counter: &mut impl Counter,
        learner: &mut dyn Learner,
    ) -> u64 {
        let ask = ask & stream.every();
        let mut free = ask;
        let mut stack = Waiting::new();
        if start.root {
            stack.push((Child::node(0), ask));
        }
        let mut k = 0;
        while k < start.entries.len() {
            let (child, _, may) = start.entries[k];
            stack.push((child, may));
            k += 1;
        }
        // The tests are large, so they stand here once, for what is given as for what is come to.
        let (mut blocks, mut nodes) = (0, start.nodes.len());
        let (mut visits, mut comers) = (0, 0);
        while free != 0 {
            let (block, node, meet);
            // Is this the last of the given nodes?
            let mut given = false;
            if blocks < start.blocks.len() {
                (block, node, meet) = (Some((&start.blocks[blocks], ALL_LANES)), None, free);
                blocks += 1;
            } else if nodes > 0 {
                nodes -= 1;
                (block, node, meet) = (None, Some(&start.nodes[nodes]), free);
                given = nodes == 0;
            } else {
                let Some((next, may)) = stack.pop() else { break };
                meet = may & free;
                if meet == 0 {
                    continue;
                }
                (block, node) = if next.is_leaf() {
                    (Some((&self.blocks[next.block()], next.bits())), None)
                } else {
                    (None, Some(&self.nodes[next.index()]))
                };
            }
            visits += 1;
            comers += u64::from(meet.count_ones());
            if let Some(block) = block {
                free &= !self.stream_at_block(stream, block, meet, part, counter, learner);
            } else if let Some(node) = node {
                self.stream_at_node(stream, node, meet, &mut stack, part, counter);
                if given {
                    fullest_on_top(&mut stack);
                }
            }
        }
        (stream.visits, stream.comers) = (visits, comers);
        ask & !free
    }

    /// Which rays of `meet` does a block's triangle block?
    #[inline(always)]
    fn stream_at_block(
        &self,
        stream: &Stream,
        (block, lanes): (&TriangleBlock, u32),
        meet: u64,
        part: impl Part,
        counter: &mut impl Counter,
        learner: &mut dyn Learner,
    ) -> u64 {
        let token = self.simd.token();
        let width = S::Packet::WIDTH;
        let mut blocked = 0;
        // How many rays the triangle in each lane blocks.
        let mut blocks = [0u32; 8];
        let lanes = match &stream.hull {
            Some(hull) if meet.count_ones() > FEW_AT_BLOCK => {
                counter.triangle_tests(part.count(block, lanes));
                lanes & hull.triangles(self.simd, block)
            }
            _ => lanes,
        };
        let mut left = meet;
        while left != 0 {
            let from = left.trailing_zeros() as usize / width * width;
            let mut rays = (left >> from) as u32 & ((1 << width) - 1);
            left &= !(u64::from(rays) << from);
            if rays.count_ones() <= FEW_AT_BLOCK {
                while rays != 0 {
                    let ray = from + rays.trailing_zeros() as usize;
                    rays &= rays - 1;
                    counter.triangle_tests(part.count(block, lanes));
                    let sheared = stream.sheared::<S::Node>(token, ray & 63);
                    let mut hits = sheared.block_hits(token, block) & lanes;
                    while hits != 0 {
                        let lane = hits.trailing_zeros() as usize & 7;
                        hits &= hits - 1;
                        if part.holds(block.ids[lane]) {
                            blocked |= 1 << ray;
                            blocks[lane] += 1;
                            break;
                        }
                    }
                }
                continue;
            }
            let sheared = stream.packet_sheared::<S::Packet>(token, from, rays);
            let mut rest = lanes;
            while rest != 0 {
                let lane = rest.trailing_zeros() as usize & 7;
                rest &= rest - 1;
                if block.ids[lane] == NO_TRIANGLE {
                    break;
                }
                if part.holds(block.ids[lane]) {
                    counter.triangle_tests(rays.count_ones());
                    let hit = sheared.cross(token, Single { block, lane }).hit.bits() & rays;
                    if hit != 0 {
                        blocked |= u64::from(hit) << from;
                        blocks[lane] += hit.count_ones();
                        rays &= !hit;
                        if rays == 0 {
                            break;
                        }
                    }
                }
            }
        }
        if blocked != 0 {
            let mut lane = 0;
            while lane < TriangleBlock::WIDTH {
                if blocks[lane] != 0 {
                    learner.learn(block, lane, blocks[lane]);
                }
                lane += 1;
            }
        }
        blocked
    }

    /// Puts the children that rays of `meet` may meet on the stack, the first on top.
    #[inline(always)]
    fn stream_at_node(
        &self,
        stream: &Stream,
        node: &Node,
        meet: u64,
        stack: &mut Waiting,
        part: impl Part,
        counter: &mut impl Counter,
    ) {
        let token = self.simd.token();
        let width = S::Packet::WIDTH;
        // Children that may be met at all.
        let mut near = 0xff;
        if let Some(hull) = &stream.hull
            && meet.count_ones() > FEW_AT_NODE
        {
            counter.node_tests(node.len());
            near = hull.children(self.simd, node);
        }
        // The rays of each child, and the children of any.
        let (mut meets, mut any) = ([0u64; 8], 0);
        let mut entry = [0.0; 8];
        let mut left = meet;
        while left != 0 {
            let from = left.trailing_zeros() as usize / width * width;
            let rays = (left >> from) as u32 & ((1 << width) - 1);
            left &= !(u64::from(rays) << from);
            let mut these = 0;
            if rays.count_ones() <= FEW_AT_NODE {
                counter.node_tests(node.len() * rays.count_ones());
                // A byte a ray, and then a byte a child.
                let mut rows = [0u64; 2];
                let mut rest = rays;
                while rest != 0 {
                    let ray = rest.trailing_zeros() as usize & 15;
                    rest &= rest - 1;
                    let slabs = stream.slabs::<S::Node>(token, (from + ray) & 63);
                    let met = slabs.children(token, node, 1.0, &mut entry);
                    these |= met;
                    rows[ray / 8] |= u64::from(met) << (8 * (ray % 8));
                }
                any |= these;
                let columns = [transposed(rows[0]), if width > 8 { transposed(rows[1]) } else { 0 }];
                while these != 0 {
                    let place = these.trailing_zeros() as usize & 7;
                    these &= these - 1;
                    let met = (columns[0] >> (8 * place) & 0xff) | ((columns[1] >> (8 * place) & 0xff) << 8);
                    meets[place] |= met << from;
                }
            } else {
                let slabs = stream.packet_slabs::<S::Packet>(token, from);
                let end = S::Packet::splat(token, 1.0);
                counter.node_tests(near.count_ones().min(node.len()) * rays.count_ones());
                let mut rest = near;
                while rest != 0 {
                    let place = rest.trailing_zeros() as usize & 7;
                    rest &= rest - 1;
                    if node.children[place] != Child::NONE {
                        let met = slabs.meet(token, node, place, end).0.bits() & rays;
                        these |= u32::from(met != 0) << place;
                        meets[place] |= u64::from(met) << from;
                    }
                }
                any |= these;
            }
        }
        while any != 0 {
            let place = (31 - any.leading_zeros()) as usize & 7;
            any &= !(1 << place);
            let child = node.children[place];
            if child != Child::NONE && part.below(child) {
                // Depth is checked at construction, so there is always room.
                stack.push((child, meets[place]));
            }
        }
    }
}

/// Puts what most rays may meet on top; where about as many do, by powers of two, the order stays.
#[inline(always)]
fn fullest_on_top(stack: &mut Waiting) {
    let mut k = 1;
    while k < stack.len() {
        let this = stack[k];
        let rays = this.1.count_ones().checked_ilog2();
        let mut slot = k;
        while slot > 0 && stack[slot - 1].1.count_ones().checked_ilog2() > rays {
            stack[slot] = stack[slot - 1];
            slot -= 1;
        }
        stack[slot] = this;
        k += 1;
    }
}

/// Subtrees yet to visit, and the rays that may meet them.
type Waiting = ArrayVec<(Child, u64), STACK>;
