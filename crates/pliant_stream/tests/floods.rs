//! A guest that sends as much as it can costs the host a bounded amount of work, and bars nobody.
//! The work is counted, since times depend on the machine.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::time::Duration;

use pliant_modal::Patch;
use pliant_stream::wire::{
    Datagram, GuestMessage, Nack, NackRun, PROTOCOL_VERSION, Payload, StreamSubscription, TargetEntry,
    Targets,
};
use pliant_stream::{
    BodyId, DisconnectReason, HostEvent, HostSession, HostSessionConfig, PeerId, StepSettings, StreamError,
    TickState,
};
use support::fine_bar;

const BODY: BodyId = BodyId(1);
/// Frames per second of the host.
const FRAMES: u32 = 60;
/// Number of datagrams that the transport keeps of a guest between two frames.
const QUEUED: u32 = 64;
const CELLS: usize = 1000;
const VERTICES: u32 = 4 * (CELLS as u32 + 1);

fn hello() -> Vec<u8> {
    let subscription = StreamSubscription { payload: Payload::Forces, modes: 12, repeats: 4, refresh: 60 };
    let cached = vec![fine_bar(CELLS, 12).hash().0];
    GuestMessage::Hello { version: PROTOCOL_VERSION, name: "guest".into(), subscription, cached }.encode()
}

fn begin(grab: u16, vertex: u32, radius: f64) -> Vec<u8> {
    let (target, hold) = ([1.0, 0.0, 0.0], Default::default());
    GuestMessage::GrabBegin { grab, body: BODY.0, vertex, radius, target, hold }.encode()
}

/// A host with one body of many vertices, which one guest has joined.
fn host() -> HostSession {
    let mut host = HostSession::new(HostSessionConfig::default()).unwrap();
    host.add_body(BODY, "bar", fine_bar(CELLS, 12), StepSettings::default()).unwrap();
    host.connect(Duration::ZERO, PeerId(1), 1200).unwrap();
    host.on_message(Duration::ZERO, PeerId(1), &hello());
    while host.poll_event().is_some() {}
    host
}

fn step(host: &mut HostSession, now: Duration, tick: u64) {
    let x = [0.01; 12];
    let state = TickState { tick, q: &x, v: &x, a: &x, z: &[], pose: None, grabs: &[], resting: false };
    host.publish(now, BODY, &state).unwrap();
    host.update(now);
}

#[test]
fn changes_of_interest_make_few_encoders() {
    let mut host = host();
    // Another number of modes for each tick.
    let wishes = ten_seconds(&mut host, |host, now, k| {
        let modes = Some([1, 2, 3, 4, 6, 8, 12][k as usize % 7]);
        host.on_message(now, PeerId(1), &GuestMessage::Interest { body: BODY.0, modes }.encode());
    });
    assert_eq!(wishes.len(), 10 * FRAMES as usize);
    assert_eq!(host.users().count(), 1, "it is still there");
    let made = host.encoders_made();
    assert!(made <= 8, "{made} encoders for seven numbers of modes");
}

/// Calls `frame` for each frame of ten seconds, and returns the events of each frame.
fn ten_seconds(
    host: &mut HostSession,
    mut frame: impl FnMut(&mut HostSession, Duration, u32),
) -> Vec<Vec<HostEvent>> {
    (1..=10 * FRAMES)
        .map(|k| {
            let now = k * Duration::from_secs(1) / FRAMES;
            step(host, now, k.into());
            frame(host, now, k);
            while host.poll_output().is_some() {}
            std::iter::from_fn(|| host.poll_event()).collect()
        })
        .collect()
}

#[test]
fn sixty_four_targets_in_each_datagram_move_a_hand_no_more_often_than_a_hand_moves() {
    let mut host = host();
    host.on_message(Duration::ZERO, PeerId(1), &begin(7, 66, 0.05));
    let mut input = 0;
    let frames = ten_seconds(&mut host, |host, now, frame| {
        for k in 0..QUEUED {
            let next = |_| {
                input += 1;
                TargetEntry { grab: 7, input, target: [1.0, 0.0, 0.0] }
            };
            let entries = (0..64).map(next).collect();
            let datagram = Datagram::Targets(Targets { entries }).encode((frame * QUEUED + k) as u16);
            host.on_datagram(now, PeerId(1), &datagram);
        }
    });
    let moved =
        |events: &Vec<HostEvent>| events.iter().filter(|e| matches!(e, HostEvent::GrabMoved { .. })).count();
    let all: usize = frames.iter().map(moved).sum();
    let most = frames.iter().map(moved).max().unwrap();
    println!("{all} movements of one hand in ten seconds, {most} in one frame");
    // Sixteen hands at 240 movements a second are the most that a guest may have.
    assert!(all <= 10 * 16 * 240 + 1024 && most <= 1024, "{all} movements, {most} in one frame");
    assert_eq!(host.users().count(), 1, "the guest stays, and its hand moves");
    assert!(moved(frames.last().unwrap()) >= 16, "{}", moved(frames.last().unwrap()));
}

#[test]
fn patches_are_charged_by_their_entries() {
    // Whole-body patches, sixty each second. Each is another one, so that no table has it.
    let (mut host, model) = (host(), fine_bar(CELLS, 12));
    let frames = ten_seconds(&mut host, |host, now, frame| {
        let grab = frame as u16;
        host.on_message(now, PeerId(1), &GuestMessage::GrabEnd { grab: grab - 1 }.encode());
        host.on_message(now, PeerId(1), &begin(grab, frame, 1.01 + 1e-5 * f64::from(frame)));
    });
    let entries = |event: &HostEvent| match *event {
        HostEvent::GrabBegan { vertex, radius, .. } => {
            Patch::around(model.surface(), vertex, radius).unwrap().entries().len()
        }
        _ => 0,
    };
    let all: usize = frames.iter().flatten().map(entries).sum();
    let busy = frames.iter().filter(|events| events.iter().any(|e| entries(e) > 0)).count();
    println!("patches with {all} entries together in ten seconds, in {busy} of {} frames", frames.len());
    assert!(all <= 16_384 + 10 * 8192 + VERTICES as usize, "{all} entries");
    assert!(all >= 10 * 8192, "{all} entries: what the budget allows is accepted");
    // A hand that slides makes a small patch in each frame, and all are accepted.
    let mut host = self::host();
    let frames = ten_seconds(&mut host, |host, now, frame| {
        let grab = frame as u16;
        host.on_message(now, PeerId(1), &GuestMessage::GrabEnd { grab: grab - 1 }.encode());
        host.on_message(now, PeerId(1), &begin(grab, 4 * frame, 0.02));
    });
    let began = frames.iter().flatten().filter(|e| matches!(e, HostEvent::GrabBegan { .. })).count();
    assert_eq!(began, frames.len());
}

#[test]
fn ticks_are_sent_again_within_a_budget_for_each_guest() {
    let mut host = host();
    let (mut all, mut most) = (0, 0);
    for k in 1..=10 * FRAMES {
        let now = k * Duration::from_secs(1) / FRAMES;
        step(&mut host, now, k.into());
        while host.poll_output().is_some() {}
        for n in 0..QUEUED {
            let first = u64::from(k.saturating_sub(255).max(1));
            let runs = (0..32).map(|r| NackRun { first: first + 8 * r, count: 64 }).collect();
            let nack = Datagram::Nack(Nack { body: BODY, runs }).encode((k * QUEUED + n) as u16);
            host.on_datagram(now, PeerId(1), &nack);
        }
        let sent = std::iter::from_fn(|| host.poll_output()).count();
        all += sent;
        most = most.max(sent);
    }
    println!("{all} ticks sent again in ten seconds, {most} at most in one frame");
    assert!(most <= 1024, "{most} ticks in one frame");
    assert!(all <= 10 * 4000 + 1024, "{all} ticks");
}

#[test]
fn silent_connections_bar_nobody_and_who_is_present_stays() {
    let mut host = host();
    let most = host.config().max_guests as u64;
    for peer in 2..=most {
        host.connect(Duration::ZERO, PeerId(peer), 1200).unwrap();
    }
    let now = Duration::from_millis(100);
    for peer in most + 1..2 * most {
        host.connect(now, PeerId(peer), 1200).unwrap_or_else(|e| panic!("guest {peer}: {e}"));
        host.on_message(now, PeerId(peer), &hello());
    }
    assert_eq!(host.users().count() as u64, most, "the first guest, and all that have said hello");
    let gone = std::iter::from_fn(|| host.poll_event())
        .filter(|e| matches!(e, HostEvent::Left { user: None, reason: DisconnectReason::Silent, .. }))
        .count() as u64;
    assert_eq!(gone, most - 1, "the silent ones made room, one for each");
    // Nobody who is in the session makes room.
    let full = host.connect(now, PeerId(9999), 1200);
    assert_eq!(full, Err(StreamError::Full { what: "guests", limit: most as usize }));
}
