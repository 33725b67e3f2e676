//! Probabilities of the terms: equal, the thesis' importance sampling, optimal; drawn one by one or by quota.

use super::pictures::two_plates;
use super::plates::Pixel;
use super::{name, unsound};
use crate::page::{Cell, Data, Entry, Page, Table, Tone, number};
use crate::reproduce::{Halted, Leg};
use crate::sampler::{Pattern, Sampler};
use occlude_kernel::decomposition::{Joint, Tally};
use occlude_kernel::{Decomposition, Estimator, EstimatorError, Group, OneTerm, Probabilities, Quotas};
use std::time::Instant;

/// Test rays a point, as many as the thesis takes.
const TEST_RAYS: usize = 64;
/// What a term that no test ray spoke for gets at least.
const LEAST: f64 = 0.5 / TEST_RAYS as f64;
/// Rays a pixel that are measured.
const RAYS: u32 = 64;

#[derive(Clone, Copy, PartialEq, Eq)]
enum Rule {
    Uniform,
    Importance,
    Optimal,
}

const RULES: [Rule; 3] = [Rule::Uniform, Rule::Importance, Rule::Optimal];

impl Rule {
    fn words(self) -> &'static str {
        match self {
            Self::Uniform => "equal",
            Self::Importance => "importance",
            Self::Optimal => "optimal",
        }
    }

    /// For what is known of a point, with both groups as costly.
    fn probabilities(
        self,
        form: &Decomposition,
        joint: &Joint,
        least: f64,
    ) -> Result<Probabilities, EstimatorError> {
        match self {
            Self::Uniform => Ok(Probabilities::UNIFORM),
            Self::Importance => Probabilities::importance(form, joint, least),
            Self::Optimal => Probabilities::optimal(form, joint, &form.costs(joint, 0.0, 1.0, 1.0), least),
        }
    }
}

const FORMS: [Decomposition; 3] =
    [Decomposition::InclusionExclusion, Decomposition::Balanced, Decomposition::Power(8)];

pub(super) fn add(leg: &Leg<'_>, page: &mut Page) -> Result<Data, Halted> {
    page.section("Importance sampling, and what would be better");
    page.prose(
        "The terms need not be equally likely. The thesis traces 64 test rays from each point, estimates \
         what each term contributes, and chooses terms in proportion. That would be right for terms that \
         vary little; those of the first form are 0 or ±1. The least variance for given work has *p* in \
         proportion to the root of the term’s mean square over its cost (“optimal” below). And instead of \
         drawing a term for each ray, one can give exactly the right share of a pixel’s rays to each term \
         (quotas), which takes the noise of the draw out.",
    );
    let mut data = Data::new(&[
        "table",
        "form",
        "rule",
        "quotas",
        "variance_per_ray",
        "groups_asked_per_ray",
        "variance_times_asked",
        "rmse",
        "test_rays_asked",
        "ns_per_ray",
    ]);
    let unchanged = closed_forms(leg, page, &mut data)?;
    measured(leg, page, &mut data, unchanged)?;
    Ok(data)
}

/// For the points of the two plates' floor where both cast a shadow, if all were known of each point.
fn closed_forms(leg: &Leg<'_>, page: &mut Page, data: &mut Data) -> Result<f64, Halted> {
    leg.at(0.0, "probabilities of terms")?;
    let plates = two_plates(leg.run.quick);
    let partly = |chance: f64| chance > 0.0 && chance < 1.0;
    // All three terms contribute.
    let joints: Vec<Joint> = (0..plates.pixels())
        .filter_map(|pixel| plates.joint(pixel))
        .filter(|joint| partly(joint.a_visible()) && partly(joint.chances()[1] + joint.chances()[3]))
        .collect();
    let mut table = Table::new(format!(
        "One ray, if (V_{{A}}, V_{{B}}) were known at each point: mean over the {} points where each of the \
         two plates hides part of the light",
        joints.len()
    ))
    .words("form, probabilities")
    .numbers("variance of one ray")
    .numbers("with quotas, a ray")
    .numbers("groups asked a ray")
    .numbers("variance × work, equal = 1")
    .numbers("with quotas");
    let mut gain = [f64::NAN; 2];
    for form in FORMS {
        table.group(name(&form));
        let mut first = (f64::NAN, f64::NAN);
        for rule in RULES {
            let (mut variance, mut quotas, mut asked) = (0.0, 0.0, 0.0);
            for joint in &joints {
                let one = OneTerm::new(form, &rule.probabilities(&form, joint, 0.0).map_err(unsound)?)
                    .map_err(unsound)?;
                variance += one.total_variance(joint);
                quotas += one.quota_variance(joint);
                asked += one.mean_cost(&form.costs(joint, 0.0, 1.0, 1.0));
            }
            let [variance, quotas, asked] = [variance, quotas, asked].map(|sum| sum / joints.len() as f64);
            if rule == Rule::Uniform {
                first = (variance * asked, variance);
            }
            let (relative, relative_quotas) = (variance * asked / first.0, quotas * asked / first.0);
            if form == Decomposition::InclusionExclusion && rule == Rule::Importance {
                gain[0] = variance / first.1;
            }
            if form == Decomposition::InclusionExclusion && rule == Rule::Optimal {
                gain[1] = relative_quotas;
            }
            table.row([
                Entry::from(rule.words()),
                Entry::number(variance, 5),
                Entry::number(quotas, 5),
                Entry::number(asked, 4),
                Entry::number(relative, 3),
                Entry::number(relative_quotas, 3).tone(if relative_quotas < 0.999 {
                    Tone::Good
                } else {
                    Tone::Faint
                }),
            ]);
            for (quotas_used, variance) in [("no", variance), ("yes", quotas)] {
                data.row([
                    Cell::from("closed form"),
                    name(&form).into(),
                    rule.words().into(),
                    quotas_used.into(),
                    variance.into(),
                    asked.into(),
                    (variance * asked).into(),
                ]);
            }
        }
    }
    page.add(&table);
    page.prose(&format!(
        "For {} the thesis’ importance sampling changes the variance of one ray by a factor of {}: nothing, \
         and not by accident. Its terms are 0 or ±1, so their mean size is their mean square, and with *p* \
         in proportion to it the variance Σ E[s²]/p − V² comes out exactly as with equal probabilities, as \
         long as no term is 0 for all rays. Optimal probabilities together with quotas bring variance times \
         work to {} of that of equal ones.",
        name(&FORMS[0]),
        number(gain[0], 6),
        number(gain[1], 2),
    ));
    Ok(gain[0])
}

/// With test rays that are really traced.
fn measured(leg: &Leg<'_>, page: &mut Page, data: &mut Data, unchanged: f64) -> Result<(), Halted> {
    let plates = two_plates(leg.run.quick);
    let reference: Vec<f64> = (0..plates.pixels()).map(|pixel| plates.reference(pixel)).collect();
    let mut table = Table::new(format!(
        "The two plates at {RAYS} stratified rays a pixel, with the {TEST_RAYS} test rays a point that \
         importance sampling and optimal probabilities want"
    ))
    .words("form, probabilities")
    .numbers("RMSE")
    .numbers("plates asked a pixel")
    .numbers("of it by test rays")
    .numbers("error² × asked, equal = 1")
    .numbers("time, ns a ray");
    let exact_way = |pixel: &Pixel<'_>, _: &mut Sampler| {
        pixel.sum(|k| f64::from(u8::from(pixel.visible(0, k) && pixel.visible(1, k))))
    };
    let time = |start: Instant| {
        let seconds = start.elapsed().as_secs_f64() * rayon::current_num_threads() as f64;
        seconds * 1e9 / (plates.pixels() as f64 * f64::from(RAYS))
    };
    let start = Instant::now();
    let exact = plates.picture(leg.run, Pattern::Lattice, RAYS, exact_way)?;
    let exact_time = time(start);
    let exact_asked = exact.asked_a_ray(1, |_| true);
    let exact_rmse = exact.rmse(&reference, |_| true);
    table.row([
        Entry::from("exact visibility"),
        Entry::number(exact_rmse, 3),
        Entry::number(exact_asked, 4),
        Entry::from("0"),
        Entry::from("–"),
        Entry::number(exact_time, 3),
    ]);
    let mut step = 0;
    let mut best = (f64::INFINITY, String::new());
    let mut gains = Vec::new();
    for form in FORMS {
        table.group(name(&form));
        let mut works = Vec::new();
        let mut first = f64::NAN;
        for rule in RULES {
            for quotas in [false, true] {
                leg.at(0.2 + 0.8 * f64::from(step) / 18.0, "probabilities of terms")?;
                step += 1;
                let way =
                    |pixel: &Pixel<'_>, random: &mut Sampler| learned(pixel, random, form, rule, quotas);
                let start = Instant::now();
                let painted = plates.picture(leg.run, Pattern::Lattice, RAYS, way)?;
                let ns = time(start);
                let asked = painted.asked_a_ray(1, |_| true);
                let tests = if rule == Rule::Uniform { 0.0 } else { 2.0 * TEST_RAYS as f64 };
                let rmse = painted.rmse(&reference, |_| true);
                let work = rmse * rmse * asked;
                if first.is_nan() {
                    first = work;
                }
                let words =
                    if quotas { format!("{}, quotas", rule.words()) } else { rule.words().to_owned() };
                works.push(work / first);
                let against_exact = work / (exact_rmse * exact_rmse * exact_asked);
                if against_exact < best.0 {
                    best = (against_exact, format!("{}, {words}", name(&form)));
                }
                table.row([
                    Entry::from(words),
                    Entry::number(rmse, 3),
                    Entry::number(asked, 4),
                    Entry::number(tests, 3),
                    Entry::number(work / first, 3),
                    Entry::number(ns, 3),
                ]);
                data.row([
                    Cell::from("measured"),
                    name(&form).into(),
                    rule.words().into(),
                    if quotas { "yes" } else { "no" }.into(),
                    Cell::from(""),
                    (asked / f64::from(RAYS)).into(),
                    Cell::from(""),
                    rmse.into(),
                    tests.into(),
                    ns.into(),
                ]);
            }
        }
        if let [_, quotas, importance, _, optimal, both] = works[..] {
            let [quotas, importance, optimal, both] =
                [quotas, importance, optimal, both].map(|work| number(work, 2));
            gains.push(format!(
                "{}: {importance} by importance, {optimal} optimal, {quotas} by quotas alone, {both} optimal \
                 with quotas",
                name(&form)
            ));
        }
    }
    page.add(&table);
    page.prose(&format!(
        "Test rays are not free: here they ask {} plates a pixel, where exact visibility asks {} for \
         everything. Squared error × plates asked, with equal probabilities as 1: {}. Quotas take no tests \
         at all, and by their closed form they can only help. The best of all these is *{}*, and has {} \
         times the squared error × work of exact visibility.",
        2 * TEST_RAYS,
        number(exact_asked, 3),
        gains.join("; "),
        best.1,
        number(best.0, 3),
    ));
    page.in_short(format!(
        "The thesis’ importance sampling changes the variance of inclusion–exclusion by a factor of {}. Of \
         all probabilities tried on two plates the best has {} times the squared error × work of exact \
         visibility.",
        number(unchanged, 6),
        number(best.0, 3),
    ));
    Ok(())
}

/// A pixel by a rule that first learns, if it has something to learn.
fn learned(pixel: &Pixel<'_>, random: &mut Sampler, form: Decomposition, rule: Rule, quotas: bool) -> f64 {
    let mut probabilities = Probabilities::UNIFORM;
    if rule != Rule::Uniform {
        let mut square = Vec::with_capacity(TEST_RAYS);
        random.points(Pattern::Lattice, TEST_RAYS, &mut square);
        let mut tally = Tally::default();
        square.iter().for_each(|&at| tally.add(pixel.test(0, at), pixel.test(1, at)));
        if let Some(joint) = tally.joint() {
            probabilities = rule.probabilities(&form, &joint, LEAST).unwrap_or_default();
        }
    }
    // The forms are sound whatever the probabilities.
    let Ok(one) = OneTerm::new(form, &probabilities) else { return f64::NAN };
    let ask = |k| move |group| pixel.visible(if group == Group::A { 0 } else { 1 }, k);
    if quotas {
        let quotas = Quotas::new(pixel.rays() as u32, random.uniform(), random.word());
        pixel.sum(|k| f64::from(one.estimate(quotas.number(k as u32), ask(k))))
    } else {
        pixel.sum(|k| f64::from(one.estimate(random.uniform(), ask(k))))
    }
}
