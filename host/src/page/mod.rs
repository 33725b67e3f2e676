//! Pages: one HTML file with words, tables, plots and pictures, readable without a network, in the light and in the
//! dark.
//!
//! A page holds everything it shows: styles, drawings as SVG, pictures as PNG in the text. It has no scripts, and asks
//! the browser to load nothing. It is HTML that is also well-formed XML, so tools can read it. The numbers go beside
//! it as comma-separated values ([`Data`]), and all of it into a [`Folder`].
//!
//! ```
//! use occlude_host::page::{Axis, Figure, Page, Plot, Series};
//!
//! let mut page = Page::new("occlude doc", "Rays", "What more rays give.");
//! page.section("Error");
//! page.prose("It falls with the root of *n*, but for V_{A} = 0.");
//! let plot = Plot::new("", Axis::log("rays").at([1.0, 4.0, 16.0]), Axis::log("RMSE"));
//! page.add(&Figure::new("Error", "").plot(plot.series(Series::new("exact", 1, [(1.0, 0.5), (4.0, 0.25)]))));
//! assert!(page.html("").contains("</svg>"));
//! ```

mod axis;
mod bars;
mod data;
mod folder;
mod picture;
mod plot;
mod table;
mod text;

pub use axis::{Axis, Scale};
pub use bars::{Bar, Bars};
pub use data::{Cell, Data};
pub use folder::{Folder, INDEX};
pub use picture::{CROPS, Crop, Gallery, Picture, Strip, heat};
pub use plot::{Figure, Line, Plot, Point, Series, TONES};
pub use table::{Entry, Table, Tone};
pub use text::{escape, marked, number, short, unmarked};

const STYLE: &str = include_str!("page.css");

/// Something that a page can hold.
pub trait Part {
    /// Writes it.
    fn html(&self, html: &mut Html);
}

/// HTML under way.
#[derive(Clone, Debug, Default)]
pub struct Html(String);

impl Html {
    /// Adds markup as it is: what comes from elsewhere has to be [`escape`]d or [`marked`].
    pub fn raw(&mut self, markup: &str) {
        self.0.push_str(markup);
    }

    fn caption(&mut self, title: &str, words: &str) {
        if !title.is_empty() || !words.is_empty() {
            self.raw(&format!(
                "<figcaption><b>{}</b><span>{}</span></figcaption>",
                marked(title),
                marked(words)
            ));
        }
    }
}

/// A page under way. Words may have the marks of [`marked`].
#[derive(Clone, Debug)]
pub struct Page {
    maker: String,
    title: String,
    lead: String,
    short: Vec<String>,
    sections: Vec<String>,
    body: Html,
}

impl Page {
    /// An empty page by `maker`, the command that writes it, by which [`Folder`] knows it again.
    pub fn new(maker: impl Into<String>, title: impl Into<String>, lead: impl Into<String>) -> Self {
        let (maker, title, lead) = (maker.into(), title.into(), lead.into());
        Self { maker, title, lead, short: Vec::new(), sections: Vec::new(), body: Html::default() }
    }

    /// Begins a section, which the list of contents shall name.
    pub fn section(&mut self, title: &str) {
        let close = if self.sections.is_empty() { "" } else { "</section>\n" };
        self.sections.push(title.to_owned());
        let number = self.sections.len();
        self.body.raw(&format!("{close}<section id=\"s{number}\"><h2>{number}. {}</h2>\n", marked(title)));
    }

    /// Adds a line to what the page says at its very beginning.
    pub fn in_short(&mut self, text: impl Into<String>) {
        self.short.push(text.into());
    }

    /// Begins a part of a section.
    pub fn heading(&mut self, title: &str) {
        self.body.raw(&format!("<h3>{}</h3>\n", marked(title)));
    }

    /// Adds a paragraph.
    pub fn prose(&mut self, text: &str) {
        self.body.raw(&format!("<p>{}</p>\n", marked(text)));
    }

    /// Adds a list.
    pub fn list(&mut self, items: impl IntoIterator<Item = impl AsRef<str>>) {
        self.body.raw("<ul class=\"plain\">");
        items.into_iter().for_each(|item| self.body.raw(&format!("<li>{}</li>", marked(item.as_ref()))));
        self.body.raw("</ul>\n");
    }

    /// Adds words with what they mean.
    pub fn facts(&mut self, facts: impl IntoIterator<Item = (impl AsRef<str>, impl AsRef<str>)>) {
        self.body.raw("<dl>");
        for (word, meaning) in facts {
            self.body.raw(&format!(
                "<dt>{}</dt><dd>{}</dd>",
                marked(word.as_ref()),
                marked(meaning.as_ref())
            ));
        }
        self.body.raw("</dl>\n");
    }

    /// Adds a table, a figure, pictures.
    pub fn add(&mut self, part: &impl Part) {
        part.html(&mut self.body);
    }

    /// Adds something that is shown when asked for.
    pub fn folded(&mut self, summary: &str, part: &impl Part) {
        self.body.raw(&format!("<details><summary>{}</summary>", marked(summary)));
        part.html(&mut self.body);
        self.body.raw("</details>\n");
    }

    /// Adds a line about a file of data that is beside the page.
    pub fn data(&mut self, file: &str, words: &str) {
        let name = escape(file);
        self.body
            .raw(&format!("<p class=\"faint\">Data: <a href=\"{name}\">{name}</a>, {}</p>\n", marked(words)));
    }

    /// The whole page, with this at its foot.
    pub fn html(&self, foot: &str) -> String {
        let title = escape(&unmarked(&self.title));
        let mut html = format!(
            "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"/>\n{}\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n\
             <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\"/>\n\
             <title>{title}</title>\n<style>\n{STYLE}</style></head>\n<body><header><h1>{}</h1>\n<p class=\"lead\">{}</p></header>\n",
            generator(&self.maker),
            marked(&self.title),
            marked(&self.lead)
        );
        if !self.short.is_empty() {
            html += "<ul class=\"plain\">";
            self.short.iter().for_each(|line| html += &format!("<li>{}</li>", marked(line)));
            html += "</ul>\n";
        }
        if self.sections.len() > 1 {
            html += "<nav aria-label=\"Contents\"><ol>";
            for (i, section) in self.sections.iter().enumerate() {
                html += &format!("<li><a href=\"#s{}\">{}</a></li>", i + 1, marked(section));
            }
            html += "</ol></nav>\n";
        }
        let close = if self.sections.is_empty() { "" } else { "</section>\n" };
        html += &format!("<main>{}{close}</main>\n", self.body.0);
        if !foot.is_empty() {
            html += &format!("<footer>{}</footer>\n", marked(foot));
        }
        html + "</body></html>\n"
    }
}

/// The line that names who made a page.
fn generator(maker: &str) -> String {
    format!("<meta name=\"generator\" content=\"{}\"/>", escape(maker))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::film::Image;

    /// Markup and text of a part, which has to be well-formed.
    pub(crate) fn parsed(html: &Html) -> (String, String) {
        let whole = format!("<html>{}</html>", html.0);
        let document = roxmltree::Document::parse(&whole).unwrap_or_else(|error| panic!("{error}: {whole}"));
        let text = document.descendants().filter_map(|node| node.text()).collect();
        (html.0.clone(), text)
    }

    fn check(page: &Page) -> String {
        let html = page.html("made by `cargo test` < 1 s");
        let options = roxmltree::ParsingOptions { allow_dtd: true, ..Default::default() };
        let document = roxmltree::Document::parse_with_options(&html, options);
        let document = document.unwrap_or_else(|error| panic!("{error}\n{html}"));
        for node in document.descendants() {
            // What is not a number has no place in a drawing.
            for attribute in node
                .attributes()
                .filter(|a| matches!(a.name(), "d" | "x" | "y" | "cx" | "cy" | "width" | "height" | "points"))
            {
                let value = attribute.value();
                assert!(!value.contains("NaN") && !value.contains("inf"), "{value}");
            }
            if node.has_tag_name("img") {
                assert!(node.attribute("alt").is_some_and(|alt| !alt.is_empty()));
                assert!(node.attribute("src").is_some_and(|src| src.starts_with("data:")));
            }
            if node.has_tag_name("svg") && node.attribute("aria-hidden").is_none() {
                assert!(node.attribute("aria-label").is_some_and(|label| !label.is_empty()));
            }
            let elsewhere = node.attributes().any(|a| a.value().starts_with("http") && a.name() != "xmlns");
            assert!(!elsewhere, "{node:?}");
        }
        html
    }

    #[test]
    fn a_page_of_everything_is_well_formed() {
        let mut page = Page::new("occlude <test>", "A & B", "V_{A} < 1");
        page.in_short("first & foremost");
        page.prose("before any section");
        page.section("First <section>");
        page.heading("Heading & more");
        page.list(["one", "`two <b>`"]);
        page.facts([("word", "meaning"), ("<x>", "&")]);
        page.data("a&b.csv", "everything");
        let bad = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.0, -1.0, 1e-300, 1e300];
        let points = || bad.iter().flat_map(|&x| bad.map(|y| Point { x, y, error: x }));
        page.section("Second");
        for axis in [Axis::linear("<x>"), Axis::log("y & z")] {
            let plot = Plot::new("<plot>", axis.clone(), axis.clone()).series(Series::with_errors(
                "\"s\"",
                9,
                points(),
            ));
            let dashed = Series::new("", 3, [(1.0, 2.0), (3.0, 4.0)]).line(Line::Dashed);
            let lone = Series::new("lone", 3, [(1.0, 2.0)]).line(Line::None);
            page.add(&Figure::new("t", "").plot(plot.series(dashed).series(lone)).plot(Plot::new(
                "empty",
                axis.clone(),
                Axis::default(),
            )));
            let mut bars = Bars::new("<bars>", "w", axis, 1.0).columns("<v>", "&");
            bars.group(
                "g",
                bad.map(|value| Bar {
                    name: "<n>".to_owned(),
                    value,
                    error: value,
                    beside: "<b>".to_owned(),
                    tone: 11,
                }),
            );
            bars.group("empty", []);
            page.add(&bars);
        }
        page.add(&Figure::default());
        let image = Image::from_fn(5, 4, |x, y| [x as f32, y as f32, f32::NAN]);
        let crop = Crop { x: 3, y: 3, width: 10, height: 1 };
        let mut strip = Strip::new("<strip>", "", ["1".to_owned(), "<2>".to_owned()])
            .crops([("<crop>".to_owned(), crop)]);
        strip.row(
            "<row>",
            [Picture::new(&image, 0.0, "a \"quoted\" alt").crops(&image, 0.0, &[crop]).under("0.1 < 0.2")],
        );
        strip.row("empty", [Picture::new(&Image::new(0, 0), 0.0, "nothing")]);
        page.add(&strip);
        let mut gallery = Gallery::new("g", "").ramp(f64::NAN, f64::INFINITY, "<unit>");
        gallery.picture("<p>", Picture::new(&heat(&bad, 3, 2, 0.0, f64::NAN), 0.0, "heat"));
        page.add(&gallery);
        page.folded("more", &Table::new("t").words("w"));
        let html = check(&page);
        assert!(!html.contains("<section>\"") && html.contains("&lt;section&gt;"));
        check(&Page::new("", "", ""));
    }

    #[test]
    fn names_become_letters_and_curves_are_drawn_where_the_numbers_are() {
        let mut html = Html::default();
        let axes = || Axis::log("n").at([1.0, 10.0, 100.0]);
        let series = Series::new("one", 1, [(1.0, 1.0), (10.0, 10.0), (100.0, 100.0), (0.0, 1.0)]);
        Figure::new("", "").plot(Plot::new("", axes(), axes()).series(series)).html(&mut html);
        let (markup, text) = parsed(&html);
        assert!(text.contains("no place on these axes: 1 points"), "{text}");
        let path = markup.split("<path class=\"curve t1\" d=\"").nth(1).unwrap().split('"').next().unwrap();
        let numbers: Vec<f64> = path.split(['M', 'L', ' ']).filter_map(|n| n.parse().ok()).collect();
        let [x0, y0, x1, y1, x2, y2] = numbers[..] else { panic!("{path}") };
        // Half-way along and half-way up.
        assert!(
            (x1 - (x0 + x2) / 2.0).abs() < 0.2 && (y1 - (y0 + y2) / 2.0).abs() < 0.2 && y2 < y0,
            "{path}"
        );
    }
}
