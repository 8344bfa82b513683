//! The search for the settings of a codec whose parts are coded apart: a climb from the coarsest settings to the finest.
//!
//! At each step every part is refined for trial, and the refinement that lowers the distortion most for a byte is kept. Where
//! rates and distortions add up and refinements are worth ever less, the states of the climb are the lower convex hull of
//! all settings. They do not quite: a part that is coarse hides what another is worth, so nothing is taken over from
//! the trials of the step before.

/// A state of the climb, measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Height {
    /// Bytes of the frame.
    pub(crate) bytes: f64,
    /// Distortion, summed over what is looked at.
    pub(crate) distortion: f64,
}

/// Measures along a climb to `tops`, the last setting of each part. `measure` is asked once for each state.
pub(crate) fn climb<const N: usize, E>(
    tops: [usize; N],
    mut measure: impl FnMut([usize; N]) -> Result<Height, E>,
) -> Result<(), E> {
    let mut at = [0; N];
    let mut here = measure(at)?;
    while at != tops {
        let mut best: Option<(f64, usize, Height)> = None;
        for part in (0..N).filter(|&part| at[part] < tops[part]) {
            let mut next = at;
            next[part] += 1;
            let there = measure(next)?;
            let gain = (here.distortion - there.distortion) / (there.bytes - here.bytes).max(1.0);
            if best.is_none_or(|(most, ..)| gain > most) {
                best = Some((gain, part, there));
            }
        }
        let Some((_, part, there)) = best else { break };
        at[part] += 1;
        here = there;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Parts with rates that double and distortions that add up, as those of quantisers do.
    fn measured(weights: [f64; 3], at: [usize; 3]) -> Height {
        let bytes = at.iter().map(|&l| 100.0 * f64::from(1u32 << l)).sum();
        let distortion: f64 = at.iter().zip(weights).map(|(&l, w)| w / f64::from(1u32 << (2 * l))).sum();
        Height { bytes, distortion }
    }

    #[test]
    fn the_climb_keeps_near_the_best_settings_and_asks_for_few() {
        let weights = [100.0, 1.0, 10.0];
        let mut asked = Vec::new();
        climb([6; 3], |at| {
            asked.push(at);
            Ok::<_, ()>(measured(weights, at))
        })
        .unwrap();
        assert_eq!((asked[0], asked.last()), ([0; 3], Some(&[6; 3])));
        assert!(asked.len() <= 1 + 3 * 18, "{}", asked.len());
        let mut unique = asked.clone();
        unique.sort_unstable();
        unique.dedup();
        assert_eq!(unique.len(), asked.len());
        // For every state, one that was asked for is as good for at most half as much again: steps are powers of two.
        let all = (0..343).map(|i| [i % 7, i / 7 % 7, i / 49]);
        let worst = |points: &[[usize; 3]]| {
            let ratio = |at: [usize; 3]| {
                let wanted = measured(weights, at);
                let good = points.iter().map(|p| measured(weights, *p));
                let good = good.filter(|h| h.distortion <= wanted.distortion);
                good.map(|h| h.bytes).fold(f64::INFINITY, f64::min) / wanted.bytes
            };
            all.clone().map(ratio).fold(0.0, f64::max)
        };
        assert!(worst(&asked) <= 1.5, "{}", worst(&asked));
        let diagonal: Vec<_> = (0..7).map(|l| [l; 3]).collect();
        assert!(worst(&diagonal) > 1.5, "settings that rise together are not good enough");
    }

    #[test]
    fn one_setting_is_one_measurement_and_errors_end_the_climb() {
        let mut num = 0;
        climb([0; 3], |at| {
            num += 1;
            Ok::<_, ()>(measured([1.0; 3], at))
        })
        .unwrap();
        assert_eq!(num, 1);
        assert_eq!(
            climb([2, 1], |at| if at == [0, 0] { Ok(measured([1.0; 3], [0; 3])) } else { Err(5) }),
            Err(5)
        );
    }
}
