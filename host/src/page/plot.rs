//! Curves over two axes.
//!
//! The drawings are plain SVG whose lines and letters take the page's colours, so that they follow it into the
//! dark; what draws for files has its colours fixed.

use super::axis::{Axis, Layout};
use super::text::{escape, marked, short, unmarked};
use super::{Html, Part};

/// One drawing, or several side by side, under a common title and with a common legend.
#[derive(Clone, Debug, Default)]
pub struct Figure {
    title: String,
    words: String,
    plots: Vec<Plot>,
}

impl Figure {
    /// Without a drawing yet. The words say what is to be seen.
    pub fn new(title: impl Into<String>, words: impl Into<String>) -> Self {
        Self { title: title.into(), words: words.into(), plots: Vec::new() }
    }

    /// The same with one more drawing.
    pub fn plot(mut self, plot: Plot) -> Self {
        self.plots.push(plot);
        self
    }
}

/// Curves over two axes.
#[derive(Clone, Debug, Default)]
pub struct Plot {
    title: String,
    x: Axis,
    y: Axis,
    series: Vec<Series>,
}

/// A curve. Those of one name in one figure should have one tone.
#[derive(Clone, Debug, Default)]
pub struct Series {
    name: String,
    tone: usize,
    line: Line,
    points: Vec<Point>,
}

/// How the points of a curve are joined.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Line {
    /// Points and a line.
    #[default]
    Solid,
    /// A dashed line without points: something to compare with.
    Dashed,
    /// Points only.
    None,
}

/// A point and what its height is uncertain by, 0 for nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// Along.
    pub x: f64,
    /// Up.
    pub y: f64,
    /// Half the length of its error bar.
    pub error: f64,
}

/// Tones there are colours for.
pub const TONES: usize = 8;

impl Series {
    /// Points joined by a line.
    pub fn new(name: impl Into<String>, tone: usize, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        let points = points.into_iter().map(|(x, y)| Point { x, y, error: 0.0 }).collect();
        Self { name: name.into(), tone: tone % TONES, line: Line::Solid, points }
    }

    /// The same with error bars.
    pub fn with_errors(
        name: impl Into<String>,
        tone: usize,
        points: impl IntoIterator<Item = Point>,
    ) -> Self {
        Self {
            name: name.into(),
            tone: tone % TONES,
            line: Line::Solid,
            points: points.into_iter().collect(),
        }
    }

    /// The same joined in this way.
    pub fn line(mut self, line: Line) -> Self {
        self.line = line;
        self
    }
}

impl Plot {
    /// Empty axes.
    pub fn new(title: impl Into<String>, x: Axis, y: Axis) -> Self {
        Self { title: title.into(), x, y, series: Vec::new() }
    }

    /// The same with one more curve.
    pub fn series(mut self, series: Series) -> Self {
        self.series.push(series);
        self
    }

    fn svg(&self, html: &mut Html) {
        let points = || self.series.iter().flat_map(|series| &series.points);
        let x = self.x.layout(points().map(|point| point.x));
        // Error bars may end below 0, where a logarithm has none; they are cut there.
        let ends = points().flat_map(|point| [point.y, point.y + point.error, point.y - point.error]);
        let lowest = points().filter(|p| p.y > 0.0).map(|p| p.y).fold(f64::INFINITY, f64::min);
        let log = self.y.scale == super::Scale::Log;
        let y = self.y.layout(ends.filter(|&end| !log || end >= 0.3 * lowest));
        let mut svg = Svg::new(html, &format!("{}: {} against {}", self.title, self.y.label, self.x.label));
        svg.frame(&x, &y, &self.x.label, &self.y.label);
        let mut left_out = 0;
        for series in &self.series {
            left_out += svg.curve(series, &x, &y);
        }
        svg.end();
        if left_out > 0 {
            html.raw(&format!(
                "<p class=\"faint\">Not shown, as they have no place on these axes: {left_out} points.</p>"
            ));
        }
    }
}

impl Part for Figure {
    fn html(&self, html: &mut Html) {
        html.raw("<figure>");
        html.caption(&self.title, &self.words);
        html.raw("<div class=\"plots\">");
        for plot in &self.plots {
            html.raw("<div>");
            if !plot.title.is_empty() {
                html.raw(&format!("<h4>{}</h4>", marked(&plot.title)));
            }
            plot.svg(html);
            html.raw("</div>\n");
        }
        html.raw("</div>");
        let mut shown: Vec<&Series> = Vec::new();
        for series in self.plots.iter().flat_map(|plot| &plot.series) {
            if !shown.iter().any(|other| other.name == series.name) {
                shown.push(series);
            }
        }
        if shown.len() > 1 || shown.iter().any(|series| !series.name.is_empty()) {
            html.raw("<ul class=\"legend\">");
            for series in shown {
                html.raw("<li><svg viewBox=\"0 0 30 14\" aria-hidden=\"true\">");
                html.raw(&sample(series));
                html.raw(&format!("</svg><span>{}</span></li>", marked(&series.name)));
            }
            html.raw("</ul>");
        }
        html.raw("</figure>\n");
    }
}

fn sample(series: &Series) -> String {
    let tone = series.tone;
    let mut svg = String::new();
    if series.line != Line::None {
        let dashed = if series.line == Line::Dashed { " dashed" } else { "" };
        svg += &format!("<path class=\"curve t{tone}{dashed}\" d=\"M1 7H29\"/>");
    }
    if series.line != Line::Dashed {
        svg += &mark(tone, 15.0, 7.0);
    }
    svg
}

/// A mark: a shape of its own for each tone, since colours alone are not for everybody.
fn mark(tone: usize, x: f64, y: f64) -> String {
    let r = 3.2;
    let class = format!("class=\"t{tone}\"");
    let path = |d: String| format!("<path {class} d=\"{d}\"/>");
    match tone {
        0 | 6 => format!("<circle {class} cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{r}\"/>"),
        1 => path(format!("M{:.1} {:.1}h{s}v{s}h-{s}z", x - r * 0.9, y - r * 0.9, s = 5.8)),
        2 => path(format!("M{x:.1} {:.1}l3.7 6.2h-7.4z", y - 4.0)),
        3 => path(format!("M{x:.1} {:.1}l4.2 4.2l-4.2 4.2l-4.2 -4.2z", y - 4.2)),
        4 => path(format!("M{x:.1} {:.1}l3.7 -6.2h-7.4z", y + 4.0)),
        5 => path(format!("M{:.1} {y:.1}h7M{x:.1} {:.1}v7", x - 3.5, y - 3.5)),
        _ => path(format!("M{:.1} {:.1}l6 6m0 -6l-6 6", x - 3.0, y - 3.0)),
    }
}

/// An SVG element under way, with a plot area of [`WIDTH`] by [`HEIGHT`].
struct Svg<'a> {
    html: &'a mut Html,
}

const LEFT: f64 = 58.0;
const TOP: f64 = 8.0;
const WIDTH: f64 = 350.0;
const HEIGHT: f64 = 230.0;
const RIGHT: f64 = 14.0;
const BOTTOM: f64 = 42.0;

fn at_x(share: f64) -> f64 {
    LEFT + share * WIDTH
}

fn at_y(share: f64) -> f64 {
    TOP + (1.0 - share) * HEIGHT
}

impl<'a> Svg<'a> {
    fn new(html: &'a mut Html, label: &str) -> Self {
        let (width, height) = (LEFT + WIDTH + RIGHT, TOP + HEIGHT + BOTTOM);
        let label = escape(&unmarked(label));
        html.raw(&format!("<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{label}\">"));
        Self { html }
    }

    fn end(self) {
        self.html.raw("</svg>");
    }

    fn frame(&mut self, x: &Layout, y: &Layout, x_label: &str, y_label: &str) {
        let (right, bottom) = (LEFT + WIDTH, TOP + HEIGHT);
        let mut grid = String::new();
        let mut ticks = String::new();
        let mut text = String::new();
        for (share, label) in x.ticks() {
            let at = at_x(share);
            grid += &format!("M{at:.1} {TOP}V{bottom}");
            ticks += &format!("M{at:.1} {bottom}v5");
            text += &format!(
                "<text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                bottom + 18.0,
                escape(label)
            );
        }
        for (share, label) in y.ticks() {
            let at = at_y(share);
            grid += &format!("M{LEFT} {at:.1}H{right}");
            ticks += &format!("M{LEFT} {at:.1}h-5");
            text += &format!(
                "<text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                LEFT - 8.0,
                at + 4.0,
                escape(label)
            );
        }
        x.minor().for_each(|share| ticks += &format!("M{:.1} {bottom}v3", at_x(share)));
        y.minor().for_each(|share| ticks += &format!("M{LEFT} {:.1}h-3", at_y(share)));
        self.html.raw(&format!(
            "<path class=\"grid\" d=\"{grid}\"/><path class=\"axis\" d=\"M{LEFT} {TOP}V{bottom}H{right}{ticks}\"/>{text}"
        ));
        let (x_label, y_label) = (escape(&unmarked(x_label)), escape(&unmarked(y_label)));
        self.html.raw(&format!(
            "<text class=\"soft\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{x_label}</text>\
             <text class=\"soft\" transform=\"translate(13 {:.1}) rotate(-90)\" text-anchor=\"middle\">{y_label}</text>",
            LEFT + WIDTH / 2.0,
            bottom + 36.0,
            TOP + HEIGHT / 2.0
        ));
    }

    /// Returns how many points have no place.
    fn curve(&mut self, series: &Series, x: &Layout, y: &Layout) -> usize {
        let tone = series.tone;
        let mut path = String::new();
        let mut whiskers = String::new();
        let mut marks = String::new();
        let (mut pen_down, mut left_out) = (false, 0);
        for point in &series.points {
            let (Some(at), Some(height)) = (x.place(point.x), y.place(point.y)) else {
                pen_down = false;
                left_out += 1;
                continue;
            };
            let (px, py) = (at_x(at), at_y(height));
            path += &format!("{}{px:.1} {py:.1}", if pen_down { "L" } else { "M" });
            pen_down = true;
            if point.error > 0.0 && point.error.is_finite() {
                let top = y.place(point.y + point.error).map_or(TOP, at_y);
                let low = y.place(point.y - point.error).map_or(TOP + HEIGHT, at_y);
                // One too short to be seen is no whisker.
                if low - top > 1.0 {
                    whiskers += &format!(
                        "M{px:.1} {top:.1}V{low:.1}M{:.1} {top:.1}h6M{:.1} {low:.1}h6",
                        px - 3.0,
                        px - 3.0
                    );
                }
            }
            if series.line != Line::Dashed {
                let title =
                    format!("{}: {}, {}", unmarked(&series.name), short(point.x), super::number(point.y, 4));
                marks += &format!("<g><title>{}</title>{}</g>", escape(&title), mark(tone, px, py));
            }
        }
        if series.line != Line::None && !path.is_empty() {
            let dashed = if series.line == Line::Dashed { " dashed" } else { "" };
            self.html.raw(&format!("<path class=\"curve t{tone}{dashed}\" d=\"{path}\"/>"));
        }
        if !whiskers.is_empty() {
            self.html.raw(&format!("<path class=\"whisker t{tone}\" d=\"{whiskers}\"/>"));
        }
        self.html.raw(&marks);
        left_out
    }
}
