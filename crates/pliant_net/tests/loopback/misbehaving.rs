//! Tests with guests that violate the protocol or fail.

use std::net::{SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use bytes::Bytes;
use pliant_net::transport::{
    ALPN, Carrier, Endpoint, Event, HostOptions, Identity, Invite, JoinOptions, Limits, PeerId, RateCap,
    SendError,
};
use pliant_stream::DisconnectReason;

use super::endpoints::{closed, connected, datagram, guest, host, message, patient, quick};
use super::unauthenticated::UnauthenticatedPeer;
use crate::support::alone;
use crate::support::wait::{must, wait_for};

#[test]
fn a_message_over_the_limit_ends_the_connection_of_its_sender_only() {
    let limits = Limits { message: 1000, ..Limits::host() };
    let host = Endpoint::host(HostOptions { limits, ..HostOptions::default() }).unwrap();
    let (bad, good) = (guest(&host.invite()), guest(&host.invite()));
    connected(&bad);
    connected(&good);
    bad.send_message(PeerId::HOST, Bytes::from(vec![0; 1000])).unwrap();
    assert_eq!(message(&host).len(), 1000);
    bad.send_message(PeerId::HOST, Bytes::from(vec![0; 1001])).unwrap();
    assert_eq!([closed(&host), closed(&bad)], [DisconnectReason::Protocol; 2]);
    good.send_message(PeerId::HOST, Bytes::from_static(b"still here")).unwrap();
    assert_eq!(message(&host), "still here");
}

#[test]
fn garbage_on_the_port_disturbs_nobody() {
    let _alone = alone();
    let host = host();
    let guest = guest(&host.invite());
    connected(&guest);
    let (peer, _) = connected(&host);
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let mut state = 0x2545_f491_4f6c_dd1d_u64;
    for i in 0..2000usize {
        let bytes: Vec<u8> = (0..i % 1300)
            .map(|_| {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                state as u8
            })
            .collect();
        socket.send_to(&bytes, host.local_address()).unwrap();
    }
    // The system drops packets while the garbage fills the host's socket, so the guest repeats the
    // datagram until it arrives.
    let received = wait_for("a datagram gets through", || {
        guest.send_datagram(PeerId::HOST, Bytes::from_static(b"through")).unwrap();
        host.poll()
    });
    assert!(matches!(&received, Event::Datagram { bytes, .. } if bytes == "through"), "{received:?}");
    host.send_datagram(peer, Bytes::from_static(b"and back")).unwrap();
    assert_eq!(datagram(&guest), "and back");
}

#[test]
fn a_guest_that_dies_without_a_word_is_noticed_after_the_idle_timeout() {
    let host =
        Endpoint::host(HostOptions { limits: quick(Limits::host()), ..HostOptions::default() }).unwrap();
    let patient = super::endpoints::host();
    let start = Instant::now();
    let unauthenticated = UnauthenticatedPeer::new(ALPN, true);
    let connections = [&patient, &host].map(|host| {
        let connection = unauthenticated.connect(host).unwrap();
        unauthenticated.runtime.block_on(async {
            let (mut send, mut recv) = connection.open_bi().await.unwrap();
            send.write_all(&0u32.to_le_bytes()).await.unwrap();
            let mut welcome = [9; 5];
            recv.read_exact(&mut welcome).await.unwrap();
            std::mem::forget((send, recv));
        });
        connection
    });
    let (peer, _) = connected(&host);
    connected(&patient);
    // From here on nothing drives this guest's side, as if its process had been killed.
    assert_eq!(closed(&host), DisconnectReason::Silent);
    // The host last received from the guest after `start`. The patient host, whose timeout is 30 s,
    // last received before that.
    let after = start.elapsed().as_secs_f64();
    assert!(after > 2.0, "the idle timeout is 2 s, noticed after {after} s");
    let event = patient.poll();
    assert!(event.is_none(), "{event:?}, though its idle timeout is far longer");
    assert!(host.stats(peer).is_none());
    std::mem::forget(connections);
}

#[test]
fn a_guest_that_never_reads_costs_a_bounded_queue() {
    // At a low rate, little data waits in the system's buffers for a thread that runs late.
    let slow = |limits| Limits { rate: RateCap::from_mbit_per_s(1.0), ..patient(limits) };
    let limits = Limits { queued_messages: 1 << 20, ..slow(Limits::host()) };
    let host = Endpoint::host(HostOptions { limits, ..HostOptions::default() }).unwrap();
    let guest_limits = Limits { queued_messages: 1 << 16, ..slow(Limits::guest()) };
    let options = JoinOptions {
        limits: guest_limits,
        identity: Some(Identity::generate().unwrap()),
        ..JoinOptions::default()
    };
    let guest = Endpoint::join(&host.invite(), options).unwrap();
    let (peer, _) = connected(&host);
    let part = Bytes::from(vec![0; 100_000]);
    let mut taken = 0;
    let error = loop {
        match host.send_message(peer, part.clone()) {
            Ok(()) => taken += 1,
            Err(error) => break error,
        }
        assert!(taken < 200, "20 MB queued for a guest that reads nothing");
    };
    assert_eq!(error, SendError::QueueFull { len: part.len() });
    // Waiting messages do not delay datagrams, and the oldest datagrams make room for the newest.
    for i in 0..200u8 {
        host.send_datagram(peer, Bytes::copy_from_slice(&[i])).unwrap();
    }
    // All datagrams that were not dropped have arrived, and wait unread.
    wait_for("all datagrams are on one side or the other", || {
        let host = host.stats(peer).ok_or("the guest is gone")?;
        let guest = guest.stats(PeerId::HOST).ok_or("the guest is not in yet")?;
        must!(host.sent_datagrams + host.dropped.send_queue_full == 200, "{host:?}");
        must!(guest.received_datagrams == host.sent_datagrams, "{host:?}, {guest:?}");
        Ok(())
    });
    connected(&guest);
    let mut got = Vec::new();
    wait_for("the newest datagram", || {
        let events = std::iter::from_fn(|| guest.poll());
        got.extend(events.filter_map(|event| match event {
            Event::Datagram { bytes, .. } => Some(bytes[0]),
            _ => None,
        }));
        got.last() == Some(&199)
    });
    let dropped = host.stats(peer).unwrap().dropped.send_queue_full as usize;
    let unread = guest.stats(PeerId::HOST).unwrap().dropped.receive_queue_full as usize;
    assert_eq!(
        got.len() + dropped + unread,
        200,
        "{} read, {dropped} not sent, {unread} not read",
        got.len()
    );
    // The guest's waiting messages delay the goodbye too, and the host closes the connection a
    // second later anyway. Nothing else would end this connection, since the guest's thread answers
    // as long as the guest exists.
    host.close(peer, DisconnectReason::Unread);
    assert_eq!(closed(&host), DisconnectReason::Unread);
}

#[cfg_attr(not(target_os = "linux"), ignore = "needs 127.0.0.2 on the loopback interface")]
#[test]
fn a_thousand_connections_from_one_address_cost_the_others_nothing() {
    let _alone = alone();
    // Connections that have reached the handshake keep their places until the test is over, however
    // long it takes.
    let long = Duration::from_secs(600);
    let limits = Limits { per_address: 8, handshake: long, idle_timeout: long, ..Limits::host() };
    let bind = "0.0.0.0:0".parse().unwrap();
    let host = Endpoint::host(HostOptions { bind, limits, ..HostOptions::default() }).unwrap();
    let port = host.local_address().port();
    let good = guest(&Invite::new(SocketAddr::from(([127, 0, 0, 1], port)), host.fingerprint()));
    connected(&good);
    connected(&host);
    // Another address of this machine stands for an attacker's address. It opens 1,000 handshakes,
    // and none of them sends anything afterwards.
    let unauthenticated = UnauthenticatedPeer::new(ALPN, true);
    let target = SocketAddr::from(([127, 0, 0, 1], port));
    let began = Instant::now();
    let open = unauthenticated.runtime.block_on(async {
        let socket = UdpSocket::bind("127.0.0.2:0").unwrap();
        unauthenticated.endpoint.rebind(socket).unwrap();
        let mut attempts = tokio::task::JoinSet::new();
        for _ in 0..1000 {
            let connecting = unauthenticated.endpoint.connect(target, "pliant").unwrap();
            attempts.spawn(async move { connecting.await.ok() });
        }
        let mut open = Vec::new();
        while let Some(done) = attempts.join_next().await {
            open.extend(done.unwrap());
        }
        open
    });
    // Twice as many as there are places may arrive at once, and half as many each second.
    let arrived = 16 + 4 * (1 + began.elapsed().as_secs() as usize);
    assert!(open.len() <= arrived, "{} got as far as a handshake, not {arrived}", open.len());
    let places = unauthenticated.live_until("eight have a place", || {
        let left = open.iter().filter(|connection| connection.close_reason().is_none()).count();
        (left <= 8).then_some(left)
    });
    assert!(places > 0);
    good.send_message(PeerId::HOST, Bytes::from_static(b"as ever")).unwrap();
    assert_eq!(message(&host), "as ever");
    // A second guest from the first guest's address is admitted at once.
    let another = guest(&Invite::new(target, host.fingerprint()));
    connected(&another);
}

#[test]
fn silent_connections_bar_nobody_and_who_has_spoken_stays() {
    // All come from one address, which has room for 64, at a host that has room for 64 and one.
    // The handshakes of the silent ones would last as long as the test.
    let long = Duration::from_secs(600);
    let limits = Limits { peers: 65, handshake: long, idle_timeout: long, ..Limits::host() };
    let host = Endpoint::host(HostOptions { limits, ..HostOptions::default() }).unwrap();
    let present = guest(&host.invite());
    connected(&present);
    let (peer, _) = connected(&host);
    present.send_message(PeerId::HOST, Bytes::from_static(b"hello")).unwrap();
    assert_eq!(message(&host), "hello");
    let unauthenticated = UnauthenticatedPeer::new(ALPN, true);
    // Half of them show no token, and the other half show one and say nothing more.
    let connections: Vec<quinn::Connection> = (0..64)
        .map(|k| {
            let connection = unauthenticated.connect(&host).unwrap();
            if k % 2 == 1 {
                unauthenticated.runtime.block_on(async {
                    let (mut send, recv) = connection.open_bi().await.unwrap();
                    send.write_all(&0u32.to_le_bytes()).await.unwrap();
                    std::mem::forget((send, recv));
                });
            }
            connection
        })
        .collect();
    let newcomer = guest(&host.invite());
    unauthenticated.live_until("a newcomer gets in", || match newcomer.poll() {
        Some(Event::Closed { reason, .. }) => panic!("the newcomer is not let in: {reason}"),
        event => event.is_some(),
    });
    newcomer.send_message(PeerId::HOST, Bytes::from_static(b"newcomer")).unwrap();
    unauthenticated.live_until("it is heard", || match host.poll() {
        Some(Event::Message { bytes, .. }) => bytes == "newcomer",
        _ => false,
    });
    assert!(host.stats(peer).is_some(), "who has spoken stays");
    drop(connections);
}
