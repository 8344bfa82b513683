//! The choice of a volume among the arrays of a file.

/// An array that may be shown.
pub(crate) struct VolumeCandidate {
    /// Sizes along its axes in space.
    pub(crate) sizes: Vec<u64>,
    /// Whether it describes other arrays.
    pub(crate) is_auxiliary: bool,
}

impl VolumeCandidate {
    /// How many of its sides are longer than one.
    fn num_sides(&self) -> usize {
        self.sizes.iter().filter(|n| **n > 1).count()
    }

    fn num_voxels(&self) -> u64 {
        self.sizes.iter().fold(1, |n, side| n.saturating_mul(*side))
    }

    /// The places of those that can be shown. Planes are volumes only where there is nothing else.
    pub(crate) fn shown(list: &[Self]) -> Vec<usize> {
        let most = list.iter().map(Self::num_sides).max().unwrap_or(0);
        (0..list.len()).filter(|&i| most > 1 && list[i].num_sides() == most).collect()
    }

    /// The one of `shown` that is shown without a choice: the largest, or the first of several. What describes others
    /// comes last.
    pub(crate) fn usual(list: &[Self], shown: &[usize]) -> usize {
        let rank = |&n: &usize| (!list[shown[n]].is_auxiliary, list[shown[n]].num_voxels());
        (0..shown.len()).rev().max_by_key(rank).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_volume_is_shown_that_describes_no_other() {
        let choice = |sizes: &[u64], is_auxiliary| VolumeCandidate { sizes: sizes.to_vec(), is_auxiliary };
        let list = [
            choice(&[100, 100], false),
            choice(&[4, 5, 6], true),
            choice(&[3, 4, 5], false),
            choice(&[3, 4, 5], false),
            choice(&[1, 900, 900], false),
        ];
        let shown = VolumeCandidate::shown(&list);
        assert_eq!(shown, [1, 2, 3]);
        assert_eq!(VolumeCandidate::usual(&list, &shown), 1);
        // The control: alone, the one that describes others is shown.
        assert_eq!(VolumeCandidate::usual(&list, &[1]), 0);
        assert!(VolumeCandidate::shown(&[choice(&[7, 1], false)]).is_empty());
    }
}
