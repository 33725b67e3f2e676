//! At equal error: what a form is worth once its noise is paid for.

use crate::accel::{Accel, Quality};
use crate::film::Image;
use crate::generate::{Kind, generate};
use crate::integrator::{Exact, Form, Rule, Settings, Split, Stage, Stochastic, Visibility};
use crate::light::lights;
use crate::page::{Axis, Bar, Bars, Cell, Data, Entry, Page, Picture, Strip, Table, Tone, number};
use crate::render::{Limits, render};
use crate::reproduce::{Halted, Leg};
use crate::sampler::Pattern;
use occlude_kernel::Counts;
use std::time::Instant;

/// Timed runs, at least and at most.
const LEAST_RUNS: u32 = 3;
const MOST_RUNS: u32 = 30;

/// Scenes, what they are, and their triangles.
const SCENES: [(Kind, &str); 3] = [
    (Kind::Spheres, "finely cut spheres"),
    (Kind::City, "boxes along streets"),
    (Kind::Forest, "branches and leaves"),
];

struct Size {
    pixels: (u32, u32),
    triangles: usize,
    cases: &'static [Case],
    reference_rays: u32,
    /// Timed runs go on until this many seconds are spent, and the fastest counts.
    seconds: f64,
}

/// Shadow rays a pixel, and how they are spread over a light.
#[derive(Clone, Copy)]
struct Case {
    rays: u32,
    pattern: Pattern,
}

impl Case {
    fn words(self) -> String {
        let how = if self.pattern == Pattern::Random { "independent" } else { "stratified" };
        format!("{} {how} shadow rays a pixel", self.rays)
    }
}

const STRATIFIED: Case = Case { rays: 16, pattern: Pattern::Lattice };
const MORE: Case = Case { rays: 64, pattern: Pattern::Lattice };
const INDEPENDENT: Case = Case { rays: 16, pattern: Pattern::Random };

const WHOLE: Size = Size {
    pixels: (240, 150),
    triangles: 50_000,
    cases: &[STRATIFIED, MORE, INDEPENDENT],
    reference_rays: 4096,
    seconds: 0.3,
};
const QUICK: Size = Size {
    pixels: (112, 70),
    triangles: 5_000,
    cases: &[STRATIFIED, INDEPENDENT],
    reference_rays: 1024,
    seconds: 0.05,
};

/// A way to find visibility; none is exact.
struct Way {
    name: &'static str,
    settings: Option<Settings>,
    tone: usize,
    shown: bool,
}

fn ways() -> Vec<Way> {
    let plain = |form| Settings { form, rule: Rule::Uniform, split: Split::Random, groups: 2, quotas: false };
    let way = |name, settings, tone, shown| Way { name, settings: Some(settings), tone, shown };
    let (inclusion, balanced, power, residual) = (
        plain(Form::InclusionExclusion),
        plain(Form::Balanced),
        plain(Form::Power(8)),
        plain(Form::Residual),
    );
    let optimal = |of: Settings| Settings { rule: Rule::Optimal, quotas: true, ..of };
    vec![
        Way { name: "Exact", settings: None, tone: 0, shown: true },
        way("Inclusion–exclusion", inclusion, 1, true),
        way("the same, optimal, quotas", optimal(inclusion), 1, false),
        way("Balanced", balanced, 2, true),
        way("the same, quotas", Settings { quotas: true, ..balanced }, 2, false),
        way("the same, importance", Settings { rule: Rule::Importance, ..balanced }, 2, false),
        way("the same, optimal, quotas", optimal(balanced), 2, false),
        way("the same, sorted halves", Settings { split: Split::Sorted, ..balanced }, 2, false),
        way("Power, n = 8", power, 3, true),
        way("Residual", residual, 4, true),
        way("the same, quotas", Settings { quotas: true, ..residual }, 4, false),
        way("the same, optimal, quotas", optimal(residual), 4, false),
        way("the same, sorted halves", Settings { split: Split::Sorted, ..residual }, 4, false),
        way("Levels, 8 groups", Settings { groups: 8, ..residual }, 5, false),
    ]
}

/// What a way did.
struct Measured {
    image: Image,
    /// Mean square error, and its standard error.
    mse: f64,
    mse_error: f64,
    /// Of the visibility phase, summed over threads; and on the clock with all preparations. Seconds.
    visibility: f64,
    whole: f64,
    counts: Counts,
}

impl Measured {
    /// Tests of a ray against a triangle, for each ray that exact visibility asks.
    fn tests_a_ray(&self, exact: &Self) -> f64 {
        self.counts.triangle_tests as f64 / exact.counts.rays.max(1) as f64
    }

    /// Efficiency relative to another way, by visibility alone and whole, and the relative standard error.
    fn relative(&self, to: &Self) -> (f64, f64, f64) {
        let error = (self.mse_error / self.mse).hypot(to.mse_error / to.mse);
        let squares = to.mse / self.mse;
        (squares * to.visibility / self.visibility, squares * to.whole / self.whole, error)
    }
}

pub(super) fn add(leg: &Leg<'_>, page: &mut Page) -> Result<Data, Halted> {
    let size = if leg.run.quick { QUICK } else { WHOLE };
    page.section("At equal error");
    page.prose(
        "Fewer tests a ray are a gain only if the rays do not have to be so many more. What counts is the \
         time until the error is small enough. As the mean square error falls with the number of rays, its \
         product with the time is, for a form whose error falls by the root law, always the same, and its \
         inverse is the form’s efficiency. Here it is measured, relative to that of exact visibility, on \
         scenes that this program generates: same shading points, same points on the lights (stratified), \
         same threads, one run, the mean square error against exact visibility with many more rays from the \
         same shading points. The exact method asks for all rays of a point and light in one traversal, and \
         the forms do the same for the rays that ask for a group.",
    );
    let mut data = Data::new(&[
        "scene",
        "triangles",
        "rays",
        "stratified",
        "method",
        "settings",
        "rmse",
        "mse_relative_standard_error",
        "visibility_s",
        "whole_s",
        "triangle_tests_per_ray",
        "node_tests_per_ray",
        "efficiency_visibility",
        "efficiency_whole",
    ]);
    let ways = ways();
    let shown = ways.iter().filter(|way| way.shown).map(|way| way.name.to_owned());
    let mut strip = Strip::new(
        format!("The scenes, at {}", size.cases[0].words()),
        "One shading point a pixel. Groups are random halves of the scene for each shading point.",
        std::iter::once("Reference".to_owned()).chain(shown),
    );
    let mut bars: Vec<Bars> = size
        .cases
        .iter()
        .map(|case| {
            let words = match case.pattern {
                Pattern::Random => {
                    "The same with independent points on the lights, as in the textbook: exact visibility is \
                     now as noisy as it can be, which flatters the forms."
                }
                _ => {
                    "Exact is 1. To the right is better, to the left is worse: 0.1 means ten times the time \
                     for the same error. Whiskers are 95 % intervals of the errors; times move by some \
                     percent from run to run. Tests are those of a ray against a triangle."
                }
            };
            Bars::new(
                format!("Efficiency of visibility relative to exact, at {}", case.words()),
                words,
                Axis::log("1 / (mean square error × time), exact = 1"),
                1.0,
            )
            .columns("efficiency", "tests a ray")
        })
        .collect();
    let mut tables = Vec::new();
    let mut tally = Tally::default();
    let steps = SCENES.len() * (1 + size.cases.len() * ways.len());
    let mut step = 0;
    for (kind, words) in SCENES {
        let mut next = |what: &str| {
            step += 1;
            leg.at((step - 1) as f64 / steps as f64, &format!("equal error: {}, {what}", kind.name()))
        };
        next("reference")?;
        let setting = Setting::new(leg, kind, &size)?;
        let title = format!("{}: {words}, {} triangles", kind.name(), setting.scene.triangles.len());
        for (r, &case) in size.cases.iter().enumerate() {
            let rays = case.rays;
            let mut measured = Vec::new();
            for way in &ways {
                next(&way.full_name(&ways))?;
                measured.push(setting.measure(leg, way, case, size.seconds)?);
            }
            // Once more after all others, since everything is relative to it, and the machine may have been busy.
            let again = setting.measure(leg, &ways[0], case, size.seconds)?;
            measured[0].visibility = measured[0].visibility.min(again.visibility);
            measured[0].whole = measured[0].whole.min(again.whole);
            let exact = &measured[0];
            if r == 0 {
                let shown = ways.iter().zip(&measured).filter(|(way, _)| way.shown);
                let exposure = setting.exposure();
                let reference = Picture::new(
                    &setting.reference,
                    exposure,
                    format!("{} with exact visibility, converged", kind.name()),
                );
                let pictures = shown.map(|(way, measured)| {
                    let words = format!("{}, {}, {rays} shadow rays", kind.name(), way.name);
                    Picture::new(&measured.image, exposure, words)
                        .under(format!("RMSE {}", number(measured.mse.sqrt(), 3)))
                });
                strip.row(kind.name(), std::iter::once(reference).chain(pictures));
            }
            let bar = |(way, measured): (&Way, &Measured)| {
                let (value, _, error) = measured.relative(exact);
                let error = if way.settings.is_some() { super::sample::Z95 * error * value } else { 0.0 };
                let tests = number(measured.tests_a_ray(exact), 3);
                Bar { name: way.name.to_owned(), value, error, beside: tests, tone: way.tone }
            };
            bars[r].group(title.clone(), ways.iter().zip(&measured).map(bar));
            tables.push((title.clone(), case, table(&title, case, &ways, &measured, &mut tally)));
            for (way, measured) in ways.iter().zip(&measured) {
                let (visibility, whole, _) = measured.relative(exact);
                let shots = exact.counts.rays.max(1) as f64;
                data.row([
                    Cell::from(kind.name()),
                    (setting.scene.triangles.len() as u64).into(),
                    rays.into(),
                    if case.pattern == Pattern::Random { "no" } else { "yes" }.into(),
                    way.full_name(&ways).into(),
                    way.settings.map_or("exact".to_owned(), |settings| settings.to_string()).into(),
                    measured.mse.sqrt().into(),
                    (measured.mse_error / measured.mse).into(),
                    measured.visibility.into(),
                    measured.whole.into(),
                    measured.tests_a_ray(exact).into(),
                    (measured.counts.node_tests as f64 / shots).into(),
                    visibility.into(),
                    whole.into(),
                ]);
            }
        }
    }
    page.add(&strip);
    bars.iter().for_each(|bars| page.add(bars));
    page.prose(&tally.words());
    page.in_short(tally.short());
    page.heading("The figures behind the bars");
    for (title, case, table) in &tables {
        page.folded(&format!("{title}, {}", case.words()), table);
    }
    Ok(data)
}

/// The name of the scene that a title begins with.
fn scene_of(title: &str) -> &str {
    title.split(':').next().unwrap_or(title)
}

/// Who wins, and by how much.
#[derive(Default)]
struct Tally {
    cases: usize,
    wins: usize,
    fewer_tests: usize,
    /// Where the picture is that of exact visibility.
    cases_as_exact: usize,
    as_exact: Vec<String>,
    best: Option<(f64, String)>,
    worst: Option<(f64, String)>,
}

impl Tally {
    fn add(&mut self, efficiency: f64, fewer_tests: bool, what: String) {
        self.cases += 1;
        self.wins += usize::from(efficiency > 1.0);
        self.fewer_tests += usize::from(fewer_tests);
        if self.best.as_ref().is_none_or(|(best, _)| efficiency > *best) {
            self.best = Some((efficiency, what.clone()));
        }
        if self.worst.as_ref().is_none_or(|(worst, _)| efficiency < *worst) {
            self.worst = Some((efficiency, what));
        }
    }

    fn short(&self) -> String {
        let best = self.best.as_ref().map_or(f64::NAN, |best| best.0);
        format!(
            "At equal error {} of {} cases (forms on three scenes) beat exact visibility, though {} of them \
             need fewer triangle tests a ray; the best reaches {} of its efficiency.",
            if self.wins == 0 { "none".to_owned() } else { self.wins.to_string() },
            self.cases,
            self.fewer_tests,
            number(best, 3),
        )
    }

    fn words(&self) -> String {
        let (Some((best, best_at)), Some((worst, worst_at))) = (&self.best, &self.worst) else {
            return String::new();
        };
        let wins = match self.wins {
            0 => "none is as efficient as exact visibility".to_owned(),
            wins => format!("{wins} are more efficient than exact visibility"),
        };
        let as_exact = match &self.as_exact[..] {
            [] => String::new(),
            cases => format!(
                " In {} of them the picture is that of exact visibility, bit for bit: what is in the second \
                 group, and is left out half of the time, never blocks anything there that the first does \
                 not. These are {}.",
                self.cases_as_exact,
                cases.join(" and ")
            ),
        };
        format!(
            "Of these {} cases (a form, a scene, a number of rays and their pattern) {} need fewer triangle \
             tests than exact visibility, and {wins}. The best is {best_at} with {} of its efficiency, the \
             last {worst_at} with {}.{as_exact} This is what the slides’ tables, which compare at an equal \
             number of rays, do not show: tests are saved, and more than that is lost in noise. One term of \
             a sum is the ground to stand on, and not the method that wins.",
            self.cases,
            self.fewer_tests,
            number(*best, 3),
            number(*worst, 2),
        )
    }
}

fn table(title: &str, case: Case, ways: &[Way], measured: &[Measured], tally: &mut Tally) -> Table {
    let mut table = Table::new("")
        .words("form")
        .numbers("RMSE")
        .numbers("visibility, ms")
        .numbers("whole render, ms")
        .numbers("triangle tests a ray")
        .numbers("node tests a ray")
        .numbers("efficiency, visibility")
        .numbers("efficiency, whole");
    let exact = &measured[0];
    let shots = exact.counts.rays.max(1) as f64;
    for (way, measured) in ways.iter().zip(measured) {
        let (visibility, whole, error) = measured.relative(exact);
        let (tests, exact_tests) = (measured.tests_a_ray(exact), exact.tests_a_ray(exact));
        if way.settings.is_some() {
            if measured.image == exact.image {
                let what = format!("*{}* on {}", way.full_name(ways), scene_of(title));
                tally.cases_as_exact += 1;
                if !tally.as_exact.contains(&what) {
                    tally.as_exact.push(what);
                }
            }
            tally.add(
                visibility,
                tests < exact_tests,
                format!("*{}* ({}, {})", way.full_name(ways), scene_of(title), case.words()),
            );
        }
        let fewer = way.settings.is_some() && tests < exact_tests;
        let tests = Entry::number(tests, 3);
        let efficiency = match way.settings {
            None => Entry::from("1"),
            Some(_) => Entry::with_error(visibility, super::sample::Z95 * error * visibility),
        };
        table.row([
            Entry::from(way.name),
            Entry::number(measured.mse.sqrt(), 3),
            Entry::number(measured.visibility * 1e3, 3),
            Entry::number(measured.whole * 1e3, 3),
            if fewer { tests.tone(Tone::Good) } else { tests },
            Entry::number(measured.counts.node_tests as f64 / shots, 3),
            if visibility > 1.0 { efficiency.tone(Tone::Good) } else { efficiency },
            Entry::number(whole, 3),
        ]);
    }
    table
}

impl Way {
    /// With the name of the form that it varies.
    fn full_name(&self, ways: &[Way]) -> String {
        match self.name.strip_prefix("the same, ") {
            Some(change) => {
                let first = ways.iter().find(|way| way.tone == self.tone).map_or("", |way| way.name);
                format!("{first}, {change}")
            }
            None => self.name.to_owned(),
        }
    }
}

/// A scene, its tree, and what its picture should be.
struct Setting {
    scene: crate::scene::Scene,
    accel: Accel,
    lights: Vec<crate::light::AreaLight>,
    size: (u32, u32),
    reference: Image,
}

impl Setting {
    fn new(leg: &Leg<'_>, kind: Kind, size: &Size) -> Result<Self, Halted> {
        let scene = generate(kind, leg.run.seed, size.triangles);
        let accel = Accel::build(&scene, Quality::Medium);
        let lights = lights(&scene);
        let mut setting = Self { scene, accel, lights, size: size.pixels, reference: Image::new(0, 0) };
        setting.reference =
            setting.render(leg, &Exact, Case { rays: size.reference_rays, ..STRATIFIED }, false)?.image;
        Ok(setting)
    }

    /// Brings the mean of the reference to a fifth.
    fn exposure(&self) -> f32 {
        let pixels = &self.reference.pixels;
        let mean =
            pixels.iter().flatten().map(|&v| f64::from(v)).sum::<f64>() / (3 * pixels.len().max(1)) as f64;
        (0.2 / mean.max(1e-30)).log2() as f32
    }

    /// One pass: the same shading points whatever the method and the number of rays.
    fn render(
        &self,
        leg: &Leg<'_>,
        method: &dyn Visibility,
        case: Case,
        count: bool,
    ) -> Result<Measured, Halted> {
        let run = leg.run;
        let missing = || crate::Error::Usage("a generated scene has no camera".to_owned());
        let mut camera = self.scene.camera.ok_or_else(missing)?;
        (camera.width, camera.height) = self.size;
        let frame = camera.frame();
        let stage = Stage {
            scene: &self.scene,
            bvh: self.accel.bvh(),
            lights: &self.lights,
            eye: camera.eye,
            camera: &frame,
            shadow_rays: case.rays,
            pattern: case.pattern,
            seed: run.seed,
            level: run.level,
            count,
        };
        let limits = Limits { passes: 1, time: None };
        let rendered = render(&stage, method, self.size, limits, run.threads, run.stop, |_| ())?;
        run.go_on()?;
        let image = rendered.film.develop();
        let (mse, mse_error) = self.error(&image);
        Ok(Measured {
            image,
            mse,
            mse_error,
            visibility: rendered.times.visibility.as_secs_f64(),
            whole: rendered.elapsed.as_secs_f64(),
            counts: rendered.shadow_counts,
        })
    }

    fn measure(&self, leg: &Leg<'_>, way: &Way, case: Case, seconds: f64) -> Result<Measured, Halted> {
        let start = Instant::now();
        let method: Box<dyn Visibility> = match way.settings {
            None => Box::new(Exact),
            Some(settings) => Box::new(Stochastic::new(settings, &self.scene, &self.accel.bvh())?),
        };
        let prepared = start.elapsed().as_secs_f64();
        let mut measured = self.render(leg, &*method, case, true)?;
        (measured.visibility, measured.whole) = (f64::INFINITY, f64::INFINITY);
        let (mut runs, start) = (0, Instant::now());
        while runs < LEAST_RUNS || (start.elapsed().as_secs_f64() < seconds && runs < MOST_RUNS) {
            runs += 1;
            let timed = self.render(leg, &*method, case, false)?;
            measured.visibility = measured.visibility.min(timed.visibility);
            measured.whole = measured.whole.min(timed.whole + prepared);
        }
        Ok(measured)
    }

    /// Mean square difference from the reference, and its standard error; 0 for the reference itself.
    fn error(&self, image: &Image) -> (f64, f64) {
        let n = self.reference.pixels.len() as f64;
        if n == 0.0 {
            return (0.0, 0.0);
        }
        let squares = image.pixels.iter().zip(&self.reference.pixels).map(|(a, b)| {
            a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>() / 3.0
        });
        let (sum, square) = squares.fold((0.0, 0.0), |(sum, square), d| (sum + d, square + d * d));
        let mean = sum / n;
        (mean, ((square / n - mean * mean).max(0.0) / n).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reproduce::theory::tests::run;
    use std::sync::atomic::AtomicBool;

    /// Same points: the reference has no error against itself, more rays have less, and one term has more than exact
    /// visibility.
    #[test]
    fn errors_are_those_of_visibility_alone() {
        let stop = AtomicBool::new(false);
        let run = run(&stop);
        let leg = Leg::new(&run, 0.0, 1.0);
        let size = Size { pixels: (40, 25), triangles: 2_000, reference_rays: 512, ..QUICK };
        let setting = Setting::new(&leg, Kind::Spheres, &size).expect("nobody stops it");
        assert_eq!(setting.error(&setting.reference), (0.0, 0.0));
        let ways = ways();
        let error = |way: &Way, rays| {
            setting.measure(&leg, way, Case { rays, ..STRATIFIED }, 0.0).expect("nobody stops it").mse
        };
        let [few, many] = [4, 64].map(|rays| error(&ways[0], rays));
        assert!(many > 0.0 && many < 0.3 * few, "{few} {many}");
        let balanced = ways.iter().find(|way| way.name == "Balanced").expect("one of them");
        assert!(error(balanced, 64) > 4.0 * many);
    }

    #[test]
    fn variations_have_the_name_of_their_form() {
        let ways = ways();
        let names: Vec<String> = ways.iter().map(|way| way.full_name(&ways)).collect();
        assert!(names.iter().all(|name| !name.contains("same")), "{names:?}");
        assert!(names.iter().enumerate().all(|(i, name)| !names[..i].contains(name)), "{names:?}");
    }
}
