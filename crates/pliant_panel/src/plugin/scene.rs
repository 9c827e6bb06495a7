//! The bodies, the time and the recording of a scene.

use std::collections::HashMap;

use bevy::{
    diagnostic::DiagnosticsStore,
    ecs::{entity::EntityHashMap, system::SystemParam},
    prelude::*,
};
use bevy_egui::egui::Ui;
use pliant_body::{
    BodyState, BodyStepTimes, DEFORM_TIME, Driven, Grab, GrabForce, Grabs, ModalBody, PliantTick, STEP_TIME,
    SingleSteps, VisualState,
};

use crate::{
    Trace,
    bodies::{self, BodyView, HandView},
    time::{self, TimeView},
};

/// Share of the newest time of a step in the mean that is shown, so that it can be read.
const STEP_SHARE: f64 = 0.05;

/// Data of the scene that the panel keeps between frames, for its plots.
#[derive(Resource, Default)]
pub(super) struct SceneHistories {
    energies: EntityHashMap<Trace>,
    forces: HashMap<HandKey, Trace>,
    #[cfg(feature = "contact")]
    contacts: EntityHashMap<Trace>,
    /// Whether a body's header is closed.
    folded: EntityHashMap<bool>,
    /// Mean time of a step of each body over the last frames with a tick, us.
    step_us: EntityHashMap<f64>,
    /// The tick that was shown last.
    tick: u64,
    step_ms: Trace,
    deform_ms: Trace,
}

/// Identifies a hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum HandKey {
    /// A grab entity of this app.
    Grab(Entity),
    /// A remote hand: its body, its user, and its number among that user's hands on the body.
    #[cfg(feature = "net")]
    Remote { body: Entity, user: u16, nth: usize },
}

#[derive(SystemParam)]
pub(super) struct SceneParam<'w, 's> {
    commands: Commands<'w, 's>,
    histories: ResMut<'w, SceneHistories>,
    virtual_time: ResMut<'w, Time<Virtual>>,
    steps: MessageWriter<'w, SingleSteps>,
    fixed_time: Option<Res<'w, Time<Fixed>>>,
    real_time: Res<'w, Time<Real>>,
    tick: Res<'w, PliantTick>,
    times: ResMut<'w, BodyStepTimes>,
    diagnostics: Option<Res<'w, DiagnosticsStore>>,
    bodies: Query<
        'w,
        's,
        (
            NameOrEntity,
            &'static mut ModalBody,
            &'static mut BodyState,
            &'static Driven,
            Option<&'static VisualState>,
            Option<&'static Grabs>,
        ),
    >,
    grabs: Query<'w, 's, (NameOrEntity, &'static GrabForce), With<Grab>>,
    #[cfg(feature = "contact")]
    contacts: Query<'w, 's, &'static pliant_contact::BodyContacts>,
    #[cfg(feature = "net")]
    people: super::hands::People<'w, 's>,
}

impl SceneParam<'_, '_> {
    pub fn show_time(&mut self, ui: &mut Ui) {
        let now = self.real_time.elapsed_secs_f64();
        let SceneHistories { step_ms, deform_ms, .. } = &mut *self.histories;
        for (path, trace) in [(STEP_TIME, step_ms), (DEFORM_TIME, deform_ms)] {
            let newest = self.diagnostics.as_ref().and_then(|all| all.get(&path)?.measurement());
            if let Some(newest) = newest {
                trace.push(now, newest.value);
            }
        }
        let step = self.fixed_time.as_ref().map(|fixed| fixed.timestep());
        let mut view = TimeView {
            paused: self.virtual_time.is_paused(),
            speed: self.virtual_time.relative_speed_f64(),
            step: step.unwrap_or(self.virtual_time.delta()).as_secs_f64(),
            tick: self.tick.0,
            step_once: false,
            step_ms: std::mem::take(&mut self.histories.step_ms),
            deform_ms: std::mem::take(&mut self.histories.deform_ms),
        };
        let before = (view.paused, view.speed);
        time::show(ui, &mut view);
        (self.histories.step_ms, self.histories.deform_ms) = (view.step_ms, view.deform_ms);
        if view.paused != before.0 {
            if view.paused { self.virtual_time.pause() } else { self.virtual_time.unpause() }
        }
        if view.speed != before.1 && view.speed.is_finite() && view.speed > 0.0 {
            self.virtual_time.set_relative_speed_f64(view.speed);
        }
        if view.step_once {
            self.steps.write(SingleSteps(1));
        }
    }

    pub fn show_bodies(&mut self, ui: &mut Ui) {
        let now = self.real_time.elapsed_secs_f64();
        // Histories that are not shown in this frame are dropped: those of removed bodies, released
        // hands and users who left.
        let mut energies = std::mem::take(&mut self.histories.energies);
        let mut forces = std::mem::take(&mut self.histories.forces);
        #[cfg(feature = "contact")]
        let mut contacts = std::mem::take(&mut self.histories.contacts);
        let folded = std::mem::take(&mut self.histories.folded);
        let means = std::mem::take(&mut self.histories.step_us);
        let stepped = std::mem::replace(&mut self.histories.tick, self.tick.0) != self.tick.0;
        self.times.ask();
        let mut found: Vec<_> = self.bodies.iter_mut().collect();
        found.sort_by_key(|(name, ..)| name.entity);
        let many = found.len() > 3;
        let (mut views, mut keys) = (Vec::with_capacity(found.len()), Vec::with_capacity(found.len()));
        for (name, body, state, driven, shown, grabs) in &found {
            let model = state.model();
            let mut view = BodyView {
                name: name
                    .name
                    .map_or_else(|| model_name(&model.info().name, name.entity), ToString::to_string),
                local: **driven == Driven::Local,
                resting: state.is_resting(),
                folded: folded.get(&name.entity).copied().unwrap_or(many),
                ..default()
            };
            let mut keys_here = Vec::new();
            if !view.folded {
                view.modes = state.body().mode_count();
                view.all_modes = model.mode_count();
                view.material = model.material().map_or_else(String::new, |material| material.to_string());
                let omega = state.body().omega().first();
                view.lowest_hz = omega.map_or(0.0, |omega| omega / std::f64::consts::TAU);
                view.settings = body.settings;
                view.step_us = self.times.get(name.entity).map(|time| {
                    let newest = time.as_secs_f64() * 1e6;
                    match means.get(&name.entity) {
                        Some(mean) if stepped => mean + STEP_SHARE * (newest - mean),
                        Some(mean) => *mean,
                        None => newest,
                    }
                });
                view.energy = energy_of(state, driven, *shown);
                view.energies = energies.remove(&name.entity).unwrap_or_default();
                view.energies.push(now, view.energy);
                #[cfg(feature = "contact")]
                if let Ok(touched) = self.contacts.get(name.entity) {
                    view.contact = contact_of(touched, contacts.remove(&name.entity), now);
                }
                for &grab in grabs.map(Grabs::entities).unwrap_or_default() {
                    let Ok((name, force)) = self.grabs.get(grab) else { continue };
                    #[cfg(feature = "net")]
                    let whose = self.people.whose(grab);
                    #[cfg(not(feature = "net"))]
                    let whose: Option<(String, [u8; 3])> = None;
                    let (whose, color) = whose.unzip();
                    let own = name.name.map(|name| name.as_str().to_owned());
                    keys_here.push(HandKey::Grab(grab));
                    view.hands.push(HandView {
                        name: own.or(whose).unwrap_or_else(|| "hand".into()),
                        color,
                        releasable: true,
                        force: force.force.length(),
                        ..default()
                    });
                }
                #[cfg(feature = "net")]
                for (key, hand) in self.people.others(name.entity) {
                    keys_here.push(key);
                    view.hands.push(hand);
                }
                for (key, hand) in keys_here.iter().zip(&mut view.hands) {
                    hand.forces = forces.remove(key).unwrap_or_default();
                    hand.forces.push(now, hand.force);
                }
            }
            views.push(view);
            keys.push(keys_here);
        }
        let filled: Vec<bool> = views.iter().map(|view| !view.folded).collect();
        bodies::show(ui, &mut views);
        let histories = &mut *self.histories;
        for (((view, keys), filled), (name, body, state, _, _, grabs)) in
            views.into_iter().zip(keys).zip(filled).zip(found)
        {
            histories.folded.insert(name.entity, view.folded);
            if !filled {
                continue;
            }
            take_over(&view, body, state);
            if view.release {
                // If the hand belongs to a guest, the session notifies that guest.
                for &grab in grabs.map(Grabs::entities).unwrap_or_default() {
                    self.commands.entity(grab).despawn();
                }
            }
            histories.step_us.extend(view.step_us.map(|mean| (name.entity, mean)));
            histories.energies.insert(name.entity, view.energies);
            #[cfg(feature = "contact")]
            histories.contacts.extend(view.contact.map(|contact| (name.entity, contact.forces)));
            histories.forces.extend(keys.into_iter().zip(view.hands.into_iter().map(|hand| hand.forces)));
        }
    }
}

/// What a body touches at time `now` (s), if it has touched anything. `forces` is its history.
#[cfg(feature = "contact")]
fn contact_of(
    touched: &pliant_contact::BodyContacts,
    forces: Option<Trace>,
    now: f64,
) -> Option<bodies::ContactView> {
    if forces.is_none() && touched.0.is_empty() {
        return None;
    }
    let mut forces = forces.unwrap_or_default();
    let force = touched.force().length();
    forces.push(now, force);
    Some(bodies::ContactView {
        places: touched.0.len(),
        sliding: touched.0.iter().filter(|place| place.sliding).count(),
        force,
        depth: touched.0.iter().map(|place| place.penetration).fold(0.0, f64::max),
        forces,
    })
}

/// Returns the name of a body without a name of its own: the name of the file from which it was
/// baked.
fn model_name(file: &str, entity: Entity) -> String {
    let file = std::path::Path::new(file).file_stem();
    file.map_or_else(|| format!("body {entity}"), |stem| stem.to_string_lossy().into_owned())
}

/// Returns the kinetic and elastic energy, J, in the world's scale.
///
/// For a remote body only the shape is known, so that the result is its elastic energy.
fn energy_of(state: &BodyState, driven: &Driven, shown: Option<&VisualState>) -> f64 {
    let energy = match (driven, shown) {
        (Driven::Remote, Some(shown)) => {
            let modes = shown.current().iter().zip(state.body().omega());
            0.5 * modes.map(|(q, omega)| (q * omega).powi(2)).sum::<f64>()
        }
        _ => state.body().energy(),
    };
    energy * state.scale() * state.scale()
}

fn take_over(view: &BodyView, mut body: Mut<ModalBody>, mut state: Mut<BodyState>) {
    if !view.local {
        return;
    }
    // The component is written only if a value differs, because a change makes the body check its
    // settings again.
    let kept = state.body().mode_count();
    if view.modes != kept {
        body.modes = (view.modes < view.all_modes).then_some(view.modes.max(1));
    }
    if view.settings != body.settings {
        body.settings = view.settings;
    }
    if view.wake {
        state.wake();
    }
}
