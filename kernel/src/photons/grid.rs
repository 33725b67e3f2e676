//! A hashed grid of photons, to measure the tree against.

use super::{Nearest, PhotonBlock, Place, PlaceLanes, Point};
use crate::lanes::{Native, Simd};
use bytemuck::{Pod, Zeroable};

/// A cell that holds photons: which, and where they stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct GridCell {
    cell: [i32; 3],
    first: u32,
    len: u32,
}

impl GridCell {
    /// No cell: what to fill a table with.
    pub const NONE: Self = Self { cell: [0; 3], first: 0, len: 0 };
}

/// Cells farther from 0 than this are one.
const EDGE: f32 = (1 << 29) as f32;

/// Photons sorted by the cells of a regular grid, and a table that finds a cell by its hash.
///
/// Look-ups visit the cells around a point shell by shell. Quicker than the tree where photons are spread evenly
/// and the edge of a cell is about the distance of the k-th; a sparse place then takes many empty cells, and a
/// dense one many photons.
#[derive(Clone, Copy, Debug)]
pub struct PhotonGrid<'a, S = Native> {
    blocks: &'a [PhotonBlock],
    table: &'a [GridCell],
    edge: f32,
    simd: S,
}

impl<'a> PhotonGrid<'a> {
    /// Cells of a table for this many photons.
    pub const fn table(photons: usize) -> usize {
        photons.saturating_mul(2).next_power_of_two()
    }

    /// Sorts points ([`PhotonBlock::as_points`]) into cells of this edge and fills the table, in place.
    ///
    /// `None` if the edge is not a positive finite number, if the table's length is not a power of two or if more
    /// than half of it would be used ([`PhotonGrid::table`]), or if there are more photons than 2³².
    pub fn build(blocks: &'a mut [PhotonBlock], table: &'a mut [GridCell], edge: f32) -> Option<Self> {
        let scale = 1.0 / edge;
        if !(edge > 0.0 && scale.is_finite() && scale > 0.0 && table.len().is_power_of_two()) {
            return None;
        }
        let points = PhotonBlock::as_points(blocks);
        if points.len() as u64 > u64::from(u32::MAX) {
            return None;
        }
        table.fill(GridCell::NONE);
        let nowhere = |point: &Point| !point.position.iter().all(|at| at.is_finite());
        points.sort_unstable_by_key(|point| (nowhere(point), cell_of(point.position, scale), point.id));
        let photons = points.partition_point(|point| !nowhere(point));
        let (mut first, mut cells) = (0, 0);
        while first < photons {
            let cell = cell_of(points[first].position, scale);
            let same = |point: &Point| cell_of(point.position, scale) == cell;
            let len = points[first..photons].iter().take_while(|&point| same(point)).count();
            cells += 1;
            if cells > table.len() / 2 {
                return None;
            }
            let mut slot = hash(cell) & (table.len() - 1);
            while table[slot].len != 0 {
                slot = (slot + 1) & (table.len() - 1);
            }
            table[slot] = GridCell { cell, first: first as u32, len: len as u32 };
            first += len;
        }
        PhotonBlock::transpose(points);
        Some(Self { blocks, table, edge, simd: Native })
    }
}

impl<'a, S: Simd> PhotonGrid<'a, S> {
    /// The same grid, asked with other vectors.
    #[inline(always)]
    pub fn on<T: Simd>(&self, simd: T) -> PhotonGrid<'a, T> {
        PhotonGrid { blocks: self.blocks, table: self.table, edge: self.edge, simd }
    }

    /// What [`PhotonMap::nearest`](super::PhotonMap::nearest) finds, with the same answers.
    #[inline(always)]
    pub fn nearest(&self, place: &Place, nearest: &mut Nearest<'_>) {
        nearest.start(place.reach());
        if self.blocks.is_empty() || nearest.reach() < 0.0 || !place.x.is_finite() {
            return;
        }
        let token = self.simd.token();
        let lanes = PlaceLanes::<S::Node>::new(token, place);
        let scale = 1.0 / self.edge;
        let x = place.x.to_array();
        let middle = cell_of(x, scale);
        // Rounding of products and differences may misplace a photon by this much.
        let slack = 1e-5 * self.edge + 8.0 * f32::EPSILON * place.x.abs().max_element();
        let mut inside = f32::INFINITY; // from x to the nearest side of its cell
        for axis in 0..3 {
            let low = x[axis] - middle[axis] as f32 * self.edge;
            let high = (middle[axis] as f32 + 1.0) * self.edge - x[axis];
            inside = inside.min(low).min(high);
        }
        let mut shell = 0i32;
        loop {
            let clear = (inside + (shell - 1) as f32 * self.edge) * (1.0 - 1e-5) - slack;
            if shell > 0 && clear > 0.0 && clear * clear > nearest.reach() {
                break;
            }
            // So many cells that a look at every photon is no more work.
            let side = 2 * i64::from(shell) + 1;
            if shell > 0 && 6 * side * side > self.blocks.len() as i64 {
                nearest.start(place.reach());
                for block in self.blocks {
                    lanes.offer(token, block, 0xff, nearest);
                }
                break;
            }
            let (mut dx, mut dy) = (-shell, -shell);
            while dx <= shell {
                while dy <= shell {
                    // Of inner columns only both ends belong to the shell.
                    let whole = dx.abs() == shell || dy.abs() == shell;
                    let step = if whole { 1 } else { (2 * shell).max(1) };
                    let mut dz = -shell;
                    while dz <= shell {
                        let cell = self.find([middle[0] + dx, middle[1] + dy, middle[2] + dz]);
                        self.offer(token, &lanes, cell, nearest);
                        dz += step;
                    }
                    dy += 1;
                }
                dy = -shell;
                dx += 1;
            }
            nearest.leaf_done();
            shell += 1;
        }
        nearest.finish();
    }

    #[inline(always)]
    fn find(&self, cell: [i32; 3]) -> GridCell {
        let mut slot = hash(cell) & (self.table.len() - 1);
        loop {
            let at = self.table[slot];
            if at.len == 0 || at.cell == cell {
                return at;
            }
            slot = (slot + 1) & (self.table.len() - 1);
        }
    }

    #[inline(always)]
    fn offer(&self, token: S::Token, lanes: &PlaceLanes<S::Node>, cell: GridCell, nearest: &mut Nearest<'_>) {
        let (mut at, last) = (cell.first as usize, cell.first as usize + cell.len as usize);
        while at < last {
            let lane = at % PhotonBlock::WIDTH;
            let count = (PhotonBlock::WIDTH - lane).min(last - at);
            let ask = ((1u32 << count) - 1) << lane;
            lanes.offer(token, &self.blocks[at / PhotonBlock::WIDTH], ask, nearest);
            at += count;
        }
    }
}

#[inline(always)]
fn cell_of(position: [f32; 3], scale: f32) -> [i32; 3] {
    let mut cell = [0; 3];
    let mut axis = 0;
    while axis < 3 {
        let at = (position[axis] * scale).clamp(-EDGE, EDGE);
        let whole = at as i32;
        cell[axis] = whole - i32::from((whole as f32) > at);
        axis += 1;
    }
    cell
}

#[inline(always)]
fn hash(cell: [i32; 3]) -> usize {
    let mixed = (cell[0] as u32).wrapping_mul(0x8da6_b343)
        ^ (cell[1] as u32).wrapping_mul(0xd816_3841)
        ^ (cell[2] as u32).wrapping_mul(0xcb1a_b31f);
    (mixed ^ mixed >> 15) as usize
}
