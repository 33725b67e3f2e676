//! The variance tables: in closed form, by sampling, and as the slides print them.

use super::sample::{Z95, sample};
use super::{grouped, name, slides, terms};
use crate::page::{Cell, Data, Entry, Page, Table, Tone};
use crate::reproduce::{Halted, Leg};
use occlude_kernel::decomposition::Joint;
use occlude_kernel::{Decomposition, Estimator, Group, OneTerm, Probabilities};

const CELLS: [(bool, bool); 4] = [(false, false), (false, true), (true, false), (true, true)];
const THIRDS: [f64; 3] = [1.0 / 3.0; 3];

pub(super) fn add(leg: &Leg<'_>, page: &mut Page) -> Result<Data, Halted> {
    page.section("The variance of one ray, two ways");
    page.prose(
        "Divide what may be in the way into two groups, A and B, and let V_{A} be 1 if group A lets a ray \
         through and 0 if not. Then the ray arrives if V = V_{A} V_{B} is 1. A product can be written as a \
         sum, in many ways. To evaluate a sum at random one takes only one of its terms, with a probability \
         *p*, and divides it by *p*: on average that is the sum. A term that asks for one group leaves the \
         other one untested, which is what is saved. The price is noise, and how much of it depends on the \
         sum.",
    );
    page.list([
        terms(&Decomposition::InclusionExclusion),
        terms(&Decomposition::Balanced),
        terms(&Decomposition::Power(8)),
    ]);
    let count = 1_000_000;
    let mut data = Data::new(&[
        "form",
        "v_a",
        "v_b",
        "v",
        "estimate_1",
        "estimate_2",
        "estimate_3",
        "variance_closed_form",
        "samples",
        "variance_sampled",
        "variance_half_width_95",
        "mean_sampled",
        "mean_half_width_95",
        "variance_slides",
        "slides_agree",
    ]);
    let mut table = Table::new("Variance of one evaluation, each term with probability 1/3")
        .words("V_{A}, V_{B}")
        .numbers("V")
        .numbers("first term")
        .numbers("second")
        .numbers("third")
        .numbers("variance, closed form")
        .numbers(format!("from {} samples, 95 %", grouped(count)))
        .numbers("on the slides")
        .words("");
    let slip = table.note(
        "The slides print half of the right number: two of the three outcomes are not 0, 3/254 and −3/254, \
         each with probability 1/3, so the variance is (2/3)·(3/254)² = 6/254². The picture that goes with \
         it is not affected.",
    );
    let mut worst: f64 = 0.0;
    let mut differing = 0;
    for (f, printed) in slides::FORMS.iter().enumerate() {
        table.group(name(&printed.form));
        let one = OneTerm::new(printed.form, &Probabilities::UNIFORM).map_err(super::unsound)?;
        for (c, &(a, b)) in CELLS.iter().enumerate() {
            leg.at((f * 4 + c) as f64 / 12.0, "variances")?;
            let v = f64::from(u8::from(a && b));
            let closed = printed.form.variance(THIRDS, a, b);
            let ask = |group| if group == Group::A { a } else { b };
            let stream = (f * 4 + c) as u64;
            let seen = sample(leg.run, stream, count, v, |random| {
                (f64::from(one.estimate(random.uniform(), ask)), 0)
            })?;
            worst = worst.max(seen.off(closed));
            let estimates = [0, 1, 2].map(|term| printed.form.value(THIRDS, term, a, b));
            let agree = estimates
                .iter()
                .zip(printed.estimates[c])
                .all(|(&value, printed)| slides::agrees(printed, value));
            let right = slides::agrees(printed.variances[c], closed);
            differing += usize::from(!right) + usize::from(!agree);
            let mut row = vec![Entry::from(format!("{}, {}", u8::from(a), u8::from(b))), Entry::number(v, 1)];
            row.extend(estimates.iter().zip(printed.estimates[c]).map(|(&value, printed)| {
                let fraction = printed.contains('/') && slides::agrees(printed, value);
                Entry::from(if fraction { printed.replace('-', "−") } else { crate::page::short(value) })
            }));
            row.push(variance_entry(closed));
            row.push(match seen.variance_error {
                error if error > 0.0 => Entry::with_error(seen.variance, Z95 * error),
                _ => Entry::number(seen.variance, 3),
            });
            let slide = Entry::from(printed.variances[c].replace("e-5", "×10⁻⁵"));
            if right && agree {
                row.push(slide);
                row.push(Entry::from("agrees").tone(Tone::Good));
            } else {
                row.push(slide.tone(Tone::Bad).noted(slip));
                row.push(Entry::from("slip").tone(Tone::Bad));
            }
            table.row(row);
            data.row([
                Cell::from(name(&printed.form)),
                u32::from(a).into(),
                u32::from(b).into(),
                v.into(),
                estimates[0].into(),
                estimates[1].into(),
                estimates[2].into(),
                closed.into(),
                count.into(),
                seen.variance.into(),
                (Z95 * seen.variance_error).into(),
                seen.mean.into(),
                (Z95 * seen.mean_error()).into(),
                printed.variances[c].into(),
                if right { "yes" } else { "no" }.into(),
            ]);
        }
    }
    page.add(&table);
    page.prose(&format!(
        "The two ways agree: of the twelve sampled variances the one that is furthest from its closed form \
         is off by {} of its standard errors. The first form is silent where both groups block, and loudest \
         where nothing is in the way, which in most pictures is nearly everywhere. The second has the same \
         noise everywhere, also where there is nothing to be uncertain about. The third is nearly silent \
         unless the light is visible, but the one term that counts asks both groups, so nothing is saved \
         when it is taken.",
        crate::page::number(worst, 2)
    ));
    page.in_short(format!(
        "Of the slides’ variance tables all but {differing} figures are right to the last digit printed; \
         those should be {}.",
        crate::page::number(slides::FORMS[2].form.variance(THIRDS, false, true), 3),
    ));
    if differing > 0 {
        page.prose(&format!(
            "Of the slides’ figures {differing} differ from what follows from their own formulas, as marked; \
             all others in the table above are right to the last digit printed."
        ));
    }
    averages(page);
    residual(leg, page, &mut data)?;
    Ok(data)
}

/// A variance in closed form: what rounding left of a whole number is not shown.
fn variance_entry(closed: f64) -> Entry {
    if (closed - closed.round()).abs() < 1e-9 {
        crate::page::short(closed.round()).into()
    } else {
        Entry::number(closed, if closed < 1e-3 { 3 } else { 5 })
    }
}

/// The slides' average over three scenes.
fn averages(page: &mut Page) {
    let mut table = Table::new("The slides’ first results, and what they average to")
        .words("occlusion map, plain")
        .numbers("time without, s")
        .numbers("with")
        .numbers("change")
        .numbers("tests without, 10⁶")
        .numbers("with")
        .numbers("change");
    let change = |[without, with]: [f64; 2]| 100.0 * (with / without - 1.0);
    let percent = |change: f64| Entry::from(format!("{} %", crate::page::number(change, 3)));
    for scene in &slides::PLAIN {
        table.row([
            Entry::from(scene.name),
            Entry::number(scene.time[0], 3),
            Entry::number(scene.time[1], 3),
            percent(change(scene.time)),
            Entry::number(scene.tests[0], 4),
            Entry::number(scene.tests[1], 4),
            percent(change(scene.tests)),
        ]);
    }
    let mean = |of: fn(&slides::Scene) -> [f64; 2]| {
        slides::PLAIN.iter().map(|scene| change(of(scene))).sum::<f64>() / slides::PLAIN.len() as f64
    };
    let (time, tests) = (mean(|scene| scene.time), mean(|scene| scene.tests));
    let [fewer_tests, less_time] = slides::PLAIN_AVERAGE;
    let note = table.note(format!(
        "The slides sum this up as {fewer_tests} % fewer intersection tests and {less_time} % less time. \
         Their own three scenes average {} % and {} %; the second scene’s tests alone fell by {} %.",
        crate::page::number(-tests, 3),
        crate::page::number(-time, 2),
        crate::page::number(-change(slides::PLAIN[1].tests), 3),
    ));
    let verdict = |printed: &str, mean: f64| {
        let right = printed.parse::<f64>().is_ok_and(|printed| (printed + mean).abs() <= 0.5);
        let tone = if right { Tone::Good } else { Tone::Bad };
        Entry::from(format!("−{printed} %")).tone(tone).noted(note)
    };
    let blank = || Entry::from("");
    table.row([
        Entry::from("average of the three"),
        blank(),
        blank(),
        percent(time),
        blank(),
        blank(),
        percent(tests),
    ]);
    table.row([
        Entry::from("as the slides say"),
        blank(),
        blank(),
        verdict(less_time, time),
        blank(),
        blank(),
        verdict(fewer_tests, tests),
    ]);
    page.add(&table);
}

/// The form that is not on the slides.
fn residual(leg: &Leg<'_>, page: &mut Page, data: &mut Data) -> Result<(), Halted> {
    page.heading("A form that is not on the slides");
    page.prose(&format!(
        "{} It looks at A first, always, and goes on to B only if A lets the ray through, and then only with \
         a chance *q*. Whatever number *u* one guesses for the rest, it is right on average; a good guess \
         makes it quiet.",
        terms(&Decomposition::Residual { q: 0.5, u: 1.0 })
    ));
    let mut table = Table::new("Variance of one evaluation of the residual form")
        .words("V_{A}, V_{B}")
        .numbers("variance, closed form")
        .numbers("from 1 000 000 samples, 95 %")
        .numbers("groups asked");
    for (k, (q, u)) in [(0.4f32, 1.0f32), (0.15, 1.0), (0.4, 0.75)].into_iter().enumerate() {
        let form = Decomposition::Residual { q, u };
        let one = OneTerm::new(form, &Probabilities::UNIFORM).map_err(super::unsound)?;
        table.group(format!("*q* = {q}, *u* = {u}"));
        for (c, &(a, b)) in CELLS.iter().enumerate() {
            leg.at(1.0, "variances")?;
            let v = f64::from(u8::from(a && b));
            let stream = 100 + (k * 4 + c) as u64;
            let seen = sample(leg.run, stream, 1_000_000, v, |random| {
                let mut asked = 0;
                let estimate = one.estimate(random.uniform(), |group| {
                    asked += 1;
                    if group == Group::A { a } else { b }
                });
                (f64::from(estimate), asked)
            })?;
            let closed = form.total_variance(one.chances(), &Joint::certain(a, b));
            table.row([
                Entry::from(format!("{}, {}", u8::from(a), u8::from(b))),
                variance_entry(closed),
                match seen.variance_error {
                    error if error > 0.0 => Entry::with_error(seen.variance, Z95 * error),
                    _ => Entry::number(seen.variance, 3),
                },
                Entry::number(seen.asked, 3),
            ]);
            data.row([
                Cell::from(format!("residual q={q} u={u}")),
                u32::from(a).into(),
                u32::from(b).into(),
                v.into(),
                Cell::from(""),
                Cell::from(""),
                Cell::from(""),
                closed.into(),
                seen.count.into(),
                seen.variance.into(),
                (Z95 * seen.variance_error).into(),
                seen.mean.into(),
                (Z95 * seen.mean_error()).into(),
            ]);
        }
    }
    page.add(&table);
    Ok(())
}
