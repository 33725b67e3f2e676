//! More primitives than two: recursive halving, and levels beside it.

use super::plates::{Painted, Pixel, Plates, Rectangle};
use super::sample::{Z95, sample};
use super::{slope, unsound};
use crate::page::{
    Axis, Cell, Data, Entry, Figure, Line, Page, Picture, Plot, Point, Series, Strip, Table, Tone, number,
};
use crate::reproduce::{Halted, Leg};
use crate::sampler::{Pattern, Sampler};
use occlude_kernel::{Decomposition, Halving, Levels, Probabilities};

const RAYS: [u32; 4] = [1, 8, 64, 256];
const PLATES: usize = 8;

/// Eight plates at unlike heights.
fn eight_plates(quick: bool) -> Plates {
    let size = if quick { (96, 60) } else { (192, 120) };
    let plates = (0..PLATES).map(|i| {
        let (column, row) = (i % 4, i / 4);
        let (x, z) = (column as f64 * 0.8 - 1.2, row as f64 * 0.9 - 0.45);
        (Rectangle::centred(x, z, 0.27), [1.2, 1.7, 1.4, 1.9][(column + 2 * row) % 4])
    });
    Plates {
        light: Rectangle::centred(0.0, 0.0, 0.7),
        light_height: 4.0,
        plates: plates.collect(),
        view: Rectangle { x: [-3.2, 3.2], z: [-2.0, 2.0] },
        width: size.0,
        height: size.1,
    }
}

/// How visibility of several plates is found.
enum Way {
    Exact,
    Halving(Halving),
    Levels,
}

impl Way {
    /// For a pixel, whose plates are shuffled first: halves at random, levels in any order.
    fn estimate(&self, pixel: &Pixel<'_>, random: &mut Sampler) -> f64 {
        let mut order: [usize; PLATES] = std::array::from_fn(|i| i);
        for last in (1..PLATES).rev() {
            let other = (random.uniform() * (last + 1) as f32) as usize;
            order.swap(last, other.min(last));
        }
        let mut reach = [0.0; PLATES];
        Levels::even(&mut reach);
        let levels = Levels::new(&reach);
        pixel.sum(|k| {
            let visible = |i: usize| pixel.visible(order[i], k);
            match self {
                Self::Exact => f64::from(u8::from((0..PLATES).all(visible))),
                Self::Halving(halving) => halving.estimate(PLATES, || random.uniform(), visible),
                Self::Levels => {
                    levels.map_or(f64::NAN, |levels| f64::from(levels.estimate(random.uniform(), visible)))
                }
            }
        })
    }
}

pub(super) fn add(leg: &Leg<'_>, page: &mut Page) -> Result<[(&'static str, Data); 2], Halted> {
    page.section("More primitives");
    page.prose(
        "With more than two things in the way the slides cut them at random into two equal halves, and \
         propose to cut each half again, until single primitives are left and one ray tests next to nothing. \
         They also say what comes of it: “a great increase of the variance”. How great follows from the \
         forms: the second moments of the halves multiply, and for the balanced form with *n* primitives, \
         none of them in the way, the variance of one ray is 3^{n − 1} − 1.",
    );
    let halving = |form| Halving::new(form, &Probabilities::UNIFORM).map_err(unsound);
    let (inclusion, balanced) =
        (halving(Decomposition::InclusionExclusion)?, halving(Decomposition::Balanced)?);
    let variance =
        variances(&Leg::new(leg.run, leg.from, 0.5 * (leg.from + leg.to)), page, &inclusion, &balanced)?;
    page.data("halving.csv", "variance and work against the number of primitives");
    let ways = [
        ("Exact", Way::Exact),
        ("Halving, inclusion–exclusion", Way::Halving(inclusion)),
        ("Halving, balanced", Way::Halving(balanced)),
        ("Levels", Way::Levels),
    ];
    let eight = pictures(&Leg::new(leg.run, 0.5 * (leg.from + leg.to), leg.to), page, &ways)?;
    page.data("eight_plates.csv", "error and work against rays");
    Ok([("halving.csv", variance), ("eight_plates.csv", eight)])
}

fn variances(
    leg: &Leg<'_>,
    page: &mut Page,
    inclusion: &Halving,
    balanced: &Halving,
) -> Result<Data, Halted> {
    let mut data = Data::new(&[
        "method",
        "primitives",
        "in_the_way",
        "variance_closed_form",
        "samples",
        "variance_sampled",
        "variance_half_width_95",
        "asked_per_ray",
    ]);
    let counts: [usize; 6] = [1, 2, 3, 4, 6, 8];
    let mut table = Table::new(
        "Variance of one ray with *n* primitives, none of them in the way; and for levels, the worst case",
    )
    .numbers("*n*")
    .numbers("3^{n − 1} − 1")
    .numbers("halving, balanced, closed form")
    .numbers("sampled, 95 %")
    .numbers("asked a ray")
    .numbers("inclusion–exclusion, closed form")
    .numbers("levels, none in the way")
    .numbers("levels, the last alone in the way: closed form")
    .numbers("sampled, 95 %")
    .numbers("asked a ray");
    let mut curves: [Vec<Point>; 4] = Default::default();
    let mut formula = Vec::new();
    let samples: u64 = if leg.run.quick { 1_000_000 } else { 4_000_000 };
    let (mut worst, mut most, mut steepest, mut sampled) = (0.0f64, 0, 0.0, 0.0);
    for (i, n) in counts.into_iter().enumerate() {
        leg.at(i as f64 / counts.len() as f64, "recursive halving")?;
        let lit = vec![true; n];
        let mut last = lit.clone();
        last[n - 1] = false;
        let mut reach = vec![0.0; n];
        Levels::even(&mut reach);
        let levels = Levels::new(&reach).map_err(unsound)?;
        let draw = |halving: &Halving, stream: u64| {
            sample(leg.run, stream, samples, 1.0, |random| {
                let mut asked = 0;
                let estimate = halving.estimate(
                    n,
                    || random.uniform(),
                    |i| {
                        asked += 1;
                        lit[i]
                    },
                );
                (estimate, asked)
            })
        };
        let closed = 3f64.powi(n as i32 - 1) - 1.0;
        let seen = draw(balanced, 200 + n as u64)?;
        let seen_inclusion = draw(inclusion, 300 + n as u64)?;
        worst = worst.max(seen.off(closed));
        (most, steepest, sampled) = (n, closed, seen.variance);
        let levels_seen = sample(leg.run, 400 + n as u64, samples, 0.0, |random| {
            let mut asked = 0;
            let estimate = levels.estimate(random.uniform(), |i| {
                asked += 1;
                last[i]
            });
            (f64::from(estimate), asked)
        })?;
        let levels_closed = levels.variance(Some(n - 1));
        let within = |seen: &super::sample::Sampled| match seen.variance_error {
            error if error > 0.0 => Entry::with_error(seen.variance, Z95 * error),
            _ => Entry::number(seen.variance, 3),
        };
        table.row([
            Entry::from(n.to_string()),
            Entry::number(closed, 4),
            Entry::number(balanced.variance(&lit), 4),
            within(&seen),
            Entry::number(seen.asked, 3),
            Entry::number(inclusion.variance(&lit), 4),
            Entry::number(levels.variance(None), 3).tone(Tone::Good),
            Entry::number(levels_closed, 3),
            within(&levels_seen),
            Entry::number(levels_seen.asked, 3),
        ]);
        let rows = [
            ("halving balanced", "none", balanced.variance(&lit), seen),
            ("halving inclusion", "none", inclusion.variance(&lit), seen_inclusion),
            ("levels", "the last", levels_closed, levels_seen),
        ];
        for (method, way, closed, seen) in rows {
            data.row([
                Cell::from(method),
                (n as u32).into(),
                way.into(),
                closed.into(),
                seen.count.into(),
                seen.variance.into(),
                (Z95 * seen.variance_error).into(),
                seen.asked.into(),
            ]);
        }
        let at = |variance: f64, error: f64| Point { x: n as f64, y: variance, error: Z95 * error };
        if n > 1 {
            curves[0].push(at(seen.variance, seen.variance_error));
            curves[1].push(at(seen_inclusion.variance, seen_inclusion.variance_error));
            curves[2].push(at(levels_seen.variance, levels_seen.variance_error));
            formula.push((n as f64, closed));
        }
    }
    page.add(&table);
    let [balanced_points, inclusion_points, levels_points, _] = curves;
    let plot = Plot::new(
        "",
        Axis::linear("primitives").at(counts.iter().skip(1).map(|&n| n as f64)),
        Axis::log("variance of one ray"),
    )
    .series(Series::new("3^{n − 1} − 1", 0, formula).line(Line::Dashed))
    .series(Series::with_errors("Halving, balanced, none in the way", 3, balanced_points).line(Line::None))
    .series(Series::with_errors("Halving, inclusion–exclusion, none in the way", 2, inclusion_points))
    .series(Series::with_errors("Levels, the last one alone in the way", 4, levels_points));
    page.add(
        &Figure::new(
            "Variance against the number of primitives",
            "Points are samples, bars 95 % intervals where they are longer than a point. The marks of the \
             balanced form should lie on the dashed line.",
        )
        .plot(plot),
    );
    page.prose(&format!(
        "The formula holds: the sampled variances of the balanced form are within {} standard errors of it. \
         With {most} primitives {} rays have to be averaged until the variance is down to 1, to find that \
         nothing is in the way. The levels beside it take the primitives in an order, and ask each only if \
         all before it let the ray through, and then not always: the chance to get to level i, Q_{{i}}, \
         falls evenly from 1 to 1/n. What comes first is asked always, what comes last seldom, and what is \
         found to block at level i counts 1/Q_{{i}}-fold. If nothing is in the way the result is 1 without \
         fail, and at worst the variance is n − 1, not 3^{{n − 1}} − 1.",
        number(worst, 2),
        number(steepest, 4),
    ));
    page.in_short(format!(
        "Recursive halving of {most} primitives has a variance of {} by the formula 3^{{n − 1}} − 1, and of \
         {} in {} samples.",
        number(steepest, 4),
        number(sampled, 4),
        super::grouped(samples),
    ));
    Ok(data)
}

fn pictures(leg: &Leg<'_>, page: &mut Page, ways: &[(&str, Way)]) -> Result<Data, Halted> {
    let plates = eight_plates(leg.run.quick);
    let reference: Vec<f64> = (0..plates.pixels()).map(|pixel| plates.reference(pixel)).collect();
    let mut data = Data::new(&["method", "rays", "rmse", "plates_asked_per_ray"]);
    let columns =
        RAYS.map(|rays| if rays == 1 { "1 shadow ray".to_owned() } else { format!("{rays} shadow rays") });
    let mut strip = Strip::new(
        "Eight plates, and recursive halving down to single ones",
        "As on the slides: 1, 8, 64 and 256 rays a pixel. Black and white alike are estimates far outside 0 \
         to 1, cut off by the screen and not by the program.",
        columns,
    );
    let mut plot = Plot::new("", Axis::log("shadow rays a pixel").at(RAYS.map(f64::from)), Axis::log("RMSE"));
    let mut table = Table::new("Eight plates: error, slope and work")
        .words("method")
        .numbers("RMSE, 1 ray")
        .numbers("RMSE, 256 rays")
        .numbers("slope")
        .numbers("plates asked a ray")
        .numbers("error to exact, 256 rays");
    let mut exact = f64::NAN;
    let mut summary = Vec::new();
    for (w, (name, way)) in ways.iter().enumerate() {
        let mut painted: Vec<Painted> = Vec::new();
        for rays in RAYS {
            leg.at(w as f64 / ways.len() as f64, "eight plates")?;
            painted.push(
                plates
                    .picture(leg.run, Pattern::Lattice, rays, |pixel, random| way.estimate(pixel, random))?,
            );
        }
        let errors: Vec<(f64, f64)> = RAYS
            .into_iter()
            .zip(&painted)
            .map(|(rays, p)| (f64::from(rays), p.rmse(&reference, |_| true)))
            .collect();
        for ((rays, painted), (_, rmse)) in RAYS.into_iter().zip(&painted).zip(&errors) {
            data.row([
                Cell::from(*name),
                rays.into(),
                (*rmse).into(),
                painted.asked_a_ray(rays, |_| true).into(),
            ]);
        }
        let pictures = RAYS.iter().zip(&painted).zip(&errors).map(|((rays, painted), (_, rmse))| {
            Picture::new(&plates.image(&painted.values), 0.0, format!("{name}, {rays} shadow rays a pixel"))
                .under(format!("RMSE {}", number(*rmse, 3)))
        });
        strip.row(*name, pictures);
        let (first, last) = (errors[0].1, errors[RAYS.len() - 1].1);
        if w == 0 {
            exact = last;
        }
        let asked = painted[RAYS.len() - 1].asked_a_ray(RAYS[RAYS.len() - 1], |_| true);
        table.row([
            Entry::from(*name),
            Entry::number(first, 3),
            Entry::number(last, 3),
            Entry::number(slope(&errors), 2),
            Entry::number(asked, 3),
            Entry::from(format!("{} ×", number(last / exact, 3))),
        ]);
        summary.push((asked, last / exact));
        plot = plot.series(Series::new(*name, [0, 2, 3, 4][w % 4], errors));
    }
    page.add(&strip);
    page.add(&Figure::new("Eight plates: error against rays", "Stratified light samples.").plot(plot));
    page.add(&table);
    if let [exact, _, balanced, levels] = summary[..] {
        page.prose(&format!(
            "Halving with the balanced form asks {} plates a ray where exact visibility asks {}, and pays \
             for it with {} times its error at 256 rays, which only {} times as many rays would make up for. \
             Levels ask {} plates, and the error is {} times that of exact. Nobody should use recursive \
             halving; it is here to be seen.",
            number(balanced.0, 3),
            number(exact.0, 3),
            number(balanced.1, 3),
            number(balanced.1 * balanced.1, 2),
            number(levels.0, 3),
            number(levels.1, 3),
        ));
    }
    Ok(data)
}
