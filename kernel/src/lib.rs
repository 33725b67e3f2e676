#![no_std]
#![forbid(unsafe_code)]
//! Visibility for soft shadows: is there anything between these points, and what?
//!
//! No std, no heap, no unsafe code, no global state and no random numbers: slices and numbers come from the
//! caller. The caller builds a tree (or lets `occlude-host` do it), borrows it to a [`Bvh`], and asks.
//!
//! ```
//! use occlude_kernel::{Bvh, Child, Node, Ray, TriangleBlock, Uncounted};
//!
//! let mut block = TriangleBlock::EMPTY;
//! block.set(0, [[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 1.0, 1.0]], 7);
//! let mut root = Node::EMPTY;
//! root.set(0, [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0], Child::leaf(0));
//!
//! let (nodes, blocks) = ([root], [block]);
//! let bvh = Bvh::new(&nodes, &blocks)?;
//! let through = Ray::segment([0.0, 0.0, 0.0], [0.0, 0.0, 2.0]);
//! assert_eq!(bvh.occluder(&through, None, &mut Uncounted), Some(7));
//! assert!(!bvh.occluded(&through, Some(7), &mut Uncounted));
//! assert!(!bvh.occluded(&Ray::segment([0.0, 0.0, 0.0], [0.0, 0.0, 0.5]), None, &mut Uncounted));
//! # Ok::<(), occlude_kernel::BvhError>(())
//! ```
//!
//! Features: `dispatch` chooses vectors at run time ([`lanes`]); `std` lets it ask the CPU which it has.

pub mod bvh;
pub mod counter;
pub mod decomposition;
pub mod estimator;
pub mod lanes;
pub mod occlusion_map;
pub mod photons;
pub mod polygon;
pub mod ray;
pub mod triangle;
mod vec3x;

pub use bvh::{
    BatchScratch, Bvh, BvhError, Child, HitPacket, Leaf, Node, Occluders, Part, Targets, TilePoint,
    TileScratch, offset,
};
pub use counter::{Counter, Counts, Uncounted};
pub use decomposition::{Costs, Decomposition, EstimatorError, Group, Joint, Need, Needs, Tally};
pub use estimator::{Estimator, Exact, Halving, Levels, OneTerm, Probabilities, Quotas};
pub use lanes::{Native, Scalar, Simd};
pub use occlusion_map::OcclusionMap;
pub use photons::{LightPhoton, OcclusionPhoton, PhotonMap};
pub use ray::{Hit, Ray, RayPacket};
pub use triangle::{NO_TRIANGLE, TriangleBlock};

/// Its code is compiled with the examples.
#[cfg(all(doctest, feature = "dispatch"))]
#[doc = include_str!("../README.md")]
struct Readme;
