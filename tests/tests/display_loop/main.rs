//! Does the display loop wait for anything: the network, a disk, a lock?
//!
//! A real window on a real connection, while frames arrive, looks change, another volume is read from a file, the server goes
//! away, and another one comes in its place. What is counted is how many refreshes, from their first look at the source on, gave up their core to wait, as the system
//! says (`waits.rs`), so the machine's load hardly matters. Only waits at the locks of the system's allocator
//! are excused, and counted by themselves. Like `viewer.rs` it needs a display, and runs on the main thread; the count is
//! Linux's.
#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test without the harness that would allow both"
)]

mod allocator;
mod backstage;
mod waits;

use std::cell::{OnceCell, RefCell};
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use isinglass_client::{FrameSource, Probe, ScriptStep, WindowOptions, display_available, run_window};
use isinglass_core::ids::FrameId;
use isinglass_core::session::ClientSession;
use isinglass_core::wire::Part;
use isinglass_net::{Client, Clock, LinkStats, ReceivedFrame, State, Talking};

use backstage::Backstage;
use waits::{Waits, begin_refresh};

fn main() {
    if !display_available() {
        assert!(
            std::env::var("ISINGLASS_STRICT").as_deref() != Ok("1"),
            "no display: DISPLAY names no X server that answers"
        );
        println!("skipped: no display (run under xvfb-run to open the window)");
        return;
    }
    if !cfg!(target_os = "linux") {
        println!("skipped: this system does not count what a thread waits for");
        return;
    }
    // The program itself shall not be read from the disk in the middle of a refresh, when a part of it is first needed.
    let mut program = std::fs::File::open("/proc/self/exe").unwrap();
    std::io::copy(&mut program, &mut std::io::sink()).unwrap();
    allocator::tell_waits_of_this_thread();
    let seen = play(Duration::ZERO);
    println!("{seen:?}");
    seen.assert_whole();
    // The kernel lets a thread wait for a page of the program, or for the map of memory while another thread changes it: on two
    // loaded cores 1 to 8 refreshes of 151 meet that. A wait of ours would be met at each look, which is every tenth refresh,
    // or at each refresh, as the control below is.
    assert!(seen.waits.waited * 15 <= seen.waits.refreshes, "refreshes wait: {seen:?}");
    // Who meets at the allocator's locks, and how often, is the system's matter; at every refresh it would be ours.
    assert!(seen.waits.excused * 4 <= seen.waits.refreshes, "{seen:?}");
    println!(
        "ok: refreshes do not wait while frames come, looks change, volumes are read and servers come and go"
    );

    // Negative control: a source that waits for its lock a thousandth of a second.
    let seen = play(Duration::from_millis(1));
    println!("{seen:?}");
    seen.assert_whole();
    assert!(seen.waits.waited * 10 >= seen.waits.refreshes * 9, "{seen:?}");
    println!("ok: a source that waits is seen");
}

/// What a window saw, from its first picture on.
#[derive(Debug, Default)]
struct Seen {
    waits: Waits,
    states: Vec<&'static str>,
    num_frames: usize,
    num_looks: usize,
    act: Act,
    /// The refreshes when it began.
    act_begun_at: u64,
    has_begun: bool,
}

/// What is going on behind the window. Each act lasts until its end has come, and at least [`REFRESHES`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum Act {
    /// A server's first volume.
    #[default]
    First,
    /// Another volume is read, until its frames are there.
    OtherVolume,
    /// The server has ended.
    NoServer,
    /// Another one starts, until its frames are there.
    OtherServer,
    Over,
}

impl Seen {
    fn assert_whole(&self) {
        assert_eq!(self.act, Act::Over, "{self:?}");
        for state in ["connected", "reconnecting"] {
            assert!(self.states.contains(&state), "{self:?}");
        }
        assert!(self.num_frames > 3 && self.num_looks > 6, "{self:?}");
    }

    fn note(&mut self, client: &Client) {
        let state = match client.state() {
            State::Connecting { .. } => "connecting",
            State::Connected => "connected",
            State::Reconnecting { .. } => "reconnecting",
            State::Refused(_) => "refused",
        };
        if !self.states.contains(&state) {
            self.states.push(state);
        }
    }
}

/// Turns the volume in a window, with another look at every tenth refresh, through all acts. Each refresh is held up for
/// `delay`.
fn play(delay: Duration) -> Seen {
    let seen = Rc::new(RefCell::new(Seen::default()));
    let clients = Rc::new(Clients::default());
    let backstage = Rc::new(RefCell::new(None::<Backstage>));
    let script = {
        let (seen, clients, backstage) = (seen.clone(), clients.clone(), backstage.clone());
        let mut newest = None;
        move |probe: &Probe| {
            let mut seen = seen.borrow_mut();
            let mut waits = seen.waits;
            waits.end_refresh();
            assert!(probe.now < Duration::from_secs(240), "{seen:?}");
            let backstage = backstage.borrow();
            let backstage = backstage.as_ref().unwrap();
            if let Some(next) = backstage.client() {
                clients.put(next);
                newest = None;
            }
            let Some(client) = clients.get() else { return ScriptStep::Continue };
            let frame = client.latest_frame();
            if frame.is_none() && !seen.has_begun {
                return ScriptStep::Continue;
            }
            (seen.has_begun, seen.waits) = (true, waits);
            seen.note(client);
            let number = frame.as_ref().map(|f| f.frame.header.frame);
            if number.is_some() && std::mem::replace(&mut newest, number) != number {
                seen.num_frames += 1;
            }
            let n = seen.waits.refreshes;
            if n.is_multiple_of(10) {
                let mut look = backstage::look();
                look.transfer.points[0].opacity = (n % 100) as f32 * 0.01;
                client.set_look(look).unwrap();
                seen.num_looks += 1;
            }
            if n < seen.act_begun_at + REFRESHES {
                return ScriptStep::Continue;
            }
            let time = client.talk().selection.choices().and_then(|parts| parts.shown.time);
            let has_frame = frame.is_some_and(|frame| frame.is_of(&client.talk()));
            let next = match seen.act {
                Act::First => {
                    client.talk().selection.open(Some(Part { time: Some(1), ..Part::default() }));
                    Act::OtherVolume
                }
                Act::OtherVolume if time == Some(1) && has_frame => {
                    backstage.end_server();
                    Act::NoServer
                }
                Act::NoServer if seen.states.contains(&"reconnecting") => {
                    backstage.start_server();
                    Act::OtherServer
                }
                Act::OtherServer if time == Some(0) && has_frame => Act::Over,
                Act::Over => return ScriptStep::Close,
                _ => return ScriptStep::Continue,
            };
            (seen.act, seen.act_begun_at) = (next, n);
            ScriptStep::Continue
        }
    };
    let options = WindowOptions {
        size: [320, 240],
        auto_orbit_degrees_per_second: 40.0,
        script: Some(Box::new(script)),
        ..Default::default()
    };
    let clock = Clock::start();
    run_window(options, clock.clone(), {
        let (clients, backstage) = (clients.clone(), backstage.clone());
        move |wake| {
            let servers = Backstage::new(clock, wake);
            servers.start_server();
            *backstage.borrow_mut() = Some(servers);
            Ok(DelayedSource { clients, nobody: Mutex::default(), delay })
        }
    })
    .unwrap();
    seen.take()
}

/// The clients of both servers, shared with the script. The one that came last counts.
#[derive(Default)]
struct Clients([OnceCell<Client>; 2]);

impl Clients {
    fn put(&self, client: Client) {
        let place = self.0.iter().find(|place| place.get().is_none()).expect("there are two servers");
        assert!(place.set(client).is_ok());
    }

    fn get(&self) -> Option<&Client> {
        self.0.iter().rev().find_map(OnceCell::get)
    }
}

struct DelayedSource {
    clients: Rc<Clients>,
    nobody: Mutex<ClientSession>,
    delay: Duration,
}

impl FrameSource for DelayedSource {
    /// Before there is a client, what is said is forgotten.
    fn talk(&self) -> Talking<'_, ClientSession> {
        begin_refresh();
        match self.clients.get() {
            Some(client) => client.talk(),
            None => Talking::alone(&self.nobody),
        }
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        begin_refresh();
        if !self.delay.is_zero() {
            std::thread::sleep(self.delay);
        }
        self.clients.get()?.latest_frame()
    }

    fn note_shown(&mut self, frame: FrameId) {
        if let Some(client) = self.clients.get() {
            client.note_shown(frame);
        }
    }

    fn state(&self) -> State {
        self.clients.get().map_or(State::Connecting { attempt: 1, problem: None }, |client| client.state())
    }

    fn stats(&self) -> LinkStats {
        self.clients.get().map(|client| client.stats()).unwrap_or_default()
    }
}

/// Refreshes of an act at least.
const REFRESHES: u64 = 30;
