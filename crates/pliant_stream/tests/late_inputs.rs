//! A peer whose inputs come as late as can be, with new patches in each, costs the others a bounded
//! amount of work, and all agree soon after. The work is counted, since times depend on the
//! machine.

use crate::support;

use std::time::{Duration, Instant};

use pliant_modal::FixedObstacle;
use pliant_stream::peer::{PeerEvent, PeerSession};
use pliant_stream::wire::{Datagram, HeldAt, ImpulseAt, InputTick, Inputs, PROTOCOL_VERSION, PeerMessage};
use pliant_stream::{Channel, DisconnectReason, PeerId, Surroundings, UserId};
use support::direct::{BODY, peers, peers_of};
use support::loose_bar;

/// How late the inputs come, ticks: one less than is remembered, and as late as can be afforded.
const LATE: [u64; 2] = [127, 15];
const TICK: Duration = Duration::from_millis(25);

/// The input of the third peer at a tick: sixteen hands, whose patches nobody has had before.
fn sixteen(tick: u64) -> InputTick {
    let hand = |k: u16| HeldAt {
        body: BODY,
        grab: k,
        vertex: 4 + 3 * u32::from(k),
        radius: f64::from((0.3 + 1e-5 * (16 * (tick % 4096) + u64::from(k)) as f64) as f32),
        target: [1.0, 0.05, 0.0],
        hold: Default::default(),
    };
    InputTick { tick, held: (0..16).map(hand).collect(), impulses: Vec::new() }
}

fn impulses(tick: u64, count: u32) -> InputTick {
    let impulse = |k: u32| ImpulseAt { body: BODY, vertex: 4 + 3 * k, impulse: [0.0, 1e-3, 0.0] };
    InputTick { tick, held: Vec::new(), impulses: (0..count).map(impulse).collect() }
}

/// What the first peer has done in the attack, by update.
struct Cost {
    restepped: Vec<u64>,
    patches: Vec<u64>,
    times: Vec<Duration>,
}

/// When the peers begin.
const BEGIN: Duration = Duration::from_millis(1);

/// Ten seconds of the attack on the first of three peers, and ten seconds after it. `input` is what
/// the third peer does at a tick.
fn attack(late: u64, mut all: Vec<PeerSession>, input: fn(u64) -> InputTick) -> (Vec<PeerSession>, Cost) {
    let mut now = BEGIN;
    let mut cost = Cost { restepped: Vec::new(), patches: Vec::new(), times: Vec::new() };
    let counts = |peer: &PeerSession| {
        let body = peer.body(BODY).unwrap();
        (body.restepped(), body.patches_made())
    };
    for round in 0..1000_u64 {
        now += TICK;
        let attacks = (200..600).contains(&round);
        for from in 0..3 {
            let before = counts(&all[from]);
            let began = Instant::now();
            all[from].update(now);
            if attacks && from == 0 {
                let after = counts(&all[from]);
                cost.times.push(began.elapsed());
                cost.restepped.push(after.0 - before.0);
                cost.patches.push(after.1 - before.1);
            }
            while let Some(o) = all[from].poll_output() {
                let to = o.peer.0 as usize;
                // The third peer keeps its own inputs from the first one during the attack.
                match o.channel {
                    Channel::Datagram if attacks && from == 2 && to == 0 => {}
                    Channel::Datagram => all[to].on_datagram(now, PeerId(from as u64), &o.bytes),
                    Channel::Message => all[to].on_message(now, PeerId(from as u64), &o.bytes),
                }
            }
        }
        let tick = all[0].tick();
        if attacks && tick > 200 + late {
            // One input for each tick, so that each update goes back as far as it can.
            let inputs = Inputs { now: tick, ahead: None, ticks: vec![input(tick + 1 - late)], check: None };
            let datagram = Datagram::Inputs(inputs).encode((round + 30_000) as u16);
            all[0].on_datagram(now, PeerId(2), &datagram);
        }
    }
    (all, cost)
}

#[test]
fn inputs_as_late_as_can_be_with_new_patches_cost_a_bounded_amount_and_then_all_agree() {
    for late in LATE {
        let (all, cost) = attack(late, peers(BEGIN), sixteen);
        let sum = |counts: &[u64]| counts.iter().sum::<u64>();
        let (steps, patches) = (sum(&cost.restepped), sum(&cost.patches));
        println!(
            "{late} ticks late, {} updates: {steps} ticks stepped again ({} at most at once), {patches} patches made",
            cost.times.len(),
            cost.restepped.iter().max().unwrap()
        );
        let confirmed = all.iter().map(PeerSession::confirmed).min().unwrap();
        assert!(confirmed + 10 > all[0].tick(), "{confirmed} of {}", all[0].tick());
        let of = |k: usize| &all[k].state_at(BODY, confirmed).unwrap().q;
        for k in [1, 2] {
            let off: f64 = of(0).iter().zip(of(k)).map(|(a, b)| (a - b).abs()).sum();
            assert!(off < 1e-6, "peer {}: {off}", k + 1);
        }
        // Besides a first burst, as many as an ordinary late peer costs.
        assert!(steps <= 127 + 12 * cost.times.len() as u64, "{steps} ticks stepped again");
        assert!(*cost.restepped.iter().max().unwrap() <= 17, "{:?}", cost.restepped);
        assert!(patches <= 120 + 60 * 10, "{patches} patches");
    }
}

#[test]
fn late_impulses_are_paid_for_as_late_hands_are_and_contacts_besides() {
    let ground = FixedObstacle { position: [0.0, -0.12, 0.0], ..FixedObstacle::GROUND };
    let floor = Surroundings { obstacles: vec![ground], ..Surroundings::default() };
    // A single impulse may come as late as can be, unless the body has contacts.
    let among = || peers_of(BEGIN, &loose_bar(12, 0.05), &floor);
    let apart = || peers_of(BEGIN, &loose_bar(12, 0.05), &Surroundings::default());
    let eight = |tick| impulses(tick, 8);
    let one = |tick| impulses(tick, 1);
    let none = |tick| impulses(tick, 0);
    for (what, late, all, input, most) in [
        ("eight impulses", 127, peers(BEGIN), eight as fn(u64) -> InputTick, 17),
        ("eight impulses", 15, peers(BEGIN), eight, 17),
        ("one impulse", 127, apart(), one, 127),
        ("one impulse with contacts", 127, among(), one, 17),
        ("nothing, and a body has contacts", 127, among(), none, 17),
    ] {
        let (all, cost) = attack(late, all, input);
        let largest = *cost.restepped.iter().max().unwrap();
        println!("{what}, {late} ticks late: {largest} ticks stepped again at most at once");
        let confirmed = all.iter().map(PeerSession::confirmed).min().unwrap();
        let of = |k: usize| &all[k].state_at(BODY, confirmed).unwrap().q;
        for k in [1, 2] {
            let off: f64 = of(0).iter().zip(of(k)).map(|(a, b)| (a - b).abs()).sum();
            assert!(off < 1e-6, "{what}: peer {}: {off}", k + 1);
        }
        assert!(largest <= most, "{what}: {:?}", cost.restepped);
        assert!(most < 127 || largest > 100, "{what}: what can be afforded is taken");
    }
}

/// Ten seconds in which a fourth peer comes to the first of three in each tick and leaves in the
/// next one. Returns the ticks that were stepped again, the patches that were made, and the states
/// that were sent to the fourth peer.
fn comes_and_goes(then: impl Fn(&mut PeerSession, Duration, PeerId, u64)) -> [u64; 3] {
    let mut all = peers(BEGIN);
    let (mut now, mut states) = (BEGIN, 0);
    let mut before = [0; 2];
    for round in 0..600_u64 {
        now += TICK;
        if round >= 200 {
            all[0].disconnect(PeerId(round - 1), DisconnectReason::Left);
            let (peer, scene) = (PeerId(round), all[0].scene());
            all[0].accept(now, peer, 1200).unwrap();
            let hello = PeerMessage::Hello {
                version: PROTOCOL_VERSION,
                user: 4,
                name: "fourth".into(),
                address: String::new(),
                joining: false,
                scene,
            };
            all[0].on_message(now, peer, &hello.encode());
            assert_eq!(all[0].user_of(peer), Some(UserId(4)));
            then(&mut all[0], now, peer, round);
        } else {
            let body = all[0].body(BODY).unwrap();
            before = [body.restepped(), body.patches_made()];
        }
        for from in 0..3 {
            all[from].update(now);
            while let Some(o) = all[from].poll_output() {
                let sender = PeerId(from as u64);
                match (all.get_mut(o.peer.0 as usize), o.channel) {
                    (Some(to), Channel::Datagram) => to.on_datagram(now, sender, &o.bytes),
                    (Some(to), Channel::Message) => to.on_message(now, sender, &o.bytes),
                    (None, Channel::Datagram) => {}
                    (None, Channel::Message) => {
                        let message = PeerMessage::decode(&o.bytes);
                        states += u64::from(matches!(message, Ok(PeerMessage::State { .. })));
                    }
                }
            }
        }
    }
    let body = all[0].body(BODY).unwrap();
    [body.restepped() - before[0], body.patches_made() - before[1], states]
}

#[test]
fn a_peer_that_comes_and_goes_and_does_nothing_makes_nobody_step_again() {
    let [steps, ..] = comes_and_goes(|_, _, _, _| {});
    println!("{steps} ticks stepped again in ten seconds, which are 400 ticks");
    // Inputs of the peers that stay come up to one tick late.
    assert!(steps <= 400, "{steps} ticks stepped again");
}

#[test]
fn a_peer_that_comes_and_goes_has_the_budgets_of_one_that_stays() {
    let [steps, patches, states] = comes_and_goes(|first, now, peer, round| {
        let inputs =
            Inputs { now: first.tick(), ahead: None, ticks: vec![sixteen(first.tick() + 1)], check: None };
        first.on_datagram(now, peer, &Datagram::Inputs(inputs).encode(round as u16));
        first.on_message(now, peer, &PeerMessage::StateRequest.encode());
    });
    println!("{steps} ticks stepped again, {patches} patches made and {states} states sent in ten seconds");
    assert!(patches <= 120 + 60 * 10, "{patches} patches");
    assert!(states <= 16 + 2 * 10, "{states} states");
}

#[test]
fn who_leaves_with_many_hands_after_a_silence_makes_nobody_step_many_ticks_again() {
    let mut all = peers(BEGIN);
    for vertex in 0..15 {
        all[2].begin_grab(BODY, 20 + vertex, 0.05, [1.0, 0.1, 0.0], Default::default()).unwrap();
    }
    let (mut now, mut most, mut repaired) = (BEGIN, 0, None);
    for round in 0..600_u64 {
        now += TICK;
        if round == 260 {
            for rest in &mut all[..2] {
                rest.disconnect(PeerId(2), DisconnectReason::Left);
            }
        }
        for from in 0..if round < 260 { 3 } else { 2 } {
            let before = all[from].body(BODY).unwrap().restepped();
            all[from].update(now);
            most = most.max(all[from].body(BODY).unwrap().restepped() - before);
            while let Some(event) = all[from].poll_event() {
                if round >= 260 && matches!(event, PeerEvent::Resynced { .. }) {
                    repaired.get_or_insert((from, round - 260));
                }
            }
            while let Some(o) = all[from].poll_output() {
                let to = o.peer.0 as usize;
                match o.channel {
                    Channel::Datagram if from == 2 && round >= 200 => {}
                    Channel::Datagram => all[to].on_datagram(now, PeerId(from as u64), &o.bytes),
                    Channel::Message => all[to].on_message(now, PeerId(from as u64), &o.bytes),
                }
            }
        }
    }
    println!("{most} ticks stepped again at most in an update");
    // The peer with the lower number is right, so the other one takes its state.
    assert!(repaired.is_some_and(|(peer, after)| peer == 1 && after < 5), "{repaired:?}");
    let confirmed = all[0].confirmed().min(all[1].confirmed());
    assert!(confirmed + 10 > all[0].tick(), "{confirmed} of {}", all[0].tick());
    let of = |k: usize| &all[k].state_at(BODY, confirmed).unwrap().q;
    let off: f64 = of(0).iter().zip(of(1)).map(|(a, b)| (a - b).abs()).sum();
    assert!(off < 1e-6, "those who stay agree: {off}");
    assert!(most <= 17, "{most} ticks stepped again in an update");
}

/// The time of an update. Run by hand, on a quiet machine and with `--release`.
#[test]
#[ignore = "measures times"]
fn time_of_an_update_while_inputs_come_as_late_as_can_be() {
    for late in LATE {
        let (_, mut cost) = attack(late, peers(BEGIN), sixteen);
        cost.times.sort();
        let at = |share: f64| cost.times[(share * (cost.times.len() - 1) as f64) as usize];
        println!("{late} ticks late: median {:?}, p99 {:?}, longest {:?}", at(0.5), at(0.99), at(1.0));
        assert!(at(0.99) < Duration::from_millis(2), "p99 {:?}", at(0.99));
    }
}
