//! The figures: two plates under a square light.

use super::plates::{Painted, Pixel, Plates, Rectangle};
use super::{name, slope, unsound};
use crate::page::{
    Axis, Cell, Crop, Data, Entry, Figure, Gallery, Line, Page, Picture, Plot, Series, Strip, Table, heat,
    number, short,
};
use crate::reproduce::{Halted, Leg};
use crate::sampler::{Pattern, Sampler};
use occlude_kernel::decomposition::Joint;
use occlude_kernel::{Decomposition, Estimator, Exact, Group, OneTerm, Probabilities};

/// Two plates of which each hides part of the light from part of the floor, and both from the middle.
pub(super) fn two_plates(quick: bool) -> Plates {
    let size = if quick { (96, 60) } else { (192, 120) };
    Plates {
        light: Rectangle::centred(0.0, 0.0, 0.6),
        light_height: 4.0,
        plates: vec![(Rectangle::centred(-0.5, -0.2, 0.7), 1.5), (Rectangle::centred(0.2, 0.15, 0.7), 2.0)],
        view: Rectangle { x: [-3.5, 3.5], z: [-2.1875, 2.1875] },
        width: size.0,
        height: size.1,
    }
}

const RAYS: [u32; 5] = [1, 4, 16, 64, 256];

/// Where a point of the floor lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    Both,
    One,
    None,
}

const PLACES: [Place; 3] = [Place::Both, Place::One, Place::None];

impl Place {
    fn of(joint: &Joint) -> Self {
        let [both, b_only, a_only, _] = joint.chances();
        match (both + b_only > 0.0, both + a_only > 0.0) {
            (true, true) => Self::Both,
            (false, false) => Self::None,
            _ => Self::One,
        }
    }

    fn words(self) -> &'static str {
        match self {
            Self::Both => "both plates are in the way",
            Self::One => "one plate is in the way",
            Self::None => "neither is in the way",
        }
    }
}

/// A form, or none, which is exact.
struct Way {
    name: String,
    one: Option<OneTerm>,
}

impl Way {
    fn estimate(&self, pixel: &Pixel<'_>, random: &mut Sampler) -> f64 {
        let ask = |k| move |group| pixel.visible(if group == Group::A { 0 } else { 1 }, k);
        match &self.one {
            None => pixel.sum(|k| f64::from(Exact.estimate(0.0, ask(k)))),
            Some(one) => pixel.sum(|k| f64::from(one.estimate(random.uniform(), ask(k)))),
        }
    }
}

/// All that was painted of one pattern: ways, then numbers of rays.
type Paintings = Vec<Vec<Painted>>;

pub(super) fn add(leg: &Leg<'_>, page: &mut Page) -> Result<Data, Halted> {
    let plates = two_plates(leg.run.quick);
    let reference: Vec<f64> = (0..plates.pixels()).map(|pixel| plates.reference(pixel)).collect();
    let joints: Vec<Option<Joint>> = (0..plates.pixels()).map(|pixel| plates.joint(pixel)).collect();
    let places: Vec<Place> =
        joints.iter().map(|joint| joint.as_ref().map_or(Place::None, Place::of)).collect();

    let mut whole = [0.0; 4];
    joints
        .iter()
        .flatten()
        .for_each(|joint| whole.iter_mut().zip(joint.chances()).for_each(|(sum, chance)| *sum += chance));
    let whole = Joint::new(whole).ok_or_else(|| crate::Error::Usage("the light has no area".to_owned()))?;
    let guess = whole.visibility() / whole.a_visible();
    let residual = Decomposition::Residual { q: 0.5, u: guess as f32 };
    let forms =
        [Decomposition::InclusionExclusion, Decomposition::Balanced, Decomposition::Power(8), residual];
    let mut ways = vec![Way { name: "Exact".to_owned(), one: None }];
    for form in forms {
        let one = OneTerm::new(form, &Probabilities::UNIFORM).map_err(unsound)?;
        ways.push(Way { name: name(&form), one: Some(one) });
    }

    let patterns = [("stratified", Pattern::Lattice), ("independent", Pattern::Random)];
    let mut all: Vec<Paintings> = Vec::new();
    for (p, (_, pattern)) in patterns.iter().enumerate() {
        let mut paintings = Vec::new();
        for (w, way) in ways.iter().enumerate() {
            let mut painted = Vec::new();
            for rays in RAYS {
                leg.at((p * ways.len() + w) as f64 / (2 * ways.len()) as f64, "two plates under a light")?;
                painted.push(
                    plates.picture(leg.run, *pattern, rays, |pixel, random| way.estimate(pixel, random))?,
                );
            }
            paintings.push(painted);
        }
        all.push(paintings);
    }

    page.section("Two plates under a square light");
    page.prose(
        "A floor, seen from above, and over it a square light and two plates that hang at different heights. \
         The plates are the two groups: A is the left, lower one, B the right, higher one. What each hides \
         of the light from a point of the floor is a rectangle, so the picture has a closed form, by \
         Lambert, which is the reference here. Brightness is irradiance, and 1 is what would arrive straight \
         below the light with nothing in the way.",
    );
    strips(page, &plates, &ways, &all[0], &reference, &places);
    // Where both plates hide all of the light.
    let core = |pixel: usize| joints[pixel].as_ref().is_some_and(|joint| joint.chances()[0] == 1.0);
    let in_core = |way: usize| short(all[0][way][0].rmse(&reference, core));
    page.prose(&format!(
        "All forms converge to the same picture, and no estimate was clamped to make them. The noise is not \
         where one knows it from ordinary soft shadows. Exact visibility is noisy in the penumbra only. {} \
         adds noise elsewhere, and most of it where the floor is fully lit; but where both plates hide all \
         of the light, which they do at {} of the {} pixels, its error with a single ray is {}: “geen \
         variantie”, as the slides say. {} is about equally noisy wherever one looks, also in that core, \
         where its error is {}. {} is loud where there is light, for its third term stands for nearly all of \
         the sum and is taken a third of the time. {} always asks A, and B half of the time; its guess of \
         V_{{B}} where A lets light through is {}, the same for the whole picture.",
        name(&forms[0]),
        (0..plates.pixels()).filter(|&pixel| core(pixel)).count(),
        plates.pixels(),
        in_core(1),
        name(&forms[1]),
        number(all[0][2][0].rmse(&reference, core), 2),
        name(&forms[2]),
        name(&forms[3]),
        number(guess, 2),
    ));
    variance_maps(page, &plates, &ways, &joints);

    let mut data = Data::new(&["pattern", "place", "form", "rays", "rmse", "plates_asked_per_ray"]);
    for ((pattern, _), paintings) in patterns.iter().zip(&all) {
        for place in PLACES {
            for (way, painted) in ways.iter().zip(paintings) {
                for (rays, painted) in RAYS.into_iter().zip(painted) {
                    let here = |pixel: usize| places[pixel] == place;
                    data.row([
                        Cell::from(*pattern),
                        place.words().into(),
                        way.name.as_str().into(),
                        rays.into(),
                        painted.rmse(&reference, here).into(),
                        painted.asked_a_ray(rays, here).into(),
                    ]);
                }
            }
        }
    }
    page.heading("Error against rays");
    let figures = [
        "The points on the light are stratified, as this renderer does it by default (a shifted lattice). \
         Exact visibility gains from that: its error falls faster than the root of the number of rays. The \
         random choice of a term does not.",
        "The points on the light are independent, as in the textbook. Now exact visibility converges no \
         faster than the forms do, and all curves are parallel: a comparison that flatters the random \
         forms.",
    ];
    for (((pattern, _), paintings), words) in patterns.iter().zip(&all).zip(figures) {
        let mut figure = Figure::new(format!("RMSE, {pattern} light samples"), words);
        for place in PLACES {
            let axes = (Axis::log("shadow rays a pixel").at(RAYS.map(f64::from)), Axis::log("RMSE"));
            let mut plot = Plot::new(format!("Where {}", place.words()), axes.0, axes.1);
            for (w, (way, painted)) in ways.iter().zip(paintings).enumerate() {
                plot = plot.series(Series::new(&way.name, w, errors(painted, &reference, &places, place)));
            }
            let anchor = paintings[1]
                .first()
                .map_or(1.0, |painted| painted.rmse(&reference, |pixel| places[pixel] == place));
            let guide = RAYS.map(|rays| (f64::from(rays), 0.5 * anchor / f64::from(rays).sqrt()));
            figure = figure.plot(plot.series(Series::new("slope −1/2", 0, guide).line(Line::Dashed)));
        }
        page.add(&figure);
    }
    slopes(page, &ways, &all, &reference, &places);
    Ok(data)
}

fn errors(painted: &[Painted], reference: &[f64], places: &[Place], place: Place) -> Vec<(f64, f64)> {
    let here = |pixel: usize| places[pixel] == place;
    RAYS.into_iter()
        .zip(painted)
        .map(|(rays, painted)| (f64::from(rays), painted.rmse(reference, here)))
        .collect()
}

fn strips(
    page: &mut Page,
    plates: &Plates,
    ways: &[Way],
    paintings: &Paintings,
    reference: &[f64],
    places: &[Place],
) {
    let crops = PLACES.map(|place| (place.words().to_owned(), crop(plates, reference, places, place)));
    let frames = crops.clone().map(|(_, crop)| crop);
    let columns =
        RAYS.map(|rays| if rays == 1 { "1 shadow ray".to_owned() } else { format!("{rays} shadow rays") });
    let mut strip = Strip::new(
        "Exact visibility and four forms, at 1 to 256 shadow rays a pixel",
        "The frames are enlarged below each picture; under it the root mean square error over the whole of \
         it. All pictures of a column use the same points on the light.",
        columns,
    )
    .crops(crops);
    for (way, painted) in ways.iter().zip(paintings) {
        let pictures = RAYS.iter().zip(painted).map(|(rays, painted)| {
            let image = plates.image(&painted.values);
            let words = format!("{}, {rays} shadow rays a pixel", way.name);
            let error = number(painted.rmse(reference, |_| true), 3);
            Picture::new(&image, 0.0, words).crops(&image, 0.0, &frames).under(format!("RMSE {error}"))
        });
        strip.row(&way.name, pictures);
    }
    page.add(&strip);
    let image = plates.image(reference);
    let mut gallery = Gallery::new("Reference", "In closed form.");
    gallery.picture("", Picture::new(&image, 0.0, "the floor in closed form").crops(&image, 0.0, &frames));
    page.add(&gallery);
}

/// A square of a place with as much going on as can be, and nothing but that place.
fn crop(plates: &Plates, reference: &[f64], places: &[Place], place: Place) -> Crop {
    let edge = plates.height / 6;
    let mut best = (f64::NEG_INFINITY, Crop { x: 0, y: 0, width: edge, height: edge });
    for y in (0..plates.height.saturating_sub(edge)).step_by(2) {
        for x in (0..plates.width.saturating_sub(edge)).step_by(2) {
            let inside =
                (y..y + edge).flat_map(|y| (x..x + edge).map(move |x| (y * plates.width + x) as usize));
            let (mut low, mut high, mut of) = (f64::INFINITY, f64::NEG_INFINITY, 0u32);
            for pixel in inside {
                (low, high) = (low.min(reference[pixel]), high.max(reference[pixel]));
                of += u32::from(places[pixel] == place);
            }
            // The darkest of the lit ones is in a corner, which shows nothing: there the brightest is best.
            let contrast = if place == Place::None { low } else { high - low };
            let score = contrast + 4.0 * f64::from(of) / f64::from(edge * edge);
            if score > best.0 {
                best = (score, Crop { x, y, width: edge, height: edge });
            }
        }
    }
    best.1
}

fn variance_maps(page: &mut Page, plates: &Plates, ways: &[Way], joints: &[Option<Joint>]) {
    let variance = |way: &Way, joint: &Joint| match &way.one {
        None => joint.visibility() * (1.0 - joint.visibility()),
        Some(one) => one.total_variance(joint),
    };
    let maps: Vec<Vec<f64>> = ways
        .iter()
        .map(|way| {
            joints.iter().map(|joint| joint.as_ref().map_or(f64::NAN, |joint| variance(way, joint))).collect()
        })
        .collect();
    let most = maps.iter().flatten().copied().filter(|v| v.is_finite()).fold(0.0, f64::max);
    let mut gallery = Gallery::new(
        "Where the noise is: the variance of the visibility of one ray, in closed form",
        "From how (V_{A}, V_{B}) is distributed over the light as seen from each point of the floor. The \
         same colours for all.",
    )
    .ramp(0.0, most, "variance");
    for (way, map) in ways.iter().zip(&maps) {
        let mean = map.iter().sum::<f64>() / map.len() as f64;
        let image = heat(map, plates.width, plates.height, 0.0, most);
        let picture = Picture::new(&image, 0.0, format!("variance of {}", way.name));
        gallery.picture(&way.name, picture.under(format!("mean {}", number(mean, 3))));
    }
    page.add(&gallery);
}

fn slopes(page: &mut Page, ways: &[Way], all: &[Paintings], reference: &[f64], places: &[Place]) {
    let mut table = Table::new("Slopes of these curves, 1 to 256 rays, and the work of a ray")
        .words("form")
        .numbers("both: stratified")
        .numbers("independent")
        .numbers("one: stratified")
        .numbers("independent")
        .numbers("neither: stratified")
        .numbers("independent")
        .numbers("plates asked a ray")
        .numbers("error to exact, 256 stratified rays");
    let last = RAYS.len() - 1;
    for (w, way) in ways.iter().enumerate() {
        let mut row = vec![Entry::from(way.name.clone())];
        for place in PLACES {
            for paintings in all {
                row.push(Entry::number(slope(&errors(&paintings[w], reference, places, place)), 2));
            }
        }
        row.push(Entry::number(all[0][w][last].asked_a_ray(RAYS[last], |_| true), 3));
        let ratio = all[0][w][last].rmse(reference, |_| true) / all[0][0][last].rmse(reference, |_| true);
        row.push(Entry::from(format!("{} ×", number(ratio, 3))));
        table.row(row);
    }
    page.add(&table);
    let exact = slope(&errors(&all[0][0], reference, places, Place::One));
    let balanced = slope(&errors(&all[0][2], reference, places, Place::One));
    page.prose(&format!(
        "A slope of −1/2 means that half the error costs four times the rays. With stratified light samples \
         exact visibility has {} in the shadow of one plate, {} has {}: however good the light samples, the \
         choice of the term remains a throw of dice. So the more rays, the larger the distance, and the \
         picture of one ray a pixel says little about that of 256.",
        number(exact, 2),
        ways[2].name,
        number(balanced, 2),
    ));
    page.in_short(format!(
        "All forms converge, with slope {} against rays where exact visibility with stratified light samples \
         has {} (both in the shadow of one of two plates).",
        number(balanced, 2),
        number(exact, 2),
    ));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reproduce::theory::tests::run;
    use std::sync::atomic::AtomicBool;

    /// Over the whole picture the error of a form's mean is no more than chance.
    #[test]
    fn every_form_is_right_on_average() {
        let stop = AtomicBool::new(false);
        let plates = two_plates(true);
        let truth: f64 =
            (0..plates.pixels()).map(|pixel| plates.reference(pixel)).sum::<f64>() / plates.pixels() as f64;
        for form in [Decomposition::InclusionExclusion, Decomposition::Balanced, Decomposition::Power(8)] {
            let one = OneTerm::new(form, &Probabilities::UNIFORM).expect("sound");
            let way = Way { name: String::new(), one: Some(one) };
            let painted =
                plates.picture(&run(&stop), Pattern::Random, 16, |p, r| way.estimate(p, r)).expect("goes on");
            let n = painted.values.len() as f64;
            let mean = painted.values.iter().sum::<f64>() / n;
            let reference: Vec<f64> = (0..plates.pixels()).map(|pixel| plates.reference(pixel)).collect();
            let error = painted.rmse(&reference, |_| true) / n.sqrt();
            assert!((mean - truth).abs() < 5.0 * error, "{form:?}: {mean} {truth} {error}");
        }
    }

    #[test]
    fn any_number_of_threads_paints_the_same() {
        let stop = AtomicBool::new(false);
        let plates = two_plates(true);
        let way = Way {
            name: String::new(),
            one: OneTerm::new(Decomposition::Balanced, &Probabilities::UNIFORM).ok(),
        };
        let paint = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            pool.install(|| plates.picture(&run(&stop), Pattern::Lattice, 4, |p, r| way.estimate(p, r)).ok())
        };
        assert!(paint(1).is_some() && paint(1) == paint(3));
    }

    #[test]
    fn every_place_is_in_the_view_and_is_enlarged() {
        let plates = two_plates(true);
        let reference: Vec<f64> = (0..plates.pixels()).map(|pixel| plates.reference(pixel)).collect();
        let places: Vec<Place> = (0..plates.pixels())
            .map(|pixel| plates.joint(pixel).as_ref().map_or(Place::None, Place::of))
            .collect();
        for place in PLACES {
            let crop = crop(&plates, &reference, &places, place);
            assert!(crop.x + crop.width <= plates.width && crop.y + crop.height <= plates.height);
            let inside = (crop.y..crop.y + crop.height)
                .flat_map(|y| (crop.x..crop.x + crop.width).map(move |x| (x, y)));
            let share =
                inside.clone().filter(|(x, y)| places[(y * plates.width + x) as usize] == place).count();
            assert!(share * 10 >= inside.count() * 9, "{place:?}: {share}");
        }
    }
}
