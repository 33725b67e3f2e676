//! `reproduce theory`: the thesis' stochastic visibility, its tables and its figures.

mod equal_error;
mod more;
mod pictures;
mod plates;
mod rules;
mod sample;
mod slides;
mod variance;

use super::{Halted, Leg, Reproduced, Run};
use crate::error::Error;
use crate::page::Page;
use occlude_kernel::lanes::level_name;
use occlude_kernel::{Decomposition, EstimatorError};
use std::time::Instant;

/// The command, by which its pages know each other.
pub const MAKER: &str = "occlude reproduce theory";

/// The files of data beside the page.
pub const FILES: [&str; 6] =
    ["variance.csv", "plates.csv", "halving.csv", "eight_plates.csv", "probabilities.csv", "efficiency.csv"];

/// Runs everything and makes the page.
pub fn theory(run: &Run<'_>) -> Result<Reproduced, Halted> {
    let start = Instant::now();
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(run.threads)
        .build()
        .map_err(|error| Error::Usage(format!("cannot start {} threads: {error}", run.threads)))?;
    let mut page = Page::new(
        MAKER,
        "Stochastic visibility",
        "What becomes of a shadow ray if only a random part of what may be in its way is tested: the tables \
         and figures of Niels Billen’s thesis on stochastic visibility, run again, checked, and taken on to \
         where they were not: to equal error.",
    );
    let mut data = Vec::new();
    pool.install(|| -> Result<(), Halted> {
        data.push(("variance.csv", variance::add(&Leg::new(run, 0.0, 0.05), &mut page)?));
        page.data("variance.csv", "the numbers of the tables above");
        data.push(("plates.csv", pictures::add(&Leg::new(run, 0.05, 0.2), &mut page)?));
        page.data("plates.csv", "error and work of each form, pattern, place and number of rays");
        data.extend(more::add(&Leg::new(run, 0.2, 0.35), &mut page)?);
        data.push(("probabilities.csv", rules::add(&Leg::new(run, 0.35, 0.45), &mut page)?));
        page.data("probabilities.csv", "the numbers of the tables above");
        Ok(())
    })?;
    data.push(("efficiency.csv", equal_error::add(&Leg::new(run, 0.45, 1.0), &mut page)?));
    page.data("efficiency.csv", "time, work and error of every form");
    let foot = format!(
        "Made by `{MAKER}{}` of Occlude {} in {:.0} s: {} threads, {}, seed {}. All but the times comes out \
         the same, digit for digit, whatever the number of threads. Billen, Engelen, Lagae and Dutré, \
         “Probabilistic Visibility Evaluation for Direct Illumination”, Computer Graphics Forum 32(4), \
         2013.",
        if run.quick { " --quick" } else { "" },
        env!("CARGO_PKG_VERSION"),
        start.elapsed().as_secs_f64(),
        pool.current_num_threads(),
        level_name(run.level),
        run.seed,
    );
    Ok(Reproduced { page, foot, data })
}

/// What to call a form.
fn name(form: &Decomposition) -> String {
    match form {
        Decomposition::InclusionExclusion => "Inclusion–exclusion".to_owned(),
        Decomposition::Balanced => "Balanced".to_owned(),
        Decomposition::Power(n) => format!("Power, n = {n}"),
        Decomposition::Residual { .. } => "Residual".to_owned(),
    }
}

/// A form in words and letters.
fn terms(form: &Decomposition) -> String {
    let sum = match form {
        Decomposition::InclusionExclusion => {
            "V_{A} + V_{B} + ((1 − V_{A})(1 − V_{B}) − 1), the slides’ first"
        }
        Decomposition::Balanced => {
            "(V_{A} − 1/3) + (V_{B} − 1/3) + ((1 − V_{A})(1 − V_{B}) − 1/3), the slides’ first alternative"
        }
        Decomposition::Power(_) => {
            "−V_{A}/d − V_{B}/d + (V_{A} + V_{B})^{n}/d with d = 2^{n} − 2, the slides’ second alternative, \
             for n = 8"
        }
        Decomposition::Residual { .. } => "*u* V_{A} + V_{A}(V_{B} − *u*).",
    };
    format!("*{}*: {sum}", name(form))
}

/// Numbers that this module chose, and the kernel refused.
fn unsound(error: EstimatorError) -> Halted {
    Halted::Failed(Error::Usage(format!("an estimator of this page is not sound: {error}")))
}

/// With a space between thousands.
fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push('\u{a0}');
        }
        text.push(digit);
    }
    text
}

/// The slope of a line through points on two logarithmic axes, by least squares; NaN for fewer than two.
fn slope(points: &[(f64, f64)]) -> f64 {
    let logs: Vec<(f64, f64)> =
        points.iter().map(|(x, y)| (x.ln(), y.ln())).filter(|(_, y)| y.is_finite()).collect();
    let n = logs.len() as f64;
    let (mx, my) = (logs.iter().map(|p| p.0).sum::<f64>() / n, logs.iter().map(|p| p.1).sum::<f64>() / n);
    let (up, along) = logs
        .iter()
        .fold((0.0, 0.0), |(up, along), (x, y)| (up + (x - mx) * (y - my), along + (x - mx) * (x - mx)));
    if logs.len() < 2 { f64::NAN } else { up / along }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::reproduce::Watch;
    use occlude_kernel::lanes::detect;
    use std::sync::atomic::AtomicBool;

    struct Nobody;

    impl Watch for Nobody {
        fn reached(&self, _: f64, _: &str) {}
    }

    pub(in crate::reproduce) fn run(stop: &AtomicBool) -> Run<'_> {
        Run { quick: true, seed: 0, threads: 0, level: detect(), stop, watch: &Nobody }
    }

    #[test]
    fn slopes_of_powers_are_their_exponents() {
        let half: Vec<(f64, f64)> = [1.0, 4.0, 16.0].map(|n: f64| (n, 3.0 / n.sqrt())).to_vec();
        assert!((slope(&half) + 0.5).abs() < 1e-12);
        assert!(slope(&[]).is_nan() && slope(&half[..1]).is_nan());
        assert!((slope(&[(1.0, 1.0), (2.0, 0.0), (4.0, 0.25)]) + 1.0).abs() < 1e-12, "0 has no logarithm");
    }

    #[test]
    fn told_to_stop_it_stops() {
        let stop = AtomicBool::new(true);
        assert!(matches!(theory(&run(&stop)), Err(Halted::Interrupted)));
    }
}
