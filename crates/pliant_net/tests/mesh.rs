//! Tests of peers with an unauthenticated peer, which writes the peers' messages itself.

use crate::support;

use std::net::UdpSocket;
use std::time::{Duration, Instant};

use bevy::prelude::*;
use bytes::Bytes;
use pliant_body::{ModalAsset, ModalBody};
use pliant_net::transport::{Carrier, Endpoint, Event, JoinOptions, Limits};
use pliant_net::{
    Access, Emulation, Fingerprint, Grant, HostOptions, Identity, Invite, NetPeer, NetPlugin, PeerConfig,
    PeerState, SharedBody, Token, User,
};
use pliant_stream::emulator::{LinkConfig, Loss};
use pliant_stream::wire::{PROTOCOL_VERSION, PeerMessage};
use pliant_stream::{DisconnectReason, PeerId};
use support::{alone, app, bar, must, run_frames, run_until, wait_for};

/// Limits with which peers time out after half a minute, and a new peer has five seconds to
/// introduce itself.
fn limits() -> Limits {
    let (idle_timeout, handshake) = (Duration::from_secs(30), Duration::from_secs(5));
    Limits { idle_timeout, handshake, ..Limits::host() }
}

fn peer(name: &str, join: Option<Invite>, access: Access, limits: Limits) -> App {
    let transport = HostOptions { limits, access, ..HostOptions::default() };
    let mut app =
        app(NetPlugin::peer(PeerConfig { name: name.into(), join, transport, ..PeerConfig::default() })
            .unwrap());
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    app.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar")));
    app
}

fn first(access: Access, limits: Limits) -> (App, Invite) {
    let mut a = peer("a", None, access, limits);
    run_until(&mut [&mut a], "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let invite = a.world().resource::<NetPeer>().invite();
    (a, invite)
}

fn users(app: &mut App) -> usize {
    app.world_mut().query::<&User>().iter(app.world()).count()
}

/// The first message of a peer with the right body. The number 0 requests a number.
fn hello(app: &App, user: u16, invite: &Invite) -> Bytes {
    let hello = PeerMessage::Hello {
        version: PROTOCOL_VERSION,
        user,
        name: "by hand".into(),
        address: invite.to_string(),
        joining: true,
        scene: app.world().resource::<NetPeer>().session().unwrap().scene(),
    };
    hello.encode().into()
}

/// The answer of the peer at `door`, with number 1, to one that requests a number.
fn admit(app: &App, door: &Endpoint, asks: PeerId, user: u16, others: Vec<(u16, String)>) {
    door.send_message(asks, hello(app, 1, &door.invite())).unwrap();
    door.send_message(asks, PeerMessage::Welcome { user, others }.encode().into()).unwrap();
}

struct UnauthenticatedPeer {
    endpoint: Endpoint,
    connected: bool,
    closed: Option<DisconnectReason>,
    messages: Vec<Bytes>,
}

impl UnauthenticatedPeer {
    fn at(invite: &Invite) -> Self {
        let endpoint = Endpoint::join(invite, JoinOptions::default()).unwrap();
        Self { endpoint, connected: false, closed: None, messages: Vec::new() }
    }

    fn listen(&mut self) {
        while let Some(event) = self.endpoint.poll() {
            match event {
                Event::Connected { .. } => self.connected = true,
                Event::Message { bytes, .. } => self.messages.push(bytes),
                Event::Closed { reason, .. } => self.closed = Some(reason),
                _ => {}
            }
        }
    }

    fn welcomed(&self) -> bool {
        self.sent(|message| matches!(message, PeerMessage::Welcome { .. }))
    }

    fn sent(&self, what: impl Fn(&PeerMessage) -> bool) -> bool {
        self.messages.iter().any(|bytes| PeerMessage::decode(bytes).is_ok_and(|message| what(&message)))
    }
}

#[test]
fn who_was_sent_away_from_among_peers_gets_in_by_no_message_that_follows() {
    let _alone = alone();
    let (hold, watch) = (Token([1; 16]), Token([2; 16]));
    let (mut a, invite) = first(Access::Tokens(vec![Grant::hold(hold), Grant::watch(watch)]), limits());
    let hello = hello(&a, 0, &invite);
    // First the correct order, to check that these messages are accepted.
    let mut right = UnauthenticatedPeer::at(&invite.clone().with_token(hold));
    let mut sent = false;
    run_until(&mut [&mut a], "who may hold is let in", |_| {
        right.listen();
        if right.connected && !sent {
            right.endpoint.send_message(PeerId::HOST, hello.clone()).unwrap();
            sent = true;
        }
        right.welcomed()
    });
    drop(right);
    // Then with a token to watch, and with a message that violates the protocol first.
    for (token, before, reason) in
        [(watch, &[][..], DisconnectReason::WatchOnly), (hold, &[99_u8][..], DisconnectReason::Protocol)]
    {
        let mut wrong = UnauthenticatedPeer::at(&invite.clone().with_token(token));
        // The transport admits the connection by itself. All messages are sent before the peer's
        // app processes the connection and closes it.
        wait_for("it connects", || {
            wrong.listen();
            wrong.connected
        });
        if !before.is_empty() {
            wrong.endpoint.send_message(PeerId::HOST, Bytes::copy_from_slice(before)).unwrap();
        }
        wrong.endpoint.send_message(PeerId::HOST, hello.clone()).unwrap();
        run_until(&mut [&mut a], "it is sent away", |_| {
            wrong.listen();
            wrong.closed.is_some()
        });
        assert_eq!(wrong.closed, Some(reason));
        assert!(!wrong.welcomed(), "{:?}", wrong.messages);
        assert_eq!(users(&mut a), 1);
    }
}

#[test]
fn who_connects_and_does_not_say_who_it_is_keeps_no_place() {
    let _alone = alone();
    let (mut a, invite) = first(Access::Anyone, limits());
    let mut silent: Vec<UnauthenticatedPeer> = (0..4).map(|_| UnauthenticatedPeer::at(&invite)).collect();
    run_until(&mut [&mut a], "all are hung up on", |_| {
        silent.iter_mut().for_each(UnauthenticatedPeer::listen);
        silent.iter().all(|caller| caller.closed.is_some())
    });
    assert!(silent.iter().all(|caller| caller.closed == Some(DisconnectReason::Silent)));
    // A peer that introduces itself stays connected, for longer than a later one that does not.
    let mut b = peer("b", Some(invite.clone()), Access::Anyone, limits());
    run_until(&mut [&mut a, &mut b], "a peer gets in", |apps| users(apps[0]) == 2 && users(apps[1]) == 2);
    let mut later = UnauthenticatedPeer::at(&invite);
    run_until(&mut [&mut a, &mut b], "a later one is hung up on", |_| {
        later.listen();
        later.connected && later.closed.is_some()
    });
    assert_eq!((users(&mut a), users(&mut b)), (2, 2));
}

/// A link that loses all packets in both directions.
#[test]
fn who_says_hello_and_then_nothing_keeps_no_place() {
    let _alone = alone();
    let limits = Limits { idle_timeout: Duration::from_secs(4), ..limits() };
    let (mut a, invite) = first(Access::Anyone, limits);
    let hello = hello(&a, 0, &invite);
    let (mut caller, mut sent) = (UnauthenticatedPeer::at(&invite), false);
    run_until(&mut [&mut a], "it gets a number", |apps| {
        caller.listen();
        if caller.connected && !sent {
            caller.endpoint.send_message(PeerId::HOST, hello.clone()).unwrap();
            sent = true;
        }
        caller.welcomed() && users(apps[0]) == 2
    });
    // Its connection stays open, because the transport keeps it alive.
    run_until(&mut [&mut a], "it is hung up on", |_| {
        caller.listen();
        caller.closed.is_some()
    });
    assert_eq!(caller.closed, Some(DisconnectReason::Silent));
    assert_eq!(users(&mut a), 1);
}

fn cut() -> Option<Emulation> {
    let link = LinkConfig { loss: Loss::Random(1.0), ..LinkConfig::default() };
    Some(Emulation { outgoing: link.clone(), incoming: link, seed: 1 })
}

#[test]
fn who_has_lost_two_peers_looks_for_both() {
    let _alone = alone();
    let handshake = Duration::from_secs(2);
    let quick = || Limits { idle_timeout: Duration::from_secs(3), handshake, ..limits() };
    let (mut a, invite) = first(Access::Anyone, quick());
    let mut b = peer("b", Some(invite.clone()), Access::Anyone, quick());
    // Numbers are given in the order of the introductions.
    run_until(&mut [&mut a, &mut b], "the second is in", |apps| users(apps[1]) == 2);
    let mut c = peer("c", Some(invite), Access::Anyone, quick());
    run_until(&mut [&mut a, &mut b, &mut c], "all know all", |apps| {
        apps.iter_mut().all(|app| users(app) == 3)
    });
    c.world_mut().resource_mut::<NetPeer>().set_emulation(cut());
    // The third peer has the highest number, so it calls both others, without success.
    run_until(&mut [&mut a, &mut b, &mut c], "the last is alone", |apps| {
        users(apps[2]) == 1 && apps[2].world().resource::<NetPeer>().looked_for() == 2
    });
    // After a failed call the peer calls again. The pause between two calls is a second.
    let since = Instant::now();
    run_until(&mut [&mut a, &mut b, &mut c], "each was called twice", |_| {
        since.elapsed() > 2 * (handshake + Duration::from_secs(1))
    });
    assert_eq!(c.world().resource::<NetPeer>().looked_for(), 2);
}

#[test]
fn who_comes_before_our_own_welcome_waits_for_it() {
    let _alone = alone();
    let door = Endpoint::host(HostOptions::default()).unwrap();
    let mut app = peer("early", Some(door.invite()), Access::Anyone, limits());
    let asks = run_until(&mut [&mut app], "it asks to come in", |_| asking(&door));
    // The peer at the door has told another new peer of this one, whose welcome is on its way.
    let own = app.world().resource::<NetPeer>().invite();
    let hello = hello(&app, 3, &own);
    let mut other = UnauthenticatedPeer::at(&own);
    run_until(&mut [&mut app], "the other is connected", |_| {
        other.listen();
        other.connected
    });
    other.endpoint.send_message(PeerId::HOST, hello).unwrap();
    run_frames(&mut [&mut app], 50);
    admit(&app, &door, asks, 2, Vec::new());
    run_until(&mut [&mut app], "it talks to the other", |_| {
        other.listen();
        assert_eq!(other.closed, None);
        other.sent(|message| matches!(message, PeerMessage::Hello { user: 2, .. }))
    });
}

/// The connection on which a new peer has introduced itself at `door`.
fn asking(door: &Endpoint) -> Option<PeerId> {
    std::iter::from_fn(|| door.poll()).find_map(|event| match event {
        Event::Message { peer, .. } => Some(peer),
        _ => None,
    })
}

/// Connection attempts under way to peers that never answer.
const CALLS: u16 = 20;

/// Creates a peer that has just been admitted and has received the invites of [`CALLS`] other
/// peers and of the one at `mute`. The peer at `door` admits it and keeps listening.
fn calling(door: &Endpoint, silent: &UdpSocket, mute: &Endpoint, limits: Limits) -> App {
    let mut app = peer("caller", Some(door.invite()), Access::Anyone, limits);
    let asks = run_until(&mut [&mut app], "it asks to come in", |_| asking(door));
    let words = Invite::new(silent.local_addr().unwrap(), Fingerprint([7; 32])).to_string();
    let mute = (2 + CALLS, mute.invite().to_string());
    let others = (0..CALLS).map(|number| (2 + number, words.clone())).chain([mute]).collect();
    admit(&app, door, asks, 100, others);
    // The peer connects to the others in the frame in which it is admitted.
    run_until(&mut [&mut app], "it gets in", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    app
}

/// An unanswered connection takes a second to end. Twenty of them, one after another, would take
/// twenty seconds.
const TOO_LONG: Duration = Duration::from_secs(10);

#[test]
fn calls_in_vain_freeze_no_frame_and_an_end_waits_for_all_of_them_at_once() {
    let _alone = alone();
    let door = Endpoint::host(HostOptions::default()).unwrap();
    let silent = UdpSocket::bind("127.0.0.1:0").unwrap();
    // This one is reached, and does not answer the hello.
    let mute = Endpoint::host(HostOptions::default()).unwrap();
    // A connection attempt that blocks a frame freezes it for a second each time. A busy machine
    // also freezes a frame now and then, so the test waits for a round without a freeze.
    wait_for("no frame waits for a call", || {
        // All attempts are given up after two seconds.
        let limits = Limits { handshake: Duration::from_secs(2), ..limits() };
        let mut app = calling(&door, &silent, &mute, limits);
        let (began, mut longest, mut hung_up) = (Instant::now(), Duration::ZERO, false);
        wait_for("the calls are over", || {
            let frame = Instant::now();
            app.update();
            longest = longest.max(frame.elapsed());
            let closed = |event| matches!(event, Event::Closed { reason: DisconnectReason::Silent, .. });
            hung_up |= std::iter::from_fn(|| mute.poll()).any(closed);
            hung_up && began.elapsed() > Duration::from_secs(4)
        });
        println!("longest frame {:.1} ms", longest.as_secs_f64() * 1e3);
        must!(longest < Duration::from_millis(500), "a frame of {longest:?}");
        Ok(())
    });
    // The app ends while its connection attempts are under way.
    let app = calling(&door, &silent, &mute, Limits { handshake: Duration::from_secs(600), ..limits() });
    let end = Instant::now();
    drop(app);
    let end = end.elapsed();
    println!("the end took {:.2} s", end.as_secs_f64());
    assert!(end < TOO_LONG, "{end:?}");
}

/// Brings a caller with this first message to `app`, until it is answered or closed.
fn call(app: &mut App, caller: &mut UnauthenticatedPeer, hello: &Bytes) {
    let mut sent = false;
    run_until(&mut [app], "the caller is answered or closed", |_| {
        caller.listen();
        if caller.connected && !std::mem::replace(&mut sent, true) {
            caller.endpoint.send_message(PeerId::HOST, hello.clone()).unwrap();
        }
        caller.closed.is_some() || caller.sent(|message| matches!(message, PeerMessage::Hello { .. }))
    });
}

/// The token that a peer has been told for when it comes back.
fn told_token(caller: &UnauthenticatedPeer) -> Option<Token> {
    caller.messages.iter().find_map(|bytes| match PeerMessage::decode(bytes) {
        Ok(PeerMessage::Hello { address, .. }) => address.parse::<Invite>().ok()?.token,
        _ => None,
    })
}

fn with_key(invite: &Invite, key: &[u8]) -> UnauthenticatedPeer {
    let identity = Some(Identity::from_pkcs8(key).unwrap());
    let endpoint = Endpoint::join(invite, JoinOptions { identity, ..JoinOptions::default() }).unwrap();
    UnauthenticatedPeer { endpoint, connected: false, closed: None, messages: Vec::new() }
}

#[test]
fn a_number_stays_with_its_key_also_while_its_peer_is_away() {
    let _alone = alone();
    let (mut a, invite) = first(Access::Anyone, limits());
    let key = Identity::generate().unwrap().to_pkcs8();
    let mut owner = with_key(&invite, &key);
    let asks = hello(&a, 0, &invite);
    call(&mut a, &mut owner, &asks);
    run_until(&mut [&mut a], "it is number 2", |apps| {
        owner.listen();
        users(apps[0]) == 2 && owner.sent(|message| matches!(message, PeerMessage::Welcome { user: 2, .. }))
    });
    drop(owner);
    run_until(&mut [&mut a], "it is away", |apps| users(apps[0]) == 1);
    // Another key says that it is number 2.
    let as_two = hello(&a, 2, &invite);
    let mut thief = UnauthenticatedPeer::at(&invite);
    call(&mut a, &mut thief, &as_two);
    run_until(&mut [&mut a], "it is sent away", |_| {
        thief.listen();
        assert!(
            !thief.sent(|message| matches!(message, PeerMessage::Hello { .. })),
            "another key was answered as number 2"
        );
        thief.closed.is_some()
    });
    assert_eq!((thief.closed, users(&mut a)), (Some(DisconnectReason::NumberTaken), 1));
    // Its own key has it again, whether it says its number or asks for one.
    for hello in [as_two, asks] {
        let mut owner = with_key(&invite, &key);
        call(&mut a, &mut owner, &hello);
        run_until(&mut [&mut a], "it is back", |apps| users(apps[0]) == 2);
        drop(owner);
        run_until(&mut [&mut a], "it is away", |apps| users(apps[0]) == 1);
    }
}

#[test]
fn sixty_four_silent_connections_bar_no_peer() {
    let _alone = alone();
    // The silent ones would stay for ten minutes.
    let limits = Limits { handshake: Duration::from_secs(600), ..limits() };
    let (mut a, invite) = first(Access::Anyone, limits.clone());
    let mut silent: Vec<UnauthenticatedPeer> = (0..64).map(|_| UnauthenticatedPeer::at(&invite)).collect();
    run_until(&mut [&mut a], "all are connected", |_| {
        silent.iter_mut().for_each(UnauthenticatedPeer::listen);
        silent.iter().all(|caller| caller.connected)
    });
    let mut b = peer("b", Some(invite), Access::Anyone, limits);
    run_until(&mut [&mut a, &mut b], "a peer gets in", |apps| {
        if let PeerState::Closed { reason } = apps[1].world().resource::<NetPeer>().state() {
            panic!("the peer is not let in: {reason}");
        }
        users(apps[0]) == 2 && users(apps[1]) == 2
    });
}

#[test]
fn each_peer_has_a_token_of_its_own() {
    let _alone = alone();
    let token = Token([1; 16]);
    let (mut a, invite) = first(Access::Tokens(vec![Grant::hold(token)]), limits());
    let hello = hello(&a, 0, &invite);
    let mut callers: Vec<UnauthenticatedPeer> = (0..2)
        .map(|_| {
            let mut caller = UnauthenticatedPeer::at(&invite);
            call(&mut a, &mut caller, &hello);
            caller
        })
        .collect();
    let tokens: Vec<Token> = callers.iter().map(|caller| told_token(caller).expect("a token")).collect();
    assert!(tokens[0] != tokens[1] && !tokens.contains(&token), "each of the three is another one");
    // With its token, a peer comes back. The token of one that was sent away admits nobody.
    let second = callers.pop().unwrap();
    let mut first = callers.pop().unwrap();
    first.endpoint.send_message(PeerId::HOST, Bytes::from_static(&[99])).unwrap();
    run_until(&mut [&mut a], "it is sent away", |_| {
        first.listen();
        first.closed.is_some()
    });
    drop(second);
    run_until(&mut [&mut a], "both are gone", |apps| users(apps[0]) == 1);
    let mut wrong = UnauthenticatedPeer::at(&invite.clone().with_token(tokens[0]));
    let mut right = UnauthenticatedPeer::at(&invite.clone().with_token(tokens[1]));
    run_until(&mut [&mut a], "one is refused and the other let in", |_| {
        wrong.listen();
        right.listen();
        wrong.closed.is_some() && right.connected
    });
    assert_eq!((wrong.closed, right.closed), (Some(DisconnectReason::UnknownToken), None));
}

#[test]
fn a_second_call_that_is_refused_does_not_cost_a_peer_its_token() {
    let _alone = alone();
    let (mut a, invite) = first(Access::Tokens(vec![Grant::hold(Token([1; 16]))]), limits());
    let key = Identity::generate().unwrap().to_pkcs8();
    let mut one = with_key(&invite, &key);
    let asks = hello(&a, 0, &invite);
    call(&mut a, &mut one, &asks);
    let own = invite.clone().with_token(told_token(&one).expect("a token"));
    // Others have told it of two addresses at which this peer is, and it calls both.
    let as_two = hello(&a, 2, &invite);
    let mut two = with_key(&own, &key);
    call(&mut a, &mut two, &as_two);
    run_until(&mut [&mut a], "one of the calls is refused", |_| {
        two.listen();
        two.closed.is_some()
    });
    assert_eq!((two.closed, users(&mut a)), (Some(DisconnectReason::NumberTaken), 2));
    drop((one, two));
    run_until(&mut [&mut a], "it is away", |apps| users(apps[0]) == 1);
    let mut back = with_key(&own, &key);
    call(&mut a, &mut back, &as_two);
    assert_eq!((back.closed, users(&mut a)), (None, 2));
}

#[test]
fn nobody_who_is_there_is_looked_for_as_somebody_else() {
    let _alone = alone();
    let door = Endpoint::host(HostOptions::default()).unwrap();
    let mut app = peer("told", Some(door.invite()), Access::Anyone, limits());
    let asks = run_until(&mut [&mut app], "it asks to come in", |_| asking(&door));
    admit(&app, &door, asks, 100, Vec::new());
    run_until(&mut [&mut app], "it is in", |apps| users(apps[0]) == 2);
    let silent = UdpSocket::bind("127.0.0.1:0").unwrap();
    let nobody = Invite::new(silent.local_addr().unwrap(), Fingerprint([7; 32]));
    let others = vec![(7, door.invite().to_string()), (8, nobody.to_string())];
    door.send_message(asks, PeerMessage::Others { others }.encode().into()).unwrap();
    let looked_for = |app: &App| app.world().resource::<NetPeer>().looked_for();
    run_until(&mut [&mut app], "it looks for somebody", |apps| looked_for(apps[0]) > 0);
    assert_eq!(looked_for(&app), 1, "one of the two has the key of the teller");
}

#[test]
fn of_one_who_comes_back_the_others_are_told_again() {
    let _alone = alone();
    let (mut a, invite) = first(Access::Anyone, limits());
    let asks = hello(&a, 0, &invite);
    let mut stays = UnauthenticatedPeer::at(&invite);
    call(&mut a, &mut stays, &asks);
    run_until(&mut [&mut a], "the second is in", |apps| users(apps[0]) == 2);
    let key = Identity::generate().unwrap().to_pkcs8();
    for times in 1..=2 {
        let mut goes = with_key(&invite, &key);
        call(&mut a, &mut goes, &asks);
        run_until(&mut [&mut a], "the second is told of the third", |_| {
            stays.listen();
            let count = |bytes: &&Bytes| match PeerMessage::decode(bytes) {
                Ok(PeerMessage::Others { others }) => others.iter().any(|(user, _)| *user == 3),
                _ => false,
            };
            let count = stays.messages.iter().filter(count).count();
            must!(count == times, "told {count} times, and it has come {times} times");
            Ok(())
        });
        drop(goes);
        run_until(&mut [&mut a], "the third has left", |apps| users(apps[0]) == 2);
    }
}
