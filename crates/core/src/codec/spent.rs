//! What the bytes of a chunk are for.

/// What a chunk spends its bytes on.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Spent {
    /// Headers and planes: names and bytes, in the order of the stream; the sum is the chunk's length.
    pub parts: Vec<(&'static str, usize)>,
    /// Lists along the side of a tile.
    pub tile_side: usize,
    /// The tiles by what they are. Headers, tables and corrections belong to none.
    pub tiles: Vec<TileClass>,
}

/// Tiles of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TileClass {
    /// What they are.
    pub name: &'static str,
    /// How many there are. A refinement has none of its own: they are those of its base.
    pub num: usize,
    /// Bytes of all of them.
    pub bytes: usize,
}

/// Whole bytes for shares of `total`, none of which is negative, as near as they get with this sum.
pub(super) fn whole_bytes<const N: usize>(total: usize, shares: [f64; N]) -> [usize; N] {
    let sum: f64 = shares.iter().sum();
    let per_share = if sum > 0.0 { total as f64 / sum } else { 0.0 };
    let (mut before, mut exact) = (0, 0.0);
    let mut bytes = shares.map(|share| {
        exact += share * per_share;
        let until = (exact.round() as usize).min(total);
        let own = until - before;
        before = until;
        own
    });
    if let Some(last) = bytes.last_mut() {
        *last += total - before;
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_become_whole_bytes_of_the_same_sum() {
        assert_eq!(whole_bytes(10, [1.0, 1.0, 2.0]), [3, 2, 5]);
        assert_eq!(whole_bytes(7, [0.0, 5.0, 0.0]), [0, 7, 0]);
        assert_eq!(whole_bytes(7, [0.0; 3]), [0, 0, 7]);
        assert_eq!(whole_bytes(0, [3.0, 4.0]), [0, 0]);
    }
}
