//! Guests' hands on the host's bodies.

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabOf, Grabs, Impulse};
use pliant_modal::{Body, GrabConfig};
use pliant_stream::{BodyId, GrabKey, HandPlayout, PeerId, UserId};

use super::NetHost;
use crate::session_transform::SessionTransform;
use crate::user::HandOf;

/// Whose hands may be on a body at the same time. As a component on a host's body, it applies to
/// that body. Otherwise [`HostConfig::holding`](super::HostConfig::holding) applies. A change ends
/// no existing grab.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq, Hash)]
#[reflect(Component, Default, Clone, PartialEq)]
pub enum Holding {
    /// Any user's hands: the paper's cooperative mode. Default.
    #[default]
    Together,
    /// One user's hands at a time: the paper's collaborative mode. Another user's grab is refused
    /// until the first user releases the body.
    OneAtATime,
    /// No guest's hands: the guests watch.
    HostOnly,
}

/// A guest's grab on the host.
#[derive(Component, Debug, Clone)]
pub(crate) struct GuestGrab {
    pub(super) key: GrabKey,
    pub(super) hand: HandPlayout,
    peer: PeerId,
    /// Largest speed of the hand, m/s.
    most: f64,
}

/// Largest speed of a hand, in body sizes per second: the hand crosses the body in a twentieth of a
/// second.
const SPEED: f64 = 20.0;

impl NetHost {
    pub(super) fn entity_of(&self, body: BodyId) -> Option<Entity> {
        self.bodies.iter().find(|(_, hosted)| hosted.id == body).map(|(&entity, _)| entity)
    }

    /// Converts a guest's target to this app's world and limits it to the reach around the body.
    pub(super) fn target_in_world(&self, world: &World, body: BodyId, target: [f64; 3]) -> Option<DVec3> {
        let entity = self.entity_of(body)?;
        let state = world.get::<BodyState>(entity)?;
        let place = SessionTransform::of_body(world.get::<GlobalTransform>(entity)?, state)?;
        let model = state.model();
        let middle = if model.is_free() {
            DVec3::from(state.body().frame().center())
        } else {
            let [low, high] = model.surface().bounds();
            (Vec3::from(low).as_dvec3() + Vec3::from(high).as_dvec3()) / 2.0
        };
        let away = (DVec3::from(target) - middle).clamp_length_max(self.reach * model.size());
        away.is_finite().then(|| place.point_to_world((middle + away).into()))
    }

    pub(super) fn begin_grab(
        &mut self,
        world: &mut World,
        key: GrabKey,
        body: BodyId,
        vertex: u32,
        radius: f64,
        target: [f64; 3],
        hold: GrabConfig,
    ) -> Result<(), &'static str> {
        let entity = self.entity_of(body).ok_or("no such body")?;
        let user = self.users.get(key.user).ok_or("no such user")?;
        let of_user = self.guests.iter().find(|(_, guest)| guest.entity == Some(user));
        let peer = *of_user.ok_or("no such user")?.0;
        let target = self.target_in_world(world, body, target).ok_or("no place for its target")?;
        let model = world.get::<BodyState>(entity).ok_or("the body is not ready")?.model().clone();
        if !(0.0..=model.size()).contains(&radius) {
            return Err("its radius is larger than the body");
        }
        let held = world.get::<Grabs>(entity).map(|grabs| grabs.entities().to_vec()).unwrap_or_default();
        let others = |other: &Entity| world.get::<HandOf>(*other).is_none_or(|hand| hand.0 != user);
        // A grab without a place on the body would wait, and its guest would not know why it holds
        // nothing. One user gets at most half of the free places. Five users together can then fill
        // a body except for one place, which is left for a sixth.
        let free = Body::MAX_GRABS.saturating_sub(held.len());
        let own = held.iter().filter(|other| !others(other)).count();
        if free == 0 {
            return Err("as many hands as there can be hold the body");
        }
        if own >= free {
            return Err("the places that are left are for others");
        }
        self.may_hold(world, entity, user)?;
        let GrabConfig { stiffness, relaxation } = hold;
        let size = world.get::<GlobalTransform>(entity).map_or(1.0, |place| f64::from(place.scale().x))
            * model.size();
        let grab = Grab { stiffness, relaxation, ..Grab::new(vertex, radius, target) };
        let spawned = world
            .spawn((
                grab,
                GrabOf(entity),
                HandOf(user),
                GuestGrab { key, hand: HandPlayout::new(target.to_array().into()), peer, most: SPEED * size },
            ))
            .id();
        self.grabs.insert(key, spawned);
        Ok(())
    }

    /// Whether a guest's hand may be on a body, and its impulses may act on it.
    fn may_hold(&self, world: &World, body: Entity, user: Entity) -> Result<(), &'static str> {
        let held = world.get::<Grabs>(body).map_or(&[][..], |grabs| grabs.entities());
        let others = |other: &Entity| world.get::<HandOf>(*other).is_none_or(|hand| hand.0 != user);
        match world.get::<Holding>(body).copied().unwrap_or(self.holding) {
            Holding::OneAtATime if held.iter().any(others) => Err("somebody else holds the body"),
            Holding::HostOnly => Err("only the host may hold the body"),
            Holding::Together | Holding::OneAtATime => Ok(()),
        }
    }

    /// Passes a guest's impulse (N s, session coordinates) to the next tick.
    pub(super) fn take_impulse(
        &self,
        world: &mut World,
        user: UserId,
        body: BodyId,
        vertex: u32,
        impulse: [f64; 3],
    ) -> Result<(), &'static str> {
        let body = self.entity_of(body).ok_or("no such body")?;
        let user = self.users.get(user).ok_or("no such user")?;
        self.may_hold(world, body, user)?;
        let state = world.get::<BodyState>(body).ok_or("the body is not ready")?;
        let transform = world.get::<GlobalTransform>(body).ok_or("the body has no place")?;
        let place = SessionTransform::of_body(transform, state).ok_or("the body has no place")?;
        world.write_message(Impulse { body, vertex, impulse: place.force_to_world(impulse) });
        Ok(())
    }
}

/// Runs before the bodies' step. Moves guests' hands to their targets of this tick.
pub(crate) fn move_hands(
    host: Option<Res<NetHost>>,
    time: Res<Time>,
    mut grabs: Query<(&mut Grab, &mut GuestGrab)>,
) {
    let Some(host) = host else { return };
    let step = time.delta_secs_f64();
    for (mut grab, mut guest) in &mut grabs {
        let link = host.session.stats(guest.peer).unwrap_or_default();
        let depth = depth(link.round_trip.as_secs_f64(), link.jitter.as_secs_f64(), step, host.smoothing);
        let most = guest.most * step;
        let target = DVec3::from_array(guest.hand.next(depth, most).into());
        if target != grab.target {
            grab.target = target;
        }
    }
}

/// Returns the playout delay of a movement in ticks: one tick, twice the jitter, and one more tick
/// if the round trip is longer than a step, because a lost target then arrives with the next one.
/// At most `most` seconds.
fn depth(round_trip: f64, jitter: f64, step: f64, most: f64) -> usize {
    if step <= 0.0 {
        return 1;
    }
    let far = if round_trip > step { 1.0 } else { 0.0 };
    let ticks = 1.0 + far + (2.0 * jitter / step).floor();
    // A float-to-integer cast saturates and takes NaN to zero.
    (ticks.min((most / step).round()) as usize).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_movement_is_held_back_by_the_jitter_of_its_way() {
        assert_eq!(depth(0.0003, 0.0001, 0.025, 0.1), 1, "at home");
        assert_eq!(depth(0.196, 0.004, 0.025, 0.1), 2, "far and even");
        assert_eq!(depth(0.196, 0.030, 0.025, 0.1), 4, "far and uneven");
        assert_eq!(depth(0.196, 10.0, 0.025, 0.1), 4, "at most what is allowed");
        assert_eq!(depth(0.196, 0.030, 0.025, 0.0), 1);
        assert_eq!(depth(0.196, 0.030, 0.0, 0.1), 1, "no step, no ticks");
    }
}
