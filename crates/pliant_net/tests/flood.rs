//! Strangers that were let in send all that they can: datagrams with 64 targets, messages of five
//! bytes, and grabs of the whole body. The host's frame stays short, a second guest joins, and who
//! is there loses nothing.
//!
//! What a frame reads is counted. The last test measures times, and is run by hand.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{Grab, GrabOf};
use pliant_modal::ModalModel;
use pliant_net::transport::{Carrier, Endpoint, Event, JoinOptions, Limits, RateCap};
use pliant_net::{
    GrabRefused, HandOf, HostConfig, HostOptions, Invite, JoinConfig, NetHost, SessionClosed, SessionLost,
};
use pliant_stream::PeerId;
use pliant_stream::wire::{
    Datagram, GuestMessage, PROTOCOL_VERSION, Payload, StreamSubscription, TargetEntry, Targets,
};
use support::{alone, bar_of, body_of, guest, host_of, messages, only, run_until};

/// What one frame may read, bytes: the share of one peer that sends long datagrams, with its last
/// one, of one that sends short messages, and what the others send.
const MAX_READ: u64 = 16 * 512 + 1200 + 5 * 257 + 1500;
/// Cells of the body that is measured, which has four times as many vertices.
const CELLS: u32 = 2500;

fn limits() -> Limits {
    Limits { rate: RateCap::from_mbit_per_s(1000.0), idle_timeout: Duration::from_secs(30), ..Limits::host() }
}

/// What a stranger sends.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Flood {
    /// Datagrams of 64 targets, as many as the connection takes.
    Targets,
    /// Messages of five bytes, 20,000 a second.
    Messages,
    /// Grabs of the whole body, sixty a second.
    Grabs,
}

const ALL: [Flood; 3] = [Flood::Targets, Flood::Messages, Flood::Grabs];

struct FloodingPeer {
    thread: Option<JoinHandle<()>>,
    stop: Arc<AtomicBool>,
    sent: Arc<AtomicU64>,
}

impl FloodingPeer {
    /// Joins and floods the host until it is dropped.
    fn at(invite: &Invite, model: &ModalModel, flood: Flood) -> Self {
        let limits = Limits { message: Limits::guest().message, ..limits() };
        let endpoint = Endpoint::join(invite, JoinOptions { limits, ..JoinOptions::default() }).unwrap();
        let (stop, sent) = (Arc::<AtomicBool>::default(), Arc::<AtomicU64>::default());
        let (cached, vertices) = (vec![model.hash().0], model.surface().positions().len() as u32);
        let (ended, count) = (Arc::clone(&stop), Arc::clone(&sent));
        let run = move || Self::flood(&endpoint, flood, (cached, vertices), &ended, &count);
        Self { thread: Some(std::thread::spawn(run)), stop, sent }
    }

    fn flood(
        endpoint: &Endpoint,
        flood: Flood,
        (cached, vertices): (Vec<[u8; 32]>, u32),
        ended: &AtomicBool,
        sent: &AtomicU64,
    ) {
        let begin = |grab: u16, radius| GuestMessage::GrabBegin {
            grab,
            body: 1,
            vertex: u32::from(grab) % vertices,
            radius,
            target: [1.0, 0.0, 0.0],
            hold: Default::default(),
        };
        let send = |message: GuestMessage| endpoint.send_message(PeerId::HOST, message.encode().into());
        while !ended.load(Ordering::Relaxed) && !matches!(endpoint.poll(), Some(Event::Connected { .. })) {
            std::thread::sleep(Duration::from_millis(1));
        }
        let subscription = StreamSubscription { payload: Payload::Forces, modes: 4, repeats: 0, refresh: 60 };
        let (version, name) = (PROTOCOL_VERSION, "stranger".into());
        send(GuestMessage::Hello { version, name, subscription, cached }).unwrap();
        std::thread::sleep(Duration::from_millis(500));
        // The grab that the targets move.
        send(begin(0, 0.05)).unwrap();
        let room = endpoint.max_datagram_size(PeerId::HOST).unwrap();
        let targets = ((room - 4) / 18).min(64);
        let (mut input, mut sequence, mut grab, began) = (0, 0, 0_u16, Instant::now());
        while !ended.load(Ordering::Relaxed) {
            let due = |rate: f64| (began.elapsed().as_secs_f64() * rate) as u64;
            let before = sent.load(Ordering::Relaxed);
            let more = match flood {
                Flood::Targets => 64,
                Flood::Messages => due(20_000.0).saturating_sub(before),
                Flood::Grabs => due(60.0).saturating_sub(before),
            };
            for _ in 0..more {
                match flood {
                    Flood::Targets => {
                        let entry = |_| {
                            input += 1;
                            let target = [1.0, 0.001 * f64::from(input % 9), 0.0];
                            TargetEntry { grab: 0, input, target }
                        };
                        let entries = (0..targets).map(entry).collect();
                        let datagram = Datagram::Targets(Targets { entries }).encode(sequence);
                        sequence = sequence.wrapping_add(1);
                        endpoint.send_datagram(PeerId::HOST, datagram.into()).unwrap();
                    }
                    Flood::Messages => {
                        let modes = Some(1 + input as u16 % 4);
                        let wanted = GuestMessage::Interest { body: 1, modes };
                        assert!(wanted.encode().len() <= 5);
                        input += 1;
                        // The host may read slowly, and then the queue is full.
                        send(wanted).ok();
                    }
                    Flood::Grabs => {
                        send(GuestMessage::GrabEnd { grab }).unwrap();
                        grab = grab.wrapping_add(1);
                        send(begin(grab, 1.0 + 1e-5 * f64::from(grab))).unwrap();
                    }
                }
            }
            sent.fetch_add(more, Ordering::Relaxed);
            while let Some(event) = endpoint.poll() {
                assert!(!matches!(event, Event::Closed { .. }), "{event:?}");
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

impl Drop for FloodingPeer {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.thread.take().is_none_or(|thread| thread.join().is_ok());
        assert!(ended || std::thread::panicking(), "the flooding peer's thread panicked");
    }
}

/// Bytes of datagrams and messages that the host has read.
fn read(host: &App) -> u64 {
    let totals = host.world().resource::<NetHost>().session().totals();
    totals.bytes_in + totals.message_bytes_in
}

/// Whom strangers flood.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Whom {
    Nobody,
    /// Another host on the same machine, which shows what they cost the machine.
    Another,
    ThisHost,
}

/// What ten seconds of the flood did.
struct Flooded {
    /// Bytes that each frame of the host has read.
    read: Vec<u64>,
    /// How long each frame of the host took, and whether a hand took hold in it.
    frames: Vec<(Duration, bool)>,
    /// Until the second guest was in and saw the body.
    joined: Duration,
}

fn flooded(model: &Arc<ModalModel>, lasts: Duration, whom: Whom) -> Flooded {
    let transport = HostOptions { limits: limits(), ..HostOptions::default() };
    let (mut host, invite, _) = host_of(HostConfig { transport, ..HostConfig::default() }, model.clone());
    let cached = || JoinConfig { models: vec![model.clone()], ..JoinConfig::default() };
    let mut first = guest(&invite, cached());
    let body = run_until(&mut [&mut host, &mut first], "the first guest is in", |apps| body_of(apps[1]));
    first.world_mut().spawn((Grab::new(0, 0.05, DVec3::new(0.0, 1.0, 0.2)), GrabOf(body)));
    run_until(&mut [&mut host, &mut first], "and holds", |apps| only::<HandOf>(apps[0]).is_some());
    let another = HostOptions { limits: limits(), ..HostOptions::default() };
    let another = (whom == Whom::Another)
        .then(|| host_of(HostConfig { transport: another, ..HostConfig::default() }, model.clone()));
    let flooded_host = another.as_ref().map_or(&invite, |(_, invite, _)| invite);
    let floods = if whom == Whom::Nobody { &[][..] } else { &ALL };
    let flooding: Vec<FloodingPeer> =
        floods.iter().map(|&flood| FloodingPeer::at(flooded_host, model, flood)).collect();
    let sent = || -> Vec<u64> { flooding.iter().map(|s| s.sent.load(Ordering::Relaxed)).collect() };
    let mut flooded = Flooded { read: Vec::new(), frames: Vec::new(), joined: Duration::ZERO };
    let (mut began, mut second, mut before) = (None::<Instant>, None::<(Instant, App)>, read(&host));
    let mut hands = host.world_mut().query_filtered::<Entity, With<HandOf>>();
    let mut held = 0;
    loop {
        let frame = Instant::now();
        host.update();
        let took = frame.elapsed();
        let newest = hands.iter(host.world()).map(Entity::to_bits).fold(0, u64::wrapping_add);
        let holds = std::mem::replace(&mut held, newest) != newest;
        first.update();
        let now = read(&host);
        if began.is_none() && sent().iter().all(|count| *count > 0) {
            began = Some(Instant::now());
        }
        if let Some(began) = began {
            flooded.read.push(now - before);
            flooded.frames.push((took, holds));
            if began.elapsed() > lasts / 5 && second.is_none() {
                second = Some((Instant::now(), guest(&invite, cached())));
            }
            if began.elapsed() > lasts && !flooded.joined.is_zero() {
                break;
            }
        }
        before = now;
        if let Some((since, second)) = &mut second {
            second.update();
            if flooded.joined.is_zero() && body_of(second).is_some() {
                flooded.joined = since.elapsed();
            }
            assert!(since.elapsed() < support::PATIENCE, "the second guest does not get in");
        }
        std::thread::sleep(Duration::from_millis(16).saturating_sub(frame.elapsed()));
    }
    println!(
        "{} frames, {:?} datagrams, short messages and grabs of strangers, {} bytes read in a frame at most; \
         the second guest was in after {:?}",
        flooded.frames.len(),
        sent(),
        flooded.read.iter().max().unwrap(),
        flooded.joined,
    );
    // The first guest has lost nothing: it is in, it holds, and no datagram of it was dropped.
    assert!(messages::<SessionLost>(&first).is_empty() && messages::<SessionClosed>(&first).is_empty());
    assert!(messages::<GrabRefused>(&first).is_empty());
    let world = host.world().resource::<NetHost>();
    let dropped = world.endpoint().unwrap().stats(PeerId(1)).unwrap().dropped;
    assert_eq!((dropped.receive_queue_full, dropped.send_queue_full), (0, 0));
    let flooding = if whom == Whom::ThisHost { floods.len() } else { 0 };
    assert_eq!(world.session().users().count(), 2 + flooding, "the guests and the flooding peers are in");
    flooded
}

#[test]
fn strangers_that_send_all_they_can_hold_up_no_frame_and_bar_nobody() {
    let _alone = alone();
    let flooded = flooded(&bar_of(16), Duration::from_secs(3), Whom::ThisHost);
    let most = *flooded.read.iter().max().unwrap();
    assert!(most <= MAX_READ, "{most} bytes read in one frame");
}

/// Guests that each take hold of the whole body, as often as their budget allows, all in the same
/// moment: a frame makes a few milliseconds' worth of patches, and the other hands come with the
/// next frames.
#[test]
fn whole_body_grabs_of_many_guests_at_once_come_a_few_in_a_frame() {
    let _alone = alone();
    let model = bar_of(CELLS);
    let transport = HostOptions { limits: limits(), ..HostOptions::default() };
    let (mut host, invite, _) = host_of(HostConfig { transport, ..HostConfig::default() }, model.clone());
    // Who sees the body tells that the host shares it.
    let mut watcher = guest(&invite, JoinConfig { models: vec![model.clone()], ..JoinConfig::default() });
    run_until(&mut [&mut host, &mut watcher], "the body is shared", |apps| body_of(apps[1]));
    let guests: Vec<Endpoint> = (0..7)
        .map(|_| {
            let limits = Limits { message: Limits::guest().message, ..limits() };
            Endpoint::join(&invite, JoinOptions { limits, ..JoinOptions::default() }).unwrap()
        })
        .collect();
    let send = |guest: &Endpoint, message: GuestMessage| {
        guest.send_message(PeerId::HOST, message.encode().into()).unwrap();
    };
    let mut greeted = vec![false; guests.len()];
    run_until(&mut [&mut host], "the guests are in", |apps| {
        for (guest, greeted) in guests.iter().zip(&mut greeted) {
            while let Some(event) = guest.poll() {
                if matches!(event, Event::Connected { .. }) {
                    let subscription =
                        StreamSubscription { payload: Payload::Forces, modes: 4, repeats: 0, refresh: 60 };
                    let (version, name, cached) = (PROTOCOL_VERSION, "guest".into(), vec![model.hash().0]);
                    send(guest, GuestMessage::Hello { version, name, subscription, cached });
                    *greeted = true;
                }
            }
        }
        apps[0].world().resource::<NetHost>().session().users().count() == 1 + guests.len()
    });
    for guest in &guests {
        for grab in 0..2 {
            let (target, hold) = ([1.0, 0.0, 0.0], Default::default());
            send(guest, GuestMessage::GrabBegin { grab, body: 1, vertex: 9, radius: 1.0, target, hold });
        }
    }
    // All of it waits at the host before its next frame.
    std::thread::sleep(Duration::from_millis(500));
    let (mut held, mut begun) = (0, Vec::new());
    // All may have 65,536 vertices at once and more with time; each hand takes 10,004.
    run_until(&mut [&mut host], "seven hands hold", |apps| {
        let now = apps[0].world_mut().query::<&HandOf>().iter(apps[0].world()).count();
        begun.push(now - std::mem::replace(&mut held, now));
        now >= 7
    });
    assert!(begun.iter().all(|hands| *hands <= 1), "hands that took hold in each frame: {begun:?}");
}

/// Run by hand, on a quiet machine and with `--release`.
#[test]
#[ignore = "measures times"]
fn times_of_the_frames_of_a_host_that_is_flooded() {
    let _alone = alone();
    // First without a flood, and with one of another host, for what the machine and the body cost
    // by themselves.
    for whom in [Whom::Nobody, Whom::Another, Whom::ThisHost] {
        let flooded = flooded(&bar_of(CELLS), Duration::from_secs(10), whom);
        let print = |what: &str, mut frames: Vec<Duration>| {
            frames.sort();
            let at =
                |share: f64| frames.get((share * frames.len().saturating_sub(1) as f64) as usize).copied();
            let [median, p99, longest] = [0.5, 0.99, 1.0].map(|share| at(share).unwrap_or_default());
            println!(
                "{whom:?}, {} {what}: median {median:?}, p99 {p99:?}, longest {longest:?}",
                frames.len()
            );
            p99
        };
        let of = |holds: bool| {
            flooded.frames.iter().filter(move |frame| frame.1 == holds).map(|frame| frame.0).collect()
        };
        print("frames with a hand that comes or goes", of(true));
        print("other frames", of(false));
        let p99 = print("frames", flooded.frames.iter().map(|frame| frame.0).collect());
        if whom == Whom::ThisHost {
            assert!(p99 < Duration::from_millis(5) && flooded.joined < Duration::from_secs(1));
        }
    }
}
