//! A scene with a camera: what it sees is sent, what it does not see is not, and what is far away comes coarser.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::path::Path;
use std::sync::Arc;

use bevy::camera::CameraProjection;
use bevy::camera::primitives::Frustum;
use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabOf, ModalAsset, ModalBody, PliantSystems, ShownState};
use pliant_modal::ModalModel;
use pliant_net::{
    CameraInterest, HostConfig, Interest, Invite, JoinConfig, NetHost, NetPlugin, NetStats, RemoteBody,
    SharedBody,
};
use pliant_stream::PeerId;
use support::{alone, app, guest, only, run_for, run_until};

/// The shipped body: 30 modes, a third of a metre high.
fn pip() -> Arc<ModalModel> {
    let file = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal"));
    Arc::new(ModalModel::read(file).unwrap())
}

/// The host's hand rests.
#[derive(Resource)]
struct Still;

/// A host whose body is always in motion.
fn moving() -> (App, Invite, Entity) {
    let net = NetPlugin::host(HostConfig::default()).unwrap();
    let invite = net.invite().unwrap().clone();
    let mut host = app(net);
    let handle = host.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(pip()));
    let body = host.world_mut().spawn((ModalBody::new(handle), SharedBody::named("pip"))).id();
    // By the top of its head, a tenth of its height each way.
    let model = pip();
    let positions = model.surface().positions();
    let top = (0..positions.len()).max_by(|&a, &b| positions[a][1].total_cmp(&positions[b][1])).unwrap();
    let at = Vec3::from(positions[top]).as_dvec3();
    host.world_mut().spawn((Grab::new(top as u32, 0.03, at), GrabOf(body)));
    let sway = move |time: Res<Time>, still: Option<Res<Still>>, mut grab: Single<&mut Grab>| {
        let t = if still.is_some() { 0.5 } else { time.elapsed_secs_f64() };
        grab.target = at + 0.03 * DVec3::new((3.0 * t).sin(), 0.0, (5.0 * t).cos());
    };
    host.add_systems(FixedUpdate, sway.before(PliantSystems::Input));
    (host, invite, body)
}

fn watcher(invite: &Invite, interest: Option<CameraInterest>) -> App {
    guest(invite, JoinConfig { models: vec![pip()], interest, ..JoinConfig::default() })
}

/// A camera as an app has one, with what Bevy would compute for it: there is no renderer here that does.
fn look(app: &mut App, camera: Entity, from: Vec3, at: Vec3) {
    let place = GlobalTransform::from(Transform::from_translation(from).looking_at(at, Vec3::Y));
    let lens = PerspectiveProjection { fov: 0.8, aspect_ratio: 1.6, ..default() };
    let frustum: Frustum = lens.compute_frustum(&place);
    // No `Transform`: nothing propagates over what is set here.
    app.world_mut().entity_mut(camera).insert((place, Projection::Perspective(lens), frustum));
}

fn came(app: &App) -> (u64, u64) {
    let stats = app.world().resource::<NetStats>();
    (stats.datagrams_in, stats.bytes_in)
}

/// Datagrams and bytes in a second.
fn in_a_second(host: &mut App, guest: &mut App) -> (u64, u64) {
    let before = came(guest);
    run_for(&mut [host, guest], 1.0);
    let after = came(guest);
    (after.0 - before.0, after.1 - before.1)
}

#[test]
fn what_the_camera_does_not_see_is_not_sent_and_comes_back_when_it_does() {
    let _alone = alone();
    let (mut host, invite, body) = moving();
    let mut guest = watcher(&invite, Some(CameraInterest::default()));
    let camera = guest.world_mut().spawn(Camera::default()).id();
    guest.world_mut().entity_mut(camera).remove::<Transform>();
    let near = Vec3::new(0.0, 0.2, 0.8);
    look(&mut guest, camera, near, Vec3::Y * 0.15);
    run_until(&mut [&mut host, &mut guest], 5.0, "the body arrives", |apps| {
        let body = only::<RemoteBody>(apps[1]);
        body.is_some_and(|body| apps[1].world().get::<ShownState>(body).is_some())
    });
    let there = only::<RemoteBody>(&mut guest).unwrap();
    run_for(&mut [&mut host, &mut guest], 1.0);
    let interest = |guest: &App| *guest.world().get::<Interest>(there).unwrap();
    assert_eq!(interest(&guest), Interest::All);
    let seen = in_a_second(&mut host, &mut guest);
    assert!(seen.0 > 30, "40 ticks a second: {seen:?}");

    // It turns around. A second of patience, then nothing but the clock.
    look(&mut guest, camera, near, Vec3::Z * 9.0);
    run_for(&mut [&mut host, &mut guest], 1.6);
    assert_eq!(interest(&guest), Interest::Nothing);
    let unseen = in_a_second(&mut host, &mut guest);
    assert!(unseen.0 <= 5 && unseen.1 * 10 < seen.1, "{unseen:?} out of sight, {seen:?} in sight");

    // From far away it is a fiftieth of the view's height: an eighth of the modes, but never fewer than four.
    look(&mut guest, camera, Vec3::new(0.0, 0.2, 30.0), Vec3::Y * 0.15);
    run_for(&mut [&mut host, &mut guest], 1.0);
    let modes = match interest(&guest) {
        Interest::Modes(modes) => modes,
        other => panic!("{other:?}"),
    };
    assert_eq!(modes, 4, "of 30");
    let far = in_a_second(&mut host, &mut guest);
    // (The default stream is mostly hands and repeats: fewer modes are less work for both sides, and hardly fewer bytes.)
    assert!(far.0 > 30 && (far.1 as f64) < 1.1 * seen.1 as f64, "{far:?} far away, {seen:?} near");
    let shown = guest.world().get::<ShownState>(there).unwrap().q().to_vec();
    assert!(shown[usize::from(modes)..].iter().all(|q| *q == 0.0) && shown[0] != 0.0, "{shown:?}");

    // Near again: more is asked for at once, and the whole shape is right.
    look(&mut guest, camera, near, Vec3::Y * 0.15);
    run_for(&mut [&mut host, &mut guest], 0.5);
    assert_eq!(interest(&guest), Interest::All);
    let again = in_a_second(&mut host, &mut guest);
    assert!(again.0 > 30, "{again:?}");
    println!(
        "a second in sight {seen:?}, out of sight {unseen:?}, far away at {modes} modes {far:?}, in sight {again:?}"
    );
    host.world_mut().insert_resource(Still);
    run_for(&mut [&mut host, &mut guest], 2.0);
    let truth = host.world().get::<BodyState>(body).unwrap().body().q().to_vec();
    let shown = guest.world().get::<ShownState>(there).unwrap().q();
    let size = truth.iter().fold(0.0_f64, |size, q| size.max(q.abs()));
    let off = truth.iter().zip(shown).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / size;
    assert!(off < 0.05, "off by {off}");
    // A camera that is switched off sees nothing.
    guest.world_mut().get_mut::<Camera>(camera).unwrap().is_active = false;
    run_for(&mut [&mut host, &mut guest], 1.6);
    assert_eq!(interest(&guest), Interest::Nothing);
}

#[test]
fn one_who_watches_costs_its_datagrams_and_no_work_of_the_encoder() {
    let _alone = alone();
    let (mut host, invite, _) = moving();
    let mut first = watcher(&invite, None);
    let arrived = |app: &mut App| {
        only::<RemoteBody>(app).is_some_and(|body| app.world().get::<ShownState>(body).is_some())
    };
    run_until(&mut [&mut host, &mut first], 5.0, "the body arrives", |apps| arrived(apps[1]));
    run_for(&mut [&mut host, &mut first], 0.5);
    let session = |host: &App, peer: u64| {
        let session = host.world().resource::<NetHost>().session();
        (session.encoded(), session.stats(PeerId(peer)).unwrap().bytes_out)
    };
    let begin = session(&host, 1);
    let tick = |host: &App| host.world().resource::<pliant_body::PliantTick>().0;
    let ticks = tick(&host);
    run_for(&mut [&mut host, &mut first], 2.0);
    let alone = session(&host, 1);
    assert_eq!(alone.0 - begin.0, tick(&host) - ticks, "one frame a tick");

    let mut second = watcher(&invite, None);
    run_until(&mut [&mut host, &mut first, &mut second], 5.0, "it has the body as well", |apps| {
        arrived(apps[2])
    });
    run_for(&mut [&mut host, &mut first, &mut second], 0.5);
    let (begin, begin_second, ticks) = (session(&host, 1), session(&host, 2), tick(&host));
    run_for(&mut [&mut host, &mut first, &mut second], 2.0);
    let (both, of_second) = (session(&host, 1), session(&host, 2));
    assert_eq!(both.0 - begin.0, tick(&host) - ticks, "still one frame a tick");
    let (a, b) = ((both.1 - begin.1) as f64, (of_second.1 - begin_second.1) as f64);
    assert!((a / b - 1.0).abs() < 0.05, "{a} bytes for the one, {b} for the other");
}
