//! Which voxels of a file have no value, as a rule that any part of it can follow.

use isinglass_core::volume::{Volume, Voxels};

use crate::padding::MissingNumbers;

/// What stands for no value in a channel.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct GapRule {
    /// Whether a float that is not finite does.
    pub(crate) has_gaps: bool,
    /// A number that marks missing floats.
    pub(crate) mark: Option<f32>,
    /// The stored numbers that are missing, or outside of what was measured.
    pub(crate) missing: MissingNumbers,
    /// Whether no voxel of the channel has a value. Then a part without any has zeros, as the whole has.
    pub(crate) is_empty: bool,
}

impl GapRule {
    /// Whether voxels of this type may be gaps, so that those beside a part count.
    pub(crate) fn may_find(&self, voxels: &Voxels) -> bool {
        let is_float = matches!(voxels, Voxels::F32(_));
        !self.missing.is_empty() || (is_float && (self.has_gaps || self.mark.is_some()))
    }

    /// A byte a voxel that is not 0 where there is no value; `None` if there is one everywhere.
    ///
    /// # Errors
    /// A voxel has no meaning and is no gap.
    pub(crate) fn gaps(&self, voxels: &Voxels) -> Result<Option<Vec<u8>>, String> {
        let gaps: Vec<u8> = match voxels {
            Voxels::U8(_) | Voxels::U16(_) if self.missing.is_empty() => return Ok(None),
            Voxels::U8(v) => v.iter().map(|&x| u8::from(self.missing.contains(x.into()))).collect(),
            Voxels::U16(v) => v.iter().map(|&x| u8::from(self.missing.contains(x.into()))).collect(),
            // Most files have no gaps, and not a number is not less.
            Voxels::F32(v)
                if self.mark.is_none()
                    && self.missing.is_empty()
                    && v.iter().all(|x| x.abs() <= Volume::MAX_MAGNITUDE) =>
            {
                return Ok(None);
            }
            Voxels::F32(v) => {
                let is_gap = |x: f32| {
                    let is_marked = (self.has_gaps && !x.is_finite()) || self.mark == Some(x);
                    is_marked || self.missing.contains(x)
                };
                v.iter().map(|&x| u8::from(is_gap(x))).collect()
            }
        };
        if let Voxels::F32(v) = voxels {
            let is_bad = |x: f32| x.is_nan() || x.abs() > Volume::MAX_MAGNITUDE;
            let count = v.iter().zip(&gaps).filter(|(x, gap)| **gap == 0 && is_bad(**x)).count();
            if count > 0 {
                let most = Volume::MAX_MAGNITUDE;
                return Err(format!(
                    "{count} voxels are NaN or infinite or too large, expected at most {most:e}"
                ));
            }
        }
        Ok(Some(gaps).filter(|gaps| gaps.iter().any(|gap| *gap != 0)))
    }

    /// Marks the gaps of a part of `dims` voxels, and fills them as a whole volume does: with the mean of the voxels
    /// beside them, or else with `elsewhere`. `None` if there are none.
    ///
    /// # Errors
    /// A voxel has no meaning and is no gap.
    pub(crate) fn apply(
        &self,
        voxels: &mut Voxels,
        dims: [u32; 3],
        elsewhere: f32,
    ) -> Result<Option<Vec<u8>>, String> {
        let Some(gaps) = self.gaps(voxels)? else { return Ok(None) };
        if self.is_empty
            && gaps.iter().all(|gap| *gap != 0)
            && let Voxels::F32(v) = voxels
        {
            v.fill(0.0);
            return Ok(None);
        }
        voxels.fill_gaps(&gaps, dims, elsewhere);
        Ok(Some(gaps))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_marked_and_filled_from_beside() {
        let missing = MissingNumbers { numbers: vec![7.0], ..MissingNumbers::default() };
        let rule = GapRule { has_gaps: true, mark: Some(-9999.0), missing, is_empty: false };
        let numbers = vec![f32::NAN, 1.0, 3.0, -9999.0, 7.0, f32::INFINITY];
        let mut voxels = Voxels::F32(numbers.clone());
        assert!(rule.may_find(&voxels));
        assert_eq!(rule.apply(&mut voxels, [6, 1, 1], -5.0), Ok(Some(vec![1, 0, 0, 1, 1, 1])));
        assert_eq!(voxels, Voxels::F32(vec![1.0, 1.0, 3.0, 3.0, -5.0, -5.0]));
        let mut bytes = Voxels::U8(vec![7, 8, 9]);
        assert_eq!(rule.apply(&mut bytes, [3, 1, 1], 0.0), Ok(Some(vec![1, 0, 0])));
        // Several numbers, and ends of those that are values.
        let missing =
            MissingNumbers { numbers: vec![7.0, 9.0], ranges: Vec::new(), valid: Some((2.0, 20.0)) };
        let rule = GapRule { missing, ..GapRule::default() };
        let mut words = Voxels::U16(vec![7, 1, 2, 9, 20, 21]);
        assert!(rule.may_find(&words));
        assert_eq!(rule.apply(&mut words, [6, 1, 1], 0.0), Ok(Some(vec![1, 1, 0, 1, 0, 1])));
        assert_eq!(words, Voxels::U16(vec![0, 2, 2, 11, 20, 20]));
        // A channel without any value has zeros; a part of another one has gaps.
        for is_empty in [true, false] {
            let rule = GapRule { has_gaps: true, is_empty, ..GapRule::default() };
            let mut nothing = Voxels::F32(vec![f32::NAN; 2]);
            let gaps = (!is_empty).then(|| vec![1, 1]);
            assert_eq!(rule.apply(&mut nothing, [2, 1, 1], 0.0), Ok(gaps));
            assert_eq!(nothing, Voxels::F32(vec![0.0; 2]));
        }
        // The controls: without a rule, numbers stay, and what is no number is refused.
        let none = GapRule::default();
        assert!(none.apply(&mut Voxels::F32(numbers), [6, 1, 1], 0.0).is_err());
        assert_eq!(none.apply(&mut Voxels::U8(vec![7, 8, 9]), [3, 1, 1], 0.0), Ok(None));
    }
}
