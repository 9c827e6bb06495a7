//! Messages for external impulses and forces, which the next tick applies.

use bevy::{math::DVec3, prelude::*};
use pliant_modal::{Body, StepError};

use crate::{BodyError, BodyState, Driven, step::Refusals};

/// An impulse at one vertex of a body, which changes the body's velocity at once.
///
/// Write the message with a `MessageWriter<Impulse>` or `Commands::write_message`. The next tick
/// applies it in [`PliantSystems::Input`](crate::PliantSystems::Input) and wakes a resting body.
/// Impulses of one tick add up.
///
/// An impulse on a body that is [`Driven::Remote`] is left to who drives it. A session takes it: a
/// guest's acts at the host's next tick, where its user may hold the body, and a peer's at all
/// peers alike. It changes the speed of the whole body by at most 100 m/s, and is limited in
/// number. A host's own impulses have no limit.
///
/// On an entity of scale `s` the body's world is `s` times as large in lengths and forces, and its
/// mass stays the same. An impulse of `J` N s changes `mass x velocity`, both measured in the
/// entity's world, by `J`.
///
/// [`BodyRefused`](crate::BodyRefused), with the entity in `body`, reports an impulse with NaN or
/// infinity, a vertex or an entity that does not exist, an impulse that makes the velocity
/// overflow, and one that a session does not take.
///
/// ```
/// # use bevy::{math::DVec3, prelude::*};
/// # use pliant_body::{Impulse, ModalBody};
/// fn poke(bodies: Query<Entity, With<ModalBody>>, mut impulses: MessageWriter<Impulse>) {
///     impulses.write_batch(bodies.iter().map(|body| Impulse { body, vertex: 0, impulse: DVec3::new(0.0, 0.2, 0.0) }));
/// }
/// ```
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct Impulse {
    /// The entity of the [`ModalBody`](crate::ModalBody).
    pub body: Entity,
    /// Vertex of the model's surface at which the impulse acts.
    pub vertex: u32,
    /// Impulse, N s, world axes.
    pub impulse: DVec3,
}

/// A force at one vertex of a body for one tick.
///
/// A force that is written in every tick acts continuously. Forces are applied, scaled and refused
/// like an [`Impulse`], and forces of one tick add up. No session takes them: on a body that is
/// [`Driven::Remote`] they are refused. Over a tick of `h` s a force adds an impulse
/// of `force x h` N s.
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct Push {
    /// The entity of the [`ModalBody`](crate::ModalBody).
    pub body: Entity,
    /// Vertex of the model's surface at which the force acts.
    pub vertex: u32,
    /// Force, N, world axes.
    pub force: DVec3,
}

/// Passes the tick's impulses and forces to the solver, in the order in which they were written.
pub(crate) fn hit_bodies(
    mut impulses: MessageReader<Impulse>,
    mut pushes: MessageReader<Push>,
    mut refusals: Refusals,
    mut bodies: Query<(NameOrEntity, &Driven, &mut BodyState)>,
) {
    let mut hit = |entity, is_push: bool, apply: &dyn Fn(&mut Body, f64) -> Result<(), StepError>| {
        let Ok((name, driven, mut state)) = bodies.get_mut(entity) else {
            return refusals.report(&entity, entity, BodyError::NoBody);
        };
        match *driven {
            Driven::Local => {}
            Driven::Remote if is_push => return refusals.report(&name, entity, BodyError::NotLocal),
            Driven::Remote => return,
        }
        let scale = state.scale;
        // A refused impulse or force does not wake the body.
        match apply(&mut state.body, scale) {
            Ok(()) => state.wake(),
            Err(error) => refusals.report(&name, entity, BodyError::Impulse(error)),
        }
    };
    for &Impulse { body, vertex, impulse } in impulses.read() {
        hit(body, false, &|body, scale| body.apply_impulse(vertex, (impulse / scale).into()));
    }
    for &Push { body, vertex, force } in pushes.read() {
        hit(body, true, &|body, scale| body.push(vertex, (force / scale).into()));
    }
}
