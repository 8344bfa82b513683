//! Does a session that reads all of a file leave its index behind?

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::volume::{Histogram, PageView};
use isinglass_formats::{Dtype, Endian, OpenOptions, RawShape, default_transfer, open_paged};
use isinglass_server::Pager;
use tempfile::TempDir;

/// A file that is too large to be indexed when it is opened: zeros, with a number here and there.
fn large_file(path: &Path) -> RawShape {
    let dims = [430, 430, 366];
    let num_voxels: u64 = dims.iter().map(|&n| u64::from(n)).product();
    let mut file = fs::File::create(path).unwrap();
    file.set_len(num_voxels * 4).unwrap();
    for i in (0..num_voxels).step_by(50_021) {
        file.seek(SeekFrom::Start(i * 4)).unwrap();
        file.write_all(&((i % 977) as f32).to_le_bytes()).unwrap();
    }
    RawShape { dims, dtype: Dtype::Float, spacing: Vec3::ONE, endian: Endian::Little, offset: 0 }
}

#[test]
fn a_session_that_reads_all_of_a_file_leaves_its_index_and_one_with_little_memory_leaves_none() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.raw");
    let raw = Some(large_file(&path));
    let [by_session, by_command] = ["session", "command"].map(|name| folder.path().join(name));
    let opened = |kept: &Path| {
        let options = OpenOptions { raw, index_folder: Some(kept), ..OpenOptions::default() };
        open_paged(path.to_str().unwrap(), &options).unwrap()
    };
    for (max_bytes, is_whole) in [(330 << 20, false), (1 << 30, true)] {
        assert!(!by_session.exists(), "half of the pages make no index");
        let volume = opened(&by_session).into_volume(max_bytes);
        let look = Look::new(default_transfer("a.raw", &volume, &Histogram::of(&volume)));
        let pager = Pager::of(&volume).unwrap().unwrap();
        let bounds = volume.bounds();
        let scene = Scene::of_look(Arc::new(volume), &look);
        let picture = Intrinsics::perspective(64, 48, 0.6);
        let pose = Pose::orbit(bounds.center(), 0.4, 0.3, bounds.radius() * picture.fit_distance());
        let view =
            PageView { camera: Camera::new(pose, picture, &bounds), region: scene.region(), rests: true };
        let pages = pager.settled(ViewerId(1), &view, &scene, &|| true);
        assert_eq!(pages.part.progress.is_exact(), is_whole, "{:?}", pages.part.progress);
    }
    let paged = opened(&by_command);
    let kept = paged.keep_index(&paged.build_index(None, None).unwrap()).unwrap().unwrap();
    let same = by_session.join(kept.file_name().unwrap());
    assert!(fs::read(&same).unwrap() == fs::read(&kept).unwrap(), "to the byte");
}
