//! The gravity of a scene.

use bevy::{math::DVec3, prelude::*};
use pliant_modal::BodyConfig;

use crate::{BodyError, BodyState, ModalBody, step::Refusals};

/// Gravity of all bodies of the app, m/s^2, world axes. Default: zero, so that bodies float and
/// have the shape of their model.
///
/// A body feels it times its [`BodyGravityScale`], in addition to the gravity of its own
/// [`settings`](ModalBody::settings). A change acts in the next tick and wakes the bodies. A value
/// that the solver refuses is reported once for every body
/// ([`BodyRefused`](crate::BodyRefused)), which keeps the gravity that it had.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::{BodyGravity, BodyGravityScale, ModalBody};
/// fn setup(mut commands: Commands, assets: Res<AssetServer>) {
///     commands.insert_resource(BodyGravity::EARTH);
///     commands.spawn(ModalBody::new(assets.load("pip.modal")));
///     // A balloon, which rises slowly.
///     commands.spawn((ModalBody::new(assets.load("balloon.modal")), BodyGravityScale(-0.1)));
/// }
/// ```
///
/// In a session a host's bodies have the host's gravity on all machines. Peers agree on it when
/// they meet, as on the other settings, so all of them need the same. The engine `avian` has a
/// `Gravity` of its own, which does not act on these bodies.
#[derive(Resource, Reflect, Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Resource, Debug, Default, Clone, PartialEq)]
pub struct BodyGravity(pub Vec3);

impl BodyGravity {
    /// Gravity of the Earth, down the y axis.
    pub const EARTH: Self = Self(Vec3::new(0.0, -9.81, 0.0));
}

/// Factor of the scene's [`BodyGravity`] for one body. Default: 1. With 0 the body floats.
///
/// [`ModalBody`] brings the component along. The gravity in the body's own settings is not scaled.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct BodyGravityScale(pub f32);

impl Default for BodyGravityScale {
    fn default() -> Self {
        Self(1.0)
    }
}

/// The gravity that a body has accepted, m/s^2, world axes and world lengths.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Pull {
    /// That of its settings.
    pub own: DVec3,
    /// That of the scene, with the body's factor.
    pub scene: DVec3,
    /// The scene's gravity that was processed last: accepted or refused.
    pub asked: DVec3,
}

impl Pull {
    /// The gravity of a step, m/s^2, in the world of a body of this scale. No other place decides
    /// it.
    pub fn of_step(&self, scale: f64) -> [f64; 3] {
        ((self.own + self.scene) / scale).into()
    }
}

/// Gives the bodies the gravity of the scene where it has changed.
pub(crate) fn pull_bodies(
    gravity: Res<BodyGravity>,
    mut refusals: Refusals,
    mut bodies: Query<(NameOrEntity, &BodyGravityScale, &mut BodyState), With<ModalBody>>,
) {
    for (name, factor, mut state) in &mut bodies {
        let asked = gravity.0.as_dvec3() * f64::from(factor.0);
        // The comparison of bits also works for NaN.
        if asked.to_array().map(f64::to_bits) == state.pull.asked.to_array().map(f64::to_bits) {
            continue;
        }
        state.pull.asked = asked;
        let pull = Pull { scene: asked, ..state.pull };
        let mut running: BodyConfig = state.body.config().clone();
        running.settings.gravity = pull.of_step(state.scale);
        match state.body_mut().reconfigure(running) {
            Ok(()) => state.pull = pull,
            Err(error) => refusals.report(&name, name.entity, BodyError::Build(error)),
        }
    }
}
