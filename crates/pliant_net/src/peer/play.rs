//! The local hands, and the displayed state and the forces.

use std::sync::Arc;

use bevy::math::{DQuat, DVec3};
use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabForce, GrabOf, VisualState};
use pliant_modal::{Body, GrabConfig, ModalModel};
use pliant_stream::{BodyId, GrabKey, Pose, StepSettings, UserId};

use super::{NetPeer, PeerState};
use crate::patch_kinematics::{PatchPoint, hold_of, holds_so};
use crate::phase::Phase;
use crate::remote::{RemoteHand, RemoteHands};
use crate::session_transform::{SessionTransform, set_pose};

/// A body of the peers and its displayed states.
pub(super) struct PlayedBody {
    pub(super) entity: Entity,
    pub(super) model: Arc<ModalModel>,
    pub(super) settings: StepSettings,
    phase: Phase,
    tick: u64,
    previous: (Vec<f64>, Option<Pose>),
    current: (Vec<f64>, Option<Pose>),
}

impl PlayedBody {
    /// Digest of the body's model and step settings, which all peers must have in common.
    pub(super) fn digest(&self) -> [u8; 32] {
        pliant_stream::peer::digest(&self.model, &self.settings)
    }

    pub(super) fn new(entity: Entity, model: Arc<ModalModel>, settings: StepSettings) -> Self {
        Self {
            entity,
            model,
            settings,
            phase: Phase::default(),
            tick: 0,
            previous: (Vec::new(), None),
            current: (Vec::new(), None),
        }
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

/// A local grab as the session knows it.
pub(super) struct PeerGrab {
    body: BodyId,
    vertex: u32,
    radius: f64,
    hold: GrabConfig,
    /// The session's number of the grab. `None`: the session did not take it.
    number: Option<u16>,
    point: Option<PatchPoint>,
}

/// `PostUpdate`: passes the app's own grabs to the session.
pub(crate) fn tell_hands(
    net: Option<ResMut<NetPeer>>,
    bodies: Query<(&BodyState, &GlobalTransform)>,
    grabs: Query<(Entity, &Grab, &GrabOf)>,
) {
    let Some(mut net) = net else { return };
    let net = &mut *net;
    if !matches!(net.state, PeerState::In { .. }) {
        return;
    }
    let Some(session) = &mut net.session else { return };
    let number_of =
        |entity: Entity| net.bodies.iter().find(|(_, played)| played.entity == entity).map(|(&id, _)| id);
    net.grabs.retain(|&entity, said| {
        let stays = grabs.get(entity).is_ok_and(|(_, grab, of)| {
            let same = grab.vertex == said.vertex && grab.radius == said.radius && holds_so(grab, &said.hold);
            same && number_of(of.0) == Some(said.body)
        });
        if let (false, Some(number)) = (stays, said.number) {
            session.end_grab(number);
        }
        stays
    });
    for (entity, grab, of) in &grabs {
        let (Some(id), Ok((state, transform))) = (number_of(of.0), bodies.get(of.0)) else { continue };
        let Some(place) = SessionTransform::of_body(transform, state) else { continue };
        let target = place.point_to_session(grab.target);
        let moved = match net.grabs.get(&entity) {
            Some(said) => said.number.map(|number| session.set_target(number, target)).transpose(),
            None => {
                let hold = hold_of(grab);
                let begun = session.begin_grab(id, grab.vertex, grab.radius, target, hold);
                let point = PatchPoint::new(state.model(), grab.vertex, grab.radius).ok();
                let (vertex, radius) = (grab.vertex, grab.radius);
                let number = begun.as_ref().ok().copied();
                net.grabs.insert(entity, PeerGrab { body: id, vertex, radius, hold, number, point });
                begun.map(|_| None)
            }
        };
        if let Err(error) = moved {
            debug!("a grab was not taken: {error}");
        }
    }
}

/// `PostUpdate`: brings the session to the current time and writes what it displays.
pub(crate) fn show(
    net: Option<ResMut<NetPeer>>,
    mut bodies: Query<(&BodyState, &mut VisualState, &mut RemoteHands, &mut Transform, &GlobalTransform)>,
    mut forces: Query<&mut GrabForce>,
) {
    let Some(mut net) = net else { return };
    let net = &mut *net;
    let PeerState::In { user } = net.state else { return };
    let now = net.now();
    let Some(session) = &mut net.session else { return };
    session.update(now);
    let step = std::time::Duration::from_nanos(net.scene.step_ns).as_secs_f64();
    for (&id, played) in &mut net.bodies {
        let Some(view) = session.body(id) else { continue };
        let Ok((state, mut shown, mut seen, mut place, transform)) = bodies.get_mut(played.entity) else {
            continue;
        };
        let first = played.current.0.len() != view.visual().modes();
        if view.tick() != played.tick || first {
            played.tick = view.tick();
            std::mem::swap(&mut played.previous, &mut played.current);
            played.current.0.clone_from(&view.visual().q);
            played.current.1 = view.pose();
            if first {
                played.previous.clone_from(&played.current);
            }
        }
        let fraction = played.phase.fraction(played.tick, step, now);
        net.scratch.clear();
        let ends = played.previous.0.iter().zip(&played.current.0);
        net.scratch.extend(ends.map(|(from, to)| from + (to - from) * fraction));
        net.scratch.resize(shown.q().len(), 0.0);
        if let (Some(from), Some(to)) = (played.previous.1, played.current.1) {
            set_pose(&mut place, &from, &to, fraction, state.scale());
        }
        if net.scratch != shown.q()
            && let Err(error) = shown.snap(&net.scratch)
        {
            debug!("a state was not shown: {error}");
        }
        let Some(place) = SessionTransform::of_body(transform, state) else { continue };
        let hand = |grab: &pliant_stream::GrabState| RemoteHand {
            user: grab.key.user,
            vertex: grab.vertex,
            target: place.point_to_world(grab.target),
            reaction: place.force_to_world(grab.reaction),
        };
        let others = view.grabs().iter().filter(|grab| grab.key.user != user).map(hand);
        seen.set_if_neq(RemoteHands(others.collect()));
        for (&entity, said) in net.grabs.iter().filter(|(_, said)| said.body == id) {
            let Ok(mut force) = forces.get_mut(entity) else { continue };
            let felt = said.number.and_then(|grab| felt(view.grabs(), user, grab)).and_then(|reaction| {
                let point = said.point.as_ref()?.at(shown.q(), state.warps());
                Some(GrabForce {
                    force: place.force_to_world(reaction),
                    point: place.body_point_to_world(played.current.1, point),
                })
            });
            force.set_if_neq(felt.unwrap_or_default());
        }
    }
    net.flush();
}

fn felt(grabs: &[pliant_stream::GrabState], user: UserId, grab: u16) -> Option<[f64; 3]> {
    let key = GrabKey { user, grab };
    Some(grabs.iter().find(|grab| grab.key == key)?.reaction)
}
