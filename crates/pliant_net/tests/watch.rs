//! A session through a relay to watchers: what they see, late, after losses, and from liars.
//!
//! The relay is in this process. Where `PLIANT_MOQ_RELAY` names the program `moq-relay`, the test
//! `the_same_through_a_real_relay` runs with it, too.

use crate::relay;
use crate::support;
use crate::watching;

use std::sync::Arc;
use std::time::{Duration, Instant};

use bevy::math::DVec3;
use bevy::prelude::*;
use moq_net::{Timestamp, origin};
use pliant_body::VisualState;
use pliant_modal::ModalModel;
use pliant_net::watch::{
    CatalogCamera, PublishOptions, RelayOptions, WatchCommands, WatchPlugin, WatchState, WatchView, Watcher,
};
use pliant_net::{NetHost, NetPlugin, RemoteHands};
use pliant_stream::watch::{BodyEncoder, Catalog, CatalogBody, WatchConfig, WatchSurface};
use pliant_stream::{BodyId, TickState};
use relay::{Certificate, TestRelay};
use support::{alone, app, bar, body_of, must, run_until, tick, wait_for};
use watching::{NAME, Publisher, Seen, off, options};

/// The whole way, through any relay: every frame is the host's shape at its tick, a late watcher
/// sees the next frames, hands and numbers are those of the host, and the end is told.
fn the_session_comes_through(at: RelayOptions) {
    let mut publish = PublishOptions::new(at.clone());
    publish.title = "A bar".into();
    let camera = CatalogCamera { eye: [0.0, 1.0, 3.0], at: [0.5, 1.0, 0.0], field_of_view: 0.9 };
    publish.cameras = vec![camera];
    publish.bodies.rate = 20.0;
    let mut host = Publisher::start(publish);
    let mut watcher = Watcher::open(&at, Vec::new()).unwrap();
    let mut seen = Seen::default();
    wait_for("forty frames", || {
        host.update();
        seen.take(&mut watcher);
        must!(seen.states.len() >= 40, "{} frames, wrong: {:?}", seen.states.len(), seen.wrong);
        // On a busy machine a frame of the host makes two ticks, and the truth has the second one.
        let known = seen.states.iter().filter(|(tick, _)| host.truth.contains_key(tick)).count();
        must!(known >= 20, "{known} of {} frames can be compared", seen.states.len());
        Ok(())
    });
    assert_eq!(seen.catalogs.last().unwrap().name, "A bar");
    assert_eq!(seen.catalogs.last().unwrap().cameras, [camera]);
    let entry = seen.catalogs.last().unwrap().bodies[0].clone();
    assert_eq!((entry.name.as_str(), entry.every, entry.modes), ("bar", 2, 4));
    assert!((entry.placement.scale - 2.0).abs() < 1e-6);
    let model = &seen.models[&entry.id];
    assert_eq!(model.hash(), bar().hash());
    let known = seen.states.iter().filter_map(|(tick, q)| Some((q, host.truth.get(tick)?)));
    let errors: Vec<f64> = known.map(|(q, truth)| off(model, q, truth)).collect();
    let worst = errors.iter().copied().fold(0.0, f64::max);
    let moved = seen.states.iter().map(|(_, q)| off(model, q, &[0.0; 4])).fold(0.0, f64::max);
    println!("{} frames, off by {worst:.1e} of the size while it moves by {moved:.2}", errors.len());
    assert!(worst < 2e-4 && moved > 0.1);
    let gaps = seen.states.windows(2).filter(|pair| pair[1].0 != pair[0].0 + 2).count();
    assert_eq!(gaps, 0, "no frame is missing");
    let hand = seen.hands.iter().rev().find(|hands| !hands.hands.is_empty()).unwrap();
    assert_eq!((hand.numbers.people, hand.numbers.loss), (1, None));
    assert!(DVec3::from(hand.hands[0].target).distance(DVec3::Y) < 3.0);
    assert!(seen.hands.iter().flat_map(|h| &h.hands).any(|h| DVec3::from(h.reaction).length() > 0.1));

    // Who comes late begins with the newest group. Of two on one thread, one leaves early.
    let mut pair = Watcher::open_all(&[at.clone(), at.clone()], Vec::new()).unwrap();
    let (mut leaves, mut late) = (pair.pop(), pair.pop().unwrap());
    let (mut seen_late, opened) = (Seen::default(), tick(&host.app));
    let mut seen_by_other = Seen::default();
    wait_for("late watchers' frames", || {
        host.update();
        seen.take(&mut watcher);
        if let Some(other) = &mut leaves {
            seen_by_other.take(other);
            must!(seen_by_other.states.len() > 5, "{} frames", seen_by_other.states.len());
        }
        leaves = None;
        seen_late.take(&mut late);
        must!(seen_late.states.len() > 20, "{} frames", seen_late.states.len());
        Ok(())
    });
    let first = seen_late.states[0].0;
    // A group is a second, which is 40 ticks, and one that ended 0.3 s before may come first.
    assert!(first + 53 > opened, "begins with tick {first}, and was opened at {opened}");

    let (_, stats) = host.app.world().resource::<NetHost>().published().unwrap();
    println!("{stats:?}");
    assert!(stats.connected && stats.dropped == 0);
    drop(host);
    wait_for("the end", || {
        seen.take(&mut watcher);
        seen.over > 0
    });
    assert!(seen.wrong.is_empty() && seen_late.wrong.is_empty(), "{:?}", seen.wrong);
}

#[test]
fn a_session_comes_through_a_relay() {
    let _alone = alone();
    let relay = TestRelay::start();
    the_session_comes_through(options(&relay));
}

/// With the program `moq-relay` that `PLIANT_MOQ_RELAY` names.
#[test]
fn the_same_through_a_real_relay() {
    let Some(program) = std::env::var_os("PLIANT_MOQ_RELAY") else {
        println!("skipped: PLIANT_MOQ_RELAY does not name the program moq-relay");
        return;
    };
    let _alone = alone();
    let port = std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let at = format!("127.0.0.1:{port}");
    let mut relay = std::process::Command::new(program)
        .args(["--listen", &at, "--listen-tls-generate", "localhost", "--web-http-listen", &at])
        .args(["--auth-public", "**"])
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let hash = wait_for("the relay's certificate", || {
        use std::io::{Read, Write};
        let mut line = std::net::TcpStream::connect(&at).ok()?;
        line.write_all(b"GET /certificate.sha256 HTTP/1.0\r\n\r\n").ok()?;
        let mut answer = String::new();
        line.read_to_string(&mut answer).ok()?;
        answer.split("\r\n\r\n").nth(1).map(|hash| hash.trim().to_owned()).filter(|hash| hash.len() == 64)
    });
    let address = format!("https://{at}/");
    the_session_comes_through(RelayOptions::new(address, NAME).with_certificate(&hash).unwrap());
    let _ = relay.kill();
    let _ = relay.wait();
}

/// The relay is killed and started again, and then the host: the picture comes again by itself.
#[test]
fn relays_and_hosts_that_start_again_are_found_again() {
    let _alone = alone();
    let relay = TestRelay::start();
    let (port, certificate, at) = (relay.port, relay.certificate.clone(), options(&relay));
    let mut host = Publisher::start(PublishOptions::new(at.clone()));
    let mut watcher = Watcher::open(&at, Vec::new()).unwrap();
    let mut seen = Seen::default();
    wait_for("the first frames", || {
        host.update();
        seen.take(&mut watcher);
        seen.states.len() > 10
    });
    drop(relay);
    let silent = Instant::now();
    while silent.elapsed() < Duration::from_secs(1) {
        host.update();
        seen.take(&mut watcher);
    }
    let before = seen.states.last().unwrap().0;
    let relay = TestRelay::start_again(port, certificate);
    let back = Instant::now();
    wait_for("frames after the relay's restart", || {
        host.update();
        seen.take(&mut watcher);
        must!(seen.states.last().unwrap().0 > before + 40, "{:?}", seen.wrong);
        Ok(())
    });
    println!("the relay was there again for {:?} when frames came", back.elapsed());

    let session = seen.catalogs.last().unwrap().session;
    drop(host);
    let mut host = Publisher::start(PublishOptions::new(at));
    let back = Instant::now();
    wait_for("the new host's catalog and frames", || {
        host.update();
        let before = seen.states.len();
        seen.take(&mut watcher);
        let new = seen.catalogs.last().unwrap().session != session;
        must!(new && seen.states.len() > before, "over: {}, wrong: {:?}", seen.over, seen.wrong);
        Ok(())
    });
    println!("the host was there again for {:?} when frames came", back.elapsed());
    drop(relay);
}

/// The relay itself publishes nonsense beside a true session: the watcher says so each time, stays
/// alive, and shows what is true.
#[test]
fn what_a_relay_invents_is_left_out_and_told() {
    let _alone = alone();
    let model = bar();
    let invented = model.clone();
    let relay = TestRelay::start_with(0, Certificate::new(), move |origin| {
        let broadcast = origin.publish(NAME, origin::Route::default()).unwrap();
        tokio::task::spawn_local(nonsense(broadcast, invented));
    });
    let at = options(&relay);
    let mut watcher = Watcher::open(&at, Vec::new()).unwrap();
    let mut seen = Seen::default();
    let wanted = ["catalog", "too long", "watched", "hands", "group is full"];
    wait_for("all the nonsense, and the truth beside it", || {
        std::thread::sleep(Duration::from_millis(3));
        seen.take(&mut watcher);
        let missing: Vec<_> = wanted.iter().filter(|w| !seen.wrong.iter().any(|s| s.contains(*w))).collect();
        must!(missing.is_empty(), "not told of {missing:?}, but of {:?}", seen.wrong);
        must!(seen.states.iter().any(|(tick, _)| *tick > 1000), "no true frame");
        Ok(())
    });
    println!("told: {:?}", seen.wrong.iter().collect::<std::collections::BTreeSet<_>>());
    assert!(seen.states.iter().all(|(_, q)| q.iter().all(|q| q.is_finite())));
    assert!(seen.models.values().all(|got| got.hash() == model.hash()));
}

/// The same in the page for browsers, where node and Chromium are: PLIANT_CHROMIUM names it.
#[test]
fn what_a_relay_invents_in_a_browser() {
    let Some(chromium) = std::env::var_os("PLIANT_CHROMIUM") else {
        println!("skipped: PLIANT_CHROMIUM does not name a browser");
        return;
    };
    let _alone = alone();
    let model = bar();
    let relay = TestRelay::start_with(0, Certificate::new(), move |origin| {
        let broadcast = origin.publish(NAME, origin::Route::default()).unwrap();
        tokio::task::spawn_local(nonsense(broadcast, model));
    });
    let link = PublishOptions::new(options(&relay)).link("");
    let folder = std::env::temp_dir().join(format!("pliant-lies-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let ended = std::process::Command::new("node")
        .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/watch/lies.mjs"))
        .args([chromium.as_os_str(), folder.as_os_str()])
        .arg(link.trim_start_matches('#'))
        .args(["another kind", "too long", "cut off", "without its snapshot", "does not end", "many hands"])
        .args(["another model", "too large"])
        .output()
        .unwrap();
    let _ = std::fs::remove_dir_all(&folder);
    println!("{}{}", String::from_utf8_lossy(&ended.stdout), String::from_utf8_lossy(&ended.stderr));
    assert!(ended.status.success());
}

async fn nonsense(broadcast: moq_net::broadcast::Producer, model: Arc<ModalModel>) {
    let track = |name: &str| broadcast.create_track(name, None).unwrap();
    let (mut catalogs, mut hands) = (track("catalog"), track("hands"));
    let mut body = track("body/1");
    let files = track(&pliant_stream::watch::model_track(model.hash()));
    let false_files = track(&pliant_stream::watch::model_track(pliant_modal::ModelHash([7; 32])));
    let now = Timestamp::now;
    let surfaces = track(&pliant_stream::watch::surface_track(model.hash()));
    let false_surfaces = track(&pliant_stream::watch::surface_track(pliant_modal::ModelHash([7; 32])));
    let bytes = model.to_bytes();
    let surface = WatchSurface::new(&model, 4).encode();
    let all = [(&files, &bytes), (&false_files, &bytes), (&surfaces, &surface), (&false_surfaces, &surface)];
    for (track, bytes) in all {
        let mut group = track.append_group().unwrap();
        for piece in pliant_stream::watch::pieces(bytes) {
            group.write_frame(now(), piece.to_vec()).unwrap();
        }
        group.finish().unwrap();
    }
    let entry = CatalogBody { surface_bytes: surface.len() as u64, ..watching::entry(&model) };
    let other = pliant_modal::ModelHash([7; 32]);
    let false_one = CatalogBody { id: BodyId(2), model: other, ..entry.clone() };
    let huge = CatalogBody {
        id: BodyId(3),
        model: pliant_modal::ModelHash([8; 32]),
        file_bytes: u64::MAX,
        surface_bytes: u64::MAX,
        ..entry.clone()
    };
    let bodies = vec![entry, false_one, huge];
    let catalog = Catalog { session: 1, step: 0.025, name: "lies".into(), bodies, cameras: Vec::new() };
    let mut encoder = BodyEncoder::new(&model, WatchConfig { rate: 40.0, ..WatchConfig::default() }, 0.025);
    let encoder = encoder.as_mut().unwrap();
    for round in 0_u64.. {
        let good = catalog.encode();
        catalogs.write_frame(now(), vec![round as u8; 33]).unwrap();
        tokio::time::sleep(Duration::from_millis(20)).await;
        catalogs.write_frame(now(), good).unwrap();
        hands.write_frame(now(), vec![0xff; 40]).unwrap();
        // Too long, cut off, out of nothing, and without end.
        body.write_frame(now(), vec![1; 300_000]).unwrap();
        tokio::time::sleep(Duration::from_millis(20)).await;
        encoder.restart();
        let q = [0.01; 4];
        let state =
            |tick| TickState { tick, q: &q, v: &[], a: &[], z: &[], pose: None, grabs: &[], resting: false };
        let first = encoder.encode(&state(2000 + 100 * round)).unwrap().unwrap().bytes;
        body.write_frame(now(), first[..first.len() - 2].to_vec()).unwrap();
        tokio::time::sleep(Duration::from_millis(20)).await;
        body.write_frame(now(), vec![4; 3]).unwrap();
        tokio::time::sleep(Duration::from_millis(20)).await;
        let mut group = body.append_group().unwrap();
        group.write_frame(now(), first).unwrap();
        let next = encoder.encode(&state(2001 + 100 * round)).unwrap().unwrap().bytes;
        if round % 8 == 3 {
            // More frames than a group may have, slowly enough to be read.
            for k in 0..2000 {
                if group.write_frame(now(), next.clone()).is_err() {
                    break;
                }
                if k % 20 == 0 {
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
            }
        } else {
            group.write_frame(now(), next).unwrap();
        }
        let _ = group.finish();
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// In Bevy: the body appears where the host has it, moves as the host's does, and goes with the
/// session.
#[test]
fn an_app_watches_a_session() {
    let _alone = alone();
    let relay = TestRelay::start();
    let at = options(&relay);
    let mut host = Publisher::start(PublishOptions::new(at.clone()));
    let view = WatchView { color: Srgba::rgb(1.0, 0.0, 0.0), hidden: false };
    host.app.world_mut().entity_mut(host.body).insert(view);
    let mut watching = app(NetPlugin::default());
    watching.add_plugins(WatchPlugin);
    watching.world_mut().commands().watch_session(at);
    let mut shown: Vec<Vec<f64>> = Vec::new();
    let there = wait_for("the body moves in the watching app", || {
        host.update();
        watching.update();
        let wrong = watching.world().resource::<WatchState>().wrong.clone();
        let there = body_of(&mut watching).ok_or_else(|| format!("no body, {wrong:?}"))?;
        shown.push(watching.world().get::<VisualState>(there).unwrap().q().to_vec());
        must!(shown.len() > 300, "{} pictures", shown.len());
        Ok(there)
    });
    let model = bar();
    // Each picture is the host's shape of some tick, up to the straight line between two frames.
    let near = |q: &Vec<f64>| host.truth.values().map(|truth| off(&model, q, truth)).fold(1.0, f64::min);
    let moved = shown.iter().map(|q| off(&model, q, &[0.0; 4])).fold(0.0, f64::max);
    let worst = shown.iter().rev().take(100).map(near).fold(0.0, f64::max);
    println!("moves by {moved:.2} of the size, off by {worst:.1e}");
    // The hand goes 0.015 of the size in a tick, and a frame of the host may make two ticks.
    assert!(moved > 0.1 && worst < 0.02);
    let different = shown.windows(2).filter(|pair| pair[0] != pair[1]).count();
    assert!(different > shown.len() / 2, "{different} of {} pictures are new", shown.len());
    let place = watching.world().get::<Transform>(there).unwrap();
    assert!(place.translation.distance(Vec3::Y) < 1e-6 && (place.scale.x - 2.0).abs() < 1e-6);
    assert_eq!(watching.world().get::<WatchView>(there).unwrap().color, Srgba::rgb(1.0, 0.0, 0.0));
    let hands = watching.world().get::<RemoteHands>(there).unwrap();
    assert_eq!(hands.0.len(), 1);
    let state = watching.world().resource::<WatchState>();
    assert!(state.connected && state.numbers.people == 1 && state.wrong.0 == 0, "{state:?}");
    // What a watcher does reaches nobody: its own hand on the body moves nothing at the host.
    assert_eq!(host.app.world().resource::<NetHost>().session().users().count(), 0);

    host.app.world_mut().resource_mut::<NetHost>().stop_publishing();
    run_until(&mut [&mut host.app, &mut watching], "the body goes with the session", |apps| {
        body_of(apps[1]).is_none()
    });
    watching.world_mut().commands().stop_watching();
    watching.update();
    assert_eq!(*watching.world().resource::<WatchState>(), WatchState::default());
}

/// A link has the hash of the relay's certificate, and never the host's token: whoever has that may
/// publish in the host's place.
#[test]
fn a_link_has_the_certificate_and_the_relay_that_it_shall_have() {
    let hash = "0123456789abcdef".repeat(4);
    let relay = RelayOptions::new("https://one.example:4443/?jwt=SECRET", "a/b");
    let mut options = PublishOptions::new(relay.with_certificate(&hash).unwrap());
    let expected = "#relay=https%3A%2F%2Fone.example%3A4443%2F&session=a%2Fb&certificate=";
    assert_eq!(options.link("https://page.example/"), format!("https://page.example/{expected}{hash}"));
    options.relay.relay = "https://me:PASSWORD@one.example:4443/a@b?jwt=SECRET".into();
    assert!(options.link("p").starts_with("p#relay=https%3A%2F%2Fone.example%3A4443%2Fa%40b&"));
    options.relay.relay = "https://one.example:4443/?jwt=SECRET".into();
    options.link_relay = Some("https://one.example:4443/?jwt=THEIRS".into());
    let expected = "#relay=https%3A%2F%2Fone.example%3A4443%2F%3Fjwt%3DTHEIRS&session=a%2Fb&certificate=";
    assert_eq!(options.link("https://page.example/"), format!("https://page.example/{expected}{hash}"));
    options.link_relay = Some("https://two.example/".into());
    let link = options.link("p");
    assert_eq!(link, "p#relay=https%3A%2F%2Ftwo.example%2F&session=a%2Fb");
    assert!(RelayOptions::new("https://one.example/", "a").with_certificate("12").is_none());
}
