//! What frames do on each link.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use quinn::congestion::CubicConfig;

use super::*;
use crate::identity::{SERVER_NAME, pinned_tls, quic_client, quic_server};

const SECOND: Duration = Duration::from_secs(1);

/// Prints one row of the table for each link: `cargo test -p isinglass-net --release networks_table -- --ignored
/// --nocapture`.
#[test]
#[ignore = "prints a table"]
fn networks_table() {
    println!(
        "| link | control | age p50/p99 ms | bound | frames/s | sent Mbit/s | queue p95 ms | lost+dropped |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for mbit in [5.0, 20.0, 50.0, 100.0] {
        for rtt_ms in [20, 40, 150, 300] {
            for loss in [0.0, 0.01, 0.02] {
                row(mbit, rtt_ms, loss);
            }
        }
    }
}

/// What one viewer had on a link, from the fifth second of its movement on.
#[derive(Debug)]
struct Run {
    /// Median and 99th percentile.
    age_ms: [f64; 2],
    /// What the 99th percentile should not exceed.
    bound_ms: f64,
    frames_per_second: f64,
    sent_mbit: f64,
    queue_ms: f64,
    num_lost: u64,
    num_dropped: u64,
}

impl Run {
    fn of(model: LinkModel, congestion: Option<Arc<dyn ControllerFactory + Send + Sync>>) -> Self {
        let (rtt_ms, mbit) = (model.rtt.as_secs_f64() * 1e3, model.bandwidth_mbit.unwrap_or(f64::INFINITY));
        let (shown, mut traffic) = one_viewer(model, congestion, 14 * SECOND, SECOND / 2);
        let (from, to) = (4e3, 14e3);
        traffic.queue_micros.sort_unstable();
        let frames_per_second = shown.frames_per_second(from, to);
        let wire_ms = shown.bytes as f64 / shown.frames.len().max(1) as f64 * 8.0 / mbit / 1e3;
        Self {
            age_ms: [shown.age(0.5, from, to), shown.age(0.99, from, to)],
            bound_ms: rtt_ms + 1.5e3 / frames_per_second.max(1.0) + wire_ms + 25.0,
            frames_per_second,
            sent_mbit: traffic.bytes as f64 * 8.0 / 14.5e6,
            queue_ms: traffic.queue_micros[traffic.queue_micros.len() * 95 / 100] as f64 / 1e3,
            num_lost: traffic.lost,
            num_dropped: traffic.dropped,
        }
    }
}

fn row(mbit: f64, rtt_ms: u64, loss: f64) {
    let congestions: [(&str, Option<Arc<dyn ControllerFactory + Send + Sync>>); 2] =
        [("delay", None), ("CUBIC", Some(Arc::new(CubicConfig::default())))];
    for (name, congestion) in congestions {
        let Run {
            age_ms: [p50, p99],
            bound_ms,
            frames_per_second,
            sent_mbit,
            queue_ms,
            num_lost,
            num_dropped,
        } = Run::of(link_model(mbit, rtt_ms, loss), congestion);
        let percent = loss * 100.0;
        println!(
            "| {mbit} Mbit/s, {rtt_ms} ms, {percent} % | {name} | {p50:.0}/{p99:.0} | {bound_ms:.0} | \
             {frames_per_second:.0} | {sent_mbit:.1} | {queue_ms:.0} | {num_lost}+{num_dropped} |"
        );
    }
}

/// The links on which the bound must hold, as an ordinary test.
#[test]
fn frames_are_as_old_as_the_link_makes_them() {
    for (mbit, rtt_ms, loss) in
        [(5.0, 20, 0.0), (20.0, 40, 0.0), (20.0, 150, 0.01), (50.0, 150, 0.02), (100.0, 300, 0.01)]
    {
        let run = Run::of(link_model(mbit, rtt_ms, loss), None);
        assert!(run.age_ms[1] <= run.bound_ms, "{mbit} Mbit/s, {rtt_ms} ms, {loss}: {run:?}");
        assert!(run.frames_per_second >= 55.0, "{run:?}");
        assert!(run.queue_ms <= 30.0 && run.sent_mbit <= 1.1 * mbit, "{run:?}");
    }
    // The control: CUBIC fills the queue, and takes each loss for one.
    for (mbit, rtt_ms, loss) in [(20.0, 40, 0.0), (50.0, 150, 0.02)] {
        let run = Run::of(link_model(mbit, rtt_ms, loss), Some(Arc::new(CubicConfig::default())));
        assert!(run.age_ms[1] > 1.5 * run.bound_ms && run.frames_per_second < 40.0, "{run:?}");
    }
}

/// A bulk transfer with CUBIC from the server's machine; returns the number of bytes that have arrived, for ever.
async fn bulk(network: Network) -> Arc<AtomicU64> {
    let [from, to]: [SocketAddr; 2] = [([10, 0, 0, 1], 9000).into(), ([10, 0, 1, 1], 9000).into()];
    let mut transport = quinn::TransportConfig::default();
    transport
        .congestion_controller_factory(Arc::new(CubicConfig::default()))
        .receive_window((16u32 << 20).into())
        .stream_receive_window((16u32 << 20).into());
    let transport = Arc::new(transport);
    let identity = Identity::generate().expect("random numbers");
    let mut config = quic_server(identity.tls().expect("TLS")).expect("TLS");
    config.transport_config(transport.clone());
    let runtime = Arc::new(TokioRuntime);
    let server =
        Endpoint::new_with_abstract_socket(seeded(91), Some(config), network.socket(from), runtime.clone());
    let client = Endpoint::new_with_abstract_socket(seeded(92), None, network.socket(to), runtime);
    let (server, client) = (server.expect("a socket"), client.expect("a socket"));
    let (tls, _) = pinned_tls(identity.fingerprint()).expect("TLS");
    let mut config = quic_client(tls).expect("TLS");
    config.transport_config(transport);
    let connecting = client.connect_with(config, from, SERVER_NAME).expect("an address");
    let accepted = async { server.accept().await.expect("a connection").await };
    let (sending, receiving) = tokio::join!(accepted, connecting);
    let (sending, receiving) = (sending.expect("a connection"), receiving.expect("a connection"));
    let arrived = Arc::<AtomicU64>::default();
    let counted = arrived.clone();
    tokio::spawn(async move {
        let mut stream = sending.open_uni().await.expect("a stream");
        while stream.write_all(&[0; 16_384]).await.is_ok() {}
        drop(server);
    });
    tokio::spawn(async move {
        let mut stream = receiving.accept_uni().await.expect("a stream");
        while let Ok(Some(part)) = stream.read_chunk(usize::MAX, false).await {
            counted.fetch_add(part.bytes.len() as u64, Ordering::Relaxed);
        }
        drop(client);
    });
    arrived
}

#[test]
fn neither_starves_beside_a_bulk_transfer() {
    let (shown, traffic, bulk) = in_virtual_time(async {
        let mut world = World::new(&link_model(20.0, 40, 0.0), None);
        let links = world.serve(1, Renderer::default());
        let arrived = bulk(world.network.clone()).await;
        let client = world.viewer(&links[0]);
        let shown = model::view(client, 30 * SECOND, Duration::ZERO).await;
        (shown, world.network.traffic(), arrived.load(Ordering::Relaxed))
    });
    let mbit = |bytes: u64| bytes as f64 * 8.0 / 30e6;
    let (ours, fps) = (mbit(shown.bytes), shown.frames_per_second(5e3, 30e3));
    println!(
        "{ours:.1} of 20 Mbit/s, {fps:.0} frames/s, age {:.0}/{:.0} ms; bulk {:.1} Mbit/s, {} dropped",
        shown.age(0.5, 5e3, 30e3),
        shown.age(0.99, 5e3, 30e3),
        mbit(bulk),
        traffic.dropped
    );
    assert!(ours >= 6.0 && fps >= 30.0, "{ours} Mbit/s, {fps} frames a second");
    assert!(mbit(bulk) >= 4.0, "the other has {} Mbit/s", mbit(bulk));
}

/// Time from the link's return to the first newer picture, ms.
fn recovery_ms(outage: Duration, model: &LinkModel) -> f64 {
    in_virtual_time(async {
        let mut world = World::new(model, None);
        let links = world.serve(1, Renderer::default());
        let client = world.viewer(&links[0]);
        let network = world.network.clone();
        let begun = 6 * SECOND;
        tokio::spawn(async move {
            tokio::time::sleep(begun).await;
            network.set_dark(true);
            tokio::time::sleep(outage).await;
            network.set_dark(false);
        });
        let shown = model::view(client, begun + outage + 4 * SECOND, Duration::ZERO).await;
        let back_ms = (begun + outage).as_secs_f64() * 1e3;
        let next = shown.frames.iter().find(|(at, _)| *at > back_ms);
        let settled = shown.frames_per_second(back_ms + 2e3, back_ms + 4e3);
        assert!(settled > 50.0, "{settled} frames a second after an outage of {outage:?}");
        next.map_or(f64::INFINITY, |(at, _)| at - back_ms)
    })
}

#[test]
fn frames_come_back_soon_after_an_outage() {
    for outage_ms in [500, 2000, 5000, 30_000] {
        let ms = recovery_ms(Duration::from_millis(outage_ms), &link_model(20.0, 40, 0.0));
        println!("{outage_ms} ms: {ms:.0} ms");
        // Two round trips, and what a viewer that repeats its pose needs. After the longest the server has given the
        // place up, and the viewer connects again.
        assert!(
            ms <= if outage_ms < 8000 { 230.0 } else { 700.0 },
            "{ms} ms after an outage of {outage_ms} ms"
        );
    }
}

/// One viewer while the network changes after six seconds.
fn while_changing(model: &LinkModel, change: impl FnOnce(&Network) + Send + 'static) -> Shown {
    in_virtual_time(async {
        let mut world = World::new(model, None);
        let links = world.serve(1, Renderer::default());
        let client = world.viewer(&links[0]);
        let network = world.network.clone();
        tokio::spawn(async move {
            tokio::time::sleep(6 * SECOND).await;
            change(&network);
        });
        model::view(client, 12 * SECOND, Duration::ZERO).await
    })
}

#[test]
fn another_address_or_rate_is_followed() {
    let model = link_model(50.0, 40, 0.0);
    let moved = while_changing(&model, |network| {
        network.readdress(viewer_address(1), ([10, 0, 7, 7], 7777).into());
    });
    let (worst, settled) = (moved.age(1.0, 6e3, 8e3), moved.age(0.99, 8e3, 12e3));
    println!("another address: {worst:.0} ms at most, then {settled:.0} ms");
    assert!(worst < 250.0 && settled < 105.0, "{worst} {settled}");
    let narrow = link_model(10.0, 40, 0.0);
    let stepped = while_changing(&model, move |network| network.set_model(&narrow));
    let (worst, settled) = (stepped.age(1.0, 6e3, 8e3), stepped.age(0.99, 8e3, 12e3));
    println!("from 50 to 10 Mbit/s: {worst:.0} ms at most, then {settled:.0} ms");
    assert!(worst < 500.0 && settled < 110.0, "{worst} {settled}");
}

#[test]
fn viewers_share_a_link_fairly() {
    let shown = in_virtual_time(async {
        let mut world = World::new(&link_model(50.0, 40, 0.0), None);
        let links = world.serve(8, Renderer::default());
        let clients: Vec<_> = links.iter().map(|link| world.viewer(link)).collect();
        let viewing = clients.into_iter().map(|c| tokio::spawn(model::view(c, 14 * SECOND, Duration::ZERO)));
        let mut shown = vec![];
        for viewer in viewing.collect::<Vec<_>>() {
            shown.push(viewer.await.expect("a viewer"));
        }
        shown
    });
    let ages: Vec<f64> = shown.iter().map(|shown| shown.age(0.5, 4e3, 14e3)).collect();
    let mean = ages.iter().sum::<f64>() / ages.len() as f64;
    let rates: Vec<f64> = shown.iter().map(|shown| shown.frames_per_second(4e3, 14e3)).collect();
    println!("ages {ages:.0?} ms, {rates:.0?} frames/s");
    assert!(
        ages.iter().all(|age| *age <= 2.0 * mean) && rates.iter().all(|rate| *rate > 20.0),
        "{ages:?} {rates:?}"
    );
}

/// A viewer comes for the first time, and then again: its ages in the first two seconds, ms.
fn ages_at_first(model: &LinkModel) -> [f64; 2] {
    in_virtual_time(async {
        let mut world = World::new(model, None);
        let links = world.serve(2, Renderer::default());
        let mut ages = [0.0; 2];
        for (link, age) in links.iter().zip(&mut ages) {
            let client = world.viewer(link);
            let shown = model::view(client, 8 * SECOND, Duration::ZERO).await;
            *age = shown.age(0.5, 0.0, 2e3);
            tokio::time::sleep(SECOND).await;
        }
        ages
    })
}

#[test]
fn a_session_starts_with_what_the_last_one_showed() {
    for (mbit, rtt_ms) in [(20.0, 40), (50.0, 150), (100.0, 300)] {
        let [stranger, known] = ages_at_first(&link_model(mbit, rtt_ms, 0.0));
        println!("{mbit} Mbit/s, {rtt_ms} ms: {stranger:.0} ms at first, {known:.0} ms when it comes again");
        assert!(known <= stranger + 1.0, "{known} {stranger}");
    }
}

#[test]
fn the_same_seed_is_the_same_run() {
    let model = |seed| LinkModel { seed, ..link_model(20.0, 40, 0.01) };
    let run = |seed| one_viewer(model(seed), None, 3 * SECOND, SECOND);
    let [a, b, c] = [7, 7, 8].map(run);
    assert_eq!((a.1.digest, &a.0.ages), (b.1.digest, &b.0.ages));
    assert_ne!(a.1.digest, c.1.digest);
}

#[test]
fn a_rest_becomes_exact_on_a_lossy_link() {
    let (shown, _) = one_viewer(link_model(50.0, 150, 0.02), None, 4 * SECOND, 2 * SECOND);
    let exact = shown.exact.iter().find(|at| **at > 4e3);
    assert!(exact.is_some_and(|at| *at < 6e3), "{:?}", shown.exact);
}
