//! Rigid bodies of the host's game, as guests see them. What they should show is known in closed
//! form.

use std::collections::VecDeque;
use std::time::Duration;

use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss, Preset};
use pliant_stream::wire::{Datagram, HostMessage, RigidPoses};
use pliant_stream::{
    Channel, DisconnectReason, GuestEvent, GuestSession, GuestSessionConfig, HostSession, HostSessionConfig,
    Newmark, PeerId, RigidId, RigidState, StreamError,
};

const STEP: f64 = 1.0 / 64.0;
const GUEST: PeerId = PeerId(1);
const GRAVITY: f64 = 9.81;

/// An elastic ball that bounces on a floor from a height (m), drifts and spins about an axis that
/// leans.
fn ball(k: u16, tick: f64) -> RigidState {
    let (t, height) = (tick * STEP + 0.37 * f64::from(k), 0.3 + 0.1 * f64::from(k % 8));
    let fall = (2.0 * height / GRAVITY).sqrt();
    // Time since the last top, within half a period before and after it.
    let since = (t + fall).rem_euclid(2.0 * fall) - fall;
    let spin = [1.0, 3.0 + f64::from(k % 4), 0.5];
    let rate = spin.iter().map(|x| x * x).sum::<f64>().sqrt();
    let (sine, cosine) = (0.5 * rate * t).sin_cos();
    let [x, y, z] = spin.map(|s| s / rate * sine);
    RigidState {
        position: [(0.5 * t).sin(), height - 0.5 * GRAVITY * since * since, 0.2 * f64::from(k)],
        rotation: [x, y, z, cosine],
        linear: [0.5 * (0.5 * t).cos(), -GRAVITY * since, 0.0],
        angular: spin,
    }
}

fn distance(a: &RigidState, b: &RigidState) -> f64 {
    (0..3).map(|k| (a.position[k] - b.position[k]).powi(2)).sum::<f64>().sqrt()
}

/// Angle between two rotations, rad.
fn angle(a: &RigidState, b: &RigidState) -> f64 {
    let dot: f64 = (0..4).map(|k| a.rotation[k] * b.rotation[k]).sum();
    2.0 * dot.abs().min(1.0).acos()
}

/// A path on which datagrams come late, twice and in another order.
fn scattered() -> LinkConfig {
    LinkConfig {
        delay: Duration::from_millis(20),
        jitter: Duration::from_millis(20),
        reorder: 0.1,
        reorder_by: Duration::from_millis(40),
        duplicate: 0.1,
        loss: Loss::Random(0.2),
        ..LinkConfig::default()
    }
}

/// A host of 64 ticks a second and a guest of 60 frames a second over an emulated network.
struct Session {
    host: HostSession,
    guest: GuestSession,
    links: [EmulatedLink<Vec<u8>>; 2],
    /// Reliable messages to the guest, and when they arrive.
    messages: VecDeque<(Duration, Vec<u8>)>,
    way: Duration,
    now: Duration,
    /// Time for which the host has stepped nothing.
    paused: Duration,
    /// Whether the network loses everything.
    silent: bool,
    tick: u64,
    frame: u64,
    /// Bytes of datagrams of rigid bodies, and of messages, that the host has sent.
    bytes: [u64; 2],
}

impl Session {
    fn new(link: &LinkConfig, way: Duration, config: HostSessionConfig) -> Self {
        let newmark = Newmark { h: STEP, ..config.newmark };
        let mut host = HostSession::new(HostSessionConfig { newmark, ..config }).unwrap();
        let mut guest = GuestSession::new(GuestSessionConfig::default(), 1200).unwrap();
        host.connect(Duration::ZERO, GUEST, 1200).unwrap();
        guest.connect(Duration::ZERO).unwrap();
        let links = [1, 2].map(|seed| EmulatedLink::new(link.clone(), seed));
        let messages = VecDeque::new();
        let (now, paused) = (Duration::ZERO, Duration::ZERO);
        Self {
            host,
            guest,
            links,
            messages,
            way,
            now,
            paused,
            tick: 0,
            frame: 0,
            silent: false,
            bytes: [0; 2],
        }
    }

    /// A session whose messages take a tenth of a second.
    fn on(preset: Preset) -> Self {
        let way = Duration::from_millis(100);
        Self::new(&LinkConfig::preset(preset), way, HostSessionConfig::default())
    }

    /// Runs for a time. Each tick publishes what `states` gives, and each frame of the guest is
    /// looked at.
    fn run(
        &mut self,
        seconds: f64,
        mut states: impl FnMut(u64) -> Vec<(RigidId, RigidState)>,
        look: impl FnMut(&GuestSession, u64),
    ) {
        self.go_on(seconds, Some(&mut states), look);
    }

    /// Runs for a time in which the host steps nothing, and its ticks stand still.
    fn pause(&mut self, seconds: f64, look: impl FnMut(&GuestSession, u64)) {
        self.go_on(seconds, None, look);
        self.paused += Duration::from_secs_f64(seconds);
    }

    fn go_on(
        &mut self,
        seconds: f64,
        mut states: Option<&mut dyn FnMut(u64) -> Vec<(RigidId, RigidState)>>,
        mut look: impl FnMut(&GuestSession, u64),
    ) {
        let end = self.now + Duration::from_secs_f64(seconds);
        while self.now < end {
            self.now += Duration::from_millis(1);
            let now = self.now;
            while let Some(bytes) = self.links[0].poll(now) {
                self.guest.on_datagram(now, &bytes);
            }
            while let Some(bytes) = self.links[1].poll(now) {
                self.host.on_datagram(now, GUEST, &bytes);
            }
            while self.messages.front().is_some_and(|(due, _)| *due <= now) {
                let (_, bytes) = self.messages.pop_front().unwrap();
                self.guest.on_message(now, &bytes);
            }
            if let Some(states) = &mut states
                && (now - self.paused).as_secs_f64() >= (self.tick + 1) as f64 * STEP
            {
                self.tick += 1;
                self.host.publish_rigids(now, self.tick, &states(self.tick)).unwrap();
            }
            self.host.update(now);
            if now.as_secs_f64() * 60.0 >= self.frame as f64 {
                self.frame += 1;
                self.guest.update(now);
                look(&self.guest, self.tick);
            }
            while let Some(out) = self.host.poll_output() {
                match out.channel {
                    Channel::Datagram => {
                        let rigids = matches!(Datagram::decode(&out.bytes), Ok((_, Datagram::Rigids(_))));
                        self.bytes[0] += if rigids { out.bytes.len() as u64 } else { 0 };
                        if !self.silent {
                            self.links[0].send(now, out.bytes.to_vec(), out.bytes.len());
                        }
                    }
                    Channel::Message => {
                        self.bytes[1] += out.bytes.len() as u64;
                        self.messages.push_back((now + self.way, out.bytes.to_vec()));
                    }
                }
            }
            while let Some(out) = self.guest.poll_output() {
                match out.channel {
                    Channel::Datagram => self.links[1].send(now, out.bytes.to_vec(), out.bytes.len()),
                    Channel::Message => self.host.on_message(now, GUEST, &out.bytes),
                }
            }
        }
    }

    fn add(&mut self, count: u16) {
        for k in 0..count {
            self.host.add_rigid(RigidId(k), &format!("ball {k}"), ball(k, self.tick as f64)).unwrap();
        }
    }
}

fn balls(count: u16, tick: u64) -> Vec<(RigidId, RigidState)> {
    (0..count).map(|k| (RigidId(k), ball(k, tick as f64))).collect()
}

/// What is off while balls are shown: position (m), rms and at worst, rotation (rad) at worst, and
/// the delay behind the host (ticks).
#[derive(Debug, Default)]
struct Off {
    count: f64,
    squares: f64,
    worst: f64,
    turn: f64,
    delay: f64,
}

impl Off {
    fn look(&mut self, guest: &GuestSession, tick: u64) {
        for rigid in guest.rigids() {
            let (shown, truth) = (rigid.visual(), ball(rigid.id().0, rigid.tick()));
            let off = distance(&shown, &truth);
            self.count += 1.0;
            self.squares += off * off;
            self.worst = self.worst.max(off);
            self.turn = self.turn.max(angle(&shown, &truth));
            self.delay += tick as f64 - rigid.tick();
        }
    }

    fn rms(&self) -> f64 {
        (self.squares / self.count).sqrt()
    }
}

#[test]
fn balls_that_bounce_are_shown_where_they_are() {
    println!("network       rms      worst    turn      delay   bytes/s of a ball");
    // Of eight balls that bounce from 0.3 to 1 m: rms and worst, m, and the delay, ticks. A lost
    // tick is led on by the velocity, which a bounce turns round: up to 2 x 4.4 m/s.
    for (name, link, rms, worst, delay) in [
        ("lan", LinkConfig::preset(Preset::Lan), 0.002, 0.04, 2.5),
        ("wifi", LinkConfig::preset(Preset::Wifi), 0.004, 0.2, 3.5),
        ("out of order", scattered(), 0.012, 0.6, 6.0),
        ("paper-1", LinkConfig::preset(Preset::Paper1), 0.004, 0.15, 9.0),
        ("paper-2", LinkConfig::preset(Preset::Paper2), 0.004, 0.15, 6.5),
    ] {
        let mut session = Session::new(&link, Duration::from_millis(100), HostSessionConfig::default());
        session.add(8);
        session.run(5.0, |tick| balls(8, tick), |_, _| {});
        let (mut off, before) = (Off::default(), session.bytes[0]);
        session.run(60.0, |tick| balls(8, tick), |guest, tick| off.look(guest, tick));
        let rate = (session.bytes[0] - before) as f64 / 60.0 / 8.0;
        println!(
            "{:<13} {:.5} m {:.4} m {:.4} rad {:.2} ticks {rate:.0}",
            name,
            off.rms(),
            off.worst,
            off.turn,
            off.delay / off.count
        );
        assert!(off.count > 8.0 * 3500.0);
        assert!(off.rms() < rms && off.worst < worst, "{name}: {off:?}");
        // Rotations of 20 bits, and no loss, since they spin evenly.
        assert!(off.turn < 1e-4 && off.delay / off.count < delay, "{name}: {off:?}");
        assert!(rate < 64.0 * 42.0 + 1.0, "{rate} bytes/s");
    }
}

/// What comes to rest is told once, and costs nothing from then on. Who joins later sees it, too.
#[test]
fn what_rests_costs_nothing_and_is_where_it_rests() {
    let mut session = Session::on(Preset::Paper1);
    session.add(3);
    // Two balls stop, one trembles by less than a tenth of a millimeter.
    let states = |tick: u64| {
        let mut all = balls(3, tick.min(200));
        for (_, state) in &mut all {
            if tick > 200 {
                (state.linear, state.angular) = ([0.0; 3], [0.0; 3]);
            }
        }
        all[2].1.position[0] += if tick.is_multiple_of(2) { 4e-5 } else { 0.0 };
        all
    };
    session.run(6.0, states, |_, _| {});
    let before = session.bytes;
    session.run(20.0, states, |_, _| {});
    assert_eq!(session.bytes, before, "nothing is sent of what rests");
    for rigid in session.guest.rigids() {
        let truth = ball(rigid.id().0, 200.0);
        assert!(rigid.is_resting(), "{rigid:?}");
        assert!(distance(&rigid.visual(), &truth) < 1e-4, "{rigid:?}");
        assert!(angle(&rigid.visual(), &truth) < 1e-6, "{rigid:?}");
    }
    // Another guest joins.
    let mut late = GuestSession::new(GuestSessionConfig::default(), 1200).unwrap();
    late.connect(session.now).unwrap();
    session.host.connect(session.now, PeerId(2), 1200).unwrap();
    while let Some(out) = late.poll_output() {
        session.host.on_message(session.now, PeerId(2), &out.bytes);
    }
    while let Some(out) = session.host.poll_output() {
        if out.peer == PeerId(2) && out.channel == Channel::Message {
            late.on_message(session.now, &out.bytes);
        }
    }
    late.update(session.now);
    let names: Vec<String> = late.rigids().map(|rigid| rigid.name().to_owned()).collect();
    assert_eq!(names, ["ball 0", "ball 1", "ball 2"]);
    for rigid in late.rigids() {
        assert!(rigid.is_resting() && distance(&rigid.visual(), &ball(rigid.id().0, 200.0)) < 1e-4);
    }
    // One is pushed: it moves again, and is shown from where it lay.
    let pushed = |tick: u64| {
        let mut all = states(tick);
        let way = 0.5 * STEP * (tick - 26 * 64).min(200) as f64;
        all[0].1.position[2] += way;
        all[0].1.linear[2] = 0.5;
        all
    };
    session.tick = session.tick.max(26 * 64);
    let mut last = session.guest.rigid(RigidId(0)).unwrap().visual().position[2];
    session.run(2.0, pushed, |guest, _| {
        let z = guest.rigid(RigidId(0)).unwrap().visual().position[2];
        assert!(z >= last - 1e-6 && z - last < 0.5 / 60.0 * 2.5, "from {last} to {z}");
        last = z;
    });
    assert!(last > 0.7, "it moves: {last}");
}

/// Of many, a part is told in each tick, all in turn, and guests see them move evenly.
#[test]
fn a_crowd_shares_its_part_of_the_rate() {
    for (count, rms) in [(24, 0.002), (48, 0.006), (96, 0.02), (192, 0.1)] {
        let mut session = Session::on(Preset::Lan);
        session.add(count);
        session.run(3.0, |tick| balls(count, tick), |_, _| {});
        let (mut off, before) = (Off::default(), session.bytes[0]);
        session.run(20.0, |tick| balls(count, tick), |guest, tick| off.look(guest, tick));
        let rate = 8.0 * (session.bytes[0] - before) as f64 / 20.0;
        println!("{count} balls: {rate:.0} bit/s, rms {:.4} m, worst {:.3} m", off.rms(), off.worst);
        // Half of the megabit that a guest gets.
        assert!(rate < 1.02 * 500_000.0, "{rate} bit/s");
        assert!(off.rms() < rms, "{count}: {}", off.rms());
    }
}

/// A jump of the host is a jump here, and no flight through all that is between: of what moves and
/// of what rests, and also where the datagram of the jump is lost.
#[test]
fn a_jump_is_shown_as_one() {
    let links = [LinkConfig::preset(Preset::Lan), LinkConfig::preset(Preset::Paper1), scattered()];
    for (link, speed) in links.iter().flat_map(|link| [(link, 0.064), (link, 0.0)]) {
        for lag in 0..16 {
            let mut session = Session::new(link, Duration::from_millis(100), HostSessionConfig::default());
            session.host.add_rigid(RigidId(5), "crate", RigidState::default()).unwrap();
            let at = |tick: u64| {
                let way = speed * STEP * tick as f64;
                let x = if tick < 200 + lag { way } else { 50.0 + way };
                let state =
                    RigidState { position: [x, 0.0, 0.0], linear: [speed, 0.0, 0.0], ..Default::default() };
                vec![(RigidId(5), state)]
            };
            let look = |guest: &GuestSession, _: u64| {
                let x = guest.rigid(RigidId(5)).map_or(0.0, |rigid| rigid.visual().position[0]);
                assert!(!(0.4..49.9).contains(&x), "{link:?} {speed} m/s: nothing is at {x}");
            };
            session.run(3.0, at, look);
            // The last ones come over a network that says nothing while it happens.
            session.silent = lag % 4 == 3;
            session.run(0.25, at, look);
            session.silent = false;
            session.run(2.75, at, look);
            let x = session.guest.rigid(RigidId(5)).unwrap().visual().position[0];
            assert!(x > 49.99 + 5.0 * speed, "{x}");
        }
    }
}

/// A host that pauses and goes on: what moves stands within a quarter of a second, and when the
/// host goes on it does so at once, from where it was at the host.
#[test]
fn a_pause_of_the_host_is_a_pause_here() {
    let states = |tick: u64| {
        let x = 0.5 * STEP * tick as f64;
        let state = RigidState { position: [x, 0.0, 0.0], linear: [0.5, 0.0, 0.0], ..Default::default() };
        vec![(RigidId(0), state)]
    };
    let x = |guest: &GuestSession| guest.rigid(RigidId(0)).unwrap().visual().position[0];
    let mut session = Session::on(Preset::Lan);
    session.add(1);
    session.run(4.0, states, |_, _| {});
    let mut last = x(&session.guest);
    session.pause(10.0, |guest, _| {
        assert!((x(guest) - last).abs() < 0.02, "from {last} to {}", x(guest));
        last = x(guest);
    });
    let (stood, mut frames, mut moves) = (last, 0, 0);
    session.run(1.0, states, |guest, _| {
        frames += 1;
        assert!((x(guest) - last).abs() < 0.05, "from {last} to {}", x(guest));
        moves += u32::from((x(guest) - last).abs() > 1e-4);
        last = x(guest);
    });
    assert!(frames > 55 && moves > frames - 10, "it moves in {moves} of {frames} frames");
    let truth = 0.5 * STEP * session.guest.rigid(RigidId(0)).unwrap().tick();
    assert!((last - truth).abs() < 2e-3 && last > stood, "{last} for {truth}");
    assert!(session.tick as f64 - session.guest.rigid(RigidId(0)).unwrap().tick() < 4.0);
}

/// What has rested for a day of ticks is seen when it moves again.
#[test]
fn what_has_rested_for_long_moves_again() {
    let mut session = Session::on(Preset::Lan);
    session.add(1);
    let rests = |_: u64| vec![(RigidId(0), RigidState::default())];
    session.run(2.0, rests, |_, _| {});
    // As many ticks and as much time pass at both.
    let ticks = 5_529_600;
    let day = Duration::from_secs(86_400);
    (session.tick, session.frame) = (session.tick + ticks, session.frame + 60 * 86_400);
    for _ in 0..19_200 {
        session.now += day / 19_200;
        session.guest.update(session.now);
        session.host.update(session.now);
        while let Some(out) = session.guest.poll_output() {
            session.host.on_datagram(session.now, GUEST, &out.bytes);
        }
        while let Some(out) = session.host.poll_output() {
            session.guest.on_datagram(session.now, &out.bytes);
        }
    }
    let from = session.tick;
    let moves = |tick: u64| {
        let x = 0.5 * STEP * (tick - from) as f64;
        let state = RigidState { position: [x, 0.0, 0.0], linear: [0.5, 0.0, 0.0], ..Default::default() };
        vec![(RigidId(0), state)]
    };
    session.run(2.0, moves, |_, _| {});
    let x = session.guest.rigid(RigidId(0)).unwrap().visual().position[0];
    assert!(x > 0.9, "{x}");
}

/// What the caller leaves out stands where it was; a number that is free is used again; a guest
/// that joins while all moves sees it; and a guest on a path that carries next to nothing sees some
/// of it.
#[test]
fn what_comes_and_goes_is_shown_so() {
    let mut session = Session::new(&scattered(), Duration::from_millis(100), HostSessionConfig::default());
    session.add(2);
    session.run(2.0, |tick| balls(2, tick), |_, _| {});
    let gone = session.tick;
    let mut before = f64::INFINITY;
    session.run(
        2.0,
        |tick| balls(1, tick),
        |guest, _| {
            let rigid = guest.rigid(RigidId(1)).unwrap();
            // What was shown wrong of its way here is corrected, and it does not go on.
            if rigid.tick() > gone as f64 + 2.0 {
                let off = distance(&rigid.visual(), &ball(1, gone as f64));
                assert!(off < before + 0.02, "it stands still, and is off by {off} after {before}");
                before = off;
            }
        },
    );
    let left_out = session.guest.rigid(RigidId(1)).unwrap();
    assert!(left_out.is_resting(), "{left_out:?}");
    assert!(distance(&left_out.visual(), &ball(1, gone as f64)) < 1e-4, "{left_out:?}");

    session.host.remove_rigid(RigidId(1));
    let far = RigidState { position: [9.0; 3], ..RigidState::default() };
    session.host.add_rigid(RigidId(1), "another", far).unwrap();
    session.run(2.0, |tick| balls(1, tick), |_, _| {});
    let another = session.guest.rigid(RigidId(1)).unwrap();
    assert_eq!((another.name(), another.visual().position), ("another", [9.0; 3]));

    let config = HostSessionConfig { guest_rate: 8000.0, ..HostSessionConfig::default() };
    let mut slow = Session::new(&LinkConfig::preset(Preset::Lan), Duration::from_millis(1), config);
    slow.add(40);
    slow.run(20.0, |tick| balls(40, tick), |_, _| {});
    let before = slow.bytes[0];
    slow.run(20.0, |tick| balls(40, tick), |_, _| {});
    let rate = 8.0 * (slow.bytes[0] - before) as f64 / 20.0;
    assert!((1.0..4200.0).contains(&rate), "{rate} bit/s");
    let moved =
        slow.guest.rigids().filter(|rigid| distance(&rigid.visual(), &ball(rigid.id().0, 0.0)) > 1e-3);
    assert!(moved.count() > 20);
}

/// What creeps does not fill the messages with its rests.
#[test]
fn what_creeps_is_told_to_rest_ever_less_often() {
    let mut session = Session::on(Preset::Lan);
    session.add(1);
    let creeps = |tick: u64| {
        let state = RigidState { position: [3e-4 * STEP * tick as f64, 0.0, 0.0], ..Default::default() };
        vec![(RigidId(0), state)]
    };
    session.run(5.0, creeps, |_, _| {});
    let before = session.bytes[1];
    session.run(60.0, creeps, |_, _| {});
    // A rest is some 110 bytes.
    let rests = (session.bytes[1] - before) as f64 / 110.0;
    assert!(rests < 15.0, "{rests} rests a minute");
}

/// Where the network is silent, what moves is led on for a quarter of a second, and comes back
/// without a jump.
#[test]
fn silence_ends_in_a_stand() {
    let mut session = Session::on(Preset::Lan);
    session.add(1);
    let states = |tick: u64| {
        let x = 0.5 * STEP * tick as f64;
        let state = RigidState { position: [x, 0.0, 0.0], linear: [0.5, 0.0, 0.0], ..Default::default() };
        vec![(RigidId(0), state)]
    };
    session.run(4.0, states, |_, _| {});
    let before = session.guest.rigid(RigidId(0)).unwrap().visual().position[0];
    let mut last = before;
    session.silent = true;
    session.run(2.0, states, |guest, _| {
        let x = guest.rigid(RigidId(0)).unwrap().visual().position[0];
        assert!(x >= last - 1e-9 && x - last < 0.02, "from {last} to {x}");
        last = x;
    });
    session.silent = false;
    assert!(last - before < 0.5 * 0.3, "led on by {}", last - before);
    let mut step: f64 = 0.0;
    session.run(2.0, states, |guest, _| {
        let x = guest.rigid(RigidId(0)).unwrap().visual().position[0];
        step = step.max((x - last).abs());
        last = x;
    });
    // A meter is made up for: at most a fifth of it in a frame.
    assert!(step < 0.25, "{step} m in a frame");
    let truth = 0.5 * STEP * session.guest.rigid(RigidId(0)).unwrap().tick();
    assert!((last - truth).abs() < 1e-3, "{last} for {truth}");
}

#[test]
fn a_host_is_told_what_it_does_wrong() {
    let mut host = HostSession::new(HostSessionConfig::default()).unwrap();
    let still = RigidState::default();
    host.add_rigid(RigidId(1), "crate", still).unwrap();
    assert!(matches!(host.add_rigid(RigidId(1), "again", still), Err(StreamError::Config { .. })));
    assert!(matches!(host.add_rigid(RigidId(2), &"x".repeat(65), still), Err(StreamError::Config { .. })));
    let nan = RigidState { position: [f64::NAN; 3], ..still };
    assert!(matches!(host.add_rigid(RigidId(2), "nan", nan), Err(StreamError::NotFinite { .. })));
    let now = Duration::from_secs(1);
    assert_eq!(
        host.publish_rigids(now, 1, &[(RigidId(9), still)]),
        Err(StreamError::UnknownRigid(RigidId(9)))
    );
    assert!(matches!(host.publish_rigids(now, 1, &[(RigidId(1), nan)]), Err(StreamError::NotFinite { .. })));
    assert!(matches!(host.publish_rigids(now, 0, &[]), Err(StreamError::TickOrder { .. })));
    host.publish_rigids(now, 1, &[(RigidId(1), still)]).unwrap();
    assert!(matches!(host.publish_rigids(now, 1, &[]), Err(StreamError::TickOrder { .. })));
    for k in 2..=1024 {
        host.add_rigid(RigidId(k), "crate", still).unwrap();
    }
    assert!(matches!(host.add_rigid(RigidId(1025), "crate", still), Err(StreamError::Full { .. })));
    host.remove_rigid(RigidId(1));
    host.remove_rigid(RigidId(1));
    assert_eq!(host.rigids().count(), 1023);
    assert_eq!(host.rigids().next(), Some((RigidId(2), false)));
}

/// A guest bears any host.
#[test]
fn a_guest_survives_what_a_host_may_send() {
    let mut session = Session::on(Preset::Lan);
    session.add(2);
    session.run(1.0, |tick| balls(2, tick), |_, _| {});
    let now = session.now;
    let far = RigidState { position: [1e9; 3], linear: [1e9; 3], angular: [1e9; 3], ..Default::default() };
    let ticks = [0, 1, 5, 60, 61, 62, 63, 64, 1_000_000, (1 << 48) - 1];
    for (sequence, tick) in ticks.into_iter().enumerate() {
        let poses = vec![(RigidId(0), far), (RigidId(0), ball(0, 3.0)), (RigidId(77), far)];
        let bytes = Datagram::Rigids(RigidPoses { tick, poses }).encode(30_000 + sequence as u16);
        session.guest.on_datagram(now, &bytes);
        let rest = HostMessage::RigidsRest { tick, rigids: vec![(1, far), (1, far), (99, far)] };
        session.guest.on_message(now, &rest.encode());
    }
    for frame in 1..200 {
        session.guest.update(now + Duration::from_millis(16 * frame));
        for rigid in session.guest.rigids() {
            let shown = rigid.visual();
            assert!(shown.position.iter().chain(&shown.rotation).all(|x| x.is_finite()), "{rigid:?}");
        }
    }
    // The same number twice breaks the protocol.
    while session.guest.poll_event().is_some() {}
    let again = HostMessage::RigidAdded { rigid: 1, name: "again".into(), tick: 5, state: far };
    session.guest.on_message(now, &again.encode());
    let mut end = None;
    while let Some(event) = session.guest.poll_event() {
        if let GuestEvent::Closed { reason } = event {
            end = Some(reason);
        }
    }
    assert_eq!(end, Some(DisconnectReason::Protocol));
}
