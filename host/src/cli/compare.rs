//! `occlude compare`: how an image differs from a reference.

use std::fmt::Write as _;
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use super::render::finite;
use crate::error::{Error, Result};
use crate::film::Image;
use crate::metrics::flip::{self, flip};
use crate::metrics::{Block, Comparison, compare};
use crate::output;

/// Compare an image with a reference: error, bias and what the eye sees of it.
#[derive(Clone, Debug, clap::Args)]
#[command(allow_negative_numbers = true)]
pub struct CompareArgs {
    /// The image on trial (.exr, .hdr, .pfm, .png)
    #[arg(value_name = "TEST")]
    pub a: PathBuf,
    /// The image to hold it against
    #[arg(value_name = "REFERENCE")]
    pub b: PathBuf,
    /// Write the signed difference, red where TEST is above REFERENCE and blue where it is below,
    /// scaled by the 99th percentile; or the plain numbers, to an .exr or .pfm
    #[arg(short, long, value_name = "DIFF.png")]
    pub output: Option<PathBuf>,
    /// Exposure at which FLIP looks at the images, in stops
    #[arg(long, value_name = "EV", default_value_t = 0.0, value_parser = finite)]
    pub exposure: f32,
    /// Print JSON instead of a table
    #[arg(long)]
    pub json: bool,
}

/// Compares two files and prints what was found.
pub fn run(args: &CompareArgs) -> Result<()> {
    print(&report(args)?)
}

fn report(args: &CompareArgs) -> Result<String> {
    if let Some(path) = &args.output {
        output::check_writable(path)?;
        output::check_apart(&[("--output", path)], &[("the image", &args.a), ("the reference", &args.b)])?;
    }
    let (test, reference) = (output::read(&args.a)?, output::read(&args.b)?);
    // The images do not know their names.
    let of_both = |error: Error| match error {
        Error::Usage(what) => Error::input(&args.a, format!("held against {}: {what}", args.b.display())),
        error => error,
    };
    let comparison = compare(&test, &reference).map_err(of_both)?;
    let seen = flip(&test, &reference, args.exposure, flip::PIXELS_PER_DEGREE)?;
    let scale = match &args.output {
        Some(path) => write_difference(path, &test, &reference)?,
        None => None,
    };
    Ok(if args.json {
        json(args, &comparison, seen.mean, scale)?
    } else {
        table(args, &comparison, seen.mean, scale)
    })
}

/// Returns the difference that gets the full colour, where the file shows colours.
fn write_difference(path: &Path, test: &Image, reference: &Image) -> Result<Option<f32>> {
    let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
    if extension == "hdr" {
        return Err(Error::Usage(format!(
            "{}: .hdr cannot hold negative numbers; name the difference .png, .exr or .pfm",
            path.display()
        )));
    }
    let mut difference = test.clone();
    for (d, r) in difference.pixels.iter_mut().zip(&reference.pixels) {
        *d = std::array::from_fn(|c| d[c] - r[c]);
    }
    if extension != "png" {
        return output::write(path, &difference, None, 0.0).map(|()| None);
    }
    let scale = percentile_99(&difference);
    difference.pixels.iter_mut().for_each(|p| *p = colour(*p, scale));
    output::write(path, &difference, None, 0.0).map(|()| Some(scale))
}

/// The channel that is the furthest from 0, with its sign; NaN if one is.
fn furthest(difference: [f32; 3]) -> f32 {
    let further = |a: f32, b: f32| if b.is_nan() || b.abs() > a.abs() { b } else { a };
    difference.into_iter().fold(0.0, |a: f32, b| if a.is_nan() { a } else { further(a, b) })
}

/// Not exceeded by 99 % of the pixels; the largest if that would be 0.
fn percentile_99(difference: &Image) -> f32 {
    let mut sizes: Vec<f32> =
        difference.pixels.iter().map(|p| furthest(*p).abs()).filter(|v| v.is_finite()).collect();
    sizes.sort_unstable_by(f32::total_cmp);
    let Some(&largest) = sizes.last() else { return 0.0 };
    let at = sizes[(sizes.len() * 99).div_ceil(100) - 1];
    if at > 0.0 { at } else { largest }
}

/// White for 0, red above and blue below, even steps of colour on the screen. Green is not a number.
fn colour(difference: [f32; 3], scale: f32) -> [f32; 3] {
    let d = furthest(difference);
    let screen = if d.is_nan() {
        [0.0, 1.0, 0.0]
    } else {
        let rest = if d == 0.0 { 1.0 } else { 1.0 - (d.abs() / scale).min(1.0) };
        if d > 0.0 { [1.0, rest, rest] } else { [rest, rest, 1.0] }
    };
    screen.map(output::srgb_decode)
}

const CHANNELS: [&str; 3] = ["red", "green", "blue"];

fn table(args: &CompareArgs, c: &Comparison, flip: f64, scale: Option<f32>) -> String {
    let mut t = String::new();
    let mut line = |name: &str, value: String| {
        // Writing to a string cannot fail.
        _ = writeln!(t, "{name:<13}{}", value.trim_end());
    };
    line("test", args.a.display().to_string());
    line("reference", args.b.display().to_string());
    line("size", format!("{} x {}", c.width, c.height));
    line("", format!("{:>12}{:>12}{:>12}{:>12}", "red", "green", "blue", "all"));
    let row = |v: [f64; 4]| v.map(|v| format!("{:>12}", number(v))).concat();
    let with_mean = |[r, g, b]: [f64; 3]| row([r, g, b, (r + g + b) / 3.0]);
    line("mean, test", with_mean(c.mean_test));
    line("mean, ref.", with_mean(c.mean_reference));
    let [r, g, b] = c.mean_ratio;
    let ratios = [r, g, b, c.mean_ratio_all];
    line("ratio", row(ratios.map(|r| r.ratio)));
    line("  +-", row(ratios.map(|r| r.standard_error)));
    line("RMSE", number(c.rmse));
    line("relMSE", format!("{}   without the worst 0.1 %: {}", number(c.relmse), number(c.relmse_trimmed)));
    line(
        "FLIP",
        format!("{}   {} pixels per degree, {:+} EV", number(flip), flip::PIXELS_PER_DEGREE, args.exposure),
    );
    let block = |b: &Block| {
        format!(
            "({}, {}) {}: {} +- {}, z {:+.1}, {:+.2} % of the image's mean",
            b.x,
            b.y,
            CHANNELS[b.channel],
            signed(b.bias),
            number(b.standard_error),
            b.z,
            100.0 * b.relative_bias,
        )
    };
    let none = || "none differs".to_owned();
    line("worst block", c.worst.as_ref().map_or_else(none, block));
    line("most biased", c.most_biased.as_ref().map_or_else(none, block));
    line(
        "chi2",
        format!(
            "{}   of {} blocks of 16 x 16 pixels and a channel; noise alone: 1, and z up to about {:.1}",
            number(c.chi2),
            c.blocks,
            c.expected_z()
        ),
    );
    line("bad pixels", format!("{} NaN, {} infinite, {} negative", c.nan, c.infinite, c.negative));
    let pixels = c.width as usize * c.height as usize;
    if c.compared < pixels {
        let what = "those that are not finite are left out of all figures, and black or white to FLIP";
        line("compared", format!("{} of {pixels} pixels: {what}", c.compared));
    }
    if let Some(path) = &args.output {
        let legend = scale.map(|s| format!("   full red +{0}, full blue -{0}", number(s.into())));
        line("difference", format!("{}{}", path.display(), legend.unwrap_or_default()));
    }
    t
}

/// Five digits, with an exponent only where it helps.
fn number(v: f64) -> String {
    match v.abs() {
        _ if v == 0.0 || !v.is_finite() => format!("{v}"),
        a if !(1e-3..1e6).contains(&a) => format!("{v:.4e}"),
        a => format!("{v:.*}", (4 - a.log10().floor() as i32).max(0) as usize),
    }
}

fn signed(v: f64) -> String {
    if v > 0.0 { format!("+{}", number(v)) } else { number(v) }
}

/// What `--json` prints, in this order. What is not finite is null.
#[derive(serde::Serialize)]
struct Report<'a> {
    test: &'a Path,
    reference: &'a Path,
    #[serde(flatten)]
    comparison: &'a Comparison,
    flip: FlipReport,
    difference: Option<DifferenceReport<'a>>,
}

#[derive(serde::Serialize)]
struct FlipReport {
    mean: f64,
    pixels_per_degree: f32,
    exposure_ev: f32,
}

#[derive(serde::Serialize)]
struct DifferenceReport<'a> {
    path: &'a Path,
    scale: Option<f32>,
}

fn json(args: &CompareArgs, comparison: &Comparison, flip: f64, scale: Option<f32>) -> Result<String> {
    let report = Report {
        test: &args.a,
        reference: &args.b,
        comparison,
        flip: FlipReport {
            mean: flip,
            pixels_per_degree: flip::PIXELS_PER_DEGREE,
            exposure_ev: args.exposure,
        },
        difference: args.output.as_deref().map(|path| DifferenceReport { path, scale }),
    };
    let text = serde_json::to_string_pretty(&report)
        .map_err(|e| Error::Usage(format!("the comparison cannot be put into JSON: {e}")))?;
    Ok(text + "\n")
}

/// To standard output; a reader that has had enough is not an error.
fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(Error::io("writing", "standard output")(e)),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(clap::Parser)]
    struct Parser {
        #[command(flatten)]
        args: CompareArgs,
    }

    fn args(words: &[&str]) -> CompareArgs {
        <Parser as clap::Parser>::try_parse_from([&["compare"], words].concat()).unwrap().args
    }

    #[test]
    fn arguments_are_what_the_help_says() {
        <Parser as clap::CommandFactory>::command().debug_assert();
        let a = args(&["a.exr", "b.exr", "-o", "d.png", "--exposure", "-1.5", "--json"]);
        assert_eq!((a.output, a.exposure, a.json), (Some("d.png".into()), -1.5, true));
        for exposure in ["nan", "inf", "bright"] {
            let line = ["compare", "a.exr", "b.exr", "--exposure", exposure];
            assert!(<Parser as clap::Parser>::try_parse_from(line).is_err(), "{exposure}");
        }
    }

    #[test]
    fn the_sign_of_a_difference_is_its_colour() {
        assert_eq!(colour([0.0; 3], 0.0), [1.0; 3]);
        assert_eq!(colour([0.5, 0.0, -0.1], 0.5), [1.0, 0.0, 0.0]);
        assert_eq!(colour([0.1, -9.0, 0.0], 0.5), [0.0, 0.0, 1.0]);
        assert_eq!(colour([0.1, f32::NAN, 9.0], 0.5), [0.0, 1.0, 0.0]);
        assert_eq!(colour([f32::INFINITY, 0.0, 0.0], 0.5), [1.0, 0.0, 0.0]);
    }

    #[test]
    fn the_scale_leaves_out_the_outliers() {
        let difference =
            Image::from_fn(100, 2, |x, y| [if y == 0 && x < 2 { -50.0 } else { 0.25 }, 0.0, 0.0]);
        assert_eq!(percentile_99(&difference), 0.25);
        let lonely = Image::from_fn(100, 2, |x, y| [if x + y == 0 { -50.0 } else { 0.0 }, 0.0, 0.0]);
        assert_eq!(percentile_99(&lonely), 50.0);
        assert_eq!(percentile_99(&Image::new(4, 4)), 0.0);
    }

    #[test]
    fn numbers_keep_five_digits() {
        for (v, text) in [
            (0.0, "0"),
            (1.0, "1.0000"),
            (0.012_345_67, "0.012346"),
            (-123.456, "-123.46"),
            (1e-5, "1.0000e-5"),
            (2.5e7, "2.5000e7"),
            (f64::NAN, "NaN"),
        ] {
            assert_eq!(number(v), text);
        }
    }

    #[test]
    fn files_are_compared_and_the_difference_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).display().to_string();
        let image = Image::from_fn(20, 17, |x, _| [x as f32 * 0.05, 0.5, 0.5]);
        output::write(path("a.exr"), &image, None, 0.0).unwrap();
        output::write(path("b.pfm"), &Image::from_fn(20, 17, |_, _| [0.5; 3]), None, 0.0).unwrap();
        output::write(path("small.pfm"), &Image::new(3, 3), None, 0.0).unwrap();

        let table = report(&args(&[&path("a.exr"), &path("b.pfm"), "-o", &path("d.png")])).unwrap();
        assert!(table.contains("worst block  (16, 0) red: +0.37500 +- "));
        assert!(table.contains("full red +0.50000, full blue -0.50000"));
        let difference = output::read(path("d.png")).unwrap();
        assert_eq!(difference.pixels[0], [0.0, 0.0, 1.0]);
        assert_eq!(difference.pixels[10], [1.0, 1.0, 1.0]);
        let json = report(&args(&[&path("a.exr"), &path("b.pfm"), "--json", "-o", &path("d.exr")])).unwrap();
        let json: serde_json::Value = serde_json::from_str(&json).unwrap();
        assert_eq!(json["worst"]["bias"].as_f64().map(|v| v as f32), Some(0.375));
        assert!(json["flip"]["mean"].as_f64().unwrap() > 0.0);
        assert_eq!(output::read(path("d.exr")).unwrap().pixels[0], [-0.5, 0.0, 0.0]);

        let mut spoilt = image.clone();
        spoilt.pixels[7][1] = f32::NAN;
        output::write(path("spoilt.pfm"), &spoilt, None, 0.0).unwrap();
        let table = report(&args(&[&path("spoilt.pfm"), &path("b.pfm")])).unwrap();
        assert!(table.contains("compared     339 of 340 pixels: "), "{table}");
        spoilt.pixels.fill([f32::NAN; 3]);
        output::write(path("nan.pfm"), &spoilt, None, 0.0).unwrap();
        assert!(report(&args(&[&path("nan.pfm"), &path("b.pfm")])).is_err());

        assert!(report(&args(&[&path("a.exr"), &path("small.pfm")])).is_err());
        assert!(report(&args(&[&path("a.exr"), &path("missing.exr")])).is_err());
        assert!(report(&args(&[&path("a.exr"), &path("b.pfm"), "-o", &path("d.hdr")])).is_err());
    }
}
