//! Sessions: joining, joining late, leaving, models, and bodies that are added and removed.

use crate::support;

use std::collections::BTreeSet;
use std::time::Duration;

use pliant_lab::pair::{Pair, PathConfig, World};
use pliant_modal::{Body, BodyConfig};
use pliant_stream::emulator::LinkConfig;
use pliant_stream::{
    BodyId, DisconnectReason, GuestEvent, GuestSession, GuestSessionConfig, HostEvent, HostSession,
    HostSessionConfig, PeerId, RecoveryConfig, Role, StepSettings, UserId,
};
use support::scene::{BODY, MS, S, Scene, cached, circling, paper1, start, start_with};
use support::{bar, loose_bar};

#[test]
fn model_is_sent_in_pieces_to_those_who_lack_it_only() {
    let model = bar(20, 0.05);
    let bytes = model.to_bytes().len() as u64;
    let (mut pair, mut scene) = start(&model);
    pair.join(GuestSessionConfig::default(), paper1(), 1).unwrap();
    pair.join_with(GuestSessionConfig::default(), paper1(), 2, cached(&model)).unwrap();
    pair.run_until(5 * S, &mut scene);
    for g in &pair.guests {
        assert!(g.session.body(BODY).unwrap().is_ready());
        assert_eq!(g.session.body(BODY).unwrap().model().unwrap().hash(), model.hash());
    }
    let got = |k: usize| pair.guests[k].session.stats().message_bytes_in;
    assert!(got(0) > bytes && got(0) < bytes + bytes / 10 + 20_000, "{} for a model of {bytes}", got(0));
    assert!(got(1) < 5_000, "{} without the model", got(1));
    assert!(
        scene.saw(0, |e| matches!(e, GuestEvent::ModelProgress { received, total, .. } if received == total))
    );
}

#[test]
fn late_joiner_has_the_right_picture_within_a_second() {
    let model = bar(40, 0.05);
    let (mut pair, mut scene) = start(&model);
    scene.hand = circling();
    let fast = PathConfig::symmetric(LinkConfig { delay: 50 * MS, ..Default::default() });
    pair.join_with(GuestSessionConfig::default(), fast.clone(), 1, cached(&model)).unwrap();
    pair.run_until(10 * S, &mut scene);
    pair.join_with(GuestSessionConfig::default(), fast, 2, cached(&model)).unwrap();
    pair.run_until(11 * S, &mut scene);
    let late = &pair.guests[1].session;
    assert!(late.body(BODY).unwrap().is_ready());
    let error = scene.error(late) / scene.size();
    assert!(error < 1e-3, "{error}");
}

/// Two guests strike a free body over the paper's worst network, and a third one may only watch.
/// The momentum is the sum of what was sent: each impulse acts once.
#[test]
fn impulses_of_guests_act_once_and_all_see_the_same() {
    let model = loose_bar(20, 0.05);
    let (mut pair, mut scene) = start_with(&model, HostSessionConfig { open: false, ..Default::default() });
    let mut sent = BTreeSet::new();
    scene.hand = Box::new(move |now, guest, session| {
        // From second 3 to 9, twice a second: the first two in turns, and the third one each time.
        let half = (now.as_secs_f64() * 2.0) as u64;
        let turn = guest == 2 || half % 2 == guest as u64;
        if turn && (6..18).contains(&half) && sent.insert((guest, half)) {
            let impulse = [0.5, 0.25 + 0.5 * guest as f64, -0.125];
            session.apply_impulse(now, BODY, 20 + 4 * guest as u32, impulse).unwrap();
        }
    });
    for seed in 1..=3 {
        pair.join_with(GuestSessionConfig::default(), paper1(), seed, cached(&model)).unwrap();
    }
    struct Door(Scene);
    impl World for Door {
        fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession) {
            self.0.step(now, tick, host);
        }
        fn host_event(&mut self, now: Duration, event: HostEvent, host: &mut HostSession) {
            if let HostEvent::JoinRequest { peer, .. } = &event {
                let role = if peer.0 == 3 { Role::Watch } else { Role::Hold };
                host.accept_as(now, *peer, None, role).unwrap();
            }
            self.0.host_event(now, event, host);
        }
        fn guest_event(&mut self, now: Duration, guest: usize, event: GuestEvent, s: &mut GuestSession) {
            self.0.guest_event(now, guest, event, s);
        }
        fn guest_stepped(&mut self, now: Duration, guest: usize, stepped: u64, s: &mut GuestSession) {
            self.0.guest_stepped(now, guest, stepped, s);
        }
    }
    let mut door = Door(scene);
    pair.run_until(12 * S, &mut door);
    let scene = &door.0;
    let struck = scene.host_events.iter().filter(|e| matches!(e, HostEvent::Impulse { .. })).count();
    assert_eq!(struck, 12, "six of each who may hold");
    let momentum = scene.body.frame().velocity().map(|v| v * model.mass());
    for (axis, expected) in [12.0 * 0.5, 6.0 * 0.25 + 6.0 * 0.75, -12.0 * 0.125].into_iter().enumerate() {
        assert!((momentum[axis] - expected).abs() < 1e-9, "{momentum:?}, {expected} along {axis}");
    }
    for (guest, end) in pair.guests.iter().enumerate() {
        let view = end.session.body(BODY).unwrap();
        let (_, truth) = scene.poses.iter().find(|pose| pose.0 == view.tick()).unwrap();
        let pose = view.pose().unwrap();
        let far = (0..3).map(|k| (pose.position[k] - truth.position[k]).powi(2)).sum::<f64>().sqrt();
        let error = scene.error(&end.session) / scene.size();
        println!("guest {guest}: place off by {far:.1e} m, shape by {:.3} %", 100.0 * error);
        assert!(far < 1e-3 && error < 0.01, "{guest}: {far} m, {error}");
    }
}

#[test]
fn goodbyes_and_bodies_that_go() {
    let model = bar(20, 0.05);
    let (mut pair, mut scene) = start(&model);
    scene.hand = circling();
    pair.join_with(GuestSessionConfig::default(), paper1(), 1, cached(&model)).unwrap();
    pair.run_until(3 * S, &mut scene);
    let second = BodyId(9);
    pair.host.add_body(second, "other", model.clone(), StepSettings::default()).unwrap();
    pair.run_until(4 * S, &mut scene);
    assert!(scene.saw(0, |e| matches!(e, GuestEvent::BodyAnnounced { body: BodyId(9), .. })));
    pair.host.remove_body(second);
    pair.run_until(5 * S, &mut scene);
    assert!(scene.saw(0, |e| matches!(e, GuestEvent::BodyGone { body: BodyId(9) })));
    pair.guests[0].session.leave();
    pair.run_until(6 * S, &mut scene);
    assert!(
        scene.host_events.iter().any(|e| matches!(e, HostEvent::Left { reason: DisconnectReason::Left, .. }))
    );
    assert!(scene.saw(0, |e| matches!(e, GuestEvent::Closed { reason: DisconnectReason::Left })));
    assert!(scene.grabs.is_empty(), "a guest's grabs end with it");
}

#[test]
fn a_closed_house_asks_before_it_lets_in() {
    struct Door(Scene, bool);
    impl World for Door {
        fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession) {
            self.0.step(now, tick, host);
        }
        fn host_event(&mut self, now: Duration, event: HostEvent, host: &mut HostSession) {
            if let HostEvent::JoinRequest { peer, name } = &event {
                if name == "friend" && self.1 {
                    host.accept(now, *peer).unwrap();
                } else {
                    host.refuse(*peer);
                }
            }
            self.0.host_event(now, event, host);
        }
        fn guest_event(&mut self, now: Duration, guest: usize, event: GuestEvent, s: &mut GuestSession) {
            self.0.guest_event(now, guest, event, s);
        }
    }
    let model = bar(20, 0.05);
    let mut pair = Pair::new(HostSessionConfig { open: false, ..Default::default() }).unwrap();
    pair.host.add_body(BODY, "bar", model.clone(), StepSettings::default()).unwrap();
    let mut door = Door(Scene::new(&model), true);
    for (seed, name) in [(1, "friend"), (2, "stranger")] {
        let config = GuestSessionConfig { name: name.into(), ..Default::default() };
        pair.join_with(config, paper1(), seed, cached(&model)).unwrap();
    }
    pair.run_until(3 * S, &mut door);
    assert!(pair.guests[0].session.body(BODY).unwrap().is_ready());
    assert!(door.0.saw(1, |e| matches!(e, GuestEvent::Closed { reason: DisconnectReason::Refused })));
}

#[test]
fn the_same_seed_gives_the_same_session() {
    let go = |seed| {
        let model = bar(20, 0.05);
        let (mut pair, mut scene) = start(&model);
        scene.hand = circling();
        pair.join_with(GuestSessionConfig::default(), paper1(), seed, cached(&model)).unwrap();
        pair.run_until(6 * S, &mut scene);
        let g = &pair.guests[0];
        let bits: Vec<u64> =
            g.session.body(BODY).unwrap().visual().unwrap().q.iter().map(|q| q.to_bits()).collect();
        (g.down.hash(), g.up.hash(), bits)
    };
    assert_eq!(go(1), go(1));
    assert_ne!(go(1).0, go(2).0);
}

#[test]
fn a_body_that_goes_while_its_model_is_on_the_way_harms_nobody() {
    let model = bar(40, 0.05);
    let (mut pair, mut scene) =
        start_with(&bar(6, 0.05), HostSessionConfig { model_rate: 50e3, ..Default::default() });
    scene.body = Body::new(bar(6, 0.05), BodyConfig { step: 0.025, ..Default::default() }).unwrap();
    pair.join(GuestSessionConfig::default(), paper1(), 1).unwrap();
    pair.run_until(3 * S, &mut scene);
    let second = BodyId(9);
    pair.host.add_body(second, "brief", model.clone(), StepSettings::default()).unwrap();
    pair.run_until(4 * S, &mut scene);
    pair.host.remove_body(second);
    pair.run_until(5 * S, &mut scene);
    pair.host.add_body(second, "again", model, StepSettings::default()).unwrap();
    pair.run_until(40 * S, &mut scene);
    assert!(!pair.guests[0].session.is_closed());
    assert!(pair.guests[0].session.body(second).unwrap().model().is_some(), "the model came after all");
}

#[test]
fn sessions_are_shared_between_threads_as_they_are() {
    fn shared<T: Send + Sync>() {}
    shared::<GuestSession>();
    shared::<HostSession>();
    shared::<Box<dyn pliant_stream::recovery::Recovery>>();
}

#[test]
fn guest_that_is_killed_is_let_go_with_its_grabs() {
    let model = bar(20, 0.05);
    let (mut pair, mut scene) = start(&model);
    scene.hand = circling();
    pair.join_with(GuestSessionConfig::default(), paper1(), 1, cached(&model)).unwrap();
    pair.join_with(GuestSessionConfig::default(), paper1(), 2, cached(&model)).unwrap();
    pair.run_until(5 * S, &mut scene);
    assert_eq!(scene.grabs.len(), 1);
    pair.cut(0);
    pair.run_until(16 * S, &mut scene);
    assert!(scene.grabs.is_empty());
    assert!(
        scene
            .host_events
            .iter()
            .any(|e| matches!(e, HostEvent::Left { peer: PeerId(1), reason: DisconnectReason::Silent, .. }))
    );
    assert!(scene.saw(1, |e| matches!(e, GuestEvent::UserLeft { user: UserId(1), .. })));
    assert_eq!(pair.guests[1].session.user(), Some(UserId(2)));
}

/// A host steps the first 4 of 40 modes, and its guests follow it without the others.
#[test]
fn guests_follow_a_host_that_steps_fewer_modes_than_the_model_has() {
    let model = bar(40, 0.05);
    for name in ["default", "paper"] {
        let (mut pair, mut scene) = start(&model);
        let config = BodyConfig { step: 1.0 / 40.0, modes: Some(4), ..Default::default() };
        scene.body = Body::new(model.clone(), config).unwrap();
        scene.hand = circling();
        let recovery = RecoveryConfig::by_name(name).unwrap();
        let path = PathConfig::symmetric(LinkConfig { delay: 50 * MS, ..Default::default() });
        pair.join_with(GuestSessionConfig { recovery, ..Default::default() }, path, 1, cached(&model))
            .unwrap();
        pair.run_until(8 * S, &mut scene);
        let guest = &pair.guests[0].session;
        let (error, size) = (scene.error(guest), scene.size());
        let shown = &guest.body(BODY).unwrap().visual().unwrap().q;
        let beyond = shown[4..].iter().map(|q| q * q).sum::<f64>().sqrt();
        println!("{name}: {:.3} % off, {:.3} % beyond", 100.0 * error / size, 100.0 * beyond / size);
        assert!(size > 0.01 && error < 0.01 * size, "{name}: {error} of {size}");
        assert!(beyond < 0.01 * size, "{name}: {beyond} of {size} in modes that the host has not");
    }
}
