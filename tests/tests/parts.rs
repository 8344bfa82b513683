//! Do viewers choose another part of a server's file, all of them see it, and does what is shown stay until it is there?
//!
//! The file is one of the test's own: its reading waits until the test lets it go on, so nothing here depends on time.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::look::Look;
use isinglass_core::picture::Picture;
use isinglass_core::transfer::Domain;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Histogram, Volume};
use isinglass_core::wire::{Choices, LoadState, Part};
use isinglass_formats::load_transfer;
use isinglass_net::Client;
use isinglass_server::{Loaded, Loader, Survey};
use isinglass_tests::host::Host;

const SIZE: Intrinsics = Intrinsics::perspective(48, 40, 0.6);

/// A file with three times: a volume each. Time 0 is shown at first; another is read half, and then waits for the gate, if
/// there is one, or to be cancelled.
struct Film {
    gate: Option<Mutex<Receiver<()>>>,
    /// Loads that were ended in the middle.
    num_cancelled: Mutex<usize>,
}

fn volume(time: u32) -> Volume {
    match time {
        0 => Builtin::Shells.volume(24),
        1 => Builtin::Cubus.volume(24),
        // Of another size.
        _ => {
            let whole = Builtin::Cloud.volume(16);
            Volume::new([16; 3], Vec3::splat(0.3), whole.voxels().clone(), (2.0, 1.0), whole.info).unwrap()
        }
    }
}

fn parts(time: u32) -> Choices {
    Choices {
        // Each time has another channel, whose numbers mean something else.
        shown: Part {
            channel: Some(time),
            time: Some(time),
            level: Some(0),
            series: Some(0),
            ..Part::default()
        },
        whole_dims: [24; 3],
        num_channels: 3,
        num_times: 3,
        num_series: 1,
        ..Choices::default()
    }
}

impl Loader for Film {
    fn survey(&self, part: &Part, held: u64) -> Result<Survey, String> {
        assert!(held > 0, "the volume that is shown counts");
        match part.time {
            Some(time @ 0..3) => {
                let mut parts = parts(time);
                parts.shown.channel = part.channel.or(parts.shown.channel);
                Ok(Survey { parts, bytes_needed: 4711 })
            }
            _ => Err("film: there is no such time".into()),
        }
    }

    fn load(
        &self,
        part: &Part,
        _: u64,
        progress: &dyn Fn(f32),
        cancel: &AtomicBool,
    ) -> Result<Loaded, String> {
        progress(0.5);
        if let Some(gate) = &self.gate {
            let gate = gate.lock().unwrap();
            while gate.recv_timeout(Duration::from_millis(2)).is_err() {
                if cancel.load(Ordering::Relaxed) {
                    *self.num_cancelled.lock().unwrap() += 1;
                    return Err("cancelled".into());
                }
            }
        }
        let time = part.time.unwrap();
        let transfer = load_transfer(["shells", "cubus", "cloud"][time as usize]).unwrap();
        Ok(Loaded { volume: volume(time), transfer, channels: Default::default() })
    }
}

struct Stage {
    host: Host,
    film: Arc<Film>,
    gate: SyncSender<()>,
}

fn stage(has_gate: bool) -> Stage {
    let (gate, opened) = sync_channel(1);
    let film = Arc::new(Film { gate: has_gate.then(|| Mutex::new(opened)), num_cancelled: Mutex::new(0) });
    Stage { host: Host::new(volume(0), "shells", parts(0), film.clone()), film, gate }
}

impl Stage {
    fn viewer(&self) -> Client {
        let client = self.host.viewer();
        client.set_pose(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 6.0), SIZE);
        client
    }

    fn end(self) {
        self.host.end();
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

fn time_of(client: &Client) -> Option<u32> {
    client.talk().selection.choices()?.shown.time
}

/// The complete picture of the volume that the client describes, which must be that of `time`.
fn picture_of(client: &Client, time: u32) -> Picture {
    until("the picture of the volume", || {
        let frame = client.latest_frame()?;
        let is_wanted = frame.is_of(&client.talk()) && time_of(client) == Some(time);
        is_wanted.then(|| frame.frame.flatten())
    })
}

fn at(time: u32) -> Option<Part> {
    Some(Part { time: Some(time), ..Part::default() })
}

fn greatest_difference(a: &Picture, b: &Picture) -> u8 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

#[test]
fn another_time_changes_picture_and_description_of_all_viewers() {
    let stage = stage(false);
    let (asking, watching) = (stage.viewer(), stage.viewer());
    let both = [&asking, &watching];
    let before = both.map(|c| picture_of(c, 0));
    // Of two frames at one pose, the budget of the second follows from the first.
    assert!(greatest_difference(&before[0], &before[1]) <= 1);
    for time in [1, 2, 0] {
        asking.talk().selection.open(at(time));
        let after = both.map(|c| picture_of(c, time));
        assert!(greatest_difference(&after[0], &after[1]) <= 1, "{time}");
        let difference = greatest_difference(&after[0], &before[0]);
        // The control: time 0 again is what it was.
        assert_eq!(difference > 8, time != 0, "{time}: {difference}");
        for client in both {
            let description = client.talk().link.description().unwrap();
            let expected = volume(time);
            assert_eq!(description.volume.dims, expected.dims(), "{time}");
            assert_eq!(description.volume.value_range, expected.value_range(), "{time}");
            assert_eq!(description.volume.bounds(), expected.bounds(), "{time}");
            // Nobody had chosen a look, so each volume has its own.
            let (_, look) = client.talk().look.in_force().unwrap();
            assert_eq!(look.transfer.name, ["shells", "cubus", "cloud"][time as usize]);
            let load = until("the end of the load", || {
                client
                    .talk()
                    .selection
                    .load()
                    .filter(|l| l.state == LoadState::Done && l.part == at(time).unwrap())
            });
            assert_eq!(load.is_own, std::ptr::eq(client, &asking));
        }
    }
    // Who comes later is told at once of what is shown then.
    asking.talk().selection.open(at(2));
    picture_of(&asking, 2);
    let late = stage.viewer();
    assert_eq!(late.talk().link.description().unwrap().volume.dims, [16; 3]);
    assert!(greatest_difference(&picture_of(&late, 2), &picture_of(&asking, 2)) <= 1);
    assert!(late.talk().selection.load().is_none(), "what was read before is no news");
    stage.end();
}

#[test]
fn a_look_that_was_chosen_stays_over_a_change() {
    let stage = stage(false);
    let (choosing, other) = (stage.viewer(), stage.viewer());
    picture_of(&choosing, 0);
    choosing.set_look(Look::new(load_transfer("ct").unwrap())).unwrap();
    until("the look", || choosing.talk().look.in_force().filter(|(_, look)| look.transfer.name == "ct"));
    other.talk().selection.open(at(1));
    picture_of(&choosing, 1);
    picture_of(&other, 1);
    assert_eq!(choosing.talk().look.in_force().unwrap().1.transfer.name, "ct");
    assert_eq!(other.talk().look.in_force().unwrap().1.transfer.name, "cubus");
    // And one can be taken back that the volume before came with.
    other.set_look(Look::new(load_transfer("shells").unwrap())).unwrap();
    until("the look", || other.talk().look.in_force().filter(|(_, look)| look.transfer.name == "shells"));
    stage.end();
}

#[test]
fn a_look_that_nobody_chose_stays_over_times_and_gives_way_to_that_of_another_channel() {
    let stage = stage(false);
    let viewer = stage.viewer();
    picture_of(&viewer, 0);
    let name_and_domain = || {
        let transfer = &viewer.talk().look.in_force().unwrap().1.transfer;
        (transfer.name.clone(), transfer.domain)
    };
    viewer.talk().selection.open(Some(Part { channel: Some(0), ..at(1).unwrap() }));
    picture_of(&viewer, 1);
    let first = volume(0);
    let kept = load_transfer("shells").unwrap().at_values(&first, &Histogram::of(&first)).domain;
    assert!(matches!(kept, Domain::Values(..)), "{kept:?}");
    assert_eq!(name_and_domain(), ("shells".into(), kept));
    viewer.talk().selection.open(at(2));
    picture_of(&viewer, 2);
    assert_eq!(name_and_domain(), ("cloud".into(), load_transfer("cloud").unwrap().domain));
    stage.end();
}

#[test]
fn a_load_that_is_refused_or_cancelled_leaves_all_as_it_was() {
    let stage = stage(true);
    let (asking, watching) = (stage.viewer(), stage.viewer());
    let both = [&asking, &watching];
    let before = both.map(|c| picture_of(c, 0));
    let dims = asking.talk().link.description().unwrap().volume.dims;
    let version = asking.talk().look.in_force().unwrap().0;
    let ended = |state: LoadState| {
        for client in both {
            let load = until("the end of a load", || {
                client.talk().selection.load().filter(|l| !matches!(l.state, LoadState::Reading { .. }))
            });
            assert_eq!(load.state, state);
            assert_eq!(
                (time_of(client), client.talk().link.description().unwrap().volume.dims),
                (Some(0), dims)
            );
            assert_eq!(client.talk().look.in_force().unwrap().0, version, "no frame is to be made anew");
        }
    };
    asking.talk().selection.open(at(9));
    ended(LoadState::Failed("film: there is no such time".into()));

    let half = |client: &Client| {
        until("half of a load", || {
            client.talk().selection.load().filter(|l| l.state == LoadState::Reading { permille: 500 })
        })
    };
    asking.talk().selection.open(at(1));
    let loads = both.map(half);
    assert_eq!((loads[0].bytes_needed, loads[0].is_own, loads[1].is_own), (4711, true, false));
    // While it is read, poses are answered.
    let moved = asking.set_pose(Pose::orbit(Vec3::ZERO, 0.6, 0.2, 6.0), SIZE);
    until("a frame while a part is read", || asking.latest_frame().filter(|f| f.frame.header.pose == moved));
    // Anybody may say that it is not wanted.
    watching.talk().selection.open(None);
    ended(LoadState::Cancelled);
    asking.set_pose(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 6.0), SIZE);
    for (client, before) in both.into_iter().zip(&before) {
        until("the picture as before", || client.latest_frame().filter(|f| f.frame.flatten() == *before));
    }

    // The newest wish ends the one before.
    asking.talk().selection.open(at(1));
    half(&asking);
    watching.talk().selection.open(at(2));
    until("the newer load", || {
        asking
            .talk()
            .selection
            .load()
            .filter(|l| l.part == at(2).unwrap() && l.state == LoadState::Reading { permille: 500 })
    });
    stage.gate.send(()).unwrap();
    for client in both {
        picture_of(client, 2);
    }
    assert_eq!(*stage.film.num_cancelled.lock().unwrap(), 2);
    stage.end();
}
