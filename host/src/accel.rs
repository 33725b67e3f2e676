//! Builds the tree that the kernel walks, and owns what it borrows.
//!
//! obvhs builds a binary tree with one triangle a leaf (PLOC), whose subtrees are then put into better places
//! (`reinsertion`). It is cut into nodes of eight children and blocks of up to eight triangles so that the expected
//! cost of a ray, by the surface area heuristic, is least over all ways of cutting it: the dynamic programme of
//! Ylitie, Karras and Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs" (HPG 2017),
//! section 3.1.

mod reinsertion;

use crate::scene::Scene;
use glam::Vec3;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::node::Bvh2Node;
use obvhs::ploc::{PlocBuilder, PlocSearchDistance, SortPrecision};
use occlude_kernel::bvh::MAX_DEPTH;
use occlude_kernel::{Bvh, Child, Node, TriangleBlock};
use rayon::prelude::*;
use reinsertion::Pairs;

/// How long to look for a good tree.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Quality {
    /// Quick to build, slower to ask.
    Fast,
    /// What a render of some seconds wants.
    #[default]
    Medium,
    /// Slow to build; for trees that are asked for long.
    High,
}

/// Nodes and triangle blocks.
#[derive(Clone, Debug, Default)]
pub struct Accel {
    nodes: Vec<Node>,
    blocks: Vec<TriangleBlock>,
    triangles: usize,
}

/// What a tree is like.
#[derive(Clone, Copy, Debug, Default)]
pub struct AccelStats {
    /// Inner nodes.
    pub nodes: usize,
    /// Blocks of triangles.
    pub blocks: usize,
    /// Children in use, of eight, on average.
    pub children_per_node: f64,
    /// Triangles in use, of eight, on average.
    pub triangles_per_block: f64,
    /// Levels of nodes.
    pub depth: usize,
    /// Bytes that queries touch.
    pub bytes: usize,
    /// Expected nodes and blocks visited by a line through the scene's box, by surface areas.
    pub expected_visits: f64,
}

/// Cost of testing the eight boxes of a node and of the eight triangles of a block, relative to each other.
const NODE_COST: f32 = 1.0;
const BLOCK_COST: f32 = 1.0;

impl Accel {
    /// Triangles a tree can surely name: blocks are more than half full, and leaves can name nearly 2^25 of them.
    pub const MOST_TRIANGLES: usize = 1 << 27;

    /// Builds the tree of a scene's triangles; triangle `i` keeps the number `i`.
    pub fn build(scene: &Scene, quality: Quality) -> Self {
        let triangles: Vec<[Vec3; 3]> =
            (0..scene.triangles.len() as u32).into_par_iter().map(|i| scene.vertices(i)).collect();
        Self::from_triangles(&triangles, quality)
    }

    /// Builds the tree of triangles, which must be finite, and no more than [`Accel::MOST_TRIANGLES`].
    pub fn from_triangles(triangles: &[[Vec3; 3]], quality: Quality) -> Self {
        if triangles.is_empty() {
            return Self::default();
        }
        let boxes: Vec<Aabb> = triangles
            .par_iter()
            .map(|[a, b, c]| Aabb::new(a.min(*b).min(*c).into(), a.max(*b).max(*c).into()))
            .collect();
        if crowded(&boxes) {
            return Self::evenly(triangles, &boxes);
        }
        let binary = build_binary(boxes, quality);
        let plans = plan(&binary);
        let (nodes, blocks) = cut(&Tree { binary: &binary, plans: &plans, triangles });
        Self { nodes, blocks, triangles: triangles.len() }
    }

    /// Cuts triangles evenly along a space-filling curve, where boxes overlap so much that no tree is good.
    fn evenly(triangles: &[[Vec3; 3]], boxes: &[Aabb]) -> Self {
        let whole = boxes.iter().fold(Aabb::empty(), |whole, b| whole.union(b));
        let scale = 1.0 / whole.diagonal().as_dvec3().max(glam::DVec3::splat(f64::MIN_POSITIVE));
        let mut order: Vec<(u64, u32)> = boxes
            .iter()
            .zip(0..)
            .map(|(b, i)| {
                let at = (b.center().as_dvec3() - whole.min.as_dvec3()) * scale;
                (obvhs::ploc::morton::morton_encode_u64_unorm(at), i)
            })
            .collect();
        order.sort_unstable();
        let order: Vec<u32> = order.into_iter().map(|(_, i)| i).collect();
        let tree = Tree { binary: &Bvh2::default(), plans: &[], triangles };
        let mut cutter = Cutter::new(&tree, triangles.len());
        let parts: Vec<&[u32]> =
            order.chunks(order.len().div_ceil(Node::WIDTH).max(TriangleBlock::WIDTH)).collect();
        cutter.place(1, parts.len(), |cutter, part| cutter.even(parts[part], 2));
        Self { nodes: cutter.nodes, blocks: cutter.blocks, triangles: triangles.len() }
    }

    /// The tree, to ask. Checks it, so ask for it once a render and not once a ray.
    pub fn bvh(&self) -> Bvh<'_> {
        Bvh::new(&self.nodes, &self.blocks).expect("the builder keeps the kernel's rules")
    }

    /// Triangles in the tree.
    pub fn triangles(&self) -> usize {
        self.triangles
    }

    /// Bytes that queries touch: nodes and blocks.
    pub fn bytes(&self) -> usize {
        size_of_val(&*self.nodes) + size_of_val(&*self.blocks)
    }

    /// What the tree is like. Costs one look at every node.
    pub fn stats(&self) -> AccelStats {
        let mut stats = AccelStats {
            nodes: self.nodes.len(),
            blocks: self.blocks.len(),
            bytes: self.bytes(),
            ..Default::default()
        };
        if self.nodes.is_empty() {
            return stats;
        }
        let mut depths = vec![1usize; self.nodes.len()];
        let mut children = 0usize;
        let mut area = 0.0;
        let root = bounds_of(self.nodes[0].bounds, |place| self.nodes[0].children[place] != Child::NONE);
        for (index, node) in self.nodes.iter().enumerate() {
            stats.depth = stats.depth.max(depths[index]);
            for place in 0..Node::WIDTH {
                let child = node.children[place];
                if child == Child::NONE {
                    continue;
                }
                children += 1;
                let (lower, upper) = bounds_of(node.bounds, |other| other == place);
                area += f64::from(half_area(lower, upper));
                if let Some(below) = child.as_node() {
                    depths[below] = depths[index] + 1;
                }
            }
        }
        stats.children_per_node = children as f64 / self.nodes.len() as f64;
        stats.triangles_per_block = self.triangles as f64 / self.blocks.len().max(1) as f64;
        let whole = f64::from(half_area(root.0, root.1));
        stats.expected_visits = 1.0 + if whole > 0.0 { area / whole } else { 0.0 };
        stats
    }
}

fn bounds_of(bounds: [[[f32; 8]; 3]; 2], used: impl Fn(usize) -> bool) -> (Vec3, Vec3) {
    (0..Node::WIDTH).filter(|&place| used(place)).fold(
        (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY)),
        |(lower, upper), place| {
            let corner = |side: usize| Vec3::from(bounds[side].map(|axis| axis[place]));
            (lower.min(corner(0)), upper.max(corner(1)))
        },
    )
}

fn half_area(lower: Vec3, upper: Vec3) -> f32 {
    let d = upper - lower;
    d.x * d.y + d.y * d.z + d.z * d.x
}

/// Where boxes take up this part of the whole on average, and there are this many, obvhs' merging takes a round
/// for each of them, and the tree is no better than an even cut.
const CROWDED: (f64, usize) = (0.003, 10_000);

/// From so many triangles on, the part of the nodes that is put into better places falls: each costs more to place, and a
/// large scene is not to take more than twice the time that Embree's best build takes.
const LARGE: f32 = 2e5;

/// Nodes that better places are looked for, as parts of those of the largest round: thrice from many to the few that
/// matter most, since others find better places once those have theirs.
const ROUNDS: [f32; 11] = [0.4, 0.2, 0.1, 0.6, 0.3, 0.2, 0.1, 1.0, 0.5, 0.3, 0.2];

/// Is no tree worth looking for?
fn crowded(boxes: &[Aabb]) -> bool {
    let whole = boxes.iter().fold(Aabb::empty(), |whole, b| whole.union(b));
    let areas: f64 = boxes.iter().map(|b| f64::from(b.half_area())).sum();
    let crowding = areas / f64::from(whole.half_area()) / boxes.len() as f64;
    boxes.len() > CROWDED.1 && crowding > CROWDED.0
}

fn build_binary(mut boxes: Vec<Aabb>, quality: Quality) -> Bvh2 {
    // PLOC merges boxes that are each other's best; where all are alike that is one pair a round, and building
    // takes the square of their number. So each grows by a little of its own; the tree's boxes are not these.
    boxes.par_iter_mut().enumerate().for_each(|(index, b)| {
        let grain = b.diagonal().max_element() * 1e-3 + b.min.abs().max(b.max.abs()).max_element() * 1e-6;
        let number = index as u32 + 1;
        let more = grain * (number.wrapping_mul(0x9e37_79b9) >> 8) as f32 / (1 << 24) as f32;
        *b = Aabb::new(b.min - more, b.max + more);
    });
    let (distance, depth, reinsertion) = match quality {
        Quality::Fast => (PlocSearchDistance::Low, 2, 0.01),
        Quality::Medium => {
            let fewer = (LARGE / boxes.len() as f32).min(1.0).sqrt();
            (PlocSearchDistance::Medium, 3, 0.4 * fewer)
        }
        Quality::High => (PlocSearchDistance::High, 2, 1.0),
    };
    let indices = (0..boxes.len() as u32).collect();
    let mut binary =
        PlocBuilder::with_capacity(boxes.len()).build(distance, &boxes, indices, SortPrecision::U64, depth);
    drop(boxes);
    if binary.nodes.len() > 1 {
        let mut pairs = Pairs::new(&binary);
        // In large scenes there is not much room for both.
        let root = std::mem::take(&mut binary.nodes)[0];
        pairs.improve(reinsertion, &ROUNDS);
        binary.nodes = pairs.nodes(root);
    }
    binary
}

/// The cheapest way to stand for a subtree by at most `i + 1` children of a node, for `i` from 0 to 6.
#[derive(Clone, Copy, Default)]
struct Plan {
    cost: [f32; 7],
    /// How many of them the left side gets; 0: not split, use one fewer (or, for one, see `own`).
    left: [u8; 7],
    /// As one child: the left side's share of the eight in a node of its own; 0: a block of triangles.
    own: u8,
    /// How many triangles are below.
    triangles: u32,
}

impl Plan {
    fn leaf(node: &Bvh2Node) -> Self {
        let block = node.aabb().half_area() * BLOCK_COST;
        Self { cost: [block; 7], triangles: node.prim_count, ..Self::default() }
    }

    fn inner(node: &Bvh2Node, [a, b]: [&Self; 2]) -> Self {
        // Both sides together, with `most` children in all.
        let split = |most: usize| {
            let mut best = (a.cost[0] + b.cost[most - 2], 1);
            for left in 2..most {
                let cost = a.cost[left - 1] + b.cost[most - left - 1];
                if cost < best.0 {
                    best = (cost, left as u8);
                }
            }
            best
        };
        let mut plan = Self { triangles: a.triangles + b.triangles, ..Self::default() };
        let area = node.aabb().half_area();
        let (below, left) = split(Node::WIDTH);
        let (block, inner) = (area * BLOCK_COST, area * NODE_COST + below);
        if plan.triangles as usize <= TriangleBlock::WIDTH && block <= inner {
            plan.cost[0] = block;
        } else {
            (plan.cost[0], plan.own) = (inner, left);
        }
        for most in 2..Node::WIDTH {
            let (cost, left) = split(most);
            let fewer = plan.cost[most - 2];
            (plan.cost[most - 1], plan.left[most - 1]) = if cost < fewer { (cost, left) } else { (fewer, 0) };
        }
        plan
    }
}

/// Plans of all nodes, of which each is followed by all that is below its left side, then by all below its right.
///
/// Subtrees are planned at the same time.
fn plan(binary: &Bvh2) -> Vec<Plan> {
    let nodes = &binary.nodes;
    // By all threads: what is written first the system has to clear.
    let mut plans: Vec<Plan> = nodes.par_iter().map(|_| Plan::default()).collect();
    // Subtrees that are small enough, and the pairs above them.
    let (mut small, mut above) = (Vec::new(), Vec::new());
    let mut waiting: Vec<_> = std::iter::once(1..nodes.len()).collect();
    while let Some(below) = waiting.pop() {
        if below.len() <= PLANNED {
            small.push(below);
            continue;
        }
        let (a, b) = (below.start, below.start + 1);
        above.push(a);
        let half = if nodes[b].is_leaf() { below.end } else { nodes[b].first_index as usize };
        waiting.extend([half..below.end, a + 2..half].into_iter().filter(|part| !part.is_empty()));
    }
    // The plan of a node, from those of the nodes from `first` on.
    let plan = |index: usize, plans: &[Plan], first: usize| {
        let node = &nodes[index];
        match node.is_leaf() {
            true => Plan::leaf(node),
            false => Plan::inner(node, [0, 1].map(|side| &plans[node.first_index as usize + side - first])),
        }
    };
    let (mut rest, mut at) = (&mut plans[..], 0);
    let mut parts = Vec::with_capacity(small.len());
    for below in small {
        let (part, after) = rest[below.start - at..].split_at_mut(below.len());
        parts.push((below.start, part));
        (rest, at) = (after, below.end);
    }
    parts.into_par_iter().for_each(|(first, part)| {
        for index in (0..part.len()).rev() {
            part[index] = plan(first + index, part, first);
        }
    });
    for first in above.into_iter().rev() {
        plans[first] = plan(first, &plans, 0);
        plans[first + 1] = plan(first + 1, &plans, 0);
    }
    plans[0] = plan(0, &plans, 0);
    plans
}

/// What stands below a place of a node.
struct Below {
    child: Child,
    /// Or the part that is cut apart; its child is the first node of that.
    part: Option<usize>,
    lower: Vec3,
    upper: Vec3,
    /// Of all triangles.
    area: f32,
    /// Nodes and blocks that a line through the box is expected to visit.
    visits: f32,
}

impl Below {
    /// How likely a line through the box is to be blocked, for each visit that this costs.
    ///
    /// A line through a convex box meets surfaces of area `a` in it `2 a / s` times on average, where `s` is the box's
    /// surface.
    fn worth(&self) -> f32 {
        let hits = self.area / half_area(self.lower, self.upper).max(f32::MIN_POSITIVE);
        (1.0 - (-hits).exp()) / self.visits
    }
}

/// What is cut into nodes and blocks.
#[derive(Clone, Copy)]
struct Tree<'a> {
    binary: &'a Bvh2,
    plans: &'a [Plan],
    triangles: &'a [[Vec3; 3]],
}

/// What becomes of a subtree that is one child of a node.
#[derive(PartialEq)]
enum Way {
    /// A block, or more of them under nodes of even fill.
    Even,
    /// A node of its own.
    Node,
    /// The same, but cut apart from what is around it.
    Part,
}

impl Tree<'_> {
    fn way(&self, subtree: usize, level: usize) -> Way {
        let plan = &self.plans[subtree];
        // A tree that is too lopsided for the kernel's stack is cut evenly from here on.
        if plan.own == 0 || level >= MAX_DEPTH - LEVELS_OF_ANY {
            Way::Even
        } else if APART.contains(&plan.triangles) {
            Way::Part
        } else {
            Way::Node
        }
    }

    /// The subtrees that stand for the children of this one as a node.
    fn children(&self, subtree: usize) -> Vec<usize> {
        let left = usize::from(self.plans[subtree].own);
        let mut parts = Vec::with_capacity(Node::WIDTH);
        let first = self.binary.nodes[subtree].first_index as usize;
        self.parts(first, left, &mut parts);
        self.parts(first + 1, Node::WIDTH - left, &mut parts);
        parts
    }

    /// The subtrees that stand for this one in a node with room for `most`.
    fn parts(&self, subtree: usize, most: usize, parts: &mut Vec<usize>) {
        let mut most = most.min(7);
        let plan = &self.plans[subtree];
        while most > 1 && plan.left[most - 1] == 0 {
            most -= 1;
        }
        if most == 1 {
            parts.push(subtree);
            return;
        }
        let left = usize::from(plan.left[most - 1]);
        let first = self.binary.nodes[subtree].first_index as usize;
        self.parts(first, left, parts);
        self.parts(first + 1, most - left, parts);
    }

    /// Subtrees to cut apart, with their levels, in the order in which a cutter comes by.
    fn apart(&self, subtree: usize, level: usize, found: &mut Vec<(usize, usize)>) {
        for child in self.children(subtree) {
            match self.way(child, level + 1) {
                Way::Even => {}
                Way::Node => {
                    if self.plans[child].triangles > *APART.end() {
                        self.apart(child, level + 1, found);
                    }
                }
                Way::Part => found.push((child, level + 1)),
            }
        }
    }

    /// The triangles of a subtree, in its order.
    fn below(&self, subtree: usize, triangles: &mut Vec<u32>) {
        let mut waiting = vec![subtree];
        triangles.clear();
        while let Some(index) = waiting.pop() {
            let node = &self.binary.nodes[index];
            let first = node.first_index as usize;
            if node.is_leaf() {
                triangles.extend_from_slice(
                    &self.binary.primitive_indices[first..first + node.prim_count as usize],
                );
            } else {
                waiting.extend([first + 1, first]);
            }
        }
    }
}

/// Cuts a tree. Many parts of it are cut at the same time; which ones depends on nothing but the tree.
fn cut(tree: &Tree<'_>) -> (Vec<Node>, Vec<TriangleBlock>) {
    let mut top = Cutter::new(tree, 0);
    // A root that is a block still needs a node above it.
    if tree.plans[0].own == 0 {
        let mut below = Vec::new();
        tree.below(0, &mut below);
        top.place(1, 1, |cutter, _| cutter.even(&below, 2));
        return (top.nodes, top.blocks);
    }
    let mut apart = Vec::new();
    if tree.plans[0].triangles > *APART.end() {
        tree.apart(0, 1, &mut apart);
    }
    let parts: Vec<(Cutter<'_>, Below)> = apart
        .par_iter()
        .map(|&(subtree, level)| {
            let mut cutter = Cutter::new(tree, tree.plans[subtree].triangles as usize);
            let below = cutter.node(subtree, level);
            (cutter, below)
        })
        .collect();
    let (parts, mut cut): (Vec<_>, Vec<_>) = parts.into_iter().unzip();
    cut.iter_mut().zip(0..).for_each(|(below, part)| below.part = Some(part));
    top.cut = cut.into_iter();
    top.node(0, 1);

    let (mut nodes, mut blocks) = (top.nodes, top.blocks);
    nodes.reserve_exact(parts.iter().map(|part| part.nodes.len()).sum());
    blocks.reserve_exact(parts.iter().map(|part| part.blocks.len()).sum());
    let firsts = parts.iter().scan(nodes.len(), |first, part| {
        let this = *first;
        *first += part.nodes.len();
        Some(this as u32)
    });
    let firsts: Vec<u32> = firsts.collect();
    for (index, place, part) in top.parts {
        nodes[index].children[place] = Child::node(firsts[part]);
    }
    for (part, first) in parts.into_iter().zip(firsts) {
        let first_block = blocks.len() as u32;
        blocks.extend_from_slice(&part.blocks);
        nodes.extend(part.nodes.into_iter().map(|mut node| {
            node.children = node.children.map(|child| match (child.as_node(), child.as_leaf()) {
                (Some(node), _) => Child::node(node as u32 + first),
                (_, Some(leaf)) => {
                    Child::lanes(leaf.block as u32 + first_block, leaf.first as u32, leaf.count as u32)
                }
                _ => child,
            });
            node
        }));
    }
    (nodes, blocks)
}

struct Cutter<'a> {
    tree: &'a Tree<'a>,
    nodes: Vec<Node>,
    blocks: Vec<TriangleBlock>,
    /// The last blocks with room, by the lanes that are left.
    room: [Vec<usize>; TriangleBlock::WIDTH],
    /// Triangles that are being written; kept for its memory.
    below: Vec<u32>,
    /// Parts that are cut already, in the order in which they are come by.
    cut: std::vec::IntoIter<Below>,
    /// Where they are: node, place and part.
    parts: Vec<(usize, usize, usize)>,
}

impl<'a> Cutter<'a> {
    /// With nothing written yet, for about so many triangles.
    fn new(tree: &'a Tree<'a>, triangles: usize) -> Self {
        Self {
            tree,
            nodes: Vec::with_capacity(triangles / 20 + 1),
            blocks: Vec::with_capacity(triangles / 7 + 1),
            room: Default::default(),
            below: Vec::new(),
            cut: Vec::new().into_iter(),
            parts: Vec::new(),
        }
    }

    /// Writes the subtree as a node of its own, on this level.
    fn node(&mut self, subtree: usize, level: usize) -> Below {
        let children = self.tree.children(subtree);
        self.place(level, children.len(), |cutter, place| {
            let subtree = children[place];
            match cutter.tree.way(subtree, level + 1) {
                Way::Even => {
                    let mut below = std::mem::take(&mut cutter.below);
                    cutter.tree.below(subtree, &mut below);
                    let placed = cutter.even(&below, level + 1);
                    cutter.below = below;
                    placed
                }
                // What is within a part is no part again.
                Way::Part => match cutter.cut.next() {
                    Some(part) => part,
                    None => cutter.node(subtree, level + 1),
                },
                Way::Node => cutter.node(subtree, level + 1),
            }
        })
    }

    /// Writes a node whose children `child` writes.
    fn place(
        &mut self,
        level: usize,
        children: usize,
        mut child: impl FnMut(&mut Self, usize) -> Below,
    ) -> Below {
        debug_assert!(level <= MAX_DEPTH && children <= Node::WIDTH);
        let index = self.nodes.len();
        self.nodes.push(Node::EMPTY);
        let mut below: Vec<Below> = (0..children).map(|place| child(self, place)).collect();
        // Rays that any triangle blocks are soonest done so (RTSAH; Ize and Hansen, "RTSAH Traversal Order for Occlusion
        // Rays", 2011).
        below.sort_by(|a, b| b.worth().total_cmp(&a.worth()));
        for (place, Below { child, part, lower, upper, .. }) in below.iter().enumerate() {
            self.nodes[index].set(place, lower.to_array(), upper.to_array(), *child);
            self.parts.extend(part.map(|part| (index, place, part)));
        }
        let lower = below.iter().fold(Vec3::splat(f32::INFINITY), |lower, below| lower.min(below.lower));
        let upper = below.iter().fold(Vec3::splat(f32::NEG_INFINITY), |upper, below| upper.max(below.upper));
        let whole = half_area(lower, upper).max(f32::MIN_POSITIVE);
        let visits = |below: &Below| below.visits * half_area(below.lower, below.upper) / whole;
        Below {
            child: Child::node(index as u32),
            part: None,
            lower,
            upper,
            area: below.iter().map(|below| below.area).sum(),
            visits: NODE_COST + below.iter().map(visits).sum::<f32>(),
        }
    }

    /// Writes triangles as blocks under nodes of even fill.
    fn even(&mut self, triangles: &[u32], level: usize) -> Below {
        if triangles.len() <= TriangleBlock::WIDTH {
            return self.leaf(triangles);
        }
        let share = triangles.len().div_ceil(Node::WIDTH).max(TriangleBlock::WIDTH);
        let parts: Vec<&[u32]> = triangles.chunks(share).collect();
        self.place(level, parts.len(), |cutter, part| cutter.even(parts[part], level + 1))
    }

    /// Writes triangles into lanes of the fullest block near by that has room for them.
    fn leaf(&mut self, triangles: &[u32]) -> Below {
        let count = triangles.len();
        let near = self.blocks.len().saturating_sub(NEAR);
        let fits = (count..TriangleBlock::WIDTH).find(|&room| {
            let last = self.room[room].last();
            if last.is_some_and(|&block| block < near) {
                self.room[room].clear();
            }
            !self.room[room].is_empty()
        });
        let (index, first) = match fits.and_then(|room| self.room[room].pop().map(|block| (room, block))) {
            Some((room, block)) => (block, TriangleBlock::WIDTH - room),
            None => {
                self.blocks.push(TriangleBlock::EMPTY);
                (self.blocks.len() - 1, 0)
            }
        };
        let left = TriangleBlock::WIDTH - first - count;
        if left > 0 {
            self.room[left].push(index);
        }
        let block = &mut self.blocks[index];
        let (mut lower, mut upper) = (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY));
        for (lane, &triangle) in triangles.iter().enumerate() {
            let vertices = self.tree.triangles[triangle as usize];
            block.set(first + lane, vertices.map(|vertex| vertex.to_array()), triangle);
            for vertex in vertices {
                (lower, upper) = (lower.min(vertex), upper.max(vertex));
            }
        }
        let area = |&triangle: &u32| {
            let [a, b, c] = self.tree.triangles[triangle as usize];
            0.5 * (b - a).cross(c - a).length()
        };
        Below {
            child: Child::lanes(index as u32, first as u32, count as u32),
            part: None,
            lower,
            upper,
            area: triangles.iter().map(area).sum(),
            visits: BLOCK_COST,
        }
    }
}

/// A leaf shares a block with leaves that were written lately: this many blocks ago, at most.
const NEAR: usize = 64;

/// Nodes that a thread plans for at a time, at most.
const PLANNED: usize = 8192;

/// Subtrees of so many triangles are cut apart from each other. Smaller ones would leave blocks with room.
const APART: std::ops::RangeInclusive<u32> = 512..=4096;

/// Levels that suffice for any number of triangles cut evenly: eight to the eleventh is more than an index holds.
const LEVELS_OF_ANY: usize = 11;
