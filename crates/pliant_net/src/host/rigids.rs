//! Tells the guests where the host's rigid bodies are.

use std::collections::BTreeMap;

use bevy::math::{DQuat, DVec3};
use bevy::prelude::*;
use pliant_body::PliantTick;
use pliant_stream::{RigidId, RigidState};

use super::NetHost;
use crate::shared_body::{RemoteRigid, SharedRigid};

/// A way faster than this in a tick is a jump, m/s and rad/s.
const JUMP: f64 = 100.0;
/// A change of velocity beyond this is a blow, m/s^2 and rad/s^2.
const BLOW: f64 = 200.0;

/// The rigid bodies of the host's app.
#[derive(Default)]
pub(super) struct HostedRigids {
    all: BTreeMap<Entity, HostedRigid>,
    next: u16,
    scratch: Vec<(RigidId, RigidState)>,
}

struct HostedRigid {
    id: RigidId,
    name: String,
    /// The pose at the last tick, and the mean velocities in it.
    last: RigidState,
}

/// Runs after the last system that moves rigid bodies in a tick. Announces new ones, removes those
/// that are gone, and sends where they are.
pub(crate) fn publish_rigids(
    host: Option<ResMut<NetHost>>,
    tick: Res<PliantTick>,
    rigids: Query<(Entity, &SharedRigid), Without<RemoteRigid>>,
    places: TransformHelper,
) {
    let Some(mut host) = host else { return };
    let host = &mut *host;
    if rigids.is_empty() && host.rigids.all.is_empty() {
        return;
    }
    let now = host.now();
    let step = host.session.config().newmark.h;
    let (hosted, session) = (&mut host.rigids, &mut host.session);
    hosted.all.retain(|&entity, one| {
        let stays = rigids.get(entity).is_ok_and(|(_, shared)| shared.name == one.name);
        if !stays {
            session.remove_rigid(one.id);
        }
        stays
    });
    hosted.scratch.clear();
    for (entity, shared) in &rigids {
        let Ok(place) = places.compute_global_transform(entity) else { continue };
        let Some(pose) = pose_of(&place) else { continue };
        if let Some(one) = hosted.all.get_mut(&entity) {
            let (last, state) = moved(&one.last, pose, step);
            one.last = last;
            hosted.scratch.push((one.id, state));
            continue;
        }
        // Numbers wrap around. A number in use is refused, and the next tick tries the next one.
        let id = RigidId(hosted.next);
        hosted.next = hosted.next.wrapping_add(1);
        match session.add_rigid(id, &shared.name, pose) {
            Ok(()) => {
                hosted.all.insert(entity, HostedRigid { id, name: shared.name.clone(), last: pose });
                hosted.scratch.push((id, pose));
            }
            Err(error) => warn_once!("a rigid body is not shared: {error}"),
        }
    }
    // A tick is published once, also where this system runs twice in it.
    if let Err(error) = session.publish_rigids(now, tick.0, &hosted.scratch) {
        debug!("rigid bodies were not sent: {error}");
    }
    host.flush();
}

/// The pose of an entity, at rest. `None` where its transform is none.
fn pose_of(place: &GlobalTransform) -> Option<RigidState> {
    let (_, rotation, position) = place.to_scale_rotation_translation();
    let state = RigidState {
        position: position.as_dvec3().into(),
        rotation: rotation.as_dquat().normalize().into(),
        ..RigidState::default()
    };
    state.is_valid().then_some(state)
}

/// A pose with the mean velocities of the way from the last one, in a time (s), and with those at
/// the end of the way.
fn moved(from: &RigidState, to: RigidState, time: f64) -> (RigidState, RigidState) {
    let way = DVec3::from(to.position) - DVec3::from(from.position);
    let turn = DQuat::from_array(to.rotation) * DQuat::from_array(from.rotation).inverse();
    // The shorter of the two ways round.
    let turn = if turn.w < 0.0 { -turn } else { turn };
    let [linear, at_end] = velocities(way / time, from.linear.into(), time);
    let [angular, spin] = velocities(turn.to_scaled_axis() / time, from.angular.into(), time);
    let mean = RigidState { linear: linear.into(), angular: angular.into(), ..to };
    (mean, RigidState { linear: at_end.into(), angular: spin.into(), ..to })
}

/// The mean velocity of a tick, and that at its end, for the mean `before`. A steady acceleration
/// goes on for half a tick. After a blow, or where something was put elsewhere, the smaller of both
/// means is the one that misleads less.
fn velocities(mean: DVec3, before: DVec3, time: f64) -> [DVec3; 2] {
    if mean.is_nan() || mean.length() > JUMP {
        return [DVec3::ZERO; 2];
    }
    let change = mean - before;
    let end = if change.length() < BLOW * time {
        mean + 0.5 * change
    } else if mean.length_squared() < before.length_squared() {
        mean
    } else {
        before
    };
    [mean, end]
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: f64 = 1.0 / 64.0;

    fn at(x: f64, turn: f64) -> RigidState {
        let rotation = DQuat::from_rotation_y(turn).into();
        RigidState { position: [x, 0.0, 0.0], rotation, ..RigidState::default() }
    }

    /// Runs over places and returns the velocity at the end of each tick.
    fn run(places: impl Iterator<Item = (f64, f64)>) -> Vec<(f64, f64)> {
        let mut last = None;
        let mut all = Vec::new();
        for (x, turn) in places {
            let pose = at(x, turn);
            let (mean, end) = last.map_or((pose, pose), |last| moved(&last, pose, STEP));
            last = Some(mean);
            all.push((end.linear[0], end.angular[1]));
        }
        all
    }

    #[test]
    fn what_falls_and_spins_has_its_velocity_at_the_end_of_the_tick() {
        let t = |tick: usize| tick as f64 * STEP;
        let seen = run((0..64).map(|k| (0.5 * -9.81 * t(k).powi(2), 3.0 * t(k))));
        for (k, (speed, spin)) in seen.into_iter().enumerate().skip(2) {
            assert!((speed + 9.81 * t(k)).abs() < 1e-9, "{speed} m/s at tick {k}");
            assert!((spin - 3.0).abs() < 1e-9, "{spin} rad/s at tick {k}");
        }
    }

    #[test]
    fn what_is_put_elsewhere_has_no_velocity_and_keeps_the_other_one() {
        // By a meter within a tick, which is 64 m/s and no jump by itself, and by fifty.
        for way in [1.0, 50.0] {
            let seen = run((0..20).map(|k| (if k < 10 { 0.0 } else { way }, 0.0)));
            assert!(seen.iter().all(|(speed, _)| speed.abs() < 1e-9), "{seen:?}");
        }
        // A wheel that turns faster than can be told goes on with its car.
        let seen = run((0..20).map(|k| (30.0 * STEP * k as f64, 2.0 * k as f64)));
        assert!(
            seen[5..].iter().all(|(speed, spin)| (speed - 30.0).abs() < 1e-9 && *spin == 0.0),
            "{seen:?}"
        );
        // Up to 4 m/s and down again, from one tick to the next.
        let seen = run((0..20).map(|k| (4.0 * STEP * (10.0 - k as f64).abs(), 0.0)));
        assert!(seen.iter().all(|(speed, _)| speed.abs() < 4.0 + 1e-9), "{seen:?}");
    }
}
