//! A guest built directly on quinn.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use pliant_net::transport::Endpoint;

use crate::support::wait::{Look, wait_for};

/// A guest built directly on quinn, which can do things that this crate's guests never do.
pub struct UnauthenticatedPeer {
    pub runtime: tokio::runtime::Runtime,
    pub endpoint: quinn::Endpoint,
}

/// Trusts any host, as only a test may.
#[derive(Debug)]
struct AnyHost(rustls::crypto::WebPkiSupportedAlgorithms);

impl rustls::client::danger::ServerCertVerifier for AnyHost {
    fn verify_server_cert(
        &self,
        _: &rustls::pki_types::CertificateDer<'_>,
        _: &[rustls::pki_types::CertificateDer<'_>],
        _: &rustls::pki_types::ServerName<'_>,
        _: &[u8],
        _: rustls::pki_types::UnixTime,
    ) -> Result<rustls::client::danger::ServerCertVerified, rustls::Error> {
        Ok(rustls::client::danger::ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        cert: &rustls::pki_types::CertificateDer<'_>,
        dss: &rustls::DigitallySignedStruct,
    ) -> Result<rustls::client::danger::HandshakeSignatureValid, rustls::Error> {
        rustls::crypto::verify_tls12_signature(message, cert, dss, &self.0)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &rustls::pki_types::CertificateDer<'_>,
        dss: &rustls::DigitallySignedStruct,
    ) -> Result<rustls::client::danger::HandshakeSignatureValid, rustls::Error> {
        rustls::crypto::verify_tls13_signature(message, cert, dss, &self.0)
    }

    fn supported_verify_schemes(&self) -> Vec<rustls::SignatureScheme> {
        self.0.supported_schemes()
    }
}

impl UnauthenticatedPeer {
    pub fn new(alpn: &[u8], key: bool) -> Self {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let algorithms = provider.signature_verification_algorithms;
        let builder = rustls::ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .dangerous()
            .with_custom_certificate_verifier(Arc::new(AnyHost(algorithms)));
        let mut tls = if key {
            let pair = rcgen::KeyPair::generate_for(&rcgen::PKCS_ED25519).unwrap();
            let certificate =
                rcgen::CertificateParams::new(vec!["x".into()]).unwrap().self_signed(&pair).unwrap();
            let der = rustls::pki_types::PrivatePkcs8KeyDer::from(pair.serialize_der());
            builder.with_client_auth_cert(vec![certificate.der().clone()], der.into()).unwrap()
        } else {
            builder.with_no_client_auth()
        };
        tls.alpn_protocols = vec![alpn.to_vec()];
        let crypto = quinn::crypto::rustls::QuicClientConfig::try_from(tls).unwrap();
        let endpoint = runtime.block_on(async {
            let mut endpoint = quinn::Endpoint::client(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
            endpoint.set_default_client_config(quinn::ClientConfig::new(Arc::new(crypto)));
            endpoint
        });
        Self { runtime, endpoint }
    }

    /// Drives this guest's runtime until `look` succeeds, because nothing else drives it.
    pub fn live_until<L: Look>(&self, awaited: &str, mut look: impl FnMut() -> L) -> L::Found {
        wait_for(awaited, || {
            self.runtime.block_on(async { tokio::time::sleep(Duration::from_millis(1)).await });
            look()
        })
    }

    pub fn connect(&self, host: &Endpoint) -> Result<quinn::Connection, quinn::ConnectionError> {
        self.runtime.block_on(async { self.endpoint.connect(host.local_address(), "pliant").unwrap().await })
    }
}
