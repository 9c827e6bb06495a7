//! Tests a hand on a device that holds a body on another machine.
//!
//! The test uses real QUIC, the paper's first network as an emulated link, and the device loop's
//! own thread. Everything runs in real time, and the test waits for each expected state.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a failed test should panic")]

use std::{
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use bevy::{math::DVec3, prelude::*, transform::TransformPlugin};
use pliant::{
    haptics::{
        DeviceId, Fault, HandModel, HapticDevices, HapticFault, HapticTool, HapticsPlugin, LoopConfig,
        ToolGrip, VirtualConfig, VirtualDevice, VirtualHandle,
    },
    modal::ModalModel,
    net::{Emulation, HandOf, HostConfig, Invite, JoinConfig, JoinOptions, NetPlugin, NetStats, SharedBody},
    prelude::*,
    stream::emulator::Preset,
};

fn pip() -> Arc<ModalModel> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal");
    Arc::new(ModalModel::read(path).unwrap())
}

fn app(net: NetPlugin) -> App {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin))
        .insert_resource(Time::<Fixed>::from_hz(40.0))
        .add_plugins((PliantBodyPlugin::default(), net));
    app
}

fn host(model: &Arc<ModalModel>) -> (App, Invite) {
    let net = NetPlugin::host(HostConfig::default()).unwrap();
    let invite = net.invite().unwrap().clone();
    let mut app = app(net);
    let body = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model.clone()));
    app.world_mut().spawn((ModalBody::new(body), SharedBody::named("pip")));
    (app, invite)
}

#[derive(Resource, Default)]
struct ReceivedFaults(Vec<Fault>);

struct Guest {
    app: App,
    device: DeviceId,
    hand: VirtualHandle,
}

/// Creates a guest with a device whose workspace lies on the body's right side.
///
/// The guest is behind the paper's first network (9 % loss, 196 ms).
fn guest(model: &Arc<ModalModel>, invite: &Invite) -> Guest {
    let transport =
        JoinOptions { emulation: Some(Emulation::preset(Preset::Paper1, 7)), ..JoinOptions::default() };
    let config =
        JoinConfig { name: "Ann".into(), transport, models: vec![model.clone()], ..JoinConfig::default() };
    let mut app = app(NetPlugin::join(invite, config).unwrap());
    app.add_plugins(HapticsPlugin::default()).init_resource::<ReceivedFaults>().add_systems(
        Update,
        |mut faults: MessageReader<HapticFault>, mut received: ResMut<ReceivedFaults>| {
            received.0.extend(faults.read().filter_map(|fault| fault.fault));
        },
    );
    app.world_mut().spawn((SharedBody::named("pip"), Transform::default()));
    // Without friction, the hand is where its springs put it.
    let config = VirtualConfig { friction: 0.0, ..VirtualConfig::premium() };
    let device = VirtualDevice::new(config, HandModel::FIRM).unwrap();
    let hand = device.handle();
    let device = app.world_mut().resource_mut::<HapticDevices>().add(device, LoopConfig::default()).unwrap();
    let side = model
        .surface()
        .positions()
        .iter()
        .max_by(|a, b| (a[0] + 0.55 * a[1]).total_cmp(&(b[0] + 0.55 * b[1])))
        .unwrap();
    app.world_mut().spawn((
        HapticTool::new(device),
        ToolGrip::default(),
        Transform::from_translation(Vec3::from(*side)),
    ));
    Guest { app, device, hand }
}

/// Maximum time to wait for a state; a busy machine makes the test slow but does not fail it.
const PATIENCE: Duration = Duration::from_secs(60);

fn until(apps: &mut [&mut App], what: &str, mut so: impl FnMut(&mut [&mut App]) -> bool) {
    let start = Instant::now();
    while !so(apps) {
        assert!(start.elapsed() < PATIENCE, "never: {what}");
        apps.iter_mut().for_each(|app| app.update());
        std::thread::sleep(Duration::from_millis(4));
    }
}

/// Returns the reaction on the guest's hand as the host computes it.
fn at_host(host: &mut App) -> Option<DVec3> {
    let world = host.world_mut();
    world.query_filtered::<&GrabForce, With<HandOf>>().iter(world).next().map(|force| force.force)
}

#[test]
fn a_hand_far_away_feels_the_body_at_once_and_nothing_when_the_network_is_gone() {
    let model = pip();
    let (mut host, invite) = host(&model);
    let mut g = guest(&model, &invite);
    until(&mut [&mut host, &mut g.app], "the body is here", |apps| {
        let world = apps[1].world_mut();
        world.query::<&BodyState>().iter(world).next().is_some()
    });
    g.hand.set_buttons(1);
    until(&mut [&mut host, &mut g.app], "the hand is on the host's body too", |apps| {
        at_host(apps[0]).is_some()
    });
    // The hand is still for some time, so that the session can measure the one-way delay.
    until(&mut [&mut host, &mut g.app], "two seconds are shown", |apps| {
        let stats = apps[1].world().resource::<NetStats>();
        stats.displayed_ticks > 80 && !stats.round_trip.is_zero()
    });

    let hand = g.device;
    let force = |app: &App| -> DVec3 {
        app.world().resource::<HapticDevices>().get(hand).unwrap().report.tick.wrench.force.into()
    };
    // The hand must feel a pull before the host's body reacts. A busy machine may look too late to
    // observe this, so the hand moves back and pulls again until it is observed.
    let start = Instant::now();
    loop {
        // The pull is short: after a late frame has faded the force, the energy tank must hold
        // enough to restore it.
        g.hand.set_target([0.02, 0.007, 0.0]);
        let pulled = Instant::now();
        let mut first = None;
        until(
            &mut [&mut host, &mut g.app],
            "the hand is pushed back as hard as the host's body pushes",
            |apps| {
                let own = force(apps[1]);
                let truth = at_host(apps[0]).unwrap_or_default();
                if own.length() > 0.2 {
                    first.get_or_insert((pulled.elapsed(), truth.length()));
                }
                truth.length() > 0.5 && own.distance(truth) < 0.1 * truth.length()
            },
        );
        let (first, truth) = first.unwrap();
        println!("felt after {} ms on a network of 196 ms: {:?} N", first.as_millis(), force(&g.app));
        if truth < 0.1 {
            break;
        }
        assert!(start.elapsed() < PATIENCE, "felt when the host's body pushed with {truth} N");
        g.hand.set_target([0.0; 3]);
        until(&mut [&mut host, &mut g.app], "nothing is felt where the hand began", |apps| {
            force(apps[1]).length() < 0.1 && at_host(apps[0]).is_some_and(|truth| truth.length() < 0.1)
        });
    }

    // The host's machine stops without a goodbye.
    std::mem::forget(host);
    g.app.world_mut().resource_mut::<ReceivedFaults>().0.clear();
    let mut nothing = Instant::now();
    until(&mut [&mut g.app], "the force fades, says why, and stays away", |apps| {
        if force(apps[0]) != DVec3::ZERO {
            nothing = Instant::now();
        }
        let received = &apps[0].world().resource::<ReceivedFaults>().0;
        nothing.elapsed() > Duration::from_secs(1) && received.iter().any(|f| matches!(f, Fault::Stale(_)))
    });
}
