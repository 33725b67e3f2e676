//! Samples of a light that follow what a cell knows of it.

use super::super::{Facing, Fan, Open, ShadingPoint};
use crate::light::{AreaLight, Shape};
use occlude_kernel::Simd;
use occlude_kernel::lanes::Task;
use occlude_kernel::occlusion_map::{BIN_EDGE, BINS, Drawn, MapCell};

/// Corners of the bins of a light.
const CORNER_EDGE: usize = BIN_EDGE + 1;

/// What the corners of the bins would send to a point if they were the whole light.
#[inline(always)]
fn corners(area: &AreaLight, point: &ShadingPoint) -> [f32; CORNER_EDGE * CORNER_EDGE] {
    let facing = Facing::new(area, point, 1.0);
    let whole = area.shape == Shape::Parallelogram;
    let mut grid = [0.0; CORNER_EDGE * CORNER_EDGE];
    let mut column = 0;
    while column < CORNER_EDGE {
        let s = column as f32 / BIN_EDGE as f32;
        let (start, step) = if whole {
            (area.corner + area.u * s, area.v)
        } else {
            let root = s.sqrt();
            (area.corner + area.u * (1.0 - root), area.v * root)
        };
        let (from, step) = (start - point.x, step * (1.0 / BIN_EDGE as f32));
        // As many as vectors hold, though the last ones are not wanted.
        let mut weights = [0.0; 16];
        let mut row = 0;
        while row < weights.len() {
            weights[row] = facing.weight(from + step * row as f32);
            row += 1;
        }
        row = 0;
        while row < CORNER_EDGE {
            grid[row * CORNER_EDGE + column] = weights[row];
            row += 1;
        }
        column += 1;
    }
    grid
}

/// What is thought of the bins of a light, and samples that follow that.
pub(super) trait Thought {
    /// The sample for a point of the unit square.
    fn draw(&self, at: [f32; 2]) -> Drawn;
    /// The part of a bin that is thought to be visible.
    fn guess(&self, bin: usize) -> f32;
    /// The mean of these.
    fn mean(&self) -> f32;
}

impl Thought for MapCell {
    #[inline(always)]
    fn draw(&self, at: [f32; 2]) -> Drawn {
        MapCell::draw(self, at)
    }

    #[inline(always)]
    fn guess(&self, bin: usize) -> f32 {
        self.odds(bin).guess()
    }

    #[inline(always)]
    fn mean(&self) -> f32 {
        MapCell::mean(self)
    }
}

/// Bins in doubt, which get more samples, and others, which get half of the usual number.
pub(super) struct Bins {
    /// Where the columns end, and the rows of each.
    columns: [f32; BIN_EDGE],
    rows: [[f32; BIN_EDGE]; BIN_EDGE],
    /// The density of sure and of doubtful bins.
    densities: [f32; 2],
    doubt: u64,
    guesses: [f32; BINS],
    mean: f32,
}

/// What part of the usual samples bins get that are sure.
const SURE: f32 = 0.5;

impl Bins {
    /// With the bins in doubt, those that are free, and the part that is thought to be visible of those in doubt. Some
    /// must be in doubt.
    #[inline]
    pub(super) fn new([doubt, free]: [u64; 2], part: f32) -> Self {
        let doubtful = doubt.count_ones() as f32;
        let sure = BINS as f32 - doubtful;
        let densities = [SURE, (BINS as f32 - SURE * sure) / doubtful.max(1.0)];
        let mut bins = Self {
            columns: [1.0; BIN_EDGE],
            rows: [[1.0; BIN_EDGE]; BIN_EDGE],
            densities,
            doubt,
            guesses: [0.0; BINS],
            mean: (free.count_ones() as f32 + doubtful * part) / BINS as f32,
        };
        let mut end = 0.0;
        for column in 0..BIN_EDGE {
            let mut sum = 0.0;
            for row in 0..BIN_EDGE {
                sum += densities[(doubt >> (row * BIN_EDGE + column) & 1) as usize];
                bins.rows[column][row] = sum;
            }
            let one = 1.0 / sum;
            bins.rows[column].iter_mut().for_each(|end| *end *= one);
            end += sum / BINS as f32;
            bins.columns[column] = end;
        }
        for (bin, guess) in bins.guesses.iter_mut().enumerate() {
            let bit = |mask: u64| mask >> bin & 1 != 0;
            *guess = if bit(doubt) { part } else { f32::from(u8::from(bit(free))) };
        }
        bins
    }
}

/// Which of the intervals with these ends, and where in it.
#[inline(always)]
fn interval(ends: &[f32; BIN_EDGE], at: f32) -> (usize, f32) {
    let (mut index, mut start, mut end) = (0, 0.0, ends[0]);
    let mut k = 0;
    while k < BIN_EDGE - 1 {
        if ends[k] <= at {
            (index, start, end) = (k + 1, ends[k], ends[k + 1]);
        }
        k += 1;
    }
    (index, ((at - start) / (end - start)).clamp(0.0, BELOW_ONE))
}

const BELOW_ONE: f32 = 1.0 - f32::EPSILON / 2.0;

impl Thought for Bins {
    #[inline(always)]
    fn draw(&self, [s, t]: [f32; 2]) -> Drawn {
        let (column, x) = interval(&self.columns, s);
        let (row, y) = interval(&self.rows[column], t);
        let bin = row * BIN_EDGE + column;
        let edge = 1.0 / BIN_EDGE as f32;
        // Rounding must not carry a sample to the next bin, which has another density.
        let within =
            |bin: usize, at: f32| ((bin as f32 + at) * edge).min((bin + 1) as f32 * edge * BELOW_ONE);
        Drawn {
            at: [within(column, x), within(row, y)],
            bin: bin as u8,
            density: self.densities[(self.doubt >> bin & 1) as usize],
        }
    }

    #[inline(always)]
    fn guess(&self, bin: usize) -> f32 {
        self.guesses[bin & (BINS - 1)]
    }

    #[inline(always)]
    fn mean(&self) -> f32 {
        self.mean
    }
}

/// Samples of a light that follow what is thought of it.
pub(super) struct Draws<'a, T> {
    pub(super) cell: &'a T,
    pub(super) fan: &'a mut Fan,
    /// Whether to look at what the corners of the bins would send; or else all send the same.
    pub(super) closely: bool,
    /// What all of the light would send.
    pub(super) whole: f32,
    pub(super) area: &'a AreaLight,
    pub(super) point: &'a ShadingPoint,
    pub(super) square: &'a mut [[f32; 2]],
    pub(super) each: f32,
    pub(super) clearance: f32,
}

impl<T: Thought> Task for Draws<'_, T> {
    /// What is known of the whole light, and what the samples have of it.
    type Output = [f32; 2];

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [f32; 2] {
        let Self { cell, fan, closely, whole, area, point, square, each, clearance } = self;
        let count = square.len();
        let mut i = 0;
        while i < count {
            let drawn = cell.draw(square[i]);
            square[i] = drawn.at;
            fan.densities[i] = drawn.density;
            i += 1;
        }
        Open { fan: &mut *fan, area, point, square: &*square, each, clearance }.run(simd);
        let (weights, bins, densities) =
            (&mut fan.weights[..count], &fan.bins[..count], &fan.densities[..count]);
        let (mut known, mut had) = (0.0, 0.0);
        if closely {
            let grid = corners(area, point);
            let mut bin = 0;
            while bin < BINS {
                let at = bin / BIN_EDGE * CORNER_EDGE + bin % BIN_EDGE;
                let four = grid[at] + grid[at + 1] + grid[at + CORNER_EDGE] + grid[at + CORNER_EDGE + 1];
                known += cell.guess(bin) * four;
                bin += 1;
            }
            known *= 0.25 / BINS as f32;
            i = 0;
            while i < count {
                let bin = usize::from(bins[i]) & (BINS - 1);
                let (row, column) = (bin / BIN_EDGE, bin % BIN_EDGE);
                let at = row * CORNER_EDGE + column;
                let x = square[i][0] * BIN_EDGE as f32 - column as f32;
                let y = square[i][1] * BIN_EDGE as f32 - row as f32;
                let above = grid[at] + (grid[at + 1] - grid[at]) * x;
                let below =
                    grid[at + CORNER_EDGE] + (grid[at + CORNER_EDGE + 1] - grid[at + CORNER_EDGE]) * x;
                let sends = above + (below - above) * y;
                let one = 1.0 / densities[i];
                had += cell.guess(bin) * sends * one;
                weights[i] *= one;
                i += 1;
            }
            had *= each;
        } else {
            known = cell.mean() * whole;
            i = 0;
            while i < count {
                let one = 1.0 / densities[i];
                had += cell.guess(usize::from(bins[i]) & (BINS - 1)) * one;
                weights[i] *= one;
                i += 1;
            }
            had *= each * whole;
        }
        [known, had]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn over_all_places_bins_have_their_area() {
        for doubt in
            [1, 0x8000_0000_0000_0000, 0x0000_3c3c_3c00_0000, 0x0101_0101_0101_0101, u64::MAX, 0x1234_5678]
        {
            let bins = Bins::new([doubt, !doubt & 0xffff], 0.5);
            let mean = (0..BINS).map(|bin| bins.guess(bin)).sum::<f32>() / BINS as f32;
            assert!((mean - bins.mean()).abs() < 1e-6);
            let edge = 1024;
            let mut area = [0.0f64; BINS];
            for k in 0..edge * edge {
                let at = |k: usize| (k as f32 + 0.5) / edge as f32;
                let drawn = bins.draw([at(k % edge), at(k / edge)]);
                assert_eq!(occlude_kernel::occlusion_map::bin(drawn.at), usize::from(drawn.bin), "{drawn:?}");
                area[usize::from(drawn.bin)] += 1.0 / f64::from(drawn.density) / (edge * edge) as f64;
            }
            for (bin, area) in area.iter().enumerate() {
                assert!((area * BINS as f64 - 1.0).abs() < 0.08, "{doubt:x}, bin {bin}: {area}");
            }
            assert!((area.iter().sum::<f64>() - 1.0).abs() < 1e-3);
            for at in [[0.0, BELOW_ONE], [BELOW_ONE, 0.0], [BELOW_ONE; 2]] {
                let drawn = bins.draw(at);
                assert_eq!(occlude_kernel::occlusion_map::bin(drawn.at), usize::from(drawn.bin), "{drawn:?}");
            }
        }
    }
}
