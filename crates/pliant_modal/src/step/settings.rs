//! How a body is stepped, wherever a copy of it is.

use serde::{Deserialize, Serialize};

use crate::{Integrator, ModalModel, Relaxation, StepError};

/// How a body is stepped: everything that the host, its guests and peers have to agree on, besides
/// the model and the length of a step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StepSettings {
    /// How the modes are integrated. Default: [`Integrator::Exact`].
    pub integrator: Integrator,
    /// Take a hand's force over a step for that of the step's middle, which it is, and tell the
    /// reaction at the end as `1.5 F - 0.5 F_before`: what is felt is then of second order in the step.
    /// Without it the force over the step is told as it is, of first order. Only the exact integrator
    /// has a choice, the others take the force at the end anyway; and only on anchored bodies, as the
    /// frame of a free one moves by a first-order step. Default: `true`.
    pub second_order: bool,
    /// Bend by modal warping (Choi and Ko 2005). Without it displacements stay linear, and the body
    /// grows when it turns. Default: `true`.
    pub warp: bool,
    /// Newton corrections of the hands in one step, 1 to [`StepSettings::MOST_CORRECTIONS`]. They
    /// only matter under warp. Default: 2.
    pub corrections: u8,
    /// Uniform acceleration, m/s^2, world axes, each at most 1e9. Default: none.
    pub gravity: [f64; 3],
    /// Factor on all damping coefficients, 0 to 1e6. Default: 1.
    pub damping_scale: f64,
    /// Factor on the material's stiffness, 1e-6 to 1e6: the body as it would be with so many times
    /// the baked Young's modulus. Frequencies go with its root, compliances (those of held patches,
    /// too) with its inverse; damping as [`ModalModel::stiffened`] says. Default: 1.
    pub stiffness_scale: f64,
    /// A viscoelastic material: every mode, and the flexibility under every hand, is a standard
    /// linear solid. Default: none, elastic.
    pub relaxation: Option<Relaxation>,
}

impl Default for StepSettings {
    fn default() -> Self {
        Self {
            integrator: Integrator::default(),
            second_order: true,
            warp: true,
            corrections: 2,
            gravity: [0.0; 3],
            damping_scale: 1.0,
            stiffness_scale: 1.0,
            relaxation: None,
        }
    }
}

impl StepSettings {
    /// Most Newton corrections in one step.
    pub const MOST_CORRECTIONS: u8 = 8;

    /// Checks all ranges, also those of settings that came from a network.
    ///
    /// # Errors
    /// [`StepError::Input`] with the value that is not finite or not in its range.
    pub fn check(&self) -> Result<(), StepError> {
        let Self { damping_scale: damping, stiffness_scale: stiffness, .. } = *self;
        StepError::check("damping_scale", "0 to 1e6", (0.0..=1e6).contains(&damping), damping)?;
        let sound = (1e-6..=1e6).contains(&stiffness);
        StepError::check("stiffness_scale", "1e-6 to 1e6", sound, stiffness)?;
        let corrections = self.corrections;
        let sound = (1..=Self::MOST_CORRECTIONS).contains(&corrections);
        StepError::check("corrections", "1 to 8", sound, corrections.into())?;
        if let Integrator::GeneralizedAlpha { rho_inf } = self.integrator {
            StepError::check("rho_inf", "0 to 1", (0.0..=1.0).contains(&rho_inf), rho_inf)?;
        }
        if let Some(relaxation) = &self.relaxation {
            relaxation.check()?;
        }
        let beyond = self.gravity.iter().find(|x| x.is_nan() || x.abs() > 1e9);
        StepError::check("gravity", "-1e9 to 1e9", beyond.is_none(), beyond.copied().unwrap_or(0.0))
    }

    /// The same bytes for the same settings, on every machine: for digests.
    pub fn to_bytes(&self) -> Vec<u8> {
        let Self { integrator, second_order, warp, corrections, gravity, .. } = *self;
        let (kind, rho_inf) = match integrator {
            Integrator::Exact => (0, 0.0),
            Integrator::Newmark => (1, 0.0),
            Integrator::GeneralizedAlpha { rho_inf } => (2, rho_inf),
        };
        let (ratio, time) = self.relaxation.map_or((0.0, 0.0), |r| (r.ratio, r.time));
        let numbers = [rho_inf, self.damping_scale, self.stiffness_scale, ratio, time];
        let mut out =
            vec![kind, second_order.into(), warp.into(), corrections, self.relaxation.is_some().into()];
        out.extend(numbers.iter().chain(&gravity).flat_map(|number| number.to_le_bytes()));
        out
    }

    /// By how much more than the force over a step the force at its end counts, less that of the step
    /// before: `F_end = (1 + x) F - x F_before`.
    pub fn extrapolation(&self, model: &ModalModel) -> f64 {
        let second = self.second_order && self.integrator == Integrator::Exact && !model.is_free();
        if second { 0.5 } else { 0.0 }
    }

    /// Angular frequency (rad/s) and damping coefficient (1/s) of a mode as it is stepped.
    pub fn mode(&self, model: &ModalModel, mode: usize) -> (f64, f64) {
        let (omega, damping) = model.stiffened(mode, self.stiffness_scale);
        (omega, damping * self.damping_scale)
    }
}
