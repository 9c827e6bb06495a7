//! The network thread's side of an endpoint.

use std::future::{Future, poll_fn};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::pin::pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::task::Poll;
use std::time::{Duration, SystemTime};

use bevy::platform::time::Instant;
use bytes::Bytes;
use pliant_stream::{DisconnectReason, PeerId, Role};
use quinn::{
    ClientConfig, Connection, ConnectionError, Incoming, RecvStream, SendDatagramError, SendStream,
    ServerConfig, TransportErrorCode, VarInt,
};
use rustls::pki_types::CertificateDer;
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};
use tracing::{debug, warn};

use super::carrier::Event;
use super::congestion::Bucket;
use super::connections::{GRACE, MESSAGE_PART, PeerConnection};
use super::endpoint::EndpointShared;
use super::identity::{Fingerprint, SERVER_NAME};
use super::invite::Invite;
use super::queue::{Next, lock};
use super::slots::Reservation;
use super::stats::PeerStats;
use super::wire::{self, ReadMessageError, TOKEN_MESSAGE};

/// Returns the code that closes a connection for a reason.
fn code_of(reason: DisconnectReason) -> VarInt {
    VarInt::from_u32(reason.code().into())
}

/// The role of this endpoint.
#[derive(Debug)]
pub(super) enum Side {
    Host { server: ServerConfig },
    Guest { client: ClientConfig, invite: Invite, refused: Arc<Mutex<Option<Fingerprint>>> },
}

/// Runs until the endpoint is over and its connections have ended.
pub(super) async fn run(shared: &Arc<EndpointShared>, quic: &quinn::Endpoint, side: Side) {
    match side {
        Side::Host { .. } => accept(shared, quic).await,
        Side::Guest { client, invite, refused } => loop {
            join(shared, quic, client.clone(), &invite, &refused).await;
            // The application decides when the next attempt begins.
            tokio::select! {
                () = shared.stopped() => break,
                () = shared.reconnect.notified() => {}
            }
        },
    }
}

/// Number of open handshakes above which a new guest must first prove its address.
const HANDSHAKES_BEFORE_RETRY: usize = 16;

async fn accept(shared: &Arc<EndpointShared>, quic: &quinn::Endpoint) {
    let handshakes = Arc::new(AtomicUsize::new(0));
    let mut guests = JoinSet::new();
    let mut stopped = pin!(shared.stopped());
    loop {
        let incoming = tokio::select! {
            // The next host at this address may accept on the same socket already. Whoever came
            // for it would be refused here.
            biased;
            () = &mut stopped => break,
            Some(_) = guests.join_next() => continue,
            incoming = quic.accept() => match incoming {
                Some(incoming) => incoming,
                None => break,
            },
        };
        let open = handshakes.load(Ordering::Relaxed);
        let address = incoming.remote_address();
        if shared.connections.inbox.overloaded() {
            debug!(%address, "refused a guest: the application does not read");
            incoming.refuse();
        } else if open >= HANDSHAKES_BEFORE_RETRY
            && incoming.may_retry()
            && !incoming.remote_address_validated()
        {
            if let Err(error) = incoming.retry() {
                debug!(%address, %error, "could not ask a guest to prove its address");
            }
        } else {
            let Some(slot) = Reservation::take(&shared.slots, &shared.connections.limits, address.ip())
            else {
                debug!(%address, "refused a guest: no room, or too many from its address");
                incoming.refuse();
                continue;
            };
            handshakes.fetch_add(1, Ordering::Relaxed);
            let (shared, handshakes) = (Arc::clone(shared), Arc::clone(&handshakes));
            guests.spawn(async move {
                let leaving = slot.leaving();
                let welcomed = tokio::select! {
                    welcomed = timeout(shared.connections.limits.handshake, welcome(&shared, incoming, slot)) => welcomed,
                    () = leaving.notified() => Ok(Err(DisconnectReason::Silent)),
                    () = shared.stopped() => Ok(Err(DisconnectReason::Left)),
                };
                handshakes.fetch_sub(1, Ordering::Relaxed);
                match welcomed {
                    Ok(Ok(guest)) => guest.serve(&shared).await,
                    Ok(Err(why)) => debug!(%address, %why, "a guest did not get in"),
                    Err(_) => debug!(%address, "a guest did not finish its handshake in time"),
                }
            });
        }
    }
    // Each guest gets its last messages and a goodbye, for which [`hang_up`] has a limit.
    while guests.join_next().await.is_some() {}
}

/// An open connection after a complete handshake.
struct OpenConnection {
    peer: PeerId,
    role: Role,
    fingerprint: Fingerprint,
    connection: Connection,
    send: SendStream,
    recv: RecvStream,
    /// The slot at this host. `None` on a guest.
    slot: Option<Reservation>,
}

/// The host's half of the handshake.
async fn welcome(
    shared: &EndpointShared,
    incoming: Incoming,
    slot: Reservation,
) -> Result<OpenConnection, DisconnectReason> {
    let connection = incoming.accept().map_err(reason_of)?.await.map_err(reason_of)?;
    let Some(fingerprint) = fingerprint_of(&connection) else {
        connection.close(code_of(DisconnectReason::Protocol), &[]);
        return Err(DisconnectReason::Protocol);
    };
    let (mut send, mut recv) = connection.accept_bi().await.map_err(reason_of)?;
    let first = wire::read_message(&mut recv, TOKEN_MESSAGE).await;
    let token = first.ok().and_then(|first| wire::token_from_message(&first).ok());
    let access = Arc::clone(&lock(&shared.access));
    let role = match token {
        Some(token) => access.role(token, SystemTime::now()),
        None => Err(DisconnectReason::Protocol),
    };
    let role = match role {
        Ok(role) => role,
        Err(reason) => {
            say_goodbye(&connection, &mut send, reason).await;
            return Err(reason);
        }
    };
    discard_early(&connection).await;
    let answered = async {
        wire::write_prefix(&mut send, 1).await?;
        send.write_all(&[role.to_byte()]).await
    };
    if answered.await.is_err() {
        return Err(DisconnectReason::Lost);
    }
    let peer = PeerId(shared.next_peer.fetch_add(1, Ordering::Relaxed));
    Ok(OpenConnection { peer, role, fingerprint, connection, send, recv, slot: Some(slot) })
}

/// The guest's half of the handshake: one attempt, whose result is reported as an event.
async fn join(
    shared: &EndpointShared,
    endpoint: &quinn::Endpoint,
    client: ClientConfig,
    invite: &Invite,
    refused: &Mutex<Option<Fingerprint>>,
) {
    let entered = tokio::select! {
        entered = timeout(shared.connections.limits.handshake, enter(endpoint, client, invite, refused)) => entered,
        () = shared.stopped() => Ok(Err(DisconnectReason::Left)),
    };
    match entered.unwrap_or(Err(DisconnectReason::Silent)) {
        Ok(host) => host.serve(shared).await,
        Err(reason) => shared.connections.ended(PeerId::HOST, reason),
    }
}

async fn enter(
    endpoint: &quinn::Endpoint,
    client: ClientConfig,
    invite: &Invite,
    refused: &Mutex<Option<Fingerprint>>,
) -> Result<OpenConnection, DisconnectReason> {
    let resolved = tokio::net::lookup_host((invite.host.as_str(), invite.port)).await;
    let address = match resolved.map(|mut addresses| addresses.next()) {
        Ok(Some(address)) => address,
        Ok(None) => return Err(DisconnectReason::UnknownHost),
        Err(error) => {
            warn!("`{}` does not resolve: {error}", invite.host);
            return Err(DisconnectReason::UnknownHost);
        }
    };
    // The socket was bound before the name was resolved. On an IPv6 socket, an IPv4 address is used
    // in its mapped form.
    let address = match (address, endpoint.local_addr()) {
        (SocketAddr::V4(v4), Ok(SocketAddr::V6(_))) => {
            SocketAddr::from((v4.ip().to_ipv6_mapped(), v4.port()))
        }
        (address, _) => address,
    };
    let reason = |error| {
        let Some(found) = *lock(refused) else { return reason_of(error) };
        warn!("the host shows the key {found}, the invite says {}", invite.fingerprint);
        DisconnectReason::WrongKey
    };
    let connecting = endpoint.connect_with(client, address, SERVER_NAME).map_err(|error| {
        debug!("cannot connect to {address}: {error}");
        DisconnectReason::Lost
    })?;
    let connection = connecting.await.map_err(reason)?;
    let (mut send, mut recv) = connection.open_bi().await.map_err(reason)?;
    let token = wire::token_to_message(invite.token);
    let written = async {
        wire::write_prefix(&mut send, token.len()).await?;
        send.write_all(&token).await
    };
    let welcomed = match written.await {
        Ok(()) => wire::read_message(&mut recv, 1).await,
        Err(error) => {
            debug!("the host did not take the token: {error}");
            // The end of the connection carries the reason.
            return Err(reason(connection.closed().await));
        }
    };
    let role = match welcomed.map(|message| message.first().copied().and_then(Role::from_byte)) {
        Ok(Some(role)) => role,
        Err(ReadMessageError::Goodbye(reason)) => return Err(reason),
        Ok(None) | Err(ReadMessageError::TooLong { .. }) => return Err(DisconnectReason::Protocol),
        Err(ReadMessageError::Ended(_)) => {
            let closed = timeout(Duration::from_millis(200), connection.closed()).await;
            return Err(closed.map_or(DisconnectReason::Lost, reason));
        }
    };
    Ok(OpenConnection {
        peer: PeerId::HOST,
        role,
        fingerprint: invite.fingerprint,
        connection,
        send,
        recv,
        slot: None,
    })
}

/// Returns the address to which a socket for the host of `invite` is bound.
pub(super) fn address_for_joining(invite: &Invite) -> SocketAddr {
    match invite.host.parse::<IpAddr>() {
        Ok(IpAddr::V4(host)) if host.is_loopback() => (Ipv4Addr::LOCALHOST, 0).into(),
        Ok(IpAddr::V6(host)) if host.is_loopback() => (Ipv6Addr::LOCALHOST, 0).into(),
        Ok(IpAddr::V6(_)) => (Ipv6Addr::UNSPECIFIED, 0).into(),
        _ => (Ipv4Addr::UNSPECIFIED, 0).into(),
    }
}

fn fingerprint_of(connection: &Connection) -> Option<Fingerprint> {
    let chain = connection.peer_identity()?.downcast::<Vec<CertificateDer<'static>>>().ok()?;
    Fingerprint::of_certificate(chain.first()?).ok()
}

/// The TLS alert of a host that has no protocol in common with the guest (RFC 7301).
const NO_APPLICATION_PROTOCOL: u8 = 120;

fn reason_of(error: ConnectionError) -> DisconnectReason {
    match error {
        ConnectionError::LocallyClosed => DisconnectReason::Left,
        ConnectionError::TimedOut => DisconnectReason::Silent,
        ConnectionError::ApplicationClosed(close) => {
            let code = u8::try_from(close.error_code.into_inner());
            code.map_or(DisconnectReason::Left, wire::reason_with_code)
        }
        ConnectionError::ConnectionClosed(close)
            if close.error_code == TransportErrorCode::CONNECTION_REFUSED =>
        {
            DisconnectReason::Full
        }
        ConnectionError::ConnectionClosed(close)
            if close.error_code == TransportErrorCode::crypto(NO_APPLICATION_PROTOCOL) =>
        {
            DisconnectReason::VersionMismatch
        }
        other => {
            debug!("the connection failed: {other}");
            DisconnectReason::Lost
        }
    }
}

impl OpenConnection {
    /// Carries the connection's traffic until it ends, and reports its beginning and end to the
    /// application.
    async fn serve(self, shared: &EndpointShared) {
        let Self { peer: id, role, fingerprint, connection, mut send, mut recv, slot } = self;
        let peer = Arc::new(PeerConnection::default());
        refresh(&connection, &peer);
        let address = Some(connection.remote_address());
        let connected = Event::Connected { peer: id, fingerprint, address, role };
        let room = shared.connections.open(id, Arc::clone(&peer), connected);
        let bucket = Mutex::new(Bucket::new(shared.connections.limits.rate, Instant::now()));
        let reason = {
            let messages_in = pin!(read_messages(shared, id, &connection, &mut recv, &room, slot.as_ref()));
            let datagrams_in = pin!(read_datagrams(shared, id, &connection, &peer));
            let messages_out = pin!(write_messages(&connection, &peer, &bucket, &mut send));
            let datagrams_out = pin!(write_datagrams(&connection, &peer, &bucket));
            let metrics = pin!(keep_metrics(&connection, &peer));
            let hung_up = pin!(hang_up(shared, &connection, &peer));
            let makes_room = pin!(make_room(&connection, slot.as_ref()));
            tokio::select! {
                reason = messages_in => reason,
                reason = messages_out => reason,
                reason = hung_up => reason,
                reason = makes_room => reason,
                error = connection.closed() => reason_of(error),
                () = datagrams_in => unreachable_end(),
                () = datagrams_out => unreachable_end(),
                () = metrics => unreachable_end(),
            }
        };
        debug!(peer = id.0, %reason, "connection closed");
        shared.connections.ended(id, reason);
    }
}

/// The three tasks without a result run until the connection is closed, which another arm reports.
fn unreachable_end() -> DisconnectReason {
    DisconnectReason::Lost
}

/// Discards datagrams that arrived before the welcome. Takes those that are there and does not wait
/// for more.
async fn discard_early(connection: &Connection) {
    loop {
        let mut read = pin!(connection.read_datagram());
        let came =
            poll_fn(|context| Poll::Ready(matches!(read.as_mut().poll(context), Poll::Ready(Ok(_))))).await;
        if !came {
            return;
        }
    }
}

fn refresh(connection: &Connection, peer: &PeerConnection) {
    let stats = connection.stats();
    *lock(&peer.address) = Some(connection.remote_address());
    peer.max_datagram.store(connection.max_datagram_size().unwrap_or(0), Ordering::Relaxed);
    *lock(&peer.stats) = PeerStats {
        round_trip: stats.path.rtt,
        min_round_trip: stats.path.min_rtt,
        sent_packets: stats.path.sent_packets,
        received_packets: stats.udp_rx.datagrams,
        lost_packets: stats.path.lost_packets,
        sent_bytes: stats.udp_tx.bytes,
        received_bytes: stats.udp_rx.bytes,
        sent_datagrams: stats.frame_tx.datagram,
        received_datagrams: stats.frame_rx.datagram,
        window: stats.path.cwnd,
        ..PeerStats::default()
    };
}

async fn keep_metrics(connection: &Connection, peer: &PeerConnection) {
    loop {
        sleep(Duration::from_millis(100)).await;
        refresh(connection, peer);
    }
}

async fn read_messages(
    shared: &EndpointShared,
    id: PeerId,
    connection: &Connection,
    recv: &mut RecvStream,
    room: &Notify,
    slot: Option<&Reservation>,
) -> DisconnectReason {
    let most = shared.connections.limits.unread_messages();
    loop {
        match wire::read_message(recv, shared.connections.limits.message).await {
            Ok(message) => {
                if let Some(slot) = slot {
                    slot.keep();
                }
                shared.connections.inbox.put_message(id, message, most, room).await;
            }
            Err(error @ ReadMessageError::TooLong { .. }) => {
                debug!(peer = id.0, %error, "the connection is closed");
                connection.close(code_of(DisconnectReason::Protocol), &[]);
                return DisconnectReason::Protocol;
            }
            Err(ReadMessageError::Goodbye(reason)) => {
                connection.close(code_of(reason), &[]);
                return reason;
            }
            // The other end has finished its stream, or the connection is gone. The end of the
            // connection carries the reason.
            Err(ReadMessageError::Ended(_)) => std::future::pending().await,
        }
    }
}

async fn read_datagrams(shared: &EndpointShared, id: PeerId, connection: &Connection, peer: &PeerConnection) {
    while let Ok(bytes) = connection.read_datagram().await {
        let dropped = shared.connections.inbox.push_datagram(
            id,
            Instant::now(),
            bytes,
            shared.connections.limits.queued_datagrams,
        );
        if dropped > 0 {
            lock(&peer.dropped).receive_queue_full += dropped;
        }
    }
    std::future::pending().await
}

async fn write_messages(
    connection: &Connection,
    peer: &PeerConnection,
    bucket: &Mutex<Bucket>,
    send: &mut SendStream,
) -> DisconnectReason {
    loop {
        match peer.outbox.wait_next().await {
            Next::Message(bytes) => {
                if write_message(bucket, send, bytes).await.is_err() {
                    std::future::pending::<()>().await;
                }
            }
            Next::Close(reason) => {
                say_goodbye(connection, send, reason).await;
                return reason;
            }
        }
    }
}

/// Tells the reason of the end, and then closes the connection.
async fn say_goodbye(connection: &Connection, send: &mut SendStream, reason: DisconnectReason) {
    // The close gives the reason to an end that has not read the stream so far.
    let _ = timeout(GRACE, wire::write_goodbye(send, reason)).await;
    connection.close(code_of(reason), &[]);
}

/// Closes the connection when the endpoint is over. Does so after [`GRACE`] whenever it is to be
/// closed, even if a peer that does not read delays the messages before the goodbye.
async fn hang_up(
    shared: &EndpointShared,
    connection: &Connection,
    peer: &PeerConnection,
) -> DisconnectReason {
    let reason = tokio::select! {
        reason = peer.outbox.closing() => reason,
        () = shared.stopped() => {
            peer.outbox.close(DisconnectReason::Left);
            peer.outbox.closing().await
        }
    };
    sleep(GRACE).await;
    connection.close(code_of(reason), &[]);
    reason
}

/// Closes a silent connection that must make room for a newcomer.
async fn make_room(connection: &Connection, slot: Option<&Reservation>) -> DisconnectReason {
    match slot {
        Some(slot) => slot.leaving().notified().await,
        None => std::future::pending().await,
    }
    connection.close(code_of(DisconnectReason::Silent), &[]);
    DisconnectReason::Silent
}

async fn write_message(
    bucket: &Mutex<Bucket>,
    send: &mut SendStream,
    bytes: Bytes,
) -> Result<(), quinn::WriteError> {
    wire::write_prefix(send, bytes.len()).await?;
    for part in bytes.chunks(MESSAGE_PART) {
        while let Err(wait) = take_message(bucket, part.len()) {
            sleep(wait).await;
        }
        send.write_all(part).await?;
    }
    Ok(())
}

fn take_message(bucket: &Mutex<Bucket>, len: usize) -> Result<(), Duration> {
    lock(bucket).take_message(len, Instant::now())
}

fn take_datagram(bucket: &Mutex<Bucket>, len: usize) -> Result<(), Duration> {
    lock(bucket).take_datagram(len, Instant::now())
}

async fn write_datagrams(connection: &Connection, peer: &PeerConnection, bucket: &Mutex<Bucket>) {
    loop {
        let len = peer.outbox.first_datagram_len().await;
        if let Err(wait) = take_datagram(bucket, len) {
            sleep(wait).await;
            continue;
        }
        let Some(bytes) = peer.outbox.pop_datagram() else { continue };
        // This waits for room in quinn's small buffer. Excess datagrams are then dropped from this
        // crate's queue, oldest first, and counted.
        match connection.send_datagram_wait(bytes).await {
            Ok(()) => {}
            Err(SendDatagramError::TooLarge) => {
                refresh(connection, peer);
                lock(&peer.dropped).too_large += 1;
            }
            Err(SendDatagramError::ConnectionLost(_)) => std::future::pending::<()>().await,
            Err(SendDatagramError::UnsupportedByPeer | SendDatagramError::Disabled) => {
                lock(&peer.dropped).not_connected += 1;
            }
        }
    }
}
