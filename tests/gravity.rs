//! Tests that all machines of a session step a body with the same gravity, over real QUIC.

use std::{
    path::Path,
    time::{Duration, Instant},
};

use bevy::{prelude::*, transform::TransformPlugin};
use pliant::{
    modal::ModalModel,
    net::{HostConfig, Invite, JoinConfig, NetGuest, NetPeer, NetPlugin, PeerConfig, RemoteBody, SharedBody},
    prelude::*,
};

const GRAVITY: [f64; 3] = [0.0, -9.81, 0.0];

/// An app with a free body, with gravity of the scene and of its own.
fn app(net: NetPlugin, scene: Option<BodyGravity>, own: [f64; 3]) -> (App, Entity) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/jack.modal");
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin))
        .insert_resource(Time::<Fixed>::from_hz(40.0))
        .add_plugins((PliantBodyPlugin::default(), net));
    if let Some(scene) = scene {
        app.insert_resource(scene);
    }
    let model = ModalAsset::from(ModalModel::read(path).unwrap());
    let mut body = ModalBody::new(app.world_mut().resource_mut::<Assets<ModalAsset>>().add(model));
    body.settings.gravity = own;
    let entity = app.world_mut().spawn((body, SharedBody::named("jack"))).id();
    (app, entity)
}

fn until(apps: &mut [&mut App], what: &str, mut so: impl FnMut(&mut [&mut App]) -> bool) {
    let start = Instant::now();
    while !so(apps) {
        assert!(start.elapsed() < Duration::from_secs(60), "never: {what}");
        apps.iter_mut().for_each(|app| app.update());
        std::thread::sleep(Duration::from_millis(4));
    }
}

/// The gravity with which a peer steps the body, if it does.
fn of_peer(app: &App, body: Entity) -> Option<[f64; 3]> {
    let net = app.world().get_resource::<NetPeer>()?;
    Some(net.session()?.body(net.body_of(body)?)?.settings().gravity)
}

#[test]
fn peers_step_with_one_gravity_wherever_it_is_set() {
    let peer = |name: &str, join: Option<Invite>| {
        NetPlugin::peer(PeerConfig { name: name.into(), join, ..default() }).unwrap()
    };
    let (mut a, body_a) = app(peer("a", None), Some(BodyGravity::EARTH), [0.0; 3]);
    until(&mut [&mut a], "the first begins", |apps| of_peer(apps[0], body_a).is_some());
    let invite = a.world().resource::<NetPeer>().invite();
    let (mut b, body_b) = app(peer("b", Some(invite)), None, GRAVITY);
    until(&mut [&mut a, &mut b], "both step it", |apps| of_peer(apps[1], body_b).is_some());
    assert_eq!([of_peer(&a, body_a), of_peer(&b, body_b)], [Some(GRAVITY); 2]);
    until(&mut [&mut a, &mut b], "it falls alike", |apps| {
        let fallen = [(0, body_a), (1, body_b)].map(|(k, body)| {
            let net = apps[k].world().resource::<NetPeer>();
            let session = net.session().unwrap();
            (session.confirmed(), session, net.body_of(body).unwrap())
        });
        let tick = fallen[0].0.min(fallen[1].0);
        let states = fallen.map(|(_, session, body)| session.state_at(body, tick));
        let [Some(here), Some(there)] = states else { return false };
        assert_eq!(here, there, "the same to the bit");
        here.frame.velocity()[1] < -1.0
    });
}

#[test]
fn a_guest_learns_the_gravity_of_the_hosts_scene() {
    let net = NetPlugin::host(HostConfig::default()).unwrap();
    let invite = net.invite().unwrap().clone();
    let (mut host, body) = app(net, Some(BodyGravity(Vec3::Y * -2.0)), [0.0, -0.5, 0.0]);
    // What the guest's own scene has does not matter.
    let net = NetPlugin::join(&invite, JoinConfig::default()).unwrap();
    let (mut guest, _) = app(net, Some(BodyGravity::EARTH), [0.0; 3]);
    let here = |app: &mut App| {
        let remote = app.world_mut().query::<&RemoteBody>().iter(app.world()).next().copied();
        remote.and_then(|body| Some(app.world().resource::<NetGuest>().body(body)?.info().settings.gravity))
    };
    until(&mut [&mut host, &mut guest], "the guest has it", |apps| here(apps[1]) == Some([0.0, -2.5, 0.0]));
    host.world_mut().get_mut::<BodyGravityScale>(body).unwrap().0 = -1.0;
    until(&mut [&mut host, &mut guest], "the change arrives", |apps| here(apps[1]) == Some([0.0, 1.5, 0.0]));
}
