//! How two images differ, and whether it is bias or noise.
//!
//! A noisy image has a large error everywhere and a small one on average; a
//! biased image keeps its error however many pixels are averaged. So besides
//! the usual figures the difference is averaged over blocks of [`BLOCK`] by
//! [`BLOCK`] pixels and divided by its standard error, which the spread of the
//! block's own pixels gives:
//!
//! ```text
//!     d = test - reference,    b = mean(d),    se = std(d) / sqrt(n),    z = b / se
//! ```
//!
//! Noise that is independent from pixel to pixel gives z of about 1, and of
//! about `sqrt(2 ln(blocks))`, some 4, in the worst block. Above 6 means bias there.
//! Pixels that share a random sequence are not independent, and their z is too large.
//!
//! Sums are in `f64` and in a fixed order, so any thread count gives the same bits.

pub mod flip;

use rayon::prelude::*;
use serde::Serialize;

use crate::error::{Error, Result};
use crate::film::Image;

/// Edge of the blocks, pixels.
pub const BLOCK: u32 = 16;

/// Blocks at the right and bottom edge with fewer pixels than this are left out.
const LEAST_PIXELS: usize = 16;

/// Everything [`compare`] finds, in linear radiance. `test` is on trial, `reference` is the truth.
///
/// Pixels of the test that are not finite are counted, and left out of everything else, as they are of the reference.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// Pixels that all figures are over: those where the test is finite.
    pub compared: usize,
    /// Pixels of the test with a NaN.
    pub nan: usize,
    /// Pixels of the test with an infinity.
    pub infinite: usize,
    /// Pixels of the test with a negative channel.
    pub negative: usize,
    /// Mean of the test per channel.
    pub mean_test: [f64; 3],
    /// Mean of the reference per channel.
    pub mean_reference: [f64; 3],
    /// Mean of the test divided by that of the reference, per channel.
    pub mean_ratio: [Ratio; 3],
    /// The same over all channels.
    pub mean_ratio_all: Ratio,
    /// `sqrt(mean(d^2))` over pixels and channels.
    pub rmse: f64,
    /// `mean(d^2 / (r^2 + (0.01 mean(r))^2))`: relative, with a floor that keeps dark pixels from exploding.
    pub relmse: f64,
    /// The same without the worst 0.1 % of pixels; far below `relmse` if there are fireflies.
    pub relmse_trimmed: f64,
    /// How many blocks, times channels, differ at all.
    pub blocks: usize,
    /// Mean of `z^2` (at most 1e6 each) over blocks: near 1 for independent noise, above for bias, below
    /// for noise that is spread evenly by design. 0 if no block differs.
    pub chi2: f64,
    /// The block with the largest `|z|`.
    pub worst: Option<Block>,
    /// The block with the largest `|bias|`.
    pub most_biased: Option<Block>,
}

/// A ratio of means.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Ratio {
    /// Infinite or NaN if the reference is black.
    pub ratio: f64,
    /// Of the ratio, from the spread of the differences of pixels. NaN for a single pixel.
    pub standard_error: f64,
}

/// The difference of one channel of one block.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Block {
    /// Its leftmost column.
    pub x: u32,
    /// Its topmost row.
    pub y: u32,
    /// 0, 1, 2 for red, green, blue.
    pub channel: usize,
    /// Mean of test minus reference.
    pub bias: f64,
    /// Of the bias.
    pub standard_error: f64,
    /// `bias / standard_error`; infinite if all pixels differ by the same amount.
    pub z: f64,
    /// Mean of the reference in the block.
    pub reference: f64,
    /// `bias` divided by the mean of the whole reference.
    pub relative_bias: f64,
}

impl Comparison {
    /// What `|worst.z|` would be if all differences were independent noise.
    pub fn expected_z(&self) -> f64 {
        (2.0 * (self.blocks.max(1) as f64).ln()).sqrt()
    }
}

/// Compares an image with a reference of the same size, whose pixels have to be finite, and one of the image's at least.
///
/// Takes one pass for the means and one for everything else, and sorts one number per pixel.
pub fn compare(test: &Image, reference: &Image) -> Result<Comparison> {
    check_sizes(test, reference)?;
    check_finite(reference)?;
    let compared = test.pixels.iter().filter(|p| p.iter().all(|v| v.is_finite())).count();
    if compared == 0 {
        return Err(Error::Usage(
            "the image has no pixel of finite numbers, so there is nothing to compare; render it again"
                .into(),
        ));
    }
    let count = |pred: fn(&f32) -> bool| test.pixels.iter().filter(|p| p.iter().any(pred)).count();
    let both = Both { test, reference };
    let n = compared as f64;

    let sums = both.sum_rows(|t, r| [t[0], t[1], t[2], r[0], r[1], r[2]]);
    let [mean_test, mean_reference] = [0, 3].map(|first| [0, 1, 2].map(|c| sums[first + c] / n));
    let mean = mean_reference.iter().sum::<f64>() / 3.0;
    let shift: [f64; 3] = std::array::from_fn(|c| mean_test[c] - mean_reference[c]);
    let shift_all = shift.iter().sum::<f64>() / 3.0;

    let floor = (0.01 * mean).powi(2) + 1e-300; // for a reference that is black throughout
    let relative =
        |d: [f64; 3], r: [f64; 3]| (0..3).map(|c| d[c] * d[c] / (r[c] * r[c] + floor)).sum::<f64>() / 3.0;
    let sums = both.sum_rows(|t, r| {
        let d = sub(t, r);
        let spread: [f64; 3] = std::array::from_fn(|c| (d[c] - shift[c]).powi(2));
        let spread_all = (d.iter().sum::<f64>() / 3.0 - shift_all).powi(2);
        let square = d.iter().map(|d| d * d).sum::<f64>() / 3.0;
        [spread[0], spread[1], spread[2], spread_all, square, relative(d, r)]
    });
    let ratio = |test: f64, reference: f64, spread: f64| Ratio {
        ratio: test / reference,
        standard_error: (spread / (n - 1.0).max(1.0) / n).sqrt() / reference,
    };

    let mut sorted: Vec<f64> = (0..reference.pixels.len())
        .into_par_iter()
        .filter_map(|i| both.pixel(i))
        .map(|(t, r)| relative(sub(t, r), r))
        .collect();
    sorted.par_sort_unstable_by(f64::total_cmp);
    sorted.truncate(((n * 0.999) as usize).max(1));

    let blocks = both.blocks(mean);
    let chi2 = blocks.iter().map(|b| (b.z * b.z).min(1e6)).sum::<f64>();
    Ok(Comparison {
        width: test.width,
        height: test.height,
        compared,
        nan: count(|v| v.is_nan()),
        infinite: count(|v| v.is_infinite()),
        negative: count(|v| *v < 0.0),
        mean_test,
        mean_reference,
        mean_ratio: std::array::from_fn(|c| ratio(mean_test[c], mean_reference[c], sums[c])),
        mean_ratio_all: ratio(mean_test.iter().sum::<f64>() / 3.0, mean, sums[3]),
        rmse: (sums[4] / n).sqrt(),
        relmse: sums[5] / n,
        relmse_trimmed: sorted.iter().sum::<f64>() / sorted.len() as f64,
        blocks: blocks.len(),
        chi2: if blocks.is_empty() { 0.0 } else { chi2 / blocks.len() as f64 },
        worst: largest(&blocks, |b| b.z),
        most_biased: largest(&blocks, |b| b.bias),
    })
}

/// Whether an image can be a reference: all of its pixels have to be finite numbers.
pub fn check_finite(reference: &Image) -> Result<()> {
    let bad = reference.pixels.iter().filter(|p| !p.iter().all(|v| v.is_finite())).count();
    if bad > 0 {
        return Err(Error::Usage(format!(
            "the reference has {bad} pixels that are not finite numbers: render it again, or name another one"
        )));
    }
    Ok(())
}

/// Whether two images have the same size, at least one pixel, and as many pixels as the size says.
pub(crate) fn check_sizes(test: &Image, reference: &Image) -> Result<()> {
    if (test.width, test.height) != (reference.width, reference.height) {
        return Err(Error::Usage(format!(
            "images of different sizes cannot be compared: {} x {} against {} x {}",
            test.width, test.height, reference.width, reference.height
        )));
    }
    let pixels = test.width as usize * test.height as usize;
    if pixels == 0 || test.pixels.len() != pixels || reference.pixels.len() != pixels {
        return Err(Error::Usage("an image has no pixels, or not as many as its size says".into()));
    }
    Ok(())
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|c| a[c] - b[c])
}

/// The first block whose value is the furthest from 0.
fn largest(blocks: &[Block], value: impl Fn(&Block) -> f64) -> Option<Block> {
    blocks.iter().copied().reduce(|a, b| if value(&b).abs() > value(&a).abs() { b } else { a })
}

/// Two images of one size.
struct Both<'a> {
    test: &'a Image,
    reference: &'a Image,
}

impl Both<'_> {
    /// Test and reference; `None` where the test is not finite.
    fn pixel(&self, i: usize) -> Option<([f64; 3], [f64; 3])> {
        let r = self.reference.pixels[i].map(f64::from);
        let t = self.test.pixels[i].map(f64::from);
        t.iter().all(|v| v.is_finite()).then_some((t, r))
    }

    /// Sums over all pixels: rows in parallel, then the rows from top to bottom.
    fn sum_rows<const N: usize>(&self, value: impl Fn([f64; 3], [f64; 3]) -> [f64; N] + Sync) -> [f64; N] {
        let add = |a: [f64; N], b: [f64; N]| std::array::from_fn(|k| a[k] + b[k]);
        let width = self.test.width as usize;
        let rows: Vec<[f64; N]> = (0..self.test.height as usize)
            .into_par_iter()
            .map(|y| {
                let row = (y * width..(y + 1) * width).filter_map(|i| self.pixel(i));
                row.fold([0.0; N], |sum, (t, r)| add(sum, value(t, r)))
            })
            .collect();
        rows.into_iter().fold([0.0; N], add)
    }

    /// The blocks that differ, row by row, and their channels.
    fn blocks(&self, mean: f64) -> Vec<Block> {
        let (width, height) = (self.test.width, self.test.height);
        let rows: Vec<Vec<Block>> = (0..height.div_ceil(BLOCK))
            .into_par_iter()
            .map(|row| {
                let y = row * BLOCK;
                let blocks = (0..width.div_ceil(BLOCK)).flat_map(|column| {
                    let x = column * BLOCK;
                    let pixels: Vec<_> = (y..height.min(y + BLOCK))
                        .flat_map(|y| (x..width.min(x + BLOCK)).map(move |x| (x, y)))
                        .filter_map(|(x, y)| self.pixel(y as usize * width as usize + x as usize))
                        .collect();
                    (0..3).filter_map(move |channel| block(x, y, channel, &pixels, mean))
                });
                blocks.collect()
            })
            .collect();
        rows.concat()
    }
}

/// `None` if there are too few pixels, or none of them differs.
fn block(x: u32, y: u32, channel: usize, pixels: &[([f64; 3], [f64; 3])], mean: f64) -> Option<Block> {
    if pixels.len() < LEAST_PIXELS {
        return None;
    }
    let n = pixels.len() as f64;
    let differences = || pixels.iter().map(|(t, r)| t[channel] - r[channel]);
    let bias = differences().sum::<f64>() / n;
    let variance = differences().map(|d| (d - bias).powi(2)).sum::<f64>() / (n - 1.0);
    let standard_error = (variance / n).sqrt();
    if bias == 0.0 && standard_error == 0.0 {
        return None;
    }
    let reference = pixels.iter().map(|(_, r)| r[channel]).sum::<f64>() / n;
    let (z, relative_bias) = (bias / standard_error, bias / mean);
    Some(Block { x, y, channel, bias, standard_error, z, reference, relative_bias })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reference() -> Image {
        Image::from_fn(40, 33, |x, y| [0.25 + (x % 4) as f32 * 0.25, 0.5 + (y % 2) as f32, 1.0])
    }

    fn near(a: f64, b: f64) -> bool {
        (a - b).abs() <= 1e-12 * b.abs().max(1e-3)
    }

    #[test]
    fn an_image_equals_itself() {
        let c = compare(&reference(), &reference()).unwrap();
        assert_eq!((c.rmse, c.relmse, c.relmse_trimmed, c.chi2, c.blocks), (0.0, 0.0, 0.0, 0.0, 0));
        assert_eq!(c.mean_ratio_all, Ratio { ratio: 1.0, standard_error: 0.0 });
        assert_eq!((c.worst, c.most_biased), (None, None));
    }

    #[test]
    fn a_constant_offset_has_its_own_size() {
        let mut test = reference();
        test.pixels.iter_mut().for_each(|p| p[1] += 0.25);
        let c = compare(&test, &reference()).unwrap();
        assert!(near(c.rmse, 0.25 / 3f64.sqrt()));
        assert!(near(c.mean_test[1] - c.mean_reference[1], 0.25));
        assert_eq!(c.mean_ratio[0].ratio, 1.0);
        assert!(near(c.mean_ratio[1].ratio, 1.0 + 0.25 / c.mean_reference[1]));
        assert_eq!(c.mean_ratio[1].standard_error, 0.0);
        let worst = c.worst.unwrap();
        assert_eq!((worst.x, worst.y, worst.channel), (0, 0, 1));
        assert_eq!((worst.bias, worst.standard_error, worst.z), (0.25, 0.0, f64::INFINITY));
        assert_eq!(c.chi2, 1e6);
        assert_eq!(c.blocks, 3 + 3 + 2); // the last is 8 x 1, too small to be counted
    }

    #[test]
    fn a_checkerboard_has_no_bias_and_a_known_error() {
        let flat = Image::from_fn(32, 32, |_, _| [2.0; 3]);
        let test = Image::from_fn(32, 32, |x, y| [if (x + y).is_multiple_of(2) { 2.5 } else { 1.5 }; 3]);
        let c = compare(&test, &flat).unwrap();
        assert_eq!(c.rmse, 0.5);
        assert!(near(c.relmse, 0.25 / (4.0 + 0.02f64.powi(2))));
        assert!(near(c.mean_ratio_all.standard_error, (0.25 / 1023f64).sqrt() / 2.0));
        assert!(near(c.worst.unwrap().standard_error, (0.25 / 255f64).sqrt()));
        assert_eq!((c.chi2, c.blocks), (0.0, 12));
    }

    #[test]
    fn bias_in_one_block_is_found_there() {
        let flat = Image::from_fn(64, 48, |_, _| [1.0; 3]);
        let noise = |x: u32, y: u32| if (x + y).is_multiple_of(2) { 0.125 } else { -0.125 };
        let inside = |x: u32, y: u32| (32..48).contains(&x) && (16..32).contains(&y);
        let test = Image::from_fn(64, 48, |x, y| {
            let d = noise(x, y) - if inside(x, y) { 0.0625 } else { 0.0 };
            [1.0 + noise(x, y), 1.0 + noise(x, y), 1.0 + d]
        });
        let worst = compare(&test, &flat).unwrap().worst.unwrap();
        assert_eq!((worst.x, worst.y, worst.channel), (32, 16, 2));
        assert_eq!((worst.bias, worst.relative_bias), (-0.0625, -0.0625));
        assert!(near(worst.z, -0.0625 / (0.125f64.powi(2) / 255.0).sqrt()));
    }

    #[test]
    fn bad_pixels_are_counted_and_left_out() {
        let mut test = reference();
        test.pixels[3][0] = f32::NAN;
        test.pixels[4] = [f32::INFINITY, f32::NAN, 0.0];
        test.pixels[5][2] = -1.0;
        let c = compare(&test, &reference()).unwrap();
        assert_eq!((c.nan, c.infinite, c.negative, c.compared), (2, 1, 1, 40 * 33 - 2));
        assert!(near(c.rmse, (4.0 / (3.0 * (40.0 * 33.0 - 2.0f64))).sqrt()));

        // Half of it: the other half says what both would.
        let mut half = reference();
        half.pixels.iter_mut().for_each(|p| p[1] += 0.25);
        half.pixels[..20 * 33].iter_mut().for_each(|p| p[1] = f32::NAN);
        let c = compare(&half, &reference()).unwrap();
        assert!(near(c.rmse, 0.25 / 3f64.sqrt()) && near(c.mean_test[1] - c.mean_reference[1], 0.25));
    }

    #[test]
    fn what_cannot_be_compared_is_refused() {
        assert!(compare(&Image::new(3, 2), &Image::new(2, 3)).is_err());
        assert!(compare(&Image::new(0, 0), &Image::new(0, 0)).is_err());
        assert!(compare(&Image { pixels: vec![], ..Image::new(2, 2) }, &Image::new(2, 2)).is_err());
        let mut nan = reference();
        nan.pixels[0][0] = f32::NAN;
        assert!(compare(&reference(), &nan).is_err());
        for bad in [f32::NAN, f32::INFINITY] {
            let test = Image::from_fn(40, 33, |_, _| [1.0, bad, 1.0]);
            assert!(compare(&test, &reference()).unwrap_err().to_string().contains("nothing to compare"));
        }
    }

    #[test]
    fn a_black_reference_and_a_single_pixel_do_no_harm() {
        let c = compare(&Image::from_fn(20, 20, |_, _| [1.0; 3]), &Image::new(20, 20)).unwrap();
        assert_eq!((c.mean_ratio_all.ratio, c.rmse), (f64::INFINITY, 1.0));
        let c = compare(&Image::from_fn(1, 1, |_, _| [1.0; 3]), &Image::new(1, 1)).unwrap();
        assert_eq!((c.rmse, c.blocks), (1.0, 0));
    }
}
