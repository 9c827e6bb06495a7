//! Tests of the content of each stream, and of the cost of a stream that is off.

use std::collections::BTreeSet;

use bevy::{math::DVec3, prelude::*};
use pliant_body::{Grab, ModalBody};
use rerun::{
    external::re_log_encoding::rrd::DecoderApp,
    log::{Chunk, LogMsg},
};

use crate::{
    RerunColor, RerunPlugin, RerunRecording, RerunScalars, RerunStats, RerunStyle,
    frame::{RecordedFrame, RecordedHand, Samples},
    motion::ModalMotion,
    stress::StressSkin,
    tests::{app, body, bytes_of_colors, chunks, frame, numbers, recorder, rows, scratch, square},
};

#[test]
fn a_skin_that_is_stretched_and_turned_has_the_stress_of_the_closed_form() {
    let model = square();
    let surface = model.surface();
    let skin = StressSkin::new(surface);
    let (young, nu) = (2e5_f32, 0.3_f32);
    let mut out = Vec::new();
    // There is no stress at rest and after any rotation.
    let turned = |stretch: [f32; 2], shear: f32, angle: f32| -> Vec<[f32; 3]> {
        let (s, c) = angle.sin_cos();
        let positions = surface.positions().iter();
        positions
            .map(|p| {
                let (x, y) = (p[0] * stretch[0] + shear * p[1], p[1] * stretch[1]);
                [c * x - s * y, 0.5, s * x + c * y]
            })
            .collect()
    };
    assert!(skin.stress(surface, &turned([1.0, 1.0], 0.0, 1.1), young, nu, &mut out) < 1e-6 * young);
    // The triangle is stretched by a tenth along x and contracted by nu times a tenth along y. Only
    // one stress remains, E times Green's strain.
    let green = |stretch: f32| 0.5 * (stretch * stretch - 1.0);
    let across = (1.0 - 2.0 * nu * green(1.1)).sqrt();
    let largest = skin.stress(surface, &turned([1.1, across], 0.0, 0.7), young, nu, &mut out);
    let expected = young * green(1.1);
    assert!((largest / expected - 1.0).abs() < 1e-4, "{largest} Pa for {expected} Pa");
    assert!(out.iter().all(|stress| (stress / expected - 1.0).abs() < 1e-4), "the same everywhere: {out:?}");
    // With equal stretch in both directions s = E e / (1 - nu), and the von Mises stress of
    // (s, s, 0) is s.
    let largest = skin.stress(surface, &turned([1.02, 1.02], 0.0, 0.0), young, nu, &mut out);
    let expected = young * green(1.02) / (1.0 - nu);
    assert!((largest / expected - 1.0).abs() < 1e-3, "{largest} Pa for {expected} Pa");
    // A small shear g gives sqrt(3) G g, with G = E / 2 (1 + nu).
    let largest = skin.stress(surface, &turned([1.0, 1.0], 0.001, 0.0), young, nu, &mut out);
    let expected = 3f32.sqrt() * young / (2.0 * (1.0 + nu)) * 0.001;
    assert!((largest / expected - 1.0).abs() < 2e-3, "{largest} Pa for {expected} Pa");
}

#[test]
fn a_swing_of_a_known_frequency_and_amplitude_is_in_the_spectrum_there_and_so_high() {
    let model = square();
    let mut motion = ModalMotion::new(&model);
    let (hz, tick) = (5.0, 1.0 / 40.0);
    for i in 0_u32..400 {
        let time = f64::from(i) * tick;
        let q = 0.2 + 0.05 * (std::f64::consts::TAU * hz * time).sin();
        motion.push(&model, &[q as f32], u64::from(i), time);
        assert_eq!(motion.spectrum().is_some(), i >= 255, "not before the window is full");
    }
    let (frequencies, amplitudes) = motion.spectrum().unwrap();
    assert!((frequencies[1] - 40.0 / 256.0).abs() < 1e-6 && frequencies.len() == 128);
    let highest = (0..128).max_by(|&a, &b| amplitudes[a].total_cmp(&amplitudes[b])).unwrap();
    assert!((frequencies[highest] - hz).abs() < 1e-3, "{} Hz", frequencies[highest]);
    // The mode lifts the far side by q.
    assert!((amplitudes[highest] - 0.05).abs() < 5e-4, "{} m", amplitudes[highest]);
    assert!(amplitudes[0] < 1e-6, "where it hangs is not a swing");
    assert!(amplitudes[highest + 3..].iter().all(|a| *a < 1e-3), "nothing elsewhere");
    // The body stood still for a whole window. The first push leaves only a step at the window's
    // end, and the second push leaves a constant window.
    motion.push(&model, &[0.2], 1000, 1000.0 * tick);
    motion.push(&model, &[0.2], 1400, 1400.0 * tick);
    let (_, still) = motion.spectrum().unwrap();
    assert!(still.iter().all(|a| *a < 1e-6), "{still:?}");
}

#[test]
fn the_energy_of_each_mode_is_a_bar() {
    let (mut recorder, stream, storage) = recorder();
    let body = body();
    for tick in 1..=300 {
        let mut frame = frame(tick, &body, 0.1);
        frame.shapes[0].bars = tick % 100 == 0;
        frame.shapes[0].energies = Some(0..1);
        frame.energies = vec![0.25];
        recorder.log(&frame).unwrap();
    }
    recorder.end();
    drop(stream);
    let messages = storage.take();
    assert_eq!(rows(&messages, "/modes/my\\ body", "values"), 3);
    assert_eq!(rows(&messages, "/spectrum/my\\ body", "values"), 1, "once the window is full");
    let views = |class: &str| {
        let told = messages.iter().filter(|message| match message {
            LogMsg::ArrowMsg(store, data) if store.is_blueprint() => format!("{data:?}").contains(class),
            _ => false,
        });
        told.count()
    };
    assert!(views("BarChart") >= 2, "both have a place in the layout");
}

#[test]
fn a_hand_has_its_users_color_in_the_plot_and_in_the_scene_and_its_line_ends_with_it() {
    let (mut recorder, stream, storage) = recorder();
    let hand = |color| RecordedHand {
        name: "Ann".into(),
        color: Some(color),
        force: [3.0, 4.0, 0.0],
        point: [0.0; 3],
        target: [0.0; 3],
    };
    let at = |tick, hands| RecordedFrame { tick, hands: Some(hands), ..RecordedFrame::default() };
    recorder.log(&at(1, vec![hand([10, 200, 30])])).unwrap();
    recorder.log(&at(2, vec![hand([10, 200, 30])])).unwrap();
    recorder.log(&at(3, Vec::new())).unwrap();
    // This is another hand with the name Ann.
    recorder.log(&at(4, vec![hand([200, 10, 30])])).unwrap();
    recorder.end();
    drop(stream);
    let messages = storage.take();
    assert_eq!(numbers(&messages, "/reaction/Ann", "scalars"), [5.0; 3]);
    let plotted = bytes_of_colors(&messages, "/reaction/Ann");
    assert_eq!(plotted, [[10, 200, 30], [200, 10, 30]], "told once each");
    let drawn = bytes_of_colors(&messages, "/world/hands/reactions");
    assert_eq!(drawn, [[10, 200, 30], [10, 200, 30], [200, 10, 30]]);
    assert_eq!(rows(&messages, "/reaction/Ann", "is_recursive"), 1, "the line ends where the hand let go");
}

#[test]
fn the_color_says_displacement_or_stress() {
    let stressed = |color, scale| {
        let (mut recorder, stream, storage) = recorder();
        let body = body();
        let mut one = frame(1, &body, 0.3);
        one.color = color;
        one.shapes[0].place.scale = scale;
        recorder.log(&one).unwrap();
        recorder.end();
        drop(stream);
        let messages = storage.take();
        let stress = numbers(&messages, "/stress/my\\ body", "scalars");
        (bytes_of_colors(&messages, "/world/my\\ body"), stress)
    };
    let (by_displacement, none) = stressed(RerunColor::Displacement, 1.0);
    let (by_stress, largest) = stressed(RerunColor::Stress, 1.0);
    assert_eq!((by_displacement.len(), by_stress.len(), none.len(), largest.len()), (4, 4, 0, 1));
    assert_ne!(by_displacement[0], by_displacement[2], "the near side rests, the far side is lifted");
    assert_ne!(by_displacement, by_stress);
    assert!(largest[0] > 0.0);
    // At twice the size and the same stiffness in N/m, the displacement doubles, the strain stays
    // the same, and the stress is halved.
    let (same, half) = stressed(RerunColor::Stress, 2.0);
    assert!((half[0] / largest[0] - 0.5).abs() < 1e-6, "{half:?} Pa for half of {largest:?} Pa");
    assert_eq!(same, by_stress, "the color is relative to Young's modulus");
}

#[test]
fn energies_are_a_line_and_what_comes_faster_than_ticks_has_its_own_times() {
    let (mut recorder, stream, storage) = recorder();
    let body = body();
    for tick in 1..=2 {
        let mut frame = frame(tick, &body, 0.1);
        frame.shapes[0].energies = Some(0..2);
        frame.energies = vec![0.25, 0.5];
        let values = (0..25).rev().map(|i| (f64::from(i) * 1e-3, f64::from(i))).collect();
        frame.samples.push(Samples { path: "device/pen/loop/force x".into(), unit: "N", values });
        recorder.log(&frame).unwrap();
    }
    recorder.end();
    drop(stream);
    let messages = storage.take();
    assert_eq!(numbers(&messages, "/energy/my\\ body", "scalars"), [0.75, 0.75]);
    assert_eq!(rows(&messages, "/modes/my\\ body", "values"), 0, "the bars were not due");
    let path = "/device/pen/loop/force\\ x";
    assert_eq!(numbers(&messages, path, "scalars").len(), 50);
    let columns = chunks(&messages, path);
    let times = columns.iter().find_map(|chunk| {
        chunk
            .timelines()
            .iter()
            .find(|(name, _)| name.as_str() == "sim_time")
            .map(|(_, c)| c.times_raw().to_vec())
    });
    let times = times.unwrap();
    assert_eq!(
        (times[0], times[24], times[49]),
        (1_000_000, 25_000_000, 50_000_000),
        "ns: a millisecond apart"
    );
}

/// Runs two hundred frames of an app at these rates. Returns what was collected and the content of
/// the file.
fn collected(rates: RerunRecording, name: &str, style: RerunStyle) -> (RerunStats, Vec<LogMsg>) {
    let path = scratch(name);
    let mut app = app(RerunPlugin::file(&path).with_rates(rates).with_queue(2048));
    let bodies: Vec<Entity> =
        app.world_mut().query_filtered::<Entity, With<ModalBody>>().iter(app.world()).collect();
    for body in bodies {
        app.world_mut().entity_mut(body).insert(style);
    }
    for tick in 0..200 {
        let mut grabs = app.world_mut().query::<&mut Grab>();
        for mut grab in grabs.iter_mut(app.world_mut()) {
            grab.target = DVec3::new(1.0, 1.0, 0.1 * (0.3 * f64::from(tick)).sin());
        }
        app.world_mut().resource_mut::<RerunScalars>().set("error/now", "%", f64::from(tick));
        app.update();
    }
    let stats = *app.world().resource::<RerunStats>();
    drop(app);
    let file = std::io::BufReader::new(std::fs::File::open(&path).unwrap());
    let messages = DecoderApp::decode_lazy(file).map(Result::unwrap).collect();
    std::fs::remove_file(path).unwrap();
    (stats, messages)
}

#[test]
fn a_stream_with_a_rate_of_zero_is_not_gathered_and_not_in_the_file() {
    let off = RerunRecording {
        shapes_hz: 0.0,
        metrics_hz: 0.0,
        hands_hz: 0.0,
        modes_hz: f64::NAN,
        ..RerunRecording::default()
    };
    // The size of a file depends on how often its worker writes, but the content does not.
    let told = |messages: &[LogMsg]| -> BTreeSet<String> {
        let of = |message: &LogMsg| match message {
            LogMsg::ArrowMsg(store, data) if store.is_recording() => {
                Some(Chunk::from_arrow_msg(data).unwrap().entity_path().to_string())
            }
            _ => None,
        };
        let paths = messages.iter().filter_map(of);
        paths.filter(|path| path != "/world" && !path.starts_with("/__properties")).collect()
    };
    // Of each body the log has its elasticity.
    let log = || "/log".to_owned();
    let nothing = BTreeSet::from([log()]);
    let shapes = |messages: &[LogMsg]| rows(messages, "/world/square", "vertex_positions") as u64;
    let (none, empty) = collected(off, "off", RerunStyle::Surface);
    assert_eq!((none.collected, none.shapes), (200, 0));
    assert_eq!(told(&empty), nothing, "nothing but the log, the world's axes and the layout");
    let (all, full) = collected(RerunRecording::default(), "all", RerunStyle::Surface);
    assert!(all.shapes >= 195, "{all:?}");
    assert!((95..=101).contains(&shapes(&full)), "20 Hz of 40: {}", shapes(&full));
    assert_eq!(numbers(&full, "/error/now", "scalars").len(), 200);
    let streams = [
        "/displacement/square",
        "/energy/square",
        "/modes/square",
        "/reaction/hand",
        "/step/square",
        "/world/hands/targets",
    ];
    assert!(streams.iter().all(|path| told(&full).contains(*path)), "{:?}", told(&full));
    let steps = numbers(&full, "/step/square", "scalars");
    assert!(steps.len() >= 195 && steps.iter().all(|us| *us > 0.0 && *us < 1e6), "{steps:?}");
    let (drawn, file) = collected(RerunRecording { shapes_hz: 10.0, ..off }, "drawn", RerunStyle::Surface);
    assert!((48..=51).contains(&drawn.shapes), "10 Hz of 40: {drawn:?}");
    assert_eq!(
        (shapes(&file), told(&file)),
        (drawn.shapes, BTreeSet::from(["/world/square".to_owned(), log()]))
    );
    let (hidden, file) = collected(RerunRecording { shapes_hz: 10.0, ..off }, "hidden", RerunStyle::Hidden);
    assert_eq!((hidden.shapes, told(&file)), (0, nothing));
}

#[test]
fn the_log_of_a_tick_whose_figures_are_not_due_is_kept_and_so_are_the_figures() {
    let path = scratch("kept");
    let rates = RerunRecording { metrics_hz: 1.0, ..RerunRecording::default() };
    let mut app = app(RerunPlugin::file(&path).with_rates(rates));
    for tick in 0..10 {
        let mut own = app.world_mut().resource_mut::<RerunScalars>();
        own.set("error/now", "%", f64::from(tick));
        own.log("a line");
        app.update();
    }
    let own = app.world().resource::<RerunScalars>();
    assert_eq!(
        (own.scalars.len(), own.lines.len()),
        (1, 0),
        "the newest value waits, the lines are gone to the log"
    );
    drop(app);
    std::fs::remove_file(path).unwrap();
}
