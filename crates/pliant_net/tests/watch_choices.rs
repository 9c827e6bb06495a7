//! What a host chooses for its watchers while they watch: where bodies are and how they look, what
//! is hidden, and what a relay's lies may cost them.

use crate::relay;
use crate::support;
use crate::watching;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use bevy::prelude::*;
use moq_net::{Timestamp, origin};
use pliant_body::{BodyState, ModalAsset, ModalBody, PliantTick};
use pliant_modal::{ModalModel, ModelHash};
use pliant_net::watch::{
    PublishOptions, WatchCommands, WatchEvent, WatchNumbers, WatchPlugin, WatchState, WatchView, Watcher,
};
use pliant_net::{NetHost, NetPlugin, RemoteHands, SharedBody};
use pliant_stream::watch::{
    BodyEncoder, CatalogBody, WatchConfig, WatchHand, WatchHands, WatchedState, body_track, model_track,
};
use pliant_stream::{BodyId, TickState};
use relay::{Certificate, TestRelay};
use support::{alone, app, bar, body_of, must, run_until, wait_for};
use watching::{NAME, Publisher, Seen, catalog, entry, give, options};

/// A body that the host moves and paints in each frame stays the same entity for a watcher, goes
/// the host's way evenly, and does not fill the catalog's track.
#[test]
fn a_body_that_is_moved_and_painted_stays_and_glides() {
    let _alone = alone();
    let relay = TestRelay::start();
    let at = options(&relay);
    let mut host = Publisher::start(PublishOptions::new(at.clone()));
    let mut other = Watcher::open(&at, Vec::new()).unwrap();
    let mut watching = app(NetPlugin::default());
    watching.add_plugins(WatchPlugin);
    watching.world_mut().commands().watch_session(at);
    let first = wait_for("the body", || {
        host.update();
        watching.update();
        body_of(&mut watching)
    });
    let mut seen = Seen::default();
    wait_for("the other watcher", || {
        host.update();
        seen.take(&mut other);
        !seen.states.is_empty()
    });
    let before = seen.catalogs.len();
    // The host's ticks, and what is shown.
    let (mut ticks, mut shown) = (Vec::new(), Vec::new());
    for k in 0..400_u16 {
        let x = 1e-3 * f32::from(k);
        host.app.world_mut().get_mut::<Transform>(host.body).unwrap().translation.x = x;
        let color = Srgba::rgb(f32::from(k % 250) / 250.0, 0.0, 0.0);
        host.app.world_mut().entity_mut(host.body).insert(WatchView { color, hidden: false });
        host.update();
        ticks.push(host.app.world().resource::<PliantTick>().0);
        watching.update();
        seen.take(&mut other);
        let there = body_of(&mut watching).expect("the body goes on");
        assert_eq!(there, first, "the body is made anew when the host moves it");
        shown.push(watching.world().get::<Transform>(there).unwrap().translation.x);
    }
    let color = watching.world().get::<WatchView>(first).unwrap().color;
    let seconds = (ticks[ticks.len() - 1] - ticks[0]) as f64 / 40.0;
    let catalogs = seen.catalogs.len() - before;
    println!("{catalogs} catalogs in {seconds} s, red {}, at {:?}", color.red, shown.last());
    assert!(color.red > 0.0, "the color has not come");
    assert!((catalogs as f64) < 10.0 * seconds + 3.0);
    assert_eq!(seen.catalogs.iter().map(|catalog| catalog.bodies.len()).max(), Some(1));
    // It goes on evenly: never back, and in most frames by some of the way.
    let (low, high) = (shown[0], shown[shown.len() - 1]);
    assert!(low < 0.1 && high > 0.2, "from {low} to {high}");
    let back = shown.windows(2).map(|pair| pair[0] - pair[1]).fold(0.0, f32::max);
    let goes = shown.windows(2).filter(|pair| pair[1] > pair[0]).count();
    println!("forward in {goes} of {} frames, back by {back} at most", shown.len());
    assert!(back < 1e-3 && goes > shown.len() / 2, "forward in {goes} frames, back by {back}");
    // It rests where the host leaves it.
    run_until(&mut [&mut host.app, &mut watching], "the body at its last place", |apps| {
        let there = body_of(apps[1]).unwrap();
        let at = *apps[1].world().get::<Transform>(there).unwrap();
        let end = *apps[0].world().get::<Transform>(host.body).unwrap();
        at.translation.distance(end.translation) < 1e-3 && at.rotation.angle_between(end.rotation) < 1e-3
    });
}

/// Hands, numbers and files are the host's to give, also to who asks for them by name, and a hidden
/// body is gone until it is shown again.
#[test]
fn what_a_host_keeps_for_itself_is_not_sent() {
    let _alone = alone();
    let relay = TestRelay::start();
    let at = options(&relay);
    let mut publish = PublishOptions::new(at.clone());
    (publish.hands, publish.numbers, publish.files) = (false, false, false);
    let mut host = Publisher::start(publish);
    let mut known = Watcher::open(&at, vec![bar()]).unwrap();
    let mut seen = Seen::default();
    wait_for("frames and numbers", || {
        host.update();
        seen.take(&mut known);
        must!(seen.states.len() > 20 && seen.hands.len() > 20, "{:?}", seen.wrong);
        Ok(())
    });
    assert!(seen.hands.iter().all(|hands| hands.hands.is_empty()));
    assert!(seen.hands.iter().all(|hands| hands.numbers == WatchNumbers::default()));
    let entry = seen.catalogs.last().unwrap().bodies[0].clone();
    assert_eq!(entry.file_bytes, 0);
    let hide = |host: &mut Publisher, hidden| {
        let view = WatchView { hidden, ..WatchView::default() };
        host.app.world_mut().entity_mut(host.body).insert(view);
    };
    hide(&mut host, true);
    let (mut gone, mut again) = (false, 0);
    wait_for("the body's end", || {
        host.update();
        while let Some(event) = known.poll() {
            gone |= matches!(event, WatchEvent::Gone(id) if id == entry.id);
        }
        gone
    });
    hide(&mut host, false);
    wait_for("the body again", || {
        host.update();
        while let Some(event) = known.poll() {
            again += u32::from(matches!(event, WatchEvent::State(id, _) if id == entry.id));
        }
        again > 20
    });
}

/// A relay that asks for the model's file by its name gets it only where the host gives it.
#[test]
fn a_file_that_the_host_keeps_is_not_given_to_who_knows_its_name() {
    let _alone = alone();
    for files in [true, false] {
        let counts = Arc::new([AtomicU64::new(0), AtomicU64::new(0)]);
        let of_task = counts.clone();
        let relay = TestRelay::start_with(0, Certificate::new(), move |origin| {
            tokio::task::spawn_local(ask(origin.consume(), of_task));
        });
        let mut publish = PublishOptions::new(options(&relay));
        publish.files = files;
        let mut host = Publisher::start(publish);
        let count = |k: usize| counts[k].load(Ordering::Relaxed);
        let mut refused = None;
        wait_for("the file, or ten refusals of a model that is published", || {
            host.update();
            let (_, stats) = host.app.world().resource::<NetHost>().published().unwrap();
            if stats.frames > 10 {
                refused.get_or_insert(count(1));
            }
            let refused = refused.map_or(0, |before| count(1) - before);
            must!(count(0) > 0 || refused >= 10, "{} bytes, {refused} refusals, {stats:?}", count(0));
            Ok(())
        });
        println!("files {files}: {} bytes, {} refusals", count(0), count(1));
        assert_eq!(count(0) > 0, files);
    }
}

/// Asks for the file of the bar again and again, and counts its bytes and the refusals.
async fn ask(origin: origin::Consumer, counts: Arc<[AtomicU64; 2]>) {
    loop {
        let Ok(broadcast) = origin.routed_broadcast(NAME).await else { return };
        let wanted = moq_net::track::Subscription::default();
        if let Ok(track) = broadcast.track(&model_track(bar().hash()))
            && let Ok(track) = track.subscribe(wanted).await
        {
            let mut track = track.ordered();
            while let Ok(Some(mut group)) = track.next_group().await {
                while let Ok(Some(frame)) = group.read_frame().await {
                    counts[0].fetch_add(frame.payload.len() as u64, Ordering::Relaxed);
                }
            }
        }
        counts[1].fetch_add(1, Ordering::Relaxed);
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// Who comes while the body sleeps sees it, and a second body beside it, by its own model.
#[test]
fn who_comes_late_sees_what_sleeps() {
    let _alone = alone();
    let relay = TestRelay::start();
    let at = options(&relay);
    let mut host = Publisher::start(PublishOptions::new(at.clone()));
    let second = support::bar_of(8);
    let handle = host.app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(second.clone()));
    let new = (SharedBody::named("second"), Transform::default(), ModalBody::new(handle));
    host.app.world_mut().spawn(new);
    for _ in 0..20 {
        host.update();
    }
    host.app.world_mut().despawn(host.hand);
    let body = host.body;
    wait_for("both sleep", || {
        host.app.update();
        std::thread::sleep(Duration::from_millis(3));
        let mut states = host.app.world_mut().query::<&BodyState>();
        states.iter(host.app.world()).count() == 2 && states.iter(host.app.world()).all(BodyState::is_resting)
    });
    for _ in 0..100 {
        host.app.update();
        std::thread::sleep(Duration::from_millis(3));
    }
    let mut late = Watcher::open(&at, Vec::new()).unwrap();
    let mut seen = BTreeMap::new();
    let mut models = BTreeMap::new();
    wait_for("both bodies", || {
        host.app.update();
        std::thread::sleep(Duration::from_millis(3));
        while let Some(event) = late.poll() {
            match event {
                WatchEvent::Body(body, model) => drop(models.insert(body.name, (body.id, model))),
                WatchEvent::State(id, state) => drop(seen.insert(id, state)),
                WatchEvent::Wrong(why) => panic!("{why}"),
                _ => {}
            }
        }
        let resting = seen.values().filter(|state: &&WatchedState| state.resting).count();
        must!(resting == 2, "{resting} of {} bodies rest, {} models", seen.len(), models.len());
        Ok(())
    });
    assert_eq!((models["bar"].1.hash(), models["second"].1.hash()), (bar().hash(), second.hash()));
    let state = &seen[&models["bar"].0];
    let truth = host.app.world().get::<BodyState>(body).unwrap().body().q();
    let off = watching::off(&bar(), &state.q, truth);
    println!("a sleeping body is off by {off:.1e} of its size");
    assert!(off < 1e-3);
}

/// A relay that announces models without end, of which none comes, does not keep a true one out.
#[test]
fn models_that_never_come_leave_room_for_one_that_does() {
    let _alone = alone();
    let relay = TestRelay::start_with(0, Certificate::new(), move |origin| {
        let broadcast = origin.publish(NAME, origin::Route::default()).unwrap();
        tokio::task::spawn_local(false_models(broadcast, bar()));
    });
    let mut watcher = Watcher::open(&options(&relay), Vec::new()).unwrap();
    let mut seen = Seen::default();
    wait_for("the true body after a hundred false models", || {
        std::thread::sleep(Duration::from_millis(3));
        seen.take(&mut watcher);
        must!(!seen.models.is_empty(), "{} catalogs, {:?}", seen.catalogs.len(), seen.wrong.last());
        Ok(())
    });
    println!("{} catalogs before the true model", seen.catalogs.len());
    assert!(seen.models.values().all(|model| model.hash() == bar().hash()));
    assert!(seen.catalogs.len() > 50, "too few catalogs came to fill anything");
}

async fn false_models(broadcast: moq_net::broadcast::Producer, model: Arc<ModalModel>) {
    let track = |name: &str| broadcast.create_track(name, None).unwrap();
    let mut catalogs = track("catalog");
    let _files = give(track(&model_track(model.hash())), &model);
    let _ = catalogs.used().await;
    for k in 0..100_u8 {
        // The track is there, and nothing ever comes in it.
        let hash = ModelHash([k; 32]);
        let empty = track(&model_track(hash));
        // Small ones last, which fill what large ones leave.
        let file_bytes = if k < 50 { 30 << 20 } else { 1 << 20 };
        let body = CatalogBody { model: hash, file_bytes, ..entry(&model) };
        catalogs.write_frame(Timestamp::now(), catalog(1, body)).unwrap();
        tokio::time::sleep(Duration::from_millis(30)).await;
        drop(empty);
    }
    catalogs.write_frame(Timestamp::now(), catalog(1, entry(&model))).unwrap();
    swing(track(&body_track(BodyId(1))), &model).await;
}

/// A relay that goes on with another start of the host in the same broadcast shows it.
#[test]
fn another_session_in_the_same_broadcast_is_seen() {
    let _alone = alone();
    let second = Arc::new(AtomicBool::new(false));
    let of_task = second.clone();
    let relay = TestRelay::start_with(0, Certificate::new(), move |origin| {
        let broadcast = origin.publish(NAME, origin::Route::default()).unwrap();
        tokio::task::spawn_local(two_sessions(broadcast, bar(), of_task));
    });
    let mut watching = app(NetPlugin::default());
    watching.add_plugins(WatchPlugin);
    watching.world_mut().commands().watch_session(options(&relay));
    let session = |watching: &App| {
        let state = watching.world().resource::<WatchState>();
        state.catalog.as_ref().map(|catalog| catalog.session)
    };
    for number in [1, 2] {
        wait_for("the body of the session", || {
            std::thread::sleep(Duration::from_millis(3));
            watching.update();
            let there = body_of(&mut watching);
            must!(
                session(&watching) == Some(number) && there.is_some(),
                "{:?}, {there:?}",
                session(&watching)
            );
            Ok(())
        });
        second.store(true, Ordering::Relaxed);
    }
}

async fn two_sessions(
    broadcast: moq_net::broadcast::Producer,
    model: Arc<ModalModel>,
    second: Arc<AtomicBool>,
) {
    let track = |name: &str| broadcast.create_track(name, None).unwrap();
    let mut catalogs = track("catalog");
    let _files = give(track(&model_track(model.hash())), &model);
    catalogs.write_frame(Timestamp::now(), catalog(1, entry(&model))).unwrap();
    let frames = track(&body_track(BodyId(1)));
    let changes = async {
        while !second.load(Ordering::Relaxed) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        catalogs.write_frame(Timestamp::now(), catalog(2, entry(&model))).unwrap();
        std::future::pending::<()>().await;
    };
    tokio::join!(changes, swing(frames, &model));
}

/// Publishes frames of a body for ever.
async fn swing(mut track: moq_net::track::Producer, model: &ModalModel) {
    let config = WatchConfig { rate: 40.0, ..WatchConfig::default() };
    let mut encoder = BodyEncoder::new(model, config, 0.025).unwrap();
    for tick in 1.. {
        let q = [0.01; 4];
        let state = TickState { tick, q: &q, v: &[], a: &[], z: &[], pose: None, grabs: &[], resting: false };
        if let Some(frame) = encoder.encode(&state).unwrap() {
            track.write_frame(Timestamp::now(), frame.bytes).unwrap();
        }
        tokio::time::sleep(Duration::from_millis(25)).await;
    }
}

/// A sleeping body's last frame may be long ago. Who comes late sees the hand on it all the same.
#[test]
fn a_hand_on_a_sleeping_body_is_seen_by_who_comes_late() {
    let _alone = alone();
    let relay = TestRelay::start_with(0, Certificate::new(), move |origin| {
        let broadcast = origin.publish(NAME, origin::Route::default()).unwrap();
        tokio::task::spawn_local(sleeping(broadcast, bar()));
    });
    let mut watching = app(NetPlugin::default());
    watching.add_plugins(WatchPlugin);
    watching.world_mut().commands().watch_session(options(&relay));
    wait_for("the hand", || {
        std::thread::sleep(Duration::from_millis(3));
        watching.update();
        let there = body_of(&mut watching)?;
        let hands = watching.world().get::<RemoteHands>(there)?;
        hands.0.first().map(|hand| assert_eq!(hand.target.to_array(), [1.0, 2.0, 3.0]))
    });
}

async fn sleeping(broadcast: moq_net::broadcast::Producer, model: Arc<ModalModel>) {
    let track = |name: &str| broadcast.create_track(name, None).unwrap();
    let mut catalogs = track("catalog");
    let _files = give(track(&model_track(model.hash())), &model);
    catalogs.write_frame(Timestamp::now(), catalog(1, entry(&model))).unwrap();
    let mut encoder = BodyEncoder::new(&model, WatchConfig::default(), 0.025).unwrap();
    let q = [0.01; 4];
    let state = TickState { tick: 100, q: &q, v: &[], a: &[], z: &[], pose: None, grabs: &[], resting: true };
    let last = encoder.encode(&state).unwrap().unwrap();
    let mut frames = track(&body_track(BodyId(1)));
    frames.write_frame(Timestamp::now(), last.bytes).unwrap();
    let mut hands = track("hands");
    for tick in 100_000.. {
        let hand = WatchHand { body: BodyId(1), target: [1.0, 2.0, 3.0], ..WatchHand::default() };
        let frame = WatchHands { tick, hands: vec![hand], ..WatchHands::default() };
        hands.write_frame(Timestamp::now(), frame.encode()).unwrap();
        tokio::time::sleep(Duration::from_millis(25)).await;
    }
}

/// The host's app and a watcher's learn why there is no relay, and the token is not in the reason.
#[test]
fn who_has_no_relay_knows_why() {
    let _alone = alone();
    let relay = TestRelay::start();
    let mut at = options(&relay);
    at.relay = format!("{}?jwt=SECRET0123", relay.address());
    let port = relay.port;
    drop(relay);
    let mut host = Publisher::start(PublishOptions::new(at.clone()));
    let mut watching = app(NetPlugin::default());
    watching.add_plugins(WatchPlugin);
    watching.world_mut().commands().watch_session(at);
    let whys = wait_for("both reasons", || {
        host.update();
        watching.update();
        let (_, stats) = host.app.world().resource::<NetHost>().published().unwrap();
        let state = watching.world().resource::<WatchState>();
        let whys = [stats.relay_error.clone(), state.relay_error.clone()];
        whys.iter().all(|why| !why.is_empty()).then_some(whys)
    });
    println!("{whys:?}");
    for why in whys {
        assert!(why.contains(&port.to_string()) && !why.contains("SECRET"), "{why}");
    }
    let hands = watching.world_mut().query::<&RemoteHands>().iter(watching.world()).count();
    assert_eq!(hands, 0);
}
