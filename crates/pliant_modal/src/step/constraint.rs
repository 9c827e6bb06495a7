//! A hand: a patch tied to a target by a compliant, implicit constraint.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::HeldPatch;
use crate::{Relaxation, StepError};

/// How a hand holds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GrabConfig {
    /// Stiffness of the hand's own spring (the device's coupling), N/m, in series with the patch's residual flexibility.
    /// `None`: the hand is as stiff as the patch it holds allows. Default: `None`.
    pub stiffness: Option<f64>,
    /// Relaxation time of the coupling's damper, s: the coupling is `lambda = C^-1 (gap + relaxation d(gap)/dt)`. 0 or more. Default: 0.
    pub relaxation: f64,
}

impl Default for GrabConfig {
    fn default() -> Self {
        Self { stiffness: None, relaxation: 0.0 }
    }
}

impl GrabConfig {
    /// Stiffest spring that is taken from a network, N/m: twenty times that of the stiffest devices
    /// (5,000 N/m), for tools that scale forces up.
    pub const MOST_STIFFNESS: f64 = 1e5;
    /// Longest relaxation time of a damper that is taken from a network, s: the strongest dampers of
    /// devices (30 N s/m) on the softest hands (50 N/m) have 0.6 s.
    pub const MOST_RELAXATION: f64 = 1.0;

    /// The same within what real devices have, and as single precision has it: what crosses a network.
    #[must_use]
    pub fn capped(self) -> Self {
        let cap = |x: f64, most: f64| f64::from(x.min(most) as f32);
        Self {
            // A spring too soft for single precision is still a spring.
            stiffness: self.stiffness.map(|k| cap(k, Self::MOST_STIFFNESS).max(f64::from(f32::MIN_POSITIVE))),
            relaxation: cap(self.relaxation, Self::MOST_RELAXATION),
        }
    }

    /// Checks both ranges.
    ///
    /// # Errors
    /// [`StepError::Input`] with the value that is not finite or not in its range.
    pub fn check(&self) -> Result<(), StepError> {
        if let Some(k) = self.stiffness {
            StepError::check("grab stiffness", "finite N/m above 0", k.is_finite() && k > 0.0, k)?;
        }
        let r = self.relaxation;
        StepError::check("grab relaxation", "finite seconds, 0 or more", r.is_finite() && r >= 0.0, r)
    }
}

/// One hand in a step.
#[derive(Debug, Clone)]
pub struct Hand {
    /// What is held. Of as many modes as are stepped.
    pub patch: Arc<HeldPatch>,
    /// By what it is held.
    pub hold: Hold,
    /// Force on the body at the end of the last step, N, world axes; minus the reaction.
    pub pull: Vector3<f64>,
    /// Force on the body over the last step, which is held constant over it, N, world axes.
    pub mean: Vector3<f64>,
    /// How far the patch's residual flexibility has flown, m, body axes: the `z` of what the modes
    /// leave out. Zero where the material is elastic.
    pub flow: Vector3<f64>,
}

/// By what a patch is held.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Hold {
    /// A hand at a target.
    Target {
        /// Where the hand is, m, world axes.
        target: Vector3<f64>,
        /// How fast it moves, m/s, world axes. Only a damper looks at it.
        velocity: Vector3<f64>,
        /// Its spring and damper.
        config: GrabConfig,
    },
    /// A patch that was measured elsewhere: it ends at this displacement from rest (m, body axes)
    /// when it is pulled by the hand's `pull`, as told before the step.
    Measured(Vector3<f64>),
}

impl Hand {
    /// A hand that has not pulled yet.
    pub fn new(patch: Arc<HeldPatch>, hold: Hold) -> Self {
        let zero = Vector3::zeros();
        Self { patch, hold, pull: zero, mean: zero, flow: zero }
    }

    /// Spring and damper; those of a measured patch play no part.
    pub fn config(&self) -> GrabConfig {
        match self.hold {
            Hold::Target { config, .. } => config,
            Hold::Measured(_) => GrabConfig::default(),
        }
    }
}

/// How the residual flexibility of a patch answers in a viscoelastic material: `d = C pull + ratio y`,
/// `time y' = d - y`; see [`Relaxation`]. With the pull held over a step `y1 = carry y0 + gain C pull`
/// and `d1 = at_once C pull + ratio carry y0`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ViscoelasticPatch {
    ratio: f64,
    carry: f64,
    gain: f64,
    /// Compliance within a step, as a multiple of the instantaneous one.
    at_once: f64,
    /// Residual flexibility as a multiple of the baked one.
    softness: f64,
}

impl ViscoelasticPatch {
    pub(crate) fn new(material: Option<Relaxation>, stiffness_scale: f64, h: f64) -> Self {
        let softness = 1.0 / stiffness_scale;
        let Some(material) = material else {
            return Self { ratio: 0.0, carry: 0.0, gain: 0.0, at_once: 1.0, softness };
        };
        let left = 1.0 - material.ratio;
        let gone = -(-left * h / material.time).exp_m1();
        Self {
            ratio: material.ratio,
            carry: 1.0 - gone,
            gain: gone / left,
            at_once: material.creep(h),
            softness,
        }
    }

    /// Residual flexibility and the hand's spring in series as they answer within a step, m/N.
    pub(crate) fn compliance(&self, hand: &Hand) -> Matrix3<f64> {
        let spring = hand.config().stiffness.map_or(0.0, |k| 1.0 / k);
        hand.patch.residual() * (self.softness * self.at_once) + Matrix3::identity() * spring
    }

    /// How far a patch gives way in a step before anyone pulls, because it was pulled before, m.
    pub(crate) fn crept(&self, flow: &Vector3<f64>) -> Vector3<f64> {
        self.ratio * self.carry * flow
    }

    /// The flow after a step under a pull (N, body axes).
    pub(crate) fn step(&self, hand: &Hand, pull: &Vector3<f64>) -> Vector3<f64> {
        self.carry * hand.flow + self.gain * (self.softness * (hand.patch.residual() * pull))
    }
}
