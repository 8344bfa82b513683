//! What a display loop asks of the network, put down without waiting: the newest of each wish, in cells that nobody locks.
//!
//! The network's own channels take locks, which their readers hold for moments; a display loop that met one would stand still.
//! So a thread of its own, the messenger, carries the wishes over: it sleeps until it is woken, which waits for nothing either.

use std::sync::atomic::{AtomicU8, AtomicU32, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::{self, Thread};

use arc_swap::ArcSwapOption;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::{PoseId, ProbeId, ShotId};
use isinglass_core::look::Look;
use isinglass_core::wire::{ClientStats, MAX_SHOWN_TURN_DEG, Part, PoseRequest, ProbeRequest, ShotRequest};

use super::{Shared, shot};

/// See the module.
#[derive(Default)]
pub(super) struct Wishes {
    /// The newest, which stays: the next one is numbered after it.
    pose: ArcSwapOption<PoseRequest>,
    /// Whole degrees and one; 0 where it is none.
    shown_turn: AtomicU8,
    look: ArcSwapOption<Look>,
    /// Its inside is none where it is a wish for no other part.
    part: ArcSwapOption<Option<Part>>,
    report: ArcSwapOption<ClientStats>,
    probe: ArcSwapOption<ProbeRequest>,
    newest_probe: AtomicU32,
    /// Its inside is none where the picture is no longer wanted.
    shot: ArcSwapOption<Option<ShotRequest>>,
    newest_shot: AtomicU32,
    /// Whoever carries them over.
    pub(super) messenger: OnceLock<Thread>,
}

impl Wishes {
    pub(super) fn pose(&self, now_micros: u64, pose: Pose, intrinsics: Intrinsics) -> PoseId {
        let mut number = PoseId(0);
        self.pose.rcu(|newest| {
            number = newest.as_ref().map_or(PoseId(0), |p| p.id);
            if newest.as_ref().is_some_and(|p| p.pose == pose && p.intrinsics == intrinsics) {
                return newest.clone();
            }
            let stamp_micros = now_micros;
            let request = PoseRequest {
                id: number.next(),
                stamp_micros,
                pose,
                intrinsics,
                newest_complete: None,
                shown_turn_deg: None,
                decode_nanos_per_list: 0,
            };
            if let Err(e) = request.validate() {
                tracing::warn!("pose ignored: {e}");
                return newest.clone();
            }
            number = request.id;
            Some(Arc::new(request))
        });
        self.knock();
        number
    }

    /// Goes with all datagrams from now on.
    pub(super) fn note_turn(&self, degrees: Option<f32>) {
        let whole = |d: f32| d.round().clamp(0.0, MAX_SHOWN_TURN_DEG.into()) as u8 + 1;
        self.shown_turn.store(degrees.map_or(0, whole), Ordering::Relaxed);
    }

    /// As it was noted last.
    pub(super) fn shown_turn_deg(&self) -> Option<u8> {
        self.shown_turn.load(Ordering::Relaxed).checked_sub(1)
    }

    pub(super) fn look(&self, look: Look) {
        self.look.store(Some(Arc::new(look)));
        self.knock();
    }

    pub(super) fn part(&self, part: Option<Part>) {
        self.part.store(Some(Arc::new(part)));
        self.knock();
    }

    pub(super) fn report(&self, stats: ClientStats) {
        self.report.store(Some(Arc::new(stats)));
        self.knock();
    }

    pub(super) fn probe(&self, point: [f32; 3]) -> ProbeId {
        if !point.iter().all(|x| x.is_finite()) {
            return ProbeId(self.newest_probe.load(Ordering::Relaxed));
        }
        let id = ProbeId(self.newest_probe.fetch_add(1, Ordering::Relaxed).wrapping_add(1));
        self.probe.store(Some(Arc::new(ProbeRequest { id, point })));
        self.knock();
        id
    }

    pub(super) fn shot(&self, pose: Pose, intrinsics: Intrinsics, background: [u8; 3]) -> ShotId {
        let id = ShotId(self.newest_shot.fetch_add(1, Ordering::Relaxed).wrapping_add(1));
        // Its number is of no meaning here.
        let view = PoseRequest {
            id: PoseId(1),
            stamp_micros: 0,
            pose,
            intrinsics,
            newest_complete: None,
            shown_turn_deg: None,
            decode_nanos_per_list: 0,
        };
        let request = ShotRequest { id, view: view.encode().to_vec(), background };
        self.shot.store(Some(Arc::new(Some(request))));
        self.knock();
        id
    }

    pub(super) fn cancel_shot(&self) {
        self.shot.store(Some(Arc::new(None)));
        self.knock();
    }

    /// Wakes the messenger, without waiting for it.
    pub(super) fn knock(&self) {
        if let Some(messenger) = self.messenger.get() {
            messenger.unpark();
        }
    }
}

/// What the messenger does: carries wishes over until the client is stopped.
pub(super) fn carry(shared: &Shared) {
    let wishes = &shared.wishes;
    while !shared.is_stopping() {
        let newest = shared.pose.borrow().map(|p: PoseRequest| p.id);
        if let Some(pose) = wishes.pose.load_full().filter(|pose| Some(pose.id) != newest) {
            shared.pose.send_replace(Some(*pose));
        }
        if let Some(look) = wishes.look.swap(None) {
            shared.look.send_replace(Some(Arc::unwrap_or_clone(look)));
        }
        if let Some(part) = wishes.part.swap(None) {
            shared.part.send_replace(Some(*part));
        }
        if let Some(report) = wishes.report.swap(None) {
            shared.report.send_replace(Some(*report));
        }
        if let Some(probe) = wishes.probe.swap(None) {
            shared.probe.send_replace(Some(*probe));
        }
        if let Some(wish) = wishes.shot.swap(None) {
            carry_shot(shared, Arc::unwrap_or_clone(wish));
        }
        thread::park();
    }
}

fn carry_shot(shared: &Shared, wish: Option<ShotRequest>) {
    let Some(request) = wish else {
        shared.shot.send_if_modified(|waiting| waiting.take().is_some());
        return;
    };
    let (id, view) = (request.id, request.view());
    shared.shot.send_replace(Some(request));
    if let Err(e) = view {
        shot::settle(shared, id, Err(e.to_string()));
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::sync_channel;
    use std::time::{Duration, Instant};

    use glam::Vec3;
    use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};

    use crate::client::{Client, ClientOptions};

    use super::*;

    fn look() -> Look {
        let point = |x: f32| ControlPoint { x, color: [1.0; 3], opacity: x };
        let points = vec![point(0.0), point(1.0)];
        let (domain, unit_length) = (Domain::Full, UnitLength::Voxel);
        Look::new(TransferFunction { name: "ramp".into(), domain, unit_length, points })
    }

    /// Every wish that a display loop has, from another thread; nothing answers at the address.
    #[test]
    fn wishes_are_put_down_while_others_hold_the_locks_of_all_channels_and_are_carried_over_later() {
        let (token, cert) = ("0".repeat(32), "ab".repeat(32));
        let link = format!("isinglass://127.0.0.1:9/#token={token}&cert=sha256:{cert}");
        let client = Client::connect(&link.parse().unwrap(), ClientOptions::default()).unwrap();
        let shared = &client.shared.clone();
        let (pose, view) = (Pose::orbit(Vec3::ZERO, 0.3, 0.2, 6.0), Intrinsics::perspective(48, 40, 0.6));
        let _client = thread::scope(|scope| {
            // As a reader in the network's thread holds them.
            let held = (
                (shared.pose.borrow(), shared.look.borrow(), shared.part.borrow()),
                (shared.report.borrow(), shared.probe.borrow(), shared.shot.borrow()),
            );
            let (done, is_done) = sync_channel(1);
            let wisher = scope.spawn(move || {
                // More than once: the messenger itself stands at the first lock by then.
                for i in 0..50 {
                    client.set_pose(Pose { eye: pose.eye * (1.0 + i as f32), ..pose }, view);
                    client.set_look(look()).unwrap();
                    client.open_part(None);
                    client.report(ClientStats::default());
                    client.probe([0.0; 3]);
                    client.shoot(pose, view, [0; 3]);
                    client.cancel_shot();
                    thread::sleep(Duration::from_millis(1));
                }
                done.send(()).unwrap();
                client
            });
            is_done.recv_timeout(Duration::from_secs(60)).expect("no wish meets a lock");
            assert!(held.0.0.is_none(), "nothing went around the lock");
            // The control: the channels' own way in does meet it.
            let (done, is_done) = sync_channel(1);
            scope.spawn(move || {
                shared.report.send_modify(|_| ());
                done.send(()).unwrap();
            });
            assert!(is_done.recv_timeout(Duration::from_millis(50)).is_err());
            drop(held);
            is_done.recv_timeout(Duration::from_secs(60)).expect("it was that lock");
            wisher.join().unwrap()
        });
        let newest = pose.eye * 50.0;
        let patience = Instant::now() + Duration::from_secs(60);
        let has_arrived = || {
            shared.pose.borrow().is_some_and(|p| p.pose.eye == newest)
                && shared.look.borrow().is_some()
                && shared.part.borrow().is_some()
                && shared.report.borrow().is_some()
                && shared.probe.borrow().is_some()
        };
        while !has_arrived() {
            assert!(Instant::now() < patience, "the messenger has stopped");
            thread::sleep(Duration::from_millis(2));
        }
    }
}
