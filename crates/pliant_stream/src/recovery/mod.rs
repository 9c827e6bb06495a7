//! Loss recovery at the receiver: policies behind one trait that share one store of received data.

mod acceleration;
mod blend;
mod config;
mod force_driven;
mod forecast;
mod history;
mod passivity;
mod pose_blend;
mod receiver;

pub use acceleration::AccelerationDriven;
pub use blend::Blend;
pub use config::{Playout, Policy, Predict, RecoveryConfig};
pub use force_driven::ForceDriven;
pub use forecast::Forecast;
pub use history::{HISTORY, History, TickData};
pub use passivity::PassivityGuard;
pub use pose_blend::PoseBlend;
pub use receiver::{Arrival, Receiver, RepairCounts, VisualGrab};

use nalgebra::Vector3;
use pliant_modal::{ContactState, Frame};

pub use crate::prediction::HandState;
use crate::state::{State, Tick};

/// Turns received data into the receiver's best estimate of the host's state.
///
/// The [`Receiver`] calls [`Recovery::advance`] once per tick, in order. The receiver calls
/// [`Recovery::correct`] when data arrives for ticks that were already stepped, and blends the
/// resulting difference out of the visual state.
pub trait Recovery: Send + Sync {
    /// Takes `state` as the true state after `tick`. `load` holds the modal forces that the
    /// reactions do not explain. `hands` holds the forces of the hands over the last step, and
    /// `contacts` what the contacts of that step have left.
    fn restart(
        &mut self,
        tick: Tick,
        state: &State,
        load: &[f64],
        hands: &[HandState],
        contacts: &ContactState,
    );

    /// Steps to `tick`, which is one tick after the last. The step uses the data of `tick` if
    /// `history` has it, and a prediction otherwise.
    fn advance(&mut self, tick: Tick, history: &History);

    /// Corrects the state up to the current tick after data arrived for `from` and possibly for
    /// later ticks. Returns false when the data came too late to be used.
    fn correct(&mut self, from: Tick, history: &History) -> bool;

    /// Takes over the absolute state slice of the frame of `tick`, after that tick has been
    /// reached.
    fn refresh(&mut self, tick: Tick, history: &History);

    /// The best estimate of the host's state at the current tick.
    fn confirmed(&self) -> &State;

    /// Modal forces that the reactions do not explain, as far as the policy knows them. Empty for
    /// none.
    fn load(&self) -> &[f64] {
        &[]
    }

    /// The rigid frame of a free body, if the policy steps it where no pose has arrived.
    fn frame(&self) -> Option<&Frame> {
        None
    }

    /// What the contacts of the last step have left, if the policy steps them.
    fn contacts(&self) -> Option<&ContactState> {
        None
    }

    /// Sum of the contact forces of the last step (N), and their torque about the center of mass
    /// (N m), world axes, as far as the policy knows them.
    fn contact_push(&self) -> [Vector3<f64>; 2] {
        [Vector3::zeros(); 2]
    }

    /// The hands of the last step, as far as the policy knows them.
    fn hands(&self) -> &[HandState] {
        &[]
    }

    /// Returns true when the visual reactions are the reactions that drive the state. Returns false
    /// when the reactions must be computed from the state.
    fn driven_by_reactions(&self) -> bool;
}
