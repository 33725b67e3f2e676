//! Axes: a range that holds the data, ticks at round numbers, and places between 0 and 1.

use super::text::short;

/// How numbers are laid along an axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scale {
    /// Equal steps for equal differences.
    #[default]
    Linear,
    /// Equal steps for equal ratios. What is not above 0 has no place.
    Log,
}

/// What an axis shows, and how.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axis {
    /// What the numbers are, with their unit.
    pub label: String,
    /// How they are laid out.
    pub scale: Scale,
    /// Where to put ticks; round numbers if empty.
    pub ticks: Vec<f64>,
    /// Numbers that the range has to hold whatever the data are.
    pub include: Vec<f64>,
}

impl Axis {
    /// A linear axis.
    pub fn linear(label: impl Into<String>) -> Self {
        Self { label: label.into(), ..Self::default() }
    }

    /// A logarithmic axis.
    pub fn log(label: impl Into<String>) -> Self {
        Self { label: label.into(), scale: Scale::Log, ..Self::default() }
    }

    /// The same with ticks at these numbers, which are part of its range.
    pub fn at(mut self, ticks: impl IntoIterator<Item = f64>) -> Self {
        self.ticks = ticks.into_iter().collect();
        self
    }

    /// The same with a range that holds this number.
    pub fn with(mut self, number: f64) -> Self {
        self.include.push(number);
        self
    }

    /// Laid out for these numbers, of which those without a place are left out.
    pub(super) fn layout(&self, numbers: impl Iterator<Item = f64>) -> Layout {
        let all = numbers.chain(self.ticks.iter().copied()).chain(self.include.iter().copied());
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for place in all.filter_map(|number| transform(self.scale, number)) {
            (low, high) = (low.min(place), high.max(place));
        }
        if low > high {
            (low, high) = (0.0, 1.0);
        }
        if high - low <= low.abs().max(high.abs()) * 1e-9 {
            // One number only: put it in the middle.
            let room = if self.scale == Scale::Log { 0.5 } else { (0.1 * low.abs()).max(0.5) };
            (low, high) = (low - room, high + room);
        }
        let mut layout = Layout { scale: self.scale, low, high, ticks: Vec::new(), minor: Vec::new() };
        if self.ticks.is_empty() {
            match self.scale {
                Scale::Linear => layout.linear_ticks(),
                Scale::Log => layout.log_ticks(),
            }
        } else {
            let at = |&tick: &f64| Some((transform(self.scale, tick)?, short(tick)));
            layout.ticks = self.ticks.iter().filter_map(at).collect();
            let room = 0.04 * (layout.high - layout.low);
            (layout.low, layout.high) = (layout.low - room, layout.high + room);
        }
        layout
    }
}

/// Where a number lies, in units of its own; `None` where it has no place.
fn transform(scale: Scale, number: f64) -> Option<f64> {
    let place = match scale {
        // Beyond this, differences overflow.
        Scale::Linear => Some(number).filter(|number| number.abs() < 1e300),
        Scale::Log => Some(number.log10()).filter(|_| number > 0.0),
    };
    place.filter(|place| place.is_finite())
}

/// An axis laid out.
#[derive(Clone, Debug)]
pub(super) struct Layout {
    scale: Scale,
    low: f64,
    high: f64,
    ticks: Vec<(f64, String)>,
    minor: Vec<f64>,
}

/// Ticks with a label, at most about so many.
const MOST_TICKS: f64 = 6.0;

impl Layout {
    /// From 0 at the low end to 1 at the high one; what is beyond an end lies at that end. `None` where a number has
    /// no place.
    pub(super) fn place(&self, number: f64) -> Option<f64> {
        transform(self.scale, number).map(|place| self.share(place).clamp(0.0, 1.0))
    }

    fn share(&self, place: f64) -> f64 {
        (place - self.low) / (self.high - self.low)
    }

    /// Places and labels.
    pub(super) fn ticks(&self) -> impl Iterator<Item = (f64, &str)> {
        let inside = |(place, label): &'_ (f64, String)| {
            -1e-9 <= self.share(*place) && self.share(*place) <= 1.0 + 1e-9 && !label.is_empty()
        };
        self.ticks
            .iter()
            .filter(move |tick| inside(tick))
            .map(|(place, label)| (self.share(*place), label.as_str()))
    }

    /// Places without labels.
    pub(super) fn minor(&self) -> impl Iterator<Item = f64> {
        self.minor.iter().map(|&place| self.share(place)).filter(|share| (0.0..=1.0).contains(share))
    }

    /// Multiples of 1, 2 or 5 times a power of ten; the range grows to the ticks around it.
    fn linear_ticks(&mut self) {
        let raw = (self.high - self.low) / MOST_TICKS;
        let power = 10f64.powf(raw.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|&step| step >= raw * 0.999);
        let step = step.unwrap_or(raw);
        let (first, last) = ((self.low / step + 1e-9).floor(), (self.high / step - 1e-9).ceil());
        let count = (last - first).clamp(0.0, 100.0) as u32;
        (self.low, self.high) = (first * step, last * step);
        self.ticks =
            (0..=count).map(|i| (first + f64::from(i)) * step).map(|tick| (tick, short(tick))).collect();
    }

    /// Powers of ten, or where there are few of them 1, 2 and 5 times those.
    fn log_ticks(&mut self) {
        let room = 0.03 * (self.high - self.low);
        (self.low, self.high) = (self.low - room, self.high + room);
        let decades = self.high - self.low;
        let (first, last) = (self.low.floor() as i32, self.high.ceil() as i32);
        let every = ((decades / MOST_TICKS).ceil() as i32).max(1);
        let multiples: &[f64] = if decades < 0.7 {
            &[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0]
        } else if decades < 2.5 {
            &[1.0, 2.0, 5.0]
        } else {
            &[1.0]
        };
        for decade in first..=last {
            let base = f64::from(decade);
            if decade.rem_euclid(every) == 0 {
                self.ticks
                    .extend(multiples.iter().map(|m| (base + m.log10(), short(m * 10f64.powi(decade)))));
            }
            if every == 1 {
                self.minor.extend((2..10).map(|m| base + f64::from(m).log10()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: &Axis, numbers: &[f64]) -> Vec<String> {
        let layout = axis.layout(numbers.iter().copied());
        let ticks: Vec<(f64, &str)> = layout.ticks().collect();
        assert!(ticks.iter().all(|(place, _)| (-1e-6..=1.0 + 1e-6).contains(place)), "{ticks:?}");
        assert!(ticks.windows(2).all(|pair| pair[0].0 < pair[1].0), "{ticks:?}");
        ticks.into_iter().map(|(_, label)| label.to_owned()).collect()
    }

    #[test]
    fn round_numbers_around_the_data() {
        assert_eq!(labels(&Axis::linear("x"), &[0.03, 0.97]), ["0", "0.2", "0.4", "0.6", "0.8", "1"]);
        assert_eq!(labels(&Axis::linear("x"), &[-3.0, 12.0]), ["−5", "0", "5", "10", "15"]);
        assert_eq!(labels(&Axis::log("x"), &[0.001, 100.0]), ["0.001", "0.01", "0.1", "1", "10", "100"]);
        assert_eq!(labels(&Axis::log("x"), &[2.0, 60.0]), ["2", "5", "10", "20", "50"]);
        assert_eq!(labels(&Axis::log("rays").at([1.0, 16.0, 256.0]), &[4.0]), ["1", "16", "256"]);
    }

    #[test]
    fn places_run_from_end_to_end() {
        let layout = Axis::log("x").layout([1.0, 100.0].into_iter());
        let middle = layout.place(10.0).unwrap();
        assert!((middle - 0.5).abs() < 1e-9);
        assert_eq!(layout.place(1e9), Some(1.0));
        assert_eq!((layout.place(0.0), layout.place(-1.0), layout.place(f64::NAN)), (None, None, None));
        assert_eq!(Axis::linear("x").layout([0.0, 1.0].into_iter()).place(f64::INFINITY), None);
    }

    #[test]
    fn any_data_make_an_axis() {
        let odd = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0, 0.0, 1e-320, 1e308, -1e308, 5e-324, 7.0];
        for axis in [
            Axis::linear("x"),
            Axis::log("x"),
            Axis::log("x").at([0.0, -1.0]),
            Axis::linear("x").with(f64::NAN),
        ] {
            labels(&axis, &[]);
            for (i, &a) in odd.iter().enumerate() {
                labels(&axis, &[a]);
                odd[i..].iter().for_each(|&b| drop(labels(&axis, &[a, b])));
            }
            assert!(labels(&axis, &odd).len() < 200);
        }
    }
}
