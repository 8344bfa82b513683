//! The choice of a volume among the arrays of a file.

/// An array that may be shown.
pub(crate) struct VolumeCandidate {
    /// Sizes along its axes in space.
    pub(crate) sizes: Vec<u64>,
    pub(crate) standing: Standing,
}

/// Which array of a file is shown first: the largest of those that stand highest.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Standing {
    /// A mask, or an array that describes others.
    Aside,
    #[default]
    Usual,
    /// The file says that it is to be shown.
    First,
}

impl Standing {
    /// That of an array which describes others, or not.
    pub(crate) fn of(is_auxiliary: bool) -> Self {
        if is_auxiliary { Self::Aside } else { Self::Usual }
    }
}

impl VolumeCandidate {
    /// How many of its sides are longer than one.
    fn num_sides(&self) -> usize {
        self.sizes.iter().filter(|n| **n > 1).count()
    }

    fn num_voxels(&self) -> u64 {
        self.sizes.iter().fold(1, |n, side| n.saturating_mul(*side))
    }

    /// The places of those that can be shown. Planes are volumes only where there is nothing else, or where the file
    /// shows them first.
    pub(crate) fn shown(list: &[Self]) -> Vec<usize> {
        let most = list.iter().map(Self::num_sides).max().unwrap_or(0);
        let is_shown =
            |one: &Self| one.num_sides() > 1 && (one.num_sides() == most || one.standing == Standing::First);
        (0..list.len()).filter(|&i| is_shown(&list[i])).collect()
    }

    /// The one of `shown` that is shown without a choice: the largest, or the first of several. What stands higher goes
    /// before.
    pub(crate) fn usual(list: &[Self], shown: &[usize]) -> usize {
        let rank = |&n: &usize| (list[shown[n]].standing, list[shown[n]].num_voxels());
        (0..shown.len()).rev().max_by_key(rank).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_volume_is_shown_that_describes_no_other() {
        let choice = |sizes: &[u64], is_auxiliary| VolumeCandidate {
            sizes: sizes.to_vec(),
            standing: Standing::of(is_auxiliary),
        };
        let mut list = vec![
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
        // A plane that the file shows first.
        list[0].standing = Standing::First;
        let shown = VolumeCandidate::shown(&list);
        assert_eq!((&shown[..], VolumeCandidate::usual(&list, &shown)), (&[0, 1, 2, 3][..], 0));
    }
}
