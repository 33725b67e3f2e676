//! Area lights: what emits, and points on it.

use crate::scene::Scene;
use glam::{DVec3, Vec3};
use occlude_kernel::polygon;
use std::collections::HashMap;
use std::f32::consts::PI;

/// Whether a light is all of its parallelogram or half of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// All points `corner + s u + t v` with s and t from 0 to 1.
    Parallelogram,
    /// Those with `s + t <= 1`.
    Triangle,
}

/// A flat light of constant radiance that shines to the side of its normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AreaLight {
    /// Parallelogram or triangle.
    pub shape: Shape,
    /// A corner.
    pub corner: Vec3,
    /// The edge from the corner along which `s` grows.
    pub u: Vec3,
    /// The edge from the corner along which `t` grows.
    pub v: Vec3,
    /// Unit normal: the side it shines to.
    pub normal: Vec3,
    /// Area, m².
    pub area: f32,
    /// Radiance per channel, W/(m² sr).
    pub radiance: Vec3,
    /// The triangle of the scene, or the two, that it is made of.
    pub triangles: [u32; 2],
}

impl AreaLight {
    /// The point for a pair of uniform numbers in [0, 1): uniform over the area.
    #[inline]
    pub fn point(&self, [s, t]: [f32; 2]) -> Vec3 {
        match self.shape {
            Shape::Parallelogram => self.corner + self.u * s + self.v * t,
            Shape::Triangle => {
                let root = s.sqrt();
                self.corner + self.u * (1.0 - root) + self.v * (t * root)
            }
        }
    }

    /// Emitted power per channel, W: radiance times area times pi.
    pub fn power(&self) -> Vec3 {
        self.radiance * (self.area * PI)
    }

    /// The corners, in order.
    #[inline]
    pub fn corners(&self) -> ([[f32; 3]; 4], usize) {
        let (a, b, c) = (self.corner, self.corner + self.u, self.corner + self.v);
        match self.shape {
            Shape::Parallelogram => ([a, b, b + self.v, c].map(|p| p.to_array()), 4),
            Shape::Triangle => ([a, b, c, c].map(|p| p.to_array()), 3),
        }
    }

    /// Is x so far from the light's plane that rounding does not matter to [`AreaLight::unshadowed`]? On the light
    /// itself all of it or nothing may seem to be in sight.
    #[inline]
    pub fn is_apart(&self, x: Vec3) -> bool {
        let reach = x.abs().max_element() + self.corner.abs().max_element();
        self.normal.dot(x - self.corner) > 64.0 * f32::EPSILON * reach
    }

    /// Irradiance of radiance 1 at x if nothing is in the way; `None` where not a ray of it can arrive: behind
    /// the light or below the surface's horizon. Never 0 otherwise, so that it may weigh a choice.
    #[inline]
    pub fn unshadowed(&self, x: Vec3, normal: Vec3) -> Option<f32> {
        let height = self.normal.dot(x - self.corner);
        let (corners, count) = self.corners();
        let above = corners[..count].iter().any(|&corner| normal.dot(Vec3::from(corner) - x) > 0.0);
        if height <= 0.0 || !above {
            return None;
        }
        let exact = polygon::irradiance(x, normal, &corners[..count]);
        Some(exact.max(f32::MIN_POSITIVE))
    }
}

/// All triangles that emit: pairs that form a parallelogram as one light, the others one by one.
///
/// In the order of their first triangles. Triangles with no area give no light.
pub fn lights(scene: &Scene) -> Vec<AreaLight> {
    let emissive: Vec<u32> = (0..scene.triangles.len() as u32)
        .filter(|&triangle| scene.material(triangle).emission.max_element() > 0.0)
        .collect();
    let mut open: HashMap<[[u32; 3]; 2], usize> = HashMap::new();
    let mut found: Vec<Option<AreaLight>> = Vec::with_capacity(emissive.len());
    for &triangle in &emissive {
        let Some(light) = single(scene, triangle) else { continue };
        let vertices = scene.vertices(triangle);
        let edges = [0, 1, 2].map(|i| (vertices[i], vertices[(i + 1) % 3], vertices[(i + 2) % 3]));
        // The neighbour across an edge runs along it the other way.
        let partner = edges.iter().find_map(|&(a, b, apex)| {
            let other = *open.get(&key(b, a))?;
            let pair = parallelogram(found[other].as_ref()?, &light, [apex, a, b])?;
            Some((other, pair))
        });
        if let Some((other, pair)) = partner {
            found[other] = Some(pair);
        } else {
            for (a, b, _) in edges {
                open.insert(key(a, b), found.len());
            }
            found.push(Some(light));
        }
    }
    found.into_iter().flatten().collect()
}

fn key(a: Vec3, b: Vec3) -> [[u32; 3]; 2] {
    // Adding zero makes one of the two zeros.
    [a, b].map(|p| p.to_array().map(|c| (c + 0.0).to_bits()))
}

fn single(scene: &Scene, triangle: u32) -> Option<AreaLight> {
    let [a, b, c] = scene.vertices(triangle);
    let (u, v) = (b - a, c - a);
    let across = (b.as_dvec3() - a.as_dvec3()).cross(c.as_dvec3() - a.as_dvec3());
    let normal = across.try_normalize()?;
    Some(AreaLight {
        shape: Shape::Triangle,
        corner: a,
        u,
        v,
        normal: normal.as_vec3(),
        area: (0.5 * across.length()) as f32,
        radiance: scene.material(triangle).emission,
        triangles: [triangle; 2],
    })
}

/// The light of two triangles that share the edge `a b` if they form a parallelogram with `apex` opposite the
/// other one's apex.
fn parallelogram(first: &AreaLight, second: &AreaLight, [apex, a, b]: [Vec3; 3]) -> Option<AreaLight> {
    if first.shape != Shape::Triangle || first.radiance != second.radiance {
        return None;
    }
    let corners = [first.corner, first.corner + first.u, first.corner + first.v];
    let far = corners.into_iter().max_by(|p, q| {
        let distance = |p: &Vec3| p.distance(a).min(p.distance(b));
        distance(p).total_cmp(&distance(q))
    })?;
    let [apex, a, b, far] = [apex, a, b, far].map(|p| p.as_dvec3());
    let size = (a - b).length().max((apex - far).length());
    let gap = ((a + b) - (apex + far)).length();
    // Far from the origin the corners are rounded to units much larger than their distances.
    let tolerance = 1e-5 * size + 4.0 * f64::from(f32::EPSILON) * far.abs().max_element();
    if gap > tolerance || first.normal.dot(second.normal) < 0.9999 {
        return None;
    }
    // a, b, apex run around the second triangle, so a and b seen from the apex turn the right way.
    let (u, v): (DVec3, DVec3) = (a - apex, b - apex);
    let across = u.cross(v);
    Some(AreaLight {
        shape: Shape::Parallelogram,
        corner: apex.as_vec3(),
        u: u.as_vec3(),
        v: v.as_vec3(),
        normal: across.try_normalize()?.as_vec3(),
        area: across.length() as f32,
        radiance: first.radiance,
        triangles: [first.triangles[0], second.triangles[0]],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Material;

    fn scene(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Scene {
        Scene {
            positions: positions.iter().map(|&p| Vec3::from(p)).collect(),
            triangles: triangles.to_vec(),
            triangle_materials: vec![0; triangles.len()],
            materials: vec![Material { name: "light".into(), diffuse: Vec3::ZERO, emission: Vec3::ONE }],
            ..Scene::default()
        }
    }

    const QUAD: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 1.0, 0.0], [1.0, 1.0, 0.0]];

    #[test]
    fn a_fan_of_two_is_one_parallelogram_of_the_same_normal_and_area() {
        for triangles in [[[0, 1, 2], [0, 2, 3]], [[1, 2, 0], [3, 0, 2]], [[0, 1, 3], [1, 2, 3]]] {
            let found = lights(&scene(&QUAD, &triangles));
            assert_eq!(found.len(), 1, "{triangles:?}");
            assert_eq!(found[0].shape, Shape::Parallelogram);
            assert!((found[0].area - 2.0).abs() < 1e-6);
            assert!((found[0].normal - Vec3::Z).length() < 1e-6);
            let sum: Vec3 = found[0].corners().0.into_iter().map(Vec3::from).sum();
            assert!((sum / 4.0 - Vec3::new(1.5, 0.5, 0.0)).length() < 1e-6);
        }
    }

    #[test]
    fn other_pairs_stay_triangles() {
        let kite = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 3.0, 0.0], [0.0, 2.0, 0.0]];
        assert_eq!(lights(&scene(&kite, &[[0, 1, 2], [0, 2, 3]])).len(), 2);
        // Facing opposite ways.
        assert_eq!(lights(&scene(&QUAD, &[[0, 1, 2], [0, 3, 2]])).len(), 2);
        let none = lights(&scene(&QUAD, &[[0, 1, 1], [0, 2, 3]]));
        assert_eq!(none.len(), 1, "a triangle with no area is no light");
    }

    #[test]
    fn points_of_a_triangle_are_uniform() {
        let light = lights(&scene(&QUAD, &[[0, 1, 2]]))[0];
        let steps = 200;
        let grid = (0..steps * steps).map(|i| {
            let at = |i: usize| (i as f32 + 0.5) / steps as f32;
            light.point([at(i % steps), at(i / steps)])
        });
        let mean = grid.sum::<Vec3>() / (steps * steps) as f32;
        assert!((mean - Vec3::new(5.0 / 3.0, 1.0 / 3.0, 0.0)).length() < 1e-3, "{mean}");
    }
}
