//! Which parts of a scene hang together, and which of them are closed.

use crate::scene::Scene;
use std::collections::HashMap;

/// How many connected meshes there are, and of what kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MeshStats {
    /// Every edge belongs to two triangles that run along it in opposite ways: an inside and an outside.
    pub closed: usize,
    /// The others.
    pub open: usize,
    /// Triangles of closed meshes.
    pub closed_triangles: usize,
    /// Edges of one triangle only.
    pub border_edges: usize,
}

/// Sorts a scene's triangles into meshes connected by edges. Vertices in the same place are one vertex.
pub fn stats(scene: &Scene) -> MeshStats {
    let mut places: HashMap<[u32; 3], u32> = HashMap::with_capacity(scene.positions.len());
    let vertex: Vec<u32> = scene
        .positions
        .iter()
        .map(|p| {
            let next = places.len() as u32;
            *places.entry(p.to_array().map(|c| (c + 0.0).to_bits())).or_insert(next)
        })
        .collect();
    // For each edge, its triangles one way and the other, and one of them.
    let mut edges: HashMap<[u32; 2], ([u32; 2], u32)> = HashMap::with_capacity(scene.triangles.len() * 3 / 2);
    let mut parts = Parts::new(scene.triangles.len());
    for (triangle, corners) in scene.triangles.iter().enumerate() {
        for i in 0..3 {
            let (a, b) = (vertex[corners[i] as usize], vertex[corners[(i + 1) % 3] as usize]);
            let entry = edges.entry([a.min(b), a.max(b)]).or_insert(([0, 0], triangle as u32));
            entry.0[usize::from(a > b)] += 1;
            parts.join(entry.1, triangle as u32);
        }
    }
    let mut closed = vec![true; scene.triangles.len()];
    let mut border_edges = 0;
    for &(uses, triangle) in edges.values() {
        if uses != [1, 1] {
            closed[parts.find(triangle) as usize] = false;
            border_edges += usize::from(uses[0] + uses[1] == 1);
        }
    }
    let mut stats = MeshStats { border_edges, ..MeshStats::default() };
    for triangle in 0..scene.triangles.len() as u32 {
        let part = parts.find(triangle);
        let is_closed = closed[part as usize];
        stats.closed_triangles += usize::from(is_closed);
        if part == triangle {
            *(if is_closed { &mut stats.closed } else { &mut stats.open }) += 1;
        }
    }
    stats
}

/// Sets of triangles that can be joined: union-find with path halving.
struct Parts(Vec<u32>);

impl Parts {
    fn new(count: usize) -> Self {
        Self((0..count as u32).collect())
    }

    fn find(&mut self, mut of: u32) -> u32 {
        while self.0[of as usize] != of {
            let above = self.0[self.0[of as usize] as usize];
            self.0[of as usize] = above;
            of = above;
        }
        of
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.find(a), self.find(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn scene(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Scene {
        Scene {
            positions: positions.iter().map(|&p| Vec3::from(p)).collect(),
            triangles: triangles.to_vec(),
            ..Scene::default()
        }
    }

    const CORNERS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    #[test]
    fn a_tetrahedron_is_closed_until_a_face_is_gone_or_turned() {
        let faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]];
        let whole = stats(&scene(&CORNERS, &faces));
        assert_eq!((whole.closed, whole.open, whole.border_edges), (1, 0, 0));
        let holed = stats(&scene(&CORNERS, &faces[..3]));
        assert_eq!((holed.closed, holed.open, holed.border_edges), (0, 1, 3));
        let turned = stats(&scene(&CORNERS, &[[0, 1, 2], faces[1], faces[2], faces[3]]));
        assert_eq!((turned.closed, turned.open), (0, 1));
    }

    #[test]
    fn vertices_in_one_place_are_one() {
        let faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]];
        let soup: Vec<[f32; 3]> = faces.iter().flatten().map(|&i: &u32| CORNERS[i as usize]).collect();
        let split: Vec<[u32; 3]> = (0..4).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        assert_eq!(stats(&scene(&soup, &split)).closed, 1);
    }
}
