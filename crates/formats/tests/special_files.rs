//! Is what is not a plain file refused by its name, wherever a file is opened? A pipe without a writer would make whoever
//! opens it wait for ever.

#![cfg(unix)]
#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "support/zarr.rs"]
mod zarr;

use std::fs;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use isinglass_formats::{
    Content, OpenOptions, Recent, Remembered, content_of, load_transfer, open, open_file, outline,
    read_settings, read_state, read_text,
};
use tempfile::TempDir;
use zarr::{ArrayText, Packing};

const SPECIAL: [&str; 4] = ["a pipe", "a socket", "a folder", "a device"];

/// Puts what is named by `kind` in the place of a file.
fn put(kind: &str, path: &Path) {
    let _ = fs::remove_file(path);
    match kind {
        "a pipe" => assert!(Command::new("mkfifo").arg(path).status().unwrap().success()),
        // The name stays when the socket is closed.
        "a socket" => drop(UnixListener::bind(path).unwrap()),
        "a folder" => fs::create_dir(path).unwrap(),
        _ => std::os::unix::fs::symlink("/dev/zero", path).unwrap(),
    }
}

/// What `work` returns. It must not take long.
fn in_time<T: Send + 'static>(what: &str, work: impl FnOnce() -> T + Send + 'static) -> T {
    let (sender, receiver) = mpsc::sync_channel(1);
    thread::spawn(move || sender.send(work()));
    receiver.recv_timeout(Duration::from_secs(60)).unwrap_or_else(|_| panic!("{what} waits"))
}

fn error_of(path: PathBuf) -> String {
    in_time("open", move || {
        let options = OpenOptions { foreign_files: true, ..OpenOptions::default() };
        let source = path.to_str().unwrap();
        let line = open(source, &options).unwrap_err().to_string();
        // Whoever reads the header alone does not wait either.
        let _ = outline(source, &options);
        line
    })
}

/// A folder with a header or array in each format that names another file; each with the name of that file.
fn owners(folder: &Path) -> Vec<(PathBuf, PathBuf)> {
    let voxels = folder.join("v.raw");
    fs::write(&voxels, [7; 8]).unwrap();
    let write = |name: &str, text: &str| {
        fs::write(folder.join(name), text).unwrap();
        (folder.join(name), voxels.clone())
    };
    let nrrd = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n";
    let meta = "ObjectType = Image\nNDims = 3\nDimSize = 2 2 2\nElementType = MET_UCHAR\n";
    let mut owners = vec![
        write("a.nhdr", &format!("{nrrd}data file: v.raw\n")),
        write("b.nhdr", &format!("{nrrd}data file: LIST\nv.raw\n")),
        write("c.mhd", &format!("{meta}ElementDataFile = v.raw\n")),
    ];
    let zarr = folder.join("d.zarr");
    let text = ArrayText { shape: &[2, 2, 2], chunk: &[2, 2, 2], dtype: "|u1", packing: Packing::Raw };
    text.write(&zarr, |_| vec![7]);
    owners.push((zarr.clone(), zarr.join("0/0/0")));
    owners
}

#[test]
fn data_files_and_chunks_are_plain_files() {
    for kind in SPECIAL {
        let folder = TempDir::new().unwrap();
        for (owner, data) in owners(folder.path()) {
            // The control.
            let volume = open(owner.to_str().unwrap(), &OpenOptions::default()).unwrap();
            assert_eq!(volume.voxels().get(0), 7.0, "{}", owner.display());
            let plain = fs::read(&data).unwrap();
            put(kind, &data);
            let line = error_of(owner.clone());
            let name = data.strip_prefix(folder.path()).unwrap().to_str().unwrap();
            assert!(
                line.contains(kind) && line.contains(name) && !line.contains('\n'),
                "{}: {line}",
                owner.display()
            );
            if kind == "a folder" {
                fs::remove_dir(&data).unwrap();
            } else {
                fs::remove_file(&data).unwrap();
            }
            fs::write(&data, plain).unwrap();
        }
    }
}

#[test]
fn headers_states_presets_and_lists_are_plain_files() {
    for kind in SPECIAL {
        let folder = TempDir::new().unwrap();
        let path = folder.path().join("a.nrrd");
        put(kind, &path);
        if kind != "a folder" {
            assert!(error_of(path.clone()).contains(kind));
        }
        let lines = in_time("a reader", move || {
            let content = content_of(&path).unwrap();
            assert!(matches!(content, Content::Other(found) if found == kind) || content == Content::Folder);
            vec![
                open_file(&path).unwrap_err().to_string(),
                read_text(&path, 100).unwrap_err().to_string(),
                read_state(&path).unwrap_err().to_string(),
                load_transfer(path.to_str().unwrap()).unwrap_err().to_string(),
                read_settings(&path).unwrap_err().to_string(),
                Recent::read(&path).unwrap_err().to_string(),
                Remembered::read(&path, |_| ()).unwrap_err().to_string(),
                isinglass_formats::iglf::read(&path).unwrap_err().to_string(),
            ]
        });
        for line in lines {
            assert!(line.contains(kind) && !line.contains('\n'), "{kind}: {line}");
        }
    }
}

#[test]
fn slices_that_are_no_files_are_left_out_or_named() {
    let folder = TempDir::new().unwrap();
    for number in 0..2 {
        put("a pipe", &folder.path().join(format!("{number}.tif")));
        put("a pipe", &folder.path().join(format!("{number}.dcm")));
    }
    let line = error_of(folder.path().to_owned());
    assert!(line.contains("a folder without slices"), "{line}");
}
