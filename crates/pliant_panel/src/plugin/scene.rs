//! Bodies, time and the recording of a scene.

use bevy::{
    diagnostic::DiagnosticsStore,
    ecs::{entity::EntityHashMap, system::SystemParam},
    prelude::*,
};
use bevy_egui::egui::Ui;
use pliant_body::{
    BodyState, DEFORM_TIME, Driven, Grab, GrabForce, Grabs, ModalBody, PliantTick, STEP_TIME, ShownState,
};

use crate::{
    Trace,
    bodies::{self, BodyView, HandView},
    time::{self, TimeView},
};

/// What the panel remembers of the scene, for its plots.
#[derive(Resource, Default)]
pub(super) struct Histories {
    energies: EntityHashMap<Trace>,
    forces: EntityHashMap<Trace>,
    step_ms: Trace,
    deform_ms: Trace,
}

#[derive(SystemParam)]
pub(super) struct Scene<'w, 's> {
    commands: Commands<'w, 's>,
    histories: ResMut<'w, Histories>,
    virtual_time: ResMut<'w, Time<Virtual>>,
    fixed_time: Option<ResMut<'w, Time<Fixed>>>,
    real_time: Res<'w, Time<Real>>,
    tick: Res<'w, PliantTick>,
    diagnostics: Option<Res<'w, DiagnosticsStore>>,
    bodies: Query<
        'w,
        's,
        (
            NameOrEntity,
            &'static mut ModalBody,
            &'static mut BodyState,
            &'static Driven,
            Option<&'static ShownState>,
            Option<&'static Grabs>,
        ),
    >,
    grabs: Query<'w, 's, (NameOrEntity, &'static GrabForce), With<Grab>>,
    #[cfg(feature = "net")]
    people: super::hands::People<'w, 's>,
}

impl Scene<'_, '_> {
    pub fn show_time(&mut self, ui: &mut Ui) {
        let now = self.real_time.elapsed_secs_f64();
        let Histories { step_ms, deform_ms, .. } = &mut *self.histories;
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
            step_ms: self.histories.step_ms.clone(),
            deform_ms: self.histories.deform_ms.clone(),
        };
        let before = (view.paused, view.speed);
        time::show(ui, &mut view);
        if view.paused != before.0 {
            if view.paused { self.virtual_time.pause() } else { self.virtual_time.unpause() }
        }
        if view.speed != before.1 && view.speed.is_finite() && view.speed > 0.0 {
            self.virtual_time.set_relative_speed_f64(view.speed);
        }
        if view.step_once
            && let Some(fixed) = &mut self.fixed_time
        {
            // The next pass of the fixed loop finds one step's worth of time, and no more.
            let step = fixed.timestep();
            let lacking = step.saturating_sub(fixed.overstep());
            fixed.accumulate_overstep(lacking);
        }
    }

    pub fn show_bodies(&mut self, ui: &mut Ui) {
        let now = self.real_time.elapsed_secs_f64();
        let Histories { energies, forces, .. } = &mut *self.histories;
        energies.retain(|entity, _| self.bodies.contains(*entity));
        forces.retain(|entity, _| self.grabs.contains(*entity));
        let mut found: Vec<_> = self.bodies.iter_mut().collect();
        found.sort_by_key(|(name, ..)| name.entity);
        let mut views: Vec<BodyView> = found
            .iter()
            .map(|(name, body, state, driven, shown, grabs)| {
                let model = state.model();
                let energy = energy_of(state, driven, *shown);
                let energies = energies.entry(name.entity).or_default();
                energies.push(now, energy);
                let held = grabs.map(Grabs::entities).unwrap_or_default();
                #[cfg_attr(
                    not(feature = "net"),
                    expect(unused_mut, reason = "others' hands come with the network")
                )]
                let mut hands: Vec<HandView> = held
                    .iter()
                    .filter_map(|&grab| self.grabs.get(grab).ok())
                    .map(|(name, force)| {
                        let trace = forces.entry(name.entity).or_default();
                        trace.push(now, force.force.length());
                        #[cfg(feature = "net")]
                        let whose = self.people.whose(name.entity);
                        #[cfg(not(feature = "net"))]
                        let whose: Option<(String, [u8; 3])> = None;
                        let (whose, colour) = whose.unzip();
                        let own = name.name.map(|name| name.as_str().to_owned());
                        HandView {
                            name: own.or(whose).unwrap_or_else(|| "hand".into()),
                            colour,
                            force: force.force.length(),
                            forces: trace.clone(),
                        }
                    })
                    .collect();
                #[cfg(feature = "net")]
                hands.extend(self.people.others(name.entity, now));
                BodyView {
                    name: name
                        .name
                        .map_or_else(|| model_name(&model.info().name, name.entity), ToString::to_string),
                    modes: state.body().mode_count(),
                    all_modes: model.mode_count(),
                    lowest_hz: state
                        .body()
                        .omega()
                        .first()
                        .map_or(0.0, |omega| omega / std::f64::consts::TAU),
                    stiffness_scale: body.stiffness_scale,
                    damping_scale: body.damping_scale,
                    warp: body.warp,
                    local: **driven == Driven::Local,
                    resting: state.is_resting(),
                    energy,
                    energies: energies.clone(),
                    hands,
                    ..default()
                }
            })
            .collect();
        bodies::show(ui, &mut views);
        for (view, (_, body, state, _, _, grabs)) in views.into_iter().zip(found) {
            take_over(&view, body, state);
            if view.release {
                for &grab in grabs.map(Grabs::entities).unwrap_or_default() {
                    self.commands.entity(grab).despawn();
                }
            }
        }
    }
}

/// What a body without a name of its own is called: as the file that it was baked from.
fn model_name(file: &str, entity: Entity) -> String {
    let file = std::path::Path::new(file).file_stem();
    file.map_or_else(|| format!("body {entity}"), |stem| stem.to_string_lossy().into_owned())
}

/// Kinetic and elastic energy, J of the world; of a body that somebody else steps only the shape is known, and only its elastic energy.
fn energy_of(state: &BodyState, driven: &Driven, shown: Option<&ShownState>) -> f64 {
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
    // Written only where something differs: a change makes the body look at its settings anew.
    let kept = state.body().mode_count();
    if view.modes != kept {
        body.modes = (view.modes < view.all_modes).then_some(view.modes.max(1));
    }
    if view.stiffness_scale != body.stiffness_scale {
        body.stiffness_scale = view.stiffness_scale;
    }
    if view.damping_scale != body.damping_scale {
        body.damping_scale = view.damping_scale;
    }
    if view.warp != body.warp {
        body.warp = view.warp;
    }
    if view.wake {
        state.wake();
    }
}

#[cfg(feature = "rerun")]
#[derive(SystemParam)]
pub(super) struct Recording<'w> {
    stats: Option<Res<'w, pliant_rerun::RerunStats>>,
    settings: Option<ResMut<'w, pliant_rerun::RerunRecording>>,
}

#[cfg(feature = "rerun")]
impl Recording<'_> {
    pub fn is_there(&self) -> bool {
        self.settings.is_some()
    }

    pub fn show(mut self, ui: &mut Ui) {
        use pliant_rerun::RerunColour;

        let (Some(stats), Some(settings)) = (&self.stats, &mut self.settings) else { return };
        let mut view = crate::recording::RecordingView {
            on: settings.on,
            sinks: stats.sinks,
            ticks: stats.collected,
            dropped: stats.dropped,
            shapes_hz: settings.shapes_hz,
            modes_hz: settings.modes_hz,
            stress: settings.colour == RerunColour::Stress,
        };
        crate::recording::show(ui, &mut view);
        let colour = if view.stress { RerunColour::Stress } else { RerunColour::Displacement };
        let wanted = pliant_rerun::RerunRecording {
            on: view.on,
            shapes_hz: view.shapes_hz,
            modes_hz: view.modes_hz,
            colour,
            ..**settings
        };
        if wanted != **settings {
            **settings = wanted;
        }
    }
}
