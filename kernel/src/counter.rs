//! The work done, counted only where somebody asks.

/// Takes note of work. With [`Uncounted`] every call compiles to nothing.
pub trait Counter {
    /// This many rays were asked about.
    #[inline(always)]
    fn rays(&mut self, _rays: u32) {}
    /// This many pairs of a ray and a triangle were tested: lanes in use, not lanes there are.
    #[inline(always)]
    fn triangle_tests(&mut self, _pairs: u32) {}
    /// This many pairs of a ray (or a bundle tested as one) and a child's box were tested: lanes in use.
    #[inline(always)]
    fn node_tests(&mut self, _pairs: u32) {}
}

/// Counts nothing and costs nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Uncounted;

impl Counter for Uncounted {}

/// Counts everything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Rays asked about.
    pub rays: u64,
    /// Ray and triangle, lanes in use.
    pub triangle_tests: u64,
    /// Ray and box, lanes in use.
    pub node_tests: u64,
}

impl Counter for Counts {
    #[inline(always)]
    fn rays(&mut self, rays: u32) {
        self.rays += u64::from(rays);
    }

    #[inline(always)]
    fn triangle_tests(&mut self, pairs: u32) {
        self.triangle_tests += u64::from(pairs);
    }

    #[inline(always)]
    fn node_tests(&mut self, pairs: u32) {
        self.node_tests += u64::from(pairs);
    }
}

impl core::ops::AddAssign for Counts {
    fn add_assign(&mut self, other: Self) {
        self.rays += other.rays;
        self.triangle_tests += other.triangle_tests;
        self.node_tests += other.node_tests;
    }
}
