//! Which parts of a light do sheets of triangles hide from all of a tile?
//!
//! Where a light is large, sheets that hide all of it are rare, though each of its parts may be behind one or another.
//! The test of [`super::cover`] is asked for all cells of the light at once: seen from a corner of the tile's box, on
//! which side of an edge the segments pass is linear in where they end, so that one multiply-add for each of the light's
//! axes tells it for as many cells as a vector holds.
//!
//! Cells that are not behind the triangle itself may be behind it and those beyond its edges. A sheet is grown over
//! all cells together, each cell across the edges that its own segments may pass on the outer side. A triangle may be come
//! to more than once; but a segment that leaves one across an edge enters one that was come to later, and as there is an
//! end to these, it meets one of them. What hides the cells
//! of a light is near them as a rule, large, and high up in the tree, and so among the first triangles that a shaft comes
//! to before there are too many for a list: nothing has to be looked for.

use super::ROUNDING;
use super::grid::{CELLS, Grid, MIDDLES, SIDE};
use super::list::List;
use super::shaft::Shaft;
use crate::counter::Counter;
use crate::lanes::{Lanes, Mask, Simd};
use crate::triangle::TriangleBlock;
use crate::vec3x;
use arrayvec::ArrayVec;
use glam::Vec3;

/// Of so many triangles, the first of a list, one may be part of a sheet.
const LISTED: usize = List::ROOM;

/// Those that cover most are looked at, and in all so many with those beyond their edges.
const LARGEST: usize = 24;
const LOOKS: usize = 48;

/// Triangles that cover less, in cells, hide none by themselves, and are not worth a look.
const SMALLEST: f32 = 1.0;

/// If as many hide nothing, nor will the others.
const VAIN: usize = 6;

/// Triangles that one sheet is grown over, at most.
const SHEET: usize = 24;

/// Where fewer cells are hidden it does not pay, and as many tiles are not asked.
const WORTHWHILE: u32 = 8;
const PAUSE: u32 = 7;

/// Half a cell in halves of the light's sides, and a hundredth more, for cells are told by rounded numbers.
const HALF: f32 = 1.01 / SIDE as f32;

/// How much longer a light's sides must be than the rounding of its position, for that hundredth to suffice.
const SHORTEST: f32 = 2e4 * ROUNDING;

/// Of a triangle: the cells that are beyond its plane, with all points on this side; those to which all segments pass on
/// the inner side of each edge; and those whose middle it hides from that of the points.
#[derive(Clone, Copy)]
struct Sides {
    beyond: u64,
    inside: [u64; 3],
    middle: u64,
    /// Is the side of the targets that where the vertices are seen to go clockwise?
    turned: bool,
}

impl Sides {
    /// Hides nothing.
    const NOTHING: Self = Self { beyond: 0, inside: [0; 3], middle: 0, turned: false };
}

/// Room for what is known of a tile's triangles.
pub(super) struct Umbra {
    sides: [Sides; LISTED],
    known: u64,
    /// For how many tiles to come it is not asked.
    pause: u32,
}

/// What the triangles of a list are asked about.
struct Asked<'a> {
    shaft: &'a Shaft,
    grid: &'a Grid,
    list: &'a List,
    /// Triangles in use.
    count: usize,
}

impl Umbra {
    pub(super) const NOTHING: Self = Self { sides: [Sides::NOTHING; LISTED], known: 0, pause: 0 };

    /// The cells of the light that sheets of the triangles of a list hide from all points of the shaft; none where it was
    /// of no use lately.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    pub(super) fn hidden_cells<S: Simd>(
        &mut self,
        simd: S,
        shaft: &Shaft,
        grid: &Grid,
        list: &List,
        magnitude: f32,
        counter: &mut impl Counter,
    ) -> u64 {
        if self.pause > 0 {
            self.pause -= 1;
            return 0;
        }
        let hidden = simd.apart(
            #[inline(always)]
            || {
                let asked = Asked { shaft, grid, list, count: list.count.min(LISTED) };
                self.of(simd, &asked, magnitude, counter)
            },
        );
        if hidden.count_ones() >= WORTHWHILE {
            return hidden;
        }
        self.pause = PAUSE;
        0
    }

    #[inline(always)]
    fn of<S: Simd>(&mut self, simd: S, asked: &Asked<'_>, magnitude: f32, counter: &mut impl Counter) -> u64 {
        let &Asked { shaft, grid, list, count } = asked;
        let reach = magnitude + shaft.reference.abs().max_element() + shaft.farthest[1];
        let [a, b, _] = grid.halves;
        // Written so that NaN fails.
        let long = a.length().min(b.length()) > SHORTEST * reach;
        if !long {
            return 0;
        }
        let mut order = ArrayVec::<(f32, usize), LARGEST>::new();
        let mut k = 0;
        while k < count {
            let covered = cells_covered(simd, shaft, grid, &list.blocks[k / TriangleBlock::WIDTH]);
            let end = (k + TriangleBlock::WIDTH).min(count);
            while k < end {
                let cells = covered[k % TriangleBlock::WIDTH];
                if cells > SMALLEST && (!order.is_full() || cells > order[LARGEST - 1].0) {
                    if order.is_full() {
                        order.pop();
                    }
                    let mut slot = order.len();
                    order.push((cells, k));
                    while slot > 0 && order[slot - 1].0 < cells {
                        order[slot] = order[slot - 1];
                        slot -= 1;
                    }
                    order[slot] = (cells, k);
                }
                k += 1;
            }
        }
        self.known = 0;
        let (mut hidden, mut looks) = (0, LOOKS);
        let mut k = 0;
        while k < order.len() && hidden != u64::MAX && (k < VAIN || hidden != 0) {
            let triangle = order[k].1;
            k += 1;
            let Sides { beyond, inside: [a, b, c], middle, .. } =
                self.sides(simd, asked, triangle, &mut looks);
            hidden |= beyond & a & b & c;
            let cells = beyond & middle & !hidden;
            if cells != 0 {
                hidden |= self.grown(simd, asked, triangle, cells, &mut looks);
            }
        }
        counter.triangle_tests((LOOKS - looks) as u32);
        hidden
    }

    /// Which of some cells does the sheet hide that is grown from a triangle?
    #[inline(always)]
    fn grown<S: Simd>(
        &mut self,
        simd: S,
        asked: &Asked<'_>,
        seed: usize,
        cells: u64,
        looks: &mut usize,
    ) -> u64 {
        let mut hidden = cells;
        // Triangles, the edge across which each was come to, if any, and the cells for which it was.
        let mut sheet = ArrayVec::<(usize, usize, u64), SHEET>::new();
        sheet.push((seed, 3, cells));
        let mut turned = None;
        let mut k = 0;
        while k < sheet.len() && hidden != 0 {
            let (triangle, entered, cells) = sheet[k];
            k += 1;
            if cells & hidden == 0 {
                continue;
            }
            let sides = self.sides(simd, asked, triangle, looks);
            hidden &= !(cells & !sides.beyond);
            if *turned.get_or_insert(sides.turned) != sides.turned {
                hidden &= !cells;
            }
            let mut edge = 0;
            while edge < 3 {
                let passing = cells & hidden & !sides.inside[edge];
                if edge != entered && passing != 0 {
                    match across(simd, asked, triangle, edge) {
                        Some((other, first)) if !sheet.is_full() => sheet.push((other, first, passing)),
                        _ => hidden &= !passing,
                    }
                }
                edge += 1;
            }
        }
        hidden
    }

    /// What is known of a triangle of the list, or nothing if that is too much to look at.
    #[inline(always)]
    fn sides<S: Simd>(&mut self, simd: S, asked: &Asked<'_>, triangle: usize, looks: &mut usize) -> Sides {
        let triangle = triangle & (LISTED - 1);
        if self.known >> triangle & 1 == 0 {
            self.known |= 1 << triangle;
            let (block, lane) = (triangle / TriangleBlock::WIDTH, triangle % TriangleBlock::WIDTH);
            self.sides[triangle] = if *looks == 0 {
                Sides::NOTHING
            } else {
                *looks -= 1;
                sides_of(simd, asked.shaft, asked.grid, &asked.list.blocks[block], lane)
            };
        }
        self.sides[triangle]
    }
}

/// How many cells do triangles cover, seen from the middle of the points? Many, where they reach behind it.
#[inline(always)]
fn cells_covered<S: Simd>(simd: S, shaft: &Shaft, grid: &Grid, block: &TriangleBlock) -> [f32; 8] {
    type N<S> = <S as Simd>::Node;
    let token = simd.token();
    let one = |v: Vec3| vec3x::splat::<N<S>>(token, v.to_array());
    // Twice the area of a triangle on the light is its volume with the eye, over the light's distance, when its
    // vertices are moved there; a cell's area is that of the halves over 16.
    let normal = grid.halves[0].cross(grid.halves[1]);
    let depth = normal.dot(shaft.between);
    let (normal, eye) = (one(normal * (1.0 / depth)), one(shaft.points.middle + shaft.reference));
    let scale = N::<S>::splat(token, 8.0 / depth);
    let nearest = N::<S>::splat(token, 1e-3);
    let mut covered = [0.0; 8];
    let mut from = 0;
    while from < TriangleBlock::WIDTH {
        let a = vec3x::sub(vec3x::load::<N<S>, 8>(token, &block.vertices[0], from), eye);
        let b = vec3x::sub(vec3x::load::<N<S>, 8>(token, &block.vertices[1], from), eye);
        let c = vec3x::sub(vec3x::load::<N<S>, 8>(token, &block.vertices[2], from), eye);
        let volume = vec3x::dot(vec3x::cross(a, b), c) * scale;
        let depths = vec3x::dot(normal, a).max(nearest)
            * vec3x::dot(normal, b).max(nearest)
            * vec3x::dot(normal, c).max(nearest);
        (volume / depths).abs().store(&mut covered[from..]);
        from += N::<S>::WIDTH;
    }
    covered
}

#[inline(always)]
fn sides_of<S: Simd>(simd: S, shaft: &Shaft, grid: &Grid, block: &TriangleBlock, lane: usize) -> Sides {
    type N<S> = <S as Simd>::Node;
    let token = simd.token();
    let [u, v, w] = grid.halves;
    let corners = super::cover::triangle(block, lane, shaft.reference);
    let [a, b, c] = corners;
    let n = (b - a).cross(c - a);
    let turned = n.dot(shaft.between) < 0.0;
    let sign = if turned { -1.0 } else { 1.0 };
    let n = n * sign;
    let mut sides = Sides { turned, ..Sides::NOTHING };
    let [near, far] = shaft.farthest;
    let length = near + far;
    // Twice the margins of one light, as there are twice as many sums.
    let (e, f) = ((b - a).abs(), (c - a).abs());
    let size = (e.y * f.z + e.z * f.y) + (e.z * f.x + e.x * f.z) + (e.x * f.y + e.y * f.x);
    let margin = 128.0 * ROUNDING * size * (length + a.abs().max_element());
    let at = n.dot(a);
    // Written so that NaN fails.
    let here = shaft.points.most(n) + margin < at;
    if !here {
        return sides;
    }
    let [s, t] = [n.dot(u), n.dot(v)];
    let spread = HALF * (s.abs() + t.abs()) + n.dot(w).abs();
    let base = n.dot(shaft.targets.middle) - spread - margin - at;
    sides.beyond = cells_above(simd, &[[base; 8], [s; 8], [t; 8]], 1);
    if sides.beyond == 0 {
        return sides;
    }
    let eye = shaft.points.middle;
    let mut from_eye = [[0.0; 8]; 3];
    let mut edge = 0;
    while edge < 3 {
        let (a, b) = (corners[edge], corners[if edge == 2 { 0 } else { edge + 1 }]);
        let n = (a - eye).cross(b - eye) * sign;
        (from_eye[0][edge], from_eye[1][edge], from_eye[2][edge]) =
            (n.dot(shaft.targets.middle - eye), n.dot(u), n.dot(v));
        let far = near + a.abs().max(b.abs()).max_element();
        let margin = N::<S>::splat(token, 256.0 * ROUNDING * far * far * length);
        let one = |v: Vec3| vec3x::splat::<N<S>>(token, v.to_array());
        let (a, b, middle) = (one(a), one(b), one(shaft.targets.middle));
        let (u, v, w) = (one(u), one(v), one(w));
        let (sign, half) = (N::<S>::splat(token, sign), N::<S>::splat(token, HALF));
        let mut from_corners = [[0.0; 8]; 3];
        let mut from = 0;
        while from < 8 {
            let p = vec3x::load::<N<S>, 16>(token, &shaft.corners, from);
            let n = vec3x::cross(vec3x::sub(a, p), vec3x::sub(b, p));
            let (s, t) = (vec3x::dot(n, u) * sign, vec3x::dot(n, v) * sign);
            let spread = (s.abs() + t.abs()) * half + vec3x::dot(n, w).abs();
            let base = vec3x::dot(n, vec3x::sub(middle, p)) * sign - spread - margin;
            base.store(&mut from_corners[0][from..]);
            s.store(&mut from_corners[1][from..]);
            t.store(&mut from_corners[2][from..]);
            from += N::<S>::WIDTH;
        }
        sides.inside[edge] = cells_above(simd, &from_corners, 8);
        edge += 1;
    }
    sides.middle = cells_above(simd, &from_eye, 3);
    sides
}

/// At the middles of which cells are the first `count` linear functions all above zero? They are given by their values
/// in the middle of the grid, and what is added along half of either side. NaN is not.
#[inline(always)]
fn cells_above<S: Simd>(simd: S, [base, along, across]: &[[f32; 8]; 3], count: usize) -> u64 {
    type P<S> = <S as Simd>::Packet;
    let token = simd.token();
    let zero = P::<S>::splat(token, 0.0);
    let mut cells = 0;
    let mut from = 0;
    while from < CELLS {
        let column = P::<S>::load(token, &MIDDLES[0][from..]);
        let row = P::<S>::load(token, &MIDDLES[1][from..]);
        let mut above = zero.le(zero);
        let mut k = 0;
        while k < count {
            let at = row.mul_add(P::<S>::splat(token, across[k]), P::<S>::splat(token, base[k]));
            above = above & zero.lt(column.mul_add(P::<S>::splat(token, along[k]), at));
            k += 1;
        }
        cells |= u64::from(above.bits()) << from;
        from += P::<S>::WIDTH;
    }
    cells
}

/// The triangle of the list across an edge, turned the same way, and which of its edges that is.
#[inline(always)]
fn across<S: Simd>(simd: S, asked: &Asked<'_>, triangle: usize, edge: usize) -> Option<(usize, usize)> {
    const WIDTH: usize = TriangleBlock::WIDTH;
    let &Asked { list, count, .. } = asked;
    let next = |vertex: usize| if vertex == 2 { 0 } else { vertex + 1 };
    let (block, lane) = (&list.blocks[triangle / WIDTH], triangle % WIDTH);
    let (a, b) = (super::cover::at(block, lane, edge), super::cover::at(block, lane, next(edge)));
    let mut from = 0;
    while from < count {
        let vertices = &list.blocks[from / WIDTH].vertices;
        let mut first = 0;
        while first < 3 {
            let mut found = same(simd, &vertices[first], b);
            if found != 0 {
                found &= same(simd, &vertices[next(first)], a);
                let place = from + found.trailing_zeros() as usize;
                if found != 0 && place < count {
                    return Some((place, first));
                }
            }
            first += 1;
        }
        from += WIDTH;
    }
    None
}

/// Which of a block's positions are this one?
#[inline(always)]
fn same<S: Simd>(simd: S, positions: &[[f32; 8]; 3], [x, y, z]: [f32; 3]) -> u32 {
    type N<S> = <S as Simd>::Node;
    let token = simd.token();
    let is = |axis: usize, from: usize, at: f32| {
        let (these, at) = (N::<S>::load(token, &positions[axis][from..]), N::<S>::splat(token, at));
        these.le(at) & at.le(these)
    };
    let mut bits = 0;
    let mut from = 0;
    while from < TriangleBlock::WIDTH {
        let same = is(0, from, x);
        if same.any() {
            bits |= (same & is(1, from, y) & is(2, from, z)).bits() << from;
        }
        from += N::<S>::WIDTH;
    }
    bits
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bvh::shaft::Turned;
    use crate::counter::Uncounted;
    use crate::lanes::{Native, Scalar};

    struct Numbers(u32);

    impl Numbers {
        fn between(&mut self, low: f32, high: f32) -> f32 {
            self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            low + (high - low) * ((self.0 >> 8) as f32 / 16_777_216.0)
        }
    }

    /// From a square of so many halves around the origin to a light above it.
    fn shaft_and_grid<S: Simd>(simd: S, points: f32) -> (Shaft, Grid) {
        let points = Turned { middle: Vec3::ZERO, axes: [Vec3::X * points, Vec3::Y * points, Vec3::ZERO] };
        let targets = Turned { middle: Vec3::Z * 2.0, axes: [Vec3::X, Vec3::Y * 0.75, Vec3::ZERO] };
        let shaft = Shaft::new(simd, Vec3::ZERO, &points, &targets, 4.0).unwrap();
        let grid = Grid::new(&shaft);
        (shaft, grid)
    }

    fn list(triangles: &[[Vec3; 3]]) -> List {
        let mut list = List::EMPTY;
        for (id, triangle) in triangles.iter().enumerate() {
            let mut block = TriangleBlock::EMPTY;
            block.set(0, triangle.map(Into::into), id as u32);
            list.push(&block, 0);
        }
        list
    }

    fn hidden<S: Simd>(simd: S, shaft: &Shaft, grid: &Grid, triangles: &[[Vec3; 3]]) -> u64 {
        let list = list(triangles);
        let asked = Asked { shaft, grid, list: &list, count: triangles.len() };
        let mut umbra = Umbra::NOTHING;
        umbra.of(simd, &asked, 4.0, &mut Uncounted)
    }

    /// A sheet of squares, each in two, over some of the light. Its vertices are moved up and down, some are beyond the
    /// light, and some squares are missing. Gives how many triangles there are.
    fn sheet(numbers: &mut Numbers, triangles: &mut [[Vec3; 3]; 32]) -> usize {
        let (z, bump) = (numbers.between(0.2, 1.8), numbers.between(0.0, 0.2));
        let (x, y) = (numbers.between(-1.0, 0.3), numbers.between(-1.0, 0.3));
        let size = numbers.between(0.1, 0.5);
        // As steep as a roof, or not.
        let slope = if numbers.between(0.0, 1.0) < 0.5 { numbers.between(-3.0, 3.0) } else { 0.0 };
        let mut vertices = [Vec3::ZERO; 25];
        for (k, vertex) in vertices.iter_mut().enumerate() {
            let at = Vec3::new(
                x + (k % 5) as f32 * size,
                y + (k / 5) as f32 * size,
                z + slope * (k % 5) as f32 * size,
            );
            *vertex = at + Vec3::Z * numbers.between(-bump, bump);
        }
        let mut count = 0;
        for k in (0..19).filter(|k| k % 5 < 4) {
            if numbers.between(0.0, 1.0) < 0.95 {
                let [a, b, c, d] = [vertices[k], vertices[k + 1], vertices[k + 6], vertices[k + 5]];
                triangles[count] = [a, b, c];
                triangles[count + 1] = [a, c, d];
                count += 2;
            }
        }
        count
    }

    /// Does a segment meet a triangle, or all but? In twice the digits.
    fn meets(from: Vec3, to: Vec3, triangle: [Vec3; 3]) -> bool {
        let sub = |a: [f64; 3], b: [f64; 3]| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
        let det = |a: [f64; 3], b: [f64; 3], c: [f64; 3]| {
            a[0] * (b[1] * c[2] - b[2] * c[1])
                + a[1] * (b[2] * c[0] - b[0] * c[2])
                + a[2] * (b[0] * c[1] - b[1] * c[0])
        };
        let [from, to, a, b, c] =
            [from, to, triangle[0], triangle[1], triangle[2]].map(|v| v.to_array().map(f64::from));
        let (direction, [a, b, c]) = (sub(to, from), [a, b, c].map(|v| sub(v, from)));
        let all = det(direction, sub(b, a), sub(c, a));
        let t = det(a, sub(b, a), sub(c, a)) / all;
        let parts = [det(direction, a, b), det(direction, b, c), det(direction, c, a)];
        (0.0..=1.0).contains(&t) && parts.iter().all(|part| part / all >= -1e-6)
    }

    #[test]
    fn all_segments_to_hidden_cells_are_blocked() {
        let mut numbers = Numbers(5);
        let (mut hidden_cells, mut dark_cells) = (0, 0);
        for _ in 0..200 {
            let (shaft, grid) = shaft_and_grid(Native, numbers.between(0.0, 0.05));
            let mut triangles = [[Vec3::ZERO; 3]; 32];
            let count = sheet(&mut numbers, &mut triangles);
            let triangles = &triangles[..count];
            // Families round differently, and so may differ about a cell.
            let (scalar, scalar_grid) = shaft_and_grid(Scalar, shaft.points.axes[0].x);
            let hidden_here =
                hidden(Native, &shaft, &grid, triangles) | hidden(Scalar, &scalar, &scalar_grid, triangles);
            for (cell, (&column, &row)) in MIDDLES[0].iter().zip(&MIDDLES[1]).enumerate() {
                let mut dark = true;
                for k in 0..40 {
                    // The corners of tile and cell, and some places between.
                    let [s, t, x, y] = if k < 16 {
                        [k, k >> 1, k >> 2, k >> 3].map(|k| if k & 1 == 0 { -1.0 } else { 1.0 })
                    } else {
                        [0; 4].map(|_| numbers.between(-1.0, 1.0))
                    };
                    let [a, b, _] = shaft.points.axes;
                    let from = shaft.points.middle + a * x + b * y;
                    let (s, t) = (column + s / SIDE as f32, row + t / SIDE as f32);
                    let to = grid.middle + grid.halves[0] * s + grid.halves[1] * t;
                    dark &= triangles.iter().any(|&triangle| meets(from, to, triangle));
                }
                let told = hidden_here >> cell & 1 != 0;
                assert!(dark || !told, "cell {cell} of {hidden_here:x}");
                dark_cells += u32::from(dark);
                hidden_cells += u32::from(told);
            }
        }
        assert!(dark_cells > 1000 && hidden_cells * 3 > dark_cells, "{hidden_cells} of {dark_cells}");
    }

    #[test]
    fn a_sheet_goes_on_only_where_it_is_turned_the_same_way() {
        let (shaft, grid) = shaft_and_grid(Native, 0.01);
        let at = |x: f32, y: f32| Vec3::new(x, y, 1.0);
        let [a, b, c, d] = [at(-2.0, -2.0), at(2.0, -2.0), at(2.0, 2.0), at(-2.0, 2.0)];
        let hidden = |triangles: &[[Vec3; 3]]| hidden(Native, &shaft, &grid, triangles);
        assert_eq!(hidden(&[[a, b, c], [a, c, d]]), u64::MAX);
        let halves = [hidden(&[[a, b, c]]), hidden(&[[c, a, d]])];
        assert!(halves.iter().all(|half| half.count_ones() >= 20), "{halves:x?}");
        assert_eq!(hidden(&[[a, b, c], [a, d, c]]), halves[0] | halves[1]);
        // Folded back under the first one: what passes the fold meets neither.
        let [a, b, c, d] = [at(-2.0, 0.0), at(2.0, 0.0), at(0.0, -2.0), at(0.0, -0.5)];
        let [first, second] = [[a, b, c], [b, a, d - Vec3::Z * 0.1]];
        assert!(hidden(&[first]) & hidden(&[second]) != 0);
        assert_eq!(hidden(&[first, second]), hidden(&[first]));
    }

    #[test]
    fn what_is_not_between_hides_nothing() {
        let (shaft, grid) = shaft_and_grid(Native, 0.01);
        let at = |z: f32| [Vec3::new(-9.0, -9.0, z), Vec3::new(9.0, -9.0, z), Vec3::new(0.0, 9.0, z)];
        for z in [-1.0, 0.0, 2.0, 3.0, f32::NAN] {
            assert_eq!(hidden(Native, &shaft, &grid, &[at(z)]), 0, "{z}");
        }
        assert_eq!(hidden(Native, &shaft, &grid, &[at(1.0)]), u64::MAX);
        assert_eq!(hidden(Native, &shaft, &grid, &[]), 0);
    }

    #[test]
    fn it_rests_where_it_was_of_no_use() {
        let (shaft, grid) = shaft_and_grid(Native, 0.01);
        let mut umbra = Umbra::NOTHING;
        let mut ask = |list: &List| umbra.hidden_cells(Native, &shaft, &grid, list, 4.0, &mut Uncounted);
        let all = list(&[[Vec3::new(-9.0, -9.0, 1.0), Vec3::new(9.0, -9.0, 1.0), Vec3::new(0.0, 9.0, 1.0)]]);
        assert_eq!(ask(&all), u64::MAX);
        assert_eq!(ask(&List::EMPTY), 0);
        for _ in 0..PAUSE {
            assert_eq!(ask(&all), 0);
        }
        assert_eq!(ask(&all), u64::MAX);
    }
}
