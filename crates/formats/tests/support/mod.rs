//! The archives of small volumes written by other libraries (`fixtures/make.py`).

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::io::Read;
use std::path::Path;

use flate2::read::GzDecoder;
use tempfile::TempDir;

/// Unpacks `fixtures/NAME.tar.gz`.
pub(crate) fn unpack(name: &str) -> TempDir {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/fixtures/{name}.tar.gz"));
    let mut tar = Vec::new();
    GzDecoder::new(fs::File::open(&path).unwrap()).read_to_end(&mut tar).unwrap();
    let folder = TempDir::new().unwrap();
    let mut rest = &tar[..];
    while rest.len() >= 512 && rest[0] != 0 {
        let text = |range: std::ops::Range<usize>| {
            std::str::from_utf8(&rest[range]).unwrap().trim_end_matches(['\0', ' ']).to_owned()
        };
        let (prefix, name) = (text(345..500), text(0..100));
        let size = usize::from_str_radix(&text(124..136), 8).unwrap();
        let path = folder.path().join(prefix).join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, &rest[512..512 + size]).unwrap();
        rest = &rest[512 + size.div_ceil(512) * 512..];
    }
    folder
}
