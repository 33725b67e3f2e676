//! Polygons into triangles.

use earcut::Earcut;
use glam::{DVec2, DVec3, Vec3};

/// Splits polygons, keeping its buffers from one to the next.
#[derive(Default)]
pub(super) struct Splitter {
    earcut: Earcut<f64>,
    corners: Vec<DVec3>, // from the first corner, which keeps digits when the polygon is far away
    flat: Vec<[f64; 2]>,
    ears: Vec<u32>,
    triangles: Vec<[u32; 3]>,
}

/// The triangles of one polygon, as numbers of its corners.
#[derive(Debug, PartialEq)]
pub(super) struct Split<'a> {
    pub(super) triangles: &'a [[u32; 3]],
    /// No right split was found, as the polygon crosses itself or is too large; this is the fan.
    pub(super) is_guess: bool,
}

/// Beyond this many corners no ears are cut off: that would take longer than a few seconds.
pub(super) const MAX_EARS: usize = 50_000;

/// How much of a fan may turn the wrong way, as a part of its area: what rounding does to a disc.
const ROUNDING: f64 = 1e-7;

impl Splitter {
    /// Splits a polygon of three corners or more; every triangle turns the way the polygon does.
    ///
    /// Seen along the polygon's Newell normal N, the sum of the vector areas c_i of the fan from the
    /// first corner: where no c_i has N behind it, the fan is the split. That is so for convex
    /// polygons, for any whose first corner sees all of it, and for quads bent along 0-2.
    /// Any other polygon is projected along N and its ears are cut off.
    pub(super) fn split(&mut self, corners: impl Iterator<Item = Vec3>) -> Split<'_> {
        self.corners.clear();
        self.triangles.clear();
        let mut first = None;
        self.corners.extend(corners.map(|p| {
            let p = p.as_dvec3();
            p - *first.get_or_insert(p)
        }));
        let sum: DVec3 = areas(&self.corners).sum();
        let is_guess = match sum.try_normalize() {
            Some(normal) => {
                let seen = areas(&self.corners).map(|c| c.dot(normal));
                let (ahead, behind) = seen.fold((0.0, 0.0), |(a, b), c| (a + c.max(0.0), b - c.min(0.0)));
                let fan_is_right = behind <= ROUNDING * ahead;
                if !fan_is_right && self.cut_ears(normal) {
                    return Split { triangles: &self.triangles, is_guess: false };
                }
                self.fan(normal);
                !fan_is_right
            }
            None => {
                self.fan(DVec3::ZERO);
                areas(&self.corners).any(|c| c != DVec3::ZERO)
            }
        };
        Split { triangles: &self.triangles, is_guess }
    }

    fn fan(&mut self, normal: DVec3) {
        self.triangles.clear();
        self.triangles.extend(
            (2..)
                .zip(areas(&self.corners))
                .map(|(i, area)| if area.dot(normal) < 0.0 { [0, i, i - 1] } else { [0, i - 1, i] }),
        );
    }

    /// Fills in the triangles if they cover the projected polygon exactly once.
    fn cut_ears(&mut self, normal: DVec3) -> bool {
        if self.corners.len() > MAX_EARS {
            return false;
        }
        let (x, y) = normal.any_orthonormal_pair();
        // The pair may turn either way about the normal.
        let y = if x.cross(y).dot(normal) < 0.0 { -y } else { y };
        self.flat.clear();
        self.flat.extend(self.corners.iter().map(|p| [p.dot(x), p.dot(y)]));
        self.ears.clear();
        self.earcut.earcut(self.flat.iter().copied(), &[], &mut self.ears);

        let point = |i: u32| DVec2::from_array(self.flat[i as usize]);
        let area = |[a, b, c]: [u32; 3]| (point(b) - point(a)).perp_dot(point(c) - point(a));
        let whole: f64 = (2..self.flat.len() as u32).map(|i| area([0, i - 1, i])).sum();
        let mut covered = 0.0;
        for ear in self.ears.chunks_exact(3) {
            let ear = [ear[0], ear[1], ear[2]];
            let area = area(ear);
            covered += area.abs();
            self.triangles.push(if area < 0.0 { [ear[0], ear[2], ear[1]] } else { ear });
        }
        (covered - whole).abs() <= 1e-6 * whole
    }
}

/// Twice the vector areas of the triangles of the fan from the first corner, which is the origin.
fn areas(corners: &[DVec3]) -> impl Iterator<Item = DVec3> {
    corners[1..].windows(2).map(|p| p[0].cross(p[1]))
}

/// Whether a triangle has no area: in double precision, where products of two coordinates are exact.
pub(super) fn is_degenerate([a, b, c]: [Vec3; 3]) -> bool {
    let a = a.as_dvec3();
    (b.as_dvec3() - a).cross(c.as_dvec3() - a) == DVec3::ZERO
}

#[cfg(test)]
mod tests {
    use super::*;

    fn split(corners: &[Vec3]) -> (Vec<[u32; 3]>, bool) {
        let mut splitter = Splitter::default();
        let split = splitter.split(corners.iter().copied());
        (split.triangles.to_vec(), split.is_guess)
    }

    fn area(corners: &[Vec3], triangle: &[u32; 3]) -> Vec3 {
        let [a, b, c] = triangle.map(|i| corners[i as usize]);
        (b - a).cross(c - a) * 0.5
    }

    const L: [Vec3; 6] = [
        Vec3::new(0.0, 0.0, 0.0),
        Vec3::new(2.0, 0.0, 0.0),
        Vec3::new(2.0, 1.0, 0.0),
        Vec3::new(1.0, 1.0, 0.0),
        Vec3::new(1.0, 2.0, 0.0),
        Vec3::new(0.0, 2.0, 0.0),
    ];

    #[test]
    fn an_l_begun_at_any_corner_either_way_round_on_any_plane() {
        let turn = glam::Quat::from_euler(glam::EulerRot::XYZ, 0.3, 1.1, -0.7);
        for rotation in [glam::Quat::IDENTITY, turn, glam::Quat::from_rotation_x(std::f32::consts::PI)] {
            for start in 0..6 {
                for backwards in [false, true] {
                    let mut corners: Vec<Vec3> = L.map(|p| rotation * p + Vec3::splat(100.0)).to_vec();
                    corners.rotate_left(start);
                    let mut normal = rotation * Vec3::Z;
                    if backwards {
                        corners.reverse();
                        normal = -normal;
                    }
                    let (triangles, is_guess) = split(&corners);
                    assert!(!is_guess);
                    let areas: Vec<f32> = triangles.iter().map(|t| area(&corners, t).dot(normal)).collect();
                    assert!(areas.iter().all(|&a| a > 0.0), "{areas:?}");
                    assert!((areas.iter().sum::<f32>() - 3.0).abs() < 1e-3, "{areas:?}");
                }
            }
        }
    }

    #[test]
    fn quads_are_split_from_the_first_corner_where_that_is_right() {
        let twisted = [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 3.0), Vec3::Y];
        assert_eq!(split(&twisted), (vec![[0, 1, 2], [0, 2, 3]], false));
        let dart = [Vec3::X, Vec3::Y * 2.0, Vec3::NEG_X, Vec3::Y * 0.5];
        assert_eq!(split(&dart).0.len(), 2);
        let dart = [Vec3::Y * 2.0, Vec3::NEG_X, Vec3::Y * 0.5, Vec3::X];
        assert_eq!(split(&dart), (vec![[0, 1, 2], [0, 2, 3]], false));
        // Begun one later, the fan would be wrong.
        let dart = [Vec3::NEG_X, Vec3::Y * 0.5, Vec3::X, Vec3::Y * 2.0];
        let (triangles, _) = split(&dart);
        assert!(triangles.iter().all(|t| area(&dart, t).z > 0.0), "{triangles:?}");
    }

    #[test]
    fn a_polygon_that_crosses_itself_is_a_fan() {
        let bow_tie =
            [Vec3::ZERO, Vec3::new(2.0, 2.0, 0.0), Vec3::new(2.0, 0.0, 0.0), Vec3::new(0.0, 1.0, 0.0)];
        // Both wings face the way the larger one does.
        assert_eq!(split(&bow_tie), (vec![[0, 1, 2], [0, 3, 2]], true));
        let even = [Vec3::ZERO, Vec3::new(1.0, 1.0, 0.0), Vec3::X, Vec3::Y];
        assert_eq!(split(&even), (vec![[0, 1, 2], [0, 2, 3]], true));
    }

    #[test]
    fn a_polygon_without_area() {
        assert_eq!(split(&[Vec3::X; 5]), (vec![[0, 1, 2], [0, 2, 3], [0, 3, 4]], false));
        assert!(is_degenerate([Vec3::X, Vec3::X, Vec3::Y]));
        assert!(is_degenerate([0.1f32, 0.2, 0.4].map(Vec3::splat)));
        assert!(!is_degenerate([Vec3::ZERO, Vec3::X * 1e-42, Vec3::Y * 1e-42]));
    }

    #[test]
    fn a_great_many_corners() {
        let circle = |i: u32, n: u32, radius: f32| {
            let (sin, cos) = (f64::from(i) / f64::from(n) * std::f64::consts::TAU).sin_cos();
            Vec3::new(cos as f32 * radius, 0.0, sin as f32 * -radius)
        };
        let disc: Vec<Vec3> = (0..200_000).map(|i| circle(i, 200_000, 1.0)).collect();
        let (triangles, is_guess) = split(&disc);
        assert!(!is_guess && triangles.len() == 199_998);
        let star: Vec<Vec3> = (0..9_000).map(|i| circle(i, 9_000, 1.0 + 0.5 * (i % 2) as f32)).collect();
        let (triangles, is_guess) = split(&star);
        assert!(!is_guess && triangles.iter().all(|t| area(&star, t).y >= 0.0));
    }
}
