//! A hand: a compliant, implicit constraint that ties a patch to a target.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::HeldPatch;
use crate::{Relaxation, StepError};

/// Spring and damper between a hand and its patch.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GrabConfig {
    /// Stiffness of the hand's own spring (the coupling of the device), N/m, in series with the
    /// residual flexibility of the patch.
    ///
    /// With `None` the hand is as stiff as the patch allows. An infinite stiffness makes a rigid
    /// constraint, see [`GrabConfig::RIGID`]. Default: `None`.
    pub stiffness: Option<f64>,
    /// Relaxation time of the coupling's damper, s, 0 or more. The coupling is
    /// `lambda = C^-1 (gap + relaxation d(gap)/dt)`. Default: 0.
    pub relaxation: f64,
}

impl Default for GrabConfig {
    fn default() -> Self {
        Self { stiffness: None, relaxation: 0.0 }
    }
}

impl GrabConfig {
    /// The hand of equation (4) of Tang et al. 2013: the patch is at the target at the end of each
    /// step, `A lambda = x_target - x*`, without any compliance.
    ///
    /// This is for comparison only. Under [`Integrator::Newmark`](crate::Integrator::Newmark), the
    /// paper's integrator, its force changes its sign in every step and grows, until it is that of
    /// a pull from one size of the body away, the bound of all hands. A session replaces it by a
    /// spring of [`GrabConfig::MAX_STIFFNESS`].
    pub const RIGID: Self = Self { stiffness: Some(f64::INFINITY), relaxation: 0.0 };
    /// Largest stiffness accepted from a network, N/m. It is twenty times that of the stiffest
    /// devices (5,000 N/m), for tools that scale forces up.
    pub const MAX_STIFFNESS: f64 = 1e5;
    /// Longest relaxation time of a damper accepted from a network, s. The strongest dampers of
    /// devices (30 N s/m) on the softest hands (50 N/m) have 0.6 s.
    pub const MAX_RELAXATION: f64 = 1.0;

    /// Returns the configuration limited to the range of real devices and rounded to single
    /// precision, for transmission over a network.
    #[must_use]
    pub fn capped(self) -> Self {
        let cap = |x: f64, most: f64| f64::from(x.min(most) as f32);
        Self {
            // A spring that is too soft for single precision must remain a spring.
            stiffness: self.stiffness.map(|k| cap(k, Self::MAX_STIFFNESS).max(f64::from(f32::MIN_POSITIVE))),
            relaxation: cap(self.relaxation, Self::MAX_RELAXATION),
        }
    }

    /// Whether the hand is a rigid constraint, see [`GrabConfig::RIGID`].
    pub fn is_rigid(&self) -> bool {
        self.stiffness == Some(f64::INFINITY)
    }

    /// Checks the ranges of both values.
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for a value that is not a number or out of range.
    pub fn check(&self) -> Result<(), StepError> {
        if let Some(k) = self.stiffness {
            StepError::check("grab stiffness", "N/m above 0", k > 0.0, k)?;
        }
        let r = self.relaxation;
        StepError::check("grab relaxation", "finite seconds, 0 or more", r.is_finite() && r >= 0.0, r)
    }
}

/// One hand in a step.
#[derive(Debug, Clone)]
pub struct Hand {
    /// The held patch. It must have as many modes as the kernel steps.
    pub patch: Arc<HeldPatch>,
    /// How the patch is held.
    pub hold: Hold,
    /// Force on the body at the end of the last step, N, world axes. It is minus the reaction.
    pub pull: Vector3<f64>,
    /// Force on the body over the last step, N, world axes. It is constant over the step.
    pub mean: Vector3<f64>,
    /// Viscoelastic state of the patch's residual flexibility, m, body axes: the `z` of the
    /// compliance that the modes leave out. Zero where the material is elastic.
    pub viscoelastic: Vector3<f64>,
}

/// What holds a patch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Hold {
    /// A hand at a target position.
    Target {
        /// Position of the hand, m, world axes.
        target: Vector3<f64>,
        /// Velocity of the hand over the step, m/s, world axes. The damper uses it, and the
        /// guard of the energy, for which the way of the target is what the hand supplies.
        velocity: Vector3<f64>,
        /// Spring and damper of the hand.
        config: GrabConfig,
    },
    /// A patch whose position was measured elsewhere.
    ///
    /// The value is the displacement from rest (m, body axes) at which the patch ends the step
    /// under the hand's `pull`, as set before the step.
    Measured(Vector3<f64>),
}

impl Hand {
    /// Makes a hand without any force so far.
    pub fn new(patch: Arc<HeldPatch>, hold: Hold) -> Self {
        let zero = Vector3::zeros();
        Self { patch, hold, pull: zero, mean: zero, viscoelastic: zero }
    }

    /// Spring and damper of the hand. A measured patch returns the default, which has no effect.
    pub fn config(&self) -> GrabConfig {
        match self.hold {
            Hold::Target { config, .. } => config,
            Hold::Measured(_) => GrabConfig::default(),
        }
    }
}

/// Viscoelastic response of the residual flexibility of a patch: `d = C pull + ratio y` with
/// `time y' = d - y` (see [`Relaxation`]).
///
/// With a constant force over a step, `y1 = carry y0 + gain C pull` and
/// `d1 = at_once C pull + ratio carry y0`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ViscoelasticPatch {
    ratio: f64,
    carry: f64,
    gain: f64,
    /// Compliance within a step, as a multiple of the instantaneous compliance.
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

    /// Compliance of the residual flexibility and the hand's spring in series within a step, m/N.
    ///
    /// `residual` is the residual flexibility of the hand's patch at the baked stiffness.
    pub(crate) fn compliance(&self, hand: &Hand, residual: Matrix3<f64>) -> Matrix3<f64> {
        if hand.config().is_rigid() {
            return Matrix3::zeros();
        }
        let spring = hand.config().stiffness.map_or(0.0, |k| 1.0 / k);
        residual * (self.softness * self.at_once) + Matrix3::identity() * spring
    }

    /// Displacement of a patch in a step that is due to earlier forces alone, m.
    pub(crate) fn creep_displacement(&self, viscoelastic: &Vector3<f64>) -> Vector3<f64> {
        self.ratio * self.carry * viscoelastic
    }

    /// Force (N, body axes) to which the hand's past has relaxed a patch: `y` with
    /// `time y' = pull - (1 - ratio) y`. The viscoelastic state is the baked residual flexibility
    /// under it.
    pub(crate) fn relaxed_force(&self, hand: &Hand) -> Vector3<f64> {
        if self.ratio == 0.0 || hand.viscoelastic == Vector3::zeros() {
            return Vector3::zeros();
        }
        let inverse = (self.softness * hand.patch.residual()).try_inverse();
        let force = inverse.map_or_else(Vector3::zeros, |inverse| inverse * hand.viscoelastic);
        if force.iter().all(|x| x.is_finite()) { force } else { Vector3::zeros() }
    }

    /// Part of an elastic force that its branch takes off for each unit of
    /// [`ViscoelasticPatch::relaxed_force`].
    pub(crate) fn ratio(&self) -> f64 {
        self.ratio
    }

    /// Displacement of a patch of reduced elasticity, whose residual flexibility is `residual`, in
    /// a step that is due to earlier forces alone, m.
    pub(crate) fn creep_of(&self, hand: &Hand, residual: &Matrix3<f64>) -> Vector3<f64> {
        self.ratio * self.carry * self.softness * (residual * self.relaxed_force(hand))
    }

    /// Returns the viscoelastic state after a step under a force `pull` (N, body axes).
    pub(crate) fn step(&self, hand: &Hand, pull: &Vector3<f64>) -> Vector3<f64> {
        if hand.config().is_rigid() {
            return self.carry * hand.viscoelastic;
        }
        self.carry * hand.viscoelastic + self.gain * (self.softness * (hand.patch.residual() * pull))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hand_from_a_network_is_no_stiffer_and_no_slower_than_a_device() {
        let hand = |stiffness, relaxation| GrabConfig { stiffness, relaxation }.capped();
        assert_eq!(hand(Some(1e9), 50.0), hand(Some(GrabConfig::MAX_STIFFNESS), GrabConfig::MAX_RELAXATION));
        assert_eq!(hand(Some(1e9), 50.0).stiffness, Some(GrabConfig::MAX_STIFFNESS));
        assert_eq!(hand(Some(1e9), 50.0).relaxation, GrabConfig::MAX_RELAXATION);
        // What real devices have stays, but for the rounding to single precision.
        let real = hand(Some(2_000.0), 0.015);
        assert!(real.stiffness == Some(2_000.0) && (real.relaxation - 0.015).abs() < 1e-8, "{real:?}");
        assert!(hand(Some(1e-300), 0.0).stiffness.is_some_and(|k| k > 0.0));
        assert_eq!(hand(None, 0.0), GrabConfig::default());
        assert_eq!(GrabConfig::RIGID.capped().stiffness, Some(GrabConfig::MAX_STIFFNESS));
        assert!(GrabConfig::RIGID.check().is_ok());
        for bad in [f64::NAN, 0.0, -1.0, f64::NEG_INFINITY] {
            assert!(GrabConfig { stiffness: Some(bad), relaxation: 0.0 }.check().is_err(), "{bad}");
        }
    }
}
