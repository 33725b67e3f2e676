//! Bars in groups.

use super::axis::{Axis, Layout};
use super::text::{escape, marked, number, unmarked};
use super::{Html, Part, TONES};

/// Horizontal bars, in groups, each from a common base to its value.
#[derive(Clone, Debug, Default)]
pub struct Bars {
    title: String,
    words: String,
    axis: Axis,
    base: f64,
    columns: [String; 2],
    groups: Vec<(String, Vec<Bar>)>,
}

/// One bar.
#[derive(Clone, Debug, Default)]
pub struct Bar {
    /// What it stands for.
    pub name: String,
    /// How far it goes.
    pub value: f64,
    /// Half the length of its error bar, 0 for none.
    pub error: f64,
    /// What to print beside its value.
    pub beside: String,
    /// Its colour.
    pub tone: usize,
}

impl Bars {
    /// Bars from `base` on.
    pub fn new(title: impl Into<String>, words: impl Into<String>, axis: Axis, base: f64) -> Self {
        Self { title: title.into(), words: words.into(), axis: axis.with(base), base, ..Self::default() }
    }

    /// The same with headers over the values and over what is printed beside them.
    pub fn columns(mut self, value: impl Into<String>, beside: impl Into<String>) -> Self {
        self.columns = [value.into(), beside.into()];
        self
    }

    /// One more group.
    pub fn group(&mut self, name: impl Into<String>, bars: impl IntoIterator<Item = Bar>) {
        self.groups.push((name.into(), bars.into_iter().collect()));
    }
}

const LEFT: f64 = 176.0;
const WIDTH: f64 = 330.0;
/// Where the columns of figures end, to the right of the bars.
const COLUMNS: [f64; 2] = [LEFT + WIDTH + 70.0, LEFT + WIDTH + 150.0];
const TOP: f64 = 22.0;
const BAR: f64 = 20.0;

impl Part for Bars {
    fn html(&self, html: &mut Html) {
        let bars = || self.groups.iter().flat_map(|(_, bars)| bars);
        let layout = self.axis.layout(bars().flat_map(|bar| [bar.value, bar.value + bar.error]));
        html.raw("<figure>");
        html.caption(&self.title, &self.words);
        html.raw("<div class=\"plots bars\">");
        for (name, bars) in &self.groups {
            html.raw(&format!("<div><h4>{}</h4>", marked(name)));
            self.svg(html, name, bars, &layout);
            html.raw("</div>\n");
        }
        html.raw("</div></figure>\n");
    }
}

impl Bars {
    fn svg(&self, html: &mut Html, name: &str, bars: &[Bar], layout: &Layout) {
        let bottom = TOP + bars.len() as f64 * BAR;
        let label = escape(&unmarked(&format!("{}, {name}", self.title)));
        let (width, height) = (COLUMNS[1] + 2.0, bottom + 42.0);
        html.raw(&format!("<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{label}\">"));
        for (header, at) in self.columns.iter().zip(COLUMNS) {
            html.raw(&text(at, TOP - 7.0, "end", "soft", header));
        }
        let mut grid = String::new();
        for (share, tick) in layout.ticks() {
            let at = at(share);
            grid += &format!("M{at:.1} {TOP}V{bottom}");
            html.raw(&text(at, bottom + 17.0, "middle", "", tick));
        }
        html.raw(&format!("<path class=\"grid\" d=\"{grid}\"/>"));
        let base = layout.place(self.base).unwrap_or(0.0);
        for (i, bar) in bars.iter().enumerate() {
            bar.svg(html, TOP + i as f64 * BAR, base, |value| layout.place(value));
        }
        html.raw(&format!("<path class=\"axis\" d=\"M{:.1} {TOP}V{bottom}\"/>", at(base)));
        html.raw(&text(LEFT + WIDTH / 2.0, bottom + 35.0, "middle", "soft", &self.axis.label));
        html.raw("</svg>");
    }
}

impl Bar {
    fn svg(&self, html: &mut Html, top: f64, base: f64, place: impl Fn(f64) -> Option<f64>) {
        let middle = top + BAR / 2.0;
        let tone = self.tone % TONES;
        html.raw(&text(LEFT - 8.0, middle + 4.0, "end", "", &self.name));
        let end = place(self.value).unwrap_or(base);
        let (from, to) = (at(base.min(end)), at(base.max(end)));
        html.raw(&format!(
            "<rect class=\"t{tone}\" x=\"{from:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" style=\"stroke:none\"/>",
            top + 3.0,
            (to - from).max(0.5),
            BAR - 6.0
        ));
        if self.error > 0.0 && self.error.is_finite() {
            let low = place(self.value - self.error).map_or(LEFT, at);
            let high = place(self.value + self.error).map_or(LEFT, at);
            // One too short to be seen is no whisker.
            if high - low > 1.0 {
                let (cap, line) = (middle - 3.0, middle);
                html.raw(&format!(
                    "<path class=\"axis\" d=\"M{low:.1} {line:.1}H{high:.1}M{low:.1} {cap:.1}v6M{high:.1} {cap:.1}v6\"/>"
                ));
            }
        }
        html.raw(&text(COLUMNS[0], middle + 4.0, "end", "", &number(self.value, 3)));
        html.raw(&text(COLUMNS[1], middle + 4.0, "end", "", &self.beside));
    }
}

fn at(share: f64) -> f64 {
    LEFT + share * WIDTH
}

fn text(x: f64, y: f64, anchor: &str, class: &str, text: &str) -> String {
    if text.is_empty() {
        return String::new();
    }
    let class = if class.is_empty() { String::new() } else { format!(" class=\"{class}\"") };
    let text = escape(&unmarked(text));
    format!("<text{class} x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{text}</text>")
}
