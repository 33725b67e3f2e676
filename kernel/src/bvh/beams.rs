//! Rays of neighbouring points, put together by where on the light they end.
//!
//! The rays of a point fan out over all of its light. Where much is in the way, few of them come to the same nodes, and
//! none shares what a visit costs. Rays from all of a tile to one part of the light do stay together, if the light is
//! the larger of the two. Sorting takes as long as a few steps down the tree, so rays are sorted where the first of the
//! tile were seen to take many.

use super::Targets;
use super::grid::{CELLS, Grid, SIDE, cell};
use super::pyramid::MOST;
use super::shaft::{Shaft, Turned};
use super::stream::Stream;
use crate::lanes::Simd;

/// Rows of rays that are sorted together, at most.
pub(super) const ROWS: usize = 64;

/// Sorting pays from so many visits of nodes and blocks on, for a hundred rays, unless this part of the rays, in percent,
/// comes together on average.
const DENSE: u64 = 12;
const TOGETHER: u64 = 50;

/// The verdict is of as many rays at least, and of fewer where parts of the light are hidden: the other rays of the same
/// point go elsewhere.
const RAYS: u32 = 32;
const FEW_RAYS: u32 = 6;

/// The cells along a Hilbert curve: those that follow each other are neighbours, and so 64 rays that do are in a compact
/// part of the light, however many rays there are.
const CURVE: [u8; CELLS] = curve();

const fn curve() -> [u8; CELLS] {
    let mut cells = [0; CELLS];
    let mut k = 0;
    while k < CELLS {
        // From the finest square on, each turned as its place in the next larger one asks.
        let (mut x, mut y, mut rest, mut side) = (0, 0, k, 1);
        while side < SIDE {
            let right = (rest / 2) & 1;
            let up = (rest ^ right) & 1;
            if up == 0 {
                if right == 1 {
                    (x, y) = (side - 1 - x, side - 1 - y);
                }
                (x, y) = (y, x);
            }
            (x, y) = (x + side * right, y + side * up);
            rest /= 4;
            side *= 2;
        }
        cells[k] = (y * SIDE + x) as u8;
        k += 1;
    }
    cells
}

/// From a point to some of up to 64 targets.
#[derive(Clone, Copy)]
struct Row {
    x: [f32; 3],
    first: u32,
    ask: u64,
}

/// Rays by row, and the cell of the light in which each ends.
pub(super) struct Beams {
    rows: [Row; ROWS],
    count: usize,
    /// The cells, as the last bits of numbers.
    cells: [[f32; MOST]; ROWS],
    /// Rays in each cell.
    sizes: [u16; CELLS],
    /// Rays in the order of their cells: 64 times the row, and the place in it.
    order: [u16; ROWS * MOST],
    pub(super) grid: Grid,
    /// Cells of the light that are known to be hidden from all of the tile.
    pub(super) hidden: u64,
    /// Rows that are best sorted together; 0 where the tile is not much smaller than the light.
    pub(super) group: usize,
    verdict: Verdict,
}

/// Does sorting pay?
#[derive(Clone, Copy, PartialEq)]
enum Verdict {
    /// Nothing was traced yet. In the tile before, it did or did not.
    Open(bool),
    Is(bool),
}

impl Beams {
    pub(super) const NOTHING: Self = Self {
        rows: [Row { x: [0.0; 3], first: 0, ask: 0 }; ROWS],
        count: 0,
        cells: [[0.0; MOST]; ROWS],
        sizes: [0; CELLS],
        order: [0; ROWS * MOST],
        grid: Grid::NOTHING,
        hidden: 0,
        group: 0,
        verdict: Verdict::Open(false),
    };

    /// For another tile, with so many targets a point.
    #[inline(always)]
    pub(super) fn aim(&mut self, shaft: &Shaft, each: usize) {
        self.clear();
        let (points, targets) = (&shaft.points, &shaft.targets);
        self.grid = Grid::new(shaft);
        self.hidden = 0;
        // In a tile of 64 points, each with a row of `each` targets on a light that is `wide` times as long as the tile, 64
        // rays of so many rows are as wide where they begin as where they end: rows^2 = 64^2 wide^2 / each. As most
        // that blocks is nearer to the points than to the light, a quarter of them does better.
        let rows_squared = 256.0 * extent_squared(targets) / (extent_squared(points) * each as f32);
        self.group = match rows_squared {
            s if s >= 1024.0 => ROWS,
            s if s >= 64.0 => 16,
            s if s >= 16.0 => 4,
            _ => 0,
        };
        if let Verdict::Is(pays) = self.verdict {
            self.verdict = Verdict::Open(pays);
        }
    }

    /// For a tile whose rays are not sorted.
    #[inline(always)]
    pub(super) fn skip(&mut self) {
        self.clear();
        (self.group, self.hidden) = (0, 0);
    }

    /// Forgets rays that a query left which did not come to its end.
    #[inline(always)]
    fn clear(&mut self) {
        self.count = 0;
        self.sizes = [0; CELLS];
    }

    /// Notes what it took to trace rays that were not sorted.
    #[inline(always)]
    pub(super) fn judge(&mut self, stream: &Stream, rays: u32) {
        let enough = if self.hidden == 0 { RAYS } else { FEW_RAYS };
        if matches!(self.verdict, Verdict::Open(_)) && rays >= enough {
            let (Stream { visits, comers, .. }, rays) = (stream, u64::from(rays));
            let together = comers * 100 >= TOGETHER * visits * rays;
            self.verdict = Verdict::Is(visits * 100 >= DENSE * rays && !together);
        }
    }

    /// Are rays to be sorted?
    #[inline(always)]
    pub(super) fn wanted(&self) -> bool {
        self.group > 0 && self.verdict == Verdict::Is(true)
    }

    /// Would parts of the tile see as much as all of it? So it is where parts of the light are hidden from all, and where
    /// the light is so much larger than the tile that sorting paid in the tile before.
    #[inline(always)]
    pub(super) fn instead_of_parts(&self) -> bool {
        self.hidden != 0 || (self.group == ROWS && self.verdict == Verdict::Open(true))
    }

    #[inline(always)]
    pub(super) fn is_full(&self) -> bool {
        self.count == ROWS
    }

    #[inline(always)]
    pub(super) fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Which of up to 64 targets from the `first`th on lie in cells that are known to be hidden?
    #[inline(always)]
    pub(super) fn hides<S: Simd>(
        &mut self,
        simd: S,
        targets: &Targets<'_>,
        first: usize,
        count: usize,
    ) -> u64 {
        // The row that is next put by has no other use yet.
        let cells = &mut self.cells[self.count & (ROWS - 1)];
        self.grid.find(simd, targets, first, count, cells);
        let mut word = 0;
        let mut i = 0;
        while i < MOST {
            word |= (self.hidden >> cell(cells[i]) & 1) << i;
            i += 1;
        }
        word & (u64::MAX >> (MOST - count))
    }

    /// Takes in the rays from a point to those of `ask` of the targets from the `first`th on. There must be room.
    #[inline(always)]
    pub(super) fn put<S: Simd>(
        &mut self,
        simd: S,
        x: [f32; 3],
        targets: &Targets<'_>,
        first: usize,
        ask: u64,
    ) {
        let row = self.count & (ROWS - 1);
        self.rows[row] = Row { x, first: first as u32, ask };
        self.count += 1;
        let cells = &mut self.cells[row];
        self.grid.find(simd, targets, first, MOST - ask.leading_zeros() as usize, cells);
        let mut rest = ask;
        while rest != 0 {
            let i = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            self.sizes[cell(cells[i])] += 1;
        }
    }

    /// Sorts all rays by cell, and forgets them but for their order. Gives how many there are.
    #[inline(always)]
    pub(super) fn sort(&mut self) -> usize {
        let mut next = [0; CELLS];
        let (mut k, mut sum) = (0, 0);
        while k < CELLS {
            let cell = CURVE[k] as usize & (CELLS - 1);
            next[cell] = sum;
            sum += self.sizes[cell];
            self.sizes[cell] = 0;
            k += 1;
        }
        let mut row = 0;
        while row < self.count.min(ROWS) {
            let cells = &self.cells[row];
            let mut rest = self.rows[row].ask;
            while rest != 0 {
                let i = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                let next = &mut next[cell(cells[i])];
                self.order[*next as usize & (ROWS * MOST - 1)] = (row * MOST + i) as u16;
                *next += 1;
            }
            row += 1;
        }
        self.count = 0;
        sum as usize
    }

    /// A ray by its place in the order: where it begins, and its target.
    #[inline(always)]
    pub(super) fn ray(&self, k: usize) -> ([f32; 3], usize) {
        let at = self.order[k & (ROWS * MOST - 1)] as usize;
        let row = &self.rows[(at / MOST) & (ROWS - 1)];
        (row.x, row.first as usize + at % MOST)
    }
}

#[inline(always)]
fn extent_squared(turned: &Turned) -> f32 {
    let [a, b, c] = turned.axes;
    (a.length_squared() + b.length_squared() + c.length_squared()).max(1e-30)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::{Native, Scalar, UNIT};
    use glam::Vec3;

    #[test]
    fn the_curve_goes_from_neighbour_to_neighbour_through_all_cells() {
        let mut seen = [false; CELLS];
        for &cell in &CURVE {
            assert!(!seen[cell as usize]);
            seen[cell as usize] = true;
        }
        let at = |cell: u8| [i32::from(cell) % SIDE as i32, i32::from(cell) / SIDE as i32];
        for pair in CURVE.windows(2) {
            let ([x, y], [u, v]) = (at(pair[0]), at(pair[1]));
            assert_eq!((x - u).abs() + (y - v).abs(), 1);
        }
    }

    /// Targets over a unit square, the last some that are nowhere.
    fn targets() -> [[f32; 64]; 3] {
        let mut at = [[0.0; 64]; 3];
        let [x, y, _] = &mut at;
        for (i, (x, y)) in x.iter_mut().zip(y).enumerate() {
            (*x, *y) = ((i * 37 % 64) as f32 / 64.0 - 0.5, (i * 23 % 64) as f32 / 64.0 - 0.5);
        }
        (at[0][61], at[1][62], at[0][63]) = (f32::NAN, f32::INFINITY, -1e38);
        at
    }

    fn sorted<S: Simd>(simd: S) -> [(u32, u32); 2 * 64 - 3] {
        let [x, y, z] = targets();
        let targets = Targets::new(&x, &y, &z).unwrap();
        let grid = Grid { middle: Vec3::ZERO, axes: [Vec3::X * 8.0, Vec3::Y * 8.0], ..Grid::NOTHING };
        let mut beams = Beams { grid, ..Beams::NOTHING };
        // Of each point two rows, and not all of the targets.
        for row in 0..2 {
            beams.put(simd, [row as f32, 0.0, 0.0], &targets, 0, (u64::from(u32::MAX) << 3) | (1 << 2));
            beams.put(simd, [row as f32, 1.0, 0.0], &targets, 36, (1 << 28) - 1 - u64::from(row == 1));
        }
        let count = beams.sort();
        assert!(beams.is_empty());
        let mut rays = [(0, 0); 2 * 64 - 3];
        let mut left = 0;
        for k in 0..count {
            let ([x, _, _], target) = beams.ray(k);
            rays[left] = (x as u32, target as u32);
            left += 1;
        }
        assert_eq!(left, 2 * (33 + 28) - 1);
        rays
    }

    #[test]
    fn every_ray_comes_once_and_cells_follow_each_other() {
        let rays = sorted(Native);
        let [x, y, _] = targets();
        let place = |target: u32| {
            let at = |v: f32| ((v * 8.0 + 3.5).clamp(0.0, 7.0) + UNIT) as usize % 8;
            let cell = at(y[target as usize]) * 8 + at(x[target as usize]);
            CURVE.iter().position(|&c| c as usize == cell)
        };
        let mut seen = [[0; 64]; 2];
        let mut last = None;
        for (row, target) in rays[..121].iter().copied() {
            seen[row as usize][target as usize] += 1;
            if target < 61 {
                let next = place(target);
                assert!(last <= next, "{last:?} {next:?}");
                last = next;
            }
        }
        for (row, seen) in seen.iter().enumerate() {
            for (target, &times) in seen.iter().enumerate() {
                let asked = (2..=34).contains(&target) || target >= 36 + row;
                assert_eq!(times, u32::from(asked), "{row} {target}");
            }
        }
        // Families may differ about the cells of targets that are no numbers.
        let finite = |ray: &(u32, u32)| ray.1 < 61;
        assert!(sorted(Scalar).into_iter().filter(finite).eq(rays.into_iter().filter(finite)));
    }
}
