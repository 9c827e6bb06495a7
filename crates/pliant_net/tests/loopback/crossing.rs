//! Tests of delivery, over good and bad links, and after a change of address.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use pliant_net::transport::{
    Carrier, Emulation, Endpoint, Event, HostOptions, Identity, Invite, JoinOptions, Limits, PeerId, RateCap,
    SendError, TransportError,
};
use pliant_stream::DisconnectReason;
use pliant_stream::emulator::{LinkConfig, Loss, Preset};

use super::endpoints::{closed, connected, datagram, guest, host, message, patient};
use crate::support::wait::{must, wait_for};

#[test]
fn datagrams_and_messages_cross_both_ways_and_a_goodbye_is_heard() {
    let host = host();
    let invite: Invite = host.invite().to_string().parse().unwrap();
    let guest = guest(&invite);
    let (at_guest, host_key) = connected(&guest);
    let (at_host, guest_key) = connected(&host);
    assert_eq!(at_guest, PeerId::HOST);
    assert_eq!((host_key, guest_key), (host.fingerprint(), guest.fingerprint()));

    host.send_datagram(at_host, Bytes::from_static(b"frame")).unwrap();
    assert_eq!(datagram(&guest), "frame");
    guest.send_datagram(at_guest, Bytes::from_static(b"target")).unwrap();
    assert_eq!(datagram(&host), "target");

    let most = host.max_datagram_size(at_host).unwrap();
    assert!((1100..1200).contains(&most), "QUIC's smallest packet less its headers, not {most}");
    let large = Bytes::from(vec![0; most + 1]);
    assert_eq!(host.send_datagram(at_host, large), Err(SendError::TooLarge { len: most + 1, most }));
    host.send_datagram(at_host, Bytes::from(vec![7; most])).unwrap();
    assert_eq!(datagram(&guest).len(), most);

    // This little data fits every buffer of the system, however late a thread empties it, so
    // nothing is lost.
    wait_for("the figures", || {
        let stats = host.stats(at_host).unwrap();
        must!((stats.sent_datagrams, stats.received_datagrams) == (2, 1), "{stats:?}");
        must!(stats.dropped.too_large == 1, "{stats:?}");
        must!(stats.round_trip < Duration::from_millis(100), "{stats:?}");
        must!(stats.loss() == 0.0, "{stats:?}");
        Ok(())
    });

    // Three megabytes at 8 Mbit/s take three seconds. Half a megabyte is enough to check order and
    // completeness.
    let start = Instant::now();
    let model: Bytes = (0..500_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    host.send_message(at_host, model.clone()).unwrap();
    host.send_message(at_host, Bytes::new()).unwrap();
    host.send_message(at_host, Bytes::from_static(b"last")).unwrap();
    assert_eq!(message(&guest), model);
    let seconds = start.elapsed().as_secs_f64();
    assert!(seconds > 0.4, "500 kB in {seconds} s is above the cap of 8 Mbit/s");
    assert_eq!(message(&guest), "");
    assert_eq!(message(&guest), "last");
    guest.send_message(at_guest, Bytes::from_static(b"thanks")).unwrap();
    assert_eq!(message(&host), "thanks");

    guest.send_message(at_guest, Bytes::from_static(b"said before leaving")).unwrap();
    guest.close(at_guest, DisconnectReason::Full);
    assert_eq!(message(&host), "said before leaving");
    assert_eq!([closed(&host), closed(&guest)], [DisconnectReason::Full; 2]);
    assert_eq!(host.send_datagram(at_host, Bytes::new()), Err(SendError::NotConnected));
    assert!(host.peers().is_empty());
}

#[test]
fn dropping_an_endpoint_says_goodbye() {
    let host = host();
    let guest = guest(&host.invite());
    connected(&guest);
    connected(&host);
    // The close reason shows that the goodbye arrived. The idle timeout would give another reason.
    drop(guest);
    assert_eq!(closed(&host), DisconnectReason::Left);
    let guest = self::guest(&host.invite());
    connected(&guest);
    drop(host);
    assert_eq!(closed(&guest), DisconnectReason::Left);
}

/// Returns how many datagrams an endpoint has delivered since the last call, and adds the lengths
/// of its messages to `whole`.
fn arrived(endpoint: &Endpoint, whole: &mut Vec<usize>) -> usize {
    let datagram = |event| match event {
        Event::Datagram { .. } => 1,
        Event::Message { bytes, .. } => {
            whole.push(bytes.len());
            0
        }
        other => panic!("{other:?}"),
    };
    std::iter::from_fn(|| endpoint.poll()).map(datagram).sum()
}

#[test]
fn a_lossy_link_loses_its_share_of_datagrams_and_no_message() {
    // The link has no rate limit, and the endpoints have a low rate and queues for all datagrams.
    // The data that waits for a late thread then fits every buffer, so that only the link loses
    // packets, and equally many at any speed.
    let slow = |limits: Limits| {
        let (queued_datagrams, rate) = (2000, RateCap::from_mbit_per_s(2.0));
        patient(Limits { queued_datagrams, rate, ..limits })
    };
    let link = LinkConfig { bits_per_second: None, ..LinkConfig::preset(Preset::Paper1) };
    let emulation = Some(Emulation { outgoing: link.clone(), incoming: link, seed: 1 });
    let host =
        Endpoint::host(HostOptions { limits: slow(Limits::host()), ..HostOptions::default() }).unwrap();
    let options = JoinOptions { emulation, limits: slow(Limits::guest()), ..JoinOptions::default() };
    let guest = Endpoint::join(&host.invite(), options).unwrap();
    connected(&guest);
    let (peer, _) = connected(&host);
    let model = Bytes::from(vec![5; 100_000]);
    host.send_message(peer, model.clone()).unwrap();
    let sent = 1000;
    // Two of these datagrams do not fit one packet. Otherwise the loss of one would also lose the
    // other.
    for _ in 0..sent {
        host.send_datagram(peer, Bytes::from(vec![0; 700])).unwrap();
        guest.send_datagram(PeerId::HOST, Bytes::from(vec![0; 700])).unwrap();
    }
    let (mut at_host, mut at_guest) = ((0, Vec::new()), (0, Vec::new()));
    let mut listen = || {
        at_host.0 += arrived(&host, &mut at_host.1);
        at_guest.0 += arrived(&guest, &mut at_guest.1);
        (at_host.clone(), at_guest.clone())
    };
    let out = |endpoint: &Endpoint, peer| endpoint.stats(peer).unwrap().sent_datagrams == sent;
    wait_for("all is sent", || {
        listen();
        out(&host, peer) && out(&guest, PeerId::HOST)
    });
    // The last message arrives after all datagrams that are not lost.
    host.send_message(peer, Bytes::from_static(b"end")).unwrap();
    guest.send_message(PeerId::HOST, Bytes::from_static(b"end")).unwrap();
    let (at_host, at_guest) = wait_for("the last words", || {
        let (at_host, at_guest) = listen();
        (at_host.1 == [3] && at_guest.1 == [model.len(), 3]).then_some((at_host, at_guest))
    });
    let stats = host.stats(peer).unwrap();
    for (arrived, _) in [at_host, at_guest] {
        let loss = 1.0 - arrived as f64 / sent as f64;
        // Four standard deviations of a share of 9 % in 1,000 are 3.6 %.
        assert!((loss - 0.09).abs() < 0.04, "lost {loss}: {stats:?}");
    }
    assert_eq!(stats.dropped.all() + guest.stats(PeerId::HOST).unwrap().dropped.all(), 0);
    // A controller that backs off at a loss would be at about 5 kB by now, which is 200 kbit/s.
    assert!(stats.window > 50_000, "{stats:?}");
    // The open connection continues to measure the round trip.
    wait_for("196 ms and the acknowledgement's delay, QUIC's own count of the loss", || {
        let stats = host.stats(peer).unwrap();
        must!((0.19..0.30).contains(&stats.round_trip.as_secs_f64()), "{stats:?}");
        must!((stats.loss() - 0.09).abs() < 0.05, "{stats:?}");
        Ok(())
    });
}

#[test]
fn a_guest_that_changes_its_address_stays_connected() {
    let host = host();
    let guest = guest(&host.invite());
    connected(&guest);
    let (peer, _) = connected(&host);
    let before = guest.local_address();
    guest.rebind("127.0.0.1:0".parse().unwrap()).unwrap();
    let after = guest.local_address();
    assert_ne!(before, after);
    // Datagrams and messages continue in both directions, and neither side reports a closed
    // connection.
    wait_for("the host sees where the guest is now", || {
        guest.send_datagram(PeerId::HOST, Bytes::from_static(b"moved")).unwrap();
        host.send_datagram(peer, Bytes::from_static(b"seen")).unwrap();
        std::thread::sleep(Duration::from_millis(20));
        host.address(peer) == Some(after)
    });
    guest.send_message(PeerId::HOST, Bytes::from_static(b"from there")).unwrap();
    assert_eq!(message(&host), "from there");
    host.send_message(peer, Bytes::from_static(b"to there")).unwrap();
    assert_eq!(message(&guest), "to there");
}

#[test]
fn a_link_is_put_under_an_open_session_and_taken_out_again() {
    let host = Endpoint::host(HostOptions::default()).unwrap();
    let guest = Endpoint::join(&host.invite(), JoinOptions::default()).unwrap();
    connected(&guest);
    let (peer, _) = connected(&host);
    let round = || {
        let start = Instant::now();
        guest.send_datagram(PeerId::HOST, Bytes::from_static(b"ping")).unwrap();
        assert_eq!(datagram(&host), "ping");
        host.send_datagram(peer, Bytes::from_static(b"pong")).unwrap();
        assert_eq!(datagram(&guest), "pong");
        start.elapsed().as_secs_f64()
    };
    // A busy machine makes a round trip longer, and nothing makes it shorter than its link. The
    // test therefore takes medians of nine until one is short enough. With the link, none is ever
    // as short as without it.
    let median = |longest: f64| {
        let nine = || {
            let mut times: [f64; 9] = std::array::from_fn(|_| round());
            times.sort_by(f64::total_cmp);
            must!(times[4] < longest, "{times:?}");
            Ok(times)
        };
        wait_for("nine rounds of which most are short enough", nine)
    };
    median(0.010);
    // The fourth network has no loss and a round trip of 20 ms. The emulation is only on the
    // guest's side, for both directions.
    guest.set_emulation(Some(Emulation::preset(Preset::Paper4, 1)));
    let with = median(0.040);
    assert!(with[0] > 0.019, "a round over 20 ms took {} s", with[0]);
    guest.set_emulation(None);
    median(0.010);
}

#[test]
fn a_guest_joins_again_after_its_host_has_come_back() {
    let identity = Identity::generate().unwrap().to_pkcs8();
    let host_at = |bind: SocketAddr| {
        let identity = Some(Identity::from_pkcs8(&identity).unwrap());
        Endpoint::host(HostOptions { bind, identity, ..HostOptions::default() }).unwrap()
    };
    let first = host_at("127.0.0.1:0".parse().unwrap());
    let (address, invite) = (first.local_address(), first.invite());
    let guest = guest(&invite);
    connected(&guest);
    let (_, key) = connected(&first);
    drop(first);
    closed(&guest);
    let second = host_at(address);
    guest.rejoin();
    connected(&guest);
    assert_eq!(connected(&second).1, key, "the same key, so the same user");
    // A call of `rejoin` on an open connection has no effect.
    guest.rejoin();
    second.send_message(PeerId(1), Bytes::from_static(b"hello again")).unwrap();
    assert_eq!(message(&guest), "hello again");
}

#[test]
fn the_next_host_at_an_address_begins_while_the_last_one_says_goodbye() {
    let first = host();
    let bind = first.local_address();
    let next_host = || Endpoint::host(HostOptions { bind, ..HostOptions::default() });
    assert!(matches!(next_host(), Err(TransportError::Bind { address, .. }) if address == bind));
    let old = guest(&first.invite());
    connected(&old);
    let (at_first, _) = connected(&first);
    // The link takes a second to the guest, so that the goodbye is under way when the next begins.
    let link = LinkConfig { delay: Duration::from_secs(1), ..LinkConfig::default() };
    first.set_emulation(Some(Emulation { outgoing: link, incoming: LinkConfig::default(), seed: 1 }));
    first.send_message(at_first, Bytes::from_static(b"the last words")).unwrap();
    let dropping = std::thread::spawn(move || drop(first));
    let second = wait_for("the address is free", || next_host().ok());
    assert!(!dropping.is_finished(), "the first one still waits for its guest");
    let new = guest(&second.invite());
    connected(&new);
    connected(&second);
    assert_eq!(message(&old), "the last words");
    assert_eq!(closed(&old), DisconnectReason::Left);
    dropping.join().unwrap();
    second.send_message(PeerId(1), Bytes::from_static(b"still here")).unwrap();
    assert_eq!(message(&new), "still here");
    drop((new, second));
    std::net::UdpSocket::bind(bind).unwrap();
}

#[test]
fn the_reason_of_the_end_arrives_over_a_link_that_loses_the_last_packet() {
    let limits = Limits { keep_alive: Duration::from_secs(10), ..Limits::host() };
    let host = Endpoint::host(HostOptions { limits, ..HostOptions::default() }).unwrap();
    // The guests have nothing to send, so that nothing makes the host repeat a packet that only
    // says that the connection is closed.
    let limits = || Limits {
        idle_timeout: Duration::from_secs(3),
        keep_alive: Duration::from_secs(10),
        ..Limits::guest()
    };
    let join = || Endpoint::join(&host.invite(), JoinOptions { limits: limits(), ..JoinOptions::default() });
    let guests: Vec<Endpoint> = (0..48).map(|_| join().unwrap()).collect();
    let peers: Vec<PeerId> = guests.iter().map(|_| connected(&host).0).collect();
    let delay = Duration::from_millis(10);
    let lossy = LinkConfig { loss: Loss::Random(0.09), delay, ..LinkConfig::default() };
    host.set_emulation(Some(Emulation { outgoing: lossy.clone(), incoming: lossy, seed: 1 }));
    for &peer in &peers[..24] {
        host.close(peer, DisconnectReason::Kicked);
    }
    (0..24).for_each(|_| assert_eq!(closed(&host), DisconnectReason::Kicked));
    drop(host);
    let mut reasons: Vec<DisconnectReason> = guests.iter().map(closed).collect();
    reasons.sort_by_key(|reason| reason.code());
    let (left, kicked) = ([DisconnectReason::Left; 24], [DisconnectReason::Kicked; 24]);
    assert_eq!(reasons, [left, kicked].concat());
}
