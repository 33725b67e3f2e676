//! What the thesis' slides print, as they print it, for comparison with what comes out here.
//!
//! Niels Billen, "Stochastische visibiliteit in rendering algoritmen a.d.h.v. de occlusion map", master's thesis,
//! KU Leuven, promotor Philip Dutré.

use occlude_kernel::Decomposition;

/// A table of a decomposition: for (V_A, V_B) = 00, 01, 10, 11 what each term's estimate is, and the variance.
pub(super) struct FormTable {
    pub(super) form: Decomposition,
    pub(super) estimates: [[&'static str; 3]; 4],
    pub(super) variances: [&'static str; 4],
}

pub(super) const FORMS: [FormTable; 3] = [
    FormTable {
        form: Decomposition::InclusionExclusion,
        estimates: [["0", "0", "0"], ["0", "3", "-3"], ["3", "0", "-3"], ["3", "3", "-3"]],
        variances: ["0", "6", "6", "8"],
    },
    FormTable {
        form: Decomposition::Balanced,
        estimates: [["-1", "-1", "2"], ["-1", "2", "-1"], ["2", "-1", "-1"], ["2", "2", "-1"]],
        variances: ["2", "2", "2", "2"],
    },
    FormTable {
        form: Decomposition::Power(8),
        estimates: [
            ["0", "0", "0"],
            ["0", "-3/254", "3/254"],
            ["-3/254", "0", "3/254"],
            ["-3/254", "-3/254", "768/254"],
        ],
        variances: ["0", "4.65e-5", "4.65e-5", "2.048"],
    },
];

/// Time in s and intersection tests in millions of a scene, without and with stochastic visibility.
pub(super) struct Scene {
    pub(super) name: &'static str,
    pub(super) time: [f64; 2],
    pub(super) tests: [f64; 2],
}

/// The results of the first, plain algorithm.
pub(super) const PLAIN: [Scene; 3] = [
    Scene { name: "first scene", time: [68.0, 63.0], tests: [1957.0, 1610.0] },
    Scene { name: "second scene", time: [62.0, 58.0], tests: [1194.0, 885.0] },
    Scene { name: "third scene", time: [133.0, 126.0], tests: [4028.0, 3074.0] },
];

/// What the slides say these average to: fewer tests, less time, in percent.
pub(super) const PLAIN_AVERAGE: [&str; 2] = ["26", "5"];

/// Whether a printed number is this value, rounded to the digits that are printed. Fractions and whole numbers are
/// taken to be meant exactly.
pub(super) fn agrees(printed: &str, value: f64) -> bool {
    if let Some((above, below)) = printed.split_once('/') {
        let (Ok(above), Ok(below)) = (above.parse::<f64>(), below.parse::<f64>()) else { return false };
        return (above / below - value).abs() < 1e-9 * value.abs().max(1.0);
    }
    let Ok(number) = printed.parse::<f64>() else { return false };
    let (mantissa, exponent) = printed.split_once('e').unwrap_or((printed, "0"));
    let decimals = mantissa.split_once('.').map_or(0, |(_, decimals)| decimals.len() as i32);
    let unit = 10f64.powi(exponent.parse::<i32>().unwrap_or(0) - decimals);
    let room = if decimals == 0 { 1e-9 } else { 0.5 * unit * (1.0 + 1e-9) };
    (number - value).abs() <= room
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn printed_numbers_stand_for_what_rounds_to_them() {
        assert!(agrees("2.048", 2.04752) && !agrees("2.048", 2.0470));
        assert!(agrees("9.30e-5", 6.0 / 254.0 / 254.0) && !agrees("4.65e-5", 6.0 / 254.0 / 254.0));
        assert!(agrees("-3/254", -3.0 / 254.0) && !agrees("-3/254", -3.1 / 254.0));
        assert!(agrees("6", 6.0) && !agrees("6", 6.2) && !agrees("six", 6.0) && !agrees("1/0", 1.0));
    }
}
