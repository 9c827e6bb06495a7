//! Lying peers and jumping clocks. Memory stays bounded, and sessions continue or end with a
//! reason.

use crate::support;

use std::time::Duration;

use pliant_stream::peer::{PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::wire::{BodyInfo, Datagram, GuestMessage, HostMessage, NackRun, PROTOCOL_VERSION};
use pliant_stream::{
    Channel, DisconnectReason, GuestEvent, GuestSession, GuestSessionConfig, HostSession, Newmark, PeerId,
    StepSettings, StreamError, Surroundings,
};
use support::bar;
use support::direct::{BODY, pass, peers, publish, random, session};

#[test]
fn a_host_cannot_make_a_guest_hold_more_than_its_bound() {
    // A small-scale version of the real limit: one model fits, and a second download beside it does
    // not.
    let model = bar(12, 0.05);
    let size = model.to_bytes().len() as u64;
    let info = |body: u16, hash: [u8; 32]| BodyInfo {
        body,
        name: "a body".into(),
        hash,
        modes: 9,
        settings: StepSettings::default(),
        around: Surroundings::default(),
    };
    let chunk = |hash, total, bytes: &[u8]| {
        HostMessage::ModelChunk { hash, offset: 0, total, bytes: bytes.to_vec() }.encode()
    };
    for (room, fits) in [(size, 1), (2 * size - 1, 1), (2 * size, 2), (size - 1, 0)] {
        let config = GuestSessionConfig { model_bytes: room, ..Default::default() };
        let mut guest = GuestSession::new(config, 1200).unwrap();
        let now = Duration::from_secs(1);
        guest.connect(now).unwrap();
        let newmark = Newmark::average(0.025);
        let (beta, gamma, users) = (newmark.beta, newmark.gamma, Vec::new());
        let welcome = HostMessage::Welcome {
            version: PROTOCOL_VERSION,
            user: 1,
            step_ns: 25_000_000,
            beta,
            gamma,
            users,
        };
        guest.on_message(now, &welcome.encode());
        // Send a whole model, then the first bytes of a second model that claims the same size. A
        // download counts with its claimed size.
        let hash = model.hash().0;
        guest.on_message(now, &HostMessage::BodyAdded(info(1, hash)).encode());
        guest.on_message(now, &HostMessage::BodyAdded(info(2, [9; 32])).encode());
        guest.on_message(now, &chunk(hash, size, &model.to_bytes()));
        assert_eq!(guest.is_closed(), fits == 0, "room for {room} of {size}");
        guest.on_message(now, &chunk([9; 32], size, &[0; 16]));
        assert_eq!(guest.is_closed(), fits < 2, "room for {room} of {size}");
        let closed = std::iter::from_fn(|| guest.poll_event())
            .find_map(|e| if let GuestEvent::Closed { reason } = e { Some(reason) } else { None });
        assert_eq!(closed, (fits < 2).then_some(DisconnectReason::Full));
    }
}

#[test]
fn hands_that_are_not_numbers_are_refused_and_the_old_target_stays() {
    let (_, mut guest, now) = session("default");
    let grab = guest.grabs().next().unwrap().0;
    let mut peer = PeerSession::new(PeerSessionConfig::default()).unwrap();
    peer.add_body(BODY, bar(12, 0.05), &StepSettings::default()).unwrap();
    let own = peer.begin_grab(BODY, 66, 0.05, [1.0, 0.0, 0.0], Default::default()).unwrap();
    for bad in [f64::NAN, f64::INFINITY, -1e300] {
        let refused = Err(StreamError::NotFinite { what: "target" });
        for at in 0..3 {
            let mut target = [1.0, 0.0, 0.0];
            target[at] = bad;
            assert_eq!(guest.set_target(grab, target), refused);
            assert_eq!(peer.set_target(own, target), refused);
            let refused = Err(StreamError::NotFinite { what: "grab" });
            assert_eq!(peer.begin_grab(BODY, 66, 0.05, target, Default::default()), refused);
            assert_eq!(guest.begin_grab(now, BODY, 66, 0.05, target, Default::default()), refused);
        }
    }
    for k in 1..80_u32 {
        peer.update(k * Duration::from_millis(25));
    }
    let body = peer.body(BODY).unwrap();
    assert_eq!(body.grabs()[0].target, [1.0, 0.0, 0.0]);
    assert!(body.visual().is_finite());
}

#[test]
fn peers_survive_a_hundred_thousand_damaged_datagrams() {
    let mut now = Duration::from_millis(1);
    let mut all = peers(now);
    let mut state = 88_172_645_463_325_252;
    let mut next = || random(&mut state);
    let mut last: Vec<Vec<u8>> = vec![Datagram::InputRequest(vec![NackRun { first: 5, count: 3 }]).encode(2)];
    let mut taken = 0_u64;
    for round in 0..100_000_u64 {
        if round % 100 == 0 {
            now += Duration::from_millis(25);
            pass(&mut all, now, |_, _, bytes| last.push(bytes.to_vec()));
            let old = last.len().saturating_sub(12);
            last.drain(1..1.max(old));
            for p in &mut all {
                assert!(p.body(BODY).unwrap().visual().is_finite(), "round {round}");
                while let Some(e) = p.poll_event() {
                    assert!(!matches!(e, PeerEvent::Left { .. }), "round {round}: {e:?}");
                }
            }
        }
        let mut bytes = last[(next() % last.len() as u64) as usize].clone();
        for _ in 0..=next() % 3 {
            let at = next() as usize % bytes.len();
            bytes[at] = next() as u8;
        }
        if next().is_multiple_of(8) {
            bytes.truncate(next() as usize % (bytes.len() + 1));
        }
        taken += u64::from(Datagram::decode(&bytes).is_ok());
        let (from, to) = (next() % 3, (next() % 3) as usize);
        if from as usize != to {
            all[to].on_datagram(now, PeerId(from), &bytes);
        }
    }
    println!("{taken} of 100,000 damaged datagrams could be read");
    assert!(taken > 20_000, "{taken}");
    // After the damage ends, all peers agree again.
    for _ in 0..400 {
        now += Duration::from_millis(25);
        pass(&mut all, now, |_, _, _| {});
    }
    let tick = all.iter().map(PeerSession::confirmed).min().unwrap();
    assert!(tick > 1300, "{tick}");
    let of = |k: usize| &all[k].state_at(BODY, tick).unwrap().q;
    for k in [1, 2] {
        let off: f64 = of(0).iter().zip(of(k)).map(|(a, b)| (a - b).abs()).sum();
        assert!(off < 1e-6, "peer {}: {off}", k + 1);
    }
}

/// The times that both clocks show in addition to the true time, and the order in which a side
/// receives data and reads its clock.
struct Jump {
    host: Duration,
    guest: Duration,
    hears_first: bool,
}

/// Runs ten seconds of a session whose clocks jump after five seconds. Returns the reason with
/// which the guest's session ended, if it ended.
fn through(jump: &Jump) -> (Option<DisconnectReason>, HostSession, GuestSession, u64) {
    let (mut host, mut guest, start) = session("default");
    while guest.poll_event().is_some() {}
    let (mut ended, mut tick) = (None, 60);
    for k in 1..=400_u32 {
        let t = start + k * Duration::from_millis(25);
        let late = k > 200;
        let host_now = if late { t + jump.host } else { t };
        let guest_now = if late { t + jump.guest } else { t };
        publish(&mut host, host_now, tick);
        tick += 1;
        let exchange = |host: &mut HostSession, guest: &mut GuestSession| {
            while let Some(o) = guest.poll_output() {
                match o.channel {
                    Channel::Datagram => host.on_datagram(host_now, PeerId(1), &o.bytes),
                    Channel::Message => host.on_message(host_now, PeerId(1), &o.bytes),
                }
            }
            while let Some(o) = host.poll_output() {
                match o.channel {
                    Channel::Datagram => guest.on_datagram(guest_now, &o.bytes),
                    Channel::Message => guest.on_message(guest_now, &o.bytes),
                }
            }
        };
        let grab = guest.grabs().next().map(|g| g.0);
        if let Some(grab) = grab {
            guest.set_target(grab, [1.0, 0.001 * f64::from(k), 0.0]).unwrap();
        }
        if jump.hears_first {
            // The network task ran in between, so both sides have just received data on the new
            // clock.
            if k == 201 {
                host.on_message(host_now, PeerId(1), &GuestMessage::SnapshotRequest { body: 1 }.encode());
            }
            exchange(&mut host, &mut guest);
        }
        host.update(host_now);
        let stepped = guest.update(guest_now);
        assert!(stepped < 20, "{stepped} ticks at once");
        exchange(&mut host, &mut guest);
        while let Some(e) = guest.poll_event() {
            if let GuestEvent::Closed { reason } = e {
                ended = ended.or(Some(reason));
            }
        }
        while host.poll_event().is_some() {}
    }
    (ended, host, guest, tick)
}

#[test]
fn clocks_that_jump_an_hour_are_followed_or_end_the_session_with_a_reason() {
    let hour = Duration::from_secs(3600);
    for (host_jumps, guest_jumps) in [(hour, Duration::ZERO), (Duration::ZERO, hour), (hour, hour)] {
        // (The time stamps of the clock exchange jump with the clocks of the host and the guest.)
        let jump = Jump { host: host_jumps, guest: guest_jumps, hears_first: true };
        let (ended, host, guest, tick) = through(&jump);
        assert_eq!(ended, None, "{host_jumps:?} {guest_jumps:?}");
        assert_eq!(host.users().count(), 1);
        let view = guest.body(BODY).unwrap();
        assert!(view.tick() + 8 > tick && !view.is_stalled(), "tick {} of {tick}", view.tick());
        let off = guest.clock_offset().unwrap() - (host_jumps.as_secs_f64() - guest_jumps.as_secs_f64());
        assert!(off.abs() < 0.1, "the clocks' offset is known again: {off} s off");
        assert!(guest.stats().round_trip < Duration::from_secs(1), "{:?}", guest.stats().round_trip);
        // A side that reads its clock first has received nothing for an hour and ends the session.
        let jump = Jump { hears_first: false, ..jump };
        let (ended, ..) = through(&jump);
        assert_eq!(ended, Some(DisconnectReason::Silent), "{host_jumps:?} {guest_jumps:?}");
    }
}

#[test]
fn a_peer_whose_clock_jumps_an_hour_comes_back_or_says_why_not() {
    let hour = Duration::from_secs(3600);
    let mut now = Duration::from_millis(1);
    let mut all = peers(now);
    for _ in 0..100 {
        now += Duration::from_millis(25);
        pass(&mut all, now, |_, _, _| {});
    }
    // All clocks jump, so no peer has received anything for an hour. Each peer reports that the
    // others are silent.
    now += hour;
    pass(&mut all, now, |_, _, _| {});
    for (k, p) in all.iter_mut().enumerate() {
        let left = std::iter::from_fn(|| p.poll_event())
            .filter(|e| matches!(e, PeerEvent::Left { reason: DisconnectReason::Silent, .. }))
            .count();
        // (The first peer updates first. The others receive what it sends before they update.)
        assert!(left == 2 || k > 0, "peer {}: {left}", k + 1);
        assert!(p.tick() < 120, "no hour of ticks is caught up with: {}", p.tick());
    }
    let before = all[0].tick();
    for _ in 0..40 {
        now += Duration::from_millis(25);
        pass(&mut all, now, |_, _, _| {});
    }
    assert!((before + 35..=before + 45).contains(&all[0].tick()), "it goes on alone at its own pace");
    assert!(all.iter().all(|p| p.body(BODY).unwrap().visual().is_finite()));
}
