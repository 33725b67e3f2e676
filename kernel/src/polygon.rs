//! The light of a polygon in closed form.

use glam::Vec3;
use wide::f32x4;

/// Edges side by side.
const LANES: usize = 4;

/// Vertices a polygon may have: those of a rectangle, and one more where the horizon cuts it.
const MOST: usize = 5;

/// The irradiance at `x`, on a surface of unit normal `normal`, of a planar polygon of radiance 1 that nothing
/// hides; the part below the surface's horizon gives none.
///
/// ```text
///     E = 1/2 sum_i angle(v_i, v_i+1) n . unit(v_i x v_i+1),     v_i = vertex i - x, clipped at n . v = 0
/// ```
///
/// - `vertices`: three or four, in order around the polygon. The side that faces `x` counts as the bright one;
///   the caller knows which side emits. More than four vertices: only the first four are used.
/// - From 0 to π. For a diffuse surface of reflectance `k` the radiance is `k E / π`.
/// - Cost: four arc tangents side by side, 70 ns on a Zen 1; 180 ns where the horizon cuts it.
///
/// Lambert, "Photometria" (1760); the clipping as in Baum, Rushmeier and Winget, "Improving Radiosity Solutions
/// Through the Use of Analytically Determined Form-Factors" (SIGGRAPH 1989).
pub fn irradiance(x: impl Into<[f32; 3]>, normal: impl Into<[f32; 3]>, vertices: &[[f32; 3]]) -> f32 {
    let (x, normal) = (Vec3::from(x.into()), Vec3::from(normal.into()));
    let [first, second, third, rest @ ..] = vertices else { return 0.0 };
    let fourth = rest.first().unwrap_or(first);
    let corners = Corners::new([first, second, third, fourth].map(|&vertex| Vec3::from(vertex) - x));
    let above = corners.dot(normal);
    // Most often all of it is above the horizon.
    if above.simd_ge(f32x4::ZERO).all() {
        return 0.5 * corners.edges_to(&corners.next(), normal).abs();
    }
    let above = above.to_array();
    let mut clipped = [Vec3::ZERO; MOST];
    let mut len = 0;
    for i in 0..LANES {
        let next = (i + 1) % LANES;
        let (a, b) = (corners.get(i), corners.get(next));
        let (above, beyond) = (above[i], above[next]);
        if above >= 0.0 {
            push(&mut clipped, &mut len, a);
        }
        if (above > 0.0 && beyond < 0.0) || (above < 0.0 && beyond > 0.0) {
            push(&mut clipped, &mut len, a + (b - a) * (above / (above - beyond)));
        }
    }
    // Edges beyond the last begin and end at the same place.
    let corner = |i: usize| clipped[if i < len { i } else { 0 }];
    let from = |first: usize| Corners::new([0, 1, 2, 3].map(|i| corner(first + i)));
    let sum = from(0).edges_to(&from(1), normal);
    0.5 * (sum + if len > LANES { from(LANES).edges_to(&from(LANES + 1), normal) } else { 0.0 }).abs()
}

/// Corners of a polygon, by axis.
struct Corners([f32x4; 3]);

impl Corners {
    #[inline]
    fn new([a, b, c, d]: [Vec3; LANES]) -> Self {
        Self([
            f32x4::new([a.x, b.x, c.x, d.x]),
            f32x4::new([a.y, b.y, c.y, d.y]),
            f32x4::new([a.z, b.z, c.z, d.z]),
        ])
    }

    /// The next one in the place of each.
    #[inline]
    fn next(&self) -> Self {
        Self(self.0.map(|axis| {
            let [a, b, c, d] = axis.to_array();
            f32x4::new([b, c, d, a])
        }))
    }

    fn get(&self, i: usize) -> Vec3 {
        let [x, y, z] = &self.0;
        Vec3::new(x.as_array()[i], y.as_array()[i], z.as_array()[i])
    }

    #[inline]
    fn dot(&self, v: Vec3) -> f32x4 {
        let [x, y, z] = self.0;
        x * f32x4::splat(v.x) + y * f32x4::splat(v.y) + z * f32x4::splat(v.z)
    }

    /// What edges from these corners to others give.
    #[inline]
    fn edges_to(&self, to: &Self, normal: Vec3) -> f32 {
        let ([ax, ay, az], [bx, by, bz]) = (self.0, to.0);
        let across = Self([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]);
        let [x, y, z] = across.0;
        let sine = (x * x + y * y + z * z).sqrt();
        let cosine = ax * bx + ay * by + az * bz;
        // An edge seen end on, or through x itself, spans no area.
        let spans = sine.simd_gt(f32x4::ZERO);
        (spans & (sine.atan2(cosine) * across.dot(normal) / sine)).reduce_add()
    }
}

#[inline]
fn push(corners: &mut [Vec3; MOST], len: &mut usize, corner: Vec3) {
    if let Some(slot) = corners.get_mut(*len) {
        *slot = corner;
        *len += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hemisphere_filled_is_pi() {
        let far = 1e6;
        let sky = [[-far, -far, 1.0], [far, -far, 1.0], [far, far, 1.0], [-far, far, 1.0]];
        let e = irradiance([0.0; 3], [0.0, 0.0, 1.0], &sky);
        assert!((e - core::f32::consts::PI).abs() < 1e-4, "{e}");
    }

    #[test]
    fn small_and_far_is_cosines_over_distance_squared() {
        let d = 100.0;
        let small = [[-0.5, -0.5, d], [0.5, -0.5, d], [0.5, 0.5, d], [-0.5, 0.5, d]];
        let e = irradiance([0.0; 3], [0.0, 0.0, 1.0], &small);
        assert!((e * d * d - 1.0).abs() < 1e-3, "{e}");
    }

    #[test]
    fn square_above_its_centre_is_the_textbook_factor() {
        // Corner factor of a parallel rectangle a by b at distance 1, four times, times pi.
        let (a, d) = (1.0f64, 1.0f64);
        let h = (a * a + d * d).sqrt();
        let expected = 4.0 * (a / h) * (a / h).atan();
        let square = [[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]];
        let e = f64::from(irradiance([0.0; 3], [0.0, 0.0, 1.0], &square));
        assert!((e - expected).abs() < 1e-5, "{e} {expected}");
    }

    #[test]
    fn half_below_the_horizon_gives_half() {
        let upright = [[1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0]];
        let upper = [[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0]];
        let normal = [0.0, 0.0, 1.0];
        let (whole, half) = (irradiance([0.0; 3], normal, &upright), irradiance([0.0; 3], normal, &upper));
        assert!((whole - half).abs() < 1e-6 && half > 0.1, "{whole} {half}");
        let below = [[1.0, -1.0, -2.0], [1.0, 1.0, -2.0], [1.0, 0.0, -1.0]];
        assert_eq!(irradiance([0.0; 3], normal, &below), 0.0);
    }
}
