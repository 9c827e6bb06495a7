//! What a port does with connections, calls and messages, and what it bounds.

use std::time::{Duration, Instant};

use bevy::prelude::*;
use bytes::Bytes;
use pliant_net::transport::{
    Carrier, CarrierPort, Channel, Event, Fingerprint, Limits, MeshCarrier, PeerId, RateCap, RemotePath,
    SendError,
};
use pliant_net::{
    DisconnectReason, HostConfig, JoinConfig, NetPlugin, Role, SessionClosed, SessionCommands, SessionState,
};

use super::network::{CLIENT, Network, ROOM, SERVER};
use super::sessions::state;
use super::support::{self, alone, app, messages, must, wait_for};

/// Two ports that are connected without loss or delay.
pub(super) fn ports() -> (CarrierPort, CarrierPort, impl Fn()) {
    let network = Network::new();
    let (server, client) = (network.server, network.client);
    let (from, to) = (server.clone(), client.clone());
    let carry = move || loop {
        let (down, up) = (from.poll(), to.poll());
        if down.is_none() && up.is_none() {
            return;
        }
        down.into_iter().for_each(|out| to.receive(SERVER, out.channel, out.bytes));
        up.into_iter().for_each(|out| from.receive(CLIENT, out.channel, out.bytes));
    };
    (server, client, carry)
}

pub(super) fn closed(carrier: &impl Carrier) -> Option<DisconnectReason> {
    std::iter::from_fn(|| carrier.poll()).find_map(|event| match event {
        Event::Closed { reason, .. } => Some(reason),
        _ => None,
    })
}

/// A message of a port: what it is, the number of the connection, and its content.
fn raw(kind: u8, number: u16, content: &[u8]) -> Bytes {
    let [low, high] = number.to_le_bytes();
    [&[kind, low, high], content].concat().into()
}

fn drained(carrier: &impl Carrier) -> Vec<Event> {
    std::iter::from_fn(|| carrier.poll()).collect()
}

#[test]
fn what_arrives_late_from_an_earlier_connection_is_dropped() {
    let (server, client, carry) = ports();
    let host = server.host(Limits::host());
    let first = client.join(SERVER, Limits::guest());
    carry();
    assert!(matches!(host.poll(), Some(Event::Connected { peer: PeerId(1), role: Role::Hold, .. })));
    first.send_datagram(PeerId::HOST, Bytes::from_static(b"late")).unwrap();
    let late = client.poll().unwrap();
    first.send_message(PeerId::HOST, Bytes::from_static(b"last words")).unwrap();
    first.end();
    // The next connection begins while the first one's goodbye waits.
    let second = client.join(SERVER, Limits::guest());
    carry();
    let came: Vec<Event> = std::iter::from_fn(|| host.poll()).collect();
    // The peers have turns.
    let [words, joined, left] = &came[..] else { panic!("{came:?}") };
    assert!(matches!(words, Event::Message { bytes, .. } if bytes == "last words"));
    assert!(matches!(joined, Event::Connected { peer: PeerId(2), .. }));
    assert!(matches!(left, Event::Closed { peer: PeerId(1), reason: DisconnectReason::Left }));
    assert!(matches!(second.poll(), Some(Event::Connected { .. })));
    server.receive(CLIENT, late.channel, late.bytes);
    assert!(host.poll().is_none(), "a datagram of the first connection");
    second.send_datagram(PeerId::HOST, Bytes::from_static(b"new")).unwrap();
    carry();
    assert!(matches!(host.poll(), Some(Event::Datagram { peer: PeerId(2), bytes, .. }) if bytes == "new"));
    let most = second.max_datagram_size(PeerId::HOST).unwrap();
    assert_eq!(most, ROOM - 2);
    let long = Bytes::from(vec![0; most + 1]);
    assert_eq!(second.send_datagram(PeerId::HOST, long), Err(SendError::TooLarge { len: most + 1, most }));
    host.close(PeerId(2), DisconnectReason::Kicked);
    carry();
    assert_eq!([closed(&host), closed(&second)], [Some(DisconnectReason::Kicked); 2]);
}

#[test]
fn a_port_bounds_what_others_make_of_it() {
    let (server, client, carry) = ports();
    let early = client.join(SERVER, Limits::guest());
    carry();
    assert_eq!(closed(&early), Some(DisconnectReason::Silent), "nobody hosts");
    let limits = Limits { message: 100, peers: 1, queued_datagrams: 4, ..Limits::host() };
    let host = server.host(limits);
    early.rejoin();
    carry();
    assert!(matches!(early.poll(), Some(Event::Connected { .. })));
    for n in 0..10 {
        early.send_datagram(PeerId::HOST, Bytes::copy_from_slice(&[n])).unwrap();
        carry();
    }
    let came: Vec<Event> = std::iter::from_fn(|| host.poll()).collect();
    assert_eq!(came.len(), 1 + 4, "{came:?}");
    assert_eq!(host.stats(PeerId(1)).unwrap().dropped.receive_queue_full, 6);
    // Another end finds no room.
    let path = RemotePath { key: Fingerprint::of_name(b"other"), role: Role::Watch, max_datagram: ROOM };
    server.connected(8, path);
    server.receive(8, Channel::Message, Bytes::from_static(&[0, 1, 0]));
    let answer = server.poll().unwrap();
    let full = DisconnectReason::Full.code();
    assert_eq!((answer.remote, &answer.bytes[..]), (8, [3, 1, 0, full].as_slice()));
    // Garbage is nobody's.
    for garbage in [&[][..], &[9], &[2, 1], &[2, 9, 9, 1], &[3, 1, 0], &[1, 1, 0, 9], &[255; 40]] {
        for channel in [Channel::Message, Channel::Datagram] {
            for remote in [CLIENT, 8, 99] {
                server.receive(remote, channel, Bytes::from_static(garbage));
            }
        }
    }
    assert!(host.poll().is_none());
    early.send_message(PeerId::HOST, Bytes::from(vec![0; 101])).unwrap();
    carry();
    assert_eq!([closed(&host), closed(&early)], [Some(DisconnectReason::Protocol); 2]);

    // Messages obey the cap on the rate, and datagrams do not wait for them.
    let limits = Limits { rate: RateCap::from_mbit_per_s(0.1), ..Limits::guest() };
    let host = server.host(Limits::host());
    let slow = client.join(SERVER, limits);
    carry();
    assert!(matches!(slow.poll(), Some(Event::Connected { .. })));
    let begin = Instant::now();
    (0..100).for_each(|_| slow.send_message(PeerId::HOST, Bytes::from(vec![0; 90])).unwrap());
    assert!(slow.unsent(PeerId::HOST) > 9000);
    carry();
    slow.send_datagram(PeerId::HOST, Bytes::from_static(b"now")).unwrap();
    carry();
    let came: Vec<Event> = std::iter::from_fn(|| host.poll()).collect();
    assert!(came.iter().any(|event| matches!(event, Event::Datagram { .. })));
    wait_for("all messages are sent", || {
        carry();
        slow.unsent(PeerId::HOST) == 0
    });
    // 100 messages with 60 bytes around each, without the half of the first 4 KiB.
    let least = (100.0 * 150.0 - 4096.0) / 12_500.0;
    assert!(begin.elapsed().as_secs_f64() > least, "{:?}, at least {least} s", begin.elapsed());
}

#[test]
fn a_call_that_is_forgotten_or_not_answered_ends() {
    let (server, client, carry) = ports();
    let (one, two) = (server.mesh(Limits::host()), client.mesh(Limits::host()));
    let invite = CarrierPort::invite_of(Fingerprint::of_name(b"server"));
    let call = two.call(&invite).unwrap();
    carry();
    let connected = |event| matches!(event, Some(Event::Connected { .. }));
    assert!(connected(one.poll()) && connected(two.poll()) && two.peers() == [call]);
    // Nothing is heard of one that is forgotten, here.
    two.forget(call);
    carry();
    assert!(two.poll().is_none() && two.peers().is_empty());
    assert_eq!(closed(&one), Some(DisconnectReason::Left));
    // An attempt that nobody answers ends.
    let quick = client.mesh(Limits { handshake: Duration::from_millis(20), ..Limits::host() });
    let another = quick.call(&invite).unwrap();
    wait_for("the attempt ends", || match quick.poll() {
        Some(Event::Closed { peer, reason: DisconnectReason::Silent }) => peer == another,
        _ => false,
    });
}

#[test]
fn an_end_that_opens_again_and_again_bars_nobody_and_ends_no_guests_session() {
    let _alone = alone();
    let mut network = Network::new();
    let server = network.server.clone();
    let liar = RemotePath { key: Fingerprint::of_name(b"liar"), role: Role::Hold, max_datagram: ROOM };
    let opens = |port: &CarrierPort, remote: u64, range: std::ops::Range<u16>| {
        range.for_each(|number| port.receive(remote, Channel::Message, raw(0, number, &[])));
    };
    server.connected(8, liar);
    let host = server.host(Limits::host());
    opens(&server, 8, 0..300);
    opens(&server, CLIENT, 0..1);
    let connected = drained(&host).into_iter().filter(|event| matches!(event, Event::Connected { .. }));
    let keys: Vec<Fingerprint> = connected
        .filter_map(|event| match event {
            Event::Connected { fingerprint, .. } => Some(fingerprint),
            _ => None,
        })
        .collect();
    assert!(keys.contains(&Fingerprint::of_name(b"client")));
    assert!(keys.len() <= 1 + 8, "{} connections of one end at once", keys.len() - 1);
    assert_eq!(host.peers().len(), 2, "the one that it has stays");
    drop(host);
    while server.poll().is_some() {}

    // A session lets a newcomer in while the other goes on, 300 times in each frame.
    let (mut ann, mut bob) = (app(NetPlugin::default()), app(NetPlugin::default()));
    ann.world_mut().commands().host_session_over(server.host(Limits::host()), HostConfig::default());
    let guest = network.client.join(SERVER, Limits::guest());
    bob.world_mut().commands().join_session_over(guest, JoinConfig::default());
    network.run_until(&mut [&mut ann, &mut bob], "Bob is in", |apps| {
        opens(&server, 8, 0..300);
        state(apps[1]) == SessionState::Joined
    });

    // A guest hosts nothing, and what its server opens is refused beside its session.
    let client = network.client.clone();
    opens(&client, SERVER, 0..1);
    let answer = client.poll();
    let silent = DisconnectReason::Silent.code();
    assert_eq!(answer.map(|out| out.bytes), Some(raw(3, 0, &[silent])));
    let begin = support::tick(&bob);
    network.run_until(&mut [&mut ann, &mut bob], "a second", |apps| support::tick(apps[1]) > begin + 40);
    assert_eq!((state(&bob), messages::<SessionClosed>(&bob).len()), (SessionState::Joined, 0));
}

#[test]
fn no_more_than_the_longest_message_waits_for_an_app_that_does_not_read() {
    let (server, _, _) = ports();
    let host = server.host(Limits::host());
    server.receive(CLIENT, Channel::Message, raw(0, 1, &[]));
    for _ in 0..100 {
        server.receive(CLIENT, Channel::Message, raw(2, 1, &[0; 100_000]));
    }
    while server.poll().is_some() {}
    let came = drained(&host);
    let lengths = came.iter().map(|event| match event {
        Event::Message { bytes, .. } => bytes.len(),
        _ => 0,
    });
    let unread: usize = lengths.sum();
    assert!(unread > 900_000 && unread <= Limits::host().message, "{unread} bytes wait");
    assert!(matches!(came.last(), Some(Event::Closed { reason: DisconnectReason::Unread, .. })));
}

#[test]
fn a_long_state_may_come_at_once_also_on_a_connection_that_another_peer_has_opened() {
    let (server, _, _) = ports();
    let mesh = server.mesh(Limits::host());
    server.receive(CLIENT, Channel::Message, raw(0, 1, &[]));
    // A state comes in messages of at most 256 KiB, and a netcode that stood still delivers them
    // between two frames.
    for _ in 0..20 {
        server.receive(CLIENT, Channel::Message, raw(2, 1, &[0; 250_000]));
    }
    while server.poll().is_some() {}
    let came = drained(&mesh);
    let count = came.iter().filter(|event| matches!(event, Event::Message { .. })).count();
    assert_eq!((count, came.len()), (20, 21), "{:?}", came.last());
}

#[test]
fn a_call_of_one_who_is_there_ends_and_the_connection_stays() {
    let mut network = Network::with_delay(Duration::from_millis(100));
    let [server, client] = [b"server".as_slice(), b"client"].map(Fingerprint::of_name);
    let [to_server, to_client] = [server, client].map(CarrierPort::invite_of);
    let (one, two) = (network.server.mesh(Limits::host()), network.client.mesh(Limits::host()));
    let carry = |network: &mut Network, delays: u32| {
        let begin = Instant::now();
        while begin.elapsed() < delays * network.delay {
            network.carry();
            std::thread::sleep(Duration::from_millis(2));
        }
    };
    let ends = |events: &[Event]| {
        let ends = events.iter().filter_map(|event| match event {
            Event::Closed { reason, .. } => Some(*reason),
            _ => None,
        });
        ends.collect::<Vec<_>>()
    };
    // They call each other at the same moment: one of the two attempts ends.
    let calls = [one.call(&to_client).unwrap(), two.call(&to_server).unwrap()];
    carry(&mut network, 8);
    let came = [drained(&one), drained(&two)];
    assert_eq!([one.peers().len(), two.peers().len()], [1, 1], "{came:?}");
    let all = [ends(&came[0]), ends(&came[1])].concat();
    assert_eq!(all, [DisconnectReason::Full], "{came:?}");
    let stays = [one.peers()[0], two.peers()[0]];
    assert_eq!(calls.iter().zip(&stays).filter(|(call, stays)| call == stays).count(), 1);
    // Somebody introduces them to each other again, to the one and then to the other.
    let again = one.call(&to_client).unwrap();
    assert_eq!(closed(&one), Some(DisconnectReason::Full));
    let back = two.call(&to_server).unwrap();
    assert!(
        matches!(two.poll(), Some(Event::Closed { peer, reason: DisconnectReason::Full }) if peer == back)
    );
    one.forget(again);
    carry(&mut network, 4);
    for (from, to, peer) in [(&one as &dyn Carrier, &two as &dyn Carrier, stays[0]), (&two, &one, stays[1])] {
        from.send_message(peer, Bytes::from_static(b"still here")).unwrap();
        carry(&mut network, 2);
        let came: Vec<Event> = std::iter::from_fn(|| to.poll()).collect();
        assert!(matches!(&came[..], [Event::Message { bytes, .. }] if bytes == "still here"), "{came:?}");
    }

    // The client's app begins anew, of which the netcode says nothing. Its own call gets in.
    drop(two);
    while network.client.poll().is_some() {}
    let anew = |network: &mut Network| {
        network.client = CarrierPort::new(client);
        let path = RemotePath { key: server, role: Role::Hold, max_datagram: ROOM };
        network.client.connected(SERVER, path);
    };
    anew(&mut network);
    let two = network.client.mesh(Limits::host());
    let call = two.call(&to_server).unwrap();
    carry(&mut network, 4);
    assert_eq!(two.peers(), [call]);
    assert_eq!((ends(&drained(&one)), one.peers().len()), (vec![DisconnectReason::Replaced], 1));
    // And it is called once it has said that it does not know the connection before.
    drop(two);
    while network.client.poll().is_some() {}
    anew(&mut network);
    let two = network.client.mesh(Limits::host());
    one.send_message(one.peers()[0], Bytes::from_static(b"are you there?")).unwrap();
    carry(&mut network, 4);
    assert_eq!((ends(&drained(&one)), one.peers().len()), (vec![DisconnectReason::Lost], 0));
    let call = one.call(&to_client).unwrap();
    carry(&mut network, 4);
    assert_eq!((one.peers(), two.peers().len()), (vec![call], 1));
}

#[test]
fn datagrams_do_not_wait_behind_a_long_message() {
    let (server, client, carry) = ports();
    let host = server.host(Limits::host());
    let rate = RateCap::from_mbit_per_s(2.0);
    let guest = client.join(SERVER, Limits { rate, ..Limits::guest() });
    carry();
    drained(&host);
    let long: Bytes = (0..256 << 10).map(|n: u32| (n % 251) as u8).collect();
    let begin = Instant::now();
    guest.send_message(PeerId::HOST, long.clone()).unwrap();
    // The first poll starts with the message.
    carry();
    let mut datagrams = 0;
    let came = wait_for("the message has arrived", || {
        guest.send_datagram(PeerId::HOST, Bytes::from(vec![0; 300])).unwrap();
        while let Some(out) = client.poll() {
            assert!(out.bytes.len() <= 2051, "a part of {} bytes", out.bytes.len());
            server.receive(CLIENT, out.channel, out.bytes);
        }
        std::thread::sleep(Duration::from_millis(20));
        let came = drained(&host);
        let at_once = came.iter().filter(|event| matches!(event, Event::Datagram { .. })).count();
        assert_eq!(at_once, 1, "datagrams that arrive at once, after {:?}", begin.elapsed());
        datagrams += 1;
        came.into_iter().find_map(|event| match event {
            Event::Message { bytes, .. } => Some(bytes),
            _ => None,
        })
    });
    let took = begin.elapsed().as_secs_f64();
    println!("{datagrams} datagrams beside a message of 256 KiB, which took {took:.2} s");
    assert!(came == long && datagrams > 3);
    // Half of the bucket is there at once.
    let least = (262_144.0 - 0.5 * 0.05 * 250_000.0) / 250_000.0;
    assert!(took > least, "{took} s, at least {least} s");
}

#[test]
fn a_message_in_parts_is_no_longer_than_the_longest() {
    let (server, _, _) = ports();
    let host = server.host(Limits { message: 100, ..Limits::host() });
    let receive = |bytes| server.receive(CLIENT, Channel::Message, bytes);
    receive(raw(0, 1, &[]));
    [raw(4, 1, &[1; 40]), raw(4, 1, &[2; 40]), raw(2, 1, &[3; 20])].into_iter().for_each(receive);
    let whole = [[1; 40].as_slice(), &[2; 40], &[3; 20]].concat();
    assert!(matches!(&drained(&host)[1..], [Event::Message { bytes, .. }] if *bytes == whole));
    [raw(4, 1, &[1; 60]), raw(4, 1, &[2; 41])].into_iter().for_each(receive);
    while server.poll().is_some() {}
    assert_eq!(closed(&host), Some(DisconnectReason::Protocol));
    // Of one that ends amid a message nothing more comes, and the next one begins anew.
    receive(raw(0, 2, &[]));
    receive(raw(4, 2, &[1; 40]));
    receive(raw(3, 2, &[0]));
    receive(raw(0, 3, &[]));
    receive(raw(2, 3, &[5]));
    let came = drained(&host).into_iter().filter_map(|event| match event {
        Event::Message { bytes, .. } => Some(bytes),
        _ => None,
    });
    assert_eq!(came.collect::<Vec<_>>(), [Bytes::from_static(&[5])]);
}

#[test]
fn what_a_closing_connection_has_queued_keeps_its_goodbye_for_a_second() {
    // A busy machine is late now and then, so the test waits for a round in which it is not.
    wait_for("a goodbye in time", || {
        let (server, client, carry) = ports();
        let host = server.host(Limits::host());
        let rate = RateCap::from_mbit_per_s(0.1);
        let guest = client.join(SERVER, Limits { rate, ..Limits::guest() });
        carry();
        drained(&host);
        // 32 s at this rate.
        (0..4).for_each(|_| guest.send_message(PeerId::HOST, Bytes::from(vec![0; 100_000])).unwrap());
        let begin = Instant::now();
        guest.end();
        let reason = wait_for("the goodbye arrives", || {
            carry();
            closed(&host)
        });
        let took = begin.elapsed().as_secs_f64();
        println!("the goodbye arrives after {took:.2} s");
        assert_eq!(reason, DisconnectReason::Left);
        assert!(took > 0.99, "what is queued has its second: {took} s");
        // The last part of it that was sent takes 0.16 s at this rate.
        must!(took < 1.5, "{took} s");
        Ok(())
    });
}

#[test]
fn an_attempt_that_another_one_replaces_is_told() {
    let port = CarrierPort::new(Fingerprint::of_name(b"client"));
    let first = port.join(SERVER, Limits::guest());
    let second = port.join(SERVER, Limits::guest());
    assert_eq!(closed(&first), Some(DisconnectReason::Replaced), "it waits for the server");
    assert_eq!(closed(&second), None);
}
