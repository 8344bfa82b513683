//! Certificates, their fingerprints, and TLS on both sides.
//!
//! A server makes its own certificate. A client accepts only the one whose SHA-256 is in the link; names, dates and
//! issuers do not matter. The handshake's signature is verified, so a copy of the certificate is not enough.

use std::sync::{Arc, Mutex, PoisonError};

use base64::Engine;
use isinglass_core::wire::{ALPN, ALPN_ANY, Token};
use ring::rand::{SecureRandom, SystemRandom};
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{
    CryptoProvider, WebPkiSupportedAlgorithms, ring::default_provider, verify_tls13_signature,
};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer, ServerName, UnixTime};
use rustls::{CertificateError, DigitallySignedStruct, SignatureScheme};

/// A certificate and its private key.
#[derive(Debug)]
pub struct Identity {
    certificate: CertificateDer<'static>,
    key: PrivatePkcs8KeyDer<'static>,
}

/// Why there is no identity or secret.
#[derive(Debug, thiserror::Error)]
pub enum IdentityError {
    /// The certificate could not be made.
    #[error("cannot make a certificate: {0}")]
    Certificate(#[from] rcgen::Error),
    /// A text holds no identity.
    #[error("there is no usable {0} in it")]
    Pem(&'static str),
    /// TLS rejects it.
    #[error("cannot set up TLS: {0}")]
    Tls(String),
    /// The operating system gives no random numbers.
    #[error("the operating system gives no random numbers")]
    NoEntropy,
}

impl Identity {
    /// A new self-signed certificate with a new key (ECDSA on P-256).
    ///
    /// # Errors
    /// If the operating system gives no random numbers.
    pub fn generate() -> Result<Self, IdentityError> {
        let key = rcgen::KeyPair::generate()?;
        let mut params = rcgen::CertificateParams::new(vec![SERVER_NAME.to_owned()])?;
        params.distinguished_name.push(rcgen::DnType::CommonName, SERVER_NAME);
        let certificate = params.self_signed(&key)?.der().clone();
        Ok(Self { certificate, key: key.into() })
    }

    /// Reads what [`Self::to_pem`] writes, or any certificate with its PKCS #8 key.
    ///
    /// # Errors
    /// If the text lacks one of them, or the key is not the certificate's.
    pub fn from_pem(text: &str) -> Result<Self, IdentityError> {
        let lacks = |what| move |_| IdentityError::Pem(what);
        let certificate = CertificateDer::from_pem_slice(text.as_bytes()).map_err(lacks("certificate"))?;
        let key = PrivatePkcs8KeyDer::from_pem_slice(text.as_bytes()).map_err(lacks("private key"))?;
        let identity = Self { certificate, key };
        identity.tls()?;
        Ok(identity)
    }

    /// The private key and the certificate as PEM (RFC 7468). Whoever has this text passes for the server.
    pub fn to_pem(&self) -> String {
        let mut text = String::new();
        let parts = [("PRIVATE KEY", self.key.secret_pkcs8_der()), ("CERTIFICATE", &self.certificate)];
        for (label, bytes) in parts {
            let digits = base64::engine::general_purpose::STANDARD.encode(bytes);
            let lines: Vec<&str> =
                (0..digits.len()).step_by(64).map(|i| &digits[i..digits.len().min(i + 64)]).collect();
            text += &format!("-----BEGIN {label}-----\n{}\n-----END {label}-----\n", lines.join("\n"));
        }
        text
    }

    /// The certificate's fingerprint, for links.
    pub fn fingerprint(&self) -> Fingerprint {
        Fingerprint::of(&self.certificate)
    }

    /// The TLS of a server, for QUIC and for streams.
    pub(crate) fn tls(&self) -> Result<Arc<rustls::ServerConfig>, IdentityError> {
        let key = PrivateKeyDer::Pkcs8(self.key.clone_key());
        let tls_error = |e: rustls::Error| IdentityError::Tls(e.to_string());
        let mut config = rustls::ServerConfig::builder_with_provider(Arc::new(default_provider()))
            .with_protocol_versions(&[&rustls::version::TLS13])
            .map_err(tls_error)?
            .with_no_client_auth()
            .with_single_cert(vec![self.certificate.clone()], key)
            .map_err(tls_error)?;
        config.alpn_protocols = vec![ALPN.to_vec(), ALPN_ANY.to_vec()];
        // TLS tickets would be a second way in; ours travel on the control stream.
        config.send_tls13_tickets = 0;
        Ok(Arc::new(config))
    }
}

/// SHA-256 of a certificate (DER). Its text is `sha256:` and 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Fingerprint([u8; 32]);

impl Fingerprint {
    fn of(certificate: &CertificateDer<'_>) -> Self {
        let digest = ring::digest::digest(&ring::digest::SHA256, certificate);
        let mut bytes = [0; 32];
        bytes.copy_from_slice(digest.as_ref());
        Self(bytes)
    }
}

impl std::fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(FINGERPRINT_PREFIX)?;
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

impl std::fmt::Debug for Fingerprint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Fingerprint({self})")
    }
}

impl std::str::FromStr for Fingerprint {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        let digits = s
            .strip_prefix(FINGERPRINT_PREFIX)
            .ok_or_else(|| format!("expected '{FINGERPRINT_PREFIX}' and 64 hexadecimal digits"))?;
        if digits.len() != 64 || !digits.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(format!("expected 64 hexadecimal digits, found {} bytes", digits.len()));
        }
        let mut bytes = [0; 32];
        for (byte, pair) in bytes.iter_mut().zip(digits.as_bytes().chunks_exact(2)) {
            let digit = |d: u8| (d as char).to_digit(16).unwrap_or(0) as u8;
            *byte = digit(pair[0]) << 4 | digit(pair[1]);
        }
        Ok(Self(bytes))
    }
}

/// A token from the operating system's generator.
///
/// # Errors
/// If the operating system gives no random numbers.
pub fn random_token() -> Result<Token, IdentityError> {
    let mut bytes = [0; 16];
    SystemRandom::new().fill(&mut bytes).map_err(|_| IdentityError::NoEntropy)?;
    Ok(Token::new(bytes))
}

/// A client's TLS that accepts one certificate, and the record of a mismatch.
///
/// # Errors
/// If TLS cannot be set up.
pub fn pinned_tls(
    expected: Fingerprint,
) -> Result<(Arc<rustls::ClientConfig>, Arc<Mismatch>), IdentityError> {
    let provider = Arc::new(default_provider());
    let mismatch = Arc::new(Mismatch::default());
    let verifier = PinnedVerifier::new(expected, &provider, mismatch.clone());
    let mut config = rustls::ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(|e| IdentityError::Tls(e.to_string()))?
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(verifier))
        .with_no_client_auth();
    config.alpn_protocols = vec![ALPN.to_vec(), ALPN_ANY.to_vec()];
    config.resumption = rustls::client::Resumption::disabled();
    Ok((Arc::new(config), mismatch))
}

/// The settings of QUIC for a server with this TLS.
pub(crate) fn quic_server(tls: Arc<rustls::ServerConfig>) -> Result<quinn::ServerConfig, IdentityError> {
    let tls = quinn::crypto::rustls::QuicServerConfig::try_from(tls);
    let tls = tls.map_err(|e| IdentityError::Tls(e.to_string()))?;
    Ok(quinn::ServerConfig::with_crypto(Arc::new(tls)))
}

/// The settings of QUIC for a client with this TLS.
///
/// # Errors
/// If TLS lacks what QUIC needs.
pub fn quic_client(tls: Arc<rustls::ClientConfig>) -> Result<quinn::ClientConfig, IdentityError> {
    let tls = quinn::crypto::rustls::QuicClientConfig::try_from(tls);
    let tls = tls.map_err(|e| IdentityError::Tls(e.to_string()))?;
    Ok(quinn::ClientConfig::new(Arc::new(tls)))
}

/// The fingerprint of a server that showed another certificate than expected.
#[derive(Debug, Default)]
pub struct Mismatch(Mutex<Option<Fingerprint>>);

impl Mismatch {
    /// The fingerprint, if there was a mismatch.
    pub fn found(&self) -> Option<Fingerprint> {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Forgets the mismatch: the expected server has been found, perhaps at another of its addresses.
    pub fn forget(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
}

#[derive(Debug)]
struct PinnedVerifier {
    expected: Fingerprint,
    algorithms: WebPkiSupportedAlgorithms,
    mismatch: Arc<Mismatch>,
}

impl PinnedVerifier {
    fn new(expected: Fingerprint, provider: &CryptoProvider, mismatch: Arc<Mismatch>) -> Self {
        Self { expected, algorithms: provider.signature_verification_algorithms, mismatch }
    }
}

impl ServerCertVerifier for PinnedVerifier {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let found = Fingerprint::of(end_entity);
        if found == self.expected {
            return Ok(ServerCertVerified::assertion());
        }
        *self.mismatch.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(found);
        Err(rustls::Error::InvalidCertificate(CertificateError::ApplicationVerificationFailure))
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        Err(rustls::Error::General("TLS 1.2 is not spoken".into()))
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        verify_tls13_signature(message, cert, dss, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

/// The name in the certificate and the handshake. It identifies nothing.
pub(crate) const SERVER_NAME: &str = "isinglass";
const FINGERPRINT_PREFIX: &str = "sha256:";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identity_survives_its_text_and_a_damaged_one_is_refused() {
        let (a, b) = (Identity::generate().unwrap(), Identity::generate().unwrap());
        let text = a.to_pem();
        assert_eq!(Identity::from_pem(&text).unwrap().fingerprint(), a.fingerprint());
        let (key, certificate) = text.split_at(text.find("-----BEGIN CERT").unwrap());
        let of_b = b.to_pem();
        let other_key = &of_b[..of_b.find("-----BEGIN CERT").unwrap()];
        for bad in ["", key, certificate, &text[..text.len() / 2], &format!("{other_key}{certificate}")] {
            assert!(Identity::from_pem(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn fingerprints_differ_and_survive_their_text() {
        let (a, b) = (Identity::generate().unwrap(), Identity::generate().unwrap());
        assert_ne!(a.fingerprint(), b.fingerprint());
        assert_eq!(a.fingerprint().to_string().parse(), Ok(a.fingerprint()));
        assert!("sha256:00".parse::<Fingerprint>().is_err());
        assert!(a.fingerprint().to_string().replace("sha256", "sha1").parse::<Fingerprint>().is_err());
    }

    #[test]
    fn tokens_are_random() {
        assert!(!random_token().unwrap().matches(&random_token().unwrap()));
    }
}
