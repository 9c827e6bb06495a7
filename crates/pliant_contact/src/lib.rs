//! The Bevy plugin for contact: soft bodies touch the floors, balls, boxes, capsules, meshes
//! and distance fields of a scene, and each other.
//!
//! ```no_run
//! use bevy::prelude::*;
//! use pliant_body::{ModalBody, PliantBodyPlugin};
//! use pliant_contact::{ContactPlugin, Obstacle};
//!
//! fn main() {
//!     App::new()
//!         .add_plugins((DefaultPlugins, PliantBodyPlugin::default(), ContactPlugin::default()))
//!         .add_systems(Startup, setup)
//!         .run();
//! }
//!
//! fn setup(mut commands: Commands, assets: Res<AssetServer>) {
//!     let mut jack = ModalBody::new(assets.load("jack.modal"));
//!     jack.settings.gravity = [0.0, -9.81, 0.0];
//!     commands.spawn((jack, Transform::from_xyz(0.0, 1.0, 0.0)));
//!     commands.spawn(Obstacle::Floor);
//! }
//! ```
//!
//! | Written by you | Read by you |
//! | --- | --- |
//! | [`Obstacle`] with a `Transform`: a rigid shape | [`BodyContacts`] on a body: where it touches, with forces |
//! | [`BodyFriction`] on a body or an obstacle | [`ContactStarted`], [`ContactEnded`]: events on the body, for observers |
//! | [`TouchBodies`] on bodies: they touch each other | |
//! | [`ContactLayers`] on bodies, obstacles and probes: who touches whom | [`BodyRefused`](pliant_body::BodyRefused): a refused obstacle |
//!
//! With the feature `avian` all colliders of avian3d 0.7 are obstacles too, and bodies push its
//! dynamic rigid bodies, as they are pushed. An `Attachment` ties a place of a body to a point of a
//! rigid body, and `AttachmentForce` has the force. An [`Obstacle`] pushes bodies, and bodies do
//! not push it. Bodies push each other. A body does not touch itself. A body that another source
//! moves ([`Driven::Remote`](pliant_body::Driven::Remote)) touches nothing here.
//!
//! A body with no obstacle nearby has no contact work. The first obstacle that comes near, or
//! the first attachment, chooses the contact sites of the body's model, once for each model.
#![cfg_attr(docsrs, feature(doc_cfg))]
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

#[cfg(feature = "avian")]
mod avian;
mod contacts;
mod distance_field;
#[cfg(feature = "mesh")]
mod mesh;
mod obstacle;
#[cfg(test)]
mod tests;

use bevy::{
    ecs::schedule::{InternedScheduleLabel, ScheduleLabel},
    prelude::*,
};
use pliant_body::PliantSystems;

#[cfg(feature = "avian")]
pub use avian::{Attachment, AttachmentForce};
pub use contacts::{BodyContacts, BodyFriction, ContactEnded, ContactPoint, ContactStarted, TouchBodies};
pub use distance_field::DistanceField;
pub use obstacle::{ContactLayers, Obstacle};

/// Lets bodies touch the [`Obstacle`]s of the scene, and each other ([`TouchBodies`]).
///
/// The plugin needs [`PliantBodyPlugin`](pliant_body::PliantBodyPlugin) in the same schedule, and
/// is added after Bevy's `AssetPlugin`, which `DefaultPlugins` has.
pub struct ContactPlugin {
    schedule: InternedScheduleLabel,
}

impl ContactPlugin {
    /// Follows bodies that are stepped in `schedule`.
    pub fn new(schedule: impl ScheduleLabel) -> Self {
        Self { schedule: schedule.intern() }
    }
}

impl Default for ContactPlugin {
    /// Follows bodies that are stepped in `FixedUpdate`.
    fn default() -> Self {
        Self::new(FixedUpdate)
    }
}

impl Plugin for ContactPlugin {
    fn build(&self, app: &mut App) {
        #[cfg(feature = "mesh")]
        app.init_resource::<mesh::Solids>();
        #[cfg(feature = "avian")]
        avian::build(app, self.schedule);
        app.init_asset::<DistanceField>()
            .register_asset_reflect::<DistanceField>()
            .register_type::<Obstacle>()
            .register_type::<ContactLayers>()
            .register_type::<BodyFriction>()
            .register_type::<TouchBodies>()
            .register_type::<BodyContacts>()
            .register_type::<ContactPoint>()
            .register_type::<ContactStarted>()
            .register_type::<ContactEnded>()
            .register_type::<contacts::Nearby>()
            .add_observer(contacts::prepare_body)
            .add_observer(contacts::forget_body)
            .add_observer(contacts::fill_fixed)
            .add_systems(
                self.schedule,
                (
                    (obstacle::move_obstacles, contacts::place_obstacles, contacts::touch_bodies)
                        .chain()
                        .after(PliantSystems::Input)
                        .before(PliantSystems::Step)
                        .run_if(|time: Res<Time>| !time.delta().is_zero()),
                    contacts::publish.in_set(PliantSystems::Publish),
                ),
            );
    }
}
