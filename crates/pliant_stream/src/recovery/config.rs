//! Which repair a session uses.

use std::time::Duration;

use crate::wire::{AccelerationCoding, Payload, StreamSubscription};
use crate::{StreamError, state::MAX_MODES};

/// What stands in for an acceleration that has not arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Predict {
    /// Nothing: 0.
    Zero,
    /// The last one used.
    Hold,
    /// The line through the last two used.
    #[default]
    Linear,
}

/// How a receiver makes good what was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Policy {
    /// A lost acceleration counts as 0 and is never made good.
    None,
    /// The paper's: predict, ask again, and when the late acceleration comes take the error out of the shown state over
    /// so many ticks.
    Paper {
        /// The stand-in.
        predict: Predict,
        /// Ticks over which the shown error fades; at least 1.
        blend_ticks: u16,
    },
    /// The receiver owns the damped model and steps it with the streamed reactions: errors die out by themselves, and a
    /// late reaction is put right by stepping again from its tick.
    ForceDriven {
        /// Ticks over which the shown error fades; at least 1.
        blend_ticks: u16,
    },
}

/// How far behind the earliest arrivals a guest shows a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Playout {
    /// So many ticks, and what 98 of 100 arrivals scatter by (a quarter tick to two).
    Fixed(u8),
    /// Only what 98 of 100 arrivals scatter by, at most so many ticks, and a quarter tick.
    Adaptive(u8),
}

/// Everything about repair, chosen by the guest per session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecoveryConfig {
    /// The numbers. Default: [`Policy::ForceDriven`], 6 ticks of blend (150 ms at 40 Hz).
    pub policy: Policy,
    /// How accelerations are written, where the policy streams them. Default: [`AccelerationCoding::Visible`].
    pub coding: AccelerationCoding,
    /// Earlier ticks that each frame repeats, 0..=7. Default: 3.
    pub repeats: u8,
    /// Each frame carries the absolute (q, v) of one in so many modes, those most in need first; 0 for never. Default: 15.
    pub refresh: u8,
    /// Ask again for what is missing. Default: true.
    pub nack: bool,
    /// Ask for a snapshot when a checksum disagrees or a gap cannot be closed. Default: true.
    pub snapshots: bool,
    /// Default: [`Playout::Fixed`] with 1 tick.
    pub playout: Playout,
    /// Cut fading corrections that would put more energy into the shown body than it has lost; see
    /// [`super::PassivityGuard`]. Default: true.
    pub passive: bool,
    /// Prediction ends after this long without a frame: the body then stands still until one comes. Default: 0.5 s.
    pub stall_after: Duration,
}

impl Default for RecoveryConfig {
    /// The better way of the design: force-driven, three repeats, the absolute state of one in 15 modes with each, NACK, snapshots, one tick of
    /// playout delay.
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
            stall_after: Duration::from_millis(500),
        }
    }
}

impl RecoveryConfig {
    /// Nothing is repaired.
    pub fn none() -> Self {
        Self { policy: Policy::None, nack: false, ..Self::paper() }
    }

    /// The paper's method: linear prediction, NACK, blend over 50 ticks; no repeats, refresh, snapshot or delay.
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

    /// The paper's method with another prediction.
    pub fn paper_with(predict: Predict, blend_ticks: u16) -> Self {
        Self { policy: Policy::Paper { predict, blend_ticks }, ..Self::paper() }
    }

    /// A configuration by name: `default`, `none`, `paper`, `paper-zero`, `paper-hold`, `force-driven` (without repeats,
    /// refresh, snapshots or delay), `paper-repeats` (the paper's with three repeats and one tick of delay).
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

    /// The names that [`RecoveryConfig::by_name`] knows.
    pub const NAMES: [&'static str; 7] =
        ["default", "none", "paper", "paper-zero", "paper-hold", "paper-repeats", "force-driven"];

    /// What this repair asks of the host's encoder.
    pub fn subscription(&self, modes: Option<u16>) -> StreamSubscription {
        let payload = match self.policy {
            Policy::ForceDriven { .. } => Payload::Forces,
            Policy::None | Policy::Paper { .. } => Payload::Accelerations(self.coding),
        };
        let modes = modes.unwrap_or(MAX_MODES as u16).max(1);
        StreamSubscription { payload, modes, repeats: self.repeats.min(7), refresh: self.refresh }
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// [`StreamError::Config`].
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
