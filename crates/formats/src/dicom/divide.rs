//! Divides series with several slices at each position into volumes.

use std::collections::BTreeMap;

use super::frame::Frame;
use super::keys::Key;
use crate::error::quoted;
use crate::warning::WarningKind;

/// The frames of a series, in the order of their volumes.
pub(super) struct Divided {
    /// Sorted by time, then along the normal.
    pub(super) frames: Vec<Frame>,
    pub(super) num_slices: usize,
    pub(super) num_times: usize,
    pub(super) warnings: Vec<(WarningKind, String)>,
}

/// Separates kinds of pictures at the same positions, such as magnitude and phase, or echoes. Each kind has a
/// description. `places` are the numbers of the frames' positions. Without several kinds, the result is one kind
/// without a description.
pub(super) fn by_kind(frames: Vec<Frame>, places: &[usize]) -> Vec<(Option<String>, Vec<Frame>)> {
    let types: Vec<&str> = frames.iter().map(|f| f.keys.image_type.as_deref().unwrap_or_default()).collect();
    if let Some((kinds, of)) = kinds(&types, places) {
        // The kind that was taken first comes first. Mostly it is the magnitude.
        let mut first = vec![f64::INFINITY; kinds.len()];
        for (frame, kind) in frames.iter().zip(&of) {
            first[*kind] = first[*kind].min(frame.order[2]);
        }
        let words = own_words(&kinds);
        let mut order: Vec<usize> = (0..kinds.len()).collect();
        order.sort_by(|a, b| first[*a].total_cmp(&first[*b]));
        return split(frames, &of, &order, &words);
    }
    for (key, unit) in [(Key::EchoNumber, ""), (Key::EchoTime, " ms")] {
        let echoes: Vec<Ordered> = frames.iter().map(|f| Ordered(f.keys.number(key))).collect();
        if let Some((kinds, of)) = kinds(&echoes, places) {
            let word = |x: &Ordered| {
                if x.0.is_finite() { format!("echo {}{unit}", x.0) } else { "no echo".to_owned() }
            };
            let words: Vec<String> = kinds.iter().map(word).collect();
            let order: Vec<usize> = (0..kinds.len()).collect();
            return split(frames, &of, &order, &words);
        }
    }
    vec![(None, frames)]
}

/// A float with a total order.
#[derive(Clone, Copy, PartialEq)]
struct Ordered(f64);

impl Eq for Ordered {}

impl Ord for Ordered {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}

impl PartialOrd for Ordered {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

/// The different values, and the index of each frame's value. Returns `None` unless some value shares at least half
/// of its positions with others. Values that only change along the stack are not kinds.
fn kinds<V: Ord + Clone>(values: &[V], places: &[usize]) -> Option<(Vec<V>, Vec<usize>)> {
    let mut all = values.to_vec();
    all.sort();
    all.dedup();
    if all.len() < 2 {
        return None;
    }
    let of: Vec<usize> = values.iter().map(|v| all.partition_point(|a| a < v)).collect();
    let mut taken: Vec<(usize, usize)> = places.iter().copied().zip(of.iter().copied()).collect();
    taken.sort_unstable();
    taken.dedup();
    // For each value: its positions, and those that it shares.
    let mut counts = vec![(0, 0); all.len()];
    for place in taken.chunk_by(|a, b| a.0 == b.0) {
        for (_, kind) in place {
            counts[*kind].0 += 1;
            counts[*kind].1 += usize::from(place.len() > 1);
        }
    }
    counts.iter().any(|(num, shared)| 2 * shared >= *num).then_some((all, of))
}

/// The frames of each kind in this order, with its description.
fn split(
    frames: Vec<Frame>,
    of: &[usize],
    order: &[usize],
    words: &[String],
) -> Vec<(Option<String>, Vec<Frame>)> {
    let mut parts: BTreeMap<usize, Vec<Frame>> = BTreeMap::new();
    for (frame, kind) in frames.into_iter().zip(of) {
        parts.entry(*kind).or_default().push(frame);
    }
    order.iter().filter_map(|k| Some((Some(words[*k].clone()), parts.remove(k)?))).collect()
}

/// The words of each type of picture that not all types have.
fn own_words(types: &[&str]) -> Vec<String> {
    let words = |t: &str| -> Vec<String> { t.split('\\').map(|w| w.trim().to_owned()).collect() };
    let all: Vec<Vec<String>> = types.iter().map(|t| words(t)).collect();
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for list in &all {
        let mut once: Vec<&str> = list.iter().map(String::as_str).collect();
        once.sort_unstable();
        once.dedup();
        once.into_iter().for_each(|w| *counts.entry(w).or_default() += 1);
    }
    let own = |list: &Vec<String>| {
        let own: Vec<&str> = list.iter().map(String::as_str).filter(|w| counts[w] < all.len()).collect();
        quoted(&if own.is_empty() { list.join(" ") } else { own.join(" ") })
    };
    all.iter().map(own).collect()
}

/// Divides frames of one kind into points in time, with one slice at each position. `frames` are sorted by position,
/// then by their order. `places` count from 0 without gaps.
pub(super) fn into_times(frames: &[Frame], places: &[usize]) -> Divided {
    let slices = PlacedFrames { frames, places, num_places: places.last().map_or(0, |p| p + 1) };
    let num_places = slices.num_places;
    let made = |list: Vec<usize>, warnings| Divided {
        num_slices: num_places,
        num_times: list.len() / num_places.max(1),
        frames: list.into_iter().map(|i| frames[i].clone()).collect(),
        warnings,
    };
    if num_places == frames.len() {
        return made((0..num_places).collect(), Vec::new());
    }
    if let Some((list, key)) = slices.divided() {
        let warnings = slices.b_values(&list, key);
        return made(list, warnings);
    }
    let counts: Vec<usize> = places.chunk_by(|a, b| a == b).map(<[usize]>::len).collect();
    let (least, most) =
        (counts.iter().min().copied().unwrap_or(0), counts.iter().max().copied().unwrap_or(0));
    let by_number = slices.by_order(&counts, least);
    if least == most {
        let text = format!(
            "nothing but their numbers tells which of the {least} slices in each place belong together; they are taken as points in time in that order"
        );
        return made(by_number, vec![(WarningKind::Guess, text)]);
    }
    if let Some((list, num_lacking)) = slices.interrupted() {
        let text = format!("{num_lacking} points in time lack slices and were left out");
        return made(list, vec![(WarningKind::Data, text)]);
    }
    let num_extra = frames.len() - by_number.len();
    let text = format!(
        "nothing divides the slices into whole volumes, there are {least} to {most} in a place; {num_extra} that lie where others do were left out"
    );
    made(by_number, vec![(WarningKind::Data, text)])
}

/// Frames with the numbers of their positions.
struct PlacedFrames<'a> {
    frames: &'a [Frame],
    places: &'a [usize],
    num_places: usize,
}

impl PlacedFrames<'_> {
    /// The frames of complete volumes in order, and the key that distinguishes these. Equal numbers are best.
    /// Otherwise, the order of the numbers at each position counts, because each slice may have its own time.
    fn divided(&self) -> Option<(Vec<usize>, Key)> {
        let keys: Vec<Key> = Key::TIMES.into_iter().filter(|k| self.differ(*k)).collect();
        let pairs =
            keys.iter().enumerate().flat_map(|(i, a)| keys[i + 1..].iter().map(move |b| (*a, Some(*b))));
        let exact = keys.iter().map(|k| (*k, None)).chain(pairs);
        let exact = exact.filter_map(|(a, b)| Some((self.exact(a, b)?, a))).next();
        exact.or_else(|| keys.iter().find_map(|k| Some((self.ranked(*k)?, *k))))
    }

    fn number(&self, i: usize, key: Key) -> f64 {
        self.frames[i].keys.number(key)
    }

    /// Whether slices differ by this key.
    fn differ(&self, key: Key) -> bool {
        (1..self.frames.len()).any(|i| self.number(i, key) != self.number(0, key))
    }

    /// The frames, sorted by these numbers, then by position.
    fn sorted(&self, key: Key, second: Option<Key>) -> Vec<([f64; 2], usize)> {
        let values =
            |i: usize| [self.number(i, key), second.map_or(f64::NEG_INFINITY, |k| self.number(i, k))];
        let mut list: Vec<_> = (0..self.frames.len()).map(|i| (values(i), i)).collect();
        // Frames are already sorted by position.
        list.sort_by(|(a, i), (b, j)| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])).then(i.cmp(j)));
        list
    }

    /// Volumes whose slices have equal numbers, if each contains every position once.
    fn exact(&self, key: Key, second: Option<Key>) -> Option<Vec<usize>> {
        let list = self.sorted(key, second);
        let is_volume =
            |part: &[([f64; 2], usize)]| self.is_whole(part) && part.iter().all(|x| x.0 == part[0].0);
        list.chunks(self.num_places).all(is_volume).then(|| list.into_iter().map(|x| x.1).collect())
    }

    /// Whether each position occurs once.
    fn is_whole(&self, part: &[([f64; 2], usize)]) -> bool {
        part.len() == self.num_places && part.iter().enumerate().all(|(place, x)| self.places[x.1] == place)
    }

    /// Volumes of the first, second, … slice at each position. The numbers must differ, and each position must have
    /// the same count.
    fn ranked(&self, key: Key) -> Option<Vec<usize>> {
        let num_times = self.frames.len() / self.num_places;
        let mut list: Vec<usize> = (0..self.frames.len()).collect();
        list.sort_by(|&i, &j| {
            self.places[i].cmp(&self.places[j]).then(self.number(i, key).total_cmp(&self.number(j, key)))
        });
        let is_good = |(place, part): (usize, &[usize])| {
            part.len() == num_times
                && part.iter().all(|&i| self.places[i] == place)
                && part.windows(2).all(|w| self.number(w[0], key) < self.number(w[1], key))
        };
        let is_even = num_times * self.num_places == self.frames.len();
        (is_even && list.chunks(num_times).enumerate().all(is_good))
            .then(|| self.transposed(num_times, |place, t| list[place * num_times + t]))
    }

    fn transposed(&self, num_times: usize, at: impl Fn(usize, usize) -> usize) -> Vec<usize> {
        (0..num_times)
            .flat_map(|t| (0..self.num_places).map(move |place| (place, t)))
            .map(|(p, t)| at(p, t))
            .collect()
    }

    /// The first `num_times` frames at each position. `counts` are the frames at each position.
    fn by_order(&self, counts: &[usize], num_times: usize) -> Vec<usize> {
        let starts: Vec<usize> = counts
            .iter()
            .scan(0, |at, n| {
                *at += n;
                Some(*at - n)
            })
            .collect();
        self.transposed(num_times, |place, t| starts[place] + t)
    }

    /// The complete ones of volumes with equal numbers, and the number of incomplete ones. A scan that was stopped
    /// early has such. The key that keeps most frames is used.
    fn interrupted(&self) -> Option<(Vec<usize>, usize)> {
        let by_key = |key: Key| {
            let list = self.sorted(key, None);
            let parts: Vec<_> = list.chunk_by(|a, b| a.0 == b.0).collect();
            let is_once = |part: &&[([f64; 2], usize)]| {
                part.windows(2).all(|w| self.places[w[0].1] < self.places[w[1].1])
            };
            let whole = || parts.iter().filter(|p| self.is_whole(p));
            parts.iter().all(is_once).then(|| {
                let frames: Vec<usize> = whole().flat_map(|p| p.iter().map(|x| x.1)).collect();
                (frames, parts.len() - whole().count())
            })
        };
        // `max_by_key` returns the last of equal ones, so the best key comes last.
        let best = Key::TIMES.into_iter().rev().filter_map(by_key).max_by_key(|(frames, _)| frames.len());
        best.filter(|(frames, _)| !frames.is_empty())
    }

    /// Lists the b-values of volumes that differ by them.
    fn b_values(&self, list: &[usize], key: Key) -> Vec<(WarningKind, String)> {
        if key != Key::BValue {
            return Vec::new();
        }
        let values: Vec<String> = list
            .iter()
            .step_by(self.num_places)
            .map(|&i| self.number(i, key))
            .map(|b| if b.is_finite() { b.to_string() } else { "none".to_owned() })
            .collect();
        let more = if values.len() > MAX_LISTED { ", …" } else { "" };
        let listed = values[..values.len().min(MAX_LISTED)].join(", ");
        vec![(WarningKind::Choice, format!("the points in time are b-values: {listed}{more} s/mm²"))]
    }
}

/// Most numbers in a warning.
const MAX_LISTED: usize = 8;
