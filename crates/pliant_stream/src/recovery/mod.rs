//! What the receiver does about loss: policies behind one trait, over one store of what has arrived.

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

use crate::state::{GrabKey, State, Tick};

/// How a receiver turns what arrived into its best estimate of the host's state.
///
/// The [`Receiver`] calls it: [`Recovery::advance`] once per tick in order, [`Recovery::correct`] when data for ticks
/// that were already stepped arrived late, and blends the difference away from what is shown.
pub trait Recovery: Send + Sync {
    /// Takes a state over as true after `tick`, with the modal forces that the reactions do not explain
    /// and the forces of the hands over the last step (N, world axes).
    fn restart(&mut self, tick: Tick, state: &State, load: &[f64], means: &[(GrabKey, Vector3<f64>)]);

    /// Steps to `tick`, one beyond the last, with its data where `history` has it and a prediction where not.
    fn advance(&mut self, tick: Tick, history: &History);

    /// Puts right what data for `from` and possibly later ticks changes, up to the tick reached. Returns false when it
    /// came too late to be used.
    fn correct(&mut self, from: Tick, history: &History) -> bool;

    /// Takes over the absolute part that the frame of `tick` carried, once that tick has been reached.
    fn refresh(&mut self, tick: Tick, history: &History);

    /// The best estimate of the truth at the tick reached.
    fn confirmed(&self) -> &State;

    /// Modal forces that the reactions do not explain, as far as they are known; empty for none.
    fn load(&self) -> &[f64] {
        &[]
    }

    /// The forces of the hands over the last step, N, world axes, as far as they are known.
    fn means(&self) -> &[(GrabKey, Vector3<f64>)] {
        &[]
    }

    /// True when the reactions shown are those that drive the state; false when they are to be computed from it.
    fn driven_by_reactions(&self) -> bool;
}
