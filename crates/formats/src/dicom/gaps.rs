//! Measures the distances of slices, and finds missing slices and separate blocks.

use crate::warning::WarningKind;

/// The distances of a stack of slices.
#[derive(Debug)]
pub(super) struct Gaps {
    /// The distance of slices that are evenly spaced, apart from missing ones and blocks, in millimetres.
    pub(super) distance: f64,
    /// The least distance that counts as neither of them.
    least: f64,
    greatest: f64,
    /// From the first slice to the last.
    span: f64,
    is_uneven: bool,
    /// Whether even distances would move some slice far from its place.
    is_displaced: bool,
    /// Number of slices in each block, and the widest gap between blocks.
    blocks: Vec<usize>,
    widest: f64,
    /// Numbers of the slices before each missing one.
    missing: Vec<usize>,
    num_missing: f64,
}

impl Gaps {
    /// `places` are at least two positions along the normal, in order.
    pub(super) fn of(places: &[f64]) -> Self {
        let gaps: Vec<f64> = places.windows(2).map(|w| w[1] - w[0]).collect();
        let mut sorted = gaps.clone();
        sorted.sort_by(f64::total_cmp);
        let median = sorted[(sorted.len() - 1) / 2];
        // Numbers of slices before each gap between blocks, and all distances that are neither such gaps nor missing
        // slices.
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
        let (least, greatest) =
            even.iter().fold((f64::INFINITY, 0.0f64), |(lo, hi), gap| (lo.min(*gap), hi.max(*gap)));
        let tolerance = JITTER_MM.max(UNEVEN * median);
        let distance = even.iter().sum::<f64>() / even.len() as f64;
        let mut place = 0.0;
        let displacement = even.iter().map(|gap| {
            place += gap - distance;
            f64::abs(place)
        });
        let is_displaced = displacement.fold(0.0, f64::max) > DISPLACED * distance;
        Self {
            distance,
            is_displaced,
            least,
            greatest,
            span: places[places.len() - 1] - places[0],
            is_uneven: (greatest - median).max(median - least) > tolerance,
            blocks: ends.windows(2).map(|w| w[1] - w[0]).collect(),
            widest,
            missing,
            num_missing,
        }
    }

    /// Whether all distances are the same.
    pub(super) fn are_even(&self) -> bool {
        !self.is_uneven && self.blocks.len() == 1 && self.missing.is_empty()
    }

    /// Whether slices have to be resampled to lie in their places. Rounded positions are near enough.
    pub(super) fn need_resampling(&self) -> bool {
        self.is_displaced || self.blocks.len() > 1 || !self.missing.is_empty()
    }

    /// The number of evenly spaced slices that show all of these, and their distance.
    pub(super) fn even_slices(&self) -> (f64, f64) {
        // A quarter of the mean keeps slices that nearly touch from filling the memory.
        let wanted = if self.is_displaced { self.least.max(self.distance / 4.0) } else { self.distance };
        let steps = (self.span / wanted).round().max(1.0);
        (steps + 1.0, self.span / steps)
    }

    /// Whether slices so far apart are in different blocks.
    pub(super) fn part_blocks(&self, gap: f64) -> bool {
        self.blocks.len() > 1 && gap > BLOCK_GAP * self.distance
    }

    /// Tells what is not even. `told` is the distance in the file, `resampled` that of the slices which are shown
    /// instead of these.
    pub(super) fn warn(
        &self,
        told: Option<f64>,
        resampled: Option<f64>,
        warnings: &mut Vec<(WarningKind, String)>,
    ) {
        let Self { distance, least, greatest, widest, num_missing, .. } = self;
        let mut warn = |text: String| warnings.push((WarningKind::Geometry, text));
        if self.blocks.len() > 1 {
            let (num_blocks, sizes) = (self.blocks.len(), listed(&self.blocks));
            let gap = if num_blocks == 2 { "the gap is" } else { "the gaps are" };
            let shown = if resampled.is_some() { "left empty" } else { "not shown" };
            warn(format!(
                "the slices lie in {num_blocks} separate blocks of {sizes} slices, up to {widest:.1} mm apart; {gap} {shown}"
            ));
        }
        if !self.missing.is_empty() {
            let is_one = *num_missing == 1.0;
            let are = if is_one { "slice is" } else { "slices are" };
            let slices = if self.missing.len() == 1 { "slice" } else { "slices" };
            let shown = match (resampled, self.missing.len()) {
                (Some(_), _) if is_one => "its neighbours were blended there",
                (Some(_), _) => "their neighbours were blended there",
                (None, 1) => "the gap is not shown",
                (None, _) => "the gaps are not shown",
            };
            warn(format!("{num_missing} {are} missing, after {slices} {}; {shown}", listed(&self.missing)));
        }
        if self.is_uneven {
            let shown = match resampled.filter(|_| self.is_displaced) {
                Some(step) => format!("they were resampled to {step:.3} mm"),
                None => format!("they are shown {distance:.3} mm apart"),
            };
            warn(format!("slices are {least:.3} to {greatest:.3} mm apart; {shown}"));
        }
        let is_other = |t: &f64| (t - distance).abs() > 0.05 * distance && self.missing.is_empty();
        if let Some(told) = told.filter(is_other).filter(|_| resampled.is_none()) {
            warn(format!(
                "the file says that slices are {told} mm apart, their positions {distance:.3} mm, which is shown"
            ));
        }
    }
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
/// A slice that is farther from its place than this, in distances, is elsewhere.
const DISPLACED: f64 = 0.1;
/// Most numbers in a warning.
const MAX_LISTED: usize = 6;

#[cfg(test)]
mod tests {
    use super::*;

    fn gaps(gaps: &[f64]) -> Gaps {
        let places = gaps.iter().scan(-20.0, |at, gap| {
            *at += gap;
            Some(*at)
        });
        Gaps::of(&[-20.0].into_iter().chain(places).collect::<Vec<_>>())
    }

    /// The distance for slices with these gaps, and the warnings.
    fn of_gaps(list: &[f64]) -> (f64, Vec<String>) {
        let found = gaps(list);
        let mut warnings = Vec::new();
        found.warn(None, None, &mut warnings);
        assert_eq!(found.are_even(), warnings.is_empty());
        // The tolerance removes rounding of sums.
        ((found.distance * 1e6).round() / 1e6, warnings.into_iter().map(|w| w.1).collect())
    }

    #[test]
    fn only_slices_that_lie_elsewhere_need_resampling() {
        for (list, needed) in [
            (&[3.0, 3.0, 3.0][..], false),
            // Rounded to a tenth of a millimetre.
            (&[3.0, 3.1, 2.9, 3.0], false),
            (&[3.0, 3.4, 2.6, 3.0], true),
            // Small differences add up.
            (&[3.0, 3.0, 3.0, 3.0, 3.2, 3.2, 3.2, 3.2], true),
            (&[3.0, 6.0, 3.0], true),
            (&[3.0, 3.0, 60.0, 3.0], true),
        ] {
            assert_eq!(gaps(list).need_resampling(), needed, "{list:?}");
        }
    }

    #[test]
    fn even_slices_reach_from_the_first_to_the_last() {
        let of = |list: &[f64]| {
            let (count, step) = gaps(list).even_slices();
            (count as u32, (step * 1e6).round() / 1e6)
        };
        assert_eq!(of(&[3.0, 6.0, 3.0]), (5, 3.0));
        assert_eq!(of(&[1.0, 1.0, 1.0, 2.5, 2.5]), (9, 1.0));
        // Slices that nearly touch do not make many.
        assert_eq!(of(&[4.0, 0.01, 4.0, 4.0, 3.99]).0, 21);
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
