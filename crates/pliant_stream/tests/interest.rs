//! Bodies that a guest does not look at are not sent. A guest that reconnects gets its old number.

use crate::support;

use std::time::Duration;

use pliant_modal::ModalModel;
use pliant_stream::wire::HostMessage;
use pliant_stream::{
    BodyId, Channel, GuestEvent, GuestSession, GuestSessionConfig, HostEvent, HostSession, HostSessionConfig,
    PeerId, Placement, Role, StepSettings, TickState, UserId, UserInfo, UserLinkInfo,
};
use support::{bar, direct};

const BODY: BodyId = BodyId(9);
const TICK: Duration = Duration::from_millis(25);

/// A host and guests that receive everything at once.
struct Room {
    host: HostSession,
    guests: Vec<(PeerId, GuestSession)>,
    now: Duration,
    tick: u64,
    modes: usize,
}

impl Room {
    fn new(config: HostSessionConfig) -> Self {
        let mut host = HostSession::new(config).unwrap();
        let model = bar(8, 0.05);
        let modes = model.mode_count();
        host.add_body(BODY, "bar", model, StepSettings::default()).unwrap();
        Self { host, guests: Vec::new(), now: Duration::ZERO, tick: 0, modes }
    }

    fn join(&mut self, peer: PeerId, model: &std::sync::Arc<ModalModel>) {
        let mut guest = GuestSession::new(GuestSessionConfig::default(), 1200).unwrap();
        guest.add_cached_model(model.clone());
        self.host.connect(self.now, peer, 1200).unwrap();
        guest.connect(self.now).unwrap();
        self.guests.push((peer, guest));
    }

    fn exchange(&mut self) {
        for _ in 0..4 {
            for (peer, guest) in &mut self.guests {
                while let Some(out) = guest.poll_output() {
                    match out.channel {
                        Channel::Datagram => self.host.on_datagram(self.now, *peer, &out.bytes),
                        Channel::Message => self.host.on_message(self.now, *peer, &out.bytes),
                    }
                }
            }
            while let Some(out) = self.host.poll_output() {
                let Some((_, guest)) = self.guests.iter_mut().find(|g| g.0 == out.peer) else { continue };
                match out.channel {
                    Channel::Datagram => guest.on_datagram(self.now, &out.bytes),
                    Channel::Message => guest.on_message(self.now, &out.bytes),
                }
            }
        }
    }

    /// Publishes a tick of a body in which every mode moves.
    fn step(&mut self) {
        self.now += TICK;
        self.tick += 1;
        let t = self.tick as f64 * 0.025;
        let rate = |k: usize| 1.0 + k as f64;
        let q: Vec<f64> = (0..self.modes).map(|k| 0.1 * (rate(k) * t).sin()).collect();
        let v: Vec<f64> = (0..self.modes).map(|k| 0.1 * rate(k) * (rate(k) * t).cos()).collect();
        let a: Vec<f64> = (0..self.modes).map(|k| -0.1 * rate(k).powi(2) * (rate(k) * t).sin()).collect();
        let state = TickState {
            tick: self.tick,
            q: &q,
            v: &v,
            a: &a,
            z: &[],
            pose: None,
            grabs: &[],
            resting: false,
        };
        self.host.publish(self.now, BODY, &state).unwrap();
        self.host.update(self.now);
        self.exchange();
        for (_, guest) in &mut self.guests {
            guest.update(self.now);
        }
        self.exchange();
    }

    fn datagrams(&self, guest: usize) -> u64 {
        self.guests[guest].1.stats().datagrams_in
    }
}

#[test]
fn a_body_that_is_not_looked_at_costs_nothing_and_comes_back_whole() {
    let model = bar(8, 0.05);
    let mut room = Room::new(HostSessionConfig::default());
    let (looks, looks_away) = (PeerId(1), PeerId(2));
    room.join(looks, &model);
    room.join(looks_away, &model);
    (0..40).for_each(|_| room.step());
    assert!(room.guests.iter().all(|(_, g)| g.body(BODY).unwrap().is_ready()));

    // Away: only answers to the guest's clock requests arrive. The other guest gets every tick.
    assert!(room.host.set_interest(looks_away, BODY, Some(0)));
    let before = [room.datagrams(0), room.datagrams(1)];
    (0..80).for_each(|_| room.step());
    let (other, away) = (room.datagrams(0) - before[0], room.datagrams(1) - before[1]);
    assert!(other >= 80 && away <= 8, "{other} datagrams for who looks, {away} for who looks away");

    // Far away: three modes are enough.
    assert!(room.host.set_interest(looks_away, BODY, Some(3)));
    (0..40).for_each(|_| room.step());
    let state = |room: &Room, guest: usize| {
        let view = room.guests[guest].1.body(BODY).unwrap();
        (view.tick(), view.visual().unwrap().clone())
    };
    assert_eq!(state(&room, 1).1.modes(), 3);

    // Near again: the guest has the whole shape, as the other guest has.
    assert!(room.host.set_interest(looks_away, BODY, None));
    (0..40).for_each(|_| room.step());
    let ((tick, full), (other_tick, back)) = (state(&room, 0), state(&room, 1));
    assert_eq!((tick, full.modes()), (other_tick, back.modes()));
    let apart = full.q.iter().zip(&back.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(apart < 0.01, "0.1 is the size of each mode, they differ by {apart}");
    assert!(!room.host.set_interest(PeerId(7), BODY, None), "no such guest");
    assert!(!room.host.set_interest(looks, BodyId(1), None), "no such body");
}

#[test]
fn a_frame_is_encoded_once_for_all_who_take_the_same_and_one_more_costs_its_datagrams() {
    let model = bar(8, 0.05);
    let mut room = Room::new(HostSessionConfig::default());
    (1..=2).for_each(|peer| room.join(PeerId(peer), &model));
    (0..40).for_each(|_| room.step());
    let run = |room: &mut Room| {
        let before = (room.host.encoded(), room.host.stats(PeerId(1)).unwrap().bytes_out);
        (0..80).for_each(|_| room.step());
        (room.host.encoded() - before.0, room.host.stats(PeerId(1)).unwrap().bytes_out - before.1)
    };
    assert_eq!(run(&mut room).0, 80, "two guests, one frame a tick");
    // Thirty more guests only watch. The host encodes no additional frame, and each guest gets the
    // same bytes as the first guest.
    (3..=32).for_each(|peer| room.join(PeerId(peer), &model));
    (0..40).for_each(|_| room.step());
    let (encoded, first) = run(&mut room);
    assert_eq!(encoded, 80, "thirty-two guests, one frame a tick");
    let watcher = room.host.stats(PeerId(20)).unwrap().bytes_out;
    (0..80).for_each(|_| room.step());
    let watcher = room.host.stats(PeerId(20)).unwrap().bytes_out - watcher;
    assert!(watcher.abs_diff(first) < first / 20, "{watcher} bytes for who watches, {first} for the first");
    // A guest with fewer modes needs one more encoder.
    assert!(room.host.set_interest(PeerId(7), BODY, Some(3)));
    (0..3).for_each(|_| room.step());
    assert_eq!(run(&mut room).0, 160);
    // Ten more guests with the same number of modes need no further encoder.
    (8..18).for_each(|peer| assert!(room.host.set_interest(PeerId(peer), BODY, Some(3))));
    (0..3).for_each(|_| room.step());
    assert_eq!(run(&mut room).0, 160);
}

#[test]
fn who_comes_back_gets_the_number_they_had_if_it_is_free() {
    let model = bar(8, 0.05);
    let mut room = Room::new(HostSessionConfig { open: false, ..HostSessionConfig::default() });
    let ask = |room: &mut Room, peer: PeerId, before: Option<UserId>| {
        room.join(peer, &model);
        room.exchange();
        let asked = std::iter::from_fn(|| room.host.poll_event())
            .any(|event| matches!(event, HostEvent::JoinRequest { peer: who, .. } if who == peer));
        assert!(asked);
        room.host.accept_as(room.now, peer, before, Role::Hold).unwrap()
    };
    assert_eq!(ask(&mut room, PeerId(1), None), UserId(1));
    assert_eq!(ask(&mut room, PeerId(2), None), UserId(2));
    room.host.disconnect(PeerId(1), pliant_stream::DisconnectReason::Lost);
    assert_eq!(ask(&mut room, PeerId(3), Some(UserId(1))), UserId(1));
    // A number that is in use or belongs to the host gives another number.
    assert_eq!(ask(&mut room, PeerId(4), Some(UserId(2))), UserId(3));
    assert_eq!(ask(&mut room, PeerId(5), Some(UserId::HOST)), UserId(4));
}

#[test]
fn guests_that_want_all_kinds_of_numbers_of_modes_share_few_encoders() {
    let model = bar(8, 0.05);
    let mut room = Room::new(HostSessionConfig::default());
    let all = room.modes as u16;
    (1..=40).for_each(|peer| room.join(PeerId(peer), &model));
    (0..40).for_each(|_| room.step());
    for peer in 1..=40_u16 {
        assert!(room.host.set_interest(PeerId(u64::from(peer)), BODY, Some(1 + peer % all)));
    }
    (0..3).for_each(|_| room.step());
    let before = room.host.encoded();
    (0..40).for_each(|_| room.step());
    let kinds = (room.host.encoded() - before) / 40;
    // The host uses two encoders per doubling: 1, 2, 3, 4, 6, 8 modes and so on up to all.
    let most = 2 * u64::from(all.ilog2()) + 2;
    assert!(kinds <= most && kinds >= 3, "{kinds} encoders for {all} modes");
    // No guest gets fewer modes than it asked for.
    for (peer, guest) in &room.guests {
        let modes = guest.body(BODY).unwrap().visual().unwrap().modes() as u64;
        assert!(modes > peer.0 % u64::from(all), "{modes} modes for guest {}", peer.0);
    }
}

#[test]
fn grabs_are_begun_no_faster_than_hands_can() {
    let model = bar(8, 0.05);
    let mut room = Room::new(HostSessionConfig::default());
    room.join(PeerId(1), &model);
    (0..40).for_each(|_| room.step());
    let mut begun = 0;
    let mut refused = 0;
    // Each grab has a patch of its own. The guest sends messages as fast as the host takes them:
    // 100 a second, half of them to begin a grab, for four seconds.
    for k in 0..400_u32 {
        let now = room.now;
        let radius = 0.05 + 1e-5 * f64::from(k);
        let guest = &mut room.guests[0].1;
        for _ in 0..2 {
            let grab = guest.begin_grab(now, BODY, 20, radius, [0.0; 3], Default::default()).unwrap();
            guest.end_grab(grab);
        }
        room.now += TICK / 5;
        room.exchange();
        begun += std::iter::from_fn(|| room.host.poll_event())
            .filter(|event| matches!(event, HostEvent::GrabBegan { .. }))
            .count();
        refused += std::iter::from_fn(|| room.guests[0].1.poll_event())
            .filter(|event| matches!(event, GuestEvent::GrabRefused { .. }))
            .count();
        if room.host.users().next().is_none() {
            break;
        }
    }
    // The limit is 120 grabs at once and 60 a second, whatever the guest sends.
    assert!((120..=125 + 60 * 2).contains(&begun), "{begun} begun, {refused} refused");
}

/// Joins a guest of a host that asks, under a role, and returns its number.
fn admit(room: &mut Room, peer: PeerId, role: Role) -> UserId {
    room.join(peer, &bar(8, 0.05));
    room.exchange();
    room.host.accept_as(room.now, peer, None, role).unwrap()
}

#[test]
fn all_guests_know_who_is_there_and_in_which_role() {
    let mut room = Room::new(HostSessionConfig { open: false, ..HostSessionConfig::default() });
    room.host.set_host_user("Ada").unwrap();
    assert!(room.host.set_host_user(&"x".repeat(65)).is_err());
    let holder = admit(&mut room, PeerId(1), Role::Hold);
    let watcher = admit(&mut room, PeerId(2), Role::Watch);
    room.step();
    let roster = |room: &Room, guest: usize| -> Vec<(UserId, Role, String)> {
        room.guests[guest].1.users().map(|u| (u.user, u.role, u.name.clone())).collect()
    };
    let ada = (UserId::HOST, Role::Hold, "Ada".to_owned());
    assert_eq!(roster(&room, 0), [ada.clone(), (watcher, Role::Watch, "guest".to_owned())]);
    assert_eq!(roster(&room, 1), [ada.clone(), (holder, Role::Hold, "guest".to_owned())]);
    // The first learned of the second by an event, and the second of the first by its welcome.
    let joined = |room: &mut Room, guest: usize| -> Vec<UserInfo> {
        let events = std::iter::from_fn(|| room.guests[guest].1.poll_event());
        events.filter_map(|e| if let GuestEvent::UserJoined(info) = e { Some(info) } else { None }).collect()
    };
    let expected = UserInfo { user: watcher, role: Role::Watch, name: "guest".to_owned() };
    assert_eq!(joined(&mut room, 0), [expected]);
    assert_eq!(joined(&mut room, 1), []);
    // Links are those of users who are there, and leave with them.
    let link = |user| UserLinkInfo::new(user, Duration::from_millis(196), 0.09, 1.0);
    room.host.send_links([holder, watcher, UserId(99)].map(link).to_vec());
    room.exchange();
    let links: Vec<UserLinkInfo> = room.guests[0].1.links().copied().collect();
    assert_eq!(links, [link(watcher)]);
    assert_eq!(links[0].round_trip(), Duration::from_millis(196));
    assert!((links[0].losses()[0] - 0.09).abs() < 0.002 && links[0].losses()[1] == 1.0);
    room.host.disconnect(PeerId(2), pliant_stream::DisconnectReason::Left);
    room.exchange();
    assert_eq!(roster(&room, 0), [ada]);
    assert_eq!(room.guests[0].1.links().count(), 0);
}

#[test]
fn who_may_only_watch_holds_and_strikes_nothing() {
    let mut room = Room::new(HostSessionConfig { open: false, ..HostSessionConfig::default() });
    admit(&mut room, PeerId(1), Role::Watch);
    admit(&mut room, PeerId(2), Role::Hold);
    (0..40).for_each(|_| room.step());
    while room.host.poll_event().is_some() {}
    for guest in 0..2 {
        let now = room.now;
        let guest = &mut room.guests[guest].1;
        while guest.poll_event().is_some() {}
        guest.begin_grab(now, BODY, 20, 0.05, [0.0; 3], Default::default()).unwrap();
        guest.apply_impulse(now, BODY, 20, [0.0, 0.5, 0.0]).unwrap();
    }
    room.exchange();
    let (mut begun, mut struck) = (Vec::new(), Vec::new());
    while let Some(event) = room.host.poll_event() {
        match event {
            HostEvent::GrabBegan { key, .. } => begun.push(key.user),
            HostEvent::Impulse { user, .. } => struck.push(user),
            _ => {}
        }
    }
    assert_eq!((begun, struck), (vec![UserId(2)], vec![UserId(2)]));
    let refused = std::iter::from_fn(|| room.guests[0].1.poll_event())
        .any(|event| matches!(event, GuestEvent::GrabRefused { .. }));
    assert!(refused, "the watcher is told");
}

#[test]
fn a_placement_reaches_those_who_are_there_and_those_who_come() {
    let model = bar(8, 0.05);
    let mut room = Room::new(HostSessionConfig::default());
    room.join(PeerId(1), &model);
    (0..4).for_each(|_| room.step());
    let placement = |room: &Room, guest: usize| room.guests[guest].1.body(BODY).unwrap().placement();
    assert_eq!(placement(&room, 0), None);
    let there = Placement { position: [1.0, 2.0, -3.0], scale: 0.5, ..Placement::default() };
    room.host.set_placement(BODY, there).unwrap();
    room.join(PeerId(2), &model);
    (0..4).for_each(|_| room.step());
    assert_eq!([0, 1].map(|guest| placement(&room, guest)), [Some(there); 2]);
    let notices = |room: &mut Room| {
        std::iter::from_fn(|| room.guests[0].1.poll_event())
            .filter(|event| matches!(event, GuestEvent::BodyPlaced { .. }))
            .count()
    };
    assert_eq!(notices(&mut room), 1);
    // The same again is not sent, and what places nothing is refused.
    room.host.set_placement(BODY, there).unwrap();
    for wrong in [
        Placement { position: [f32::NAN, 0.0, 0.0], ..there },
        Placement { position: [1e7, 0.0, 0.0], ..there },
        Placement { orientation: [0.0; 4], ..there },
        Placement { scale: 0.0, ..there },
        Placement { scale: f32::INFINITY, ..there },
    ] {
        assert!(room.host.set_placement(BODY, wrong).is_err(), "{wrong:?}");
        let message = HostMessage::BodyPlaced { body: BODY.0, placement: wrong };
        assert!(HostMessage::decode(&message.encode()).is_err(), "{wrong:?}");
    }
    room.exchange();
    assert_eq!((notices(&mut room), placement(&room, 0)), (0, Some(there)));
}

#[test]
fn a_guest_says_how_much_of_a_body_it_wants() {
    let model = bar(8, 0.05);
    let mut room = Room::new(HostSessionConfig::default());
    room.join(PeerId(1), &model);
    (0..40).for_each(|_| room.step());
    let shown = |room: &Room| room.guests[0].1.body(BODY).unwrap().visual().unwrap().modes();
    let all = shown(&room);
    assert!(!room.guests[0].1.set_interest(BodyId(77), Some(2)), "there is no such body");
    assert!(room.guests[0].1.set_interest(BODY, Some(2)));
    (0..8).for_each(|_| room.step());
    assert_eq!(shown(&room), 2);
    // Nothing at all, and then everything again.
    room.guests[0].1.set_interest(BODY, Some(0));
    (0..8).for_each(|_| room.step());
    let before = room.datagrams(0);
    (0..8).for_each(|_| room.step());
    assert!(room.datagrams(0) <= before + 1, "only answers about the clock");
    room.guests[0].1.set_interest(BODY, None);
    (0..8).for_each(|_| room.step());
    assert_eq!(shown(&room), all);
    // The same interest is sent once. A flood of changes is bounded and costs the guest nothing
    // else.
    let sent = |room: &Room| room.guests[0].1.stats().message_bytes_out;
    let bytes = sent(&room);
    room.guests[0].1.set_interest(BODY, None);
    assert_eq!(sent(&room), bytes);
    for change in 0..5000_u16 {
        room.guests[0].1.set_interest(BODY, Some(1 + change % 2));
    }
    room.exchange();
    assert_eq!(room.host.users().count(), 1, "it is still in the session");
    let rejected = room.host.stats(PeerId(1)).unwrap().rejected;
    assert_eq!(rejected, 0);
}

/// The message that a body rests may be read before the frames of the ticks before it.
#[test]
fn frames_from_before_a_rest_wake_nobody() {
    let (mut host, mut guest, mut now) = direct::session("default");
    let zero = vec![0.0; 12];
    let q: Vec<f64> = (0..12).map(|k| 0.01 * f64::from(k).cos()).collect();
    for (tick, resting) in [(60, false), (61, true)] {
        now += TICK;
        let state = TickState { tick, q: &q, v: &zero, a: &zero, z: &[], pose: None, grabs: &[], resting };
        host.publish(now, direct::BODY, &state).unwrap();
        host.update(now);
    }
    let outputs: Vec<_> = std::iter::from_fn(|| host.poll_output()).collect();
    for output in outputs.iter().filter(|output| output.channel == Channel::Message) {
        guest.on_message(now, &output.bytes);
    }
    assert!(guest.body(direct::BODY).unwrap().is_resting());
    for output in outputs.iter().filter(|output| output.channel == Channel::Datagram) {
        guest.on_datagram(now, &output.bytes);
    }
    for _ in 0..200 {
        assert!(guest.body(direct::BODY).unwrap().is_resting(), "a frame has waked the body at {now:?}");
        now += TICK;
        direct::exchange(&mut host, &mut guest, now);
        while let Some(event) = guest.poll_event() {
            assert!(!matches!(event, GuestEvent::Stalled { .. }), "{event:?}");
        }
    }
    let shown = guest.body(direct::BODY).unwrap().visual().unwrap().q.clone();
    assert!(shown.iter().zip(&q).all(|(shown, q)| (shown - q).abs() < 1e-6), "{shown:?} {q:?}");

    // It wakes with the first frame after.
    let v = vec![0.01; 12];
    for tick in 262..270 {
        now += TICK;
        let state =
            TickState { tick, q: &q, v: &v, a: &zero, z: &[], pose: None, grabs: &[], resting: false };
        host.publish(now, direct::BODY, &state).unwrap();
        direct::exchange(&mut host, &mut guest, now);
    }
    assert!(!guest.body(direct::BODY).unwrap().is_resting());
}
