//! Pictures against formulas: penumbrae whose visible fraction is known, and Lambert's law.
//!
//! Every pixel of a render is an estimate with a known variance, so a formula is tested by the sum of squared
//! deviations over its standard errors, at five standard deviations of that sum, and by the mean deviation.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_host::integrator::{Exact, Stage};
use occlude_host::light::{self, AreaLight};
use occlude_host::render::{Limits, Rendered, render};
use occlude_host::sampler::Pattern;
use occlude_host::scene::{Camera, CameraRequest, Material, Scene, load};
use occlude_kernel::lanes::{detect, levels};
use occlude_kernel::polygon;
use rand_xoshiro::Xoshiro128PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use std::f64::consts::PI;
use std::path::Path;
use std::sync::atomic::AtomicBool;

struct Setting {
    scene: Scene,
    accel: Accel,
    lights: Vec<AreaLight>,
    camera: Camera,
}

impl Setting {
    fn of(scene: Scene) -> Self {
        let camera = scene.camera.expect("a camera");
        Self { accel: Accel::build(&scene, Quality::Medium), lights: light::lights(&scene), camera, scene }
    }

    /// A scene of the repository, seen straight from above: pixels are points of the floor.
    fn own(name: &str, eye: Vec3, target: Vec3, vfov_deg: f32) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes").join(name);
        let request = CameraRequest {
            eye: Some(eye),
            target: Some(target),
            up: Some(Vec3::Z),
            vfov_deg: Some(vfov_deg),
            size: Some((64, 64)),
            ..CameraRequest::default()
        };
        Self::of(load(&folder, &request).expect("the scene loads"))
    }

    fn render(
        &self,
        passes: u32,
        shadow_rays: u32,
        pattern: Pattern,
        threads: usize,
        simd: usize,
    ) -> Rendered {
        let frame = self.camera.frame();
        let stage = Stage {
            scene: &self.scene,
            bvh: self.accel.bvh(),
            lights: &self.lights,
            eye: self.camera.eye,
            camera: &frame,
            shadow_rays,
            pattern,
            seed: 5,
            level: levels().nth(simd).unwrap_or_else(detect),
            count: false,
        };
        let size = (self.camera.width, self.camera.height);
        let limits = Limits { passes, time: None };
        render(&stage, &Exact, size, limits, threads, &AtomicBool::new(false), |_| ()).expect("it renders")
    }
}

const PATTERNS: [Pattern; 5] =
    [Pattern::Lattice, Pattern::Sobol, Pattern::Jittered, Pattern::UniformJitter, Pattern::Random];

/// The mean over pixels of (rendered - expected) in units of its standard error, and the mean square of the same.
fn deviations(rendered: &Rendered, expected: impl Fn(u32, u32) -> Option<f64>) -> (f64, f64) {
    let (mean, error) = (rendered.film.develop(), rendered.film.standard_error());
    let (mut difference, mut variance, mut squares, mut count) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
    for y in 0..mean.height {
        for x in 0..mean.width {
            let at = (y * mean.width + x) as usize;
            let (value, error) = (f64::from(mean.pixels[at][1]), f64::from(error.pixels[at][1]));
            if let Some(expected) = expected(x, y) {
                difference += value - expected;
                variance += error * error;
                let least = 1e-5 * expected.abs() + 1e-7;
                squares += ((value - expected) / error.max(least)).powi(2);
                count += 1.0;
            }
        }
    }
    assert!(count > 500.0, "{count} pixels");
    (difference / f64::sqrt(variance + (1e-5_f64 * count).powi(2)), squares / count)
}

/// The point of the floor, y = 0, that a place in the image shows.
fn floor_point(setting: &Setting, px: f32, py: f32) -> Vec3 {
    let direction = setting.camera.frame().ray_direction(px, py);
    setting.camera.eye + direction * (-setting.camera.eye.y / direction.y)
}

/// The visible fraction itself: shadow rays of equal weight, straight from the kernel.
fn fraction(setting: &Setting, x: Vec3, samples: usize, seed: u64) -> f64 {
    use occlude_kernel::{BatchScratch, Targets, Uncounted, offset};
    let bvh = setting.accel.bvh();
    let light = &setting.lights[0];
    let mut sampler = occlude_host::sampler::Sampler::new(seed, 0, 0);
    let mut square = Vec::new();
    sampler.points(Pattern::Jittered, samples, &mut square);
    let points: Vec<Vec3> =
        square.iter().map(|&at| offset(light.point(at), light.normal, bvh.clearance())).collect();
    let [xs, ys, zs] = [0, 1, 2].map(|axis| points.iter().map(|p| p[axis]).collect::<Vec<f32>>());
    let targets = Targets::new(&xs, &ys, &zs).expect("one length");
    let targets = targets.on_parallelogram(light.corner, light.u, light.v);
    let mut blocked = vec![0u64; samples.div_ceil(64)];
    let origin = offset(x, Vec3::Y, bvh.clearance());
    bvh.occluded_batch(origin, &targets, None, &mut Uncounted, &mut BatchScratch::new(), &mut blocked);
    1.0 - blocked.iter().map(|word| f64::from(word.count_ones())).sum::<f64>() / samples as f64
}

/// Jittered samples on an n x n grid miss an area bounded by straight edges by no more than the cells on its edges.
fn check_fraction(name: &str, exact: impl Fn(f64) -> f64, z: f32) {
    let setting = Setting::own(name, Vec3::new(0.0, 20.0, 0.0), Vec3::ZERO, 30.0);
    let (edge, points) = (64usize, 400);
    let mut sum = 0.0;
    for i in 0..points {
        let x = -3.5 + 7.0 * (i as f32 + 0.5) / points as f32;
        let (found, exact) =
            (fraction(&setting, Vec3::new(x, 0.0, z), edge * edge, i as u64), exact(f64::from(x)));
        // Cells cut by up to six edges, each Bernoulli: six standard deviations and the rounding of the planes.
        let deviation = (6.0 * edge as f64 * 0.25).sqrt() / (edge * edge) as f64;
        assert!((found - exact).abs() < 6.0 * deviation + 1e-4, "{name} at {x}: {found} but {exact}");
        sum += found - exact;
    }
    assert!((sum / f64::from(points)).abs() < 5e-4, "{name}: off by {} on average", sum / f64::from(points));
}

#[test]
fn half_plane_has_its_linear_penumbra() {
    check_fraction("half_plane", |x| ((1.0 + x) / 2.0).clamp(0.0, 1.0), 0.3);
}

#[test]
fn fence_shows_its_slats() {
    let covered = |s: f64| {
        let q = (s + 4.0).clamp(0.0, 8.0);
        let whole = (4.0 * q).floor();
        whole / 8.0 + (q - whole / 4.0).min(0.125)
    };
    let fraction = |x: f64| 1.0 - (covered(0.75 * x + 0.1875) - covered(0.75 * x - 0.1875)) / 0.375;
    check_fraction("fence", fraction, -0.2);
}

#[test]
fn plates_shade_what_the_formula_says() {
    let clip = |a: f64, b: f64| (b.min(1.0) - a.max(-1.0)).max(0.0);
    let z = 0.1;
    let shadow = |x: f64, near: f64, far: f64, height: f64| {
        let k = 4.0 / height;
        let across = [(near - x) * k + x, (far - x) * k + x];
        let along = [(-0.6 - z) * k + z, (0.6 - z) * k + z];
        (across, along)
    };
    let area = |(a, b): ([f64; 2], [f64; 2])| clip(a[0], a[1]) * clip(b[0], b[1]);
    let exact = |x: f64| {
        let (a, b) = (shadow(x, -1.6, -0.4, 2.0), shadow(x, -0.1, 1.1, 3.0));
        let both = ([a.0[0].max(b.0[0]), a.0[1].min(b.0[1])], [a.1[0].max(b.1[0]), a.1[1].min(b.1[1])]);
        1.0 - (area(a) + area(b) - area(both)) / 4.0
    };
    check_fraction("plates", exact, z as f32);
}

/// A rectangle above a plane: pixels far from any shadow have Lambert's value.
#[test]
fn a_rectangle_above_a_plane_gives_lambert() {
    for (size, height) in [(0.02f32, 1.0f32), (1.0, 1.0), (4.0, 0.5)] {
        let half = size / 2.0;
        let floor = [[-9.0, 0.0, -9.0], [-9.0, 0.0, 9.0], [9.0, 0.0, 9.0], [9.0, 0.0, -9.0]];
        let light =
            [[-half, height, -half], [half, height, -half], [half, height, half], [-half, height, half]];
        let scene = Scene {
            positions: floor.iter().chain(&light).map(|&p| Vec3::from(p)).collect(),
            triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
            triangle_materials: vec![0, 0, 1, 1],
            materials: vec![
                Material { name: "floor".into(), diffuse: Vec3::splat(0.5), emission: Vec3::ZERO },
                Material { name: "light".into(), diffuse: Vec3::ZERO, emission: Vec3::splat(3.0) },
            ],
            camera: Some(Camera {
                eye: Vec3::new(2.0, 0.4 * height, 0.0),
                target: Vec3::new(1.0, 0.0, 0.0),
                up: Vec3::Y,
                vfov_deg: 40.0,
                width: 32,
                height: 32,
            }),
            ..Scene::default()
        };
        let setting = Setting::of(scene);
        assert_eq!(setting.lights.len(), 1);
        for pattern in PATTERNS {
            let rendered = setting.render(48, 16, pattern, 0, 0);
            let (z, chi2) = deviations(&rendered, |px, py| {
                // The mean over the pixel, by the midpoints of eight by eight parts.
                let parts = 8;
                let mut sum = 0.0;
                for part in 0..parts * parts {
                    let at = |i: u32| (i as f32 + 0.5) / parts as f32;
                    let (dx, dy) = (at(part % parts), at(part / parts));
                    let direction = setting.camera.frame().ray_direction(px as f32 + dx, py as f32 + dy);
                    if direction.y > -0.05 {
                        return None;
                    }
                    let x = floor_point(&setting, px as f32 + dx, py as f32 + dy);
                    if x.abs().max_element() > 8.0 {
                        return None;
                    }
                    sum += f64::from(polygon::irradiance(x, [0.0, 1.0, 0.0], &light));
                }
                Some(0.5 / PI * 3.0 * sum / f64::from(parts * parts))
            });
            assert!(
                z.abs() < 5.0,
                "light of {size} at {height}, {pattern:?}: mean off by {z} standard errors"
            );
            // Patterns correlated between passes only make the error smaller than its estimate.
            assert!(chi2 < 1.5, "light of {size} at {height}, {pattern:?}: chi2 {chi2}");
        }
    }
}

/// Triangles and parallelograms above the horizon, from near and large to far and small, against double precision.
#[test]
fn polygons_are_off_by_some_units_of_what_is_added_up() {
    let mut random = Xoshiro128PlusPlus::seed_from_u64(5);
    let mut next = || (random.next_u32() >> 8) as f32 / (1 << 24) as f32;
    let mut worst = 0.0f64;
    for turn in 0..20_000 {
        let size = (-12.0 * next()).exp2();
        let mut vector = || Vec3::new(next() - 0.5, next() - 0.5, next() - 0.5) * size;
        let (u, v, aside) = (vector(), vector(), vector());
        let corner = aside + Vec3::Z * (1.5 * size + 1e-3 + next());
        let all = [corner, corner + u, corner + u + v, corner + v];
        let corners = &all[..3 + turn % 2];
        // The sum, and what it is made of: a small light far away is what long edges leave of each other.
        let (mut sum, mut angles) = (0.0, 0.0);
        for (i, a) in corners.iter().enumerate() {
            let (a, b) = (a.as_dvec3(), corners[(i + 1) % corners.len()].as_dvec3());
            let across = a.cross(b);
            let angle = across.length().atan2(a.dot(b));
            sum += angle * across.z / across.length();
            angles += angle;
        }
        let vertices: Vec<[f32; 3]> = corners.iter().map(Vec3::to_array).collect();
        let e = f64::from(polygon::irradiance([0.0; 3], [0.0, 0.0, 1.0], &vertices));
        worst = worst.max((e - 0.5 * f64::abs(sum)).abs() / angles);
    }
    let units = worst / f64::from(f32::EPSILON);
    assert!(units < 1.0, "off by {units} units");
}

/// Any thread count and any SIMD level: the same bits.
#[test]
fn threads_and_levels_render_the_same_bits() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes/columns");
    let request = CameraRequest { size: Some((96, 54)), ..CameraRequest::default() };
    let setting = Setting::of(load(&folder, &request).expect("the scene loads"));
    let image = |threads, simd| setting.render(2, 24, Pattern::default(), threads, simd).film.develop();
    let first = image(1, 0);
    for (threads, simd) in [(2, 0), (5, 0), (1, 1), (3, 2), (2, 3)] {
        assert_eq!(first.pixels, image(threads, simd).pixels, "{threads} threads, level {simd}");
    }
}
