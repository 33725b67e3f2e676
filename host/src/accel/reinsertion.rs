//! Puts subtrees of a binary tree into better places.
//!
//! After Meister and Bittner, "Parallel Reinsertion for Bounding Volume Hierarchy Optimization" (2018): for many
//! subtrees at once, the place is looked for where boxes are smallest in all. Those that gain most go first; those
//! near to what has changed since wait for the next round.
//!
//! Most searches find nothing, and those of later rounds nearly all. So they are made where most can be saved, and not
//! again where nothing was found and nothing has changed near by, but for those that can save most of all.

use glam::{Vec3A, Vec4};
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::node::Bvh2Node;
use rayon::prelude::*;

/// Two siblings, in one line of the cache.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct Pair {
    boxes: Boxes,
    /// The pair below each, or a leaf's triangle with [`LEAF`].
    below: [u32; 2],
    /// The node that the pair is below.
    above: u32,
}

/// Two boxes, along each axis: the least of both, and minus the greatest of both. So the least of two such holds both.
type Boxes = [Vec4; 3];

/// Marks a triangle among what is below a node.
const LEAF: u32 = 1 << 31;

/// What the pair at the top is below.
const TOP: u32 = u32::MAX;

/// Searches that a thread makes at a time.
const CHUNK: usize = 512;

/// The part of the nodes wanted in the largest round that are searched for whenever they are wanted.
const ALWAYS: f32 = 0.12;

/// How much of a subtree's own area is no saving: a little less than all, since boxes further up may shrink too.
const KEPT: f32 = 0.8;

/// Bits of what can be saved that do not matter when it is compared.
const COARSE: u32 = 18;

/// A binary tree with one triangle a leaf, and at least two of them. A node is twice its pair, and its side.
pub(super) struct Pairs {
    pairs: Vec<Pair>,
    /// The pair at the top.
    top: u32,
    /// Nodes that no better place was found for, with nothing near by changed since.
    settled: Vec<bool>,
}

/// A subtree that has a better place: beside another.
#[derive(Clone, Copy)]
struct Move {
    gain: f32,
    from: u32,
    to: u32,
}

impl Pairs {
    /// A tree of at least two leaves.
    pub(super) fn new(binary: &Bvh2) -> Self {
        let below = |node: &Bvh2Node| match node.is_leaf() {
            true => node.first_index | LEAF,
            false => node.first_index / 2,
        };
        let pair = |nodes: &[Bvh2Node]| {
            let [a, b] = [nodes[0].aabb(), nodes[1].aabb()];
            let axis = |axis| Vec4::new(a.min[axis], b.min[axis], -a.max[axis], -b.max[axis]);
            Pair { boxes: [0, 1, 2].map(axis), below: [below(&nodes[0]), below(&nodes[1])], above: TOP }
        };
        let mut pairs: Vec<Pair> = binary.nodes[1..].chunks_exact(2).map(pair).collect();
        for at in 0..pairs.len() {
            for side in 0..2 {
                if let Some(below) = inner(pairs[at].below[side]) {
                    pairs[below].above = node(at, side);
                }
            }
        }
        Self { top: binary.nodes[0].first_index / 2, settled: vec![false; 2 * pairs.len()], pairs }
    }

    /// Nodes of it, each followed by all that is below its left side, and then by all that is below its right.
    pub(super) fn nodes(&self, root: Bvh2Node) -> Vec<Bvh2Node> {
        let mut nodes = Vec::with_capacity(2 * self.pairs.len() + 1);
        nodes.push(root);
        let mut waiting = vec![(self.top as usize, 0)];
        while let Some((at, above)) = waiting.pop() {
            let pair = &self.pairs[at];
            let first = nodes.len();
            nodes[above].first_index = first as u32;
            for side in 0..2 {
                let [x, y, z] = one(&pair.boxes, side);
                let bounds = Aabb::new(Vec3A::new(x.x, y.x, z.x), -Vec3A::new(x.z, y.z, z.z));
                let leaf = inner(pair.below[side]).is_none();
                nodes.push(Bvh2Node::new(bounds, u32::from(leaf), pair.below[side] & !LEAF));
            }
            for side in [1, 0] {
                waiting.extend(inner(pair.below[side]).map(|below| (below, first + side)));
            }
        }
        nodes
    }

    /// Looks for better places in some rounds, for a share of this part of the nodes in each.
    ///
    /// The same for any number of threads.
    pub(super) fn improve(&mut self, part: f32, rounds: &[f32]) {
        let nodes = 2 * self.pairs.len();
        // In which round a node was changed; the last one is what the top is below.
        let mut changed = vec![0u8; nodes + 1];
        for (&share, round) in rounds.iter().zip(1..) {
            let most = nodes as f32 * part;
            let wanted = self.wanted((most * share) as usize, (most * ALWAYS) as usize);
            let mut moves: Vec<Move> = wanted
                .par_chunks(CHUNK)
                .flat_map_iter(|nodes| {
                    let (tree, mut waiting) = (&*self, Vec::new());
                    nodes.iter().filter_map(move |&node| tree.better_place(node, &mut waiting))
                })
                .collect();
            wanted.iter().for_each(|&node| self.settled[node as usize] = true);
            moves.iter().for_each(|one| self.settled[one.from as usize] = false);
            moves.par_sort_unstable_by(|a, b| b.gain.total_cmp(&a.gain).then(a.from.cmp(&b.from)));
            for Move { from, to, .. } in moves {
                let above = |node: u32| self.pairs[split(node).0].above;
                let near =
                    [from, from ^ 1, to, above(from), above(to)].map(|node| (node as usize).min(nodes));
                // One that has gone there since may have taken the place along.
                if near.iter().all(|&node| changed[node] != round) && !self.is_below(to, from) {
                    for node in near {
                        changed[node] = round;
                        self.settled.get_mut(node).into_iter().for_each(|settled| *settled = false);
                    }
                    self.reinsert(from, to);
                }
            }
        }
    }

    /// As many nodes, of those that are not settled or among so many first ones, as can save most; in the tree's order,
    /// since neighbours have much of their ways in common.
    fn wanted(&self, count: usize, always: usize) -> Vec<u32> {
        let count = count.max(1);
        // Pairs merged last come first, and nearly all of those that matter most are among them.
        let first = &self.pairs[..(count + 1).min(self.pairs.len())];
        let savings = |pair: &Pair| {
            let whole = area(&both(&pair.boxes));
            areas(&pair.boxes).map(|area| ((whole - KEPT * area).max(0.0).to_bits() >> COARSE) as u16)
        };
        let savings: Vec<[u16; 2]> = first.par_iter().with_min_len(CHUNK).map(savings).collect();
        let savings = savings.as_flattened();
        let mut nodes_with = vec![0; 1 << (32 - COARSE)];
        savings.iter().for_each(|&saving| nodes_with[usize::from(saving)] += 1);
        // All nodes that save more than this, and how many of those that save just as much.
        let limit = |mut count: usize| {
            for (saving, &nodes) in nodes_with.iter().enumerate().rev() {
                if count < nodes {
                    return (saving, count);
                }
                count -= nodes;
            }
            (0, 0)
        };
        let ((least, mut left), (least_always, _)) = (limit(count), limit(always));
        let mut wanted = Vec::new();
        for ((&saving, &settled), node) in savings.iter().zip(&self.settled).zip(0..) {
            let saving = usize::from(saving);
            let within = saving > least || saving == least && left > 0;
            left -= usize::from(within && saving == least);
            if within && (!settled || saving > least_always) {
                wanted.push(node);
            }
        }
        wanted
    }

    /// Beside which other node boxes are smallest in all, if they are smaller than now.
    fn better_place(&self, from: u32, waiting: &mut Vec<(f32, u32)>) -> Option<Move> {
        let (mut at, mut side) = split(from);
        let mut here = &self.pairs[at];
        let own = one(&here.boxes, side);
        let mut search = Search {
            own_area: area(&own),
            own,
            best: Move { gain: 0.0, from, to: TOP },
            waiting,
            pairs: &self.pairs,
        };
        // What boxes lose if it goes elsewhere than below the one on the way up that is looked at.
        let mut lost = area(&both(&here.boxes));
        // That box without it, until it makes no difference there, and so nowhere above.
        let mut without = Some(one(&here.boxes, 1 - side));
        let mut moved = false;
        loop {
            search.beside(here, at, side, lost);
            if here.above == TOP {
                break;
            }
            if let Some(rest) = &mut without
                && moved
            {
                let whole = both(&here.boxes);
                *rest = union(rest, &one(&here.boxes, 1 - side));
                lost += area(&whole) - area(rest);
                if *rest == whole {
                    without = None;
                }
            }
            moved = true;
            (at, side) = split(here.above);
            here = &self.pairs[at];
        }
        (search.best.to != TOP).then_some(search.best)
    }

    /// Is a node the other one, or anywhere below it?
    fn is_below(&self, mut node: u32, other: u32) -> bool {
        while node != TOP && node != other {
            node = self.pairs[split(node).0].above;
        }
        node == other
    }

    /// Moves a subtree beside another that is not below it.
    fn reinsert(&mut self, from: u32, to: u32) {
        let (at, side) = split(from);
        let above = self.pairs[at].above;
        let (sibling, other) = (self.subtree(node(at, 1 - side)), self.subtree(to));
        // The sibling takes the place of the box around both, and its own place goes to the other.
        if above == TOP {
            self.top = sibling.1;
            self.pairs[self.top as usize].above = TOP;
        } else {
            self.put(above, sibling);
        }
        self.put(node(at, 1 - side), other);
        let (to_at, to_side) = split(to);
        self.pairs[to_at].below[to_side] = at as u32;
        self.pairs[at].above = to;
        self.refit(at);
        if above != TOP {
            self.refit(split(above).0);
        }
    }

    fn subtree(&self, node: u32) -> (Boxes, u32) {
        let (at, side) = split(node);
        (one(&self.pairs[at].boxes, side), self.pairs[at].below[side])
    }

    fn put(&mut self, node: u32, (bounds, below): (Boxes, u32)) {
        self.set_box(node, bounds);
        let (at, side) = split(node);
        self.pairs[at].below[side] = below;
        if let Some(below) = inner(below) {
            self.pairs[below].above = node;
        }
    }

    /// Does that change it?
    fn set_box(&mut self, node: u32, bounds: Boxes) -> bool {
        let (at, side) = split(node);
        let before = self.pairs[at].boxes;
        for (axis, new) in self.pairs[at].boxes.iter_mut().zip(bounds) {
            *axis = match side {
                0 => Vec4::new(new.x, axis.y, new.z, axis.w),
                _ => Vec4::new(axis.x, new.y, axis.z, new.w),
            };
        }
        before != self.pairs[at].boxes
    }

    /// Sets the boxes above a pair, as far as they change.
    fn refit(&mut self, mut at: usize) {
        loop {
            let above = self.pairs[at].above;
            if above == TOP || !self.set_box(above, both(&self.pairs[at].boxes)) {
                return;
            }
            self.settled[above as usize] = false;
            at = split(above).0;
        }
    }
}

/// Looks for the best place of a subtree.
struct Search<'a> {
    pairs: &'a [Pair],
    /// The subtree's box, twice.
    own: Boxes,
    own_area: f32,
    best: Move,
    /// Pairs to look at, with what is gained above them.
    waiting: &'a mut Vec<(f32, u32)>,
}

impl Search<'_> {
    /// Looks at the sibling of a node on the way up, and below it.
    #[inline(always)]
    fn beside(&mut self, pair: &Pair, at: usize, side: usize, lost: f32) {
        let (joined, alone) = (areas(&union(&pair.boxes, &self.own)), areas(&pair.boxes));
        let (joined, alone, below) = match side {
            0 => (joined[1], alone[1], pair.below[1]),
            _ => (joined[0], alone[0], pair.below[0]),
        };
        let gain = lost - joined;
        self.compare(gain, node(at, 1 - side));
        if self.may_gain(gain + alone)
            && let Some(below) = inner(below)
        {
            self.below(below, gain + alone);
        }
    }

    /// Looks at everything below that may be better. `gained` is what boxes gain but for the one around both.
    #[inline(always)]
    fn below(&mut self, mut at: usize, mut gained: f32) {
        loop {
            let pair = &self.pairs[at];
            let (joined, alone) = (areas(&union(&pair.boxes, &self.own)), areas(&pair.boxes));
            let gains = joined.map(|joined| gained - joined);
            self.compare(gains[0], node(at, 0));
            self.compare(gains[1], node(at, 1));
            let further = [gains[0] + alone[0], gains[1] + alone[1]];
            // The more promising one next.
            let next = usize::from(further[1] > further[0]);
            for side in [1 - next, next] {
                if pair.below[side] & LEAF == 0 && self.may_gain(further[side]) {
                    self.waiting.push((further[side], pair.below[side]));
                }
            }
            loop {
                let Some((more, below)) = self.waiting.pop() else { return };
                if self.may_gain(more) {
                    (gained, at) = (more, below as usize);
                    break;
                }
            }
        }
    }

    #[inline(always)]
    fn compare(&mut self, gain: f32, to: u32) {
        if gain > self.best.gain {
            (self.best.gain, self.best.to) = (gain, to);
        }
    }

    /// The box around both is no smaller than the subtree's own.
    #[inline(always)]
    fn may_gain(&self, gained: f32) -> bool {
        gained - self.own_area > self.best.gain
    }
}

fn node(pair: usize, side: usize) -> u32 {
    (2 * pair + side) as u32
}

/// The pair of a node, and its side.
fn split(node: u32) -> (usize, usize) {
    ((node / 2) as usize, (node % 2) as usize)
}

/// The pair below a node that is not a leaf.
fn inner(below: u32) -> Option<usize> {
    (below & LEAF == 0).then_some(below as usize)
}

/// Half the surfaces. Extents are negative here, and a product of two of them is not.
#[inline(always)]
fn areas(boxes: &Boxes) -> [f32; 2] {
    let [x, y, z] = boxes.map(|axis| axis + Vec4::new(axis.z, axis.w, axis.z, axis.w));
    let areas = x * y + (x + y) * z;
    [areas.x, areas.y]
}

/// Half the surface of a box that is there twice.
#[inline(always)]
fn area(boxes: &Boxes) -> f32 {
    areas(boxes)[0]
}

/// One of the boxes, twice.
#[inline(always)]
fn one(boxes: &Boxes, side: usize) -> Boxes {
    boxes.map(|axis| match side {
        0 => Vec4::new(axis.x, axis.x, axis.z, axis.z),
        _ => Vec4::new(axis.y, axis.y, axis.w, axis.w),
    })
}

/// What holds both boxes, twice.
#[inline(always)]
fn both(boxes: &Boxes) -> Boxes {
    boxes.map(|axis| axis.min(Vec4::new(axis.y, axis.x, axis.w, axis.z)))
}

/// What holds each of two boxes and its counterpart.
#[inline(always)]
fn union(a: &Boxes, b: &Boxes) -> Boxes {
    [0, 1, 2].map(|axis| a[axis].min(b[axis]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampler::Sampler;
    use obvhs::ploc::{PlocBuilder, PlocSearchDistance, SortPrecision};

    /// Boxes of so many sizes, of which some are in the same place.
    fn tree(leaves: u32, random: &mut Sampler) -> Bvh2 {
        let boxes: Vec<Aabb> = (0..leaves)
            .map(|k| {
                let mut at =
                    |scale: f32| Vec3A::new(random.uniform(), random.uniform(), random.uniform()) * scale;
                let (place, size) = (at(1.0), at([0.01, 0.3, 2.0][k as usize % 3]));
                let place = if k % 7 == 0 { Vec3A::splat(0.5) } else { place };
                Aabb::new(place - size, place + size)
            })
            .collect();
        let indices = (0..leaves).collect();
        PlocBuilder::with_capacity(boxes.len()).build(
            PlocSearchDistance::Low,
            &boxes,
            indices,
            SortPrecision::U64,
            2,
        )
    }

    /// That links and boxes are right, and every leaf is there once; the sum of all areas.
    fn checked(pairs: &Pairs) -> f32 {
        let mut leaves = vec![0; pairs.pairs.len() + 1];
        let mut waiting = vec![(pairs.top as usize, TOP)];
        let (mut seen, mut sum) = (0, 0.0);
        while let Some((at, above)) = waiting.pop() {
            let pair = &pairs.pairs[at];
            seen += 1;
            assert!(seen <= pairs.pairs.len(), "below itself");
            assert_eq!(pair.above, above);
            if above != TOP {
                let (over, side) = split(above);
                assert_eq!(one(&pairs.pairs[over].boxes, side), both(&pair.boxes), "no more and no less");
            }
            sum += areas(&pair.boxes).iter().sum::<f32>();
            for side in 0..2 {
                match inner(pair.below[side]) {
                    Some(below) => waiting.push((below, node(at, side))),
                    None => leaves[(pair.below[side] & !LEAF) as usize] += 1,
                }
            }
        }
        assert_eq!(seen, pairs.pairs.len());
        assert!(leaves.iter().all(|&times| times == 1), "{leaves:?}");
        sum
    }

    #[test]
    fn trees_stay_whole_and_get_smaller() {
        let mut random = Sampler::from_key(3);
        let (mut before, mut after) = (0.0, 0.0);
        for leaves in (2..40).chain([100, 300, 1000, 3000]) {
            let binary = tree(leaves, &mut random);
            let mut pairs = Pairs::new(&binary);
            let first = checked(&pairs);
            let mut last = first;
            for share in [1.0, 0.3, 1.0, 0.1] {
                pairs.improve(1.0, &[share]);
                let next = checked(&pairs);
                assert!(next <= last * 1.02, "{leaves} leaves: {next} after {last}");
                last = next;
            }
            (before, after) = (before + first, after + last);
            let nodes = pairs.nodes(binary.nodes[0]);
            assert_eq!(nodes.len(), binary.nodes.len());
            assert_eq!(nodes.iter().filter(|node| node.is_leaf()).count(), leaves as usize);
        }
        assert!(after < 0.97 * before, "{after} of {before}");
    }
}
