//! Colours of labels.

use super::VolumeLabel;

/// The colour of a label, sRGB: the file's, or one of its own that differs from those of the labels next to it.
pub fn label_color(value: u32, labels: &[VolumeLabel]) -> [u8; 3] {
    let of_file = labels.iter().find(|label| label.value == value).and_then(|label| label.color);
    of_file.unwrap_or_else(|| {
        // Steps by the golden ratio never come close to a hue of a few steps before.
        let hue = (f64::from(value) * GOLDEN_RATIO).fract() * 6.0;
        let [least, greatest] = LEVELS[value as usize % LEVELS.len()];
        [5.0, 3.0, 1.0].map(|shift| {
            let k = (hue + shift) % 6.0;
            let share = (2.0 - (k - 3.0).abs()).clamp(0.0, 1.0);
            (least + (greatest - least) * share).round() as u8
        })
    })
}

const GOLDEN_RATIO: f64 = 0.618_033_988_749_894_9;
/// Least and greatest component of a colour.
const LEVELS: [[f64; 2]; 3] = [[70.0, 245.0], [110.0, 225.0], [40.0, 205.0]];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_near_each_other_have_colours_apart() {
        let apart = |a: u32, b: u32| {
            let [a, b] = [a, b].map(|value| label_color(value, &[]));
            a.iter().zip(b).map(|(&a, b)| i32::from(a).abs_diff(i32::from(b))).sum::<u32>()
        };
        for a in 1..200 {
            for b in a + 1..a + 5 {
                assert!(apart(a, b) > 60, "{a} {b}: {:?} {:?}", label_color(a, &[]), label_color(b, &[]));
            }
        }
        assert_eq!(apart(7, 7), 0);
    }

    #[test]
    fn a_colour_of_the_file_holds() {
        let label = |color| VolumeLabel { value: 5, name: "liver".into(), color };
        assert_eq!(label_color(5, &[label(Some([1, 2, 3]))]), [1, 2, 3]);
        // The control: another label, and one without a colour.
        assert_eq!(label_color(6, &[label(Some([1, 2, 3]))]), label_color(6, &[]));
        assert_eq!(label_color(5, &[label(None)]), label_color(5, &[]));
    }
}
