//! The names of files in a folder, as columns: the numbers and words in which they differ.

use std::collections::{BTreeMap, HashMap};

/// A number or a word at the same place of all names.
pub(super) struct NameColumn {
    /// Letters before the number, or the word of the field before it. Of a word, there are none.
    pub(super) key: String,
    /// Whether the key is in the same field.
    pub(super) is_joined: bool,
    /// Letters behind the number, if all names have the same.
    pub(super) unit: String,
    pub(super) is_number: bool,
    /// Whether the field is no more than the key and the number.
    pub(super) is_whole: bool,
    /// For each name, which of the values it has.
    pub(super) ranks: Vec<usize>,
    /// The different values as names have them, in order.
    pub(super) values: Vec<String>,
    /// The different values as numbers; empty if they are none or too large.
    pub(super) numbers: Vec<u64>,
    /// What follows the number of each value within its field, if it is the same for all names with that value.
    pub(super) labels: Vec<String>,
}

/// The columns of names.
pub(super) struct NameTable {
    /// The names that have these columns.
    pub(super) rows: Vec<usize>,
    pub(super) columns: Vec<NameColumn>,
}

/// A run of digits or of other letters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Run<'a> {
    Digits(&'a str),
    Word(&'a str),
}

impl NameTable {
    /// The columns of most of the `names`. `None` if fewer than three of four are alike.
    pub(super) fn of(names: &[String]) -> Option<Self> {
        let all: Vec<Vec<Vec<Run>>> = names.iter().map(|name| fields(name).map(runs).collect()).collect();
        let is_thumb = |row: &Vec<Vec<Run>>| {
            row.iter().flatten().any(|run| matches!(run, Run::Word(w) if w.eq_ignore_ascii_case("thumb")))
        };
        let mut rows: Vec<usize> = (0..names.len()).collect();
        if !all.iter().all(is_thumb) {
            rows.retain(|&i| !is_thumb(&all[i]));
        }
        let num_names = rows.len();
        let most = most_frequent(rows.iter().map(|&i| all[i].len()))?;
        rows.retain(|&i| all[i].len() == most.0);
        if rows.len() * 4 < num_names * 3 {
            return None;
        }
        // A few of other words, such as an overview, are no part of the table. Many are channels.
        let skeletons: Vec<String> = all.iter().map(|row| skeleton(row)).collect();
        let usual = most_frequent(rows.iter().map(|&i| &skeletons[i][..]))?;
        if usual.1 * 4 >= num_names * 3 {
            rows.retain(|&i| skeletons[i] == usual.0);
        }
        let mut columns = Vec::new();
        for at in 0..most.0 {
            let field: Vec<&[Run]> = rows.iter().map(|&i| &all[i][at][..]).collect();
            let before =
                at.checked_sub(1).map(|at| rows.iter().map(|&i| &all[i][at][..]).collect::<Vec<_>>());
            let before = before.as_deref().and_then(word_of_all);
            columns.extend(columns_of(&field, before));
        }
        Some(Self { rows, columns })
    }
}

/// The most frequent value and how often it occurs; the greatest of several.
fn most_frequent<T: Ord>(values: impl Iterator<Item = T>) -> Option<(T, usize)> {
    let mut counts = BTreeMap::new();
    values.for_each(|value| *counts.entry(value).or_insert(0) += 1);
    counts.into_iter().max_by_key(|(_, count)| *count)
}

/// The parts of a name between what are neither letters nor digits, without the ends of TIFF files.
fn fields(name: &str) -> impl Iterator<Item = &str> {
    let mut stem = name;
    for end in [".tif", ".tiff", ".ome"] {
        if let Some(cut) = stem.len().checked_sub(end.len()).and_then(|at| stem.split_at_checked(at))
            && cut.1.eq_ignore_ascii_case(end)
        {
            stem = cut.0;
        }
    }
    stem.split(|c: char| !c.is_alphanumeric()).filter(|field| !field.is_empty())
}

fn runs(mut field: &str) -> Vec<Run<'_>> {
    let mut runs = Vec::new();
    while let Some(first) = field.chars().next() {
        let is_digit = first.is_ascii_digit();
        let end = field.find(|c: char| c.is_ascii_digit() != is_digit).unwrap_or(field.len());
        let (run, rest) = field.split_at(end);
        runs.push(if is_digit { Run::Digits(run) } else { Run::Word(run) });
        field = rest;
    }
    runs
}

/// A name without its numbers, in lower case.
fn skeleton(row: &[Vec<Run>]) -> String {
    let field = |runs: &Vec<Run>| runs.iter().map(word_or_mark).collect::<String>();
    row.iter().map(field).collect::<Vec<_>>().join("_")
}

fn word_or_mark(run: &Run) -> String {
    match run {
        Run::Digits(_) => "#".into(),
        Run::Word(word) => word.to_lowercase(),
    }
}

/// The word that a field is in all names.
fn word_of_all<'a>(field: &[&[Run<'a>]]) -> Option<&'a str> {
    let [Run::Word(word)] = field.first()? else { return None };
    field.iter().all(|runs| matches!(runs, [Run::Word(w)] if w.eq_ignore_ascii_case(word))).then_some(*word)
}

/// The columns of a field, one for each of its numbers, or one of words. `before` is the word in front of it.
fn columns_of(field: &[&[Run]], before: Option<&str>) -> Vec<NameColumn> {
    let Some(first) = field.first() else { return Vec::new() };
    let shape = |runs: &[Run]| runs.iter().map(word_or_mark).collect::<String>();
    let usual = shape(first);
    if field.iter().all(|runs| shape(runs) == usual) {
        let numbers = (0..first.len()).filter(|&i| matches!(first[i], Run::Digits(_)));
        let column = |i: usize| {
            let word = |i: usize| match first.get(i) {
                Some(Run::Word(word)) => Some(*word),
                _ => None,
            };
            let joined = i.checked_sub(1).and_then(word);
            let is_whole = first.len() - i == 1 && i <= 1;
            NameColumn {
                key: joined.or(before.filter(|_| i == 0)).unwrap_or_default().to_owned(),
                is_whole,
                ..numbers_at(field, i, joined, word(i + 1))
            }
        };
        return numbers.map(column).collect();
    }
    // A number behind the same letters, and then a word of its own: `w1DAPI`, `w2Cy5`.
    if let [Run::Word(key), Run::Digits(_), ..] = first
        && field
            .iter()
            .all(|runs| matches!(runs, [Run::Word(w), Run::Digits(_), ..] if w.eq_ignore_ascii_case(key)))
    {
        return vec![numbers_at(field, 1, Some(key), None)];
    }
    let words: Vec<String> = field.iter().map(|runs| written(runs)).collect();
    let mut values: Vec<String> = words.clone();
    values.sort_by_key(|word| (word.to_lowercase(), word.clone()));
    values.dedup();
    let rank = |word: &String| values.iter().position(|value| value == word).unwrap_or(0);
    let ranks = words.iter().map(rank).collect();
    let labels = vec![String::new(); values.len()];
    let (key, unit, numbers) = (String::new(), String::new(), Vec::new());
    let (is_joined, is_number, is_whole) = (false, false, true);
    vec![NameColumn { key, is_joined, unit, is_number, is_whole, ranks, values, numbers, labels }]
}

fn written(runs: &[Run]) -> String {
    runs.iter()
        .map(|run| match run {
            Run::Digits(text) | Run::Word(text) => *text,
        })
        .collect()
}

/// The column of the numbers at run `at` of a field, behind these letters and before that unit.
fn numbers_at(field: &[&[Run]], at: usize, key: Option<&str>, unit: Option<&str>) -> NameColumn {
    // Numbers of any length, by their digits without zeros in front.
    let digits = |runs: &[Run]| match runs.get(at) {
        Some(Run::Digits(digits)) => digits.to_string(),
        _ => String::new(),
    };
    let order = |digits: &str| {
        let digits = digits.trim_start_matches('0').to_owned();
        (digits.len(), digits)
    };
    let all: Vec<String> = field.iter().map(|runs| digits(runs)).collect();
    let mut sorted: BTreeMap<(usize, String), &str> = BTreeMap::new();
    for digits in &all {
        sorted.entry(order(digits)).or_insert(digits);
    }
    let places: HashMap<&(usize, String), usize> =
        sorted.keys().enumerate().map(|(i, key)| (key, i)).collect();
    let ranks: Vec<usize> =
        all.iter().map(|digits| places.get(&order(digits)).copied().unwrap_or(0)).collect();
    let numbers: Option<Vec<u64>> = sorted
        .keys()
        .map(|(_, digits)| if digits.is_empty() { Some(0) } else { digits.parse().ok() })
        .collect();
    let mut labels: Vec<Option<String>> = vec![None; sorted.len()];
    let mut is_told = true;
    for (runs, rank) in field.iter().zip(&ranks) {
        let label = written(&runs[at + 1..]);
        is_told &= labels[*rank].get_or_insert_with(|| label.clone()) == &label;
    }
    let labels = labels.into_iter().map(|label| label.filter(|_| is_told).unwrap_or_default()).collect();
    // Letters before another number belong to that.
    let end = unit.filter(|_| field.iter().all(|runs| runs.len() == at + 2)).unwrap_or_default();
    let value = |digits: &&str| format!("{}{digits}{end}", key.unwrap_or_default());
    NameColumn {
        key: key.unwrap_or_default().to_owned(),
        unit: unit.unwrap_or_default().to_lowercase(),
        is_joined: key.is_some(),
        is_number: true,
        is_whole: false,
        ranks,
        values: sorted.values().map(value).collect(),
        numbers: numbers.unwrap_or_default(),
        labels,
    }
}
