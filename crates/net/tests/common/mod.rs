//! A server with a generator of small frames, and what tests wait with.
#![allow(dead_code, reason = "each test file uses another part")]

use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::{self, EncodedFrame};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::layer::{FrameHeader, LayeredFrame, Segment};
use isinglass_core::look::Look;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::wire::{ServerStats, VolumeDescription};
use isinglass_net::{
    Client, ClientOptions, Fingerprint, Greeting, Identity, Link, Server, ServerOptions, Session,
};
use quinn::Endpoint;

pub(crate) const INTRINSICS: Intrinsics = Intrinsics::perspective(64, 64, 0.6);

pub(crate) fn look() -> Look {
    let p = |x| ControlPoint { x, color: [1.0, 0.5, 0.0], opacity: x };
    let transfer = TransferFunction {
        name: "ramp".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![p(0.0), p(1.0)],
    };
    Look { shaded: false, k: 4, ..Look::new(transfer) }
}

pub(crate) fn greeting() -> Greeting {
    let volume = VolumeDescription {
        name: "test".into(),
        dims: [8, 8, 8],
        spacing: [1.0; 3],
        unit: Some("mm".into()),
        orientation: None,
        placement: None,
        value_unit: None,
        value_range: (0.0, 1.0),
        histogram_range: (0.0, 1.0),
        histogram: vec![1; 16],
        channels: vec![],
    };
    Greeting { volume, look_version: LookVersion(1), look: look() }
}

pub(crate) fn pose(n: u32) -> Pose {
    Pose::orbit(Vec3::ZERO, 0.01 * n as f32, 0.0, 30.0)
}

/// Lists of up to four segments whose colours are noise, so that they do not compress.
pub(crate) fn frame(frame: FrameId, pose_id: PoseId, pose: Pose, intrinsics: Intrinsics) -> LayeredFrame {
    let bounds = Aabb { min: Vec3::splat(-4.0), max: Vec3::splat(4.0) };
    let camera = Camera::new(pose, intrinsics, &bounds);
    let look = LookVersion(1);
    let header = FrameHeader { frame, pose: pose_id, look, ..FrameHeader::alone(camera, 4) };
    let mut out = LayeredFrame::empty(header);
    let mut noise = frame.0.wrapping_mul(2_654_435_761) | 1;
    for list in 0..intrinsics.num_pixels() {
        for layer in 0..(list % 5) as u16 {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let c = Vec3::new((noise >> 24) as f32, (noise >> 16 & 255) as f32, (noise >> 8 & 255) as f32)
                / 512.0;
            let front = layer * 1000 + (noise >> 20 & 255) as u16;
            out.push(&Segment { front, back: front + 100, c, tau: 0.8 });
        }
        out.offsets[list + 1] = out.depth.len() as u32;
    }
    out.validate().unwrap();
    out
}

pub(crate) fn encoded(id: FrameId, pose_id: PoseId, pose: Pose, intrinsics: Intrinsics) -> EncodedFrame {
    codec::encode(&frame(id, pose_id, pose, intrinsics)).unwrap()
}

pub(crate) fn server() -> Server {
    server_with(ServerOptions::default())
}

pub(crate) fn server_with(options: ServerOptions) -> Server {
    Server::bind(([127, 0, 0, 1], 0).into(), &Identity::generate().unwrap(), options, greeting()).unwrap()
}

/// Accepts viewers for ever and answers every pose with a frame.
pub(crate) fn serve(mut server: Server) {
    tokio::spawn(async move {
        while let Some(session) = server.accept().await {
            tokio::spawn(answer(session));
        }
    });
}

/// Answers every pose of one viewer with a frame, and every look with the same look.
pub(crate) async fn answer(mut session: Session) {
    let mut id = FrameId(0);
    while session.hear().await {
        let newest = {
            let mut talk = session.talk();
            if let Some(look) = talk.look.poll_wanted() {
                talk.look.begin(0, look, true);
            }
            talk.pose.poll_new()
        };
        let Some(request) = newest else { continue };
        id = id.next();
        let encoded = encoded(id, request.id, request.pose, request.intrinsics);
        let bytes = encoded.num_bytes() as u64;
        if session.frames.send(id, request.id, encoded.chunks).await.is_err() {
            return;
        }
        let pose_stamp_micros = request.stamp_micros;
        let stats =
            ServerStats { frame: id, pose: request.id, pose_stamp_micros, bytes, ..Default::default() };
        session.talk().link.report(stats);
    }
}

pub(crate) fn connect(link: &Link) -> Client {
    Client::connect(link, ClientOptions::default()).unwrap()
}

/// Waits until `probe` finds something. The limit only turns a hang into a failure.
pub(crate) async fn until<T>(what: &str, mut probe: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = probe() {
            return found;
        }
        assert!(start.elapsed() < Duration::from_secs(30), "waited in vain for {what}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Waits until the client has all of a frame that answers this pose.
pub(crate) async fn until_answered(client: &Client, pose: PoseId) -> Arc<isinglass_net::ReceivedFrame> {
    until("an answer", || client.latest_frame().filter(|f| f.frame.header.pose == pose)).await
}

/// An endpoint with a certificate of its own, which offers these protocols.
pub(crate) fn forged_endpoint(protocols: &[&[u8]]) -> (Endpoint, Fingerprint) {
    let identity = rcgen::KeyPair::generate().unwrap();
    let certificate =
        rcgen::CertificateParams::new(vec!["isinglass".into()]).unwrap().self_signed(&identity).unwrap();
    let mut tls =
        rustls::ServerConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()))
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .with_no_client_auth()
            .with_single_cert(vec![certificate.der().clone()], identity.into())
            .unwrap();
    tls.alpn_protocols = protocols.iter().map(|p| p.to_vec()).collect();
    let digest = ring::digest::digest(&ring::digest::SHA256, certificate.der());
    let hex: String = digest.as_ref().iter().map(|b| format!("{b:02x}")).collect();
    let tls = quinn::crypto::rustls::QuicServerConfig::try_from(tls).unwrap();
    let config = quinn::ServerConfig::with_crypto(Arc::new(tls));
    let endpoint = Endpoint::server(config, ([127, 0, 0, 1], 0).into()).unwrap();
    (endpoint, format!("sha256:{hex}").parse().unwrap())
}
