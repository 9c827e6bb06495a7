//! The fixed step: builds, places, grabs and steps the bodies, and publishes the results.

use std::sync::{Arc, Weak};

use bevy::{
    diagnostic::Diagnostics,
    ecs::{
        name::NameOrEntityItem,
        system::{NonSendMarker, SystemParam},
    },
    math::{DQuat, DVec3},
    platform::time::Instant,
    prelude::*,
    tasks::ComputeTaskPool,
};
use pliant_modal::{
    Body, BodyConfig, GrabConfig, Islands, ModalModel, Patch, Probe, StepError, Together, Touched,
};

use crate::{
    AWAKE_BODIES, BodyError, BodyReady, BodyRefused, BodyState, Driven, Grab, GrabForce, GrabOf, Grabbed,
    Grabs, HeldShapesCache, ModalAsset, ModalBody, Pose, ProbeShape, ProbeState, Released, STEP_TIME,
    SavedState, TouchProbe, VisualState, body::HeldBody, gravity::Pull, step_times::BodyStepTimes,
};

/// The tick: the number of steps that the schedule of the bodies has made.
///
/// The number increases while bodies rest, and stays constant while time is paused.
#[derive(Resource, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub struct PliantTick(pub u64);

/// The rigid bodies of another engine that give way to bodies in the next step, and afterwards what
/// the contacts of the step did to them. Only a scene with such an engine has this resource.
#[derive(Resource, Debug, Default)]
pub struct RigidBodies(pub Vec<pliant_modal::Rigid>);

/// Describes how the bodies' schedule runs.
#[derive(Resource, Debug, Clone, Copy)]
pub(crate) struct Stepping {
    /// Whether the schedule runs by `Time<Fixed>`, so that frames fall between steps.
    pub fixed: bool,
}

/// Marks an entity whose body was refused with this model. The build is tried again when the
/// entity's [`ModalBody`] or the asset behind it changes.
#[derive(Component)]
pub(crate) struct BuildRefused(Weak<ModalModel>);

/// Time for which a body must be slow before it rests, s.
const REST_AFTER: f64 = 0.5;

#[derive(SystemParam)]
pub(crate) struct Refusals<'w, 's> {
    commands: Commands<'w, 's>,
}

impl Refusals<'_, '_> {
    pub fn report(&mut self, name: &impl std::fmt::Display, entity: Entity, error: BodyError) {
        warn!("{name}: {error}");
        self.commands.trigger(BodyRefused { entity, error });
    }
}

/// The requested body and the existing body of an entity.
type Buildable = (
    NameOrEntity,
    Ref<'static, ModalBody>,
    Option<&'static mut BodyState>,
    Option<&'static BuildRefused>,
    Option<&'static SavedState>,
    Option<&'static VisualState>,
);

pub(crate) fn build_bodies(
    mut commands: Commands,
    models: Res<Assets<ModalAsset>>,
    stepping: Res<Stepping>,
    fixed: Option<Res<Time<Fixed>>>,
    mut shapes: ResMut<HeldShapesCache>,
    mut refusals: Refusals,
    mut bodies: Query<Buildable>,
) {
    let step = match fixed {
        Some(fixed) if stepping.fixed => fixed.timestep().as_secs_f64(),
        _ => 1.0 / 60.0,
    };
    for (name, body, state, refused, saved, visual) in &mut bodies {
        // While the asset of a new handle is not loaded, the old body stays, if there is one.
        let Some(ModalAsset(model)) = models.get(&body.model) else { continue };
        let modes = body.modes.unwrap_or(usize::MAX).min(model.mode_count());
        if let Some(saved) = saved {
            // The own shapes of held patches are waited for.
            let Some(restored) = saved.restore(&body, model, &mut shapes) else { continue };
            let mut entity = commands.entity(name.entity);
            entity.try_remove::<SavedState>();
            match restored {
                Ok(state) => {
                    if !visual.is_some_and(|visual| visual.fits(modes)) {
                        entity.try_insert(VisualState::new(state.body.q()));
                    }
                    entity.try_insert(state).try_remove::<BuildRefused>();
                    commands.trigger(BodyReady { entity: name.entity });
                    continue;
                }
                Err(error) => refusals.report(&name, name.entity, BodyError::Saved(error)),
            }
        }
        match state {
            Some(state) if Arc::ptr_eq(state.model(), model) && state.body.mode_count() == modes => {
                if body.is_changed() {
                    let mut state = state;
                    let config = body.config(state.body.config().step, state.scale, state.pull);
                    match state.body_mut().reconfigure(config) {
                        Ok(()) => state.pull = body.pulled(state.pull),
                        Err(error) => refusals.report(&name, name.entity, BodyError::Build(error)),
                    }
                }
            }
            state => {
                let same = refused.is_some_and(|BuildRefused(with)| with.as_ptr() == Arc::as_ptr(model));
                if same && !body.is_changed() {
                    continue;
                }
                // The first tick brings the scale and the gravity of the scene.
                let pull = body.pulled(Pull::default());
                match Body::new(model.clone(), body.config(step, 1.0, pull)) {
                    Ok(new) => {
                        // If only the number of modes changed, the motion of the common modes
                        // continues.
                        let new = match state {
                            Some(old) if Arc::ptr_eq(old.model(), model) => carry_over(&name, &old.body, new),
                            _ => new,
                        };
                        let visual = VisualState::new(new.q());
                        // The entity may have been despawned in this frame.
                        commands
                            .entity(name.entity)
                            .try_insert((BodyState { pull, ..BodyState::new(new) }, visual))
                            .try_remove::<BuildRefused>();
                        commands.trigger(BodyReady { entity: name.entity });
                    }
                    Err(error) => {
                        refusals.report(&name, name.entity, BodyError::Build(error));
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
    // The state of the old body is finite, so this should not fail. If it does, the new body starts
    // at rest.
    if let Err(error) = new.set_state(&state) {
        warn!("{name}: the motion of the body was not carried over: {error}");
    }
    new
}

/// Removes the simulation components of an entity whose [`ModalBody`] was removed.
pub(crate) fn drop_states(removed: On<Remove, ModalBody>, mut commands: Commands) {
    if let Ok(mut entity) = commands.get_entity(removed.entity) {
        entity.try_remove::<(BodyState, VisualState, BuildRefused, SavedState)>();
    }
}

/// Sets the force of a grab that was removed from its body to zero.
pub(crate) fn clear_grab_force(removed: On<Remove, GrabOf>, mut forces: Query<&mut GrabForce>) {
    feel_nothing(removed.entity, &mut forces);
}

/// Sets the forces of the grabs on a removed body to zero, and triggers the events of their
/// release.
pub(crate) fn lose_body(
    removed: On<Remove, BodyState>,
    mut commands: Commands,
    bodies: Query<&BodyState>,
    grabs: Query<&Grabs>,
    mut forces: Query<&mut GrabForce>,
) {
    let held = bodies.get(removed.entity).map_or(&[][..], |state| &state.held[..]);
    for held in held.iter().filter(|held| held.id.is_some()) {
        commands.trigger(Released { entity: removed.entity, grab: held.entity });
    }
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

/// Applies the transform of every body whose transform changed.
pub(crate) fn place_bodies(
    mut refusals: Refusals,
    mut bodies: Query<
        (NameOrEntity, &Transform, &GlobalTransform, &mut BodyState, &mut VisualState),
        With<ModalBody>,
    >,
) {
    for (name, local, global, mut state, mut visual) in &mut bodies {
        // A free body has no parent. Its `GlobalTransform` does not contain the changes to
        // `Transform` since the last frame.
        let transform = if state.model().is_free() { GlobalTransform::from(*local) } else { *global };
        let affine = transform.affine();
        if state.is_placed(&affine) {
            continue;
        }
        state.placed = Some(affine);
        let (scale, rotation, translation) = transform.to_scale_rotation_translation();
        let uniform = (scale - scale.x).abs().max_element() <= 1e-3 * scale.x;
        if !(affine.is_finite() && scale.x > 0.0 && scale.is_finite() && rotation.is_finite() && uniform) {
            refusals.report(&name, name.entity, BodyError::Placement { translation, scale });
            continue;
        }
        let scale = f64::from(scale.x);
        // Out of a matrix that turns, the scale changes by rounding.
        if (scale - state.scale).abs() > 1e-5 * scale {
            // The running configuration is the base, because the component's fields may have been
            // refused.
            let mut running = state.body.config().clone();
            running.settings.gravity = state.pull.of_step(scale);
            match state.body_mut().reconfigure(running) {
                Ok(()) => state.scale = scale,
                Err(error) => {
                    refusals.report(&name, name.entity, BodyError::Build(error));
                    continue;
                }
            }
        }
        let origin = translation.as_dvec3() / scale;
        let rotation = rotation.as_dquat().normalize();
        match state.body_mut().set_pose(origin.into(), rotation.into()) {
            // The body jumped to this pose, so the visual state must not interpolate toward it.
            Ok(()) => visual.bypass_change_detection().forget_pose(),
            Err(error) => refusals.report(&name, name.entity, BodyError::Step(error)),
        }
    }
}

/// Synchronizes the solver's grabs with the grab entities: adds new grabs, releases removed grabs
/// and passes on the targets. A grab that finds the body full waits until a slot is free.
pub(crate) fn hold_bodies(
    mut commands: Commands,
    mut refusals: Refusals,
    mut bodies: Query<(Entity, &mut BodyState, &Driven, Option<&Grabs>)>,
    grabs: Query<(NameOrEntity, &Grab)>,
    mut forces: Query<&mut GrabForce>,
) {
    for (of, mut state, driven, list) in &mut bodies {
        let wanted = match (driven, list) {
            (Driven::Local, Some(list)) => list.entities(),
            _ => &[],
        };
        if wanted.is_empty() && state.held.is_empty() {
            continue;
        }
        let BodyState { body, held, scale, quiet, resting, .. } = &mut *state;
        let before = body.grabs().count();
        // Grabs whose settings have changed take hold anew, which is no event.
        let mut again = Vec::new();
        held.retain(|held| {
            let grab = wanted.contains(&held.entity).then(|| grabs.get(held.entity).ok()).flatten();
            if grab.is_none() {
                feel_nothing(held.entity, &mut forces);
            }
            let stays = grab.as_ref().is_some_and(|(_, grab)| grab.hold().is(&held.hold));
            if let (false, Some(id)) = (stays, held.id) {
                body.release(id);
                match grab {
                    Some(_) => again.push(held.entity),
                    None => commands.trigger(Released { entity: of, grab: held.entity }),
                }
            }
            stays
        });
        let released = body.grabs().count() < before;
        for &entity in wanted {
            let Ok((name, grab)) = grabs.get(entity) else { continue };
            let known = held.iter().position(|held| held.entity == entity);
            let index = known.unwrap_or_else(|| {
                held.push(HeldBody { entity, id: None, hold: grab.hold(), waiting: false, refusing: false });
                held.len() - 1
            });
            let held = &mut held[index];
            let free = body.grabs().count() < Body::MAX_GRABS;
            if known.is_none() || (held.waiting && free) {
                let taken = take_hold(body, grab);
                held.waiting = matches!(taken, Err(BodyError::Grab(StepError::TooManyGrabs { .. })));
                held.id = taken.map_err(|error| refusals.report(&name, entity, error)).ok();
                match (again.contains(&entity), held.id.is_some()) {
                    (false, true) => commands.trigger(Grabbed { entity: of, grab: entity }),
                    (true, false) => commands.trigger(Released { entity: of, grab: entity }),
                    _ => {}
                }
            }
            let Some(id) = held.id else { continue };
            // A target can be invalid only by being not finite.
            let refused = body.set_target(id, (grab.target / *scale).into()).is_err();
            if refused && !held.refusing {
                refusals.report(&name, entity, BodyError::TargetNotFinite { target: grab.target.into() });
            }
            held.refusing = refused;
        }
        // A grab keeps the body awake. A release wakes the body until it comes to rest. A refused
        // grab has no effect.
        if released || held.iter().any(|held| held.id.is_some()) {
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
    // Bevy runs other systems on a thread of the pool, which then hands work to all threads but the
    // main one: on two cores, to itself alone.
    _main: NonSendMarker,
    time: Res<Time>,
    mut diagnostics: Diagnostics,
    mut refusals: Refusals,
    mut islands: Local<Islands>,
    mut rigids: Option<ResMut<RigidBodies>>,
    times: Option<ResMut<BodyStepTimes>>,
    mut bodies: Query<(NameOrEntity, &ModalBody, &Driven, &mut BodyState)>,
    mut probes: Query<(NameOrEntity, &TouchProbe, &ProbeShape, &mut ProbeState)>,
) {
    let start = Instant::now();
    let step = time.delta_secs_f64();
    let mut all: Vec<_> = Vec::new();
    let probed = probes.iter().any(|(_, probe, ..)| probe.enabled);
    let pushes = rigids.as_ref().is_some_and(|rigids| !rigids.0.is_empty());
    for (name, body, driven, mut state) in &mut bodies {
        // A resting body takes part only where others may wake it.
        let steps = *driven == Driven::Local && !state.resting;
        if state.stepped != steps {
            state.stepped = steps;
        }
        if steps || (*driven == Driven::Local && (probed || pushes || state.layers.is_some())) {
            all.push((name, body.rest_speed, state));
        }
    }
    // In one order, so that the order of archetypes makes no difference.
    all.sort_by_key(|(name, ..)| name.entity.to_bits());
    if !probed && all.iter().all(|(.., state)| state.resting) {
        all.clear();
    }
    let (mut held, mut taken) = take_probes(&mut probes, &all, &mut refusals);
    let traits: Vec<_> =
        all.iter().map(|(.., state)| (state.layers, state.scale, state.probe_layers)).collect();
    let mut together: Vec<Together<'_>> = Vec::with_capacity(all.len());
    for (name, _, state) in &mut all {
        let (resting, layers) = (state.resting, state.layers);
        // A resting body has not changed as long as nothing wakes it.
        let body = &mut state.bypass_change_detection().body;
        // The running configuration is the base, because the component's fields may have been
        // refused.
        let lengthened = match body.config() {
            running if running.step == step => Ok(()),
            running => body.reconfigure(BodyConfig { step, ..running.clone() }),
        };
        let mut member = Together::new(name.entity.to_bits(), body);
        (member.resting, member.error) = (resting, lengthened.err());
        member.touches = probed || layers.is_some();
        together.push(member);
    }
    let may_touch = |a: usize, b: usize| {
        let ((Some(own), scale, _), (Some(other), of_other, _)) = (traits[a], traits[b]) else {
            return false;
        };
        scale == of_other && meet(own, other)
    };
    let may_probe = |probe: usize, body: usize| {
        let ((_, own, layers), (_, scale, others)) = (held[probe], traits[body]);
        own == scale && meet(layers, others)
    };
    if let Some(rigids) = &mut rigids {
        std::mem::swap(&mut islands.rigids, &mut rigids.0);
    }
    let mut times = times.filter(|times| times.has_work());
    let measures = times.as_mut().is_some_and(|times| times.begin_tick());
    let mut alone = start;
    islands.step_by(&mut together, &mut taken, step, may_touch, may_probe, |bodies, each| {
        on_all_threads(bodies, each, measures);
        alone = Instant::now();
    });
    if let Some(mut times) = times.filter(|_| measures) {
        times.set(&together, alone.elapsed());
    }
    if let Some(rigids) = &mut rigids {
        std::mem::swap(&mut islands.rigids, &mut rigids.0);
    }
    let results: Vec<_> = together.into_iter().map(|member| (member.resting, member.error)).collect();
    for ((entity, ..), probe) in held.drain(..).zip(taken) {
        if let Ok((.., mut state)) = probes.get_mut(entity) {
            state.give(probe);
        }
    }
    let mut stepped = 0_usize;
    for ((name, rest_speed, state), (resting, error)) in all.iter_mut().zip(results) {
        if resting {
            continue;
        }
        stepped += 1;
        // A body that was woken only because others are near may rest again at once.
        (state.stepped, state.resting) = (true, false);
        match error {
            None => state.faulted = false,
            Some(error) => {
                if !state.faulted {
                    refusals.report(name, name.entity, BodyError::Step(error));
                }
                state.faulted = true;
            }
        }
        let slow = is_slow(&state.body, *rest_speed);
        let left_alone = state.held.iter().all(|held| held.id.is_none());
        state.quiet = if slow && left_alone { state.quiet + step } else { 0.0 };
    }
    rest(&mut all);
    diagnostics.add_measurement(&AWAKE_BODIES, || stepped as f64);
    if stepped > 0 {
        diagnostics.add_measurement(&STEP_TIME, || start.elapsed().as_secs_f64() * 1e3);
    }
}

/// Steps bodies on the threads of the compute pool, where there is more work than handing it out.
fn on_all_threads<'a>(bodies: &mut [Together<'a>], step: fn(&mut Together<'a>), measured: bool) {
    // In steps of a linear body of 20 modes, which take about half a microsecond.
    let work = |together: &Together<'_>| {
        let body = &together.body;
        if body.config().settings.is_reduced(body.model()) { 300 } else { 1 + body.mode_count() / 20 }
    };
    let work: usize = bodies.iter().filter(|body| !body.resting).map(work).sum();
    let timed = |together: &mut Together<'a>| {
        let start = Instant::now();
        step(together);
        together.took = start.elapsed();
    };
    batches(bodies, work >= 200, |batch| match measured {
        true => batch.iter_mut().for_each(timed),
        false => batch.iter_mut().for_each(step),
    });
}

/// Calls `run` for parts of `items`: for all of them at once if it is not `worth` handing out.
pub(crate) fn batches<T: Send>(items: &mut [T], worth: bool, run: impl Fn(&mut [T]) + Sync) {
    match ComputeTaskPool::try_get() {
        Some(pool) if worth && items.len() > 1 => {
            // Some parts for each thread, since they are not equally long. The calling thread works
            // too.
            let size = items.len().div_ceil(4 * (pool.thread_num() + 1));
            pool.scope(|scope| {
                for part in items.chunks_mut(size) {
                    let run = &run;
                    scope.spawn(async move { run(part) });
                }
            });
        }
        _ => run(items),
    }
}

/// Whether two layers, each `[memberships, filters]`, let their owners touch.
fn meet(own: [u32; 2], other: [u32; 2]) -> bool {
    own[0] & other[1] != 0 && other[0] & own[1] != 0
}

/// Takes the probes for a step: the entity of each, the scale of the bodies that it touches and its
/// layers, and the probes.
fn take_probes(
    probes: &mut Query<(NameOrEntity, &TouchProbe, &ProbeShape, &mut ProbeState)>,
    bodies: &[(NameOrEntityItem<'_, '_>, f64, Mut<'_, BodyState>)],
    refusals: &mut Refusals,
) -> (Vec<(Entity, f64, [u32; 2])>, Vec<Probe>) {
    let (mut held, mut taken) = (Vec::new(), Vec::new());
    for (name, wanted, shape, mut state) in probes {
        let away = |state: &BodyState| {
            (DVec3::from(state.body.frame().center()) * state.scale).distance_squared(wanted.target)
        };
        let touched = |(.., body): &&(NameOrEntityItem<'_, '_>, f64, Mut<'_, BodyState>)| {
            meet(state.layers(), body.probe_layers)
        };
        let nearest = bodies.iter().filter(touched).min_by(|a, b| away(&a.2).total_cmp(&away(&b.2)));
        match state.take(wanted, shape, nearest.map_or(1.0, |(.., state)| state.scale)) {
            Ok(Some(probe)) => {
                held.push((name.entity, state.scale(), state.layers()));
                taken.push(probe);
            }
            Ok(None) => {}
            Err(error) => refusals.report(&name, name.entity, BodyError::Probe(error)),
        }
    }
    // In one order, so that the order of archetypes makes no difference.
    let mut order: Vec<_> = held.into_iter().zip(taken).collect();
    order.sort_by_key(|((entity, ..), _)| entity.to_bits());
    order.into_iter().unzip()
}

/// Lets the bodies rest that have been slow for long enough, and that touch only such bodies.
fn rest(all: &mut [(NameOrEntityItem<'_, '_>, f64, Mut<'_, BodyState>)]) {
    let index = |bits: u64| all.binary_search_by_key(&bits, |(name, ..)| name.entity.to_bits()).ok();
    let mut calm: Vec<bool> = all.iter().map(|(.., state)| state.quiet >= REST_AFTER).collect();
    loop {
        let stirred = |(.., state): &(NameOrEntityItem<'_, '_>, f64, Mut<'_, BodyState>)| {
            state.body.contacts().contacts().iter().any(|contact| match contact.other {
                Touched::Body(bits) => index(bits).is_some_and(|other| !calm[other]),
                Touched::Obstacle(_) | Touched::Probe(_) | Touched::Attachment(_) => false,
            })
        };
        let next: Vec<bool> = all.iter().zip(&calm).map(|(body, calm)| *calm && !stirred(body)).collect();
        if next == calm {
            break;
        }
        calm = next;
    }
    for ((.., state), calm) in all.iter_mut().zip(calm) {
        if calm && !state.resting {
            state.resting = true;
        }
    }
}

/// Whether the root mean square speed of the mass is below `limit` (m/s).
///
/// The modes are mass-normalized: twice their kinetic energy is `sum v^2`.
fn is_slow(body: &Body, limit: f64) -> bool {
    let mass = body.model().mass();
    let modes: f64 = body.v().iter().map(|v| v * v).sum();
    // With a limit of NaN no body rests.
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

/// Whether a viscoelastic body is still farther from its final shape than it would move at the
/// speed `limit` (m/s) during `REST_AFTER`. Such a body must not rest, however slowly it moves.
///
/// Without motion, `omega^2 (q - ratio z) = f`, and finally `q = z`. The remaining distance is
/// `ratio / (1 - ratio) (z - q)`.
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
    for (name, state, mut visual) in &mut bodies {
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
            visual.push_at(body.q(), pose)
        } else {
            visual.push(body.q())
        };
        if let Err(error) = pushed {
            warn!("{name}: a step was not shown: {error}");
        }
        visual.hold(body.held_shapes().map(|shapes| (shapes, &body.state().s[..])));
        for held in &state.held {
            let Ok(mut force) = forces.get_mut(held.entity) else { continue };
            let grab_force = held.id.and_then(|id| {
                let reaction = body.reaction(id).ok()?;
                let point = body.grab_position(id).ok()?;
                Some(GrabForce {
                    force: DVec3::from(reaction) * state.scale,
                    point: DVec3::from(point) * state.scale,
                })
            });
            force.set_if_neq(grab_force.unwrap_or_default());
        }
    }
}
