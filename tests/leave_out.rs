//! Tests that unused parts of a scene cost nothing.
//!
//! A plugin that is left out adds no system. A body that nothing touches causes no step, state,
//! message or mesh.

use std::{path::PathBuf, time::Duration};

use bevy::{
    diagnostic::DiagnosticsStore, ecs::schedule::Schedules, prelude::*, time::TimeUpdateStrategy,
    transform::TransformPlugin,
};
use pliant::{
    body::{AWAKE_BODIES, PointerGrabPlugin, STEP_TIME},
    modal::ModalModel,
    prelude::*,
};

fn engine() -> App {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin))
        .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_secs_f64(1.0 / 60.0)))
        .insert_resource(Time::<Fixed>::from_hz(60.0));
    app
}

fn ready(app: &mut App) {
    app.finish();
    app.cleanup();
    app.update();
}

/// Returns the number of systems in all schedules after one frame.
fn systems(mut app: App) -> usize {
    ready(&mut app);
    app.world().resource::<Schedules>().iter().map(|(_, schedule)| schedule.systems_len()).sum()
}

fn with(plugins: impl FnOnce(&mut App)) -> usize {
    let mut app = engine();
    plugins(&mut app);
    systems(app)
}

/// Counts what each plugin adds to the engine, whatever features are compiled.
#[test]
fn each_plugin_brings_its_own_systems_and_no_other() {
    let none = systems(engine());
    assert_eq!(none, systems(engine()), "counting is repeatable");
    let body = with(|app| {
        app.add_plugins(PliantBodyPlugin::default());
    }) - none;
    // The count was 19 with the plugin's messages and assets; the range allows a few more.
    assert!((10..=24).contains(&body), "{body} systems of the body plugin");
    let riding = with(|app| {
        app.add_plugins((PliantBodyPlugin::default(), RidingPlugin::default()));
    });
    assert!((1..=8).contains(&(riding - none - body)), "{} systems of what rides", riding - none - body);
    let pointer = with(|app| {
        app.add_plugins((PliantBodyPlugin::default(), PointerGrabPlugin));
    });
    assert!((1..=6).contains(&(pointer - none - body)), "{} systems of the pointer", pointer - none - body);
    #[cfg(feature = "contact")]
    {
        use pliant::contact::ContactPlugin;
        let touching = with(|app| {
            app.add_plugins((PliantBodyPlugin::default(), ContactPlugin::default()));
        });
        let contact = touching - none - body;
        // Two of the engine's keep the assets of distance fields. Six more are for avian's
        // colliders and attachments, which do not run without avian.
        let most = if cfg!(feature = "contact-avian") { 4 + 2 + 6 } else { 4 + 2 };
        assert!((1..=most).contains(&contact), "{contact} systems of the contacts");
    }
    #[cfg(feature = "net")]
    {
        use pliant::net::{HostConfig, NetPlugin};
        let host = |app: &mut App| {
            app.add_plugins((PliantBodyPlugin::default(), NetPlugin::host(HostConfig::default()).unwrap()));
        };
        let net = with(host) - none - body;
        assert!((1..=12).contains(&net), "{net} systems of the network");
    }
    #[cfg(feature = "haptics")]
    {
        let felt = with(|app| {
            app.add_plugins((PliantBodyPlugin::default(), HapticsPlugin::default()));
        });
        assert!(
            (1..=20).contains(&(felt - none - body)),
            "{} systems of the device layer",
            felt - none - body
        );
    }
}

/// Tests that a resting body is not stepped and no component of it written for ten seconds, and
/// that a touch wakes it.
#[test]
fn a_body_at_rest_takes_no_step_and_changes_nothing() {
    let mut app = engine();
    app.add_plugins(PliantPlugins::default());
    ready(&mut app);
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal");
    let model = ModalAsset::from(ModalModel::read(path).unwrap());
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(model);
    let body = app.world_mut().spawn(ModalBody::new(handle)).id();
    let frames = |app: &mut App, count: usize| (0..count).for_each(|_| app.update());
    frames(&mut app, 120);
    let steps = |app: &App| {
        let store = app.world().resource::<DiagnosticsStore>();
        (store.get(&AWAKE_BODIES).unwrap().value().unwrap(), store.get(&STEP_TIME).unwrap().history_len())
    };
    let last = |app: &mut App| {
        let world = app.world_mut();
        let mut query =
            world.query::<(Ref<BodyState>, Ref<VisualState>, Ref<Transform>, Ref<GlobalTransform>)>();
        let (state, shown, place, seen) = query.get(world, body).unwrap();
        [state.last_changed(), shown.last_changed(), place.last_changed(), seen.last_changed()]
            .map(|t| t.get())
    };
    let (before, timed) = (last(&mut app), steps(&app).1);
    frames(&mut app, 600);
    assert_eq!(last(&mut app), before, "no component of a resting body is written");
    assert_eq!(steps(&app), (0.0, timed), "no body was awake and no step was timed");
    app.world_mut().write_message(Impulse {
        body,
        vertex: 0,
        impulse: bevy::math::DVec3::new(0.0, 0.01, 0.0),
    });
    frames(&mut app, 3);
    assert_ne!(last(&mut app), before);
    assert_eq!(steps(&app).0, 1.0);
}
