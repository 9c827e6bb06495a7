//! The fixed step: bodies are made, placed, held, stepped, and what came of it is published.

use std::{
    sync::{Arc, Weak},
    time::Instant,
};

use bevy::{
    diagnostic::Diagnostics,
    ecs::{name::NameOrEntityItem, system::SystemParam},
    math::{DQuat, DVec3},
    prelude::*,
};
use pliant_modal::{Body, BodyConfig, GrabConfig, ModalModel, Patch, StepError};

use crate::{
    AWAKE_BODIES, BodyError, BodyRefused, BodyState, Driven, Grab, GrabForce, GrabOf, Grabs, ModalAsset,
    ModalBody, Pose, STEP_TIME, VisualState, body::Held,
};

/// The tick: how many steps the schedule of the bodies has made. It counts on while bodies rest, and stands while time is paused.
#[derive(Resource, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub struct PliantTick(pub u64);

/// How the bodies' schedule runs.
#[derive(Resource, Debug, Clone, Copy)]
pub(crate) struct Stepping {
    /// By `Time<Fixed>`, so that frames fall between steps.
    pub fixed: bool,
}

/// The body of this entity was refused with this model; it is tried again when its [`ModalBody`] or the asset behind it changes.
#[derive(Component)]
pub(crate) struct BuildRefused(Weak<ModalModel>);

/// Seconds for which a body must be slow before it rests.
const REST_AFTER: f64 = 0.5;

#[derive(SystemParam)]
pub(crate) struct Refusals<'w> {
    messages: MessageWriter<'w, BodyRefused>,
}

impl Refusals<'_> {
    pub fn tell(&mut self, name: &impl std::fmt::Display, entity: Entity, error: BodyError) {
        warn!("{name}: {error}");
        self.messages.write(BodyRefused { entity, error });
    }
}

/// A body as it is asked for, and as it is.
type Buildable =
    (NameOrEntity, Ref<'static, ModalBody>, Option<&'static mut BodyState>, Option<&'static BuildRefused>);

pub(crate) fn build_bodies(
    mut commands: Commands,
    models: Res<Assets<ModalAsset>>,
    stepping: Res<Stepping>,
    fixed: Option<Res<Time<Fixed>>>,
    mut refusals: Refusals,
    mut bodies: Query<Buildable>,
) {
    let step = match fixed {
        Some(fixed) if stepping.fixed => fixed.timestep().as_secs_f64(),
        _ => 1.0 / 60.0,
    };
    for (name, body, state, refused) in &mut bodies {
        // A handle whose asset is not there yet leaves the old body, if there is one.
        let Some(ModalAsset(model)) = models.get(&body.model) else { continue };
        let modes = body.modes.unwrap_or(usize::MAX).min(model.mode_count());
        match state {
            Some(state) if Arc::ptr_eq(state.model(), model) && state.body.mode_count() == modes => {
                if body.is_changed() {
                    let mut state = state;
                    let config = body.config(state.body.config().step, state.scale);
                    if let Err(error) = state.body_mut().reconfigure(config) {
                        refusals.tell(&name, name.entity, BodyError::Build(error));
                    }
                }
            }
            state => {
                let same = refused.is_some_and(|BuildRefused(with)| with.as_ptr() == Arc::as_ptr(model));
                if same && !body.is_changed() {
                    continue;
                }
                match Body::new(model.clone(), body.config(step, 1.0)) {
                    Ok(new) => {
                        // Fewer or more modes of one model: the motion of those that stay goes on.
                        let new = match state {
                            Some(old) if Arc::ptr_eq(old.model(), model) => carry_over(&name, &old.body, new),
                            _ => new,
                        };
                        let shown = VisualState::new(new.q());
                        // Somebody may have despawned it in this very frame.
                        commands
                            .entity(name.entity)
                            .try_insert((BodyState::new(new), shown))
                            .try_remove::<BuildRefused>();
                    }
                    Err(error) => {
                        refusals.tell(&name, name.entity, BodyError::Build(error));
                        commands.entity(name.entity).try_insert(BuildRefused(Arc::downgrade(model)));
                    }
                }
            }
        }
    }
}

fn carry_over(name: &NameOrEntityItem, old: &Body, mut new: Body) -> Body {
    let mut state = new.state().clone();
    let from = old.state();
    for (to, from) in [
        (&mut state.q, &from.q),
        (&mut state.v, &from.v),
        (&mut state.a, &from.a),
        (&mut state.f, &from.f),
        (&mut state.z, &from.z),
    ] {
        for (to, from) in to.iter_mut().zip(from) {
            *to = *from;
        }
    }
    state.frame = from.frame;
    // A state that the old body had is finite; were it not, the new one stays at rest.
    if let Err(error) = new.set_state(&state) {
        warn!("{name}: the motion of the body was not carried over: {error}");
    }
    new
}

/// An entity whose [`ModalBody`] is taken away keeps nothing of the simulation.
pub(crate) fn drop_states(removed: On<Remove, ModalBody>, mut commands: Commands) {
    if let Ok(mut entity) = commands.get_entity(removed.entity) {
        entity.try_remove::<(BodyState, VisualState, BuildRefused)>();
    }
}

/// A grab that is taken off its body feels nothing any more.
pub(crate) fn let_go(removed: On<Remove, GrabOf>, mut forces: Query<&mut GrabForce>) {
    feel_nothing(removed.entity, &mut forces);
}

/// Nor do the grabs on a body that is not there any more.
pub(crate) fn lose_body(
    removed: On<Remove, BodyState>,
    grabs: Query<&Grabs>,
    mut forces: Query<&mut GrabForce>,
) {
    for &grab in grabs.get(removed.entity).map_or(&[][..], Grabs::entities) {
        feel_nothing(grab, &mut forces);
    }
}

fn feel_nothing(grab: Entity, forces: &mut Query<&mut GrabForce>) {
    if let Ok(mut force) = forces.get_mut(grab) {
        force.set_if_neq(GrabForce::default());
    }
}

pub(crate) fn count_tick(mut tick: ResMut<PliantTick>) {
    tick.0 += 1;
}

/// Takes the place of every body whose transform changed.
pub(crate) fn place_bodies(
    mut refusals: Refusals,
    mut bodies: Query<
        (NameOrEntity, &Transform, &GlobalTransform, &mut BodyState, &mut VisualState),
        With<ModalBody>,
    >,
) {
    for (name, local, global, mut state, mut shown) in &mut bodies {
        // A free body has no parent; what was written into its transform since the last frame is not in the global one yet.
        let transform = if state.model().is_free() { GlobalTransform::from(*local) } else { *global };
        let affine = transform.affine();
        if state.is_placed(&affine) {
            continue;
        }
        state.placed = Some(affine);
        let (scale, rotation, translation) = transform.to_scale_rotation_translation();
        let uniform = (scale - scale.x).abs().max_element() <= 1e-3 * scale.x;
        if !(affine.is_finite() && scale.x > 0.0 && scale.is_finite() && rotation.is_finite() && uniform) {
            refusals.tell(&name, name.entity, BodyError::Placement { translation, scale });
            continue;
        }
        let scale = f64::from(scale.x);
        if scale != state.scale {
            // From what the body runs with, not from its component, whose fields may have been refused.
            let mut running = state.body.config().clone();
            let shrink = state.scale / scale;
            running.settings.gravity = running.settings.gravity.map(|acceleration| acceleration * shrink);
            match state.body_mut().reconfigure(running) {
                Ok(()) => state.scale = scale,
                Err(error) => {
                    refusals.tell(&name, name.entity, BodyError::Build(error));
                    continue;
                }
            }
        }
        let origin = translation.as_dvec3() / scale;
        let rotation = rotation.as_dquat().normalize();
        match state.body_mut().set_pose(origin.into(), rotation.into()) {
            // It did not fly here: the picture has nothing to pass through.
            Ok(()) => shown.bypass_change_detection().forget_pose(),
            Err(error) => refusals.tell(&name, name.entity, BodyError::Step(error)),
        }
    }
}

/// Makes the solver's grabs those of the entities: new ones are held, gone ones are let go, targets are handed over.
/// One that found the body full waits, and is held once a place is free.
pub(crate) fn hold_bodies(
    mut refusals: Refusals,
    mut bodies: Query<(&mut BodyState, &Driven, Option<&Grabs>)>,
    grabs: Query<(NameOrEntity, &Grab)>,
    mut forces: Query<&mut GrabForce>,
) {
    for (mut state, driven, list) in &mut bodies {
        let wanted = match (driven, list) {
            (Driven::Local, Some(list)) => list.entities(),
            _ => &[],
        };
        if wanted.is_empty() && state.held.is_empty() {
            continue;
        }
        let BodyState { body, held, scale, quiet, resting, .. } = &mut *state;
        let before = body.grabs().count();
        held.retain(|held| {
            let grab = wanted.contains(&held.entity).then(|| grabs.get(held.entity).ok()).flatten();
            if grab.is_none() {
                feel_nothing(held.entity, &mut forces);
            }
            let stays = grab.is_some_and(|(_, grab)| grab.hold().is(&held.hold));
            if let (false, Some(id)) = (stays, held.id) {
                body.release(id);
            }
            stays
        });
        let let_go = body.grabs().count() < before;
        for &entity in wanted {
            let Ok((name, grab)) = grabs.get(entity) else { continue };
            let known = held.iter().position(|held| held.entity == entity);
            let index = known.unwrap_or_else(|| {
                held.push(Held { entity, id: None, hold: grab.hold(), waiting: false, refusing: false });
                held.len() - 1
            });
            let held = &mut held[index];
            let free = body.grabs().count() < Body::MAX_GRABS;
            if known.is_none() || (held.waiting && free) {
                let taken = take_hold(body, grab);
                held.waiting = matches!(taken, Err(BodyError::Grab(StepError::TooManyGrabs { .. })));
                held.id = taken.map_err(|error| refusals.tell(&name, entity, error)).ok();
            }
            let Some(id) = held.id else { continue };
            // Not finite is the only way in which a target can be wrong.
            let refused = body.set_target(id, (grab.target / *scale).into()).is_err();
            if refused && !held.refusing {
                refusals.tell(&name, entity, BodyError::TargetNotFinite { target: grab.target.into() });
            }
            held.refusing = refused;
        }
        // A hand keeps the body awake, and so does letting go for as long as it moves; a hand that was refused touches nothing.
        if let_go || held.iter().any(|held| held.id.is_some()) {
            (*quiet, *resting) = (0.0, false);
        }
    }
}

fn take_hold(body: &mut Body, grab: &Grab) -> Result<pliant_modal::GrabId, BodyError> {
    let patch = Patch::around(body.model().surface(), grab.vertex, grab.radius).map_err(BodyError::Patch)?;
    let config = GrabConfig { stiffness: grab.stiffness, relaxation: grab.relaxation };
    body.grab(&patch, config).map_err(BodyError::Grab)
}

pub(crate) fn step_bodies(
    time: Res<Time>,
    mut diagnostics: Diagnostics,
    mut refusals: Refusals,
    mut bodies: Query<(NameOrEntity, &ModalBody, &Driven, &mut BodyState)>,
) {
    let start = Instant::now();
    let step = time.delta_secs_f64();
    let mut stepped = 0_usize;
    for (name, body, driven, mut state) in &mut bodies {
        let steps = *driven == Driven::Local && !state.resting;
        if state.stepped != steps {
            state.stepped = steps;
        }
        if !steps {
            continue;
        }
        stepped += 1;
        let state = &mut *state;
        // From what the body runs with: the component's fields may have been refused.
        let lengthened = match state.body.config() {
            running if running.step == step => Ok(()),
            running => state.body.reconfigure(BodyConfig { step, ..running.clone() }),
        };
        match lengthened.and_then(|()| state.body.step()) {
            Ok(_) => state.faulted = false,
            Err(error) => {
                if !state.faulted {
                    refusals.tell(&name, name.entity, BodyError::Step(error));
                }
                state.faulted = true;
            }
        }
        let slow = is_slow(&state.body, body.rest_speed);
        let left_alone = state.held.iter().all(|held| held.id.is_none());
        state.quiet = if slow && left_alone { state.quiet + step } else { 0.0 };
        state.resting = state.quiet >= REST_AFTER;
    }
    diagnostics.add_measurement(&AWAKE_BODIES, || stepped as f64);
    if stepped > 0 {
        diagnostics.add_measurement(&STEP_TIME, || start.elapsed().as_secs_f64() * 1e3);
    }
}

/// Whether the root mean square speed of the mass is below `limit` (m/s). Modes are mass-normalised: twice their kinetic energy is `sum v^2`.
fn is_slow(body: &Body, limit: f64) -> bool {
    let mass = body.model().mass();
    let modes: f64 = body.v().iter().map(|v| v * v).sum();
    // A limit that is NaN lets nothing rest.
    let below = modes < limit * limit * mass;
    if !below || is_relaxing(body, limit) {
        return false;
    }
    if !body.model().is_free() {
        return true;
    }
    let frame = body.frame();
    let velocity = DVec3::from(frame.velocity());
    let spin = DVec3::from(frame.spin());
    velocity.length() < limit && spin.length() < limit * mass * body.model().size()
}

/// Whether a viscoelastic body has still farther to go than it would at this speed (m/s) in the time
/// after which it rests. However slowly it goes there, it is not where it will be.
///
/// Unmoved, `omega^2 (q - ratio z) = f` and in the end `q = z`: what is left is `ratio / (1 - ratio) (z - q)`.
fn is_relaxing(body: &Body, limit: f64) -> bool {
    let Some(relaxation) = body.config().settings.relaxation else { return false };
    let share = relaxation.ratio / (1.0 - relaxation.ratio);
    let left: f64 = body.q().iter().zip(body.z()).map(|(q, z)| (share * (z - q)).powi(2)).sum();
    left > (limit * REST_AFTER).powi(2) * body.model().mass()
}

pub(crate) fn publish(
    mut bodies: Query<(NameOrEntity, &BodyState, &mut VisualState)>,
    mut forces: Query<&mut GrabForce>,
) {
    for (name, state, mut shown) in &mut bodies {
        if !state.stepped {
            continue;
        }
        let body = state.body();
        let pushed = if body.model().is_free() {
            let frame = body.frame();
            let pose = Pose {
                origin: DVec3::from(frame.origin()) * state.scale,
                orientation: DQuat::from_array(frame.orientation()),
            };
            shown.push_at(body.q(), pose)
        } else {
            shown.push(body.q())
        };
        if let Err(error) = pushed {
            warn!("{name}: a step was not shown: {error}");
        }
        for held in &state.held {
            let Ok(mut force) = forces.get_mut(held.entity) else { continue };
            let felt = held.id.and_then(|id| {
                let reaction = body.reaction(id).ok()?;
                let point = body.grab_position(id).ok()?;
                Some(GrabForce {
                    force: DVec3::from(reaction) * state.scale,
                    point: DVec3::from(point) * state.scale,
                })
            });
            force.set_if_neq(felt.unwrap_or_default());
        }
    }
}
