//! Does a viewer get its frames, over a good link, a bad one, and after the connection was lost?
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::time::Duration;

use common::*;
use isinglass_core::codec::{
    self,
    blocks::{self, References},
};
use isinglass_core::ids::{FrameId, PoseId};
use isinglass_core::look::Look;
use isinglass_core::session::ledger::{Life, Stage};
use isinglass_core::wire::{Part, Refusal};
use isinglass_net::{Client, ClientOptions, ConnectError, Identity, LinkModel, Server, ServerOptions, State};

#[tokio::test(flavor = "multi_thread")]
async fn a_viewer_gets_the_exact_frame_for_its_pose() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let client = connect(&link);
    let id = client.set_pose(pose(3), INTRINSICS);
    let received = until_answered(&client, id).await;
    assert_eq!(client.state(), State::Connected);
    assert_eq!(client.talk().link.description().unwrap().volume, greeting().volume);
    // What arrives is what the codec makes of it, and of no other pose.
    let header = received.frame.header;
    let expected = |n| codec::decode(&bytes(encoded(header.frame, id, pose(n), INTRINSICS))).unwrap();
    assert_eq!(received.frame, expected(3));
    assert_ne!(received.frame, expected(4));
    // The ledger is in order, on one clock.
    let t = received.times;
    let stamps =
        [Stage::Asked, Stage::FirstByteReceived, Stage::Received, Stage::DecodingBegun, Stage::Decoded]
            .map(|s| t.at(s));
    assert!(stamps.iter().all(Option::is_some) && stamps.is_sorted(), "{t:?}");
    client.note_shown(header.frame);
    assert!(client.ledger().iter().any(|t| t.frame == header.frame && t.at(Stage::Shown).is_some()));
    until("statistics", || (client.stats().server.pose == id).then_some(())).await;
    assert_eq!(Some(client.stats().server.pose_stamp_micros), t.at(Stage::Asked));
}

fn bytes(frame: codec::EncodedFrame) -> Vec<Vec<u8>> {
    frame.chunks.into_iter().map(|c| c.bytes).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn how_far_frames_are_turned_reaches_the_server() {
    let mut server = server();
    let client = connect(&server.mint_link("127.0.0.1").unwrap());
    let session = server.accept().await.unwrap();
    for (noted, told) in [(None, None), (Some(7.4), Some(7)), (Some(500.0), Some(180)), (None, None)] {
        client.talk().pose.note_turn(noted);
        let id = client.set_pose(pose(told.unwrap_or(1).into()), INTRINSICS);
        let newest = || session.talk().pose.newest().filter(|p| p.id == id);
        assert_eq!(until("the pose", newest).await.shown_turn_deg, told, "{noted:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_look_reaches_the_server_and_comes_back() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let client = connect(&link);
    let mut wanted = look();
    wanted.shaded = true;
    client.set_look(wanted.clone()).unwrap();
    let (version, _) =
        until("the look", || client.talk().look.in_force().filter(|(_, l)| **l == wanted)).await;
    assert_eq!(version.0, 2);
    wanted.k = 99;
    assert!(client.set_look(wanted).is_err());
}

/// On a long way the look in force is still the first when the second thought comes; here no answer comes at all.
#[tokio::test(flavor = "multi_thread")]
async fn a_look_that_is_taken_back_at_once_is_taken_back() {
    let mut server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    let client = connect(&link);
    let session = server.accept().await.unwrap();
    until("the welcome", || (client.state() == State::Connected).then_some(())).await;
    for wanted in [Look { shaded: true, ..look() }, look()] {
        client.set_look(wanted.clone()).unwrap();
        let asked = until("the look", || session.talk().look.poll_wanted()).await;
        assert_eq!(asked, wanted);
    }
    // The same once more is nothing to ask for.
    client.set_look(look()).unwrap();
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert_eq!(session.talk().look.poll_wanted(), None);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_newest_pose_wins() {
    let mut server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    let client = connect(&link);
    let session = server.accept().await.unwrap();
    let mut last = PoseId(0);
    for n in 1..=40 {
        last = client.set_pose(pose(n), INTRINSICS);
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    assert_eq!(last, PoseId(40));
    assert_eq!(client.set_pose(pose(40), INTRINSICS), last, "the same pose is no new one");
    let newest = until("the last pose", || session.talk().pose.poll_new().filter(|p| p.id == last)).await;
    assert_eq!((newest.pose, newest.intrinsics), (pose(40), INTRINSICS));
    // At rest the pose is repeated, and the repetition is not a new pose.
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert_eq!(session.talk().pose.poll_new(), None);
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_arrive_whole_over_a_lossy_link() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let ms = Duration::from_millis;
    let model = LinkModel { rtt: ms(40), jitter: ms(5), loss: 0.05, reorder: true, ..Default::default() };
    let options = ClientOptions { conditioner: Some(model), ..Default::default() };
    let client = Client::connect(&link, options).unwrap();
    // Small frames: a loss-based controller gets little through at this loss.
    let small = isinglass_core::camera::Intrinsics { width: 32, height: 32, ..INTRINSICS };
    let mut shown = FrameId(0);
    for n in 1..=10 {
        let id = client.set_pose(pose(n), small);
        let received = until_answered(&client, id).await;
        let header = received.frame.header;
        assert!(header.frame > shown);
        shown = header.frame;
        assert_eq!(received.frame, codec::decode(&bytes(encoded(header.frame, id, pose(n), small))).unwrap());
    }
    let counters = client.link_counters();
    assert!(counters.up.lost + counters.down.lost > 0, "the link has lost nothing: {counters:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn newer_frames_do_not_starve_older_ones() {
    let mut server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    // A frame of this size takes over 30 ms at 10 Mbit/s; the offer is a frame each 10 ms.
    let size = isinglass_core::camera::Intrinsics { width: 128, height: 96, ..INTRINSICS };
    let model = LinkModel {
        rtt: Duration::from_millis(40),
        bandwidth_mbit: Some(10.0),
        queue: Duration::from_millis(100),
        ..Default::default()
    };
    let client =
        Client::connect(&link, ClientOptions { conditioner: Some(model), ..Default::default() }).unwrap();
    let session = server.accept().await.unwrap();
    client.set_pose(pose(1), INTRINSICS);
    let mut num_decoded = 0;
    let mut newest = FrameId(0);
    for n in 1..=12 {
        let encoded = encoded(FrameId(n), PoseId(n), pose(n), size);
        let length = encoded.num_bytes();
        assert!(length > 37_500, "{length} bytes do not take 30 ms");
        session.frames.send(FrameId(n), PoseId(n), encoded.chunks).await.unwrap();
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let shown = |n| client.latest_frame().filter(|f| f.frame.header.frame == FrameId(n));
    until("the last frame", || shown(12)).await;
    for life in client.ledger() {
        assert!(life.frame > newest);
        newest = life.frame;
        num_decoded += u32::from(life.at(Stage::Decoded).is_some());
    }
    assert!(num_decoded >= 6, "{num_decoded} of 12 frames: newer frames have starved the older");
    let known = || (session.talk().chunks.newest_complete() == FrameId(12)).then_some(());
    until("the acknowledgement of the last frame", known).await;
    // Frames that may finish before the next one all arrive.
    for n in 13..=16 {
        let encoded = encoded(FrameId(n), PoseId(n), pose(n), size);
        session.frames.send(FrameId(n), PoseId(n), encoded.chunks).await.unwrap();
        until("each frame", || shown(n)).await;
    }
    let is_decoded = |life: &&Life| life.frame > FrameId(12) && life.at(Stage::Decoded).is_some();
    assert_eq!(client.ledger().iter().filter(is_decoded).count(), 4);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dropped_connection_keeps_the_picture_and_comes_back() {
    let mut server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    let client = connect(&link);
    let id = client.set_pose(pose(1), INTRINSICS);
    let session = server.accept().await.unwrap();
    let control = session.control.clone();
    let serving = tokio::spawn(answer(session));
    let first = until_answered(&client, id).await;
    control.close("a test");
    until("the loss", || matches!(client.state(), State::Reconnecting { .. }).then_some(())).await;
    if let State::Reconnecting { problem, .. } = client.state() {
        assert_eq!(problem, ConnectError::Lost("a test".into()));
    }
    assert_eq!(client.latest_frame().unwrap().frame, first.frame);
    serving.await.unwrap();
    // The same viewer comes back with its ticket, and asks for its pose without being told to.
    let session = server.accept().await.unwrap();
    assert_eq!((session.id, session.viewer.0), (2, 0));
    tokio::spawn(answer(session));
    until("a frame of the second connection", || client.latest_frame().filter(|f| f.times.connection == 2))
        .await;
    let id = client.set_pose(pose(2), INTRINSICS);
    until_answered(&client, id).await;
    assert_eq!(client.state(), State::Connected);
}

/// Later it would change what all others see.
#[tokio::test(flavor = "multi_thread")]
async fn a_part_that_is_wished_for_without_a_connection_is_forgotten() {
    let mut server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    let client = connect(&link);
    let session = server.accept().await.unwrap();
    let control = session.control.clone();
    until("the welcome", || (client.state() == State::Connected).then_some(())).await;
    control.close("a test");
    until("the loss", || matches!(client.state(), State::Reconnecting { .. }).then_some(())).await;
    client.talk().selection.open(Some(Part { time: Some(1), ..Part::default() }));
    let session = server.accept().await.unwrap();
    until("the welcome", || (client.state() == State::Connected).then_some(())).await;
    // The control: one that is wished for now.
    let wanted = Part { time: Some(2), ..Part::default() };
    client.talk().selection.open(Some(wanted));
    let asked = until("the part", || session.talk().selection.poll_order()).await;
    assert_eq!(asked, Some(wanted));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_was_started_again_is_another_server() {
    let first = server();
    let address = first.local_addr().unwrap();
    let client = connect(&first.mint_link("127.0.0.1").unwrap());
    client.wait_connected(Duration::from_secs(20)).unwrap();
    first.close().await;
    drop(first);
    let identity = Identity::generate().unwrap();
    let again =
        until("the port", || Server::bind(address, &identity, ServerOptions::default(), greeting()).ok());
    let _again = again.await;
    let refused = until("the verdict", || match client.state() {
        State::Refused(problem) => Some(problem),
        _ => None,
    });
    assert!(
        matches!(refused.await, ConnectError::Certificate { found, .. } if found == identity.fingerprint())
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_link_lets_in_one_viewer() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    let other_link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let first = connect(&link);
    first.wait_connected(Duration::from_secs(20)).unwrap();
    let second = connect(&link);
    let refused = second.wait_connected(Duration::from_secs(20)).unwrap_err();
    assert_eq!(refused, ConnectError::Refused(Refusal::TokenUsed));
    assert_eq!(second.state(), State::Refused(refused));
    // The first one is not disturbed, and another link works.
    let id = first.set_pose(pose(1), INTRINSICS);
    until_answered(&first, id).await;
    connect(&other_link).wait_connected(Duration::from_secs(20)).unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_server_says_so_and_lets_in_the_next_when_one_leaves() {
    let server = server_with(ServerOptions { max_viewers: 1, ..ServerOptions::default() });
    let links = [0, 1].map(|_| server.mint_link("127.0.0.1").unwrap());
    serve(server);
    let first = connect(&links[0]);
    first.wait_connected(Duration::from_secs(20)).unwrap();
    // Who is sent away has not spent the link.
    let gone = connect(&links[1]);
    assert!(gone.wait_connected(Duration::from_secs(20)).is_err());
    drop(gone);
    let second = connect(&links[1]);
    let full = second.wait_connected(Duration::from_secs(20)).unwrap_err();
    assert_eq!(full, ConnectError::Refused(Refusal::Full(1)));
    drop(first);
    until("a place", || (second.state() == State::Connected).then_some(())).await;
}

/// Frames in blocks name the ones before: all must arrive for any to be shown, and a broken one heals.
#[tokio::test(flavor = "multi_thread")]
async fn predicted_frames_are_shown_and_a_lost_one_is_healed() {
    let mut server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    let ms = Duration::from_millis;
    let model = LinkModel { rtt: ms(20), jitter: ms(3), loss: 0.01, reorder: true, ..Default::default() };
    let client =
        Client::connect(&link, ClientOptions { conditioner: Some(model), ..Default::default() }).unwrap();
    let session = server.accept().await.unwrap();
    let settings = blocks::Settings::of(50);
    let size = isinglass_core::camera::Intrinsics { width: 48, height: 32, ..INTRINSICS };
    let mut sent = References::default();
    let (mut named, mut shown_predicted, mut withheld) = (0, 0, 0);
    for n in 1..=50u32 {
        let id = client.set_pose(pose(n), size);
        until("the pose", || session.talk().pose.newest().filter(|p| p.id == id)).await;
        let reference = sent.next(session.talk().chunks.reported()).cloned();
        let made = frame(FrameId(n), id, pose(n), size);
        let (encoded, decoded) = blocks::encode(&made, &settings, reference.as_deref()).unwrap();
        named += u32::from(reference.is_some());
        sent.insert(std::sync::Arc::new(decoded));
        if n == 8 {
            // Lost: those that name it, and those that name these, cannot be shown.
            continue;
        }
        session.frames.send(FrameId(n), id, encoded.chunks).await.unwrap();
        let names_what_was_lost = (9..=8 + HEALED_AFTER).contains(&n);
        if names_what_was_lost {
            tokio::time::sleep(ms(60)).await;
            withheld += u32::from(client.latest_frame().is_none_or(|f| f.frame.header.frame < FrameId(8)));
            continue;
        }
        let received = until_answered(&client, id).await;
        let expected = sent.newest().unwrap().to_frame();
        assert_eq!(received.frame, expected, "frame {n} from {:?}", reference.map(|r| r.frame()));
        shown_predicted += u32::from(n > 1);
    }
    assert!(named >= 48, "{named}");
    assert_eq!((withheld, shown_predicted), (HEALED_AFTER, 48 - HEALED_AFTER));
}

/// Frames that name a lost one, or each other, before the server goes back to one the viewer has.
const HEALED_AFTER: u32 = 24;
