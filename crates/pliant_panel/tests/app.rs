//! Tests of the panel in an app: presses and moves of its controls, found by their accessible
//! names, change components and resources.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a failed test should panic")]

use std::{
    fmt::Debug,
    time::{Duration, Instant},
};

use bevy::{
    asset::AssetPlugin, prelude::*, time::TimeUpdateStrategy, transform::TransformPlugin,
    window::ExitCondition,
};
use bevy_egui::{
    EguiContext, EguiContextSettings, EguiPrimaryContextPass, PrimaryEguiContext,
    egui::{self, Key, accesskit::Role},
};
use egui_kittest::{
    Harness,
    kittest::{NodeT, Queryable},
};
use pliant_body::{BodyState, Driven, Grab, GrabOf, ModalBody, PliantBodyPlugin, PliantTick};
use pliant_panel::{Panel, PanelPlugin, PanelRecording, recording::RecordingView};

type Shown = Harness<'static, App>;

/// Time limit for all waits. Only a failure takes longer.
const LIMIT: Duration = Duration::from_secs(60);

/// Calls `look` until it succeeds. `look` advances by a frame, and its error says what it saw
/// instead.
#[track_caller]
fn until<L: Debug>(what: &str, mut look: impl FnMut() -> Result<(), L>) {
    let begun = Instant::now();
    while let Err(seen) = look() {
        assert!(begun.elapsed() < LIMIT, "not in {LIMIT:?}: {what}; the last was {seen:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Returns an app without a window, with frames of a hundredth of a second, Pip, and the open
/// panel.
fn app(more: impl FnOnce(&mut App)) -> App {
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin { file_path: concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets").into(), ..default() },
        bevy::input::InputPlugin,
        bevy::window::WindowPlugin {
            primary_window: None,
            exit_condition: ExitCondition::DontExit,
            ..default()
        },
        bevy::image::ImagePlugin::default(),
        TransformPlugin,
    ))
    .init_asset::<bevy::shader::Shader>()
    .add_plugins((PliantBodyPlugin::default(), PanelPlugin::default()))
    .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_millis(10)))
    .insert_resource(Time::<Fixed>::from_hz(100.0));
    more(&mut app);
    app.finish();
    app.cleanup();
    let context = EguiContextSettings { run_manually: true, ..default() };
    app.world_mut().spawn((PrimaryEguiContext, context));
    let pip = app.world().resource::<AssetServer>().load("pip.modal");
    app.world_mut().spawn((ModalBody::new(pip), Name::new("pip")));
    until("the body is read", || {
        app.update();
        find::<BodyState>(&mut app).map(drop).ok_or("no body")
    });
    app
}

fn find<C: Component>(app: &mut App) -> Option<Entity> {
    let world = app.world_mut();
    world.query_filtered::<Entity, With<C>>().iter(world).next()
}

/// Shows the panel on a bare egui context. Each frame of the context is a frame of the app.
fn show(app: App) -> Shown {
    sized(app, [420.0, 2400.0])
}

fn sized(app: App, size: [f32; 2]) -> Shown {
    Harness::builder().with_size(size).with_max_steps(16).build_ui_state(
        |ui, app: &mut App| {
            app.update();
            let world = app.world_mut();
            let mut contexts = world.query::<&mut EguiContext>();
            *contexts.single_mut(world).unwrap().get_mut() = ui.ctx().clone();
            world.run_schedule(EguiPrimaryContextPass);
        },
        app,
    )
}

fn click(shown: &mut Shown, name: &str) {
    shown.get_by_label(name).click();
    shown.run_steps(3);
}

fn nudge(shown: &mut Shown, name: &str, key: Key) {
    shown.get_by_role_and_label(Role::Slider, name).focus();
    shown.run_steps(2);
    shown.key_press(key);
    shown.run_steps(3);
}

fn body(shown: &mut Shown) -> (ModalBody, usize) {
    let app = shown.state_mut();
    let entity = find::<ModalBody>(app).unwrap();
    let world = app.world();
    (
        world.get::<ModalBody>(entity).unwrap().clone(),
        world.get::<BodyState>(entity).unwrap().body().mode_count(),
    )
}

fn settings(body: &ModalBody) -> (Option<usize>, f64, f64, bool) {
    (body.modes, body.settings.stiffness_scale, body.settings.damping_scale, body.settings.warp)
}

#[test]
fn a_bodys_knobs_change_the_body_and_only_when_they_are_moved() {
    let mut app = app(|_| {});
    let entity = find::<ModalBody>(&mut app).unwrap();
    // The values are beyond the range of the sliders and between the decimals that they show.
    let mut odd = app.world_mut().get_mut::<ModalBody>(entity).unwrap();
    (odd.settings.damping_scale, odd.settings.stiffness_scale) = (20.0, 1.0 / 3.0);
    let mut shown = show(app);
    for _ in 0..40 {
        shown.key_press(Key::Tab);
        shown.run_steps(2);
    }
    let (untouched, all) = body(&mut shown);
    assert_eq!(settings(&untouched), (None, 1.0 / 3.0, 20.0, true), "looked at, and tabbed through");

    nudge(&mut shown, "modes", Key::ArrowLeft);
    let (fewer, kept) = body(&mut shown);
    assert_eq!((fewer.modes, kept), (Some(all - 1), all - 1));
    nudge(&mut shown, "modes", Key::ArrowRight);
    assert_eq!((body(&mut shown).0.modes, body(&mut shown).1), (None, all));
    nudge(&mut shown, "stiffness", Key::ArrowRight);
    assert!(body(&mut shown).0.settings.stiffness_scale > 1.0 / 3.0);
    nudge(&mut shown, "damping", Key::ArrowLeft);
    assert!(body(&mut shown).0.settings.damping_scale <= 10.0, "once it is moved it is within its range");
    click(&mut shown, "modal warping");
    assert!(!body(&mut shown).0.settings.warp);
}

#[test]
fn let_go_takes_off_what_is_held_here_and_wake_wakes() {
    let mut app = app(|_| {});
    let pip = find::<ModalBody>(&mut app).unwrap();
    let at = {
        let state = app.world().get::<BodyState>(pip).unwrap();
        Vec3::from(state.model().surface().positions()[0]).as_dvec3()
    };
    app.world_mut().spawn((Name::new("a hand"), Grab::new(0, 0.02, at), GrabOf(pip)));
    let mut shown = show(app);
    assert!(shown.query_by_label_contains("a hand: ").is_some());
    click(&mut shown, "Let go");
    assert!(find::<Grab>(shown.state_mut()).is_none());
    assert!(shown.query_by_label("Let go").is_none());
    let rests = (0..3000).any(|_| {
        shown.state_mut().update();
        shown.state().world().get::<BodyState>(pip).unwrap().is_resting()
    });
    assert!(rests, "there is something to wake");
    shown.run_steps(2);
    click(&mut shown, "Pause");
    click(&mut shown, "Wake");
    assert!(!shown.state().world().get::<BodyState>(pip).unwrap().is_resting());
    // The panel must not change a remote body.
    shown.state_mut().world_mut().entity_mut(pip).insert(Driven::Remote);
    shown.run_steps(2);
    assert!(shown.get_by_role_and_label(Role::Slider, "modes").accesskit_node().is_disabled());
}

#[test]
fn time_stands_goes_on_by_one_step_and_runs_slower() {
    let mut app = app(|_| {});
    app.world_mut().resource_mut::<Time<Virtual>>().set_relative_speed(8.0);
    let mut shown = show(app);
    let speed = |shown: &Shown| shown.state().world().resource::<Time<Virtual>>().relative_speed_f64();
    let tick = |shown: &Shown| shown.state().world().resource::<PliantTick>().0;
    assert_eq!(speed(&shown), 8.0, "faster than its slider goes, and left so");
    click(&mut shown, "Pause");
    assert!(shown.state().world().resource::<Time<Virtual>>().is_paused());
    let before = tick(&shown);
    shown.run_steps(5);
    assert_eq!(tick(&shown), before);
    click(&mut shown, "Step");
    shown.run_steps(5);
    assert_eq!(tick(&shown), before + 1);
    nudge(&mut shown, "speed", Key::ArrowLeft);
    assert!(speed(&shown) < 4.0 + 1e-9);
    click(&mut shown, "Run");
    shown.run_steps(5);
    assert!(tick(&shown) > before + 1);
    click(&mut shown, "Step");
    assert!(shown.state().world().resource::<Time<Virtual>>().is_paused(), "a step stops the time first");
}

#[test]
fn the_focus_goes_from_top_to_bottom_through_every_part() {
    let mut shown = show(app(|_| {}));
    let mut order = Vec::new();
    for _ in 0..40 {
        shown.key_press(Key::Tab);
        shown.run_steps(2);
        let names = ["Pause", "Step", "speed", "modes", "stiffness", "damping", "modal warping"];
        for name in names {
            let here = shown.query_all_by_label(name).any(|node| node.is_focused());
            if here && !order.contains(&name) {
                order.push(name);
            }
        }
    }
    assert_eq!(order, ["Pause", "Step", "speed", "modes", "stiffness", "damping", "modal warping"]);
}

#[test]
fn it_fits_the_screen_at_any_scale_and_is_gone_when_it_is_closed() {
    for (size, zoom) in [([1280.0, 720.0], 1.0), ([640.0, 360.0], 1.0), ([1280.0, 720.0], 2.0)] {
        let mut app = app(|_| {});
        app.world_mut().resource_mut::<Panel>().zoom = zoom;
        let mut shown = sized(app, size);
        shown.run_steps(8);
        assert_eq!(shown.ctx.zoom_factor(), zoom);
        let window = shown.ctx.memory(|memory| {
            let windows = memory.areas().visible_layer_ids().into_iter();
            windows
                .filter(|layer| layer.order == egui::Order::Middle)
                .find_map(|layer| memory.area_rect(layer.id))
        });
        let window = window.unwrap();
        let screen = shown.ctx.content_rect();
        assert!(screen.contains_rect(window), "{window:?} in {screen:?} at {size:?}, zoom {zoom}");
        assert!(window.width() > 250.0 && window.height() > 100.0, "{window:?}");
    }
    let mut shown = show(app(|_| {}));
    let key = |shown: &mut Shown| {
        let mut keys = shown.state_mut().world_mut().resource_mut::<ButtonInput<KeyCode>>();
        keys.release(KeyCode::F1);
        keys.press(KeyCode::F1);
        // The press belongs to the frame that the app runs here, because the app's own input starts
        // each frame by clearing itself.
        shown.state_mut().world_mut().run_schedule(Update);
        shown.run_steps(4);
    };
    assert!(shown.query_by_label("Pause").is_some());
    key(&mut shown);
    assert!(!shown.state().world().resource::<Panel>().open);
    assert!(shown.query_by_label("Pause").is_none() && shown.query_by_label("Pliant").is_none());
    key(&mut shown);
    assert!(shown.query_by_label("Pause").is_some());
}

#[test]
fn a_recording_has_a_section_and_its_knobs_change_it() {
    let recording = RecordingView { on: true, sinks: 1, shapes_hz: f64::INFINITY, ..default() };
    let mut shown = show(app(|app| {
        app.insert_resource(PanelRecording(recording.clone()));
    }));
    let now = |shown: &Shown| shown.state().world().resource::<PanelRecording>().0.clone();
    shown.run_steps(10);
    assert_eq!(now(&shown), recording, "looked at, and left as it is");
    click(&mut shown, "record");
    assert!(!now(&shown).on);
    nudge(&mut shown, "shapes a second", Key::ArrowLeft);
    assert!(now(&shown).shapes_hz <= 60.0);
    nudge(&mut shown, "bars a second", Key::ArrowRight);
    assert!(now(&shown).modes_hz > 0.0);
    click(&mut shown, "color by stress");
    assert!(now(&shown).stress);
}

#[cfg(feature = "contact")]
#[test]
fn a_ball_that_presses_a_body_is_told_with_its_force_and_when_it_has_gone() {
    use pliant_contact::{BodyContacts, ContactPlugin, Obstacle};
    let mut app = app(|app| {
        app.add_plugins(ContactPlugin::default());
    });
    let entity = find::<BodyState>(&mut app).unwrap();
    let surface = app.world().get::<BodyState>(entity).unwrap().model().surface();
    let top = surface.positions().iter().copied().max_by(|a, b| a[1].total_cmp(&b[1])).unwrap();
    let mut shown = show(app);
    shown.run_steps(3);
    assert!(shown.query_by_label_contains("contacts:").is_none());
    let ball = Obstacle::Ball { radius: 0.05 };
    let at = Transform::from_translation(Vec3::from(top) + Vec3::Y * 0.02);
    let ball = shown.state_mut().world_mut().spawn((ball, at)).id();
    until("the ball's force is told", || {
        shown.run_steps(1);
        let world = shown.state().world();
        let force = world.get::<BodyContacts>(entity).map_or(0.0, |all| all.force().length());
        let told = shown.query_by_label_contains("contacts:").is_some();
        if told && force > 0.01 { Ok(()) } else { Err((told, force)) }
    });
    shown.state_mut().world_mut().despawn(ball);
    until("the ball has gone", || {
        shown.run_steps(1);
        shown.query_by_label_contains("contacts: 0 ").map(drop).ok_or("it touches")
    });
}

#[cfg(feature = "haptics")]
#[test]
fn the_stop_and_the_force_of_a_device_are_its_own() {
    use pliant_haptics::{
        HandModel, HapticDevices, HapticTool, HapticsPlugin, LoopConfig, VirtualConfig, VirtualDevice,
    };

    let mut app = app(|app| {
        app.add_plugins(HapticsPlugin::default());
    });
    let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
    let device = app.world_mut().resource_mut::<HapticDevices>().add(device, LoopConfig::default()).unwrap();
    let tool = HapticTool { force_scale: 2.0, ..HapticTool::new(device) };
    let tool = app.world_mut().spawn((tool, Transform::default())).id();
    let mut shown = show(app);
    let stopped = |shown: &Shown| shown.state().world().resource::<HapticDevices>().is_stopped();
    let scale = |shown: &Shown| shown.state().world().get::<HapticTool>(tool).unwrap().force_scale;
    shown.run_steps(5);
    assert!(!stopped(&shown) && scale(&shown) == 2.0, "looked at, and left as it is");
    click(&mut shown, "STOP");
    assert!(stopped(&shown));
    // Another device connects, and the only stopped device disconnects. The stop stays latched, and
    // can be pressed and released.
    let later = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
    let mut devices = shown.state_mut().world_mut().resource_mut::<HapticDevices>();
    devices.add(later, LoopConfig::default()).unwrap();
    shown.run_steps(3);
    click(&mut shown, "STOP");
    click(&mut shown, "Release the stop");
    assert!(!stopped(&shown));
    nudge(&mut shown, "force", Key::ArrowLeft);
    assert!(scale(&shown) <= 1.0);
}

#[cfg(feature = "net")]
mod session {
    use pliant_net::{
        Emulation, GuestState, HostConfig, JoinConfig, NetGuest, NetHost, NetPeer, NetPlugin, PeerConfig,
        SessionState, emulator::Preset,
    };

    use super::*;

    fn choose(shown: &mut Shown, name: &str) {
        shown.get_by_role(Role::ComboBox).click();
        shown.run_steps(3);
        let all: Vec<_> = shown.query_all_by_label(name).collect();
        all.last().unwrap().click();
        drop(all);
        shown.run_steps(3);
    }

    #[test]
    fn the_emulated_network_is_the_hosts_and_stays_what_it_is_until_a_knob_is_moved() {
        let net = NetPlugin::host(HostConfig::default()).unwrap();
        let mut shown = show(app(|app| {
            app.add_plugins(net);
        }));
        let emulation = |shown: &Shown| shown.state().world().resource::<NetHost>().emulation();
        assert_eq!(emulation(&shown), None);
        for preset in Preset::ALL {
            let put_in = Emulation::preset(preset, 99);
            shown.state().world().resource::<NetHost>().set_emulation(Some(put_in.clone()));
            shown.run_steps(4);
            assert_eq!(emulation(&shown), Some(put_in), "{}: looked at", preset.name());
        }
        choose(&mut shown, "wifi");
        assert_eq!(emulation(&shown), Some(Emulation::preset(Preset::Wifi, 99)));
        choose(&mut shown, "other");
        assert_eq!(emulation(&shown), Some(Emulation::preset(Preset::Wifi, 99)), "with all its knobs");
        nudge(&mut shown, "% twice", Key::ArrowRight);
        let doubled = emulation(&shown).unwrap();
        assert!(doubled.outgoing.duplicate > 0.0 && doubled.incoming.duplicate > 0.0, "{doubled:?}");
        choose(&mut shown, "lan");
        nudge(&mut shown, "ms round trip", Key::ArrowRight);
        assert!(emulation(&shown).unwrap().outgoing.delay > Duration::from_micros(200));
        assert!(
            shown.query_by_role_and_label(Role::Slider, "Mbit/s").is_some(),
            "moved away from its preset"
        );
        choose(&mut shown, "none");
        assert_eq!(emulation(&shown), None);
        click(&mut shown, "End the session");
        shown.run_steps(3);
        assert!(shown.state().world().get_resource::<NetHost>().is_none());
        assert!(shown.query_by_label("End the session").is_none());
    }

    #[test]
    fn a_guest_leaves() {
        let host = NetPlugin::host(HostConfig::default()).unwrap();
        let invite = host.invite().unwrap().clone();
        let mut host = app(|app| {
            app.add_plugins(host);
        });
        let guest = NetPlugin::join(&invite, JoinConfig::default()).unwrap();
        let mut shown = show(app(|app| {
            app.add_plugins(guest);
        }));
        let state = |shown: &Shown| shown.state().world().resource::<NetGuest>().state().clone();
        until("the guest is in", || {
            host.update();
            shown.run_steps(1);
            if matches!(state(&shown), GuestState::In { .. }) { Ok(()) } else { Err(state(&shown)) }
        });
        click(&mut shown, "Leave");
        shown.run_steps(3);
        assert_eq!(session(&shown), SessionState::Idle);
        assert!(shown.state().world().get_resource::<NetGuest>().is_none());
        assert!(shown.query_by_label("Leave").is_none());
    }

    #[test]
    fn a_peer_leaves() {
        let peer = NetPlugin::peer(PeerConfig::default()).unwrap();
        let mut shown = show(app(|app| {
            app.add_plugins(peer);
        }));
        shown.run_steps(3);
        // Without a body the first peer waits for one.
        assert_eq!(session(&shown), SessionState::Joining);
        click(&mut shown, "Leave");
        shown.run_steps(3);
        assert_eq!(session(&shown), SessionState::Idle);
        assert!(shown.state().world().get_resource::<NetPeer>().is_none());
        assert!(shown.query_by_label("Leave").is_none());
    }

    fn session(shown: &Shown) -> SessionState {
        *shown.state().world().resource::<SessionState>()
    }
}
