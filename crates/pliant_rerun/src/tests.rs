use std::{
    fmt::Debug,
    net::{TcpListener, TcpStream},
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, Instant},
};

use bevy::{math::DVec3, prelude::*, time::TimeUpdateStrategy, transform::TransformPlugin};
use pliant_body::{Driven, Grab, GrabOf, ModalAsset, ModalBody, PliantBodyPlugin, VisualState};
use pliant_modal::{BakeInfo, Damping, Element, ModalModel, ModelParts, SurfaceMesh};
use rerun::{
    RecordingStreamBuilder,
    log::{Chunk, LogMsg},
    sink::MemorySinkStorage,
};

use crate::{
    RerunPlugin, RerunScalars, RerunStats, RerunStyle,
    blueprint::Plots,
    frame::{BodyTransform, Drawn, Line, RecordedFrame, RecordedHand, Scalar, ShapeFrame},
    recorder::Recorder,
    worker::{Target, Worker},
};

/// Time limit for all waits. Only a failure takes longer.
const LIMIT: Duration = Duration::from_secs(60);

/// Calls `look` until it succeeds. Its error says what it saw instead.
#[track_caller]
pub(crate) fn until<T, L: Debug>(what: &str, mut look: impl FnMut() -> Result<T, L>) -> T {
    let begun = Instant::now();
    loop {
        match look() {
            Ok(seen) => return seen,
            Err(seen) => assert!(begun.elapsed() < LIMIT, "not in {LIMIT:?}: {what}; the last was {seen:?}"),
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Runs a frame of the app, and then returns whether its counters satisfy `so`.
pub(crate) fn update_to(app: &mut App, so: impl Fn(&RerunStats) -> bool) -> Result<(), RerunStats> {
    app.update();
    let stats = *app.world().resource::<RerunStats>();
    if so(&stats) { Ok(()) } else { Err(stats) }
}

/// Returns a unit square in the plane z = 0 on which one mode lifts the far side (y = 1) by q
/// meters.
pub(crate) fn square() -> ModalModel {
    let positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
    let surface = SurfaceMesh::new(positions, vec![[0, 1, 2], [0, 2, 3]], None, Vec::new()).unwrap();
    ModalModel::from_parts(ModelParts {
        info: BakeInfo {
            name: "square".into(),
            tets: 0,
            nodes: 0,
            element: Element::Tet4,
            young: 1e5,
            poisson: 0.3,
            density: 1000.0,
            damping: Damping::Ratio(0.1),
            anchors: vec!["y<0.1".into()],
            residual_max: 0.0,
            orthonormality_max: 0.0,
        },
        surface,
        omega: vec![6.0],
        damping: vec![1.2],
        displacement: vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0],
        rotation: vec![0.0; 12],
        participation: vec![[0.0, 0.0, 0.5]],
        free: false,
        mass: 1.0,
        center_of_mass: [0.5, 0.5, 0.0],
        inertia: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        sites: Vec::new(),
        reduced: None,
    })
    .unwrap()
}

const HERE: BodyTransform =
    BodyTransform { translation: [0.0, 1.0, 0.0], rotation: [0.0, 0.0, 0.0, 1.0], scale: 2.0 };

pub(crate) fn body() -> Arc<Drawn> {
    Arc::new(Drawn {
        path: "my/body".replace('/', " ").into(),
        model: Arc::new(square()),
        style: RerunStyle::Surface,
    })
}

pub(crate) fn frame(tick: u64, body: &Arc<Drawn>, q: f32) -> RecordedFrame {
    let shape = ShapeFrame {
        body: body.clone(),
        coordinates: 0..1,
        warped: false,
        place: HERE,
        stiffness: 1.0,
        draw: true,
        metrics: true,
        sample: true,
        energies: None,
        bars: false,
    };
    RecordedFrame {
        tick,
        time: tick as f64 / 40.0,
        wall: 1.7e9 + tick as f64 / 40.0,
        arrived: if tick == 1 { vec![body.clone()] } else { Vec::new() },
        shapes: vec![shape],
        coordinates: vec![q],
        ..RecordedFrame::default()
    }
}

pub(crate) fn recorder() -> (Recorder, rerun::RecordingStream, MemorySinkStorage) {
    let (stream, storage) = RecordingStreamBuilder::new("pliant_test").memory().unwrap();
    (Recorder::new(stream.clone(), Plots::default()), stream, storage)
}

/// Returns the chunks of the recording itself (not of its layout) for one path, in order.
pub(crate) fn chunks(messages: &[LogMsg], path: &str) -> Vec<Chunk> {
    let data = messages.iter().filter_map(|message| match message {
        LogMsg::ArrowMsg(store, data) if store.is_recording() => Some(Chunk::from_arrow_msg(data).unwrap()),
        _ => None,
    });
    data.filter(|chunk| chunk.entity_path().to_string() == path).collect()
}

/// Returns the number of rows with the component whose name ends with `component`.
pub(crate) fn rows(messages: &[LogMsg], path: &str, component: &str) -> usize {
    let of = |chunk: &Chunk| {
        let found =
            chunk.components().values().find(|column| column.descriptor.to_string().ends_with(component));
        found.map_or(0, |column| column.list_array.iter().filter(Option::is_some).count())
    };
    chunks(messages, path).iter().map(of).sum()
}

/// Returns all numbers of the component whose name ends with `component`, row by row.
pub(crate) fn numbers(messages: &[LogMsg], path: &str, component: &str) -> Vec<f64> {
    let mut values = Vec::new();
    for chunk in chunks(messages, path) {
        for column in chunk.components().values() {
            if column.descriptor.to_string().ends_with(component) {
                let array = column.list_array.values();
                let array = array.as_any().downcast_ref::<rerun::external::arrow::array::Float64Array>();
                values.extend(array.unwrap().values().iter().copied());
            }
        }
    }
    values
}

/// Returns all vectors of the component whose name ends with `component`, row by row.
#[cfg(feature = "contact")]
pub(crate) fn vectors(messages: &[LogMsg], path: &str, component: &str) -> Vec<[f32; 3]> {
    use rerun::external::arrow::array::{FixedSizeListArray, Float32Array};
    let mut vectors = Vec::new();
    for chunk in chunks(messages, path) {
        for column in chunk.components().values() {
            if column.descriptor.to_string().ends_with(component) {
                let array = column.list_array.values();
                let array = array.as_any().downcast_ref::<FixedSizeListArray>().unwrap().values();
                let array = array.as_any().downcast_ref::<Float32Array>().unwrap();
                vectors.extend(array.values().as_chunks().0);
            }
        }
    }
    vectors
}

/// Returns how many values each row of the component has whose name ends with `component`.
#[cfg(feature = "contact")]
pub(crate) fn row_lengths(messages: &[LogMsg], path: &str, component: &str) -> Vec<usize> {
    use rerun::external::arrow::array::Array;
    let of = |chunk: &Chunk| -> Vec<usize> {
        let mut columns = chunk.components().values();
        let found = columns.find(|column| column.descriptor.to_string().ends_with(component));
        let rows = found.into_iter().flat_map(|column| column.list_array.iter().flatten());
        rows.map(|row| row.len()).collect()
    };
    chunks(messages, path).iter().flat_map(of).collect()
}

/// Returns the colors of a path, row by row: red, green and blue.
pub(crate) fn bytes_of_colors(messages: &[LogMsg], path: &str) -> Vec<[u8; 3]> {
    let mut colors = Vec::new();
    for chunk in chunks(messages, path) {
        for column in chunk.components().values() {
            if column.descriptor.to_string().ends_with("colors") {
                let array = column.list_array.values();
                let array = array.as_any().downcast_ref::<rerun::external::arrow::array::UInt32Array>();
                let rgba = array.unwrap().values().iter().map(|rgba| rgba.to_be_bytes());
                colors.extend(rgba.map(|[r, g, b, _]| [r, g, b]));
            }
        }
    }
    colors
}

#[test]
fn a_body_is_told_once_and_its_positions_every_time() {
    let (mut recorder, stream, storage) = recorder();
    let body = body();
    for tick in 1..=10 {
        recorder.log(&frame(tick, &body, 0.1 * tick as f32)).unwrap();
    }
    recorder.end();
    drop(stream);
    let messages = storage.take();
    let path = "/world/my\\ body";
    assert_eq!(rows(&messages, path, "triangle_indices"), 1);
    assert_eq!(rows(&messages, path, "vertex_positions"), 10);
    assert_eq!(rows(&messages, path, "vertex_normals"), 10);
    assert_eq!(rows(&messages, path, "translation"), 1, "it did not move");
    for chunk in chunks(&messages, path) {
        let mut timelines: Vec<String> = chunk.timelines().keys().map(ToString::to_string).collect();
        timelines.sort();
        assert_eq!(timelines, ["sim_time", "tick", "wall_time"]);
    }
}

#[test]
fn figures_have_their_values_and_the_displacement_is_in_the_world() {
    let (mut recorder, stream, storage) = recorder();
    let body = body();
    for tick in 1..=4 {
        let mut frame = frame(tick, &body, 0.25 * tick as f32);
        frame.scalars.push(Scalar { path: "net/round trip".into(), unit: "ms".into(), value: 196.0 });
        recorder.log(&frame).unwrap();
    }
    recorder.end();
    drop(stream);
    let messages = storage.take();
    let values = |path: &str| numbers(&messages, path, "scalars");
    // One mode lifts the far side by q, and the body is drawn at twice its size.
    assert_eq!(values("/displacement/my\\ body"), [0.5, 1.0, 1.5, 2.0]);
    assert_eq!(values("/net/round\\ trip"), [196.0; 4]);
    assert_eq!(
        chunks(&messages, "/net/round\\ trip").len(),
        2,
        "the line's name, and one column of its values"
    );
}

#[test]
fn hands_of_one_name_are_two_lines_and_an_empty_hand_clears_the_arrows() {
    let (mut recorder, stream, storage) = recorder();
    let hand = RecordedHand {
        name: "hand".into(),
        color: None,
        force: [3.0, 4.0, 0.0],
        point: [0.0; 3],
        target: [0.0; 3],
    };
    let line = Line { warning: true, text: "watch out".into() };
    recorder
        .log(&RecordedFrame {
            tick: 1,
            hands: Some(vec![hand.clone(), hand]),
            lines: vec![line],
            ..RecordedFrame::default()
        })
        .unwrap();
    recorder.log(&RecordedFrame { tick: 2, hands: Some(Vec::new()), ..RecordedFrame::default() }).unwrap();
    recorder.end();
    drop(stream);
    let messages = storage.take();
    assert_eq!(rows(&messages, "/reaction/hand", "scalars"), 1);
    assert_eq!(rows(&messages, "/reaction/hand\\ 2", "scalars"), 1);
    assert_eq!(rows(&messages, "/world/hands/reactions", "vectors"), 2);
    assert_eq!(rows(&messages, "/log", "text"), 1);
}

#[test]
fn the_layout_ships_with_the_recording_and_is_made_active() {
    let (mut recorder, stream, storage) = recorder();
    let body = body();
    recorder.log(&frame(1, &body, 0.1)).unwrap();
    recorder.end();
    drop(stream);
    let messages = storage.take();
    let activated = messages.iter().any(
        |message| matches!(message, LogMsg::BlueprintActivationCommand(command) if command.make_active && command.make_default),
    );
    assert!(activated);
    let views = messages.iter().filter(|message| match message {
        LogMsg::ArrowMsg(store, data) if store.is_blueprint() => {
            Chunk::from_arrow_msg(data).unwrap().entity_path().to_string().starts_with("/view/")
        }
        _ => false,
    });
    assert!(views.count() >= 2, "the scene and the plot of the displacement");
    let legends = messages.iter().filter(|message| match message {
        LogMsg::ArrowMsg(store, data) if store.is_blueprint() => {
            Chunk::from_arrow_msg(data).unwrap().entity_path().to_string().ends_with("/PlotLegend")
        }
        _ => false,
    });
    assert!(legends.count() >= 1);
}

#[test]
fn figures_of_two_units_get_two_plots() {
    let mut plots = Plots::default();
    assert!(plots.note("net/loss_in", "%"));
    assert!(plots.note("net/loss_out", "%"));
    assert!(plots.note("net/round_trip", "ms"));
    assert!(!plots.note("net/loss_in", "%"), "known");
    assert!(plots.take_changed() && !plots.take_changed());
    assert!(
        plots.note("time/step", "ms") && plots.note("frame/deform", "ms") && plots.note("bodies/awake", "")
    );
    assert!(plots.note("reaction/left", "N") && plots.note("error/now", "%"));
    let titles: Vec<Vec<String>> =
        plots.cells().into_iter().map(|cell| cell.into_iter().map(|plot| plot.title).collect()).collect();
    let expected: [&[&str]; 4] =
        [&["Reaction (N)"], &["Error (%)"], &["Net (ms)", "Net (%)"], &["Time (ms)", "Frame (ms)", "Bodies"]];
    assert_eq!(titles, expected);
    let net = plots.cells().swap_remove(2);
    assert_eq!(net[0].contents, ["/net/round_trip"]);
    assert_eq!(net[1].contents, ["/net/loss_in", "/net/loss_out"]);
    for i in 0..20 {
        plots.note(&format!("game{i}/x"), "");
    }
    assert_eq!(plots.cells().len(), 8, "the others are tabs of the last");
    assert_eq!(plots.cells().iter().flatten().count(), 27);
}

pub(crate) fn app(plugin: RerunPlugin) -> App {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin, PliantBodyPlugin::default()))
        .insert_resource(Time::<Fixed>::from_seconds(1.0 / 40.0))
        .insert_resource(TimeUpdateStrategy::FixedTimesteps(1))
        .add_plugins(plugin);
    app.update();
    let model = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(square()));
    let body = app.world_mut().spawn((ModalBody::new(model), Name::new("square"))).id();
    app.world_mut().spawn((Grab::new(2, 0.0, DVec3::new(1.0, 1.0, 0.1)), GrabOf(body), Name::new("hand")));
    app
}

pub(crate) fn scratch(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("pliant_rerun_{}_{name}.rrd", std::process::id()))
}

/// Whether the file ends with the footer that the encoder of a recording writes last.
pub(crate) fn is_whole(path: &Path) -> bool {
    let bytes = std::fs::read(path).unwrap();
    bytes.starts_with(b"RRF2")
        && bytes.len() > 1000
        && bytes[bytes.len() - 64..].windows(4).any(|w| w == b"RRF2")
}

#[test]
fn a_file_ends_at_its_limit_and_is_whole() {
    let path = scratch("limit");
    let mut app = app(RerunPlugin::file(&path).with_file_limit(20_000));
    until("the recording has ended", || update_to(&mut app, |stats| stats.sinks == 0 && stats.collected > 0));
    drop(app);
    let size = path.metadata().unwrap().len();
    assert!(size >= 20_000, "not before its limit: {size} bytes");
    assert!(is_whole(&path), "{size} bytes");
    std::fs::remove_file(path).unwrap();
}

#[test]
fn a_file_is_whole_when_the_app_says_exit_and_when_it_is_only_dropped() {
    for (name, exits) in [("exit", true), ("drop", false)] {
        let path = scratch(name);
        let mut app = app(RerunPlugin::file(&path));
        for _ in 0..40 {
            app.update();
        }
        let stats = *app.world().resource::<RerunStats>();
        assert_eq!((stats.collected, stats.dropped, stats.sinks), (40, 0, 1), "the first update has no tick");
        if exits {
            app.world_mut().write_message(AppExit::Success);
            app.update();
            assert!(is_whole(&path), "{name}");
        }
        drop(app);
        assert!(is_whole(&path), "{name}");
        std::fs::remove_file(path).unwrap();
    }
}

#[test]
fn a_file_is_whole_after_a_panic() {
    let path = scratch("panic");
    let moved = path.clone();
    let fell = std::thread::spawn(move || {
        let mut app = app(RerunPlugin::file(&moved));
        app.add_systems(Update, |tick: Res<pliant_body::PliantTick>| assert!(tick.0 < 20, "on purpose"));
        (0..100).for_each(|_| app.update());
    });
    assert!(fell.join().is_err());
    assert!(is_whole(&path));
    std::fs::remove_file(path).unwrap();
}

#[test]
fn without_a_viewer_nothing_is_lost_but_the_recording() {
    // The port belongs to the near end of an open connection, so no process can listen on it.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let stream = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let port = stream.local_addr().unwrap().port();
    let mut app = app(RerunPlugin::viewer().with_viewer_port(port).with_spawn(false));
    until("on without a viewer", || update_to(&mut app, |stats| stats.sinks == 0 && stats.collected > 0));
    let collected = app.world().resource::<RerunStats>().collected;
    (0..20).for_each(|_| app.update());
    assert_eq!(app.world().resource::<RerunStats>().collected, collected, "nothing is collected for nobody");
    // The end does not wait for a viewer either: the worker ends by itself.
    let target = Target::Viewer { port, spawn: false };
    let (spare, _logged) = crossbeam_channel::bounded(1);
    let worker = Worker::start("pliant_test", &target, 1, Plots::default(), spare).unwrap();
    until("the worker ends", || if worker.has_ended() { Ok(()) } else { Err("it runs") });
}

#[test]
fn a_viewer_that_does_not_read_drops_ticks_and_never_holds_the_app_up() {
    // This viewer listens and accepts, but never reads.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let (full, filled) = crossbeam_channel::bounded(1);
    let run = std::thread::spawn(move || {
        let mut app = app(RerunPlugin::viewer().with_viewer_port(port).with_spawn(false).with_queue(4));
        // The SDK buffers data that the viewer does not read: three queues of 50 MiB and a hundred
        // messages. Long lines fill these buffers soon, while a tick of this app alone has about a
        // kilobyte. While ticks are dropped, the last line waits and no other is added.
        app.add_systems(Update, |mut metrics: ResMut<RerunScalars>| {
            if metrics.lines.is_empty() {
                metrics.log("x".repeat(1 << 20));
            }
        });
        // A worker that is only late drops some of the ticks. A worker that is stuck drops all of
        // them.
        let mut stuck = 0;
        let mut last = 0;
        while stuck < 200 {
            app.update();
            let dropped = app.world().resource::<RerunStats>().dropped;
            stuck = if dropped > last { stuck + 1 } else { 0 };
            last = dropped;
        }
        full.send(()).unwrap();
        (0..500).for_each(|_| app.update());
        drop(listener);
    });
    until("the queue is full and stays full", || filled.try_recv());
    // The limit detects a wait for the viewer, either an endless wait or a short wait in each tick.
    until("five hundred ticks beside it", || if run.is_finished() { Ok(()) } else { Err("held up") });
    run.join().unwrap();
}

#[test]
fn a_path_that_cannot_be_written_leaves_the_app_running() {
    let mut app = app(RerunPlugin::file("/nonexistent/folder/x.rrd"));
    app.update();
    assert_eq!(app.world().resource::<RerunStats>().collected, 0);
    // Metrics that are not taken do not accumulate.
    let mut metrics = app.world_mut().resource_mut::<RerunScalars>();
    for i in 0..10_000 {
        metrics.set(format!("a/{i}"), "", 1.0);
        metrics.log("b");
    }
    assert!(metrics.scalars.len() <= 4096 && metrics.lines.len() <= 4096);
}

#[test]
fn a_resting_body_is_not_sent() {
    let path = scratch("rest");
    let mut app = app(RerunPlugin::file(&path).with_queue(2048));
    let body = app.world_mut().query_filtered::<Entity, With<ModalBody>>().single(app.world()).unwrap();
    app.world_mut().entity_mut(body).insert(Driven::Remote);
    (0..40).for_each(|_| app.update());
    let before = *app.world().resource::<RerunStats>();
    (0..400).for_each(|_| app.update());
    let after = *app.world().resource::<RerunStats>();
    assert_eq!((after.collected, after.shapes), (before.collected + 400, before.shapes));
    // A new state is drawn in the next drawing at the latest, and then not again.
    app.world_mut().get_mut::<VisualState>(body).unwrap().snap(&[0.1]).unwrap();
    (0..400).for_each(|_| app.update());
    let shapes = app.world().resource::<RerunStats>().shapes - after.shapes;
    assert_eq!(app.world().resource::<RerunStats>().dropped, 0, "what was dropped would be sent again");
    assert!((1..=3).contains(&shapes), "{shapes} shapes");
    drop(app);
    std::fs::remove_file(path).unwrap();
}
