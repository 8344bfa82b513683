//! Opens a volume on its own thread, so that a window never waits.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;

use glam::Vec3;
use isinglass_core::volume::Volume;

use crate::error::FormatError;
use crate::raw::RawShape;
use crate::reading::Reading;
use crate::selection::Selection;
use crate::source::{OpenOptions, open};
use crate::volume_source::VolumeSource;

/// What to open.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadRequest {
    /// The volume, as for [`open`].
    pub source: String,
    /// The shape of a raw file.
    pub raw: Option<RawShape>,
    /// The part of the file to read.
    pub selection: Selection,
    /// Distances between voxels, instead of those in the file.
    pub spacing: Option<Vec3>,
    /// The memory limit in bytes.
    pub max_bytes: u64,
    /// Whether a header may name files outside its own folder.
    pub foreign_files: bool,
    /// How the numbers become voxels.
    pub reading: Reading,
}

impl LoadRequest {
    /// A request for all of `source`, with the default limit of memory.
    pub fn new(source: impl Into<String>) -> Self {
        VolumeSource::new(source).request(OpenOptions::default().max_bytes)
    }

    /// The options to open it with. A volume that does not fit is read by pages.
    pub fn options(&self) -> OpenOptions<'_> {
        let &Self { raw, selection, spacing, max_bytes, foreign_files, ref reading, .. } = self;
        let options = OpenOptions { by_pages: true, ..OpenOptions::default() };
        OpenOptions { raw, selection, spacing, max_bytes, foreign_files, reading, ..options }
    }
}

/// A volume that is being opened. Dropping this value cancels it.
#[derive(Debug)]
pub struct Loading {
    shared: Arc<Shared>,
    result: mpsc::Receiver<Result<Volume, FormatError>>,
}

#[derive(Debug, Default)]
struct Shared {
    /// The bits of the fraction that has been read.
    progress: AtomicU32,
    cancel: AtomicBool,
}

impl Loading {
    /// Starts to open a volume, with the folder of indices of volumes that were read before. `wake` is called once, on the loading thread, when [`Loading::poll`] has an answer.
    pub fn start(
        request: LoadRequest,
        index_folder: Option<PathBuf>,
        wake: impl FnOnce() + Send + 'static,
    ) -> Self {
        let shared = Arc::new(Shared::default());
        let (sender, result) = mpsc::sync_channel(1);
        let theirs = Arc::clone(&shared);
        thread::spawn(move || {
            let source = &request.source;
            let progress = |fraction: f32| theirs.progress.store(fraction.to_bits(), Ordering::Relaxed);
            let cancel = Some(&theirs.cancel);
            let progress = Some(&progress as &dyn Fn(f32));
            let index_folder = index_folder.as_deref();
            let options = OpenOptions { progress, cancel, index_folder, ..request.options() };
            // A panic must not leave the window waiting.
            let opened = catch_unwind(AssertUnwindSafe(|| open(source, &options)));
            let opened = opened.unwrap_or_else(|_| {
                let problem = "reading it has failed by a defect of isinglass".to_owned();
                Err(FormatError::Data { path: source.clone(), problem })
            });
            // The receiver is gone if this value was dropped.
            let _ = sender.send(opened);
            wake();
        });
        Self { shared, result }
    }

    /// The fraction that has been read, 0 to 1.
    pub fn progress(&self) -> f32 {
        f32::from_bits(self.shared.progress.load(Ordering::Relaxed))
    }

    /// Asks the thread to stop. [`Loading::poll`] then returns [`FormatError::Cancelled`].
    pub fn cancel(&self) {
        self.shared.cancel.store(true, Ordering::Relaxed);
    }

    /// Returns the volume or the error once, as soon as there is one. It never waits.
    pub fn poll(&self) -> Option<Result<Volume, FormatError>> {
        self.result.try_recv().ok()
    }
}

impl Drop for Loading {
    fn drop(&mut self) {
        self.cancel();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The result of a request, and the progress at its end.
    fn finished(loading: &Loading, woken: &mpsc::Receiver<()>) -> (Result<Volume, FormatError>, f32) {
        woken.recv().expect("it always wakes");
        (loading.poll().expect("there is an answer when it wakes"), loading.progress())
    }

    #[test]
    fn a_volume_comes_from_a_thread_and_can_be_cancelled() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("a.raw");
        std::fs::write(&path, vec![7; 64 * 64 * 64]).unwrap();
        let raw = RawShape {
            dims: [64; 3],
            dtype: crate::Dtype::Uint8,
            spacing: Vec3::ONE,
            endian: crate::Endian::Little,
            offset: 0,
        };
        let request = LoadRequest { raw: Some(raw), ..LoadRequest::new(path.to_str().unwrap()) };
        let (wake, woken) = mpsc::sync_channel(1);
        let loading = Loading::start(request.clone(), None, move || wake.send(()).unwrap());
        let (volume, progress) = finished(&loading, &woken);
        assert_eq!((volume.unwrap().dims(), progress), ([64; 3], 1.0));
        assert!(loading.poll().is_none());
        let options =
            OpenOptions { raw: request.raw, cancel: Some(&AtomicBool::new(true)), ..Default::default() };
        let e = open(&request.source, &options).unwrap_err();
        assert!(matches!(e, FormatError::Cancelled { .. }) && e.to_string().ends_with("a.raw: cancelled"));
        let (wake, woken) = mpsc::sync_channel(1);
        let loading = Loading::start(LoadRequest::new("nowhere.nrrd"), None, move || wake.send(()).unwrap());
        assert!(finished(&loading, &woken).0.unwrap_err().to_string().contains("nowhere.nrrd"));
    }
}
