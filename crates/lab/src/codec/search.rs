//! The search for the settings of a codec whose parts are coded apart: a climb from the coarsest settings to the
//! finest.
//!
//! At each step every part is refined for trial, by one setting and by a few at once, and the refinement that lowers
//! the distortion most for a byte is kept. Where rates and distortions add up and refinements are worth ever less,
//! the states of the climb are the lower convex hull of all settings. They do not quite: a part that is coarse hides
//! what another is worth, so nothing is taken over from the trials of the step before; and a setting may be worth
//! less than both of its neighbours, as the coarsest step of a larger plane behind the finest of a smaller one, so
//! the climb looks beyond it.

use std::collections::HashMap;

/// A state of the climb, measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Height {
    pub(crate) bytes: f64,
    /// Distortion, summed over what is looked at.
    pub(crate) distortion: f64,
}

/// Measures along a climb to `tops`, the last setting of each part. `measure` is asked once for each state.
pub(crate) fn climb<const N: usize, E>(
    tops: [usize; N],
    mut measure: impl FnMut([usize; N]) -> Result<Height, E>,
) -> Result<(), E> {
    let mut known: HashMap<[usize; N], Height> = HashMap::new();
    let mut height = |at: [usize; N]| {
        if let Some(height) = known.get(&at) {
            return Ok(*height);
        }
        let height = measure(at)?;
        known.insert(at, height);
        Ok(height)
    };
    let mut at = [0; N];
    let mut here = height(at)?;
    while at != tops {
        let mut best: Option<(f64, [usize; N], Height)> = None;
        for part in 0..N {
            for rise in (1..=REACH).take_while(|rise| at[part] + rise <= tops[part]) {
                let mut next = at;
                next[part] += rise;
                let there = height(next)?;
                let gain = (here.distortion - there.distortion) / (there.bytes - here.bytes).max(1.0);
                if best.is_none_or(|(most, ..)| gain > most) {
                    best = Some((gain, next, there));
                }
            }
        }
        let Some((_, next, there)) = best else { break };
        at = next;
        here = there;
    }
    Ok(())
}

/// Settings that a part may rise by at once.
const REACH: usize = 6;

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
        assert!(asked.len() <= 1 + 3 * REACH * 18, "{}", asked.len());
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
    fn a_setting_that_is_worth_nothing_does_not_hide_those_behind_it() {
        // The third setting of the first part costs more than the second and is worse; the fourth is worth more than
        // all that the other part has.
        let first = [(100.0, 64.0), (200.0, 32.0), (300.0, 40.0), (400.0, 4.0)];
        let second = [(100.0, 8.0), (200.0, 7.0), (800.0, 6.5), (6400.0, 6.4)];
        let mut asked = Vec::new();
        climb([3, 3], |at: [usize; 2]| {
            asked.push(at);
            let (a, b) = (first[at[0]], second[at[1]]);
            Ok::<_, ()>(Height { bytes: a.0 + b.0, distortion: a.1 + b.1 })
        })
        .unwrap();
        let place = |at: [usize; 2]| asked.iter().position(|a| *a == at);
        assert!(place([3, 0]).is_some() || place([3, 1]).is_some(), "{asked:?}");
        assert!(place([2, 3]).is_none(), "a look of one setting ends there: {asked:?}");
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
