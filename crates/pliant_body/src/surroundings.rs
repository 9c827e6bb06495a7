//! What stands still around a body, for a source that steps the body elsewhere.

use bevy::prelude::*;
use pliant_modal::{Contacts, FixedObstacle};

/// What stands still around a body and what it touches there.
///
/// A source that steps the body itself, such as a session of peers, inserts the default. A plugin
/// that knows obstacles fills it in at once (an observer of [`Insert`]). Without such a plugin, the
/// body touches nothing.
#[derive(Component, Debug, Clone, PartialEq)]
pub struct FixedObstacles {
    /// Coefficient of friction between the body and all obstacles. Default: 0.5.
    pub friction: f64,
    /// The obstacles, in the axes of the solver's world: the entity's world divided by its scale.
    /// What moves is not among them. Default: none.
    pub obstacles: Vec<FixedObstacle>,
}

impl Default for FixedObstacles {
    fn default() -> Self {
        Self { friction: Contacts::FRICTION, obstacles: Vec::new() }
    }
}
