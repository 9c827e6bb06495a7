//! Options of hosts and guests, and the QUIC settings that follow from them.

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
use pliant_stream::wire::PROTOCOL_VERSION;
use pliant_stream::{DisconnectReason, Role};

/// The application protocol and [`PROTOCOL_VERSION`]. The handshake negotiates it and refuses
/// another version.
pub const ALPN: &[u8] = &{
    assert!(PROTOCOL_VERSION < 10, "the version has one digit here");
    let mut name = *b"pliant/0";
    name[7] += PROTOCOL_VERSION as u8;
    name
};

/// The role that a token grants, and the time of expiry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grant {
    /// The secret, to be put in the [`Invite`](super::Invite).
    pub token: Token,
    /// What guests with this token may do.
    pub role: Role,
    /// The time from which the token admits no more guests. Connected guests stay connected.
    /// `None`: valid as long as the host runs.
    pub expires: Option<SystemTime>,
}

impl Grant {
    /// Creates a grant to see and hold, without expiry.
    pub fn hold(token: Token) -> Self {
        Self { token, role: Role::Hold, expires: None }
    }

    /// Creates a grant to see only, without expiry.
    pub fn watch(token: Token) -> Self {
        Self { token, role: Role::Watch, expires: None }
    }

    /// Returns the grant with a time of expiry.
    pub fn until(self, moment: SystemTime) -> Self {
        Self { expires: Some(moment), ..self }
    }
}

/// Who may join.
#[derive(Clone, Debug, Default)]
pub enum Access {
    /// Anyone who knows the address, with the role to hold. Default.
    #[default]
    Anyone,
    /// Only guests that present one of these tokens. [`Endpoint::invite`](super::Endpoint::invite)
    /// contains the first one.
    Tokens(Vec<Grant>),
}

impl Access {
    /// Returns the role that the token `presented` grants at `now`, or the reason for a refusal.
    pub(super) fn role(&self, presented: Option<Token>, now: SystemTime) -> Result<Role, DisconnectReason> {
        match (self, presented) {
            (Self::Anyone, _) => Ok(Role::Hold),
            (Self::Tokens(_), None) => Err(DisconnectReason::MissingToken),
            (Self::Tokens(grants), Some(presented)) => {
                // All grants are compared, so that timing does not reveal which one matched.
                let found = grants.iter().fold(None, |found, grant| {
                    let same = grant.token == presented;
                    found.or(same.then_some(grant))
                });
                match found {
                    None => Err(DisconnectReason::UnknownToken),
                    Some(grant) if grant.expires.is_some_and(|expires| now >= expires) => {
                        Err(DisconnectReason::ExpiredToken)
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

/// Bounds on the cost of one peer. They include every queue of the transport.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Most peers and handshakes at one time. For the next one, the oldest that has sent no message
    /// after its token makes room. If there is none, the next one is refused. Default: 256.
    pub peers: usize,
    /// Most peers and handshakes at one time from one IPv4 address, or one IPv6 network of 64 bits,
    /// with the same rule. Twice as many may arrive at once, and half as many each second. Default:
    /// 64.
    pub per_address: usize,
    /// Longest message accepted from a peer, bytes. A longer message closes the connection.
    /// Default: 1 MiB for a host, 256 MiB for a guest (because models are sent as messages). Among
    /// peers, 256 MiB from one that was called, and from all over a
    /// [`CarrierPort`](super::CarrierPort).
    pub message: usize,
    /// Most bytes of messages that are not yet sent or not yet read, for each peer and direction. A
    /// single message is accepted whatever its length. Toward the peer, a full queue gives
    /// [`SendError::QueueFull`](super::SendError::QueueFull). From the peer, no more than the
    /// longest message waits: over QUIC flow control holds the peer back, and on a
    /// [`CarrierPort`](super::CarrierPort) the connection is closed. Default: 64 MiB.
    pub queued_messages: usize,
    /// Most datagrams that are not yet sent, or not yet read, for each peer and direction. A full
    /// queue drops its oldest datagram. Default: 64.
    pub queued_datagrams: usize,
    /// Largest rate to one peer. Default: 8 Mbit/s.
    pub rate: RateCap,
    /// Time after which a silent peer counts as gone. At least 1 s. Default: 10 s.
    pub idle_timeout: Duration,
    /// Interval at which a quiet connection sends a sign of life. At least 0.1 s. Default: 1 s.
    pub keep_alive: Duration,
    /// Longest time from the first packet to the accepted token. Default: 10 s.
    pub handshake: Duration,
}

impl Limits {
    /// Returns the defaults of a host.
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

    /// Returns the defaults of a guest.
    pub fn guest() -> Self {
        Self { peers: 1, message: 256 << 20, ..Self::host() }
    }

    /// Returns the limits of a connection among peers on which a state may come: of one that a peer
    /// opens to another one, and over an app's own netcode of each.
    pub(super) fn of_a_call(&self) -> Self {
        Self { message: Self::guest().message, ..self.clone() }
    }

    /// Returns how many bytes of a peer's messages may wait to be read. A message that is too long
    /// is not queued, so more room than for the longest is of no use.
    pub(super) fn unread_messages(&self) -> usize {
        self.queued_messages.min(self.message)
    }
}

/// How to host.
#[derive(Debug)]
pub struct HostOptions {
    /// Address to listen on. Default: any free port on 127.0.0.1. A host for other machines binds
    /// `0.0.0.0:PORT` or `[::]:PORT`.
    pub bind: SocketAddr,
    /// The host's key. Default `None`: a new key, so that invites are valid as long as this host
    /// runs.
    pub identity: Option<Identity>,
    /// Who may join.
    pub access: Access,
    /// Bounds on the cost of a guest.
    pub limits: Limits,
    /// Emulated lossy link under the socket, for demonstrations and tests. Default: none.
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
    /// The guest's key, which identifies the guest permanently. Default `None`: a new key.
    pub identity: Option<Identity>,
    /// Bounds on the cost of the host.
    pub limits: Limits,
    /// Emulated lossy link under the socket, for demonstrations and tests. Default: none.
    pub emulation: Option<Emulation>,
    /// The guest's own address. Default `None`: any free port, on loopback for a host on loopback,
    /// otherwise on every interface.
    pub bind: Option<SocketAddr>,
}

impl Default for JoinOptions {
    fn default() -> Self {
        Self { identity: None, limits: Limits::guest(), emulation: None, bind: None }
    }
}

/// quinn's buffer of datagrams that wait for the congestion window, bytes. With its default of 1
/// MiB, a 40 Hz stream built up a queue of 3 s.
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
        // Jitter reorders datagrams. A packet counts as lost only when sixteen later packets have
        // overtaken it or 9/8 of the round trip have passed.
        .packet_threshold(16)
        .enable_segmentation_offload(false)
        // Every QUIC path carries 1,200 bytes, and frames are far smaller. Larger packets would
        // only require the detection of black holes.
        .mtu_discovery_config(None)
        .congestion_controller_factory(Arc::new(RateController::new(limits.rate)));
    Ok(Arc::new(config))
}

/// Most handshakes that quinn holds before the host has processed them.
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
    // Early data could be replayed, and a ticket would bypass the pinned key.
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
        assert_eq!(access.role(Some(Token([8; 16])), now), Err(DisconnectReason::UnknownToken));
        assert_eq!(access.role(None, now), Err(DisconnectReason::MissingToken));
        assert_eq!(access.role(Some(held), now + minute), Err(DisconnectReason::ExpiredToken));
        assert_eq!(access.role(Some(watched), now + minute), Ok(Role::Watch));
        assert_eq!(Access::Anyone.role(None, now), Ok(Role::Hold));
        assert!(Access::Tokens(Vec::new()).role(Some(held), now).is_err(), "nobody");
        for role in [Role::Hold, Role::Watch] {
            assert_eq!(Role::from_byte(role.to_byte()), Some(role));
        }
        assert_eq!(Role::from_byte(2), None);
    }
}
