//! Tests of sessions that ride on an app's own carrier.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use bevy::math::DVec3;
use bevy::prelude::*;
use bytes::Bytes;
use pliant_body::{Grab, GrabForce, GrabOf, ModalAsset, ModalBody};
use pliant_net::transport::{
    Carrier, CarrierPort, Channel, Event, Fingerprint, Limits, MeshCarrier, PeerId, RateCap, RemotePath,
    SendError,
};
use pliant_net::{
    DisconnectReason, HandOf, HostConfig, JoinConfig, NetGuest, NetHost, NetPlugin, NetStats, PeerConfig,
    Role, SessionClosed, SessionCommands, SessionState, SharedBody, User, UserLeft,
};
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss};
use support::{Look, TIP, alone, app, bar, body_of, messages, must, only, wait_for};

const SERVER: u64 = 0;
const CLIENT: u64 = 7;
const ROOM: usize = 1200;

/// A netcode in memory: reliable messages in order, and datagrams of which 9 % are lost and many
/// overtake others.
struct Network {
    began: Instant,
    delay: Duration,
    server: CarrierPort,
    client: CarrierPort,
    /// To the client, and to the server.
    messages: [EmulatedLink<Bytes>; 2],
    datagrams: [EmulatedLink<Bytes>; 2],
}

impl Network {
    fn new() -> Self {
        Self::with_delay(Duration::from_millis(30))
    }

    fn with_delay(delay: Duration) -> Self {
        let keys = [b"server".as_slice(), b"client"].map(Fingerprint::of_name);
        let even = LinkConfig { delay, keep_order: true, ..LinkConfig::default() };
        let uneven = LinkConfig {
            delay,
            loss: Loss::Random(0.09),
            jitter: Duration::from_millis(2),
            reorder: 0.1,
            duplicate: 0.02,
            ..LinkConfig::default()
        };
        let network = Self {
            began: Instant::now(),
            delay,
            server: CarrierPort::new(keys[0]),
            client: CarrierPort::new(keys[1]),
            messages: [1, 2].map(|seed| EmulatedLink::new(even.clone(), seed)),
            datagrams: [3, 4].map(|seed| EmulatedLink::new(uneven.clone(), seed)),
        };
        network.connect();
        network
    }

    fn connect(&self) {
        let path = |key| RemotePath { key, role: Role::Hold, max_datagram: ROOM };
        self.server.connected(CLIENT, path(Fingerprint::of_name(b"client")));
        self.client.connected(SERVER, path(Fingerprint::of_name(b"server")));
        for (port, remote) in [(&self.server, CLIENT), (&self.client, SERVER)] {
            port.set_round_trip(remote, 2 * self.delay);
        }
    }

    fn carry(&mut self) {
        let now = self.began.elapsed();
        for (to, from) in [&self.server, &self.client].into_iter().enumerate() {
            while let Some(out) = from.poll() {
                let len = out.bytes.len();
                match out.channel {
                    Channel::Message => self.messages[to].send(now, out.bytes, len),
                    Channel::Datagram => {
                        assert!(len <= ROOM, "{len} bytes");
                        self.datagrams[to].send(now, out.bytes, len);
                    }
                }
            }
        }
        for (to, (port, remote)) in [(&self.client, SERVER), (&self.server, CLIENT)].into_iter().enumerate() {
            while let Some(bytes) = self.messages[to].poll(now) {
                port.receive(remote, Channel::Message, bytes);
            }
            while let Some(bytes) = self.datagrams[to].poll(now) {
                port.receive(remote, Channel::Datagram, bytes);
            }
        }
    }

    fn run_until<L: Look>(
        &mut self,
        apps: &mut [&mut App],
        awaited: &str,
        mut look: impl FnMut(&mut [&mut App]) -> L,
    ) -> L::Found {
        wait_for(awaited, || {
            std::thread::sleep(Duration::from_millis(4));
            self.carry();
            apps.iter_mut().for_each(|app| app.update());
            look(apps)
        })
    }
}

fn state(app: &App) -> SessionState {
    *app.world().resource::<SessionState>()
}

#[test]
fn a_session_rides_on_another_netcode_at_9_percent_loss() {
    let _alone = alone();
    let (mut ann, mut bob) = (app(NetPlugin::default()), app(NetPlugin::default()));
    let mut network = Network::new();
    let (server, client) = (network.server.clone(), network.client.clone());
    let handle = ann.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    ann.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar")));

    // Joined before anybody hosts: the guest tries until somebody does.
    bob.world_mut().commands().join_session_over(client.join(SERVER, Limits::guest()), JoinConfig::default());
    network.run_until(&mut [&mut ann, &mut bob], "nobody hosts", |apps| {
        let guest = apps[1].world().get_resource::<NetGuest>()?;
        let reason = DisconnectReason::Silent;
        (*guest.state() == pliant_net::GuestState::Lost { reason }).then_some(())
    });
    ann.world_mut().commands().host_session_over(server.host(Limits::host()), HostConfig::default());
    // The model has to cross, too.
    let there = network.run_until(&mut [&mut ann, &mut bob], "the body arrives", |apps| body_of(apps[1]));
    assert_eq!((state(&ann), state(&bob)), (SessionState::Hosting, SessionState::Joined));
    assert!(ann.world().resource::<NetHost>().invite().is_none());

    let target = DVec3::new(1.0, 0.3, 0.2);
    let grab = bob.world_mut().spawn((Grab::new(TIP, 0.3, target), GrabOf(there))).id();
    let force = network.run_until(&mut [&mut ann, &mut bob], "Bob feels what Ann computes", |apps| {
        let mut query = apps[0].world_mut().query::<(&HandOf, &GrabForce)>();
        let felt = query.single(apps[0].world()).map_err(|error| error.to_string())?.1.force;
        let own = apps[1].world().get::<GrabForce>(grab).ok_or("none")?.force;
        must!(felt.length() > 1.0 && own.distance(felt) < 0.02 * felt.length(), "{own}, truly {felt}");
        Ok(felt.length())
    });
    let begin = support::tick(&ann);
    network.run_until(&mut [&mut ann, &mut bob], "ten seconds", |apps| support::tick(apps[0]) > begin + 400);
    let stats = *bob.world().resource::<NetStats>();
    let lost = network.datagrams[0].counts();
    println!(
        "{force:.2} N; {} of {} datagrams to the guest lost, which counts {:.1} %; {:.0} bytes/s in, round trip {:?}",
        lost.lost,
        lost.sent,
        100.0 * stats.loss_in,
        stats.bytes_in_per_s,
        stats.round_trip
    );
    // Four standard deviations of a share of 9 % in 400 are 5.7 %.
    let share = lost.lost as f64 / lost.sent as f64;
    assert!(lost.sent > 300 && (share - 0.09).abs() < 0.06, "{lost:?}");
    assert!(stats.loss_in > 0.02 && stats.loss_in < 0.2 && stats.rejected == 0, "{stats:?}");

    bob.world_mut().commands().leave_session();
    network.run_until(&mut [&mut ann, &mut bob], "Bob has left", |apps| {
        only::<HandOf>(apps[0]).is_none() && messages::<UserLeft>(apps[0]).len() == 1
    });
    assert_eq!(messages::<UserLeft>(&ann)[0].reason, DisconnectReason::Left);
    bob.world_mut().commands().join_session_over(client.join(SERVER, Limits::guest()), JoinConfig::default());
    network.run_until(&mut [&mut ann, &mut bob], "he is back", |apps| body_of(apps[1]));

    // Ann leaves and hosts again in the same frame. What is left of the old session comes first.
    ann.world_mut().commands().leave_session();
    ann.world_mut().commands().host_session_over(server.host(Limits::host()), HostConfig::default());
    network.run_until(&mut [&mut ann, &mut bob], "Bob knows that it is over", |apps| {
        state(apps[0]) == SessionState::Hosting && state(apps[1]) == SessionState::Idle
    });
    let over: Vec<_> = messages::<SessionClosed>(&bob).into_iter().map(|closed| closed.reason).collect();
    assert_eq!(over, [DisconnectReason::Left; 2], "once his own doing, once hers");
    bob.world_mut().commands().join_session_over(client.join(SERVER, Limits::guest()), JoinConfig::default());
    network.run_until(&mut [&mut ann, &mut bob], "he is in the next one", |apps| body_of(apps[1]));

    // The netcode loses him.
    server.disconnected(CLIENT, DisconnectReason::Lost);
    client.disconnected(SERVER, DisconnectReason::Lost);
    network.run_until(&mut [&mut ann, &mut bob], "they have lost each other", |apps| {
        let mut users = apps[0].world_mut().query::<&User>();
        users.iter(apps[0].world()).count() == 1 && state(apps[1]) == SessionState::Lost
    });
    network.connect();
    network.run_until(&mut [&mut ann, &mut bob], "he joins again by himself", |apps| {
        state(apps[1]) == SessionState::Joined
    });
}

/// Two ports that are connected without loss or delay.
fn ports() -> (CarrierPort, CarrierPort, impl Fn()) {
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

fn closed(carrier: &impl Carrier) -> Option<DisconnectReason> {
    std::iter::from_fn(|| carrier.poll()).find_map(|event| match event {
        Event::Closed { reason, .. } => Some(reason),
        _ => None,
    })
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

/// Peers on ports, each connected with each, over links that lose 9 % of the datagrams.
struct Party {
    began: Instant,
    ports: Vec<CarrierPort>,
    /// From the first to the second of each pair: messages, and datagrams.
    links: BTreeMap<(usize, usize), [EmulatedLink<Bytes>; 2]>,
}

fn name(peer: usize) -> Fingerprint {
    Fingerprint::of_name(&[peer as u8])
}

impl Party {
    fn new(count: usize) -> Self {
        let delay = Duration::from_millis(20);
        let even = LinkConfig { delay, keep_order: true, ..LinkConfig::default() };
        let uneven = LinkConfig { delay, loss: Loss::Random(0.09), reorder: 0.1, ..LinkConfig::default() };
        let ports: Vec<CarrierPort> = (0..count).map(|peer| CarrierPort::new(name(peer))).collect();
        let mut links = BTreeMap::new();
        for (from, port) in ports.iter().enumerate() {
            for to in (0..count).filter(|&to| to != from) {
                port.connected(to as u64, RemotePath { key: name(to), role: Role::Hold, max_datagram: ROOM });
                let seed = (10 * from + to) as u64;
                let pair = [(even.clone(), seed), (uneven.clone(), seed + 100)];
                links.insert((from, to), pair.map(|(config, seed)| EmulatedLink::new(config, seed)));
            }
        }
        Self { began: Instant::now(), ports, links }
    }

    fn run_until<L: Look>(
        &mut self,
        apps: &mut [&mut App],
        awaited: &str,
        mut look: impl FnMut(&mut [&mut App]) -> L,
    ) -> L::Found {
        wait_for(awaited, || {
            std::thread::sleep(Duration::from_millis(4));
            let now = self.began.elapsed();
            for (from, port) in self.ports.iter().enumerate() {
                while let Some(out) = port.poll() {
                    let link = self.links.get_mut(&(from, out.remote as usize)).unwrap();
                    let (kind, len) = (usize::from(out.channel == Channel::Datagram), out.bytes.len());
                    link[kind].send(now, out.bytes, len);
                }
            }
            for (&(from, to), links) in &mut self.links {
                for (link, channel) in links.iter_mut().zip([Channel::Message, Channel::Datagram]) {
                    while let Some(bytes) = link.poll(now) {
                        self.ports[to].receive(from as u64, channel, bytes);
                    }
                }
            }
            apps.iter_mut().for_each(|app| app.update());
            look(apps)
        })
    }
}

#[test]
fn three_peers_ride_on_another_netcode_and_all_feel_one_body() {
    let _alone = alone();
    let mut party = Party::new(3);
    let [mut a, mut b, mut c] = [(); 3].map(|()| app(NetPlugin::default()));
    let mut bodies = Vec::new();
    for app in [&mut a, &mut b, &mut c] {
        let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
        bodies.push(app.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar"))).id());
    }
    let join = |app: &mut App, port: &CarrierPort, through: Option<usize>| {
        let join = through.map(|peer| CarrierPort::invite_of(name(peer)));
        let config = PeerConfig { join, ..PeerConfig::default() };
        app.world_mut().commands().join_peers_over(port.mesh(Limits::host()), config);
    };
    let users = |app: &mut App| app.world_mut().query::<&User>().iter(app.world()).count();
    join(&mut a, &party.ports[0], None);
    join(&mut b, &party.ports[1], Some(0));
    party.run_until(&mut [&mut a, &mut b, &mut c], "two are together", |apps| {
        users(apps[0]) == 2 && users(apps[1]) == 2
    });
    // The third one joins through the second, which tells it of the first.
    join(&mut c, &party.ports[2], Some(1));
    let all = |apps: &mut [&mut App]| apps.iter_mut().all(|app| users(app) == 3);
    party.run_until(&mut [&mut a, &mut b, &mut c], "all are together", all);

    let target = DVec3::new(1.0, 0.3, 0.2);
    c.world_mut().spawn((Grab::new(TIP, 0.3, target), GrabOf(bodies[2])));
    party.run_until(&mut [&mut a, &mut b, &mut c], "all see the same", |apps| {
        let shown = apps.iter().zip(&bodies).map(|(app, &body)| {
            app.world().get::<pliant_body::VisualState>(body).map_or(0.0, |visual| visual.q()[0])
        });
        let shown: Vec<f64> = shown.collect();
        must!(shown[0].abs() > 0.05, "{shown:?}");
        must!(shown.iter().all(|q| (q / shown[0] - 1.0).abs() < 0.01), "{shown:?}");
        Ok(())
    });

    // The one through whom the third has come leaves, and the others go on.
    b.world_mut().commands().leave_session();
    party.run_until(&mut [&mut a, &mut b, &mut c], "two go on", |apps| {
        users(apps[0]) == 2 && users(apps[2]) == 2 && state(apps[1]) == SessionState::Idle
    });
    for app in [&a, &c] {
        assert_eq!(messages::<UserLeft>(app)[0].reason, DisconnectReason::Left);
    }
    join(&mut b, &party.ports[1], Some(2));
    party.run_until(&mut [&mut a, &mut b, &mut c], "it comes back", all);

    // One whose netcode has lost another finds it again.
    let lost = DisconnectReason::Lost;
    party.ports[0].disconnected(2, lost);
    party.ports[2].disconnected(0, lost);
    party.run_until(&mut [&mut a, &mut b, &mut c], "they have lost each other", |apps| users(apps[0]) == 2);
    for (one, other) in [(0, 2), (2, 0)] {
        let path = RemotePath { key: name(other), role: Role::Hold, max_datagram: ROOM };
        party.ports[one].connected(other as u64, path);
    }
    party.run_until(&mut [&mut a, &mut b, &mut c], "they are together again", all);

    // Nobody is there by that key.
    b.world_mut().commands().leave_session();
    join(&mut b, &party.ports[1], Some(9));
    party.run_until(&mut [&mut b], "nobody is there", |apps| {
        !messages::<pliant_net::SessionFailed>(apps[0]).is_empty()
    });
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
