//! Cost of a session: resting bodies, weak guests, small datagrams and low bandwidth.

use crate::support;

use std::time::Duration;

use pliant_lab::pair::PathConfig;
use pliant_stream::emulator::{LinkConfig, Loss};
use pliant_stream::{
    DisconnectReason, GuestEvent, GuestSessionConfig, HostSessionConfig, PeerId, RecoveryConfig,
};
use support::bar;
use support::scene::{BODY, MS, S, cached, circling, path_for, start, start_with};

#[test]
fn resting_body_sends_next_to_nothing_and_wakes_right() {
    for name in ["default", "paper"] {
        let model = bar(20, 0.2);
        let (mut pair, mut scene) = start(&model);
        scene.hand = circling();
        let recovery = RecoveryConfig::by_name(name).unwrap();
        pair.join_with(
            GuestSessionConfig { recovery, ..Default::default() },
            path_for(name),
            4,
            cached(&model),
        )
        .unwrap();
        pair.run_until(5 * S, &mut scene);
        scene.resting = true;
        // A sleeping body does not move.
        let mut still = scene.body.state().clone();
        still.v.fill(0.0);
        still.a.fill(0.0);
        scene.body.set_state(&still).unwrap();
        pair.run_until(7 * S, &mut scene);
        let before = pair.host.stats(PeerId(1)).unwrap();
        pair.run_until(17 * S, &mut scene);
        let after = pair.host.stats(PeerId(1)).unwrap();
        let sent = after.datagrams_out - before.datagrams_out;
        assert!(sent <= 21, "{name}: {sent} datagrams in 10 s of rest, clock answers only");
        let view = pair.guests[0].session.body(BODY).unwrap();
        assert!(view.is_resting() && !view.is_stalled());
        let shown = &view.visual().unwrap().q;
        let rest: f64 = still.q.iter().zip(shown).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert!(rest < 1e-6 * scene.size(), "{name}: {rest}");
        scene.resting = false;
        pair.run_until(20 * S, &mut scene);
        let session = &pair.guests[0].session;
        assert!(!session.body(BODY).unwrap().is_resting());
        assert!(session.body(BODY).unwrap().tick() + 20 > pair.tick());
        let error = scene.error(session) / scene.size();
        assert!(error < 0.02, "{name}: {error}");
    }
}

#[test]
fn who_fetches_a_resting_bodys_model_costs_nobody_else() {
    let model = bar(500, 0.2);
    // The rates are so low that the model is still being sent at the end.
    let slow = HostSessionConfig { model_rate: 2e4, models_rate: 2e4, ..Default::default() };
    let (mut pair, mut scene) = start_with(&model, slow);
    scene.resting = true;
    let path = PathConfig::symmetric(LinkConfig { delay: 10 * MS, ..Default::default() });
    pair.join_with(GuestSessionConfig::default(), path.clone(), 1, cached(&model)).unwrap();
    pair.run_until(2 * S, &mut scene);
    pair.join_with(GuestSessionConfig::default(), path, 2, |_| {}).unwrap();
    pair.run_until(3 * S, &mut scene);
    let before = pair.host.stats(PeerId(1)).unwrap().message_bytes_out;
    pair.run_until(13 * S, &mut scene);
    let fetched = pair.host.stats(PeerId(2)).unwrap().message_bytes_out;
    assert!(fetched > 100_000 && !pair.guests[1].session.body(BODY).unwrap().is_ready(), "{fetched} bytes");
    let sent = pair.host.stats(PeerId(1)).unwrap().message_bytes_out - before;
    // A state of 500 modes is 12 kB.
    assert_eq!(sent, 0, "bytes of messages in 10 s of rest");
}

#[test]
fn weak_guests_take_fewer_modes_and_small_paths_fewer_still() {
    let model = bar(500, 0.05);
    let (mut pair, mut scene) = start(&model);
    scene.hand = circling();
    let weak = GuestSessionConfig { modes: Some(12), ..Default::default() };
    let paper = GuestSessionConfig { recovery: RecoveryConfig::paper(), ..Default::default() };
    let path = PathConfig::symmetric(LinkConfig { delay: 10 * MS, ..Default::default() });
    let thin = PathConfig { max_datagram: 400, ..path.clone() };
    pair.join_with(weak, path.clone(), 1, cached(&model)).unwrap();
    pair.join_with(GuestSessionConfig::default(), thin.clone(), 2, cached(&model)).unwrap();
    pair.join_with(paper.clone(), path, 3, cached(&model)).unwrap();
    pair.join_with(paper, thin, 4, cached(&model)).unwrap();
    pair.run_until(4 * S, &mut scene);
    let modes = |k: usize| pair.guests[k].session.body(BODY).unwrap().visual().unwrap().modes();
    assert_eq!(modes(0), 12);
    assert_eq!(modes(1), 500, "the force stream carries any number of modes");
    assert_eq!(
        modes(2),
        500,
        "1,200 bytes, less 209 for header, four grabs and a pose, leave a byte a mode and more"
    );
    assert_eq!(modes(3), 191, "400 bytes, a byte a mode");
    for g in &pair.guests {
        let longest = g.down.counts();
        assert!(longest.sent > 50);
        assert!(g.session.body(BODY).unwrap().counts().guessed <= 2);
    }
    // The datagram size shrinks while streaming.
    pair.host.set_max_datagram(PeerId(3), 300);
    pair.run_until(6 * S, &mut scene);
    assert_eq!(pair.guests[2].session.body(BODY).unwrap().visual().unwrap().modes(), 91);
    pair.host.set_max_datagram(PeerId(3), 100);
    pair.run_until(7 * S, &mut scene);
    assert!(scene.saw(2, |e| matches!(e, GuestEvent::Closed { reason: DisconnectReason::SmallDatagrams })));
}

#[test]
fn a_path_whose_round_trip_scatters_is_not_taken_for_one_with_a_queue() {
    let model = bar(120, 0.05);
    for (seed, jitter) in [(1, 15), (2, 30), (3, 30), (4, 50), (5, 50)] {
        let loss = Loss::gilbert(0.09, 4.0, 25 * MS);
        let link = LinkConfig { delay: 40 * MS, jitter: jitter * MS, loss, ..Default::default() };
        let (mut pair, mut scene) = start(&model);
        scene.hand = circling();
        let path = PathConfig::symmetric(link);
        pair.join_with(GuestSessionConfig::default(), path, seed, cached(&model)).unwrap();
        let (mut level, mut cut) = (0, 0);
        for second in 1..=60 {
            pair.run_until(second * S, &mut scene);
            let now = pair.host.stats(PeerId(1)).unwrap().level;
            (level, cut) = (level.max(now), cut + u32::from(now > 0));
        }
        let counts = pair.guests[0].session.body(BODY).unwrap().counts();
        let guessed = counts.guessed as f64 / counts.stepped as f64;
        println!("{jitter} ms: level {level}, for {cut} of 60 s, {:.1} % guessed", 100.0 * guessed);
        assert!(level <= 1 && cut <= 6, "{jitter} ms: level {level}, for {cut} s");
    }
}

#[test]
fn a_short_queue_that_stands_is_no_scatter() {
    let model = bar(120, 0.05);
    // The path has a buffer of 150 ms, and drops what is beyond.
    let down =
        LinkConfig { delay: 20 * MS, bits_per_second: Some(55e3), queue_bytes: 1000, ..Default::default() };
    let (mut pair, mut scene) = start(&model);
    scene.hand = circling();
    let path = PathConfig {
        up: LinkConfig { bits_per_second: None, queue_bytes: usize::MAX, ..down.clone() },
        ..PathConfig::symmetric(down)
    };
    pair.join_with(GuestSessionConfig::default(), path, 5, cached(&model)).unwrap();
    let mut cut = 0;
    for second in 1..=60 {
        pair.run_until(second * S, &mut scene);
        let stats = pair.host.stats(PeerId(1)).unwrap();
        cut += u32::from(stats.level > 0);
    }
    // The host looks for more now and then.
    println!("cut for {cut} of 60 s, lost {:.3}", pair.host.stats(PeerId(1)).unwrap().loss_out);
    assert!(cut > 40, "cut for {cut} of 60 s");
}

#[test]
fn a_guest_that_may_cost_little_gets_less_of_everything_but_every_tick() {
    let model = bar(120, 0.05);
    for (rate, link) in [
        (50e3, LinkConfig { delay: 20 * MS, ..Default::default() }),
        // The path itself has low bandwidth, and the host does not know the rate. The queue shows
        // it.
        (1e6, LinkConfig { delay: 20 * MS, bits_per_second: Some(55e3), ..Default::default() }),
    ] {
        let (mut pair, mut scene) =
            start_with(&model, HostSessionConfig { guest_rate: rate, ..Default::default() });
        scene.hand = circling();
        let path = PathConfig {
            up: LinkConfig { bits_per_second: None, ..link.clone() },
            ..PathConfig::symmetric(link)
        };
        pair.join_with(GuestSessionConfig::default(), path, 5, cached(&model)).unwrap();
        pair.run_until(20 * S, &mut scene);
        let before =
            (pair.host.stats(PeerId(1)).unwrap(), pair.guests[0].session.body(BODY).unwrap().counts());
        let mut round_trips: Vec<Duration> = Vec::new();
        for second in 21..=40 {
            pair.run_until(second * S, &mut scene);
            round_trips.push(pair.host.stats(PeerId(1)).unwrap().round_trip);
        }
        let session = &pair.guests[0].session;
        let after = (pair.host.stats(PeerId(1)).unwrap(), session.body(BODY).unwrap().counts());
        let bits = 8.0 * (after.0.bytes_out - before.0.bytes_out) as f64 / 20.0;
        println!("level {}, {bits:.0} bit/s", after.0.level);
        assert!(after.0.level >= 1, "cut down");
        assert!(bits < rate.min(60e3), "{bits} bit/s");
        let frames = after.0.datagrams_out - before.0.datagrams_out;
        assert!(frames >= 800, "{frames} datagrams in 800 ticks: none is dropped");
        // Probing for more bandwidth fills the queue now and then, but the queue empties again.
        round_trips.sort_unstable();
        assert!(round_trips[10] < 90 * MS, "no queue stands: {round_trips:?}");
        let error = scene.error(session) / scene.size();
        assert!(error < 0.03, "{error}");
        assert_eq!(
            scene.guest_events.iter().filter(|e| matches!(e.1, GuestEvent::BodyReady { .. })).count(),
            1
        );
    }
}
