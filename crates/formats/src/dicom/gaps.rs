//! Measures the distances of slices, and finds missing slices and separate blocks.

use crate::warning::WarningKind;

/// The distance in millimetres at which slices are shown. `places` are at least two positions along the normal.
/// Uneven distances cause warnings, and so does a difference from `told`, the distance in the file.
pub(super) fn slice_distance(
    places: &[f64],
    told: Option<f64>,
    warnings: &mut Vec<(WarningKind, String)>,
) -> f64 {
    let gaps: Vec<f64> = places.windows(2).map(|w| w[1] - w[0]).collect();
    let mut sorted = gaps.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted[(sorted.len() - 1) / 2];
    let mut warn = |text: String| warnings.push((WarningKind::Geometry, text));
    // Numbers of slices before each gap between blocks, numbers before each missing slice, and all other gaps.
    let (mut ends, mut missing, mut even) = (vec![0], Vec::new(), Vec::new());
    let (mut widest, mut num_missing) = (0.0f64, 0.0);
    for (i, gap) in gaps.iter().enumerate() {
        let steps = (gap / median).round();
        if *gap > BLOCK_GAP * median {
            ends.push(i + 1);
            widest = widest.max(*gap);
        } else if steps >= 2.0 && (gap / median - steps).abs() < 0.2 {
            missing.push(i + 1);
            num_missing += steps - 1.0;
        } else {
            even.push(*gap);
        }
    }
    ends.push(places.len());
    let distance = even.iter().sum::<f64>() / even.len() as f64;
    let sizes: Vec<usize> = ends.windows(2).map(|w| w[1] - w[0]).collect();
    if sizes.len() > 1 {
        let (num_blocks, sizes, gap) = (sizes.len(), listed(&sizes), the_gaps(sizes.len() - 1));
        warn(format!(
            "the slices lie in {num_blocks} separate blocks of {sizes} slices, up to {widest:.1} mm apart; {gap} not shown"
        ));
    }
    if !missing.is_empty() {
        let are = if num_missing == 1.0 { "slice is" } else { "slices are" };
        let slices = if missing.len() == 1 { "slice" } else { "slices" };
        let (after, gap) = (listed(&missing), the_gaps(missing.len()));
        warn(format!("{num_missing} {are} missing, after {slices} {after}; {gap} not shown"));
    }
    let (least, greatest) =
        even.iter().fold((f64::INFINITY, 0.0f64), |(lo, hi), gap| (lo.min(*gap), hi.max(*gap)));
    let tolerance = JITTER_MM.max(UNEVEN * median);
    if (greatest - median).max(median - least) > tolerance {
        warn(format!(
            "slices are {least:.3} to {greatest:.3} mm apart; they are shown {distance:.3} mm apart"
        ));
    }
    if let Some(told) = told.filter(|t| (t - distance).abs() > 0.05 * distance && missing.is_empty()) {
        warn(format!(
            "the file says that slices are {told} mm apart, their positions {distance:.3} mm, which is shown"
        ));
    }
    distance
}

fn the_gaps(count: usize) -> &'static str {
    if count == 1 { "the gap is" } else { "the gaps are" }
}

/// Lists numbers, such as `3, 5 and 8`. Long lists are cut.
fn listed(numbers: &[usize]) -> String {
    let words = |list: &[usize]| list.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
    match numbers {
        [] => String::new(),
        [one] => one.to_string(),
        _ if numbers.len() > MAX_LISTED => {
            format!("{} and {} more", words(&numbers[..MAX_LISTED]), numbers.len() - MAX_LISTED)
        }
        [most @ .., last] => format!("{} and {last}", words(most)),
    }
}

/// A gap of more distances separates two blocks. In a smaller one, slices are missing.
const BLOCK_GAP: f64 = 4.0;
/// Distances that differ by less than this, or by this fraction, are rounded.
const JITTER_MM: f64 = 1e-3;
const UNEVEN: f64 = 0.01;
/// Most numbers in a warning.
const MAX_LISTED: usize = 6;

#[cfg(test)]
mod tests {
    use super::*;

    /// The distance for slices with these gaps, and the warnings.
    fn of_gaps(gaps: &[f64]) -> (f64, Vec<String>) {
        let places = gaps.iter().scan(-20.0, |at, gap| {
            *at += gap;
            Some(*at)
        });
        let places: Vec<f64> = [-20.0].into_iter().chain(places).collect();
        let mut warnings = Vec::new();
        let distance = slice_distance(&places, None, &mut warnings);
        // The tolerance removes rounding of sums.
        ((distance * 1e6).round() / 1e6, warnings.into_iter().map(|w| w.1).collect())
    }

    #[test]
    fn distances_that_differ_by_rounding_are_even() {
        let said = |gaps: &[f64]| of_gaps(gaps).1;
        assert_eq!(said(&[3.0, 3.02, 2.98, 3.0]), [""; 0]);
        assert_eq!(
            said(&[3.0, 3.04, 2.96, 3.0]),
            ["slices are 2.960 to 3.040 mm apart; they are shown 3.000 mm apart"]
        );
        // Half a micrometre is a tenth of this distance.
        assert_eq!(said(&[0.005, 0.0055, 0.0045, 0.005]), [""; 0]);
        assert_eq!(said(&[0.005, 0.007, 0.003, 0.005]).len(), 1);
    }

    #[test]
    fn missing_slices_are_told_with_their_places() {
        let expected = |text: &str| (3.0, vec![text.to_owned()]);
        assert_eq!(of_gaps(&[3.0, 6.0]), expected("1 slice is missing, after slice 2; the gap is not shown"));
        assert_eq!(
            of_gaps(&[3.0, 6.0, 3.0, 9.0, 3.0, 3.0, 3.0]),
            expected("3 slices are missing, after slices 2 and 4; the gaps are not shown")
        );
        // Missing slices do not hide that the others are uneven.
        let (_, said) = of_gaps(&[3.0, 6.0, 3.3, 3.0, 2.7]);
        assert_eq!(said.len(), 2, "{said:?}");
    }

    #[test]
    fn blocks_are_told_and_not_stretched() {
        let (distance, said) = of_gaps(&[2.0, 2.0, 2.0, 71.3, 2.0, 2.0]);
        assert_eq!(distance, 2.0);
        let expected = "the slices lie in 2 separate blocks of 4 and 3 slices, up to 71.3 mm apart; the gap is not shown";
        assert_eq!(said, [expected]);
        // A single distant slice is a block, too.
        let (distance, said) = of_gaps(&[324.0, 2.0, 2.0]);
        assert_eq!((distance, said.len()), (2.0, 1), "{said:?}");
    }
}
