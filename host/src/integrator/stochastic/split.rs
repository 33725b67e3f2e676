//! Which blockers belong to which group.
//!
//! Groups are made of *units*: single triangles where the scene has few, subtrees of its tree where it has many, and
//! for a split by objects the groups themselves. A group is then a byte a unit, drawn anew for each point, and a query
//! about it walks the scene's own tree and leaves out the subtrees of other units. Nothing is copied.

use crate::error::{Error, Result};
use crate::sampler::Sampler;
use crate::scene::Scene;
use glam::Vec3;
use occlude_kernel::{Bvh, Child, Leaf, NO_TRIANGLE, Node, Part, TriangleBlock};

/// How blockers are divided into groups.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Split {
    /// At random for each point, in equal parts: of triangles, or of subtrees of the scene's tree if there are over 256.
    #[default]
    Random,
    /// By the distance of their boxes from each point, nearest first, in equal parts.
    Sorted,
    /// Whole objects of the file, the same for all points, in parts as equal as the objects allow.
    Object,
    /// With --blockers map: subtrees of the scene's own tree, which photons name, by the distance of their middles. No
    /// tree is built.
    Treelet,
}

/// The most units that are drawn for a point.
const MOST: usize = 256;

/// In the place of a unit: triangles of several.
const MIXED: u32 = u32::MAX;

/// Divides the scene into units and the units into groups.
#[derive(Clone, Debug)]
pub(super) struct Units {
    split: Split,
    groups: usize,
    nodes: Vec<u32>,
    /// A mark for each lane of each block, of which that of a leaf's first counts.
    leaves: Vec<u32>,
    /// Empty where units are made of whole leaves.
    triangles: Vec<u32>,
    /// Box and triangles of each.
    units: Vec<Unit>,
}

#[derive(Clone, Copy, Debug)]
struct Unit {
    lower: Vec3,
    upper: Vec3,
    triangles: u32,
}

impl Units {
    /// For this many groups, up to 255. Costs one look at the tree.
    pub(super) fn new(scene: &Scene, bvh: &Bvh<'_>, split: Split, groups: usize) -> Result<Self> {
        let (nodes, lanes) = (bvh.nodes().len(), bvh.blocks().len() * TriangleBlock::WIDTH);
        let (nodes, leaves) = (vec![MIXED; nodes], vec![MIXED; lanes]);
        let mut units = Self { split, groups, nodes, leaves, triangles: Vec::new(), units: Vec::new() };
        if split == Split::Object {
            if scene.objects.len() < groups {
                return Err(Error::Usage(format!(
                    "--split object wants at least {groups} objects, `o` or `g` in the file; {} has {}",
                    scene.name,
                    scene.objects.len()
                )));
            }
            units.triangles = by_object(scene, groups);
            units.unify(bvh);
        } else if scene.triangles.len() <= MOST {
            units.triangles = (0..scene.triangles.len() as u32).collect();
            units.units = units.triangles.iter().map(|&triangle| of_triangle(scene, triangle)).collect();
            units.unify(bvh);
        } else {
            units.cut(bvh);
        }
        Ok(units)
    }

    /// Marks the leaves and subtrees whose triangles are of one unit.
    fn unify(&mut self, bvh: &Bvh<'_>) {
        // Children come after their parents.
        for (index, node) in bvh.nodes().iter().enumerate().rev() {
            for leaf in children(node).filter_map(|(_, child)| child.as_leaf()) {
                let ids = leaf.ids(bvh.blocks());
                let first = ids.first().map_or(MIXED, |&id| self.triangles[id as usize]);
                let same = ids.iter().all(|&id| self.triangles[id as usize] == first);
                self.leaves[place_of(leaf)] = if same { first } else { MIXED };
            }
            let mut marks = children(node).map(|(_, child)| self.mark(child));
            let first = marks.next().unwrap_or(MIXED);
            self.nodes[index] = if marks.all(|mark| mark == first) { first } else { MIXED };
        }
    }

    fn mark(&self, child: Child) -> u32 {
        let mark = match child.as_leaf() {
            Some(leaf) => self.leaves.get(place_of(leaf)),
            None => child.as_node().and_then(|node| self.nodes.get(node)),
        };
        mark.copied().unwrap_or(MIXED)
    }

    /// Makes units of subtrees: the largest is cut up until there are enough.
    fn cut(&mut self, bvh: &Bvh<'_>) {
        let nodes = bvh.nodes();
        let mut counts = vec![0u32; nodes.len()];
        let count = |child: Child, counts: &[u32]| match (child.as_leaf(), child.as_node()) {
            (Some(leaf), _) => leaf.ids(bvh.blocks()).len() as u32,
            (_, Some(node)) => counts[node],
            _ => 0,
        };
        for (index, node) in nodes.iter().enumerate().rev() {
            counts[index] = children(node).map(|(_, child)| count(child, &counts)).sum();
        }
        // The largest last: triangles, and then the parent and the place, so that the order is a whole one.
        let mut cut = std::collections::BinaryHeap::new();
        let mut whole = Vec::new();
        let places =
            |parent: usize| children(&nodes[parent]).map(move |(place, child)| (parent, place, child));
        let mut open: Vec<(usize, usize, Child)> = places(0).collect();
        loop {
            for (parent, place, child) in open.drain(..) {
                let triangles = count(child, &counts);
                match child.as_node() {
                    Some(node) => cut.push((triangles, std::cmp::Reverse((parent, place)), node)),
                    None => whole.push((triangles, parent, place)),
                }
            }
            let Some(&(_, _, node)) = cut.peek() else { break };
            if cut.len() + whole.len() - 1 + children(&nodes[node]).count() > MOST {
                break;
            }
            cut.pop();
            open.extend(places(node));
        }
        whole.extend(
            cut.into_iter()
                .map(|(triangles, std::cmp::Reverse((parent, place)), _)| (triangles, parent, place)),
        );
        // By size: a random split deals out neighbours in this order, so that groups come out of one size.
        whole.sort_unstable_by_key(|&(triangles, parent, place)| {
            (std::cmp::Reverse(triangles), parent, place)
        });
        for (unit, &(triangles, parent, place)) in (0u32..).zip(&whole) {
            let node = &nodes[parent];
            let corner = |side: usize| Vec3::from(node.bounds[side].map(|axis| axis[place]));
            self.units.push(Unit { lower: corner(0), upper: corner(1), triangles });
            let mut below = vec![node.children[place]];
            while let Some(child) = below.pop() {
                if let Some(leaf) = child.as_leaf() {
                    self.leaves[place_of(leaf)] = unit;
                } else if let Some(index) = child.as_node() {
                    self.nodes[index] = unit;
                    below.extend(children(&nodes[index]).map(|(_, child)| child));
                }
            }
        }
    }

    /// Writes the group of each unit as it is for a point.
    pub(super) fn draw(&self, x: Vec3, random: &mut Sampler, groups: &mut Vec<u8>, order: &mut Vec<u64>) {
        groups.clear();
        let count = self.groups;
        match self.split {
            Split::Object => groups.extend((0..count).map(|group| group as u8)),
            Split::Random => {
                // One of each few neighbours to each group, by a random turn.
                for first in (0..self.units.len()).step_by(count) {
                    let turn = ((u64::from(random.word()) * count as u64) >> 32) as usize;
                    let last = (first + count).min(self.units.len());
                    groups.extend((first..last).map(|unit| ((unit - first + turn) % count) as u8));
                }
            }
            Split::Sorted | Split::Treelet => {
                // Squares are not negative, so that their bits are in their order; then come the units.
                order.clear();
                order.extend(self.units.iter().zip(0u64..).map(|(unit, index)| {
                    let nearest = x.clamp(unit.lower, unit.upper);
                    u64::from(nearest.distance_squared(x).to_bits()) << 32 | index
                }));
                order.sort_unstable();
                groups.resize(self.units.len(), 0);
                let all: u64 = self.units.iter().map(|unit| u64::from(unit.triangles)).sum();
                let mut before = 0;
                for &key in order.iter() {
                    let index = key as u32;
                    // The group that the middle of its triangles falls into.
                    let triangles = u64::from(self.units[index as usize].triangles);
                    let group = (2 * before + triangles) * count as u64 / (2 * all.max(1));
                    groups[index as usize] = group.min(count as u64 - 1) as u8;
                    before += triangles;
                }
            }
        }
    }
}

fn children(node: &Node) -> impl Iterator<Item = (usize, Child)> {
    node.children.into_iter().enumerate().filter(|(_, child)| *child != Child::NONE)
}

/// Where the mark of a leaf stands.
#[inline(always)]
fn place_of(leaf: Leaf) -> usize {
    leaf.block * TriangleBlock::WIDTH + leaf.first
}

fn of_triangle(scene: &Scene, triangle: u32) -> Unit {
    let [a, b, c] = scene.vertices(triangle);
    Unit { lower: a.min(b).min(c), upper: a.max(b).max(c), triangles: 1 }
}

/// The group of each triangle: the largest object first, each to the group that has the fewest triangles so far.
fn by_object(scene: &Scene, groups: usize) -> Vec<u32> {
    let mut order: Vec<usize> = (0..scene.objects.len()).collect();
    order.sort_by_key(|&object| std::cmp::Reverse(scene.objects[object].triangles.len()));
    let mut sizes = vec![0usize; groups];
    let mut group_of = vec![0; scene.triangles.len()];
    for object in order {
        let range = scene.objects[object].triangles.clone();
        let group = (0..groups).min_by_key(|&group| sizes[group]).unwrap_or(0);
        sizes[group] += range.len();
        group_of[range.start as usize..range.end as usize].fill(group as u32);
    }
    group_of
}

/// The blockers of one group, to be asked about.
#[derive(Clone, Copy, Debug)]
pub(super) struct Members<'a> {
    /// The units.
    pub(super) units: &'a Units,
    /// The group of each.
    pub(super) groups: &'a [u8],
    /// Which group.
    pub(super) group: u8,
}

impl Members<'_> {
    #[inline(always)]
    fn has(self, unit: u32) -> bool {
        self.groups.get(unit as usize).is_some_and(|&group| group == self.group)
    }
}

impl Part for Members<'_> {
    #[inline(always)]
    fn below(self, child: Child) -> bool {
        let mark = match child.as_leaf() {
            Some(leaf) => self.units.leaves[place_of(leaf)],
            None => child.as_node().map_or(MIXED, |node| self.units.nodes[node]),
        };
        mark == MIXED || self.has(mark)
    }

    #[inline(always)]
    fn holds(self, id: u32) -> bool {
        debug_assert_ne!(id, NO_TRIANGLE);
        self.units.triangles.is_empty()
            || self.units.triangles.get(id as usize).is_some_and(|&unit| self.has(unit))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::accel::{Accel, Quality};
    use crate::generate::{Kind, generate};

    /// Group by group, the triangles that queries would see.
    fn members(units: &Units, bvh: &Bvh<'_>, groups: &[u8]) -> Vec<Vec<u32>> {
        (0..units.groups)
            .map(|group| {
                let part = Members { units, groups, group: group as u8 };
                let (mut found, mut open) = (Vec::new(), vec![Child::node(0)]);
                while let Some(child) = open.pop() {
                    if let Some(leaf) = child.as_leaf() {
                        found.extend(leaf.ids(bvh.blocks()).iter().filter(|&&id| part.holds(id)));
                    } else if let Some(node) = child.as_node() {
                        let below = children(&bvh.nodes()[node]).map(|(_, child)| child);
                        open.extend(below.filter(|&child| part.below(child)));
                    }
                }
                found.sort_unstable();
                found
            })
            .collect()
    }

    /// Every triangle is in one group and in no other, and groups are of about one size.
    #[test]
    fn groups_divide_the_scene() {
        for (kind, triangles) in [(Kind::Spheres, 20_000), (Kind::City, 5000), (Kind::Soup, 200)] {
            let scene = generate(kind, 3, triangles);
            let accel = Accel::build(&scene, Quality::Medium);
            let bvh = accel.bvh();
            let (lower, upper) = scene.bounds().unwrap();
            for split in [Split::Random, Split::Sorted, Split::Object] {
                for count in [2, 3, 7] {
                    let Ok(units) = Units::new(&scene, &bvh, split, count) else {
                        assert!(split == Split::Object && scene.objects.len() < count);
                        continue;
                    };
                    assert!(units.units.len() <= MOST);
                    let mut draws = Vec::new();
                    for seed in 0..4 {
                        let mut groups = Vec::new();
                        let x = lower + (upper - lower) * (seed as f32 / 3.0);
                        let mut random = Sampler::new(seed, 0, 0);
                        units.draw(x, &mut random, &mut groups, &mut Vec::new());
                        let members = members(&units, &bvh, &groups);
                        let mut all: Vec<u32> = members.iter().flatten().copied().collect();
                        all.sort_unstable();
                        assert!(
                            all.iter().copied().eq(0..scene.triangles.len() as u32),
                            "{kind:?} {split:?}"
                        );
                        if split != Split::Object {
                            let fair = scene.triangles.len() as f64 / count as f64;
                            for group in &members {
                                let share = group.len() as f64 / fair;
                                assert!((0.8..1.25).contains(&share), "{kind:?} {split:?} {count}: {share}");
                            }
                        }
                        draws.push(members);
                    }
                    // The object split is fixed, the others are not.
                    assert_eq!(draws.windows(2).all(|pair| pair[0] == pair[1]), split == Split::Object);
                }
            }
        }
    }

    #[test]
    fn sorted_groups_are_sorted() {
        let scene = generate(Kind::Soup, 3, 250);
        let accel = Accel::build(&scene, Quality::Medium);
        let bvh = accel.bvh();
        let units = Units::new(&scene, &bvh, Split::Sorted, 2).unwrap();
        let x = Vec3::new(0.5, 0.2, -0.3);
        let mut groups = Vec::new();
        units.draw(x, &mut Sampler::new(0, 0, 0), &mut groups, &mut Vec::new());
        let distance = |&id: &u32| {
            let unit = of_triangle(&scene, id);
            x.clamp(unit.lower, unit.upper).distance(x)
        };
        let [near, far] = [0, 1].map(|group| members(&units, &bvh, &groups)[group].clone());
        let farthest = near.iter().map(distance).fold(0.0, f32::max);
        assert!(far.iter().map(distance).fold(f32::INFINITY, f32::min) >= farthest);
        assert!(near.len().abs_diff(far.len()) <= 1);
    }
}
