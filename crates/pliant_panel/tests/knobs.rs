//! Tests of every knob: it is pressed and moved by its accessible name, on a bare egui context.
#![allow(clippy::unwrap_used, missing_docs, reason = "a failed test should panic")]

use bevy_egui::egui::{self, Key, accesskit::Role};
use egui_kittest::{
    Harness,
    kittest::{NodeT, Queryable},
};
use pliant_body::StepSettings;
use pliant_panel::{
    bodies::{self, BodyView, ContactView, HandView},
    device::{self, DeviceView, DevicesView},
    network::{self, EmulatorView, NetworkView, UserView},
    recording::{self, RecordingView},
    time::{self, TimeView},
};

fn body() -> BodyView {
    BodyView {
        name: "pip".into(),
        modes: 20,
        all_modes: 30,
        lowest_hz: 3.5,
        settings: StepSettings::default(),
        local: true,
        resting: true,
        energy: 0.12,
        ..Default::default()
    }
}

/// Presses `key` on the slider called `name`.
fn nudge<S>(harness: &mut Harness<'_, S>, name: &str, key: Key) {
    harness.get_by_role_and_label(Role::Slider, name).focus();
    harness.run();
    harness.key_press(key);
    harness.run();
}

#[test]
fn time_is_paused_run_stepped_and_slowed() {
    let time = TimeView { speed: 1.0, step: 0.025, tick: 7, ..Default::default() };
    let mut harness = Harness::new_ui_state(|ui, time: &mut TimeView| time::show(ui, time), time);
    harness.get_by_label("Pause").click();
    harness.run();
    assert!(harness.state().paused && !harness.state().step_once);
    harness.get_by_label("Run").click();
    harness.run();
    assert!(!harness.state().paused);
    harness.get_by_label("Step").click();
    harness.run();
    assert!(harness.state().paused && harness.state().step_once, "a step stops the clock first");
    nudge(&mut harness, "speed", Key::ArrowLeft);
    assert!(harness.state().speed < 1.0);
}

#[test]
fn a_body_tells_its_elasticity_and_what_a_step_takes() {
    let views = |material: &str, step_us| vec![BodyView { material: material.into(), step_us, ..body() }];
    let shown = |views| Harness::new_ui_state(|ui, views: &mut Vec<BodyView>| bodies::show(ui, views), views);
    let linear = shown(views("", None));
    assert!(linear.query_by_label("linear elasticity").is_some());
    assert!(linear.query_by_label_contains("a step").is_none(), "nobody steps it here");
    let reduced = shown(views("neo-hookean", Some(52.4)));
    assert!(reduced.query_by_label_contains("reduced elasticity, neo-hookean").is_some());
    assert!(reduced.query_by_label_contains("52.4 \u{b5}s a step").is_some());
}

#[test]
fn a_body_is_given_fewer_modes_more_damping_and_no_warp() {
    let mut harness =
        Harness::new_ui_state(|ui, bodies: &mut Vec<BodyView>| bodies::show(ui, bodies), vec![body()]);
    nudge(&mut harness, "modes", Key::ArrowLeft);
    assert_eq!(harness.state()[0].modes, 19);
    nudge(&mut harness, "stiffness", Key::ArrowRight);
    assert!(harness.state()[0].settings.stiffness_scale > 1.0);
    nudge(&mut harness, "damping", Key::ArrowRight);
    assert!(harness.state()[0].settings.damping_scale > 1.0);
    harness.get_by_label("modal warping").click();
    harness.run();
    assert!(!harness.state()[0].settings.warp);
    harness.get_by_label("Wake").click();
    harness.run();
    assert!(harness.state()[0].wake);
}

#[test]
fn hands_are_taken_off_a_body_and_a_remote_body_keeps_its_own_settings() {
    let mut held = body();
    held.local = false;
    let ann = HandView { name: "Ann".into(), force: 3.0, ..Default::default() };
    held.hands = vec![ann.clone()];
    let mut harness =
        Harness::new_ui_state(|ui, bodies: &mut Vec<BodyView>| bodies::show(ui, bodies), vec![held]);
    harness.run();
    assert!(harness.query_by_label("Ann: 3.00 N").is_some());
    let slider = harness.get_by_role_and_label(Role::Slider, "modes");
    assert!(slider.accesskit_node().is_disabled());
    assert!(harness.query_by_label("Let go").is_none(), "Ann is elsewhere, and lets go herself");
    let own = HandView { name: "pointer grab".into(), releasable: true, ..ann };
    harness.state_mut()[0].hands.push(own);
    harness.run();
    harness.get_by_label("Let go").click();
    harness.run();
    assert!(harness.state()[0].release);
}

#[test]
fn a_body_tells_what_it_touches_once_it_has() {
    let mut harness =
        Harness::new_ui_state(|ui, bodies: &mut Vec<BodyView>| bodies::show(ui, bodies), vec![body()]);
    harness.run();
    assert!(harness.query_by_label_contains("contacts:").is_none());
    let contact = ContactView { places: 12, sliding: 2, force: 9.81, depth: 1e-4, ..Default::default() };
    harness.state_mut()[0].contact = Some(contact);
    harness.run();
    harness.get_by_label("contacts: 12 (2 slide) \u{b7} 9.81 N \u{b7} 0.10 mm deep");
}

#[test]
fn what_a_closed_header_hides_is_asked_for_when_it_is_opened() {
    let bodies = (0..4).map(|i| BodyView { name: format!("pip {i}"), folded: i == 0, ..body() }).collect();
    let mut harness =
        Harness::new_ui_state(|ui, bodies: &mut Vec<BodyView>| bodies::show(ui, bodies), bodies);
    harness.run();
    assert!(harness.state().iter().all(|body| body.folded), "more than three begin closed");
    harness.get_by_label_contains("pip 2").click();
    harness.run();
    let folded: Vec<bool> = harness.state().iter().map(|body| body.folded).collect();
    assert_eq!(folded, [true, true, false, true]);
    harness.get_by_role_and_label(Role::Slider, "modes");
    harness.get_by_label_contains("pip 2").click();
    harness.run();
    assert!(harness.state()[2].folded);
}

#[test]
fn the_emergency_stop_is_one_press_and_its_release_another() {
    let devices = DevicesView {
        devices: vec![DeviceView {
            name: "virtual".into(),
            force: 1.0,
            limit: 3.3,
            force_scale: Some(0.5),
            calibrate: Some("press the button in its corner".into()),
            ..Default::default()
        }],
        ..Default::default()
    };
    let mut harness = Harness::new_ui_state(|ui, view: &mut DevicesView| device::show(ui, view), devices);
    assert!(harness.query_by_label("Release the stop").is_none());
    harness.get_by_label("STOP").click();
    harness.run();
    assert!(harness.state().stop);
    assert!(harness.query_by_label_contains("press the button").is_some());
    nudge(&mut harness, "force", Key::ArrowLeft);
    assert!(harness.state().devices[0].force_scale.unwrap() < 0.5);
    harness.state_mut().stopped = true;
    harness.state_mut().stop = false;
    harness.run();
    harness.get_by_label("Release the stop").click();
    harness.run();
    assert!(harness.state().reset && !harness.state().stop);
    // A device may have connected after the stop. The stop can be pressed at any time, also without
    // a device.
    harness.get_by_label("STOP").click();
    harness.run();
    assert!(std::mem::take(&mut harness.state_mut().stop));
    harness.state_mut().devices.clear();
    harness.run();
    assert!(harness.query_by_label("Release the stop").is_some());
    harness.get_by_label("STOP").click();
    harness.run();
    assert!(harness.state().stop);
}

#[test]
fn the_session_shows_its_people_and_never_the_secret_of_its_invite() {
    let session = NetworkView {
        role: "host".into(),
        invite: Some("pliant://127.0.0.1:7400#abcdef?token=secret".into()),
        users: vec![
            UserView { name: "Ann".into(), yourself: true, ..Default::default() },
            UserView { name: "Bo".into(), hands: 2, round_trip_ms: Some(196.0), ..Default::default() },
        ],
        ..Default::default()
    };
    let mut harness = Harness::new_ui_state(|ui, view: &mut NetworkView| network::show(ui, view), session);
    assert!(harness.query_by_label("Ann (you)").is_some() && harness.query_by_label("holds 2").is_some());
    assert!(harness.query_by_label_contains("secret").is_none());
    assert!(harness.query_by_label_contains("127.0.0.1").is_some());
    harness.get_by_label("Copy").click();
    harness.run();
    assert!(harness.state().copy);
}

#[test]
fn the_emulated_network_is_chosen_by_name_and_its_loss_moved() {
    let session = NetworkView {
        role: "guest".into(),
        emulator: Some(EmulatorView {
            presets: vec!["none".into(), "paper-1".into(), "wifi".into()],
            preset: 1,
            loss: 9.0,
            round_trip_ms: 196.0,
            jitter_ms: 2.0,
            ..Default::default()
        }),
        ..Default::default()
    };
    let mut harness = Harness::new_ui_state(|ui, view: &mut NetworkView| network::show(ui, view), session);
    nudge(&mut harness, "% lost", Key::ArrowRight);
    assert!(harness.state().emulator.as_ref().unwrap().loss > 9.0);
    nudge(&mut harness, "ms round trip", Key::ArrowLeft);
    assert!(harness.state().emulator.as_ref().unwrap().round_trip_ms < 196.0);
    nudge(&mut harness, "ms jitter", Key::ArrowRight);
    assert!(harness.state().emulator.as_ref().unwrap().jitter_ms > 2.0);
    harness.get_by_role(Role::ComboBox).click();
    harness.run();
    harness.get_by_label("wifi").click();
    harness.run();
    assert_eq!(harness.state().emulator.as_ref().unwrap().preset, 2);
    // Without emulation there are no knobs.
    harness.get_by_role(Role::ComboBox).click();
    harness.run();
    harness.get_by_label("none").click();
    harness.run();
    assert_eq!(harness.state().emulator.as_ref().unwrap().preset, 0);
    assert!(harness.query_by_label("% lost").is_none());
}

#[test]
fn another_network_has_knobs_for_all_that_it_can_do() {
    let emulator = EmulatorView {
        presets: vec!["none".into(), "wifi".into(), "other".into()],
        preset: 1,
        loss: 9.0,
        queue_kib: 64.0,
        seed: 7,
        ..Default::default()
    };
    let session = NetworkView { role: "peer".into(), emulator: Some(emulator), ..Default::default() };
    let mut harness = Harness::builder()
        .with_size([400.0, 900.0])
        .build_ui_state(|ui, view: &mut NetworkView| network::show(ui, view), session);
    assert!(harness.query_by_label("Mbit/s").is_none(), "a preset is what it is called");
    harness.get_by_role(Role::ComboBox).click();
    harness.run();
    harness.get_by_label("other").click();
    harness.run();
    let knobs = ["ms bursts", "Mbit/s", "KiB queue", "% reordered", "ms held back", "% twice"];
    for name in knobs {
        nudge(&mut harness, name, Key::ArrowRight);
    }
    harness.get_by_label("jitter keeps the order").click();
    harness.run();
    let seed = harness.get_by_role_and_label(Role::SpinButton, "seed");
    seed.focus();
    harness.run();
    harness.get_by_role_and_label(Role::SpinButton, "seed").type_text("12");
    harness.run();
    let moved = harness.state().emulator.as_ref().unwrap();
    for (name, value) in knobs.into_iter().zip([
        moved.burst_ms,
        moved.rate_mbit,
        moved.queue_kib - 64.0,
        moved.reordered,
        moved.held_back_ms,
        moved.duplicated,
    ]) {
        assert!(value > 0.0, "{name}: {moved:?}");
    }
    assert_eq!((moved.keep_order, moved.seed), (true, 12));
}

#[test]
fn the_figures_of_a_session_are_shown_with_their_units() {
    let session = NetworkView {
        round_trip_ms: 196.0,
        jitter_ms: 2.0,
        loss: [9.0, 8.5],
        rate: [103.0, 20.0],
        repaired: Some([12, 11]),
        nacks: 4,
        snapshots: 1,
        dropped: 3,
        queueing: true,
        visual_offset: Some(0.25),
        users: vec![UserView { name: "Bo".into(), loss: Some([3.0, 4.0]), ..Default::default() }],
        ..Default::default()
    };
    let mut harness = Harness::new_ui_state(|ui, view: &mut NetworkView| network::show(ui, view), session);
    for words in [
        "196 \u{b1} 2.00 ms, queueing",
        "9.00 % in, 8.50 % out",
        "103 kbit/s in, 20.0 out",
        "12 ticks, 11 corrected",
        "4 ticks, snapshots: 1",
        "3",
        "0.25 %",
        "lost 3.00 % in, 4.00 % out",
    ] {
        assert!(harness.query_by_label(words).is_some(), "{words}");
    }
    harness.state_mut().repaired = None;
    harness.state_mut().visual_offset = None;
    harness.run();
    assert!(harness.query_by_label("visual offset").is_none() && harness.query_by_label("guessed").is_none());
}

#[test]
fn a_session_is_left_where_there_is_one_to_leave() {
    let session = NetworkView { role: "guest".into(), way_out: Some("Leave"), ..Default::default() };
    let mut harness = Harness::new_ui_state(|ui, view: &mut NetworkView| network::show(ui, view), session);
    harness.get_by_label("Leave").click();
    harness.run();
    assert!(std::mem::take(&mut harness.state_mut().leave));
    harness.state_mut().way_out = None;
    harness.run();
    assert!(harness.query_by_label("Leave").is_none() && !harness.state().leave);
}

#[test]
fn a_recording_is_switched_off_and_thinned() {
    let recording = RecordingView {
        on: true,
        sinks: 1,
        ticks: 40,
        dropped: 0,
        removed: 3,
        shapes_hz: 20.0,
        modes_hz: 4.0,
        stress: false,
    };
    let mut harness =
        Harness::new_ui_state(|ui, view: &mut RecordingView| recording::show(ui, view), recording);
    harness.get_by_label("record").click();
    harness.run();
    assert!(!harness.state().on);
    nudge(&mut harness, "shapes a second", Key::ArrowLeft);
    assert!(harness.state().shapes_hz < 20.0);
    nudge(&mut harness, "bars a second", Key::ArrowRight);
    assert!(harness.state().modes_hz > 4.0);
    harness.get_by_label("color by stress").click();
    harness.run();
    assert!(harness.state().stress);
    // What became of earlier recordings, and of this one, is told.
    assert!(harness.query_by_label("3 older recordings were removed to make room").is_some());
    harness.state_mut().sinks = 0;
    harness.run();
    assert!(harness.query_by_label_contains("Nothing records any more").is_some());
}

#[test]
fn tab_alone_reaches_every_knob_of_a_body() {
    let mut harness =
        Harness::new_ui_state(|ui, bodies: &mut Vec<BodyView>| bodies::show(ui, bodies), vec![body()]);
    let mut reached = std::collections::BTreeSet::new();
    for _ in 0..12 {
        harness.key_press(Key::Tab);
        harness.run();
        for (role, name) in [
            (Role::Slider, "modes"),
            (Role::Slider, "damping"),
            (Role::Slider, "stiffness"),
            (Role::CheckBox, "modal warping"),
            (Role::Button, "Wake"),
        ] {
            if harness.get_by_role_and_label(role, name).is_focused() {
                reached.insert(name);
            }
        }
    }
    assert_eq!(reached.len(), 5, "{reached:?}");
}

/// Shows `view`, moves the focus through all of its controls, and checks that it stays unchanged.
fn untouched<S: Clone + std::fmt::Debug>(view: S, show: fn(&mut egui::Ui, &mut S), words: &str) {
    let before = format!("{view:?}");
    let mut harness = Harness::builder()
        .with_size([400.0, 900.0])
        .build_ui_state(move |ui, view: &mut S| show(ui, view), view);
    assert_eq!(format!("{:?}", harness.state()), before, "{words}: looked at");
    for _ in 0..32 {
        harness.key_press(Key::Tab);
        harness.run_steps(2);
        assert_eq!(format!("{:?}", harness.state()), before, "{words}: the focus went through");
    }
}

#[test]
fn what_nobody_touches_stays_as_it_is_whatever_it_is() {
    for (scale, modes) in [(20.0, 45), (1.0 / 3.0, 0), (0.0, 1), (-1.5, 7), (1e9, 30)] {
        let settings = StepSettings { damping_scale: scale, stiffness_scale: scale, ..Default::default() };
        let body = BodyView { settings, modes, ..body() };
        untouched(vec![body], |ui, bodies| bodies::show(ui, bodies), "body");
        untouched(TimeView { speed: scale, step: 0.025, ..Default::default() }, time::show, "time");
        let device = DeviceView { force_scale: Some(scale), ..Default::default() };
        untouched(DevicesView { devices: vec![device], ..Default::default() }, device::show, "device");
        let recording = |shapes_hz| RecordingView {
            on: true,
            sinks: 1,
            shapes_hz,
            modes_hz: scale,
            ..Default::default()
        };
        untouched(recording(scale), recording::show, "recording");
        untouched(recording(f64::INFINITY), recording::show, "recording of everything");
        let emulator = EmulatorView {
            presets: vec!["none".into(), "one".into()],
            preset: 1,
            loss: scale,
            round_trip_ms: scale,
            jitter_ms: scale,
            burst_ms: scale,
            rate_mbit: scale,
            queue_kib: scale,
            reordered: scale,
            held_back_ms: scale,
            duplicated: scale,
            seed: u64::MAX,
            ..Default::default()
        };
        assert!(emulator.other());
        let network = NetworkView { emulator: Some(emulator), ..Default::default() };
        untouched(network, network::show, "network");
    }
}

#[test]
fn what_is_typed_is_taken() {
    let mut harness =
        Harness::new_ui_state(|ui, bodies: &mut Vec<BodyView>| bodies::show(ui, bodies), vec![body()]);
    // The field beside the slider has the same name and comes after the slider.
    let field = || "damping";
    harness.get_by_role_and_label(Role::SpinButton, field()).focus();
    harness.run();
    harness.get_by_role_and_label(Role::SpinButton, field()).type_text("2.25");
    harness.run();
    harness.key_press(Key::Enter);
    harness.run();
    assert_eq!(harness.state()[0].settings.damping_scale, 2.25);
}
