//! Sessions without links: each side receives at once what the other sends.

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{GrabConfig, ModalModel};
use pliant_stream::peer::{PeerSession, PeerSessionConfig};
use pliant_stream::wire::FrameGrab;
use pliant_stream::{
    BodyId, Channel, GrabKey, GrabState, GuestSession, GuestSessionConfig, HostSession, HostSessionConfig,
    PeerId, RecoveryConfig, StepSettings, Surroundings, TickState, UserId,
};

use super::bar;

pub const BODY: BodyId = BodyId(1);

pub fn grab(index: u16) -> FrameGrab {
    FrameGrab {
        state: GrabState {
            key: GrabKey { user: UserId(index), grab: 7 },
            vertex: 5,
            radius: 0.25,
            target: [1.0, 2.0, 3.0],
            reaction: [0.5, -8.0, 1024.0],
            hold: GrabConfig {
                stiffness: (index == 1).then_some(200.0),
                relaxation: if index == 2 { 0.0625 } else { 0.0 },
            },
        },
        displacement: [0.25, 0.0, -0.5],
        held: index != 2,
    }
}

/// A connected host and guest without links: each side receives at once what the other sends.
pub fn session(name: &str) -> (HostSession, GuestSession, Duration) {
    let model = bar(12, 0.05);
    let mut host = HostSession::new(HostSessionConfig::default()).unwrap();
    host.add_body(BODY, "bar", model.clone(), StepSettings::default()).unwrap();
    let recovery = RecoveryConfig::by_name(name).unwrap();
    let mut guest = GuestSession::new(GuestSessionConfig { recovery, ..Default::default() }, 1200).unwrap();
    guest.add_cached_model(model);
    let mut now = Duration::ZERO;
    host.connect(now, PeerId(1), 1200).unwrap();
    guest.connect(now).unwrap();
    for tick in 1..60 {
        now += Duration::from_millis(25);
        publish(&mut host, now, tick);
        exchange(&mut host, &mut guest, now);
        if tick == 10 {
            guest.begin_grab(now, BODY, 66, 0.05, [1.0, 0.0, 0.0], Default::default()).unwrap();
        }
    }
    assert!(guest.body(BODY).unwrap().is_ready());
    (host, guest, now)
}

pub fn publish(host: &mut HostSession, now: Duration, tick: u64) {
    let q: Vec<f64> = (0..12).map(|k| 0.01 * (0.002 * tick as f64 + k as f64).sin()).collect();
    let v = vec![0.0; 12];
    let grabs = [GrabState { reaction: [0.05, -0.02, 0.1], ..grab(1).state }];
    let state = TickState { tick, q: &q, v: &v, a: &v, z: &[], pose: None, grabs: &grabs, resting: false };
    host.publish(now, BODY, &state).unwrap();
}

pub fn exchange(host: &mut HostSession, guest: &mut GuestSession, now: Duration) {
    for _ in 0..3 {
        host.update(now);
        guest.update(now);
        while let Some(o) = guest.poll_output() {
            match o.channel {
                Channel::Datagram => host.on_datagram(now, PeerId(1), &o.bytes),
                Channel::Message => host.on_message(now, PeerId(1), &o.bytes),
            }
        }
        while let Some(o) = host.poll_output() {
            match o.channel {
                Channel::Datagram => guest.on_datagram(now, &o.bytes),
                Channel::Message => guest.on_message(now, &o.bytes),
            }
        }
    }
}

/// Xorshift random numbers (Marsaglia 2003). Equal seeds give equal numbers.
pub fn random(state: &mut u64) -> u64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    *state
}

/// Three peers without links. Each output goes directly to its receiver.
pub fn peers(now: Duration) -> Vec<PeerSession> {
    peers_of(now, &bar(12, 0.05), &Surroundings::default())
}

/// The same with another body, and with what stands around it.
pub fn peers_of(now: Duration, model: &Arc<ModalModel>, around: &Surroundings) -> Vec<PeerSession> {
    let mut all: Vec<PeerSession> = (0..3)
        .map(|k| {
            let config = PeerSessionConfig { user: UserId(k + 1), ..Default::default() };
            let mut peer = PeerSession::new(config).unwrap();
            peer.add_body(BODY, model.clone(), &StepSettings::default()).unwrap();
            peer.set_surroundings(BODY, around.clone()).unwrap();
            for other in (0..3).filter(|o| *o != k) {
                peer.connect(now, PeerId(u64::from(other)), UserId(other + 1), 1200).unwrap();
            }
            peer.begin_grab(BODY, 66, 0.05, [1.0, 0.05 * f64::from(k), 0.0], Default::default()).unwrap();
            peer
        })
        .collect();
    pass(&mut all, now, |_, _, _| {});
    all
}

pub fn pass(all: &mut [PeerSession], now: Duration, mut seen: impl FnMut(usize, usize, &[u8])) {
    for from in 0..all.len() {
        all[from].update(now);
        while let Some(o) = all[from].poll_output() {
            let to = o.peer.0 as usize;
            if o.channel == Channel::Datagram {
                seen(from, to, &o.bytes);
                all[to].on_datagram(now, PeerId(from as u64), &o.bytes);
            } else {
                all[to].on_message(now, PeerId(from as u64), &o.bytes);
            }
        }
    }
}
