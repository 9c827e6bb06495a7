//! Three equal peers over bad paths: they agree on one shape, apply their own hands at once and
//! correct all errors.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{
    Body, BodyConfig, ContactState, FixedObstacle, FixedShape, GrabConfig, HeldPatch, Integrator, ModalModel,
    Patch, Relaxation,
};
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss, Preset};
use pliant_stream::peer::{LateInputRepair, PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::wire::{
    Datagram, HeldAt, InputTick, Inputs, NackRun, PROTOCOL_VERSION, PeerBodyState, PeerMessage, StateCheck,
};
use pliant_stream::{
    BodyId, Channel, DisconnectReason, PeerId, State, StepSettings, StreamError, Surroundings, UserId,
};
use proptest::prelude::*;
use support::{bar, loose_bar};

const BODY: BodyId = BodyId(1);
const OTHER: BodyId = BodyId(2);
const S: Duration = Duration::from_secs(1);
const MS: Duration = Duration::from_millis(1);

/// Peer `k` has user number `k + 1`, and the others know it as `PeerId(k)`.
struct Mesh {
    peers: Vec<Option<PeerSession>>,
    /// `[from][to]`: the link for datagrams and the link for messages.
    links: Vec<Vec<(EmulatedLink, EmulatedLink)>>,
    events: Vec<(usize, PeerEvent)>,
    now: Duration,
    /// Time of each peer's clock at the test's time zero.
    began: Vec<Duration>,
    grabs: Vec<Option<u16>>,
    /// Peer, tick and visual coordinates.
    seen: Vec<(usize, u64, Vec<f64>)>,
    model: Arc<ModalModel>,
    /// A second body, if there is one.
    other: Option<Arc<ModalModel>>,
    settings: StepSettings,
    around: Surroundings,
    hold: GrabConfig,
    /// What happens to a datagram on its way. Arguments: sender, receiver, bytes.
    tamper: fn(usize, usize, Vec<u8>) -> Vec<u8>,
}

impl Mesh {
    fn new(count: usize, link: &LinkConfig, seed: u64) -> Self {
        let reliable = LinkConfig { loss: Loss::None, keep_order: true, ..link.clone() };
        let links = (0..count as u64)
            .map(|a| {
                (0..count as u64)
                    .map(|b| {
                        let s = seed * 1000 + a * 10 + b;
                        (EmulatedLink::new(link.clone(), s), EmulatedLink::new(reliable.clone(), s + 500))
                    })
                    .collect()
            })
            .collect();
        Self {
            peers: (0..count).map(|_| None).collect(),
            links,
            events: Vec::new(),
            now: Duration::ZERO,
            began: vec![Duration::ZERO; count],
            grabs: vec![None; count],
            seen: Vec::new(),
            model: bar(40, 0.05),
            other: None,
            settings: StepSettings::default(),
            around: Surroundings::default(),
            hold: GrabConfig::default(),
            tamper: |_, _, bytes| bytes,
        }
    }

    fn start(&mut self, k: usize, repair: LateInputRepair, founds: bool) {
        let user = UserId(k as u16 + 1);
        let config = PeerSessionConfig { user, repair, founds, ..Default::default() };
        let mut peer = PeerSession::new(config).unwrap();
        peer.add_body(BODY, self.model.clone(), &self.settings).unwrap();
        peer.set_surroundings(BODY, self.around.clone()).unwrap();
        if let Some(other) = &self.other {
            peer.add_body(OTHER, other.clone(), &self.settings).unwrap();
            peer.set_surroundings(OTHER, self.around.clone()).unwrap();
        }
        for other in 0..self.peers.len() {
            if let Some(o) = &mut self.peers[other] {
                o.connect(self.began[other] + self.now, PeerId(k as u64), user, 1200).unwrap();
                let number = UserId(other as u16 + 1);
                peer.connect(self.began[k] + self.now, PeerId(other as u64), number, 1200).unwrap();
            }
        }
        self.peers[k] = Some(peer);
    }

    fn hand(k: usize, now: Duration) -> [f64; 3] {
        let t = now.as_secs_f64() + k as f64;
        let x = [1.0, 0.5, 0.75][k];
        let size = [0.1, 0.04, 0.06][k];
        [x, 0.08 + size * (1.1 * t).sin(), 0.08 + size * (0.7 * t).cos()]
    }

    /// Vertices at x = 1, 1/2, 3/4 on the edge y = z = 0.08.
    const VERTEX: [u32; 3] = [66, 34, 50];

    fn run(&mut self, until: Duration) {
        while self.now < until {
            for from in 0..self.peers.len() {
                for to in 0..self.peers.len() {
                    let (datagrams, messages) = &mut self.links[from][to];
                    while let Some(bytes) = messages.poll(self.now) {
                        if let Some(p) = &mut self.peers[to] {
                            p.on_message(self.began[to] + self.now, PeerId(from as u64), &bytes);
                        }
                    }
                    while let Some(bytes) = datagrams.poll(self.now) {
                        if let Some(p) = &mut self.peers[to] {
                            let bytes = (self.tamper)(from, to, bytes.to_vec());
                            p.on_datagram(self.began[to] + self.now, PeerId(from as u64), &bytes);
                        }
                    }
                }
            }
            for (k, slot) in self.peers.iter_mut().enumerate() {
                let Some(p) = slot else { continue };
                if p.tick() > 40 {
                    let target = Self::hand(k, self.now);
                    match self.grabs[k] {
                        None => {
                            self.grabs[k] = p.begin_grab(BODY, Self::VERTEX[k], 0.05, target, self.hold).ok()
                        }
                        Some(g) => p.set_target(g, target).unwrap(),
                    }
                }
                let stepped = p.update(self.began[k] + self.now);
                while let Some(e) = p.poll_event() {
                    self.events.push((k, e));
                }
                if stepped > 0 {
                    let body = p.body(BODY).unwrap();
                    self.seen.push((k, p.tick(), body.visual().q.clone()));
                }
                while let Some(o) = p.poll_output() {
                    let link = &mut self.links[k][o.peer.0 as usize];
                    let link = if o.channel == Channel::Datagram { &mut link.0 } else { &mut link.1 };
                    link.send(self.now, o.bytes.to_vec(), o.bytes.len());
                }
            }
            // Peers update their sessions every 5 ms, as with rendered frames.
            self.now += 5 * MS;
        }
    }

    /// Distance of the centers of mass of the free body at the last tick that two peers have
    /// confirmed, m, and its largest difference in a modal coordinate.
    fn other_apart(&self, a: usize, b: usize) -> (f64, f64) {
        let (a, b) = (self.peers[a].as_ref().unwrap(), self.peers[b].as_ref().unwrap());
        let tick = a.confirmed().min(b.confirmed());
        let (x, y) = (a.state_at(OTHER, tick).unwrap(), b.state_at(OTHER, tick).unwrap());
        let (c, d) = (x.frame.center(), y.frame.center());
        let far = (0..3).map(|k| (c[k] - d[k]).powi(2)).sum::<f64>().sqrt();
        (far, x.q.iter().zip(&y.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max))
    }

    fn agree(&self, a: usize, b: usize) -> f64 {
        let (a, b) = (self.peers[a].as_ref().unwrap(), self.peers[b].as_ref().unwrap());
        let tick = a.confirmed().min(b.confirmed());
        let (x, y) = (a.state_at(BODY, tick).unwrap(), b.state_at(BODY, tick).unwrap());
        let size = x.q.iter().map(|q| q * q).sum::<f64>().sqrt();
        x.q.iter().zip(&y.q).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt() / size
    }

    /// Root mean square difference between the visual coordinates and those that peer 0 confirmed
    /// for the same tick, relative to the largest confirmed shape.
    fn shown_error(&self, settled: &[(u64, Vec<f64>)]) -> f64 {
        let size =
            settled.iter().map(|(_, q)| q.iter().map(|x| x * x).sum::<f64>().sqrt()).fold(0.0, f64::max);
        let (mut sum, mut count) = (0.0, 0);
        // Skip the first five seconds, because no forecast predicts the start of a grab.
        for (_, tick, q) in self.seen.iter().filter(|s| s.1 > 200) {
            if let Some((_, truth)) = settled.iter().find(|s| s.0 == *tick) {
                sum += q.iter().zip(truth).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
                count += 1;
            }
        }
        assert!(count > 300);
        (sum / f64::from(count)).sqrt() / size
    }
}

#[test]
fn three_peers_agree_to_the_bit_under_rollback_over_the_papers_worst_network() {
    let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper1), 7);
    for k in 0..3 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    let mut settled: Vec<(u64, Vec<f64>)> = Vec::new();
    for second in 1..=30 {
        mesh.run(second * S);
        let p = mesh.peers[0].as_ref().unwrap();
        let from = p.confirmed().saturating_sub(60);
        for t in from..=p.confirmed() {
            if settled.last().is_none_or(|l| l.0 < t)
                && let Some(s) = p.state_at(BODY, t)
            {
                settled.push((t, s.q.clone()));
            }
        }
    }
    assert_eq!(mesh.agree(0, 1), 0.0, "the same inputs stepped the same way");
    assert_eq!(mesh.agree(0, 2), 0.0);
    assert!(!mesh.events.iter().any(|e| matches!(e.1, PeerEvent::Resynced { .. })), "{:?}", mesh.events);
    let ticks: Vec<u64> = mesh.peers.iter().map(|p| p.as_ref().unwrap().tick()).collect();
    let spread = ticks.iter().max().unwrap() - ticks.iter().min().unwrap();
    assert!(spread <= 1, "ticks stay together: {ticks:?}");
    let behind = ticks[0] - mesh.peers[0].as_ref().unwrap().confirmed();
    assert!(behind <= 40, "confirmed {behind} ticks behind");
    let error = mesh.shown_error(&settled);
    println!("shown error before confirmation: {:.3} %", 100.0 * error);
    assert!(error < 0.004, "{error}");
}

/// Three peers strike a free body in turns. Its momentum is the sum of what was sent, and the same
/// to the bit at all peers: each impulse acts once, at one tick.
#[test]
fn impulses_act_once_and_alike_at_all_peers() {
    for repair in [LateInputRepair::Rollback, LateInputRepair::Compensate] {
        let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper1), 19);
        mesh.other = Some(loose_bar(12, 0.05));
        (0..3).for_each(|k| mesh.start(k, repair, true));
        let mut sum = [0.0; 3];
        for round in 0..9_u32 {
            mesh.run(2 * S + round * 300 * MS);
            let k = round as usize % 3;
            // These numbers are the same in single precision.
            let impulse = [0.25, -0.5 * f64::from(round), 0.125];
            (0..3).for_each(|axis| sum[axis] += impulse[axis]);
            mesh.peers[k].as_mut().unwrap().apply_impulse(OTHER, Mesh::VERTEX[k], impulse).unwrap();
        }
        mesh.run(8 * S);
        assert_eq!(mesh.other_apart(0, 1), (0.0, 0.0));
        assert_eq!(mesh.other_apart(0, 2), (0.0, 0.0));
        let peer = mesh.peers[0].as_ref().unwrap();
        let velocity = peer.state_at(OTHER, peer.confirmed()).unwrap().frame.velocity();
        for (axis, expected) in sum.into_iter().enumerate() {
            assert!((2.0 * velocity[axis] - expected).abs() < 1e-9, "{velocity:?}, {sum:?} N s over 2 kg");
        }
        assert!(peer.body(OTHER).unwrap().live().q.iter().any(|q| q.abs() > 1e-6), "the modes move too");
    }
}

#[test]
fn an_impulse_of_a_peer_has_its_bounds() {
    let mut mesh = Mesh::new(2, &LinkConfig::default(), 5);
    mesh.other = Some(loose_bar(12, 0.05));
    (0..2).for_each(|k| mesh.start(k, LateInputRepair::Rollback, true));
    mesh.run(S);
    let peer = mesh.peers[0].as_mut().unwrap();
    for wrong in [[f64::NAN, 0.0, 0.0], [0.0, f64::INFINITY, 0.0], [0.0, 0.0, 2e9]] {
        let error = peer.apply_impulse(OTHER, 0, wrong).unwrap_err();
        assert_eq!(error, StreamError::NotFinite { what: "impulse" });
    }
    assert_eq!(peer.apply_impulse(BodyId(9), 0, [1.0; 3]), Err(StreamError::UnknownBody(BodyId(9))));
    assert!(matches!(peer.apply_impulse(OTHER, 1_000_000, [1.0; 3]), Err(StreamError::Model(_))));
    peer.apply_impulse(OTHER, Mesh::VERTEX[0], [0.0, -1e8, 0.0]).unwrap();
    for _ in 1..8 {
        peer.apply_impulse(OTHER, Mesh::VERTEX[0], [0.0; 3]).unwrap();
    }
    let full = StreamError::Full { what: "impulses", limit: 8 };
    assert_eq!(peer.apply_impulse(OTHER, 0, [1.0; 3]), Err(full), "the ninth of a tick");
    mesh.run(2 * S);
    for k in 0..2 {
        let peer = mesh.peers[k].as_ref().unwrap();
        let velocity = peer.body(OTHER).unwrap().live().frame.velocity();
        assert!((velocity[1] + pliant_stream::MAX_IMPULSE_SPEED).abs() < 1e-6, "{k}: {velocity:?}");
    }
}

#[test]
fn rollback_is_nearer_than_the_papers_compensation() {
    let error = |repair| {
        let mut mesh = Mesh::new(2, &LinkConfig::preset(Preset::Paper2), 3);
        for k in 0..2 {
            mesh.start(k, repair, true);
        }
        mesh.run(20 * S);
        mesh.agree(0, 1)
    };
    let (exact, papers) = (error(LateInputRepair::Rollback), error(LateInputRepair::Compensate));
    println!("disagreement: rollback {exact:e}, compensation {papers:e}");
    assert_eq!(exact, 0.0);
    assert!((0.005..0.0125).contains(&papers), "{papers}");
}

#[test]
fn free_and_relaxing_bodies_agree_to_the_bit_and_late_joiners_with_them() {
    let settings = StepSettings {
        integrator: Integrator::GeneralizedAlpha { rho_inf: 0.5 },
        gravity: [0.0, 0.0, -0.4],
        relaxation: Some(Relaxation { ratio: 0.5, time: 0.4 }),
        ..Default::default()
    };
    for (free, settings) in
        [(true, StepSettings { relaxation: None, ..settings }), (false, settings), (true, settings)]
    {
        let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper2), 11);
        mesh.settings = settings;
        mesh.model = if free { loose_bar(24, 0.05) } else { bar(24, 0.05) };
        mesh.start(0, LateInputRepair::Rollback, true);
        mesh.start(1, LateInputRepair::Rollback, true);
        mesh.run(6 * S);
        mesh.start(2, LateInputRepair::Rollback, false);
        mesh.run(14 * S);
        assert_eq!(mesh.agree(0, 1), 0.0, "free {free}, {settings:?}");
        // The received orientation is normalized, so the last bit of the dependent values may
        // differ.
        assert!(mesh.agree(0, 2) < 1e-9, "free {free}, {settings:?}: {}", mesh.agree(0, 2));
        let all: Vec<&PeerSession> = mesh.peers.iter().flatten().collect();
        let tick = all.iter().map(|p| p.confirmed()).min().unwrap();
        let state = |k: usize| all[k].state_at(BODY, tick).unwrap();
        let pose = |k: usize| all[k].pose_at(BODY, tick);
        assert_eq!(pose(0).is_some(), free);
        assert_eq!((pose(0), &state(0).z), (pose(1), &state(1).z));
        let flown: f64 = state(0).z.iter().zip(&state(2).z).map(|(a, b)| (a - b).abs()).sum();
        assert!(flown < 1e-9, "{flown}");
        if let (Some(a), Some(b)) = (pose(0), pose(2)) {
            assert!((0..3).all(|k| (a.position[k] - b.position[k]).abs() < 1e-9), "{a:?} and {b:?}");
        }
        assert_eq!(state(0).z.is_empty(), settings.relaxation.is_none());
        if let Some(pose) = pose(0) {
            let moved = (0..3).map(|k| pose.position[k].powi(2)).sum::<f64>().sqrt();
            assert!(moved > 0.01, "the hands must have moved the frame: {moved} m");
        }
        // (In its first seconds a joining peer may need one more state, which it requests from the
        // peer with the lowest number.)
        let resynced = |e: &(usize, PeerEvent)| matches!(e.1, PeerEvent::Resynced { .. });
        assert!(mesh.events.iter().filter(|e| e.0 == 2 && resynced(e)).count() <= 1, "{:?}", mesh.events);
        let resynced = |e: &(usize, PeerEvent)| e.0 < 2 && resynced(e);
        assert!(!mesh.events.iter().any(resynced), "{:?}", mesh.events);
    }
}

/// The ground, 4 cm below the bars.
fn floor() -> Surroundings {
    let ground = FixedObstacle { position: [0.0, -0.12, 0.0], ..FixedObstacle::GROUND };
    Surroundings { obstacles: vec![ground], ..Surroundings::default() }
}

/// Three hands beat one bar onto the floor, and another one falls onto it. Late inputs roll the
/// peers back over the blows.
#[test]
fn peers_step_contacts_to_the_bit_and_late_joiners_with_them() {
    let lowest = |around: Surroundings| {
        let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper1), 7);
        mesh.model = loose_bar(24, 0.05);
        mesh.other = Some(loose_bar(24, 0.05));
        mesh.settings.gravity = [0.0, -9.81, 0.0];
        mesh.hold = GrabConfig { stiffness: Some(400.0), relaxation: 0.01 };
        mesh.around = around;
        mesh.start(0, LateInputRepair::Rollback, true);
        mesh.start(1, LateInputRepair::Rollback, true);
        let mut lowest = f64::INFINITY;
        for half in 1..=24 {
            if half == 14 {
                mesh.start(2, LateInputRepair::Rollback, false);
            }
            mesh.run(half * S / 2);
            let p = mesh.peers[0].as_ref().unwrap();
            for tick in p.confirmed().saturating_sub(30)..=p.confirmed() {
                lowest = p.state_at(BODY, tick).map_or(lowest, |s| lowest.min(s.frame.center()[1]));
            }
        }
        assert!(!mesh.events.iter().any(|e| e.0 < 2 && matches!(e.1, PeerEvent::Resynced { .. })));
        assert_eq!((mesh.agree(0, 1), mesh.other_apart(0, 1)), (0.0, (0.0, 0.0)));
        let (far, bent) = mesh.other_apart(0, 2);
        println!("joiner: {:e} apart, the other bar {far:e} m and {bent:e}", mesh.agree(0, 2));
        assert!(mesh.agree(0, 2) < 1e-6 && far < 1e-6 && bent < 1e-6);
        let all: Vec<&PeerSession> = mesh.peers.iter().flatten().collect();
        let tick = all.iter().map(|p| p.confirmed()).min().unwrap();
        assert_eq!(all[0].pose_at(BODY, tick), all[1].pose_at(BODY, tick));
        assert!(all.iter().all(|p| p.body(BODY).unwrap().restepped() > 100), "late hands roll back");
        // The modes of this bar move it against its frame, so its surface tells where it lies.
        let (model, state) = (&mesh.model, all[0].state_at(OTHER, tick).unwrap());
        let height = |vertex: u32| {
            let patch = Patch::around(model.surface(), vertex, 0.0).unwrap();
            let patch = HeldPatch::new(model, &patch, model.mode_count()).unwrap();
            state.frame.to_world(patch.rest() + patch.displacement(&state.q, true)).y
        };
        (lowest, (0..68).map(height).fold(f64::INFINITY, f64::min))
    };
    let (held, fallen) = lowest(floor());
    let (unheld, gone) = lowest(Surroundings::default());
    println!("with the floor {held:.3} and {fallen:.3} m, without {unheld:.3} and {gone:.1} m");
    assert!(unheld < held - 0.01, "the hands beat it onto the floor");
    assert!((-0.2..-0.1).contains(&fallen) && gone < -50.0, "the other one lies on the floor");
}

#[test]
fn peers_among_other_obstacles_are_turned_away_and_bad_ones_are_refused() {
    let new = |around: &Surroundings| {
        let mut peer = PeerSession::new(PeerSessionConfig::default()).unwrap();
        peer.add_body(BODY, loose_bar(2, 0.05), &StepSettings::default()).unwrap();
        peer.set_surroundings(BODY, around.clone()).map(|()| peer.scene())
    };
    let ground = new(&floor()).unwrap();
    assert_eq!(new(&floor()).unwrap(), ground);
    assert_ne!(new(&Surroundings::default()).unwrap(), ground);
    assert_ne!(new(&Surroundings { friction: 0.4, ..floor() }).unwrap(), ground);
    let with = |shape, count| Surroundings {
        obstacles: vec![FixedObstacle { shape, ..FixedObstacle::GROUND }; count],
        ..Surroundings::default()
    };
    assert!(new(&with(FixedShape::Plane, 256)).is_ok());
    assert!(matches!(new(&with(FixedShape::Plane, 257)), Err(StreamError::Full { limit: 256, .. })));
    for bad in [
        with(FixedShape::Ball { radius: f64::NAN }, 1),
        with(FixedShape::Box { half: [1.0, -1.0, 1.0], round: 0.0 }, 1),
        with(FixedShape::Capsule { radius: 1e300, half_length: 1.0 }, 1),
        Surroundings { friction: f64::NAN, ..floor() },
        Surroundings { friction: 11.0, ..floor() },
    ] {
        assert!(matches!(new(&bad), Err(StreamError::Model(_))), "{bad:?}");
    }
}

#[test]
fn compensation_keeps_a_free_relaxing_body_together() {
    let mut mesh = Mesh::new(2, &LinkConfig::preset(Preset::Paper3), 11);
    mesh.settings.relaxation = Some(Relaxation { ratio: 0.5, time: 0.4 });
    mesh.model = loose_bar(24, 0.05);
    mesh.start(0, LateInputRepair::Compensate, true);
    mesh.start(1, LateInputRepair::Compensate, true);
    mesh.run(15 * S);
    let all: Vec<&PeerSession> = mesh.peers.iter().flatten().collect();
    let tick = all.iter().map(|p| p.confirmed()).min().unwrap();
    let place = |k: usize| all[k].pose_at(BODY, tick).unwrap().position;
    let apart = (0..3).map(|k| (place(0)[k] - place(1)[k]).powi(2)).sum::<f64>().sqrt();
    println!("compensation: frames {apart:.2e} m apart, shapes {:.5}", mesh.agree(0, 1));
    assert!(apart < 1.5e-4, "{apart} m");
    assert!(mesh.agree(0, 1) < 0.004, "{}", mesh.agree(0, 1));
}

/// The paper's equations (8) and (9) for a late input: `n` ticks after it, the velocity is off by
/// `h da`, and the place by `n h^2 da` (average acceleration). They hold at every tick of the
/// history, from which later corrections begin and which checks are made of, and not at the present
/// tick alone.
#[test]
fn compensation_corrects_every_tick_of_the_history() {
    const LATE: u64 = 30;
    const LAST: u64 = 60;
    let step = PeerSessionConfig::default().step;
    for free in [false, true] {
        let config =
            PeerSessionConfig { user: UserId(2), repair: LateInputRepair::Compensate, ..Default::default() };
        let mut p = PeerSession::new(config).unwrap();
        let model = if free { loose_bar(24, 0.05) } else { bar(24, 0.05) };
        p.add_body(BODY, model, &StepSettings::default()).unwrap();
        greeted(&mut p);
        let said = |p: &mut PeerSession, tick: u64, aside: f64, sequence: u16| {
            let target = [1.0, 0.18 + aside, 0.08];
            let (body, grab, vertex, radius, hold) = (BODY, 0, 66, 0.05, GrabConfig::default());
            let held = vec![HeldAt { body, grab, vertex, radius, target, hold }];
            let ticks = vec![InputTick { tick, held, impulses: Vec::new() }];
            let inputs = Datagram::Inputs(Inputs { now: tick, ahead: None, ticks, check: None });
            p.on_datagram(25 * MS * p.tick() as u32, PeerId(1), &inputs.encode(sequence));
        };
        p.update(Duration::ZERO);
        while p.tick() < LAST {
            let next = p.tick() + 1;
            if next != LATE {
                said(&mut p, next, 0.0, next as u16);
            }
            p.update(25 * MS * next as u32 + MS);
        }
        let history = |p: &PeerSession| -> Vec<State> {
            (1..=LAST).map(|tick| p.state_at(BODY, tick).unwrap().clone()).collect()
        };
        let before = history(&p);
        said(&mut p, LATE, 0.02, LATE as u16);
        assert_eq!(p.update(25 * MS * LAST as u32 + MS), 0, "no step");
        let after = history(&p);
        let body = p.body(BODY).unwrap();
        assert_eq!(
            (&body.live().q, body.live().frame),
            (&after[LAST as usize - 1].q, after[LAST as usize - 1].frame)
        );
        // Place and velocity of each mode, and of the center of mass of a free body.
        let all = |s: &State| -> (Vec<f64>, Vec<f64>) {
            let (place, speed) = (s.frame.center(), s.frame.velocity());
            (s.q.iter().copied().chain(place).collect(), s.v.iter().copied().chain(speed).collect())
        };
        let off: Vec<(Vec<f64>, Vec<f64>)> = (before.iter().zip(&after))
            .map(|(before, after)| {
                let ((q, v), (to_q, to_v)) = (all(before), all(after));
                let minus = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a - b).collect();
                (minus(&to_q, &q), minus(&to_v, &v))
            })
            .collect();
        let of = |tick: u64| &off[tick as usize - 1];
        let largest = of(LAST).0.iter().fold(0.0f64, |m, x| m.max(x.abs()));
        assert!(largest > 1e-4, "the late input must matter: {largest}");
        let mut worst = 0.0f64;
        for tick in 1..=LAST {
            let ((place, speed), (_, last)) = (of(tick), of(LAST));
            for k in 0..place.len() {
                let (modal, n) = (k < 24, tick.saturating_sub(LATE) as f64);
                let wrong = match tick {
                    ..LATE => place[k].abs() + speed[k].abs(),
                    // At the tick itself, both are what the solver gives.
                    LATE => 0.0,
                    _ if modal => (place[k] - n * step * last[k]).abs() + step * (speed[k] - last[k]).abs(),
                    _ => {
                        (place[k] - of(LATE).0[k] - n * step * last[k]).abs()
                            + step * (speed[k] - last[k]).abs()
                    }
                };
                worst = worst.max(wrong / largest);
            }
        }
        println!("free {free}: the history is off by {worst:.1e} of the correction");
        assert!(worst < 1e-9, "{worst}");
        assert_eq!(body.restepped(), 1, "one tick is corrected");
    }
}

/// The state check of a body that agrees.
fn agreeing(p: &PeerSession, body: BodyId) -> StateCheck {
    let tick = p.confirmed();
    let value = pliant_stream::codec::checksum::checksum(tick, p.state_at(body, tick).unwrap()) as f32;
    StateCheck { body, tick, value }
}

#[test]
fn a_body_that_differs_is_noticed_beside_one_that_agrees() {
    let mut p = PeerSession::new(PeerSessionConfig { user: UserId(2), ..Default::default() }).unwrap();
    for body in [BODY, OTHER] {
        p.add_body(body, bar(4, 0.05), &StepSettings::default()).unwrap();
    }
    greeted(&mut p);
    let mut asked = false;
    for tick in 1..=40_u16 {
        p.update(25 * MS * u32::from(tick));
        let check = match tick {
            0..10 => None,
            // The first body agrees each time, and the second never does.
            _ if tick % 2 == 0 => Some(agreeing(&p, BODY)),
            _ => Some(StateCheck { value: 1e3, ..agreeing(&p, OTHER) }),
        };
        asked |= asks(&mut p, tick, tick, check);
    }
    assert!(asked, "the lowest number was asked for its state");
}

#[test]
fn a_body_that_differs_beside_one_that_agrees_is_repaired() {
    let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
    // The second body is free. What once pushed it on one machine only drives it away for ever.
    mesh.other = Some(loose_bar(8, 0.05));
    mesh.tamper = |from, to, bytes| {
        let inputs = match Datagram::decode(&bytes) {
            Ok((sequence, Datagram::Inputs(inputs))) if (from, to) == (0, 1) => Some((sequence, inputs)),
            _ => None,
        };
        let Some((sequence, mut inputs)) = inputs else { return bytes };
        for tick in inputs.ticks.iter_mut().filter(|tick| (200..208).contains(&tick.tick)) {
            let (grab, vertex, radius, hold) = (99, 66, 0.05, GrabConfig::default());
            tick.held.push(HeldAt { body: OTHER, grab, vertex, radius, target: [1.0, 0.5, 0.0], hold });
        }
        Datagram::Inputs(inputs).encode(sequence)
    };
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(6 * S);
    let (far, bent) = mesh.other_apart(0, 1);
    assert!(far > 0.05 && bent > 1e-4, "the bodies must be apart: {far} m, {bent}");
    assert_eq!(mesh.agree(0, 1), 0.0, "the first body agrees all the time");
    mesh.run(12 * S);
    let (after, after_bent) = mesh.other_apart(0, 1);
    println!("{far:.3} m apart after the fault, {after:.1e} m and {after_bent:.1e} after the repair");
    assert!(after < 1e-12 && after_bent < 1e-12, "{after} m, {after_bent}");
    assert!(mesh.agree(0, 1) < 1e-9, "{}", mesh.agree(0, 1));
    let resynced = |e: &&(usize, PeerEvent)| **e == (1, PeerEvent::Resynced { from: UserId(1) });
    assert_eq!(mesh.events.iter().filter(resynced).count(), 1, "{:?}", mesh.events);
}

#[test]
fn copies_of_one_datagram_are_one_disagreement() {
    let mut p = PeerSession::new(PeerSessionConfig { user: UserId(2), ..Default::default() }).unwrap();
    p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
    greeted(&mut p);
    for tick in 1..=20_u16 {
        p.update(25 * MS * u32::from(tick));
        let wrong = StateCheck { value: 1e3, ..agreeing(&p, BODY) };
        let check = (tick > 10).then_some(wrong);
        // From the eleventh datagram on, the network repeats that datagram.
        let asked = asks(&mut p, tick, tick.min(11), check);
        assert!(!asked, "tick {tick}");
    }
    assert_eq!(p.stats(PeerId(1)).unwrap().datagrams_in, 11);
}

/// Connects the peer with the lowest number.
fn greeted(p: &mut PeerSession) {
    p.connect(Duration::ZERO, PeerId(1), UserId(1), 1200).unwrap();
    let hello = PeerMessage::Hello {
        version: PROTOCOL_VERSION,
        user: 1,
        name: "first".into(),
        address: String::new(),
        joining: false,
        scene: p.scene(),
    };
    p.on_message(Duration::ZERO, PeerId(1), &hello.encode());
}

/// Delivers inputs of the peer with the lowest number. Returns whether `p` then requests its state.
fn asks(p: &mut PeerSession, tick: u16, sequence: u16, check: Option<StateCheck>) -> bool {
    let ticks = vec![InputTick { tick: p.tick(), ..Default::default() }];
    let datagram = Datagram::Inputs(Inputs { now: p.tick(), ahead: None, ticks, check });
    p.on_datagram(25 * MS * u32::from(tick), PeerId(1), &datagram.encode(sequence));
    let mut asked = false;
    while let Some(out) = p.poll_output() {
        asked |= out.channel == Channel::Message
            && PeerMessage::decode(&out.bytes) == Ok(PeerMessage::StateRequest);
    }
    asked
}

#[test]
fn peers_with_other_settings_are_turned_away() {
    let link = LinkConfig { delay: 20 * MS, ..Default::default() };
    let mut mesh = Mesh::new(2, &link, 3);
    mesh.start(0, LateInputRepair::Rollback, true);
    mesh.settings.stiffness_scale = 2.0;
    mesh.start(1, LateInputRepair::Rollback, true);
    mesh.run(S);
    let turned = |k: usize| {
        let away = |e: &(usize, PeerEvent)| matches!(e, (at, PeerEvent::TurnedAway { reason: DisconnectReason::SceneMismatch, .. }) if *at == k);
        mesh.events.iter().any(away)
    };
    assert!(turned(0) && turned(1), "{:?}", mesh.events);
}

#[test]
fn late_joiner_takes_the_state_of_another_and_follows() {
    let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper2), 5);
    mesh.start(0, LateInputRepair::Rollback, true);
    mesh.start(1, LateInputRepair::Rollback, true);
    mesh.run(10 * S);
    mesh.start(2, LateInputRepair::Rollback, false);
    mesh.run(20 * S);
    assert!(mesh.events.contains(&(2, PeerEvent::Started)));
    assert!(mesh.agree(0, 2) < 1e-9, "{}", mesh.agree(0, 2));
    assert!(mesh.agree(0, 1) < 1e-9);
    let late = mesh.peers[2].as_ref().unwrap();
    assert_eq!(late.body(BODY).unwrap().grabs().len(), 3, "all three hold on");
}

#[test]
fn those_who_come_before_the_first_step_get_a_state_too() {
    let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Lan), 5);
    for peer in 0..3 {
        mesh.start(peer, LateInputRepair::Rollback, peer == 0);
    }
    mesh.run(3 * S);
    let ticks: Vec<u64> = mesh.peers.iter().flatten().map(PeerSession::tick).collect();
    assert!(ticks.iter().all(|tick| tick.abs_diff(120) <= 2), "{ticks:?}");
    let confirmed: Vec<u64> = mesh.peers.iter().flatten().map(PeerSession::confirmed).collect();
    assert!(confirmed.iter().all(|tick| *tick > 110), "{confirmed:?}");
    assert_eq!(mesh.agree(0, 1), 0.0);
    assert_eq!(mesh.agree(0, 2), 0.0);
}

#[test]
fn clocks_that_differ_by_years_change_nothing_among_peers() {
    let year = Duration::from_secs(365 * 86_400);
    let go = |began: [Duration; 3]| {
        let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper1), 4);
        mesh.began = began.to_vec();
        mesh.start(0, LateInputRepair::Rollback, true);
        mesh.start(1, LateInputRepair::Rollback, true);
        mesh.run(4 * S);
        // The third peer joins late, with a clock that is decades off.
        mesh.start(2, LateInputRepair::Rollback, false);
        mesh.run(10 * S);
        assert_eq!((mesh.agree(0, 1), mesh.agree(0, 2)), (0.0, 0.0), "to the bit");
        let ticks: Vec<u64> = mesh.peers.iter().flatten().map(PeerSession::tick).collect();
        assert!(ticks.iter().max().unwrap() - ticks.iter().min().unwrap() <= 8, "{ticks:?}");
        ticks
    };
    let one_age = go([Duration::ZERO; 3]);
    for began in [[Duration::ZERO, 30 * year, 60 * year], [60 * year, Duration::ZERO, 30 * year]] {
        let ticks = go(began);
        let apart = ticks.iter().zip(&one_age).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(apart <= 2, "{ticks:?} where one clock has {one_age:?}");
    }
}

#[test]
fn a_peer_that_stalls_for_two_seconds_catches_up_within_one() {
    let mut mesh = Mesh::new(3, &LinkConfig { delay: 30 * MS, ..LinkConfig::default() }, 3);
    (0..3).for_each(|k| mesh.start(k, LateInputRepair::Rollback, true));
    mesh.run(4 * S);
    // Its process stands still, and what arrives is lost.
    let stalled = mesh.peers[1].take();
    mesh.run(6 * S);
    mesh.peers[1] = stalled;
    let behind = |mesh: &Mesh| {
        let tick = |k: usize| mesh.peers[k].as_ref().unwrap().tick();
        tick(0) - tick(1).min(tick(0))
    };
    assert!(behind(&mesh) > 70, "{}", behind(&mesh));
    mesh.run(7 * S);
    assert!(behind(&mesh) <= 8, "{} ticks behind after a second", behind(&mesh));
    mesh.run(9 * S);
    let left = mesh.events.iter().any(|(_, event)| matches!(event, PeerEvent::Left { .. }));
    assert!(!left, "nobody has left");
    let off = mesh.agree(0, 1);
    assert!(off < 1e-6, "{off}");
}

#[test]
fn a_peer_that_dies_lets_go() {
    let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper3), 9);
    for k in 0..3 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(5 * S);
    mesh.peers[2] = None;
    mesh.run(20 * S);
    let left = |e: &(usize, PeerEvent)| {
        matches!(e.1, PeerEvent::Left { user: UserId(3), reason: DisconnectReason::Silent })
    };
    assert_eq!(mesh.events.iter().filter(|e| left(e)).count(), 2);
    assert_eq!(mesh.peers[0].as_ref().unwrap().body(BODY).unwrap().grabs().len(), 2);
    assert!(mesh.agree(0, 1) < 1e-3, "{}", mesh.agree(0, 1));
}

#[test]
fn a_liar_is_not_believed_by_the_lowest_and_cannot_harm() {
    let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(5 * S);
    // Peer 2 (number 2) lies to peer 1 about its state, hundreds of times.
    let p = mesh.peers[0].as_mut().unwrap();
    for s in 0..500_u16 {
        let check = Some(StateCheck { body: BODY, tick: p.confirmed(), value: 1e6 });
        let lie = Datagram::Inputs(Inputs { now: 1, ahead: Some(500.0), ticks: Vec::new(), check });
        p.on_datagram(mesh.now, PeerId(1), &lie.encode(s));
    }
    mesh.run(8 * S);
    assert!(!mesh.events.iter().any(|e| matches!(e, (0, PeerEvent::Resynced { .. }))));
    assert_eq!(mesh.agree(0, 1), 0.0);
}

#[test]
fn a_state_that_nobody_asked_for_is_not_taken() {
    // The higher number lies to the lower, and the lower to the higher.
    for (liar, victim) in [(1, 0), (0, 1)] {
        let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
        for k in 0..2 {
            mesh.start(k, LateInputRepair::Rollback, true);
        }
        mesh.run(5 * S);
        let p = mesh.peers[victim].as_mut().unwrap();
        let body = PeerBodyState {
            body: BODY.0,
            q: vec![5.0; 40],
            v: vec![5.0; 40],
            a: vec![0.0; 40],
            z: Vec::new(),
            force: vec![0.0; 40],
            frame: None,
            pulls: Vec::new(),
            contacts: ContactState::default(),
        };
        let tick = p.confirmed();
        let lie = PeerMessage::State { tick, now: p.tick(), more: false, bodies: vec![body] }.encode();
        let before = p.body(BODY).unwrap().live().q.clone();
        for _ in 0..50 {
            p.on_message(mesh.now, PeerId(liar), &lie);
        }
        assert_eq!(p.body(BODY).unwrap().live().q, before);
        mesh.run(8 * S);
        assert!(!mesh.events.iter().any(|e| matches!(e.1, PeerEvent::Resynced { .. })), "{:?}", mesh.events);
        assert_eq!(mesh.agree(0, 1), 0.0);
    }
}

#[test]
fn the_lowest_number_is_believed_when_it_was_asked() {
    let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(5 * S);
    // Checks of the lowest number disagree. The peer requests its state, receives it, and the state
    // is the same as before.
    let p = mesh.peers[1].as_mut().unwrap();
    for s in 0..3_u16 {
        let check = Some(StateCheck { body: BODY, tick: p.confirmed(), value: 1e6 });
        let said = Datagram::Inputs(Inputs { now: p.tick(), ahead: None, ticks: Vec::new(), check });
        p.on_datagram(mesh.now, PeerId(0), &said.encode(s));
    }
    mesh.run(8 * S);
    let resynced = |e: &&(usize, PeerEvent)| e.1 == PeerEvent::Resynced { from: UserId(1) };
    assert_eq!(mesh.events.iter().filter(resynced).count(), 1, "{:?}", mesh.events);
    assert!(mesh.agree(0, 1) < 1e-9, "{}", mesh.agree(0, 1));
}

#[test]
fn ask_floods_are_answered_within_bounds() {
    let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(5 * S);
    let p = mesh.peers[0].as_mut().unwrap();
    let now = p.tick();
    let ask = Datagram::InputRequest(vec![NackRun { first: now - 100, count: 50 }; 32]);
    let answered = |p: &mut PeerSession, at: Duration| {
        for s in 0..2000_u16 {
            p.on_datagram(at, PeerId(1), &ask.encode(s));
            p.on_message(at, PeerId(1), &PeerMessage::StateRequest.encode());
        }
        let (mut ticks, mut states) = (0, 0);
        p.update(at);
        while let Some(o) = p.poll_output() {
            match (Datagram::decode(&o.bytes), PeerMessage::decode(&o.bytes)) {
                (Ok((_, Datagram::Inputs(Inputs { ticks: t, .. }))), _) if o.channel == Channel::Datagram => {
                    ticks += t.len();
                }
                (_, Ok(PeerMessage::State { .. })) if o.channel == Channel::Message => states += 1,
                _ => {}
            }
        }
        (ticks, states)
    };
    let (ticks, states) = answered(p, mesh.now);
    assert!((1000..=1005).contains(&ticks), "{ticks} ticks for 256,000 questions");
    assert_eq!(states, 1, "one state an update");
    let (ticks, _) = answered(p, mesh.now + 100 * MS);
    assert!((100..=125).contains(&ticks), "{ticks} ticks 0.1 s later: 1,000 a second");
    let states: usize = (0..200).map(|k| answered(p, mesh.now + 100 * MS + k * MS).1).sum();
    assert!((10..=16).contains(&states), "{states} states: 16 at once and two a second");
    mesh.run(8 * S);
    assert_eq!(mesh.agree(0, 1), 0.0, "who is flooded goes on");
}

#[test]
fn a_peer_under_another_number_than_the_one_it_was_given_is_turned_away() {
    // Under number 1 the peer's state would override all others.
    for claimed in [0, 1, 3, 9] {
        let config = PeerSessionConfig { user: UserId(3), ..Default::default() };
        let mut p = PeerSession::new(config).unwrap();
        p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
        p.connect(Duration::ZERO, PeerId(7), UserId(8), 1200).unwrap();
        let scene = p.scene();
        let hello = |user| PeerMessage::Hello {
            version: PROTOCOL_VERSION,
            user,
            name: "other".into(),
            address: String::new(),
            joining: false,
            scene,
        };
        p.on_message(MS, PeerId(7), &hello(claimed).encode());
        let turned = PeerEvent::TurnedAway { peer: PeerId(7), reason: DisconnectReason::Protocol };
        assert_eq!(p.poll_event(), Some(turned), "as {claimed}");
        // A second, correct hello does not help either.
        p.on_message(MS, PeerId(7), &hello(8).encode());
        assert_eq!((p.poll_event(), p.user_of(PeerId(7))), (None, None));
        p.connect(MS, PeerId(9), UserId(8), 1200).unwrap();
        p.on_message(MS, PeerId(9), &hello(8).encode());
        assert!(matches!(p.poll_event(), Some(PeerEvent::Joined { user: UserId(8), .. })));
        assert_eq!(p.user_of(PeerId(9)), Some(UserId(8)));
    }
    assert!(PeerSession::new(PeerSessionConfig { user: UserId::HOST, ..Default::default() }).is_err());
}

fn lone(user: UserId, founds: bool) -> PeerSession {
    let address = format!("address of {}", user.0);
    let mut p = PeerSession::new(PeerSessionConfig { user, founds, address, ..Default::default() }).unwrap();
    p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
    p
}

/// Delivers the messages of `from`, which `to` knows as `peer`. Returns their number.
fn tell(from: &mut PeerSession, to: &mut PeerSession, peer: PeerId) -> usize {
    let said = std::iter::from_fn(|| from.poll_output()).filter(|out| out.channel == Channel::Message);
    said.map(|out| to.on_message(100 * MS, peer, &out.bytes)).count()
}

#[test]
fn a_new_peer_is_given_its_number_and_those_who_come_before_wait_for_it() {
    let (mut first, mut new, mut early) =
        (lone(UserId(1), true), lone(UserId::HOST, false), lone(UserId(3), false));
    for k in 0..10 {
        first.update(25 * MS * k);
    }
    while first.poll_output().is_some() {}
    new.connect(Duration::ZERO, PeerId(1), None, 1200).unwrap();
    first.accept(Duration::ZERO, PeerId(2), 1200).unwrap();
    // Another peer was told of the new one before the new one has its number.
    early.connect(Duration::ZERO, PeerId(2), UserId(2), 1200).unwrap();
    new.accept(Duration::ZERO, PeerId(3), 1200).unwrap();
    assert_eq!(tell(&mut early, &mut new, PeerId(3)), 1);
    // It cannot give the new peer a number either, which has not asked it.
    let mut liar = lone(UserId::HOST, false);
    liar.accept(Duration::ZERO, PeerId(3), 1200).unwrap();
    early.disconnect(PeerId(2), DisconnectReason::Left);
    early.connect(Duration::ZERO, PeerId(2), UserId(2), 1200).unwrap();
    tell(&mut early, &mut liar, PeerId(3));
    liar.on_message(MS, PeerId(3), &PeerMessage::Welcome { user: 9, others: Vec::new() }.encode());
    let turned = PeerEvent::TurnedAway { peer: PeerId(3), reason: DisconnectReason::Protocol };
    assert_eq!(liar.poll_event(), Some(turned));

    assert_eq!(tell(&mut new, &mut first, PeerId(2)), 1, "the new peer greets only whom it asks");
    assert_eq!(first.poll_event(), Some(PeerEvent::JoinRequest { peer: PeerId(2) }));
    assert!(first.welcome(PeerId(2), UserId(1), &[]).is_err(), "the first peer's own number");
    let others = [(UserId(3), "there".to_owned())];
    first.welcome(PeerId(2), UserId(2), &others).unwrap();
    assert_eq!(first.user_of(PeerId(2)), Some(UserId(2)));
    first.update(300 * MS);
    assert_eq!(tell(&mut first, &mut new, PeerId(1)), 3, "hello, welcome and state");
    assert_eq!(new.poll_event(), Some(PeerEvent::Welcomed { user: UserId(2), others: others.to_vec() }));
    assert_eq!((new.user_of(PeerId(1)), new.user_of(PeerId(3))), (Some(UserId(1)), Some(UserId(3))));
    assert!(new.tick() > 0, "it has the state");
    // The peer that waited is answered under the new number.
    assert_eq!(tell(&mut new, &mut early, PeerId(2)), 1);
    assert_eq!(early.user_of(PeerId(2)), Some(UserId(2)));
}

#[test]
fn a_peer_that_never_says_hello_is_told_of_when_it_goes() {
    let mut p = PeerSession::new(PeerSessionConfig::default()).unwrap();
    p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
    assert!(p.connect(Duration::ZERO, PeerId(7), UserId::HOST, 1200).is_err());
    assert!(p.connect(Duration::ZERO, PeerId(7), UserId(1), 1200).is_err(), "our own");
    p.connect(Duration::ZERO, PeerId(7), UserId(2), 1200).unwrap();
    p.update(9 * S);
    assert_eq!(p.poll_event(), None);
    p.update(11 * S);
    let turned = PeerEvent::TurnedAway { peer: PeerId(7), reason: DisconnectReason::Silent };
    assert_eq!(p.poll_event(), Some(turned));
}

#[test]
fn what_nobody_fetches_does_not_grow_for_ever() {
    let mut p =
        PeerSession::new(PeerSessionConfig { idle_timeout: 100_000 * S, ..Default::default() }).unwrap();
    p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
    p.connect(Duration::ZERO, PeerId(7), UserId(2), 1200).unwrap();
    for k in 1..=20_000_u32 {
        p.update(k * 25 * MS);
    }
    assert!(p.tick() > 19_000);
    let mut count = 0;
    while p.poll_output().is_some() {
        count += 1;
    }
    assert_eq!(count, 16_384);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_read_without_panic(bytes in proptest::collection::vec(any::<u8>(), 0..600), kind in 0_u8..9) {
        let mut bytes = bytes;
        if let Some(first) = bytes.first_mut() {
            *first = kind;
        }
        let _ = Datagram::decode(&bytes);
        let _ = PeerMessage::decode(&bytes);
    }
}

#[test]
fn every_datagram_reads_back_as_it_was_written() {
    let held = vec![HeldAt {
        body: BODY,
        grab: 3,
        vertex: 9,
        radius: 0.25,
        target: [1.0, -2.0, 0.5],
        hold: GrabConfig::default(),
    }];
    let ticks = vec![
        InputTick { tick: 77, held, impulses: Vec::new() },
        InputTick { tick: 76, ..Default::default() },
    ];
    let check = Some(StateCheck { body: BODY, tick: 64, value: 0.5 });
    for d in [
        Datagram::Inputs(Inputs { now: 78, ahead: Some(-1.5), ticks: ticks.clone(), check }),
        Datagram::Inputs(Inputs { now: 78, ahead: None, ticks, check: None }),
        Datagram::InputRequest(vec![NackRun { first: 5, count: 3 }, NackRun { first: 90, count: 64 }]),
    ] {
        let bytes = d.encode(513);
        assert_eq!(Datagram::decode(&bytes).unwrap(), (513, d));
        for cut in 0..bytes.len() {
            assert!(Datagram::decode(&bytes[..cut]).is_err());
        }
    }
}

#[test]
fn peers_tell_how_their_paths_do() {
    let link = LinkConfig { loss: Loss::Random(0.1), delay: 40 * MS, ..Default::default() };
    let mut mesh = Mesh::new(2, &link, 5);
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(40 * S);
    let p = mesh.peers[0].as_mut().unwrap();
    let stats = p.stats(PeerId(1)).unwrap();
    // Some 1,600 datagrams at 10 % loss have a standard deviation of 0.75 %.
    assert!((stats.loss_in - 0.1).abs() < 0.03, "{stats:?}");
    assert!(stats.datagrams_in > 1200 && stats.datagrams_out > 1500, "{stats:?}");
    // Peers update their sessions every 5 ms, so the jitter is about that large.
    assert!(stats.jitter < 10 * MS, "{stats:?}");
    assert_eq!(stats.rejected, 0);
    let before = p.totals();
    p.on_datagram(mesh.now, PeerId(1), b"\x63nonsense");
    p.on_message(mesh.now, PeerId(1), b"\xff\xff\xff\xff");
    let after = p.totals();
    assert_eq!(p.stats(PeerId(1)), None, "who breaks the protocol is gone");
    assert_eq!(after.rejected, before.rejected + 2, "and stays counted");
    assert_eq!(after.datagrams_in, before.datagrams_in);
    assert!(
        p.begin_grab(BODY, 66, 50.0, [0.0; 3], GrabConfig::default()).is_err(),
        "a patch larger than the body"
    );
}

/// Compares a device's spring and damper on Pip between a peer session and a body.
#[test]
fn a_peers_hand_has_its_own_spring_and_damper() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal");
    let pip = Arc::new(ModalModel::read(path).unwrap());
    let (vertex, radius) = (76, f64::from(0.0216_f32));
    // A Touch device: 400 N/m and 4 N s/m.
    let hold = GrabConfig { stiffness: Some(400.0), relaxation: 0.01 }.capped();
    let mut peer = PeerSession::new(PeerSessionConfig::default()).unwrap();
    peer.add_body(BODY, pip.clone(), &StepSettings::default()).unwrap();
    let mut body = Body::new(pip.clone(), BodyConfig { step: 1.0 / 40.0, ..Default::default() }).unwrap();
    let patch = Patch::around(pip.surface(), vertex, radius).unwrap();
    let id = body.grab(&patch, hold).unwrap();
    let start = body.target(id).unwrap();
    let at = |tick: u64| {
        let way = 0.02 * (tick as f64 / 40.0).min(1.0);
        [start[0] + way, start[1] - 0.5 * way, start[2]].map(|x| f64::from(x as f32))
    };
    peer.update(Duration::ZERO);
    let grab = peer.begin_grab(BODY, vertex, radius, at(0), hold).unwrap();
    let mut largest = 0.0f64;
    for tick in 1..=120 {
        peer.set_target(grab, at(tick)).unwrap();
        assert_eq!(peer.update(25 * MS * tick as u32 + MS), 1);
        body.set_target(id, at(tick)).unwrap();
        body.step().unwrap();
        let (felt, expected) = (peer.body(BODY).unwrap().grabs()[0].reaction, body.reaction(id).unwrap());
        for (felt, expected) in felt.iter().zip(expected) {
            largest = largest.max(expected.abs());
            assert!(
                (felt - expected).abs() <= 1e-9 * largest,
                "tick {tick}: {felt} N instead of {expected} N"
            );
        }
    }
    assert!(largest > 0.05, "{largest} N");
}

/// The damper of a hand crosses: the other peer computes the same force, to the bit, and another
/// one than for a hand without a damper.
#[test]
fn a_hands_damper_is_felt_alike_by_the_other_peer() {
    let felt = |relaxation| {
        let link = LinkConfig { loss: Loss::Random(0.05), delay: 20 * MS, ..Default::default() };
        let mut mesh = Mesh::new(2, &link, 11);
        mesh.hold = GrabConfig { stiffness: Some(40.0), relaxation };
        for k in 0..2 {
            mesh.start(k, LateInputRepair::Rollback, true);
        }
        mesh.run(6 * S);
        let [a, b] = [0, 1].map(|k| mesh.peers[k].as_ref().unwrap());
        let last = a.confirmed().min(b.confirmed());
        let mut all = Vec::new();
        for tick in last - 60..=last {
            let reactions = a.reactions_at(BODY, tick).unwrap();
            assert_eq!(reactions.len(), 2);
            assert_eq!(b.reactions_at(BODY, tick).unwrap(), reactions, "tick {tick}");
            all.push(reactions[0].1);
        }
        all
    };
    let (damped, free) = (felt(0.1), felt(0.0));
    let size = |x: &[f64; 3]| x.iter().map(|x| x * x).sum::<f64>().sqrt();
    let largest = free.iter().map(size).fold(0.0, f64::max);
    let apart = damped.iter().zip(&free).map(|(a, b)| size(&std::array::from_fn(|c| a[c] - b[c])));
    let apart = apart.fold(0.0, f64::max);
    assert!(apart > 0.05 * largest, "{apart} N of {largest} N");
}
