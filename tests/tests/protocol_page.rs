//! Was docs/PROTOCOL.md read again when the bytes it describes changed?
//!
//! The page ends with a hash of the sources that define bytes on the wire and in files. Whoever changes one of them
//! reads the page, corrects it, and puts the hash that this test prints there: in the same commit.

use std::path::{Path, PathBuf};

/// Files and folders below the workspace that define bytes.
const SOURCES: [&str; 32] = [
    "crates/core/src/wire",
    "crates/core/src/codec/bands.rs",
    "crates/core/src/codec/chunk.rs",
    "crates/core/src/codec/header.rs",
    "crates/core/src/codec/portable_math.rs",
    "crates/core/src/codec/exact/mod.rs",
    "crates/core/src/codec/exact/scale.rs",
    "crates/core/src/codec/exact/rans.rs",
    "crates/core/src/codec/exact/contexts.rs",
    "crates/core/src/codec/exact/rows.rs",
    "crates/core/src/codec/exact/predict.rs",
    "crates/core/src/codec/exact/planes.rs",
    "crates/core/src/codec/blocks/model.rs",
    "crates/core/src/codec/blocks/transform.rs",
    "crates/core/src/codec/blocks/scales.rs",
    "crates/core/src/codec/blocks/smooth.rs",
    "crates/core/src/codec/blocks/entropy.rs",
    "crates/core/src/codec/blocks/prior.rs",
    "crates/core/src/codec/blocks/tables.rs",
    "crates/core/src/codec/blocks/syntax.rs",
    "crates/core/src/codec/blocks/steps.rs",
    "crates/core/src/codec/blocks/motion.rs",
    "crates/core/src/codec/blocks/tile.rs",
    "crates/core/src/codec/blocks/reference.rs",
    "crates/core/src/codec/blocks/fetch.rs",
    "crates/core/src/codec/blocks/to_frame.rs",
    "crates/core/src/codec/blocks/head.rs",
    "crates/core/src/codec/blocks/residual.rs",
    "crates/core/src/codec/blocks/corrections.rs",
    "crates/core/src/codec/blocks/coding",
    "crates/core/src/codec/blocks/decode.rs",
    "crates/formats/src/iglf.rs",
];

fn workspace() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

fn files(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let entries = std::fs::read_dir(path).expect("the folder is there");
    let mut files: Vec<_> = entries.map(|e| e.expect("it can be listed").path()).collect();
    files.sort();
    files
}

/// FNV-1a of the code: comments, empty lines and tests do not count.
fn hash(texts: impl Iterator<Item = String>) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    for text in texts {
        let code = text.split("#[cfg(test)]").next().unwrap_or_default();
        let lines = code.lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with("//"));
        for byte in lines.flat_map(|l| l.bytes().chain([b'\n'])) {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
    hash
}

#[test]
fn the_page_knows_the_bytes() {
    let sources = SOURCES.iter().flat_map(|s| files(&workspace().join(s)));
    let found = hash(sources.map(|f| std::fs::read_to_string(f).expect("a source can be read")));
    let page = std::fs::read_to_string(workspace().join("docs/PROTOCOL.md")).expect("the page is there");
    let line = format!("<!-- sources: {found:016x} -->");
    assert!(
        page.trim_end().ends_with(&line),
        "bytes may have changed: read docs/PROTOCOL.md again, correct it, and end it with {line}"
    );
}

#[test]
fn a_change_of_code_is_noticed_and_one_of_words_is_not() {
    let of = |text: &str| hash(std::iter::once(text.to_owned()));
    assert_ne!(of("const A: u8 = 1;"), of("const A: u8 = 2;"));
    assert_eq!(of("// one\nconst A: u8 = 1;"), of("const A: u8 = 1;\n#[cfg(test)]\nmod tests {}"));
}
