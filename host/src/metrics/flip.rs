//! FLIP: how different two images look when one is exchanged for the other.
//!
//! The images are blurred as the eye blurs them at a viewing distance, compared
//! by colour in a uniform space, and the result is raised where an edge or a
//! point is in one image and not in the other:
//!
//! ```text
//!     FLIP = colour^(1 - feature),    both in [0, 1]
//! ```
//!
//! Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström and Fairchild, "FLIP: A
//! Difference Evaluator for Alternating Images", Proceedings of the ACM on
//! Computer Graphics and Interactive Techniques 3(2), 2020. All constants are the
//! paper's. Every filter is a Gaussian or a derivative of one, so all of them are
//! applied as a row followed by a column; beyond the border the outermost pixel repeats.

use std::f64::consts::PI;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::film::Image;
use crate::metrics::check_sizes;
use crate::output::clamp_to_screen;

/// Pixels per degree of visual angle 70 cm from a 70 cm wide screen of 3840 pixels.
pub const PIXELS_PER_DEGREE: f32 = 67.0;

/// The difference that is seen, per pixel and on average.
#[derive(Clone, Debug, PartialEq)]
pub struct Flip {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// From 0, the same, to 1, as different as can be; row by row.
    pub map: Vec<f32>,
    /// The mean of the map.
    pub mean: f64,
}

/// Compares the images as a screen would show them: times `2^exposure_ev`, clamped to 0 to 1, NaN black.
///
/// Takes some 640 multiplications a pixel at [`PIXELS_PER_DEGREE`], and more in proportion at a higher resolution.
pub fn flip(test: &Image, reference: &Image, exposure_ev: f32, pixels_per_degree: f32) -> Result<Flip> {
    check_sizes(test, reference)?;
    if !(1.0..=1000.0).contains(&pixels_per_degree) {
        return Err(Error::Usage(format!(
            "{pixels_per_degree} pixels per degree: FLIP wants 1 to 1000, 67 for a usual screen"
        )));
    }
    let filters = Filters::new(pixels_per_degree.into());
    let [test_seen, reference_seen] = [test, reference].map(|image| Seen::new(image, exposure_ev, &filters));
    let largest = largest_distance();
    let map: Vec<f32> = (0..test.pixels.len())
        .into_par_iter()
        .map(|i| {
            let distance = hyab(test_seen.colour[i], reference_seen.colour[i]).powf(COLOUR_EXPONENT);
            let feature = (test_seen.edge[i] - reference_seen.edge[i])
                .abs()
                .max((test_seen.point[i] - reference_seen.point[i]).abs());
            let feature = (feature * std::f32::consts::FRAC_1_SQRT_2).sqrt().min(1.0);
            redistribute(distance, largest).powf(1.0 - feature)
        })
        .collect();
    let rows: Vec<f64> =
        map.par_chunks(test.width as usize).map(|row| row.iter().map(|&v| f64::from(v)).sum()).collect();
    let mean = rows.iter().sum::<f64>() / map.len() as f64;
    Ok(Flip { width: test.width, height: test.height, map, mean })
}

const COLOUR_EXPONENT: f32 = 0.7; // q_c
const KNEE: f32 = 0.4; // p_c, of the largest distance
const KNEE_VALUE: f32 = 0.95; // p_t
const FEATURE_WIDTH: f64 = 0.082; // degrees, of the feature detectors

/// What the eye makes of one image.
struct Seen {
    colour: Vec<[f32; 3]>, // filtered, L*a*b* with the Hunt effect
    edge: Vec<f32>,
    point: Vec<f32>,
}

impl Seen {
    fn new(image: &Image, exposure_ev: f32, filters: &Filters) -> Self {
        let scale = exposure_ev.exp2();
        let shown = |v: f32| clamp_to_screen(v * scale);
        let opponent: Vec<[f32; 3]> =
            image.pixels.par_iter().map(|p| xyz_to_opponent(rgb_to_xyz(p.map(shown)))).collect();
        let size = (image.width as usize, image.height as usize);
        let [y, cx, cz] =
            [0, 1, 2].map(|c| Plane { size, values: opponent.par_iter().map(|p| p[c]).collect() });
        drop(opponent);

        let achromatic = Plane { size, values: y.values.par_iter().map(|y| (y + 16.0) / 116.0).collect() };
        let magnitude = |kernel: &[f32]| -> Vec<f32> {
            let across = achromatic.rows(kernel).columns(&filters.feature_blur);
            let down = achromatic.rows(&filters.feature_blur).columns(kernel);
            across.values.par_iter().zip(&down.values).map(|(x, y)| x.hypot(*y)).collect()
        };
        let (edge, point) = (magnitude(&filters.edge), magnitude(&filters.point));
        drop(achromatic);

        let [y, cx, cz] = [(y, 0), (cx, 1), (cz, 2)].map(|(plane, c)| plane.sensed(&filters.contrast[c]));
        let colour = (0..y.values.len())
            .into_par_iter()
            .map(|i| {
                let rgb = xyz_to_rgb(opponent_to_xyz([y.values[i], cx.values[i], cz.values[i]]));
                hunt(xyz_to_lab(rgb_to_xyz(rgb.map(|v| v.clamp(0.0, 1.0)))))
            })
            .collect();
        Self { colour, edge, point }
    }
}

/// Kernels, each of odd length and centred.
struct Filters {
    /// For achromatic, red-green, blue-yellow: a sum of Gaussians, and the weight of each.
    contrast: [Vec<(f32, Vec<f32>)>; 3],
    feature_blur: Vec<f32>,
    edge: Vec<f32>,
    point: Vec<f32>,
}

impl Filters {
    fn new(pixels_per_degree: f64) -> Self {
        // Contrast sensitivity, a sqrt(pi/b) exp(-pi^2 x^2 / b) with x in degrees: (a, b).
        let sensitivities: [&[(f64, f64)]; 3] =
            [&[(1.0, 0.0047)], &[(1.0, 0.0053)], &[(34.1, 0.04), (13.5, 0.025)]];
        let widest = (0.04 / (2.0 * PI * PI)).sqrt();
        let radius = (3.0 * widest * pixels_per_degree).ceil() as i32;
        let contrast = sensitivities.map(|gaussians| {
            let parts: Vec<_> = gaussians
                .iter()
                .map(|&(a, b)| {
                    let at = |x: i32| (-PI * PI * (f64::from(x) / pixels_per_degree).powi(2) / b).exp();
                    let kernel: Vec<f64> = (-radius..=radius).map(at).collect();
                    let sum: f64 = kernel.iter().sum();
                    // In two dimensions the Gaussian is the product of two, and so is its sum.
                    (a * (PI / b).sqrt() * sum * sum, scaled(&kernel, |_| 1.0 / sum))
                })
                .collect();
            let total: f64 = parts.iter().map(|(weight, _)| weight).sum();
            parts.into_iter().map(|(weight, kernel)| ((weight / total) as f32, kernel)).collect()
        });

        let deviation = 0.5 * FEATURE_WIDTH * pixels_per_degree;
        let radius = (3.0 * deviation).ceil() as i32;
        let kernel = |factor: fn(f64) -> f64| -> Vec<f64> {
            let at = |x: i32| f64::from(x) / deviation;
            (-radius..=radius).map(|x| factor(at(x)) * (-0.5 * at(x).powi(2)).exp()).collect()
        };
        // Positive weights sum to one and negative weights to minus one.
        let balanced = |kernel: Vec<f64>| {
            let above: f64 = kernel.iter().filter(|v| **v > 0.0).sum();
            let below: f64 = kernel.iter().filter(|v| **v < 0.0).sum();
            scaled(&kernel, |v| if v > 0.0 { 1.0 / above } else { -1.0 / below.min(-f64::MIN_POSITIVE) })
        };
        let blur = kernel(|_| 1.0);
        let sum: f64 = blur.iter().sum();
        Self {
            contrast,
            feature_blur: scaled(&blur, |_| 1.0 / sum),
            edge: balanced(kernel(|x| -x)),
            point: balanced(kernel(|x| x * x - 1.0)),
        }
    }
}

fn scaled(kernel: &[f64], factor: impl Fn(f64) -> f64) -> Vec<f32> {
    kernel.iter().map(|&v| (v * factor(v)) as f32).collect()
}

/// One channel of an image.
struct Plane {
    size: (usize, usize),
    values: Vec<f32>,
}

impl Plane {
    /// Every row convolved with an odd kernel.
    fn rows(&self, kernel: &[f32]) -> Plane {
        let (width, radius) = (self.size.0, kernel.len() / 2);
        let mut values = vec![0.0; self.values.len()];
        values.par_chunks_mut(width).zip(self.values.par_chunks(width)).for_each(|(out, row)| {
            let mut padded = Vec::with_capacity(width + 2 * radius);
            padded.resize(radius, row[0]);
            padded.extend_from_slice(row);
            padded.resize(width + 2 * radius, row[width - 1]);
            for (k, weight) in kernel.iter().enumerate() {
                out.iter_mut().zip(&padded[k..]).for_each(|(out, v)| *out += weight * v);
            }
        });
        Plane { size: self.size, values }
    }

    /// Every column convolved with an odd kernel.
    fn columns(&self, kernel: &[f32]) -> Plane {
        let ((width, height), radius) = (self.size, kernel.len() / 2);
        let mut values = vec![0.0; self.values.len()];
        values.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            for (k, weight) in kernel.iter().enumerate() {
                let y = (y + k).saturating_sub(radius).min(height - 1);
                let row = &self.values[y * width..(y + 1) * width];
                out.iter_mut().zip(row).for_each(|(out, v)| *out += weight * v);
            }
        });
        Plane { size: self.size, values }
    }

    /// Filtered by a sum of Gaussians.
    fn sensed(&self, gaussians: &[(f32, Vec<f32>)]) -> Plane {
        let mut sum = Plane { size: self.size, values: vec![0.0; self.values.len()] };
        for (weight, kernel) in gaussians {
            let part = self.rows(kernel).columns(kernel);
            sum.values.par_iter_mut().zip(&part.values).for_each(|(sum, v)| *sum += weight * v);
        }
        sum
    }
}

/// From linear sRGB, to fractions of the white's X, Y and Z: white is (1, 1, 1).
fn rgb_to_xyz([r, g, b]: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|i| {
        let m = RGB_TO_XYZ[i];
        (m[0] * r + m[1] * g + m[2] * b) / (m[0] + m[1] + m[2])
    })
}

fn xyz_to_rgb(xyz: [f32; 3]) -> [f32; 3] {
    let [x, y, z]: [f32; 3] = std::array::from_fn(|i| xyz[i] * RGB_TO_XYZ[i].iter().sum::<f32>());
    XYZ_TO_RGB.map(|m| m[0] * x + m[1] * y + m[2] * z)
}

/// IEC 61966-2-1, from its primaries and the white D65.
const RGB_TO_XYZ: [[f32; 3]; 3] = [
    [0.412_390_8, 0.357_584_33, 0.180_480_8],
    [0.212_639, 0.715_168_68, 0.072_192_32],
    [0.019_330_819, 0.119_194_78, 0.950_532_15],
];

const XYZ_TO_RGB: [[f32; 3]; 3] = [
    [3.240_97, -1.537_383_2, -0.498_610_76],
    [-0.969_243_65, 1.875_967_5, 0.041_555_06],
    [0.055_630_08, -0.203_976_96, 1.056_971_5],
];

/// YCxCz, an L*a*b* without the cube roots, in which light can be averaged.
fn xyz_to_opponent([x, y, z]: [f32; 3]) -> [f32; 3] {
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

fn opponent_to_xyz([l, cx, cz]: [f32; 3]) -> [f32; 3] {
    let y = (l + 16.0) / 116.0;
    [y + cx / 500.0, y, y - cz / 200.0]
}

fn xyz_to_lab(xyz: [f32; 3]) -> [f32; 3] {
    const DELTA: f32 = 6.0 / 29.0;
    let [x, y, z] = xyz
        .map(|t| if t > DELTA * DELTA * DELTA { t.cbrt() } else { t / (3.0 * DELTA * DELTA) + 4.0 / 29.0 });
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// Colours look stronger in brighter light.
fn hunt([l, a, b]: [f32; 3]) -> [f32; 3] {
    [l, 0.01 * l * a, 0.01 * l * b]
}

/// A distance for colours far apart: city block in lightness, Euclid in chroma.
fn hyab(p: [f32; 3], q: [f32; 3]) -> f32 {
    (p[0] - q[0]).abs() + (p[1] - q[1]).hypot(p[2] - q[2])
}

/// The distance from green to blue, the two furthest apart.
fn largest_distance() -> f32 {
    let [green, blue] = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|rgb| hunt(xyz_to_lab(rgb_to_xyz(rgb))));
    hyab(green, blue).powf(COLOUR_EXPONENT)
}

/// Distances to 0 to 1: those below the knee get most of the range.
fn redistribute(distance: f32, largest: f32) -> f32 {
    let knee = KNEE * largest;
    let value = if distance < knee {
        KNEE_VALUE / knee * distance
    } else {
        KNEE_VALUE + (distance - knee) / (largest - knee) * (1.0 - KNEE_VALUE)
    };
    value.min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(value: f32) -> Image {
        Image::from_fn(48, 40, |_, _| [value; 3])
    }

    fn texture() -> Image {
        Image::from_fn(48, 40, |x, y| [((x * 7 + y * 13) % 11) as f32 / 10.0, (x % 5) as f32 / 4.0, 0.3])
    }

    #[test]
    fn an_image_does_not_differ_from_itself() {
        let f = flip(&texture(), &texture(), 0.0, PIXELS_PER_DEGREE).unwrap();
        assert_eq!(f.mean, 0.0);
        assert!(f.map.iter().all(|v| *v == 0.0));
    }

    #[test]
    fn black_and_white_differ_by_their_lightness() {
        let f = flip(&flat(0.0), &flat(1.0), 0.0, PIXELS_PER_DEGREE).unwrap();
        // HyAB is 100, of 308.6 from green to blue; flat images have no features.
        let expected = redistribute(100f32.powf(COLOUR_EXPONENT), largest_distance());
        assert!(f.map.iter().all(|v| (v - expected).abs() < 1e-4), "{} {expected}", f.mean);
        assert!((0.95..1.0).contains(&f.mean), "{}", f.mean);
    }

    #[test]
    fn the_order_does_not_matter_and_nothing_leaves_the_range() {
        let [a, b] = [texture(), flat(0.4)];
        let [ab, ba] = [(&a, &b), (&b, &a)].map(|(a, b)| flip(a, b, 0.0, PIXELS_PER_DEGREE).unwrap());
        assert_eq!(ab, ba);
        assert!(ab.map.iter().all(|v| (0.0..=1.0).contains(v)));
    }

    #[test]
    fn a_screen_shows_nothing_above_white_below_black_or_nan() {
        assert_eq!(flip(&flat(7.0), &flat(1.0), 0.0, 67.0).unwrap().mean, 0.0);
        assert_eq!(flip(&flat(-7.0), &flat(0.0), 0.0, 67.0).unwrap().mean, 0.0);
        assert_eq!(flip(&flat(f32::NAN), &flat(0.0), 0.0, 67.0).unwrap().mean, 0.0);
        assert_eq!(flip(&flat(0.25), &flat(0.5), 2.0, 67.0).unwrap().mean, 0.0);
    }

    #[test]
    fn kernels_sum_as_the_paper_says() {
        let filters = Filters::new(67.0);
        for kernel in filters.contrast.iter().flatten().map(|(_, k)| k).chain([&filters.feature_blur]) {
            assert!((kernel.iter().sum::<f32>() - 1.0).abs() < 1e-6);
        }
        for kernel in [&filters.edge, &filters.point] {
            assert!((kernel.iter().map(|v| v.max(0.0)).sum::<f32>() - 1.0).abs() < 1e-6);
            assert!((kernel.iter().map(|v| v.min(0.0)).sum::<f32>() + 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn a_single_pixel_and_a_wild_resolution_do_no_harm() {
        let (a, b) = (Image::new(1, 1), Image::from_fn(1, 1, |_, _| [1.0; 3]));
        for ppd in [1.0, 67.0, 1000.0] {
            assert!(flip(&a, &b, 0.0, ppd).unwrap().mean > 0.9);
        }
        for ppd in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            assert!(flip(&a, &b, 0.0, ppd).is_err());
        }
        assert!(flip(&a, &Image::new(1, 2), 0.0, 67.0).is_err());
    }
}
