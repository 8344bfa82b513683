//! Do the viewers of a server see another time of its file when one of them asks, within the memory that was allowed?

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use std::io::{BufRead, BufReader};
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::picture::Picture;
use isinglass_core::transfer::Domain;
use isinglass_core::wire::{LoadState, Part};
use isinglass_net::{Client, ClientOptions};

use common::Bench;

/// Voxels along each side.
const SIDE: usize = 16;

/// A NIfTI-1 file of three times: a ball of 1000 + time, at another place each time.
fn film() -> Vec<u8> {
    let mut header = vec![0; 352];
    let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    for (i, dim) in [4i16, 16, 16, 16, 3, 1, 1, 1].iter().enumerate() {
        put(40 + 2 * i, &dim.to_le_bytes());
    }
    put(70, &512i16.to_le_bytes());
    put(72, &16i16.to_le_bytes());
    for i in 0..5 {
        put(76 + 4 * i, &1f32.to_le_bytes());
    }
    put(108, &352f32.to_le_bytes());
    put(344, b"n+1\0");
    let voxels = (0..3 * SIDE.pow(3)).flat_map(|i| {
        let (time, i) = (i / SIDE.pow(3), i % SIDE.pow(3));
        let [x, y, z] = [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE].map(|n| n as f32 - 7.5);
        let is_inside = (x - 4.0 * time as f32 + 4.0).powi(2) + y * y + z * z < 9.0;
        (if is_inside { 1000 + time as u16 } else { 0 }).to_le_bytes()
    });
    header.extend(voxels);
    header
}

/// A server that ends with the test.
struct Served(Child, Vec<String>);

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn serve(bench: &Bench, flags: &str) -> Served {
    let line =
        format!("serve film.nii --listen 127.0.0.1:0 --viewers 2 --backend cpu --json --codec exact {flags}");
    let child = bench.command(&line).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let mut served = Served(child, Vec::new());
    let mut text = String::new();
    for line in BufReader::new(served.0.stdout.take().unwrap()).lines() {
        text += &line.unwrap();
        if let Ok(json) = serde_json::from_str::<serde_json::Value>(&text) {
            let links = json["links"].as_array().unwrap();
            served.1 = links.iter().map(|l| l.as_str().unwrap().to_owned()).collect();
            return served;
        }
    }
    panic!("no links: {text}");
}

/// A server goes on when viewers leave, and the next one needs another link.
#[cfg(unix)]
#[test]
fn who_leaves_makes_room_for_another_link_and_a_polite_signal_ends_it() {
    let bench = Bench::new();
    let line = "serve builtin:shells@16 --listen 127.0.0.1:0 --backend cpu --json";
    let child = bench.command(line).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let mut served = Served(child, Vec::new());
    let mut lines = BufReader::new(served.0.stdout.take().unwrap()).lines();
    let mut next = || {
        let told: serde_json::Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
        let links = told["links"].as_array().unwrap();
        assert_eq!(links.len(), 1, "{told}");
        links[0].as_str().unwrap().to_owned()
    };
    let first = next();
    drop(viewer(&first));
    let second = next();
    assert_ne!(first, second);
    let here = viewer(&second);
    let pid = served.0.id().to_string();
    assert!(std::process::Command::new("kill").arg(&pid).status().unwrap().success());
    assert!(served.0.wait().unwrap().success());
    drop(here);
}

fn viewer(link: &str) -> Client {
    let client = Client::connect(&link.parse().unwrap(), ClientOptions::default()).unwrap();
    client.wait_connected(Duration::from_secs(30)).unwrap();
    let size = Intrinsics::perspective(40, 40, 0.6);
    client.set_pose(Pose::orbit(Vec3::ZERO, 0.0, 0.0, 50.0), size);
    client
}

fn until<T>(what: &str, mut found: impl FnMut() -> Option<T>) -> T {
    let patience = Instant::now() + Duration::from_secs(60);
    loop {
        if let Some(found) = found() {
            return found;
        }
        assert!(Instant::now() < patience, "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The picture of a time, which must be the one that is described.
fn picture_of(client: &Client, time: u32) -> Picture {
    until("the picture of a time", || {
        let frame = client.latest_frame()?;
        let is_wanted = client.talk().selection.choices()?.shown.time == Some(time);
        (is_wanted && frame.is_of(&client.talk())).then(|| frame.frame.flatten())
    })
}

/// Where the matter is, from left to right, as a share of the picture.
fn middle(picture: &Picture) -> f32 {
    let mut sum = [0.0; 2];
    for (i, pixel) in picture.pixels.iter().enumerate() {
        let x = (i % picture.width as usize) as f32 + 0.5;
        sum[0] += pixel[3] * x;
        sum[1] += pixel[3];
    }
    sum[0] / sum[1] / picture.width as f32
}

fn refusal_of(client: &Client, part: Part) -> String {
    client.talk().selection.open(Some(part));
    until("a refusal", || match client.talk().selection.load().filter(|l| l.part == part)?.state {
        LoadState::Failed(problem) => Some(problem),
        LoadState::Reading { .. } | LoadState::Done | LoadState::Cancelled => None,
    })
}

#[test]
fn another_time_of_a_file_moves_the_matter_for_two_viewers() {
    let bench = Bench::new();
    bench.write("film.nii", film());
    let served = serve(&bench, "--time 1");
    let viewers = [&served.1[0], &served.1[1]].map(|link| viewer(link));
    let parts = until("parts", || viewers[1].talk().selection.choices());
    assert_eq!((parts.num_times, parts.num_channels, parts.shown.time), (3, 1, Some(1)));
    assert_eq!(parts.bytes_in_memory, 3 * SIDE.pow(3) as u64);
    for (time, place) in [(1, 0.5), (2, 0.7), (0, 0.3)] {
        viewers[0].talk().selection.open(Some(Part { time: Some(time), ..parts.shown }));
        for client in &viewers {
            let found = middle(&picture_of(client, time));
            // NIfTI's x runs to the right of a body, which is seen from the front; a pixel is .025.
            assert!((found - place).abs() < 0.1 || (found - 1.0 + place).abs() < 0.1, "{time}: {found}");
            let volume = client.talk().link.description().unwrap().volume.clone();
            assert_eq!((volume.dims, volume.value_range.1), ([16; 3], 1000.0 + time as f32));
        }
    }
    // What has one value has one colour at all times, whichever of them the curve was made for.
    let domain = viewers[0].talk().look.in_force().unwrap().1.transfer.domain;
    assert!(matches!(domain, Domain::Values(..)), "{domain:?}");
    let [ends, middle_time] = [0, 1].map(|time| {
        viewers[1].talk().selection.open(Some(Part { time: Some(time), ..parts.shown }));
        middle(&picture_of(&viewers[1], time))
    });
    assert_eq!(viewers[0].talk().look.in_force().unwrap().1.transfer.domain, domain);
    assert!((ends - middle_time).abs() > 0.1, "the control: {ends} and {middle_time}");
    let problem = refusal_of(&viewers[0], Part { time: Some(3), ..parts.shown });
    assert_eq!(problem, "film.nii: time 3 was asked for, expected 0 to 2");
    assert_eq!(viewers[0].talk().selection.choices().unwrap().shown.time, Some(1));
}

/// A time takes 12 kB and as much while it is read: two at a time do not fit into 20 kB.
#[test]
fn a_part_without_room_or_leave_is_refused() {
    let bench = Bench::new();
    bench.write("film.nii", film());
    let served = serve(&bench, "--max-memory 20kB");
    let client = viewer(&served.1[0]);
    let shown = until("parts", || client.talk().selection.choices()).shown;
    let problem = refusal_of(&client, Part { time: Some(1), ..shown });
    assert_eq!(
        problem,
        "film.nii: needs 12 kB of memory beside 12 kB of what is shown, expected at most 20 kB in all (--max-memory)"
    );
    assert_eq!(client.talk().selection.choices().unwrap().shown.time, Some(0));
    drop(served);

    let served = serve(&bench, "--fixed");
    let client = viewer(&served.1[0]);
    let problem = refusal_of(&client, Part { time: Some(1), ..shown });
    assert_eq!(problem, "this server shows this part of its file only");
    assert!(client.talk().selection.choices().is_none(), "and offers no other");
    drop(served);
    let words = ["film.nii: needs 12 kB of memory, expected at most 5 kB in all", "--max-memory"];
    bench.fails("serve film.nii --max-memory 5kB", 1, &words);
    bench.fails("serve film.nii --max-memory lots", 2, &["expected a size such as 12GB"]);
}
