//! What a host and a guest may be told, and the QUIC settings that follow from it.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{ClientConfig, IdleTimeout, ServerConfig, TransportConfig, VarInt};

use super::congestion::{RateCap, RateController};
use super::emulated::Emulation;
use super::endpoint::TransportError;
use super::identity::{AnyGuest, Identity, PinnedHost};
use super::invite::Token;

/// The application protocol and its version, negotiated in the handshake: another version is refused there.
pub const ALPN: &[u8] = b"pliant/2";

/// What a user may do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Role {
    /// See the bodies and take hold of them. Default.
    #[default]
    Hold,
    /// See them only: a grab is refused. A watcher costs its datagrams and nothing else.
    Watch,
}

impl Role {
    pub(crate) fn to_byte(self) -> u8 {
        match self {
            Self::Hold => 0,
            Self::Watch => 1,
        }
    }

    pub(crate) fn from_byte(byte: u8) -> Option<Self> {
        match byte {
            0 => Some(Self::Hold),
            1 => Some(Self::Watch),
            _ => None,
        }
    }
}

/// What a token lets in to, and until when.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grant {
    /// The secret; put it in the [`Invite`](super::Invite).
    pub token: Token,
    /// What its bearers may do.
    pub role: Role,
    /// The moment from which it lets in nobody more; who is in stays in. `None`: as long as the host runs.
    pub expires: Option<SystemTime>,
}

impl Grant {
    /// Lets in to see and hold, without end.
    pub fn hold(token: Token) -> Self {
        Self { token, role: Role::Hold, expires: None }
    }

    /// Lets in to see, without end.
    pub fn watch(token: Token) -> Self {
        Self { token, role: Role::Watch, expires: None }
    }

    /// The same until a moment.
    pub fn until(self, moment: SystemTime) -> Self {
        Self { expires: Some(moment), ..self }
    }
}

/// Who may join.
#[derive(Clone, Debug, Default)]
pub enum Access {
    /// Anyone who knows the address, to hold. Default.
    #[default]
    Anyone,
    /// Only who shows one of these tokens. The first is the one in [`Endpoint::invite`](super::Endpoint::invite).
    Tokens(Vec<Grant>),
}

impl Access {
    /// What `shown` lets in to at `now`, or why not, in words for the guest.
    pub(super) fn role(&self, shown: Option<Token>, now: SystemTime) -> Result<Role, &'static str> {
        match (self, shown) {
            (Self::Anyone, _) => Ok(Role::Hold),
            (Self::Tokens(_), None) => Err("this host asks for a token and the invite has none"),
            (Self::Tokens(grants), Some(shown)) => {
                // All are looked at, so that the time taken tells nothing of which one it was.
                let found = grants.iter().fold(None, |found, grant| {
                    let same = grant.token == shown;
                    found.or(same.then_some(grant))
                });
                match found {
                    None => Err("wrong token"),
                    Some(grant) if grant.expires.is_some_and(|expires| now >= expires) => {
                        Err("the token has expired")
                    }
                    Some(grant) => Ok(grant.role),
                }
            }
        }
    }

    pub(super) fn first_token(&self) -> Option<Token> {
        match self {
            Self::Anyone => None,
            Self::Tokens(grants) => grants.first().map(|grant| grant.token),
        }
    }
}

/// Bounds on what one peer may cost. Every queue of the transport is in here.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Peers at one time; the next is refused. Default: 256.
    pub peers: usize,
    /// Peers and handshakes from one IP address at one time; the next is refused. Default: 64.
    pub per_address: usize,
    /// Longest message accepted from a peer, bytes; a longer one closes the connection. Default: 1 MiB for a host, 256 MiB for a guest
    /// (models come that way).
    pub message: usize,
    /// Messages not yet sent or not yet read, bytes for each peer and direction. One message is always let through, however long.
    /// Default: 64 MiB towards the peer is the bound of [`SendError::QueueFull`](super::SendError::QueueFull); from the peer, flow control.
    pub queued_messages: usize,
    /// Datagrams not yet sent, or not yet read, for each peer and direction; more drop the oldest. Default: 64.
    pub queued_datagrams: usize,
    /// Most that is sent to one peer. Default: 8 Mbit/s.
    pub rate: RateCap,
    /// A peer that is silent for so long is gone. Default: 10 s. At least 1 s.
    pub idle_timeout: Duration,
    /// A quiet connection says that it lives so often. Default: 1 s.
    pub keep_alive: Duration,
    /// From the first packet to the accepted token. Default: 10 s.
    pub handshake: Duration,
}

impl Limits {
    /// The defaults of a host.
    pub fn host() -> Self {
        Self {
            peers: 256,
            per_address: 64,
            message: 1 << 20,
            queued_messages: 64 << 20,
            queued_datagrams: 64,
            rate: RateCap::from_mbit_per_s(8.0),
            idle_timeout: Duration::from_secs(10),
            keep_alive: Duration::from_secs(1),
            handshake: Duration::from_secs(10),
        }
    }

    /// The defaults of a guest.
    pub fn guest() -> Self {
        Self { peers: 1, message: 256 << 20, ..Self::host() }
    }
}

/// How to host.
#[derive(Debug)]
pub struct HostOptions {
    /// Where to listen. Default: any free port on 127.0.0.1; a host for others binds `0.0.0.0:PORT` or `[::]:PORT`.
    pub bind: SocketAddr,
    /// The host's key. Default `None`: a new one, so that invites are good as long as this host runs.
    pub identity: Option<Identity>,
    /// Who may join.
    pub access: Access,
    /// What a guest may cost.
    pub limits: Limits,
    /// A lossy link put under the socket, for demonstrations and tests. Default: none.
    pub emulation: Option<Emulation>,
}

impl Default for HostOptions {
    fn default() -> Self {
        Self {
            bind: SocketAddr::from((Ipv4Addr::LOCALHOST, 0)),
            identity: None,
            access: Access::default(),
            limits: Limits::host(),
            emulation: None,
        }
    }
}

/// How to join.
#[derive(Debug)]
pub struct JoinOptions {
    /// The guest's key, which is its lasting name. Default `None`: a new one.
    pub identity: Option<Identity>,
    /// What the host may cost.
    pub limits: Limits,
    /// A lossy link put under the socket, for demonstrations and tests. Default: none.
    pub emulation: Option<Emulation>,
    /// The own address. Default `None`: any free port, on loopback for a host there, else on every interface.
    pub bind: Option<SocketAddr>,
}

impl Default for JoinOptions {
    fn default() -> Self {
        Self { identity: None, limits: Limits::guest(), emulation: None, bind: None }
    }
}

/// quinn's buffer of datagrams that wait for the congestion window. Its default of 1 MiB turned a 40 Hz stream into a queue of 3 s.
const DATAGRAM_SEND_BUFFER: usize = 4 << 10;
const DATAGRAM_RECEIVE_BUFFER: usize = 64 << 10;

fn transport(limits: &Limits, from_peer: u32) -> Result<Arc<TransportConfig>, TransportError> {
    let idle = limits.idle_timeout.max(Duration::from_secs(1));
    let idle = IdleTimeout::try_from(idle)
        .map_err(|_| TransportError::IdleTimeout { given: limits.idle_timeout })?;
    let mut config = TransportConfig::default();
    config
        .max_concurrent_bidi_streams(VarInt::from_u32(from_peer))
        .max_concurrent_uni_streams(VarInt::from_u32(0))
        .stream_receive_window(VarInt::from_u32(1 << 20))
        .receive_window(VarInt::from_u32(2 << 20))
        .send_window(1 << 20)
        .max_idle_timeout(Some(idle))
        .keep_alive_interval(Some(limits.keep_alive.max(Duration::from_millis(100))))
        .datagram_send_buffer_size(DATAGRAM_SEND_BUFFER)
        .datagram_receive_buffer_size(Some(DATAGRAM_RECEIVE_BUFFER))
        // Jitter reorders datagrams at will: a packet is late, not lost, until sixteen have overtaken it or 9/8 of the round trip are over.
        .packet_threshold(16)
        .enable_segmentation_offload(false)
        // Every QUIC path carries 1,200 bytes, and a frame is far below that: larger packets would only bring black holes to detect.
        .mtu_discovery_config(None)
        .congestion_controller_factory(Arc::new(RateController::new(limits.rate)));
    Ok(Arc::new(config))
}

/// The most handshakes quinn holds before the host has looked at them.
const PENDING_HANDSHAKES: usize = 256;

pub(super) fn server(identity: &Identity, limits: &Limits) -> Result<ServerConfig, TransportError> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let verifier = AnyGuest { algorithms: provider.signature_verification_algorithms };
    let (chain, key) = identity.chain();
    let mut tls = rustls::ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(TransportError::tls)?
        .with_client_cert_verifier(Arc::new(verifier))
        .with_single_cert(chain, key)
        .map_err(TransportError::tls)?;
    tls.alpn_protocols = vec![ALPN.to_vec()];
    // Early data could be replayed, and a ticket would skip the pinned key.
    tls.max_early_data_size = 0;
    tls.send_tls13_tickets = 0;
    let crypto = QuicServerConfig::try_from(tls).map_err(TransportError::tls)?;
    let mut config = ServerConfig::with_crypto(Arc::new(crypto));
    config
        .transport_config(transport(limits, 1)?)
        .max_incoming(PENDING_HANDSHAKES)
        .incoming_buffer_size(64 << 10)
        .incoming_buffer_size_total(4 << 20);
    Ok(config)
}

pub(super) fn client(
    identity: &Identity,
    limits: &Limits,
    make_verifier: impl FnOnce(&rustls::crypto::CryptoProvider) -> Arc<PinnedHost>,
) -> Result<ClientConfig, TransportError> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let verifier = make_verifier(&provider);
    let (chain, key) = identity.chain();
    let mut tls = rustls::ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(TransportError::tls)?
        .dangerous()
        .with_custom_certificate_verifier(verifier)
        .with_client_auth_cert(chain, key)
        .map_err(TransportError::tls)?;
    tls.alpn_protocols = vec![ALPN.to_vec()];
    tls.resumption = rustls::client::Resumption::disabled();
    let crypto = QuicClientConfig::try_from(tls).map_err(TransportError::tls)?;
    let mut config = ClientConfig::new(Arc::new(crypto));
    config.transport_config(transport(limits, 0)?);
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_lets_in_to_its_role_until_it_expires() {
        let now = SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000);
        let minute = Duration::from_secs(60);
        let (held, watched) = (Token([7; 16]), Token([9; 16]));
        let access = Access::Tokens(vec![Grant::hold(held).until(now + minute), Grant::watch(watched)]);
        assert_eq!(access.role(Some(held), now), Ok(Role::Hold));
        assert_eq!(access.role(Some(watched), now), Ok(Role::Watch));
        assert!(access.role(Some(Token([8; 16])), now).unwrap_err().contains("wrong"));
        assert!(access.role(None, now).unwrap_err().contains("asks for a token"));
        assert!(access.role(Some(held), now + minute).unwrap_err().contains("expired"));
        assert_eq!(access.role(Some(watched), now + minute), Ok(Role::Watch));
        assert_eq!(Access::Anyone.role(None, now), Ok(Role::Hold));
        assert!(Access::Tokens(Vec::new()).role(Some(held), now).is_err(), "nobody");
        for role in [Role::Hold, Role::Watch] {
            assert_eq!(Role::from_byte(role.to_byte()), Some(role));
        }
        assert_eq!(Role::from_byte(2), None);
    }
}
