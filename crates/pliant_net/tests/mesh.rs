//! Peers, and somebody at their door who is none: it speaks the peers' messages by itself.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::time::{Duration, Instant};

use bevy::prelude::*;
use bytes::{BufMut, Bytes, BytesMut};
use pliant_body::{ModalAsset, ModalBody};
use pliant_net::transport::{Endpoint, Event, JoinOptions, Limits};
use pliant_net::{
    Access, Emulation, Grant, HostOptions, Invite, NetPeer, NetPlugin, PeerConfig, PeerState, SharedBody,
    Token, User,
};
use pliant_stream::PeerId;
use pliant_stream::emulator::{LinkConfig, Loss};
use support::{alone, app, bar, run_for, run_until};

const INTRODUCE: u8 = 16;
const WELCOME: u8 = 17;

/// Misses the others after a second, and gives a newcomer two to say who it is.
fn peer(name: &str, join: Option<Invite>, access: Access) -> (App, Entity) {
    let limits = Limits {
        idle_timeout: Duration::from_secs(1),
        keep_alive: Duration::from_millis(200),
        handshake: Duration::from_secs(2),
        ..Limits::host()
    };
    let transport = HostOptions { limits, access, ..HostOptions::default() };
    let mut app =
        app(NetPlugin::peer(PeerConfig { name: name.into(), join, transport, ..PeerConfig::default() })
            .unwrap());
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    let body = app.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar"))).id();
    (app, body)
}

fn first(access: Access) -> (App, Entity, Invite) {
    let (mut a, body) = peer("a", None, access);
    run_until(&mut [&mut a], 3.0, "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let invite = a.world().resource::<NetPeer>().invite();
    (a, body, invite)
}

fn users(app: &mut App) -> usize {
    app.world_mut().query::<&User>().iter(app.world()).count()
}

/// What a newcomer with the right body says first.
fn introduction(app: &App, body: Entity, invite: &Invite) -> Bytes {
    let number = app.world().resource::<NetPeer>().body_of(body).unwrap();
    let words = invite.to_string();
    let mut bytes = BytesMut::new();
    bytes.put_u8(INTRODUCE);
    bytes.put_u64_le(25_000_000);
    bytes.put_u16_le(1);
    bytes.put_u16_le(number.0);
    bytes.put_slice(&bar().hash().0);
    bytes.put_u16_le(words.len() as u16);
    bytes.put_slice(words.as_bytes());
    bytes.freeze()
}

struct Stranger {
    endpoint: Endpoint,
    connected: bool,
    closed: Option<String>,
    messages: Vec<Bytes>,
}

impl Stranger {
    fn at(invite: &Invite) -> Self {
        let endpoint = Endpoint::join(invite, JoinOptions::default()).unwrap();
        Self { endpoint, connected: false, closed: None, messages: Vec::new() }
    }

    fn listen(&mut self) {
        while let Some(event) = self.endpoint.poll() {
            match event {
                Event::Connected { .. } => self.connected = true,
                Event::Message { bytes, .. } => self.messages.push(bytes),
                Event::Closed { reason, .. } => self.closed = Some(reason.to_string()),
                _ => {}
            }
        }
    }

    fn welcomed(&self) -> bool {
        self.messages.iter().any(|bytes| bytes.first() == Some(&WELCOME))
    }
}

#[test]
fn who_was_sent_away_from_among_peers_gets_in_by_no_message_that_follows() {
    let _alone = alone();
    let (hold, watch) = (Token([1; 16]), Token([2; 16]));
    let (mut a, body, invite) = first(Access::Tokens(vec![Grant::hold(hold), Grant::watch(watch)]));
    let hello = introduction(&a, body, &invite);
    // Rightly: the words are those that let in.
    let mut right = Stranger::at(&invite.clone().with_token(hold));
    let mut said = false;
    run_until(&mut [&mut a], 3.0, "who may hold is let in", |_| {
        right.listen();
        if right.connected && !said {
            right.endpoint.send_message(PeerId::HOST, hello.clone()).unwrap();
            said = true;
        }
        right.welcomed()
    });
    drop(right);
    // By a token to watch, and after a message that breaks the protocol.
    for (token, before) in [(watch, &[][..]), (hold, &[99_u8][..])] {
        let mut wrong = Stranger::at(&invite.clone().with_token(token));
        // The transport lets it in by itself; all is said before the peers' app hears of it and hangs up.
        let since = Instant::now();
        while !wrong.connected {
            assert!(since.elapsed() < Duration::from_secs(4), "it connects");
            wrong.listen();
            std::thread::sleep(Duration::from_millis(1));
        }
        if !before.is_empty() {
            wrong.endpoint.send_message(PeerId::HOST, Bytes::copy_from_slice(before)).unwrap();
        }
        wrong.endpoint.send_message(PeerId::HOST, hello.clone()).unwrap();
        run_until(&mut [&mut a], 4.0, "it is sent away", |_| {
            wrong.listen();
            wrong.closed.is_some()
        });
        assert!(!wrong.welcomed(), "{:?}", wrong.messages);
        assert_eq!(users(&mut a), 1);
    }
}

#[test]
fn who_connects_and_does_not_say_who_it_is_keeps_no_place() {
    let _alone = alone();
    let (mut a, body, invite) = first(Access::Anyone);
    let hello = introduction(&a, body, &invite);
    let mut silent: Vec<Stranger> = (0..4).map(|_| Stranger::at(&invite)).collect();
    // The last says what it has and not, in the session, who it is.
    let mut said = false;
    run_until(&mut [&mut a], 6.0, "all are hung up on", |_| {
        silent.iter_mut().for_each(Stranger::listen);
        if let Some(last) = silent.last_mut().filter(|last| last.connected && !said) {
            last.endpoint.send_message(PeerId::HOST, hello.clone()).unwrap();
            said = true;
        }
        silent.iter().all(|stranger| stranger.closed.is_some())
    });
    assert!(silent[3].welcomed(), "the last was given a number");
    assert!(silent.iter().all(|stranger| stranger.connected));
    // Who does say it stays.
    let (mut b, _) = peer("b", Some(invite), Access::Anyone);
    run_until(&mut [&mut a, &mut b], 5.0, "a peer gets in", |apps| {
        users(apps[0]) == 2 && users(apps[1]) == 2
    });
    run_for(&mut [&mut a, &mut b], 3.0);
    assert_eq!((users(&mut a), users(&mut b)), (2, 2));
}

#[test]
fn lost_peers_freeze_no_frame_and_an_end_waits_for_all_of_them_at_once() {
    let _alone = alone();
    let (mut a, _, invite) = first(Access::Anyone);
    let (mut b, _) = peer("b", Some(invite.clone()), Access::Anyone);
    let (mut c, _) = peer("c", Some(invite), Access::Anyone);
    run_until(&mut [&mut a, &mut b, &mut c], 5.0, "all know all", |apps| {
        apps.iter_mut().all(|app| users(app) == 3)
    });
    let link = LinkConfig { loss: Loss::Random(1.0), ..LinkConfig::default() };
    let cut = Emulation { outgoing: link.clone(), incoming: link, seed: 1 };
    c.world_mut().resource_mut::<NetPeer>().set_emulation(Some(cut));
    run_until(&mut [&mut a, &mut b, &mut c], 8.0, "the last is alone", |apps| users(apps[2]) == 1);
    // It has the highest number and calls both, in vain, every three seconds.
    let (began, mut longest) = (Instant::now(), Duration::ZERO);
    while began.elapsed() < Duration::from_secs(7) {
        let frame = Instant::now();
        c.update();
        longest = longest.max(frame.elapsed());
        std::thread::sleep(Duration::from_millis(5));
    }
    println!("longest frame {:.1} ms", longest.as_secs_f64() * 1e3);
    assert_eq!(c.world().resource::<NetPeer>().looked_for(), 2);
    assert!(longest < Duration::from_millis(500), "a frame of {longest:?}");
    let end = Instant::now();
    drop(c);
    let end = end.elapsed();
    println!("the end took {:.2} s", end.as_secs_f64());
    assert!(end < Duration::from_millis(1700), "{end:?}");
}
