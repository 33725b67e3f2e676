//! Pictures: inline PNG, alone, in rows and columns, with crops, and as heat maps.

use super::text::{escape, marked, number, unmarked};
use super::{Html, Part};
use crate::film::Image;
use crate::output::{self, srgb_decode};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;

/// A picture and the words for those who do not see it.
#[derive(Clone, Debug)]
pub struct Picture {
    source: String,
    size: (u32, u32),
    words: String,
    crops: Vec<String>,
    under: String,
}

/// A rectangle of a picture to look at closely, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Crop {
    /// Its leftmost column.
    pub x: u32,
    /// Its topmost row.
    pub y: u32,
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
}

/// Crops there are colours for.
pub const CROPS: usize = 4;

impl Picture {
    /// Of linear radiance, encoded for screens after an exposure in stops. An empty image is a picture of nothing.
    pub fn new(image: &Image, exposure_ev: f32, words: impl Into<String>) -> Self {
        let size = (image.width, image.height);
        Self {
            source: data_uri(image, exposure_ev),
            size,
            words: words.into(),
            crops: Vec::new(),
            under: String::new(),
        }
    }

    /// The same with these parts of it enlarged below, as far as they lie inside.
    pub fn crops(mut self, image: &Image, exposure_ev: f32, crops: &[Crop]) -> Self {
        self.crops = crops.iter().take(CROPS).map(|&crop| data_uri(&cut(image, crop), exposure_ev)).collect();
        self
    }

    /// The same with a line of text below.
    pub fn under(mut self, text: impl Into<String>) -> Self {
        self.under = text.into();
        self
    }

    fn html(&self, html: &mut Html, marks: &[Crop]) {
        let words = escape(&unmarked(&self.words));
        let (width, height) = self.size;
        html.raw("<div class=\"picture\">");
        html.raw(&format!(
            "<img src=\"{}\" width=\"{width}\" height=\"{height}\" alt=\"{words}\"/>",
            self.source
        ));
        for (i, crop) in marks.iter().enumerate().take(CROPS) {
            let percent = |part: u32, whole: u32| 100.0 * f64::from(part) / f64::from(whole.max(1));
            html.raw(&format!(
                "<i class=\"k{i}\" style=\"left:{:.2}%;top:{:.2}%;width:{:.2}%;height:{:.2}%\"></i>",
                percent(crop.x, width),
                percent(crop.y, height),
                percent(crop.width, width),
                percent(crop.height, height)
            ));
        }
        html.raw("</div>");
        if !self.crops.is_empty() {
            html.raw("<div class=\"crops\">");
            for (i, source) in self.crops.iter().enumerate() {
                html.raw(&format!("<img class=\"k{i}\" src=\"{source}\" alt=\"part {} of it\"/>", i + 1));
            }
            html.raw("</div>");
        }
        if !self.under.is_empty() {
            html.raw(&format!("<div class=\"under\">{}</div>", marked(&self.under)));
        }
    }
}

fn data_uri(image: &Image, exposure_ev: f32) -> String {
    // An image without pixels has no PNG; a source without data is a picture of nothing.
    let png = output::png(image, exposure_ev).unwrap_or_default();
    format!("data:image/png;base64,{}", STANDARD.encode(png))
}

fn cut(image: &Image, crop: Crop) -> Image {
    let (left, top) = (crop.x.min(image.width), crop.y.min(image.height));
    let (width, height) = (crop.width.min(image.width - left), crop.height.min(image.height - top));
    Image::from_fn(width, height, |x, y| image.pixels[((top + y) * image.width + left + x) as usize])
}

/// Pictures in rows and columns, each row and column with a name.
#[derive(Clone, Debug, Default)]
pub struct Strip {
    title: String,
    words: String,
    columns: Vec<String>,
    rows: Vec<(String, Vec<Picture>)>,
    crops: Vec<(String, Crop)>,
}

impl Strip {
    /// Without a picture yet.
    pub fn new(
        title: impl Into<String>,
        words: impl Into<String>,
        columns: impl IntoIterator<Item = String>,
    ) -> Self {
        let columns = columns.into_iter().collect();
        Self { title: title.into(), words: words.into(), columns, rows: Vec::new(), crops: Vec::new() }
    }

    /// The same with frames in the pictures where they are enlarged, and what is to be seen there.
    pub fn crops(mut self, crops: impl IntoIterator<Item = (String, Crop)>) -> Self {
        self.crops = crops.into_iter().take(CROPS).collect();
        self
    }

    /// One more row.
    pub fn row(&mut self, name: impl Into<String>, pictures: impl IntoIterator<Item = Picture>) {
        self.rows.push((name.into(), pictures.into_iter().collect()));
    }
}

impl Part for Strip {
    fn html(&self, html: &mut Html) {
        let marks: Vec<Crop> = self.crops.iter().map(|(_, crop)| *crop).collect();
        html.raw("<figure>");
        html.caption(&self.title, &self.words);
        html.raw(&format!(
            "<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"{}\">",
            escape(&unmarked(&self.title))
        ));
        html.raw("<table class=\"strip\"><thead><tr><td></td>");
        self.columns.iter().for_each(|name| html.raw(&format!("<th scope=\"col\">{}</th>", marked(name))));
        html.raw("</tr></thead><tbody>");
        for (name, pictures) in &self.rows {
            html.raw(&format!("<tr><th scope=\"row\">{}</th>", marked(name)));
            for picture in pictures {
                html.raw("<td>");
                picture.html(html, &marks);
                html.raw("</td>");
            }
            html.raw("</tr>\n");
        }
        html.raw("</tbody></table></div>");
        if !self.crops.is_empty() {
            html.raw("<ul class=\"legend\">");
            for (i, (name, _)) in self.crops.iter().enumerate() {
                html.raw(&format!("<li><span><span class=\"key k{i}\"></span>{}</span></li>", marked(name)));
            }
            html.raw("</ul>");
        }
        html.raw("</figure>\n");
    }
}

/// Pictures side by side, each under a name, with the ramp of colours that heat maps share.
#[derive(Clone, Debug, Default)]
pub struct Gallery {
    title: String,
    words: String,
    pictures: Vec<(String, Picture)>,
    ramp: Option<(f64, f64, String)>,
}

impl Gallery {
    /// Without a picture yet.
    pub fn new(title: impl Into<String>, words: impl Into<String>) -> Self {
        Self { title: title.into(), words: words.into(), ..Self::default() }
    }

    /// One more picture.
    pub fn picture(&mut self, name: impl Into<String>, picture: Picture) {
        self.pictures.push((name.into(), picture));
    }

    /// The same with the colours of [`heat`] from `low` to `high` explained.
    pub fn ramp(mut self, low: f64, high: f64, unit: impl Into<String>) -> Self {
        self.ramp = Some((low, high, unit.into()));
        self
    }
}

impl Part for Gallery {
    fn html(&self, html: &mut Html) {
        html.raw("<figure>");
        html.caption(&self.title, &self.words);
        html.raw("<div class=\"gallery\">");
        for (name, picture) in &self.pictures {
            html.raw(&format!("<div><h4>{}</h4>", marked(name)));
            picture.html(html, &[]);
            html.raw("</div>\n");
        }
        html.raw("</div>");
        if let Some((low, high, unit)) = &self.ramp {
            let words = format!("colours from {} to {} {unit}", number(*low, 3), number(*high, 3));
            html.raw(&format!(
                "<svg class=\"ramp\" viewBox=\"0 0 350 34\" role=\"img\" aria-label=\"{}\">",
                escape(&unmarked(&words))
            ));
            for i in 0..100 {
                let [r, g, b] = colour(f64::from(i) / 99.0).map(|c| (c * 255.0).round() as u8);
                // Wider than the step, so that no gap shines through.
                html.raw(&format!(
                    "<rect x=\"{}\" y=\"0\" width=\"4\" height=\"12\" shape-rendering=\"crispEdges\" fill=\"#{r:02x}{g:02x}{b:02x}\"/>",
                    i * 3
                ));
            }
            let label = |x: u32, anchor: &str, text: String| {
                format!("<text x=\"{x}\" y=\"28\" text-anchor=\"{anchor}\">{}</text>", escape(&text))
            };
            html.raw(&label(0, "start", number(*low, 3)));
            html.raw(&label(150, "middle", unmarked(unit)));
            html.raw(&label(303, "end", number(*high, 3)));
            html.raw("</svg>");
        }
        html.raw("</figure>\n");
    }
}

/// Numbers as colours, `low` dark blue and `high` yellow; what is beyond is cut off, and NaN is grey.
///
/// As many of `values` as there are pixels count, row by row; what is missing is NaN.
pub fn heat(values: &[f64], width: u32, height: u32, low: f64, high: f64) -> Image {
    Image::from_fn(width, height, |x, y| {
        let value = values.get((y * width + x) as usize).copied().unwrap_or(f64::NAN);
        let share = (value - low) / (high - low);
        if share.is_nan() { [0.2; 3] } else { colour(share).map(srgb_decode) }
    })
}

/// The colour map viridis (Smith and van der Walt, 2015), interpolated between ten of its colours: it grows evenly
/// brighter, also for those who do not tell red from green. sRGB.
fn colour(share: f64) -> [f32; 3] {
    const COLOURS: [[u8; 3]; 10] = [
        [0x44, 0x01, 0x54],
        [0x48, 0x28, 0x78],
        [0x3e, 0x4a, 0x89],
        [0x31, 0x68, 0x8e],
        [0x26, 0x82, 0x8e],
        [0x1f, 0x9e, 0x89],
        [0x35, 0xb7, 0x79],
        [0x6d, 0xcd, 0x59],
        [0xb4, 0xde, 0x2c],
        [0xfd, 0xe7, 0x25],
    ];
    let at = share.clamp(0.0, 1.0) * (COLOURS.len() - 1) as f64;
    let first = (at as usize).min(COLOURS.len() - 2);
    let part = (at - first as f64) as f32;
    std::array::from_fn(|c| {
        let (from, to) = (f32::from(COLOURS[first][c]), f32::from(COLOURS[first + 1][c]));
        (from + (to - from) * part) / 255.0
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_comes_back_out_of_the_page() {
        let image = Image::from_fn(3, 2, |x, y| [x as f32 * 0.25, y as f32, 0.5]);
        let uri = data_uri(&image, 0.0);
        let bytes = STANDARD.decode(uri.strip_prefix("data:image/png;base64,").unwrap()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        std::fs::write(&path, bytes).unwrap();
        let back = output::read(&path).unwrap();
        let close = |a: &[f32; 3], b: &[f32; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 0.01);
        assert!(back.pixels.iter().zip(&image.pixels).all(|(a, b)| close(a, b)), "{back:?}");
    }

    #[test]
    fn crops_end_where_the_image_does() {
        let image = Image::from_fn(4, 4, |x, y| [x as f32, y as f32, 0.0]);
        let part = cut(&image, Crop { x: 2, y: 3, width: 9, height: 9 });
        assert_eq!((part.width, part.height, part.pixels), (2, 1, vec![[2.0, 3.0, 0.0], [3.0, 3.0, 0.0]]));
        assert_eq!(cut(&image, Crop { x: 7, y: 0, width: 2, height: 2 }).width, 0);
    }

    #[test]
    fn heat_is_dark_below_and_grey_for_nothing() {
        let image = heat(&[-1.0, 2.0, f64::NAN], 4, 1, 0.0, 1.0);
        let brightness: Vec<f32> = image.pixels.iter().map(|p| p.iter().sum()).collect();
        assert!(brightness[0] < 0.2 && brightness[1] > 1.5, "{brightness:?}");
        assert_eq!((image.pixels[2], image.pixels[3]), ([0.2; 3], [0.2; 3]));
        // A range without extent: no panic, and still a picture.
        assert_eq!(heat(&[1.0; 4], 2, 2, 1.0, 1.0).pixels.len(), 4);
    }
}
