//! Which pixels get camera samples, and how many shadow rays these get, from what was seen in earlier rounds.
//!
//! The variance of a sample of a pixel has two parts. Shadow rays make one, and more rays a sample make it less; the other
//! is of the place in the pixel, of edges and of what lies behind them, and only more samples make that less. A film that
//! [listens](Film::listening) tells them apart. With `e` of edges and `s` at one ray, samples of `r` rays leave
//!
//! ```text
//!     v(r) = e + s r^-1.5        at the cost        c(r) = 10 + r
//! ```
//!
//! in shadow rays (the power is that of points spread well over a border; 10 is what a sample costs beside its rays, where
//! one of them costs what most do). So each pixel has the number of rays with the least `v c`, and samples in proportion
//! to `sqrt(v / c)`. That is how a given work makes the least squared error (Neyman 1934, and with costs Cochran, Sampling
//! Techniques, 1977, section 5.5).
//!
//! A pixel's squared error counts the less the brighter it is. With 16 samples of four shared scenes that changes the RMSE by
//! 3 % at most, the relative squared error to 0.67 to 1.15 of what it was and FLIP to 0.93 to 1.03.
//!
//! As samples are spread over a pixel, too, its edges matter the less the more there are: `e` counts as `e / sqrt(n)`. They
//! are the beginning of a (0, 2)-sequence, which is spread best when their number is a power of two.

use crate::film::{Film, Heard, Tile};
use glam::DVec3;
use rayon::prelude::*;

/// The samples of a pixel in a round.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Due {
    /// How many.
    pub(crate) samples: u32,
    /// The shadow rays of each.
    pub(crate) rays: u32,
}

/// Passes over everything before anything is known.
pub(crate) const FIRST: u32 = 4;

/// With fewer passes than this there is nothing to be gained.
pub(crate) const FEWEST: u32 = 2 * FIRST;

/// What each of the first passes counts: where samples are needed most, theirs are few.
pub(crate) const FIRST_WEIGHT: f64 = 0.05;

/// What a camera sample costs beside its shadow rays, in shadow rays. Of nine scenes at 16 rays, 5 to 24 do as well.
const CAMERA: f32 = 10.0;

/// Times the passes of a round that a pixel can have as samples at most, from and to, so that the rays of one pass of a pixel
/// are no more than so many, unless they are with the fewest: what a tile asks in a pass is in memory at once.
const MOST: [u32; 2] = [16, 256];
const MOST_RAYS: u32 = 16_384;

/// More samples than this are rounded to a power of two, which for the same work leaves 0.89 of the squared error at 64
/// passes and 0.78 at 32 (six scenes).
const AS_THEY_ARE: f32 = 6.0;

/// Numbers, or powers of two, are rounded up half this sooner or later, from pixel to pixel, so that work is shared out to
/// the end where pixels are alike.
const TIES: f32 = 0.25;

/// A pixel counts as if this part of the mean deviation were its own, so that what no sample has found yet is found.
const FLOOR: f32 = 0.2;

/// The same of what rays add: there is less to be found, and more rays where nothing is are dear.
const NOISE_FLOOR: f32 = 0.05;

/// As many samples of a pixel say as much about its edges as those around it do, up to so many pixels away.
const EDGE_TRUST: [usize; 2] = [8, 1];

/// The same about what rays add. The far end of a penumbra sends little light, but few rays see any of it, and where none did
/// those around must tell, or some dots are left in the dark. With 16 samples of six shared scenes the relative squared error
/// is 0.45 of that with [`EDGE_TRUST`], the RMSE 0.97 and FLIP 0.96.
const NOISE_TRUST: [usize; 2] = [32, 3];

/// Turns until samples and rays fit each other.
const TURNS: u32 = 4;

/// Shadow rays of a sample in the first passes: enough to tell what rays add.
pub(crate) fn first_rays(usual: u32) -> u32 {
    (usual / 4).max(usual.min(4))
}

/// Halvings until rounded numbers cost what they may.
const HALVINGS: u32 = 10;

/// From 0 to 1, spread over pixels so that those around any have about as many of each (the R2 sequence, Roberts 2018).
fn dither(x: usize, y: usize) -> f32 {
    (0.754_877_67 * x as f64 + 0.569_840_3 * y as f64).fract() as f32
}

/// Sums over the samples of a pixel.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    samples: f32,
    /// Their mean, and summed squared distances from it.
    mean: DVec3,
    deviation: f64,
    /// The power -1.5 of their rays.
    power: f32,
    /// The rays that they were due.
    due: f32,
    heard: Heard,
}

impl Seen {
    fn add(&mut self, count: u32, rays: u32, (mean, deviation): (DVec3, f64), heard: &Heard) {
        let (n, rays) = (count as f32, rays as f32);
        let (before, added) = (f64::from(self.samples), f64::from(n));
        let off = mean - self.mean;
        self.deviation += deviation + off.length_squared() * (before * added / (before + added));
        self.mean += off * (added / (before + added));
        self.samples += n;
        self.power += n / (rays * rays.sqrt());
        self.due += n * rays;
        self.heard += *heard;
    }

    fn model(&self) -> Model {
        let (n, heard) = (self.samples, &self.heard);
        if n < 2.0 {
            return Model::default();
        }
        let variance = (self.deviation / f64::from(n - 1.0)) as f32;
        let power = self.power / n;
        // What single rays add cannot be told from edges: all that it may be counts as noise.
        let (known, unknown) =
            if heard.all > 0.0 { (heard.noise / n, 1.0 - heard.known / heard.all) } else { (0.0, 0.0) };
        let more = unknown.clamp(0.0, 1.0) * (variance / power - known).max(0.0);
        let noise = known + more.min(heard.most / n);
        // What is not finite, of light that is not, must not tell others what they get.
        let finite = |x: f32| if x.is_finite() { x } else { 0.0 };
        Model {
            edge: finite((variance - noise * power).max(0.0)),
            noise: finite(noise),
            all: finite(heard.all / n),
            each: finite(heard.each / n),
            asked: heard.rays / self.due,
        }
    }
}

/// The variance of a sample, and what it costs, by its rays.
#[derive(Clone, Copy, Debug, Default)]
struct Model {
    edge: f32,
    /// At one ray.
    noise: f32,
    /// Squared light, and the same over the rays of its light at one ray a sample: of lights that are left out at random.
    all: f32,
    each: f32,
    /// Rays that are asked for each that is due.
    asked: f32,
}

impl Model {
    fn shadow(&self, rays: f32) -> f32 {
        self.noise / (rays * rays.sqrt()) + (self.each / rays - self.all).max(0.0)
    }

    fn cost(&self, rays: f32) -> f32 {
        CAMERA + self.asked * rays
    }

    /// The best number of rays of these, and in proportion to what there should be of such samples if there are about `n`.
    fn choose(&self, choices: &[f32], n: f32) -> (f32, f32) {
        let edge = self.edge / n.sqrt();
        let product = |rays: f32| (edge + self.shadow(rays)) * self.cost(rays);
        let better = |a: f32, b: f32| if product(b) < product(a) { b } else { a };
        let rays = choices.iter().copied().reduce(better).unwrap_or(1.0);
        // The derivative of e n^-1.5 + s n^-1.
        (((1.5 * edge + self.shadow(rays)) / self.cost(rays)).sqrt(), rays)
    }
}

/// What is known of each pixel of an image.
#[derive(Debug)]
pub(crate) struct Needs {
    width: usize,
    height: usize,
    seen: Vec<Seen>,
}

impl Needs {
    /// What a pixel takes, bytes, with what is due to it.
    pub(crate) const BYTES_A_PIXEL: usize = size_of::<Seen>() + size_of::<Due>();

    /// Nothing yet.
    pub(crate) fn new(width: u32, height: u32) -> Self {
        let (width, height) = (width as usize, height as usize);
        Self { width, height, seen: vec![Seen::default(); width * height] }
    }

    /// Takes in a round; `rays` says how many the samples of each pixel of each tile had.
    ///
    /// # Panics
    /// If the film is larger or does not listen.
    pub(crate) fn learn(&mut self, film: &Film, rays: impl Fn(usize, usize) -> u32) {
        for (index, tile) in film.tiles().iter().enumerate() {
            for pixel in (0..tile.tile().len()).filter(|&pixel| tile.count(pixel) > 0) {
                let (x, y) = tile.tile().position(pixel);
                let seen = &mut self.seen[y as usize * self.width + x as usize];
                seen.add(tile.count(pixel), rays(index, pixel), tile.spread(pixel), tile.heard(pixel));
            }
        }
    }

    /// Counts bright pixels less: squared errors over `1 + L / typical`, so that lights in sight do not take all there is.
    fn dim(&self, models: &mut [Model]) {
        let light = |seen: &Seen| {
            let light = seen.mean.element_sum();
            if light.is_finite() { light.max(0.0) } else { 0.0 }
        };
        let roots: f64 = self.seen.iter().map(|seen| light(seen).sqrt()).sum();
        let typical = (roots / self.seen.len().max(1) as f64).powi(2);
        if typical > 0.0 {
            for (model, seen) in models.iter_mut().zip(&self.seen) {
                let counts = (1.0 / (1.0 + light(seen) / typical)) as f32;
                for part in [&mut model.edge, &mut model.noise, &mut model.all, &mut model.each] {
                    *part *= counts;
                }
            }
        }
    }

    /// Of all pixels, each with a part of what those around it know.
    fn models(&self) -> Vec<Model> {
        let (width, height) = (self.width, self.height);
        let own: Vec<Model> = self.seen.par_iter().map(Seen::model).collect();
        let mut models: Vec<Model> = (0..own.len())
            .into_par_iter()
            .with_min_len(width.max(1))
            .map(|at| {
                let (x, y) = (at % width, at / width);
                let around = |reach: usize, of: fn(&Model) -> f32| {
                    let rows = y.saturating_sub(reach)..(y + reach + 1).min(height);
                    let columns = x.saturating_sub(reach)..(x + reach + 1).min(width);
                    let count = rows.len() * columns.len();
                    rows.flat_map(|y| &own[y * width..][columns.clone()]).map(of).sum::<f32>() / count as f32
                };
                let samples = self.seen[at].samples;
                let mix = |[trust, reach]: [usize; 2], of: fn(&Model) -> f32| {
                    let own_part = samples / (samples + trust as f32);
                    own_part * of(&own[at]) + (1.0 - own_part) * around(reach, of)
                };
                let (edge, noise) = (mix(EDGE_TRUST, |near| near.edge), mix(NOISE_TRUST, |near| near.noise));
                Model { edge, noise, ..own[at] }
            })
            .collect();
        self.dim(&mut models);
        let mean = |of: fn(&Model) -> f32| {
            let sum: f64 = models.iter().map(|model| f64::from(of(model).sqrt())).sum();
            (sum / models.len().max(1) as f64) as f32
        };
        let (edge, noise) = (mean(|model| model.edge), mean(|model| model.noise));
        for model in &mut models {
            // Where nothing at all was seen, all is alike.
            model.edge += (FLOOR * edge).powi(2).max(1e-30);
            model.noise += (NOISE_FLOOR * noise).powi(2);
        }
        models
    }

    /// What the pixels of the tiles are due in a round that costs as much as so many passes of the usual rays; each has one
    /// sample at least. If it is the last one samples may have a single ray, which tells nothing that later ones could use.
    pub(crate) fn share(&self, tiles: &[Tile], passes: u32, usual: u32, last: bool) -> Vec<Vec<Due>> {
        let models = self.models();
        let least = if last { 1 } else { first_rays(usual) };
        let half = |rays: &u32| Some(rays / 2).filter(|half| *half >= least);
        let halves = std::iter::successors(Some(usual.max(1)), half);
        let choices: Vec<f32> = halves.map(|rays| rays as f32).collect();
        let most =
            ((MOST_RAYS / usual.max(1)).clamp(MOST[0], MOST[1]) as f32 * passes as f32).log2().floor().exp2();
        // Sums in the order of pixels, whatever the threads.
        let sum = |costs: Vec<f32>| costs.into_iter().map(f64::from).sum::<f64>();
        let budget = sum(models.iter().map(|model| model.cost(usual as f32)).collect()) * f64::from(passes);
        let scaled = |cost: f64| if cost > 0.0 { (budget / cost) as f32 } else { 1.0 };
        let mut due = vec![(passes as f32, usual as f32); models.len()];
        let mut scale = 1.0f32;
        for _ in 0..TURNS {
            let costs = due.par_iter_mut().zip(&models).with_min_len(1024).map(|(due, model)| {
                *due = model.choose(&choices, (due.0 * scale).max(1.0).min(most));
                due.0 * model.cost(due.1)
            });
            scale = scaled(sum(costs.collect()));
        }
        let width = self.width;
        let rounded = |at: usize, scale: f32| {
            let (samples, later) = (due[at].0 * scale, TIES * (dither(at % width, at / width) - 0.5));
            let whole = if samples > AS_THEY_ARE {
                (samples.log2() + later).round().exp2()
            } else {
                (samples + later).round()
            };
            // One if it is not a number.
            whole.max(1.0).min(most)
        };
        // Between half and twice as much, by halves.
        let (mut low, mut high) = (0.5 * scale, 2.0 * scale);
        for _ in 0..HALVINGS {
            scale = (low * high).sqrt();
            let costs = models.par_iter().zip(&due).enumerate().with_min_len(1024);
            let costs = costs.map(|(at, (model, due))| rounded(at, scale) * model.cost(due.1));
            *(if sum(costs.collect()) > budget { &mut high } else { &mut low }) = scale;
        }
        scale = low;
        let of = |(x, y): (u32, u32)| {
            let at = y as usize * width + x as usize;
            Due { samples: rounded(at, scale) as u32, rays: due[at].1 as u32 }
        };
        tiles.iter().map(|tile| (0..tile.len()).map(|pixel| of(tile.position(pixel))).collect()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A pixel whose samples have so much variance of edges and, at one ray, of rays; ten samples of four rays.
    fn seen(edge: f32, noise: f32) -> Seen {
        let variance = f64::from(edge + noise / 8.0);
        let heard = Heard { rays: 40.0, all: 10.0, known: 10.0, noise: 10.0 * noise, most: 0.0, each: 2.5 };
        let mut seen = Seen::default();
        seen.add(10, 4, (DVec3::ONE, 9.0 * variance), &heard);
        seen
    }

    fn needs(pixels: &[Seen]) -> Needs {
        Needs { width: pixels.len(), height: 1, seen: pixels.to_vec() }
    }

    #[test]
    fn edges_and_rays_are_told_apart() {
        let model = seen(2.0, 16.0).model();
        assert!((model.edge - 2.0).abs() < 1e-5 && (model.noise - 16.0).abs() < 1e-5, "{model:?}");
        assert_eq!(model.asked, 1.0);
        // Of batches of one ray nothing is known: all of the variance may be theirs, but no more than the square of what
        // they saw.
        let mut single = seen(2.0, 16.0);
        (single.heard.known, single.heard.noise, single.heard.most) = (0.0, 0.0, 1e6);
        let model = single.model();
        assert!(model.edge < 1e-4 && (model.noise - 32.0).abs() < 1e-4, "{model:?}");
        single.heard.most = 80.0;
        let model = single.model();
        assert!((model.edge - 3.0).abs() < 1e-4 && (model.noise - 8.0).abs() < 1e-4, "{model:?}");
    }

    #[test]
    fn rounds_are_added_up_like_one() {
        let values = [1.0, 4.0, 2.0, 8.0, 5.0, 7.0];
        let of = |values: &[f64]| {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            (DVec3::splat(mean), values.iter().map(|value| 3.0 * (value - mean).powi(2)).sum::<f64>())
        };
        let mut seen = Seen::default();
        for part in [&values[..1], &values[1..4], &values[4..]] {
            seen.add(part.len() as u32, 4, of(part), &Heard::default());
        }
        let (mean, deviation) = of(&values);
        assert!((seen.mean - mean).length() < 1e-12 && (seen.deviation - deviation).abs() < 1e-9, "{seen:?}");
        assert_eq!((seen.samples, seen.due), (6.0, 24.0));
    }

    #[test]
    fn a_round_costs_what_it_may_and_goes_where_it_helps() {
        let mut pixels = vec![seen(0.0, 0.0); 64];
        (pixels[8], pixels[40]) = (seen(10.0, 0.01), seen(0.01, 10.0));
        let tiles = [Tile { x: 0, y: 0, width: 32, height: 1 }, Tile { x: 32, y: 0, width: 32, height: 1 }];
        for (passes, usual) in [(8, 16), (4, 64), (100, 1)] {
            let shares = needs(&pixels).share(&tiles, passes, usual, true);
            assert!(shares.iter().flatten().all(|due| due.samples >= 1 && (1..=usual).contains(&due.rays)));
            assert!(shares.iter().flatten().all(|due| due.samples < 7 || due.samples.is_power_of_two()));
            let cost: f32 =
                shares.iter().flatten().map(|due| due.samples as f32 * (CAMERA + due.rays as f32)).sum();
            let may = 64.0 * passes as f32 * (CAMERA + usual as f32);
            assert!((0.8..1.1).contains(&(cost / may)), "{passes} passes of {usual}: {cost} of {may}");
            let (edge, noisy, calm) = (shares[0][8], shares[1][8], shares[0][20]);
            assert!(
                edge.samples > 4 * calm.samples.max(2) && noisy.samples > calm.samples,
                "{edge:?} {noisy:?} {calm:?}"
            );
            let before = needs(&pixels).share(&tiles, passes, usual, false);
            assert!(before.iter().flatten().all(|due| (first_rays(usual)..=usual).contains(&due.rays)));
            assert!(edge.rays <= noisy.rays && noisy.rays == usual && (usual == 1 || edge.rays < usual));
        }
    }

    #[test]
    fn what_rays_add_is_looked_for_three_pixels_away_and_edges_one() {
        let due = |edge: f32, noise: f32| {
            let mut pixels = vec![seen(0.0, 0.0); 64];
            pixels[8] = seen(edge, noise);
            let tiles = [Tile { x: 0, y: 0, width: 64, height: 1 }];
            needs(&pixels).share(&tiles, 16, 16, true).remove(0)
        };
        let work = |due: &Due| due.samples * (CAMERA as u32 + due.rays);
        let (edges, noise) = (due(10.0, 0.0), due(0.0, 10.0));
        assert!(work(&noise[11]) > 2 * work(&noise[12]), "{:?} {:?}", noise[11], noise[12]);
        assert!(work(&edges[9]) > 2 * work(&edges[10]), "{:?} {:?}", edges[9], edges[10]);
    }

    #[test]
    fn where_all_is_alike_all_get_about_the_same_and_black_is_no_trouble() {
        for pixel in [seen(0.0, 0.0), seen(1.0, 1.0), Seen::default()] {
            let tiles = [Tile { x: 0, y: 0, width: 5, height: 1 }];
            let shares = needs(&[pixel; 5]).share(&tiles, 4, 16, true);
            let rays = shares[0][0].rays;
            assert!(
                shares[0].iter().all(|due| due.rays == rays && (4..=8).contains(&due.samples)),
                "{shares:?}"
            );
        }
        assert!(Needs::new(0, 0).share(&[], 4, 16, true).is_empty());
    }

    #[test]
    fn light_that_is_no_number_leaves_the_others_theirs() {
        let heard = |x: f32| Heard { rays: 40.0, all: x, known: x, noise: x, most: 0.0, each: x };
        for bad in [f64::NAN, f64::INFINITY, 1e60] {
            let mut pixels = vec![seen(1.0, 1.0); 16];
            pixels[3] = Seen::default();
            pixels[3].add(10, 4, (DVec3::splat(bad), bad), &heard(bad as f32));
            pixels[4].heard.noise = f32::INFINITY;
            let tiles = [Tile { x: 0, y: 0, width: 16, height: 1 }];
            let shares = needs(&pixels).share(&tiles, 8, 16, true);
            assert!(shares[0].iter().all(|due| due.samples >= 1), "{bad}: {shares:?}");
            assert!(shares[0][8..].iter().all(|due| (2..=32).contains(&due.samples)), "{bad}: {shares:?}");
        }
    }

    #[test]
    fn with_many_rays_no_pixel_has_too_many_samples() {
        let mut pixels = vec![seen(0.0, 0.0); 4096];
        pixels[8] = seen(1e6, 1e6);
        let tiles = [Tile { x: 0, y: 0, width: 4096, height: 1 }];
        for (usual, most) in [(1, 256), (64, 256), (256, 64), (1024, 16), (65_536, 16)] {
            let due = needs(&pixels).share(&tiles, 4, usual, true)[0][8];
            assert_eq!(due.samples, 4 * most, "{usual} rays: {due:?}");
        }
    }
}
