//! Step settings, the same for all copies of a body.

use serde::{Deserialize, Serialize};

use crate::{Integrator, ModalModel, Relaxation, StepError};

/// How a body resists deformation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Elasticity {
    /// The forces are those of small strains, `omega^2 q`.
    ///
    /// A step costs a few microseconds. The forces are wrong as soon as a pull can be seen. For
    /// crowds, and for bodies that are only looked at.
    Linear,
    /// The forces are those of the model's material for large strains and rotations, reduced to the
    /// coordinates of the model (see [`ReducedElasticity`](crate::ReducedElasticity)). Default.
    ///
    /// A model without a material is stepped as [`Elasticity::Linear`].
    #[default]
    Reduced,
}

impl std::fmt::Display for Elasticity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Linear => "linear",
            Self::Reduced => "reduced",
        })
    }
}

/// Step settings of a body.
///
/// The host, its guests and peers must agree on these settings, on the model and on the step
/// length.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StepSettings {
    /// How the body resists deformation. Default: [`Elasticity::Reduced`], which only a model that
    /// was baked with a material has.
    pub elasticity: Elasticity,
    /// Integrator of the modes. Default: [`Integrator::Exact`].
    ///
    /// It has no effect on reduced elasticity, which has one integrator.
    pub integrator: Integrator,
    /// Whether reactions are of second order in the step. Default: `true`.
    ///
    /// If true, the force over a step is taken as the force at the middle of the step, and the
    /// reaction at the end is `1.5 F - 0.5 F_before`. On a body that the warp bends, a small part
    /// of first order is left, which shows above 240 steps a second. If false, the reaction is the
    /// force over the step, which is of first order. This only affects the exact integrator, as the
    /// others use the force at the end in any case. It only affects anchored bodies, because the
    /// frame of a free body moves by a first-order step.
    pub second_order: bool,
    /// Whether the shape bends by modal warping (Choi and Ko 2005). Without warp displacements stay
    /// linear, and the body grows when it turns. Reduced elasticity needs and has no warp. Default:
    /// `true`.
    pub warp: bool,
    /// Number of Newton corrections of the hands in one step, 1 to
    /// [`StepSettings::MAX_CORRECTIONS`]. With linear elasticity they only have an effect with
    /// warp. With reduced elasticity they are the least number of Newton rounds of
    /// the whole step, which goes on to the maximum where it converges slowly. Default: 2.
    pub corrections: u8,
    /// Uniform acceleration, m/s^2, world axes. Each component is at most 1e9 in magnitude.
    /// Default: zero.
    pub gravity: [f64; 3],
    /// Factor on all damping coefficients, 0 to 1e6. Default: 1.
    pub damping_scale: f64,
    /// Factor on the material's stiffness, 1e-6 to 1e6. The body then behaves as with this multiple
    /// of the baked Young's modulus.
    ///
    /// Frequencies scale with the square root of the factor. Compliances, including those of held
    /// patches, scale with its inverse. Damping scales as described at [`ModalModel::stiffened`].
    /// Default: 1.
    pub stiffness_scale: f64,
    /// Parameters of a viscoelastic material: every mode, and the flexibility under every hand, is
    /// a standard linear solid. With reduced elasticity the elastic force of each coordinate
    /// relaxes. Default: `None`, elastic.
    pub relaxation: Option<Relaxation>,
}

impl Default for StepSettings {
    fn default() -> Self {
        Self {
            elasticity: Elasticity::default(),
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
    /// Maximum number of Newton corrections in one step.
    pub const MAX_CORRECTIONS: u8 = 8;

    /// Checks all ranges, also for settings from a network.
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for a value that is not finite or out of range.
    pub fn check(&self) -> Result<(), StepError> {
        let Self { damping_scale: damping, stiffness_scale: stiffness, .. } = *self;
        StepError::check("damping_scale", "0 to 1e6", (0.0..=1e6).contains(&damping), damping)?;
        let sound = (1e-6..=1e6).contains(&stiffness);
        StepError::check("stiffness_scale", "1e-6 to 1e6", sound, stiffness)?;
        let corrections = self.corrections;
        let sound = (1..=Self::MAX_CORRECTIONS).contains(&corrections);
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

    /// Encodes the settings for digests. Equal settings give the same bytes on every machine.
    pub fn to_bytes(&self) -> Vec<u8> {
        // Each field is named, so that a new one cannot be forgotten here.
        let Self {
            integrator,
            elasticity,
            second_order,
            warp,
            corrections,
            relaxation,
            damping_scale,
            stiffness_scale,
            gravity,
        } = *self;
        let (kind, rho_inf) = match integrator {
            Integrator::Exact => (0, 0.0),
            Integrator::Newmark => (1, 0.0),
            Integrator::GeneralizedAlpha { rho_inf } => (2, rho_inf),
        };
        let (ratio, time) = relaxation.map_or((0.0, 0.0), |r| (r.ratio, r.time));
        let numbers = [rho_inf, damping_scale, stiffness_scale, ratio, time];
        let mut out = vec![kind, second_order.into(), warp.into(), corrections, relaxation.is_some().into()];
        out.push(match elasticity {
            Elasticity::Linear => 0,
            Elasticity::Reduced => 1,
        });
        out.extend(numbers.iter().chain(&gravity).flat_map(|number| number.to_le_bytes()));
        out
    }

    /// Returns the extrapolation factor `x` of the force at the end of a step:
    /// `F_end = (1 + x) F - x F_before`.
    ///
    /// `F` is the force over the step and `F_before` that over the previous step. With reduced
    /// elasticity the force of a step is that at its end. `hands` with more rows than the body that
    /// computes their forces has `modes` contradict each other, and would not come to rest with
    /// extrapolated forces.
    pub fn extrapolation(&self, model: &ModalModel, modes: usize, hands: usize) -> f64 {
        let exact = self.integrator == Integrator::Exact && !self.is_reduced(model);
        let second = self.second_order && exact && !model.is_free() && 3 * hands <= modes;
        if second { 0.5 } else { 0.0 }
    }

    /// Whether a body of this model has reduced elasticity.
    pub fn is_reduced(&self, model: &ModalModel) -> bool {
        self.elasticity == Elasticity::Reduced && model.material().is_some()
    }

    /// Whether the shape of a body of this model bends by modal warping.
    pub fn warps(&self, model: &ModalModel) -> bool {
        self.warp && !self.is_reduced(model)
    }

    /// Angular frequency (rad/s) and damping coefficient (1/s) of a mode as stepped.
    pub fn mode(&self, model: &ModalModel, mode: usize) -> (f64, f64) {
        let (omega, damping) = model.stiffened(mode, self.stiffness_scale);
        (omega, damping * self.damping_scale)
    }
}
