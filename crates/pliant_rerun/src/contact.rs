//! Where bodies touch: the force of each place as an arrow, and sums for the plots.

use std::sync::Arc;

use bevy::{ecs::entity::EntityHashMap, prelude::*};
use pliant_body::BodyState;
use pliant_contact::{BodyContacts, ContactPoint};

use crate::{
    RerunScalars,
    collect::Collector,
    frame::{Metric, RecordedContact},
};

/// Gathers the places where bodies touch, which are drawn if they have changed.
pub(crate) fn see_contacts(
    bodies: Query<(Entity, &BodyContacts)>,
    mut order: Local<Vec<Entity>>,
    mut places: Local<Vec<RecordedContact>>,
    mut collector: ResMut<Collector>,
) {
    order.clear();
    order.extend(bodies.iter().filter(|(_, contacts)| !contacts.0.is_empty()).map(|(entity, _)| entity));
    order.sort_unstable();
    let touching = order.iter().filter_map(|&entity| bodies.get(entity).ok());
    places.clear();
    places.extend(touching.flat_map(|(_, contacts)| &contacts.0).map(|place: &ContactPoint| {
        RecordedContact {
            point: place.point.as_vec3().into(),
            force: place.force.as_vec3().into(),
            sliding: place.sliding,
        }
    }));
    collector.set_contacts(&mut places);
}

/// The metrics of a body that has touched something: force, depth and number of places.
pub(crate) struct Plotted {
    body: Arc<str>,
    metrics: [Arc<Metric>; 3],
    last: [f64; 3],
    /// [`RerunScalars::lost`] when they were set.
    lost: u64,
}

/// Plots what each body feels where it touches. A body that has touched nothing has no plot, and
/// one that rests gets no further values.
pub(crate) fn plot_contacts(
    bodies: Query<(Entity, &BodyState, &BodyContacts)>,
    collector: Res<Collector>,
    mut plotted: Local<EntityHashMap<Plotted>>,
    mut own: ResMut<RerunScalars>,
) {
    plotted.retain(|entity, _| bodies.contains(*entity));
    for (entity, state, contacts) in &bodies {
        let Some(body) = collector.path_of(entity) else { continue };
        if plotted.get(&entity).is_none_or(|known| known.body != *body) {
            if contacts.0.is_empty() {
                continue;
            }
            let metric = |what: &str, unit: &str| {
                Arc::new(Metric { path: format!("contact/{body}{what}"), unit: unit.to_owned() })
            };
            let metrics = [metric("", "N"), metric("/depth", "m"), metric("/places", "")];
            plotted.insert(entity, Plotted { body: body.clone(), metrics, last: [f64::NAN; 3], lost: 0 });
        }
        let Some(known) = plotted.get_mut(&entity) else { continue };
        let depth = contacts.0.iter().map(|place| place.penetration).fold(0.0, f64::max);
        let now = [contacts.force().length(), depth, contacts.0.len() as f64];
        if state.is_resting() && now == known.last && known.lost == own.lost {
            continue;
        }
        (known.last, known.lost) = (now, own.lost);
        for (metric, value) in known.metrics.iter().zip(now) {
            own.measured(metric, value);
        }
    }
}
