//! The app's side: reads what others published and offers it to the workers.

use std::{
    borrow::Cow,
    collections::{HashMap, HashSet},
    sync::Arc,
    time::{Instant, SystemTime},
};

use bevy::{diagnostic::DiagnosticsStore, prelude::*};
use pliant_body::{BodyRefused, BodyState, Grab, GrabForce, PliantTick, ShownState};

use crate::{
    RerunRecording, RerunScalars, RerunStats, RerunStyle,
    frame::{Drawn, Frame, Hand, Line, Place, Scalar, Shape},
    worker::Worker,
};

#[derive(Resource)]
pub(crate) struct Collector {
    workers: Vec<Worker>,
    /// When the last drawing was due, s of simulated time.
    last_drawing: f64,
    bodies: HashMap<Entity, Followed>,
    /// Bodies that some worker has not taken notice of.
    untold: bool,
    had_hands: bool,
    /// Newest measurement of each diagnostic that was recorded.
    measured: HashMap<String, Instant>,
}

/// Hands that are not entities here: those of a session's other users.
#[derive(Resource, Default)]
pub(crate) struct OtherHands(pub Vec<Hand>);

struct Followed {
    drawn: Arc<Drawn>,
    version: u64,
    place: Option<Place>,
    /// The newest shape was drawn.
    complete: bool,
}

impl Collector {
    pub fn new(workers: Vec<Worker>) -> Self {
        Self {
            workers,
            last_drawing: f64::NEG_INFINITY,
            bodies: HashMap::new(),
            untold: false,
            had_hands: false,
            measured: HashMap::new(),
        }
    }

    /// Whether a drawing is due at simulated time `time`, at `hz` drawings a second.
    fn drawing_is_due(&mut self, time: f64, hz: f64) -> bool {
        let period = 1.0 / hz;
        // A millionth of a second of slack: 20 Hz of drawings in 40 Hz of ticks is every second one, whatever the rounding.
        if !(period > 0.0 && period.is_finite()) || time + 1e-6 < self.last_drawing + period {
            return false;
        }
        let next = self.last_drawing + period;
        self.last_drawing = if time < next + period { next } else { time };
        true
    }
}

pub(crate) fn somebody_listens(collector: Res<Collector>, recording: Res<RerunRecording>) -> bool {
    recording.on && collector.workers.iter().any(Worker::listens)
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
        &'static ShownState,
        &'static GlobalTransform,
        Option<&'static RerunStyle>,
    ),
>;

#[expect(
    clippy::too_many_arguments,
    reason = "a reader of everything; each argument is one thing that is read"
)]
pub(crate) fn collect(
    mut collector: ResMut<Collector>,
    mut stats: ResMut<RerunStats>,
    mut own: ResMut<RerunScalars>,
    recording: Res<RerunRecording>,
    tick: Res<PliantTick>,
    time: Res<Time>,
    diagnostics: Option<Res<DiagnosticsStore>>,
    mut refused: MessageReader<BodyRefused>,
    others: Res<OtherHands>,
    bodies: Bodies,
    grabs: Query<(Entity, Option<&Name>, &Grab, &GrabForce)>,
) {
    let collector = &mut *collector;
    let now = time.elapsed_secs_f64();
    let mut frame = Frame {
        tick: tick.0,
        time: now,
        wall: SystemTime::UNIX_EPOCH.elapsed().map_or(0.0, |since| since.as_secs_f64()),
        scalars: std::mem::take(&mut own.scalars),
        lines: std::mem::take(&mut own.lines),
        ..Frame::default()
    };
    frame.lines.extend(
        refused
            .read()
            .map(|refused| Line { warning: true, text: format!("{}: {}", refused.entity, refused.error) }),
    );
    let draw = collector.drawing_is_due(now, recording.shapes_hz);
    follow_bodies(collector, &mut frame, &bodies, draw);

    let mut hands: Vec<_> = grabs.iter().collect();
    hands.sort_by_key(|(entity, ..)| *entity);
    let hands = hands.into_iter().map(|(_, name, grab, force)| hand(name, grab, force));
    let hands: Vec<Hand> = hands.chain(others.0.iter().cloned()).collect();
    if !hands.is_empty() || collector.had_hands {
        collector.had_hands = !hands.is_empty();
        frame.hands = Some(hands);
    }
    if let Some(diagnostics) = &diagnostics {
        frame.scalars.extend(measurements(&mut collector.measured, diagnostics));
    }

    if collector.untold {
        frame.arrived = collector.bodies.values().map(|followed| followed.drawn.clone()).collect();
        frame.arrived.sort_by(|a, b| a.path.cmp(&b.path));
    }
    let frame = Arc::new(frame);
    let mut missed = false;
    for worker in &mut collector.workers {
        missed |= !worker.offer(&frame) && worker.listens();
    }
    // A frame that was dropped may have told of a body or drawn its last shape: tell again.
    collector.untold = missed;
    if missed {
        collector.bodies.values_mut().for_each(|followed| followed.complete = false);
    }
    stats.collected += 1;
    stats.shapes += frame.shapes.len() as u64;
    stats.dropped = collector.workers.iter().map(Worker::dropped).sum();
    stats.sinks = collector.workers.iter().filter(|worker| worker.listens()).count();
}

fn follow_bodies(collector: &mut Collector, frame: &mut Frame, bodies: &Bodies, draw: bool) {
    let present: HashSet<Entity> = bodies.iter().map(|(entity, ..)| entity).collect();
    collector.bodies.retain(|entity, followed| {
        let stays = present.contains(entity);
        if !stays {
            frame.left.push(followed.drawn.path.clone());
        }
        stays
    });
    for (entity, name, state, shown, transform, style) in bodies {
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
            collector.untold = true;
        }
        let Some(followed) = collector.bodies.get_mut(&entity) else { continue };
        let (scale, rotation, translation) = transform.to_scale_rotation_translation();
        let place = Place { translation: translation.into(), rotation: rotation.into(), scale: scale.x };
        let moved = followed.version != shown.version() || followed.place != Some(place);
        if !moved && shown.is_settled() && (followed.complete || !draw) {
            continue;
        }
        followed.version = shown.version();
        followed.place = Some(place);
        followed.complete = draw && shown.is_settled();
        frame.shapes.push(Shape {
            body: followed.drawn.clone(),
            q: shown.current().iter().map(|&q| q as f32).collect(),
            warped: state.warps(),
            place,
            draw,
        });
    }
}

/// The entity's name, or a number; made different from the names in use.
fn free_path(bodies: &HashMap<Entity, Followed>, entity: Entity, name: Option<&Name>) -> Arc<str> {
    let name = name.map_or_else(|| format!("body {entity}"), |name| name.as_str().replace('/', " "));
    if bodies.values().any(|followed| *followed.drawn.path == *name) {
        format!("{name} {entity}").into()
    } else {
        name.into()
    }
}

fn hand(name: Option<&Name>, grab: &Grab, force: &GrabForce) -> Hand {
    Hand {
        name: name.map_or("hand", Name::as_str).replace('/', " ").into(),
        force: force.force.into(),
        point: force.point.into(),
        target: grab.target.into(),
    }
}

/// The diagnostics under `pliant/` that were measured since the last tick.
fn measurements(measured: &mut HashMap<String, Instant>, diagnostics: &DiagnosticsStore) -> Vec<Scalar> {
    let mut scalars = Vec::new();
    for diagnostic in diagnostics.iter() {
        let Some(rest) = diagnostic.path().as_str().strip_prefix("pliant/") else { continue };
        let Some(measurement) = diagnostic.measurement() else { continue };
        if measured.get(rest) == Some(&measurement.time) {
            continue;
        }
        measured.insert(rest.to_owned(), measurement.time);
        let path = if rest.contains('/') { rest.to_owned() } else { format!("time/{rest}") };
        let unit = diagnostic.suffix.trim().to_owned();
        scalars.push(Scalar { path: Cow::Owned(path), unit: Cow::Owned(unit), value: measurement.value });
    }
    scalars
}
