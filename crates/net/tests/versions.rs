//! Do peers of different protocol versions say both versions, and which side to update?
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use common::*;
use isinglass_core::wire::{ALPN, ALPN_ANY, PROTOCOL_VERSION, Refusal, version_in_notice};
use isinglass_net::{ConnectError, Link, random_token};
use quinn::{ConnectionError, Endpoint};

/// What our viewer says of a server that offers these protocols and closes with this code and reason.
async fn said_of(protocols: &[&[u8]], code: u32, reason: &'static [u8]) -> ConnectError {
    let (endpoint, fingerprint) = forged_endpoint(protocols);
    let port = endpoint.local_addr().unwrap().port();
    tokio::spawn(async move {
        while let Some(incoming) = endpoint.accept().await {
            let Ok(connection) = incoming.await else { continue };
            connection.close(code.into(), reason);
        }
    });
    let token = random_token().unwrap();
    let link = Link { host: "127.0.0.1".into(), port, token, fingerprint, state: None };
    connect(&link).wait_connected(Duration::from_secs(20)).unwrap_err()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_viewer_names_both_versions_and_the_older_side() {
    let client = PROTOCOL_VERSION;
    for (server, protocol, notice, side) in [
        (9, &b"isinglass/9"[..], &b"isinglass/9"[..], "the server's"),
        (99, b"isinglass/99", b"isinglass/99", "the viewer's"),
    ] {
        let problem = said_of(&[protocol, ALPN_ANY], 6, notice).await;
        assert_eq!(problem, ConnectError::Refused(Refusal::Version { server, client }));
        let line = problem.to_string();
        for word in [format!("version {server}"), format!("viewer {client}"), format!("update {side}")] {
            assert!(line.contains(&word), "{line}");
        }
        assert!(!problem.is_temporary(), "it does not pass by itself");
    }
    // Before servers told their version, and one that tells nonsense.
    for (protocols, notice) in [(&[&b"isinglass/9"[..]][..], &b""[..]), (&[ALPN_ANY], b"isinglass/x")] {
        let problem = said_of(protocols, 6, notice).await;
        assert_eq!(problem, ConnectError::Version);
        assert!(problem.to_string().contains("update the server's") && !problem.is_temporary());
    }
    // The control: a server of this version that closes is tried again.
    assert!(said_of(&[ALPN, ALPN_ANY], 4, b"").await.is_temporary());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_tells_its_version_to_a_viewer_of_another() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let client = Endpoint::client(([127, 0, 0, 1], 0).into()).unwrap();
    let address: SocketAddr = ([127, 0, 0, 1], link.port).into();
    let reached = async |protocols: &[&[u8]]| {
        let mut tls =
            rustls::ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()))
                .with_protocol_versions(&[&rustls::version::TLS13])
                .unwrap()
                .dangerous()
                .with_custom_certificate_verifier(Arc::new(AnyCertificate))
                .with_no_client_auth();
        tls.alpn_protocols = protocols.iter().map(|p| p.to_vec()).collect();
        let tls = quinn::crypto::rustls::QuicClientConfig::try_from(tls).unwrap();
        let config = quinn::ClientConfig::new(Arc::new(tls));
        client.connect_with(config, address, "isinglass").unwrap().await
    };
    let connection = reached(&[b"isinglass/99", ALPN_ANY]).await.unwrap();
    let ConnectionError::ApplicationClosed(close) = connection.closed().await else { panic!("no reason") };
    assert_eq!((close.error_code, version_in_notice(&close.reason)), (6u32.into(), Some(PROTOCOL_VERSION)));
    // Who offers only another version gets no connection.
    assert!(reached(&[b"isinglass/99"]).await.is_err());
    // The control: who offers both speaks the common version.
    let connection = reached(&[b"isinglass/99", ALPN, ALPN_ANY]).await.unwrap();
    assert!(connection.open_bi().await.is_ok() && connection.close_reason().is_none());
}

/// Takes any certificate: the test reads what a server says to everybody.
#[derive(Debug)]
struct AnyCertificate;

mod any_certificate {
    use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
    use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
    use rustls::{DigitallySignedStruct, Error, SignatureScheme};

    impl ServerCertVerifier for super::AnyCertificate {
        fn verify_server_cert(
            &self,
            _end_entity: &CertificateDer<'_>,
            _intermediates: &[CertificateDer<'_>],
            _server_name: &ServerName<'_>,
            _ocsp_response: &[u8],
            _now: UnixTime,
        ) -> Result<ServerCertVerified, Error> {
            Ok(ServerCertVerified::assertion())
        }

        fn verify_tls12_signature(
            &self,
            _message: &[u8],
            _cert: &CertificateDer<'_>,
            _dss: &DigitallySignedStruct,
        ) -> Result<HandshakeSignatureValid, Error> {
            Ok(HandshakeSignatureValid::assertion())
        }

        fn verify_tls13_signature(
            &self,
            _message: &[u8],
            _cert: &CertificateDer<'_>,
            _dss: &DigitallySignedStruct,
        ) -> Result<HandshakeSignatureValid, Error> {
            Ok(HandshakeSignatureValid::assertion())
        }

        fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
            vec![SignatureScheme::ECDSA_NISTP256_SHA256]
        }
    }
}
