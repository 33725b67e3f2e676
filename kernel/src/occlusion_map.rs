//! The occlusion map: what is known of the visibility between places and lights.
//!
//! Space is cut into cells. For each cell, each way a surface may face there, and each light, the map knows one of
//! three things:
//!
//! - *lit*: a shaft around all of the cell's points and the light met nothing. Exact: no ray is needed;
//! - *odds*: the light is cut into bins, and each has u, the part of the segments that were free so far, and a class of
//!   doubt, which says with what chance q one is worth a ray;
//! - nothing, or nothing that helps: every segment is asked.
//!
//! With odds the estimate of a segment's visibility V is
//!
//! ```text
//!     u + (V - u)/q    with chance q,        u    otherwise,
//! ```
//!
//! which is [`Residual`](crate::Decomposition::Residual) with nothing in its first group. It is right on average for any u and any q
//! above 0, as long as they do not depend on the segment at hand; its variance is `(1/q - 1) E[(V - u)²]`. Where a bin
//! is all dark or all free, as most are away from the borders of shadows, that is next to nothing even for a small q:
//! so the rays go where shadows begin and end, on the surfaces and on the light.
//!
//! How far the doubts are right is itself measured: [`Doubts`] sums `(V - u)²` for each class, and [`Doubts::chances`]
//! turns that into the q of each class.
//!
//! Nothing here is written while it is read, and no number is drawn: the caller collects what rays saw in [`Tally`]s,
//! and makes new odds of them ([`MapCell::learn`]) between passes.

use bytemuck::{Pod, Zeroable};
use core::fmt;
use glam::Vec3;

/// Bins along each edge of a light.
pub const BIN_EDGE: usize = 8;

/// Bins of a light.
pub const BINS: usize = BIN_EDGE * BIN_EDGE;

/// No chance is below one in this many, so that no weight is above it.
pub const LEAST_CHANCE: u32 = 16;

/// The bin of a light's point by its coordinates on the unit square, as light samples have them.
#[inline]
pub fn bin([s, t]: [f32; 2]) -> usize {
    let at = |x: f32| ((x * BIN_EDGE as f32) as usize).min(BIN_EDGE - 1);
    at(t) * BIN_EDGE + at(s)
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

    /// The light.
    #[inline]
    pub fn light(self) -> u32 {
        (self.0 >> 51) as u32
    }

    #[inline]
    fn hash(self) -> usize {
        let mixed = self.0.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (mixed ^ mixed >> 29) as usize
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
    spare: [u8; 4],
    /// What all bins share, if they do: u in units of 1/255, and the class; and whether they do.
    flat: [u8; 4],
    /// u, in units of 1/255.
    u: [u8; BINS],
    /// Classes of doubt.
    class: [u8; BINS],
}

const NOTHING: u32 = 0;
const ODDS: u32 = 1;
const LIT: u32 = 2;
const ALL: u32 = 3;

/// What a cell says of the segments to its light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Known {
    /// Nothing: ask.
    Nothing,
    /// That most segments are worth a ray: asking all costs no more. No need to tell what they saw.
    All,
    /// All of them are free.
    Lit,
    /// The same for all bins.
    Flat(Odds),
    /// [`MapCell::odds`] has them.
    Bins,
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
            spare: [0; 4],
            flat: [0; 4],
            u: [0; BINS],
            class: [0; BINS],
        }
    }

    /// Which it is.
    #[inline]
    pub fn key(&self) -> CellKey {
        self.key
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

    /// Says that every segment from within its bounds is free: proven, and not for all one has seen.
    pub fn set_lit(&mut self) {
        self.state = LIT;
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
            LIT => Known::Flat(Odds { u: 255, class: CLASSES as u8 - 1 }),
            ODDS if self.flat[2] == 1 => Known::Flat(Odds { u: self.flat[0], class: self.flat[1] }),
            ALL => Known::All,
            ODDS => Known::Bins,
            _ => Known::Nothing,
        }
    }

    /// What is thought of a bin. Panics if there is no such bin.
    #[inline(always)]
    pub fn odds(&self, bin: usize) -> Odds {
        Odds { u: self.u[bin], class: self.class[bin] }
    }

    /// The part of each bin's segments that one expects to be free, by everything that rays have seen so far; `None` if
    /// that is too little.
    ///
    /// What was seen in the bins around a bin counts as one ray more, and what was seen in the whole cell as a quarter
    /// of one among these: a bin amid dark ones is thought to be dark.
    pub fn expect(tallies: &[Tally; BINS]) -> Option<[f32; BINS]> {
        let (mut asked, mut free) = (0.0, 0.0);
        for tally in tallies {
            asked += tally.asked as f32;
            free += tally.free as f32;
        }
        if asked < ENOUGH {
            return None;
        }
        let whole = (free + 0.5 * DOUBT) / (asked + DOUBT);
        let mut expected = [0.0; BINS];
        // Sums of threes along the rows, and then of these along the columns.
        let mut rows = [[0.0; 2]; BINS];
        for (bin, row) in rows.iter_mut().enumerate() {
            let column = bin % BIN_EDGE;
            let mut at = bin - usize::from(column > 0);
            while at <= bin + usize::from(column + 1 < BIN_EDGE) {
                row[0] += tallies[at].asked as f32;
                row[1] += tallies[at].free as f32;
                at += 1;
            }
        }
        for (bin, p) in expected.iter_mut().enumerate() {
            let (mut near, mut near_free) = (DOUBT, DOUBT * whole);
            let mut at = if bin >= BIN_EDGE { bin - BIN_EDGE } else { bin };
            while at <= bin + BIN_EDGE && at < BINS {
                near += rows[at][0];
                near_free += rows[at][1];
                at += BIN_EDGE;
            }
            let own = tallies[bin];
            *p = (own.free as f32 + near_free / near) / (own.asked as f32 + 1.0);
        }
        Some(expected)
    }

    /// Makes odds of what one expects, p: u is p, or 0 where p is below a half, so that dark places do not become
    /// negative; and the class of doubt follows from the variance p (1 - p). Nothing to expect, and a cell knows
    /// nothing. What is lit stays so.
    ///
    /// Where more than this part of the rays would be asked, all are from then on.
    pub fn learn(&mut self, expected: Option<&[f32; BINS]>, chances: &Chances, most: f32) {
        let Some(expected) = expected.filter(|_| self.state != LIT) else {
            self.state = if self.state == LIT { LIT } else { NOTHING };
            return;
        };
        let mut sum = 0;
        for (bin, &p) in expected.iter().enumerate() {
            self.u[bin] = if p < 0.5 { 0 } else { (p * 255.0 + 0.5) as u8 };
            self.class[bin] = class(p) as u8;
            sum += u32::from(chances.of(self.class[bin]));
        }
        let alike =
            self.u.iter().all(|&u| u == self.u[0]) && self.class.iter().all(|&class| class == self.class[0]);
        self.flat = [self.u[0], self.class[0], u8::from(alike), 0];
        let asked = sum as f32 / (LEAST_CHANCE as usize * BINS) as f32;
        self.state = if asked > most { ALL } else { ODDS };
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
    /// Counts a ray.
    #[inline(always)]
    pub fn count(&mut self, odds: Odds, free: bool) {
        let off = i32::from(odds.u) - if free { 255 } else { 0 };
        let class = odds.class as usize & (CLASSES - 1);
        self.asked[class] += 1;
        self.squared[class] += (off * off) as u64;
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

    /// The chances that make the product of work and error least, where `segments` of each class are to come,
    /// `unknown` ones are asked for sure, and a segment costs `overhead` rays before it is asked. `spread` is what the
    /// samples' pattern leaves of the variance that bins have by themselves.
    pub fn chances(&self, segments: &[u64; CLASSES], unknown: u64, overhead: f64, spread: f64) -> Chances {
        let mut variance = [0.0; CLASSES];
        let mut base = 0.0;
        for class in 0..CLASSES {
            variance[class] = self.variance(class);
            base += spread * segments[class] as f64 * variance[class];
        }
        let mut best = (f64::INFINITY, Chances::ALL);
        // q = eagerness · sqrt(variance) for eagernesses from 1/4 to 2^13.5, by half powers of 2.
        let mut eagerness = 0.25;
        for _ in 0..32 {
            let (mut work, mut error) = (unknown as f64, base);
            let mut chances = Chances::ALL;
            for class in 0..CLASSES {
                let sixteenths = libm::ceil(16.0 * eagerness * libm::sqrt(variance[class]));
                chances.0[class] = sixteenths.clamp(1.0, 16.0) as u8;
                let q = f64::from(chances.0[class]) / 16.0;
                work += segments[class] as f64 * (q + overhead);
                error += segments[class] as f64 * variance[class] * (1.0 / q - 1.0);
            }
            if work * error < best.0 {
                best = (work * error, chances);
            }
            eagerness *= core::f64::consts::SQRT_2;
        }
        best.1
    }
}

/// The chance to be asked of each class of doubt, in units of 1/16.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Chances([u8; CLASSES]);

impl Chances {
    /// Ask everything.
    pub const ALL: Self = Self([LEAST_CHANCE as u8; CLASSES]);

    /// The same for all classes: `sixteenths` from 1 to 16, or the nearest of these.
    pub fn each(sixteenths: u8) -> Self {
        Self([sixteenths.clamp(1, LEAST_CHANCE as u8); CLASSES])
    }

    /// In units of 1/16: from 1 to 16.
    #[inline(always)]
    pub fn of(&self, class: u8) -> u8 {
        self.0[class as usize & (CLASSES - 1)]
    }
}

/// Rays before a cell has odds.
const ENOUGH: f32 = 8.0;

/// How many rays the neighbourhood's doubt counts as.
const DOUBT: f32 = 0.25;

#[inline]
fn unit(byte: u8) -> f32 {
    f32::from(byte) * (1.0 / 255.0)
}

/// Segments of a batch are asked by systematic sampling: with one random number for the batch each has exactly its
/// chance, and the number of rays is within one of what is expected.
#[derive(Clone, Copy, Debug)]
pub struct Coin(u32);

impl Coin {
    /// From a number uniform in [0, 1).
    #[inline(always)]
    pub fn new(uniform: f32) -> Self {
        Self((uniform * LEAST_CHANCE as f32) as u32)
    }

    /// Whether the next segment is asked: true with chance `sixteenths / 16`.
    #[inline(always)]
    pub fn toss(&mut self, sixteenths: u8) -> bool {
        self.0 += u32::from(sixteenths);
        let asked = self.0 >= LEAST_CHANCE;
        self.0 &= LEAST_CHANCE - 1;
        asked
    }
}

/// What is thought of a segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Odds {
    /// u, in units of 1/255.
    pub u: u8,
    /// The class of doubt.
    pub class: u8,
}

impl Odds {
    /// What is thought of a segment that is not asked: u, and 0 where all are asked, when a guess would only add rounding.
    #[inline(always)]
    pub fn guess(self, chances: &Chances) -> f32 {
        if u32::from(chances.of(self.class)) == LEAST_CHANCE { 0.0 } else { unit(self.u) }
    }

    /// What a ray adds to the guess: `(V - u)/q`.
    #[inline(always)]
    pub fn correction(self, chances: &Chances, free: bool) -> f32 {
        let visible = if free { 1.0 } else { 0.0 };
        (visible - self.guess(chances)) * (LEAST_CHANCE as f32 / f32::from(chances.of(self.class)))
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
