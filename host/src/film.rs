//! What radiance is added to: the mean and the variance of every pixel.
//!
//! Pixels live tile by tile, each [`TileFilm`] owning its own, so that a thread
//! is handed one tile of [`Film::tiles_mut`] and shares nothing. Nothing here
//! clamps: estimates may be negative or above one, and an average of clamped
//! estimates would be biased.

use glam::{DVec3, Vec3};

/// A rectangle of pixels, rows from the top.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Tile {
    /// The leftmost column.
    pub x: u32,
    /// The topmost row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Tile {
    /// Tiles of `edge` by `edge` pixels that cover an image, row by row.
    ///
    /// Those at the right and at the bottom are as small as what is left. An edge of 0 counts as 1.
    pub fn cover(width: u32, height: u32, edge: u32) -> impl Iterator<Item = Tile> {
        let edge = edge.max(1);
        (0..height.div_ceil(edge)).flat_map(move |row| {
            (0..width.div_ceil(edge)).map(move |column| {
                let (x, y) = (column * edge, row * edge);
                Tile { x, y, width: edge.min(width - x), height: edge.min(height - y) }
            })
        })
    }

    /// How many pixels it has.
    pub fn len(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Whether it has none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Column and row in the image of its `pixel`th pixel, which are counted row by row.
    pub fn position(&self, pixel: usize) -> (u32, u32) {
        let width = self.width as usize;
        (self.x + (pixel % width) as u32, self.y + (pixel / width) as u32)
    }
}

/// Where a pixel comes along a Z curve (Morton 1966): neighbours on the curve are neighbours in the picture.
pub fn z_order(x: u32, y: u32) -> u64 {
    let spread = |v: u32| {
        let mut v = u64::from(v);
        for shift in [16, 8, 4, 2, 1] {
            v = (v | v << shift) & MASKS[usize::ilog2(shift) as usize];
        }
        v
    };
    /// Every second bit, pair of bits, and so on.
    const MASKS: [u64; 5] = [
        0x5555_5555_5555_5555,
        0x3333_3333_3333_3333,
        0x0f0f_0f0f_0f0f_0f0f,
        0x00ff_00ff_00ff_00ff,
        0x0000_ffff_0000_ffff,
    ];
    spread(x) | spread(y) << 1
}

/// Mean and summed squared deviation of one pixel.
///
/// Welford, "Note on a Method for Calculating Corrected Sums of Squares and Products", Technometrics 4(3), 1962.
#[derive(Clone, Copy, Debug, Default)]
struct Accumulator {
    mean: DVec3,
    deviation: DVec3, // sum of squares about the mean
    count: u32,
}

impl Accumulator {
    fn add(&mut self, radiance: DVec3) {
        self.count += 1;
        let before = radiance - self.mean;
        self.mean += before / f64::from(self.count);
        self.deviation += before * (radiance - self.mean);
    }

    /// Becomes the weighted mean of itself and another of the same pixel. Where the other had one sample only, its
    /// variance is taken from the samples here.
    fn merge(&mut self, own: f64, other: &Self, weight: f64) {
        if other.count == 0 {
            return;
        }
        if self.count == 0 {
            *self = *other;
            return;
        }
        let (a, b) = (own / (own + weight), weight / (own + weight));
        let its = if other.count < 2 { self.variance_of_sample() } else { other.variance_of_mean() };
        let variance = a * a * self.variance_of_mean() + b * b * its;
        self.mean = a * self.mean + b * other.mean;
        self.count += other.count;
        let n = f64::from(self.count);
        self.deviation = variance * n * (n - 1.0);
    }

    /// Of one sample, as far as is known.
    fn variance_of_sample(&self) -> DVec3 {
        self.variance_of_mean() * f64::from(self.count)
    }

    fn variance_of_mean(&self) -> DVec3 {
        if self.count < 2 {
            return DVec3::ZERO;
        }
        let n = f64::from(self.count);
        self.deviation / (n - 1.0) / n
    }
}

/// What the shadow rays of a pixel's samples were like, in sums over batches. Light is squared, in sum over channels.
#[derive(Clone, Copy, Debug, Default)]
pub struct Heard {
    /// Shadow rays.
    pub rays: f32,
    /// Light that arrived: all of it, and that of batches of more than one ray.
    pub all: f32,
    /// See there.
    pub known: f32,
    /// The variance that rays made in those, times the power 1.5 of the rays of the sample.
    pub noise: f32,
    /// The most that it can be in the others.
    pub most: f32,
    /// All of the light times the rays of the sample, over those of the batch.
    pub each: f32,
}

impl Heard {
    /// A batch of so many rays, which stand for the part `share` of their light, of a sample that was due `due`. Of radiance 1 it
    /// saw `seen`, which would have the variance `variance` with *independent* rays; `full` is radiance times reflectance,
    /// squared.
    #[inline]
    pub fn batch(rays: usize, due: u32, share: f32, full: f32, seen: f32, variance: f32) -> Self {
        let (n, due) = (rays as f32, due as f32);
        let square = full * seen * seen;
        let all = square / share;
        // Spread rays make less, by the root of their number.
        let spread = due * (due / n).sqrt();
        let (known, noise, most) = if rays > 1 {
            (all, full * variance.max(0.0) * spread, 0.0)
        } else {
            (0.0, 0.0, square * spread)
        };
        Self { rays: n, all, known, noise, most, each: square * due / n }
    }
}

impl std::ops::AddAssign for Heard {
    fn add_assign(&mut self, other: Self) {
        self.rays += other.rays;
        self.all += other.all;
        self.known += other.known;
        self.noise += other.noise;
        self.most += other.most;
        self.each += other.each;
    }
}

/// The pixels of one tile.
#[derive(Clone, Debug)]
pub struct TileFilm {
    tile: Tile,
    pixels: Vec<Accumulator>,
    /// Of each pixel, if asked for.
    heard: Vec<Heard>,
}

impl TileFilm {
    /// Which pixels of the image these are.
    pub fn tile(&self) -> Tile {
        self.tile
    }

    /// Adds the radiance that one pass found for a pixel; the tile's pixels are counted row by row.
    ///
    /// # Panics
    /// If the tile has no such pixel.
    #[inline]
    pub fn add(&mut self, pixel: usize, radiance: Vec3) {
        self.pixels[pixel].add(radiance.as_dvec3());
    }

    /// Whether it was [made](Film::listening) to hear what shadow rays are like.
    pub fn listens(&self) -> bool {
        !self.heard.is_empty()
    }

    /// Adds what a batch of a pixel was like.
    ///
    /// # Panics
    /// If the tile has no such pixel or does not listen.
    #[inline]
    pub fn hear(&mut self, pixel: usize, batch: Heard) {
        self.heard[pixel] += batch;
    }

    /// What was heard of a pixel.
    ///
    /// # Panics
    /// If the tile has no such pixel or does not listen.
    pub fn heard(&self, pixel: usize) -> &Heard {
        &self.heard[pixel]
    }

    /// The mean of a pixel's samples, and the sum of their squared distances from it over all channels.
    ///
    /// # Panics
    /// If the tile has no such pixel.
    pub fn spread(&self, pixel: usize) -> (DVec3, f64) {
        (self.pixels[pixel].mean, self.pixels[pixel].deviation.element_sum())
    }

    /// How many samples a pixel has had.
    ///
    /// # Panics
    /// If the tile has no such pixel.
    pub fn count(&self, pixel: usize) -> u32 {
        self.pixels[pixel].count
    }
}

/// The mean and the variance of the radiance of every pixel, over passes.
///
/// A pass need not reach every pixel: an interrupted render leaves tiles with
/// different counts, and every pixel is the average of those it has had.
/// 56 bytes a pixel.
#[derive(Clone, Debug)]
pub struct Film {
    width: u32,
    height: u32,
    tiles: Vec<TileFilm>,
}

impl Film {
    /// What a pixel takes, bytes, and what it takes more if the film [listens](Film::listening).
    pub const BYTES_A_PIXEL: [usize; 2] = [size_of::<Accumulator>(), size_of::<Heard>()];

    /// Edge of the tiles of [`Film::new`], pixels.
    pub const TILE: u32 = 16;

    /// A film nothing has been added to, in tiles of [`Film::TILE`] pixels.
    pub fn new(width: u32, height: u32) -> Self {
        Self::with_tiles(width, height, Self::TILE)
    }

    /// The same in tiles of another edge. What it develops to does not depend on the edge.
    pub fn with_tiles(width: u32, height: u32, edge: u32) -> Self {
        let tiles = Tile::cover(width, height, edge)
            .map(|tile| TileFilm {
                tile,
                pixels: vec![Accumulator::default(); tile.len()],
                heard: Vec::new(),
            })
            .collect();
        Self { width, height, tiles }
    }

    /// The same that listens to what the shadow rays of each pixel are like: 24 bytes a pixel more.
    pub fn listening(mut self) -> Self {
        for tile in &mut self.tiles {
            tile.heard = vec![Heard::default(); tile.pixels.len()];
        }
        self
    }

    /// Becomes the mean of itself and another film of the same size and tiles, weighted. Pixels that had nothing in
    /// one of them are those of the other. Right on average whenever the weights do not depend on what was seen.
    ///
    /// # Panics
    /// If the other has fewer tiles or pixels.
    pub fn merge(&mut self, own: f64, other: &Film, weight: f64) {
        for (tile, other) in self.tiles.iter_mut().zip(&other.tiles) {
            for (pixel, other) in tile.pixels.iter_mut().zip(&other.pixels) {
                pixel.merge(own, other, weight);
            }
        }
    }

    /// Pixels across.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Pixels down.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// The tiles, row by row.
    pub fn tiles(&self) -> &[TileFilm] {
        &self.tiles
    }

    /// The tiles, row by row, each to be given to one thread.
    pub fn tiles_mut(&mut self) -> &mut [TileFilm] {
        &mut self.tiles
    }

    /// The least and the greatest number of passes that a pixel has had.
    pub fn passes(&self) -> (u32, u32) {
        let mut counts = self.tiles.iter().flat_map(|t| &t.pixels).map(|p| p.count);
        let first = counts.next().unwrap_or(0);
        counts.fold((first, first), |(least, most), count| (least.min(count), most.max(count)))
    }

    /// The mean of each pixel; black where nothing was added.
    pub fn develop(&self) -> Image {
        self.image(|pixel| pixel.mean)
    }

    /// The variance of each pixel of [`Film::develop`]: that of a sample, divided by the number of samples, and of
    /// [merged](Film::merge) films by the weight of each.
    ///
    /// Estimated from the samples themselves, so 0, which here means *unknown*, where there were fewer
    /// than two: see [`Film::passes`].
    pub fn variance_of_mean(&self) -> Image {
        self.image(Accumulator::variance_of_mean)
    }

    /// The standard error of each pixel of [`Film::develop`]: the root of [`Film::variance_of_mean`].
    pub fn standard_error(&self) -> Image {
        self.image(|pixel| pixel.variance_of_mean().map(f64::sqrt))
    }

    fn image(&self, value: impl Fn(&Accumulator) -> DVec3) -> Image {
        let mut image = Image::new(self.width, self.height);
        for TileFilm { tile, pixels, .. } in &self.tiles {
            for (i, pixel) in pixels.iter().enumerate() {
                let (x, y) = tile.position(i);
                image.pixels[y as usize * self.width as usize + x as usize] =
                    value(pixel).as_vec3().to_array();
            }
        }
        image
    }
}

/// Linear radiance, red, green and blue, rows from the top.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Image {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// `width * height` of them, row by row.
    pub pixels: Vec<[f32; 3]>,
}

/// What [`Image::settle`] had to do.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Settled {
    /// Pixels that were below 0.
    pub pixels: u64,
    /// How far, in sum over their channels.
    pub sum: f64,
}

impl Image {
    /// A black one.
    pub fn new(width: u32, height: u32) -> Self {
        Self { width, height, pixels: vec![[0.0; 3]; width as usize * height as usize] }
    }

    /// Makes values below 0, which an average of estimates may leave in the dark, 0, and takes what is missing from the
    /// channel's values around, in proportion to what they hold.
    ///
    /// From the least square that holds as much: so the sum over the image stays what it was, and that over a block but for
    /// what crosses its border, and no value becomes negative. Where the whole image holds less, all of the channel is 0.
    /// Values that are not finite neither give nor take. The result depends on nothing but the image.
    pub fn settle(&mut self) -> Settled {
        let (width, height) = (self.width as usize, self.height as usize);
        let mut settled = Settled::default();
        for at in 0..self.pixels.len() {
            let negative = |value: &f32| *value < 0.0 && value.is_finite();
            settled.pixels += u64::from(self.pixels[at].iter().any(negative));
            for channel in 0..3 {
                let value = self.pixels[at][channel];
                if !negative(&value) {
                    continue;
                }
                self.pixels[at][channel] = 0.0;
                settled.sum -= f64::from(value);
                let (x, y) = (at % width, at / width);
                let mut radius = 1;
                loop {
                    let columns = x.saturating_sub(radius)..(x + radius + 1).min(width);
                    let rows = y.saturating_sub(radius)..(y + radius + 1).min(height);
                    let all = columns.len() == width && rows.len() == height;
                    let places = rows.flat_map(|y| columns.clone().map(move |x| y * width + x));
                    let gives = |value: f32| value > 0.0 && value.is_finite();
                    let held: f64 = places
                        .clone()
                        .map(|place| self.pixels[place][channel])
                        .filter(|&value| gives(value))
                        .map(f64::from)
                        .sum();
                    if held >= -f64::from(value) || all {
                        let keep = (1.0 + f64::from(value) / held).max(0.0);
                        for place in places {
                            let value = &mut self.pixels[place][channel];
                            if gives(*value) {
                                *value = (f64::from(*value) * keep) as f32;
                            }
                        }
                        break;
                    }
                    radius *= 2;
                }
            }
        }
        settled
    }

    /// One whose pixels are computed from column and row.
    pub fn from_fn(width: u32, height: u32, mut pixel: impl FnMut(u32, u32) -> [f32; 3]) -> Self {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        Self { width, height, pixels: pixels.map(|(x, y)| pixel(x, y)).collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn radiance(x: u32, y: u32, pass: u32) -> Vec3 {
        let k = f64::from(x * 7919 + y * 104_729 + pass * 1_299_709) * 0.618_033_988_75;
        Vec3::new(k.fract() as f32, (k * 3.0).fract() as f32 - 0.5, 1e4 + (k * 5.0).fract() as f32)
    }

    #[test]
    fn tiles_cover_every_pixel_once_in_rows() {
        for (width, height, edge) in [(33, 17, 16), (5, 3, 8), (4, 4, 1), (3, 2, 0), (0, 5, 4), (5, 0, 4)] {
            let mut seen = vec![0; (width * height) as usize];
            let tiles: Vec<_> = Tile::cover(width, height, edge).collect();
            assert!(tiles.is_sorted_by_key(|t| (t.y, t.x)));
            for tile in tiles {
                for i in 0..tile.len() {
                    let (x, y) = tile.position(i);
                    seen[(y * width + x) as usize] += 1;
                }
            }
            assert!(seen.iter().all(|&n| n == 1));
        }
    }

    #[test]
    fn mean_and_variance_are_those_of_two_passes_over_the_data() {
        const PASSES: u32 = 50;
        let mut film = Film::with_tiles(19, 9, 4);
        for pass in 0..PASSES {
            for tile in film.tiles_mut() {
                for i in 0..tile.tile().len() {
                    let (x, y) = tile.tile().position(i);
                    tile.add(i, radiance(x, y, pass));
                }
            }
        }
        assert_eq!(film.passes(), (PASSES, PASSES));
        let (mean, variance, error) = (film.develop(), film.variance_of_mean(), film.standard_error());
        for (i, (x, y)) in (0..9).flat_map(|y| (0..19).map(move |x| (x, y))).enumerate() {
            let n = f64::from(PASSES);
            let samples: Vec<_> = (0..PASSES).map(|p| radiance(x, y, p).as_dvec3()).collect();
            let m = samples.iter().sum::<DVec3>() / n;
            let v = samples.iter().map(|s| (s - m) * (s - m)).sum::<DVec3>() / (n - 1.0) / n;
            for c in 0..3 {
                assert!((f64::from(mean.pixels[i][c]) - m[c]).abs() <= 1e-7 * m[c].abs());
                assert!((f64::from(variance.pixels[i][c]) - v[c]).abs() < 1e-6 * v[c]);
                assert!((f64::from(error.pixels[i][c]) - v[c].sqrt()).abs() < 1e-6 * v[c].sqrt());
            }
        }
    }

    #[test]
    fn fewer_than_two_passes_have_no_variance_and_no_nan() {
        let mut film = Film::with_tiles(4, 2, 2);
        film.tiles_mut()[1].add(3, Vec3::new(-2.0, 0.5, 3.0));
        assert_eq!(film.passes(), (0, 1));
        assert_eq!(film.tiles()[1].count(3), 1);
        assert_eq!(film.develop().pixels[7], [-2.0, 0.5, 3.0]);
        assert!(film.develop().pixels[..7].iter().all(|p| *p == [0.0; 3]));
        assert!(film.standard_error().pixels.iter().all(|p| *p == [0.0; 3]));
        assert_eq!(Film::new(0, 0).passes(), (0, 0));
    }

    #[test]
    fn what_is_below_zero_is_taken_from_those_around() {
        let mut image = Image::new(7, 5);
        image.pixels[8] = [-1.0, 0.0, f32::NAN];
        image.pixels[9] = [3.0, 2.0, 1.0];
        image.pixels[15] = [1.0, 0.0, -f32::INFINITY];
        image.pixels[34] = [5.0, 0.0, 0.0];
        assert_eq!(image.settle(), Settled { pixels: 1, sum: 1.0 });
        assert_eq!(image.pixels[8][0], 0.0);
        assert_eq!([image.pixels[9], image.pixels[34]], [[2.25, 2.0, 1.0], [5.0, 0.0, 0.0]]);
        assert_eq!(image.pixels[15][0], 0.75);
        assert!(image.pixels[8][2].is_nan() && image.pixels[15][2] == -f32::INFINITY);
        assert_eq!(image.settle(), Settled::default(), "nothing is left to do");

        // What is near holds too little: the square grows.
        let mut far = Image::new(9, 9);
        (far.pixels[0], far.pixels[1], far.pixels[80]) = ([-2.0; 3], [0.5; 3], [4.0; 3]);
        far.settle();
        let sum: f32 = far.pixels.iter().map(|pixel| pixel[1]).sum();
        assert!((sum - 2.5).abs() < 1e-6 && far.pixels.iter().all(|pixel| pixel[1] >= 0.0), "{sum}");

        // And where there is too little of it at all, all is black.
        let mut black = Image::new(2, 1);
        black.pixels = vec![[-2.0; 3], [1.0; 3]];
        assert_eq!(black.settle(), Settled { pixels: 1, sum: 6.0 });
        assert_eq!(black.pixels, [[0.0; 3]; 2]);
        let mut alone = Image::new(1, 1);
        alone.pixels[0] = [-1.0; 3];
        alone.settle();
        assert_eq!(alone.pixels[0], [0.0; 3]);
    }

    #[test]
    fn the_edge_of_the_tiles_changes_nothing() {
        let render = |edge| {
            let mut film = Film::with_tiles(21, 13, edge);
            for pass in 0..5 {
                for tile in film.tiles_mut() {
                    for i in 0..tile.tile().len() {
                        let (x, y) = tile.tile().position(i);
                        tile.add(i, radiance(x, y, pass));
                    }
                }
            }
            (film.develop(), film.variance_of_mean())
        };
        assert_eq!(render(16), render(1));
        assert_eq!(render(16), render(7));
    }
}
