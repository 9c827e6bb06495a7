//! A guest that sees, holds and feels the host's body, with or without a window.

use std::{
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::Duration,
};

use bevy::{
    app::ScheduleRunnerPlugin,
    log::{Level, LogPlugin},
    math::DVec3,
    prelude::*,
    render::view::screenshot::{Screenshot, ScreenshotCaptured, save_to_disk},
    window::PresentMode,
    winit::WinitSettings,
};
use pliant::{
    modal::{ModalModel, warp},
    net::{GuestState, NetGuest, NetPlugin, NetStats, RemoteBody, RemoteHands, SharedBody, User, color_of},
    prelude::*,
    rerun::{RerunPlugin, RerunScalars},
};

use crate::{
    BODY, RATE,
    hand::{self, ScriptedHand},
    meter::{Meters, Truth},
    stage,
    view::{DrawnHand, HeldBy, ViewPlugin},
};

/// Settings of one guest.
pub struct Guest {
    pub title: String,
    pub net: NetPlugin,
    pub truth: Truth,
    /// The script of the hand if no person moves it.
    pub hand: Option<ScriptedHand>,
    pub rerun: Option<RerunPlugin>,
    /// Seconds after the body is first shown. `None`: until told to stop, or until the window
    /// closes.
    pub duration: Option<f64>,
    /// Frames, picture, window and panel.
    pub stage: stage::Options,
    pub stop: Arc<AtomicBool>,
    /// Number of guests of this process that have not seen the body yet. Time counts from when it
    /// is zero.
    pub missing: Arc<AtomicUsize>,
}

/// The results of a guest, kept after its app has ended.
#[derive(Default, Clone)]
pub struct GuestReport {
    pub meters: Meters,
    pub stats: NetStats,
    /// Why the session ended early, if it did.
    pub failure: Option<String>,
}

/// Marks the guest's copy of the body.
#[derive(Component)]
pub struct GuestBody;

/// The newest metrics, for the corner of the window and for the recording.
#[derive(Resource, Default)]
pub struct Metrics {
    pub joined: bool,
    pub loss: f64,
    pub round_trip: f64,
    /// Magnitude of the reaction on the local hand, N.
    pub reaction: f64,
    pub kbit_s: f64,
    /// How far the predicted body is ahead of the streamed body while the local hand holds it, s.
    pub ahead: f64,
}

#[derive(Resource)]
struct Run {
    duration: Option<f64>,
    /// Frames left, counted while the body exists.
    frames: Option<u64>,
    screenshot: Option<PathBuf>,
    stop: Arc<AtomicBool>,
    missing: Arc<AtomicUsize>,
    /// Whether this guest has seen the body.
    seen: bool,
    /// Time at which all guests had seen the body, s.
    since: Option<f64>,
    /// Time at which the screenshot was requested, s.
    asked: f64,
    picture: Picture,
    failure: Option<String>,
}

/// State of the screenshot, if one is requested.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Picture {
    Wanted,
    Asked,
    Saved,
}

/// Time that a guest waits for the body before it gives up, s.
const PATIENCE: f64 = 300.0;

/// Runs a guest with a window on this thread, which must be the main thread.
pub fn run_windowed(guest: Guest) -> GuestReport {
    let mut app = App::new();
    app.add_plugins(
        DefaultPlugins
            .set(WindowPlugin {
                primary_window: Some(Window {
                    title: "Pliant: shared body".into(),
                    resolution: stage::resolution(&guest.stage),
                    present_mode: PresentMode::AutoVsync,
                    ..default()
                }),
                ..default()
            })
            .set(AssetPlugin { file_path: stage::ASSETS.into(), ..default() }),
    )
    // The session continues while the window is not in focus.
    .insert_resource(WinitSettings::continuous())
    .add_plugins((PointerGrabPlugin, ViewPlugin { title: guest.title.clone() }, guest.stage.panel()));
    run(app, guest)
}

/// Runs a guest without a window on this thread.
///
/// Only one app of a process may install the logger, which prints the messages of all of them.
pub fn run_headless(guest: Guest, prints: bool) -> GuestReport {
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins.set(ScheduleRunnerPlugin::run_loop(Duration::from_millis(4))),
        AssetPlugin::default(),
        TransformPlugin,
    ));
    if prints {
        app.add_plugins(LogPlugin { level: Level::WARN, ..default() });
    }
    run(app, guest)
}

fn run(mut app: App, guest: Guest) -> GuestReport {
    app.add_plugins((PliantBodyPlugin::default(), guest.net))
        .insert_resource(Time::<Fixed>::from_hz(RATE))
        .insert_resource(guest.truth)
        .init_resource::<Meters>()
        .init_resource::<Metrics>()
        .insert_resource(Run {
            duration: guest.duration,
            frames: guest.stage.frames,
            screenshot: guest.stage.screenshot,
            stop: guest.stop,
            missing: guest.missing,
            seen: false,
            since: None,
            asked: 0.0,
            picture: Picture::Wanted,
            failure: None,
        })
        .add_systems(Startup, spawn)
        .add_systems(Last, (measure, gather_hands, finish).chain());
    if let Some(hand) = guest.hand {
        app.insert_resource(hand).add_systems(FixedUpdate, hand::play.before(PliantSystems::Input));
    }
    if let Some(rerun) = guest.rerun {
        app.add_plugins(rerun).add_systems(Last, record.after(measure));
    }
    let kept = Kept::default();
    app.insert_resource(kept.clone()).add_systems(Last, keep.after(finish));
    app.run();
    kept.take()
}

/// Spawns the entity that receives the body.
fn spawn(mut commands: Commands) {
    commands.spawn((
        Name::new(BODY),
        SharedBody::named(BODY),
        GuestBody,
        HeldBy::default(),
        Transform::default(),
    ));
}

/// Compares the shown shapes with the truth of the same ticks and gathers the metrics.
fn measure(
    guest: Option<Res<NetGuest>>,
    stats: Res<NetStats>,
    truth: Res<Truth>,
    mut meters: ResMut<Meters>,
    mut metrics: ResMut<Metrics>,
    mut run: ResMut<Run>,
    time: Res<Time<Real>>,
    bodies: Query<(&RemoteBody, &BodyState), With<GuestBody>>,
    forces: Query<&GrabForce, With<Grab>>,
) {
    let Some(guest) = guest else { return };
    if let GuestState::Closed { reason } = guest.state() {
        run.failure.get_or_insert_with(|| reason.to_string());
    }
    metrics.loss = stats.loss_in;
    metrics.round_trip = stats.round_trip.as_secs_f64();
    metrics.kbit_s = stats.bytes_in_per_s * 8e-3;
    metrics.reaction = forces.iter().map(|f| f.force.length()).fold(0.0, f64::max);
    meters.reaction = meters.reaction.max(metrics.reaction);
    for (remote, state) in &bodies {
        let Some(view) = guest.body(*remote) else { continue };
        let Some(streamed) = view.visual() else { continue };
        metrics.joined = true;
        if !std::mem::replace(&mut run.seen, true) {
            run.missing.fetch_sub(1, Ordering::Relaxed);
        }
        if run.missing.load(Ordering::Relaxed) == 0 {
            run.since.get_or_insert(time.elapsed_secs_f64());
        }
        meters.streamed.show(view.tick(), &streamed.q);
        metrics.ahead = 0.0;
        if let Some(own) = view.predicted_hand() {
            // The host has yet to reach this tick; the shape is compared when it has.
            metrics.ahead = own.tick().saturating_sub(view.tick()) as f64 / RATE;
            meters.predicted_hand.show(own.tick(), &own.visual().q);
            meters.waiting.show(own.tick(), &streamed.q);
        }
        meters.compare(state.model(), &truth);
    }
}

/// Collects all hands on the body: the remote hands from the stream, the local hand from its
/// entity.
fn gather_hands(
    mut bodies: Query<
        (&RemoteHands, &BodyState, &VisualState, &GlobalTransform, &mut HeldBy),
        With<GuestBody>,
    >,
    own: Query<(&Grab, &GrabForce), Without<PointerHeld>>,
    you: Query<&User, With<pliant::net::Yourself>>,
) {
    for (seen, state, shown, place, mut held) in &mut bodies {
        held.0.clear();
        for hand in &seen.0 {
            let point =
                place.transform_point(surface_point(state.model(), hand.vertex, shown.q())).as_dvec3();
            held.0.push(DrawnHand {
                target: hand.target,
                point,
                force: hand.reaction,
                color: color_of(hand.user),
            });
        }
        let color = you.iter().next().map_or(Color::WHITE, |user| user.color);
        for (grab, force) in &own {
            held.0.push(DrawnHand { target: grab.target, point: force.point, force: force.force, color });
        }
    }
}

fn surface_point(model: &ModalModel, vertex: u32, q: &[f64]) -> Vec3 {
    let Some(rest) = model.surface().positions().get(vertex as usize) else { return Vec3::ZERO };
    let (mut d, mut w) = ([0.0f64; 3], [0.0f64; 3]);
    for (mode, q) in q.iter().enumerate() {
        for axis in 0..3 {
            d[axis] += q * f64::from(model.displacement_row(vertex, axis, mode));
            w[axis] += q * f64::from(model.rotation_row(vertex, axis, mode));
        }
    }
    Vec3::from(*rest) + DVec3::from(warp(w, d)).as_vec3()
}

/// Records the errors; the rerun plugin records shapes, forces and network metrics by itself.
fn record(metrics: Res<Metrics>, meters: Res<Meters>, mut scalars: ResMut<RerunScalars>) {
    if !metrics.joined {
        return;
    }
    for (name, meter) in [("streamed", &meters.streamed), ("predicted hand", &meters.predicted_hand)] {
        scalars.set(format!("error/{name}"), "%", meter.percent(meter.now));
    }
    scalars.set("error/streamed, rms", "%", meters.streamed.percent(meters.streamed.rms()));
}

/// Time limit for the screenshot, s; software renderers are slow.
const PICTURE: f64 = 60.0;

fn finish(
    mut commands: Commands,
    time: Res<Time<Real>>,
    mut run: ResMut<Run>,
    mut exit: MessageWriter<AppExit>,
) {
    let now = time.elapsed_secs_f64();
    if run.since.is_none() && now > PATIENCE {
        run.failure.get_or_insert_with(|| format!("no body within {PATIENCE} s"));
    }
    let shown_for = run.since.map_or(0.0, |since| now - since);
    if run.since.is_some() {
        run.frames = run.frames.map(|frames| frames.saturating_sub(1));
    }
    let over = run.duration.is_some_and(|duration| shown_for >= duration) || run.frames == Some(0);
    let mut done = over;
    if let Some(path) = run.screenshot.clone() {
        match run.picture {
            Picture::Wanted if over => {
                commands
                    .spawn(Screenshot::primary_window())
                    .observe(save_to_disk(path))
                    .observe(|_: On<ScreenshotCaptured>, mut run: ResMut<Run>| run.picture = Picture::Saved);
                run.picture = Picture::Asked;
                run.asked = now;
                done = false;
            }
            Picture::Wanted => {}
            Picture::Asked => done = false,
            Picture::Saved => done = true,
        }
        if run.picture == Picture::Asked && now > run.asked + PICTURE {
            run.failure.get_or_insert_with(|| "the window could not be pictured".into());
        }
    }
    if done || run.failure.is_some() || run.stop.load(Ordering::Relaxed) {
        exit.write(AppExit::Success);
    }
}

/// The report that remains when the app has ended.
#[derive(Resource, Clone, Default)]
struct Kept(Arc<std::sync::Mutex<GuestReport>>);

impl Kept {
    fn take(&self) -> GuestReport {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner))
    }
}

fn keep(kept: Res<Kept>, meters: Res<Meters>, stats: Res<NetStats>, run: Res<Run>) {
    let mut report = kept.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    report.meters.clone_from(&meters);
    // A closed connection has no metrics, so the last ones are kept.
    if stats.peers > 0 {
        report.stats = *stats;
    }
    report.failure.clone_from(&run.failure);
}
