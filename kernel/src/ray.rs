//! Rays and what they hit.

use glam::Vec3;

/// A half-open stretch of a line: the points `origin + t * direction` with `t_min < t <= t_max`.
///
/// The direction need not be of unit length; `t` counts in its units. A direction of zero, or whose components are all
/// below 1e-27, makes a ray that hits nothing, and so does anything that is NaN or infinite; only `t_min` may be minus
/// infinity, and `t_max` infinity. Hits are found, and their `t` is right, as long as no difference between the origin
/// and a vertex is above 1e12 along an axis; see [`Bvh::new`](crate::Bvh::new).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where `t` is 0.
    pub origin: Vec3,
    /// Where `t` grows to.
    pub direction: Vec3,
    /// The ray begins after this `t`.
    pub t_min: f32,
    /// The ray ends at this `t`.
    pub t_max: f32,
}

impl Ray {
    /// A ray from its parts. Vectors of any version of glam, and plain arrays, will do.
    #[inline]
    pub fn new(origin: impl Into<[f32; 3]>, direction: impl Into<[f32; 3]>, t_min: f32, t_max: f32) -> Self {
        Self { origin: origin.into().into(), direction: direction.into().into(), t_min, t_max }
    }

    /// From a point on for ever: `0 < t`.
    #[inline]
    pub fn from(origin: impl Into<[f32; 3]>, direction: impl Into<[f32; 3]>) -> Self {
        Self::new(origin, direction, 0.0, f32::INFINITY)
    }

    /// A shadow ray: from x to y, so that y lies at `t = 1`.
    #[inline]
    pub fn segment(x: impl Into<[f32; 3]>, y: impl Into<[f32; 3]>) -> Self {
        let (x, y) = (Vec3::from(x.into()), Vec3::from(y.into()));
        Self { origin: x, direction: y - x, t_min: 0.0, t_max: 1.0 }
    }

    /// The point at `t`.
    #[inline]
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + self.direction * t
    }
}

/// Up to 16 rays side by side.
///
/// Any query of a packet takes a mask of the rays in use, bit `i` for ray `i`; what the others hold does not
/// matter. Rays that start close together and point the same way share most of their work.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct RayPacket {
    /// Origins: x, y and z.
    pub origin: [[f32; Self::WIDTH]; 3],
    /// Directions: x, y and z.
    pub direction: [[f32; Self::WIDTH]; 3],
    /// See [`Ray::t_min`].
    pub t_min: [f32; Self::WIDTH],
    /// See [`Ray::t_max`].
    pub t_max: [f32; Self::WIDTH],
}

impl RayPacket {
    /// Rays a packet.
    pub const WIDTH: usize = 16;

    /// The first 16 of these rays; the mask of those in use is `(1 << rays.len()) - 1`.
    pub fn new(rays: &[Ray]) -> Self {
        let mut packet = Self::default();
        for (i, ray) in rays.iter().take(Self::WIDTH).enumerate() {
            packet.set(i, ray);
        }
        packet
    }

    /// Writes ray `i`. Panics if there is no such place.
    #[inline]
    pub fn set(&mut self, i: usize, ray: &Ray) {
        for axis in 0..3 {
            self.origin[axis][i] = ray.origin[axis];
            self.direction[axis][i] = ray.direction[axis];
        }
        self.t_min[i] = ray.t_min;
        self.t_max[i] = ray.t_max;
    }

    /// Reads ray `i`. Panics if there is no such place.
    #[inline]
    pub fn get(&self, i: usize) -> Ray {
        Ray {
            origin: Vec3::from(self.origin.map(|axis| axis[i])),
            direction: Vec3::from(self.direction.map(|axis| axis[i])),
            t_min: self.t_min[i],
            t_max: self.t_max[i],
        }
    }
}

impl Default for RayPacket {
    /// Sixteen rays that hit nothing.
    fn default() -> Self {
        Self {
            origin: [[0.0; Self::WIDTH]; 3],
            direction: [[0.0; Self::WIDTH]; 3],
            t_min: [0.0; Self::WIDTH],
            t_max: [0.0; Self::WIDTH],
        }
    }
}

/// Where a ray meets a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// How far along the ray, in units of its direction.
    pub t: f32,
    /// The weight of the triangle's second vertex.
    pub u: f32,
    /// The weight of the third; the first has `1 - u - v`.
    pub v: f32,
    /// Which triangle, by the number its owner gave it.
    pub triangle: u32,
}

impl Hit {
    /// Is this hit nearer than the other? Of hits at the same `t` the lower number counts as nearer, so that
    /// the answer does not depend on the order in which triangles are met.
    #[inline]
    pub fn nearer_than(&self, other: &Self) -> bool {
        self.t < other.t || (self.t == other.t && self.triangle < other.triangle)
    }
}
