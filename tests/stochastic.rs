//! Stochastic visibility against exact, on whole images.
//!
//! The difference of the two is rendered itself, with the same camera rays and light samples, so that its noise is
//! that of the random terms alone. Its mean over blocks of pixels must be 0 within five standard errors, which the
//! passes give.

use glam::Vec3;
use occlude_host::accel::{Accel, Quality};
use occlude_host::generate::{Kind, generate};
use occlude_host::integrator::{
    Exact, Form, Map, MapOptions, MapTerms, PreparedMap, Questions, Rule, Settings, Split, Stage, Stochastic,
    Visibility,
};
use occlude_host::light::{AreaLight, lights};
use occlude_host::photons::BlockerKind;
use occlude_host::render::{Limits, Rendered, render};
use occlude_host::sampler::Pattern;
use occlude_host::scene::{CameraRequest, Scene, load};
use occlude_host::volumetric::Volumes;
use occlude_kernel::Counts;
use occlude_kernel::lanes::{detect, levels};
use std::path::Path;
use std::sync::atomic::AtomicBool;

struct Setting {
    scene: Scene,
    accel: Accel,
    lights: Vec<AreaLight>,
}

impl Setting {
    fn of(mut scene: Scene, size: (u32, u32)) -> Self {
        let camera = scene.camera.as_mut().expect("a camera");
        (camera.width, camera.height) = size;
        Self { accel: Accel::build(&scene, Quality::Medium), lights: lights(&scene), scene }
    }

    fn own(name: &str, size: (u32, u32)) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes").join(name);
        Self::of(load(&folder, &CameraRequest::default()).expect("the scene loads"), size)
    }

    fn method(&self, settings: Settings) -> Stochastic {
        Stochastic::new(settings, &self.scene, &self.accel.bvh()).expect("the settings go together")
    }

    fn render(&self, method: &dyn Visibility, passes: u32, threads: usize, simd: usize) -> Rendered {
        let camera = self.scene.camera.expect("a camera");
        let frame = camera.frame();
        let stage = Stage {
            scene: &self.scene,
            bvh: self.accel.bvh(),
            lights: &self.lights,
            eye: camera.eye,
            camera: &frame,
            shadow_rays: SHADOW_RAYS,
            pattern: Pattern::default(),
            seed: 3,
            level: levels().nth(simd).unwrap_or_else(detect),
            count: false,
        };
        let limits = Limits { passes, time: None };
        let size = (camera.width, camera.height);
        render(&stage, method, size, limits, threads, &AtomicBool::new(false), |_| ()).expect("it renders")
    }
}

/// A method less the exact one.
struct Less<F>(Stochastic, F);

impl<F: Fn(f32) -> f32 + Sync> Visibility for Less<F> {
    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        let mut exact = Vec::new();
        Exact.estimate(stage, questions, &mut exact, counts);
        self.0.estimate(stage, questions, estimates, counts);
        assert_eq!(estimates.len(), exact.len());
        estimates.iter_mut().zip(&exact).for_each(|(x, v)| *x = self.1(*x) - v);
    }
}

/// Lets nothing through, so that only what emits is seen.
struct Dark;

impl Visibility for Dark {
    fn estimate(&self, _: &Stage<'_>, questions: &Questions, estimates: &mut Vec<f32>, _: &mut Counts) {
        estimates.clear();
        estimates.resize(questions.weights.len(), 0.0);
    }
}

const BLOCK: u32 = 16;
const SHADOW_RAYS: u32 = 12;

/// The block whose mean is the most standard errors away from 0, and how many.
///
/// Where a learned residual errs rarely, and then by 16, it may not have erred yet, and the passes know of no noise. So
/// for `rare` two errors more are allowed for, each a sample of the block's brightest pixel.
fn worst(setting: &Setting, difference: &Rendered, rare: bool) -> (f64, String) {
    let passes = difference.passes;
    let [dark, lit] =
        [&Dark as &dyn Visibility, &Exact].map(|method| setting.render(method, passes, 0, 0).film.develop());
    let error_of = if rare { 2.0 * 16.0 / f64::from(SHADOW_RAYS * passes) } else { 0.0 };
    let (mean, error) = (difference.film.develop(), difference.film.standard_error());
    let (mut worst, mut told) = (0.0f64, String::new());
    let mut noisy = 0;
    for top in (0..mean.height).step_by(BLOCK as usize) {
        for left in (0..mean.width).step_by(BLOCK as usize) {
            let (mut sum, mut variance, mut brightest) = (0.0, 0.0, 0.0f64);
            for y in top..(top + BLOCK).min(mean.height) {
                for x in left..(left + BLOCK).min(mean.width) {
                    let at = (y * mean.width + x) as usize;
                    sum += f64::from(mean.pixels[at][1] - dark.pixels[at][1]);
                    variance += f64::from(error.pixels[at][1]).powi(2);
                    brightest = brightest.max(f64::from(lit.pixels[at][1] - dark.pixels[at][1]));
                }
            }
            noisy += u32::from(variance > 1e-12);
            let off = sum / (variance + (error_of * brightest).powi(2) + 1e-12).sqrt();
            if off.abs() > worst.abs() {
                (worst, told) = (off, format!("block at {left}, {top}: {off:+.2} standard errors"));
            }
        }
    }
    assert!(noisy >= 2, "only {noisy} blocks have any noise");
    (worst.abs(), told)
}

const FORMS: [Form; 4] = [Form::InclusionExclusion, Form::Balanced, Form::Power(8), Form::Residual];
const SPLITS: [Split; 3] = [Split::Random, Split::Sorted, Split::Object];

fn check(setting: &Setting, settings: Settings, passes: u32) {
    let difference = setting.render(&Less(setting.method(settings), |x| x), passes, 0, 0);
    let learned = settings.form == Form::Residual && settings.rule == Rule::Optimal;
    let (off, told) = worst(setting, &difference, learned);
    println!("{}, {settings}: {told}", setting.scene.name);
    assert!(off < 5.0, "{}, {settings}: {told}", setting.scene.name);
}

/// Which rule and whether quotas go with the i-th case, so that each is met.
fn turn(form: Form, i: usize) -> (Rule, bool) {
    let rule = [Rule::Uniform, Rule::Optimal, Rule::Importance][i % 3];
    let rule = if form == Form::Residual && rule == Rule::Importance { Rule::Uniform } else { rule };
    (rule, i % 2 == 1)
}

/// Every form with every split, on scenes of single triangles and of subtrees.
#[test]
fn images_are_right_on_average() {
    for setting in [Setting::own("plates", (48, 48)), Setting::own("columns", (64, 36))] {
        for (i, form) in FORMS.into_iter().enumerate() {
            for (j, split) in SPLITS.into_iter().enumerate() {
                let (rule, quotas) = turn(form, i + j);
                check(&setting, Settings { form, rule, split, groups: 2, quotas }, 24);
            }
        }
        for (groups, rule) in
            [(3, Rule::Uniform), (3, Rule::Optimal), (64, Rule::Uniform), (17, Rule::Optimal)]
        {
            let split = if groups == 3 { Split::Sorted } else { Split::Random };
            check(&setting, Settings { form: Form::Residual, rule, split, groups, quotas: groups == 3 }, 24);
        }
    }
}

/// All of it, longer, on more scenes.
#[test]
#[ignore = "takes minutes"]
fn images_are_right_on_average_long() {
    let own = ["plates", "cornell", "columns", "fence"].map(|name| Setting::own(name, (96, 64)));
    let generated = [Kind::Spheres, Kind::Hair].map(|kind| Setting::of(generate(kind, 1, 20_000), (96, 64)));
    for setting in own.iter().chain(&generated) {
        for form in FORMS {
            for rule in [Rule::Uniform, Rule::Importance, Rule::Optimal] {
                for split in SPLITS {
                    for quotas in [false, true] {
                        let settings = Settings { form, rule, split, groups: 2, quotas };
                        let few = split == Split::Object && setting.scene.objects.len() < 2;
                        if settings.checked().is_ok() && !few {
                            check(setting, settings, 96);
                        }
                    }
                }
            }
        }
        for groups in [3, 8, 32] {
            for rule in [Rule::Uniform, Rule::Optimal] {
                for split in [Split::Random, Split::Sorted] {
                    let settings = Settings { form: Form::Residual, rule, split, groups, quotas: false };
                    check(setting, settings, 96);
                }
            }
        }
    }
}

/// The same comparison finds what is wrong when estimates are clamped, and when a hundredth is missing.
#[test]
fn bias_is_found() {
    let setting = Setting::own("plates", (48, 48));
    let method = || setting.method(Settings::default());
    let (off, _) =
        worst(&setting, &setting.render(&Less(method(), |x: f32| x.clamp(0.0, 1.0)), 24, 0, 0), false);
    assert!(off > 20.0, "clamping goes unnoticed: {off}");
    let residual = setting.method(Settings { form: Form::Residual, ..Settings::default() });
    let (off, _) = worst(&setting, &setting.render(&Less(residual, |x: f32| 0.99 * x), 24, 0, 0), false);
    assert!(off > 5.0, "a hundredth goes unnoticed: {off}");
}

/// Any number of threads, any SIMD level: the same bits. Another seed of the groups is another image.
#[test]
fn threads_and_levels_render_the_same_bits() {
    let setting = Setting::own("columns", (64, 36));
    for settings in [
        Settings { rule: Rule::Optimal, ..Settings::default() },
        Settings {
            form: Form::Residual,
            split: Split::Sorted,
            groups: 5,
            quotas: true,
            ..Settings::default()
        },
    ] {
        let method = setting.method(settings);
        let first = setting.render(&method, 2, 1, 0).film.develop();
        for (threads, simd) in [(2, 0), (5, 0), (1, 1), (3, 2), (2, 3)] {
            let image = setting.render(&method, 2, threads, simd).film.develop();
            assert_eq!(first.pixels, image.pixels, "{settings}: {threads} threads, level {simd}");
        }
    }
}

/// With chances of 1 nothing is random: the residual that always goes on is the exact method. Where a point sees no
/// blocker at all, every form but the three-term sums gives 1.
#[test]
fn levels_without_blockers_are_exact() {
    let mut scene = Setting::own("plates", (32, 32)).scene;
    let lit = scene.bounds().expect("triangles").1 + Vec3::Y;
    // The light alone, far above a floor that nothing hides.
    scene.camera = scene.camera.map(|camera| occlude_host::scene::Camera { eye: lit, ..camera });
    let lone: Vec<usize> = (0..scene.triangles.len())
        .filter(|&t| {
            let [a, b, c] = scene.vertices(t as u32);
            let emits = scene.material(t as u32).emission.max_element() > 0.0;
            emits || (a.y == b.y && b.y == c.y && a.y == 0.0)
        })
        .collect();
    scene.triangles = lone.iter().map(|&t| scene.triangles[t]).collect();
    scene.triangle_materials = lone.iter().map(|&t| scene.triangle_materials[t]).collect();
    scene.objects.clear();
    let setting = Setting::of(scene, (32, 32));
    let exact = setting.render(&Exact, 2, 0, 0).film.develop();
    assert!(exact.pixels.iter().any(|pixel| pixel[1] > 0.0), "nothing is lit");
    for groups in [2, 9] {
        let method = setting.method(Settings { form: Form::Residual, groups, ..Settings::default() });
        assert_eq!(setting.render(&method, 2, 0, 0).film.develop().pixels, exact.pixels, "{groups} groups");
    }
}

#[test]
fn settings_that_do_not_go_together_are_refused() {
    let refused = |settings: Settings, cause: &str| {
        let said = settings.checked().expect_err("refused").to_string();
        assert!(said.contains(cause), "{said}");
    };
    let balanced = Settings::default();
    refused(Settings { groups: 3, ..balanced }, "residual");
    refused(Settings { groups: 1, ..balanced }, "--levels");
    refused(Settings { groups: 65, form: Form::Residual, ..balanced }, "--levels");
    refused(Settings { form: Form::Residual, rule: Rule::Importance, ..balanced }, "importance");
    refused(Settings { form: Form::Power(1), ..balanced }, "power");
    for text in ["power", "power:", "power:1", "power:65", "power:-2", "Balanced", ""] {
        assert!(text.parse::<Form>().is_err(), "{text}");
    }
    for form in FORMS {
        assert_eq!(form.to_string().parse::<Form>(), Ok(form));
    }
    let mut scene = generate(Kind::Soup, 1, 500);
    scene.objects.truncate(1);
    let accel = Accel::build(&scene, Quality::Fast);
    let object = Settings { split: Split::Object, ..balanced };
    let said = Stochastic::new(object, &scene, &accel.bvh()).expect_err("refused").to_string();
    assert!(said.contains("objects"), "{said}");
}

/// Random terms over what photons name, less exact rays against the same.
struct Terms<'a>(MapTerms<'a>, Map<'a>);

impl Visibility for Terms<'_> {
    fn estimate(
        &self,
        stage: &Stage<'_>,
        questions: &Questions,
        estimates: &mut Vec<f32>,
        counts: &mut Counts,
    ) {
        let mut known = Vec::new();
        self.1.estimate(stage, questions, &mut known, counts);
        self.0.estimate(stage, questions, estimates, counts);
        assert_eq!(estimates.len(), known.len());
        estimates.iter_mut().zip(&known).for_each(|(x, v)| *x -= v);
    }
}

/// Every form, split, rule and kind of blockers: the expectation is that of the map, to within five standard errors of
/// every block of pixels.
#[test]
fn terms_over_a_map_have_its_expectation() {
    let setting = Setting::own("plates", (48, 32));
    let spheres = Setting::of(generate(Kind::Spheres, 1, 2000), (48, 32));
    let kinds = [BlockerKind::Triangle, BlockerKind::Treelet(16), BlockerKind::Object];
    for setting in [&setting, &spheres] {
        for (f, form) in FORMS.into_iter().enumerate() {
            for (s, split) in [Split::Random, Split::Sorted].into_iter().enumerate() {
                let i = 2 * f + s;
                let (rule, quotas) = turn(form, i + f);
                let settings = Settings { form, rule, split, groups: 2, quotas };
                let camera = setting.scene.camera.expect("a camera");
                let frame = camera.frame();
                let stage = Stage {
                    scene: &setting.scene,
                    bvh: setting.accel.bvh(),
                    lights: &setting.lights,
                    eye: camera.eye,
                    camera: &frame,
                    shadow_rays: SHADOW_RAYS,
                    pattern: Pattern::default(),
                    seed: 3,
                    level: detect(),
                    count: false,
                };
                let options = MapOptions {
                    lines: Some(20_000),
                    rounds: 1,
                    k: 50,
                    radius: None,
                    // Few names leave a half empty, and learned terms without noise to test.
                    blockers: if rule == Rule::Optimal { BlockerKind::Triangle } else { kinds[i % 3] },
                    quality: Quality::Medium,
                };
                let map = PreparedMap::new(&stage, &options);
                let terms =
                    MapTerms::new(map.visibility(), settings, &setting.scene).expect("they go together");
                let difference = setting.render(&Terms(terms, map.visibility()), 32, 0, 0);
                let learned = form == Form::Residual && rule == Rule::Optimal;
                let (off, told) = worst(setting, &difference, learned);
                println!("{}, {settings}, {}: {told}", setting.scene.name, options.blockers);
                assert!(off < 5.0, "{}, {settings}, {}: {told}", setting.scene.name, options.blockers);
            }
        }
    }
}

/// Trees over the halves, subtrees as halves, test rays by cells, photons in rounds and boxes in closed meshes, each and
/// together: the expectation is that of the map with the same photons and boxes.
#[test]
fn every_remedy_keeps_the_expectation_of_the_map() {
    let setting = Setting::of(generate(Kind::Spheres, 1, 2000), (48, 32));
    let volumes = Volumes::build(&setting.scene, &setting.lights);
    assert!(volumes.stats.boxes > 0);
    let stage_of = |what: &dyn Fn(&Stage<'_>) -> PreparedMap| {
        let camera = setting.scene.camera.expect("a camera");
        let frame = camera.frame();
        what(&Stage {
            scene: &setting.scene,
            bvh: setting.accel.bvh(),
            lights: &setting.lights,
            eye: camera.eye,
            camera: &frame,
            shadow_rays: SHADOW_RAYS,
            pattern: Pattern::default(),
            seed: 3,
            level: detect(),
            count: false,
        })
    };
    let balanced = Settings { split: Split::Sorted, ..Settings::default() };
    let (importance, optimal) = (Rule::Importance, Rule::Optimal);
    let treelets = Settings { split: Split::Treelet, rule: importance, ..balanced };
    let (triangle, treelet) = (BlockerKind::Triangle, BlockerKind::Treelet(16));
    // Kind, settings, rounds, trees, cells, boxes.
    let cases = [
        (triangle, balanced, 1, true, false, false),
        (triangle, balanced, 1, false, false, true),
        (triangle, Settings { rule: importance, ..balanced }, 1, false, true, false),
        (triangle, Settings { rule: importance, ..balanced }, 3, true, true, true),
        (triangle, Settings { rule: optimal, quotas: true, ..balanced }, 3, true, true, true),
        (treelet, treelets, 1, false, false, true),
        (treelet, Settings { form: Form::InclusionExclusion, ..treelets }, 3, false, true, true),
    ];
    for (kind, settings, rounds, trees, cells, boxes) in cases {
        let options = MapOptions {
            lines: Some(10_000),
            rounds,
            k: 50,
            radius: None,
            blockers: kind,
            quality: Quality::Medium,
        };
        let map = stage_of(&|stage| PreparedMap::new(stage, &options));
        let with_all = || {
            let occluders = if boxes { volumes.occluders() } else { Vec::new() };
            let map = map.visibility().with_occluders(occluders);
            if trees { map.with_trees().expect("of triangles") } else { map }
        };
        let mut terms = MapTerms::new(with_all(), settings, &setting.scene).expect("they go together");
        if cells {
            terms = terms.by_cells();
        }
        let difference = setting.render(&Terms(terms, with_all()), 32, 0, 0);
        let (off, told) = worst(&setting, &difference, false);
        println!("{settings}, {kind}, {rounds} rounds, trees {trees}, cells {cells}, boxes {boxes}: {told}");
        assert!(
            off < 5.0,
            "{settings}, {kind}, {rounds} rounds, trees {trees}, cells {cells}, boxes {boxes}: {told}"
        );
    }
    // Boxes left out on one side only are found.
    let options = MapOptions {
        lines: Some(2_000),
        rounds: 1,
        k: 50,
        radius: None,
        blockers: triangle,
        quality: Quality::Medium,
    };
    let map = stage_of(&|stage| PreparedMap::new(stage, &options));
    let boxed = map.visibility().with_occluders(volumes.occluders());
    let quiet = Settings { form: Form::Residual, ..balanced };
    let terms = MapTerms::new(boxed, quiet, &setting.scene).expect("they go together");
    let (off, _) = worst(&setting, &setting.render(&Terms(terms, map.visibility()), 32, 0, 0), false);
    assert!(off > 5.0, "{off}");
    let said = MapTerms::new(map.visibility(), treelets, &setting.scene).expect_err("refused").to_string();
    assert!(said.contains("--split sorted"), "{said}");
    let alone =
        Stochastic::new(treelets, &setting.scene, &setting.accel.bvh()).expect_err("refused").to_string();
    assert!(alone.contains("--blockers map"), "{alone}");
}
