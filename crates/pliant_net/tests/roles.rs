//! Tests of roles, subscriptions and recordings.

use crate::support;

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime};

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabForce, GrabOf, ModalAsset, ModalBody, VisualState};
use pliant_net::{
    Access, GrabRefused, Grant, GuestState, HandOf, Holding, HostConfig, HostOptions, Interest, Invite,
    JoinConfig, NetGuest, NetPlugin, NetStats, RemoteHands, Role, SessionClosed, SessionRecording,
    SharedBody, Token, User, UserLink,
};
use pliant_stream::DisconnectReason;
use support::{
    Came, TIP, alone, app, arrival, bar, body_of, guest, host, messages, must, only, rests, run_until, tick,
    window,
};

fn cached() -> JoinConfig {
    JoinConfig { models: vec![bar()], ..JoinConfig::default() }
}

fn roles(app: &mut App) -> BTreeMap<u16, Role> {
    let mut users = app.world_mut().query::<&User>();
    users.iter(app.world()).map(|user| (user.id.0, user.role)).collect()
}

#[test]
fn a_watcher_sees_and_does_not_hold_and_all_know_who_is_who() {
    let _alone = alone();
    let [held, watched, spent] = [(); 3].map(|()| Token::generate().unwrap());
    let access = Access::Tokens(vec![
        Grant::hold(held),
        Grant::watch(watched),
        Grant::hold(spent).until(SystemTime::now() - Duration::from_secs(1)),
    ]);
    let transport = HostOptions { access, ..HostOptions::default() };
    let (mut host, invite, _) = host(HostConfig { transport, ..HostConfig::default() });
    let mut holder = guest(&invite, JoinConfig { name: "holder".into(), ..cached() });
    let watching = Invite { token: Some(watched), ..invite.clone() };
    let mut watcher = guest(&watching, JoinConfig { name: "watcher".into(), ..cached() });
    let mut late = guest(&Invite { token: Some(spent), ..invite.clone() }, cached());
    run_until(&mut [&mut host, &mut holder, &mut watcher, &mut late], "two are in, one is not", |apps| {
        body_of(apps[1]).is_some()
            && body_of(apps[2]).is_some()
            && matches!(
                apps[3].world().resource::<NetGuest>().state(),
                GuestState::Closed { reason: DisconnectReason::ExpiredToken }
            )
    });
    assert_eq!(watcher.world().resource::<NetGuest>().role(), Role::Watch);
    let (there, body) = (body_of(&mut watcher).unwrap(), body_of(&mut holder).unwrap());
    let refused = watcher.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::Y), GrabOf(there))).id();
    holder.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.5, 0.4)), GrabOf(body)));
    run_until(&mut [&mut host, &mut holder, &mut watcher], "one holds, the other is refused", |apps| {
        only::<HandOf>(apps[0]).is_some()
            && messages::<GrabRefused>(apps[2]) == [GrabRefused { entity: refused }]
    });
    run_until(
        &mut [&mut host, &mut holder, &mut watcher],
        "the watcher sees the hand, and how all are reached",
        |apps| {
            let seen = apps[2].world().get::<RemoteHands>(there).is_some_and(|hands| hands.0.len() == 1);
            let mut links = apps[2].world_mut().query::<(&User, &UserLink)>();
            let holder = links.iter(apps[2].world()).find(|(user, _)| user.name == "holder");
            seen && holder.is_some_and(|(_, link)| !link.round_trip.is_zero())
        },
    );
    run_until(&mut [&mut host, &mut holder, &mut watcher], "all know the same", |apps| {
        let of_apps: Vec<BTreeMap<u16, Role>> = apps.iter_mut().map(|app| roles(app)).collect();
        must!(of_apps[0].values().filter(|role| **role == Role::Watch).count() == 1, "{of_apps:?}");
        must!(of_apps[1] == of_apps[0] && of_apps[2] == of_apps[0], "{of_apps:?}");
        Ok(())
    });
}

#[test]
fn a_body_may_be_the_hosts_alone() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    host.world_mut().entity_mut(body).insert(Holding::HostOnly);
    let mut guest = guest(&invite, cached());
    let there = arrival(&mut host, &mut guest);
    let grab = guest.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::Y), GrabOf(there))).id();
    run_until(&mut [&mut host, &mut guest], "the grab is refused", |apps| {
        messages::<GrabRefused>(apps[1]) == [GrabRefused { entity: grab }]
    });
    assert!(only::<HandOf>(&mut host).is_none());
}

#[test]
fn a_host_takes_a_guests_hand_off_and_the_guest_knows() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    let mut guest = guest(&invite, cached());
    let there = arrival(&mut host, &mut guest);
    let hold = (Grab::new(TIP, 0.3, DVec3::new(1.2, 2.5, 0.4)), GrabOf(there));
    let grab = guest.world_mut().spawn(hold).id();
    run_until(&mut [&mut host, &mut guest], "held", |apps| only::<HandOf>(apps[0]).is_some());
    let hand = only::<HandOf>(&mut host).unwrap();
    host.world_mut().despawn(hand);
    run_until(&mut [&mut host, &mut guest], "the guest is told", |apps| {
        messages::<GrabRefused>(apps[1]) == [GrabRefused { entity: grab }]
    });
    // Targets that the guest still sends have no effect, and another hand of the guest may hold the
    // body.
    guest.world_mut().get_mut::<Grab>(grab).unwrap().target.y += 0.1;
    let datagrams = |host: &App| host.world().resource::<NetStats>().datagrams_in;
    let before = datagrams(&host);
    run_until(&mut [&mut host, &mut guest], "more of the guest is heard", |apps| {
        assert!(only::<HandOf>(apps[0]).is_none());
        datagrams(apps[0]) > before + 5
    });
    guest.world_mut().despawn(grab);
    guest.world_mut().spawn(hold);
    run_until(&mut [&mut host, &mut guest], "held again", |apps| only::<HandOf>(apps[0]).is_some());
}

#[test]
fn what_is_not_wanted_is_not_sent() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let mut guest = guest(&invite, cached());
    let there = arrival(&mut host, &mut guest);
    host.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.5, 0.4)), GrabOf(body)));
    let sway = |time: Res<Time>, mut grab: Single<&mut Grab>| {
        grab.target = DVec3::new(1.2, 2.5 + 0.2 * (3.0 * time.elapsed_secs_f64()).sin(), 0.4);
    };
    host.add_systems(FixedUpdate, sway);
    run_until(&mut [&mut host, &mut guest], "all ticks come", window(Came::ticks_come));
    *guest.world_mut().get_mut::<Interest>(there).unwrap() = Interest::Nothing;
    run_until(&mut [&mut host, &mut guest], "nothing but the clock's answers", window(Came::only_the_clock));
    // Half of the four modes are subscribed. Their shape is displayed, and the other modes are at
    // rest.
    *guest.world_mut().get_mut::<Interest>(there).unwrap() = Interest::Modes(2);
    run_until(&mut [&mut host, &mut guest], "half of the modes", |apps| {
        let truth = apps[0].world().get::<BodyState>(body).unwrap().body().q();
        let shown = apps[1].world().get::<VisualState>(there).unwrap().q();
        let size = truth.iter().fold(0.0_f64, |size, q| size.max(q.abs()));
        must!(shown[2..] == [0.0, 0.0] && size > 0.05, "{shown:?} for {truth:?}");
        must!((0..2).all(|k| (truth[k] - shown[k]).abs() < 0.25 * size), "{shown:?} for {truth:?}");
        Ok(())
    });
    *guest.world_mut().get_mut::<Interest>(there).unwrap() = Interest::All;
    run_until(&mut [&mut host, &mut guest], "all modes again", |apps| {
        let shown = apps[1].world().get::<VisualState>(there).unwrap().q();
        must!(shown[2].abs() + shown[3].abs() > 0.0, "{shown:?}");
        Ok(())
    });
}

#[test]
fn a_recorded_session_is_seen_again_as_it_was() {
    let _alone = alone();
    let path = std::env::temp_dir().join(format!("pliant-session-{}.rec", std::process::id()));
    let (mut host, invite, body) = host(HostConfig { name: "Hanna".into(), ..HostConfig::default() });
    // The model is in the guest's cache, so the host does not send it. The recording must contain
    // it anyway.
    let mut seen = guest(&invite, JoinConfig { record: Some(path.clone()), ..cached() });
    run_until(&mut [&mut host, &mut seen], "the body arrives", |apps| body_of(apps[1]).is_some());
    host.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.5, 0.4)), GrabOf(body)));
    let there = body_of(&mut seen).unwrap();
    run_until(&mut [&mut host, &mut seen], "the body rests where it is held", |apps| {
        let truth = apps[0].world().get::<BodyState>(body).unwrap().body().q();
        let shown = apps[1].world().get::<VisualState>(there).unwrap().q();
        let size = truth.iter().fold(0.0_f64, |size, q| size.max(q.abs()));
        let off = truth.iter().zip(shown).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        must!(size > 0.1 && off < 0.005 * size && rests(apps[0], body, 0.05 * size), "{off} of {size}");
        Ok(())
    });
    // The body stands still for a while, so that a replay with late last frames still shows the end
    // state.
    let still = tick(&host);
    run_until(&mut [&mut host, &mut seen], "two seconds", |apps| tick(apps[0]) > still + 80);
    let shown = seen.world().get::<VisualState>(there).unwrap().q().to_vec();
    drop(seen);
    drop(host);

    let recording = SessionRecording::open(&path).unwrap();
    let mut again = app(NetPlugin::replay(recording, JoinConfig::default()));
    run_until(&mut [&mut again], "the recording is over", |apps| {
        !messages::<SessionClosed>(apps[0]).is_empty()
    });
    let mut bodies = again.world_mut().query::<&VisualState>();
    let replayed = bodies.single(again.world()).unwrap().q();
    let size = shown.iter().fold(0.0_f64, |size, q| size.max(q.abs()));
    let off = shown.iter().zip(replayed).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / size;
    // The body stands still under a steady hand, so both end states must be the same.
    assert!(off < 0.01, "{replayed:?}, not {shown:?}");
    std::fs::remove_file(&path).unwrap();
    // At the end of the recorded session its users are despawned.
    let mut users = again.world_mut().query::<&User>();
    let names: Vec<&str> = users.iter(again.world()).map(|user| user.name.as_str()).collect();
    assert!(names.is_empty(), "the session is over: {names:?}");
}

#[test]
fn a_body_that_is_full_says_so_and_one_user_leaves_room_for_the_next() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let mut guests: Vec<App> = (0..3).map(|_| guest(&invite, cached())).collect();
    let all =
        |host: &mut App, guests: &mut [App], what: &str, done: &mut dyn FnMut(&mut [&mut App]) -> bool| {
            let mut apps: Vec<&mut App> = std::iter::once(host).chain(guests.iter_mut()).collect();
            run_until(&mut apps, what, done);
        };
    all(&mut host, &mut guests, "the body is everywhere", &mut |apps| {
        (1..4).all(|at| body_of(apps[at]).is_some())
    });
    let hands = |host: &mut App| host.world_mut().query::<&HandOf>().iter(host.world()).count();
    // First as many grabs as a guest may hold at all, each with its own patch, then half of the
    // free places, then one.
    for (guest, asked, held) in [(0, 16, 16), (1, 16, 24), (2, 1, 25)] {
        let there = body_of(&mut guests[guest]).unwrap();
        for k in 0..asked {
            let grab = Grab::new(TIP, 0.3 + 0.01 * f64::from(k), DVec3::new(0.9, 1.9, 0.0));
            guests[guest].world_mut().spawn((grab, GrabOf(there)));
        }
        all(&mut host, &mut guests, "all are held or refused", &mut |apps| {
            let refused = messages::<GrabRefused>(apps[guest + 1]).len();
            hands(apps[0]) == held && refused == asked as usize + [0, 16, 24][guest] - held
        });
    }
    // The limit does not apply to the host's own hands. They fill the body, and the next guest's
    // grab is refused instead of waiting without notice.
    for _ in 0..7 {
        host.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(0.9, 1.9, 0.0)), GrabOf(body)));
    }
    let there = body_of(&mut guests[2]).unwrap();
    let late = guests[2].world_mut().spawn((Grab::new(TIP, 0.5, DVec3::Y), GrabOf(there))).id();
    all(&mut host, &mut guests, "the last is refused", &mut |apps| {
        messages::<GrabRefused>(apps[3]) == [GrabRefused { entity: late }]
    });
}

#[test]
fn a_hand_is_told_of_no_more_force_than_it_may_be() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    let mut guest = guest(&invite, JoinConfig { most_force: 0.25, ..cached() });
    let there = arrival(&mut host, &mut guest);
    let own = guest.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.5, 0.4)), GrabOf(there))).id();
    let strongest = |app: &mut App| {
        let mut forces = app.world_mut().query::<&GrabForce>();
        forces.iter(app.world()).map(|felt| felt.force.length()).fold(0.0, f64::max)
    };
    run_until(&mut [&mut host, &mut guest], "the host's body pulls back", |apps| strongest(apps[0]) > 1.0);
    // For forty steps the force must be at its limit and never above.
    let mut since = None;
    run_until(&mut [&mut host, &mut guest], "the guest feels its most, in the force's direction", |apps| {
        let most = strongest(apps[1]);
        assert!(most <= 0.25 + 1e-9, "{most} N");
        let felt = apps[1].world().get::<GrabForce>(own).unwrap().force.length();
        let now = tick(apps[0]);
        since = (felt > 0.24).then(|| since.unwrap_or(now));
        must!(since.is_some_and(|since| now > since + 40), "{felt} N");
        Ok(())
    });
}

#[test]
fn a_body_that_goes_while_a_guest_holds_it_takes_the_hand_with_it() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let mut guest = guest(&invite, cached());
    let there = arrival(&mut host, &mut guest);
    guest.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.5, 0.4)), GrabOf(there)));
    run_until(&mut [&mut host, &mut guest], "it is held", |apps| only::<HandOf>(apps[0]).is_some());
    host.world_mut().despawn(body);
    run_until(&mut [&mut host, &mut guest], "it is gone", |apps| {
        body_of(apps[1]).is_none() && only::<HandOf>(apps[0]).is_none()
    });
    // The session continues, and another body arrives and is held.
    let handle = host.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    host.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar")));
    run_until(&mut [&mut host, &mut guest], "another comes", |apps| body_of(apps[1]).is_some());
    let there = body_of(&mut guest).unwrap();
    guest.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 0.5, 0.4)), GrabOf(there)));
    run_until(&mut [&mut host, &mut guest], "and is held", |apps| only::<HandOf>(apps[0]).is_some());
}
