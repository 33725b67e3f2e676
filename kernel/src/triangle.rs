//! Ray and triangle: does the segment meet it?
//!
//! The test of Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection" (JCGT 2013). The ray's dominant
//! axis becomes z, a shear makes the ray the z axis, and what is left is a point-in-triangle test in the plane:
//! with the sheared vertices A, B and C,
//!
//! ```text
//!     U = Cx By - Cy Bx,    V = Ax Cy - Ay Cx,    W = Bx Ay - By Ax,    all >= 0 or all <= 0.
//! ```
//!
//! **Guarantee.** A line through a shared edge or vertex of a closed mesh meets at least one of the triangles
//! around it. A vertex is sheared by the same operations in every triangle, so all of them see the same point of
//! the plane. `U` is the difference of two rounded products; rounding is monotonic, so the difference may come
//! out as zero but never with the wrong sign, and zero counts as inside. The set of triangles that answer is thus
//! no smaller than the set that holds the origin exactly. The two products must each be rounded: a fused
//! multiply-add would break this, and nothing here uses one. (The original falls back to double precision when
//! an edge function is zero; counting zero as inside makes that unnecessary.) A triangle seen exactly edge-on
//! (`U = V = W = 0`) is missed; its neighbours share the edges and answer in its place. One seen edge-on but for
//! rounding, in a line with the ray, can have three signs alike by chance, however far away it is: a hit must
//! therefore also have the ray within the sheared vertices' box, which holds for every triangle that holds it.
//! A segment that begins *in* the plane of a triangle, but for rounding, and ends there too may be said to meet it or not,
//! and queries may differ about it. A point that stands off its surface ([`offset`](crate::offset)) is not in that one's plane.
//!
//! Where along the ray is another question, and asked only where a lane is inside: `t = n (a - o) / n d` with the
//! normal n of the triangle's own edges, held between the t of the vertices.
//!
//! All of it is single operations in a fixed order, so every width gives the same answer bit for bit.

use crate::lanes::{Lanes, Mask, Simd};
use crate::vec3x::{self, Vec3x};
use bytemuck::{Pod, Zeroable};
use core::hint::black_box;
use glam::Vec3;

/// Marks an unused lane of a [`TriangleBlock`]. No triangle may have this number.
pub const NO_TRIANGLE: u32 = u32::MAX;

/// Up to eight triangles side by side: what a leaf of a [`Bvh`](crate::Bvh) holds.
///
/// Unused lanes hold a point, which nothing hits, and the number [`NO_TRIANGLE`]; used lanes come first.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(32))]
pub struct TriangleBlock {
    /// `vertices[vertex][axis][lane]`.
    pub vertices: [[[f32; 8]; 3]; 3],
    /// The number of the triangle in each lane.
    pub ids: [u32; 8],
}

impl TriangleBlock {
    /// Triangles a block holds.
    pub const WIDTH: usize = 8;

    /// No triangles.
    pub const EMPTY: Self = Self { vertices: [[[0.0; 8]; 3]; 3], ids: [NO_TRIANGLE; 8] };

    /// Writes the triangle of a lane. Panics if there is no such lane.
    pub fn set(&mut self, lane: usize, vertices: [[f32; 3]; 3], id: u32) {
        for (vertex, position) in vertices.iter().enumerate() {
            for (axis, &value) in position.iter().enumerate() {
                self.vertices[vertex][axis][lane] = value;
            }
        }
        self.ids[lane] = id;
    }

    /// The vertices of a lane. Panics if there is no such lane.
    #[inline]
    pub fn get(&self, lane: usize) -> [[f32; 3]; 3] {
        self.vertices.map(|vertex| vertex.map(|axis| axis[lane]))
    }

    /// Triangles in use.
    #[inline]
    pub fn len(&self) -> usize {
        self.ids.iter().take_while(|&&id| id != NO_TRIANGLE).count()
    }

    /// Is no lane in use?
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.ids[0] == NO_TRIANGLE
    }
}

/// The axes of a ray: the dominant one last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Axes {
    pub(crate) x: usize,
    pub(crate) y: usize,
    pub(crate) z: usize,
}

impl Axes {
    /// With this dominant axis.
    #[inline(always)]
    pub(crate) fn of(z: usize) -> Self {
        // Written so that the compiler sees that none is above 2.
        match z {
            0 => Self { x: 1, y: 2, z: 0 },
            1 => Self { x: 2, y: 0, z: 1 },
            _ => Self { x: 0, y: 1, z: 2 },
        }
    }

    /// The axis along which a direction is longest; the first of several.
    #[inline(always)]
    pub(crate) fn dominant(direction: Vec3) -> usize {
        let length = direction.abs();
        if length.x >= length.y && length.x >= length.z {
            0
        } else if length.y >= length.z {
            1
        } else {
            2
        }
    }
}

/// Which axes are x, y and z of the test: the same in all lanes, or by lane.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Turn<L: Lanes> {
    /// In all lanes.
    Same(Axes),
    /// Lanes whose dominant axis is the first, and the second; of the others it is the third.
    Each([L::Mask; 2]),
}

impl<L: Lanes> Turn<L> {
    /// That of all rays, where their dominant axis is the same; `along` are the rays by axis.
    #[inline(always)]
    pub(crate) fn same(along: [u32; 3], rays: u32) -> Option<Self> {
        if along[0] == rays {
            Some(Self::Same(Axes::of(0)))
        } else if along[1] == rays {
            Some(Self::Same(Axes::of(1)))
        } else if along[2] == rays {
            Some(Self::Same(Axes::of(2)))
        } else {
            None
        }
    }

    /// By the longest axis of each direction, which most often is the same for all.
    #[inline(always)]
    pub(crate) fn of(direction: Vec3x<L>) -> Self {
        let each = Self::each(direction);
        let Self::Each([first, second]) = each else { return each };
        let all = u32::MAX >> (32 - L::WIDTH);
        let (first, second) = (first.bits(), second.bits());
        Self::same([first, second & !first, all & !(first | second)], all).unwrap_or(each)
    }

    /// By the longest axis of each direction: the rule of [`Axes::dominant`].
    #[inline(always)]
    pub(crate) fn each(direction: Vec3x<L>) -> Self {
        let [x, y, z] = vec3x::abs(direction);
        Self::Each([y.le(x) & z.le(x), z.le(y)])
    }

    /// The components of a vector along x, y and z.
    #[inline(always)]
    fn turn(&self, [x, y, z]: Vec3x<L>) -> Vec3x<L> {
        match *self {
            Self::Same(axes) => [[x, y, z][axes.x], [x, y, z][axes.y], [x, y, z][axes.z]],
            Self::Each([first, second]) => [
                L::select(first, y, L::select(second, z, x)),
                L::select(first, z, L::select(second, x, y)),
                L::select(first, x, L::select(second, y, z)),
            ],
        }
    }
}

/// Triangles, one a lane, read number by number: what a test reads again need not stand in registers meanwhile.
pub(crate) trait Corners<L: Lanes>: Copy {
    /// An axis of a vertex.
    fn at(&self, token: L::Token, vertex: usize, axis: usize) -> L;

    /// The same, as one that the compiler knows nothing of: numbers read from it are not kept from before.
    fn again(self) -> Self;

    /// A vertex.
    #[inline(always)]
    fn vertex(&self, token: L::Token, vertex: usize) -> Vec3x<L> {
        [self.at(token, vertex, 0), self.at(token, vertex, 1), self.at(token, vertex, 2)]
    }
}

/// The triangles of a block from a lane on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Across<'b> {
    pub(crate) block: &'b TriangleBlock,
    pub(crate) from: usize,
}

impl<L: Lanes> Corners<L> for Across<'_> {
    #[inline(always)]
    fn at(&self, token: L::Token, vertex: usize, axis: usize) -> L {
        L::load(token, &self.block.vertices[vertex][axis][self.from..])
    }

    #[inline(always)]
    fn again(self) -> Self {
        Self { block: black_box(self.block), from: self.from }
    }
}

/// The triangle in a lane of a block, for all rays.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Single<'b> {
    pub(crate) block: &'b TriangleBlock,
    pub(crate) lane: usize,
}

impl<L: Lanes> Corners<L> for Single<'_> {
    #[inline(always)]
    fn at(&self, token: L::Token, vertex: usize, axis: usize) -> L {
        L::splat(token, self.block.vertices[vertex][axis][self.lane])
    }

    #[inline(always)]
    fn again(self) -> Self {
        Self { block: black_box(self.block), lane: self.lane }
    }
}

/// A ray as the triangle test wants it, one a lane.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sheared<L: Lanes> {
    pub(crate) turn: Turn<L>,
    /// The origin along x, y and z of the test.
    pub(crate) turned: Vec3x<L>,
    /// By world axis.
    pub(crate) origin: Vec3x<L>,
    /// By world axis.
    pub(crate) direction: Vec3x<L>,
    /// How x and y move for a step along z, and how far t does.
    pub(crate) shear: Vec3x<L>,
    pub(crate) t_min: L,
    pub(crate) t_max: L,
}

/// What the test leaves behind: who was hit and where; `u` and `v` scaled by the determinant.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Crossing<L: Lanes> {
    pub(crate) hit: L::Mask,
    pub(crate) det: L,
    pub(crate) t: L,
    pub(crate) u: L,
    pub(crate) v: L,
}

impl<L: Lanes> Sheared<L> {
    /// A ray, or one a lane. `direction` must be longest along z in every lane that counts.
    #[inline(always)]
    pub(crate) fn new(
        token: L::Token,
        turn: Turn<L>,
        origin: Vec3x<L>,
        direction: Vec3x<L>,
        t_min: L,
        t_max: L,
    ) -> Self {
        let [x, y, z] = turn.turn(direction);
        let step = L::splat(token, 1.0) / z;
        let turned = turn.turn(origin);
        Self { turn, turned, origin, direction, shear: [x * step, y * step, step], t_min, t_max }
    }

    /// A vertex with the ray's origin at 0 and the ray along z.
    #[inline(always)]
    fn vertex(&self, token: L::Token, triangle: impl Corners<L>, vertex: usize) -> Vec3x<L> {
        let at = match self.turn {
            Turn::Same(axes) => [
                triangle.at(token, vertex, axes.x),
                triangle.at(token, vertex, axes.y),
                triangle.at(token, vertex, axes.z),
            ],
            Turn::Each(_) => self.turn.turn(triangle.vertex(token, vertex)),
        };
        let [x, y, depth] = vec3x::sub(at, self.turned);
        [x - self.shear[0] * depth, y - self.shear[1] * depth, depth]
    }

    /// Where these rays meet these triangles, lane by lane; either side may be splatted. NaN is a miss.
    #[inline(always)]
    pub(crate) fn cross(&self, token: L::Token, triangle: impl Corners<L>) -> Crossing<L> {
        let a = self.vertex(token, triangle, 0);
        let b = self.vertex(token, triangle, 1);
        let c = self.vertex(token, triangle, 2);
        let u = c[0] * b[1] - c[1] * b[0];
        let v = a[0] * c[1] - a[1] * c[0];
        let w = b[0] * a[1] - b[1] * a[0];
        let zero = L::splat(token, 0.0);
        // Nothing below zero or nothing above: inside. Both: outside. Neither: edge-on or a point, which is missed.
        let (least, most) = (u.min(v).min(w), u.max(v).max(w));
        let may = least.lt(zero) ^ zero.lt(most);
        let det = u + v + w;
        if !may.any() {
            return Crossing { hit: may, det, t: zero, u: v, v: w };
        }
        // What remains to be told apart is NaN, which may have got lost above.
        let front = zero.le(u) & zero.le(v) & zero.le(w) & zero.lt(det);
        let back = u.le(zero) & v.le(zero) & w.le(zero) & det.lt(zero);
        let inside = front | back;
        // Few come here, so nothing is kept for it.
        let triangle = triangle.again();
        let a = self.vertex(token, triangle, 0);
        let b = self.vertex(token, triangle, 1);
        let c = self.vertex(token, triangle, 2);
        // Of a triangle seen edge-on the signs are rounding: then the ray must at least meet its box.
        let x = a[0].min(b[0]).min(c[0]).le(zero) & zero.le(a[0].max(b[0]).max(c[0]));
        let y = a[1].min(b[1]).min(c[1]).le(zero) & zero.le(a[1].max(b[1]).max(c[1]));
        let inside = inside & x & y;
        // Where the line crosses the plane. The weights would give t too, but for long thin triangles they are
        // small differences of large products, and t is off by more than a point is moved off its surface.
        let first = triangle.vertex(token, 0);
        let n = vec3x::cross(
            vec3x::sub(triangle.vertex(token, 1), first),
            vec3x::sub(triangle.vertex(token, 2), first),
        );
        let t = vec3x::dot(n, vec3x::sub(first, self.origin)) / vec3x::dot(n, self.direction);
        // Seen edge-on that is a quotient of rounding errors, but t lies between those of the vertices.
        let [a, b, c] = [a[2] * self.shear[2], b[2] * self.shear[2], c[2] * self.shear[2]];
        let (first, last) = (a.min(b).min(c), a.max(b).max(c));
        let t = L::select(first.le(t), t, first);
        let t = L::select(t.le(last), t, last);
        Crossing { hit: inside & self.t_min.lt(t) & t.le(self.t_max), det, t, u: v, v: w }
    }
}

impl<S> Sheared<S>
where
    S: Lanes,
{
    /// One ray against the eight triangles of a block: the lanes hit, as bits, and the crossings as arrays.
    #[inline(always)]
    pub(crate) fn cross_block(&self, token: S::Token, block: &TriangleBlock, found: &mut Found) -> u32 {
        let mut hits = 0;
        for from in (0..TriangleBlock::WIDTH).step_by(S::WIDTH) {
            let crossing = self.cross(token, Across { block, from });
            let bits = crossing.hit.bits();
            if bits != 0 {
                crossing.det.store(&mut found.det[from..]);
                crossing.t.store(&mut found.t[from..]);
                crossing.u.store(&mut found.u[from..]);
                crossing.v.store(&mut found.v[from..]);
                hits |= bits << from;
            }
        }
        hits
    }
}

impl<S: Lanes> Sheared<S> {
    /// The lanes of a block that one ray hits, as bits.
    #[inline(always)]
    pub(crate) fn block_hits(&self, token: S::Token, block: &TriangleBlock) -> u32 {
        let mut hits = 0;
        let mut from = 0;
        while from < TriangleBlock::WIDTH {
            hits |= self.cross(token, Across { block, from }).hit.bits() << from;
            from += S::WIDTH;
        }
        hits
    }
}

/// Crossings as arrays; a lane counts where the test's bit is set.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Found {
    pub(crate) det: [f32; 16],
    pub(crate) t: [f32; 16],
    pub(crate) u: [f32; 16],
    pub(crate) v: [f32; 16],
}

impl Found {
    pub(crate) const NOTHING: Self = Self { det: [0.0; 16], t: [0.0; 16], u: [0.0; 16], v: [0.0; 16] };

    /// The hit of a lane.
    #[inline(always)]
    pub(crate) fn hit(&self, lane: usize, triangle: u32) -> crate::Hit {
        let det = self.det[lane];
        crate::Hit { t: self.t[lane], u: self.u[lane] / det, v: self.v[lane] / det, triangle }
    }
}

/// The dominant axis of a ray that can hit something; `None` for one that cannot.
#[inline(always)]
pub(crate) fn dominant_axis(origin: Vec3, direction: Vec3) -> Option<usize> {
    let longest = direction.abs().max_element();
    (origin.is_finite() && direction.is_finite() && longest > 0.0).then(|| Axes::dominant(direction))
}

/// One ray, the same in every lane.
#[inline(always)]
pub(crate) fn shear_one<S: Simd>(simd: S, ray: &crate::Ray, axis: usize) -> Sheared<S::Node> {
    let token = simd.token();
    // Divided once as a scalar: the same division as in any lane.
    let axes = Axes::of(axis);
    let step = 1.0 / ray.direction[axes.z];
    Sheared {
        turn: Turn::Same(axes),
        turned: vec3x::splat(token, [ray.origin[axes.x], ray.origin[axes.y], ray.origin[axes.z]]),
        origin: vec3x::splat(token, ray.origin.to_array()),
        direction: vec3x::splat(token, ray.direction.to_array()),
        shear: vec3x::splat(token, [ray.direction[axes.x] * step, ray.direction[axes.y] * step, step]),
        t_min: S::Node::splat(token, ray.t_min),
        t_max: S::Node::splat(token, ray.t_max),
    }
}
