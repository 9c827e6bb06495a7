//! A relay for Media over QUIC in this process, with a certificate of its own.
#![allow(dead_code, reason = "each test uses its part")]

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::mpsc::sync_channel;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use moq_net::origin;
use rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};
use tokio::sync::oneshot;
use web_transport_quinn::proto::ConnectResponse;

/// A relay's certificate and its key.
#[derive(Clone)]
pub struct Certificate {
    der: Vec<u8>,
    key: Vec<u8>,
}

/// A relay at loopback, until it is dropped.
pub struct TestRelay {
    pub port: u16,
    pub certificate: Certificate,
    /// SHA-256 of its certificate, 64 digits.
    pub hash: String,
    end: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl TestRelay {
    pub fn start() -> Self {
        Self::start_with(0, Certificate::new(), |_| {})
    }

    /// Starts at a port, with the certificate of the relay that was there before.
    pub fn start_again(port: u16, certificate: Certificate) -> Self {
        Self::start_with(port, certificate, |_| {})
    }

    /// Starts with what `publish` puts into the relay itself. It is called on the relay's thread
    /// and may start tasks there.
    pub fn start_with(
        port: u16,
        certificate: Certificate,
        publish: impl FnOnce(&origin::Producer) + Send + 'static,
    ) -> Self {
        let (sender, receiver) = sync_channel(1);
        let (end, ended) = oneshot::channel();
        let own = certificate.clone();
        let thread = thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            let tasks = tokio::task::LocalSet::new();
            runtime.block_on(tasks.run_until(async move {
                let endpoint = endpoint(port, &own).await;
                sender.send(endpoint.local_addr().unwrap().port()).unwrap();
                let (origin, driver) = origin::Producer::new(origin::Config::default());
                tokio::task::spawn_local(moq_net::time::run(driver));
                publish(&origin);
                tokio::select! {
                    () = accept(endpoint.clone(), origin) => {}
                    _ = ended => {}
                }
                // As a relay that was killed: sessions get no goodbye of their own.
                endpoint.close(0_u32.into(), b"");
            }));
            drop(tasks);
        });
        let port = receiver.recv().unwrap();
        let hash = certificate.hash();
        Self { port, certificate, hash, end: Some(end), thread: Some(thread) }
    }

    pub fn address(&self) -> String {
        format!("https://127.0.0.1:{}/", self.port)
    }
}

impl Drop for TestRelay {
    fn drop(&mut self) {
        self.end.take();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Certificate {
    pub fn new() -> Self {
        let key = rcgen::KeyPair::generate().unwrap();
        let mut parameters = rcgen::CertificateParams::new(vec!["127.0.0.1".into()]).unwrap();
        // Browsers take a certificate by its hash if it is valid for two weeks at most.
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
        let day = Duration::from_hours(24);
        parameters.not_before = rcgen::date_time_ymd(1970, 1, 1) + (now - day);
        parameters.not_after = parameters.not_before + 10 * day;
        let der = parameters.self_signed(&key).unwrap().der().to_vec();
        Self { der, key: key.serialize_der() }
    }

    fn hash(&self) -> String {
        let digest = ring::digest::digest(&ring::digest::SHA256, &self.der);
        digest.as_ref().iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

async fn endpoint(port: u16, certificate: &Certificate) -> quinn::Endpoint {
    let key = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(certificate.key.clone()));
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut tls = rustls::ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![certificate.der.clone().into()], key)
        .unwrap();
    tls.alpn_protocols = vec![web_transport_quinn::ALPN.as_bytes().to_vec()];
    let crypto = quinn::crypto::rustls::QuicServerConfig::try_from(tls).unwrap();
    let config = quinn::ServerConfig::with_crypto(Arc::new(crypto));
    let address = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), port);
    loop {
        match quinn::Endpoint::server(config.clone(), address) {
            Ok(endpoint) => return endpoint,
            // The relay before may still be closing its socket.
            Err(error) if port != 0 => println!("port {port}: {error}"),
            Err(error) => panic!("no socket: {error}"),
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

async fn accept(endpoint: quinn::Endpoint, origin: origin::Producer) {
    let mut server = web_transport_quinn::Server::new(endpoint);
    while let Some(request) = server.accept().await {
        let origin = origin.clone();
        tokio::task::spawn_local(async move {
            let chosen = request.connect().protocols.iter().find(|p| moq_net::ALPNS.contains(&p.as_str()));
            let response = match chosen {
                Some(version) => ConnectResponse::OK.with_protocol(version.clone()),
                None => ConnectResponse::OK,
            };
            let Ok(transport) = request.respond(response).await else { return };
            let server = moq_net::Server::new().with_origin(origin);
            let now = std::time::Instant::now();
            if let Ok((session, driver)) = server.accept(now, transport).await {
                moq_net::time::run(driver).await;
                drop(session);
            }
        });
    }
}
