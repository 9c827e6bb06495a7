use std::time::Duration;

use bevy::{
    asset::AssetPlugin, math::DVec3, prelude::*, time::TimeUpdateStrategy, transform::TransformPlugin,
};
use pliant_body::{Grab, GrabForce, ModalAsset, ModalBody, PliantBodyPlugin};

use super::*;
use crate::{Fault, Hand, LoopConfig, LoopState, VirtualConfig, VirtualDevice, VirtualHandle};

#[path = "../../tests/rig/block.rs"]
mod block;

/// Fixed steps of a hundredth of a second in real time: the loop's thread has its own clock.
fn app() -> App {
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin::default(),
        TransformPlugin,
        PliantBodyPlugin::default(),
        HapticsPlugin::default(),
    ))
    .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_millis(10)))
    .insert_resource(Time::<Fixed>::from_hz(100.0));
    app.finish();
    app.cleanup();
    app
}

fn run(app: &mut App, frames: usize) {
    for _ in 0..frames {
        app.update();
        std::thread::sleep(Duration::from_millis(10));
    }
}

struct Scene {
    app: App,
    device: DeviceId,
    tool: Entity,
    hand: VirtualHandle,
}

/// A block with its tip at the middle of the workspace, a firm hand there.
fn scene(modal: bool) -> Scene {
    let mut app = app();
    let model = block::block(1e5, 12);
    let tip = model.surface().positions()[block::tip() as usize];
    let handle =
        app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(std::sync::Arc::new(model)));
    app.world_mut().spawn(ModalBody::new(handle));
    let device = VirtualDevice::new(VirtualConfig::touch(), Hand::FIRM).unwrap();
    let hand = device.handle();
    let device = app.world_mut().resource_mut::<HapticDevices>().add(device, LoopConfig::default()).unwrap();
    let tool = app
        .world_mut()
        .spawn((
            HapticTool { modal, ..HapticTool::new(device) },
            ToolGrip::default(),
            Transform::from_translation(tip.into()),
        ))
        .id();
    run(&mut app, 5);
    Scene { app, device, tool, hand }
}

fn force(scene: &Scene) -> DVec3 {
    let devices = scene.app.world().resource::<HapticDevices>();
    devices.get(scene.device).unwrap().report.tick.wrench.force.into()
}

fn grabs(app: &mut App) -> Vec<(Grab, GrabForce)> {
    let world = app.world_mut();
    world.query::<(&Grab, &GrabForce)>().iter(world).map(|(g, f)| (*g, *f)).collect()
}

#[test]
fn a_press_holds_and_the_hand_feels_the_body() {
    for modal in [false, true] {
        let mut s = scene(modal);
        s.hand.set_buttons(1);
        run(&mut s.app, 10);
        let held = grabs(&mut s.app);
        assert_eq!(held.len(), 1, "the button grips what is in reach");
        assert!(
            held[0].0.stiffness.is_some_and(|k| (k - 280.0).abs() < 1.0),
            "the device's coupling: {:?}",
            held[0].0
        );
        assert!(force(&s).length() < 0.05, "grabbing pushes nobody: {}", force(&s));
        s.hand.set_target([0.02, 0.0, 0.0]);
        run(&mut s.app, 80);
        let pull = force(&s);
        // The block has E A / L = 1600 N/m, the coupling 280, the arm 500: 2 cm of them in series are 3.1 N.
        assert!((-3.3..-1.5).contains(&pull.x) && pull.y.abs() < 0.5, "modal {modal}: {pull}");
        let body = grabs(&mut s.app)[0].1.force;
        assert!(
            (body.x / pull.x - 1.0).abs() < 0.25,
            "modal {modal}: what the body says and what the hand gets: {body} and {pull}; {:?}",
            s.app.world().resource::<HapticDevices>().get(s.device).unwrap().report.tick
        );
        let pose = *s.app.world().get::<ToolPose>(s.tool).unwrap();
        assert!(pose.gain > 0.9 && pose.position.x > 0.1, "{pose:?}");
        s.hand.set_buttons(0);
        run(&mut s.app, 20);
        assert!(grabs(&mut s.app).is_empty());
        assert!(force(&s).length() < 0.05, "let go: {}", force(&s));
    }
}

#[derive(Resource, Default)]
struct Heard(Vec<Fault>);

#[test]
fn pause_fades_and_stop_is_latched() {
    let mut s = scene(false);
    s.hand.set_buttons(1);
    run(&mut s.app, 10);
    s.hand.set_target([0.02, 0.0, 0.0]);
    run(&mut s.app, 60);
    assert!(force(&s).length() > 1.0);
    s.app.insert_resource(Heard::default());
    s.app.add_systems(Update, |mut faults: MessageReader<HapticFault>, mut heard: ResMut<Heard>| {
        heard.0.extend(faults.read().filter_map(|f| f.fault));
    });
    s.app.world_mut().resource_mut::<Time<Virtual>>().pause();
    run(&mut s.app, 15);
    let heard = &s.app.world().resource::<Heard>().0;
    assert!(heard.iter().any(|f| matches!(f, Fault::Stale(_))), "{heard:?}");
    assert_eq!(force(&s), DVec3::ZERO, "a paused game pushes nobody");
    s.app.world_mut().resource_mut::<Time<Virtual>>().unpause();
    run(&mut s.app, 60);
    assert!(force(&s).length() > 1.0, "and it comes back: {}", force(&s));
    s.app.world().resource::<HapticDevices>().estop();
    run(&mut s.app, 3);
    assert_eq!(force(&s), DVec3::ZERO);
    let state = |s: &Scene| s.app.world().resource::<HapticDevices>().get(s.device).unwrap().report.state;
    assert_eq!(state(&s), LoopState::Stopped);
    s.app.world_mut().resource_mut::<HapticDevices>().reset_stop();
    run(&mut s.app, 60);
    assert_eq!(state(&s), LoopState::Running);
    assert!(force(&s).length() > 1.0);
    assert!(s.app.world_mut().resource_mut::<HapticDevices>().remove(s.device));
    run(&mut s.app, 2);
}

#[test]
fn a_remote_body_is_felt_through_its_published_force() {
    let mut s = scene(false);
    let world = s.app.world_mut();
    let body = world.query_filtered::<Entity, With<ModalBody>>().single(world).unwrap();
    world.entity_mut(body).insert(pliant_body::Driven::Remote);
    let at = DVec3::from(world.get::<Transform>(s.tool).unwrap().translation.as_dvec3());
    let grab =
        world.spawn((Grab::new(block::tip(), 0.01, at), pliant_body::GrabOf(body), HeldBy(s.tool))).id();
    // What a session would write: the patch stays where it is.
    world.entity_mut(grab).insert(GrabForce { point: at, force: DVec3::ZERO });
    s.hand.set_target([0.01, 0.0, 0.0]);
    run(&mut s.app, 60);
    // The coupling's 280 N/m and the arm's 500 in series over 1 cm.
    let want = -0.01 / (1.0 / 280.0 + 1.0 / 500.0);
    let got = force(&s);
    assert!((got.x - want).abs() < 0.3, "{got} for {want}");
    let target = s.app.world().get::<Grab>(grab).unwrap().target;
    assert!(target.x > at.x + 1e-3, "and the session is told where the hand is: {target}");
}
