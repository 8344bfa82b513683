//! Many viewers on one server, and a peer that means harm.

use isinglass_core::wire::Token;
use isinglass_core::wire::control::{self, hello};
use quinn::SendStream;
use rand::rngs::Xoshiro256PlusPlus;
use rand::{RngExt, SeedableRng};

use super::model::view;
use super::*;
use crate::identity::{SERVER_NAME, pinned_tls, quic_client};

const SECOND: Duration = Duration::from_secs(1);

/// Median ages and frames a second of viewers that share one link.
fn crowd(renderers: Vec<Renderer>) -> (Vec<f64>, Vec<f64>) {
    let shown = in_virtual_time(async {
        let mut world = World::new(&link_model(100.0, 40, 0.0), None);
        let links = world.serve_each(renderers);
        let clients: Vec<_> = links.iter().map(|link| world.viewer(link)).collect();
        let viewing = clients.into_iter().map(|c| tokio::spawn(view(c, 10 * SECOND, Duration::ZERO)));
        let mut shown = vec![];
        for viewer in viewing.collect::<Vec<_>>() {
            shown.push(viewer.await.expect("a viewer"));
        }
        shown
    });
    let of_each = |of: &dyn Fn(&Shown) -> f64| shown.iter().map(of).collect::<Vec<_>>();
    (of_each(&|s| s.age(0.5, 4e3, 10e3)), of_each(&|s| s.frames_per_second(4e3, 10e3)))
}

/// Whether all are alive, and at most one waits for twice the mean. In one run of fifty, a viewer that came into the
/// queue of all others sends too little to see its share, until the queue is drained.
fn is_fair((ages, rates): &(Vec<f64>, Vec<f64>)) -> bool {
    let mean = ages.iter().sum::<f64>() / ages.len() as f64;
    let num_late = ages.iter().filter(|age| **age > 2.0 * mean).count();
    num_late <= 1 && rates.iter().all(|rate| *rate >= 5.0)
}

#[test]
fn sixteen_viewers_are_all_served() {
    let sixteen = crowd(vec![Renderer::default(); 16]);
    println!("ages {:.0?} ms, {:.0?} frames/s", sixteen.0, sixteen.1);
    assert!(is_fair(&sixteen), "{sixteen:?}");
    // The control: two whose frames take half a second.
    let slow = Renderer { generate: SECOND / 2, ..Renderer::default() };
    let mut renderers = vec![Renderer::default(); 16];
    (renderers[3], renderers[9]) = (slow, slow);
    let two_wait = crowd(renderers);
    assert!(!is_fair(&two_wait), "{two_wait:?}");
}

/// What a stranger or a viewer does to harm others.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Harm {
    Nothing,
    /// Datagrams of noise, some of which look like the beginning of a connection.
    Garbage,
    /// Connections that are begun and left alone.
    Handshakes,
    /// Connections that say half a hello, or that a message of 4 GB follows.
    Giants,
    /// A viewer that is let in and reads nothing.
    Sloth,
    /// As many packets as the link takes. It is the control: no server can help there.
    Flood,
}

fn hostile_address(number: u16) -> SocketAddr {
    ([10, 0, 9, 9], 10_000 + number).into()
}

/// Does harm for ever.
async fn harm(world: (Network, Link, u64), harm: Harm) {
    let (network, link, seed) = world;
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let noise = |rng: &mut Xoshiro256PlusPlus, length: usize| -> Vec<u8> {
        (0..length).map(|_| rng.random::<u8>()).collect()
    };
    match harm {
        Harm::Nothing => {}
        Harm::Garbage | Harm::Flood => {
            let socket = network.socket(hostile_address(0));
            let (length, period) = match harm {
                Harm::Flood => (1200, Duration::from_micros(90)),
                _ => (200, Duration::from_millis(1)),
            };
            let mut tick = tokio::time::interval(period);
            loop {
                tick.tick().await;
                let mut contents = noise(&mut rng, length);
                // A long header, of this version of QUIC or another one.
                contents[0] |= 0xc0;
                if rng.random::<bool>() {
                    contents[1..5].copy_from_slice(&[0, 0, 0, 1]);
                }
                socket.send_raw(server_address(), &contents);
            }
        }
        Harm::Handshakes | Harm::Giants | Harm::Sloth => {
            let mut held = Vec::new();
            for number in 0u16.. {
                let endpoint = Endpoint::new_with_abstract_socket(
                    seeded(seed + u64::from(number)),
                    None,
                    network.socket(hostile_address(number)),
                    Arc::new(TokioRuntime),
                );
                let endpoint = endpoint.expect("a socket");
                let (tls, _) = pinned_tls(link.fingerprint).expect("TLS");
                let config = quic_client(tls).expect("TLS");
                let connecting =
                    endpoint.connect_with(config, server_address(), SERVER_NAME).expect("an address");
                if harm == Harm::Handshakes {
                    held.push((endpoint, Some(connecting), None));
                } else if let Ok(connection) = connecting.await
                    && let Ok((mut send, receive)) = connection.open_bi().await
                {
                    let said = first_words(&link, harm, number, &mut send).await;
                    held.push((endpoint, None, said.then_some((connection, send, receive))));
                }
                if held.len() > 200 {
                    held.remove(0);
                }
                tokio::time::sleep(if harm == Harm::Sloth { SECOND } else { Duration::from_millis(20) })
                    .await;
            }
        }
    }
}

/// Says half a hello, a giant length, or a true hello.
async fn first_words(link: &Link, harm: Harm, number: u16, send: &mut SendStream) -> bool {
    let hello = hello(link.token.clone(), link.token.clone(), "x");
    let hello = control::encode(&hello).expect("a hello");
    let words = match harm {
        Harm::Sloth => &hello[..],
        _ if number.is_multiple_of(2) => &hello[..hello.len() / 2],
        _ => &[0xff; 64],
    };
    send.write_all(words).await.is_ok()
}

/// Frames a second of three good viewers beside a bad peer.
fn frames_beside(bad: Harm) -> f64 {
    in_virtual_time(async move {
        let mut world = World::new(&link_model(50.0, 40, 0.0), None);
        let links = world.serve(4, Renderer::default());
        let clients: Vec<_> = links[..3].iter().map(|link| world.viewer(link)).collect();
        let hostile = tokio::spawn(harm((world.network.clone(), links[3].clone(), 77), bad));
        let viewing = clients.into_iter().map(|c| tokio::spawn(view(c, 10 * SECOND, Duration::ZERO)));
        let mut frames = 0.0;
        for viewer in viewing.collect::<Vec<_>>() {
            frames += viewer.await.expect("a viewer").frames_per_second(2e3, 10e3);
        }
        hostile.abort();
        frames
    })
}

#[test]
fn a_peer_that_means_harm_costs_the_others_few_frames() {
    let alone = frames_beside(Harm::Nothing);
    for bad in [Harm::Garbage, Harm::Handshakes, Harm::Giants, Harm::Sloth] {
        let beside = frames_beside(bad);
        println!("{bad:?}: {beside:.0} of {alone:.0} frames/s");
        assert!(beside >= 0.9 * alone, "{bad:?}: {beside} of {alone}");
    }
    let flooded = frames_beside(Harm::Flood);
    println!("Flood: {flooded:.0} of {alone:.0} frames/s");
    assert!(flooded < 0.9 * alone, "{flooded} of {alone}");
}

/// One guess: a connection from `address` with a token that admits nobody. Returns when it was refused.
async fn guess(network: Network, link: Link, address: SocketAddr, seed: u64) {
    let socket = network.socket(address);
    let endpoint = Endpoint::new_with_abstract_socket(seeded(seed), None, socket, Arc::new(TokioRuntime));
    let endpoint = endpoint.expect("a socket");
    let config = quic_client(pinned_tls(link.fingerprint).expect("TLS").0).expect("TLS");
    let connecting = endpoint.connect_with(config, server_address(), SERVER_NAME).expect("an address");
    let Ok(connection) = connecting.await else { return };
    let Ok((mut send, _receive)) = connection.open_bi().await else { return };
    let hello = hello(Token::new([9; 16]), link.token, "x");
    let _ = send.write_all(&control::encode(&hello).expect("a hello")).await;
    connection.closed().await;
}

/// The time until a viewer is let in while `num` connections of its own address guess tokens at once; `None` if it is not.
fn time_beside_guesses(num: u16, has_token: bool) -> Option<Duration> {
    in_virtual_time(async move {
        let mut world = World::new(&link_model(50.0, 40, 0.0), None);
        let links = world.serve(1, Renderer::default());
        for number in 0..num {
            let address = SocketAddr::new(viewer_address(0).ip(), 20_000 + number);
            tokio::spawn(guess(world.network.clone(), links[0].clone(), address, 900 + u64::from(number)));
        }
        // The guesses are on their way, and none is decided.
        tokio::time::sleep(Duration::from_millis(30)).await;
        let begun = Instant::now();
        let token = if has_token { links[0].token.clone() } else { Token::new([8; 16]) };
        let client = world.viewer(&Link { token, ..links[0].clone() });
        while !client.is_connected() && begun.elapsed() < 20 * SECOND {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        client.is_connected().then(|| begun.elapsed())
    })
}

#[test]
fn wrong_tokens_do_not_make_a_viewer_of_the_same_address_wait() {
    let alone = time_beside_guesses(0, true).expect("a viewer alone");
    let beside = time_beside_guesses(200, true).expect("a viewer beside guesses");
    println!("{alone:?} alone, {beside:?} beside 200 guesses");
    assert!(beside < alone + SECOND / 2, "{beside:?} and {alone:?} alone");
    // The control: it needs its token.
    assert_eq!(time_beside_guesses(0, false), None);
}
