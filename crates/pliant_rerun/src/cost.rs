//! Which elasticity each body has, and what a step of it takes.

use std::sync::Arc;

use bevy::{ecs::entity::EntityHashMap, prelude::*};
use pliant_body::{BodyState, BodyStepTimes, Material};

use crate::{RerunScalars, collect::Collector, frame::Metric};

/// The metric of a body.
pub(crate) struct Plotted {
    body: Arc<str>,
    metric: Arc<Metric>,
}

/// Plots the time that the step of each body has taken.
pub(crate) fn plot_step_times(
    bodies: Query<Entity, With<BodyState>>,
    times: Res<BodyStepTimes>,
    collector: Res<Collector>,
    mut plotted: Local<EntityHashMap<Plotted>>,
    mut own: ResMut<RerunScalars>,
) {
    plotted.retain(|entity, _| bodies.contains(*entity));
    for entity in &bodies {
        let (Some(time), Some(body)) = (times.get(entity), collector.path_of(entity)) else { continue };
        if plotted.get(&entity).is_none_or(|known| known.body != *body) {
            let metric = Arc::new(Metric { path: format!("step/{body}"), unit: "us".to_owned() });
            plotted.insert(entity, Plotted { body: body.clone(), metric });
        }
        if let Some(known) = plotted.get(&entity) {
            own.measured(&known.metric, time.as_secs_f64() * 1e6);
        }
    }
}

/// What the log has said of a body: its name, and its material and its number of coordinates or
/// modes.
pub(crate) struct Told {
    body: Arc<str>,
    material: Option<Material>,
    count: usize,
}

/// Writes a line to the log when a body is there and when its elasticity changes.
pub(crate) fn log_elasticity(
    bodies: Query<(Entity, Ref<BodyState>)>,
    collector: Res<Collector>,
    mut told: Local<EntityHashMap<Told>>,
    mut own: ResMut<RerunScalars>,
) {
    told.retain(|entity, _| bodies.contains(*entity));
    for (entity, state) in &bodies {
        if !state.is_changed() && told.contains_key(&entity) {
            continue;
        }
        let Some(path) = collector.path_of(entity) else { continue };
        let (body, model) = (state.body(), state.model());
        let material = model.material().filter(|_| body.config().settings.is_reduced(model));
        let count = body.mode_count();
        let known = |told: &Told| told.body == *path && told.material == material && told.count == count;
        if !told.get(&entity).is_some_and(known) {
            own.log(match material {
                Some(material) => format!("{path}: reduced elasticity, {material}, coordinates: {count}"),
                None => format!("{path}: linear elasticity, modes: {count}"),
            });
            told.insert(entity, Told { body: path.clone(), material, count });
        }
    }
}
