//! Plates under a square light, over a floor seen from above: visibility and irradiance in closed form.
//!
//! All is parallel to the floor, so what a plate hides of the light from a point of the floor is a rectangle in the
//! plane of the light, and what is left of the light is rectangles as well.

use crate::film::Image;
use crate::reproduce::{Halted, Run};
use crate::sampler::{Pattern, Sampler};
use occlude_kernel::decomposition::Joint;
use rayon::prelude::*;
use std::cell::Cell;

/// From and to, along x and along z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rectangle {
    pub(super) x: [f64; 2],
    pub(super) z: [f64; 2],
}

impl Rectangle {
    pub(super) const fn centred(x: f64, z: f64, half: f64) -> Self {
        Self { x: [x - half, x + half], z: [z - half, z + half] }
    }

    fn clipped(self, to: Self) -> Self {
        let clip = |[a, b]: [f64; 2], [low, high]: [f64; 2]| [a.clamp(low, high), b.clamp(low, high)];
        Self { x: clip(self.x, to.x), z: clip(self.z, to.z) }
    }

    pub(super) fn area(self) -> f64 {
        (self.x[1] - self.x[0]) * (self.z[1] - self.z[0])
    }

    fn contains(self, x: f64, z: f64) -> bool {
        self.x[0] <= x && x <= self.x[1] && self.z[0] <= z && z <= self.z[1]
    }
}

/// Plates, a light above them, and the part of the floor that is looked at.
#[derive(Clone, Debug)]
pub(super) struct Plates {
    pub(super) light: Rectangle,
    pub(super) light_height: f64,
    /// Each with its height.
    pub(super) plates: Vec<(Rectangle, f64)>,
    pub(super) view: Rectangle,
    /// Pixels along x.
    pub(super) width: u32,
    /// Pixels along z.
    pub(super) height: u32,
}

impl Plates {
    pub(super) fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The middle of a pixel, on the floor; z grows downwards.
    pub(super) fn point(&self, pixel: usize) -> (f64, f64) {
        let (column, row) = (pixel % self.width as usize, pixel / self.width as usize);
        let along =
            |[from, to]: [f64; 2], i: usize, of: u32| from + (to - from) * (i as f64 + 0.5) / f64::from(of);
        (along(self.view.x, column, self.width), along(self.view.z, row, self.height))
    }

    /// The point of the light for two numbers from 0 to 1.
    fn on_light(&self, [s, t]: [f32; 2]) -> [f64; 2] {
        let along = |[from, to]: [f64; 2], share: f32| from + (to - from) * f64::from(share);
        [along(self.light.x, s), along(self.light.z, t)]
    }

    /// What a plate hides of the light from a point of the floor.
    fn hidden(&self, plate: usize, x: f64, z: f64) -> Rectangle {
        let (rectangle, height) = self.plates[plate];
        let k = self.light_height / height;
        let project = |[a, b]: [f64; 2], from: f64| [from + (a - from) * k, from + (b - from) * k];
        Rectangle { x: project(rectangle.x, x), z: project(rectangle.z, z) }.clipped(self.light)
    }

    /// Whether a plate lets a point of the floor see a point of the light.
    fn visible(&self, plate: usize, x: f64, z: f64, [u, w]: [f64; 2]) -> bool {
        let (rectangle, height) = self.plates[plate];
        let along = height / self.light_height;
        !rectangle.contains(x + (u - x) * along, z + (w - z) * along)
    }

    /// Irradiance from a part of the light, of radiance 1.
    fn irradiance(&self, part: Rectangle, x: f64, z: f64) -> f64 {
        let h = self.light_height;
        // Of a rectangle with a corner straight above, by Lambert.
        let corner = |a: f64, b: f64| {
            let (ra, rb) = (a.hypot(h), b.hypot(h));
            0.5 * (a / ra * (b / ra).atan() + b / rb * (a / rb).atan())
        };
        let [x0, x1] = part.x.map(|at| at - x);
        let [z0, z1] = part.z.map(|at| at - z);
        corner(x1, z1) - corner(x0, z1) - corner(x1, z0) + corner(x0, z0)
    }

    /// The irradiance straight below the middle of the light, if nothing is in the way: what counts as 1.
    fn unit(&self) -> f64 {
        let middle = |[from, to]: [f64; 2]| 0.5 * (from + to);
        self.irradiance(self.light, middle(self.light.x), middle(self.light.z))
    }

    /// The parts of the light between the edges of all shadows, with the plates that hide each.
    fn parts(&self, x: f64, z: f64) -> impl Iterator<Item = (Rectangle, u32)> {
        let hidden: Vec<Rectangle> = (0..self.plates.len()).map(|plate| self.hidden(plate, x, z)).collect();
        let cuts = |of: fn(&Rectangle) -> [f64; 2]| {
            let mut cuts: Vec<f64> = hidden.iter().chain([&self.light]).flat_map(of).collect();
            cuts.sort_by(f64::total_cmp);
            cuts
        };
        let (xs, zs) = (cuts(|r| r.x), cuts(|r| r.z));
        let cells =
            xs.windows(2).flat_map(|x| zs.windows(2).map(|z| Rectangle { x: [x[0], x[1]], z: [z[0], z[1]] }));
        let cells: Vec<Rectangle> = cells.filter(|cell| cell.area() > 0.0).collect();
        cells.into_iter().map(move |cell| {
            let (x, z) = (0.5 * (cell.x[0] + cell.x[1]), 0.5 * (cell.z[0] + cell.z[1]));
            let by = hidden.iter().enumerate().filter(|(_, hidden)| hidden.contains(x, z));
            (cell, by.fold(0, |set, (plate, _)| set | 1 << plate))
        })
    }

    /// Irradiance in units of the greatest there could be.
    pub(super) fn reference(&self, pixel: usize) -> f64 {
        let (x, z) = self.point(pixel);
        let seen = self.parts(x, z).filter(|(_, by)| *by == 0);
        seen.map(|(part, _)| self.irradiance(part, x, z)).sum::<f64>() / self.unit()
    }

    /// How (V_A, V_B) is distributed over the light, with the first plate as A and all others as B.
    pub(super) fn joint(&self, pixel: usize) -> Option<Joint> {
        let (x, z) = self.point(pixel);
        let mut weights = [0.0; 4];
        for (part, by) in self.parts(x, z) {
            let (a, b) = (by & 1 == 0, by & !1 == 0);
            weights[usize::from(a) << 1 | usize::from(b)] += part.area();
        }
        Joint::new(weights)
    }

    /// A picture: for each pixel the sum of estimates over its light samples, and the plates asked.
    ///
    /// `way` gets a pixel, and random numbers that do not depend on those of the light samples; these are the same
    /// for every way.
    pub(super) fn picture(
        &self,
        run: &Run<'_>,
        pattern: Pattern,
        rays: u32,
        way: impl Fn(&Pixel<'_>, &mut Sampler) -> f64 + Sync,
    ) -> Result<Painted, Halted> {
        let unit = self.unit();
        let pixels: Vec<Option<(f64, u32)>> = (0..self.pixels())
            .into_par_iter()
            .map_init(Vec::new, |square, at| {
                if at % 256 == 0 {
                    run.go_on().ok()?;
                }
                square.clear();
                Sampler::new(run.seed, at as u64, rays).points(pattern, rays as usize, square);
                let points: Vec<[f64; 2]> = square.iter().map(|&at| self.on_light(at)).collect();
                let (x, z) = self.point(at);
                let pixel = Pixel { plates: self, x, z, points, asked: Cell::new(0) };
                let mut random = Sampler::new(!run.seed, at as u64, rays);
                let sum = way(&pixel, &mut random);
                Some((sum / unit, pixel.asked.get()))
            })
            .collect();
        let pixels: Option<Vec<(f64, u32)>> = pixels.into_iter().collect();
        let (values, asked) = pixels.ok_or(Halted::Interrupted)?.into_iter().unzip();
        Ok(Painted { values, asked })
    }

    /// Grey values as an image.
    pub(super) fn image(&self, values: &[f64]) -> Image {
        Image::from_fn(self.width, self.height, |x, y| {
            [values.get((y * self.width + x) as usize).map_or(0.0, |&value| value as f32); 3]
        })
    }
}

/// A picture, and the plates that were asked for each pixel.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Painted {
    pub(super) values: Vec<f64>,
    pub(super) asked: Vec<u32>,
}

impl Painted {
    /// Root mean square difference over the pixels chosen.
    pub(super) fn rmse(&self, reference: &[f64], chosen: impl Fn(usize) -> bool) -> f64 {
        let pixels = self.values.iter().zip(reference).enumerate().filter(|(i, _)| chosen(*i));
        let (sum, count) = pixels.fold((0.0, 0u32), |(sum, count), (_, (value, truth))| {
            (sum + (value - truth).powi(2), count + 1)
        });
        (sum / f64::from(count)).sqrt()
    }

    /// Plates asked a ray, over the pixels chosen.
    pub(super) fn asked_a_ray(&self, rays: u32, chosen: impl Fn(usize) -> bool) -> f64 {
        let pixels = self.asked.iter().enumerate().filter(|(i, _)| chosen(*i));
        let (sum, count) =
            pixels.fold((0u64, 0u64), |(sum, count), (_, &asked)| (sum + u64::from(asked), count + 1));
        sum as f64 / (count as f64 * f64::from(rays))
    }
}

/// A point of the floor and its light samples.
pub(super) struct Pixel<'a> {
    plates: &'a Plates,

    x: f64,
    z: f64,
    points: Vec<[f64; 2]>,
    asked: Cell<u32>,
}

impl Pixel<'_> {
    /// How many light samples there are.
    pub(super) fn rays(&self) -> usize {
        self.points.len()
    }

    /// Whether a plate lets light sample `k` through. Counted.
    pub(super) fn visible(&self, plate: usize, k: usize) -> bool {
        self.visible_at(plate, self.points[k])
    }

    /// The same for a point of the light of one's own.
    pub(super) fn test(&self, plate: usize, at: [f32; 2]) -> bool {
        self.visible_at(plate, self.plates.on_light(at))
    }

    fn visible_at(&self, plate: usize, point: [f64; 2]) -> bool {
        self.asked.set(self.asked.get() + 1);
        self.plates.visible(plate, self.x, self.z, point)
    }

    /// The irradiance by these estimates of the visibility of each light sample.
    pub(super) fn sum(&self, mut estimate: impl FnMut(usize) -> f64) -> f64 {
        let h2 = self.plates.light_height.powi(2);
        let each = self.plates.light.area() / self.points.len() as f64;
        let weight = |[u, w]: [f64; 2]| {
            let squared = (u - self.x).powi(2) + (w - self.z).powi(2) + h2;
            each * h2 / (squared * squared)
        };
        (0..self.points.len()).map(|k| weight(self.points[k]) * estimate(k)).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reproduce::theory::tests::run;
    use occlude_kernel::polygon;

    fn two() -> Plates {
        Plates {
            light: Rectangle::centred(0.1, -0.2, 0.7),
            light_height: 4.0,
            plates: vec![
                (Rectangle::centred(-0.7, -0.2, 0.6), 1.5),
                (Rectangle::centred(0.5, 0.3, 0.6), 2.0),
            ],
            view: Rectangle { x: [-3.0, 3.0], z: [-2.0, 2.0] },
            width: 60,
            height: 40,
        }
    }

    #[test]
    fn irradiance_is_that_of_the_kernel() {
        let plates = two();
        let Rectangle { x: [x0, x1], z: [z0, z1] } = plates.light;
        let corners = [[x0, z0], [x1, z0], [x1, z1], [x0, z1]].map(|[x, z]| [x as f32, 4.0, z as f32]);
        for (x, z) in [(0.0, 0.0), (2.0, -1.0), (-5.0, 3.0)] {
            let closed = plates.irradiance(plates.light, x, z);
            let kernel = polygon::irradiance([x as f32, 0.0, z as f32], [0.0, 1.0, 0.0], &corners);
            assert!((closed - f64::from(kernel)).abs() < 1e-6, "{closed} {kernel}");
        }
    }

    /// Rays of their own, 4096 a pixel in strata, against the closed forms of irradiance and of (V_A, V_B).
    #[test]
    fn rays_agree_with_the_closed_forms() {
        let stop = std::sync::atomic::AtomicBool::new(false);
        let plates = Plates { width: 12, height: 8, ..two() };
        let exact = |pixel: &Pixel<'_>, _: &mut Sampler| {
            pixel.sum(|k| f64::from(u8::from(pixel.visible(0, k) && pixel.visible(1, k))))
        };
        let painted = plates.picture(&run(&stop), Pattern::Jittered, 4096, exact).expect("nobody stops it");
        let reference: Vec<f64> = (0..plates.pixels()).map(|pixel| plates.reference(pixel)).collect();
        assert!(painted.rmse(&reference, |_| true) < 1e-3, "{}", painted.rmse(&reference, |_| true));
        let worst = painted.values.iter().zip(&reference).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(worst < 5e-3, "{worst}");
        let mut partly = 0;
        for pixel in 0..plates.pixels() {
            let joint = plates.joint(pixel).expect("a light has an area");
            let seen = Cell::new([0.0; 4]);
            let (x, z) = plates.point(pixel);
            let count = 64;
            for i in 0..count * count {
                let at = [i % count, i / count].map(|i| (i as f32 + 0.5) / count as f32);
                let light = plates.on_light(at);
                let (a, b) = (plates.visible(0, x, z, light), plates.visible(1, x, z, light));
                let mut all = seen.get();
                all[usize::from(a) << 1 | usize::from(b)] += 1.0 / f64::from(count * count);
                seen.set(all);
            }
            for (closed, seen) in joint.chances().iter().zip(seen.get()) {
                assert!((closed - seen).abs() < 0.05, "{pixel}: {closed} {seen}");
                partly += usize::from(*closed > 0.05 && *closed < 0.95);
            }
        }
        assert!(partly > 20, "the view should show penumbrae: {partly}");
    }
}
