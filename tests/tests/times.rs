//! Are the next times of a film read before a viewer requests them, within the memory's bound, and do equal values keep
//! their colours?
//!
//! The film is a file that the test writes, and nothing here depends on time.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::transfer::Domain;
use isinglass_core::volume::Volume;
use isinglass_core::wire::{Choices, LoadState, Part};
use isinglass_formats::{OpenOptions, Selection, load_transfer, open, outline};
use isinglass_net::Client;
use isinglass_server::{Loaded, Loader, Survey};
use isinglass_tests::host::Host;

const SIZE: Intrinsics = Intrinsics::perspective(32, 32, 0.6);
const TIMES: u32 = 6;
const SIDE: usize = 8;

/// A NIfTI file of six times, one every quarter of a second, each brighter than the one before.
fn write_film(path: &std::path::Path) {
    let mut header = vec![0; 352];
    let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    for (i, dim) in [4, SIDE as i16, SIDE as i16, SIDE as i16, TIMES as i16, 1, 1, 1].iter().enumerate() {
        put(40 + 2 * i, &dim.to_le_bytes());
    }
    put(70, &512i16.to_le_bytes());
    for i in 0..4 {
        put(76 + 4 * i, &1f32.to_le_bytes());
    }
    put(92, &250f32.to_le_bytes());
    put(108, &352f32.to_le_bytes());
    put(123, &[2 + 16]);
    put(344, b"n+1\0");
    let values = (0..TIMES as usize * SIDE.pow(3)).map(|i| value(i / SIDE.pow(3), i % SIDE.pow(3)));
    let voxels = values.flat_map(u16::to_le_bytes);
    std::fs::write(path, header.into_iter().chain(voxels).collect::<Vec<_>>()).unwrap();
}

fn value(time: usize, voxel: usize) -> u16 {
    (100 + 50 * time + voxel) as u16
}

/// Reads the film. While there is a gate, each reading waits for it.
struct Film {
    path: PathBuf,
    /// Most memory, bytes.
    limit: u64,
    gate: Option<Mutex<Receiver<()>>>,
    loads: Mutex<Vec<u32>>,
}

impl Film {
    fn options(part: &Part) -> OpenOptions<'static> {
        let selection = Selection { time: part.time, ..Selection::default() };
        OpenOptions { selection, ..OpenOptions::default() }
    }

    fn read(&self, part: &Part) -> Volume {
        open(self.path.to_str().unwrap(), &Self::options(part)).unwrap()
    }

    fn loads(&self) -> Vec<u32> {
        self.loads.lock().unwrap().clone()
    }
}

impl Loader for Film {
    fn survey(&self, part: &Part, held: u64) -> Result<Survey, String> {
        let found = outline(self.path.to_str().unwrap(), &Self::options(part)).map_err(|e| e.to_string())?;
        if held + found.bytes_needed() > self.limit {
            return Err("no room".into());
        }
        let shown = Part { time: part.time.or(Some(0)), ..ZERO };
        let parts = Choices {
            shown,
            whole_dims: found.whole_dims,
            num_channels: 1,
            num_times: found.num_times as u32,
            time_step: found.time_step.map(|seconds| seconds as f32),
            num_series: 1,
            bytes_in_memory: found.bytes_in_memory,
            ..Choices::default()
        };
        Ok(Survey { parts, bytes_needed: found.bytes_needed() })
    }

    fn load(&self, part: &Part, _: u64, _: &dyn Fn(f32), cancel: &AtomicBool) -> Result<Loaded, String> {
        self.loads.lock().unwrap().push(part.time.unwrap());
        if let Some(gate) = &self.gate {
            let gate = gate.lock().unwrap();
            while gate.recv_timeout(Duration::from_millis(2)).is_err() {
                if cancel.load(std::sync::atomic::Ordering::Relaxed) {
                    return Err("cancelled".into());
                }
            }
        }
        Ok(Loaded {
            volume: self.read(part),
            transfer: load_transfer("smooth").unwrap(),
            channels: Default::default(),
        })
    }
}

const ZERO: Part =
    Part { channel: Some(0), time: Some(0), level: Some(0), series: Some(0), region: None, flip: [false; 3] };

struct Stage {
    host: Host,
    film: Arc<Film>,
    gate: SyncSender<()>,
    _folder: tempfile::TempDir,
}

/// Serves the film within so many volumes of memory, and so many bytes for frames.
fn stage(volumes: u64, frame_memory: u64, has_gate: bool) -> Stage {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("film.nii");
    write_film(&path);
    let (gate, opened) = sync_channel(1);
    let bytes = outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap().bytes_in_memory;
    let film = Film {
        path,
        limit: volumes * bytes,
        gate: has_gate.then(|| Mutex::new(opened)),
        loads: Mutex::default(),
    };
    let film = Arc::new(film);
    let parts = film.survey(&ZERO, 0).unwrap().parts;
    let memory = [frame_memory, film.limit];
    let host = Host::within(film.read(&ZERO), "smooth", parts, film.clone(), memory);
    Stage { host, film, gate, _folder: folder }
}

impl Stage {
    fn viewer(&self) -> Client {
        let client = self.host.viewer();
        client.set_pose(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 30.0), SIZE);
        client
    }
}

fn until<T>(what: &str, mut found: impl FnMut() -> Option<T>) -> T {
    let patience = Instant::now() + Duration::from_secs(60);
    loop {
        if let Some(found) = found() {
            return found;
        }
        assert!(Instant::now() < patience, "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn request(client: &Client, time: u32) {
    client.talk().selection.open(Some(Part { time: Some(time), ..ZERO }));
}

/// Requests a time, and waits until a frame shows it.
fn show(client: &Client, time: u32) {
    request(client, time);
    until("a frame of the time", || {
        let frame = client.latest_frame()?;
        let talk = client.talk();
        let shown = talk.selection.choices()?.shown.time;
        (frame.is_of(&talk) && shown == Some(time)).then_some(())
    });
    let least = f32::from(value(time as usize, 0));
    assert_eq!(client.talk().link.description().unwrap().volume.value_range.0, least, "time {time}");
}

#[test]
fn a_film_that_plays_is_read_ahead_and_each_time_once() {
    let stage = stage(100, 1 << 20, false);
    let viewer = stage.viewer();
    until("the choices", || viewer.talk().selection.choices());
    assert_eq!(viewer.talk().selection.choices().unwrap().time_step, Some(0.25));
    show(&viewer, 1);
    until("the times ahead", || (stage.film.loads().len() == 5).then_some(()));
    assert_eq!(stage.film.loads(), [1, 2, 3, 4, 5], "the one before is there still");
    for time in [2, 3, 4, 5, 0, 1] {
        show(&viewer, time);
    }
    assert_eq!(stage.film.loads().len(), 5, "nothing is read again");
    // A value keeps its colour from time to time, although the range is another.
    let transfer = viewer.talk().look.in_force().unwrap().1.transfer.clone();
    let first = stage.film.read(&ZERO);
    let kept = load_transfer("smooth").unwrap();
    let kept = kept.at_values(&first, &isinglass_core::volume::Histogram::of(&first)).domain;
    assert!(matches!(kept, Domain::Values(..)) && transfer.domain == kept, "{kept:?} {:?}", transfer.domain);
    stage.host.end();
}

#[test]
fn what_is_read_ahead_keeps_to_the_memory_and_gives_way() {
    // Room for the shown one and another.
    let stage = stage(2, 1 << 20, false);
    let viewer = stage.viewer();
    for time in [1, 2, 3] {
        show(&viewer, time);
        let next = time + 1;
        until("the time ahead", || (stage.film.loads().last() == Some(&next)).then_some(()));
    }
    assert_eq!(stage.film.loads(), [1, 2, 3, 4], "one ahead, and each once");
    // A jump takes the room of what was read ahead, and nothing is read ahead of it. The one before is there still.
    for (time, loads) in [(0, &[1, 2, 3, 4, 0][..]), (3, &[1, 2, 3, 4, 0]), (1, &[1, 2, 3, 4, 0, 1])] {
        show(&viewer, time);
        assert_eq!(stage.film.loads(), loads);
    }
    stage.host.end();
    // Frames have so little memory that a quarter of it holds no volume, and volumes have no more than they need.
    let stage = self::stage(2, 4096, false);
    let viewer = stage.viewer();
    for time in [1, 2, 3] {
        show(&viewer, time);
    }
    assert_eq!(stage.film.loads(), [1, 2, 3], "control");
    show(&viewer, 2);
    assert_eq!(stage.film.loads(), [1, 2, 3, 2], "nor is the one before kept");
    stage.host.end();
}

#[test]
fn a_time_that_is_being_read_ahead_is_not_read_twice() {
    let stage = stage(100, 1 << 20, true);
    let viewer = stage.viewer();
    request(&viewer, 1);
    stage.gate.send(()).unwrap();
    until("reading ahead", || (stage.film.loads() == [1, 2]).then_some(()));
    request(&viewer, 2);
    until("the load", || {
        let load = viewer.talk().selection.load()?;
        (load.part.time == Some(2) && matches!(load.state, LoadState::Reading { .. })).then_some(())
    });
    assert!(viewer.talk().selection.load().unwrap().bytes_needed > 0, "viewers are told of it now");
    stage.gate.send(()).unwrap();
    until("the next time", || (stage.film.loads() == [1, 2, 3]).then_some(()));
    let shown = || viewer.talk().selection.choices().and_then(|choices| choices.shown.time);
    until("the time itself", || (shown() == Some(2)).then_some(()));
    // Another part ends what is read ahead, and comes first.
    request(&viewer, 5);
    until("the other part", || (stage.film.loads() == [1, 2, 3, 5]).then_some(()));
    stage.gate.send(()).unwrap();
    until("the other part", || {
        let choices = viewer.talk().selection.choices()?;
        (choices.shown.time == Some(5)).then_some(())
    });
    stage.host.end();
}
