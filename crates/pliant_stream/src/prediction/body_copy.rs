//! The state of a body with its hands and contacts, as one step leaves it and the next one needs
//! it.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::{ContactState, HeldShapes, State};

use crate::state::GrabKey;

/// What a step leaves of a hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandState {
    /// Identifies the grab.
    pub key: GrabKey,
    /// Force on the body at the end of the step, world axes, N.
    pub pull: Vector3<f64>,
    /// Force on the body over the step, world axes, N.
    pub mean: Vector3<f64>,
    /// Position of the hand, world, m. `None` if only the patch's displacement is known.
    pub target: Option<Vector3<f64>>,
    /// Viscoelastic state of the patch's residual flexibility, body axes, m.
    pub viscoelastic: Vector3<f64>,
}

impl HandState {
    /// A hand of which only the force over the step is known, N, world axes.
    pub(crate) fn of_mean(key: GrabKey, mean: Vector3<f64>) -> Self {
        let zero = Vector3::zeros();
        Self { key, pull: zero, mean, target: None, viscoelastic: zero }
    }
}

/// A state with its hands and its contacts. A step of [`Replica`](crate::replica::Replica) replaces
/// all.
#[derive(Debug, Default)]
pub(crate) struct BodyCopy {
    pub state: State,
    pub hands: Vec<HandState>,
    pub contacts: ContactState,
    /// The own shapes of held patches whose coordinates the state has, where the copies of a body
    /// change them by tick ([`Replica::shape`](crate::replica::Replica::shape)).
    pub shapes: Option<Arc<HeldShapes>>,
}

impl Clone for BodyCopy {
    fn clone(&self) -> Self {
        Self {
            state: self.state.clone(),
            hands: self.hands.clone(),
            contacts: self.contacts.clone(),
            shapes: self.shapes.clone(),
        }
    }

    /// Copies into the memory that is there, because every tick is remembered.
    fn clone_from(&mut self, from: &Self) {
        self.state.clone_from(&from.state);
        self.hands.clone_from(&from.hands);
        self.contacts.clone_from(&from.contacts);
        self.shapes.clone_from(&from.shapes);
    }
}

impl BodyCopy {
    /// A copy without hands and contacts.
    pub(crate) fn new(state: State) -> Self {
        Self { state, hands: Vec::new(), contacts: ContactState::default(), shapes: None }
    }

    pub(crate) fn hand(&self, key: GrabKey) -> Option<&HandState> {
        self.hands.iter().find(|hand| hand.key == key)
    }

    /// The mean force of a hand, or zero for a hand without one.
    pub(crate) fn mean(&self, key: GrabKey) -> Vector3<f64> {
        self.hand(key).map_or_else(Vector3::zeros, |hand| hand.mean)
    }
}
