//! What processes send each other about the pixels of a picture, row by row, in words of 32 bits.
//!
//! A row begins with the first column that has anything and the one behind the last, 16 bits each. Then each column
//! between them has its number of items, two in a word. The items follow, all of one size.

use rayon::prelude::*;

/// Why what a process sent is not about the expected rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PartsError {
    /// Too many or too few processes sent something.
    #[error("{found} processes sent their part of a picture, expected {expected}")]
    Processes {
        /// Number of processes that sent something.
        found: usize,
        /// Number of parts.
        expected: usize,
    },
    /// A row names columns that the picture does not have.
    #[error("process {rank} sent columns {first} to {end}, expected at most {width}")]
    Columns {
        /// The sender.
        rank: usize,
        /// The first column.
        first: u32,
        /// The column behind the last.
        end: u32,
        /// Columns of the picture.
        width: u32,
    },
    /// There are fewer or more words than the rows need.
    #[error("process {rank} sent {found} words, expected {expected}")]
    Words {
        /// The sender.
        rank: usize,
        /// Number of words sent.
        found: usize,
        /// Number of words that its rows need.
        expected: usize,
    },
    /// A process sent something else than the cells of the light that its part touches.
    #[error("a process sent other cells of the light than those of its part")]
    Cells,
    /// A list of a frame ends before it begins.
    #[error("process {rank} sent lists of row {row} whose ends are in no order")]
    Lists {
        /// The sender.
        rank: usize,
        /// The row.
        row: u32,
    },
    /// A process sent something about a pixel that its part does not show.
    #[error("process {rank} sent {found} items in row {row}, and {expected} of them lie in its part")]
    Stray {
        /// The sender.
        rank: usize,
        /// The row.
        row: u32,
        /// Items sent.
        found: usize,
        /// Items where its part is.
        expected: usize,
    },
}

/// The rows of a picture that a process unites: blocks of [`ROWS_IN_BLOCK`] rows, dealt in turn.
pub fn rows_of(rank: usize, num_ranks: usize, height: u32) -> Vec<u32> {
    (0..height).filter(|row| (row / ROWS_IN_BLOCK) as usize % num_ranks.max(1) == rank).collect()
}

/// Writes the items of each pixel of `rows`. `fill(x, y, items)` adds those of a pixel and returns their number.
pub(super) fn write(
    rows: &[u32],
    width: u32,
    fill: impl Fn(u32, u32, &mut Vec<u32>) -> usize + Sync,
) -> Vec<u32> {
    let row = |&y: &u32| {
        let (mut items, mut counts) = (Vec::new(), Vec::with_capacity(width as usize));
        counts.extend((0..width).map(|x| fill(x, y, &mut items) as u32));
        let first = counts.iter().take_while(|count| **count == 0).count();
        let empty = counts.iter().rev().take_while(|count| **count == 0).count();
        let (first, end) = if first == counts.len() { (0, 0) } else { (first, counts.len() - empty) };
        let mut words = vec![first as u32 | (end as u32) << 16];
        words.extend(counts[first..end].chunks(2).map(|two| two[0] | two.get(1).unwrap_or(&0) << 16));
        words.append(&mut items);
        words
    };
    let rows: Vec<Vec<u32>> = rows.par_iter().map(row).collect();
    rows.concat()
}

/// The items of a row that one process sent.
#[derive(Clone, Copy, Debug)]
pub(super) struct RowItems<'a> {
    first: u32,
    end: u32,
    counts: &'a [u32],
    items: &'a [u32],
    words_per_item: usize,
}

impl<'a> RowItems<'a> {
    /// Number of items in the row.
    pub(super) fn num_items(&self) -> usize {
        self.items.len() / self.words_per_item
    }

    /// The items of each column from 0 on. It must be asked for one column after the other.
    pub(super) fn columns(&self) -> impl FnMut(u32) -> &'a [u32] + use<'a> {
        let Self { first, end, counts, items, words_per_item } = *self;
        let mut rest = items;
        move |x| {
            if !(first..end).contains(&x) {
                return &[];
            }
            let (here, behind) = rest.split_at(count(counts, x - first) * words_per_item);
            rest = behind;
            here
        }
    }
}

fn count(counts: &[u32], column: u32) -> usize {
    (counts[column as usize / 2] >> (16 * (column % 2)) & 0xffff) as usize
}

/// Reads what the process `rank` wrote about `num_rows` rows of a picture.
///
/// # Errors
/// If these are not the words of so many rows.
pub(super) fn read(
    words: &[u32],
    rank: usize,
    num_rows: usize,
    width: u32,
    words_per_item: usize,
) -> Result<Vec<RowItems<'_>>, PartsError> {
    let mut at = 0;
    let mut take = |num: usize| {
        let taken = words.get(at..at + num);
        at += num;
        taken.ok_or(PartsError::Words { rank, found: words.len(), expected: at })
    };
    let mut rows = Vec::with_capacity(num_rows);
    for _ in 0..num_rows {
        let span = take(1)?[0];
        let (first, end) = (span & 0xffff, span >> 16);
        if first > end || end > width {
            return Err(PartsError::Columns { rank, first, end, width });
        }
        let counts = take((end - first).div_ceil(2) as usize)?;
        let num_items: usize = (0..end - first).map(|column| count(counts, column)).sum();
        let items = take(num_items * words_per_item)?;
        rows.push(RowItems { first, end, counts, items, words_per_item });
    }
    if at == words.len() {
        Ok(rows)
    } else {
        Err(PartsError::Words { rank, found: words.len(), expected: at })
    }
}

/// Reads what all processes wrote, each in its place.
///
/// # Errors
/// If one did not write so many rows, or the number of processes is wrong.
pub(super) fn read_all<'a>(
    lists: &'a [Vec<u32>],
    num_ranks: usize,
    num_rows: usize,
    width: u32,
    words_per_item: usize,
) -> Result<Vec<Vec<RowItems<'a>>>, PartsError> {
    if lists.len() != num_ranks {
        return Err(PartsError::Processes { found: lists.len(), expected: num_ranks });
    }
    let each = lists.iter().enumerate();
    each.map(|(rank, words)| read(words, rank, num_rows, width, words_per_item)).collect()
}

/// Rows in a block of those that a process unites.
pub const ROWS_IN_BLOCK: u32 = 8;
/// Most items of a pixel.
pub(super) const MAX_ITEMS: usize = 0xffff;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_dealt_in_blocks_and_each_has_one_owner() {
        assert_eq!(rows_of(1, 2, 20), [8, 9, 10, 11, 12, 13, 14, 15]);
        let mut all: Vec<u32> = (0..3).flat_map(|rank| rows_of(rank, 3, 77)).collect();
        all.sort_unstable();
        assert!(all.into_iter().eq(0..77));
    }

    #[test]
    fn items_are_read_where_they_were_written_and_wrong_words_are_errors() {
        // Item x·100 + y, as often as the pixel says.
        let num = |x: u32, y: u32| {
            if (3..8).contains(&x) && y != 2 { (x as usize * 7 + y as usize) % 4 } else { 0 }
        };
        let fill = |x: u32, y: u32, items: &mut Vec<u32>| {
            items.extend((0..num(x, y) * 2).map(|_| x * 100 + y));
            num(x, y)
        };
        let rows = [1, 2, 5, 6];
        let words = write(&rows, 11, fill);
        let found = read(&words, 0, 4, 11, 2).unwrap();
        for (row, y) in found.iter().zip(rows) {
            let mut at = row.columns();
            for x in 0..11 {
                assert_eq!(at(x), vec![x * 100 + y; num(x, y) * 2]);
            }
        }
        let error = |words: &[u32], rows, width| read(words, 3, rows, width, 2).unwrap_err().to_string();
        let short = error(&words[..words.len() - 1], 4, 11);
        assert_eq!(short, format!("process 3 sent {} words, expected {}", words.len() - 1, words.len()));
        assert!(error(&words, 3, 11).contains("expected"), "a row too many");
        assert!(error(&words, 5, 11).contains("words, expected"), "a row too few");
        assert!(error(&words, 4, 5).contains("columns"), "{}", error(&words, 4, 5));
        // No word may lead outside.
        for i in 0..words.len() {
            let mut wrong = words.clone();
            wrong[i] ^= 0xffff_ffff;
            let _ = read(&wrong, 0, 4, 11, 2);
        }
        assert_eq!(
            read_all(&[words], 2, 4, 11, 2).unwrap_err(),
            PartsError::Processes { found: 1, expected: 2 }
        );
    }
}
