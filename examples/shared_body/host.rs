//! The host, which steps the body and streams it without a window.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use bevy::{app::ScheduleRunnerPlugin, diagnostic::DiagnosticsStore, prelude::*};
use pliant::{
    body::{Integrator, STEP_TIME},
    modal::ModalModel,
    net::{HandOf, NetHost, NetPlugin, NetStats, SharedBody, User},
    prelude::*,
};

use crate::{BODY, RATE, meter::Truth};

/// Number of steps whose times are kept: half an hour.
const STEPS: usize = 72_000;

/// The results of the host.
#[derive(Default, Clone, Debug)]
pub struct HostReport {
    /// Ticks stepped while a guest was in the session.
    pub ticks: u64,
    /// Bytes sent to all guests.
    pub bytes_out: u64,
    /// Seconds over which these bytes were sent.
    pub seconds: f64,
    /// Times of the newest steps, us; a resting body is not stepped.
    pub step_us: VecDeque<f64>,
    /// Largest true reaction on the hands of each user, N, by the user's name.
    pub reactions: BTreeMap<String, f64>,
}

/// The report while it grows, and the flag that stops the host.
#[derive(Resource, Clone, Default)]
pub struct Shared {
    pub report: Arc<Mutex<HostReport>>,
    pub stop: Arc<AtomicBool>,
}

impl Shared {
    pub fn snapshot(&self) -> HostReport {
        self.report.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

#[derive(Resource)]
struct Model(Arc<ModalModel>);

#[derive(Resource)]
struct Stepped(Integrator);

/// Runs the host's app on this thread until the flag stops it.
pub fn run(model: Arc<ModalModel>, integrator: Integrator, net: NetPlugin, truth: Truth, shared: Shared) {
    App::new()
        .add_plugins((
            MinimalPlugins.set(ScheduleRunnerPlugin::run_loop(Duration::from_millis(2))),
            AssetPlugin::default(),
            TransformPlugin,
            PliantBodyPlugin::default(),
            net,
        ))
        .insert_resource(Time::<Fixed>::from_hz(RATE))
        .insert_resource(Model(model))
        .insert_resource(Stepped(integrator))
        .insert_resource(truth)
        .insert_resource(shared)
        .add_systems(Startup, spawn)
        .add_systems(FixedUpdate, record.after(PliantSystems::Publish))
        .add_systems(Last, stop)
        .run();
}

fn spawn(
    mut commands: Commands,
    model: Res<Model>,
    integrator: Res<Stepped>,
    mut assets: ResMut<Assets<ModalAsset>>,
) {
    let asset = assets.add(ModalAsset::from(model.0.clone()));
    let mut body = ModalBody::new(asset);
    body.settings.integrator = integrator.0;
    commands.spawn((body, SharedBody::named(BODY)));
}

fn record(
    tick: Res<PliantTick>,
    host: Option<Res<NetHost>>,
    stats: Res<NetStats>,
    time: Res<Time<Real>>,
    truth: Res<Truth>,
    shared: Res<Shared>,
    diagnostics: Res<DiagnosticsStore>,
    bodies: Query<&BodyState>,
    hands: Query<(&GrabForce, &HandOf)>,
    users: Query<&User>,
    mut since: Local<Option<f64>>,
    mut last: Local<Option<Instant>>,
) {
    for state in &bodies {
        truth.push(tick.0, state.body().q());
    }
    if host.is_none_or(|host| host.guests().next().is_none()) {
        return;
    }
    let now = time.elapsed_secs_f64();
    let begun = *since.get_or_insert(now);
    let mut report = shared.report.lock().unwrap_or_else(PoisonError::into_inner);
    report.ticks += 1;
    for (force, of) in &hands {
        let Ok(user) = users.get(of.0) else { continue };
        let largest = report.reactions.entry(user.name.clone()).or_default();
        *largest = largest.max(force.force.length());
    }
    report.bytes_out = stats.bytes_out;
    report.seconds = now - begun;
    if let Some(step) = diagnostics.get_measurement(&STEP_TIME)
        && last.replace(step.time) != Some(step.time)
    {
        report.step_us.push_back(step.value * 1e3);
        if report.step_us.len() > STEPS {
            report.step_us.pop_front();
        }
    }
}

fn stop(shared: Res<Shared>, mut exit: MessageWriter<AppExit>) {
    if shared.stop.load(Ordering::Relaxed) {
        exit.write(AppExit::Success);
    }
}
