//! Meshes to ask about.

use crate::{Random, Triangle};
use glam::{DVec3, Mat3, Vec3};
use std::collections::BTreeMap;

/// Triangles of any shape in the box from -1 to 1, each of about this size.
pub fn soup(random: &mut Random, count: usize, size: f32) -> Vec<Triangle> {
    (0..count)
        .map(|_| {
            let centre = random.point();
            [0; 3].map(|_| centre + random.point() * size)
        })
        .collect()
}

/// Long thin triangles.
pub fn slivers(random: &mut Random, count: usize) -> Vec<Triangle> {
    (0..count)
        .map(|_| {
            let (a, b) = (random.point(), random.point());
            [a, b, a.lerp(b, random.unit()) + random.point() * random.any_scale(-6.0, -2.0)]
        })
        .collect()
}

/// The same triangles elsewhere.
pub fn moved(triangles: &[Triangle], scale: f32, shift: Vec3) -> Vec<Triangle> {
    triangles.iter().map(|triangle| triangle.map(|vertex| vertex * scale + shift)).collect()
}

/// A rotation, every one equally likely.
pub fn rotation(random: &mut Random) -> Mat3 {
    let z = random.direction();
    let x = loop {
        let other = random.direction();
        if other.cross(z).length() > 0.1 {
            break other.cross(z).normalize();
        }
    };
    Mat3::from_cols(x, z.cross(x), z)
}

/// Vertices, and triangles of their indices: triangles that meet share the vertex bit for bit.
#[derive(Clone, Debug, Default)]
pub struct Indexed {
    /// The vertices.
    pub vertices: Vec<DVec3>,
    /// The triangles.
    pub triangles: Vec<[usize; 3]>,
}

impl Indexed {
    /// The triangles, with every vertex put through `to`.
    pub fn triangles(&self, to: impl Fn(DVec3) -> Vec3) -> Vec<Triangle> {
        self.triangles.iter().map(|triangle| triangle.map(|index| to(self.vertices[index]))).collect()
    }

    /// Does every edge have as many triangles on one side as on the other?
    pub fn is_closed(&self) -> bool {
        let mut edges = BTreeMap::<[usize; 2], i32>::new();
        for [a, b, c] in &self.triangles {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                *edges.entry([*from.min(to), *from.max(to)]).or_default() += if from < to { 1 } else { -1 };
            }
        }
        edges.values().all(|&balance| balance == 0)
    }
}

/// The unit sphere: an icosahedron whose triangles are split in four, this often.
pub fn icosphere(subdivisions: usize) -> Indexed {
    let phi = (1.0 + 5.0f64.sqrt()) / 2.0;
    let mut vertices = Vec::new();
    for (a, b) in [(-1.0, phi), (1.0, phi), (-1.0, -phi), (1.0, -phi)] {
        vertices.push(DVec3::new(a, b, 0.0).normalize());
    }
    for (a, b) in [(-1.0, phi), (1.0, phi), (-1.0, -phi), (1.0, -phi)] {
        vertices.push(DVec3::new(0.0, a, b).normalize());
    }
    for (a, b) in [(-1.0, phi), (1.0, phi), (-1.0, -phi), (1.0, -phi)] {
        vertices.push(DVec3::new(b, 0.0, a).normalize());
    }
    let mut triangles = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..subdivisions {
        let mut middles = BTreeMap::new();
        let mut middle = |a: usize, b: usize, vertices: &mut Vec<DVec3>| {
            *middles.entry([a.min(b), a.max(b)]).or_insert_with(|| {
                vertices.push((vertices[a] + vertices[b]).normalize());
                vertices.len() - 1
            })
        };
        let mut finer = Vec::with_capacity(triangles.len() * 4);
        for [a, b, c] in triangles {
            let (ab, bc, ca) =
                (middle(a, b, &mut vertices), middle(b, c, &mut vertices), middle(c, a, &mut vertices));
            finer.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        triangles = finer;
    }
    Indexed { vertices, triangles }
}

/// The unit sphere by latitude and longitude: slivers at the poles, and everywhere if one count is large.
pub fn globe(latitudes: usize, longitudes: usize) -> Indexed {
    let mut mesh = Indexed { vertices: vec![DVec3::Z, -DVec3::Z], triangles: Vec::new() };
    let at = |ring: usize, step: usize| 2 + ring * longitudes + step % longitudes;
    for ring in 1..latitudes {
        let (sin, cos) = (std::f64::consts::PI * ring as f64 / latitudes as f64).sin_cos();
        for step in 0..longitudes {
            let (y, x) = (std::f64::consts::TAU * step as f64 / longitudes as f64).sin_cos();
            mesh.vertices.push(DVec3::new(x * sin, y * sin, cos));
        }
    }
    for step in 0..longitudes {
        mesh.triangles.push([0, at(0, step), at(0, step + 1)]);
        mesh.triangles.push([1, at(latitudes - 2, step + 1), at(latitudes - 2, step)]);
        for ring in 0..latitudes - 2 {
            let [a, b, c, d] =
                [at(ring, step), at(ring + 1, step), at(ring + 1, step + 1), at(ring, step + 1)];
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}

/// A ring of radius 1 whose tube has this radius.
pub fn torus(tube: f64, around: usize, across: usize) -> Indexed {
    let mut mesh = Indexed::default();
    let at = |i: usize, j: usize| i % around * across + j % across;
    for i in 0..around {
        let (y, x) = (std::f64::consts::TAU * i as f64 / around as f64).sin_cos();
        for j in 0..across {
            let (sin, cos) = (std::f64::consts::TAU * j as f64 / across as f64).sin_cos();
            let radius = 1.0 + tube * cos;
            mesh.vertices.push(DVec3::new(x * radius, y * radius, tube * sin));
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}

/// Is a cell of the sponge solid? Cells count from 0 below `3^level` along each axis.
pub fn sponge_holds(cell: [i32; 3], level: u32) -> bool {
    let size = 3i32.pow(level);
    cell.iter().all(|&c| (0..size).contains(&c))
        && (0..level).all(|digit| cell.iter().filter(|&&c| c / 3i32.pow(digit) % 3 == 1).count() < 2)
}

/// Menger's sponge in the box from -1 to 1: faces of solid cells that look into holes. Level 0 is a cube.
pub fn sponge(level: u32) -> Indexed {
    let size = 3i32.pow(level);
    let mut mesh = Indexed::default();
    let mut known = BTreeMap::new();
    for index in 0..size * size * size {
        let cell = [index % size, index / size % size, index / size / size];
        if !sponge_holds(cell, level) {
            continue;
        }
        for axis in 0..3 {
            for side in 0..2 {
                let mut beyond = cell;
                beyond[axis] += 2 * side - 1;
                if sponge_holds(beyond, level) {
                    continue;
                }
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                let mut corners = [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(at_u, at_v)| {
                    let mut corner = cell;
                    corner[axis] += side;
                    corner[u] += at_u;
                    corner[v] += at_v;
                    *known.entry(corner).or_insert_with(|| {
                        let place = corner.map(|c| f64::from(c) * 2.0 / f64::from(size) - 1.0);
                        mesh.vertices.push(DVec3::from(place));
                        mesh.vertices.len() - 1
                    })
                });
                if side == 0 {
                    corners.reverse();
                }
                let [a, b, c, d] = corners;
                mesh.triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
    }
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn closed_meshes_are_closed() {
        for mesh in [icosphere(0), icosphere(3), globe(5, 40), torus(0.3, 24, 12), sponge(0), sponge(2)] {
            assert!(mesh.is_closed());
        }
    }
}
