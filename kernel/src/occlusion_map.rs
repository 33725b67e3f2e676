//! The occlusion map: what is known of the visibility between places and lights.
//!
//! Space is cut into cells. For each cell, each way a surface may face there, and each light, the map knows one of
//! three things:
//!
//! - *lit*: a shaft around all of the cell's points and the light met nothing. Exact: no ray is needed;
//! - *odds*: the light is cut into bins, and each has u, the part of the segments that were free so far, and a class of
//!   doubt, which says how far V is from u there;
//! - nothing, or nothing that helps: segments are asked as if there were no map.
//!
//! With odds, what arrives from the light is
//!
//! ```text
//!     integral of V w  =  integral of u g  +  mean over samples y of  (V w - u g)(y)/p(y),
//! ```
//!
//! where w is what each point of the light would send, and g something near it whose integral is known. The samples have
//! the density p, which follows the doubt: few where V is as good as known, many where shadows begin and end. That
//! is right on average for any u, any g and any p above 0 that do not depend on the samples at hand; it is
//! [`Residual`](crate::Decomposition::Residual) with nothing in its first group, the chance q spread over the light. Where a bin is all dark
//! or all free, as most are away from the borders of shadows, what is left to sample is next to nothing.
//!
//! How far the doubts are right is itself measured: [`Doubts`] sums `(V - u)²` for each class, and [`Doubts::rates`]
//! turns that into densities.
//!
//! Nothing here is written while it is read, and no number is drawn: the caller collects what rays saw in [`Tally`]s,
//! and makes new odds of them ([`MapCell::learn`]) between passes.

use crate::lanes::UNIT;
use bytemuck::{Pod, Zeroable};
use core::fmt;
use glam::Vec3;
use wide::{f32x8, i32x8};

/// Bins along each edge of a light.
pub const BIN_EDGE: usize = 8;

/// Bins of a light.
pub const BINS: usize = BIN_EDGE * BIN_EDGE;

/// No part of a light gets fewer samples than one in this many of those it would get without a map, so that no weight
/// is more than this many times what it would be.
pub const LEAST_CHANCE: u32 = 32;

/// The bin of a light's point by its coordinates on the unit square, as light samples have them.
#[inline]
pub fn bin([s, t]: [f32; 2]) -> usize {
    // No conversion to whole numbers: of those that saturate the compiler makes no vectors.
    let at = |x: f32| {
        let within = (x * BIN_EDGE as f32).clamp(0.0, BIN_EDGE as f32 - 1.0);
        let near = (within + UNIT) - UNIT;
        if near > within { near - 1.0 } else { near }
    };
    (at(t) * BIN_EDGE as f32 + at(s) + UNIT).to_bits() as usize & (BINS - 1)
}

/// Which cell: a cube of the grid of its size, the side that surfaces face there, and the light.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Pod, Zeroable)]
#[repr(transparent)]
pub struct CellKey(u64);

impl CellKey {
    /// Lights that a key can name.
    pub const LIGHTS: u32 = 1 << 12;

    /// The cell of a point: cubes have the edge `2^level`. `None` where that cannot be named: `level` is beyond -32 and
    /// 31, the point more than 8191 cubes away from the origin along an axis, or the light beyond [`CellKey::LIGHTS`].
    #[inline]
    pub fn new(x: impl Into<[f32; 3]>, normal: impl Into<[f32; 3]>, level: i32, light: u32) -> Option<Self> {
        if !(-32..32).contains(&level) || light >= Self::LIGHTS {
            return None;
        }
        let scale = f32::from_bits(((127 - level) as u32) << 23);
        let mut key = u64::from(light) << 6 | (level + 32) as u64;
        let normal = normal.into();
        let mut axis = 0;
        for other in 1..3 {
            if normal[other].abs() > normal[axis].abs() {
                axis = other;
            }
        }
        key = key << 3 | (2 * axis as u64 + u64::from(normal[axis] < 0.0));
        for at in x.into() {
            let cube = libm::floorf(at * scale);
            if !(-8192.0..8192.0).contains(&cube) {
                return None;
            }
            key = key << 14 | (cube as i32 + 8192) as u64;
        }
        Some(Self(key))
    }

    /// The edge of cubes that are `size` long or up to twice as long, as a power of 2; for [`CellKey::new`].
    #[inline]
    pub fn level(size: f32) -> i32 {
        if !(size > 0.0 && size.is_finite()) {
            return i32::MAX;
        }
        let bits = size.to_bits();
        (bits >> 23) as i32 - 127 + i32::from(bits & 0x7f_ffff != 0)
    }

    /// The same cell for another light. `None` where a key cannot name it.
    #[inline]
    pub fn with_light(self, light: u32) -> Option<Self> {
        (light < Self::LIGHTS).then_some(Self(self.0 & ((1 << 51) - 1) | u64::from(light) << 51))
    }

    /// As a number, and back. Every number is the key of some cell.
    #[inline]
    pub fn bits(self) -> u64 {
        self.0
    }

    /// The key of a number that [`CellKey::bits`] gave.
    #[inline]
    pub fn from_bits(bits: u64) -> Self {
        Self(bits)
    }

    /// The light.
    #[inline]
    pub fn light(self) -> u32 {
        (self.0 >> 51) as u32
    }

    /// Light and level are in the upper half, which a product alone would not carry down to the index.
    #[inline]
    fn hash(self) -> usize {
        let folded = self.0 ^ self.0 >> 32;
        let mixed = folded.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (mixed ^ mixed >> 32) as usize
    }
}

/// What rays between a cell and a bin of its light have seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Rays.
    pub asked: u32,
    /// Of these, those that nothing blocked.
    pub free: u32,
}

/// One cell of the map.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct MapCell {
    key: CellKey,
    /// About where its surface faces; a unit vector.
    normal: [f32; 3],
    /// The bounds of its points in the frame of the normal.
    lower: [f32; 3],
    upper: [f32; 3],
    state: u32,
    /// Are all bins alike?
    flat: u32,
    /// What part of the usual number of samples it is worth.
    part: f32,
    /// The variance that these leave, and what the usual samples would, in units of a sample's.
    error: f32,
    usual: f32,
    /// The mean of u, in units of 1/255.
    mean: f32,
    spare: u32,
    /// How many of 64 equal parts of the unit interval belong to the columns of bins up to each one.
    columns: [u8; BIN_EDGE],
    /// And within each column, to the rows up to each one.
    rows: [[u8; BIN_EDGE]; BIN_EDGE],
    /// u, in units of 1/255.
    u: [u8; BINS],
    /// Classes of doubt.
    class: [u8; BINS],
}

/// The same for all.
const EVEN: [u8; BIN_EDGE] = [8, 16, 24, 32, 40, 48, 56, 64];

const NOTHING: u32 = 0;
const ODDS: u32 = 1;
const LIT: u32 = 2;
const ALL: u32 = 3;

/// What a cell says of the segments to its light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Known {
    /// Nothing: ask, and tell what they saw.
    Nothing,
    /// That doubt is everywhere: asking as if there were no map is as good. No need to tell what they saw.
    All,
    /// All of them are free.
    Lit,
    /// [`MapCell::odds`] and [`MapCell::draw`].
    Odds,
}

/// A sample of the light that follows a cell's density.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drawn {
    /// Where, on the unit square.
    pub at: [f32; 2],
    /// In which bin.
    pub bin: u8,
    /// How many times as likely it is as with an even density.
    pub density: f32,
}

/// Parts that the unit interval is cut into, to share among columns and among rows.
const PARTS: usize = 64;

/// Each column has this many of them at least, and each row of a column one: a density of `1 / LEAST_CHANCE`.
const LEAST_PARTS: usize = 2;
const _: () = assert!(PARTS * PARTS / (BINS * LEAST_PARTS) == LEAST_CHANCE as usize);

/// Shares the parts among columns in proportion to their weights, which are above 0.
fn share(weights: &[f32; BIN_EDGE]) -> [u8; BIN_EDGE] {
    let rest = (PARTS - LEAST_PARTS * BIN_EDGE) as f32;
    let each = rest / weights.iter().sum::<f32>();
    let mut ends = [0; BIN_EDGE];
    let mut sum = 0.0;
    for (i, end) in ends.iter_mut().enumerate() {
        sum += weights[i];
        *end = (LEAST_PARTS * (i + 1)) as u8 + ((sum * each).min(rest) + 0.5) as u8;
    }
    ends[BIN_EDGE - 1] = PARTS as u8;
    ends
}

/// Which of the shares a number in [0, 1) falls into, where in it, and how many parts it has.
#[inline(always)]
fn place(ends: [u8; BIN_EDGE], at: f32) -> (usize, f32, f32) {
    let at = at * PARTS as f32;
    let part = (at as u64).min(PARTS as u64 - 1);
    let ends = u64::from_le_bytes(ends);
    // A byte's highest bit stays where its end is not beyond the part.
    let ones = 0x0101_0101_0101_0101;
    let before = ((part | 0x80) * ones - ends) & (0x80 * ones);
    let index = before.count_ones() as usize & (BIN_EDGE - 1);
    let start = ((ends << 8) >> (8 * index)) as u8;
    let width = f32::from(((ends >> (8 * index)) as u8).wrapping_sub(start));
    (index, (at - f32::from(start)) / width, width)
}

impl MapCell {
    /// A cell of which nothing is known, for surfaces that face about along `normal`, and no point of it.
    pub fn new(key: CellKey, normal: impl Into<[f32; 3]>) -> Self {
        let normal = Vec3::from(normal.into()).normalize_or(Vec3::Z).to_array();
        Self {
            key,
            normal,
            lower: [f32::INFINITY; 3],
            upper: [f32::NEG_INFINITY; 3],
            state: NOTHING,
            flat: 1,
            part: 1.0,
            error: 1.0,
            usual: 1.0,
            mean: 0.0,
            spare: 0,
            columns: EVEN,
            rows: [EVEN; BIN_EDGE],
            u: [0; BINS],
            class: [0; BINS],
        }
    }

    /// Which it is.
    #[inline]
    pub fn key(&self) -> CellKey {
        self.key
    }

    /// About where its surface faces, and the bounds of its points in the frame of that; to be kept, for
    /// [`MapCell::restore`].
    pub fn bounds(&self) -> [[f32; 3]; 3] {
        [self.normal, self.lower, self.upper]
    }

    /// A cell of which nothing is known, with bounds that [`MapCell::bounds`] gave. `None` if no cell can have them.
    pub fn restore(key: CellKey, [normal, lower, upper]: [[f32; 3]; 3]) -> Option<Self> {
        let unit = (Vec3::from(normal).length_squared() - 1.0).abs() < 1e-3;
        let finite = lower.iter().chain(&upper).all(|at| at.is_finite());
        (unit && finite).then(|| Self { lower, upper, normal, ..Self::new(key, normal) })
    }

    /// A position in the frame of the normal.
    #[inline]
    fn turned(&self, x: Vec3) -> [f32; 3] {
        let normal = Vec3::from(self.normal);
        let (u, v) = normal.any_orthonormal_pair();
        [u.dot(x), v.dot(x), normal.dot(x)]
    }

    /// Takes a point in: where its segments begin. A cell that grows is not lit any more.
    pub fn add(&mut self, x: impl Into<[f32; 3]>) {
        let at = self.turned(x.into().into());
        for (axis, &at) in at.iter().enumerate() {
            self.lower[axis] = self.lower[axis].min(at);
            self.upper[axis] = self.upper[axis].max(at);
        }
        if self.state == LIT {
            self.state = NOTHING;
        }
    }

    /// Widens its bounds: to all sides along the surface, and before and behind it.
    pub fn widen(&mut self, along: f32, across: f32) {
        for (axis, by) in [along, along, across].into_iter().enumerate() {
            self.lower[axis] -= by;
            self.upper[axis] += by;
        }
    }

    /// Does the point lie within its bounds?
    #[inline]
    pub fn covers(&self, x: impl Into<[f32; 3]>) -> bool {
        let at = self.turned(x.into().into());
        (0..3).all(|axis| self.lower[axis] <= at[axis] && at[axis] <= self.upper[axis])
    }

    /// The corners of its bounds, in the order of [`Bvh::nothing_between`](crate::Bvh::nothing_between).
    pub fn corners(&self) -> [[f32; 3]; 8] {
        let normal = Vec3::from(self.normal);
        let (u, v) = normal.any_orthonormal_pair();
        let mut corners = [[0.0; 3]; 8];
        for (i, corner) in corners.iter_mut().enumerate() {
            let at = |axis: usize| if i >> axis & 1 == 0 { self.lower[axis] } else { self.upper[axis] };
            *corner = (u * at(0) + v * at(1) + normal * at(2)).to_array();
        }
        corners
    }

    /// Says that every segment from within its bounds is free: proven, and not for all one has seen. What is thought of
    /// other segments is that they will be.
    pub fn set_lit(&mut self) {
        self.set_odds(&[1.0; BINS], &Rates::each(LIT_PART));
        self.state = LIT;
    }

    /// Knows nothing any more but its bounds.
    pub fn forget(&mut self) {
        *self = Self { lower: self.lower, upper: self.upper, ..Self::new(self.key, self.normal) };
    }

    /// Says that the map does not help here.
    pub fn set_all(&mut self) {
        self.state = ALL;
    }

    /// Is it proven to be lit?
    #[inline]
    pub fn is_lit(&self) -> bool {
        self.state == LIT
    }

    /// Has it learned anything?
    #[inline]
    pub fn is_known(&self) -> bool {
        self.state != NOTHING
    }

    /// What it says of segments that begin at x. What is proven holds within its bounds only.
    #[inline]
    pub fn known(&self, x: impl Into<[f32; 3]>) -> Known {
        match self.state {
            LIT if self.covers(x) => Known::Lit,
            LIT | ODDS => Known::Odds,
            ALL => Known::All,
            _ => Known::Nothing,
        }
    }

    /// What is thought of a bin. Panics if there is no such bin.
    #[inline(always)]
    pub fn odds(&self, bin: usize) -> Odds {
        Odds { u: self.u[bin], class: self.class[bin] }
    }

    /// Are all bins alike? Then the density is even.
    #[inline(always)]
    pub fn is_flat(&self) -> bool {
        self.flat == 1
    }

    /// The mean of u over the light.
    #[inline(always)]
    pub fn mean(&self) -> f32 {
        self.mean * (1.0 / 255.0)
    }

    /// What part of the usual number of samples it is worth, at most 1. Together with the density no bin has less than
    /// `1 / LEAST_CHANCE` of the usual samples.
    #[inline(always)]
    pub fn part(&self) -> f32 {
        self.part
    }

    /// The variance that its samples are thought to leave, and the usual ones, in units of a sample's.
    #[inline(always)]
    pub fn errors(&self) -> [f32; 2] {
        [self.error, self.usual]
    }

    /// The sample for a point of the unit square. For even points its density is [`Drawn::density`].
    #[inline(always)]
    pub fn draw(&self, [s, t]: [f32; 2]) -> Drawn {
        let (column, x, parts) = place(self.columns, s);
        let (row, y, others) = place(self.rows[column & (BIN_EDGE - 1)], t);
        let edge = 1.0 / BIN_EDGE as f32;
        Drawn {
            at: [(column as f32 + x) * edge, (row as f32 + y) * edge],
            bin: (row * BIN_EDGE + column) as u8,
            density: parts * others * (BINS as f32 / (PARTS * PARTS) as f32),
        }
    }

    /// The part of each bin's segments that one expects to be free, by everything that rays have seen so far; `None` if
    /// that is too little.
    ///
    /// What was seen in the bins around a bin counts as one ray more, and what was seen in the whole cell as a quarter
    /// of one among these: a bin amid dark ones is thought to be dark.
    pub fn expect(tallies: &[Tally; BINS]) -> Option<[f32; BINS]> {
        // Asked and free, with a bin of nothing at both ends of each row, and a row of nothing at both ends.
        const ROW: usize = BIN_EDGE + 2;
        let mut seen = [[[0.0; ROW]; ROW]; 2];
        for (row, tallies) in tallies.chunks_exact(BIN_EDGE).enumerate() {
            for (column, tally) in tallies.iter().enumerate() {
                seen[0][row + 1][column + 1] = tally.asked as f32;
                seen[1][row + 1][column + 1] = tally.free as f32;
            }
        }
        let mut sums = [[0.0; ROW]; 2];
        for (sums, rows) in sums.iter_mut().zip(&seen) {
            rows.iter().for_each(|row| (0..ROW).for_each(|column| sums[column] += row[column]));
        }
        let [asked, free] = [sums[0].iter().sum::<f32>(), sums[1].iter().sum()];
        if asked < ENOUGH {
            return None;
        }
        let whole = (free + 0.5 * DOUBT) / (asked + DOUBT);
        let mut expected = [0.0; BINS];
        for (row, expected) in expected.chunks_exact_mut(BIN_EDGE).enumerate() {
            // Sums of threes down the columns, and then of these along the rows.
            let mut down = [[0.0; ROW]; 2];
            for (down, seen) in down.iter_mut().zip(&seen) {
                for (i, sum) in down.iter_mut().enumerate() {
                    *sum = seen[row][i] + seen[row + 1][i] + seen[row + 2][i];
                }
            }
            for (i, p) in expected.iter_mut().enumerate() {
                let near = down[0][i] + down[0][i + 1] + down[0][i + 2] + DOUBT;
                let near_free = down[1][i] + down[1][i + 1] + down[1][i + 2] + DOUBT * whole;
                *p = (seen[1][row + 1][i + 1] + near_free / near) / (seen[0][row + 1][i + 1] + 1.0);
            }
        }
        Some(expected)
    }

    /// Makes odds of what one expects, p: u is p, or 0 where p is below a half, so that dark places do not become
    /// negative; the class of doubt follows from the variance p (1 - p), and the density from the rates of the classes.
    /// Nothing to expect, and a cell knows nothing. What is lit stays so.
    pub fn learn(&mut self, expected: Option<&[f32; BINS]>, rates: &Rates) {
        if self.state == LIT {
            return;
        }
        match expected {
            None => self.state = NOTHING,
            Some(expected) => {
                self.set_odds(expected, rates);
                self.state = ODDS;
            }
        }
    }

    fn set_odds(&mut self, expected: &[f32; BINS], rates: &Rates) {
        self.class = classes(expected);
        for (u, &p) in self.u.iter_mut().zip(expected) {
            *u = if p < 0.5 { 0 } else { (p * 255.0 + 0.5).min(255.0) as i32 as u8 };
        }
        self.mean = self.u.iter().map(|&u| u32::from(u)).sum::<u32>() as f32 / BINS as f32;
        let alike = self.u == [self.u[0]; BINS] && self.class == [self.class[0]; BINS];
        self.flat = u32::from(alike);
        let plan = rates.plan(&self.class);
        let level = if plan.unsure(rates, rates.best) { plan.level } else { rates.best };
        let part = plan.mean(rates, level);
        if alike {
            let variance = rates.variance[usize::from(self.class[0]) & (CLASSES - 1)];
            (self.columns, self.rows) = (EVEN, [EVEN; BIN_EDGE]);
            self.part = part.clamp(1.0 / LEAST_CHANCE as f32, 1.0);
            self.error = variance * left(self.part, rates.spread);
            self.usual = variance * rates.spread;
            return;
        }
        // Row by row.
        let (mut wanted, mut variances) = ([[0.0; BIN_EDGE]; BIN_EDGE], [[0.0; BIN_EDGE]; BIN_EDGE]);
        for (row, classes) in self.class.chunks_exact(BIN_EDGE).enumerate() {
            for (column, &class) in classes.iter().enumerate() {
                let class = usize::from(class) & (CLASSES - 1);
                wanted[row][column] = rates.of[level][class];
                variances[row][column] = rates.variance[class];
            }
        }
        let (wanted, variances) = (wanted.map(f32x8::new), variances.map(f32x8::new));
        let columns = wanted.iter().fold(f32x8::ZERO, |sum, &row| sum + row);
        self.columns = share(columns.as_array());
        let mut widths = [0.0; BIN_EDGE];
        let mut from = 0;
        for (width, to) in widths.iter_mut().zip(self.columns) {
            *width = f32::from(to - from) * (BINS as f32 / (PARTS * PARTS) as f32);
            from = to;
        }
        // The same for the rows of each column, with one part at least for each; all columns side by side.
        let rest = f32x8::splat((PARTS - BIN_EDGE) as f32);
        let each = rest / columns;
        let (mut sum, mut above) = (f32x8::ZERO, f32x8::ZERO);
        let mut densities = [f32x8::ZERO; BIN_EDGE];
        for (row, &wanted) in wanted.iter().enumerate() {
            sum += wanted;
            let parts = ((sum * each).fast_min(rest) + 0.5).fast_trunc_int() + i32x8::splat(row as i32 + 1);
            let parts = if row + 1 < BIN_EDGE { parts } else { i32x8::splat(PARTS as i32) };
            for (rows, &end) in self.rows.iter_mut().zip(parts.as_array()) {
                rows[row] = end as u8;
            }
            let end = parts.round_float();
            densities[row] = f32x8::new(widths) * (end - above);
            above = end;
        }
        let least = densities.iter().fold(densities[0], |least, &row| least.fast_min(row));
        let least = least.to_array().into_iter().fold(f32::INFINITY, f32::min);
        self.part = part.clamp(1.0 / (LEAST_CHANCE as f32 * least), 1.0);
        let (mut error, mut usual) = (f32x8::ZERO, f32x8::ZERO);
        for (&density, &variances) in densities.iter().zip(&variances) {
            // What `left` says.
            let (rate, spread) = (density * self.part, f32x8::splat(rates.spread));
            let [many, few] = [spread / (rate * rate.sqrt()), 1.0 / rate - 1.0 + spread];
            error += variances * rate.simd_ge(1.0).select(many, few);
            usual += variances;
        }
        self.error = error.reduce_add() / BINS as f32;
        self.usual = usual.reduce_add() * rates.spread / BINS as f32;
    }
}

/// The part of the usual samples of segments that are free as far as one knows.
const LIT_PART: f32 = 0.5;

/// What samples leave of a variance, with this part of the usual number. Well spread samples find most of what differs
/// from bin to bin, and only `spread` is left; but only if there are enough to ask in every bin.
fn left(rate: f32, spread: f32) -> f32 {
    if rate >= 1.0 { spread / (rate * libm::sqrtf(rate)) } else { 1.0 / rate - 1.0 + spread }
}

/// How many rates there are to choose from.
pub const LEVELS: usize = 32;

/// What part of the usual number of samples bins get, by their class of doubt.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// For less and less doubt, so that there are more and more.
    of: [[f32; CLASSES]; LEVELS],
    /// What these leave of the variance.
    left: [[f32; CLASSES]; LEVELS],
    best: usize,
    variance: [f32; CLASSES],
    spread: f32,
}

impl Rates {
    /// The same for all: from a millionth to a million.
    pub fn each(rate: f32) -> Self {
        // Not a number is the least.
        let rate = rate.max(1e-6).clamp(1e-6, 1e6);
        let [of, left] = [rate, UNSURE as f32 * left(rate, 1.0)].map(|each| [[each; CLASSES]; LEVELS]);
        Self { of, left, best: 0, variance: [UNSURE as f32; CLASSES], spread: 1.0 }
    }

    /// Of a class, where nothing limits them.
    pub fn of(&self, class: usize) -> f32 {
        self.of[self.best][class & (CLASSES - 1)]
    }

    /// What the usual samples leave of the variance that bins have by themselves.
    pub fn spread(&self) -> f32 {
        self.spread
    }

    fn plan(&self, classes: &[u8; BINS]) -> Plan {
        let count = |class: usize| classes.iter().map(|&other| u8::from(other == class as u8)).sum();
        let members: [u8; CLASSES] = core::array::from_fn(count);
        let worst = members.iter().position(|&members| members > 0).unwrap_or(CLASSES - 1);
        let mut plan = Plan { members, level: 0, worst };
        // Rates grow from level to level.
        let mut beyond = LEVELS;
        while beyond - plan.level > 1 {
            let middle = (plan.level + beyond) / 2;
            if plan.mean(self, middle) > 1.0 { beyond = middle } else { plan.level = middle }
        }
        plan
    }

    /// Chooses the rates that make the product of work and squared error least.
    ///
    /// `unknown` points are asked as usual, and a point costs `overhead` times as much as usual before it is asked.
    pub fn choose(&mut self, demand: &Demand, unknown: f64, overhead: f64) {
        let mut least = f64::INFINITY;
        for level in 0..LEVELS {
            let (mut work, mut error) = (unknown, unknown * UNSURE * f64::from(self.spread));
            for worst in 0..CLASSES {
                work += overhead * demand.points[worst];
                if self.of[level][worst] >= 1.0 {
                    work += demand.points[worst];
                    error += demand.error[worst];
                    continue;
                }
                for class in worst..CLASSES {
                    let (bins, rate) = (demand.bins[worst][class], self.of[level][class]);
                    work += SURE * bins * f64::from(rate);
                    error += bins * f64::from(self.left[level][class]);
                }
            }
            if work * error < least {
                (least, self.best) = (work * error, level);
            }
        }
    }
}

/// How a cell would be asked.
struct Plan {
    /// Bins of each class.
    members: [u8; CLASSES],
    /// The level at which it gets no more than the usual number of samples.
    level: usize,
    /// The class of most doubt.
    worst: usize,
}

impl Plan {
    /// The part of the usual number of samples that it gets.
    fn mean(&self, rates: &Rates, level: usize) -> f32 {
        let mut sums = [0.0; 4];
        for (members, rates) in self.members.chunks_exact(4).zip(rates.of[level].chunks_exact(4)) {
            (0..4).for_each(|i| sums[i] += f32::from(members[i]) * rates[i]);
        }
        sums.iter().sum::<f32>() / BINS as f32
    }

    /// Is there a bin that is worth a usual sample? Then the cell gets as many as it may: a point that is asked at all
    /// costs about the same for few rays and for many.
    fn unsure(&self, rates: &Rates, level: usize) -> bool {
        rates.of[level][self.worst] >= 1.0
    }
}

/// What the cells of a map ask for, for [`Rates::choose`]: sums by the class of most doubt in a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Demand {
    points: [f64; CLASSES],
    /// What the usual number of samples would leave, well spread.
    error: [f64; CLASSES],
    bins: [[f64; CLASSES]; CLASSES],
}

impl Default for Demand {
    fn default() -> Self {
        Self { points: [0.0; CLASSES], error: [0.0; CLASSES], bins: [[0.0; CLASSES]; CLASSES] }
    }
}

impl Demand {
    /// Adds a cell of which one expects this, and which so many points ask.
    pub fn add(&mut self, expected: &[f32; BINS], points: f64, rates: &Rates) {
        let plan = rates.plan(&classes(expected));
        self.points[plan.worst] += points;
        for (class, &members) in plan.members.iter().enumerate() {
            let part = points * f64::from(members) / BINS as f64;
            self.bins[plan.worst][class] += part;
            self.error[plan.worst] += part * f64::from(rates.left[plan.level][class]);
        }
    }
}

/// Classes of doubt: each stands for half the variance of the one before it.
pub const CLASSES: usize = 16;

/// The class of a bin that is expected to be free with this chance.
#[inline]
pub fn class(p: f32) -> usize {
    let variance = (4.0 * p * (1.0 - p)).max(f32::MIN_POSITIVE);
    // Minus the logarithm to base 2, rounded down.
    let power = 126 - (variance.to_bits() >> 23) as i32;
    power.clamp(0, CLASSES as i32 - 1) as usize
}

/// The classes of all bins of a cell.
fn classes(expected: &[f32; BINS]) -> [u8; BINS] {
    let mut classes = [0; BINS];
    for (of, &p) in classes.iter_mut().zip(expected) {
        *of = class(p) as u8;
    }
    classes
}

/// What is thought of `(V - u)²` before there are rays to tell: enough to ask them.
const UNSURE: f64 = 0.01;

/// How far guesses were off, by class.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Doubts {
    /// Rays.
    pub asked: [u64; CLASSES],
    /// Sum of `(V - u)²` in units of 255⁻².
    pub squared: [u64; CLASSES],
}

impl Doubts {
    /// Counts rays of a bin.
    #[inline(always)]
    pub fn add(&mut self, odds: Odds, seen: Tally) {
        let class = odds.class as usize & (CLASSES - 1);
        let (u, asked, free) = (u64::from(odds.u), u64::from(seen.asked), u64::from(seen.free));
        self.asked[class] += asked;
        self.squared[class] += free * (255 - u).pow(2) + asked.saturating_sub(free) * u.pow(2);
    }

    /// Adds what another has counted.
    pub fn merge(&mut self, other: &Self) {
        for class in 0..CLASSES {
            self.asked[class] += other.asked[class];
            self.squared[class] += other.squared[class];
        }
    }

    /// Halves what is known, so that later guesses count for more.
    pub fn fade(&mut self) {
        for class in 0..CLASSES {
            self.asked[class] /= 2;
            self.squared[class] /= 2;
        }
    }

    /// E[(V - u)²] of a class: as measured, or 0.01 where there are few rays.
    pub fn variance(&self, class: usize) -> f64 {
        let few = 64.0;
        let measured = self.squared[class] as f64 / (255.0 * 255.0);
        (measured + few * UNSURE) / (self.asked[class] as f64 + few)
    }

    /// The rates to choose from. `spread` is what the usual samples leave of the variance that bins have by themselves.
    ///
    /// A bin of variance v gets the rate r at which one more sample would take away as much in any bin: the error is
    /// `v (1/r - 1 + spread)` up to `r = 1`, and `v spread r^-1.5` beyond.
    pub fn rates(&self, spread: f32) -> Rates {
        let mut rates = Rates::each(1.0);
        for (class, variance) in rates.variance.iter_mut().enumerate() {
            *variance = self.variance(class) as f32;
        }
        rates.spread = spread;
        let mut price = 1.0;
        for (of, kept) in rates.of.iter_mut().zip(&mut rates.left) {
            for (class, variance) in rates.variance.into_iter().enumerate() {
                let ratio = variance / price;
                let wanted = if ratio < 1.0 {
                    libm::sqrtf(ratio)
                } else {
                    libm::powf(1.5 * spread * ratio, 0.4).max(1.0)
                };
                of[class] = wanted.clamp(LEAST_RATE, MOST_RATE);
                kept[class] = variance * left(of[class], spread);
            }
            price *= 0.625;
        }
        rates
    }
}

/// Rates are between these.
///
/// Measured: below a half, what is missed in bins that look sure costs more than the rays saved, since rays that meet
/// nothing near them are cheap.
const LEAST_RATE: f32 = 0.5;
const MOST_RATE: f32 = 4.0;

/// What a ray costs where there is no doubt: hardly anything is near it.
const SURE: f64 = 0.35;

/// Rays before a cell has odds.
const ENOUGH: f32 = BINS as f32;

/// How many rays the neighbourhood's doubt counts as.
const DOUBT: f32 = 0.25;

/// What is thought of a segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Odds {
    /// u, in units of 1/255.
    pub u: u8,
    /// The class of doubt.
    pub class: u8,
}

impl Odds {
    /// u as a number from 0 to 1.
    #[inline(always)]
    pub fn guess(self) -> f32 {
        f32::from(self.u) * (1.0 / 255.0)
    }
}

/// Cells and a table to find them by, borrowed.
///
/// ```
/// use occlude_kernel::occlusion_map::{CellKey, Known, MapCell, OcclusionMap};
///
/// let key = CellKey::new([0.3, 0.1, 0.7], [0.0, 1.0, 0.0], CellKey::level(0.2), 0).expect("near the origin");
/// let mut cell = MapCell::new(key, [0.0, 1.0, 0.0]);
/// cell.add([0.3, 0.1, 0.7]);
/// cell.set_lit();
/// let cells = [cell];
/// let mut table = [OcclusionMap::FREE; OcclusionMap::table(1)];
/// OcclusionMap::index(&cells, &mut table);
/// let map = OcclusionMap::new(&cells, &table)?;
/// let found = map.find(key).expect("it is there");
/// assert_eq!(map.cells()[found].known([0.3, 0.1, 0.7]), Known::Lit);
/// assert_ne!(map.cells()[found].known([0.3, 0.2, 0.7]), Known::Lit);
/// # Ok::<(), occlude_kernel::occlusion_map::MapError>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct OcclusionMap<'a> {
    cells: &'a [MapCell],
    table: &'a [u32],
}

/// A table must have a power of 2 of places.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MapError;

impl fmt::Display for MapError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the table of an occlusion map must have a power of 2 of places")
    }
}

impl core::error::Error for MapError {}

impl<'a> OcclusionMap<'a> {
    /// What a place in a table holds that names no cell.
    pub const FREE: u32 = u32::MAX;

    /// A map with nothing in it.
    pub const EMPTY: Self = Self { cells: &[], table: &[Self::FREE] };

    /// How long the table of so many cells should be.
    pub const fn table(cells: usize) -> usize {
        (2 * cells + 1).next_power_of_two()
    }

    /// Fills a table: a power of 2 of places, and more than there are cells ([`OcclusionMap::table`]). Of cells with the
    /// same key the first is found. Panics if the table is too short.
    pub fn index(cells: &[MapCell], table: &mut [u32]) {
        assert!(table.len().is_power_of_two() && table.len() > cells.len(), "room in the table");
        table.fill(Self::FREE);
        for (index, cell) in (0..).zip(cells) {
            let mut at = cell.key.hash() & (table.len() - 1);
            while table[at] != Self::FREE {
                at = (at + 1) & (table.len() - 1);
            }
            table[at] = index;
        }
    }

    /// Cells with their table, as [`OcclusionMap::index`] fills it. Of another table less is found, and nothing wrong.
    #[inline]
    pub fn new(cells: &'a [MapCell], table: &'a [u32]) -> Result<Self, MapError> {
        if table.len().is_power_of_two() { Ok(Self { cells, table }) } else { Err(MapError) }
    }

    /// The cells.
    #[inline]
    pub fn cells(&self) -> &'a [MapCell] {
        self.cells
    }

    /// The index of a cell. Some tens of nanoseconds where the map is larger than the cache.
    #[inline]
    pub fn find(&self, key: CellKey) -> Option<usize> {
        let mut at = key.hash() & (self.table.len() - 1);
        for _ in 0..self.table.len() {
            let index = self.table[at] as usize;
            if self.cells.get(index)?.key == key {
                return Some(index);
            }
            at = (at + 1) & (self.table.len() - 1);
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOST: usize = 1 << 13;

    /// The longest search among as many cells, in a table as long as it should be.
    fn longest(cells: usize, key: impl Fn(usize) -> CellKey) -> usize {
        let mut table = [false; OcclusionMap::table(MOST)];
        let last = OcclusionMap::table(cells) - 1;
        let mut longest = 0;
        for i in 0..cells {
            let mut at = key(i).hash() & last;
            let mut steps = 1;
            while table[at] {
                at = (at + 1) & last;
                steps += 1;
            }
            table[at] = true;
            longest = longest.max(steps);
        }
        longest
    }

    fn key(x: [usize; 3], side: usize, level: i32, light: usize) -> CellKey {
        let size = f32::from_bits(((127 + level) as u32) << 23);
        let mut normal = [0.0; 3];
        normal[side / 2] = if side & 1 == 0 { 1.0 } else { -1.0 };
        let x = x.map(|at| (at as f32 - 16.0 + 0.5) * size);
        CellKey::new(x, normal, level, light as u32).expect("near the origin")
    }

    #[test]
    fn cells_spread_over_the_table() {
        for cube in [[16, 16, 16], [3, 40, 18]] {
            let lights = longest(CellKey::LIGHTS as usize, |i| key(cube, 0, -2, i));
            assert!(lights <= 4, "the lights of {cube:?}: {lights}");
        }
        for (axis, edge) in [(0, 8), (1, 16), (2, 64)] {
            // A square of cubes, and as many lights of each as there is room for.
            let at = |i: usize| {
                let mut x = [16; 3];
                (x[(axis + 1) % 3], x[(axis + 2) % 3]) = (i % edge, i / edge % edge);
                key(x, 2 * axis, -2, i / (edge * edge))
            };
            let steps = longest(MOST, at);
            assert!(steps <= 32, "{edge} by {edge} cubes: {steps}");
        }
        let grid = longest(MOST, |i| key([i % 20, i / 20 % 20, i / 400], 5, -3, 0));
        assert!(grid <= 32, "a grid: {grid}");
        let levels =
            longest(MOST, |i| key([i % 8, i / 8 % 8, i / 64 % 8], i / 512 % 6, -6 + (i / 3072) as i32, 0));
        assert!(levels <= 32, "sides and levels: {levels}");
    }
}
