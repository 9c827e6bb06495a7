//! Sessions go on under damaged data, or end with a reason.

use std::time::Duration;

use pliant_stream::wire::{
    AccelerationCoding, Datagram, GuestMessage, HostMessage, Nack, NackRun, TickFrame,
};
use pliant_stream::{
    BodyId, Channel, DisconnectReason, GuestEvent, GuestSession, GuestSessionConfig, HostEvent, HostSession,
    HostSessionConfig, PeerId, RecoveryConfig, StepSettings, StreamError, TickState,
};

use super::samples::{quantized, samples};
use super::support::bar;
use super::support::direct::{BODY, exchange, publish, random, session};

fn finite(guest: &GuestSession) {
    if let Some(visual) = guest.body(BODY).and_then(|b| b.visual()) {
        assert!(visual.is_finite());
    }
}

#[test]
fn sessions_survive_a_hundred_thousand_damaged_datagrams() {
    // The test damages data of a real session, so that most of it passes the parser, in both
    // directions and with all policies. The seed is the loop's counter.
    for name in RecoveryConfig::NAMES {
        let (mut host, mut guest, mut now) = session(name);
        let mut state = 88_172_645_463_325_252;
        let mut next = || random(&mut state);
        let base: Vec<Vec<u8>> = samples().iter().map(|d| d.encode(3)).collect();
        let mut last_frame: Option<Vec<u8>> = None;
        for round in 0..15_000_u64 {
            if round % 10 == 0 {
                now += Duration::from_millis(25);
                publish(&mut host, now, 60 + round / 10);
                host.update(now);
                while let Some(o) = host.poll_output() {
                    if o.channel == Channel::Datagram {
                        last_frame = Some(o.bytes.to_vec());
                        guest.on_datagram(now, &o.bytes);
                    } else {
                        guest.on_message(now, &o.bytes);
                    }
                }
                guest.update(now);
                while let Some(o) = guest.poll_output() {
                    if o.channel == Channel::Datagram {
                        host.on_datagram(now, PeerId(1), &o.bytes);
                    } else {
                        host.on_message(now, PeerId(1), &o.bytes);
                    }
                }
                while guest.poll_event().is_some() {}
                while host.poll_event().is_some() {}
            }
            let mut bytes = match (&last_frame, next() % 3) {
                (Some(f), 0 | 1) => f.clone(),
                _ => base[(next() % 8) as usize].clone(),
            };
            for _ in 0..=next() % 3 {
                let at = (next() as usize) % bytes.len();
                bytes[at] = next() as u8;
            }
            if bytes.len() > 3 {
                // Write a sequence number that counts as new.
                let s = (next() as u16).to_le_bytes();
                bytes[1] = s[0];
                bytes[2] = s[1];
            }
            guest.on_datagram(now, &bytes);
            host.on_datagram(now, PeerId(1), &bytes);
            finite(&guest);
        }
        // A snapshot corrects whatever the damaged data put in.
        assert!(!guest.is_closed(), "{name}");
    }
}

#[test]
fn ticks_of_the_far_future_and_past_do_not_move_a_body() {
    let (_, mut guest, now) = session("default");
    let before = guest.body(BODY).unwrap().tick();
    for tick in [0, 1, (1 << 48) - 1, 1 << 40, before + 2_000_000] {
        let Datagram::Frame(f) = &samples()[0] else { unreachable!() };
        let frame = TickFrame { tick, run: u16::MAX, ..f.clone() };
        guest.on_datagram(now, &Datagram::Frame(frame).encode(30_000_u16.wrapping_add(tick as u16)));
        guest.update(now);
    }
    let after = guest.body(BODY).unwrap().tick();
    assert!(after <= before + 3, "{before} {after}");
    finite(&guest);
}

#[test]
fn a_tick_of_the_near_future_costs_a_snapshot_and_no_more() {
    for name in ["default", "paper"] {
        let (mut host, mut guest, mut now) = session(name);
        let Datagram::Frame(f) = &samples()[0] else { unreachable!() };
        let accelerations = (name == "paper").then(|| quantized(AccelerationCoding::Visible, &[1.0; 12]));
        let frame = TickFrame { tick: 900_000, accelerations, repeats: Vec::new(), ..f.clone() };
        guest.on_datagram(now, &Datagram::Frame(frame).encode(120));
        for tick in 60..160 {
            now += Duration::from_millis(25);
            publish(&mut host, now, tick);
            exchange(&mut host, &mut guest, now);
        }
        let view = guest.body(BODY).unwrap();
        assert!((150..=160).contains(&view.tick()), "{name}: tick {}", view.tick());
        let q = &view.confirmed().unwrap().q;
        let truth = |k: usize| 0.01 * (0.002 * view.tick() as f64 + k as f64).sin();
        for (k, q) in q.iter().enumerate() {
            // No reaction explains this shape. The force-driven receiver holds it with the load
            // that it received.
            assert!((q - truth(k)).abs() < 1e-3, "{name} mode {k}: {q} and {}", truth(k));
        }
    }
}

#[test]
fn nack_flood_is_answered_within_bounds() {
    let (mut host, _, now) = session("default");
    while host.poll_output().is_some() {}
    let runs = vec![NackRun { first: 1, count: 64 }; 32];
    let flood = Datagram::Nack(Nack { body: BODY, runs });
    for s in 0..5000_u16 {
        host.on_datagram(now, PeerId(1), &flood.encode(s.wrapping_add(2000)));
    }
    let mut answers = 0;
    while host.poll_output().is_some() {
        answers += 1;
    }
    // The budget is 4,000 ticks at once, and all requests arrive at one moment.
    assert!(answers <= 4000, "{answers} answers to ten million questions");
}

#[test]
fn a_guest_that_breaks_the_protocol_is_shown_out_with_a_reason() {
    let (mut host, _, now) = session("default");
    while host.poll_event().is_some() {}
    while host.poll_output().is_some() {}
    host.on_message(now, PeerId(1), &[0xFF; 40]);
    let mut ended = false;
    while let Some(e) = host.poll_event() {
        ended |= matches!(e, HostEvent::Left { reason: DisconnectReason::Protocol, .. });
    }
    assert!(ended);
    let goodbye = host.poll_output().unwrap();
    let message = HostMessage::decode(&goodbye.bytes).unwrap();
    assert_eq!(message, HostMessage::Goodbye { reason: DisconnectReason::Protocol });
}

#[test]
fn a_host_that_sends_a_false_model_is_left() {
    let model = bar(12, 0.05);
    let mut host = HostSession::new(HostSessionConfig::default()).unwrap();
    host.add_body(BODY, "bar", model, StepSettings::default()).unwrap();
    let mut guest = GuestSession::new(GuestSessionConfig::default(), 1200).unwrap();
    let now = Duration::from_secs(1);
    host.connect(now, PeerId(1), 1200).unwrap();
    guest.connect(now).unwrap();
    while let Some(o) = guest.poll_output() {
        host.on_message(now, PeerId(1), &o.bytes);
    }
    host.update(now);
    while let Some(o) = host.poll_output() {
        let mut bytes = o.bytes.to_vec();
        if let Ok(HostMessage::ModelChunk { hash, offset, total, bytes: mut piece }) =
            HostMessage::decode(&bytes)
        {
            piece[100] ^= 1;
            bytes = HostMessage::ModelChunk { hash, offset, total, bytes: piece }.encode();
        }
        guest.on_message(now, &bytes);
    }
    let mut reason = None;
    while let Some(e) = guest.poll_event() {
        if let GuestEvent::Closed { reason: r } = e {
            reason = Some(r);
        }
    }
    assert_eq!(reason, Some(DisconnectReason::Protocol));
}

#[test]
fn another_version_is_told_so() {
    let mut host = HostSession::new(HostSessionConfig::default()).unwrap();
    host.connect(Duration::ZERO, PeerId(1), 1200).unwrap();
    let hello = GuestMessage::Hello {
        version: 999,
        name: "old".into(),
        subscription: RecoveryConfig::default().subscription(None),
        cached: Vec::new(),
    };
    host.on_message(Duration::ZERO, PeerId(1), &hello.encode());
    let message = HostMessage::decode(&host.poll_output().unwrap().bytes).unwrap();
    assert_eq!(message, HostMessage::Goodbye { reason: DisconnectReason::VersionMismatch });
}

#[test]
fn the_application_cannot_publish_nonsense() {
    let model = bar(12, 0.05);
    let mut host = HostSession::new(HostSessionConfig::default()).unwrap();
    host.add_body(BODY, "bar", model, StepSettings::default()).unwrap();
    let good = vec![0.0; 12];
    let bad = vec![f64::NAN; 12];
    let long = vec![0.0; 13];
    let at = |tick, q: &[f64]| {
        let mut h = HostSession::new(HostSessionConfig::default()).unwrap();
        h.add_body(BODY, "bar", bar(12, 0.05), StepSettings::default()).unwrap();
        let state = TickState { tick, q, v: &good, a: &good, z: &[], pose: None, grabs: &[], resting: false };
        h.publish(Duration::ZERO, BODY, &state)
    };
    assert_eq!(at(1, &good), Ok(()));
    assert_eq!(at(1, &bad), Err(StreamError::NotFinite { what: "q" }));
    assert_eq!(at(1, &long), Err(StreamError::Length { what: "q", found: 13, expected: 12 }));
    assert!(matches!(at(0, &good), Err(StreamError::TickOrder { .. })));
    let state =
        TickState { tick: 5, q: &good, v: &good, a: &good, z: &[], pose: None, grabs: &[], resting: false };
    host.publish(Duration::ZERO, BODY, &state).unwrap();
    assert_eq!(host.publish(Duration::ZERO, BODY, &state), Err(StreamError::TickOrder { last: 5, found: 5 }));
    assert_eq!(host.publish(Duration::ZERO, BodyId(7), &state), Err(StreamError::UnknownBody(BodyId(7))));
}
