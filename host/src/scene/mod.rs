//! Scenes as their files describe them: triangles, materials, a camera.

mod camera;

pub use camera::{Camera, CameraRequest, Frame, MAX_PIXELS, MAX_SIDE};

use glam::Vec3;
use std::ops::Range;

/// The largest magnitude of a coordinate: squares of it still fit an `f32`.
pub const MAX_COORDINATE: f32 = 1e18;

/// What a surface does with light. Both sides reflect; only the front emits.
#[derive(Clone, Debug, PartialEq)]
pub struct Material {
    /// As the file names it.
    pub name: String,
    /// Diffuse reflectance per channel (`Kd`), two-sided.
    pub diffuse: Vec3,
    /// Emitted radiance per channel (`Ke`), W/(m² sr), to the side of the geometric normal.
    pub emission: Vec3,
}

/// Triangles that the file groups under one name.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// As the file names it; empty before the first `o` or `g`.
    pub name: String,
    /// Its triangles.
    pub triangles: Range<u32>,
}

/// Everything a render needs to know, in one triangle soup.
///
/// A triangle `[a, b, c]` has the geometric normal `(b - a) x (c - a)`.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// What to call it: the folder's or the file's name.
    pub name: String,
    /// Vertices, finite, below 1e18 in magnitude.
    pub positions: Vec<Vec3>,
    /// Three indices into `positions` each.
    pub triangles: Vec<[u32; 3]>,
    /// One index into `materials` for each triangle.
    pub triangle_materials: Vec<u32>,
    /// Materials.
    pub materials: Vec<Material>,
    /// Objects, in the order of their triangles, covering all of them.
    pub objects: Vec<Object>,
    /// The camera, if the file or the caller gave one.
    pub camera: Option<Camera>,
    /// What was odd but usable, a sentence each.
    pub warnings: Vec<String>,
}

impl Scene {
    /// The vertices of a triangle.
    #[inline]
    pub fn vertices(&self, triangle: u32) -> [Vec3; 3] {
        self.triangles[triangle as usize].map(|i| self.positions[i as usize])
    }

    /// The material of a triangle.
    #[inline]
    pub fn material(&self, triangle: u32) -> &Material {
        &self.materials[self.triangle_materials[triangle as usize] as usize]
    }

    /// The least and the greatest corner of all triangles; `None` if there are none.
    pub fn bounds(&self) -> Option<(Vec3, Vec3)> {
        let mut used = self.triangles.iter().flatten().map(|&i| self.positions[i as usize]);
        let first = used.next()?;
        Some(used.fold((first, first), |(lo, hi), p| (lo.min(p), hi.max(p))))
    }
}
