//! Blows and forces from outside: messages that the coming tick takes.

use bevy::{math::DVec3, prelude::*};
use pliant_modal::{Body, StepError};

use crate::{BodyError, BodyState, Driven, step::Refusals};

/// A blow: an impulse at one vertex of a body, whose velocity changes at once.
///
/// Sent with a `MessageWriter<Impulse>` or `Commands::write_message` and taken by the next tick in
/// [`PliantSystems::Input`](crate::PliantSystems::Input); a body at rest wakes. Blows of one tick add up. They act on a body that this app steps, and
/// do not cross a session by themselves: a guest's go to nobody.
///
/// On an entity of scale `s` the body's world is `s` times as large in lengths and forces, and its mass stays: an impulse of `J` N s changes
/// `mass x velocity`, both as seen in the entity's world, by `J`.
///
/// Refused by [`BodyRefused`](crate::BodyRefused), with the entity in `body`: one with NaN or infinity, a vertex or an entity that is not there, a
/// body that is [`Driven::Remote`], an impulse beyond what numbers hold.
///
/// ```
/// # use bevy::{math::DVec3, prelude::*};
/// # use pliant_body::{ModalBody, Strike};
/// fn poke(bodies: Query<Entity, With<ModalBody>>, mut blows: MessageWriter<Strike>) {
///     blows.write_batch(bodies.iter().map(|body| Strike { body, vertex: 0, impulse: DVec3::new(0.0, 0.2, 0.0) }));
/// }
/// ```
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct Impulse {
    /// The entity of the [`ModalBody`](crate::ModalBody).
    pub body: Entity,
    /// Vertex of the model's surface that is hit.
    pub vertex: u32,
    /// Impulse, N s, world axes.
    pub impulse: DVec3,
}

/// A force at one vertex of a body for one tick; sent anew each tick, it is a force that lasts.
///
/// Taken, scaled and refused as a [`Impulse`]; forces of one tick add up. Over a tick of `h` s it brings in `force x h` N s.
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct Push {
    /// The entity of the [`ModalBody`](crate::ModalBody).
    pub body: Entity,
    /// Vertex of the model's surface that is pushed.
    pub vertex: u32,
    /// Force, N, world axes.
    pub force: DVec3,
}

/// Hands the tick's blows and forces to the solver, in the order in which they were sent.
pub(crate) fn hit_bodies(
    mut strikes: MessageReader<Impulse>,
    mut pushes: MessageReader<Push>,
    mut refusals: Refusals,
    mut bodies: Query<(NameOrEntity, &Driven, &mut BodyState)>,
) {
    let mut hit = |entity: Entity, apply: &dyn Fn(&mut Body, f64) -> Result<(), StepError>| {
        let Ok((name, driven, mut state)) = bodies.get_mut(entity) else {
            return refusals.tell(&entity, entity, BodyError::NoBody);
        };
        if *driven != Driven::Local {
            return refusals.tell(&name, entity, BodyError::NotLocal);
        }
        let scale = state.scale;
        // What is refused wakes nobody.
        match apply(&mut state.body, scale) {
            Ok(()) => state.wake(),
            Err(error) => refusals.tell(&name, entity, BodyError::Blow(error)),
        }
    };
    for &Impulse { body, vertex, impulse } in strikes.read() {
        hit(body, &|body, scale| body.apply_impulse(vertex, (impulse / scale).into()));
    }
    for &Push { body, vertex, force } in pushes.read() {
        hit(body, &|body, scale| body.push(vertex, (force / scale).into()));
    }
}
