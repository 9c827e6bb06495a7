//! Publishes the local model to each device's loop after a tick.

use std::sync::Arc;

use bevy::{math::DVec3, prelude::*};
use nalgebra::Matrix3;
use pliant_body::{
    BodyState, Driven, Grab, GrabForce, GrabOf, ProbeState, TouchProbe, Touching, VisualState,
};
use pliant_modal::{BodyConfig, GrabConfig, GrabId, ModalModel, Patch};

use super::{HapticDevices, HapticTool, ToolGrabs, ToolOffset};
use crate::{Coupling, HeldGrab, LocalModel, MAX_CONTACTS, ModalLocal, PublishedGrab, TouchBall, TouchPlane};

/// Number of missing states in a row after which a body that is stepped elsewhere counts as lost.
const MISSING_STATES: f64 = 4.0;
/// Bounds of the time that this is, s. The lower one is four ticks at 40 Hz, and after the upper
/// one a session's guest stands still by itself.
const PATIENCE: [f64; 2] = [0.1, 0.5];

type HeldItem<'w> = (Entity, &'w GrabOf, &'w Grab, &'w GrabForce, Option<&'w ToolOffset>);
type HeldGrabs<'w, 's> =
    Query<'w, 's, (Entity, &'static GrabOf, &'static Grab, &'static GrabForce, Option<&'static ToolOffset>)>;
type Bodies<'w, 's> =
    Query<'w, 's, (&'static BodyState, &'static Driven, &'static VisualState, &'static GlobalTransform)>;

/// Inputs of a local copy of a body. A change of any of them requires a new copy.
#[derive(Default, PartialEq)]
pub(crate) struct CopyOf {
    grabs: Vec<u64>,
    /// All grabs on the body. The copy also has the grabs of others, which come and go.
    all: Vec<GrabId>,
    /// Address of the model. The copy keeps the model alive, so no other model can have this
    /// address.
    model: usize,
    /// Address of the own shapes of held patches, which the copy keeps alive too.
    shapes: Option<usize>,
    /// Settings without the step, because the loop has a step of its own. In a schedule at frame
    /// rate, the step differs each time.
    config: Option<BodyConfig>,
    coupling: Option<Coupling>,
}

impl CopyOf {
    fn new(state: &BodyState, held: &[HeldGrab], coupling: &Coupling) -> Self {
        Self {
            grabs: held.iter().map(|grab| grab.key).collect(),
            all: state.body().grabs().collect(),
            model: Arc::as_ptr(state.model()).addr(),
            shapes: state.body().held_shapes().map(|shapes| Arc::as_ptr(shapes).addr()),
            config: Some(BodyConfig { step: 0.0, ..state.body().config().clone() }),
            coupling: Some(*coupling),
        }
    }
}

/// A grab on a body that is stepped elsewhere, the body's model and settings when its spring was
/// computed, and the spring.
struct Spring {
    of: Entity,
    grab: Grab,
    model: Arc<ModalModel>,
    config: BodyConfig,
    stiffness: Matrix3<f64>,
}

/// State of the tool's grabs on bodies that are stepped elsewhere.
#[derive(Default)]
pub(crate) struct Elsewhere {
    springs: Vec<(Entity, Spring)>,
    arrivals: Arrivals,
}

/// Arrivals of new states of bodies that are stepped elsewhere.
#[derive(Default)]
struct Arrivals {
    /// Version of the visual states, and the time of its last change, s.
    version: u64,
    at: f64,
    /// Smoothed time between changes, s. It follows the rate at which the states come.
    interval: f64,
}

impl Arrivals {
    /// Returns whether a state has arrived recently, given the present version.
    fn are_recent(&mut self, version: u64, now: f64) -> bool {
        let patience = (MISSING_STATES * self.interval).clamp(PATIENCE[0], PATIENCE[1]);
        let since = now - self.at;
        if version != self.version {
            (self.version, self.at) = (version, now);
            // A silence is not an interval, so it counts only as far as it was waited for.
            self.interval += 0.1 * (since.clamp(0.0, patience) - self.interval);
            return true;
        }
        since <= patience
    }
}

impl Elsewhere {
    /// Returns whether the held bodies have received a new state recently.
    fn is_alive(&mut self, held: &[HeldItem], bodies: &Bodies, now: f64) -> bool {
        let remote = held.iter().filter_map(|(_, of, ..)| bodies.get(of.0).ok());
        let mut remote = remote.filter(|(_, driven, ..)| **driven == Driven::Remote).peekable();
        if remote.peek().is_none() {
            return true;
        }
        let version =
            remote.fold(1u64, |sum, (.., shown, _)| sum.wrapping_mul(31).wrapping_add(shown.version()));
        self.arrivals.are_recent(version, now)
    }

    /// Returns the stiffness of the spring that ties a patch to the hand, N/m, body axes. The
    /// spring is that of such a grab on a copy of the body.
    fn spring(&mut self, entity: Entity, of: Entity, grab: &Grab, state: &BodyState) -> Matrix3<f64> {
        let config = BodyConfig { step: 0.0, ..state.body().config().clone() };
        let same = |known: &Spring| {
            known.of == of
                && Grab { target: known.grab.target, ..*grab } == known.grab
                && Arc::ptr_eq(&known.model, state.model())
                && known.config == config
        };
        if let Some((_, spring)) = self.springs.iter().find(|(e, known)| *e == entity && same(known)) {
            return spring.stiffness;
        }
        let mut probe = state.body().clone();
        let hold = GrabConfig { stiffness: grab.stiffness, relaxation: grab.relaxation };
        let compliance = Patch::around(state.model().surface(), grab.vertex, grab.radius)
            .ok()
            .and_then(|patch| probe.grab(&patch, hold).ok())
            .and_then(|id| probe.compliance(id).ok());
        let coupling = Matrix3::identity() * grab.stiffness.unwrap_or(0.0);
        let stiffness =
            compliance.and_then(|c| Matrix3::from_fn(|i, j| c[i][j]).try_inverse()).unwrap_or(coupling);
        self.springs.retain(|(e, _)| *e != entity);
        let spring = Spring { of, grab: *grab, model: state.model().clone(), config, stiffness };
        self.springs.push((entity, spring));
        stiffness
    }
}

pub(crate) fn publish(
    time: Res<Time>,
    simulated: Option<Res<Time<Virtual>>>,
    mut devices: ResMut<HapticDevices>,
    tools: Query<(&HapticTool, Option<&ToolGrabs>, Option<(&TouchProbe, &ProbeState)>)>,
    grabs: HeldGrabs,
    bodies: Bodies,
) {
    let period = time.delta_secs_f64();
    if period <= 0.0 {
        // While the game is paused, no updates are published and the loop fades the force.
        return;
    }
    let speed = simulated.map_or(1.0, |time| f64::from(time.relative_speed()));
    let interval = if speed > 0.0 { period / speed } else { 0.0 };
    for (tool, held, touch) in &tools {
        let Some(entry) = devices.entry(tool.device) else { continue };
        let entities = held.map_or(&[][..], ToolGrabs::entities);
        let held: Vec<_> = entities.iter().filter_map(|&e| grabs.get(e).ok()).take(MAX_CONTACTS).collect();
        let local = single_body(&held, &bodies);

        let (seen, coupling) = (entry.seen, entry.status.coupling);
        let now = entry.running.get().now();
        let (rate, writer) = (entry.running.get().rate(), &mut entry.writer);
        if let Some((state, ids)) = &local {
            let scale = state.scale();
            let wrong = entry.running.get().publish(|model: &mut LocalModel| {
                model.interval = interval;
                writer.write(state.body(), ids, &coupling, scale, seen, model).err()
            });
            if let Some(error) = wrong {
                warn!("{}: the hand was told of no contact: {error}", entry.status.info.name);
            }
        } else if let Some((probe, state)) = touch.filter(|(probe, _)| probe.enabled) {
            let ball = TouchBall {
                radius: probe.radius,
                stiffness: probe.stiffness,
                relaxation: probe.relaxation,
                lever: state.lever(),
            };
            // What pushes comes first, if there are more than the loop has room for.
            let mut touched: Vec<Touching> = state.contacts().collect();
            touched.sort_by(|a, b| b.force.length().total_cmp(&a.force.length()));
            let planes = touched.into_iter().map(|contact| TouchPlane {
                key: contact.other.to_bits(),
                spot: contact.spot.into(),
                point: contact.point.into(),
                normal: contact.normal.into(),
                velocity: contact.velocity.into(),
                compliance: contact.compliance,
                friction: contact.friction,
            });
            let stored = state.contacts().filter_map(|contact| {
                let (state, ..) = bodies.get(contact.other).ok()?;
                Some(state.body().energy() * state.scale() * state.scale())
            });
            let stored = stored.sum();
            entry.running.get().publish(|model: &mut LocalModel| {
                model.interval = interval;
                writer.write_touch(ball, planes, stored, period, seen, model);
            });
        } else if entry.elsewhere.is_alive(&held, &bodies, now) {
            entry.elsewhere.springs.retain(|(e, _)| entities.contains(e));
            let published: Vec<PublishedGrab> = held
                .iter()
                .filter_map(|(entity, of, grab, force, offset)| {
                    // The force is unknown: the session has not answered yet, or it is over.
                    if **force == GrabForce::default() {
                        return None;
                    }
                    let (state, _, _, place) = bodies.get(of.0).ok()?;
                    let turn: Matrix3<f64> = world_axes(place);
                    let spring = turn * entry.elsewhere.spring(*entity, of.0, grab, state) * turn.transpose();
                    Some(PublishedGrab {
                        key: key(*entity, of),
                        offset: offset.map_or(DVec3::ZERO, |o| o.0).into(),
                        point: force.point.into(),
                        force: force.force.into(),
                        stiffness: std::array::from_fn(|r| std::array::from_fn(|c| spring[(r, c)])),
                    })
                })
                .collect();
            let relaxation = coupling.grab_config(tool.motion_scale, tool.force_scale).relaxation;
            let stored = stored(&held, &bodies);
            let write = |model: &mut LocalModel| {
                model.interval = interval;
                writer.write_forces(&published, relaxation, stored, period, seen, model);
            };
            entry.running.get().publish(write);
        }

        // The copy of the body for the loop is created here, where allocation is allowed, whenever
        // the held grabs change.
        let local = local.filter(|_| tool.modal);
        let wanted = local.as_ref().map_or_else(CopyOf::default, |(s, ids)| CopyOf::new(s, ids, &coupling));
        if wanted != entry.modal_for {
            let modal = match &local {
                Some((state, ids)) => match ModalLocal::new(state.body(), ids, state.scale(), rate) {
                    Ok(modal) => Some(Box::new(modal)),
                    Err(error) => {
                        warn!("{}: the loop does not step the body itself: {error}", entry.status.info.name);
                        None
                    }
                },
                None => None,
            };
            if entry.running.get().set_modal(modal) {
                entry.modal_for = wanted;
            }
        }
    }
}

/// Returns the energy that the held bodies could give back, J. For a body that is stepped
/// elsewhere, this is the elastic energy of its visual state, because nothing else is known.
fn stored(held: &[HeldItem], bodies: &Bodies) -> f64 {
    let mut counted: Vec<Entity> = Vec::new();
    let mut sum = 0.0;
    for (_, of, ..) in held {
        let Ok((state, driven, shown, _)) = bodies.get(of.0) else { continue };
        if counted.contains(&of.0) {
            continue;
        }
        counted.push(of.0);
        let energy = if *driven == Driven::Remote {
            let modes = shown.current().iter().zip(state.body().omega());
            0.5 * modes.map(|(q, omega)| (q * omega).powi(2)).sum::<f64>()
        } else {
            state.body().energy()
        };
        sum += energy * state.scale() * state.scale();
    }
    sum
}

/// Returns the loop's key of a grab. The key differs for another entity, and also for the same
/// entity on another body.
fn key(grab: Entity, of: &GrabOf) -> u64 {
    grab.to_bits() ^ of.0.to_bits().rotate_left(23)
}

fn world_axes(place: &GlobalTransform) -> Matrix3<f64> {
    let m = bevy::math::DMat3::from_quat(place.rotation().as_dquat().normalize()).to_cols_array();
    Matrix3::from_column_slice(&m)
}

/// Returns the body and the solver's grabs, if all grabs are on one body and it is stepped here.
fn single_body<'a>(held: &[HeldItem], bodies: &'a Bodies) -> Option<(&'a BodyState, Vec<HeldGrab>)> {
    let (_, of, ..) = held.first()?;
    if held.iter().any(|(_, other, ..)| other.0 != of.0) {
        return None;
    }
    let (state, driven, ..) = bodies.get(of.0).ok()?;
    if *driven == Driven::Remote {
        return None;
    }
    let ids = held.iter().map(|(entity, of, .., offset)| {
        let id = state.grab_id(*entity)?;
        Some(HeldGrab { key: key(*entity, of), id, offset: offset.map_or(DVec3::ZERO, |o| o.0).into() })
    });
    Some((state, ids.collect::<Option<Vec<_>>>()?))
}

#[cfg(test)]
mod tests {
    use super::Arrivals;

    /// Returns how long states that have come at `hz` may be missing, s, in steps of 1 ms.
    fn patience(hz: f64) -> f64 {
        let (mut arrivals, mut now) = (Arrivals::default(), 0.0);
        for version in 1..=300 {
            now = f64::from(version as u32) / hz;
            arrivals.are_recent(version, now);
        }
        (1..2000).map(|ms| 1e-3 * f64::from(ms)).find(|t| !arrivals.are_recent(300, now + t)).unwrap()
    }

    #[test]
    fn a_body_is_lost_after_four_missing_states() {
        for (hz, expected) in [(120.0, 0.1), (40.0, 0.1), (20.0, 0.2), (10.0, 0.4), (4.0, 0.5)] {
            assert!((patience(hz) - expected).abs() < 2e-3, "{} s at {hz} Hz", patience(hz));
        }
    }
}
