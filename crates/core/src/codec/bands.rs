//! Where the bands of a frame end: at rows of tiles or of blocks, so that each band takes about as long.

use std::ops::Range;

use super::error::CodecError;
use super::limits::MAX_CHUNKS;

/// Where all bands but the last end, in rows of tiles or of blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Borders {
    ends: [u16; MAX_CHUNKS - 1],
    num: u8,
}

impl Borders {
    /// Borders of `num_bands` bands with about the same work each, given the work of each row. There must be at least
    /// as many rows as bands.
    pub(super) fn sharing(work: &[usize], num_bands: u8) -> Self {
        let num = usize::from(num_bands).saturating_sub(1).min(MAX_CHUNKS - 1);
        let total: usize = work.iter().sum();
        let mut ends = [0; MAX_CHUNKS - 1];
        let (mut row, mut done) = (0, 0);
        for (n, end) in ends[..num].iter_mut().enumerate() {
            // This band and each later one get at least one row.
            let (least, most) = (row + 1, work.len().saturating_sub(num - n));
            let goal = total * (n + 1) / (num + 1);
            while row < least || (row < most && done + work[row] / 2 < goal) {
                done += work.get(row).copied().unwrap_or(0);
                row += 1;
            }
            *end = row as u16;
        }
        Self { ends, num: num as u8 }
    }

    /// Takes the borders of `num_bands` bands of `num_rows` rows from the front of `bytes`.
    pub(super) fn read(bytes: &mut &[u8], num_bands: u8, num_rows: usize) -> Result<Self, CodecError> {
        let damaged = |problem: String| CodecError::Payload { plane: "borders", problem };
        let num = usize::from(num_bands).saturating_sub(1).min(MAX_CHUNKS - 1);
        let Some((stated, rest)) = bytes.split_at_checked(2 * num) else {
            return Err(damaged(format!("{} bytes of borders, expected {}", bytes.len(), 2 * num)));
        };
        let mut ends = [0; MAX_CHUNKS - 1];
        let mut last = 0;
        for (end, stated) in ends.iter_mut().zip(stated.as_chunks::<2>().0) {
            *end = u16::from_le_bytes(*stated);
            if *end <= last || usize::from(*end) >= num_rows {
                let expected = format!("more than {last} and less than {num_rows}");
                return Err(damaged(format!("a band that ends at row {end}, expected {expected}")));
            }
            last = *end;
        }
        *bytes = rest;
        Ok(Self { ends, num: num as u8 })
    }

    /// Writes what [`Borders::read`] takes.
    pub(super) fn write(&self, out: &mut Vec<u8>) {
        self.ends().iter().for_each(|end| out.extend(end.to_le_bytes()));
    }

    /// The rows of a band in a frame of `num_rows` rows.
    pub(super) fn rows(&self, band: usize, num_rows: usize) -> Range<usize> {
        let end = |n: usize| self.ends().get(n).map_or(num_rows, |end| usize::from(*end));
        let first = band.checked_sub(1).map_or(0, end);
        first..end(band)
    }

    fn ends(&self) -> &[u16] {
        &self.ends[..usize::from(self.num)]
    }
}

/// Cuts the first `n` elements off a slice. So each band is written to its final place in a frame.
pub(super) fn split_off<'a, T>(slice: &mut &'a mut [T], n: usize) -> &'a mut [T] {
    let (head, tail) = std::mem::take(slice).split_at_mut(n);
    *slice = tail;
    head
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_share_the_work_and_have_every_row_once() {
        for work in [
            &[0, 0, 1, 9, 9, 8, 9, 7, 2, 0, 0, 0][..],
            &[8; 4],
            &[0, 0, 0, 0, 0, 9],
            &[9, 0, 0, 0, 0],
            &[0; 9],
        ] {
            let borders = Borders::sharing(work, 4);
            let rows = [0, 1, 2, 3].map(|band| borders.rows(band, work.len()));
            assert!(rows.iter().all(|rows| !rows.is_empty()), "{rows:?}");
            assert!(rows.iter().cloned().flatten().eq(0..work.len()), "{rows:?}");
            let mut bytes = vec![];
            borders.write(&mut bytes);
            assert_eq!(bytes.len(), 6);
            let mut rest = &[&bytes[..], &[77]].concat()[..];
            assert_eq!(Borders::read(&mut rest, 4, work.len()), Ok(borders));
            assert_eq!(rest, [77]);
        }
        // No band has more than its share and a row; four of equal height have.
        let work = [0, 0, 1, 9, 9, 8, 9, 7, 2, 0, 0, 0];
        let borders = Borders::sharing(&work, 4);
        let most = |rows: [Range<usize>; 4]| rows.map(|r| work[r].iter().sum::<usize>()).into_iter().max();
        assert!(most([0, 1, 2, 3].map(|b| borders.rows(b, 12))) <= Some(45 / 4 + 9));
        assert!(most([0..3, 3..6, 6..9, 9..12]) > Some(45 / 4 + 9));
        assert_eq!(Borders::sharing(&[8; 9], 1).rows(0, 9), 0..9);
    }

    #[test]
    fn borders_that_do_not_part_the_rows_are_refused() {
        let read = |ends: &[u16], num_bands, num_rows| {
            let bytes: Vec<u8> = ends.iter().flat_map(|end| end.to_le_bytes()).collect();
            Borders::read(&mut &bytes[..], num_bands, num_rows)
        };
        assert!(read(&[1, 2, 3], 4, 4).is_ok() && read(&[1, 2, 3, 4, 5, 6, 7], 8, 9).is_ok());
        assert!(read(&[], 1, 4).is_ok());
        for (ends, num_bands, num_rows) in [
            (&[0, 2, 3][..], 4, 4),
            (&[1, 1, 3], 4, 4),
            (&[2, 1, 3], 4, 4),
            (&[1, 2, 4], 4, 4),
            (&[1, 2, u16::MAX], 4, 1024),
            (&[1, 2], 4, 4),
            (&[], 2, 4),
        ] {
            assert!(read(ends, num_bands, num_rows).is_err(), "{ends:?}");
        }
    }
}
