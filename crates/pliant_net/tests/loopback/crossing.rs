//! What is sent arrives, over good links and bad ones, from here and from elsewhere.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use pliant_net::transport::{
    CloseReason, Emulation, Endpoint, Event, HostOptions, Identity, Invite, JoinOptions, PeerId, SendError,
};
use pliant_stream::emulator::Preset;

use crate::endpoints::{closed, connected, datagram, guest, host, message};

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

    // Three megabytes at 8 Mbit/s take three seconds; half of one is enough to see order and wholeness.
    let model: Bytes = (0..500_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    host.send_message(at_host, model.clone()).unwrap();
    host.send_message(at_host, Bytes::new()).unwrap();
    host.send_message(at_host, Bytes::from_static(b"last")).unwrap();
    let start = Instant::now();
    assert_eq!(message(&guest), model);
    let seconds = start.elapsed().as_secs_f64();
    assert!(seconds > 0.4, "500 kB in {seconds} s is above the cap of 8 Mbit/s");
    assert_eq!(message(&guest), "");
    assert_eq!(message(&guest), "last");
    guest.send_message(at_guest, Bytes::from_static(b"thanks")).unwrap();
    assert_eq!(message(&host), "thanks");

    let most = host.max_datagram_size(at_host).unwrap();
    assert!((1100..1200).contains(&most), "QUIC's smallest packet less its headers, not {most}");
    let large = Bytes::from(vec![0; most + 1]);
    assert_eq!(host.send_datagram(at_host, large), Err(SendError::TooLarge { len: most + 1, most }));
    host.send_datagram(at_host, Bytes::from(vec![7; most])).unwrap();
    assert_eq!(datagram(&guest).len(), most);

    std::thread::sleep(Duration::from_millis(150));
    let stats = host.stats(at_host).unwrap();
    assert_eq!((stats.sent_datagrams, stats.received_datagrams, stats.dropped.too_large), (2, 1, 1));
    assert!(stats.round_trip < Duration::from_millis(100) && stats.loss() == 0.0, "{stats:?}");

    guest.send_message(at_guest, Bytes::from_static(b"said before leaving")).unwrap();
    guest.close(at_guest, "bye\n\u{7}now");
    assert_eq!(message(&host), "said before leaving");
    assert_eq!(closed(&host), CloseReason::ByPeer { words: "byenow".into() });
    assert_eq!(closed(&guest), CloseReason::ByUs);
    assert_eq!(host.send_datagram(at_host, Bytes::new()), Err(SendError::NotConnected));
    assert!(host.peers().is_empty());
}

#[test]
fn dropping_an_endpoint_says_goodbye() {
    let host = host();
    let guest = guest(&host.invite());
    connected(&guest);
    connected(&host);
    let start = Instant::now();
    drop(guest);
    assert!(matches!(closed(&host), CloseReason::ByPeer { .. }));
    assert!(start.elapsed() < Duration::from_millis(900), "sooner than any timeout: {:?}", start.elapsed());
    let guest = self::guest(&host.invite());
    connected(&guest);
    drop(host);
    assert!(matches!(closed(&guest), CloseReason::ByPeer { words } if words.contains("host")));
}

#[test]
fn a_lossy_link_loses_its_share_of_datagrams_and_no_message() {
    let host = Endpoint::host(HostOptions::default()).unwrap();
    let emulation = Emulation::preset(Preset::Paper1, 1);
    let options = JoinOptions { emulation: Some(emulation), ..JoinOptions::default() };
    let guest = Endpoint::join(&host.invite(), options).unwrap();
    connected(&guest);
    let (peer, _) = connected(&host);
    let model = Bytes::from(vec![5; 100_000]);
    host.send_message(peer, model.clone()).unwrap();
    let (mut at_host, mut at_guest, mut whole) = (0, 0, false);
    let sent = 500;
    for _ in 0..sent {
        host.send_datagram(peer, Bytes::from(vec![0; 270])).unwrap();
        guest.send_datagram(PeerId::HOST, Bytes::from(vec![0; 40])).unwrap();
        std::thread::sleep(Duration::from_millis(4));
        while let Some(event) = guest.poll() {
            match event {
                Event::Datagram { .. } => at_guest += 1,
                Event::Message { bytes, .. } => whole |= bytes == model,
                other => panic!("{other:?}"),
            }
        }
        at_host += std::iter::from_fn(|| host.poll()).count();
    }
    std::thread::sleep(Duration::from_millis(400));
    while let Some(event) = guest.poll() {
        at_guest += usize::from(matches!(event, Event::Datagram { .. }));
    }
    at_host += std::iter::from_fn(|| host.poll()).count();
    assert!(whole, "a message of 100 kB did not cross in two seconds");
    let stats = host.stats(peer).unwrap();
    for arrived in [at_host, at_guest] {
        let loss = 1.0 - arrived as f64 / f64::from(sent);
        // Three standard deviations of a share of 9 % in 500 are 3.8 %. A window that backed off would lose far more.
        assert!((loss - 0.09).abs() < 0.04, "lost {loss}: {stats:?}");
    }
    let round_trip = stats.round_trip.as_secs_f64();
    assert!((0.19..0.30).contains(&round_trip), "196 ms and the acknowledgement's delay, not {round_trip}");
    assert!((stats.loss() - 0.09).abs() < 0.05, "QUIC's own count: {stats:?}");
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
    // Datagrams and messages go on, both ways, and nobody was told of an end.
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(2) && host.address(peer) != Some(after) {
        guest.send_datagram(PeerId::HOST, Bytes::from_static(b"moved")).unwrap();
        host.send_datagram(peer, Bytes::from_static(b"seen")).unwrap();
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(host.address(peer), Some(after), "the host sees where the guest is now");
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
    let median = |mut times: Vec<f64>| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    };
    let bare = median((0..9).map(|_| round()).collect());
    // The fourth network: no loss, 20 ms there and back. It stands on the guest's side only, for both directions.
    guest.set_emulation(Some(Emulation::preset(Preset::Paper4, 1)));
    let with = median((0..9).map(|_| round()).collect());
    guest.set_emulation(None);
    let without = median((0..9).map(|_| round()).collect());
    assert!(bare < 0.010 && without < 0.010, "bare {bare} s, without a link again {without} s");
    assert!((0.019..0.040).contains(&with), "20 ms and the scheduler's, not {with} s");
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
    // While it is in, joining again means nothing.
    guest.rejoin();
    second.send_message(PeerId(1), Bytes::from_static(b"hello again")).unwrap();
    assert_eq!(message(&guest), "hello again");
}
