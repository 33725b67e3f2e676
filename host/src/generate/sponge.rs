//! The surface of Menger's sponge: one closed mesh, full of holes.

use super::mesh::Mesh;
use crate::scene::Scene;
use glam::Vec3;

/// The level whose count is nearest in ratio: 12, 144, 2112, 36 096, 672 768, 13 062 144, 258 097 152.
///
/// Level `n` has `2 (2 * 20^n + 4 * 8^n)` triangles, only those between stone and air. There is
/// nothing random in it. Four more triangles are the ground and the light.
pub(super) fn sponge(triangles: usize) -> Scene {
    let level = level(triangles);
    let count = surface(level);
    let mut mesh = Mesh::new("sponge", count + 4, count / 2 + count / 8 + 64);
    mesh.ground(3.0, [0.6, 0.58, 0.56]);
    mesh.light("light", Vec3::new(0.45, 2.6, 0.65), [0.15, 0.15], [290.0, 270.0, 242.0]);
    let stone = mesh.matte("stone", [0.74, 0.62, 0.44]);
    mesh.object("sponge");
    mesh.paint(stone);
    carve(&mut mesh, level);
    mesh.finish([-1.25, 1.75, 2.3], [0.0, 0.4, 0.0], 34.0)
}

fn surface(level: u32) -> usize {
    2 * (2 * 20_usize.pow(level) + 4 * 8_usize.pow(level))
}

fn level(triangles: usize) -> u32 {
    // n or n + 1: whichever is nearer by ratio, so the bound is their geometric mean.
    let squared = (triangles as f64) * (triangles as f64);
    (0..6).find(|&n| squared < surface(n) as f64 * surface(n + 1) as f64).unwrap_or(6)
}

/// The cells of a 3^level grid, one layer at a time; only two layers of vertices are remembered.
fn carve(mesh: &mut Mesh, level: u32) {
    const NONE: u32 = u32::MAX;
    let n = 3_usize.pow(level);
    // Bit d is set where digit d of the coordinate, base 3, is its middle one.
    let middles: Vec<u32> = (0..n)
        .map(|c| (0..level).fold(0, |m, d| m | (u32::from(c / 3_usize.pow(d) % 3 == 1) << d)))
        .collect();
    // A hole has two middle digits in one place. Outside the grid there is air.
    let solid = |x: usize, y: usize, z: usize| match (middles.get(x), middles.get(y), middles.get(z)) {
        (Some(&x), Some(&y), Some(&z)) => (x & y) | (y & z) | (z & x) == 0,
        _ => false,
    };

    let row = n + 1;
    let mut low = vec![NONE; row * row];
    let mut high = low.clone();
    for z in 0..n {
        for y in 0..n {
            for x in 0..n {
                if !solid(x, y, z) {
                    continue;
                }
                // `0.wrapping_sub(1)` is outside, too.
                let open = [
                    !solid(x.wrapping_sub(1), y, z),
                    !solid(x + 1, y, z),
                    !solid(x, y.wrapping_sub(1), z),
                    !solid(x, y + 1, z),
                    !solid(x, y, z.wrapping_sub(1)),
                    !solid(x, y, z + 1),
                ];
                // The corners of each face, counter-clockwise from outside: bits 0, 1, 2 are x, y, z.
                const FACES: [[usize; 4]; 6] =
                    [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
                for (face, _) in FACES.iter().zip(open).filter(|(_, open)| *open) {
                    let corners = face.map(|bits| {
                        let (x, y) = (x + (bits & 1), y + (bits >> 1 & 1));
                        let slot = if bits >> 2 == 0 { &mut low } else { &mut high };
                        let slot = &mut slot[y * row + x];
                        if *slot == NONE {
                            let cell = Vec3::new(x as f32, y as f32, (z + (bits >> 2)) as f32) / n as f32;
                            // A hundredth above the ground, and centred over it.
                            *slot = mesh.vertex(cell + Vec3::new(-0.5, 0.01, -0.5));
                        }
                        *slot
                    });
                    mesh.quad(corners);
                }
            }
        }
        std::mem::swap(&mut low, &mut high);
        high.fill(NONE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_level() {
        let nearest = [1, 12, 1000, 100_000, 1_000_000, 10_000_000, usize::MAX].map(level);
        assert_eq!(nearest, [0, 0, 2, 3, 4, 5, 6]);
        assert_eq!(surface(5), 13_062_144);
    }
}
