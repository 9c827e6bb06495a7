//! Devices, tools and grips in an app without a window.
#![cfg(feature = "plugin")]

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use bevy::{
    asset::AssetPlugin, math::DVec3, prelude::*, time::TimeUpdateStrategy, transform::TransformPlugin,
};
use pliant_body::{BodyState, Grab, GrabForce, GrabOf, ModalAsset, ModalBody, PliantBodyPlugin, TouchProbe};

use pliant_haptics::{
    DeviceId, DeviceInfo, Fault, HandModel, HapticButton, HapticDevice, HapticDevices, HapticFault,
    HapticNotice, HapticTool, HapticsPlugin, HeldBy, LoopConfig, LoopState, Sample, Scheduler, ToolGrip,
    ToolPose, ToolTouch, VirtualConfig, VirtualDevice, VirtualHandle, Wrench,
};

use crate::rig::block;

use crate::rig::machine;

/// Creates an app with fixed steps of 0.01 s in real time, because the loop's thread uses a real
/// clock.
fn app() -> App {
    app_in(FixedUpdate)
}

fn app_in(schedule: impl bevy::ecs::schedule::ScheduleLabel + Clone) -> App {
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin::default(),
        TransformPlugin,
        PliantBodyPlugin::new(schedule.clone()),
        HapticsPlugin::new(schedule),
    ))
    .insert_resource(Time::<Fixed>::from_hz(100.0));
    app.finish();
    app.cleanup();
    app
}

struct Scene {
    app: App,
    device: DeviceId,
    tool: Entity,
    hand: VirtualHandle,
    frames: u32,
    /// Whether every frame has another length.
    uneven: bool,
}

/// Creates a block with its tip at the center of the workspace, and a firm hand there.
fn scene(modal: bool) -> Scene {
    scene_in(app(), modal, false)
}

fn scene_in(app: App, modal: bool, uneven: bool) -> Scene {
    scene_on(VirtualConfig::touch(), app, modal, uneven)
}

fn scene_on(config: VirtualConfig, mut app: App, modal: bool, uneven: bool) -> Scene {
    let model = block::block(1e5, 12);
    let tip = model.surface().positions()[block::tip() as usize];
    let handle =
        app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(std::sync::Arc::new(model)));
    app.world_mut().spawn(ModalBody::new(handle));
    let (device, hand) = add(&mut app, config);
    let tool = HapticTool { modal, ..HapticTool::new(device) };
    let place = Transform::from_translation(tip.into());
    let tool = app.world_mut().spawn((tool, ToolGrip::default(), place)).id();
    let mut scene = Scene { app, device, tool, hand, frames: 0, uneven };
    in_place(&mut scene, tool);
    scene
}

/// Adds a virtual device with a firm hand at rest.
fn add_device(app: &mut App) -> (DeviceId, VirtualHandle) {
    add(app, VirtualConfig::touch())
}

fn add(app: &mut App, config: VirtualConfig) -> (DeviceId, VirtualHandle) {
    let device = VirtualDevice::new(config, HandModel::FIRM).unwrap();
    let hand = device.handle();
    (app.world_mut().resource_mut::<HapticDevices>().add(device, machine::patient()).unwrap(), hand)
}

impl Scene {
    /// Runs frames in real time, because the loop extrapolates the local model from one frame to
    /// the next.
    fn run(&mut self, frames: usize) {
        for _ in 0..frames {
            self.frames += 1;
            let uneven = u64::from(self.frames * 137 % 4000);
            let length = Duration::from_micros(if self.uneven { 8000 + uneven } else { 10_000 });
            self.app.insert_resource(TimeUpdateStrategy::ManualDuration(length));
            self.app.update();
            std::thread::sleep(length);
        }
    }
}

fn force(scene: &Scene) -> DVec3 {
    let devices = scene.app.world().resource::<HapticDevices>();
    devices.get(scene.device).unwrap().report.tick.wrench.force.into()
}

/// Runs until the condition holds. The loop uses a real clock and a busy machine stutters, so the
/// test waits instead of counting frames.
fn until(s: &mut Scene, what: &str, mut so: impl FnMut(&mut Scene) -> bool) {
    machine::until(what, || {
        if so(s) {
            return Ok(());
        }
        s.run(1);
        let devices = s.app.world().resource::<HapticDevices>().iter();
        Err(devices.map(|(_, d)| (d.report.state, d.report.ticks, d.report.tick)).collect::<Vec<_>>())
    });
}

/// Checks that the condition holds for thirty frames, and for more periods of every loop than the
/// ramp of the force takes.
fn stays(s: &mut Scene, what: &str, mut so: impl FnMut(&mut Scene) -> bool) {
    let ticks = |s: &Scene| -> Vec<u64> {
        s.app.world().resource::<HapticDevices>().iter().map(|(_, d)| d.report.ticks).collect()
    };
    let (begun, frames) = (ticks(s), s.frames);
    until(s, "frames and periods go on", |s| {
        assert!(so(s), "{what}: {} N", force(s));
        s.frames >= frames + 30 && ticks(s).iter().zip(&begun).all(|(now, then)| now - then >= 400)
    });
}

/// Runs until there is a body and the loop reports the tool at its position. An earlier press would
/// grab nothing and would not be repeated.
fn in_place(s: &mut Scene, tool: Entity) {
    until(s, "a body, and the tool in its place", |s| {
        let bodies = s.app.world_mut().query::<&BodyState>().iter(s.app.world()).count();
        let world = s.app.world();
        let place = world.get::<Transform>(tool).unwrap().translation.as_dvec3();
        bodies == 1 && world.get::<ToolPose>(tool).unwrap().position.distance(place) < 1e-3
    });
}

#[test]
fn a_slow_world_is_felt_as_well() {
    let mut s = scene(false);
    // The step is that of a session: 40 Hz, which at a quarter of the speed is one step every 0.1
    // s.
    s.app.insert_resource(Time::<Fixed>::from_hz(40.0));
    s.hand.set_buttons(1);
    until(&mut s, "it is held", |s| grabs(&mut s.app).len() == 1);
    s.hand.set_target([0.02, 0.0, 0.0]);
    until(&mut s, "3 N", |s| (-3.3..-2.7).contains(&force(s).x));
    s.app.world_mut().resource_mut::<Time<Virtual>>().set_relative_speed(0.25);
    s.run(50);
    stays(&mut s, "at a quarter of the speed", |s| force(s).length() > 2.0);
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
        until(&mut s, "the button grips what is in reach", |s| grabs(&mut s.app).len() == 1);
        stays(&mut s, "grabbing pushes nobody", |s| force(s).length() < 0.05);
        let held = grabs(&mut s.app);
        assert!(
            held[0].0.stiffness.is_some_and(|k| (k - 280.0).abs() < 1.0),
            "the device's coupling: {:?}",
            held[0].0
        );
        s.hand.set_target([0.02, 0.0, 0.0]);
        // The block has E A / L = 1600 N/m, the coupling 280 N/m, the arm 500 N/m. In series, 2 cm
        // of them give 3.1 N, of which friction may hold back 0.26 N.
        until(&mut s, "3 N, and the body says the same as the hand gets", |s| {
            let (pull, body) = (force(s), grabs(&mut s.app)[0].1.force);
            (-3.3..-2.7).contains(&pull.x) && pull.y.abs() < 0.1 && (body.x / pull.x - 1.0).abs() < 0.1
        });
        let pose = *s.app.world().get::<ToolPose>(s.tool).unwrap();
        assert!(pose.position.x > 0.1, "{pose:?}");
        s.hand.set_buttons(0);
        until(&mut s, "let go", |s| grabs(&mut s.app).is_empty() && force(s).length() < 0.05);
    }
}

#[derive(Resource, Default)]
struct ReceivedFaults(Vec<Fault>);

#[test]
fn pause_fades_and_stop_is_latched() {
    let mut s = scene(false);
    s.hand.set_buttons(1);
    until(&mut s, "gripped", |s| grabs(&mut s.app).len() == 1);
    s.hand.set_target([0.02, 0.0, 0.0]);
    until(&mut s, "a force", |s| force(s).length() > 1.0);
    s.app.insert_resource(ReceivedFaults::default());
    s.app.add_systems(
        Update,
        |mut faults: MessageReader<HapticFault>, mut received: ResMut<ReceivedFaults>| {
            received.0.extend(faults.read().filter_map(|f| f.fault));
        },
    );
    s.app.world_mut().resource_mut::<Time<Virtual>>().pause();
    until(&mut s, "a paused game pushes nobody, and says why", |s| {
        let received = &s.app.world().resource::<ReceivedFaults>().0;
        received.iter().any(|f| matches!(f, Fault::Stale(_))) && force(s) == DVec3::ZERO
    });
    s.app.world_mut().resource_mut::<Time<Virtual>>().unpause();
    until(&mut s, "it comes back", |s| force(s).length() > 1.0);
    s.app.world().resource::<HapticDevices>().estop();
    until(&mut s, "stopped", |s| force(s) == DVec3::ZERO);
    stays(&mut s, "and stays so", |s| force(s) == DVec3::ZERO);
    let state = |s: &Scene| s.app.world().resource::<HapticDevices>().get(s.device).unwrap().report.state;
    assert_eq!(state(&s), LoopState::Stopped);
    s.app.world_mut().resource_mut::<HapticDevices>().reset_stop();
    until(&mut s, "runs again", |s| state(s) == LoopState::Running && force(s).length() > 1.0);
    // The device is removed while its button is down. The tool must release the body, and the app
    // must get the message of the button.
    #[derive(Resource, Default)]
    struct Buttons(Vec<HapticButton>);
    s.app.init_resource::<Buttons>();
    s.app.add_systems(Update, |mut events: MessageReader<HapticButton>, mut buttons: ResMut<Buttons>| {
        buttons.0.extend(events.read());
    });
    s.run(2);
    s.app.world_mut().resource_mut::<Buttons>().0.clear();
    assert_eq!(grabs(&mut s.app).len(), 1);
    assert!(s.app.world_mut().resource_mut::<HapticDevices>().remove(s.device));
    assert!(!s.app.world_mut().resource_mut::<HapticDevices>().remove(s.device), "once");
    s.run(2);
    assert_eq!(grabs(&mut s.app).len(), 0, "no phantom hand");
    let up = HapticButton { device: s.device, button: 0, pressed: false };
    assert_eq!(s.app.world().resource::<Buttons>().0, [up]);
    let pose = *s.app.world().get::<ToolPose>(s.tool).unwrap();
    assert_eq!((pose.force, pose.buttons), (DVec3::ZERO, 0));
}

#[test]
fn a_copy_of_the_body_stands_steps_of_changing_length() {
    // In a schedule that runs once per frame, all steps differ. The loop's copy of the body must
    // not be rebuilt for that.
    let mut s = scene_in(app_in(Update), true, true);
    s.hand.set_buttons(1);
    until(&mut s, "gripped", |s| grabs(&mut s.app).len() == 1);
    s.hand.set_target([0.02, 0.0, 0.0]);
    until(&mut s, "3 N", |s| (-3.3..-2.7).contains(&force(s).x));
}

#[test]
fn a_remote_body_that_turns_softer_is_felt_so() {
    let mut s = scene(false);
    let world = s.app.world_mut();
    let body = world.query_filtered::<Entity, With<ModalBody>>().single(world).unwrap();
    world.entity_mut(body).insert(pliant_body::Driven::Remote);
    let at = world.get::<Transform>(s.tool).unwrap().translation.as_dvec3();
    let hold = Grab { stiffness: Some(280.0), ..Grab::new(block::tip(), 0.01, at) };
    world.spawn((
        hold,
        pliant_body::GrabOf(body),
        HeldBy(s.tool),
        GrabForce { point: at, force: DVec3::ZERO },
    ));
    s.app.add_systems(PostUpdate, |mut shown: Query<&mut pliant_body::VisualState>| {
        for mut shown in &mut shown {
            let q = shown.current().to_vec();
            shown.snap(&q).unwrap();
        }
    });
    s.hand.set_target([0.01, 0.0, 0.0]);
    // The stiffness is the part of L / (E A) that four modes per axis leave out, in series with the
    // coupling and the arm. Friction may hold back 0.26 N.
    let left_out = |scale: f64| {
        let kept: f64 = (0..4).map(|k| 8.0 / (std::f64::consts::PI * f64::from(2 * k + 1)).powi(2)).sum();
        block::LENGTH / (scale * 1e5 * 0.0016) * (1.0 - kept)
    };
    let want = |scale: f64| -0.01 / (left_out(scale) + 1.0 / 280.0 + 1.0 / 500.0);
    let [stiff, soft] = [1.0, 1e-3].map(want);
    assert!((stiff / soft) > 3.0, "{stiff} and {soft} N");
    until(&mut s, "the stiff one", |s| (force(s).x - stiff).abs() < 0.3);
    s.app.world_mut().get_mut::<ModalBody>(body).unwrap().settings.stiffness_scale = 1e-3;
    until(&mut s, "the soft one", |s| (force(s).x - soft).abs() < 0.1);
}

#[test]
fn a_stop_holds_for_devices_that_come_later() {
    let mut s = scene(false);
    let devices = |s: &mut Scene| -> Vec<(LoopState, DVec3)> {
        let devices = s.app.world().resource::<HapticDevices>();
        devices.iter().map(|(_, d)| (d.report.state, d.report.tick.wrench.force.into())).collect()
    };
    assert!(!s.app.world().resource::<HapticDevices>().is_stopped());
    s.app.world().resource::<HapticDevices>().estop();
    let tip = *s.app.world().get::<Transform>(s.tool).unwrap();
    let (later, hand) = add_device(&mut s.app);
    let tool = s.app.world_mut().spawn((HapticTool::new(later), ToolGrip::default(), tip)).id();
    in_place(&mut s, tool);
    until(&mut s, "both are stopped", |s| devices(s).iter().all(|d| d.0 == LoopState::Stopped));
    hand.set_buttons(1);
    until(&mut s, "the later device holds the block", |s| grabs(&mut s.app).len() == 1);
    hand.set_target([0.02, 0.0, 0.0]);
    stays(&mut s, "stopped, old and new", |s| {
        devices(s).iter().all(|d| *d == (LoopState::Stopped, DVec3::ZERO))
    });
    s.app.world_mut().resource_mut::<HapticDevices>().reset_stop();
    assert!(!s.app.world().resource::<HapticDevices>().is_stopped());
    until(&mut s, "the later device gives its force", |s| devices(s)[1].1.length() > 1.0);
}

/// A device whose driver does not return while it is told so.
struct Stuck {
    inner: VirtualDevice,
    stuck: Arc<AtomicBool>,
}

impl HapticDevice for Stuck {
    fn info(&self) -> DeviceInfo {
        self.inner.info()
    }
    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        while self.stuck.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(1));
        }
        self.inner.exchange(wrench, scheduler)
    }
    fn safe_stop(&mut self) {
        self.inner.safe_stop();
    }
}

#[test]
fn a_stop_is_reset_for_all_devices_or_for_none() {
    let mut s = scene(false);
    let stuck = Arc::new(AtomicBool::new(false));
    let inner = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
    let device = Stuck { inner, stuck: stuck.clone() };
    let mut devices = s.app.world_mut().resource_mut::<HapticDevices>();
    let other = devices.add(device, machine::patient()).unwrap();
    let state = |s: &Scene, id| s.app.world().resource::<HapticDevices>().get(id).unwrap().report.state;
    until(&mut s, "both run", |s| [s.device, other].iter().all(|id| state(s, *id) == LoopState::Running));
    s.app.world().resource::<HapticDevices>().estop();
    until(&mut s, "both stop", |s| [s.device, other].iter().all(|id| state(s, *id) == LoopState::Stopped));
    stuck.store(true, Ordering::Relaxed);
    let mut devices = s.app.world_mut().resource_mut::<HapticDevices>();
    while devices.set_recording(other, true) {}
    devices.reset_stop();
    assert!(devices.is_stopped());
    // The other loop goes on and stays stopped.
    let ticks = |s: &Scene| s.app.world().resource::<HapticDevices>().get(s.device).unwrap().report.ticks;
    let begun = ticks(&s);
    until(&mut s, "periods of the other loop", |s| {
        assert_eq!(state(s, s.device), LoopState::Stopped);
        ticks(s) >= begun + 400
    });
    stuck.store(false, Ordering::Relaxed);
    let returned = |s: &Scene| s.app.world().resource::<HapticDevices>().get(other).unwrap().report.ticks;
    let stood = returned(&s);
    until(&mut s, "the driver returns", |s| returned(s) >= stood + 10);
    assert_eq!(state(&s, other), LoopState::Stopped);
    s.app.world_mut().resource_mut::<HapticDevices>().reset_stop();
    until(&mut s, "both run again", |s| {
        [s.device, other].iter().all(|id| state(s, *id) == LoopState::Running)
    });
}

#[test]
fn a_remote_body_is_felt_through_its_published_force_until_the_network_is_gone() {
    let mut s = scene(false);
    let world = s.app.world_mut();
    let body = world.query_filtered::<Entity, With<ModalBody>>().single(world).unwrap();
    world.entity_mut(body).insert(pliant_body::Driven::Remote);
    let at = world.get::<Transform>(s.tool).unwrap().translation.as_dvec3();
    let hold = Grab { stiffness: Some(280.0), ..Grab::new(block::tip(), 0.01, at) };
    let grab = world.spawn((hold, pliant_body::GrabOf(body), HeldBy(s.tool))).id();
    // The test writes what a session would write: the patch stays where it is, and a state comes
    // every frame.
    let known = GrabForce { point: at, force: DVec3::ZERO };
    world.entity_mut(grab).insert(known);
    #[derive(Resource)]
    struct Network(bool);
    s.app.insert_resource(Network(true)).insert_resource(ReceivedFaults::default());
    s.app.add_systems(
        PostUpdate,
        |network: Res<Network>, mut shown: Query<&mut pliant_body::VisualState>| {
            for mut shown in shown.iter_mut().filter(|_| network.0) {
                let q = shown.current().to_vec();
                shown.snap(&q).unwrap();
            }
        },
    );
    s.app.add_systems(
        Update,
        |mut faults: MessageReader<HapticFault>, mut received: ResMut<ReceivedFaults>| {
            received.0.extend(faults.read().filter_map(|f| f.fault));
        },
    );
    s.hand.set_target([0.01, 0.0, 0.0]);
    // The coupling (280 N/m) and the arm (500 N/m) are in series over 1 cm. The compliance of the
    // patch itself is a hundredth of that. Friction may hold back 0.26 N.
    let want = -0.01 / (1.0 / 280.0 + 1.0 / 500.0);
    until(&mut s, "the coupling's force", |s| (force(s).x - want).abs() < 0.3);
    let target = s.app.world().get::<Grab>(grab).unwrap().target;
    assert!(target.x > at.x + 1e-3, "and the session is told where the hand is: {target}");
    // Until the session knows the grab, and after the session is over, the force is unknown. The
    // default value must not count as a patch at the origin.
    s.app.world_mut().entity_mut(grab).insert(GrabForce::default());
    stays(&mut s, "no more than before", |s| force(s).length() < 2.5);
    until(&mut s, "let go", |s| force(s) == DVec3::ZERO);
    s.app.world_mut().entity_mut(grab).insert(known);
    until(&mut s, "held again", |s| (force(s).x - want).abs() < 0.3);
    s.app.world_mut().resource_mut::<ReceivedFaults>().0.clear();
    s.app.world_mut().resource_mut::<Network>().0 = false;
    until(&mut s, "nothing new comes: the force fades", |s| {
        let received = &s.app.world().resource::<ReceivedFaults>().0;
        received.iter().any(|f| matches!(f, Fault::Stale(_))) && force(s) == DVec3::ZERO
    });
    stays(&mut s, "and stays away", |s| force(s) == DVec3::ZERO);
    s.app.world_mut().resource_mut::<Network>().0 = true;
    until(&mut s, "it comes back", |s| (force(s).x - want).abs() < 0.3);
}

#[test]
fn two_devices_on_one_body_feel_each_other() {
    let mut s = scene(false);
    let at = s.app.world().get::<Transform>(s.tool).unwrap().translation;
    let (other, second) = add_device(&mut s.app);
    let place = Transform::from_translation(at);
    let tool = s.app.world_mut().spawn((HapticTool::new(other), ToolGrip::default(), place)).id();
    in_place(&mut s, tool);
    s.hand.set_buttons(1);
    second.set_buttons(1);
    until(&mut s, "both hold it", |s| grabs(&mut s.app).len() == 2);
    let devices = |s: &Scene| {
        let devices = s.app.world().resource::<HapticDevices>();
        [s.device, other].map(|id| DVec3::from(devices.get(id).unwrap().report.tick.wrench.force))
    };
    // One hand drags the block. The other hand holds still and is pulled along: its force is
    // opposite, less the part that the block's own 1600 N/m takes.
    s.hand.set_target([0.02, 0.0, 0.0]);
    until(&mut s, "the still hand is pulled toward the one that pulls", |s| {
        let [puller, holder] = devices(s);
        puller.x < -1.0 && holder.x > 0.2
    });
    // The first hand releases the block, and the other one then holds it alone.
    s.hand.set_buttons(0);
    until(&mut s, "alone", |s| grabs(&mut s.app).len() == 1 && devices(s)[1].length() < 0.3);
}

#[test]
fn a_hand_that_has_let_go_is_no_longer_in_the_loops_copy_of_the_body() {
    // The friction of a Touch would hold the tool where it is against up to 0.26 N.
    let mut s = scene_on(VirtualConfig { friction: 0.0, ..VirtualConfig::touch() }, app(), true, false);
    s.hand.set_buttons(1);
    until(&mut s, "the button grips what is in reach", |s| grabs(&mut s.app).len() == 1);
    stays(&mut s, "nobody pulls", |s| force(s).length() < 0.05);
    // Another hand pulls the middle of the block, and the tool feels it.
    let body = s.app.world_mut().query_filtered::<Entity, With<ModalBody>>().single(s.app.world()).unwrap();
    let middle = block::tip() / 2;
    let surface = block::block(1e5, 12).surface().positions()[middle as usize];
    let target = Vec3::from(surface).as_dvec3() + DVec3::new(0.01, 0.0, 0.0);
    let other = s.app.world_mut().spawn((Grab::new(middle, 0.01, target), GrabOf(body))).id();
    until(&mut s, "the other hand is felt", |s| force(s).x > 0.5);
    s.app.world_mut().despawn(other);
    // The block swings back first.
    let mut quiet = 0;
    until(&mut s, "its old target pulls no more", |s| {
        quiet = if force(s).length() < 0.05 { quiet + 1 } else { 0 };
        quiet > 30
    });
}

#[test]
fn a_driver_that_panics_is_told_and_lets_go() {
    struct Bomb(VirtualDevice, std::sync::Arc<std::sync::atomic::AtomicBool>);
    impl pliant_haptics::HapticDevice for Bomb {
        fn info(&self) -> pliant_haptics::DeviceInfo {
            self.0.info()
        }
        fn exchange(
            &mut self,
            wrench: &pliant_haptics::Wrench,
            scheduler: &mut dyn pliant_haptics::Scheduler,
        ) -> Result<pliant_haptics::Sample, Fault> {
            assert!(!self.1.load(std::sync::atomic::Ordering::Acquire), "the driver's own bug, on purpose");
            self.0.exchange(wrench, scheduler)
        }
        fn safe_stop(&mut self) {
            self.0.safe_stop();
        }
    }
    #[derive(Resource, Default)]
    struct Notices(Vec<pliant_haptics::LoopEvent>);
    let mut s = scene(false);
    let at = *s.app.world().get::<Transform>(s.tool).unwrap();
    s.app.world_mut().despawn(s.tool);
    let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
    let (hand, fuse) = (device.handle(), std::sync::Arc::default());
    let bomb = Bomb(device, std::sync::Arc::clone(&fuse));
    s.device = s.app.world_mut().resource_mut::<HapticDevices>().add(bomb, machine::patient()).unwrap();
    s.tool = s.app.world_mut().spawn((HapticTool::new(s.device), ToolGrip::default(), at)).id();
    s.app.init_resource::<ReceivedFaults>().init_resource::<Notices>();
    s.app.add_systems(
        Update,
        |mut faults: MessageReader<HapticFault>,
         mut notices: MessageReader<HapticNotice>,
         mut received: ResMut<ReceivedFaults>,
         mut ends: ResMut<Notices>| {
            received.0.extend(faults.read().filter_map(|f| f.fault));
            ends.0.extend(notices.read().map(|n| n.event));
        },
    );
    let tool = s.tool;
    in_place(&mut s, tool);
    hand.set_buttons(1);
    until(&mut s, "gripped", |s| grabs(&mut s.app).len() == 1);
    hand.set_target([0.02, 0.0, 0.0]);
    until(&mut s, "a force", |s| force(s).length() > 1.0);
    fuse.store(true, std::sync::atomic::Ordering::Release);
    until(&mut s, "the body is let go of", |s| grabs(&mut s.app).is_empty());
    let count = |world: &World| {
        world.resource::<ReceivedFaults>().0.iter().filter(|f| **f == Fault::Panicked).count()
    };
    let state = |s: &Scene| s.app.world().resource::<HapticDevices>().get(s.device).unwrap().report.state;
    until(&mut s, "the end is told", |s| {
        let world = s.app.world();
        state(s) == LoopState::Ended && count(world) > 0 && !world.resource::<Notices>().0.is_empty()
    });
    s.run(5);
    assert_eq!((state(&s), force(&s)), (LoopState::Ended, DVec3::ZERO));
    assert_eq!(count(s.app.world()), 1, "told once");
    assert_eq!(s.app.world().resource::<Notices>().0, [pliant_haptics::LoopEvent::Lost]);
    // The app continues, and a new device replaces the dead one.
    assert!(s.app.world_mut().resource_mut::<HapticDevices>().remove(s.device));
    let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
    s.device = s.app.world_mut().resource_mut::<HapticDevices>().add(device, LoopConfig::default()).unwrap();
    until(&mut s, "another one runs", |s| {
        let devices = s.app.world().resource::<HapticDevices>();
        devices.get(s.device).unwrap().report.state == LoopState::Running
    });
}

/// A ball that begins where a loop says that does not know its workspace yet is caught in what lies
/// there.
#[test]
fn a_ball_begins_where_its_tool_is_and_anew_where_the_workspace_jumps() {
    let mut app = app();
    let (device, hand) = add_device(&mut app);
    let mut s = Scene { app, device, tool: Entity::PLACEHOLDER, hand, frames: 0, uneven: false };
    until(&mut s, "the loop runs", |s| {
        s.app.world().resource::<HapticDevices>().get(device).unwrap().report.ticks > 100
    });
    let tool = (HapticTool::new(device), ToolTouch::default(), Transform::from_xyz(0.0, 0.3, 0.0));
    s.tool = s.app.world_mut().spawn(tool).id();
    let probe = |s: &Scene| *s.app.world().get::<TouchProbe>(s.tool).unwrap();
    until(&mut s, "the ball is there", |s| {
        let TouchProbe { enabled, target, .. } = probe(s);
        assert!(!enabled || (target.y - 0.3).abs() < 0.1, "it begins at {target}");
        enabled
    });
    s.app.world_mut().get_mut::<Transform>(s.tool).unwrap().translation.y = 0.6;
    let mut gone = false;
    until(&mut s, "the ball is at the new place", |s| {
        let TouchProbe { enabled, target, .. } = probe(s);
        gone |= !enabled;
        assert!(!gone || !enabled || (target.y - 0.6).abs() < 0.1, "it begins anew at {target}");
        enabled && (target.y - 0.6).abs() < 0.1
    });
    assert!(gone, "the ball was dragged along");
}
