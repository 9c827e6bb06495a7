//! The app's side of the recording: reads the published data and offers it to the workers.

use std::{
    collections::{HashMap, HashSet},
    sync::Arc,
    time::SystemTime,
};

use bevy::{
    diagnostic::{DiagnosticPath, DiagnosticsStore},
    ecs::entity::EntityHashMap,
    platform::time::Instant,
    prelude::*,
};
use crossbeam_channel::Receiver;
use pliant_body::{BodyRefused, BodyState, BodyStepTimes, Driven, Grab, GrabForce, PliantTick, VisualState};

use crate::{
    RerunRecording, RerunScalars, RerunStats, RerunStyle,
    frame::{BodyTransform, Drawn, Metric, RecordedContact, RecordedFrame, RecordedHand, ShapeFrame},
    log_lines::LogLines,
    worker::Worker,
};

#[derive(Resource)]
pub(crate) struct Collector {
    workers: Vec<Worker>,
    /// Logged frames whose memory is reused, so that recording every tick allocates nothing new.
    spare: Receiver<RecordedFrame>,
    shapes: Due,
    metrics: Due,
    hands: Due,
    modes: Due,
    texts: Due,
    bodies: HashMap<Entity, Followed>,
    /// Whether there are new bodies that no frame contains yet.
    unsent_bodies: bool,
    had_hands: bool,
    contacts: Touches,
    /// The diagnostics that were recorded.
    measured: HashMap<DiagnosticPath, Measured>,
    /// Grabs in the order of their drawing. `names` holds their names.
    order: Vec<Entity>,
    names: EntityHashMap<Called>,
}

/// The places where bodies touch.
#[derive(Default)]
struct Touches {
    places: Vec<RecordedContact>,
    /// Whether the places have to be drawn.
    due: bool,
}

struct Measured {
    /// Time of the newest measurement.
    newest: Instant,
    metric: Arc<Metric>,
}

/// The given name of a hand and its recorded name.
struct Called {
    given: String,
    name: Arc<str>,
}

/// The session's data about hands.
#[derive(Resource, Default)]
pub(crate) struct Hands {
    /// Hands of the session's other users that are not entities of this app.
    pub others: Vec<RecordedHand>,
    /// The users of the hands that are entities of this app.
    pub whose: EntityHashMap<Whose>,
}

/// The user of a hand.
#[derive(Debug, Clone)]
pub(crate) struct Whose {
    pub name: String,
    /// Color, sRGB.
    pub color: [u8; 3],
}

/// Simulated time at which something was last due, s.
#[derive(Debug, Clone, Copy)]
struct Due(f64);

impl Due {
    const NEVER: Self = Self(f64::NEG_INFINITY);

    /// Whether something with rate `hz` is due at simulated time `time`.
    fn at(&mut self, time: f64, hz: f64) -> bool {
        let period = 1.0 / hz;
        // With the tolerance of a microsecond, 20 Hz is exactly every second tick at 40 Hz,
        // whatever the rounding. Time that goes back starts a new run.
        if hz.is_nan() || hz <= 0.0 || (time + 1e-6 < self.0 + period && time >= self.0) {
            return false;
        }
        let next = self.0 + period;
        self.0 = if time < next + period { next } else { time };
        true
    }
}

/// The data that is recorded of the current tick. The decision comes before the gathering, so that
/// a stream that is off costs nothing.
#[derive(Resource, Debug, Default, Clone, Copy)]
pub(crate) struct WantedData {
    draw: bool,
    metrics: bool,
    hands: bool,
    /// Whether a sample for the spectrum is taken.
    sample: bool,
    /// Whether the energies of the modes are drawn as bars.
    bars: bool,
    /// Whether states that are logged as text are checked for changes, a few times per second.
    texts: bool,
    /// Length of a tick, s.
    tick: f64,
}

/// Rate of checks for states that are logged as text, Hz of simulated time.
const TEXTS_HZ: f64 = 10.0;

struct Followed {
    drawn: Arc<Drawn>,
    version: u64,
    place: Option<BodyTransform>,
    /// Whether the newest shape was drawn.
    complete: bool,
}

impl Collector {
    pub fn new(workers: Vec<Worker>, spare: Receiver<RecordedFrame>) -> Self {
        Self {
            workers,
            spare,
            shapes: Due::NEVER,
            metrics: Due::NEVER,
            hands: Due::NEVER,
            modes: Due::NEVER,
            texts: Due::NEVER,
            bodies: HashMap::new(),
            unsent_bodies: false,
            had_hands: false,
            contacts: Touches::default(),
            measured: HashMap::new(),
            order: Vec::new(),
            names: EntityHashMap::default(),
        }
    }

    /// Takes the places where bodies touch, which are drawn if they have changed. `places` then has
    /// the former ones.
    #[cfg(feature = "contact")]
    pub fn set_contacts(&mut self, places: &mut Vec<RecordedContact>) {
        let touches = &mut self.contacts;
        if *places != touches.places {
            std::mem::swap(places, &mut touches.places);
            touches.due = true;
        }
    }

    /// The name under which a body is recorded. `None` before its first frame.
    pub fn path_of(&self, body: Entity) -> Option<&Arc<str>> {
        self.bodies.get(&body).map(|followed| &followed.drawn.path)
    }
}

pub(crate) fn somebody_listens(collector: Res<Collector>, recording: Res<RerunRecording>) -> bool {
    recording.on && collector.workers.iter().any(Worker::listens)
}

pub(crate) fn wants_metrics(wanted: Res<WantedData>) -> bool {
    wanted.metrics
}

#[cfg(any(feature = "contact", feature = "net"))]
pub(crate) fn wants_hands(wanted: Res<WantedData>) -> bool {
    wanted.hands
}

pub(crate) fn wants_text(wanted: Res<WantedData>) -> bool {
    wanted.texts
}

/// Drops gathered data while no sink is open or the recording is off, because this data does not
/// belong to the time that is recorded next.
pub(crate) fn forget(
    mut own: ResMut<RerunScalars>,
    mut wanted: ResMut<WantedData>,
    lines: Option<Res<LogLines>>,
) {
    own.forget_metrics();
    own.lines.clear();
    *wanted = WantedData::default();
    if let Some(lines) = lines {
        lines.0.try_iter().for_each(drop);
    }
}

/// Decides what is recorded of this tick.
pub(crate) fn decide(
    mut collector: ResMut<Collector>,
    mut wanted: ResMut<WantedData>,
    mut own: ResMut<RerunScalars>,
    mut stats: ResMut<RerunStats>,
    mut step_times: ResMut<BodyStepTimes>,
    recording: Res<RerunRecording>,
    time: Res<Time>,
) {
    let collector = &mut *collector;
    if recording.metrics_hz.is_nan() || recording.metrics_hz <= 0.0 {
        // The metrics are not recorded now, and would have a wrong time later.
        own.forget_metrics();
    }
    if collector.workers.iter().all(Worker::is_full) {
        // No queue has room, so no frame is made. What is due stays due.
        collector.workers.iter_mut().for_each(Worker::miss);
        collector.bodies.values_mut().for_each(|followed| followed.complete = false);
        own.forget_metrics();
        stats.dropped = collector.workers.iter().map(Worker::dropped).sum();
        *wanted = WantedData::default();
        return;
    }
    if recording.metrics_hz > 0.0 {
        step_times.ask();
    }
    let now = time.elapsed_secs_f64();
    *wanted = WantedData {
        draw: collector.shapes.at(now, recording.shapes_hz),
        metrics: collector.metrics.at(now, recording.metrics_hz),
        hands: collector.hands.at(now, recording.hands_hz),
        sample: recording.modes_hz > 0.0,
        bars: collector.modes.at(now, recording.modes_hz),
        texts: collector.texts.at(now, TEXTS_HZ),
        tick: time.delta_secs_f64(),
    };
}

pub(crate) fn close_at_exit(mut collector: ResMut<Collector>) {
    for worker in &mut collector.workers {
        worker.close();
    }
}

type Bodies<'w, 's> = Query<
    'w,
    's,
    (
        Entity,
        Option<&'static Name>,
        &'static BodyState,
        &'static VisualState,
        &'static Driven,
        &'static GlobalTransform,
        Option<&'static RerunStyle>,
    ),
>;

/// Logs the refused inputs as lines.
pub(crate) fn note_refusal(refused: On<BodyRefused>, mut own: ResMut<RerunScalars>) {
    own.warn(format!("{}: {}", refused.entity, refused.error));
}

#[expect(
    clippy::too_many_arguments,
    reason = "a reader of everything; each argument is one thing that is read"
)]
pub(crate) fn collect(
    mut collector: ResMut<Collector>,
    mut stats: ResMut<RerunStats>,
    mut own: ResMut<RerunScalars>,
    wanted: Res<WantedData>,
    recording: Res<RerunRecording>,
    tick: Res<PliantTick>,
    time: Res<Time>,
    diagnostics: Option<Res<DiagnosticsStore>>,
    logged: Option<Res<LogLines>>,
    session: Res<Hands>,
    bodies: Bodies,
    grabs: Grabs,
) {
    let collector = &mut *collector;
    let wanted = *wanted;
    if collector.workers.iter().all(Worker::is_full) && collector.workers.iter().any(Worker::listens) {
        // `decide` has counted this tick. The lines wait for a later frame.
        return;
    }
    let mut frame = collector.spare.try_recv().unwrap_or_default();
    frame.tick = tick.0;
    frame.time = time.elapsed_secs_f64();
    frame.wall = SystemTime::UNIX_EPOCH.elapsed().map_or(0.0, |since| since.as_secs_f64());
    frame.color = recording.color;
    std::mem::swap(&mut frame.lines, &mut own.lines);
    if let Some(logged) = logged {
        frame.lines.extend(logged.0.try_iter());
    }
    follow_bodies(collector, &mut frame, &bodies, wanted);
    if wanted.hands {
        gather_hands(collector, &mut frame, &grabs, &session);
        // A new body may be the largest or the heaviest, by which the arrows are scaled.
        let scaled = collector.unsent_bodies && !collector.contacts.places.is_empty();
        if std::mem::take(&mut collector.contacts.due) || scaled {
            frame.contacts_changed = true;
            frame.contacts.extend_from_slice(&collector.contacts.places);
        }
    }
    if wanted.metrics {
        std::mem::swap(&mut frame.scalars, &mut own.scalars);
        std::mem::swap(&mut frame.samples, &mut own.samples);
        std::mem::swap(&mut frame.measured, &mut own.measured);
        if let Some(diagnostics) = &diagnostics {
            measure(&mut collector.measured, diagnostics, &mut frame.measured);
        }
    }

    if std::mem::take(&mut collector.unsent_bodies) {
        frame.arrived.extend(collector.bodies.values().map(|followed| followed.drawn.clone()));
        frame.arrived.sort_by(|a, b| a.path.cmp(&b.path));
    }
    stats.collected += 1;
    stats.shapes += frame.shapes.len() as u64;
    let frame = Arc::new(frame);
    let mut missed = false;
    for worker in &mut collector.workers {
        let all = || collector.bodies.values().map(|followed| followed.drawn.clone()).collect();
        missed |= !worker.offer(&frame, all) && worker.listens();
    }
    if missed {
        // The dropped frame may hold the last shape of a body, so the shape must be drawn again.
        collector.bodies.values_mut().for_each(|followed| followed.complete = false);
        own.lost += 1;
    }
    stats.dropped = collector.workers.iter().map(Worker::dropped).sum();
    stats.sinks = collector.workers.iter().filter(|worker| worker.listens()).count();
    stats.removed = collector.workers.iter().map(Worker::removed).sum();
}

fn follow_bodies(collector: &mut Collector, frame: &mut RecordedFrame, bodies: &Bodies, wanted: WantedData) {
    collector.bodies.retain(|entity, followed| {
        let stays = bodies.contains(*entity);
        if !stays {
            frame.left.push(followed.drawn.path.clone());
        }
        stays
    });
    for (entity, name, state, visual, driven, transform, style) in bodies {
        let style = style.copied().unwrap_or_default();
        let known = collector.bodies.get(&entity);
        if known
            .is_none_or(|known| !Arc::ptr_eq(&known.drawn.model, state.model()) || known.drawn.style != style)
        {
            let path = known
                .map_or_else(|| free_path(&collector.bodies, entity, name), |known| known.drawn.path.clone());
            let drawn = Arc::new(Drawn { path, model: state.model().clone(), style });
            let followed = Followed { drawn, version: 0, place: None, complete: false };
            collector.bodies.insert(entity, followed);
            collector.unsent_bodies = true;
        }
        let Some(followed) = collector.bodies.get_mut(&entity) else { continue };
        let (scale, rotation, translation) = transform.to_scale_rotation_translation();
        let place =
            BodyTransform { translation: translation.into(), rotation: rotation.into(), scale: scale.x };
        let moved = followed.version != visual.version() || followed.place != Some(place);
        let draw = wanted.draw && style != RerunStyle::Hidden;
        if !moved && visual.is_settled() && (followed.complete || !draw) {
            continue;
        }
        if !(draw || wanted.metrics || wanted.sample) {
            // The body still counts as moved until its data is wanted.
            continue;
        }
        followed.version = visual.version();
        followed.place = Some(place);
        followed.complete = draw && visual.is_settled();
        let from = frame.coordinates.len();
        frame.coordinates.extend(visual.current().iter().map(|&q| q as f32));
        let energies = (wanted.metrics || wanted.bars).then(|| {
            let from = frame.energies.len();
            energies(&mut frame.energies, state, driven, visual, wanted.tick);
            from..frame.energies.len()
        });
        frame.shapes.push(ShapeFrame {
            body: followed.drawn.clone(),
            coordinates: from..frame.coordinates.len(),
            warped: state.warps(),
            place,
            stiffness: state.body().config().settings.stiffness_scale as f32,
            draw,
            metrics: wanted.metrics,
            sample: wanted.sample,
            energies,
            bars: wanted.bars,
        });
    }
}

/// Returns the entity's name, or a number, made different from the names in use.
fn free_path(bodies: &HashMap<Entity, Followed>, entity: Entity, name: Option<&Name>) -> Arc<str> {
    let name = name.map_or_else(|| format!("body {entity}"), |name| name.as_str().replace('/', " "));
    if bodies.values().any(|followed| *followed.drawn.path == *name) {
        format!("{name} {entity}").into()
    } else {
        name.into()
    }
}

/// Adds the kinetic and elastic energy of each mode, J, to `to`.
///
/// The velocities of a remote body are computed from the change of its shape over the last tick of
/// `tick` seconds.
fn energies(to: &mut Vec<f64>, state: &BodyState, driven: &Driven, visual: &VisualState, tick: f64) {
    let body = state.body();
    let scale = state.scale() * state.scale();
    let of = |omega: f64, q: f64, v: f64| 0.5 * scale * (v * v + (omega * q).powi(2));
    let kept = body.omega().iter();
    match driven {
        Driven::Local => {
            to.extend(kept.zip(body.q()).zip(body.v()).map(|((&omega, &q), &v)| of(omega, q, v)));
        }
        Driven::Remote => {
            to.extend(kept.zip(visual.current().iter().zip(visual.previous())).map(
                |(&omega, (&q, &before))| of(omega, q, if tick > 0.0 { (q - before) / tick } else { 0.0 }),
            ))
        }
    }
}

type Grabs<'w, 's> = Query<'w, 's, (Entity, Option<&'static Name>, &'static Grab, &'static GrabForce)>;

fn gather_hands(collector: &mut Collector, frame: &mut RecordedFrame, grabs: &Grabs, session: &Hands) {
    let order = &mut collector.order;
    order.clear();
    order.extend(grabs.iter().map(|(entity, ..)| entity));
    order.sort_unstable();
    let mut hands = frame.take_room();
    for &entity in &*order {
        let Ok((_, name, grab, force)) = grabs.get(entity) else { continue };
        let whose = session.whose.get(&entity);
        let given = name.map(Name::as_str).or(whose.map(|whose| whose.name.as_str())).unwrap_or("hand");
        let call = || Called { given: given.to_owned(), name: given.replace('/', " ").into() };
        let called = collector.names.entry(entity).or_insert_with(call);
        if called.given != given {
            *called = call();
        }
        hands.push(RecordedHand {
            name: called.name.clone(),
            color: whose.map(|whose| whose.color),
            force: force.force.into(),
            point: force.point.into(),
            target: grab.target.into(),
        });
    }
    if collector.names.len() > order.len() {
        let held: HashSet<Entity> = order.iter().copied().collect();
        collector.names.retain(|entity, _| held.contains(entity));
    }
    hands.extend_from_slice(&session.others);
    if !hands.is_empty() || collector.had_hands {
        collector.had_hands = !hands.is_empty();
        frame.hands = Some(hands);
    }
}

/// Paths of the diagnostics of `pliant_body`, whose own paths contain no area.
const AREAS: [(&str, &str); 3] =
    [("step", "time/step"), ("awake", "bodies/awake"), ("deform", "frame/deform")];

/// Adds the diagnostics under `pliant/` that were measured since the last tick to `to`.
fn measure(
    measured: &mut HashMap<DiagnosticPath, Measured>,
    diagnostics: &DiagnosticsStore,
    to: &mut Vec<(Arc<Metric>, f64)>,
) {
    for diagnostic in diagnostics.iter() {
        let Some(measurement) = diagnostic.measurement() else { continue };
        let Some(rest) = diagnostic.path().as_str().strip_prefix("pliant/") else { continue };
        if let Some(known) = measured.get_mut(diagnostic.path()) {
            if known.newest != measurement.time {
                known.newest = measurement.time;
                to.push((known.metric.clone(), measurement.value));
            }
            continue;
        }
        let known = AREAS.iter().find(|(name, _)| *name == rest).map(|(_, path)| (*path).to_owned());
        let path = known.unwrap_or_else(|| match rest.contains('/') {
            true => rest.to_owned(),
            false => format!("metrics/{rest}"),
        });
        let metric = Arc::new(Metric { path, unit: diagnostic.suffix.trim().to_owned() });
        to.push((metric.clone(), measurement.value));
        measured.insert(diagnostic.path().clone(), Measured { newest: measurement.time, metric });
    }
}
