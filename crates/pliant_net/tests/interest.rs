//! Tests of a scene with a camera: visible bodies are sent, invisible ones are not, and distant
//! ones are sent with fewer modes.

use crate::support;

use std::path::Path;
use std::sync::Arc;

use bevy::camera::CameraProjection;
use bevy::camera::primitives::Frustum;
use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabOf, ModalAsset, ModalBody, PliantSystems, VisualState};
use pliant_modal::ModalModel;
use pliant_net::{CameraInterest, HostConfig, Interest, Invite, JoinConfig, NetHost, NetPlugin, SharedBody};
use pliant_stream::PeerId;
use support::{
    Came, alone, app, arrival, body_of, guest, must, rests, run_frames, run_until, tick, wait_for, window,
};

/// The shipped body, with 30 modes and a height of a third of a meter.
fn pip() -> Arc<ModalModel> {
    let file = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal"));
    Arc::new(ModalModel::read(file).unwrap())
}

/// While this resource exists, the host's hand rests.
#[derive(Resource)]
struct Still;

/// Creates a host whose body is always in motion.
fn moving() -> (App, Invite, Entity) {
    let net = NetPlugin::host(HostConfig::default()).unwrap();
    let invite = net.invite().unwrap().clone();
    let mut host = app(net);
    let handle = host.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(pip()));
    let body = host.world_mut().spawn((ModalBody::new(handle), SharedBody::named("pip"))).id();
    // The hand holds the top of the head and moves it by a tenth of the height each way.
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

/// Sets a camera of an app, with the components that Bevy would compute, because no renderer here
/// does so.
fn look(app: &mut App, camera: Entity, from: Vec3, at: Vec3) {
    let place = GlobalTransform::from(Transform::from_translation(from).looking_at(at, Vec3::Y));
    let lens = PerspectiveProjection { fov: 0.8, aspect_ratio: 1.6, ..default() };
    let frustum: Frustum = lens.compute_frustum(&place);
    // The camera has no `Transform`, so propagation does not overwrite these components.
    app.world_mut().entity_mut(camera).insert((place, Projection::Perspective(lens), frustum));
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
    let there = arrival(&mut host, &mut guest);
    let interest = |guest: &App| *guest.world().get::<Interest>(there).unwrap();
    assert_eq!(interest(&guest), Interest::All);
    let seen = run_until(&mut [&mut host, &mut guest], "all ticks come", window(Came::ticks_come));

    // The camera turns around. After one second of patience only the clock's datagrams arrive.
    look(&mut guest, camera, near, Vec3::Z * 9.0);
    run_until(&mut [&mut host, &mut guest], "patience is over", |apps| {
        interest(apps[1]) == Interest::Nothing
    });
    // In view, ticks cost bytes. Out of view, time does. A slow machine makes few ticks in much
    // time.
    let unseen = window(|came| {
        let unseen = came.only_the_clock()?;
        must!(10.0 * unseen.bytes_in_a_second() < seen.bytes_in_40_ticks(), "{unseen:?}, in sight {seen:?}");
        Ok(unseen)
    });
    let unseen = run_until(&mut [&mut host, &mut guest], "nothing but the clock comes", unseen);

    // From far away the body takes a fiftieth of the view's height. It gets an eighth of its modes,
    // but never fewer than four.
    look(&mut guest, camera, Vec3::new(0.0, 0.2, 30.0), Vec3::Y * 0.15);
    run_until(&mut [&mut host, &mut guest], "four of 30 modes are asked for", |apps| {
        let interest = interest(apps[1]);
        must!(interest == Interest::Modes(4), "{interest:?}");
        Ok(())
    });
    // The default stream is mostly hands and repeats. Fewer modes are less work for both sides, but
    // hardly fewer bytes.
    let far = window(|came| {
        let far = came.ticks_come()?;
        must!(far.bytes_in_40_ticks() < 1.1 * seen.bytes_in_40_ticks(), "{far:?} far away, {seen:?} near");
        Ok(far)
    });
    let far = run_until(&mut [&mut host, &mut guest], "all ticks come, far away", far);
    run_until(&mut [&mut host, &mut guest], "four modes are shown, and no more", |apps| {
        let shown = apps[1].world().get::<VisualState>(there).unwrap().q();
        must!(shown[4..].iter().all(|q| *q == 0.0) && shown[0] != 0.0, "{shown:?}");
        Ok(())
    });

    // Near the body, more modes are requested at once, and the whole shape is right.
    look(&mut guest, camera, near, Vec3::Y * 0.15);
    run_until(&mut [&mut host, &mut guest], "all is asked for", |apps| interest(apps[1]) == Interest::All);
    let again = run_until(&mut [&mut host, &mut guest], "all ticks come again", window(Came::ticks_come));
    println!("in sight {seen:?}, out of sight {unseen:?}, far away {far:?}, in sight {again:?}");
    host.world_mut().insert_resource(Still);
    run_until(&mut [&mut host, &mut guest], "the body is shown as it is", |apps| {
        let truth = apps[0].world().get::<BodyState>(body).unwrap().body().q();
        let shown = apps[1].world().get::<VisualState>(there).unwrap().q();
        let size = truth.iter().fold(0.0_f64, |size, q| size.max(q.abs()));
        let off = truth.iter().zip(shown).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / size;
        must!(shown[4..].iter().any(|q| *q != 0.0) && rests(apps[0], body, size), "it still moves");
        must!(off < 0.05, "off by {off}");
        Ok(())
    });
    // An inactive camera sees nothing.
    guest.world_mut().get_mut::<Camera>(camera).unwrap().is_active = false;
    run_until(&mut [&mut host, &mut guest], "it sees nothing", |apps| interest(apps[1]) == Interest::Nothing);
}

#[test]
fn one_who_watches_costs_its_datagrams_and_no_work_of_the_encoder() {
    let _alone = alone();
    // If a busy machine makes a guest answer late, the host assumes a queue and reduces that
    // guest's stream for a while. The guests' streams then differ, and the test starts over.
    wait_for("two seconds in which two guests have the same stream", cost_of_watching);
}

fn cost_of_watching() -> Result<(), String> {
    let (mut host, invite, _) = moving();
    let mut first = watcher(&invite, None);
    arrival(&mut host, &mut first);
    let session = |host: &App, peer: u64| {
        let session = host.world().resource::<NetHost>().session();
        let stats = session.stats(PeerId(peer)).unwrap();
        (session.encoded(), stats.bytes_out, stats.level)
    };
    let (begin, ticks) = (session(&host, 1), tick(&host));
    run_until(&mut [&mut host, &mut first], "two seconds", |apps| tick(apps[0]) >= ticks + 80);
    assert_eq!(session(&host, 1).0 - begin.0, tick(&host) - ticks, "one frame a tick");

    let mut second = watcher(&invite, None);
    let has_it = |apps: &mut [&mut App]| body_of(apps[2]);
    run_until(&mut [&mut host, &mut first, &mut second], "it has the body as well", has_it);
    run_frames(&mut [&mut host, &mut first, &mut second], 80);
    let (begin, begin_second, ticks) = (session(&host, 1), session(&host, 2), tick(&host));
    let mut alike = true;
    run_until(&mut [&mut host, &mut first, &mut second], "two seconds", |apps| {
        alike &= session(apps[0], 1).2 == session(apps[0], 2).2;
        tick(apps[0]) >= ticks + 80
    });
    must!(alike, "one is cut down, the other is not");
    let (both, of_second) = (session(&host, 1), session(&host, 2));
    let (frames, ticks) = (both.0 - begin.0, tick(&host) - ticks);
    must!(frames == ticks, "still one frame a tick, not {frames} for {ticks}");
    let (a, b) = ((both.1 - begin.1) as f64, (of_second.1 - begin_second.1) as f64);
    must!((a / b - 1.0).abs() < 0.05, "{a} bytes for the one, {b} for the other");
    Ok(())
}
