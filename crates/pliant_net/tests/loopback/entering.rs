//! Tests of which guests are admitted.

use std::net::UdpSocket;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use pliant_net::transport::{
    ALPN, Access, Carrier, Endpoint, Event, Fingerprint, Grant, HostOptions, Invite, JoinOptions, Limits,
    PeerId, Role, Token,
};
use pliant_stream::DisconnectReason;
use pliant_stream::wire::PROTOCOL_VERSION;

use super::endpoints::{closed, connected, guest, host, is_first_heard_of, message, next};
use super::unauthenticated::UnauthenticatedPeer;

#[test]
fn another_key_than_the_invites_is_refused() {
    let host = host();
    let mut invite = host.invite();
    invite.fingerprint = Fingerprint([1; 32]);
    let guest = guest(&invite);
    assert_eq!(closed(&guest), DisconnectReason::WrongKey);
    // The host's application receives no event of that guest.
    is_first_heard_of(&host);
}

#[test]
fn tokens_are_asked_for_and_say_the_role() {
    let [held, watched, spent] = [(); 3].map(|()| Token::generate().unwrap());
    let access = Access::Tokens(vec![
        Grant::hold(held),
        Grant::watch(watched),
        Grant::hold(spent).until(SystemTime::now()),
    ]);
    let host = Endpoint::host(HostOptions { access, ..HostOptions::default() }).unwrap();
    let invite = host.invite();
    assert_eq!(invite.token, Some(held));
    let role = |endpoint: &Endpoint| {
        next(endpoint, |event| match event {
            Event::Connected { role, .. } => Some(role),
            // Other events belong to the previous guest, at the host.
            _ => None,
        })
    };
    for (token, expected) in [(held, Role::Hold), (watched, Role::Watch)] {
        let guest = guest(&Invite { token: Some(token), ..invite.clone() });
        assert_eq!((role(&guest), role(&host)), (expected, expected), "both ends know");
    }
    for (token, expected) in [
        (None, DisconnectReason::MissingToken),
        (Some(Token([0; 16])), DisconnectReason::UnknownToken),
        (Some(spent), DisconnectReason::ExpiredToken),
    ] {
        assert_eq!(closed(&guest(&Invite { token, ..invite.clone() })), expected);
    }
    // With no valid token left, connected guests stay and no new guest is admitted.
    let inside = guest(&invite);
    connected(&inside);
    host.set_access(Access::Tokens(Vec::new()));
    assert_eq!(closed(&guest(&invite)), DisconnectReason::UnknownToken);
    inside.send_message(PeerId::HOST, Bytes::from_static(b"still here")).unwrap();
    let message = next(&host, |event| match event {
        Event::Message { bytes, .. } => Some(bytes),
        _ => None,
    });
    assert_eq!(message, "still here");
}

#[test]
fn a_host_that_is_not_there_is_reported() {
    let silent = UdpSocket::bind("127.0.0.1:0").unwrap();
    let limits = Limits { handshake: Duration::from_millis(700), ..Limits::guest() };
    let invite = Invite::new(silent.local_addr().unwrap(), Fingerprint([0; 32]));
    let guest = Endpoint::join(&invite, JoinOptions { limits, ..JoinOptions::default() }).unwrap();
    assert_eq!(closed(&guest), DisconnectReason::Silent);
    // No part of a name may be longer than 63 characters, so the resolver rejects this name without
    // asking the network.
    let nowhere = Invite { host: format!("no-such-host-{}", "x".repeat(64)), ..invite };
    let guest = self::guest(&nowhere);
    assert_eq!(closed(&guest), DisconnectReason::UnknownHost);
}

#[test]
fn a_full_host_refuses_the_next_guest() {
    let limits = Limits { peers: 1, ..Limits::host() };
    let host = Endpoint::host(HostOptions { limits, ..HostOptions::default() }).unwrap();
    let first = guest(&host.invite());
    connected(&first);
    connected(&host);
    // Who has said something keeps its place.
    first.send_message(PeerId::HOST, Bytes::from_static(b"hello")).unwrap();
    message(&host);
    assert_eq!(closed(&guest(&host.invite())), DisconnectReason::Full);
    drop(first);
    closed(&host);
    connected(&guest(&host.invite()));
}

#[test]
fn another_version_is_refused_in_the_handshake() {
    let host = host();
    let before = format!("pliant/{}", PROTOCOL_VERSION - 1);
    for other in ["pliant/0", &before] {
        let error = UnauthenticatedPeer::new(other.as_bytes(), true).connect(&host).unwrap_err();
        assert!(error.to_string().contains("120"), "no_application_protocol is alert 120: {error}");
    }
    is_first_heard_of(&host);
}

/// The page that others read to speak the protocol has its version in three places.
#[test]
fn the_page_has_the_version() {
    let page =
        std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/protocol.md")).unwrap();
    let alpn = String::from_utf8_lossy(ALPN);
    assert_eq!(alpn, format!("pliant/{PROTOCOL_VERSION}"));
    for text in [
        format!("# The streaming protocol, version {PROTOCOL_VERSION}\n"),
        format!("Hello carries is {PROTOCOL_VERSION}."),
        format!("(ALPN `{alpn}`)"),
        format!("| 0 | Hello | version u16 = {PROTOCOL_VERSION}; name"),
        format!("| 0 | Hello | version u16 = {PROTOCOL_VERSION}; user"),
    ] {
        assert!(page.contains(&text), "docs/protocol.md lacks {text:?}");
    }
}

#[test]
fn a_guest_without_a_key_is_refused() {
    let host = host();
    let unauthenticated = UnauthenticatedPeer::new(ALPN, false);
    // The client's side of the handshake completes before the host refuses.
    if let Ok(connection) = unauthenticated.connect(&host) {
        let error = unauthenticated.runtime.block_on(connection.closed()).to_string();
        assert!(
            error.contains("116") || error.contains("certificate"),
            "certificate_required is alert 116: {error}"
        );
    }
    is_first_heard_of(&host);
}

#[test]
fn datagrams_before_the_token_do_not_count_and_garbage_after_it_is_the_applications() {
    let host = host();
    let unauthenticated = UnauthenticatedPeer::new(ALPN, true);
    let connection = unauthenticated.connect(&host).unwrap();
    connection.send_datagram(Bytes::from_static(b"early")).unwrap();
    // The datagram is sent before the stream is opened, and packets on loopback stay in order.
    let out = || connection.stats().frame_tx.datagram == 1;
    unauthenticated.live_until("the early datagram is sent", out);
    // The guest is not admitted before its token.
    let _other = is_first_heard_of(&host);
    unauthenticated.runtime.block_on(async {
        let (mut send, mut recv) = connection.open_bi().await.unwrap();
        send.write_all(&0u32.to_le_bytes()).await.unwrap();
        let mut welcome = [9; 5];
        recv.read_exact(&mut welcome).await.unwrap();
        assert_eq!(welcome, [1, 0, 0, 0, 0], "one byte: the role");
        connection.send_datagram(Bytes::from_static(b"\xff\x00garbage")).unwrap();
    });
    connected(&host);
    let came = unauthenticated.live_until("the first datagram that counts", || host.poll());
    assert!(matches!(&came, Event::Datagram { bytes, .. } if bytes == &b"\xff\x00garbage"[..]), "{came:?}");

    // The first message is not a token.
    let second = unauthenticated.connect(&host).unwrap();
    let error = unauthenticated.runtime.block_on(async {
        let (mut send, _recv) = second.open_bi().await.unwrap();
        send.write_all(b"\x05\x00\x00\x00hello").await.unwrap();
        second.closed().await
    });
    assert_eq!(error.to_string(), "closed by peer: 3", "the code of a broken protocol");
}
