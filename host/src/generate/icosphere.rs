//! A sphere of nearly equal triangles.

use super::mesh::Mesh;
use glam::{DVec3, Vec3};

/// The golden ratio; an icosahedron's corners are `(0, ±1, ±GOLDEN)` and the cyclic shifts of that.
const GOLDEN: f64 = 1.618_033_988_749_895;

const CORNERS: [[f64; 3]; 12] = [
    [-1.0, GOLDEN, 0.0],
    [1.0, GOLDEN, 0.0],
    [-1.0, -GOLDEN, 0.0],
    [1.0, -GOLDEN, 0.0],
    [0.0, -1.0, GOLDEN],
    [0.0, 1.0, GOLDEN],
    [0.0, -1.0, -GOLDEN],
    [0.0, 1.0, -GOLDEN],
    [GOLDEN, 0.0, -1.0],
    [GOLDEN, 0.0, 1.0],
    [-GOLDEN, 0.0, -1.0],
    [-GOLDEN, 0.0, 1.0],
];

#[rustfmt::skip]
const FACES: [[usize; 3]; 20] = [
    [0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11],
    [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8],
    [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9],
    [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1],
];

/// An icosahedron with each edge cut in `frequency >= 1`, blown up to a sphere.
///
/// `20 frequency²` triangles on `10 frequency² + 2` shared vertices: closed, facing out.
pub(super) fn icosphere(mesh: &mut Mesh, centre: Vec3, radius: f32, frequency: u32) {
    let f = frequency.max(1);
    let corners = CORNERS.map(DVec3::from);
    let add = |mesh: &mut Mesh, p: DVec3| mesh.vertex(centre + radius * p.normalize().as_vec3());

    let first_corner = mesh.next_vertex();
    for corner in corners {
        add(mesh, corner);
    }

    // The vertices inside each edge, once, from its lower corner to its higher.
    let mut edges = [[0; 12]; 12];
    for (a, b) in FACES.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).filter(|(a, b)| a < b) {
        edges[a][b] = mesh.next_vertex();
        for k in 1..f {
            let t = f64::from(k) / f64::from(f);
            add(mesh, corners[a] * (1.0 - t) + corners[b] * t);
        }
    }
    let on_edge = |a: usize, b: usize, k: u32| {
        if a < b { edges[a][b] + k - 1 } else { edges[b][a] + (f - k) - 1 }
    };

    for [a, b, c] in FACES {
        let inside = mesh.next_vertex();
        for j in 1..f {
            for i in 1..f - j {
                let sum =
                    corners[a] * f64::from(f - i - j) + corners[b] * f64::from(i) + corners[c] * f64::from(j);
                add(mesh, sum);
            }
        }
        // The vertex `i` steps from a towards b and `j` steps towards c.
        let at = |i: u32, j: u32| match (i, j) {
            (0, 0) => first_corner + a as u32,
            (i, 0) if i == f => first_corner + b as u32,
            (0, j) if j == f => first_corner + c as u32,
            (i, 0) => on_edge(a, b, i),
            (0, j) => on_edge(a, c, j),
            (i, j) if i + j == f => on_edge(b, c, j),
            (i, j) => inside + (j - 1) * (f - 1) - j * (j - 1) / 2 + i - 1,
        };
        for j in 0..f {
            for i in 0..f - j {
                mesh.triangle([at(i, j), at(i + 1, j), at(i, j + 1)]);
                if i + j + 1 < f {
                    mesh.triangle([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
    }
}
