//! What the names of the files in a folder say about channels, times and slices. Microscopes number their files by
//! letters before numbers: `_t00_z000_ch00` (Leica), `_w1DAPI_s1_t1` (MetaMorph), `channel000_position000_time000_z000`
//! (Micro-Manager), `xy1c1z01t1` (Nikon), `T0001F001L01A01Z01C01` (Yokogawa), `r01c01f01p01-ch1sk1` (Operetta).

use std::collections::{BTreeMap, HashSet};

use super::name_fields::{NameColumn, NameTable};
use crate::error::quoted;

/// What a number in a name counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum NameMeaning {
    Slice,
    Channel,
    Time,
    /// Another place of the stage, another sample, another view.
    Place,
}

/// The names of a folder by what they count.
#[derive(Debug)]
pub(super) struct FileNames {
    /// For each file of the table its number in the folder, and what it has along slices, channels, times and places.
    rows: Vec<(usize, [usize; 3], Vec<usize>)>,
    /// Names of the channels.
    channels: Vec<String>,
    /// Names of the series, one for each place.
    series: Vec<(Vec<usize>, String)>,
    /// A word about what was assumed.
    pub(super) note: Option<String>,
}

/// The files of one series.
pub(super) struct NameGrid {
    /// Slices, channels and times.
    pub(super) sizes: [usize; 3],
    /// The number of the file in the folder, slices first, then channels, then times; `None` if there is no such file.
    pub(super) files: Vec<Option<usize>>,
    pub(super) channels: Vec<String>,
}

/// What is known of the files beside their names.
#[derive(Clone, Copy, Debug)]
pub(super) struct FileFacts {
    /// Whether each has several pages.
    pub(super) has_pages: bool,
    /// Whether a pixel has several colours, so that other channels would be too many.
    pub(super) has_colors: bool,
}

/// What a key counts. Longer words come from programs and people, single letters from microscopes.
fn counted(key: &str) -> Option<NameMeaning> {
    Some(match key {
        "z" | "zs" | "zpos" | "zplane" | "zslice" | "zstack" | "slice" | "slices" | "sl" | "plane"
        | "section" | "sec" | "layer" | "depth" => NameMeaning::Slice,
        "c" | "ch" | "chn" | "chan" | "channel" | "channels" | "w" | "wv" | "wave" | "wavelength"
        | "color" | "colour" | "filter" => NameMeaning::Channel,
        "t" | "tm" | "tp" | "time" | "times" | "timepoint" | "timepoints" | "frame" | "cycle" => {
            NameMeaning::Time
        }
        "s" | "xy" | "pos" | "position" | "positions" | "stage" | "series" | "p" | "f" | "field" | "fov"
        | "site" | "scene" | "m" | "view" | "angle" | "ang" | "well" | "tile" | "region" | "roi" | "r"
        | "row" | "col" | "column" | "cm" | "spc" | "ph" => NameMeaning::Place,
        _ => return None,
    })
}

/// A key in lower case, or the end of a longer word from its last capital on: `imgZ`.
fn short_key(word: &str) -> String {
    let lower = word.to_lowercase();
    if counted(&lower).is_some() {
        return lower;
    }
    let letters: Vec<(usize, char)> = word.char_indices().collect();
    let last = letters.windows(2).rfind(|pair| pair[0].1.is_lowercase() && pair[1].1.is_uppercase());
    let end = last.map(|pair| word[pair[1].0..].to_lowercase());
    end.filter(|end| counted(end).is_some()).unwrap_or(lower)
}

/// What a column counts by its key. Where letters and numbers follow each other, the last letter before the first number
/// is its key: `seqt1z1c1`.
fn counted_by(column: &NameColumn) -> (String, Option<NameMeaning>) {
    let key = short_key(&column.key);
    let is_first_of_many = column.is_joined && counted(&column.unit).is_some();
    if counted(&key).is_none() && is_first_of_many {
        let last = key.chars().next_back().map(String::from).unwrap_or_default();
        return (last.clone(), counted(&last));
    }
    let found = counted(&key);
    (key, found)
}

impl FileNames {
    /// What the names of all files say; `Err` with a word about the order of the files, if there is one, if they do
    /// not tell slices, channels or times apart.
    pub(super) fn of(names: &[String], facts: FileFacts) -> Result<Self, Option<String>> {
        let table = NameTable::of(names).ok_or(None)?;
        let mut choice = AxisChoice::by_keys(&table, facts);
        let varied: Vec<usize> =
            (0..table.columns.len()).filter(|&i| table.columns[i].values.len() > 1).collect();
        if let [only] = varied[..] {
            choice.check_alone(&table.columns[only], facts)?;
        }
        let is_told = choice.axes.iter().any(Option::is_some);
        choice.split(&table, &varied, facts)?;
        let found = choice.into_names(&table);
        // Without any letter that tells, only a full grid of words is believed.
        let is_full = || {
            let sizes = [0, 1, 2].map(|k| found.rows.iter().map(|row| row.1[k]).max().unwrap_or(0) + 1);
            sizes.iter().product::<usize>() == found.rows.len() && found.series.len() == 1
        };
        let has_words = found.channels.len() > 1 && found.channels.len() <= MOST_WORDS;
        let is_believed = is_told || (has_words && is_full());
        if !is_believed {
            return Err((varied.len() > 1).then(|| PLAIN_ORDER.to_owned()));
        }
        Ok(found)
    }

    /// The names of the series, and how many files each has.
    pub(super) fn series(&self) -> Vec<(String, usize)> {
        let count = |places: &Vec<usize>| self.rows.iter().filter(|row| row.2 == *places).count();
        self.series.iter().map(|(places, name)| (name.clone(), count(places))).collect()
    }

    /// The files of a series. Numbers that it leaves out are left out. `None` if it lacks more than half.
    pub(super) fn grid(&self, series: usize) -> Option<NameGrid> {
        let places = &self.series.get(series)?.0;
        let rows: Vec<_> = self.rows.iter().filter(|row| row.2 == *places).collect();
        let known = [0, 1, 2].map(|k| {
            let mut values: Vec<usize> = rows.iter().map(|row| row.1[k]).collect();
            values.sort_unstable();
            values.dedup();
            values
        });
        let sizes = known.each_ref().map(Vec::len);
        let count =
            sizes.iter().try_fold(1usize, |n, m| n.checked_mul(*m)).filter(|n| *n <= 2 * rows.len())?;
        let mut files = vec![None; count];
        for (file, at, _) in rows {
            let [z, c, t] = [0, 1, 2].map(|k| known[k].binary_search(&at[k]).unwrap_or(0));
            files[(t * sizes[1] + c) * sizes[0] + z] = Some(*file);
        }
        let channels = known[1].iter().filter_map(|&c| self.channels.get(c).cloned()).collect();
        Some(NameGrid { sizes, files, channels })
    }

    /// How many of the files have other names.
    pub(super) fn num_left_out(&self, num_files: usize) -> usize {
        num_files - self.rows.len()
    }
}

/// The columns that count slices, channels, times and places.
#[derive(Default)]
struct AxisChoice {
    axes: [Option<usize>; 3],
    places: Vec<usize>,
    notes: Vec<String>,
}

impl AxisChoice {
    /// The columns whose keys tell what they count.
    fn by_keys(table: &NameTable, facts: FileFacts) -> Self {
        let keys: Vec<_> = table.columns.iter().map(counted_by).collect();
        let has = |key: &str| keys.iter().any(|(k, _)| k == key);
        // Operetta: rows and columns of wells, fields, planes, channels, and times (sk).
        let is_operetta = ["r", "c", "f", "p", "ch"].iter().all(|key| has(key));
        let mut choice = Self::default();
        let mut lengths = [0; 3];
        for (i, (column, (key, found))) in table.columns.iter().zip(&keys).enumerate() {
            let counted = match &key[..] {
                "p" if is_operetta => Some(NameMeaning::Slice),
                "sk" if is_operetta => Some(NameMeaning::Time),
                "c" if is_operetta => None,
                _ => found.or((column.unit == "nm").then_some(NameMeaning::Channel)),
            };
            let is_few = column.values.len() <= MOST_CHANNELS && !facts.has_colors;
            let axis = match counted {
                Some(NameMeaning::Slice) => 0,
                Some(NameMeaning::Channel) if is_few => 1,
                Some(NameMeaning::Time) => 2,
                _ => continue,
            };
            // The longest word tells most.
            if column.is_number && column.values.len() > 1 && key.len() + 1 > lengths[axis] {
                (choice.axes[axis], lengths[axis]) = (Some(i), key.len() + 1);
            }
        }
        choice
    }

    /// Whether the only number that differs counts what its key says. One letter may be the end of any word.
    fn check_alone(&self, column: &NameColumn, facts: FileFacts) -> Result<(), Option<String>> {
        let is_sure = facts.has_pages || (column.is_number && column.is_whole);
        let is_slice = self.axes[0].is_some();
        let is_other = self.axes[1].is_some() || self.axes[2].is_some();
        if is_slice || (is_other && is_sure) { Ok(()) } else { Err(None) }
    }

    /// Chooses more columns until no two files are at the same place.
    fn split(&mut self, table: &NameTable, varied: &[usize], facts: FileFacts) -> Result<(), Option<String>> {
        while !self.is_unique(table) {
            let is_used = |i: &usize| self.axes.contains(&Some(*i)) || self.places.contains(i);
            let rest: Vec<usize> =
                varied.iter().copied().filter(|i| !is_used(i) && self.splits(table, *i)).collect();
            let is_place = |i: &usize| match counted_by(&table.columns[*i]).1 {
                Some(NameMeaning::Place) => true,
                Some(NameMeaning::Channel) => facts.has_colors,
                _ => false,
            };
            let is_told = self.axes.iter().any(Option::is_some);
            if let Some(place) = rest.iter().find(|i| is_told && is_place(i)) {
                self.places.push(*place);
                continue;
            }
            let is_channel = |i: &usize| may_be_channels(&table.columns[*i]) && !facts.has_colors;
            let channel = rest.iter().find(|i| is_channel(i)).filter(|_| self.axes[1].is_none());
            let number = self.best_number(table, &rest);
            let has_word = |i: usize| table.columns[i].is_joined && is_told && !facts.has_pages;
            let free = match (facts.has_pages, self.axes) {
                (false, [None, ..]) => Some(0),
                // A number behind a word, such as `mouse1`, is another sample.
                (_, [.., None]) if !number.is_some_and(has_word) => Some(2),
                _ => None,
            };
            match (channel, number.zip(free), rest.first()) {
                (Some(&i), ..) => self.assume(1, i, table),
                (_, Some((i, axis)), _) => self.assume(axis, i, table),
                (.., Some(&i)) => self.places.push(i),
                _ => return Err(Some(PLAIN_ORDER.to_owned())),
            }
        }
        Ok(())
    }

    /// The number that tells most files apart with the fewest values, or else the last, which counts fastest.
    fn best_number(&self, table: &NameTable, rest: &[usize]) -> Option<usize> {
        let numbers = || rest.iter().rev().copied().filter(|&i| table.columns[i].is_number);
        let is_enough = |i: &usize| {
            let mut seen = HashSet::new();
            let ranks = &table.columns[*i].ranks;
            (0..table.rows.len()).all(|row| seen.insert((self.place(table, row), ranks[row])))
        };
        numbers().filter(is_enough).min_by_key(|&i| table.columns[i].values.len()).or(numbers().next())
    }

    fn assume(&mut self, axis: usize, column: usize, table: &NameTable) {
        self.axes[axis] = Some(column);
        let values = &table.columns[column].values;
        let (first, last) = (&values[0], &values[values.len() - 1]);
        let what = ["slices", "channels", "times"][axis];
        let (first, last) = (quoted(first), quoted(last));
        self.notes.push(format!("{first} to {last} in the names were taken as {what}"));
    }

    /// Where a file is by the columns that were chosen.
    fn place(&self, table: &NameTable, row: usize) -> ([usize; 3], Vec<usize>) {
        let rank = |column: usize| table.columns[column].ranks[row];
        (self.axes.map(|column| column.map_or(0, rank)), self.places.iter().map(|&i| rank(i)).collect())
    }

    fn is_unique(&self, table: &NameTable) -> bool {
        let mut seen = HashSet::new();
        (0..table.rows.len()).all(|row| seen.insert(self.place(table, row)))
    }

    /// Whether files at the same place differ in this column.
    fn splits(&self, table: &NameTable, column: usize) -> bool {
        let mut known = BTreeMap::new();
        let ranks = &table.columns[column].ranks;
        (0..table.rows.len())
            .any(|row| *known.entry(self.place(table, row)).or_insert(ranks[row]) != ranks[row])
    }

    fn into_names(self, table: &NameTable) -> FileNames {
        let rows = table.rows.iter().enumerate().map(|(row, file)| {
            let (at, places) = self.place(table, row);
            (*file, at, places)
        });
        let rows: Vec<_> = rows.collect();
        let mut series = BTreeMap::new();
        for (row, (.., places)) in rows.iter().enumerate() {
            let words = self.places.iter().map(|&i| {
                let column = &table.columns[i];
                column.values[column.ranks[row]].clone()
            });
            series.entry(places.clone()).or_insert_with(|| words.collect::<Vec<_>>().join(" "));
        }
        let note = (!self.notes.is_empty()).then(|| self.notes.join("; "));
        let channels = self.axes[1].map_or(Vec::new(), |i| channel_names(table, i));
        FileNames { rows, channels, series: series.into_iter().collect(), note }
    }
}

/// Names of the channels that a column counts: the words beside its numbers, or else the numbers with their letters.
fn channel_names(table: &NameTable, channel: usize) -> Vec<String> {
    let column = &table.columns[channel];
    let labels: HashSet<&String> = column.labels.iter().filter(|label| !label.is_empty()).collect();
    if column.is_number && labels.len() == column.values.len() && column.unit.is_empty() {
        return column.labels.clone();
    }
    // A word in another field, if each channel has its own.
    let words = table.columns.iter().filter(|c| c.values.len() == column.values.len() && may_be_channels(c));
    for other in words.filter(|_| column.is_number) {
        let mut known = vec![None; column.values.len()];
        let pairs = column.ranks.iter().zip(&other.ranks);
        let is_own = pairs.into_iter().all(|(&a, &b)| *known[a].get_or_insert(b) == b);
        if is_own {
            return known.into_iter().flatten().map(|b: usize| other.values[b].clone()).collect();
        }
    }
    column.values.clone()
}

/// Whether a column has words, or numbers of dyes and lasers, which do not count: `DAPI`, `Cy3`, `488nm`.
fn may_be_channels(column: &NameColumn) -> bool {
    let counts = column.numbers.windows(2).all(|pair| pair[1] == pair[0] + 1);
    let is_dye = column.unit == "nm" || (column.is_joined && counted_by(column).1.is_none() && !counts);
    (2..=MOST_DYES).contains(&column.values.len()) && (!column.is_number || is_dye)
}

/// The word about names that do not tell what they count.
const PLAIN_ORDER: &str = "the names differ in several numbers, and no letters tell which count slices; all files are slices in their order";
/// Most channels that names count.
const MOST_CHANNELS: usize = 64;
/// Most channels that words name.
const MOST_DYES: usize = 16;
/// The same where no letter tells anything.
const MOST_WORDS: usize = 8;
