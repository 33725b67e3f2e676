//! Which parts of a scene hang together, and which of them are closed.

use crate::scene::Scene;
use rayon::prelude::*;
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
    let vertex = weld(scene);
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

/// For each vertex the number of its place: the same for vertices in the same place.
fn weld(scene: &Scene) -> Vec<u32> {
    // Adding zero makes one of the two zeros.
    let place = |p: &glam::Vec3| p.to_array().map(|c| (c + 0.0).to_bits());
    let mut order: Vec<([u32; 3], u32)> = scene.positions.iter().map(place).zip(0..).collect();
    order.par_sort_unstable();
    let mut vertex = vec![0; order.len()];
    for (number, same) in (0u32..).zip(order.chunk_by(|a, b| a.0 == b.0)) {
        same.iter().for_each(|&(_, index)| vertex[index as usize] = number);
    }
    vertex
}

/// The closed meshes of a scene: sets of triangles such that every edge belongs to as many of them one way as the
/// other, so that each has an inside (where it winds around a point) and an outside.
///
/// Vertices in the same place are one vertex, and triangles with two corners in one place count for nothing.
/// Triangles belong together if they share an edge with each other and with no third; only sets that are open by
/// themselves are taken together with others across edges of more than two. In the order of their first triangles.
pub fn closed(scene: &Scene) -> Vec<Vec<u32>> {
    let vertex = weld(scene);
    // An edge, and a triangle with the way it runs along it in the lowest bit.
    let mut edges: Vec<([u32; 2], u64)> = Vec::with_capacity(3 * scene.triangles.len());
    for (triangle, corners) in (0u64..).zip(&scene.triangles) {
        let [a, b, c] = corners.map(|corner| vertex[corner as usize]);
        if a != b && b != c && c != a {
            edges.extend([(a, b), (b, c), (c, a)].map(|(a, b)| {
                let way = u64::from(a > b);
                ([a.min(b), a.max(b)], triangle << 1 | way)
            }));
        }
    }
    edges.par_sort_unstable();
    let mut found = Vec::new();
    let mut rest = edges;
    for by_twos in [true, false] {
        let mut parts = Parts::new(scene.triangles.len());
        for edge in rest.chunk_by(|a, b| a.0 == b.0) {
            if !by_twos || matches!(edge, [a, b] if (a.1 ^ b.1) & 1 == 1) {
                edge.iter().for_each(|side| parts.join((edge[0].1 >> 1) as u32, (side.1 >> 1) as u32));
            }
        }
        let mut open = vec![false; scene.triangles.len()];
        for edge in rest.chunk_by(|a, b| a.0 == b.0) {
            let many = edge.len() > MOST_AT_AN_EDGE;
            for side in edge {
                let part = parts.find((side.1 >> 1) as u32);
                if !open[part as usize] && !many {
                    let mut balance = 0;
                    for other in edge {
                        if parts.find((other.1 >> 1) as u32) == part {
                            balance += 1 - 2 * (other.1 & 1) as i64;
                        }
                    }
                    open[part as usize] = balance != 0;
                } else {
                    open[part as usize] = true;
                }
            }
        }
        let mut used = vec![false; scene.triangles.len()];
        rest.iter().for_each(|edge| used[(edge.1 >> 1) as usize] = true);
        let mut place: HashMap<u32, usize> = HashMap::new();
        for triangle in (0..scene.triangles.len() as u32).filter(|&triangle| used[triangle as usize]) {
            let part = parts.find(triangle);
            if !open[part as usize] {
                let place = *place.entry(part).or_insert_with(|| {
                    found.push(Vec::new());
                    found.len() - 1
                });
                found[place].push(triangle);
            }
        }
        rest.retain(|edge| open[parts.find((edge.1 >> 1) as u32) as usize]);
    }
    found.sort_unstable_by_key(|triangles| triangles[0]);
    found
}

/// Edges of more triangles than this make their meshes open.
const MOST_AT_AN_EDGE: usize = 64;

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
