//! Measures the cost of a recording per frame of the recorded app, and the size of the recording.
//!
//! `cargo run --release -p pliant_rerun --example recording_cost -- [SECONDS]`. The default is 20 s
//! for each case.
//!
//! Each case has its own app, and all apps are equal: the shipped body with two hands that never
//! rest, one tick per frame, 60 frames per second. The apps take turns of one second, so that other
//! load of the machine affects all of them. A frame is `App::update` (without a renderer) and a
//! busy wait of 4 ms in place of the rest of a game. The viewer that reads is `rerun --save`, if
//! `rerun` is installed. The slow viewer accepts a connection and never reads.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::print_stdout,
    reason = "a measurement that fails should say so"
)]

use std::{
    net::TcpListener,
    path::PathBuf,
    process::{Child, Command, Stdio},
    sync::Arc,
    time::{Duration, Instant},
};

use bevy::{math::DVec3, prelude::*, time::TimeUpdateStrategy, transform::TransformPlugin};
use pliant_body::{Grab, GrabOf, ModalAsset, ModalBody, PliantBodyPlugin, PliantSystems};
use pliant_modal::ModalModel;
use pliant_rerun::{RerunColor, RerunPlugin, RerunRecording, RerunStats};

const HZ: f64 = 60.0;
const SPIN: Duration = Duration::from_millis(4);
/// Frames per turn.
const TURN: usize = 60;

struct Case {
    name: &'static str,
    app: App,
    /// The output of the file sink or the viewer.
    file: Option<PathBuf>,
    updates: Vec<f64>,
    frames: Vec<f64>,
}

fn main() {
    let seconds: usize = std::env::args().nth(1).map_or(20, |text| text.parse().expect("seconds"));
    let assets = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal");
    let model = Arc::new(ModalModel::from_bytes(&std::fs::read(assets).unwrap()).unwrap());
    let scratch =
        |name: &str| std::env::temp_dir().join(format!("pliant_cost_{}_{name}.rrd", std::process::id()));

    let deaf = TcpListener::bind("127.0.0.1:0").unwrap();
    let deaf_port = deaf.local_addr().unwrap().port();
    std::thread::spawn(move || {
        let kept: Vec<_> = deaf.incoming().collect();
        drop(kept);
    });
    let read = scratch("read");
    let viewer = Viewer::start(&read);

    let rates = RerunRecording::default;
    let mut cases = vec![
        Case::new("no plugin", &model, None, None),
        Case::new("plugin without a sink", &model, Some(RerunPlugin::none()), None),
        Case::new("viewer absent", &model, Some(viewer_at(free_port())), None),
        Case::new("viewer that never reads", &model, Some(viewer_at(deaf_port)), None),
        file("file, as it comes", &model, scratch("file"), rates()),
        file("file, no shapes", &model, scratch("figures"), RerunRecording { shapes_hz: 0.0, ..rates() }),
        file(
            "file, no shapes, figures 10 Hz",
            &model,
            scratch("few"),
            RerunRecording { shapes_hz: 0.0, metrics_hz: 10.0, hands_hz: 10.0, modes_hz: 0.0, ..rates() },
        ),
        file(
            "file, stress",
            &model,
            scratch("stress"),
            RerunRecording { color: RerunColor::Stress, ..rates() },
        ),
    ];
    if let Some(viewer) = &viewer {
        cases.insert(4, Case::new("viewer that reads", &model, Some(viewer_at(viewer.port)), Some(read)));
    } else {
        println!("`rerun` is not installed: the viewer that reads is left out");
    }

    // The first second is for warming caches, opening connections and loading bodies.
    for turn in 0..=seconds {
        for case in &mut cases {
            case.turn(turn > 0);
        }
    }
    println!("{} updates a case; us:", seconds * TURN);
    println!(
        "| case | update, median | 99 % | longest | frame, 99 % | against none | dropped | bytes a second |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- |");
    let mut bare = None;
    for case in cases {
        let dropped = case.app.world().get_resource::<RerunStats>().map_or(0, |stats| stats.dropped);
        let Case { name, app, file, mut updates, mut frames } = case;
        drop(app);
        let [median, most, longest] = [0.5, 0.99, 1.0].map(|share| percentile(&mut updates, share));
        let frame = percentile(&mut frames, 0.99);
        let none = *bare.get_or_insert(frame);
        let bytes = file.map(|file| {
            let bytes = std::fs::metadata(&file).map_or(0, |data| data.len());
            std::fs::remove_file(file).ok();
            format!("{:.0}", bytes as f64 * HZ / ((seconds + 1) * TURN) as f64)
        });
        println!(
            "| {name} | {median:.0} | {most:.0} | {longest:.0} | {frame:.0} | {:+.1} % | {dropped} | {} |",
            100.0 * (frame / none - 1.0),
            bytes.as_deref().unwrap_or("")
        );
    }
}

fn file(name: &'static str, model: &Arc<ModalModel>, path: PathBuf, rates: RerunRecording) -> Case {
    Case::new(name, model, Some(RerunPlugin::file(&path).with_rates(rates)), Some(path))
}

fn viewer_at(port: u16) -> RerunPlugin {
    RerunPlugin::viewer().with_viewer_port(port).with_spawn(false)
}

/// Returns a port that was free a moment ago.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

fn percentile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * share) as usize]
}

impl Case {
    fn new(
        name: &'static str,
        model: &Arc<ModalModel>,
        plugin: Option<RerunPlugin>,
        file: Option<PathBuf>,
    ) -> Self {
        let mut app = App::new();
        app.add_plugins((
            MinimalPlugins,
            AssetPlugin::default(),
            TransformPlugin,
            PliantBodyPlugin::default(),
        ))
        .insert_resource(Time::<Fixed>::from_hz(HZ))
        .insert_resource(TimeUpdateStrategy::FixedTimesteps(1))
        .add_systems(FixedUpdate, move_hands.before(PliantSystems::Input));
        if let Some(plugin) = plugin {
            app.add_plugins(plugin);
        }
        app.finish();
        app.cleanup();
        let asset = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model.clone()));
        let body = app.world_mut().spawn((ModalBody::new(asset), Name::new("pip"))).id();
        for (way, name) in [(-1.0, "left"), (1.0, "right")] {
            let positions = model.surface().positions();
            let along = |p: &[f32; 3]| way * p[0] + p[1];
            let far =
                (0..positions.len()).max_by(|&a, &b| along(&positions[a]).total_cmp(&along(&positions[b])));
            let vertex = far.unwrap();
            let at = Vec3::from(positions[vertex]).as_dvec3();
            let grab = Grab::new(vertex as u32, 0.06 * model.size(), at);
            app.world_mut().spawn((grab, GrabOf(body), Name::new(name), At(at)));
        }
        Self { name, app, file, updates: Vec::new(), frames: Vec::new() }
    }

    fn turn(&mut self, counts: bool) {
        let mut next = Instant::now();
        for _ in 0..TURN {
            next += Duration::from_secs_f64(1.0 / HZ);
            let start = Instant::now();
            self.app.update();
            let update = start.elapsed();
            while start.elapsed() < update + SPIN {
                std::hint::spin_loop();
            }
            if counts {
                self.updates.push(update.as_secs_f64() * 1e6);
                self.frames.push(start.elapsed().as_secs_f64() * 1e6);
            }
            std::thread::sleep(next.saturating_duration_since(Instant::now()));
        }
    }
}

/// Position at which a hand grabbed, m.
#[derive(Component)]
struct At(DVec3);

fn move_hands(time: Res<Time>, mut hands: Query<(&mut Grab, &At)>) {
    let t = time.elapsed_secs_f64();
    for (mut grab, At(at)) in &mut hands {
        let way = at.x.signum();
        let swing = DVec3::new(way * (1.0 - (2.1 * t).cos()), 0.6 * (1.3 * t).sin(), 0.8 * (1.7 * t).sin());
        grab.target = *at + 0.05 * swing;
    }
}

/// A `rerun --save` process, which receives everything and writes it to a file.
struct Viewer {
    port: u16,
    process: Child,
}

impl Viewer {
    fn start(path: &PathBuf) -> Option<Self> {
        let port = free_port();
        let process = Command::new("rerun")
            .args(["--port", &port.to_string(), "--save"])
            .arg(path)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .ok()?;
        let mut viewer = Self { port, process };
        let start = Instant::now();
        while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
            let ended = viewer.process.try_wait().is_ok_and(|status| status.is_some());
            if ended || start.elapsed() > Duration::from_secs(20) {
                return None;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        Some(viewer)
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        self.process.kill().ok();
        self.process.wait().ok();
    }
}
