//! A scene under construction.

use super::dice::circle;
use crate::scene::{Camera, Material, Object, Scene};
use glam::Vec3;

/// Collects vertices and triangles, each painted with the material chosen last.
pub(super) struct Mesh {
    scene: Scene,
    material: u32,
}

impl Mesh {
    /// An empty scene with room for so many triangles and vertices.
    pub(super) fn new(name: &str, triangles: usize, vertices: usize) -> Self {
        let scene = Scene {
            name: name.to_owned(),
            positions: Vec::with_capacity(vertices),
            triangles: Vec::with_capacity(triangles),
            triangle_materials: Vec::with_capacity(triangles),
            ..Scene::default()
        };
        Self { scene, material: 0 }
    }

    /// Adds a material that reflects, and returns its number for [`Mesh::paint`].
    pub(super) fn matte(&mut self, name: &str, diffuse: [f32; 3]) -> u32 {
        self.material(name, diffuse, [0.0; 3])
    }

    fn material(&mut self, name: &str, diffuse: [f32; 3], emission: [f32; 3]) -> u32 {
        let (diffuse, emission) = (Vec3::from(diffuse), Vec3::from(emission));
        self.scene.materials.push(Material { name: name.to_owned(), diffuse, emission });
        self.scene.materials.len() as u32 - 1
    }

    /// The triangles from here on have this material.
    pub(super) fn paint(&mut self, material: u32) {
        self.material = material;
    }

    /// The triangles from here on belong to an object of this name.
    pub(super) fn object(&mut self, name: impl Into<String>) {
        self.close_object();
        let start = self.scene.triangles.len() as u32;
        self.scene.objects.push(Object { name: name.into(), triangles: start..start });
    }

    fn close_object(&mut self) {
        if let Some(last) = self.scene.objects.last_mut() {
            last.triangles.end = self.scene.triangles.len() as u32;
        }
    }

    #[inline]
    pub(super) fn vertex(&mut self, p: Vec3) -> u32 {
        self.scene.positions.push(p);
        self.scene.positions.len() as u32 - 1
    }

    /// The number the next vertex will get.
    pub(super) fn next_vertex(&self) -> u32 {
        self.scene.positions.len() as u32
    }

    #[inline]
    pub(super) fn triangle(&mut self, corners: [u32; 3]) {
        self.scene.triangles.push(corners);
        self.scene.triangle_materials.push(self.material);
    }

    /// Two triangles, counter-clockwise from the side of the normal.
    #[inline]
    pub(super) fn quad(&mut self, [a, b, c, d]: [u32; 4]) {
        self.triangle([a, b, c]);
        self.triangle([a, c, d]);
    }

    /// A square floor at height 0, facing up.
    pub(super) fn ground(&mut self, half: f32, diffuse: [f32; 3]) {
        self.object("ground");
        let material = self.matte("ground", diffuse);
        self.paint(material);
        let corners = [(-half, half), (half, half), (half, -half), (-half, -half)];
        let corners = corners.map(|(x, z)| self.vertex(Vec3::new(x, 0.0, z)));
        self.quad(corners);
    }

    /// A horizontal rectangle that shines down.
    pub(super) fn light(&mut self, name: &str, centre: Vec3, half: [f32; 2], emission: [f32; 3]) {
        self.object(name);
        let material = self.material(name, [0.0; 3], emission);
        self.paint(material);
        let [x, z] = half;
        let corners = [(-x, -z), (x, -z), (x, z), (-x, z)];
        let corners = corners.map(|(x, z)| self.vertex(centre + Vec3::new(x, 0.0, z)));
        self.quad(corners);
    }

    /// A tube of `sides` along `rings` (centre and radius), open at its foot, that ends in the point `tip`.
    ///
    /// `sides * (2 * rings - 1)` triangles; none without a ring. The rings turn as little as they can.
    pub(super) fn spike(&mut self, rings: &[(Vec3, f32)], tip: Vec3, sides: u32) {
        let mut side = Vec3::ZERO;
        for (k, &(centre, radius)) in rings.iter().enumerate() {
            let before = if k == 0 { centre } else { rings[k - 1].0 };
            let after = rings.get(k + 1).map_or(tip, |r| r.0);
            let along = (after - before).try_normalize().unwrap_or(Vec3::Y);
            side = (side - along * along.dot(side))
                .try_normalize()
                .unwrap_or_else(|| along.any_orthonormal_vector());
            let other = along.cross(side);
            for i in 0..sides {
                let (cos, sin) = circle(i as f32 / sides as f32);
                self.vertex(centre + radius * (cos * side + sin * other));
            }
        }
        if rings.is_empty() {
            return;
        }
        let tip = self.vertex(tip);
        let first = tip - rings.len() as u32 * sides;
        for k in 0..rings.len() as u32 {
            let ring = first + k * sides;
            for i in 0..sides {
                let (a, b) = (ring + i, ring + (i + 1) % sides);
                if ring + sides == tip {
                    self.triangle([a, b, tip]);
                } else {
                    self.quad([a, b, b + sides, a + sides]);
                }
            }
        }
    }

    /// The scene, seen by this camera.
    pub(super) fn finish(mut self, eye: [f32; 3], target: [f32; 3], vfov_deg: f32) -> Scene {
        self.close_object();
        let (eye, target) = (Vec3::from(eye), Vec3::from(target));
        self.scene.camera = Some(Camera { eye, target, up: Vec3::Y, vfov_deg, width: 640, height: 360 });
        self.scene
    }
}
