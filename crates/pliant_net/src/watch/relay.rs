//! The connection to a relay, made again whenever it is lost.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use quinn::crypto::rustls::QuicClientConfig;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, verify_tls12_signature, verify_tls13_signature};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{CertificateError, DigitallySignedStruct, Error as TlsError, SignatureScheme};
use thiserror::Error;
use tokio::time::{Instant, sleep, timeout};
use url::{Host, Url};
use web_transport_quinn::proto::ConnectRequest;

/// Longest time to a relay's answer.
const CONNECT: Duration = Duration::from_secs(10);
/// Pauses between tries to reach a relay: the first and the longest.
const PAUSES: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(4)];
/// A silent relay is lost after this time.
const IDLE: Duration = Duration::from_secs(4);

/// Why watching or publishing could not begin.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum WatchError {
    /// The relay's address is none.
    #[error("the relay's address {0} is no https:// URL with a host")]
    Address(String),
    /// The settings are outside their ranges.
    #[error(transparent)]
    Settings(#[from] pliant_stream::StreamError),
    /// The name of the session is none.
    #[error("the session's name {0:?} is empty, too long or no path")]
    Name(String),
    /// The thread or the keys could not be set up.
    #[error("the connection to a relay could not be set up: {0}")]
    Setup(String),
}

/// Whom to trust to be the relay.
#[derive(Debug, Clone, Default)]
pub enum RelayTrust {
    /// Whoever has a certificate for the relay's name from an authority that this system trusts.
    /// Default.
    #[default]
    System,
    /// Whoever has a certificate with one of these SHA-256 hashes, as relays with certificates of
    /// their own tell them (`moq-relay` at `/certificate.sha256`).
    Certificates(Vec<[u8; 32]>),
}

/// Which relay to use, and under which name the session is there.
#[derive(Debug, Clone)]
pub struct RelayOptions {
    /// Address of the relay, `https://HOST:PORT/PATH`. A token for the relay belongs into it, as
    /// the relay has them (`?jwt=TOKEN` for `moq-relay`).
    pub relay: String,
    /// Name of the session at the relay: parts with slashes between them, at most 256 bytes.
    pub session: String,
    /// Whom to trust to be the relay. Default: the system's authorities.
    pub trust: RelayTrust,
}

impl RelayOptions {
    /// The session of this name at a relay that the system's authorities vouch for.
    pub fn new(relay: impl Into<String>, session: impl Into<String>) -> Self {
        Self { relay: relay.into(), session: session.into(), trust: RelayTrust::System }
    }

    /// Trusts a certificate by its SHA-256 hash, given as 64 hexadecimal digits. Text that is no
    /// hash changes nothing and returns `None`.
    pub fn with_certificate(mut self, hash: &str) -> Option<Self> {
        let hash = hash.trim();
        let digits = hash.len() == 64 && hash.bytes().all(|c| c.is_ascii_hexdigit());
        let mut bytes = [0; 32];
        for (k, byte) in bytes.iter_mut().enumerate() {
            *byte = u8::from_str_radix(hash.get(2 * k..2 * k + 2)?, 16).ok()?;
        }
        self.trust = RelayTrust::Certificates(vec![bytes]);
        digits.then_some(self)
    }

    /// Link to a page that shows the session: `page` with the relay and the session in its
    /// fragment, which browsers send to no web server, and the hashes of certificates to trust. A
    /// token in `relay` is in the link too.
    pub(super) fn link(&self, page: &str, relay: &str) -> String {
        let mut fragment = url::form_urlencoded::Serializer::new(String::new());
        fragment.append_pair("relay", relay).append_pair("session", &self.session);
        // Another relay has another certificate; the same one may be there with another token.
        if let RelayTrust::Certificates(hashes) = &self.trust
            && without_token(relay) == without_token(&self.relay)
        {
            for hash in hashes {
                let hex: String = hash.iter().map(|byte| format!("{byte:02x}")).collect();
                fragment.append_pair("certificate", &hex);
            }
        }
        format!("{page}#{}", fragment.finish())
    }

    pub(super) fn open(&self) -> Result<Relay, WatchError> {
        let parts = self.session.split('/');
        let sound = parts.clone().count() <= 16 && parts.clone().all(|part| !part.is_empty() && part != "..");
        if !sound || self.session.len() > 256 || self.session.contains('*') {
            return Err(WatchError::Name(self.session.clone()));
        }
        let address = || WatchError::Address(without_token(&self.relay));
        let url = Url::parse(&self.relay).map_err(|_| address())?;
        if url.scheme() != "https" || url.host().is_none() {
            return Err(address());
        }
        Ok(Relay { url, tls: client_config(&self.trust)? })
    }
}

/// A relay's address as logs and watchers may have it: what follows the question mark is secret,
/// and so are a user and a password.
pub(super) fn without_token(relay: &str) -> String {
    let shown = relay.split(['?', '#']).next().unwrap_or_default();
    let Some((scheme, rest)) = shown.split_once("://") else { return shown.to_owned() };
    let (host, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
    format!("{scheme}://{}{path}", host.rsplit('@').next().unwrap_or_default())
}

/// A relay to connect to.
#[derive(Clone)]
pub(super) struct Relay {
    url: Url,
    tls: quinn::ClientConfig,
}

impl Relay {
    /// Address for logs.
    pub(super) fn address(&self) -> String {
        without_token(self.url.as_str())
    }

    /// Keeps a client connected, and calls `on_change` at each connection, and with the reason at
    /// each loss and failure.
    pub(super) async fn keep(&self, client: moq_net::Client, on_change: impl Fn(Result<(), String>)) {
        let mut pause = PAUSES[0];
        // Each reason once, and at most two in a row that alternate.
        let mut last = [String::new(), String::new()];
        loop {
            let why = match timeout(CONNECT, self.connect(&client)).await {
                Ok(Ok((session, driver))) => {
                    on_change(Ok(()));
                    let since = Instant::now();
                    let end = moq_net::time::run(driver).await;
                    drop(session);
                    // Relays refuse a token when the connection is already there.
                    if since.elapsed() > PAUSES[1] {
                        pause = PAUSES[0];
                        last = Default::default();
                    }
                    format!("the relay {} is lost: {end}", self.address())
                }
                Ok(Err(error)) => format!("the relay {} is not reached: {error}", self.address()),
                Err(_) => format!("the relay {} does not answer", self.address()),
            };
            let why = self.without_secrets(why);
            if last.contains(&why) {
                tracing::debug!("{why}");
            } else {
                tracing::warn!("{why}");
                last.rotate_left(1);
                last[1].clone_from(&why);
            }
            on_change(Err(why));
            sleep(pause).await;
            pause = (pause * 2).min(PAUSES[1]);
        }
    }

    /// A text without the token of the relay's address, wherever it is from.
    fn without_secrets(&self, mut text: String) -> String {
        let query = self.url.query().unwrap_or_default();
        let written =
            query.split('&').filter_map(|pair| pair.split_once('=')).map(|(_, value)| value.to_owned());
        let values = self.url.query_pairs().map(|(_, value)| value.into_owned());
        let all = std::iter::once(query.to_owned()).chain(written).chain(values);
        // Shorter values are no secrets, and may be anywhere in a text.
        for secret in all.filter(|secret| secret.len() >= 8) {
            text = text.replace(&secret, "...");
        }
        text
    }

    async fn connect(
        &self,
        client: &moq_net::Client,
    ) -> Result<(moq_net::Session, moq_net::Driver<web_transport_quinn::Session>), String> {
        let port = self.url.port_or_known_default().unwrap_or(443);
        let (name, addresses) = match self.url.host() {
            Some(Host::Ipv4(ip)) => (ip.to_string(), vec![SocketAddr::new(ip.into(), port)]),
            Some(Host::Ipv6(ip)) => (ip.to_string(), vec![SocketAddr::new(ip.into(), port)]),
            Some(Host::Domain(name)) => {
                let found = tokio::net::lookup_host((name, port)).await.map_err(|error| error.to_string())?;
                (name.to_owned(), found.take(8).collect())
            }
            None => return Err("no host".to_owned()),
        };
        let mut last = "no address".to_owned();
        for address in addresses {
            match self.connect_to(address, &name).await {
                Ok(transport) => {
                    let now = std_now();
                    return client.connect(now, transport).await.map_err(|error| error.to_string());
                }
                Err(error) => last = error,
            }
        }
        Err(last)
    }

    async fn connect_to(
        &self,
        address: SocketAddr,
        name: &str,
    ) -> Result<web_transport_quinn::Session, String> {
        let any: SocketAddr = match address {
            SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
            SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
        };
        let endpoint = quinn::Endpoint::client(any).map_err(|error| error.to_string())?;
        let connecting = endpoint.connect_with(self.tls.clone(), address, name);
        let connection = connecting.map_err(|error| error.to_string())?.await.map_err(|e| e.to_string())?;
        let versions = moq_net::ALPNS.iter().map(|version| (*version).to_owned());
        let request = ConnectRequest::new(self.url.clone()).with_protocols(versions);
        web_transport_quinn::Session::connect(connection, request).await.map_err(|error| error.to_string())
    }
}

/// The time as the drivers of moq-net want it, by the clock of tokio.
fn std_now() -> moq_net::time::Instant {
    Instant::now().into_std()
}

fn client_config(trust: &RelayTrust) -> Result<quinn::ClientConfig, WatchError> {
    let setup = |error: &dyn std::fmt::Display| WatchError::Setup(error.to_string());
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = rustls::ClientConfig::builder_with_provider(provider.clone())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(|error| setup(&error))?;
    let mut tls = match trust {
        RelayTrust::System => {
            let mut roots = rustls::RootCertStore::empty();
            roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
            builder.with_root_certificates(roots).with_no_client_auth()
        }
        RelayTrust::Certificates(hashes) => {
            let verifier = Arc::new(KnownCertificates { hashes: hashes.clone(), provider });
            builder.dangerous().with_custom_certificate_verifier(verifier).with_no_client_auth()
        }
    };
    tls.alpn_protocols = vec![web_transport_quinn::ALPN.as_bytes().to_vec()];
    let crypto = QuicClientConfig::try_from(tls).map_err(|error| setup(&error))?;
    let mut config = quinn::ClientConfig::new(Arc::new(crypto));
    let mut transport = quinn::TransportConfig::default();
    transport.keep_alive_interval(Some(IDLE / 4));
    transport.max_idle_timeout(IDLE.try_into().ok());
    config.transport_config(Arc::new(transport));
    Ok(config)
}

/// Accepts certificates by their hashes, as browsers do with `serverCertificateHashes`.
#[derive(Debug)]
struct KnownCertificates {
    hashes: Vec<[u8; 32]>,
    provider: Arc<CryptoProvider>,
}

impl ServerCertVerifier for KnownCertificates {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, TlsError> {
        let found = ring::digest::digest(&ring::digest::SHA256, end_entity);
        if self.hashes.iter().any(|hash| hash == found.as_ref()) {
            Ok(ServerCertVerified::assertion())
        } else {
            Err(TlsError::InvalidCertificate(CertificateError::ApplicationVerificationFailure))
        }
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, TlsError> {
        verify_tls12_signature(
            message,
            certificate,
            signature,
            &self.provider.signature_verification_algorithms,
        )
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, TlsError> {
        verify_tls13_signature(
            message,
            certificate,
            signature,
            &self.provider.signature_verification_algorithms,
        )
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider.signature_verification_algorithms.supported_schemes()
    }
}
