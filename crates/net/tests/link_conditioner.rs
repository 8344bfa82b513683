//! Does the conditioner do to real QUIC what its model says?
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::time::Duration;

use common::*;
use isinglass_core::session::ledger::Stage;
use isinglass_net::conditioner::LinkCounters;
use isinglass_net::{Client, ClientError, ClientOptions, LinkModel};

async fn run(model: Option<LinkModel>, frames: u32) -> (Duration, LinkCounters) {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let client = Client::connect(&link, ClientOptions { conditioner: model, ..Default::default() }).unwrap();
    let mut least = Duration::MAX;
    for n in 1..=frames {
        let id = client.set_pose(pose(n), INTRINSICS);
        let received = until_answered(&client, id).await;
        let times = received.times;
        least = least.min(Duration::from_micros(
            times.at(Stage::FirstByteReceived).unwrap() - times.at(Stage::Asked).unwrap(),
        ));
    }
    until("a round-trip time", || (client.stats().rtt_micros > 0).then_some(())).await;
    (least, client.link_counters())
}

#[tokio::test(flavor = "multi_thread")]
async fn no_answer_comes_before_the_round_trip_is_over() {
    let rtt = Duration::from_millis(80);
    let model = LinkModel { rtt, jitter: Duration::from_millis(4), ..Default::default() };
    // From pose to first byte is a round trip and the frame's making. Packets are held until they are due and never
    // sent early, so the model's time is a lower bound without any tolerance; above it only the machine decides.
    let (least, counters) = run(Some(model), 5).await;
    assert!(least >= rtt, "{least:?}");
    assert!(counters.up.offered > 0 && counters.down.offered > 0);
    assert_eq!((counters.up.lost, counters.down.lost), (0, 0));
    // The same without a conditioner: were it not far below, the bound above would show nothing. The least of many,
    // because the machine may be busy.
    let (least, counters) = run(None, 20).await;
    assert!(least < rtt, "{least:?}");
    assert_eq!(counters, LinkCounters::default());
}

#[tokio::test(flavor = "multi_thread")]
async fn losses_are_counted_and_survived() {
    let model = LinkModel { loss: 0.1, seed: 11, ..Default::default() };
    let (_, counters) = run(Some(model), 10).await;
    for direction in [counters.up, counters.down] {
        // At least 40 packets go each way; that none of them is lost has a probability of 0.9⁴⁰ = 1.5 %, and the
        // draws of this seed are fixed: some of the first 40 of both directions are lost.
        assert!(direction.offered >= 40, "{direction:?}");
        assert!(direction.lost > 0, "{direction:?}");
        assert_eq!(direction.dropped, 0);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_narrow_pipe_drops_what_its_queue_cannot_hold() {
    let narrow = LinkModel {
        bandwidth_mbit: Some(2.0),
        queue: Duration::from_millis(15),
        rtt: Duration::from_millis(20),
        ..Default::default()
    };
    let wide = LinkModel { bandwidth_mbit: Some(10_000.0), ..narrow.clone() };
    assert!(run(Some(narrow), 6).await.1.down.dropped > 0);
    assert_eq!(run(Some(wide), 6).await.1.down.dropped, 0);
}

#[test]
fn an_unusable_model_is_named() {
    let link = format!("isinglass://127.0.0.1:1/#token={}&cert=sha256:{}", "0".repeat(32), "0".repeat(64));
    let model = LinkModel { loss: 2.0, ..Default::default() };
    let options = ClientOptions { conditioner: Some(model), ..Default::default() };
    let error = Client::connect(&link.parse().unwrap(), options).unwrap_err();
    assert!(matches!(error, ClientError::Conditioner(_)));
}
