//! Can anything that a peer sends make the other side do more than refuse it?
//!
//! Each kind of input is a function in `common/wire_targets.rs`, which any fuzzer can call. The one here has a seed.
//! It damages inputs that were taken, and goes on from each input that became something new. Those are kept in
//! `corpora/`, which an ordinary test run repeats. Panics and memory beyond the limit are findings.

#[path = "common/fuzzing.rs"]
mod fuzzing;
#[path = "common/wire_targets.rs"]
mod targets;

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use fuzzing::{ALLOCATED, MOST, Random};
use targets::{TARGETS, Target};

/// One target at a time, so that what is allocated is its own.
static ONE: Mutex<()> = Mutex::new(());

/// Damages `bytes` in one to four places.
fn mutate(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    for _ in 0..1 + random.below(4) {
        let len = bytes.len();
        let reach = random.of(&[len, len, 64, 16]).min(len);
        let at = random.below(reach);
        match random.below(9) {
            0..=1 if len > 0 => bytes[at] ^= 1 << random.below(8),
            2 if len > 0 => bytes[at] = random.of(&[0, 1, 0x7f, 0x80, 0xfb, 0xfc, 0xfd, 0xff]),
            3 => {
                let value = random.of(&[0u32, 1, 4, len as u32, 0x7f80_0000, 0x7fc0_0000, 1 << 31, u32::MAX]);
                let end = (at + 4).min(len);
                bytes[at..end].copy_from_slice(&value.to_le_bytes()[..end - at]);
            }
            4 => bytes.truncate(random.below(len + 1)),
            5 => {
                let from = random.below(other.len());
                bytes.truncate(at);
                bytes.extend_from_slice(&other[from..]);
            }
            6 => {
                let to = at + random.below(64).min(len - at);
                let run = bytes[at..to].to_vec();
                drop(bytes.splice(at..at, run));
            }
            7 => drop(bytes.drain(at..(at + random.below(16)).min(len))),
            8 => {
                let run = vec![random.of(&[0, 0xff]); random.of(&[1, 8, 300, 4000])];
                drop(bytes.splice(at..at, run));
            }
            _ => {}
        }
    }
    bytes.truncate(MOST_INPUT);
}

/// Gives a target its input and holds it to its limit.
fn take(target: &Target, bytes: &[u8]) -> String {
    let before = ALLOCATED.load(Relaxed);
    MOST.store(before, Relaxed);
    let what = (target.take)(bytes);
    let used = MOST.load(Relaxed).saturating_sub(before);
    assert!(used <= target.most_bytes, "{}: {used} bytes allocated for {bytes:02x?}", target.name);
    what
}

/// The inputs of a target that became something of their own.
fn fuzz(target: &Target, duration: Duration, most: u64, seed: u64) -> BTreeMap<String, Vec<u8>> {
    let mut pool: Vec<Vec<u8>> = (target.seeds)().into_iter().chain(corpus(target)).collect();
    let mut found: BTreeMap<String, Vec<u8>> = BTreeMap::new();
    for bytes in &pool {
        found.entry(take(target, bytes)).or_insert_with(|| bytes.clone());
    }
    let mut random = Random(seed);
    let start = Instant::now();
    let mut inputs = 0;
    while inputs < most && start.elapsed() < duration {
        let mut bytes = pool[random.below(pool.len())].clone();
        let other = random.below(pool.len());
        mutate(&mut bytes, &pool[other], &mut random);
        let what = take(target, &bytes);
        inputs += 1;
        if let Entry::Vacant(new) = found.entry(what) {
            new.insert(bytes.clone());
            pool.push(bytes);
        }
    }
    eprintln!("{}: {inputs} inputs became {} different things", target.name, found.len());
    found
}

fn corpus_file(target: &Target) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/corpora").join(format!("{}.hex", target.name))
}

/// One input a line.
fn corpus(target: &Target) -> Vec<Vec<u8>> {
    let text = std::fs::read_to_string(corpus_file(target)).unwrap_or_default();
    let byte = |line: &str, i: usize| u8::from_str_radix(&line[2 * i..2 * i + 2], 16).expect("digits");
    text.lines().map(|line| (0..line.len() / 2).map(|i| byte(line, i)).collect()).collect()
}

#[test]
fn some_damage_to_each_kind_of_input_finds_nothing() {
    let _one = ONE.lock();
    for target in &TARGETS {
        // Everything in the corpus, and then a little more.
        assert!(!corpus(target).is_empty(), "{}", target.name);
        let found = fuzz(target, Duration::MAX, 3000, 5);
        // Seeds that are not taken, or damage that is never met, would test nothing.
        let num_refused = found
            .keys()
            .filter(|what| ["error", "nothing", "refused"].iter().any(|w| what.contains(w)))
            .count();
        assert!(num_refused > 0 && num_refused < found.len(), "{}: {:?}", target.name, found.keys());
    }
}

/// A target that allocates what a length says is found.
#[test]
#[should_panic(expected = "bytes allocated")]
fn a_length_that_is_believed_is_a_finding() {
    let _one = ONE.lock();
    let believes = |bytes: &[u8]| {
        let length = bytes.first_chunk().map_or(0, |b| u32::from_le_bytes(*b) as usize % (1 << 26));
        format!("{}", std::hint::black_box(vec![1u8; length]).len() % 2)
    };
    let target =
        Target { name: "believing", seeds: || vec![vec![1, 0, 0, 0]], take: believes, most_bytes: 1 << 20 };
    fuzz(&target, Duration::MAX, 10_000, 1);
}

/// `ISINGLASS_FUZZ_SECONDS` for each target, 600 if it is not set; `ISINGLASS_FUZZ_SEED`; `ISINGLASS_FUZZ_TARGET` for
/// one of them; `ISINGLASS_FUZZ_KEEP` writes the corpora.
#[test]
#[ignore = "runs for ten minutes a target"]
fn ten_minutes_of_damage_to_each_kind_of_input_find_nothing() {
    let _one = ONE.lock();
    let number =
        |name: &str, otherwise| std::env::var(name).map_or(otherwise, |v| v.parse().expect("a number"));
    let duration = Duration::from_secs(number("ISINGLASS_FUZZ_SECONDS", 600));
    let only = std::env::var("ISINGLASS_FUZZ_TARGET").ok();
    for target in TARGETS.iter().filter(|t| only.as_deref().is_none_or(|only| only == t.name)) {
        let found = fuzz(target, duration, u64::MAX, number("ISINGLASS_FUZZ_SEED", 7));
        if std::env::var_os("ISINGLASS_FUZZ_KEEP").is_some() {
            let line = |bytes: &Vec<u8>| bytes.iter().map(|b| format!("{b:02x}")).collect::<String>() + "\n";
            // The shortest say as much as the longest, and keep the folder small.
            let short = found.values().filter(|bytes| bytes.len() <= MOST_KEPT);
            std::fs::write(corpus_file(target), short.map(line).collect::<String>()).expect("the corpus");
        }
    }
}

const MOST_INPUT: usize = 1 << 16;
const MOST_KEPT: usize = 2000;
