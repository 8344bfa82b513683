//! Runs the binary and looks at what came out.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};

use serde_json::Value;

/// A folder of its own, gone at the end, and the binary run in it.
pub(crate) struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    pub(crate) fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(name);
        std::fs::write(&path, bytes).unwrap();
        path
    }

    /// The names of all files, also hidden ones.
    pub(crate) fn files(&self) -> Vec<String> {
        files_in(self.folder.path())
    }

    pub(crate) fn command(&self, line: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_isinglass"));
        command.args(line.split_whitespace()).current_dir(self.folder.path());
        command.env_remove("RUST_LOG").env_remove("DISPLAY").env_remove("ISINGLASS_DATA");
        // No settings of this machine.
        command.env("ISINGLASS_SYSTEM_CONFIG", self.path("etc")).env("XDG_CONFIG_HOME", self.path("home"));
        command.env("XDG_CACHE_HOME", self.path("cache"));
        command
    }

    pub(crate) fn run(&self, line: &str) -> Output {
        self.command(line).output().unwrap()
    }

    /// Runs what must succeed; its standard output.
    pub(crate) fn ok(&self, line: &str) -> String {
        let output = self.run(line);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{line}: {error}");
        String::from_utf8(output.stdout).unwrap()
    }

    pub(crate) fn json(&self, line: &str) -> Value {
        let out = self.ok(line);
        serde_json::from_str(&out).unwrap_or_else(|e| panic!("{line}: {e}: {out}"))
    }

    /// Runs what must fail: with this code, one line on standard error that has all `words`, and nothing on standard
    /// output or in the folder that was not there before.
    pub(crate) fn fails(&self, line: &str, code: i32, words: &[&str]) {
        let before = self.files();
        let output = self.run(line);
        assert_failed(line, &output, code, words);
        assert_eq!(self.files(), before, "{line}: left something behind");
    }
}

/// A process that ends with the test.
pub(crate) struct Running(pub(crate) Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Whether a window can open. Where none can, the caller prints nothing more and returns; strict mode fails instead.
pub(crate) fn has_display() -> bool {
    let has = isinglass_client::display_available();
    assert!(
        has || std::env::var("ISINGLASS_STRICT").as_deref() != Ok("1"),
        "no display: DISPLAY names no X server that answers"
    );
    if !has {
        eprintln!("skipped: no display (run under xvfb-run to open the window)");
    }
    has
}

pub(crate) fn assert_failed(line: &str, output: &Output, code: i32, words: &[&str]) {
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{line}: {error}");
    assert!(error.starts_with("isinglass: ") && error.ends_with('\n'), "{line}: {error}");
    assert_eq!(error.lines().count(), 1, "{line}: {error}");
    assert!(output.stdout.is_empty(), "{line}: wrote to standard output");
    for word in words {
        assert!(error.contains(word), "{line}: expected {word:?} in: {error}");
    }
}

pub(crate) fn files_in(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// The names of an object's fields, in order.
pub(crate) fn keys(object: &Value) -> Vec<&str> {
    let mut keys: Vec<_> = object.as_object().unwrap().keys().map(String::as_str).collect();
    keys.sort_unstable();
    keys
}

/// Fields that must be there.
pub(crate) fn assert_has(object: &Value, fields: &str) {
    for field in fields.split_whitespace() {
        assert!(object.get(field).is_some(), "no field {field} in {object}");
    }
}
