//! Boxes wholly inside closed meshes: a ray that meets one of them is blocked, whatever triangle does it.
//!
//! If a segment ends outside a closed mesh and passes through a point inside it, it crosses the mesh, wherever it
//! begins. So what counts is where light comes from: a mesh that encloses or touches a light, such as the walls of a
//! room with a lamp in it, blocks nothing of that light by its inside, and its boxes are left out for that light.
//! Points to shade may be anywhere, also inside meshes and on either side of their surfaces.
//!
//! Each closed mesh ([`crate::mesh::closed`]) is cut into voxels. Those that a triangle touches are its surface; of
//! the others, what the outside does not reach through faces of voxels is inside if the mesh winds around it, by the
//! solid angles of all triangles. Inside is then covered by boxes, the one around the deepest voxel first; they may
//! overlap, as larger boxes hide more. At last each box grows until it nearly touches a triangle.
//!
//! After Djeu, Keely and Hunt, "Accelerating Shadow Rays Using Volumetric Occluders and Modified kd-Tree Traversal"
//! (High Performance Graphics 2009). Winding numbers: van Oosterom and Strackee, "The Solid Angle of a Plane
//! Triangle" (1983).

use crate::light::{AreaLight, Shape};
use crate::mesh;
use crate::scene::Scene;
use glam::{DVec3, Vec3};
use occlude_kernel::{Child, Node, Occluders};
use rayon::prelude::*;
use std::collections::HashMap;
use std::f64::consts::TAU;
use std::time::{Duration, Instant};

/// A box inside a closed mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolidBox {
    /// The least corner.
    pub lower: Vec3,
    /// The greatest corner.
    pub upper: Vec3,
    /// The closed mesh, counted in the order of [`mesh::closed`].
    pub mesh: u32,
}

impl SolidBox {
    fn half_area(&self) -> f32 {
        let d = self.upper - self.lower;
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

/// What was found.
#[derive(Clone, Copy, Debug, Default)]
pub struct VolumeStats {
    /// Closed meshes of the scene.
    pub meshes: usize,
    /// Those with boxes inside that some light may use.
    pub filled_meshes: usize,
    /// Boxes that some light may use.
    pub boxes: usize,
    /// Volume that closed meshes enclose, but for those that enclose or touch every light.
    pub enclosed: f64,
    /// Volume of the boxes, counted once where they overlap.
    pub filled: f64,
    /// Time to find them, on the clock.
    pub time: Duration,
}

impl VolumeStats {
    /// The part of the enclosed volume that boxes fill; 0 where nothing is enclosed.
    pub fn fraction(&self) -> f64 {
        if self.enclosed > 0.0 { (self.filled / self.enclosed).min(1.0) } else { 0.0 }
    }
}

/// The boxes of a scene, for each of its lights those that block its light.
#[derive(Clone, Debug, Default)]
pub struct Volumes {
    boxes: Vec<SolidBox>,
    /// Trees over the boxes that a light may use.
    trees: Vec<Vec<Node>>,
    /// Which of the trees is a light's.
    of_light: Vec<u32>,
    /// How it went.
    pub stats: VolumeStats,
}

/// Voxels along the longest side of a mesh, at least and at most; in between four for each cube root of its triangles.
const VOXELS: [usize; 2] = [8, 96];

/// Voxels along any side, at least.
const THIN: usize = 8;

/// Voxels of all meshes together; what would need more than is left gets a coarser grid, or none.
const ALL_VOXELS: usize = 1 << 26;

/// Where boxes fill less than this part of a mesh, voxels half as large are tried, while they are no more than `FINER`
/// and the mesh's share of all.
const ENOUGH: f64 = 0.3;
const FINER: usize = 1 << 21;

/// Pairs of triangles and voxels looked at for one mesh.
const ALL_PAIRS: f64 = 2e8;

/// Voxels around the box of a mesh: one that its faces may touch, and one that is surely outside.
const MARGIN: usize = 2;

/// Voxels are no smaller than this part of the scene's greatest coordinate: boxes must outlast what is taken off for
/// rounding, and a quarter of a voxel must be more than points are moved off a light.
const SMALLEST: f64 = 2e-5;

/// Boxes of one mesh, and of all; those with the greatest surfaces are kept.
const BOXES: usize = 64;
const ALL_BOXES: usize = 1 << 14;

/// A box must hold this part of a mesh's inside that no other holds, or if that is asking too much, as in a lattice,
/// this part of what the first one holds.
const NEW: [f64; 2] = [0.01, 0.5];

/// How near boxes come to triangles, in voxels.
const GAP: f64 = 1e-3;

/// How near to a triangle, in voxels, light may be outside.
const LIGHT_GAP: f64 = 0.25;

/// How far boxes may grow once they are made of voxels, in voxels.
const GROWTH: f64 = 2.0;

/// Parts of a mesh's inside that are looked at.
const PARTS: usize = 64;

impl Volumes {
    /// Finds the boxes of a scene with these lights, on the threads of the current pool.
    pub fn build(scene: &Scene, lights: &[AreaLight]) -> Self {
        let start = Instant::now();
        let meshes = mesh::closed(scene);
        let magnitude = scene
            .bounds()
            .map_or(0.0, |(lower, upper)| f64::from(lower.abs().max(upper.abs()).max_element()));
        let mut bodies: Vec<Body> =
            (0..).zip(&meshes).filter_map(|(mesh, triangles)| Body::new(scene, mesh, triangles)).collect();
        let mut enclosed: f64 = bodies.iter().map(Body::volume).sum();
        // The largest first, while there are voxels.
        bodies.sort_by(|a, b| b.size().total_cmp(&a.size()).then(a.mesh.cmp(&b.mesh)));
        let mut left = ALL_VOXELS;
        let mut work = Vec::new();
        for body in &bodies {
            let size = body.resolution(left, magnitude);
            if let Some(size) = size {
                left -= size.iter().map(|n| n + 2 * MARGIN).product::<usize>().min(left);
                work.push((body, size));
            }
        }
        let most = (ALL_VOXELS / work.len().max(1)).min(FINER);
        let fill = |(body, size): &(&Body, _)| body.fill(*size, most, magnitude, lights);
        let found: Vec<Found> = work.par_iter().map(fill).collect();
        let mut volumes = Self::default();
        let mut banned: Vec<Vec<u32>> = vec![Vec::new(); lights.len()];
        let (mut filled, mut filled_meshes) = (0.0, 0);
        for ((body, _), found) in work.iter().zip(found) {
            if found.boxes.is_empty() {
                continue;
            }
            if found.banned.len() == lights.len() {
                enclosed -= body.volume();
                continue;
            }
            filled += found.filled;
            filled_meshes += 1;
            for &light in &found.banned {
                banned[light as usize].push(found.boxes[0].mesh);
            }
            volumes.boxes.extend(found.boxes);
        }
        if volumes.boxes.len() > ALL_BOXES {
            volumes.boxes.sort_by(|a, b| b.half_area().total_cmp(&a.half_area()));
            volumes.boxes.truncate(ALL_BOXES);
        }
        // Lights that leave out the same meshes share a tree.
        let mut known: HashMap<Vec<u32>, u32> = HashMap::new();
        for mut banned in banned {
            banned.sort_unstable();
            let next = volumes.trees.len() as u32;
            let tree = *known.entry(banned).or_insert_with_key(|banned| {
                let usable = |b: &&SolidBox| banned.binary_search(&b.mesh).is_err();
                volumes.trees.push(tree(volumes.boxes.iter().filter(usable)));
                next
            });
            volumes.of_light.push(tree);
        }
        volumes.stats = VolumeStats {
            meshes: meshes.len(),
            filled_meshes,
            boxes: volumes.boxes.len(),
            enclosed,
            filled,
            time: start.elapsed(),
        };
        volumes
    }

    /// All boxes.
    pub fn boxes(&self) -> &[SolidBox] {
        &self.boxes
    }

    /// The boxes that block the light of each light, to ask. Checks them, so ask for it once a render.
    pub fn occluders(&self) -> Vec<Occluders<'_>> {
        let tree = |&tree: &u32| Occluders::new(&self.trees[tree as usize]).expect("boxes are finite");
        self.of_light.iter().map(tree).collect()
    }
}

/// A tree over boxes, cut in halves by their middles, eight children a node.
fn tree<'a>(boxes: impl Iterator<Item = &'a SolidBox>) -> Vec<Node> {
    let mut boxes: Vec<(u32, &SolidBox)> = (0..).zip(boxes).collect();
    let mut nodes = Vec::new();
    if !boxes.is_empty() {
        subtree(&mut boxes, &mut nodes);
    }
    nodes
}

fn subtree(boxes: &mut [(u32, &SolidBox)], nodes: &mut Vec<Node>) -> (Child, Vec3, Vec3) {
    let index = nodes.len();
    nodes.push(Node::EMPTY);
    let mut parts: Vec<&mut [(u32, &SolidBox)]> = vec![boxes];
    for _ in 0..3 {
        parts = parts.into_iter().flat_map(halves).collect();
    }
    let (mut lower, mut upper) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    let mut place = 0;
    for part in parts {
        let (child, low, high) = match part {
            [] => continue,
            [(number, only)] => (Child::leaf(*number), only.lower, only.upper),
            _ => subtree(part, nodes),
        };
        nodes[index].set(place, low.to_array(), high.to_array(), child);
        (lower, upper) = (lower.min(low), upper.max(high));
        place += 1;
    }
    (Child::node(index as u32), lower, upper)
}

fn halves<'a, 'b>(boxes: &'a mut [(u32, &'b SolidBox)]) -> [&'a mut [(u32, &'b SolidBox)]; 2] {
    let middle = |b: &SolidBox| (b.lower + b.upper) * 0.5;
    let (low, high) = boxes
        .iter()
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, h), b| (l.min(middle(b.1)), h.max(middle(b.1))));
    let axis = (high - low).max_position();
    boxes.sort_by(|a, b| middle(a.1)[axis].total_cmp(&middle(b.1)[axis]).then(a.0.cmp(&b.0)));
    let (first, second) = boxes.split_at_mut(boxes.len().div_ceil(2));
    [first, second]
}

/// A closed mesh on its own.
struct Body {
    mesh: u32,
    triangles: Vec<[DVec3; 3]>,
    lower: DVec3,
    upper: DVec3,
}

/// What is inside a mesh.
#[derive(Default)]
struct Found {
    boxes: Vec<SolidBox>,
    filled: f64,
    /// Lights that the mesh encloses or touches.
    banned: Vec<u32>,
}

impl Body {
    /// `None` if it has no room for an inside.
    fn new(scene: &Scene, mesh: u32, triangles: &[u32]) -> Option<Self> {
        let triangles: Vec<[DVec3; 3]> =
            triangles.iter().map(|&i| scene.vertices(i).map(|v| v.as_dvec3())).collect();
        let (lower, upper) = bounds(triangles.iter().flatten());
        (triangles.len() >= 4 && (upper - lower).min_element() > 0.0).then_some(Self {
            mesh,
            triangles,
            lower,
            upper,
        })
    }

    /// Half of its box's surface.
    fn size(&self) -> f64 {
        let d = self.upper - self.lower;
        d.x * d.y + d.y * d.z + d.z * d.x
    }

    fn volume(&self) -> f64 {
        let six = |[a, b, c]: &[DVec3; 3]| (*a - self.lower).dot((*b - self.lower).cross(*c - self.lower));
        (self.triangles.iter().map(six).sum::<f64>() / 6.0).abs()
    }

    /// Voxels along each side; `None` where they would be too small or more than `left`.
    fn resolution(&self, left: usize, magnitude: f64) -> Option<[usize; 3]> {
        let extent = self.upper - self.lower;
        let [least, most] = VOXELS;
        let mut finest = ((4.0 * (self.triangles.len() as f64).cbrt()) as usize).clamp(least, most);
        loop {
            let n = (extent / extent.max_element() * finest as f64).ceil();
            let size = [n.x, n.y, n.z].map(|n| (n as usize).clamp(THIN.min(finest), finest));
            if self.affordable(size, left, magnitude) {
                return Some(size);
            }
            if finest <= THIN {
                return None;
            }
            finest = (finest / 2).max(THIN);
        }
    }

    /// Are there no more voxels than `most`, nor too many to look at, and none too small?
    fn affordable(&self, size: [usize; 3], most: usize, magnitude: f64) -> bool {
        let count: usize = size.iter().map(|n| n + 2 * MARGIN).product();
        let cell = (self.upper - self.lower) / DVec3::from(size.map(|n| n as f64));
        let pairs = |triangle: &[DVec3; 3]| {
            let (lower, upper) = bounds(triangle.iter());
            ((upper - lower) / cell + 2.0).element_product()
        };
        count <= most
            && cell.min_element() > SMALLEST * magnitude
            && self.triangles.iter().map(pairs).sum::<f64>() <= ALL_PAIRS
    }

    /// Finds the boxes, with finer voxels where these leave much open and no more than `most` are needed.
    fn fill(&self, size: [usize; 3], most: usize, magnitude: f64, lights: &[AreaLight]) -> Found {
        let enough = ENOUGH * self.volume();
        let (mut size, mut best) = (size, Found::default());
        loop {
            let found = self.fill_with(size, lights);
            if found.filled > best.filled {
                best = found;
            }
            size = size.map(|n| 2 * n);
            if best.filled >= enough || !self.affordable(size, most, magnitude) {
                return best;
            }
        }
    }

    fn fill_with(&self, size: [usize; 3], lights: &[AreaLight]) -> Found {
        let mut grid = Grid::new(self, size);
        grid.touch();
        grid.flood();
        let depths = grid.depths();
        grid.judge(&depths);
        if !grid.labels.contains(&Label::Inside) {
            return Found::default();
        }
        let (boxes, filled) = grid.cover(&depths);
        let banned = (0..).zip(lights).filter(|(_, light)| !grid.outside(light)).map(|(i, _)| i).collect();
        Found { boxes, filled, banned }
    }
}

fn bounds<'a>(points: impl Iterator<Item = &'a DVec3>) -> (DVec3, DVec3) {
    points.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lower, upper), &p| (lower.min(p), upper.max(p)))
}

/// What a voxel is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Label {
    /// No triangle touches it; else not known yet.
    Free,
    /// A triangle touches it.
    Surface,
    /// The outside reaches it.
    Outside,
    /// The mesh winds around it.
    Inside,
    /// Shut in, but not inside, or not worth looking at.
    Other,
}

/// Voxels around a mesh, counted along x first. Positions are in voxels from the grid's corner.
struct Grid<'a> {
    body: &'a Body,
    corner: DVec3,
    cell: DVec3,
    size: [usize; 3],
    triangles: Vec<[DVec3; 3]>,
    labels: Vec<Label>,
}

impl<'a> Grid<'a> {
    fn new(body: &'a Body, inner: [usize; 3]) -> Self {
        let count = DVec3::from(inner.map(|n| n as f64));
        let cell = (body.upper - body.lower) / count;
        let corner = body.lower - cell * MARGIN as f64;
        let size = inner.map(|n| n + 2 * MARGIN);
        let triangles = body.triangles.iter().map(|t| t.map(|v| (v - corner) / cell)).collect();
        Self { body, corner, cell, size, triangles, labels: vec![Label::Free; size.iter().product()] }
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.size[1] + y) * self.size[0] + x
    }

    fn place(&self, index: usize) -> [usize; 3] {
        let [nx, ny, _] = self.size;
        [index % nx, index / nx % ny, index / (nx * ny)]
    }

    /// Voxels that a triangle may touch, `gap` further out: the first and the last along each axis. `None` if it is
    /// off the grid.
    fn range(&self, triangle: &[DVec3; 3], gap: f64) -> Option<[[usize; 2]; 3]> {
        let (lower, upper) = bounds(triangle.iter());
        let mut range = [[0; 2]; 3];
        for axis in 0..3 {
            let last = self.size[axis] as f64 - 1.0;
            let (from, to) = ((lower[axis] - gap).floor(), (upper[axis] + gap).floor());
            if to < 0.0 || from > last {
                return None;
            }
            range[axis] = [from.max(0.0) as usize, to.min(last) as usize];
        }
        Some(range)
    }

    /// Visits the voxels within `gap` of a triangle until it is told to stop; false if it was.
    fn around(&self, triangle: &[DVec3; 3], gap: f64, mut visit: impl FnMut(usize) -> bool) -> bool {
        let Some([xs, ys, zs]) = self.range(triangle, gap) else { return true };
        for z in zs[0]..=zs[1] {
            for y in ys[0]..=ys[1] {
                for x in xs[0]..=xs[1] {
                    let centre = DVec3::new(x as f64, y as f64, z as f64) + 0.5;
                    if touches(triangle, centre, DVec3::splat(0.5 + gap)) && !visit(self.index([x, y, z])) {
                        return false;
                    }
                }
            }
        }
        true
    }

    /// Finds the surface.
    fn touch(&mut self) {
        let triangles = std::mem::take(&mut self.triangles);
        let mut labels = std::mem::take(&mut self.labels);
        for triangle in &triangles {
            self.around(triangle, GAP, |voxel| {
                labels[voxel] = Label::Surface;
                true
            });
        }
        (self.triangles, self.labels) = (triangles, labels);
    }

    /// Visits a voxel and all of its label that are connected with it by faces, and gives them another label.
    fn spread(&mut self, from: usize, to: Label) -> Vec<usize> {
        let was = self.labels[from];
        self.labels[from] = to;
        let mut reached = vec![from];
        let mut next = 0;
        while next < reached.len() {
            let at = self.place(reached[next]);
            next += 1;
            for axis in 0..3 {
                for side in 0..2 {
                    let mut beside = at;
                    if side == 0 && at[axis] > 0 {
                        beside[axis] -= 1;
                    } else if side == 1 && at[axis] + 1 < self.size[axis] {
                        beside[axis] += 1;
                    } else {
                        continue;
                    }
                    let index = self.index(beside);
                    if self.labels[index] == was {
                        self.labels[index] = to;
                        reached.push(index);
                    }
                }
            }
        }
        reached
    }

    /// Finds the outside: the outermost voxels are free, and surely outside.
    fn flood(&mut self) {
        self.spread(0, Label::Outside);
    }

    /// For each free voxel, how many steps, diagonal ones too, it is away from any other.
    fn depths(&self) -> Vec<u8> {
        let mut depths: Vec<u8> =
            self.labels.iter().map(|&label| if label == Label::Free { u8::MAX } else { 0 }).collect();
        let [nx, ny, nz] = self.size;
        // The outermost voxels are not free, so no voxel that counts lacks a neighbour.
        let mut offsets = Vec::new();
        for z in -1isize..=1 {
            for y in -1isize..=1 {
                for x in -1isize..=1 {
                    let offset = (z * ny as isize + y) * nx as isize + x;
                    if offset < 0 {
                        offsets.push(offset);
                    }
                }
            }
        }
        let total = nx * ny * nz;
        for backwards in [false, true] {
            for i in 0..total {
                let index = if backwards { total - 1 - i } else { i };
                if depths[index] == 0 {
                    continue;
                }
                let sign = if backwards { -1 } else { 1 };
                let least = offsets
                    .iter()
                    .map(|offset| depths[index.wrapping_add_signed(sign * offset)])
                    .min()
                    .unwrap_or(0);
                depths[index] = depths[index].min(least.saturating_add(1));
            }
        }
        depths
    }

    /// Finds what is inside among the voxels that the outside does not reach.
    fn judge(&mut self, depths: &[u8]) {
        let mut parts = 0;
        for voxel in 0..self.labels.len() {
            if self.labels[voxel] != Label::Free {
                continue;
            }
            let reached = self.spread(voxel, Label::Other);
            if reached.len() < 8 || parts == PARTS {
                continue;
            }
            parts += 1;
            let deepest = *reached.iter().max_by_key(|&&voxel| depths[voxel]).expect("at least one");
            let at = DVec3::from(self.place(deepest).map(|n| n as f64 + 0.5));
            let winding = winding(&self.triangles, at);
            if winding.abs() > 0.9 && (winding - winding.round()).abs() < 0.1 {
                reached.iter().for_each(|&voxel| self.labels[voxel] = Label::Inside);
            }
        }
    }

    /// Boxes that cover what is inside, and their volume.
    fn cover(&self, depths: &[u8]) -> (Vec<SolidBox>, f64) {
        let sums = self.sums();
        let total = self.labels.iter().filter(|&&label| label == Label::Inside).count();
        let mut covered = vec![false; self.labels.len()];
        let mut found: Vec<[DVec3; 2]> = Vec::new();
        let mut least = NEW[0] * total as f64;
        for _ in 0..2 * BOXES {
            let mut seed = None;
            for voxel in 0..self.labels.len() {
                if self.labels[voxel] == Label::Inside
                    && !covered[voxel]
                    && seed.is_none_or(|best: usize| depths[voxel] > depths[best])
                {
                    seed = Some(voxel);
                }
            }
            let Some(seed) = seed else { break };
            let range = self.grow(&sums, seed);
            let mut new = 0;
            for z in range[2][0]..range[2][1] {
                for y in range[1][0]..range[1][1] {
                    for x in range[0][0]..range[0][1] {
                        let covered = &mut covered[self.index([x, y, z])];
                        new += usize::from(!*covered);
                        *covered = true;
                    }
                }
            }
            if found.is_empty() {
                least = least.min(NEW[1] * new as f64);
            }
            if new as f64 >= least {
                found.push(self.widen([0, 1].map(|side| DVec3::from(range.map(|r| r[side] as f64)))));
                if found.len() == BOXES {
                    break;
                }
            }
        }
        let volume = union(&found) * self.cell.element_product();
        let boxes = found.iter().filter_map(|[lower, upper]| {
            let lower = (self.corner + *lower * self.cell).to_array().map(|v| rounded(v, true));
            let upper = (self.corner + *upper * self.cell).to_array().map(|v| rounded(v, false));
            let (lower, upper) = (Vec3::from(lower), Vec3::from(upper));
            lower.cmplt(upper).all().then_some(SolidBox { lower, upper, mesh: self.body.mesh })
        });
        (boxes.collect(), volume)
    }

    /// How many voxels before a corner are inside, for all corners.
    fn sums(&self) -> Vec<u32> {
        let [nx, ny, nz] = self.size;
        let at = |x: usize, y: usize, z: usize| (z * (ny + 1) + y) * (nx + 1) + x;
        let mut sums = vec![0u32; (nx + 1) * (ny + 1) * (nz + 1)];
        for z in 0..nz {
            for y in 0..ny {
                let mut row = 0;
                for x in 0..nx {
                    row += u32::from(self.labels[self.index([x, y, z])] == Label::Inside);
                    sums[at(x + 1, y + 1, z + 1)] =
                        row + sums[at(x + 1, y, z + 1)] + sums[at(x + 1, y + 1, z)] - sums[at(x + 1, y, z)];
                }
            }
        }
        sums
    }

    /// Grows a voxel, a layer a side in turn, as long as all of it is inside.
    fn grow(&self, sums: &[u32], seed: usize) -> [[usize; 2]; 3] {
        let [nx, ny, _] = self.size;
        let sum = |x: usize, y: usize, z: usize| u64::from(sums[(z * (ny + 1) + y) * (nx + 1) + x]);
        let full = |[[x, x1], [y, y1], [z, z1]]: [[usize; 2]; 3]| {
            let above = sum(x1, y1, z1) + sum(x, y, z1) - sum(x, y1, z1) - sum(x1, y, z1);
            let below = sum(x1, y1, z) + sum(x, y, z) - sum(x, y1, z) - sum(x1, y, z);
            above - below == ((x1 - x) * (y1 - y) * (z1 - z)) as u64
        };
        let mut range = self.place(seed).map(|n| [n, n + 1]);
        let mut growing = true;
        while growing {
            growing = false;
            for axis in 0..3 {
                for side in 0..2 {
                    let mut layer = range;
                    if side == 0 {
                        layer[axis] = [range[axis][0] - 1, range[axis][0]];
                    } else {
                        layer[axis] = [range[axis][1], range[axis][1] + 1];
                    }
                    // The outermost voxels are never inside, so this ends before them.
                    if full(layer) {
                        range[axis][side] = layer[axis][side];
                        growing = true;
                    }
                }
            }
        }
        range
    }

    /// Moves the sides of a box out until it nearly touches a triangle.
    fn widen(&self, [mut lower, mut upper]: [DVec3; 2]) -> [DVec3; 2] {
        let gap = DVec3::splat(GAP);
        let near = |triangle: &&[DVec3; 3], lower: DVec3, upper: DVec3| {
            touches(triangle, (lower + upper) * 0.5, (upper - lower) * 0.5 + gap)
        };
        let around: Vec<&[DVec3; 3]> =
            self.triangles.iter().filter(|t| near(t, lower - GROWTH, upper + GROWTH)).collect();
        for axis in 0..3 {
            for side in 0..2 {
                // What would be added for a step.
                let slab = |step: f64| {
                    let (mut low, mut high) = (lower, upper);
                    if side == 0 {
                        (low[axis], high[axis]) = (lower[axis] - step, lower[axis]);
                    } else {
                        (low[axis], high[axis]) = (upper[axis], upper[axis] + step);
                    }
                    (low, high)
                };
                let (low, high) = slab(GROWTH);
                let there: Vec<&[DVec3; 3]> = around.iter().copied().filter(|t| near(t, low, high)).collect();
                let (mut free, mut most) = (0.0, GROWTH);
                for _ in 0..8 {
                    let step = if there.is_empty() { GROWTH } else { 0.5 * (free + most) };
                    let (low, high) = slab(step);
                    if there.iter().any(|t| near(t, low, high)) { most = step } else { free = step }
                }
                if side == 0 {
                    lower[axis] -= free;
                } else {
                    upper[axis] += free;
                }
            }
        }
        [lower, upper]
    }

    /// Is all of a light outside, and at a distance from the mesh?
    fn outside(&self, light: &AreaLight) -> bool {
        let [a, u, v] = [light.corner, light.u, light.v].map(|v| v.as_dvec3());
        let in_voxels = |v: DVec3| (v - self.corner) / self.cell;
        let mut halves = vec![[a, a + u, a + v].map(in_voxels)];
        if light.shape == Shape::Parallelogram {
            halves.push([a + u, a + v, a + u + v].map(in_voxels));
        }
        // Corners are rounded, and points a little off the corners' plane.
        let off = 1e-4 * (u.length() + v.length()) / self.cell.min_element();
        halves
            .iter()
            .all(|half| self.around(half, LIGHT_GAP + off, |voxel| self.labels[voxel] == Label::Outside))
    }
}

/// The `f32` next to a number on one side, or the number.
fn rounded(value: f64, up: bool) -> f32 {
    let near = value as f32;
    match (up, f64::from(near).partial_cmp(&value)) {
        (true, Some(std::cmp::Ordering::Less)) => near.next_up(),
        (false, Some(std::cmp::Ordering::Greater)) => near.next_down(),
        _ => near,
    }
}

/// Does a triangle touch a box? By the axes that may separate them: the box's, the triangle's normal, and the
/// products of their edges. After Akenine-Möller, "Fast 3D Triangle-Box Overlap Testing" (2001).
fn touches(triangle: &[DVec3; 3], centre: DVec3, half: DVec3) -> bool {
    let [a, b, c] = triangle.map(|v| v - centre);
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    if low.cmpgt(half).any() || high.cmplt(-half).any() {
        return false;
    }
    let edges = [b - a, c - b, a - c];
    let normal = edges[0].cross(edges[1]);
    if normal.dot(a).abs() > normal.abs().dot(half) {
        return false;
    }
    for edge in edges {
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            let across = axis.cross(edge);
            let reach = across.abs().dot(half);
            let [p, q, r] = [across.dot(a), across.dot(b), across.dot(c)];
            if p.min(q).min(r) > reach || p.max(q).max(r) < -reach {
                return false;
            }
        }
    }
    true
}

/// How often triangles wind around a point.
fn winding(triangles: &[[DVec3; 3]], point: DVec3) -> f64 {
    let angle = |triangle: &[DVec3; 3]| {
        let [a, b, c] = triangle.map(|v| v - point);
        let (la, lb, lc) = (a.length(), b.length(), c.length());
        let volume = a.dot(b.cross(c));
        let rest = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
        2.0 * volume.atan2(rest)
    };
    triangles.iter().map(angle).sum::<f64>() / (2.0 * TAU)
}

/// The volume of boxes, counted once where they overlap.
fn union(boxes: &[[DVec3; 2]]) -> f64 {
    let cuts = [0, 1, 2].map(|axis| {
        let mut cuts: Vec<f64> = boxes.iter().flatten().map(|corner| corner[axis]).collect();
        cuts.sort_by(f64::total_cmp);
        cuts.dedup();
        cuts
    });
    let [nx, ny, nz] = [0, 1, 2].map(|axis: usize| cuts[axis].len());
    let mut inside = vec![false; nx * ny * nz];
    let mut volume = 0.0;
    for [lower, upper] in boxes {
        let place = |axis: usize, at: f64| cuts[axis].partition_point(|&cut| cut < at);
        for z in place(2, lower.z)..place(2, upper.z) {
            for y in place(1, lower.y)..place(1, upper.y) {
                for x in place(0, lower.x)..place(0, upper.x) {
                    let cell = &mut inside[(z * ny + y) * nx + x];
                    if !*cell {
                        *cell = true;
                        volume += (cuts[0][x + 1] - cuts[0][x])
                            * (cuts[1][y + 1] - cuts[1][y])
                            * (cuts[2][z + 1] - cuts[2][z]);
                    }
                }
            }
        }
    }
    volume
}
