//! The local hands, and the displayed state and the forces.

use std::collections::BTreeMap;
use std::sync::Arc;

use bevy::math::{DQuat, DVec3};
use bevy::prelude::*;
use pliant_body::{BodyState, FixedObstacles, Grab, GrabForce, GrabOf, HeldShapesCache, Impulse};
use pliant_modal::{Body, FixedObstacle, FixedShape, ModalModel, ObstacleShape};
use pliant_stream::peer::PeerSession;
use pliant_stream::{BodyId, GrabKey, StepSettings, StreamError, Surroundings};

use super::{NetPeer, PeerState};
use crate::own_grab::{self, HandSession, OwnGrab, send_grabs};
use crate::session_transform::SessionTransform;
use crate::view::{BodyDisplay, DisplayedBodies, remote_hands};

/// A body of the peers and its displayed states.
pub(super) struct PlayedBody {
    pub(super) entity: Entity,
    pub(super) model: Arc<ModalModel>,
    pub(super) settings: StepSettings,
    pub(super) around: Surroundings,
    /// Whether it gets the own shapes of held patches.
    pub(super) held_shapes: bool,
    display: BodyDisplay,
}

impl PlayedBody {
    pub(super) fn new(entity: Entity, model: Arc<ModalModel>, settings: StepSettings) -> Self {
        let (around, display) = (Surroundings::default(), BodyDisplay::default());
        Self { entity, model, settings, around, held_shapes: true, display }
    }
}

/// Returns the settings with which all peers step this body. They are the body's own settings, with
/// gravity in the axes in which the peers step the body. For an anchored body these are its own
/// axes, wherever each peer places it.
pub(super) fn agreed_settings(body: &Body) -> StepSettings {
    /// Resolution of gravity, m/s^2. Peers compare the settings, and a rotation in single precision
    /// differs in its last digits between machines.
    const FINE: f64 = 1e-3;
    let settings = body.config().settings;
    let mut gravity = DVec3::from(settings.gravity);
    if !body.model().is_free() {
        gravity = DQuat::from_array(body.frame().orientation()).inverse() * gravity;
    }
    // Adding zero turns a negative zero into zero.
    let gravity = gravity.to_array().map(|x| (x / FINE).round() * FINE + 0.0);
    StepSettings { gravity, ..settings }
}

/// Returns the surroundings with which all peers step this body: what stands still around it, in an
/// order and with numbers that are the same on all machines.
///
/// More than [`Surroundings::MAX_OBSTACLES`] obstacles count as none, and so does each that no
/// machine would accept, which is decided by the agreed numbers.
pub(super) fn agreed_surroundings(fixed: &FixedObstacles) -> Surroundings {
    /// Resolution of lengths, m, and of quaternions: a power of two, so that rounding is exact.
    const FINE: f64 = 1.0 / 1_048_576.0;
    let round = |x: f64| (x / FINE).round() * FINE + 0.0;
    let agreed = |of: &FixedObstacle| {
        // Two quaternions are the same rotation. The last number other than zero is positive.
        let rotation = of.rotation.map(round);
        let last = rotation.iter().rev().find(|x| **x != 0.0);
        let sign = last.map_or(1.0, |x| x.signum());
        let shape = match of.shape {
            FixedShape::Plane => FixedShape::Plane,
            FixedShape::Ball { radius } => FixedShape::Ball { radius: round(radius) },
            FixedShape::Box { half, round: by } => {
                FixedShape::Box { half: half.map(round), round: round(by) }
            }
            FixedShape::Capsule { radius, half_length } => {
                FixedShape::Capsule { radius: round(radius), half_length: round(half_length) }
            }
        };
        let (position, rotation) = (of.position.map(round), rotation.map(|x| sign * x + 0.0));
        FixedObstacle { shape, position, rotation }
    };
    let obstacles = fixed.obstacles.iter().map(agreed);
    let mut obstacles: Vec<FixedObstacle> = obstacles.filter(|o| o.check().is_ok()).collect();
    if obstacles.len() > Surroundings::MAX_OBSTACLES {
        warn!("a body of peers touches nothing: it has {} obstacles", obstacles.len());
        obstacles.clear();
    }
    // By all numbers, since entities have another order on each machine.
    let key = |of: &FixedObstacle| {
        let (kind, lengths) = match of.shape {
            FixedShape::Plane => (0, [0.0; 4]),
            FixedShape::Ball { radius } => (1, [radius, 0.0, 0.0, 0.0]),
            FixedShape::Box { half: [x, y, z], round } => (2, [x, y, z, round]),
            FixedShape::Capsule { radius, half_length } => (3, [radius, half_length, 0.0, 0.0]),
        };
        (kind, lengths.map(f64::to_bits), of.position.map(f64::to_bits), of.rotation.map(f64::to_bits))
    };
    obstacles.sort_by_key(key);
    Surroundings { friction: fixed.friction, obstacles }
}

/// `PostUpdate`: passes the app's own grabs, and its impulses on the peers' bodies, to the session.
pub(crate) fn send_hands(
    net: Option<ResMut<NetPeer>>,
    bodies: Query<(&BodyState, &GlobalTransform)>,
    grabs: Query<(Entity, &Grab, &GrabOf)>,
    mut impulses: MessageReader<Impulse>,
) {
    let Some(mut net) = net else { return };
    let net = &mut *net;
    let body_of = |entity: Entity| {
        let (state, transform) = bodies.get(entity).ok()?;
        let (&id, _) = net.bodies.iter().find(|(_, played)| played.entity == entity)?;
        Some((id, state, transform))
    };
    own_grab::send_impulses(&mut impulses, &mut net.refused_impulses, body_of, |body, vertex, impulse| {
        let needed = "a session";
        let none = StreamError::State { what: "apply_impulse", state: "not in", needed };
        net.session.as_mut().ok_or(none)?.apply_impulse(body, vertex, impulse)
    });
    if !matches!(net.state, PeerState::In { .. }) {
        return;
    }
    let Some(session) = &mut net.session else { return };
    send_grabs(session, &mut net.grabs, &grabs, body_of);
}

impl HandSession for PeerSession {
    type Sent = OwnGrab;

    fn begin(&mut self, body: BodyId, grab: &Grab, model: &ModalModel, target: [f64; 3]) -> OwnGrab {
        OwnGrab::begin(body, grab, model, |hold| {
            self.begin_grab(body, grab.vertex, grab.radius, target, hold)
        })
    }

    fn lead(&mut self, sent: &mut OwnGrab, target: [f64; 3]) {
        if let Some(Err(error)) = sent.number.map(|number| self.set_target(number, target)) {
            debug!("a target was not taken: {error}");
        }
    }

    fn end(&mut self, number: u16) {
        self.end_grab(number);
    }
}

/// `PostUpdate`: brings the session to the current time and writes what it displays.
pub(crate) fn show(
    net: Option<ResMut<NetPeer>>,
    mut bodies: DisplayedBodies,
    mut forces: Query<&mut GrabForce>,
    cache: Option<ResMut<HeldShapesCache>>,
) {
    let Some(mut net) = net else { return };
    let net = &mut *net;
    let PeerState::In { user } = net.state else { return };
    let now = net.now();
    let Some(session) = &mut net.session else { return };
    session.update(now);
    if let Some(mut cache) = cache {
        make_shapes(session, &net.bodies, &mut cache);
    }
    let step = net.step.as_secs_f64();
    for (&id, played) in &mut net.bodies {
        let Some(view) = session.body(id) else { continue };
        let Ok((state, mut visual, mut hands, mut transform, global)) = bodies.get_mut(played.entity) else {
            continue;
        };
        played.display.take(view.tick(), &view.visual().q, view.pose(), view.held_shapes());
        played.display.write((step, now, false), state, &mut visual, &mut transform, &mut net.scratch);
        let Some(place) = SessionTransform::of_body(global, state) else { continue };
        hands.set_if_neq(remote_hands(view.grabs(), Some(user), &place));
        for (&entity, sent) in net.grabs.iter().filter(|(_, sent)| sent.body == id) {
            let Ok(mut force) = forces.get_mut(entity) else { continue };
            let reaction = sent.number.and_then(|grab| {
                let key = GrabKey { user, grab };
                Some(view.grabs().iter().find(|grab| grab.key == key)?.reaction)
            });
            let at = (&place, state, &*visual);
            sent.write_force(&mut force, reaction, f64::INFINITY, &played.display, at);
        }
    }
    net.flush();
}

/// Gives the session the own shapes of held patches that it asks for, as soon as they are made.
fn make_shapes(
    session: &mut PeerSession,
    bodies: &BTreeMap<BodyId, PlayedBody>,
    cache: &mut HeldShapesCache,
) {
    for (id, places) in session.shapes_to_make() {
        let Some(played) = bodies.get(&id) else { continue };
        if let Some(shapes) = cache.get(&played.model, &places) {
            session.take_shapes(id, &places, shapes);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_obstacle_beyond_all_bounds_does_not_cost_the_session() {
        let ball = |x: f64, radius: f64| FixedObstacle {
            shape: FixedShape::Ball { radius },
            position: [x, 0.0, 0.0],
            rotation: [0.0, 0.0, 0.0, 1.0],
        };
        // The last one lies within the bounds as soon as it is rounded.
        let obstacles = vec![ball(2e6, 1.0), ball(1.0, 0.5), ball(3.0, -0.5), ball(1e6 + 1e-9, 0.5)];
        let around = agreed_surroundings(&FixedObstacles { obstacles, ..FixedObstacles::default() });
        assert_eq!(around.obstacles, [ball(1.0, 0.5), ball(1e6, 0.5)]);
        assert!(around.check().is_ok(), "{:?}", around.check());
    }
}
