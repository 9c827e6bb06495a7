//! The app's side: reads what others published and offers it to the workers.

use std::{
    borrow::Cow,
    collections::{HashMap, HashSet},
    sync::Arc,
    time::{Instant, SystemTime},
};

use bevy::{diagnostic::DiagnosticsStore, ecs::entity::EntityHashMap, prelude::*};
use pliant_body::{BodyRefused, BodyState, Driven, Grab, GrabForce, PliantTick, ShownState};

use crate::{
    RerunRecording, RerunScalars, RerunStats, RerunStyle,
    frame::{Drawn, Frame, Hand, Line, Place, Scalar, Shape},
    worker::Worker,
};

#[derive(Resource)]
pub(crate) struct Collector {
    workers: Vec<Worker>,
    shapes: Due,
    figures: Due,
    hands: Due,
    modes: Due,
    bodies: HashMap<Entity, Followed>,
    /// Bodies that some worker has not taken notice of.
    untold: bool,
    had_hands: bool,
    /// Newest measurement of each diagnostic that was recorded.
    measured: HashMap<String, Instant>,
}

/// What a session says of hands.
#[derive(Resource, Default)]
pub(crate) struct Hands {
    /// Those that are not entities here: of a session's other users.
    pub others: Vec<Hand>,
    /// Whose those are that are.
    pub whose: EntityHashMap<Whose>,
}

/// The user behind a hand.
#[derive(Debug, Clone)]
pub(crate) struct Whose {
    pub name: String,
    /// sRGB.
    pub colour: [u8; 3],
}

/// When something was due last, s of simulated time.
#[derive(Debug, Clone, Copy)]
struct Due(f64);

impl Due {
    const NEVER: Self = Self(f64::NEG_INFINITY);

    /// Whether it is due at simulated time `time`, so often as `hz` says.
    fn at(&mut self, time: f64, hz: f64) -> bool {
        let period = 1.0 / hz;
        // A millionth of a second of slack: 20 Hz in 40 Hz of ticks is every second one, whatever the rounding. Time that went back is a new run.
        if hz.is_nan() || hz <= 0.0 || (time + 1e-6 < self.0 + period && time >= self.0) {
            return false;
        }
        let next = self.0 + period;
        self.0 = if time < next + period { next } else { time };
        true
    }
}

/// What of a tick is wanted now.
#[derive(Debug, Clone, Copy)]
struct Wanted {
    draw: bool,
    figures: bool,
    /// A sample for the spectrum.
    sample: bool,
    /// The energies of the modes.
    energies: bool,
    /// Length of a tick, s.
    tick: f64,
}

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
            shapes: Due::NEVER,
            figures: Due::NEVER,
            hands: Due::NEVER,
            modes: Due::NEVER,
            bodies: HashMap::new(),
            untold: false,
            had_hands: false,
            measured: HashMap::new(),
        }
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
        &'static Driven,
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
    session: Res<Hands>,
    bodies: Bodies,
    grabs: Query<(Entity, Option<&Name>, &Grab, &GrabForce)>,
) {
    let collector = &mut *collector;
    let now = time.elapsed_secs_f64();
    let mut frame = Frame {
        tick: tick.0,
        time: now,
        wall: SystemTime::UNIX_EPOCH.elapsed().map_or(0.0, |since| since.as_secs_f64()),
        colour: recording.colour,
        lines: std::mem::take(&mut own.lines),
        ..Frame::default()
    };
    frame.lines.extend(
        refused
            .read()
            .map(|refused| Line { warning: true, text: format!("{}: {}", refused.entity, refused.error) }),
    );
    let wanted = Wanted {
        draw: collector.shapes.at(now, recording.shapes_hz),
        figures: collector.figures.at(now, recording.figures_hz),
        sample: recording.modes_hz > 0.0,
        energies: collector.modes.at(now, recording.modes_hz),
        tick: time.delta_secs_f64(),
    };
    follow_bodies(collector, &mut frame, &bodies, wanted);

    if collector.hands.at(now, recording.hands_hz) {
        let mut hands: Vec<_> = grabs.iter().collect();
        hands.sort_by_key(|(entity, ..)| *entity);
        let hands = hands
            .into_iter()
            .map(|(entity, name, grab, force)| hand(name, session.whose.get(&entity), grab, force));
        let hands: Vec<Hand> = hands.chain(session.others.iter().cloned()).collect();
        if !hands.is_empty() || collector.had_hands {
            collector.had_hands = !hands.is_empty();
            frame.hands = Some(hands);
        }
    }
    if wanted.figures {
        frame.scalars = std::mem::take(&mut own.scalars);
        if let Some(diagnostics) = &diagnostics {
            frame.scalars.extend(measurements(&mut collector.measured, diagnostics));
        }
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

fn follow_bodies(collector: &mut Collector, frame: &mut Frame, bodies: &Bodies, wanted: Wanted) {
    let present: HashSet<Entity> = bodies.iter().map(|(entity, ..)| entity).collect();
    collector.bodies.retain(|entity, followed| {
        let stays = present.contains(entity);
        if !stays {
            frame.left.push(followed.drawn.path.clone());
        }
        stays
    });
    for (entity, name, state, shown, driven, transform, style) in bodies {
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
        let draw = wanted.draw && style != RerunStyle::Hidden;
        if !moved && shown.is_settled() && (followed.complete || !draw) {
            continue;
        }
        if !(draw || wanted.figures || wanted.sample) {
            // What moves goes on counting as moved until somebody wants it.
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
            stiffness: state.body().config().stiffness_scale as f32,
            draw,
            figures: wanted.figures,
            sample: wanted.sample,
            energies: wanted.energies.then(|| energies(state, driven, shown, wanted.tick)),
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

/// Kinetic and elastic energy of each mode, J. Of a body that somebody else steps the velocities are those of its shape over the last tick of
/// `tick` seconds.
fn energies(state: &BodyState, driven: &Driven, shown: &ShownState, tick: f64) -> Vec<f64> {
    let body = state.body();
    let scale = state.scale() * state.scale();
    let of = |omega: f64, q: f64, v: f64| 0.5 * scale * (v * v + (omega * q).powi(2));
    let kept = body.omega().iter();
    match driven {
        Driven::Local => kept.zip(body.q()).zip(body.v()).map(|((&omega, &q), &v)| of(omega, q, v)).collect(),
        Driven::Remote => kept
            .zip(shown.current().iter().zip(shown.previous()))
            .map(|(&omega, (&q, &before))| of(omega, q, if tick > 0.0 { (q - before) / tick } else { 0.0 }))
            .collect(),
    }
}

fn hand(name: Option<&Name>, whose: Option<&Whose>, grab: &Grab, force: &GrabForce) -> Hand {
    let name = name.map(Name::as_str).or(whose.map(|whose| whose.name.as_str())).unwrap_or("hand");
    Hand {
        name: name.replace('/', " ").into(),
        colour: whose.map(|whose| whose.colour),
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
