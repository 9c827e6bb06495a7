//! The loss recovery settings of a session.

use std::time::Duration;

use pliant_modal::Integrator;

use crate::wire::{AccelerationCoding, Payload, StreamSubscription};
use crate::{StreamError, state::MAX_MODES};

/// Prediction of an acceleration that has not arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Predict {
    /// Zero.
    Zero,
    /// The last acceleration that was used.
    Hold,
    /// The line through the last two accelerations that were used.
    #[default]
    Linear,
}

/// How a receiver recovers lost data.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Policy {
    /// Counts a lost acceleration as 0 and never corrects it.
    None,
    /// The paper's method. The receiver predicts a lost acceleration and requests it again. When
    /// the late acceleration arrives, its error leaves the visual state over `blend_ticks`.
    Paper {
        /// The prediction of a lost acceleration.
        predict: Predict,
        /// Ticks over which the error in the visual state fades, at least 1.
        blend_ticks: u16,
    },
    /// The receiver steps its own damped model with the streamed reactions. Damping makes errors
    /// die out, and a late reaction makes the receiver step again from the tick of that reaction.
    ForceDriven {
        /// Ticks over which the error in the visual state fades, at least 1.
        blend_ticks: u16,
    },
}

/// How far behind the earliest arrivals a guest plays a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Playout {
    /// This many ticks plus the scatter of 98 of 100 arrivals. The scatter part is a quarter tick
    /// to two ticks.
    Fixed(u8),
    /// The scatter of 98 of 100 arrivals, at most this many ticks, plus a quarter tick.
    Adaptive(u8),
}

/// All loss recovery settings. The guest chooses them per session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecoveryConfig {
    /// The recovery policy. Default: [`Policy::ForceDriven`] with a blend of 6 ticks (150 ms at 40
    /// Hz).
    pub policy: Policy,
    /// Coding of accelerations, if the policy streams them. Default:
    /// [`AccelerationCoding::Visible`].
    pub coding: AccelerationCoding,
    /// Earlier ticks that each frame repeats, 0..=7. Default: 3.
    pub repeats: u8,
    /// Each frame carries the absolute (q, v) of one in this many modes, those with the largest
    /// error first. 0 means never. Default: 15.
    pub refresh: u8,
    /// Request missing frames again. Default: true.
    pub nack: bool,
    /// Request a snapshot when a checksum disagrees or a gap cannot be closed. Default: true.
    pub snapshots: bool,
    /// The playout delay. Default: [`Playout::Fixed`] with 1 tick.
    pub playout: Playout,
    /// Cut fading corrections that would put more energy into the visual body than it has lost. See
    /// [`super::PassivityGuard`]. Default: true.
    pub passive: bool,
    /// Time without a frame after which prediction ends. The body then stands still until a frame
    /// arrives. Default: 0.475 s.
    pub stall_after: Duration,
}

impl Default for RecoveryConfig {
    /// The force-driven policy with three repeats, the absolute state of one in 15 modes per frame,
    /// NACK, snapshots and one tick of playout delay.
    fn default() -> Self {
        Self {
            policy: Policy::ForceDriven { blend_ticks: 6 },
            coding: AccelerationCoding::Visible,
            repeats: 3,
            refresh: 15,
            nack: true,
            snapshots: true,
            playout: Playout::Fixed(1),
            passive: true,
            stall_after: Duration::from_millis(475),
        }
    }
}

impl RecoveryConfig {
    /// Recovers nothing.
    pub fn none() -> Self {
        Self { policy: Policy::None, nack: false, ..Self::paper() }
    }

    /// The paper's method: linear prediction, NACK and a blend over 50 ticks, without repeats,
    /// refresh, snapshots or playout delay.
    pub fn paper() -> Self {
        Self {
            policy: Policy::Paper { predict: Predict::Linear, blend_ticks: 50 },
            repeats: 0,
            refresh: 0,
            snapshots: false,
            passive: false,
            playout: Playout::Fixed(0),
            ..Self::default()
        }
    }

    /// The paper's method with another prediction and blend.
    pub fn paper_with(predict: Predict, blend_ticks: u16) -> Self {
        Self { policy: Policy::Paper { predict, blend_ticks }, ..Self::paper() }
    }

    /// Returns a configuration by name: `default`, `none`, `paper`, `paper-zero`, `paper-hold`,
    /// `force-driven` (without repeats, refresh, snapshots or delay) or `paper-repeats` (the
    /// paper's method with three repeats and one tick of delay).
    pub fn by_name(name: &str) -> Option<Self> {
        Some(match name {
            "default" => Self::default(),
            "none" => Self::none(),
            "paper" => Self::paper(),
            "paper-zero" => Self::paper_with(Predict::Zero, 50),
            "paper-hold" => Self::paper_with(Predict::Hold, 50),
            "paper-repeats" => Self { repeats: 3, playout: Playout::Fixed(1), ..Self::paper() },
            "force-driven" => Self { policy: Policy::ForceDriven { blend_ticks: 6 }, ..Self::paper() },
            _ => return None,
        })
    }

    /// The names that [`RecoveryConfig::by_name`] accepts.
    pub const NAMES: [&'static str; 7] =
        ["default", "none", "paper", "paper-zero", "paper-hold", "paper-repeats", "force-driven"];

    /// The integrator with which the host steps a body that is streamed this way. Accelerations
    /// that are streamed or predicted are read by Newmark's formulas, so the host's integrator has
    /// to follow them as well.
    pub fn integrator(&self) -> Integrator {
        match self.policy {
            Policy::ForceDriven { .. } => Integrator::Exact,
            _ => Integrator::GeneralizedAlpha { rho_inf: 0.5 },
        }
    }

    /// The stream subscription that this configuration sends to the host's encoder. `modes` limits
    /// the number of modes.
    pub fn subscription(&self, modes: Option<u16>) -> StreamSubscription {
        let payload = match self.policy {
            Policy::ForceDriven { .. } => Payload::Forces,
            Policy::None | Policy::Paper { .. } => Payload::Accelerations(self.coding),
        };
        let modes = modes.unwrap_or(MAX_MODES as u16).max(1);
        StreamSubscription { payload, modes, repeats: self.repeats.min(7), refresh: self.refresh }
    }

    /// Checks that all values are in range.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a value out of range.
    pub fn check(&self) -> Result<(), StreamError> {
        let blend = match self.policy {
            Policy::None => 1,
            Policy::Paper { blend_ticks, .. } | Policy::ForceDriven { blend_ticks } => blend_ticks,
        };
        let fail = |what, found: String, expected| Err(StreamError::Config { what, found, expected });
        if !(1..=4096).contains(&blend) {
            return fail("blend_ticks", blend.to_string(), "1..=4096");
        }
        if self.repeats > 7 {
            return fail("repeats", self.repeats.to_string(), "0..=7");
        }
        let (Playout::Fixed(ticks) | Playout::Adaptive(ticks)) = self.playout;
        if ticks > 16 {
            return fail("playout", ticks.to_string(), "0..=16 ticks");
        }
        Ok(())
    }
}
