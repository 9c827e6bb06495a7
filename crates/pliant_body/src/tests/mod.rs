//! Test apps with manual time, and a bar whose modes have a closed form, so that every number has
//! an independent value.

mod baking;
mod display;
mod grabs;
mod gravity;
#[cfg(feature = "bake")]
mod held;
mod impulses;
mod inertia;
mod load;
pub mod model;
mod pausing;
#[cfg(feature = "picking")]
mod pointer;
mod probe;
mod settings;
mod stepping;
mod surface_anchor;

use std::{sync::Arc, time::Duration};

use bevy::{ecs::schedule::ScheduleLabel, prelude::*, time::TimeUpdateStrategy, transform::TransformPlugin};
use pliant_modal::ModalModel;

use crate::{BodyRefused, BodyState, ModalAsset, ModalBody, PliantBodyPlugin, PliantTick, RidingPlugin};

/// Length of a step, s.
pub const STEP: f64 = 1.0 / 40.0;

/// Returns an app without a renderer whose every update is one step.
pub fn app() -> App {
    app_in(FixedUpdate)
}

/// Returns the same app as [`app`], with bodies that are stepped in `schedule`.
pub fn app_in(schedule: impl ScheduleLabel) -> App {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin))
        .insert_resource(Time::<Fixed>::from_seconds(STEP))
        .insert_resource(TimeUpdateStrategy::FixedTimesteps(1))
        .add_plugins((PliantBodyPlugin::new(schedule.intern()), RidingPlugin::new(schedule)))
        .init_resource::<Received>()
        .add_observer(|refused: On<BodyRefused>, mut received: ResMut<Received>| {
            received.0.push((refused.entity, refused.error.to_string()));
        });
    app.update();
    app
}

#[derive(Resource, Default)]
struct Received(Vec<(Entity, String)>);

/// Spawns a body together with `bundle`. Its first step is in the next update.
pub fn spawn(app: &mut App, model: ModalModel, bundle: impl Bundle) -> Entity {
    spawn_with(app, model, |_| {}, bundle)
}

pub fn spawn_with(
    app: &mut App,
    model: ModalModel,
    settings: impl FnOnce(&mut ModalBody),
    bundle: impl Bundle,
) -> Entity {
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(Arc::new(model)));
    let mut body = ModalBody::new(handle);
    settings(&mut body);
    let entity = app.world_mut().spawn((body, bundle)).id();
    app.update();
    entity
}

pub fn steps(app: &mut App, count: usize) {
    for _ in 0..count {
        app.update();
    }
}

/// Sets the length of a frame as a fraction of a step: 0.5 means two frames per step.
pub fn frames_of(app: &mut App, fraction: f64) {
    let frame = Duration::from_secs_f64(STEP * fraction);
    app.insert_resource(TimeUpdateStrategy::ManualDuration(frame));
}

pub fn state(app: &App, body: Entity) -> &BodyState {
    app.world().get::<BodyState>(body).expect("the body was made")
}

pub fn tick(app: &App) -> u64 {
    app.world().resource::<PliantTick>().0
}

/// Returns the refusals since the last call, as text.
pub fn refusals(app: &mut App) -> Vec<(Entity, String)> {
    std::mem::take(&mut app.world_mut().resource_mut::<Received>().0)
}
