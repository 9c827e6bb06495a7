//! Tests of sessions that are begun and left while the apps run.

use crate::support;

use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{BodyState, Driven, FixedObstacles, Grab, GrabOf, ModalAsset, ModalBody, VisualState};
use pliant_modal::{Frame, ModalModel, Relaxation, StepSettings};
use pliant_net::transport::{Limits, TransportError};
use pliant_net::{
    BodyLeft, DisconnectReason, Emulation, Fingerprint, HandOf, HostConfig, HostOptions, Invite, JoinConfig,
    JoinOptions, NetError, NetHost, NetPlugin, NetStats, PeerConfig, RemoteBody, RemoteHands, SessionClosed,
    SessionCommands, SessionFailed, SessionJoined, SessionState, SharedBody, User, UserLeft,
};
use pliant_stream::UserId;
use pliant_stream::emulator::LinkConfig;
use support::{TIP, alone, app, bar, body_of, messages, must, only, run_frames, run_until, tick};

/// An app without a session.
fn idle() -> App {
    app(NetPlugin::default())
}

/// Spawns the shared bar, as a host has it.
fn share(app: &mut App) -> Entity {
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    app.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar"))).id()
}

fn state(app: &App) -> SessionState {
    *app.world().resource::<SessionState>()
}

fn users(app: &mut App) -> usize {
    app.world_mut().query::<&User>().iter(app.world()).count()
}

/// A link of 300 ms round trip: whoever waited for an answer would wait that long.
const ROUND_TRIP: Duration = Duration::from_millis(300);

fn far(seed: u64) -> Option<Emulation> {
    let link = LinkConfig { delay: ROUND_TRIP / 4, ..LinkConfig::default() };
    Some(Emulation { outgoing: link.clone(), incoming: link, seed })
}

fn host_at(bind: SocketAddr) -> HostConfig {
    HostConfig {
        transport: HostOptions { bind, emulation: far(1), ..HostOptions::default() },
        ..HostConfig::default()
    }
}

fn join_from_afar() -> JoinConfig {
    JoinConfig {
        transport: JoinOptions { emulation: far(2), ..JoinOptions::default() },
        models: vec![bar()],
        ..JoinConfig::default()
    }
}

/// Runs the apps like [`run_until`], and keeps the longest frame of any of them.
fn run_timed<L: support::Look>(
    apps: &mut [&mut App],
    longest: &mut Duration,
    awaited: &str,
    mut look: impl FnMut(&mut [&mut App]) -> L,
) -> L::Found {
    support::wait_for(awaited, || {
        std::thread::sleep(Duration::from_millis(4));
        for app in apps.iter_mut() {
            let begins = Instant::now();
            app.update();
            *longest = begins.elapsed().max(*longest);
        }
        look(apps)
    })
}

fn invite_of(app: &App) -> Option<Invite> {
    app.world().get_resource::<NetHost>().and_then(NetHost::invite)
}

#[test]
fn a_session_is_hosted_joined_left_and_hosted_again_and_no_frame_waits() {
    let _alone = alone();
    let (mut ann, mut bob, mut cy) = (idle(), idle(), idle());
    let body = share(&mut ann);
    run_frames(&mut [&mut ann, &mut bob, &mut cy], 20);
    assert_eq!([&ann, &bob, &cy].map(state), [SessionState::Idle; 3]);
    assert_eq!(*ann.world().resource::<NetStats>(), NetStats::default());

    // The port is known before, so that the second session can have the same.
    let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut longest = Duration::ZERO;
    ann.world_mut().commands().host_session(host_at(port));
    run_timed(&mut [&mut ann], &mut longest, "the session is open", |apps| invite_of(apps[0]));
    let invite = invite_of(&ann).unwrap().to_string();
    assert_eq!(state(&ann), SessionState::Hosting);
    assert_eq!(messages::<SessionJoined>(&ann)[0].user, UserId::HOST);

    bob.world_mut().commands().join_session(invite.as_str(), join_from_afar());
    let mut both = [&mut ann, &mut bob];
    let there = run_timed(&mut both, &mut longest, "the body arrives", |apps| body_of(apps[1]));
    assert_eq!(state(&bob), SessionState::Joined);
    bob.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 0.5, 0.4)), GrabOf(there)));
    let mut both = [&mut ann, &mut bob];
    run_timed(&mut both, &mut longest, "Bob holds it", |apps| only::<HandOf>(apps[0]).is_some());
    assert_eq!((users(&mut ann), users(&mut bob)), (2, 2));

    bob.world_mut().commands().leave_session();
    let mut both = [&mut ann, &mut bob];
    run_timed(&mut both, &mut longest, "Bob's hand lets go", |apps| only::<HandOf>(apps[0]).is_none());
    assert_eq!(messages::<UserLeft>(&ann)[0].reason, DisconnectReason::Left);
    assert_eq!((state(&bob), users(&mut ann), users(&mut bob)), (SessionState::Idle, 1, 0));
    assert!(bob.world().get_entity(there).is_err(), "the session's body is gone with it");

    // He comes back, and Ann ends the session and hosts the next one in the same frame.
    bob.world_mut().commands().join_session(invite.as_str(), join_from_afar());
    let mut both = [&mut ann, &mut bob];
    run_timed(&mut both, &mut longest, "the body arrives again", |apps| body_of(apps[1]));
    let left = tick(&ann);
    ann.world_mut().commands().leave_session();
    ann.world_mut().commands().host_session(host_at(port));
    run_timed(&mut [&mut ann], &mut longest, "the old session is left", |apps| {
        state(apps[0]) == SessionState::Opening
    });
    assert_eq!((users(&mut ann), only::<HandOf>(&mut ann)), (0, None));
    let begins = Instant::now();
    let mut both = [&mut ann, &mut bob];
    run_timed(&mut both, &mut longest, "Ann hosts again", |apps| state(apps[0]) == SessionState::Hosting);
    let again = begins.elapsed();
    println!("hosting again at the same port after {:.1} ms", again.as_secs_f64() * 1e3);
    // The old connections end beside it. Without that it waited for four round trips.
    assert!(again < 2 * ROUND_TRIP, "hosting again took {again:?}");
    let mut both = [&mut ann, &mut bob];
    run_timed(&mut both, &mut longest, "Bob knows that it is over", |apps| {
        state(apps[1]) == SessionState::Idle
    });
    let over: Vec<DisconnectReason> =
        messages::<SessionClosed>(&bob).into_iter().map(|closed| closed.reason).collect();
    assert_eq!(over, [DisconnectReason::Left; 2], "once his own doing, once hers");
    assert!(body_of(&mut bob).is_none() && tick(&ann) > left, "her body goes on");

    let again = invite_of(&ann).unwrap();
    assert_eq!(again.port, port.port());
    cy.world_mut().commands().join_session(again, join_from_afar());
    let mut both = [&mut ann, &mut cy];
    run_timed(&mut both, &mut longest, "it is Cy's too", |apps| body_of(apps[1]));
    cy.world_mut().commands().leave_session();
    ann.world_mut().commands().leave_session();
    let mut both = [&mut ann, &mut cy];
    run_timed(&mut both, &mut longest, "all is over", |apps| {
        state(apps[0]) == SessionState::Idle && state(apps[1]) == SessionState::Idle
    });
    assert!(ann.world().get::<BodyState>(body).is_some());
    println!("the longest frame took {:.1} ms", longest.as_secs_f64() * 1e3);
    // A frame that waited would have waited for a round trip. A busy machine is allowed a third.
    assert!(longest < ROUND_TRIP / 3, "a frame took {longest:?}");
}

/// The reason of the first failure, which an observer has kept.
#[derive(Resource, Default)]
struct Failure(Option<Arc<NetError>>);

fn keep_failure(failed: On<SessionFailed>, mut failure: ResMut<Failure>) {
    failure.0.get_or_insert(Arc::clone(&failed.reason));
}

/// Asks for a session, and returns why there is none.
fn failure(ask: impl FnOnce(&mut Commands)) -> Arc<NetError> {
    let mut app = idle();
    app.init_resource::<Failure>().add_observer(keep_failure);
    run_frames(&mut [&mut app], 2);
    ask(&mut app.world_mut().commands());
    let reason =
        run_until(&mut [&mut app], "it fails", |apps| apps[0].world().resource::<Failure>().0.clone());
    assert_eq!(state(&app), SessionState::Idle);
    assert!(messages::<SessionClosed>(&app).is_empty(), "nothing has begun");
    assert_eq!(messages::<SessionFailed>(&app).len(), 1);
    reason
}

#[test]
fn a_session_that_cannot_begin_says_why() {
    let _alone = alone();
    let limits = Limits { handshake: Duration::from_millis(500), ..Limits::guest() };
    let once = || JoinConfig {
        transport: JoinOptions { limits: limits.clone(), ..JoinOptions::default() },
        rejoin: Duration::ZERO,
        ..JoinConfig::default()
    };
    let reason = failure(|commands| commands.join_session("see you", once()));
    assert!(
        matches!(&*reason, NetError::Invite(error) if error.to_string().contains("pliant://")),
        "{reason}"
    );

    // Somebody has the port and does not answer.
    let silent = UdpSocket::bind("127.0.0.1:0").unwrap();
    let taken = silent.local_addr().unwrap();
    let nobody = Invite::new(taken, Fingerprint([7; 32]));
    let reason = failure(|commands| commands.join_session(nobody.clone(), once()));
    assert!(matches!(*reason, NetError::NotJoined(DisconnectReason::Silent)), "{reason}");
    let config = PeerConfig {
        join: Some(nobody),
        transport: HostOptions { limits: limits.clone(), ..HostOptions::default() },
        ..PeerConfig::default()
    };
    let reason = failure(|commands| commands.join_peers(config));
    assert!(matches!(*reason, NetError::NotJoined(DisconnectReason::Silent)), "{reason}");
    let reason = failure(|commands| commands.host_session(host_at(taken)));
    let NetError::Transport(TransportError::Bind { address, .. }) = &*reason else { panic!("{reason}") };
    assert_eq!(*address, taken);

    // The invite names another key than the host has.
    let mut host = idle();
    host.world_mut().commands().host_session(HostConfig::default());
    let invite = run_until(&mut [&mut host], "the host is there", |apps| invite_of(apps[0]));
    let other = Invite { fingerprint: Fingerprint([7; 32]), ..invite };
    let reason = failure(|commands| commands.join_session(other, once()));
    assert!(matches!(*reason, NetError::NotJoined(DisconnectReason::WrongKey)), "{reason}");
}

#[test]
fn an_attempt_that_is_given_up_leaves_nothing_and_is_no_failure() {
    let _alone = alone();
    let silent = UdpSocket::bind("127.0.0.1:0").unwrap();
    let nobody = Invite::new(silent.local_addr().unwrap(), Fingerprint([7; 32]));
    let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut app = idle();
    run_frames(&mut [&mut app], 2);
    let mut longest = Duration::ZERO;
    for round in 0..6 {
        // At a different moment each time: while the socket is opened, or while the host is called.
        app.world_mut().commands().join_session(nobody.clone(), JoinConfig::default());
        run_timed(&mut [&mut app], &mut longest, "some frames", {
            let mut left = round % 4;
            move |_| {
                left = i32::max(left, 1) - 1;
                left == 0
            }
        });
        app.world_mut().commands().host_session(host_at(port));
        app.world_mut().commands().leave_session();
        app.world_mut().commands().host_session(host_at(port));
        run_timed(&mut [&mut app], &mut longest, "it is hosted", |apps| invite_of(apps[0]));
        app.world_mut().commands().leave_session();
        run_timed(&mut [&mut app], &mut longest, "it is left", |apps| state(apps[0]) == SessionState::Idle);
    }
    println!("the longest frame took {:.1} ms", longest.as_secs_f64() * 1e3);
    assert!(longest < ROUND_TRIP / 3, "a frame took {longest:?}");
    assert!(messages::<SessionFailed>(&app).is_empty());
    assert_eq!((users(&mut app), messages::<SessionClosed>(&app).len()), (0, 6));
    drop(app);
    assert!(UdpSocket::bind(port).is_ok(), "no socket is left open");
}

#[test]
fn a_guests_own_body_is_stepped_there_again_from_what_was_last_shown() {
    let _alone = alone();
    let (mut host, mut guest) = (idle(), idle());
    let body = share(&mut host);
    let own = share(&mut guest);
    guest.world_mut().get_mut::<ModalBody>(own).unwrap().settings.damping_scale = 3.0;
    // Without a body of its own: what the session gives to it goes with the session.
    let empty = guest.world_mut().spawn(SharedBody::named("other")).id();
    let handle = host.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    host.world_mut().spawn((ModalBody::new(handle), SharedBody::named("other")));
    let before = guest.world().get::<ModalBody>(own).unwrap().clone();
    host.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(0.9, 0.4, 0.2)), GrabOf(body)));
    host.world_mut().commands().host_session(HostConfig::default());
    let invite = run_until(&mut [&mut host], "the session is open", |apps| invite_of(apps[0]));
    guest.world_mut().commands().join_session(invite, JoinConfig::default());
    let shown = |app: &App| app.world().get::<VisualState>(own).map(|visual| visual.q()[0]).unwrap_or(0.0);
    run_until(&mut [&mut host, &mut guest], "it is bent there too", |apps| {
        let truth = apps[0].world().get::<BodyState>(body).map_or(0.0, |state| state.body().q()[0]);
        let there = shown(apps[1]);
        must!(truth.abs() > 0.1 && (there / truth - 1.0).abs() < 0.05, "{there} for {truth}");
        Ok(())
    });
    assert_eq!(guest.world().get::<Driven>(own), Some(&Driven::Remote));
    assert_eq!(guest.world().get::<ModalBody>(own).unwrap().settings.damping_scale, 1.0, "the host's");
    run_until(&mut [&mut host, &mut guest], "the other is there", |apps| {
        apps[1].world().get::<BodyState>(empty).is_some()
    });

    let last = shown(&guest);
    guest.world_mut().commands().leave_session();
    guest.update();
    let world = guest.world();
    assert_eq!(world.get::<Driven>(own), Some(&Driven::Local));
    assert_eq!(world.get::<ModalBody>(own), Some(&before));
    assert!(world.get::<RemoteBody>(own).is_none() && world.get::<RemoteHands>(own).is_none());
    assert!(world.get::<ModalBody>(empty).is_none() && world.get::<BodyState>(empty).is_none());
    let goes_on = world.get::<BodyState>(own).unwrap().body().q()[0];
    assert!((goes_on / last - 1.0).abs() < 0.1, "{goes_on} after {last}");
    run_until(&mut [&mut guest], "it swings back, because no hand holds it here", |apps| {
        shown(apps[0]).abs() < 0.2 * last.abs()
    });
    // It may be shared at once.
    guest.world_mut().commands().host_session(HostConfig::default());
    let invite = run_until(&mut [&mut guest], "it is hosted here", |apps| invite_of(apps[0]));
    let mut third = idle();
    third.world_mut().commands().join_session(invite, JoinConfig::default());
    run_until(&mut [&mut guest, &mut third], "a third one sees it", |apps| body_of(apps[1]));
}

#[test]
fn a_peer_leaves_its_body_goes_on_and_it_may_come_back() {
    let _alone = alone();
    let (mut one, mut two) = (idle(), idle());
    let (mine, yours) = (share(&mut one), share(&mut two));
    let from_afar = |seed| HostOptions { emulation: far(seed), ..HostOptions::default() };
    one.world_mut().commands().join_peers(PeerConfig { transport: from_afar(1), ..PeerConfig::default() });
    let invite = run_until(&mut [&mut one], "the first is there", |apps| {
        apps[0].world().get_resource::<pliant_net::NetPeer>().map(pliant_net::NetPeer::invite)
    });
    let join = || PeerConfig { join: Some(invite.clone()), transport: from_afar(2), ..PeerConfig::default() };
    two.world_mut().commands().join_peers(join());
    let together = |apps: &mut [&mut App]| users(apps[0]) == 2 && users(apps[1]) == 2;
    run_until(&mut [&mut one, &mut two], "they are together", together);
    assert_eq!([&one, &two].map(state), [SessionState::Joined; 2]);
    assert_eq!(two.world().get::<Driven>(yours), Some(&Driven::Remote));

    let mut longest = Duration::ZERO;
    two.world_mut().commands().leave_session();
    run_timed(&mut [&mut one, &mut two], &mut longest, "one is alone", |apps| {
        messages::<UserLeft>(apps[0]).first().map(|left| left.reason)
    });
    assert_eq!(messages::<UserLeft>(&one)[0].reason, DisconnectReason::Left);
    assert_eq!((state(&one), state(&two)), (SessionState::Joined, SessionState::Idle));
    assert_eq!(two.world().get::<Driven>(yours), Some(&Driven::Local));
    assert_eq!((users(&mut two), one.world().get::<Driven>(mine)), (0, Some(&Driven::Remote)));

    two.world_mut().commands().join_peers(join());
    run_timed(&mut [&mut one, &mut two], &mut longest, "they are together again", together);
    println!("the longest frame took {:.1} ms", longest.as_secs_f64() * 1e3);
    assert!(longest < ROUND_TRIP / 3, "a frame took {longest:?}");
}

#[test]
fn a_free_body_that_flew_before_the_session_is_at_rest_after_it() {
    let _alone = alone();
    let jack = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/jack.modal");
    let jack = Arc::new(ModalModel::read(jack).unwrap());
    let mut app = idle();
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(jack.clone()));
    let relaxation = Some(Relaxation { ratio: 0.5, time: 10.0 });
    let settings = StepSettings { relaxation, ..StepSettings::default() };
    let body = ModalBody { settings, ..ModalBody::new(handle) };
    let entity = app.world_mut().spawn((body, SharedBody::named("jack"))).id();
    run_until(&mut [&mut app], "it is there", |apps| {
        apps[0].world().get::<BodyState>(entity).is_some_and(BodyState::has_place)
    });
    let mut state = app.world_mut().get_mut::<BodyState>(entity).unwrap();
    let mut flies = state.body().state().clone();
    let (center, upright) = (flies.frame.center(), flies.frame.orientation());
    flies.frame = Frame::from_motion(&jack, center, upright, [0.0, -5.0, 0.0], [0.0, 0.1, 0.0]).unwrap();
    // It was bent for long.
    flies.z.fill(0.01);
    state.body_mut().set_state(&flies).unwrap();

    app.world_mut().commands().join_peers(PeerConfig::default());
    run_until(&mut [&mut app], "it is played", |apps| {
        apps[0].world().get::<Driven>(entity) == Some(&Driven::Remote)
    });
    run_frames(&mut [&mut app], 30);
    assert!(app.world().get::<FixedObstacles>(entity).is_some());
    app.world_mut().commands().leave_session();
    app.update();
    let shown = app.world().get::<Transform>(entity).unwrap().translation;
    run_frames(&mut [&mut app], 30);
    let world = app.world();
    assert_eq!(world.get::<Driven>(entity), Some(&Driven::Local));
    assert!(world.get::<FixedObstacles>(entity).is_none(), "nobody asks for them any more");
    let body = world.get::<BodyState>(entity).unwrap().body();
    let frame = body.frame();
    assert_eq!([frame.velocity(), frame.spin()], [[0.0; 3]; 2]);
    assert!(body.q().iter().chain(body.z()).all(|x| *x == 0.0), "{:?}, {:?}", body.q(), body.z());
    assert_eq!(world.get::<Transform>(entity).unwrap().translation, shown);
}

#[test]
fn a_body_that_the_host_has_removed_is_the_guests_again_when_it_leaves() {
    let _alone = alone();
    let (mut host, mut guest) = (idle(), idle());
    let own = share(&mut guest);
    guest.world_mut().get_mut::<ModalBody>(own).unwrap().settings.damping_scale = 3.0;
    let before = guest.world().get::<ModalBody>(own).unwrap().clone();
    host.world_mut().commands().host_session(HostConfig::default());
    let invite = run_until(&mut [&mut host], "the session is open", |apps| invite_of(apps[0]));
    guest.world_mut().commands().join_session(invite, JoinConfig::default());
    // The host removes it, brings it back, and removes it again.
    for times in 1..=2 {
        let body = share(&mut host);
        run_until(&mut [&mut host, &mut guest], "it is the host's", |apps| {
            apps[1].world().get::<RemoteBody>(own).is_some()
        });
        host.world_mut().despawn(body);
        run_until(&mut [&mut host, &mut guest], "it is removed", |apps| {
            messages::<BodyLeft>(apps[1]).len() == times
        });
        let world = guest.world();
        assert!(world.get::<RemoteBody>(own).is_none(), "it tracks nothing");
        assert_eq!(world.get::<Driven>(own), Some(&Driven::Remote), "it stays as it was last shown");
    }
    guest.world_mut().commands().leave_session();
    guest.update();
    let world = guest.world();
    assert_eq!(world.get::<Driven>(own), Some(&Driven::Local));
    assert_eq!(world.get::<ModalBody>(own), Some(&before));
    assert_eq!(messages::<BodyLeft>(&guest).len(), 2, "of which nobody is told again");
}

#[test]
fn who_is_told_that_a_session_is_over_reads_that_there_is_none() {
    #[derive(Resource, Default)]
    struct Seen(Vec<SessionState>);
    let _alone = alone();
    let mut app = idle();
    app.init_resource::<Seen>();
    app.add_observer(|_: On<SessionClosed>, state: Res<SessionState>, mut seen: ResMut<Seen>| {
        seen.0.push(*state);
    });
    run_frames(&mut [&mut app], 2);
    app.world_mut().commands().host_session(HostConfig::default());
    run_until(&mut [&mut app], "it hosts", |apps| state(apps[0]) == SessionState::Hosting);
    // The next session begins in the frame in which this one is left.
    app.world_mut().commands().host_session(HostConfig::default());
    run_until(&mut [&mut app], "it hosts again", |apps| {
        messages::<SessionJoined>(apps[0]).len() == 2 && state(apps[0]) == SessionState::Hosting
    });
    app.world_mut().commands().leave_session();
    app.update();
    assert_eq!(app.world().resource::<Seen>().0, [SessionState::Idle; 2]);
}

/// With the feature `states`, the state is one of Bevy's.
#[cfg(feature = "states")]
#[test]
fn the_state_is_one_of_bevys_where_the_app_has_states() {
    #[derive(Resource, Default)]
    struct Entered(Vec<SessionState>);
    let _alone = alone();
    let mut app = idle();
    app.add_plugins(bevy::state::app::StatesPlugin).init_state::<SessionState>().init_resource::<Entered>();
    for state in [SessionState::Opening, SessionState::Hosting, SessionState::Idle] {
        let enter = move |mut entered: ResMut<Entered>| entered.0.push(state);
        app.add_systems(OnEnter(state), enter);
    }
    run_frames(&mut [&mut app], 2);
    app.world_mut().commands().host_session(HostConfig::default());
    run_until(&mut [&mut app], "it hosts", |apps| {
        *apps[0].world().resource::<State<SessionState>>() == SessionState::Hosting
    });
    app.world_mut().commands().leave_session();
    run_until(&mut [&mut app], "it is idle", |apps| {
        *apps[0].world().resource::<State<SessionState>>() == SessionState::Idle
    });
    let entered = &app.world().resource::<Entered>().0;
    assert_eq!(entered.last(), Some(&SessionState::Idle));
    assert!(entered.contains(&SessionState::Hosting), "{entered:?}");
}
